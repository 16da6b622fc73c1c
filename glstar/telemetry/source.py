"""What all readers share: the interface `TelemetrySource`, batches of samples, and removal of damaged samples.

A source yields `Samples` in batches: attitudes, positions, readings of UTC, gyro rates, triggers, gimbal and events.
Their times are by the source's own clock; an autopilot counts seconds since boot.  A `Recording` collects the
samples of a boot and converts their times to UTC.  `UnpackedSource` is a log that is made of another file in a
temporary directory: unpacked, or completed.
"""

import io
import os
from abc import abstractmethod
from collections.abc import Callable, Collection, Iterable, Iterator, Sequence
from contextlib import contextmanager, redirect_stderr, redirect_stdout
from dataclasses import dataclass, field
from pathlib import Path
from types import TracebackType
from typing import Protocol, Self, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from glstar.arrays import Float, Integer, Mask
from glstar.errors import LogFormatError, reading
from glstar.flight import ONLY_CAMERA, CameraTriggers, EventKind, FlightEvents, GimbalAttitude
from glstar.sky.place.site import HEIGHTS_M
from glstar.system.files import UnpackedFolder

# Reason of the gap between two boots.
REBOOT = "a reboot of the autopilot"

# A half-open range of positions in a file: start, stop.
Span = tuple[int, int]
# Larger than any position in a file.
EVERYWHERE = 1 << 62


@dataclass(frozen=True, slots=True)
class Boot:
    """One boot of an autopilot in a log, or the part of it that was recorded."""

    number: int  # From 1, in the order of the file
    spans: tuple[Span, ...] = ((0, EVERYWHERE),)  # Half-open ranges of positions in the file
    doubt: str = ""  # Why its UTC is unreliable, for messages; empty if it is reliable


@dataclass(frozen=True, slots=True, eq=False)
class AttitudeSamples:
    """Recorded attitudes.

    Attributes
    ----------
    clock_s : (n,) float64
        Sample times by the clock of the source, s; in any order.
    q_body_ned : (n, 4) float64
        Quaternions (w, x, y, z), NED to body.
    segment : (n,) int64
        Number of the contiguous segment of each sample.  Between two segments the estimator was reset, or another EKF
        lane took over: the difference is no rotation of the aircraft, and attitude is not interpolated.
    source : str
        Where they come from, for messages.
    break_reason : str
        Why a new segment begins, for messages.
    boot : int
        Number of the boot, and so of its clock; from 1.
    notes : tuple of str
        Remarks for the user on how the attitude was chosen.
    """

    clock_s: Float
    q_body_ned: Float
    segment: NDArray[np.int64]
    source: str
    break_reason: str = "a reset of the estimator"
    boot: int = 1
    notes: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True, eq=False)
class PositionSamples:
    """Recorded positions.

    Attributes
    ----------
    clock_s : (n,) float64
        Sample times by the clock of the source, s; in any order.
    latitude_rad, longitude_rad, height_m : (n,) float64
        WGS84 latitude, longitude positive eastward (rad), height (m).
    source : str
        Where they come from, for messages; for an empty batch, why there are none.
    boot : int
        Number of the boot, and so of its clock; from 1.
    """

    clock_s: Float
    latitude_rad: Float
    longitude_rad: Float
    height_m: Float
    source: str
    boot: int = 1


@dataclass(frozen=True, slots=True, eq=False)
class ClockSamples:
    """Readings of UTC, with the clock of the source at the same time.

    Attributes
    ----------
    clock_s : (n,) float64
        Clock of the source, s.
    utc_s : (n,) float64
        UTC at that time, seconds since 1970.
    source : str
        Where they come from, for messages; for an empty batch, why there are none.
    boot : int
        Number of the boot, and so of its clock; from 1.
    lag_s : float or None
        Median delay from the GPS sample to its record in the log, s; None where it does not matter.
    lag_is_measured : bool
        Whether the log contains the delay; otherwise the usual one is assumed.
    notes : tuple of str
        Remarks for the user on readings that are left out, or on their quality.
    utc_minus_clock_s : float or None
        UTC minus the clock as the reader found it, s; None: the median of the readings.
    cut : int
        Number of readings that disagree and are not among these.
    """

    clock_s: Float
    utc_s: Float
    source: str
    boot: int = 1
    lag_s: float | None = None
    lag_is_measured: bool = False
    notes: tuple[str, ...] = ()
    utc_minus_clock_s: float | None = None
    cut: int = 0


