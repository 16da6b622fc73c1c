"""Division of exposures into the segments of analytic trails."""

from collections.abc import Callable, Iterator
from types import SimpleNamespace
from typing import ClassVar, NamedTuple, Self

import numpy as np
import pytest
from scipy.integrate import simpson
from scipy.spatial.transform import Rotation

from glstar.camera.model import Mount
from glstar.flight import AttitudeTrack, Flight, PositionTrack
from glstar.render.motion import segmentation
from glstar.render.motion.pointing import Pointing
from glstar.render.motion.segmentation import segment_times
from glstar.render.motion.starpaths import end_rates_px, end_weights, probe_rays
from glstar.render.simulator import Simulator
from glstar.rotation import quaternion_from_euler
from tests.support.scenes import ADELAIDE, NIGHT_UTC_S, camera, sky_over_adelaide

LENS = camera(1014, 760, 967.7425)


def rolling(t: np.ndarray, roll_rad: np.ndarray) -> Simulator:
    still = sky_over_adelaide(LENS)
    q = quaternion_from_euler(roll_rad, np.zeros_like(roll_rad), np.zeros_like(roll_rad))
    flight = Flight(AttitudeTrack.from_samples(NIGHT_UTC_S + t, q), PositionTrack.fixed(ADELAIDE))
    return Simulator.of(flight, still.sky, LENS, Mount(), still.sensor)


def cut(simulator: Simulator, opens_s: float, samples_s: np.ndarray) -> np.ndarray:
    """Return the ends of the segments of an exposure of 0.5 s, seconds after its start."""
    nodes_s = NIGHT_UTC_S + np.concatenate(
        [[opens_s], samples_s[(samples_s > opens_s) & (samples_s < opens_s + 0.5)], [opens_s + 0.5]]
    )
    times_s = segment_times(simulator.motion, nodes_s, LENS, 1.2)
    assert times_s is not None
    assert times_s[1::2] == pytest.approx((times_s[:-1:2] + times_s[2::2]) / 2, abs=1e-6)
    return times_s[::2] - nodes_s[0]


@pytest.mark.parametrize("deg_per_s", [10.0, 60.0, 100.0, 200.0, 300.0])
@pytest.mark.parametrize("samples", [3, 101, 801])
def test_a_uniform_rotation_has_equal_segments_at_any_log_rate(deg_per_s, samples):
    t = np.linspace(0.0, 1.0, samples)
    cuts_s = cut(rolling(t, np.deg2rad(deg_per_s) * t - 0.9), 0.21, t)
    parts = np.diff(cuts_s)
    if samples < 200:
        assert np.ptp(parts) < 1e-5
        assert len(parts) <= 2 + 0.08 * deg_per_s
    else:  # with more samples a segment that was just acceptable may be divided once more
        assert len(parts) <= 2 + 0.12 * deg_per_s


@pytest.mark.parametrize("periods", [1, 4, 8, 16])
def test_a_vibration_in_phase_with_the_exposure_has_two_segments_per_period(periods):
    """Too few evenly spaced samples would all fall on one phase, where the aircraft seems not to move."""
    t = np.linspace(0.0, 1.0, 401)
    shaking = rolling(t, np.deg2rad(0.5) * np.sin(2 * np.pi * 2 * periods * (t - 0.25)))
    assert len(cut(shaking, 0.25, t)) - 1 >= 2 * periods


def test_a_rotation_that_starts_at_a_sample_is_divided_there():
    t = np.array([0.0, 0.43, 1.0])
    cuts_s = cut(rolling(t, np.array([0.0, 0.0, np.deg2rad(30.0)])), 0.21, t)
    assert np.abs(cuts_s - 0.22).min() < 1e-6
    # Before that a single segment suffices.
    assert np.count_nonzero(cuts_s < 0.22 - 1e-6) == 1


