"""Cameras from calibration files and presets."""

from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from typer.testing import CliRunner

from glstar.camera.camerafile import camera_from_file, camera_to_yaml, camera_warnings
from glstar.camera.distortion import Lens
from glstar.camera.model import Camera
from glstar.camera.presets import camera_from_preset, camera_presets
from glstar.cli import app
from glstar.errors import CalibrationError, ConfigError

K = np.array([[967.7425, 0.25, 506.5], [0.0, 961.5, 379.5], [0.0, 0.0, 1.0]])
CAMERA = Camera(1014, 760, 967.7425, 961.5, 506.5, 379.5, 0.25)
NO_SKEW = Camera(1014, 760, 967.7425, 961.5, 506.5, 379.5)

ROS = """\
image_width: 1014
image_height: 760
camera_name: narrow_stereo
camera_matrix:
  rows: 3
  cols: 3
  data: [967.74250, 0.00000, 506.50000, 0.00000, 961.50000, 379.50000, 0.00000, 0.00000, 1.00000]
distortion_model: plumb_bob
distortion_coefficients:
  rows: 1
  cols: 5
  data: [0.000000, 0.000000, 0.000000, 0.000000, 0.000000]
rectification_matrix:
  rows: 3
  cols: 3
  data: [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0]
projection_matrix:
  rows: 3
  cols: 4
  data: [967.7, 0.0, 506.5, 0.0, 0.0, 961.5, 379.5, 0.0, 0.0, 0.0, 1.0, 0.0]
"""

ROS_TOPIC = """\
header:
  stamp:
    sec: 1710068400
    nanosec: 0
  frame_id: camera
height: 760
width: 1014
distortion_model: plumb_bob
d:
- 0.0
- 0.0
- 0.0
- 0.0
- 0.0
k:
- 967.7425
- 0.0
- 506.5
- 0.0
- 961.5
- 379.5
- 0.0
- 0.0
- 1.0
binning_x: 0
binning_y: 0
roi:
  x_offset: 0
  do_rectify: false
---
"""

KALIBR = """\
cam0:
  T_cam_imu:
  - - 0.01779318
    - 0.99967549
    - -0.01822936
    - 0.07008565
  - - -0.9998017
    - 0.01795239
    - 0.00860714
    - -0.01771023
  cam_overlaps: []
  camera_model: pinhole
  distortion_coeffs:
  - 0.0
  - 0.0
  - 0.0
  - 0.0
  distortion_model: radtan
  intrinsics:
  - 967.7425
  - 961.5
  - 506.5
  - 379.5
  resolution:
  - 1014
  - 760
  rostopic: /cam0/image_raw
  timeshift_cam_imu: 1.0e-3
"""


def write(path: Path, text: str) -> Path:
    path.write_text(text, encoding="utf-8")
    return path


def opencv_file(path: Path, distortion: list[float] | None = None, matrix_name: str = "camera_matrix") -> Path:
    """A calibration as OpenCV itself writes it."""
    storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
    storage.write("calibration_time", "Sun 10 Mar 2024 11:00:00")
    storage.write("image_width", 1014)
    storage.write("image_height", 760)
    storage.write(matrix_name, K)
    storage.write("distortion_coefficients", np.array([distortion or [0.0] * 5]).T)
    storage.write("image_points", np.zeros((2, 5, 2), dtype=np.float32))
    storage.release()
    return path


def refusal(path: Path) -> str:
    """Return the one-line message for a file that is refused."""
    with pytest.raises(CalibrationError) as caught:
        camera_from_file(path)
    message = str(caught.value)
    assert message.startswith(f"{path}: ")
    assert caught.value.path == str(path)
    assert "\n" not in message
    return message.removeprefix(f"{path}: ")


# --- what is read -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["calib.yml", "calib.yaml", "calib.json", "calib.xml"])
def test_a_file_that_opencv_writes_is_read(tmp_path: Path, name: str) -> None:
    path = opencv_file(tmp_path / name)

    storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_READ)

    camera = camera_from_file(path)

    assert camera == CAMERA
    np.testing.assert_array_equal(camera.K, storage.getNode("camera_matrix").mat())