@dataclass(frozen=True, slots=True, eq=False)
class RateSamples:
    """Recorded gyro rates."""

    clock_s: Float  # (n,) sample times by the clock of the source, s; in any order
    rate_rad_per_s: Float  # (n, 3) turn rates about the body axes forward, right, down, rad/s
    source: str  # Where they come from, for messages
    boot: int = 1  # Number of the boot, and so of its clock; from 1


@dataclass(frozen=True, slots=True, eq=False)
class TriggerSamples:
    """When one camera was triggered."""

    clock_s: Float  # (n,) times by the clock of the source, s; NaN where only UTC is known
    utc_s: Float  # (n,) UTC seconds since 1970 by the log itself; NaN where it is not recorded
    source: str  # The message, for messages
    boot: int = 1  # Number of the boot, and so of its clock; from 1
    camera: str = ONLY_CAMERA  # Name by which ``--at`` chooses it, see `CameraTriggers`
    number: Integer | None = None  # (n,) number of each image, by the camera; None if their order numbers them
    clock_error_s: float = 2.0  # Largest error of `clock_s`; `utc_s` that differs by more is not used, s
    notes: tuple[str, ...] = ()  # Remarks for the user on triggers that are left out, or on their times

    def over_utc(self, utc_minus_clock_s: float, *, by_log: bool) -> CameraTriggers | None:
        """Return the triggers over UTC; None if no time is known.

        `utc_minus_clock_s`: UTC minus the clock, s; `by_log`: whether it is that of the log, so that UTC in the
        triggers themselves may be used.
        """
        utc_s = self.clock_s + utc_minus_clock_s
        if by_log:
            utc_s = np.where(np.isfinite(self.utc_s) & ~self._contradicts(utc_minus_clock_s), self.utc_s, utc_s)
        known = np.isfinite(utc_s)
        number = None if self.number is None else self.number[known]
        return CameraTriggers(utc_s[known], self.source, self.camera, number) if known.any() else None

    def remarks(self, utc_minus_clock_s: float | None) -> tuple[str, ...]:
        """Return remarks for the user; `utc_minus_clock_s`: by the log, s; None if it has no UTC."""
        odd = np.zeros(0, dtype=bool) if utc_minus_clock_s is None else self._contradicts(utc_minus_clock_s)
        if not odd.any():
            return self.notes
        off_s = float(np.median((self.utc_s - self.clock_s)[odd])) - float(utc_minus_clock_s or 0.0)
        times = f"{np.count_nonzero(odd)} of {odd.size} times of {self.source}"
        return (*self.notes, f"{times} are {off_s:+.1f} s from the UTC of the log: its own clock dates these triggers")

    def _contradicts(self, utc_minus_clock_s: float) -> Mask:
        """Return which triggers, (n,), have a UTC of their own that the clock contradicts."""
        with np.errstate(invalid="ignore"):
            mask: Mask = np.abs(self.utc_s - self.clock_s - utc_minus_clock_s) > self.clock_error_s
        return mask


@dataclass(frozen=True, slots=True, eq=False)
class GimbalSamples:
    """Recorded attitudes of the platform of a gimbal."""

    clock_s: Float  # (n,) sample times by the clock of the source, s; in any order
    q_gimbal_reference: Float  # (n, 4) unit quaternions (w, x, y, z) from the frame of reference to the platform
    # (n,) bool: whether the frame of reference is NED; otherwise it is level, with its first axis along the aircraft's
    # heading.
    is_earth: NDArray[np.bool_]
    source: str  # The message, for messages
    boot: int = 1  # Number of the boot, and so of its clock; from 1

    def over_utc(self, utc_minus_clock_s: float) -> GimbalAttitude:
        """Return the attitudes over UTC, sorted, each time once; `utc_minus_clock_s`: UTC minus the clock, s."""
        clock_s, first = np.unique(self.clock_s, return_index=True)
        return GimbalAttitude(
            clock_s + utc_minus_clock_s, self.q_gimbal_reference[first], self.is_earth[first], self.source
        )


