"""Matching of stars with detections and the refinement of a solution, against sums over all pairs and SciPy."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.stats import binom, multivariate_normal

from glstar.arrays import robust_std
from glstar.calibrate.identify import matching
from glstar.calibrate.identify.leastsquares import CameraPoses
from glstar.calibrate.identify.matching import (
    _brightest_counts,
    _chance_nearby,
    _completeness,
    _false_alarm,
    _refined,
    _residuals,
    _residuals_and_jacobian,
    _stepped,
    _with_fisheye,
    chance_pairs,
    match_probability,
    match_stars,
    mutual_nearest,
    offset_probability,
    refine,
    refine_outwards,
    significant,
    without_k1,
)
from glstar.calibrate.identify.platesolution import Matches, PlateSolution
from glstar.camera.distortion import Lens
from glstar.camera.model import Camera
from glstar.rotation import about_z, matrix_from_quaternion, quaternion_from_turn

CAMERA = Camera(640, 480, 700.0, 690.0, 322.0, 236.0)
TURN = matrix_from_quaternion(quaternion_from_turn([0.3, -0.2, 0.5]))


def detections(xy_px: np.ndarray, **more: object) -> SimpleNamespace:
    saturated = np.zeros(len(xy_px), bool)
    return SimpleNamespace(**{"xy_px": xy_px, "saturated": saturated, "psf_sigma_px": 1.2} | more)


def pairs(count: int, *, solution: PlateSolution | None = None, chance: float = 0.5, **more: object) -> Matches:
    """Return matches of which only the number and the chance count."""
    index = np.arange(count)
    usual = {"star": index, "detection": index, "residual_px": np.zeros((count, 2)), "predicted": index}
    solution = PlateSolution(CAMERA, TURN) if solution is None else solution
    return Matches(**{"solution": solution, "predicted_xy_px": np.zeros((count, 2)), "chance": chance, **usual} | more)


def test_completeness_is_that_of_twelve_neighbours_on_each_side() -> None:
    matched = np.random.default_rng(4).random(40) > 0.4
    matched[:13] = True
    for chance in (0.05, 0.95):
        expected = []
        for k in range(40):
            others = [j for j in range(max(k - 12, 0), min(k + 13, 40)) if j != k]
            seen, by_chance = sum(matched[j] for j in others), chance * len(others)
            # With half a success in one more trial, less chance matches and one standard deviation of their number.
            fraction = (seen + 0.5 - by_chance - by_chance**0.5) / ((len(others) + 1) * (1 - min(chance, 0.9)))
            expected.append(min(max(fraction, 0.005), 0.98))
        np.testing.assert_allclose(_completeness(matched, chance), expected, rtol=1e-12)
    assert _completeness(np.ones(30, bool), 0.0)[0] == pytest.approx(12.5 / 13)
    assert _completeness(np.ones(1, bool), 0.9)[0] == 0.98
    assert _completeness(np.zeros(60, bool), 0.3)[30] == 0.005


def test_a_match_has_the_probability_of_bayes() -> None:
    separation, scatter = np.array([0.3, np.inf, 2.5, 1.1, 4.0]), np.array([0.7, 0.7, 1.4, 0.7, 0.7])
    density, radius = 2e-3, 5.0
    prior = _completeness(np.isfinite(separation), 1 - np.exp(-density * np.pi * radius**2))
    expected = []
    for s, sigma, p in zip(separation, scatter, prior, strict=True):
        if np.isinf(s):
            expected.append(0.0)
            continue
        near, far = (multivariate_normal([0, 0], np.eye(2) * width**2).pdf([s, 0]) for width in (sigma, 3 * sigma))
        real = p * (0.9 * near + 0.1 * far)
        expected.append(real / (real + (1 - p) * density))
    np.testing.assert_allclose(match_probability(separation, scatter, density, radius), expected, rtol=1e-10)


def test_matches_are_kept_from_nine_tenths_on_with_half_a_false_one_or_one_in_two_hundred() -> None:
    assert significant(np.array([0.89, 0.91, 0.0, 1.0])).tolist() == [False, True, False, True]
    assert significant(np.array([0.9, 0.899])).tolist() == [True, False]
    # Seven of 0.93 have 0.49 false ones; an eighth makes it 0.56.
    assert significant(np.full(9, 0.93)).tolist() == [True] * 7 + [False] * 2
    assert significant(np.full(4, 0.875)).sum() == 0
    # Half a false one of eight is allowed exactly.
    assert significant(np.full(9, 0.9375)).tolist() == [True] * 8 + [False]
    many = np.full(400, 0.9951)
    assert significant(many).all()
    assert significant(many - 2e-4).sum() == 98  # 0.0051 each: 0.4998, more than one in two hundred
    assert chance_pairs(3, 5, 2.0, 700.0) == pytest.approx(3 * 5 * np.pi * 4 / 700)


def test_stars_and_detections_are_each_other_s_nearest_and_of_close_stars_the_brightest() -> None:
    stars = np.array([[10.0, 10], [40, 10], [41, 10], [80, 10], [81.3, 10], [10, 60]])
    found = np.array([[41.2, 10.0], [10.5, 10.0], [81.2, 10.0], [30.0, 60.0], [13.0, 10.0]])
    detection, distance = mutual_nearest(stars, found, 0.4)
    assert detection.tolist() == [1, 0, 0, 2, 2, 3]
    # 40 and 41 px are one star (a pixel between them): the brighter one; 80 and 81.3 px are two.
    np.testing.assert_allclose(distance, [0.5, 1.2, np.inf, np.inf, 0.1, 20.0], atol=1e-12, rtol=0)
    # Within a wider point spread they are one, too.
    np.testing.assert_allclose(
        mutual_nearest(stars, found, 1.3001)[1], [0.5, 1.2, np.inf, 1.2, np.inf, 20], atol=1e-12, rtol=0
    )
    np.testing.assert_allclose(mutual_nearest(stars, found, 1.2999)[1][3:5], [np.inf, 0.1], atol=1e-12, rtol=0)
    # A pixel is the limit.
    two_stars = np.array([[5.0, 5.0], [6.04, 5.0]])
    assert mutual_nearest(two_stars, np.array([[6.0, 5.0]]), 0.5)[1][1] == pytest.approx(0.04)
    # Of five within a pixel the fourth nearest counts, and the fifth does not.
    close = np.array([[0.95, 0.0], [0.8, 0.0], [0.6, 0.0], [0.4, 0.0], [0.2, 0.0]])
    assert mutual_nearest(close, np.zeros((1, 2)), 0.5)[1].tolist() == [np.inf, 0.8, np.inf, np.inf, np.inf]
    assert mutual_nearest(close[:1], np.zeros((1, 2)), 0.5)[1].tolist() == [0.95]


def test_the_scatter_of_matches_is_measured_on_those_that_are_probable() -> None:
    rng = np.random.default_rng(194)  # each of six rounds leaves some out
    offset = rng.normal(0, 0.4, (60, 2))
    scale = np.where(np.arange(60) % 3, 1.0, 2.0)
    offset *= scale[:, np.newaxis]
    offset[20:] = rng.uniform(-4, 4, (40, 2))
    matched = np.ones(60, bool)
    matched[[4, 25]] = False
    separation = np.where(matched, np.hypot(*offset.T), np.inf)
    probability = matched * 1.0
    rounds = []
    for _ in range(5):
        real = probability > 0.5
        width = max(1.4826 * np.median(np.abs(offset[real] / scale[real][:, None])), 0.1)
        probability = match_probability(separation, width * scale, 3e-3, 6.0)
        rounds.append(probability)
    assert not np.allclose(rounds[-2], rounds[-1], rtol=1e-3)
    np.testing.assert_allclose(offset_probability(offset, matched, scale, 3e-3, 6.0), probability, rtol=1e-12)
    # The smallest scatter is a tenth of a pixel.
    exact = offset_probability(np.full((20, 2), 0.01), np.ones(20, bool), np.ones(20), 3e-3, 6.0)
    expected = match_probability(np.full(20, 0.01 * 2**0.5), np.full(20, 0.1), 3e-3, 6.0)
    np.testing.assert_allclose(exact, expected, rtol=1e-12)
    assert offset_probability(offset[:3], np.zeros(3, bool), np.ones(3), 3e-3, 6.0).tolist() == [0, 0, 0]


def test_the_density_of_detections_is_measured_on_a_spiral_around_the_stars() -> None:
    rng = np.random.default_rng(5)
    found, stars, radius = rng.uniform(0, 200, (120, 2)), rng.uniform(40, 160, (7, 2)), 6.0
    hits = []
    for x, y in stars:
        for k in range(24):
            length = radius * (6 + 14 * k / 23)
            place = complex(x, y) + length * np.exp(1j * k * np.pi * (3 - 5**0.5))  # the golden angle
            hits.append(min(abs(place - complex(*one)) for one in found) < radius)
    assert 20 < sum(hits) < 130
    assert _chance_nearby(found, stars, radius) == pytest.approx(np.mean(hits), abs=1e-12)


def test_the_false_alarm_is_the_smallest_of_all_subsets_of_the_brightest() -> None:
    rng = np.random.default_rng(6)
    for count, share, nearby in (
        (3, 1.0, 0.2),
        (9, 0.8, 0.05),
        (25, 0.6, 0.1),
        (50, 0.5, 0.2),
        (90, 0.3, 0.02),
        (9, 0.6, 1e-9),
    ):
        matched = rng.random(count) < np.linspace(1.3 * share, 0.7 * share, count)
        subsets = sorted({n for n in (10, 20, 40, 80) if n <= count} | {count})
        best, needed = 1.0, count + 1
        for n in subsets:
            alarms = [
                min(1.0, 1e6 * len(subsets) * (binom.sf(k - 5, max(n - 4, 1), nearby) if k > 4 else 1.0))
                for k in range(n + 1)
            ]
            m = int(matched[:n].sum())
            if alarms[m] <= best:
                best = alarms[m]
                enough = next((k for k, alarm in enumerate(alarms) if alarm <= 1e-12), n + 1)
                needed = matched.sum() - m + enough
        found = _false_alarm(matched, nearby)
        assert found[0] == pytest.approx(best, rel=1e-9, abs=0)
        assert found[1] == needed


@pytest.mark.parametrize("area_px2", [3e5, 5e4])
def test_as_many_of_the_brightest_are_matched_as_give_half_a_chance_pair(area_px2: float) -> None:
    for radius in (0.3, 1.5, 4.0, 9.0):
        stars, found = _brightest_counts(1000, 10**6, radius, area_px2, deep=False)
        assert found == round(1.5 * stars) + 10

        def expected(k: int, radius: float = radius) -> float:
            return k * (1.5 * k + 10) * np.pi * radius**2 / area_px2

        assert stars == 1000 or stars == 20 or expected(stars) <= 0.5
        assert stars == 1000 or expected(stars + 1) > 0.5
        assert stars >= 20
    assert _brightest_counts(7, 15, 1.5, 3e5, deep=False) == (7, 15)
    assert _brightest_counts(7, 50, 1.5, 3e5, deep=False) == (7, 20)  # 10.5 are 10
    assert _brightest_counts(7, 5000, 9.0, 3e5, deep=True) == (7, max(20, int(0.5 / (7 * np.pi * 81 / 3e5))))
    assert _brightest_counts(7, 5000, 30.0, 3e5, deep=True) == (7, 20)
    assert _brightest_counts(7, 5000, 1.5, 3e5, deep=True)[1] == int(0.5 / (7 * np.pi * 2.25 / 3e5))
    assert _brightest_counts(7, 15, 1.5, 3e5, deep=True) == (7, 15)


def scene(seed: int = 3, *, within_px: float = np.inf) -> tuple[SimpleNamespace, SimpleNamespace, np.ndarray]:
    """Return detections, a solution whose stars they are, and the stars' positions and indices."""
    rng = np.random.default_rng(seed)
    xy = rng.uniform(5, [635, 475], (60, 2))
    index = np.sort(rng.choice(900, 60, replace=False))
    found = np.concatenate([xy[:45] + rng.normal(0, 0.5, (45, 2)), rng.uniform(0, [640, 480], (70, 2))])
    saturated = np.arange(115) < 9
    found[4] = xy[4] + [4.5, 0]  # farther than the radius, and less than twice that
    centre = np.array([[CAMERA.cx_px, CAMERA.cy_px]])
    solution = SimpleNamespace(
        camera=CAMERA,
        stars_on_image=lambda reference: (index, xy),
        project=lambda direction: centre + 90 * direction[:, :2],
    )
    return detections(found, saturated=saturated), solution, xy


