"""Identified stars, steps of a camera's parameters, the lens to start from, and the errors of a fit."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from glstar.calibrate.identify import leastsquares
from glstar.calibrate.identify.leastsquares import (
    CameraPoses,
    FreeParameters,
    IdentifiedStars,
    _coefficient_jacobian,
    _lens_like,
    _scores_of_parts,
    fit_parameters,
    is_one_to_one,
    standard_errors,
)
from glstar.calibrate.identify.platesolution import PlateSolution
from glstar.calibrate.identify.rollingshutter import RowTurns
from glstar.calibrate.minimise import Minimum
from glstar.camera.distortion import Lens
from glstar.camera.model import Camera
from glstar.errors import CalibrationError
from glstar.flight import AttitudeTrack
from glstar.rotation import about_z, matrix_from_quaternion, quaternion_from_turn

CAMERA = Camera(640, 480, 700.0, 690.0, 322.0, 236.0, 1.5)
TURN = matrix_from_quaternion(quaternion_from_turn([0.3, -0.2, 0.5]))
XY = np.array([[100.0, 50], [500, 400], [320, 200], [30, 420]])
APPARENT = CAMERA.unit_vectors(XY) @ TURN


@pytest.mark.parametrize("mirrored", [False, True])
@pytest.mark.parametrize("rolling", [False, True])
def test_stars_are_those_of_the_pairs_in_the_attitude_of_the_middle_row(mirrored: bool, rolling: bool) -> None:
    t = np.arange(-20, 21) * 0.01
    turn = np.array([0.5, 0.2, -0.4]) * t[:, np.newaxis]
    rows = RowTurns(AttitudeTrack.from_samples(t, quaternion_from_turn(turn)), 0.0, about_z(0.3), 0.1)
    detected = SimpleNamespace(xy_px=XY + 1.0)
    star, detection = np.array([2, 0, 3]), np.array([1, 3, 0])
    solution = PlateSolution(CAMERA, TURN, mirrored)
    stars = IdentifiedStars.of(detected, APPARENT, solution, star, detection, rows if rolling else None)
    xy = XY[detection] + 1
    shown = np.column_stack([639 - xy[:, 0] if mirrored else xy[:, 0], xy[:, 1]])
    np.testing.assert_allclose(stars.xy_px, shown, rtol=1e-12)
    assert len(stars) == 3
    if rolling:
        # Rows are those of the image as it was recorded.
        np.testing.assert_allclose(stars.apparent, rows.turned(APPARENT[star], xy, CAMERA), rtol=1e-12)
        np.testing.assert_allclose(stars.by_readout, rows.by_readout(APPARENT[star], xy, CAMERA), rtol=1e-9)
        np.testing.assert_allclose(stars.every(2).by_readout, stars.by_readout[[0, 2]], rtol=1e-12)
    else:
        np.testing.assert_array_equal(stars.apparent, APPARENT[star])
        assert stars.by_readout is stars.every(2).by_readout is None
    np.testing.assert_array_equal(stars.every(2).apparent, stars.apparent[[0, 2]])
    np.testing.assert_array_equal(stars.every(2).xy_px, stars.xy_px[[0, 2]])
    np.testing.assert_array_equal(detected.xy_px, XY + 1)


def test_stars_have_residuals_and_a_largest_angle() -> None:
    shift = np.array([[0.5, -0.25], [0.125, 1.0], [2.0, 3.0], [-1.0, 0.0]])
    stars = IdentifiedStars(APPARENT, XY + shift)
    np.testing.assert_allclose(stars.residual_px(CAMERA, TURN), shift, rtol=0, atol=1e-9)
    rays = CAMERA.unit_vectors(XY)
    assert stars.largest_angle_rad(TURN) == pytest.approx(np.arccos(rays[:, 2]).max())
    behind = IdentifiedStars(np.array([[0.6, 0.0, -0.8]]), XY[:1])
    assert behind.largest_angle_rad(np.eye(3)) == pytest.approx(np.pi - np.arcsin(0.6))


def test_the_outermost_star_is_a_fraction_of_the_farthest_corner() -> None:
    stars = IdentifiedStars(APPARENT, XY)
    for centre, corner in (
        ((322.0, 236.0), (322.5, 243.5)),
        ((310.0, 236.0), (329.5, 243.5)),
        ((322.0, 250.0), (322.5, 250.5)),
        ((310.0, 250.0), (329.5, 250.5)),
    ):
        outermost = np.hypot(*(XY - centre).T).max()
        camera = replace(CAMERA, cx_px=centre[0], cy_px=centre[1])
        assert stars.corner_fraction(camera) == pytest.approx(outermost / np.hypot(*corner))
        bent = replace(camera, lens=Lens("plumb_bob", (-0.1,)))
        assert stars.corner_fraction(bent) == stars.corner_fraction(camera)
    outermost = np.hypot(*(XY - [322, 236]).T).max()
    # A fisheye shows stars up to 90 deg or the end of its image circle, or as far as there are some.
    for f_px, limit_rad, radius in (
        (160.0, np.pi, 160 * np.pi / 2), (190.0, 1.5, 190 * 1.5), (100.0, np.pi, outermost), (600.0, np.pi, None)
    ):  # fmt: skip
        fisheye = replace(CAMERA, fx_px=f_px, lens=Lens("fisheye", (), limit_rad))
        farthest = np.hypot(322.5, 243.5) if radius is None else max(radius, outermost)
        farthest = min(farthest, np.hypot(322.5, 243.5))
        assert stars.corner_fraction(fisheye) == pytest.approx(outermost / farthest, rel=1e-5)


def test_a_step_moves_attitudes_focal_length_point_and_coefficients() -> None:
    camera = replace(CAMERA, lens=Lens("plumb_bob", (-0.1, 0.02, 0.001, 0.002, 0.03)))
    stars = (IdentifiedStars(APPARENT, XY), IdentifiedStars(APPARENT[:2], XY[:2]))
    free = FreeParameters(stars, CAMERA, (0.1, 0.2), (0, 4), principal_point=True)
    assert (free.focal_column, free.lens_column, free.denominator) == (6, 9, ())
    rational = FreeParameters(stars, CAMERA, (0.1, 0.2), (0, 4, 5, 7), principal_point=False)
    assert (rational.lens_column, rational.denominator) == (7, (5, 7))
    step = np.array([0.01, 0.02, 0.03, -0.04, 0.05, -0.06, 0.07, 0.002, -0.003, 0.011, 0.012])
    moved = free.stepped(CameraPoses(camera, (TURN, about_z(0.2))), step)
    factor = np.exp(0.07)
    found = moved.camera
    assert (found.fx_px, found.fy_px, found.skew_px) == pytest.approx((700 * factor, 690 * factor, 1.5 * factor))
    assert (found.cx_px, found.cy_px) == pytest.approx((322 + 0.002 * 640, 236 - 0.003 * 640))
    assert found.lens.coefficients == pytest.approx((-0.1 + 0.011, 0.02, 0.001, 0.002, 0.03 + 0.012))
    for turn, before, after in zip((step[:3], step[3:6]), (TURN, about_z(0.2)), moved.C_camera_eq, strict=True):
        np.testing.assert_allclose(after, matrix_from_quaternion(quaternion_from_turn(turn)) @ before, rtol=1e-12)
    # A step changes the focal length by at most a factor of e.
    for ln_f, limit in ((1.5, 1.0), (-1.5, -1.0)):
        far = FreeParameters(stars[:1], CAMERA, (0.1,), (), principal_point=False)
        moved = far.stepped(CameraPoses(CAMERA, (TURN,)), np.array([0, 0, 0, ln_f]))
        assert moved.camera.fx_px == pytest.approx(700 * np.exp(limit))
        assert (moved.camera.cx_px, moved.camera.cy_px, moved.camera.lens) == (322, 236, None)


def test_a_fit_starts_from_a_lens_of_its_model_and_keeps_priors_at_full_weight(monkeypatch) -> None:
    calls = []

    def minimised(start, measured, moved, *, scale, most_steps):
        calls.append((start, scale, most_steps))
        if failures:
            raise failures.pop()
        return "fit"

    failures: list[Exception] = []
    monkeypatch.setattr(leastsquares, "minimise", minimised)
    prior = replace(CAMERA, cx_px=300.0, cy_px=200.0)
    stars = (IdentifiedStars(APPARENT, XY), IdentifiedStars(APPARENT[:2], XY[:2]))
    start = CameraPoses(CAMERA, (TURN, TURN))
    free = FreeParameters(stars, prior, (0.1, 0.2), (0, 1, 4, 5, 6), principal_point=True)
    assert fit_parameters(free, start, "rational") == "fit"
    began, scale, most_steps = calls[0]
    assert (scale.tolist(), most_steps) == ([2.0] * 12 + [np.inf] * 4, 100)
    assert (began.camera.cx_px, began.camera.lens.model, began.C_camera_eq) == (322.0, "rational", start.C_camera_eq)
    fit_parameters(replace(free, principal_point=False, coefficients=()), start, None)
    began, scale, _ = calls[1]
    assert (scale.tolist(), began.camera.lens) == ([2.0] * 12, None)
    assert (began.camera.cx_px, began.camera.cy_px) == (300.0, 200.0)
    for failure in (ValueError(), np.linalg.LinAlgError(), CalibrationError("none")):
        failures.append(failure)
        assert fit_parameters(free, start, "rational") is None


@pytest.mark.parametrize("principal_point", [False, True])
def test_errors_are_the_larger_of_those_of_stars_and_of_parts_of_the_image(principal_point: bool) -> None:
    rng = np.random.default_rng(3)
    lens = Lens("plumb_bob", (-0.1, 0.02))
    camera = replace(CAMERA, lens=lens)
    stars = tuple(IdentifiedStars(np.ones((n, 3)), rng.uniform(-20, [660, 500], (n, 2))) for n in (40, 30))
    free = FreeParameters(stars, CAMERA, (0.1, 0.2), (0, 1), principal_point=principal_point)
    count = 6 + 1 + 2 * principal_point + 2
    priors = 2 * principal_point
    slopes, residual = rng.normal(size=(140 + priors, count)), rng.normal(0, 1.3, 140 + priors)
    scale = np.append(np.full(140, 2.0), np.full(priors, np.inf))
    fit = Minimum(CameraPoses(camera, (TURN, TURN)), residual, slopes, scale)
    root = np.sqrt(1 + (residual / scale) ** 2)
    inverse = np.linalg.inv((slopes.T * ((root + 1) / (2 * root**2))) @ slopes)
    degrees = 140 + priors - count
    cost = (residual**2 / (root + 1)).sum()
    by_star = np.diag(inverse) * 2 * cost / degrees
    parts: dict[tuple[int, ...], np.ndarray] = {}
    k = 0
    for image, one in enumerate(stars):
        for x, y in one.xy_px:
            part = (image, int(np.clip(4 * y / 480, 0, 3)), int(np.clip(4 * x / 640, 0, 3)))
            for j in (2 * k, 2 * k + 1):
                parts[part] = parts.get(part, 0.0) + slopes[j] * residual[j] / root[j]
            k += 1
    number = len(parts)
    scores = np.array([parts[key] for key in sorted(parts)]) * np.sqrt(number / (number - 1))
    np.testing.assert_allclose(_scores_of_parts(fit, free), scores, rtol=1e-9, atol=1e-12)
    by_part = ((scores @ inverse) ** 2).sum(axis=0) * (140 + priors) / degrees
    sd = np.sqrt(np.maximum(by_star, by_part))
    assert (by_star > by_part).any() != (by_star > by_part).all()
    found = standard_errors(fit, free)
    expected = {"fx_px": sd[6] * 700}
    if principal_point:
        expected |= {"cx_px": sd[7] * 640, "cy_px": sd[8] * 640}
    expected |= {"k1": sd[-2], "k2": sd[-1]}
    assert found == pytest.approx(expected, rel=1e-9)
    assert list(found) == list(expected)


def test_a_fisheye_of_a_hemisphere_may_leave_the_corners_dark() -> None:
    wide = replace(CAMERA, fx_px=150.0, fy_px=150.0)
    assert is_one_to_one(CAMERA)
    assert is_one_to_one(replace(wide, lens=Lens("fisheye", (), np.pi / 2)))
    assert not is_one_to_one(replace(wide, lens=Lens("fisheye", (), np.pi / 2 - 0.01)))
    assert is_one_to_one(replace(CAMERA, lens=Lens("fisheye", (), 1.0)))
    assert not is_one_to_one(replace(CAMERA, lens=Lens("plumb_bob", (-2.0,))))


def test_the_farthest_corner_and_a_fiftieth_more_must_be_inside_of_a_lens() -> None:
    for cx_px, cy_px in ((322.0, 236.0), (310.0, 236.0), (322.0, 250.0), (310.0, 250.0)):
        farthest = 1.02 * np.hypot(max(cx_px + 0.5, 639.5 - cx_px), max(cy_px + 0.5, 479.5 - cy_px))
        for off_px, expected in ((0.2, True), (-0.2, False)):
            lens = Lens("fisheye", (), (farthest + off_px) / 400)
            camera = Camera(640, 480, 400.0, 400.0, cx_px, cy_px, lens=lens)
            assert is_one_to_one(camera) is expected


def test_a_lens_starts_like_the_one_before() -> None:
    theta = np.linspace(0.0, 0.9, 65)[1:]
    bent = Lens("plumb_bob", (-0.1, 0.02, 0.001, 0.002, -0.004), 1.2)
    for lens, free in ((bent, (0, 1, 4)), (Lens("fisheye", (0.03, -0.01, 0.002, 0.001), 1.2), (0, 1, 2, 3))):
        like = _lens_like(lens, lens.model, free, 0.9)
        assert (like.model, like.max_angle_rad) == (lens.model, 1.2)
        np.testing.assert_allclose(
            [like.coefficients[k] for k in free], [lens.coefficients[k] for k in free], rtol=1e-6
        )
    # Decentring starts at 0.
    like = _lens_like(bent, "plumb_bob", (0, 1, 2, 3, 4), 0.9)
    assert like.coefficients == pytest.approx((-0.1, 0.02, 0.0, 0.0, -0.004), rel=1e-6)
    assert _lens_like(None, "plumb_bob", (), 0.9) == Lens("plumb_bob", (), np.pi)
    pinhole = _lens_like(None, "fisheye", (0, 1, 2, 3), 0.9)
    np.testing.assert_allclose(pinhole.radius(theta), np.tan(theta), rtol=2e-3)
    assert pinhole.max_angle_rad == np.pi
    one = _lens_like(None, "fisheye", (0,), 0.9).coefficients
    assert one == pytest.approx([((np.tan(theta) / theta - 1) @ theta**2) / (theta**2 @ theta**2)])
    # A rational lens starts with a denominator of 1 + r^2 / 2, whose quotient is the lens.
    rational = _lens_like(bent, "rational", (0, 1, 4, 5, 6, 7), 0.9)
    assert rational.coefficients[5:] == (0.5, 0.0, 0.0)
    np.testing.assert_allclose(rational.radius(theta), bent.radius(theta), rtol=2e-3)
    # Beyond 88 deg a perspective has no start.
    wide = Lens("fisheye", ())
    like = _lens_like(wide, "plumb_bob", (0, 1), 1.6)
    angles = np.linspace(0, 1.6, 65)[1:]
    near = angles[angles < np.deg2rad(88)]
    r = np.tan(near)
    expected = np.linalg.lstsq(np.column_stack([r**2, r**4]), near / r - 1, rcond=None)[0]
    assert like.coefficients == pytest.approx(expected.tolist())


@pytest.mark.parametrize(
    "lens",
    [
        Lens("fisheye", (0.03, -0.01, 0.002, 0.001)),
        Lens("plumb_bob", (-0.1, 0.02, 0.001, 0.002, -0.004)),
        Lens("rational", (0.1, 0.02, 0.001, 0.002, 0.01, 0.4, 0.1, 0.02, 0.003, 0.004, 0.005, 0.006)),
    ],
    ids=lambda lens: lens.model,
)
def test_slopes_by_coefficients_are_those_of_differences(lens: Lens) -> None:
    direction = np.array([[0.3, -0.2, 1.1], [-0.25, 0.4, 0.9], [0.1, 0.35, 1.2]])
    h = 1e-6
    columns = []
    for k in range(len(lens.coefficients)):
        both = []
        for sign in (1, -1):
            values = list(lens.coefficients)
            values[k] += sign * h
            both.append(replace(lens, coefficients=tuple(values)).project(direction))
        columns.append((both[0] - both[1]) / (2 * h))
    found = _coefficient_jacobian(lens, direction)
    assert found.shape == (3, 2, 4 if lens.model == "fisheye" else 12)
    np.testing.assert_allclose(found[:, :, : len(columns)], np.stack(columns, axis=-1), rtol=1e-5, atol=1e-8)
