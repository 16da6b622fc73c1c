"""Every field of an answer, as JSON and as CSV, and the line that refuses a wrong one."""

import json
from dataclasses import replace
from math import exp, pi, radians
from pathlib import Path

import numpy as np
import pytest

from glstar.errors import AnswersError
from glstar.score.answers import (
    ErrorEllipse,
    FirstAnswers,
    ObservedStars,
    attitude_of_boresight,
    parse_answer,
    read_answers,
)
from tests.score.test_scoremeasures import answer

SOURCE = Path("nav.jsonl")
PLACE = {"latitude_deg": -34.5, "longitude_deg": 200.0}
ELLIPSE = {"ellipse_major_km": 7.0, "ellipse_minor_km": 2.0, "ellipse_azimuth_deg": 30.0}


def parsed(**row):
    return parse_answer(SOURCE, 4, json.dumps(row))


def test_an_ellipse_has_its_axes_along_its_azimuth_and_a_standard_deviation() -> None:
    ellipse = ErrorEllipse(7.0, 2.0, 0.5, 0.9)
    for along, across, is_inside in (
        (6.9, 0.0, True),
        (7.1, 0.0, False),
        (0.0, 1.9, True),
        (0.0, -2.1, False),
        (5.0, 1.3, True),
        (-5.0, 1.5, False),
    ):
        # Along the azimuth, from north through east, and to the right of it.
        point = (along + 1j * across) * np.exp(0.5j)
        assert ellipse.contains(point.real, point.imag) == is_inside
    # The probability of the ellipse of a normal distribution with the standard deviation s: 1 - exp(-a^2 / 2 s^2).
    round_km = ErrorEllipse(3.0, 3.0, 0.0, 0.8)
    assert 1 - exp(-(3.0**2) / (2 * round_km.sigma_km**2)) == pytest.approx(0.8)
    assert ErrorEllipse(7.0, 1.0, 0.0, 0.8).sigma_km == pytest.approx(round_km.sigma_km * 5 / 3)


def test_a_boresight_is_a_direction_and_a_position_angle_of_up() -> None:
    ra, dec, roll = 2.1, -0.4, 0.7
    C = attitude_of_boresight(ra, dec, roll)
    ahead = np.array([np.cos(dec) * np.cos(ra), np.cos(dec) * np.sin(ra), np.sin(dec)])
    east = np.array([-np.sin(ra), np.cos(ra), 0.0])
    north = np.cross(ahead, east)
    up = np.cos(roll) * north + np.sin(roll) * east
    np.testing.assert_allclose(C[2], ahead, rtol=0, atol=1e-12)
    np.testing.assert_allclose(C[1], -up, rtol=0, atol=1e-12)
    np.testing.assert_allclose(C[0], np.cross(-up, ahead), rtol=0, atol=1e-12)


def test_a_line_has_every_field_of_an_answer() -> None:
    found = parsed(
        frame=3,
        file="c.png",
        utc="2024-03-10T11:00:00.25Z",
        status="solved",
        replaces=True,
        instant="end",
        qw=0.5005,
        qx=-0.5005,
        qy=0.5005,
        qz=0.5005,
        **PLACE,
        **ELLIPSE,
        ellipse_confidence=0.5,
        time_ms=250,
        stars=[[1.5, 2.5, 7], [3, 4, None], [5, 6, 7]],
        stars_at="start",
    )
    assert (found.line, found.frame, found.file, found.of, found.solved, found.instant) == (
        4,
        3,
        "c.png",
        3,
        True,
        "end",
    )
    # Of the normalised quaternion (1, -1, 1, 1) / 2.
    np.testing.assert_allclose(found.C_camera_icrs, [[0, -1, 0], [0, 0, 1], [-1, 0, 0]], rtol=0, atol=1e-12)
    assert (found.latitude_rad, found.longitude_rad) == pytest.approx((radians(-34.5), radians(-160)))
    assert found.ellipse == ErrorEllipse(7.0, 2.0, pytest.approx(pi / 6), 0.5)
    assert (found.run_time_s, found.utc_s, found.replaces) == (0.25, 1710068400.25, True)
    assert (found.stars.xy_px.tolist(), found.stars.star_id.tolist(), found.stars.at) == (
        [[1.5, 2.5], [3, 4]],
        [7, -1],
        "start",
    )

    plain = parsed(file="a.png", **PLACE)
    assert (plain.frame, plain.file, plain.of, plain.solved, plain.instant) == (None, "a.png", "a.png", True, "middle")
    nothing = (plain.C_camera_icrs, plain.ellipse, plain.stars, plain.run_time_s, plain.utc_s, plain.replaces)
    assert nothing == (None, None, None, None, None, False)
    assert parsed(frame=1, **PLACE, **ELLIPSE).ellipse.confidence == 0.95
    for azimuth_deg in (-400.0, 0.0, 50_000.0):
        turned = parsed(frame=1, **PLACE, **ELLIPSE | {"ellipse_azimuth_deg": azimuth_deg}).ellipse
        assert turned.azimuth_rad == pytest.approx(radians(azimuth_deg))
    assert parsed(frame=1, stars=[[1, 2, 0]]).stars.at == "centroid"
    np.testing.assert_allclose(
        parsed(frame=1, ra_deg=120, dec_deg=-20, roll_deg=40).C_camera_icrs,
        attitude_of_boresight(radians(120), radians(-20), radians(40)),
        rtol=0,
        atol=1e-12,
    )
    # What answers nothing is no solution; null is a field that is left out.
    for row, solved in (
        ({"stars": [[1, 2, 3]]}, True),
        ({"stars": [[1, 2, None]]}, False),
        ({"latitude_deg": None, "longitude_deg": None}, False),
        ({**PLACE, "status": "refused"}, False),
        ({"qw": 1, "qx": 0, "qy": 0, "qz": 0}, True),
    ):
        assert parsed(frame=1, **row).solved == solved


