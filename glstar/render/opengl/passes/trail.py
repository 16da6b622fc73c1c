"""The trail pass: analytic trails, one sprite or quad per star and segment of the exposure."""

from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import replace
from functools import partial
from typing import Any, NamedTuple, TypeVar

import moderngl
import numpy as np
from numpy.typing import NDArray

from glstar.camera.sensor.sensor import Sensor
from glstar.render.motion.starpaths import view_radius_rad
from glstar.render.motion.trailmodels import AnalyticSegments
from glstar.render.opengl.passes import path
from glstar.render.opengl.passes.piece import EndPass, PiecePass
from glstar.render.opengl.program import linked, set_used_uniforms
from glstar.render.opengl.textures import RecentFields, StarTarget, pointing_texels, star_texture
from glstar.render.readout.openings import PixelOpenings, SegmentColumns, divided_trails, whole_trails
from glstar.render.readout.pieces import WIDE_PIXEL_COSTS, in_pieces
from glstar.render.scene.scene import Scene
from glstar.render.scene.starcomponents import cell_tints
from glstar.sky.air.refraction import MAX_REFRACTION_RAD


class DrawQueue:
    """Draws to one target, in the order in which they were added, after a first one that replaces its content.

    Software OpenGL finishes what was drawn to a target whenever another is bound.  In an image of 12 megapixels each
    time takes 2 ms and more.  What is drawn to other targets first does not interrupt it.
    """

    def __init__(self, target: StarTarget, first: Callable[[], None]) -> None:
        self.target = target
        self._waiting: list[Callable[[], None]] = [first]

    def __len__(self) -> int:
        """Return how many draws wait."""
        return len(self._waiting)

    def add(self, draw: Callable[[], None]) -> None:
        """Let a draw wait until the target is bound."""
        self._waiting.append(draw)

    def run(self) -> None:
        """Bind the target and draw what waits."""
        self.target.light.use()
        while self._waiting:
            self._waiting.pop(0)()


_Owned = TypeVar("_Owned", moderngl.Program, moderngl.VertexArray, moderngl.Buffer, moderngl.Texture)


class _Shape(NamedTuple):
    """One value of SHAPE in trail.vert or trail_rows.vert."""

    number: int  # The value
    shaders: tuple[str, str]  # The vertex and the fragment shader
    mode: int  # The trails to draw
    vertices: int  # Vertices per segment
    layout: str  # Which of the repeated entries of the list of segments its vertices read


class _DrawPass(NamedTuple):
    """One shape's program and vertices."""

    program: moderngl.Program
    vertex_array: moderngl.VertexArray
    shape: _Shape


_SHAPES = (
    _Shape(0, ("trail.vert", "trail_short.frag"), moderngl.POINTS, 1, "2u2 12x"),
    _Shape(1, ("trail.vert", "trail.frag"), moderngl.POINTS, 2, "2u2 4x"),
    _Shape(2, ("trail.vert", "trail_middle.frag"), moderngl.TRIANGLES, 6, "2u2"),
)
# Shapes of segments during which a row of a rolling shutter opens or closes.
_ROW_SHAPES = (
    _Shape(0, ("trail_rows.vert", "trail_short.frag"), moderngl.POINTS, 1, "2u2 12x"),
    _Shape(1, ("trail_rows.vert", "trail.frag"), moderngl.POINTS, 1, "2u2 12x"),
    _Shape(2, ("trail_rows.vert", "trail.frag"), moderngl.TRIANGLES, 6, "2u2"),
)

# Texture units at which trail.vert and trail_rows.vert read the textures of PathPass.
_PATH_TEXTURES = {"chords": 0, "shapes": 1, "fluxes": 2, "joints": 3, "boundaries": 4, "openings_of_paths": 5}
# Texture unit at which they read the colours of stars in a mosaic.
_TINTS_UNIT = 6

# Limits of one draw call: stars and times are columns and rows of textures, which every driver supports up to 4096.
_STARS_PER_CALL = 4096
_SEGMENTS_PER_CALL = 1024
# Segments of stars per draw call, each repeated for the vertices of a quad.
_PRIMITIVES_PER_CALL = 16384
_REPETITIONS = 4

# Draws that wait at most, and texels of the largest that waits: its textures take 80 bytes a texel.
_MOST_WAITING = 16
_MOST_WAITING_TEXELS = 1 << 15


