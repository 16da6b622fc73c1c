"""``glstar`` and ``python -m glstar``: the command line."""

import gc
import sys

from glstar.system.process import default_signals, end_on_signals, exit_on_interrupt, exit_status, interrupt_of

__all__ = ["main"]


def main() -> None:
    """Run the command line and leave with its exit status; a signal ends it with 128 plus its number and one line."""
    # Modules stay: looking for garbage in what they make takes a fifth of a start, until `glstar.cli.main` enables it.
    gc.disable()
    with exit_on_interrupt():
        from glstar.cli import main as run  # noqa: PLC0415 - half a second in which Ctrl-C may come
    try:
        end_on_signals()
        run()
    except BaseException as error:
        interrupt = None if isinstance(error, SystemExit) else interrupt_of(error)
        if interrupt is None:
            raise
        sys.stderr.write("glstar: stopped\n")
        sys.exit(exit_status(interrupt))
    finally:
        # All is written: a later Ctrl-C meets nothing but the interpreter's own end, where it would show a traceback.
        default_signals()


if __name__ == "__main__":
    main()
