"""`LOG_FORMATS`, the table of log formats that glstar reads.

A new format is a reader, a `TelemetrySource` in a module of its own, and one entry of the table.  Logs in gzip files
and zip archives are unpacked by `unpack`; `other_file` says what a file is that is no flight log.
"""

import gzip
import re
import zipfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path, PurePath

from glstar.errors import LogFormatError, reading
from glstar.system.files import UnpackedFolder
from glstar.system.userinput import Unpacking, refuse_more
from glstar.telemetry.bags import BagReader, is_bag
from glstar.telemetry.dataflash import DataFlashDumpReader, DataFlashReader, is_dataflash, is_dataflash_dump
from glstar.telemetry.mavlink.mavlogdump import MavlogdumpReader, is_mavlogdump
from glstar.telemetry.mavlink.packets import is_telemetry_log
from glstar.telemetry.mavlink.tlog import TelemetryLogReader, is_mavlink_stream, stream_reader
from glstar.telemetry.source import MEMBER_MARK, TelemetrySource, archive_and_member
from glstar.telemetry.tables.files import csv_header, is_office_file, is_parquet, is_preamble, table_header
from glstar.telemetry.tables.mapped import MappedTableReader, ready_map
from glstar.telemetry.tables.native import TableReader
from glstar.telemetry.ulog import Ulog2csvReader, ULogReader, is_ulog, is_ulog2csv


@dataclass(frozen=True, slots=True)
class LogFormat:
    """One log format.

    Attributes
    ----------
    name : str
        For messages: ``"PX4 ULog"``.
    suffixes : tuple of str
        Usual suffixes of its files; only for messages and for searching folders.
    recognises : callable
        Whether a file is of this format, from its first 4096 bytes.
    reader : callable
        Opens a file: ``reader(path, attitude=..., boot=...)``.
    has_systems : bool
        Whether a file may hold several vehicles by MAVLink system; the reader then also takes ``sysid``.
    has_name_spaces : bool
        Whether a file may hold several vehicles by name; the reader then also takes ``vehicle``, and ``columns`` with
        topics and frames, as text.
    is_table : bool
        Whether a column map can say what its columns mean.
    is_any_text : bool
        Whether any text is recognised: another log in the same archive is preferred.
    """

    name: str
    suffixes: tuple[str, ...]
    recognises: Callable[[bytes], bool]
    reader: Callable[..., TelemetrySource]
    has_systems: bool = False
    has_name_spaces: bool = False
    is_table: bool = False
    is_any_text: bool = False


def _csv_tables(
    recognises: Callable[[bytes], bool], reader: Callable[..., TelemetrySource], *, is_any_text: bool = False
) -> LogFormat:
    return LogFormat("CSV tables", (".csv",), recognises, reader, is_table=True, is_any_text=is_any_text)


def _has_ready_map(header: Sequence[str]) -> bool:
    return ready_map(header) is not None or is_preamble(header)


# In the order of recognition: binary formats, then text formats, the most general last.
LOG_FORMATS = (
    LogFormat("MAVLink telemetry logs", (".tlog",), is_telemetry_log, TelemetryLogReader, has_systems=True),
    LogFormat("ArduPilot DataFlash", (".BIN", ".log"), is_dataflash, DataFlashReader),
    LogFormat("PX4 ULog", (".ulg",), is_ulog, ULogReader),
    LogFormat("MAVLink streams", (".rlog",), is_mavlink_stream, stream_reader, has_systems=True),
    LogFormat("ROS bags", (".bag", ".mcap", ".db3"), is_bag, BagReader, has_name_spaces=True),
    LogFormat("Parquet tables", (".parquet",), is_parquet, MappedTableReader, is_table=True),
    LogFormat("Excel workbooks", (".xlsx",), is_office_file, MappedTableReader, is_table=True),
    _csv_tables(lambda head: is_mavlogdump(csv_header(head)), MavlogdumpReader),
    _csv_tables(lambda head: is_dataflash_dump(csv_header(head)), DataFlashDumpReader),
    _csv_tables(lambda head: is_ulog2csv(csv_header(head)), Ulog2csvReader),
    _csv_tables(lambda head: _has_ready_map(table_header(head)), MappedTableReader),
    _csv_tables(lambda head: other_file(head, "") is None, TableReader, is_any_text=True),
)

