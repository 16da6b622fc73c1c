"""`Link`, the thread that owns a telemetry link: it opens the link, requests messages, receives them, and reconnects.

Other threads read snapshots, `Link.status` and `Link.flight`, without waiting for the link: a flight is made of
`Received`, a copy of what the receiver holds.
"""

import logging
import time
from collections import deque
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import partial
from math import inf
from pathlib import Path
from threading import Condition, Event, Thread
from types import TracebackType
from typing import Literal, Self

from glstar.errors import ConfigError, LinkError, TelemetryError
from glstar.flight import Flight
from glstar.flight.gimbal import Gimbal
from glstar.link.camera import CameraComponent
from glstar.link.clock import COMPUTER_CLOCK, BootClock
from glstar.link.endpoint import Endpoint
from glstar.link.history import Estimate, HistorySnapshot
from glstar.link.outgoing import Injector, Requests
from glstar.link.packets import Framer, LinkRecording, Recorder, carried_rate_hz
from glstar.link.receiver import Receiver
from glstar.link.status import LatestAttitude, LinkEvent, LinkState, LinkStatus, Quality, no_packets_message
from glstar.link.transport import Transport, open_transport
from glstar.sky.place.site import Site
from glstar.telemetry.recording import DEFAULT_OPTIONS, FlightOptions
from glstar.telemetry.source import GimbalSamples


@dataclass(frozen=True, slots=True)
class Received:
    """The last minutes of one autopilot."""

    utc_minus_boot_s: float  # UTC minus the time since boot, s
    utc_source: str
    attitude_source: str  # Of the sky
    estimate_source: str  # Of the attitude that the autopilot estimates
    sky: HistorySnapshot  # What the sky is drawn from
    estimated: HistorySnapshot | None  # What the autopilot estimates, if the sky is that of a simulator
    gimbal: GimbalSamples | None  # The attitudes of its gimbal over UTC
    is_on_gimbal: bool  # Whether the camera is on the gimbal

    @classmethod
    def of(cls, receiver: Receiver, last_s: float, *, with_gimbal: bool) -> Self | None:
        """Copy at most the last `last_s` of what a receiver holds; None while UTC is not known.

        `with_gimbal`: whether the camera is on its gimbal.
        """
        utc_minus_boot_s = receiver.clock.utc_minus_boot_s
        simulator = receiver.simulator
        if utc_minus_boot_s is None:
            return None
        return cls(
            utc_minus_boot_s=utc_minus_boot_s,
            utc_source=receiver.clock.source or "",
            attitude_source=(simulator and simulator.source) or receiver.attitude_source,
            estimate_source=receiver.attitude_source,
            sky=receiver.sky_history.snapshot(last_s),
            estimated=None if simulator is None else receiver.history.snapshot(last_s),
            gimbal=receiver.gimbal.samples(utc_minus_boot_s, last_s),
            is_on_gimbal=with_gimbal,
        )

    def flight(self, name: str, position_source: str, options: FlightOptions) -> Flight | None:
        """Return the flight of the body that carries the camera, by options without `utc_start`.

        None if attitude, position or the attitude of the gimbal are not known.
        """
        flight = self.sky.flight(
            self.utc_minus_boot_s,
            name=name,
            attitude_source=self.attitude_source,
            position_source=position_source,
            utc_source=self.utc_source,
            options=options,
        )
        if flight is None:
            return None
        flight = replace(flight, gimbal=None if self.gimbal is None else self.gimbal.over_utc(0.0))
        if not self.is_on_gimbal:
            return flight
        try:
            return Gimbal("log").carried(flight)
        except TelemetryError:
            return None

    def estimate(self, options: FlightOptions) -> Estimate | None:
        """Return what the autopilot estimates, if the sky is a simulator's and its attitude is known."""
        if self.estimated is None:
            return None
        return self.estimated.estimate(self.utc_minus_boot_s, attitude_source=self.estimate_source, options=options)


# What the sky is drawn from: what the autopilot estimates, or a simulator's own state.
Truth = Literal["estimator", "sim_state"]
# When frames are due: at the arrival of attitudes, or by the vehicle's own clock.
Clock = Literal["arrival", "vehicle"]

_LOG = logging.getLogger(__name__)

# Pauses between attempts to open a link: the first and the longest, s, and the factor from one to the next.
_FIRST_PAUSE_S, _LONGEST_PAUSE_S, _PAUSE_FACTOR = 0.5, 5.0, 1.5
# Poll interval of the thread, s.
_POLL_S = 0.05
# Time without packets after which the link is reported as timed out, and after which it is reopened, s.
_TIMEOUT_S, _REOPEN_S = 2.0, 5.0
# Number of events that are kept.
_EVENTS = 200


