"""The newest frame, handed from one process to another: pixels and truth, in shared memory or in a file.

A navigation algorithm runs beside ``glstar live LINK --latest-frame shm:sky`` and reads

>>> with LatestFrameReader("shm:sky") as latest:  # doctest: +SKIP
...     while (frame := latest.wait(timeout_s=10)) is not None:
...         print(frame.truth["utc_mid"], frame.pixels.mean(), frame.truth["q_body_ned"])

This module needs NumPy and nothing else of glstar's; other languages read the same bytes, little-endian:

======  =====  ==================================================================================
offset  bytes  what
======  =====  ==================================================================================
0       8      ``GLSTARF1``; ``GLSTARF0`` once the writer has ended: open the name again
8       8      counts the frames, twice each: 0 before the first, odd while one is being written
16      4      bytes of truth
20      4      width, px
24      4      height, px
28      4      bytes of a pixel: 1 or 2
32      4      CRC-32 of truth and pixels
36      4      run: a random number of the writer, another one after each restart
40             truth: the frame's line of ``truth.jsonl``
...            pixels, row by row from the top
======  =====  ==================================================================================

In shared memory a reader copies, and takes the copy if the count is even and stayed the same, and the sum is right.  A
frame is new if run or count differ from those of the last one.  A writer that was killed marks no end: a reader that
has seen no new frame for a while opens the name again.

One writer has a name at a time.  It locks a file while it lives, `/dev/shm/glstar-NAME.lock` for shared memory (in
`/tmp` on macOS, in the user's folder for temporary files on Windows) and ``.NAME.lock`` beside a file.  The system
releases the lock of a process however it ends, so that the next writer takes over the name of a dead one.
"""

import json
import os
import struct
import sys
import time
import zlib
from contextlib import suppress
from dataclasses import dataclass
from multiprocessing import resource_tracker
from multiprocessing.shared_memory import SharedMemory
from pathlib import Path
from secrets import randbits
from tempfile import gettempdir
from types import TracebackType
from typing import Any, Final, Self

import numpy as np

from glstar.errors import ConfigError, ExportError

if sys.platform == "win32":
    import msvcrt
else:
    import fcntl

__all__ = ["LatestFrame", "LatestFrameReader", "LatestFrameWriter"]

_MAGIC: Final = b"GLSTARF1"
_ENDED: Final = b"GLSTARF0"
_HEAD: Final = struct.Struct("<8sQ6I")
_COUNT: Final = struct.Struct("<Q")
_COUNT_AT: Final = 8
# Space for the truth of a frame: ten thousand stars.
_TRUTH_BYTES: Final = 4 * 2**20
_SHARED: Final = "shm:"
# Poll interval of a reader that waits, s.
_POLL_S: Final = 0.002
# A reader without a new frame opens the name again after this time, s: the writer may have been killed and restarted.
_REOPEN_S: Final = 0.2
# Windows refuses for as long as a reader has the file or the memory open, which is milliseconds: retry this long, s.
_RETRY_S: Final = 1.0
_IS_WINDOWS: Final = os.name == "nt"
# A locked byte cannot be read on Windows: the lock lies far behind the process number in the file.
_LOCKED_BYTE: Final = 2**20


@dataclass(frozen=True, slots=True, eq=False)
class LatestFrame:
    """A frame with its truth.

    Attributes
    ----------
    pixels : (height, width) uint8 or uint16
    truth : dict
        See `glstar.render.truth.frame_truth`.
    """

    pixels: np.ndarray[Any, Any]
    truth: dict[str, Any]