@pytest.mark.parametrize("within_px", [np.inf, 170.0])
@pytest.mark.parametrize("deep", [False, True])
def test_matches_are_the_pairs_within_the_radius_with_their_chance(deep: bool, within_px: float) -> None:
    detected, solution, xy = scene()
    found = match_stars(detected, None, solution, 3.0, deep=deep, within_px=within_px)
    index = solution.stars_on_image(None)[0]
    near = np.hypot(*(xy - [322, 236]).T) < within_px
    tried = np.flatnonzero(np.hypot(*(detected.xy_px - [322, 236]).T) < within_px)
    area = min(640 * 480, np.pi * within_px**2)
    stars, count = _brightest_counts(near.sum(), len(tried), 3.0, area, deep=deep)
    assert stars <= near.sum()
    tried = tried[:count]
    star_xy, found_xy = xy[near][:stars], detected.xy_px[tried]
    nearest, distance = mutual_nearest(star_xy, found_xy, 1.2)
    scale = np.where(deep & detected.saturated[tried[nearest]], 2.0, 1.0)
    matched = distance < 3.0 * scale
    single = 1 - (1 - np.pi * 9 / area) ** count
    assert found.chance == pytest.approx(min(1, 1e6 * binom.sf(matched.sum() - 1, stars, single)), rel=1e-9, abs=0)
    if deep:
        alarm = _false_alarm(matched, max(single, _chance_nearby(found_xy, star_xy, 3.0)))
        assert (found.false_alarm, found.needed) == alarm
        probability = offset_probability(found_xy[nearest] - star_xy, matched, scale, count / area, 3.0)
        matched = significant(probability)
        assert found.expected_by_chance == pytest.approx((1 - probability[matched]).sum())
        assert found.expected_by_chance > 0
    else:
        assert (found.false_alarm, found.needed, found.expected_by_chance) == (1.0, 0, 0.0)
    assert found.star.tolist() == index[near][:stars][matched].tolist()
    assert found.detection.tolist() == tried[nearest[matched]].tolist()
    assert len(found) > (5 if within_px < 200 else 20)
    residual = detected.xy_px[found.detection] - xy[np.searchsorted(index, found.star)]
    np.testing.assert_allclose(found.residual_px, residual, rtol=1e-7)
    assert found.predicted.tolist() == index[near].tolist()
    assert found.predicted_xy_px.tolist() == xy[near].tolist()
    assert found.solution is solution


