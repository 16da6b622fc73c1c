"""``glstar`` and ``python -m glstar``: the command line."""

import signal
import sys

from glstar.system.process import EXIT_INTERRUPTED, exit_on_interrupt, is_interrupt

__all__ = ["main"]


def main() -> None:
    """Run the command line and leave with its exit status; Ctrl-C ends it with 130 and one line."""
    with exit_on_interrupt():
        from glstar.cli import main as run  # noqa: PLC0415 - half a second in which Ctrl-C may come
    try:
        run()
    except BaseException as error:
        if isinstance(error, SystemExit) or not is_interrupt(error):
            raise
        sys.stderr.write("glstar: stopped\n")
        sys.exit(EXIT_INTERRUPTED)
    finally:
        # All is written: a later Ctrl-C meets nothing but the interpreter's own end, where it would show a traceback.
        if signal.getsignal(signal.SIGINT) is signal.default_int_handler:
            signal.signal(signal.SIGINT, signal.SIG_DFL)


if __name__ == "__main__":
    main()
