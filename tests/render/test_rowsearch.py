"""The search for the times at which rows record stars, of a camera that turns steadily, by roots and by sums."""

from types import SimpleNamespace

import numpy as np
import pytest
from scipy.optimize import brentq
from scipy.spatial.transform import Rotation

from glstar.camera.exposure import Exposure
from glstar.flight import AttitudeTrack
from glstar.render.motion.pointing import MotionTable, Pointing
from glstar.render.motion.starpaths import SampledPaths
from glstar.render.readout import rows
from glstar.render.readout.rows import OpenPath, RecordedTimes, RowTimeSearch
from tests.support.scenes import NIGHT_UTC_S, camera

LENS = camera(320, 240, 300.0)
# Down the image and across it, rad/s; the image is 0.78 rad high.
RATES = np.array([0.4, -0.25, 0.1])


def turning(since_s: np.ndarray, rates: np.ndarray) -> Pointing:
    C = Rotation.from_rotvec(-np.outer(since_s, rates)).as_matrix()
    return Pointing(C, np.tile([0.0, 0.6, 0.8], (len(since_s), 1)), np.zeros((len(since_s), 3)), 0.0)


def search(exposure: Exposure, rates: np.ndarray = RATES, shorts: tuple[object, ...] = ()) -> RowTimeSearch:
    """Return the search in a scene whose attitude log has a sample every 0.1 s."""

    def pointings(*times_s: np.ndarray) -> list[Pointing]:
        assert max(each.max() for each in times_s) <= exposure.stop_utc_s
        return [turning(each - NIGHT_UTC_S, rates) for each in times_s]

    times_s = NIGHT_UTC_S + np.arange(-10, 40) / 10
    q = np.roll(Rotation.from_rotvec(np.outer(times_s - NIGHT_UTC_S, rates)).as_quat(), 1, axis=1)
    attitude = AttitudeTrack.from_samples(times_s, q)
    motion = SimpleNamespace(pointings=pointings, flight=SimpleNamespace(attitude=attitude))
    return RowTimeSearch(SimpleNamespace(exposure=exposure, camera=LENS, motion=motion, shorts=shorts))


def delay_s(exposure: Exposure, xy_px: np.ndarray) -> np.ndarray:
    """Return how long after the first row those at positions open, which are beside the image as at its border."""
    axis, count = (1, 240) if exposure.readout in {"down", "up"} else (0, 320)
    row = xy_px[..., axis] if exposure.readout in {"down", "right"} else count - 1 - xy_px[..., axis]
    return exposure.readout_s * np.clip(row, 0, count - 1) / (count - 1)


def at(since_s: float, direction: np.ndarray, start_s: float, rates: np.ndarray = RATES) -> np.ndarray:
    pointing = turning(np.array([start_s + since_s]), rates)
    return LENS.project(pointing.C_camera_eq[0] @ direction)


PLACES_PX = [(40, 30), (300, 20), (160, 120), (20, 225), (310, 210), (150, 239), (150, 0), (200, 260), (100, -30)]


@pytest.mark.parametrize("has_table", [True, False])
@pytest.mark.parametrize("readout", ["down", "up", "left", "right"])
def test_a_star_is_recorded_from_the_meeting_with_the_opening_row_to_that_with_the_closing_one(
    readout: str, has_table: bool
) -> None:
    exposure = Exposure(NIGHT_UTC_S + 0.3, 0.15, readout_s=0.1, readout=readout)
    one = search(exposure)
    if not has_table:
        vars(one)["_table"] = None
    directions = LENS.unit_vectors(PLACES_PX) @ turning(np.array([0.425]), RATES).C_camera_eq[0]
    found = one.times(directions)
    assert one._may_overtake_rows != has_table
    for star, direction in enumerate(directions):
        ends = [
            brentq(lambda t, d=direction, late=late: t - late - delay_s(exposure, at(t, d, 0.3)), -1e-9, 0.25 + 1e-9)
            for late in (0.0, 0.15)
        ]
        assert found.opens_s[star] == pytest.approx(ends[0], abs=1e-7)
        assert found.closes_s[star] == pytest.approx(ends[1], abs=1e-7)
        assert found.exposed_s[star] == pytest.approx(ends[1] - ends[0], abs=2e-4 if not has_table else 1e-7)
        assert found.mid_offset_s[star] == pytest.approx(sum(ends) / 2 - 0.125, abs=1e-7)
        expected = [at(time, direction, 0.3) for time in (ends[0], sum(ends) / 2, ends[1])]
        np.testing.assert_allclose(found.positions[:, star], expected, rtol=0, atol=1e-4)
    assert found.shorts == ()
    path = OpenPath.of(found)
    np.testing.assert_array_equal(path.first_px.T, found.positions[0])
    np.testing.assert_array_equal(path.last_px.T, found.positions[2])
    assert (path.opens_s is found.opens_s, path.closes_s is found.closes_s) == (True, True)


