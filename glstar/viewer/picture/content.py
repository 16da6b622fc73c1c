"""The picture in the image panel, drawn by the display pass of `glstar.render.opengl`.

It is kept in a texture, or drawn straight onto the window while it keeps changing.
"""

from dataclasses import dataclass
from functools import lru_cache
from math import ceil, floor
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from glstar.images import FittedImage
from glstar.render.opengl import Context, Framebuffer, Texture
from glstar.render.opengl.passes.display import ComparisonInput, DisplayPass, Placement, Tone, WindowPart
from glstar.render.scene.scene import Scene
from glstar.viewer.picture.comparison import LESS_RGB, MORE_RGB, ComparisonMode, ComparisonState
from glstar.viewer.picture.simulated import SimulatedImage, why_not_processed
from glstar.viewer.picture.view import ColourMap, ImageView, Stretch

# Constants of display.frag; blinking shows one image or the other.
_SIMULATED, _REAL = 0, 1
_SHADER_MODE = {ComparisonMode.WIPE: 2, ComparisonMode.DIFFERENCE: 3, ComparisonMode.SIDE_BY_SIDE: 4}


@dataclass(frozen=True, slots=True, eq=False)
class PanelContent:
    """The content of the image panel."""

    image: Texture | SimulatedImage  # The developed image; a simulated one is waited for when the picture is drawn
    white_dn: int  # Its largest digital number
    real: FittedImage | None = None  # The real image it is compared with
    comparison: ComparisonMode = ComparisonMode.OFF
    wipe: float = 0.5  # See `glstar.viewer.picture.comparison.compose`
    phase: float = 0.0
    real_black: float = 0.0
    real_gain: float = 1.0
    is_processed: bool = False  # Whether a simulated image is shown as ``[output]`` writes it; not while it is compared

    @classmethod
    def of(
        cls,
        image: Texture | SimulatedImage,
        scene: Scene,
        real: FittedImage | None,
        comparison: ComparisonState,
        *,
        is_processed: bool = False,
    ) -> "PanelContent":
        """Return the content for an image and, if it has been decoded, the real image beside it.

        `image`: the developed image of the scene; `is_processed`: whether to show it as ``[output]`` writes it, if it
        does process it and there is no real image.
        """
        if real is None and comparison.active and comparison.mode is ComparisonMode.SIDE_BY_SIDE:
            # While an image is decoded its half of the picture stays empty, so that the view keeps its zoom.
            real = _blank(scene.camera.width_px, scene.camera.height_px)
        return cls(
            image,
            scene.white_dn,
            real,
            comparison=comparison.mode,
            wipe=comparison.wipe,
            phase=comparison.phase,
            real_black=comparison.real_black,
            real_gain=comparison.real_gain,
            is_processed=is_processed and real is None and not why_not_processed(scene),
        )

    @property
    def is_there(self) -> bool:
        """Whether there is an image still: a panel that is drawn later may have taken the flight away."""
        return not isinstance(self.image, SimulatedImage) or self.image.texture is not None

    @property
    def texture(self) -> Texture:
        """The developed image, after waiting for it."""
        texture = self.image.texture if isinstance(self.image, SimulatedImage) else self.image
        assert texture is not None
        return texture

    @property
    def picture(self) -> Texture | NDArray[np.uint8]:
        """The drawn image: the processed one, red, green and blue, or the developed one."""
        processed = self.image.processed if self.is_processed and isinstance(self.image, SimulatedImage) else None
        return self.texture if processed is None else processed

    @property
    def size_px(self) -> tuple[int, int]:
        """Width and height of the picture, px: twice as wide side by side."""
        width_px, height_px = self.image.size
        beside = self.real is not None and self.comparison is ComparisonMode.SIDE_BY_SIDE
        return (2 * width_px if beside else width_px), height_px

    @property
    def mode(self) -> int:
        """The mode as ``display.frag`` numbers it."""
        if self.real is None or self.comparison is ComparisonMode.OFF:
            return _SIMULATED
        if self.comparison is ComparisonMode.BLINK:
            return _REAL if self.phase % 1.0 >= 0.5 else _SIMULATED
        return _SHADER_MODE[self.comparison]


@dataclass(frozen=True, slots=True, eq=False)
class Picture:
    """A panel's content, where it is in the panel, and how it is stretched."""

    content: PanelContent
    placement: Placement
    tone: Tone

    @classmethod
    def of(
        cls,
        content: PanelContent,
        view: ImageView,
        stretch: Stretch,
        size: tuple[int, int],
        *,
        scale: float,
        night: bool,
    ) -> "Picture":
        """Return the picture as a view shows it at present.

        `size`: width and height of the panel, px; `scale`: pixels to one screen unit of `view`; `night`: whether to
        draw in shades of red.
        """
        size = max(size[0], 1), max(size[1], 1)
        scissor = _covered(view, content.size_px, size, scale)
        placement = Placement(size, view.corner, 1 / (view.zoom * scale), scissor)
        plain = night or stretch.colours is ColourMap.GREY
        tone = Tone(stretch.black, stretch.boost, stretch.softening, None if plain else stretch.colours.colours, night)
        return cls(content, placement, tone)


