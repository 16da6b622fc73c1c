"""The piece pass: trails as Gaussians with the moments of the stars' motion, four per point sprite.

The end pass: pieces of trails that a rolling shutter records in part, one point sprite per star and piece.

Point sprites of stars during parts of their trails: what the passes that draw them have in common.
"""

from contextlib import ExitStack
from typing import Any

import moderngl
import numpy as np
from numpy.typing import NDArray

from glstar.render.motion.starpaths import view_radius_rad
from glstar.render.motion.trailmodels import TrailPieces
from glstar.render.opengl import textures
from glstar.render.opengl.passes.path import drawn_sigma_px, falloff_per_px2, still_peak_dn
from glstar.render.opengl.program import linked, set_uniforms, set_used_uniforms
from glstar.render.opengl.textures import TEXELS_PER_TIME, RecentFields, StarTarget
from glstar.render.readout.openings import EndPieces
from glstar.render.readout.pieces import PIECES_PER_SPRITE, ScenePart
from glstar.render.scene.scene import Scene
from glstar.render.scene.starcomponents import cell_tints
from glstar.sky.air.refraction import MAX_REFRACTION_RAD
from glstar.sky.catalogue.starfield import StarField

# Stars of one draw call are columns of textures, which every driver supports up to 4096.
STARS_PER_CALL = 4096
_SPRITES_PER_CALL = 1 << 16
# Texture units.
_UNITS = {"pointing": 0, "stars": 1, "chosen": 2, "tints_of_stars": 3, "passage": 4}


class StarSprites:
    """A list of sprites, each a column (star) and a row (part of its trail), the textures they read, and programs.

    `pointing_size` is columns and rows of the texture of orientations, and `chosen_rows` rows of the texture with the
    properties of the stars of a call.  `stars` are not released here.
    """

    def __init__(
        self,
        context: moderngl.Context,
        stars: RecentFields[moderngl.Texture],
        pointing_size: tuple[int, int],
        chosen_rows: int,
    ) -> None:
        self._context = context
        self._stars = stars
        self._programs: dict[tuple[object, ...], tuple[moderngl.Program, moderngl.VertexArray]] = {}
        with ExitStack() as owned:
            self._sprites = context.buffer(reserve=4 * _SPRITES_PER_CALL, dynamic=True)
            owned.callback(self._sprites.release)
            sizes = (*pointing_size, 4), (STARS_PER_CALL, chosen_rows, 3), (STARS_PER_CALL, 1, 4)
            self.pointing, self._chosen, self._tints = owned_textures = [
                context.texture((columns, rows), components, dtype="f4") for columns, rows, components in sizes
            ]
            for texture in owned_textures:
                owned.callback(texture.release)
                texture.filter = moderngl.NEAREST, moderngl.NEAREST
            self._passage = textures.PassageTexture(context)
            owned.callback(self._passage.release)
            owned.callback(self._release_programs)
            self._owned = owned.pop_all()

    def program(
        self, vertices: str, fragments: str, **constants: float
    ) -> tuple[moderngl.Program, moderngl.VertexArray]:
        """Return the program of two shaders and its vertices, created when it is first needed."""
        key = vertices, fragments, *constants.items()
        if key not in self._programs:
            program = linked(
                self._context, vertices, fragments, generated={}, STARS_PER_ROW=textures.STARS_PER_ROW, **constants
            )
            set_used_uniforms(program, **_UNITS)
            self._programs[key] = program, self._context.vertex_array(program, [(self._sprites, "2u2", "sprite")])
        return self._programs[key]

    def bind(self, field: StarField) -> None:
        """Use the textures for the stars of a field, and add what is drawn to the target."""
        for unit, texture in enumerate((self.pointing, self._stars.of(field), self._chosen, self._tints)):
            texture.use(unit)
        self._context.enable_only(moderngl.BLEND | moderngl.PROGRAM_POINT_SIZE)
        self._context.blend_func = moderngl.ONE, moderngl.ONE

    def write_stars(
        self, chosen: NDArray[np.float32], tints: NDArray[np.float32] | None, passage: NDArray[np.float32] | None
    ) -> None:
        """Write the properties of the k stars of a call, (rows, k, 3) float32.

        `tints` (k, 4) float32 are their colours in a mosaic; `passage` (n, k) float32 is the transmission of cloud
        during each part of their trails.  Both are None without it.
        """
        self._chosen.write(np.ascontiguousarray(chosen), viewport=(0, 0, chosen.shape[1], len(chosen)))
        if tints is not None:
            self._tints.write(tints, viewport=(0, 0, len(tints), 1))
        self._passage.write_table(np.ones((1, 1), np.float32) if passage is None else passage)
        self._passage.texture.use(_UNITS["passage"])

    def draw(self, vertices: moderngl.VertexArray, sprites: NDArray[np.uint16]) -> None:
        """Draw sprites, (c, 2): column and row."""
        for first in range(0, len(sprites), _SPRITES_PER_CALL):
            of_call = sprites[first : first + _SPRITES_PER_CALL]
            self._sprites.write(np.ascontiguousarray(of_call))
            vertices.render(moderngl.POINTS, vertices=len(of_call))

    def _release_programs(self) -> None:
        for program, vertices in self._programs.values():
            vertices.release()
            program.release()

    def release(self) -> None:
        """Release programs, buffers and textures."""
        self._owned.close()


