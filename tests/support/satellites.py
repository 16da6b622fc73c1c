"""Elements of invented satellites, and where skyfield sees them."""

from typing import Final

import numpy as np
from numpy.typing import NDArray
from skyfield.api import EarthSatellite, load, wgs84
from skyfield.positionlib import ICRF

from glstar.sky.place.site import Site

Float = NDArray[np.float64]

_KM_PER_AU: Final = 149597870.7
_LIGHT_KM_PER_S: Final = 299792.458
_TIMES: Final = load.timescale(builtin=True)

# Passes over Adelaide on 2024-03-18: high in the north-west at 10:37:40 UTC, into the Earth's shadow at 10:37:50.
PASS: Final = (
    "1 99001U 24001A   24078.41666667  .00010000  00000-0  10000-3 0  9994",
    "2 99001  51.6400 144.0000 0006703  90.0000  80.0000 15.50000000    11",
)
# A navigation satellite, a geostationary one and an eccentric one.
HIGHER: Final = (
    (
        "1 99002U 24001B   24078.41666667  .00000010  00000-0  00000-0 0  9990",
        "2 99002  55.0000 100.0000 0050000  30.0000 330.0000  2.00560000    10",
    ),
    (
        "1 99003U 24001C   24078.41666667  .00000000  00000-0  00000-0 0  9990",
        "2 99003   0.0500  90.0000 0002000  20.0000  60.0000  1.00270000    10",
    ),
    (
        "1 99004U 24001D   24078.41666667  .00000100  00000-0  00000-0 0  9990",
        "2 99004  63.4000 200.0000 7200000 270.0000  10.0000  2.00600000    10",
    ),
)


def with_checksum(line: str) -> str:
    """Return a line of elements with the right last digit."""
    total = sum(1 if one == "-" else int(one) if one.isdigit() else 0 for one in line[:68])
    return f"{line[:68]}{total % 10}"


def elements(*pairs: tuple[str, str], names: bool = True) -> str:
    """Return a file of elements."""
    lines = []
    for number, pair in enumerate(pairs, 1):
        lines += [f"SATELLITE {number}"] * names + [with_checksum(line) for line in pair]
    return "\n".join(lines) + "\n"


def dut1_s(utc_s: float) -> float:
    """Return skyfield's UT1 - UTC."""
    return float(_at(utc_s).dut1)


def seen_by_skyfield(pair: tuple[str, str], utc_s: float, site: Site) -> Float:
    """Return the vector from a site to a satellite, north, east, down, km, with light time."""
    satellite = EarthSatellite(*map(with_checksum, pair), "", _TIMES)
    place = wgs84.latlon(np.rad2deg(site.latitude_rad), np.rad2deg(site.longitude_rad), elevation_m=site.height_m)
    time, light_s = _at(utc_s), 0.0
    for _ in range(3):
        then = _TIMES.tt_jd(time.tt - light_s / 86400)
        offset_km = satellite.at(then).position.km - place.at(time).position.km
        light_s = float(np.linalg.norm(offset_km)) / _LIGHT_KM_PER_S
    altitude, azimuth, distance = ICRF(offset_km / _KM_PER_AU, None, time, center=place).altaz()
    level = np.cos(altitude.radians)
    ned = [level * np.cos(azimuth.radians), level * np.sin(azimuth.radians), -np.sin(altitude.radians)]
    return np.array(ned) * distance.km


def _at(utc_s: float):
    return _TIMES.tt_jd(2440587.5 + (utc_s + 37.0 + 32.184) / 86400)