@pytest.mark.parametrize("sample_s", [0.211, 0.709])
def test_a_rotation_that_slows_just_after_the_start_or_before_the_end_is_divided_there(sample_s):
    """Evenly spaced samples see nothing of such a part, which was too bright by as much as its rate is lower.

    At 10 deg/s a single segment would do for the rest of the exposure.
    """
    t = np.array([0.0, sample_s, 1.0])
    slower = np.deg2rad(10.0) * np.array([0.95, 1.0] if sample_s < 0.5 else [1.0, 0.95])
    cuts_s = cut(rolling(t, np.concatenate([[0.0], np.cumsum(slower * np.diff(t))])), 0.21, t)
    assert np.abs(cuts_s - (sample_s - 0.21)).min() < 1e-6


def probes_of(motion: Callable[[np.ndarray], np.ndarray], times: int) -> np.ndarray:
    """Return positions at even times of what gives x and y, (probes, 2), at one: (times, 1, probes, 2)."""
    return np.stack([motion(t) for t in np.linspace(0.0, 1.0, times)])[:, np.newaxis]


def turned(xy: np.ndarray, angle_rad: float) -> np.ndarray:
    cosine, sine = np.cos(angle_rad), np.sin(angle_rad)
    return xy @ np.array([[cosine, sine], [-sine, cosine]])


def excess_of_one(xy: np.ndarray, rates_px: np.ndarray, fraction: float, elapsed: np.ndarray | None = None) -> float:
    """Return the excess of one probe's path, (times, 2), and rates, (2, 2), at sigma 1.3 px, within 0.03 px."""
    found = segmentation.segment_excess(
        xy[:, np.newaxis, np.newaxis], rates_px[:, np.newaxis, np.newaxis], np.array([fraction]), 1.3, 0.03, elapsed
    )
    assert found.shape == (1,)
    return float(found[0])


def short_path(length: float, ahead: float, aside: float) -> np.ndarray:
    """Return positions at nine times along a chord, px, from a point on the image in a direction of 0.6 rad."""
    t = np.linspace(0.0, 1.0, 9)
    s = length * t + 4 * ahead * t * (1 - t) + 0.3 * t * (1 - t) * (1 - 2 * t)
    p = 4 * aside * t * (1 - t) - 0.5 * t * (1 - t) * (1 - 2 * t) * (2 - t)
    return np.array([40.0, 70.0]) + turned(np.column_stack([s, p]), 0.6)


@pytest.mark.parametrize(("length", "ahead", "aside"), [(2.5, 0.2, 0.13), (1.1, -0.5, 0.3), (1.9, 0.9, -0.7)])
def test_the_error_of_a_path_shorter_than_two_sigma_is_that_of_the_moments_of_two_gaussians(
    length: float, ahead: float, aside: float
) -> None:
    xy, sigma, fraction = short_path(length, ahead, aside), 1.3, 0.4
    s, p = turned(xy - xy[0], -0.6).T
    assert p[-1] == pytest.approx(0.0, abs=1e-12)
    ahead, aside = s[4] - length / 2, p[4]
    # The middle of the light of an even change lies at two thirds of it.
    off_s, off_p = s - length / 2 - ahead * 2 / 3, p - aside * 2 / 3
    mean_s, mean_p, ss, pp, sp = (simpson(of, dx=1 / 8) for of in (off_s, off_p, off_s**2, off_p**2, off_s * off_p))
    # Their variance: VARIANCE RATE_CHANGE^2 of two_gaussians.glsl.
    change = 0.0187834 * 2.3282816**2
    second = abs(ss - length**2 / 12 - change * ahead**2) + abs(pp - change * aside**2)
    second += abs(sp - change * ahead * aside)
    sixth = max((off_s**2 + off_p**2) / sigma**2) ** 3
    error = 0.61 * np.hypot(mean_s, mean_p) / sigma + second / (2 * sigma**2) + 4e-4 * sixth
    # At most 0.4 % of the flux of the trail in a pixel, and 0.05 % of the peak of the star at rest.
    level = min(1.0, fraction * min(4.0, 2.5 * sigma / length))
    assert excess_of_one(xy, np.full((2, 2), np.nan), fraction) == pytest.approx(
        error * max(1 / 4e-3, level / 5e-4), rel=1e-9
    )
    # Of unevenly added samples next to the ends this needs none.
    many = np.concatenate([xy[:1], xy[:1] + 7, xy[1:-1], xy[-1:] - 5, xy[-1:]])
    elapsed = np.linspace(0, 1, 11)[:, np.newaxis]
    assert excess_of_one(many, np.full((2, 2), np.nan), fraction, elapsed) == pytest.approx(
        error * max(1 / 4e-3, level / 5e-4), rel=1e-9
    )