@dataclass(frozen=True, slots=True, eq=False)
class EventSamples:
    """Recorded flight modes and messages."""

    clock_s: Float  # (n,) times by the clock of the source, s; in any order
    kinds: tuple[EventKind, ...]
    texts: tuple[str, ...]
    boot: int = 1  # Number of the boot, and so of its clock; from 1

    @classmethod
    def of(cls, kind: EventKind, clock_s: Float, texts: Sequence[str], boot: int = 1) -> Self:
        """Return events of one kind, without modes that repeat the one before, and texts without a printable letter.

        `clock_s` (n,): time of each text, s; events whose time is not finite are left out.
        """
        printable = ["".join(filter(str.isprintable, text)).strip() for text in texts]
        kept = [
            k
            for k, text in enumerate(printable)
            if text and np.isfinite(clock_s[k]) and (kind is not EventKind.MODE or not k or text != printable[k - 1])
        ]
        times_s = np.asarray(clock_s, dtype=np.float64)[kept]
        return cls(times_s, (kind,) * len(kept), tuple(printable[k] for k in kept), boot)

    def over_utc(self, utc_minus_clock_s: float) -> FlightEvents:
        """Return the events over UTC; `utc_minus_clock_s`: UTC minus the clock, s."""
        return FlightEvents(self.clock_s + utc_minus_clock_s, self.kinds, self.texts)


Samples = GimbalSamples | AttitudeSamples | PositionSamples | ClockSamples | RateSamples | TriggerSamples | EventSamples


@dataclass(frozen=True, slots=True)
class LogFacts:
    """Facts about a log and its vehicle."""

    format: str  # Format of the log: ``"ArduPilot DataFlash"``
    vehicle: str | None = None  # ``"ArduPlane"``
    firmware: str | None = None  # ``"ArduPlane V4.5.1 (1a2b3c4d)"``
    estimator: str | None = None  # The estimator whose attitude the autopilot used: ``"EKF3"``, ``"DCM"``
    # Bytes of the file that belong to no valid message: damage, or data of another format.
    unread_bytes: int = field(default=0, compare=False)

    @classmethod
    def joined(cls, log_format: str, boots: Sequence[Self], unread_bytes: int) -> Self:
        """Return the facts about a log of several boots: the different names of each kind, joined by "and"."""

        def names(known: Iterable[str | None]) -> str | None:
            return " and ".join(dict.fromkeys(filter(None, known))) or None

        return cls(
            log_format,
            vehicle=names(boot.vehicle for boot in boots),
            firmware=names(boot.firmware for boot in boots),
            estimator=names(boot.estimator for boot in boots),
            unread_bytes=unread_bytes,
        )


@runtime_checkable
class TelemetrySource(Protocol):
    """A source of attitudes, positions and UTC: a log file or a script.

    A context manager; `close` may be called twice.

    Attributes
    ----------
    name : str
        The file as the user named it.
    one_clock : bool
        Whether the clock continues through all boots; otherwise each boot has its own.
    """

    name: str
    one_clock: bool = False

    @abstractmethod
    def samples(self) -> Iterator[Samples]:
        """Yield all samples in batches."""

    def facts(self, boots: Collection[int] = ()) -> LogFacts:  # noqa: ARG002 - for readers of several boots
        """Return facts about the log and its vehicle.

        Parameters
        ----------
        boots : collection of int
            Numbers of the boots; by default all.

        Returns
        -------
        LogFacts
        """
        return LogFacts("telemetry")

    def boots(self) -> tuple[Boot, ...]:
        """Return the boots of the autopilot in the log, at least one.

        Returns
        -------
        tuple of Boot
        """
        return (Boot(1),)

    def attitudes(self) -> Iterator[tuple[str, AttitudeSamples]]:
        """Yield the name and the samples of every attitude in the log; the names are values of ``attitude=``."""
        for batch in self.samples():
            if isinstance(batch, AttitudeSamples):
                yield batch.source, batch

    @abstractmethod
    def close(self) -> None:
        """Close the file."""

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()


def chosen_boots(name: str, boots: Sequence[Boot], number: int | None) -> tuple[Boot, ...]:
    """Return the boot with a number, or all boots without one; raises LogFormatError if the log has no such boot."""
    if number is None:
        return tuple(boots)
    chosen = tuple(boot for boot in boots if boot.number == number)
    if not chosen:
        has = "1 boot" if len(boots) == 1 else f"{len(boots)} boots"
        raise LogFormatError(name, f"the log has no boot {number} (--boot): it has {has}; glstar info lists them")
    return chosen


def check_only_boot(name: str, number: int | None) -> None:
    """Raise LogFormatError if the requested boot of a log with a single one is neither 1 nor None."""
    if number not in {None, 1}:
        raise LogFormatError(name, f"the log has no boot {number} (--boot): it has 1 boot")


