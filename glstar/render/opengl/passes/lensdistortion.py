"""The distortion pass: the undistorted signal is resampled into the pixels behind a lens.

The image is divided into patches in which the undistorted position is a biquadratic function of the pixel.
"""

from dataclasses import replace
from functools import lru_cache
from math import ceil, hypot, sqrt
from typing import NamedTuple

import moderngl
import numpy as np
from numpy.typing import NDArray

from glstar.arrays import Float
from glstar.camera.model import Camera
from glstar.camera.sensor.colourband import Channel
from glstar.camera.sensor.sensor import PIXEL_VARIANCE_PX2, Sensor
from glstar.errors import RenderError
from glstar.render.opengl.passes.subexposure import sprite_px
from glstar.render.opengl.program import linked, set_uniforms
from glstar.render.opengl.targets import SignalTarget
from glstar.render.opengl.textures import LensOpenings
from glstar.render.scene.scene import Scene
from glstar.render.scene.starcomponents import FIRST_CHANNEL, gaussian_scenes

# Left, top, right, bottom, px.
Bounds = tuple[float, float, float, float]

# Initial side of a patch, px.  Large images start with larger patches, because each is fitted in float64.
_PATCH_PX = 8
LARGE_PATCH_PX = 16
_LARGE_IMAGE_PX2 = 2_000_000
# Largest acceptable error of a position, px.
_POSITION_ERROR_PX = 1e-3


@lru_cache(maxsize=2)
def distortion_patches(camera: Camera) -> tuple[NDArray[np.float32], Bounds]:
    """Return the patches of an image, (n, 25) float32, and their bounds in the undistorted plane.

    Patches, the vertices of warp.vert, have left, top and side, bounds in the undistorted plane, and nine coefficients
    for x and y.  They are divided until a biquadratic function is accurate; at the limit of the lens they are single
    pixels.  Raises RenderError if no pixel of the image sees anything.
    """
    accepted_patches: list[Float] = []
    side_px = LARGE_PATCH_PX if camera.width_px * camera.height_px > _LARGE_IMAGE_PX2 else _PATCH_PX
    columns, rows = np.meshgrid(np.arange(0, camera.width_px, side_px), np.arange(0, camera.height_px, side_px))
    corner = np.stack([columns.ravel(), rows.ravel()], axis=-1)
    while True:
        positions = _undistorted_grids(camera, corner, side_px)
        coefficients = _biquadratic(positions)
        accepted: NDArray[np.bool_] = np.asarray(np.isfinite(positions).all(axis=(1, 2, 3)))
        if side_px > 1:
            error_px = _relative_error(positions[accepted], coefficients[accepted])
            accepted[accepted] = error_px <= _POSITION_ERROR_PX * 2 / side_px
        grid = positions[accepted].reshape(-1, 25, 2)
        square = np.column_stack([corner[accepted], np.full(len(grid), side_px)])
        accepted_patches.append(
            np.hstack([square, grid.min(axis=1), grid.max(axis=1), coefficients[accepted].reshape(-1, 18)])
        )
        if side_px == 1:
            break
        side_px //= 2
        quarters = side_px * np.array([(0, 0), (1, 0), (0, 1), (1, 1)])
        corner = (corner[~accepted, np.newaxis] + quarters).reshape(-1, 2)
        corner = corner[(corner < [camera.width_px, camera.height_px]).all(axis=1)]
    patches = np.concatenate(accepted_patches)
    if not len(patches):
        raise RenderError("no pixel of this camera's image sees anything through its lens; check its coefficients")
    bounds_px = (*patches[:, 3:5].min(axis=0).tolist(), *patches[:, 5:7].max(axis=0).tolist())
    vertices = patches.astype(np.float32)
    vertices.setflags(write=False)
    return vertices, bounds_px


def max_pixel_sides_px(patches: NDArray[np.float32]) -> Float:
    """Return the largest extent, across and down, of a pixel of each of n patches, undistorted, (n, 2) px."""
    u, v = np.array([(-1, -1), (1, -1), (0, 0), (-1, 1), (1, 1)]).T
    zero = np.zeros(5)
    one = np.ones(5)
    # Derivatives of 1, u, v, uu, vv, uv, uuv, uvv, uuvv.
    by_u = np.stack([zero, one, zero, 2 * u, zero, v, 2 * u * v, v * v, 2 * u * v * v])
    by_v = np.stack([zero, zero, one, zero, 2 * v, u, u * u, 2 * u * v, 2 * u * u * v])
    coefficients = patches[:, 7:].reshape(-1, 9, 2).astype(np.float64)
    slopes = np.einsum("skp,nkc->nspc", np.stack([by_u, by_v]), coefficients)
    return np.asarray(np.linalg.norm(slopes, axis=-1).max(axis=-1) * 2 / patches[:, 2:3])


