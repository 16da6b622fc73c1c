"""Files that are complete or absent after a power failure, and locks on files and directories.

A file is written under a temporary name, flushed, and renamed.  Without the flush, ext4, XFS, btrfs, APFS and NTFS may
write the new name before the content.  The new name is durable after its directory has been flushed too.

Locks are those of flock(2), and of a byte range on Windows; the operating system releases them when a process ends.
Locks are advisory, and exclude no process on file systems without locks (some network disks), where portalocker raises
and filelock leaves files that exclude others after their process was killed.
"""

import errno
import os
import re
import shutil
import stat
import sys
import tempfile
import time
from collections import deque
from collections.abc import Iterator, Sequence
from concurrent.futures import Executor
from contextlib import ExitStack, suppress
from dataclasses import dataclass
from pathlib import Path
from secrets import token_hex
from typing import Self

# Prefix of the names of files that are being written.
TEMPORARY = ".glstar-writing-"
# Waits between attempts to replace a file that another program has open, s: Windows refuses that, other systems do not.
_PAUSES_S: tuple[float, ...] = (0.01, 0.04, 0.15, 0.3) if os.name == "nt" else ()
# Errors of file systems that cannot flush a file or a directory on request.
_NO_FLUSH = {errno.EINVAL, errno.ENOSYS, errno.ENOTSUP, errno.EOPNOTSUPP}

# Errors of file systems without locks: NFS without its lock daemon and some others.
_NO_LOCKS = {errno.EBADF, errno.EINVAL, errno.ENOLCK, errno.ENOSYS, errno.ENOTSUP, errno.EOPNOTSUPP}
# The byte that is locked on Windows, where a locked byte cannot be read: far behind the content of any lock file.
_LOCKED_BYTE = 2**20
# Longest text that is read from a lock file, bytes; a process number has at most 10 digits.
_MAX_TEXT_BYTES = 20


def temporary_path(path: Path) -> Path:
    """Return a temporary name in the directory of a file, different for each process that writes the file."""
    return path.with_name(f"{TEMPORARY}{token_hex(4)}-{path.name}")


@dataclass(frozen=True, slots=True)
class StagedFile:
    """A file under a temporary name, to be flushed and renamed."""

    temporary: Path  # current name
    path: Path  # final name

    @classmethod
    def beside(cls, path: Path) -> Self:
        """Return a staged file with a new temporary name in the directory of `path`; nothing is written yet."""
        return cls(temporary_path(path), path)

    def write(self, content: bytes) -> None:
        """Write the content under the temporary name.

        Raises OSError if it cannot be written; the temporary file is removed.
        """
        try:
            self.temporary.write_bytes(content)
        except BaseException:
            self.discard()
            raise

    def rename(self) -> None:
        """Rename the file to its final name, replacing an existing file; `flush` its content first."""
        _replace(self.temporary, self.path)

    def discard(self) -> None:
        """Remove the temporary file; does nothing after `rename`."""
        with suppress(OSError):
            self.temporary.unlink(missing_ok=True)


def remove_staged(path: Path) -> None:
    """Remove the temporary files of killed processes; no other process may be writing the file `path`."""
    pattern = re.compile(re.escape(TEMPORARY) + r"[0-9a-f]{8}-" + re.escape(path.name))
    with suppress(OSError):
        for entry in path.parent.iterdir():
            if pattern.fullmatch(entry.name):
                entry.unlink(missing_ok=True)


def write_atomically(path: Path, content: bytes) -> None:
    """Write a file so that after a power failure it has its old content or the new one, completely.

    Raises OSError if it cannot be written; an existing file keeps its content.
    """
    staged = StagedFile.beside(path)
    staged.write(content)
    publish(staged.temporary, path)


def publish(temporary: Path, path: Path) -> None:
    """Flush a file that was written under a temporary name, and rename it to its final name.

    `temporary`, `path`: in the same directory.  Raises OSError if it cannot be flushed or renamed; the temporary file
    is removed.
    """
    try:
        flush([temporary])
        _replace(temporary, path)
    except BaseException:
        StagedFile(temporary, path).discard()
        raise
    flush_directory(path.parent)