# Largest deviation of the norm of a quaternion from 1: rounding to float32 gives 1e-6, damage more than 1 %.
UNIT_TOLERANCE = 0.01
# Dates outside these years are wrong, UTC seconds since 1970: a receiver whose 10-bit week number has rolled over
# reports a date 19.6 years ago, one without a fix reports 1980 or 1970.
YEAR_2010_S = 1262304000.0
YEAR_2100_S = 4102444800.0

# A sample that differs this much from the median of itself and its two neighbours is damaged.
_CLOCK_SPIKE_S = 1.0
_SPIKE_INTERVALS = 3.0
# An aircraft flies no faster, m/s; positions jump by less where an estimator is reset, m.
_LARGEST_SPEED_M_PER_S = 700.0
_POSITION_NOISE_M = 200.0
_EARTH_RADIUS_M = 6.371e6
# A height of 0 m is none if the ones beside it are farther away than this and this climb, m and m/s.
_NO_HEIGHT_M, _LARGEST_CLIMB_M_PER_S = 30.0, 50.0
# With this part of the positions at another place, either may be the flight.
_ELSEWHERE = 0.8
# A pause, in median intervals of positions.
_PAUSE_INTERVALS = 10.0
# Number of runs of positions before one that are searched for the one that it goes on from.
_RUNS_BACK = 100
# Positions this close to 0 N 0 E mean that there is no fix, deg: an estimator without an origin drifts by some metres.
_ZERO_POSITION_DEG = 0.001
# Gyros of autopilots measure up to 2000 deg/s, some up to 4000 deg/s.
_MAX_GYRO_RATE_RAD_PER_S = np.deg2rad(5000.0)
# Times this far from the median belong to no flight: a month, s.
_MAX_DURATION_S = 30 * 86400.0


def spikes(values: Float, limit: float) -> Mask:
    """Return which of (n,) values differ by more than a limit from the median of themselves and their neighbours."""
    if values.size < 3:
        return np.zeros(values.size, dtype=bool)
    neighbours = np.lib.stride_tricks.sliding_window_view(values, 3)
    middle = np.median(neighbours, axis=-1)
    with np.errstate(invalid="ignore"):  # infinity minus infinity
        spike: Mask = np.abs(values - np.concatenate([middle[:1], middle, middle[-1:]])) > limit
    return spike


def valid_times(clock_s: Float) -> Mask:
    """Return which of (n,) times in the order of the log, s, are finite, no spikes, within a month of the median."""
    valid = valid_rare_times(clock_s)
    # At the ends of slow samples the median of three is one interval away.
    usual_s = float(np.median(np.abs(np.diff(clock_s[valid])))) if np.count_nonzero(valid) > 1 else 0.0
    return valid & ~spikes(clock_s, max(_CLOCK_SPIKE_S, _SPIKE_INTERVALS * usual_s))


def valid_rare_times(clock_s: Float) -> Mask:
    """Return which of (n,) times of rare events, s, are finite and within a month of the median."""
    finite = np.isfinite(clock_s)
    if not finite.any():
        return finite
    near: Mask = np.abs(clock_s - np.median(clock_s[finite])) < _MAX_DURATION_S
    return finite & near


def position_samples(
    clock_s: Float, latitude_deg: Float, longitude_deg: Float, height_m: Float, source: str
) -> PositionSamples:
    """Return the valid ones of (n,) positions in the order of the log; `source`: where they come from, for messages."""
    valid = valid_positions(latitude_deg, longitude_deg, height_m) & valid_times(clock_s)
    return PositionSamples(
        clock_s[valid], np.deg2rad(latitude_deg[valid]), np.deg2rad(longitude_deg[valid]), height_m[valid], source
    )


def valid_positions(latitude_deg: Float, longitude_deg: Float, height_m: Float) -> Mask:
    """Return which of (n,) positions are on the Earth, not at 0 N 0 E, and at a height of flights."""
    with np.errstate(invalid="ignore"):
        valid: Mask = (np.abs(latitude_deg) <= 90) & (np.abs(longitude_deg) <= 180)
        valid &= (height_m >= HEIGHTS_M[0]) & (height_m <= HEIGHTS_M[1])
        valid &= ~is_zero_position(latitude_deg, longitude_deg)
    return valid


