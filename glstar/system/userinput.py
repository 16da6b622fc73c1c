"""Reading of files that the user names: the limits of their size, and suggestions for misspelt words.

A file of a few kilobytes can unpack to any size, declare an image of any size or nest without end.  Every reader takes
its bounds from `LIMITS`, before it decodes or unpacks anything.  Only regular files are read: a pipe might block
forever.
"""

import json
import os
import re
import stat
import tomllib
from collections import Counter
from collections.abc import Collection, Iterable, Iterator
from dataclasses import dataclass
from difflib import get_close_matches
from io import BufferedIOBase, BytesIO
from itertools import islice
from os import PathLike, strerror
from typing import Any, BinaryIO, Literal

import orjson

# Names in a directory that a misspelt one is compared with: 50 ms for names of 20 letters.
_MOST_NAMES = 2000

LimitName = Literal[
    "megapixels",
    "file_mib",
    "content_mib",
    "unpacked_gib",
    "ratio",
    "members",
    "archives",
    "rows",
    "columns",
    "cells",
    "depth",
]


@dataclass(frozen=True, slots=True)
class Limit:
    """A limit of files of others."""

    name: LimitName
    default: float
    unit: str  # For messages, after the number
    covers: str  # What it bounds, and why it has its value; for the manual

    @property
    def variable(self) -> str:
        """The environment variable that replaces the default."""
        return f"GLSTAR_MAX_{self.name.upper()}"

    @property
    def value(self) -> float:
        """The limit in force; raises ValueError if the environment variable is no number above 0."""
        text = os.environ.get(self.variable, "")
        try:
            number = float(text) if text else self.default
        except ValueError:
            number = 0.0
        if not number > 0:
            raise ValueError(f"the environment variable {self.variable} is {text!r}, not a number above 0")
        return number


LIMITS = (
    Limit("megapixels", 200, "megapixels", "photographs and maps of pixels; the largest sensors have 150"),
    Limit("file_mib", 4096, "MiB", "a file that is read as a whole: images, maps, catalogues, tables of text"),
    Limit("content_mib", 512, "MiB", "data unpacked in memory: a KMZ, a chunk of a bag, a packed catalogue"),
    Limit("unpacked_gib", 16, "GiB", "data unpacked to the disk: logs in gzip, zip and zstd"),
    Limit("ratio", 250, "times its size", "unpacked over packed bytes of either, from 64 MiB on"),
    Limit("members", 10_000, "members", "files in an archive"),
    Limit("archives", 3, "archives", "archives inside each other: flight.csv.gz in a zip has 2"),
    Limit("rows", 10_000_000, "rows", "rows of a table: Parquet, Excel and text with a column map"),
    Limit("columns", 10_000, "columns", "columns of a table"),
    Limit("cells", 20_000_000, "cells", "cells of an Excel sheet, empty ones before others included"),
    Limit("depth", 64, "levels", "nested elements of XML and YAML"),
)
_LIMIT_OF = {limit.name: limit for limit in LIMITS}
# Constant columns compress to any ratio: what takes no memory to speak of is unpacked in any case, bytes.
_ANY_RATIO_BYTES = 64 << 20
_PIECE_BYTES = 1 << 20
# Two reads for each of 5000 tags of EXIF; a camera writes some 200.
_MOST_READS = 10_000
# A line of truth with 100 000 stars has 50 MB.
_LONGEST_LINE = 64 << 20
_BYTES = {"MiB": 1 << 20, "GiB": 1 << 30}

_KINDS = (
    (stat.S_ISDIR, "this is a directory; give a file"),
    (stat.S_ISFIFO, "is a pipe, which can be read only once; save it to a file first"),
    (stat.S_ISSOCK, "is a socket; give a file"),
    (stat.S_ISCHR, "is a device; give a file"),
    (stat.S_ISBLK, "is a device; give a file"),
)


def refuse_irregular(mode: int) -> None:
    """Raise ValueError, which continues "PATH: ", if the ``st_mode`` says directory, pipe, device or socket."""
    for is_kind, message in _KINDS:
        if is_kind(mode):
            raise ValueError(message)


def limit_of(name: LimitName) -> float:
    """Return a limit: a number, or bytes; raises ValueError if its environment variable is no number."""
    limit = _LIMIT_OF[name]
    return limit.value * _BYTES.get(limit.unit, 1)