@pytest.mark.parametrize(
    ("row", "message"),
    [
        (
            {"frame": 1, "colour": 2},
            "line 4: 'colour' is no field of an answer; fields are dec_deg, ellipse_azimuth_deg,",
        ),
        (PLACE, "line 4 does not say which frame it answers: give frame or file, or utc for a live window"),
        ({"frame": -1}, "line 4: frame is -1, not a whole number from 0"),
        ({"frame": 1.5}, "line 4: frame is 1.5, not a whole number from 0"),
        ({"frame": 2**63}, "line 4: frame is 9223372036854775808, not a whole number from 0"),
        ({"frame": [1]}, "line 4: frame is [1], not a number"),
        ({"frame": 1, "utc": "noon"}, "line 4: utc is 'noon', not a UTC such as 2024-03-10T11:00:00.25Z"),
        ({"frame": 1, "status": "done"}, "line 4: status is 'done'; it is one of refused, solved"),
        ({"frame": 1, "instant": "mid"}, "line 4: instant is 'mid'; it is one of end, middle, start"),
        ({"frame": 1, "replaces": "yes"}, "line 4: replaces is 'yes'; it is true or false"),
        (
            {"frame": 1, "status": "solved"},
            "line 4: says solved, but has neither an attitude nor a position nor identified stars",
        ),
        ({"frame": 1, "qw": 1, "qy": 0, "qz": 0}, "line 4: qx is missing beside qw"),
        ({"frame": 1, "dec_deg": 3}, "line 4: ra_deg is missing beside dec_deg"),
        ({"frame": 1, "qw": 1, "qx": 1, "qy": 0, "qz": 0}, "line 4: the quaternion has length 1.4142, not 1"),
        (
            {"frame": 1, "qw": 1, "qx": 0, "qy": 0, "qz": 0, "ra_deg": 0, "dec_deg": 0, "roll_deg": 0},
            "line 4: gives the attitude twice: a quaternion and a boresight; leave one of them out",
        ),
        ({"frame": 1, "ra_deg": 0, "dec_deg": -91, "roll_deg": 0}, "line 4: dec_deg is -91, beyond the pole"),
        ({"frame": 1, "latitude_deg": 91, "longitude_deg": 91}, "line 4: latitude_deg is 91, beyond the pole"),
        (
            {"frame": 1, "latitude_deg": -91, "longitude_deg": -90},
            "line 4: latitude_deg is -91, beyond the pole; are latitude and longitude exchanged?",
        ),
        (
            {"frame": 1, "latitude_deg": 1, "longitude_deg": -721},
            "line 4: longitude_deg is -721, which is no longitude in degrees",
        ),
        (
            {"frame": 1, **PLACE, **ELLIPSE, "ellipse_minor_km": -2},
            "line 4: an error ellipse has semi-axes above 0 and up to 40000 km, not 7 and -2",
        ),
        (
            {"frame": 1, **PLACE, **ELLIPSE, "ellipse_confidence": 1.5},
            "line 4: ellipse_confidence is 1.5, not from 0.0001 to below 1",
        ),
        (
            {"frame": 1, "stars": [], "stars_at": "begin"},
            "line 4: stars_at is 'begin'; it is one of centroid, end, middle, start",
        ),
        (
            {"frame": 1, "stars": [[1, 2, 3], [1, 2, "x" * 99]]},
            f"line 4: {'x' * 60} is no star_id, which is a whole number, or null where unknown",
        ),
        (
            {"frame": 1, "stars": [[1, 2, -2]]},
            "line 4: -2 is no star_id, which is a whole number, or null where unknown",
        ),
        (
            {"frame": 1, "stars": [[1, 2, 3], 7]},
            "line 4: stars are a list of [x_px, y_px, star_id], star_id null where unknown",
        ),
        ({"frame": 1, "time_ms": "y" * 99}, f"line 4: time_ms is '{'y' * 59}..., not a number"),
    ],
)
def test_a_wrong_field_is_named(row: dict, message: str) -> None:
    with pytest.raises(AnswersError) as caught:
        parsed(**row)
    text = str(caught.value)
    assert text.startswith(f"nav.jsonl: {message}") if message.endswith(",") else text == f"nav.jsonl: {message}"


