"""Draws to one target that wait until the textures they read are filled."""

from collections.abc import Callable

import moderngl

__all__ = ["DrawQueue"]


class DrawQueue:
    """Draws to one target, in the order in which they were added.

    Software OpenGL finishes what was drawn to a target whenever another is bound.  In an image of 12 megapixels each
    time takes 2 ms and more.  What is drawn to other targets first does not interrupt it.

    Parameters
    ----------
    light : moderngl.Framebuffer
        The target.  It is cleared first.
    """

    def __init__(self, light: moderngl.Framebuffer) -> None:
        self.light = light
        self._waiting: list[Callable[[], None]] = [light.clear]

    def __len__(self) -> int:
        """Return how many draws wait."""
        return len(self._waiting)

    def add(self, draw: Callable[[], None]) -> None:
        """Let a draw wait.

        Parameters
        ----------
        draw : callable
            Called when the target is bound.
        """
        self._waiting.append(draw)

    def run(self) -> None:
        """Bind the target and draw what waits."""
        self.light.use()
        while self._waiting:
            self._waiting.pop(0)()
