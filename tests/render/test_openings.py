"""When all rows are open that a star lights, and which pieces are recorded in part, by roots and one star at a time."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.optimize import brentq
from scipy.spatial.transform import Rotation

from glstar.camera.sensor.sensor import Sensor
from glstar.render.motion.pointing import Pointing
from glstar.render.motion.trailmodels import AnalyticSegments, CameraPath
from glstar.render.readout import openings as openings_module
from glstar.render.readout.openings import (
    OpenPieces,
    OpenSpans,
    PixelOpenings,
    _meeting,
    _zone_times,
    are_worth_dividing,
    divided_trails,
    end_pieces,
    open_pieces,
    open_spans,
    overtaking,
    whole_trails,
)
from glstar.render.scene.culling import DrawList
from glstar.render.scene.occlusion import NEVER
from tests.render.test_camerapath import trails as curved_trails
from tests.support.scenes import camera, star_field

LENS = camera(320, 240, 300.0)
MARKS = np.array([0.0, 0.15, 0.6, 1.0])
# The camera turns by this in the exposure, rad; rows open in 0.3 of it.
TURN = np.array([0.27, -0.15, 0.0])
PER_PX = 0.3 / 239


def turning(times: np.ndarray, turn: np.ndarray = TURN) -> Pointing:
    C = Rotation.from_rotvec(-np.outer(times, turn)).as_matrix()
    return Pointing(C, np.tile([0.0, 0, 1], (len(times), 1)), np.zeros((len(times), 3)), 0.0)


def segments(turn: np.ndarray = TURN) -> AnalyticSegments:
    return AnalyticSegments(turning(np.interp(np.arange(7) / 2, np.arange(4), MARKS), turn), np.diff(MARKS))


def openings() -> PixelOpenings:
    return PixelOpenings(0.7, PER_PX, lambda xy: PER_PX * xy[:, 1])


PLACES_PX = np.array([(40.0, 60), (160, 120), (300, 200), (100, 25), (250, 235), (20, -30), (200, 280)])


def scene(turn: np.ndarray = TURN) -> SimpleNamespace:
    stars = star_field(LENS.unit_vectors(PLACES_PX) @ turning(np.array([0.5]), turn).C_camera_eq[0], np.ones(7))
    return SimpleNamespace(
        trails=segments(turn), camera=LENS, stars=stars, sensor=Sensor(psf_sigma_px=1.2),
        draw_list=DrawList(np.arange(7, dtype=np.int32)[::-1], np.linspace(3.0, 9.0, 7)),
    )  # fmt: skip


def test_all_rows_are_open_from_the_last_opening_that_a_star_meets_to_the_first_closing() -> None:
    one, reach_px = scene(), np.linspace(2.0, 8.0, 7)
    spans = open_spans(one, reach_px, openings())
    rates = one.trails.pointing.rotation_rad / np.repeat(np.diff(MARKS) / 2, 2)
    ratio = rates.max() * LENS.max_px_per_rad * PER_PX
    assert overtaking(one.trails, LENS, openings()) == pytest.approx(ratio, rel=1e-12)
    assert 0.1 < ratio < 0.3
    for k, star in enumerate(one.draw_list.index):

        def row(time: float, star: int = star) -> float:
            (C,) = turning(np.array([time])).C_camera_eq
            return float(np.clip(PER_PX * LENS.project(C @ one.stars.direction_eq[star])[1], 0.0, 0.3))

        opens = brentq(lambda t: t - row(t), -1e-9, 0.3 + 1e-9)
        closes = brentq(lambda t: t - 0.7 - row(t), 0.7 - 1e-9, 1 + 1e-9)
        # And half a pixel, for the path between the times of segments.
        around = PER_PX * (reach_px[k] + 0.5) / (1 - ratio)
        assert spans.begin[k] == pytest.approx(min(opens + around, 0.3), abs=2e-5)
        assert spans.end[k] == pytest.approx(max(closes - 0.7 - around, 0.0) + 0.7, abs=2e-5)
        assert spans.opens[k] == pytest.approx(max(opens - around, 0.0), abs=2e-5)
        assert spans.closes[k] == pytest.approx(min(closes + around, 1.0), abs=2e-5)
    # Stars that are nearly as fast as the readout are not divided.
    for factor, is_known in ((0.89, True), (0.91, False)):
        fast = openings_module.replace(openings(), per_px=PER_PX * factor / ratio)
        assert (open_spans(one, reach_px, fast) is not None) == is_known


@pytest.mark.parametrize(("begin", "end", "ends", "parts"), [
    (0.0, 0.3, [0.0, 0.15, 0.3], 6), (0.7, 1.0, [0.7, 1.0], 12), (0.1, 0.9, [0.1, 0.15, 0.6, 0.9], 4),
    (0.15, 0.6, [0.15, 0.6], 12),
])  # fmt: skip
def test_zones_are_divided_evenly_in_each_segment(begin: float, end: float, ends: list[float], parts: int) -> None:
    times, is_inner = _zone_times(segments(), begin, end)
    count = len(ends) - 1
    np.testing.assert_allclose(times, np.interp(np.arange(count * parts + 1) / parts, np.arange(count + 1), ends),
                               rtol=0, atol=1e-12)  # fmt: skip
    assert is_inner.tolist() == [k % parts != 0 for k in range(count * parts)] + [False]
    many = AnalyticSegments(turning(np.arange(41) / 40), np.full(20, 0.05))
    times, _ = _zone_times(many, 0.0, 1.0)
    np.testing.assert_allclose(times, np.arange(41) / 40, rtol=0, atol=1e-12)


def test_a_star_meets_the_row_that_opens_where_lines_between_times_cross() -> None:
    times = np.array([0.0, 0.1, 0.2, 0.3])
    is_inner = np.array([False, True, True, False])
    rows = np.array(
        [[0.05, 0.12, 0.18, 0.2], [-0.2, -0.1, 0.0, 0.0], [0.5, 0.45, 0.4, 0.35], [0.25, 0.25, 0.25, 0.25]]
    ).T
    meets, bend = _meeting(times, is_inner, rows, 0.3)
    # 0.05 + 0.7 t up to 0.1, then 0.12 + 0.6 (t - 0.1): t = 0.15; at the border rows 0 and 0.3.
    np.testing.assert_allclose(meets, [0.15, 0.0, 0.3, 0.25], rtol=0, atol=1e-12)
    # A quarter of the largest second difference at an inner time.
    np.testing.assert_allclose(bend, [0.04 / 4, 0.1 / 4, 0, 0], rtol=0, atol=1e-12)


def test_pieces_are_recorded_in_full_that_lie_within_the_time_of_all_rows() -> None:
    ends = np.array([0.0, 0.1, 0.3, 0.6, 0.8, 1.0])
    begin, end = np.array([0.05, 0.1, 0.31, 0.0, np.nan, 0.61]), np.array([0.85, 0.8, 0.59, 1.0, np.nan, 0.7])
    spans = OpenSpans(begin, end, begin - 0.01, end + 0.01)
    found = open_pieces(spans, ends)
    assert found.first.tolist() == [1, 1, 3, 0, 5, 4]
    assert found.last.tolist() == [4, 4, 3, 5, 5, 4]
    assert (found.opens is spans.opens, found.closes is spans.closes) == (True, True)
    some = found.of(np.array([True, False, True, False, False, False]))
    assert (some.first.tolist(), some.last.tolist()) == ([1, 3], [4, 3])
    np.testing.assert_allclose([some.opens, some.closes], [[0.04, 0.3], [0.86, 0.6]], rtol=1e-12)


@pytest.mark.parametrize("has_cloud", [False, True])
def test_pieces_at_the_ends_lie_between_the_first_opening_and_the_full_ones_and_after_those(has_cloud: bool) -> None:
    path = CameraPath(curved_trails(), LENS)
    bounds = np.array([0.0, 0.4, 0.8, 1.3, 2.0, 2.6, 3.0])
    ends = np.array([0.0, 0.4, 0.8, 1.0, 1.3, 2.0, 2.6, 3.0])
    times = np.interp(ends, np.arange(4), [0.0, 0.2, 0.5, 1.0])
    recorded = OpenPieces(
        np.array([2, 1, 3]), np.array([4, 5, 4]), np.array([0.05, -1e-3, 0.17]), np.array([0.9, 0.85, 0.6])
    )
    passage = np.arange(15, dtype=np.float32).reshape(5, 3) if has_cloud else None
    found = end_pieces(path, bounds, np.array([4, 0, 2]), recorded, passage)
    expected = []
    for star, first, last, opens, closes in zip(
        (4, 0, 2), (2, 1, 3), (5, 6, 5), recorded.opens, recorded.closes, strict=True
    ):
        # Numbers of `ends`: those of the bounds, of which the fourth and the next come one later.
        begin = first if first < 3 else 4
        expected += [(star, k) for k in range(begin) if times[k + 1] > opens]
        expected += [(star, k) for k in range(last, 7) if times[k] < closes]
    drawn = sorted({k for _, k in expected})
    np.testing.assert_allclose(found.begin, times[drawn], rtol=0, atol=1e-12)
    np.testing.assert_allclose(found.duration, np.diff(times)[drawn], rtol=0, atol=1e-12)
    pairs = list(zip(found.star.tolist(), (drawn[k] for k in found.piece), strict=True))
    assert sorted(pairs) == sorted(expected)
    pointing = path.pointings(ends[drawn], ends[np.array(drawn) + 1])
    np.testing.assert_allclose(found.pointing.C_camera_eq, pointing.C_camera_eq, rtol=0, atol=1e-12)
    if has_cloud:
        np.testing.assert_array_equal(found.passage, passage[:, ends[drawn].astype(int)])
    else:
        assert found.passage is None


def test_trails_are_divided_from_thirty_sigma_per_segment_on() -> None:
    longest_px = segments().longest_trail_px(LENS)
    for sigma_px, is_worth in ((longest_px / 3 / 30.5, True), (longest_px / 3 / 29.5, False)):
        assert are_worth_dividing(segments(), LENS, sigma_px) == is_worth
    short = scene(np.array([0.09, -0.05, 0.0]))
    assert divided_trails(short, short.trails, openings()) is None
    long = scene()
    assert divided_trails(long, long.trails, openings()) is not None
    # As fast as the readout.
    assert divided_trails(long, long.trails, replace(openings(), per_px=0.01)) is None


def test_a_long_trail_is_divided_into_the_part_of_all_open_rows_and_pieces_at_its_ends() -> None:
    turn = np.array([0.4, -0.3, 0.0])
    one = scene(turn)
    fast = PixelOpenings(0.7, 0.3 / 239 / 3, lambda xy: 0.3 / 239 / 3 * xy[:, 1])
    whole = whole_trails(one, one.trails)
    assert whole.star.tolist() == list(range(7))
    is_up = (whole.rises_and_sets == [0.0, NEVER]).all(axis=1)
    assert is_up.all()
    found = divided_trails(one, one.trails, fast)
    spans = open_spans(one, one.draw_list.truncation_radius_px, fast)
    path = CameraPath(one.trails, LENS)
    even = path.bounds_of_equal_lengths(1.6 * one.sensor.effective_sigma_px)
    at = np.interp(even, np.arange(4), MARKS)
    limits = np.interp([0.3, 0.7], MARKS, np.arange(4))
    bounds = np.unique([*even[at <= 0.3], *even[at >= 0.7], *limits])
    times = np.interp(bounds, np.arange(4), MARKS)
    assert found.whole.star.size == 0
    assert found.while_open.star.tolist() == list(range(7))
    begin = [times[np.flatnonzero(times >= t - 1e-12)[0]] for t in spans.begin]
    end = [times[np.flatnonzero(times <= t + 1e-12)[-1]] for t in spans.end]
    np.testing.assert_allclose(found.while_open.rises_and_sets, np.column_stack([begin, end]), rtol=0, atol=1e-12)
    first = np.array([found.ends.begin[found.ends.piece[found.ends.star == star]].min() for star in range(7)])
    assert (first <= spans.opens + 1e-12).all()
    # Stars that rise or set are drawn whole.
    setting = replace(one.trails.pointing, zenith_eq=np.tile([0.0, 0.0, -1.0], (7, 1)))
    below = SimpleNamespace(**vars(one) | {"trails": replace(one.trails, pointing=setting)})
    none = divided_trails(below, below.trails, fast)
    assert none.whole.star.tolist() == list(range(7))
    assert none.while_open.star.size == none.ends.star.size == 0
    some = whole.of(np.array([True, False, False, True, False, False, False]))
    assert some.star.tolist() == [0, 3]
    assert some.rises_and_sets.shape == (2, 2)
