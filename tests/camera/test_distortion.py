"""Lenses there and back, against OpenCV."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from glstar.camera.distortion import Lens, _first_fold
from glstar.camera.model import Camera, directions_seen
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
    Lens("rational", (0.3, 0.1, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.05, 0.0)),
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
    direction = camera.unit_vectors(np.stack([columns, rows], axis=-1).reshape(-1, 2))
    assert np.isfinite(direction).all()

    np.testing.assert_allclose(camera.project(direction), opencv_projects(camera, direction), rtol=0, atol=MILLIONTH_PX)


@every_lens
def test_unit_vectors_are_the_inverse_of_project(lens: Lens) -> None:
    camera = camera_with(lens, skew_px=0.5)
    xy = np.random.default_rng(1).uniform(-0.5, [1013.5, 759.5], (500, 2))

    np.testing.assert_allclose(camera.project(camera.unit_vectors(xy)), xy, rtol=0, atol=MILLIONTH_PX)


# A fisheye of 190 deg, one whose polynomial turns at 115 deg, and one that shows the whole sphere.
BEYOND_90 = [Lens("fisheye", (-0.02, 0.003, -1e-3, 2e-4)), Lens("fisheye", (-1 / 12,)), Lens("fisheye", ())]


def directions_within(limit_rad: float) -> np.ndarray:
    """Return a grid of unit vectors up to just within an angle off the axis."""
    theta, azimuth = np.meshgrid(np.linspace(0.0, 0.999 * limit_rad, 41), np.linspace(0.0, 2 * np.pi, 37))
    across = np.sin(theta)
    return np.stack([across * np.cos(azimuth), across * np.sin(azimuth), np.cos(theta)], axis=-1).reshape(-1, 3)


@pytest.mark.parametrize("lens", BEYOND_90, ids=str)
def test_a_fisheye_projects_by_the_angle_beyond_90_deg(lens: Lens) -> None:
    camera = camera_with(lens)
    seen = directions_within(min(lens.limit_rad, np.deg2rad(179.0)))
    theta = np.arctan2(np.hypot(seen[:, 0], seen[:, 1]), seen[:, 2])
    k = np.append(lens.coefficients, np.zeros(4))
    radius = theta + k[0] * theta**3 + k[1] * theta**5 + k[2] * theta**7 + k[3] * theta**9
    azimuth = np.arctan2(seen[:, 1], seen[:, 0])
    expected = [511.25, 370.75] + radius[:, np.newaxis] * np.column_stack(
        [967.7425 * np.cos(azimuth), 961.5 * np.sin(azimuth)]
    )

    np.testing.assert_allclose(camera.project(3.7 * seen), expected, rtol=0, atol=1e-9)
    np.testing.assert_allclose(camera.unit_vectors(expected), seen, rtol=0, atol=1e-9)


def test_a_fisheye_ends_where_its_polynomial_turns_beyond_90_deg() -> None:
    camera = camera_with(Lens("fisheye", (-1 / 12,)))

    assert camera.limit_rad == pytest.approx(2.0)
    at = [[np.sin(theta), 0.0, np.cos(theta)] for theta in (1.999, 2.001, 3.0, np.pi)]
    np.testing.assert_array_equal(np.isfinite(camera.project(at)).all(axis=1), [True, False, False, False])
    assert np.isnan(camera.project([0.0, 0.0, 0.0])).all()
    assert np.isnan(camera.unit_vectors([511.25 + 967.7425 * 1.34, 370.75])).all()  # the farthest is 4/3


@pytest.mark.parametrize("lens", [*LENSES, *BEYOND_90], ids=str)
def test_a_lens_ends_at_the_stated_end_of_its_image_circle(lens: Lens) -> None:
    camera = camera_with(replace(lens, max_angle_rad=0.5))
    at = [[np.sin(theta), 0.0, np.cos(theta)] for theta in (0.49, 0.51)]

    assert camera.limit_rad == 0.5
    np.testing.assert_array_equal(np.isfinite(camera.project(at)).all(axis=1), [True, False])
    beyond_px = camera_with(lens).project(at)[1]
    assert np.isnan(camera.unit_vectors(beyond_px)).all()
    assert camera.field_radius_rad == 0.5
    assert replace(lens, max_angle_rad=0.5).rotated_by_quarter().max_angle_rad == 0.5


@pytest.mark.parametrize("lens", [None, *LENSES, *BEYOND_90], ids=str)
def test_rates_are_the_derivatives_of_positions(lens: Lens | None) -> None:
    camera, random = camera_with(lens, skew_px=0.5), np.random.default_rng(6)
    seen = directions_within(min(camera.limit_rad, np.deg2rad(60.0 if camera.limit_rad < 1.6 else 175.0)))
    seen *= random.uniform(0.5, 2.0, (len(seen), 1))
    rate, step = random.normal(size=seen.shape), 1e-6

    xy_px, rate_px = camera.project_with_rates(seen, rate)

    np.testing.assert_array_equal(xy_px, camera.project(seen))
    central = (camera.project(seen + step * rate) - camera.project(seen - step * rate)) / (2 * step)
    scale = 1 + np.abs(central).max(axis=1, keepdims=True)
    np.testing.assert_allclose(rate_px / scale, central / scale, rtol=0, atol=1e-6)


def test_fields_of_view_are_measured_beyond_90_deg() -> None:
    # An image circle of 220 deg that fits the height, in an image that is wider.
    camera = Camera(1200, 800, 400 / np.deg2rad(110), 400 / np.deg2rad(110), 599.5, 399.5, 0.0, BEYOND_90[2])

    assert np.rad2deg(camera.horizontal_field_rad) == pytest.approx(330.0)
    assert camera.field_radius_rad == camera.limit_rad == np.pi  # corners are 198 deg off the axis
    scales = np.linalg.svd(camera.px_per_rad(directions_seen(camera)), compute_uv=False)
    assert scales.min() == pytest.approx(camera.fx_px)  # along the radius


@pytest.mark.parametrize("lens", LENSES[:5], ids=str)
def test_undistortion_agrees_with_opencv(lens: Lens) -> None:
    camera = camera_with(lens)
    xy = np.random.default_rng(2).uniform(0, [1013, 759], (200, 2))
    criteria = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 500, 1e-14)
    expected = cv2.undistortPoints(
        xy[:, np.newaxis], camera.K, np.array(lens.coefficients), P=camera.K, criteria=criteria
    )[:, 0]

    np.testing.assert_allclose(camera.pinhole.project(camera.unit_vectors(xy)), expected, rtol=0, atol=MILLIONTH_PX)


def test_fisheye_undistortion_agrees_with_opencv() -> None:
    camera = camera_with(LENSES[6])
    xy = np.random.default_rng(2).uniform(0, [1013, 759], (200, 2))
    expected = cv2.fisheye.undistortPoints(xy[:, np.newaxis], camera.K, np.array(LENSES[6].coefficients), P=camera.K)

    np.testing.assert_allclose(camera.pinhole.project(camera.unit_vectors(xy)), expected[:, 0], rtol=0, atol=1e-4)


@given(st.floats(-0.5, 0.5), st.floats(-0.2, 0.2), st.floats(-0.05, 0.05), st.floats(-1.0, 1.0), st.floats(-1.0, 1.0))
def test_no_two_directions_have_the_same_pixel_position_for_any_coefficients(
    k1: float, k2: float, k3: float, x: float, y: float
) -> None:
    lens = Lens("plumb_bob", (k1, k2, 0.0, 0.0, k3))
    direction = np.array([x, y, 1.0]) / np.sqrt(x * x + y * y + 1)
    bent = lens.project(direction)
    if np.isfinite(bent).all() and np.hypot(x, y) < 0.999 * np.tan(lens.limit_rad):
        np.testing.assert_allclose(lens.unproject(bent), direction, rtol=0, atol=1e-6)


def test_stars_beyond_the_maximum_of_the_polynomial_leave_no_ghosts() -> None:
    # r (1 - 0.1 r^2) is largest at r = 1.826 and comes back to 0.94 at r = 2.5.
    camera = camera_with(Lens("plumb_bob", (-0.1,)))
    limit = np.sqrt(1 / 0.3)

    assert camera.lens is not None
    assert camera.limit_rad == pytest.approx(np.arctan(limit))
    assert np.isfinite(camera.project([0.999 * limit, 0.0, 1.0])).all()
    assert np.isnan(camera.project([[1.001 * limit, 0.0, 1.0], [2.5, 0.0, 1.0], [0.0, 3.1, 1.0]])).all()


@pytest.mark.parametrize(
    ("lens", "limit_rad"),
    [
        (Lens("plumb_bob", (0.1,)), np.pi / 2),
        (Lens("rational", (0.0, 0.0, 0.0, 0.0, 0.0, -0.25)), np.arctan(2.0)),  # a pole
        (Lens("rational", (0.0, 0.0, 0.0, 0.0, 0.0, 0.25)), np.arctan(2.0)),  # r / (1 + r^2 / 4) is largest there
        (Lens("fisheye", (-1 / 3,)), 1.0),
        (Lens("fisheye", (-1 / 12,)), 2.0),  # beyond 90 deg
        (Lens("fisheye", (0.0,)), np.pi),
    ],
    ids=str,
)
def test_a_lens_ends_at_the_maximum_of_its_polynomial(lens: Lens, limit_rad: float) -> None:
    assert lens.limit_rad == pytest.approx(limit_rad)


@pytest.mark.parametrize("seed", range(12))
def test_a_lens_with_tangential_terms_ends_where_a_first_direction_folds(seed: int) -> None:
    rng = np.random.default_rng(seed)
    k1, k2, k3 = rng.normal(0.0, (0.3, 0.2, 0.1))
    p1, p2, *prism = rng.normal(0.0, 10 ** rng.uniform(-4, -1), 6) * ([1] * 6 if seed % 2 else [1, 1, 0, 0, 0, 0])
    lens = Lens("rational", (k1, k2, p1, p2, k3, 0.0, 0.0, 0.0, *prism))
    radii = np.tan(np.linspace(0.0, np.deg2rad(89.0), 3000))
    azimuth_rad = np.linspace(0.0, 2 * np.pi, 72, endpoint=False)
    x, y = np.outer(radii, np.cos(azimuth_rad)), np.outer(radii, np.sin(azimuth_rad))

    def moved(x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        q = x**2 + y**2
        factor = 1 + k1 * q + k2 * q**2 + k3 * q**3
        return (
            x * factor + 2 * p1 * x * y + p2 * (q + 2 * x**2) + prism[0] * q + prism[1] * q**2,
            y * factor + p1 * (q + 2 * y**2) + 2 * p2 * x * y + prism[2] * q + prism[3] * q**2,
        )

    step = 1e-6 * (1 + np.hypot(x, y))
    (xx, yx), (xy, yy) = (
        [
            (after - before) / (2 * step)
            for after, before in zip(moved(x + dx, y + dy), moved(x - dx, y - dy), strict=True)
        ]
        for dx, dy in ((step, 0.0), (0.0, step))
    )
    folded = (xx * yy - xy * yx <= 0).any(axis=1)
    expected = float(np.arctan(radii[folded.argmax()])) if folded.any() else np.pi / 2

    assert lens.limit_rad == pytest.approx(expected, rel=0, abs=2 * np.deg2rad(89.0) / 3000)


def test_a_pixel_outside_the_image_circle_has_no_direction() -> None:
    camera = Camera(1014, 760, 600.0, 600.0, 506.5, 379.5, 0.0, Lens("plumb_bob", (-0.4,)))

    assert np.isnan(camera.unit_vectors([0.0, 0.0])).any()
    assert np.isfinite(camera.unit_vectors([506.5, 60.0])).all()
    assert camera.field_radius_rad == pytest.approx(np.arctan(np.sqrt(1 / 1.2)))


def test_the_field_radius_of_a_camera_with_a_lens_is_that_of_its_farthest_corner() -> None:
    camera = camera_with(LENSES[1])
    corners = camera.unit_vectors([[-0.5, -0.5], [1013.5, -0.5], [-0.5, 759.5], [1013.5, 759.5]])

    assert camera.field_radius_rad == pytest.approx(np.arccos(corners[:, 2]).max())
    assert camera.field_radius_rad > camera.pinhole.field_radius_rad  # a barrel sees more


@pytest.mark.parametrize("lens", [*LENSES, Lens("plumb_bob", (0.1, 0.0, 2e-3))], ids=str)
def test_a_camera_rotated_by_90_deg_has_its_lens_rotated(lens: Lens) -> None:
    x, y = np.random.default_rng(5).uniform(-0.5, 0.5, (2, 100))
    bent = lens.project(np.column_stack([x, y, np.ones(100)]))
    tau_x, tau_y = lens.coefficients[12:] or (0.0, 0.0)

    turned = lens.rotated_by_quarter().unproject(bent[:, ::-1] * [-1, 1])
    turned = turned[:, :2] / turned[:, 2:]

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
        ("fov", (0.9,), "there is no lens model 'fov'; there are plumb_bob, rational, fisheye, double_sphere"),
    ],
)
def test_an_invalid_lens_is_refused(model, coefficients, words: str) -> None:
    with pytest.raises(CalibrationError, match=words):
        Lens(model, coefficients)


def test_the_limits_of_coefficients_and_of_the_image_circle_are_valid() -> None:
    for coefficients in ((-0.999999, 0.0), (0.3, 1.0), (0.3, 0.0), (1.7, 0.4)):
        assert Lens("double_sphere", coefficients).coefficients == coefficients
    assert Lens("eucm", (0.4, 1e-9)).coefficients == (0.4, 1e-9)
    for model, coefficients in (("double_sphere", (0.3, 1.000001)), ("double_sphere", (0.3, -1e-6)), ("omni", (-1.0,))):
        with pytest.raises(CalibrationError, match="the lens has"):
            Lens(model, coefficients)
    for angle_deg in (0.0, -1.0, 180.1):
        with pytest.raises(CalibrationError, match=f"ends {angle_deg:g} deg off the axis; it is up to 180 deg"):
            Lens("fisheye", (), np.deg2rad(angle_deg))
    assert Lens("fisheye", ()).keys == {"lens": "fisheye", "distortion": []}
    assert Lens("fisheye", (0.1,), np.deg2rad(93.5)).keys == {
        "lens": "fisheye",
        "distortion": [0.1],
        "max_angle_deg": 93.5,
    }
    assert str(Lens("plumb_bob", (-0.25, 0.0, 1e-3))) == "plumb_bob k1=-0.25 p1=0.001"


@pytest.mark.parametrize(
    "lens", [*BEYOND_90[:2], Lens("plumb_bob", (-0.1,)), Lens("double_sphere", (1.6, 0.3))], ids=str
)
def test_a_direction_at_the_limit_has_no_position(lens: Lens) -> None:
    limit = lens.limit_rad
    at = [[np.sin(theta), 0.0, np.cos(theta)] for theta in (limit, limit - 1e-4)]
    assert np.isfinite(lens.project(at)).all(axis=1).tolist() == [False, True]
    assert np.isnan(lens.radius([limit, limit + 0.1])).all()
    # The image of a direction on the x axis is its distance from the axis.
    theta = np.linspace(0, 0.99 * limit, 7)
    on_axis = lens.project(np.column_stack([np.sin(theta), 0 * theta, np.cos(theta)]))
    np.testing.assert_allclose(lens.radius(theta), on_axis[:, 0], rtol=1e-9)


@pytest.mark.parametrize("count", range(1, 15))
def test_a_rotated_lens_has_whole_pairs_of_coefficients(count: int) -> None:
    every = (0.1, 0.02, 1e-3, 2e-3, 0.01, 0.03, 0.02, 0.01, 1e-3, 2e-3, 3e-3, 4e-3, 0.01, 0.02)
    rotated = Lens("rational", every[:count]).rotated_by_quarter().coefficients
    whole = {1: 1, 2: 2, 3: 4, 9: 12, 10: 12, 11: 12, 13: 14}.get(count, count)
    assert len(rotated) == whole
    if count > 2:
        # Tangential coefficients are a vector (p2, p1) in the image plane.
        p1, p2 = every[2], every[3] if count > 3 else 0.0
        if count < 13:
            assert rotated[2:4] == pytest.approx((p2, -p1), rel=1e-12)
    omni = Lens("omni", (1.2, *every[:3])).rotated_by_quarter().coefficients
    assert omni == pytest.approx((1.2, 0.1, 0.02, 0.0, -1e-3), rel=1e-12)


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


def test_the_first_fold_is_found_on_every_circle_that_has_one() -> None:
    """Against the determinants on all circles, by complex steps: none of those that are left out folds."""
    azimuth = np.linspace(0.0, 2 * np.pi, 72, endpoint=False)
    radii = np.linspace(0.0, 3.0, 50)
    x, y = np.outer(radii, np.cos(azimuth)), np.outer(radii, np.sin(azimuth))
    rng = np.random.default_rng(11)
    found = []
    for _ in range(150):
        k = rng.normal(0.0, (0.2, 0.05, 0.01, 0.1, 0.02, 0.002)) * rng.choice([0.0, 1.0], 6, p=[0.3, 0.7])
        t = rng.normal(0.0, 10 ** rng.uniform(-3, -0.7), 6) * rng.choice([0.0, 1.0], 6)

        def moved(x: np.ndarray, y: np.ndarray, k: np.ndarray = k, t: np.ndarray = t) -> np.ndarray:
            q = x * x + y * y
            factor = (1 + k[0] * q + k[1] * q**2 + k[2] * q**3) / (1 + k[3] * q + k[4] * q**2 + k[5] * q**3)
            p1, p2, s1, s2, s3, s4 = t
            return np.array([
                x * factor + 2 * p1 * x * y + p2 * (q + 2 * x * x) + s1 * q + s2 * q**2,
                y * factor + p1 * (q + 2 * y * y) + 2 * p2 * x * y + s3 * q + s4 * q**2,
            ])  # fmt: skip

        xx, yx = moved(x + 1e-20j, y + 0j).imag / 1e-20
        xy, yy = moved(x + 0j, y + 1e-20j).imag / 1e-20
        folded = (xx * yy - xy * yx <= 0).any(axis=1)
        expected = int(folded.argmax()) if folded.any() else None
        coefficients = (k[0], k[1], t[0], t[1], k[2], *k[3:], *t[2:], 0.0, 0.0)
        assert _first_fold(coefficients, radii) == expected
        found.append(expected)
    # Folds lie anywhere between the axis and the last circle, or nowhere.
    assert found.count(None) > 20
    assert len(set(found)) > 20
