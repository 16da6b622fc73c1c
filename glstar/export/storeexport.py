"""An export to an object store: blocks of frames are drawn in a temporary folder, then sent.

An object appears whole or not at all, so that no step needs a lock:

1. the manifest, or the comparison with the one that is there;
2. of each block, the files of its frames, then its lines of truth as ``truth-NNNNNN.jsonl``: a block with these lines
   is complete, and others are drawn by the next run;
3. when all blocks are there, ``truth.jsonl``; the lines of the blocks are then removed.

Two runs that draw the same block send the same bytes.
"""

from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from glstar.errors import ExportError
from glstar.export.executors import Executor
from glstar.export.frames import ComposedFrame, Frames, Shot
from glstar.export.manifest import NAME, claim
from glstar.export.objectstore import ObjectStore
from glstar.export.plan import SkippedFrame
from glstar.export.run import Export, ExportReport
from glstar.export.shard import ALL_FRAMES, Shard

__all__ = ["StoreExport"]

# Frames that are drawn before they are sent: what a kill can lose, and the need for disk space.
_BLOCK_FRAMES: Final = 256
_TRUTH: Final = "truth.jsonl"


@dataclass(frozen=True, slots=True, eq=False)
class _FrameBlock:
    """Some frames of an export."""

    whole: Frames
    numbers: NDArray[np.int64]
    skipped: tuple[SkippedFrame, ...] = ()

    @property
    def firsts(self) -> NDArray[np.int64]:
        return self.whole.firsts

    @property
    def saturation_dn(self) -> int:
        return self.whole.saturation_dn

    @property
    def files(self) -> tuple[Path, ...]:
        return self.whole.files

    def shot(self, number: int) -> Shot:
        return self.whole.shot(number)

    def compose(self, number: int) -> ComposedFrame:
        return self.whole.compose(number)


@dataclass(frozen=True, slots=True, eq=False)
class StoreExport:
    """An export whose frames are sent to an object store.

    Attributes
    ----------
    job : Export
        Its directory is not used.
    url : str
        Such as ``s3://bucket/night-1``.
    block_frames : int
        Frames that are drawn before they are sent.
    """

    job: Export
    url: str
    block_frames: int = _BLOCK_FRAMES

    def run(
        self,
        executor: Executor,
        *,
        shard: Shard = ALL_FRAMES,
        force: bool = False,
        on_frame: Callable[[int, int], None] | None = None,
    ) -> ExportReport:
        """Draw and send the blocks that the store lacks.

        Parameters
        ----------
        executor : Executor
        shard : Shard
            The blocks to draw: every `count`-th.
        force : bool
            Must be False: glstar removes nothing from a store.
        on_frame : callable, optional
            Called with the number of finished frames and the number of all frames.

        Returns
        -------
        ExportReport

        Raises
        ------
        ExportError
            If the store does not answer, or has frames of other settings.
        """
        if force:
            raise ExportError(self.url, "glstar removes nothing from a store; choose another prefix")
        report_progress = on_frame or (lambda *_: None)
        store = ObjectStore(self.url)
        with TemporaryDirectory(prefix="glstar-") as folder:
            self._claim(store, Path(folder), self.job.manifest | {"renderer": executor.driver})
            blocks = self._blocks()
            wanted = shard.select(np.arange(len(blocks))).tolist()
            frames = sum(len(blocks[index]) for index in wanted)
            missing = [] if store.read(_TRUTH) is not None else self._missing(store, wanted)
            there = frames - sum(len(blocks[index]) for index in missing)
            done = there
            report_progress(done, frames)
            for index in missing:
                self._send(store, executor, index, blocks[index], Path(folder), done, frames, report_progress)
                done += len(blocks[index])
            complete = self._joined(store, len(blocks))
        return ExportReport(self.url, done - there, there, self.job.task.frames.skipped, complete)

    def _blocks(self) -> list[NDArray[np.int64]]:
        numbers = self.job.numbers
        return [numbers[first : first + self.block_frames] for first in range(0, len(numbers), self.block_frames)]

    def _claim(self, store: ObjectStore, folder: Path, manifest: dict[str, Any]) -> None:
        """Send the manifest, or compare it with the one in the store."""
        there, local = store.read(NAME), folder / NAME
        if there is not None:
            local.write_bytes(there)
        try:
            claim(folder, manifest)
        except ExportError as error:
            raise ExportError(self.url, str(error).removeprefix(f"{folder}: ").removeprefix(f"{local}: ")) from error
        if there is None:
            store.send(NAME, local.read_bytes())
        elif local.read_bytes() != there:
            raise ExportError(self.url, "holds another number of frames; choose another prefix")

    def _missing(self, store: ObjectStore, wanted: list[int]) -> list[int]:
        there = set(store.names("truth-"))
        return [index for index in wanted if _lines(index) not in there]

    def _send(
        self,
        store: ObjectStore,
        executor: Executor,
        index: int,
        numbers: NDArray[np.int64],
        folder: Path,
        done: int,
        frames: int,
        report_progress: Callable[[int, int], None],
    ) -> None:
        """Draw one block and send its files, last its truth."""
        with TemporaryDirectory(dir=folder) as place:
            directory = Path(place)
            task = replace(self.job.task, frames=_FrameBlock(self.job.task.frames, numbers), directory=directory)
            Export(task, self.job.manifest).run(executor, on_frame=lambda n, _: report_progress(done + n, frames))
            for path_of in task.file_kinds.values():
                for number in numbers.tolist():
                    path = path_of(number)
                    store.send(path.relative_to(directory).as_posix(), path.read_bytes())
            store.send(_lines(index), (directory / _TRUTH).read_bytes())

    def _joined(self, store: ObjectStore, blocks: int) -> bool:
        """Write the truth of all blocks if they are there; return whether the export is complete."""
        if store.read(_TRUTH) is not None:
            return True
        names = [_lines(index) for index in range(blocks)]
        if set(names) - set(store.names("truth-")):
            return False
        lines = [store.read(name) for name in names]
        if None in lines:  # another run has joined and removed them
            return store.read(_TRUTH) is not None
        store.send(_TRUTH, b"".join(content or b"" for content in lines))
        for name in names:
            with suppress(ExportError):
                store.remove(name)
        return True


def _lines(index: int) -> str:
    """Return the name of the lines of truth of a block."""
    return f"truth-{index:06d}.jsonl"
