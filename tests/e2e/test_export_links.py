"""Links inside the output directory: nothing is written or removed outside of it."""

import os
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from glstar.errors import ExportError
from glstar.export.directory import open_to_append, output_files
from glstar.export.publish.latest import LatestFrameWriter
from tests.support.exports import SETTINGS, assert_same, contents, done, invoke, refused, table_of_a_flight

VALUABLE = b"the only copy"


@pytest.fixture(scope="module")
def words(tmp_path_factory: pytest.TempPathFactory) -> tuple[object, ...]:
    folder = tmp_path_factory.mktemp("inputs")
    (folder / "flight.csv").write_text(table_of_a_flight(), encoding="utf-8")
    (folder / "small.toml").write_text(SETTINGS, encoding="utf-8")
    return "export", folder / "flight.csv", "--config", folder / "small.toml", "--frames", 3, "-o"


@pytest.fixture(scope="module")
def three(words: tuple[object, ...], tmp_path_factory: pytest.TempPathFactory) -> Path:
    directory = tmp_path_factory.mktemp("three") / "frames"
    done(*words, directory)
    return directory


@pytest.fixture
def place(tmp_path: Path) -> SimpleNamespace:
    """An output directory, and a file and a folder outside that must stay."""
    made = SimpleNamespace(output=tmp_path / "output", file=tmp_path / "valuable", folder=tmp_path / "elsewhere")
    made.output.mkdir()
    made.folder.mkdir()
    made.file.write_bytes(VALUABLE)
    (made.folder / "frame_010000.png").write_bytes(VALUABLE)
    return made


def assert_nothing_outside_was_touched(place: SimpleNamespace) -> None:
    assert place.file.read_bytes() == VALUABLE
    assert contents(place.folder) == {"frame_010000.png": VALUABLE}


@pytest.mark.parametrize("name", ["truth.jsonl.partial", "truth.jsonl", "manifest.json", "frame_000001.png"])
@pytest.mark.parametrize("target", ["file", "nowhere"])
def test_a_symbolic_link_with_the_name_of_a_file_is_refused_and_removed_by_force(
    name: str, target: str, words: tuple[object, ...], three: Path, place: SimpleNamespace
) -> None:
    aim = place.file if target == "file" else place.file.with_name("nowhere")
    (place.output / name).symlink_to(aim)

    assert f"{name}: is a symbolic link" in refused(*words, place.output)
    assert_nothing_outside_was_touched(place)

    done(*words, place.output, "--force")
    assert_nothing_outside_was_touched(place)
    assert not place.file.with_name("nowhere").exists()
    assert_same(place.output, three)


def test_a_folder_of_frames_that_is_a_link_is_refused_and_force_removes_the_link_but_not_its_target(
    words: tuple[object, ...], three: Path, place: SimpleNamespace
) -> None:
    (place.output / "frames_010000").symlink_to(place.folder, target_is_directory=True)

    assert "frames_010000: is a symbolic link" in refused(*words, place.output)
    assert [path.name for path in output_files(place.output)] == ["frames_010000"]

    done(*words, place.output, "--force")
    assert_nothing_outside_was_touched(place)
    assert_same(place.output, three)


def test_no_frame_is_written_into_a_folder_that_is_replaced_by_a_link(
    words: tuple[object, ...], tmp_path: Path
) -> None:
    (tmp_path / "elsewhere").mkdir()
    config = tmp_path / "many.toml"
    config.write_text(SETTINGS + "[sweep]\ndraws = 10050\nstart_s = { min = 0, max = 9 }\n", encoding="utf-8")
    script = f"""
import os
from glstar.export.run import executors
draw_frames = executors.draw_frames
def planted(*words, **settings):
    os.symlink({str(tmp_path / "elsewhere")!r}, {str(tmp_path / "set" / "frames_010000")!r})
    yield from draw_frames(*words, **settings)
executors.draw_frames = planted
from glstar.cli import main
main()
"""
    asked = [str(words[1]), "--config", str(config), "-o", str(tmp_path / "set"), "--frames", "1"]
    command = [sys.executable, "-c", script, "export", *asked, "--shard", "10050/10050"]

    process = subprocess.run(command, capture_output=True, text=True, timeout=60, check=False)

    assert process.returncode == 1
    assert "frames_010000: is a symbolic link" in process.stderr
    assert list((tmp_path / "elsewhere").iterdir()) == []


def test_another_hard_link_to_the_truth_keeps_its_content(
    words: tuple[object, ...], tmp_path: Path, three: Path
) -> None:
    directory, snapshot = tmp_path / "frames", tmp_path / "snapshot"
    done(*words[:-2], 2, "-o", directory)
    snapshot.mkdir()
    for path in directory.iterdir():  # cp -al
        os.link(path, snapshot / path.name)
    before = contents(snapshot)

    done(*words, directory)

    assert_same(directory, three)
    assert contents(snapshot) == before


def test_the_output_directory_itself_may_be_a_link(words: tuple[object, ...], three: Path, tmp_path: Path) -> None:
    (tmp_path / "disk").mkdir()
    (tmp_path / "frames").symlink_to("disk")

    done(*words, tmp_path / "frames")

    assert_same(tmp_path / "disk", three)


@pytest.mark.timeout(20)
def test_a_pipe_with_the_name_of_a_file_is_refused(words: tuple[object, ...], tmp_path: Path) -> None:
    for name in ("truth.jsonl.partial", "truth.jsonl.part-00.partial", "manifest.json"):
        os.mkfifo(tmp_path / name)
        assert f"{name}: is no regular file" in refused(*words, tmp_path)
        with pytest.raises((ExportError, OSError)):
            open_to_append(tmp_path / name).close()
        (tmp_path / name).unlink()


@pytest.mark.parametrize("option", [("-o", ""), ("--output=",), ("-o", "frames", "--video", ""), ("-o", "x", "-c", "")])
def test_an_empty_path_is_refused(option: tuple[str, ...], tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)

    result = invoke("export", *option)

    assert result.rc == 2
    assert "an empty word after " in result.err
    assert list(tmp_path.iterdir()) == []


def test_the_latest_frame_and_a_video_do_not_write_through_links(
    words: tuple[object, ...], place: SimpleNamespace
) -> None:
    for name in ("latest.bin", "video.mp4"):
        (place.output / f".glstar-writing-{name}").symlink_to(place.file)
        (place.output / name).symlink_to(place.file)

    with LatestFrameWriter(str(place.output / "latest.bin"), 4) as latest:
        latest.write(np.zeros((2, 2), np.uint8), b"{}\n")
    done(*words, place.output.parent / "frames", "--video", place.output / "video.mp4")

    assert_nothing_outside_was_touched(place)
    assert {path.name for path in place.output.iterdir() if not path.is_symlink()} == {"latest.bin", "video.mp4"}
