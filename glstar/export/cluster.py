"""The workers of a Dask cluster that draw one export, on machines that share its disk."""

import logging
import os
import socket
from collections.abc import Generator, Iterator
from concurrent.futures import CancelledError, ThreadPoolExecutor
from contextlib import contextmanager, suppress
from pathlib import Path
from secrets import token_hex
from types import TracebackType
from typing import Any, Final, Self

import numpy as np
from distributed import Client, Worker, WorkerPlugin, as_completed, get_worker
from distributed.comm import CommClosedError
from distributed.scheduler import KilledWorker
from numpy.typing import NDArray

from glstar.errors import ExportError
from glstar.export.crew import chunks_of, draw_frames
from glstar.export.files import words_for_the_disk
from glstar.export.job import Export
from glstar.export.manifest import NAME
from glstar.export.truthfile import TruthFile
from glstar.gl import GLRenderer

__all__ = ["DaskCluster"]

# How long to wait for a scheduler, and for the first of its workers, s.
_PATIENCE_S: Final = 20
# How often a chunk is tried again, by whatever worker, after an error of the worker's.
_RETRIES: Final = 2
_AGAIN: Final = "the same command goes on where it stopped"


class DaskCluster:
    """The workers of a Dask scheduler; a context manager, which lets them go.

    Each opens an OpenGL context of its own, on the device that its environment names as GLSTAR_DEVICE, and keeps it
    from one chunk of frames to the next.  What comes back are numbers only: images and truth go straight to the disk,
    which all must see under one path.  A worker that dies costs its chunk, which another draws anew.

    Parameters
    ----------
    address : str
        The scheduler's, as in ``tcp://10.0.0.1:8786``.
    export : Export
        What they shall draw.

    Raises
    ------
    ExportError
        If there is no scheduler, or it has no workers.
    """

    apart = True

    def __init__(self, address: str, export: Export) -> None:
        self._address = address
        self._name = f"glstar-{token_hex(6)}"
        self._driver = ""
        # What they have to say of a scheduler that has gone comes to the user in the words below.
        logging.getLogger("distributed").setLevel(logging.CRITICAL)
        logging.getLogger("distributed.client").setLevel(logging.CRITICAL + 1)
        with self._words():
            self._client = Client(address, timeout=_PATIENCE_S, set_as_default=False)
        try:
            with self._words():
                self._client.wait_for_workers(1, timeout=_PATIENCE_S)
                self._client.register_plugin(_Drawer(export), name=self._name)
        except BaseException:
            self._client.close()
            raise

    @property
    def driver(self) -> str:
        """What all of them draw with."""
        if not self._driver:
            with self._words():
                drivers = set(self._client.run(_driver_of, self._name).values())
            if len(drivers) != 1:
                words = f"has workers of different drivers, whose frames differ: {'; '.join(sorted(drivers))}"
                raise ExportError(self._address, words)
            [self._driver] = drivers
        return self._driver

    def rehearse(self, export: Export, number: int) -> None:  # noqa: ARG002 - they have it already
        """Draw a frame and write nothing; see `Crew`."""
        with self._words():
            self._client.submit(_rehearse, self._name, number, pure=False).result()

    def draw(
        self,
        export: Export,  # noqa: ARG002 - they have it already
        numbers: NDArray[np.int64],
        truth: TruthFile,
    ) -> Generator[int, None, None]:
        """Draw frames and write them; see `Crew`."""
        hands = sum(self._client.nthreads().values())
        asked = {"who": truth.who, "driver": self.driver}
        with self._words():
            futures = [
                self._client.submit(_draw, self._name, chunk, **asked, pure=False, retries=_RETRIES)
                for chunk in chunks_of(numbers, hands)
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
            words = f"has no workers after {_PATIENCE_S} s; start one: dask worker {self._address} --nthreads 1"
            raise ExportError(self._address, words) from error
        except (OSError, ValueError) as error:
            words = f"no Dask scheduler answers there ({str(error).splitlines()[0]}); start one: dask scheduler"
            raise ExportError(self._address, words) from error

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

    def on_its_thread(self, work: Any, *arguments: Any) -> Any:
        """Return what comes of some work on the renderer's thread."""
        assert self._thread is not None
        return self._thread.submit(lambda: work(self._export, self._opened(), *arguments)).result()


def _driver_of(name: str, dask_worker: Worker) -> str:
    driver: str = dask_worker.plugins[name].on_its_thread(lambda _, renderer: renderer.driver)
    return driver


def _rehearse(name: str, number: int) -> None:
    get_worker().plugins[name].on_its_thread(lambda export, renderer: export.draw(renderer, number) and None)


def _draw(name: str, numbers: NDArray[np.int64], *, who: str, driver: str) -> list[int]:
    """Draw a chunk; return the numbers of its frames."""
    drawer = get_worker().plugins[name]

    def work(export: Export, renderer: GLRenderer) -> list[int]:
        if renderer.driver != driver:
            words = f"the worker on {socket.gethostname()} draws with {renderer.driver}, the others with {driver}"
            raise ExportError(export.directory, words)
        if not Path(export.directory, NAME).exists():
            words = f"is not on the disk of {socket.gethostname()}; all workers must see it under this path"
            raise ExportError(export.directory, words)
        truth = TruthFile(export.directory, who)
        with words_for_the_disk(export.directory):
            return list(draw_frames(export, renderer, numbers, truth, apart=True, finishers=drawer.finishers))

    drawn: list[int] = drawer.on_its_thread(work)
    return drawn
