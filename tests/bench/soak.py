"""An hour of a live flight in a minute: ``poe bench soak``, or ``python -m tests.bench.soak``.

A separate process sends a flight of an hour, 50 attitudes a second, sixty times as fast over TCP; the viewer shows it
and the link is recorded.  Every few minutes of flight it prints the memory of the process, the drift of the link's UTC
from the vehicle's, and the attitude error of the latest image.
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
from glstar.link.packets import dialect
from glstar.rotation import conjugate, quaternion_from_euler
from glstar.sky.place.site import Site
from glstar.telemetry import ScriptedFlight
from glstar.viewer.loop import HeadlessSurface, Viewer
from tests.support.links import free_port

UTC_S = 1710068400.0
SMALL = {"width_px": 254, "height_px": 190, "fx_px": 242.0, "fy_px": 242.0}


@dataclass(frozen=True, slots=True)
class Sample:
    """Measurements at one time of the flight.

    Attributes
    ----------
    flown_s : float
        Duration of the received part of the flight, s.
    resident_kb : int
        Resident memory of the process, kB.
    drift_s : float
        The link's UTC minus the vehicle's, s.
    error_rad : float
        Attitude error in the middle of the latest image.
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
    """Send every packet of the flight to the client that connects, however slowly it reads."""
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
                    position = -349300000, 1386000000, 300_000, 300_000
                    packets.append(packed(mavlink.MAVLink_global_position_int_message(boot_ms, *position, 0, 0, 0, 0)))
                if step % 25 == 0:
                    utc_us = round(1e6 * UTC_S) + 1000 * boot_ms
                    packets.append(packed(mavlink.MAVLink_system_time_message(utc_us, boot_ms)))
                if step % 50 == 0:
                    packets.append(packed(mavlink.MAVLink_heartbeat_message(1, 3, 0, 0, 4, 3)))
                ground.sendall(b"".join(packets))
                time.sleep(max(began_s + boot_ms / 1000 / speed - time.monotonic(), 0.0))
            ground.shutdown(socket.SHUT_WR)
            # Requests are read and ignored until the client has received all packets.
            while ground.recv(4096):
                pass


def resident_kb() -> int:
    """Return the resident memory of this process, kB."""
    gc.collect()
    pages = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[1])
    return pages * 4


def soak(duration_s: float, speed: float, every_s: float, *, keep_s: float = 600.0) -> Iterator[Sample]:
    """Yield a sample at each interval of flight time."""
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
                yield from _samples(viewer, link, truth, every_s, lambda: recorder.bytes)
    finally:
        surface.close()
        flying.terminate()
        flying.join()


def _samples(
    viewer: Viewer, link: Link, truth: Flight, every_s: float, recorded: Callable[[], int]
) -> Iterator[Sample]:
    session, due_s, deadline_s = viewer.session, every_s, time.monotonic() + 60.0
    flight_s = truth.attitude.last_s - truth.attitude.first_s
    while time.monotonic() < deadline_s:
        viewer.frame()
        latest = link.latest()
        if latest is None or session.scene is None:
            continue
        flown_s = latest.utc_s - truth.attitude.first_s
        if flown_s >= due_s:
            due_s, deadline_s = due_s + every_s, time.monotonic() + 60.0
            q = truth.attitude.at(session.scene.exposure.mid_utc_s)
            error_rad = 2 * float(np.arccos(min(abs(q @ session.scene.q_body_ned), 1.0)))
            # The vehicle's time since boot counts from the flight's first attitude.
            drift_s = latest.utc_minus_boot_s - truth.attitude.first_s
            yield Sample(flown_s, resident_kb(), drift_s, error_rad, recorded())
            if due_s > flight_s:
                return
    messages = "; ".join(event.message for event in link.events()[-10:])
    raise TimeoutError(f"{session.status or 'no more packets'} ({messages})")


def main() -> None:
    arguments = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    arguments.add_argument("--minutes", type=float, default=60.0)
    arguments.add_argument("--speed", type=float, default=60.0)
    asked = arguments.parse_args()
    print("flown, min   memory, MB   drift, ms   error, deg   recorded, MB")
    for sample in soak(60 * asked.minutes + 5, asked.speed, 300.0):
        print(
            f"{sample.flown_s / 60:10.1f} {sample.resident_kb / 1024:12.1f} {1e3 * sample.drift_s:11.3f}"
            f" {np.rad2deg(sample.error_rad):12.4f} {sample.recorded_bytes / 1e6:14.1f}",
            flush=True,
        )


if __name__ == "__main__":
    main()
