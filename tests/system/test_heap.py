"""Memory that is freed stays with the process, in processes of their own."""

import platform
import subprocess
import sys

import pytest

# Frees blocks of 64 KB that together are 30 MB, and prints what the process still holds of them, bytes.
PROGRAM = """
import ctypes
from glstar.system.heap import keep_freed_memory
keeps = keep_freed_memory()
libc = ctypes.CDLL(None)
libc.malloc.restype = ctypes.c_void_p
libc.free.argtypes = [ctypes.c_void_p]
def resident():
    return 4096 * int(open("/proc/self/statm").read().split()[1])
before = resident()
blocks = [libc.malloc(65000) for _ in range(460)]
for block in blocks:
    ctypes.memset(block, 1, 65000)
for block in reversed(blocks):
    libc.free(block)
print(keeps, resident() - before)
"""


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="only glibc has the setting")
@pytest.mark.parametrize(("chosen", "keeps"), [({}, True), ({"MALLOC_TRIM_THRESHOLD_": "131072"}, False)])
def test_freed_memory_stays_unless_the_environment_chooses_otherwise(monkeypatch, chosen, keeps):
    for name in ("MALLOC_TRIM_THRESHOLD_", "MALLOC_MMAP_THRESHOLD_", "GLIBC_TUNABLES"):
        monkeypatch.delenv(name, raising=False)
    for name, value in chosen.items():
        monkeypatch.setenv(name, value)
    answer = subprocess.run([sys.executable, "-c", PROGRAM], capture_output=True, text=True, check=True).stdout.split()
    assert answer[0] == str(keeps)
    assert (int(answer[1]) > 20_000_000) == keeps
