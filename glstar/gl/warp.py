"""Light behind a lens: summed as a pinhole has it, then gathered by the pixels that the lens gives it to."""

from dataclasses import replace
from functools import lru_cache
from math import ceil
from typing import Final

import moderngl
import numpy as np
from numpy.typing import NDArray

from glstar.camera import Camera
from glstar.errors import RenderError
from glstar.gl.program import linked, set_uniforms
from glstar.scene import Scene
from glstar.sensor import Sensor

__all__ = ["PinholeLight", "Warp"]

Float = NDArray[np.float64]

# A cubic B-spline widens what it goes through by this, px^2.
_SPLINE_VARIANCE_PX2: Final = 1 / 3
# Stars are drawn no narrower than this, px: from there on a spline through a Gaussian's pixels is a Gaussian.
_NARROWEST_PX: Final = 1.0
# A pixel that integrates is asked at so many places along each side, at the least and at the most.
_SAMPLES: Final = (2, 24)
# A third to a half pixel of the pinhole's light apart, they leave this of a pixel's variance, px^2.
_UNSAMPLED_PX2: Final = 0.015
# Light is looked for in blocks of so many pixels of the pinhole's light a side, and gathered in tiles of the image of
# so many.
_BLOCK_PX: Final = 8
_TILE_PX: Final = 8
# The spline reaches so far, px of the pinhole's light.
_SPLINE_REACH_PX: Final = 3
_NOWHERE_PX: Final = 1e9
_BLOCK_ROWS: Final = 256


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
        shift_px, self._bounds_px = _shifts(camera)
        self._program = linked(context, "warp.vert", "warp.frag")
        self._tiles = context.vertex_array(self._program, [])
        self._lighting = linked(context, "develop.vert", "lit.frag")
        self._all_blocks = context.vertex_array(self._lighting, [])
        self._shift = context.texture(shift_px.shape[1::-1], 2, np.ascontiguousarray(shift_px), dtype="f4")
        self._shift.filter = moderngl.NEAREST, moderngl.NEAREST
        self._context = context
        self._light: PinholeLight | None = None

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
        narrowest = np.sqrt(_NARROWEST_PX**2 + _SPLINE_VARIANCE_PX2)
        return max(self.camera.stretch, float(narrowest / sensor.psf_sigma_px))

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
        unsampled_px2 = _UNSAMPLED_PX2 if scene.sensor.pixel == "integrated" else 0.0
        drawn_px = np.sqrt((finer * sigma_px) ** 2 + unsampled_px2 - _SPLINE_VARIANCE_PX2)
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
        least, most = _SAMPLES if scene.sensor.pixel == "integrated" else (1, 1)
        left, top, _, _ = self._bounds_px
        set_uniforms(
            self._program,
            light=0,
            shift_px=1,
            lit=2,
            block_px=_BLOCK_PX,
            tile_px=_TILE_PX,
            image_px=(self.camera.width_px, self.camera.height_px),
            origin_px=(left - _SPLINE_REACH_PX / finer, top - _SPLINE_REACH_PX / finer),
            finer=finer,
            apron_px=self._light.apron_px,
            least_samples=least,
            most_samples=most,
        )
        self._context.enable_only(moderngl.NOTHING)
        self._light.light_texture.use(location=0)
        set_uniforms(self._lighting, light=0, block_px=_BLOCK_PX)
        self._light.lit.use()
        self._all_blocks.render(moderngl.TRIANGLES, vertices=3)
        self._shift.use(location=1)
        self._light.lit_texture.use(location=2)
        target.use()
        target.clear()
        tiles = -(-self.camera.width_px // _TILE_PX) * -(-self.camera.height_px // _TILE_PX)
        self._tiles.render(moderngl.TRIANGLE_STRIP, vertices=4, instances=tiles)

    def _drop_light(self) -> None:
        if self._light is not None:
            self._light.release()
            self._light = None

    def release(self) -> None:
        """Give all of it back."""
        self._drop_light()
        for resource in (self._all_blocks, self._lighting, self._tiles, self._program, self._shift):
            resource.release()


@lru_cache(maxsize=2)
def _shifts(camera: Camera) -> tuple[NDArray[np.float32], tuple[float, float, float, float]]:
    """Return by how much the corners of pixels are elsewhere in the pinhole's plane, and the part of it that is seen.

    Shifts, (height + 1, width + 1, 2) float32 px, are small, and keep their digits where places would lose them.
    """
    shift_px = np.empty((camera.height_px + 1, camera.width_px + 1, 2), np.float32)
    low, high = np.full(2, np.inf), np.full(2, -np.inf)
    for top in range(0, camera.height_px + 1, _BLOCK_ROWS):
        rows, columns = np.mgrid[top : min(top + _BLOCK_ROWS, camera.height_px + 1), : camera.width_px + 1]
        corners = np.stack([columns, rows], axis=-1) - 0.5
        straight = camera.pinhole.project(camera.unproject(corners))
        if np.isfinite(straight).any():
            low = np.fmin(low, np.nanmin(straight, axis=(0, 1)))
            high = np.fmax(high, np.nanmax(straight, axis=(0, 1)))
        shift_px[top : top + _BLOCK_ROWS] = straight - corners
    if not np.isfinite(low).all():
        raise RenderError("no light comes through this camera's lens onto its image; check its coefficients")
    np.nan_to_num(shift_px, copy=False, nan=_NOWHERE_PX)
    shift_px.setflags(write=False)
    return shift_px, (float(low[0]), float(low[1]), float(high[0]), float(high[1]))