@pytest.mark.parametrize("header", ["%YAML:1.0\n---\n", "%YAML 1.2\n---\n", "%YAML:1.0\n", ""])
def test_both_headers_of_opencv_are_read(tmp_path: Path, header: str) -> None:
    written = opencv_file(tmp_path / "written.yml").read_text()
    body = written.split("---\n", 1)[1]
    path = write(tmp_path / "calib.yml", "")
    path.write_text(header + body)

    assert camera_from_file(path) == CAMERA


@pytest.mark.parametrize("matrix_name", ["cameraMatrix", "Camera_Matrix", "K", "intrinsic_matrix", "mtx"])
def test_the_common_names_of_the_camera_matrix_are_read(tmp_path: Path, matrix_name: str) -> None:
    assert camera_from_file(opencv_file(tmp_path / "calib.yml", matrix_name=matrix_name)) == CAMERA


@pytest.mark.parametrize("text", [ROS, ROS_TOPIC], ids=["camera_info file", "topic echo"])
def test_a_ros_camera_info_is_read(tmp_path: Path, text: str) -> None:
    assert camera_from_file(write(tmp_path / "ost.yaml", text)) == NO_SKEW


def test_a_ros_camera_info_agrees_with_what_opencv_reads(tmp_path: Path) -> None:
    path = write(tmp_path / "ost.yaml", ROS)
    storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_READ)
    data = storage.getNode("camera_matrix").getNode("data")

    expected = [data.at(i).real() for i in range(9)]

    np.testing.assert_array_equal(camera_from_file(path).K.ravel(), expected)


def test_a_kalibr_camchain_with_block_lists_is_read(tmp_path: Path) -> None:
    assert camera_from_file(write(tmp_path / "camchain.yaml", KALIBR)) == NO_SKEW


def test_a_matrix_may_be_three_rows(tmp_path: Path) -> None:
    text = "image_size: [1014, 760]\nK:\n- [967.7425, 0.25, 506.5]\n- [0, 961.5, 379.5]\n- [0, 0, 1]\n"

    assert camera_from_file(write(tmp_path / "calib.yaml", text)) == CAMERA


def test_a_number_with_an_exponent_and_no_decimal_point_is_read(tmp_path: Path) -> None:
    text = ROS.replace("967.74250", "9677425e-4")

    assert camera_from_file(write(tmp_path / "ost.yaml", text)) == NO_SKEW


def test_a_byte_order_mark_and_windows_line_ends_are_accepted(tmp_path: Path) -> None:
    path = tmp_path / "ost.yaml"
    path.write_bytes(b"\xef\xbb\xbf" + ROS.replace("\n", "\r\n").encode())

    assert camera_from_file(path) == NO_SKEW


@pytest.mark.parametrize("model", ["plumb_bob", "rational_polynomial", "radtan", "none", '""'])
def test_a_model_whose_coefficients_are_zero_is_no_distortion(tmp_path: Path, model: str) -> None:
    assert camera_from_file(write(tmp_path / "ost.yaml", ROS.replace("plumb_bob", model))) == NO_SKEW


def test_a_file_without_distortion_is_a_pinhole(tmp_path: Path) -> None:
    text = "image_width: 1014\nimage_height: 760\nK: [967.7425, 0, 506.5, 0, 961.5, 379.5, 0, 0, 1]\nD: []\n"

    assert camera_from_file(write(tmp_path / "calib.yaml", text)) == NO_SKEW


def test_the_principal_point_is_not_shifted_because_all_dialects_count_from_pixel_centres(tmp_path: Path) -> None:
    # The centre of the top-left pixel projects onto (0, 0) in OpenCV and in glstar.
    camera = camera_from_file(opencv_file(tmp_path / "calib.yml"))
    ray = np.linalg.solve(K, [0.0, 0.0, 1.0])

    np.testing.assert_allclose(camera.project(ray), [0.0, 0.0], rtol=0, atol=1e-9)


# --- lenses -----------------------------------------------------------------------------------------------------------

NO_DISTORTION = "[0.000000, 0.000000, 0.000000, 0.000000, 0.000000]"


def test_a_lens_of_ros_is_read(tmp_path: Path) -> None:
    path = write(tmp_path / "ost.yaml", ROS.replace(NO_DISTORTION, "[-0.123, 0.04, 0.0, 0.001, 0.0]"))

    assert camera_from_file(path).lens == Lens("plumb_bob", (-0.123, 0.04, 0.0, 0.001, 0.0))


