"""The options of ``glstar export`` other than the flight's, and which outputs they ask for beside frames and truth.

`OutputPlace`: a directory or an object store; `SummaryFiles`: Parquet tables, splits and the data card;
`NavigatorFiles`: what a navigator knows, without the truth; `FramePublishing`: frames for other processes, as they are
drawn, also of ``glstar live``.
"""

from collections.abc import Iterator, Sequence
from contextlib import closing, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, Self

import typer

from glstar.cli.flightoptions import with_fields_as_options
from glstar.cli.reporting import echo_note
from glstar.errors import ExportError
from glstar.export.publish.stream import STREAM
from glstar.system.files import write_atomically
from glstar.system.installation import install_command

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import NDArray

    from glstar.camera.sensor.sensor import Sensor
    from glstar.config import Config
    from glstar.export.publish.outputs import FrameOutput
    from glstar.export.run.executors import OnPixels
    from glstar.export.run.export import Export
    from glstar.export.run.store import StoreExport
    from glstar.export.truth.splits import SplitRule

# Frames for which one more worker process saves time, although it needs a second to start.
FRAMES_PER_WORKER = 100
# Settings that decide the size of the images.
_KEYS_OF_SIZE = {"camera.file", "camera.camera", "camera.preset", "camera.width_px", "camera.height_px"}
# Largest default number of worker processes, because each needs memory of its own.
MAX_WORKERS = 8

