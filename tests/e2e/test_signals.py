"""Signals that end a command as a process: what it leaves, its exit status, and how the rest is used."""

import json
import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

import glstar as gs
from glstar.config import Config
from glstar.export.directory import directory_lock
from glstar.system.resources import asset
from tests.support.exports import SETTINGS, assert_same, done, invoke, table_of_a_flight
from tests.support.links import free_port, has_frames, playing, until

pytestmark = [pytest.mark.slow, pytest.mark.skipif(os.name == "nt", reason="sends POSIX signals")]
# Of any three frames of the bundled flight one has a star that `compare` can pair; with 64 x 48 px, 9 % have none.
SMALL = "[camera]\nwidth_px = 128\nheight_px = 96\nfx_px = 120.0\nfy_px = 120.0\n"


@pytest.fixture(scope="module")
def vehicle(tmp_path_factory: pytest.TempPathFactory) -> Iterator[list[str]]:
    """Play a flight; return the flags of a live export of it: a frame each 0.2 s, without the directory."""
    config = tmp_path_factory.mktemp("config") / "small.toml"
    config.write_text(SMALL, encoding="utf-8")
    port = free_port()
    with playing(Config().open_flight(asset("adelaide.BIN")), f"udpout:127.0.0.1:{port}", rate_hz=50, loop=True):
        more = ["--every", "0.2", "--exposure", "0.1", "--config", str(config), "--export"]
        yield [f"udpin:127.0.0.1:{port}", *more]


def wait_until(true: Callable[[], object], what: str) -> None:
    until(true, what, patience_s=120.0)


@contextmanager
def started(*words: object, **options: object) -> Iterator[subprocess.Popen[str]]:
    command = [sys.executable, "-m", "glstar", *map(str, words)]
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
    with subprocess.Popen(command, **(pipes | options)) as process:  # type: ignore[call-overload]
        try:
            yield process
        finally:
            process.kill()


def killed(vehicle: list[str], directory: Path) -> Path:
    """Return the directory of a live export that was killed after four frames."""
    with started("live", *vehicle, directory) as process:
        wait_until(lambda: has_frames(directory, 4), "frames")
        process.kill()
    return directory


@pytest.fixture(scope="module")
def unfinished(vehicle: list[str], tmp_path_factory: pytest.TempPathFactory) -> Path:
    return killed(vehicle, tmp_path_factory.mktemp("killed") / "frames")


def frames_of(directory: Path) -> list[int]:
    return [frame["frame"] for frame in gs.read_truth(directory)]


# --- the end of a command ---------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("number", "times"), [(signal.SIGTERM, 1), (signal.SIGHUP, 2), (signal.SIGINT, 1)])
def test_a_live_export_is_complete_after_each_signal(
    number: signal.Signals, times: int, vehicle: list[str], tmp_path: Path
) -> None:
    directory = tmp_path / "frames"
    with started("live", *vehicle, directory) as process:
        wait_until(lambda: has_frames(directory, 3), "frames")
        for _ in range(times):
            process.send_signal(number)
            time.sleep(0.02)
        out, err = process.communicate(timeout=60)

    assert process.returncode == 0, err
    assert "frames drawn" in out
    assert "Traceback" not in err
    assert not list(directory.glob("*.partial"))
    assert not list(directory.glob(".glstar*"))
    frames = frames_of(directory)
    assert len(frames) >= 3
    assert json.loads((directory / "manifest.json").read_text())["frames"] == len(frames)
    assert len(list(directory.glob("frame_*.png"))) == len(frames)


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGKILL])
def test_a_live_export_that_ended_before_its_first_frame_can_be_started_again(
    number: signal.Signals, vehicle: list[str], tmp_path: Path
) -> None:
    directory = tmp_path / "frames"
    nobody = [f"udpin:127.0.0.1:{free_port()}", *vehicle[1:]]
    with started("live", *nobody, directory) as process:
        wait_until((directory / "truth.jsonl.partial").exists, "a directory")
        process.send_signal(number)
        process.communicate(timeout=60)
    left = {path.name for path in directory.iterdir()}
    assert left <= {"manifest.json", "truth.jsonl", "truth.jsonl.partial"}

    result = invoke("live", *vehicle, directory, "--duration", 6)

    assert result.rc == 0, result.err
    assert frames_of(directory)


