"""Ctrl-C at inconvenient moments."""

import os
import signal
import threading

import pytest

from glstar.system.process import defer_interrupts


@pytest.mark.skipif(os.name == "nt", reason="sends a POSIX signal")
def test_an_interrupt_is_deferred_to_the_end_of_the_context() -> None:
    done = []

    def work() -> None:
        with defer_interrupts():
            signal.pthread_kill(threading.main_thread().ident or 0, signal.SIGINT)
            done.append("first")
            os.kill(os.getpid(), signal.SIGINT)
            done.append("second")

    with pytest.raises(KeyboardInterrupt):
        work()

    assert done == ["first", "second"]
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler


def test_nothing_is_raised_without_an_interrupt() -> None:
    with defer_interrupts():
        pass
