"""Sites on the Earth with their air, and positions on the WGS84 ellipsoid: geocentric, and in the frame of a site."""

from dataclasses import dataclass
from math import asin, hypot, isfinite, pi

import erfa
import numpy as np
from numpy.typing import ArrayLike

from glstar.arrays import Float
from glstar.errors import ConfigError
from glstar.sky.place.horizon import C_ned_eq

# The standard air of eqs (25) and (27).
STANDARD_PRESSURE_HPA = 1010.0
STANDARD_TEMPERATURE_C = 10.0

# Valid ranges: heights from below the Dead Sea to space, and the pressures and temperatures of the atmosphere.
HEIGHTS_M = (-1000.0, 100_000.0)
PRESSURES_HPA = (0.0, 1200.0)
TEMPERATURES_C = (-120.0, 100.0)

# ERFA's number of the ellipsoid.
_WGS84 = 1


@dataclass(frozen=True, slots=True)
class Site:
    """An observing site and its air.

    Attributes
    ----------
    latitude_rad, longitude_rad : float
        WGS84 geodetic latitude, and longitude positive eastward, rad.
    height_m : float
        Height above the WGS84 ellipsoid, m.
    pressure_hpa : float
        Pressure at the observer (not reduced to sea level), hPa; 0 means no refraction.
    temperature_c : float
        Air temperature at the observer, degrees Celsius.

    Raises
    ------
    ConfigError
        If a number is outside its limits, such as a latitude of more than 90 deg or a negative pressure.
    """

    latitude_rad: float
    longitude_rad: float
    height_m: float = 0.0
    pressure_hpa: float = STANDARD_PRESSURE_HPA
    temperature_c: float = STANDARD_TEMPERATURE_C

    def __post_init__(self) -> None:
        numbers = (self.latitude_rad, self.longitude_rad, self.height_m, self.pressure_hpa, self.temperature_c)
        if not all(isfinite(number) for number in numbers):
            raise ConfigError(f"a site needs finite numbers, not {numbers}")
        if abs(self.latitude_rad) > pi / 2 + 1e-12:
            raise ConfigError(
                f"latitude {self.latitude_rad * 180 / pi:.6f} deg lies beyond the pole; it runs from -90 to 90"
            )
        if abs(self.longitude_rad) > 2 * pi + 1e-12:
            raise ConfigError(
                f"longitude {self.longitude_rad * 180 / pi:.6f} deg is more than a turn;"
                " it runs from -180 to 180, or 0 to 360"
            )
        if self.pressure_hpa < 0:
            raise ConfigError(
                f"a pressure of {self.pressure_hpa} hPa is negative; give the station pressure, or 0 for no air"
            )
        if self.temperature_c <= -273.0:
            raise ConfigError(f"an air temperature of {self.temperature_c} deg C is below absolute zero")
        limits = (
            (self.height_m, HEIGHTS_M, "a height", "m"),
            (self.pressure_hpa, PRESSURES_HPA, "a pressure", "hPa"),
            (self.temperature_c, TEMPERATURES_C, "an air temperature", "deg C"),
        )
        for number, (least, most), what, unit in limits:
            if not least <= number <= most:
                raise ConfigError(
                    f"{what} of {number:g} {unit} is not possible; it must be from {least:g} to {most:g} {unit}"
                )


def semi_axes_m() -> Float:
    """Return the semi-axes of the WGS84 ellipsoid along the axes of ITRS, m: (3,) float64."""
    equator_m, flattening = erfa.eform(_WGS84)
    return np.array([equator_m, equator_m, equator_m * (1 - flattening)])


def radii_of_curvature_m(latitude_rad: ArrayLike) -> tuple[Float, Float]:
    """Return the radii of curvature of the ellipsoid along the meridian and across it, (...) m each, at latitudes."""
    equator_m, _, polar_m = semi_axes_m()
    squeeze = (polar_m / equator_m) ** 2
    across_m = equator_m / np.sqrt(np.cos(latitude_rad) ** 2 + squeeze * np.sin(latitude_rad) ** 2)
    return np.asarray(squeeze * across_m**3 / equator_m**2), np.asarray(across_m)


def geocentric_m(latitude_rad: ArrayLike, longitude_rad: ArrayLike, height_m: ArrayLike) -> Float:
    """Return the geocentric positions, (..., 3) m in ITRS, of WGS84 latitudes, longitudes and heights, (...)."""
    return np.asarray(erfa.gd2gc(_WGS84, longitude_rad, latitude_rad, height_m), dtype=np.float64)


def north_east_down_m(origin: Site, latitude_rad: ArrayLike, longitude_rad: ArrayLike, height_m: ArrayLike) -> Float:
    """Return positions north, east and down of a site, (..., 3) m, of WGS84 latitudes, longitudes and heights, (...).

    North and east lie in the plane that is tangent to the ellipsoid at the origin.
    """
    return local_ned_m(origin, geocentric_m(latitude_rad, longitude_rad, height_m))


def local_ned_m(origin: Site, position_m: ArrayLike) -> Float:
    """Return geocentric positions, (..., 3) m in ITRS, north, east and down of a site; see `north_east_down_m`."""
    chord_m = np.asarray(position_m) - geocentric_m(origin.latitude_rad, origin.longitude_rad, origin.height_m)
    return np.asarray(chord_m @ C_ned_eq(origin.latitude_rad, origin.longitude_rad).T)


def geodetic(position_m: ArrayLike) -> tuple[Float, Float, Float]:
    """Return latitude, longitude and height, (...) each, of positions, (..., 3) m: the inverse of `geocentric_m`."""
    longitude_rad, latitude_rad, height_m = erfa.gc2gd(_WGS84, position_m)
    return latitude_rad, longitude_rad, height_m


def north_east_of(origin: Site, north_m: float, east_m: float) -> tuple[float, float]:
    """Return latitude and longitude, rad, of a point in the plane that is tangent to the ellipsoid below a site."""
    ground_m = geocentric_m(origin.latitude_rad, origin.longitude_rad, 0.0)
    moved_m = ground_m + np.array([north_m, east_m, 0.0]) @ C_ned_eq(origin.latitude_rad, origin.longitude_rad)
    latitude_rad, longitude_rad, _ = geodetic(moved_m)
    return float(latitude_rad), float(longitude_rad)


def surface_offset_km(origin: Site, latitude_rad: float, longitude_rad: float) -> tuple[float, float]:
    """Return how far north and east of a site a position is on the WGS84 ellipsoid, km.

    The length of the chord as an arc, in the direction of the chord; heights do not matter.
    """
    ground = Site(origin.latitude_rad, origin.longitude_rad)
    chord_km = north_east_down_m(ground, latitude_rad, longitude_rad, 0.0) / 1000
    north, east = float(chord_km[0]), float(chord_km[1])
    level_km, length_km = hypot(north, east), float(np.linalg.norm(chord_km))
    radius_km = float(np.linalg.norm(geocentric_m(origin.latitude_rad, origin.longitude_rad, 0.0))) / 1000
    arc_km = 2 * radius_km * asin(min(length_km / (2 * radius_km), 1.0))
    scale = arc_km / level_km if level_km > 0 else 0.0
    return north * scale, east * scale
