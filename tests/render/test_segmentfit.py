"""Samples, search and fit of least-squares segments, by polynomials and dense positions written out."""

from collections.abc import Iterator
from dataclasses import replace
from itertools import pairwise
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from glstar.render.motion import segmentfit
from glstar.render.motion.pointing import Pointing
from glstar.render.motion.segmentation import segment_excess
from glstar.render.motion.segmentfit import SampledMotion, SegmentFit, fitted_segments
from glstar.render.motion.starpaths import end_rates_px, end_weights, probe_rays
from tests.render.test_pathfit import LENS, rough
from tests.support.scenes import NIGHT_UTC_S, camera

WIDE = camera(300, 100, 400.0)


def turning(times_s: np.ndarray) -> Pointing:
    """Return a camera whose rotation vector, and zenith, are curves of time."""
    t = times_s - 50.0
    turns = np.column_stack([0.02 * t**2, -0.01 * t + 0.004 * t**3, 0.03 * np.sin(t)])
    zenith = np.column_stack([np.sin(0.1 * t), 0.2 + 0 * t, np.cos(0.1 * t)])
    return Pointing(Rotation.from_rotvec(turns).as_matrix(), zenith, np.column_stack([t, -t, 2 * t]) * 1e-6, 0.7)


def motion(interpolation: str = "slerp", requests: list[np.ndarray] | None = None) -> SimpleNamespace:
    def pointings(*times_s: np.ndarray) -> list[Pointing]:
        if requests is not None:
            requests.extend(times_s)
        return [turning(each) for each in times_s]

    return SimpleNamespace(
        flight=SimpleNamespace(attitude=SimpleNamespace(interpolation=interpolation)), pointings=pointings
    )


NODES_S = 50.0 + np.array([0.0, 0.3, 0.5, 1.1, 1.5])


@pytest.mark.parametrize("interpolation", ["slerp", "spline"])
def test_the_motion_is_sampled_evenly_from_node_to_node(interpolation: str) -> None:
    samples = SampledMotion.of(motion(interpolation), NODES_S, 3)
    expected = np.interp(np.arange(13) / 3, np.arange(5), NODES_S)
    np.testing.assert_allclose(samples.times_s, expected, rtol=0, atol=1e-9)
    assert (samples.parts, samples.bends) == (3, interpolation == "spline")
    np.testing.assert_allclose(samples.pointing.C_camera_eq, turning(expected).C_camera_eq, rtol=0, atol=1e-9)
    # Twice as strict within 0.2 s of either end, the limits among them.
    at_s = 8 + np.array([0.0, 0.1875, 0.25, 0.3125, 0.8125, 0.875, 1.0])
    strict = replace(samples, times_s=at_s).strictness(0.25, 2.5)
    assert strict.tolist() == [2.5, 2.5, 2.5, 1.0, 2.5, 2.5, 2.5]
    assert replace(samples, times_s=np.linspace(0.0, 1.0, 9)).strictness(0.125, 3.0).tolist() == [
        3,
        3,
        1,
        1,
        1,
        1,
        1,
        3,
        3,
    ]


