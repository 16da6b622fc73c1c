"""``glstar convert``: an export in the formats of other tools, or a flight as a table."""

import json
from pathlib import Path
from typing import Annotated, Literal

import typer

from glstar.cli.reporting import echo_note, progress_bar
from glstar.config import Config
from glstar.errors import ConfigError, ExportError, reading
from glstar.export.directory import refuse_links
from glstar.system.files import write_atomically
from glstar.system.resources import DEMO
from glstar.telemetry import as_table, is_flight_description
from glstar.telemetry.synthetic import parse_description

_BY_SUFFIX = {".mcap": "mcap", ".csv": "csv", ".parquet": "parquet", ".srt": "srt"}
_LEAST_SNR = 5.0
_SHARD_FRAMES = 1000


def convert(
    export: Annotated[
        Path,
        typer.Argument(
            metavar="SET|FLIGHT",
            help="The directory of an export; or a flight, such as fly:orbit or a log, for a CSV table of it.",
            show_default=False,
        ),
    ],
    output: Annotated[
        str,
        typer.Option(
            "-o",
            "--output",
            help="A new file or directory, by the format; webdataset also to a URL of an object store (s3://...).",
            show_default=False,
        ),
    ],
    to: Annotated[
        Literal["mcap", "ros2", "csv", "srt", "png", "jpeg", "coco", "yolo", "webdataset"] | None,
        typer.Option(
            help="MCAP file or directory of a ROS 2 bag (Image, CameraInfo, Imu, NavSatFix, TF). The truth as CSV"
            " tables or as subtitles of the video (SubRip). Images with EXIF (UTC, exposure, position). Labels of"
            " trails as COCO or YOLO, or tar files for WebDataset.",
            show_default="by the suffix of the output: .mcap, .csv or .srt",
        ),
    ] = None,
    min_snr: Annotated[
        float, typer.Option(help="Smallest signal-to-noise ratio of a star with a label (coco, yolo).", min=0.0)
    ] = _LEAST_SNR,
    shard_frames: Annotated[int, typer.Option(help="Frames of a tar file (webdataset).", min=1)] = _SHARD_FRAMES,
    video_fps: Annotated[
        float, typer.Option(help="Frame rate of the video that subtitles belong to, 1/s (srt).", min=0.1, max=240)
    ] = 10.0,
    force: Annotated[bool, typer.Option("--force", help="Replace the table of a flight.")] = False,
    as_json: Annotated[bool, typer.Option("--json", help="Report as JSON.")] = False,
) -> None:
    """Convert an export to MCAP, a ROS 2 bag, CSV, images with EXIF, COCO, YOLO or WebDataset; or a flight to CSV.

    Try: glstar convert frames -o frames.mcap, or glstar convert 'fly:orbit?radius_m=300' -o orbit.csv
    """
    kind = to or _BY_SUFFIX.get(Path(output).suffix.lower())
    if kind == "parquet":
        raise ConfigError("glstar export --parquet writes the truth as Parquet tables into the export")
    if kind is None:
        kinds = "mcap, ros2, csv, srt, png, jpeg, coco, yolo or webdataset"
        raise ConfigError(f"{output}: say with --to whether {kinds} is meant")
    if is_flight_description(str(export)) or export.is_file() or str(export) == DEMO:
        _tabulate(export, Path(output), kind, force=force, as_json=as_json)
        return
    if force:
        raise typer.BadParameter("replaces the table of a flight only; name another output", param_hint="--force")
    written = _converted(export, output, kind, min_snr, shard_frames, video_fps)
    if as_json:
        typer.echo(json.dumps({"export": str(export), "format": kind, "written": list(written)}))
    else:
        for path in written:
            typer.echo(f"{kind}: {path}")


def _converted(
    export: Path, output: str, kind: str, min_snr: float, shard_frames: int, video_fps: float
) -> tuple[str, ...]:
    """Write an export in another format; return what was written."""
    if not export.is_dir():
        raise ExportError(export, "is no directory of an export, and no flight")
    refuse_links(export)
    if "://" in output and kind != "webdataset":
        raise ConfigError(f"{output}: only --to webdataset writes to an object store")
    with reading(export, ExportError, "cannot be converted, a line of its truth is damaged", is_unchecked=True):
        if kind in {"coco", "yolo", "webdataset"}:
            return _written_to_learn(export, output, kind, min_snr, shard_frames)
        if kind == "srt":
            return _subtitles(export, Path(output), video_fps)
        return tuple(map(str, _written(export, Path(output), kind)))