class LatestFrameWriter:
    """Hands over one frame after the other; a context manager.

    Parameters
    ----------
    where : str
        ``shm:NAME`` for shared memory, or a file, which is replaced whole.
    pixels : int
        How many pixels a frame has.

    Raises
    ------
    ConfigError
        If the name is not valid.
    ExportError
        If it cannot be written, or another process is writing it.
    """

    def __init__(self, where: str, pixels: int) -> None:
        self._where, self._writings, self._run = where, 0, randbits(32) | 1
        self._size_bytes = _HEAD.size + _TRUTH_BYTES + 2 * pixels
        self._memory: SharedMemory | None = None
        self._lock: _Lock | None = _Lock(where, _lock_file(where))
        if where.startswith(_SHARED):
            try:
                self._memory = self._new_memory()
            except BaseException:
                self._lock.release()
                raise

    def write(self, pixels: np.ndarray[Any, Any], truth: bytes) -> None:
        """Hand over a frame.

        Parameters
        ----------
        pixels : (height, width) uint8 or uint16
        truth : bytes
            A line of ``truth.jsonl``.

        Raises
        ------
        ExportError
            If it cannot be written, or its truth is longer than any sky's.
        """
        body = truth + np.ascontiguousarray(pixels.astype(pixels.dtype.newbyteorder("<"), copy=False)).tobytes()
        self._writings += 1
        height_px, width_px = pixels.shape
        numbers = len(truth), width_px, height_px, pixels.itemsize, zlib.crc32(body), self._run
        head = _HEAD.pack(_MAGIC, 2 * self._writings, *numbers)
        if self._memory is None:
            self._replace_file(head + body)
            return
        if not self._has_name(self._memory):
            # Somebody removed it, or Python did so late, after the killed writer before this one.
            _buffer(self._memory)[: len(_ENDED)] = _ENDED
            self._memory.close()
            self._memory = self._new_memory()
        buffer = _buffer(self._memory)
        if len(head) + len(body) > len(buffer):
            raise ExportError(self._where, f"a frame of {len(body)} bytes does not fit into {len(buffer)}")
        _COUNT.pack_into(buffer, _COUNT_AT, 2 * self._writings - 1)
        buffer[len(head) : len(head) + len(body)] = body
        buffer[_COUNT_AT + _COUNT.size : len(head)] = head[_COUNT_AT + _COUNT.size :]
        _COUNT.pack_into(buffer, _COUNT_AT, 2 * self._writings)

    def close(self) -> None:
        """Remove shared memory; a file stays.  It may be called twice."""
        if self._memory is not None:
            _end(self._memory)
            self._memory = None
        if self._lock is not None:
            self._lock.release()
            self._lock = None

    def _new_memory(self) -> SharedMemory:
        memory = _memory_for_writing(self._where, self._size_bytes)
        buffer = _buffer(memory)
        # Odd first, so that a reader of the writer before takes no mixture.
        _COUNT.pack_into(buffer, _COUNT_AT, 1)
        _HEAD.pack_into(buffer, 0, _MAGIC, 1, 0, 0, 0, 0, 0, self._run)
        _COUNT.pack_into(buffer, _COUNT_AT, 0)
        return memory

    def _has_name(self, memory: SharedMemory) -> bool:
        """Return whether readers find this memory under its name."""
        try:
            found = _opened(memory.name)
        except FileNotFoundError:
            return False
        try:
            return bytes(_buffer(found)[_HEAD.size - 4 : _HEAD.size]) == self._run.to_bytes(4, "little")
        finally:
            found.close()

    def _replace_file(self, content: bytes) -> None:
        path = Path(self._where)
        temporary = path.with_name(f".glstar-writing-{path.name}")
        try:
            # A file of its own: somebody may have put a link of this name there.
            temporary.unlink(missing_ok=True)
            with temporary.open("xb") as file:
                file.write(content)
            _replace(temporary, path)
        except OSError as error:
            with suppress(OSError):
                temporary.unlink(missing_ok=True)
            raise ExportError(path, f"cannot be written ({error.strerror})") from error

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()


