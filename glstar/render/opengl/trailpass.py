"""Trails in closed form: one quad a star and segment of the exposure."""

from contextlib import ExitStack
from typing import Final, TypeVar

import moderngl
import numpy as np
from numpy.typing import NDArray

from glstar.render.opengl.program import linked, set_uniforms
from glstar.render.scene import Scene
from glstar.sky.horizon import MAX_REFRACTION_RAD
from glstar.sky.magnitudes import brightness_ratio
from glstar.sky.starfield import StarField

__all__ = ["SweptTrails"]

_Made = TypeVar("_Made", moderngl.Program, moderngl.VertexArray, moderngl.Buffer, moderngl.Texture)

_Painter = tuple[moderngl.Program, moderngl.VertexArray, int, int]

# What trail.vert calls a shape: who lights its pixels, as what, of how many vertices a way, and which of the ways that
# are repeated these read.
_SHAPES: Final = (
    ("trail_short.frag", moderngl.POINTS, 1, "2u2 12x"),
    ("trail.frag", moderngl.POINTS, 2, "2u2 4x"),
    ("trail_between.frag", moderngl.TRIANGLES, 6, "2u2"),
)

# Where trail.vert finds what way.frag wrote.
_WAYS: Final = {"lines": 0, "forms": 1, "extents": 2, "edges": 3, "bounds": 4}

# So many stars a draw call: one row of a texture on any driver.
_STARS_A_CALL: Final = 4096
# So many segments a draw call, for their moments are rows of a texture.
_SEGMENTS_A_CALL: Final = 1024
_TEXELS_A_MOMENT: Final = 5
_STARS_A_ROW: Final = 1024  # place.frag
# So many ways a draw call, each as often as the shape of most vertices asks.
_WAYS_A_CALL: Final = 16384
_REPEATED: Final = 4

# The variance that is left to each of the Gaussians that stand for a pixel: trail.frag.
_NARROW_VARIANCE_PX2: Final = 0.00705189


