"""``glstar export``: frames of a flight, with the truth beside them."""

import json
import time
from collections import Counter
from collections.abc import Callable
from contextlib import ExitStack, contextmanager
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import typer

from glstar.cli.flightoptions import FlightFlags, Format, flights_of, with_flight_flags
from glstar.cli.images.exportoptions import (
    FRAMES_PER_WORKER,
    MAX_WORKERS,
    At,
    Blind,
    Dask,
    DryRun,
    Every,
    Exif,
    ExposureTime,
    Flights,
    Force,
    FrameLimit,
    Json,
    Masks,
    NavigatorAttitude,
    Noiseless,
    Output,
    OutputPlace,
    Seed,
    ShardText,
    Start,
    Stop,
    Strict,
    Verify,
    Video,
    VideoRate,
    WorkerCount,
)
from glstar.cli.images.exportreport import SummaryFiles, bit_note, light_notes, needing, with_summary_files
from glstar.cli.images.publishing import FramePublishing, LatestFrame, NavigatorFiles, WithTruth
from glstar.cli.progress import progress_bar
from glstar.cli.verbosity import echo_detail, echo_note, with_verbosity
from glstar.errors import ExportError
from glstar.flight import DATA_GAP
from glstar.system.process import EXIT_INTERRUPTED, exit_on_interrupt

if TYPE_CHECKING:
    from collections.abc import Iterator
    from contextlib import AbstractContextManager

    from glstar.config import Config
    from glstar.export.frame import EncodedFrame
    from glstar.export.plan.frames import ExportOptions, SkippedFrame
    from glstar.export.run.executors import Executor, OnPixels
    from glstar.export.run.export import Export, ExportReport, Shard


# Frames that a dry run draws to estimate the complete export, spread evenly over it.
_SAMPLE_FRAMES = 5
# Settings that decide the size of the images.
_KEYS_OF_SIZE = {"camera.file", "camera.camera", "camera.preset", "camera.width_px", "camera.height_px"}


@with_verbosity
@with_summary_files
@with_flight_flags()
def export(
    output: Output,
    flights: Flights = None,
    *,
    exposure: ExposureTime = None,
    every: Every = None,
    at: At = None,
    flags: FlightFlags,
    start: Start = 0.0,
    stop: Stop = None,
    frames: FrameLimit = None,
    format_: Format = None,
    light: Noiseless = False,
    masks: Masks = False,
    exif: Exif = False,
    seed: Seed = 0,
    video: Video = None,
    video_fps: VideoRate = 10.0,
    workers: WorkerCount = None,
    shard: ShardText = None,
    dask: Dask = None,
    strict: Strict = False,
    navigator: NavigatorAttitude = None,
    blind: Blind = None,
    latest_frame: LatestFrame = None,
    with_truth: WithTruth = False,
    dry_run: DryRun = False,
    verify: Verify = False,
    force: Force = False,
    as_json: Json = False,
    summaries: SummaryFiles,
) -> None:
    """Write the long exposures that the camera would have taken on a flight, and where every star is on them.

    Run again, it draws the missing frames only.  Several flights, or a [sweep] in the config, make one data set.

    Try: glstar export flight.BIN -o frames --exposure 0.5 --every 3
    """
    _import_libraries()
    from glstar.export.plan.frames import ExportOptions  # noqa: PLC0415 - OpenCV, only when needed

    summaries.check(verify=verify)
    output.check(video=video, verify=verify, blind=blind, **summaries.asked)
    _refuse_contradictions(video, dask, workers, verify=verify, writes_more=any((dask, video, dry_run, force)))
    publishing = FramePublishing(latest_frame, with_truth).in_one_process(workers, dask, draws=not (verify or dry_run))
    when = {"exposure.duration_s": exposure, "exposure.interval_s": every, "exposure.at": at}
    settings = flags.settings(**when | {"navigator.attitude": navigator})
    flown = flights_of(settings, flights)
    part, known = _part_of(shard, force=force), NavigatorFiles(settings, output.directory, blind, flown)
    wanted = ExportOptions(start, stop, frames, format_, light, seed, masks, known.allows(exif=exif))
    job = _prepare(settings, known.paths, known.directory, wanted, strict=strict, video=video)
    workers = 1 if latest_frame else workers or _default_workers(len(job.numbers), part)
    if dry_run or verify:
        (_estimate if dry_run else _verify)(job, part, workers, as_json=as_json)
    else:
        known.begin()
        passed_on = publishing.of_export(job, settings, known)
        report, took_s = _draw(job, output, part, workers, dask, passed_on, force=force)
        tables = _finish(job, output, known, summaries, video, video_fps) if report.complete else ()
        _report(job, report, took_s, video, tables, as_json=as_json)


