"""The right of one run to write into a directory, which ends when another run begins there.

Worker processes, on this machine or of a cluster, can outlive the export that started them by the frames that they are
drawing.  Each run keeps a file in the directory while it draws; its workers lock that file, shared, while they write.
A later run locks it exclusively, once no worker writes, and removes it: frames of the earlier run are then no longer
written.
"""

import errno
import os
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from secrets import token_hex
from typing import Final, Self

from glstar.errors import ExportError
from glstar.export.directorylock import NO_LOCKS
from glstar.system.durable import TEMPORARY

if sys.platform != "win32":
    import fcntl

__all__ = ["Lease", "revoke_leases"]

_PREFIX: Final = f"{TEMPORARY}lease-"
# How long to wait for a worker of an earlier run to finish writing its frame, s.
_LONGEST_WRITE_S: Final = 30.0
_POLL_S: Final = 0.02


@dataclass(frozen=True, slots=True)
class Lease:
    """The right of one run to write into a directory; other processes get a copy.

    Attributes
    ----------
    path : Path
        The file that represents it.
    """

    path: Path

    @classmethod
    @contextmanager
    def taken(cls, directory: Path) -> Iterator[Self]:
        """Take the right to write for as long as the context lasts.

        Parameters
        ----------
        directory : Path

        Yields
        ------
        Lease
        """
        lease = cls(directory / f"{_PREFIX}{token_hex(8)}")
        lease.path.touch(exist_ok=False)
        try:
            yield lease
        finally:
            with suppress(OSError):
                lease.path.unlink(missing_ok=True)

    @contextmanager
    def writing(self) -> Iterator[None]:
        """Keep the right while something is written.

        Raises
        ------
        ExportError
            If the run has ended, or another one has taken the directory over.
        """
        try:
            handle = os.open(self.path, os.O_RDONLY | getattr(os, "O_NOFOLLOW", 0))
        except FileNotFoundError:
            raise self._ended() from None
        try:
            _lock(handle, exclusive=False)
            if os.fstat(handle).st_nlink == 0:
                raise self._ended()
            yield
        finally:
            os.close(handle)

    def _ended(self) -> ExportError:
        words = "another run has taken this directory over, or the one that asked for these frames has ended"
        return ExportError(self.path.parent, words)


def revoke_leases(directory: Path) -> None:
    """End the right to write of all earlier runs; return when none of their workers is writing.

    Parameters
    ----------
    directory : Path

    Raises
    ------
    ExportError
        If one of their workers does not finish writing.
    """
    for path in directory.glob(f"{_PREFIX}*"):
        until_s = time.monotonic() + _LONGEST_WRITE_S
        while not _revoked(path):
            if time.monotonic() > until_s:
                words = f"a worker of an earlier export has been writing here for {_LONGEST_WRITE_S:.0f} s; stop it"
                raise ExportError(directory, words)
            time.sleep(_POLL_S)


def _revoked(path: Path) -> bool:
    """Remove a lease unless a worker is writing under it; return whether it is gone."""
    try:
        handle = os.open(path, os.O_RDWR | getattr(os, "O_NOFOLLOW", 0))
    except FileNotFoundError:
        return True
    except OSError as error:
        if error.errno == errno.ELOOP:
            path.unlink()
            return True
        raise
    try:
        _lock(handle, exclusive=True)
        if sys.platform != "win32":
            path.unlink(missing_ok=True)
    except BlockingIOError:
        return False
    finally:
        os.close(handle)
    if sys.platform == "win32":
        try:  # Windows removes no file that somebody has open: that is its lock
            path.unlink(missing_ok=True)
        except PermissionError:
            return False
    return True


def _lock(handle: int, *, exclusive: bool) -> None:
    """Lock a file: to write beside others, waiting; or alone, at once or not at all."""
    if sys.platform == "win32":
        return
    try:
        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB if exclusive else fcntl.LOCK_SH)
    except BlockingIOError:
        raise
    except OSError as error:
        if error.errno not in NO_LOCKS:
            raise
