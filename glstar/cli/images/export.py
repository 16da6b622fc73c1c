"""``glstar export``: frames of a flight, with the truth beside them."""

import json
import time
from collections import Counter
from collections.abc import Callable
from contextlib import contextmanager
from dataclasses import asdict
from math import asin, degrees
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import typer

from glstar.camera.mounts import mount_label
from glstar.cli.flightoptions import FlightFlags, Format, flights_of, note_swept, with_flight_flags
from glstar.cli.images import exportoptions as options
from glstar.cli.reporting import echo_detail, echo_note, progress_bar, resumable
from glstar.flight import DATA_GAP
from glstar.render.truth.conditions import conditions_report
from glstar.sky.observed.stars import sun_altitude_rad
from glstar.sky.place.timescale import earth_orientation_note, has_earth_orientation
from glstar.system.process import exit_on_interrupt

if TYPE_CHECKING:
    from collections.abc import Iterator
    from contextlib import AbstractContextManager

    from glstar.config import Config
    from glstar.export.frame import EncodedFrame, FrameTask
    from glstar.export.plan.frames import ExportOptions, Frames, Shot, SkippedFrame
    from glstar.export.run.executors import Executor, OnPixels
    from glstar.export.run.export import Export, ExportReport, Shard


# Frames that a dry run draws to estimate the complete export, spread evenly over it.
_SAMPLE_FRAMES = 5
# Frames that are checked for day and ground, spread evenly over an export.
_CHECKED = 24
# With the Sun higher than this, deg, the sky hides all but the brightest stars: the end of civil twilight.
_DAY_DEG = -6.0
# Bits at which full scale is at most a quarter of a 16-bit file's white.
_MAX_BITS = 14


@options.with_summary_files
@with_flight_flags()
def export(
    output: options.Output,
    flights: options.Flights = None,
    *,
    exposure: options.ExposureTime = None,
    every: options.Every = None,
    at: options.At = None,
    flags: FlightFlags,
    start: options.Start = 0.0,
    stop: options.Stop = None,
    frames: options.FrameLimit = None,
    format_: Format = None,
    light: options.Noiseless = False,
    masks: options.Masks = False,
    exif: options.Exif = False,
    seed: options.Seed = 0,
    video: options.Video = None,
    video_fps: options.VideoRate = 10.0,
    workers: options.WorkerCount = None,
    shard: options.ShardText = None,
    dask: options.Dask = None,
    strict: options.Strict = False,
    navigator: options.NavigatorAttitude = None,
    blind: options.Blind = None,
    latest_frame: options.LatestFrame = None,
    with_truth: options.WithTruth = False,
    dry_run: options.DryRun = False,
    verify: options.Verify = False,
    force: options.Force = False,
    recover: options.Recover = None,  # noqa: ARG001 - its callback does all of it
    as_json: options.Json = False,
    summaries: options.SummaryFiles,
) -> None:
    """Write the long exposures that the camera would have taken on a flight, and where every star is on them.

    Run again, it draws the missing frames only.  Several flights, or a [sweep] in the config, make one data set.

    Try: glstar export flight.BIN -o frames --exposure 0.5 --every 3
    """
    _import_libraries()
    from glstar.export.plan.frames import ExportOptions  # noqa: PLC0415 - OpenCV

    summaries.check(verify=verify)
    output.check(video=video, verify=verify, blind=blind, **summaries.asked)
    _refuse_contradictions(video, dask, workers, verify=verify, writes_more=any((dask, video, dry_run, force)))
    publishing = options.FramePublishing(latest_frame, with_truth).without_truth(blind)
    publishing.in_one_process(workers, dask, draws=not (verify or dry_run))
    exposures = {"exposure.duration_s": exposure, "exposure.interval_s": every, "exposure.at": at}
    settings = flags.settings(**exposures, **{"navigator.attitude": navigator})
    part = _part_of(shard, force=force)
    known = options.NavigatorFiles(settings, output.directory, blind, flights_of(settings, flights))
    exif, start = known.allows(exif=exif), known.start_s(start)
    wanted = ExportOptions(
        start, stop, frames=frames, image_format=format_, noiseless=light, seed=seed, masks=masks, exif=exif
    )
    job = _prepare(settings, known, wanted, summaries, strict=strict, video=video, dry_run=dry_run)
    workers = 1 if latest_frame else workers or _default_workers(len(job.numbers), part)
    if dry_run:
        _estimate(job, part, workers, as_json=as_json)
    elif verify:
        _verify(job, part, workers, as_json=as_json)
    else:
        known.begin()
        passed_on = publishing.of_export(job, settings, known)
        report, took_s = _draw(job, output, part, workers, dask, passed_on, force=force)
        tables = _finish(job, output, known, summaries, video, video_fps) if report.complete else ()
        _report(job, report, took_s, video, tables, as_json=as_json)


