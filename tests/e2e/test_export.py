"""``glstar export``: the content of the directory, and repeated runs."""

import json
import os
import pty
import shlex
import signal
import subprocess
import sys
from datetime import datetime
from itertools import pairwise
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
import tifffile

from glstar.camera.sensor.pointspread import TRUNCATION_DN
from glstar.errors import ExportError
from glstar.export.imagefiles.formats import encode, write_video
from glstar.render.truth.frame import KEYS
from glstar.sky.catalogue.reading import StarCatalogue
from glstar.system.resources import asset
from tests.support.exports import (
    CAMERA,
    FIRST_UTC_S,
    FRAMES,
    IN_PROGRESS,
    SETTINGS,
    assert_same,
    contents,
    done,
    image_of,
    invoke,
    manifest_of,
    paused,
    refused,
    start,
    table_of_a_flight,
    truth_of,
)

SHARED = Path(__file__).parents[3] / "shared" / "logs"
# Empty if there is no ../shared/logs.
REAL_LOGS = [log for kind in ("BIN", "tlog", "ulg") for log in sorted(SHARED.glob(f"*.{kind}"))]

# Few stars, so that some are isolated.
FEW_STARS = SETTINGS.replace("4.0", "2.0")

TRUTH_KEYS = [
    *("schema", "frame", "file", "utc_start", "utc_mid", "camera_utc_start", "camera_utc_mid"),
    *("duration_s", "seed", "sub_exposures", "site"),
    *("q_body_ned", "C_camera_body", "C_camera_icrs", "up_camera", "camera", "catalogue", "stars"),
]
STAR_KEYS = [
    *(
        "star_id",
        "vmag",
        "camera_mag",
        "x_px",
        "y_px",
        "centroid_x_px",
        "centroid_y_px",
        "start",
        "end",
        "peak_dn",
        "flux_dn",
    ),
    *("in_frame", "saturated", "trail_peak_dn", "snr"),
]

# Runs the command line, and kills it with SIGKILL while a file called `victim` is written or renamed.
DYING = """
import os, signal, sys
from pathlib import Path
moment, victim = sys.argv.pop(1), sys.argv.pop(1)
write_bytes, replace, link = Path.write_bytes, Path.replace, os.link

def die():
    os.kill(os.getpid(), signal.SIGKILL)

def dying_write(path, content):
    if moment == "half written" and path.name.endswith(victim):
        write_bytes(path, content[: len(content) // 2])
        die()
    return write_bytes(path, content)

def dying_replace(path, target):
    if moment == "before its name" and Path(target).name == victim:
        die()
    result = replace(path, target)
    if moment == "after its name" and Path(target).name == victim:
        die()
    return result

def dying_link(path, target):
    link(path, target)
    if moment == "after its name" and Path(target).name == victim:
        die()

Path.write_bytes, Path.replace, os.link = dying_write, dying_replace, dying_link
from glstar.cli import main
main()
"""


# Runs the command line with 3 GiB of memory.
SMALL_MACHINE = """
import resource
resource.setrlimit(resource.RLIMIT_AS, (3 << 30, 3 << 30))
from glstar.cli import main
main()
"""


def starts_s(directory: Path) -> list[float]:
    """Return the start times of the frames, s from the flight's first attitude."""
    return [round(utc_s(line["utc_start"]) - FIRST_UTC_S, 6) for line in truth_of(directory)]


def utc_s(text: str) -> float:
    return datetime.fromisoformat(text).timestamp()


@pytest.fixture(scope="session")
def inputs(tmp_path_factory: pytest.TempPathFactory) -> SimpleNamespace:
    """A flight and a small camera, as files."""
    folder = tmp_path_factory.mktemp("inputs")
    files = SimpleNamespace(folder=folder, flight=folder / "flight.csv", config=folder / "small.toml")
    files.flight.write_text(table_of_a_flight(), encoding="utf-8")
    files.config.write_text(SETTINGS, encoding="utf-8")
    files.words = ("export", files.flight, "--config", files.config, "-o")
    return files


