"""Who draws an export's frames: this process alone, or several."""

import os
from collections import deque
from collections.abc import Callable, Generator, Iterator
from contextlib import ExitStack, closing, suppress
from functools import partial
from typing import TYPE_CHECKING, Final, Protocol, TypeVar

import numpy as np
from numpy.typing import NDArray

from glstar.errors import ExportError
from glstar.export.framewriter import FrameWriter
from glstar.export.pipeline import pipelined
from glstar.export.truthfile import TruthFile
from glstar.export.verify import CheckedFrame, check_files
from glstar.render.scene import Frame, Renderer

if TYPE_CHECKING:
    from glstar.export.frames import ComposedFrame
    from glstar.export.run import EncodedFrame, Export

__all__ = ["Checker", "Executor", "SerialExecutor", "check_frames", "draw_frames", "processors", "split_into_chunks"]

T = TypeVar("T")

# Each has its turn so many times, for frames take longer here than there; and a chunk leaves a part of the truth.
_TURNS: Final = 8
_LARGEST_CHUNK: Final = 1000


def processors() -> int:
    """Return how many processors this process may use.

    Returns
    -------
    int
        Those that a cluster's scheduler has given it, where it is bound to some.
    """
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


class Executor(Protocol):
    """Who draws.

    Attributes
    ----------
    apart : bool
        Whether they write the truth in parts.
    """

    apart: bool

    @property
    def driver(self) -> str:
        """What all of them draw with."""
        ...

    def preflight(self, export: "Export", number: int) -> None:
        """Draw a frame and write nothing: what cannot be drawn shall leave no directory behind.

        Parameters
        ----------
        export : Export
        number : int
        """
        ...

    def draw(self, export: "Export", numbers: NDArray[np.int64], truth: TruthFile) -> Generator[int, None, None]:
        """Draw frames and write them, with their truth.

        Parameters
        ----------
        export : Export
        numbers : (n,) int64
        truth : TruthFile

        Yields
        ------
        int
            The number of each frame, once all of it is there.
        """
        ...


class Checker(Protocol):
    """Draws frames again, to compare them with those in the directory."""

    @property
    def driver(self) -> str:
        """What all of them draw with."""
        ...

    def check(self, export: "Export", numbers: NDArray[np.int64]) -> Iterator[CheckedFrame]:
        """Draw frames again and compare them with the files in the directory; nothing is written.

        Parameters
        ----------
        export : Export
        numbers : (n,) int64

        Yields
        ------
        CheckedFrame
            In any order.
        """
        ...


class SerialExecutor:
    """The calling process, on its own thread's context.

    Parameters
    ----------
    renderer : Renderer
    """

    apart = False

    def __init__(self, renderer: Renderer) -> None:
        self._renderer = renderer

    @property
    def driver(self) -> str:
        """What it draws with."""
        return self._renderer.driver

    def preflight(self, export: "Export", number: int) -> None:
        """Draw a frame and write nothing; see `Executor`."""
        export.draw(self._renderer, number)

    def draw(self, export: "Export", numbers: NDArray[np.int64], truth: TruthFile) -> Generator[int, None, None]:
        """Draw frames and write them; see `Executor`."""
        yield from draw_frames(export, self._renderer, numbers, truth)

    def check(self, export: "Export", numbers: NDArray[np.int64]) -> Iterator[CheckedFrame]:
        """Draw frames again and compare them with the files in the directory; see `Checker`."""
        yield from check_frames(export, self._renderer, numbers)


def draw_frames(
    export: "Export",
    renderer: Renderer,
    numbers: NDArray[np.int64],
    truth: TruthFile,
    *,
    apart: bool = False,
    finishers: int | None = None,
) -> Generator[int, None, None]:
    """Draw frames and write them, all steps at the same time.

    Parameters
    ----------
    export : Export
    renderer : Renderer
        Of this thread.
    numbers : (n,) int64
    truth : TruthFile
    apart : bool
        Whether others write truth at the same time.
    finishers : int, optional
        How many threads encode and write, and none where others keep the processors busy; one for each processor
        unless said otherwise.

    Yields
    ------
    int
        The number of each frame, once all of it is there.
    """
    with ExitStack() as opened:
        with export.writing():
            lines = opened.enter_context(truth.growing(apart=apart))
        writer = opened.enter_context(FrameWriter(truth, lines, writing=export.writing))

        def write(frame: "EncodedFrame") -> tuple[int, bytes]:
            export.write(frame, partial(writer.stage, frame.number))
            return frame.number, frame.truth

        try:
            with closing(_drawn(export, renderer, numbers, write, finishers)) as written:
                for number, line in written:
                    yield from writer.add(number, line)
        except Exception:
            with suppress(OSError, ExportError):  # frames before the one that failed are kept and counted
                yield from writer.drain()
            raise
        yield from writer.drain()


def check_frames(
    export: "Export", renderer: Renderer, numbers: NDArray[np.int64], *, finishers: int | None = None
) -> Generator[CheckedFrame, None, None]:
    """Draw frames again and compare them with the files in the directory, all steps at the same time.

    Parameters
    ----------
    export, renderer, numbers, finishers
        As for `draw_frames`.

    Yields
    ------
    CheckedFrame
    """
    yield from _drawn(export, renderer, numbers, partial(check_files, export), finishers)


def _drawn(
    export: "Export",
    renderer: Renderer,
    numbers: NDArray[np.int64],
    use: "Callable[[EncodedFrame], T]",
    finishers: int | None,
) -> Generator[T, None, None]:
    """Yield what is made of each drawn frame, all steps at the same time."""
    under_way: deque[ComposedFrame] = deque()

    def begin(composed: "ComposedFrame") -> None:
        export.begin(renderer, composed)
        under_way.append(composed)

    def end() -> "tuple[ComposedFrame, Frame]":
        return under_way.popleft(), renderer.end_read()

    def finish(rendered: "tuple[ComposedFrame, Frame]") -> T:
        return use(export.encoded(*rendered))

    if finishers is None:
        finishers = processors()
    try:
        yield from pipelined(numbers.tolist(), export.compose, begin, end, finish, finishers=finishers)
    finally:
        renderer.forget()


def split_into_chunks(numbers: NDArray[np.int64], hands: int) -> list[NDArray[np.int64]]:
    """Divide frames into what is handed out at a time.

    Parameters
    ----------
    numbers : (n,) int64
    hands : int
        How many draw.

    Returns
    -------
    list of (m,) int64
        In order.
    """
    size = min(max(1, -(-len(numbers) // (_TURNS * hands))), _LARGEST_CHUNK)
    return [numbers[first : first + size] for first in range(0, len(numbers), size)]
