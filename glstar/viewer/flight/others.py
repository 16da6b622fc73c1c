"""Other logs of the flight shown, such as a simulator's, and the thread that reads them."""

from collections.abc import Callable, Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Self

from glstar.config import Config
from glstar.errors import GlstarError
from glstar.flight import Flight
from glstar.rotation import euler_from_quaternion
from glstar.viewer.flight.traces import FlightLines, TimelineCurve, Trace, motion_traces


@dataclass(frozen=True, slots=True, eq=False)
class OtherLog:
    """Another log of the flight shown, by the same clock: UTC."""

    name: str
    flight: Flight
    traces: Mapping[TimelineCurve, tuple[Trace, ...]]  # Times are s from its own first attitude

    @classmethod
    def read(cls, path: Path, config: Config) -> Self:
        """Read a log with the settings of the one shown, but its own attitude; raises GlstarError."""
        own = config.override(**{"flight.attitude": "auto"})
        return cls.of(path.stem, own.gimbal.carried(own.open_flight(path)))

    @classmethod
    def of(cls, name: str, flight: Flight) -> Self:
        """Return a flight with its curves."""
        first_s = flight.attitude.first_s
        lines = FlightLines.of(flight.aircraft_attitude, first_s)
        curves = {TimelineCurve.ATTITUDE: lines.angles, TimelineCurve.RATES: lines.rates}
        return cls(name, flight, curves | motion_traces(flight, first_s))

    def angles_rad(self, utc_s: float) -> tuple[float, ...] | None:
        """Return roll, pitch and yaw at a time, UTC s; None where it has none."""
        attitude = self.flight.aircraft_attitude
        if not attitude.covers(utc_s):
            return None
        return tuple(float(angle) for angle in euler_from_quaternion(attitude.at(utc_s)))


class OtherLogs:
    """Reads other logs, one after another, while the flight plays on."""

    def __init__(self) -> None:
        self.shown: tuple[OtherLog, ...] = ()
        self._thread = ThreadPoolExecutor(max_workers=1, thread_name_prefix="glstar-other-log")
        self._pending: list[tuple[Path, Flight, Future[OtherLog]]] = []

    @property
    def reading(self) -> Path | None:
        """The log that is being read; None if there is none."""
        return self._pending[0][0] if self._pending else None

    def open(self, path: Path, config: Config, flight: Flight) -> None:
        """Begin to read a log; `config`, `flight`: of the one shown."""
        self._pending.append((path, flight, self._thread.submit(OtherLog.read, path, config)))

    def poll(self, notify: Callable[..., None]) -> bool:
        """Show the logs that have been read, and notify what cannot be read; return whether there is another one."""
        before = self.shown
        while self._pending and self._pending[0][2].done():
            path, flight, future = self._pending.pop(0)
            try:
                log = future.result()
            except (GlstarError, OSError) as error:
                notify(str(error), is_error=True)
            except MemoryError:
                notify(f"{path}: is too large for this machine's memory", is_error=True)
            else:
                self.shown = (*self.shown, log)
                notify(_notice(path, log.flight, flight))
        return self.shown != before

    def clear(self) -> None:
        """Show no other log, and read no further one."""
        for _, _, future in self._pending:
            future.cancel()
        self._pending, self.shown = [], ()

    def close(self) -> None:
        """End the thread."""
        self._thread.shutdown(wait=True, cancel_futures=True)


def _notice(path: Path, other: Flight, flight: Flight) -> str:
    """Return what to say about a log that has been read, beside the flight shown."""
    later_s = max(other.attitude.first_s - flight.attitude.last_s, flight.attitude.first_s - other.attitude.last_s)
    if later_s > 0:
        side = "after" if other.attitude.first_s > flight.attitude.last_s else "before"
        return f"{path.name} is {later_s:.0f} s {side} the flight shown: nothing to compare; is its clock UTC?"
    return f"{path.name} beside the flight; its clock must be UTC too"
