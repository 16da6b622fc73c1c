"""The ground truth of an export, read back."""

import json
from collections.abc import Iterator
from os import PathLike
from pathlib import Path
from typing import Any

from glstar.errors import ExportError
from glstar.render.truth import as_current_schema

__all__ = ["read_truth"]


def read_truth(path: str | PathLike[str]) -> Iterator[dict[str, Any]]:
    """Yield the frames of an export's ground truth, in the order of the file.

    Parameters
    ----------
    path : path-like
        The directory of an export, or its ``truth.jsonl``.

    Yields
    ------
    dict
        One line, as ``glstar manual truth`` describes it.  A line of schema 1 gets ``star_id`` in each star and an
        empty ``catalogue``; the other keys that schema 1 lacks are missing.

    Raises
    ------
    ExportError
        If the file cannot be read, or a line is not a frame of glstar's truth.
    """
    file = Path(path)
    if file.is_dir():
        file /= "truth.jsonl"
    try:
        lines = file.open("rb")
    except OSError as error:
        raise ExportError(file, f"cannot be read ({error.strerror})") from error
    with lines:
        for number, line in enumerate(lines, start=1):
            yield _frame(file, number, line)


def _frame(file: Path, number: int, line: bytes) -> dict[str, Any]:
    """Return one line as a dictionary."""
    try:
        return as_current_schema(json.loads(line))
    except (ValueError, TypeError, KeyError, RecursionError) as error:
        raise ExportError(file, f"line {number} is not a frame of a truth file of glstar") from error
