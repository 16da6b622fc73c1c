"""``glstar camera calibrate`` recovers the camera of frames exported with wide lenses, by pattern only."""

import csv
import json
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner, Result

from glstar.camera.camerafile import camera_from_file
from glstar.camera.distortion import Lens
from glstar.camera.model import Camera
from glstar.cli import app
from glstar.config import Config

SENSOR = """
[sensor]
reference_peak_dn = 500.0
sky_mean_dn = 16.0
sky_std_dn = 2.5
[sky]
vmag_limit = 6.5
"""
SEEN_FROM = ["--utc", "2024-03-10T11:00:05.25Z", "--lat", "-34.93", "--lon", "138.60"]
WIDE = {
    "rational": Camera(
        1000, 750, 720.0, 720.0, 503.4, 371.2, 0.0,
        Lens("rational", (0.30, 0.08, 6e-4, -4e-4, 0.01, 0.62, 0.18, 0.02)),
    ),
    "fisheye": Camera(1000, 750, 600.0, 600.0, 503.4, 371.2, 0.0, Lens("fisheye", (-0.02, 0.003, -0.002, 5e-4))),
    "plumb_bob": Camera(1000, 750, 700.0, 700.0, 503.4, 371.2, 0.0, Lens("plumb_bob", (-0.28, 0.09, 8e-4, -5e-4))),
}  # fmt: skip


def run(*arguments: str | Path) -> Result:
    return CliRunner().invoke(app, [str(argument) for argument in arguments])


def exported(directory: Path, camera: Camera) -> tuple[Path, dict]:
    """Return a frame of a flight without motion, and its truth."""
    names = ("width_px", "height_px", "fx_px", "fy_px", "cx_px", "cy_px")
    assert camera.lens is not None
    lines = [f"{name} = {getattr(camera, name)}" for name in names]
    lines += [f'lens = "{camera.lens.model}"', f"distortion = {list(camera.lens.coefficients)}"]
    (directory / "camera.toml").write_text("\n".join(["[camera]", *lines, SENSOR]), encoding="utf-8")
    rows = [f"{1710068400 + k * 0.1:.1f},-4,3,70,-34.93,138.60" for k in range(101)]
    header = "utc_s,roll_deg,pitch_deg,yaw_deg,latitude_deg,longitude_deg"
    (directory / "still.csv").write_text("\n".join([header, *rows]), encoding="utf-8")
    drawn = run(
        *("export", directory / "still.csv", "-o", directory / "frames", "-c", directory / "camera.toml"),
        *("--start", "5", "--frames", "1", "--exposure", "0.5"),
    )
    assert drawn.exit_code == 0, drawn.output
    truth = json.loads((directory / "frames" / "truth.jsonl").read_text(encoding="utf-8").splitlines()[0])
    return directory / "frames" / "frame_000000.png", truth


def left_to_right_deg(camera: Camera) -> float:
    ends = camera.unit_vectors([[-0.5, camera.cy_px], [camera.width_px - 0.5, camera.cy_px]])
    return float(np.rad2deg(np.arctan2(np.abs(ends[:, 0]), ends[:, 2]).sum()))


@pytest.mark.parametrize("model", WIDE)
def test_the_camera_of_a_wide_lens_is_recovered_to_the_corners(tmp_path, kept_patterns, model) -> None:
    pytest.importorskip("tetra3rs")
    hidden = WIDE[model]
    image, truth = exported(tmp_path, hidden)

    result = run(
        *(
            "camera",
            "calibrate",
            image,
            "--fov",
            f"{1.06 * left_to_right_deg(hidden):.0f}",
            "--exposure",
            "0.5",
            *SEEN_FROM,
        ),
        *("--lens", model, "-o", tmp_path / "calibration.toml", "--camera-out", tmp_path / "camera.yaml", "--json"),
    )

    assert result.exit_code == 0, result.output
    found = json.loads(result.stdout)["identification"]
    camera = camera_from_file(tmp_path / "camera.yaml")
    assert found["method"] == "by their pattern"
    assert camera.lens is not None
    assert camera.lens.model == model
    assert camera.fx_px == pytest.approx(hidden.fx_px, rel=1e-3)
    # Both cameras project every direction to the same pixel, up to the corners of the image.
    grid = np.stack(np.meshgrid(np.linspace(0, 999, 21), np.linspace(0, 749, 16)), axis=-1).reshape(-1, 2)
    icrs = hidden.unit_vectors(grid) @ np.array(truth["C_camera_icrs"])
    off_px = np.linalg.norm(camera.project(icrs @ np.array(found["C_camera_icrs"]).T) - grid, axis=1)
    assert np.median(off_px) < 0.02
    assert off_px.max() < 0.2
    place = {star["star_id"]: (star["centroid_x_px"], star["centroid_y_px"]) for star in truth["stars"]}
    with (tmp_path / "calibration.stars.csv").open(encoding="utf-8", newline="") as file:
        stars = list(csv.DictReader(file))
    alone = [(place[int(star["star_id"])], star) for star in stars if star["blended"] == "0"]
    wrong_px = [np.hypot(x - float(star["x_px"]), y - float(star["y_px"])) for (x, y), star in alone]
    bright = [star["star_id"] for star in truth["stars"] if star["in_frame"] == 1.0 and star["vmag"] < 4.5]
    assert max(wrong_px) < 1.0
    assert np.isin(bright, [int(star["star_id"]) for star in stars]).mean() > 0.95
    assert found["identified"] > 300
    # With barrel distortion stars are narrower and brighter towards the corners; the sensor is that of the axis.
    sensor = Config.load(tmp_path / "calibration.toml").sensor()
    assert sensor.psf_sigma_px == pytest.approx(1.2, rel=0.02)
    assert sensor.peak_dn([3.0], 0.5)[0] == pytest.approx(500.0, rel=0.02)
