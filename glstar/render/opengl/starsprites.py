"""Point sprites of stars during parts of their trails: what the passes that draw them have in common."""

from contextlib import ExitStack
from typing import Final

import moderngl
import numpy as np
from numpy.typing import NDArray

from glstar.render.opengl.passagetexture import PassageTexture
from glstar.render.opengl.program import linked, set_used_uniforms
from glstar.render.opengl.startextures import STARS_PER_ROW, StarTextures
from glstar.sky.starfield import StarField

__all__ = ["STARS_PER_CALL", "StarSprites"]

# Stars of one draw call are columns of textures, which every driver supports up to 4096.
STARS_PER_CALL: Final = 4096
_SPRITES_PER_CALL: Final = 1 << 16
# Texture units.
_UNITS: Final = {"pointing": 0, "stars": 1, "chosen": 2, "tints_of_stars": 3, "passage": 4}


class StarSprites:
    """A list of sprites, each a column (star) and a row (part of its trail), the textures they read, and programs.

    Parameters
    ----------
    context : moderngl.Context
    stars : StarTextures
        Not released here.
    pointing_size : tuple of int
        Columns and rows of the texture of orientations.
    chosen_rows : int
        Rows of the texture of what is known of each star of a call.
    """

    def __init__(
        self, context: moderngl.Context, stars: StarTextures, pointing_size: tuple[int, int], chosen_rows: int
    ) -> None:
        self._context = context
        self._stars = stars
        self._programs: dict[tuple[object, ...], tuple[moderngl.Program, moderngl.VertexArray]] = {}
        with ExitStack() as owned:
            self._sprites = context.buffer(reserve=4 * _SPRITES_PER_CALL, dynamic=True)
            owned.callback(self._sprites.release)
            sizes = (*pointing_size, 4), (STARS_PER_CALL, chosen_rows, 3), (STARS_PER_CALL, 1, 4)
            self.pointing, self._chosen, self._tints = textures = [
                context.texture((columns, rows), components, dtype="f4") for columns, rows, components in sizes
            ]
            for texture in textures:
                owned.callback(texture.release)
                texture.filter = moderngl.NEAREST, moderngl.NEAREST
            self._passage = PassageTexture(context)
            owned.callback(self._passage.release)
            owned.callback(self._release_programs)
            self._owned = owned.pop_all()

    def program(
        self, vertices: str, fragments: str, **constants: float
    ) -> tuple[moderngl.Program, moderngl.VertexArray]:
        """Return the program of two shaders, and its vertices: made when it is first needed."""
        key = vertices, fragments, *constants.items()
        if key not in self._programs:
            program = linked(self._context, vertices, fragments, generated={}, STARS_PER_ROW=STARS_PER_ROW, **constants)
            set_used_uniforms(program, **_UNITS)
            self._programs[key] = program, self._context.vertex_array(program, [(self._sprites, "2u2", "sprite")])
        return self._programs[key]

    def bind(self, field: StarField) -> None:
        """Use the textures for the stars of a field, and add what is drawn to the target."""
        textures = self.pointing, self._stars.of(field), self._chosen, self._tints
        for unit, texture in enumerate(textures):
            texture.use(unit)
        self._context.enable_only(moderngl.BLEND | moderngl.PROGRAM_POINT_SIZE)
        self._context.blend_func = moderngl.ONE, moderngl.ONE

    def write_stars(
        self, chosen: NDArray[np.float32], tints: NDArray[np.float32] | None, passage: NDArray[np.float32] | None
    ) -> None:
        """Write what is known of the stars of a call.

        Parameters
        ----------
        chosen : (rows, k, 3) float32
        tints : (k, 4) float32 or None
            Their colours in a mosaic.
        passage : (n, k) float32 or None
            What cloud transmits of them during each part of their trails; None without cloud.
        """
        self._chosen.write(np.ascontiguousarray(chosen), viewport=(0, 0, chosen.shape[1], len(chosen)))
        if tints is not None:
            self._tints.write(tints, viewport=(0, 0, len(tints), 1))
        self._passage.write_table(np.ones((1, 1), np.float32) if passage is None else passage)
        self._passage.texture.use(_UNITS["passage"])

    def draw(self, vertices: moderngl.VertexArray, sprites: NDArray[np.uint16]) -> None:
        """Draw sprites, (c, 2): column and row."""
        for first in range(0, len(sprites), _SPRITES_PER_CALL):
            some = sprites[first : first + _SPRITES_PER_CALL]
            self._sprites.write(np.ascontiguousarray(some))
            vertices.render(moderngl.POINTS, vertices=len(some))

    def _release_programs(self) -> None:
        for program, vertices in self._programs.values():
            vertices.release()
            program.release()

    def release(self) -> None:
        """Release programs, buffers and textures."""
        self._owned.close()