@pytest.mark.parametrize("lacking", ["stars", "detections"])
def test_nothing_matches_without_stars_or_detections(lacking: str) -> None:
    detected, solution, _ = scene()
    if lacking == "stars":
        solution.stars_on_image = lambda reference: (np.empty(0, np.intp), np.empty((0, 2)))
    else:
        detected = detections(np.empty((0, 2)))
    found = match_stars(detected, None, solution, 3.0, deep=True)
    assert (len(found), found.chance, found.false_alarm, found.needed) == (0, 1.0, 1.0, 0)
    assert (found.residual_px.shape, found.detection.tolist()) == ((0, 2), [])
    assert len(found.predicted) == len(found.predicted_xy_px) == (0 if lacking == "stars" else 60)


def test_a_solution_is_refined_with_shrinking_radii(monkeypatch: pytest.MonkeyPatch) -> None:
    radii, steps, residuals = [], [], iter([[9.0] * 9 + [1.0], *[[k, 0.5 * k] for k in (1.6, 0.9, 0.2) + (0.3,) * 6]])
    camera = replace(CAMERA, width_px=1000)

    def matched(detected, reference, solution, radius_px, *, deep=False):
        radii.append((radius_px, deep, solution.k1))
        return pairs(3, solution=solution, chance=1.0 if len(radii) <= 3 else 0.99)

    def refined(detected, reference, matches, most_steps):
        steps.append(most_steps)
        return replace(matches.solution, k1=matches.solution.k1 + 1)

    def remaining(detected, reference, solution, matches):
        values = np.array(next(residuals))
        return np.column_stack([0.6 * values, 0.8 * values])

    monkeypatch.setattr(matching, "match_stars", matched)
    monkeypatch.setattr(matching, "_refined", refined)
    monkeypatch.setattr(matching, "_residuals", remaining)
    found = refine(detections(np.zeros((1, 2))), None, PlateSolution(camera, TURN))
    # The 90th percentile of two is a tenth of their difference below the larger.
    expected = [10.0, 8.0, 3 * 0.95 * 1.6, 3 * 0.95 * 0.9] + [1.5] * 7
    np.testing.assert_allclose([radius for radius, *_ in radii], expected, rtol=1e-12)
    assert [deep for _, deep, _ in radii] == [False] * 10 + [True]
    assert [k1 for *_, k1 in radii] == list(range(11))
    assert steps == [6] * 3 + [100] * 7
    assert found.solution.k1 == 10


