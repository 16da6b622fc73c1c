"""``glstar export`` says when its frames are of day, or of the ground."""

from pathlib import Path

import pytest
from typer.testing import CliRunner

from glstar.cli import app

NIGHT, DAY = "2024-03-18T14:00:00Z", "2024-03-18T04:00:00Z"


def notes(tmp_path: Path, utc: str, *, pitch_deg: float) -> str:
    config = tmp_path / "config.toml"
    config.write_text(f"[mount]\nyaw_deg = 0.0\npitch_deg = {pitch_deg}\n", encoding="utf-8")
    flight = f"fly:still?start_utc={utc}&duration_s=5"
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
