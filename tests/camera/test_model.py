"""The pinhole camera and how it is bolted to the aircraft."""

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from glstar.camera.model import Camera, Mount
from glstar.errors import CalibrationError

# Body axes: forward, right, down.
FORWARD, RIGHT, DOWN = np.eye(3)
LEFT, UP, AFT = -RIGHT, -DOWN, -FORWARD
# The rows of C_camera_body: where the image's right and down and the optical axis point, in body axes.
IMAGE_RIGHT, IMAGE_DOWN, BORESIGHT = range(3)

NEGLIGIBLE_PX = 1e-9


@pytest.fixture
def camera() -> Camera:
    """Return a camera with two focal lengths, a principal point off the centre and a skew."""
    return Camera(1014, 760, fx_px=967.7425, fy_px=961.5, cx_px=511.25, cy_px=370.75, skew_px=0.5)


def test_the_papers_mount_points_at_the_zenith_of_a_level_aircraft() -> None:
    np.testing.assert_allclose(Mount().C_camera_body[BORESIGHT], UP, rtol=0, atol=1e-15)


def test_with_the_papers_mount_image_right_is_forward_and_image_down_is_the_left_wing() -> None:
    C_camera_body = Mount().C_camera_body

    np.testing.assert_allclose(C_camera_body[IMAGE_RIGHT], FORWARD, rtol=0, atol=1e-15)
    np.testing.assert_allclose(C_camera_body[IMAGE_DOWN], LEFT, rtol=0, atol=1e-15)


def test_the_zenith_of_a_level_aircraft_falls_on_the_principal_point(camera: Camera) -> None:
    pixel = camera.project(Mount().C_camera_body @ UP)

    np.testing.assert_allclose(pixel, [511.25, 370.75], rtol=0, atol=NEGLIGIBLE_PX)


def test_a_star_ahead_of_the_zenith_lies_to_the_right_of_the_principal_point(camera: Camera) -> None:
    x_px, y_px = camera.project(Mount().C_camera_body @ (UP + 0.1 * FORWARD))

    assert x_px == pytest.approx(511.25 + 0.1 * 967.7425)
    assert y_px == pytest.approx(370.75)


def test_the_papers_angles_read_literally_point_along_the_left_wing() -> None:
    C_camera_body = Mount(reading="literal").C_camera_body

    np.testing.assert_allclose(C_camera_body[BORESIGHT], LEFT, rtol=0, atol=1e-15)
    np.testing.assert_allclose(C_camera_body[IMAGE_RIGHT], UP, rtol=0, atol=1e-15)
    np.testing.assert_allclose(C_camera_body[IMAGE_DOWN], FORWARD, rtol=0, atol=1e-15)


def test_the_papers_mount_is_a_half_turn_of_roll_read_literally() -> None:
    half_a_turn = Mount(roll_rad=np.pi, pitch_rad=0.0, yaw_rad=0.0, reading="literal")

    np.testing.assert_allclose(Mount().C_camera_body, half_a_turn.C_camera_body, rtol=0, atol=1e-15)


def test_a_camera_without_rotation_points_along_the_nose() -> None:
    C_camera_body = Mount(0.0, 0.0, 0.0).C_camera_body

    np.testing.assert_array_equal(C_camera_body, [RIGHT, DOWN, FORWARD])


@given(*[st.floats(-np.pi, np.pi)] * 3, st.sampled_from(["body", "literal"]))
def test_a_mount_is_a_rotation_and_never_a_mirror(roll_rad: float, pitch_rad: float, yaw_rad: float, reading) -> None:
    C_camera_body = Mount(roll_rad, pitch_rad, yaw_rad, reading).C_camera_body

    np.testing.assert_allclose(C_camera_body @ C_camera_body.T, np.eye(3), rtol=0, atol=1e-14)
    assert np.linalg.det(C_camera_body) == pytest.approx(1.0)


@given(*[st.floats(-2.0, 2.0)] * 2, st.floats(0.1, 100.0))
def test_project_agrees_with_opencv(x: float, y: float, z: float) -> None:
    camera = Camera(1014, 760, fx_px=967.7425, fy_px=961.5, cx_px=511.25, cy_px=370.75)
    expected, _ = cv2.projectPoints(np.array([[x, y, z]]), np.zeros(3), np.zeros(3), camera.K, np.zeros(5))

    np.testing.assert_allclose(camera.project([x, y, z]), expected.ravel(), rtol=1e-12, atol=1e-9)