def test_openings_are_searched_while_rows_open_or_all_the_time_where_stars_may_overtake_them() -> None:
    exposure = Exposure(NIGHT_UTC_S + 0.3, 0.15, readout_s=0.1)
    slow = search(exposure)
    np.testing.assert_allclose(slow._grids_s, [np.arange(6) * 0.02, 0.15 + np.arange(6) * 0.02], rtol=0, atol=1e-12)
    since = slow._since_opening_s(LENS.unit_vectors(PLACES_PX))
    expected = turning(0.3 + slow._grids_s.ravel(), RATES).to_camera(LENS.unit_vectors(PLACES_PX))
    delays_s = delay_s(exposure, np.nan_to_num(LENS.project(expected))).reshape(2, 6, -1)
    np.testing.assert_allclose(since, slow._grids_s[:, :, np.newaxis] - delays_s, rtol=0, atol=1e-6)
    # Half as fast as the rows of 0.1 s / 239, anywhere on the image.
    rate = 0.5 * 239 / 0.1 / LENS.max_px_per_rad
    for readout, factor, may_overtake in (("down", 0.98, False), ("down", 1.02, True), ("up", 1.02, True),
                                          ("left", 1.02, False), ("left", 0.98 * 319 / 239, False),
                                          ("left", 1.02 * 319 / 239, True)):  # fmt: skip
        fast = search(
            Exposure(NIGHT_UTC_S + 0.3, 0.15, readout_s=0.1, readout=readout), np.array([0, factor * rate, 0])
        )
        assert fast._may_overtake_rows == may_overtake
        if may_overtake:
            np.testing.assert_allclose(fast._grids_s, np.tile(np.arange(65) * 0.25 / 64, (2, 1)), rtol=0, atol=1e-12)
    assert slow.frame_keys["readout_s"] == 0.1
    assert slow.frame_keys["readout"] == "down"
    np.testing.assert_allclose(slow.frame_keys["rates_rad_per_s"], RATES, rtol=1e-3)


def test_a_star_that_crosses_the_opening_rows_several_times_is_recorded_while_its_row_is_open() -> None:
    exposure = Exposure(NIGHT_UTC_S, 0.15, readout_s=0.1)
    one = search(exposure)
    vars(one)["_grids_s"] = np.tile(np.arange(7) * 0.25 / 6, (2, 1))
    since = np.array([[-0.05, 0.02, 0.1, 0.14, 0.16, 0.2, 0.3], [-0.05, 0.02, -0.03, 0.06, 0.2, 0.1, 0.2],
                      [0.1, 0.1, 0.1, -0.1, -0.1, 0.3, 0.3], [0.0, 0.0, 0.15, 0.15, 0.16, 0.16, 0.2]]).T  # fmt: skip
    found = one._open_s(since, np.array([1.0, 2.0, 3.0, 4.0]))
    dense = np.array([np.interp(np.linspace(0, 6, 600_001), np.arange(7), of) for of in since.T])
    expected = ((dense >= 0) & (dense <= 0.15)).mean(axis=1) * 0.25
    # The first one never goes back.
    assert found[0] == 1.0
    np.testing.assert_allclose(found[1:], expected[1:], rtol=0, atol=1e-5)


def times(opens: list[float], closes: list[float], seed: int) -> RecordedTimes:
    rng = np.random.default_rng(seed)
    a, b = np.array(opens), np.array(closes)
    return RecordedTimes(a, b, 0.9 * (b - a), rng.uniform(0, 200, (3, len(a), 2)), (a + b) / 2 - 0.125)


