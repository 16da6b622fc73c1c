"""A camera on a gimbal over a link: the platform's attitude in the truth, against the script that sends it."""

import json
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from typer.testing import CliRunner

from glstar.cli import app
from glstar.flight import AttitudeTrack, Flight, GimbalAttitude, PositionTrack
from glstar.link import Vehicle
from glstar.rotation import conjugate, quaternion_from_euler
from glstar.sky.place.site import Site
from glstar.sky.place.timescale import parse_utc
from tests.support.autopilot import BOOT_S, MAVLINK, UTC_S, SimulatedAutopilot, estimated_yaw_rad
from tests.support.links import free_port, has_frames, interrupted_when

SMALL = """
[camera]
width_px = 64
height_px = 48
fx_px = 60.0
fy_px = 60.0
[mount]
gimbal = "log"
"""
PITCH_RAD, ROLL_RAD = 0.5, 0.03
IN_VEHICLE_FRAME = 32


def yaw_rad(utc_s: float) -> float:
    """Return the yaw of the platform against the heading."""
    return float(-0.4 + 0.15 * (utc_s - UTC_S))


class AutopilotWithGimbal(SimulatedAutopilot):
    """Sends the attitude of a gimbal too, until `silent` is set."""

    def __init__(self, port: int) -> None:
        super().__init__(port, None)
        self.silent = threading.Event()

    def messages(self, step: int, elapsed_s: float) -> Iterator[Any]:
        yield from super().messages(step, elapsed_s)
        if step % 2 == 0 and not self.silent.is_set():
            boot_ms = round((BOOT_S + elapsed_s) * 1000)
            x, y, z, w = Rotation.from_euler(
                "ZYX", [yaw_rad(UTC_S + boot_ms / 1e3 - BOOT_S), PITCH_RAD, ROLL_RAD]
            ).as_quat()
            status = MAVLINK.MAVLink_gimbal_device_attitude_status_message
            yield status(0, 0, boot_ms, IN_VEHICLE_FRAME, [w, x, y, z], 0, 0, 0, 0)


@contextmanager
def sending(autopilot: SimulatedAutopilot) -> Iterator[None]:
    stop = threading.Event()
    thread = threading.Thread(target=autopilot.run, args=(stop,), name="autopilot")
    thread.start()
    try:
        yield
    finally:
        stop.set()
        thread.join()


def live(port: int, config: Path, frames: Path, duration_s: float) -> list[str]:
    words = f"live udpin:127.0.0.1:{port} --every 0.2 --exposure 0.2 --duration {duration_s} -c {config}"
    return [*words.split(), "--export", str(frames)]


def test_the_camera_has_the_attitude_of_the_gimbal_and_no_frame_is_drawn_without_it(tmp_path: Path) -> None:
    port, frames, config = free_port(), tmp_path / "frames", tmp_path / "small.toml"
    config.write_text(SMALL)
    autopilot = AutopilotWithGimbal(port)

    def is_over() -> bool:
        if has_frames(frames, 4):
            autopilot.silent.set()
        asked = {
            int(message.param1)
            for message in autopilot.received
            if message.get_type() == "COMMAND_LONG" and message.param2 > 0
        }
        return autopilot.silent.is_set() and 285 in asked

    with sending(autopilot), interrupted_when(is_over):
        result = CliRunner().invoke(app, live(port, config, frames, 60))
    assert result.exit_code == 0, result.output

    truth = [json.loads(line) for line in (frames / "truth.jsonl").read_text().splitlines()]
    # The one in progress when the gimbal fell silent may still be drawn.
    assert 4 <= len(truth) <= 6
    for line in truth:
        utc_s = parse_utc(line["utc_mid"])
        heading_rad = estimated_yaw_rad(utc_s)
        to_ned = Rotation.from_euler("ZYX", [heading_rad + yaw_rad(utc_s), PITCH_RAD, ROLL_RAD])
        w, x, y, z = line["q_body_ned"]
        assert (Rotation.from_quat([x, y, z, w]) * to_ned).magnitude() < np.deg2rad(0.002)
        aircraft = quaternion_from_euler(0.1, 0.2, heading_rad)
        assert abs(np.dot(line["gimbal"]["q_aircraft_ned"], aircraft)) == pytest.approx(1, rel=0, abs=1e-9)


def test_a_link_without_a_gimbal_says_so_in_one_line(tmp_path: Path) -> None:
    port, frames, config = free_port(), tmp_path / "frames", tmp_path / "small.toml"
    config.write_text(SMALL)
    with sending(SimulatedAutopilot(port, None)):
        result = CliRunner().invoke(app, live(port, config, frames, 1))

    assert result.exit_code == 1
    assert "nothing was drawn: no GIMBAL_DEVICE_ATTITUDE_STATUS" in result.output.splitlines()[-1]


class Wire:
    """Keeps what a vehicle writes."""

    def __init__(self) -> None:
        self.written = b""

    def read(self, timeout_s: float) -> bytes:
        return b""

    def write(self, data: bytes) -> None:
        self.written += data


def test_a_replayed_flight_sends_its_gimbal() -> None:
    utc_s = UTC_S + 0.05 * np.arange(21)
    heading = quaternion_from_euler(np.zeros(21), np.zeros(21), 0.3 + 0.2 * (utc_s - UTC_S))
    platform = quaternion_from_euler(
        np.full(21, ROLL_RAD), np.full(21, PITCH_RAD), np.array([yaw_rad(one) for one in utc_s])
    )
    is_earth = utc_s > UTC_S + 0.5
    flight = Flight(
        AttitudeTrack.from_samples(utc_s, heading),
        PositionTrack.fixed(Site(-0.6, 2.4, 50.0)),
        gimbal=GimbalAttitude(utc_s, platform, is_earth, "MOUNT_STATUS"),
    )
    wire = Wire()
    Vehicle(flight, wire, speed=2.0).run()  # type: ignore[arg-type]

    link = MAVLINK.MAVLink(None)
    sent = [one for one in link.parse_buffer(wire.written) if one.get_type() == "GIMBAL_DEVICE_ATTITUDE_STATUS"]
    # Ten times in the second, of which a busy computer may miss the last.
    assert 7 <= len(sent) <= 11
    assert {message.flags for message in sent} == {64, IN_VEHICLE_FRAME}
    for message in sent:
        at_s = message.time_boot_ms / 1e3
        assert message.flags == (64 if at_s > 0.5 else IN_VEHICLE_FRAME)
        expected = conjugate(quaternion_from_euler(ROLL_RAD, PITCH_RAD, yaw_rad(UTC_S + at_s)))
        assert abs(np.dot(message.q, expected)) == pytest.approx(1, rel=0, abs=1e-6)
