"""The latest frame, passed from one process to another."""

import json
import os
import signal
import subprocess
import sys
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from multiprocessing.shared_memory import SharedMemory
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from glstar.errors import ConfigError, ExportError
from glstar.export.publish import latest as latestframe
from glstar.export.publish.latest import LatestFrameReader, LatestFrameWriter
from glstar.system import files as filelock
from glstar.system.files import lock_handle


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
@pytest.mark.parametrize("shared", [True, False])
def test_a_written_frame_is_read_once(shared: bool, dtype: type, tmp_path: Path) -> None:
    where = f"shm:glstar-test-{np.dtype(dtype).itemsize}" if shared else str(tmp_path / "latest")
    pixels = np.arange(12, dtype=dtype).reshape(3, 4) * 20
    with LatestFrameReader(where) as reader, LatestFrameWriter(where, pixels.size) as writer:
        assert reader.read() is None
        for number in range(3):
            writer.write(pixels + dtype(number), json.dumps({"frame": number}).encode())
            frame = reader.wait(1.0)
            assert frame is not None
            assert frame.truth == {"frame": number}
            assert frame.pixels.dtype == dtype
            np.testing.assert_array_equal(frame.pixels, pixels + dtype(number))
            assert reader.read() is None


def test_an_incomplete_or_damaged_frame_is_not_read() -> None:
    with LatestFrameWriter("shm:glstar-test-torn", 4) as writer, LatestFrameReader("shm:glstar-test-torn") as reader:
        writer.write(np.zeros((2, 2), dtype=np.uint8), b"{}")
        assert writer._memory is not None
        room = writer._memory.buf
        room[8] ^= 1
        assert reader.read() is None
        room[8] ^= 1
        room[41] ^= 1
        assert reader.read() is None
        room[41] ^= 1
        assert reader.read() is not None


def test_a_reader_finds_a_restarted_writer() -> None:
    with LatestFrameReader("shm:glstar-test-again") as reader:
        for _ in range(2):
            with LatestFrameWriter("shm:glstar-test-again", 4) as writer:
                writer.write(np.zeros((2, 2), dtype=np.uint8), b"{}")
                assert reader.wait(1.0) is not None


def test_an_invalid_name_and_a_frame_that_is_too_large_are_refused(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="shm:NAME"):
        LatestFrameWriter("shm:", 4)
    with LatestFrameWriter("shm:glstar-test-size", 4) as writer, pytest.raises(ExportError, match="does not fit"):
        writer.write(np.zeros((4000, 4000), dtype=np.uint8), b"{}")
    with pytest.raises(ExportError, match="cannot be written"):
        LatestFrameWriter(str(tmp_path / "no" / "latest"), 4).write(np.zeros((2, 2), dtype=np.uint8), b"{}")


def test_a_name_of_shared_memory_is_one_short_word() -> None:
    for name in ("", "glstar/a", "a" * 31):
        with pytest.raises(ConfigError, match=f"shm:{name} is no name of shared memory; write shm:NAME with a short"):
            LatestFrameWriter(f"shm:{name}", 4)
    longest = f"glstar-test-{'a' * 18}"
    assert len(longest) == 30
    with LatestFrameWriter(f"shm:{longest}", 4) as writer:
        assert not writer.needs_nav


def test_memory_is_kept_while_its_name_exists(monkeypatch: pytest.MonkeyPatch) -> None:
    now_s = [100.0]
    monkeypatch.setattr(latestframe.time, "monotonic", lambda: now_s[0])
    opened, original = list[str](), latestframe._opened
    where = "shm:glstar-test-kept"
    with LatestFrameWriter(where, 6) as writer, LatestFrameReader(where) as reader:
        memory = writer._memory
        for value in (3, 5):
            writer.write(np.full((2, 3), value, np.uint8), b"{}")
        assert writer._memory is memory
        monkeypatch.setattr(latestframe, "_opened", lambda name: opened.append(name) or original(name))
        frame = reader.read()
        assert frame is not None
        assert frame.pixels.tolist() == [[5, 5, 5]] * 2
        # A reader opens the name again after 0.2 s without a new frame.
        for now_s[0], times in ((100.19, 1), (100.21, 2), (100.4, 2), (100.42, 3)):
            assert reader.read() is None
            assert opened == ["glstar-test-kept"] * times
        assert memory is not None
        memory.unlink()
        writer.write(np.full((2, 3), 7, np.uint8), b"{}")
        assert writer._memory is not memory


