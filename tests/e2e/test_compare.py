"""``glstar compare``: reports on images and a log, by the command line."""

import json
import shutil
from pathlib import Path

import pytest
from typer.testing import CliRunner, Result

from glstar.cli import app
from glstar.config import Config
from tests.support.comparisons import CAMERA


def run(*arguments: str | Path) -> Result:
    return CliRunner().invoke(app, [str(argument) for argument in arguments])


@pytest.fixture(scope="module")
def taken(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a directory with frames of the bundled flight, drawn with a clock 20 ms ahead, and plain settings."""
    directory = tmp_path_factory.mktemp("compare")
    (directory / "camera.toml").write_text(CAMERA, encoding="utf-8")
    flight = Path(__file__).parents[2] / "assets" / "adelaide.BIN"
    drawn = run(
        *("export", flight, "-o", directory / "frames", "-c", directory / "camera.toml", "--time-offset", "0.02"),
        *("--start", "5", "--frames", "6"),
    )
    assert drawn.exit_code == 0, drawn.output
    return directory


def test_the_fitted_clock_offset_is_written_to_the_settings(taken: Path, tmp_path: Path) -> None:
    flight = Path(__file__).parents[2] / "assets" / "adelaide.BIN"
    (taken / "frames" / "notes.png").write_bytes(b"no image")

    result = run(
        *("compare", flight, taken / "frames", "-c", taken / "camera.toml", "-o", tmp_path / "compared"),
        *("--fit-time-offset", "--search-time", "0.1", "--stars", "12", "--json"),
    )

    assert result.exit_code == 0, result.output
    facts = json.loads(result.stdout)
    assert {path.name for path in (tmp_path / "compared").iterdir()} == {
        *("compare.json", "compare.png", "best.png", "worst.png", "pairs.csv", "aligned.toml")
    }
    assert json.loads((tmp_path / "compared" / "compare.json").read_text(encoding="utf-8")) == facts
    aligned = Config.load(tmp_path / "compared" / "aligned.toml")
    assert aligned.flight.time_offset_s == pytest.approx(0.02, abs=0.002)
    assert facts["alignment"]["time_offset_change_s"] == pytest.approx(aligned.flight.time_offset_s, abs=1e-6)
    assert facts["alignment"]["time_offset_std_s"] < 0.002
    assert facts["time_sources"] == "6 by truth.jsonl"
    assert facts["left_out_images"][0]["file"] == "notes.png"


def test_the_fitted_readout_time_is_written_to_the_settings(taken: Path, tmp_path: Path) -> None:
    flight = Path(__file__).parents[2] / "assets" / "adelaide.BIN"
    rolling = tmp_path / "rolling.toml"
    rolling.write_text(CAMERA + 'readout_s = 0.05\nreadout = "up"\n', encoding="utf-8")
    drawn = run("export", flight, "-o", tmp_path / "frames", "-c", rolling, "--start", "5", "--frames", "4")
    assert drawn.exit_code == 0, drawn.output

    result = run(
        *("compare", flight, tmp_path / "frames", "-c", taken / "camera.toml", "-o", tmp_path / "compared"),
        *("--fit-readout", "--stars", "12"),
    )

    assert result.exit_code == 0, result.output
    assert "(the rows open up, not down as configured)" in " ".join(result.output.split())
    found = json.loads((tmp_path / "compared" / "compare.json").read_text(encoding="utf-8"))["alignment"]
    assert found["readout_s"] == pytest.approx(-0.05, rel=0, abs=0.001)
    assert 0 < found["readout_std_s"] < 0.001
    assert found["time_offset_change_s"] is None
    aligned = Config.load(tmp_path / "compared" / "aligned.toml")
    assert aligned.exposure.readout_s == pytest.approx(0.05, rel=0, abs=0.001)
    assert aligned.exposure.readout == "up"
    assert aligned.flight.time_offset_s == 0


def test_what_cannot_be_meant_is_one_line(taken: Path, tmp_path: Path) -> None:
    frames, camera = taken / "frames", taken / "camera.toml"
    flight = Path(__file__).parents[2] / "assets" / "adelaide.BIN"
    for words, arguments in (
        ("needs a flight and images", [frames]),
        ("need a flight", [frames, "--against", frames, "--fit-mount"]),
        ("need a flight", [frames, "--against", frames, "--fit-readout"]),
        ("neither an image nor a folder", [flight, tmp_path / "nowhere"]),
        ("not a folder of images", [frames, "--against", tmp_path / "nowhere"]),
    ):
        result = run("compare", *arguments, "-c", camera, "-o", tmp_path / "out")
        assert result.exit_code == 1, result.output
        assert words in result.output
        assert "Traceback" not in result.output
    assert not (tmp_path / "out").exists()


def test_an_export_compared_with_itself_has_no_difference(taken: Path, tmp_path: Path) -> None:
    (taken / "frames" / "notes.png").unlink(missing_ok=True)
    result = run("compare", taken / "frames", "--against", taken / "frames", "-o", tmp_path / "same", "--json")

    assert result.exit_code == 0, result.output
    facts = json.loads(result.stdout)
    assert facts["summary"]["shift"]["mean_px"] < 0.02
    assert facts["summary"]["peak"]["mean_absolute_percentage_error"] < 2.0
    assert any(star["star_id"] for star in facts["stars"])
    assert {star["catalogue"] for star in facts["stars"]} == {"bsc5"}


def test_stars_of_truth_of_schema_1_are_identified(taken: Path, tmp_path: Path) -> None:
    now = tmp_path / "now"
    old = tmp_path / "old"
    shutil.copytree(taken / "frames", old)
    lines = [json.loads(line) for line in (old / "truth.jsonl").read_text(encoding="utf-8").splitlines()]
    for line in lines:
        line["schema"] = "glstar-truth-1"
        for key in ("catalogue", "C_camera_body", "up_camera"):
            del line[key]
        line["stars"] = [{"hr": star.pop("star_id"), **star} for star in line["stars"]]
    (old / "truth.jsonl").write_text("".join(json.dumps(line) + "\n" for line in lines), encoding="utf-8")

    found = [
        json.loads(run("compare", taken / "frames", "--against", against, "-o", now, "--json").stdout)["stars"]
        for against in (taken / "frames", old)
    ]

    assert [star | {"catalogue": ""} for star in found[0]] == found[1]
