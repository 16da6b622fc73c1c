"""The end pass: pieces of trails that a rolling shutter records in part, one point sprite per star and piece."""

from contextlib import ExitStack
from typing import Any, Final

import moderngl
import numpy as np
from numpy.typing import NDArray

from glstar.render.colourscenes import cell_tints
from glstar.render.endpieces import EndPieces
from glstar.render.opengl.passagetexture import PassageTexture
from glstar.render.opengl.pathpass import drawn_sigma_px
from glstar.render.opengl.pointingtexture import TEXELS_PER_TIME, pointing_texels, projection_uniforms
from glstar.render.opengl.program import linked, set_used_uniforms
from glstar.render.opengl.readoutclock import ReadoutClock
from glstar.render.opengl.startextures import STARS_PER_ROW, StarTextures
from glstar.render.scene import Scene

__all__ = ["EndPass"]

# Limits of one draw call: columns and rows of textures, which every driver supports up to 4096.
_STARS_PER_CALL: Final = 4096
_PIECES_PER_CALL: Final = 1024
_SPRITES_PER_CALL: Final = 1 << 15
# Orientations per piece: at its start, its middle and its end.
_TIMES: Final = 3
# Texture units.
_UNITS: Final = {"pointing": 0, "stars": 1, "chosen": 2, "tints_of_stars": 3, "passage": 4}


