"""An export to an object store: blocks of frames are drawn in a temporary folder, on any worker, then sent.

An object appears whole or not at all, so that no step needs a lock:

1. the manifest, or the comparison with the one that is there;
2. of each block, the files of its frames, then its lines of truth as ``truth-NNNNNN.jsonl``: a block with these lines
   is complete, and others are drawn by the next run;
3. when all blocks are there, ``truth.jsonl``; the lines of the blocks are then removed.

Two runs that draw the same block send the same bytes.
"""

from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import partial
from itertools import accumulate
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from glstar.errors import ExportError
from glstar.export.executors import BlockExecutor, Executor, draw_frames
from glstar.export.frames import ComposedFrame, Frames, Shot
from glstar.export.manifest import NAME, claim
from glstar.export.objectstore import ObjectStore
from glstar.export.plan import SkippedFrame
from glstar.export.run import Export, ExportReport
from glstar.export.shard import ALL_FRAMES, Shard
from glstar.export.task import FrameTask
from glstar.export.truthfile import TruthFile
from glstar.render.scene import Renderer

__all__ = ["StoreExport"]

Numbers = NDArray[np.int64]

# Frames that are drawn before they are sent: what a kill can lose, and the need for disk space.
_BLOCK_FRAMES: Final = 256
# Files that are sent at the same time: their number, and the memory that they take.
_BATCH_FILES: Final = 64
_BATCH_BYTES: Final = 1 << 26
_TRUTH: Final = "truth.jsonl"


@dataclass(frozen=True, slots=True, eq=False)
class _FrameBlock:
    """Some frames of an export."""

    whole: Frames
    numbers: Numbers
    skipped: tuple[SkippedFrame, ...] = ()

    @property
    def firsts(self) -> Numbers:
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
            report_progress(there, frames)
            to_draw = {index: blocks[index] for index in missing}
            self._draw(executor, to_draw, Path(folder), lambda drawn: report_progress(there + drawn, frames))
            complete = self._joined(store, len(blocks))
        return ExportReport(self.url, frames - there, there, self.job.task.frames.skipped, complete)

    def _blocks(self) -> list[Numbers]:
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

    def _draw(
        self, executor: Executor, blocks: Mapping[int, Numbers], folder: Path, on_frame: Callable[[int], None]
    ) -> None:
        """Draw and send blocks; call back with the number of frames drawn."""
        if isinstance(executor, BlockExecutor):
            for drawn in accumulate(executor.draw_blocks(partial(_draw_and_send, self.url), blocks)):
                on_frame(drawn)
            return
        store, before = ObjectStore(self.url), 0

        def report(drawn: int, _: int) -> None:
            on_frame(before + drawn)

        for index, numbers in blocks.items():
            with TemporaryDirectory(dir=folder) as place:
                task = _task_of(self.job.task, numbers, Path(place))
                Export(task, self.job.manifest).run(executor, on_frame=report)
                _send(store, task, index)
            before += len(numbers)

    def _joined(self, store: ObjectStore, blocks: int) -> bool:
        """Write the truth of all blocks if they are there; return whether the export is complete."""
        if store.read(_TRUTH) is not None:
            return True
        names = [_lines(index) for index in range(blocks)]
        if set(names) - set(store.names("truth-")):
            return False
        if not store.join(_TRUTH, names):  # another run has joined and removed them
            return store.read(_TRUTH) is not None
        for name in names:
            with suppress(ExportError):
                store.remove(name)
        return True


def _draw_and_send(
    url: str, task: FrameTask, renderer: Renderer, index: int, numbers: Numbers, encoder_threads: int
) -> None:
    """Draw a block on a worker, which needs no disk but its own, and send it."""
    with TemporaryDirectory(prefix="glstar-") as place:
        task = _task_of(task, numbers, Path(place))
        truth = TruthFile(task.directory)
        deque(draw_frames(task, renderer, numbers, truth, encoder_threads=encoder_threads), maxlen=0)
        truth.finish(numbers)
        _send(ObjectStore(url), task, index)


def _task_of(task: FrameTask, numbers: Numbers, directory: Path) -> FrameTask:
    """Return the task of drawing a block into a directory."""
    return replace(task, frames=_FrameBlock(task.frames, numbers), directory=directory)


def _send(store: ObjectStore, task: FrameTask, index: int) -> None:
    """Send the files of a block, last its lines of truth."""
    paths = (path_of(number) for path_of in task.file_kinds.values() for number in task.frames.numbers.tolist())
    for batch in _batches(paths):
        store.send_all({path.relative_to(task.directory).as_posix(): path.read_bytes() for path in batch})
    if not store.names(_TRUTH):  # a worker that outlives its export may be late
        store.send(_lines(index), (task.directory / _TRUTH).read_bytes())


def _batches(paths: Iterable[Path]) -> Iterator[list[Path]]:
    """Divide files into batches that are in memory at a time."""
    batch, size = list[Path](), 0
    for path in paths:
        batch.append(path)
        size += path.stat().st_size
        if len(batch) == _BATCH_FILES or size >= _BATCH_BYTES:
            yield batch
            batch, size = [], 0
    if batch:
        yield batch


def _lines(index: int) -> str:
    """Return the name of the lines of truth of a block."""
    return f"truth-{index:06d}.jsonl"