@pytest.fixture(scope="session")
def one_run(inputs: SimpleNamespace, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The complete flight, exported by one run."""
    directory = tmp_path_factory.mktemp("one-run") / "frames"
    done(*inputs.words, directory)
    return directory


@pytest.fixture(scope="session")
def six(inputs: SimpleNamespace, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Six frames, exported by one run; read-only."""
    directory = tmp_path_factory.mktemp("six") / "frames"
    done(*inputs.words, directory, "--frames", 6)
    return directory


@pytest.fixture
def six_again(six: Path, tmp_path: Path) -> Path:
    """A copy of the six frames."""
    directory = tmp_path / "again"
    directory.mkdir()
    for name, content in contents(six).items():
        (directory / name).write_bytes(content)
    return directory


# --- the same frames after any interruption - -------------------------------------------------------------------------


def test_two_exports_of_one_flight_are_equal_byte_for_byte(
    inputs: SimpleNamespace, one_run: Path, tmp_path: Path
) -> None:
    process = start(*inputs.words, tmp_path / "frames", cwd=tmp_path)

    _, err = process.communicate(timeout=60)

    assert (process.returncode, err) == (0, "")
    assert_same(tmp_path / "frames", one_run)


def test_an_export_leaves_frames_truth_and_manifest_and_nothing_else(one_run: Path) -> None:
    frames = [f"frame_{number:06d}.png" for number in range(FRAMES)]

    assert sorted(contents(one_run)) == [*frames, "manifest.json", "truth.jsonl"]


def test_a_repeatedly_killed_export_ends_with_the_files_of_one_run(
    inputs: SimpleNamespace, one_run: Path, tmp_path: Path
) -> None:
    directory = tmp_path / "frames"
    for count in (1, 5, 9):
        process = paused(count, *inputs.words, directory)
        process.kill()
        process.communicate()
        assert process.returncode == -signal.SIGKILL
    there = len(list(directory.glob("frame_*.png")))
    assert there < FRAMES
    assert not (directory / "truth.jsonl").exists()

    report = json.loads(done(*inputs.words, directory, "--json").out)

    assert report["drawn"] + report["there_already"] == FRAMES
    assert 0 <= there - report["there_already"] <= IN_PROGRESS
    assert_same(directory, one_run)


@pytest.mark.parametrize(
    ("moment", "victim"),
    [
        ("half written", "manifest.json"),
        ("after its name", "manifest.json"),
        ("half written", "frame_000003.png"),
        ("before its name", "frame_000000.png"),
        ("after its name", "frame_000004.png"),
        ("before its name", "truth.jsonl"),
        ("after its name", "truth.jsonl"),
    ],
)
def test_an_export_killed_while_it_writes_or_renames_a_file_ends_with_the_files_of_one_run(
    moment: str, victim: str, inputs: SimpleNamespace, six: Path, tmp_path: Path
) -> None:
    directory = tmp_path / "frames"
    words = [*map(str, inputs.words), str(directory), "--frames", "6"]
    child = subprocess.run([sys.executable, "-c", DYING, moment, victim, *words], capture_output=True, check=False)
    assert child.returncode == -signal.SIGKILL
    for name, content in contents(directory).items():
        if name in contents(six) and not name.startswith("manifest"):
            assert content == contents(six)[name], "a file that has its name is whole"

    done(*words)

    assert_same(directory, six)


@pytest.mark.parametrize("share", [0.0, 0.01, 0.5, 0.999])
def test_a_line_of_truth_cut_off_by_a_kill_is_written_again(
    share: float, inputs: SimpleNamespace, six: Path, six_again: Path
) -> None:
    lines = (six / "truth.jsonl").read_bytes().splitlines(keepends=True)
    cut = lines[3][: int(share * len(lines[3]))]
    (six_again / "truth.jsonl").unlink()
    (six_again / "truth.jsonl.partial").write_bytes(b"".join(lines[:3]) + cut)
    (six_again / ".glstar-writing-frame_000004.png").write_bytes(b"\x89PNG half a frame")
    for number in (4, 5):
        (six_again / f"frame_{number:06d}.png").unlink()

    report = json.loads(done(*inputs.words, six_again, "--frames", 6, "--json").out)

    assert (report["drawn"], report["there_already"]) == (3, 3)
    assert_same(six_again, six)


def test_a_second_run_changes_no_file(inputs: SimpleNamespace, six_again: Path) -> None:
    before = {path.name: path.stat().st_mtime_ns for path in six_again.iterdir()}

    said = done(*inputs.words, six_again, "--frames", 6)

    assert said.out.startswith("0 frames drawn in ")
    assert "6 there already" in said.out
    assert {path.name: path.stat().st_mtime_ns for path in six_again.iterdir()} == before


def test_frames_deleted_by_hand_are_drawn_again_and_the_others_left(
    inputs: SimpleNamespace, six: Path, six_again: Path
) -> None:
    for number in (0, 3):
        (six_again / f"frame_{number:06d}.png").unlink()
    kept = six_again / "frame_000004.png"
    before_ns = kept.stat().st_mtime_ns

    report = json.loads(done(*inputs.words, six_again, "--frames", 6, "--json").out)

    assert report["drawn"] == 2
    assert kept.stat().st_mtime_ns == before_ns
    assert_same(six_again, six)


def test_truth_deleted_by_hand_is_written_again(inputs: SimpleNamespace, six: Path, six_again: Path) -> None:
    (six_again / "truth.jsonl").unlink()

    done(*inputs.words, six_again, "--frames", 6)

    assert_same(six_again, six)


def test_an_export_of_three_frames_is_extended_to_six(inputs: SimpleNamespace, six: Path, tmp_path: Path) -> None:
    directory = tmp_path / "frames"
    done(*inputs.words, directory, "--frames", 3)

    report = json.loads(done(*inputs.words, directory, "--frames", 6, "--json").out)

    assert (report["drawn"], report["there_already"]) == (3, 3)
    assert_same(directory, six)


def test_fewer_frames_than_exported_are_refused(inputs: SimpleNamespace, six: Path, six_again: Path) -> None:
    line = refused(*inputs.words, six_again, "--frames", 3)

    assert "holds 6 frames" in line
    assert "3 were asked for" in line
    assert "--force" in line
    assert_same(six_again, six)


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        (("--seed", "1"), "seed was 0, is 1"),
        (("--exposure", "0.25"), "config.exposure.duration_s was 0.5, is 0.25"),
        (("--every", "1"), "config.exposure.interval_s was 0.5, is 1"),
        (("--start", "1"), "start_s was 0.0, is 1.0"),
        (("--light",), "light was False, is True"),
        (("--format", "tiff"), "format was png, is tiff"),
    ],
)
def test_other_settings_in_the_same_directory_are_refused_by_name(
    words: tuple[str, ...], expected: str, inputs: SimpleNamespace, six: Path, six_again: Path
) -> None:
    line = refused(*inputs.words, six_again, "--frames", 6, *words)

    assert expected in line
    assert "--force" in line
    assert_same(six_again, six)


