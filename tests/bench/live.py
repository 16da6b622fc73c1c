"""Latency of a live view: ``poe bench live``, or ``python -m tests.bench.live``.

A separate process plays the bundled flight at 50 Hz into one end of a serial cable (a socat pair of pseudo-terminals
limited to the baud rate); the viewer listens at the other end.  Prints

arrival to screen   from the arrival of the latest attitude of an image until the image is on the screen
stamp to screen     from the timestamp of that attitude, so that the delay of the cable is included
error               of the attitude at start, middle and end of an exposure, compared with the log at that UTC

and the time of each stage of a frame.
"""

import argparse
import multiprocessing
import os
import platform
import shutil
import subprocess
import tempfile
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from rich.table import Table

from glstar import __version__
from glstar.config import Config
from glstar.link import Endpoint, Link, Transport, Vehicle, open_transport
from glstar.render.scene.scene import Scene
from glstar.system.resources import asset
from glstar.viewer.loop import HeadlessSurface, Surface, Viewer

START_S = 20.0
BITS_A_BYTE = 10


class Cable(Transport):
    """A transport limited to the rate of a serial port: a packet arrives with its last byte."""

    def __init__(self, inner: Transport, baud: int) -> None:
        self.endpoint, self._inner, self._byte_s = inner.endpoint, inner, BITS_A_BYTE / baud
        self._free_s = 0.0

    def read(self, timeout_s: float) -> bytes:
        return self._inner.read(timeout_s)

    def write(self, packet: bytes) -> None:
        self._free_s = max(self._free_s, time.monotonic()) + len(packet) * self._byte_s
        time.sleep(max(self._free_s - time.monotonic(), 0.0))
        self._inner.write(packet)

    def close(self) -> None:
        self._inner.close()


class StampedVehicle(Vehicle):
    """A vehicle that records the time at which its clock began."""

    began_s = np.inf

    def _send(self, message: Any) -> None:
        if message is not None and message.get_type() == "ATTITUDE_QUATERNION":
            self.began_s = min(self.began_s, time.monotonic() - message.time_boot_ms / 1000)
        super()._send(message)


def fly(port: str, baud: int, rate_hz: float, pipe: Connection) -> None:
    """Play the flight until a stop message; then send the time at which its clock began."""
    flight = Config().open_flight(asset("adelaide.BIN"))
    with Cable(open_transport(Endpoint.parse(f"{port},{baud}")), baud) as cable:
        vehicle = StampedVehicle(flight, cable, start_s=START_S, rate_hz=rate_hz)
        stop = threading.Event()
        threading.Thread(target=lambda: (pipe.recv(), stop.set()), daemon=True).start()
        vehicle.run(stop)
    pipe.send(vehicle.began_s)


@contextmanager
def cable() -> Iterator[tuple[str, str]]:
    """Yield the two ends of a serial cable."""
    with tempfile.TemporaryDirectory() as folder:
        ends = tuple(str(Path(folder) / end) for end in ("vehicle", "ground"))
        command = ["socat", *(f"pty,raw,echo=0,link={end}" for end in ends)]
        with subprocess.Popen(command) as socat:
            while not all(Path(end).exists() for end in ends):
                time.sleep(0.01)
            try:
                yield ends[0], ends[1]
            finally:
                socat.terminate()


def watch(surface: Surface, link: Link, seconds: float) -> tuple[list[tuple[Scene, float]], dict[str, Any]]:
    """Show the link; return the scene of each image with the time it was shown, and the viewer's own report."""
    seen: list[tuple[Scene, float]] = []
    with Viewer(surface, Config()) as viewer:
        viewer.follow(link)
        session = viewer.session
        until_s = time.monotonic() + seconds + 60.0
        while session.scene is None or session.scene.exposure.duration_s < Config().exposure.duration_s:
            viewer.frame()
            if time.monotonic() > until_s:
                raise SystemExit(session.status)
        assert session.live is not None
        session.live.record()
        session.times.recording = True
        until_s = time.monotonic() + seconds
        while time.monotonic() < until_s:
            began_s, before = time.perf_counter(), session.scene
            viewer.frame()
            if session.scene is not before:
                seen.append((session.scene, time.monotonic()))
            viewer.pace(began_s)
        return seen, session.times.report() | {"link": session.live.report()}


def main() -> None:
    arguments = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    arguments.add_argument("--seconds", type=float, default=30.0)
    arguments.add_argument("--baud", type=int, default=57600)
    arguments.add_argument("--rate", type=float, default=50.0)
    arguments.add_argument("--window", action="store_true", help="in a real window, not a headless one")
    asked = arguments.parse_args()
    if shutil.which("socat") is None:
        raise SystemExit("socat is not installed")

    def surface() -> Surface:
        if asked.window:
            from glstar.viewer.window import WindowSurface  # noqa: PLC0415

            return WindowSurface((1280, 800))
        return HeadlessSurface((1280, 800))

    here, there = multiprocessing.Pipe()
    screen = surface()
    try:
        with cable() as (vehicle_end, ground_end):
            flying = multiprocessing.get_context("spawn").Process(
                target=fly, args=(vehicle_end, asked.baud, asked.rate, there)
            )
            flying.start()
            with Link(Endpoint.parse(f"{ground_end},{asked.baud}"), rate_hz=asked.rate) as link:
                seen, report = watch(screen, link, asked.seconds)
            here.send("stop")
            began_s = here.recv()
            flying.join()
    finally:
        screen.close()
    print_table(seen, report, began_s)


def print_table(seen: list[tuple[Scene, float]], report: dict[str, Any], began_s: float) -> None:
    """Print the measurements."""
    config = Config()
    flight = config.open_flight(asset("adelaide.BIN"))
    log = config.simulator(flight)
    boot_utc_s = flight.attitude.first_s + START_S
    late_ms, error_deg = [], 0.0
    for scene, shown_s in seen:
        exposure = scene.exposure
        late_ms.append(1e3 * (shown_s - began_s - (exposure.stop_utc_s - boot_utc_s)))
        C_camera_eq = log.pointing(
            np.array([exposure.start_utc_s, exposure.mid_utc_s, exposure.stop_utc_s])
        ).C_camera_eq
        turn = np.einsum("nij,nij->n", C_camera_eq, scene.shutter.C_camera_eq).clip(max=3.0)
        error_deg = max(error_deg, float(np.rad2deg(np.arccos((turn.min() - 1) / 2))))

    console = Console(width=120)
    link = report["link"]
    console.print(f"glstar {__version__}, Python {platform.python_version()}, NumPy {np.__version__}")
    console.print(f"{platform.machine()}, {os.cpu_count()} processors, load {report['load']}")
    console.print(
        f"{link['images']} images in {report['seconds']} s; attitude {link['rate_hz']} Hz,"
        f" {link['packets']} packets, {link['lost']} lost; error at most {error_deg:.4f} deg"
    )
    table = Table(title="milliseconds")
    for column in ("", "median", "95 % under"):
        table.add_column(column, justify="right")
    table.add_row("arrival to screen", *(f"{link['latency_ms'][share]}" for share in ("median", "p95")))
    table.add_row("stamp to screen", *(f"{value:.1f}" for value in np.quantile(late_ms, [0.5, 0.95])))
    for name in ("frame", "python", "simulation", "drawing", "presenting"):
        table.add_row(name, *(f"{report[f'{name}_ms'][share]}" for share in ("median", "p95")))
    console.print(table)


if __name__ == "__main__":
    main()
