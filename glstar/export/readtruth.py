"""The ground truth of an export, read back."""

from collections.abc import Iterator
from os import PathLike
from pathlib import Path
from typing import Any

import orjson

from glstar.errors import ExportError
from glstar.render.truth import as_current_schema

__all__ = ["count_frames_of_truth", "read_truth"]

_BLOCK_BYTES = 1 << 20


def read_truth(path: str | PathLike[str], *, split: str | None = None) -> Iterator[dict[str, Any]]:
    """Yield the frames of an export's ground truth, in the order of the file.

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
    try:
        lines = file.open("rb")
    except OSError as error:
        raise ExportError(file, f"cannot be read ({error.strerror})") from error
    with lines:
        for number, line in enumerate(lines, start=1):
            frame = _frame(file, number, line)
            if wanted is None or frame["file"] in wanted:
                yield frame


def _listed(path: Path) -> set[str]:
    """Return the images of a split."""
    try:
        return set(path.read_text(encoding="utf-8").splitlines())
    except (OSError, ValueError) as error:
        message = "is no list of a split; glstar export --split flight writes train.txt, validation.txt and test.txt"
        raise ExportError(path, message) from error


def _frame(file: Path, number: int, line: bytes) -> dict[str, Any]:
    """Return one line as a dictionary."""
    try:
        return as_current_schema(orjson.loads(line))
    except (ValueError, TypeError, KeyError, RecursionError) as error:
        raise ExportError(file, f"line {number} is not a frame of a truth file of glstar") from error


def count_frames_of_truth(directory: Path) -> int:
    """Return the number of frames of an export, without parsing its truth.

    Parameters
    ----------
    directory : Path

    Returns
    -------
    int

    Raises
    ------
    ExportError
        If the truth cannot be read.
    """
    file = directory / "truth.jsonl"
    try:
        with file.open("rb") as truth:
            return sum(block.count(b"\n") for block in iter(lambda: truth.read(_BLOCK_BYTES), b""))
    except OSError as error:
        raise ExportError(file, f"cannot be read ({error.strerror})") from error
