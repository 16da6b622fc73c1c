"""Measures of a score, against their definitions, on frames that are composed by hand."""

import json
from dataclasses import replace
from math import pi
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from glstar.camera.model import AttitudeError
from glstar.score.answers import Answer, ErrorEllipse, ObservedStars
from glstar.score.frames import (
    FrameScore,
    FrameTruth,
    Limits,
    Outcome,
    PositionError,
    StarScore,
    _star_score,
    camera_utc_mid_s,
    clock_offset_s,
    score_frame,
)
from glstar.score.metrics import BINS, Bin, Spread, as_json, drawn_settings, settings_bins, summarized
from glstar.score.scoring import _draw_condition, _orbit, orbits, orbits_by_setting, runs_of, spread_of_runs
from tests.support.scenes import camera

ARCSEC = pi / 180 / 3600
LENS = camera(640, 480, 500.0)
C_ICRS = Rotation.from_rotvec([0.3, -0.5, 0.8]).as_matrix()
TURN = 0.1  # rad/s over 0.4 s, about an oblique axis


def frame_truth(number: int = 0, **changes) -> FrameTruth:
    rng = np.random.default_rng(3)
    middle = rng.uniform([100, 80], [540, 400], (8, 2))
    axis = np.array([0.6, 0.0, 0.8])

    def moved(angle: float) -> np.ndarray:
        turn = Rotation.from_rotvec(angle * axis).as_matrix()
        return LENS.project(LENS.unit_vectors(middle) @ turn.T)

    xy = {"start": moved(-TURN * 0.2), "middle": middle, "end": moved(TURN * 0.2), "centroid": middle + 0.3}
    xy["start"][6] = np.nan
    values = {
        "frame": number,
        "file": f"{number}.png",
        "utc_mid_s": 1e9,
        "camera_utc_mid_s": 1e9,
        "duration_s": 0.3,
        "total_s": 0.4,
        "latitude_rad": 0.6,
        "longitude_rad": 2.4,
        "height_m": 100.0,
        "yaw_rad": 0.0,
        "C_camera_icrs": C_ICRS,
        "camera": LENS,
        "catalogue": "",
        "star_id": np.arange(11, 19),
        "xy_px": xy,
        "is_detectable": np.array([1, 1, 1, 1, 1, 0, 1, 0], bool),
    }
    return FrameTruth(**values | changes)


def answer(**changes) -> Answer:
    values = {
        "line": 1,
        "frame": 0,
        "file": None,
        "solved": True,
        "instant": "middle",
        "C_camera_icrs": None,
        "latitude_rad": None,
        "longitude_rad": None,
        "ellipse": None,
        "stars": None,
        "run_time_s": None,
    }
    return Answer(**values | changes)


def scored(boresight_arcsec: float = 0.0, outcome: Outcome = Outcome.SOLVED, **changes) -> FrameScore:
    error = AttitudeError(boresight_arcsec * ARCSEC, 0.0, -2 * boresight_arcsec * ARCSEC)
    values = {"truth": frame_truth(), "answer": answer(), "outcome": outcome, "attitude": error}
    return FrameScore(**values | changes)


def test_the_spread_of_errors_is_of_their_sizes() -> None:
    spread = Spread.of([3.0, -1.0, None, 2.0, -10.0])
    assert (spread.count, spread.median, spread.p90) == (4, 2.5, 10.0)
    assert spread.rms == pytest.approx(np.sqrt(114 / 4))
    assert Spread.of(list(range(1, 11))).p90 == 9
    scaled = spread.scaled(2.0)
    assert (scaled.count, scaled.median, scaled.rms, scaled.p90) == (4, 5.0, 2 * spread.rms, 20.0)
    assert Spread.of([None]) is None
    assert as_json(AttitudeError(ARCSEC, -2 * ARCSEC, 3 * ARCSEC)) == pytest.approx(
        {"right_arcsec": 1, "down_arcsec": -2, "roll_arcsec": 3}
    )


