"""Foreign clients: packets of real vehicles as they were recorded, and MAVProxy in between."""

import os
import shutil
import socket
import subprocess
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest

from glstar.config import Config
from glstar.flight import Flight
from glstar.link import Endpoint, Link
from glstar.system.resources import asset
from tests.support.links import farthest_rad, free_port, playing, until

DEG = np.pi / 180
LOGS = Path(__file__).parents[3] / "shared" / "logs"
# ArduSub with its ground station and two companions; a plane over Adelaide.
ROV, PLANE = LOGS / "rov_ardusub_small.tlog", LOGS / "plane_SITL_adelaide_100Hz.tlog"
needs_logs = pytest.mark.skipif(not ROV.exists(), reason=f"no sample logs in {LOGS}")
MAVPROXY = shutil.which("mavproxy.py")


@contextmanager
def sent_again(log: Path, port: int, *, speed: float, seconds: float) -> Iterator[None]:
    """Send the packets of a telemetry log over UDP as they were recorded, byte for byte, faster."""
    raw, packets, at = log.read_bytes(), [], 0
    while at + 17 < len(raw):
        length = raw[at + 9] + (12 + 13 * (raw[at + 10] & 1) if raw[at + 8] == 0xFD else 8)
        if raw[at + 8] not in {0xFD, 0xFE}:
            at += 1
            continue
        packets.append((int.from_bytes(raw[at : at + 8], "big") * 1e-6, raw[at + 8 : at + 8 + length]))
        at += 8 + length
    ending = threading.Event()

    def send() -> None:
        began_s, first_s = time.monotonic(), packets[0][0]
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as one:
            for stamp_s, packet in packets:
                due_s = began_s + (stamp_s - first_s) / speed
                if stamp_s - first_s > seconds or ending.wait(max(due_s - time.monotonic(), 0.0)):
                    return
                one.sendto(packet, ("127.0.0.1", port))

    thread = threading.Thread(target=send)
    thread.start()
    try:
        yield
    finally:
        ending.set()
        thread.join()


def flown(link: Link, seconds: float) -> Flight:
    """Return the link's flight when it is long enough."""

    def found() -> Flight | None:
        flight = link.flight()
        return flight if flight and flight.attitude.last_s - flight.attitude.first_s > seconds else None

    result = until(found, f"{seconds} s of flight")
    assert isinstance(result, Flight)
    return result


@needs_logs
@pytest.mark.parametrize(
    ("log", "vehicle", "senders_utc"), [(PLANE, "ArduPlane", False), (ROV, "ArduSub", True)], ids=["plane", "rov"]
)
def test_the_packets_of_a_real_vehicle_are_the_flight_of_its_log(log: Path, vehicle: str, senders_utc: bool) -> None:
    port, truth = free_port(), Config().open_flight(log)
    with Link(Endpoint.parse(f"udpin:127.0.0.1:{port}")) as link, sent_again(log, port, speed=4.0, seconds=40.0):
        received = flown(link, 30.0)
        status = link.status()

    assert status.vehicle == vehicle
    assert received.attitude_source.startswith("ATTITUDE")
    latitude_deg = np.rad2deg(received.position.at(received.attitude.last_s).latitude_rad)
    assert latitude_deg == pytest.approx(np.rad2deg(truth.position.at(truth.attitude.last_s).latitude_rad), abs=0.01)
    if senders_utc:
        # Only the ground station sent UTC, and in a faster replay its clock drifts from the vehicle's: attitudes are
        # compared by the time since boot.
        assert "another system" in received.utc_source
        shift_s = truth.attitude.utc_s[np.argmax(similarity(truth, received))] - received.attitude.utc_s[10]
    else:
        assert received.utc_source.startswith("SYSTEM_TIME")
        shift_s = 0.0
    inside = received.attitude.utc_s + shift_s > truth.attitude.first_s + 2.0
    worst_rad = 0.0
    for utc_s, q in zip(received.attitude.utc_s[inside] + shift_s, received.attitude.q_body_ned[inside], strict=True):
        if truth.attitude.gap_within(utc_s, utc_s) is None:
            worst_rad = max(worst_rad, 2 * float(np.arccos(min(abs(truth.attitude.at(utc_s) @ q), 1.0))))
    assert worst_rad < 0.1 * DEG


def similarity(truth: Flight, received: Flight) -> np.ndarray:
    """Return the |cosine| of half the angle between each attitude of a log and the eleventh of a link."""
    return np.abs(truth.attitude.q_body_ned @ received.attitude.q_body_ned[10])


@needs_logs
@pytest.mark.parametrize("log", [PLANE, ROV], ids=["plane", "rov"])
def test_a_replayed_telemetry_log_gives_its_flight(log: Path) -> None:
    port, truth = free_port(), Config().open_flight(log)
    with (
        Link(Endpoint.parse(f"udpin:127.0.0.1:{port}"), rate_hz=50) as link,
        playing(truth, f"udpout:127.0.0.1:{port}", rate_hz=50, start_s=10.0),
    ):
        received = flown(link, 3.0)

    assert farthest_rad(received.attitude, truth.attitude) < 0.1 * DEG
    assert received.utc_source.startswith("SYSTEM_TIME")


@pytest.mark.skipif(MAVPROXY is None or shutil.which("socat") is None, reason="MAVProxy or socat is not installed")
def test_mavproxy_forwards_to_a_serial_port(tmp_path: Path) -> None:
    truth = Config().open_flight(asset("adelaide.BIN"))
    port, ends = free_port(socket.SOCK_STREAM), [str(tmp_path / end) for end in ("proxy", "ground")]
    with subprocess.Popen(["socat", *(f"pty,raw,echo=0,link={end}" for end in ends)]) as cable:
        try:
            until(lambda: all(Path(end).exists() for end in ends), "the cable")
            words = [str(MAVPROXY), f"--master=tcp:127.0.0.1:{port}", f"--out={ends[0]},57600", "--daemon"]
            words += ["--non-interactive", f"--state-basedir={tmp_path}", "--default-modules=link,signing"]
            with (
                playing(truth, f"tcpin:127.0.0.1:{port}", rate_hz=10, start_s=20.0),
                subprocess.Popen(
                    words,
                    cwd=tmp_path,
                    stdin=subprocess.DEVNULL,
                    stdout=subprocess.DEVNULL,
                    stderr=subprocess.DEVNULL,
                    env=os.environ | {"HOME": str(tmp_path)},
                ) as proxy,
            ):
                try:
                    with Link(Endpoint.parse(f"{ends[1]},57600"), rate_hz=50) as link:
                        # Message requests pass through MAVProxy to the vehicle.
                        until(lambda: link.status().rate_hz > 40, "the rate that was asked for", 60.0)
                        received = flown(link, 2.0)
                finally:
                    proxy.terminate()
        finally:
            cable.terminate()

    assert farthest_rad(received.attitude, truth.attitude) < 0.1 * DEG
    assert received.utc_source.startswith("SYSTEM_TIME")
