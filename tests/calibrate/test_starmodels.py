"""The image of a star and its fit, against integration, finite differences and SciPy's least squares."""

import numpy as np
import pytest
from scipy.integrate import quad
from scipy.optimize import least_squares, rosen, rosen_der

from glstar.calibrate.minimise import Minimum, minimise, minimise_each
from glstar.calibrate.photo import psf
from glstar.calibrate.photo.psf import (
    FittedStars,
    _axis,
    _exposure_samples,
    _first_guess,
    _Model,
    _stamps,
    _step,
    dilution,
    draw_stars,
    drawn_out_px,
    fit_stars,
    profile,
    star_shapes,
)
from glstar.camera.sensor.sensor import MIN_WIDENED_SIGMA_PX, PIXEL_VARIANCE_PX2

NONE = np.zeros((1, 2))


def gaussian(x: float, sigma: float) -> float:
    return float(np.exp(-(x**2) / (2 * sigma**2)))


@pytest.mark.parametrize("sigma_px", [0.5, 1.0, 1.1, 2.5])
def test_a_profile_is_the_integral_over_a_pixel(sigma_px: float) -> None:
    offsets = np.array([-2.3, -0.4, 0.0, 0.7, 3.1])
    integral = [quad(gaussian, x - 0.5, x + 0.5, args=(sigma_px,))[0] for x in offsets]
    # From 1.1 px up a widened Gaussian is within a percent of it.
    tolerance = 1e-9 if sigma_px < 1.1 else 0.006
    np.testing.assert_allclose(profile(offsets, sigma_px), integral, rtol=0, atol=tolerance)
    if sigma_px >= 1.1:
        variance = sigma_px**2 + 1 / 12
        widened = sigma_px / np.sqrt(variance) * np.exp(-(offsets**2) / (2 * variance))
        np.testing.assert_allclose(profile(offsets, sigma_px), widened, rtol=1e-3)


@pytest.mark.parametrize("widened", [True, False])
def test_derivatives_of_a_profile_are_those_of_differences(widened: bool) -> None:
    offset, sigma, h = np.linspace(-3, 3, 13), np.array(1.3), 1e-6
    g, by_position, by_log_sigma = _axis(offset, sigma, widened=widened)
    moved = [_axis(offset - s * h, sigma, widened=widened)[0] for s in (1, -1)]
    wider = [_axis(offset, sigma * np.exp(s * h), widened=widened)[0] for s in (1, -1)]
    np.testing.assert_allclose(by_position, (moved[0] - moved[1]) / (2 * h), rtol=1e-6, atol=1e-9)
    np.testing.assert_allclose(by_log_sigma, (wider[0] - wider[1]) / (2 * h), rtol=1e-6, atol=1e-9)
    assert g[6] == pytest.approx(quad(gaussian, -0.5, 0.5, args=(1.3,))[0], rel=2e-3)


def test_a_trail_dilutes_the_peak_like_the_mean_over_its_path() -> None:
    trails = np.array([[0.0, 0], [3, 4], [-1.2, 0.5]])
    lengths = np.linalg.norm(trails, axis=1)
    expected = [1.0, *(quad(gaussian, -n / 2, n / 2, args=(1.4,))[0] / n for n in lengths[1:])]
    np.testing.assert_allclose(dilution(trails, 1.4), expected, rtol=1e-9)