class TrailPass:
    """Adds the flux of `AnalyticSegments` to a target.

    Where short pieces cost less than segments, `PiecePass` draws them.  Of segments, `project_stars.frag` computes the
    positions of the stars at the ends and the middles, and `star_path.frag` the path through each three of them.
    `trail.vert` makes geometry that encloses the flux, and `trail_short.frag`, `trail.frag` and `trail_middle.frag`
    integrate it.  Raises ShaderError if the driver rejects a shader.
    """

    def __init__(self, context: moderngl.Context) -> None:
        self._context = context
        self._owned = ExitStack()
        self._stars = RecentFields(partial(star_texture, context))
        self._owned.callback(self._stars.release)
        # By whether the point spread function is narrow, and there is a mosaic, ROWS of readout.glsl, COMPONENTS.
        self._draw_passes: dict[tuple[bool, bool, int, bool], list[_DrawPass]] = {}
        try:
            self._create_programs()
        except BaseException:
            self.release()
            raise

    def _create_programs(self) -> None:
        context = self._context
        self._path_pass = path.PathPass(context, _STARS_PER_CALL, _SEGMENTS_PER_CALL)
        self._owned.callback(self._path_pass.release)
        quads = 4 * np.arange(_PRIMITIVES_PER_CALL, dtype=np.uint32)[:, np.newaxis]
        self._corners = self._own(context.buffer(quads + np.array([0, 1, 2, 2, 1, 3], np.uint32)))
        self._drawn = self._own(context.buffer(reserve=_PRIMITIVES_PER_CALL * _REPETITIONS * 4, dynamic=True))
        for narrow in (False, True):
            self._draw_passes_of(narrow, mosaic=False, rows=0, components=False)
        self._point_size_px = float(context.info["GL_POINT_SIZE_RANGE"][1])
        self._tints = self._texture((_STARS_PER_CALL, 1), 4)
        self._piece_pass = PiecePass(context, self._stars)
        self._owned.callback(self._piece_pass.release)
        self._end_pass = EndPass(context, self._stars)
        self._owned.callback(self._end_pass.release)

    def draw(self, scene: Scene, trails: AnalyticSegments, queue: DrawQueue) -> None:
        """Add the flux of a scene's stars to the target of a queue, in which some draws may wait afterwards."""
        target = queue.target
        openings = target.clock.openings(target.guard_band_px)
        if openings is not None and len(trails) > _SEGMENTS_PER_CALL:
            self._draw_segments(scene, trails, queue, target)
            return
        divide = in_pieces if target.pixel_width_px == 1 else partial(in_pieces, costs=WIDE_PIXEL_COSTS)
        divided = divide(scene, trails, largest_point_px=self._point_size_px, openings=openings)
        if divided is None:
            self._draw_trails(scene, trails, queue, openings)
            return
        # The last bits of a sum depend on its order, which stays as it is.
        if target.clock.rows and len(divided.rest.draw_list):
            self._draw_segments(divided.rest, trails, queue, target)
        for part in divided.parts:
            if part.ends is not None:
                queue.add(partial(self._end_pass.draw, part.scene, part.ends, target))
            queue.add(partial(self._piece_pass.draw, part, target))
        if not target.clock.rows and len(divided.rest.draw_list):
            self._draw_segments(divided.rest, trails, queue, target)

    def draw_components(self, scenes: Sequence[Scene], queue: DrawQueue) -> None:
        """Add the flux of several Gaussians of the same stars: scenes that `drawn_together` lists together."""
        scene, components = path.in_one_scene(scenes)
        assert isinstance(scene.trails, AnalyticSegments)
        self._draw_segments(scene, scene.trails, queue, queue.target, components=components)

    def _draw_trails(
        self, scene: Scene, trails: AnalyticSegments, queue: DrawQueue, openings: PixelOpenings | None
    ) -> None:
        """Draw the trails of a scene in segments; where all rows are open, as under a global shutter."""
        target = queue.target
        divided = None if openings is None else divided_trails(scene, trails, openings)
        if divided is None:
            self._draw_segments(scene, trails, queue, target)
            return
        queue.add(partial(self._end_pass.draw, scene, divided.ends, target))
        while_open = target._replace(clock=replace(target.clock, rows=0))
        for parts, how in ((divided.while_open, while_open), (divided.whole, target)):
            if len(parts.star):
                self._draw_segments(scene, trails, queue, how, parts)

    def _draw_segments(
        self,
        scene: Scene,
        trails: AnalyticSegments,
        queue: DrawQueue,
        target: StarTarget,
        parts: SegmentColumns | None = None,
        *,
        components: path.StarComponents | None = None,
    ) -> None:
        """Draw the trails of a scene, or parts of them, in segments."""
        has_components = components is not None
        are_short = has_components or path.surely_short(scene, trails)
        kinds = path.SegmentKinds(are_short, has_components, len(trails) == 1)
        self._path_pass.set_scene(scene, trails, target, kinds)
        texels = _segment_texels(trails)
        drawn = scene.draw_list
        tints = cell_tints(scene, target.guard_band_px)
        parts = whole_trails(scene, trails) if parts is None else parts
        field = self._stars.of(scene.stars)
        chosen = _texels_of_parts(scene, parts)
        runs: list[tuple[Sensor, NDArray[np.bool_] | None]] = [(scene.sensor, None)]
        if components is not None:
            chosen = np.concatenate([chosen, components.texels(scene.exposure.duration_s, target.clock.span)])
            runs = list(components.runs())
        for first in range(0, len(texels) - 1, 2 * _SEGMENTS_PER_CALL):
            times = slice(first, first + 2 * _SEGMENTS_PER_CALL + 1)
            self._path_pass.set_times(texels[times])
            for begin in range(0, chosen.shape[1], _STARS_PER_CALL):
                columns = slice(begin, begin + _STARS_PER_CALL)
                stars = parts.star[columns]
                segments = slice(first // 2, first // 2 + _SEGMENTS_PER_CALL)
                passage = None if drawn.passage is None else drawn.passage[stars, segments].T
                near = _near_image(scene, trails, times, stars)
                if near.size > _MOST_WAITING_TEXELS or len(queue) > _MOST_WAITING:
                    queue.run()
                filled = self._path_pass.filled(len(queue), field, chosen[:, columns], passage, len(near))
                of_columns = None if tints is None else tints[drawn.index[stars]]
                for sensor, has_star in runs:
                    of_run = near if has_star is None else near & has_star[columns]
                    queue.add(partial(self._draw, sensor, target, filled, of_columns, of_run, kinds))

    def _draw(
        self,
        sensor: Sensor,
        target: StarTarget,
        paths: list[moderngl.Texture],
        tints: NDArray[np.float32] | None,
        near: NDArray[np.bool_],
        kinds: path.SegmentKinds,
    ) -> None:
        """Draw some stars in some segments: those that are near the image then, (segments, stars)."""
        draw_passes = self._passes_with_uniforms(sensor, target, kinds)
        for location, texture in enumerate(paths):
            texture.use(location)
        if tints is not None:
            self._tints.write(tints, viewport=(0, 0, len(tints), 1))
        self._tints.use(location=_TINTS_UNIT)
        self._context.enable_only(moderngl.BLEND | moderngl.PROGRAM_POINT_SIZE)
        self._context.blend_func = moderngl.ONE, moderngl.ONE
        # Star by star: software OpenGL then finds the primitives of a tile of the target near each other in memory.
        drawn = np.argwhere(near.T).astype(np.uint16)
        for first in range(0, len(drawn), _PRIMITIVES_PER_CALL):
            primitives = drawn[first : first + _PRIMITIVES_PER_CALL]
            self._drawn.write(np.repeat(primitives, _REPETITIONS, axis=0))
            for _, vertex_array, shape in draw_passes:
                vertex_array.render(shape.mode, vertices=shape.vertices * len(primitives))
        self._context.enable_only(moderngl.NOTHING)

    def _passes_with_uniforms(self, sensor: Sensor, target: StarTarget, kinds: path.SegmentKinds) -> list[_DrawPass]:
        """Return the draw passes for a sensor, after setting their uniforms."""
        sigma_px = path.drawn_sigma_px(sensor)
        uniforms: dict[str, Any] = {
            "target_px": target.light.size,
            "falloff_per_px2": path.falloff_per_px2(sensor),
            "half_width_px": np.sqrt(2 * np.log(2)) * sigma_px,
            "sigma_px": sigma_px,
        }
        mosaic = sensor.colour.mosaic != "none"
        draw_passes = self._draw_passes_of(sensor.needs_erf, mosaic, target.clock.rows, kinds.have_components)
        draw_passes = [each for each in draw_passes if each.shape.number == 0 or not kinds.are_short]
        for program, *_ in draw_passes:
            set_used_uniforms(program, **uniforms)
            target.clock.bind(program)
        return draw_passes

    def _draw_passes_of(self, narrow: bool, mosaic: bool, rows: int, components: bool) -> list[_DrawPass]:
        """Return the draw passes for narrow or wide point spread functions, with a mosaic, and one value of ROWS."""
        key = narrow, mosaic, rows, components
        if key not in self._draw_passes:
            shapes = [shape for shape in (_ROW_SHAPES if rows else _SHAPES) if shape.number == 0 or not components]
            before = self._draw_passes_of(narrow, mosaic, 0, components) if rows else []
            self._draw_passes[key] = [*before, *(self._draw_pass(shape, *key) for shape in shapes)]
        return self._draw_passes[key]

    def _draw_pass(self, shape: _Shape, narrow: bool, mosaic: bool, rows: int, components: bool) -> _DrawPass:
        program = self._own(
            linked(
                self._context,
                *shape.shaders,
                NARROW=int(narrow),
                SHAPE=shape.number,
                ROWS=rows,
                MOSAIC=int(mosaic),
                COMPONENTS=int(components),
            )
        )
        set_used_uniforms(program, **_PATH_TEXTURES, tints_of_stars=_TINTS_UNIT)
        corners = self._corners if shape.mode == moderngl.TRIANGLES else None
        content = [(self._drawn, shape.layout, "segment")]
        vertex_array = self._context.vertex_array(program, content, index_buffer=corners, index_element_size=4)
        return _DrawPass(program, self._own(vertex_array), shape)

    def _texture(self, size: tuple[int, int], components: int) -> moderngl.Texture:
        texture = self._own(self._context.texture(size, components, dtype="f4"))
        texture.filter = moderngl.NEAREST, moderngl.NEAREST
        return texture

    def _own(self, resource: _Owned) -> _Owned:
        self._owned.callback(resource.release)
        return resource

    def release(self) -> None:
        """Release programs, buffers and textures."""
        self._owned.close()


def _segment_texels(trails: AnalyticSegments) -> NDArray[np.float32]:
    """Return the texture of orientations, (2 m + 1, 5, 4) float32, with durations, weights and starts of segments."""
    texels = pointing_texels(trails.pointing)
    texels[:-1:2, 0, 3] = trails.time_fraction
    texels[:-1:2, 1, 3] = trails.end_weight
    texels[:-1:2, 2, 3] = np.cumsum(trails.time_fraction) - trails.time_fraction
    return texels


def _texels_of_parts(scene: Scene, parts: SegmentColumns) -> NDArray[np.float32]:
    """Return what project_stars.frag reads of each part of a trail, (2, c, 3): see its uniform `chosen`."""
    drawn = scene.draw_list
    texels = np.zeros((2, len(parts.star), 3), np.float32)
    texels[0] = np.column_stack([drawn.index, drawn.truncation_radius_px, drawn.transmission])[parts.star]
    texels[1, :, :2] = parts.rises_and_sets
    return texels


def _near_image(scene: Scene, trails: AnalyticSegments, times: slice, stars: NDArray[np.intp]) -> NDArray[np.bool_]:
    """Return in which segments which visible stars are near the image, (m, k): a bound that excludes most others.

    Between two times a star comes closer to the boresight than at both by at most half of the boresight's rotation.
    """
    camera = scene.camera
    boresight = trails.pointing.boresight_eq[times]
    chord = np.diff(boresight, axis=0)
    rotation_rad = 2 * np.arcsin(np.sqrt((chord * chord).sum(axis=1).max()).clip(max=2.0) / 2)
    margin_px = float(scene.draw_list.truncation_radius_px.max()) + 1
    radius_rad = view_radius_rad(camera, margin_px) + rotation_rad / 2 + MAX_REFRACTION_RAD
    cosine = boresight @ scene.stars.direction_eq[scene.draw_list.index[stars]].T
    near: NDArray[np.bool_] = cosine > np.cos(min(radius_rad, np.pi))
    return near[:-2:2] | near[1::2] | near[2::2]
