"""Lenses there and back, against OpenCV."""

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from glstar.camera.distortion import Lens
from glstar.camera.model import Camera
from glstar.errors import CalibrationError
from glstar.images.decoding import rectify

LENSES = [
    Lens("plumb_bob", (-0.28, 0.07, 0.0, 0.0)),
    Lens("plumb_bob", (-0.28, 0.07, 1e-3, -7e-4, 0.01)),
    Lens("plumb_bob", (0.15, -0.02, -2e-3, 1e-3)),
    Lens("rational", (0.3, 0.1, 1e-3, -2e-3, 0.02, 0.6, 0.2, 0.03)),
    Lens("rational", (0.3, 0.1, 1e-3, -2e-3, 0.02, 0.6, 0.2, 0.03, 1e-3, -2e-3, 3e-3, 1e-3)),
    Lens("rational", (0.3, 0.1, 1e-3, -2e-3, 0.02, 0.6, 0.2, 0.03, 1e-3, -2e-3, 3e-3, 1e-3, 0.05, -0.03)),
    Lens("fisheye", (-0.02, 0.003, -1e-3, 2e-4)),
    Lens("fisheye", ()),
]
every_lens = pytest.mark.parametrize("lens", LENSES, ids=str)
MILLIONTH_PX = 1e-6


def camera_with(lens: Lens | None, skew_px: float = 0.0) -> Camera:
    return Camera(1014, 760, 967.7425, 961.5, 511.25, 370.75, skew_px, lens)


def opencv_projects(camera: Camera, direction: np.ndarray) -> np.ndarray:
    assert camera.lens is not None
    nowhere, coefficients = np.zeros(3), np.array(camera.lens.coefficients)
    if camera.lens.model == "fisheye":
        coefficients = np.append(coefficients, np.zeros(4 - len(coefficients)))
        found, _ = cv2.fisheye.projectPoints(
            direction[:, np.newaxis], nowhere, nowhere, camera.K, coefficients, alpha=camera.skew_px / camera.fx_px
        )
    else:
        found, _ = cv2.projectPoints(direction, nowhere, nowhere, camera.K, coefficients)
    return found[:, 0]


@every_lens
def test_a_camera_with_a_lens_projects_as_opencv_does_to_the_corners(lens: Lens) -> None:
    camera = camera_with(lens)
    columns, rows = np.meshgrid(np.linspace(-0.5, 1013.5, 40), np.linspace(-0.5, 759.5, 30))
    direction = camera.unproject(np.stack([columns, rows], axis=-1).reshape(-1, 2))
    assert np.isfinite(direction).all()

    np.testing.assert_allclose(camera.project(direction), opencv_projects(camera, direction), rtol=0, atol=MILLIONTH_PX)


@every_lens
def test_unproject_is_the_inverse_of_project(lens: Lens) -> None:
    camera = camera_with(lens, skew_px=0.5)
    xy = np.random.default_rng(1).uniform(-0.5, [1013.5, 759.5], (500, 2))

    np.testing.assert_allclose(camera.project(camera.unproject(xy)), xy, rtol=0, atol=MILLIONTH_PX)


@pytest.mark.parametrize("lens", LENSES[:5], ids=str)
def test_undistortion_agrees_with_opencv(lens: Lens) -> None:
    camera = camera_with(lens)
    xy = np.random.default_rng(2).uniform(0, [1013, 759], (200, 2))
    criteria = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 500, 1e-14)
    expected = cv2.undistortPoints(
        xy[:, np.newaxis], camera.K, np.array(lens.coefficients), P=camera.K, criteria=criteria
    )[:, 0]

    np.testing.assert_allclose(camera.pinhole.project(camera.unproject(xy)), expected, rtol=0, atol=MILLIONTH_PX)


def test_fisheye_undistortion_agrees_with_opencv() -> None:
    camera = camera_with(LENSES[6])
    xy = np.random.default_rng(2).uniform(0, [1013, 759], (200, 2))
    expected = cv2.fisheye.undistortPoints(xy[:, np.newaxis], camera.K, np.array(LENSES[6].coefficients), P=camera.K)

    np.testing.assert_allclose(camera.pinhole.project(camera.unproject(xy)), expected[:, 0], rtol=0, atol=1e-4)


