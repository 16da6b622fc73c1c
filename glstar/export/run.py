"""An export: what is missing of its frames is drawn and written."""

import re
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager, ExitStack, closing, nullcontext, suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from glstar.config import Config
from glstar.errors import ExportError, FlightTooShortError, LogFormatError
from glstar.export.dataset import DataSetFrames
from glstar.export.directorylock import directory_lock
from glstar.export.diskerrors import explain_disk_errors
from glstar.export.executors import Executor
from glstar.export.fingerprint import file_hash
from glstar.export.frames import ComposedFrame, FlightFrames, Frames
from glstar.export.images import SUFFIX, ImageFormat, damage_of, encode, fitting, tiff
from glstar.export.layout import LIGHT_SUFFIX, OURS, files_of, folder_of, folders_of, is_folder_name, numbers_of
from glstar.export.lease import Lease, revoke_leases
from glstar.export.links import make_folder, refuse_links
from glstar.export.manifest import (
    LeftOut,
    Request,
    claim,
    describe,
    describe_data_set,
    is_claimed,
    refuse_other_settings,
)
from glstar.export.plan import SkippedFrame, plan_frames
from glstar.export.shard import WHOLE, Shard
from glstar.export.truthfile import TruthFile
from glstar.flight import Flight
from glstar.render.scene import Frame, Renderer
from glstar.render.truth import frame_truth
from glstar.sky.catalogue import StarCatalogue
from glstar.system.durable import TEMPORARY, flush_directory, make_directory, write_atomically

__all__ = ["EncodedFrame", "Export", "ExportReport", "frame_seed", "prepare", "prepare_data_set"]

Numbers = NDArray[np.int64]

# The temporary name of a file that `StagedFile` writes.
_STAGED: Final = re.compile(re.escape(TEMPORARY) + r"[0-9a-f]{8}-.+")


@dataclass(frozen=True, slots=True)
class EncodedFrame:
    """A frame as its files' contents.

    Attributes
    ----------
    number : int
        Its place in the sequence.
    image : bytes
        The image file.
    light : bytes or None
        The float32 TIFF of the light before noise, if it was asked for.
    truth : bytes
        The line of ``truth.jsonl``.
    """

    number: int
    image: bytes
    light: bytes | None
    truth: bytes


@dataclass(frozen=True, slots=True)
class ExportReport:
    """What an export did.

    Attributes
    ----------
    directory : Path
    drawn, there_already : int
        Frames made now, and frames that an earlier run had made.
    skipped : tuple of SkippedFrame
    complete : bool
        Whether all is there: where several draw shares of it, only the last to end finds so.
    tables_removed : bool
        Whether Parquet tables of fewer frames were removed.
    """

    directory: Path
    drawn: int
    there_already: int
    skipped: tuple[SkippedFrame, ...]
    complete: bool = True
    tables_removed: bool = False


