"""Camera files of strangers: what carries the lens is read or named, and decoys beside it are passed over."""

from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from glstar.camera.camerafile import camera_from_file, read_camera_file
from glstar.camera.distortion import Lens
from glstar.camera.model import Camera
from glstar.cli import app
from glstar.errors import CalibrationError
from tests.support import camerafiles
from tests.support.camerafiles import FISHEYE_KEYS, LACKING

D = (0.01, -0.002, 0.0003, -0.00004)
FISHEYE = Camera(1280, 960, 700.5, 701.1, 640.2, 481.3, lens=Lens("fisheye", D))
PLAIN = f"""\
image_width: 1280
image_height: 960
K: [[700.5, 0, 640.2], [0, 701.1, 481.3], [0, 0, 1]]
D: {list(D)}
"""
# What OpenCV's interactive calibration writes.
INTERACTIVE = """\
%YAML:1.0
---
calibrationDate: "Fri Nov 27 20:00:00 2026"
framesCount: 34
cameraResolution: [ 1280, 960 ]
cameraMatrix: !!opencv-matrix
   rows: 3
   cols: 3
   dt: d
   data: [ 700.5, 0., 640.2, 0., 701.1, 481.3, 0., 0., 1. ]
cameraMatrix_std_dev: !!opencv-matrix
   rows: 4
   cols: 1
   dt: d
   data: [ 0.5, 0.5, 0.8, 0.7 ]
dist_coeffs: !!opencv-matrix
   rows: 1
   cols: 5
   dt: d
   data: [ -0.3, 0.1, 0.001, -0.002, 0.01 ]
dist_coeffs_std_dev: !!opencv-matrix
   rows: 5
   cols: 1
   dt: d
   data: [ 0.001, 0.01, 0.0001, 0.0001, 0.03 ]
avg_reprojection_error: 0.31
"""


def read(path: Path, text: str) -> Camera:
    path.write_text(text)
    return camera_from_file(path)


def refusal(path: Path, text: str) -> str:
    with pytest.raises(CalibrationError) as caught:
        read(path, text)
    assert "\n" not in str(caught.value)
    return str(caught.value)


@pytest.mark.parametrize(("key", "value"), FISHEYE_KEYS)
def test_a_fisheye_named_by_any_key_is_a_fisheye(tmp_path: Path, key: str, value: object) -> None:
    assert read(tmp_path / "c.yaml", f"{PLAIN}{key}: {str(value).lower() if value is True else value}\n") == FISHEYE


def test_standard_errors_are_no_coefficients(tmp_path: Path) -> None:
    path = tmp_path / "c.yml"

    assert read(path, INTERACTIVE) == Camera(
        1280, 960, 700.5, 701.1, 640.2, 481.3, lens=Lens("plumb_bob", (-0.3, 0.1, 0.001, -0.002, 0.01))
    )
    shown = CliRunner().invoke(app, ["camera", "show", str(path)])
    assert "note: passed over as standard errors" in shown.stderr
    assert "dist_coeffs_std_dev" in shown.stderr


@pytest.mark.parametrize("key", ["camera_model", "distortion_model", "lens_type", "projection"])
@pytest.mark.parametrize("model", LACKING)
def test_a_model_that_glstar_lacks_is_refused_by_name(tmp_path: Path, key: str, model: str) -> None:
    message = refusal(tmp_path / "sensor.yaml", f"{PLAIN}{key}: {model}\n")

    assert f"has a lens of the model {model} ({key}); glstar knows plumb_bob" in message


@pytest.mark.parametrize(
    ("extra", "words"),
    [
        ("distortion_coefficients: [0.1, 0, 0, 0, 0]\n", "D is (0.01, -0.002, 0.0003, -4e-05) and distortion_coeff"),
        ("radial_distortion: [0.1, 0.2]\n", "has radial_distortion, which glstar does not know and which may carry"),
        ("lens: {k1: 0.1}\n", "has lens, which glstar does not know"),
        ("fisheye_D: [0.1, 0.2]\n", "has fisheye_D, which glstar does not know"),
        ("camera_model: fisheye\ndistortion_model: plumb_bob\n", "camera_model is 'fisheye' and distortion_model is"),
        ("fisheye_model: 0\ndistortion_model: equidistant\n", "distortion_model is 'fisheye' and fisheye_model is"),
        ("distortion_model: none\n", "says that the lens does not distort (none), and has coefficients"),
        ("camera_name: front_fisheye\n", "has camera_name = front_fisheye and no key names the model of the lens"),
        ("k1: 0.02\n", "has k1 = 0.02, and k1 of D is 0.01: they contradict each other"),
        ("k7: 0.02\n", "has k7 = 0.02, and k7 of D is 0"),
        ("xi: 1.2\ndistortion_model: radtan\n", "has xi = 1.2, the mirror of an omnidirectional lens"),
        ("camera_matrix: [600, 0, 300, 0, 600, 200, 0, 0, 1]\n", "they contradict each other"),
        ("resolution: [640, 480]\n", "resolution is 640 and image_width is 1280: they contradict each other"),
        ("K: [600, 0, 300, 0, 600, 200, 0, 0, 1]\n", "the key K occurs twice, with two values"),
        ("roi: {x_offset: 0, y_offset: 60, width: 1280, height: 720}\n", "has roi of 1280 x 720 px at 0, 60"),
        ("---\n" + PLAIN.replace("700.5", "705"), "several documents (---) with different cameras"),
    ],
)
def test_keys_that_contradict_or_may_carry_the_lens_are_named(tmp_path: Path, extra: str, words: str) -> None:
    assert words in refusal(tmp_path / "c.yaml", PLAIN + extra)


