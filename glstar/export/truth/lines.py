"""``truth.jsonl`` of an export: written with one line per frame, complete or not at all, and read back."""

import os
import re
import warnings
from array import array
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from functools import cached_property
from os import PathLike
from pathlib import Path, PurePosixPath, PureWindowsPath
from secrets import token_hex
from typing import IO, Any

import numpy as np
import orjson
from numpy.typing import NDArray

from glstar.errors import ExportError, reading
from glstar.export.directory import create, open_to_append
from glstar.render.truth.frame import KEYS, SCHEMA, as_current_schema
from glstar.system.files import flush, flush_directory, publish, temporary_path
from glstar.system.userinput import lines_of, read_json_line

Numbers = NDArray[np.int64]

# The beginning of a line: its schema and frame number.
_LINE = re.compile(rb'\{"schema":"' + SCHEMA.encode() + rb'","frame":(\d{1,18}),')
_BLOCK_BYTES = 1 << 22
# Signal-to-noise ratio above which a matched filter detects a trail with few false alarms.
DETECTABLE_SNR = 10.0


class TruthFile:
    """The truth of a directory of frames.

    Lines are appended to ``truth.jsonl.partial``. If several processes draw, each appends to a part of its own,
    ``truth.jsonl.LABEL-HEX.partial``. When every frame has its line, the file is renamed to ``truth.jsonl``, after the
    parts have been joined. An incomplete line of a killed run is cut off; if a frame was drawn twice, one of its two
    equal lines is kept. With a `shard_label`, `Shard.label`, only parts of this shard are read and written.
    """

    def __init__(self, directory: Path, shard_label: str = "") -> None:
        self._directory, self.shard_label = directory, shard_label
        self._final = directory / "truth.jsonl"
        self._partial = directory / "truth.jsonl.partial"
        self._reset()

    def _reset(self) -> None:
        # Files that lines were found in.  None is the main file, truth.jsonl or truth.jsonl.partial.
        self._sources: list[Path | None] = [None]
        # Four numbers per line: frame, index of the source, offset and length, bytes.  Compact, for millions of lines.
        self._lines = array("q")
        self._end = 0  # end of the last complete line of the main file, bytes
        self._appended = 0  # index of the source that `append` writes to

    @property
    def numbers(self) -> Numbers:
        """Frames that have a line, increasing."""
        return np.unique(self._table[:, 0])

    @property
    def _table(self) -> Numbers:
        # A copy: an array cannot grow while NumPy has a view of it.
        return np.array(self._lines, dtype=np.int64).reshape(-1, 4)

    def read(self) -> None:
        """Index the valid lines on the disk; `finish` omits all others."""
        self._reset()
        self._end = self._read(self._main(), 0, _is_valid)
        self._index_new_parts(_is_valid)

    def read_new_parts(self) -> None:
        """Index the lines in parts that other processes have written since `read`.

        `read` parses each line, because a power failure may have damaged the file.  Lines written by this run are
        complete if they end with a newline, so they are not parsed: that would delay the end of the export.
        """
        self._index_new_parts(_is_terminated)

    def _index_new_parts(self, is_valid: Callable[[bytes], bool]) -> None:
        for part in self._parts():
            if part not in self._sources:
                self._sources.append(part)
                self._read(part, len(self._sources) - 1, is_valid)

    def _read(self, path: Path, source: int, is_valid: Callable[[bytes], bool]) -> int:
        """Index the valid lines of a file; return the offset after its last complete line."""
        offset = 0
        with suppress(FileNotFoundError), path.open("rb") as truth:
            for line in truth:
                if not line.endswith(b"\n"):
                    break
                match = _LINE.match(line)
                if match and is_valid(line):
                    self._lines.extend((int(match[1]), source, offset, len(line)))
                offset += len(line)
        return offset

    def _main(self) -> Path:
        return self._final if self._final.exists() else self._partial

    def _parts(self) -> list[Path]:
        return sorted(self._directory.glob(f"truth.jsonl.{self.shard_label or '*'}-*.partial"))

    @contextmanager
    def open_for_append(self, *, as_part: bool = False) -> Iterator[IO[bytes]]:
        """Open the truth after its last complete line, or a new part, for `append`.

        A new part is for processes that write at the same time; a shard always writes one.
        """
        if as_part or self.shard_label:
            part = self._directory / f"truth.jsonl.{self.shard_label or 'part'}-{token_hex(6)}.partial"
            self._appended = len(self._sources)
            self._sources.append(part)
            with part.open("xb") as truth:
                yield truth
            return
        self.unpublish()
        self._appended = 0
        with open_to_append(self._partial) as truth:
            truth.truncate(self._end)
            truth.seek(0, os.SEEK_END)
            yield truth

    def unpublish(self) -> None:
        """Rename ``truth.jsonl`` to its partial name, because lines will be added."""
        with suppress(FileNotFoundError):
            self._final.replace(self._partial)

    def append(self, truth: IO[bytes], number: int, line: bytes) -> None:
        """Write the line of JSON of a frame, with its newline, to the file of `open_for_append`."""
        self._lines.extend((number, self._appended, truth.tell(), len(line)))
        truth.write(line)
        truth.flush()

    def line(self, number: int) -> bytes | None:
        """Return the line of a frame, as indexed by `read`; returns: none if it has no valid line."""
        found = self._found.get(number)
        if found is None:
            return None
        source, offset, length = found
        with (self._sources[source] or self._main()).open("rb") as truth:
            truth.seek(offset)
            return truth.read(length)

    def lines(self) -> Iterator[bytes]:
        """Yield the lines that are indexed, one for each frame, in the order of the frames."""
        for number in self.numbers.tolist():
            line = self.line(number)
            assert line is not None
            yield line

    @cached_property
    def _found(self) -> dict[int, tuple[int, int, int]]:
        """Source, offset and length of the last line of each frame."""
        return {number: (source, offset, length) for number, source, offset, length in self._table.tolist()}

    def is_finished(self, numbers: Numbers) -> bool:
        """Return whether ``truth.jsonl`` has one line for each frame, in order, and nothing else.

        `numbers` (n,) int64: all frames, increasing.
        """
        lines = self._table
        return self._final.exists() and np.array_equal(lines[:, 0], numbers) and self._in_order(lines)

    def finish(self, numbers: Numbers) -> None:
        """Write ``truth.jsonl`` with the lines in the order of the frames, and remove the partial files.

        `numbers` (n,) int64: all frames, increasing; each must have a line.
        """
        lines = self._table
        # The last line of each frame: a stable sort keeps the order in which lines were indexed.
        lines = lines[np.argsort(lines[:, 0], kind="stable")]
        lines = lines[np.append(np.diff(lines[:, 0]) != 0, True)] if len(lines) else lines
        lines = lines[np.isin(lines[:, 0], numbers)]
        if len(lines) != len(numbers):
            raise KeyError(f"{len(numbers) - len(lines)} frames have no line of truth")
        if not self._in_order(lines):
            self._join(lines)
        elif not self._final.exists():
            open_to_append(self._partial).close()  # creates the file of an export without frames
            flush([self._partial])
            self._partial.replace(self._final)
            flush_directory(self._directory)
        # truth.jsonl is durable, so its parts can be removed.
        parts = [self._partial, *self._directory.glob("truth.jsonl.*-*.partial")]
        for part in parts:
            part.unlink(missing_ok=True)
        flush_directory(self._directory)

    def _in_order(self, lines: Numbers) -> bool:
        """Return whether the main file consists of exactly these lines, in this order."""
        main = self._main()
        size = main.stat().st_size if main.exists() else 0
        follow = np.append(0, np.cumsum(lines[:, 3]))
        return bool((lines[:, 1] == 0).all() and (lines[:, 2] == follow[:-1]).all() and follow[-1] == size)

    def _join(self, lines: Numbers) -> None:
        joined = temporary_path(self._final)
        # Consecutive lines of one file are copied in one block.
        follows = (lines[1:, 1] == lines[:-1, 1]) & (lines[1:, 2] == lines[:-1, 2] + lines[:-1, 3])
        starts = np.append(0, np.flatnonzero(~follows) + 1)
        lengths = np.add.reduceat(lines[:, 3], starts)
        try:
            with create(joined) as truth:
                for (_, source, offset, _), length in zip(lines[starts].tolist(), lengths.tolist(), strict=True):
                    with (self._sources[source] or self._main()).open("rb") as part:
                        part.seek(offset)
                        _copy(part, truth, length)
        except BaseException:
            joined.unlink(missing_ok=True)
            raise
        publish(joined, self._final)


