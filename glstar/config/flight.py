"""The sections ``[flight]``, ``[flight.synthetic]``, ``[navigator]``, ``[mount]`` and ``[air]`` of the config."""

from collections.abc import Mapping
from datetime import UTC, datetime
from math import degrees, radians
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, Literal
from urllib.parse import urlencode

from pydantic import Field, create_model, field_validator

from glstar.camera.model import Mount
from glstar.config.section import Section
from glstar.errors import ConfigError
from glstar.flight import Interpolation
from glstar.flight.gimbal import Gimbal, GimbalMode
from glstar.flight.navigator import AttitudeErrorModel, MountError
from glstar.flight.synthetic.syntheticflight import FlightPath, SyntheticFlight
from glstar.sky.air.extinction import Extinction
from glstar.sky.place import site
from glstar.sky.place.timescale import parse_known_utc, parse_utc
from glstar.telemetry import FlightOptions, read_track
from glstar.telemetry.synthetic import KEYS, PREFIX, Setting, synthetic_flight

# Name of the section, and prefix of its keys in a sweep.
SYNTHETIC = "flight.synthetic"
# Keys that accept a list besides their text.
_LISTS = {
    "waypoints": "a list of [latitude_deg, longitude_deg, height_m]",
    "vibration": "a list of [frequency_hz, amplitude_deg, axis]",
}
# Keys that do not change how long a flight lasts.
_OF_ANY_LENGTH = {
    "latitude_deg",
    "longitude_deg",
    "height_m",
    "utc_start",
    "direction",
    "route",
    "pitch_deg",
    "roll_deg",
    "gusts",
    "yaw_rate_deg_per_s",
    "height_above_ground_m",
    "span_m",
    "natural_frequency_hz",
    "damping",
    "vibration",
    "seed",
}

_DEGREES = "a number of degrees"
_SPREAD = "a number of degrees, 0 or more"

_MOUNT, _EXTINCTION = Mount(), Extinction()

# Command-line flags of the keys of [flight].
FLIGHT_FLAGS = MappingProxyType(
    {
        "utc_start": "--utc-start",
        "latitude_deg": "--lat",
        "longitude_deg": "--lon",
        "height_m": "--height",
        "sysid": "--sysid",
        "vehicle": "--vehicle",
        "boot": "--boot",
        "attitude": "--attitude",
        "time_offset_s": "--time-offset",
        "max_gap_s": "--max-gap",
        "interpolation": "--interpolation",
        "columns": "--columns",
        "position": "--position",
    }
)


class _SyntheticKeys(Section):
    """The part of ``[flight.synthetic]`` that is not a key of `KEYS`."""

    path: FlightPath | None = Field(default=None, description="the path, which makes the section a flight")

    @field_validator("utc_start", mode="before", check_fields=False)
    @classmethod
    def _toml_time(cls, value: object) -> object:
        """Accept a time without quotes, which TOML reads as a datetime."""
        return value.isoformat() if hasattr(value, "isoformat") else value

    @property
    def settings(self) -> dict[str, str]:
        """The values of `KEYS` that are given, as text."""
        values = {key: getattr(self, key) for key in KEYS}
        return {key: _text(value) for key, value in values.items() if value is not None}

    @property
    def description(self) -> str | None:
        """The same flight in one line, ``fly:orbit?radius_m=300``; None without a path."""
        if self.path is None:
            return None
        query = urlencode(self.settings, safe=":,;")
        return f"{PREFIX}{self.path}{'?' if query else ''}{query}"

    def flight(self) -> SyntheticFlight:
        """Return the described flight; raises ConfigError if there is no path, or a value is impossible."""
        if self.path is None:
            key = next(iter(self.settings), None)
            message = "is missing" if key is None else f"is missing beside {key}"
            raise ConfigError(f'path {message}; it makes the section a flight, such as path = "orbit"')
        return synthetic_flight(self.path, self.settings)


def _text(value: object) -> str:
    """Return a value as a description has it."""
    if isinstance(value, list):
        return ";".join(",".join(map(_text, row)) if isinstance(row, list) else _text(row) for row in value)
    return repr(value) if isinstance(value, float) else str(value)


