"""``glstar export``: frames of a flight, with the truth beside them."""

import json
import time
from collections import Counter
from contextlib import ExitStack, contextmanager
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import numpy as np
import typer

from glstar.cli.flightoptions import FlightFlags, Format, log_of, with_flight_flags
from glstar.cli.progress import progress_bar
from glstar.errors import ExportError
from glstar.flight import DATA_GAP
from glstar.system.installation import install_command
from glstar.system.interrupt import EXIT_INTERRUPTED, exit_on_interrupt

if TYPE_CHECKING:
    from collections.abc import Iterator

    from glstar.config import Config
    from glstar.export.executors import Executor
    from glstar.export.plan import SkippedFrame
    from glstar.export.run import Export, ExportReport
    from glstar.export.shard import Shard

__all__ = ["export"]

# Of so many frames, from all over the export, a dry run takes its measure.
_TRIED = 5
# A process that draws pays from so many frames on, and takes memory: nobody who has not asked for more gets more.
_FRAMES_A_WORKER = 100
_MOST_WORKERS = 8
# Settings that decide how large the images are.
_KEYS_OF_SIZE = {"camera.file", "camera.preset", "camera.width_px", "camera.height_px"}


@with_flight_flags()
def export(
    output: Annotated[Path, typer.Option("-o", "--output", help="The directory to fill.", show_default=False)],
    flights: Annotated[
        list[Path] | None,
        typer.Argument(
            help="Flight logs: ArduPilot .BIN or .log, MAVLink .tlog, PX4 .ulg, or CSV tables.",
            show_default="the bundled flight",
        ),
    ] = None,
    *,
    exposure: Annotated[
        float | None, typer.Option(help="How long each exposure is, s.", show_default="0.5, or the config's")
    ] = None,
    every: Annotated[
        float | None,
        typer.Option(help="From one exposure's start to the next's, s.", show_default="3, or the config's"),
    ] = None,
    flags: FlightFlags,
    start: Annotated[float, typer.Option(help="Where to begin, s from the flight's first attitude.")] = 0.0,
    stop: Annotated[
        float | None, typer.Option(help="Where to end, s from the first attitude.", show_default="the end")
    ] = None,
    frames: Annotated[int | None, typer.Option(help="No more frames than this.", show_default="all")] = None,
    format_: Format = None,
    light: Annotated[bool, typer.Option("--light", help="Write the light before noise too, as float32 TIFF.")] = False,
    seed: Annotated[int, typer.Option(help="Seed of the noise.", min=0)] = 0,
    video: Annotated[
        Path | None, typer.Option(help="Make a video of all frames too: a name.mp4.", show_default=False)
    ] = None,
    video_fps: Annotated[float, typer.Option(help="Frames a second of the video.", min=0.1, max=240)] = 10.0,
    workers: Annotated[
        int | None,
        typer.Option(
            help="How many processes draw, each on an OpenGL context of its own.",
            min=1,
            max=256,
            show_default=f"one a processor and {_FRAMES_A_WORKER} frames, {_MOST_WORKERS} at most; one of a shard",
        ),
    ] = None,
    shard: Annotated[
        str | None,
        typer.Option(
            metavar="K/N",
            help="Draw the Kth of N shares only, from 1; N such jobs fill one directory.",
            show_default="all",
        ),
    ] = None,
    dask: Annotated[
        str | None,
        typer.Option(metavar="ADDRESS", help="Let the workers of a Dask scheduler draw.", show_default="not"),
    ] = None,
    strict: Annotated[
        bool, typer.Option("--strict", help="Stop at a log that cannot be drawn; else it is left out of several.")
    ] = False,
    parquet: Annotated[bool, typer.Option("--parquet", help="Write the truth as Parquet tables too.")] = False,
    dry_run: Annotated[
        bool, typer.Option("--dry-run", help="Say how many frames, bytes and minutes; write nothing.")
    ] = False,
    verify: Annotated[
        bool,
        typer.Option("--verify", help="Write nothing: draw all frames again, and list the files that differ."),
    ] = False,
    force: Annotated[bool, typer.Option("--force", help="Start over: remove the frames that are there.")] = False,
    as_json: Annotated[bool, typer.Option("--json", help="Report as JSON.")] = False,
) -> None:
    """Write the long exposures that the camera would have taken on a flight, and where every star is on them.

    Run again, it finishes what is missing and leaves what is there.  Several flights, or a [sweep] in the config, make
    one data set.

    Try: glstar export flight.BIN -o frames --exposure 0.5 --every 3
    """
    with exit_on_interrupt():
        from glstar.export.images import write_video  # noqa: PLC0415 - OpenCV and OpenGL, when they are needed
        from glstar.export.run import prepare, prepare_data_set  # noqa: PLC0415 - OpenCV and OpenGL, when they are needed
        from glstar.export.shard import Shard  # noqa: PLC0415 - OpenCV and OpenGL, when they are needed
        from glstar.render.opengl import GLRenderer  # noqa: F401, PLC0415

    only_compares = dask is None and video is None and not (dry_run or force or parquet)
    _refuse_contradictions(video, dask, workers, verify=verify, only_compares=only_compares)
    share = Shard() if shard is None else Shard.parse(shard)
    if force and not share.is_whole:
        raise typer.BadParameter("would remove what the other shares have drawn", param_hint="--force")
    settings = flags.settings(**{"exposure.duration_s": exposure, "exposure.interval_s": every})
    paths = flights or [log_of(None)]
    request = {
        "start_s": start,
        "stop_s": stop,
        "frames": frames,
        "image_format": format_,
        "light": light,
        "seed": seed,
    }
    if len(paths) > 1 or settings.sweep:
        job = prepare_data_set(settings, paths, output, strict=strict, **request)  # type: ignore[arg-type]
        for log in job.left_out:
            typer.echo(f"glstar: left out: {log.path}: {' '.join(log.reason.split())}", err=True)
    else:
        job = prepare(settings, paths[0], output, **request)  # type: ignore[arg-type]
    for name, note in job.notes:
        typer.echo(f"{name}: {note}", err=True)
    if video is not None:
        _refuse_video_of_two_sizes(settings, len(paths), video)
    if workers is None:
        # Who deals out shares has dealt out the processors too.
        workers = _fitting(len(job.frames.numbers)) if share.is_whole else 1
    if dry_run:
        _say_what_would_be_done(job, share, workers, as_json=as_json)
        return
    if verify:
        _verify(job, share, workers, as_json=as_json)
        return
    began_s = time.monotonic()
    try:
        with _crew(job, workers, dask) as crew, progress_bar("frames") as on_frame:
            report = job.run(crew, shard=share, force=force, on_frame=on_frame)
    except KeyboardInterrupt:
        typer.echo("glstar: stopped; run the same command again to go on", err=True)
        raise typer.Exit(EXIT_INTERRUPTED) from None
    took_s = time.monotonic() - began_s
    if video is not None and report.complete:
        images = [job.image_path(number) for number in job.frames.numbers.tolist()]
        write_video(images, video, frames_per_s=video_fps, saturation_dn=job.frames.saturation_dn)
    tables = _write_parquet(output) if parquet and report.complete else ()
    _say_what_was_done(job, report, took_s, video, tables, as_json=as_json)