@pytest.mark.parametrize(("count", "chance", "number", "gives_up"), [
    (2, 0.0, 1, True), (3, 0.0, 1, False), (3, 1.0, 3, False), (3, 1.0, 4, True), (3, 0.99, 4, False),
])  # fmt: skip
def test_refinement_ends_with_few_or_insignificant_matches(count, chance, number, gives_up, monkeypatch) -> None:
    calls = []

    def matched(detected, reference, solution, radius_px, *, deep=False):
        calls.append(radius_px)
        return pairs(count, chance=chance) if len(calls) == number else pairs(5)

    monkeypatch.setattr(matching, "match_stars", matched)
    monkeypatch.setattr(matching, "_refined", lambda *arguments: PlateSolution(CAMERA, TURN))
    monkeypatch.setattr(matching, "_residuals", lambda *arguments: np.ones((5, 2)))
    found = refine(detections(np.zeros((1, 2))), None, PlateSolution(replace(CAMERA, width_px=100), TURN))
    assert calls[0] == 4.5
    assert (found is None) == gives_up
    assert len(calls) == (number if gives_up else 11)


def reference_of(direction_eq: np.ndarray) -> SimpleNamespace:
    return SimpleNamespace(recorded=lambda C, star, xy, camera: direction_eq[star] @ C.T, rows=None)


