"""Write permission of one run for a directory, which ends when another run begins there.

The processes of an export, on this machine or a cluster, may outlive the export that started them until they have drawn
their current frames.  Each run keeps a lease file in the directory while it draws, and its processes hold a shared lock
on the file while they write.  A later run takes an exclusive lock on the file, which waits for writes in progress, and
removes it: the processes of the earlier run then cannot write any more.
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
from glstar.system.durable import TEMPORARY
from glstar.system.filelock import lock_handle

__all__ = ["Lease", "revoke_leases"]

_PREFIX: Final = f"{TEMPORARY}lease-"
# Time for a process of an earlier run to finish writing its frame, s.
_WRITE_TIMEOUT_S: Final = 30.0
_POLL_INTERVAL_S: Final = 0.02


@dataclass(frozen=True, slots=True)
class Lease:
    """Write permission of one run for a directory; its processes receive a copy.

    Attributes
    ----------
    path : Path
        The lease file.
    """

    path: Path

    @classmethod
    @contextmanager
    def taken(cls, directory: Path) -> Iterator[Self]:
        """Take a lease for the duration of the context.

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
        """Hold the permission while files are written in the context.

        Raises
        ------
        ExportError
            If the run has ended, or another run has taken over the directory.
        """
        try:
            handle = os.open(self.path, os.O_RDONLY | getattr(os, "O_NOFOLLOW", 0))
        except FileNotFoundError:
            raise self._revoked_error() from None
        try:
            lock_handle(handle, shared=True, wait=True)
            if os.fstat(handle).st_nlink == 0:
                raise self._revoked_error()
            yield
        finally:
            os.close(handle)

    def _revoked_error(self) -> ExportError:
        message = "another run has taken this directory over, or the one that asked for these frames has ended"
        return ExportError(self.path.parent, message)


def revoke_leases(directory: Path) -> None:
    """Revoke the leases of all earlier runs, after their processes have finished writing.

    Parameters
    ----------
    directory : Path

    Raises
    ------
    ExportError
        If a process does not finish writing in time.
    """
    for path in directory.glob(f"{_PREFIX}*"):
        until_s = time.monotonic() + _WRITE_TIMEOUT_S
        while not _revoke(path):
            if time.monotonic() > until_s:
                message = f"a worker of an earlier export has been writing here for {_WRITE_TIMEOUT_S:.0f} s; stop it"
                raise ExportError(directory, message)
            time.sleep(_POLL_INTERVAL_S)


def _revoke(path: Path) -> bool:
    """Remove a lease file unless a process is writing under it; return whether it is gone."""
    try:
        handle = os.open(path, os.O_RDWR | getattr(os, "O_NOFOLLOW", 0))
    except FileNotFoundError:
        return True
    except OSError as error:
        if error.errno == errno.ELOOP:  # a symbolic link
            path.unlink()
            return True
        raise
    try:
        if not lock_handle(handle):
            return False
        if sys.platform != "win32":
            path.unlink(missing_ok=True)
    finally:
        os.close(handle)
    if sys.platform == "win32":
        try:  # Windows removes no file that a process has open, which serves as the lock there
            path.unlink(missing_ok=True)
        except PermissionError:
            return False
    return True
