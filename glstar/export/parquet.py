"""The truth as two Parquet tables, of frames and of stars, joined by the frame number."""

from collections.abc import Callable, Iterator
from contextlib import ExitStack
from itertools import chain, islice
from pathlib import Path
from typing import Any, Final

import orjson
import pyarrow as pa
from pyarrow.parquet import ParquetWriter

from glstar.export.diskerrors import explain_disk_errors
from glstar.system.durable import publish, temporary_path

__all__ = ["write_parquet"]

# Frames per row group, which are in memory at a time: some 100,000 stars at most.
_FRAMES_PER_GROUP: Final = 256

_STARS: Final = pa.schema(
    [
        ("frame", pa.int64()),
        ("catalogue", pa.string()),
        ("star_id", pa.int32()),
        ("vmag", pa.float64()),
        *((name, pa.float64()) for name in ("x_px", "y_px", "centroid_x_px", "centroid_y_px")),
        *((name, pa.float64()) for name in ("start_x_px", "start_y_px", "end_x_px", "end_y_px")),
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
# Of rolling shutters only: a table has these columns if any of its frames has a readout time.
_ROLLING_STARS: Final = pa.schema([(name, pa.float64()) for name in ("mid_offset_s", "exposed_s", "light_dn")])
_ROLLING_FRAMES: Final = pa.schema(
    [("readout_s", pa.float64()), ("readout", pa.string()), ("rates_rad_per_s", pa.list_(pa.float64(), 3))]
)

Line = dict[str, Any]


def write_parquet(directory: Path) -> tuple[Path, Path]:
    """Write ``frames.parquet`` and ``stars.parquet`` from ``truth.jsonl``, atomically.

    Parameters
    ----------
    directory : Path
        Directory of a complete export.

    Returns
    -------
    frames, stars : Path
        One row per frame, with a column for each setting that the data set varies; one row per star and frame.

    Raises
    ------
    ExportError
        If they cannot be written.
    """
    paths = directory / "frames.parquet", directory / "stars.parquet"
    temporary = [temporary_path(path) for path in paths]
    with explain_disk_errors(directory):
        try:
            _write(directory / "truth.jsonl", *temporary)
            for unnamed, path in zip(temporary, paths, strict=True):
                publish(unnamed, path)
        finally:
            for unnamed in temporary:
                unnamed.unlink(missing_ok=True)
    return paths


def _write(truth: Path, frames_path: Path, stars_path: Path) -> None:
    with truth.open("rb") as lines:
        is_rolling = any(b'"readout_s":' in line for line in lines)
    with truth.open("rb") as lines, ExitStack() as opened:
        groups = _groups(lines)
        first = next(groups, [])
        settings = _settings_schema(first)
        frames_schema = pa.schema([*_FRAMES, *(_ROLLING_FRAMES if is_rolling else ()), *settings])
        stars_schema = pa.schema([*_STARS, *(_ROLLING_STARS if is_rolling else ())])
        frames = opened.enter_context(ParquetWriter(frames_path, frames_schema, compression="zstd"))
        stars = opened.enter_context(ParquetWriter(stars_path, stars_schema, compression="zstd"))
        group = first
        while group:
            frames.write_table(_table(frames_schema, [_frame_row(line) for line in group]))
            stars.write_table(_table(stars_schema, [row for line in group for row in _star_rows(line)]))
            group = next(groups, [])


def _groups(lines: Any) -> Iterator[list[Line]]:
    while group := [orjson.loads(line) for line in islice(lines, _FRAMES_PER_GROUP)]:
        yield group


def _settings_schema(lines: list[Line]) -> list[pa.Field]:
    """Return the columns of the settings that a data set varies, with the types in its first frame."""
    if not lines or "settings" not in lines[0]:
        return []
    kinds: dict[type, Callable[[], pa.DataType]] = {bool: pa.bool_, str: pa.string}
    settings = [pa.field(key, kinds.get(type(value), pa.float64)()) for key, value in lines[0]["settings"].items()]
    return [pa.field("flight", pa.string()), pa.field("sample", pa.int64()), *settings]


def _table(schema: pa.Schema, rows: list[Line]) -> pa.Table:
    columns = {name: [row[name] for row in rows] for name in schema.names}
    return pa.table({name: pa.array(values, schema.field(name).type) for name, values in columns.items()}, schema)


def _frame_row(line: Line) -> Line:
    camera = line["camera"]
    return {
        **dict.fromkeys(_ROLLING_FRAMES.names),
        **line,
        **line["site"],
        **{name: pa.scalar(line[name]).cast(pa.timestamp("us", tz="UTC")) for name in _TIMES},
        "C_camera_body": list(chain.from_iterable(line["C_camera_body"])),
        "C_camera_icrs": list(chain.from_iterable(line["C_camera_icrs"])),
        "K": list(chain.from_iterable(camera["K"])),
        "width_px": camera["width_px"],
        "height_px": camera["height_px"],
        "lens": camera["lens"],
        "distortion": camera["distortion"],
        **line.get("settings", {}),
    }


def _star_rows(line: Line) -> Iterator[Line]:
    for star in line["stars"]:
        (start_x, start_y), (end_x, end_y) = (star[name] or (None, None) for name in ("start", "end"))
        yield {
            **dict.fromkeys(_ROLLING_STARS.names),
            **star,
            "frame": line["frame"],
            "catalogue": line["catalogue"],
            "start_x_px": start_x,
            "start_y_px": start_y,
            "end_x_px": end_x,
            "end_y_px": end_y,
        }