def _undistorted_grids(camera: Camera, corner: NDArray[np.intp], side_px: int) -> Float:
    """Return undistorted positions on a 5 x 5 grid over each square, (n, 5, 5, 2) px; axes v, then u."""
    steps_px = side_px * np.arange(5) / 4 - 0.5
    grid_px = np.stack(np.meshgrid(steps_px, steps_px), axis=-1)
    return camera.pinhole.project(camera.unit_vectors(corner[:, np.newaxis, np.newaxis] + grid_px))


def _biquadratic(positions: Float) -> Float:
    """Return the coefficients of 1, u, v, uu, vv, uv, uuv, uvv, uuvv through every other point of 5 x 5 grids.

    (n, 9, 2) float64, px.
    """
    # From values at -1, 0 and 1 to coefficients of 1, u and uu.
    three = np.array([[0.0, 1.0, 0.0], [-0.5, 0.0, 0.5], [0.5, -1.0, 0.5]])
    by = np.einsum("iv,ju,nvuc->nijc", three, three, positions[:, ::2, ::2])
    order = ((0, 0), (0, 1), (1, 0), (0, 2), (2, 0), (1, 1), (1, 2), (2, 1), (2, 2))
    return np.stack([by[:, v, u] for v, u in order], axis=1)


def _relative_error(positions: Float, coefficients: Float) -> Float:
    """Return the largest error of a biquadratic on a 5 x 5 grid, (n,), relative to its derivatives by u and v."""
    u, v = np.meshgrid(np.linspace(-1, 1, 5), np.linspace(-1, 1, 5))
    powers = np.stack([u**0, u, v, u * u, v * v, u * v, u * u * v, u * v * v, u * u * v * v])
    off = np.linalg.norm(np.einsum("kvu,nkc->nvuc", powers, coefficients) - positions, axis=-1).max(axis=(1, 2))
    return np.asarray(off / np.linalg.norm(coefficients[:, 1:3], axis=-1).min(axis=1))


# Variance that the interpolation between pixels of the undistorted signal adds, px^2: warp.frag.
_INTERPOLATION_PX2 = 0.40
# Smallest sigma of a star in the undistorted signal, px: what interpolation leaves differs from a Gaussian by up to
# 0.4 % of its peak at 1.2 px and 0.1 % at 1.5 px.
_MIN_SIGMA_PX = 1.5
_MOSTLY_PIXEL_PX = 0.5
_MIN_WITH_PIXEL_PX = 1.3
# The same where wide wings would need larger sprites than a driver draws: up to 2 % of the peak of a narrow core.
_LEAST_SIGMA_PX = 0.9
# Side of the part of a pixel by whose variance stars are drawn wider, px, wide point spread functions and those that a
# widened Gaussian does not describe (Sensor.needs_erf): several samples per pixel make up the rest.  With parts of half
# a pixel, errors are 0.3 % of the peak at a sigma of 0.3 px, 4 % at 0.2 px and 12 % at 0.15 px: narrow stars take less.
_DRAWN_PIXEL_PX = (1.0, 0.5)
_NARROW_PX = 0.25
_DRAWN_PIXEL_OF_NARROW_PX = 0.25
# A pixel that integrates takes several samples if its variance in the undistorted signal exceeds that of a pixel on the
# axis by more than this, px^2; at most this many along each side.
_MAX_VARIANCE_EXCESS_PX2 = 0.05
_MAX_PARTS = 24
# Numbers of samples with a program of their own: software OpenGL takes twice as long with a loop count in a uniform.
_COMPILED_PARTS = ((1, 1), (2, 1), (1, 2), (2, 2))
# Side of the blocks of the undistorted signal that are tested for flux, px.
_BLOCK_PX = 4
# Distance up to which the spline of warp.frag reads pixels of the undistorted signal, px.
_SPLINE_SUPPORT_PX = 3
# The vertices of warp.vert.
_PATCH_FORMAT = "3f 4f 2f 4f 4f 2f 4f 2f"
_PATCH_NAMES = ("square_px", "undistorted_px", "at_1", "at_u_v", "at_uu_vv", "at_uv", "at_uuv_uvv", "at_uuvv")


