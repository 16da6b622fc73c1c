"""The window, made with GLFW; the only place that knows it."""

import ctypes
from contextlib import suppress
from pathlib import Path
from typing import Any, Final

from imgui_bundle import imgui  # before glfw: the two then share one library

import glfw  # isort: skip

from glstar.errors import ContextError, RenderError
from glstar.render.opengl.context import adopt_context
from glstar.render.opengl.objects import Context, Framebuffer

__all__ = ["WindowSurface"]

_WITHOUT: Final = "glstar view --headless --screenshot FILE draws without a window, glstar export writes frames"


class WindowSurface:
    """A window with an OpenGL 3.3 context, current on this thread.

    Parameters
    ----------
    size : tuple of int
        Width and height, screen px.

    Raises
    ------
    ContextError
        If there is no display, or none that draws OpenGL 3.3.
    """

    def __init__(self, size: tuple[int, int]) -> None:
        self._closed = False
        self._dropped: list[Path] = []
        self._windowed: tuple[int, int, int, int] | None = None
        # Its type hints tell of C, not of what the Python functions take.
        self._library: Any = glfw
        glfw.ERROR_REPORTING = "ignore"
        if not glfw.init():
            raise ContextError(f"no display to open a window on: {_complaint()}. {_WITHOUT}")
        for hint, value in (
            (glfw.CONTEXT_VERSION_MAJOR, 3),
            (glfw.CONTEXT_VERSION_MINOR, 3),
            (glfw.OPENGL_PROFILE, glfw.OPENGL_CORE_PROFILE),
            (glfw.OPENGL_FORWARD_COMPAT, 1),
        ):
            glfw.window_hint(hint, value)
        self._window: Any = glfw.create_window(*size, "glstar", None, None)
        if not self._window:
            code, words = glfw.get_error()
            glfw.terminate()
            self._closed = True
            raise ContextError(_no_window(code, _text(words)))
        try:
            glfw.make_context_current(self._window)
            # The loop paces itself: a software driver does not wait for the screen, whatever it is told.
            glfw.swap_interval(0)
            self._library.set_drop_callback(self._window, self._drop)
            self.context: Context = adopt_context()
        except RenderError:
            self.close()
            raise

    def _drop(self, _window: Any, paths: list[str]) -> None:
        self._dropped += [Path(path) for path in paths]

    @property
    def size(self) -> tuple[int, int]:
        """Width and height of what is drawn on, px."""
        width, height = glfw.get_framebuffer_size(self._window)
        return int(width), int(height)

    @property
    def scale(self) -> float:
        """Of the screen: 2 where text needs twice the screen's units."""
        return text_scale(
            float(glfw.get_window_content_scale(self._window)[0]),
            int(glfw.get_framebuffer_size(self._window)[0]),
            int(glfw.get_window_size(self._window)[0]),
        )

    @property
    def target(self) -> Framebuffer:
        """The window itself."""
        return self.context.screen

    @property
    def should_close(self) -> bool:
        """Whether somebody has closed it."""
        return bool(glfw.window_should_close(self._window))

    def attach(self) -> None:
        """Give keys and mouse to the imgui context that is current."""
        imgui.backends.glfw_init_for_opengl(ctypes.cast(self._window, ctypes.c_void_p).value or 0, True)

    def new_frame(self) -> None:
        """Tell imgui size, time and mouse."""
        imgui.backends.glfw_new_frame()

    def wait(self, timeout_s: float) -> bool:
        """Take events, waiting for the first of them.

        Parameters
        ----------
        timeout_s : float
            How long; 0 not to wait.

        Returns
        -------
        bool
            Whether there was one, where it was waited for.
        """
        if timeout_s <= 0:
            glfw.poll_events()
            return True
        before_s = glfw.get_time()
        glfw.wait_events_timeout(timeout_s)
        return bool(glfw.get_time() - before_s < 0.95 * timeout_s)

    def dropped(self) -> list[Path]:
        """Return what has been dropped onto the window since the last call."""
        paths, self._dropped = self._dropped, []
        return paths

    def set_full_screen(self, full: bool) -> None:
        """Fill the screen, or return to where the window was.

        Parameters
        ----------
        full : bool
        """
        if full == (self._windowed is not None):
            return
        if full:
            self._windowed = *glfw.get_window_pos(self._window), *glfw.get_window_size(self._window)
            monitor = glfw.get_primary_monitor()
            mode = glfw.get_video_mode(monitor)
            glfw.set_window_monitor(self._window, monitor, 0, 0, *mode.size, mode.refresh_rate)
        elif self._windowed is not None:
            windowed, self._windowed = self._windowed, None
            self._library.set_window_monitor(self._window, None, *windowed, 0)

    def set_title(self, title: str) -> None:
        """Say in the window's frame what it shows.

        Parameters
        ----------
        title : str
        """
        glfw.set_window_title(self._window, title)

    def present(self) -> None:
        """Show what was drawn."""
        glfw.swap_buffers(self._window)

    def detach(self) -> None:
        """Take keys and mouse from imgui."""
        imgui.backends.glfw_shutdown()

    def close(self) -> None:
        """Close the window and all that belongs to it; a second call does nothing."""
        if self._closed:
            return
        self._closed = True
        with suppress(AttributeError):
            self.context.release()
        glfw.destroy_window(self._window)
        glfw.terminate()


def text_scale(content_scale: float, framebuffer_px: int, window_units: int) -> float:
    """Return how much larger text is to be, in the window's units.

    On macOS and Wayland a unit is several pixels already, and only what the content scale asks for beyond that is left;
    on X11 and Windows a unit is a pixel.

    Parameters
    ----------
    content_scale : float
        What the system asks for.
    framebuffer_px, window_units : int
        The window's width.

    Returns
    -------
    float
    """
    return content_scale / (framebuffer_px / window_units) if framebuffer_px and window_units else content_scale


def _text(words: bytes | str | None) -> str:
    return words.decode(errors="replace") if isinstance(words, bytes) else words or "the system does not say why"


def _complaint() -> str:
    """Return what GLFW says of its last failure."""
    return _text(glfw.get_error()[1])


def _no_window(code: int, words: str) -> str:
    if code == glfw.VERSION_UNAVAILABLE:
        return f"this display's OpenGL is older than 3.3, which glstar needs: {words}; 'glstar doctor' shows the driver"
    if code == glfw.API_UNAVAILABLE:
        return f"this display draws no OpenGL (X11 without GLX?): {words}. {_WITHOUT}"
    return f"no window: {words}. {_WITHOUT}"