def test_another_flight_in_the_same_directory_is_refused(
    inputs: SimpleNamespace, six: Path, six_again: Path, tmp_path: Path
) -> None:
    other = tmp_path / "flight.csv"
    other.write_text(table_of_a_flight(yaw_deg_per_s=3.0), encoding="utf-8")

    line = refused("export", other, "--config", inputs.config, "-o", six_again, "--frames", 6)

    assert "flight.sha256" in line
    assert_same(six_again, six)


def test_force_removes_the_files_of_an_export_and_no_others(inputs: SimpleNamespace, six: Path, tmp_path: Path) -> None:
    directory = tmp_path / "frames"
    done(*inputs.words, directory, "--frames", 8, "--format", "tiff", "--light", "--seed", 3)
    (directory / "notes.txt").write_text("mine", encoding="utf-8")

    done(*inputs.words, directory, "--frames", 6, "--force")

    assert (directory / "notes.txt").read_text(encoding="utf-8") == "mine"
    (directory / "notes.txt").unlink()
    assert_same(directory, six)


def test_frames_without_a_manifest_are_not_continued(inputs: SimpleNamespace, six: Path, six_again: Path) -> None:
    (six_again / "manifest.json").unlink()

    line = refused(*inputs.words, six_again, "--frames", 6)

    assert "no manifest" in line
    done(*inputs.words, six_again, "--frames", 6, "--force")
    assert_same(six_again, six)


@pytest.mark.parametrize("flags", [[], ["--verify"]])
def test_an_export_with_truth_of_schema_1_is_neither_continued_nor_verified(
    flags: list[str], inputs: SimpleNamespace, six: Path, six_again: Path
) -> None:
    manifest = six_again / "manifest.json"
    manifest.write_text(manifest.read_text(encoding="utf-8").replace("manifest-2", "manifest-1"), encoding="utf-8")

    line = refused(*inputs.words, six_again, "--frames", 6, *flags)

    assert "glstar-manifest-1" in line
    assert "continues and verifies glstar-manifest-2 only" in line
    assert (six_again / "truth.jsonl").read_bytes() == (six / "truth.jsonl").read_bytes()


@pytest.mark.parametrize(
    "manifest",
    [
        *("", "{", "[]", '{"frames": "six"}', "null"),
        '{"frames": 6, "config": ' + "[" * 1000 + "]" * 1000 + "}",
        '{"frames": 6, "config": ' + '{"sky":' * 100_000 + "1" + "}" * 100_001,
    ],
    ids=["empty", "torn", "a list", "no count", "null", "nested", "nested far too deep"],
)
def test_an_invalid_manifest_is_refused(manifest: str, inputs: SimpleNamespace, six_again: Path) -> None:
    (six_again / "manifest.json").write_text(manifest, encoding="utf-8")

    assert "is no manifest of glstar" in refused(*inputs.words, six_again, "--frames", 6)


def test_ctrl_c_exits_with_130_and_the_next_run_completes_the_export(
    inputs: SimpleNamespace, one_run: Path, tmp_path: Path
) -> None:
    directory = tmp_path / "frames"
    process = paused(3, *inputs.words, directory)

    process.send_signal(signal.SIGINT)
    process.send_signal(signal.SIGCONT)
    _, err = process.communicate(timeout=60)

    assert process.returncode == 130
    assert "Traceback" not in err
    assert not list(directory.glob(".glstar-writing-*"))
    done(*inputs.words, directory)
    assert_same(directory, one_run)


# --- which exposures --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("words", "expected_s"),
    [
        (("--start", 2, "--stop", 5, "--every", 1), [2, 3, 4]),
        (("--start", 2, "--stop", 4.5, "--every", 1), [2, 3, 4]),  # the last exposure ends at the end of the flight
        (("--start", 2, "--stop", 4.4, "--every", 1), [2, 3]),
        (("--start", 2, "--stop", 5, "--every", 1, "--frames", 2), [2, 3]),
        (("--start", 2, "--stop", 3, "--every", 0.25), [2, 2.25, 2.5]),  # exposures may overlap
        (("--start", 11, "--stop", 99, "--every", 0.5), [11, 11.5, 12]),
        (("--start", 12), [12]),
        (("--exposure", 12.5), [0]),
        (("--exposure", 0.1, "--every", 6.2), [0, 6.2, 12.4]),
    ],
)
def test_exposures_begin_at_the_interval_and_end_within_the_selected_part(
    words: tuple[object, ...], expected_s: list[float], inputs: SimpleNamespace, tmp_path: Path
) -> None:
    done(*inputs.words, tmp_path, *words)

    np.testing.assert_allclose(starts_s(tmp_path), expected_s, rtol=0, atol=1e-6)  # s
    exposure_s = words[words.index("--exposure") + 1] if "--exposure" in words else 0.5
    assert {line["duration_s"] for line in truth_of(tmp_path)} == {exposure_s}


@pytest.fixture
def gappy(inputs: SimpleNamespace, tmp_path: Path) -> tuple[object, ...]:
    """The arguments to export a flight whose log has a data gap from 4 to 6 s."""
    flight = tmp_path / "gap.csv"
    flight.write_text(table_of_a_flight(silent=(4.0, 6.0)), encoding="utf-8")
    return "export", flight, "--config", inputs.config, "-o", tmp_path / "frames"


