"""``truth.jsonl`` on its way: one line a frame, whole or not at all."""

import json
import os
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import IO

from glstar.export.files import TEMPORARY
from glstar.truth import SCHEMA

__all__ = ["TruthFile"]


class TruthFile:
    """The truth of a directory of frames.

    It grows as ``truth.jsonl.partial`` and takes its name when every frame has its line; a line that a killed run left
    half-written is cut off.

    Parameters
    ----------
    directory : Path
        Where the frames lie.
    """

    def __init__(self, directory: Path) -> None:
        self._final = directory / "truth.jsonl"
        self._partial = directory / "truth.jsonl.partial"
        self._sorted = directory / f"{TEMPORARY}truth.jsonl"
        # Where each frame's line stands: offset and length, bytes.
        self._lines: dict[int, tuple[int, int]] = {}
        # Where its last line ends that has an end.
        self._end = 0

    def __contains__(self, number: int) -> bool:
        return number in self._lines

    def read(self) -> None:
        """Find the lines that are there and whole; `finish` leaves the others out."""
        self._lines.clear()
        with suppress(FileNotFoundError), (self._final if self._final.exists() else self._partial).open("rb") as truth:
            self._end = 0
            for line in truth:
                number = _frame_number(line)
                if number is not None:
                    self._lines[number] = self._end, len(line)
                if line.endswith(b"\n"):
                    self._end += len(line)

    @contextmanager
    def growing(self) -> Iterator[IO[bytes]]:
        """Open the truth at the end of its last whole line.

        Yields
        ------
        binary file
            For `append`.
        """
        if self._final.exists():
            self._final.replace(self._partial)
        with self._partial.open("ab") as truth:
            truth.truncate(self._end)
            truth.seek(0, os.SEEK_END)
            yield truth

    def append(self, truth: IO[bytes], number: int, line: bytes) -> None:
        """Write a frame's line.

        Parameters
        ----------
        truth : binary file
            What `growing` gives.
        number : int
            The frame.
        line : bytes
            One line of JSON with its newline.
        """
        self._lines[number] = truth.tell(), len(line)
        truth.write(line)
        truth.flush()

    def finish(self, numbers: list[int]) -> None:
        """Give the truth its name, its lines in the order of the frames.

        Parameters
        ----------
        numbers : list of int
            All frames, each with its line.
        """
        if self._final.exists():
            self._partial.unlink(missing_ok=True)
            return
        spans = [self._lines[number] for number in numbers]
        self._partial.touch()  # of no frames at all
        in_order = sum(length for _, length in spans) == self._partial.stat().st_size and spans == sorted(spans)
        if not in_order:
            with self._partial.open("rb") as lines, self._sorted.open("wb") as in_turn:
                for offset, length in spans:
                    lines.seek(offset)
                    in_turn.write(lines.read(length))
            self._sorted.replace(self._partial)
        self._partial.replace(self._final)


def _frame_number(line: bytes) -> int | None:
    """Return the frame that a line of truth is about, or None for a line that is damaged or cut off."""
    try:
        truth = json.loads(line)
    except ValueError:
        return None
    return truth.get("frame") if isinstance(truth, dict) and truth.get("schema") == SCHEMA else None
