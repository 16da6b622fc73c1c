"""The viewer without a display: the same interface on a headless context, for scripts and tests."""

import time
from contextlib import ExitStack
from pathlib import Path

from imgui_bundle import imgui

from glstar.render.opengl.context import headless_context
from glstar.render.opengl.objects import Framebuffer

__all__ = ["HeadlessSurface"]


class HeadlessSurface:
    """A surface that nobody sees.

    Parameters
    ----------
    size : tuple of int
        Width and height, px.
    """

    scale = 1.0
    should_close = False

    def __init__(self, size: tuple[int, int]) -> None:
        self.size = size
        self.context = headless_context()
        self._current = ExitStack()
        self._current.enter_context(self.context)
        self._texture = self.context.texture(size, 4)
        self.target: Framebuffer = self.context.framebuffer([self._texture])
        self._seen_s = time.monotonic()
        self._closed = False

    def attach(self) -> None:
        """Connect with imgui: there is nothing to connect."""

    def new_frame(self) -> None:
        """Tell imgui size and time."""
        io, now_s = imgui.get_io(), time.monotonic()
        io.display_size = imgui.ImVec2(*self.size)
        io.delta_time = max(now_s - self._seen_s, 1e-4)
        self._seen_s = now_s

    def wait(self, timeout_s: float) -> bool:
        """Wait: nothing ever happens."""
        time.sleep(timeout_s)
        return False

    def dropped(self) -> list[Path]:
        """Return what was dropped: nothing."""
        return []

    def set_full_screen(self, full: bool) -> None:
        """There is no screen to fill."""

    def set_title(self, title: str) -> None:
        """There is no frame to say it in."""

    def present(self) -> None:
        """Wait until it is drawn, as a window would."""
        self.context.finish()

    def detach(self) -> None:
        """Part from imgui: there is nothing to part."""

    def close(self) -> None:
        """Give all of it back; a second call does nothing."""
        if self._closed:
            return
        self._closed = True
        self.context.detect_framebuffer(0).use()
        self.target.release()
        self._texture.release()
        self._current.close()
        self.context.release()
