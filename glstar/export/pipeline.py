"""Work that overlaps: while a frame is drawn, the next is composed and the last ones are read, encoded and written."""

from collections import deque
from collections.abc import Callable, Generator, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from itertools import islice
from typing import Final, TypeVar

__all__ = ["pipelined"]

A = TypeVar("A")
B = TypeVar("B")
C = TypeVar("C")
D = TypeVar("D")

# ComposedFrame and not drawn yet: one under way and one ready.
_AHEAD: Final = 2


def pipelined(
    items: Iterable[A],
    compose: Callable[[A], B],
    begin: Callable[[B], None],
    end: Callable[[], C],
    finish: Callable[[C], D],
    *,
    finishers: int = 1,
) -> Generator[D, None, None]:
    """Take items through steps that are at work at the same time.

    Parameters
    ----------
    items : iterable
    compose : callable
        The first step, on a thread of its own, an item or two ahead.
    begin, end : callable
        The second, on the caller's thread: whose the OpenGL context is.  An item is begun before the one before it is
        ended, so that a GPU never waits for who reads.
    finish : callable
        The third, on as many threads as there are finishers.
    finishers : int
        How many threads finish.  Where there are none all is done in turn: there are no processors to spare.

    Yields
    ------
    object
        What `finish` returns, in the order of the items.  Only a few are on their way at a time.

    Raises
    ------
    Exception
        What a step raises, when it is that item's turn; of those behind it no further step is begun.
    """
    if not finishers:
        yield from map(finish, _drawn(map(compose, items), begin, end))
        return
    waiting = iter(items)
    composed: deque[Future[B]] = deque()
    finished: deque[Future[D]] = deque()
    with (
        ThreadPoolExecutor(1, "glstar-compose") as composer,
        ThreadPoolExecutor(finishers, "glstar-finish") as writers,
    ):
        try:
            composed.extend(composer.submit(compose, item) for item in islice(waiting, _AHEAD))

            def ready() -> Iterator[B]:
                while composed:
                    item = composed.popleft().result()
                    composed.extend(composer.submit(compose, item) for item in islice(waiting, 1))
                    yield item

            for drawn in _drawn(ready(), begin, end):
                finished.append(writers.submit(finish, drawn))
                while finished and (len(finished) > finishers + 1 or finished[0].done()):
                    yield finished.popleft().result()
            while finished:
                yield finished.popleft().result()
        finally:
            for begun in composed:
                begun.cancel()
            for written in finished:
                written.cancel()


def _drawn(composed: Iterable[B], begin: Callable[[B], None], end: Callable[[], C]) -> Iterator[C]:
    """Yield what `end` returns of each item, once the next is begun."""
    under_way = False
    for item in composed:
        begin(item)
        if under_way:
            yield end()
        under_way = True
    if under_way:
        yield end()