# Suffixes of flight logs, in lower case.
LOG_SUFFIXES = tuple(dict.fromkeys(suffix.lower() for entry in LOG_FORMATS for suffix in entry.suffixes))


def _readable() -> str:
    names = list(dict.fromkeys(f"{entry.name} ({', '.join(entry.suffixes)})" for entry in LOG_FORMATS))
    return f"glstar reads {', '.join(names[:-1])} and {names[-1]}"


# A sentence for messages.
READABLE = _readable()


def log_format(head: bytes) -> LogFormat | None:
    """Return the format of a file by its first 4096 bytes; None if glstar does not read it."""
    return next((entry for entry in LOG_FORMATS if entry.recognises(head)), None)


_GZIP, _ZIP = b"\x1f\x8b", b"PK\x03\x04"
# Name of the member of a KMZ, which is a track.
_KMZ = b"doc.kml"
_HEAD_BYTES = 4096
# Number of logs that a message lists.
_LISTED = 20


def is_packed(head: bytes) -> bool:
    """Return whether a file is gzipped or a zip archive, by its first bytes, but no Excel workbook and no KMZ."""
    return head.startswith(_GZIP) or (head.startswith(_ZIP) and not is_office_file(head) and _KMZ not in head[:200])


def unpack(name: str) -> tuple[UnpackedFolder, Path]:
    """Unpack the log of a gzip file or a zip archive into a temporary directory, beside other files of the archive.

    `name` may be ``FILE.zip::member``.  Returns the directory, to be removed by its `cleanup`, and the log.  Raises
    LogFormatError if the file is damaged or above a limit, or does not hold exactly one log and none is named.
    """
    archive, member = archive_and_member(name)
    folder = UnpackedFolder()
    try:
        with reading(name, LogFormatError, "cannot be unpacked"):
            return folder, _unpacked(name, archive, member, folder.path)
    except BaseException:
        folder.cleanup()
        raise


def _unpacked(name: str, archive: str, member: str, folder: Path) -> Path:
    """Return the log of a file, unpacked into a folder."""
    unpacking = Unpacking(Path(archive).stat().st_size, "unpacked_gib")
    with Path(archive).open("rb") as file:
        is_gzip = file.read(2) == _GZIP
    if not is_gzip:
        return _unzipped(name, archive, member, folder, unpacking)
    path = folder / (PurePath(archive).stem or "log")
    with gzip.open(archive) as packed, path.open("xb") as file:
        unpacking.copy(packed, file)
    return path


def _unzipped(name: str, archive_name: str, wanted: str, folder: Path, unpacking: Unpacking) -> Path:
    """Unpack all files of an archive with their folders, and return the log that is wanted, or the only one."""
    logs: dict[str, Path] = {}
    texts: dict[str, Path] = {}
    with zipfile.ZipFile(archive_name) as archive:
        members = archive.infolist()
        refuse_more("members", len(members))
        for number, member in enumerate(members):
            title = member.filename.replace("\\", "/")
            path = _inside(folder, title)
            if member.is_dir() or path.name.startswith("."):
                continue
            if path.exists():
                title = f"{title}#{number + 1}"
                path = folder / f"#{number + 1}" / path.name
            path.parent.mkdir(parents=True, exist_ok=True)
            with archive.open(member) as packed, path.open("xb") as whole:
                unpacking.copy(packed, whole)
            with path.open("rb") as file:
                head = file.read(_HEAD_BYTES)
            if (kind := log_format(head)) is not None:
                (texts if kind.is_any_text else logs)[title] = path
    if wanted:
        return _named(name, wanted, logs | texts)
    # Any text may be a table: a text beside a log is a readme.
    logs = logs or texts
    if len(logs) == 1:
        return next(iter(logs.values()))
    if not logs:
        raise LogFormatError(name, "is a zip archive without a log")
    example = f"{PurePath(archive_name).name}{MEMBER_MARK}{next(iter(logs))}"
    raise LogFormatError(name, f"holds {len(logs)} logs ({_list(logs)}); name one, such as {example}")


