"""The clock of a simulator alone: faster than the computer's, paused, and set back."""

import json
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner

from glstar.cli import app
from glstar.link.clock import BootClock
from glstar.sky.place.timescale import parse_utc
from tests.support.autopilot import BOOT_S, SMALL, UTC_S, YAW_RATE_RAD_PER_S, angle_rad, lines, simulated, true_yaw_rad
from tests.support.links import free_port, has_frames, interrupted_when


def exported(tmp_path: Path, frames: int, *options: str, **simulator: Any) -> tuple[list[dict], dict, str]:
    """Export frames of 0.1 s every 0.5 s of the vehicle's clock; return their truth, the report and the messages."""
    port, folder, config = free_port(), tmp_path / "frames", tmp_path / "small.toml"
    config.write_text(SMALL)
    words = f"live udpin:127.0.0.1:{port} --truth sim_state --exposure 0.1 --every 0.5 --duration 100 -c {config}"
    words += f" --clock vehicle --json --export {folder}"
    with simulated(port, **simulator), interrupted_when(lambda: has_frames(folder, frames)):
        result = CliRunner().invoke(app, [*words.split(), *options])
    assert result.exit_code == 0, result.output
    return lines(folder / "truth.jsonl"), json.loads(result.stdout), result.stderr


def stops_s(truth: list[dict]) -> np.ndarray:
    """Return when the exposures end by the vehicle's time since boot, s."""
    mid_s = np.array([parse_utc(line["utc_mid"]) for line in truth])
    return mid_s + 0.05 - UTC_S + BOOT_S


def assert_true_attitudes(truth: list[dict]) -> None:
    """Check the attitudes: a state that is read late is off by up to one interval of the attitude, 20 ms."""
    for line in truth:
        assert angle_rad(true_yaw_rad(parse_utc(line["utc_mid"])), line["q_body_ned"]) < 0.02 * YAW_RATE_RAD_PER_S


@pytest.mark.parametrize("speed", [1.0, 10.0])
def test_frames_are_on_the_grid_of_a_fast_simulator_and_late_ones_are_counted(tmp_path: Path, speed: float) -> None:
    truth, report, _ = exported(tmp_path, 12, speed=speed)

    halves = stops_s(truth) / 0.5
    np.testing.assert_allclose(halves, np.round(halves), rtol=0, atol=1e-4)
    steps = np.diff(np.round(halves)).astype(int)
    assert steps.min() >= 1
    assert report["skipped"] == {}
    # Between the first and the last frame, and while the last one was drawn.
    assert 0 <= report["late"] - (steps - 1).sum() <= 20 * speed
    assert_true_attitudes(truth)


def test_utc_counts_by_the_simulation_where_it_states_the_computers_utc(tmp_path: Path) -> None:
    """PX4 at five times real time: UTC was set twice a second, and frames were skipped and dated at random."""
    simulator = {"truth": "HIL_STATE_QUATERNION", "speed": 5.0, "has_computers_utc": True}
    truth, report, messages = exported(tmp_path, 12, **simulator)

    steps = np.diff(stops_s(truth)) / 0.5
    np.testing.assert_allclose(steps, np.round(steps), rtol=0, atol=1e-4)
    assert steps.min() > 0.5
    assert report["skipped"] == {}
    assert "UTC was set" not in messages
    # UTC is that of the first SYSTEM_TIME that was received, and then as far from the time since boot as there.
    behind_s = [
        angle_rad(true_yaw_rad(parse_utc(line["utc_mid"]) - 1.0), line["q_body_ned"]) / YAW_RATE_RAD_PER_S - 1.0
        for line in truth
    ]
    assert np.ptp(behind_s) < 2 * 0.02


def test_a_simulator_that_sets_its_utc_is_followed_and_one_that_drifts_is_not() -> None:
    clock = BootClock(is_vehicle_time=True)

    def read(from_s: float, count: int, utc_minus_boot_s: float, drift: float = 0.0) -> float:
        for number in range(count):
            boot_s = from_s + 0.5 * number
            clock.add_packet(boot_s, boot_s)
            clock.read_utc(boot_s, boot_s + utc_minus_boot_s + drift * 0.5 * number)
        assert clock.utc_minus_boot_s is not None
        return clock.utc_minus_boot_s - UTC_S

    assert read(10.0, 40, UTC_S) == 0.0
    # A computer that is too slow for real time: 4.7 ms/s of a PX4 on a busy one.
    assert read(30.0, 400, UTC_S, drift=0.0047) == pytest.approx(0.0, rel=0, abs=0.025)
    assert read(230.0, 100, UTC_S, drift=-0.8) == pytest.approx(0.0, rel=0, abs=0.025)
    assert read(280.0, 4, UTC_S - 18.0) == pytest.approx(0.0, rel=0, abs=0.025)
    assert read(282.0, 1, UTC_S - 18.0) == -18.0


