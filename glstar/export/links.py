"""Symbolic links below an output directory are refused, so that an export writes to no other directory.

The output directory itself may be a link.
"""

import errno
import io
import os
import shutil
import stat
from pathlib import Path
from secrets import token_hex
from typing import IO, Final

from glstar.errors import ExportError
from glstar.export.layout import OURS, is_folder_name
from glstar.system.durable import TEMPORARY, flush_directory

__all__ = ["create", "make_folder", "open_to_append", "refuse_link", "refuse_links"]

_NO_LINKS: Final = getattr(os, "O_NOFOLLOW", 0) | getattr(os, "O_NONBLOCK", 0)
_ADVICE: Final = "glstar follows no links below its output directory; remove it, or choose another directory"


def refuse_links(directory: Path) -> None:
    """Refuse a directory where a name that an export uses belongs to a link, a pipe or another kind of file.

    Parameters
    ----------
    directory : Path
        May itself be a link.

    Raises
    ------
    ExportError
        Names the first one.
    """
    folders = [directory]
    for folder in folders:
        with os.scandir(folder) as entries:
            for entry in entries:
                if folder is directory and is_folder_name(entry.name):
                    _refuse(Path(entry.path), is_expected=entry.is_dir(follow_symlinks=False), expected="directory")
                    folders.append(Path(entry.path))
                elif OURS.fullmatch(entry.name) or entry.name.startswith(TEMPORARY):
                    _refuse(Path(entry.path), is_expected=entry.is_file(follow_symlinks=False), expected="regular file")


def refuse_link(path: Path) -> None:
    """Refuse a file of the output directory that is a link or no regular file.

    Parameters
    ----------
    path : Path
        Must exist.

    Raises
    ------
    ExportError
    """
    _refuse(path, is_expected=stat.S_ISREG(path.lstat().st_mode), expected="regular file")


def _refuse(path: Path, *, is_expected: bool, expected: str) -> None:
    # Another process may have removed it in the meantime.
    if not is_expected and os.path.lexists(path):
        what = "is a symbolic link" if path.is_symlink() else f"is no {expected}"
        raise ExportError(path, f"{what}; {_ADVICE}")


def make_folder(folder: Path) -> None:
    """Make a folder of frames, unless it exists.

    Parameters
    ----------
    folder : Path

    Raises
    ------
    ExportError
        If a link or a file has its name.
    """
    try:
        folder.mkdir()
        flush_directory(folder.parent)
    except FileExistsError:
        _refuse(folder, is_expected=stat.S_ISDIR(folder.lstat().st_mode), expected="directory")


def create(path: Path) -> IO[bytes]:
    """Create a file and open it for writing.

    Parameters
    ----------
    path : Path

    Returns
    -------
    binary file

    Raises
    ------
    FileExistsError
        If the name exists, even as a broken link.
    """
    return path.open("xb")


def open_to_append(path: Path) -> IO[bytes]:
    """Open a file of the output directory for appending; create it if it does not exist.

    If the file has other hard links, as after ``cp -al``, it is copied first, so that the other names keep their
    content.

    Parameters
    ----------
    path : Path

    Returns
    -------
    binary file

    Raises
    ------
    ExportError
        If it is a symbolic link or no regular file.
    OSError
        If it cannot be opened.
    """
    try:
        file = io.open(path, "ab", opener=_without_links)  # noqa: SIM115, UP020 - pathlib's takes no opener, and tests record io's
    except OSError as error:
        if error.errno not in {errno.ELOOP, errno.EMLINK}:  # EMLINK: FreeBSD's ELOOP
            raise
        raise ExportError(path, f"is a symbolic link; {_ADVICE}") from error
    status = os.fstat(file.fileno())
    if not stat.S_ISREG(status.st_mode):
        file.close()
        _refuse(path, is_expected=False, expected="regular file")
    if status.st_nlink < 2:
        return file
    file.close()
    own = path.with_name(f"{TEMPORARY}{token_hex(4)}-{path.name}")
    try:
        with path.open("rb") as shared, create(own) as copy:
            shutil.copyfileobj(shared, copy)
        own.replace(path)
    finally:
        own.unlink(missing_ok=True)
    return path.open("ab")


def _without_links(path: str, flags: int) -> int:
    return os.open(path, flags | _NO_LINKS, 0o666)