def test_a_rational_lens_of_ros_is_read(tmp_path: Path) -> None:
    text = ROS.replace(NO_DISTORTION, "[0.3, 0.1, 0.001, -0.002, 0.02, 0.6, 0.2, 0.03]")
    path = write(tmp_path / "ost.yaml", text.replace("plumb_bob", "rational_polynomial"))

    assert camera_from_file(path).lens == Lens("rational", (0.3, 0.1, 0.001, -0.002, 0.02, 0.6, 0.2, 0.03))


@pytest.mark.parametrize(("count", "model"), [(4, "plumb_bob"), (5, "plumb_bob"), (8, "rational"), (14, "rational")])
def test_the_number_of_coefficients_in_an_opencv_file_determines_the_lens_model(
    tmp_path: Path, count: int, model
) -> None:
    coefficients = [0.01] * count

    lens = camera_from_file(opencv_file(tmp_path / "calib.yml", distortion=coefficients)).lens

    assert lens == Lens(model, tuple(coefficients))


def test_a_lens_of_kalibr_is_read(tmp_path: Path) -> None:
    text = KALIBR.replace("distortion_coeffs:\n  - 0.0", "distortion_coeffs:\n  - 1e-3")

    assert camera_from_file(write(tmp_path / "camchain.yaml", text)).lens == Lens("plumb_bob", (1e-3, 0.0, 0.0, 0.0))


def test_a_fisheye_with_zero_coefficients_is_still_a_fisheye(tmp_path: Path) -> None:
    path = write(tmp_path / "camchain.yaml", KALIBR.replace("radtan", "equidistant"))

    assert camera_from_file(path).lens == Lens("fisheye", (0.0,) * 4)


def test_the_fisheye_key_of_an_opencv_file_is_read(tmp_path: Path) -> None:
    path = opencv_file(tmp_path / "calib.yml", distortion=[0.01, 0.0, 0.0, 0.0])
    path.write_text(path.read_text() + "fisheye_model: 1\n")

    assert camera_from_file(path).lens == Lens("fisheye", (0.01, 0.0, 0.0, 0.0))


@pytest.mark.parametrize(
    "lens",
    [
        None,
        Lens("plumb_bob", (-0.28, 0.07, 1e-5, -7.123456789012345e-4, 0.01)),
        Lens("rational", (0.3, 0.1, 1e-3, -2e-3, 0.02, 0.6, 0.2, 0.03)),
        Lens("rational", tuple(0.001 * k for k in range(1, 15))),
        Lens("fisheye", (-0.02, 0.003, -1e-3, 2e-4)),
        Lens("omni", (1.25, -0.1, 0.02, 1e-3, -2e-3)),
        Lens("double_sphere", (-0.172, 0.593)),
        Lens("eucm", (0.58, 1.08)),
        Lens("fisheye", (-0.02, 0.003, 0.0, 0.0), float(np.deg2rad(95.0))),
    ],
    ids=str,
)
def test_a_camera_that_is_written_is_read_back_as_it_was(tmp_path: Path, lens: Lens | None) -> None:
    camera = Camera(1014, 760, 967.7425, 961.5, 506.5, 379.1234567890123, 0.25, lens)
    path = write(tmp_path / "camera.yaml", camera_to_yaml(camera, "from 12 boards", "rms 0.1 px"))

    assert camera_from_file(path) == camera
    assert path.read_text().startswith("# from 12 boards\n# rms 0.1 px\nimage_width: 1014\n")


def test_a_camera_that_is_written_is_read_by_opencv(tmp_path: Path) -> None:
    lens = Lens("plumb_bob", (-0.28, 0.07, 1e-5, -7e-4, 0.01))
    camera = Camera(1014, 760, 967.7425, 961.5, 506.5, 379.5, lens=lens)
    storage = cv2.FileStorage(str(write(tmp_path / "c.yaml", camera_to_yaml(camera, "a"))), cv2.FILE_STORAGE_READ)
    K, D = (storage.getNode(name).getNode("data") for name in ("camera_matrix", "distortion_coefficients"))

    assert [K.at(k).real() for k in range(9)] == camera.K.ravel().tolist()
    assert tuple(D.at(k).real() for k in range(5)) == lens.coefficients


# --- what is refused --------------------------------------------------------------------------------------------------


