"""The config: one TOML file, turned into the nouns of glstar.

Units stand in the key names.  This is the only place where degrees become radians; everything behind it is in SI units
and pixels.  Every key has a default, so that ``Config()`` is a whole config; ``assets/glstar.toml`` is the page that
shows them all.

A `Config` is a snapshot: the files that it names are read once, when it is made.
"""

import json
import re
import tomllib
from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from datetime import UTC, datetime
from difflib import get_close_matches
from math import degrees, floor, radians
from os import PathLike
from pathlib import Path
from types import MappingProxyType
from typing import Any, Final, Literal, Self, TypeVar, get_args, get_origin

from pydantic import BaseModel, ConfigDict, Field, ValidationError, field_validator

from glstar.apparent import ASTROMETRY
from glstar.camera import Camera, Mount
from glstar.camerafile import camera_from_file, camera_from_preset, read_text
from glstar.catalogue import StarCatalogue
from glstar.errors import CalibrationError, ConfigError
from glstar.exposure import Exposure
from glstar.sensor import Sensor
from glstar.simulator import Simulator
from glstar.site import STANDARD_PRESSURE_HPA, STANDARD_TEMPERATURE_C, Site
from glstar.sky import Sky
from glstar.telemetry import Survey, open_flight, open_source, survey
from glstar.timescale import CLOCK_GRAIN_S, parse_utc
from glstar.track import Flight, Interpolation

__all__ = ["FLIGHT_FLAGS", "AirSection", "Config", "ExposureSection", "FlightSection", "SkySection"]

# The camera when nobody names one: it draws a frame in some 30 ms without a GPU.
_BUNDLED_CAMERA = "picamhq-6mm-binned4"
_NUMBERS_OF_A_CAMERA = ("width_px", "height_px", "fx_px", "fy_px")
_CATALOGUES = ("bsc5", "hipparcos")

# A config is a page; larger than this is a flight log in the wrong place.
_LARGEST_BYTES = 2**20

_MOUNT, _SENSOR = Mount(), Sensor()
_RATE_HZ = Exposure(start_utc_s=0.0, duration_s=1.0).rate_hz

# Beyond it float64 has no odd numbers; an interval can be absurdly short.
_MOST_EXPOSURES = 2.0**53


# --- the sections -----------------------------------------------------------------------------------------------------
# The description of a key completes "must be ...": it is what a person reads who got it wrong.


class _Section(BaseModel):
    """A table of the config: known keys only, whole numbers for floats, nothing else converted, no inf and no nan."""

    model_config = ConfigDict(frozen=True, extra="forbid", strict=True, allow_inf_nan=False)


class _CameraSection(_Section):
    width_px: int | None = Field(default=None, ge=1, le=65535, description="a whole number of pixels, from 1 to 65535")
    height_px: int | None = Field(default=None, ge=1, le=65535, description="a whole number of pixels, from 1 to 65535")
    fx_px: float | None = Field(
        default=None, gt=0, description="a positive number of pixels (focal length / pixel pitch)"
    )
    fy_px: float | None = Field(
        default=None, gt=0, description="a positive number of pixels (focal length / pixel pitch)"
    )
    cx_px: float | None = Field(default=None, description="a number of pixels from the centre of the leftmost one")
    cy_px: float | None = Field(default=None, description="a number of pixels from the centre of the topmost one")
    skew_px: float | None = Field(default=None, description="a number of pixels")
    file: str | None = Field(default=None, min_length=1, description="the path of a calibration file, in quotes")
    preset: str | None = Field(
        default=None, min_length=1, description="the name of a camera that glstar knows, in quotes"
    )


class _MountSection(_Section):
    yaw_deg: float = Field(default=degrees(_MOUNT.yaw_rad), description="a number of degrees")
    pitch_deg: float = Field(default=degrees(_MOUNT.pitch_rad), description="a number of degrees")
    roll_deg: float = Field(default=degrees(_MOUNT.roll_rad), description="a number of degrees")
    reading: Literal["body", "literal"] = _MOUNT.reading


