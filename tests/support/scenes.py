"""Scenes for tests: stars at given pixels, and the real sky over scripted flights."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from glstar.camera.exposure import Exposure
from glstar.camera.model import Camera, Mount
from glstar.camera.sensor.sensor import Sensor
from glstar.render.motion.pointing import Pointing
from glstar.render.motion.trailmodels import SubExposures
from glstar.render.scene.culling import DrawList
from glstar.render.scene.scene import Scene
from glstar.render.simulator import Simulator
from glstar.rotation import about_x, about_y
from glstar.sky.catalogue.reading import StarCatalogue
from glstar.sky.catalogue.starfield import StarField
from glstar.sky.observed.stars import Sky
from glstar.sky.place.site import Site
from glstar.sky.place.timescale import parse_utc
from glstar.telemetry.synthetic import ScriptedFlight

ADELAIDE = Site(np.deg2rad(-34.93), np.deg2rad(138.60), 50.0)
NIGHT_UTC_S = parse_utc("2024-03-10T11:00:00Z")


def camera(width_px: int = 320, height_px: int = 240, f_px: float = 300.0) -> Camera:
    return Camera(width_px, height_px, f_px, f_px, (width_px - 1) / 2, (height_px - 1) / 2)


def stars_at(
    xy_px: ArrayLike,
    vmag: ArrayLike,
    *,
    sensor: Sensor,
    lens: Camera,
    n: int = 100,
    turn: Callable[[NDArray[np.float64]], tuple[ArrayLike, ArrayLike]] = lambda u: (0 * u, 0 * u),
    duration_s: float = 0.5,
) -> Scene:
    """Return a scene of stars that are at given pixels in the middle of the exposure.

    `turn` gives the camera's angles about its y and its x axis, rad, for times from -1/2 to 1/2 of the exposure.
    There is no refraction, and the zenith is on the boresight.
    """
    xy, vmag = np.asarray(xy_px, dtype=np.float64), np.asarray(vmag, dtype=np.float64)
    rays = lens.unit_vectors(xy)
    field = StarField(
        catalogue="bsc5",
        star_id=np.arange(1, len(xy) + 1, dtype=np.int32),
        name=("",) * len(xy),
        vmag=vmag,
        direction_eq=rays,
        epoch_utc_s=0.0,
        C_eq_icrs=np.eye(3),
    )

    def pointing(u: NDArray[np.float64]) -> Pointing:
        about_y_rad, about_x_rad = turn(u)
        ahead = np.tile([0.0, 0.0, 1.0], (len(u), 1))
        return Pointing(about_x(about_x_rad) @ about_y(about_y_rad), ahead, 0 * ahead, 0.0)

    exposure = Exposure(0.0, duration_s, trail="sprites")
    return Scene(
        stars=field,
        draw_list=DrawList(
            np.arange(len(xy), dtype=np.int32), sensor.truncation_radius_px(sensor.peak_dn(vmag, duration_s))
        ),
        trails=SubExposures(pointing((np.arange(n) + 0.5) / n - 0.5)),
        camera=lens,
        sensor=sensor,
        exposure=exposure,
        site=ADELAIDE,
        C_camera_body=np.eye(3),
        q_body_ned=np.array([1.0, 0.0, 0.0, 0.0]),
        shutter=pointing(np.array([-0.5, 0.0, 0.5])),
    )


def turning(deg_per_s: float, duration_s: float = 0.5) -> Callable[[NDArray[np.float64]], tuple[ArrayLike, ArrayLike]]:
    """Return a rotation about an oblique axis for `stars_at`, deg/s at the centre of the image."""
    rate = np.deg2rad(deg_per_s) * duration_s
    return lambda u: (0.8 * rate * u, 0.6 * rate * u)


def sky_over_adelaide(
    lens: Camera,
    *,
    sensor: Sensor | None = None,
    mount: Mount | None = None,
    vmag_limit: float = 6.5,
    refraction: bool = True,
    duration_s: float = 10.0,
    **attitude: float,
) -> Simulator:
    """Return the bright stars over Adelaide at night from an aircraft that rotates uniformly for ten seconds."""
    flight = ScriptedFlight.steady(ADELAIDE, NIGHT_UTC_S, duration_s=duration_s, **attitude).flight()
    stars = StarCatalogue.open("bsc5").brighter_than(vmag_limit)
    return Simulator.of(flight, Sky(stars, refraction=refraction), lens, mount or Mount(), sensor or Sensor())


def star_field(direction_eq: NDArray[np.float64], vmag: NDArray[np.float64]) -> StarField:
    """Return stars without names, numbered from 1."""
    return StarField(
        catalogue="bsc5",
        star_id=np.arange(1, len(vmag) + 1, dtype=np.int32),
        name=("",) * len(vmag),
        vmag=vmag,
        direction_eq=direction_eq,
        epoch_utc_s=NIGHT_UTC_S,
        C_eq_icrs=np.eye(3),
    )


def with_stars_at(simulator: Simulator, xy_px: ArrayLike, vmag: ArrayLike, utc_s: float) -> Simulator:
    """Return a simulator without refraction whose stars are at given pixels at one time."""
    pointing = simulator.pointing(np.array([utc_s]))
    rays = simulator.camera.unit_vectors(xy_px)
    stars = star_field(rays @ pointing.C_camera_eq[0] - pointing.velocity_eq[0], np.asarray(vmag, dtype=np.float64))
    return replace(simulator, stars=stars, sky=replace(simulator.sky, refraction=False))