def test_a_lens_of_an_unknown_model_is_refused_with_its_name(tmp_path: Path) -> None:
    path = write(tmp_path / "camchain.yaml", KALIBR.replace("radtan", "fov"))

    assert refusal(path) == (
        "has a lens of the model fov (cam0.distortion_model); glstar knows plumb_bob (radtan), rational_polynomial,"
        " fisheye (equidistant), omni, double_sphere (ds) and eucm: calibrate with one of these, or rectify the images"
    )


def test_too_many_coefficients_are_refused(tmp_path: Path) -> None:
    path = opencv_file(tmp_path / "calib.yml", distortion=[0.01] * 15)

    assert refusal(path).startswith("15 distortion coefficients are too many for rational: k1, k2, p1")


def test_a_file_without_image_size_says_how_to_give_it(tmp_path: Path) -> None:
    path = write(tmp_path / "ost.yaml", ROS.replace("image_width: 1014\n", "\n"))

    message = refusal(path)

    assert "image_width:" in message
    assert "image_height:" in message
    assert "resolution: [width, height]" in message


def test_a_camchain_without_resolution_says_how_to_give_it(tmp_path: Path) -> None:
    path = write(tmp_path / "camchain.yaml", KALIBR.replace("  resolution:\n  - 1014\n  - 760\n", ""))

    assert "resolution: [width, height]" in refusal(path)


@pytest.mark.parametrize(
    ("model", "missing"), [("omni", "has no xi;"), ("eucm", "has no alpha and beta;"), ("ds", "has no xi and alpha;")]
)
def test_a_camchain_of_a_wide_lens_without_its_coefficients_is_refused(
    tmp_path: Path, model: str, missing: str
) -> None:
    path = write(tmp_path / "camchain.yaml", KALIBR.replace("pinhole", model))

    assert missing in refusal(path)


def test_a_camchain_of_two_cameras_is_refused_without_a_name(tmp_path: Path) -> None:
    path = write(tmp_path / "camchain.yaml", KALIBR + KALIBR.replace("cam0", "cam1"))

    assert "holds 2 cameras (cam0, cam1)" in refusal(path)


@pytest.mark.parametrize(
    ("matrix", "words"),
    [
        ("[0, 0, 506.5, 0, 961.5, 379.5, 0, 0, 1]", "fx_px = 0.0; a focal length is a positive number"),
        ("[967.7, 0, 506.5, 0, -961.5, 379.5, 0, 0, 1]", "fy_px = -961.5; a focal length is a positive number"),
        ("[967.7, 0, 506.5, 0, 961.5, 379.5, 0, 0, 2]", "a camera matrix is [fx skew cx; 0 fy cy; 0 0 1]"),
        ("[967.7, 0, 506.5, 3, 961.5, 379.5, 0, 0, 1]", "a camera matrix is [fx skew cx; 0 fy cy; 0 0 1]"),
        ("[967.7, 0, 0, 0, 961.5, 0, 506.5, 379.5, 1]", "a camera matrix is [fx skew cx; 0 fy cy; 0 0 1]"),
        ("[967.7, 0, .nan, 0, 961.5, 379.5, 0, 0, 1]", "K holds nan; it must be a finite number"),
        ("[967.7, 0, .Nan, 0, 961.5, 379.5, 0, 0, 1]", "K holds nan; it must be a finite number"),
        ("[967.7, 0, -.Inf, 0, 961.5, 379.5, 0, 0, 1]", "K holds -inf; it must be a finite number"),
        ("[967.7, 0, 506.5, 0, 961.5, 379.5]", "K holds 6 numbers; a camera matrix has 9"),
        ("{rows: 2, cols: 3, data: [1, 0, 0, 0, 1, 0]}", "K is 2 x 3"),
        ("{rows: 3, cols: 3}", "K has no data"),
        ("{rows: 3, cols: 3, data: 5}", "K.data must be a list of numbers, not 5"),
        ("[967.7, 0, wide, 0, 961.5, 379.5, 0, 0, 1]", "K must be a number, not 'wide'"),
        ("[967.7, 0, true, 0, 961.5, 379.5, 0, 0, 1]", "K must be a number, not True"),
        ("~", "K must be a list of numbers, not None"),
        ("[9" + "0" * 400 + ", 0, 5, 0, 961.5, 379.5, 0, 0, 1]", "K must be a number, not 9000"),
    ],
)
def test_a_bad_camera_matrix_is_refused(tmp_path: Path, matrix: str, words: str) -> None:
    path = write(tmp_path / "calib.yaml", f"image_width: 1014\nimage_height: 760\nK: {matrix}\n")

    assert words in refusal(path)


