"""The piece pass: trails as Gaussians with the moments of the stars' motion, four per point sprite."""

from typing import Final

import moderngl
import numpy as np
from numpy.typing import NDArray

from glstar.render.colourscenes import cell_tints
from glstar.render.opengl.pointingtexture import TEXELS_PER_TIME, pointing_texels, projection_uniforms
from glstar.render.opengl.program import set_uniforms
from glstar.render.opengl.readoutclock import GLOBAL_SHUTTER, ReadoutClock
from glstar.render.opengl.starsprites import STARS_PER_CALL, StarSprites
from glstar.render.opengl.startextures import StarTextures
from glstar.render.scene import Scene
from glstar.render.trailpieces import PIECES_PER_SPRITE, ScenePart, TrailPieces
from glstar.sky.horizon import MAX_REFRACTION_RAD

__all__ = ["PiecePass"]

# Texels per piece: those of its mean orientation, and two of its covariance and duration.
_TEXELS: Final = TEXELS_PER_TIME + 2
# Pieces per draw call: rows of a texture, which every driver supports up to 4096.
_PIECES_PER_CALL: Final = 4096


class PiecePass:
    """Adds the flux of `TrailPieces` to a target.

    Parameters
    ----------
    context : moderngl.Context
    stars : StarTextures
        Not released here.

    Raises
    ------
    ShaderError
        If the driver rejects a shader.
    """

    def __init__(self, context: moderngl.Context, stars: StarTextures) -> None:
        self._context = context
        self._sprites = StarSprites(context, stars, (_TEXELS, _PIECES_PER_CALL), 2)
        try:
            self._program(mosaic=False, rolling=False)
        except BaseException:
            self.release()
            raise

    def draw(
        self, part: ScenePart, light: moderngl.Framebuffer, guard_band_px: int, clock: ReadoutClock = GLOBAL_SHUTTER
    ) -> None:
        """Add the flux of a scene's stars to a target.

        Parameters
        ----------
        part : ScenePart
            Behind cloud with the passage of each piece.
        light : moderngl.Framebuffer
            32-bit float; in use afterwards.
        guard_band_px : int
            Width of its border around the image.
        clock : ReadoutClock
            When the pixels of the target open.
        """
        scene, drawn = part.scene, part.scene.draw_list
        tints = cell_tints(scene, guard_band_px)
        program, vertices = self._program(mosaic=tints is not None, rolling=part.drawn is not None)
        self._set_uniforms(program, scene, light, guard_band_px, clock.span)
        texels, chosen = _piece_texels(part.pieces), _texels_of_stars(part)
        light.use()
        self._sprites.bind(scene.stars)
        for first in range(0, len(texels), _PIECES_PER_CALL):
            of_call = slice(first, first + _PIECES_PER_CALL)
            rows = texels[of_call]
            self._sprites.pointing.write(rows, viewport=(0, 0, _TEXELS, len(rows)))
            if "first_piece" in program:
                set_uniforms(program, first_piece=first)
            for begin in range(0, len(drawn), STARS_PER_CALL):
                stars = slice(begin, begin + STARS_PER_CALL)
                of_columns = None if tints is None else tints[drawn.index[stars]]
                passage = None if drawn.passage is None else drawn.passage[stars, of_call].T
                self._sprites.write_stars(chosen[:, stars], of_columns, passage)
                near = _near_image(part, of_call, stars)
                # Star by star: software OpenGL then finds the sprites of a tile near each other in memory.
                self._sprites.draw(vertices, np.argwhere(near.T).astype(np.uint16))
        self._context.enable_only(moderngl.NOTHING)

    def _set_uniforms(
        self, program: moderngl.Program, scene: Scene, light: moderngl.Framebuffer, guard_band_px: int, span: float
    ) -> None:
        sensor, pointing = scene.sensor, scene.trails.pointing
        set_uniforms(
            program,
            **projection_uniforms(scene.camera, pointing, guard_band_px),
            sine_horizon=pointing.sine_horizon,
            target_px=light.size,
            sigma_px=sensor.effective_sigma_px,
            vmag_0_peak_dn=sensor.effective_peak * float(sensor.peak_dn(0.0, scene.exposure.duration_s)) * span,
        )

    def _program(self, *, mosaic: bool, rolling: bool) -> tuple[moderngl.Program, moderngl.VertexArray]:
        return self._sprites.program(
            "trail_pieces.vert",
            "trail_pieces.frag",
            PIECES_PER_SPRITE=PIECES_PER_SPRITE,
            MOSAIC=int(mosaic),
            ROWS=int(rolling),
        )

    def release(self) -> None:
        """Release programs, buffers and textures."""
        self._sprites.release()


def _piece_texels(pieces: TrailPieces) -> NDArray[np.float32]:
    """Return the texture of pieces, (n rounded up to fours, 7, 4) float32; those that are none last for no time."""
    orientations = pointing_texels(pieces.pointing, multiple=PIECES_PER_SPRITE)
    texels = np.zeros((len(orientations), _TEXELS, 4), np.float32)
    texels[:, :TEXELS_PER_TIME] = orientations
    covariance = pieces.covariance_rad2
    texels[: len(pieces), TEXELS_PER_TIME, :3] = covariance[:, 0]
    texels[: len(pieces), TEXELS_PER_TIME, 3] = pieces.time_fraction
    texels[: len(pieces), TEXELS_PER_TIME + 1, :2] = covariance[:, 1, 1:]
    texels[: len(pieces), TEXELS_PER_TIME + 1, 2] = covariance[:, 2, 2]
    return texels


def _texels_of_stars(part: ScenePart) -> NDArray[np.float32]:
    """Return what trail_pieces.vert reads of each star, (2, k, 3): see its uniform `chosen`."""
    drawn = part.scene.draw_list
    texels = np.zeros((2, len(drawn), 3), np.float32)
    texels[0] = np.column_stack([drawn.index, drawn.truncation_radius_px, drawn.transmission])
    if part.drawn is not None:
        texels[1, :, :2] = part.drawn.T
    return texels


def _near_image(part: ScenePart, rows: slice, stars: slice) -> NDArray[np.bool_]:
    """Return which four pieces of which visible stars are near the image and drawn, (sprites, k): a bound."""
    scene, pieces, camera = part.scene, part.pieces, part.scene.camera
    boresight = pieces.pointing.boresight_eq[rows]
    boresight = boresight / np.linalg.norm(boresight, axis=1, keepdims=True)
    firsts = boresight[::PIECES_PER_SPRITE]
    turn = firsts.repeat(PIECES_PER_SPRITE, axis=0)[: len(boresight)] - boresight
    swing_rad = 2 * np.arcsin(min(1.0, float(np.sqrt((turn * turn).sum(axis=1).max())) / 2))
    margin_rad = np.arctan(3 * scene.draw_list.truncation_radius_px.max() / min(camera.fx_px, camera.fy_px))
    radius_rad = camera.field_radius_rad + margin_rad + swing_rad + MAX_REFRACTION_RAD
    cosine = firsts @ scene.stars.direction_eq[scene.draw_list.index[stars]].T
    near: NDArray[np.bool_] = cosine > np.cos(min(radius_rad, np.pi))
    if part.drawn is not None:
        piece = rows.start + PIECES_PER_SPRITE * np.arange(len(near))[:, np.newaxis]
        near &= (piece + PIECES_PER_SPRITE > part.drawn[0, stars]) & (piece < part.drawn[1, stars])
    return near