class SweptTrails:
    """Draws scenes whose exposure's trail is ``"analytic"``, with one context.

    `place.frag` finds where each star stands at the ends and in the middles of the segments, `way.frag` the way through
    each three of them; `trail.vert` encloses its light, and `trail.frag` and its like say how much there is.

    Parameters
    ----------
    context : moderngl.Context

    Raises
    ------
    ShaderError
        If the driver refuses a shader.
    """

    def __init__(self, context: moderngl.Context) -> None:
        self._context = context
        self._owned = ExitStack()
        self._stars: moderngl.Texture | None = None
        self._uploaded: StarField | None = None
        self._places = _Table(context, 1)
        self._ways = _Table(context, len(_WAYS))
        try:
            self._make()
        except BaseException:
            self.release()
            raise

    def _make(self) -> None:
        context = self._context
        self._placer = self._own(linked(context, "develop.vert", "place.frag"))
        self._wayfinder = self._own(linked(context, "develop.vert", "way.frag"))
        set_uniforms(self._placer, stars=0, chosen=1, moments=2)
        set_uniforms(self._wayfinder, places=0, moments=2)
        self._all_places = self._own(context.vertex_array(self._placer, []))
        self._all_ways = self._own(context.vertex_array(self._wayfinder, []))
        quads = 4 * np.arange(_WAYS_A_CALL, dtype=np.uint32)[:, np.newaxis]
        self._corners = self._own(context.buffer(quads + np.array([0, 1, 2, 2, 1, 3], np.uint32)))
        self._drawn = self._own(context.buffer(reserve=_WAYS_A_CALL * _REPEATED * 4, dynamic=True))
        self._painters = {
            narrow: [self._painter(narrow, shape) for shape in range(len(_SHAPES))] for narrow in (False, True)
        }
        self._point_size_px = float(context.info["GL_POINT_SIZE_RANGE"][1])
        self._moments = self._texture((_TEXELS_A_MOMENT, 2 * _SEGMENTS_A_CALL + 1), 4)
        self._chosen = self._texture((_STARS_A_CALL, 1), 2)
        self._owned.callback(self._drop_stars)
        self._owned.callback(self._places.release)
        self._owned.callback(self._ways.release)

    def draw(self, scene: Scene, light: moderngl.Framebuffer, apron_px: int) -> None:
        """Add the light of a scene's stars to a target.

        Parameters
        ----------
        scene : Scene
        light : moderngl.Framebuffer
            32-bit float, cleared.
        apron_px : int
            By how much it is larger than the image, on each side.
        """
        sensor, camera = scene.sensor, scene.camera
        narrow = sensor.needs_erf
        sigma_px = np.sqrt(sensor.psf_sigma_px**2 + _NARROW_VARIANCE_PX2) if narrow else sensor.drawn_sigma_px
        peak = (sensor.psf_sigma_px / sigma_px) ** 2
        set_uniforms(
            self._placer,
            refraction_scale=scene.pointing.refraction_scale,
            focal_px=(camera.fx_px, camera.fy_px),
            principal_px=(camera.cx_px, camera.cy_px),
            skew_px=camera.skew_px,
            apron_px=apron_px,
        )
        set_uniforms(
            self._wayfinder,
            sigma_px=sigma_px,
            drawn_sigma_px=sensor.drawn_sigma_px,
            largest_point_px=self._point_size_px,
            vmag_0_peak_dn=peak * float(sensor.peak_dn(0.0, scene.exposure.duration_s)),
        )
        painters = self._painters[narrow]
        wanted = {
            "target_px": light.size,
            "falloff_per_px2": 1 / (2 * np.log(2) * sigma_px**2),
            "half_width_px": np.sqrt(2 * np.log(2)) * sigma_px,
        }
        for program, *_ in painters:
            set_uniforms(program, **{name: value for name, value in wanted.items() if name in program})
        self._upload(scene.stars)
        texels = _texels(scene)
        chosen = np.column_stack([scene.visible, scene.reach_px]).astype(np.float32)
        for first in range(0, len(texels) - 1, 2 * _SEGMENTS_A_CALL):
            moments = slice(first, first + 2 * _SEGMENTS_A_CALL + 1)
            rows = texels[moments]
            self._moments.write(rows, viewport=(0, 0, _TEXELS_A_MOMENT, len(rows)))
            for begin in range(0, len(chosen), _STARS_A_CALL):
                stars = slice(begin, begin + _STARS_A_CALL)
                self._draw(painters, chosen[stars], _near(scene, moments, stars), light)

    def _draw(
        self,
        painters: list[_Painter],
        chosen: NDArray[np.float32],
        near: NDArray[np.bool_],
        light: moderngl.Framebuffer,
    ) -> None:
        """Draw a few stars in a few segments, (segments, stars): those that are near the image then."""
        segments, moments = len(near), 2 * len(near) + 1
        self._chosen.write(np.ascontiguousarray(chosen), viewport=(0, 0, len(chosen), 1))
        for location, texture in enumerate((self._stars, self._chosen, self._moments)):
            assert texture is not None
            texture.use(location)
        self._placer["last_moment"] = self._wayfinder["last_moment"] = moments - 1
        self._context.enable_only(moderngl.NOTHING)
        places = self._places.filled(self._all_places, len(chosen), moments + 1)
        places[0].use(location=0)
        ways = self._ways.filled(self._all_ways, len(chosen), segments + 1)
        for location, texture in enumerate(ways):
            texture.use(location)
        light.use()
        self._context.enable_only(moderngl.BLEND | moderngl.PROGRAM_POINT_SIZE)
        self._context.blend_func = moderngl.ONE, moderngl.ONE
        drawn = np.argwhere(near)[:, ::-1].astype(np.uint16)
        for first in range(0, len(drawn), _WAYS_A_CALL):
            few = drawn[first : first + _WAYS_A_CALL]
            self._drawn.write(np.repeat(few, _REPEATED, axis=0))
            for _, shapes, mode, vertices in painters:
                shapes.render(mode, vertices=vertices * len(few))
        self._context.enable_only(moderngl.NOTHING)

    def _painter(self, narrow: bool, shape: int) -> _Painter:
        fragments, mode, vertices, layout = _SHAPES[shape]
        program = self._own(linked(self._context, "trail.vert", fragments, NARROW=int(narrow), SHAPE=shape))
        set_uniforms(program, **{name: location for name, location in _WAYS.items() if name in program})
        corners = self._corners if mode == moderngl.TRIANGLES else None
        ways = [(self._drawn, layout, "way")]
        shapes = self._own(self._context.vertex_array(program, ways, index_buffer=corners, index_element_size=4))
        return program, shapes, mode, vertices

    def _upload(self, stars: StarField) -> None:
        if self._stars is None or self._uploaded is not stars:
            self._drop_stars()
            rows = -(-max(len(stars), 1) // _STARS_A_ROW)
            packed = np.zeros((rows * _STARS_A_ROW, 4), np.float32)
            packed[: len(stars), :3] = stars.direction_eq
            packed[: len(stars), 3] = brightness_ratio(stars.camera_mag)
            self._stars = self._context.texture((_STARS_A_ROW, rows), 4, packed, dtype="f4")
            self._stars.filter = moderngl.NEAREST, moderngl.NEAREST
            self._uploaded = stars

    def _texture(self, size: tuple[int, int], components: int) -> moderngl.Texture:
        texture = self._own(self._context.texture(size, components, dtype="f4"))
        texture.filter = moderngl.NEAREST, moderngl.NEAREST
        return texture

    def _own(self, made: _Made) -> _Made:
        self._owned.callback(made.release)
        return made

    def _drop_stars(self) -> None:
        if self._stars is not None:
            self._stars.release()
            self._stars = self._uploaded = None

    def release(self) -> None:
        """Give all of it back."""
        self._owned.close()


class _Table:
    """Textures of one size that are drawn together, four numbers a texel: a column is a star."""

    def __init__(self, context: moderngl.Context, count: int) -> None:
        self._context = context
        self._count = count
        self._textures: list[moderngl.Texture] = []
        self._target: moderngl.Framebuffer | None = None
        self._size = (0, 0)

    def filled(self, drawn: moderngl.VertexArray, stars: int, rows: int) -> list[moderngl.Texture]:
        """Return the textures after filling some columns and rows of theirs."""
        target = self._held(stars, rows)
        target.use()
        target.viewport = (0, 0, stars, rows)
        drawn.render(moderngl.TRIANGLES, vertices=3)
        return self._textures

    def _held(self, stars: int, rows: int) -> moderngl.Framebuffer:
        """Return a target of so many columns and rows or more."""
        if self._target is None or self._size[0] < stars or self._size[1] < rows:
            # In steps, so that a flight does not make new ones all the time.
            size = 256 * -(-max(stars, self._size[0]) // 256), 16 * -(-max(rows, self._size[1]) // 16)
            self.release()
            self._size = size
            self._textures = [self._context.texture(size, 4, dtype="f4") for _ in range(self._count)]
            for texture in self._textures:
                texture.filter = moderngl.NEAREST, moderngl.NEAREST
            self._target = self._context.framebuffer(self._textures)
        return self._target

    def release(self) -> None:
        """Give all of it back."""
        for resource in (self._target, *self._textures):
            if resource is not None:
                resource.release()
        self._target, self._textures, self._size = None, [], (0, 0)


def _texels(scene: Scene) -> NDArray[np.float32]:
    """Return the moments as place.frag reads them, (2 m + 1, 5, 4) float32, and what way.frag asks beside."""
    pointing = scene.pointing
    texels = np.zeros((len(pointing), _TEXELS_A_MOMENT, 4), np.float32)
    texels[:, :3, :3] = pointing.C_camera_eq
    texels[:, 3, :3] = pointing.zenith_eq
    texels[:, 4, :3] = pointing.velocity_eq
    texels[:-1:2, 0, 3] = scene.segment_share
    texels[:-1:2, 1, 3] = scene.end_weight
    return texels


def _near(scene: Scene, moments: slice, stars: slice) -> NDArray[np.bool_]:
    """Return in which segments which visible stars are near the image, (m, k): a bound, which leaves out most others.

    Between two moments a star comes nearer to the boresight than at both by half of what the boresight turns, at most.
    """
    camera, boresight = scene.camera, scene.pointing.boresight_eq[moments]
    chord = np.diff(boresight, axis=0)
    turn_rad = 2 * np.arcsin(np.sqrt((chord * chord).sum(axis=1).max()).clip(max=2.0) / 2)
    margin_rad = np.arctan((scene.reach_px.max() + 1) / min(camera.fx_px, camera.fy_px))
    radius_rad = camera.reach_rad + margin_rad + turn_rad / 2 + MAX_REFRACTION_RAD
    cosine = boresight @ scene.stars.direction_eq[scene.visible[stars]].T
    near: NDArray[np.bool_] = cosine > np.cos(min(radius_rad, np.pi))
    return near[:-2:2] | near[1::2] | near[2::2]