Flights = Annotated[
    list[Path] | None,
    typer.Argument(
        help="Flights: logs of ArduPilot (.BIN, .log), MAVLink (.tlog), PX4 (.ulg), CSV tables; demo; or fly:orbit and"
        " other described ones (glstar manual fly).",
        show_default="the bundled flight",
    ),
]
ExposureTime = Annotated[float | None, typer.Option(help="Exposure time, s.", show_default="0.5, or the config's")]
Every = Annotated[
    float | None,
    typer.Option(help="Time from one exposure's start to the next, s.", show_default="3, or the config's"),
]
At = Annotated[
    str | None,
    typer.Option(
        help="Expose when the log says that a camera was triggered, instead of every some seconds: camera, or of"
        " several the one that glstar info lists, such as camera:1 or /cam0/camera_info.",
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
Video = Annotated[
    Path | None, typer.Option(help="Write a video of all frames too: a name.webm or name.mp4.", show_default=False)
]
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


def _recover(directory: Path | None) -> None:
    """Complete an unfinished export, and exit."""
    if directory is None:
        return
    from glstar.export.live import recover  # noqa: PLC0415 - OpenCV

    found = recover(directory)
    for image in found.damaged:
        typer.echo(f"glstar: left out: {image} is missing or damaged", err=True)
    typer.echo(f"{found.frames} frames are complete: {found.directory}")
    raise typer.Exit


Recover = Annotated[
    Path | None,
    typer.Option(
        metavar="DIR",
        help="Only complete an export, live too, that was killed: truth.jsonl of the frames that DIR has.",
        show_default=False,
        is_eager=True,
        callback=_recover,
    ),
]

Parquet = Annotated[bool, typer.Option("--parquet", help="Write the truth as Parquet tables too.")]
Split = Annotated[
    Literal["flight", "flight:exact"] | None,
    typer.Option(
        help="Write train.txt, validation.txt and test.txt: every flight with all of its frames in one list, by its"
        " hash, or exact: dealt out by the number of frames.",
        show_default="no",
    ),
]
SplitShares = Annotated[str, typer.Option(help="Shares of the flights for training, validation and test with --split.")]
SplitSeed = Annotated[int, typer.Option(help="Seed of --split.")]
Card = Annotated[
    bool | None,
    typer.Option("--card/--no-card", help="Write DATACARD.md.", show_default="yes for a data set, no for one flight"),
]
Report = Annotated[
    bool,
    typer.Option(
        "--report", help="Write index.html: frames, truth and curves as one page for a browser, without a network."
    ),
]
# Fraction of frames near one of the training from which a split is no test, and is noted.
_MOST_NEAR = 0.1
_DEFAULT_SHARES = "80,10,10"

LatestFrame = Annotated[
    str | None,
    typer.Option(
        help="Pass the frames on: shm:NAME, a file, zmq://HOST:PORT, http://HOST:PORT for a browser (MJPEG), or"
        " video:DEVICE for what reads a camera; one writer for each name.",
        show_default=False,
    ),
]
WithTruth = Annotated[bool, typer.Option("--with-truth", help="Send the truth with the frames of zmq://, too.")]


@dataclass(frozen=True, slots=True)
class OutputPlace:
    """The output that the user named: a directory or an object store."""

    directory: Path  # not used by a store
    url: str | None = None  # of the store

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
        from glstar.export.run.store import StoreExport  # noqa: PLC0415 - fsspec

        return StoreExport(job, self.url)


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


@dataclass(frozen=True, slots=True)
class SummaryFiles:
    """What to write about a complete export."""

    parquet: Parquet = False
    split: Split = None
    split_shares: SplitShares = _DEFAULT_SHARES
    split_seed: SplitSeed = 0
    card: Card = None  # None: for data sets only
    report: Report = False

    def check(self, *, verify: bool) -> None:
        """Refuse to write beside ``--verify``; raises ConfigError if the shares are not valid."""
        _ = self._rule
        flags = {"--parquet": self.parquet, "--split": self.split, "--card": self.card, "--report": self.report}
        given = [flag for flag, value in flags.items() if value]
        if verify and given:
            raise typer.BadParameter(f"only compares; leave out {' and '.join(given)}", param_hint="--verify")

    def refuse_empty_splits(self, job: "Export") -> None:
        """Raise ConfigError if a split would have no flight: hours of drawing later it would be no use."""
        if self.split is not None:
            from glstar.export.plan.dataset import DataSetFrames  # noqa: PLC0415 - OpenCV
            from glstar.export.truth.splits import refuse_empty_splits  # noqa: PLC0415 - OpenCV

            frames = job.task.frames
            samples = map(frames.settings_of, range(frames.samples)) if isinstance(frames, DataSetFrames) else [{}]
            refuse_empty_splits(self._rule, job.manifest, samples)

    @property
    def _rule(self) -> "SplitRule":
        from glstar.export.truth.splits import SplitRule  # noqa: PLC0415 - OpenCV

        return SplitRule.parse(self.split_shares, self.split_seed, is_exact=self.split == "flight:exact")

    @property
    def asked(self) -> dict[str, object]:
        """The options that ask for files, by name."""
        return {"parquet": self.parquet, "split": self.split, "card": self.card, "report": self.report}

    def finish(self, job: "Export", output: Path) -> tuple[Path, ...]:
        """Write the files of a complete export and return its Parquet tables.

        `output`: the directory that the user named; with ``--blind`` it gets the lists of the split too.
        """
        from glstar.export.directory import SPLITS  # noqa: PLC0415 - OpenCV
        from glstar.export.report.setpage import write_report  # noqa: PLC0415 - OpenCV
        from glstar.export.truth.datacard import write_card  # noqa: PLC0415 - OpenCV
        from glstar.export.truth.splits import write_splits  # noqa: PLC0415 - OpenCV

        if self.split is not None:
            written = write_splits(job.directory, self._rule)
            echo_note("split by flight: " + ", ".join(f"{split} {count}" for split, count in written.frames.items()))
            for split, fraction in written.near_train.items():
                if fraction > _MOST_NEAR:
                    echo_note(
                        f"glstar: {fraction:.0%} of the frames of {split} are within 2 deg of a frame of train, as if"
                        " flights differ in gusts alone: vary place, time, path or heading too"
                    )
            for split in SPLITS if output != job.directory else ():
                write_atomically(output / f"{split}.txt", (job.directory / f"{split}.txt").read_bytes())
        is_data_set = "flights" in job.manifest
        if self.card or (self.card is None and is_data_set):
            write_card(job.directory)
        if self.report:
            echo_note(f"page: {write_report(job.directory)}")
        return _write_parquet(job.directory) if self.parquet else ()


@contextmanager
def needing(extra: str) -> Iterator[None]:
    """Raise ExportError with the command that installs an extra of ``pyproject.toml`` if its library is missing."""
    try:
        yield
    except ImportError as error:
        raise ExportError(error.name or extra, f"is not installed; {install_command(extra)}") from error


def _write_parquet(directory: Path) -> tuple[Path, ...]:
    with needing("parquet"):
        from glstar.export.truth.parquet import write_parquet  # noqa: PLC0415 - an extra
    return write_parquet(directory)


def with_summary_files(command: "Callable[..., None]") -> "Callable[..., None]":
    """Replace the parameter ``summaries: SummaryFiles`` of a command by its options."""
    return with_fields_as_options(command, "summaries", SummaryFiles)


def note_codec(video: Path) -> None:
    """Note that a video has a codec that browsers do not play."""
    from glstar.export.imagefiles.formats import is_pyav_installed  # noqa: PLC0415 - OpenCV

    if video.suffix.lower() == ".mp4" and not is_pyav_installed():
        better = f"write {video.with_suffix('.webm').name}, or: {install_command('film')}"
        echo_note(f"glstar: {video.name} has MPEG-4 part 2, which browsers and notebooks do not play; {better}")


def refuse_video_of_two_sizes(settings: "Config", flights: int, video: Path) -> None:
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


class NavigatorFiles:
    """``nav.jsonl`` of an export, and the directory for a navigator from whom the truth is hidden.

    `output`: the directory that the user named; `blind`: the directory for the truth, if it is hidden; `paths`: the
    flights.
    """

    def __init__(self, settings: "Config", output: Path, blind: Path | None, paths: Sequence[Path]) -> None:
        self._settings = settings
        self._output = output
        self._blind = blind
        self.paths = list(paths)
        self._is_wanted = blind is not None or "navigator" in settings.resolved()
        if blind is not None and _overlap(output, blind):
            raise typer.BadParameter(
                f"{blind} and {output} lie in each other: the navigator would see the truth", param_hint="--blind"
            )

    @property
    def directory(self) -> Path:
        """The directory of the export itself, with the truth."""
        return self._output if self._blind is None else self._blind

    def allows(self, *, exif: bool) -> bool:
        """Return whether images have EXIF; refuse it in the images of a navigator from whom the truth is hidden."""
        if exif and self._blind is not None:
            raise typer.BadParameter(
                "states the true time and position in each image; nav.jsonl has what the navigator knows",
                param_hint="--exif",
            )
        return exif

    def start_s(self, start_s: float) -> float:
        """Return when the exposures begin, s from the first attitude: a random fraction later in a blind set."""
        if self._blind is None:
            return start_s
        from glstar.export.navigator import blind_phase_s  # noqa: PLC0415 - OpenCV

        return start_s + blind_phase_s(self._settings)

    def begin(self) -> None:
        """Remove an older ``nav.jsonl`` before frames are drawn; refuse a directory with files of another export."""
        from glstar.export.navigator import refuse_other_files, remove_nav  # noqa: PLC0415 - OpenCV

        if self._blind is not None:
            refuse_other_files(self._output)
        remove_nav(self.directory)

    def used(self, job: "Export") -> list[Path]:
        """Return the flights of which there are frames."""
        omitted = {log.path for log in job.omitted_logs}
        return [path for path in self.paths if path not in omitted]

    def finish(self, job: "Export") -> None:
        """Write ``nav.jsonl`` of a complete export, and hand images and ``nav.jsonl`` to the navigator."""
        if not self._is_wanted:
            return
        from glstar.export.navigator import estimates, publish_blind, write_nav  # noqa: PLC0415 - OpenCV

        write_nav(job, self._settings, estimates(self._settings, self.used(job)))
        if self._settings.navigator.is_perfect and not any(
            axis.key.startswith("navigator.") for axis in self._settings.sweep.axes
        ):
            echo_note(
                "glstar: the navigator's attitude has no error, and nav.jsonl has the true one; give it errors in"
                " [navigator], or a message with --navigator"
            )
        if self._blind is not None:
            publish_blind(job, self._output)
            echo_note(f"for the navigator, without the truth: {self._output}")
            section = self._settings.navigator
            if section.errors.is_random and section.seed == type(section)().seed:
                echo_note(
                    "glstar: the errors of nav.jsonl are drawn from the default seed, which everybody knows; give"
                    " navigator.seed a number of your own"
                )
            if job.task.seed == 0:
                echo_note(
                    "glstar: the noise of the images is drawn from the default seed: who has glstar can subtract it;"
                    " give --seed a number of your own"
                )


def _overlap(one: Path, other: Path) -> bool:
    """Return whether one directory is the other, or lies in it."""
    first, second = one.resolve(), other.resolve()
    return first.is_relative_to(second) or second.is_relative_to(first)


@dataclass(frozen=True, slots=True)
class FramePublishing:
    """An output of frames to other processes."""

    where: str | None  # the value of ``--latest-frame``
    with_truth: bool = False  # whether ``zmq://`` sends the truth too

    def __post_init__(self) -> None:
        if self.with_truth and not (self.where or "").startswith(STREAM):
            raise typer.BadParameter("belongs to --latest-frame zmq://...", param_hint="--with-truth")

    def without_truth(self, blind: Path | None) -> Self:
        """Return itself; refuse an output of a blind export that passes the truth on."""
        has_truth = self.with_truth or not (self.where or "").startswith((STREAM, "http://", "video:"))
        if blind is not None and self.where is not None and has_truth:
            raise typer.BadParameter(
                "would pass on the truth that --blind hides; take zmq://, http:// or video:, without --with-truth",
                param_hint="--latest-frame",
            )
        return self

    def in_one_process(self, workers: int | None, dask: str | None, *, draws: bool) -> Self:
        """Return itself; refuse frames that several processes draw (`workers`, `dask`), or that are not written."""
        problem = None
        if dask is not None or (workers or 1) > 1:
            problem = "passes on what this process draws; leave out --workers and --dask"
        elif not draws:
            problem = "passes on frames that are drawn; leave out --dry-run and --verify"
        if self.where is not None and problem is not None:
            raise typer.BadParameter(problem, param_hint="--latest-frame")
        return self

    def opened(self, settings: "Config", sensor: "Sensor") -> "FrameOutput":
        """Open the output for frames of a sensor; the caller closes it."""
        from glstar.export.publish.outputs import open_frame_output  # noqa: PLC0415 - OpenCV

        assert self.where is not None
        exposure = settings.exposure
        return open_frame_output(
            self.where,
            settings.camera(),
            sensor,
            interval_s=exposure.interval_s,
            summed=exposure.signal_factor,
            with_truth=self.with_truth,
        )

    @contextmanager
    def of_export(self, job: "Export", settings: "Config", known: NavigatorFiles) -> "Iterator[OnPixels | None]":
        """Open the output and yield the function that `SerialExecutor` calls with each frame; None without one."""
        if self.where is None:
            yield None
            return
        from glstar.export.navigator import NavRecords, estimates  # noqa: PLC0415 - OpenCV

        records = NavRecords(job.task, settings, estimates(settings, known.used(job)))
        sensor = job.task.frames.shot(int(job.numbers[0])).simulator.sensor
        with closing(self.opened(settings, sensor)) as output:

            def publish(number: int, pixels: "NDArray[Any]", truth: bytes) -> None:
                output.write(pixels, truth, records.of(number))

            yield publish
