"""Horizontal coordinates (hour angle, azimuth, altitude), the dip of the horizon, and horizon profiles from CSV files.

Tables and labels use the angles of eqs (22)-(29).  The renderer does the same calculation with vectors, by `C_ned_eq`
and `glstar.sky.air.refraction.refraction_displacement`, without asin and tan.
"""

import csv
import io
import textwrap
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache
from math import acos, cos, radians, sin, sqrt
from os import PathLike
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from glstar.arrays import Float
from glstar.errors import ConfigError, reading
from glstar.system.userinput import is_number, read_text

_EARTH_ROTATION_RAD_PER_S = 7.292115e-5
_WGS84_A_M = 6378137.0
_WGS84_F = 1 / 298.257223563
_LIGHT_M_PER_S = 299792458.0
_EARTH_RADIUS_M = 6371000.0
# Curvature of a nearly horizontal ray over that of the Earth.
_RAY_CURVATURE = 1 / 7

_KEY = "sky.horizon"
_COLUMNS = ("azimuth_deg", "altitude_deg")
# A point for every arcsecond has 30 MB.
_LARGEST_BYTES = 64 << 20
# Altitudes, deg: the lowest is below the dip of the horizon at any height of an aircraft.
_ALTITUDES_DEG = (-10.0, 80.0)


def hour_angle_rad(local_sidereal_time_rad: ArrayLike, ra_rad: ArrayLike) -> Float:
    """Return hour angles, -pi to pi, positive west of the meridian, (...): Teague & Chahl, eq. (22).

    `local_sidereal_time_rad`, `ra_rad` (...): local apparent sidereal time and apparent right ascension.
    """
    angle = np.asarray(local_sidereal_time_rad, dtype=np.float64) - np.asarray(ra_rad, dtype=np.float64)
    return (angle + np.pi) % (2 * np.pi) - np.pi


def azimuth_altitude_rad(hour_angle_rad: ArrayLike, dec_rad: ArrayLike, latitude_rad: float) -> tuple[Float, Float]:
    """Return azimuth and altitude, without refraction.

    `hour_angle_rad`, `dec_rad` (...): hour angle and apparent declination; `latitude_rad`: geodetic latitude.  Returns
    azimuths from north through east, 0 to 2 pi, and altitudes, (...) each.

    Teague & Chahl, eqs (23), (24); Meeus, eqs (13.5), (13.6).  Departs from eq. (24), printed with five arguments:
    azimuth = atan2(sin w, cos w sin phi - tan dec cos phi) + pi, both arguments multiplied by cos dec so that the
    azimuth of the celestial pole is defined.  Departs from eq. (23), whose asin loses digits near the zenith.
    """
    w, dec = np.asarray(hour_angle_rad, dtype=np.float64), np.asarray(dec_rad, dtype=np.float64)
    north = np.sin(dec) * cos(latitude_rad) - np.cos(dec) * np.cos(w) * sin(latitude_rad)
    east = -np.cos(dec) * np.sin(w)
    up = np.sin(dec) * sin(latitude_rad) + np.cos(dec) * np.cos(w) * cos(latitude_rad)
    return np.arctan2(east, north) % (2 * np.pi), np.arctan2(up, np.hypot(north, east))


def ned_direction(azimuth_rad: ArrayLike, altitude_rad: ArrayLike) -> Float:
    """Return unit vectors north, east, down, (..., 3), of azimuths and altitudes: Teague & Chahl, eq. (29)."""
    azimuth, altitude = np.broadcast_arrays(
        np.asarray(azimuth_rad, dtype=np.float64), np.asarray(altitude_rad, dtype=np.float64)
    )
    return np.stack(
        [np.cos(azimuth) * np.cos(altitude), np.sin(azimuth) * np.cos(altitude), -np.sin(altitude)], axis=-1
    )


def ned_to_azimuth_altitude_rad(direction_ned: ArrayLike) -> tuple[Float, Float]:
    """Return azimuths, 0 to 2 pi, and altitudes of vectors north, east, down of any length, (..., 3)."""
    north, east, down = np.moveaxis(np.asarray(direction_ned, dtype=np.float64), -1, 0)
    return np.arctan2(east, north) % (2 * np.pi), np.arctan2(-down, np.hypot(north, east))