@pytest.mark.parametrize("sigma_px", [0.8, 1.5])
def test_stars_are_drawn_at_their_positions_to_a_thousandth_of_a_dn(sigma_px: float) -> None:
    xy, peak = np.array([[10.3, 8.6], [0.2, 19.9], [40.0, 5.0]]), np.array([500.0, 80.0, 1e4])
    drawn = draw_stars((20, 30), xy, peak, sigma_px)
    rows, columns = np.indices((20, 30))
    expected = sum(
        p * profile(columns - x, sigma_px) * profile(rows - y, sigma_px) for (x, y), p in zip(xy, peak, strict=True)
    )
    np.testing.assert_allclose(drawn, expected, rtol=0, atol=1.5e-3)
    assert drawn[9, 10] == pytest.approx(expected[9, 10], rel=1e-9)
    # A moving star is the mean of many at rest.
    trail = np.array([[6.0, -3.0]])
    moving = draw_stars((20, 30), np.array([[14.0, 9.0]]), np.array([800.0]), sigma_px, trail_px=trail)
    steps = (np.arange(400) + 0.5) / 400 - 0.5
    mean = draw_stars((20, 30), [14.0, 9.0] + steps[:, np.newaxis] * trail, np.full(400, 800.0 / 400), sigma_px)
    np.testing.assert_allclose(moving, mean, rtol=0, atol=0.35)
    assert moving.sum() == pytest.approx(800 * 2 * np.pi * sigma_px**2, rel=2e-3)
    widths = draw_stars((20, 30), xy[:2], peak[:2], np.array([0.8, 1.5]))
    both = sum(draw_stars((20, 30), xy[[k]], peak[[k]], s) for k, s in enumerate((0.8, 1.5)))
    np.testing.assert_allclose(widths, both, rtol=1e-12)


def test_samples_of_a_trail_integrate_over_the_exposure() -> None:
    assert _exposure_samples(np.zeros((3, 2)), 1.0)[0].tolist() == [0.0]
    steps, weights = _exposure_samples(np.array([[0.0, 0], [6, 8]]), 2.0)
    assert len(steps) == 2 + 5
    for power in range(6):
        assert weights @ steps**power == pytest.approx((1 - (power % 2)) / (power + 1) / 2**power)
    assert len(_exposure_samples(np.array([[3.0, 0]]), 0.1)[0]) == 2 + 10


def test_normal_equations_are_those_of_finite_differences() -> None:
    rng = np.random.default_rng(3)
    stamps = rng.normal(100, 5, (2, 9, 9))
    weights = (rng.random((2, 9, 9)) > 0.1).astype(float)
    trail = np.array([[2.0, 1.0], [-1.5, 2.5]])
    p = np.array([[60.0, 4.2, 3.8, np.log(1.3), 98.0], [90.0, 3.6, 4.4, np.log(1.6), 101.0]])
    model = _Model(stamps, weights, trail, _exposure_samples(trail, 1.3), True, True)
    cost, gradient, normal = model.normal_equations(p)

    def residual(k: int, v: np.ndarray) -> np.ndarray:
        drawn = draw_stars((9, 9), v[np.newaxis, 1:3], v[:1], float(np.exp(v[3])), trail_px=trail[[k]]) + v[4]
        return ((stamps[k] - drawn) * weights[k]).ravel()

    for k in range(2):
        J = np.column_stack([
            -(residual(k, p[k] + h) - residual(k, p[k] - h)) / (2 * h.sum()) for h in np.diag([1, 1e-3, 1e-3, 1e-3, 1])
        ])[:, [0, 1, 2, 4, 3]]  # fmt: skip
        assert cost[k] == pytest.approx((residual(k, p[k]) ** 2).sum(), rel=1e-3)
        np.testing.assert_allclose(gradient[k], J.T @ residual(k, p[k]), rtol=0.02, atol=2.0)
        np.testing.assert_allclose(normal[k], J.T @ J, rtol=0.01, atol=3.0)
    # A part of the problems; and of these with a fixed width all but the last parameter.
    part = model.some(np.array([1])).normal_equations(p[1:])
    np.testing.assert_allclose(part[2], normal[1:], rtol=1e-7)
    fixed = _Model(stamps, weights, trail, _exposure_samples(trail, 1.3), True, False).normal_equations(p)
    np.testing.assert_allclose(fixed[2], normal[:, :4, :4], rtol=1e-7)