def test_exposures_across_a_data_gap_are_skipped_and_counted(gappy: tuple[object, ...], tmp_path: Path) -> None:
    said = done(*gappy)

    drawn = [0, 0.5, 1, 1.5, 2, 2.5, 3, 3.5, *np.arange(6, 12.5, 0.5)]
    np.testing.assert_allclose(starts_s(tmp_path / "frames"), drawn, rtol=0, atol=1e-6)  # s
    assert [line["frame"] for line in truth_of(tmp_path / "frames")] == [k for k in range(25) if k not in range(8, 12)]
    assert not (tmp_path / "frames" / "frame_000008.png").exists()
    assert said.out.startswith("21 frames drawn")
    assert said.err.startswith("4 frames skipped, their exposures meet a data gap of the log; the longest, ")
    assert "--max-gap" in said.err
    manifest = manifest_of(tmp_path / "frames")
    assert manifest["frames"] == 21
    assert [frame["start_s"] for frame in manifest["skipped"]] == [4.0, 4.5, 5.0, 5.5]
    assert manifest["flight"]["gaps"] == {"a data gap": 1}


def test_a_json_report_lists_the_skipped_frames(gappy: tuple[object, ...], tmp_path: Path) -> None:
    said = done(*gappy, "--json")

    report = json.loads(said.out)
    assert said.err == ""
    assert (report["drawn"], report["there_already"]) == (21, 0)
    assert [frame["number"] for frame in report["skipped"]] == [8, 9, 10, 11]
    assert report["directory"] == str(tmp_path / "frames")
    assert report["video"] is None


def test_an_export_with_a_data_gap_is_continued_after_a_kill(gappy: tuple[object, ...], tmp_path: Path) -> None:
    done(*gappy)
    expected = contents(tmp_path / "frames")
    (tmp_path / "frames" / "frame_000012.png").unlink()
    (tmp_path / "frames" / "truth.jsonl").rename(tmp_path / "frames" / "truth.jsonl.partial")

    done(*gappy)

    assert contents(tmp_path / "frames") == expected


def test_a_flight_of_one_data_gap_has_no_frames_and_no_video(gappy: tuple[object, ...], tmp_path: Path) -> None:
    result = invoke(*gappy, "--start", 4, "--stop", 6, "--video", tmp_path / "none.mp4")

    assert result.rc in {0, 1}
    assert "4 frames skipped" in result.err or result.err.startswith("glstar: ")
    assert not list(tmp_path.glob("*.mp4"))


def test_fast_rotation_of_the_bundled_flight_fits_into_memory(inputs: SimpleNamespace, tmp_path: Path) -> None:
    # 15 s after the first attitude it tumbles: stars cross the plane z = 0 of the camera, where 1 / z is unbounded.
    config = tmp_path / "wide.toml"
    config.write_text(CAMERA, encoding="utf-8")
    words = ["export", "--config", config, "-o", tmp_path / "frames", "--start", 15, "--frames", 1]
    child = subprocess.run(
        [sys.executable, "-c", SMALL_MACHINE, *map(str, words)], capture_output=True, text=True, check=False, timeout=60
    )

    assert child.returncode == 0, child.stderr[-300:]
    assert truth_of(tmp_path / "frames")[0]["sub_exposures"] < 10_000


# --- formats ----------------------------------------------------------------------------------------------------------


def test_png_has_the_eight_bits_of_the_sensor(six: Path) -> None:
    image = image_of(six / "frame_000000.png")

    assert image.dtype == np.uint8
    assert image.shape == (120, 160)
    assert abs(float(np.median(image)) - 16) <= 1  # the sky, DN
    assert image.max() == 255  # Sirius


@pytest.mark.parametrize(("image_format", "suffix"), [("png16", ".png"), ("tiff", ".tiff")])
def test_sixteen_bits_of_an_eight_bit_sensor_are_257_times_as_many_dn(
    image_format: str, suffix: str, inputs: SimpleNamespace, six: Path, tmp_path: Path
) -> None:
    done(*inputs.words, tmp_path, "--frames", 6, "--format", image_format)

    path = tmp_path / f"frame_000000{suffix}"
    image = image_of(path) if suffix == ".png" else tifffile.imread(path)
    assert image.dtype == np.uint16
    assert image.shape == (120, 160)
    # Rounding to 8 bits is half a DN off; and stars are drawn until they are fainter than TRUNCATION_DN, 257 times
    # farther down where there are 257 times as many DN.
    np.testing.assert_allclose(image / 257, image_of(six / "frame_000000.png"), rtol=0, atol=0.5 + TRUNCATION_DN)
    assert manifest_of(tmp_path)["sensor"]["bit_depth"] == 16
    for fine, coarse in zip(truth_of(tmp_path), truth_of(six), strict=True):
        assert fine["file"] == Path(coarse["file"]).with_suffix(suffix).name
        assert [star["star_id"] for star in fine["stars"]][:20] == [star["star_id"] for star in coarse["stars"]][:20]
        for key in ("peak_dn", "flux_dn"):
            np.testing.assert_allclose(
                [star[key] for star in fine["stars"]][:20],
                [257 * star[key] for star in coarse["stars"]][:20],
                rtol=1e-6,
            )


def test_a_sensor_of_twelve_bits_keeps_its_dn_in_a_file_of_sixteen(inputs: SimpleNamespace, tmp_path: Path) -> None:
    config = tmp_path / "twelve.toml"
    config.write_text(SETTINGS + "[sensor]\nbit_depth = 12\n", encoding="utf-8")

    done("export", inputs.flight, "--config", config, "-o", tmp_path / "frames", "--frames", 1)

    image = image_of(tmp_path / "frames" / "frame_000000.png")
    assert image.dtype == np.uint16
    assert image.max() == 4095
    assert abs(float(np.median(image)) - 16) <= 1  # the sky, DN
    line = refused(
        *("export", inputs.flight, "--config", config, "-o", tmp_path / "other", "--frames", 1, "--format", "png")
    )
    assert "12 bits" in line
    assert not (tmp_path / "other").exists()