# --- one writer at a time ---------------------------------------------------------------------------------------------

# Writes frames, reports it, and ends at the end of its input or when it is killed.
WRITER = """
import sys, numpy as np
from glstar.export.publish.latest import LatestFrameWriter
with LatestFrameWriter(sys.argv[1], 4) as writer:
    for number in range(3):
        writer.write(np.full((2, 2), 7, dtype=np.uint8), b'{"by": "the first"}')
    print("written", flush=True)
    sys.stdin.read()
"""


@contextmanager
def another_process(where: str) -> Iterator[subprocess.Popen[str]]:
    """Start another process that writes to a name."""
    words = [sys.executable, "-c", WRITER, where]
    with subprocess.Popen(
        words, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    ) as child:
        try:
            assert child.stdout is not None
            assert child.stdout.readline() == "written\n"
            yield child
        finally:
            child.kill()


def write_one(writer: LatestFrameWriter, by: str = "the second") -> None:
    writer.write(np.zeros((2, 2), dtype=np.uint8), json.dumps({"by": by}).encode())


@pytest.fixture(params=["shm", "file"])
def where(request: pytest.FixtureRequest, tmp_path: Path) -> str:
    return f"shm:glstar-test-{os.getpid()}" if request.param == "shm" else str(tmp_path / "latest")


def test_a_second_writer_is_refused_while_the_first_is_alive(where: str) -> None:
    with LatestFrameReader(where) as reader, another_process(where) as child:
        with pytest.raises(ExportError) as refusal:
            LatestFrameWriter(where, 4)
        assert f"(process {child.pid})" in str(refusal.value)
        assert "choose another name" in str(refusal.value)
        frame = reader.wait(5.0)
        assert frame is not None
        assert frame.truth["by"] == "the first"

        # It ends normally, and the name is free.
        _, errors = child.communicate(timeout=20.0)
        assert (child.returncode, errors) == (0, "")
        with LatestFrameWriter(where, 4) as writer:
            write_one(writer)
            frame = reader.wait(5.0)
            assert frame is not None
            assert frame.truth["by"] == "the second"


def test_the_name_of_a_killed_writer_is_taken_over_and_its_readers_follow(where: str) -> None:
    with LatestFrameReader(where) as reader:
        with another_process(where) as child:
            assert reader.wait(5.0) is not None
            child.send_signal(signal.SIGKILL)
            child.wait(20.0)
        with LatestFrameWriter(where, 4) as writer:
            write_one(writer)
            frame = reader.wait(5.0)
            assert frame is not None
            assert frame.truth["by"] == "the second"
            assert reader.read() is None


def test_a_reader_follows_from_memory_whose_name_was_removed_after_a_kill() -> None:
    """Python removes the name of a killed process's memory; a reader that has it open is not notified."""
    name = f"glstar-test-gone-{os.getpid()}"
    with LatestFrameReader(f"shm:{name}") as reader:
        with LatestFrameWriter(f"shm:{name}", 4) as killed:
            write_one(killed, "the killed")
            assert reader.wait(5.0) is not None
            assert killed._memory is not None
            kept = bytes(killed._memory.buf[:100])
            assert reader._memory is not None
            held = reader._memory
        held.buf[:100] = kept  # it could not mark the end
        with LatestFrameWriter(f"shm:{name}", 4) as writer:
            write_one(writer)
            frame = reader.wait(5.0)
            assert frame is not None
            assert frame.truth["by"] == "the second"