def _is_terminated(line: bytes) -> bool:
    return line.endswith(b"}\n")


def _is_valid(line: bytes) -> bool:
    """Return whether a line is a JSON object with every key: a fragment of a line may be valid JSON too."""
    try:
        parsed = orjson.loads(line)
    except ValueError:
        return False
    return isinstance(parsed, dict) and parsed.keys() >= set(KEYS)


def _copy(source: IO[bytes], target: IO[bytes], length: int) -> None:
    while length:
        block = source.read(min(length, _BLOCK_BYTES))
        if not block:
            raise EOFError(f"{source.name} has been truncated")
        target.write(block)
        length -= len(block)


_COUNTED_BLOCK_BYTES = 1 << 20


def has_truth(directory: Path) -> bool:
    """Return whether a directory has ``truth.jsonl``, or that of an export that was not finished."""
    return (directory / "truth.jsonl").is_file() or is_unfinished(directory)


def is_unfinished(directory: Path) -> bool:
    """Return whether a directory has lines of truth, but no ``truth.jsonl``."""
    return not (directory / "truth.jsonl").exists() and any(directory.glob("truth.jsonl*.partial"))


def _unfinished(directory: Path) -> TruthFile:
    """Return the truth of an export that was not finished, with a warning."""
    truth = TruthFile(directory)
    truth.read()
    warnings.warn(
        f"{directory}: the export was not finished; its first {len(truth.numbers)} frames are read"
        f" (glstar export --recover {directory} completes it)",
        stacklevel=1,
    )
    return truth