def _kind(key: str, setting: Setting) -> Any:
    if key == "gusts":
        return float | str | None
    if key in _LISTS:
        return str | list[list[Any]] | None
    if setting.is_number:
        return float | None
    return int | None if setting.is_whole_number else str | None


def _field(key: str, setting: Setting) -> Any:
    kind = "a number" if setting.is_number else "a whole number" if setting.is_whole_number else "text"
    if key == "gusts":
        kind = "text or a number"
    if key in _LISTS:
        kind = f"{_LISTS[key]}, or text"
    default = f", by default {setting.default}" if setting.default else ""
    return _kind(key, setting), Field(default=None, description=f"{kind}{default} ({setting.help})")


if TYPE_CHECKING:
    SyntheticSection = _SyntheticKeys
else:
    SyntheticSection = create_model(
        "SyntheticSection",
        __base__=_SyntheticKeys,
        __module__=__name__,
        __doc__="``[flight.synthetic]``: a flight without a log; its keys are those of `KEYS`, and ``path``.",
        **{key: _field(key, setting) for key, setting in KEYS.items()},
    )


def changes_length(keys: Mapping[str, Any]) -> bool:
    """Return whether any of these dotted keys may change how long a synthetic flight lasts."""
    return any(
        key.startswith(f"{SYNTHETIC}.") and key.removeprefix(f"{SYNTHETIC}.") not in _OF_ANY_LENGTH for key in keys
    )


class NavigatorSection(Section):
    """``[navigator]``: estimated attitude, mount, clock and position; without any key there is no ``nav.jsonl``."""

    # ``"model"``: the true attitude with the errors of the keys below; else a message of the log, such as ``"ATT"``,
    # with the same errors on top (none by default).
    attitude: str = Field(default="model", min_length=1, description='"model" or the name of a message, such as "ATT"')
    roll_bias_deg: float = Field(default=0.0, description=_DEGREES)
    pitch_bias_deg: float = Field(default=0.0, description=_DEGREES)
    yaw_bias_deg: float = Field(default=0.0, description=_DEGREES)
    bias_sigma_deg: float = Field(default=0.0, ge=0, description=_SPREAD)
    drift_sigma_deg: float = Field(default=0.0, ge=0, description=_SPREAD)
    drift_time_s: float = Field(default=60.0, gt=0, description="a positive number of seconds")
    turn_coupling: float = Field(default=0.0, ge=0, le=1, description="a number from 0 to 1")
    # Errors that turn once per revolution: see `AttitudeErrorModel`.
    revolution_pitch_deg: float = Field(default=0.0, ge=-90, le=90, description="a number of degrees, -90 to 90")
    revolution_roll_deg: float = Field(default=0.0, ge=-90, le=90, description="a number of degrees, -90 to 90")
    revolution_heading_deg: float = Field(default=0.0, description=_DEGREES)
    perlin_deg: float = Field(default=0.0, ge=0, description=_SPREAD)
    perlin_time_s: float = Field(default=10.0, gt=0, description="a positive number of seconds")
    perlin_octaves: int = Field(default=4, ge=1, le=12, description="a whole number from 1 to 12")
    mount_roll_error_deg: float = Field(default=0.0, description=_DEGREES)
    mount_pitch_error_deg: float = Field(default=0.0, description=_DEGREES)
    mount_yaw_error_deg: float = Field(default=0.0, description=_DEGREES)
    clock_offset_s: float = Field(default=0.0, ge=-3600, le=3600, description="a number of seconds, -3600 to 3600")
    gps: Literal["known", "denied"] = "denied"
    seed: int = Field(default=0, ge=0, description="a whole number, 0 or more")  # of the random errors

    @property
    def errors(self) -> AttitudeErrorModel:
        """The errors of the estimated attitude."""
        return AttitudeErrorModel(
            bias_rad=(radians(self.roll_bias_deg), radians(self.pitch_bias_deg), radians(self.yaw_bias_deg)),
            bias_sigma_rad=radians(self.bias_sigma_deg),
            drift_sigma_rad=radians(self.drift_sigma_deg),
            drift_time_s=self.drift_time_s,
            turn_coupling=self.turn_coupling,
            revolution_pitch_rad=radians(self.revolution_pitch_deg),
            revolution_roll_rad=radians(self.revolution_roll_deg),
            revolution_heading_rad=radians(self.revolution_heading_deg),
            perlin_rad=radians(self.perlin_deg),
            perlin_time_s=self.perlin_time_s,
            perlin_octaves=self.perlin_octaves,
        )

    @property
    def is_perfect(self) -> bool:
        """Whether the aircraft knows its true attitude, mount and time."""
        return (
            self.attitude == "model"
            and self.errors == AttitudeErrorModel()
            and self.mount_error == MountError()
            and self.clock_offset_s == 0
        )

    def real_mount(self, nominal: Mount) -> Mount:
        """Return the mount of the camera that takes the frames; the navigator knows the nominal one of ``[mount]``."""
        if self.mount_error == MountError():
            return nominal
        return Mount.from_matrix(self.mount_error.applied(nominal.C_camera_body), reading=nominal.reading)

    @property
    def mount_error(self) -> MountError:
        """The rotation of the real camera against the nominal mount."""
        return MountError(
            radians(self.mount_roll_error_deg), radians(self.mount_pitch_error_deg), radians(self.mount_yaw_error_deg)
        )


