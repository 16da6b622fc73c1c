"""Options of ``glstar export``, besides those of the flight.

Where ``glstar export`` writes: a directory, or an object store.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Final, Literal, Self

import typer

from glstar.errors import ExportError

if TYPE_CHECKING:
    from glstar.export.run.export import Export
    from glstar.export.run.store import StoreExport


@dataclass(frozen=True, slots=True)
class OutputPlace:
    """The output that the user named."""

    directory: Path  # Not used by a store
    url: str | None = None  # Of a store

    @classmethod
    def parse(cls, text: str) -> Self:
        """Return the output of a command line."""
        return cls(Path(text), text if "://" in text else None)

    def check(self, **options: object) -> None:
        """Refuse options that need the files in a directory; the keywords are their names."""
        given = [f"--{name}" for name, value in options.items() if value]
        if self.url is not None and given:
            raise typer.BadParameter(
                f"an object store gets frames and truth alone; leave out {' and '.join(given)}, or export to a"
                " directory",
                param_hint="--output",
            )

    def target(self, job: "Export") -> "Export | StoreExport":
        """Return what draws and writes the frames."""
        if self.url is None:
            return job
        if "navigator" in job.manifest["config"]:
            raise ExportError(self.url, "a store gets no nav.jsonl; leave out [navigator], or export to a directory")
        from glstar.export.run.store import StoreExport  # noqa: PLC0415 - only when needed

        return StoreExport(job, self.url)


# Frames for which an additional worker process saves time, despite the second that it needs to start.
FRAMES_PER_WORKER: Final = 100
# Default limit of worker processes, for each needs memory of its own.
MAX_WORKERS: Final = 8

Output = Annotated[
    OutputPlace,
    typer.Option(
        "-o",
        "--output",
        help="The output directory, or s3://BUCKET/PREFIX and other object stores of fsspec.",
        show_default=False,
        parser=OutputPlace.parse,
        metavar="DIRECTORY",
    ),
]
Flights = Annotated[
    list[Path] | None,
    typer.Argument(
        help="Flight logs: ArduPilot .BIN or .log, MAVLink .tlog, PX4 .ulg, or CSV tables.",
        show_default="the bundled flight",
    ),
]
ExposureTime = Annotated[float | None, typer.Option(help="Exposure time, s.", show_default="0.5, or the config's")]
Every = Annotated[
    float | None,
    typer.Option(help="Time from one exposure's start to the next, s.", show_default="3, or the config's"),
]
At = Annotated[
    Literal["camera"] | None,
    typer.Option(
        help="Expose when the log says that the camera was triggered (CAM, TRIG, CAMERA_FEEDBACK, camera_capture),"
        " instead of every some seconds.",
        show_default="a regular interval",
    ),
]
Start = Annotated[float, typer.Option(help="Start of the first exposure, s from the flight's first attitude.")]
Stop = Annotated[
    float | None, typer.Option(help="End of the last exposure, s from the first attitude.", show_default="the end")
]
FrameLimit = Annotated[int | None, typer.Option(help="Maximum number of frames.", show_default="all")]
Noiseless = Annotated[
    bool, typer.Option("--light", help="Write the signal before noise beside each frame, as float32 TIFF.")
]
Masks = Annotated[
    bool,
    typer.Option(
        "--masks",
        help="Write masks beside each frame, as PNG: which star each pixel shows (.trails), which pixels are"
        " saturated (.saturated), and with [cloud] and [flare] what cloud transmits (.cloud) and the flare (.flare).",
    ),
]
Exif = Annotated[bool, typer.Option("--exif", help="Write UTC, exposure time and position into each image, as EXIF.")]
Seed = Annotated[int, typer.Option(help="Seed of the noise.", min=0)]
Video = Annotated[Path | None, typer.Option(help="Write a video of all frames too: a name.mp4.", show_default=False)]
VideoRate = Annotated[float, typer.Option(help="Frame rate of the video, 1/s.", min=0.1, max=240)]
WorkerCount = Annotated[
    int | None,
    typer.Option(
        help="Number of processes that draw, each with an OpenGL context of its own.",
        min=1,
        max=256,
        show_default=f"one per processor and {FRAMES_PER_WORKER} frames, at most {MAX_WORKERS}; 1 with --shard",
    ),
]
ShardText = Annotated[
    str | None,
    typer.Option(
        metavar="K/N",
        help="Draw every Nth frame only, from the Kth on (K from 1); N such jobs fill one directory.",
        show_default="all",
    ),
]
Dask = Annotated[
    str | None, typer.Option(metavar="ADDRESS", help="Draw on the workers of a Dask scheduler.", show_default="no")
]
Strict = Annotated[
    bool,
    typer.Option("--strict", help="Stop at a log that cannot be exported; without it, one of several is left out."),
]
NavigatorAttitude = Annotated[
    str | None,
    typer.Option(
        "--navigator",
        metavar="MESSAGE",
        help="Write nav.jsonl, what the aircraft knows: with the attitude of this message, such as ATT, or of the error"
        ' "model" of [navigator].',
        show_default="no, unless the config has [navigator]",
    ),
]
Blind = Annotated[
    Path | None,
    typer.Option(
        metavar="DIR",
        help="Write truth and settings into DIR instead; the output directory has only images and nav.jsonl.",
        show_default=False,
    ),
]
DryRun = Annotated[
    bool, typer.Option("--dry-run", help="Estimate the number of frames, bytes and minutes; write nothing.")
]
Verify = Annotated[
    bool, typer.Option("--verify", help="Write nothing: draw all frames again and list the files that differ.")
]
Force = Annotated[bool, typer.Option("--force", help="Start over: remove the frames in the directory.")]
Json = Annotated[bool, typer.Option("--json", help="Report as JSON.")]
