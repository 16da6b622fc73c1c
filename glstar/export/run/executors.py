"""Executors draw the frames of a task: in this process, in several processes, or on a Dask cluster.

This module has the interface, the executor that uses the calling process only, and the functions with which every
process draws, writes and checks frames, in a pipeline of threads.  While a frame is drawn, the next is composed and
earlier frames are encoded and written.
"""

import os
from collections import deque
from collections.abc import Callable, Generator, Iterable, Iterator, Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import ExitStack, closing, suppress
from functools import partial
from itertools import islice
from typing import Any, Protocol, TypeVar, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from glstar.errors import ExportError
from glstar.export.frame import CheckedFrame, EncodedFrame, FrameTask, FrameWriter, check_files
from glstar.export.plan.frames import ComposedFrame
from glstar.export.truth.lines import TruthFile
from glstar.render.scene.scene import Frame, PendingFrame, Renderer

A = TypeVar("A")
B = TypeVar("B")
C = TypeVar("C")
D = TypeVar("D")

# Items composed ahead of drawing: one in progress and one ready.
_AHEAD = 2


def pipelined(
    items: Iterable[A],
    compose: Callable[[A], B],
    begin: Callable[[B], None],
    end: Callable[[], C],
    encode: Callable[[C], D],
    *,
    encoder_threads: int = 1,
) -> Generator[D, None, None]:
    """Take items through three steps that run concurrently, and yield the results in the order of the items.

    `compose` runs on a thread of its own, one or two items ahead. `begin` and `end` run on the caller's thread, which
    owns the OpenGL context; `begin` is called for an item before `end` is called for the item before it, so that the
    GPU never waits for a read. `encode` runs on `encoder_threads` threads; if 0, all steps run on the caller's thread:
    for processes that share the processors with others. Only a few items are in progress at a time. Raises the
    exception of a step at the position of its item; no further step begins for later items.
    """
    if encoder_threads:
        yield from _threaded(items, compose, begin, end, encode, encoder_threads)
    else:
        yield from map(encode, _drawn(map(compose, items), begin, end))


def _threaded(
    items: Iterable[A],
    compose: Callable[[A], B],
    begin: Callable[[B], None],
    end: Callable[[], C],
    encode: Callable[[C], D],
    encoder_threads: int,
) -> Generator[D, None, None]:
    waiting = iter(items)
    composed: deque[Future[B]] = deque()
    encoded: deque[Future[D]] = deque()
    with (
        ThreadPoolExecutor(1, "glstar-compose") as composer,
        ThreadPoolExecutor(encoder_threads, "glstar-encode") as encoders,
    ):
        try:
            composed.extend(composer.submit(compose, item) for item in islice(waiting, _AHEAD))

            def ready() -> Iterator[B]:
                while composed:
                    item = composed.popleft().result()
                    composed.extend(composer.submit(compose, item) for item in islice(waiting, 1))
                    yield item

            for drawn in _drawn(ready(), begin, end):
                encoded.append(encoders.submit(encode, drawn))
                while encoded and (len(encoded) > encoder_threads + 1 or encoded[0].done()):
                    yield encoded.popleft().result()
            while encoded:
                yield encoded.popleft().result()
        finally:
            for composing in composed:
                composing.cancel()
            for encoding in encoded:
                encoding.cancel()


def _drawn(composed: Iterable[B], begin: Callable[[B], None], end: Callable[[], C]) -> Iterator[C]:
    """Yield the result of `end` for each item, after `begin` of the next item."""
    in_progress = False
    for item in composed:
        begin(item)
        if in_progress:
            yield end()
        in_progress = True
    if in_progress:
        yield end()


T = TypeVar("T")
OnPixels = Callable[[int, NDArray[Any], bytes], None]