def test_a_removed_name_is_created_again_with_the_next_frame() -> None:
    name = f"glstar-test-removed-{os.getpid()}"
    with LatestFrameReader(f"shm:{name}") as old, LatestFrameWriter(f"shm:{name}", 4) as writer:
        write_one(writer, "before")
        assert old.wait(5.0) is not None
        removed = SharedMemory(name)
        removed.close()
        removed.unlink()

        write_one(writer, "after")
        with LatestFrameReader(f"shm:{name}") as new:
            for reader in (old, new):
                frame = reader.wait(5.0)
                assert frame is not None
                assert frame.truth["by"] == "after"


def test_a_second_writer_in_the_same_process_is_refused(where: str) -> None:
    with LatestFrameWriter(where, 4), pytest.raises(ExportError, match=rf"process {os.getpid()}\)"):
        LatestFrameWriter(where, 4)
    with LatestFrameWriter(where, 4):
        pass


def test_a_file_that_a_killed_writer_was_writing_is_removed_by_the_next(tmp_path: Path) -> None:
    (tmp_path / ".glstar-writing-0123abcd-latest").write_bytes(b"half a frame")
    (tmp_path / ".glstar-writing-0123abcd-other").write_bytes(b"of another name")
    with LatestFrameWriter(str(tmp_path / "latest"), 4) as writer:
        write_one(writer)
    assert {path.name for path in tmp_path.iterdir()} == {"latest", ".glstar-writing-0123abcd-other"}


def test_no_lock_is_left_behind(tmp_path: Path) -> None:
    with LatestFrameWriter(str(tmp_path / "latest"), 4) as writer:
        write_one(writer)
    assert [path.name for path in tmp_path.iterdir()] == ["latest"]


def test_a_lock_that_is_removed_during_locking_is_locked_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Its last owner removes it between opening and locking: a lock on a removed file excludes no other writer."""
    where = str(tmp_path / "latest")

    def removed_meanwhile(handle: int) -> bool:
        monkeypatch.setattr(filelock, "lock_handle", lock_handle)
        (tmp_path / ".latest.lock").unlink()
        return lock_handle(handle)

    monkeypatch.setattr(filelock, "lock_handle", removed_meanwhile)
    with LatestFrameWriter(where, 4), pytest.raises(ExportError, match="another glstar"):
        LatestFrameWriter(where, 4)


def test_memory_of_a_dead_writer_is_reused_or_replaced_if_it_is_too_small() -> None:
    name = f"glstar-test-left-{os.getpid()}"
    for left_bytes in (8 * 2**20, 100):
        left = SharedMemory(name, create=True, size=left_bytes)
        left.buf[:8] = b"GLSTARF1"
        left.buf[8:16] = (5).to_bytes(8, "little")  # killed in the middle of a frame
        with LatestFrameReader(f"shm:{name}") as reader:
            assert reader.read() is None
            with LatestFrameWriter(f"shm:{name}", 4) as writer:
                write_one(writer)
                assert reader.wait(5.0) is not None
        left.close()
        with pytest.raises(FileNotFoundError):
            SharedMemory(name)


def test_the_shared_memory_of_another_program_is_refused_and_left_alone() -> None:
    name = f"glstar-test-other-{os.getpid()}"
    other = SharedMemory(name, create=True, size=100)
    try:
        other.buf[:5] = b"other"
        with pytest.raises(ExportError, match="of another program"):
            LatestFrameWriter(f"shm:{name}", 4)
        assert bytes(other.buf[:5]) == b"other"
    finally:
        other.close()
        other.unlink()


# --- as other systems have it -----------------------------------------------------------------------------------------


def test_on_macos_where_shared_memory_has_no_links_a_frame_is_read_once(monkeypatch: pytest.MonkeyPatch) -> None:
    fstat = os.fstat

    def without_links(handle: int) -> os.stat_result:
        found = list(fstat(handle))
        found[3] = 0  # st_nlink
        return os.stat_result(found)

    monkeypatch.setattr(os, "fstat", without_links)
    name = f"shm:glstar-test-mac-{os.getpid()}"
    with LatestFrameWriter(name, 4) as writer, LatestFrameReader(name) as reader:
        for _ in range(3):
            write_one(writer)
            assert reader.read() is not None
            assert [reader.read() for _ in range(5)] == [None] * 5
            # Nor once it has opened the name again.
            reader._fresh_s = 0.0
            assert reader.read() is None


@pytest.fixture
def kept(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Keep shared memory by name as long as a process has it open, as Windows does: unlink does nothing."""
    unlink, close, opened = SharedMemory.unlink, SharedMemory.close, Counter[str]()
    init = SharedMemory.__init__

    def open_(self: SharedMemory, *args: Any, **keys: Any) -> None:
        init(self, *args, **keys)
        opened[self.name] += 1

    def close_(self: SharedMemory) -> None:
        is_open = getattr(self, "_buf", None) is not None
        close(self)
        if is_open:
            opened[self.name] -= 1
            if not opened[self.name]:
                unlink(self)

    monkeypatch.setattr(SharedMemory, "__init__", open_)
    monkeypatch.setattr(SharedMemory, "close", close_)
    monkeypatch.setattr(SharedMemory, "unlink", lambda _: None)
    yield
    assert not +opened


