"""What the viewer is shown on: a window, or nothing at all."""

from pathlib import Path
from typing import Protocol

from glstar.render.opengl.objects import Context, Framebuffer

__all__ = ["Surface"]


class Surface(Protocol):
    """A place to draw on, with its events.

    Attributes
    ----------
    context : Context
        Current on the thread that made the surface.
    size : tuple of int
        Width and height, px.
    target : Framebuffer
    scale : float
        Of the screen.
    should_close : bool
    """

    context: Context

    @property
    def scale(self) -> float: ...  # noqa: D102 - told above

    @property
    def size(self) -> tuple[int, int]: ...  # noqa: D102

    @property
    def target(self) -> Framebuffer: ...  # noqa: D102

    @property
    def should_close(self) -> bool: ...  # noqa: D102

    def attach(self) -> None:
        """Connect with the imgui context that is current."""

    def new_frame(self) -> None:
        """Tell imgui size, time, keys and mouse."""

    def wait(self, timeout_s: float) -> bool:
        """Take events, waiting for the first of them; return whether there was one."""
        ...

    def dropped(self) -> list[Path]:
        """Return what has been dropped onto it since the last call."""
        ...

    def set_full_screen(self, full: bool) -> None:
        """Fill the screen, or no longer."""

    def set_title(self, title: str) -> None:
        """Say in its frame what it shows."""

    def present(self) -> None:
        """Show what was drawn."""

    def detach(self) -> None:
        """Part from imgui, before its context is destroyed."""

    def close(self) -> None:
        """Give all of it back; a second call does nothing."""
