"""Which parameters a joint fit of stars takes, by scripted costs, and what its last fit leaves out."""

from dataclasses import replace

import numpy as np
import pytest

from glstar.calibrate.sensor import jointpsf
from glstar.calibrate.sensor.jointpsf import (
    StarStamps,
    _Shape,
)
from glstar.camera.sensor.pointspread import PointSpread
from tests.support.handmade import stamps_of


def chosen(
    monkeypatch: pytest.MonkeyPatch,
    gains: dict[str, float],
    *,
    never: set = frozenset(),
    not_yet: set = frozenset(),
    late: set = frozenset(),
):
    """Return the fit of stamps whose cost falls by a gain for each group, the trials of it, and the cost.

    Groups of `never` are not determined; those of `not_yet` are determined once others are in the fit.
    """
    stamps = stamps_of(4, side=21)
    free = 4 * 441 - 20
    trials: list[tuple[str, ...]] = []

    def fitted(stamps: StarStamps, names: tuple[str, ...], start: _Shape):
        trials.append(names)
        return start, stamps, free - sum(gain for name, gain in gains.items() if name in names)

    def unclear(stamps: StarStamps, names: tuple[str, ...], shape: _Shape, covariance: np.ndarray) -> dict:
        assert covariance.shape == (len(names),) * 2
        hidden = never | (not_yet if len(names) <= 3 else set())
        # The covariance of the last fit has the difference of bright and faint stars in it.
        hidden = hidden | (late if covariance[0, 0] > 2e-4 else set())
        return {
            group: f"{group[0]} is unclear" for group in jointpsf._GROUPS if group[0] in names and group[0] in hidden
        }

    monkeypatch.setattr(jointpsf, "_fitted", fitted)
    monkeypatch.setattr(jointpsf, "_unclear", unclear)
    monkeypatch.setattr(jointpsf, "_covariance", lambda _, names, __: np.eye(len(names)) * 1e-4)
    monkeypatch.setattr(jointpsf, "_between_halves", lambda _, names, __: np.eye(len(names)) * 3e-4)
    monkeypatch.setattr(jointpsf, "_without_outliers", lambda stamps, _: stamps)
    monkeypatch.setattr(jointpsf, "_without_position_bias", lambda _, __, shape: shape)
    joint, _ = jointpsf.fit_joint_psf(stamps, 1.3)
    return joint, trials, free - sum(gain for name, gain in gains.items() if name in trials[-1])


def test_a_gaussian_is_left_if_nothing_lowers_the_residuals(monkeypatch: pytest.MonkeyPatch) -> None:
    joint, trials, cost = chosen(monkeypatch, {})
    assert (joint.psf, joint.sigma_px, joint.refused, joint.stars) == (PointSpread(), 1.3, (), 4)
    # Twice the root of 1e-4: both parts of the covariance add up.
    assert joint.standard_error == {"psf_sigma_px": pytest.approx(1.3 * 0.02)}
    assert joint.misfit == pytest.approx(np.sqrt(cost / (4 * 441 - 16)), rel=1e-12)
    names = [
        ("beta",),
        ("wing", "ln_wing_px"),
        ("wing", "ln_wing_px"),
        ("growth",),
        ("tilt_x", "tilt_y"),
        ("colour",),
        ("e1", "e2"),
    ]
    assert trials == [("sigma",), *(("sigma", *group) for group in names), ("sigma",)]


@pytest.mark.parametrize(
    ("gains", "keys"),
    [
        ({"growth": 12.2}, {"growth"}),
        ({"growth": 11.7}, set()),
        ({"tilt_x": 24.3}, {"tilt_x", "tilt_y"}),
        ({"tilt_x": 23.5}, set()),
        ({"beta": 12.2}, {"beta"}),
        ({"wing": 24.3}, {"wing", "ln_wing_px"}),
        ({"wing": 23.5}, set()),
        # The better of two profiles, less a thousandth for each parameter; then the other if it explains more.
        ({"beta": 40.0, "wing": 30.0}, {"beta", "wing", "ln_wing_px"}),
        ({"colour": 13.0, "e1": 25.0, "growth": 13.0}, {"growth", "colour", "e1", "e2"}),
    ],
)
def test_a_group_must_lower_the_residuals_by_twelve_for_each_parameter(
    monkeypatch: pytest.MonkeyPatch, gains: dict, keys: set
) -> None:
    _, trials, _ = chosen(monkeypatch, gains)
    assert set(trials[-1]) == {"sigma", *keys}