class _SensorSection(_Section):
    reference_vmag: float = Field(default=_SENSOR.reference_vmag, description="a magnitude")
    reference_peak_dn: float = Field(default=_SENSOR.reference_peak_dn, gt=0, description="a positive number of DN")
    reference_exposure_s: float = Field(
        default=_SENSOR.reference_exposure_s, gt=0, description="a positive number of seconds"
    )
    psf_sigma_px: float = Field(default=_SENSOR.psf_sigma_px, gt=0, description="a positive number of pixels")
    sky_mean_dn: float = Field(default=_SENSOR.sky_mean_dn, ge=0, description="a number of DN, 0 or more")
    sky_std_dn: float = Field(default=_SENSOR.sky_std_dn, ge=0, description="a number of DN, 0 or more")
    bit_depth: int = Field(default=_SENSOR.bit_depth, ge=1, le=16, description="a whole number from 1 to 16")
    pixel: Literal["integrated", "sampled"] = _SENSOR.pixel
    file: str | None = Field(
        default=None, min_length=1, description="the path of a TOML file with a [sensor] table, in quotes"
    )


class ExposureSection(_Section):
    """``[exposure]``: when the shutter opens, and how finely its time is cut.

    Attributes
    ----------
    duration_s : float
        How long the shutter stays open, s.
    interval_s : float
        From one opening to the next, s.
    rate_hz : float
        The least number of sub-exposures a second.
    """

    duration_s: float = Field(default=0.5, gt=0, description="a positive number of seconds")
    interval_s: float = Field(default=3.0, gt=0, description="a positive number of seconds")
    rate_hz: float = Field(default=_RATE_HZ, gt=0, description="a positive number of sub-exposures a second")

    def nth(self, number: int, first_utc_s: float, *, start_s: float = 0.0) -> Exposure:
        """Return one exposure of the sequence that a camera records on a flight.

        Parameters
        ----------
        number : int
            Which one; the first is 0.
        first_utc_s : float
            The flight's first attitude, UTC seconds since 1970.
        start_s : float
            When the first exposure begins, s from the first attitude.

        Returns
        -------
        Exposure
            The same, to the bit, for all who ask.
        """
        return Exposure(first_utc_s + (start_s + number * self.interval_s), self.duration_s, self.rate_hz)

    def count_within(self, length_s: float) -> int:
        """Return how many exposures of the sequence end within so many seconds.

        Parameters
        ----------
        length_s : float
            From the first opening of the shutter to the last closing, s.

        Returns
        -------
        int
            0 where not even one fits.
        """
        # Half a grain of grace, so that the last one still ends where a track can answer.
        room_s = length_s - self.duration_s + CLOCK_GRAIN_S / 2
        return 0 if room_s < 0 else floor(min(room_s / self.interval_s, _MOST_EXPOSURES)) + 1


class SkySection(_Section):
    """``[sky]``: which stars, and how their places are computed.

    Attributes
    ----------
    catalogue : str
        ``"bsc5"``, ``"hipparcos"``, or the absolute path of a catalogue file (``.sqlite``).
    vmag_limit : float
        The faintest visual magnitude.
    astrometry : {"paper", "erfa"}
        Who computes apparent places.
    refraction : bool
        Whether the air lifts the stars.
    dut1_s : float
        UT1 - UTC, s.
    """

    catalogue: str = Field(
        default="bsc5", min_length=1, description='"bsc5", "hipparcos" or the path of a .sqlite file'
    )
    vmag_limit: float = Field(default=6.5, description="a magnitude")
    astrometry: Literal["paper", "erfa"] = "paper"
    refraction: bool = Field(default=True, description="true or false")
    dut1_s: float = Field(default=0.0, ge=-1, le=1, description="UT1 - UTC in seconds, from -1 to 1")

    @field_validator("catalogue")
    @classmethod
    def _known_or_a_file(cls, name: str) -> str:
        if name not in _CATALOGUES and not _is_file_name(name):
            raise ValueError("neither a catalogue of glstar's nor a file name")
        return name


class AirSection(_Section):
    """``[air]``: what bends the light.

    Attributes
    ----------
    pressure_hpa : float
        Pressure at the aircraft (not reduced to sea level), hPa.
    temperature_c : float
        Temperature at the aircraft, degrees Celsius.
    """

    pressure_hpa: float = Field(
        default=STANDARD_PRESSURE_HPA, ge=0, le=1200, description="a number of hPa from 0 to 1200"
    )
    temperature_c: float = Field(
        default=STANDARD_TEMPERATURE_C, ge=-120, le=100, description="degrees Celsius, from -120 to 100"
    )


