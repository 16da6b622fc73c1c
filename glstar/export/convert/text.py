"""Text made of the truth: CSV tables with a row per frame, star, body or satellite, and the subtitles of a video."""

import csv
from collections.abc import Iterator
from itertools import chain
from math import asin, degrees
from pathlib import Path
from typing import Any

import numpy as np

from glstar.errors import ExportError
from glstar.export.directory import explain_disk_errors
from glstar.export.truth.lines import read_truth
from glstar.render.truth.columns import COLUMNS, columns_of
from glstar.rotation import euler_from_quaternion, matrix_from_quaternion
from glstar.sky.place.horizon import ned_to_azimuth_altitude_rad
from glstar.system.files import publish, temporary_path

# Names of the elements of lists, by their key; those of other lists are numbered.
_PARTS = {column.name: column.parts for column in COLUMNS if column.parts}
# Lists of a frame that are tables of their own; the last two are written if there is any.
_LISTS = tuple(column.name for column in columns_of("frame") if column.kind == "table")
# As many as there are short exposures, each of two positions: in no table.
_LEFT_OUT = frozenset(column.name for column in COLUMNS if column.kind == "segments")


def write_csv(directory: Path, output: Path) -> tuple[Path, ...]:
    """Write the truth of an export as CSV: the frames to ``NAME.csv``, the stars to ``NAME-stars.csv``.

    If there are any, bodies are written to ``NAME-bodies.csv`` and satellites to ``NAME-satellites.csv``. Raises
    ExportError if the truth cannot be read, or a table cannot be written.
    """
    with explain_disk_errors(output):
        columns = _columns(directory)
        paths = {key: output.with_name(f"{output.stem}-{key}{output.suffix}") for key in columns} | {"frames": output}
        if existing := next((path for path in paths.values() if path.exists()), None):
            raise ExportError(existing, "exists already; name another file, or remove it")
        temporary = {key: temporary_path(path) for key, path in paths.items()}
        try:
            for key, path in temporary.items():
                _write(path, columns[key], chain.from_iterable(_rows(line, key) for line in read_truth(directory)))
            for key, path in paths.items():
                publish(temporary[key], path)
        finally:
            for unnamed in temporary.values():
                unnamed.unlink(missing_ok=True)
    return tuple(paths.values())


def _columns(directory: Path) -> dict[str, list[str]]:
    """Return the columns of each table, in the order in which the frames of a data set bring them up."""
    columns = {key: dict[str, None]() for key in ("frames", *_LISTS)}
    for line in read_truth(directory):
        for key, names in columns.items():
            for row in _rows(line, key):
                names.update(dict.fromkeys(row))
    return {key: list(names) for key, names in columns.items() if names or key == "stars"}


def _write(path: Path, columns: list[str], rows: Iterator[dict[str, Any]]) -> None:
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, columns, restval="")
        writer.writeheader()
        writer.writerows(rows)


def _rows(line: dict[str, Any], key: str) -> Iterator[dict[str, Any]]:
    """Yield the row of a frame, or the rows of one of its lists."""
    if key == "frames":
        yield _flat(line)
        return
    for one in line.get(key, ()):
        yield {"frame": line["frame"], "file": line["file"], "utc_mid": line["utc_mid"], **_flat(one)}


def _flat(record: dict[str, Any]) -> dict[str, Any]:
    """Return a record without nested objects; lists of objects and the segments of stacks are left out."""
    flat: dict[str, Any] = {}
    for key, value in record.items():
        if key in _LEFT_OUT:
            continue
        if isinstance(value, dict):
            flat |= _flat(value)
        elif not isinstance(value, list):
            flat[key] = value
        elif not any(isinstance(item, dict) for item in value):
            items = list(chain.from_iterable(value)) if value and isinstance(value[0], list) else value
            names = _PARTS.get(key, ())
            flat |= dict(zip(names or [f"{key}_{k}" for k in range(len(items))], items, strict=False))
    return flat


def write_subtitles(export: Path, output: Path, *, frames_per_s: float) -> None:
    """Write the subtitles of the video that ``glstar export --video`` makes of the same frames, as a SubRip file.

    Players show it with a video of the same name, whose frame rate is `frames_per_s`. Raises ExportError if the
    directory has no truth, or the file cannot be written.
    """
    with explain_disk_errors(output):
        output.parent.mkdir(parents=True, exist_ok=True)
        temporary = temporary_path(output)
        try:
            is_empty = True
            with temporary.open("wb") as file:
                for number, truth in enumerate(read_truth(export)):
                    file.write(("\n" * (number > 0) + _entry(number, truth, frames_per_s)).encode())
                    is_empty = False
            if is_empty:
                raise ExportError(export, "has no frames")
            publish(temporary, output)
        finally:
            temporary.unlink(missing_ok=True)


def _entry(number: int, truth: dict[str, Any], frames_per_s: float) -> str:
    """Return the entry of one frame, which is shown as long as the frame."""
    roll, pitch, yaw = (degrees(float(angle)) for angle in euler_from_quaternion(truth["q_body_ned"]))
    C_camera_ned = np.array(truth["C_camera_body"]) @ matrix_from_quaternion(np.array(truth["q_body_ned"]))
    azimuth, _ = np.rad2deg(ned_to_azimuth_altitude_rad(C_camera_ned[2]))
    altitude = degrees(asin(min(max(truth["up_camera"][2], -1.0), 1.0)))
    site = truth["site"]
    lines = (
        str(number + 1),
        f"{_time(number / frames_per_s)} --> {_time((number + 1) / frames_per_s)}",
        f"{truth['file']}  {truth['utc_mid']}  {truth['duration_s']:g} s  {len(truth['stars'])} stars",
        f"axis: azimuth {azimuth:.2f} deg, altitude {altitude:.2f} deg"
        f"  aircraft: roll {roll:.2f}, pitch {pitch:.2f}, yaw {yaw % 360:.2f} deg",
        f"{site['latitude_deg']:.6f}, {site['longitude_deg']:.6f}, {site['height_m']:.0f} m",
    )
    return "\n".join(lines) + "\n"


def _time(seconds: float) -> str:
    """Return a time as SubRip writes it: ``00:01:02,345``."""
    milliseconds = round(seconds * 1000)
    minutes, rest = divmod(milliseconds, 60_000)
    return f"{minutes // 60:02d}:{minutes % 60:02d}:{rest // 1000:02d},{rest % 1000:03d}"
