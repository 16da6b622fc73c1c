"""Paths as chains of lines, and the light of lines at points, by integrals along them in float64."""

from itertools import pairwise
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.special import erf

from glstar.camera.exposure import Exposure
from glstar.render.motion.trailmodels import AnalyticSegments, SubExposures
from glstar.render.readout.rows import RecordedTimes
from glstar.render.readout.stacking import StackedTrails
from glstar.render.truth import linechains
from glstar.render.truth.linechains import LineChain, NearLines, _path, _while_open, line_chains, square_distance_px2
from tests.support.scenes import NIGHT_UTC_S, camera

XY_PX = np.array([[[1.0, 10], [4, 12], [9, np.nan], [9, 30]], [[2.0, 20], [6, 25], [6, 26], [7, 40]]])
DURATION = np.array([0.2, 0.5, 0.3])


def test_a_chain_has_the_lines_between_positions_and_hides_those_with_an_end_that_is_not_visible() -> None:
    chain = LineChain.of(XY_PX.copy(), DURATION, None)
    assert len(chain) == 3
    np.testing.assert_allclose(chain.step_px, [[[3, 2], [5, 0], [0, 0]], [[4, 5], [0, 0], [1, 0]]], rtol=1e-12)
    np.testing.assert_allclose(chain.middle_px[:, :, 0], [[2.5, 6.5, 9], [4, 6, 6.5]], rtol=1e-12)
    np.testing.assert_allclose(chain.middle_px[:, 0, 1], [11, 22.5], rtol=1e-12)
    np.testing.assert_allclose(chain.length_px, [[5, np.sqrt(29)], [5, 0], [1, 0]], rtol=1e-12)
    assert chain.hidden.tolist() == [[False, False], [False, True], [False, True]]
    assert chain.is_whole.tolist() == [True, False]
    assert chain.weight.tolist() == [[0.2, 0.2], [0.5, 0.0], [0.3, 0.0]]
    recorded = np.array([[0.1, 0.4], [0.7, 0.5], [0.2, 0.1]])
    rolling = LineChain.of(XY_PX.copy(), DURATION, recorded)
    assert rolling.weight.tolist() == [[0.1, 0.4], [0.7, 0.0], [0.2, 0.0]]
    one = rolling[np.array([1])]
    np.testing.assert_array_equal(one.step_px, rolling.step_px[:, :, 1:])
    np.testing.assert_array_equal(one.middle_px, rolling.middle_px[:, :, 1:])
    assert one.length_px.tolist() == rolling.length_px[:, 1:].tolist()
    assert (one.hidden.tolist(), one.recorded.tolist()) == ([[False], [True], [True]], [[0.4], [0.5], [0.1]])
    assert one.duration is rolling.duration
    whole = LineChain.of(XY_PX[:, :, :1], DURATION, None)
    assert whole.hidden is None
    assert whole.is_whole.tolist() == [True]
    assert whole[np.array([0, 0])].hidden is whole[:].recorded is None
    assert whole.weight.tolist() == [[0.2], [0.5], [0.3]]


def test_lines_are_near_a_point_within_half_their_length_and_a_distance() -> None:
    rng = np.random.default_rng(3)
    chain = LineChain.of(rng.uniform(0, 30, (2, 21, 6)), np.full(20, 0.05), None)
    hidden = rng.random((20, 6)) < 0.2
    point, reach = rng.uniform(0, 30, (6, 2)), rng.uniform(1, 12, 6)
    for one in (chain, LineChain(*(getattr(chain, name) for name in ("middle_px", "step_px", "length_px", "duration")),
                                 hidden, None)):  # fmt: skip
        expected = [
            (6 * line + star, star) for line in range(20) for star in range(6)
            if np.hypot(*(chain.middle_px[:, line, star] - point[star])) < chain.length_px[line, star] / 2 + reach[star]
            and not (one.hidden is not None and hidden[line, star])
        ]  # fmt: skip
        lines, stars = one.near(point, reach)
        assert list(zip(lines.tolist(), stars.tolist(), strict=True)) == expected
    distance2 = square_distance_px2(chain.middle_px, *point.T)
    np.testing.assert_allclose(distance2, ((chain.middle_px - point.T[:, np.newaxis]) ** 2).sum(axis=0), rtol=1e-12)


