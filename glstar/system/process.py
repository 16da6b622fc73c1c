"""Signals that end a command, and freed memory of the C library.

Ctrl-C, SIGTERM and SIGHUP end a command with one line at any time, without a traceback, after its files are closed.
Freed memory stays with the process, because the next frame needs as much again.
"""

import os
import signal
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from functools import cache
from typing import Any

# Signals that end a command as Ctrl-C does: of `kill`, of a service manager, of a terminal that is closed.
TERMINATING = tuple(getattr(signal, name) for name in ("SIGTERM", "SIGHUP") if hasattr(signal, name))
_ENDING = (signal.SIGINT, *TERMINATING)
# A closed terminal sends SIGHUP twice, once by its shell: later signals within this time are ignored, s.
_REPEATED_S = 2.0

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


class Terminated(KeyboardInterrupt):
    """The process received one of `TERMINATING`; `number` is that of the signal."""

    def __init__(self, number: int) -> None:
        super().__init__()
        self.number = number


def exit_status(error: KeyboardInterrupt) -> int:
    """Return the exit status of a command that a signal has ended: 128 plus its number, as in shells."""
    return 128 + (error.number if isinstance(error, Terminated) else signal.SIGINT)


class _Terminator:
    """A handler of `TERMINATING` that raises `Terminated`."""

    def __init__(self) -> None:
        self.has_ended = False  # the command, so that the rest is its orderly exit
        self._ignored_until_s = -1.0
        # Streams whose terminal may be closed.
        self._terminals = [handle for handle in (1, 2) if os.isatty(handle)]

    def __call__(self, number: int, _: object) -> None:
        now_s = time.monotonic()
        if now_s < self._ignored_until_s:
            return
        self.has_ended = True
        self._ignored_until_s = now_s + _REPEATED_S
        if number != signal.SIGTERM:
            self._leave_terminals()
        raise Terminated(number)

    def _leave_terminals(self) -> None:
        """Discard what is still written to a terminal: each write to a closed one would be an error."""
        with suppress(OSError):
            nowhere = os.open(os.devnull, os.O_WRONLY)
            for handle in self._terminals:
                os.dup2(nowhere, handle)
            os.close(nowhere)


def end_on_signals() -> None:
    """Let SIGTERM and SIGHUP end the command from now on, unless the caller has them ignored, as nohup does."""
    terminator = _Terminator()
    for number in TERMINATING:
        if signal.getsignal(number) is signal.SIG_DFL:
            signal.signal(number, terminator)


def _ends_the_command(handler: Any) -> bool:
    return handler is signal.default_int_handler or isinstance(handler, _Terminator)


@contextmanager
def exit_on_interrupt() -> Iterator[None]:
    """Let Ctrl-C end the process at once, for the time in which libraries are imported and nothing is written.

    Libraries may turn a KeyboardInterrupt during their import into a traceback or an ImportError, or suppress it.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = {number: handler for number in _ENDING if _ends_the_command(handler := signal.getsignal(number))}
    for number in before:
        signal.signal(number, _stop)
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


@contextmanager
def defer_interrupts() -> Iterator[None]:
    """Delay KeyboardInterrupt until the end of the context.

    Blocking the signal is not enough: the system delivers SIGINT to any thread that does not block it, such as those of
    OpenBLAS, and Python then raises KeyboardInterrupt in the main thread.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    received: list[int] = []
    before = {number: handler for number in _ENDING if callable(handler := signal.getsignal(number))}
    for number in before:
        signal.signal(number, lambda number, _: received.append(number))
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
    if received:
        before[signal.Signals(received[0])](received[0], None)


def default_signals() -> None:
    """Let signals end the process without Python: nothing is left to be written.

    After a signal has ended the command, a repeated one must not replace its exit status: it is ignored.
    """
    for number in _ENDING:
        handler = signal.getsignal(number)
        if isinstance(handler, _Terminator) and handler.has_ended:
            signal.signal(number, signal.SIG_IGN)
        elif _ends_the_command(handler):
            signal.signal(number, signal.SIG_DFL)


def _stop(number: int, _: object) -> None:
    os._exit(128 + number)


def interrupt_of(error: BaseException | None) -> KeyboardInterrupt | None:
    """Return the KeyboardInterrupt that an exception is, or that was handled when it was raised; None without one."""
    while error is not None:
        if isinstance(error, KeyboardInterrupt):
            return error
        error = error.__cause__ or error.__context__
    return None


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
