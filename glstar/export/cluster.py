"""The workers of a Dask cluster that draw one export, on machines that share its disk."""

import asyncio
import logging
import os
import re
import socket
from collections.abc import Callable, Generator, Iterator
from concurrent.futures import CancelledError, ThreadPoolExecutor
from contextlib import contextmanager, suppress
from dataclasses import replace
from pathlib import Path
from secrets import token_hex
from types import TracebackType
from typing import Any, Final, Self

import numpy as np
from distributed import Client, Worker, WorkerPlugin, as_completed, get_worker
from distributed.comm import CommClosedError, connect
from distributed.scheduler import KilledWorker
from distributed.security import Security
from numpy.typing import NDArray

from glstar import __version__
from glstar.errors import ExportError, GlstarError
from glstar.export.diskerrors import explain_disk_errors
from glstar.export.executors import draw_frames, split_into_chunks
from glstar.export.fingerprint import differences, fingerprint
from glstar.export.lease import Lease
from glstar.export.manifest import NAME
from glstar.export.run import Export
from glstar.export.truthfile import TruthFile
from glstar.render.opengl import GLRenderer

__all__ = ["DaskExecutor"]

# How long to wait for a scheduler to say its name, to take a client, and for the first of its workers, s.
_ANSWER_TIMEOUT_S: Final = 3
_SCHEDULER_TIMEOUT_S: Final = 5
_WORKERS_TIMEOUT_S: Final = 20
# How often a chunk is tried again, by whatever worker, after an error of the worker's.
_RETRIES: Final = 2
_AGAIN: Final = "the same command goes on where it stopped"
_START: Final = "start one: dask scheduler"