@dataclass(frozen=True, slots=True, eq=False)
class Export:
    """Frames on their way to one directory; `prepare` makes it.

    It can be pickled, and other processes draw the same from it.

    Attributes
    ----------
    frames : Frames
    directory : Path
    manifest : dict
        What makes the frames, but for the renderer, ready to be written as JSON; an unfinished export goes on only
        if nothing in it differs.
    image_format : {"png", "png16", "tiff"}
    light : bool
        Whether to write the light before noise beside each frame.
    seed : int
        The seed from which every frame's own is derived.
    lease : Lease or None
        The right to write that `run` gives to other processes; None where it ends with this one.
    left_out : tuple of LeftOut
        Logs of a data set that cannot be drawn.
    """

    frames: Frames
    directory: Path
    manifest: dict[str, Any]
    image_format: ImageFormat
    light: bool
    seed: int
    lease: Lease | None = None
    left_out: tuple[LeftOut, ...] = ()

    @property
    def notes(self) -> list[tuple[str, str]]:
        """What somebody who uses the frames should know of how the logs were read: the log's name, and a message."""
        flights = self.manifest.get("flights") or [self.manifest["flight"]]
        return [(flight["name"], note) for flight in flights for note in flight.get("notes", ())]

    def run(
        self,
        crew: Executor,
        *,
        shard: Shard = WHOLE,
        force: bool = False,
        on_frame: Callable[[int, int], None] | None = None,
    ) -> ExportReport:
        """Draw and write what is missing.

        Parameters
        ----------
        crew : Executor
            Who draws: `SerialExecutor`, `ProcessExecutor` or a cluster.
        shard : Shard
            The share to draw.  Who draws the last one joins the truth.
        force : bool
            Start over: remove what an earlier export left in the directory.
        on_frame : callable
            Called with the number of frames done and of all, after each.

        Returns
        -------
        ExportReport

        Raises
        ------
        ExportError
            If the directory cannot be written, the disk is full, or it holds frames made otherwise.
        """
        tell = on_frame or (lambda *_: None)
        manifest = self.manifest | {"renderer": crew.driver}
        truth = TruthFile(self.directory, shard.who)
        mine = shard.share(self.frames.numbers)
        shared = not shard.is_whole
        with explain_disk_errors(self.directory):
            with ExitStack() as held:
                new = not self.directory.exists()
                if not new:
                    held.enter_context(directory_lock(self.directory, shared=shared))
                missing = mine if new or force else self._missing(manifest, truth, mine)
                # What cannot be drawn must leave no directory behind, nor clear one.
                if missing.size:
                    crew.preflight(self, int(missing[0]))
                if new:
                    make_directory(self.directory)
                    held.enter_context(directory_lock(self.directory, shared=shared))
                    # Another may have begun here since.
                    missing = mine if force else self._missing(manifest, truth, mine)
                if force:
                    self._clear(everything=True)
                removed = claim(self.directory, manifest)
                if not shared and not force:
                    self._clear(everything=False)
                there_already = len(mine) - len(missing)
                tell(there_already, len(mine))
                if missing.size:
                    truth.reopen()
                    with Lease.taken(self.directory) if crew.apart else nullcontext() as lease:
                        export = replace(self, lease=lease)
                        with closing(crew.draw(export, missing, truth)) as drawn:
                            for done, _ in enumerate(drawn, start=there_already + 1):
                                tell(done, len(mine))
                    # The images have their names on the disk before the truth has its own.
                    for folder in sorted({self.directory, *(self.image_path(n).parent for n in missing.tolist())}):
                        flush_directory(folder)
                if not shared:
                    if crew.apart:
                        truth.read_more()
                        self._remove_staged()
                    truth.finish(self.frames.numbers)
            complete = not shared or self._join_shards(manifest)
        return ExportReport(self.directory, len(missing), there_already, self.frames.skipped, complete, removed)

    def compose(self, number: int) -> ComposedFrame:
        """Return what a frame shows.

        Parameters
        ----------
        number : int

        Returns
        -------
        ComposedFrame
        """
        return self.frames.compose(number)

    def begin(self, renderer: Renderer, composed: ComposedFrame) -> None:
        """Begin to draw a composed frame with the noise that is its own; `Renderer.end_read` has it.

        Parameters
        ----------
        renderer : Renderer
        composed : ComposedFrame
        """
        renderer.begin(composed.scene, seed=frame_seed(self.seed, composed.number), light=self.light)

    def encoded(
        self,
        composed: ComposedFrame,
        frame: Frame,
        *,
        on_pixels: Callable[[np.ndarray[Any, Any], bytes], None] | None = None,
    ) -> EncodedFrame:
        """Return a frame with its files' contents.

        Parameters
        ----------
        composed : ComposedFrame
        frame : Frame
        on_pixels : callable
            Called with the pixels and the line of truth before the image becomes a file's content, for who is in haste.

        Returns
        -------
        EncodedFrame
        """
        number = composed.number
        file = self.image_path(number).relative_to(self.directory).as_posix()
        line = frame_truth(composed.scene, frame, number=number, file=file, about=composed.about)
        if on_pixels is not None:
            on_pixels(frame.pixels, line)
        return EncodedFrame(
            number=number,
            image=encode(frame.pixels, self.image_format),
            light=None if frame.light_dn is None else tiff(frame.light_dn),
            truth=line,
        )

    def draw(
        self,
        renderer: Renderer,
        number: int,
        *,
        on_pixels: Callable[[np.ndarray[Any, Any], bytes], None] | None = None,
    ) -> EncodedFrame:
        """Return a frame with its files' contents, without writing anything.

        Parameters
        ----------
        renderer : Renderer
        number : int
        on_pixels : callable
            As for `encoded`.

        Returns
        -------
        EncodedFrame
        """
        composed = self.compose(number)
        self.begin(renderer, composed)
        return self.encoded(composed, renderer.end_read(), on_pixels=on_pixels)

    def write(self, frame: EncodedFrame, write: Callable[[Path, bytes], None] = write_atomically) -> None:
        """Write a frame's files, each whole or not at all; its line of truth is none of them.

        Parameters
        ----------
        frame : EncodedFrame
        write : callable
            Called with each file's path and content; it writes the file at once unless said otherwise.

        Raises
        ------
        OSError
            If they cannot be written.
        ExportError
            If another run has taken the directory over, or a link has the name of a folder.
        """
        path = self.image_path(frame.number)
        if path.parent != self.directory:
            with self.writing():
                make_folder(path.parent)
        write(path, frame.image)
        if frame.light is not None:
            write(self.light_path(frame.number), frame.light)

    def writing(self) -> AbstractContextManager[None]:
        """Return a context in which the directory is this run's to write into.

        Returns
        -------
        context manager
            It raises ExportError where another run has taken the directory over.
        """
        return nullcontext() if self.lease is None else self.lease.writing()

    def image_path(self, number: int) -> Path:
        """Return where a frame's image lies.

        Parameters
        ----------
        number : int

        Returns
        -------
        Path
            The first ten thousand frames lie in the directory, those after them in folders of a thousand: no file
            manager likes a million files in one.
        """
        return self.directory / folder_of(number) / f"frame_{number:06d}{SUFFIX[self.image_format]}"

    def light_path(self, number: int) -> Path:
        """Return where the light of a frame lies, where it is written.

        Parameters
        ----------
        number : int

        Returns
        -------
        Path
        """
        return self.directory / folder_of(number) / f"frame_{number:06d}{LIGHT_SUFFIX}"

    def _clear(self, *, everything: bool) -> None:
        """Remove what a killed run was writing, and with `everything` all that an export writes."""
        revoke_leases(self.directory)
        if everything:
            # Of a folder that is a link the link goes, and what it leads to stays.
            for entry in self.directory.iterdir():
                if is_folder_name(entry.name) and entry.is_symlink():
                    entry.unlink()
        for path in files_of(self.directory):
            if path.name.startswith(TEMPORARY) or (everything and OURS.fullmatch(path.name)):
                path.unlink()
        if everything:
            for folder in folders_of(self.directory):
                flush_directory(folder)
                with suppress(OSError):  # it holds what is not ours
                    folder.rmdir()
            # Old frames are gone from the disk before a new manifest could vouch for them.
            flush_directory(self.directory)

    def _remove_staged(self) -> None:
        """Remove the files that workers had staged when they died; all others have ended their work."""
        for path in files_of(self.directory):
            if _STAGED.fullmatch(path.name):
                path.unlink(missing_ok=True)

    def _missing(self, manifest: dict[str, Any], truth: TruthFile, wanted: Numbers) -> Numbers:
        """Return the frames that are not there with image, light and truth."""
        refuse_links(self.directory)
        refuse_other_settings(self.directory, manifest)
        truth.read()
        with_truth = np.intersect1d(wanted, truth.numbers, assume_unique=True)
        return np.setdiff1d(wanted, self._whole_images(with_truth), assume_unique=True)

    def _whole_images(self, numbers: Numbers) -> Numbers:
        """Return which frames have an image, and light if asked for, that is neither short nor torn."""
        paths = [self.image_path] + [self.light_path] * self.light
        for there in (SUFFIX[self.image_format], *[LIGHT_SUFFIX] * self.light):
            numbers = np.intersect1d(numbers, numbers_of(self.directory, there))
        whole = [number for number in numbers.tolist() if not any(damage_of(path(number)) for path in paths)]
        return np.array(whole, dtype=np.int64)

    def _join_shards(self, manifest: dict[str, Any]) -> bool:
        """Join the truth, if all shares are there and nobody draws any more; return whether it is so."""
        numbers = self.frames.numbers
        with ExitStack() as held:
            try:
                held.enter_context(directory_lock(self.directory))
            except ExportError:
                return False
            # Since this share was drawn another may have asked for more frames.
            if not is_claimed(self.directory, manifest):
                return False
            truth = TruthFile(self.directory)
            truth.read()
            if np.setdiff1d(numbers, truth.numbers).size or len(self._whole_images(numbers)) < len(numbers):
                return False
            self._clear(everything=False)
            truth.finish(numbers)
            return True