def test_a_foreign_manifest_is_no_leftover(vehicle: list[str], tmp_path: Path) -> None:
    (tmp_path / "manifest.json").write_text('{"name": "web"}')

    for words in (
        ["live", *vehicle, str(tmp_path), "--duration", "1"],
        ["export", asset("adelaide.BIN"), "-o", tmp_path],
    ):
        result = invoke(*words)
        assert result.rc == 1
    assert (tmp_path / "manifest.json").read_text() == '{"name": "web"}'


@pytest.mark.parametrize(("number", "status", "workers"), [(signal.SIGTERM, 143, 1), (signal.SIGHUP, 129, 2)])
def test_an_export_ends_with_the_status_of_the_signal_and_is_continued(
    number: signal.Signals, status: int, workers: int, flight: SimpleNamespace, tmp_path: Path
) -> None:
    directory = tmp_path / "frames"
    with started(*flight.words, directory, "--workers", workers, start_new_session=True) as process:
        wait_until(lambda: any(directory.glob("frame_*.png")), "frames")
        os.killpg(process.pid, number)
        _, err = process.communicate(timeout=60)

    assert process.returncode == status, err
    assert err.splitlines()[-1] == "glstar: stopped; run the same command again to go on"
    assert "Traceback" not in err
    done(*flight.words, directory, "--workers", 1)
    assert_same(directory, flight.whole)


@pytest.fixture(scope="module")
def flight(tmp_path_factory: pytest.TempPathFactory) -> SimpleNamespace:
    folder = tmp_path_factory.mktemp("flight")
    (folder / "flight.csv").write_text(table_of_a_flight(), encoding="utf-8")
    (folder / "small.toml").write_text(SETTINGS, encoding="utf-8")
    words = (
        "export",
        folder / "flight.csv",
        "--config",
        folder / "small.toml",
        "--exposure",
        0.1,
        "--every",
        0.2,
        "-o",
    )
    done(*words, folder / "whole")
    return SimpleNamespace(words=words, whole=folder / "whole")


def test_an_export_that_was_stopped_before_its_first_frame_binds_to_no_settings(
    flight: SimpleNamespace, tmp_path: Path
) -> None:
    shutil.copy(flight.whole / "manifest.json", tmp_path)
    (tmp_path / "truth.jsonl.partial").touch()
    (tmp_path / ".glstar-writing-01234567-frame_000000.png").write_bytes(b"half")

    done(*flight.words, tmp_path, "--frames", 1, "--seed", 9)

    assert frames_of(tmp_path) == [0]
    assert json.loads((tmp_path / "manifest.json").read_text())["seed"] == 9
    assert not list(tmp_path.glob(".glstar*"))


def test_nohup_keeps_a_command(vehicle: list[str], tmp_path: Path) -> None:
    directory = tmp_path / "frames"
    ignoring = {"preexec_fn": lambda: signal.signal(signal.SIGHUP, signal.SIG_IGN)}
    with started("live", *vehicle, directory, **ignoring) as process:
        wait_until(lambda: has_frames(directory, 1), "frames")
        process.send_signal(signal.SIGHUP)
        before = (directory / "truth.jsonl.partial").read_bytes().count(b"\n")
        wait_until(lambda: has_frames(directory, before + 2), "more frames")
        process.send_signal(signal.SIGTERM)
        assert process.wait(60) == 0


def test_a_closed_terminal_completes_a_live_export(vehicle: list[str], tmp_path: Path) -> None:
    directory = tmp_path / "frames"
    ours, theirs = os.openpty()
    with started(
        "live", *vehicle, directory, stdin=theirs, stdout=theirs, stderr=theirs, start_new_session=True
    ) as process:
        os.close(theirs)
        wait_until(lambda: has_frames(directory, 2), "frames")
        os.close(ours)
        process.send_signal(signal.SIGHUP)
        assert process.wait(60) == 0
    assert len(frames_of(directory)) >= 2


# --- what a killed one leaves -----------------------------------------------------------------------------------------


