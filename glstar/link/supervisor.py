"""The thread that owns a link: opens it, asks, listens, notices silence, closes, waits, opens it again.

Other threads take snapshots: `Link.status`, `Link.flight`.  Nothing they do waits for the link.
"""

import logging
import time
from collections import deque
from contextlib import suppress
from dataclasses import dataclass
from math import inf
from pathlib import Path
from threading import Condition, Event, Thread
from types import TracebackType
from typing import Final, Self

from glstar.errors import ConfigError, LinkError
from glstar.flight import Flight, Interpolation
from glstar.link.clock import COMPUTERS, BootClock
from glstar.link.endpoint import Endpoint
from glstar.link.framing import Framer, Packet
from glstar.link.messages import carried_rate_hz
from glstar.link.quality import Quality
from glstar.link.receiver import Receiver
from glstar.link.recorder import Recorder
from glstar.link.requests import Requests
from glstar.link.transport import Transport, open_transport
from glstar.sky.site import Site

__all__ = ["Link", "LinkEvent", "LinkStatus", "NewestAttitude"]

_LOG = logging.getLogger(__name__)

# From one try to open a link to the next, s.
_FIRST_PAUSE_S, _LONGEST_PAUSE_S, _LONGER = 0.5, 5.0, 1.5
# How often the thread looks whether it shall end, s.
_GLANCE_S: Final = 0.05
# After so long without a packet the link is told to be silent, and after so much more it is opened anew, s.
_SILENT_S, _DEAD_S = 2.0, 5.0
# So many bytes without a packet among them are no accident.
_NOISE_BYTES: Final = 300
_EVENTS: Final = 200


@dataclass(frozen=True, slots=True)
class LinkEvent:
    """Something that happened on a link.

    Attributes
    ----------
    number : int
        Counts the events of a link.
    utc_s : float
        When, by the computer's clock, UTC seconds since 1970.
    words : str
        What.
    """

    number: int
    utc_s: float
    words: str


@dataclass(frozen=True, slots=True)
class LinkStatus:
    """How a link is.

    Attributes
    ----------
    endpoint : str
        As the user named it.
    state : {"opening", "waiting", "live", "silent", "closed"}
        ``waiting``: open, and no packet came yet; ``silent``: packets came, and come no more.
    trouble : str or None
        What is wrong, in words.
    vehicle : str or None
        What flies.
    sysid : int or None
        Its MAVLink system.
    systems : tuple of int
        All autopilots that were heard.
    rate_hz : float
        Attitudes a second, over the last two.
    age_s : float or None
        Since the newest attitude came, s.
    packets, lost, bad_bytes : int
        Packets that came and that did not; bytes that belonged to none.
    utc_source : str or None
        Where UTC comes from; None where nobody knows it.
    position_source : str or None
        Where the place comes from; None where nobody knows it.
    recorded_bytes : int
        How much was recorded.
    """

    endpoint: str
    state: str
    trouble: str | None
    vehicle: str | None
    sysid: int | None
    systems: tuple[int, ...]
    rate_hz: float
    age_s: float | None
    packets: int
    lost: int
    bad_bytes: int
    utc_source: str | None
    position_source: str | None
    recorded_bytes: int

    @property
    def lacking(self) -> tuple[str, ...]:
        """What is still to be known before the sky can be drawn, and what to do about it, in words."""
        lacking = []
        if self.age_s is None:
            lacking.append("no attitude yet")
        if self.utc_source is None:
            lacking.append("no UTC yet (--utc-now takes the computer's clock)")
        if self.position_source is None:
            lacking.append("no position yet (--lat, --lon)")
        return tuple(lacking)


@dataclass(frozen=True, slots=True)
class NewestAttitude:
    """The newest attitude of a link.

    Attributes
    ----------
    utc_s : float
        Its time, UTC seconds since 1970.
    arrival_s : float
        When it came, by `time.monotonic`.
    utc_minus_boot_s : float
        UTC minus the autopilot's time since boot, s: another one by more than jitter is another boot, or another clock.
    boot : int
        Counts the autopilot's boots that were seen.
    utc_minus_host_s : float
        UTC minus the computer's steady clock, s, without the link's delays.
    """

    utc_s: float
    arrival_s: float
    utc_minus_boot_s: float
    boot: int = 0
    utc_minus_host_s: float = 0.0

    def utc_step_s(self, before: "NewestAttitude") -> float:
        """Return by how much UTC was set since an earlier attitude, s; a reboot alone sets it by nothing.

        Parameters
        ----------
        before : NewestAttitude

        Returns
        -------
        float
        """
        if self.boot == before.boot:
            return self.utc_minus_boot_s - before.utc_minus_boot_s
        return self.utc_minus_host_s - before.utc_minus_host_s