def test_left_out_exposures_are_reported_when_they_become_more(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("glstar.export.live._LATE_REPORT_S", 0.0)
    _, report, messages = exported(tmp_path, 12, speed=10.0)

    said = [int(count) for count in re.findall(r"exposures left out: (\d+);", messages)]
    assert said == sorted(set(said))
    assert bool(said) == bool(report["late"])


def test_a_pause_of_the_simulator_loses_no_frame(tmp_path: Path) -> None:
    truth, report, messages = exported(tmp_path, 8, speed=1.0, pauses={110: 3.0})

    halves = np.round(stops_s(truth) / 0.5).astype(int)
    assert set(np.diff(halves)) == {1} or report["late"] > 0  # on a busy machine some are late
    assert report["skipped"] == {}
    assert "packets are received again" in messages
    assert_true_attitudes(truth)


def test_a_simulator_that_is_set_back_is_followed(tmp_path: Path) -> None:
    truth, _, messages = exported(tmp_path, 12, speed=2.0, rewinds={250: 150})

    stops = stops_s(truth)
    back = np.flatnonzero(np.diff(stops) < 0)
    assert len(back) == 1
    assert -3.0 <= np.diff(stops)[back[0]] < -1.0
    assert "was set to another time" in messages
    halves = stops / 0.5
    np.testing.assert_allclose(halves, np.round(halves), rtol=0, atol=1e-4)
    assert_true_attitudes(truth)


def test_a_packet_that_was_delayed_for_long_sets_nothing_back() -> None:
    clock = BootClock(is_vehicle_time=True)
    times_s = [10.0, 10.1, 8.0, 10.2, 200.0, 10.3]

    kept = [clock.add_packet(boot_s, 1.0 + 0.01 * number) for number, boot_s in enumerate(times_s)]

    assert kept == [10.0, 10.1, None, 10.2, None, 10.3]
    assert clock.boot == 0


@pytest.mark.parametrize("first_s", [7.0, 500.0])
def test_two_packets_of_another_time_begin_again_and_utc_waits_for_the_simulator(first_s: float) -> None:
    clock = BootClock(is_vehicle_time=True)
    clock.add_packet(10.0, 1.0)
    clock.read_utc(10.0, UTC_S)

    assert clock.add_packet(first_s, 1.01) is None
    assert clock.add_packet(first_s + 0.02, 1.02) == first_s + 0.02

    assert clock.boot == 1
    assert clock.utc_minus_boot_s is None
    clock.read_utc(first_s, UTC_S - 3.0)
    assert clock.utc_minus_boot_s == UTC_S - 3.0 - first_s


def test_time_stands_still_while_a_simulator_is_paused() -> None:
    clock = BootClock(is_vehicle_time=True)
    for number in range(20):
        clock.add_packet(10.0 + number, 1.0 + 0.1 * number)  # ten times as fast
    clock.read_utc(10.0, UTC_S)

    assert clock.now(2.9) == (pytest.approx(UTC_S + 19.0, rel=0, abs=1e-6), pytest.approx(29.0, rel=0, abs=1e-9))
    assert clock.now(60.0) == clock.now(2.9)
    clock.add_packet(29.1, 60.0)
    assert clock.now(60.0)[1] == pytest.approx(29.1, rel=0, abs=1e-9)


def test_the_computers_clock_gives_the_utc_of_the_first_packet_alone() -> None:
    clock = BootClock(is_vehicle_time=True, utc_minus_host_s=1000.0)

    for number in range(5):
        clock.add_packet(10.0 + number, 1.0 + 0.1 * number)

    assert clock.utc_minus_boot_s == pytest.approx(1001.0 - 10.0, rel=0, abs=1e-9)


def test_the_clock_is_for_frames() -> None:
    result = CliRunner().invoke(app, ["live", "udpin:127.0.0.1:1", "--clock", "vehicle"])

    assert result.exit_code == 2
    assert "times frames" in result.output
