"""Flights without a log: described in one line, or given by a function of time (`ScriptedFlight`).

A description is ``fly:orbit?radius_m=300&wind_m_per_s=8&gusts=light``: the path follows ``fly:``; the keys of `KEYS`
follow ``?``, joined by ``&``.  By default a flight has the position and the night of the bundled flight.
"""

from collections.abc import Callable, Collection, Iterator, Mapping
from dataclasses import dataclass, fields
from math import isfinite
from types import MappingProxyType
from typing import Any, Self
from urllib.parse import parse_qsl
from warnings import warn

import numpy as np

from glstar.arrays import Float
from glstar.errors import ConfigError, LogFormatError
from glstar.flight import Flight
from glstar.flight.synthetic.gusts import AttitudeResponse, VibrationLine
from glstar.flight.synthetic.paths import Wind
from glstar.flight.synthetic.syntheticflight import FLIGHT_PATHS, SyntheticFlight
from glstar.rotation import quaternion_from_euler
from glstar.sky.place.site import Site
from glstar.sky.place.timescale import parse_utc
from glstar.system.userinput import did_you_mean, nearest_word
from glstar.telemetry.recordedlog import read_flight
from glstar.telemetry.source import AttitudeSamples, ClockSamples, LogFacts, PositionSamples, Samples, TelemetrySource

PREFIX = "fly:"

# Mean winds 20 ft above the ground of MIL-F-8785C: 15, 30 and 45 knots.
_GUSTS = {"none": 0.0, "light": 7.7, "moderate": 15.4, "severe": 23.2}


def _number(text: str) -> float:
    number = float(text)
    if not isfinite(number):
        raise ValueError(text)
    return number


def _radians(text: str) -> float:
    return float(np.deg2rad(_number(text)))


def _whole_number(text: str) -> int:
    return int(text)


def _gusts(text: str) -> float:
    if text in _GUSTS:
        return _GUSTS[text]
    try:
        return _number(text)
    except ValueError:
        raise _no_choice(text, _GUSTS) from None


def _no_choice(text: str, choices: Collection[str]) -> ValueError:
    """Return the error of a word that is none of the choices, with the most similar of them."""
    near = nearest_word(text, choices)
    return ConfigError(f"did you mean {near}?") if near else ValueError(text)


def _one_of(*choices: str) -> Callable[[str], str]:
    def check(text: str) -> str:
        if text not in choices:
            raise _no_choice(text, choices)
        return text

    return check


def _waypoints(text: str) -> tuple[Site, ...]:
    sites = []
    for corner in text.split(";"):
        latitude, longitude, *height = (_number(part) for part in corner.split(","))
        if len(height) > 1:
            raise ValueError(corner)
        sites.append(Site(float(np.deg2rad(latitude)), float(np.deg2rad(longitude)), *height))
    return tuple(sites)


def _vibration(text: str) -> tuple[VibrationLine, ...]:
    lines = []
    for line in text.split(";"):
        frequency, amplitude, *axis = line.split(",")
        lines.append(VibrationLine(_number(frequency), _radians(amplitude), *axis))
    return tuple(lines)


@dataclass(frozen=True, slots=True)
class Setting:
    """One key of a described flight."""

    read: Callable[[str], Any]  # Parses the text of a value; raises ValueError if the text is invalid
    default: str  # The default as text; empty if it depends on the path
    help: str  # Description with unit, for ``--help``

    @property
    def is_number(self) -> bool:
        """Whether a value is one real number."""
        return self.read in {_number, _radians, _gusts}

    @property
    def is_whole_number(self) -> bool:
        """Whether a value is one whole number."""
        return self.read is _whole_number


