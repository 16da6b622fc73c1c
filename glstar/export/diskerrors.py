"""Errors of the operating system, as messages that say what the user can do."""

import errno
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from glstar.errors import ExportError
from glstar.system.durable import TEMPORARY

__all__ = ["explain_disk_errors"]


@contextmanager
def explain_disk_errors(path: Path) -> Iterator[None]:
    """Turn each OSError of the context into an ExportError with advice.

    Parameters
    ----------
    path : Path
        Named in the message if the operating system names no file, or one of glstar's temporary files.

    Raises
    ------
    ExportError
        For every OSError inside the context.
    """
    try:
        yield
    except OSError as error:
        reason = (error.strerror or str(error)).lower()
        named = Path(os.fsdecode(error.filename)) if error.filename is not None else path
        if error.errno in {errno.ENOSPC, errno.EDQUOT}:
            advice = "the disk is full; make room and run the same command again, it goes on where it stopped"
        elif error.errno in {errno.EACCES, errno.EPERM, errno.EROFS}:
            advice = f"cannot be written ({reason}); choose another directory"
        elif error.errno in {errno.EEXIST, errno.ENOTDIR}:
            advice = f"is no directory ({reason}); choose another"
        else:
            advice = f"cannot be written ({reason}); once it can, the same command goes on where it stopped"
        named = path if named.name.startswith(TEMPORARY) else named
        raise ExportError(named, advice) from error
