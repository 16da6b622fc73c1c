"""Scores of answers with known errors."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.stats import chi2

from glstar.camera.model import AttitudeError
from glstar.errors import AnswersError
from glstar.rotation import about_x, about_y, about_z, matrix_from_quaternion, quaternion_from_matrix
from glstar.score.answers import ErrorEllipse, attitude_of_boresight, read_answers
from glstar.score.frames import Outcome
from glstar.score.metrics import METRICS
from glstar.score.scoring import Score, score
from glstar.sky.place.apparent import direction
from glstar.sky.place.timescale import parse_utc
from glstar.telemetry import open_flight
from tests.support.exports import done

DEG, ARCSEC = np.pi / 180, np.pi / 180 / 3600
Row = dict[str, Any]


@pytest.fixture(scope="module")
def export(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """An export of two orbits with trails of a few px."""
    folder = tmp_path_factory.mktemp("export")
    flight = "fly:orbit?radius_m=300&turns=2.2&gusts=light&latitude_deg=-34.93&longitude_deg=138.6"
    done("export", flight, "-o", folder / "set", "--every", 8, "--seed", 1)
    return folder / "set"


@pytest.fixture(scope="module")
def truth(export: Path) -> list[Row]:
    return [json.loads(line) for line in (export / "truth.jsonl").read_text(encoding="utf-8").splitlines()]


def answered(truth: list[Row], answer: Callable[[Row], Row], folder: Path) -> Path:
    """Write an answer for each frame and return the file."""
    path = folder / "answers.jsonl"
    path.write_text(
        "".join(json.dumps({"frame": row["frame"], **answer(row)}) + "\n" for row in truth), encoding="utf-8"
    )
    return path


def quaternion(C_camera_icrs: np.ndarray) -> Row:
    return dict(zip(("qw", "qx", "qy", "qz"), quaternion_from_matrix(C_camera_icrs).tolist(), strict=True))


def true_attitude(row: Row) -> Row:
    return quaternion(np.array(row["C_camera_icrs"]))


def arcsec(found: Score, part: str, error: str = "attitude") -> list[float]:
    return [getattr(getattr(one, error), part) / ARCSEC for one in found.frames]


def test_the_truth_itself_has_no_errors(export: Path, truth: list[Row], tmp_path: Path) -> None:
    def answer(row: Row) -> Row:
        stars = [[s["centroid_x_px"], s["centroid_y_px"], s["star_id"]] for s in row["stars"]]
        site = {key: row["site"][key] for key in ("latitude_deg", "longitude_deg")}
        return {**true_attitude(row), **site, "stars": stars, "time_ms": 20}

    found = score(export, answered(truth, answer, tmp_path)).summary

    assert (found.frames, found.solved, found.refused, found.false) == (len(truth), len(truth), 0, 0)
    assert found.spread("boresight_rad").p90 < 1e-6 * ARCSEC
    assert found.spread("roll_rad").p90 < 1e-6 * ARCSEC
    assert found.spread("position_km").p90 < 1e-9
    assert (found.number("precision"), found.number("recall")) == (1.0, 1.0)
    assert found.spread("centroid_px").p90 == 0
    assert found.spread("run_time_s").median == 0.02


@pytest.mark.parametrize(
    ("turn", "part", "sign"),
    [(about_y, "right_rad", 1), (about_x, "down_rad", -1), (about_z, "roll_rad", 1)],
)
def test_a_known_rotation_is_scored_in_arcseconds(
    turn: Callable, part: str, sign: int, export: Path, truth: list[Row], tmp_path: Path
) -> None:
    wrong = turn(37.5 * ARCSEC)

    found = score(export, answered(truth, lambda row: quaternion(wrong @ np.array(row["C_camera_icrs"])), tmp_path))

    np.testing.assert_allclose(arcsec(found, part), sign * 37.5, rtol=0, atol=1e-6)
    others = {"right_rad", "down_rad", "roll_rad"} - {part}
    for other in others:
        np.testing.assert_allclose(arcsec(found, other), 0, rtol=0, atol=1e-6)


@pytest.mark.parametrize("roll_deg", [0.0, 1.0, 77.0, 150.0, 179.9, -180.0])
@pytest.mark.parametrize("boresight_deg", [0.0, 1e-4, 0.9, 45.0, 90.0, 179.0, 180.0])
def test_boresight_is_the_angle_between_the_axes_and_roll_what_remains(boresight_deg: float, roll_deg: float) -> None:
    C_true = attitude_of_boresight(81.5 * DEG, -9.3 * DEG, 25 * DEG)
    # The axis is moved towards 40 deg below the image's right, then the camera is rolled about it.
    towards = 40 * DEG
    moved = about_z(-towards) @ about_y(boresight_deg * DEG) @ about_z(towards)
    C_answered = about_z(roll_deg * DEG) @ moved @ C_true

    error = AttitudeError.between(C_true, C_answered)

    assert error.boresight_rad / DEG == pytest.approx(boresight_deg, rel=0, abs=1e-9)
    if boresight_deg < 180:  # of opposite axes neither direction nor roll is defined
        assert error.right_rad == pytest.approx(error.boresight_rad * np.cos(towards), rel=0, abs=1e-9)
        assert error.down_rad == pytest.approx(error.boresight_rad * np.sin(towards), rel=0, abs=1e-9)
        assert np.cos(error.roll_rad - roll_deg * DEG) == pytest.approx(1.0, rel=0, abs=1e-12)


@pytest.mark.parametrize(("roll_deg", "outcome"), [(4.9, Outcome.SOLVED), (5.1, Outcome.FALSE), (77.0, Outcome.FALSE)])
def test_a_rolled_camera_is_not_solved(
    roll_deg: float, outcome: Outcome, export: Path, truth: list[Row], tmp_path: Path
) -> None:
    rolled = about_z(roll_deg * DEG)

    found = score(export, answered(truth, lambda row: quaternion(rolled @ np.array(row["C_camera_icrs"])), tmp_path))

    assert {one.outcome for one in found.frames} == {outcome}
    assert max(arcsec(found, "boresight_rad")) < 1e-6
    assert max(arcsec(found, "roll_rad")) == pytest.approx(3600 * roll_deg, rel=1e-9)


def test_an_optical_axis_too_far_right_and_down_sees_its_stars_left_and_up(truth: list[Row]) -> None:
    """The signs by the image: a star on the answered optical axis is right of and below the true centre."""
    C_true = np.array(truth[0]["C_camera_icrs"])
    C_answered = about_x(-20 * ARCSEC) @ about_y(30 * ARCSEC) @ C_true

    ahead = C_true @ C_answered.T @ [0, 0, 1]

    np.testing.assert_allclose(ahead[:2] / ARCSEC, [30, 20], rtol=0, atol=1e-3)


def test_a_boresight_and_a_roll_define_the_attitude() -> None:
    ra, dec, roll = 81.5 * DEG, -9.3 * DEG, 25 * DEG
    C_camera_icrs = attitude_of_boresight(ra, dec, roll)
    ahead, north = direction(ra, dec), direction(ra, dec + 90 * DEG)
    east = np.cross(north, ahead)

    np.testing.assert_allclose(C_camera_icrs @ ahead, [0, 0, 1], rtol=0, atol=1e-15)
    # Up in the image is minus y, rotated from north towards east.
    up = C_camera_icrs.T @ [0, -1, 0]
    np.testing.assert_allclose(up, np.cos(roll) * north + np.sin(roll) * east, rtol=0, atol=1e-15)
    # With north up, east is to the left.
    np.testing.assert_allclose(attitude_of_boresight(ra, dec, 0) @ east, [-1, 0, 0], rtol=0, atol=1e-15)


def test_a_rotation_fit_reaches_the_error_floor(export: Path, truth: list[Row], tmp_path: Path) -> None:
    plain = {
        one.truth.frame: one.truth.plain_fit("middle")
        for one in score(export, answered(truth, true_attitude, tmp_path)).frames
    }

    found = score(export, answered(truth, lambda row: quaternion(plain[row["frame"]]), tmp_path))

    assert found.summary.spread("boresight_above_floor_rad").p90 < 1e-6 * ARCSEC
    np.testing.assert_allclose(arcsec(found, "right_rad"), arcsec(found, "right_rad", "floor"), rtol=0, atol=1e-6)
    # Aberration is 20 arcseconds; refraction near the zenith adds a few.
    assert 1 < found.summary.spread("boresight_floor_rad").median / ARCSEC < 90


@pytest.mark.parametrize("instant", ["start", "end"])
def test_an_attitude_may_refer_to_the_start_or_the_end_of_the_exposure(
    instant: str, export: Path, truth: list[Row], tmp_path: Path
) -> None:
    """The attitudes at start and end, computed independently from the flight."""
    flight = open_flight(json.loads((export / "manifest.json").read_text(encoding="utf-8"))["flight"]["name"])

    def answer(row: Row) -> Row:
        late_s = {"start": 0.0, "end": row["duration_s"]}[instant] - row["duration_s"] / 2
        middle_s = parse_utc(row["utc_mid"])
        C_now, C_mid = (matrix_from_quaternion(flight.attitude.at([t])[0]) for t in (middle_s + late_s, middle_s))
        C_camera_body = np.array(row["C_camera_body"])
        # The Earth rotates in the meantime about the axis of the equatorial frame.
        turned = C_camera_body @ C_now @ C_mid.T @ C_camera_body.T
        earth = about_z(7.292115e-5 * late_s)
        C_mid_icrs = np.array(row["C_camera_icrs"])
        return {**quaternion(turned @ C_mid_icrs @ earth), "instant": instant}

    found = score(export, answered(truth, answer, tmp_path))

    # Refraction and aberration change by less than this within half a second.
    assert max(np.abs(arcsec(found, "right_rad") + arcsec(found, "down_rad"))) < 0.5


def test_a_known_position_error_is_scored_in_kilometres(export: Path, truth: list[Row], tmp_path: Path) -> None:
    # A minute of latitude at 35 deg south is 1.84842 km of the meridian (WGS84); one of longitude 1.52295 km.
    def answer(row: Row) -> Row:
        site = row["site"]
        return {"latitude_deg": site["latitude_deg"] + 1 / 60, "longitude_deg": site["longitude_deg"] - 1 / 60}

    found = score(export, answered(truth, answer, tmp_path))

    for one in found.frames:
        assert one.position.north_km == pytest.approx(1.8486, abs=1e-3)
        assert one.position.east_km == pytest.approx(-1.5229, abs=1e-3)
    (_, nautical_miles) = next(metric.units for metric in METRICS if metric.name == "position_km")
    median = found.summary.spread("position_km").median * nautical_miles.per_value
    assert median == pytest.approx(np.hypot(1.8486, 1.5229) / 1.852, abs=1e-3)


def test_a_mount_error_is_a_circle_over_an_orbit_and_its_weighted_mean_is_small(
    export: Path, truth: list[Row], tmp_path: Path
) -> None:
    def answer(row: Row) -> Row:
        w, x, y, z = row["q_body_ned"]
        heading = np.arctan2(-2 * (w * z - x * y), 1 - 2 * (y * y + z * z))
        north_m, east_m = 44.5e3 * np.cos(heading) + 2000, 44.5e3 * np.sin(heading)
        site = row["site"]
        return {
            "latitude_deg": site["latitude_deg"] + north_m / 110_925,
            "longitude_deg": site["longitude_deg"] + east_m / 91_380,
        }

    found = score(export, answered(truth, answer, tmp_path))

    assert len(found.orbits) == 2
    for orbit in found.orbits:
        assert orbit.radius_km == pytest.approx(44.5, rel=0.01)
        assert orbit.circle_km == pytest.approx(2.0, abs=0.4)
        assert orbit.weighted_mean_km == pytest.approx(2.0, abs=0.5)


def test_refused_false_and_missing_answers_are_counted_separately(
    export: Path, truth: list[Row], tmp_path: Path
) -> None:
    wrong = about_y(2 * DEG)
    kinds = {0: {"status": "refused"}, 1: quaternion(wrong @ np.array(truth[1]["C_camera_icrs"]))}
    path = answered(truth[:-1], lambda row: kinds.get(row["frame"], true_attitude(row)), tmp_path)

    found = score(export, path)

    assert (found.summary.refused, found.summary.false) == (2, 1)
    assert [one.outcome for one in found.frames[:3]] == [Outcome.REFUSED, Outcome.FALSE, Outcome.SOLVED]
    # A false answer does not spoil the errors of the solved ones.
    assert found.summary.spread("boresight_rad").p90 < 1e-6 * ARCSEC


def test_stars_are_scored_by_identifier_and_position(export: Path, truth: list[Row], tmp_path: Path) -> None:
    """Two of five stars are correct, one is too far off, one is another star, and one is unidentified."""

    def answer(row: Row) -> Row:
        a, b, c, d, e = row["stars"][:5]
        x, y = "centroid_x_px", "centroid_y_px"
        return {
            "stars": [
                [a[x] + 0.3, a[y] - 0.4, a["star_id"]],
                [b[x], b[y], b["star_id"]],
                [c[x] + 9, c[y], c["star_id"]],
                [d[x], d[y], e["star_id"]],
                [e[x], e[y], None],
            ]
        }

    found = score(export, answered(truth, answer, tmp_path))

    for one in found.frames:
        assert (one.stars.identified, one.stars.correct) == (4, 2)
        assert one.stars.centroid_rms_px == pytest.approx(0.5 / np.sqrt(2), abs=1e-9)
    assert found.summary.number("precision") == 0.5


def test_error_ellipses_are_scored_by_containment(export: Path, truth: list[Row], tmp_path: Path) -> None:
    """An error of 2 km north is inside an ellipse of 3 km by 1 km to the north, and outside of one to the east."""

    def answer(row: Row) -> Row:
        site = row["site"]
        return {
            "latitude_deg": site["latitude_deg"] + 2000 / 110_925,
            "longitude_deg": site["longitude_deg"],
            "ellipse_major_km": 3,
            "ellipse_minor_km": 1,
            "ellipse_azimuth_deg": 0 if row["frame"] % 2 else 90,
            "ellipse_confidence": 0.5,
        }

    found = score(export, answered(truth, answer, tmp_path)).summary

    assert found.number("with_ellipse") == len(truth)
    assert found.number("in_ellipse") == sum(row["frame"] % 2 for row in truth)
    assert found.number("stated_confidence") == 0.5


def test_csv_and_json_lines_give_the_same_score(export: Path, truth: list[Row], tmp_path: Path) -> None:
    rows = [{"file": row["file"], **true_attitude(row)} for row in truth]
    table = tmp_path / "answers.csv"
    table.write_text(
        "\n".join([",".join(rows[0]), *(",".join(str(value) for value in row.values()) for row in rows)]) + "\n",
        encoding="utf-8",
    )

    found = score(export, table).summary

    assert (found.solved, found.spread("boresight_rad").p90 < 1e-6 * ARCSEC) == (len(truth), True)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("", "holds no answers"),
        ("frame,ra\n1,2\n", "'ra' is no field of an answer"),
        ("ra_deg,dec_deg,roll_deg\n1,2,3\n", "does not say which frame it answers"),
        ("frame,ra_deg,dec_deg\n0,2,3\n", "line 2: roll_deg is missing beside ra_deg"),
        ("frame,qw,qx,qy,qz\n0,1,1,0,0\n", r"line 2: the quaternion has length 1\.4142, not 1"),
        ("frame,latitude_deg,longitude_deg\n0,x,3\n", "line 2: latitude_deg is 'x', not a number"),
        ("frame,status\n0,lost\n", "status is 'lost'; it is one of refused, solved"),
        ("frame,status\n0,solved\n", "line 2: says solved, but has neither an attitude nor a position nor identified"),
        ("frame,time_ms\n1.5,2\n", "frame is '1.5', not a whole number"),
        ("frame,time_ms\n999,2\n", "line 2 answers frame 999; the truth has"),
        ('{"frame": 0, "stars": [[1, 2]]}\n', "line 1: stars are a list of"),
        ('{"frame": 0\n', "line 1 is no JSON"),
        (f'{{"frame": 0, "latitude_deg": {10**400}, "longitude_deg": 3}}\n', "line 1"),
        ("frame,ra_deg,dec_deg,roll_deg\n0,2,93,1\n", "dec_deg is 93, beyond the pole"),
        ("frame,time_ms\n0,1,2\n", "line 2 has more fields than the header"),
    ],
)
def test_an_invalid_answer_file_gives_a_one_line_error(
    content: str, message: str, export: Path, tmp_path: Path
) -> None:
    path = tmp_path / "answers"
    path.write_text(content, encoding="utf-8")

    with pytest.raises(AnswersError, match=message) as caught:
        score(export, path)
    assert "\n" not in str(caught.value)


def test_missing_files_are_named(export: Path, tmp_path: Path) -> None:
    with pytest.raises(AnswersError, match="there is no truth to score against"):
        score(tmp_path, tmp_path / "answers.csv")
    with pytest.raises(AnswersError, match=r"answers\.csv: .*(no such file|No such file|does not exist)"):
        read_answers(tmp_path / "answers.csv")


def test_the_command_prints_a_table_and_writes_json_and_a_plot(export: Path, truth: list[Row], tmp_path: Path) -> None:
    path = answered(truth, true_attitude, tmp_path)

    printed = done("score", export, path, "-o", tmp_path / "out")

    assert printed.err == ""
    assert printed.out.startswith(f"{len(truth)} frames: {len(truth)} solved, 0 refused, 0 false")
    saved = json.loads((tmp_path / "out" / "score.json").read_text(encoding="utf-8"))
    assert saved["summary"]["solved"] == len(truth)
    assert saved["summary"]["boresight_arcsec"]["p90"] < 1e-6
    assert saved["frames"][0]["attitude"].keys() == {"right_arcsec", "down_arcsec", "roll_arcsec"}
    assert (tmp_path / "out" / "score.png").read_bytes().startswith(b"\x89PNG")


@pytest.mark.parametrize("confidence", [0.5, 0.95, 0.99])
def test_the_standard_deviation_of_an_ellipse_is_that_of_the_chi_squared_distribution(confidence: float) -> None:
    axis = np.sqrt(chi2.ppf(confidence, 2))  # semi-axis of one standard deviation's ellipse of this probability

    assert ErrorEllipse(3 * axis, 3 * axis, 0.0, confidence).sigma_km == pytest.approx(3.0, rel=1e-12, abs=0)
    # The mean variance of both axes.
    assert ErrorEllipse(7 * axis, axis, 0.4, confidence).sigma_km == pytest.approx(5.0, rel=1e-12, abs=0)