@pytest.mark.parametrize(("wing", "first"), [(101.5, "beta"), (102.1, "wing")])
def test_the_better_profile_is_taken_first(monkeypatch: pytest.MonkeyPatch, wing: float, first: str) -> None:
    """Of costs near 1645 a thousandth is 1.64 to 1.65: a profile with one parameter more must be better by that."""
    _, trials, _ = chosen(monkeypatch, {"beta": 100.2, "wing": wing})
    assert trials[-1][1] == first


def test_a_group_that_is_not_determined_is_refused_with_its_reason(monkeypatch: pytest.MonkeyPatch) -> None:
    joint, trials, _ = chosen(monkeypatch, {"growth": 50.0, "colour": 50.0}, never={"growth"})
    assert joint.refused == ("growth is unclear",)
    assert trials[-1] == ("sigma", "colour")
    # One that the last fit does not determine is taken out again.
    joint, trials, _ = chosen(monkeypatch, {"wing": 50.0, "growth": 50.0, "colour": 50.0}, late={"wing"})
    assert (trials[-1], joint.refused) == (("sigma", "growth", "colour"), ("wing is unclear",))
    assert joint.psf == PointSpread()
    # The reason of one that the last fit leaves out is added, and the shape goes back to that without it.
    joint, trials, _ = chosen(monkeypatch, {"wing": 50.0, "growth": 50.0, "colour": 50.0}, not_yet={"wing"})
    assert (trials[-1], joint.refused) == (("sigma", "growth", "colour", "wing", "ln_wing_px"), ())
    assert joint.psf.psf_wing_fraction == 0.1


def test_profiles_that_are_not_clear_at_first_are_tried_again_after_the_others(monkeypatch: pytest.MonkeyPatch) -> None:
    joint, trials, _ = chosen(monkeypatch, {"beta": 50.0}, never={"beta"})
    assert joint.refused == ("beta is unclear",)
    assert trials.count(("sigma", "beta")) == 2
    assert trials[-1] == ("sigma",)
    # With another in the fit it is clear.
    joint, trials, _ = chosen(monkeypatch, {"beta": 50.0, "tilt_x": 60.0}, not_yet={"beta"})
    assert trials[-1] == ("sigma", "tilt_x", "tilt_y", "beta")
    assert (joint.psf.psf, joint.psf.psf_beta, joint.refused) == ("moffat", 4.0, ())


def test_bright_and_faint_stars_that_differ_add_to_the_errors(monkeypatch: pytest.MonkeyPatch) -> None:
    """Half of their difference, beyond the errors of both."""
    stamps = stamps_of(8)
    flux = np.array([5.0, 80, 20, 60, 10, 90, 30, 70])
    halves = []

    def fitted(some: StarStamps, names: tuple[str, ...], shape: _Shape):
        halves.append(some.bv.tolist())
        return replace(shape, sigma_px=float(np.exp(0.1 * len(halves))), growth=0.3 * len(halves)), some, 1.0

    monkeypatch.setattr(jointpsf, "_fitted", fitted)
    monkeypatch.setattr(jointpsf, "_faint_fluxes", lambda *_: flux)
    monkeypatch.setattr(jointpsf, "_covariance", lambda *_: np.diag([0.002, 0.06]))
    found = jointpsf._between_halves(stamps, ("sigma", "growth"), _Shape(1.3))
    bright, faint = np.array([1, 3, 5, 7]), np.array([0, 2, 4, 6])
    assert halves == [stamps.bv[bright].tolist(), stamps.bv[faint].tolist()]
    np.testing.assert_allclose(found, np.diag([0.05**2 - 0.001, 0.0]), rtol=1e-9, atol=1e-12)
    # Two stars for each parameter in each half are enough.
    assert not jointpsf._between_halves(stamps.some(np.arange(7)), ("sigma", "growth"), _Shape(1.3)).any()
    assert len(halves) == 2


@pytest.mark.parametrize(("factor", "is_outlier"), [(1.06, True), (0.94, False)])
def test_light_beyond_four_deviations_of_a_filtered_stamp_does_not_count(factor: float, is_outlier: bool) -> None:
    """A single pixel of h is h / (2 pi s^2) behind a Gaussian filter, where noise of 1 is 1 / (2 sqrt(pi) s)."""
    stamps = stamps_of(1, side=21, variance_dn2=np.ones((1, 21, 21)), dn_per_e=0.0)
    values = np.zeros((1, 21, 21))
    values[0, 4, 15] = factor * 4 / (2 * np.sqrt(np.pi) * 1.3) * 2 * np.pi * 1.3**2
    found = jointpsf._without_outliers(replace(stamps, values_dn=values), _Shape(1.3)).variance_dn2[0]
    hidden = np.argwhere(np.isinf(found))
    if is_outlier:
        # And two pixels around it.
        assert (hidden.min(axis=0).tolist(), hidden.max(axis=0).tolist(), len(hidden)) == ([2, 13], [6, 17], 25)
    else:
        assert len(hidden) == 0


