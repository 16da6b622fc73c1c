"""The image panel's pass: from the developed texture to what the screen shows, nothing read back."""

from dataclasses import dataclass
from math import ceil, floor
from typing import Any

import moderngl
import numpy as np
from numpy.typing import NDArray

from glstar.images import FittedImage
from glstar.render.opengl.program import linked, set_uniforms
from glstar.viewer.comparisonview import LESS_RGB, MORE_RGB, Comparison
from glstar.viewer.imageview import ImageView
from glstar.viewer.stretch import Stretch

__all__ = ["Display", "Shown"]


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
        See `glstar.viewer.comparisonview.compose`.
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
        # One for each way of looking, made when somebody looks so.
        self._programs: dict[tuple[int, bool], tuple[moderngl.Program, moderngl.VertexArray]] = {}
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
        size = max(size[0], 1), max(size[1], 1)
        target, texture = self._target_of(size)
        real = shown.real if shown.mode else None
        px_a_pixel = 1 / (view.zoom * scale)
        program, panel = self._program_for(shrinks=int(px_a_pixel > 1) + int(px_a_pixel > 2), compares=real is not None)
        set_uniforms(
            program,
            simulated=0,
            corner_px=view.corner,
            px_a_pixel=px_a_pixel,
            simulated_white_dn=float(shown.white_dn),
            black=stretch.black,
            boost=stretch.boost,
            softening=stretch.softening,
            night=int(night),
        )
        if real is not None:
            set_uniforms(
                program,
                real=1,
                comparison=shown.mode,
                wipe=shown.wipe,
                covered_px=(real.left, real.top, real.right, real.bottom),
                real_white_dn=float(real.white_dn),
                real_black=shown.real_black,
                real_gain=shown.real_gain,
                more_rgb=MORE_RGB,
                less_rgb=LESS_RGB,
            )
            self._uploaded(real).use(location=1)
        shown.image.use(location=0)
        self._context.enable_only(moderngl.NOTHING)
        target.use()
        # Only where the picture is: around it there is nothing to compute.
        self._context.scissor = _covered(view, shown.size_px, size, scale)
        panel.render(moderngl.TRIANGLES, vertices=3)
        self._context.scissor = None
        self._screen.use()
        return texture.glo

    def read(self) -> NDArray[np.uint8]:
        """Return what was drawn last, (height, width, 3) uint8: for tests, and for nothing on the way to the screen."""
        assert self._target is not None
        width, height = self._target.size
        return np.frombuffer(self._target.read(components=3), np.uint8).reshape(height, width, 3)

    def _program_for(self, *, shrinks: int, compares: bool) -> tuple[moderngl.Program, moderngl.VertexArray]:
        key = shrinks, compares
        if key not in self._programs:
            made = linked(self._context, "develop.vert", "display.frag", SHRINKS=shrinks, COMPARES=int(compares))
            self._programs[key] = made, self._context.vertex_array(made, [])
        return self._programs[key]

    def _target_of(self, size: tuple[int, int]) -> tuple[moderngl.Framebuffer, moderngl.Texture]:
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
        for program, panel in self._programs.values():
            panel.release()
            program.release()
        self._programs.clear()


def _covered(
    view: ImageView, picture_px: tuple[int, int], size: tuple[int, int], scale: float
) -> tuple[int, int, int, int]:
    """Return the part of the panel's texture where the picture is: left, top, width, height, px."""
    width_px, height_px = picture_px
    (left, top), (right, bottom) = view.to_screen([[-0.5, -0.5], [width_px - 0.5, height_px - 0.5]]) * scale
    first = max(floor(left), 0), max(floor(top), 0)
    last = min(ceil(right), size[0]), min(ceil(bottom), size[1])
    return *first, max(last[0] - first[0], 0), max(last[1] - first[1], 0)
