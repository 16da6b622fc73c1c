"""Answers that are invalid, contradict each other or themselves: counted line by line, while the others are scored."""

import json
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner

from glstar.cli import app
from glstar.errors import AnswersError
from glstar.score.answers import MOST_CHARACTERS, ErrorEllipse, read_answers
from glstar.score.frames import Outcome
from glstar.score.scoring import Score, score
from tests.score.test_runs import line

RUNNER = CliRunner()
Row = dict[str, Any]
RIGHT = '{"frame": 0, "latitude_deg": 0.0, "longitude_deg": 20.0}'
DIGITS = "9" * 400
DEEP = "[" * 5000


@pytest.fixture(scope="module")
def frames(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Three frames over the equator at 20 deg east, at 11:00:00, :01 and :02, with stars at (10 k, 5 k^2) px."""
    folder = tmp_path_factory.mktemp("set")
    rows = [line(k, run=0, wind=0.0, yaw_rad=0.0) for k in range(3)]
    (folder / "truth.jsonl").write_text("".join(json.dumps(row) + "\n" for row in rows), encoding="utf-8")
    return folder


def scored(frames: Path, folder: Path, *lines: str | Row, **options: Any) -> Score:
    path = folder / "answers.jsonl"
    text = [row if isinstance(row, str) else json.dumps(row) for row in lines]
    path.write_text("\n".join(text) + "\n", encoding="utf-8")
    return score(frames, path, **options)


@pytest.mark.parametrize(
    ("invalid", "message"),
    [
        ('{"frame": 1, "latitude_deg": 138.6, "longitude_deg": -34.93}', "latitude_deg is 138.6, beyond the pole; are"),
        ('{"frame": 1, "latitude_deg": -90.01, "longitude_deg": 170}', "latitude_deg is -90.01, beyond the pole$"),
        ('{"frame": 1, "latitude_deg": 3e8, "longitude_deg": 2e8}', "latitude_deg is 3e.08, beyond the pole$"),
        ('{"frame": 1, "latitude_deg": 3, "longitude_deg": 1386000000}', "longitude_deg is 1.386e.09, which is no"),
        ('{"frame": 1, "latitude_deg": NaN, "longitude_deg": 3}', "is no JSON"),
        ('{"frame": 1, "latitude_deg": 1e999, "longitude_deg": 3}', "is no JSON"),
        ('{"frame": 1, "latitude_deg": "inf", "longitude_deg": 3}', "latitude_deg is 'inf', not a finite number"),
        ('{"frame": 1, "latitude_deg": true, "longitude_deg": 3}', "latitude_deg is True, not a finite number"),
        (f'{{"frame": {DIGITS}, "time_ms": 3}}', "is no JSON"),
        (f'{{"frame": "{DIGITS}", "time_ms": 3}}', r"frame is '9{59}\.\.\., not a finite number"),
        (f'{{"frame": 1, "stars": {DEEP}}}', "is no JSON"),
        ('{"frame": 1, "stars": [[10, 5, 9223372036854775808]]}', "9223372036854775808 is no star_id"),
        ('{"frame": 1, "stars": [[10, 5, 1.5]]}', "1.5 is no star_id, which is a whole number, or null"),
        ('{"frame": 1, "stars": [[10, 5, -7]]}', "-7 is no star_id"),
        ('{"frame": 1, "stars": [[10, "5", 7]]}', r"stars are a list of \[x_px, y_px, star_id\]"),
        ('{"frame": 1, "stars": [[10, 5]]}', r"stars are a list of \[x_px, y_px, star_id\]"),
        ('{"frame": 1, "stars": "none"}', "stars is 'none', not a list, which JSON lines can hold"),
        ('{"frame": 1, "time_ms": -3}', "time_ms is -3; a run time is not negative"),
        ('{"frame": 1, "time_ms": 1e200}', r"time_ms is 1e\+200, beyond 1e\+12"),
        ('{"frame": 1, "qw": 1e200, "qx": 0, "qy": 0, "qz": 0}', r"qw is 1e\+200, beyond 1e\+12"),
        ('{"frame": 1, "stars": [[1e200, 5, 7]]}', r"stars are a list of \[x_px, y_px, star_id\]"),
        (
            '{"frame": 1, "ellipse_major_km": 3, "ellipse_minor_km": 2, "ellipse_azimuth_deg": 0}',
            "an error ellipse stands without a position",
        ),
        ('{"frame": 1, "ellipse_confidence": 0.5}', "ellipse_confidence stands without an ellipse"),
        ('{"frame": 1, "status": "solved"}', "says solved, but has neither an attitude nor a position"),
        ('{"frame": 1, "status": "solved", "stars": [[10, 5, null]]}', "says solved, but has neither an attitude"),
        ('{"frame": 1, "replaces": 1, "latitude_deg": 3, "longitude_deg": 2}', "replaces is 1; it is true or false"),
        ('{"frame": 7, "latitude_deg": 3, "longitude_deg": 2}', "answers frame 7; the truth has 3"),
        (
            '{"frame": 1, "file": "frame_000002.png", "latitude_deg": 3, "longitude_deg": 2}',
            "contradicts itself: frame 1 is frame_000001.png, not frame_000002.png",
        ),
        (
            '{"frame": 1, "utc": "2024-03-10T11:00:05Z", "latitude_deg": 3, "longitude_deg": 2}',
            r"contradicts itself: its utc is \+4.0 s from the middle of frame 1",
        ),
        ('{"utc": "2024-03-10T11:00:01Z", "latitude_deg": 3, "longitude_deg": 2}', "does not say which frame"),
        (RIGHT, "answers frame 0 again; line 1 counts, unless a later one says"),
        (
            '{"file": "frame_000000.png", "latitude_deg": 3, "longitude_deg": 2}',
            "frame_000000.png again; line 1 counts",
        ),
        ("[1, 2]", "holds no object"),
        ('{"frame": 1, "note": "' + "x" * MOST_CHARACTERS + '"}', "characters; at most 1000000 are read"),
    ],
)
def test_an_invalid_line_is_reported_and_the_others_are_scored(
    invalid: str, message: str, frames: Path, tmp_path: Path
) -> None:
    found = scored(frames, tmp_path, RIGHT, invalid, '{"frame": 2, "latitude_deg": 0.0, "longitude_deg": 380.0}')

    assert [one.outcome for one in found.frames] == [Outcome.SOLVED, Outcome.REFUSED, Outcome.SOLVED]
    assert found.summary.spread("position_km").p90 < 1e-9
    (fault,) = found.faults
    assert re.search(message, fault), fault
    assert found.json["invalid_lines"] == list(found.faults)


@pytest.mark.parametrize("longitude_deg", [20, -340, 380, 20 - 720])
def test_a_longitude_is_taken_modulo_a_turn(longitude_deg: float, frames: Path, tmp_path: Path) -> None:
    row = {"frame": 0, "latitude_deg": 0.0, "longitude_deg": longitude_deg}

    found = scored(frames, tmp_path, row)

    assert found.frames[0].position.distance_km < 1e-6
    (answer,) = read_answers(tmp_path / "answers.jsonl").answers
    assert answer.longitude_rad == pytest.approx(np.deg2rad(20.0), rel=0, abs=1e-12)


def test_the_first_answer_to_a_frame_counts_unless_another_replaces_it(frames: Path, tmp_path: Path) -> None:
    later = {"frame": 0, "latitude_deg": 1.0, "longitude_deg": 20.0}

    found = scored(frames, tmp_path, RIGHT, later, later | {"latitude_deg": 2.0})
    assert found.frames[0].position.distance_km < 1e-9
    assert len(found.faults) == 2

    found = scored(frames, tmp_path, RIGHT, later, later | {"latitude_deg": 2.0, "replaces": True}, later)
    # Two degrees of the meridian at the equator (WGS84).
    assert found.frames[0].position.north_km == pytest.approx(221.15, rel=0, abs=0.02)
    assert len(found.faults) == 2


@pytest.mark.parametrize("row", [{"frame": 1}, {"frame": 1, "time_ms": 20}, {"frame": 1, "stars": [[10, 5, None]]}])
def test_an_answer_of_nothing_is_a_refusal(row: Row, frames: Path, tmp_path: Path) -> None:
    found = scored(frames, tmp_path, RIGHT, row)

    assert (found.summary.solved, found.summary.refused, found.summary.false) == (1, 2, 0)
    assert found.faults == ()


def test_a_star_that_is_listed_twice_counts_once(frames: Path, tmp_path: Path) -> None:
    wrong = {"frame": 0, "stars": [*[[10.0, 5.0, 1]] * 10, [80.0, 80.0, 2], [90.0, 80.0, 3]]}

    found = scored(frames, tmp_path, wrong, least_snr=1.0)

    assert (found.frames[0].stars.identified, found.frames[0].stars.correct) == (3, 1)
    assert found.summary.number("precision") == pytest.approx(1 / 3)
    assert found.summary.number("lost_rate") == 0.0
    # The first place counts: a star cannot be found by listing many.
    found = scored(frames, tmp_path, {"frame": 0, "stars": [[50.0, 5.0, 1], [10.0, 5.0, 1]]}, least_snr=1.0)
    assert (found.frames[0].stars.identified, found.frames[0].stars.correct) == (1, 0)


def test_identifiers_are_judged_beside_a_right_position(frames: Path, tmp_path: Path) -> None:
    stars = [[10.0, 5.0, 1], [20.0, 20.0, 2], [80.0, 80.0, 3]]
    place = {"latitude_deg": 0.0, "longitude_deg": 20.0}

    right = scored(frames, tmp_path, {"frame": 0, **place, "stars": stars})
    wrong = scored(frames, tmp_path, {"frame": 0, **place, "stars": [*stars[1:][::-1], [90.0, 90.0, 1]]})

    assert right.frames[0].outcome is Outcome.SOLVED
    assert wrong.frames[0].outcome is Outcome.FALSE


def test_a_star_on_its_trail_is_the_right_one_although_its_place_is_not_the_asked_one(
    frames: Path, tmp_path: Path
) -> None:
    rows = [json.loads(text) for text in (frames / "truth.jsonl").read_text().splitlines()]
    rows[0]["stars"][0] |= {"start": [10.0, 5.0], "x_px": 30.0, "y_px": 5.0, "end": [30.0, 25.0]}
    (tmp_path / "truth.jsonl").write_text("".join(json.dumps(row) + "\n" for row in rows))

    for xy, outcome in (((20.0, 7.9), Outcome.SOLVED), ((20.0, 8.1), Outcome.FALSE), ((27.1, 15.0), Outcome.SOLVED)):
        found = scored(tmp_path, tmp_path, {"frame": 0, "stars": [[*xy, 1]], "stars_at": "start"})
        assert (found.frames[0].stars.correct, found.frames[0].outcome) == (0, outcome)


def test_a_star_is_detectable_by_the_snr_of_the_truth(frames: Path, tmp_path: Path) -> None:
    rows = [json.loads(text) for text in (frames / "truth.jsonl").read_text().splitlines()]
    rows[0]["stars"][1]["snr"] = 10.5  # of the same flux and the same trail as its neighbours with 9
    (tmp_path / "truth.jsonl").write_text("".join(json.dumps(row) + "\n" for row in rows))

    found = scored(tmp_path, tmp_path, {"frame": 0, "stars": [[20.0, 20.0, 2]]})

    assert (found.frames[0].stars.detectable, found.frames[0].stars.found) == (1, 1)
    assert found.summary.number("recall") == 1.0
    del rows[0]["stars"][1]["snr"]
    (tmp_path / "truth.jsonl").write_text("".join(json.dumps(row) + "\n" for row in rows))
    with pytest.raises(AnswersError, match="has no snr, which a score needs; export the frames again"):
        scored(tmp_path, tmp_path, RIGHT)


def test_the_command_reports_invalid_lines_and_scores_the_rest(frames: Path, tmp_path: Path) -> None:
    answers = tmp_path / "answers.csv"
    answers.write_text("frame,latitude_deg,longitude_deg\n0,0,20\n" + "1,100,20\n" * 7 + "2,0,20,9\n")

    run = RUNNER.invoke(app, ["score", str(frames), str(answers)])

    assert run.exit_code == 0, run.output
    assert run.stdout.startswith("3 frames: 1 solved, 2 refused, 0 false")
    lines = run.stderr.splitlines()
    assert len(lines) == 6
    assert lines[0] == (
        f"{answers}: line 3: latitude_deg is 100, beyond the pole; are latitude and longitude exchanged?; not counted"
    )
    assert lines[-1] == f"{answers}: 3 more lines are not counted; score.json has all"


@pytest.mark.parametrize("content", ["frame,latitude_deg\r0,1\r", 'frame,latitude_deg\n0,"1\n', "frame\n\x00\n"])
def test_odd_tables_give_one_line(content: str, frames: Path, tmp_path: Path) -> None:
    (tmp_path / "answers.csv").write_text(content, newline="")

    with pytest.raises(AnswersError) as caught:
        score(frames, tmp_path / "answers.csv")
    assert "\n" not in str(caught.value)


ELLIPSE = {
    "latitude_deg": 3,
    "longitude_deg": 2,
    "ellipse_major_km": 3,
    "ellipse_minor_km": 2,
    "ellipse_azimuth_deg": 5,
}
UNIT = {"qx": 0.0, "qy": 0.0, "qz": 0.0}


@pytest.mark.parametrize(
    ("row", "is_valid"),
    [
        ({"latitude_deg": 90, "longitude_deg": -720}, True),
        ({"latitude_deg": -90.001, "longitude_deg": 0}, False),
        ({"latitude_deg": 0, "longitude_deg": 720.001}, False),
        ({"ra_deg": 10, "dec_deg": -90, "roll_deg": 0}, True),
        ({"ra_deg": 10, "dec_deg": 90.001, "roll_deg": 0}, False),
        ({"latitude_deg": 3, "longitude_deg": 2, "time_ms": 0}, True),
        ({"latitude_deg": 3, "longitude_deg": 2, "time_ms": 1e12}, True),
        ({"latitude_deg": 3, "longitude_deg": 2, "time_ms": 1.0001e12}, False),
        ({"qw": 1.0009, **UNIT}, True),
        ({"qw": 1.0011, **UNIT}, False),
        ({"qw": 0.9989, **UNIT}, False),
        (ELLIPSE | {"ellipse_major_km": 40000}, True),
        (ELLIPSE | {"ellipse_major_km": 40001}, False),
        (ELLIPSE | {"ellipse_minor_km": 0}, False),
        (ELLIPSE | {"ellipse_minor_km": 1e-9}, True),
        (ELLIPSE | {"ellipse_confidence": 1e-4}, True),
        (ELLIPSE | {"ellipse_confidence": 0.99e-4}, False),
        (ELLIPSE | {"ellipse_confidence": 0.999999}, True),
        (ELLIPSE | {"ellipse_confidence": 1}, False),
        ({"stars": [[1e12, 5, -1], [1, 2, 0]]}, True),
        ({"stars": [[1.0001e12, 5, 7]]}, False),
        ({"stars": [[1, 5, True]]}, False),
        ({"stars": [[True, 5, 1]]}, False),
        ({"stars": [[1, 5, 2**63 - 1]]}, True),
        ({"stars": []}, True),
    ],
)
def test_numbers_are_valid_up_to_their_limits(row: Row, is_valid: bool, tmp_path: Path) -> None:
    path = tmp_path / "answers.jsonl"
    path.write_text(json.dumps({"frame": 0} | row) + "\n" + json.dumps({"frame": 2} | ELLIPSE) + "\n", encoding="utf-8")

    found = read_answers(path)

    assert [one.frame for one in found.answers] == ([0, 2] if is_valid else [2]), found.faults
    assert len(found.faults) == (not is_valid)
    # The confidence is 95 % unless an ellipse states another.
    assert found.answers[-1].ellipse == ErrorEllipse(3.0, 2.0, pytest.approx(np.deg2rad(5)), 0.95)


@pytest.mark.parametrize("late_s", [1.24, 1.26, -1.24, -1.26])
def test_the_utc_of_an_answer_may_be_a_second_beyond_its_exposure(late_s: float, frames: Path, tmp_path: Path) -> None:
    """The frames last 0.5 s around whole seconds."""
    utc = f"2024-03-10T11:00:{1 + late_s:06.3f}Z" if late_s > -1 else f"2024-03-10T10:59:{61 + late_s:06.3f}Z"
    found = scored(frames, tmp_path, {"frame": 1, "utc": utc, "latitude_deg": 0.0, "longitude_deg": 20.0}, RIGHT)

    assert len(found.faults) == (abs(late_s) > 1.25)


def test_stars_without_a_number_are_all_kept_and_identify_nothing(tmp_path: Path) -> None:
    path = tmp_path / "answers.jsonl"
    rows = [[1, 2, None], [3, 4, None], [5, 6, 0], [7, 8, 0], [9, 10, -1]]
    path.write_text(
        json.dumps({"frame": 0, "stars": rows}) + "\n" + json.dumps({"frame": 1, "stars": [[1, 2, None]]}) + "\n"
    )

    known, unknown = (one.stars for one in read_answers(path).answers)

    assert known.star_id.tolist() == [-1, -1, 0, -1]
    assert known.xy_px.tolist() == [[1, 2], [3, 4], [5, 6], [9, 10]]
    assert (known.identifies, unknown.identifies) == (True, False)
