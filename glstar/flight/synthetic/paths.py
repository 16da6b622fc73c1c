"""Paths through moving air: position, heading, bank and climb of an aircraft over time.

All of them are coordinated: tan(bank) = V omega / g with the airspeed V and the heading rate omega.  Positions are
metres north and east of the start (or of an orbit's centre) on a local map, whose scale is right there.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import ArrayLike

from glstar.arrays import Float
from glstar.errors import ConfigError
from glstar.sky.place.site import Site, radii_of_curvature_m

GRAVITY_M_PER_S2 = 9.80665
# Number of nodes of one orbit in wind: the error of the time along it is 1e-10 s.
_ORBIT_NODES = 4096
# Autopilots of small aircraft: the steepest bank, rad, and the largest roll rate, rad/s.
_MOST_BANK_RAD = np.deg2rad(45.0)
_ROLL_RATE_RAD_PER_S = np.deg2rad(30.0)
# Time constant of the bank loop; of the climb loop.
_BANK_TIME_S = 0.4
_CLIMB_TIME_S = 1.0
_MOST_CLIMB_RAD = np.deg2rad(15.0)
# Nearest that a path comes to a pole, where the local map ends, rad.
_NEAREST_POLE_RAD = np.deg2rad(0.1)
_AT_POLE = "the flight crosses a pole, where its local map ends; fly farther from it, or shorter"
# Relative error of the integration of a line over the ellipsoid: micrometres in 1000 km.
_LINE_ERROR = 1e-12
# A leg is never finished that takes longer than this many times its length at the slowest speed, plus this time, s.
_LEG_SLACK = 3.0
_LEG_SLACK_S = 120.0
# Look-ahead of the guidance to a leg, s of flight (Park, Deyst and How 2004 recommend 3 to 5).
_LOOKAHEAD_S = 4.0


@dataclass(frozen=True, slots=True)
class Wind:
    """A steady wind."""

    north_m_per_s: float = 0.0  # Velocity of the air over the ground
    east_m_per_s: float = 0.0

    @classmethod
    def from_direction(cls, speed_m_per_s: float, from_rad: float) -> "Wind":
        """Return a wind that blows from a direction, rad from north through east."""
        return cls(-speed_m_per_s * float(np.cos(from_rad)), -speed_m_per_s * float(np.sin(from_rad)))

    @property
    def speed_m_per_s(self) -> float:
        """Speed of the wind, m/s."""
        return float(np.hypot(self.north_m_per_s, self.east_m_per_s))

    def along(self, course_rad: Float) -> Float:
        """Return the component along a course, m/s."""
        return self.north_m_per_s * np.cos(course_rad) + self.east_m_per_s * np.sin(course_rad)

    def across(self, course_rad: Float) -> Float:
        """Return the component to the right of a course, m/s."""
        return -self.north_m_per_s * np.sin(course_rad) + self.east_m_per_s * np.cos(course_rad)


@dataclass(frozen=True, slots=True)
class LocalMap:
    """Latitude and longitude as metres north and east of an origin, with the scale that is right at its height."""

    origin: Site

    def metres(self, latitude_rad: ArrayLike, longitude_rad: ArrayLike) -> tuple[Float, Float]:
        """Return metres north and east, (...) each, of places, (...) rad; longitudes are continuous from the origin."""
        north_m, east_m = self._per_rad()
        latitude, longitude = np.asarray(latitude_rad), np.asarray(longitude_rad)
        return (latitude - self.origin.latitude_rad) * north_m, (longitude - self.origin.longitude_rad) * east_m

    def place(self, north_m: Float, east_m: Float) -> tuple[Float, Float]:
        """Return latitudes and longitudes, (...) rad: the inverse of `metres`; raises ConfigError near a pole."""
        north_per_rad, east_per_rad = self._per_rad()
        latitude_rad = self.origin.latitude_rad + north_m / north_per_rad
        if np.abs(latitude_rad).max() > np.pi / 2 - _NEAREST_POLE_RAD:
            raise ConfigError(_AT_POLE)
        return latitude_rad, self.origin.longitude_rad + east_m / east_per_rad

    def _per_rad(self) -> tuple[float, float]:
        along_m, across_m = radii_of_curvature_m(self.origin.latitude_rad)
        height_m, cosine = self.origin.height_m, np.cos(self.origin.latitude_rad)
        return float(along_m + height_m), float((across_m + height_m) * cosine)


@dataclass(frozen=True, slots=True, eq=False)
class FlownPath:
    """A flown path."""

    t_s: Float  # (n,) times since the start, s
    north_m: Float  # (n,) position from the start, or from an orbit's centre, on its `LocalMap`, m
    east_m: Float
    up_m: Float
    yaw_rad: Float  # (n,) heading, rad from north through east, continuous
    bank_rad: Float  # (n,) roll angle, right wing down positive, rad
    climb_rad: Float  # (n,) angle of climb through the air, rad


def _speed_over_ground(wind: Wind, course_rad: Float, airspeed_m_per_s: float) -> Float:
    """Return the ground speed on a course, by the wind triangle; raise an error if the wind is too strong."""
    across = wind.across(course_rad)
    if wind.speed_m_per_s >= airspeed_m_per_s:
        raise ConfigError(
            f"a wind of {wind.speed_m_per_s:g} m/s carries an aircraft of {airspeed_m_per_s:g} m/s away:"
            " it cannot follow a path over the ground; fly faster, or take less wind"
        )
    return np.asarray(wind.along(course_rad) + np.sqrt(airspeed_m_per_s**2 - across**2))


def ground_orbit_period_s(*, radius_m: float, airspeed_m_per_s: float, wind: Wind) -> float:
    """Return the time of one turn of a circle over the ground, s.

    Raises ConfigError if the wind is as fast as the aircraft.  The mean of a periodic function at equidistant points
    converges faster than any power of their number.
    """
    course = 2 * np.pi * np.arange(_ORBIT_NODES) / _ORBIT_NODES
    return float(2 * np.pi * radius_m * np.mean(1 / _speed_over_ground(wind, course, airspeed_m_per_s)))


def orbit_over_ground(
    t_s: Float, *, radius_m: float, airspeed_m_per_s: float, wind: Wind, clockwise: bool, bearing_rad: float = 0.0
) -> FlownPath:
    """Return a circle over the ground, flown at constant airspeed: heading, bank and ground speed follow the wind.

    `t_s` (n,): times from 0, rising, s; `clockwise`: seen from above; `bearing_rad`: direction from the centre to the
    start, rad from north through east.  Positions are relative to the centre.  Raises ConfigError if the wind is as
    fast as the aircraft.
    """
    from scipy.interpolate import CubicSpline  # noqa: PLC0415 - slow to import, rarely needed

    sign = 1.0 if clockwise else -1.0
    # Seconds for each radian of the circle, and their sum along it.
    angle = np.linspace(0.0, 2 * np.pi, _ORBIT_NODES + 1)
    course = bearing_rad + sign * (angle + np.pi / 2)
    pace = radius_m / _speed_over_ground(wind, course, airspeed_m_per_s)
    pace[-1] = pace[0]
    elapsed = CubicSpline(angle, pace, bc_type="periodic").antiderivative()
    period_s = ground_orbit_period_s(radius_m=radius_m, airspeed_m_per_s=airspeed_m_per_s, wind=wind)
    turns, rest_s = np.divmod(t_s, period_s)
    angle = np.interp(rest_s, elapsed(angle), angle)
    for _ in range(2):  # Newton's method, to rounding errors
        course = bearing_rad + sign * (angle + np.pi / 2)
        angle += (rest_s - elapsed(angle)) * _speed_over_ground(wind, course, airspeed_m_per_s) / radius_m
    angle = angle + 2 * np.pi * turns
    course = bearing_rad + sign * (angle + np.pi / 2)
    air_along = np.sqrt(airspeed_m_per_s**2 - wind.across(course) ** 2)
    over_ground = _speed_over_ground(wind, course, airspeed_m_per_s)
    yaw_rate = sign * over_ground / radius_m * over_ground / air_along
    bearing = bearing_rad + sign * angle
    return FlownPath(
        t_s=t_s,
        north_m=radius_m * np.cos(bearing),
        east_m=radius_m * np.sin(bearing),
        up_m=np.zeros_like(t_s),
        yaw_rad=course - np.arcsin(wind.across(course) / airspeed_m_per_s),
        bank_rad=np.arctan(airspeed_m_per_s * yaw_rate / GRAVITY_M_PER_S2),
        climb_rad=np.zeros_like(t_s),
    )


def held_orbit(
    t_s: Float, *, radius_m: float, airspeed_m_per_s: float, wind: Wind, clockwise: bool, bearing_rad: float = 0.0
) -> FlownPath:
    """Return circles through the air, flown with constant bank and airspeed; over the ground they drift with the wind.

    Parameters as for `orbit_over_ground`; the radius is that of the circle through the air, and positions are relative
    to the centre of the first circle.
    """
    sign = 1.0 if clockwise else -1.0
    yaw_rate = sign * airspeed_m_per_s / radius_m
    bearing = bearing_rad + yaw_rate * t_s
    bank = np.arctan(airspeed_m_per_s * yaw_rate / GRAVITY_M_PER_S2)
    return FlownPath(
        t_s=t_s,
        north_m=radius_m * np.cos(bearing) + wind.north_m_per_s * t_s,
        east_m=radius_m * np.sin(bearing) + wind.east_m_per_s * t_s,
        up_m=np.zeros_like(t_s),
        yaw_rad=bearing + sign * np.pi / 2,
        bank_rad=np.full_like(t_s, bank),
        climb_rad=np.zeros_like(t_s),
    )


def straight(
    t_s: Float,
    local: LocalMap,
    *,
    course_rad: float,
    airspeed_m_per_s: float,
    wind: Wind,
    climb_rad: float = 0.0,
    great_circle: bool = False,
) -> FlownPath:
    """Return a path over the WGS84 ellipsoid along a course; the aircraft crabs into the wind.

    `t_s` (n,): times from 0, rising, s; `local`: its origin is the start; `course_rad`: direction over the ground at
    the start, rad from north through east, which a rhumb line keeps and a great circle changes; `climb_rad`: angle of
    climb through the air, rad.  Raises ConfigError if the wind is as fast as the aircraft, or the path nears a pole.
    """
    from scipy.integrate import solve_ivp  # noqa: PLC0415 - slow to import

    level_m_per_s = airspeed_m_per_s * float(np.cos(climb_rad))
    climb_m_per_s = airspeed_m_per_s * float(np.sin(climb_rad))
    start = local.origin

    def rates(elapsed_s: float, state: Float) -> list[float]:
        """Return the rates of latitude, longitude and course: a great circle is a geodesic of the ellipsoid."""
        latitude, _, course = state
        along_m, across_m = (
            radius_m + start.height_m + climb_m_per_s * elapsed_s for radius_m in radii_of_curvature_m(latitude)
        )
        speed = _speed_over_ground(wind, course, level_m_per_s)
        east_rate = speed * np.sin(course) / across_m
        turn = east_rate * np.tan(latitude) if great_circle else 0.0
        return [speed * np.cos(course) / along_m, east_rate / np.cos(latitude), turn]

    def to_pole_rad(_: float, state: Float) -> float:
        return float(np.pi / 2 - _NEAREST_POLE_RAD - abs(state[0]))

    to_pole_rad.terminal = True  # type: ignore[attr-defined]
    first = [start.latitude_rad, start.longitude_rad, course_rad]
    flown = solve_ivp(
        rates, (0.0, t_s[-1]), first, "DOP853", t_s, events=to_pole_rad, rtol=_LINE_ERROR, atol=_LINE_ERROR / 1e3
    )
    if flown.status == 1:
        raise ConfigError(_AT_POLE)
    latitude, longitude, course = flown.y
    north_m, east_m = local.metres(latitude, longitude)
    return FlownPath(
        t_s=t_s,
        north_m=north_m,
        east_m=east_m,
        up_m=climb_m_per_s * t_s,
        yaw_rad=course - np.arcsin(wind.across(course) / level_m_per_s),
        bank_rad=np.zeros_like(t_s),
        climb_rad=np.full_like(t_s, climb_rad),
    )


def stationary(t_s: Float, *, yaw_rad: float = 0.0, yaw_rate_rad_per_s: float = 0.0) -> FlownPath:
    """Return the path of an aircraft that stays above one point, level, and may turn about its vertical axis.

    `t_s` (n,): times from 0, rising, s; `yaw_rad`, `yaw_rate_rad_per_s`: heading at the start, rad, and its rate,
    rad/s.
    """
    zero = np.zeros_like(t_s)
    yaw = yaw_rad + yaw_rate_rad_per_s * t_s
    return FlownPath(t_s, north_m=zero, east_m=zero, up_m=zero, yaw_rad=yaw, bank_rad=zero, climb_rad=zero)


def through_waypoints(
    step_s: float, waypoints_m: Sequence[tuple[float, float, float]], *, airspeed_m_per_s: float, wind: Wind
) -> FlownPath:
    """Return the path of an autopilot that flies straight legs between waypoints.

    The bank follows the guidance within 45 deg and rolls in at up to 30 deg/s, so that corners are rounded as real
    aircraft round them.  The path, sampled every `step_s`, begins at the first of two or more waypoints (north_m,
    east_m, up_m) and ends abeam of the last.  Raises ConfigError if there are fewer than two waypoints, two neighbours
    coincide, or the wind is as fast as the aircraft.  S. Park, J. Deyst and J. How, "A new nonlinear guidance logic for
    trajectory tracking", AIAA 2004-4900.
    """
    legs = _legs(waypoints_m)
    _speed_over_ground(wind, np.array([leg.course_rad for leg in legs]), airspeed_m_per_s)
    pilot = _Autopilot(legs[0], airspeed_m_per_s, wind, step_s)
    rows = [pilot.row()]
    slowest = airspeed_m_per_s - wind.speed_m_per_s
    for number, leg in enumerate(legs, 1):
        most_steps = len(rows) + int((_LEG_SLACK * leg.length_m / slowest + _LEG_SLACK_S) / step_s)
        while pilot.to_go_m(leg) > 0:
            if len(rows) > most_steps:
                raise ConfigError(
                    f"the aircraft does not reach waypoint {number + 1}: its leg is too short to turn onto"
                )
            pilot.follow(leg)
            rows.append(pilot.row())
    north, east, up, yaw, bank, climb = np.array(rows).T
    return FlownPath(np.arange(len(rows), dtype=np.float64) * step_s, north, east, up, yaw, bank, climb)


@dataclass(frozen=True, slots=True)
class _Leg:
    """A straight leg from one waypoint to the next."""

    start_m: tuple[float, float, float]
    end_m: tuple[float, float, float]

    @property
    def length_m(self) -> float:
        return float(np.hypot(self.end_m[0] - self.start_m[0], self.end_m[1] - self.start_m[1]))

    @property
    def course_rad(self) -> float:
        return float(np.arctan2(self.end_m[1] - self.start_m[1], self.end_m[0] - self.start_m[0]))


def _legs(waypoints_m: Sequence[tuple[float, float, float]]) -> list[_Leg]:
    if len(waypoints_m) < 2:
        raise ConfigError(f"a path through waypoints needs two of them or more, not {len(waypoints_m)}")
    legs = [_Leg(a, b) for a, b in pairwise(waypoints_m)]
    for number, leg in enumerate(legs, 1):
        if leg.length_m < 1.0:
            raise ConfigError(
                f"the leg from waypoint {number} to {number + 1} is {leg.length_m:.2f} m long; a leg needs 1 m"
            )
    return legs


class _Autopilot:
    """A point mass with bank and climb loops, integrated by the midpoint of each step."""

    def __init__(self, first: _Leg, airspeed_m_per_s: float, wind: Wind, step_s: float) -> None:
        self._airspeed = airspeed_m_per_s
        self._wind = wind
        self._step_s = step_s
        self._north, self._east, self._up = first.start_m
        across = float(wind.across(np.array(first.course_rad)))
        self._yaw = first.course_rad - float(np.arcsin(across / airspeed_m_per_s))
        self._bank = self._climb = 0.0

    def row(self) -> tuple[float, float, float, float, float, float]:
        return self._north, self._east, self._up, self._yaw, self._bank, self._climb

    def to_go_m(self, leg: _Leg) -> float:
        """Distance along the leg to its end, m; the turn into the next leg begins a look-ahead before it."""
        course = leg.course_rad
        along = (self._north - leg.start_m[0]) * np.cos(course) + (self._east - leg.start_m[1]) * np.sin(course)
        return float(leg.length_m - along)

    def follow(self, leg: _Leg) -> None:
        """Fly one step towards a leg."""
        step, course = self._step_s, leg.course_rad
        velocity_north = self._airspeed * np.cos(self._climb) * np.cos(self._yaw) + self._wind.north_m_per_s
        velocity_east = self._airspeed * np.cos(self._climb) * np.sin(self._yaw) + self._wind.east_m_per_s
        speed = float(np.hypot(velocity_north, velocity_east))
        ahead = min(leg.length_m - self.to_go_m(leg) + _LOOKAHEAD_S * speed, leg.length_m + _LOOKAHEAD_S * speed)
        to_north = leg.start_m[0] + ahead * np.cos(course) - self._north
        to_east = leg.start_m[1] + ahead * np.sin(course) - self._east
        off = _wrapped(np.arctan2(to_east, to_north) - np.arctan2(velocity_east, velocity_north))
        acceleration = 2 * speed**2 * np.sin(np.clip(off, -np.pi / 2, np.pi / 2)) / float(np.hypot(to_north, to_east))
        target_bank = np.clip(np.arctan(acceleration / GRAVITY_M_PER_S2), -_MOST_BANK_RAD, _MOST_BANK_RAD)
        roll_rate = np.clip((target_bank - self._bank) / _BANK_TIME_S, -_ROLL_RATE_RAD_PER_S, _ROLL_RATE_RAD_PER_S)
        fraction = min(max(1 - self.to_go_m(leg) / leg.length_m, 0.0), 1.0)
        height = leg.start_m[2] + fraction * (leg.end_m[2] - leg.start_m[2])
        slope = (leg.end_m[2] - leg.start_m[2]) / leg.length_m * speed / self._airspeed
        target_climb = np.clip(slope + (height - self._up) / (_LOOKAHEAD_S * speed), -_MOST_CLIMB_RAD, _MOST_CLIMB_RAD)
        climb_rate = (target_climb - self._climb) / _CLIMB_TIME_S

        middle_bank = self._bank + roll_rate * step / 2
        yaw_rate = GRAVITY_M_PER_S2 * np.tan(middle_bank) / self._airspeed
        middle_yaw, middle_climb = self._yaw + yaw_rate * step / 2, self._climb + climb_rate * step / 2
        level = self._airspeed * np.cos(middle_climb)
        self._north += float((level * np.cos(middle_yaw) + self._wind.north_m_per_s) * step)
        self._east += float((level * np.sin(middle_yaw) + self._wind.east_m_per_s) * step)
        self._up += float(self._airspeed * np.sin(middle_climb) * step)
        self._yaw += float(yaw_rate * step)
        self._bank += float(roll_rate * step)
        self._climb += float(climb_rate * step)


def _wrapped(angle_rad: float) -> float:
    """Return an angle from -pi to pi."""
    return float((angle_rad + np.pi) % (2 * np.pi) - np.pi)
