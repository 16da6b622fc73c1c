"""Light behind a lens: summed as a pinhole has it, then gathered by the pixels that the lens gives it to."""

from dataclasses import replace
from functools import lru_cache
from math import ceil
from typing import Final, NamedTuple

import moderngl
import numpy as np
from numpy.typing import NDArray

from glstar.camera.model import Camera
from glstar.camera.sensor import PIXEL_VARIANCE_PX2, Sensor
from glstar.errors import RenderError
from glstar.render.opengl.program import linked, set_uniforms
from glstar.render.scene import Scene

__all__ = ["PinholeLight", "Warp"]

Float = NDArray[np.float64]

# What lies between the pixels of the pinhole's light widens what goes through them by this, px^2: warp.frag.
_WIDENED_PX2: Final = 0.44
# Stars are drawn no narrower than this, px of the pinhole's light: from there on a Gaussian stays one.
_NARROWEST_PX: Final = 1.2
# A pixel that integrates is asked in several parts where its variance in the pinhole's light exceeds that of a pixel on
# the axis by more than this, px^2; in so many along each side at the most.
_LARGER_PX2: Final = 0.05
_MOST_PARTS: Final = 24
# So many parts are worth a program of their own: software OpenGL takes twice as long over loops that it does not know.
_KNOWN_PARTS: Final = ((1, 1), (2, 1), (1, 2), (2, 2))
# Light is looked for in blocks of so many pixels of the pinhole's light a side.
_BLOCK_PX: Final = 4
# The image is cut into patches of this side, and these into smaller ones where the lens bends them much; a large image
# into larger ones at first, for each is found in float64.
_PATCH_PX: Final = 8
_LARGE_PATCH_PX: Final = 16
_LARGE_IMAGE_PX2: Final = 2_000_000
# By so much the place of a pixel may be wrong, px.
_PATCH_ERROR_PX: Final = 1e-3
# The spline reaches so far, px of the pinhole's light.
_SPLINE_REACH_PX: Final = 3
# What warp.vert takes of a patch.
_PATCH_FORMAT: Final = "3f 4f 2f 4f 4f 2f 4f 2f"
_PATCH_NAMES: Final = ("square_px", "seen_px", "at_1", "at_u_v", "at_uu_vv", "at_uv", "at_uuv_uvv", "at_uuvv")