@pytest.mark.parametrize("fixed", [False, True])
def test_fits_agree_with_those_of_scipy(fixed: bool) -> None:
    rng = np.random.default_rng(8)
    xy, peak = np.array([[15.3, 14.7], [24.2, 15.6], [50.4, 30.2]]), np.array([300.0, 200.0, 150.0])
    image = draw_stars((45, 65), xy, peak, 1.5) + 50 + rng.normal(0, 4, (45, 65))
    usable = np.ones(image.shape, bool)
    usable[15, 15] = False
    start = xy + rng.uniform(-0.5, 0.5, (3, 2))
    found = fit_stars(image, usable, start, start_sigma_px=1.4, sigma_px=1.5 if fixed else None)

    half = int(np.ceil(4 * np.hypot(1.5 if fixed else 1.4, 0.3))) + 1
    rows, columns = np.indices(image.shape)
    distance = np.hypot(columns - start[:, :1, np.newaxis], rows - start[:, 1:, np.newaxis])
    for k in range(3):
        x, y = np.rint(start[k])
        own = (np.abs(columns - x) <= half) & (np.abs(rows - y) <= half) & usable & (distance.argmin(axis=0) == k)

        def residual(v: np.ndarray, own: np.ndarray = own) -> np.ndarray:
            sigma = 1.5 if fixed else float(np.exp(v[4]))
            return ((v[0] * profile(columns - v[1], sigma) * profile(rows - v[2], sigma)) + v[3] - image)[own]

        fit = least_squares(residual, [*(peak[k], *xy[k], 50.0), *([] if fixed else [np.log(1.5)])], xtol=1e-12)
        free = len(fit.x)
        misfit = np.sqrt(2 * fit.cost / (own.sum() - free))
        std = misfit * np.sqrt(np.diag(np.linalg.inv(fit.jac.T @ fit.jac)))
        assert found.peak_dn[k] == pytest.approx(fit.x[0], rel=1e-4)
        assert tuple(found.xy_px[k]) == pytest.approx(tuple(fit.x[1:3]), abs=1e-3)
        assert (found.sky_dn[k], found.misfit_dn[k]) == pytest.approx((fit.x[3], misfit), rel=1e-4)
        assert found.peak_sd_dn[k] == pytest.approx(std[0], rel=1e-3)
        assert found.sigma_px[k] == pytest.approx(1.5 if fixed else np.exp(fit.x[4]), rel=1e-3)
        assert found.ln_sigma_sd[k] == pytest.approx(0 if fixed else std[4], rel=1e-3)
        assert found.converged[k]
    # Only some stars: the others keep their pixels.
    some = fit_stars(image, usable, start, start_sigma_px=1.4, sigma_px=1.5 if fixed else None, only=np.array([2, 1]))
    np.testing.assert_allclose(some.peak_dn, found.peak_dn[[2, 1]], rtol=1e-9)
    np.testing.assert_allclose(some.xy_px, found.xy_px[[2, 1]], rtol=1e-9)


@pytest.mark.parametrize("sigma_px", [0.7, 1.6])
def test_the_model_of_the_width_found_is_used_whatever_the_start(sigma_px: float) -> None:
    trail = np.array([[4.0, 2.0], [4.0, 2.0]])
    xy = np.array([[20.4, 18.7], [50.1, 21.2]])
    image = 10 + draw_stars((45, 70), xy, np.array([400.0, 900.0]), sigma_px, trail_px=trail)
    found = fit_stars(image, np.ones(image.shape, bool), xy + 0.3, start_sigma_px=1.1, trail_px=trail)
    np.testing.assert_allclose(found.sigma_px, sigma_px, rtol=2e-3)
    np.testing.assert_allclose(found.peak_dn, [400, 900], rtol=3e-3)
    np.testing.assert_allclose(found.xy_px, xy, rtol=0, atol=1e-3)
    assert len(fit_stars(image, np.ones(image.shape, bool), np.zeros((0, 2)), start_sigma_px=1.1)) == 0


@pytest.mark.parametrize(
    ("lengths", "half"),
    [
        ({}, np.ceil(4 * np.hypot(1.4, 0.3)) + 1),
        ({"trail_px": np.array([[6.0, 8.0], [0, 1]])}, np.ceil(4 * np.hypot(1.4, 0.3) + 5) + 1),
        ({"stamp_trail_px": np.array([[0, 1], [12.0, 0]])}, np.ceil(4 * np.hypot(1.4, 0.3) + 6) + 1),
    ],
)
def test_stamps_are_as_large_as_stars_and_trails(lengths, half, monkeypatch: pytest.MonkeyPatch) -> None:
    halves = []

    def recorded(image, usable, xy, half, only):
        halves.append(half)
        return _stamps(image, usable, xy, half, only)

    monkeypatch.setattr(psf, "_stamps", recorded)
    xy = np.array([[30.0, 30.0], [60.0, 30.0]])
    fit_stars(
        draw_stars((60, 90), xy, np.full(2, 99.0), 1.4), np.ones((60, 90), bool), xy, start_sigma_px=1.4, **lengths
    )
    assert halves == [half]