def flyable(clock_s: Float, latitude_rad: Float, longitude_rad: Float, height_m: Float) -> Mask:
    """Return which of (n,) valid positions, sorted by time, s, belong to the longest sequence that an aircraft can fly.

    Runs of positions are joined if the aircraft can get from the last of one to the first of the next.
    """
    if clock_s.size < 2:
        return np.ones(clock_s.size, dtype=bool)
    level = np.cos(latitude_rad)
    direction = [level * np.cos(longitude_rad), level * np.sin(longitude_rad), np.sin(latitude_rad)]
    place_m = np.stack(direction, axis=-1) * (_EARTH_RADIUS_M + height_m)[:, np.newaxis]

    def reached(one: Integer, other: Integer | int) -> Mask:
        distance_m = np.linalg.norm(place_m[other] - place_m[one], axis=-1)
        return np.asarray(distance_m <= _POSITION_NOISE_M + _LARGEST_SPEED_M_PER_S * (clock_s[other] - clock_s[one]))

    rows = np.arange(clock_s.size)
    # After a pause almost any place is reached: it may be gone on from an earlier run than the one before it.
    steps_s = np.diff(clock_s)
    parted = ~reached(rows[:-1], rows[1:]) | (steps_s > _PAUSE_INTERVALS * np.median(steps_s))
    starts = np.concatenate([[0], np.flatnonzero(parted) + 1])
    ends = np.concatenate([starts[1:], [clock_s.size]])
    length, previous = ends - starts, np.full(starts.size, -1)
    for run in range(1, starts.size):
        first = max(0, run - _RUNS_BACK)
        joined = np.flatnonzero(reached(ends[first:run] - 1, int(starts[run]))) + first
        if joined.size:
            previous[run] = joined[np.argmax(length[joined])]
            length[run] += length[previous[run]]
    kept = np.zeros(clock_s.size, dtype=bool)
    run = int(np.argmax(length))
    while run >= 0:
        kept[starts[run] : ends[run]] = True
        run = int(previous[run])
    return kept


def two_places(kept: Mask, clock_s: Float, latitude_rad: Float, longitude_rad: Float, height_m: Float) -> str:
    """Return where else the rest of (n,) positions is, if nearly as many as are kept are there; otherwise empty."""
    rest = ~kept
    rest[rest] = flyable(clock_s[rest], latitude_rad[rest], longitude_rad[rest], height_m[rest])
    if not rest.any() or np.count_nonzero(rest) < _ELSEWHERE * np.count_nonzero(kept):
        return ""
    latitude_deg, longitude_deg = np.rad2deg(latitude_rad), np.rad2deg(longitude_rad)
    one, other = (
        f"{np.count_nonzero(rows)} at {np.median(latitude_deg[rows]):.2f}, {np.median(longitude_deg[rows]):.2f} deg"
        for rows in (kept, rest)
    )
    return f"its positions are of two places, {one} and {other}, and nothing says which is the flight"


def is_missing_height(clock_s: Float, height_m: Float) -> Mask:
    """Return which of (n,) heights, m, sorted by time, s, are 0 because there is none: no aircraft climbs to the next.

    A run of zeros is compared with the heights before and after it.
    """
    missing = np.zeros(height_m.size, dtype=bool)
    edges = np.flatnonzero(np.diff(np.concatenate([[False], height_m == 0, [False]])))
    for start, stop in zip(edges[::2].tolist(), edges[1::2].tolist(), strict=True):
        beside = [(start - 1, start)] if start else []
        beside += [(stop, stop - 1)] if stop < height_m.size else []
        missing[start:stop] = bool(beside) and all(
            abs(height_m[known]) > _NO_HEIGHT_M + _LARGEST_CLIMB_M_PER_S * abs(clock_s[zero] - clock_s[known])
            for known, zero in beside
        )
    return missing


def is_zero_position(latitude_deg: Float, longitude_deg: Float) -> Mask:
    """Return which of (n,) positions are 0 N 0 E within 0.001 deg, as receivers without a fix report."""
    with np.errstate(invalid="ignore"):
        mask: Mask = (np.abs(latitude_deg) <= _ZERO_POSITION_DEG) & (np.abs(longitude_deg) <= _ZERO_POSITION_DEG)
    return mask


def quaternion_lengths(q: Float) -> Float:
    """Return the lengths of quaternions (..., 4); infinite where the square of a damaged component has no float64."""
    with np.errstate(over="ignore"):
        return np.asarray(np.linalg.norm(q, axis=-1))