def test_residuals_are_those_of_each_star_in_its_row() -> None:
    rays = CAMERA.unit_vectors(np.array([[100.0, 50], [500, 400], [320, 200]]))
    detected = detections(np.array([[510.0, 404.0], [11, 12], [98.0, 51.0]]))
    matches = pairs(2, star=np.array([0, 1]), detection=np.array([2, 0]))
    found = _residuals(detected, reference_of(rays @ TURN), PlateSolution(CAMERA, TURN), matches)
    np.testing.assert_allclose(found, [[-2, 1], [10, 4]], rtol=0, atol=1e-9)


@pytest.mark.parametrize("mirrored", [False, True])
def test_the_slopes_of_a_solution_are_those_of_its_steps(mirrored: bool) -> None:
    prior = replace(CAMERA, fx_px=650.0, cx_px=318.0, cy_px=240.5)
    start = PlateSolution(CAMERA, TURN, mirrored, -0.07, prior)
    rng = np.random.default_rng(1)
    xy = rng.uniform(20, [620, 460], (12, 2))
    apparent = CAMERA.unit_vectors(xy) @ TURN
    apparent[5] = -apparent[5]
    residual, slopes = _residuals_and_jacobian(start, apparent, xy, 0.3, 7)
    assert slopes.shape == (28, 7)
    off = start.project(apparent @ TURN.T) - xy
    off[5] = 1e3  # behind the camera
    np.testing.assert_allclose(residual[:24], off.ravel(), rtol=1e-12)
    from_prior = [np.log(700 / 650) / 0.1, 4 / (0.02 * 640), -4.5 / (0.02 * 640), -0.7]
    np.testing.assert_allclose(residual[24:], 0.3 * np.array(from_prior), rtol=1e-12)
    h = 1e-5
    numerical = np.column_stack([
        (
            _residuals_and_jacobian(_stepped(start, step), apparent, xy, 0.3, 7)[0]
            - _residuals_and_jacobian(_stepped(start, -step), apparent, xy, 0.3, 7)[0]
        )
        / (2 * h)
        for step in h * np.eye(7)
    ])  # fmt: skip
    assert (slopes[10:12] == 0).all()
    np.testing.assert_allclose(slopes, numerical, rtol=1e-5, atol=1e-3)
    np.testing.assert_allclose(_residuals_and_jacobian(start, apparent, xy, 0.3, 4)[1], slopes[:, :4], rtol=1e-12)
    # Without a camera before refinement the camera is its own prior.
    assert (
        _residuals_and_jacobian(replace(start, prior_camera=None), apparent, xy, 0.3, 7)[0][24:27].tolist() == [0] * 3
    )