def light_of(start: np.ndarray, end: np.ndarray, at: np.ndarray, sigma: float) -> float:
    """Return the mean along a line of a Gaussian over its flux at a point, 1/px^2; a short one is a wide Gaussian."""
    length = np.hypot(*(end - start))
    along = (end - start) / length if length else np.array([1.0, 0.0])
    s, across = (at - (start + end) / 2) @ along, (at - (start + end) / 2) @ [along[1], -along[0]]
    height = np.exp(-(across**2) / (2 * sigma**2)) / (np.sqrt(2 * np.pi) * sigma)
    if length >= sigma:
        ends = [erf((s + sign * length / 2) / (np.sqrt(2) * sigma)) for sign in (1, -1)]
        return float(height * (ends[0] - ends[1]) / (2 * length))
    variance = sigma**2 + length**2 / 12
    return float(height * np.exp(-(s**2) / (2 * variance)) / np.sqrt(2 * np.pi * variance))


@pytest.mark.parametrize("is_rolling", [False, True])
@pytest.mark.parametrize("is_clouded", [False, True])
@pytest.mark.parametrize("at_once", [32_768, 7])
def test_the_signal_at_places_is_that_of_all_near_lines(
    monkeypatch: pytest.MonkeyPatch, is_rolling: bool, is_clouded: bool, at_once: int
) -> None:
    monkeypatch.setattr(linechains, "PAIRS_AT_ONCE", at_once)
    rng = np.random.default_rng(5)
    count, stars, sigma = 14, 3, 1.4
    # From very short lines to very long ones.
    steps = rng.normal(size=(2, count, stars)) * np.geomspace(0.2, 6, count)[:, np.newaxis]
    steps[:, 3] = 0.0
    xy_px = np.concatenate([np.zeros((2, 1, stars)), np.cumsum(steps, axis=1)], axis=1) + 50
    recorded = rng.uniform(0, 0.2, (count, stars)) if is_rolling else None
    passing = rng.uniform(0.2, 1, (count, stars)) if is_clouded else 0.7
    chain = LineChain.of(xy_px, rng.dirichlet(np.ones(count)), recorded)
    point = np.array([[51.0, 50.5], [52.0, 49.0], [49.0, 51.0]])
    x, y = rng.uniform(-2, 2, (2, 4, stars))
    near = list(NearLines.of(chain, slice(None), point, np.full(stars, 3.0), sigma, passing))
    assert [each.is_long for each in near] == [True, False]
    assert [each.sigma_px for each in near] == [sigma, sigma]
    light = chain.weight * (passing if is_clouded else 0.7)
    expected = np.zeros((4, stars))
    for star in range(stars):
        for place in range(4):
            at = point[star] + [x[place, star], y[place, star]]
            for line in range(count):
                ends = xy_px[:, line, star], xy_px[:, line + 1, star]
                if np.hypot(*(sum(ends) / 2 - point[star])) < np.hypot(*(ends[1] - ends[0])) / 2 + 3.0 + 5 * sigma:
                    expected[place, star] += light[line, star] * light_of(*ends, at, sigma)
    assert expected.mean() > 5e-3
    np.testing.assert_allclose(sum(lines.signal(x, y) for lines in near), expected, rtol=0, atol=2e-6)
    # Numbers of the points of some stars.
    some = np.array([2, 0])
    of_some = list(NearLines.of(chain[some], np.array([2, 0]), point[some], np.full(2, 3.0), sigma,
                                passing[:, some] if is_clouded else 0.7))  # fmt: skip
    found = sum(lines.signal(x, y) for lines in of_some)
    np.testing.assert_allclose(found[:, some], expected[:, some], rtol=0, atol=2e-6)
    assert not found[:, 1].any()
    chosen = [lines.of_points(np.array([True, False, True])) for lines in near]
    np.testing.assert_allclose(sum(lines.signal(x[:, ::2], y[:, ::2]) for lines in chosen), expected[:, ::2],
                               rtol=0, atol=2e-6)  # fmt: skip


@pytest.mark.parametrize(("side", "is_near"), [(0.99, True), (1.01, False)])
def test_lines_are_left_out_beyond_five_sigma(side: float, is_near: bool) -> None:
    chain = LineChain.of(np.array([[[0.0], [4.0]], [[0.0], [0.0]]]), np.ones(1), None)
    found = list(
        NearLines.of(chain, slice(None), np.array([[2 + side * (2 + 1.5 + 5 * 1.2), 0.0]]), np.array([1.5]), 1.2, 1.0)
    )
    assert bool(found) == is_near


