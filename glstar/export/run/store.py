"""An export to an object store: blocks of frames are drawn in a temporary folder, on any worker, then sent.

An object appears whole or not at all, so that no step needs a lock:

1. the manifest, or the comparison with the one that is there;
2. of each block, the files of its frames, then its lines of truth as ``truth-NNNNNN.jsonl``: a block with these lines
   is complete, and others are drawn by the next run;
3. when all blocks are there, ``truth.jsonl``; the lines of the blocks are then removed.

Two runs that draw the same block send the same bytes.

Where converted files go: a directory, or a prefix of an object store by fsspec (``s3://``, ``gs://``, ``memory://``).
"""

import hashlib
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from functools import partial
from itertools import accumulate
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import IO, Any, Protocol

import numpy as np
from numpy.typing import NDArray

from glstar.errors import ExportError
from glstar.export.directory import new_directory
from glstar.export.frame import FrameTask
from glstar.export.plan.frames import FramesOfOthers, SkippedFrame
from glstar.export.plan.manifest import NAME, claim
from glstar.export.run.executors import BlockExecutor, Executor, draw_frames
from glstar.export.run.export import ALL_FRAMES, Export, ExportReport, Shard
from glstar.export.truth.lines import TruthFile
from glstar.render.scene.scene import Renderer
from glstar.system.installation import install_command


class Target(Protocol):
    """A place for whole files."""

    def put(self, name: str, content: bytes) -> None:
        """Write a file; `name`: with forward slashes between folders."""
        ...


class _Directory:
    """A directory on a disk."""

    def __init__(self, directory: Path) -> None:
        self._directory = directory

    def put(self, name: str, content: bytes) -> None:
        path = self._directory / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(content)


class ObjectStore:
    """A prefix of an object store, such as ``s3://bucket/night-1``.

    Beside each object lies its SHA-256, ``NAME.sha256``, which is sent after it. An object with the same one is not
    sent again, so that an upload that was cut off goes on where it stopped. The file system's own environment variables
    give keys and hosts. Raises ExportError if fsspec or the library of this kind of store is missing, or the store does
    not answer.
    """

    def __init__(self, url: str) -> None:
        self._url, self.sent = url, 0
        with self._explained():
            import fsspec  # noqa: PLC0415 - an extra

            self._files, self._prefix = fsspec.core.url_to_fs(url)

    def put(self, name: str, content: bytes) -> None:
        """Send a file, unless the same one is there."""
        digest = hashlib.sha256(content).hexdigest().encode()
        with self._explained():
            if self.read(f"{name}.sha256") == digest and self._files.exists(self._path(name)):
                return
            self.send(name, content)
            self.send(f"{name}.sha256", digest)
        self.sent += 1

    def send(self, name: str, content: bytes) -> None:
        """Send a file, in place of one of this name, which has forward slashes between folders."""
        self.send_all({name: content})

    def send_all(self, contents: Mapping[str, bytes]) -> None:
        """Send files by name, several at a time where the store can."""
        by_path = {self._path(name): content for name, content in contents.items()}
        with self._explained():
            self._make_folders(by_path)
            self._files.pipe(by_path)

    def join(self, name: str, parts: Sequence[str]) -> bool:
        """Make a file of others, one after the other, with one of them at a time in memory; it appears when complete.

        Returns False, and makes nothing, if one of the parts is missing.
        """
        path = self._path(name)
        with self._explained():
            self._make_folders([path])
            with self._files.open(path, "wb", autocommit=False) as whole:
                is_complete = all(_append(whole, self.read(part)) for part in parts)
            if is_complete:
                whole.commit()
            else:
                whole.discard()
        return is_complete

    def _make_folders(self, paths: Iterable[str]) -> None:
        """Make the folders of files on a disk; a store has none."""
        if "file" in self._files.protocol:
            for folder in {path.rpartition("/")[0] for path in paths}:
                self._files.makedirs(folder, exist_ok=True)

    def read(self, name: str) -> bytes | None:
        """Return a file; None if there is none."""
        with self._explained():
            try:
                return bytes(self._files.cat_file(self._path(name)))
            except FileNotFoundError:
                return None

    def names(self, beginning: str) -> list[str]:
        """Return the names of the files, outside of folders, that begin with some letters."""
        with self._explained():
            paths = self._files.glob(self._path(f"{beginning}*"))
        return [str(path).rpartition("/")[2] for path in paths]

    def remove(self, name: str) -> None:
        """Remove a file."""
        with self._explained():
            self._files.rm_file(self._path(name))

    def _path(self, name: str) -> str:
        return f"{self._prefix.rstrip('/')}/{name}"

    @contextmanager
    def _explained(self) -> Iterator[None]:
        try:
            yield
        except ImportError as error:
            message = f"needs {error.name or error}: {install_command('storage')}, and the library of the store"
            raise ExportError(self._url, message) from error
        except ExportError:
            raise
        except Exception as error:  # each store has errors of its own
            summary = (str(error).splitlines() or [""])[0]
            hint = "; is there this bucket, and do the environment variables of the store name your keys and its host"
            example = " (AWS_ACCESS_KEY_ID, AWS_SECRET_ACCESS_KEY, AWS_ENDPOINT_URL)" * self._url.startswith("s3:")
            message = f"cannot be written ({type(error).__name__}: {summary}){hint}{example}?"
            raise ExportError(self._url, message) from error


