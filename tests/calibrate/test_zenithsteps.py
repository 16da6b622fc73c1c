"""The search for a zenith step by step, on a few refracted stars of a pinhole."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from glstar.calibrate.geometry import zenith as module
from glstar.calibrate.geometry.lenschoice import LensCandidate
from glstar.calibrate.geometry.zenith import (
    _best_zeniths,
    _RefractedStars,
    _Trial,
    _with_zenith,
    find_zenith,
)
from glstar.calibrate.identify.leastsquares import CameraPoses
from glstar.calibrate.identify.platesolution import Matches, PlateSolution, ReferenceStars
from glstar.camera.model import Camera
from glstar.errors import CalibrationError
from glstar.rotation import matrix_from_quaternion, quaternion_from_turn
from glstar.sky.air.refraction import refraction_displacement

CAMERA = Camera(640, 480, 900.0, 890.0, 322.0, 236.0)
TURN = matrix_from_quaternion(quaternion_from_turn([0.3, -0.2, 0.5]))
PLAIN = LensCandidate(None, (), principal_point=False)
BENT = LensCandidate("plumb_bob", (0,), principal_point=False)
# Altitude of the optical axis, and direction of the zenith on the image from the top, rad.
PLACE = np.deg2rad([21.0, 65.0])


def refracted(*, scale: float = 0.9, noise_px: float = 0.02, count: int = 50) -> _RefractedStars:
    rng = np.random.default_rng(2)
    xy = rng.uniform(5, [635, 475], (count, 2))
    direction = CAMERA.unit_vectors(xy) @ TURN
    stars = _RefractedStars(direction, xy, PlateSolution(CAMERA, TURN), scale, noise_px, PLAIN)
    zenith = stars.zenith_eq(*PLACE)
    seen = direction + refraction_displacement(direction @ zenith, scale)[:, np.newaxis] * zenith
    moved = CAMERA.project(seen @ TURN.T) + rng.normal(0, noise_px, xy.shape)
    return replace(stars, xy_px=moved)


STARS = refracted()


def test_stars_are_lifted_towards_the_zenith() -> None:
    zenith = STARS.zenith_eq(*PLACE)
    lifted = STARS.at(zenith)
    unit = lifted.apparent / np.linalg.norm(lifted.apparent, axis=1, keepdims=True)
    altitude = np.arcsin(STARS.direction_eq @ zenith)
    # Bennett's formula of standard air, minutes of arc by degrees, for 0.9 of it.
    up = np.rad2deg(altitude)
    minutes = 0.9 * 1.02 / np.tan(np.deg2rad(up + 10.3 / (up + 5.11)))
    np.testing.assert_allclose(np.arcsin(unit @ zenith) - altitude, np.deg2rad(minutes / 60), rtol=0.02)
    np.testing.assert_array_equal(STARS.at(None).apparent, STARS.direction_eq)
    np.testing.assert_array_equal(lifted.xy_px, STARS.xy_px)
    for direction_deg, x, y in ((0, 0, -1), (90, 1, 0), (180, 0, 1), (270, -1, 0)):
        in_camera = TURN @ STARS.zenith_eq(0.4, np.deg2rad(direction_deg))
        np.testing.assert_allclose(in_camera, [np.cos(0.4) * x, np.cos(0.4) * y, np.sin(0.4)], rtol=0, atol=1e-12)


def test_parameters_start_from_the_solution_and_its_prior() -> None:
    free = STARS._free(None, BENT)
    assert (free.prior, free.noise_px, free.coefficients, free.principal_point) == (CAMERA, (0.02,), (0,), False)
    prior = replace(CAMERA, cx_px=300.0)
    with_prior = replace(STARS, solution=replace(STARS.solution, prior_camera=prior))
    assert with_prior._free(STARS.zenith_eq(*PLACE), PLAIN).prior is prior


def test_the_criterion_counts_two_angles_of_a_zenith(monkeypatch: pytest.MonkeyPatch) -> None:
    with monkeypatch.context() as patch:
        patch.setattr(_RefractedStars, "cost", lambda stars, zenith, candidate: 70.0 if zenith is None else 60.0)
        for candidate, parameters in ((PLAIN, 4), (BENT, 5)):
            none, some = (STARS.criterion(zenith, candidate) for zenith in (None, np.zeros(3)))
            assert none == pytest.approx(50 * np.log(70 / 50) + parameters * np.log(50))
            assert some == pytest.approx(50 * np.log(60 / 50) + (parameters + 2) * np.log(50))
        patch.setattr(_RefractedStars, "cost", lambda *arguments: 0.0)
        assert STARS.criterion(None, PLAIN) == pytest.approx(50 * np.log(1e-12 / 50) + 4 * np.log(50))
    fit = STARS.fit(None, PLAIN)
    assert STARS.cost(None, PLAIN) == pytest.approx(2 * fit.cost)
    assert STARS.cost(STARS.zenith_eq(*PLACE), PLAIN) < 150 < STARS.cost(None, PLAIN)
    with monkeypatch.context() as patch:
        patch.setattr(module, "fit_parameters", lambda *arguments: None)
        assert STARS.cost(None, PLAIN) == np.inf
        np.testing.assert_array_equal(STARS.improved(PLACE, PLAIN), PLACE)
        with pytest.raises(CalibrationError, match="no camera fits the stars") as caught:
            STARS.first_place(PLAIN)
        assert caught.value.stars_used == 50


def test_positions_change_with_the_zenith_as_by_differences() -> None:
    poses = CameraPoses(CAMERA, (TURN,))

    def positions(place: np.ndarray) -> np.ndarray:
        return CAMERA.project(STARS.at(STARS.zenith_eq(*place)).apparent @ TURN.T).ravel()

    h = 1e-4
    numerical = np.column_stack([(positions(PLACE + h * e) - positions(PLACE - h * e)) / (2 * h) for e in np.eye(2)])
    found = STARS._by_place(poses, PLACE)
    np.testing.assert_allclose(found, numerical, rtol=2e-3, atol=2e-3 * np.abs(numerical).max())


def test_a_zenith_nearby_is_improved_with_the_camera(monkeypatch: pytest.MonkeyPatch) -> None:
    found = STARS.improved(PLACE + np.deg2rad([3.0, -8.0]), PLAIN)
    off = found - PLACE
    error = STARS.error_rad(STARS.zenith_eq(*found), PLAIN)
    assert np.hypot(off[0], off[1] * np.cos(PLACE[0])) < 4 * error
    assert 5e-4 < error < 0.06
    # The slopes of the last two parameters are those of a step of them.
    seen = {}

    def kept(start, measured, moved, *, scale):
        seen.update(start=start, measured=measured, moved=moved, scale=scale)
        return SimpleNamespace(state=start)

    monkeypatch.setattr(module, "minimise", kept)
    np.testing.assert_array_equal(STARS.improved(PLACE, PLAIN), PLACE)
    start, measured, moved = seen["start"], seen["measured"], seen["moved"]
    residual, slopes = measured(start)
    assert (residual.shape, slopes.shape, len(seen["scale"])) == ((100,), (100, 6), 100)
    h = 1e-5
    numerical = np.column_stack([
        (measured(moved(start, h * e))[0] - measured(moved(start, -h * e))[0]) / (2 * h) for e in np.eye(6)
    ])  # fmt: skip
    np.testing.assert_allclose(slopes, numerical, rtol=5e-3, atol=5e-3 * np.abs(numerical).max(axis=0).min())

    def failing(*arguments, **more):
        raise np.linalg.LinAlgError

    monkeypatch.setattr(module, "minimise", failing)
    np.testing.assert_array_equal(STARS.improved(PLACE, PLAIN), PLACE)


def test_the_first_zenith_is_the_one_of_the_grid_that_fits_best() -> None:
    first = np.rad2deg(STARS.first_place(PLAIN))
    altitudes = (5, 8, 12, 16, 20, 25, 30, 37, 45, 53, 62, 72, 83)
    costs = {}
    # A camera takes up part of each refraction: the rest is what no rotation and no focal length makes.
    fit = STARS.fit(None, PLAIN)
    weight = 1 / np.sqrt(fit.root)
    slopes = fit.slopes * weight[:, np.newaxis]
    camera, [C] = fit.state.camera, fit.state.C_camera_eq
    for up in altitudes:
        for along in range(0, 360, 20):
            lifted = STARS.at(STARS.zenith_eq(np.deg2rad(up), np.deg2rad(along))).apparent
            moved = (camera.project(lifted @ C.T) - camera.project(STARS.direction_eq @ C.T)).ravel() / 0.02
            residual = (fit.residual + moved) * weight
            residual = residual - slopes @ np.linalg.lstsq(slopes, residual, rcond=None)[0]
            costs[up, along] = residual @ residual
    assert tuple(np.rint(first).astype(int).tolist()) == min(costs, key=costs.__getitem__)
    assert abs(first[0] - 21) < 12


def test_the_error_of_a_zenith_is_that_of_its_worst_direction(monkeypatch: pytest.MonkeyPatch) -> None:
    zenith, first, second = np.linalg.qr(np.random.default_rng(1).normal(size=(3, 3)))[0].T
    information = np.array([[4e4, 3e3], [3e3, 9e6]])

    def cost(stars, zenith_eq, candidate):
        along = np.array([zenith_eq @ first, zenith_eq @ second]) / (zenith_eq @ zenith)
        assert np.linalg.norm(zenith_eq) == pytest.approx(1)
        return 70.0 + along @ information @ along

    monkeypatch.setattr(_RefractedStars, "cost", cost)
    # The noise is that of the residuals: 70 over the number of stars.
    expected = np.sqrt(70.0 / 50 / np.linalg.eigvalsh(information)[0])
    assert STARS.error_rad(zenith, PLAIN) == pytest.approx(expected, rel=1e-9)
    information[0, 0] = -4e4
    assert STARS.error_rad(zenith, PLAIN) == np.inf


def unknown(**more: object) -> ReferenceStars:
    usual = {"zenith_eq": np.zeros(3), "velocity_eq": np.zeros(3), "refraction_scale": 0.0, "C_ned_eq": None}
    return ReferenceStars(SimpleNamespace(direction_eq=STARS.direction_eq), **usual | more)


def test_a_zenith_is_sought_with_thirty_stars_and_without_a_place(monkeypatch: pytest.MonkeyPatch) -> None:
    calls = []
    detected = SimpleNamespace(xy_px=STARS.xy_px)

    def matches(count: int) -> Matches:
        index = np.arange(count)
        return Matches(STARS.solution, index, index, np.zeros((count, 2)), index, np.zeros((count, 2)), 0.0)

    fitted = replace(matches(40), star=np.arange(40)[::-1])

    def of(identified, solution, scale):
        calls.append((identified, solution, scale))
        return "refracted"

    monkeypatch.setattr(module, "fit_camera", lambda *arguments: SimpleNamespace(matches=fitted))
    monkeypatch.setattr(_RefractedStars, "of", of)
    monkeypatch.setattr(module, "_with_zenith", lambda stars, reference: (stars, reference))
    reference = unknown()
    assert find_zenith(detected, reference, matches(30), refraction_scale=0.9) == ("refracted", reference)
    [(identified, solution, scale)] = calls
    assert (solution, scale) == (fitted.solution, 0.9)
    np.testing.assert_array_equal(identified.apparent, STARS.direction_eq[39::-1])
    for over, count, scale in (
        (reference, 29, 0.9),
        (reference, 30, 0.0),
        (unknown(zenith_eq=np.array([0.0, 0, 1])), 30, 0.9),
        (unknown(rows="rows"), 30, 0.9),
    ):
        assert find_zenith(detected, over, matches(count), refraction_scale=scale) is over

    def failing(*arguments):
        raise CalibrationError("no camera")

    monkeypatch.setattr(module, "fit_camera", failing)
    assert find_zenith(detected, reference, matches(30), refraction_scale=0.9) is reference


def chosen(
    monkeypatch: pytest.MonkeyPatch,
    *,
    best: float = -20.0,
    other: float = 0.0,
    without: float = 0.0,
    error_deg: float = 5.0,
    sines: tuple[float, ...] = (0.3, *[0.5] * 99),
    thin: tuple[float, float] = (0.0, 0.0),
) -> tuple[ReferenceStars, list[float]]:
    """Choose a zenith whose criteria are given, and return the reference stars and the airs that were tried."""
    zenith = np.array([0.0, 0.6, 0.8])
    across = np.array([1.0, 0.0, 0.0])
    sine = np.array(sines)[:, np.newaxis]
    direction = sine * zenith + np.sqrt(1 - sine**2) * across
    stars = replace(STARS, direction_eq=direction, xy_px=np.zeros((len(sines), 2)), plain_candidate=BENT)
    airs = []

    def zeniths(part):
        airs.append(part.refraction_scale)
        criterion = best if len(airs) == 1 else thin[len(airs) - 2]
        return _Trial(criterion, zenith, PLAIN), _Trial(other, -zenith, PLAIN)

    def criterion(part, zenith_eq, candidate):
        assert (zenith_eq, candidate) == (None, BENT)
        return without

    def error(part, zenith_eq, candidate):
        assert (zenith_eq is zenith, candidate) == (True, PLAIN)
        return np.deg2rad(error_deg)

    monkeypatch.setattr(module, "_best_zeniths", zeniths)
    monkeypatch.setattr(_RefractedStars, "criterion", criterion)
    monkeypatch.setattr(_RefractedStars, "error_rad", error)
    found = _with_zenith(stars, unknown())
    if found.zenith_error_rad is not None:
        assert found.zenith_eq is zenith
        assert (found.refraction_scale, found.zenith_error_rad) == (0.9, np.deg2rad(error_deg))
    else:
        assert found.refraction_scale == 0
    return found, airs


def test_a_zenith_must_be_better_than_its_opposite_than_none_and_than_in_thin_air(monkeypatch) -> None:
    def is_known(**more: object) -> bool:
        return chosen(monkeypatch, **more)[0].zenith_error_rad is not None

    assert chosen(monkeypatch)[1] == pytest.approx([0.9, 0.9 * 0.25, 0.9 * 0.05])
    assert is_known()
    for name in ("other", "without"):
        assert [is_known(**{name: better}) for better in (-17.9, -18.1)] == [True, False]
    assert is_known(other=-18.0)
    assert [is_known(error_deg=error) for error in (11.9, 12.1, np.inf, np.nan)] == [True, False, False, False]
    # Two of a hundred stars may be below the horizon.
    assert [is_known(sines=(*[-0.1] * low, *[0.5] * (100 - low))) for low in (2, 3)] == [True, False]
    # A hundred stars: the amount of air costs 4.6, and must gain two.
    limit = -22 - np.log(100)
    assert [is_known(thin=(limit + off, 0.0)) for off in (0.05, -0.05)] == [True, False]
    assert [is_known(thin=(0.0, limit + off)) for off in (0.05, -0.05)] == [True, False]
    # Only stars near the horizon show thin air.
    assert [is_known(thin=(-99.0, 0.0), sines=(sine, *[0.5] * 99)) for sine in (0.34, 0.36)] == [False, True]
    assert chosen(monkeypatch, sines=(0.36, *[0.5] * 99))[1] == [0.9]


class Fitted:
    """In place of stars, with criteria by the place of the zenith and by the lens."""

    plain_candidate = PLAIN

    def __init__(self, criteria, candidates) -> None:
        self.criteria, self.candidates, self.tried = criteria, iter(candidates), []

    def first_place(self, candidate):
        assert candidate is PLAIN
        return np.array([0.3, 1.0])

    def improved(self, place, candidate):
        self.tried.append((place.tolist(), candidate))
        return place + np.array([0.1, 0.0])

    def zenith_eq(self, altitude, direction):
        return (round(float(altitude), 6), round(float(direction), 6))

    def criterion(self, zenith, candidate):
        return self.criteria(zenith)

    def best_candidate(self, zenith):
        return next(self.candidates)


def test_both_sides_of_the_image_are_tried_until_the_lens_does_not_change() -> None:
    near, far = (0.4, 1.0), (0.4, round(1 + np.pi, 6))
    stars = Fitted(lambda zenith: -5.0 if zenith[1] == 1.0 else 3.0, [PLAIN])
    best, other = _best_zeniths(stars)
    assert (best.zenith_eq, best.criterion, other.zenith_eq, other.criterion) == (near, -5.0, far, 3.0)
    assert stars.tried == [([0.3, 1.0], PLAIN), ([0.3, 1.0 + np.pi], PLAIN)]
    # From the better place, with the lens that the stars justify there.
    stars = Fitted(lambda zenith: -zenith[1], [BENT, BENT])
    best, _ = _best_zeniths(stars)
    assert [candidate for _, candidate in stars.tried] == [PLAIN, PLAIN, BENT, BENT]
    assert stars.tried[2][0] == pytest.approx([0.4, 1 + np.pi])
    assert best.candidate == BENT
    stars = Fitted(lambda zenith: -5.0 if zenith[1] == 1.0 else 3.0, [BENT, PLAIN] * 3)
    _best_zeniths(stars)
    assert len(stars.tried) == 8  # four rounds


def test_stars_are_refracted_with_their_scatter_and_the_lens_that_they_justify(monkeypatch) -> None:
    calls = []

    def best(parts, solutions, choice):
        calls.append((parts[0].apparent, solutions, choice))
        return SimpleNamespace(candidate=BENT)

    monkeypatch.setattr(module, "best_lens", best)
    monkeypatch.setattr(
        module, "scatter_px", lambda stars, camera, C: 0.25 if (camera, C is TURN) == (CAMERA, True) else 0
    )
    identified = STARS.at(None)
    found = _RefractedStars.of(identified, STARS.solution, 0.7)
    assert (found.noise_px, found.plain_candidate, found.refraction_scale) == (0.25, BENT, 0.7)
    assert (found.direction_eq is STARS.direction_eq, found.xy_px is STARS.xy_px) == (True, True)
    zenith = STARS.zenith_eq(*PLACE)
    assert STARS.best_candidate(zenith) is BENT
    np.testing.assert_array_equal(calls[1][0], STARS.at(zenith).apparent)
    assert [call[1:] for call in calls] == [((STARS.solution,), "auto")] * 2
