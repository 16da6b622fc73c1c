"""Suppression of the output of third-party readers."""

import io
import os
from collections.abc import Iterator
from contextlib import contextmanager, redirect_stderr, redirect_stdout

__all__ = ["suppressed_output"]


@contextmanager
def suppressed_output() -> Iterator[None]:
    """Suppress printed output and restore the environment variables of MAVLink.

    Importing pymavlink sets MAVLINK_DIALECT and reads MAVLINK20; pymavlink and pyulog print remarks on damaged data.
    """
    before = {key: os.environ.get(key) for key in ("MAVLINK20", "MAVLINK_DIALECT")}
    os.environ["MAVLINK20"] = "1"
    try:
        with redirect_stdout(io.StringIO()), redirect_stderr(io.StringIO()):
            yield
    finally:
        for key, value in before.items():
            os.environ.pop(key, None)
            if value is not None:
                os.environ[key] = value
