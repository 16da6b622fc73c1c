"""The image panel's pass: from the developed texture to what the screen shows, nothing read back."""

from dataclasses import dataclass
from typing import Any

import moderngl
import numpy as np
from numpy.typing import NDArray

from glstar.gl.program import linked, set_uniforms
from glstar.viewer.comparison import LESS_RGB, MORE_RGB, Comparison
from glstar.viewer.imageview import ImageView
from glstar.viewer.realimages import FittedImage
from glstar.viewer.stretch import Stretch, StretchKind

__all__ = ["Display", "Shown", "Stretch", "StretchKind"]


@dataclass(frozen=True, slots=True, eq=False)
class Shown:
    """What the panel shows.

    Attributes
    ----------
    image : moderngl.Texture
        The developed image.
    white_dn : int
        Its largest digital number.
    real : FittedImage or None
        The real image beside it.
    comparison : Comparison
    wipe, phase, real_black, real_gain : float
        See `glstar.viewer.comparison.compose`.
    """

    image: moderngl.Texture
    white_dn: int
    real: FittedImage | None = None
    comparison: Comparison = Comparison.OFF
    wipe: float = 0.5
    phase: float = 0.0
    real_black: float = 0.0
    real_gain: float = 1.0

    @property
    def size_px(self) -> tuple[int, int]:
        """Width and height of the picture, px: twice as wide side by side."""
        width_px, height_px = self.image.size
        beside = self.real is not None and self.comparison is Comparison.SIDE_BY_SIDE
        return (2 * width_px if beside else width_px), height_px

    @property
    def mode(self) -> int:
        """What display.frag calls the comparison."""
        if self.real is None or self.comparison is Comparison.OFF:
            return 0
        if self.comparison is Comparison.BLINK:
            return int(self.phase % 1.0 >= 0.5)
        return {Comparison.WIPE: 2, Comparison.DIFFERENCE: 3, Comparison.SIDE_BY_SIDE: 4}[self.comparison]


class Display:
    """Draws the picture at the panel's own resolution, on the context that is current.

    Parameters
    ----------
    context : moderngl.Context
    """

    def __init__(self, context: moderngl.Context) -> None:
        self._context = context
        self._screen = context.detect_framebuffer(0)
        self._program = linked(context, "develop.vert", "display.frag")
        self._panel = context.vertex_array(self._program, [])
        self._target: moderngl.Framebuffer | None = None
        self._texture: moderngl.Texture | None = None
        self._real: moderngl.Texture | None = None
        self._real_of: FittedImage | None = None

    def draw(
        self, shown: Shown, view: ImageView, stretch: Stretch, size: tuple[int, int], *, scale: float, night: bool
    ) -> int:
        """Draw the panel and return its texture's OpenGL number, for as long as the size stays the same.

        Parameters
        ----------
        shown : Shown
        view : ImageView
        stretch : Stretch
        size : tuple of int
            Width and height of the panel, px.
        scale : float
            Pixels to one unit of the screen in which `view` is told.
        night : bool
            Red on black.

        Returns
        -------
        int
        """
        target, texture = self._target_of(size)
        real = shown.real if shown.mode else None
        left, top, right, bottom = (real.left, real.top, real.right, real.bottom) if real else (0, 0, 0, 0)
        set_uniforms(
            self._program,
            simulated=0,
            real=1,
            corner_px=view.corner,
            px_a_pixel=1 / (view.zoom * scale),
            comparison=shown.mode,
            wipe=shown.wipe,
            covered_px=(left, top, right, bottom),
            simulated_white_dn=float(shown.white_dn),
            real_white_dn=float(real.white_dn if real else 255),
            real_black=shown.real_black,
            real_gain=shown.real_gain,
            black=stretch.black,
            boost=stretch.boost,
            softening=stretch.softening,
            night=int(night),
            more_rgb=MORE_RGB,
            less_rgb=LESS_RGB,
        )
        shown.image.use(location=0)
        (shown.image if real is None else self._uploaded(real)).use(location=1)
        self._context.enable_only(moderngl.NOTHING)
        target.use()
        self._panel.render(moderngl.TRIANGLES, vertices=3)
        self._screen.use()
        return texture.glo

    def read(self) -> NDArray[np.uint8]:
        """Return what was drawn last, (height, width, 3) uint8: for tests, and for nothing on the way to the screen."""
        assert self._target is not None
        width, height = self._target.size
        return np.frombuffer(self._target.read(components=3), np.uint8).reshape(height, width, 3)

    def _target_of(self, size: tuple[int, int]) -> tuple[moderngl.Framebuffer, moderngl.Texture]:
        size = max(size[0], 1), max(size[1], 1)
        if self._target is None or self._texture is None or self._texture.size != size:
            self._release_target()
            self._texture = self._context.texture(size, 4)
            self._texture.filter = moderngl.NEAREST, moderngl.NEAREST
            self._target = self._context.framebuffer([self._texture])
        return self._target, self._texture

    def _uploaded(self, real: FittedImage) -> moderngl.Texture:
        pixels: NDArray[Any] = np.ascontiguousarray(real.pixels)
        size, dtype = (pixels.shape[1], pixels.shape[0]), f"u{pixels.itemsize}"
        if self._real is None or self._real.size != size or self._real.dtype != dtype:
            self._release_real()
            self._real = self._context.texture(size, 1, dtype=dtype, alignment=1)
            self._real.filter = moderngl.NEAREST, moderngl.NEAREST
        if self._real_of is not real:
            self._real.write(pixels, alignment=1)
            self._real_of = real
        return self._real

    def _release_target(self) -> None:
        if self._target is not None and self._texture is not None:
            self._target.release()
            self._texture.release()
        self._target = self._texture = None

    def _release_real(self) -> None:
        if self._real is not None:
            self._real.release()
        self._real = self._real_of = None

    def close(self) -> None:
        """Give back all that it holds; a second call does nothing."""
        self._release_target()
        self._release_real()
        self._panel.release()
        self._program.release()
