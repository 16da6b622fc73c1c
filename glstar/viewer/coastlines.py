"""The map around a site: coastlines and the graticule of latitude and longitude.

The map is an orthographic projection: metres east and north in the plane that is tangent to the ellipsoid at the site.
Directions from there are true at any distance; a distance of 900 km is 0.3 % too short.
``assets/coastlines.npz`` holds the coast of Natural Earth; `tests/scripts/make_coastlines.py` wrote it and says how.
"""

from dataclasses import dataclass
from functools import lru_cache
from math import ceil, cos, floor, log10, pi, sin
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from glstar.sky.geodesy import north_east_down_m, semi_axes_m
from glstar.sky.site import Site
from glstar.system.resources import asset

__all__ = ["Coastlines", "GraticuleLine", "MapLimits", "graticule", "map_east_north_m"]

Float = NDArray[np.float64]

# Steps of the coordinates in the asset.
_PER_DEG: Final = 100
# Largest number of points of a part of a coastline, which is drawn or not.
_PART_POINTS: Final = 64
_EARTH_M: Final = float(np.mean(semi_axes_m()))
# Smallest and largest distance of the lines of a graticule, deg; lines across the map; and points of a line.
_STEPS_DEG: Final = (*(m * 10.0**e for e in range(-5, 1) for m in (1, 2, 5)), 10.0, 15.0, 30.0)
_LINES: Final = 4
_POINTS: Final = 129


class MapLimits(NamedTuple):
    """A part of the map, m east and north of its origin."""

    west: float
    east: float
    south: float
    north: float

    @property
    def extent_m(self) -> float:
        """The larger of width and height."""
        return max(self.east - self.west, self.north - self.south)


def map_east_north_m(origin: Site, latitude_rad: Float, longitude_rad: Float) -> Float:
    """Return where places of the ground are on the map.

    Parameters
    ----------
    origin : Site
    latitude_rad, longitude_rad : (n,) float64
        WGS84, rad; NaN between lines.

    Returns
    -------
    (n, 2) float64
        East and north of the origin, m; NaN on the other side of the Earth.
    """
    sine = np.sin(latitude_rad) * sin(origin.latitude_rad)
    cosine = np.cos(latitude_rad) * cos(origin.latitude_rad) * np.cos(longitude_rad - origin.longitude_rad)
    here = sine + cosine > 0  # not for NaN
    xy_m = np.full((len(latitude_rad), 2), np.nan)
    xy_m[here] = north_east_down_m(origin, latitude_rad[here], longitude_rad[here], 0.0)[:, 1::-1]
    return xy_m


class Coastlines:
    """The coast on the map of a site.

    Parameters
    ----------
    origin : Site
    """

    def __init__(self, origin: Site) -> None:
        latitude_rad, longitude_rad, starts = _coast()
        self._xy_m = map_east_north_m(origin, latitude_rad, longitude_rad)
        filled = np.where(np.isnan(self._xy_m), np.inf, self._xy_m)
        self._least = np.minimum.reduceat(filled, starts)
        filled[np.isinf(filled)] = -np.inf
        self._most = np.maximum.reduceat(filled, starts)
        self._starts = starts
        self._last: tuple[tuple[MapLimits, float], Float] | None = None

    def within(self, limits: MapLimits, px_m: float) -> Float:
        """Return the coast within a part of the map.

        Parameters
        ----------
        limits : MapLimits
        px_m : float
            Size of a pixel of the screen, m: points that are in the same pixel as the one before are left out.

        Returns
        -------
        (n, 2) float64
            East and north, m; NaN between lines.
        """
        key = limits, px_m
        if self._last is not None and self._last[0] == key:
            return self._last[1]
        overlaps = (self._least[:, 0] < limits.east) & (self._most[:, 0] > limits.west)
        overlaps &= (self._least[:, 1] < limits.north) & (self._most[:, 1] > limits.south)
        sizes = np.diff(self._starts, append=len(self._xy_m))
        xy_m = self._xy_m[np.repeat(overlaps, sizes)]
        # Gaps have a cell of their own, so that of several the first stays.
        cell = np.where(np.isnan(xy_m), np.inf, np.floor(xy_m / px_m))
        kept = np.ones(len(xy_m), dtype=bool)
        kept[1:] = (cell[1:] != cell[:-1]).any(axis=1)
        self._last = key, xy_m[kept]
        return self._last[1]


@lru_cache(maxsize=1)
def _coast() -> tuple[Float, Float, NDArray[np.intp]]:
    """Return latitudes and longitudes, rad, NaN after each part of a line, and where the parts begin."""
    with np.load(asset("coastlines.npz")) as stored:
        steps = np.column_stack([stored["latitude_steps"], stored["longitude_steps"]]).astype(np.int64)
        points = stored["points"]
    degrees = [np.cumsum(line, axis=0) / _PER_DEG for line in np.split(steps, np.cumsum(points)[:-1])]
    # Neighbouring parts of a line share a point.
    parts = [line[i : i + _PART_POINTS] for line in degrees for i in range(0, len(line) - 1, _PART_POINTS - 1)]
    gap = np.full((1, 2), np.nan)
    together = np.deg2rad(np.concatenate([piece for part in parts for piece in (part, gap)]))
    starts = np.cumsum([0, *(len(part) + 1 for part in parts[:-1])])
    return np.ascontiguousarray(together[:, 0]), np.ascontiguousarray(together[:, 1]), starts