class FlightSection(_Section):
    """``[flight]``: how the log is read.

    Attributes
    ----------
    attitude : str
        ``"auto"``, or the name of the message to take the attitude from.
    time_offset_s : float
        The camera's clock minus the log's, s.
    utc_start : str or None
        For logs without UTC: the time of their first attitude, ISO 8601.
    latitude_deg, longitude_deg : float or None
        For logs without positions: the place, WGS84, east positive.  It stands over the log's own.
    height_m : float or None
        Its height, m; 0 unless said otherwise.
    sysid : int or None
        For telemetry logs of several vehicles: the MAVLink system whose flight it is.
    max_gap_s : float or None
        The longest silence of the attitude to interpolate across, s; frames that meet a longer one are skipped.
    interpolation : {"slerp", "spline", "gyro"}
        How the attitude goes between its samples; see `glstar.track.AttitudeTrack`.
    """

    attitude: str = Field(default="auto", min_length=1, description='"auto" or the name of a message, such as "ATT"')
    time_offset_s: float = Field(default=0.0, description="a number of seconds")
    utc_start: str | None = Field(default=None, description='a time such as "2024-03-10T11:00:00Z"')
    latitude_deg: float | None = Field(default=None, ge=-90, le=90, description="degrees north, from -90 to 90")
    longitude_deg: float | None = Field(default=None, ge=-180, le=360, description="degrees east, from -180 to 360")
    height_m: float | None = Field(default=None, ge=-1000, le=100_000, description="a number of metres")
    sysid: int | None = Field(default=None, ge=1, le=255, description="a whole number from 1 to 255")
    max_gap_s: float | None = Field(default=None, gt=0, description="a positive number of seconds")
    interpolation: Interpolation = "slerp"

    @property
    def site(self) -> Site | None:
        """The place, in standard air; None if the config leaves it to the log."""
        if self.latitude_deg is None or self.longitude_deg is None:
            return None
        return Site(radians(self.latitude_deg), radians(self.longitude_deg), self.height_m or 0.0)

    @property
    def reading(self) -> dict[str, Any]:
        """What `telemetry.read_flight` takes."""
        return {
            "time_offset_s": self.time_offset_s,
            "utc_start": self.start_utc_s,
            "site": self.site,
            "max_gap_s": self.max_gap_s,
            "interpolation": self.interpolation,
        }

    @property
    def start_utc_s(self) -> float | None:
        """`utc_start` in UTC seconds since 1970; None if the config leaves it to the log."""
        return None if self.utc_start is None else parse_utc(self.utc_start)

    @field_validator("utc_start", mode="before")
    @classmethod
    def _toml_time(cls, given: object) -> object:
        """Take a time without quotes too, which TOML reads itself."""
        if isinstance(given, datetime):
            return given.isoformat() if given.tzinfo is None else given.astimezone(UTC).isoformat()
        return given

    @field_validator("utc_start")
    @classmethod
    def _is_a_time(cls, text: str | None) -> str | None:
        if text is not None:
            parse_utc(text)
        return text


# How the command line spells the keys of [flight].
FLIGHT_FLAGS: Final = MappingProxyType(
    {
        "utc_start": "--utc-start",
        "latitude_deg": "--lat",
        "longitude_deg": "--lon",
        "sysid": "--sysid",
        "attitude": "--attitude",
        "time_offset_s": "--time-offset",
        "max_gap_s": "--max-gap",
        "interpolation": "--interpolation",
    }
)

_SECTIONS: dict[str, type[_Section]] = {
    "camera": _CameraSection,
    "mount": _MountSection,
    "exposure": ExposureSection,
    "sensor": _SensorSection,
    "sky": SkySection,
    "air": AirSection,
    "flight": FlightSection,
}

# What the keys of a section were given as, before any check.
Tables = dict[str, dict[str, Any]]
# A dotted key and what is wrong with it.
Fault = tuple[str, str]


# --- the config -------------------------------------------------------------------------------------------------------


def _bundled_camera() -> Camera:
    return camera_from_preset(_BUNDLED_CAMERA)


