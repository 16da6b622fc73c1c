"""Vehicles and cables for tests of links: played in threads, over loopback and pseudo-terminals."""

import os
import select
import signal
import socket
import threading
import time
import tty
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from glstar.flight import AttitudeTrack, Flight
from glstar.link import Endpoint, LatestAttitude, Link, Packet, Transport, Vehicle, open_transport
from glstar.telemetry import FlightOptions
from tests.support.scenes import ADELAIDE
from tests.support.sender import Sender, system_time

# Much longer than needed, for busy machines.
PATIENCE_S = 20.0


def free_port(kind: socket.SocketKind = socket.SOCK_DGRAM) -> int:
    with socket.socket(socket.AF_INET, kind) as one:
        one.bind(("127.0.0.1", 0))
        return int(one.getsockname()[1])


def soon(true: Callable[[], Any], within_s: float) -> Any:
    """Poll a function until it returns a true value or the time is over; return its last value."""
    end_s = time.monotonic() + within_s
    while not (found := true()) and time.monotonic() <= end_s:
        time.sleep(0.01)
    return found


def until(true: Callable[[], Any], what: str, patience_s: float = PATIENCE_S) -> Any:
    """Poll a function until it returns a true value, and return that value; fail after a timeout."""
    found = soon(true, patience_s)
    if not found:
        pytest.fail(f"{what}: not within {patience_s} s")
    return found


@contextmanager
def playing(flight: Flight, transport: Transport | str, **options: Any) -> Iterator[Vehicle]:
    """Play a flight in a thread of its own."""
    opened = open_transport(Endpoint.parse(transport)) if isinstance(transport, str) else transport
    stop = threading.Event()
    with opened:
        vehicle = Vehicle(flight, opened, **options)
        thread = threading.Thread(target=vehicle.run, args=(stop,), name="vehicle")
        thread.start()
        try:
            yield vehicle
        finally:
            stop.set()
            thread.join()


class Plug(Transport):
    """The vehicle's end of a serial cable, which can be unplugged: the other end is a port of that name."""

    def __init__(self, port: Path, damage: Callable[[bytes], bytes] = bytes) -> None:
        self.endpoint = Endpoint.parse("serial:plug")
        self.port, self.damage = port, damage
        self._ends: tuple[int, int] | None = None
        self._lock = threading.Lock()
        self.plug_in()

    def plug_in(self) -> None:
        with self._lock:
            self._ends = os.openpty()
            tty.setraw(self._ends[1])
            os.set_blocking(self._ends[0], False)
            self.port.symlink_to(os.ttyname(self._ends[1]))

    def pull_out(self) -> None:
        with self._lock:
            self.port.unlink()
            for end in self._ends or ():
                os.close(end)
            self._ends = None

    def read(self, timeout_s: float) -> bytes:
        with self._lock:
            if self._ends is not None:
                with suppress(OSError):
                    if select.select([self._ends[0]], [], [], 0.0)[0]:
                        return os.read(self._ends[0], 4096)
        time.sleep(min(timeout_s, 0.01))
        return b""

    def write(self, packet: bytes) -> None:
        with self._lock, suppress(OSError):
            if self._ends is not None:
                os.write(self._ends[0], self.damage(packet))

    def close(self) -> None:
        if self._ends is not None:
            self.pull_out()


def farthest_rad(track: AttitudeTrack, truth: AttitudeTrack) -> float:
    """Return the largest angle between the samples of a track and another track at the same times."""
    reported = truth.at(track.utc_s.clip(truth.first_s, truth.last_s))
    cosine = np.abs(np.sum(reported * track.q_body_ned, axis=-1)).clip(max=1.0)
    return float(2 * np.arccos(cosine).max())


Script = list[tuple[float, Packet]]


class ScriptedLink(Link):
    """A link whose packets arrive as a script says; Ctrl-C is pressed at its end."""

    def __init__(self, script: Script) -> None:
        super().__init__(Endpoint.parse("udpin:127.0.0.1:14550"), FlightOptions(site=ADELAIDE))
        self._script = deque(sorted(script, key=lambda one: one[0]))
        self._state = "live"
        self.now_s = 0.0

    def wait_for(self, utc_s: float, timeout_s: float) -> LatestAttitude | None:
        until_s = self.now_s + timeout_s
        while (latest := self.latest()) is None or latest.utc_s < utc_s:
            if not self._script:
                raise KeyboardInterrupt
            if self._script[0][0] > until_s:
                self.now_s = until_s
                return None
            self.now_s, packet = self._script.popleft()
            with self._changed:
                self._receiver.receive(packet, self.now_s)
        return latest


def flown(
    plane: Sender, boot_s: float, from_s: float, to_s: float, utc_s: float | None
) -> Iterator[tuple[float, Packet]]:
    """Yield the packets of an autopilot between two times of the script; `utc_s` is UTC at its time 0."""
    for step in range(round((to_s - from_s) * 50)):
        at_s = from_s + step / 50
        if step % 50 == 0:
            yield at_s, plane.heartbeat()
        if utc_s is not None and step % 25 == 0:
            yield at_s, system_time(plane, boot_s + step / 50, utc_s + at_s)
        yield at_s, plane.angles(boot_s + step / 50, 0.01 * at_s)


def has_frames(directory: Path, count: int) -> bool:
    """Return whether an export in progress has this number of frames."""
    lines = directory / "truth.jsonl.partial"
    return lines.exists() and lines.read_bytes().count(b"\n") >= count


@contextmanager
def interrupted_when(true: Callable[[], bool]) -> Iterator[None]:
    """Press Ctrl-C once a condition holds, for example after a number of frames."""
    over = threading.Event()

    def watch() -> None:
        while not over.wait(0.02):
            if true():
                signal.raise_signal(signal.SIGINT)
                return

    handler = signal.signal(signal.SIGINT, signal.default_int_handler)
    watcher = threading.Thread(target=watch)
    watcher.start()
    try:
        yield
    finally:
        over.set()
        watcher.join()
        signal.signal(signal.SIGINT, handler)