def _import_libraries() -> None:
    """Import OpenCV and OpenGL, which takes long enough to be interrupted."""
    with exit_on_interrupt():
        import glstar.export.run.prepare  # noqa: PLC0415 - only when needed
        import glstar.export.run.processes  # noqa: PLC0415
        import glstar.render.opengl  # noqa: F401, PLC0415


def _part_of(shard: str | None, *, force: bool) -> "Shard":
    """Return the shard that the options name."""
    from glstar.export.run.export import Shard  # noqa: PLC0415 - OpenCV, only when needed

    part = Shard() if shard is None else Shard.parse(shard)
    if force and not part.is_all:
        raise typer.BadParameter("would remove the frames of the other shards", param_hint="--force")
    return part


def _prepare(
    settings: "Config", paths: list[Path], output: Path, options: "ExportOptions", *, strict: bool, video: Path | None
) -> "Export":
    """Read the flights and plan their frames; print notes on how the logs were read."""
    from glstar.export.run.prepare import prepare_data_set, prepare_export  # noqa: PLC0415 - OpenCV, only when needed

    if len(paths) > 1 or settings.sweep:
        job = prepare_data_set(settings, paths, output, options, strict=strict)
        for log in job.omitted_logs:
            typer.echo(f"glstar: left out: {log.path}: {' '.join(log.reason.split())}", err=True)
    else:
        job = prepare_export(settings, paths[0], output, options)
    for name, note in job.notes:
        echo_note(f"{name}: {note}")
    if video is not None:
        _refuse_video_of_two_sizes(settings, len(paths), video)
    return job


def _refuse_contradictions(
    video: Path | None, dask: str | None, workers: int | None, *, verify: bool, writes_more: bool
) -> None:
    """Refuse options that contradict each other."""
    if video is not None and video.suffix.lower() != ".mp4":
        raise typer.BadParameter(f"{video} must end with .mp4", param_hint="--video")
    if dask is not None and workers is not None:
        raise typer.BadParameter("has workers of its own; leave out --workers", param_hint="--dask")
    if verify and writes_more:
        raise typer.BadParameter(
            "only compares; leave out --dask, --dry-run, --force and --video", param_hint="--verify"
        )


def _refuse_video_of_two_sizes(settings: "Config", flights: int, video: Path) -> None:
    """Refuse a video, before anything is drawn, if the sweep varies the size of the images."""
    keys = [axis.key for axis in settings.sweep.axes if axis.key in _KEYS_OF_SIZE]
    samples: set[tuple[object, ...]] = set()
    for flight in range(flights if keys else 0):
        samples |= set(zip(*(settings.sweep.column(key, salt=flight) for key in keys), strict=True))
    cameras = [settings.at(dict(zip(keys, values, strict=True))).camera() for values in samples]
    sizes = sorted({(camera.width_px, camera.height_px) for camera in cameras})
    if len(sizes) > 1:
        listed = " and ".join(f"{width_px} x {height_px} px" for width_px, height_px in sizes[:3])
        raise ExportError(
            video,
            f"a video has frames of one size, and {', '.join(keys)} of [sweep] makes images of {listed}; leave out"
            " --video, or export each size to a directory of its own",
        )


