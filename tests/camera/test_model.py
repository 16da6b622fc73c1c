"""The pinhole camera and how it is bolted to the aircraft."""

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from glstar.camera.distortion import Lens
from glstar.camera.model import AttitudeError, Camera, Mount, directions_seen
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


def test_an_image_of_one_row_or_column_is_valid() -> None:
    assert Camera(1, 760, 967.7, 967.7, 0.0, 379.5).width_px == 1
    assert Camera(1014, 1, 967.7, 967.7, 506.5, 0.0).height_px == 1


def test_a_position_outside_is_not_contained_without_a_margin(camera: Camera) -> None:
    assert camera.contains([[-0.4, 3.0], [1013.4, 759.4]]).all()
    assert not camera.contains([[-0.6, 3.0], [3.0, 759.6], [-0.5, 3.0], [3.0, 759.5]]).any()
    assert np.isnan(camera.project([[0.0, 0.0, 1e-9]])).all()


@pytest.mark.parametrize("lens", [None, Lens("plumb_bob", (-0.2, 0.03)), Lens("fisheye", (0.02,))], ids=str)
@pytest.mark.parametrize("axis", [(300.0, 200.0), (700.0, 200.0), (300.0, 500.0), (700.0, 500.0)])
def test_the_field_radius_is_that_of_the_corner_opposite_to_the_axis(lens: Lens | None, axis: tuple) -> None:
    camera = Camera(1014, 760, 967.7, 901.5, *axis, skew_px=7.0, lens=lens)
    corner = [1013.5 if axis[0] < 500 else -0.5, 759.5 if axis[1] < 400 else -0.5]
    x, y, z = camera.unit_vectors(corner)
    assert camera.field_radius_rad == pytest.approx(np.arctan2(np.hypot(x, y), z), rel=1e-12)
    seen = directions_seen(camera)
    grid = np.stack(np.meshgrid(np.linspace(-0.5, 1013.5, 65), np.linspace(-0.5, 759.5, 65)), axis=-1)
    np.testing.assert_allclose(camera.project(seen), grid.reshape(-1, 2), rtol=0, atol=1e-6)
    left, right = camera.unit_vectors([[-0.5, axis[1]], [1013.5, axis[1]]])
    between = np.arctan2(right[0], right[2]) - np.arctan2(left[0], left[2])
    if lens is None:
        rows = camera.normalized([[-0.5, axis[1]], [1013.5, axis[1]]])
        between = np.arctan(rows[1, 0]) - np.arctan(rows[0, 0])
    assert camera.horizontal_field_rad == pytest.approx(between, rel=1e-12)


def test_the_largest_scale_of_an_image_is_that_of_its_farthest_corner() -> None:
    camera = Camera(1014, 760, 967.7, 901.5, 300.0, 200.0)
    field = camera.field_radius_rad
    # Along the radius a pinhole has f / cos^2: f tan(theta) grows so.
    assert camera.max_px_per_rad == pytest.approx(967.7 / np.cos(field) ** 2, rel=1e-12)
    behind = Camera(1014, 760, 967.7, 901.5, 300.0, 200.0, lens=Lens("fisheye", (0.1,)))
    angle = behind.field_radius_rad
    # That of a circle around the corner: theta (1 + k theta^2) has the slope 1 + 3 k theta^2.
    assert behind.max_px_per_rad == pytest.approx(967.7 * (1 + 0.3 * angle**2), rel=0.05)
    scales = np.linalg.svd(behind.px_per_rad(directions_seen(behind)), compute_uv=False)
    assert behind.max_px_per_rad == scales.max()


@pytest.mark.parametrize("lens", [None, Lens("plumb_bob", (-0.2, 0.03, 1e-3, -2e-3))], ids=str)
def test_the_scale_is_the_derivative_along_and_about_the_radius(lens: Lens | None) -> None:
    camera = Camera(1014, 760, 967.7, 901.5, 300.0, 200.0, skew_px=7.0, lens=lens)
    direction, step = np.array([0.2, -0.3, 0.9]) / np.sqrt(0.94), 1e-6
    rho = np.hypot(0.2, 0.3)
    # Away from the axis is a turn about the vector at right angles to the radius; clockwise is one about the axis,
    # by the angle over the sine of the distance from it.
    turns = np.array([[0.3, 0.2, 0.0], [0.0, 0.0, np.sqrt(0.94)]]) / rho
    expected = [
        (
            camera.project(Rotation.from_rotvec(step * turn).apply(direction))
            - camera.project(Rotation.from_rotvec(-step * turn).apply(direction))
        )
        / (2 * step)
        for turn in turns
    ]
    np.testing.assert_allclose(camera.px_per_rad(direction).T, expected, rtol=1e-6)
    on_axis = camera.px_per_rad([0.0, 0.0, 1.0])
    np.testing.assert_allclose(on_axis, [[967.7, 7.0], [0.0, 901.5]], rtol=0, atol=1e-9)


