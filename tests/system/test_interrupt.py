"""Ctrl-C at inconvenient moments."""

import os
import signal
import subprocess
import sys
import threading
from pathlib import Path

import pytest

from glstar.system import process
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


def test_a_repeated_signal_within_two_seconds_is_ignored(monkeypatch: pytest.MonkeyPatch) -> None:
    now_s = [50.0]
    monkeypatch.setattr(process.time, "monotonic", lambda: now_s[0])
    terminator = process._Terminator()
    assert not terminator.has_ended
    with pytest.raises(process.Terminated) as raised:
        terminator(signal.SIGTERM, None)
    assert (raised.value.number, terminator.has_ended) == (signal.SIGTERM, True)
    now_s[0] = 51.9
    terminator(signal.SIGTERM, None)
    now_s[0] = 52.1
    with pytest.raises(process.Terminated):
        terminator(signal.SIGTERM, None)


@pytest.mark.skipif(os.name == "nt", reason="Windows has no SIGHUP")
def test_what_is_written_to_a_closed_terminal_is_discarded(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(process.os, "isatty", lambda handle: handle == 2)
    replaced = []
    monkeypatch.setattr(process.os, "dup2", lambda source, handle: replaced.append((os.fstat(source).st_rdev, handle)))
    for number, handles in ((signal.SIGTERM, []), (signal.SIGHUP, [2])):
        with pytest.raises(process.Terminated):
            process._Terminator()(number, None)
        assert replaced == [(Path(os.devnull).stat().st_rdev, handle) for handle in handles]


def test_the_exit_status_is_that_of_shells() -> None:
    assert process.exit_status(KeyboardInterrupt()) == 130
    assert process.exit_status(process.Terminated(15)) == 143
    assert process.exit_status(process.Terminated(1)) == 129


def test_the_interrupt_behind_an_error_is_found() -> None:
    interrupt = process.Terminated(15)
    caused, handled = ImportError("no"), ValueError("no")
    caused.__cause__, handled.__context__ = interrupt, caused
    assert process.interrupt_of(handled) is interrupt
    assert process.interrupt_of(interrupt) is interrupt
    assert process.interrupt_of(ValueError("no")) is None
    assert process.interrupt_of(None) is None


@pytest.mark.skipif(os.name == "nt", reason="POSIX signals")
def test_only_signals_with_their_default_handler_end_the_command() -> None:
    before = {number: signal.getsignal(number) for number in process.TERMINATING}
    try:
        signal.signal(signal.SIGHUP, signal.SIG_IGN)  # as nohup does
        signal.signal(signal.SIGTERM, signal.SIG_DFL)
        process.end_on_signals()
        assert signal.getsignal(signal.SIGHUP) is signal.SIG_IGN
        ends = signal.getsignal(signal.SIGTERM)
        assert isinstance(ends, process._Terminator)
        with process.exit_on_interrupt():
            stops = signal.getsignal(signal.SIGTERM)
            assert stops is signal.getsignal(signal.SIGINT) is process._stop
            assert signal.getsignal(signal.SIGHUP) is signal.SIG_IGN
        assert signal.getsignal(signal.SIGTERM) is ends
        assert signal.getsignal(signal.SIGINT) is signal.default_int_handler
        process.default_signals()
        assert signal.getsignal(signal.SIGTERM) is signal.SIG_DFL
        signal.signal(signal.SIGTERM, ends)
        ends.has_ended = True
        process.default_signals()
        assert signal.getsignal(signal.SIGTERM) is signal.SIG_IGN
    finally:
        for number, handler in (*before.items(), (signal.SIGINT, signal.default_int_handler)):
            signal.signal(number, handler)


def test_the_exit_of_an_interrupted_import_has_the_number_of_the_signal(monkeypatch: pytest.MonkeyPatch) -> None:
    ended = []
    monkeypatch.setattr(process.os, "_exit", ended.append)
    process._stop(2, None)
    assert ended == [130]


def test_another_thread_changes_no_handler() -> None:
    handlers = []

    def work() -> None:
        for context in (process.exit_on_interrupt(), process.defer_interrupts()):
            with context:
                handlers.append(signal.getsignal(signal.SIGINT))

    thread = threading.Thread(target=work)
    thread.start()
    thread.join()
    assert handlers == [signal.default_int_handler] * 2