def _default_workers(frames: int, part: "Shard") -> int:
    """Return the number of processes for this many frames."""
    if not part.is_all:
        return 1  # the user has divided the processors already
    from glstar.export.run.executors import available_processors  # noqa: PLC0415 - OpenCV, only when needed

    return max(1, min(available_processors(), frames // FRAMES_PER_WORKER, MAX_WORKERS))


def _print_light_notes(job: "Export") -> None:
    for note in light_notes(job.task.frames):
        echo_note(f"glstar: {note}")


def _with_light_notes(job: "Export", on_frame: Callable[[int, int], None]) -> Callable[[int, int], None]:
    """Return a progress callback that first prints notes on day and ground, once the export has been accepted."""
    begun = False

    def report(done: int, frames: int) -> None:
        nonlocal begun
        if not begun:
            begun = True
            _print_light_notes(job)
        on_frame(done, frames)

    return report


def _draw(
    job: "Export",
    output: OutputPlace,
    shard: "Shard",
    workers: int,
    dask: str | None,
    passed_on: "AbstractContextManager[OnPixels | None]",
    *,
    force: bool,
) -> "tuple[ExportReport, float]":
    """Draw and write the missing frames, with a progress bar; return the report and the time taken, s."""
    began_s = time.monotonic()
    try:
        with (
            passed_on as on_pixels,
            _executor(job, workers, dask, on_pixels) as executor,
            progress_bar("frames") as on_frame,
        ):
            target = output.target(job)
            report = target.run(executor, shard=shard, force=force, on_frame=_with_light_notes(job, on_frame))
    except KeyboardInterrupt:
        typer.echo("glstar: stopped; run the same command again to go on", err=True)
        raise typer.Exit(EXIT_INTERRUPTED) from None
    return report, time.monotonic() - began_s


def _finish(
    job: "Export",
    output: OutputPlace,
    known: NavigatorFiles,
    summaries: SummaryFiles,
    video: Path | None,
    video_fps: float,
) -> tuple[Path, ...]:
    """Write what belongs to a complete export: video, the navigator's files, summaries; return the Parquet tables."""
    if video is not None:
        _write_video(job, video, video_fps)
    known.finish(job)
    return summaries.finish(job, output.directory) if output.url is None else ()


def _verify(job: "Export", shard: "Shard", workers: int, *, as_json: bool) -> None:
    """Draw all frames again, list the files that differ, and exit with status 1 if there are any."""
    from glstar.export.run.executors import SerialExecutor  # noqa: PLC0415 - OpenCV, only when needed
    from glstar.export.run.processes import ProcessExecutor  # noqa: PLC0415 - OpenCV, only when needed
    from glstar.export.run.verify import verify  # noqa: PLC0415
    from glstar.render.opengl import GLRenderer  # noqa: PLC0415 - OpenGL, only when needed

    began_s = time.monotonic()
    with ExitStack() as opened:
        on_frame = opened.enter_context(progress_bar("frames"))
        if workers > 1:
            found = verify(job, opened.enter_context(ProcessExecutor(workers)), shard=shard, on_frame=on_frame)
        else:
            renderer = opened.enter_context(GLRenderer.headless())
            found = verify(job, SerialExecutor(renderer), shard=shard, on_frame=on_frame)
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
            f"the frames were drawn by {driver}, and another driver draws other bytes: they have been decoded and"
            " compared with the truth, not drawn again",
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
        how = "byte for byte" if found.is_redrawn else "decoded, and of the size in the truth"
        typer.echo(f"{_count(found.frames)} verified in {time.monotonic() - began_s:.1f} s, {how}: {found.directory}")


@contextmanager
def _executor(
    job: "Export", workers: int, dask: str | None, on_pixels: "OnPixels | None" = None
) -> "Iterator[Executor]":
    """Open the executor that the options ask for."""
    from glstar.export.run.executors import SerialExecutor  # noqa: PLC0415 - OpenCV, only when needed
    from glstar.export.run.processes import ProcessExecutor  # noqa: PLC0415 - OpenCV, only when needed
    from glstar.render.opengl import GLRenderer  # noqa: PLC0415 - OpenGL, only when needed

    if dask is not None:
        with needing("cluster"):
            from glstar.export.run.cluster import DaskExecutor  # noqa: PLC0415 - an extra
        with DaskExecutor(dask, job.task) as cluster:
            yield cluster
    elif workers > 1:
        echo_detail(f"{workers} processes draw")
        with ProcessExecutor(workers) as processes:
            yield processes
    else:
        with GLRenderer.headless() as renderer:
            echo_detail(f"drawn by {renderer.driver}")
            yield SerialExecutor(renderer, on_pixels=on_pixels)


def _write_video(job: "Export", video: Path, frames_per_s: float) -> None:
    from glstar.export.imagefiles.formats import write_video  # noqa: PLC0415 - OpenCV, only when needed

    images = [job.task.image_path(number) for number in job.numbers.tolist()]
    write_video(images, video, frames_per_s=frames_per_s, saturation_dn=job.task.frames.saturation_dn)


def _report(
    job: "Export", report: "ExportReport", took_s: float, video: Path | None, tables: tuple[Path, ...], *, as_json: bool
) -> None:
    if note := bit_note(job.task):
        echo_note(f"glstar: {note}")
    if as_json:
        facts = {
            "directory": str(report.directory),
            "drawn": report.drawn,
            "there_already": report.there_already,
            "skipped": [asdict(frame) for frame in report.skipped],
            "left_out": _omitted(job),
            "complete": report.complete,
            "seconds": round(took_s, 3),
            "video": None if video is None else str(video),
            "tables": [str(table) for table in tables],
        }
        typer.echo(json.dumps(facts))
        return
    typer.echo(
        f"{_count(report.drawn)} drawn in {took_s:.1f} s, {report.there_already} there already: {report.directory}"
    )
    _report_skipped(report.skipped)
    if report.tables_removed and not tables:
        typer.echo("the Parquet tables had fewer frames and are removed; --parquet writes them again", err=True)
    if job.omitted_logs:
        typer.echo(f"logs left out: {len(job.omitted_logs)}, see above; --strict stops at the first", err=True)
    if not report.complete:
        typer.echo(
            "the other shards are not complete yet; the last one to finish joins the truth and writes --video and"
            " --parquet"
        )
    elif video is not None:
        typer.echo(f"video: {video}")
    for table in tables:
        typer.echo(f"table: {table}")


def _omitted(job: "Export") -> list[dict[str, str]]:
    return [{"log": str(log.path), "reason": log.reason} for log in job.omitted_logs]


def _count(frames: int) -> str:
    return "1 frame" if frames == 1 else f"{frames} frames"


def _report_skipped(skipped: "tuple[SkippedFrame, ...]") -> None:
    """Report the number of skipped frames by reason."""
    for reason, count in Counter(frame.reason for frame in skipped).most_common():
        longest = max((frame for frame in skipped if frame.reason == reason), key=lambda frame: frame.gap_s)
        meets = "its exposure meets" if count == 1 else "their exposures meet"
        typer.echo(
            f"{_count(count)} skipped, {meets} {reason} of the log;"
            f" the longest, {longest.gap_s:.3f} s, at {longest.start_s:.1f} s",
            err=True,
        )
    if any(frame.reason == DATA_GAP for frame in skipped):
        echo_note("(--max-gap SECONDS interpolates across longer gaps)")


def _image_bytes(frame: "EncodedFrame") -> int:
    """Return the size of all the images of a frame."""
    return len(frame.image) + len(frame.noiseless or b"") + sum(map(len, frame.masks.values()))


def _estimate(job: "Export", shard: "Shard", workers: int, *, as_json: bool) -> None:
    """Draw a few frames in memory, and report the estimated size and time of all."""
    from glstar.render.opengl import GLRenderer  # noqa: PLC0415 - OpenGL, only when needed

    _print_light_notes(job)
    numbers = shard.select(job.numbers)
    count = len(numbers)
    size_bytes = seconds = join_bytes = 0.0
    if count:
        sample = [int(numbers[k]) for k in np.linspace(0, count - 1, min(count, _SAMPLE_FRAMES)).round().astype(int)]
        with GLRenderer.headless() as renderer:
            job.task.draw(renderer, sample[0])  # the first frame also compiles shaders
            began_s = time.perf_counter()
            frames = [job.task.draw(renderer, number) for number in sample]
        seconds = count / len(sample) * (time.perf_counter() - began_s) / workers
        truth_bytes = count / len(sample) * sum(len(frame.truth) for frame in frames)
        size_bytes = truth_bytes + count / len(sample) * sum(map(_image_bytes, frames))
        # Parts of the truth by several processes are joined into one file before they are removed.
        join_bytes = truth_bytes if workers > 1 or not shard.is_all else 0.0
    if as_json:
        facts = {
            "frames": count,
            "skipped": len(job.task.frames.skipped),
            "left_out": _omitted(job),
            "bytes": round(size_bytes),
            "peak_bytes": round(size_bytes + join_bytes),
            "seconds": round(seconds, 1),
        }
        typer.echo(json.dumps(facts))
        return
    joining = f" ({join_bytes / 1e9:.3f} GB more while the truth is joined)" if join_bytes else ""
    typer.echo(
        f"{_count(count)} to {job.directory}: about {size_bytes / 1e9:.3f} GB{joining}"
        f" and {seconds / 60:.1f} minutes; nothing written"
    )
    _report_skipped(job.task.frames.skipped)
