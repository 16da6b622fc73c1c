"""The picture in the image panel: kept in a texture, or drawn straight onto the window while it keeps changing."""

from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from glstar.render.opengl.displaypass import WindowPart
from glstar.render.opengl.objects import Framebuffer
from glstar.viewer.display import Display, Picture

__all__ = ["PanelPicture", "WindowPlace"]

_NEVER: Final = ("never drawn",)


class WindowPlace(NamedTuple):
    """Where a panel is in the window, px of its framebuffer from the top-left corner.

    Attributes
    ----------
    corner_px : tuple of int
        Its left and top.
    clip_px : tuple of int
        Left, top, right and bottom of what is visible of it.
    """

    corner_px: tuple[int, int]
    clip_px: tuple[int, int, int, int]


class PanelPicture:
    """Draws the picture of the image panel when the window is painted.

    A picture that stays for more than a frame is drawn into a texture, which imgui puts into the window with blending.
    One that has changed in two frames running probably changes in the next too: it is drawn straight onto the window,
    under what imgui draws, which saves software OpenGL a copy of the panel.  Both give the same pixels.

    Parameters
    ----------
    display : Display
        It stays the caller's.
    """

    def __init__(self, display: Display) -> None:
        self._display = display
        self._picture: Picture | None = None
        # What the picture and the one in the texture depend on.
        self._inputs: tuple[object, ...] = _NEVER
        self._in_texture: tuple[object, ...] = _NEVER
        self._is_changing = False
        # Of the frame that is built: where the picture is drawn straight onto the window, and whether it is drawn.
        self._place: WindowPlace | None = None
        self._is_shown = False

    def show(self, picture: Picture, inputs: tuple[object, ...], place: WindowPlace | None) -> int | None:
        """Take the picture of a frame; `paint` draws it.

        Parameters
        ----------
        picture : Picture
        inputs : tuple
            All that it depends on.
        place : WindowPlace or None
            Where the panel is; None if something may lie below it.

        Returns
        -------
        int or None
            The OpenGL name of the texture, for imgui to draw; None if `paint` draws onto the window.
        """
        changed = inputs != self._inputs
        self._place = place if changed and self._is_changing else None
        self._is_changing, self._is_shown = changed, True
        self._picture, self._inputs = picture, inputs
        return self._display.texture(picture.placement.size) if self._place is None else None

    def paint(self, target: Framebuffer, size: tuple[int, int], colour: tuple[float, float, float]) -> None:
        """Draw the picture of this frame, if there is one, after the window has been cleared and before imgui draws.

        Parameters
        ----------
        target : Framebuffer
            Of the window.
        size : tuple of int
            Its width and height, px.
        colour : tuple of float
            Red, green, blue that it has been cleared to.
        """
        if not self._is_shown or self._picture is None:
            return
        self._is_shown = False
        if not self._picture.content.is_there:
            return
        if self._place is None:
            self._draw_texture(self._picture)
        else:
            self._display.draw_onto(
                WindowPart(target, size, self._place.corner_px, self._place.clip_px, colour), self._picture
            )

    def read(self) -> NDArray[np.uint8]:
        """Return the picture of the panel without overlays, (height, width, 3) uint8."""
        if self._picture is not None:
            self._draw_texture(self._picture)
        return self._display.read()

    def _draw_texture(self, picture: Picture) -> None:
        if self._inputs != self._in_texture:
            self._in_texture = self._inputs
            self._display.draw_picture(picture)