KEYS: Mapping[str, Setting] = {
    "latitude_deg": Setting(_radians, "-34.93", "latitude of an orbit's centre or of the start, deg, north positive"),
    "longitude_deg": Setting(_radians, "138.60", "its longitude, deg, east positive"),
    "height_m": Setting(_number, "300", "height above the WGS84 ellipsoid, m"),
    "utc_start": Setting(parse_utc, "2024-03-10T11:00:00Z", "UTC of the first attitude, ISO 8601"),
    "duration_s": Setting(_number, "", "duration, s; by default an orbit's turns or all waypoints, else 60"),
    "airspeed_m_per_s": Setting(_number, "18", "speed through the air, m/s"),
    "radius_m": Setting(_number, "150", "radius of an orbit, m"),
    "turns": Setting(_number, "1", "number of orbits, if there is no duration"),
    "direction": Setting(_one_of("right", "left"), "right", "turn of an orbit: right (clockwise from above) or left"),
    "guidance": Setting(
        _one_of("ground", "attitude"), "ground", "of an orbit: ground keeps the circle, attitude the bank"
    ),
    "heading_deg": Setting(
        _radians, "0", "course of a transit over the ground, heading of a hover, bearing of an orbit's start, deg"
    ),
    "pitch_deg": Setting(_radians, "0", "added to the pitch of every attitude (angle of attack), deg"),
    "roll_deg": Setting(_radians, "0", "added to the roll of every attitude, deg"),
    "climb_deg": Setting(_radians, "0", "angle of climb of a transit, deg"),
    "route": Setting(
        _one_of("rhumb", "great_circle"),
        "rhumb",
        "of a transit: rhumb keeps the course, great_circle is the shortest line",
    ),
    "yaw_rate_deg_per_s": Setting(_radians, "10", "rate of a spin, deg/s"),
    "waypoints": Setting(_waypoints, "", "latitude,longitude[,height_m] of each, deg, deg, m; semicolons between"),
    "wind_m_per_s": Setting(_number, "0", "speed of the wind, m/s"),
    "wind_from_deg": Setting(_radians, "270", "where the wind comes from, deg from north through east"),
    "gusts": Setting(
        _gusts, "none", "Dryden gusts: none, light, moderate, severe, or the wind 20 ft above ground, m/s"
    ),
    "height_above_ground_m": Setting(_number, "100", "height above the ground, for the gusts, m"),
    "span_m": Setting(_number, "2", "wing span, for the gusts, m"),
    "natural_frequency_hz": Setting(
        _number, "1.5", "of the attitude loop that gusts drive, Hz; 3 to 5 for a multirotor"
    ),
    "damping": Setting(_number, "0.7", "of that loop"),
    "vibration": Setting(_vibration, "", "frequency,amplitude[,axis] of each line, Hz, deg; semicolons between"),
    "rate_hz": Setting(_number, "200", "attitudes a second"),
    "seed": Setting(_whole_number, "0", "of gusts and vibration: the same seed gives the same flight"),
}
# Names of keys in the last release, which are read for one more.
OLD_KEYS = MappingProxyType({"start_utc": "utc_start"})
# Fields of `SyntheticFlight` that take a key's value as it is, and keys whose fields are in radians.
_SAME_NAMES = {field.name for field in fields(SyntheticFlight)} & KEYS.keys()
_ANGLES = ("heading_deg", "pitch_deg", "roll_deg", "climb_deg", "yaw_rate_deg_per_s")


def is_flight_description(name: str) -> bool:
    """Return whether a FLIGHT is a description instead of a file name."""
    return name.startswith(PREFIX)


def parse_description(text: str) -> SyntheticFlight:
    """Return the flight of a description such as ``"fly:orbit?radius_m=300"``.

    Raises ConfigError if the path or a key is unknown, a key is repeated, or a value is impossible.
    """
    path, _, query = text.removeprefix(PREFIX).partition("?")
    try:
        pairs = parse_qsl(query, keep_blank_values=True, strict_parsing=True, separator="&") if query else []
    except ValueError:
        raise ConfigError(f"{text}: keys are written key=value and joined by &") from None
    pairs = [(present_key(key), value) for key, value in pairs]
    keys = [key for key, _ in pairs]
    if twice := {key for key in keys if keys.count(key) > 1}:
        raise ConfigError(f"{text}: {min(twice)} is given twice")
    return synthetic_flight(path, dict(pairs))


def present_key(key: str) -> str:
    """Return a key of a described flight under its present name; warn of an old one."""
    if key not in OLD_KEYS:
        return key
    warn(f"the key {key} is called {OLD_KEYS[key]} now; the old name goes with the next release", stacklevel=2)
    return OLD_KEYS[key]


def synthetic_flight(path: str, settings: Mapping[str, str]) -> SyntheticFlight:
    """Return the flight along one of `FLIGHT_PATHS` that settings, values as text by key of `KEYS`, describe.

    Raises ConfigError if the path or a key is unknown, or a value is impossible.
    """
    if path not in FLIGHT_PATHS:
        near = did_you_mean(path, FLIGHT_PATHS, or_else="")
        raise ConfigError(f"fly: {path!r} is no path{near}; paths are {', '.join(FLIGHT_PATHS)}")
    values = {key: _value(key, settings.get(key, setting.default)) for key, setting in KEYS.items()}
    if unknown := [key for key in settings if key not in KEYS]:
        near = did_you_mean(unknown[0], KEYS, or_else="")
        raise ConfigError(f"fly: {unknown[0]!r} is no key{near}; keys are {', '.join(KEYS)}")
    options = {name: values[name] for name in _SAME_NAMES if values[name] is not None}
    options |= {key.replace("_deg", "_rad"): values[key] for key in _ANGLES}
    return SyntheticFlight(
        path,
        Site(values["latitude_deg"], values["longitude_deg"], values["height_m"]),
        values["utc_start"],
        clockwise=values["direction"] == "right",
        wind=Wind.from_direction(values["wind_m_per_s"], values["wind_from_deg"]),
        gusts_20ft_m_per_s=values["gusts"],
        response=AttitudeResponse(values["natural_frequency_hz"], values["damping"]),
        **options,
    )


