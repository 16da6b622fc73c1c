"""What telemetry is to glstar: samples in a source's own clock.

A `TelemetrySource` hands over `Samples`, in batches: a log file a few large ones, a live link many small ones.  Four
kinds are enough: attitudes, places, readings of UTC, and the rates of the gyros, each stamped with the source's own
clock (an autopilot counts seconds since boot).  A `Recording` brings them together.
"""

from abc import abstractmethod
from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass
from types import TracebackType
from typing import Final, Protocol, Self, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from glstar.errors import LogFormatError

__all__ = [
    "EVERYWHERE",
    "REBOOT",
    "AttitudeSamples",
    "Boot",
    "ClockSamples",
    "LogFacts",
    "PositionSamples",
    "RateSamples",
    "Samples",
    "Span",
    "TelemetrySource",
    "chosen_boots",
]

Float = NDArray[np.float64]

# Why there is a gap between two boots.
REBOOT: Final = "a reboot of the autopilot"


# Positions of records in the file, rising from `start` to below `stop`.
Span = tuple[int, int]
EVERYWHERE: Final = 1 << 62  # more than any position


@dataclass(frozen=True, slots=True)
class Boot:
    """One boot of an autopilot, or what is left of it in a log.

    Attributes
    ----------
    number : int
        From 1, in the order of the file.
    spans : tuple of (int, int)
        Which positions in the file are of this boot: from the first number to below the second.
    doubt : str
        Why its UTC is not to be trusted, as a message; empty if it is.
    """

    number: int
    spans: tuple[Span, ...] = ((0, EVERYWHERE),)
    doubt: str = ""


@dataclass(frozen=True, slots=True, eq=False)
class AttitudeSamples:
    """Attitudes as they were recorded.

    Attributes
    ----------
    clock_s : (n,) float64
        Sample times by the source's own clock, s; in any order.
    q_body_ned : (n, 4) float64
        Quaternions (w, x, y, z), NED to body.
    segment : (n,) int64
        Which unbroken segment each belongs to.  A new number says that the estimator jumped (another EKF lane): that is
        no rotation of the aircraft, and nothing is interpolated across it.
    source : str
        Where they come from, in words.
    break_reason : str
        What a new segment means, in words.
    boot : int
        Of which boot they are, and so of which clock; from 1.
    notes : tuple of str
        What a user should know of how they were chosen, a message each.
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
    """Places as they were recorded.

    Attributes
    ----------
    clock_s : (n,) float64
        Sample times by the source's own clock, s; in any order.
    latitude_rad, longitude_rad, height_m : (n,) float64
        WGS84 latitude, longitude positive eastward (rad), height (m).
    source : str
        Where they come from, in words; for an empty batch, why there are none.
    boot : int
        Of which boot they are, and so of which clock; from 1.
    """

    clock_s: Float
    latitude_rad: Float
    longitude_rad: Float
    height_m: Float
    source: str
    boot: int = 1


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
    boot : int
        Of which boot they are, and so of which clock; from 1.
    lag_s : float or None
        How long after the GPS sample its record is written, s, in the median; None where that does not matter.
    lag_is_measured : bool
        Whether the log says so itself; else it is assumed.
    """

    clock_s: Float
    utc_s: Float
    source: str
    boot: int = 1
    lag_s: float | None = None
    lag_is_measured: bool = False


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
    boot : int
        Of which boot they are, and so of which clock; from 1.
    """

    clock_s: Float
    rate_rad_per_s: Float
    source: str
    boot: int = 1


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
    estimator : str or None
        Whose attitude the autopilot flew by: ``"EKF3"``, ``"DCM"``.
    """

    format: str
    vehicle: str | None = None
    firmware: str | None = None
    estimator: str | None = None


@runtime_checkable
class TelemetrySource(Protocol):
    """Anything that tells where an aircraft was and how it was turned: a log file, a link, a script.

    A context manager; `close` may be called twice.

    Attributes
    ----------
    name : str
        The file or the endpoint, as the user named it.
    one_clock : bool
        Whether one clock runs through all boots; else each boot has its own.
    """

    name: str
    # Whether one clock runs through all boots; else each boot has its own.
    one_clock: bool = False

    @abstractmethod
    def samples(self) -> Iterator[Samples]:
        """Yield batches of samples until the source has no more."""

    def facts(self, boots: Collection[int] = ()) -> LogFacts:  # noqa: ARG002
        """Return what the source says of itself.

        Parameters
        ----------
        boots : collection of int
            Of which boots, by number; by default of all.

        Returns
        -------
        LogFacts
        """
        return LogFacts("telemetry")

    def boots(self) -> tuple[Boot, ...]:
        """Return the boots that the source has samples of, at least one.

        Returns
        -------
        tuple of Boot
        """
        return (Boot(1),)

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


def chosen_boots(name: str, boots: Sequence[Boot], number: int | None) -> tuple[Boot, ...]:
    """Return the boot that was asked for, or all of them.

    Parameters
    ----------
    name : str
        The log.
    boots : sequence of Boot
        All that it has.
    number : int, optional
        The boot to choose; by default all.

    Returns
    -------
    tuple of Boot

    Raises
    ------
    LogFormatError
        If the log has no such boot.
    """
    if number is None:
        return tuple(boots)
    found = tuple(boot for boot in boots if boot.number == number)
    if not found:
        has = "1 boot" if len(boots) == 1 else f"{len(boots)} boots"
        raise LogFormatError(name, f"the log has no boot {number} (--boot): it has {has}; glstar info lists them")
    return found