# Texels per piece: those of its mean orientation, and two of its covariance and duration.
_TEXELS = TEXELS_PER_TIME + 2
# Pieces per draw call: rows of a texture, which every driver supports up to 4096.
_PIECES_PER_CALL = 4096


class PiecePass:
    """Adds the flux of `TrailPieces` to a target; raises ShaderError if the driver rejects a shader."""

    def __init__(self, context: moderngl.Context, stars: RecentFields[moderngl.Texture]) -> None:
        self._context = context
        self._sprites = StarSprites(context, stars, (_TEXELS, _PIECES_PER_CALL), 2)
        try:
            self._program(0, narrow=False, mosaic=False, rolling=False)
        except BaseException:
            self.release()
            raise

    def draw(self, part: ScenePart, target: StarTarget) -> None:
        """Add the flux of a scene's stars to a target, which is in use afterwards; cloud has a passage per piece."""
        scene = part.scene
        drawn = scene.draw_list
        tints = cell_tints(scene, target.guard_band_px)
        program, vertices = self._program(
            target.lens.kind,
            narrow=scene.sensor.needs_erf,
            mosaic=tints is not None,
            rolling=part.drawn is not None,
        )
        _set_uniforms(program, scene, target)
        texels = _piece_texels(part.pieces)
        chosen = _texels_of_stars(part)
        target.light.use()
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

    def _program(
        self, lens: int, *, narrow: bool, mosaic: bool, rolling: bool
    ) -> tuple[moderngl.Program, moderngl.VertexArray]:
        return self._sprites.program(
            "trail_pieces.vert",
            "trail_pieces.frag",
            PIECES_PER_SPRITE=PIECES_PER_SPRITE,
            NARROW=int(narrow),
            MOSAIC=int(mosaic),
            ROWS=int(rolling),
            LENS=lens,
        )

    def release(self) -> None:
        """Release programs, buffers and textures."""
        self._sprites.release()


