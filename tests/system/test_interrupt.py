"""Ctrl-C at inconvenient moments."""

import os
import signal
import subprocess
import sys
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


@pytest.mark.skipif(os.name == "nt", reason="sends a POSIX signal")
@pytest.mark.parametrize(
    ("before_the_end", "status"), [("", -signal.SIGHUP), ("end_by(signal.SIGHUP)", 0), ("end_by(signal.SIGTERM)", 0)]
)
def test_a_repeated_signal_does_not_replace_the_status_of_an_ended_command(before_the_end: str, status: int) -> None:
    program = f"""
import os, signal
from glstar.system.process import Terminated, default_signals, end_on_signals

def end_by(number):
    try:
        os.kill(os.getpid(), number)
    except Terminated:
        pass

end_on_signals()
{before_the_end}
default_signals()
os.kill(os.getpid(), signal.SIGHUP)
"""
    assert subprocess.run([sys.executable, "-c", program], check=False).returncode == status
