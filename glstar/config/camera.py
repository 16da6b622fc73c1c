"""The sections ``[camera]`` and ``[exposure]``, and checks of ``[lens]`` and ``[output]`` on several keys or a file."""

from dataclasses import fields
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pydantic import Field, field_validator

from glstar.camera.distortion import LensModel
from glstar.camera.exposure import MAX_FRAMES, Exposure, ExposureControl, Metering, Readout, Stack, Trail
from glstar.camera.model import Camera
from glstar.camera.sensor.pixelpattern import read_map
from glstar.camera.sensor.sensor import NoiseModel
from glstar.camera.sensor.tonecurve import checked_points, curve_text, is_curve_text, parse_curve, read_curve
from glstar.config.section import Section
from glstar.errors import ConfigError
from glstar.sky.place.timescale import CLOCK_GRAIN_S

_EXPOSURE = Exposure(start_utc_s=0.0, duration_s=1.0)

# Limit of the number of exposures, because an interval may be extremely short: float64 holds all integers up to this.
_MOST_EXPOSURES = 2.0**53


class ExposureSection(Section):
    """``[exposure]``: exposure times, and how trails are drawn."""

    duration_s: float = Field(default=0.5, gt=0, description="a positive number of seconds")
    # When exposures begin: when the log says that this camera was triggered, see `Flight.triggers_of`; None for a
    # regular interval.
    at: str | None = Field(
        default=None, pattern=r"^(camera(:.+)?|/.+)$", description='"camera", or of several "camera:1" or a topic'
    )
    # Time from a trigger of the camera to the opening of its shutter, s.
    at_delay_s: float = Field(default=0.0, allow_inf_nan=False, description="a number of seconds")
    # Time from the start of one exposure to the start of the next, s.
    interval_s: float = Field(default=3.0, gt=0, description="a positive number of seconds")
    # The minimum number of sub-exposures per second, for "sprites".
    rate_hz: float = Field(default=_EXPOSURE.rate_hz, gt=0, description="a positive number of sub-exposures a second")
    trail: Trail = _EXPOSURE.trail  # how trails are drawn: see `Exposure`
    # Largest distance between true and drawn positions of a star on an analytic trail, px: see `Exposure`.
    path_tolerance_px: float = Field(default=_EXPOSURE.path_tolerance_px, ge=0, description="a number of px, 0 or more")
    # Fainter analytic trails are omitted, up to 0.05 % of the flux, DN: see `Exposure`.
    faintest_dn: float = Field(default=_EXPOSURE.faintest_dn, ge=0, description="a number of DN, 0 or more")
    # Readout time of a rolling shutter, s; 0 for a global shutter.
    readout_s: float = Field(default=_EXPOSURE.readout_s, ge=0, description="a number of seconds, 0 or more")
    readout: Readout = _EXPOSURE.readout  # direction in which the rolling shutter proceeds
    # Number of short exposures that are stacked into each image.
    frames: int = Field(
        default=_EXPOSURE.frames, ge=1, le=MAX_FRAMES, description=f"a whole number from 1 to {MAX_FRAMES}"
    )
    # Time from the end of one short exposure to the start of the next, s.
    gap_s: float = Field(default=_EXPOSURE.gap_s, ge=0, description="a number of seconds, 0 or more")
    stack: Stack = _EXPOSURE.stack  # whether short exposures are added or averaged
    # Automatic exposure: see `ExposureControl`; `duration_s` is its longest exposure time, and that of the first frame.
    control: Literal["none", Metering] = "none"
    control_target: float = Field(default=0.16, gt=0, lt=1, description="a number between 0 and 1")
    control_percentile: float = Field(default=99.0, ge=0, le=100, description="a number from 0 to 100")
    control_min_s: float = Field(default=0.0001, gt=0, description="a positive number of seconds")
    control_min_gain: float = Field(default=1.0, gt=0, description="a positive number")
    control_max_gain: float = Field(default=16.0, gt=0, description="a positive number")
    control_delay_frames: int = Field(default=2, ge=1, le=30, description="a whole number from 1 to 30")
    control_speed: float = Field(default=0.2, gt=0, le=1, description="a number above 0, at most 1")

    @field_validator("trail", mode="before")
    @classmethod
    def _analytic_was_swept(cls, value: object) -> object:
        """Accept "swept", the name of "analytic" up to glstar 0.1."""
        return "analytic" if value == "swept" else value

    def nth(self, number: int, first_utc_s: float, *, start_s: float = 0.0) -> Exposure:
        """Return one exposure of the sequence that a camera records on a flight.

        `number`: number of the exposure, from 0; `first_utc_s`: the flight's first attitude, UTC seconds since 1970;
        `start_s`: start of the first exposure, s after the first attitude.
        """
        return self.starting_at(first_utc_s + (start_s + number * self.interval_s))

    @property
    def exposure_control(self) -> ExposureControl | None:
        """The automatic exposure; None without."""
        if self.control == "none":
            return None
        return ExposureControl(
            self.control,
            self.control_target,
            self.control_percentile,
            (self.control_min_s, self.duration_s),
            (self.control_min_gain, self.control_max_gain),
            self.control_delay_frames,
            self.control_speed,
        )

    @property
    def span_s(self) -> float:
        """Time from the first opening to the last closing: of all rows and all short exposures, s."""
        return self.starting_at(0.0).span_s

    @property
    def signal_factor(self) -> int:
        """Ratio of the signals of an image and of one short exposure: see `Exposure.signal_factor`."""
        return self.starting_at(0.0).signal_factor

    def starting_at(self, start_utc_s: float, duration_s: float | None = None) -> Exposure:
        """Return an exposure with the section's settings.

        `start_utc_s`: when the shutter opens, UTC seconds since 1970; `duration_s`: another exposure time, s.
        """
        duration_s = self.duration_s if duration_s is None else duration_s
        return Exposure(
            start_utc_s=start_utc_s,
            duration_s=duration_s,
            rate_hz=self.rate_hz,
            trail=self.trail,
            readout_s=self.readout_s,
            readout=self.readout,
            path_tolerance_px=self.path_tolerance_px,
            faintest_dn=self.faintest_dn,
            frames=self.frames,
            gap_s=self.gap_s,
            stack=self.stack,
        )

    def count_within(self, length_s: float) -> int:
        """Return the number of exposures of the sequence in a time from the first start to the last end."""
        return int(exposures_within(length_s, self.span_s, self.interval_s))


