"""The lock on a directory of frames."""

import errno
import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Final

from glstar.errors import ExportError

if sys.platform != "win32":
    import fcntl

__all__ = ["NO_LOCKS", "directory_lock"]

# What a disk answers that knows no locks: NFS and some others.
NO_LOCKS: Final = {errno.EBADF, errno.ENOLCK, errno.ENOSYS, errno.EOPNOTSUPP}


@contextmanager
def directory_lock(directory: Path, *, shared: bool = False) -> Iterator[None]:
    """Keep other exports out of a directory; a killed one no longer counts.

    Parameters
    ----------
    directory : Path
        It must exist.
    shared : bool
        Let others in who share the work, too.

    Raises
    ------
    ExportError
        If another export is at work there.

    Notes
    -----
    Windows locks no directories, nor do some disks of networks: there nobody is kept out.
    """
    if sys.platform == "win32":
        yield
        return
    handle = os.open(directory, os.O_RDONLY)
    try:
        try:
            fcntl.flock(handle, (fcntl.LOCK_SH if shared else fcntl.LOCK_EX) | fcntl.LOCK_NB)
        except BlockingIOError:
            words = "another glstar is writing here; wait for it, or choose another directory"
            raise ExportError(directory, words) from None
        except OSError as error:
            if error.errno not in NO_LOCKS:
                raise
        yield
    finally:
        os.close(handle)
