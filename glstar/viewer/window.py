"""The window, made with GLFW; the only module that imports it."""

import ctypes
from contextlib import suppress
from pathlib import Path
from typing import Any

from imgui_bundle import imgui  # before glfw: the two then share one library

from glstar.errors import ContextError, RenderError
from glstar.render.opengl import Context, Framebuffer
from glstar.render.opengl.context import adopt_context
from glstar.viewer.ui.dialogs import has_native_dialogs

import glfw  # isort: skip


_ALTERNATIVES = "glstar view --headless --screenshot FILE draws without a window, glstar export writes frames"


class WindowSurface:
    """A window with an OpenGL 3.3 context, current on this thread.

    `size`: width and height, screen px.  Raises ContextError if there is no display, or its OpenGL is older than 3.3.
    """

    def __init__(self, size: tuple[int, int]) -> None:
        self._closed = False
        self._dropped: list[Path] = []
        self._windowed: tuple[int, int, int, int] | None = None
        # Untyped: the type hints of glfw are those of the C functions.
        self._library: Any = glfw
        glfw.ERROR_REPORTING = "ignore"
        if not glfw.init():
            raise ContextError(f"no display to open a window on: {_text(glfw.get_error()[1])}. {_ALTERNATIVES}")
        for hint, value in (
            (glfw.CONTEXT_VERSION_MAJOR, 3),
            (glfw.CONTEXT_VERSION_MINOR, 3),
            (glfw.OPENGL_PROFILE, glfw.OPENGL_CORE_PROFILE),
            (glfw.OPENGL_FORWARD_COMPAT, 1),
        ):
            glfw.window_hint(hint, value)
        self._window: Any = glfw.create_window(*size, "glstar", None, None)
        if not self._window:
            code, message = glfw.get_error()
            glfw.terminate()
            self._closed = True
            raise ContextError(_no_window(code, _text(message)))
        try:
            glfw.make_context_current(self._window)
            # The loop limits the frame rate itself: software drivers ignore the swap interval.
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
        """Width and height of the framebuffer, px."""
        width, height = glfw.get_framebuffer_size(self._window)
        return int(width), int(height)

    @property
    def window_size(self) -> tuple[int, int]:
        """Width and height of the window when it does not fill the screen, screen units."""
        width, height = self._windowed[2:] if self._windowed is not None else glfw.get_window_size(self._window)
        return int(width), int(height)

    @property
    def native_dialogs(self) -> bool:
        """Whether the system has file dialogs."""
        return has_native_dialogs()

    @property
    def scale(self) -> float:
        """Scale of the text: 2 if it needs twice the screen units."""
        return text_scale(
            float(glfw.get_window_content_scale(self._window)[0]),
            int(glfw.get_framebuffer_size(self._window)[0]),
            int(glfw.get_window_size(self._window)[0]),
        )

    @property
    def target(self) -> Framebuffer:
        """The framebuffer of the window."""
        return self.context.screen

    @property
    def should_close(self) -> bool:
        """Whether the user has closed the window."""
        return bool(glfw.window_should_close(self._window))

    def attach(self) -> None:
        """Connect keys and mouse to the current imgui context."""
        imgui.backends.glfw_init_for_opengl(ctypes.cast(self._window, ctypes.c_void_p).value or 0, True)

    def new_frame(self) -> None:
        """Give imgui size, time and mouse."""
        imgui.backends.glfw_new_frame()

    def wait(self, timeout_s: float) -> bool:
        """Process events, waiting for the first of them.

        `timeout_s`: longest wait; 0 for none.  Returns whether there was an event; always True without waiting.
        """
        if timeout_s <= 0:
            glfw.poll_events()
            return True
        before_s = glfw.get_time()
        glfw.wait_events_timeout(timeout_s)
        return bool(glfw.get_time() - before_s < 0.95 * timeout_s)

    def dropped(self) -> list[Path]:
        """Return the files dropped onto the window since the last call."""
        paths, self._dropped = self._dropped, []
        return paths

    def set_full_screen(self, full: bool) -> None:
        """Fill the screen, or return to the window's former position and size."""
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
        """Set the text of the title bar."""
        glfw.set_window_title(self._window, title)

    def present(self) -> None:
        """Swap the buffers."""
        glfw.swap_buffers(self._window)

    def detach(self) -> None:
        """Disconnect keys and mouse from imgui."""
        imgui.backends.glfw_shutdown()

    def close(self) -> None:
        """Close the window and release its context; a second call does nothing."""
        if self._closed:
            return
        self._closed = True
        with suppress(AttributeError):
            self.context.release()
        glfw.destroy_window(self._window)
        glfw.terminate()


def text_scale(content_scale: float, framebuffer_px: int, window_units: int) -> float:
    """Return the scale of text in the window's units.

    On macOS and Wayland a unit is several pixels, and the content scale includes this factor; on X11 and Windows a unit
    is a pixel.  `content_scale`: of the system; `framebuffer_px`, `window_units`: the window's width.
    """
    return content_scale / (framebuffer_px / window_units) if framebuffer_px and window_units else content_scale


def _text(message: bytes | str | None) -> str:
    return message.decode(errors="replace") if isinstance(message, bytes) else message or "the system does not say why"


def _no_window(code: int, message: str) -> str:
    if code == glfw.VERSION_UNAVAILABLE:
        return (
            f"this display's OpenGL is older than 3.3, which glstar needs: {message}; 'glstar doctor' shows the driver"
        )
    if code == glfw.API_UNAVAILABLE:
        return f"this display draws no OpenGL (X11 without GLX?): {message}. {_ALTERNATIVES}"
    return f"no window: {message}. {_ALTERNATIVES}"