def refuse_more(name: LimitName, amount: float, what: str = "") -> None:
    """Raise ValueError, which continues "PATH: ", if an amount is above a limit; `what`: what the file has or is."""
    if amount > limit_of(name):
        limit = _LIMIT_OF[name]
        has = what or f"has {amount:,.0f} {limit.unit}"
        raise ValueError(f"{has}; glstar reads up to {limit.value:,g} {limit.unit} ({limit.variable} raises the limit)")


def refuse_many_pixels(width_px: int, height_px: int) -> None:
    """Raise ValueError, which continues "PATH: ", if an image is too large to decode."""
    refuse_more(
        "megapixels",
        width_px * height_px / 1e6,
        f"is {width_px} x {height_px} px, {width_px * height_px / 1e6:.4g} megapixels",
    )


class Unpacking:
    """The bytes that are unpacked of one file; `limit`: the limit of all of them.

    Raises ValueError, which continues "PATH: ", as soon as they are more than the limit, or than the allowed multiple
    of the packed ones.
    """

    def __init__(self, packed_bytes: int, limit: Literal["content_mib", "unpacked_gib"]) -> None:
        self._packed_bytes, self._limit = max(packed_bytes, 1), limit
        self._bytes = 0

    def add(self, count: int) -> None:
        """Count more bytes."""
        self._bytes += count
        refuse_more(self._limit, self._bytes, "unpacks to more than glstar takes")
        if self._bytes > _ANY_RATIO_BYTES:
            refuse_more("ratio", self._bytes / self._packed_bytes, "unpacks to a much larger file, as bombs do")

    def copy(self, packed: Any, target: BinaryIO) -> None:
        """Copy what a reader of packed bytes yields to a file."""
        while piece := packed.read(_PIECE_BYTES):
            self.add(len(piece))
            target.write(piece)

    def read(self, packed: Any) -> bytes:
        """Return what a reader of packed bytes yields."""
        content = BytesIO()
        self.copy(packed, content)
        return content.getvalue()


class FewReads:
    """An open file for a library that takes a file record by record, as ExifRead does.

    Raises ValueError after thousands of reads: a damaged directory states any number of records.
    """

    def __init__(self, file: BinaryIO) -> None:
        self._file, self._remaining = file, _MOST_READS

    def __getattr__(self, name: str) -> Any:
        return getattr(self._file, name)

    def read(self, count: int = -1) -> bytes:
        """Return bytes of the file."""
        self._remaining -= 1
        if self._remaining < 0:
            raise ValueError("has too many records in its header")
        return self._file.read(count)


def read_whole(path: str | PathLike[str]) -> bytes:
    """Return the content of a file of any size up to the limit; see `read_bytes`."""
    return read_bytes(path, int(limit_of("file_mib")))


def read_bytes(path: str | PathLike[str], largest_bytes: int) -> bytes:
    """Return the content of a small file.

    `path`: symbolic links are followed; `largest_bytes`: larger files, such as a flight log, are refused as mistakes.
    Raises ValueError, which continues "PATH: ", if it is no regular file, is too large, or cannot be read.
    """
    try:
        refuse_irregular(os.stat(path).st_mode)  # noqa: PTH116 - before it is opened: a device may act on that
        # The file may have been replaced by a pipe in the meantime: open it without waiting for a writer.
        flags = os.O_RDONLY | getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_BINARY", 0)
        with os.fdopen(os.open(path, flags), "rb") as file:
            refuse_irregular(os.fstat(file.fileno()).st_mode)
            content = file.read(largest_bytes + 1)
    except FileNotFoundError:
        raise ValueError(no_such_file(path)) from None
    except OSError as error:
        raise ValueError(f"cannot be read: {strerror(error.errno) if error.errno else error}") from None
    if len(content) > largest_bytes:
        raise ValueError(f"is larger than {largest_bytes / 2**20:g} MiB; is it the file that you mean?")
    return content


def read_text(path: str | PathLike[str], largest_bytes: int) -> str:
    """Return the text of a small file without a byte order mark; see `read_bytes`.

    Raises ValueError as `read_bytes` does, and if it is no UTF-8 text.
    """
    content = read_bytes(path, largest_bytes)
    try:
        return content.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise ValueError(f"is not UTF-8 text (byte 0x{content[error.start]:02x} at offset {error.start})") from None