class LatestFrameReader:
    """Reads what a `LatestFrameWriter` hands over; a context manager.

    Nothing needs to be there yet; a writer that was restarted is found again.

    Parameters
    ----------
    where : str
        ``shm:NAME``, or a file.
    """

    def __init__(self, where: str) -> None:
        self._where = where
        self._memory: SharedMemory | None = None
        # When the memory was opened, or last held a new frame, by `time.monotonic`.
        self._fresh_s = 0.0
        # Run and count of the frame that was returned last.
        self._last: tuple[int, int] | None = None

    def read(self) -> LatestFrame | None:
        """Return the newest frame.

        Returns
        -------
        LatestFrame or None
            None where there is none, or none since the last reading.
        """
        raw = self._shared() if self._where.startswith(_SHARED) else self._file()
        if raw is None or len(raw) < _HEAD.size:
            return None
        magic, count, truth_bytes, width_px, height_px, pixel_bytes, checksum, run = _HEAD.unpack_from(raw)
        stop = _HEAD.size + truth_bytes + width_px * height_px * pixel_bytes
        body = raw[_HEAD.size : stop]
        if magic != _MAGIC or (run, count) == self._last or len(raw) < stop or zlib.crc32(body) != checksum:
            return None
        self._last, self._fresh_s = (run, count), time.monotonic()
        pixels = np.frombuffer(body, dtype=f"<u{pixel_bytes}", offset=truth_bytes).reshape(height_px, width_px)
        return LatestFrame(pixels, json.loads(body[:truth_bytes]))

    def wait(self, timeout_s: float) -> LatestFrame | None:
        """Wait for a frame that was not read yet.

        Parameters
        ----------
        timeout_s : float
            No longer than this, s.

        Returns
        -------
        LatestFrame or None
            None where none came in time.
        """
        until_s = time.monotonic() + timeout_s
        while (frame := self.read()) is None and time.monotonic() < until_s:
            time.sleep(_POLL_S)
        return frame

    def close(self) -> None:
        """Let go of the memory; it may be called twice."""
        if self._memory is not None:
            self._memory.close()
            self._memory = None

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def _file(self) -> bytes | None:
        try:
            return Path(self._where).read_bytes()
        except FileNotFoundError:
            return None
        except PermissionError:
            # On Windows so is a file that is just being replaced.
            if not _IS_WINDOWS:
                raise
            return None

    def _shared(self) -> bytes | None:
        if self._memory is not None and time.monotonic() - self._fresh_s > _REOPEN_S:
            self.close()
        if self._memory is None:
            try:
                self._memory = _opened(self._where.removeprefix(_SHARED))
            except (FileNotFoundError, ValueError):
                return None
            self._fresh_s = time.monotonic()
        buffer = _buffer(self._memory)
        magic, count, truth_bytes, width_px, height_px, pixel_bytes, _, run = _HEAD.unpack_from(buffer)
        if magic == _ENDED:
            # Windows keeps it for as long as a reader does.
            self.close()
            return None
        if count % 2 or not count or self._last == (run, count):
            return None
        raw = bytes(buffer[: _HEAD.size + truth_bytes + width_px * height_px * pixel_bytes])
        return raw if _COUNT.unpack_from(buffer, _COUNT_AT)[0] == count else None


class _Lock:
    """A locked file that holds the number of its process.

    Parameters
    ----------
    where : str
        What it guards, for messages.
    path : Path

    Raises
    ------
    ExportError
        If a living process has it.
    """

    def __init__(self, where: str, path: Path) -> None:
        self._path = path
        while True:
            try:
                self._handle = os.open(path, os.O_RDWR | os.O_CREAT | getattr(os, "O_NOFOLLOW", 0), 0o600)
            except PermissionError as error:
                message = f"its lock {path} belongs to another user; choose another name"
                raise ExportError(
                    where, message if path.exists() else f"cannot be written ({error.strerror})"
                ) from error
            except OSError as error:
                raise ExportError(where, f"cannot be written ({error.strerror})") from error
            if not _locked(self._handle):
                process = os.read(self._handle, 20).decode(errors="replace")
                os.close(self._handle)
                raise ExportError(
                    where,
                    f"another glstar (process {process or 'unknown'}) writes its frames there;"
                    " stop that one, or choose another name",
                )
            # The writer before may have removed the file between opening and locking it here.
            with suppress(FileNotFoundError):
                if os.path.samestat(os.fstat(self._handle), path.stat()):
                    break
            os.close(self._handle)
        os.ftruncate(self._handle, 0)
        os.write(self._handle, str(os.getpid()).encode())

    def release(self) -> None:
        """Remove the file and release the lock."""
        if _IS_WINDOWS:
            os.close(self._handle)
        with suppress(OSError):
            self._path.unlink()
        if not _IS_WINDOWS:
            os.close(self._handle)


