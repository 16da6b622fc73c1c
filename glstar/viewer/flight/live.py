"""The flight that a link receives, as the viewer uses it."""

import time
from collections import deque
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from statistics import median
from typing import Any, NamedTuple

import numpy as np

from glstar.flight import Flight
from glstar.link import Estimate, LatestAttitude, Link, LinkEvent, LinkStatus
from glstar.render.scene.scene import Scene
from glstar.render.truth.conditions import conditions_report
from glstar.viewer.flight.traces import FlightLines

# Interval at which the timeline gets a new copy of the link's buffer, s.
_REFRESH_S = 0.5
# Largest change of UTC minus boot time, s, that is drift; a larger one is a reboot or another clock.
_CLOCK_STEP_S = 1.0
# Age of the latest attitude, s, above which the sky is shown as out of date.
_STALE_S = 1.0
# Number of images in the median latency.
_LATENCIES = 60
# Number of events that are kept for the panel.
_EVENTS = 100


class Buffered(NamedTuple):
    """A copy of the link's buffer."""

    flight: Flight
    lines: FlightLines  # Its curves, for the timeline


class LiveFlight:
    """The viewer's side of a link; no method waits for the link.

    `link`: open; it stays the caller's; `on_event`: called with the message of each event.
    """

    def __init__(self, link: Link, *, on_event: Callable[[str], None] | None = None) -> None:
        self.link = link
        # Counts how often UTC was set: the samples before and after belong to two flights.  A reboot with the same UTC
        # is a gap of one flight.
        self.epoch = 0
        self.status: LinkStatus = link.status()  # At the last `poll`
        self.events: deque[LinkEvent] = deque(maxlen=_EVENTS)  # Oldest first
        self._latency_s: deque[float] = deque(maxlen=_LATENCIES)
        self._all_latency_s: list[float] | None = None
        self._on_event = on_event or (lambda _: None)
        self._last_event = 0
        self._before: LatestAttitude | None = None
        self._copier = ThreadPoolExecutor(max_workers=1, thread_name_prefix="glstar-live")
        self._copying: Future[Buffered | None] | None = None
        self._copied_s = 0.0
        self._copied_epoch = 0
        self._drawn: LatestAttitude | None = None
        self._reported_conditions = False
        self._counted_s = 0.0

    def poll(self, *, on_gimbal: bool = False) -> LatestAttitude | None:
        """Update the status and the epoch.

        `on_gimbal`: whether the camera is on the gimbal; see `Link.follow_gimbal`.  Returns the latest attitude; None
        without attitude or UTC.
        """
        self.link.follow_gimbal(on_gimbal)
        self.status = self.link.status()
        latest = self.link.latest()
        if latest is not None:
            if self._before is None or abs(latest.utc_step_s(self._before)) > _CLOCK_STEP_S:
                self.epoch += 1
            self._before = latest
        return latest

    def listen_to(self, sysid: int) -> None:
        """Receive the flight of another vehicle on the link: another epoch begins with its first attitude.

        `sysid`: its MAVLink system.
        """
        self.link.listen_to(sysid)
        self._before = None

    def new_events(self) -> list[LinkEvent]:
        """Return the events since the last call, and pass their messages on."""
        events = self.link.events(self._last_event)
        for event in events:
            self._last_event = event.number
            self.events.append(event)
            self._on_event(event.message)
        return events

    def last(self, last_s: float) -> Flight | None:
        """Return the flight's last seconds; see `Link.flight`."""
        return self.link.flight(last_s)

    def with_estimate(self, last_s: float) -> tuple[Flight, Estimate] | None:
        """Return the flight's last seconds, and what the autopilot estimated in them.

        The flight itself is the estimate unless the link draws a simulator's state.  Returns None without samples.
        """
        flight, estimate = self.link.flight_and_estimate(last_s)
        if flight is None or (estimate is None and self.link.truth == "sim_state"):
            return None
        return flight, estimate or Estimate(flight.aircraft_attitude, flight.position, flight.attitude_source)

    def buffered(self, origin_s: float) -> Buffered | None:
        """Return a copy of the buffer if one has been made since the last call; another thread makes it.

        `origin_s`: the origin of the timeline, UTC seconds since 1970.
        """
        now_s = time.monotonic()
        taken = None
        if self._copying is not None and self._copying.done():
            if self._copied_epoch == self.epoch:
                taken = self._copying.result()
            self._copying = None
        if self._copying is None and now_s - self._copied_s >= _REFRESH_S:
            self._copied_s = now_s
            self._copied_epoch = self.epoch
            self._copying = self._copier.submit(self._copy, origin_s)
        return taken

    def _copy(self, origin_s: float) -> Buffered | None:
        flight = self.link.flight()
        return None if flight is None else Buffered(flight, FlightLines.of(flight.aircraft_attitude, origin_s))

    @property
    def stale_s(self) -> float | None:
        """The age of the latest attitude, s, if it is more than a second; None otherwise."""
        age_s = self.status.age_s
        return age_s if age_s is not None and age_s > _STALE_S else None

    def stale_message(self, age_s: float) -> str:
        """Return that the sky is out of date, by the age of the latest attitude, s."""
        of_gimbal = " of the gimbal" if self.status.lacks_gimbal else ""
        return f"no attitude{of_gimbal} for {age_s:.0f} s: this sky is out of date"

    @property
    def lacking(self) -> str:
        """A message that says why no sky can be drawn yet."""
        status = self.status
        if status.problem is not None:
            return status.problem
        if status.age_s is None:
            return f"waiting for an autopilot's attitude on {status.endpoint} ..."
        return "\n".join(status.missing) or "the first exposure has not ended yet ..."

    # --- latency ---

    def drew(self, latest: LatestAttitude, scene: Scene | None, duration_s: float) -> None:
        """Record that the image of an attitude was drawn; `presented` follows when it is on the screen.

        Each attitude counts once, even if it is drawn again with other settings.  The Sun, the Moon and the limiting
        magnitude of the first complete exposure are reported as an event.  `scene`: of the image; `duration_s`: the
        camera's exposure time, s; the first image of a link may be shorter.
        """
        if scene is not None and scene.exposure.duration_s >= duration_s and not self._reported_conditions:
            self._reported_conditions = True
            self._on_event(conditions_report(scene))
        if latest.arrival_s > self._counted_s and self.stale_s is None:
            self._drawn = latest
            self._counted_s = latest.arrival_s

    def presented(self) -> None:
        """Record that the image drawn last is on the screen."""
        if self._drawn is None:
            return
        latency_s = time.monotonic() - self._drawn.arrival_s
        self._drawn = None
        self._latency_s.append(latency_s)
        if self._all_latency_s is not None:
            self._all_latency_s.append(latency_s)

    @property
    def latency_now_s(self) -> float | None:
        """Median time from the arrival of an image's latest attitude to the screen, of the last 60 images, s."""
        return median(self._latency_s) if self._latency_s else None

    def record(self) -> None:
        """Record the latency of every image from now on, for `report`."""
        self._all_latency_s = []

    def report(self) -> dict[str, Any]:
        """Return the state of the link and the latency of the images, for JSON."""
        status = self.status
        latency_ms = 1e3 * np.array(self._all_latency_s or [])
        quantiles = {"median": 0.5, "p95": 0.95}
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
                name: round(float(np.quantile(latency_ms, fraction)), 1) if latency_ms.size else None
                for name, fraction in quantiles.items()
            },
            "events": [event.message for event in self.events],
        }

    def close(self) -> None:
        """End the thread; the link stays the caller's."""
        self._copier.shutdown(wait=True, cancel_futures=True)
