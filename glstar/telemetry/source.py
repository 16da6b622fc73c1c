"""What telemetry is to glstar: samples in a source's own clock, and how they become a flight.

A `TelemetrySource` hands over `Samples`, in batches: a log file a few large ones, a live link many small ones.  Four
kinds are enough: attitudes, places, readings of UTC, and the rates of the gyros, each stamped with the source's own
clock (an autopilot counts seconds since boot).  `read_flight` brings them together: the median of the UTC readings
turns the clock into UTC.
"""

from abc import abstractmethod
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import PurePath
from types import TracebackType
from typing import Protocol, Self, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from glstar.errors import LogFormatError, TelemetryError
from glstar.site import Site
from glstar.timescale import format_utc
from glstar.track import AttitudeTrack, Flight, PositionTrack

__all__ = [
    "AttitudeSamples",
    "ClockSamples",
    "LogFacts",
    "PositionSamples",
    "RateSamples",
    "Samples",
    "TelemetrySource",
    "read_flight",
]

Float = NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class AttitudeSamples:
    """Attitudes as they were recorded.

    Attributes
    ----------
    clock_s : (n,) float64
        Sample times by the source's own clock, s; in any order.
    q_body_ned : (n, 4) float64
        Quaternions (w, x, y, z), NED to body.
    stretch : (n,) int64
        Which unbroken stretch each belongs to.  A new number says that the estimator jumped (another EKF lane): that is
        no rotation of the aircraft, and nothing is interpolated across it.
    source : str
        Where they come from, in words.
    break_reason : str
        What a new stretch means, in words.
    """

    clock_s: Float
    q_body_ned: Float
    stretch: NDArray[np.int64]
    source: str
    break_reason: str = "a reset of the estimator"


@dataclass(frozen=True, slots=True, eq=False)
class PositionSamples:
    """Places as they were recorded.

    Attributes
    ----------
    clock_s : (n,) float64
        Sample times by the source's own clock, s; in any order.
    latitude_rad, longitude_rad, height_m : (n,) float64
        WGS84 latitude, longitude positive eastward (rad), height (m).
    source : str
        Where they come from, in words; for an empty batch, why there are none.
    """

    clock_s: Float
    latitude_rad: Float
    longitude_rad: Float
    height_m: Float
    source: str


@dataclass(frozen=True, slots=True, eq=False)
class ClockSamples:
    """Readings of UTC beside the source's own clock.

    Attributes
    ----------
    clock_s : (n,) float64
        The source's own clock, s.
    utc_s : (n,) float64
        What UTC was then, seconds since 1970.
    source : str
        Where they come from, in words; for an empty batch, why there are none.
    """

    clock_s: Float
    utc_s: Float
    source: str


@dataclass(frozen=True, slots=True, eq=False)
class RateSamples:
    """What the gyros felt.

    Attributes
    ----------
    clock_s : (n,) float64
        Sample times by the source's own clock, s; in any order.
    rate_rad_per_s : (n, 3) float64
        Turn rates about the body's axes forward, right, down, rad/s.
    source : str
        Where they come from, in words.
    """

    clock_s: Float
    rate_rad_per_s: Float
    source: str


Samples = AttitudeSamples | PositionSamples | ClockSamples | RateSamples


@dataclass(frozen=True, slots=True)
class LogFacts:
    """What a source says of itself.

    Attributes
    ----------
    format : str
        What kind of log it is: ``"ArduPilot DataFlash"``.
    vehicle : str or None
        What flew: ``"ArduPlane"``.
    firmware : str or None
        What flew it: ``"ArduPlane V4.5.1 (1a2b3c4d)"``.
    """

    format: str
    vehicle: str | None = None
    firmware: str | None = None


@runtime_checkable
class TelemetrySource(Protocol):
    """Anything that tells where an aircraft was and how it was turned: a log file, a link, a script.

    A context manager; `close` may be called twice.

    Attributes
    ----------
    name : str
        The file or the endpoint, as the user named it.
    """

    name: str

    @abstractmethod
    def samples(self) -> Iterator[Samples]:
        """Yield batches of samples until the source has no more."""

    def facts(self) -> LogFacts:
        """Return what the source says of itself.

        Returns
        -------
        LogFacts
        """
        return LogFacts("telemetry")

    def attitudes(self) -> Iterator[tuple[str, AttitudeSamples]]:
        """Yield every attitude that the source has, each after the name by which it can be asked for."""
        for batch in self.samples():
            if isinstance(batch, AttitudeSamples):
                yield batch.source, batch

    @abstractmethod
    def close(self) -> None:
        """Let go of the file or the link."""

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()