def _value(key: str, text: str) -> Any:
    """Return a key's value; None for an empty default."""
    if text == "" and not KEYS[key].default:
        return None
    try:
        return KEYS[key].read(text)
    except (ValueError, TypeError) as error:
        detail = f" ({error})" if isinstance(error, ConfigError) else ""
        raise ConfigError(f"fly: {key} cannot be {text!r}{detail}; it is: {KEYS[key].help}") from None


class SyntheticSource(TelemetrySource):
    """A described flight as a telemetry source; its clock is UTC.

    Raises LogFormatError if `name` describes no flight.
    """

    one_clock = True

    def __init__(self, name: str) -> None:
        self.name = name
        try:
            self._flight: Flight = parse_description(name).flight()
        except ConfigError as error:
            raise LogFormatError(name, str(error).removeprefix(f"{name}: ").removeprefix("fly: ")) from error

    def samples(self) -> Iterator[Samples]:
        """Yield the whole flight, a single batch of each kind."""
        attitude, position = self._flight.attitude, self._flight.position
        source = self._flight.position_source
        segment = np.zeros(attitude.utc_s.size, dtype=np.int64)
        yield AttitudeSamples(attitude.utc_s, attitude.q_body_ned, segment, source)
        yield PositionSamples(position.utc_s, position.latitude_rad, position.longitude_rad, position.height_m, source)
        yield ClockSamples(attitude.utc_s[:1], attitude.utc_s[:1], "given")

    def facts(self, boots: Collection[int] = ()) -> LogFacts:  # noqa: ARG002 - there is one boot
        """Return facts about the source."""
        return LogFacts("synthetic flight")

    def close(self) -> None:
        """Do nothing: there is no open file."""


@dataclass(frozen=True, slots=True, eq=False)
class ScriptedFlight(TelemetrySource):
    """A telemetry source with scripted attitude at a fixed position.

    Attributes
    ----------
    q_body_ned : callable
        The script: seconds since the start, (n,) float64, to quaternions (w, x, y, z), NED to body, (n, 4) float64.
    site : Site
        The position.
    start_utc_s : float
        UTC of the first sample, seconds since 1970.
    duration_s : float
        Time from the first sample to the last, s.
    rate_hz : float
        Sample rate, Hz.
    name : str
        Name of the flight.

    Examples
    --------
    A turn of 8 deg/s over Adelaide, as in figure 6 of Teague & Chahl:

    >>> from math import radians
    >>> site = Site(latitude_rad=radians(-34.93), longitude_rad=radians(138.60))
    >>> flight = ScriptedFlight.steady(site, 1710068400.0, yaw_rate_rad_per_s=radians(8.0)).flight()
    >>> flight.attitude_source
    'script, 200.0 Hz'
    """

    q_body_ned: Callable[[Float], Float]
    site: Site
    start_utc_s: float
    duration_s: float = 10.0
    rate_hz: float = 200.0
    name: str = "scripted flight"

    @classmethod
    def steady(
        cls,
        site: Site,
        start_utc_s: float,
        *,
        duration_s: float = 10.0,
        rate_hz: float = 200.0,
        roll_rad: float = 0.0,
        pitch_rad: float = 0.0,
        yaw_rad: float = 0.0,
        roll_rate_rad_per_s: float = 0.0,
        pitch_rate_rad_per_s: float = 0.0,
        yaw_rate_rad_per_s: float = 0.0,
    ) -> Self:
        """Return a flight whose Euler angles change at constant rates.

        Parameters
        ----------
        site : Site
            The position.
        start_utc_s : float
            UTC of the first sample, seconds since 1970.
        duration_s, rate_hz : float
            Time from the first sample to the last, s; sample rate, Hz.
        roll_rad, pitch_rad, yaw_rad : float
            Euler angles at the start, rad.
        roll_rate_rad_per_s, pitch_rate_rad_per_s, yaw_rate_rad_per_s : float
            Rates of the angles, rad/s; equal to body rates only if the other two angles are zero.

        Returns
        -------
        ScriptedFlight
        """

        def script(t_s: Float) -> Float:
            return quaternion_from_euler(
                roll_rad + roll_rate_rad_per_s * t_s,
                pitch_rad + pitch_rate_rad_per_s * t_s,
                yaw_rad + yaw_rate_rad_per_s * t_s,
            )

        return cls(script, site, start_utc_s, duration_s, rate_hz)

    def samples(self) -> Iterator[Samples]:
        """Yield one batch of each kind."""
        clock_s = np.arange(round(self.duration_s * self.rate_hz) + 1) / self.rate_hz
        yield AttitudeSamples(clock_s, self.q_body_ned(clock_s), np.zeros(clock_s.size, dtype=np.int64), "script")
        site = self.site
        latitude_rad, longitude_rad, height_m = np.array([[site.latitude_rad], [site.longitude_rad], [site.height_m]])
        yield PositionSamples(clock_s[:1], latitude_rad, longitude_rad, height_m, "script")
        yield ClockSamples(clock_s[:1], np.array([self.start_utc_s]), "script")

    def close(self) -> None:
        """Do nothing."""

    def flight(self) -> Flight:
        """Return the flight.

        Returns
        -------
        Flight
        """
        return read_flight(self)