def prepare(
    config: Config,
    flight_path: Path,
    directory: Path,
    *,
    flight: Flight | None = None,
    start_s: float = 0.0,
    stop_s: float | None = None,
    frames: int | None = None,
    image_format: ImageFormat | None = None,
    light: bool = False,
    seed: int = 0,
    only: int | None = None,
) -> Export:
    """Read a flight and plan its frames; nothing is drawn or written yet.

    Parameters
    ----------
    config : Config
    flight_path : Path
        The flight's log.
    directory : Path
        Where the frames shall lie.
    flight : Flight, optional
        What the log holds, where it has been read already.
    start_s, stop_s : float
        The part of the flight, s from its first attitude; all of it unless said otherwise.
    frames : int, optional
        No more than so many.
    image_format : {"png", "png16", "tiff"}, optional
        8-bit PNG unless the sensor has more bits.  A sensor of 8 bits in a file of 16 gets a converter of 16 bits:
        full scale stays full scale, and all DN of the truth follow.
    light : bool
        Write the light before noise beside each frame.
    seed : int
        The seed of all noise.
    only : int, optional
        Of all these, the one frame to draw.

    Returns
    -------
    Export
        Exposures that span a gap of the log are not drawn but counted, in its plan.

    Raises
    ------
    ConfigError
        If no exposure fits into the flight, the sensor's bits not into the format, or the only frame is skipped.
    LogFormatError
        If the log cannot be replayed.
    CatalogueError
        If there is no such star catalogue.
    """
    flight = config.open_flight(flight_path) if flight is None else flight
    plan = plan_frames(flight, config.exposure, start_s=start_s, stop_s=stop_s, frames=frames)
    image_format, sensor = fitting(image_format, config.sensor())
    request = Request(start_s, stop_s, frames, image_format, light, seed)
    return Export(
        frames=FlightFrames(config.simulator(flight, sensor=sensor), plan if only is None else plan.only(only)),
        directory=directory,
        manifest=describe(config, flight_path, flight, sensor, request, plan),
        image_format=image_format,
        light=light,
        seed=seed,
    )


