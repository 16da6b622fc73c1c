"""Memory of the C library: what a process frees stays with it, because the next frame needs as much again."""

import ctypes
import os
import sys
from functools import cache
from typing import Final

__all__ = ["keep_freed_memory"]

# Parameters of glibc's `mallopt`, from malloc.h.
_M_TRIM_THRESHOLD: Final = -1
_M_MMAP_THRESHOLD: Final = -3
# Free memory at the end of the heap that is returned to the system, bytes.  The primitives of one fast exposure take
# up to 40 MB of Mesa llvmpipe's memory, which is freed after each: pages that are returned cost 12 to 20 % of drawing.
_KEPT_BYTES: Final = 64 << 20
# The largest that glibc accepts, bytes: setting either parameter stops it from raising this one as it does otherwise.
_MAPPED_BYTES: Final = 32 << 20
# Set by a user who has chosen another value.
_CHOSEN: Final = ("MALLOC_TRIM_THRESHOLD_", "MALLOC_MMAP_THRESHOLD_", "GLIBC_TUNABLES")


@cache
def keep_freed_memory() -> bool:
    """Let the C library keep up to 64 MiB of freed memory for this process instead of returning it to the system.

    Returns
    -------
    bool
        Whether it does: only glibc, and not where the environment chooses otherwise.
    """
    if sys.platform != "linux" or any(name in os.environ for name in _CHOSEN):
        return False
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None)
    if mallopt is None:  # musl has none
        return False
    mallopt.restype, mallopt.argtypes = ctypes.c_int, [ctypes.c_int, ctypes.c_int]
    return bool(mallopt(_M_MMAP_THRESHOLD, _MAPPED_BYTES) and mallopt(_M_TRIM_THRESHOLD, _KEPT_BYTES))
