"""The surface that the viewer draws on: a window, or an offscreen framebuffer."""

from pathlib import Path
from typing import Protocol

from glstar.render.opengl.objects import Context, Framebuffer

__all__ = ["Surface"]


class Surface(Protocol):
    """A framebuffer to draw on, with its events.

    Attributes
    ----------
    context : Context
        Current on the thread that made the surface.
    size : tuple of int
        Width and height, px.
    window_size : tuple of int
        Width and height of the window when it does not fill the screen, screen units.
    target : Framebuffer
    scale : float
        Of the screen.
    native_dialogs : bool
        Whether files are chosen in the system's dialogs.
    should_close : bool
    """

    context: Context

    @property
    def scale(self) -> float: ...  # noqa: D102 - documented above

    @property
    def native_dialogs(self) -> bool: ...  # noqa: D102

    @property
    def size(self) -> tuple[int, int]: ...  # noqa: D102

    @property
    def window_size(self) -> tuple[int, int]: ...  # noqa: D102

    @property
    def target(self) -> Framebuffer: ...  # noqa: D102

    @property
    def should_close(self) -> bool: ...  # noqa: D102

    def attach(self) -> None:
        """Connect the events to the current imgui context."""

    def new_frame(self) -> None:
        """Give imgui size, time, keys and mouse."""

    def wait(self, timeout_s: float) -> bool:
        """Process events, waiting for the first of them; return whether there was one."""
        ...

    def dropped(self) -> list[Path]:
        """Return the files dropped onto it since the last call."""
        ...

    def set_full_screen(self, full: bool) -> None:
        """Fill the screen, or stop filling it."""

    def set_title(self, title: str) -> None:
        """Set the text of the title bar."""

    def present(self) -> None:
        """Show the frame that was drawn."""

    def detach(self) -> None:
        """Disconnect from imgui, before its context is destroyed."""

    def close(self) -> None:
        """Release the context and its objects; a second call does nothing."""
