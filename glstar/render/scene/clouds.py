"""Clouds over a scene: where lines of sight cross a sheet of cloud, and what it transmits of stars."""

from dataclasses import dataclass
from math import ceil

import numpy as np
from numpy.typing import ArrayLike

from glstar.arrays import Float
from glstar.camera.exposure import Exposure
from glstar.camera.sensor.sensor import Sensor
from glstar.flight import Flight
from glstar.render.motion.pointing import CameraMotion
from glstar.render.scene.transmission import Sources
from glstar.sky.air.clouds import CloudSheet, SheetCrossing

CLOUD_DEFAULTS: dict[str, float | int] = {
    "coverage": 0.0,
    "optical_depth": 2.0,
    "height_m": 4000.0,
    "scale_m": 2000.0,
    "edge": 1.0,
    "wind_m_s": 10.0,
    "wind_from_deg": 270.0,
    "seed": 0,
}
# The transmission is computed whenever the sheet has moved by this part of its smallest structures.
_STEP_CELLS = 0.125
# Lines of sight whose crossings are computed at once: more of them do not fit into the processor's cache.
_MOST_CROSSINGS = 8192
# Minimum and maximum number of times of an exposure at which it is computed.
_MIN_TIMES, _MAX_TIMES = 5, 513
# Grid of the origin of the sheet's coordinates, rad: it stays during a flight, also of a live one that drops its start.
_ORIGIN_RAD = np.pi / 180


def cloud_sheet(sensor: Sensor, motion: CameraMotion | None) -> CloudSheet | None:
    """Return the sheet of cloud over a flight, given the keys of ``[cloud]`` of a sensor; None without cloud."""
    keys = {name: sensor.effects.get(f"cloud.{name}", default) for name, default in CLOUD_DEFAULTS.items()}
    if motion is None or not keys["coverage"] or not keys["optical_depth"]:
        return None
    latitude_rad, longitude_rad = _origin_rad(motion.flight)
    wind_from_rad = float(np.deg2rad(float(keys.pop("wind_from_deg"))))
    seed = int(keys.pop("seed"))
    return CloudSheet(
        **{name: float(value) for name, value in keys.items()},
        seed=seed,
        wind_from_rad=wind_from_rad,
        latitude_rad=latitude_rad,
        longitude_rad=longitude_rad,
    )


def _origin_rad(flight: Flight) -> tuple[float, float]:
    """Return the origin of the sheet's coordinates: latitude and longitude of the start of a flight, rounded."""
    latitude_rad, longitude_rad, _ = flight.position.coordinates(np.array([flight.attitude.first_s]))
    latitude, longitude = (
        float(np.rint(angle_rad[0] / _ORIGIN_RAD) * _ORIGIN_RAD) for angle_rad in (latitude_rad, longitude_rad)
    )
    return latitude, longitude


def horizontal_axes(zenith_eq: Float, pole_eq: Float | None = None) -> tuple[Float, Float]:
    """Return unit vectors to the east and the north, (..., 3) each, true equator and equinox.

    `zenith_eq`, `pole_eq` (..., 3): unit vectors to the zenith and, if it is not (0, 0, 1), to the celestial pole: see
    `Pointing`.
    """
    if pole_eq is None:
        north = np.array([0.0, 0.0, 1.0]) - zenith_eq[..., 2:] * zenith_eq
    else:
        north = pole_eq - np.sum(pole_eq * zenith_eq, axis=-1, keepdims=True) * zenith_eq
    north /= np.linalg.norm(north, axis=-1, keepdims=True)
    return np.cross(north, zenith_eq), north


def sheet_crossing(
    sheet: CloudSheet,
    sine: Float,
    direction_eq: Float,
    zenith_eq: Float,
    site: tuple[float, float, float],
    utc_s: float,
) -> SheetCrossing:
    """Return where the lines of sight of directions cross a sheet.

    `sine` (...): sines of the apparent altitudes; `direction_eq` (..., 3), `zenith_eq` (3,): unit vectors, true equator
    and equinox; `site`: latitude and longitude, rad, and height, m.
    """
    east_eq, north_eq = horizontal_axes(zenith_eq)
    return _crossed(sheet, sine, direction_eq @ east_eq, direction_eq @ north_eq, site, utc_s)


def _crossed(
    sheet: CloudSheet,
    sine: Float,
    east: Float,
    north: Float,
    site: tuple[ArrayLike, ArrayLike, ArrayLike],
    utc_s: ArrayLike,
) -> SheetCrossing:
    length = np.maximum(np.hypot(east, north), 1e-12)
    return sheet.crossed(sine, east / length, north / length, site, utc_s)


@dataclass(frozen=True, slots=True, eq=False)
class CloudCover:
    """A sheet of cloud in front of stars during one exposure: an `Attenuator`."""

    sheet: CloudSheet
    motion: CameraMotion
    exposure: Exposure
    max_change: float = 0.04

    @property
    def min_times(self) -> int:
        """Number of times between which the sheet moves by a small part of its structures."""
        ends_s = np.array([self.exposure.start_utc_s, self.exposure.stop_utc_s])
        latitude_rad, longitude_rad, height_m = self.motion.flight.position.coordinates(ends_s)
        north_m = 6.4e6 * (latitude_rad[1] - latitude_rad[0])
        east_m = 6.4e6 * (longitude_rad[1] - longitude_rad[0]) * np.cos(latitude_rad[0])
        moved_m = float(np.linalg.norm([north_m, east_m, height_m[1] - height_m[0]]))
        moved_m += abs(self.sheet.wind_m_s) * float(ends_s[1] - ends_s[0])
        return int(np.clip(ceil(moved_m / (_STEP_CELLS * self.sheet.cell_m)) + 1, _MIN_TIMES, _MAX_TIMES))

    def fraction(self, sources: Sources, times: int) -> Float:
        """Return the transmission at a number of times, (times, m): 1 above the sheet, and below the horizon."""
        times_s = np.linspace(self.exposure.start_utc_s, self.exposure.stop_utc_s, times)
        (pointing,) = self.motion.pointings(times_s)
        site = self.motion.flight.position.coordinates(times_s)
        direction_eq = sources.direction_eq
        fraction = np.ones((len(times_s), len(direction_eq)))
        below = np.flatnonzero(site[2] < self.sheet.height_m)
        crossings = below.size * len(direction_eq)
        for block in np.array_split(below, ceil(crossings / _MOST_CROSSINGS)) if crossings else ():
            latitude_rad, longitude_rad, height_m, utc_s = (column[block, np.newaxis] for column in (*site, times_s))
            pole_eq = None if pointing.pole_eq is None else pointing.pole_eq[block]
            east_eq, north_eq = horizontal_axes(pointing.zenith_eq[block], pole_eq)
            fraction[block] = _crossed(
                self.sheet,
                pointing[block].sine_apparent_altitude(direction_eq),
                east_eq @ direction_eq.T,
                north_eq @ direction_eq.T,
                (latitude_rad, longitude_rad, height_m),
                utc_s,
            ).transmission
        return fraction
