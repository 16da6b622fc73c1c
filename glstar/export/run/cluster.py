"""Executor with the workers of a Dask cluster, on machines that share a disk."""

import asyncio
import logging
import os
import re
import socket
from collections.abc import Callable, Generator, Iterator, Mapping
from concurrent.futures import CancelledError, ThreadPoolExecutor
from contextlib import contextmanager, suppress
from dataclasses import replace
from pathlib import Path
from secrets import token_hex
from typing import Any, Self

import numpy as np
from distributed import Client, Worker, WorkerPlugin, as_completed, get_worker
from distributed.comm import CommClosedError, connect
from distributed.scheduler import KilledWorker
from distributed.security import Security
from numpy.typing import NDArray

from glstar import __version__
from glstar.errors import ExportError, GlstarError
from glstar.export.directory import Lease, explain_disk_errors
from glstar.export.frame import FrameTask
from glstar.export.plan.manifest import NAME, differences, fingerprint
from glstar.export.run.executors import BlockWork, draw_frames, split_into_chunks
from glstar.export.truth.lines import TruthFile
from glstar.render.opengl import GLRenderer

# Timeouts for a scheduler to identify itself, to accept a client, and to have its first worker, s.
_ANSWER_TIMEOUT_S = 3
_SCHEDULER_TIMEOUT_S = 5
_WORKERS_TIMEOUT_S = 20
# Further attempts for a chunk after an error of a worker, on any worker.
_RETRIES = 2
_RESUME = "the same command goes on where it stopped"
_START = "start one: dask scheduler"