def test_a_summary_has_errors_of_solved_frames_and_counts_of_answered_ones() -> None:
    one = StarScore(identified=10, correct=8, elsewhere=1, detectable=16, found=8, centroid_rms_px=0.5)
    two = StarScore(identified=4, correct=4, elsewhere=0, detectable=4, found=3, centroid_rms_px=0.1)
    none = StarScore(identified=6, correct=0, elsewhere=6, detectable=0, found=0, centroid_rms_px=None)
    single = StarScore(identified=1, correct=1, elsewhere=0, detectable=2, found=1, centroid_rms_px=0.3)
    ellipse = ErrorEllipse(1.0, 1.0, 0.0, 0.5)
    frames = [
        scored(10, stars=one, position=PositionError(3.0, 4.0, None), answer=answer(run_time_s=2.0)),
        scored(20, stars=two, position=PositionError(0.0, 1.0, True), answer=answer(ellipse=ellipse)),
        scored(30, floor=AttitudeError(0, ARCSEC, 0), above_floor=AttitudeError(0, 7 * ARCSEC, 0), stars=single),
        scored(
            9000,
            Outcome.FALSE,
            stars=none,
            position=PositionError(900.0, 0, False),
            answer=answer(ellipse=replace(ellipse, confidence=0.9)),
        ),
        scored(0, Outcome.REFUSED, attitude=None, answer=None),
    ]
    summary = summarized(frames)
    assert (summary.frames, summary.solved, summary.refused, summary.false) == (5, 3, 1, 1)
    found = summary.json
    assert found["boresight_arcsec"]["median"] == pytest.approx(20)
    assert found["roll_arcsec"]["median"] == pytest.approx(40)
    assert found["boresight_floor_arcsec"]["median"] == pytest.approx(1)
    assert found["boresight_above_floor_arcsec"]["median"] == pytest.approx(7)
    assert (found["position_km"]["count"], found["position_km"]["median"]) == (2, 3.0)
    assert (found["in_ellipse"], found["with_ellipse"], found["stated_confidence"]) == (1, 2, pytest.approx(0.7))
    assert (found["precision"], found["recall"]) == (13 / 21, 12 / 22)
    assert (found["centroid_px"]["count"], found["centroid_px"]["median"], found["run_time_s"]["median"]) == (
        3,
        0.3,
        2.0,
    )
    # Two or more right and none wrong: of four frames one.
    assert found["lost_rate"] == 1 / 4
    # Wrong stars count twice: 4 of 16, 3 of 4, all of none at most -1, and 1 of 2.
    assert found["kelvins"] == pytest.approx((4 / 16 + 3 / 4 - 1 + 1 / 2) / 4)


def test_frames_are_grouped_from_each_edge_up() -> None:
    bins = Bin("x, m", lambda frame: frame.x, (0.0, 1.5))
    frames = [SimpleNamespace(x=x) for x in (-1.0, 0.0, 1.4, 1.5, None, 9.0)]
    grouped = bins.grouped(frames)
    assert [(label, [one.x for one in inside]) for label, inside in grouped] == [
        *[("< 0", [-1.0]), ("0 to 1.5", [0.0, 1.4]), (">= 1.5", [1.5, 9.0])]
    ]
    assert Bin("x, m", lambda frame: frame.x, (20.0,)).grouped(frames)[0][0] == "< 20"
    moon = {"moon_illuminated_fraction": 0.6, "moon_separation_deg": 40.0}
    up, down, unknown = (
        scored(truth=frame_truth(conditions=moon | more))
        for more in ({"moon_altitude_deg": 0.1}, {"moon_altitude_deg": 0.0}, {})
    )
    by_name = {one.name: one.of for one in BINS}
    lit, axis = by_name["lit fraction of a Moon above the horizon"], by_name["axis to a Moon above the horizon, deg"]
    assert [lit(one) for one in (up, down, unknown)] == [0.6, None, None]
    assert axis(up) == 40
    assert by_name["rate, deg/s"](up) == pytest.approx(np.rad2deg(TURN), rel=1e-6)
    assert by_name["field, deg"](up) == pytest.approx(2 * np.rad2deg(np.arctan(320 / 500)), rel=2e-3)
    assert by_name["detectable stars"](up) == 6
    assert by_name["exposure, s"](up) == 0.3


