"""Cloud: keys of a sheet through which stars and the natural sky are seen, and its transmission towards pixels."""

from functools import lru_cache

import numpy as np

from glstar.arrays import Float
from glstar.camera.model import Camera
from glstar.render.effects.effect import Control, Effect, Key, Stage
from glstar.render.scene.clouds import CLOUD_DEFAULTS, cloud_sheet, sheet_crossing
from glstar.render.scene.scene import Scene
from glstar.sky.air.clouds import SheetCrossing

# Columns and rows at which the mean transmission of a frame is sampled.
_SAMPLES = (49, 37)


def crossing_at(scene: Scene, time: int, direction_eq: Float) -> SheetCrossing | None:
    """Return where lines of sight cross the scene's sheet of cloud; None without cloud.

    `time` is 0, 1 or 2 for the start, the middle or the end of the exposure; `direction_eq` (..., 3) are apparent unit
    vectors, true equator and equinox, with refraction.
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
    """Return the transmission for the sky behind pixels, (..., 2), in the middle of the exposure, (...).

    It is 1 without cloud, below the horizon, and for a sheet below the aircraft.
    """
    rays = scene.camera.unit_vectors(xy_px.reshape(-1, 2))
    return _transmission(scene, rays).reshape(xy_px.shape[:-1])


def _transmission(scene: Scene, rays: Float) -> Float:
    direction = rays @ scene.shutter.C_camera_eq[1]
    is_sky = scene.above_horizon(direction) >= 0
    return np.where(is_sky, transmission_towards(scene, direction), 1.0)


def transmission_towards(scene: Scene, direction_eq: Float) -> Float:
    """Return the transmission in directions above the horizon, (n,), in the middle of the exposure.

    `direction_eq` (n, 3) are apparent unit vectors, true equator and equinox, with refraction.  The transmission is 1
    without cloud, and for a sheet below the aircraft.
    """
    crossing = crossing_at(scene, 1, direction_eq) if is_below_cloud(scene) else None
    return np.ones(len(direction_eq)) if crossing is None else crossing.transmission


def is_below_cloud(scene: Scene) -> bool:
    """Return whether there is a sheet of cloud above the aircraft."""
    sheet = cloud_sheet(scene.sensor, scene.motion)
    return sheet is not None and sheet.height_m > scene.site.height_m


def frame_transmission(scene: Scene) -> float | None:
    """Return the mean transmission of cloud over the sky on the image, in the middle of the exposure.

    It is 1 for a sheet below the aircraft, and None if the image shows no sky.
    """
    rays = _rays(scene.camera)
    is_sky = scene.above_horizon(rays @ scene.shutter.C_camera_eq[1]) >= 0
    return round(float(_transmission(scene, rays)[is_sky].mean()), 6) if is_sky.any() else None


def sky_fraction(scene: Scene) -> float:
    """Return the fraction of the image that shows the sky in the middle of the exposure, to about 1 %."""
    is_sky = scene.above_horizon(_rays(scene.camera) @ scene.shutter.C_camera_eq[1]) >= 0
    return round(float(is_sky.mean()), 4)


def axis_transmission(scene: Scene) -> float:
    """Return the transmission of cloud on the optical axis in the middle of the exposure.

    It is 1 without cloud, below the horizon, and for a sheet below the aircraft.
    """
    return float(_transmission(scene, np.array([[0.0, 0.0, 1.0]]))[0])


@lru_cache(maxsize=4)
def _rays(camera: Camera) -> Float:
    """Return directions in the camera frame, evenly over the image, (n, 3) unit vectors."""
    columns, rows = _SAMPLES
    x = (np.arange(columns) + 0.5) / columns * camera.width_px - 0.5
    y = (np.arange(rows) + 0.5) / rows * camera.height_px - 0.5
    return camera.unit_vectors(np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2))


def _key(
    name: str,
    allowed: str,
    minimum: float | None = None,
    maximum: float | None = None,
    control: Control | None = None,
) -> Key:
    return Key(name, CLOUD_DEFAULTS[name], allowed, control, minimum, maximum, changes_light=True)


CLOUD = Effect(
    name="cloud",
    section="cloud",
    keys=(
        _key("coverage", "a fraction from 0 to 1; 0 is no cloud", 0.0, 1.0, Control("Cloud cover", 0.0, 1.0, "%.2f")),
        _key("optical_depth", "a number from 0 to 5", 0.0, 5.0, Control("Cloud optical depth", 0.0, 5.0, "%.2f")),
        _key("height_m", "a height from 0 to 20000 m", 0.0, 2e4, Control("Cloud height", 0.0, 12000.0, "%.0f m")),
        _key(
            "scale_m",
            "a size from 10 to 100000 m",
            10.0,
            1e5,
            Control("Cloud size", 100.0, 10000.0, "%.0f m", logarithmic=True),
        ),
        _key("edge", "a width from 0.01 to 10", 0.01, 10.0),
        _key("wind_m_s", "a speed from 0 to 150 m/s", 0.0, 150.0, Control("Wind in the cloud", 0.0, 60.0, "%.0f m/s")),
        _key("wind_from_deg", "an azimuth in degrees"),
        _key("seed", "a whole number, 0 or more", 0),
    ),
    stage=Stage.STARS,
    truth=lambda _values, scene: {"cloud_transmission": frame_transmission(scene)},
    is_active=lambda values: bool(values["coverage"] and values["optical_depth"]),
    glsl="",
)
