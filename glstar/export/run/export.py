"""An export and its run: the missing frames of a directory, or of one shard of it, are drawn and written."""

import re
from collections.abc import Callable, Generator
from contextlib import ExitStack, closing, nullcontext
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from glstar.errors import ConfigError, ExportError
from glstar.export.directory import (
    Lease,
    directory_lock,
    explain_disk_errors,
    frame_numbers,
    output_files,
    refuse_links,
    remove_own_files,
    revoke_leases,
)
from glstar.export.frame import FrameTask
from glstar.export.imagefiles.formats import find_damage
from glstar.export.plan.frames import ComposedFrame, SkippedFrame, control_exposures
from glstar.export.plan.manifest import OmittedLog, claim, holds_frames, is_claimed, refuse_other_settings
from glstar.export.run.executors import Executor
from glstar.export.truth.lines import TruthFile
from glstar.render.scene.scene import Frame, Renderer
from glstar.system.files import TEMPORARY, flush_directory, make_directory

Numbers = NDArray[np.int64]

# The temporary name of a `StagedFile`.
_STAGED = re.compile(re.escape(TEMPORARY) + r"[0-9a-f]{8}-.+")


def missing_frames(task: FrameTask, manifest: dict[str, Any], truth: TruthFile, wanted: Numbers) -> Numbers:
    """Return the wanted frames that have no intact files or no line of truth, (m,) increasing.

    `manifest` is the one that the export would write; `truth` is read by this function. Raises ExportError if the
    directory holds frames of other settings, or links.
    """
    refuse_links(task.directory)
    refuse_other_settings(task.directory, manifest)
    truth.read()
    with_truth = np.intersect1d(wanted, truth.numbers, assume_unique=True)
    return np.setdiff1d(wanted, intact_frames(task, with_truth), assume_unique=True)


def intact_frames(task: FrameTask, numbers: Numbers) -> Numbers:
    """Return which of (n,) frames have files that are neither truncated nor damaged, (m,)."""
    kinds = task.file_kinds
    for suffix in kinds:
        numbers = np.intersect1d(numbers, frame_numbers(task.directory, suffix))
    intact = [n for n in numbers.tolist() if not any(find_damage(path_of(n)) for path_of in kinds.values())]
    return np.array(intact, dtype=np.int64)


def remove_leftovers(directory: Path) -> None:
    """Remove the unfinished files of runs that were killed, after their workers have stopped writing."""
    revoke_leases(directory)
    for path in output_files(directory):
        if path.name.startswith(TEMPORARY):
            path.unlink()


def remove_staged_files(directory: Path) -> None:
    """Remove files that workers staged before they died; no worker may be running."""
    for path in output_files(directory):
        if _STAGED.fullmatch(path.name):
            path.unlink(missing_ok=True)


@dataclass(frozen=True, slots=True)
class Shard:
    """One of several equal parts of an export's frames."""

    index: int = 1  # The shard is number `index`, counted from 1, of `count` shards
    count: int = 1

    @classmethod
    def parse(cls, text: str) -> Self:
        """Return the shard that is written as K/N; raises ConfigError if the text is not K/N with 1 <= K <= N."""
        match = re.fullmatch(r"(\d{1,9})/(\d{1,9})", text)
        if match is None or not 1 <= int(match[1]) <= int(match[2]):
            raise ConfigError(f"--shard {text} is no shard; of four jobs the first draws 1/4 and the last 4/4")
        return cls(int(match[1]), int(match[2]))

    @property
    def is_all(self) -> bool:
        """Whether it is the only shard."""
        return self.count == 1

    @property
    def label(self) -> str:
        """Part of the names of its files of truth; empty if it is the only shard."""
        return "" if self.is_all else f"shard{self.index}of{self.count}"

    def select(self, numbers: NDArray[np.int64]) -> NDArray[np.int64]:
        """Return every `count`-th of all frames, so that slow parts of a flight are spread over all shards."""
        return numbers[self.index - 1 :: self.count]


ALL_FRAMES = Shard()


@dataclass(frozen=True, slots=True)
class ExportReport:
    """The result of a run."""

    directory: Path | str  # The URL of an object store is text
    drawn: int  # Frames drawn by this run, and frames that an earlier run had drawn
    there_already: int
    skipped: tuple[SkippedFrame, ...]
    # Whether all frames and the joined truth are in the directory; of several shards only the last one to finish
    # reports True.
    complete: bool = True
    tables_removed: bool = False  # Whether Parquet tables of fewer frames were removed


