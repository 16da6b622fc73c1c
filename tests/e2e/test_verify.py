"""``glstar export --verify``: findings in a directory of frames."""

import json
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from glstar.export.imagefiles.formats import decode, encode
from tests.support.exports import SETTINGS, assert_same, contents, done, invoke, refused, table_of_a_flight

COUNT = 6


@pytest.fixture(scope="module")
def words(tmp_path_factory: pytest.TempPathFactory) -> tuple[object, ...]:
    folder = tmp_path_factory.mktemp("inputs")
    (folder / "flight.csv").write_text(table_of_a_flight(), encoding="utf-8")
    (folder / "small.toml").write_text(SETTINGS, encoding="utf-8")
    return "export", folder / "flight.csv", "--config", folder / "small.toml", "--frames", COUNT


@pytest.fixture(scope="module")
def whole(words: tuple[object, ...], tmp_path_factory: pytest.TempPathFactory) -> Path:
    directory = tmp_path_factory.mktemp("whole") / "frames"
    done(*words, "-o", directory)
    return directory


@pytest.fixture
def frames(whole: Path, tmp_path: Path) -> Path:
    directory = tmp_path / "frames"
    directory.mkdir()
    for name, content in contents(whole).items():
        (directory / name).write_bytes(content)
    return directory


def found(*words: object, wrong: bool = True) -> SimpleNamespace:
    """Verify; return the findings by file, and the rest of the output."""
    result = invoke(*words, "--verify")
    assert result.rc == (1 if wrong else 0), result.err
    return SimpleNamespace(lines=result.out.splitlines(), err=result.err)


