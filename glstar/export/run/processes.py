"""Executor with several processes on this machine, each with an OpenGL context of its own."""

import os
import signal
import sys
import traceback
from collections import Counter, deque
from collections.abc import Generator, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field, replace
from multiprocessing import get_context, resource_tracker
from multiprocessing.connection import Connection, wait
from multiprocessing.context import SpawnProcess
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from glstar.errors import ExportError, GlstarError
from glstar.export.directory import explain_disk_errors
from glstar.export.frame import CheckedFrame, FrameTask
from glstar.export.run.executors import (
    OnPixels,
    SerialExecutor,
    available_processors,
    check_frames,
    draw_frames,
    split_into_chunks,
)
from glstar.export.truth.lines import TruthFile
from glstar.render.scene.scene import Renderer
from glstar.system.process import defer_interrupts

# Workers that may die while they draw one frame, or while they start, before the export fails.
_MAX_DEATHS = 3
# Time for a worker to finish the frames that it has begun, before it is killed, s.
_STOP_TIMEOUT_S = 30.0
# Signals that every process of a terminal receives, by Ctrl-C and when it is closed: the parent stops its workers.
_OF_TERMINAL = {signal.Signals[name] for name in ("SIGINT", "SIGHUP") if name in signal.Signals.__members__}


@dataclass(frozen=True, slots=True)
class _Ready:
    """Answer of a worker that has opened its OpenGL context."""

    driver: str


@dataclass(frozen=True, slots=True)
class _FrameDone:
    """Answer of a worker that has written or checked a frame."""

    number: int
    checked: CheckedFrame | None = None


@dataclass(frozen=True, slots=True)
class _ChunkDone:
    """Answer of a worker that has finished a chunk."""


@dataclass(frozen=True, slots=True)
class _Chunk:
    """Request to draw and write frames, to check them, or to draw one and write nothing (`is_preflight`)."""

    numbers: NDArray[np.int64]
    shard_label: str = ""
    encoder_threads: int = 0
    is_preflight: bool = False
    is_check: bool = False


@dataclass(slots=True)
class _Worker:
    process: SpawnProcess
    connection: "Connection[Any, Any]"
    index: int
    # Frames of its chunk that are not done yet.
    remaining: set[int] = field(default_factory=set)
    is_idle: bool = True


