"""The sections of the config: their keys, allowed values and defaults."""

from collections.abc import Callable
from datetime import UTC, datetime
from math import degrees, radians
from pathlib import Path
from types import MappingProxyType
from typing import Any, Final, Literal

from pydantic import Field, field_validator, model_validator

from glstar.camera.model import Mount
from glstar.config.effectkeys import with_effect_keys
from glstar.config.exposuresection import ExposureSection, exposures_within
from glstar.config.flightsections import SYNTHETIC, SyntheticSection
from glstar.config.navigatorsection import NavigatorSection
from glstar.config.section import Section
from glstar.config.sensorsection import SENSOR_MAPS, SensorSection
from glstar.flight import Interpolation
from glstar.flight.gimbal import Gimbal, GimbalMode
from glstar.render.effects import EFFECTS
from glstar.sky.catalogue import NAMES
from glstar.sky.extinction import Extinction
from glstar.sky.scintillation import SMALL_LENS_RMS
from glstar.sky.site import (
    HEIGHTS_M,
    PRESSURES_HPA,
    STANDARD_PRESSURE_HPA,
    STANDARD_TEMPERATURE_C,
    TEMPERATURES_C,
    Site,
)
from glstar.sky.timescale import parse_known_utc, parse_utc
from glstar.telemetry import FlightOptions, read_track

__all__ = [
    "CATALOGUES",
    "EFFECT_DEFAULTS",
    "EFFECT_SECTIONS",
    "FLIGHT_FLAGS",
    "HORIZONS",
    "PATHS",
    "SECTIONS",
    "SOURCES",
    "AirSection",
    "CameraSection",
    "ExposureSection",
    "FlightSection",
    "MountSection",
    "Section",
    "SensorSection",
    "SkySection",
    "effect_values",
    "exposures_within",
    "is_file_name",
    "split_key",
    "with_effect_keys",
]

CATALOGUES = NAMES
# Values of ``sky.horizon`` that are no files.
HORIZONS = ("flat", "dip")

_MOUNT, _EXTINCTION = Mount(), Extinction()
# The keys of [sky] with a preset: "full" has what glstar's later versions have added.
_NATURAL = {"bodies": True, "extinction": "standard", "brightness": "natural", "horizon": "dip"}
_FULL = {
    **_NATURAL,
    "zodiacal_light": True,
    "galaxy": True,
    "extinction_band": "sensor",
    "scintillation": SMALL_LENS_RMS,
}
_PRESETS = {"natural": _NATURAL, "full": _FULL}


class CameraSection(Section):
    """``[camera]``: a file, a preset, or numbers; `reading.camera_of` checks that only one of them is given."""

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
    lens: Literal["none", "plumb_bob", "rational", "fisheye"] = "none"
    distortion: list[float] | None = Field(
        default=None, max_length=14, description="a list of numbers, OpenCV's distortion coefficients in its order"
    )
    file: str | None = Field(default=None, min_length=1, description="the path of a calibration file, in quotes")
    camera: str | None = Field(
        default=None, min_length=1, description="the name of a camera in a file of several, in quotes"
    )
    preset: str | None = Field(
        default=None, min_length=1, description="the name of a camera or of a sensor's mode, in quotes"
    )
    lens_mm: float | None = Field(default=None, gt=0, description="a positive number of millimetres")
    f_number: float | None = Field(default=None, gt=0, description="a positive number")


class MountSection(Section):
    """``[mount]``: the orientation of the camera on the aircraft."""

    yaw_deg: float = Field(default=degrees(_MOUNT.yaw_rad), description="a number of degrees")
    pitch_deg: float = Field(default=degrees(_MOUNT.pitch_rad), description="a number of degrees")
    roll_deg: float = Field(default=degrees(_MOUNT.roll_rad), description="a number of degrees")
    reading: Literal["body", "literal"] = _MOUNT.reading
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