def test_settings_of_a_sweep_are_grouped_by_value_or_range() -> None:
    frames = [
        scored(
            truth=frame_truth(
                settings={"a": k % 8, "f": k % 9, "b": 0.1 * k, "c": "x", "d.seed": k, **({"e": k} if k < 2 else {})}
            )
        )
        for k in range(20)
    ]
    grouped = dict(settings_bins(frames))
    assert list(grouped) == ["a", "f", "b", "e"]
    # Nine values are four ranges.
    assert [label for label, _ in grouped["f"]] == ["0 to 2", "3 to 4", "5 to 6", "7 to 8"]
    assert [(label, len(inside)) for label, inside in grouped["a"]] == [(str(k), 3 if k < 4 else 2) for k in range(8)]
    assert [(label, len(inside)) for label, inside in grouped["b"]] == [
        *[("0 to 0.4", 5), ("0.5 to 0.9", 5), ("1 to 1.4", 5), ("1.5 to 1.9", 5)]
    ]
    assert drawn_settings(frames) == {"b", "d.seed", "f"}


def orbit_frames(count: int = 48, turns: float = 2.2, *, solved=lambda _: True) -> list[FrameScore]:
    """A mount error turns with the heading about a constant error of 3 km north and 1 km west."""
    frames = []
    for k in range(count):
        yaw = 0.4 + 2 * pi * turns * (k / (count - 1)) ** 1.2
        error = PositionError(3 + 5 * np.cos(yaw + 0.7), -1 + 5 * np.sin(yaw + 0.7), None)
        truth = frame_truth(k, yaw_rad=float(np.angle(np.exp(1j * yaw))))
        frames.append(scored(truth=truth, position=error, outcome=Outcome.SOLVED if solved(k) else Outcome.REFUSED))
    return frames


