"""An hour of a live flight in a minute: ``poe soak-live``, or ``python -m tests.bench.soak``.

A process of its own sends a flight of an hour, 50 attitudes a second, sixty times as fast over TCP; the viewer shows it
and the link is recorded.  Every few minutes of flight it prints how large the process is, how far the UTC of the link
has drifted from the vehicle's, and how far the attitude in the newest image is from the truth.
"""

import argparse
import gc
import multiprocessing
import socket
import tempfile
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from glstar.config import Config
from glstar.flight import Flight
from glstar.link import Endpoint, Link, Recorder
from glstar.link.messages import dialect
from glstar.rotation import conjugate, quaternion_from_euler
from glstar.sky.site import Site
from glstar.telemetry import ScriptedFlight
from glstar.viewer.headless import HeadlessSurface
from glstar.viewer.loop import Viewer
from tests.support.links import free_port

UTC_S = 1710068400.0
SMALL = {"width_px": 254, "height_px": 190, "fx_px": 242.0, "fy_px": 242.0}


@dataclass(frozen=True, slots=True)
class Look:
    """How it was at one moment.

    Attributes
    ----------
    flown_s : float
        How much of the flight had come, s.
    resident_kb : int
        What the process takes of the memory.
    drift_s : float
        The link's UTC minus the vehicle's, s.
    error_rad : float
        Of the attitude in the middle of the newest image.
    recorded_bytes : int
    """

    flown_s: float
    resident_kb: int
    drift_s: float
    error_rad: float
    recorded_bytes: int


def long_flight(duration_s: float) -> Flight:
    """Return a flight that weaves over Adelaide."""

    def script(t: np.ndarray) -> np.ndarray:
        return np.asarray(quaternion_from_euler(0.4 * np.sin(t / 3), 0.1 * np.cos(t / 5), (t / 20) % (2 * np.pi)))

    site = Site(np.deg2rad(-34.93), np.deg2rad(138.60), 300.0)
    return ScriptedFlight(script, site, UTC_S, duration_s, rate_hz=50.0).flight()


def fly(port: int, duration_s: float, speed: float) -> None:
    """Send the flight to whoever connects: every packet of it, none left out where the other end is slow."""
    flight, mavlink = long_flight(duration_s), dialect()
    link = mavlink.MAVLink(None, srcSystem=1, srcComponent=1)
    q_ned_body = conjugate(flight.attitude.q_body_ned).tolist()

    def packed(message: Any) -> bytes:
        link.seq = (link.seq + 1) % 256
        return bytes(message.pack(link))

    with socket.create_server(("127.0.0.1", port)) as server:
        ground, _ = server.accept()
        with ground:
            began_s = time.monotonic()
            for step, q in enumerate(q_ned_body):
                boot_ms = 20 * step
                packets = [packed(mavlink.MAVLink_attitude_quaternion_message(boot_ms, *q, 0, 0, 0))]
                if step % 10 == 0:
                    place = -349300000, 1386000000, 300_000, 300_000
                    packets.append(packed(mavlink.MAVLink_global_position_int_message(boot_ms, *place, 0, 0, 0, 0)))
                if step % 25 == 0:
                    utc_us = round(1e6 * UTC_S) + 1000 * boot_ms
                    packets.append(packed(mavlink.MAVLink_system_time_message(utc_us, boot_ms)))
                if step % 50 == 0:
                    packets.append(packed(mavlink.MAVLink_heartbeat_message(1, 3, 0, 0, 4, 3)))
                ground.sendall(b"".join(packets))
                time.sleep(max(began_s + boot_ms / 1000 / speed - time.monotonic(), 0.0))
            ground.shutdown(socket.SHUT_WR)
            # What was asked for is read and not answered, until the other end has heard all.
            while ground.recv(4096):
                pass


def resident_kb() -> int:
    """Return what this process takes of the memory now, kB."""
    gc.collect()
    pages = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[1])
    return pages * 4


def soak(duration_s: float, speed: float, every_s: float, *, keep_s: float = 600.0) -> Iterator[Look]:
    """Yield how it is, every so many seconds of flight."""
    port, truth = free_port(socket.SOCK_STREAM), long_flight(duration_s)
    flying = multiprocessing.get_context("spawn").Process(target=fly, args=(port, duration_s, speed), daemon=True)
    flying.start()
    surface = HeadlessSurface((900, 600))
    config = Config().override(**{f"camera.{key}": value for key, value in SMALL.items()})
    try:
        with tempfile.TemporaryDirectory() as folder, Recorder(Path(folder) / "flight.tlog") as recorder:
            endpoint = Endpoint.parse(f"tcp:127.0.0.1:{port}")
            link = Link(endpoint, rate_hz=50, keep_s=keep_s, recorder=recorder, retry=True)
            with link, Viewer(surface, config) as viewer:
                viewer.follow(link)
                yield from _looks(viewer, link, truth, every_s, lambda: recorder.bytes)
    finally:
        surface.close()
        flying.terminate()
        flying.join()


def _looks(viewer: Viewer, link: Link, truth: Flight, every_s: float, recorded: Callable[[], int]) -> Iterator[Look]:
    session, due_s, patient_s = viewer.session, every_s, time.monotonic() + 60.0
    flight_s = truth.attitude.last_s - truth.attitude.first_s
    while time.monotonic() < patient_s:
        viewer.frame()
        newest = link.latest()
        if newest is None or session.scene is None:
            continue
        flown_s = newest.utc_s - truth.attitude.first_s
        if flown_s >= due_s:
            due_s, patient_s = due_s + every_s, time.monotonic() + 60.0
            q = truth.attitude.at(session.scene.exposure.mid_utc_s)
            error_rad = 2 * float(np.arccos(min(abs(q @ session.scene.q_body_ned), 1.0)))
            # The vehicle's time since boot counts from the flight's first attitude.
            drift_s = newest.utc_minus_boot_s - truth.attitude.first_s
            yield Look(flown_s, resident_kb(), drift_s, error_rad, recorded())
            if due_s > flight_s:
                return
    words = "; ".join(event.message for event in link.events()[-10:])
    raise TimeoutError(f"{session.status or 'nothing comes any more'} ({words})")


def main() -> None:
    arguments = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    arguments.add_argument("--minutes", type=float, default=60.0)
    arguments.add_argument("--speed", type=float, default=60.0)
    asked = arguments.parse_args()
    print("flown, min   memory, MB   drift, ms   error, deg   recorded, MB")
    for look in soak(60 * asked.minutes + 5, asked.speed, 300.0):
        print(
            f"{look.flown_s / 60:10.1f} {look.resident_kb / 1024:12.1f} {1e3 * look.drift_s:11.3f}"
            f" {np.rad2deg(look.error_rad):12.4f} {look.recorded_bytes / 1e6:14.1f}",
            flush=True,
        )


if __name__ == "__main__":
    main()