def test_a_table_leaves_out_empty_cells_and_counts_lines_of_its_file(tmp_path: Path) -> None:
    path = tmp_path / "nav.csv"
    path.write_text(
        " frame ,file,latitude_deg, longitude_deg,replaces\n3, , 10 ,20,TRUE\n\n,b.png,,,\n,,1,2,\n5,,x,2,\n6,,1,2,,9\n"
    )
    found = read_answers(path)
    first, second = found.answers
    assert (first.line, first.frame, first.file, first.replaces, first.solved) == (2, 3, None, True, True)
    assert (first.latitude_rad, first.longitude_rad) == pytest.approx((radians(10), radians(20)))
    assert (second.line, second.of, second.solved, second.replaces) == (4, "b.png", False, False)
    assert found.faults == (
        "line 5 does not say which frame it answers: give frame or file, or utc for a live window",
        "line 6: latitude_deg is 'x', not a number",
        "line 7 has more fields than the header",
    )
    assert found.path == path
    for text, message in (
        ("frame,frame\n1,2\n", "frame"),
        ("", "holds no answers: write one line for each frame"),
        ('{"frame": 1, "status": 3}\n', "line 1: status is 3; it is one of refused, solved"),
        ('\n{"utc": "2024-03-10T11:00:00Z"}\n', "line 2 does not say which frame it answers: give frame or file"),
        ('[1]\n{"frame": 1', "line 1 holds no object; write one for each frame"),
    ):
        path.write_text(text)
        with pytest.raises(AnswersError) as caught:
            read_answers(path)
        assert str(caught.value).startswith(f"{path}: ")
        assert message in str(caught.value)


def test_an_answer_contradicts_a_frame_by_its_file_or_its_clock() -> None:
    one = answer(file="a.png", utc_s=1000.0)
    assert one.contradiction(7, "b.png", 1000.0, 0.4) == "frame 7 is b.png, not a.png"
    assert one.contradiction(7, "a.png", 1000.0, 0.4) is None
    for late_s, is_right in ((1.19, True), (1.21, False), (-1.19, True), (-1.21, False)):
        found = one.contradiction(7, "a.png", 1000.0 - late_s, 0.4)
        assert (found is None) == is_right
    assert found == "its utc is -1.2 s from the middle of frame 7 by the camera's clock"
    assert replace(one, utc_s=None, file=None).contradiction(7, "b.png", 5.0, 0.0) is None


def test_the_first_answer_counts_until_one_replaces_it() -> None:
    first = FirstAnswers()
    assert first.objection(answer(line=2, frame=5), 5) is None
    assert first.objection(answer(line=2, frame=5), 5) is None
    assert first.objection(answer(line=3, frame=6), 6) is None
    assert first.objection(answer(line=4, frame=5, replaces=True), 5) is None
    assert first.objection(answer(line=7, frame=None, file="e.png"), 5) == (
        'line 7 answers frame e.png again; line 2 counts, unless a later one says "replaces": true'
    )


def test_stars_identify_if_one_has_a_number() -> None:
    for numbers, identifies in (([-1, 0], True), ([-1, -1], False), ([], False)):
        assert ObservedStars(np.zeros((len(numbers), 2)), np.array(numbers, int), "middle").identifies == identifies
