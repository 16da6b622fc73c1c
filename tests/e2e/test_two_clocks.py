"""The camera's clock stamps images; sky, attitude and position are those of UTC."""

import json
from pathlib import Path

import pytest
from typer.testing import CliRunner, Result

from glstar.cli import app
from glstar.config import Config
from glstar.sky.place.timescale import format_utc, parse_utc
from tests.support.comparisons import CAMERA

FLIGHT = Path(__file__).parents[2] / "assets" / "adelaide.BIN"
HOUR_S = 3600.0
CAMERA_KEYS = {"camera_utc_start", "camera_utc_mid"}


def run(*arguments: object) -> Result:
    result = CliRunner().invoke(app, [str(argument) for argument in arguments])
    assert result.exit_code == 0, result.output
    return result


def truth_of(directory: Path) -> list[dict]:
    return [json.loads(line) for line in (directory / "truth.jsonl").read_text(encoding="utf-8").splitlines()]


@pytest.fixture(scope="module")
def exported(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a directory with frames of a camera with a correct clock, and of one an hour ahead."""
    directory = tmp_path_factory.mktemp("clocks")
    (directory / "camera.toml").write_text(CAMERA, encoding="utf-8")
    for name, offset_s in (("right", 0.0), ("ahead", HOUR_S)):
        words = ("-c", directory / "camera.toml", "--time-offset", offset_s, "--start", 5, "--frames", 4)
        run("export", FLIGHT, "-o", directory / name, *words)
    return directory


def test_a_camera_clock_an_hour_ahead_stamps_the_same_images_an_hour_later(exported: Path) -> None:
    right, ahead = (truth_of(exported / name) for name in ("right", "ahead"))

    assert len(right) == 4
    for one, other in zip(right, ahead, strict=True):
        assert (exported / "right" / one["file"]).read_bytes() == (exported / "ahead" / other["file"]).read_bytes()
        assert {key: one[key] for key in one.keys() - CAMERA_KEYS} == {
            key: other[key] for key in other.keys() - CAMERA_KEYS
        }
        for instant in ("start", "mid"):
            assert one[f"camera_utc_{instant}"] == one[f"utc_{instant}"]
            later_s = parse_utc(other[f"camera_utc_{instant}"]) - parse_utc(other[f"utc_{instant}"])
            assert later_s == pytest.approx(HOUR_S, abs=1e-5)
    flights = [json.loads((exported / name / "manifest.json").read_text())["flight"] for name in ("right", "ahead")]
    assert flights[0] == flights[1]


def test_real_images_are_found_in_the_log_by_the_offset_and_the_fit_refines_it(exported: Path, tmp_path: Path) -> None:
    """The camera stamps its images 3600.02 s late; the user knows only the hour."""
    real = tmp_path / "real"
    real.mkdir()
    rows = []
    for line in truth_of(exported / "right"):
        (real / line["file"]).write_bytes((exported / "right" / line["file"]).read_bytes())
        rows.append(f"{line['file']},{format_utc(parse_utc(line['utc_start']) + HOUR_S + 0.02)}")
    (real / "images.csv").write_text("\n".join(["file,utc", *rows]) + "\n", encoding="utf-8")

    words = ("-c", exported / "camera.toml", "--time-offset", HOUR_S, "--fit-time-offset", "--search-time", "0.05")
    facts = json.loads(run("compare", FLIGHT, real, "-o", tmp_path / "compared", *words, "--stars", 8, "--json").stdout)

    aligned = Config.load(tmp_path / "compared" / "aligned.toml")
    assert aligned.flight.time_offset_s == pytest.approx(HOUR_S + 0.02, abs=0.002)
    assert facts["alignment"]["time_offset_change_s"] == pytest.approx(0.02, abs=0.002)
    # With the fitted offset the exposures are those that were drawn.
    again = ("-c", tmp_path / "compared" / "aligned.toml", "--stars", 8, "--json")
    facts = json.loads(run("compare", FLIGHT, real, "-o", tmp_path / "again", *again).stdout)
    drawn_s = [parse_utc(line["utc_start"]) for line in truth_of(exported / "right")]
    assert [image["start_utc_s"] for image in facts["images"]] == pytest.approx(drawn_s, abs=0.002)
    assert facts["summary"]["centroid"]["median_px"] < 0.2


def test_the_camera_s_clock_can_be_swept_without_changing_the_images(tmp_path: Path) -> None:
    (tmp_path / "sweep.toml").write_text(f"{CAMERA}[sweep]\nflight.time_offset_s = [0.0, -7.5]\n", encoding="utf-8")
    run("export", FLIGHT, "-o", tmp_path / "set", "-c", tmp_path / "sweep.toml", "--start", 5, "--frames", 1)

    one, other = truth_of(tmp_path / "set")
    assert [one["utc_mid"], one["stars"], one["q_body_ned"]] == [other["utc_mid"], other["stars"], other["q_body_ned"]]
    later_s = [parse_utc(line["camera_utc_mid"]) - parse_utc(line["utc_mid"]) for line in (one, other)]
    assert later_s == pytest.approx([0.0, -7.5], abs=1e-5)