def test_the_times_of_a_stack_join_those_of_its_short_exposures(monkeypatch: pytest.MonkeyPatch) -> None:
    short = Exposure(NIGHT_UTC_S, 0.15, readout_s=0.1)
    stack = Exposure(NIGHT_UTC_S, 0.15, readout_s=0.1, frames=3, gap_s=0.02)
    scenes = tuple(SimpleNamespace(exposure=short, camera=LENS, motion=object(), shorts=()) for _ in range(3))
    one = search(stack, shorts=scenes)
    # The second star closes when it opens again, to 9 us, the third to 11 us; the fourth much later.
    of_shorts = [
        times([0.01, 0.02, 0.03, 0.04], [0.20, 0.191, 0.201011, 0.25], 1),
        times([0.035, 0.021009, 0.031, 0.05], [0.18, 0.2, 0.2, 0.2], 2),
        times([0.05, 0.03, 0.030009, 0.06], [0.19, 0.21, 0.22, 0.23], 3),
    ]
    before = [each.positions.copy() for each in of_shorts]
    for own, given in zip(one._shorts, of_shorts, strict=True):
        monkeypatch.setattr(own, "times", lambda _directions, given=given: given)
    directions = LENS.unit_vectors(PLACES_PX[:4])
    found = one.times(directions)
    np.testing.assert_allclose(found.opens_s, [0.01, 0.02, 0.03, 0.04], rtol=1e-12)
    np.testing.assert_allclose(found.closes_s, 0.34 + np.array([0.19, 0.21, 0.22, 0.23]), rtol=0, atol=5e-7)
    np.testing.assert_allclose(found.exposed_s, sum(each.exposed_s for each in of_shorts), rtol=1e-12)
    middle_s = (found.opens_s + found.closes_s) / 2
    np.testing.assert_allclose(found.mid_offset_s, middle_s - stack.span_s / 2, rtol=0, atol=1e-12)
    np.testing.assert_array_equal(found.positions[0], before[0][0])
    np.testing.assert_array_equal(found.positions[2], before[2][2])
    expected = [at(time, direction, 0.0) for time, direction in zip(middle_s, directions, strict=True)]
    np.testing.assert_allclose(found.positions[1], expected, rtol=0, atol=1e-4)
    assert found.shorts == tuple(of_shorts)
    # 0.191 and 0.17 + 0.021009; of the second and the third 0.2 and 0.17 + 0.030009.
    np.testing.assert_array_equal(of_shorts[0].positions[2, [0, 2, 3]], before[0][2, [0, 2, 3]])
    np.testing.assert_array_equal(of_shorts[0].positions[2, 1], before[1][0, 1])
    np.testing.assert_array_equal(of_shorts[1].positions[2, [0, 3]], before[1][2, [0, 3]])
    np.testing.assert_array_equal(of_shorts[1].positions[2, [1, 2]], before[2][0, [1, 2]])
    some = found[np.array([3, 1])]
    assert some.opens_s.tolist() == [0.04, 0.02]
    assert some.closes_s.tolist() == found.closes_s[[3, 1]].tolist()
    assert some.exposed_s.tolist() == found.exposed_s[[3, 1]].tolist()
    assert some.mid_offset_s.tolist() == found.mid_offset_s[[3, 1]].tolist()
    np.testing.assert_array_equal(some.positions, found.positions[:, [3, 1]])
    assert [short.opens_s.tolist() for short in some.shorts] == [[0.04, 0.02], [0.05, 0.021009], [0.06, 0.03]]


def test_the_columns_of_truth_are_rounded_and_light_is_that_of_the_time_that_is_recorded() -> None:
    recorded = times([0.01], [0.2], 1)
    recorded = RecordedTimes(recorded.opens_s, recorded.closes_s, np.array([0.123456789]), recorded.positions,
                             np.array([-0.0123456789]))  # fmt: skip
    stack = Exposure(NIGHT_UTC_S, 0.15, frames=3, readout_s=0.1)
    assert rows.exposed_fraction(stack, None) == 1.0
    np.testing.assert_allclose(rows.exposed_fraction(stack, recorded), [0.123456789 / 0.45], rtol=1e-12)
    columns = rows.row_columns(SimpleNamespace(exposure=stack), recorded, np.array([1000.0]))
    assert {name: values.tolist() for name, values in columns.items()} == {
        "mid_offset_s": [-0.01234568], "exposed_s": [0.12345679], "light_dn": [274.34842],
    }  # fmt: skip
    assert rows.row_columns(SimpleNamespace(exposure=stack), None, np.array([1000.0])) == {}


def paths_of(parts: list[np.ndarray]) -> list[SampledPaths]:
    return [SampledPaths(np.full((2, len(part), 2), float(k)), part) for k, part in enumerate(parts)]


