"""``glstar export``: frames of a flight, with the truth beside them."""

import json
import time
from collections import Counter
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from glstar.cli.flightoptions import Flight, FlightFlags, Format, log_of, with_flight_flags
from glstar.cli.progress import progress_bar
from glstar.track import SILENCE

if TYPE_CHECKING:
    from glstar.export import Export, SkippedFrame
    from glstar.gl import GLRenderer

__all__ = ["export"]


@with_flight_flags()
def export(
    output: Annotated[Path, typer.Option("-o", "--output", help="The directory to fill.", show_default=False)],
    flight: Flight = None,
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
    dry_run: Annotated[
        bool, typer.Option("--dry-run", help="Say how many frames, bytes and minutes; write nothing.")
    ] = False,
    force: Annotated[bool, typer.Option("--force", help="Start over: remove the frames that are there.")] = False,
    as_json: Annotated[bool, typer.Option("--json", help="Report as JSON.")] = False,
) -> None:
    """Write the long exposures that the camera would have taken on a flight, and where every star is on them.

    Run again, it finishes what is missing and leaves what is there.

    Try: glstar export flight.BIN -o frames --exposure 0.5 --every 3
    """
    from glstar.export import Alone, prepare, write_video  # noqa: PLC0415 - OpenCV, when it is needed
    from glstar.gl import GLRenderer  # noqa: PLC0415 - OpenGL, when it is needed

    if video is not None and video.suffix.lower() != ".mp4":
        raise typer.BadParameter(f"{video} must end with .mp4", param_hint="--video")
    settings = flags.settings(**{"exposure.duration_s": exposure, "exposure.interval_s": every})
    job = prepare(
        settings,
        log_of(flight),
        output,
        start_s=start,
        stop_s=stop,
        frames=frames,
        image_format=format_,
        light=light,
        seed=seed,
    )
    with GLRenderer.headless() as renderer:
        if dry_run:
            _say_what_would_be_done(job, renderer, as_json=as_json)
            return
        began_s = time.monotonic()
        try:
            with progress_bar("frames") as on_frame:
                report = job.run(Alone(renderer), force=force, on_frame=on_frame)
        except KeyboardInterrupt:
            typer.echo("glstar: stopped; run the same command again to go on", err=True)
            raise typer.Exit(130) from None
        took_s = time.monotonic() - began_s
    if video is not None:
        images = [job.image_path(number) for number in job.frames.numbers.tolist()]
        write_video(images, video, frames_per_s=video_fps, saturation_dn=job.frames.saturation_dn)

    if as_json:
        facts = {
            "directory": str(report.directory),
            "drawn": report.drawn,
            "there_already": report.there_already,
            "skipped": [asdict(frame) for frame in report.skipped],
            "seconds": round(took_s, 3),
            "video": None if video is None else str(video),
        }
        typer.echo(json.dumps(facts))
        return
    typer.echo(
        f"{_counted(report.drawn)} drawn in {took_s:.1f} s, {report.there_already} there already: {report.directory}"
    )
    _say_what_was_skipped(report.skipped)
    if video is not None:
        typer.echo(f"video: {video}")


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
    if any(frame.reason == SILENCE for frame in skipped):
        typer.echo("(--max-gap SECONDS interpolates across longer silences)", err=True)


def _say_what_would_be_done(job: "Export", renderer: "GLRenderer", *, as_json: bool) -> None:
    """Draw the first frame, in memory, and say what all of them take."""
    count = len(job.frames.numbers)
    size_bytes = seconds = 0.0
    if count:
        first = int(job.frames.numbers[0])
        job.draw(renderer, first)  # the first one ever also warms the driver up
        began_s = time.perf_counter()
        frame = job.draw(renderer, first)
        seconds = count * (time.perf_counter() - began_s)
        size_bytes = count * (len(frame.image) + len(frame.light or b"") + len(frame.truth))
    if as_json:
        facts = {
            "frames": count,
            "skipped": len(job.frames.skipped),
            "bytes": round(size_bytes),
            "seconds": round(seconds, 1),
        }
        typer.echo(json.dumps(facts))
        return
    typer.echo(
        f"{_counted(count)} to {job.directory}: about {size_bytes / 1e9:.3f} GB and {seconds / 60:.1f} minutes;"
        " nothing written"
    )
    _say_what_was_skipped(job.frames.skipped)
