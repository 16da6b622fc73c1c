"""``nav.jsonl``: what a navigator knows of each frame; and the directory that holds nothing else."""

import os
import shutil
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any, Final

import orjson

from glstar.config import Config
from glstar.errors import ConfigError, ExportError
from glstar.export.diskerrors import explain_disk_errors
from glstar.export.fitsfile import without_truth
from glstar.export.images import SUFFIX
from glstar.export.layout import OURS, SPLITS
from glstar.export.navrecord import Navigator
from glstar.export.run import Export
from glstar.export.task import FrameTask
from glstar.flight import AttitudeTrack
from glstar.system.durable import publish, temporary_path, write_atomically

__all__ = ["NAV", "NavRecords", "estimates", "publish_blind", "refuse_other_files", "remove_nav", "write_nav"]

NAV: Final = "nav.jsonl"


def estimates(config: Config, flight_paths: Sequence[Path]) -> list[AttitudeTrack | None]:
    """Return the attitudes that the aircraft of each log estimated, where ``[navigator]`` names their message.

    Parameters
    ----------
    config : Config
    flight_paths : sequence of Path

    Returns
    -------
    list of AttitudeTrack or None
        None where the estimate is the true attitude with errors.

    Raises
    ------
    ConfigError
        If the time of the flight is given, so that two messages have no common clock.
    LogFormatError
        If a log has no such message.
    """
    if config.navigator.attitude == "model":
        return [None] * len(flight_paths)
    if config.flight.utc_start is not None:
        raise ConfigError(
            'takes the attitude of a log with UTC of its own; leave out flight.utc_start, or use "model"',
            key="navigator.attitude",
        )
    other = config.override(**{"flight.attitude": config.navigator.attitude})
    return [other.open_flight(path).aircraft_attitude for path in flight_paths]


def remove_nav(directory: Path) -> None:
    """Remove ``nav.jsonl`` before frames are drawn, so that it never lacks frames.

    Parameters
    ----------
    directory : Path
    """
    with suppress(FileNotFoundError, NotADirectoryError):
        (directory / NAV).unlink()


def write_nav(job: Export, config: Config, attitudes: Sequence[AttitudeTrack | None]) -> Path:
    """Write ``nav.jsonl`` beside the truth of a complete export, atomically.

    Parameters
    ----------
    job : Export
    config : Config
    attitudes : sequence of AttitudeTrack or None
        From `estimates`.

    Returns
    -------
    Path
    """
    path = job.directory / NAV
    temporary = temporary_path(path)
    with explain_disk_errors(job.directory):
        try:
            with temporary.open("wb") as file:
                records = NavRecords(job.task, config, attitudes)
                for number in job.numbers.tolist():
                    file.write(orjson.dumps(records.of(number), option=orjson.OPT_APPEND_NEWLINE))
        except BaseException:
            temporary.unlink(missing_ok=True)
            raise
        publish(temporary, path)
    return path


class NavRecords:
    """The records of the frames of an export, in any order; fastest in theirs.

    Parameters
    ----------
    task : FrameTask
    config : Config
    attitudes : sequence of AttitudeTrack or None
        From `estimates`.
    """

    def __init__(self, task: FrameTask, config: Config, attitudes: Sequence[AttitudeTrack | None]) -> None:
        self._task, self._config, self._attitudes = task, config, attitudes
        self._current: tuple[int, Navigator] | None = None

    def of(self, number: int) -> dict[str, Any]:
        """Return the record of a frame.

        Parameters
        ----------
        number : int

        Returns
        -------
        dict
            As of `Navigator.record`.
        """
        task = self._task
        shot = task.frames.shot(number)
        if self._current is None or shot.stream != self._current[0]:
            estimate = self._attitudes[shot.flight]
            if estimate is not None:
                estimate = estimate.shifted(shot.shift_s)
            own = self._config.at(shot.settings)
            navigator = Navigator.of(own, shot.simulator.flight, estimate=estimate, stream=shot.stream)
            self._current = shot.stream, navigator
        file = task.image_path(number).relative_to(task.directory).as_posix()
        return self._current[1].record(shot.exposure, number=number, file=file)


def publish_blind(job: Export, output: Path) -> None:
    """Fill a directory with the images and ``nav.jsonl`` of a complete export, and nothing else of it.

    Parameters
    ----------
    job : Export
        Its directory has the truth.
    output : Path
        For the navigator.  Images are hard links where the file system has them, else copies; FITS images are copies
        without their truth.

    Raises
    ------
    ExportError
        If the directory holds files of another export.
    """
    images = [job.task.image_path(number).relative_to(job.directory) for number in job.numbers.tolist()]
    refuse_other_files(output, {image.name for image in images})
    with explain_disk_errors(output), (job.directory / NAV).open("rb") as records:
        for name in (*images, Path(NAV)):
            target = output / name
            target.parent.mkdir(parents=True, exist_ok=True)
            if name.suffix == SUFFIX["fits"]:
                content = (job.directory / name).read_bytes()
                write_atomically(target, without_truth(content, orjson.loads(records.readline())["utc"]))
            else:
                _hand_over(job.directory / name, target)


def _hand_over(source: Path, target: Path) -> None:
    """Put a file in a second directory."""
    fresh = temporary_path(target)
    try:
        os.link(source, fresh)
    except OSError:
        shutil.copyfile(source, fresh)
    fresh.replace(target)


def refuse_other_files(output: Path, names: set[str] | None = None) -> None:
    """Refuse a directory for a navigator that holds more than its images, ``nav.jsonl`` and the lists of splits.

    Parameters
    ----------
    output : Path
    names : set of str, optional
        Names that may be there; without it, any image.

    Raises
    ------
    ExportError
        If it holds other files of an export.
    """
    if not output.is_dir():
        return
    for entry in sorted(path.name for path in output.rglob("*") if path.is_file()):
        is_image = entry.startswith("frame_") and entry.count(".") == 1  # no mask, no noiseless image
        is_known = is_image if names is None else entry in names
        allowed = is_known or entry in {NAV, *(f"{split}.txt" for split in SPLITS)}
        if OURS.fullmatch(entry) and not allowed:
            raise ExportError(output, f"holds {entry} of another export; choose another directory for the blind set")