@given(*[st.floats(-2.0, 2.0)] * 2, st.floats(0.1, 100.0))
def test_project_multiplies_by_the_intrinsic_matrix(x: float, y: float, z: float) -> None:
    camera = Camera(1014, 760, fx_px=967.7425, fy_px=961.5, cx_px=511.25, cy_px=370.75, skew_px=0.5)

    np.testing.assert_allclose(
        camera.project([x, y, z]),
        (camera.K @ [x / z, y / z, 1.0])[:2],
        rtol=1e-12,
        atol=NEGLIGIBLE_PX,
    )


def test_the_length_of_a_direction_does_not_matter(camera: Camera) -> None:
    np.testing.assert_allclose(camera.project([0.1, 0.2, 1.0]), camera.project([10.0, 20.0, 100.0]), rtol=1e-15)


def test_directions_behind_or_beside_the_camera_have_no_pixel_position(camera: Camera) -> None:
    pixels = camera.project([[0.1, 0.2, -1.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])

    assert np.isnan(pixels[:2]).all()
    assert np.isfinite(pixels[2]).all()


def test_many_directions_are_projected_at_once(camera: Camera) -> None:
    assert camera.project(np.ones((4, 5, 3))).shape == (4, 5, 2)


def test_a_position_is_within_a_margin_larger_than_its_distance_outside_the_image(camera: Camera) -> None:
    """Pixel centres are whole numbers: the image begins half a pixel before the first and ends half after the last."""
    last = np.array([camera.width_px, camera.height_px]) - 1
    places = np.array([[-0.5, 0], [-3.5, 7], [4, -10.5], [last[0] + 2.5, 0], [0, last[1] + 1.5], [np.nan, 0]])
    beyond_px = camera.distance_outside_px(places)
    np.testing.assert_array_equal(beyond_px, [0, 3, 10, 2, 1, np.nan])
    assert not camera.contains(places, beyond_px).any()
    assert camera.contains(places, beyond_px + 0.25)[:-1].all()
    assert (camera.distance_outside_px([[0, 0], last / 2, last]) < 0).all()


def test_the_field_radius_of_a_camera_is_that_of_its_farthest_corner() -> None:
    # Corners of an image lie half a pixel outside the centres of its corner pixels: here 500 px and 500 px out.
    camera = Camera(1000, 1000, 1000.0, 1000.0, 499.5, 499.5)

    assert camera.field_radius_rad == pytest.approx(np.arctan(np.sqrt(0.5)))


@pytest.mark.parametrize("key", ["fx_px", "fy_px"])
@pytest.mark.parametrize("focal_px", [0.0, -967.7])
def test_a_focal_length_that_is_not_positive_is_refused(key: str, focal_px: float) -> None:
    numbers = {"fx_px": 967.7, "fy_px": 967.7, "cx_px": 506.5, "cy_px": 379.5} | {key: focal_px}

    with pytest.raises(CalibrationError, match=f"{key} = {focal_px}; a focal length is a positive number"):
        Camera(1014, 760, **numbers)


@pytest.mark.parametrize("key", ["fx_px", "fy_px", "cx_px", "cy_px", "skew_px"])
@pytest.mark.parametrize("number", [float("nan"), float("inf"), float("-inf")])
def test_a_camera_matrix_with_a_number_that_is_not_finite_is_refused(key: str, number: float) -> None:
    numbers = {"fx_px": 967.7, "fy_px": 967.7, "cx_px": 506.5, "cy_px": 379.5} | {key: number}

    with pytest.raises(CalibrationError, match=f"{key} = .*finite"):
        Camera(1014, 760, **numbers)


@pytest.mark.parametrize(("width_px", "height_px"), [(0, 760), (1014, 0), (-1, 760)])
def test_an_image_without_pixels_is_refused(width_px: int, height_px: int) -> None:
    with pytest.raises(CalibrationError, match="has no pixels"):
        Camera(width_px, height_px, 967.7, 967.7, 506.5, 379.5)