class DaskExecutor:
    """The workers of a Dask scheduler; a context manager, which lets them go.

    Each opens an OpenGL context of its own, on the device that its environment names as GLSTAR_DEVICE, and keeps it
    from one chunk of frames to the next.  What comes back are numbers only: images and truth go straight to the disk,
    which all must see under one path.  A worker that dies costs its chunk, which another draws anew.  A worker that
    would draw other bytes than the rest (another glstar, driver or library) is refused before it draws.

    Parameters
    ----------
    address : str
        The scheduler's, as in ``tcp://10.0.0.1:8786``.
    export : Export
        What they shall draw.

    Raises
    ------
    ExportError
        If there is no scheduler, it has no workers, or they differ from this process in what they draw.
    """

    apart = True

    def __init__(self, address: str, export: Export) -> None:
        self._address = address
        self._name = f"glstar-{token_hex(6)}"
        self._files = export.frames.files
        self._fingerprint: dict[str, str] = {}
        # What they have to say of a scheduler that has gone comes to the user in the words below.
        logging.getLogger("distributed").setLevel(logging.CRITICAL)
        logging.getLogger("distributed.client").setLevel(logging.CRITICAL + 1)
        _check_that_a_scheduler_answers(address)
        with self._words():
            self._client = Client(address, timeout=_SCHEDULER_TIMEOUT_S, set_as_default=False)
        try:
            with self._words():
                self._client.wait_for_workers(1, timeout=_WORKERS_TIMEOUT_S)
                self._refuse_other_versions()
                # A worker runs in a directory of its own.
                absolute = replace(export, directory=export.directory.absolute())
                self._client.register_plugin(_Drawer(absolute), name=self._name)
        except BaseException:
            self._client.close()
            raise

    @property
    def driver(self) -> str:
        """What all of them draw with."""
        return self._agreed()["OpenGL"]

    def _refuse_other_versions(self) -> None:
        """Refuse workers whose glstar is of another version: what this one sends may mean something else to them."""
        for worker, theirs in self._ask(_version_of).items():
            if theirs != __version__:
                raise self._differs(worker, f"glstar {theirs}, not {__version__}")

    def _agreed(self) -> dict[str, str]:
        """Return what decides the bytes that all workers draw."""
        if not self._fingerprint:
            found = self._ask(_fingerprint_of, self._name)
            # This process draws nothing: its own driver does not matter.
            expected = fingerprint(next(iter(found.values()))["OpenGL"], self._files)
            for worker, theirs in found.items():
                if differing := differences(expected, theirs):
                    raise self._differs(worker, differing)
            self._fingerprint = expected
        return self._fingerprint

    def _ask(self, question: Callable[..., Any], *arguments: Any) -> dict[str, Any]:
        """Return what each worker answers."""
        with self._words():
            answers: dict[str, Any] = self._client.run(question, *arguments, on_error="return")
        for worker, answer in answers.items():
            if isinstance(answer, GlstarError):
                raise answer
            if isinstance(answer, ImportError):
                raise self._differs(worker, f"no glstar that it can import ({answer})")
            if isinstance(answer, BaseException):
                raise self._differs(worker, f"a glstar that does not understand this one ({_brief(answer)})")
        return answers

    def _differs(self, worker: str, how: str) -> ExportError:
        words = f"the worker {worker} has {how}: its frames would differ; install the same on all workers and here"
        return ExportError(self._address, words)

    def preflight(self, export: Export, number: int) -> None:  # noqa: ARG002 - they have it already
        """Draw a frame and write nothing; see `Executor`."""
        with self._words():
            self._client.submit(_rehearse, self._name, number, pure=False).result()

    def draw(self, export: Export, numbers: NDArray[np.int64], truth: TruthFile) -> Generator[int, None, None]:
        """Draw frames and write them; see `Executor`."""
        hands = sum(self._client.nthreads().values())
        asked = {"who": truth.who, "expected": self._agreed(), "lease": _absolute(export.lease)}
        with self._words():
            futures = [
                self._client.submit(_draw, self._name, chunk, **asked, pure=False, retries=_RETRIES)
                for chunk in split_into_chunks(numbers, hands)
            ]
            try:
                for future in as_completed(futures, loop=self._client.loop):
                    yield from future.result()
                    future.release()
            finally:
                with suppress(Exception):
                    self._client.cancel(futures)

    @contextmanager
    def _words(self) -> Iterator[None]:
        """Turn what Dask says into what the user can do."""
        try:
            yield
        except KilledWorker as error:
            words = f"its workers died one after the other ({error.last_worker.address}); is there memory? {_AGAIN}"
            raise ExportError(self._address, words) from error
        except (CancelledError, CommClosedError) as error:
            raise ExportError(self._address, f"the Dask scheduler has gone; start it again, {_AGAIN}") from error
        except TimeoutError as error:
            words = f"has no workers after {_WORKERS_TIMEOUT_S} s; start one: dask worker {self._address} --nthreads 1"
            raise ExportError(self._address, words) from error
        except (OSError, ValueError) as error:
            raise ExportError(self._address, f"no Dask scheduler answers there ({_brief(error)}); {_START}") from error

    def close(self) -> None:
        """Let the workers go; a second call does nothing."""
        with suppress(Exception):  # a scheduler that has gone knows no plugins
            self._client.unregister_worker_plugin(self._name)
        self._client.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()


# --- on the workers ---------------------------------------------------------------------------------------------------


