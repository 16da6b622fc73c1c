"""Work that overlaps: while one frame is drawn, the next is composed and the last ones are encoded and written."""

from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from itertools import islice
from typing import Final, TypeVar

__all__ = ["overlapped"]

A = TypeVar("A")
B = TypeVar("B")
C = TypeVar("C")
D = TypeVar("D")

# Composed and not drawn yet: one under way and one ready.
_AHEAD: Final = 2


def overlapped(
    items: Iterable[A],
    compose: Callable[[A], B],
    draw: Callable[[B], C],
    finish: Callable[[C], D],
    *,
    finishers: int = 1,
) -> Iterator[D]:
    """Take items through three steps that are at work at the same time.

    Parameters
    ----------
    items : iterable
    compose : callable
        The first step, on a thread of its own, an item or two ahead.
    draw : callable
        The second, on the caller's thread: whose the OpenGL context is.
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
        yield from (finish(draw(compose(item))) for item in items)
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
            while composed:
                ready = composed.popleft().result()
                composed.extend(composer.submit(compose, item) for item in islice(waiting, 1))
                finished.append(writers.submit(finish, draw(ready)))
                while finished and (len(finished) > finishers + 1 or finished[0].done()):
                    yield finished.popleft().result()
            while finished:
                yield finished.popleft().result()
        finally:
            for begun in composed:
                begun.cancel()
            for written in finished:
                written.cancel()