def _import_libraries() -> None:
    """Import OpenCV and OpenGL, which takes long enough to be interrupted."""
    with exit_on_interrupt():
        import glstar.export.run.prepare  # noqa: PLC0415 - OpenCV
        import glstar.export.run.processes  # noqa: PLC0415 - OpenCV
        import glstar.render.opengl  # noqa: F401, PLC0415 - OpenGL


def _part_of(shard: str | None, *, force: bool) -> "Shard":
    """Return the shard that the options name."""
    from glstar.export.run.export import Shard  # noqa: PLC0415 - OpenCV

    part = Shard() if shard is None else Shard.parse(shard)
    if force and not part.is_all:
        raise typer.BadParameter("would remove the frames of the other shards", param_hint="--force")
    return part


def _prepare(
    settings: "Config",
    known: options.NavigatorFiles,
    wanted: "ExportOptions",
    summaries: options.SummaryFiles,
    *,
    strict: bool,
    video: Path | None,
    dry_run: bool,
) -> "Export":
    """Read the flights and plan their frames; print notes on how the logs were read."""
    from glstar.export.run.prepare import prepare_data_set, prepare_export  # noqa: PLC0415 - OpenCV

    paths = known.paths
    if len(paths) > 1 or settings.sweep:
        note_swept(settings)
        job = prepare_data_set(settings, paths, known.directory, wanted, strict=strict)
        for log in job.omitted_logs:
            typer.echo(f"glstar: left out: {log.path}: {' '.join(log.reason.split())}", err=True)
    else:
        job = prepare_export(settings, paths[0], known.directory, wanted)
    for name, note in job.notes:
        echo_note(f"{name}: {note}")
    if video is not None:
        options.refuse_video_of_two_sizes(settings, len(paths), video)
    summaries.refuse_empty_splits(job)
    return _controlled(job) if job.is_controlled and not dry_run else job


def _controlled(job: "Export") -> "Export":
    """Return the export with the exposure times and gains of its exposure control, which draws every frame."""
    from glstar.render.opengl import GLRenderer  # noqa: PLC0415 - OpenGL

    with exit_on_interrupt(), GLRenderer.headless() as renderer, progress_bar("exposures") as on_frame:
        return job.controlled(renderer, on_frame)


def _refuse_contradictions(
    video: Path | None, dask: str | None, workers: int | None, *, verify: bool, writes_more: bool
) -> None:
    """Refuse options that contradict each other."""
    if video is not None and video.suffix.lower() not in (".webm", ".mp4"):
        raise typer.BadParameter(f"{video} must end with .webm or .mp4", param_hint="--video")
    if dask is not None and workers is not None:
        raise typer.BadParameter("has workers of its own; leave out --workers", param_hint="--dask")
    if verify and writes_more:
        advice = "only compares; leave out --dask, --dry-run, --force and --video"
        raise typer.BadParameter(advice, param_hint="--verify")


