"""Locks on files and directories, between processes."""

import errno
import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from glstar.system import files as filelock
from glstar.system.files import LockFile, LockHeldError, lock_handle

# Takes a lock, reports it, and keeps it until its input ends or it is killed.
OWNER = """
import os, sys
from glstar.system.files import LockFile, lock_handle
from pathlib import Path
how, path = sys.argv[1:]
if how == "file":
    lock = LockFile(Path(path))
else:
    assert lock_handle(os.open(path, os.O_RDONLY), shared=how == "shared")
print("locked", flush=True)
sys.stdin.read()
"""


@contextmanager
def owner(how: str, path: Path) -> Iterator["subprocess.Popen[str]"]:
    command = [sys.executable, "-c", OWNER, how, str(path)]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as process:
        try:
            assert process.stdout is not None
            assert process.stdout.readline() == "locked\n"
            yield process
        finally:
            process.kill()


def lock(directory: Path, *, shared: bool = False) -> bool:
    handle = os.open(directory, os.O_RDONLY)
    try:
        return lock_handle(handle, shared=shared)
    finally:
        os.close(handle)


@pytest.mark.parametrize(("how", "shared"), [("exclusive", False), ("shared", True)])
def test_a_directory_is_locked_for_one_process_or_shared_by_several(how: str, shared: bool, tmp_path: Path) -> None:
    with owner(how, tmp_path):
        assert not lock(tmp_path)
        assert lock(tmp_path, shared=True) == shared
    assert lock(tmp_path)


def test_the_lock_of_a_killed_process_is_released(tmp_path: Path) -> None:
    path = tmp_path / "lock"
    with owner("file", path) as process:
        with pytest.raises(LockHeldError) as held:
            LockFile(path)
        assert held.value.process == str(process.pid)
        process.send_signal(signal.SIGKILL)
        process.wait(20)
    assert path.exists()
    LockFile(path).release()
    assert not path.exists()


@pytest.mark.parametrize("number", [errno.ENOLCK, errno.ENOTSUP, errno.ENOSYS])
def test_a_file_system_without_locks_excludes_no_process(
    number: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def flock(handle: int, how: int) -> None:
        raise OSError(number, os.strerror(number))

    monkeypatch.setattr(filelock.fcntl, "flock", flock)
    first, second = LockFile(tmp_path / "lock"), LockFile(tmp_path / "lock")
    first.release()
    second.release()


def test_a_disk_error_is_not_taken_for_a_free_lock(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def flock(handle: int, how: int) -> None:
        raise OSError(errno.EIO, os.strerror(errno.EIO))

    monkeypatch.setattr(filelock.fcntl, "flock", flock)
    before = len(list(Path("/proc/self/fd").iterdir()))
    with pytest.raises(OSError, match="Input/output"):
        LockFile(tmp_path / "lock")
    assert len(list(Path("/proc/self/fd").iterdir())) == before


def test_a_lock_file_that_is_a_link_is_refused(tmp_path: Path) -> None:
    (tmp_path / "lock").symlink_to(tmp_path / "elsewhere")
    with pytest.raises(OSError, match="symbolic links"):
        LockFile(tmp_path / "lock")
    assert not (tmp_path / "elsewhere").exists()
