"""``truth.jsonl`` on its way: one line a frame, whole or not at all."""

import os
import re
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import IO

from glstar.export.files import TEMPORARY

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

    def __contains__(self, number: int) -> bool:
        return number in self._lines

    def read(self) -> None:
        """Find the lines that are there, up to the last whole one."""
        self._lines.clear()
        with suppress(FileNotFoundError), (self._final if self._final.exists() else self._partial).open("rb") as truth:
            offset = 0
            for line in truth:
                number = _frame_number(line)
                if number is None:
                    break
                self._lines[number] = offset, len(line)
                offset += len(line)

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
            truth.truncate(max((offset + length for offset, length in self._lines.values()), default=0))
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
    """Return the frame that a line of truth is about, or None for a line that was cut off."""
    if not line.endswith(b"}\n"):
        return None
    found = re.match(rb'\{"schema":"[^"]*","frame":(\d+),', line)
    return None if found is None else int(found.group(1))
