"""One image from a pose, a time and a site: no flight log is needed.

>>> import glstar as gs  # doctest: +SKIP
>>> gs.render_frame(utc="2024-03-10T11:00:00Z", latitude_deg=-34.93, longitude_deg=138.6).save("zenith.png")
"""

from dataclasses import replace
from datetime import datetime
from math import radians
from typing import Required, TypedDict, Unpack

import numpy as np
from numpy.typing import ArrayLike, NDArray

from glstar.camera.model import Mount
from glstar.config.config import Config
from glstar.errors import ConfigError
from glstar.flight import AttitudeTrack, Flight, PositionTrack
from glstar.render.scene.scene import Frame, Renderer, Scene
from glstar.rotation import quaternion_from_euler
from glstar.sky.place.site import Site
from glstar.sky.place.timescale import parse_utc

# Roll, pitch and yaw of a camera with this mount are the roll, altitude and azimuth of its optical axis.
_CAMERA_ALONG_BODY_AXES = Mount(roll_rad=0.0, pitch_rad=0.0, yaw_rad=0.0)


class PoseOptions(TypedDict, total=False):
    """The keywords of `scene_at_pose`, for type checkers; `render_frame` describes them."""

    utc: Required[str | float | datetime]
    latitude_deg: Required[float]
    longitude_deg: Required[float]
    height_m: float
    azimuth_deg: float
    altitude_deg: float
    roll_deg: float
    q_body_ned: ArrayLike | None
    duration_s: float | None
    config: Config | None


def render_frame(*, seed: int = 0, renderer: Renderer | None = None, **pose: Unpack[PoseOptions]) -> Frame:
    """Return the image of a camera that keeps its pose during the exposure.

    Parameters
    ----------
    seed : int
        Seed of the noise, 0 to 2**32 - 1.
    renderer : Renderer, optional
        The renderer to use; it stays open.  By default an OpenGL context is made and released for this one image,
        which takes longer than the image.
    utc : str, float or datetime.datetime
        When the shutter opens: ISO 8601 (``"2024-03-10T11:00:00Z"``), UTC seconds since 1970, or a datetime.  A time
        without an offset is UTC.
    latitude_deg, longitude_deg : float
        WGS84, degrees; longitude is positive eastward.
    height_m : float, default 0
        Height above the WGS84 ellipsoid, m.
    azimuth_deg, altitude_deg : float, default 0 and 90
        Direction of the optical axis, degrees; azimuth from north through east.  The default is the zenith.
    roll_deg : float, default 0
        Rotation of the camera about its optical axis, degrees, clockwise as seen from behind the camera.  At 0 the
        zenith is up in the image (with the camera at the zenith, the azimuth + 180 deg is up).
    q_body_ned : (4,) array_like, optional
        Attitude of the aircraft instead of azimuth, altitude and roll: (w, x, y, z), NED to body.  The mount is then
        that of `config`.
    duration_s : float, optional
        Exposure time, s; by default that of `config`.
    config : Config, optional
        Camera, sensor, sky and air; by default ``Config()``, the bundled camera.

    Returns
    -------
    Frame

    Raises
    ------
    ConfigError
        If a setting is not valid.
    ContextError
        If OpenGL is not available.
    """
    scene = scene_at_pose(**pose)
    if renderer is not None:
        return renderer.render(scene, seed=seed)

    from glstar.render.opengl import GLRenderer  # noqa: PLC0415 - loads OpenGL, which a config does not need

    with GLRenderer.headless() as own_renderer:
        return own_renderer.render(scene, seed=seed)


def scene_at_pose(
    *,
    utc: str | float | datetime,
    latitude_deg: float,
    longitude_deg: float,
    height_m: float = 0.0,
    azimuth_deg: float = 0.0,
    altitude_deg: float = 90.0,
    roll_deg: float = 0.0,
    q_body_ned: ArrayLike | None = None,
    duration_s: float | None = None,
    config: Config | None = None,
) -> Scene:
    """Return the scene of a camera that keeps its pose during the exposure.

    `frame_truth` gives the ground truth of the scene and its frame.

    Parameters
    ----------
    utc, latitude_deg, longitude_deg, height_m, azimuth_deg, altitude_deg, roll_deg, q_body_ned, duration_s, config
        As for `render_frame`.

    Returns
    -------
    Scene

    Raises
    ------
    ConfigError
        If a setting is not valid.
    """
    config = Config() if config is None else config
    start_utc_s = _utc_s(utc)
    exposure = config.exposure.starting_at(start_utc_s, duration_s)
    site = Site(radians(latitude_deg), radians(longitude_deg), height_m)
    if q_body_ned is None:
        attitude = quaternion_from_euler(radians(roll_deg), radians(altitude_deg), radians(azimuth_deg))
    else:
        attitude = _unit_quaternion(q_body_ned)
    still = Flight(
        attitude=AttitudeTrack(np.array([start_utc_s, exposure.stop_utc_s]), np.stack([attitude, attitude])),
        position=PositionTrack.fixed(site),
        name="still camera",
    )
    simulator = config.simulator(still)
    if q_body_ned is None:
        simulator = replace(simulator, mount=_CAMERA_ALONG_BODY_AXES)
    return simulator.scene(exposure)


def _utc_s(utc: str | float | datetime) -> float:
    """Return a time as UTC seconds since 1970."""
    if isinstance(utc, str):
        return parse_utc(utc)
    return parse_utc(utc.isoformat()) if isinstance(utc, datetime) else float(utc)


def _unit_quaternion(q: ArrayLike) -> NDArray[np.float64]:
    """Return a quaternion normalized to unit length, (4,)."""
    quaternion = np.asarray(q, dtype=np.float64)
    length = np.linalg.norm(quaternion)
    if quaternion.shape != (4,) or not (np.isfinite(length) and length > 0):
        raise ConfigError(f"q_body_ned must be four finite numbers (w, x, y, z), not all 0; it is {q!r}")
    return np.asarray(quaternion / length)
