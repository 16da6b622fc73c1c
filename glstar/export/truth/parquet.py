"""The truth as Parquet tables: of frames, of stars, and of bodies and satellites, joined by the frame number.

The first columns of each table are the same for every export.  What a setting adds to the truth (electrons, clouds, a
rolling shutter, a stack, the settings of a data set) is a column if any line of the truth has it, empty for the others.
"""

from collections.abc import Iterable, Iterator
from contextlib import ExitStack
from itertools import chain, islice
from pathlib import Path
from typing import Any

import pyarrow as pa
from pyarrow.parquet import ParquetWriter

from glstar.errors import ExportError
from glstar.export.directory import TABLES, explain_disk_errors
from glstar.render.truth.columns import Column, columns_of
from glstar.system.files import publish, temporary_path
from glstar.system.userinput import read_json_line

# Frames per row group, which are in memory at a time: some 100,000 stars at most.
_FRAMES_PER_GROUP = 256

_TYPES = {
    "float": pa.float64(),
    "int32": pa.int32(),
    "int64": pa.int64(),
    "string": pa.string(),
    "bool": pa.bool_(),
    "utc": pa.timestamp("us", tz="UTC"),
    "float[]": pa.list_(pa.float64()),
    **{f"float[{length}]": pa.list_(pa.float64(), length) for length in (3, 4, 9)},
}
# Keys of a frame that are not columns of the frames.
_NO_COLUMN = frozenset({"schema", "catalogue"})
_POSITIONS = tuple(column for column in columns_of("star") if column.kind == "position")
_TIMES = tuple(column.name for column in columns_of("frame") if column.kind == "utc")


def _fields(columns: Iterable[Column]) -> Iterator[tuple[str, pa.DataType]]:
    """Yield the name and type of each column; a position has two."""
    for column in columns:
        if column.kind == "position":
            yield from ((part, pa.float64()) for part in column.parts)
        else:
            yield column.name.rpartition(".")[2], _TYPES[column.kind]


_FRAMES = pa.schema(
    _fields(
        column
        for column in columns_of("frame")
        if not column.when and column.kind in {*_TYPES} and column.name not in _NO_COLUMN
    )
)
# Schema 1 had no ``camera_mag``: its column follows the others.
_STARS = pa.schema(
    [
        ("frame", pa.int64()),
        ("catalogue", pa.string()),
        *_fields(column for column in columns_of("star") if not column.when and column.name != "camera_mag"),
    ]
)
_OBJECT_KEYS = frozenset({"name", "x_px", "y_px", "start", "end"})
_OBJECTS = pa.schema(
    [("frame", pa.int64()), *_fields(column for column in columns_of("body") if column.name in _OBJECT_KEYS)]
)
# By the name of the table; those of bodies and of satellites are written if there is any.
_SCHEMAS = dict(zip(TABLES, (_FRAMES, _STARS, _OBJECTS, _OBJECTS), strict=True))
_ALWAYS = TABLES[:2]
_LISTS = tuple(column.name for column in columns_of("frame") if column.kind == "table")
# Keys of a frame that are tables, or whose own keys are columns without a prefix.
_ELSEWHERE = frozenset({"schema", "site", "camera", "settings", *_LISTS})

Row = dict[str, Any]


def write_parquet(directory: Path) -> tuple[Path, ...]:
    """Write the tables of the truth of a complete export from ``truth.jsonl``, atomically, and return their paths.

    ``frames.parquet`` has one row per frame, with a column for each setting that the data set varies, and
    ``stars.parquet`` one row per star and frame; bodies and satellites have ``bodies.parquet`` and
    ``satellites.parquet``. Raises ExportError if they cannot be written, or the values of a key have no common type.
    """
    truth = directory / "truth.jsonl"
    with explain_disk_errors(directory):
        schemas = _with_further_columns(truth)
        paths = {name: directory / name for name in schemas}
        temporary = {name: temporary_path(path) for name, path in paths.items()}
        try:
            _write(truth, schemas, temporary)
            for name, path in paths.items():
                publish(temporary[name], path)
        finally:
            for unnamed in temporary.values():
                unnamed.unlink(missing_ok=True)
        for name in set(TABLES) - set(schemas):
            (directory / name).unlink(missing_ok=True)
    return tuple(paths.values())


