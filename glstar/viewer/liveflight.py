"""A flight that is still going on, as the viewer takes it from a link."""

import time
from collections import deque
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from statistics import median
from typing import Any, Final, NamedTuple

import numpy as np

from glstar.flight import Flight
from glstar.link import LatestAttitude, Link, LinkEvent, LinkStatus
from glstar.viewer.flightlines import FlightLines

__all__ = ["Buffered", "LiveFlight"]

# How often the whole buffer is taken anew for the timeline, s.
_REFRESH_S: Final = 0.5
# UTC and the time since boot drift apart by less; by more, it is another boot or another clock.
_ANOTHER_CLOCK_S: Final = 1.0
# An attitude older than this is not the sky of now, s.
_FRESH_S: Final = 1.0
_LATEST: Final = 60
_EVENTS: Final = 100


class Buffered(NamedTuple):
    """All that is remembered of the flight, at one moment.

    Attributes
    ----------
    flight : Flight
    lines : FlightLines
        The same, for the timeline.
    """

    flight: Flight
    lines: FlightLines


class LiveFlight:
    """Looks at a link for the viewer; nothing here waits for the link.

    Parameters
    ----------
    link : Link
        Open; it is used, not closed.
    tell : callable, optional
        Called with what happens on the link, in words.

    Attributes
    ----------
    link : Link
    epoch : int
        Counts the times that UTC was set: what is before and after belongs to two flights.  A reboot is a gap of one.
    status : LinkStatus
        As it was when it was looked at last.
    events : deque of LinkEvent
        What happened lately, oldest first.
    """

    def __init__(self, link: Link, *, tell: Callable[[str], None] | None = None) -> None:
        self.link = link
        self.epoch = 0
        self.status: LinkStatus = link.status()
        self.events: deque[LinkEvent] = deque(maxlen=_EVENTS)
        self._latency_s: deque[float] = deque(maxlen=_LATEST)
        self._all_latency_s: list[float] | None = None
        self._tell = tell or (lambda _: None)
        self._told = 0
        self._before: LatestAttitude | None = None
        self._taker = ThreadPoolExecutor(max_workers=1, thread_name_prefix="glstar-live")
        self._taking: Future[Buffered | None] | None = None
        self._taken_s, self._taken_of = 0.0, 0
        self._drawn: LatestAttitude | None = None
        self._counted_s = 0.0

    def poll(self) -> LatestAttitude | None:
        """Take note of what has happened on the link.

        Returns
        -------
        LatestAttitude or None
            None where there is none, or no UTC.
        """
        self.status = self.link.status()
        newest = self.link.latest()
        if newest is not None:
            if self._before is None or abs(newest.utc_step_s(self._before)) > _ANOTHER_CLOCK_S:
                self.epoch += 1
            self._before = newest
        return newest

    def new_events(self) -> list[LinkEvent]:
        """Return what has happened on the link since the last call, and tell it."""
        events = self.link.events(self._told)
        for event in events:
            self._told = event.number
            self.events.append(event)
            self._tell(event.message)
        return events

    def last(self, last_s: float) -> Flight | None:
        """Return the flight's last seconds; see `Link.flight`.

        Parameters
        ----------
        last_s : float
            s.

        Returns
        -------
        Flight or None
        """
        return self.link.flight(last_s)

    def buffered(self, origin_s: float) -> Buffered | None:
        """Return all that is remembered, if it has been taken since the last call; a thread of its own takes it.

        Parameters
        ----------
        origin_s : float
            From when the timeline counts its seconds, UTC seconds since 1970.

        Returns
        -------
        Buffered or None
        """
        now_s = time.monotonic()
        taken = None
        if self._taking is not None and self._taking.done():
            taken, self._taking = self._taking.result() if self._taken_of == self.epoch else None, None
        if self._taking is None and now_s - self._taken_s >= _REFRESH_S:
            self._taken_s, self._taken_of = now_s, self.epoch
            self._taking = self._taker.submit(self._take, origin_s)
        return taken

    def _take(self, origin_s: float) -> Buffered | None:
        flight = self.link.flight()
        return None if flight is None else Buffered(flight, FlightLines.of(flight.attitude, origin_s))

    @property
    def stale_s(self) -> float | None:
        """How old the newest attitude is, s, where it is older than a second; None where it is not."""
        age_s = self.status.age_s
        return age_s if age_s is not None and age_s > _FRESH_S else None

    @property
    def lacking(self) -> str:
        """What the sky waits for, in words."""
        status = self.status
        if status.problem is not None:
            return status.problem
        if status.age_s is None:
            return f"waiting for an autopilot's attitude on {status.endpoint} ..."
        return "\n".join(status.missing) or "the first exposure is under way ..."

    # --- how late the images are ---

    def drew(self, newest: LatestAttitude) -> None:
        """Take note that the image of an attitude was drawn; `presented` follows when it is on the screen.

        An attitude counts once: what is drawn again of it, with other settings, is no later for that.

        Parameters
        ----------
        newest : LatestAttitude
        """
        if newest.arrival_s > self._counted_s and self.stale_s is None:
            self._drawn, self._counted_s = newest, newest.arrival_s

    def presented(self) -> None:
        """Take note that what was drawn is on the screen."""
        if self._drawn is None:
            return
        latency_s = time.monotonic() - self._drawn.arrival_s
        self._drawn = None
        self._latency_s.append(latency_s)
        if self._all_latency_s is not None:
            self._all_latency_s.append(latency_s)

    @property
    def latency_now_s(self) -> float | None:
        """From the arrival of the newest attitude of an image to the screen: the median of the latest images, s."""
        return median(self._latency_s) if self._latency_s else None

    def record(self) -> None:
        """Keep the latency of every image from now on, for `report`."""
        self._all_latency_s = []

    def report(self) -> dict[str, Any]:
        """Return how the link and its images are, ready for JSON."""
        status = self.status
        latency_ms = 1e3 * np.array(self._all_latency_s or [])
        shares = {"median": 0.5, "p95": 0.95}
        return {
            "endpoint": status.endpoint,
            "state": status.state,
            "vehicle": status.vehicle,
            "rate_hz": status.rate_hz,
            "packets": status.packets,
            "lost": status.lost,
            "bad_bytes": status.bad_bytes,
            "utc": status.utc_source,
            "recorded_bytes": status.recorded_bytes,
            "images": latency_ms.size,
            "latency_ms": {
                name: round(float(np.quantile(latency_ms, share)), 1) if latency_ms.size else None
                for name, share in shares.items()
            },
            "events": [event.message for event in self.events],
        }

    def close(self) -> None:
        """End the thread; the link stays the caller's."""
        self._taker.shutdown(wait=True, cancel_futures=True)