@pytest.mark.parametrize(("pixels", "is_enough"), [(8, False), (9, True)])
def test_a_fit_needs_more_than_twice_as_many_pixels_as_parameters(pixels: int, is_enough: bool) -> None:
    xy = np.array([[10.2, 9.9]])
    image = draw_stars((20, 20), xy, np.array([500.0]), 1.3) + 7
    usable = np.zeros((20, 20), bool)
    usable[9:12, 9:12] = True
    usable[9, 9] = pixels == 9
    found = fit_stars(image, usable, xy, start_sigma_px=1.3, sigma_px=1.3)
    assert found.converged.tolist() == [is_enough]
    assert found.peak_dn[0] == pytest.approx(500, rel=1e-3)


def test_stamps_hold_the_pixels_nearest_to_their_star() -> None:
    rng = np.random.default_rng(5)
    image, usable = rng.normal(0, 1, (30, 40)), rng.random((30, 40)) > 0.1
    xy = np.array([[2.4, 3.2], [9.1, 5.4], [20.0, 20.0], [20.0, 20.0], [39.4, 29.3], [12.5, 12.2]])
    corner, stamps, weights = _stamps(image, usable, xy, 6, np.array([1, 4, 0, 2]))
    for k, star in enumerate([1, 4, 0, 2]):
        assert corner[k].tolist() == (np.rint(xy[star]) - 6).tolist()
        for j in range(13):
            for i in range(13):
                x, y = corner[k] + [i, j]
                inside = 0 <= x < 40 and 0 <= y < 30
                own = np.hypot(*(xy - [x, y]).T)
                expected = inside and usable[int(y), int(x)] and own[star] <= own.min() + 1e-12
                assert bool(weights[k, j, i]) == bool(expected)
                if inside:
                    assert stamps[k, j, i] == image[int(y), int(x)]


def test_start_values_are_the_brightest_pixel_and_the_median() -> None:
    stamps = np.full((2, 3, 3), 7.0)
    stamps[0, 1, 1], stamps[0, 0, 0] = 50.0, 99.0
    weights = np.ones((2, 3, 3))
    weights[0, 0, 0] = 0
    weights[1] = 0
    guess = _first_guess(stamps, weights, np.array([[1.0, 1.2], [0.9, 1.0]]), 2.0)
    np.testing.assert_allclose(guess, [[43, 1, 1.2, np.log(2), 7], [1e-3, 0.9, 1, np.log(2), 0]], rtol=1e-7)


def test_steps_of_position_and_width_are_limited() -> None:
    step = _step(np.array([[100.0, 3.0, -0.4, 5.0, -0.9]]), width_free=True)
    assert step.tolist() == [[100.0, 1.0, -0.4, -0.5, 5.0]]
    assert _step(np.array([[100.0, -3.0, 0.4, 5.0]]), width_free=False).tolist() == [[100.0, -1.0, 0.4, 0.0, 5.0]]


def test_the_bias_of_noise_is_subtracted_down_to_three_sigma() -> None:
    n = np.ones(3)
    stars = FittedStars(
        xy_px=np.zeros((3, 2)),
        peak_dn=np.array([100.0, 20.0, 40.0]),
        peak_sd_dn=np.full(3, 10.0),
        sigma_px=np.array([1.0, 2.0, 1.0]),
        ln_sigma_sd=np.array([0.1, 0.2, 0.9]),
        sky_dn=n,
        misfit_dn=n,
        converged=n > 0,
    )
    np.testing.assert_allclose(stars.unbiased_peak_dn, [99, 20 - 100 / 30, 37.5], rtol=1e-7)
    fraction = np.array([1, 4, 1]) / (np.array([1, 4, 1]) + PIXEL_VARIANCE_PX2)
    np.testing.assert_allclose(stars.unbiased_sigma_px, [1, 2, 1] * np.exp(fraction * [0.01, 0.04, 1 / 9]), rtol=1e-7)
    assert MIN_WIDENED_SIGMA_PX == 1.1


