"""Logs in gzip files and zip archives, opened without unpacking them first."""

import gzip
import tempfile
import zipfile
import zlib
from pathlib import Path, PurePath
from typing import Any, Final

from glstar.errors import LogFormatError
from glstar.telemetry.formats import LOG_FORMATS, log_format
from glstar.telemetry.tablefile import is_office_file

__all__ = ["is_packed", "unpack"]

_GZIP, _ZIP = b"\x1f\x8b", b"PK\x03\x04"
# Name of the member of a KMZ, which is a track.
_KMZ: Final = b"doc.kml"
_HEAD_BYTES: Final = 4096
# Larger content is refused: a few kilobytes can unpack to any size, bytes.
_LARGEST_BYTES: Final = 16 << 30
_PIECE_BYTES: Final = 1 << 20


def is_packed(head: bytes) -> bool:
    """Return whether a file is gzipped or a zip archive, but no Excel workbook and no KMZ.

    Parameters
    ----------
    head : bytes
        The first bytes of the file, some thousands.

    Returns
    -------
    bool
    """
    return head.startswith(_GZIP) or (head.startswith(_ZIP) and not is_office_file(head) and _KMZ not in head[:200])


# What gzip and zipfile raise on damaged files; damaged names and directories of an archive end in the last two.
_DAMAGED: Final = (
    EOFError,
    zlib.error,
    gzip.BadGzipFile,
    zipfile.BadZipFile,
    NotImplementedError,
    RuntimeError,
    IndexError,
    UnicodeDecodeError,
)


def unpack(name: str) -> tuple["tempfile.TemporaryDirectory[str]", Path]:
    """Unpack the log of a gzip file or a zip archive into a temporary directory.

    Parameters
    ----------
    name : str
        The file.

    Returns
    -------
    TemporaryDirectory
        Removed by its `cleanup`, or when it is no longer referenced.
    Path
        The log in it; other files of the archive are beside it.

    Raises
    ------
    LogFormatError
        If it is damaged, or does not hold exactly one log.
    """
    folder = tempfile.TemporaryDirectory(prefix="glstar-", ignore_cleanup_errors=True)
    try:
        with Path(name).open("rb") as file:
            is_gzip = file.read(2) == _GZIP
        if is_gzip:
            path = Path(folder.name) / (PurePath(name).stem or "log")
            with gzip.open(name) as packed:
                _copy(name, packed, path, 0)
            return folder, path
        return folder, _unzipped(name, Path(folder.name))
    except _DAMAGED as error:
        folder.cleanup()
        raise LogFormatError(name, f"cannot be unpacked: {error}") from error
    except BaseException:
        folder.cleanup()
        raise


def _copy(name: str, packed: Any, path: Path, before_bytes: int) -> int:
    """Write the unpacked content to a file; return the total number of bytes."""
    with path.open("xb") as file:
        while piece := packed.read(_PIECE_BYTES):
            before_bytes += len(piece)
            if before_bytes > _LARGEST_BYTES:
                raise LogFormatError(name, f"unpacks to more than {_LARGEST_BYTES >> 30} GiB")
            file.write(piece)
    return before_bytes


def _unzipped(name: str, folder: Path) -> Path:
    """Unpack all files of an archive into one folder, and return the only log."""
    size = 0
    logs: list[Path] = []
    tables: list[Path] = []
    with zipfile.ZipFile(name) as archive:
        for member in archive.infolist():
            # A path could lead out of the folder: only its last part counts.
            path = folder / PurePath(member.filename.replace("\\", "/")).name
            if member.is_dir() or path.name.startswith(".") or path.exists():
                continue
            with archive.open(member) as packed:
                size = _copy(name, packed, path, size)
            with path.open("rb") as file:
                head = file.read(_HEAD_BYTES)
            if (found := log_format(head)) is not None:
                (tables if found is LOG_FORMATS[-1] else logs).append(path)
    # Any text may be a table: a text beside a log is a readme.
    logs = logs or tables
    if len(logs) != 1:
        held = ", ".join(path.name for path in logs[:5])
        what = f"holds {len(logs)} logs ({held}); unpack it and name one" if logs else "is a zip archive without a log"
        raise LogFormatError(name, what)
    return logs[0]
