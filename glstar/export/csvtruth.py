"""The truth of an export as two CSV tables: one row per frame, and one row per star and frame."""

import csv
from collections.abc import Iterator
from itertools import chain
from pathlib import Path
from typing import Any, Final

from glstar.errors import ExportError
from glstar.export.diskerrors import explain_disk_errors
from glstar.export.readtruth import read_truth
from glstar.system.durable import publish, temporary_path

__all__ = ["write_csv"]

# Names of the parts of lists, by their key; other lists are numbered.
_PARTS: Final = {"q_body_ned": ("qw", "qx", "qy", "qz"), "start": ("start_x_px", "start_y_px")} | {
    "end": ("end_x_px", "end_y_px"),
}


def write_csv(directory: Path, output: Path) -> tuple[Path, Path]:
    """Write the truth of an export as CSV.

    Parameters
    ----------
    directory : Path
        The export.
    output : Path
        ``NAME.csv`` for the frames; the stars are written to ``NAME-stars.csv``.

    Returns
    -------
    frames, stars : Path

    Raises
    ------
    ExportError
        If the truth cannot be read, or a table cannot be written.
    """
    paths = output, output.with_name(f"{output.stem}-stars{output.suffix}")
    if there := next((path for path in paths if path.exists()), None):
        raise ExportError(there, "exists already; name another file, or remove it")
    temporary = [temporary_path(path) for path in paths]
    with explain_disk_errors(output):
        try:
            columns = _columns(directory)
            _write(temporary[0], columns[0], (_flat(line) for line in read_truth(directory)))
            _write(temporary[1], columns[1], chain.from_iterable(map(_stars, read_truth(directory))))
            for unnamed, path in zip(temporary, paths, strict=True):
                publish(unnamed, path)
        finally:
            for unnamed in temporary:
                unnamed.unlink(missing_ok=True)
    return paths


def _columns(directory: Path) -> tuple[list[str], list[str]]:
    """Return the columns of both tables, in the order in which the frames of a data set bring them up."""
    frames, stars = dict[str, None](), dict[str, None]()
    for line in read_truth(directory):
        frames |= dict.fromkeys(_flat(line))
        for star in _stars(line):
            stars |= dict.fromkeys(star)
    return list(frames), list(stars)


def _write(path: Path, columns: list[str], rows: Iterator[dict[str, Any]]) -> None:
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, columns, restval="")
        writer.writeheader()
        writer.writerows(rows)


def _stars(line: dict[str, Any]) -> Iterator[dict[str, Any]]:
    for star in line["stars"]:
        yield {"frame": line["frame"], "file": line["file"], "utc_mid": line["utc_mid"], **_flat(star)}


def _flat(record: dict[str, Any]) -> dict[str, Any]:
    """Return a record without nested objects and lists; the list of stars and the segments of stacks are left out."""
    flat: dict[str, Any] = {}
    for key, value in record.items():
        if isinstance(value, dict):
            flat |= _flat(value)
        elif key == "segments":
            continue  # as many as there are short exposures, each of two positions
        elif not isinstance(value, list):
            flat[key] = value
        elif not any(isinstance(item, dict) for item in value):
            items = list(chain.from_iterable(value)) if value and isinstance(value[0], list) else value
            names = _PARTS.get(key, ())
            flat |= dict(zip(names or [f"{key}_{k}" for k in range(len(items))], items, strict=False))
    return flat