def _tabulate(flight: Path, output: Path, kind: str, *, force: bool, as_json: bool) -> None:
    """Write a flight as a table that every command reads."""
    from glstar.export.directory import explain_disk_errors  # noqa: PLC0415 - OpenCV, only when needed

    if kind != "csv":
        raise ConfigError(f"{output}: of a flight there is a CSV table only; name a file that ends with .csv")
    if output.exists() and flight.exists() and output.samefile(flight):
        raise ConfigError(f"{output} is the flight itself; name another file")
    if output.exists() and not force:
        raise ConfigError(f"{output} is there already; name another file, or replace it with --force")
    described = is_flight_description(str(flight))
    read = parse_description(str(flight)).flight() if described else Config().open_flight(flight)
    with explain_disk_errors(output):
        write_atomically(output, as_table(read).encode())
    attitude = read.attitude
    if as_json:
        facts = {"flight": str(flight), "format": kind, "written": [str(output)], "attitudes": int(attitude.utc_s.size)}
        typer.echo(json.dumps(facts))
        return
    length_s = attitude.last_s - attitude.first_s
    typer.echo(f"{output}: {length_s:.1f} s, {attitude.utc_s.size} attitudes at {attitude.rate_hz:.0f} Hz")


def _written_to_learn(export: Path, output: str, kind: str, min_snr: float, shard_frames: int) -> tuple[str, ...]:
    """Write labels or tar files; return what was written."""
    from glstar.export.truth.splits import ConvertedSet  # noqa: PLC0415 - OpenCV, only when needed

    with progress_bar("frames") as on_step:
        source = ConvertedSet(export, on_step)
        if kind == "coco":
            from glstar.export.convert.labels import write_coco  # noqa: PLC0415

            if Path(output).suffix.lower() != ".json":
                raise ConfigError(f"{output}: a file of COCO is named .json")
            return tuple(map(str, write_coco(source, Path(output), least_snr=min_snr)))
        if kind == "yolo":
            from glstar.export.convert.labels import write_yolo, yolo_folders  # noqa: PLC0415

            write_yolo(source, Path(output), least_snr=min_snr)
            for key, (_, why) in yolo_folders(source.splits).items():
                if why:
                    echo_note(f"glstar: {key} of data.yaml: {why}")
            return (output,)
        from glstar.export.convert.shards import write_shards  # noqa: PLC0415
        from glstar.export.run.store import opened_target  # noqa: PLC0415

        with opened_target(output) as target:
            names = write_shards(source, target, shard_frames=shard_frames)
        return tuple(f"{output.rstrip('/')}/{name}" for split in names.values() for name in split)


def _subtitles(export: Path, output: Path, frames_per_s: float) -> tuple[str, ...]:
    from glstar.export.convert.text import write_subtitles  # noqa: PLC0415 - only when needed

    if output.suffix.lower() != ".srt":
        raise ConfigError(f"{output}: a file of subtitles is named .srt")
    write_subtitles(export, output, frames_per_s=frames_per_s)
    return (str(output),)


def _written(export: Path, output: Path, kind: str) -> tuple[Path, ...]:
    """Write the output; return its files or directory."""
    if kind == "csv":
        from glstar.export.convert.text import write_csv  # noqa: PLC0415 - OpenCV, only when needed

        return write_csv(export, output)
    if kind in {"png", "jpeg"}:
        from glstar.export.imagefiles.exif import write_photographs  # noqa: PLC0415 - OpenCV, only when needed

        write_photographs(export, output, kind)
        return (output,)
    if kind == "mcap" and output.suffix.lower() != ".mcap":
        raise ConfigError(f"{output}: an MCAP file is named .mcap; --to ros2 writes the directory of a bag")
    if kind == "ros2" and output.suffix.lower() == ".mcap":
        raise ConfigError(f"{output}: --to ros2 writes a directory; leave out .mcap, or --to ros2")
    try:
        from glstar.export.convert.bags import write_bag  # noqa: PLC0415 - an extra
    except ImportError:
        raise ConfigError("bags and MCAP files need the rosbags library: pip install rosbags") from None
    with progress_bar("frames") as on_step:
        write_bag(export, output, on_step)
    return (output,)
