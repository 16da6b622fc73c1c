"""Files that survive a power failure: what is flushed, when, and in which order."""

import errno
import os
import threading
import time
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from glstar.export.frame import FrameWriter
from glstar.export.truth.lines import TruthFile
from glstar.link import Recorder
from glstar.system import files as durable
from glstar.system.files import TEMPORARY, StagedFile, flush, make_directory, write_atomically


@pytest.fixture
def flushed(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """The names of the files and directories that are flushed, in order."""
    names: list[str] = []
    real = os.fsync

    def fsync(handle: int) -> None:
        names.append(Path(f"/proc/self/fd/{handle}").readlink().name)
        real(handle)

    if not Path("/proc/self/fd").exists():
        pytest.skip("names of descriptors take Linux")
    monkeypatch.setattr(os, "fsync", fsync)
    return names


def temporaries(directory: Path) -> list[str]:
    return [path.name for path in directory.iterdir() if path.name.startswith(TEMPORARY)]


# --- whole files ------------------------------------------------------------------------------------------------------


def test_a_file_is_flushed_under_its_temporary_name_and_its_directory_afterwards(
    tmp_path: Path, flushed: list[str]
) -> None:
    write_atomically(tmp_path / "a.toml", b"content")

    first, second = flushed
    assert first.startswith(TEMPORARY)
    assert first.endswith("-a.toml")
    assert second == tmp_path.name
    assert (tmp_path / "a.toml").read_bytes() == b"content"
    assert temporaries(tmp_path) == []


def test_a_file_that_cannot_be_flushed_keeps_its_old_content(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "a.toml").write_bytes(b"before")

    def fsync(handle: int) -> None:
        raise OSError(errno.EIO, os.strerror(errno.EIO))

    monkeypatch.setattr(os, "fsync", fsync)
    with pytest.raises(OSError, match="Input/output"):
        write_atomically(tmp_path / "a.toml", b"after")

    assert (tmp_path / "a.toml").read_bytes() == b"before"
    assert temporaries(tmp_path) == []


@pytest.mark.parametrize("number", [errno.EINVAL, errno.ENOTSUP, errno.ENOSYS])
def test_a_file_system_without_flush_can_be_written(
    number: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fsync(handle: int) -> None:
        raise OSError(number, os.strerror(number))

    monkeypatch.setattr(os, "fsync", fsync)

    write_atomically(tmp_path / "a.toml", b"content")

    assert (tmp_path / "a.toml").read_bytes() == b"content"


def test_the_parent_of_each_new_directory_is_flushed(tmp_path: Path, flushed: list[str]) -> None:
    make_directory(tmp_path / "a" / "b" / "c")
    make_directory(tmp_path / "a" / "b")

    assert sorted(flushed) == sorted([tmp_path.name, "a", "b"])


def test_the_drive_cache_of_a_mac_is_flushed_once_for_all_files(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    emptied: list[int] = []
    flushed: list[int] = []
    fcntl = SimpleNamespace(F_FULLFSYNC=51, fcntl=lambda handle, what: emptied.append(what))
    monkeypatch.setattr(durable, "fcntl", fcntl, raising=False)
    monkeypatch.setattr(durable.sys, "platform", "darwin")
    monkeypatch.setattr(os, "fsync", flushed.append)
    for name in "abc":
        (tmp_path / name).write_bytes(b"content")

    flush([tmp_path / name for name in "abc"])

    assert (len(flushed), emptied) == (3, [51])


# --- frames -----------------------------------------------------------------------------------------------------------


def test_a_line_of_truth_follows_the_flush_and_the_name_of_its_image(tmp_path: Path, flushed: list[str]) -> None:
    truth = TruthFile(tmp_path)
    partial = tmp_path / "truth.jsonl.partial"
    with truth.open_for_append() as lines, FrameWriter(truth, lines) as writer:
        for number in range(8):
            writer.stage(number, tmp_path / f"frame_{number:06d}.png", b"content")
            assert not list(tmp_path.glob("frame_*"))
            assert list(writer.add(number, b"%d\n" % number)) == []
        seen = []
        for number in writer.drain():
            seen.append(number)
            assert (tmp_path / f"frame_{number:06d}.png").exists()
            assert len(partial.read_bytes().splitlines()) == len(seen)
            assert len([name for name in flushed if name.endswith(".png")]) == 8

    assert seen == list(range(8))
    assert temporaries(tmp_path) == []


def test_the_next_flush_makes_names_and_lines_durable(tmp_path: Path, flushed: list[str]) -> None:
    truth = TruthFile(tmp_path)
    with truth.open_for_append() as lines, FrameWriter(truth, lines, group_s=0.0) as writer:
        for number in range(2):
            writer.stage(number, tmp_path / f"{number}.png", b"content")
            list(writer.add(number, b"%d\n" % number))
            list(writer.drain())

    names = [name.rpartition("-")[2] for name in flushed]
    assert names[:2] == ["0.png", "1.png"]
    assert sorted(names[2:]) == sorted(["truth.jsonl.partial", tmp_path.name])


def test_drawing_waits_for_a_flush_only_when_many_frames_are_pending(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    may_flush = threading.Event()
    monkeypatch.setattr(os, "fsync", lambda _: may_flush.wait(10))
    truth = TruthFile(tmp_path)
    with truth.open_for_append() as lines, FrameWriter(truth, lines) as writer:
        done: list[int] = []
        for number in range(71):
            writer.stage(number, tmp_path / f"{number}.png", b"content")
            done += writer.add(number, b"%d\n" % number)
        assert done == []
        assert not list(tmp_path.glob("[0-9]*.png"))
        may_flush.set()
        done += writer.drain()

    assert done == list(range(71))


@pytest.mark.parametrize("failing", ["flush", "rename"])
def test_frames_that_cannot_be_finished_leave_no_temporary_file(
    failing: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(*_: object) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    def write() -> None:
        truth = TruthFile(tmp_path)
        with truth.open_for_append() as lines, FrameWriter(truth, lines) as writer:
            for number in range(3):
                writer.stage(number, tmp_path / f"{number}.png", b"content")
                list(writer.add(number, b"%d\n" % number))
            if failing == "flush":
                monkeypatch.setattr(os, "fsync", fail)
            else:
                monkeypatch.setattr(StagedFile, "rename", fail)

    with pytest.raises(OSError, match="No space"):
        write()

    assert temporaries(tmp_path) == []
    assert (tmp_path / "truth.jsonl.partial").read_bytes() == b""
    assert not [thread for thread in threading.enumerate() if thread.name.startswith("glstar-flush")]


def test_no_frame_is_renamed_after_the_write_permission_ends(tmp_path: Path) -> None:
    def revoked() -> None:
        raise PermissionError("another run has begun here")

    def write() -> None:
        truth = TruthFile(tmp_path)
        with truth.open_for_append() as lines, FrameWriter(truth, lines, writing=revoked) as writer:
            writer.stage(0, tmp_path / "0.png", b"content")
            list(writer.add(0, b"0\n"))

    with pytest.raises(PermissionError):
        write()

    assert [path.name for path in tmp_path.iterdir()] == ["truth.jsonl.partial"]


def test_joining_the_truth_on_a_full_disk_leaves_no_temporary_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    truth = TruthFile(tmp_path)
    for first in (0, 1):
        with truth.open_for_append(as_part=True) as lines:
            for number in range(first, 6, 2):
                truth.append(lines, number, b'{"frame":%d}\n' % number)

    def copy_half(source: object, target: object, length: int) -> None:
        target.write(b"half")
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    with monkeypatch.context() as full:
        full.setattr("glstar.export.truth.lines._copy", copy_half)
        with pytest.raises(OSError, match="No space"):
            truth.finish(np.arange(6))

    assert temporaries(tmp_path) == []
    assert len(list(tmp_path.glob("truth.jsonl.part-*"))) == 2, "the parts are still there"
    truth.finish(np.arange(6))
    assert (tmp_path / "truth.jsonl").read_bytes() == b"".join(b'{"frame":%d}\n' % number for number in range(6))


# --- recordings -------------------------------------------------------------------------------------------------------


def until(condition: object) -> None:
    until_s = time.monotonic() + 20
    while not condition():
        assert time.monotonic() < until_s
        time.sleep(0.002)


def test_a_recording_is_flushed_while_packets_arrive_and_at_its_end(tmp_path: Path, flushed: list[str]) -> None:
    with Recorder(tmp_path / "flight.tlog", flush_every_s=0.01) as recorder:
        recorder.write([SimpleNamespace(content=b"packet")])
        until(lambda: "flight.tlog" in flushed)
        before = len(flushed)
        time.sleep(0.05)
        assert len(flushed) == before, "nothing new came"
        recorder.write([SimpleNamespace(content=b"another")])
        until(lambda: len(flushed) > before)
        before = len(flushed)

    assert len(flushed) == before + 1
    assert flushed[0] == tmp_path.name, "its name is on the disk"


def test_packets_are_recorded_while_a_slow_disk_flushes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    flushes, may_end = threading.Event(), threading.Event()

    def fsync(handle: int) -> None:
        flushes.set()
        may_end.wait(20)

    monkeypatch.setattr(os, "fsync", fsync)
    with Recorder(tmp_path / "flight.tlog", flush_every_s=0.01) as recorder:
        recorder.write([SimpleNamespace(content=b"packet")])
        assert flushes.wait(20)
        for _ in range(100):
            recorder.write([SimpleNamespace(content=b"packet")])
        assert recorder.bytes == 101 * (8 + len(b"packet"))
        assert not may_end.is_set()
        may_end.set()

    assert (tmp_path / "flight.tlog").stat().st_size == recorder.bytes


@pytest.mark.parametrize("failures", [2, 9])
def test_on_windows_a_file_that_another_program_has_open_is_replaced_after_a_wait(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, failures: int
) -> None:
    # Windows refuses to replace an open file; the waits are those of Windows, the refusal is simulated.
    monkeypatch.setattr(durable, "_PAUSES_S", (0.001, 0.001, 0.001, 0.001))
    real, refused = Path.replace, []

    def replace(own: Path, target: Path) -> Path:
        if len(refused) < failures:
            refused.append(own)
            raise PermissionError(errno.EACCES, "The process cannot access the file")
        return real(own, target)

    monkeypatch.setattr(Path, "replace", replace)

    if failures == 2:
        write_atomically(tmp_path / "frame.png", b"new")
        assert (tmp_path / "frame.png").read_bytes() == b"new"
    else:
        with pytest.raises(PermissionError):
            write_atomically(tmp_path / "frame.png", b"new")
        assert list(tmp_path.iterdir()) == []
