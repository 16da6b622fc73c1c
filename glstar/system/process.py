"""Handling of Ctrl-C, and freed memory of the C library.

Ctrl-C ends a command with one line and exit status 130 at any time, without a traceback.  Freed memory stays with the
process, because the next frame needs as much again.
"""

import os
import signal
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache
from typing import Any

# Exit status of a command that was ended by SIGINT: 128 + 2, as in shells.
EXIT_INTERRUPTED = 130

# Parameters of glibc's `mallopt`, from malloc.h.
_M_ARENA_MAX = -8
_M_TRIM_THRESHOLD = -1
_M_MMAP_THRESHOLD = -3
# Free memory at the end of the heap that is returned to the system, bytes.  The primitives of one fast exposure take
# up to 40 MB of Mesa llvmpipe's memory, which is freed after each: pages that are returned cost 12 to 20 % of drawing.
_KEPT_BYTES = 64 << 20
# Largest threshold that glibc accepts, bytes: setting either parameter stops it from raising this one by itself.
_MAPPED_BYTES = 32 << 20
# Heaps of the process.  glibc gives each thread its own heap, and each would keep as much: threads that read logs,
# sample curves and write videos added 80 MB to a window in ten minutes.
_HEAPS = 1
# Set by a user who has chosen another value.
_CHOSEN = ("MALLOC_TRIM_THRESHOLD_", "MALLOC_MMAP_THRESHOLD_", "GLIBC_TUNABLES")


@contextmanager
def exit_on_interrupt() -> Iterator[None]:
    """Let Ctrl-C end the process at once, for the time in which libraries are imported and nothing is written.

    Libraries may turn a KeyboardInterrupt during their import into a traceback or an ImportError, or suppress it.
    """
    before = signal.getsignal(signal.SIGINT)
    if before is not signal.default_int_handler or threading.current_thread() is not threading.main_thread():
        yield
        return
    signal.signal(signal.SIGINT, _stop)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)


@contextmanager
def defer_interrupts() -> Iterator[None]:
    """Delay KeyboardInterrupt until the end of the context.

    Blocking the signal is not enough: the system delivers SIGINT to any thread that does not block it, such as those of
    OpenBLAS, and Python then raises KeyboardInterrupt in the main thread.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    received = []
    before = signal.signal(signal.SIGINT, lambda *_: received.append(True))
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)
    if received and before not in {signal.SIG_IGN, None}:
        raise KeyboardInterrupt


def _stop(*_: Any) -> None:
    os.write(2, b"glstar: stopped\n")
    os._exit(EXIT_INTERRUPTED)


def is_interrupt(error: BaseException | None) -> bool:
    """Return whether an exception is a KeyboardInterrupt or was raised while one was handled."""
    while error is not None:
        if isinstance(error, KeyboardInterrupt):
            return True
        error = error.__cause__ or error.__context__
    return False


@cache
def keep_freed_memory() -> bool:
    """Let the C library keep up to 64 MiB of freed memory for this process instead of returning it to the system.

    Returns whether it does: only glibc, and not where the environment chooses otherwise.
    """
    if any(name in os.environ for name in _CHOSEN):
        return False
    return _set((_M_MMAP_THRESHOLD, _MAPPED_BYTES), (_M_TRIM_THRESHOLD, _KEPT_BYTES))


@cache
def share_one_heap() -> bool:
    """Let threads that begin from now on share one heap, so that what is kept is a limit of the process.

    Returns whether they do: only with glibc, and not where the environment chooses otherwise.
    """
    if any(name in os.environ for name in ("MALLOC_ARENA_MAX", "GLIBC_TUNABLES")):
        return False
    return _set((_M_ARENA_MAX, _HEAPS))


def return_freed_memory() -> None:
    """Return the C library's freed memory to the system, except for 64 MiB at the end of the heap.

    Without this only free memory at the end of the heap is ever returned: one small block that stays in use holds
    everything that was freed below it.
    """
    malloc_trim = _of_c_library("malloc_trim", "c_size_t")
    if malloc_trim is not None:
        malloc_trim(_KEPT_BYTES)


def _set(*parameters: tuple[int, int]) -> bool:
    """Set parameters of glibc's heap; return whether it took them all."""
    mallopt = _of_c_library("mallopt", "c_int", "c_int")
    return mallopt is not None and all(bool(mallopt(*parameter)) for parameter in parameters)


def _of_c_library(name: str, *argument_types: str) -> Any:
    """Return a function of the C library that returns an int; None if it has none, as musl has neither of the above."""
    if sys.platform != "linux":
        return None
    import ctypes  # noqa: PLC0415 - 4 ms, which `glstar --help` does not need

    function = getattr(ctypes.CDLL(None), name, None)
    if function is not None:
        function.argtypes = [getattr(ctypes, argument_type) for argument_type in argument_types]
    return function
