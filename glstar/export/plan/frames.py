"""Planning of an export: its options, the exposure and scene of each frame, and the frames that are skipped."""

from bisect import bisect_left
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from math import isnan
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from glstar.camera.exposure import ControlledExposure, Exposure, ExposureControl
from glstar.camera.sensor.sensor import Sensor
from glstar.config import ExposureSection
from glstar.errors import ConfigError
from glstar.export.imagefiles.formats import ImageFormat
from glstar.flight import CameraTriggers, Flight
from glstar.render.scene.scene import Frame, Scene
from glstar.render.simulator import Simulator
from glstar.sky.place.timescale import CLOCK_GRAIN_S

# Larger exports are refused as typing errors in --every or in the draws of a sweep.
MOST_FRAMES = 10_000_000
# Exposures are compared with the gaps of a log in blocks of this many frames.
_BLOCK = 1_000_000


@dataclass(frozen=True, slots=True)
class PlannedFrame:
    """A frame to be drawn."""

    number: int  # Frame number, from 0; part of the file name
    exposure: Exposure
    extra_truth: Mapping[str, Any] = field(default_factory=dict)  # Additional keys of its line of truth


@dataclass(frozen=True, slots=True)
class SkippedFrame:
    """A frame that is not drawn, because its exposure spans a gap in the log."""

    number: int  # Frame number
    start_s: float  # Start of its exposure, s from the flight's first attitude
    reason: str  # Kind of the gap, such as "a data gap"
    gap_s: float  # Duration of the gap, s


@dataclass(frozen=True, slots=True)
class Plan:
    """The frames of one flight."""

    frames: tuple[PlannedFrame, ...]
    skipped: tuple[SkippedFrame, ...]

    def only(self, number: int) -> "Plan":
        """Return a plan with one frame only; raises ConfigError if the frame is skipped."""
        frames = tuple(frame for frame in self.frames if frame.number == number)
        if not frames:
            reason = next((frame.reason for frame in self.skipped if frame.number == number), "the end")
            raise ConfigError(f"no exposure: {reason} of the log is here")
        return Plan(frames, ())


def plan_frames(
    flight: Flight, exposure: ExposureSection, *, start_s: float, stop_s: float | None, frames: int | None
) -> Plan:
    """Return the frames of a flight: one exposure per interval until the flight ends, or at most `frames`.

    `start_s` and `stop_s` are the part of the flight, s from its first attitude. Exposures that span a gap in the
    attitude track are in `skipped`. Raises ConfigError if no exposure fits, or more than `MOST_FRAMES` do.
    """
    if exposure.at is not None:
        triggers = flight.triggers_of(exposure.at)
        return _plan_triggered(flight, triggers, exposure, start_s=start_s, stop_s=stop_s, frames=frames)
    count = count_frames(flight, exposure, start_s=start_s, stop_s=stop_s, frames=frames)
    skipped = tuple(skipped_frames(flight, exposure, start_s=start_s, count=count))
    skipped_numbers = {frame.number for frame in skipped}
    first_s = flight.attitude.first_s
    drawn = (number for number in range(count) if number not in skipped_numbers)
    return Plan(tuple(PlannedFrame(k, exposure.nth(k, first_s, start_s=start_s)) for k in drawn), skipped)


def _plan_triggered(
    flight: Flight,
    triggers: CameraTriggers,
    exposure: ExposureSection,
    *,
    start_s: float,
    stop_s: float | None,
    frames: int | None,
) -> Plan:
    """Return one exposure for each trigger of the camera, numbered like the triggers of the log."""
    attitude = flight.attitude
    first_s, last_s = attitude.first_s + start_s, attitude.last_s if stop_s is None else attitude.first_s + stop_s
    drawn: list[PlannedFrame] = []
    skipped: list[SkippedFrame] = []
    opened_s = (triggers.utc_s + exposure.at_delay_s).tolist()
    for number, utc_s in zip(triggers.numbers.tolist(), opened_s, strict=True):
        shutter = exposure.starting_at(utc_s)
        if not first_s <= utc_s or shutter.stop_utc_s > last_s + CLOCK_GRAIN_S / 2 or len(drawn) == frames:
            continue
        gap = attitude.gap_within(shutter.start_utc_s, shutter.stop_utc_s) if attitude.gaps else None
        if gap is None and shutter.stop_utc_s <= attitude.last_s:
            drawn.append(PlannedFrame(number, shutter))
        elif gap is not None:
            skipped.append(SkippedFrame(number, utc_s - attitude.first_s, gap.reason, round(gap.duration_s, 6)))
    if not drawn:
        raise ConfigError(
            f"none of the {triggers.utc_s.size} triggers of the camera ({triggers.source}) is followed by"
            f" {exposure.duration_s:g} s of attitude in {flight.name}"
        )
    return Plan(tuple(drawn), tuple(skipped))