@pytest.mark.parametrize("is_stack", [False, True])
def test_parts_of_a_path_are_recorded_by_the_times_since_they_began(is_stack: bool) -> None:
    exposure = Exposure(NIGHT_UTC_S, 0.15, readout_s=0.1)
    paths = paths_of([np.array([0.2, 0.3]), np.array([0.5])])
    short = SimpleNamespace(exposure=exposure, star_paths=lambda _directions: iter(paths))
    each = [times([0.01, 0.05], [0.2, 0.15], 1), times([0.03, 0.02], [0.17, 0.24], 2)]
    scene = SimpleNamespace(shorts=(short, short) if is_stack else (), exposure=exposure, star_paths=short.star_paths)
    recorded = (
        each[0] if not is_stack else RecordedTimes(*(np.zeros(2),) * 3, np.zeros((3, 2, 2)), np.zeros(2), tuple(each))
    )
    found = list(rows.recorded_parts(scene, np.zeros((2, 3)), recorded))
    of = each if is_stack else each[:1]
    assert len(found) == 2 * len(of)
    for k, part in enumerate(found):
        begin = [0.0, 0.5][k % 2]
        assert part.paths is paths[k % 2]
        np.testing.assert_allclose(part.opens, of[k // 2].opens_s / 0.25 - begin, rtol=0, atol=1e-12)
        np.testing.assert_allclose(part.closes, of[k // 2].closes_s / 0.25 - begin, rtol=0, atol=1e-12)
        assert part.scale == pytest.approx(0.25 / 0.15 / len(of), rel=1e-12)
        assert part.shorts == len(of)
    samples = list(rows.recorded_samples(scene, np.zeros((2, 3)), recorded))
    assert [len(xy) for xy, _, _ in samples] == [2, 1] * len(of)
    weights = np.concatenate([weight for _, _, weight in samples]).sum(axis=0)
    np.testing.assert_allclose(weights, sum(one.closes_s - one.opens_s for one in of) / 0.15 / len(of), rtol=1e-9)
    fractions = np.concatenate([fraction for _, fraction, _ in samples])
    np.testing.assert_allclose(fractions, np.tile([0.2, 0.3, 0.5], len(of)) / len(of), rtol=1e-12)


def test_positions_at_fractions_of_a_stars_own_time_are_those_of_the_motion(monkeypatch: pytest.MonkeyPatch) -> None:
    exposure = Exposure(NIGHT_UTC_S, 0.15, readout_s=0.1)
    given = times([0.01, 0.05], [0.2, 0.15], 1)
    monkeypatch.setattr(RowTimeSearch, "times", lambda _self, _directions: given)
    one = search(exposure)
    scene = one._scene
    directions = LENS.unit_vectors(PLACES_PX[1:3])
    fractions = np.array([0.0, 0.3, 1.0])
    found = rows.recorded_positions(scene, directions, fractions)
    own_s = given.opens_s + fractions[:, np.newaxis] * (given.closes_s - given.opens_s)
    expected = [[at(time, direction, 0.0) for time, direction in zip(row, directions, strict=True)] for row in own_s]
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-4)
    vectors, exposed_s = rows.recorded_paths(scene, directions, 4)
    middles_s = given.opens_s + (np.arange(4) + 0.5)[:, np.newaxis] / 4 * (given.closes_s - given.opens_s)
    expected = [
        [at(time, direction, 0.0) for time, direction in zip(row, directions, strict=True)] for row in middles_s
    ]
    np.testing.assert_allclose(LENS.project(vectors), expected, rtol=0, atol=1e-4)
    assert exposed_s is given.exposed_s
    empty, none = rows.recorded_paths(scene, np.zeros((0, 3)), 4)
    assert (empty.shape, none.shape) == ((4, 0, 3), (0,))
    # Of a stack, fractions of the open time of all short exposures.
    stack = SimpleNamespace(exposure=exposure, motion=scene.motion, shorts=(scene, scene), camera=LENS)
    both = rows.recorded_positions(stack, directions, np.array([0.0, 0.15, 0.5, 0.65, 1.0]))
    np.testing.assert_allclose(both, found[[0, 1, 0, 1, 2]], rtol=0, atol=1e-6)
    # A global shutter, and a scene without a motion, has the positions of its trails.
    for shutter, motion in ((0.0, scene.motion), (0.1, None)):
        still = SimpleNamespace(exposure=Exposure(NIGHT_UTC_S, 0.15, readout_s=shutter), motion=motion,
                                positions=lambda eq, at: ("drawn", len(eq), len(at)))  # fmt: skip
        assert rows.recorded_positions(still, directions, fractions) == ("drawn", 2, 3)
        assert RowTimeSearch.of(still) is None
        assert rows.recorded_rows(still, np.array([0])) is None
    assert RowTimeSearch.of(scene) is not None


def test_the_table_is_that_of_the_exposure() -> None:
    exposure = Exposure(NIGHT_UTC_S + 0.3, 0.15, readout_s=0.1)
    one = search(exposure)
    assert isinstance(one._table, MotionTable)
    assert one._table.ends_s[-1] == pytest.approx(0.25)
    directions = LENS.unit_vectors(PLACES_PX[:2])
    # Beyond the end of the exposure is its end.
    vars(one)["_table"] = None
    vectors = one.in_camera(directions, np.array([0.1, 0.3]))
    expected = [at(0.1, directions[0], 0.3), at(0.25, directions[1], 0.3)]
    np.testing.assert_allclose(LENS.project(vectors), expected, rtol=0, atol=1e-4)
