"""Handling of Ctrl-C: one line and exit status 130 at any time, without a traceback."""

import os
import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any, Final

__all__ = ["EXIT_INTERRUPTED", "defer_interrupts", "exit_on_interrupt", "is_interrupt"]

# Exit status of a command that was ended by SIGINT: 128 + 2, as in shells.
EXIT_INTERRUPTED: Final = 130


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
    """Return whether an exception is a KeyboardInterrupt or was raised while one was handled.

    Parameters
    ----------
    error : exception or None

    Returns
    -------
    bool
    """
    while error is not None:
        if isinstance(error, KeyboardInterrupt):
            return True
        error = error.__cause__ or error.__context__
    return False