class DaskExecutor:
    """The workers of a Dask scheduler; a context manager, which releases them.

    Each worker opens an OpenGL context of its own, on the device that its environment names as GLSTAR_DEVICE, and keeps
    it for all chunks. Workers write images and truth directly to the disk, which all of them must see under the same
    path, and return frame numbers only. If a worker dies, another draws its chunk again. A worker whose frames would
    differ from the other workers' frames (another version of glstar, driver or library) is refused before it draws. The
    address of the scheduler is such as ``tcp://10.0.0.1:8786``. Raises ExportError if no scheduler answers, it has no
    workers, or a worker would draw other frames.
    """

    writes_parts = True

    def __init__(self, address: str, task: FrameTask) -> None:
        self._address = address
        self._name = f"glstar-{token_hex(6)}"
        self._files = task.frames.files
        self._fingerprint: dict[str, str] = {}
        # _explain_errors reports a lost scheduler; Dask would log it as well.
        logging.getLogger("distributed").setLevel(logging.CRITICAL)
        logging.getLogger("distributed.client").setLevel(logging.CRITICAL + 1)
        _check_that_a_scheduler_answers(address)
        with self._explain_errors():
            self._client = Client(address, timeout=_SCHEDULER_TIMEOUT_S, set_as_default=False)
        try:
            with self._explain_errors():
                self._client.wait_for_workers(1, timeout=_WORKERS_TIMEOUT_S)
                self._refuse_other_versions()
                # A worker has a working directory of its own.
                self._client.register_plugin(_Drawer(task.absolute()), name=self._name)
        except BaseException:
            self._client.close()
            raise

    @property
    def driver(self) -> str:
        """The OpenGL driver, the same on all workers."""
        return self._common_fingerprint()["OpenGL"]

    def _refuse_other_versions(self) -> None:
        """Refuse workers with another version of glstar, which may not understand this one's requests."""
        for worker, theirs in self._run_on_workers(_version_of).items():
            if theirs != __version__:
                raise self._difference_error(worker, f"glstar {theirs}, not {__version__}")

    def _common_fingerprint(self) -> dict[str, str]:
        """Return the fingerprint of all workers; raise if one differs."""
        if not self._fingerprint:
            fingerprints = self._run_on_workers(_fingerprint_of, self._name)
            # This process draws nothing, so its own driver does not matter.
            expected = fingerprint(next(iter(fingerprints.values()))["OpenGL"], self._files)
            for worker, theirs in fingerprints.items():
                if differing := differences(expected, theirs):
                    raise self._difference_error(worker, differing)
            self._fingerprint = expected
        return self._fingerprint

    def _run_on_workers(self, function: Callable[..., Any], *arguments: Any) -> dict[str, Any]:
        """Run a function on each worker; return the results by worker."""
        with self._explain_errors():
            answers: dict[str, Any] = self._client.run(function, *arguments, on_error="return")
        for worker, answer in answers.items():
            if isinstance(answer, GlstarError):
                raise answer
            if isinstance(answer, ImportError):
                raise self._difference_error(worker, f"no glstar that it can import ({answer})")
            if isinstance(answer, BaseException):
                raise self._difference_error(worker, f"a glstar that does not understand this one ({_brief(answer)})")
        return answers

    def _difference_error(self, worker: str, how: str) -> ExportError:
        message = f"the worker {worker} has {how}: its frames would differ; install the same on all workers and here"
        return ExportError(self._address, message)

    def preflight(self, task: FrameTask, number: int) -> None:  # noqa: ARG002 - the workers have it already
        """Draw a frame and write nothing; see `Executor`."""
        with self._explain_errors():
            self._client.submit(_preflight, self._name, number, pure=False).result()

    def draw(self, task: FrameTask, numbers: NDArray[np.int64], truth: TruthFile) -> Generator[int, None, None]:
        """Draw frames and write them; see `Executor`."""
        threads = sum(self._client.nthreads().values())
        arguments = {
            "shard_label": truth.shard_label,
            "expected": self._common_fingerprint(),
            "lease": _absolute(task.lease),
        }
        with self._explain_errors():
            futures = [
                self._client.submit(_draw, self._name, chunk, **arguments, pure=False, retries=_RETRIES)
                for chunk in split_into_chunks(numbers, threads, task.frames.firsts)
            ]
            try:
                for future in as_completed(futures, loop=self._client.loop):
                    yield from future.result()
                    future.release()
            finally:
                with suppress(Exception):
                    self._client.cancel(futures)

    def draw_blocks(self, work: BlockWork, blocks: Mapping[int, NDArray[np.int64]]) -> Generator[int, None, None]:
        """Draw blocks of frames that the workers write elsewhere than in a directory; see `BlockExecutor`."""
        expected = self._common_fingerprint()
        with self._explain_errors():
            futures = [
                self._client.submit(_draw_block, self._name, work, k, block, expected, pure=False, retries=_RETRIES)
                for k, block in blocks.items()
            ]
            try:
                for future in as_completed(futures, loop=self._client.loop):
                    yield future.result()
                    future.release()
            finally:
                with suppress(Exception):
                    self._client.cancel(futures)

    @contextmanager
    def _explain_errors(self) -> Iterator[None]:
        """Turn the errors of Dask into messages that say what to do."""
        try:
            yield
        except KilledWorker as error:
            message = f"its workers died one after the other ({error.last_worker.address}); is there memory? {_RESUME}"
            raise ExportError(self._address, message) from error
        except (CancelledError, CommClosedError) as error:
            raise ExportError(self._address, f"the Dask scheduler has gone; start it again, {_RESUME}") from error
        except TimeoutError as error:
            start = f"start one: dask worker {self._address} --nthreads 1"
            message = f"has no workers after {_WORKERS_TIMEOUT_S} s; {start}"
            raise ExportError(self._address, message) from error
        except (OSError, ValueError) as error:
            raise ExportError(self._address, f"no Dask scheduler answers there ({_brief(error)}); {_START}") from error

    def close(self) -> None:
        """Release the workers; a second call does nothing."""
        with suppress(Exception):  # the scheduler may have gone
            self._client.unregister_worker_plugin(self._name)
        self._client.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


# --- on the workers ---------------------------------------------------------------------------------------------------


class _Drawer(WorkerPlugin):  # type: ignore[misc]
    """The renderer of a worker and its thread: an OpenGL context belongs to one thread, and Dask changes threads."""

    def __init__(self, task: FrameTask) -> None:
        self._task = task
        self._thread: ThreadPoolExecutor | None = None
        self._renderer: GLRenderer | None = None
        self.encoder_threads = 0

    def setup(self, worker: Worker) -> None:
        """Prepare the worker; the OpenGL context is opened at the first use."""
        # Threads of a software driver.
        os.environ.setdefault("LP_NUM_THREADS", str(worker.state.nthreads))
        self.encoder_threads = worker.state.nthreads - 1
        self._thread = ThreadPoolExecutor(1, "glstar-gl")

    def teardown(self, worker: Worker) -> None:  # noqa: ARG002 - Dask's signature
        """Close the OpenGL context after the current chunk."""
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
        """Return everything that decides the bytes of this worker's frames."""
        values: dict[str, str] = self.on_gl_thread(lambda _, renderer: self.fingerprint_with(renderer))
        return values

    def fingerprint_with(self, renderer: GLRenderer) -> dict[str, str]:
        """Return the same; to be called on the renderer's thread."""
        return fingerprint(renderer.driver, self._task.frames.files)

    def refuse_other_fingerprint(self, expected: dict[str, str], renderer: GLRenderer) -> None:
        """Raise if this worker would draw other frames: it may have joined after the fingerprints were compared."""
        if differing := differences(expected, self.fingerprint_with(renderer)):
            worker = f"{get_worker().address} on {socket.gethostname()}"
            raise ExportError(self._task.directory, f"the worker {worker} has {differing}")

    def on_gl_thread(self, work: Any, *arguments: Any) -> Any:
        """Return the result of ``work(task, renderer, *arguments)``, called on the renderer's thread."""
        assert self._thread is not None
        return self._thread.submit(lambda: work(self._task, self._opened(), *arguments)).result()


