"""The state of the aircraft at a time, the ground that its camera sees, and the map around a site.

The map is an orthographic projection: metres east and north in the plane that is tangent to the ellipsoid at the site.
Directions from there are true at any distance; a distance of 900 km is 0.3 % too short.
``assets/coastlines.npz`` holds the coast of Natural Earth; `tests/scripts/make_coastlines.py` wrote it and says how.
"""

from dataclasses import dataclass
from functools import lru_cache
from itertools import pairwise
from math import ceil, cos, floor, hypot, log10, pi, sin
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from glstar.arrays import Float
from glstar.camera.model import Camera
from glstar.flight import Flight
from glstar.render.simulator import Simulator
from glstar.rotation import euler_from_quaternion, matrix_from_quaternion
from glstar.sky.place.horizon import C_ned_eq, ned_to_azimuth_altitude_rad
from glstar.sky.place.site import Site, geocentric_m, north_east_down_m, semi_axes_m
from glstar.system.resources import asset

# Points on each side of the image's border: near the zenith, azimuths change fast from point to point.
_BORDER_POINTS = 128
_UP_AND_DOWN_NED = np.array([[0.0, 0.0, -1.0], [0.0, 0.0, 1.0]])


def image_azimuths_rad(camera: Camera, C_camera_ned: Float) -> tuple[float, float]:
    """Return the azimuths between which all directions of an image lie, without refraction.

    `C_camera_ned` (3, 3): rotation from north, east, down to the camera frame.  Returns the first azimuth, from north
    through east, 0 to 2 pi, and the extent clockwise from there, seen from above: 2 pi if the zenith or the nadir is in
    the image.  Both are NaN if a part of the image's border is beyond the limit of the lens.
    """
    directions = image_border(camera) @ C_camera_ned
    if not np.isfinite(directions).all():
        return np.nan, np.nan
    if camera.contains(camera.project(_UP_AND_DOWN_NED @ C_camera_ned.T)).any():
        return 0.0, 2 * np.pi
    azimuth_rad = np.unwrap(ned_to_azimuth_altitude_rad(directions)[0])
    first_rad, last_rad = float(azimuth_rad.min()), float(azimuth_rad.max())
    return first_rad % (2 * np.pi), min(last_rad - first_rad, 2 * np.pi)


@lru_cache(maxsize=2)
def image_border(camera: Camera) -> Float:
    """Return directions along the border of an image.

    Returns (n, 3) vectors in the camera frame, in order, the first one again at the end; NaN beyond the limit of the
    lens.
    """
    right, bottom = camera.width_px - 0.5, camera.height_px - 0.5
    corners = np.array([[-0.5, -0.5], [right, -0.5], [right, bottom], [-0.5, bottom], [-0.5, -0.5]])
    along = np.linspace(0.0, 1.0, _BORDER_POINTS, endpoint=False)[:, np.newaxis]
    sides = [start + along * (end - start) for start, end in pairwise(corners)]
    return camera.unit_vectors(np.concatenate([*sides, corners[:1]]))


# Interval over which speeds are measured, s: GPS positions come five times a second at most.
_SPEED_INTERVAL_S = 1.0


@dataclass(frozen=True, slots=True, eq=False)
class AircraftState:
    """The aircraft at one time."""

    roll_rad: float  # Euler angles of the body
    pitch_rad: float
    yaw_rad: float
    site: Site  # Its position
    # Horizontal and upward speed, averaged over a second; NaN for a flight with a single position.
    ground_speed_m_per_s: float
    climb_m_per_s: float
    camera_azimuth_rad: float  # Direction of the optical axis
    camera_altitude_rad: float
    lowest_altitude_rad: float  # Altitude of the lowest corner of the image, without refraction
    # Azimuths that the image covers: the first, and the extent clockwise; see `image_azimuths_rad`.
    image_azimuths_rad: tuple[float, float]
    C_camera_ned: Float  # (3, 3) rotation from north, east, down to the camera frame

    @property
    def view(self) -> str:
        """A message if the camera sees the ground, else empty."""
        if self.camera_altitude_rad < 0:
            return "the camera points below the horizon"
        return "a part of the image is below the horizon" if self.lowest_altitude_rad < 0 else ""


