"""``glstar compare``: reports on images and a log, by the command line."""

import json
import shutil
from collections.abc import Callable
from datetime import UTC, datetime
from math import floor
from pathlib import Path
from statistics import median

import cv2
import pytest
from PIL import Image
from typer.testing import CliRunner, Result

from glstar.cli import app
from glstar.config import Config
from glstar.sky.place.timescale import parse_utc
from tests.support.comparisons import CAMERA
from tests.support.exif import DATE_TIME_ORIGINAL, EXPOSURE_TIME, SUB_SEC_TIME_ORIGINAL, jpeg_with_exif
from tests.support.photofiles import exif_block

FLIGHT = Path(__file__).parents[2] / "assets" / "adelaide.BIN"


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
        *("compare.json", "compare.png", "best.png", "worst.png", "pairs.csv", "aligned.toml", "index.html")
    }
    assert json.loads((tmp_path / "compared" / "compare.json").read_text(encoding="utf-8")) == facts
    aligned = Config.load(tmp_path / "compared" / "aligned.toml")
    assert aligned.flight.time_offset_s == pytest.approx(0.02, abs=0.002)
    assert facts["alignment"]["time_offset_change_s"] == pytest.approx(aligned.flight.time_offset_s, abs=1e-6)
    assert facts["alignment"]["time_offset_std_s"] < 0.002
    assert facts["time_sources"] == "6 by truth.jsonl"
    assert facts["left_out_images"][0]["file"] == "notes.png"


def test_simulated_images_have_another_noise_than_an_export_with_the_same_seed(taken: Path, tmp_path: Path) -> None:
    result = run(
        *("compare", FLIGHT, taken / "frames", "-c", taken / "camera.toml", "-o", tmp_path / "compared"),
        *("--time-offset", "0.02", "--stars", "12", "--json"),
    )

    assert result.exit_code == 0, result.output
    summary = json.loads(result.stdout)["summary"]
    assert summary["brightest_pixel"]["magnitude_difference_std"] > 0.02  # mag; of equal noise 0
    assert 0.005 < summary["centroid"]["median_px"] < 2 * summary["centroid"]["noise_px"]


def test_turned_images_are_compared_as_the_sensor_read_them(taken: Path, tmp_path: Path) -> None:
    flight = Path(__file__).parents[2] / "assets" / "adelaide.BIN"
    frames = tmp_path / "frames"
    shutil.copytree(taken / "frames", frames, ignore=shutil.ignore_patterns("notes.png"))
    for path in sorted(frames.glob("*.png"))[:2]:
        Image.open(path).save(path, exif=exif_block(orientation=6))

    result = run("compare", flight, frames, "-c", taken / "camera.toml", "-o", tmp_path / "compared", "--json")

    assert result.exit_code == 0, result.output
    assert len(json.loads(result.stdout)["images"]) == 6
    assert "note: EXIF turns 2 of 6 images for display; pixels are as the sensor read them" in result.stderr


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
        ("there is no such file, nor a folder", [flight, tmp_path / "nowhere"]),
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


# By how much the clock of the camera below is ahead, s.
AHEAD_S = 0.31


@pytest.fixture(scope="module")
def stamped(tmp_path_factory: pytest.TempPathFactory) -> Callable[[str, float], tuple[Path, dict[str, float]]]:
    """Return a function that writes frames as JPEG files whose EXIF has whole seconds of a camera's clock.

    It takes the rule, "floor", "round" or "zeros" (sub-seconds of 00), and the zone that the clock shows, s; it returns
    the folder and the true start of each exposure, UTC seconds since 1970.
    """
    directory = tmp_path_factory.mktemp("stamped")
    (directory / "camera.toml").write_text(CAMERA, encoding="utf-8")
    drawn = run(
        *("export", FLIGHT, "-o", directory / "frames", "-c", directory / "camera.toml", "--start", "17.137"),
        *("--every", "6.37", "--frames", "6"),
    )
    assert drawn.exit_code == 0, drawn.output
    lines = [json.loads(line) for line in (directory / "frames" / "truth.jsonl").read_text("utf-8").splitlines()]

    def write(rule: str, zone_s: float = 0.0) -> tuple[Path, dict[str, float]]:
        folder, starts_s = directory / f"{rule}{zone_s:g}", dict[str, float]()
        folder.mkdir()
        for line in lines:
            start_s = parse_utc(line["utc_start"])
            written_s = (round if rule == "round" else floor)(start_s + AHEAD_S) + zone_s
            exif = {DATE_TIME_ORIGINAL: f"{datetime.fromtimestamp(written_s, UTC):%Y:%m:%d %H:%M:%S}"}
            exif |= {SUB_SEC_TIME_ORIGINAL: "00"} if rule == "zeros" else {}
            name = f"{Path(line['file']).stem}.jpg"
            pixels = cv2.imread(str(directory / "frames" / line["file"]), cv2.IMREAD_UNCHANGED)
            (folder / name).write_bytes(jpeg_with_exif(pixels, exif | {EXPOSURE_TIME: [(4, 10)]}))
            starts_s[name] = start_s
        return folder, starts_s

    return write


@pytest.mark.slow
@pytest.mark.parametrize(
    ("rule", "fit"), [("floor", ["--fit-time-offset"]), ("round", ["--fit-time-offset", "--fit-mount"]), ("zeros", [])]
)
def test_times_in_whole_seconds_are_fitted_within_them(
    stamped: Callable[..., tuple[Path, dict[str, float]]], taken: Path, tmp_path: Path, rule: str, fit: list[str]
) -> None:
    folder, starts_s = stamped(rule)

    result = run(
        *("compare", FLIGHT, folder, "-c", taken / "camera.toml", "-o", tmp_path / "out", "--stars", "12", *fit)
    )

    assert result.exit_code == 0, result.output
    facts = json.loads((tmp_path / "out" / "compare.json").read_text(encoding="utf-8"))
    assert facts["left_out"]["count"] == 0, facts["left_out_images"]
    off_s = [abs(image["start_utc_s"] - starts_s[image["file"]]) for image in facts["images"]]
    assert median(off_s) < 0.003
    assert max(off_s) < 0.05  # one is of a slow turn: 0.02 deg
    steps, zone = facts["notes"]
    assert steps in result.stderr
    assert "6 of 6 images are in steps of 1 s" in steps
    assert "6 of 6 images have no zone and were taken as UTC" in zone
    assert "--time-offset 32400" in zone
    if fit:
        fitted = facts["alignment"]
        assert 0.2 < fitted["time_offset_std_s"] < 0.5
        assert abs(fitted["time_offset_change_s"] - AHEAD_S) < 1.6 * fitted["time_offset_std_s"]
        assert "may cut off or round" in fitted["notes"][0]


def test_images_of_a_clock_in_local_time_are_refused_with_the_zone(
    stamped: Callable[..., tuple[Path, dict[str, float]]], taken: Path, tmp_path: Path
) -> None:
    folder, _ = stamped("floor", 34200.0)

    result = run("compare", FLIGHT, folder, "-c", taken / "camera.toml", "-o", tmp_path / "out")

    assert result.exit_code == 1
    assert "add --time-offset 34200, with which it lies in the flight" in result.output