@pytest.mark.parametrize("width", ["0", "-3", "10.5"])
def test_a_width_that_is_not_a_positive_integer_is_refused(tmp_path: Path, width: str) -> None:
    path = write(tmp_path / "ost.yaml", ROS.replace("image_width: 1014", f"image_width: {width}"))

    assert f"image_width is {width}; the size of an image is an integer of 1 or more" in refusal(path)


def test_camera_info_with_binning_is_refused(tmp_path: Path) -> None:
    path = write(tmp_path / "echo.yaml", ROS_TOPIC.replace("binning_x: 0", "binning_x: 2"))

    assert "has binning_x = 2" in refusal(path)


def test_a_file_without_camera_matrix_says_what_is_read(tmp_path: Path) -> None:
    path = write(tmp_path / "camera.yaml", "fx: 1\nfy: 2\n")

    message = refusal(path)

    assert message.endswith("and here its first key is fx")
    assert "Kalibr" in message


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (b"", "is empty"),
        (b"  \n\n", "is empty"),
        (b"%YAML:1.0\n---\n", "is empty"),
        (b"# nothing here\n", "is empty"),
        (b"\x89PNG\r\n\x1a\n\x00\x00", "is not UTF-8 text (byte 0x89 at offset 0)"),
        (b"image_width: \x00\x01", "is not YAML: the character at position 13 is not allowed in text"),
        (b"K: [1, 2\nimage_width: 3", "is not YAML: line 2, column"),
        (b"a: b: c\n", "is not YAML: line 1, column 5"),
        (b"just words", "holds no keys and values, but text"),
        (b"- 1\n- 2\n", "holds no keys and values, but a list"),
        (b"<?xml version='1.0'?>\n<opencv_storage/>", "is empty"),
        (b"<?xml version='1.0'?>\n<calibration><f>9</f></calibration>", "is XML of another program than OpenCV"),
        (b"<opencv_storage><K>", "is XML that cannot be read"),
        (b"<opencv_storage>%s%s</opencv_storage>" % (5000 * b"<K>", 5000 * b"</K>"), "is nested too deeply"),
        (b"image_width: 9\nimage_height: 9\nK: &a {rows: 3, cols: 3, data: *a}", "is nested too deeply"),
        (b"image_width: 9\nK: " + 20_000 * b"[", "is not YAML: line 2, column 69: nested too deeply"),
        (b"K: &a {fx: 1, fy: 2, cx: 3, cy: 4, K: *a}", "is nested too deeply"),
        (b"<?xml version='1.0'?><!DOCTYPE a [<!ENTITY a 'b'>]><opencv_storage/>", "document type"),
        (b"1 OPENCV 752 480 458.6 457.3 367.2 248.4 -0.28 0.07 0 0", "is a list of cameras by COLMAP"),
        (b"K: !!python/object/apply:os.system [true]", "is not YAML: line 1, column 4: could not determine"),
        (b"a: &a {b: 1}\nK: {<<: *a}\n", "merge keys (<<) are not read"),
        (b"[" * 5000, "is not YAML"),
        (b"a: 2024-13-45\n", "has no camera matrix"),
        (b"<opencv_storage><K>1</K><K>2</K></opencv_storage>", "the key K occurs twice, with two values"),
        (b"cam0: 3\n", "cam0 holds no keys and values, but one value"),
        (b"cam0: {camera_model: pinhole}\n", "cam0 has no intrinsics"),
        (b"cam0: {intrinsics: [1, 2], resolution: [3, 4]}\n", "cam0.intrinsics holds 2 numbers"),
    ],
)
def test_a_file_that_is_no_calibration_is_refused_in_one_line(tmp_path: Path, content: bytes, words: str) -> None:
    path = tmp_path / "calib.yaml"
    path.write_bytes(content)

    assert words in refusal(path)


@pytest.mark.parametrize("width", ["01014", "+1014", "1014.0", "1.014e3", "'1014'"])
def test_a_number_of_a_camera_file_is_decimal(tmp_path: Path, width: str) -> None:
    path = write(tmp_path / "ost.yaml", ROS.replace("image_width: 1014", f"image_width: {width}"))

    assert camera_from_file(path).width_px == 1014