def _write(truth: Path, schemas: dict[str, pa.Schema], paths: dict[str, Path]) -> None:
    with ExitStack() as opened:
        writers = {
            name: opened.enter_context(ParquetWriter(paths[name], schema, compression="zstd"))
            for name, schema in schemas.items()
        }
        for group in _groups(truth):
            for name, schema in schemas.items():
                if rows := group[name]:
                    writers[name].write_table(_table(schema, rows))


def _table(schema: pa.Schema, rows: list[Row]) -> pa.Table:
    columns = {name: [row.get(name) for row in rows] for name in schema.names}
    return pa.table({name: pa.array(values, schema.field(name).type) for name, values in columns.items()}, schema)


def _with_further_columns(truth: Path) -> dict[str, pa.Schema]:
    """Return the schema of each table that has rows, with the columns that only some exports have."""
    schemas = {name: schema for name, schema in _SCHEMAS.items() if name in _ALWAYS}
    for group in _groups(truth):
        for name in TABLES:
            if group[name]:
                schemas[name] = _extended(truth, schemas.get(name, _SCHEMAS[name]), group[name], _SCHEMAS[name])
    return schemas


def _extended(truth: Path, schema: pa.Schema, rows: list[Row], fixed: pa.Schema) -> pa.Schema:
    """Add the columns that rows have beyond the fixed ones; integers and fractions of one column become floats."""
    names = [name for name in dict.fromkeys(chain.from_iterable(rows)) if name not in fixed.names]
    try:
        further = pa.schema([(name, pa.array([row.get(name) for row in rows]).type) for name in names])
        return pa.unify_schemas([schema, further], promote_options="permissive")
    except pa.ArrowException as error:
        raise ExportError(truth, f"the values of one key have different types: {error}") from error


def _groups(truth: Path) -> Iterator[dict[str, list[Row]]]:
    """Yield the rows of all tables, of some frames at a time."""
    with truth.open("rb") as file:
        while lines := [read_json_line(line) for line in islice(file, _FRAMES_PER_GROUP)]:
            frames = [_frame_row(line) for line in lines]
            stars, *objects = (
                [_object_row(line, entry) for line in lines for entry in line.get(key, ())] for key in _LISTS
            )
            yield dict(zip(TABLES, (frames, stars, *objects), strict=True))


def _frame_row(line: Row) -> Row:
    row = {key: value for key, value in line.items() if key not in _ELSEWHERE}
    return {
        **_flat(row),
        **line["site"],
        **{name: pa.scalar(line[name]).cast(pa.timestamp("us", tz="UTC")) for name in _TIMES},
        "C_camera_body": list(chain.from_iterable(line["C_camera_body"])),
        "C_camera_icrs": list(chain.from_iterable(line["C_camera_icrs"])),
        **line["camera"],
        "K": list(chain.from_iterable(line["camera"]["K"])),
        **line.get("settings", {}),
    }


def _flat(record: Row) -> Row:
    """Return a record without nested objects: the keys of ``sensor`` become ``sensor_noise`` and so on."""
    flat: Row = {}
    for key, value in record.items():
        if isinstance(value, dict):
            flat |= {f"{key}_{name}": part for name, part in _flat(value).items()}
        else:
            flat[key] = value
    return flat


def _object_row(line: Row, entry: Row) -> Row:
    """Return the row of a star, a body or a satellite."""
    row = {"frame": line["frame"], **entry}
    for column in _POSITIONS:
        row |= dict(zip(column.parts, row.pop(column.name) or (None, None), strict=True))
    if "star_id" in entry:
        row["catalogue"] = line["catalogue"]
    return row