class Display:
    """Draws the content of the image panel at the panel's resolution, on the current context."""

    def __init__(self, context: Context) -> None:
        self._pass = DisplayPass(context)

    def draw(self, picture: Picture) -> int:
        """Draw the panel and return the OpenGL name of its texture, which is valid until the size changes."""
        content = picture.content
        return self._pass.draw(content.picture, content.white_dn, picture.placement, picture.tone, _compared(content))

    def draw_onto(self, part: WindowPart, picture: Picture) -> None:
        """Draw the panel onto a window instead of its texture: the same pixels."""
        content = picture.content
        placement, tone = picture.placement, picture.tone
        self._pass.draw_onto(part, content.picture, content.white_dn, placement, tone, _compared(content))

    def texture(self, size: tuple[int, int]) -> int:
        """Return the OpenGL name of the panel's texture for a size, before it is drawn.

        `size`: width and height, px.
        """
        return self._pass.texture(size)

    def read(self) -> NDArray[np.uint8]:
        """Read back the last picture, (height, width, 3) uint8: for tests."""
        return self._pass.read()

    def close(self) -> None:
        """Release all OpenGL objects; a second call does nothing."""
        self._pass.close()


def _compared(content: PanelContent) -> ComparisonInput | None:
    real = content.real
    if real is None or content.mode == _SIMULATED:
        return None
    return ComparisonInput(
        pixels=real.pixels,
        white_dn=real.white_dn,
        covered_px=(real.left, real.top, real.right, real.bottom),
        mode=content.mode,
        wipe=content.wipe,
        black=content.real_black,
        gain=content.real_gain,
        more_rgb=MORE_RGB,
        less_rgb=LESS_RGB,
    )


def _covered(
    view: ImageView, picture_px: tuple[int, int], size: tuple[int, int], scale: float
) -> tuple[int, int, int, int]:
    """Return the part of the panel's texture that the picture covers: left, top, width, height, px."""
    (left, top), (right, bottom) = view.edges(*picture_px) * scale
    first = max(floor(left), 0), max(floor(top), 0)
    last = min(ceil(right), size[0]), min(ceil(bottom), size[1])
    return *first, max(last[0] - first[0], 0), max(last[1] - first[1], 0)


@lru_cache(maxsize=1)
def _blank(width_px: int, height_px: int) -> FittedImage:
    """Return a real image that covers no pixel."""
    return FittedImage(np.zeros((height_px, width_px), np.uint8), 0, 0, 0, 0)


_NEVER = ("never drawn",)


class WindowPlace(NamedTuple):
    """Where a panel is in the window, px of its framebuffer from the top-left corner."""

    corner_px: tuple[int, int]  # Its left and top
    clip_px: tuple[int, int, int, int]  # Left, top, right and bottom of what is visible of it


class PanelPicture:
    """Draws the picture of the image panel when the window is painted.

    A picture that stays for more than a frame is drawn into a texture, which imgui puts into the window with
    blending.  One that has changed in two frames running probably changes in the next too: it is drawn straight onto
    the window, under what imgui draws, which saves software OpenGL a copy of the panel.  Both give the same pixels.
    `display`: it stays the caller's.
    """

    def __init__(self, display: Display) -> None:
        self._display = display
        self._picture: Picture | None = None
        # What the picture and the one in the texture depend on.
        self._inputs: tuple[object, ...] = _NEVER
        self._in_texture: tuple[object, ...] = _NEVER
        self._is_changing = False
        # Where the picture of this frame is drawn straight onto the window, and whether it is drawn.
        self._place: WindowPlace | None = None
        self._is_shown = False

    def show(self, picture: Picture, inputs: tuple[object, ...], place: WindowPlace | None) -> int | None:
        """Take the picture of a frame; `paint` draws it.

        `inputs`: all that it depends on; `place`: where the panel is; None if something may lie below it.  Returns the
        OpenGL name of the texture, for imgui to draw; None if `paint` draws onto the window.
        """
        changed = inputs != self._inputs
        self._place = place if changed and self._is_changing else None
        self._is_changing = changed
        self._is_shown = True
        self._picture = picture
        self._inputs = inputs
        return self._display.texture(picture.placement.size) if self._place is None else None

    @property
    def is_new(self) -> bool:
        """Whether `paint` has to draw the picture of this frame."""
        return self._is_shown and (self._place is not None or self._inputs != self._in_texture)

    def paint(self, target: Framebuffer, size: tuple[int, int], colour: tuple[float, float, float]) -> None:
        """Draw the picture of this frame, if there is one, after the window has been cleared and before imgui draws.

        `target`: of the window; `size`: its width and height, px; `colour`: red, green, blue that it has been cleared
        to.
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
            self._display.draw(picture)
