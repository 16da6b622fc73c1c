"""The lock on a directory of frames."""

import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from glstar.errors import ExportError
from glstar.system.filelock import lock_handle

__all__ = ["directory_lock"]


@contextmanager
def directory_lock(directory: Path, *, shared: bool = False) -> Iterator[None]:
    """Lock a directory against other exports; the lock of a killed export is released.

    Parameters
    ----------
    directory : Path
        Must exist.
    shared : bool
        Whether other exports may hold a shared lock at the same time: shards of one export, and verifications.

    Raises
    ------
    ExportError
        If another export holds a conflicting lock.

    Notes
    -----
    On Windows, which locks no directories, and on file systems without locks, no export is excluded.
    """
    if sys.platform == "win32":
        yield
        return
    handle = os.open(directory, os.O_RDONLY)
    try:
        if not lock_handle(handle, shared=shared):
            message = "another glstar is writing here; wait for it, or choose another directory"
            raise ExportError(directory, message)
        yield
    finally:
        os.close(handle)