def read_flight(
    source: TelemetrySource,
    *,
    time_offset_s: float = 0.0,
    utc_start: float | None = None,
    site: Site | None = None,
    max_gap_s: float | None = None,
) -> Flight:
    """Read a source to its end and return what it tells as one flight.

    Parameters
    ----------
    source : TelemetrySource
        An open source; it is read, not closed.
    time_offset_s : float
        Camera clock minus log clock, s.  The attitude that the log stamps t is the one the camera had at t +
        `time_offset_s`: positive where the camera's clock is ahead of the log's.  Attitude and place shift together.
    utc_start : float, optional
        UTC of the first attitude sample, seconds since 1970; where given, it counts instead of the log's own UTC.
    site : Site, optional
        Where the flight was; where given, it counts instead of the log's own positions.
    max_gap_s : float, optional
        The longest silence to interpolate across, s; see `AttitudeTrack.from_samples`.

    Returns
    -------
    Flight

    Raises
    ------
    LogFormatError
        If there are fewer than two attitudes, or no UTC, or no place.
    """
    attitudes, positions, clocks = _by_kind(source)
    clock_s = _joined([a.clock_s for a in attitudes])
    if (count := np.unique(clock_s).size) < 2:
        raise LogFormatError(source.name, f"a flight needs two attitude samples or more; this log has {count}")
    _refuse_lacking(source.name, clocks if utc_start is None else None, positions if site is None else None)
    if utc_start is not None:
        utc_minus_clock_s = utc_start - float(clock_s.min())
        utc_source = f"given: the first attitude at {format_utc(utc_start)}"
    else:
        utc_minus_clock_s, utc_source = _utc_minus_clock_s(clocks)
    shift_s = utc_minus_clock_s + time_offset_s
    try:
        attitude = AttitudeTrack.from_samples(
            clock_s + shift_s,
            np.concatenate([a.q_body_ned for a in attitudes]),
            stretch=np.concatenate([a.stretch for a in attitudes]),
            break_reason=attitudes[0].break_reason,
            max_gap_s=max_gap_s,
        )
        if site is not None:
            position, position_source = PositionTrack.fixed(site), "given"
        else:
            position, position_source = _position(positions, shift_s)
    except TelemetryError as error:
        raise LogFormatError(source.name, str(error)) from error
    return Flight(
        attitude=attitude,
        position=position,
        name=PurePath(source.name).name,
        attitude_source=f"{attitudes[0].source}, {attitude.rate_hz:.1f} Hz",
        position_source=position_source,
        utc_source=utc_source,
    )


def _by_kind(
    source: TelemetrySource,
) -> tuple[list[AttitudeSamples], list[PositionSamples], list[ClockSamples]]:
    attitudes: list[AttitudeSamples] = []
    positions: list[PositionSamples] = []
    clocks: list[ClockSamples] = []
    for batch in source.samples():
        match batch:
            case AttitudeSamples():
                attitudes.append(batch)
            case PositionSamples():
                positions.append(batch)
            case ClockSamples():
                clocks.append(batch)
    return attitudes, positions, clocks


def _joined(arrays: list[Float]) -> Float:
    """Return arrays end to end; nothing at all is an empty array."""
    return np.concatenate(arrays) if arrays else np.empty(0)


def _refuse_lacking(name: str, clocks: list[ClockSamples] | None, positions: list[PositionSamples] | None) -> None:
    """Raise one error for all that a log lacks and nobody gave; None stands for what was given."""
    lacking: list[str] = []
    needed: list[str] = []
    for batches, what, remedy in (
        (clocks, "UTC", "the UTC of its first attitude as utc_start (--utc-start)"),
        (positions, "position", "its place as latitude_deg and longitude_deg (--lat, --lon)"),
    ):
        if batches is not None and not any(batch.clock_s.size for batch in batches):
            reason = f" ({batches[0].source})" if batches else ""
            lacking.append(f"no {what}{reason}")
            needed.append(remedy)
    if lacking:
        raise LogFormatError(name, f"the log has {' and '.join(lacking)}; give {' and '.join(needed)}")


def _utc_minus_clock_s(clocks: list[ClockSamples]) -> tuple[float, str]:
    # The median: one late or mistaken reading, and the first ones of a receiver are, moves the sky by nothing.
    difference_s = _joined([c.utc_s - c.clock_s for c in clocks])
    return float(np.median(difference_s)), next(c.source for c in clocks if c.clock_s.size)


def _position(positions: list[PositionSamples], shift_s: float) -> tuple[PositionTrack, str]:
    track = PositionTrack.from_samples(
        np.concatenate([p.clock_s for p in positions]) + shift_s,
        np.concatenate([p.latitude_rad for p in positions]),
        np.concatenate([p.longitude_rad for p in positions]),
        np.concatenate([p.height_m for p in positions]),
    )
    return track, next(p.source for p in positions if p.clock_s.size)