class _Drawer(WorkerPlugin):  # type: ignore[misc]
    """One worker's renderer, and the thread that it lives on: contexts belong to threads, and Dask's come and go."""

    def __init__(self, export: Export) -> None:
        self._export = export
        self._thread: ThreadPoolExecutor | None = None
        self._renderer: GLRenderer | None = None
        self.finishers = 0

    def setup(self, worker: Worker) -> None:
        """Make ready; the context is opened when it is needed."""
        # As many threads of a software driver as the worker has.
        os.environ.setdefault("LP_NUM_THREADS", str(worker.state.nthreads))
        self.finishers = worker.state.nthreads - 1
        self._thread = ThreadPoolExecutor(1, "glstar-gl")

    def teardown(self, worker: Worker) -> None:  # noqa: ARG002 - Dask's signature
        """Give the context back, after the chunk at hand."""
        if self._thread is not None:
            self._thread.submit(self._close)
            self._thread.shutdown(wait=False)

    def _close(self) -> None:
        if self._renderer is not None:
            self._renderer.close()

    def _opened(self) -> GLRenderer:
        if self._renderer is None:
            self._renderer = GLRenderer.headless()
        return self._renderer

    def fingerprint(self) -> dict[str, str]:
        """Return what decides the bytes that this worker draws."""
        found: dict[str, str] = self.on_its_thread(lambda _, renderer: self.fingerprint_with(renderer))
        return found

    def fingerprint_with(self, renderer: GLRenderer) -> dict[str, str]:
        """Return the same, on the renderer's thread."""
        return fingerprint(renderer.driver, self._export.frames.files)

    def on_its_thread(self, work: Any, *arguments: Any) -> Any:
        """Return what comes of some work on the renderer's thread."""
        assert self._thread is not None
        return self._thread.submit(lambda: work(self._export, self._opened(), *arguments)).result()


def _version_of() -> str:
    import glstar  # noqa: PLC0415 - the worker's own

    return glstar.__version__


def _fingerprint_of(name: str, dask_worker: Worker) -> dict[str, str]:
    found: dict[str, str] = dask_worker.plugins[name].fingerprint()
    return found


def _rehearse(name: str, number: int) -> None:
    get_worker().plugins[name].on_its_thread(lambda export, renderer: export.draw(renderer, number) and None)


def _draw(name: str, numbers: NDArray[np.int64], *, who: str, expected: dict[str, str], lease: Lease) -> list[int]:
    """Draw a chunk; return the numbers of its frames."""
    drawer = get_worker().plugins[name]
    host = socket.gethostname()

    def work(export: Export, renderer: GLRenderer) -> list[int]:
        export = replace(export, lease=lease)
        # A worker may have joined since the others were asked.
        if differing := differences(expected, drawer.fingerprint_with(renderer)):
            raise ExportError(export.directory, f"the worker {get_worker().address} on {host} has {differing}")
        if not Path(export.directory, NAME).exists():
            words = f"is not on the disk of {host}; all workers must see it under this path"
            raise ExportError(export.directory, words)
        truth = TruthFile(export.directory, who)
        with explain_disk_errors(export.directory):
            return list(draw_frames(export, renderer, numbers, truth, apart=True, finishers=drawer.finishers))

    drawn: list[int] = drawer.on_its_thread(work)
    return drawn


def _brief(error: BaseException) -> str:
    return f"{type(error).__name__}: {(str(error).splitlines() or [''])[0]}"


def _absolute(lease: Lease | None) -> Lease | None:
    return None if lease is None else Lease(lease.path.absolute())


def _check_that_a_scheduler_answers(address: str) -> None:
    """Raise unless a Dask scheduler says its name: Dask's own client tries for most of a minute, or for ever."""
    if re.fullmatch(r"([a-z+]+://)?\S*:\d{1,5}/?", address) is None:
        words = "is no address of a Dask scheduler; it is written as in --dask tcp://10.0.0.1:8786"
        raise ExportError(address or "--dask", words)
    try:
        kind = asyncio.run(asyncio.wait_for(_kind_of_server(address), _ANSWER_TIMEOUT_S))
    except Exception as error:  # whatever another server answers, or a connection raises
        words = f"nothing in {_ANSWER_TIMEOUT_S} s" if isinstance(error, TimeoutError) else _brief(error)
        raise ExportError(address, f"no Dask scheduler answers there ({words}); {_START}") from error
    if kind != "Scheduler":
        raise ExportError(address, f"is the address of a Dask {str(kind).lower()}; give that of its scheduler")


async def _kind_of_server(address: str) -> object:
    """Ask who listens at an address."""
    arguments = Security().get_connection_args("client")
    connection = await connect(address, timeout=_ANSWER_TIMEOUT_S, **arguments)
    try:
        await connection.write({"op": "identity", "reply": True})
        answer = await connection.read()
        return answer["type"]
    finally:
        connection.abort()
