"""Widths of the border around an image from which stars contribute with a part of their sprite."""

from typing import NamedTuple

import moderngl
import numpy as np

from glstar.camera.model import Camera
from glstar.camera.sensor import Sensor
from glstar.errors import RenderError
from glstar.render.scene import Scene

__all__ = ["GuardBands"]


class GuardBands:
    """Widths of guard bands; that of the previous scene is kept, because a flight's scenes have the same sensor.

    Parameters
    ----------
    context : moderngl.Context
        Its driver limits the size of images.
    """

    def __init__(self, context: moderngl.Context) -> None:
        self._texture_size_px = int(context.info["GL_MAX_TEXTURE_SIZE"])
        self._last: _Known | None = None

    def of(self, scene: Scene) -> int:
        """Return the width of the guard band around a pinhole's image.

        Parameters
        ----------
        scene : Scene

        Returns
        -------
        int
            px, for the brightest star, whether visible or not.

        Raises
        ------
        RenderError
            If the image is larger than the driver draws.
        """
        largest = _largest(scene)
        known = self._last
        if (
            known is None
            or known.sensor is not scene.sensor
            or known.depends_on != (scene.exposure.duration_s, *largest)
        ):
            depends_on = scene.exposure.duration_s, *largest
            self._last = known = _Known(scene.sensor, depends_on, _wide_guard_band_px(scene, *largest))
        _refuse_large_image(scene.camera, known.guard_band_px, self._texture_size_px)
        return known.guard_band_px


class _Known(NamedTuple):
    """The guard band of a sensor; it depends on the exposure time and on what `_largest` returns."""

    sensor: Sensor
    depends_on: tuple[float, float, float]
    guard_band_px: int


def _largest(scene: Scene) -> tuple[float, float]:
    """Return the largest truncation radius, px, and the brightest magnitude of all that a scene draws."""
    fields = [scene, *([] if scene.body_scene is None else [scene.body_scene]), *scene.satellites]
    radius_px = max(float(field.draw_list.truncation_radius_px.max(initial=0.0)) for field in fields)
    return radius_px, min(float(field.stars.camera_mag.min(initial=np.inf)) for field in fields)


def _wide_guard_band_px(scene: Scene, radius_px: float, brightest_mag: float) -> int:
    """Return a width for the brightest star, whether visible or not.

    It is a multiple of 8 px: neither playback nor a slider creates new targets for every image.
    """
    brightest_dn = scene.sensor.peak_dn(brightest_mag, scene.exposure.duration_s)
    return 8 * int(np.ceil((max(radius_px, float(scene.sensor.truncation_radius_px(brightest_dn))) + 1) / 8))


def _refuse_large_image(camera: Camera, guard_band_px: int, texture_size_px: int) -> None:
    """Raise if an image with its guard band is larger than the driver draws."""
    if max(camera.width_px, camera.height_px) + 2 * guard_band_px > texture_size_px:
        raise RenderError(
            f"an image of {camera.width_px} x {camera.height_px} px is larger than this driver draws:"
            f" at most {texture_size_px - 2 * guard_band_px} px per side"
        )