def turned_star(shape, x, y, long_px, short_px, angle_rad, flux=1e4):
    rows, columns = np.indices(shape)
    along = (columns - x) * np.cos(angle_rad) + (rows - y) * np.sin(angle_rad)
    across = -(columns - x) * np.sin(angle_rad) + (rows - y) * np.cos(angle_rad)
    return flux * np.exp(-0.5 * ((along / long_px) ** 2 + (across / short_px) ** 2))


def test_shapes_of_stars_are_their_second_moments() -> None:
    truth = [(3.0, 1.6, 0.5), (2.0, 2.0, 0.0), (2.5, 1.5, -1.1)]
    centres = [(40.3, 45.8), (110.6, 50.2), (180.1, 44.7)]
    image = sum(turned_star((95, 240), *at, *shape) for at, shape in zip(centres, truth, strict=True))
    usable = np.ones(image.shape, bool)
    usable[50, 213] = False
    near = np.array([[18.0, 40.0], *centres, [216.0, 50.0], [225.0, 40.0], [120.0, 76.0], [120.0, 18.0]]) + 0.4
    xx, yy, xy = star_shapes(image, usable, near[[0, 1, 2, 3, 5, 6, 7]], 1.8)
    covariance = []
    for long_px, short_px, angle in truth:
        axes = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
        covariance.append(axes @ np.diag([long_px**2, short_px**2]) @ axes.T)
    c = np.array(covariance)
    np.testing.assert_allclose(
        np.column_stack([xx, yy, xy]), np.column_stack([c[:, 0, 0], c[:, 1, 1], c[:, 0, 1]]), rtol=0.01, atol=0.01
    )
    # 20 px around a star must lie on the image and be usable.
    assert len(star_shapes(image, usable, np.array([[193.0, 45.0]]), 1.8)[0]) == 0
    assert len(star_shapes(image, usable, np.array([[180.0, 45.0]] * 130), 1.8)[0]) == 120
    assert len(star_shapes(image, usable, np.array([[20.0, 45.0], [110.0, 74.0]]), 1.8)[0]) <= 2


def field(axes_of) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(2)
    at = np.array([(x, y) for x in range(30, 400, 45) for y in range(30, 120, 45)], float) + rng.uniform(-3, 3, (18, 2))
    image = sum(turned_star((130, 430), *xy, *axes_of(k)) for k, xy in enumerate(at))
    return image, at


@pytest.mark.parametrize(
    ("axes_of", "length_px"),
    [
        (lambda k: (3.0, 1.5, 0.6), np.sqrt(11 * (9 - 2.25))),
        (lambda k: (1.84, 1.5, 0.6), 0.0),  # the ratio of the widths is below 1.25
        (lambda k: (1.92, 1.5, 0.6), np.sqrt(11 * (1.92**2 - 2.25))),  # and above it
        # Aberrations in all directions are no motion.
        (lambda k: (3.0, 1.5, k * np.pi / 18), 0.0),
        (lambda k: (3.0, 1.5, 0.6 if k % 9 < 5 else 0.6 + np.pi / 2), np.sqrt(11 * (9 - 2.25))),  # more than half
    ],
)
def test_trails_are_alike_and_longer_than_wide(axes_of, length_px: float) -> None:
    image, at = field(axes_of)
    found = drawn_out_px(image, np.ones(image.shape, bool), at, 1.8)
    assert found == pytest.approx(length_px, rel=0.02)
    assert drawn_out_px(image, np.ones(image.shape, bool), at[:5], 1.8) is None
    assert drawn_out_px(image, np.ones(image.shape, bool), at[:6], 1.8) is not None


