"""``glstar camera calibrate`` on frames of a rolling shutter that a turning aircraft took."""

import json
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner, Result

from glstar.cli import app
from glstar.config import Config
from glstar.rotation import turn_from_matrix

FLIGHT = Path(__file__).parents[2] / "assets" / "adelaide.BIN"
CAMERA = """
[camera]
width_px = 676
height_px = 507
fx_px = {focal_px}
fy_px = {focal_px}
[exposure]
readout_s = {readout_s}
readout = "{readout}"
"""
DRAWN = """duration_s = 0.008
[mount]
yaw_deg = -89.7
pitch_deg = 89.8
[sensor]
reference_peak_dn = 4000.0
psf_sigma_px = 1.0
sky_std_dn = 1.5
"""
FOCAL_PX = 645.0
READOUT_S = 0.0869


def run(*arguments: str | Path) -> Result:
    return CliRunner().invoke(app, [str(argument) for argument in arguments])


def drawn(directory: Path, *, readout_s: float = READOUT_S, start_s: float = 19, frames: int = 3) -> list[dict]:
    """Draw frames of the bundled flight, which turns at 12 to 27 deg/s from 19 s on, and return their truth."""
    config = directory / "drawn.toml"
    config.write_text(CAMERA.format(focal_px=FOCAL_PX, readout_s=readout_s, readout="down") + DRAWN, encoding="utf-8")
    frames_of = ("--start", str(start_s), "--every", "18", "--frames", str(frames))
    done = run("export", FLIGHT, "-o", directory / "frames", "-c", config, *frames_of)
    assert done.exit_code == 0, done.output
    return [json.loads(line) for line in (directory / "frames" / "truth.jsonl").read_text().splitlines()]


def calibrated(
    directory: Path, truth: list[dict], *options: str, readout_s: float = 0.0, readout: str = "down"
) -> Result:
    """Calibrate the frames, with a focal length that is 0.8 % off and the mount half a degree."""
    config = directory / "guess.toml"
    config.write_text(CAMERA.format(focal_px=640.0, readout_s=readout_s, readout=readout), encoding="utf-8")
    images = [directory / "frames" / frame["file"] for frame in truth]
    times = [part for frame in truth for part in ("--utc", frame["utc_mid"])]
    several = ("--fit-lens",) if len(truth) > 1 else ()
    where = ("-c", config, "--flight", FLIGHT, "-o", directory / "found.toml")
    return run("camera", "calibrate", *images, *times, *where, "--geometry-only", *several, "--json", *options)


@pytest.fixture(scope="module")
def turning(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, list[dict]]:
    directory = tmp_path_factory.mktemp("turning")
    return directory, drawn(directory)


def check(found: dict, truth: list[dict]) -> None:
    """Compare camera and attitudes with the truth."""
    shared = found["shared_lens"]
    focal_px, error_px = shared["parameters"]["fx_px"], shared["standard_error"]["fx_px"]
    assert error_px < 0.05
    assert focal_px == pytest.approx(FOCAL_PX, rel=0, abs=4 * error_px)
    assert shared["rms_px"] < 0.6
    for image, frame in zip(found["images"], truth, strict=True):
        attitude = np.array(image["identification"]["C_camera_icrs"])
        turn_rad = turn_from_matrix(attitude @ np.array(frame["C_camera_icrs"]).T)
        assert np.linalg.norm(turn_rad) * FOCAL_PX < 0.2  # px: at the middle row


def test_a_known_readout_time_gives_camera_and_attitudes(turning: tuple[Path, list[dict]]) -> None:
    directory, truth = turning
    done = calibrated(directory, truth, readout_s=READOUT_S)
    assert done.exit_code == 0, done.output
    found = json.loads(done.stdout)
    check(found, truth)
    assert any("camera and attitude are those of the middle row" in note for note in found["notes"])


def test_the_readout_time_is_fitted_with_camera_and_attitudes(turning: tuple[Path, list[dict]]) -> None:
    """With the direction of the rows given wrong."""
    directory, truth = turning
    done = calibrated(directory, truth, "--fit-readout", readout="up")
    assert done.exit_code == 0, done.output
    found = json.loads(done.stdout)
    check(found, truth)
    fitted = found["images"][0]["identification"]
    assert fitted["readout_s"] == pytest.approx(READOUT_S, rel=0, abs=4 * fitted["readout_std_s"])
    assert fitted["readout_std_s"] < 0.0005
    assert fitted["readout"] == "down"
    assert fitted["opposite_to_given"]
    exposure = Config.load(directory / "found.toml").exposure
    assert exposure.readout_s == pytest.approx(fitted["readout_s"], rel=0, abs=1e-6)
    assert exposure.readout == "down"


def test_a_global_shutter_has_no_readout_time_within_its_error(tmp_path: Path) -> None:
    truth = drawn(tmp_path, readout_s=0.0, frames=1)
    done = calibrated(tmp_path, truth, "--fit-readout", readout_s=0.03)
    assert done.exit_code == 0, done.output
    fitted = json.loads(done.stdout)["identification"]
    assert fitted["readout_s"] < 4 * fitted["readout_std_s"] < 0.004


def test_too_little_turn_is_refused_with_its_rate(tmp_path: Path) -> None:
    truth = drawn(tmp_path, start_s=0.5, frames=1)
    done = calibrated(tmp_path, truth, "--fit-readout")
    assert done.exit_code == 1
    assert "the aircraft turned at up to 0." in done.stderr
    assert "determine the readout time only to" in done.stderr
    assert "20 ms are needed" in done.stderr
    assert not (tmp_path / "found.toml").exists()


def test_a_readout_time_without_a_flight_is_refused(tmp_path: Path) -> None:
    done = run("camera", "calibrate", tmp_path / "none.png", "--fov", "60", "--fit-readout", "--geometry-only")
    assert done.exit_code == 1
    assert "--fit-readout needs --flight and --utc" in done.stderr
