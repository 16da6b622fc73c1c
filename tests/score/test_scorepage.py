"""The page of a score: which frames it shows, its curves, and what is drawn of an answer."""

from dataclasses import replace
from math import pi
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from glstar.camera.model import AttitudeError
from glstar.score import page
from glstar.score.answers import ObservedStars
from glstar.score.frames import Outcome, PositionError, StarScore
from tests.score.test_scoremeasures import C_ICRS, LENS, answer, frame_truth, scored

HIDDEN = {"attitude": None}


def numbered(number: int, *score, **changes):
    return scored(*score, truth=frame_truth(number), **changes)


def test_the_worst_frames_are_false_ones_and_then_those_of_the_largest_error() -> None:
    frames = [
        numbered(0, 10.0),
        numbered(1, 40.0),
        numbered(2, outcome=Outcome.REFUSED, attitude=None, answer=None),
        numbered(3, 2.0, Outcome.FALSE),
        numbered(4, 3.0, Outcome.FALSE),
        numbered(5, **HIDDEN, position=PositionError(3.0, 4.0, None)),
        numbered(6, **HIDDEN, position=PositionError(30.0, 40.0, None)),
        numbered(7, **HIDDEN),
    ]
    assert [one.truth.frame for one in page.worst_frames(frames)] == [4, 3, 6, 5, 1, 0, 7, 2]
    assert [one.truth.frame for one in page.worst_frames([numbered(k, k) for k in range(20)])] == [*range(19, 7, -1)]


def test_the_curves_are_in_their_units(monkeypatch) -> None:
    drawn = {}

    def curve(title, points, *, is_log, is_line):
        assert not is_line
        drawn[title] = is_log, points
        return title

    monkeypatch.setattr(page, "curve", curve)
    stars = StarScore(identified=9, correct=8, elsewhere=1, detectable=16, found=7, centroid_rms_px=0.5)
    frames = (
        numbered(3, 10.0, stars=stars, position=PositionError(3.0, -4.0, None)),
        numbered(5, outcome=Outcome.REFUSED, attitude=None, answer=None),
    )
    assert page._curves(SimpleNamespace(frames=frames), {5: 0}) == list(drawn)
    errors = "optical axis, arcsec", "rotation about it, arcsec", "position, km"
    # The rotation of `scored` is -2 times the error of the axis.
    for title, value in zip((f"error of the {name}" for name in errors), (10.0, 20.0, 5.0), strict=True):
        is_log, points = drawn.pop(title)
        assert is_log
        assert points == [(None, 3, pytest.approx(value), "solved"), (0, 5, None, "refused")]
    [(title, (is_log, points))] = drawn.items()
    assert (title, is_log) == ("detectable stars that are not identified", False)
    assert [value for _, _, value, _ in points] == [9, None]


def test_the_facts_of_a_frame_are_in_degrees_and_kilometres() -> None:
    stars = StarScore(identified=9, correct=8, elsewhere=1, detectable=16, found=7, centroid_rms_px=0.5)
    one = scored(attitude=AttitudeError(0.0, 0.25 * pi / 180, -3 * pi / 180), stars=stars)
    assert page._facts(replace(one, position=PositionError(3.0, 4.0, None))) == (
        "solved; optical axis 0.25 deg off; rotation about it -3 deg off; position 5 km off;"
        " 8 of 9 identified stars right; 6 detectable stars"
    )
    assert page._facts(scored(outcome=Outcome.REFUSED, attitude=None)) == "refused; 6 detectable stars"


def test_a_star_of_an_answer_is_a_cross_that_says_whether_it_is_right() -> None:
    truth = frame_truth()
    at = truth.xy_px["middle"]
    # On the place, just inside and outside the tolerance, of an unknown number, not identified, and far away.
    start = truth.xy_px["start"][2]
    xy_px = [at[0], at[1] + [0, 2.9], at[1] + [50, 50], at[1], at[1], [3e6, 1.0], start]
    star_id = np.array([11, 12, 12, 99, -1, 11, 13])
    marks = page._star_marks(truth, ObservedStars(np.array(xy_px), star_id, "middle"), 3.0)
    # The last one is at the beginning of its trail, which counts as right.
    assert [kind for kind, _ in marks] == ["answers", "answers", "wrong", "wrong", "answers", "answers"]
    x, y = at[0].tolist()
    assert marks[0][1] == f"M{x - 5:.1f} {y:.1f}h10M{x:.1f} {y - 5:.1f}v10"


def test_lines_lead_from_true_places_to_those_under_the_answered_attitude() -> None:
    truth = frame_truth()
    turn = Rotation.from_rotvec([0.0, 0.02, 0.0]).as_matrix()
    one = scored(answer=answer(C_camera_icrs=turn @ C_ICRS))
    lines = page._answer_marks(one, 3.0)
    assert len(lines) == truth.is_detectable.sum()
    for (kind, path), xy in zip(lines, truth.xy_px["middle"][truth.is_detectable], strict=True):
        assert kind == "answers"
        ray = np.array([(xy[0] - LENS.cx_px) / LENS.fx_px, (xy[1] - LENS.cy_px) / LENS.fy_px, 1.0])
        right, down, ahead = turn @ ray
        x, y, x_to, y_to = (float(part) for part in path[1:].replace("L", " ").split())
        np.testing.assert_allclose([x, y], xy, rtol=0, atol=0.06)
        expected = LENS.cx_px + LENS.fx_px * right / ahead, LENS.cy_px + LENS.fy_px * down / ahead
        np.testing.assert_allclose([x_to, y_to], expected, rtol=0, atol=0.06)
    # Backwards no star is in front of the camera; a refused frame has no answer.
    backwards = Rotation.from_rotvec([0.0, pi, 0.0]).as_matrix()
    assert page._answer_marks(scored(answer=answer(C_camera_icrs=backwards @ C_ICRS)), 3.0) == []
    assert page._answer_marks(scored(answer=None), 3.0) == []
