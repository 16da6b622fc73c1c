"""A synthetic flight: its path, site and time, wind, gusts and vibration."""

from dataclasses import dataclass, field
from math import pi
from typing import Literal, get_args

import numpy as np

from glstar.arrays import Float
from glstar.errors import ConfigError
from glstar.flight.attitude import AttitudeTrack
from glstar.flight.flight import Flight, PositionTrack
from glstar.flight.synthetic import paths
from glstar.flight.synthetic.gusts import AttitudeResponse, DrydenGusts, VibrationLine, vibration_turns
from glstar.rotation import multiply, quaternion_from_euler, quaternion_from_turn
from glstar.sky.place.site import Site

FlightPath = Literal["orbit", "transit", "waypoints", "hover", "spin", "still"]
FLIGHT_PATHS: tuple[FlightPath, ...] = get_args(FlightPath)

# Largest number of attitudes: ten million need some gigabytes of memory.
_MOST_SAMPLES = 10_000_000
# Gusts are modelled from 3 m above the ground.
_LEAST_HEIGHT_M = 3.0


@dataclass(frozen=True, slots=True)
class SyntheticFlight:
    """A flight that is described instead of logged; raises ConfigError if a number is impossible."""

    # ``orbit``: circles; ``transit``: a straight line; ``waypoints``: legs with rounded corners; ``hover``: above one
    # point, shaken by gusts; ``spin``: the same, turning at `yaw_rate_rad_per_s`; ``still``: no motion, no gusts.
    path: FlightPath
    site: Site  # Centre of an orbit, else the start; for ``waypoints`` their first
    start_utc_s: float  # UTC of the first attitude, seconds since 1970
    duration_s: float | None = None  # Duration, s; by default that of `turns` orbits or of all waypoints; else a minute
    airspeed_m_per_s: float = 18.0
    radius_m: float = 150.0
    # Number of orbits, if there is no duration: turns over the ground, or through the air for guidance by attitude.
    turns: float = 1.0
    clockwise: bool = True  # Direction of an orbit, seen from above
    # For an orbit: a circle over the ground, or a constant bank, which drifts with the wind.
    guidance: Literal["ground", "attitude"] = "ground"
    # Course of a transit over the ground; heading of ``hover``, ``spin`` and ``still`` at the start; bearing from an
    # orbit's centre to its start. rad from north through east.
    heading_rad: float = 0.0
    pitch_rad: float = 0.0  # Added to every attitude: angle of attack, or the attitude of ``still``, rad
    roll_rad: float = 0.0
    climb_rad: float = 0.0  # Angle of climb of a transit, rad
    route: Literal["rhumb", "great_circle"] = "rhumb"  # Whether a transit keeps its course, or takes the shortest line
    yaw_rate_rad_per_s: float = pi / 18  # Of a spin
    waypoints: tuple[Site, ...] = ()  # For ``waypoints``
    wind: paths.Wind = field(default_factory=paths.Wind)
    # Mean wind 20 ft above the ground that scales the Dryden gusts, m/s; 0: none, 7.7: light, 15.4: moderate, 23.2:
    # severe.
    gusts_20ft_m_per_s: float = 0.0
    height_above_ground_m: float = 100.0  # For the gusts, m
    span_m: float = 2.0  # Wing span, for the gusts, m
    response: AttitudeResponse = field(default_factory=AttitudeResponse)
    vibration: tuple[VibrationLine, ...] = ()
    rate_hz: float = 200.0  # Attitudes a second
    seed: int = 0  # Of gusts and phases: the same seed gives the same flight

    def __post_init__(self) -> None:
        if self.path not in FLIGHT_PATHS:
            raise ConfigError(f"a synthetic flight is one of {', '.join(FLIGHT_PATHS)}, not {self.path!r}")
        for name in ("airspeed_m_per_s", "radius_m", "turns", "rate_hz", "height_above_ground_m", "span_m"):
            if not 0 < getattr(self, name) < np.inf:
                raise ConfigError(f"a synthetic flight needs {name} above 0, not {getattr(self, name):g}")
        if self.duration_s is not None and not 0 < self.duration_s < np.inf:
            raise ConfigError(f"a synthetic flight needs duration_s above 0, not {self.duration_s:g}")
        if self.path == "waypoints" and len(self.waypoints) < 2:
            raise ConfigError(f"a flight through waypoints needs two or more of them, not {len(self.waypoints)}")
        if self.path != "waypoints" and self._duration_s() * self.rate_hz > _MOST_SAMPLES:
            raise ConfigError(
                f"{self._duration_s():g} s at {self.rate_hz:g} Hz are more than {_MOST_SAMPLES:,} attitudes;"
                " fly shorter, or at a lower rate_hz"
            )

    def flight(self) -> Flight:
        """Return the flight.

        Raises ConfigError if the path cannot be flown: the wind is faster than the aircraft, or a leg is too short.
        """
        path = self._flown()
        utc_s = self.start_utc_s + path.t_s
        level = quaternion_from_euler(path.bank_rad + self.roll_rad, path.climb_rad + self.pitch_rad, path.yaw_rad)
        attitude = AttitudeTrack(utc_s, multiply(quaternion_from_turn(self._turns(path.t_s)), level))
        label = f"synthetic {self.path}"
        return Flight(
            attitude,
            self._positions(path, utc_s),
            label,
            attitude_source=f"{label}, {self.rate_hz:.1f} Hz",
            position_source=label,
            utc_source="given",
        )

    @property
    def length_s(self) -> float:
        """Time from the first attitude to the last, s; a flight through waypoints is flown to find it."""
        if self.path == "waypoints":
            return float(self._flown().t_s[-1])
        return round(self._duration_s() * self.rate_hz) / self.rate_hz

    def _duration_s(self) -> float:
        if self.duration_s is not None:
            return self.duration_s
        if self.path != "orbit":
            return 60.0
        if self.guidance == "attitude":
            return self.turns * 2 * pi * self.radius_m / self.airspeed_m_per_s
        return self.turns * paths.ground_orbit_period_s(
            radius_m=self.radius_m, airspeed_m_per_s=self.airspeed_m_per_s, wind=self.wind
        )

    def _flown(self) -> paths.FlownPath:
        if self.path == "waypoints":
            legs = self._waypoints_m()
            return paths.through_waypoints(
                1 / self.rate_hz, legs, airspeed_m_per_s=self.airspeed_m_per_s, wind=self.wind
            )
        # UTC in float64 has a resolution of 0.24 microseconds: attitudes are evaluated at the rounded times.
        steps = np.arange(round(self._duration_s() * self.rate_hz) + 1)
        t_s = (self.start_utc_s + steps / self.rate_hz) - self.start_utc_s
        if self.path == "orbit":
            fly = paths.orbit_over_ground if self.guidance == "ground" else paths.held_orbit
            return fly(
                t_s,
                radius_m=self.radius_m,
                airspeed_m_per_s=self.airspeed_m_per_s,
                wind=self.wind,
                clockwise=self.clockwise,
                bearing_rad=self.heading_rad,
            )
        if self.path == "transit":
            return paths.straight(
                t_s,
                self._map,
                great_circle=self.route == "great_circle",
                course_rad=self.heading_rad,
                airspeed_m_per_s=self.airspeed_m_per_s,
                wind=self.wind,
                climb_rad=self.climb_rad,
            )
        rate = self.yaw_rate_rad_per_s if self.path == "spin" else 0.0
        return paths.stationary(t_s, yaw_rad=self.heading_rad, yaw_rate_rad_per_s=rate)

    def _turns(self, t_s: Float) -> Float:
        """Return the rotation of the body by gusts and vibration relative to the attitude of the path, (n, 3), rad."""
        gust_seed, phase_seed = np.random.SeedSequence(self.seed).spawn(2)
        turns = vibration_turns(self.vibration, t_s, np.random.default_rng(phase_seed))
        if self.gusts_20ft_m_per_s > 0 and self.path != "still":
            height_m = max(self.height_above_ground_m, _LEAST_HEIGHT_M)
            gusts = DrydenGusts(self.gusts_20ft_m_per_s, height_m, self.airspeed_m_per_s, self.span_m)
            turns += self.response.to(gusts).simulated(t_s.size, 1 / self.rate_hz, np.random.default_rng(gust_seed))
        return turns

    def _waypoints_m(self) -> list[tuple[float, float, float]]:
        """Return the waypoints in metres north, east and above the first."""
        origin = self._map.origin
        longitudes = np.unwrap([site.longitude_rad for site in self.waypoints])
        north_m, east_m = self._map.metres([site.latitude_rad for site in self.waypoints], longitudes)
        up_m = [site.height_m - origin.height_m for site in self.waypoints]
        return list(zip(north_m.tolist(), east_m.tolist(), up_m, strict=True))

    @property
    def _map(self) -> paths.LocalMap:
        return paths.LocalMap(self.waypoints[0] if self.path == "waypoints" else self.site)

    def _positions(self, path: paths.FlownPath, utc_s: Float) -> PositionTrack:
        latitude_rad, longitude_rad = self._map.place(path.north_m, path.east_m)
        return PositionTrack(utc_s, latitude_rad, longitude_rad, self._map.origin.height_m + path.up_m)