@dataclass(frozen=True, slots=True, eq=False)
class GraticuleLine:
    """A line of equal latitude or longitude.

    Attributes
    ----------
    label : str
        Such as ``"34.5 deg S"``, with the sign of degrees.
    is_parallel : bool
        Whether it is one of latitude.
    xy_m : (n, 2) float64
        East and north, m; NaN on the other side of the Earth.
    """

    label: str
    is_parallel: bool
    xy_m: Float


def graticule(origin: Site, limits: MapLimits) -> list[GraticuleLine]:
    """Return the graticule of a part of the map.

    Parameters
    ----------
    origin : Site
    limits : MapLimits

    Returns
    -------
    list of GraticuleLine
        About four lines of latitude and of longitude; none beyond the Earth.
    """
    south_deg, north_deg, west_deg, east_deg = _bounds_deg(origin, limits)
    wanted_deg = np.rad2deg(min(limits.extent_m / _EARTH_M, pi)) / _LINES
    step = next((step for step in _STEPS_DEG if step >= wanted_deg), _STEPS_DEG[-1])
    parallels = [number * step for number in range(ceil(south_deg / step), floor(north_deg / step) + 1)]
    longitudes = np.linspace(west_deg, east_deg, _POINTS)
    lines = [
        GraticuleLine(_label(value, step, "NS"), True, _line_m(origin, np.full(_POINTS, value), longitudes))
        for value in parallels
        if abs(value) < 90
    ]
    wanted_deg = max(wanted_deg / max(cos(origin.latitude_rad), 0.02), (east_deg - west_deg) / (2 * _LINES))
    step = next((step for step in _STEPS_DEG if step >= wanted_deg), _STEPS_DEG[-1])
    first, last = ceil(west_deg / step), floor(east_deg / step)
    last = min(last, first + round(360 / step) - 1)
    latitudes = np.linspace(south_deg, north_deg, _POINTS)
    for value in (number * step for number in range(first, last + 1)):
        label = _label((value + 180) % 360 - 180, step, "EW")
        lines.append(GraticuleLine(label, False, _line_m(origin, latitudes, np.full(_POINTS, value))))
    return lines


def _line_m(origin: Site, latitude_deg: Float, longitude_deg: Float) -> Float:
    return map_east_north_m(origin, np.deg2rad(latitude_deg), np.deg2rad(longitude_deg))


def _bounds_deg(origin: Site, limits: MapLimits) -> tuple[float, float, float, float]:
    """Return the least and the largest latitude and longitude of a part of the map, on a sphere, and a bit more."""
    x, y = (side.ravel() for side in np.meshgrid(np.linspace(*limits[:2], 33), np.linspace(*limits[2:], 33)))
    on_earth = np.hypot(x, y) < _EARTH_M
    if not on_earth.any():
        return -90.0, 90.0, -180.0, 180.0
    x, y = x[on_earth] / _EARTH_M, y[on_earth] / _EARTH_M
    up = np.sqrt(1 - x**2 - y**2)
    sine, cosine = sin(origin.latitude_rad), cos(origin.latitude_rad)
    latitude_deg = np.rad2deg(np.arcsin(np.clip(up * sine + y * cosine, -1, 1)))
    east_deg = np.rad2deg(np.arctan2(x, up * cosine - y * sine))
    margin_deg = np.rad2deg(limits.extent_m / _EARTH_M) / 16
    south, north = max(float(latitude_deg.min()) - margin_deg, -90.0), min(float(latitude_deg.max()) + margin_deg, 90.0)
    centre_deg = float(np.rad2deg(origin.longitude_rad))
    pole_m = _EARTH_M * (cosine if sine > 0 else -cosine)
    has_pole = limits.west < 0 < limits.east and limits.south < pole_m < limits.north
    if has_pole:
        south, north = (south, 90.0) if sine > 0 else (-90.0, north)
    if has_pole or np.ptp(east_deg) > 180:
        return south, north, centre_deg - 180, centre_deg + 180
    wide_deg = margin_deg / max(cosine, 0.02)
    return south, north, centre_deg + float(east_deg.min()) - wide_deg, centre_deg + float(east_deg.max()) + wide_deg


def _label(value_deg: float, step_deg: float, sides: str) -> str:
    """Return the label of a line of the graticule; `sides` are the letters of positive and negative values."""
    digits = max(0, -floor(log10(step_deg) + 1e-9))
    has_side = step_deg / 2 < abs(value_deg) < 180 - step_deg / 2
    return f"{abs(value_deg):.{digits}f}\N{DEGREE SIGN}{sides[value_deg < 0] if has_side else ''}"