def C_ned_eq(latitude_rad: ArrayLike, local_sidereal_time_rad: ArrayLike) -> Float:
    """Return the matrices, (..., 3, 3), from the true equator and equinox of date to north, east, down.

    `latitude_rad`, `local_sidereal_time_rad` (...): geodetic latitude and local apparent sidereal time.  Teague &
    Chahl, eqs (22)-(24) and (29) in one matrix.
    """
    latitude, sidereal = np.asarray(latitude_rad, dtype=np.float64), np.asarray(local_sidereal_time_rad, np.float64)
    sin_lat, cos_lat, sin_lst, cos_lst = np.sin(latitude), np.cos(latitude), np.sin(sidereal), np.cos(sidereal)
    C = np.empty((*np.broadcast_shapes(latitude.shape, sidereal.shape), 3, 3))
    north, east, down = C[..., 0, :], C[..., 1, :], C[..., 2, :]
    north[..., 0], north[..., 1], north[..., 2] = -sin_lat * cos_lst, -sin_lat * sin_lst, cos_lat
    east[..., 0], east[..., 1], east[..., 2] = -sin_lst, cos_lst, 0.0
    down[..., 0], down[..., 1], down[..., 2] = -(cos_lat * cos_lst), -(cos_lat * sin_lst), -sin_lat
    return C


def diurnal_aberration_rad(latitude_rad: float, height_m: float = 0.0) -> float:
    """Return the observer's eastward speed in units of the speed of light; diurnal aberration adds it to unit vectors.

    0.32" at the equator.  `latitude_rad`: geodetic latitude; `height_m`: height above the WGS84 ellipsoid.  Not in the
    paper: it is half of the difference between the paper's corrected formulae and ERFA.
    """
    flattened = 1 - _WGS84_F * (2 - _WGS84_F) * sin(latitude_rad) ** 2
    from_axis_m = (_WGS84_A_M / sqrt(flattened) + height_m) * cos(latitude_rad)
    return _EARTH_ROTATION_RAD_PER_S * from_axis_m / _LIGHT_M_PER_S


def with_diurnal_aberration(direction_ned: ArrayLike, latitude_rad: float, height_m: float) -> Float:
    """Return the vectors, (..., 3) north, east, down, along which an observer on the turning Earth sees.

    `direction_ned` (..., 3): unit vectors without diurnal aberration; `latitude_rad`, `height_m`: the observer.
    """
    towards_east = np.array([0.0, diurnal_aberration_rad(latitude_rad, height_m), 0.0])
    return np.asarray(np.asarray(direction_ned, dtype=np.float64) + towards_east)


def dip_rad(height_m: float) -> float:
    """Return the dip of the sea's horizon below the horizontal, with refraction: 1.63 deg at 3 km, 0 below the sea.

    acos(R / (R + h)) times sqrt(1 - 1/7): a ray near the ground is curved by a seventh of the Earth's curvature.
    """
    return acos(_EARTH_RADIUS_M / (_EARTH_RADIUS_M + max(height_m, 0.0))) * sqrt(1 - _RAY_CURVATURE)