def test_an_orbit_has_the_circle_of_its_errors() -> None:
    frames = orbit_frames()
    first, second = found = orbits(frames)
    turned = 2 * pi * 2.2 * (np.arange(48) / 47) ** 1.2
    for turn, orbit in enumerate(found):
        inside = (turned // (2 * pi)) == turn
        assert orbit.frames == inside.sum()
        errors = np.array([(f.position.north_km, f.position.east_km) for f in frames])[inside]
        assert orbit.mean_km == pytest.approx(np.linalg.norm(errors.mean(axis=0)))
        assert (orbit.circle_km, orbit.radius_km) == pytest.approx((np.sqrt(10), 5))
        headings = turned[inside]
        closed = np.concatenate([[headings[-1] - 2 * pi], headings, [headings[0] + 2 * pi]])
        weights = (closed[2:] - closed[:-2]) / 2
        mean = weights @ errors / weights.sum()
        assert orbit.weighted_mean_km == pytest.approx(np.linalg.norm(mean))
        assert abs(orbit.weighted_mean_km - np.sqrt(10)) < 0.25 * abs(orbit.mean_km - np.sqrt(10)) + 0.02
    assert first.frames != second.frames
    assert orbits(orbit_frames(turns=0.99)) == []
    assert len(orbits(orbit_frames(turns=-1.1))) == 1
    assert orbits(orbit_frames(solved=lambda k: k < 3)) == []
    assert [one.frames for one in orbits(orbit_frames(solved=lambda k: k < 4))] == [4]
    line = [replace(f, position=PositionError(float(k), 2.0 * k, None)) for k, f in enumerate(frames[:6])]
    straight = _orbit(line, np.arange(6.0))
    assert (straight.circle_km, straight.radius_km) == (None, None)
    # Kasa's circle is near the least squares of distances, for small errors.
    noisy = np.random.default_rng(1).normal(0, 0.05, (48, 2))
    moved = [
        replace(f, position=PositionError(f.position.north_km + a, f.position.east_km + b, None))
        for f, (a, b) in zip(frames, noisy, strict=True)
    ]
    xy = np.array([(f.position.north_km, f.position.east_km) for f in moved])
    best = least_squares(lambda v: np.hypot(*(xy - v[:2]).T) - v[2], [0.0, 0.0, 1.0]).x
    circle = _orbit(moved, turned)
    assert (circle.circle_km, circle.radius_km) == pytest.approx((np.hypot(*best[:2]), best[2]), abs=0.02)


def test_runs_have_the_spread_of_their_medians() -> None:
    frames = [
        scored(
            10 * (run + 1) + k,
            truth=frame_truth(k, run=("f", run), settings={"a": run}),
            outcome=Outcome.SOLVED if k else Outcome.FALSE,
        )
        for run in range(3)
        for k in range(4)
    ]
    runs = runs_of(frames)
    assert [(run.flight, run.sample, run.summary.frames) for run in runs] == [("f", 0, 4), ("f", 1, 4), ("f", 2, 4)]
    spread = spread_of_runs(runs)
    assert spread["solved_fraction"].median == 0.75
    assert spread["boresight_arcsec"].median == pytest.approx(22)
    assert spread["position_km"] is None
    assert spread_of_runs(runs[:1]) is None
    orbit = orbits(orbit_frames())
    with_orbits = [replace(run, orbits=tuple(orbit[: 1 + k])) for k, run in enumerate(runs)]
    assert {key: len(one) for key, one in orbits_by_setting(with_orbits)["a"].items()} == {"0": 1, "1": 2, "2": 2}
    assert spread_of_runs(with_orbits)["orbit_circle_km"].count == 5
    assert orbits_by_setting(with_orbits[:1]) == {}


def test_trails_rates_and_attitudes_are_those_of_the_turning_camera() -> None:
    truth = frame_truth()
    lengths = np.linalg.norm(truth.xy_px["end"] - truth.xy_px["start"], axis=1)[[0, 1, 2, 3, 4]]
    assert truth.trail_length_px == pytest.approx(np.median(lengths))
    assert replace(truth, is_detectable=np.zeros(8, bool)).trail_length_px == 0
    assert truth.rate_rad_per_s == pytest.approx(TURN, rel=1e-6)
    axis = np.array([0.6, 0.0, 0.8])
    for instant, angle in (("start", -TURN * 0.2), ("middle", 0.0), ("end", TURN * 0.2)):
        expected = Rotation.from_rotvec(angle * axis).as_matrix() @ C_ICRS
        np.testing.assert_allclose(truth.attitude(instant), expected, rtol=0, atol=1e-9)
    few = {name: np.where(np.arange(8)[:, np.newaxis] < 2, xy, np.nan) for name, xy in truth.xy_px.items()}
    lost = replace(truth, xy_px=few)
    assert (lost.attitude("start"), lost.rate_rad_per_s, lost.plain_fit("middle")) == (None, None, None)
    three = {name: np.where(np.arange(8)[:, np.newaxis] < 3, xy, np.nan) for name, xy in truth.xy_px.items()}
    np.testing.assert_allclose(replace(truth, xy_px=three).attitude("end"), truth.attitude("end"), rtol=0, atol=1e-9)


def test_the_distance_from_a_trail_is_that_of_its_nearest_point() -> None:
    rng = np.random.default_rng(4)
    bent = {"start": np.array([[10.0, 10]]), "middle": np.array([[30.0, 20]]), "end": np.array([[40.0, 45]])}
    truth = replace(frame_truth(), xy_px=bent)
    u = np.linspace(0, 1, 4001)[:, np.newaxis]
    dense = np.vstack([bent["start"] * (1 - u) + bent["middle"] * u, bent["middle"] * (1 - u) + bent["end"] * u])
    for point in rng.uniform(0, 60, (12, 2)):
        expected = np.linalg.norm(dense - point, axis=1).min()
        assert truth.distance_from_trail(0, point) == pytest.approx(expected, abs=0.02)
    none = np.full((1, 2), np.nan)
    assert replace(truth, xy_px=bent | {"start": none, "end": none}).distance_from_trail(0, np.array([33.0, 24])) == 5
    assert replace(truth, xy_px=dict.fromkeys(bent, none)).distance_from_trail(0, np.zeros(2)) == np.inf


def test_stars_are_right_within_the_limit_and_elsewhere_off_their_trail() -> None:
    truth = frame_truth()
    at = truth.xy_px["middle"]
    xy = np.array(
        [at[0] + [3, 0], at[1] + [0, 3.01], at[2] + [1, 1], truth.xy_px["end"][3], at[5], [1, 1], [2, 2], at[2] - 1]
    )
    ids = np.array([11, 12, 13, 14, 16, 99, -1, 13])
    found = _star_score(truth, ObservedStars(xy, ids, "middle"), 3.0)
    on_trail = truth.distance_from_trail(1, xy[1]) <= 3.0
    assert (found.identified, found.correct, found.detectable) == (7, 4, 6)
    # Stars 11 and 13 are detectable, 16 is not; 99 is none, and 14 is on its trail.
    assert found.found == 2
    assert found.elsewhere == 7 - (5 + on_trail)
    assert found.centroid_rms_px == pytest.approx(np.sqrt((9 + 2 + 0 + 2) / 4))


@pytest.mark.parametrize(
    ("boresight_deg", "roll_deg", "north_deg", "wrong", "is_right"),
    [
        *[
            (0.99, 0.0, 0.0, 0, True),
            (1.01, 0.0, 0.0, 0, False),
            (0.0, 4.99, 0.0, 0, True),
            (0.0, -5.01, 0.0, 0, False),
        ],
        *[(0.0, 0.0, 1.79, 0, True), (0.0, 0.0, 1.82, 0, False), (0.0, 0.0, 0.0, 2, True), (0.0, 0.0, 0.0, 3, False)],
    ],
)
def test_an_answer_is_right_within_all_limits(boresight_deg, roll_deg, north_deg, wrong, is_right) -> None:
    truth = frame_truth()
    error = Rotation.from_euler("xz", [boresight_deg, roll_deg], degrees=True).as_matrix()
    xy = truth.xy_px["centroid"][:4].copy()
    xy[:wrong] = [5.0, 5.0]
    given = answer(
        C_camera_icrs=error @ C_ICRS,
        latitude_rad=0.6 + np.deg2rad(north_deg),
        longitude_rad=2.4,
        stars=ObservedStars(xy, np.arange(11, 15), "centroid"),
        ellipse=ErrorEllipse(200.0, 1.0, 0.0, 0.9),
    )
    found = score_frame(truth, given, Limits())
    assert found.outcome == (Outcome.SOLVED if is_right else Outcome.FALSE)
    assert found.attitude.boresight_rad == pytest.approx(np.deg2rad(boresight_deg), abs=1e-9)
    assert abs(found.attitude.roll_rad) == pytest.approx(np.deg2rad(abs(roll_deg)), abs=1e-9)
    # A degree of latitude at 34 deg is 110.9 km.
    assert found.position.north_km == pytest.approx(110.92 * north_deg, rel=1e-3)
    assert found.position.in_ellipse == (north_deg < 1.8)
    assert found.stars.elsewhere == wrong
    assert score_frame(truth, None, Limits()).outcome == Outcome.REFUSED
    assert score_frame(truth, answer(solved=False), Limits()).outcome == Outcome.REFUSED
    assert score_frame(truth, answer(), Limits()).outcome == Outcome.SOLVED


def test_the_clock_of_a_navigator_is_off_by_the_offset_of_the_export(tmp_path) -> None:
    (tmp_path / "manifest.json").write_text(json.dumps({"config": {"navigator": {"clock_offset_s": 2.5}}}))
    assert clock_offset_s(tmp_path) == 2.5
    assert clock_offset_s(tmp_path / "none") == 0
    line = {"utc_mid": "1970-01-01T00:01:40Z"}
    assert camera_utc_mid_s(line, 2.5) == 102.5
    assert camera_utc_mid_s(line | {"settings": {"navigator.clock_offset_s": -1}}, 2.5) == 99
    assert camera_utc_mid_s(line | {"camera_utc_mid": "1970-01-01T00:00:10Z"}, 0.0) == 10


def test_an_error_lies_in_an_ellipse_by_its_axes_and_azimuth() -> None:
    """Against the quadratic form of its covariance."""
    ellipse = ErrorEllipse(3.0, 1.0, 0.5, 0.9)
    major = np.array([np.cos(0.5), np.sin(0.5)])
    minor = np.array([-major[1], major[0]])
    shape = 9 * np.outer(major, major) + np.outer(minor, minor)
    for error in np.random.default_rng(4).normal(0, 2, (300, 2)):
        assert ellipse.contains(*error.tolist()) == (error @ np.linalg.solve(shape, error) <= 1)
    assert ellipse.contains(*(2.999 * major).tolist())
    assert not ellipse.contains(*(3.001 * major).tolist())


def test_frames_are_grouped_at_the_levels_of_twilight() -> None:
    """The Sun at the ends of astronomical, nautical and civil twilight, and at the horizon."""
    by_name = {one.name.partition(",")[0]: one.edges for one in BINS}
    assert by_name["altitude of the Sun"] == (-18.0, -12.0, -6.0, 0.0)


def test_a_setting_drawn_from_eight_values_is_no_random_one() -> None:
    def frames(values: int) -> list[FrameScore]:
        return [scored(truth=frame_truth(settings={"a": k % values, **({"b": k} if k % 2 else {})})) for k in range(18)]

    assert drawn_settings(frames(8)) == {"b"}
    assert drawn_settings(frames(9)) == {"a", "b"}
    # A setting of one value is no group.
    assert [name for name, _ in settings_bins(frames(1))] == ["b"]


def test_errors_are_drawn_against_a_condition_and_refused_frames_at_the_lower_edge() -> None:
    """Frames without the condition are left out; the axis is logarithmic, and has no zero."""
    drawn = {}

    class Axis:
        def plot(self, x, y, _, *, label, **__):
            drawn[label] = [*x], [*y]

        def set(self, **keys):
            assert keys["yscale"] == "log"

        def get_xaxis_transform(self):
            return None

    def one(cloud: float | None, *score, **changes) -> FrameScore:
        conditions = {} if cloud is None else {"cloud_transmission": cloud}
        return scored(*score, truth=frame_truth(conditions=conditions), **changes)

    frames = [
        *[one(0.9, 10.0), one(0.5, 0.0), one(None, 20.0), one(0.3, 30.0, Outcome.FALSE)],
        *[one(0.2, outcome=Outcome.REFUSED, attitude=None), one(0.7, attitude=None)],
    ]
    (condition,) = (each for each in BINS if each.name == "transmission of cloud")
    _draw_condition(SimpleNamespace(frames=frames), condition, Axis())
    (x, y), false = drawn[Outcome.SOLVED], drawn[Outcome.FALSE]
    assert x == [0.9, 0.5]
    assert y[0] == pytest.approx(10)
    assert 0 < y[1] < 1e-6
    assert false == ([0.3], [pytest.approx(30)])
    assert drawn["refused"] == ([0.2], [0.02])
