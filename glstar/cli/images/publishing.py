"""Frames of ``glstar export`` and ``glstar live`` to other processes while they are drawn.

The part of ``glstar export`` that writes what a navigator knows, and hides the truth from it.
"""

from collections.abc import Iterator, Sequence
from contextlib import closing, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Self

import typer

from glstar.cli.verbosity import echo_note
from glstar.export.publish.stream import STREAM

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from glstar.camera.sensor.sensor import Sensor
    from glstar.config import Config
    from glstar.export.publish.outputs import FrameOutput
    from glstar.export.run.executors import OnPixels
    from glstar.export.run.export import Export


class NavigatorFiles:
    """``nav.jsonl`` of an export, and the directory for the navigator if the truth is to be hidden.

    `output`: the directory that the user asked for; `blind`: where the truth goes instead; `paths`: the flights.
    """

    def __init__(self, settings: "Config", output: Path, blind: Path | None, paths: Sequence[Path]) -> None:
        self._settings, self._output, self._blind = settings, output, blind
        self.paths = list(paths)
        self._is_wanted = blind is not None or "navigator" in settings.resolved()
        if blind is not None and _is_within(output, blind):
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

    def begin(self) -> None:
        """Remove an older ``nav.jsonl`` before frames are drawn; refuse a directory with files of another export."""
        from glstar.export.navigator import refuse_other_files, remove_nav  # noqa: PLC0415 - OpenCV, only when needed

        if self._blind is not None:
            refuse_other_files(self._output)
        remove_nav(self.directory)

    def used(self, job: "Export") -> list[Path]:
        """Return the flights of which there are frames."""
        left_out = {log.path for log in job.omitted_logs}
        return [path for path in self.paths if path not in left_out]

    def finish(self, job: "Export") -> None:
        """Write ``nav.jsonl`` of a complete export, and hand images and ``nav.jsonl`` to the navigator."""
        if not self._is_wanted:
            return
        from glstar.export.navigator import estimates, publish_blind, write_nav  # noqa: PLC0415

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


def _is_within(one: Path, other: Path) -> bool:
    """Return whether one directory lies in the other, or is the same."""
    first, second = one.resolve(), other.resolve()
    return first.is_relative_to(second) or second.is_relative_to(first)


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
class FramePublishing:
    """Where frames go besides files."""

    where: str | None  # As of `--latest-frame`
    with_truth: bool = False  # Whether ``zmq://`` sends the truth, too

    def __post_init__(self) -> None:
        if self.with_truth and not (self.where or "").startswith(STREAM):
            raise typer.BadParameter("belongs to --latest-frame zmq://...", param_hint="--with-truth")

    def in_one_process(self, workers: int | None, dask: str | None, *, draws: bool) -> Self:
        """Refuse frames that several processes draw, or none.

        `workers`: number of processes, if it is given; `draws`: whether frames are drawn to be written.  Returns:
        itself.
        """
        problem = None
        if dask is not None or (workers or 1) > 1:
            problem = "passes on what this process draws; leave out --workers and --dask"
        elif not draws:
            problem = "passes on frames that are drawn; leave out --dry-run and --verify"
        if self.where is not None and problem is not None:
            raise typer.BadParameter(problem, param_hint="--latest-frame")
        return self

    def opened(self, settings: "Config", sensor: "Sensor") -> "FrameOutput":
        """Open the output.

        `sensor`: of the frames.  Returns the caller closes it.
        """
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
        """Open the output, and yield what `SerialExecutor` calls with each frame; None without an output.

        `known`: names the flights.
        """
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
