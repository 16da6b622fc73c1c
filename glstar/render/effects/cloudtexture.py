"""What a sheet of cloud transmits in the directions of pixels, in the middle of the exposure."""

from functools import lru_cache
from typing import Final

import numpy as np
from numpy.typing import NDArray

from glstar.camera.model import Camera
from glstar.render.clouds import cloud_sheet, sheet_crossing
from glstar.render.scene import Scene
from glstar.sky.cloudsheet import SheetCrossing

__all__ = ["axis_transmission", "crossing_at", "frame_transmission", "transmission_at"]

Float = NDArray[np.float64]

# Columns and rows at which the mean transmission of a frame is sampled.
_SAMPLES: Final = (49, 37)


def crossing_at(scene: Scene, time: int, direction_eq: Float) -> SheetCrossing | None:
    """Return where lines of sight cross the scene's sheet of cloud.

    Parameters
    ----------
    scene : Scene
    time : int
        0, 1, 2: the start, the middle, the end of the exposure.
    direction_eq : (..., 3) float64
        Apparent unit vectors, true equator and equinox, with refraction.

    Returns
    -------
    SheetCrossing or None
        None without cloud.
    """
    sheet = cloud_sheet(scene.sensor, scene.motion)
    if sheet is None or scene.motion is None:
        return None
    exposure = scene.exposure
    utc_s = (exposure.start_utc_s, exposure.mid_utc_s, exposure.stop_utc_s)[time]
    latitude_rad, longitude_rad, height_m = scene.motion.flight.position.coordinates(np.array([utc_s]))
    zenith = scene.shutter.zenith_eq[time]
    site = float(latitude_rad[0]), float(longitude_rad[0]), float(height_m[0])
    return sheet_crossing(sheet, direction_eq @ zenith, direction_eq, zenith, site, utc_s)


def transmission_at(scene: Scene, xy_px: Float) -> Float:
    """Return the transmission for the sky behind pixels, in the middle of the exposure.

    Parameters
    ----------
    scene : Scene
    xy_px : (..., 2) float64

    Returns
    -------
    (...) float64
        1 without cloud, below the horizon, and for a sheet below the aircraft.
    """
    rays = scene.camera.unproject(xy_px.reshape(-1, 2))
    return _transmission(scene, rays / np.linalg.norm(rays, axis=1, keepdims=True)).reshape(xy_px.shape[:-1])


def _transmission(scene: Scene, rays: Float) -> Float:
    direction = rays @ scene.shutter.C_camera_eq[1]
    crossing = crossing_at(scene, 1, direction)
    is_sky = direction @ scene.shutter.zenith_eq[1] >= scene.sine_horizon
    if crossing is None or not _is_above(scene):
        return np.ones(len(direction))
    return np.where(is_sky, crossing.transmission, 1.0)


def _is_above(scene: Scene) -> bool:
    """Return whether the sheet is above the aircraft."""
    sheet = cloud_sheet(scene.sensor, scene.motion)
    return sheet is not None and sheet.height_m > scene.site.height_m


def frame_transmission(scene: Scene) -> float | None:
    """Return the mean transmission of cloud over the part of the image that shows the sky.

    Parameters
    ----------
    scene : Scene

    Returns
    -------
    float or None
        In the middle of the exposure; 1 for a sheet below the aircraft, None if the image shows no sky.
    """
    rays = _rays(scene.camera)
    is_sky = rays @ scene.shutter.C_camera_eq[1] @ scene.shutter.zenith_eq[1] >= scene.sine_horizon
    return round(float(_transmission(scene, rays)[is_sky].mean()), 6) if is_sky.any() else None


def axis_transmission(scene: Scene) -> float:
    """Return the transmission of cloud on the optical axis in the middle of the exposure.

    Parameters
    ----------
    scene : Scene

    Returns
    -------
    float
        1 without cloud, below the horizon, and for a sheet below the aircraft.
    """
    return float(_transmission(scene, np.array([[0.0, 0.0, 1.0]]))[0])


@lru_cache(maxsize=4)
def _rays(camera: Camera) -> Float:
    """Return directions in the camera frame, evenly over the image, (n, 3) unit vectors."""
    columns, rows = _SAMPLES
    x = (np.arange(columns) + 0.5) / columns * camera.width_px - 0.5
    y = (np.arange(rows) + 0.5) / rows * camera.height_px - 0.5
    rays = camera.unproject(np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2))
    return np.asarray(rays / np.linalg.norm(rays, axis=1, keepdims=True))