@pytest.mark.parametrize("width", ["16:54", "0x3F6", "0b1111110110"])
def test_a_number_that_is_not_decimal_is_refused(tmp_path: Path, width: str) -> None:
    path = write(tmp_path / "ost.yaml", ROS.replace("image_width: 1014", f"image_width: {width}"))

    assert refusal(path) == f"image_width must be a number, not '{width}'"


@pytest.mark.parametrize("remark", ["serial: 0012345", "calibration_time: 12:30:00", "date: 2024-13-45"])
def test_numbers_of_other_keys_are_text(tmp_path: Path, remark: str) -> None:
    assert camera_from_file(write(tmp_path / "ost.yaml", f"{ROS}\n{remark}\n")).width_px == 1014


def test_a_missing_file_is_refused(tmp_path: Path) -> None:
    assert refusal(tmp_path / "calib.yaml") == "there is no such file"


def test_a_directory_is_refused(tmp_path: Path) -> None:
    assert refusal(tmp_path) == "this is a directory; give a file"


def test_a_file_as_large_as_a_flight_log_is_not_read(tmp_path: Path) -> None:
    path = tmp_path / "flight.yaml"
    with path.open("wb") as file:
        file.truncate(2**30)

    assert "is larger than" in refusal(path)


def test_a_billion_laughs_attack_is_refused_in_a_short_message(tmp_path: Path) -> None:
    lines = ["a: &a [ha, ha, ha, ha, ha, ha, ha, ha, ha]"]
    lines += [f"{b}: &{b} [{', '.join([f'*{a}'] * 9)}]" for a, b in zip("abcdefgh", "bcdefghi", strict=True)]
    path = write(tmp_path / "calib.yaml", "\n".join([*lines, "K: *i", "image_size: [*i, *i]"]))

    assert len(refusal(path)) < 400


@settings(suppress_health_check=[HealthCheck.function_scoped_fixture], deadline=None)
@given(at=st.integers(0, 600), new=st.binary(max_size=8), text=st.sampled_from([ROS, ROS_TOPIC, KALIBR]))
def test_a_damaged_file_gives_a_camera_or_a_one_line_error(tmp_path: Path, at: int, new: bytes, text: str) -> None:
    whole = text.encode()
    path = tmp_path / "calib.yaml"
    path.write_bytes(whole[:at] + new + whole[at + len(new) :])

    try:
        camera_from_file(path)
    except CalibrationError as error:
        assert "\n" not in str(error)  # noqa: PT017


# --- presets ----------------------------------------------------------------------------------------------------------


def test_the_hq_camera_with_its_six_millimetre_lens() -> None:
    assert camera_from_preset("picamhq-6mm") == Camera(4056, 3040, 3870.97, 3870.97, 2027.5, 1519.5)


def test_binning_keeps_the_field_of_view_and_the_centre() -> None:
    full, binned = camera_from_preset("picamhq-6mm"), camera_from_preset("picamhq-6mm-binned4")

    assert binned == Camera(1014, 760, 967.7425, 967.7425, 506.5, 379.5)
    assert binned.field_radius_rad == pytest.approx(full.field_radius_rad, rel=1e-12)


def test_a_binned_pixel_is_at_the_centre_of_its_four_by_four_pixels() -> None:
    full, binned = camera_from_preset("picamhq-6mm"), camera_from_preset("picamhq-6mm-binned4")
    # The middle of the pixels 0, 1, 2, 3 lies at 1.5.
    ray = np.linalg.solve(full.K, [1.5, 1.5, 1.0])

    np.testing.assert_allclose(binned.project(ray), [0.0, 0.0], rtol=0, atol=1e-9)


@pytest.mark.parametrize(
    ("name", "focal_mm", "pixel_um"), [("picamhq-6mm", 6.0, 1.55), ("picamhq-16mm", 16.0, 1.55), ("picam2", 3.04, 1.12)]
)
def test_a_focal_length_in_pixels_is_that_in_millimetres_over_the_pixel_pitch(
    name: str, focal_mm: float, pixel_um: float
) -> None:
    assert camera_from_preset(name).fx_px == pytest.approx(focal_mm / pixel_um * 1e3, abs=0.005)


def test_the_camera_module_2_has_the_field_of_view_of_its_data_sheet() -> None:
    camera = camera_from_preset("picam2")

    assert np.rad2deg(2 * np.arctan(camera.width_px / 2 / camera.fx_px)) == pytest.approx(62.2, abs=0.1)
    assert np.rad2deg(2 * np.arctan(camera.height_px / 2 / camera.fy_px)) == pytest.approx(48.8, abs=0.1)