def exposures_within(length_s: ArrayLike, span_s: ArrayLike, interval_s: ArrayLike) -> NDArray[np.int64]:
    """Return the numbers of exposures of a sequence, (...), that end within a time span; 0 where none fits.

    `length_s` (...): time from the start of the first exposure to the end of the last; `span_s` (...): time from the
    start of an exposure to its end (with a rolling shutter, until the last row closes); `interval_s` (...): time from
    one start to the next.
    """
    # A tolerance of half the resolution of the clock, so that the last exposure may end with the track.
    length, span, interval = (np.asarray(time, dtype=np.float64) for time in (length_s, span_s, interval_s))
    remaining_s = length - span + CLOCK_GRAIN_S / 2
    with np.errstate(over="ignore"):
        counts = np.floor(np.clip(remaining_s / interval, 0.0, _MOST_EXPOSURES))
    return np.where(remaining_s < 0, 0, counts.astype(np.int64) + 1)


def checked_control(exposure: ExposureSection, noise: NoiseModel, faults: list[tuple[str, str]]) -> None:
    """Check exposure control against the exposure and the sensor's noise model; errors are appended to `faults`."""
    if exposure.control == "none":
        return
    if noise == "paper":
        message = 'needs [sensor] noise = "electrons": the sky of the paper\'s sensor does not depend on the exposure'
        faults.append(("exposure.control", message))
    if exposure.control_min_s > exposure.duration_s:
        message = f"is {exposure.control_min_s:g} s, longer than exposure.duration_s, {exposure.duration_s:g} s"
        faults.append(("exposure.control_min_s", f"{message}, which is the longest exposure"))
    if exposure.control_min_gain > exposure.control_max_gain:
        message = f"is {exposure.control_min_gain:g}, more than control_max_gain, {exposure.control_max_gain:g}"
        faults.append(("exposure.control_min_gain", message))


def checked_lens(values: dict[str, Any], camera: Camera, folder: Path, faults: list[tuple[str, str]]) -> dict[str, Any]:
    """Return the values of ``[lens]`` with the absolute path of its flat field.

    `values`: the section, each key checked on its own; `camera`: the flat field must have its size; `folder`: the
    folder that the path is relative to; `faults`: errors are appended.
    """
    file = values["vignetting_file"]
    if values["vignetting"] != "flat":
        if file:
            faults.append(("lens.vignetting_file", 'needs vignetting = "flat"'))
        return values
    if not file:
        faults.append(("lens.vignetting_file", 'is missing from vignetting = "flat"'))
        return values
    path = str((folder / file).absolute())
    try:
        height_px, width_px = read_map(path).shape
    except ConfigError as error:
        faults.append(("lens.vignetting_file", f"cannot be used: {error}"))
        return values
    if (width_px, height_px) != (camera.width_px, camera.height_px):
        size = f"{width_px} x {height_px} px and the camera {camera.width_px} x {camera.height_px}"
        faults.append(("lens.vignetting_file", f"{path} has {size}"))
    return {**values, "vignetting_file": path}


def checked_output(values: dict[str, Any], folder: Path, faults: list[tuple[str, str]]) -> dict[str, Any]:
    """Return the values of ``[output]`` with the points of the tone curve as text.

    `values`: the section, each key checked on its own; `folder`: the folder that the path of a curve is relative to;
    `faults`: errors are appended.
    """
    curve = values["tone_curve"]
    if not curve:
        return {**values, "tone_curve": ""}
    if values["gamma"] != "linear":
        faults.append(("output.tone_curve", "is a tone curve, and so is gamma; leave one out"))
        return values
    try:
        if not isinstance(curve, str):
            points = checked_points(curve)
        else:
            points = parse_curve(curve) if is_curve_text(curve) else read_curve((folder / curve).absolute())
    except ValueError as error:
        faults.append(("output.tone_curve", str(error)))
        return values
    return {**values, "tone_curve": curve_text(points)}


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
    lens: Literal["none", LensModel] = "none"
    distortion: list[float] | None = Field(
        default=None, max_length=14, description="a list of numbers, OpenCV's distortion coefficients in its order"
    )
    max_angle_deg: float | None = Field(
        default=None, gt=0, le=180, description="an angle of up to 180 deg from the optical axis"
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


def camera_numbers(camera: Camera) -> dict[str, Any]:
    """Return the keys of ``[camera]``."""
    numbers = {field.name: getattr(camera, field.name) for field in fields(Camera) if field.name != "lens"}
    return numbers if camera.lens is None else numbers | camera.lens.keys