class _UndistortedTarget(SignalTarget):
    """The target of the undistorted signal, and which of its blocks have any flux."""

    def __init__(self, context: moderngl.Context, width_px: int, height_px: int, guard_band_px: int) -> None:
        super().__init__(context, width_px, height_px, guard_band_px)
        self.key = (width_px, height_px, guard_band_px)
        blocks = (-(-side // _BLOCK_PX) for side in self.light_texture.size)
        self.occupancy_texture = context.texture((next(blocks), next(blocks)), 1, dtype="f1")
        self.occupancy_texture.filter = moderngl.NEAREST, moderngl.NEAREST
        self.occupancy = context.framebuffer([self.occupancy_texture])

    def release(self) -> None:
        """Release the targets."""
        self.occupancy.release()
        self.occupancy_texture.release()
        super().release()


class _PatchGroup(NamedTuple):
    """Patches whose pixels take the same number of samples, across and down."""

    parts: tuple[int, int]
    program: moderngl.Program
    buffer: moderngl.Buffer
    vertices: moderngl.VertexArray
    patches: int


class DistortionPass:
    """The lens of one camera on the GPU.

    Raises RenderError if its field of view is too wide for a plane, and ShaderError if the driver rejects a shader.
    Teague & Chahl, section 2.3: the distortion is applied after a star is rendered, so that its point spread function
    is distorted too.  The paper does not say what happens to its brightness.  Here the flux is preserved: behind a
    barrel distortion a star is smaller and its peak higher towards the corners, and the sum over its pixels stays
    `Sensor.flux_dn`.
    """

    def __init__(self, context: moderngl.Context, camera: Camera) -> None:
        camera.require_drawable()
        self.camera = camera
        self._point_size_px = float(context.info["GL_POINT_SIZE_RANGE"][1])
        self._patches, self._bounds_px = distortion_patches(camera)
        self.openings = LensOpenings(context, camera)
        self._programs: dict[tuple[int, int, bool], moderngl.Program] = {}
        self._groups: list[_PatchGroup] = []
        self._grouped_for: tuple[float, str, float, bool] | None = None
        self._occupancy = linked(context, "whole_image.vert", "occupancy.frag", BLOCK_PX=_BLOCK_PX)
        self._all_blocks = context.vertex_array(self._occupancy, [])
        self._context = context
        self._target: _UndistortedTarget | None = None
        self._undistorted: tuple[Scene, Scene] | None = None

    def oversampling(self, sensor: Sensor) -> float:
        """Return the number of pixels of the undistorted signal per pixel of the image, on the axis.

        It is the largest magnification of the lens, or more for stars narrower than 1.5 px.
        """
        return self._sampling(sensor)[0]

    def _sampling(self, sensor: Sensor) -> tuple[float, float]:
        """Return the oversampling, and the side of the part of a pixel by whose variance stars are drawn wider, px.

        Stars below 0.5 px are mostly pixel: that part counts as their width.  Where the sprites of the wings would be
        larger than the driver draws, the oversampling is less, and at last that part is larger.
        """
        core_px, pixel_px2 = sensor.core.psf_sigma_px, _pixel_px2(sensor)
        widest_px = hypot(sensor.point_spread.widest(sensor.psf_sigma_px)[2], sqrt(pixel_px2))
        usual_px = _drawn_pixel_px(sensor)
        for drawn_pixel_px in (usual_px, *(side_px for side_px in (0.5, 1.0) if side_px > usual_px)):
            sigma_px, least_px = core_px, _MIN_SIGMA_PX
            if core_px < _MOSTLY_PIXEL_PX and pixel_px2:
                sigma_px, least_px = hypot(core_px, sqrt(pixel_px2) * drawn_pixel_px), _MIN_WITH_PIXEL_PX
            needed, least = (max(self.camera.max_magnification, px / sigma_px) for px in (least_px, _LEAST_SIGMA_PX))
            largest = self._point_size_px / sprite_px(widest_px, sigma_px)
            if largest >= least:
                break
        return min(needed, max(least, largest)), drawn_pixel_px

    def undistorted(self, scene: Scene) -> Scene:
        """Return the scene as a pinhole sees it, with a field and a resolution sufficient for resampling.

        Stars and times are the same; stars are narrower by as much as resampling widens them.
        """
        # A frame needs it several times.
        if self._undistorted is None or self._undistorted[0] is not scene:
            self._undistorted = scene, self._pinhole_scene(scene, scene.sensor)
        return self._undistorted[1]

    def undistorted_gaussians(self, scene: Scene) -> list[Scene]:
        """Return scenes as a pinhole sees them, with one Gaussian per star, which add up to `undistorted`."""
        if scene.sensor.point_spread.is_gaussian:
            return gaussian_scenes(self.undistorted(scene))
        oversampling = self.oversampling(scene.sensor)
        pinholes = []
        for gaussian in gaussian_scenes(scene):
            pinhole = self._pinhole_scene(gaussian, scene.sensor)
            cx_px = pinhole.camera.cx_px + oversampling * (gaussian.camera.cx_px - self.camera.cx_px)
            cy_px = pinhole.camera.cy_px + oversampling * (gaussian.camera.cy_px - self.camera.cy_px)
            pinholes.append(replace(pinhole, camera=replace(pinhole.camera, cx_px=cx_px, cy_px=cy_px)))
        return pinholes

    def _pinhole_scene(self, scene: Scene, whole: Sensor) -> Scene:
        """Return a scene as a pinhole sees it; `whole` is the sensor with the whole point spread function."""
        oversampling, drawn_pixel_px = self._sampling(whole)
        left, top, right, bottom = self._bounds_px
        camera = Camera(
            width_px=ceil((right - left) * oversampling) + 2 * _SPLINE_SUPPORT_PX,
            height_px=ceil((bottom - top) * oversampling) + 2 * _SPLINE_SUPPORT_PX,
            fx_px=self.camera.fx_px * oversampling,
            fy_px=self.camera.fy_px * oversampling,
            cx_px=(self.camera.cx_px - left) * oversampling + _SPLINE_SUPPORT_PX,
            cy_px=(self.camera.cy_px - top) * oversampling + _SPLINE_SUPPORT_PX,
            skew_px=self.camera.skew_px * oversampling,
        )
        sigma_px = scene.sensor.psf_sigma_px
        variance_px2 = sigma_px**2 + _pixel_px2(whole) * drawn_pixel_px**2 - _INTERPOLATION_PX2 / oversampling**2
        drawn_px = oversampling * np.sqrt(variance_px2)
        sensor = replace(
            scene.sensor,
            psf_sigma_px=float(drawn_px),
            reference_peak_dn=scene.sensor.reference_peak_dn * float(sigma_px / drawn_px) ** 2,
            pixel="sampled",
        )
        draw_list = scene.draw_list
        draw_list = replace(draw_list, truncation_radius_px=oversampling * draw_list.truncation_radius_px)
        bodies = None if scene.bodies is None else scene.bodies.magnified(oversampling)
        satellites = tuple(self._pinhole_scene(satellite, whole) for satellite in scene.satellites)
        return replace(scene, camera=camera, sensor=sensor, draw_list=draw_list, bodies=bodies, satellites=satellites)

    def resampling_px2(self, sensor: Sensor) -> float:
        """Return the variance that resampling adds to the undistorted signal, px^2 of its target.

        It is that of the interpolation, and of the samples of a pixel on the axis.
        """
        oversampling, drawn_pixel_px = self._sampling(sensor)
        return _INTERPOLATION_PX2 + _pixel_px2(sensor) * (1 - drawn_pixel_px**2) * oversampling**2

    def target_for(self, undistorted: Scene, guard_band_px: int) -> SignalTarget:
        """Return the target for an undistorted signal: owned here, and valid until another size is requested."""
        key = (undistorted.camera.width_px, undistorted.camera.height_px, guard_band_px)
        if self._target is None or self._target.key != key:
            self._drop_target()
            self._target = _UndistortedTarget(self._context, *key)
        return self._target

    def resample(self, scene: Scene, light: moderngl.Framebuffer, *, channel: Channel | None = None) -> None:
        """Resample the undistorted signal into the pixels of the image of a scene: all, or those of a mosaic's channel.

        `light` has one float per pixel, and the size of the image.
        """
        assert self._target is not None
        colour = scene.sensor.colour
        self._group_for(scene.sensor, has_mosaic=channel is not None)
        viewport_px = self.camera.width_px + LARGE_PATCH_PX, self.camera.height_px + LARGE_PATCH_PX
        self._set_uniforms(scene.sensor, viewport_px, self._target.guard_band_px)
        self._context.enable_only(moderngl.NOTHING)
        self._target.light_texture.use(location=0)
        set_uniforms(self._occupancy, light=0)
        self._target.occupancy.use()
        self._all_blocks.render(moderngl.TRIANGLES, vertices=3)
        self._target.occupancy_texture.use(location=1)
        light.use()
        if channel in (None, FIRST_CHANNEL):
            light.clear()
        # A point whose centre lies outside the viewport is clipped entirely.
        light.viewport = (0, 0, *viewport_px)
        self._context.enable_only(moderngl.PROGRAM_POINT_SIZE)
        for group in self._groups:
            if group.parts not in _COMPILED_PARTS:
                group.program["parts"] = group.parts
            if channel is not None:
                cells = tuple(float(colour.channel_at(x, y) == channel) for y in (0, 1) for x in (0, 1))
                set_uniforms(group.program, is_drawn=cells)
            group.vertices.render(moderngl.POINTS, vertices=group.patches)
        self._context.enable_only(moderngl.NOTHING)
        light.viewport = (0, 0, *light.size)

    def _set_uniforms(self, sensor: Sensor, viewport_px: tuple[int, int], guard_band_px: int) -> None:
        oversampling, drawn_pixel_px = self._sampling(sensor)
        left, top, _, _ = self._bounds_px
        for program in {group.program for group in self._groups}:
            set_uniforms(
                program,
                light=0,
                occupancy=1,
                block_px=_BLOCK_PX,
                viewport_px=viewport_px,
                origin_px=(left - _SPLINE_SUPPORT_PX / oversampling, top - _SPLINE_SUPPORT_PX / oversampling),
                oversampling=oversampling,
                guard_band_px=guard_band_px,
                pixel_px2=_pixel_px2(sensor),
                drawn_pixel_px=drawn_pixel_px * oversampling,
            )

    def _group_for(self, sensor: Sensor, *, has_mosaic: bool) -> None:
        """Group the patches by the number of samples that their pixels take."""
        oversampling, drawn_pixel_px = self._sampling(sensor)
        key = (oversampling, sensor.pixel, drawn_pixel_px, has_mosaic)
        if self._grouped_for == key:
            return
        self._drop_groups()
        largest_px = np.sqrt(drawn_pixel_px**2 + _MAX_VARIANCE_EXCESS_PX2 / (PIXEL_VARIANCE_PX2 * key[0] ** 2))
        parts = np.ceil(max_pixel_sides_px(self._patches) / largest_px).clip(1, _MAX_PARTS).astype(np.intp)
        if sensor.pixel != "integrated":
            parts[:] = 1
        for across, down in np.unique(parts, axis=0).tolist():
            patches = self._patches[(parts == (across, down)).all(axis=1)]
            program = self._program_for((across, down), has_mosaic=has_mosaic)
            buffer = self._context.buffer(np.ascontiguousarray(patches))
            vertices = self._context.vertex_array(program, [(buffer, _PATCH_FORMAT, *_PATCH_NAMES)])
            self._groups.append(_PatchGroup((across, down), program, buffer, vertices, len(patches)))
        self._grouped_for = key

    def _program_for(self, parts: tuple[int, int], *, has_mosaic: bool) -> moderngl.Program:
        across, down = parts if parts in _COMPILED_PARTS else (0, 0)
        compiled = across, down, has_mosaic
        if compiled not in self._programs:
            self._programs[compiled] = linked(
                self._context,
                "warp.vert",
                "warp.frag",
                PARTS_ACROSS=across,
                PARTS_DOWN=down,
                MOSAIC=int(has_mosaic),
                SPLINE_SUPPORT_PX=_SPLINE_SUPPORT_PX,
            )
        return self._programs[compiled]

    def _drop_target(self) -> None:
        if self._target is not None:
            self._target.release()
            self._target = None

    def _drop_groups(self) -> None:
        for group in self._groups:
            group.vertices.release()
            group.buffer.release()
        self._groups.clear()
        self._grouped_for = None

    def release(self) -> None:
        """Release programs, buffers and targets."""
        self._drop_target()
        self._drop_groups()
        self.openings.release()
        for program in self._programs.values():
            program.release()
        self._programs.clear()
        self._all_blocks.release()
        self._occupancy.release()


def _pixel_px2(sensor: Sensor) -> float:
    """Return the variance of a pixel along a side, px^2: 0 if it does not integrate."""
    return PIXEL_VARIANCE_PX2 if sensor.pixel == "integrated" else 0.0


def _drawn_pixel_px(sensor: Sensor) -> float:
    """Return the usual side of the part of a pixel by whose variance stars are drawn wider, px."""
    core = sensor.core
    return _DRAWN_PIXEL_OF_NARROW_PX if core.psf_sigma_px < _NARROW_PX else _DRAWN_PIXEL_PX[core.needs_erf]