def aircraft_state(simulator: Simulator, utc_s: float) -> AircraftState:
    """Return the state of the aircraft at a time.

    `simulator`: its flight, mount and camera; `utc_s`: UTC seconds since 1970, inside the flight.
    """
    flight, camera = simulator.flight, simulator.camera
    roll, pitch, yaw = (float(angle) for angle in euler_from_quaternion(flight.aircraft_attitude.at(utc_s)))
    q_body_ned = flight.attitude.at(np.array([utc_s]))
    C_camera_ned = simulator.mount.C_camera_body @ matrix_from_quaternion(q_body_ned)[0]
    azimuth_rad, altitude_rad = ned_to_azimuth_altitude_rad(C_camera_ned[2])
    right, bottom = camera.width_px - 0.5, camera.height_px - 0.5
    corners = camera.unit_vectors([[-0.5, -0.5], [right, -0.5], [-0.5, bottom], [right, bottom]])
    _, corner_rad = ned_to_azimuth_altitude_rad(corners @ C_camera_ned)
    ground_speed, climb = _speeds_m_per_s(flight, utc_s)
    return AircraftState(
        roll_rad=roll,
        pitch_rad=pitch,
        yaw_rad=yaw,
        site=flight.position.at(utc_s),
        ground_speed_m_per_s=ground_speed,
        climb_m_per_s=climb,
        camera_azimuth_rad=float(azimuth_rad),
        camera_altitude_rad=float(altitude_rad),
        lowest_altitude_rad=float(np.fmin.reduce(corner_rad)),
        image_azimuths_rad=image_azimuths_rad(camera, C_camera_ned),
        C_camera_ned=C_camera_ned,
    )