@given(st.floats(-0.5, 0.5), st.floats(-0.2, 0.2), st.floats(-0.05, 0.05), st.floats(-1.0, 1.0), st.floats(-1.0, 1.0))
def test_no_two_directions_have_the_same_pixel_position_for_any_coefficients(
    k1: float, k2: float, k3: float, x: float, y: float
) -> None:
    lens = Lens("plumb_bob", (k1, k2, 0.0, 0.0, k3))
    bent = lens.distort([x, y])
    if np.isfinite(bent).all() and np.hypot(x, y) < 0.999 * lens.limit:
        np.testing.assert_allclose(lens.undistort(bent), [x, y], rtol=0, atol=1e-6)


def test_stars_beyond_the_maximum_of_the_polynomial_leave_no_ghosts() -> None:
    # r (1 - 0.1 r^2) is largest at r = 1.826 and comes back to 0.94 at r = 2.5.
    camera = camera_with(Lens("plumb_bob", (-0.1,)))
    limit = np.sqrt(1 / 0.3)

    assert camera.lens is not None
    assert camera.lens.limit == pytest.approx(limit)
    assert np.isfinite(camera.project([0.999 * limit, 0.0, 1.0])).all()
    assert np.isnan(camera.project([[1.001 * limit, 0.0, 1.0], [2.5, 0.0, 1.0], [0.0, 3.1, 1.0]])).all()


@pytest.mark.parametrize(
    ("lens", "limit"),
    [
        (Lens("plumb_bob", (0.1,)), np.inf),
        (Lens("rational", (0.0, 0.0, 0.0, 0.0, 0.0, -0.25)), 2.0),  # a pole
        (Lens("rational", (0.0, 0.0, 0.0, 0.0, 0.0, 0.25)), 2.0),  # r / (1 + r^2 / 4) is largest there
        (Lens("fisheye", (-1 / 3,)), np.tan(1.0)),
        (Lens("fisheye", (0.0,)), np.inf),
    ],
    ids=str,
)
def test_a_lens_ends_at_the_maximum_of_its_polynomial(lens: Lens, limit: float) -> None:
    assert lens.limit == pytest.approx(limit)


def test_a_pixel_outside_the_image_circle_has_no_direction() -> None:
    camera = Camera(1014, 760, 600.0, 600.0, 506.5, 379.5, 0.0, Lens("plumb_bob", (-0.4,)))

    assert np.isnan(camera.unproject([0.0, 0.0])).any()
    assert np.isfinite(camera.unproject([506.5, 60.0])).all()
    assert camera.field_radius_rad == pytest.approx(np.arctan(np.sqrt(1 / 1.2)))


def test_the_field_radius_of_a_camera_with_a_lens_is_that_of_its_farthest_corner() -> None:
    camera = camera_with(LENSES[1])
    corners = camera.unproject([[-0.5, -0.5], [1013.5, -0.5], [-0.5, 759.5], [1013.5, 759.5]])

    assert camera.field_radius_rad == pytest.approx(np.arctan(np.hypot(corners[:, 0], corners[:, 1])).max())
    assert camera.field_radius_rad > camera.pinhole.field_radius_rad  # a barrel sees more


@every_lens
def test_no_short_line_is_magnified_more_than_the_maximum(lens: Lens) -> None:
    camera, random = camera_with(lens), np.random.default_rng(3)
    plane = camera.unproject(random.uniform(0, [1013, 759], (2000, 2)))[:, :2]
    step = random.normal(size=(2000, 2)) * 1e-6

    stretched = np.linalg.norm(lens.distort(plane + step) - lens.distort(plane), axis=1) / np.linalg.norm(step, axis=1)

    assert 0.97 * camera.max_magnification <= max(1.0, stretched.max()) <= 1.001 * camera.max_magnification


