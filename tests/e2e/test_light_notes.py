"""``glstar export`` says when its frames are of day, or of the ground."""

import json
import re
from importlib.util import find_spec
from pathlib import Path

import pytest
from typer.testing import CliRunner

from glstar.cli import app

NIGHT, DAY = "2024-03-18T14:00:00Z", "2024-03-18T04:00:00Z"


def notes(tmp_path: Path, utc: str, *, pitch_deg: float) -> str:
    config = tmp_path / "config.toml"
    config.write_text(f"[mount]\nyaw_deg = 0.0\npitch_deg = {pitch_deg}\n", encoding="utf-8")
    flight = f"fly:still?utc_start={utc}&duration_s=5"
    result = CliRunner().invoke(app, ["export", flight, "-c", str(config), "-o", str(tmp_path / "frames"), "--dry-run"])
    assert result.exit_code == 0, result.output
    return result.stderr


@pytest.mark.parametrize(
    ("utc", "pitch_deg", "said"),
    [(DAY, 60.0, "with the Sun up to 53 deg high"), (NIGHT, -60.0, "all frames show only the ground")],
)
def test_frames_of_day_or_ground_are_noted(tmp_path: Path, utc: str, pitch_deg: float, said: str) -> None:
    assert said in notes(tmp_path, utc, pitch_deg=pitch_deg)


@pytest.mark.parametrize("pitch_deg", [60.0, -10.0])
def test_frames_of_a_night_sky_have_no_note(tmp_path: Path, pitch_deg: float) -> None:
    assert notes(tmp_path, NIGHT, pitch_deg=pitch_deg) == ""


def test_an_export_of_a_natural_sky_notes_light_moon_and_limit(tmp_path: Path) -> None:
    config = tmp_path / "config.toml"
    config.write_text('[sky]\nbrightness = "natural"\n[mount]\npitch_deg = 60.0\n', encoding="utf-8")
    flight = "fly:still?latitude_deg=-34.93&longitude_deg=138.60&utc_start=2024-03-18T12:00:00Z&duration_s=5"
    result = CliRunner().invoke(app, ["export", flight, "-c", str(config), "-o", str(tmp_path / "a"), "--dry-run"])
    assert result.exit_code == 0, result.output
    # The Moon of 2024-03-18 is 62 % lit and above the north-west of Adelaide, by any almanac.
    assert re.search(
        r"the middle frame: night: Sun -\d+ deg, Moon \d+ deg, 6\d% lit, \d+ deg from the axis; limit V \d\.\d",
        result.stderr.replace("\n", " "),
    )


@pytest.mark.parametrize(("pitch_deg", "said"), [(-60.0, "the camera sees only the ground"), (60.0, "")])
def test_info_says_where_the_camera_points_and_what_cloud_transmits(
    tmp_path: Path, pitch_deg: float, said: str
) -> None:
    config = tmp_path / "config.toml"
    lines = f"[mount]\nyaw_deg = 0.0\npitch_deg = {pitch_deg}\n[cloud]\ncoverage = 1.0\noptical_depth = 1.0\n"
    config.write_text(lines, encoding="utf-8")
    flight = f"fly:still?utc_start={NIGHT}&duration_s=5"
    text = CliRunner().invoke(app, ["info", flight, "-c", str(config)])
    assert text.exit_code == 0, text.output
    assert ("view" in text.stdout) == bool(said)
    assert said in text.stdout
    found = json.loads(CliRunner().invoke(app, ["info", flight, "-c", str(config), "--json"]).stdout)
    assert found["sees_only_ground"] == bool(said)
    assert abs(found["axis_altitude_deg"] - pitch_deg) < 0.1
    if not said:
        assert 0.05 < found["cloud_transmission"] < 0.6


@pytest.mark.skipif(find_spec("astropy_iers_data") is None, reason="astropy-iers-data is an extra")
def test_an_export_after_the_end_of_the_table_of_ut1_notes_it(tmp_path: Path) -> None:
    assert "UT1 - UTC = " in notes(tmp_path, "2060-03-18T12:00:00Z", pitch_deg=60.0)