@dataclass(frozen=True, slots=True)
class Config:
    """All the settings of glstar.

    ``Config()`` holds the defaults, `load` reads a file, `override` puts command-line flags on top.  Two configs are
    equal that mean the same, wherever they were read.

    Attributes
    ----------
    exposure : ExposureSection
        ``[exposure]``.
    sky : SkySection
        ``[sky]``.
    air : AirSection
        ``[air]``.
    flight : FlightSection
        ``[flight]``.
    file : pathlib.Path or None
        Where it was read; paths in it are relative to its folder.
    """

    exposure: ExposureSection = field(default_factory=ExposureSection)
    sky: SkySection = field(default_factory=SkySection)
    air: AirSection = field(default_factory=AirSection)
    flight: FlightSection = field(default_factory=FlightSection)
    file: Path | None = field(default=None, compare=False)
    _camera: Camera = field(default_factory=_bundled_camera)
    _mount: _MountSection = field(default_factory=_MountSection)
    _sensor: _SensorSection = field(default_factory=_SensorSection)
    # As given, for `override` to check anew and for `resolved` to name the sources.
    _tables: Tables = field(default_factory=dict, compare=False, repr=False)

    @classmethod
    def load(cls, path: str | PathLike[str]) -> Self:
        """Return the config of a TOML file.

        Parameters
        ----------
        path : path-like
            The file; paths inside it are relative to its folder.

        Returns
        -------
        Config

        Raises
        ------
        ConfigError
            If the file cannot be read or is no TOML, and otherwise with every fault in it at once: the key, what it
            must be, what was given.
        """
        tables, faults = _known_tables(_toml(path))
        return cls._made(tables, faults, Path(path).absolute(), blamed=path)

    def override(self, **flags: Any) -> Self:
        """Return the same config with some keys set anew, as command-line flags do; everything is checked again.

        Parameters
        ----------
        **flags
            Values by dotted key: ``config.override(**{"exposure.duration_s": 1.0})``.  None leaves a key as it is.
            Paths are relative to the working directory.  Another camera file or preset replaces the camera; a number
            of the sensor stands over what its file says.

        Returns
        -------
        Config

        Raises
        ------
        ConfigError
            With every fault at once.
        """
        tables = {section: dict(keys) for section, keys in self._tables.items()}
        given = {key: _absolute(key, value, Path.cwd()) for key, value in flags.items() if value is not None}
        if {"camera.file", "camera.preset"} & given.keys():
            tables["camera"] = {}
        if "sensor.file" in given:
            tables["sensor"] = {}
        elif any(key.startswith("sensor.") for key in given) and "file" in tables.get("sensor", {}):
            tables["sensor"] = self._sensor.model_dump(exclude={"file"})

        faults: list[Fault] = []
        for dotted, value in given.items():
            section, _, key = dotted.partition(".")
            if section in _SECTIONS and key:
                tables.setdefault(section, {})[key] = value
            else:
                every = [f"{name}.{known}" for name, model in _SECTIONS.items() for known in model.model_fields]
                sections = f" (the sections are {', '.join(_SECTIONS)})"
                faults.append((_key(dotted), f"is no key{_did_you_mean(dotted, every, or_else=sections)}"))
        return self._made(tables, faults, self.file, blamed=None)

    def camera(self) -> Camera:
        """Return the camera.

        Returns
        -------
        Camera
            px throughout.
        """
        return self._camera

    def mount(self) -> Mount:
        """Return how the camera is bolted to the aircraft.

        Returns
        -------
        Mount
            Angles in rad.
        """
        mount = self._mount
        return Mount(radians(mount.roll_deg), radians(mount.pitch_deg), radians(mount.yaw_deg), mount.reading)

    def sensor(self) -> Sensor:
        """Return the sensor.

        Returns
        -------
        Sensor
            Brightness in DN.
        """
        return Sensor(**self._sensor.model_dump(exclude={"file"}))

    def open_flight(self, path: str | PathLike[str]) -> Flight:
        """Return the flight of a log, read as ``[flight]`` says.

        Parameters
        ----------
        path : path-like
            The log.

        Returns
        -------
        Flight

        Raises
        ------
        LogFormatError
            If the log cannot be replayed.
        """
        flight = self.flight
        return open_flight(path, attitude=flight.attitude, sysid=flight.sysid, **flight.reading)

    def survey_flight(
        self, path: str | PathLike[str], *, flags: Mapping[str, object] = MappingProxyType({})
    ) -> tuple[Survey, Flight]:
        """Return what a log holds, read as ``[flight]`` says, and its flight.

        Parameters
        ----------
        path : path-like
            The log.
        flags : mapping of str to object
            What the command line said of it, for the command to try.

        Returns
        -------
        Survey
        Flight
            Where the log lacks UTC or place and nobody gave them, at 1970 or at 0 N 0 E.

        Raises
        ------
        LogFormatError
            If the log has no attitude.
        """
        flight = self.flight
        with open_source(path, attitude=flight.attitude, sysid=flight.sysid) as source:
            return survey(source, flags=flags, **flight.reading)

    def simulator(self, flight: Flight, *, sensor: Sensor | None = None) -> Simulator:
        """Return the simulator of a flight under this sky, with this camera.

        Parameters
        ----------
        flight : Flight
        sensor : Sensor, optional
            Another sensor than ``[sensor]`` says.

        Returns
        -------
        Simulator

        Raises
        ------
        CatalogueError
            If the star catalogue cannot be opened.
        """
        stars = StarCatalogue.open(self.sky.catalogue).brighter_than(self.sky.vmag_limit)
        return Simulator.of(
            flight=flight,
            sky=Sky(stars, ASTROMETRY[self.sky.astrometry], self.sky.dut1_s, self.sky.refraction),
            camera=self.camera(),
            mount=self.mount(),
            sensor=self.sensor() if sensor is None else sensor,
            pressure_hpa=self.air.pressure_hpa,
            temperature_c=self.air.temperature_c,
        )

    def resolved(self) -> dict[str, dict[str, Any]]:
        """Return every value of the config, section by section, ready for JSON and TOML.

        Returns
        -------
        dict
            The camera and the sensor as numbers; ``preset`` and ``file`` beside them tell where the numbers came
            from.  What was not given of ``[flight]`` is left out.
        """
        # A config that says nothing about the camera means the bundled one.
        camera_keys = self._tables.get("camera") or {"preset": _BUNDLED_CAMERA}
        return {
            "camera": {f.name: getattr(self._camera, f.name) for f in fields(Camera)} | _source(camera_keys),
            "mount": self._mount.model_dump(),
            "exposure": self.exposure.model_dump(),
            "sensor": self._sensor.model_dump(exclude={"file"}) | _source(self._tables.get("sensor", {})),
            "sky": self.sky.model_dump(),
            "air": self.air.model_dump(),
            "flight": self.flight.model_dump(exclude_none=True),
        }

    def to_toml(self) -> str:
        """Return the config as a TOML file that stands alone: it loads to an equal config, in any folder.

        Returns
        -------
        str
            All values; where camera and sensor came from is a comment.
        """
        lines = []
        for section, values in self.resolved().items():
            lines.append(f"[{section}]")
            for key, value in values.items():
                lines.append(f"{'# from ' if key in _SOURCES else ''}{key} = {_toml_value(value)}")
            lines.append("")
        return "\n".join(lines)

    @classmethod
    def _made(cls, tables: Tables, faults: list[Fault], file: Path | None, blamed: str | PathLike[str] | None) -> Self:
        """Return the config of these tables, or raise all that is wrong with them."""
        folder = Path() if file is None else file.parent
        camera = _camera(_section(_CameraSection, "camera", tables, faults), tables, folder, faults)
        mount = _section(_MountSection, "mount", tables, faults)
        exposure = _section(ExposureSection, "exposure", tables, faults)
        sensor = _sensor(_section(_SensorSection, "sensor", tables, faults), tables, folder, faults)
        sky = _section(SkySection, "sky", tables, faults)
        air = _section(AirSection, "air", tables, faults)
        flight = _flight(_section(FlightSection, "flight", tables, faults), faults)
        if faults:
            raise _config_error(faults, blamed)
        sky = sky.model_copy(update={"catalogue": _absolute("sky.catalogue", sky.catalogue, folder)})
        return cls(exposure, sky, air, flight, file, camera, mount, sensor, tables)