@pytest.mark.parametrize("scale", [0.5, np.inf])
def test_a_robust_minimum_is_that_of_scipy(scale: float) -> None:
    rng = np.random.default_rng(4)
    t = np.linspace(0, 3, 40)
    y = 2.0 * np.exp(-0.7 * t) + 0.3 + rng.normal(0, 0.05, 40)
    y[::9] += 2.0

    def residual(v: np.ndarray) -> np.ndarray:
        return (v[0] * np.exp(-v[1] * t) + v[2] - y) / 0.05

    def slopes(v: np.ndarray) -> np.ndarray:
        e = np.exp(-v[1] * t)
        return np.column_stack([e, -v[0] * t * e, np.ones(40)]) / 0.05

    loss = {"loss": "linear"} if scale == np.inf else {"loss": "soft_l1", "f_scale": scale}
    expected = least_squares(residual, [1.0, 1.0, 0.0], jac=slopes, xtol=1e-14, ftol=1e-14, gtol=1e-14, **loss)
    evaluations = []

    def measured(v: np.ndarray):
        evaluations.append(v)
        return residual(v), slopes(v)

    found = minimise(np.array([1.0, 1.0, 0.0]), measured, np.add, scale=scale)
    np.testing.assert_allclose(found.state, expected.x, rtol=1e-4)
    # Near the minimum the curvature of the loss makes it converge as fast as least squares.
    assert len(evaluations) <= (10 if scale < 1 else 12)
    assert found.cost == pytest.approx(expected.cost, rel=1e-8)


def test_the_information_of_a_minimum_weighs_residuals_by_their_scale() -> None:
    residual, slopes, scale = (
        np.array([0.0, 3.0, -4.0]),
        np.array([[1.0, 2], [0, 1], [3, -1]]),
        np.array([1.0, 4.0, 3.0]),
    )
    found = Minimum(None, residual, slopes, scale)
    root = np.array([1, 1.25, 5 / 3])
    np.testing.assert_allclose(found.root, root, rtol=1e-7)
    # SciPy's soft_l1: the scale squared times (root - 1).
    assert found.cost == pytest.approx((scale**2 * (root - 1)).sum())
    weight = np.diag((root + 1) / (2 * root**2))
    np.testing.assert_allclose(found.information, slopes.T @ weight @ slopes, rtol=1e-7)


def test_many_problems_are_solved_at_once_each_to_its_minimum() -> None:
    """Rosenbrock's valleys, from different starts; a limit keeps the last one out of its minimum."""
    starts = np.array([[-1.2, 1.0], [0.0, 0.0], [2.0, 3.0], [3.0, -2.0]])
    calls = []

    def equations(p: np.ndarray, k: np.ndarray):
        calls.append(k.tolist())
        r = np.column_stack([1 - p[:, 0], 10 * (p[:, 1] - p[:, 0] ** 2)])
        J = np.zeros((len(p), 2, 2))  # of the model: data minus model is r
        J[:, 0, 0], J[:, 1, 0], J[:, 1, 1] = 1, 20 * p[:, 0], -10
        assert np.sum(r**2, axis=1) == pytest.approx([rosen(one) for one in p])
        gradient = np.einsum("nij,ni->nj", J, r)
        assert gradient == pytest.approx(np.array([-rosen_der(one) / 2 for one in p]))
        return np.sum(r**2, axis=1), gradient, np.einsum("nij,nik->njk", J, J)

    p, cost, normal, converged = minimise_each(
        starts, equations, lambda step: np.abs(step).max(axis=1) < 1e-8, bounded=lambda p: p, most_steps=100
    )
    np.testing.assert_allclose(p, 1.0, rtol=0, atol=1e-6)
    assert converged.all()
    assert (cost < 1e-12).all()
    np.testing.assert_allclose(normal[0], [[401, -200], [-200, 100]], rtol=1e-5)
    assert calls[0] == [0, 1, 2, 3]
    assert len(calls[-1]) < 4
    assert starts[0].tolist() == [-1.2, 1.0]
    assert not minimise_each(starts, equations, lambda step: np.abs(step).max(axis=1) < 1e-8, most_steps=2)[3].any()
