"""Horizon profiles: the apparent altitude of mountains, trees or buildings by azimuth, from a CSV file."""

import csv
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache
from math import radians
from os import PathLike
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from glstar.errors import ConfigError
from glstar.system.inputfile import is_number

__all__ = ["HorizonProfile"]

Float = NDArray[np.float64]

_KEY: Final = "sky.horizon"
_COLUMNS: Final = ("azimuth_deg", "altitude_deg")
# Altitudes, deg: the lowest is below the dip of the horizon at any height of an aircraft.
_ALTITUDES_DEG: Final = (-10.0, 80.0)


@dataclass(frozen=True)
class HorizonProfile:
    """The apparent altitude of the horizon by azimuth, linear between points and continued through north.

    Attributes
    ----------
    azimuths_rad : tuple of float
        From north through east, ascending, 0 to 2 pi rad.
    altitudes_rad : tuple of float
        Apparent altitudes at these azimuths, rad.
    """

    azimuths_rad: tuple[float, ...]
    altitudes_rad: tuple[float, ...]

    @staticmethod
    def open(path: str | PathLike[str]) -> "HorizonProfile":
        """Read a profile from a CSV file.

        Parameters
        ----------
        path : path-like
            Two columns, azimuth and altitude in degrees, of ascending azimuths from 0 to 360.  The first line may name
            the columns; empty lines and lines that begin with ``#`` are ignored.

        Returns
        -------
        HorizonProfile

        Raises
        ------
        ConfigError
            If the file cannot be read, or is no such table.
        """
        file = Path(path)
        try:
            state = file.stat()
            return _read(file, state.st_mtime_ns, state.st_size)
        except OSError as error:
            raise ConfigError(f"{file} cannot be read ({error.strerror})", key=_KEY) from error
        except UnicodeDecodeError as error:
            raise ConfigError(f"{file} is no text file; a horizon profile is a CSV file", key=_KEY) from error

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
        """Return the apparent altitude of the horizon in some directions.

        Parameters
        ----------
        azimuth_rad : (...) array_like
            From north through east, rad, of any turn.

        Returns
        -------
        (...) float64
            Altitudes, rad.
        """
        turned = np.mod(np.asarray(azimuth_rad, dtype=np.float64), 2 * np.pi)
        return np.asarray(np.interp(turned, *self._nodes_rad))


# A profile is needed again for every change of a setting.
@lru_cache(maxsize=8)
def _read(file: Path, _changed_ns: int, _size: int) -> HorizonProfile:
    """Return the profile in a file; the last parameters distinguish its versions."""
    with file.open(encoding="utf-8-sig", newline="") as lines:
        rows = [(number, row) for number, row in enumerate(csv.reader(lines), 1) if any(cell.strip() for cell in row)]
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
    found = tuple(name.strip() for name in names)
    if found != _COLUMNS:
        raise ConfigError(f"{file} has columns {', '.join(found)}; they must be {', '.join(_COLUMNS)}", key=_KEY)


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