@pytest.mark.parametrize("lens", [*LENSES, Lens("plumb_bob", (0.1, 0.0, 2e-3))], ids=str)
def test_a_camera_rotated_by_90_deg_has_its_lens_rotated(lens: Lens) -> None:
    x, y = np.random.default_rng(5).uniform(-0.5, 0.5, (2, 100))
    bent = lens.distort(np.column_stack([x, y]))
    tau_x, tau_y = lens.coefficients[12:] or (0.0, 0.0)

    turned = lens.rotated_by_quarter().undistort(bent[:, ::-1] * [-1, 1])

    # A sensor tilted about both axes: the camera is rolled a little too, as a rigid camera can be.
    roll = np.arctan2((turned[:, 1] * -y - turned[:, 0] * x).sum(), (turned[:, 0] * -y + turned[:, 1] * x).sum())
    assert abs(roll) <= 1.1 * abs(tau_x * tau_y) + 1e-12
    c, s = np.cos(roll), np.sin(roll)
    np.testing.assert_allclose(turned, np.column_stack([-y, x]) @ [[c, s], [-s, c]], rtol=0, atol=1e-12)


@pytest.mark.parametrize(
    ("model", "coefficients", "words"),
    [
        ("plumb_bob", (0.0,) * 6, "6 distortion coefficients are too many for plumb_bob: k1, k2, p1, p2, k3"),
        ("fisheye", (0.1, float("nan")), "the lens has k2 = nan; it must be a finite number"),
        ("fov", (0.9,), "there is no lens model 'fov'; there are plumb_bob, rational, fisheye"),
    ],
)
def test_an_invalid_lens_is_refused(model, coefficients, words: str) -> None:
    with pytest.raises(CalibrationError, match=words):
        Lens(model, coefficients)


# --- rectified images -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16, np.float32, np.float64])
def test_rectification_agrees_with_opencv(dtype) -> None:
    camera = camera_with(LENSES[1])
    noise = np.random.default_rng(4).uniform(0, 255, (760, 1014))
    image = cv2.GaussianBlur(noise, (0, 0), 2.0).astype(dtype)
    assert camera.lens is not None
    maps = cv2.initUndistortRectifyMap(
        camera.K, np.array(camera.lens.coefficients), None, camera.K, (1014, 760), cv2.CV_32FC1
    )

    rectified, pinhole = rectify(image, camera)

    assert pinhole == camera.pinhole
    assert rectified.dtype == dtype
    expected = cv2.remap(image, *maps, cv2.INTER_CUBIC)
    np.testing.assert_allclose(rectified.astype(float), expected.astype(float), rtol=0, atol=1)


def test_a_star_of_a_rectified_image_is_at_the_position_of_the_pinhole() -> None:
    camera = camera_with(LENSES[1])
    rows, columns = np.mgrid[:760, :1014]
    for star in ([0.4, 0.3, 1.0], [-0.45, -0.33, 1.0], [0.02, -0.35, 1.0]):
        x, y = camera.project(star)
        image = 1000 * np.exp(-((columns - x) ** 2 + (rows - y) ** 2) / (2 * 1.5**2))

        rectified, pinhole = rectify(image, camera)

        x, y = pinhole.project(star)
        near = rectified[round(y) - 10 : round(y) + 11, round(x) - 10 : round(x) + 11]
        found = (columns[: near.shape[0], : near.shape[1]] * near).sum() / near.sum() + round(x) - 10
        assert found == pytest.approx(x, abs=0.05)  # its profile is bent with the image


def test_rectifying_an_image_of_a_pinhole_changes_nothing() -> None:
    image = np.zeros((760, 1014), np.uint8)

    assert rectify(image, camera_with(None))[0] is image


def test_an_image_of_another_size_is_not_rectified() -> None:
    with pytest.raises(CalibrationError, match="the image is 507 x 380 px and the camera 1014 x 760"):
        rectify(np.zeros((380, 507), np.uint8), camera_with(LENSES[0]))


@pytest.mark.parametrize("dtype", [np.uint32, np.int8, np.float16])
@pytest.mark.parametrize("lens", [None, LENSES[0]])
def test_numbers_that_cannot_be_rectified_are_refused(dtype: type, lens: Lens | None) -> None:
    camera = camera_with(lens)

    with pytest.raises(CalibrationError, match=f"holds {np.dtype(dtype).name}; rectify images of uint8, uint16"):
        rectify(np.zeros((camera.height_px, camera.width_px), dtype), camera)