def read_truth(path: str | PathLike[str], *, split: str | None = None) -> Iterator[dict[str, Any]]:
    """Yield the frames of an export's ground truth, in the order of the file.

    Of an export that was not finished, its frames are yielded in the order of their numbers, with a warning.

    Parameters
    ----------
    path : path-like
        The directory of an export, or its ``truth.jsonl``.
    split : {"train", "validation", "test"}, optional
        Yield the frames of one split only, as ``glstar export --split flight`` has listed them beside the truth.

    Yields
    ------
    dict
        One line, as ``glstar manual truth`` describes it.  A line of schema 1 gets ``star_id`` in each star and an
        empty ``catalogue``; the other keys that schema 1 lacks are missing.

    Raises
    ------
    ExportError
        If a file cannot be read, or a line is not a frame of glstar's truth.
    """
    file = Path(path)
    if file.is_dir():
        file /= "truth.jsonl"
    wanted = None if split is None else _listed(file.with_name(f"{split}.txt"))
    if file.name.startswith("truth.jsonl") and is_unfinished(file.parent):
        lines = _unfinished(file.parent).lines()
    else:
        lines = _lines(file)
    for number, line in enumerate(lines, start=1):
        frame = parse_frame(file, number, line)
        if wanted is None or frame["file"] in wanted:
            yield frame


def _lines(file: Path) -> Iterator[bytes]:
    try:
        lines = file.open("rb")
    except OSError as error:
        raise ExportError(file, f"cannot be read ({error.strerror})") from error
    with lines, reading(file, ExportError):
        yield from lines_of(lines)


def _listed(path: Path) -> set[str]:
    """Return the images of a split."""
    try:
        return set(path.read_text(encoding="utf-8").splitlines())
    except (OSError, ValueError) as error:
        message = "is no list of a split; glstar export --split flight writes train.txt, validation.txt and test.txt"
        raise ExportError(path, message) from error


def parse_frame(file: Path, number: int, line: bytes) -> dict[str, Any]:
    """Return a line of a file, with its number, as a frame; raises ExportError if it is none."""
    try:
        frame = as_current_schema(read_json_line(line))
    except (ValueError, TypeError, KeyError, RecursionError) as error:
        why = f": {error}" if isinstance(error, ValueError) else ""
        raise ExportError(file, f"line {number} is not a frame of a truth file of glstar{why}") from error
    if "file" in frame and not is_inside(frame["file"]):
        name = str(frame["file"])[:80]
        raise ExportError(file, f"line {number} names the image {name!r}, which is not below its directory")
    return frame


def is_inside(name: object) -> bool:
    """Return whether a value is the relative path of a file that cannot leave its directory, on any system."""
    if not isinstance(name, str) or not name or "\0" in name:
        return False
    kinds = PurePosixPath(name), PureWindowsPath(name)
    return not any(path.anchor or path.drive or ".." in path.parts for path in kinds)


def count_frames_of_truth(directory: Path) -> int:
    """Return the number of frames of an export, without parsing its truth.

    Raises ExportError if the truth cannot be read.
    """
    file = directory / "truth.jsonl"
    if is_unfinished(directory):
        return len(_unfinished(directory).numbers)
    try:
        with file.open("rb") as truth:
            return sum(block.count(b"\n") for block in iter(lambda: truth.read(_COUNTED_BLOCK_BYTES), b""))
    except OSError as error:
        raise ExportError(file, f"cannot be read ({error.strerror})") from error