def ground_track_m(flight: Flight, origin: Site, points: int = 2000) -> Float:
    """Return the ground track of a flight around a site.

    `points`: largest number of points.  Returns (n, 2) east and north of the origin, m.
    """
    position = flight.position
    stride = max(1, -(-len(position.utc_s) // points))
    chosen = np.append(np.arange(0, len(position.utc_s) - 1, stride), len(position.utc_s) - 1)
    ned_m = north_east_down_m(
        origin, position.latitude_rad[chosen], position.longitude_rad[chosen], position.height_m[chosen]
    )
    return ned_m[:, 1::-1]


def _speeds_m_per_s(flight: Flight, utc_s: float) -> tuple[float, float]:
    """Return horizontal and upward speed around a time."""
    position = flight.position
    if len(position.utc_s) < 2:
        return float("nan"), float("nan")
    times_s = np.clip(utc_s + np.array([-0.5, 0.5]) * _SPEED_INTERVAL_S, position.utc_s[0], position.utc_s[-1])
    if times_s[1] <= times_s[0]:
        return float("nan"), float("nan")
    north, east, down = np.diff(north_east_down_m(position.at(utc_s), *position.coordinates(times_s)), axis=0)[0]
    interval_s = times_s[1] - times_s[0]
    return hypot(north, east) / interval_s, -down / interval_s


# Points around the horizon.
_HORIZON_POINTS = 721


@dataclass(frozen=True, slots=True, eq=False)
class Footprint:
    """The ground that an image shows: geocentric positions in ITRS, m, NaN where there is none."""

    border: Float  # (n, 3) along the border of the image, in order
    horizon: Float  # (m, 3) around the horizon of the ground: NaN where it is not in the image
    axis: Float  # (3,) where the optical axis meets the ground

    @property
    def is_empty(self) -> bool:
        """Whether the image shows no ground."""
        return not (np.isfinite(self.border).any() or np.isfinite(self.horizon).any() or np.isfinite(self.axis).any())


def ground_footprint(camera: Camera, C_camera_ned: Float, site: Site, ground_m: float) -> Footprint:
    """Return where the rays of an image meet the ground, without refraction and without terrain.

    It is empty if the site is not above the ground.  `C_camera_ned` (3, 3): rotation from north, east, down to the
    camera frame; `site`: of the camera; `ground_m`: height of the ground above the WGS84 ellipsoid, m: an ellipsoid
    whose semi-axes are longer by that.
    """
    axes_m = semi_axes_m() + ground_m
    eye_m = geocentric_m(site.latitude_rad, site.longitude_rad, site.height_m)
    C_camera_itrs = C_camera_ned @ C_ned_eq(site.latitude_rad, site.longitude_rad)
    rays = np.vstack([image_border(camera), [0.0, 0.0, 1.0]]) @ C_camera_itrs
    ground = _first_hits(eye_m / axes_m, rays / axes_m) * axes_m
    horizon = _tangent_points(eye_m / axes_m) * axes_m
    in_camera = (horizon - eye_m) @ C_camera_itrs.T
    with np.errstate(invalid="ignore"):
        seen = camera.contains(camera.project(in_camera)) & (in_camera[:, 2] > 0)
    horizon[~seen] = np.nan
    return Footprint(ground[:-1], horizon, ground[-1])


def _first_hits(eye: Float, rays: Float) -> Float:
    """Return where rays from a point outside of the unit sphere first meet it: (n, 3), NaN where they do not."""
    squared, along = np.sum(rays**2, axis=1), rays @ eye
    height = eye @ eye - 1
    with np.errstate(invalid="ignore"):
        root = np.sqrt(along**2 - squared * height)
        # The product of both roots is height / squared: the nearer one without cancellation.
        distance = np.where((along < 0) & (height > 0), height / (root - along), np.nan)
    return np.asarray(eye + distance[:, np.newaxis] * rays)


def _tangent_points(eye: Float) -> Float:
    """Return the points around the horizon of a point outside of the unit sphere: (n, 3), NaN if it is inside."""
    squared = float(eye @ eye)
    if squared <= 1:
        return np.full((_HORIZON_POINTS, 3), np.nan)
    outwards = eye / np.sqrt(squared)
    first = np.cross(outwards, np.eye(3)[np.abs(outwards).argmin()])
    first /= np.linalg.norm(first)
    angle = np.linspace(0.0, 2 * np.pi, _HORIZON_POINTS)[:, np.newaxis]
    around = np.cos(angle) * first + np.sin(angle) * np.cross(outwards, first)
    return np.asarray(eye / squared + np.sqrt(1 - 1 / squared) * around)


# Steps of the coordinates in the asset.
_PER_DEG = 100
# Largest number of points of a part of a coastline, which is drawn or not.
_PART_POINTS = 64
_EARTH_M = float(np.mean(semi_axes_m()))
# Smallest and largest distance of the lines of a graticule, deg; lines across the map; and points of a line.
_STEPS_DEG = (*(m * 10.0**e for e in range(-5, 1) for m in (1, 2, 5)), 10.0, 15.0, 30.0)
_LINES = 4
_LINE_POINTS = 129


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

    `latitude_rad`, `longitude_rad` (n,): WGS84, rad; NaN between lines.  Returns (n, 2) east and north of the origin,
    m; NaN on the other side of the Earth.
    """
    sine = np.sin(latitude_rad) * sin(origin.latitude_rad)
    cosine = np.cos(latitude_rad) * cos(origin.latitude_rad) * np.cos(longitude_rad - origin.longitude_rad)
    here = sine + cosine > 0  # not for NaN
    xy_m = np.full((len(latitude_rad), 2), np.nan)
    xy_m[here] = north_east_down_m(origin, latitude_rad[here], longitude_rad[here], 0.0)[:, 1::-1]
    return xy_m


class Coastlines:
    """The coast on the map of a site."""

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

        `px_m`: size of a pixel of the screen, m: points that are in the same pixel as the one before are left out.
        Returns (n, 2) east and north, m; NaN between lines.
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
    """A line of equal latitude or longitude."""

    label: str  # Such as ``"34.5 deg S"``, with the sign of degrees
    is_parallel: bool  # Whether it is one of latitude
    xy_m: Float  # (n, 2) east and north, m; NaN on the other side of the Earth


def graticule(origin: Site, limits: MapLimits) -> list[GraticuleLine]:
    """Return the graticule of a part of the map: about four lines each of latitude and longitude, if on the Earth."""
    south_deg, north_deg, west_deg, east_deg = _bounds_deg(origin, limits)
    wanted_deg = np.rad2deg(min(limits.extent_m / _EARTH_M, pi)) / _LINES
    step = next((step for step in _STEPS_DEG if step >= wanted_deg), _STEPS_DEG[-1])
    parallels = [number * step for number in range(ceil(south_deg / step), floor(north_deg / step) + 1)]
    longitudes = np.linspace(west_deg, east_deg, _LINE_POINTS)
    lines = [
        GraticuleLine(_label(value, step, "NS"), True, _line_m(origin, np.full(_LINE_POINTS, value), longitudes))
        for value in parallels
        if abs(value) < 90
    ]
    wanted_deg = max(wanted_deg / max(cos(origin.latitude_rad), 0.02), (east_deg - west_deg) / (2 * _LINES))
    step = next((step for step in _STEPS_DEG if step >= wanted_deg), _STEPS_DEG[-1])
    first, last = ceil(west_deg / step), floor(east_deg / step)
    last = min(last, first + round(360 / step) - 1)
    latitudes = np.linspace(south_deg, north_deg, _LINE_POINTS)
    for value in (number * step for number in range(first, last + 1)):
        label = _label((value + 180) % 360 - 180, step, "EW")
        lines.append(GraticuleLine(label, False, _line_m(origin, latitudes, np.full(_LINE_POINTS, value))))
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
