"""The loop with a simulator: the sky of its true state, the autopilot's estimate in nav.jsonl."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner

from glstar.cli import app
from glstar.rotation import quaternion_from_euler
from glstar.sky.timescale import parse_utc
from tests.e2e.test_link import has_frames, interrupted_when
from tests.support.autopilot import (
    BIAS_RAD,
    ESTIMATED_DEG,
    TRUE_DEG,
    estimated_yaw_rad,
    simulated,
    true_yaw_rad,
)
from tests.support.links import free_port

DEG = np.pi / 180
SMALL = """
[camera]
width_px = 64
height_px = 48
fx_px = 60.0
fy_px = 60.0
[navigator]
gps = "known"
"""


def angle_rad(yaw_rad: float, q_body_ned: list[float]) -> float:
    """Return the angle between an attitude of the script and another one."""
    cosine = abs(float(quaternion_from_euler(0.1, 0.2, yaw_rad) @ np.array(q_body_ned)))
    return float(2 * np.arccos(min(cosine, 1.0)))


def lines(path: Path) -> list[dict[str, Any]]:
    return [json.loads(line) for line in path.read_text().splitlines()]


def test_the_sky_is_the_simulators_and_the_navigator_knows_the_estimate(tmp_path: Path) -> None:
    port, frames, config = free_port(), tmp_path / "frames", tmp_path / "small.toml"
    config.write_text(SMALL)
    words = f"live udpin:127.0.0.1:{port} --truth sim_state --every 0.2 --exposure 0.2 --duration 60 -c {config}"
    with simulated(port), interrupted_when(lambda: has_frames(frames, 6)):
        result = CliRunner().invoke(app, [*words.split(), "--export", str(frames)])
    assert result.exit_code == 0, result.output

    truth, nav = lines(frames / "truth.jsonl"), lines(frames / "nav.jsonl")
    assert [line["frame"] for line in nav] == [line["frame"] for line in truth]
    assert not (frames / "nav.jsonl.partial").exists()
    errors_rad = []
    for drawn, known in zip(truth, nav, strict=True):
        utc_s = parse_utc(drawn["utc_mid"])
        errors_rad.append(angle_rad(true_yaw_rad(utc_s), drawn["q_body_ned"]))
        assert known["schema"] == "glstar-nav-1"
        assert parse_utc(known["utc"]["middle"]) == pytest.approx(utc_s, rel=0, abs=1e-5)
        assert angle_rad(estimated_yaw_rad(utc_s), known["q_body_ned"]["middle"]) < 0.001 * DEG
        # 1 deg of yaw at 0.2 rad of pitch and more: the estimate is not the truth.
        assert angle_rad(true_yaw_rad(utc_s), known["q_body_ned"]["middle"]) > 0.9 * BIAS_RAD
        assert drawn["site"]["latitude_deg"] == pytest.approx(TRUE_DEG[0], rel=0, abs=1e-6)
        assert drawn["site"]["height_m"] == pytest.approx(TRUE_DEG[2], rel=0, abs=1e-6)
        assert known["position"]["latitude_deg"] == pytest.approx(ESTIMATED_DEG[0], rel=0, abs=1e-6)
    # A delayed packet may move one state by up to an interval of 20 ms: 0.1 deg at 5 deg/s.
    assert max(errors_rad) < 0.11 * DEG
    assert np.median(errors_rad) < 0.02 * DEG
    manifest = json.loads((frames / "manifest.json").read_text())
    assert manifest["flight"]["attitude"].startswith("SIM_STATE, ")


def test_a_link_without_a_simulators_state_says_so_in_one_line(tmp_path: Path) -> None:
    port = free_port()
    words = f"live udpin:127.0.0.1:{port} --truth sim_state --duration 1 --export {tmp_path / 'frames'}"
    with simulated(port, None):
        result = CliRunner().invoke(app, words.split())

    assert result.exit_code == 1
    assert "sent no SIM_STATE, HIL_STATE_QUATERNION or SIMSTATE" in result.output.splitlines()[-1]


def test_a_message_of_a_log_is_no_estimate_of_a_link(tmp_path: Path) -> None:
    port, config = free_port(), tmp_path / "att.toml"
    config.write_text('[navigator]\nattitude = "ATT"\n')
    words = f"live udpin:127.0.0.1:{port} --truth sim_state --duration 1 -c {config} --export {tmp_path / 'frames'}"
    result = CliRunner().invoke(app, words.split())

    assert result.exit_code == 1
    assert "navigator.attitude" in result.output
    assert "a message of a log" in result.output
    assert not (tmp_path / "frames" / "manifest.json").exists()