@with_effect_keys("sky")
class SkySection(Section):
    """``[sky]``: the stars, and how their apparent places are computed.

    Attributes
    ----------
    catalogue : str
        ``"bsc5"``, ``"hipparcos"``, ``"tycho2"``, ``"gaia"``, or the absolute path of a catalogue file (``.sqlite``).
    vmag_limit : float
        The faintest visual magnitude.
    astrometry : {"paper", "erfa"}
        The implementation of apparent places: the paper's formulae, corrected, or ERFA.
    refraction : bool
        Whether atmospheric refraction is simulated.
    dut1_s : float or None
        UT1 - UTC, s; None for the IERS table if it is installed, else 0.
    bodies : bool
        Whether the Sun, the Moon and the planets are drawn.
    extinction : {"none", "standard", "pressure"}
        Extinction by the air above the aircraft: of a standard atmosphere at its height, or by ``air.pressure_hpa``.
    extinction_band : {"eye", "sensor"}
        Wavelength of the extinction: 510 nm, or that of the sensor's band, with a mosaic that of each channel.
    horizon : str
        ``"flat"``: the horizontal; ``"dip"``: as far below it as the aircraft's height makes it; or the absolute path
        of a CSV file with the altitude of the horizon by azimuth.
    satellites : str or None
        The absolute path of a file of two-line elements.
    satellite_mag : float
        V magnitude of a satellite 1000 km away, half lit.
    preset : {"natural", "full"} or None
        Other defaults: see `_PRESETS`.
    """

    catalogue: str = Field(
        default="bsc5", min_length=1, description='"bsc5", "hipparcos", "tycho2", "gaia" or the path of a .sqlite file'
    )
    vmag_limit: float = Field(default=6.5, description="a magnitude")
    astrometry: Literal["paper", "erfa"] = "paper"
    refraction: bool = Field(default=True, description="true or false")
    dut1_s: float | None = Field(default=None, ge=-1, le=1, description="UT1 - UTC in seconds, from -1 to 1")
    bodies: bool = Field(default=False, description="true or false")
    extinction: Literal["none", "standard", "pressure"] = "none"
    extinction_band: Literal["eye", "sensor"] = "eye"
    horizon: str = Field(default="flat", description='"flat", "dip" or the path of a .csv file')
    satellites: str | None = Field(default=None, description="the path of a file of two-line elements")
    satellite_mag: float = Field(default=4.5, ge=-10, le=20, description="a magnitude from -10 to 20")
    preset: Literal["natural", "full"] | None = None

    @model_validator(mode="before")
    @classmethod
    def _with_preset(cls, given: Any) -> Any:
        """Replace the defaults of keys that are not given by those of the preset."""
        preset = given.get("preset") if isinstance(given, dict) else None
        return {**_PRESETS[preset], **given} if isinstance(preset, str) and preset in _PRESETS else given

    @field_validator("catalogue")
    @classmethod
    def _known_or_a_file(cls, name: str) -> str:
        if name not in CATALOGUES and not is_file_name(name):
            raise ValueError("neither a catalogue of glstar's nor a file name")
        return name

    @field_validator("horizon")
    @classmethod
    def _level_or_a_file(cls, name: str) -> str:
        if name not in HORIZONS and not is_file_name(name):
            raise ValueError("neither a kind of horizon nor a file name")
        return name


class AirSection(Section):
    """``[air]``: pressure and temperature, which determine the refraction, and what the air takes of the light.

    Attributes
    ----------
    pressure_hpa : float
        Pressure at the aircraft (not reduced to sea level), hPa.
    temperature_c : float
        Temperature at the aircraft, degrees Celsius.
    rayleigh_mag, aerosol_mag, ozone_mag : float
        Extinction per air mass at sea level by the air, the aerosol and the ozone, mag.
    aerosol_scale_m : float
        Height in which the aerosol falls to 1/e, m.
    """

    pressure_hpa: float = Field(
        default=STANDARD_PRESSURE_HPA,
        ge=PRESSURES_HPA[0],
        le=PRESSURES_HPA[1],
        description="a number of hPa from 0 to 1200",
    )
    temperature_c: float = Field(
        default=STANDARD_TEMPERATURE_C,
        ge=TEMPERATURES_C[0],
        le=TEMPERATURES_C[1],
        description="degrees Celsius, from -120 to 100",
    )
    rayleigh_mag: float = Field(default=_EXTINCTION.rayleigh_mag, ge=0, le=10, description="a magnitude from 0 to 10")
    aerosol_mag: float = Field(default=_EXTINCTION.aerosol_mag, ge=0, le=10, description="a magnitude from 0 to 10")
    aerosol_scale_m: float = Field(default=_EXTINCTION.aerosol_scale_m, gt=0, description="a positive number of metres")
    ozone_mag: float = Field(default=_EXTINCTION.ozone_mag, ge=0, le=10, description="a magnitude from 0 to 10")


