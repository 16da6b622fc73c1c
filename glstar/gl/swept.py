"""Trails in closed form: one quad a star and segment of the exposure."""

from contextlib import ExitStack
from math import erf
from typing import Final, TypeVar

import moderngl
import numpy as np
from numpy.typing import NDArray

from glstar.gl.program import linked, set_uniforms
from glstar.photometry import brightness_ratio
from glstar.scene import Scene
from glstar.starfield import StarField

__all__ = ["SweptTrails"]

_Made = TypeVar("_Made", moderngl.Program, moderngl.VertexArray, moderngl.Buffer, moderngl.Texture)

_Painter = tuple[moderngl.Program, moderngl.VertexArray, int]

# What trail.vert calls a shape: who lights its pixels, and of how many quads it is; a point is none.
_SHAPES: Final = (("trail_short.frag", 0), ("trail.frag", 0), ("trail.frag", 2), ("trail_between.frag", 1))

# So many stars a draw call: one row of a texture on any driver.
_STARS_A_CALL: Final = 4096
# So many segments a draw call, for their moments are rows of a texture.
_SEGMENTS_A_CALL: Final = 1024
_TEXELS_A_MOMENT: Final = 5
_STARS_A_ROW: Final = 1024  # place.frag

# The variance that is left to each of the Gaussians that stand for a pixel: trail.frag.
_NARROW_VARIANCE_PX2: Final = 0.00705189

# The share of a Gaussian within so many sigma of its middle.
_REACHES_SIGMA: Final = np.linspace(0.0, 5.0, 201)
_WITHIN: Final = np.array([erf(reach / 2**0.5) for reach in _REACHES_SIGMA.tolist()]).clip(0.01)


