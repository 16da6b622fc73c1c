"""``glstar convert``: an export in the formats of other tools."""

import json
from pathlib import Path
from typing import Annotated, Literal

import typer

from glstar.cli.progress import progress_bar
from glstar.cli.verbosity import with_verbosity
from glstar.errors import ConfigError, ExportError

__all__ = ["convert"]

_BY_SUFFIX = {".mcap": "mcap", ".csv": "csv", ".parquet": "parquet"}


@with_verbosity
def convert(
    export: Annotated[Path, typer.Argument(help="The directory of an export.", show_default=False)],
    output: Annotated[
        Path, typer.Option("-o", "--output", help="A new file or directory, by the format.", show_default=False)
    ],
    to: Annotated[
        Literal["mcap", "ros2", "csv", "png", "jpeg"] | None,
        typer.Option(
            help="MCAP file or directory of a ROS 2 bag (Image, CameraInfo, Imu, NavSatFix, TF), the truth as CSV"
            " tables, or images with EXIF (UTC, exposure, position).",
            show_default="by the suffix of the output: .mcap or .csv",
        ),
    ] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Report as JSON.")] = False,
) -> None:
    """Convert an export: to MCAP or a ROS 2 bag, its truth to CSV, or its frames to images with EXIF.

    Try: glstar convert frames -o frames.mcap
    """
    kind = to or _BY_SUFFIX.get(output.suffix.lower())
    if kind == "parquet":
        raise ConfigError("glstar export --parquet writes the truth as Parquet tables into the export")
    if kind is None:
        raise ConfigError(f"{output}: say with --to whether mcap, ros2, csv, png or jpeg is meant")
    if not export.is_dir():
        raise ExportError(export, "is no directory of an export")
    written = _written(export, output, kind)
    if as_json:
        typer.echo(json.dumps({"export": str(export), "format": kind, "written": [str(path) for path in written]}))
    else:
        for path in written:
            typer.echo(f"{kind}: {path}")


def _written(export: Path, output: Path, kind: str) -> tuple[Path, ...]:
    """Write the output; return its files or directory."""
    if kind == "csv":
        from glstar.export.csvtruth import write_csv  # noqa: PLC0415 - OpenCV, only when needed

        return write_csv(export, output)
    if kind in {"png", "jpeg"}:
        from glstar.export.exif import write_photographs  # noqa: PLC0415 - OpenCV, only when needed

        write_photographs(export, output, kind)
        return (output,)
    if kind == "mcap" and output.suffix.lower() != ".mcap":
        raise ConfigError(f"{output}: an MCAP file is named .mcap; --to ros2 writes the directory of a bag")
    if kind == "ros2" and output.suffix.lower() == ".mcap":
        raise ConfigError(f"{output}: --to ros2 writes a directory; leave out .mcap, or --to ros2")
    try:
        from glstar.export.bagwriter import write_bag  # noqa: PLC0415 - an extra
    except ImportError:
        raise ConfigError("bags and MCAP files need the rosbags library: pip install rosbags") from None
    with progress_bar("frames") as on_step:
        write_bag(export, output, on_step)
    return (output,)