# --- reading ----------------------------------------------------------------------------------------------------------


def _toml(path: str | PathLike[str]) -> dict[str, Any]:
    """Return what a TOML file holds."""
    try:
        return tomllib.loads(read_text(path, _LARGEST_BYTES))
    except tomllib.TOMLDecodeError as error:
        # "Expected '=' after a key in a key/value pair (at line 2, column 9)": the place goes first.
        words = re.fullmatch(r"(.*) \(at (.*)\)", str(error))
        message = f"{words[2]}: {words[1]}" if words else str(error)
        raise ConfigError(f"{message} (TOML)", file=path) from None
    except RecursionError:
        raise ConfigError("is nested too deep to be a config", file=path) from None
    except ValueError as error:
        raise ConfigError(str(error), file=path) from None


def _known_tables(document: dict[str, Any]) -> tuple[Tables, list[Fault]]:
    """Return the sections of a document, and what in it is none."""
    tables: Tables = {}
    faults: list[Fault] = []
    for name, value in document.items():
        if name not in _SECTIONS:
            faults.append((_key(name), f"is no section{_at_home(name) or _did_you_mean(name, list(_SECTIONS))}"))
        elif not isinstance(value, dict):
            faults.append((name, f"must be a section, [{name}] with keys below it, not {_shown(value)}"))
        else:
            tables[name] = value
    return tables, faults