class FlightSection(Section):
    """``[flight]``: how the log is read.

    Attributes
    ----------
    attitude : str
        ``"auto"``, or the name of the message to take the attitude from.
    time_offset_s : float
        The camera's clock minus the log's, s; file names of images contain it, see `glstar.flight.Flight`.
    utc_start : str or None
        UTC of the first attitude, ISO 8601, for logs without UTC or with a wrong clock.
    latitude_deg, longitude_deg : float or None
        For logs without positions: a fixed site, WGS84, east positive.  It overrides the positions of the log.
    height_m : float or None
        Height of that site above the WGS84 ellipsoid, m; None means 0.
    sysid : int or None
        For telemetry logs of several vehicles: the MAVLink system ID of the vehicle.
    boot : int or None
        For logs of several boots of the autopilot: the number of the boot, from 1.
    max_gap_s : float or None
        The longest data gap of the attitude to interpolate across, s; frames in longer gaps are skipped.
    interpolation : {"slerp", "spline", "gyro"}
        Interpolation of the attitude between its samples; see `glstar.flight.AttitudeTrack`.
    columns : str or None
        What the columns of a table mean; see `glstar.telemetry.column_map`.
    position : str or None
        A GPX, KML, NMEA or IGC file with the positions of the flight.
    """

    attitude: str = Field(default="auto", min_length=1, description='"auto" or the name of a message, such as "ATT"')
    time_offset_s: float = Field(default=0.0, description="a number of seconds")
    utc_start: str | None = Field(default=None, description='a time such as "2024-03-10T11:00:00Z"')
    latitude_deg: float | None = Field(default=None, ge=-90, le=90, description="degrees north, from -90 to 90")
    longitude_deg: float | None = Field(default=None, ge=-180, le=360, description="degrees east, from -180 to 360")
    height_m: float | None = Field(
        default=None, ge=HEIGHTS_M[0], le=HEIGHTS_M[1], description="a number of metres from -1000 to 100000"
    )
    sysid: int | None = Field(default=None, ge=1, le=255, description="a whole number from 1 to 255")
    boot: int | None = Field(default=None, ge=1, description="a whole number from 1")
    max_gap_s: float | None = Field(default=None, gt=0, description="a positive number of seconds")
    interpolation: Interpolation = "slerp"
    columns: str | None = Field(
        default=None, min_length=1, description='a column map such as "airdata", a .toml file, or "time=t,roll=phi,..."'
    )

    position: str | None = Field(
        default=None, min_length=1, description="the path of a track: GPX, KML, KMZ, NMEA or IGC"
    )

    @property
    def site(self) -> Site | None:
        """The fixed site, in standard air; None if the log's positions are used."""
        if self.latitude_deg is None or self.longitude_deg is None:
            return None
        return Site(radians(self.latitude_deg), radians(self.longitude_deg), self.height_m or 0.0)

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


# Command-line flags of the keys of [flight].
FLIGHT_FLAGS: Final = MappingProxyType(
    {
        "utc_start": "--utc-start",
        "latitude_deg": "--lat",
        "longitude_deg": "--lon",
        "sysid": "--sysid",
        "boot": "--boot",
        "attitude": "--attitude",
        "time_offset_s": "--time-offset",
        "max_gap_s": "--max-gap",
        "interpolation": "--interpolation",
        "columns": "--columns",
        "position": "--position",
    }
)

# Sections that contain only keys of an effect; [sensor] and [sky] have keys of their own too.
EFFECT_SECTIONS: dict[str, type[Section]] = {
    effect.section: with_effect_keys(effect.section)(Section)
    for effect in EFFECTS
    if effect.section not in ("sensor", "sky")
}


# Values of the effects' keys that `Sensor.effects` need not contain, by dotted key.
EFFECT_DEFAULTS: Final = MappingProxyType(
    {f"{effect.section}.{key.name}": key.default for effect in EFFECTS for key in effect.keys}
)


def effect_values(checked: Callable[[type[Section], str], Section]) -> dict[str, dict[str, Any]]:
    """Return the values of the effects that have their own section.

    Parameters
    ----------
    checked : callable
        Takes a model and the name of a section, and returns the checked section.

    Returns
    -------
    dict of str to dict of str to float, int, bool or str
        By section and key.
    """
    return {name: checked(model, name).model_dump() for name, model in EFFECT_SECTIONS.items()}


SECTIONS: dict[str, type[Section]] = {
    "camera": CameraSection,
    "mount": MountSection,
    "exposure": ExposureSection,
    "sensor": SensorSection,
    "sky": SkySection,
    "air": AirSection,
    "flight": FlightSection,
    SYNTHETIC: SyntheticSection,
    "navigator": NavigatorSection,
    **EFFECT_SECTIONS,
}

PATHS = (
    *("camera.file", "sensor.file", "sensor.star_brightness", "sky.catalogue", "sky.horizon"),
    "sky.satellites",
    *("flight.columns", "flight.position"),
    *(f"sensor.{key}" for key in SENSOR_MAPS),
    "lens.vignetting_file",
    "output.tone_curve",
)
# Keys that name the source of other values; `Config.to_toml` writes them as comments.
SOURCES = ("file", "camera", "preset")


def split_key(dotted: str) -> tuple[str, str]:
    """Return the section and the key of a dotted key; ``flight.synthetic`` is a section too."""
    nested = next((name for name in SECTIONS if "." in name and dotted.startswith(f"{name}.")), None)
    section = nested or dotted.partition(".")[0]
    return section, dotted[len(section) + 1 :]


def is_file_name(name: str) -> bool:
    """Return whether a name is a path rather than one of the names that glstar knows."""
    return bool(Path(name).suffix) or len(Path(name).parts) > 1