def _piece_texels(pieces: TrailPieces) -> NDArray[np.float32]:
    """Return the texture of n pieces, rounded up to fours with pieces of no duration, (rows, 7, 4) float32."""
    orientations = textures.pointing_texels(pieces.pointing, multiple=PIECES_PER_SPRITE)
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
    margin_px = 3 * float(scene.draw_list.truncation_radius_px.max())
    radius_rad = view_radius_rad(camera, margin_px) + swing_rad + MAX_REFRACTION_RAD
    cosine = firsts @ scene.stars.direction_eq[scene.draw_list.index[stars]].T
    near: NDArray[np.bool_] = cosine > np.cos(min(radius_rad, np.pi))
    if part.drawn is not None:
        piece = rows.start + PIECES_PER_SPRITE * np.arange(len(near))[:, np.newaxis]
        near &= (piece + PIECES_PER_SPRITE > part.drawn[0, stars]) & (piece < part.drawn[1, stars])
    return near


# Pieces per draw call: rows of a texture, of which every driver supports 4096.
_END_PIECES_PER_CALL = 1024
# Orientations per piece: at its start, its middle and its end.
_TIMES_OF_END = 3


class EndPass:
    """Adds the flux of `EndPieces` to a target."""

    def __init__(self, context: moderngl.Context, stars: RecentFields[moderngl.Texture]) -> None:
        self._context = context
        self._sprites = StarSprites(context, stars, (TEXELS_PER_TIME, _TIMES_OF_END * _END_PIECES_PER_CALL), 1)

    def draw(self, scene: Scene, ends: EndPieces, target: StarTarget) -> None:
        """Add the flux of a scene's stars during some pieces to a target that is in use, under a rolling shutter."""
        drawn = scene.draw_list
        tints = cell_tints(scene, target.guard_band_px)
        program, vertices = self._sprites.program(
            "end_pieces.vert",
            "trail_short.frag",
            NARROW=int(scene.sensor.needs_erf),
            MOSAIC=int(tints is not None),
            ROWS=target.clock.rows,
            LENS=target.lens.kind,
            COMPONENTS=0,
        )
        _set_uniforms(program, scene, target)
        chosen = np.column_stack([drawn.index, drawn.truncation_radius_px, drawn.transmission]).astype(np.float32)
        texels = _end_texels(ends)
        self._sprites.bind(scene.stars)
        for first in range(0, len(ends.begin), _END_PIECES_PER_CALL):
            pieces = slice(first, first + _END_PIECES_PER_CALL)
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


def _set_uniforms(program: moderngl.Program, scene: Scene, target: StarTarget) -> None:
    sensor, pointing = scene.sensor, scene.trails.pointing
    uniforms: dict[str, Any] = {
        "refraction_scale": pointing.refraction_scale,
        "sine_horizon": pointing.sine_horizon,
        "target_px": target.light.size,
        "falloff_per_px2": falloff_per_px2(sensor),
        "sigma_px": drawn_sigma_px(sensor),
        "effective_sigma_px": sensor.effective_sigma_px,
        "vmag_0_peak_dn": still_peak_dn(sensor, scene.exposure.duration_s, target.clock.span),
    }
    set_used_uniforms(program, **uniforms)
    target.clock.bind(program)
    target.lens.bind(program, scene.camera, target.guard_band_px)


def _end_texels(ends: EndPieces) -> NDArray[np.float32]:
    """Return the texture of pieces by piece, (n, 3, 5, 4) float32: see end_pieces.vert."""
    texels = textures.pointing_texels(ends.pointing).reshape(-1, _TIMES_OF_END, TEXELS_PER_TIME, 4)
    texels[:, 0, 0, 3] = ends.begin
    texels[:, 0, 1, 3] = ends.duration
    return texels


def _sprites(ends: EndPieces, first_star: int, first_piece: int) -> NDArray[np.uint16]:
    """Return which stars of a draw call are drawn during which of its pieces, (c, 2), star by star."""
    star = ends.star - first_star
    piece = ends.piece - first_piece
    in_call = (star >= 0) & (star < STARS_PER_CALL) & (piece >= 0) & (piece < _END_PIECES_PER_CALL)
    # Software OpenGL finds the sprites of a tile near each other in memory.
    return np.stack([star[in_call], piece[in_call]], axis=1).astype(np.uint16)
