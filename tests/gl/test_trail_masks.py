"""Trail masks against images of each star alone, and masks beside the frames of an export."""

import json
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from typer.testing import CliRunner

from glstar.camera.distortion import Lens
from glstar.camera.exposure import Exposure
from glstar.camera.sensor.sensor import Sensor
from glstar.cli import app
from glstar.compare.folders import image_files
from glstar.export.imagefiles.masks import saturated_mask
from glstar.render.opengl import GLRenderer
from glstar.render.scene.scene import Scene
from glstar.render.truth.frame import frame_truth
from glstar.render.truth.mask import mask_threshold_dn, trail_mask
from tests.support.scenes import NIGHT_UTC_S, camera, sky_over_adelaide

SENSOR = Sensor(sky_mean_dn=20.0, sky_std_dn=4.0)
LENS = camera(320, 240, 300.0)
# Its middle, where nothing depends on the place on the image: each star is drawn alone.
NARROW = camera(160, 120, 300.0)


def dominant_star(renderer: GLRenderer, scene: Scene, margin: float) -> tuple[np.ndarray, np.ndarray]:
    """Return which entry of truth is the brightest in each pixel, and whether that is clear, from one image a star."""
    line = json.loads(frame_truth(scene, renderer.render(scene, seed=0), number=0, file="a.png"))
    order = [int(np.flatnonzero(scene.stars.star_id == star["star_id"])[0]) for star in line["stars"]]
    lens = scene.camera
    row, column = np.mgrid[: lens.height_px, : lens.width_px]
    squared = (column - lens.cx_px) ** 2 + (row - lens.cy_px) ** 2
    r2 = scene.sensor.effects.get("lens.vignetting_r2", 0.0)
    # The flat field over the solid angle of the pixels.
    falloff = (1 + r2 * squared / (160**2 + 120**2)) * (1 + squared / 300**2) ** 1.5 if r2 else np.ones(row.shape)
    brightest_dn, second_dn = np.full(row.shape, mask_threshold_dn(scene)), np.full(row.shape, -np.inf)
    entry = np.zeros(row.shape, np.intp)
    for number, index in enumerate(order, 1):
        alone = scene.with_visible(scene.visible == index)
        image_dn = renderer.render(alone, seed=0, light=True).light_dn * falloff
        entry[image_dn > brightest_dn] = number
        second_dn = np.maximum(second_dn, np.minimum(brightest_dn, image_dn))
        brightest_dn = np.maximum(brightest_dn, image_dn)
    return entry, brightest_dn - second_dn > margin * brightest_dn + 0.02


@pytest.mark.parametrize(
    "case",
    [
        "turning",
        "still",
        "lens",
        "rolling",
        "wings",
        "tilted",
        "sprites",
        "vignetting",
        "narrow",
        "elliptical",
        "colours",
    ],
)
def test_each_pixel_belongs_to_the_star_that_is_brightest_there(renderer: GLRenderer, case: str) -> None:
    sensor, lens = SENSOR, LENS if case in {"lens", "tilted", "vignetting"} else NARROW
    if case == "wings":
        sensor = replace(SENSOR, effects={"sensor.psf_wing_fraction": 0.2, "sensor.psf_wing_sigma_px": 4.0})
    if case == "tilted":
        sensor = replace(SENSOR, effects={"sensor.psf_tilt": 0.8, "sensor.psf_colour_growth": 0.3})
    if case == "colours":  # from 0.24 px on: narrower than pixels
        sensor = replace(SENSOR, effects={"sensor.psf_tilt": 0.8, "sensor.psf_colour_growth": 0.3})
    if case == "narrow":
        sensor = replace(SENSOR, psf_sigma_px=0.3, sky_std_dn=0.3)
    if case == "elliptical":
        core = {"sensor.psf_ellipticity": 0.4, "sensor.psf_angle_rad": 0.7}
        sensor = replace(SENSOR, psf_sigma_px=3.0, sky_std_dn=0.3, effects=core)
    if case == "vignetting":
        sensor = replace(SENSOR, effects={"lens.vignetting": "polynomial", "lens.vignetting_r2": -0.6})
    if case == "lens":
        lens = replace(LENS, lens=Lens("plumb_bob", (-0.05, 0.01, 0.0, 0.0)))
    simulator = sky_over_adelaide(
        lens, sensor=sensor, yaw_rate_rad_per_s=0.0 if case in {"still", "narrow", "elliptical"} else 0.3
    )
    readout = {"readout_s": 0.1} if case == "rolling" else {}
    trail = "sprites" if case == "sprites" else "analytic"
    scene = simulator.scene(Exposure(NIGHT_UTC_S + 2.0, 0.3, trail=trail, **readout))

    mask = trail_mask(scene)

    expected, clear = dominant_star(renderer, scene, 0.4 if case == "lens" else 0.02)
    assert np.count_nonzero(expected) > 200
    np.testing.assert_array_equal(mask[clear], expected[clear])
    assert clear.mean() > {"lens": 0.9, "elliptical": 0.97}.get(case, 0.98)


def test_saturated_pixels_are_white(renderer: GLRenderer) -> None:
    scene = sky_over_adelaide(LENS, sensor=SENSOR).scene(Exposure(NIGHT_UTC_S + 2.0, 5.0))
    frame = renderer.render(scene, seed=3)
    mask = saturated_mask(scene, frame)
    assert mask.dtype == np.uint8
    np.testing.assert_array_equal(mask, 255 * (frame.pixels == 255))
    assert mask.any()


def test_an_export_writes_resumes_and_verifies_masks(tmp_path: Path) -> None:
    command = ["export", "-o", str(tmp_path / "a"), "--start", "60", "--frames", "2", "--every", "1", "--masks"]
    assert CliRunner().invoke(app, command).exit_code == 0
    assert json.loads((tmp_path / "a/manifest.json").read_text())["masks"] == ["trails", "saturated"]
    lines = [json.loads(line) for line in (tmp_path / "a/truth.jsonl").read_text().splitlines()]
    path = tmp_path / "a/frame_000001.trails.png"
    before = path.read_bytes()
    mask = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    assert mask.dtype == np.uint16
    assert 0 < mask.max() <= len(lines[1]["stars"])
    # The brightest star's mask lies along its trail.
    row, column = np.nonzero(mask == 1)
    star = lines[1]["stars"][0]
    assert abs(column.mean() - star["centroid_x_px"]) < 3
    assert abs(row.mean() - star["centroid_y_px"]) < 3
    path.unlink()
    assert CliRunner().invoke(app, [*command, "--verify"]).exit_code == 1
    assert CliRunner().invoke(app, command).exit_code == 0
    assert path.read_bytes() == before
    verified = CliRunner().invoke(app, [*command, "--verify"])
    assert verified.exit_code == 0, verified.output
    assert [path.name for path in image_files(tmp_path / "a")] == ["frame_000000.png", "frame_000001.png"]
    refused = CliRunner().invoke(app, command[:-1])
    assert refused.exit_code != 0
    assert "masks" in refused.output + str(refused.exception)
