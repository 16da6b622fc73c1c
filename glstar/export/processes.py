"""Several processes of this machine that draw one export, each on an OpenGL context of its own."""

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
from types import TracebackType
from typing import Any, Final, Self

import numpy as np
from numpy.typing import NDArray

from glstar.errors import ExportError, GlstarError
from glstar.export.diskerrors import explain_disk_errors
from glstar.export.executors import check_frames, draw_frames, processors, split_into_chunks
from glstar.export.run import Export
from glstar.export.truthfile import TruthFile
from glstar.export.verify import CheckedFrame
from glstar.render.scene import Renderer
from glstar.system.interrupt import defer_interrupts

__all__ = ["ProcessExecutor"]

# A chunk at which so many have died is not tried again.
_TRIES: Final = 3
# Who is told to stop has a frame or two under way.
_PATIENCE_S: Final = 30.0


@dataclass(frozen=True, slots=True)
class _Ready:
    """A worker has its context: what it draws with."""

    driver: str


@dataclass(frozen=True, slots=True)
class _Frame:
    """A frame is there, or has been checked."""

    number: int
    checked: CheckedFrame | None = None


@dataclass(frozen=True, slots=True)
class _Done:
    """A task has ended."""


@dataclass(frozen=True, slots=True)
class _Task:
    """Frames to be drawn, and written unless it is a rehearsal or they are compared with what is there."""

    numbers: NDArray[np.int64]
    who: str = ""
    finishers: int = 0
    rehearsal: bool = False
    checks: bool = False


@dataclass(slots=True)
class _Worker:
    process: SpawnProcess
    connection: "Connection[Any, Any]"
    seat: int
    # What it has been given and has not done yet.
    left: set[int] = field(default_factory=set)
    idle: bool = True


class ProcessExecutor:
    """Processes that share the frames; a context manager, which ends them.

    Each opens an OpenGL context of its own.  Where GLSTAR_DEVICE lists several devices, as in ``0,1``, they take turns
    on them; on a software driver they share the processors out.  A worker that dies is replaced, and what it had not
    finished is drawn anew.

    Parameters
    ----------
    count : int
        How many.
    """

    apart = True

    def __init__(self, count: int) -> None:
        self.count = count
        self._spawn = get_context("spawn")
        self._crew: list[_Worker] = []
        self._driver = ""

    @property
    def driver(self) -> str:
        """What all of them draw with."""
        if not self._crew:
            for seat in range(self.count):
                self._crew.append(self._hire(seat))
            for seat in range(self.count):
                self._welcome(seat)
        return self._driver

    def preflight(self, export: Export, number: int) -> None:
        """Draw a frame and write nothing; see `Executor`."""
        for _ in range(_TRIES):
            worker = self._crew[0]
            with suppress(OSError):  # of one that has just died the answer tells
                worker.connection.send(export)
                worker.connection.send(_Task(np.array([number]), rehearsal=True))
            if self._answer(worker) is not None:
                return
            self._replace(worker)
        raise self._mourned(worker, {number})

    def draw(self, export: Export, numbers: NDArray[np.int64], truth: TruthFile) -> Generator[int, None, None]:
        """Draw frames and write them; see `Executor`."""
        for answer in self._shared_out(export, numbers, _Task(numbers, truth.who)):
            yield answer.number

    def check(self, export: Export, numbers: NDArray[np.int64]) -> Iterator[CheckedFrame]:
        """Draw frames again and compare them with the files in the directory; see `Checker`."""
        for answer in self._shared_out(export, numbers, _Task(numbers, checks=True)):
            assert answer.checked is not None
            yield answer.checked

    def _shared_out(self, export: Export, numbers: NDArray[np.int64], task: "_Task") -> "Iterator[_Frame]":
        """Share frames out among the workers; yield their answers, one a frame."""
        chunks = deque(split_into_chunks(numbers, self.count))
        died: Counter[int] = Counter()
        for worker in self._crew:
            with suppress(OSError):  # of one that has just died the answer tells
                worker.connection.send(export)
        while chunks or not all(worker.idle for worker in self._crew):
            for worker in self._crew:
                if worker.idle and chunks:
                    self._set_to_work(worker, replace(task, numbers=chunks.popleft()))
            at_work: dict[Any, _Worker] = {worker.connection: worker for worker in self._crew if not worker.idle}
            for connection in wait(list(at_work)):
                worker = at_work[connection]
                answer = self._answer(worker)
                if answer is None:
                    died.update(worker.left)
                    if max(died.values(), default=0) >= _TRIES:
                        raise self._mourned(worker, worker.left)
                    chunks.appendleft(np.array(sorted(worker.left), dtype=np.int64))
                    self._replace(worker).connection.send(export)
                elif isinstance(answer, _Done):
                    worker.idle = True
                elif isinstance(answer, _Frame):
                    worker.left.discard(answer.number)
                    yield answer

    def _hire(self, seat: int) -> _Worker:
        ours, theirs = self._spawn.Pipe()
        process = self._spawn.Process(target=_work, args=(theirs,), name=f"glstar-worker-{seat}", daemon=True)
        # NumPy and OpenGL read the settings as they are loaded.
        with _environment(_settings_of(seat, self.count)), _without_interrupts():
            process.start()
        theirs.close()  # or its death would not be noticed
        return _Worker(process, ours, seat)

    def _welcome(self, seat: int) -> None:
        """Wait until a worker is ready; one that dies meanwhile is replaced, a few times."""
        answer, tries = self._answer(self._crew[seat]), 1
        while answer is None and tries < _TRIES:
            self._crew[seat].connection.close()
            self._crew[seat] = self._hire(seat)
            answer, tries = self._answer(self._crew[seat]), tries + 1
        if not isinstance(answer, _Ready):
            raise self._mourned(self._crew[seat], set())
        if self._driver and answer.driver != self._driver:
            raise ExportError("workers", f"draw with different drivers, {self._driver} and {answer.driver}")
        self._driver = answer.driver

    def _set_to_work(self, worker: _Worker, task: "_Task") -> None:
        worker.left, worker.idle = set(task.numbers.tolist()), False
        # Of one that has just died the answer tells.
        with suppress(OSError):
            worker.connection.send(replace(task, finishers=_processors(self.count) - 1))

    def _replace(self, worker: _Worker) -> _Worker:
        worker.connection.close()
        worker.process.join()
        self._crew[worker.seat] = self._hire(worker.seat)
        self._welcome(worker.seat)
        return self._crew[worker.seat]

    def _answer(self, worker: _Worker) -> Any:
        """Return what a worker says, None if it has died; raise what it could not do."""
        try:
            answer = worker.connection.recv()
        except (EOFError, OSError):
            return None
        if isinstance(answer, BaseException):
            raise answer
        return answer

    def _mourned(self, worker: _Worker, left: set[int]) -> ExportError:
        worker.process.join(_PATIENCE_S)
        code = worker.process.exitcode
        how = signal.Signals(-code).name if code is not None and code < 0 else f"exit status {code}"
        at = f" at frame {min(left)}" if left else ""
        words = f"died{at} ({how}); is there memory for {self.count} of them? The same command goes on where it stopped"
        return ExportError("a worker", words)

    def close(self) -> None:
        """End them, each after the frames that it has under way; a second call does nothing."""
        for worker in self._crew:
            with suppress(OSError):
                worker.connection.send(None)
        for worker in self._crew:
            # What it still says must not fill the pipe, or it would wait for ever.
            with suppress(EOFError, OSError):
                while worker.connection.poll(_PATIENCE_S):
                    worker.connection.recv_bytes()
            worker.process.join(_PATIENCE_S)
            if worker.process.is_alive():
                worker.process.kill()
            worker.connection.close()
        self._crew = []

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()