@pytest.mark.parametrize(
    ("interpolation", "parts", "knots", "then_parts", "then_least"),
    [
        ("slerp", 2, [0, 2, 4], 2, None),  # two parts of a segment do where the rate is constant
        ("slerp", 1, [0, 1, 4], 2, 8),  # one does not: twice as many
        ("slerp", 4, [0, 0.1, 4], 8, 8),  # none in the first segment: eight are the most for all
        ("slerp", 5, [0, 0.1, 4], 8, 8),
        ("spline", 4, [0, 2, 4], 4, None),  # eight
        ("spline", 4, [0, 1, 4], 4, 8),  # four do for all, and others are added to the four
        ("spline", 3, [0, 1, 4], 6, 8),
        ("spline", 2, [0, 1, 4], 4, 8),
        ("spline", 12, [0, 0.1, 4], 12, 8),
    ],
)
def test_segments_with_few_samples_get_more(
    interpolation: str, parts: int, knots: list[float], then_parts: int, then_least: int | None
) -> None:
    samples = SampledMotion.of(motion(interpolation), NODES_S, parts)
    knots_s = np.interp(knots, np.arange(5), NODES_S)
    resolved = samples.resolving(motion(interpolation), knots_s)
    if then_least is None:
        assert resolved is samples
        return
    counts = np.diff(resolved.times_s.searchsorted(knots_s - 1e-6))
    assert resolved.parts == then_parts
    assert counts.min() >= then_least
    even = SampledMotion.of(motion(interpolation), NODES_S, then_parts).times_s
    added = np.concatenate([
        begin + (end - begin) * np.arange(8) / 8
        for begin, end in pairwise(knots_s)
        if np.count_nonzero((even >= begin - 1e-6) & (even < end - 1e-6)) < 8
    ])  # fmt: skip
    expected = np.sort([*even, *(time for time in added if np.abs(even - time).min() > 1e-6)])
    np.testing.assert_allclose(resolved.times_s, expected, rtol=0, atol=1e-9)
    for name in ("C_camera_eq", "zenith_eq", "velocity_eq"):
        np.testing.assert_allclose(
            getattr(resolved.pointing, name), getattr(turning(expected), name), rtol=0, atol=1e-9
        )


def test_a_quadratic_follows_values_if_no_sample_is_farther_from_its_least_squares_than_the_limit() -> None:
    rng = np.random.default_rng(2)
    t = np.sort(rng.uniform(0, 3, (9, 40)), axis=0)
    values = rng.normal(size=(3, 9, 40)) + 5 * t**2 - 7 * t + 20
    residual = np.empty_like(values)
    for k in range(40):
        fits = np.polynomial.polynomial.polyfit(t[:, k], values[:, :, k].T, 2)
        residual[:, :, k] = values[:, :, k] - np.polynomial.polynomial.polyval(t[:, k], fits)
    distance = np.linalg.norm(residual, axis=0)
    wider = rng.uniform(1.0, 2.0, (9, 40))
    largest = (distance / wider).max(axis=0)
    follows = np.arange(40) % 2 == 0
    limit = wider * largest * np.where(follows, 1.0001, 0.9999)
    np.testing.assert_array_equal(segmentfit._follow(t, values, limit), follows)
    # Of three samples any is a quadratic.
    assert segmentfit._follow(t[:3], values[:, :3], np.full((3, 40), 1e-9)).all()


def test_the_turn_since_the_start_is_in_pixels_at_the_farthest_corner() -> None:
    turns = np.array([[0.0, 0, 0], [0.01, -0.02, 0.03], [0.03, -0.01, 0.02]])
    C = np.array([Rotation.from_rotvec(-turns[:k].sum(axis=0)).as_matrix() for k in range(1, 4)])
    steps = [Rotation.from_matrix(C[k + 1] @ C[k].T).as_rotvec() for k in range(2)]
    expected = -np.cumsum([np.zeros(3), *steps], axis=0) * [WIDE.max_px_per_rad] * [1, 1, 0]
    expected[:, 2] = -np.cumsum([np.zeros(3), *steps], axis=0)[:, 2] * np.hypot(300, 100) / 2
    np.testing.assert_allclose(
        segmentfit._turns_px(Pointing(C, np.zeros((3, 3)), np.zeros((3, 3)), 0.0), WIDE), expected, rtol=1e-9
    )