@pytest.mark.parametrize(("length", "is_long"), [(1.19, False), (1.2, True)])
def test_a_line_of_a_sigma_is_long(length: float, is_long: bool) -> None:
    chain = LineChain.of(np.array([[[0.0], [length]], [[0.0], [0.0]]]), np.ones(1), None)
    (found,) = NearLines.of(chain, slice(None), np.zeros((1, 2)), np.ones(1), 1.2, 1.0)
    assert found.is_long == is_long


class Segments:
    """Pointings and positions of analytic trails of which only the numbers of requests are known."""

    def __init__(self, segments: int) -> None:
        fraction = np.arange(1.0, segments + 1)
        along = np.arange(2 * segments + 1.0)
        pointing = SimpleNamespace(
            to_camera=lambda eq: np.stack([eq + np.array([0.01 * k, 0.02 * k, 0]) for k in along])
        )
        self.trails = AnalyticSegments(pointing, fraction / fraction.sum())
        self.times: np.ndarray | None = None

    def positions(self, _camera: object, direction_eq: np.ndarray, time: np.ndarray) -> np.ndarray:
        self.times = time
        return np.stack([100 * time, 300 * time], axis=-1)[:, np.newaxis] * np.ones((1, len(direction_eq), 1))


@pytest.mark.parametrize(("segments", "parts"), [(1, 16), (3, 6), (4, 4), (5, 4), (7, 4), (8, None), (9, None)])
def test_paths_have_sixteen_lines_or_two_per_segment(
    monkeypatch: pytest.MonkeyPatch, segments: int, parts: int | None
) -> None:
    one, scene = Segments(segments), SimpleNamespace(camera=camera())
    monkeypatch.setattr(AnalyticSegments, "positions", one.positions)
    direction = np.array([[0.0, 0.1, 1.0], [0.1, 0.0, 1.0]])
    xy_px, duration = _path(scene, one.trails, direction, None)
    fraction = one.trails.time_fraction
    if parts is None:
        np.testing.assert_allclose(duration, np.repeat(fraction, 2) / 2, rtol=1e-12)
        expected = scene.camera.project(one.trails.pointing.to_camera(direction))
        np.testing.assert_allclose(xy_px, np.moveaxis(expected, -1, 0), rtol=1e-12)
        assert one.times is None
        known = np.full((2, 2 * segments + 1, 2), 3.0)
        assert _path(scene, one.trails, direction, known)[0] is known
        return
    np.testing.assert_allclose(duration, np.repeat(fraction, parts) / parts, rtol=1e-12)
    times = np.interp(np.arange(segments * parts + 1) / parts, np.arange(segments + 1), [0, *np.cumsum(fraction)])
    np.testing.assert_allclose(one.times, times, rtol=0, atol=1e-12)
    assert one.times.max() <= 1.0
    np.testing.assert_allclose(xy_px[:, :, 1], [100 * times, 300 * times], rtol=0, atol=1e-9)


def test_the_path_of_a_star_is_cut_where_its_row_opens_and_closes() -> None:
    exposure = Exposure(NIGHT_UTC_S, 0.6, readout_s=0.4)
    scene = SimpleNamespace(exposure=exposure, camera=camera())
    duration = np.array([0.1, 0.3, 0.2, 0.4])
    ends_s = np.array([0.0, 0.1, 0.4, 0.6, 1.0])
    xy_px = np.stack([100 + 50 * ends_s, 30 * ends_s])[:, :, np.newaxis] * np.ones(3)
    opens, closes = np.array([0.0, 0.25, 0.1]), np.array([0.6, 0.8, 0.95])
    positions = np.stack([np.column_stack([100 + 50 * at, 30 * at]) for at in (opens, (opens + closes) / 2, closes)])
    recorded = RecordedTimes(opens, closes, closes - opens, positions, np.zeros(3))
    cut_px, found, open_s = _while_open(scene, xy_px.copy(), duration, recorded)
    assert found is duration
    overlap = np.array([
        [max(0.0, min(end, b) - max(begin, a)) for a, b in zip(opens, closes, strict=True)]
        for begin, end in pairwise(ends_s)
    ])  # fmt: skip
    np.testing.assert_allclose(open_s, overlap / (closes - opens), rtol=0, atol=1e-12)
    at = np.clip(ends_s[:, np.newaxis], opens, closes)
    np.testing.assert_allclose(cut_px, [100 + 50 * at, 30 * at], rtol=0, atol=1e-9)
    # Of a quarter of the exposure, as in a stack, all lines together are a quarter.
    _, _, quarter = _while_open(scene, xy_px.copy(), duration / 4, recorded)
    np.testing.assert_allclose(quarter, open_s / 4, rtol=0, atol=1e-12)
    still = SimpleNamespace(exposure=Exposure(NIGHT_UTC_S, 0.6), camera=camera())
    same_px, same, none = _while_open(still, xy_px, duration, recorded)
    assert same_px is xy_px
    assert same is duration
    assert none is None


