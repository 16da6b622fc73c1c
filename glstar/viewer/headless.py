"""A surface without a display: the same interface on a headless context, for scripts and tests."""

import time
from contextlib import ExitStack
from pathlib import Path

from imgui_bundle import imgui

from glstar.render.opengl.context import headless_context
from glstar.render.opengl.objects import Framebuffer
from glstar.render.opengl.waiting import wait_until_drawn

__all__ = ["HeadlessSurface"]


class HeadlessSurface:
    """A surface that is not displayed.

    Parameters
    ----------
    size : tuple of int
        Width and height, px.
    """

    scale = 1.0
    should_close = False
    native_dialogs = False

    def __init__(self, size: tuple[int, int]) -> None:
        self.size = self.window_size = size
        self.context = headless_context()
        self._current = ExitStack()
        self._current.enter_context(self.context)
        self._texture = self.context.texture(size, 4)
        self.target: Framebuffer = self.context.framebuffer([self._texture])
        self._frame_s = time.monotonic()
        self._closed = False

    def attach(self) -> None:
        """Do nothing: there are no events to connect to imgui."""

    def new_frame(self) -> None:
        """Give imgui the size and the time."""
        io, now_s = imgui.get_io(), time.monotonic()
        io.display_size = imgui.ImVec2(*self.size)
        io.delta_time = max(now_s - self._frame_s, 1e-4)
        self._frame_s = now_s

    def wait(self, timeout_s: float) -> bool:
        """Sleep: there are no events."""
        time.sleep(timeout_s)
        return False

    def dropped(self) -> list[Path]:
        """Return an empty list: nothing can be dropped."""
        return []

    def set_full_screen(self, full: bool) -> None:
        """Do nothing: there is no screen."""

    def set_title(self, title: str) -> None:
        """Do nothing: there is no title bar."""

    def present(self) -> None:
        """Wait until the frame has been drawn."""
        wait_until_drawn(self.context)

    def detach(self) -> None:
        """Do nothing: nothing was attached."""

    def close(self) -> None:
        """Release the context and its objects; a second call does nothing."""
        if self._closed:
            return
        self._closed = True
        self.context.detect_framebuffer(0).use()
        self.target.release()
        self._texture.release()
        self._current.close()
        self.context.release()
