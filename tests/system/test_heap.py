"""Memory that is freed stays with the process, in processes of their own."""

import platform
import subprocess
import sys

import pytest

from glstar.system import process

NAMES = ("MALLOC_ARENA_MAX", "MALLOC_TRIM_THRESHOLD_", "MALLOC_MMAP_THRESHOLD_", "GLIBC_TUNABLES")
# Frees blocks of 64 KB that together are 30 MB, and prints what the process still holds of them, bytes.
PROGRAM = """
import ctypes
from glstar.system.process import keep_freed_memory
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
    for name in NAMES:
        monkeypatch.delenv(name, raising=False)
    for name, value in chosen.items():
        monkeypatch.setenv(name, value)
    answer = subprocess.run([sys.executable, "-c", PROGRAM], capture_output=True, text=True, check=True).stdout.split()
    assert answer[0] == str(keeps)
    assert (int(answer[1]) > 20_000_000) == keeps


# Eight threads allocate and free 30 MB each, one after the other, and live on; prints what the process still holds.
THREADS = (
    PROGRAM[: PROGRAM.index("before =")]
    + """
import threading
from glstar.system.process import share_one_heap
shares = share_one_heap()
before, end = resident(), threading.Event()
def work(done):
    blocks = [libc.malloc(65000) for _ in range(460)]
    for block in blocks:
        ctypes.memset(block, 1, 65000)
    for block in reversed(blocks):
        libc.free(block)
    done.set()
    end.wait()
for _ in range(8):
    done = threading.Event()
    threading.Thread(target=work, args=(done,)).start()
    done.wait()
print(shares, resident() - before)
end.set()
"""
)


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="only glibc has the setting")
def test_all_threads_together_keep_what_one_thread_keeps(monkeypatch):
    for name in NAMES:
        monkeypatch.delenv(name, raising=False)
    answer = subprocess.run([sys.executable, "-c", THREADS], capture_output=True, text=True, check=True).stdout.split()
    assert answer[0] == "True"
    assert int(answer[1]) < 60_000_000


# Frees blocks that together are 200 MB below one that stays in use; prints what the process still holds of them, bytes.
BELOW = (
    PROGRAM[: PROGRAM.index("before =")]
    + """
from glstar.system.process import return_freed_memory
before = resident()
blocks = [libc.malloc(65000) for _ in range(3080)]
for block in blocks:
    ctypes.memset(block, 1, 65000)
kept = libc.malloc(65000)
for block in reversed(blocks):
    libc.free(block)
held = resident() - before
return_freed_memory()
print(held, resident() - before)
"""
)


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="only glibc has the setting")
def test_freed_memory_is_returned_from_below_what_is_in_use(monkeypatch):
    for name in NAMES:
        monkeypatch.delenv(name, raising=False)
    answer = subprocess.run([sys.executable, "-c", BELOW], capture_output=True, text=True, check=True).stdout.split()
    assert int(answer[0]) > 150_000_000
    assert int(answer[1]) < 80_000_000


def test_the_parameters_are_those_of_glibcs_malloc_h(monkeypatch):
    """M_TRIM_THRESHOLD -1, M_MMAP_THRESHOLD -3 and M_ARENA_MAX -8; 32 MiB is DEFAULT_MMAP_THRESHOLD_MAX."""
    for name in NAMES:
        monkeypatch.delenv(name, raising=False)
    called, accepted = [], [1, 1]
    monkeypatch.setattr(
        process, "_of_c_library", lambda name, *_: lambda *args: called.append((name, *args)) or accepted[-1]
    )
    keep, share = process.keep_freed_memory.__wrapped__, process.share_one_heap.__wrapped__
    assert (keep(), share()) == (True, True)
    process.return_freed_memory()
    mib = 1024 * 1024
    assert called == [
        ("mallopt", -3, 32 * mib),
        ("mallopt", -1, 64 * mib),
        ("mallopt", -8, 1),
        ("malloc_trim", 64 * mib),
    ]
    accepted.append(0)
    assert (keep(), share()) == (False, False)
    monkeypatch.setattr(process, "_of_c_library", lambda *_: None)
    assert (keep(), share()) == (False, False)
    process.return_freed_memory()


@pytest.mark.parametrize("name", NAMES)
def test_what_the_environment_chooses_stays(monkeypatch, name):
    for other in NAMES:
        monkeypatch.delenv(other, raising=False)
    monkeypatch.setenv(name, "1")
    monkeypatch.setattr(process, "_of_c_library", lambda *_: lambda *_: 1)
    assert process.keep_freed_memory.__wrapped__() == (name == "MALLOC_ARENA_MAX")
    assert process.share_one_heap.__wrapped__() == (name in {"MALLOC_TRIM_THRESHOLD_", "MALLOC_MMAP_THRESHOLD_"})


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="only glibc has the functions")
def test_functions_of_the_c_library_are_found_on_linux_only(monkeypatch):
    found = process._of_c_library("malloc_trim", "c_size_t")
    assert [kind.__name__ for kind in found.argtypes] == ["c_ulong"]
    assert process._of_c_library("no_such_function_of_glstar") is None
    monkeypatch.setattr(process.sys, "platform", "darwin")
    assert process._of_c_library("malloc_trim", "c_size_t") is None