def _version_of() -> str:
    import glstar  # noqa: PLC0415 - the worker's own

    return glstar.__version__


def _fingerprint_of(name: str, dask_worker: Worker) -> dict[str, str]:
    values: dict[str, str] = dask_worker.plugins[name].fingerprint()
    return values


def _preflight(name: str, number: int) -> None:
    get_worker().plugins[name].on_gl_thread(lambda task, renderer: task.draw(renderer, number) and None)


def _draw(
    name: str, numbers: NDArray[np.int64], *, shard_label: str, expected: dict[str, str], lease: Lease
) -> list[int]:
    """Draw a chunk; return the numbers of its frames."""
    drawer = get_worker().plugins[name]
    host = socket.gethostname()

    def work(task: FrameTask, renderer: GLRenderer) -> list[int]:
        task = replace(task, lease=lease)
        drawer.refuse_other_fingerprint(expected, renderer)
        if not Path(task.directory, NAME).exists():
            raise ExportError(task.directory, f"is not on the disk of {host}; all workers must see it under this path")
        truth, threads = TruthFile(task.directory, shard_label), drawer.encoder_threads
        with explain_disk_errors(task.directory):
            return list(draw_frames(task, renderer, numbers, truth, as_part=True, encoder_threads=threads))

    drawn: list[int] = drawer.on_gl_thread(work)
    return drawn


def _draw_block(name: str, work: BlockWork, index: int, numbers: NDArray[np.int64], expected: dict[str, str]) -> int:
    """Draw a block, which `work` writes; return the number of its frames."""
    drawer = get_worker().plugins[name]

    def drawn(task: FrameTask, renderer: GLRenderer) -> int:
        drawer.refuse_other_fingerprint(expected, renderer)
        work(task, renderer, index, numbers, drawer.encoder_threads)
        return len(numbers)

    count: int = drawer.on_gl_thread(drawn)
    return count


def _brief(error: BaseException) -> str:
    return f"{type(error).__name__}: {(str(error).splitlines() or [''])[0]}"


def _absolute(lease: Lease | None) -> Lease | None:
    return None if lease is None else Lease(lease.path.absolute())


def _check_that_a_scheduler_answers(address: str) -> None:
    """Raise unless a Dask scheduler answers: Dask's own client may try for a minute or longer."""
    if re.fullmatch(r"([a-z+]+://)?\S*:\d{1,5}/?", address) is None:
        message = "is no address of a Dask scheduler; it is written as in --dask tcp://10.0.0.1:8786"
        raise ExportError(address or "--dask", message)
    try:
        kind = asyncio.run(asyncio.wait_for(_server_type(address), _ANSWER_TIMEOUT_S))
    except Exception as error:  # a connection, or the answer of another kind of server, may raise anything
        reason = f"nothing in {_ANSWER_TIMEOUT_S} s" if isinstance(error, TimeoutError) else _brief(error)
        raise ExportError(address, f"no Dask scheduler answers there ({reason}); {_START}") from error
    if kind != "Scheduler":
        raise ExportError(address, f"is the address of a Dask {str(kind).lower()}; give that of its scheduler")


async def _server_type(address: str) -> object:
    """Return the type that a Dask server reports at an address: Scheduler, Worker or Nanny."""
    arguments = Security().get_connection_args("client")
    connection = await connect(address, timeout=_ANSWER_TIMEOUT_S, **arguments)
    try:
        await connection.write({"op": "identity", "reply": True})
        answer = await connection.read()
        return answer["type"]
    finally:
        connection.abort()