S = TypeVar("S", bound=_Section)
_PLACE = ("latitude_deg", "longitude_deg")


def _section(model: type[S], name: str, tables: Tables, faults: list[Fault]) -> S:
    """Return one section, checked; its defaults if it has faults, which join the others."""
    try:
        return model.model_validate(tables.get(name, {}))
    except ValidationError as refusal:
        for error in refusal.errors(include_url=False, include_context=False):
            key = str(error["loc"][0])
            if error["type"] == "extra_forbidden":
                message = f"is no key of [{name}]{_at_home(key) or _did_you_mean(key, list(model.model_fields))}"
            else:
                message = f"must be {_allowed(model, key)}, not {_shown(error['input'])}{_hint(model, key, error)}"
            faults.append((f"{name}.{_key(key)}", message))
        return model()


def _flight(section: FlightSection, faults: list[Fault]) -> FlightSection:
    """Return the section; half a place is a fault."""
    missing = [key for key in _PLACE if getattr(section, key) is None]
    if missing and (len(missing) < len(_PLACE) or section.height_m is not None):
        faults.extend((f"flight.{key}", "is missing from a place given in numbers") for key in missing)
    return section


def _camera(section: _CameraSection, tables: Tables, folder: Path, faults: list[Fault]) -> Camera:
    """Return the camera that the section means; any camera if it has faults."""
    keys = tables.get("camera", {})
    numbers = [key for key in keys if key in _CameraSection.model_fields and key not in ("file", "preset")]
    ways = [*(way for way in ("file", "preset") if way in keys), *numbers[:1]]
    if len(ways) > 1:
        faults.append(
            ("camera", f"has {' and '.join(ways)}; give a file, or a preset, or numbers, and only one of them")
        )
    elif section.file is not None:
        try:
            return camera_from_file(folder / section.file)
        except CalibrationError as error:
            faults.append(("camera.file", str(error)))
    elif section.preset is not None:
        try:
            return camera_from_preset(section.preset)
        except ConfigError as error:
            faults.append(("camera.preset", str(error).removeprefix("camera.preset: ")))
    elif numbers:
        missing = [key for key in _NUMBERS_OF_A_CAMERA if key not in keys]
        faults.extend((f"camera.{key}", "is missing from a camera given in numbers") for key in missing)
        if section.width_px and section.height_px and section.fx_px and section.fy_px:
            return Camera(
                section.width_px,
                section.height_px,
                section.fx_px,
                section.fy_px,
                (section.width_px - 1) / 2 if section.cx_px is None else section.cx_px,
                (section.height_px - 1) / 2 if section.cy_px is None else section.cy_px,
                section.skew_px or 0.0,
            )
    return _bundled_camera()


def _sensor(section: _SensorSection, tables: Tables, folder: Path, faults: list[Fault]) -> _SensorSection:
    """Return the sensor's section with the values of its file, if it names one."""
    others = [key for key in tables.get("sensor", {}) if key in _SensorSection.model_fields and key != "file"]
    if section.file is None:
        return section
    if others:
        faults.append(("sensor", f"has file and {others[0]}; give a file or numbers, not both"))
        return section
    path = folder / section.file
    try:
        document = _toml(path)
    except ConfigError as error:
        faults.append(("sensor.file", str(error)))
        return section
    # Other tables of a calibration are none of the sensor's business.
    inside, found = _known_tables({"sensor": document.get("sensor")}) if "sensor" in document else ({}, [])
    if "sensor" not in document:
        found = [("sensor", "is missing; a sensor calibration is a TOML file with a [sensor] section")]
    elif "file" in inside.get("sensor", {}):
        found = [("sensor.file", "must not stand here; a calibration file holds the numbers")]
    else:
        section = _section(_SensorSection, "sensor", inside, found)
    faults.extend(("sensor.file", f"{path}: {key}: {message}") for key, message in found)
    return section