def _refuse_contradictions(
    video: Path | None, dask: str | None, workers: int | None, *, verify: bool, only_compares: bool
) -> None:
    """Refuse options that exclude each other."""
    if video is not None and video.suffix.lower() != ".mp4":
        raise typer.BadParameter(f"{video} must end with .mp4", param_hint="--video")
    if dask is not None and workers is not None:
        raise typer.BadParameter("has workers of its own; leave out --workers", param_hint="--dask")
    if verify and not only_compares:
        raise typer.BadParameter(
            "only compares; leave out --dask, --dry-run, --force, --parquet and --video", param_hint="--verify"
        )


def _refuse_video_of_two_sizes(settings: "Config", flights: int, video: Path) -> None:
    """Refuse a video, before anything is drawn, where the sweep varies the size of the images."""
    keys = [axis.key for axis in settings.sweep.axes if axis.key in _KEYS_OF_SIZE]
    samples: set[tuple[object, ...]] = set()
    for flight in range(flights if keys else 0):
        samples |= set(zip(*(settings.sweep.column(key, salt=flight) for key in keys), strict=True))
    cameras = [settings.at(dict(zip(keys, values, strict=True))).camera() for values in samples]
    sizes = sorted({(camera.width_px, camera.height_px) for camera in cameras})
    if len(sizes) > 1:
        words = " and ".join(f"{width_px} x {height_px} px" for width_px, height_px in sizes[:3])
        raise ExportError(
            video,
            f"a video has frames of one size, and {', '.join(keys)} of [sweep] makes images of {words}; leave out"
            " --video, or export each size to a directory of its own",
        )