def test_a_window_of_the_whole_image_is_none(tmp_path: Path) -> None:
    roi = "roi: {x_offset: 0, y_offset: 0, width: 1280, height: 960}\ndistortion_model: equidistant\n"

    assert read(tmp_path / "c.yaml", PLAIN + roi) == FISHEYE


@pytest.mark.parametrize("scale", [1 / 1280, 0.003])
def test_a_matrix_that_is_not_in_pixels_is_refused(tmp_path: Path, scale: float) -> None:
    K = [[700.5 * scale, 0, 640.2 * scale], [0, 701.1 * scale, 481.3 * scale], [0, 0, 1]]

    message = refusal(tmp_path / "c.yaml", f"image_size: [1280, 960]\nK: {K}\nD: [0, 0, 0, 0, 0]\n")

    assert "they are not in pixels, but normalized or in mm" in message


@pytest.mark.parametrize("numbers", [[0.1], [0.1, 0.2, 0.3], [0.1] * 6, [0.1] * 13])
def test_a_number_of_coefficients_that_no_model_has_is_refused(tmp_path: Path, numbers: list[float]) -> None:
    text = PLAIN.replace(str(list(D)), str(numbers))

    assert f"D holds {len(numbers)} numbers" in refusal(tmp_path / "c.yaml", text)


def test_four_coefficients_that_are_no_plumb_bob_need_a_model(tmp_path: Path) -> None:
    """A fisheye by its numbers would be read as a lens with a tangential distortion that none has."""
    text = "image_width: 1280\nimage_height: 960\nK: [[700, 0, 640], [0, 700, 480], [0, 0, 1]]\n"
    path = tmp_path / "camera.yaml"
    path.write_text(text + "D: [[-0.021], [0.013], [-0.027], [0.0101]]\n")

    with pytest.raises(CalibrationError, match=r"the last two are too large .* add distortion_model: equidistant"):
        camera_from_file(path)
    path.write_text(text + "D: [[-0.021], [0.013], [-0.027], [0.0101]]\ndistortion_model: fisheye\n")
    assert str(camera_from_file(path).lens).startswith("fisheye k1=-0.021")


def test_four_coefficients_without_a_model_are_noted(tmp_path: Path) -> None:
    path = tmp_path / "c.yaml"
    path.write_text(PLAIN)

    read = read_camera_file(path)

    assert read.camera.lens == Lens("plumb_bob", D)
    assert read.notes == (
        "D has four numbers and no key names the model: plumb_bob is assumed; for a fisheye, add distortion_model:"
        " equidistant",
    )


def test_the_second_camera_does_not_take_coefficients_of_the_first(tmp_path: Path) -> None:
    path = tmp_path / "stereo.yaml"
    numbers = "fx: 500\n{0}fy: 500\n{0}cx: 300\n{0}cy: 200\n"
    text = "".join(f"{name}." + numbers.format(f"{name}.") for name in ("Camera", "Camera2"))
    path.write_text(text + "Camera.k1: -0.2\nCamera.width: 640\nCamera.height: 480\n")

    assert camera_from_file(path, "Camera2") == Camera(640, 480, 500, 500, 300, 200)


def test_random_camera_files_are_right_or_refused() -> None:
    verdicts = [camerafiles.verdict(camerafiles.random_case(np.random.default_rng([5, k]))) for k in range(150)]

    assert [verdict for verdict in verdicts if verdict not in ("right", "refused")] == []
    assert verdicts.count("right") > 60


@pytest.mark.parametrize(("lens", "least"), [("", 0.1), ("distortion_model: fisheye\n", 0.03)])
def test_the_least_focal_length_that_is_in_pixels(tmp_path: Path, lens: str, least: float) -> None:
    def text(fx_px: float, fy_px: float) -> str:
        return f"image_size: [1000, 800]\nfx: {fx_px}\nfy: {fy_px}\ncx: 500\ncy: 400\n{lens}"

    # Of the width of 1000 px for fx, of the height of 800 px for fy; one of both may be shorter.
    for fx_px, fy_px in ((1001, 801), (999, 801), (1001, 799)):
        assert read(tmp_path / "c.yaml", text(fx_px * least, fy_px * least)).fx_px == fx_px * least
    assert "not in pixels" in refusal(tmp_path / "c.yaml", text(999 * least, 799 * least))


def test_a_matrix_and_the_same_numbers_by_name_agree_and_keep_the_skew(tmp_path: Path) -> None:
    matrix = "image_size: [1280, 960]\nK: [[700, 1.5, 640], [0, 701, 480], [0, 0, 1]]\n"
    named = "fx: 700\nfy: 701\ncx: 640\ncy: 480\n"
    for text in (matrix, matrix + named, matrix + "fx: 700\n"):
        camera = read(tmp_path / "c.yaml", text)
        assert (camera.fx_px, camera.fy_px, camera.cx_px, camera.cy_px, camera.skew_px) == (700, 701, 640, 480, 1.5)
    assert read(tmp_path / "c.yaml", "image_size: [1280, 960]\n" + named).skew_px == 0
    assert "they contradict each other" in refusal(tmp_path / "c.yaml", matrix + named.replace("701", "702"))
    assert "has no camera matrix" in refusal(
        tmp_path / "c.yaml", "image_size: [1280, 960]\nfx: 700\nfy: 701\ncx: 640\n"
    )