def prepare_data_set(
    config: Config,
    flight_paths: Sequence[Path],
    directory: Path,
    *,
    start_s: float = 0.0,
    stop_s: float | None = None,
    frames: int | None = None,
    image_format: ImageFormat | None = None,
    light: bool = False,
    seed: int = 0,
    strict: bool = True,
) -> Export:
    """Read flights and plan the frames of a data set: each flight under each sample of the config's sweep.

    Parameters
    ----------
    config : Config
    flight_paths : sequence of Path
        The flights' logs.
    directory, start_s, stop_s, image_format, light, seed
        As for `prepare`.
    frames : int, optional
        Of each sample no more than so many.
    strict : bool
        Raise if one of several logs cannot be replayed, or has no room for an exposure.  Otherwise it is left out and
        listed in `Export.left_out` and in the manifest, as long as one log is left.

    Returns
    -------
    Export

    Raises
    ------
    ConfigError
        If a sample's exposure does not fit into its flight, or a sensor's bits not into the format.
    LogFormatError
        If a log cannot be replayed.
    CatalogueError
        If there is no such star catalogue.
    """
    image_format, sensor = fitting(image_format, config.sensor())
    faintest: dict[str, float] = {}
    for one in (config, *map(config.at, config.sweep.extremes())):
        fitting(image_format, one.sensor())
        faintest[one.sky.catalogue] = max(faintest.get(one.sky.catalogue, -np.inf), one.sky.vmag_limit)
    catalogues = {name: StarCatalogue.open(name).brighter_than(vmag) for name, vmag in faintest.items()}
    hashes = tuple((path, file_hash(path)) for path in config.files)
    paths, flights, left_out = _readable(config, flight_paths, strict=strict)
    while True:
        planned = DataSetFrames(config, tuple(flights), catalogues, image_format, start_s, stop_s, frames, hashes)
        try:
            planned.check_samples_fit()
            break
        except FlightTooShortError as error:
            if strict or len(flights) == 1:
                raise
            # The draws of the flights after it change with their places: all are checked again.
            del flights[error.which]
            left_out.append(LeftOut(paths.pop(error.which), str(error)))
    request = Request(start_s, stop_s, frames, image_format, light, seed)
    manifest = describe_data_set(paths, planned, sensor, request, left_out)
    return Export(planned, directory, manifest, image_format, light, seed, left_out=tuple(left_out))


def _readable(
    config: Config, flight_paths: Sequence[Path], *, strict: bool
) -> tuple[list[Path], list[Flight], list[LeftOut]]:
    """Return the logs that can be replayed, their flights, and the other logs; raise if there is no flight."""
    paths, flights, left_out = [], [], []
    errors: list[LogFormatError] = []
    for path in flight_paths:
        try:
            flights.append(config.open_flight(path))
        except LogFormatError as error:
            if strict or len(flight_paths) == 1:
                raise
            errors.append(error)
            left_out.append(LeftOut(path, str(error).removeprefix(f"{path}: ")))
        else:
            paths.append(path)
    if not flights:
        raise LogFormatError(errors[0].path, f"{str(errors[0]).removeprefix(f'{errors[0].path}: ')} (no log is left)")
    return paths, flights, left_out


def frame_seed(seed: int, number: int) -> int:
    """Return the seed of a frame's noise.

    Parameters
    ----------
    seed : int
        The export's.
    number : int
        The frame's place in the sequence.

    Returns
    -------
    int
        0 to 2**32 - 1.
    """
    return int(np.random.SeedSequence([seed, number]).generate_state(1)[0])
