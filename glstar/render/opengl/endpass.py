"""The end pass: pieces of trails that a rolling shutter records in part, one point sprite per star and piece."""

from typing import Any, Final

import moderngl
import numpy as np
from numpy.typing import NDArray

from glstar.render.colourscenes import cell_tints
from glstar.render.endpieces import EndPieces
from glstar.render.opengl.pathpass import drawn_sigma_px, falloff_per_px2, still_peak_dn
from glstar.render.opengl.pointingtexture import TEXELS_PER_TIME, pointing_texels, projection_uniforms
from glstar.render.opengl.program import set_used_uniforms
from glstar.render.opengl.readoutclock import ReadoutClock
from glstar.render.opengl.starsprites import STARS_PER_CALL, StarSprites
from glstar.render.opengl.startextures import StarTextures
from glstar.render.scene import Scene

__all__ = ["EndPass"]

# Pieces per draw call: rows of a texture, of which every driver supports 4096.
_PIECES_PER_CALL: Final = 1024
# Orientations per piece: at its start, its middle and its end.
_TIMES: Final = 3


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
        self._sprites = StarSprites(context, stars, (TEXELS_PER_TIME, _TIMES * _PIECES_PER_CALL), 1)

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
        drawn, tints = scene.draw_list, cell_tints(scene, guard_band_px)
        program, vertices = self._sprites.program(
            "end_pieces.vert",
            "trail_short.frag",
            NARROW=int(scene.sensor.needs_erf),
            MOSAIC=int(tints is not None),
            ROWS=clock.rows,
            COMPONENTS=0,
        )
        _set_uniforms(program, scene, light, guard_band_px, clock)
        chosen = np.column_stack([drawn.index, drawn.truncation_radius_px, drawn.transmission]).astype(np.float32)
        texels = _piece_texels(ends)
        self._sprites.bind(scene.stars)
        for first in range(0, len(ends.begin), _PIECES_PER_CALL):
            pieces = slice(first, first + _PIECES_PER_CALL)
            rows = np.ascontiguousarray(texels[pieces]).reshape(-1, TEXELS_PER_TIME, 4)
            self._sprites.pointing.write(rows, viewport=(0, 0, TEXELS_PER_TIME, len(rows)))
            for begin in range(0, len(drawn), STARS_PER_CALL):
                stars = slice(begin, begin + STARS_PER_CALL)
                of_columns = None if tints is None else tints[drawn.index[stars]]
                passage = None if ends.passage is None else ends.passage[stars, pieces].T
                self._sprites.write_stars(chosen[np.newaxis, stars], of_columns, passage)
                self._sprites.draw(vertices, _sprites(ends, begin, first))
        self._context.enable_only(moderngl.NOTHING)

    def release(self) -> None:
        """Release programs, buffers and textures."""
        self._sprites.release()


def _set_uniforms(
    program: moderngl.Program, scene: Scene, light: moderngl.Framebuffer, guard_band_px: int, clock: ReadoutClock
) -> None:
    sensor, sigma_px = scene.sensor, drawn_sigma_px(scene.sensor)
    uniforms: dict[str, Any] = {
        **projection_uniforms(scene.camera, scene.trails.pointing, guard_band_px),
        "target_px": light.size,
        "falloff_per_px2": falloff_per_px2(sensor),
        "sigma_px": sigma_px,
        "effective_sigma_px": sensor.effective_sigma_px,
        "vmag_0_peak_dn": still_peak_dn(sensor, scene.exposure.duration_s, clock.span),
    }
    set_used_uniforms(program, **uniforms)
    clock.bind(program, sigma_px)


def _piece_texels(ends: EndPieces) -> NDArray[np.float32]:
    """Return the texture of pieces by piece, (n, 3, 5, 4) float32: see end_pieces.vert."""
    texels = pointing_texels(ends.pointing).reshape(-1, _TIMES, TEXELS_PER_TIME, 4)
    texels[:, 0, 0, 3] = ends.begin
    texels[:, 0, 1, 3] = ends.duration
    return texels


def _sprites(ends: EndPieces, first_star: int, first_piece: int) -> NDArray[np.uint16]:
    """Return which stars of a draw call are drawn during which of its pieces, (c, 2), star by star."""
    star, piece = ends.star - first_star, ends.piece - first_piece
    some = (star >= 0) & (star < STARS_PER_CALL) & (piece >= 0) & (piece < _PIECES_PER_CALL)
    # Software OpenGL finds the sprites of a tile near each other in memory.
    return np.stack([star[some], piece[some]], axis=1).astype(np.uint16)