def count_frames(
    flight: Flight,
    exposure: ExposureSection,
    *,
    start_s: float,
    stop_s: float | None,
    frames: int | None,
    length_s: float | None = None,
) -> int:
    """Return the number of exposures of `plan_frames`, including those that span a gap.

    `length_s` is how long the flight lasts under a sample of a sweep, s. Raises ConfigError if no exposure fits, or
    more than `MOST_FRAMES` do.
    """
    length_s = flight.attitude.last_s - flight.attitude.first_s if length_s is None else length_s
    stop_s = length_s if stop_s is None else min(stop_s, length_s)
    if isnan(start_s) or isnan(stop_s):
        raise ConfigError("--start and --stop take seconds from the flight's first attitude, not nan")
    if start_s < 0:
        raise ConfigError(f"--start {start_s:g} s lies before the flight; times count from its first attitude")
    if frames is not None and frames < 1:
        raise ConfigError(f"--frames {frames} must be 1 or more")
    count = exposure.count_within(stop_s - start_s)
    if count == 0:
        raise ConfigError(
            f"no exposure of {exposure.span_s:g} s fits between {start_s:g} s and {stop_s:.3f} s of {flight.name},"
            f" whose attitude lasts {length_s:.3f} s; take a shorter exposure or another part of the flight"
        )
    count = count if frames is None else min(count, frames)
    if count > MOST_FRAMES:
        message = f"asks for {count:.3g} frames, and at most {MOST_FRAMES:,} can be planned; take a longer interval"
        raise ConfigError(f"--every {exposure.interval_s:g} s {message}, or --frames")
    return count


def skipped_frames(flight: Flight, exposure: ExposureSection, *, start_s: float, count: int) -> Iterator[SkippedFrame]:
    """Yield the exposures, of `count` of a flight, that span a gap in its attitude track.

    The first begins at `start_s`, s from the flight's first attitude.
    """
    attitude = flight.attitude
    for first in range(0, count if attitude.gaps else 0, _BLOCK):
        numbers = np.arange(first, min(first + _BLOCK, count))
        start_utc_s = attitude.first_s + (start_s + numbers * exposure.interval_s)
        for number in numbers[across_gaps(flight, start_utc_s, start_utc_s + exposure.span_s)].tolist():
            shutter = exposure.nth(number, attitude.first_s, start_s=start_s)
            gap = attitude.gap_within(shutter.start_utc_s, shutter.stop_utc_s)
            if gap is not None:
                begin_s = start_s + number * exposure.interval_s
                yield SkippedFrame(number, begin_s, gap.reason, round(gap.duration_s, 6))


def across_gaps(
    flight: Flight, start_utc_s: NDArray[np.floating], stop_utc_s: NDArray[np.floating]
) -> NDArray[np.bool_]:
    """Return for each exposure whether it touches a gap in the attitude track, vectorised for millions of exposures.

    `start_utc_s`, `stop_utc_s` (n,): times at which the shutter opens and closes, UTC seconds since 1970.  Returns (n,)
    bool.
    """
    starts = np.array([gap.start_utc_s for gap in flight.attitude.gaps])
    stops = np.array([gap.stop_utc_s for gap in flight.attitude.gaps])
    first, last = np.searchsorted(stops, start_utc_s, side="right"), np.searchsorted(starts, stop_utc_s, side="left")
    touched: NDArray[np.bool_] = first < last
    return touched


@dataclass(frozen=True, slots=True, eq=False)
class ComposedFrame:
    """A frame that is ready to be drawn."""

    number: int  # Frame number
    scene: Scene
    extra_truth: Mapping[str, Any] = field(default_factory=dict)  # Additional keys of its line of truth


