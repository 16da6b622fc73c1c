"""Logs in gzip files and zip archives, opened without unpacking them first."""

import gzip
import tempfile
import zipfile
import zlib
from collections.abc import Callable, Collection, Iterator
from contextlib import contextmanager
from pathlib import Path, PurePath
from typing import Any, Final

from glstar.errors import LogFormatError
from glstar.telemetry.formats import LOG_FORMATS, log_format
from glstar.telemetry.source import AttitudeSamples, Boot, LogFacts, Samples, TelemetrySource
from glstar.telemetry.tablefile import is_office_file

__all__ = ["UnpackedSource", "is_packed", "unpack"]

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
    except (EOFError, zlib.error, gzip.BadGzipFile, zipfile.BadZipFile, NotImplementedError, RuntimeError) as error:
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


class UnpackedSource(TelemetrySource):
    """The log of an archive as a telemetry source, under the name of the archive.

    Parameters
    ----------
    name : str
        The archive.
    opener : callable
        Opens the unpacked log: ``opener(path)``.

    Raises
    ------
    LogFormatError
        If the archive cannot be unpacked, or its log cannot be read.
    """

    def __init__(self, name: str, opener: Callable[[str], TelemetrySource]) -> None:
        self.name = name
        self._folder, path = unpack(name)
        self._inside = str(path)
        try:
            with self._named():
                self._source = opener(self._inside)
        except BaseException:
            self._folder.cleanup()
            raise
        self.one_clock = self._source.one_clock

    def samples(self) -> Iterator[Samples]:
        """Yield the samples of the log."""
        with self._named():
            yield from self._source.samples()

    def facts(self, boots: Collection[int] = ()) -> LogFacts:
        """Return facts about the log and its vehicle."""
        with self._named():
            return self._source.facts(boots)

    def boots(self) -> tuple[Boot, ...]:
        """Return the boots of the log."""
        with self._named():
            return self._source.boots()

    def attitudes(self) -> Iterator[tuple[str, AttitudeSamples]]:
        """Yield the name and the samples of every attitude of the log."""
        with self._named():
            yield from self._source.attitudes()

    def close(self) -> None:
        """Close the log and remove the unpacked files."""
        self._source.close()
        self._folder.cleanup()

    @contextmanager
    def _named(self) -> Iterator[None]:
        """Name the archive in errors, in place of the temporary file."""
        try:
            yield
        except LogFormatError as error:
            reason = f"{Path(self._inside).name}: {error.reason}".replace(self._inside, Path(self._inside).name)
            raise LogFormatError(self.name, reason, offset=error.offset, lacks=error.lacks) from error