class Link:
    """A telemetry link in the background; a context manager, whose thread ends with it.

    Parameters
    ----------
    endpoint : Endpoint
    sysid : int, optional
        The MAVLink system to listen to; by default the first autopilot heard.
    site : Site, optional
        The place, instead of what the link tells.
    utc_start : float, optional
        UTC of the first packet, seconds since 1970, instead of what the link tells.
    utc_now : bool
        Whether the computer's clock is UTC where the link tells none.
    rate_hz : float, optional
        How often to ask for the attitude, Hz; by default what the link can carry.
    keep_s : float
        How much of the flight is remembered, s; of attitudes that come faster than 200 Hz less.
    time_offset_s : float
        The camera's clock minus UTC, s; it names images, see `Flight`.
    interpolation : {"slerp", "spline"}
        See `AttitudeTrack`.
    max_gap_s : float, optional
        The longest silence to interpolate across, s; see `AttitudeTrack.from_samples`.
    recorder : Recorder, optional
        Takes every packet; it is used, not closed.
    patient : bool
        Whether to go on trying where the first opening fails.

    Raises
    ------
    ConfigError
        If the interpolation wants gyros.
    """

    def __init__(
        self,
        endpoint: Endpoint,
        *,
        sysid: int | None = None,
        site: Site | None = None,
        utc_start: float | None = None,
        utc_now: bool = False,
        rate_hz: float | None = None,
        keep_s: float = 600.0,
        time_offset_s: float = 0.0,
        interpolation: Interpolation = "slerp",
        max_gap_s: float | None = None,
        recorder: Recorder | None = None,
        patient: bool = False,
    ) -> None:
        if interpolation == "gyro":
            raise ConfigError("a link tells no rates of the gyros; take slerp or spline", key="flight.interpolation")
        self.endpoint = endpoint
        self._time_offset_s, self._interpolation = time_offset_s, interpolation
        self._site, self._max_gap_s, self._recorder, self._patient = site, max_gap_s, recorder, patient
        clock = BootClock(
            utc_minus_host_s=time.time() - time.monotonic() if utc_now else None,
            given="given: the first packet" if utc_start is not None else COMPUTERS,
            start_utc_s=utc_start,
        )
        self._receiver = Receiver(clock, self._tell, sysid=sysid, keep_s=keep_s)
        self._requests = Requests(carried_rate_hz(endpoint) if rate_hz is None else rate_hz)
        # Guards all that follows and the receiver; notified when an attitude has come.
        self._changed = Condition()
        self._state = "opening"
        self._trouble: str | None = None
        # Whether trouble was told since packets last came.
        self._troubled = False
        self._events: deque[LinkEvent] = deque(maxlen=_EVENTS)
        self._told = 0
        self._bad_bytes = 0
        self._refused: LinkError | None = None
        self._fault: Exception | None = None
        self._tried, self._ending = Event(), Event()
        self._thread = Thread(target=self._run, name=f"glstar link {endpoint.text}", daemon=True)

    def __enter__(self) -> Self:
        """Open the link.

        Raises
        ------
        LinkError
            If it cannot be opened, unless it is patient.
        """
        self._thread.start()
        if not self._patient:
            self._tried.wait()
            if self._refused is not None:
                self.close()
                raise self._refused
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def close(self) -> None:
        """Give back the usual rates, close the link and end its thread; it may be called twice."""
        self._ending.set()
        if self._thread.is_alive():
            self._thread.join()
        if self._fault is not None:
            fault, self._fault = self._fault, None
            raise fault

    # --- what others see ----------------------------------------------------------------------------------------------

    def status(self) -> LinkStatus:
        """Return how the link is now.

        Returns
        -------
        LinkStatus
        """
        now_s = time.monotonic()
        with self._changed:
            receiver = self._receiver
            arrival_s = receiver.attitude_arrival_s
            return LinkStatus(
                endpoint=self.endpoint.text,
                state=self._state,
                trouble=self._trouble,
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
                recorded_bytes=0 if self._recorder is None else self._recorder.bytes,
            )

    def events(self, after: int = 0) -> list[LinkEvent]:
        """Return what happened, of the last 200 events.

        Parameters
        ----------
        after : int
            The number of the last event already known.

        Returns
        -------
        list of LinkEvent
        """
        with self._changed:
            return [event for event in self._events if event.number > after]

    def take_computers_utc(self) -> None:
        """Take the computer's clock for UTC, where the link tells none."""
        with self._changed:
            self._receiver.clock.take_computers(time.time() - time.monotonic())

    def take_place(self, site: Site) -> None:
        """Take a place, instead of what the link tells.

        Parameters
        ----------
        site : Site
        """
        with self._changed:
            self._site = site

    def flight(self, last_s: float = inf) -> Flight | None:
        """Return the last minutes as a flight: it ends at the newest attitude.

        Parameters
        ----------
        last_s : float
            No more than so much of it, s.

        Returns
        -------
        Flight or None
            None where two attitudes, UTC or the place are not known yet; `status` tells which.
        """
        with self._changed:
            receiver = self._receiver
            utc_minus_boot_s, utc_source = receiver.clock.utc_minus_boot_s, receiver.clock.source or ""
            if utc_minus_boot_s is None:
                return None
            attitude_source, position_source = receiver.attitude_source, self._position_source or ""
            memory = receiver.history.memory(last_s)
        # The link listens on while the flight is made.
        return memory.flight(
            utc_minus_boot_s,
            name=self.endpoint.text,
            attitude_source=attitude_source,
            position_source=position_source,
            utc_source=utc_source,
            site=self._site,
            interpolation=self._interpolation,
            max_gap_s=self._max_gap_s,
            time_offset_s=self._time_offset_s,
        )

    def newest(self) -> NewestAttitude | None:
        """Return when the newest attitude was and when it came; None where there is none, or no UTC.

        Returns
        -------
        NewestAttitude or None
        """
        with self._changed:
            return self._newest()

    def wait_for(self, utc_s: float, timeout_s: float) -> NewestAttitude | None:
        """Wait for an attitude that is not older than a time.

        Parameters
        ----------
        utc_s : float
            UTC seconds since 1970.
        timeout_s : float
            No longer than this, s.

        Returns
        -------
        NewestAttitude or None
            None where none came in time.
        """
        until_s = time.monotonic() + timeout_s
        with self._changed:
            while (newest := self._newest()) is None or newest.utc_s < utc_s:
                left_s = until_s - time.monotonic()
                if left_s <= 0 or not self._changed.wait(left_s):
                    return None
            return newest

    @property
    def _position_source(self) -> str | None:
        if self._site is not None:
            return "given"
        if not self._receiver.history.has_position:
            return None
        return self._receiver.position_source

    def _newest(self) -> NewestAttitude | None:
        receiver = self._receiver
        boot_s, arrival_s = receiver.history.newest_boot_s, receiver.attitude_arrival_s
        utc_minus_boot_s, host_minus_boot_s = receiver.clock.utc_minus_boot_s, receiver.clock.host_minus_boot_s
        if boot_s is None or arrival_s is None or utc_minus_boot_s is None or host_minus_boot_s is None:
            return None
        return NewestAttitude(
            boot_s + utc_minus_boot_s,
            arrival_s,
            utc_minus_boot_s,
            receiver.clock.boot,
            utc_minus_boot_s - host_minus_boot_s,
        )

    # --- the thread ---------------------------------------------------------------------------------------------------

    def _run(self) -> None:
        try:
            self._supervise()
        except Exception as error:
            self._fault = error
            self._be("closed", f"a fault of glstar's own: {error!r}")
        finally:
            self._tried.set()

    def _supervise(self) -> None:
        pause_s = _FIRST_PAUSE_S
        while not self._ending.is_set():
            try:
                transport = open_transport(self.endpoint)
            except LinkError as error:
                if not self._tried.is_set() and not self._patient:
                    self._refused = error
                    self._tried.set()
                    return
                self._be("opening", str(error))
                self._pause(pause_s)
                pause_s = min(pause_s * _LONGER, _LONGEST_PAUSE_S)
                continue
            self._tried.set()
            with transport:
                self._be("waiting", None)
                try:
                    if self._listen(transport):
                        pause_s = _FIRST_PAUSE_S
                    self._bid_farewell(transport)
                except LinkError as error:
                    self._be("silent", str(error))
            self._pause(pause_s)
        self._be("closed", None)

    def _pause(self, pause_s: float) -> None:
        """Wait before the next try; a serial port that appears ends the waiting."""
        port = Path(self.endpoint.device) if self.endpoint.kind == "serial" else None
        missing = port is not None and not port.exists()
        until_s = time.monotonic() + pause_s
        while time.monotonic() < until_s and not self._ending.wait(_GLANCE_S):
            if missing and port is not None and port.exists():
                return

    def _listen(self, transport: Transport) -> bool:
        """Take in what comes until the link is silent for long, or shall end; return whether packets came."""
        framer = Framer()
        self._requests.begin_anew()
        opened_s = packet_s = time.monotonic()
        noise_bytes, came = 0, False
        quality, received_bytes = Quality(), 0
        bad_before = self._bad_bytes
        boot = self._receiver.clock.boot
        while not self._ending.is_set():
            received = transport.read(_GLANCE_S)
            now_s = time.monotonic()
            received_bytes += len(received)
            packets = list(framer.feed(received) if received else framer.settle())
            if packets:
                self._record(packets)
                with self._changed:
                    for packet in packets:
                        self._receiver.receive(packet, now_s)
                    self._bad_bytes = bad_before + framer.bad_bytes
                    self._changed.notify_all()
                packet_s, noise_bytes, came = now_s, 0, True
                self._be("live", None)
            else:
                noise_bytes += len(received)
                self._bad_bytes = bad_before + framer.bad_bytes
                if now_s - packet_s > _SILENT_S:
                    self._be("silent" if came else "waiting", self._why_nothing(now_s - packet_s, noise_bytes))
                if now_s - packet_s > _DEAD_S and now_s - opened_s > _DEAD_S and self._reopening_helps():
                    return came
            for words in quality.noted(
                now_s,
                packets=self._receiver.packets,
                lost=self._receiver.lost,
                bytes_=received_bytes,
                bad_bytes=framer.bad_bytes,
            ):
                self._tell(words)
            if self._receiver.clock.boot != boot:
                boot = self._receiver.clock.boot
                self._requests.begin_anew()
            for request in self._requests.due(self._receiver, now_s):
                transport.write(request)
        return came

    def _reopening_helps(self) -> bool:
        """Return whether a silent link may come back by being opened anew: a UDP port only hears or does not."""
        return self.endpoint.kind not in {"udpin", "udpout"}

    def _bid_farewell(self, transport: Transport) -> None:
        if self._ending.is_set():
            with suppress(LinkError):
                for packet in self._requests.farewell(self._receiver):
                    transport.write(packet)

    def _record(self, packets: list[Packet]) -> None:
        if self._recorder is None:
            return
        try:
            self._recorder.write(packets)
        except LinkError as error:
            self._tell(str(error))

    def _why_nothing(self, silent_s: float, noise_bytes: int) -> str:
        endpoint = self.endpoint
        if noise_bytes > _NOISE_BYTES:
            if endpoint.kind == "serial":
                return (
                    f"{noise_bytes} bytes and no packet at {endpoint.baud} baud: a wrong baud rate?"
                    f" Radios are set to 57600, autopilots to 57600 or 115200 ({endpoint.device},115200)"
                )
            return f"{noise_bytes} bytes and no packet among them: is it MAVLink that is sent there?"
        asks = {
            "serial": "is the vehicle on, and the port and its baud rate the right ones?",
            "udpin": f"is something else listening on UDP port {endpoint.port}, or sending elsewhere?"
            f" QGroundControl and MAVProxy forward a copy: mavproxy.py --out 127.0.0.1:{endpoint.port}",
            "udpout": f"does somebody listen on UDP port {endpoint.port} there?",
            "tcp": "is the vehicle on?",
            "tcpin": "has nobody connected?",
        }
        return f"no packets on {endpoint.text} for {int(silent_s)} s; {asks[endpoint.kind]}"

    def _be(self, state: str, trouble: str | None) -> None:
        """Change the state, and tell what is new about it."""
        with self._changed:
            if state == self._state and (trouble is None) == (self._trouble is None):
                self._trouble = trouble
                return
            self._state, self._trouble = state, trouble
        if trouble is not None:
            self._troubled = True
            self._tell(trouble)
        elif state == "live" and self._troubled:
            self._troubled = False
            self._tell("packets come again")

    def _tell(self, words: str) -> None:
        _LOG.info("%s: %s", self.endpoint.text, words)
        with self._changed:
            self._told += 1
            self._events.append(LinkEvent(self._told, time.time(), words))