def test_a_step_turns_and_widens_a_solution() -> None:
    start = PlateSolution(CAMERA, TURN, True, -0.07)
    stepped = _stepped(start, np.array([0.02, 0.03, -0.01, 0.05, 0.004, -0.003, 0.02]))
    camera = stepped.camera
    np.testing.assert_allclose(
        (camera.fx_px, camera.fy_px, camera.cx_px, camera.cy_px),
        (700 * np.exp(0.05), 690 * np.exp(0.05), 322 + 0.004 * 640, 236 - 0.003 * 640),
        rtol=1e-7,
    )
    assert (stepped.k1, stepped.mirrored) == (pytest.approx(-0.05), True)
    turn = matrix_from_quaternion(quaternion_from_turn([0.02, 0.03, -0.01]))
    np.testing.assert_allclose(stepped.C_camera_eq, turn @ TURN, rtol=0, atol=1e-12)
    few = _stepped(start, np.array([0.0, 0.0, 0.0, 0.05]))
    assert (few.camera.cx_px, few.camera.cy_px, few.k1) == (322.0, 236.0, -0.07)


def test_without_k1_the_middle_of_the_image_stays() -> None:
    prior = replace(CAMERA, cx_px=310.0, cy_px=245.0, fx_px=650.0)
    found = without_k1(PlateSolution(CAMERA, TURN, True, -0.1), prior)
    assert (found.camera.cx_px, found.camera.cy_px, found.camera.fx_px, found.camera.fy_px) == (310, 245, 700, 690)
    assert (found.mirrored, found.k1, found.prior_camera) == (True, 0.0, prior)
    # The direction that was on the new principal point is within a hundredth of a pixel of it.
    ray = CAMERA.unit_vectors(np.array([[322.0, 236.0]])) @ TURN
    np.testing.assert_allclose(found.camera.project(ray @ found.C_camera_eq.T), [[322.0, 236.0]], rtol=0, atol=0.01)


@pytest.mark.parametrize(("excess", "distorted"), [(-0.01, False), (0.01, True)])
def test_distortion_must_improve_the_criterion_of_bayes_by_ten(excess, distorted, monkeypatch) -> None:
    rays = CAMERA.unit_vectors(np.array([[100.0, 50], [500, 400], [320, 200]]))
    count = 6
    improvement = (3 * np.log(count) + 10) / count + excess
    seen = []

    def fitted(start, measured, moved, *, scale, most_steps):
        _, slopes = measured(start)
        seen.append((slopes.shape, scale, most_steps, start.k1, start.prior_camera))
        assert moved(start, np.zeros(slopes.shape[1])).camera == start.camera
        has_k1 = slopes.shape[1] == 7
        return SimpleNamespace(state=has_k1, cost=2.0 if has_k1 else 2.0 * np.exp(improvement))

    monkeypatch.setattr(matching, "minimise", fitted)
    detected = detections(np.array([[510.0, 404.0], [11, 12], [98.0, 51.0]]))
    start = PlateSolution(CAMERA, TURN, k1=-0.03)
    residual_px = np.array([[0.5, -0.3], [0.2, 0.9], [-0.6, 0.1]])
    matches = pairs(3, solution=start, residual_px=residual_px)
    assert _refined(detected, reference_of(rays @ TURN), matches, 17) is distorted
    typical = 1.4826 * 0.4
    assert seen == [
        ((10, 7), pytest.approx(typical), 17, -0.03, CAMERA),
        ((10, 4), pytest.approx(typical), 17, 0.0, CAMERA),
    ]
    seen.clear()
    prior = replace(CAMERA, cx_px=320.0)
    matches = pairs(3, solution=replace(start, prior_camera=prior), residual_px=0.01 * residual_px)
    _refined(detected, reference_of(rays @ TURN), matches, 17)
    assert [(scale, before) for _, scale, _, _, before in seen] == [(0.02, prior)] * 2


