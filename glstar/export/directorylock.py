"""The lock on a directory of frames, and what the user can do about errors of the operating system."""

import errno
import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Final

from glstar.errors import ExportError
from glstar.system.durable import TEMPORARY

if sys.platform != "win32":
    import fcntl

__all__ = ["WITHOUT_LOCKS", "alone_in", "words_for_the_disk"]

# What a disk answers that knows no locks: NFS and some others.
WITHOUT_LOCKS: Final = {errno.EBADF, errno.ENOLCK, errno.ENOSYS, errno.EOPNOTSUPP}


@contextmanager
def alone_in(directory: Path, *, shared: bool = False) -> Iterator[None]:
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
            if error.errno not in WITHOUT_LOCKS:
                raise
        yield
    finally:
        os.close(handle)


@contextmanager
def words_for_the_disk(path: Path) -> Iterator[None]:
    """Turn what the operating system says of a file into what the user can do.

    Parameters
    ----------
    path : Path
        What to blame where the system names nothing.

    Raises
    ------
    ExportError
        For every OSError inside.
    """
    try:
        yield
    except OSError as error:
        reason = (error.strerror or str(error)).lower()
        blamed = Path(os.fsdecode(error.filename)) if error.filename is not None else path
        if error.errno in {errno.ENOSPC, errno.EDQUOT}:
            advice = "the disk is full; make room and run the same command again, it goes on where it stopped"
        elif error.errno in {errno.EACCES, errno.EPERM, errno.EROFS}:
            advice = f"cannot be written ({reason}); choose another directory"
        elif error.errno in {errno.EEXIST, errno.ENOTDIR}:
            advice = f"is no directory ({reason}); choose another"
        else:
            advice = f"cannot be written ({reason}); once it can, the same command goes on where it stopped"
        blamed = path if blamed.name.startswith(TEMPORARY) else blamed
        raise ExportError(blamed, advice) from error
