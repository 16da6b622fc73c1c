"""Other people's readers, held to glstar's manners: they print nothing and leave the environment alone."""

import io
import os
from collections.abc import Iterator
from contextlib import contextmanager, redirect_stderr, redirect_stdout

__all__ = ["quiet"]


@contextmanager
def quiet() -> Iterator[None]:
    """Swallow what is printed, and keep the environment as it is.

    Importing pymavlink sets MAVLINK_DIALECT, and asks for MAVLINK20; it and pyulog print what they do not understand.
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