@dataclass(frozen=True, slots=True, eq=False)
class Shot:
    """When and how the camera exposes a frame."""

    simulator: Simulator
    exposure: Exposure
    flight: int = 0  # Index of the flight in a data set
    stream: int = 0  # Index of the flight and the sample together: frames of one value belong to one flight
    settings: Mapping[str, Any] = field(default_factory=dict)  # The settings of the sample, by dotted key
    shift_s: float = 0.0  # How much later than in its log the flight is, s
    about: Mapping[str, Any] = field(default_factory=dict)  # Additional keys of its line of truth
    control: ExposureControl | None = None  # The automatic exposure, which shortens it; None without

    def set_to(self, duration_s: float, gain: float) -> "Shot":
        """Return the shot with the exposure time, s, and the analogue gain of an exposure control."""
        sensor = self.simulator.sensor
        assert sensor.electrons is not None  # the config has checked it
        sensor = replace(sensor, electrons=replace(sensor.electrons, analogue_gain=gain))
        return replace(
            self,
            simulator=replace(self.simulator, sensor=sensor),
            exposure=self.exposure.shortened(duration_s),
            about={"analogue_gain": gain, **self.about},
            control=None,
        )

    @property
    def gain(self) -> float | None:
        """The analogue gain that an exposure control has set; None without."""
        return self.about.get("analogue_gain")

    @property
    def sensor_gain(self) -> float:
        """The analogue gain of the sensor."""
        electrons = self.simulator.sensor.electrons
        return 1.0 if electrons is None else electrons.analogue_gain

    def composed(self, number: int) -> ComposedFrame:
        """Return the scene of the frame of this number."""
        return ComposedFrame(number, self.simulator.scene(self.exposure), self.about)


class Frames(Protocol):
    """The frames of an export.  An instance can be pickled, so that other processes can draw its frames."""

    @property
    def numbers(self) -> NDArray[np.int64]:
        """Frame numbers, (n,) int64, increasing."""
        ...

    @property
    def firsts(self) -> NDArray[np.int64]:
        """First frame number of each simulator, (m,) int64, increasing: frames between two of them share one."""
        ...

    @property
    def skipped(self) -> tuple[SkippedFrame, ...]:
        """Frames that are left out because their exposure spans a gap in the log."""
        ...

    @property
    def saturation_dn(self) -> int:
        """The largest digital number of the images."""
        ...

    @property
    def files(self) -> tuple[Path, ...]:
        """Files that `compose` reads again; all processes must find the same content there."""
        ...

    def shot(self, number: int) -> Shot:
        """Return when and how the camera exposes a frame; `number`: one of `numbers`."""
        ...

    def compose(self, number: int) -> ComposedFrame:
        """Return the scene of a frame; `number`: one of `numbers`."""
        ...


@dataclass(frozen=True, eq=False)
class FlightFrames:
    """The frames of one flight, composed by one simulator."""

    simulator: Simulator
    plan: Plan
    control: ExposureControl | None = None

    @cached_property
    def numbers(self) -> NDArray[np.int64]:
        """Frame numbers, (n,) int64, increasing."""
        return np.array([planned.number for planned in self.plan.frames], dtype=np.int64)

    @property
    def firsts(self) -> NDArray[np.int64]:
        """Frame 0: one simulator has all frames."""
        return np.zeros(1, dtype=np.int64)

    @property
    def skipped(self) -> tuple[SkippedFrame, ...]:
        """Frames that are left out because their exposure spans a gap in the log."""
        return self.plan.skipped

    @property
    def saturation_dn(self) -> int:
        """The largest digital number of the images."""
        factors = [planned.exposure.signal_factor for planned in self.plan.frames[:1]]  # all have the same
        return self.simulator.sensor.saturation_dn * max(factors, default=1)

    @property
    def files(self) -> tuple[Path, ...]:
        """Empty: the simulator holds everything."""
        return ()

    def shot(self, number: int) -> Shot:
        """Return when and how the camera exposes a frame; see `Frames`."""
        planned = self.plan.frames[bisect_left(self.plan.frames, number, key=lambda frame: frame.number)]
        return Shot(self.simulator, planned.exposure, about=planned.extra_truth, control=self.control)

    def compose(self, number: int) -> ComposedFrame:
        """Return the scene of a frame; see `Frames`."""
        return self.shot(number).composed(number)