class MountSection(Section):
    """``[mount]``: the orientation of the camera on the aircraft."""

    yaw_deg: float = Field(default=degrees(_MOUNT.yaw_rad), description="a number of degrees")
    pitch_deg: float = Field(default=degrees(_MOUNT.pitch_rad), description="a number of degrees")
    roll_deg: float = Field(default=degrees(_MOUNT.roll_rad), description="a number of degrees")
    reading: Literal["body", "literal"] = _MOUNT.reading
    # A mount by name, in place of the angles and their reading; see `glstar.camera.mounts`.
    preset: str | None = Field(default=None, min_length=1, description='the name of a mount, such as "forward-up-30"')
    gimbal: GimbalMode = "none"
    gimbal_roll_limit_deg: float = Field(default=180.0, ge=0, le=180, description="a number of degrees, 0 to 180")
    gimbal_pitch_limit_deg: float = Field(default=90.0, ge=0, le=90, description="a number of degrees, 0 to 90")
    gimbal_lag_s: float = Field(default=0.0, ge=0, le=60, description="a number of seconds, 0 to 60")
    gimbal_heading_lag_s: float = Field(default=0.0, ge=0, le=600, description="a number of seconds, 0 to 600")

    @property
    def carrier(self) -> Gimbal:
        """What carries the camera."""
        limits = radians(self.gimbal_roll_limit_deg), radians(self.gimbal_pitch_limit_deg)
        return Gimbal(self.gimbal, *limits, self.gimbal_lag_s, self.gimbal_heading_lag_s)


class AirSection(Section):
    """``[air]``: pressure and temperature, which determine the refraction, and the extinction."""

    # Pressure at the aircraft (not reduced to sea level), hPa.
    pressure_hpa: float = Field(
        default=site.STANDARD_PRESSURE_HPA,
        ge=site.PRESSURES_HPA[0],
        le=site.PRESSURES_HPA[1],
        description="a number of hPa from 0 to 1200",
    )
    # Temperature at the aircraft, degrees Celsius.
    temperature_c: float = Field(
        default=site.STANDARD_TEMPERATURE_C,
        ge=site.TEMPERATURES_C[0],
        le=site.TEMPERATURES_C[1],
        description="degrees Celsius, from -120 to 100",
    )
    # Extinction per air mass at sea level by the air, the aerosol and the ozone, mag.
    rayleigh_mag: float = Field(default=_EXTINCTION.rayleigh_mag, ge=0, le=10, description="a magnitude from 0 to 10")
    aerosol_mag: float = Field(default=_EXTINCTION.aerosol_mag, ge=0, le=10, description="a magnitude from 0 to 10")
    # Height in which the aerosol falls to 1/e, m.
    aerosol_scale_m: float = Field(default=_EXTINCTION.aerosol_scale_m, gt=0, description="a positive number of metres")
    ozone_mag: float = Field(default=_EXTINCTION.ozone_mag, ge=0, le=10, description="a magnitude from 0 to 10")