def _replace(temporary: Path, path: Path) -> None:
    """Rename a file; on Windows, wait up to half a second while another program has the old one open."""
    for pause_s in _PAUSES_S:
        try:
            temporary.replace(path)
        except PermissionError:
            time.sleep(pause_s)
        else:
            return
    temporary.replace(path)


def flush(paths: Sequence[Path], *, executor: Executor | None = None) -> None:
    """Flush the content of a few files, all open at the same time, to the disk.

    `executor`: threads that flush concurrently, so that the drive's cache is flushed once for several files: on ext4,
    eight files take 2 to 5 ms instead of 23.  Raises OSError if content did not reach the disk.
    """
    with ExitStack() as opened:
        handles = []
        for path in paths:
            handle = os.open(path, os.O_RDWR | getattr(os, "O_BINARY", 0) | getattr(os, "O_CLOEXEC", 0))
            opened.callback(os.close, handle)
            handles.append(handle)
        if sys.platform == "linux":
            # Start to write all files, so that the first fsync commits the file system's journal for all of them.
            for handle in handles:
                with suppress(OSError):
                    os.posix_fadvise(handle, 0, 0, os.POSIX_FADV_DONTNEED)
        for handle in handles[:1]:
            _synchronize(handle)
        deque((map if executor is None else executor.map)(_synchronize, handles[1:]), maxlen=0)
        for handle in handles[-1:]:
            _flush_drive_cache(handle)


def flush_handle(handle: int) -> None:
    """Flush the content of a file that is open for writing; raises OSError if it did not reach the disk."""
    _synchronize(handle)
    _flush_drive_cache(handle)


def _synchronize(handle: int) -> None:
    try:
        os.fsync(handle)
    except OSError as error:
        if error.errno not in _NO_FLUSH:
            raise


def _flush_drive_cache(handle: int) -> None:
    """Flush the cache of the drive on macOS, where `fsync` does not."""
    if sys.platform == "darwin":
        with suppress(OSError):  # unknown to network disks
            fcntl.fcntl(handle, fcntl.F_FULLFSYNC)


def flush_directory(directory: Path) -> None:
    """Flush a directory, so that created, renamed and removed names are durable.

    Raises OSError if the names did not reach the disk.  Does nothing on Windows, where NTFS journals names in order.
    """
    if sys.platform == "win32":
        return
    try:
        handle = os.open(directory, os.O_RDONLY | os.O_CLOEXEC)
    except PermissionError:  # a directory that may be written but not read
        return
    try:
        flush_handle(handle)
    finally:
        os.close(handle)


def make_directory(directory: Path) -> None:
    """Create a directory and its missing parents, durably; raises OSError if one cannot be created."""
    missing = [path for path in (directory, *directory.parents) if not path.exists()]
    directory.mkdir(parents=True, exist_ok=True)
    for created in missing:
        flush_directory(created.parent)


if sys.platform == "win32":
    import msvcrt
else:
    import fcntl


class LockHeldError(Exception):
    """Another process holds a lock; `process`: its process number; "unknown" if the lock file holds none."""

    def __init__(self, process: str) -> None:
        super().__init__(f"process {process} holds the lock")
        self.process = process


def lock_handle(handle: int, *, shared: bool = False, wait: bool = False) -> bool:
    """Lock an open file or directory until it is closed.

    `shared`: whether other processes may hold shared locks at the same time; `wait`: whether to wait until conflicting
    locks are released.  Returns whether no other process holds a conflicting lock, also if the file system has no
    locks.  Raises OSError if it cannot be locked for another reason.  On Windows, a shared lock excludes no process,
    and `wait` is ignored.
    """
    try:
        if sys.platform == "win32":
            if not shared:
                os.lseek(handle, _LOCKED_BYTE, os.SEEK_SET)
                msvcrt.locking(handle, msvcrt.LK_NBLCK, 1)
        else:
            fcntl.flock(handle, (fcntl.LOCK_SH if shared else fcntl.LOCK_EX) | (0 if wait else fcntl.LOCK_NB))
    except (BlockingIOError, PermissionError):
        return False
    except OSError as error:
        if error.errno not in _NO_LOCKS:
            raise
    finally:
        if sys.platform == "win32":
            os.lseek(handle, 0, os.SEEK_SET)
    return True