def test_each_preset_is_a_camera_with_a_description() -> None:
    for name, description in camera_presets().items():
        assert camera_from_preset(name).width_px > 0
        assert description
        assert "\n" not in description


def test_the_message_for_an_unknown_preset_has_the_closest_name_and_all_names() -> None:
    with pytest.raises(
        ConfigError, match=r'no camera "picamhq-6m" \(did you mean "picamhq-6mm"\? There are .*picam2'
    ) as caught:
        camera_from_preset("picamhq-6m")

    assert caught.value.key == "camera.preset"


def test_the_message_for_a_preset_without_a_close_name_has_all_names() -> None:
    with pytest.raises(ConfigError, match=r'no camera "hubble" \(there are picamhq-6mm, '):
        camera_from_preset("hubble")


# --- files of other programs ------------------------------------------------------------------------------------------

# EuRoC MAV data set, mav0/cam0/sensor.yaml.
EUROC = """
sensor_type: camera
comment: VI-Sensor cam0 (MT9M034)
T_BS:
  cols: 4
  rows: 4
  data: [0.0148655429818, -0.999880929698, 0.00414029679422, -0.0216401454975,
         0.999557249008, 0.0149672133247, 0.025715529948, -0.064676986768,
        -0.0257744366974, 0.00375618835797, 0.999660727178, 0.00981073058949,
         0.0, 0.0, 0.0, 1.0]
rate_hz: 20
resolution: [752, 480]
camera_model: pinhole
intrinsics: [458.654, 457.296, 367.215, 248.375] #fu, fv, cu, cv
distortion_model: radial-tangential
distortion_coefficients: [-0.28340811, 0.07395907, 0.00019359, 1.76187114e-05]
"""
VINS = """%YAML:1.0
---
model_type: PINHOLE
camera_name: camera
image_width: 752
image_height: 480
distortion_parameters:
   k1: -0.28340811
   k2: 0.07395907
   p1: 0.00019359
   p2: 1.76187114e-05
projection_parameters:
   fx: 458.654
   fy: 457.296
   cx: 367.215
   cy: 248.375
"""
VINS_FISHEYE = """%YAML:1.0
---
model_type: KANNALA_BRANDT
camera_name: camera
image_width: 752
image_height: 480
projection_parameters:
   k2: -0.02
   k3: 0.003
   k4: -0.002
   k5: 0.0005
   mu: 380.5
   mv: 380.25
   u0: 370.0
   v0: 250.0
"""
ORB_SLAM2 = """%YAML:1.0
Camera.fx: 458.654
Camera.fy: 457.296
Camera.cx: 367.215
Camera.cy: 248.375

Camera.k1: -0.28340811
Camera.k2: 0.07395907
Camera.p1: 0.00019359
Camera.p2: 1.76187114e-05

Camera.width: 752
Camera.height: 480
Camera.fps: 20.0
ORBextractor.nFeatures: 1200
"""
ORB_SLAM3 = """%YAML:1.0
File.version: "1.0"
Camera.type: "KannalaBrandt8"
Camera1.fx: 380.5
Camera1.fy: 380.25
Camera1.cx: 370.0
Camera1.cy: 250.0
Camera1.k1: -0.02
Camera1.k2: 0.003
Camera1.k3: -0.002
Camera1.k4: 0.0005
Camera.width: 752
Camera.height: 480
"""
RADTAN_CAMERA = Camera(
    752, 480, 458.654, 457.296, 367.215, 248.375, 0.0,
    Lens("plumb_bob", (-0.28340811, 0.07395907, 0.00019359, 1.76187114e-05)),
)  # fmt: skip
FISHEYE_CAMERA = Camera(752, 480, 380.5, 380.25, 370.0, 250.0, 0.0, Lens("fisheye", (-0.02, 0.003, -0.002, 0.0005)))


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        (EUROC, RADTAN_CAMERA),
        (VINS, RADTAN_CAMERA),
        (ORB_SLAM2, RADTAN_CAMERA),
        (VINS_FISHEYE, FISHEYE_CAMERA),
        (ORB_SLAM3, FISHEYE_CAMERA),
    ],
    ids=["EuRoC", "VINS-Fusion", "ORB-SLAM2", "VINS-Fusion fisheye", "ORB-SLAM3 fisheye"],
)
def test_camera_files_of_other_programs_are_read(tmp_path: Path, text: str, expected: Camera) -> None:
    camera = camera_from_file(write(tmp_path / "sensor.yaml", text))

    np.testing.assert_array_equal(camera.K, expected.K)
    assert camera.lens is not None
    assert expected.lens is not None
    assert camera.lens.model == expected.lens.model
    assert [k for k in camera.lens.coefficients if k] == list(expected.lens.coefficients)
    grid = np.stack(np.meshgrid(np.linspace(0, 751, 5), np.linspace(0, 479, 5)), axis=-1)
    np.testing.assert_allclose(camera.unit_vectors(grid), expected.unit_vectors(grid), rtol=0, atol=1e-12)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        (VINS.replace("PINHOLE", "SCARAMUZZA"), "has a lens of the model SCARAMUZZA (model_type); glstar knows plumb"),
        (VINS.replace("PINHOLE", "MEI"), "has no xi; a lens of the model omni has xi, k1, k2, p1, p2"),
        (VINS.replace("   fy: 457.296\n", ""), "has no fy; a camera has fx, fy, cx and cy"),
        (ORB_SLAM2.replace("Camera.cx: 367.215\n", ""), "has no cx; a camera has fx, fy, cx and cy"),
        (ORB_SLAM2.replace("Camera.width: 752\n", ""), "does not give the image size"),
        (VINS.replace("458.654", "wide"), "projection_parameters.fx must be a number, not 'wide'"),
        ("projection_parameters: 3\nimage_width: 3\n", "projection_parameters holds no keys and values, but one value"),
    ],
)
def test_a_faulty_file_of_another_program_is_refused(tmp_path: Path, text: str, words: str) -> None:
    assert words in refusal(write(tmp_path / "sensor.yaml", text))


