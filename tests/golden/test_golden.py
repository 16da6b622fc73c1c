"""Regression test against images that were inspected by eye: software OpenGL only, within 1 DN.

``poe golden`` regenerates them.  If one differs, the frame and the difference, times fifty, are written to the
test's temporary directory.
"""

from pathlib import Path

import cv2
import numpy as np
import pytest

from glstar.camera.exposure import Exposure
from glstar.camera.sensor.sensor import Sensor
from glstar.render.opengl import GLRenderer
from tests.support.scenes import NIGHT_UTC_S, camera, sky_over_adelaide

HERE = Path(__file__).parent
TOLERANCE_DN = 1

LENS = camera(320, 240, 260.0)
SCENES = {
    "still": (sky_over_adelaide, {}),
    "yawing": (sky_over_adelaide, {"yaw_rate_rad_per_s": 0.35}),
    "rolling": (sky_over_adelaide, {"roll_rad": -1.2, "roll_rate_rad_per_s": 0.5}),
    "at the horizon": (sky_over_adelaide, {"pitch_rad": -1.3, "pitch_rate_rad_per_s": 0.1}),
    "narrow stars": (sky_over_adelaide, {"sensor": Sensor(psf_sigma_px=0.5), "yaw_rate_rad_per_s": 0.1}),
}


@pytest.fixture(scope="module")
def renderer():
    with GLRenderer.headless() as renderer:
        yield renderer


@pytest.mark.parametrize("name", SCENES)
def test_the_frame_equals_the_inspected_image(renderer, name, request, tmp_path):
    if "llvmpipe" not in renderer.driver:
        pytest.skip(f"golden images are llvmpipe's, and this is {renderer.driver}")
    sky, settings = SCENES[name]
    scene = sky(LENS, **settings).scene(Exposure(NIGHT_UTC_S + 4, 0.5))
    pixels = renderer.render(scene, seed=1).pixels
    golden = HERE / f"{name.replace(' ', '-')}.png"
    if request.config.getoption("--regenerate-golden"):
        cv2.imwrite(str(golden), pixels)
    expected = cv2.imread(str(golden), cv2.IMREAD_UNCHANGED)
    difference = np.abs(pixels.astype(int) - expected)
    if difference.max() > TOLERANCE_DN:
        cv2.imwrite(str(tmp_path / golden.name), pixels)
        cv2.imwrite(str(tmp_path / f"difference-{golden.name}"), np.clip(50 * difference, 0, 255).astype(np.uint8))
    assert difference.max() <= TOLERANCE_DN, f"{(difference > TOLERANCE_DN).sum()} pixels differ; see {tmp_path}"