def longest_of(values: np.ndarray, limit_px: np.ndarray, parts: int) -> list[int]:
    """Return the longest acceptable number of intervals from each node of those that the search tries."""
    t = np.arange(len(values)) / parts
    last = (len(values) - 1) // parts

    def follows(first: int, length: int) -> bool:
        of = slice(first * parts, (first + length) * parts + 1)
        fits = np.polynomial.polynomial.polyfit(t[of], values[of], 2)
        off = values[of].T - np.polynomial.polynomial.polyval(t[of], fits)
        return bool((np.linalg.norm(off, axis=0) <= limit_px[of]).all())

    longest = [1] * (last + 1)
    if follows(0, last):
        return [last, *longest[1:]]
    for length in (2, 3, 4, 5, 6, 7, 8, 10, 12, 15, 19, 24, 30, 38, 48, 60, 76, 96, 120, 152, 192, 240):
        of_length = [first for first in range(last - length + (length < last)) if follows(first, length)]
        if length >= last or not of_length:
            break
        for first in of_length:
            longest[first] = length
    return longest


@pytest.mark.parametrize("parts", [1, 2])
@pytest.mark.parametrize("amount", [0.003, 0.02, 2.0])
def test_the_longest_segments_are_those_that_a_quadratic_follows(parts: int, amount: float) -> None:
    rng = np.random.default_rng(7)
    nodes = 40
    t = np.arange(nodes * parts + 1) / parts
    values = np.column_stack([np.sin(0.3 * t), 0.2 * t, np.cos(0.4 * t)]) + 2e-3 * rng.normal(size=(len(t), 3))
    limit_px = amount * rng.uniform(0.9, 1.5, len(t))
    samples = SampledMotion(np.arange(nodes + 1.0), parts, t, None, bends=False)
    found = samples._longest(t, values, limit_px)
    assert found.tolist() == longest_of(values, limit_px, parts)