@pytest.mark.usefixtures("kept")
def test_on_windows_a_reader_follows_a_restarted_writer() -> None:
    name = f"shm:glstar-test-win-{os.getpid()}"
    with LatestFrameReader(name) as reader:
        for by in ("the first", "the second"):
            with LatestFrameWriter(name, 4) as writer:
                write_one(writer, by)
                frame = reader.wait(5.0)
                assert frame is not None
                assert frame.truth["by"] == by
                assert reader.read() is None


@pytest.mark.usefixtures("kept")
def test_on_windows_smaller_memory_is_replaced_after_its_readers_have_closed_it(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    name = f"glstar-test-held-{os.getpid()}"
    held = SharedMemory(name, create=True, size=200)
    held.buf[:8] = b"GLSTARF1"
    monkeypatch.setattr(latestframe, "_RETRY_S", 0.05)
    with pytest.raises(ExportError, match="200 bytes are held open by readers"):
        LatestFrameWriter(f"shm:{name}", 4)
    # A reader sees the mark and closes its memory.
    assert bytes(held.buf[:8]) == b"GLSTARF0"
    with LatestFrameReader(f"shm:{name}") as reader:
        assert reader.read() is None
        held.close()
        with LatestFrameWriter(f"shm:{name}", 4) as writer:
            write_one(writer)
            assert reader.wait(5.0) is not None


def test_on_windows_replacing_a_file_is_retried_while_it_is_being_read(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path, replace, refusals = tmp_path / "latest", Path.replace, [3]

    def refuse_first(self: Path, target: Path) -> Path:
        if refusals[0]:
            refusals[0] -= 1
            raise PermissionError(13, "Access is denied")
        return replace(self, target)

    monkeypatch.setattr(Path, "replace", refuse_first)
    with LatestFrameWriter(str(path), 4) as writer, LatestFrameReader(str(path)) as reader:
        write_one(writer)
        assert refusals == [0]
        assert reader.read() is not None

        # If the file is never closed, writing fails and leaves no temporary file.
        monkeypatch.setattr(latestframe, "_RETRY_S", 0.02)
        refusals[0] = 10**9
        with pytest.raises(ExportError, match="Access is denied"):
            write_one(writer)
        assert sorted(one.name for one in tmp_path.iterdir()) == [".latest.lock", "latest"]


def test_on_windows_reading_a_file_is_retried_while_it_is_being_replaced(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path, refusals = tmp_path / "latest", [3]
    with LatestFrameWriter(str(path), 4) as writer:
        write_one(writer)
    read_bytes = Path.read_bytes

    def refuse_first(self: Path) -> bytes:
        if refusals[0]:
            refusals[0] -= 1
            raise PermissionError(13, "Access is denied")
        return read_bytes(self)

    monkeypatch.setattr(Path, "read_bytes", refuse_first)
    with LatestFrameReader(str(path)) as reader:
        with pytest.raises(PermissionError):
            reader.read()
        monkeypatch.setattr(latestframe, "_IS_WINDOWS", True)
        assert reader.wait(5.0) is not None
