"""``glstar camera calibrate --fit-lens``: recovers the lens that exported frames of one camera share."""

import json
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner, Result

from glstar.camera.camerafile import camera_from_file
from glstar.camera.distortion import Lens
from glstar.camera.model import Camera
from glstar.cli import app

HIDDEN = Camera(800, 600, 1000.0, 1000.0, 402.7, 296.4, 0.0, Lens("plumb_bob", (-0.12,)))
SETTINGS = """
[camera]
width_px = 800
height_px = 600
fx_px = 1000.0
fy_px = 1000.0
cx_px = 402.7
cy_px = 296.4
lens = "plumb_bob"
distortion = [-0.12]
[sensor]
reference_peak_dn = 300.0
psf_sigma_px = 1.1
sky_mean_dn = 22.0
sky_std_dn = 3.0
[sky]
vmag_limit = 6.5
"""
# Roll and yaw of the four flights, deg.
ATTITUDES_DEG = ((-4, 70), (25, 130), (-30, 200), (15, 300))
# Refraction shortens the focal length by 280 ppm at the zenith: the site must be known.
SITE = ["--lat", "-34.93", "--lon", "138.60", *(4 * ["--utc", "2024-03-10T11:00:05.25Z"])]


def run(*arguments: str | Path) -> Result:
    return CliRunner().invoke(app, [str(argument) for argument in arguments])


@pytest.fixture(scope="module")
def frames(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    """Return one frame each of four flights without motion, in four directions."""
    directory = tmp_path_factory.mktemp("shared")
    (directory / "camera.toml").write_text(SETTINGS, encoding="utf-8")
    header = "utc_s,roll_deg,pitch_deg,yaw_deg,latitude_deg,longitude_deg"
    images = []
    for roll_deg, yaw_deg in ATTITUDES_DEG:
        rows = [f"{1710068400 + k * 0.1:.1f},{roll_deg},3,{yaw_deg},-34.93,138.60" for k in range(101)]
        (directory / "still.csv").write_text("\n".join([header, *rows]), encoding="utf-8")
        output = directory / f"yaw{yaw_deg}"
        drawn = run(
            *("export", directory / "still.csv", "-o", output, "-c", directory / "camera.toml"),
            *("--start", "5", "--frames", "1", "--exposure", "0.5", "--seed", yaw_deg),
        )
        assert drawn.exit_code == 0, drawn.output
        images.append((output / "frame_000000.png").rename(directory / f"{yaw_deg}.png"))
    return images


def off_px(camera: Camera) -> float:
    """Return the largest distance between the hidden camera's positions and another's, attitudes aligned, px."""
    grid = np.stack(np.meshgrid(np.linspace(0, 799, 17), np.linspace(0, 599, 13)), axis=-1).reshape(-1, 2)
    true, found = HIDDEN.unit_vectors(grid), camera.unit_vectors(grid)
    U, _, Vt = np.linalg.svd(found.T @ true)
    C = U @ np.diag([1.0, 1.0, np.linalg.det(U) * np.linalg.det(Vt)]) @ Vt
    return float(np.linalg.norm(camera.project(true @ C.T) - grid, axis=1).max())


def test_four_rendered_images_give_one_lens_with_smaller_errors(frames, tmp_path, kept_patterns) -> None:
    pytest.importorskip("tetra3rs")

    result = run(
        *("camera", "calibrate", *frames, "--fov", "43", "--exposure", "0.5", "-o", tmp_path / "c.toml", *SITE),
        *("--fit-lens", "--lens", "plumb_bob", "--camera-out", tmp_path / "camera.yaml", "--json"),
    )

    assert result.exit_code == 0, result.output
    found = json.loads(result.stdout)
    lens = found["shared_lens"]
    assert lens["rms_px"] < 0.2
    true = {"fx_px": 1000.0, "cx_px": 402.7, "cy_px": 296.4, "k1": -0.12}
    for name, error in lens["standard_error"].items():
        if name in true:
            assert abs(lens["parameters"][name] - true[name]) < 4 * error
        for image in lens["single_images"]:
            assert error < image["standard_error"][name]
    # Every image has the shared camera, and so has the camera file.
    cameras = {(part["identification"]["fx_px"], part["identification"]["cx_px"]) for part in found["images"]}
    assert len(cameras) == 1
    camera = camera_from_file(tmp_path / "camera.yaml")
    assert camera.fx_px == pytest.approx(lens["parameters"]["fx_px"], abs=1e-3)  # px
    assert off_px(camera) < 0.15
    single_fx = [image["parameters"]["fx_px"] for image in lens["single_images"]]
    assert abs(lens["parameters"]["fx_px"] - 1000.0) < np.sqrt(np.mean((np.array(single_fx) - 1000.0) ** 2)) + 0.02
    assert any("one lens fitted to" in note for note in found["notes"])


def test_a_single_image_has_no_lens_to_share(frames, tmp_path) -> None:
    result = run(
        "camera", "calibrate", frames[0], "--fov", "43", "--exposure", "0.5", "--fit-lens", "-o", tmp_path / "c.toml"
    )

    assert result.exit_code == 1
    assert result.stderr.count("\n") == 1
    assert "--fit-lens needs several images" in result.stderr