def _settings_of(seat: int, count: int) -> dict[str, str]:
    """Return the environment of a worker: its device, and its share of the processors for what makes threads."""
    share = str(_processors(count))
    settings = {name: os.environ.get(name, share) for name in ("LP_NUM_THREADS", "OPENBLAS_NUM_THREADS")}
    devices = [device.strip() for device in os.environ.get("GLSTAR_DEVICE", "").split(",") if device.strip()]
    if devices:
        settings["GLSTAR_DEVICE"] = devices[seat % len(devices)]
    return settings


@contextmanager
def _environment(settings: dict[str, str]) -> Iterator[None]:
    """Lend the processes that are started meanwhile an environment."""
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
def _without_interrupts() -> Iterator[None]:
    """Hold back Ctrl-C, which reaches all processes of a terminal, from those that are started meanwhile.

    They inherit the mask and lift it when they ignore SIGINT.  Here the interrupt is raised afterwards: a process that
    is half started would fail.
    """
    if sys.platform == "win32":
        yield
        return
    resource_tracker.ensure_running()  # multiprocessing starts it with the first process, and would lift the mask
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        with defer_interrupts():
            yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def _processors(count: int) -> int:
    """Return how many processors each of so many workers has to itself."""
    return max(1, processors() // count)


# --- in the worker ----------------------------------------------------------------------------------------------------


def _work(connection: "Connection[Any, Any]") -> None:
    """Draw what is asked for, until told to stop or left alone."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C reaches all of a terminal; the parent stops its workers
    if sys.platform != "win32":
        signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGINT})
    from glstar.render.opengl import GLRenderer  # noqa: PLC0415 - OpenGL, where it is needed

    # Who asked may have gone: then nobody listens.
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
    export: Export | None = None
    while (asked := connection.recv()) is not None:
        if isinstance(asked, Export):
            export = asked
            continue
        assert isinstance(asked, _Task)
        assert export is not None
        if asked.rehearsal:
            export.draw(renderer, int(asked.numbers[0]))
        else:
            _draw(connection, renderer, export, asked)
        connection.send(_Done())


def _draw(connection: "Connection[Any, Any]", renderer: Renderer, export: Export, task: _Task) -> None:
    with explain_disk_errors(export.directory):
        for answer in _answers(renderer, export, task):
            try:
                connection.send(answer)
            except OSError:
                raise EOFError from None  # not the disk's fault
            if connection.poll():  # told to stop, or left alone
                return


def _answers(renderer: Renderer, export: Export, task: _Task) -> Iterator[_Frame]:
    if task.checks:
        for checked in check_frames(export, renderer, task.numbers, finishers=task.finishers):
            yield _Frame(checked.number, checked)
    else:
        truth = TruthFile(export.directory, task.who)
        for number in draw_frames(export, renderer, task.numbers, truth, apart=True, finishers=task.finishers):
            yield _Frame(number)