@pytest.mark.parametrize("is_rolling", [False, True])
@pytest.mark.parametrize("is_listed", [False, True])
def test_a_stack_has_a_chain_for_each_short_exposure(is_rolling: bool, is_listed: bool) -> None:
    def short(shift: float) -> SubExposures:
        turned = np.array([[0.0, 0.0, 0.0], [0.01, 0.02, 0.0], [0.03, 0.05, 0.0]]) + shift
        pointing = SimpleNamespace(to_camera=lambda eq: eq + turned[:, np.newaxis])
        return SubExposures(pointing)

    stack = StackedTrails([short(0.0), short(0.1)])
    exposure = Exposure(NIGHT_UTC_S, 0.6, readout_s=0.4 if is_rolling else 0.0, frames=2, gap_s=0.1)
    listing = SimpleNamespace(trails=stack) if is_listed else None
    scene = SimpleNamespace(trails=None if is_listed else stack, listing=listing, exposure=exposure, camera=camera())
    direction = np.array([[0.0, 0.1, 1.0], [0.1, 0.0, 1.0]])
    each = [
        RecordedTimes(np.array([a, 0.1]), np.array([0.8, 0.9]), np.ones(2), np.full((3, 2, 2), 9.0 * a), np.zeros(2))
        for a in (0.2, 0.4)
    ]  # fmt: skip
    joined = RecordedTimes(*(np.zeros(2),) * 3, np.zeros((3, 2, 2)), np.zeros(2), tuple(each)) if is_rolling else None
    found = list(line_chains(scene, direction, recorded=joined))
    assert len(found) == 2
    for chain, trails, a in zip(found, stack.shorts, (0.2, 0.4), strict=True):
        xy_px, duration = _path(scene, trails, direction, None)
        np.testing.assert_allclose(duration, [1 / 3] * 3, rtol=1e-12)
        np.testing.assert_allclose(chain.duration, [1 / 6] * 3, rtol=1e-12)
        if is_rolling:
            thirds = np.array([[0, 1 / 3], [1 / 3, 2 / 3], [2 / 3, 1]])
            open_s = np.diff(thirds.clip(a, 0.8), axis=1)[:, 0]
            np.testing.assert_allclose(chain.weight[:, 0], open_s / (0.8 - a) / 2, rtol=0, atol=1e-9)
        else:
            np.testing.assert_allclose(chain.middle_px, (xy_px[:, 1:] + xy_px[:, :-1]) / 2, rtol=1e-12)
            np.testing.assert_allclose(chain.weight, np.full((3, 2), 1 / 6), rtol=1e-12)
    single = SimpleNamespace(trails=stack.shorts[1], listing=None, exposure=Exposure(NIGHT_UTC_S, 0.6), camera=camera())
    (alone,) = line_chains(single, direction)
    np.testing.assert_allclose(alone.duration, [1 / 3] * 3, rtol=1e-12)


def test_the_light_of_a_star_at_rest_falls_with_the_distance() -> None:
    """A line without a length once had no direction either, and the same light everywhere."""
    chain = LineChain.of(np.full((2, 3, 1), 50.0), np.array([0.3, 0.7]), None)
    (found,) = NearLines.of(chain, slice(None), np.full((1, 2), 50.0), np.array([9.0]), 1.4, 1.0)
    x, y = np.array([[0.0], [2.0], [0.0], [-1.5]]), np.array([[0.0], [0.0], [3.0], [2.5]])
    expected = np.exp(-(x**2 + y**2) / (2 * 1.4**2)) / (2 * np.pi * 1.4**2)
    np.testing.assert_allclose(found.signal(x, y), expected, rtol=1e-5)