class LockFile:
    """A file that is locked while its owner lives and holds the owner's process number.

    `path`: created if it does not exist; a symbolic link is not followed.  Raises LockHeldError if another owner, in
    this process or another, holds the lock; OSError if the file cannot be opened or locked.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        while True:
            self._handle = _open_locked(path)
            # The previous owner may have removed the file between opening and locking it here.
            with suppress(FileNotFoundError):
                if os.path.samestat(os.fstat(self._handle), path.stat()):
                    break
            os.close(self._handle)
        os.ftruncate(self._handle, 0)
        os.write(self._handle, str(os.getpid()).encode())

    def release(self) -> None:
        """Remove the file and release the lock."""
        # Windows removes no open file.  Elsewhere the file is removed under the lock, so that it is the owner's own.
        if sys.platform == "win32":
            os.close(self._handle)
        with suppress(OSError):
            self._path.unlink()
        if sys.platform != "win32":
            os.close(self._handle)


def _open_locked(path: Path) -> int:
    """Open and lock a file; return its descriptor."""
    handle = os.open(path, os.O_RDWR | os.O_CREAT | getattr(os, "O_NOFOLLOW", 0), 0o600)
    with ExitStack() as failed:
        failed.callback(os.close, handle)
        if lock_handle(handle):
            failed.pop_all()
            return handle
        owner = os.read(handle, _MAX_TEXT_BYTES).decode(errors="replace")
    raise LockHeldError(owner or "unknown")


# Prefix of temporary directories of unpacked files; each has a lock file and a directory of its content.
_UNPACKED = "glstar-unpacked-"
_LOCK, _CONTENT = "lock", "content"
# A directory without its lock is being created, or its owner was killed meanwhile, s.
_CREATED_WITHIN_S = 3600.0


class UnpackedFolder:
    """A temporary directory for unpacked files, `path`, which `cleanup` removes; a context manager.

    Directories of killed processes are removed first: their locks are free.
    """

    def __init__(self) -> None:
        parent = Path(tempfile.gettempdir())
        for abandoned in _abandoned(parent):
            shutil.rmtree(abandoned, ignore_errors=True)
        self._folder = Path(tempfile.mkdtemp(prefix=_UNPACKED, dir=parent))
        self._lock = LockFile(self._folder / _LOCK)
        self.path = self._folder / _CONTENT
        self.path.mkdir()

    def cleanup(self) -> None:
        """Remove the directory; a second call does nothing."""
        if self._folder.exists():
            # The lock last: until then no other process removes it too.
            shutil.rmtree(self.path, ignore_errors=True)
            self._lock.release()
            shutil.rmtree(self._folder, ignore_errors=True)

    def __enter__(self) -> Path:
        return self.path

    def __exit__(self, *_: object) -> None:
        self.cleanup()


def _abandoned(parent: Path) -> Iterator[Path]:
    """Yield the directories of unpacked files of this user whose owners were killed."""
    user = os.getuid() if hasattr(os, "getuid") else None
    with suppress(OSError):
        for folder in parent.glob(f"{_UNPACKED}*"):
            with suppress(OSError):
                state = folder.lstat()
                if not stat.S_ISDIR(state.st_mode) or (user is not None and state.st_uid != user):
                    continue
                if (folder / _LOCK).is_file():
                    with suppress(LockHeldError):
                        LockFile(folder / _LOCK).release()
                        yield folder
                elif time.time() - state.st_mtime > _CREATED_WITHIN_S:
                    yield folder