def read_toml(path: str | PathLike[str], largest_bytes: int) -> dict[str, Any]:
    """Return the content of a small TOML file, in which each key occurs once; see `read_text`.

    Raises ValueError as `read_text` does, and if it is no TOML: line and column come first.
    """
    try:
        return tomllib.loads(read_text(path, largest_bytes))
    except tomllib.TOMLDecodeError as error:
        # "Expected '=' after a key in a key/value pair (at line 2, column 9)".
        parts = re.fullmatch(r"(.*) \(at (.*)\)", str(error))
        raise ValueError(f"{f'{parts[2]}: {parts[1]}' if parts else error} (TOML)") from None
    except RecursionError:
        raise ValueError("is nested too deeply") from None


def lines_of(file: BinaryIO | BufferedIOBase, longest_bytes: int = _LONGEST_LINE) -> Iterator[bytes]:
    """Yield the lines of an open file; raises ValueError, which continues "PATH: ", if one is longer."""
    number = 0
    while line := file.readline(longest_bytes + 1):
        number += 1
        if len(line) > longest_bytes:
            raise ValueError(f"line {number} is longer than {longest_bytes / 2**20:g} MiB")
        yield line


def read_json(text: str | bytes) -> Any:
    """Return the value of a JSON text; raises ValueError if it is none, nests too deeply or has a key twice."""
    try:
        return json.loads(text, object_pairs_hook=_once_each, parse_constant=_no_constant)
    except RecursionError:
        raise ValueError("is nested too deeply") from None


def read_json_line(line: str | bytes) -> Any:
    """Return the value of a line of JSON, as `read_json`; fast for lines that glstar wrote.

    Raises ValueError if it is none, nests too deeply or has a key twice.
    """
    text = line.encode() if isinstance(line, str) else line
    value = orjson.loads(text)
    # Of two equal keys orjson takes the last: then what it writes is shorter.
    return value if orjson.dumps(value) == text.rstrip(b"\r\n") else read_json(text)


def _once_each(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    """Return the keys and values of an object of JSON, in which each key occurs once."""
    values = dict(pairs)
    if len(values) < len(pairs):
        seen: set[str] = set()
        twice = next(key for key, _ in pairs if key in seen or seen.add(key))  # type: ignore[func-returns-value]
        raise ValueError(f"the key {twice[:60]!r} occurs twice")
    return values


def _no_constant(name: str) -> None:
    raise ValueError(f"{name} is no number of JSON")


def refuse_repeated(names: Iterable[str], needed: Collection[str] | None = None) -> None:
    """Raise ValueError, which continues "PATH: ", if several columns have a name: a needed one, or any."""
    counts = Counter(names)
    twice = next((name for name, n in counts.items() if n > 1 and name and (needed is None or name in needed)), None)
    if twice is not None:
        raise ValueError(f"has several columns named {twice[:60]}; rename or remove all but one")


def is_number(text: str) -> bool:
    """Return whether a cell of a table holds a number, rather than a name of its header."""
    try:
        float(text)
    except ValueError:
        return False
    return True


def nearest_word(word: str, known: Iterable[str], *, cutoff: float = 0.6) -> str | None:
    """Return the known word that is most similar to a misspelt one; None if no word is similar.

    `cutoff`: smallest similarity, from 0 to 1; see `difflib.get_close_matches`.
    """
    return next(iter(get_close_matches(word, list(known), n=1, cutoff=cutoff)), None)


def no_such_file(path: str | PathLike[str]) -> str:
    """Return that there is no such file, for a message after its name, with the most similar name in its directory.

    Names that differ in digits only, such as those of frames, are another file and not misspelt.
    """
    folder, name = os.path.split(os.fspath(path))
    try:
        with os.scandir(folder or os.curdir) as entries:
            beside = [entry.name for entry in islice(entries, _MOST_NAMES)]
    except OSError:
        return "there is no such file"
    digits = re.compile(r"\d+")
    series = digits.sub("0", name)
    near = nearest_word(name, [one for one in beside if digits.sub("0", one) != series], cutoff=0.75)
    return f"there is no such file (did you mean {near}?)" if near else "there is no such file"


def did_you_mean(word: str, known: Iterable[str], *, quote: str = "", or_else: str | None = None) -> str:
    """Return a question with the most similar known word: " (did you mean seed?)".

    `word`: the misspelt word; its case is ignored; `quote`: put before and after the known word; `or_else`: the text if
    no word is similar; by default all known words.
    """
    known = list(known)
    near = nearest_word(word.lower(), known)
    if near is not None:
        return f" (did you mean {quote}{near}{quote}?)"
    return f" (there are {', '.join(known)})" if or_else is None else or_else
