"""Limits of a score: what passes, what fails and by how much."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner

from glstar.cli import app
from glstar.errors import ConfigError
from glstar.render.truth.frame import KEYS
from glstar.rotation import about_x, about_y, about_z, quaternion_from_matrix
from glstar.score.gate import EXAMPLE, GateLimit, Verdict, gate_note, judged, read_gate
from glstar.score.metrics import METRICS
from glstar.score.scoring import Orbit, Score, score
from glstar.system.resources import manual_pages

ARCSEC, DEG = np.pi / 180 / 3600, np.pi / 180
RUNNER = CliRunner()
Row = dict[str, Any]
# Error of the axis of frames 0 to 7; frame 8 is refused, frame 9 is 2 deg off.
ERRORS_ARCSEC = (10.0, 20.0, 30.0, 40.0, 50.0, 60.0, 70.0, 80.0)
CENTRE_PX, FOCAL_PX = 50.0, 100.0


def pixels(directions: np.ndarray) -> list[list[float]]:
    return (CENTRE_PX + FOCAL_PX * directions[:, :2] / directions[:, 2:]).tolist()


def line(frame: int) -> Row:
    """Return a line of truth: even frames turn about the axis by 1.5 deg in 0.5 s, odd ones by 15 deg about x and y."""
    rays = np.array([[-0.1, 0.02, 1.0], [0.15, -0.08, 1.0], [0.03, 0.12, 1.0], [0.1, 0.1, 1.0]])
    half = about_z(0.75 * DEG) if frame % 2 == 0 else about_y(6 * DEG) @ about_x(4.5 * DEG)
    start, middle, end = pixels(rays @ half), pixels(rays), pixels(rays @ half.T)
    stars = [
        {"star_id": k, "vmag": 4.0, "camera_mag": 4.0, "x_px": xy[0], "y_px": xy[1], "snr": 50.0, "in_frame": 1.0}
        | {"centroid_x_px": xy[0], "centroid_y_px": xy[1], "start": start[k], "end": end[k], "saturated": False}
        for k, xy in enumerate(middle)
    ]
    values: Row = dict.fromkeys(KEYS) | {
        "schema": "glstar-truth-2",
        "frame": frame,
        "file": f"frame_{frame:06d}.png",
        "utc_mid": f"2024-03-10T11:00:{frame:02d}.000000Z",
        "duration_s": 0.5,
        "site": {"latitude_deg": 0.0, "longitude_deg": 20.0, "height_m": 0.0},
        "q_body_ned": [1.0, 0.0, 0.0, 0.0],
        "C_camera_icrs": np.eye(3).tolist(),
        "camera": {"K": [[100, 0, 50], [0, 100, 50], [0, 0, 1]], "width_px": 101, "height_px": 101, "lens": "none"},
        "catalogue": "",
        "stars": stars,
        "flight": "first" if frame < 5 else "second",
        "sample": 0,
        "settings": {},
    }
    return values


def answer(frame: int) -> Row:
    if frame == 8:
        return {"frame": frame, "status": "refused"}
    error_rad = 2 * DEG if frame == 9 else ERRORS_ARCSEC[frame] * ARCSEC
    q = quaternion_from_matrix(about_y(error_rad)).tolist()
    return {"frame": frame, "time_ms": 20.0, **dict(zip(("qw", "qx", "qy", "qz"), q, strict=True))}


@pytest.fixture(scope="module")
def answered(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    folder = tmp_path_factory.mktemp("gate")
    for name, row in (("truth.jsonl", line), ("answers.jsonl", answer)):
        (folder / name).write_text("".join(json.dumps(row(k)) + "\n" for k in range(10)), encoding="utf-8")
    return folder, folder / "answers.jsonl"


@pytest.fixture(scope="module")
def found(answered: tuple[Path, Path]) -> Score:
    return score(*answered)


def gate(folder: Path, *limits: str) -> Path:
    path = folder / "gate.toml"
    path.write_text("".join(f"[[limit]]\n{limit}\n" for limit in limits), encoding="utf-8")
    return path


def texts(found: Score, folder: Path, *limits: str) -> list[str]:
    return [verdict.text for verdict in judged(read_gate(gate(folder, *limits)), found)]


def test_limits_hold_up_to_their_value_and_state_by_how_much_they_fail(found: Score, tmp_path: Path) -> None:
    assert texts(
        found,
        tmp_path,
        'metric = "solved_fraction"\nat_least = 0.8',
        'metric = "solved_fraction"\nat_least = 0.85',
        'metric = "false"\nat_most = 1',
        'metric = "false_fraction"\nat_most = 0.05',
        'metric = "refused"\nat_most = 0',
        'metric = "frames"\nat_least = 10',
        'metric = "run_time_s"\nat_most = 0.015',
        'metric = "invalid_lines"\nat_most = 0',
    ) == [
        "holds   solved_fraction: 0.8, at least 0.8 (10 frames)",
        "FAILED  solved_fraction: 0.8, at least 0.85, 0.05 too little (10 frames)",
        "holds   false: 1, at most 1 (10 frames)",
        "FAILED  false_fraction: 0.1, at most 0.05, 0.05 too much (10 frames)",
        "FAILED  refused: 1, at most 0, 1 too much (10 frames)",
        "holds   frames: 10, at least 10 (10 frames)",
        "FAILED  run_time_s (median): 0.02, at most 0.015, 0.005 too much (9 of 10 frames)",
        "holds   invalid_lines: 0, at most 0 (10 frames)",
    ]


@pytest.mark.parametrize(
    ("statistic", "value_arcsec"), [("", 45.0), ("median", 45.0), ("p90", 80.0), ("rms", float(np.sqrt(2550.0)))]
)
def test_an_error_is_limited_by_its_median_rms_or_p90(
    statistic: str, value_arcsec: float, found: Score, tmp_path: Path
) -> None:
    chosen = f'statistic = "{statistic}"\n' if statistic else ""
    limits = read_gate(gate(tmp_path, f'metric = "boresight_arcsec"\n{chosen}at_most = 44'))

    (verdict,) = judged(limits, found)

    assert verdict.json["value"] == pytest.approx(value_arcsec, rel=1e-9)
    assert verdict.json["excess"] == pytest.approx(value_arcsec - 44, rel=1e-9)
    assert (verdict.passed, verdict.json["count"], verdict.json["frames"]) == (False, 8, 10)
    assert verdict.json["statistic"] == (statistic or "median")


def test_a_smallest_and_a_largest_value_are_two_limits(found: Score, tmp_path: Path) -> None:
    limits = read_gate(gate(tmp_path, 'metric = "solved"\nat_least = 9\nat_most = 9'))

    assert [(one.json.get("at_most"), one.json.get("at_least"), one.passed) for one in judged(limits, found)] == [
        (9.0, None, True),
        (None, 9.0, False),
    ]


def test_frames_are_grouped_by_rate_flight_and_field(found: Score, tmp_path: Path) -> None:
    rates_deg_per_s = [one.truth.rate_rad_per_s / DEG for one in found.frames]
    # The first turns by 2 * 0.75 deg in 0.5 s; cos(a) = (tr R - 1) / 2 gives the angle of the second.
    half = about_y(6 * DEG) @ about_x(4.5 * DEG)
    turned_deg = np.arccos((np.trace(half @ half) - 1) / 2) / DEG
    assert rates_deg_per_s == pytest.approx([3.0, turned_deg / 0.5] * 5, rel=1e-9)

    assert texts(
        found,
        tmp_path,
        'metric = "solved"\nby = "rate, deg/s"\ngroup = "1 to 5"\nat_least = 5',
        'metric = "solved"\nby = "Rate"\ngroup = "20  to 50"\nat_least = 5',
        'metric = "solved_fraction"\nby = "flight"\nat_least = 1',
        # 101 px of 100 px focal length: 2 atan(0.505) is 53.6 deg; all frames are in one group.
        'metric = "solved"\nby = "field"\ngroup = "40 to 60"\nat_least = 8',
    ) == [
        "FAILED  solved, rate, deg/s: 1 to 5: 4, at least 5, 1 too little (5 frames)",
        "FAILED  solved, Rate: 20  to 50: 4, at least 5, 1 too little (5 frames)",
        "holds   solved_fraction, flight: first: 1, at least 1 (5 frames)",
        "FAILED  solved_fraction, flight: second: 0.6, at least 1, 0.4 too little (5 frames)",
        "holds   solved, field: 40 to 60: 8, at least 8 (10 frames)",
    ]


@pytest.mark.parametrize(
    ("limit", "lacks"),
    [
        ('metric = "recall"\nat_most = 1', "no value, at most 1; none of 10 frames has it"),
        ('metric = "position_km"\nat_most = 1e9', "no value, at most 1e+09; none of 10 frames has it"),
        ('metric = "orbit_mean_km"\nat_most = 1', "none of 10 frames has it"),
        (
            'metric = "solved"\nby = "rate"\ngroup = "5 to 20"\nat_least = 0',
            "no frame is in this group; groups with frames: 1 to 5, 20 to 50",
        ),
        (
            'metric = "solved"\nby = "transmission of cloud"\nat_least = 0',
            "no frame is in this group; groups with frames: none",
        ),
        (
            'metric = "solved"\nby = "trial length, px"\nat_least = 0',
            "frames are not grouped by 'trial length, px' (did you mean trail length, px?)",
        ),
    ],
)
def test_a_limit_without_a_value_fails(limit: str, lacks: str, found: Score, tmp_path: Path) -> None:
    (verdict,) = judged(read_gate(gate(tmp_path, limit)), found)

    assert (verdict.passed, verdict.json["value"], verdict.json["passed"]) == (False, None, False)
    assert verdict.text.startswith("FAILED")
    assert verdict.text.endswith(lacks)
    assert lacks.endswith(verdict.json["reason"])


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ('[[limit]]\nmetric = "boresight"\nat_most = 1', "'boresight' is no metric .did you mean boresight_arcsec or"),
        ('[[limit]]\nmetric = "roll"\nat_most = 1', "did you mean roll_arcsec"),
        ('[[limit]]\nmetric = "recal"\nat_least = 1', "did you mean recall"),
        ('[[limit]]\nmetric = "zzzzz"\nat_least = 1', "there are frames, solved,"),
        ("[[limit]]\nat_least = 1", "limit 1: has no metric"),
        ('[[limit]]\nmetric = "recall"', "limit 1: has no bound of recall; give at_most or at_least"),
        ('[[limit]]\nmetric = "recall"\nat_last = 1', "at_last is no key of a limit .did you mean at_least"),
        ('[[limit]]\nmetric = "recall"\nat_least = nan', "at_least is nan, not a finite number"),
        ('[[limit]]\nmetric = "recall"\nat_least = inf', "at_least is inf, not a finite number"),
        ('[[limit]]\nmetric = "recall"\nat_least = true', "at_least is True, not a finite number"),
        ('[[limit]]\nmetric = "recall"\nat_least = "1"', "at_least is '1', not a finite number"),
        ("[[limit]]\nmetric = 3\nat_least = 1", "metric is 3, not a name in quotes"),
        ('[[limit]]\nmetric = "recall"\nstatistic = "p90"\nat_least = 1', "recall has one value, and no statistic"),
        (
            '[[limit]]\nmetric = "roll_arcsec"\nstatistic = "p95"\nat_most = 1',
            "'p95' is no statistic .*did you mean p90",
        ),
        ('[[limit]]\nmetric = "recall"\ngroup = "first"\nat_least = 1', "group is 'first', and by is missing"),
        ('[[limit]]\nmetric = "orbit_mean_km"\nby = "rate"\nat_most = 1', "is one of the whole set; leave out by"),
        ('[limit]\nmetric = "recall"\nat_least = 1', "written in double brackets"),
        ('[[limits]]\nmetric = "recall"\nat_least = 1', "limits is no part of a gate .did you mean limit"),
        ("", "holds no limit; glstar score --gate example"),
        ("[[limit", "TOML"),
    ],
)
def test_a_file_that_is_no_gate_is_one_line(text: str, message: str, tmp_path: Path) -> None:
    (tmp_path / "gate.toml").write_text(text)

    with pytest.raises(ConfigError, match=message) as caught:
        read_gate(tmp_path / "gate.toml")
    assert "\n" not in str(caught.value)


def test_every_metric_of_a_score_can_be_limited(tmp_path: Path) -> None:
    names = ["frames", "solved", "refused", "false", *(metric.json_key for metric in METRICS)]

    limits = read_gate(gate(tmp_path, *(f'metric = "{name}"\nat_least = 0' for name in names)))

    assert [limit.metric for limit in limits] == names


def test_limits_of_errors_without_one_of_solved_frames_are_noted(tmp_path: Path) -> None:
    error, solved = 'metric = "boresight_arcsec"\nat_most = 1', 'metric = "solved_fraction"\nat_least = 1'

    assert "limit solved_fraction" in (gate_note(read_gate(gate(tmp_path, error))) or "")
    assert gate_note(read_gate(gate(tmp_path, error, solved))) is None
    note = gate_note(read_gate(gate(tmp_path, 'metric = "recall"\nat_least = 1', error))) or ""
    assert "boresight_arcsec is that of solved frames" in note
    assert "recall" not in note
    assert gate_note(read_gate(gate(tmp_path, 'metric = "recall"\nat_least = 1'))) is None


def test_the_exit_status_is_1_if_a_limit_fails_and_score_json_has_the_verdicts(
    answered: tuple[Path, Path], tmp_path: Path
) -> None:
    passing, failing = 'metric = "solved"\nat_least = 8', 'metric = "solved"\nat_least = 9'
    command = ["score", *map(str, answered), "--gate", str(gate(tmp_path, passing))]
    held = RUNNER.invoke(app, command)
    gate(tmp_path, passing, failing)
    failed = RUNNER.invoke(app, [*command, "-o", str(tmp_path / "out")])
    as_json = RUNNER.invoke(app, [*command, "--json"])

    assert (held.exit_code, failed.exit_code, as_json.exit_code) == (0, 1, 1)
    assert "gate.toml: all limits hold" in held.stdout
    assert "FAILED  solved: 8, at least 9, 1 too little (10 frames)" in failed.stdout
    assert "1 of 2 limits failed" in failed.stderr
    report = json.loads(as_json.stdout)["gate"]
    assert (report["passed"], [verdict["passed"] for verdict in report["verdicts"]]) == (False, [True, False])
    assert json.loads((tmp_path / "out" / "score.json").read_text())["gate"] == report
    assert "FAILED  solved" in as_json.stderr


def test_the_example_is_printed_without_a_set_read_and_in_the_manual(tmp_path: Path) -> None:
    printed = RUNNER.invoke(app, ["score", "--gate", "example"])
    (tmp_path / "gate.toml").write_text(printed.stdout)

    assert (printed.exit_code, printed.stdout) == (0, EXAMPLE)
    assert len(read_gate(tmp_path / "gate.toml")) == 4
    assert f"```toml\n{EXAMPLE}```" in manual_pages()["score"].read_text(encoding="utf-8")


@pytest.mark.parametrize(
    ("value", "is_upper", "passed", "text"),
    [
        (2.0, True, True, "holds   recall: 2, at most 2 (3 of 4 frames)"),
        (2.5, True, False, "FAILED  recall: 2.5, at most 2, 0.5 too much (3 of 4 frames)"),
        (1.5, True, True, "holds   recall: 1.5, at most 2 (3 of 4 frames)"),
        (2.0, False, True, "holds   recall: 2, at least 2 (3 of 4 frames)"),
        (1.5, False, False, "FAILED  recall: 1.5, at least 2, 0.5 too little (3 of 4 frames)"),
        (2.5, False, True, "holds   recall: 2.5, at least 2 (3 of 4 frames)"),
    ],
)
def test_a_verdict_says_by_how_much_a_limit_fails(value: float, is_upper: bool, passed: bool, text: str) -> None:
    verdict = Verdict(GateLimit("recall", None, None, None, 2.0, is_upper), None, value, 3, 4)

    assert (verdict.passed, verdict.text) == (passed, text)
    assert verdict.json["excess"] == (0.0 if passed else 0.5)
    assert verdict.json["at_most" if is_upper else "at_least"] == 2.0


def test_a_verdict_without_a_value_fails() -> None:
    verdict = Verdict(GateLimit("recall", None, None, None, 2.0, True), None, float("nan"), 0, 4, "none has it")

    assert not verdict.passed
    assert verdict.text == "FAILED  recall: no value, at most 2; none has it"
    assert (verdict.json["value"], verdict.json["excess"], verdict.json["reason"]) == (None, None, "none has it")


def test_a_limit_of_orbits_is_of_their_spread_and_one_without_frames_of_none(found: Score, tmp_path: Path) -> None:
    orbit = Orbit(frames=5, mean_km=1.0, weighted_mean_km=0.5, circle_km=0.25, radius_km=7.0)
    runs = tuple(replace(found.runs[0], orbits=(orbit, replace(orbit, mean_km=3.0))) for _ in range(2))
    limit = 'metric = "orbit_mean_km"\nstatistic = "rms"\nat_most = 2'

    def verdict(score_: Score, text: str) -> Verdict:
        (one,) = judged(read_gate(gate(tmp_path, text)), score_)
        return one

    one = verdict(replace(found, runs=runs), limit)
    assert (one.value, one.count, one.frames, one.lacks) == (pytest.approx(np.sqrt(5)), 10, 10, "")
    assert one.json == {
        "passed": False,
        "metric": "orbit_mean_km",
        "statistic": "rms",
        "at_most": 2.0,
        "value": one.value,
        "excess": one.value - 2,
        "by": None,
        "group": None,
        "count": 10,
        "frames": 10,
    }
    none = verdict(found, limit)
    assert (none.count, none.frames, none.lacks) == (0, 10, "none of 10 frames has it")
    for by in ('by = "rate"\ngroup = "9000 to 9001"', 'by = "colour"\ngroup = "red"'):
        lost = verdict(found, f'metric = "solved"\n{by}\nat_least = 1')
        assert (lost.count, lost.frames, lost.group, np.isnan(lost.value)) == (0, 0, by.split('"')[-2], True)