@pytest.fixture(scope="session")
def lit(inputs: SimpleNamespace, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two frames of few stars, with their noiseless signal."""
    folder = tmp_path_factory.mktemp("lit")
    (folder / "few.toml").write_text(FEW_STARS, encoding="utf-8")
    directory = folder / "frames"
    done("export", inputs.flight, "--config", folder / "few.toml", "-o", directory, "--frames", 2, "--light")
    return directory


def test_the_noiseless_signal_of_an_isolated_star_sums_to_its_flux(lit: Path) -> None:
    reach_px, alone = 15, 0
    for line in truth_of(lit):
        light_dn = tifffile.imread(lit / line["file"].replace(".png", ".light.tiff"))
        assert light_dn.dtype == np.float32
        assert light_dn.shape == (120, 160)
        at = np.array([[star["centroid_x_px"], star["centroid_y_px"]] for star in line["stars"]])
        for star, (x, y) in zip(line["stars"], at, strict=True):
            inside = reach_px < x < 159 - reach_px and reach_px < y < 119 - reach_px
            others = np.hypot(*(at - (x, y)).T) < 2 * reach_px * np.sqrt(2)
            if inside and others.sum() == 1:
                alone += 1
                rows, columns = (slice(round(c) - reach_px, round(c) + reach_px + 1) for c in (y, x))
                window = light_dn[rows, columns].astype(np.float64)
                assert window.sum() == pytest.approx(star["flux_dn"], rel=2e-3)
                # ... and its centroid is that of its label.
                row, column = np.indices(window.shape)
                centroid = (column * window).sum() / window.sum() + columns.start
                assert centroid == pytest.approx(x, abs=1e-3)  # px
                centroid = (row * window).sum() / window.sum() + rows.start
                assert centroid == pytest.approx(y, abs=1e-3)  # px
    assert alone >= 2


def test_a_deleted_noiseless_file_is_drawn_again(inputs: SimpleNamespace, lit: Path, tmp_path: Path) -> None:
    directory = tmp_path / "frames"
    directory.mkdir()
    for name, content in contents(lit).items():
        (directory / name).write_bytes(content)
    (directory / "frame_000001.light.tiff").unlink()
    config = lit.parent / "few.toml"

    done("export", inputs.flight, "--config", config, "-o", directory, "--frames", 2, "--light")

    assert_same(directory, lit)


def test_the_seed_changes_the_noise_and_nothing_else(inputs: SimpleNamespace, lit: Path, tmp_path: Path) -> None:
    config = lit.parent / "few.toml"

    done("export", inputs.flight, "--config", config, "-o", tmp_path, "--frames", 2, "--light", "--seed", 7)

    for seeded, line in zip(truth_of(tmp_path), truth_of(lit), strict=True):
        assert seeded.pop("seed") != line.pop("seed")
        assert seeded == line
        light = line["file"].replace(".png", ".light.tiff")
        assert (tmp_path / light).read_bytes() == (lit / light).read_bytes()
        difference = image_of(tmp_path / line["file"]).astype(float) - image_of(lit / line["file"])
        assert abs(difference.mean()) < 0.15  # DN: four standard errors of 19200 pixels
        assert np.median(np.abs(difference)) == pytest.approx(0.6745 * 3 * np.sqrt(2), abs=0.5)  # DN, of sky_std_dn = 3


def test_two_frames_have_different_noise(lit: Path) -> None:
    first, second = truth_of(lit)
    assert first["seed"] != second["seed"]
    light_dn = [tifffile.imread(lit / line["file"].replace(".png", ".light.tiff")) for line in (first, second)]
    dark = np.maximum(*light_dn) < 0.01  # DN
    noise = [image_of(lit / line["file"])[dark].astype(float) for line in (first, second)]
    assert dark.sum() > 10_000
    assert abs(np.corrcoef(*noise)[0, 1]) < 0.05


def test_a_dry_run_writes_nothing_and_estimates_the_size(inputs: SimpleNamespace, tmp_path: Path) -> None:
    before = sorted(inputs.folder.iterdir())
    said = done(*inputs.words, tmp_path / "frames", "--dry-run")
    facts = json.loads(done(*inputs.words, tmp_path / "frames", "--dry-run", "--json").out)

    assert said.out.startswith(f"{FRAMES} frames to ")
    assert "nothing written" in said.out
    assert facts["frames"] == FRAMES
    assert facts["skipped"] == 0
    assert facts["seconds"] > 0
    assert not (tmp_path / "frames").exists()
    assert sorted(inputs.folder.iterdir()) == before


def test_a_dry_run_predicts_the_bytes(inputs: SimpleNamespace, one_run: Path, tmp_path: Path) -> None:
    facts = json.loads(done(*inputs.words, tmp_path / "frames", "--dry-run", "--json").out)

    written = sum(len(content) for name, content in contents(one_run).items() if name != "manifest.json")
    assert facts["bytes"] == pytest.approx(written, rel=0.1)


@pytest.mark.parametrize("more", [("--workers", 2), ("--shard", "1/2")])
def test_a_dry_run_includes_the_disk_space_for_joining_the_truth(
    more: tuple[object, ...], inputs: SimpleNamespace, one_run: Path, tmp_path: Path
) -> None:
    alone = json.loads(done(*inputs.words, tmp_path / "frames", "--dry-run", "--json").out)
    report = json.loads(done(*inputs.words, tmp_path / "frames", "--dry-run", "--json", *more).out)

    assert alone["peak_bytes"] == alone["bytes"]
    truth_bytes = (one_run / "truth.jsonl").stat().st_size * report["frames"] / FRAMES
    assert report["peak_bytes"] - report["bytes"] == pytest.approx(truth_bytes, rel=0.1)
    assert "GB more while the truth is joined" in done(*inputs.words, tmp_path / "frames", "--dry-run", *more).out


def test_a_video_shows_every_frame(inputs: SimpleNamespace, six_again: Path, tmp_path: Path) -> None:
    video = tmp_path / "new folder" / "flight.mp4"
    said = done(*inputs.words, six_again, "--frames", 6, "--video", video, "--video-fps", 5)

    assert str(video) in said.out
    assert [path.name for path in video.parent.iterdir()] == ["flight.mp4"]
    reader = cv2.VideoCapture(str(video))
    assert reader.get(cv2.CAP_PROP_FRAME_COUNT) == 6
    assert reader.get(cv2.CAP_PROP_FPS) == pytest.approx(5)
    for number in range(6):
        good, shown = reader.read()
        assert good
        assert shown.shape == (120, 160, 3)
        drawn = image_of(six_again / f"frame_{number:06d}.png").astype(float)
        assert np.abs(shown[..., 0] - drawn).mean() < 5  # DN, error of the codec
    reader.release()


def test_a_video_of_frames_of_two_sizes_is_refused_before_anything_is_drawn(
    inputs: SimpleNamespace, tmp_path: Path
) -> None:
    (tmp_path / "two.toml").write_text(SETTINGS + "[sweep]\ncamera.width_px = [160, 200]\n", encoding="utf-8")
    words = ("export", inputs.flight, "-c", tmp_path / "two.toml", "--frames", 1, "-o", tmp_path / "frames")

    line = refused(*words, "--video", tmp_path / "two.mp4")

    assert "camera.width_px of [sweep] makes images of 160 x 120 px and 200 x 120 px" in line
    assert not (tmp_path / "frames").exists()
    assert done(*words).out.startswith("2 frames drawn")


@pytest.mark.parametrize("order", [1, -1])
def test_a_video_of_images_of_two_sizes_is_refused_with_both_sizes(order: int, tmp_path: Path) -> None:
    images = [tmp_path / f"{width_px}.png" for width_px in (40, 60)]
    for image, width_px in zip(images, (40, 60), strict=True):
        image.write_bytes(encode(np.zeros((30, width_px), np.uint8), "png"))

    with pytest.raises(ExportError, match=r"is \d0 x 30 px and \d0\.png \d0 x 30 px, and a video has frames of one"):
        write_video(images[::order], tmp_path / "video.mp4", frames_per_s=5.0, saturation_dn=255)

    assert sorted(path.name for path in tmp_path.iterdir()) == ["40.png", "60.png"]


def test_a_video_of_sixteen_bits_is_as_bright_as_one_of_eight(inputs: SimpleNamespace, tmp_path: Path) -> None:
    means = []
    for image_format in ("png", "tiff"):
        video = tmp_path / f"{image_format}.mp4"
        done(*inputs.words, tmp_path / image_format, "--frames", 2, "--format", image_format, "--video", video)
        reader = cv2.VideoCapture(str(video))
        means.append(reader.read()[1].mean())
        reader.release()

    assert means[0] == pytest.approx(means[1], abs=0.5)  # of 255


# --- the progress bar -------------------------------------------------------------------------------------------------


def test_no_progress_bar_is_drawn_if_standard_error_is_no_terminal(inputs: SimpleNamespace, tmp_path: Path) -> None:
    process = start(*inputs.words, tmp_path, "--frames", 2, env=os.environ | {"TERM": "xterm-256color"})

    out, err = process.communicate(timeout=60)

    assert (process.returncode, err) == (0, "")
    assert len(out.splitlines()) == 1
    assert "\x1b" not in out


def test_a_progress_bar_is_drawn_on_a_terminal(inputs: SimpleNamespace, tmp_path: Path) -> None:
    ours, theirs = pty.openpty()
    process = start(*inputs.words, tmp_path, stderr=theirs, env=os.environ | {"TERM": "xterm-256color"})
    os.close(theirs)
    shown = b""
    try:
        while more := os.read(ours, 65536):
            shown += more
    except OSError:  # Linux reports the closed end of a terminal as an error
        pass
    finally:
        os.close(ours)

    out, _ = process.communicate(timeout=60)

    assert process.returncode == 0
    assert b"frames" in shown
    assert f"/{FRAMES}".encode() in shown
    assert out.startswith(f"{FRAMES} frames drawn")


# --- the truth --------------------------------------------------------------------------------------------------------


def test_every_line_of_truth_has_every_key(one_run: Path) -> None:
    lines = truth_of(one_run)
    assert [line["frame"] for line in lines] == list(range(FRAMES))
    for line in lines:
        assert list(line) == TRUTH_KEYS
        assert list(line) == list(KEYS)
        assert line["schema"] == "glstar-truth-2"
        assert line["file"] == f"frame_{line['frame']:06d}.png"
        assert list(line["site"]) == ["latitude_deg", "longitude_deg", "height_m"]
        assert line["camera"] == {
            "K": [[150, 0, 79.5], [0, 150, 59.5], [0, 0, 1]],
            "width_px": 160,
            "height_px": 120,
            "lens": "none",
            "distortion": [],
        }
        assert line["catalogue"] == "bsc5"
        assert line["stars"]
        for star in line["stars"]:
            assert list(star) == STAR_KEYS


def test_the_truth_has_time_site_and_attitude(one_run: Path) -> None:
    for line in truth_of(one_run):
        start_s = utc_s(line["utc_start"])
        assert start_s == pytest.approx(FIRST_UTC_S + 0.5 * line["frame"], abs=1e-6)
        assert utc_s(line["utc_mid"]) == pytest.approx(start_s + 0.25, abs=1e-6)
        assert line["sub_exposures"] >= 1
        site = line["site"]
        assert site["latitude_deg"] == pytest.approx(-34.93, abs=1e-9)
        assert site["longitude_deg"] == pytest.approx(138.60, abs=1e-9)
        assert site["height_m"] == pytest.approx(100)
        # Level but for a slow roll, turning by 2 deg/s: the quaternion of yaw, then roll.
        t_s = 0.5 * line["frame"] + 0.25
        half_yaw, half_roll = np.deg2rad([2.0 * t_s, 0.5 * t_s]) / 2
        expected = [
            np.cos(half_yaw) * np.cos(half_roll),
            np.cos(half_yaw) * np.sin(half_roll),
            np.sin(half_yaw) * np.sin(half_roll),
            np.sin(half_yaw) * np.cos(half_roll),
        ]
        # The conjugate is the inverse rotation. The CSV is rounded to a thousandth of a degree.
        q = np.array(line["q_body_ned"])
        assert np.linalg.norm(q) == pytest.approx(1, abs=1e-12)
        conjugate = q * [1, -1, -1, -1]
        assert max(abs(q @ expected), abs(conjugate @ expected)) == pytest.approx(1, abs=1e-9)


def test_the_stars_of_a_line_are_the_catalogues_brightest_first(one_run: Path) -> None:
    for line in truth_of(one_run):
        vmag = [star["vmag"] for star in line["stars"]]
        assert vmag == sorted(vmag)
        assert max(vmag) <= 4.0
        numbers = [star["star_id"] for star in line["stars"]]
        assert len(set(numbers)) == len(numbers)
        catalogue = StarCatalogue.open("bsc5").by_id(numbers)
        assert dict(zip(numbers, vmag, strict=True)) == dict(
            zip(catalogue.star_id.tolist(), catalogue.vmag.tolist(), strict=True)
        )
        for star in line["stars"]:
            assert 0 <= star["in_frame"] <= 1
            assert star["flux_dn"] == pytest.approx(2 * np.pi * 1.2**2 * star["peak_dn"], rel=1e-6)
            assert star["peak_dn"] == pytest.approx(150 * 10 ** (-0.4 * (star["vmag"] - 3)), rel=1e-6)


def test_only_stars_that_reach_full_scale_are_saturated(one_run: Path) -> None:
    stars = [star for line in truth_of(one_run) for star in line["stars"] if star["in_frame"] == 1]

    assert all(star["saturated"] for star in stars if star["vmag"] < 0)
    assert any(star["vmag"] < 0 for star in stars)
    # A star of 3.5 mag stays under 110 DN with its sky, unless it is next to a bright one.
    assert sum(star["saturated"] for star in stars if star["vmag"] > 3.5) <= 0.02 * len(stars)


def test_the_matrices_of_the_truth_project_the_catalogue_onto_its_labels(one_run: Path) -> None:
    for line in truth_of(one_run):
        stars = [star for star in line["stars"] if star["x_px"] is not None]
        catalogue = StarCatalogue.open("bsc5").by_id([star["star_id"] for star in stars])
        ra, dec = catalogue.ra_rad, catalogue.dec_rad
        places = dict(
            zip(
                catalogue.star_id.tolist(),
                np.stack([np.cos(ra) * np.cos(dec), np.sin(ra) * np.cos(dec), np.sin(dec)], axis=-1),
                strict=True,
            )
        )
        C_camera_icrs = np.array(line["C_camera_icrs"])
        np.testing.assert_allclose(C_camera_icrs @ C_camera_icrs.T, np.eye(3), rtol=0, atol=1e-9)
        assert np.linalg.det(C_camera_icrs) == pytest.approx(1)
        v = np.array([places[star["star_id"]] for star in stars]) @ C_camera_icrs.T @ np.array(line["camera"]["K"]).T
        # The residual is aberration (20"), refraction (40" in the corners) and proper motion; a pixel is 23'.
        labels = [[star["x_px"], star["y_px"]] for star in stars]
        np.testing.assert_allclose(labels, v[:, :2] / v[:, 2:], rtol=0, atol=0.08)


def test_a_trail_begins_where_the_last_one_ended(one_run: Path) -> None:
    lines = truth_of(one_run)
    met = 0
    for before, after in pairwise(lines):
        ends = {star["star_id"]: star["end"] for star in before["stars"]}
        for star in after["stars"]:
            if star["star_id"] in ends:
                met += 1
                np.testing.assert_allclose(star["start"], ends[star["star_id"]], rtol=0, atol=2e-6)  # px, as rounded
    assert met > 100


def test_middle_and_centroid_lie_between_the_ends_of_a_trail(one_run: Path) -> None:
    for line in truth_of(one_run):
        for star in line["stars"]:
            if star["in_frame"] < 1:
                continue
            begin, end = np.array(star["start"]), np.array(star["end"])
            chord_px = float(np.hypot(*(end - begin)))
            # A degree of a steady turn: an arc with a sagitta of a thousandth of its length, at a constant rate.
            middle = np.array([star["x_px"], star["y_px"]])
            centroid = np.array([star["centroid_x_px"], star["centroid_y_px"]])
            assert np.hypot(*(middle - (begin + end) / 2)) < 0.01 * chord_px + 1e-3  # px
            assert np.hypot(*(centroid - (begin + end) / 2)) < 0.01 * chord_px + 1e-3  # px


def test_the_manifest_describes_the_flight_the_config_and_the_command(one_run: Path, inputs: SimpleNamespace) -> None:
    manifest = manifest_of(one_run)

    assert manifest["schema"] == "glstar-manifest-2"
    assert manifest["frames"] == FRAMES
    assert manifest["seed"] == 0
    assert manifest["skipped"] == []
    assert manifest["renderer"]
    assert manifest["config"]["camera"]["fx_px"] == 150
    assert manifest["config"]["sky"]["vmag_limit"] == 4.0
    assert len(manifest["catalogue"]["sha256"]) == 64
    assert manifest["flight"]["name"] == "flight.csv"
    assert manifest["flight"]["first_utc"].startswith("2024-03-10T11:00:00")
    assert manifest["command"].startswith("glstar export flight.csv --config small.toml")
    assert str(inputs.folder) not in json.dumps(manifest), "nothing of where it was made"


def test_the_command_of_a_manifest_draws_the_same_frames(
    inputs: SimpleNamespace, one_run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(inputs.folder)
    words = manifest_of(one_run)["command"].split()
    assert words[0] == "glstar"

    done(*words[1:], "-o", tmp_path / "frames")

    assert_same(tmp_path / "frames", one_run)


def test_the_command_of_a_manifest_has_every_option_of_the_flight(
    inputs: SimpleNamespace, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(inputs.folder)
    (inputs.folder / "chosen.toml").write_text('[flight]\nattitude = "ATT"\ninterpolation = "gyro"\n', encoding="utf-8")
    chosen = ("--attitude", "XKQ[0]", "--time-offset", -0.25, "--max-gap", 0.5, "--interpolation", "spline")
    done("export", "-o", tmp_path / "one", "--config", "chosen.toml", *chosen, "--start", 30, "--frames", 1)

    words = shlex.split(manifest_of(tmp_path / "one")["command"])
    words[2] = str(asset("adelaide.BIN"))
    done(*words[1:], "-o", tmp_path / "other")

    assert_same(tmp_path / "one", tmp_path / "other")
    assert manifest_of(tmp_path / "other")["flight"]["attitude"] == "XKQ lane 0, 100.0 Hz, between samples by a spline"


@pytest.mark.parametrize("log", REAL_LOGS, ids=lambda log: log.name)
def test_every_real_log_becomes_frames_by_one_command(log: Path, inputs: SimpleNamespace, tmp_path: Path) -> None:
    words = ["export", log, "--config", inputs.config, "-o", tmp_path / "frames", "--start", 3, "--frames", 1]
    if log.name.startswith("copter"):  # without GPS
        assert "--utc-start" in refused(*words)
        words += ["--utc-start", "2017-03-01T20:00:00Z", "--lat", 47.4, "--lon", 8.5]

    done(*words)

    assert manifest_of(tmp_path / "frames")["frames"] == 1
    assert (tmp_path / "frames" / "frame_000000.png").stat().st_size > 1000


def test_two_exports_cannot_write_one_directory_at_the_same_time(tmp_path: Path) -> None:
    fcntl = pytest.importorskip("fcntl")
    directory = tmp_path / "frames"
    words = ("export", "-o", directory, "--frames", 1)
    assert invoke(*words).rc == 0
    before = {path.name: path.read_bytes() for path in directory.iterdir()}
    handle = os.open(directory, os.O_RDONLY)
    try:
        fcntl.flock(handle, fcntl.LOCK_EX)
        result = invoke(*words, "--force")
    finally:
        os.close(handle)
    assert result.rc == 1
    assert "another glstar is writing here" in result.err
    assert {path.name: path.read_bytes() for path in directory.iterdir()} == before
    assert invoke(*words).rc == 0


def test_a_damaged_line_of_truth_is_written_again(tmp_path: Path) -> None:
    directory = tmp_path / "frames"
    words = ("export", "-o", directory, "--frames", 3)
    assert invoke(*words).rc == 0
    truth = directory / "truth.jsonl"
    whole = truth.read_bytes()
    lines = whole.splitlines(keepends=True)
    truth.write_bytes(lines[0] + lines[1][:200] + lines[1][500:] + lines[2])
    result = invoke(*words, "--json")
    assert json.loads(result.out)["drawn"] == 1
    assert truth.read_bytes() == whole


def test_an_exposure_as_long_as_the_flight_fits_despite_rounding_of_its_clock(tmp_path: Path) -> None:
    rows = ["utc_s,roll_deg,pitch_deg,yaw_deg,latitude_deg,longitude_deg"]
    rows += [f"{FIRST_UTC_S + 0.002 + k / 100:.3f},0,0,{k / 10},-34.93,138.60" for k in range(71)]
    flight = tmp_path / "short.csv"
    flight.write_text("\n".join(rows) + "\n", encoding="utf-8")
    assert invoke("export", flight, "-o", tmp_path / "frames", "--exposure", 0.7).rc == 0


def test_few_frames_at_a_very_short_interval_are_allowed(tmp_path: Path) -> None:
    result = invoke("export", "-o", tmp_path / "frames", "--every", 1e-6, "--frames", 2)
    assert result.rc == 0