def test_one_camera_of_several_is_chosen_by_name(tmp_path: Path) -> None:
    second = KALIBR.replace("cam0", "cam1").replace("1014", "1000")
    path = write(tmp_path / "camchain.yaml", KALIBR + second)

    assert camera_from_file(path, "cam1").width_px == 1000
    assert camera_from_file(path, "cam0").width_px == 1014
    with pytest.raises(CalibrationError, match="holds cam0, cam1, and no camera named cam2"):
        camera_from_file(path, "cam2")
    stereo = ORB_SLAM3 + ORB_SLAM3[ORB_SLAM3.index("Camera1.fx") :].replace("Camera1", "Camera2").replace(
        "380.5", "381"
    )
    stereo = "\n".join(dict.fromkeys(stereo.splitlines()))
    path = write(tmp_path / "stereo.yaml", stereo)
    assert camera_from_file(path, "Camera2").fx_px == 381
    assert "holds 2 cameras (Camera1, Camera2)" in refusal(path)
    with pytest.raises(CalibrationError, match="holds one camera, and none named cam1"):
        camera_from_file(write(tmp_path / "one.yaml", EUROC), "cam1")


def test_the_command_line_writes_the_chosen_camera_as_a_file_of_its_own(tmp_path: Path) -> None:
    chain = write(tmp_path / "camchain.yaml", KALIBR + KALIBR.replace("cam0", "cam1").replace("1014", "1000"))

    result = CliRunner().invoke(
        app, ["camera", "show", str(chain), "--camera", "cam1", "-o", str(tmp_path / "cam1.yaml")]
    )

    assert result.exit_code == 0, result.output
    assert camera_from_file(tmp_path / "cam1.yaml") == camera_from_file(chain, "cam1")


def test_an_implausible_camera_gives_warnings(tmp_path: Path) -> None:
    wrong = Camera(752, 480, 458.654, 457.296, 940.0, 248.375, 0.0, Lens("plumb_bob", (-0.3, 113.0)))
    path = write(tmp_path / "camera.yaml", camera_to_yaml(wrong))

    result = CliRunner().invoke(app, ["camera", "show", str(path)])

    assert result.exit_code == 0, result.output
    assert "warning: the principal point (940.0, 248.4) lies outside the image of 752 x 480 px" in result.stderr
    assert "warning: k2 = 113: coefficients of real lenses are rarely above 10" in result.stderr
    assert camera_warnings(RADTAN_CAMERA) == ()
    assert camera_warnings(FISHEYE_CAMERA) == ()
