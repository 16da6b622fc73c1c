"""Clouds over a scene: the transmission of a sheet of cloud for stars during an exposure, and for pixels."""

from dataclasses import dataclass
from functools import lru_cache
from math import ceil
from typing import Final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from glstar.camera.exposure import Exposure
from glstar.camera.sensor.sensor import Sensor
from glstar.flight import Flight
from glstar.render.motion.pointing import CameraMotion
from glstar.sky.air.clouds import CloudSheet, SheetCrossing

Float = NDArray[np.float64]

CLOUD_DEFAULTS: Final[dict[str, float | int]] = {
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
_STEP_CELLS: Final = 0.125
# Lines of sight whose crossings are computed at once: more of them fall out of the processor's cache.
_MOST_CROSSINGS: Final = 8192
# Times of an exposure at which it is computed, at least and at most.
_MIN_TIMES, _MAX_TIMES = 5, 513
# Grid of the origin of the sheet's coordinates, rad: it stays during a flight, also of a live one that drops its start.
_ORIGIN_RAD: Final = np.pi / 180


def cloud_sheet(sensor: Sensor, motion: CameraMotion | None) -> CloudSheet | None:
    """Return the sheet of cloud over a flight.

    `sensor`: with the keys of ``[cloud]`` in its effects; `motion`: of the flight.  Returns: none without cloud.
    """
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


# Each frame asks a dozen times; one flight is kept, because flights are large.
@lru_cache(maxsize=1)
def _origin_rad(flight: Flight) -> tuple[float, float]:
    """Return the origin of the sheet's coordinates: latitude and longitude of the start of a flight, rounded."""
    latitude_rad, longitude_rad, _ = flight.position.coordinates(np.array([flight.attitude.first_s]))
    latitude, longitude = (float(np.rint(of[0] / _ORIGIN_RAD) * _ORIGIN_RAD) for of in (latitude_rad, longitude_rad))
    return latitude, longitude


def horizontal_axes(zenith_eq: Float, pole_eq: Float | None = None) -> tuple[Float, Float]:
    """Return unit vectors to the east and the north.

    `zenith_eq` (..., 3): unit vectors to the zenith, true equator and equinox; `pole_eq` (..., 3) or None: unit vectors
    to the celestial pole, if it is not (0, 0, 1): see `Pointing`.  Returns `east_eq, north_eq` (..., 3).
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

    `sine` (...): sines of the apparent altitudes; `direction_eq` (..., 3): unit vectors, true equator and equinox;
    `zenith_eq` (3,); `site`: latitude and longitude, rad, and height, m.
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
class CloudPassage:
    """The transmission of a sheet of cloud for m stars over an exposure."""

    transmission: Float  # (n, m) at n equidistant times from the start to the end of the exposure, linear between them

    def at(self, time: Float) -> Float:
        """Return the transmission at some elapsed fractions of the exposure, (k,), as (k, m)."""
        position = np.clip(time, 0.0, 1.0) * (len(self.transmission) - 1)
        before = np.minimum(position.astype(np.intp), len(self.transmission) - 2)
        part = (position - before)[:, np.newaxis]
        return np.asarray((1 - part) * self.transmission[before] + part * self.transmission[before + 1])

    def means(self, time_fraction: Float) -> Float:
        """Return the mean transmission of consecutive parts of the exposure.

        `time_fraction` (s,): their durations; they add up to 1.  Returns (s, m).
        """
        ends = np.concatenate([[0.0], np.cumsum(time_fraction)])
        ends /= ends[-1]
        integral = self._integral(ends)
        return np.asarray(np.diff(integral, axis=0) / np.diff(ends)[:, np.newaxis])

    @property
    def mean(self) -> Float:
        """The mean transmission of the exposure, (m,)."""
        return np.asarray(self.means(np.ones(1))[0])

    def _integral(self, time: Float) -> Float:
        """Return the integral of the transmission from the start to some times, (k, m)."""
        steps = len(self.transmission) - 1
        each = (self.transmission[1:] + self.transmission[:-1]) / (2 * steps)
        before_all = np.concatenate([np.zeros((1, each.shape[1])), np.cumsum(each, axis=0)])
        position = np.clip(time, 0.0, 1.0) * steps
        before = np.minimum(position.astype(np.intp), steps - 1)
        part = (position - before)[:, np.newaxis]
        slope = self.transmission[before + 1] - self.transmission[before]
        return np.asarray(before_all[before] + part * (self.transmission[before] + part * slope / 2) / steps)


def cloud_passage(
    sheet: CloudSheet, motion: CameraMotion, exposure: Exposure, direction_eq: Float, least_times: int = 0
) -> CloudPassage:
    """Return what a sheet of cloud transmits of stars over an exposure.

    `motion`: of the flight; `exposure`: a single one; `direction_eq` (m, 3): geocentric apparent unit vectors, true
    equator and equinox; `least_times`: number of times of the exposure at least.  Returns: all 1 for a sheet below the
    aircraft, and below the horizon.
    """
    ends_s = np.array([exposure.start_utc_s, exposure.stop_utc_s])
    times_s = np.linspace(ends_s[0], ends_s[1], max(least_times, _count(sheet, motion, ends_s)))
    (pointing,) = motion.pointings(times_s)
    site = motion.flight.position.coordinates(times_s)
    transmission = np.ones((len(times_s), len(direction_eq)))
    below = np.flatnonzero(site[2] < sheet.height_m)
    crossings = below.size * len(direction_eq)
    for some in np.array_split(below, ceil(crossings / _MOST_CROSSINGS)) if crossings else ():
        latitude_rad, longitude_rad, height_m, utc_s = (of[some, np.newaxis] for of in (*site, times_s))
        pole_eq = None if pointing.pole_eq is None else pointing.pole_eq[some]
        east_eq, north_eq = horizontal_axes(pointing.zenith_eq[some], pole_eq)
        transmission[some] = _crossed(
            sheet,
            pointing[some].sine_apparent_altitude(direction_eq),
            east_eq @ direction_eq.T,
            north_eq @ direction_eq.T,
            (latitude_rad, longitude_rad, height_m),
            utc_s,
        ).transmission
    return CloudPassage(transmission)


def _count(sheet: CloudSheet, motion: CameraMotion, ends_s: Float) -> int:
    """Return the number of times, so that the sheet moves by a small part of its structures between them."""
    latitude_rad, longitude_rad, height_m = motion.flight.position.coordinates(ends_s)
    north_m = 6.4e6 * (latitude_rad[1] - latitude_rad[0])
    east_m = 6.4e6 * (longitude_rad[1] - longitude_rad[0]) * np.cos(latitude_rad[0])
    moved_m = float(np.linalg.norm([north_m, east_m, height_m[1] - height_m[0]]))
    moved_m += abs(sheet.wind_m_s) * float(ends_s[1] - ends_s[0])
    return int(np.clip(ceil(moved_m / (_STEP_CELLS * sheet.cell_m)) + 1, _MIN_TIMES, _MAX_TIMES))