def _fitting(frames: int) -> int:
    """Return how many processes draw so many frames where nobody has said it."""
    from glstar.export.executors import processors  # noqa: PLC0415 - OpenCV, when it is needed

    return max(1, min(processors(), frames // _FRAMES_A_WORKER, _MOST_WORKERS))


def _verify(job: "Export", share: "Shard", workers: int, *, as_json: bool) -> None:
    """Draw all frames again, list the files that differ, and exit with 1 if any does."""
    from glstar.export.executors import SerialExecutor  # noqa: PLC0415 - OpenCV, when it is needed
    from glstar.export.processes import ProcessExecutor  # noqa: PLC0415 - OpenCV, when it is needed
    from glstar.export.verify import verify  # noqa: PLC0415
    from glstar.render.opengl import GLRenderer  # noqa: PLC0415 - OpenGL, when it is needed

    began_s = time.monotonic()
    with ExitStack() as held:
        on_frame = held.enter_context(progress_bar("frames"))
        if workers > 1:
            found = verify(job, held.enter_context(ProcessExecutor(workers)), shard=share, on_frame=on_frame)
        else:
            renderer = held.enter_context(GLRenderer.headless())
            found = verify(job, SerialExecutor(renderer), shard=share, on_frame=on_frame)
        driver = found.drawn_by
    if as_json:
        facts = {
            "directory": str(found.directory),
            "frames": found.frames,
            "drawn_again": found.is_redrawn,
            "renderer": driver,
            "findings": [asdict(finding) for finding in found.findings],
            "seconds": round(time.monotonic() - began_s, 3),
        }
        typer.echo(json.dumps(facts))
    for finding in found.findings if not as_json else ():
        typer.echo(f"{finding.file}: {finding.problem}")
    if not found.is_redrawn:
        typer.echo(
            f"the frames were drawn by {driver}, whose bytes another driver does not draw: they have been decoded and"
            " matched with the truth, not drawn again",
            err=True,
        )
    if found.findings:
        files = len({finding.file for finding in found.findings})
        typer.echo(
            f"glstar: {found.directory}: {files} file{'s are' if files != 1 else ' is'} wrong; remove"
            f" {'them' if files != 1 else 'it'} and run the same command without --verify: it draws what is missing",
            err=True,
        )
        raise typer.Exit(1)
    if not as_json:
        how = "what is drawn, byte for byte" if found.is_redrawn else "whole, and of the size that the truth says"
        typer.echo(f"{_counted(found.frames)} verified in {time.monotonic() - began_s:.1f} s, {how}: {found.directory}")


@contextmanager
def _crew(job: "Export", workers: int, dask: str | None) -> "Iterator[Executor]":
    """Open who draws."""
    from glstar.export.executors import SerialExecutor  # noqa: PLC0415 - OpenCV, when it is needed
    from glstar.export.processes import ProcessExecutor  # noqa: PLC0415 - OpenCV, when it is needed
    from glstar.render.opengl import GLRenderer  # noqa: PLC0415 - OpenGL, when it is needed

    if dask is not None:
        with _needing("cluster"):
            from glstar.export.cluster import DaskExecutor  # noqa: PLC0415 - an extra
        with DaskExecutor(dask, job) as cluster:
            yield cluster
    elif workers > 1:
        with ProcessExecutor(workers) as several:
            yield several
    else:
        with GLRenderer.headless() as renderer:
            yield SerialExecutor(renderer)


@contextmanager
def _needing(extra: str) -> "Iterator[None]":
    try:
        yield
    except ImportError as error:
        raise ExportError(error.name or extra, f"is not installed; {install_command(extra)}") from error


def _write_parquet(directory: Path) -> tuple[Path, ...]:
    with _needing("parquet"):
        from glstar.export.parquet import write_parquet  # noqa: PLC0415 - an extra
    return write_parquet(directory)


def _say_what_was_done(
    job: "Export", report: "ExportReport", took_s: float, video: Path | None, tables: tuple[Path, ...], *, as_json: bool
) -> None:
    if as_json:
        facts = {
            "directory": str(report.directory),
            "drawn": report.drawn,
            "there_already": report.there_already,
            "skipped": [asdict(frame) for frame in report.skipped],
            "left_out": _listed(job),
            "complete": report.complete,
            "seconds": round(took_s, 3),
            "video": None if video is None else str(video),
            "tables": [str(table) for table in tables],
        }
        typer.echo(json.dumps(facts))
        return
    typer.echo(
        f"{_counted(report.drawn)} drawn in {took_s:.1f} s, {report.there_already} there already: {report.directory}"
    )
    _say_what_was_skipped(report.skipped)
    if report.tables_removed and not tables:
        typer.echo("the Parquet tables were of fewer frames and are removed; --parquet writes them again", err=True)
    if job.left_out:
        typer.echo(f"logs left out: {len(job.left_out)}, see above; --strict stops at the first", err=True)
    if not report.complete:
        typer.echo(
            "the other shares are not all there yet; the last one to end joins the truth, and makes what else is asked"
        )
    elif video is not None:
        typer.echo(f"video: {video}")
    for table in tables:
        typer.echo(f"table: {table}")


def _listed(job: "Export") -> list[dict[str, str]]:
    return [{"log": str(log.path), "reason": log.reason} for log in job.left_out]


def _counted(frames: int) -> str:
    return "1 frame" if frames == 1 else f"{frames} frames"


def _say_what_was_skipped(skipped: "tuple[SkippedFrame, ...]") -> None:
    """Count the frames left out, by reason."""
    for reason, count in Counter(frame.reason for frame in skipped).most_common():
        longest = max((frame for frame in skipped if frame.reason == reason), key=lambda frame: frame.gap_s)
        meets = "its exposure meets" if count == 1 else "their exposures meet"
        typer.echo(
            f"{_counted(count)} skipped, {meets} {reason} of the log;"
            f" the longest, {longest.gap_s:.3f} s, at {longest.start_s:.1f} s",
            err=True,
        )
    if any(frame.reason == DATA_GAP for frame in skipped):
        typer.echo("(--max-gap SECONDS interpolates across longer silences)", err=True)


def _say_what_would_be_done(job: "Export", share: "Shard", workers: int, *, as_json: bool) -> None:
    """Draw a few frames, in memory, and say what all of them take."""
    from glstar.render.opengl import GLRenderer  # noqa: PLC0415 - OpenGL, when it is needed

    numbers = share.share(job.frames.numbers)
    count = len(numbers)
    size_bytes = seconds = join_bytes = 0.0
    if count:
        tried = [int(numbers[which]) for which in np.linspace(0, count - 1, min(count, _TRIED)).round().astype(int)]
        with GLRenderer.headless() as renderer:
            job.draw(renderer, tried[0])  # the first one ever also warms the driver up
            began_s = time.perf_counter()
            frames = [job.draw(renderer, number) for number in tried]
        seconds = count / len(tried) * (time.perf_counter() - began_s) / workers
        truth_bytes = count / len(tried) * sum(len(frame.truth) for frame in frames)
        size_bytes = truth_bytes + count / len(tried) * sum(len(f.image) + len(f.light or b"") for f in frames)
        # Several writers leave parts of the truth, which are joined into one file before they are removed.
        join_bytes = truth_bytes if workers > 1 or not share.is_whole else 0.0
    if as_json:
        facts = {
            "frames": count,
            "skipped": len(job.frames.skipped),
            "left_out": _listed(job),
            "bytes": round(size_bytes),
            "peak_bytes": round(size_bytes + join_bytes),
            "seconds": round(seconds, 1),
        }
        typer.echo(json.dumps(facts))
        return
    joining = f" ({join_bytes / 1e9:.3f} GB more while the truth is joined)" if join_bytes else ""
    typer.echo(
        f"{_counted(count)} to {job.directory}: about {size_bytes / 1e9:.3f} GB{joining}"
        f" and {seconds / 60:.1f} minutes; nothing written"
    )
    _say_what_was_skipped(job.frames.skipped)