@dataclass(frozen=True, slots=True, eq=False)
class FramesOfOthers:
    """What frames have in common with others that they are made of, for `Frames`; subclasses say what differs."""

    whole: Frames

    @property
    def firsts(self) -> NDArray[np.int64]:
        """First frame number of each simulator; see `Frames`."""
        return self.whole.firsts

    @property
    def saturation_dn(self) -> int:
        """The largest digital number of the images."""
        return self.whole.saturation_dn

    @property
    def files(self) -> tuple[Path, ...]:
        """Files that `compose` reads again; see `Frames`."""
        return self.whole.files

    def shot(self, number: int) -> Shot:
        """Return when and how the camera exposes a frame; see `Frames`."""
        return self.whole.shot(number)

    def compose(self, number: int) -> ComposedFrame:
        """Return the scene of a frame; see `Frames`."""
        return self.whole.compose(number)


@dataclass(frozen=True, slots=True, eq=False)
class ControlledFrames(FramesOfOthers):
    """Frames whose exposure time and gain an exposure control has set, frame after frame of each flight."""

    settings: Mapping[int, tuple[float, float]]  # Exposure time, s, and gain by frame number

    @property
    def numbers(self) -> NDArray[np.int64]:
        """Frame numbers, (n,) int64, increasing."""
        return self.whole.numbers

    @property
    def skipped(self) -> tuple[SkippedFrame, ...]:
        """Frames that are left out because their exposure spans a gap in the log."""
        return self.whole.skipped

    def shot(self, number: int) -> Shot:
        """Return when and how the camera exposes a frame; see `Frames`."""
        return self.whole.shot(number).set_to(*self.settings[number])

    def compose(self, number: int) -> ComposedFrame:
        """Return the scene of a frame; see `Frames`."""
        return self.shot(number).composed(number)


def control_exposures(
    frames: Frames, draw: Callable[[ComposedFrame], Frame], on_frame: Callable[[int, int], None] = lambda *_: None
) -> Frames:
    """Return frames with the exposure times and gains of their exposure control; unchanged without.

    Each frame is drawn with `draw` to measure its level. Each flight and sample has a control of its own. `on_frame`
    is called with the number of finished frames and of all frames.
    """
    numbers = frames.numbers.tolist()
    if not numbers or frames.shot(numbers[0]).control is None:
        return frames
    settings: dict[int, tuple[float, float]] = {}
    state: ControlledExposure | None = None
    stream = -1
    for done, number in enumerate(numbers, start=1):
        shot = frames.shot(number)
        if shot.control is not None and (state is None or shot.stream != stream):
            stream, state = shot.stream, ControlledExposure.begun(shot.control, shot.sensor_gain)
        assert state is not None
        settings[number] = state.settings
        shot = shot.set_to(*state.settings)
        pixels = draw(shot.composed(number)).pixels
        state = state.after(level_of(state.control, shot.exposure, shot.simulator.sensor, pixels))
        on_frame(done, len(numbers))
    return ControlledFrames(frames, settings)


def level_of(control: ExposureControl, exposure: Exposure, sensor: Sensor, pixels_dn: NDArray[Any]) -> float:
    """Return the level of an image that an exposure control measures."""
    factor = exposure.signal_factor
    black_dn = 0.0 if sensor.electrons is None else sensor.electrons.black_level_dn
    return control.level(pixels_dn, factor * black_dn, factor * sensor.saturation_dn)


@dataclass(frozen=True, slots=True)
class ExportOptions:
    """What to export of a flight, besides the config."""

    # The part of the flight, s from its first attitude; to the end of the flight if `stop_s` is None.
    start_s: float = 0.0
    stop_s: float | None = None
    frames: int | None = None  # Maximum number of frames; in a data set, of each sample
    # {"png", "png16", "tiff", "fits", "jpeg"} or None: none for 8-bit PNG, or 16-bit PNG if the sensor has more than 8
    # bits; if a sensor of 8 bits is written with 16, its full scale becomes the full scale of 16 bits, and all DN of
    # the truth are scaled with it.
    image_format: ImageFormat | None = None
    noiseless: bool = False  # Whether to write the signal before noise beside each frame
    seed: int = 0  # The seed from which the noise seed of every frame is derived
    masks: bool = False  # Whether to write masks beside each frame: see `glstar.export.imagefiles.masks`
    exif: bool = False  # Whether images have EXIF with UTC, exposure time and position