@dataclass(frozen=True, slots=True, eq=False)
class Export:
    """Frames to be written to one directory; `prepare_export` and `prepare_data_set` return one."""

    task: FrameTask  # How to draw the frames and where to write them
    # Everything that decides the frames except the renderer, ready to be written as JSON. A run continues an earlier
    # one only if their manifests agree.
    manifest: dict[str, Any]
    omitted_logs: tuple[OmittedLog, ...] = ()  # Logs of a data set that cannot be exported

    @property
    def directory(self) -> Path:
        """The directory of the frames."""
        return self.task.directory

    @property
    def numbers(self) -> Numbers:
        """Frame numbers, (n,) int64, increasing."""
        return self.task.frames.numbers

    @property
    def notes(self) -> list[tuple[str, str]]:
        """Notes on how the logs were read that matter to users of the frames: name of the log, and message."""
        flights = self.manifest.get("flights") or [self.manifest["flight"]]
        return [(flight["name"], note) for flight in flights for note in flight.get("notes", ())]

    def into(self, directory: Path) -> Self:
        """Return the same export with another output directory."""
        return replace(self, task=replace(self.task, directory=directory))

    @property
    def is_controlled(self) -> bool:
        """Whether an exposure control is to set exposure times and gains, which are not known yet."""
        return bool(len(self.numbers)) and self.task.frames.shot(int(self.numbers[0])).control is not None

    def controlled(self, renderer: Renderer, on_frame: Callable[[int, int], None]) -> Self:
        """Return the export with the exposure times and gains of its exposure control: all frames are drawn for them.

        `on_frame` is called with the number of finished frames and of all frames.
        """

        def draw(composed: ComposedFrame) -> Frame:
            return self.task.begin(renderer, composed).frame()

        frames = control_exposures(self.task.frames, draw, on_frame)
        return replace(self, task=replace(self.task, frames=frames))

    def run(
        self,
        executor: Executor,
        *,
        shard: Shard = ALL_FRAMES,
        force: bool = False,
        on_frame: Callable[[int, int], None] | None = None,
    ) -> ExportReport:
        """Draw and write the missing frames.

        The run that draws the last shard joins the truth of all. With `force` the files of an earlier export are
        removed from the directory first. `on_frame` is called with the number of finished frames and of all frames,
        after each frame. Raises ExportError if the directory cannot be written, the disk is full, or it holds frames of
        other settings.
        """
        if self.is_controlled:
            raise ConfigError(
                "follows the level of the frames before, which glstar export draws", key="exposure.control"
            )
        report_progress = on_frame or (lambda *_: None)
        manifest = self.manifest | {"renderer": executor.driver}
        truth = TruthFile(self.directory, shard.label)
        wanted = shard.select(self.numbers)
        with explain_disk_errors(self.directory):
            with ExitStack() as locked:
                missing = self._open(executor, manifest, truth, wanted, locked, shared=not shard.is_all, force=force)
                tables_removed = claim(self.directory, manifest)
                if shard.is_all and not force:
                    remove_leftovers(self.directory)
                there_already = len(wanted) - len(missing)
                report_progress(there_already, len(wanted))
                if missing.size:
                    for done in self._draw(executor, missing, truth):
                        report_progress(there_already + done, len(wanted))
                if shard.is_all:
                    if executor.writes_parts:
                        truth.read_new_parts()
                        remove_staged_files(self.directory)
                    truth.finish(self.numbers)
            complete = shard.is_all or self._join_shards(manifest)
        skipped = self.task.frames.skipped
        return ExportReport(self.directory, len(missing), there_already, skipped, complete, tables_removed)

    def _open(
        self,
        executor: Executor,
        manifest: dict[str, Any],
        truth: TruthFile,
        wanted: Numbers,
        locked: ExitStack,
        *,
        shared: bool,
        force: bool,
    ) -> Numbers:
        """Lock the directory, create or clear it as needed, and return the frames to draw.

        A frame that cannot be drawn fails in the preflight, before a directory is created or cleared.
        """
        is_new = not self.directory.exists()
        if not is_new:
            locked.enter_context(directory_lock(self.directory, shared=shared))
            if not shared and not force:
                refuse_links(self.directory)
                force = not holds_frames(self.directory)
        missing = wanted if is_new or force else missing_frames(self.task, manifest, truth, wanted)
        if missing.size:
            executor.preflight(self.task, int(missing[0]))
        if is_new:
            make_directory(self.directory)
            locked.enter_context(directory_lock(self.directory, shared=shared))
            # Another run may have begun here in the meantime.
            missing = wanted if force else missing_frames(self.task, manifest, truth, wanted)
        if force:
            remove_own_files(self.directory)
        return missing

    def _draw(self, executor: Executor, missing: Numbers, truth: TruthFile) -> Generator[int, None, None]:
        """Draw and write frames; yield the number of finished frames after each."""
        truth.unpublish()
        with (
            Lease.taken(self.directory) if executor.writes_parts else nullcontext() as lease,
            closing(executor.draw(replace(self.task, lease=lease), missing, truth)) as drawn,
        ):
            for done, _ in enumerate(drawn, start=1):
                yield done
        # The names of the images must be on the disk before the truth gets its name.
        folders = {self.directory, *(self.task.image_path(number).parent for number in missing.tolist())}
        for folder in sorted(folders):
            flush_directory(folder)

    def _join_shards(self, manifest: dict[str, Any]) -> bool:
        """Join the truth of all shards if all frames are there and no other run is writing; return whether it did."""
        with ExitStack() as locked:
            try:
                locked.enter_context(directory_lock(self.directory))
            except ExportError:
                return False
            # Another run may have extended the export after this shard was drawn.
            if not is_claimed(self.directory, manifest):
                return False
            truth = TruthFile(self.directory)
            truth.read()
            if np.setdiff1d(self.numbers, truth.numbers).size:
                return False
            if len(intact_frames(self.task, self.numbers)) < len(self.numbers):
                return False
            remove_leftovers(self.directory)
            truth.finish(self.numbers)
            return True
