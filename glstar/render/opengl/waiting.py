"""Waiting for the GPU without keeping Python's other threads from running."""

import ctypes
import sys
from functools import cache
from typing import Final

import moderngl

__all__ = ["start_drawing", "wait_until_drawn"]

# Where the system has glFinish for the current context, whichever library made it.
_LIBRARIES: Final = {
    "linux": ("libOpenGL.so.0", "libGL.so.1"),
    "darwin": ("/System/Library/Frameworks/OpenGL.framework/OpenGL",),
    "win32": ("opengl32",),
}


def wait_until_drawn(context: moderngl.Context) -> None:
    """Wait until everything that was drawn on the current context is complete.

    ModernGL holds Python's lock while it waits, so that a scene could not be composed meanwhile; a function that is
    called through ctypes does not.

    Parameters
    ----------
    context : moderngl.Context
        The current one.
    """
    library = _library()
    if library is None:
        context.finish()
    else:
        library.glFinish()


def start_drawing() -> None:
    """Let the driver start what was drawn on the current context, without waiting; a GPU would start by itself."""
    library = _library()
    if library is not None:
        library.glFlush()


@cache
def _library() -> ctypes.CDLL | None:
    """Return the system's library with glFinish and glFlush; None if it has another name here."""
    for name in _LIBRARIES.get(sys.platform, ()):
        try:
            library = ctypes.CDLL(name)
            functions = library.glFinish, library.glFlush
        except (OSError, AttributeError):
            continue
        for function in functions:
            function.restype, function.argtypes = None, []
        return library
    return None