ANGLES = [(0.3, -0.4, 2.0), (-2.5, 1.1, -0.7), (3.0, 0.2, -3.0)]


@pytest.mark.parametrize("reading", ["body", "literal"])
@pytest.mark.parametrize("angles", ANGLES)
def test_a_mount_has_the_angles_of_its_matrix(reading, angles: tuple) -> None:
    """SciPy turns by yaw, pitch and roll; the rows of the transpose are the axes of the camera."""
    roll, pitch, yaw = angles
    turned = Rotation.from_euler("ZYX", [yaw, pitch, roll]).as_matrix().T
    if reading == "body":
        turned = turned[[1, 2, 0]]  # forward, right, down become right, down, forward
    mount = Mount(roll, pitch, yaw, reading)
    np.testing.assert_allclose(mount.C_camera_body, turned, rtol=0, atol=1e-12)
    again = Mount.from_matrix(turned, reading=reading)
    assert (again.roll_rad, again.pitch_rad, again.yaw_rad) == pytest.approx(angles, rel=0, abs=1e-12)
    assert again.reading == reading
    with pytest.raises(ValueError, match="read-only"):
        mount.C_camera_body[0, 0] = 1.0


@pytest.mark.parametrize("reading", ["body", "literal"])
@pytest.mark.parametrize("pitch", [np.pi / 2, -np.pi / 2])
def test_in_gimbal_lock_the_roll_is_zero(reading, pitch: float) -> None:
    mount = Mount(0.5, pitch, -0.8, reading)
    again = Mount.from_matrix(mount.C_camera_body, reading=reading)
    assert (again.roll_rad, again.pitch_rad) == (0.0, pytest.approx(pitch, rel=0, abs=1e-9))
    assert again.yaw_rad == pytest.approx(-0.8 - 0.5 * np.sign(pitch), rel=0, abs=1e-9)
    np.testing.assert_allclose(again.C_camera_body, mount.C_camera_body, rtol=0, atol=1e-9)


def test_the_default_mount_is_that_of_the_paper() -> None:
    assert Mount() == Mount(0.0, np.pi / 2, -np.pi / 2, "body")
    assert Mount.from_matrix(np.eye(3)).reading == "body"


@pytest.mark.parametrize(
    ("right", "down", "roll"),
    [(0.3, -0.2, 0.4), (-1.5, 2.0, -1.0), (0.0, 0.0, 0.7), (np.pi, 0.0, 0.0), (0.0, 1.2, -3.0)],
)
def test_an_attitude_error_is_a_turn_of_the_axis_and_one_about_it(right: float, down: float, roll: float) -> None:
    true = Rotation.random(random_state=3).as_matrix()
    # The axis moves right by a turn about down, and down by one about left; then the camera rolls.
    across = Rotation.from_rotvec([-down, right, 0.0])
    answered = (across * Rotation.from_rotvec([0.0, 0.0, roll])).as_matrix().T @ true
    error = AttitudeError.between(true, answered)
    assert error.boresight_rad == pytest.approx(np.hypot(right, down), rel=1e-9)
    if right < np.pi:
        assert (error.right_rad, error.down_rad) == pytest.approx((right, down), rel=0, abs=1e-9)
        assert error.roll_rad == pytest.approx(roll, rel=0, abs=1e-9)


def test_the_opposite_attitude_is_half_a_turn_away() -> None:
    error = AttitudeError.between(np.eye(3), np.diag([-1.0, 1.0, -1.0]))
    assert (error.right_rad, error.down_rad, error.boresight_rad) == (np.pi, 0.0, np.pi)
    assert AttitudeError.between(np.eye(3), np.eye(3)) == AttitudeError(0.0, 0.0, 0.0)