def test_the_frames_of_a_killed_export_are_read_with_a_warning(unfinished: Path) -> None:
    with pytest.warns(UserWarning, match=r"not finished; .*--recover"):
        frames = frames_of(unfinished)

    assert len(frames) >= 4
    assert frames == sorted(frames)
    with pytest.warns(UserWarning, match="not finished"):
        assert frames_of(unfinished / "truth.jsonl.partial") == frames


def test_commands_take_a_killed_export_with_a_note(unfinished: Path, tmp_path: Path) -> None:
    (tmp_path / "answers.jsonl").write_text('{"frame": 0, "latitude_deg": -34.9, "longitude_deg": 138.6}\n')
    commands = [
        ("convert", unfinished, "--to", "csv", "-o", tmp_path / "csv"),
        ("convert", unfinished, "--to", "coco", "-o", tmp_path / "labels.json"),
        ("score", unfinished, tmp_path / "answers.jsonl"),
        ("compare", unfinished, "--against", unfinished, "-o", tmp_path / "compared"),
    ]
    for words in commands:
        result = invoke(*words)
        assert result.rc == 0, result.err
        notes = [line for line in result.err.splitlines() if "not finished" in line]
        assert len(notes) >= 1
        assert notes[0].startswith(f"glstar: {unfinished}: the export was not finished;")
        assert len(set(notes)) == len(notes)


def test_a_killed_export_is_recovered(unfinished: Path, vehicle: list[str], tmp_path: Path) -> None:
    directory = Path(shutil.copytree(unfinished, tmp_path / "frames"))
    with (directory / "truth.jsonl.partial").open("ab") as truth:
        truth.write(b'{"schema":"glstar-truth-2","fra')
    (directory / ".glstar-writing-00000000-frame_000099.png").write_bytes(b"half")
    with pytest.warns(UserWarning, match="not finished"):
        frames = frames_of(directory)
    (directory / f"frame_{frames[1]:06d}.png").unlink()

    assert "holds frames already (glstar export --recover" in invoke("live", *vehicle, directory).err
    result = invoke("export", "--recover", directory)

    assert result.rc == 0, result.err
    assert result.out == f"{len(frames) - 1} frames are complete: {directory}\n"
    assert f"frame_{frames[1]:06d}.png is missing or damaged" in result.err
    assert frames_of(directory) == np.setdiff1d(frames, frames[1]).tolist()
    assert json.loads((directory / "manifest.json").read_text())["frames"] == len(frames) - 1
    assert {path.suffix for path in directory.iterdir()} == {".png", ".json", ".jsonl"}

    before = {path.name: path.read_bytes() for path in directory.iterdir()}
    assert invoke("export", "--recover", directory).rc == 0  # again
    assert {path.name: path.read_bytes() for path in directory.iterdir()} == before


def test_only_an_export_that_nobody_writes_is_recovered(unfinished: Path, tmp_path: Path) -> None:
    with directory_lock(unfinished):
        result = invoke("export", "--recover", unfinished)
    assert (result.rc, "another glstar is writing here" in result.err) == (1, True)
    assert "has no finished frame" in invoke("export", "--recover", tmp_path).err
    assert "is no directory" in invoke("export", "--recover", tmp_path / "absent").err


@pytest.mark.parametrize("format_", ["tiff", "fits"])
def test_an_export_of_two_workers_that_was_killed_is_recovered_and_continued(
    format_: str, flight: SimpleNamespace, tmp_path: Path
) -> None:
    directory = tmp_path / "frames"
    words = (*flight.words, directory, "--format", format_)
    with started(*words, "--workers", 2, start_new_session=True) as process:
        wait_until(lambda: sum(1 for _ in directory.glob("frame_*")) > 8, "frames")
        os.killpg(process.pid, signal.SIGKILL)
        process.wait(60)

    result = invoke("export", "--recover", directory)
    assert result.rc == 0, result.err
    count = len(frames_of(directory))
    assert result.out == f"{count} frames are complete: {directory}\n"
    assert count > 0
    done(*words, "--workers", 1)
    done(*words[:-2], "--format", format_, "--verify")
    assert len(frames_of(directory)) == len(frames_of(flight.whole))