def unit_quaternions(q: Float) -> Mask:
    """Return which of quaternions (..., 4) have length 1 within the rounding of logs; False for NaN."""
    with np.errstate(invalid="ignore"):
        mask: Mask = np.abs(quaternion_lengths(q) - 1) < UNIT_TOLERANCE
    return mask


def plausible_utc(utc_s: Float) -> Mask:
    """Return which of (n,) times, UTC seconds since 1970, are from 2010 to 2100."""
    mask: Mask = (utc_s >= YEAR_2010_S) & (utc_s < YEAR_2100_S)
    return mask


def no_position_samples(source: str) -> PositionSamples:
    """Return an empty batch of positions; `source`: why there are none, for messages."""
    nothing = np.empty(0)
    return PositionSamples(nothing, nothing, nothing, nothing, source)


def no_clock_samples(source: str) -> ClockSamples:
    """Return an empty batch of UTC readings; `source`: why there are none, for messages."""
    return ClockSamples(np.empty(0), np.empty(0), source)


def valid_rates(rate_rad_per_s: Float) -> Mask:
    """Return which of (n, 3) turn rates, rad/s, are finite and within the range of autopilot gyros."""
    with np.errstate(over="ignore", invalid="ignore"):
        valid: Mask = (np.abs(rate_rad_per_s) < _MAX_GYRO_RATE_RAD_PER_S).all(axis=-1)
    return valid


# Between an archive and its member: FILE.zip::folder/flight.csv.
MEMBER_MARK = "::"


def archive_and_member(name: str) -> tuple[str, str]:
    """Return the file and the member of ``FILE.zip::member``; the member is empty if there is none."""
    archive, separator, member = name.partition(MEMBER_MARK)
    if not separator or Path(name).exists() or not Path(archive).is_file():
        return name, ""
    return archive, member


Unpack = Callable[[str], tuple[UnpackedFolder, Path]]


class UnpackedSource(TelemetrySource):
    """A log in a temporary directory as a telemetry source, under the name of the file that it was made from.

    `unpack` writes the log of the file `name` into a temporary directory: ``folder, path = unpack(name)``; `opener`
    opens it: ``opener(path)``.  Raises LogFormatError if the file cannot be unpacked, or its log cannot be read.
    """

    def __init__(self, name: str, unpack: Unpack, opener: Callable[[str], TelemetrySource]) -> None:
        self.name = name
        self._folder, path = unpack(name)
        self._inside = str(path)
        try:
            with self._named():
                self._source = opener(self._inside)
        except BaseException:
            self._folder.cleanup()
            raise
        self.one_clock = self._source.one_clock

    def samples(self) -> Iterator[Samples]:
        """Yield the samples of the log."""
        with self._named():
            yield from self._source.samples()

    def facts(self, boots: Collection[int] = ()) -> LogFacts:
        """Return facts about the log and its vehicle."""
        with self._named():
            return self._source.facts(boots)

    def boots(self) -> tuple[Boot, ...]:
        """Return the boots of the log."""
        with self._named():
            return self._source.boots()

    def attitudes(self) -> Iterator[tuple[str, AttitudeSamples]]:
        """Yield the name and the samples of every attitude of the log."""
        with self._named():
            yield from self._source.attitudes()

    def close(self) -> None:
        """Close the log and remove the unpacked files."""
        self._source.close()
        self._folder.cleanup()

    @contextmanager
    def _named(self) -> Iterator[None]:
        """Name the archive in errors, in place of the temporary file."""
        try:
            with reading(self._inside, LogFormatError):
                yield
        except LogFormatError as error:
            reason = f"{Path(self._inside).name}: {error.reason}".replace(self._inside, Path(self._inside).name)
            raise LogFormatError(self.name, reason, offset=error.offset, lacks=error.lacks) from error


@contextmanager
def suppressed_output() -> Iterator[None]:
    """Suppress printed output and restore the environment variables of MAVLink.

    Importing pymavlink sets MAVLINK_DIALECT and reads MAVLINK20; pymavlink and pyulog print remarks on damaged data.
    """
    before = {key: os.environ.get(key) for key in ("MAVLINK20", "MAVLINK_DIALECT")}
    os.environ["MAVLINK20"] = "1"
    try:
        with redirect_stdout(io.StringIO()), redirect_stderr(io.StringIO()):
            yield
    finally:
        for key, value in before.items():
            os.environ.pop(key, None)
            if value is not None:
                os.environ[key] = value