def _source(keys: Mapping[str, Any]) -> dict[str, str]:
    """Return what of these keys says where the numbers are."""
    return {key: keys[key] for key in _SOURCES if key in keys}


def _is_file_name(name: str) -> bool:
    return bool(Path(name).suffix) or len(Path(name).parts) > 1


def _absolute(dotted: str, value: object, folder: Path) -> object:
    """Return a path, if this key holds one, that means the same from every folder."""
    if dotted not in _PATHS or not isinstance(value, str | PathLike):
        return value
    if dotted == "sky.catalogue" and not _is_file_name(str(value)):
        return value
    return str((folder / value).absolute())


# --- words ------------------------------------------------------------------------------------------------------------

_PATHS = ("camera.file", "sensor.file", "sky.catalogue")
# Of `resolved`, what tells where values came from; beside the values TOML holds it as a comment.
_SOURCES = ("file", "preset")

_LONGEST = 60


def _config_error(faults: list[Fault], file: str | PathLike[str] | None) -> ConfigError:
    """Return one error with all that is wrong."""
    if len(faults) == 1:
        [(key, message)] = faults
        return ConfigError(message, file=file, key=key)
    words = " | ".join(f"{key}: {message}" for key, message in faults)
    error = ConfigError(f"{len(faults)} faults: {words}", file=file)
    error.key = faults[0][0]
    return error


def _allowed(model: type[_Section], key: str) -> str:
    """Return what a key may be, to follow "must be"."""
    known = model.model_fields[key]
    return known.description or " or ".join(f'"{option}"' for option in _options(model, key))


def _options(model: type[_Section], key: str) -> tuple[str, ...]:
    """Return the words that a key may be, if it is one of a few."""
    annotation = model.model_fields[key].annotation
    if get_origin(annotation) is Literal:
        return get_args(annotation)
    return _CATALOGUES if key == "catalogue" else ()


def _hint(model: type[_Section], key: str, error: Any) -> str:
    """Return what was probably meant, if a word is misspelt or a number stands in quotes."""
    given = error["input"]
    if isinstance(given, str) and error["type"] in ("float_type", "int_type"):
        try:
            float(given)
        except ValueError:
            return ""
        return " (leave out the quotes)"
    return _did_you_mean(given, list(_options(model, key)), quote='"', or_else="") if isinstance(given, str) else ""


def _at_home(key: str) -> str:
    """Return where a key belongs that stands in the wrong place."""
    homes = [name for name, model in _SECTIONS.items() if key in model.model_fields and key != "file"]
    return f" (it belongs in [{homes[0]}])" if homes else ""


def _did_you_mean(word: str, known: list[str], *, quote: str = "", or_else: str | None = None) -> str:
    """Return the nearest known word as a question, or all of them."""
    close = get_close_matches(word.lower(), known, n=1)
    if close:
        return f" (did you mean {quote}{close[0]}{quote}?)"
    return f" (there are {', '.join(known)})" if or_else is None else or_else


def _key(name: str) -> str:
    """Return a key as TOML writes it."""
    return name if re.fullmatch(r"[\w.-]+", name) else _toml_value(name[:_LONGEST])


def _shown(value: object) -> str:
    """Return a value as TOML writes it, or shortly what it is."""
    if isinstance(value, bool | int | float | str):
        text = "a number without end" if isinstance(value, int) and abs(value) > 10**_LONGEST else _toml_value(value)
    elif isinstance(value, dict):
        text = "a table"
    elif isinstance(value, list):
        text = "a list"
    else:
        text = str(value)
    return text if len(text) <= _LONGEST else f"{text[:_LONGEST]}..."


def _toml_value(value: object) -> str:
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, str):
        # TOML's strings are JSON's, but for DEL, which they want escaped.
        return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")
    return repr(float(value)) if isinstance(value, float) else str(value)
