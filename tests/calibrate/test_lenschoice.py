"""The choice of a lens: counts of parameters, the scatter of stars, and the limits of what is tried."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from glstar.calibrate.geometry.lenschoice import (
    _CANDIDATES,
    LensCandidate,
    _is_allowed,
    _no_lens,
    _with_k1_as_lens,
    best_lens,
    fit_candidate,
    scatter_px,
    simple_lens,
)
from glstar.calibrate.identify.leastsquares import (
    _SOFT_NOISE,
    CameraPoses,
    FreeParameters,
    IdentifiedStars,
    fit_parameters,
    is_one_to_one,
)
from glstar.calibrate.identify.platesolution import PlateSolution
from glstar.camera.distortion import Lens
from glstar.camera.model import Camera
from glstar.errors import CalibrationError

PINHOLE = Camera(1280, 960, 900.0, 900.0, 639.5, 479.5)
# Distance of the farthest corner from the middle of the image, px.
CORNER_PX = float(np.hypot(640, 480))


def stars_of(count: int, fraction: float = 0.95, scatter: float = 0.05, camera: Camera = PINHOLE) -> IdentifiedStars:
    """Return stars in random places; the outermost lies at a fraction of the distance of the corner."""
    rng = np.random.default_rng(count)
    size = fraction * np.array([640, 480])
    xy = rng.uniform(-0.98, 0.98, (count, 2)) * size
    xy[0] = size
    xy += (639.5, 479.5)
    directions = camera.unit_vectors(xy)
    off = rng.normal(0, scatter, xy.shape)
    off[0] = 0
    return IdentifiedStars(directions, xy + off)


def solution(camera: Camera = PINHOLE, **changes) -> PlateSolution:
    return PlateSolution(camera, np.eye(3), **changes)


@pytest.mark.parametrize(
    ("candidate", "radial", "parameters", "label"),
    [
        (LensCandidate(None, (), principal_point=False), 0, 4, "pinhole"),
        (LensCandidate(None, (), principal_point=True), 0, 6, "pinhole, principal point"),
        (LensCandidate("plumb_bob", (0, 1, 2, 3, 4), principal_point=True), 3, 11, "plumb_bob of 5, principal point"),
        (LensCandidate("fisheye", (0, 1, 2, 3), principal_point=False), 4, 8, "fisheye of 4"),
    ],
)
def test_a_candidate_counts_its_parameters(candidate: LensCandidate, radial, parameters, label) -> None:
    assert (candidate.radial, candidate.label) == (radial, label)
    assert [candidate.parameters(images) for images in (1, 4)] == [parameters, parameters + 9]


def test_a_rational_lens_is_tried_after_all_parameters_of_a_simple_one() -> None:
    rational = _CANDIDATES[-1]
    used = [SimpleNamespace(chosen=SimpleNamespace(parameters=count)) for count in (10, 11, 16, 17)]
    assert [_is_allowed(rational, "auto", best, images=1) for best in used] == [False, True, True, True]
    assert [_is_allowed(rational, "auto", best, images=3) for best in used] == [False, False, False, True]
    assert not _is_allowed(rational, "auto", None, images=1)
    assert _is_allowed(rational, "rational", None, images=1)
    models = {choice: {c.model for c in _CANDIDATES if _is_allowed(c, choice, None, images=1)} for choice in
              ("auto", "none", "fisheye")}  # fmt: skip
    assert models == {"auto": {None, "plumb_bob", "fisheye"}, "none": {None}, "fisheye": {None, "fisheye"}}


def test_the_scatter_is_that_about_a_cubic_polynomial() -> None:
    rng = np.random.default_rng(2)
    stars = stars_of(600, scatter=0.2)
    x, y = ((stars.xy_px - (639.5, 479.5)) / 640).T
    smooth = np.column_stack([3 * x**3 - 0.9 * x * y, 2 * x**2 * y + 4 - y**3])
    bent = IdentifiedStars(stars.apparent, stars.xy_px + smooth)
    assert scatter_px(bent, PINHOLE, np.eye(3)) == pytest.approx(0.2, rel=0.06)
    # False matches have no weight.
    bent.xy_px[rng.choice(600, 40, replace=False)] += rng.uniform(4, 9, (40, 2))
    assert scatter_px(bent, PINHOLE, np.eye(3)) == pytest.approx(0.2, rel=0.06)
    # A bend of the fourth order is not absorbed.
    quartic = IdentifiedStars(stars.apparent, stars.xy_px + 40 * x[:, np.newaxis] ** 4)
    assert scatter_px(quartic, PINHOLE, np.eye(3)) > 1.0


def test_few_stars_have_the_scatter_of_their_residuals() -> None:
    exact = stars_of(16, scatter=0.0)
    shift = np.where(np.arange(16) % 2, 1.0, -1.0)[:, np.newaxis] * [1.0, 1.0]
    few = IdentifiedStars(exact.apparent[:15], (exact.xy_px + shift)[:15])
    # The median of absolute residuals is 1 px.
    assert scatter_px(few, PINHOLE, np.eye(3)) == pytest.approx(1.4826, rel=1e-3)
    assert scatter_px(IdentifiedStars(exact.apparent, exact.xy_px + shift), PINHOLE, np.eye(3)) < 1.4
    # No scatter is smaller than 0.005 px.
    assert scatter_px(exact, PINHOLE, np.eye(3)) == 0.005
    assert scatter_px(IdentifiedStars(exact.apparent[:9], exact.xy_px[:9]), PINHOLE, np.eye(3)) == 0.005


@pytest.mark.parametrize(("fraction", "many"), [(0.79, False), (0.81, True)])
def test_a_second_radial_coefficient_needs_stars_near_the_corner(fraction: float, many: bool) -> None:
    stars = stars_of(60, fraction)
    assert stars.corner_fraction(PINHOLE) == pytest.approx(fraction, abs=1e-9)
    tried = best_lens((stars,), (solution(),), "plumb_bob").trials
    labels = {trial.label.partition(",")[0] for trial, _ in tried}
    assert ("plumb_bob of 2" in labels) == many
    lens = simple_lens(stars, solution(), "plumb_bob").camera.lens
    assert len(np.flatnonzero(lens.coefficients)) == (2 if many else 1)


@pytest.mark.parametrize(("count", "parameters"), [(8, 4), (9, 4), (10, 5), (11, 5), (12, 6), (21, 10), (22, 11)])
def test_two_stars_are_needed_for_each_parameter(count: int, parameters: int) -> None:
    tried = best_lens((stars_of(count, 0.9),), (solution(),), "auto").trials
    assert max(trial.parameters for trial, _ in tried) == parameters


def test_too_few_stars_are_counted() -> None:
    with pytest.raises(CalibrationError, match="7 identified stars are too few") as raised:
        best_lens((stars_of(7),), (solution(),), "auto")
    assert (raised.value.stars_used, raised.value.stars_needed) == (7, 8)
    message = str(_no_lens("fisheye", 40, np.deg2rad(61.0), attempted=True))
    assert "no fisheye lens projects the 40 identified stars, up to 61 deg off" in message
    candidate = LensCandidate(None, (), principal_point=False)
    assert fit_candidate(candidate, stars_of(7), solution()) is None
    camera, sd = fit_candidate(candidate, stars_of(8), solution())
    assert abs(camera.fx_px - 900) < 5 * sd["fx_px"]


def test_trials_have_the_criterion_of_bayes() -> None:
    stars = stars_of(80)
    best = best_lens((stars,), (solution(),), "none")
    (first, _), _ = best.trials
    noise_px = scatter_px(stars, PINHOLE, np.eye(3))
    free = FreeParameters((stars,), PINHOLE, (noise_px,), (), principal_point=False)
    fit = fit_parameters(free, CameraPoses(PINHOLE, (np.eye(3),)), None)
    off = stars.residual_px(fit.state.camera, fit.state.C_camera_eq[0])
    scaled = off / noise_px / _SOFT_NOISE
    robust = _SOFT_NOISE**2 * np.sum(2 * (np.sqrt(1 + scaled**2) - 1))  # SciPy's soft_l1
    assert first.criterion == pytest.approx(80 * np.log(robust / 80) + 4 * np.log(80), rel=1e-9)
    assert first.rms_px == pytest.approx(np.sqrt((off**2).sum() / 80), rel=1e-9)
    # The pinhole that made the stars is chosen although the other one fits as well.
    assert (best.candidate, best.chosen.parameters) == (_CANDIDATES[0], 4)


def test_the_k1_of_a_solution_is_its_lens_if_it_has_none() -> None:
    stars = (stars_of(20),)
    attitudes = (np.eye(3),)
    assert _with_k1_as_lens(stars, PINHOLE, attitudes, 0.0) is PINHOLE
    assert _with_k1_as_lens(stars, PINHOLE, attitudes, -0.1).lens.coefficients == (-0.1,)
    bent = replace(PINHOLE, lens=Lens("fisheye", ()))
    assert _with_k1_as_lens(stars, bent, attitudes, -0.1) is bent
    # r (1 - 2 r^2) turns back at r = 0.41, and the outermost star is at 0.84.
    assert _with_k1_as_lens(stars, PINHOLE, attitudes, -2.0) is PINHOLE


@pytest.mark.parametrize(
    ("lens", "coefficients"),
    [
        (None, ()),
        (Lens("plumb_bob", (-0.2, 0.05, 0.001, -0.002, 0.01)), (0, 1, 2, 3, 4)),
        (Lens("rational", (0.1, 0.02, 0.001, 0.002, 0.01, 0.4, 0.1, 0.02)), (0, 1, 4, 5, 6, 7)),
        (Lens("fisheye", (0.01, 0.02, 0.0, 0.0)), (0, 1, 2, 3)),
    ],
    ids=["pinhole", "plumb_bob", "rational", "fisheye"],
)
def test_the_slopes_of_two_images_are_those_of_steps(lens: Lens | None, coefficients: tuple[int, ...]) -> None:
    """Each parameter is moved a little up and down; the priors are rows of their own."""
    camera = Camera(1280, 960, 900.0, 905.0, 620.0, 490.0, 2.0, lens)
    stars = tuple(stars_of(count) for count in (9, 12))
    free = FreeParameters(stars, PINHOLE, (0.5, 0.25), coefficients, principal_point=True)
    turned = np.array([[0.96, -0.28, 0], [0.28, 0.96, 0], [0, 0, 1]])
    state = CameraPoses(camera, (np.eye(3), turned))
    residual, slopes = free.residuals(state)
    denominator = sum(5 <= k <= 7 for k in coefficients)
    assert residual.shape == (2 * 21 + 2 + denominator,)
    assert slopes.shape == (len(residual), 6 + 3 + len(coefficients))
    nudges = 1e-6 * np.eye(slopes.shape[1])
    numerical = np.stack(
        [
            (free.residuals(free.stepped(state, nudge))[0] - free.residuals(free.stepped(state, -nudge))[0]) / 2e-6
            for nudge in nudges
        ],
        axis=-1,
    )
    np.testing.assert_allclose(slopes, numerical, rtol=1e-5, atol=1e-3)
    # Positions over the noise of their image; the principal point over 2 % of the width; k4 about 0.5 +- 0.3.
    predicted = camera.project(stars[1].apparent @ turned.T) - stars[1].xy_px
    np.testing.assert_allclose(residual[18:42], predicted.ravel() / 0.25, rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(residual[42:44], [-19.5 / 25.6, 10.5 / 25.6], rtol=1e-9)
    if denominator:
        np.testing.assert_allclose(residual[44:], [-1 / 3, 1 / 3, 0.2 / 3], rtol=1e-9)
    moved = free.stepped(state, np.eye(slopes.shape[1])[6] * 9.0).camera
    assert (moved.fx_px, moved.fy_px) == pytest.approx((900 * np.e, 905 * np.e))  # a step of ln f ends at 1


def test_a_star_outside_of_a_lens_has_a_large_constant_residual() -> None:
    stars = stars_of(6)
    behind = IdentifiedStars(np.vstack([stars.apparent, [0, 0, -1]]), np.vstack([stars.xy_px, [3, 4]]))
    free = FreeParameters((behind,), PINHOLE, (0.5,), (), principal_point=False)
    residual, slopes = free.residuals(CameraPoses(PINHOLE, (np.eye(3),)))
    assert residual[-2:].tolist() == [2560.0, 2560.0]
    assert not slopes[-2:].any()
    assert np.abs(residual[:-2]).max() < 2


@pytest.mark.parametrize(("factor", "expected"), [(1.015, False), (1.025, True)])
def test_a_lens_is_one_to_one_to_a_fiftieth_beyond_the_border(factor: float, expected: bool) -> None:
    """A barrel with k1 = -c turns back at r^2 = 1 / (3 c), where the image has the radius 2 r / 3."""
    turn = factor * 1.5 * CORNER_PX / 900
    camera = replace(PINHOLE, lens=Lens("plumb_bob", (-1 / (3 * turn**2),)))
    assert is_one_to_one(camera) == expected
    assert is_one_to_one(PINHOLE)
