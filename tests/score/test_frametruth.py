"""The truth that a score reads, line by line, and the JSON of a score."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from glstar.camera.model import AttitudeError
from glstar.errors import AnswersError
from glstar.rotation import quaternion_from_euler
from glstar.score import page
from glstar.score.answers import ObservedStars
from glstar.score.frames import Limits, Outcome, PositionError, StarScore, _star_score, read_frame_truths, score_frame
from glstar.score.metrics import as_json, summarized
from glstar.score.scoring import Orbit, Run, Score, orbits_by_setting, runs_of, spread_of_runs
from glstar.sky.catalogue.reading import StarCatalogue
from tests.score.test_runs import line
from tests.score.test_scoremeasures import ARCSEC, LENS, answer, frame_truth, scored


def star(k: int, **changes) -> dict:
    values = {
        "star_id": 100 + k,
        "x_px": 10.0 + k,
        "y_px": 20.5 - k,
        "centroid_x_px": 11.0 * k,
        "centroid_y_px": 3.0 + k,
    }
    return values | {"start": [1.5 * k, 2.0], "end": [7.0, 0.5 * k], "in_frame": 1.0, "snr": 10.0} | changes


def test_a_line_of_truth_is_read_with_every_field(tmp_path: Path) -> None:
    stars = [
        star(1),
        star(2, start=None, snr=9.9),
        star(3, end=None, in_frame=0.52),
        star(4, in_frame=0.48),
        star(5, x_px=None, y_px=None, snr=99.0),
    ]
    row = line(8, run=3, wind=2.5, yaw_rad=0.7) | {
        "utc_mid": "2024-03-10T11:00:05.250000Z",
        "camera_utc_mid": "2024-03-10T11:00:07.250000Z",
        "duration_s": 0.25,
        "total_s": 0.4,
        "site": {"latitude_deg": -34.5, "longitude_deg": 138.25, "height_m": 77.0},
        "q_body_ned": quaternion_from_euler(0.1, -0.2, 0.7).tolist(),
        "C_camera_icrs": [[0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [1.0, 0.0, 0.0]],
        "stars": stars,
        "moon_altitude_deg": 12.5,
        "sky_mag_arcsec2": 20.5,
        "sun_altitude_deg": None,
    }
    plain = {
        key: value
        for key, value in row.items()
        if key not in ("total_s", "camera_utc_mid", "flight", "sample", "settings")
    }
    (tmp_path / "truth.jsonl").write_text(json.dumps(row) + "\n" + json.dumps(plain) + "\n")
    (tmp_path / "manifest.json").write_text(json.dumps({"config": {"navigator": {"clock_offset_s": -1.5}}}))

    first, second = read_frame_truths(tmp_path, least_snr=10.0)

    mid_s = 1710068405.25
    assert (first.frame, first.file, first.catalogue, first.run) == (8, "frame_000008.png", "bsc5", ("flight 3", 3))
    assert (first.utc_mid_s, first.camera_utc_mid_s, first.duration_s, first.total_s) == (mid_s, mid_s + 0.5, 0.25, 0.4)
    place = first.latitude_rad, first.longitude_rad, first.height_m, first.yaw_rad
    assert place == pytest.approx((np.deg2rad(-34.5), np.deg2rad(138.25), 77.0, 0.7))
    np.testing.assert_array_equal(first.C_camera_icrs, row["C_camera_icrs"])
    assert (first.camera.width_px, first.camera.fx_px, first.camera.cx_px) == (101, 100, 50)
    assert first.star_id.tolist() == [101, 102, 103, 104, 105]
    nan = [np.nan, np.nan]
    expected = {
        "middle": [[11, 19.5], [12, 18.5], [13, 17.5], [14, 16.5], nan],
        "centroid": [[11 * k, 3 + k] for k in range(1, 6)],
        "start": [[1.5, 2], nan, [4.5, 2], [6, 2], [7.5, 2]],
        "end": [[7, 0.5], [7, 1], nan, [7, 2], [7, 2.5]],
    }
    assert first.xy_px.keys() == expected.keys()
    for name, xy_px in expected.items():
        np.testing.assert_array_equal(first.xy_px[name], xy_px)
    # From the limit up, and on the image for half of the exposure.
    assert first.is_detectable.tolist() == [True, False, True, False, True]
    assert first.settings == {"flight.synthetic.wind_m_per_s": 2.5, "flight.synthetic.seed": 3}
    assert first.conditions == {"moon_altitude_deg": 12.5, "sky_mag_arcsec2": 20.5}
    assert (second.total_s, second.camera_utc_mid_s, second.run, second.settings) == (0.25, mid_s - 1.5, ("", 0), {})
    # The file itself is the truth, too.
    assert [one.frame for one in read_frame_truths(tmp_path / "truth.jsonl", least_snr=10.0)] == [8, 8]
    # So it is by any name.
    (tmp_path / "truth.jsonl").rename(tmp_path / "copy.jsonl")
    assert [one.frame for one in read_frame_truths(tmp_path / "copy.jsonl", least_snr=10.0)] == [8, 8]


def test_without_a_truth_there_is_one_line(tmp_path: Path) -> None:
    for path in (tmp_path, tmp_path / "truth.jsonl"):
        with pytest.raises(AnswersError) as caught:
            read_frame_truths(path, least_snr=1.0)
        assert str(caught.value) == (
            f"{tmp_path / 'truth.jsonl'}: there is no truth to score against; give the directory of an export"
        )
    (tmp_path / "truth.jsonl").write_text("")
    with pytest.raises(AnswersError) as caught:
        read_frame_truths(tmp_path, least_snr=1.0)
    assert str(caught.value) == f"{tmp_path / 'truth.jsonl'}: holds no frames"


def test_a_plain_fit_has_the_proper_motion_of_the_epoch() -> None:
    """Stars around Sirius fifty years after J2000, which it moves by 67 arcsec."""
    catalogue = StarCatalogue.open("bsc5")
    number = np.array([2491, 2294, 2618, 2693, 2653, 2421])
    stars = catalogue.by_id(number.tolist())
    by_id = {int(n): k for k, n in enumerate(stars.star_id)}
    k = np.array([by_id[n] for n in number.tolist()])
    ra, dec = stars.ra_rad[k], stars.dec_rad[k]
    east = np.column_stack([-np.sin(ra), np.cos(ra), 0 * ra])
    north = np.column_stack([-np.sin(dec) * np.cos(ra), -np.sin(dec) * np.sin(ra), np.cos(dec)])
    there = np.column_stack([np.cos(dec) * np.cos(ra), np.cos(dec) * np.sin(ra), np.sin(dec)])
    moved = there + 50 * (
        stars.pm_ra_cosdec_rad_per_yr[k, np.newaxis] * east + stars.pm_dec_rad_per_yr[k, np.newaxis] * north
    )
    assert np.linalg.norm(moved - there, axis=1).max() > 60 * ARCSEC
    C = np.stack([-east[0], -north[0], there[0]])
    xy_px = LENS.project(moved @ C.T)
    truth = replace(
        frame_truth(),
        star_id=number,
        xy_px=dict.fromkeys(("start", "middle", "end"), xy_px),
        catalogue="bsc5",
        utc_mid_s=946728000.0 + 50 * 365.25 * 86400,
        is_detectable=np.ones(6, bool),
    )
    # To second order in the proper motion.
    np.testing.assert_allclose(truth.plain_fit("end"), C, rtol=0, atol=2e-7)
    three = replace(truth, is_detectable=np.array([1, 0, 1, 0, 1, 0], bool))
    np.testing.assert_allclose(three.plain_fit("middle"), C, rtol=0, atol=3e-7)
    assert replace(truth, is_detectable=np.array([1, 0, 1, 0, 0, 0], bool)).plain_fit("middle") is None
    assert replace(truth, catalogue="").plain_fit("middle") is None


def test_a_rate_needs_both_ends_of_an_exposure() -> None:
    truth = frame_truth()
    for lost in ("start", "end"):
        xy_px = truth.xy_px | {lost: np.full((8, 2), np.nan)}
        assert replace(truth, xy_px=xy_px).rate_rad_per_s is None


def test_half_a_position_is_none_and_the_number_zero_is_an_identifier() -> None:
    truth = frame_truth()
    for half in ({"latitude_rad": 0.6}, {"longitude_rad": 2.4}):
        assert score_frame(truth, answer(**half), Limits()).position is None
    stars = ObservedStars(np.array([[5.0, 5.0], [9.0, 9.0]]), np.array([0, -1]), "middle")
    assert _star_score(truth, stars, 3.0) == StarScore(1, 0, 1, 6, 0, None)


def test_marks_of_an_answer_end_far_outside_of_the_image() -> None:
    truth = replace(frame_truth(), is_detectable=np.eye(8, dtype=bool)[2])
    shifted = replace(truth, xy_px=truth.xy_px | {"centroid": truth.xy_px["middle"] + 50})
    at_centroid = ObservedStars(shifted.xy_px["centroid"][:1] + 1, np.array([11]), "centroid")
    assert [kind for kind, _ in page._star_marks(shifted, at_centroid, 3.0)] == ["answers"]
    ray = LENS.unit_vectors(truth.xy_px["middle"][2])
    start_rad = np.arctan2(ray[0], ray[2])
    for to_px, count in ((0.96e5, 1), (1.04e5, 0), (-0.96e5, 1), (-1.04e5, 0)):
        turn = np.arctan(to_px / LENS.fx_px) - start_rad
        cosine, sine = np.cos(turn), np.sin(turn)
        about_down = np.array([[cosine, 0, sine], [0, 1, 0], [-sine, 0, cosine]])
        assert len(page._shift_marks(truth, "middle", about_down @ truth.C_camera_icrs)) == count


ORBIT = Orbit(frames=5, mean_km=1.0, weighted_mean_km=0.5, circle_km=0.25, radius_km=7.0)


def test_a_run_may_have_one_frame_and_two_runs_have_a_spread() -> None:
    frames = [
        scored(10.0 * k, truth=frame_truth(k, run=("flight", k), settings={"mount.yaw_deg": 5.0 * k})) for k in (1, 2)
    ]
    runs = runs_of(frames)
    assert [(run.flight, run.sample, run.settings, run.orbits) for run in runs] == [
        ("flight", k, {"mount.yaw_deg": 5.0 * k}, ()) for k in (1, 2)
    ]
    assert spread_of_runs(runs[:1]) is None
    spread = spread_of_runs(runs)
    assert spread["boresight_arcsec"].median == pytest.approx(15.0)
    # Orbits are grouped by settings that their run has.
    other = Run("flight", 3, {"mount.pitch_deg": 1.0}, summarized(frames), (ORBIT,))
    assert orbits_by_setting([*runs, other]) == {}
    with_orbits = [replace(run, orbits=(ORBIT, replace(ORBIT, frames=run.sample))) for run in runs]
    assert orbits_by_setting([*with_orbits, other]) == {
        "mount.yaw_deg": {f"{5.0 * k}": [ORBIT, replace(ORBIT, frames=k)] for k in (1, 2)}
    }


def test_the_json_of_a_score_has_all_of_it() -> None:
    stars = StarScore(identified=9, correct=8, elsewhere=1, detectable=16, found=7, centroid_rms_px=0.5)
    error = AttitudeError(ARCSEC, -2 * ARCSEC, 3 * ARCSEC)
    in_arcsec = {"right_arcsec": pytest.approx(1), "down_arcsec": pytest.approx(-2), "roll_arcsec": pytest.approx(3)}
    truth = frame_truth(6, conditions={"moon_altitude_deg": 4.5}, run=("flight", 1), settings={"sensor.seed": 3})
    one = scored(
        truth=truth,
        attitude=error,
        floor=error,
        above_floor=replace(error, down_rad=0.0),
        position=PositionError(3.0, -4.0, True),
        stars=stars,
    )
    two = scored(truth=frame_truth(7, run=("flight", 2)), outcome=Outcome.REFUSED, attitude=None, answer=None)
    runs = tuple(replace(run, orbits=(ORBIT,) * (run.sample == 1)) for run in runs_of([one, two]))
    half = summarized([one])
    score = Score((one, two), summarized([one, two]), (("rate", (("< 1", half),)),), runs, faults=("line 3 is odd",))
    orbit = {"frames": 5, "mean_km": 1.0, "weighted_mean_km": 0.5, "circle_km": 0.25, "radius_km": 7.0}

    found = score.json

    assert found.pop("frames") == [
        {
            "frame": 6,
            "file": "6.png",
            "outcome": "solved",
            "attitude": in_arcsec,
            "floor": in_arcsec,
            "above_floor": in_arcsec | {"down_arcsec": 0.0},
            "position": {"north_km": 3.0, "east_km": -4.0, "in_ellipse": True, "distance_km": 5.0},
            "stars": {"identified": 9, "correct": 8, "elsewhere": 1, "detectable": 16, "found": 7}
            | {"centroid_rms_px": 0.5},
            "trail_length_px": truth.trail_length_px,
            "detectable_stars": 6,
            "moon_altitude_deg": 4.5,
        },
        {
            "frame": 7,
            "file": "7.png",
            "outcome": "refused",
            "trail_length_px": truth.trail_length_px,
            "detectable_stars": 6,
        },
    ]
    spread = {key: as_json(value) for key, value in score.spread.items()}
    assert spread["solved_fraction"]["median"] == 0.5
    assert found.pop("runs") == {
        "spread": {"runs": 2} | spread,
        "each": [
            {"flight": "flight", "sample": 1, "settings": {"sensor.seed": 3}, "summary": half.json, "orbits": [orbit]},
            {"flight": "flight", "sample": 2, "settings": {}, "summary": summarized([two]).json, "orbits": []},
        ],
    }
    assert found == {
        "schema": "glstar-score-1",
        "summary": score.summary.json,
        "bins": {"rate": {"< 1": half.json}},
        "orbits": [orbit],
        "invalid_lines": ["line 3 is odd"],
    }
    assert list(Score((two,), summarized([two]), (), runs[:1]).json) == [
        "schema",
        "summary",
        "bins",
        "orbits",
        "frames",
    ]


def test_three_right_stars_of_three_count_for_lost() -> None:
    stars = StarScore(identified=3, correct=3, elsewhere=0, detectable=3, found=3, centroid_rms_px=0.5)
    assert summarized([scored(stars=stars)]).number("lost_rate") == 1.0