def lit_stamps(count: int, seed: int) -> StarStamps:
    """Return stamps with the light of growing stars of 1.3 px, a sky, and noise."""
    stamps = stamps_of(count, seed=seed)
    rng = np.random.default_rng(seed)
    flux = rng.uniform(200, 1500, count)[:, np.newaxis, np.newaxis]
    light = flux * stamps.profiles(PointSpread(psf_growth=0.4), 1.3) + 2.5
    return replace(stamps, values_dn=light + np.sqrt(stamps.variance_dn2) * rng.standard_normal(light.shape))


NAMES = ("sigma", "growth")


def test_the_covariance_is_that_of_the_linearised_jackknife() -> None:
    """Each star is left out of the normal equations, with its position projected out by orthogonal columns."""
    stamps, shape = lit_stamps(7, 20), _Shape(1.28, growth=0.35)
    weight = jointpsf._weights(stamps, shape, jointpsf._faint_fluxes(stamps, shape))
    residual, by_position = jointpsf._position_slopes(stamps, shape, weight)
    slopes = jointpsf._slopes(stamps, NAMES, shape, weight)
    information, score = [], []
    for k in range(7):
        q, _ = np.linalg.qr(by_position[k])
        free = np.eye(len(q)) - q @ q.T
        information.append(slopes[k].T @ free @ slopes[k])
        score.append(slopes[k].T @ free @ residual[k, :, 0])
    steps = [np.linalg.solve(np.sum(information, axis=0) - information[k], score[k]) for k in range(7)]
    expected = np.cov(np.transpose(steps), bias=True) * 6
    np.testing.assert_allclose(jointpsf._covariance(stamps, NAMES, shape), expected, rtol=1e-5)


def test_the_bias_of_fitted_positions_is_box_s_expansion() -> None:
    """Half of each position's variance times the second derivative of the light is missing in the fit."""
    stamps, shape = lit_stamps(6, 21), _Shape(1.28, growth=0.35)
    weight = jointpsf._weights(stamps, shape, jointpsf._faint_fluxes(stamps, shape))
    flux = jointpsf._residuals(stamps, shape, weight)[1]
    step = 0.01
    missing = np.zeros_like(stamps.values_dn)
    for axis in (0, 1):
        ahead, here, behind = (
            replace(stamps, xy_px=stamps.xy_px + s * step * np.eye(2)[axis]).profiles(shape.psf, shape.sigma_px)
            for s in (1, 0, -1)
        )
        for k in range(6):
            slope = flux[k] * (ahead[k] - behind[k]) / (2 * step)
            variance = 1 / (weight[k] * slope**2).sum()
            missing[k] += variance / 2 * flux[k] * (ahead[k] - 2 * here[k] + behind[k]) / step**2
    slopes = jointpsf._slopes(stamps, NAMES, shape, weight)
    normal = sum(slopes[k].T @ slopes[k] for k in range(6))
    by = -sum(slopes[k].T @ (np.sqrt(weight[k]) * missing[k]).ravel() for k in range(6))
    shift = np.linalg.solve(normal, by)
    assert (np.abs(shift) < np.sqrt(np.diag(np.linalg.inv(normal)))).all()
    found = jointpsf._without_position_bias(stamps, NAMES, shape)
    moved = found.vector(NAMES) - shape.vector(NAMES)
    np.testing.assert_allclose(moved, shift, rtol=0.03)
    assert np.abs(shift).min() > 1e-5


def test_the_cost_of_a_fit_is_the_sum_of_its_squared_residuals() -> None:
    stamps = lit_stamps(6, 22)
    shape, moved, cost = jointpsf._fitted(stamps, NAMES, _Shape(1.4, growth=0.2))
    weight = jointpsf._weights(moved, shape, jointpsf._faint_fluxes(moved, shape))
    residual, _ = jointpsf._residuals(moved, shape, weight)
    # The weights of the last round differ by their fluxes only.
    assert cost == pytest.approx((residual**2).sum(), rel=0.02)
    assert cost == pytest.approx(6 * (169 - 4), rel=0.15)
