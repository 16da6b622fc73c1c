"""Artificial satellites from a file of two-line elements: where they are seen, and how bright."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import lru_cache
from math import pi, radians
from os import PathLike
from pathlib import Path
from typing import Any, NamedTuple, Protocol

import erfa
import numpy as np
from numpy.typing import ArrayLike

from glstar.arrays import Float
from glstar.errors import ConfigError, reading
from glstar.rotation import about_z
from glstar.sky.place.horizon import C_ned_eq
from glstar.sky.place.site import Site, geocentric_m
from glstar.sky.place.timescale import UNIX_EPOCH_JD, EarthOrientation
from glstar.system.userinput import read_text

_KEY = "sky.satellites"
_LIGHT_KM_PER_S = 299792.458
# Mean radius of the Earth, km, and mean angular radius of the Sun, rad.
_EARTH_KM = 6371.0
_SUN_RAD = radians(0.2666)
# Elements describe a low orbit for about two weeks.
_VALID_DAYS = 14.0
# All objects that are tracked have 5 MB.
_LARGEST_BYTES = 64 << 20
# A line of elements: 69 characters, the last one a checksum.
_LINE_LENGTH = 69
# Relative speed of a satellite and the ground at most, km/s.
_FASTEST_KM_PER_S = 12.0


class EarthFrames(Protocol):
    """What satellites need of `glstar.sky.observed.stars.Sky`: how the Earth is turned."""

    def earth(self, utc_s: float) -> EarthOrientation:
        """Return the Earth orientation parameters at one time."""
        ...

    def C_ned_eq(self, utc_s: ArrayLike, latitude_rad: ArrayLike, longitude_rad: ArrayLike) -> Float:
        """Return the matrices from the true equator and equinox to north, east, down."""
        ...


class SatelliteView(NamedTuple):
    """A satellite as seen at n times."""

    # (n, 3) unit vectors, true equator and equinox, with light time, without diurnal aberration.
    direction_eq: Float
    range_km: Float  # (n,) distances from the observer
    geocentric_eq_km: Float  # (n, 3) positions from the Earth's centre


@dataclass(frozen=True, slots=True)
class Satellite:
    """One satellite."""

    name: str
    number: int  # number in the satellite catalogue
    lines: tuple[str, str]  # the two lines of elements
    standard_mag: float  # V magnitude 1000 km away, half lit

    def seen(
        self, sky: EarthFrames, utc_s: Float, latitude_rad: ArrayLike, longitude_rad: ArrayLike, height_m: ArrayLike
    ) -> SatelliteView:
        """Return the satellite as an observer sees it; NaN where the elements no longer describe an orbit.

        `sky`: the orientation of the Earth; `utc_s` (n,): UTC seconds since 1970, within minutes of each other;
        `latitude_rad`, `longitude_rad`, `height_m` (n,): the observer at these times.  SGP4 (Vallado and others 2006,
        AIAA 2006-6753) in the frame TEME, turned by the sidereal time of 1982.
        """
        return _seen([_propagator(self.lines)], sky, utc_s, (latitude_rad, longitude_rad, height_m))


@dataclass(frozen=True)
class Satellites:
    """The satellites of a file."""

    path: Path
    satellites: tuple[Satellite, ...]

    @staticmethod
    def open(path: str | PathLike[str], standard_mag: float = 4.5) -> "Satellites":
        """Read a file of two-line elements.

        `path`: pairs of lines, with or without a line with the name before each; `standard_mag`: V magnitude of each
        satellite 1000 km away, half lit, which elements do not contain.  Raises ConfigError if the file cannot be read
        or is damaged, or the package sgp4 is not installed.
        """
        file = Path(path)
        _sgp4()
        with reading(file, _refusal):
            state = file.stat()
            return _read(file, standard_mag, state.st_mtime_ns, state.st_size)

    def near(
        self, sky: EarthFrames, utc_s: float, span_s: float, site: Site, towards_eq: Float, angle_rad: float
    ) -> Iterator[Satellite]:
        """Yield the satellites that may be above the horizon and near a direction during an exposure.

        `utc_s`: the middle of the exposure, UTC seconds since 1970; `span_s`: its duration; `towards_eq` (3,): unit
        vector, true equator and equinox; `angle_rad`: largest angle from it.
        """
        seen = _seen(self._records, sky, np.array([utc_s]), (site.latitude_rad, site.longitude_rad, site.height_m))
        moved_rad = np.arcsin(np.minimum(_FASTEST_KM_PER_S * span_s / 2 / seen.range_km, 1.0))
        separation_rad = np.arccos(np.clip(seen.direction_eq @ towards_eq, -1, 1))
        # NaN, of an orbit that has ended, is not near.
        for number in np.flatnonzero(separation_rad < angle_rad + moved_rad).tolist():
            yield self.satellites[number]

    def ages_days(self, utc_s: float) -> Float:
        """Return the times since the epochs of the elements, (n,) days; negative before an epoch."""
        epochs = np.array([record.jdsatepoch + record.jdsatepochF for record in self._records])
        return np.asarray(utc_s / 86400 + UNIX_EPOCH_JD - epochs)

    def age_note(self, utc_s: float) -> str:
        """Return a remark on elements that do not describe a time; empty if all do."""
        ages_days = np.abs(self.ages_days(utc_s))
        old = int(np.count_nonzero(ages_days > _VALID_DAYS))
        if not old:
            return ""
        of = "its elements are" if len(ages_days) == 1 else f"{old} of {len(ages_days)} elements are"
        return (
            f"{self.path.name}: {of} up to {ages_days.max():.0f} days from the exposures; those of low orbits are"
            f" good for {_VALID_DAYS:.0f}: satellites may be degrees from their places"
        )

    @property
    def _records(self) -> list[Any]:
        return [_propagator(satellite.lines) for satellite in self.satellites]


def satellite_vmag(standard_mag: float, range_km: ArrayLike, phase_angle_rad: ArrayLike) -> Float:
    """Return the V magnitudes, (...), of a satellite in full sunlight.

    `standard_mag`: magnitude 1000 km away, half lit; `range_km` (...): distances; `phase_angle_rad` (...): angles
    between Sun and observer at the satellite.  A white Lambert sphere reflects (sin a + (pi - a) cos a) / pi of the
    light at full phase, 1 / pi at 90 deg.
    """
    angle = np.asarray(phase_angle_rad, dtype=np.float64)
    lit = np.maximum(np.sin(angle) + (pi - angle) * np.cos(angle), 1e-12)
    return np.asarray(standard_mag + 5 * np.log10(np.asarray(range_km) / 1000) - 2.5 * np.log10(lit))


def lit_fraction(geocentric_eq_km: Float, sun_eq: Float) -> Float:
    """Return the fraction of the Sun's disc that a satellite sees beside the Earth, (...): 0 in the umbra.

    `geocentric_eq_km` (..., 3): positions of the satellite; `sun_eq` (3,): unit vector to the Sun.  The Earth's edge is
    straight, and has no air.
    """
    distance_km = np.linalg.norm(geocentric_eq_km, axis=-1)
    earth_rad = np.arcsin(np.minimum(_EARTH_KM / distance_km, 1.0))
    separation_rad = np.arccos(np.clip(-(geocentric_eq_km @ sun_eq) / distance_km, -1, 1))
    x = np.clip((separation_rad - earth_rad) / _SUN_RAD, -1, 1)
    return np.asarray(0.5 + (np.arcsin(x) + x * np.sqrt(1 - x * x)) / pi)


def visible_vmag(satellite: Satellite, view: SatelliteView, sun_eq: Float) -> tuple[Float, Float]:
    """Return the V magnitudes of a satellite in full sunlight, and the fractions of the Sun that it sees, (n,) each.

    `sun_eq` (3,): unit vector to the Sun.
    """
    phase_rad = np.arccos(np.clip(-(view.direction_eq @ sun_eq), -1, 1))
    return satellite_vmag(satellite.standard_mag, view.range_km, phase_rad), lit_fraction(view.geocentric_eq_km, sun_eq)


def _seen(
    propagators: Sequence[Any], sky: EarthFrames, utc_s: Float, site: tuple[ArrayLike, ArrayLike, ArrayLike]
) -> SatelliteView:
    """Return the view of several satellites at one time, or of one satellite at several times.

    `site`: latitude and longitude, rad, and height, m.
    """
    latitude_rad, longitude_rad, height_m = (np.asarray(number, dtype=np.float64) for number in site)
    count = max(len(propagators), utc_s.size)
    to_ned = C_ned_eq(latitude_rad, longitude_rad)
    site_km = geocentric_m(latitude_rad, longitude_rad, height_m) / 1000
    earth = sky.earth(float(utc_s[0]))
    ut1_day = (utc_s + earth.dut1_s) / 86400
    C_fixed_teme = earth.polar_motion @ about_z(erfa.gmst82(UNIX_EPOCH_JD, ut1_day))
    range_km = np.zeros(count)
    for _ in range(2):
        teme_km = _teme_km(propagators, np.broadcast_to(utc_s, count) - range_km / _LIGHT_KM_PER_S)
        fixed_km = (C_fixed_teme @ teme_km[..., np.newaxis])[..., 0]
        range_km = np.linalg.norm(fixed_km - site_km, axis=-1)
    C_eq_ned = np.swapaxes(sky.C_ned_eq(utc_s, latitude_rad, longitude_rad), -1, -2)
    C_eq_fixed = C_eq_ned @ to_ned
    direction_eq = (C_eq_fixed @ (fixed_km - site_km)[..., np.newaxis])[..., 0] / range_km[:, np.newaxis]
    return SatelliteView(direction_eq, range_km, (C_eq_fixed @ fixed_km[..., np.newaxis])[..., 0])


def _teme_km(propagators: Sequence[Any], utc_s: Float) -> Float:
    """Return geocentric positions in TEME, (n, 3) km; NaN where an orbit has ended."""
    day = np.floor(utc_s / 86400)
    fraction = utc_s / 86400 - day
    if len(propagators) == 1:
        error, position, _ = propagators[0].sgp4_array(day + UNIX_EPOCH_JD, fraction)
    else:
        times = zip(propagators, day.tolist(), fraction.tolist(), strict=True)
        states = [propagator.sgp4(whole + UNIX_EPOCH_JD, part) for propagator, whole, part in times]
        error, position, _ = (np.array(values) for values in zip(*states, strict=True))
    return np.where((error == 0)[:, np.newaxis], position, np.nan)


def _sgp4() -> Any:
    """Return the module of SGP4."""
    try:
        from sgp4 import api  # noqa: PLC0415 - an extra
    except ImportError as error:
        raise ConfigError("satellites need the package sgp4: pip install sgp4", key=_KEY) from error
    return api


@lru_cache(maxsize=65536)
def _propagator(lines: tuple[str, str]) -> Any:
    return _sgp4().Satrec.twoline2rv(*lines)


def _refusal(file: Path, message: str) -> ConfigError:
    return ConfigError(f"{file} {message}", key=_KEY)


# The file is needed again for every change of a setting.
@lru_cache(maxsize=8)
def _read(file: Path, standard_mag: float, _changed_ns: int, _size: int) -> Satellites:
    """Return the satellites in a file; the last parameters distinguish its versions."""
    lines = [line.rstrip() for line in read_text(file, _LARGEST_BYTES).splitlines()]
    numbered = [(number, line) for number, line in enumerate(lines, 1) if line and not line.startswith("#")]
    satellites = list[Satellite]()
    name = first = ""
    for number, line in numbered:
        if line.startswith("1 ") and not first and len(line) >= _LINE_LENGTH - 1:
            first = _checked(file, number, line)
        elif first:
            second = _checked(file, number, line)
            if not second.startswith("2 ") or second[2:7] != first[2:7]:
                raise ConfigError(f"{file}, line {number}: must be line 2 of satellite {first[2:7].strip()}", key=_KEY)
            satellites.append(_satellite(file, number, name, (first, second), standard_mag))
            name = first = ""
        elif line.startswith("2 ") and len(line) >= _LINE_LENGTH - 1:
            raise ConfigError(f"{file}, line {number}: line 2 of elements without its line 1", key=_KEY)
        elif name:
            raise ConfigError(f"{file}, line {number}: must be line 1 of the elements of {name}", key=_KEY)
        else:
            name = line.removeprefix("0 ").strip()
    if first or name or not satellites:
        what = "ends within the elements of a satellite" if first or name else "has no two-line elements"
        raise ConfigError(f"{file} {what}", key=_KEY)
    return Satellites(file, tuple(satellites))


def _checked(file: Path, number: int, line: str) -> str:
    """Return a line of elements whose checksum is right."""
    if len(line) < _LINE_LENGTH or not line[_LINE_LENGTH - 1].isdigit():
        raise ConfigError(
            f"{file}, line {number}: has {len(line)} characters, and elements {_LINE_LENGTH} with a checksum", key=_KEY
        )
    digits = line[: _LINE_LENGTH - 1].replace("-", "1")
    total = sum(int(digit) for digit in digits if digit.isdigit()) % 10
    if total != int(line[_LINE_LENGTH - 1]):
        raise ConfigError(
            f"{file}, line {number}: its checksum is {line[_LINE_LENGTH - 1]}, and that of its digits {total}: damaged",
            key=_KEY,
        )
    return line[:_LINE_LENGTH]


def _satellite(file: Path, number: int, name: str, lines: tuple[str, str], standard_mag: float) -> Satellite:
    try:
        record = _propagator(lines)
    except ValueError as error:
        raise ConfigError(f"{file}, line {number}: {error}", key=_KEY) from error
    if record.error:
        raise ConfigError(f"{file}, line {number}: describes no orbit (SGP4 error {record.error})", key=_KEY)
    return Satellite(name or f"satellite {record.satnum}", record.satnum, lines, standard_mag)