def _inside(folder: Path, member: str) -> Path:
    """Return the path of a member of an archive in a folder; its name cannot lead out of it."""
    parts = [part.replace(":", "_") for part in member.split("/") if part not in {"", ".", ".."}]
    return folder.joinpath(*parts or ["log"])


def _named(name: str, wanted: str, logs: dict[str, Path]) -> Path:
    """Return the log of an archive with a path, or with a file name that only one has."""
    wanted = wanted.replace("\\", "/").strip("/")
    titles = [title for title in logs if title == wanted] or [t for t in logs if PurePath(t).name == wanted]
    if len(titles) != 1:
        held = f"it holds {_list(logs)}" if logs else "it holds no log"
        raise LogFormatError(name, f"the archive has {'several' if titles else 'no'} logs of that name; {held}")
    return logs[titles[0]]


def _list(logs: dict[str, Path]) -> str:
    return ", ".join([*list(logs)[:_LISTED], *(["..."] if len(logs) > _LISTED else [])])


# What a file is that has positions only.
_TRACK = "track; it has positions but no attitude: --position takes it"
# What a file is, by its first bytes.
_BY_MAGIC = {
    b"\x89PNG\r\n\x1a\n": "a PNG image",
    b"\xff\xd8\xff": "a JPEG image",
    b"II*\x00": "a TIFF image",
    b"MM\x00*": "a TIFF image",
    b"GIF8": "a GIF image",
    b"SIMPLE  =": "a FITS image",
    b"%PDF-": "a PDF",
    b"MATLAB 5.0": "a MATLAB file",
    b"BZh": "compressed with bzip2; unpack it first",
    b"7z\xbc\xaf": "a 7-Zip archive; unpack it first",
    b"\x28\xb5\x2f\xfd": "compressed with Zstandard; unpack it first",
    b"PK\x03\x04": "a zip archive without a log",
    b"\x89HDF\r\n": "an HDF5 file",
    b"\x93NUMPY": "a NumPy array",
    b"H Product:Blackbox": "a Betaflight or INAV blackbox log; its attitude has no compass and no UTC",
    b"RIFF": "a WebP image, audio or video",
    b"ULogEnc": "an encrypted ULog; decrypt it first",
    b"\xff\xfe": "text in UTF-16; save it as UTF-8",
    b"\xfe\xff": "text in UTF-16; save it as UTF-8",
    b"$GP": f"an NMEA {_TRACK}",
    b"$GN": f"an NMEA {_TRACK}",
    b"<": "a web page or XML; was it saved from a browser?",
    b"{": "JSON",
}

# What an archive or an XML file contains, by a string in its first bytes.
_CONTENTS = {
    b"PK\x03\x04": {
        b"doc.kml": "a track of Google Earth (KMZ); it has positions but no attitude: --position takes it",
    },
    b"<": {
        b"<gpx": f"a GPX {_TRACK}",
        b"<kml": f"a KML {_TRACK}",
        b"<TrainingCenterDatabase": "a TCX track; it has positions but no attitude",
    },
}

# First lines of an IGC file: its recorder, and header records.
_IGC = re.compile(rb"A[A-Z0-9]{3}[^\n]*\r?\n(?:[^\n]*\r?\n){0,4}?H[FOP]")
# Output of mavlogdump.py: 2024-03-10 20:30:34.26: ATT {TimeUS : 34265000, ...
_PRINTED = re.compile(rb"\d{4}-\d\d-\d\d [\d:.]+: \w+ \{")


def other_file(head: bytes, name: str) -> str | None:
    """Return what a file is that glstar does not read, such as ``"a PNG image"``, by its first bytes and its name.

    None if the file is text and may be a table.
    """
    text = head.removeprefix(b"\xef\xbb\xbf").lstrip()
    for magic, kind in _BY_MAGIC.items():
        if text.startswith(magic):
            contents = _CONTENTS.get(magic, {})
            return next((content for mark, content in contents.items() if mark in head), kind)
    if _IGC.match(text):
        return f"an IGC {_TRACK}"
    if _PRINTED.match(text):
        return "what mavlogdump.py prints; give the log itself, or its CSV (mavlogdump.py --format csv)"
    if b"\0" in head and "DJI" in Path(name).name:
        return "no log that glstar knows; DJI encrypts its flight records"
    return "no log that glstar knows" if b"\0" in head else None
