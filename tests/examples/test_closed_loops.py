"""The examples that fly: ArduPilot's JSON backend in lock-step, and an aircraft without GNSS."""

import json
import socket
import threading
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

from glstar.rotation import quaternion_from_euler
from glstar.sky.place.timescale import parse_utc
from tests.examples import gnss_denied, json_backend
from tests.support.links import free_port


def lines(path: Path) -> list[dict]:
    return [json.loads(line) for line in path.read_text().splitlines()]


def test_the_json_backend_flies_in_lock_step_with_ten_frames_a_second(tmp_path: Path) -> None:
    words = [str(tmp_path / "out"), "--seconds", "1", "--port", str(free_port()), "--scripted"]

    states, frames = json_backend.main(words)

    assert frames == 11
    times_s = [state["timestamp"] for state in states]
    np.testing.assert_allclose(np.diff(times_s), 0.02, rtol=0, atol=1e-12)
    truth, nav = lines(tmp_path / "out" / "truth.jsonl"), lines(tmp_path / "out" / "nav.jsonl")
    assert [line["file"] for line in truth] == [line["file"] for line in nav]
    assert all((tmp_path / "out" / line["file"]).stat().st_size for line in truth)
    mid_s = np.array([parse_utc(line["utc_mid"]) for line in truth])
    np.testing.assert_allclose(np.diff(mid_s[1:]), 0.1, rtol=0, atol=1e-5)
    # An exposure of a tenth of a second ends at its state, and is between that and the one before in the middle.
    for number, line in enumerate(truth[2:], 2):
        ends = [quaternion_from_euler(*states[5 * one - 1]["attitude"]) for one in (number - 1, number)]
        middle = ends[0] + ends[1] * np.sign(ends[0] @ ends[1])
        assert abs(middle @ line["q_body_ned"]) / np.linalg.norm(middle) > 1 - 1e-9
    # The plane rolls into its turn: gyro and attitude agree.
    rolls = np.array([state["attitude"][0] for state in states])
    assert rolls[-1] > np.deg2rad(15.0)
    for before, after in pairwise(states):
        turn = (after["attitude"][2] - before["attitude"][2]) / 0.02
        rolled = (after["attitude"][0] - before["attitude"][0]) / 0.02
        assert after["imu"]["gyro"][0] == pytest.approx(rolled - turn * np.sin(before["attitude"][1]), rel=0, abs=1e-9)
    # At the start it flies straight and level: the accelerometer has gravity alone.
    np.testing.assert_allclose(states[0]["imu"]["accel_body"], [0.0, 0.0, -9.80665], rtol=0, atol=1e-9)


def test_a_packet_that_is_sent_again_moves_nothing(tmp_path: Path) -> None:
    port, ready = free_port(), threading.Event()
    served: list[tuple[json_backend.Plane, int]] = []
    server = threading.Thread(target=lambda: served.append(json_backend.serve(tmp_path, 0.06, port, ready)))
    server.start()
    assert ready.wait(60)
    replies = []
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as here:
        here.settimeout(60)
        for count in (0, 0, 1, 1, 2):
            here.sendto(json_backend.PACKETS[18458].pack(18458, 50, count, *[1500] * 16), ("127.0.0.1", port))
            replies.append(json.loads(here.recv(4096)))
    server.join()

    assert [reply["timestamp"] for reply in replies] == [0.02, 0.02, 0.04, 0.04, 0.06]
    assert replies[0] == replies[1]
    # 22 m/s to the north.
    np.testing.assert_allclose(replies[-1]["position"], [1.32, 0.0, -500.0], rtol=0, atol=1e-9)
    assert served[0][1] == 1


def test_the_plane_flies_level_until_ardupilot_has_started_and_its_limits_are_those_of_its_gyros() -> None:
    """ArduPlane 4.7.0-dev sends widths of 0 until it has started; they passed for full deflection."""
    plane = json_backend.Plane()
    for _ in range(1200):
        state = plane.step((0,) * 16, 1 / 1200)
    assert state["attitude"] == [0.0, 0.0, 0.0]
    assert state["airspeed"] == 22.0

    for _ in range(2400):
        state = plane.step((1500, 2000, 1500, 1500), 1 / 1200)
    assert state["attitude"][1] == 1.2
    np.testing.assert_allclose(state["imu"]["gyro"], 0.0, rtol=0, atol=1e-9)


@pytest.mark.slow
def test_an_aircraft_without_gnss_finds_its_place_by_the_stars(
    tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    pytest.importorskip("tetra3rs")

    autopilot = gnss_denied.main([str(tmp_path / "out"), "--seconds", "15"])

    assert autopilot.errors_m[0][1] == pytest.approx(20_000.0, rel=0, abs=1.0)
    # The first answers may be late on a busy machine.
    assert len(autopilot.applied) >= 2
    assert autopilot.errors_m[-1][1] < 2_000.0
    assert "0 false" in capfd.readouterr().out
