"""Which pieces of trails a rolling shutter records in full, against the stars' own positions and rows at many times."""

from dataclasses import replace

import numpy as np
import pytest

from glstar.camera.exposure import Exposure
from glstar.render.readout.openings import PixelOpenings, divided_trails
from glstar.render.readout.pieces import PieceCosts, in_pieces
from tests.render.test_pathfit import EXPOSURE, LENS, flown, rough

FREE = PieceCosts(min_segments=1, pieces_per_segment=np.inf)
TIMES = 2001
SECOND = np.arange(0.0, 1.0, 0.02)


def openings_of(exposure: Exposure) -> PixelOpenings:
    """Return the opening times of rows or columns: of the first 0, of the last readout_s later."""
    axis, count = (1, LENS.height_px) if exposure.readout in {"down", "up"} else (0, LENS.width_px)
    per_px = exposure.readout_s / exposure.span_s / (count - 1)

    def at(xy_px: np.ndarray) -> np.ndarray:
        order = xy_px[:, axis] if exposure.readout in {"down", "right"} else count - 1 - xy_px[:, axis]
        return per_px * order

    return PixelOpenings(exposure.duration_s / exposure.span_s, per_px, at)


def covered_by(ends, star: int, time: np.ndarray) -> np.ndarray:
    """Return which times lie in the pieces of a star that are recorded in part; none of them overlap."""
    pieces = ends.piece[ends.star == star]
    begin, stop = ends.begin[pieces], ends.begin[pieces] + ends.duration[pieces]
    order = np.argsort(begin)
    assert (stop[order][:-1] <= begin[order][1:] + 1e-12).all()
    return ((time >= begin[:, np.newaxis]) & (time <= stop[:, np.newaxis] + 1e-12)).any(axis=0)


@pytest.mark.parametrize("readout", ["down", "left"])
def test_every_piece_is_drawn_while_all_rows_of_the_star_are_open_and_others_in_part(readout):
    exposure = replace(EXPOSURE, readout_s=0.087, readout=readout)
    openings, scene = openings_of(exposure), rough(200.0).scene(exposure)
    divided = in_pieces(scene, scene.trails, FREE, openings=openings)
    time = np.linspace(0.0, 1.0, TIMES)
    assert len(divided.parts) > 0
    for part in divided.parts:
        drawn = part.scene.draw_list
        ends = np.concatenate([[0.0], np.cumsum(part.pieces.time_fraction)])
        xy_px = scene.positions(scene.stars.direction_eq[drawn.index], time)
        for star in range(0, len(drawn), 20):
            since = openings.at(xy_px[:, star])
            reach = openings.per_px * drawn.truncation_radius_px[star]
            # Rows beside the image do not matter.
            earliest, latest = (np.clip(since + off, 0.0, 1 - openings.open_time) for off in (-reach, reach))
            begin, stop = ends[part.drawn[:, star]]
            in_piece = (time > begin) & (time < stop)
            is_open = (time >= latest) & (time <= earliest + openings.open_time)
            assert is_open[in_piece].all()
            # Little more than one piece at either end, and what the wings take, is recorded in part.
            assert np.count_nonzero(is_open & ~in_piece) < TIMES * (4 * np.diff(ends).max() + 6 * reach)
            covered = covered_by(part.ends, star, time)
            assert not (covered & (time > begin + 1e-9) & (time < stop - 1e-9)).any()
            is_lit = (time >= earliest) & (time <= latest + openings.open_time) & ~in_piece
            assert covered[is_lit].all()


def test_pieces_that_are_recorded_in_part_lie_within_segments():
    scene = rough(200.0).scene(replace(EXPOSURE, readout_s=0.087))
    (part, *_) = in_pieces(scene, scene.trails, FREE, openings=openings_of(scene.exposure)).parts
    marks = np.concatenate([[0.0], np.cumsum(scene.trails.time_fraction)])
    begin, end = part.ends.begin, part.ends.begin + part.ends.duration
    assert (np.searchsorted(marks, begin + 1e-9) == np.searchsorted(marks, end - 1e-9)).all()
    middle = part.ends.pointing[np.arange(1, 3 * len(begin), 3)]
    directions = scene.stars.direction_eq[part.scene.draw_list.index[:50]]
    drawn_px = LENS.project(middle.to_camera(directions))
    np.testing.assert_allclose(drawn_px, scene.positions(directions, (begin + end) / 2), rtol=0, atol=1e-3)


def test_no_trail_is_divided_where_stars_may_be_as_fast_as_the_readout():
    scene = rough(200.0).scene(replace(EXPOSURE, readout_s=0.087))
    openings = openings_of(scene.exposure)
    slow = replace(openings, per_px=1e3 * openings.per_px)
    assert in_pieces(scene, scene.trails, FREE, openings=openings) is not None
    assert in_pieces(scene, scene.trails, FREE, openings=slow) is None


def test_the_parts_of_a_long_trail_in_segments_join_and_the_middle_one_is_lit_in_full():
    exposure = replace(EXPOSURE, readout_s=0.087)
    turn = flown(SECOND, np.deg2rad([40.0 * SECOND, 0 * SECOND, 0 * SECOND]))
    openings, scene = openings_of(exposure), turn.scene(exposure)
    divided = divided_trails(scene, scene.trails, openings)
    assert divided is not None
    assert len(divided.whole.star) + len(divided.while_open.star) == len(scene.draw_list)
    time = np.linspace(0.0, 1.0, TIMES)
    xy_px = scene.positions(scene.stars.direction_eq[scene.draw_list.index], time)
    for star, (begin, end) in list(zip(divided.while_open.star, divided.while_open.rises_and_sets, strict=True))[::9]:
        since, reach = openings.at(xy_px[:, star]), openings.per_px * scene.draw_list.truncation_radius_px[star]
        earliest, latest = (np.clip(since + off, 0.0, 1 - openings.open_time) for off in (-reach, reach))
        inside = (time > begin) & (time < end)
        assert (time[inside] >= latest[inside]).all()
        assert (time[inside] <= earliest[inside] + openings.open_time).all()
        assert end - begin > openings.open_time - 0.03 - 6 * reach
        covered = covered_by(divided.ends, star, time)
        is_lit = (time >= earliest) & (time <= latest + openings.open_time) & ~inside
        assert not (is_lit & ~covered & (time != begin) & (time != end)).any()
        assert not (covered & (time > begin + 1e-9) & (time < end - 1e-9)).any()