@pytest.mark.parametrize(("stop", "count"), [(99, 22), (5, 4)])
def test_lengths_are_tried_in_steps_of_about_a_quarter_until_none_follows(
    monkeypatch: pytest.MonkeyPatch, stop: int, count: int
) -> None:
    tried = []

    def follow(t: np.ndarray, _values: np.ndarray, _limit: np.ndarray) -> np.ndarray:
        tried.append((len(t) - 1) // 2)
        return np.full(t.shape[1], 1 < len(tried) < stop)

    monkeypatch.setattr(segmentfit, "_follow", follow)
    samples = SampledMotion(np.arange(301.0), 2, np.arange(601.0), None, bends=False)
    samples._longest(np.arange(601.0), np.zeros((601, 3)), np.ones(601))
    lengths = [2, 3, 4, 5, 6, 7, 8, 10, 12, 15, 19, 24, 30, 38, 48, 60, 76, 96, 120, 152, 192, 240]
    assert tried == [300, *lengths[:count]]


def test_the_search_goes_from_node_to_node_in_blocks(monkeypatch: pytest.MonkeyPatch) -> None:
    nodes_s = 50.0 + np.arange(601) / 100
    samples = SampledMotion.of(motion(), nodes_s, 2)
    blocks = []

    def longest(self: object, times_s: np.ndarray, turns_px: np.ndarray, limit_px: np.ndarray) -> np.ndarray:
        blocks.append((times_s[0] - 50, times_s[-1] - 50, *turns_px[[0, -1], 0], *limit_px[[0, -1]]))
        return 10 + np.arange(300) % 7

    monkeypatch.setattr(SampledMotion, "_longest", longest)
    strictness = np.linspace(1.0, 3.0, 1201)
    knots_s = samples.search(LENS, 0.05, strictness)
    turns_px = segmentfit._turns_px(samples.pointing, LENS)
    expected = [0]
    for first, end in ((0, 256), (256, 512), (512, 600)):
        while expected[-1] < end:
            expected.append(min(end, expected[-1] + 10 + (expected[-1] - first) % 7))
    np.testing.assert_array_equal(knots_s, nodes_s[expected])
    ends = [(0, 512), (512, 1024), (1024, 1200)]
    for block, (first, end) in zip(blocks, ends, strict=True):
        limits_px = 0.8 * 0.05 / strictness[[first, end]]
        np.testing.assert_allclose(
            block, [first / 200, end / 200, *turns_px[[first, end], 0], *limits_px], rtol=1e-9, atol=1e-9
        )


def fit_of(knots_s: np.ndarray, parts: int = 16, interpolation: str = "slerp") -> tuple[SampledMotion, SegmentFit]:
    samples = SampledMotion.of(motion(interpolation), NODES_S, parts)
    return samples, SegmentFit.of(motion(interpolation), samples, knots_s)


def test_fitted_segments_have_the_least_squared_rotation_from_the_samples() -> None:
    """A change of any node by a hundredth of its correction makes the sum of squares larger."""
    knots_s = 50.0 + np.array([0.0, 0.9, 1.5])
    samples, fit = fit_of(knots_s)
    t = samples.times_s
    np.testing.assert_allclose(fit.time_fraction, [0.6, 0.4], rtol=1e-12)
    assert fit.segment.tolist() == [int(k > 0) for k in (t >= 50.9 - 1e-9)]
    times_s = 50.0 + np.array([0.0, 0.45, 0.9, 1.2, 1.5])
    start = turning(times_s)
    weight = end_weights(start.C_camera_eq[:-2:2], start.C_camera_eq[2::2])[fit.segment]
    u = (t - knots_s[fit.segment]) / np.diff(knots_s)[fit.segment]
    lagrange = [2 * (u - 0.5) * (u - 1) * weight, 4 * u * (1 - u), 2 * u * (u - 0.5) * weight]
    np.testing.assert_allclose(fit.basis, np.transpose(lagrange), rtol=0, atol=1e-9)
    np.testing.assert_array_equal(fit.nodes.zenith_eq, start.zenith_eq)
    assert fit.sampled is samples.pointing
    assert fit.bends is False

    def squares(nodes: np.ndarray) -> float:
        drawn = np.einsum("nk,nkij->nij", fit.basis, nodes[2 * fit.segment[:, np.newaxis] + np.arange(3)])
        turn = segmentfit._small_turn(samples.pointing.C_camera_eq @ np.swapaxes(drawn, 1, 2))
        # Each sample represents the time from halfway to the one before to halfway to the next, and the ends for twice
        # their half.
        return float((np.gradient(t)[:, np.newaxis] * turn**2).sum())

    least = squares(fit.nodes.C_camera_eq)
    assert 1e-12 < least < 0.5 * squares(start.C_camera_eq)
    for node in range(5):
        for axis in np.eye(3):
            for step in (-1e-5, 1e-5):
                moved = fit.nodes.C_camera_eq.copy()
                moved[node] = Rotation.from_rotvec(step * axis).as_matrix() @ moved[node]
                assert squares(moved) > least


def test_small_turns_are_those_of_matrices_of_any_scale() -> None:
    turns = np.random.default_rng(1).normal(size=(5, 3)) * 1e-4
    C = np.arange(1, 6)[:, np.newaxis, np.newaxis] * Rotation.from_rotvec(-turns).as_matrix()
    np.testing.assert_allclose(segmentfit._small_turn(C), turns, rtol=0, atol=1e-11)


@pytest.mark.parametrize(("interpolation", "factor"), [("slerp", 1.0), ("spline", 1.4)])
def test_the_deviation_is_the_largest_distance_of_a_probe_at_a_sample(interpolation: str, factor: float) -> None:
    knots_s = 50.0 + np.array([0.0, 1.1, 1.5])
    samples, fit = fit_of(knots_s, 7, interpolation)
    strictness = np.where(samples.times_s > 51.2, 1.7, 1.0)
    deviation, drawing = fit.excess(LENS, 1.3, 0.04, 0.02, strictness)
    rays = probe_rays(LENS).T
    C = fit.nodes.C_camera_eq
    weight = end_weights(C[:-2:2], C[2::2])
    np.testing.assert_array_equal(np.bincount(fit.segment), [21, 8])
    for k in range(2):
        directions = rays @ C[2 * k + 1]
        nodes = fit.nodes[np.arange(2 * k, 2 * k + 3)].to_camera(directions, below_horizon=True)
        of = np.flatnonzero(fit.segment == k)
        vectors = np.einsum("nk,kmi->nmi", fit.basis[of], nodes)
        true = samples.pointing[of].to_camera(directions, below_horizon=True)
        distance_px = np.linalg.norm(LENS.project(vectors) - LENS.project(true), axis=-1)
        expected = (distance_px * strictness[of, np.newaxis]).max() / 0.04
        assert deviation[k] == pytest.approx(expected, rel=1e-6)
        start, middle, end = nodes[0] * weight[k], nodes[1], nodes[2] * weight[k]
        u = np.arange(9)[:, np.newaxis, np.newaxis] / 8
        path = (1 - u) * (1 - 2 * u) * start + 4 * u * (1 - u) * middle + u * (2 * u - 1) * end
        drawn = segment_excess(
            LENS.project(path)[:, np.newaxis], end_rates_px(LENS, start, middle, end)[:, np.newaxis],
            fit.time_fraction[[k]], 1.3, 0.02,
        )  # fmt: skip
        assert drawing[k] == pytest.approx(float(drawn[0]), rel=1e-6)
    # A spline may bend between fewer than eight samples.
    kept = np.sort(np.append(np.flatnonzero(fit.segment == 0), np.flatnonzero(fit.segment == 1)[:7]))
    few = replace(fit, sampled=fit.sampled[kept], segment=fit.segment[kept], basis=fit.basis[kept])
    fewer, _ = few.excess(LENS, 1.3, 0.04, 0.02, np.ones(len(kept)))
    all_of, _ = replace(few, bends=False).excess(LENS, 1.3, 0.04, 0.02, np.ones(len(kept)))
    np.testing.assert_allclose(fewer / all_of, [1.0, factor], rtol=1e-12)


class Scripted:
    """A fit whose errors are given, round by round, and what it was asked."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, rounds: Iterator[tuple[list[float], list[float]]]) -> None:
        self.asked: list[tuple[float, ...]] = []
        self.strict: list[float] = []
        self.tolerances_px: list[float] = []
        one = self

        def search(samples: SampledMotion, lens: object, tolerance_px: float, strictness: np.ndarray) -> np.ndarray:
            one.tolerances_px.append(tolerance_px)
            one.strict.extend([strictness.max(), np.count_nonzero(strictness > 1)])
            return samples.nodes_s[[0, -1]]

        def excess(fit: SegmentFit, *of: object) -> tuple[np.ndarray, np.ndarray]:
            one.asked.append(of[1:4])
            deviation, drawing = next(rounds)
            count = len(fit.time_fraction)
            return np.resize(deviation, count), np.resize(drawing, count)

        monkeypatch.setattr(SampledMotion, "search", search)
        monkeypatch.setattr(SegmentFit, "excess", excess)


def found(nodes_s: np.ndarray = NODES_S, **changed: float) -> object:
    values = {"sigma_px": 1.5, "tolerance_px": 0.03, "psf_sigma_px": 1.2, "position_px": 0.02} | changed
    return fitted_segments(motion(), nodes_s, LENS, **values)


def test_a_fit_is_accepted_when_both_errors_are_at_most_one(monkeypatch: pytest.MonkeyPatch) -> None:
    rounds = [([1.0], [1.01]), ([1.01, 1.0], [1.0]), ([1.0], [1.0])]
    one = Scripted(monkeypatch, iter(rounds))
    trails = found()
    # Into two, at even times because it could not be drawn; and the first of both into two at a sample of the log.
    np.testing.assert_allclose(trails.marks, [0.0, 0.2, 0.5, 1.0], rtol=0, atol=1e-9)
    np.testing.assert_allclose(trails.time_fraction, [0.2, 0.3, 0.5], rtol=0, atol=1e-9)
    # The tolerance of a star narrower than 1.37 px is smaller.
    assert one.asked == [(1.5, pytest.approx(0.03 * 1.2 / 1.37), 0.02)] * 3
    assert one.tolerances_px == [pytest.approx(0.03 * 1.2 / 1.37)]
    assert one.strict == [1.0, 0]


@pytest.mark.parametrize(
    ("changed", "tolerance_px", "strict"),
    [
        ({"psf_sigma_px": 1.5, "readout_s": 0.3}, 0.03, 1.5),
        ({"psf_sigma_px": 1.3, "readout_s": 0.3, "tolerance_px": 0.01}, 0.01 * 1.3 / 1.37, 1.0),
        ({"psf_sigma_px": 1.36, "readout_s": 0.3, "position_px": 0.005}, 0.03 * 1.36 / 1.37, 6.0),
        ({"psf_sigma_px": 1.38, "position_px": 0.005}, 0.03, 1.0),
    ],
)
def test_tolerances_are_stricter_for_narrow_stars_and_while_rows_open(
    monkeypatch: pytest.MonkeyPatch, changed: dict[str, float], tolerance_px: float, strict: float
) -> None:
    one = Scripted(monkeypatch, iter([([0.5], [0.5])]))
    assert len(found(**changed)) == 1
    assert one.tolerances_px == [pytest.approx(tolerance_px, rel=1e-9)]
    assert one.strict[0] == pytest.approx(strict, rel=1e-9)
    assert (one.strict[1] > 0) == (strict > 1)


def test_a_fit_that_takes_too_many_rounds_or_too_short_segments_is_none(monkeypatch: pytest.MonkeyPatch) -> None:
    def errors(last: int) -> Iterator[tuple[list[float], list[float]]]:
        for k in range(99):
            yield ([2.0] + [0.0] * 50, [0.0]) if k < last else ([1.0], [1.0])

    long_s = 50.0 + np.linspace(0.0, 1.0, 9)
    # Twelve rounds: the first segment is divided by two in each but the last.
    one = Scripted(monkeypatch, errors(11))
    assert len(found(long_s)) == 12
    assert len(one.asked) == 12
    one = Scripted(monkeypatch, errors(12))
    assert found(long_s) is None
    assert len(one.asked) == 12
    # In halves, so that the first segment of the second round has 21 us, or 19 us.
    for first_s, is_fitted in ((4.2e-5, True), (3.8e-5, False)):
        one = Scripted(monkeypatch, errors(1))
        assert (found(50.0 + np.array([0.0, first_s])) is not None) == is_fitted
        assert len(one.asked) == 1 + is_fitted


def test_paths_are_sampled_at_eighths_and_observed_with_refraction() -> None:
    rng = np.random.default_rng(3)
    start, middle, end = rng.normal(size=(3, 2, 3, 4))
    path = segmentfit._sampled_path(start, middle, end)
    assert path.shape == (9, 2, 4, 3)
    for k, u in enumerate(np.linspace(0, 1, 9)):
        expected = start + (end - start) * u + (middle - (start + end) / 2) * 4 * u * (1 - u)
        np.testing.assert_allclose(path[k], np.swapaxes(expected, 1, 2), rtol=0, atol=1e-12)
    pointing = rough(50.0).pointing(NIGHT_UTC_S + np.array([0.1, 0.5]))
    directions = np.swapaxes(np.stack([probe_rays(LENS).T @ C for C in pointing.C_camera_eq]), 1, 2)
    for k, of in enumerate(segmentfit._observed(pointing, directions)):
        expected = pointing.to_camera(directions[k].T, below_horizon=True)[k]
        np.testing.assert_allclose(of.T, expected, rtol=0, atol=1e-8)