def _append(file: IO[bytes], content: bytes | None) -> bool:
    """Append to a file; return whether there is a content."""
    if content is not None:
        file.write(content)
    return content is not None


def is_url(text: str) -> bool:
    """Return whether a text names an object store rather than a file."""
    return "://" in text


@contextmanager
def opened_target(output: str) -> Iterator[Target]:
    """Open a new directory, which appears when it is complete, or a prefix of an object store.

    Raises ExportError if the directory exists, or the store does not answer.
    """
    if is_url(output):
        yield ObjectStore(output)
    else:
        with new_directory(Path(output)) as folder:
            yield _Directory(folder)


Numbers = NDArray[np.int64]

# Frames that are drawn before they are sent: what a kill can lose, and the need for disk space.
_BLOCK_FRAMES = 256
# Files that are sent at the same time: their number, and the memory that they take.
_BATCH_FILES = 64
_BATCH_BYTES = 1 << 26
_TRUTH = "truth.jsonl"


@dataclass(frozen=True, slots=True, eq=False)
class _FrameBlock(FramesOfOthers):
    """Some frames of an export."""

    numbers: Numbers
    skipped: tuple[SkippedFrame, ...] = ()


@dataclass(frozen=True, slots=True, eq=False)
class StoreExport:
    """An export whose frames are sent to an object store."""

    job: Export  # Its directory is not used
    url: str  # Such as ``s3://bucket/night-1``
    block_frames: int = _BLOCK_FRAMES  # Frames that are drawn before they are sent

    def run(
        self,
        executor: Executor,
        *,
        shard: Shard = ALL_FRAMES,
        force: bool = False,
        on_frame: Callable[[int, int], None] | None = None,
    ) -> ExportReport:
        """Draw and send the blocks that the store lacks.

        `shard`: the blocks to draw: every `count`-th; `force`: must be False: glstar removes nothing from a store;
        `on_frame`: called with the number of finished frames and the number of all frames.  Raises ExportError if the
        store does not answer, or has frames of other settings.
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
            complete_frames = frames - sum(len(blocks[index]) for index in missing)
            report_progress(complete_frames, frames)
            to_draw = {index: blocks[index] for index in missing}
            self._draw(executor, to_draw, Path(folder), lambda drawn: report_progress(complete_frames + drawn, frames))
            complete = self._joined(store, len(blocks))
        return ExportReport(self.url, frames - complete_frames, complete_frames, self.job.task.frames.skipped, complete)

    def _blocks(self) -> list[Numbers]:
        numbers = self.job.numbers
        return [numbers[first : first + self.block_frames] for first in range(0, len(numbers), self.block_frames)]

    def _claim(self, store: ObjectStore, folder: Path, manifest: dict[str, Any]) -> None:
        """Send the manifest, or compare it with the one in the store."""
        local = folder / NAME
        stored = store.read(NAME)
        if stored is not None:
            local.write_bytes(stored)
        try:
            claim(folder, manifest)
        except ExportError as error:
            raise ExportError(self.url, str(error).removeprefix(f"{folder}: ").removeprefix(f"{local}: ")) from error
        if stored is None:
            store.send(NAME, local.read_bytes())
        elif local.read_bytes() != stored:
            raise ExportError(self.url, "holds another number of frames; choose another prefix")

    def _missing(self, store: ObjectStore, wanted: list[int]) -> list[int]:
        complete = set(store.names("truth-"))
        return [index for index in wanted if _lines(index) not in complete]

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
