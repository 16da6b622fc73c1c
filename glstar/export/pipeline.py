"""A pipeline of threads: while a frame is drawn, the next is composed and earlier ones are encoded and written."""

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

# Items composed ahead of drawing: one in progress and one ready.
_AHEAD: Final = 2


def pipelined(
    items: Iterable[A],
    compose: Callable[[A], B],
    begin: Callable[[B], None],
    end: Callable[[], C],
    encode: Callable[[C], D],
    *,
    encoder_threads: int = 1,
) -> Generator[D, None, None]:
    """Take items through three steps that run concurrently.

    Parameters
    ----------
    items : iterable
    compose : callable
        First step; runs on a thread of its own, one or two items ahead.
    begin, end : callable
        Second step; both run on the caller's thread, which owns the OpenGL context.  `begin` is called for an item
        before `end` is called for the item before it, so that the GPU never waits for a read.
    encode : callable
        Third step; runs on `encoder_threads` threads.
    encoder_threads : int
        If 0, all steps run on the caller's thread: for processes that share the processors with others.

    Yields
    ------
    object
        Results of `encode`, in the order of the items.  Only a few items are in progress at a time.

    Raises
    ------
    Exception
        The exception of a step, at the position of its item; no further step begins for later items.
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