class Link:
    """A telemetry link in the background; a context manager, whose thread ends with it.

    `options`: how the received samples become a flight; `utc_start` is the UTC of the first packet.
    `sysid`: MAVLink system of the vehicle; by default the first autopilot.
    `utc_now`: whether to use the computer's clock if the link has no UTC.
    `rate_hz`: requested rate of the attitude; by default what the link can carry.
    `keep_s`: duration of the history.
    `recorder`: takes every packet; it is closed with the link, or before by `recording`.
    `truth`: what the sky is drawn from.
    `injector`: position fixes that are sent to the autopilot; without it only heartbeats and requests are sent.
    `camera`: a camera beside the vehicle, which others command; without it there is none on the link.
    `retry`: whether to try again if the link cannot be opened at first.
    `on_gimbal`: whether the camera is on a gimbal, whose attitude is requested; see `follow_gimbal`.
    `clock`: ``"vehicle"`` for a simulator that is faster than the computer's clock, is paused or set back.

    Raises ConfigError if the interpolation is ``"gyro"``.
    """

    def __init__(
        self,
        endpoint: Endpoint,
        options: FlightOptions = DEFAULT_OPTIONS,
        *,
        sysid: int | None = None,
        utc_now: bool = False,
        rate_hz: float | None = None,
        keep_s: float = 600.0,
        recorder: Recorder | None = None,
        truth: Truth = "estimator",
        injector: Injector | None = None,
        camera: CameraComponent | None = None,
        retry: bool = False,
        on_gimbal: bool = False,
        clock: Clock = "arrival",
    ) -> None:
        if options.interpolation == "gyro":
            raise ConfigError("a link has no gyro rates; take slerp or spline", key="flight.interpolation")
        self.endpoint = endpoint
        self.truth = truth
        self.clock = clock
        # Begins and ends a recording while the link is open.
        self.recording = LinkRecording(recorder, self._report)
        self._options = options
        self._retry = retry
        self.camera = camera
        self._components = [component for component in (camera, injector) if component is not None]
        with_simulator = truth == "sim_state"
        self._make_receiver = partial(Receiver, report=self._report, keep_s=keep_s, with_simulator=with_simulator)
        self._uses_computer_clock = utc_now
        self._receiver = self._make_receiver(self._new_clock(), sysid=sysid)
        self._requests = Requests(carried_rate_hz(endpoint) if rate_hz is None else rate_hz, wants_gimbal=on_gimbal)
        # Guards the receiver and the following attributes; notified when packets arrive.
        self._changed = Condition()
        self._state: LinkState = "opening"
        self._problem: str | None = None
        # Whether a problem was reported since packets last arrived.
        self._had_problem = False
        self._events: deque[LinkEvent] = deque(maxlen=_EVENTS)
        self._event_count = 0
        self._bad_bytes = 0
        self._open_error: LinkError | None = None
        # What ended the thread, which `close` raises; None while the link is well.
        self.failure: LinkError | None = None
        self._tried, self._ending = Event(), Event()
        self._thread = Thread(target=self._run, name=f"glstar link {endpoint.text}", daemon=True)

    def __enter__(self) -> Self:
        """Open the link; raises LinkError if it cannot be opened, unless `retry` is set."""
        self._thread.start()
        if not self._retry:
            self._tried.wait()
            if self._open_error is not None:
                self.close()
                raise self._open_error
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def close(self) -> None:
        """Restore the default message rates, close the link and end its thread; may be called twice.

        Raises LinkError if an internal error had ended the thread.
        """
        self._ending.set()
        if self._thread.is_alive():
            self._thread.join()
        self.recording.end()
        if self.failure is not None:
            failure, self.failure = self.failure, None
            raise failure

    # --- for other threads --------------------------------------------------------------------------------------------

    def status(self) -> LinkStatus:
        """Return the current status."""
        now_s = time.monotonic()
        with self._changed:
            receiver = self._receiver
            arrival_s = receiver.attitude_arrival_s
            lacks_gimbal = False
            if self._requests.wants_gimbal and self._state == "live" and arrival_s is not None:
                arrival_s = receiver.gimbal.arrival_s or arrival_s
                lacks_gimbal = receiver.gimbal.is_silent(now_s)
            return LinkStatus(
                endpoint=self.endpoint.text,
                state=self._state,
                problem=self._problem,
                vehicle=receiver.vehicle,
                sysid=None if receiver.chosen is None else receiver.chosen[0],
                systems=receiver.systems,
                rate_hz=receiver.attitude_rate_hz(now_s),
                age_s=None if arrival_s is None else now_s - arrival_s,
                packets=receiver.packets,
                lost=receiver.lost,
                bad_bytes=self._bad_bytes,
                utc_source=receiver.clock.source,
                position_source=self._position_source,
                recorded_bytes=self.recording.bytes,
                lacks_simulator=receiver.simulator is not None and receiver.simulator.source is None,
                lacks_gimbal=lacks_gimbal,
            )

    def events(self, after: int = 0) -> list[LinkEvent]:
        """Return the latest events with numbers larger than `after`, 200 at most."""
        with self._changed:
            return [event for event in self._events if event.number > after]

    def use_computer_clock(self) -> None:
        """Use the computer's clock if the link has no UTC."""
        with self._changed:
            self._uses_computer_clock = True
            self._receiver.clock.use_computer_clock(time.time() - time.monotonic())

    def listen_to(self, sysid: int) -> None:
        """Listen to the vehicle of another MAVLink system: its flight is a new one, and earlier samples are dropped."""
        with self._changed:
            receiver = self._make_receiver(self._new_clock(), sysid=sysid)
            receiver.continue_from(self._receiver, time.monotonic())
            self._receiver = receiver

    def set_site(self, site: Site) -> None:
        """Use a given position instead of the link's."""
        with self._changed:
            self._options = replace(self._options, site=site)

    def follow_gimbal(self, on_gimbal: bool) -> None:
        """Choose whether the camera is on a gimbal.

        If so, the `attitude` of a flight is the platform's and ends at its latest sample; without one there is no
        flight.
        """
        self._requests.wants_gimbal = on_gimbal

    def flight(self, last_s: float = inf) -> Flight | None:
        """Return at most the last `last_s` as a flight, up to the latest attitude, estimated or true.

        None if attitude, UTC or position are not known yet; see `LinkStatus.missing`.
        """
        return self.flight_and_estimate(last_s)[0]

    def flight_and_estimate(self, last_s: float = inf) -> tuple[Flight | None, Estimate | None]:
        """Return the flight of at most the last `last_s`, and what the autopilot estimated in the meantime.

        The estimate is None if the flight itself is the autopilot's estimate, or its attitude is not known yet.
        """
        with self._changed:
            received = Received.of(self._receiver, last_s, with_gimbal=self._requests.wants_gimbal)
            position_source, options = self._position_source or "", self._options
        # Outside the lock: the link continues to receive.
        if received is None:
            return None, None
        return received.flight(self.endpoint.text, position_source, options), received.estimate(options)

    def latest(self) -> LatestAttitude | None:
        """Return the times of the latest attitude; None if there is none, or no UTC."""
        with self._changed:
            return self._latest()

    def wait_for(self, utc_s: float, timeout_s: float) -> LatestAttitude | None:
        """Wait for an attitude at or after a time, UTC seconds since 1970; None after the timeout."""
        until_s = time.monotonic() + timeout_s
        with self._changed:
            while (latest := self._latest()) is None or latest.utc_s < utc_s:
                wait_s = until_s - time.monotonic()
                if wait_s <= 0 or not self._changed.wait(wait_s):
                    return None
            return latest

    @property
    def _position_source(self) -> str | None:
        if self._options.site is not None:
            return "given"
        if not self._receiver.sky_history.has_position:
            return None
        simulator = self._receiver.simulator
        return self._receiver.position_source if simulator is None else simulator.position_source

    def _latest(self) -> LatestAttitude | None:
        return self._receiver.latest(of_gimbal=self._requests.wants_gimbal)

    # --- the thread ---------------------------------------------------------------------------------------------------

    def _run(self) -> None:
        try:
            self._supervise()
        except Exception as error:
            self.failure = LinkError(self.endpoint.text, f"ended by an internal error of glstar: {error!r}")
            self.failure.__cause__ = error
            self._set_state("closed", str(self.failure))
        finally:
            self._tried.set()

    def _supervise(self) -> None:
        pause_s = _FIRST_PAUSE_S
        while not self._ending.is_set():
            try:
                transport = open_transport(self.endpoint)
            except LinkError as error:
                if not self._tried.is_set() and not self._retry:
                    self._open_error = error
                    self._tried.set()
                    return
                self._set_state("opening", str(error))
                self._pause(pause_s)
                pause_s = min(pause_s * _PAUSE_FACTOR, _LONGEST_PAUSE_S)
                continue
            self._tried.set()
            with transport:
                self._set_state("waiting", None)
                try:
                    if self._receive(transport):
                        pause_s = _FIRST_PAUSE_S
                    self._restore_rates(transport)
                except LinkError as error:
                    self._set_state("timeout", str(error))
            self._pause(pause_s)
        self._set_state("closed", None)

    def _pause(self, pause_s: float) -> None:
        """Wait before the next attempt; stop waiting when a missing serial port appears."""
        port = Path(self.endpoint.device) if self.endpoint.kind == "serial" else None
        missing = port is not None and not port.exists()
        until_s = time.monotonic() + pause_s
        while time.monotonic() < until_s and not self._ending.wait(_POLL_S):
            if missing and port is not None and port.exists():
                return

    def _receive(self, transport: Transport) -> bool:
        """Receive packets until the link times out or is closed; return whether packets were received."""
        framer = Framer()
        self._requests.restart()
        opened_s = packet_s = time.monotonic()
        noise_bytes = received_bytes = 0
        has_packets = False
        quality = Quality()
        bad_before = self._bad_bytes
        while not self._ending.is_set():
            received = transport.read(_POLL_S)
            now_s = time.monotonic()
            received_bytes += len(received)
            packets = list(framer.feed(received) if received else framer.flush())
            if packets:
                self.recording.write(packets)
                with self._changed:
                    for packet in packets:
                        self._receiver.receive(packet, now_s)
                        if self.camera is not None:
                            self.camera.receive(packet, self._receiver, now_s)
                    self._bad_bytes = bad_before + framer.bad_bytes
                    self._changed.notify_all()
                packet_s = now_s
                noise_bytes = 0
                has_packets = True
                self._set_state("live", None)
            else:
                noise_bytes += len(received)
                self._bad_bytes = bad_before + framer.bad_bytes
                if now_s - packet_s > _TIMEOUT_S:
                    message = no_packets_message(self.endpoint, now_s - packet_s, noise_bytes)
                    self._set_state("timeout" if has_packets else "waiting", message)
                if now_s - packet_s > _REOPEN_S and now_s - opened_s > _REOPEN_S and self._may_reopen():
                    return has_packets
            for message in quality.update(
                now_s,
                packets=self._receiver.packets,
                counted=self._receiver.counted,
                lost=self._receiver.lost,
                bytes_=received_bytes,
                bad_bytes=framer.bad_bytes,
            ):
                self._report(message)
            for request in self._requests.due(self._receiver, now_s):
                transport.write(request)
            for component in self._components:
                for outgoing in component.due(self._receiver, now_s):
                    transport.write(outgoing)
                while component.messages:
                    self._report(component.messages.popleft())
        return has_packets

    def _may_reopen(self) -> bool:
        """Return whether reopening can help after a timeout: not for UDP, nor for a simulator that is paused."""
        return self.endpoint.kind not in {"udpin", "udpout"} and self.clock == "arrival"

    def _new_clock(self) -> BootClock:
        """Return the clock of a vehicle from which nothing has been received."""
        start_s = self._options.utc_start
        return BootClock(
            is_vehicle_time=self.clock == "vehicle",
            utc_minus_host_s=time.time() - time.monotonic() if self._uses_computer_clock else None,
            host_source=COMPUTER_CLOCK if start_s is None else "given: the first packet",
            start_utc_s=start_s,
        )

    def _restore_rates(self, transport: Transport) -> None:
        if self._ending.is_set():
            with suppress(LinkError):
                for packet in self._requests.default_rate_requests(self._receiver):
                    transport.write(packet)

    def _set_state(self, state: LinkState, problem: str | None) -> None:
        """Set state and problem, and report a change."""
        with self._changed:
            if state == self._state and (problem is None) == (self._problem is None):
                self._problem = problem
                return
            self._state = state
            self._problem = problem
        if problem is not None:
            self._had_problem = True
            self._report(problem)
        elif state == "live" and self._had_problem:
            self._had_problem = False
            self._report("packets are received again")

    def _report(self, message: str) -> None:
        """Add an event."""
        _LOG.info("%s: %s", self.endpoint.text, message)
        with self._changed:
            self._event_count += 1
            self._events.append(LinkEvent(self._event_count, time.time(), message))