class FlightSection(Section):
    """``[flight]``: how the log is read."""

    # ``"auto"``, or the name of the message to take the attitude from.
    attitude: str = Field(default="auto", min_length=1, description='"auto" or the name of a message, such as "ATT"')
    # The camera's clock minus the log's, s; file names of images contain it, see `glstar.flight.Flight`.
    time_offset_s: float = Field(default=0.0, description="a number of seconds")
    # UTC of the first attitude, ISO 8601, for logs without UTC or with a wrong clock.
    utc_start: str | None = Field(default=None, description='a time such as "2024-03-10T11:00:00Z"')
    # For logs without positions: a fixed site, WGS84, east positive; it overrides the positions of the log.
    latitude_deg: float | None = Field(default=None, ge=-90, le=90, description="degrees north, from -90 to 90")
    longitude_deg: float | None = Field(default=None, ge=-180, le=360, description="degrees east, from -180 to 360")
    # Height of that site above the WGS84 ellipsoid, m; None means 0.
    height_m: float | None = Field(
        default=None, ge=site.HEIGHTS_M[0], le=site.HEIGHTS_M[1], description="a number of metres from -1000 to 100000"
    )
    # For telemetry logs of several vehicles: the MAVLink system ID of the vehicle.
    sysid: int | None = Field(default=None, ge=1, le=255, description="a whole number from 1 to 255")
    # For logs of several vehicles: the name space of one in a ROS bag, or its MAVLink system.
    vehicle: str | None = Field(default=None, min_length=1, description='a name space such as "uav1", or a system')
    # For logs of several boots of the autopilot: the number of the boot, from 1.
    boot: int | None = Field(default=None, ge=1, description="a whole number from 1")
    # The longest data gap of the attitude to interpolate across, s; frames in longer gaps are skipped.
    max_gap_s: float | None = Field(default=None, gt=0, description="a positive number of seconds")
    # Interpolation of the attitude between its samples; see `glstar.flight.AttitudeTrack`.
    interpolation: Interpolation = "slerp"
    # Meaning of the columns of a table; see `glstar.telemetry.column_map`.
    columns: str | None = Field(
        default=None, min_length=1, description='a column map such as "airdata", a .toml file, or "time=t,roll=phi,..."'
    )

    # A GPX, KML, NMEA or IGC file with the positions of the flight.
    position: str | None = Field(
        default=None, min_length=1, description="the path of a track: GPX, KML, KMZ, NMEA or IGC"
    )

    @property
    def site(self) -> site.Site | None:
        """The fixed site, in standard air; None if the log's positions are used."""
        if self.latitude_deg is None or self.longitude_deg is None:
            return None
        return site.Site(radians(self.latitude_deg), radians(self.longitude_deg), self.height_m or 0.0)

    @property
    def options(self) -> FlightOptions:
        """The options for reading a log."""
        track = None if self.position is None else read_track(self.position)
        return FlightOptions(self.time_offset_s, self.start_utc_s, self.site, self.max_gap_s, self.interpolation, track)

    @property
    def start_utc_s(self) -> float | None:
        """`utc_start` in UTC seconds since 1970; None if the log's clock is used."""
        return None if self.utc_start is None else parse_utc(self.utc_start)

    @field_validator("utc_start", mode="before")
    @classmethod
    def _toml_time(cls, given: object) -> object:
        """Accept a time without quotes, which TOML reads as a datetime."""
        if isinstance(given, datetime):
            return given.isoformat() if given.tzinfo is None else given.astimezone(UTC).isoformat()
        return given

    @field_validator("utc_start")
    @classmethod
    def _is_a_time(cls, text: str | None) -> str | None:
        if text is not None:
            parse_known_utc(text)
        return text