def curved(times: np.ndarray, late: np.ndarray, off_px: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return a path of 8 px, with its rates, px, that is drawn too late and beside itself by some amounts.

    Flux per length 1 + slope m + bend (2/3 - 4 x (1 - x)), m = 2 x - 1; across 8 px x (1 - x) (curvature + skewness m).
    """
    shape = {"slope": 0.12, "bend": 0.2, "curvature": 0.3, "skewness": -0.17}
    grid = np.linspace(0, 1, 20_001)
    m = 2 * grid - 1
    flux = 1 + shape["slope"] * m + shape["bend"] * (2 / 3 - 4 * grid * (1 - grid))
    drawn = np.concatenate([[0.0], np.cumsum((flux[1:] + flux[:-1]) / 2) * (grid[1] - grid[0])])
    x = np.interp(times + late, drawn, grid)
    across = 8 * grid * (1 - grid) * (shape["curvature"] + shape["skewness"] * m)
    p = np.interp(x, grid, across) + off_px
    ends = [(8 / flux[k], (across[k1] - across[k0]) / (grid[1] - grid[0]) / flux[k])
            for k, k0, k1 in ((0, 0, 1), (-1, -2, -1))]  # fmt: skip
    return np.column_stack([8 * x, p]), np.array(ends)


@pytest.mark.parametrize("sign", [-1, 1])
def test_the_error_of_a_longer_path_is_that_of_the_curve_and_the_flux_that_shaders_draw(sign: int) -> None:
    times = np.array([0.0, 0.04, 0.125, 0.25, 0.375, 0.5, 0.625, 0.75, 0.875, 0.96, 1.0])
    wave = np.sin(np.pi * times) * (times - 0.5) * (times != 0.5)
    for late, off_px in ((sign * 0.008 * wave, 0 * wave), (0 * wave, sign * 0.04 * wave), (-0.003 * wave, 0.03 * wave)):
        path, rates = curved(times, late, off_px)
        # What shaders take from the middle and the rates, by the curve's own conditions.
        x, p = path[:, 0] / 8, path[:, 1] / 8
        slope = 4 * x[5] - 2
        bend = (1 / (rates[0, 0] / 8) + 1 / (rates[1, 0] / 8) - 2) * 3 / 4
        skewness = -(rates[0, 1] / rates[0, 0] + rates[1, 1] / rates[1, 0]) / 2
        assert bend == pytest.approx(0.2, abs=1e-9)
        assert skewness == pytest.approx(-0.17, abs=1e-4)
        curvature = p[5] / (x[5] * (1 - x[5])) - skewness * (2 * x[5] - 1)
        density = np.polynomial.Polynomial([1 - slope + bend * 2 / 3, 2 * slope - 4 * bend, 4 * bend])
        is_late = density.integ()(x) - times
        along = 8 * is_late / density(x)
        across = path[:, 1] - 8 * x * (1 - x) * (curvature + skewness * (2 * x - 1))
        distance = np.hypot(along, across).max()
        change = np.abs(np.diff(is_late) / np.diff(times)).max()
        error = min(change, np.abs(along).max() * 0.7 / 1.3) + np.abs(across).max() * 0.7 / 1.3 + 0.3 * curvature**2
        for fraction in (0.05, 0.9):
            level = min(1.0, fraction * 2.5 * 1.3 / 8)
            expected = max(distance / 0.03, error / 4e-3, error * level / 5e-4)
            xy = np.array([40.0, 70.0]) + turned(path, 2.1)
            found = excess_of_one(xy, turned(rates, 2.1), fraction, times[:, np.newaxis])
            assert found == pytest.approx(expected, rel=1e-6)


def test_the_displacement_along_a_path_counts_by_the_smaller_of_its_change_and_its_distance() -> None:
    t = np.arange(9) / 8
    for late, length in (
        (1e-3 * np.sin(2 * np.pi * t), 300.0),
        (0.02 * t * (1 - t) * (t - 0.5), 40.0),
        (5e-4 * (np.arange(9) % 2), 8.0),
    ):
        # A straight path of even flux, that is early by `late`.
        path = np.column_stack([length * (t + late), 0 * t])
        rates = np.full((2, 2), [length, 0.0])
        slope = 4 * (t + late)[4] - 2
        drawn = np.polynomial.Polynomial([1 - slope, 2 * slope])
        is_late = drawn.integ()(t + late) - t
        along = length * np.abs(is_late / drawn(t + late)).max()
        flux_error = min(np.abs(np.diff(is_late)).max() * 8, along * 0.7 / 1.3)
        expected = max(along / 0.03, flux_error / 4e-3)
        assert excess_of_one(path, rates, 1e-3) == pytest.approx(expected, rel=1e-9)


def test_a_path_of_too_uneven_a_flux_cannot_be_drawn() -> None:
    t = np.arange(9) / 8

    def excess(middle: float, start_rate: float, end_rate: float) -> float:
        x = t + 4 * middle * t * (1 - t)
        return excess_of_one(np.column_stack([10 * x, 0 * t]), 10 * np.array([[start_rate, 0], [end_rate, 0]]), 0.1)

    # The variation is 4 middle + 0.75 (1 / start + 1 / end - 2); rates at the ends are more than a third of even ones.
    assert np.isfinite(excess(0.224, 1.0, 1.0))
    assert np.isinf(excess(0.226, 1.0, 1.0))
    assert np.isinf(excess(-0.226, 1.0, 1.0))
    assert np.isfinite(excess(0.0, 1 / 2.19, 1.0))
    assert np.isinf(excess(0.0, 1 / 2.21, 1.0))
    assert np.isinf(excess(0.0, 1.0, 1 / 2.21))
    assert np.isfinite(excess(0.0, 0.334, 1 / 0.19))
    assert np.isinf(excess(0.0, 0.333, 1 / 0.19))
    assert np.isinf(excess(0.0, 1 / 0.19, 0.333))
    assert np.isinf(excess(0.1, 1 / 1.8, 1.0))
    assert np.isnan(excess_of_one(np.full((9, 2), np.nan), np.full((2, 2), 1.0), 0.1))


def test_the_worst_probe_decides_and_short_and_long_paths_are_mixed() -> None:
    t = np.arange(9) / 8
    long = np.column_stack([3.0 + 20 * t, 4.0 + 5 * np.sin(np.pi * t)])
    rates = np.array([[20.0, 5 * np.pi], [20.0, -5 * np.pi]])
    paths = [short_path(1.1, -0.5, 0.3), long, short_path(1.9, 0.9, -0.7), np.tile([5.0, 6.0], (9, 1))]
    each = [excess_of_one(path, rates, 0.3) for path in paths]
    assert each[3] == 0.0
    assert len(set(each)) == 4
    xy = np.stack(paths, axis=1).reshape(9, 2, 2, 2)
    both = segmentation.segment_excess(
        xy, np.tile(rates[:, np.newaxis, np.newaxis], (1, 2, 2, 1)), np.array([0.3, 0.3]), 1.3, 0.03
    )
    np.testing.assert_allclose(both, [max(each[:2]), max(each[2:])], rtol=1e-12)
    # Two sigma decide how it is drawn: 2.6 px.
    assert np.isinf(excess_of_one(short_path(2.61, 0.6, 0.0), np.zeros((2, 2)), 0.3))
    assert np.isfinite(excess_of_one(short_path(2.59, 0.6, 0.0), np.zeros((2, 2)), 0.3))


def evaluator(nodes_s: np.ndarray, C_at_nodes: np.ndarray | None = None, **changed: object) -> object:
    found = segmentation._SegmentEvaluator(SimpleNamespace(), nodes_s, LENS, 1.3, 0.03)
    found._at_nodes = SimpleNamespace(C_camera_eq=C_at_nodes)
    return found


def test_segments_are_evaluated_at_even_times_and_at_samples_near_their_ends() -> None:
    nodes_s = np.array([10.0, 10.02, 10.3, 10.5, 10.81, 10.99, 11.0])
    begins, ends = np.array([10.0, 10.3, 10.82]), np.array([10.5, 11.0, 10.98])
    at = evaluator(nodes_s)._elapsed(begins, ends)
    # Three samples inside the second segment are four intervals: 8 parts do.
    inner = np.tile(np.arange(1, 8)[:, np.newaxis] / 8, 3)
    after, before = [0.04, 0.125, 0.125], [0.125, 0.01 / 0.7, 0.125]
    expected = np.vstack([np.zeros(3), after, inner, 1 - np.array(before), np.ones(3)])
    np.testing.assert_allclose(at, expected, rtol=0, atol=1e-12)
    # Four inside are five intervals, for which 8 are too few: the number is doubled.
    for inside, samples in ((3, 8), (4, 16), (7, 16), (8, 32)):
        nodes_s = np.linspace(0.0, 1.0, inside + 2)
        assert len(evaluator(nodes_s)._elapsed(np.array([0.0]), np.array([1.0]))) == samples + 3
    times_s = segmentation._times_s(
        np.array([3.0, 7.0]), np.array([4.0, 9.1]), np.array([[0.0, 0], [0.25, 0.5], [1, 1]])
    )
    np.testing.assert_allclose(times_s, [3.0, 3.25, 4.0, 7.0, 8.05, 9.1], rtol=1e-12)


def test_the_turn_rate_is_discontinuous_where_it_changes_by_more_than_a_thousandth_of_the_largest() -> None:
    steps_s = np.array([0.1, 0.2, 0.1, 0.3, 0.1])
    nodes_s = 5.0 + np.concatenate([[0.0], np.cumsum(steps_s)])
    rates = np.array([[2.0, 0, 0], [2.0, 0.00199, 0], [2.0, 0.00199 + 0.00202, 0], [1, 0, 0], [1, 0.0, 0.0]])
    C = [np.eye(3)]
    for step_s, rate in zip(steps_s, rates, strict=True):
        C.append(Rotation.from_rotvec(-rate * step_s).as_matrix() @ C[-1])
    breaks_s = evaluator(nodes_s, np.array(C))._rate_discontinuities_s
    np.testing.assert_allclose(breaks_s, nodes_s[[0, 2, 3, 5]], rtol=1e-12)


def test_a_segment_is_divided_at_the_break_nearest_to_its_middle_or_into_as_many_parts_as_its_error_needs() -> None:
    one = evaluator(np.array([0.0, 10.0]))
    one._rate_discontinuities_s = np.array([0.0, 1.0, 3.0, 8.0, 10.0])
    # The middles 2 and 5.5 have two breaks at the same distance, of which the first is taken.
    begins, ends = np.array([0.0, 2.0, 0.0]), np.array([4.0, 9.0, 10.0])
    starts, stops = one._divided(begins, ends, np.full(3, 9.9))
    np.testing.assert_allclose(starts, [0, 2, 0, 1, 3, 3], rtol=0, atol=1e-12)
    np.testing.assert_allclose(stops, [1, 3, 3, 4, 9, 10], rtol=0, atol=1e-12)
    # Breaks at the ends themselves and beyond do not count; the error falls with the third power of the length.
    begins, ends = np.array([1.0, 3.0, 2.5, 8.0, 8.2]), np.array([3.0, 8.0, 3.1, 10.0, 9.8])
    excess = np.array([8.1, 1.1, 5.0, np.inf, 30_000.0])
    starts, stops = one._divided(begins, ends, excess)
    expected = [2.5, 3.0, 1.0, 5 / 3, 7 / 3, 3.0, 5.5, 8.0, 8.5, 9.0, 9.5, *(8.2 + 1.6 * np.arange(24) / 24)]
    np.testing.assert_allclose(starts, expected, rtol=0, atol=1e-12)
    expected = [3.0, 3.1, 5 / 3, 7 / 3, 3.0, 5.5, 8.0, 8.5, 9, 9.5, 10, *(8.2 + 1.6 * np.arange(1, 25) / 24)]
    np.testing.assert_allclose(stops, expected, rtol=0, atol=1e-12)
    # A break that is later by less than 20 us counts as at the same distance.
    for after, expected in ((3.0 - 1.9e-5, 1.0), (3.0 - 2.1e-5, 3.0 - 2.1e-5)):
        one._rate_discontinuities_s = np.array([-9.0, 1.0, after, 19.0])
        assert one._divided(np.array([0.0]), np.array([4.0]), np.array([2.0]))[0][1] == expected


class Counted:
    """An evaluator whose error is that of a length that is allowed, and which has no breaks."""

    limit_s = 0.0
    evaluated: ClassVar[list[int]] = []
    position_px: ClassVar[list[float]] = []

    @classmethod
    def of(cls, monkeypatch: pytest.MonkeyPatch, limit_s: float) -> type[Self]:
        def evaluate(self: object, *several: segmentation.Segments) -> Iterator[np.ndarray]:
            cls.evaluated.append(len(several))
            cls.position_px.append(self._position_px)
            for begins, ends in several:
                yield ((ends - begins) / limit_s) ** 3

        cls.evaluated, cls.position_px = [], []
        monkeypatch.setattr(segmentation._SegmentEvaluator, "evaluate", evaluate)
        monkeypatch.setattr(segmentation._SegmentEvaluator, "_rate_discontinuities_s", np.array([-1e9, 1e9]))
        return cls


def test_an_exposure_has_as_many_segments_as_its_error_needs_or_none(monkeypatch: pytest.MonkeyPatch) -> None:
    nodes_s = np.array([100.0, 100.3, 101.0])

    def found(**most: float) -> np.ndarray | None:
        return segment_times(None, nodes_s, LENS, 1.2, **most)

    Counted.of(monkeypatch, 0.11)
    np.testing.assert_allclose(found(), 100 + np.arange(21) / 20, rtol=0, atol=1e-9)
    assert Counted.evaluated == [1, 1]
    # Of at most 15 segments 10 parts are tried, which are short enough.
    np.testing.assert_allclose(found(most=15), 100 + np.arange(21) / 20, rtol=0, atol=1e-9)
    assert Counted.evaluated == [1, 1, 2, 1]
    # Of at most 14 segments 9 parts are tried, each of which has to be divided by two.
    assert found(most=14) is None
    assert found(most=1) is None
    Counted.of(monkeypatch, 1.0)
    np.testing.assert_allclose(found(most=1), [100.0, 100.5, 101.0], rtol=0, atol=1e-9)
    assert (Counted.evaluated, Counted.position_px) == ([2], [0.02])
    found(position_px=0.007)
    assert Counted.position_px == [0.02, 0.007]
    np.testing.assert_array_equal(segmentation._trial_parts(nodes_s, 1), [[100.0], [101.0]])
    np.testing.assert_allclose(
        segmentation._trial_parts(nodes_s, 10), [100 + np.arange(7) / 7, 100 + np.arange(1, 8) / 7], rtol=1e-12
    )


def test_an_exposure_takes_more_segments_only_if_those_that_remain_exceed_a_number() -> None:
    class Scripted(NamedTuple):
        steps: list[tuple[int, int]]

        def refined(self, parts: object, excess: object) -> Iterator[tuple[np.ndarray, int]]:
            assert (parts, excess) == ("parts", "excess")
            yield from ((np.zeros(begins), remaining) for begins, remaining in self.steps)

    def takes_more(steps: list[tuple[int, int]], most: int) -> bool:
        return segmentation._takes_more(Scripted(steps), "parts", "excess", most)

    assert not takes_more([(3, 4), (4, 0)], 7)
    assert takes_more([(3, 4), (4, 0)], 6)
    assert takes_more([(3, 2), (1, 5), (5, 0)], 8)
    assert not takes_more([(3, 2), (1, 5), (5, 0)], 9)
    # What is known when nothing remains decides nothing: there are fewer parts than segments are allowed.
    assert not takes_more([(9, 0)], 5)


def test_errors_are_evaluated_for_stars_all_over_the_field_in_the_middle_of_each_segment(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    simulator = rolling(np.linspace(0.0, 1.0, 11), np.linspace(0.0, 0.4, 11) ** 2)
    nodes_s = NIGHT_UTC_S + np.array([0.2, 0.3, 0.5, 0.9])
    one = segmentation._SegmentEvaluator(simulator.motion, nodes_s, LENS, 1.3, 0.03)
    begins, ends = NIGHT_UTC_S + np.array([0.2, 0.5]), NIGHT_UTC_S + np.array([0.5, 0.9])
    requests = []

    def pointings(*times_s: np.ndarray) -> list[Pointing]:
        requests.append([len(each) for each in times_s])
        return simulator.motion.pointings(*times_s)

    one._motion = SimpleNamespace(pointings=pointings)
    elapsed = one._elapsed(begins, ends)
    pointing = simulator.pointing(segmentation._times_s(begins, ends, elapsed))
    xy, rates = segmentation._probe_paths(pointing, 2, LENS)
    rays = probe_rays(LENS).T
    assert xy.shape == (11, 2, 9, 2)
    for k in range(2):
        of = pointing[np.arange(11 * k, 11 * k + 11)]
        directions = rays @ of.C_camera_eq[5]
        vectors = of.to_camera(directions, below_horizon=True)
        np.testing.assert_allclose(xy[:, k], LENS.project(vectors), rtol=0, atol=1e-6)
        weight = end_weights(of.C_camera_eq[:1], of.C_camera_eq[-1:])
        expected = end_rates_px(LENS, vectors[0] * weight, vectors[5], vectors[10] * weight)
        np.testing.assert_allclose(rates[:, k], expected, rtol=0, atol=1e-5)
    (excess,) = one.evaluate((begins, ends))
    fraction = np.array([3 / 7, 4 / 7])
    np.testing.assert_allclose(excess, segmentation.segment_excess(xy, rates, fraction, 1.3, 0.03, elapsed), rtol=1e-6)
    # The nodes are requested once, with the first segments; the error of less than 20 us is none.
    assert requests == [[4, 22]]
    short = NIGHT_UTC_S + np.array([0.4, 0.4]), NIGHT_UTC_S + np.array([0.4 + 1.9e-5, 0.4 + 2.1e-5])
    assert (next(one.evaluate(short, (begins, ends))) > 0).tolist() == [False, True]
    assert requests == [[4, 22], [22, 22]]
    monkeypatch.setattr(segmentation, "segment_excess", lambda *of: of[2] + of[3] + of[4])
    np.testing.assert_allclose(next(one.evaluate((begins, ends))), fraction + 1.3 + 0.03, rtol=1e-6)


def test_simpsons_rule_is_exact_for_third_powers_and_even_fractions_end_at_one() -> None:
    for count in (3, 9, 17):
        t = segmentation._even_fractions(count)
        np.testing.assert_allclose(t, np.linspace(0, 1, count), rtol=0, atol=1e-15)
        weights = segmentation._simpson_weights(count)
        np.testing.assert_allclose([weights @ t**k for k in range(4)], [1, 1 / 2, 1 / 3, 1 / 4], rtol=1e-12)
        np.testing.assert_allclose(weights, simpson(np.eye(count), dx=1 / (count - 1)), rtol=1e-12)
        assert not weights.flags.writeable
        assert not t.flags.writeable
