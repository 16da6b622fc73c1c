"""The truth as Parquet tables: of frames, of stars, and of bodies and satellites, joined by the frame number.

The first columns of each table are the same for every export.  What a setting adds to the truth (electrons, clouds, a
rolling shutter, a stack, the settings of a data set) is a column if any line of the truth has it, empty for the others.
"""

from collections.abc import Iterator
from contextlib import ExitStack
from itertools import chain, islice
from pathlib import Path
from typing import Any, Final

import orjson
import pyarrow as pa
from pyarrow.parquet import ParquetWriter

from glstar.errors import ExportError
from glstar.export.directory import TABLES, explain_disk_errors
from glstar.system.files import publish, temporary_path

# Frames per row group, which are in memory at a time: some 100,000 stars at most.
_FRAMES_PER_GROUP: Final = 256

_ENDS: Final = ("start_x_px", "start_y_px", "end_x_px", "end_y_px")
_STARS: Final = pa.schema(
    [
        ("frame", pa.int64()),
        ("catalogue", pa.string()),
        ("star_id", pa.int32()),
        ("vmag", pa.float64()),
        *((name, pa.float64()) for name in ("x_px", "y_px", "centroid_x_px", "centroid_y_px")),
        *((name, pa.float64()) for name in _ENDS),
        *((name, pa.float64()) for name in ("peak_dn", "flux_dn", "in_frame")),
        ("saturated", pa.bool_()),
        *((name, pa.float64()) for name in ("trail_peak_dn", "snr")),
    ]
)
_TIMES: Final = ("utc_start", "utc_mid", "camera_utc_start", "camera_utc_mid")
_FRAMES: Final = pa.schema(
    [
        ("frame", pa.int64()),
        ("file", pa.string()),
        *((name, pa.timestamp("us", tz="UTC")) for name in _TIMES),
        ("duration_s", pa.float64()),
        ("seed", pa.int64()),
        ("sub_exposures", pa.int64()),
        *((name, pa.float64()) for name in ("latitude_deg", "longitude_deg", "height_m")),
        ("q_body_ned", pa.list_(pa.float64(), 4)),
        ("C_camera_body", pa.list_(pa.float64(), 9)),
        ("C_camera_icrs", pa.list_(pa.float64(), 9)),
        ("up_camera", pa.list_(pa.float64(), 3)),
        ("K", pa.list_(pa.float64(), 9)),
        ("width_px", pa.int32()),
        ("height_px", pa.int32()),
        ("lens", pa.string()),
        ("distortion", pa.list_(pa.float64())),
    ]
)
_OBJECTS: Final = pa.schema(
    [
        ("frame", pa.int64()),
        ("name", pa.string()),
        *((name, pa.float64()) for name in ("x_px", "y_px", *_ENDS)),
    ]
)
# By the name of the table; those of bodies and of satellites are written if there is any.
_SCHEMAS: Final = dict(zip(TABLES, (_FRAMES, _STARS, _OBJECTS, _OBJECTS), strict=True))
_ALWAYS: Final = TABLES[:2]
# Keys of a frame that are tables or columns of their own.
_ELSEWHERE: Final = frozenset({"schema", "site", "camera", "stars", "bodies", "satellites", "settings"})

Row = dict[str, Any]


def write_parquet(directory: Path) -> tuple[Path, ...]:
    """Write the tables of the truth from ``truth.jsonl``, atomically.

    `directory`: directory of a complete export.  Returns ``frames.parquet``, one row per frame, with a column for each
    setting that the data set varies, and ``stars.parquet``, one row per star and frame; with bodies or satellites
    ``bodies.parquet`` and ``satellites.parquet``.  Raises ExportError if they cannot be written, or the values of a key
    have no common type.
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
        found = pa.schema([(name, pa.array([row.get(name) for row in rows]).type) for name in names])
        return pa.unify_schemas([schema, found], promote_options="permissive")
    except pa.ArrowException as error:
        raise ExportError(truth, f"the values of one key have different types: {error}") from error


def _groups(truth: Path) -> Iterator[dict[str, list[Row]]]:
    """Yield the rows of all tables, of some frames at a time."""
    with truth.open("rb") as file:
        while lines := [orjson.loads(line) for line in islice(file, _FRAMES_PER_GROUP)]:
            frames = [_frame_row(line) for line in lines]
            stars = [
                _object_row(line, star) | {"catalogue": line["catalogue"]} for line in lines for star in line["stars"]
            ]
            bodies, satellites = (
                [_object_row(line, one) for line in lines for one in line.get(key, ())]
                for key in ("bodies", "satellites")
            )
            yield dict(zip(TABLES, (frames, stars, bodies, satellites), strict=True))


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


def _object_row(line: Row, one: Row) -> Row:
    """Return the row of a star, a body or a satellite."""
    positions = chain.from_iterable(one.get(name) or (None, None) for name in ("start", "end"))
    ends = dict(zip(_ENDS, positions, strict=True))
    return {"frame": line["frame"], **{key: value for key, value in one.items() if key not in {"start", "end"}}, **ends}