class EndPass:
    """Adds the flux of `EndPieces` to a target.

    Parameters
    ----------
    context : moderngl.Context
    stars : StarTextures
        Not released here.
    """

    def __init__(self, context: moderngl.Context, stars: StarTextures) -> None:
        self._context = context
        self._stars = stars
        # By NARROW of pixel_kernel.glsl, MOSAIC and ROWS: made when they are first needed.
        self._programs: dict[tuple[bool, bool, int], tuple[moderngl.Program, moderngl.VertexArray]] = {}
        with ExitStack() as owned:
            self._sprites = context.buffer(reserve=4 * _SPRITES_PER_CALL, dynamic=True)
            owned.callback(self._sprites.release)
            sizes = (TEXELS_PER_TIME, _TIMES * _PIECES_PER_CALL, 4), (_STARS_PER_CALL, 1, 3), (_STARS_PER_CALL, 1, 4)
            self._pointing, self._chosen, self._tints = textures = [
                context.texture((columns, rows), components, dtype="f4") for columns, rows, components in sizes
            ]
            for texture in textures:
                owned.callback(texture.release)
                texture.filter = moderngl.NEAREST, moderngl.NEAREST
            self._passage = PassageTexture(context)
            owned.callback(self._passage.release)
            owned.callback(self._release_programs)
            self._owned = owned.pop_all()

    def draw(
        self, scene: Scene, ends: EndPieces, light: moderngl.Framebuffer, guard_band_px: int, clock: ReadoutClock
    ) -> None:
        """Add the flux of a scene's stars during some pieces to a target.

        Parameters
        ----------
        scene : Scene
        ends : EndPieces
            Of its draw list.
        light : moderngl.Framebuffer
            32-bit float, in use.
        guard_band_px : int
            Width of its border around the image.
        clock : ReadoutClock
            When the pixels of the target open, of a rolling shutter.
        """
        sensor, drawn = scene.sensor, scene.draw_list
        tints = cell_tints(scene, guard_band_px)
        program, vertices = self._program(sensor.needs_erf, tints is not None, clock.rows)
        self._set_uniforms(program, scene, light, guard_band_px, clock)
        chosen = np.column_stack([drawn.index, drawn.truncation_radius_px, drawn.transmission]).astype(np.float32)
        texels = _piece_texels(ends)
        for name, texture in (
            ("pointing", self._pointing),
            ("stars", self._stars.of(scene.stars)),
            ("chosen", self._chosen),
            ("tints_of_stars", self._tints),
        ):
            texture.use(_UNITS[name])
        self._context.enable_only(moderngl.BLEND | moderngl.PROGRAM_POINT_SIZE)
        self._context.blend_func = moderngl.ONE, moderngl.ONE
        for first in range(0, len(ends.begin), _PIECES_PER_CALL):
            pieces = slice(first, first + _PIECES_PER_CALL)
            rows = np.ascontiguousarray(texels[pieces]).reshape(-1, TEXELS_PER_TIME, 4)
            self._pointing.write(rows, viewport=(0, 0, TEXELS_PER_TIME, len(rows)))
            for begin in range(0, len(drawn), _STARS_PER_CALL):
                stars = slice(begin, begin + _STARS_PER_CALL)
                of_stars = np.ascontiguousarray(chosen[stars])
                self._chosen.write(of_stars, viewport=(0, 0, len(of_stars), 1))
                if tints is not None:
                    of_columns = tints[drawn.index[stars]]
                    self._tints.write(of_columns, viewport=(0, 0, len(of_columns), 1))
                passage = np.ones((1, 1), np.float32) if ends.passage is None else ends.passage[stars, pieces].T
                self._passage.write_table(passage)
                self._passage.texture.use(_UNITS["passage"])
                self._draw(vertices, _sprites(ends, begin, first))
        self._context.enable_only(moderngl.NOTHING)

    def _draw(self, vertices: moderngl.VertexArray, sprites: NDArray[np.uint16]) -> None:
        for first in range(0, len(sprites), _SPRITES_PER_CALL):
            some = sprites[first : first + _SPRITES_PER_CALL]
            self._sprites.write(np.ascontiguousarray(some))
            vertices.render(moderngl.POINTS, vertices=len(some))

    def _set_uniforms(
        self,
        program: moderngl.Program,
        scene: Scene,
        light: moderngl.Framebuffer,
        guard_band_px: int,
        clock: ReadoutClock,
    ) -> None:
        sensor, sigma_px = scene.sensor, drawn_sigma_px(scene.sensor)
        peak = (sensor.psf_sigma_px / sigma_px) ** 2
        uniforms: dict[str, Any] = {
            **projection_uniforms(scene.camera, scene.trails.pointing, guard_band_px),
            "target_px": light.size,
            "falloff_per_px2": 1 / (2 * np.log(2) * sigma_px**2),
            "sigma_px": sigma_px,
            "effective_sigma_px": sensor.effective_sigma_px,
            "vmag_0_peak_dn": peak * float(sensor.peak_dn(0.0, scene.exposure.duration_s)) * clock.span,
        }
        set_used_uniforms(program, **uniforms)
        clock.bind(program, sigma_px)

    def _program(self, narrow: bool, mosaic: bool, rows: int) -> tuple[moderngl.Program, moderngl.VertexArray]:
        key = narrow, mosaic, rows
        if key not in self._programs:
            program = linked(
                self._context,
                "end_pieces.vert",
                "trail_short.frag",
                STARS_PER_ROW=STARS_PER_ROW,
                NARROW=int(narrow),
                MOSAIC=int(mosaic),
                ROWS=rows,
                COMPONENTS=0,
            )
            set_used_uniforms(program, **_UNITS)
            vertices = self._context.vertex_array(program, [(self._sprites, "2u2", "sprite")])
            self._programs[key] = program, vertices
        return self._programs[key]

    def _release_programs(self) -> None:
        for program, vertices in self._programs.values():
            vertices.release()
            program.release()

    def release(self) -> None:
        """Release programs, buffers and textures."""
        self._owned.close()


def _piece_texels(ends: EndPieces) -> NDArray[np.float32]:
    """Return the texture of pieces by piece, (n, 3, 5, 4) float32: see end_pieces.vert."""
    texels = pointing_texels(ends.pointing).reshape(-1, _TIMES, TEXELS_PER_TIME, 4)
    texels[:, 0, 0, 3] = ends.begin
    texels[:, 0, 1, 3] = ends.duration
    return texels


def _sprites(ends: EndPieces, first_star: int, first_piece: int) -> NDArray[np.uint16]:
    """Return which stars of a draw call are drawn during which of its pieces, (c, 2), star by star."""
    star, piece = ends.star - first_star, ends.piece - first_piece
    some = (star >= 0) & (star < _STARS_PER_CALL) & (piece >= 0) & (piece < _PIECES_PER_CALL)
    # Software OpenGL finds the sprites of a tile near each other in memory.
    return np.stack([star[some], piece[some]], axis=1).astype(np.uint16)
