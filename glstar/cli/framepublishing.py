"""Frames of ``glstar export`` and ``glstar live`` to other processes while they are drawn."""

from collections.abc import Iterator
from contextlib import closing, contextmanager
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, Any, Self

import typer

from glstar.cli.navigatorfiles import NavigatorFiles
from glstar.export.framestream import STREAM

if TYPE_CHECKING:  # these modules import OpenCV and OpenGL
    from numpy.typing import NDArray

    from glstar.camera.sensor import Sensor
    from glstar.config import Config
    from glstar.export.executors import OnPixels
    from glstar.export.frameoutputs import FrameOutput
    from glstar.export.run import Export

__all__ = ["FramePublishing", "LatestFrame", "WithTruth"]

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
    """Where frames go besides files.

    Attributes
    ----------
    where : str or None
        As of `--latest-frame`.
    with_truth : bool
        Whether ``zmq://`` sends the truth, too.
    """

    where: str | None
    with_truth: bool = False

    def __post_init__(self) -> None:
        if self.with_truth and not (self.where or "").startswith(STREAM):
            raise typer.BadParameter("belongs to --latest-frame zmq://...", param_hint="--with-truth")

    def in_one_process(self, workers: int | None, dask: str | None, *, draws: bool) -> Self:
        """Refuse frames that several processes draw, or none.

        Parameters
        ----------
        workers : int or None
            Number of processes, if it is given.
        dask : str or None
        draws : bool
            Whether frames are drawn to be written.

        Returns
        -------
        FramePublishing
            Itself.
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

        Parameters
        ----------
        settings : Config
        sensor : Sensor
            Of the frames.

        Returns
        -------
        FrameOutput
            The caller closes it.
        """
        from glstar.export.frameoutputs import open_frame_output  # noqa: PLC0415 - OpenCV

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

        Parameters
        ----------
        job : Export
        settings : Config
        known : NavigatorFiles
            Names the flights.
        """
        if self.where is None:
            yield None
            return
        from glstar.export.navfile import NavRecords, estimates  # noqa: PLC0415 - OpenCV

        records = NavRecords(job.task, settings, estimates(settings, known.used(job)))
        sensor = job.task.frames.shot(int(job.numbers[0])).simulator.sensor
        with closing(self.opened(settings, sensor)) as output:

            def publish(number: int, pixels: "NDArray[Any]", truth: bytes) -> None:
                output.write(pixels, truth, records.of(number))

            yield publish