class ProcessExecutor:
    """Processes that share the frames; a context manager, which stops them.

    Each process opens an OpenGL context of its own. If GLSTAR_DEVICE lists several devices, as in ``0,1``, the
    processes are assigned to them in turn. With a software driver they divide the processors between them. A worker
    that dies is replaced, and the frames that it had not finished are drawn again.
    """

    writes_parts = True

    def __init__(self, count: int) -> None:
        self.count = count
        self._spawn = get_context("spawn")
        self._workers: list[_Worker] = []
        self._driver = ""

    @property
    def driver(self) -> str:
        """The OpenGL driver, the same in all processes."""
        if not self._workers:
            for index in range(self.count):
                self._workers.append(self._start(index))
            for index in range(self.count):
                self._wait_until_ready(index)
        return self._driver

    def preflight(self, task: FrameTask, number: int) -> None:
        """Draw a frame and write nothing; see `Executor`."""
        for _ in range(_MAX_DEATHS):
            worker = self._workers[0]
            with suppress(OSError):  # it has just died, which _receive reports
                worker.connection.send(task)
                worker.connection.send(_Chunk(np.array([number]), is_preflight=True))
            if self._receive(worker) is not None:
                return
            self._replace(worker)
        raise self._death_error(worker, {number})

    def draw(self, task: FrameTask, numbers: NDArray[np.int64], truth: TruthFile) -> Generator[int, None, None]:
        """Draw frames and write them; see `Executor`."""
        for answer in self._distribute(task, numbers, _Chunk(numbers, truth.shard_label)):
            yield answer.number

    def check(self, task: FrameTask, numbers: NDArray[np.int64]) -> Iterator[CheckedFrame]:
        """Draw frames again and compare them with the files of the directory; see `Checker`."""
        for answer in self._distribute(task, numbers, _Chunk(numbers, is_check=True)):
            assert answer.checked is not None
            yield answer.checked

    def _distribute(self, task: FrameTask, numbers: NDArray[np.int64], request: _Chunk) -> Iterator[_FrameDone]:
        """Distribute frames among the workers in chunks; yield an answer for each frame."""
        chunks = deque(split_into_chunks(numbers, self.count, task.frames.firsts))
        deaths: Counter[int] = Counter()
        for worker in self._workers:
            with suppress(OSError):  # it has just died, which _receive reports
                worker.connection.send(task)
        while chunks or not all(worker.is_idle for worker in self._workers):
            for worker in self._workers:
                if worker.is_idle and chunks:
                    self._assign(worker, replace(request, numbers=chunks.popleft()))
            busy: dict[Any, _Worker] = {worker.connection: worker for worker in self._workers if not worker.is_idle}
            for connection in wait(list(busy)):
                worker = busy[connection]
                answer = self._receive(worker)
                if answer is None:
                    deaths.update(worker.remaining)
                    if max(deaths.values(), default=0) >= _MAX_DEATHS:
                        raise self._death_error(worker, worker.remaining)
                    chunks.appendleft(np.array(sorted(worker.remaining), dtype=np.int64))
                    self._replace(worker).connection.send(task)
                elif isinstance(answer, _ChunkDone):
                    worker.is_idle = True
                elif isinstance(answer, _FrameDone):
                    worker.remaining.discard(answer.number)
                    yield answer

    def _start(self, index: int) -> _Worker:
        ours, theirs = self._spawn.Pipe()
        process = self._spawn.Process(target=_worker_main, args=(theirs,), name=f"glstar-worker-{index}", daemon=True)
        # NumPy and OpenGL read these variables when they are loaded.
        with _environment(_worker_environment(index, self.count)), _block_interrupts():
            process.start()
        theirs.close()  # otherwise the pipe would stay open when the worker dies
        return _Worker(process, ours, index)

    def _wait_until_ready(self, index: int) -> None:
        """Wait until a worker has its OpenGL context; a worker that dies is replaced, a few times."""
        answer, starts = self._receive(self._workers[index]), 1
        while answer is None and starts < _MAX_DEATHS:
            self._workers[index].connection.close()
            self._workers[index] = self._start(index)
            answer, starts = self._receive(self._workers[index]), starts + 1
        if not isinstance(answer, _Ready):
            raise self._death_error(self._workers[index], set())
        if self._driver and answer.driver != self._driver:
            raise ExportError("workers", f"draw with different drivers, {self._driver} and {answer.driver}")
        self._driver = answer.driver

    def _assign(self, worker: _Worker, chunk: _Chunk) -> None:
        worker.remaining, worker.is_idle = set(chunk.numbers.tolist()), False
        with suppress(OSError):  # it has just died, which _receive reports
            worker.connection.send(replace(chunk, encoder_threads=_processors_per_worker(self.count) - 1))

    def _replace(self, worker: _Worker) -> _Worker:
        worker.connection.close()
        worker.process.join()
        self._workers[worker.index] = self._start(worker.index)
        self._wait_until_ready(worker.index)
        return self._workers[worker.index]

    def _receive(self, worker: _Worker) -> Any:
        """Return the next answer of a worker, or None if it has died; raise the exception that it sent."""
        try:
            answer = worker.connection.recv()
        except (EOFError, OSError):
            return None
        if isinstance(answer, BaseException):
            raise answer
        return answer

    def _death_error(self, worker: _Worker, remaining: set[int]) -> ExportError:
        worker.process.join(_STOP_TIMEOUT_S)
        code = worker.process.exitcode
        how = signal.Signals(-code).name if code is not None and code < 0 else f"exit status {code}"
        at = f" at frame {min(remaining)}" if remaining else ""
        message = (
            f"died{at} ({how}); is there memory for {self.count} of them? The same command goes on where it stopped"
        )
        return ExportError("a worker", message)

    def close(self) -> None:
        """Stop the workers after the frames that they have begun; a second call does nothing."""
        for worker in self._workers:
            with suppress(OSError):
                worker.connection.send(None)
        for worker in self._workers:
            # Read its remaining answers: a worker with a full pipe would never end.
            with suppress(EOFError, OSError):
                while worker.connection.poll(_STOP_TIMEOUT_S):
                    worker.connection.recv_bytes()
            worker.process.join(_STOP_TIMEOUT_S)
            if worker.process.is_alive():
                worker.process.kill()
            worker.connection.close()
        self._workers = []

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def _worker_environment(index: int, count: int) -> dict[str, str]:
    """Return the environment variables of a worker: its OpenGL device, and thread counts of LLVMpipe and OpenBLAS."""
    usual = {"LP_NUM_THREADS": str(_processors_per_worker(count)), "OPENBLAS_NUM_THREADS": "1"}
    settings = {name: os.environ.get(name, threads) for name, threads in usual.items()}
    devices = [device.strip() for device in os.environ.get("GLSTAR_DEVICE", "").split(",") if device.strip()]
    if devices:
        settings["GLSTAR_DEVICE"] = devices[index % len(devices)]
    return settings