@pytest.mark.parametrize(("fraction", "stars", "coefficients"), [
    (0.39, 99, 1), (0.4, 99, 2), (0.64, 99, 2), (0.65, 99, 3), (0.89, 99, 3), (0.9, 99, 4), (0.95, 19, 3),
    (0.95, 18, 3), (0.95, 17, 2), (0.95, 13, 1), (0.95, 5, 1),
])  # fmt: skip
def test_a_fisheye_gets_a_coefficient_for_radius_and_stars(fraction, stars, coefficients, monkeypatch) -> None:
    camera, prior = replace(CAMERA, lens=Lens("fisheye", (0.1,))), replace(CAMERA, cx_px=300.0)
    seen = []

    def fitted(free, start, model):
        seen.append((free, start, model))
        return SimpleNamespace(state=CameraPoses(replace(camera, fx_px=555.0), (about_z(0.4),)))

    monkeypatch.setattr(matching, "fit_parameters", fitted)
    solution = PlateSolution(camera, TURN, prior_camera=prior)
    residual_px = np.array([[0.5, -0.3], [0.2, 0.9], [-0.6, 0.1]])
    found = _with_fisheye(range(stars), solution, pairs(3, residual_px=residual_px), fraction)
    [(free, start, model)] = seen
    assert (free.coefficients, free.principal_point, free.prior) == (tuple(range(coefficients)), True, prior)
    assert free.noise_px == (pytest.approx(robust_std(residual_px)),)
    assert (start.camera, start.C_camera_eq[0] is TURN, model) == (camera, True, "fisheye")
    assert found.camera.fx_px == 555.0
    assert found.C_camera_eq.tolist() == about_z(0.4).tolist()
    exact = replace(solution, prior_camera=None)
    _with_fisheye(range(stars), exact, pairs(3, residual_px=0.001 * residual_px), fraction)
    assert (seen[1][0].noise_px, seen[1][0].prior) == ((0.005,), camera)
    monkeypatch.setattr(matching, "fit_parameters", lambda *arguments: None)
    assert _with_fisheye(range(stars), solution, pairs(3), fraction) is None


def growing(monkeypatch: pytest.MonkeyPatch, *, counts=(), chance=0.5, without_fit=()) -> tuple[list, list, Matches]:
    """Refine a fisheye outwards with given numbers of matches, and return the calls."""
    camera = Camera(640, 480, 200.0, 200.0, 319.5, 239.5, lens=Lens("fisheye", ()))
    calls, fractions = [], []
    number = dict(counts)

    def matched(detected, reference, solution, radius_px, *, deep=False, within_px=np.inf):
        calls.append((within_px, radius_px, deep))
        return pairs(number.get(len(calls), 4), solution=solution, chance=chance)

    def fisheye(stars, solution, matches, corner_fraction):
        assert solution.prior_camera is camera
        fractions.append(corner_fraction)
        return None if len(fractions) in without_fit else solution

    off = np.array([[3.0, 4.0], [0.3, 0.4], [np.nan, 0.0]])
    star = SimpleNamespace(residual_px=lambda camera, C: 0.5 ** max(len(calls) - 12, 0) * off)
    monkeypatch.setattr(matching, "match_stars", matched)
    monkeypatch.setattr(matching, "_with_fisheye", fisheye)
    monkeypatch.setattr(matching.IdentifiedStars, "of", lambda *arguments: star)
    reference = SimpleNamespace(to_camera=lambda C: np.zeros((9, 3)), rows=None)
    found = refine_outwards(detections(np.zeros((9, 2))), reference, PlateSolution(camera, TURN))
    return calls, fractions, found


def test_a_fisheye_is_matched_outwards_and_then_with_shrinking_radii(monkeypatch: pytest.MonkeyPatch) -> None:
    calls, fractions, found = growing(monkeypatch)
    within = [200 * np.deg2rad(20.0)]
    while within[-1] < 400:
        within.append(1.2 * within[-1])
    rounds = len(within) - 1
    assert rounds == 10
    np.testing.assert_allclose([w for w, *_ in calls], [*within, *[within[-1]] * 5, np.inf], rtol=1e-9)
    np.testing.assert_allclose(fractions, np.array([w for w, *_ in calls[:-1]]) / 400, rtol=1e-9)
    # 3 times the 90th percentile of 5 and 0.5 px, which halves in later rounds: no wider than before, 1 px or more.
    wide = 3 * (0.5 + 0.9 * 4.5)
    radii = [3.2] * 11
    for k in range(6):
        radii.append(max(min(wide * 0.5 ** max(k - 1, 0), radii[-1]), 1.0))
    np.testing.assert_allclose([radius for _, radius, _ in calls], radii, rtol=1e-9)
    assert [deep for *_, deep in calls] == [False] * 16 + [True]
    assert len(found) == 4


def test_growth_ends_with_few_or_insignificant_matches(monkeypatch: pytest.MonkeyPatch) -> None:
    calls, _, found = growing(monkeypatch, counts=[(3, 3)])
    assert (len(calls), found) == (3, None)
    calls, _, found = growing(monkeypatch, chance=1.0)
    assert (len(calls), found) == (1, None)
    calls, _, found = growing(monkeypatch, without_fit=[2])
    assert (len(calls), found) == (2, None)
