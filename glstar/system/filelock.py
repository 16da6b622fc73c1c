"""Locks on files and directories; the operating system releases the lock of a process however it ends.

The locks are those of flock(2), and of a byte range on Windows.  They are advisory: they exclude only processes that
take them too.  On file systems without locks (some network disks), no process is excluded.

Notes
-----
portalocker and filelock were considered.  portalocker raises on a file system without locks, and filelock has exclusive
locks on files of its own only; on such a file system it leaves files that keep excluding others after their process was
killed.
"""

import errno
import os
import sys
from contextlib import ExitStack, suppress
from pathlib import Path
from typing import Final

if sys.platform == "win32":
    import msvcrt
else:
    import fcntl

__all__ = ["LockFile", "LockHeldError", "lock_handle"]

# Errors of file systems without locks: NFS without its lock daemon and some others.
_NO_LOCKS: Final = {errno.EBADF, errno.EINVAL, errno.ENOLCK, errno.ENOSYS, errno.ENOTSUP, errno.EOPNOTSUPP}
# The byte that is locked on Windows, where a locked byte cannot be read: far behind the content of any lock file.
_LOCKED_BYTE: Final = 2**20
# Longest text that is read from a lock file, bytes; a process number has at most 10 digits.
_MAX_TEXT_BYTES: Final = 20


class LockHeldError(Exception):
    """Another process holds a lock.

    Attributes
    ----------
    process : str
        Its process number; "unknown" if the lock file holds none.
    """

    def __init__(self, process: str) -> None:
        super().__init__(f"process {process} holds the lock")
        self.process = process


def lock_handle(handle: int, *, shared: bool = False, wait: bool = False) -> bool:
    """Lock an open file or directory until it is closed.

    Parameters
    ----------
    handle : int
        Its descriptor.
    shared : bool
        Whether other processes may hold shared locks at the same time.
    wait : bool
        Whether to wait until conflicting locks are released.

    Returns
    -------
    bool
        False if another process holds a conflicting lock.  True also if the file system has no locks.

    Raises
    ------
    OSError
        If it cannot be locked for another reason.

    Notes
    -----
    Windows has no shared locks here: a shared lock excludes no process, and `wait` is ignored.
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

    Parameters
    ----------
    path : Path
        Created if it does not exist; a symbolic link is not followed.

    Raises
    ------
    LockHeldError
        If another owner, in this process or another, holds the lock.
    OSError
        If the file cannot be opened or locked.
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