# Chunks per worker: enough to balance workers of different speed, and each chunk leaves one part of the truth.
_CHUNKS_PER_WORKER = 8
# An image of fewer pixels is encoded sooner than another thread gets Python's lock: more threads delay each other.
_FEWEST_PX_FOR_THREADS = 1_000_000
# Pixels for which one more thread has work: compressing them takes as long as Python needs for a frame.
_PX_PER_THREAD = 4_000_000
# Frames per chunk at most, so that a worker that dies costs little.
_MAX_CHUNK_FRAMES = 1000


def available_processors() -> int:
    """Return the number of processors of this process, which the scheduler of a cluster may have limited."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


class Executor(Protocol):
    """Draws and writes frames."""

    writes_parts: bool  # Whether several processes write, each a part of the truth in a file of its own

    @property
    def driver(self) -> str:
        """The OpenGL driver, the same in all processes."""
        ...

    def preflight(self, task: FrameTask, number: int) -> None:
        """Draw a frame and write nothing, so that an error occurs before a directory is created."""
        ...

    def draw(self, task: FrameTask, numbers: NDArray[np.int64], truth: TruthFile) -> Generator[int, None, None]:
        """Draw frames and write them with their truth; yield the number of each once all of it is written."""
        ...


# Draws a block with its index and frame numbers on a renderer, with a number of encoder threads, and writes it.
BlockWork = Callable[[FrameTask, Renderer, int, NDArray[np.int64], int], None]


@runtime_checkable
class BlockExecutor(Protocol):
    """An executor whose workers can write frames elsewhere than in a directory that all of them see."""

    def draw_blocks(self, work: BlockWork, blocks: Mapping[int, NDArray[np.int64]]) -> Generator[int, None, None]:
        """Call a function that can be pickled for each block, (n,) frame numbers by its index, on a worker.

        Yields the number of frames of each block, in any order, once `work` has returned.
        """
        ...


class Checker(Protocol):
    """Draws frames again and compares them with the files of a directory."""

    @property
    def driver(self) -> str:
        """The OpenGL driver, the same in all processes."""
        ...

    def check(self, task: FrameTask, numbers: NDArray[np.int64]) -> Iterator[CheckedFrame]:
        """Draw frames again, in any order, and compare them with the files of the directory; nothing is written."""
        ...


class SerialExecutor:
    """Draws in the calling process, on the OpenGL context of the calling thread.

    `on_pixels` is called on this thread, in the order of the frames, with the number, the pixels and the line of truth
    of each frame that `draw` draws, before it is encoded.
    """

    writes_parts = False

    def __init__(self, renderer: Renderer, *, on_pixels: OnPixels | None = None) -> None:
        self._renderer, self._on_pixels = renderer, on_pixels

    @property
    def driver(self) -> str:
        """The OpenGL driver."""
        return self._renderer.driver

    def preflight(self, task: FrameTask, number: int) -> None:
        """Draw a frame and write nothing; see `Executor`."""
        task.draw(self._renderer, number)

    def draw(self, task: FrameTask, numbers: NDArray[np.int64], truth: TruthFile) -> Generator[int, None, None]:
        """Draw frames and write them; see `Executor`."""
        if self._on_pixels is None:
            yield from draw_frames(task, self._renderer, numbers, truth)
        else:
            yield from draw_frames(task, self._renderer, numbers, truth, encoder_threads=0, on_pixels=self._on_pixels)

    def check(self, task: FrameTask, numbers: NDArray[np.int64]) -> Iterator[CheckedFrame]:
        """Draw frames again and compare them with the files of the directory; see `Checker`."""
        yield from check_frames(task, self._renderer, numbers)


def draw_frames(
    task: FrameTask,
    renderer: Renderer,
    numbers: NDArray[np.int64],
    truth: TruthFile,
    *,
    as_part: bool = False,
    encoder_threads: int | None = None,
    on_pixels: OnPixels | None = None,
) -> Generator[int, None, None]:
    """Draw frames and write them, in a pipeline; yield the number of each once its files and its truth are written.

    `renderer` belongs to the calling thread. With `as_part` the truth is a part of its own, because other processes
    write at the same time. `encoder_threads` encode and write, at most: one for each available processor if None, and 0
    for a process that shares the processors with others; small images take fewer. `on_pixels` is called with the
    number, the pixels and the line of truth of each frame on the thread that encodes it.
    """
    with ExitStack() as opened:
        with task.writing():
            lines = opened.enter_context(truth.open_for_append(as_part=as_part))
        writer = opened.enter_context(FrameWriter(truth, lines, writing=task.writing))

        def stage(frame: EncodedFrame) -> tuple[int, bytes]:
            task.write(frame, partial(writer.stage, frame.number))
            return frame.number, frame.truth

        try:
            with closing(_pipeline(task, renderer, numbers, stage, encoder_threads, on_pixels)) as staged:
                for number, line in staged:
                    yield from writer.add(number, line)
        except Exception:
            with suppress(OSError, ExportError):  # frames before the failed one are kept and counted
                yield from writer.drain()
            raise
        yield from writer.drain()


def check_frames(
    task: FrameTask, renderer: Renderer, numbers: NDArray[np.int64], *, encoder_threads: int | None = None
) -> Generator[CheckedFrame, None, None]:
    """Draw frames again and compare them with the files of the directory, in the pipeline of `draw_frames`."""
    yield from _pipeline(task, renderer, numbers, partial(check_files, task), encoder_threads)


def _pipeline(
    task: FrameTask,
    renderer: Renderer,
    numbers: NDArray[np.int64],
    use: Callable[[EncodedFrame], T],
    encoder_threads: int | None,
    on_pixels: OnPixels | None = None,
) -> Generator[T, None, None]:
    """Yield the result of `use` for each frame, which is called on an encoder thread."""
    in_progress: deque[tuple[ComposedFrame, PendingFrame]] = deque()

    def begin(composed: ComposedFrame) -> None:
        in_progress.append((composed, task.begin(renderer, composed)))

    def end() -> tuple[ComposedFrame, Frame]:
        composed, pending = in_progress.popleft()
        return composed, pending.frame()

    def encode(rendered: tuple[ComposedFrame, Frame]) -> T:
        publish = None if on_pixels is None else partial(on_pixels, rendered[0].number)
        return use(task.encode(*rendered, on_pixels=publish))

    most = available_processors() if encoder_threads is None else encoder_threads
    encoder_threads = min(most, _useful_encoders(task, numbers)) if most else 0
    try:
        yield from pipelined(numbers.tolist(), task.frames.compose, begin, end, encode, encoder_threads=encoder_threads)
    finally:
        for _, pending in in_progress:
            pending.discard()


def _useful_encoders(task: FrameTask, numbers: NDArray[np.int64]) -> int:
    """Return the number of encoder threads beyond which an export is not faster."""
    if not len(numbers):
        return 0
    camera = task.frames.shot(int(numbers[0])).simulator.camera
    pixels = camera.width_px * camera.height_px
    return 0 if pixels < _FEWEST_PX_FOR_THREADS else 2 + pixels // _PX_PER_THREAD


def split_into_chunks(numbers: NDArray[np.int64], workers: int, firsts: NDArray[np.int64]) -> list[NDArray[np.int64]]:
    """Divide frames into chunks, each drawn by one worker at a time.

    A chunk ends before one of `firsts`, `Frames.firsts`, where it can, because each worker that draws frames of a
    sample prepares its flight and its stars: with chunks that end elsewhere, two workers prepare each sample. Chunks
    are half as long to one and a half times as long as equal parts, but for the last.
    """
    size = min(max(1, -(-len(numbers) // (_CHUNKS_PER_WORKER * workers))), _MAX_CHUNK_FRAMES)
    ends = np.unique(np.searchsorted(numbers, firsts))
    chunks, start = [], 0
    while start < len(numbers):
        near = ends[(ends >= start + (size + 1) // 2) & (ends <= start + min(3 * size // 2, _MAX_CHUNK_FRAMES))]
        end = int(near[np.argmin(np.abs(near - start - size))]) if near.size else start + size
        chunks.append(numbers[start:end])
        start = end
    return chunks