@dataclass(frozen=True)
class HorizonProfile:
    """The apparent altitude of the horizon by azimuth, linear between points and continued through north."""

    azimuths_rad: tuple[float, ...]  # from north through east, ascending, 0 to 2 pi
    altitudes_rad: tuple[float, ...]  # apparent altitudes at these azimuths

    @staticmethod
    def open(path: str | PathLike[str]) -> "HorizonProfile":
        """Read a profile from a CSV file.

        `path`: two columns, ascending azimuths from 0 to 360 and altitudes, in degrees; the first line may name the
        columns; empty lines and lines that begin with ``#`` are ignored.  Raises ConfigError if the file cannot be
        read, or is no such table.
        """
        file = Path(path)
        with reading(file, _refusal):
            state = file.stat()
            return _read(file, state.st_mtime_ns, state.st_size)

    @cached_property
    def _nodes_rad(self) -> tuple[Float, Float]:
        """Azimuths and altitudes of the points, and of the last and the first one turn before and after, rad."""
        azimuth, altitude = np.array(self.azimuths_rad), np.array(self.altitudes_rad)
        around = np.concatenate([[azimuth[-1] - 2 * np.pi], azimuth, [azimuth[0] + 2 * np.pi]])
        return around, np.concatenate([altitude[-1:], altitude, altitude[:1]])

    @property
    def lowest_rad(self) -> float:
        """The lowest altitude, rad."""
        return min(self.altitudes_rad)

    @property
    def highest_rad(self) -> float:
        """The highest altitude, rad."""
        return max(self.altitudes_rad)

    def altitude_rad(self, azimuth_rad: ArrayLike) -> Float:
        """Return the apparent altitudes of the horizon, (...), at azimuths of any turn, (...)."""
        turned = np.mod(np.asarray(azimuth_rad, dtype=np.float64), 2 * np.pi)
        return np.asarray(np.interp(turned, *self._nodes_rad))


def _refusal(file: Path, message: str) -> ConfigError:
    return ConfigError(f"{file} {message}", key=_KEY)


# A profile is needed again for every change of a setting.
@lru_cache(maxsize=8)
def _read(file: Path, _changed_ns: int, _size: int) -> HorizonProfile:
    """Return the profile in a file; the last parameters distinguish its versions."""
    lines = csv.reader(io.StringIO(read_text(file, _LARGEST_BYTES), newline=""))
    rows = [(number, row) for number, row in enumerate(lines, 1) if any(cell.strip() for cell in row)]
    rows = [(number, row) for number, row in rows if not row[0].lstrip().startswith("#")]
    if rows and not is_number(rows[0][1][0]):
        _check_header(file, rows.pop(0)[1])
    points = [_point(file, number, row) for number, row in rows]
    if len(points) < 2:
        raise ConfigError(f"{file} has {len(points)} points; a horizon profile needs two or more", key=_KEY)
    for (_, row), (azimuth_deg, _), (next_deg, _) in zip(rows[1:], points, points[1:], strict=False):
        if next_deg <= azimuth_deg:
            raise ConfigError(f"{file}: azimuths must ascend, but {row[0].strip()} follows {azimuth_deg:g}", key=_KEY)
    azimuths_deg, altitudes_deg = zip(*points, strict=True)
    if azimuths_deg[-1] - azimuths_deg[0] == 360:
        if altitudes_deg[0] != altitudes_deg[-1]:
            raise ConfigError(f"{file}: azimuths 0 and 360 are north, but their altitudes differ", key=_KEY)
        azimuths_deg, altitudes_deg = azimuths_deg[:-1], altitudes_deg[:-1]
    return HorizonProfile(tuple(map(radians, azimuths_deg)), tuple(map(radians, altitudes_deg)))


def _check_header(file: Path, names: Sequence[str]) -> None:
    columns = tuple(name.strip() for name in names)
    if columns != _COLUMNS:
        found = textwrap.shorten(", ".join(columns), 100, placeholder=" ...")
        raise ConfigError(f"{file} has columns {found}; they must be {', '.join(_COLUMNS)}", key=_KEY)


def _point(file: Path, number: int, row: Sequence[str]) -> tuple[float, float]:
    """Return azimuth and altitude of a line, deg."""
    if len(row) != 2 or not all(map(is_number, row)):
        raise ConfigError(f"{file}, line {number}: must be an azimuth and an altitude in degrees", key=_KEY)
    azimuth_deg, altitude_deg = map(float, row)
    lowest_deg, highest_deg = _ALTITUDES_DEG
    if not 0 <= azimuth_deg <= 360:
        raise ConfigError(f"{file}, line {number}: azimuth {azimuth_deg:g} is not from 0 to 360", key=_KEY)
    if not lowest_deg <= altitude_deg <= highest_deg:
        allowed = f"from {lowest_deg:g} to {highest_deg:g}"
        raise ConfigError(f"{file}, line {number}: altitude {altitude_deg:g} is not {allowed}", key=_KEY)
    return azimuth_deg, altitude_deg
