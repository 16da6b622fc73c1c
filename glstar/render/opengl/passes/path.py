"""The path pass: where stars are during the segments of an exposure, as textures.

A column of these textures is a star, and a row a time or a segment.  The Gaussians of a point spread function are drawn
together, as stars of one scene, each of its own width.
"""

from collections.abc import Iterable, Iterator, Sequence
from contextlib import ExitStack
from dataclasses import replace
from itertools import groupby
from typing import NamedTuple

import moderngl
import numpy as np
from numpy.typing import NDArray

from glstar.arrays import Float32
from glstar.camera.sensor.sensor import PIXEL_PART_VARIANCE_PX2, Sensor
from glstar.render.motion.segmentation import SHAPE_LIMITS
from glstar.render.motion.trailmodels import AnalyticSegments
from glstar.render.opengl import textures
from glstar.render.opengl.program import linked, set_uniforms, set_used_uniforms
from glstar.render.opengl.textures import StarTarget
from glstar.render.readout.openings import are_worth_dividing
from glstar.render.readout.pieces import PIECE_COSTS
from glstar.render.scene.culling import DrawList
from glstar.render.scene.scene import Scene


class TextureTable:
    """Textures of four floats per texel that are drawn together: a column is a star, a row a time or a segment."""

    def __init__(self, context: moderngl.Context, count: int) -> None:
        self._context = context
        self._count = count
        self._textures: list[moderngl.Texture] = []
        self._target: moderngl.Framebuffer | None = None
        self._size = (0, 0)

    def filled(self, vertex_array: moderngl.VertexArray, stars: int, rows: int) -> list[moderngl.Texture]:
        """Return the textures after drawing some of their columns and rows."""
        target = self._target_of(stars, rows)
        target.use()
        target.viewport = (0, 0, stars, rows)
        vertex_array.render(moderngl.TRIANGLES, vertices=3)
        return self._textures

    def _target_of(self, stars: int, rows: int) -> moderngl.Framebuffer:
        """Return a target with at least this many columns and rows."""
        if self._target is None or self._size[0] < stars or self._size[1] < rows:
            # In steps, so that the number of stars in view does not require new textures for every frame.
            size = 256 * -(-max(stars, self._size[0]) // 256), 16 * -(-max(rows, self._size[1]) // 16)
            self.release()
            self._size = size
            self._textures = [self._context.texture(size, 4, dtype="f4") for _ in range(self._count)]
            for texture in self._textures:
                texture.filter = moderngl.NEAREST, moderngl.NEAREST
            self._target = self._context.framebuffer(self._textures)
            self._target.clear()
        return self._target

    def release(self) -> None:
        """Release the textures."""
        for resource in (self._target, *self._textures):
            if resource is not None:
                resource.release()
        self._target = None
        self._textures = []
        self._size = (0, 0)


# Outputs of star_path.frag: the last one is that of a rolling shutter.
_OUTPUTS = 6
_UNITS = {"positions": 0, "passage": 1, "pointing": 2, "chosen": 3}
# Segments are surely SHORT if their longest is at most this fraction of the limit: stars beside the image are faster.
_SURELY_SHORT = 0.5


class SegmentKinds(NamedTuple):
    """Properties that all segments of a scene share: ALL_SHORT, COMPONENTS and SINGLE of star_path.frag."""

    are_short: bool  # Whether they are SHORT
    have_components: bool = False  # Whether each star of the draw list has a Gaussian of its own width
    are_single: bool = False  # Whether there is a single segment


def surely_short(scene: Scene, trails: AnalyticSegments) -> bool:
    """Return whether all segments of a scene of plain Gaussians are surely SHORT."""
    limit_px = SHAPE_LIMITS.short_sigma * scene.sensor.effective_sigma_px
    return trails.longest_segment_px(scene.camera) < _SURELY_SHORT * limit_px


def drawn_sigma_px(sensor: Sensor) -> float:
    """Return the width of the Gaussians that are drawn, px: with that of a pixel, or of the parts of a narrow one."""
    if sensor.needs_erf:
        return float(np.sqrt(sensor.psf_sigma_px**2 + PIXEL_PART_VARIANCE_PX2))
    return sensor.effective_sigma_px


def falloff_per_px2(sensor: Sensor) -> float:
    """Return the coefficient of the squared distance in the exponent of 2 of the Gaussians that are drawn, 1/px^2."""
    return float(1 / (2 * np.log(2) * drawn_sigma_px(sensor) ** 2))


def still_peak_dn(sensor: Sensor, duration_s: float, span: float = 1.0) -> float:
    """Return the peak, as drawn, of a star of magnitude 0 that does not move, DN.

    `span` is `ReadoutClock.span` of a rolling shutter.
    """
    peak = (sensor.psf_sigma_px / drawn_sigma_px(sensor)) ** 2
    return peak * float(sensor.peak_dn(0.0, duration_s)) * span


class PathPass:
    """Computes the paths of stars: `project_stars.frag` their positions, `star_path.frag` the paths through these.

    `stars` and `segments` are the largest numbers of a call.  Raises ShaderError if the driver rejects a shader.
    """

    def __init__(self, context: moderngl.Context, stars: int, segments: int) -> None:
        self._context = context
        # By ROWS of readout.glsl, LENS of lens.glsl and the kinds of segments.
        self._programs: dict[tuple[int, int, SegmentKinds], _PathProgram] = {}
        self._projections: dict[int, _PathProgram] = {}  # By LENS of lens.glsl
        with ExitStack() as owned:
            self._positions = TextureTable(context, 1)
            owned.callback(self._positions.release)
            self._pointing = context.texture((textures.TEXELS_PER_TIME, 2 * segments + 1), 4, dtype="f4")
            self._chosen = context.texture((stars, 4), 3, dtype="f4")
            for texture in (self._pointing, self._chosen):
                texture.filter = moderngl.NEAREST, moderngl.NEAREST
                owned.callback(texture.release)
            self._passage = textures.PassageTexture(context)
            owned.callback(self._passage.release)
            owned.callback(self._release_programs)
            self._kinds = SegmentKinds(are_short=False)
            self._path, self._projection = self._program(0, 0), self._projection_behind(0)
            self._owned = owned.pop_all()
        self._point_size_px = float(context.info["GL_POINT_SIZE_RANGE"][1])

    def set_scene(self, scene: Scene, trails: AnalyticSegments, target: StarTarget, kinds: SegmentKinds) -> None:
        """Set the uniforms for a scene, given its trails, and their kinds of segments."""
        sensor, clock = scene.sensor, target.clock
        sigma_px = drawn_sigma_px(sensor)
        self._projection = self._projection_behind(target.lens.kind)
        set_uniforms(self._projection.program, refraction_scale=trails.pointing.refraction_scale)
        target.lens.bind(self._projection.program, scene.camera, target.guard_band_px)
        self._kinds = kinds
        self._path = self._program(clock.rows, target.lens.kind)
        program = self._path.program
        uniforms = {
            "sigma_px": sigma_px,
            "effective_sigma_px": sensor.effective_sigma_px,
            "largest_point_px": self._point_size_px,
            "vmag_0_peak_dn": still_peak_dn(sensor, scene.exposure.duration_s, clock.span),
        }
        set_used_uniforms(program, **uniforms)
        clock.bind(program)
        target.lens.bind(program, scene.camera, target.guard_band_px)

    def set_times(self, texels: Float32) -> None:
        """Set the orientations at the ends and the middles of m segments, (2 m + 1, 5, 4) float32.

        Texels include durations, weights and starts of segments: the uniform ``pointing`` of star_path.frag.
        """
        self._pointing.write(texels, viewport=(0, 0, textures.TEXELS_PER_TIME, len(texels)))

    def filled(
        self, number: int, field: moderngl.Texture, chosen: Float32, passage: Float32 | None, segments: int
    ) -> list[moderngl.Texture]:
        """Return the outputs of star_path.frag: textures of the paths of some stars.

        Textures are valid until the next call with the same `number` and kinds of segments.  `field` has all stars;
        `chosen` (2 or 4, c, 3) float32 is the uniform ``chosen`` of project_stars.frag and star_path.frag; `passage`
        (m, c) float32 is the transmission of cloud, None without cloud; `segments` is m.
        """
        rows, stars = chosen.shape[:2]
        times = 2 * segments + 1
        self._passage.write_table(np.ones((1, 1), np.float32) if passage is None else passage)
        self._chosen.write(np.ascontiguousarray(chosen), viewport=(0, 0, stars, rows))
        for location, texture in enumerate((field, self._chosen, self._pointing)):
            texture.use(location)
        self._projection.program["last_time"] = self._path.program["last_time"] = times - 1
        self._context.enable_only(moderngl.NOTHING)
        positions = self._positions.filled(self._projection.vertices, stars, times + 1)
        positions[0].use(_UNITS["positions"])
        self._passage.texture.use(_UNITS["passage"])
        self._chosen.use(_UNITS["chosen"])
        # Long segments have a joint at their end too.  That of a single one is 0, as textures are when they are new.
        joints = segments if self._kinds.are_short or self._kinds.are_single else segments + 1
        filled = self._path.table(number).filled(self._path.vertices, stars, joints)
        # Software OpenGL waits here for that pass.  Otherwise it would interrupt what is being drawn when that reads
        # the textures.
        self._chosen.write(chosen[:1, :1].tobytes(), viewport=(0, 0, 1, 1))
        return filled

    def _projection_behind(self, lens: int) -> "_PathProgram":
        if lens not in self._projections:
            program = linked(
                self._context,
                "whole_image.vert",
                "project_stars.frag",
                STARS_PER_ROW=textures.STARS_PER_ROW,
                LENS=lens,
            )
            set_uniforms(program, stars=0, chosen=1, pointing=2)
            self._projections[lens] = _PathProgram(self._context, program, 1)
        return self._projections[lens]

    def _program(self, rows: int, lens: int) -> "_PathProgram":
        key = rows, lens, self._kinds
        if key not in self._programs:
            program = linked(
                self._context,
                "whole_image.vert",
                "star_path.frag",
                SHORT_SIGMA=SHAPE_LIMITS.short_sigma,
                MAX_FLUX_VARIATION=SHAPE_LIMITS.max_flux_variation,
                MAX_END_FLUX=SHAPE_LIMITS.max_end_flux,
                ROWS=rows,
                LENS=lens,
                ALL_SHORT=int(self._kinds.are_short),
                COMPONENTS=int(self._kinds.have_components),
                SINGLE=int(self._kinds.are_single),
            )
            set_used_uniforms(program, **_UNITS)
            self._programs[key] = _PathProgram(self._context, program, _OUTPUTS if rows else _OUTPUTS - 1)
        return self._programs[key]

    def _release_programs(self) -> None:
        for program in (*self._programs.values(), *self._projections.values()):
            program.release()
        self._programs.clear()
        self._projections.clear()

    def release(self) -> None:
        """Release programs and textures."""
        self._owned.close()


class _PathProgram:
    """A program of paths, and the tables that it fills: one for each draw that waits."""

    def __init__(self, context: moderngl.Context, program: moderngl.Program, outputs: int) -> None:
        self.program = program
        self.vertices = context.vertex_array(program, [])
        self._context = context
        self._outputs = outputs
        self._tables: list[TextureTable] = []

    def table(self, number: int) -> TextureTable:
        self._tables += [TextureTable(self._context, self._outputs) for _ in range(len(self._tables), number + 1)]
        return self._tables[number]

    def release(self) -> None:
        for table in self._tables:
            table.release()
        self.vertices.release()
        self.program.release()


# Segments up to this length, in standard deviations of the narrowest Gaussian, are drawn as one: 1e-4 of the peak.
_SHORT_SIGMA = 0.5


class StarComponents(NamedTuple):
    """The Gaussians of the stars of a scene: the first ones of all stars, then the second ones, and so on."""

    sensors: tuple[Sensor, ...]  # The sensor of each Gaussian, `Sensor.of_component`
    of_star: NDArray[np.intp]  # (k,) intp: the Gaussian that each star of the scene's draw list has

    def texels(self, duration_s: float, span: float) -> Float32:
        """Return what star_path.frag reads of each of k stars of the draw list, (2, k, 3) float32.

        These are rows 2 and 3 of `chosen`; `span` is `ReadoutClock.span`.
        """
        rows = [
            (
                (drawn_sigma_px(sensor), sensor.effective_sigma_px, still_peak_dn(sensor, duration_s, span)),
                (falloff_per_px2(sensor), 0.0, 0.0),
            )
            for sensor in self.sensors
        ]
        return np.swapaxes(np.array(rows, np.float32)[self.of_star], 0, 1)

    def runs(self) -> Iterator[tuple[Sensor, NDArray[np.bool_]]]:
        """Yield sensors and the stars, (k,), that one program draws with them, in the order of the draw list."""
        for _, numbers in groupby(range(len(self.sensors)), key=lambda number: self.sensors[number].needs_erf):
            run = list(numbers)
            yield self.sensors[run[0]], np.isin(self.of_star, run)


def drawn_together(scenes: Iterable[Scene], *, rolling: bool) -> Iterator[list[Scene]]:
    """Yield scenes of plain Gaussians in their order: lists that `in_one_scene` joins, or of one scene.

    Several have the same stars on the same paths, whose segments are well below their widths.  Scenes without stars are
    left out.
    """
    drawn = (scene for scene in scenes if len(scene.draw_list))
    for _, same in groupby(drawn, key=lambda scene: (id(scene.stars), id(scene.trails), scene.camera)):
        several = list(same)
        if len(several) > 1 and _are_short(several, rolling=rolling):
            yield several
        else:
            yield from ([scene] for scene in several)


def _are_short(scenes: Sequence[Scene], *, rolling: bool) -> bool:
    trails = scenes[0].trails
    narrowest = min(scenes, key=lambda scene: scene.sensor.effective_sigma_px)
    if not isinstance(trails, AnalyticSegments) or len(trails) >= PIECE_COSTS.min_segments:
        return False
    if rolling and are_worth_dividing(trails, narrowest.camera, narrowest.sensor.effective_sigma_px):
        return False
    limit_px = _SHORT_SIGMA * narrowest.sensor.effective_sigma_px
    return trails.longest_segment_px(narrowest.camera) < limit_px


def in_one_scene(scenes: Sequence[Scene]) -> tuple[Scene, StarComponents]:
    """Return scenes of `drawn_together` as one, in which a star occurs once for each of its Gaussians.

    It has the sensor of the first one.
    """
    lists = [scene.draw_list for scene in scenes]
    of_star = np.repeat(np.arange(len(scenes)), [len(stars) for stars in lists])
    components = StarComponents(tuple(scene.sensor for scene in scenes), of_star)
    return replace(scenes[0], draw_list=_joined(lists)), components


def _joined(lists: Sequence[DrawList]) -> DrawList:
    extinctions_mag = [stars.extinction_mag for stars in lists if stars.extinction_mag is not None]
    passages = [stars.passage for stars in lists if stars.passage is not None]
    return DrawList(
        np.concatenate([stars.index for stars in lists]),
        np.concatenate([stars.truncation_radius_px for stars in lists]),
        np.concatenate([stars.min_trail_px for stars in lists]),
        np.concatenate(extinctions_mag) if extinctions_mag else None,
        np.concatenate(passages) if passages else None,
    )
