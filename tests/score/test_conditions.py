"""Scores grouped by the cloud, the Moon and the Sun of each frame, and by settings that were drawn at random."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner

from glstar.cli import app
from glstar.render.truth.frame import KEYS
from glstar.rotation import about_y, quaternion_from_matrix
from glstar.score.scoring import Score, score

ARCSEC = np.pi / 180 / 3600
RUNNER = CliRunner()
Row = dict[str, Any]
# Frames 0 to 11: from a clear sky to thick cloud, and a Moon that rises; frames 10 and 11 do not know the Moon.
TRANSMISSION = [1.0, 1.0, 0.9, 0.85, 0.7, 0.65, 0.5, 0.45, 0.3, 0.25, 0.1, 0.05]
MOON_DEG = [-30.0, -20.0, -10.0, -1.0, 5.0, 10.0, 20.0, 25.0, 40.0, 70.0]


def line(frame: int) -> Row:
    moon: Row = {}
    if frame < len(MOON_DEG):
        moon = {"moon_altitude_deg": MOON_DEG[frame], "moon_illuminated_fraction": 0.1 * frame}
        moon |= {"moon_separation_deg": 10.0 * frame, "sun_altitude_deg": -25.0 + frame}
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
        "catalogue": "bsc5",
        "stars": [],
        "flight": "flight",
        "sample": frame,
        "settings": {"cloud.coverage": frame / 12, "exposure.duration_s": 0.5 + (frame % 2)},
        "cloud_transmission": TRANSMISSION[frame],
        **moon,
    }
    return values


def answer(frame: int) -> Row:
    """Return an error of 10" per frame number; cloud of less than 0.4 is refused."""
    if TRANSMISSION[frame] < 0.4:
        return {"frame": frame, "status": "refused"}
    q = quaternion_from_matrix(about_y(10.0 * (frame + 1) * ARCSEC)).tolist()
    return {"frame": frame, **dict(zip(("qw", "qx", "qy", "qz"), q, strict=True))}


@pytest.fixture(scope="module")
def answered(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    folder = tmp_path_factory.mktemp("conditions")
    (folder / "truth.jsonl").write_text("".join(json.dumps(line(k)) + "\n" for k in range(12)), encoding="utf-8")
    manifest = {"sensor": {"psf_sigma_px": 1.2, "sky_std_dn": 3.0}}
    (folder / "manifest.json").write_text(json.dumps(manifest), encoding="utf-8")
    answers = folder / "answers.jsonl"
    answers.write_text("".join(json.dumps(answer(k)) + "\n" for k in range(12)), encoding="utf-8")
    return folder, answers


def counts(found: Score, name: str) -> list[tuple[str, int, int]]:
    return [(label, one.frames, one.solved) for label, one in dict(found.bins)[name]]


def test_frames_are_grouped_by_cloud_moon_and_sun(answered: tuple[Path, Path]) -> None:
    found = score(*answered)

    assert counts(found, "transmission of cloud") == [
        ("< 0.2", 2, 0),
        ("0.2 to 0.4", 2, 0),
        ("0.4 to 0.6", 2, 2),
        ("0.6 to 0.8", 2, 2),
        ("0.8 to 0.99", 2, 2),
        (">= 0.99", 2, 2),
    ]
    # Frames that do not know the Moon are in no bin.
    assert counts(found, "altitude of the Moon, deg") == [
        ("< 0", 4, 4),
        ("0 to 15", 2, 2),
        ("15 to 30", 2, 2),
        ("30 to 60", 1, 0),
        (">= 60", 1, 0),
    ]
    # The phase of a Moon below the horizon does not matter: 0.4 and 0.5, 0.6 and 0.7, 0.8 and 0.9 of frames 4 to 9.
    assert counts(found, "lit fraction of a Moon above the horizon") == [
        ("0.25 to 0.5", 1, 1),
        ("0.5 to 0.75", 3, 3),
        (">= 0.75", 2, 0),
    ]
    assert counts(found, "axis to a Moon above the horizon, deg") == [
        ("30 to 60", 2, 2),
        ("60 to 90", 3, 2),
        (">= 90", 1, 0),
    ]
    assert counts(found, "altitude of the Sun, deg") == [("< -18", 7, 7), ("-18 to -12", 3, 1)]
    thin = dict(dict(found.bins)["transmission of cloud"])["0.8 to 0.99"]
    assert thin.spread("boresight_rad") is not None
    assert thin.spread("boresight_rad").median == pytest.approx(35 * ARCSEC, rel=0, abs=1e-9)


def test_json_and_plot_have_the_conditions_of_each_frame(answered: tuple[Path, Path], tmp_path: Path) -> None:
    done = RUNNER.invoke(app, ["score", *map(str, answered), "-o", str(tmp_path)])
    assert done.exit_code == 0, done.output

    written = json.loads((tmp_path / "score.json").read_text())
    assert [one["cloud_transmission"] for one in written["frames"]] == TRANSMISSION
    assert [one.get("moon_altitude_deg") for one in written["frames"]] == [*MOON_DEG, None, None]
    assert written["bins"]["transmission of cloud"]["< 0.2"]["refused"] == 2
    assert (tmp_path / "score.png").stat().st_size > 10_000


def test_settings_drawn_at_random_share_a_table_unless_one_is_asked_for(answered: tuple[Path, Path]) -> None:
    plain = RUNNER.invoke(app, ["score", *map(str, answered)]).output
    asked = RUNNER.invoke(app, ["score", *map(str, answered), "--by", "cloud.coverage"]).output
    wrong = RUNNER.invoke(app, ["score", *map(str, answered), "--by", "cloud.cover"])

    (row,) = (row for row in plain.splitlines() if row.strip().startswith("cloud.coverage"))
    assert " ".join(row.split()) == "cloud.coverage 0 to 0.1667 3 of 3 20 0.75 to 0.9167 0 of 3"
    assert "exposure.duration_s" in plain
    assert "0.25 to 0.4167" in asked
    assert "0.25 to 0.4167" not in plain
    assert wrong.exit_code == 2
    assert "cloud.coverage" in wrong.output


def test_frames_without_conditions_have_no_bins_of_them(answered: tuple[Path, Path], tmp_path: Path) -> None:
    rows = [{k: v for k, v in line(n).items() if "moon" not in k and "cloud_" not in k} for n in range(12)]
    (tmp_path / "truth.jsonl").write_text("".join(json.dumps(row) + "\n" for row in rows), encoding="utf-8")
    (tmp_path / "manifest.json").write_bytes((answered[0] / "manifest.json").read_bytes())

    assert not [name for name, _ in score(tmp_path, answered[1]).bins if "Moon" in name or "cloud " in name]