def damaged_in_the_middle(path: Path) -> None:
    content = bytearray(path.read_bytes())
    content[len(content) // 2] ^= 1
    path.write_bytes(content)


def with_one_pixel_brighter(path: Path) -> None:
    pixels = decode(path.read_bytes(), path.suffix).copy()
    pixels[3, 4] += 7
    path.write_bytes(encode(pixels, "png"))


@pytest.mark.parametrize("more", [(), ("--workers", 2)])
def test_a_complete_directory_has_no_findings(
    more: tuple[object, ...], words: tuple[object, ...], frames: Path
) -> None:
    before = contents(frames)

    said = found(*words, "-o", frames, *more, wrong=False)

    assert said.lines[0].startswith(f"{COUNT} frames verified in ")
    assert said.lines[0].endswith(f"byte for byte: {frames}")
    assert said.err == ""
    assert contents(frames) == before


@pytest.mark.parametrize("more", [(), ("--workers", 2)])
def test_damage_is_reported_frame_by_frame_and_repaired_by_removing_the_files(
    more: tuple[object, ...], words: tuple[object, ...], whole: Path, frames: Path
) -> None:
    names = [f"frame_{number:06d}.png" for number in range(COUNT)]
    (frames / names[0]).write_bytes(b"")
    (frames / names[1]).write_bytes((frames / names[1]).read_bytes()[:1000])
    damaged_in_the_middle(frames / names[2])
    with_one_pixel_brighter(frames / names[3])
    (frames / names[4]).unlink()
    (frames / "frame_000099.png").write_bytes((frames / names[5]).read_bytes())
    (frames / ".glstar-writing-1234-frame_000005.png").write_bytes(b"half")

    said = found(*words, "-o", frames, *more)

    assert said.lines == [
        f"{names[0]}: is empty (0 bytes)",
        f"{names[1]}: is cut short or damaged: no IEND at the end of its 1000 bytes",
        f"{names[2]}: is damaged: a wrong checksum in its chunk at byte 33",
        f"{names[3]}: 1 of 19200 pixels differ from what is drawn, by 7 DN at most",
        f"{names[4]}: is missing",
        ".glstar-writing-1234-frame_000005.png: is left of a run that was cut off; the next run removes it",
        "frame_000099.png: belongs to no frame of this export",
    ]
    assert "7 files are wrong; remove them and run the same command without --verify" in said.err
    for line in said.lines:
        (frames / line.partition(":")[0]).unlink(missing_ok=True)
    done(*words, "-o", frames)
    assert_same(frames, whole)


def test_a_tiff_whose_pixels_are_zeros_has_its_structure_and_is_found(
    words: tuple[object, ...], tmp_path: Path
) -> None:
    asked = (*words, "--format", "tiff", "--light", "-o", tmp_path / "frames")
    done(*asked)
    for name in ("frame_000001.tiff", "frame_000002.light.tiff"):
        path = tmp_path / "frames" / name
        content = path.read_bytes()
        path.write_bytes(content[:2000] + bytes(len(content) - 2000))

    first, second = found(*asked).lines

    assert first.startswith("frame_000001.tiff: ")
    assert "pixels differ from what is drawn" in first
    assert second.startswith("frame_000002.light.tiff: ")


def test_a_missing_damaged_or_different_line_of_truth_is_reported(words: tuple[object, ...], frames: Path) -> None:
    truth = frames / "truth.jsonl"
    lines = truth.read_bytes().splitlines(keepends=True)
    other = lines[2].replace(b'"duration_s":0.5', b'"duration_s":0.25')
    assert other != lines[2]
    truth.write_bytes(b"".join([lines[0], lines[1][:50] + b"\n", other, *lines[3:5]]))

    said = found(*words, "-o", frames)

    assert said.lines == [
        "truth.jsonl: frame 1 has no complete line",
        "truth.jsonl: the line of frame 2 differs from what is drawn, in duration_s",
        "truth.jsonl: frame 5 has no complete line",
    ]


def test_lines_of_truth_in_another_order_are_reported(words: tuple[object, ...], frames: Path) -> None:
    truth = frames / "truth.jsonl"
    lines = truth.read_bytes().splitlines(keepends=True)
    truth.write_bytes(b"".join(reversed(lines)))

    [line] = found(*words, "-o", frames).lines

    assert line.startswith("truth.jsonl: has damaged lines, lines twice or in another order")


def test_an_unfinished_export_is_reported(words: tuple[object, ...], frames: Path) -> None:
    (frames / "truth.jsonl").rename(frames / "truth.jsonl.partial")

    assert found(*words, "-o", frames).lines == [
        "truth.jsonl: is missing: the export has not ended",
        "truth.jsonl.partial: is left of a run that was cut off; the next run removes it",
    ]


def test_one_shard_can_be_verified(words: tuple[object, ...], tmp_path: Path) -> None:
    done(*words, "-o", tmp_path, "--shard", "2/3")

    assert found(*words, "-o", tmp_path, "--shard", "2/3", wrong=False).lines[0].startswith("2 frames verified")
    assert found(*words, "-o", tmp_path, "--shard", "1/3").lines[0] == "frame_000000.png: is missing"


def test_frames_of_another_driver_are_decoded_and_compared_with_the_truth(
    words: tuple[object, ...], frames: Path
) -> None:
    manifest = json.loads((frames / "manifest.json").read_text(encoding="utf-8"))
    there = json.dumps(manifest | {"renderer": "a GPU elsewhere"}, indent=2, sort_keys=True) + "\n"
    (frames / "manifest.json").write_text(there, encoding="utf-8")
    with_one_pixel_brighter(frames / "frame_000001.png")  # unknown without drawing

    said = found(*words, "-o", frames, wrong=False)

    assert "were drawn by a GPU elsewhere" in said.err
    assert said.lines[0].endswith(f"decoded, and of the size in the truth: {frames}")
    damaged_in_the_middle(frames / "frame_000002.png")
    (frames / "frame_000003.png").write_bytes(encode(np.zeros((30, 40), np.uint8), "png"))
    assert found(*words, "-o", frames).lines == [
        "frame_000002.png: is damaged: a wrong checksum in its chunk at byte 33",
        "frame_000003.png: is 40 x 30 px of uint8, and its line of truth says 160 x 120 px",
    ]


def test_findings_can_be_reported_as_json(words: tuple[object, ...], frames: Path) -> None:
    (frames / "frame_000003.png").write_bytes(b"")

    result = invoke(*words, "-o", frames, "--verify", "--json")

    assert result.rc == 1
    report = json.loads(result.out)
    assert report["findings"] == [{"file": "frame_000003.png", "problem": "is empty (0 bytes)", "frame": 3}]
    assert (report["frames"], report["drawn_again"]) == (COUNT, True)


def test_a_directory_that_cannot_be_verified_is_refused_in_one_line(words: tuple[object, ...], frames: Path) -> None:
    assert "nothing to verify" in refused(*words, "-o", frames / "none", "--verify")
    assert not (frames / "none").exists()
    assert "made otherwise" in refused(*words, "-o", frames, "--seed", 3, "--verify")
    assert invoke(*words, "-o", frames, "--verify", "--force").rc == 2
