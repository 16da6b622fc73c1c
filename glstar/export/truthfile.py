"""``truth.jsonl`` on its way: one line a frame, whole or not at all."""

import os
import re
from array import array
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from functools import cached_property
from pathlib import Path
from secrets import token_hex
from typing import IO, Final

import numpy as np
import orjson
from numpy.typing import NDArray

from glstar.export.links import create, open_to_append
from glstar.render.truth import KEYS, SCHEMA
from glstar.system.durable import flush, flush_directory, publish, temporary_path

__all__ = ["TruthFile"]

Numbers = NDArray[np.int64]

# How a line begins.
_LINE: Final = re.compile(rb'\{"schema":"' + SCHEMA.encode() + rb'","frame":(\d{1,18}),')
_BLOCK_BYTES: Final = 1 << 22


class TruthFile:
    """The truth of a directory of frames.

    It grows as ``truth.jsonl.partial``, and where several draw at a time in parts of their own, as
    ``truth.jsonl.WHO-HEX.partial``.  It takes its name when every frame has its line; a line that a killed run left
    half-written is cut off, and of a frame drawn twice one line stays: they are equal.

    Parameters
    ----------
    directory : Path
        Where the frames lie.
    who : str
        Whose parts to write, and to look at: a shard's.  All parts where it is empty.

    Attributes
    ----------
    who : str
    """

    def __init__(self, directory: Path, who: str = "") -> None:
        self._directory, self.who = directory, who
        self._final = directory / "truth.jsonl"
        self._partial = directory / "truth.jsonl.partial"
        self._forget()

    def _forget(self) -> None:
        # The first is the truth itself, with or without its name.
        self._sources: list[Path | None] = [None]
        # Of each line the frame, the source, the offset and the length, one after the other: a million fit.
        self._lines = array("q")
        # Where the last line of the first source ends that has an end, and which source grows.
        self._end = self._growing = 0

    @property
    def numbers(self) -> Numbers:
        """The frames that have their line, rising."""
        return np.unique(self._table[:, 0])

    @property
    def _table(self) -> Numbers:
        # A copy: an array that is looked at cannot grow.
        return np.array(self._lines, dtype=np.int64).reshape(-1, 4)

    def read(self) -> None:
        """Find the lines that are there and whole; `finish` leaves the others out."""
        self._forget()
        self._end = self._read(self._main(), 0, _is_whole)
        self._read_new_parts(_is_whole)

    def read_more(self) -> None:
        """Find the lines that others have written in parts of their own since `read`, or ever.

        What an earlier run has left, on a disk that may have lost its power, is parsed to know that it is whole.  Of
        what has been written since an end of line tells it, and everybody would wait for a parser.
        """
        self._read_new_parts(_has_end)

    def _read_new_parts(self, is_whole: Callable[[bytes], bool]) -> None:
        for part in self._parts():
            if part not in self._sources:
                self._sources.append(part)
                self._read(part, len(self._sources) - 1, is_whole)

    def _read(self, path: Path, source: int, is_whole: Callable[[bytes], bool]) -> int:
        """Find a file's whole lines; return where the last of them ends."""
        offset = 0
        with suppress(FileNotFoundError), path.open("rb") as truth:
            for line in truth:
                if not line.endswith(b"\n"):
                    break
                match = _LINE.match(line)
                if match and is_whole(line):
                    self._lines.extend((int(match[1]), source, offset, len(line)))
                offset += len(line)
        return offset

    def _main(self) -> Path:
        return self._final if self._final.exists() else self._partial

    def _parts(self) -> list[Path]:
        return sorted(self._directory.glob(f"truth.jsonl.{self.who or '*'}-*.partial"))

    @contextmanager
    def growing(self, *, apart: bool = False) -> Iterator[IO[bytes]]:
        """Open the truth at the end of its last whole line, or a new part of it.

        Parameters
        ----------
        apart : bool
            Whether others draw at the same time; of a shard others always do.

        Yields
        ------
        binary file
            For `append`.
        """
        if apart or self.who:
            part = self._directory / f"truth.jsonl.{self.who or 'part'}-{token_hex(6)}.partial"
            self._growing = len(self._sources)
            self._sources.append(part)
            with part.open("xb") as truth:
                yield truth
            return
        self.reopen()
        self._growing = 0
        with open_to_append(self._partial) as truth:
            truth.truncate(self._end)
            truth.seek(0, os.SEEK_END)
            yield truth

    def reopen(self) -> None:
        """Take its name away: there are frames to come."""
        with suppress(FileNotFoundError):
            self._final.replace(self._partial)

    def append(self, truth: IO[bytes], number: int, line: bytes) -> None:
        """Write a frame's line.

        Parameters
        ----------
        truth : binary file
            What `growing` gave last.
        number : int
            The frame.
        line : bytes
            One line of JSON with its newline.
        """
        self._lines.extend((number, self._growing, truth.tell(), len(line)))
        truth.write(line)
        truth.flush()

    def line(self, number: int) -> bytes | None:
        """Return a frame's line as `read` found it.

        Parameters
        ----------
        number : int

        Returns
        -------
        bytes or None
            None where it has no whole line.
        """
        found = self._found.get(number)
        if found is None:
            return None
        source, offset, length = found
        with (self._sources[source] or self._main()).open("rb") as truth:
            truth.seek(offset)
            return truth.read(length)

    @cached_property
    def _found(self) -> dict[int, tuple[int, int, int]]:
        """The source, the offset and the length of each frame's last line, when it is first asked for."""
        return {number: (source, offset, length) for number, source, offset, length in self._table.tolist()}

    def is_finished(self, numbers: Numbers) -> bool:
        """Return whether the truth has its name, one line of each frame in their order, and nothing else.

        Parameters
        ----------
        numbers : (n,) int64
            All frames, rising.

        Returns
        -------
        bool
        """
        lines = self._table
        return self._final.exists() and np.array_equal(lines[:, 0], numbers) and self._in_order(lines)

    def finish(self, numbers: Numbers) -> None:
        """Give the truth its name, its lines in the order of the frames.

        Parameters
        ----------
        numbers : (n,) int64
            All frames, rising, each with its line.
        """
        lines = self._table
        # The last line of each frame: a stable sort keeps the order in which they were found.
        lines = lines[np.argsort(lines[:, 0], kind="stable")]
        lines = lines[np.append(np.diff(lines[:, 0]) != 0, True)] if len(lines) else lines
        lines = lines[np.isin(lines[:, 0], numbers)]
        if len(lines) != len(numbers):
            raise KeyError(f"{len(numbers) - len(lines)} frames have no line of truth")
        if not self._in_order(lines):
            self._join(lines)
        elif not self._final.exists():
            open_to_append(self._partial).close()  # of no frames at all
            flush([self._partial])
            self._partial.replace(self._final)
            flush_directory(self._directory)
        # The truth has its name on the disk: what it was made of may go.
        parts = [self._partial, *self._directory.glob("truth.jsonl.*-*.partial")]
        for part in parts:
            part.unlink(missing_ok=True)
        flush_directory(self._directory)

    def _in_order(self, lines: Numbers) -> bool:
        """Say whether the truth itself holds these lines and no others, one after the other."""
        main = self._main()
        size = main.stat().st_size if main.exists() else 0
        follow = np.append(0, np.cumsum(lines[:, 3]))
        return bool((lines[:, 1] == 0).all() and (lines[:, 2] == follow[:-1]).all() and follow[-1] == size)

    def _join(self, lines: Numbers) -> None:
        joined = temporary_path(self._final)
        # What lies together is copied together.
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


def _has_end(line: bytes) -> bool:
    return line.endswith(b"}\n")


def _is_whole(line: bytes) -> bool:
    """Return whether a line is an object with every key: what is left of a damaged one may be JSON too."""
    try:
        found = orjson.loads(line)
    except ValueError:
        return False
    return isinstance(found, dict) and found.keys() >= set(KEYS)


def _copy(source: IO[bytes], target: IO[bytes], length: int) -> None:
    while length:
        block = source.read(min(length, _BLOCK_BYTES))
        if not block:
            raise EOFError(f"{source.name} has become shorter")
        target.write(block)
        length -= len(block)