class PinholeLight:
    """Where a pinhole's light is summed: what `GLRenderer` exposes, without an image."""

    def __init__(self, context: moderngl.Context, width_px: int, height_px: int, apron_px: int) -> None:
        self.key = (width_px, height_px, apron_px)
        self.scene: Scene | None = None
        self.apron_px = apron_px
        size = width_px + 2 * apron_px, height_px + 2 * apron_px
        self.light_texture = context.texture(size, 1, dtype="f4")
        self.light_texture.filter = moderngl.NEAREST, moderngl.NEAREST
        self.light = context.framebuffer([self.light_texture])
        self.lit_texture = context.texture((-(-size[0] // _BLOCK_PX), -(-size[1] // _BLOCK_PX)), 1, dtype="f1")
        self.lit_texture.filter = moderngl.NEAREST, moderngl.NEAREST
        self.lit = context.framebuffer([self.lit_texture])

    def release(self) -> None:
        """Give all of it back."""
        for resource in (self.lit, self.lit_texture, self.light, self.light_texture):
            resource.release()


class Warp:
    """One camera's lens on the GPU.

    Parameters
    ----------
    context : moderngl.Context
    camera : Camera
        With a lens.

    Raises
    ------
    RenderError
        If the lens sees too wide a field for a plane.
    ShaderError
        If the driver refuses the shader.

    Notes
    -----
    Teague & Chahl, section 2.3: a lens is applied after a star is rendered, so that its point spread is distorted too.
    The paper leaves open what becomes of its brightness.  Here its light is kept: behind a barrel a star is smaller
    and its peak higher towards the corners, and the sum over its pixels stays `Sensor.flux_dn`.
    """

    def __init__(self, context: moderngl.Context, camera: Camera) -> None:
        camera.check_field()
        self.camera = camera
        self._patches, self._bounds_px = _patches(camera)
        self._programs: dict[tuple[int, int], moderngl.Program] = {}
        self._groups: list[_Group] = []
        self._grouped_for: tuple[float, str] | None = None
        self._lighting = linked(context, "develop.vert", "lit.frag", BLOCK_PX=_BLOCK_PX)
        self._all_blocks = context.vertex_array(self._lighting, [])
        self._context = context
        self._light: PinholeLight | None = None
        self._straightened: tuple[Scene, Scene] | None = None

    def finer(self, sensor: Sensor) -> float:
        """Return how many pixels of the pinhole's light are one of the image on the axis.

        As many as the image has where the lens stretches it most, and enough for the narrowest star.

        Parameters
        ----------
        sensor : Sensor

        Returns
        -------
        float
        """
        return max(self.camera.stretch, _NARROWEST_PX / sensor.psf_sigma_px)

    def straight(self, scene: Scene) -> Scene:
        """Return the scene as a pinhole sees it, wide and fine enough to be warped.

        Parameters
        ----------
        scene : Scene
            Of this camera.

        Returns
        -------
        Scene
            The same stars and moments; stars are drawn narrower by what warping widens them.
        """
        # Who draws it asks several times.
        if self._straightened is None or self._straightened[0] is not scene:
            self._straightened = scene, self._made_straight(scene)
        return self._straightened[1]

    def _made_straight(self, scene: Scene) -> Scene:
        finer = self.finer(scene.sensor)
        left, top, right, bottom = self._bounds_px
        camera = Camera(
            ceil((right - left) * finer) + 2 * _SPLINE_REACH_PX,
            ceil((bottom - top) * finer) + 2 * _SPLINE_REACH_PX,
            self.camera.fx_px * finer,
            self.camera.fy_px * finer,
            (self.camera.cx_px - left) * finer + _SPLINE_REACH_PX,
            (self.camera.cy_px - top) * finer + _SPLINE_REACH_PX,
            self.camera.skew_px * finer,
        )
        sigma_px = scene.sensor.psf_sigma_px
        drawn_px = finer * np.sqrt(sigma_px**2 + _pixel_px2(scene.sensor) - _WIDENED_PX2 / finer**2)
        sensor = replace(
            scene.sensor,
            psf_sigma_px=float(drawn_px),
            reference_peak_dn=scene.sensor.reference_peak_dn * float(sigma_px / drawn_px) ** 2,
            pixel="sampled",
        )
        return replace(scene, camera=camera, sensor=sensor, reach_px=finer * scene.reach_px)

    def light_for(self, straight: Scene, apron_px: int) -> PinholeLight:
        """Return where the light of a scene made `straight` is summed.

        Parameters
        ----------
        straight : Scene
        apron_px : int

        Returns
        -------
        PinholeLight
            The warp's own; it is made anew when another size is asked for.
        """
        wanted = (straight.camera.width_px, straight.camera.height_px, apron_px)
        if self._light is None or self._light.key != wanted:
            self._drop_light()
            self._light = PinholeLight(self._context, *wanted)
        return self._light

    def gather(self, scene: Scene, target: moderngl.Framebuffer) -> None:
        """Bring the light that was summed last into the image's pixels.

        Parameters
        ----------
        scene : Scene
            As it was before it was made `straight`.
        target : moderngl.Framebuffer
            One float a pixel, of the image's size.
        """
        assert self._light is not None
        finer = self.finer(scene.sensor)
        left, top, _, _ = self._bounds_px
        self._group_for(scene.sensor)
        viewport_px = self.camera.width_px + _LARGE_PATCH_PX, self.camera.height_px + _LARGE_PATCH_PX
        for program in {group.program for group in self._groups}:
            set_uniforms(
                program,
                light=0,
                lit=1,
                block_px=_BLOCK_PX,
                viewport_px=viewport_px,
                origin_px=(left - _SPLINE_REACH_PX / finer, top - _SPLINE_REACH_PX / finer),
                finer=finer,
                apron_px=self._light.apron_px,
                pixel_px2=_pixel_px2(scene.sensor),
            )
        self._context.enable_only(moderngl.NOTHING)
        self._light.light_texture.use(location=0)
        set_uniforms(self._lighting, light=0)
        self._light.lit.use()
        self._all_blocks.render(moderngl.TRIANGLES, vertices=3)
        self._light.lit_texture.use(location=1)
        target.use()
        target.clear()
        # A point whose middle is outside the viewport is clipped whole.
        target.viewport = (0, 0, *viewport_px)
        self._context.enable_only(moderngl.PROGRAM_POINT_SIZE)
        for group in self._groups:
            if group.parts not in _KNOWN_PARTS:
                group.program["parts"] = group.parts
            group.vertices.render(moderngl.POINTS, vertices=group.patches)
        self._context.enable_only(moderngl.NOTHING)
        target.viewport = (0, 0, *target.size)

    def _group_for(self, sensor: Sensor) -> None:
        """Put together the patches whose pixels are asked in as many parts."""
        wanted = (self.finer(sensor), sensor.pixel)
        if self._grouped_for == wanted:
            return
        self._drop_groups()
        largest_px = np.sqrt(1 + _LARGER_PX2 / (PIXEL_VARIANCE_PX2 * wanted[0] ** 2))
        parts = np.ceil(_sides_px(self._patches) / largest_px).clip(1, _MOST_PARTS).astype(np.intp)
        if sensor.pixel != "integrated":
            parts[:] = 1
        for across, down in np.unique(parts, axis=0).tolist():
            chosen = self._patches[(parts == (across, down)).all(axis=1)]
            program = self._program_for((across, down))
            buffer = self._context.buffer(np.ascontiguousarray(chosen))
            vertices = self._context.vertex_array(program, [(buffer, _PATCH_FORMAT, *_PATCH_NAMES)])
            self._groups.append(_Group((across, down), program, buffer, vertices, len(chosen)))
        self._grouped_for = wanted

    def _program_for(self, parts: tuple[int, int]) -> moderngl.Program:
        across, down = known = parts if parts in _KNOWN_PARTS else (0, 0)
        if known not in self._programs:
            self._programs[known] = linked(
                self._context, "warp.vert", "warp.frag", PARTS_ACROSS=across, PARTS_DOWN=down
            )
        return self._programs[known]

    def _drop_light(self) -> None:
        if self._light is not None:
            self._light.release()
            self._light = None

    def _drop_groups(self) -> None:
        for group in self._groups:
            group.vertices.release()
            group.buffer.release()
        self._groups.clear()
        self._grouped_for = None

    def release(self) -> None:
        """Give all of it back."""
        self._drop_light()
        self._drop_groups()
        for program in self._programs.values():
            program.release()
        self._programs.clear()
        self._all_blocks.release()
        self._lighting.release()


class _Group(NamedTuple):
    """Patches whose pixels are asked in as many parts, across and down."""

    parts: tuple[int, int]
    program: moderngl.Program
    buffer: moderngl.Buffer
    vertices: moderngl.VertexArray
    patches: int


def _pixel_px2(sensor: Sensor) -> float:
    """Return a pixel's own variance along a side, px^2: 0 if it does not integrate."""
    return PIXEL_VARIANCE_PX2 if sensor.pixel == "integrated" else 0.0


@lru_cache(maxsize=2)
def _patches(camera: Camera) -> tuple[NDArray[np.float32], tuple[float, float, float, float]]:
    """Return the image cut into patches, and the part of the pinhole's plane that they see: left, top, right, bottom.

    Patches, (n, 25) float32, are what warp.vert reads: squares, within which places in the pinhole's plane are a
    biquadratic of u and v.  They are cut until that is so; where the lens ends they are single pixels.
    """
    kept: list[Float] = []
    side_px = _LARGE_PATCH_PX if camera.width_px * camera.height_px > _LARGE_IMAGE_PX2 else _PATCH_PX
    columns, rows = np.meshgrid(np.arange(0, camera.width_px, side_px), np.arange(0, camera.height_px, side_px))
    corner = np.stack([columns.ravel(), rows.ravel()], axis=-1)
    while True:
        places = _places(camera, corner, side_px)
        coefficients = _biquadratic(places)
        taken: NDArray[np.bool_] = np.asarray(np.isfinite(places).all(axis=(1, 2, 3)))
        if side_px > 1:
            taken[taken] = _off_px(places[taken], coefficients[taken]) <= _PATCH_ERROR_PX * 2 / side_px
        seen = places[taken].reshape(-1, 25, 2)
        square = np.column_stack([corner[taken], np.full(len(seen), side_px)])
        kept.append(np.hstack([square, seen.min(axis=1), seen.max(axis=1), coefficients[taken].reshape(-1, 18)]))
        if side_px == 1:
            break
        side_px //= 2
        quarters = side_px * np.array([(0, 0), (1, 0), (0, 1), (1, 1)])
        corner = (corner[~taken, np.newaxis] + quarters).reshape(-1, 2)
        corner = corner[(corner < [camera.width_px, camera.height_px]).all(axis=1)]
    patches = np.concatenate(kept)
    if not len(patches):
        raise RenderError("no light comes through this camera's lens onto its image; check its coefficients")
    bounds_px = (*patches[:, 3:5].min(axis=0).tolist(), *patches[:, 5:7].max(axis=0).tolist())
    handed = patches.astype(np.float32)
    handed.setflags(write=False)
    return handed, bounds_px


def _places(camera: Camera, corner: NDArray[np.intp], side_px: int) -> Float:
    """Return where five by five places of squares stand in the pinhole's plane, (n, 5, 5, 2) px; v, then u."""
    steps_px = side_px * np.arange(5) / 4 - 0.5
    grid_px = np.stack(np.meshgrid(steps_px, steps_px), axis=-1)
    return camera.pinhole.project(camera.unproject(corner[:, np.newaxis, np.newaxis] + grid_px))


def _biquadratic(places: Float) -> Float:
    """Return the coefficients of 1, u, v, uu, vv, uv, uuv, uvv, uuvv through every other of five by five places.

    (n, 9, 2) float64, px.
    """
    # From values at -1, 0 and 1 to coefficients of 1, u and uu.
    three = np.array([[0.0, 1.0, 0.0], [-0.5, 0.0, 0.5], [0.5, -1.0, 0.5]])
    by = np.einsum("iv,ju,nvuc->nijc", three, three, places[:, ::2, ::2])
    order = ((0, 0), (0, 1), (1, 0), (0, 2), (2, 0), (1, 1), (1, 2), (2, 1), (2, 2))
    return np.stack([by[:, v, u] for v, u in order], axis=1)


def _off_px(places: Float, coefficients: Float) -> Float:
    """Return how far a biquadratic is from five by five places at the most, (n,), over how far u and v go there."""
    u, v = np.meshgrid(np.linspace(-1, 1, 5), np.linspace(-1, 1, 5))
    powers = np.stack([u**0, u, v, u * u, v * v, u * v, u * u * v, u * v * v, u * u * v * v])
    off = np.linalg.norm(np.einsum("kvu,nkc->nvuc", powers, coefficients) - places, axis=-1).max(axis=(1, 2))
    return np.asarray(off / np.linalg.norm(coefficients[:, 1:3], axis=-1).min(axis=1))


def _sides_px(patches: NDArray[np.float32]) -> Float:
    """Return how long the sides of pixels are in the pinhole's plane at the most, (n, 2) px: across and down."""
    u, v = np.array([(-1, -1), (1, -1), (0, 0), (-1, 1), (1, 1)]).T
    zero, one = np.zeros(5), np.ones(5)
    # Of 1, u, v, uu, vv, uv, uuv, uvv, uuvv.
    by_u = np.stack([zero, one, zero, 2 * u, zero, v, 2 * u * v, v * v, 2 * u * v * v])
    by_v = np.stack([zero, zero, one, zero, 2 * v, u, u * u, 2 * u * v, 2 * u * u * v])
    coefficients = patches[:, 7:].reshape(-1, 9, 2).astype(np.float64)
    slopes = np.einsum("skp,nkc->nspc", np.stack([by_u, by_v]), coefficients)
    return np.asarray(np.linalg.norm(slopes, axis=-1).max(axis=-1) * 2 / patches[:, 2:3])
