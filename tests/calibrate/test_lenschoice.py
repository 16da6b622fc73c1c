"""The choice of a lens: counts of parameters, the scatter of stars, and the limits of what is tried."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from glstar.calibrate.geometry import lenschoice
from glstar.calibrate.geometry.lenschoice import (
    _CANDIDATES,
    LensCandidate,
    LensTrial,
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


def tries(monkeypatch: pytest.MonkeyPatch, criteria=None, *, fails=lambda candidate: False) -> list[tuple]:
    """Record the lenses that are tried instead of fitting them; `criteria`: by the number of parameters."""
    calls: list[tuple] = []

    def tried(candidate: LensCandidate, free: FreeParameters, start: CameraPoses):
        calls.append((candidate, free, start))
        if fails(candidate):
            return None
        parameters = candidate.parameters(len(free.stars))
        criterion = -20.0 * len(calls) if criteria is None else criteria(candidate)
        poses = CameraPoses(replace(PINHOLE, fx_px=900.0 + len(calls)), start.C_camera_eq)
        return poses, LensTrial(candidate.label, parameters, 0.1, criterion), {"fx_px": float(len(calls))}

    monkeypatch.setattr(lenschoice, "_try_candidate", tried)
    return calls


# Models, coefficients and principal point, from the simplest to the most complicated: k1, k2, p1, p2, k3 of plumb_bob,
# k1 to k4 of a fisheye, and k4 to k6 of the denominator of a rational lens.
TABLE = [
    (None, "", False), (None, "", True), ("plumb_bob", "0", False), ("plumb_bob", "0", True),
    ("plumb_bob", "01", False), ("plumb_bob", "01", True), ("plumb_bob", "014", True), ("plumb_bob", "0123", True),
    ("plumb_bob", "01234", True), ("fisheye", "", False), ("fisheye", "", True), ("fisheye", "0", True),
    ("fisheye", "01", True), ("fisheye", "012", True), ("fisheye", "0123", True), ("rational", "01456", True),
    ("rational", "01234567", True),
]  # fmt: skip


def test_all_lenses_of_a_choice_are_tried_in_order(monkeypatch: pytest.MonkeyPatch) -> None:
    table = [LensCandidate(model, tuple(map(int, free)), point) for model, free, point in TABLE]
    # Rational lenses are tried because a plumb_bob of all parameters is the best of the others.
    calls = tries(monkeypatch, lambda one: 0.0 if one.model == "fisheye" else -20.0 * table.index(one))
    prior = replace(PINHOLE, cx_px=600.0)
    stars = (stars_of(40), stars_of(60))
    both = (solution(k1=-0.1, prior_camera=prior), PlateSolution(PINHOLE, np.eye(3)))
    best = best_lens(stars, both, "auto")
    assert [candidate for candidate, *_ in calls] == table
    _, free, start = calls[0]
    assert (free.prior, free.coefficients, free.principal_point, free.stars) == (prior, (), False, stars)
    assert start.camera.lens == Lens("plumb_bob", (-0.1,))
    assert free.noise_px == tuple(scatter_px(part, start.camera, np.eye(3)) for part in stars)
    assert len(start.C_camera_eq) == 2
    assert (best.candidate, best.sd, best.poses.camera.fx_px) == (table[-1], {"fx_px": 17.0}, 917.0)
    assert [model for _, model in best.trials] == [model for model, *_ in TABLE]
    for choice in ("plumb_bob", "fisheye", "rational", "none"):
        calls = tries(monkeypatch)
        found = best_lens((stars_of(60),), (solution(),), choice)
        allowed = {None} if choice == "none" else {None, choice}
        assert [candidate for candidate, *_ in calls] == [one for one in table if one.model in allowed]
        assert found.candidate.model == (None if choice == "none" else choice)
    # Without a camera before refinement that of the solution, with its k1, is the prior.
    calls.clear()
    best_lens((stars_of(60),), (solution(k1=-0.1),), "none")
    assert calls[0][1].prior.lens == Lens("plumb_bob", (-0.1,))


@pytest.mark.parametrize(("gain", "parameters"), [(9.9, 4), (10.1, 11)])
def test_a_more_complicated_lens_must_gain_ten(gain: float, parameters: int, monkeypatch: pytest.MonkeyPatch) -> None:
    full = LensCandidate("plumb_bob", (0, 1, 2, 3, 4), principal_point=True)
    tries(monkeypatch, lambda candidate: -gain if candidate == full else 0.0)
    assert best_lens((stars_of(60),), (solution(),), "auto").chosen.parameters == parameters


def test_a_choice_without_a_fit_says_whether_one_was_tried(monkeypatch: pytest.MonkeyPatch) -> None:
    tries(monkeypatch, fails=lambda candidate: candidate.model == "fisheye")
    with pytest.raises(CalibrationError, match=r"no fisheye lens projects the 60 identified stars, up to 4\d deg off"):
        best_lens((stars_of(60),), (solution(),), "fisheye")
    # Pinholes are tried for comparison; a rational lens needs 22 stars.
    with pytest.raises(
        CalibrationError, match="20 identified stars are too few, or too near to the middle, to fit a rat"
    ):
        best_lens((stars_of(20),), (solution(),), "rational")
    tries(monkeypatch, fails=lambda candidate: True)
    with pytest.raises(CalibrationError, match="no camera projects the 60 identified stars"):
        best_lens((stars_of(60),), (solution(),), "auto")
    with pytest.raises(CalibrationError, match="no pinhole projects the 60 identified stars"):
        best_lens((stars_of(60),), (solution(),), "none")


def test_a_simple_lens_has_as_many_parameters_as_stars_and_corners_allow(monkeypatch: pytest.MonkeyPatch) -> None:
    calls = tries(monkeypatch, fails=lambda candidate: True)
    fisheye = replace(PINHOLE, lens=Lens("fisheye", (0.1,)))
    few, many = [((0, 1), True), ((0,), True), ((0,), False)], [((0, 1, 2, 3), True), ((0, 1, 2), True)]

    def tried(stars: IdentifiedStars, start: PlateSolution, choice: str) -> list[tuple]:
        calls.clear()
        found = simple_lens(stars, start, choice)
        assert (found.k1, found.prior_camera) == (0.0, start.prior_camera)
        assert {candidate.model for candidate, *_ in calls} <= {"fisheye" if is_fisheye else "plumb_bob"}
        return [(candidate.coefficients, candidate.principal_point) for candidate, *_ in calls]

    is_fisheye = False
    for choice in ("auto", "none", "plumb_bob", "rational"):
        assert tried(stars_of(40), solution(k1=0.05), choice) == few
    # Two stars for each of 8, 7 and 5 parameters.
    assert [len(tried(stars_of(count), solution(), "auto")) for count in (16, 15, 14, 13, 10, 9)] == [3, 2, 2, 1, 1, 0]
    assert tried(stars_of(40, 0.79), solution(), "auto") == few[1:]
    is_fisheye = True
    assert tried(stars_of(40), solution(), "fisheye") == [*many, *few]
    assert tried(stars_of(40, camera=fisheye), solution(fisheye), "auto") == [*many, *few]
    assert [len(tried(stars_of(count), solution(), "fisheye")) for count in (20, 19, 18, 17)] == [5, 4, 4, 3]


def test_a_simple_lens_is_the_first_that_fits(monkeypatch: pytest.MonkeyPatch) -> None:
    calls = tries(monkeypatch, fails=lambda candidate: len(candidate.coefficients) == 2)
    prior = replace(PINHOLE, cx_px=600.0)
    found = simple_lens(stars_of(40), solution(k1=0.05), "auto")
    assert [candidate.coefficients for candidate, *_ in calls] == [(0, 1), (0,)]
    assert (found.camera.fx_px, found.k1, found.prior_camera) == (902.0, 0.0, PINHOLE)
    bent = replace(PINHOLE, lens=Lens("plumb_bob", (0.05,)))
    _, free, start = calls[0]
    assert (free.prior, start.camera) == (bent, bent)
    assert free.noise_px == (scatter_px(stars_of(40), PINHOLE, np.eye(3)),)
    assert simple_lens(stars_of(40), solution(prior_camera=prior), "auto").prior_camera is prior
    assert calls[2][1].prior is prior


@pytest.mark.parametrize("what", ["no minimum", "not one-to-one", "a star outside", None])
def test_a_trial_needs_a_minimum_that_is_one_to_one_and_has_all_stars(what, monkeypatch: pytest.MonkeyPatch) -> None:
    stars = stars_of(40)
    candidate = _CANDIDATES[0]
    free = FreeParameters((stars,), PINHOLE, (0.05,), (), principal_point=False)
    start = CameraPoses(PINHOLE, (np.eye(3),))
    if what == "no minimum":
        monkeypatch.setattr(lenschoice, "fit_parameters", lambda *arguments: None)
    elif what == "not one-to-one":
        monkeypatch.setattr(lenschoice, "is_one_to_one", lambda camera: False)
    elif what == "a star outside":
        stars.apparent[7] *= -1
    found = lenschoice._try_candidate(candidate, free, start)
    assert (found is None) == (what is not None)


def test_a_candidate_of_one_image_starts_from_its_solution(monkeypatch: pytest.MonkeyPatch) -> None:
    calls = tries(monkeypatch)
    prior = replace(PINHOLE, cx_px=600.0)
    candidate = LensCandidate("plumb_bob", (0, 1), principal_point=True)
    camera, sd = fit_candidate(candidate, stars_of(16), solution(prior_camera=prior))
    [(tried, free, start)] = calls
    assert (tried, camera.fx_px, sd, start.camera) == (candidate, 901.0, {"fx_px": 1.0}, PINHOLE)
    assert (free.prior, free.coefficients, free.principal_point) == (prior, (0, 1), True)
    assert free.noise_px == (scatter_px(stars_of(16), PINHOLE, np.eye(3)),)
    assert fit_candidate(candidate, stars_of(15), solution()) is None
    fit_candidate(candidate, stars_of(16), solution())
    assert calls[1][1].prior is PINHOLE
    monkeypatch.setattr(lenschoice, "_try_candidate", lambda *arguments: None)
    assert fit_candidate(candidate, stars_of(16), solution()) is None


def test_stars_within_four_median_distances_count_for_the_scatter() -> None:
    stars = stars_of(40, scatter=0.0)
    rng = np.random.default_rng(3)
    off = rng.normal(0, 0.2, (40, 2))
    off[5] = [6.0, 0.0]  # 4.9 median distances off the cubic that it bends
    noisy = IdentifiedStars(stars.apparent, stars.xy_px + off)
    x, y = ((noisy.xy_px - noisy.xy_px.mean(axis=0)) / noisy.xy_px.std(axis=0)).T
    terms = np.polynomial.polynomial.polyvander2d(x, y, [3, 3])[:, [0, 1, 2, 3, 4, 5, 6, 8, 9, 12]]
    residual = noisy.residual_px(PINHOLE, np.eye(3))
    for _ in range(4):
        rest = residual - terms @ np.linalg.pinv(terms) @ residual
        distance = np.hypot(*rest.T)
        last, near = rest, distance <= 4 * np.median(distance)
        residual, terms = residual[near], terms[near]
    assert len(last) < 40
    assert scatter_px(noisy, PINHOLE, np.eye(3)) == pytest.approx(1.4826 * np.median(np.abs(last)), rel=1e-6)