def _default_workers(frames: int, part: "Shard") -> int:
    """Return the number of processes for this many frames."""
    if not part.is_all:
        return 1  # the user has divided the processors already
    from glstar.export.run.executors import available_processors  # noqa: PLC0415 - OpenCV

    return max(1, min(available_processors(), frames // options.FRAMES_PER_WORKER, options.MAX_WORKERS))


def _print_light_notes(job: "Export") -> None:
    for note in _light_notes(job.task.frames):
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
    output: options.OutputPlace,
    shard: "Shard",
    workers: int,
    dask: str | None,
    passed_on: "AbstractContextManager[OnPixels | None]",
    *,
    force: bool,
) -> "tuple[ExportReport, float]":
    """Draw and write the missing frames, with a progress bar; return the report and the time taken, s."""
    began_s = time.monotonic()
    with (
        resumable(),
        passed_on as on_pixels,
        _executor(job, workers, dask, on_pixels) as executor,
        progress_bar("frames") as on_frame,
    ):
        target = output.target(job)
        report = target.run(executor, shard=shard, force=force, on_frame=_with_light_notes(job, on_frame))
    return report, time.monotonic() - began_s


def _finish(
    job: "Export",
    output: options.OutputPlace,
    known: options.NavigatorFiles,
    summaries: options.SummaryFiles,
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
    from glstar.export.run.processes import local_executor  # noqa: PLC0415 - OpenCV
    from glstar.export.run.verify import verify  # noqa: PLC0415 - OpenCV

    began_s = time.monotonic()
    with progress_bar("frames") as on_frame, local_executor(workers) as executor:
        outcome = verify(job, executor, shard=shard, on_frame=on_frame)
        driver = outcome.drawn_by
    if as_json:
        facts = {
            "directory": str(outcome.directory),
            "frames": outcome.frames,
            "drawn_again": outcome.is_redrawn,
            "renderer": driver,
            "findings": [asdict(finding) for finding in outcome.findings],
            "seconds": round(time.monotonic() - began_s, 3),
        }
        typer.echo(json.dumps(facts))
    for finding in outcome.findings if not as_json else ():
        typer.echo(f"{finding.file}: {finding.problem}")
    if not outcome.is_redrawn:
        typer.echo(
            f"the frames were drawn by {driver}, and another driver draws other bytes: they have been decoded and"
            " compared with the truth, not drawn again",
            err=True,
        )
    if outcome.findings:
        files = len({finding.file for finding in outcome.findings})
        typer.echo(
            f"glstar: {outcome.directory}: {files} file{'s are' if files != 1 else ' is'} wrong; remove"
            f" {'them' if files != 1 else 'it'} and run the same command without --verify: it draws the missing frames",
            err=True,
        )
        raise typer.Exit(1)
    if not as_json:
        how = "byte for byte" if outcome.is_redrawn else "decoded, and of the size in the truth"
        typer.echo(
            f"{_count(outcome.frames)} verified in {time.monotonic() - began_s:.1f} s, {how}: {outcome.directory}"
        )


@contextmanager
def _executor(
    job: "Export", workers: int, dask: str | None, on_pixels: "OnPixels | None" = None
) -> "Iterator[Executor]":
    """Open the executor that the options ask for."""
    from glstar.export.run.processes import local_executor  # noqa: PLC0415 - OpenCV

    if dask is not None:
        with options.needing("cluster"):
            from glstar.export.run.cluster import DaskExecutor  # noqa: PLC0415 - an extra
        with DaskExecutor(dask, job.task) as cluster:
            yield cluster
        return
    if workers > 1:
        echo_detail(f"{workers} processes draw")
    with local_executor(workers, on_pixels) as local:
        if workers <= 1:
            echo_detail(f"drawn by {local.driver}")
        yield local


def _write_video(job: "Export", video: Path, frames_per_s: float) -> None:
    from glstar.export.imagefiles.formats import write_video  # noqa: PLC0415 - OpenCV

    options.note_codec(video)
    images = [job.task.image_path(number) for number in job.numbers.tolist()]
    write_video(images, video, frames_per_s=frames_per_s, saturation_dn=job.task.frames.saturation_dn)


def _report(
    job: "Export", report: "ExportReport", took_s: float, video: Path | None, tables: tuple[Path, ...], *, as_json: bool
) -> None:
    if note := _bit_note(job.task):
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
    from glstar.render.opengl import GLRenderer  # noqa: PLC0415 - OpenGL

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


def _light_notes(frames: "Frames") -> list[str]:
    """Return notes on day, on a camera that sees only the ground, on a natural sky, and on old satellites."""
    if not len(frames.numbers):
        return []
    numbers = frames.numbers[np.unique(np.linspace(0, len(frames.numbers) - 1, _CHECKED).astype(np.intp))]
    checked = [_sun_and_ground(frames.shot(int(number))) for number in numbers]
    grounded = sum(sees_ground for _, sees_ground in checked)
    notes = []
    middle = frames.shot(int(frames.numbers[len(frames.numbers) // 2]))
    if grounded:
        notes.append(
            f"{_of_checked(grounded, len(checked))} show only the ground, because the camera points below the horizon"
            f" ({mount_label(middle.simulator.mount)}): --mount or [mount] says how it is mounted"
        )
    by_day = sum(sun > _DAY_DEG for sun, _ in checked)
    if by_day:
        notes.append(
            f"{_of_checked(by_day, len(checked))} are of day or bright twilight, with the Sun up to"
            f' {max(checked)[0]:.0f} deg high: a camera sees no stars then; [sky] brightness = "natural" shows it'
        )
    if middle.simulator.sensor.effects.get("sky.brightness") == "natural":
        notes.append(f"the middle frame: {conditions_report(middle.simulator.scene(middle.exposure))}")
    satellites = middle.simulator.sky.satellites
    if satellites is not None and (note := satellites.age_note(middle.exposure.mid_utc_s)):
        notes.append(note)
    # Without the package, UT1 = UTC for every flight: the manual says it.
    is_from_table = middle.simulator.sky.dut1_s is None and has_earth_orientation()
    if is_from_table and (note := earth_orientation_note(middle.exposure.mid_utc_s)):
        notes.append(note)
    return notes


def _of_checked(count: int, checked: int) -> str:
    return "all frames" if count == checked else f"{count} of {checked} frames checked"


def _sun_and_ground(shot: "Shot") -> tuple[float, bool]:
    """Return the altitude of the Sun, deg, and whether a frame shows only the ground."""
    simulator, mid_s = shot.simulator, shot.exposure.mid_utc_s
    (samples,) = simulator.motion.at(np.array([mid_s]))
    altitude_rad = asin(float(np.clip(samples.pointing.boresight_eq[0] @ samples.pointing.zenith_eq[0], -1, 1)))
    highest_rad = altitude_rad + simulator.camera.field_radius_rad
    return degrees(sun_altitude_rad(mid_s, samples.site)), highest_rad < asin(samples.pointing.sine_horizon)


def _bit_note(task: "FrameTask") -> str:
    """Return a note on images of few bits in files of 16; empty for FITS, which astronomical viewers stretch."""
    from glstar.export.imagefiles.processing import CameraProcessing  # noqa: PLC0415 - OpenCV

    if task.image_format not in {"png16", "tiff"} or not len(task.frames.numbers):
        return ""
    sensor = task.frames.shot(int(task.frames.numbers[0])).simulator.sensor
    processing, largest_dn = CameraProcessing.of(sensor), task.frames.saturation_dn
    bits = largest_dn.bit_length()
    if processing.is_active or processing.align == "high" or bits > _MAX_BITS:
        return ""
    return (
        f"pixels hold {bits} bits, 0 to {largest_dn}, in files of 16: image viewers show them almost black. [output]"
        ' align = "high" shifts them to the highest bits; [output] process = "isp" develops them'
    )