class SweptTrails:
    """Draws scenes whose exposure's trail is ``"swept"``, with one context.

    `place.frag` finds where each star stands at the ends and in the middles of the segments, once; `trail.vert` and
    `trail.frag` draw a quad of light from each three of them.

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
        self._places: moderngl.Texture | None = None
        self._placed: moderngl.Framebuffer | None = None
        try:
            self._make()
        except BaseException:
            self.release()
            raise

    def _make(self) -> None:
        context = self._context
        self._placer = self._own(linked(context, "develop.vert", "place.frag"))
        self._everywhere = self._own(context.vertex_array(self._placer, []))
        quads = 4 * np.arange(2 * _STARS_A_CALL, dtype=np.uint32)[:, np.newaxis]
        self._corners = self._own(context.buffer(quads + np.array([0, 1, 2, 2, 1, 3], np.uint32)))
        self._painters = {
            narrow: [self._painter(narrow, shape) for shape in range(len(_SHAPES))] for narrow in (False, True)
        }
        self._point_size_px = float(context.info["GL_POINT_SIZE_RANGE"][1])
        self._moments = self._texture((_TEXELS_A_MOMENT, 2 * _SEGMENTS_A_CALL + 1), 4)
        self._chosen = self._texture((_STARS_A_CALL, 1), 4)
        self._owned.callback(self._drop_stars)
        self._owned.callback(self._drop_places)

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
            stars=0,
            chosen=1,
            moments=2,
            refraction_scale=scene.pointing.refraction_scale,
            focal_px=(camera.fx_px, camera.fy_px),
            principal_px=(camera.cx_px, camera.cy_px),
            skew_px=camera.skew_px,
            apron_px=apron_px,
        )
        painters = self._painters[narrow]
        for program, _, _ in painters:
            if "largest_point_px" in program:
                program["largest_point_px"] = self._point_size_px
            set_uniforms(
                program,
                places=0,
                moments=2,
                target_px=light.size,
                sigma_px=sigma_px,
                falloff_per_px2=1 / (2 * np.log(2) * sigma_px**2),
                vmag_0_peak_dn=peak * float(sensor.peak_dn(0.0, scene.exposure.duration_s)),
            )
        self._upload(scene.stars).use(location=0)
        self._chosen.use(location=1)
        self._moments.use(location=2)
        texels = _texels(scene)
        # What is cut off beside a fast and faint trail is given back to what is left of it.
        gain = 1 / np.interp(scene.reach_px / sigma_px, _REACHES_SIGMA, _WITHIN)
        chosen = np.column_stack([scene.visible, scene.reach_px, gain, gain]).astype(np.float32)
        for first in range(0, len(texels) - 1, 2 * _SEGMENTS_A_CALL):
            rows = texels[first : first + 2 * _SEGMENTS_A_CALL + 1]
            self._moments.write(rows, viewport=(0, 0, _TEXELS_A_MOMENT, len(rows)))
            for begin in range(0, len(chosen), _STARS_A_CALL):
                self._draw(painters, chosen[begin : begin + _STARS_A_CALL], len(rows), light)

    def _draw(
        self, painters: list[_Painter], chosen: NDArray[np.float32], moments: int, light: moderngl.Framebuffer
    ) -> None:
        """Draw a few stars in a few segments: those of which there are so many moments."""
        self._chosen.write(np.ascontiguousarray(chosen), viewport=(0, 0, len(chosen), 1))
        placed, places = self._targets(len(chosen), moments + 1)
        placed.use()
        placed.viewport = (0, 0, len(chosen), moments + 1)
        self._placer["last_moment"] = moments - 1
        self._context.enable_only(moderngl.NOTHING)
        assert self._stars is not None
        self._stars.use(location=0)
        self._everywhere.render(moderngl.TRIANGLES, vertices=3)
        light.use()
        places.use(location=0)
        self._context.enable_only(moderngl.BLEND | moderngl.PROGRAM_POINT_SIZE)
        self._context.blend_func = moderngl.ONE, moderngl.ONE
        for program, shapes, quads in painters:
            program["last_moment"] = moments - 1
            mode, vertices = (moderngl.TRIANGLES, 6 * quads) if quads else (moderngl.POINTS, 1)
            shapes.render(mode, vertices=vertices * len(chosen), instances=(moments - 1) // 2)
        self._context.enable_only(moderngl.NOTHING)

    def _painter(self, narrow: bool, shape: int) -> _Painter:
        fragments, quads = _SHAPES[shape]
        program = self._own(linked(self._context, "trail.vert", fragments, NARROW=int(narrow), SHAPE=shape))
        corners = self._corners if quads else None
        shapes = self._own(self._context.vertex_array(program, [], index_buffer=corners, index_element_size=4))
        return program, shapes, quads

    def _upload(self, stars: StarField) -> moderngl.Texture:
        if self._stars is None or self._uploaded is not stars:
            self._drop_stars()
            rows = -(-max(len(stars), 1) // _STARS_A_ROW)
            packed = np.zeros((rows * _STARS_A_ROW, 4), np.float32)
            packed[: len(stars), :3] = stars.direction_eq
            packed[: len(stars), 3] = brightness_ratio(stars.camera_mag)
            self._stars = self._context.texture((_STARS_A_ROW, rows), 4, packed, dtype="f4")
            self._stars.filter = moderngl.NEAREST, moderngl.NEAREST
            self._uploaded = stars
        return self._stars

    def _targets(self, stars: int, rows: int) -> tuple[moderngl.Framebuffer, moderngl.Texture]:
        """Return where places are written, of so many columns and rows or more."""
        held = (0, 0) if self._places is None else self._places.size
        if self._places is None or self._placed is None or held[0] < stars or held[1] < rows:
            self._drop_places()
            # In steps, so that a flight does not make new ones all the time.
            size = 256 * -(-max(stars, held[0]) // 256), 16 * -(-max(rows, held[1]) // 16)
            self._places = self._context.texture(size, 4, dtype="f4")
            self._places.filter = moderngl.NEAREST, moderngl.NEAREST
            self._placed = self._context.framebuffer([self._places])
        return self._placed, self._places

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

    def _drop_places(self) -> None:
        for resource in (self._placed, self._places):
            if resource is not None:
                resource.release()
        self._placed = self._places = None

    def release(self) -> None:
        """Give all of it back."""
        self._owned.close()


def _texels(scene: Scene) -> NDArray[np.float32]:
    """Return the moments as place.frag reads them, (2 m + 1, 5, 4) float32, with the segments' shares beside."""
    pointing = scene.pointing
    texels = np.zeros((len(pointing), _TEXELS_A_MOMENT, 4), np.float32)
    texels[:, :3, :3] = pointing.C_camera_eq
    texels[:, 3, :3] = pointing.zenith_eq
    texels[:, 4, :3] = pointing.velocity_eq
    texels[:-1:2, 0, 3] = scene.segment_share
    return texels