def _lock_file(where: str) -> Path:
    """Return the file that the writer of a name locks."""
    if not where.startswith(_SHARED):
        path = Path(where)
        return path.with_name(f".{path.name}.lock")
    name = where.removeprefix(_SHARED)
    if not name or "/" in name or len(name) > 30:
        raise ConfigError(f"{where} names no shared memory; write shm:NAME, a short word such as shm:glstar")
    # Beside the shared memory where that is a directory: containers that share the one share the other.
    shared = ("/dev/shm", "/tmp")  # noqa: S108 - a fixed place, the same for all of the user's shells
    directory = gettempdir() if _IS_WINDOWS else next((one for one in shared if Path(one).is_dir()), gettempdir())
    return Path(directory) / f"glstar-{name}.lock"


def _locked(handle: int) -> bool:
    """Lock a file for as long as its process lives; return False where another process has locked it."""
    try:
        if sys.platform == "win32":
            os.lseek(handle, _LOCKED_BYTE, os.SEEK_SET)
            msvcrt.locking(handle, msvcrt.LK_NBLCK, 1)
            os.lseek(handle, 0, os.SEEK_SET)
        else:
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except (BlockingIOError, PermissionError):
        os.lseek(handle, 0, os.SEEK_SET)
        return False
    except OSError:
        # A disk of the network without locks: a second writer cannot be noticed there.
        return True
    return True


def _replace(temporary: Path, path: Path) -> None:
    """Replace a file; Windows refuses while a reader has it open."""
    until_s = time.monotonic() + _RETRY_S
    while True:
        try:
            temporary.replace(path)
        except PermissionError:
            if time.monotonic() > until_s:
                raise
            time.sleep(_POLL_S)
        else:
            return


def _memory_for_writing(where: str, size_bytes: int) -> SharedMemory:
    """Return shared memory of this name, new or of a dead writer; its lock is held."""
    name = where.removeprefix(_SHARED)
    until_s = time.monotonic() + _RETRY_S
    try:
        while True:
            with suppress(FileExistsError):
                return SharedMemory(name, create=True, size=size_bytes)
            with suppress(FileNotFoundError):
                if not _is_ours(name):
                    raise ExportError(where, "is shared memory of another program; choose another name")
                left = SharedMemory(name)
                if left.size >= size_bytes:
                    return left
                size_left = left.size
                _end(left)
                if time.monotonic() > until_s:
                    # Windows keeps it while it is open anywhere.
                    message = f"{size_left} bytes are held open by readers, {size_bytes} are needed; close the readers"
                    raise ExportError(where, f"{message}, or choose another name")
            time.sleep(_POLL_S)
    except OSError as error:
        raise ExportError(where, f"shared memory cannot be made ({error.strerror}); choose another name") from error


def _is_ours(name: str) -> bool:
    """Return whether shared memory was made by a writer of frames."""
    memory = _opened(name)
    try:
        return bytes(_buffer(memory)[: len(_MAGIC)]) in {_MAGIC, _ENDED}
    finally:
        memory.close()


def _end(memory: SharedMemory) -> None:
    """Mark shared memory as ended for its readers, and remove it."""
    _buffer(memory)[: len(_ENDED)] = _ENDED
    memory.close()
    with suppress(FileNotFoundError):
        memory.unlink()


def _opened(name: str) -> SharedMemory:
    """Return shared memory that another process owns, and removes."""
    if sys.version_info >= (3, 13):
        return SharedMemory(name, track=False)
    # Before 3.13 Python removes, when it ends, all shared memory that it ever opened: also that of others.
    register = resource_tracker.register
    resource_tracker.register = lambda *_: None
    try:
        return SharedMemory(name)
    finally:
        resource_tracker.register = register


def _buffer(memory: SharedMemory) -> memoryview:
    buffer = memory.buf
    assert buffer is not None  # it is not closed
    return buffer