@contextmanager
def _environment(settings: dict[str, str]) -> Iterator[None]:
    """Set environment variables for processes that are started in this context."""
    before = {name: os.environ.get(name) for name in settings}
    os.environ.update(settings)
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value


@contextmanager
def _block_interrupts() -> Iterator[None]:
    """Keep `_OF_TERMINAL` from processes that are started in this context.

    They inherit the signal mask and lift it once they ignore the signals.  In this process the interrupt is raised when
    the context ends: a half-started process would fail.
    """
    if sys.platform == "win32":
        yield
        return
    resource_tracker.ensure_running()  # multiprocessing starts it with the first process, which would lift the mask
    before = signal.pthread_sigmask(signal.SIG_BLOCK, _OF_TERMINAL)
    try:
        with defer_interrupts():
            yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def _processors_per_worker(count: int) -> int:
    """Return the number of processors for each of `count` workers, at least 1."""
    return max(1, available_processors() // count)


# --- in the worker ----------------------------------------------------------------------------------------------------


def _worker_main(connection: "Connection[Any, Any]") -> None:
    """Serve requests until the parent sends None or closes the pipe."""
    for number in _OF_TERMINAL:
        signal.signal(number, signal.SIG_IGN)
    if sys.platform != "win32":
        signal.pthread_sigmask(signal.SIG_UNBLOCK, _OF_TERMINAL)
    from glstar.render.opengl import GLRenderer  # noqa: PLC0415 - OpenGL only where it is needed

    # The parent may have died: then there is no one to answer.
    with suppress(EOFError, OSError):
        try:
            with GLRenderer.headless() as renderer:
                connection.send(_Ready(renderer.driver))
                _serve(connection, renderer)
        except GlstarError as error:
            connection.send(error)
        except Exception:
            connection.send(RuntimeError(traceback.format_exc()))


def _serve(connection: "Connection[Any, Any]", renderer: Renderer) -> None:
    task: FrameTask | None = None
    while (request := connection.recv()) is not None:
        if isinstance(request, FrameTask):
            task = request
            continue
        assert isinstance(request, _Chunk)
        assert task is not None
        if request.is_preflight:
            task.draw(renderer, int(request.numbers[0]))
        else:
            _send_frames(connection, renderer, task, request)
        connection.send(_ChunkDone())


def _send_frames(connection: "Connection[Any, Any]", renderer: Renderer, task: FrameTask, chunk: _Chunk) -> None:
    with explain_disk_errors(task.directory):
        for answer in _frames(renderer, task, chunk):
            try:
                connection.send(answer)
            except OSError:
                raise EOFError from None  # an error of the pipe, not of the disk
            if connection.poll():  # None, or the end of the pipe
                return


def _frames(renderer: Renderer, task: FrameTask, chunk: _Chunk) -> Iterator[_FrameDone]:
    threads = chunk.encoder_threads
    if chunk.is_check:
        for checked in check_frames(task, renderer, chunk.numbers, encoder_threads=threads):
            yield _FrameDone(checked.number, checked)
    else:
        truth = TruthFile(task.directory, chunk.shard_label)
        for number in draw_frames(task, renderer, chunk.numbers, truth, as_part=True, encoder_threads=threads):
            yield _FrameDone(number)


@contextmanager
def local_executor(workers: int, on_pixels: OnPixels | None = None) -> Iterator[ProcessExecutor | SerialExecutor]:
    """Open an executor with several processes, or with this one, which calls `on_pixels` as `SerialExecutor` does."""
    if workers > 1:
        with ProcessExecutor(workers) as processes:
            yield processes
        return
    from glstar.render.opengl import GLRenderer  # noqa: PLC0415 - OpenGL, where this process draws

    with GLRenderer.headless() as renderer:
        yield SerialExecutor(renderer, on_pixels=on_pixels)
