"""The latest frame, passed from one process to another: pixels and truth, in shared memory or in a file.

A navigation algorithm runs beside ``glstar live LINK --latest-frame shm:sky`` and reads

>>> with LatestFrameReader("shm:sky") as latest:  # doctest: +SKIP
...     while (frame := latest.wait(timeout_s=10)) is not None:
...         print(frame.truth["utc_mid"], frame.pixels.mean(), frame.truth["q_body_ned"])

Other languages read the same bytes, little-endian:

======  =====  ==================================================================================
offset  bytes  content
======  =====  ==================================================================================
0       8      ``GLSTARF1``; ``GLSTARF0`` after the writer has ended: open the name again
8       8      counter: 2 more for each frame, 0 before the first, odd while a frame is being written
16      4      size of the truth, bytes
20      4      width, px
24      4      height, px
28      4      size of a pixel, bytes: 1 or 2
32      4      CRC-32 of truth and pixels
36      4      run: a random number of the writer, different after each restart
40             truth: the line of ``truth.jsonl`` of the frame
...            pixels, row by row from the top
======  =====  ==================================================================================

A reader of shared memory copies the frame.  The copy is valid if the counter is even, has not changed meanwhile, and
the checksum matches.  A frame is new if its run or counter differs from the previous frame's.  A writer that is killed
does not mark the end: a reader without a new frame for a while opens the name again.

One process at a time can write to a name.  It locks a file: `/dev/shm/glstar-NAME.lock` for shared memory (in `/tmp` on
macOS, in the user's folder for temporary files on Windows) and ``.NAME.lock`` beside a file.  The operating system
releases the lock however the process ends, so that the next writer can take over the name.
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
from typing import Any, Self

import numpy as np

from glstar.errors import ConfigError, ExportError
from glstar.system.files import LockFile, LockHeldError, StagedFile, remove_staged

_MAGIC = b"GLSTARF1"
_ENDED = b"GLSTARF0"
_HEAD = struct.Struct("<8sQ6I")
_COUNT = struct.Struct("<Q")
_COUNT_OFFSET = 8
# Space for the truth of a frame, bytes: enough for 10,000 stars.
_TRUTH_BYTES = 4 * 2**20
_SHARED = "shm:"
# Interval at which a waiting reader checks for a new frame, and a writer retries, s.
_POLL_INTERVAL_S = 0.002
# Time without a new frame after which a reader opens the name again, s: the writer may have been killed and restarted.
_REOPEN_S = 0.2
# Windows refuses while a reader has the file or the memory open, which takes milliseconds.  Time to keep trying, s.
_RETRY_S = 1.0
_IS_WINDOWS = os.name == "nt"


@dataclass(frozen=True, slots=True, eq=False)
class LatestFrame:
    """A frame with its truth.

    Attributes
    ----------
    pixels : (height, width) uint8 or uint16
    truth : dict
        See `glstar.render.truth.frame.frame_truth`.
    """

    pixels: np.ndarray[Any, Any]
    truth: dict[str, Any]


class LatestFrameWriter:
    """Passes frames to readers, one after the other; a context manager.

    Parameters
    ----------
    where : str
        ``shm:NAME`` for shared memory, or a file, which is replaced atomically.
    pixels : int
        Number of pixels of a frame.

    Raises
    ------
    ConfigError
        If the name is not valid.
    ExportError
        If the name cannot be written, or another process writes to it.
    """

    needs_nav = False

    def __init__(self, where: str, pixels: int) -> None:
        self._where, self._writings, self._run = where, 0, randbits(32) | 1
        self._size_bytes = _HEAD.size + _TRUTH_BYTES + 2 * pixels
        self._memory: SharedMemory | None = None
        self._lock: LockFile | None = _lock(where)
        if where.startswith(_SHARED):
            try:
                self._memory = self._new_memory()
            except BaseException:
                self._lock.release()
                raise
        else:
            remove_staged(Path(where))

    def write(self, pixels: np.ndarray[Any, Any], truth: bytes, _nav: dict[str, Any] | None = None) -> None:
        """Pass a frame to the readers.

        Parameters
        ----------
        pixels : (height, width) uint8 or uint16
        truth : bytes
            A line of ``truth.jsonl``.

        Raises
        ------
        ExportError
            If it cannot be written, or its truth needs more than 4 MiB.
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
            # Another process removed the name, such as Python's resource tracker after a previous writer was killed.
            _buffer(self._memory)[: len(_ENDED)] = _ENDED
            self._memory.close()
            self._memory = self._new_memory()
        buffer = _buffer(self._memory)
        if len(head) + len(body) > len(buffer):
            raise ExportError(self._where, f"a frame of {len(body)} bytes does not fit into {len(buffer)}")
        _COUNT.pack_into(buffer, _COUNT_OFFSET, 2 * self._writings - 1)
        buffer[len(head) : len(head) + len(body)] = body
        buffer[_COUNT_OFFSET + _COUNT.size : len(head)] = head[_COUNT_OFFSET + _COUNT.size :]
        _COUNT.pack_into(buffer, _COUNT_OFFSET, 2 * self._writings)

    def close(self) -> None:
        """Remove shared memory, or keep the file; a second call does nothing."""
        if self._memory is not None:
            _end(self._memory)
            self._memory = None
        if self._lock is not None:
            self._lock.release()
            self._lock = None

    def _new_memory(self) -> SharedMemory:
        memory = _memory_for_writing(self._where, self._size_bytes)
        buffer = _buffer(memory)
        # The counter is odd at first, so that a reader of the previous writer accepts no mixture.
        _COUNT.pack_into(buffer, _COUNT_OFFSET, 1)
        _HEAD.pack_into(buffer, 0, _MAGIC, 1, 0, 0, 0, 0, 0, self._run)
        _COUNT.pack_into(buffer, _COUNT_OFFSET, 0)
        return memory

    def _has_name(self, memory: SharedMemory) -> bool:
        """Return whether readers find this memory under the name."""
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
        staged = StagedFile.beside(path)
        try:
            staged.write(content)
            _rename(staged)
        except OSError as error:
            staged.discard()
            raise ExportError(path, f"cannot be written ({error.strerror})") from error

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


class LatestFrameReader:
    """Reads the frames of a `LatestFrameWriter`; a context manager.

    The writer may start later, and may be restarted.

    Parameters
    ----------
    where : str
        ``shm:NAME``, or a file.
    """

    def __init__(self, where: str) -> None:
        self._where = where
        self._memory: SharedMemory | None = None
        # Time at which the memory was opened or last held a new frame, by `time.monotonic`.
        self._fresh_s = 0.0
        # Run and counter of the frame that was returned last.
        self._last: tuple[int, int] | None = None

    def read(self) -> LatestFrame | None:
        """Return the latest frame.

        Returns
        -------
        LatestFrame or None
            None if there is no frame, or no new one since the last call.
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
        """Wait for a new frame.

        Parameters
        ----------
        timeout_s : float
            Maximum time to wait, s.

        Returns
        -------
        LatestFrame or None
            None if no frame came in time.
        """
        until_s = time.monotonic() + timeout_s
        while (frame := self.read()) is None and time.monotonic() < until_s:
            time.sleep(_POLL_INTERVAL_S)
        return frame

    def close(self) -> None:
        """Close the memory; a second call does nothing."""
        if self._memory is not None:
            self._memory.close()
            self._memory = None

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _file(self) -> bytes | None:
        try:
            return Path(self._where).read_bytes()
        except FileNotFoundError:
            return None
        except PermissionError:
            # On Windows a file cannot be opened while it is being replaced.
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
            # Windows keeps the memory while a reader has it open.
            self.close()
            return None
        if count % 2 or not count or self._last == (run, count):
            return None
        raw = bytes(buffer[: _HEAD.size + truth_bytes + width_px * height_px * pixel_bytes])
        return raw if _COUNT.unpack_from(buffer, _COUNT_OFFSET)[0] == count else None


def _lock(where: str) -> LockFile:
    """Lock a name for one writer."""
    path = _lock_path(where)
    try:
        return LockFile(path)
    except LockHeldError as error:
        message = (
            f"another glstar (process {error.process}) writes its frames there; stop that one, or choose another name"
        )
        raise ExportError(where, message) from None
    except PermissionError as error:
        message = f"its lock {path} belongs to another user; choose another name"
        raise ExportError(where, message if path.exists() else f"cannot be written ({error.strerror})") from error
    except OSError as error:
        raise ExportError(where, f"cannot be written ({error.strerror})") from error


def _lock_path(where: str) -> Path:
    """Return the lock file of a name."""
    if not where.startswith(_SHARED):
        path = Path(where)
        return path.with_name(f".{path.name}.lock")
    name = where.removeprefix(_SHARED)
    if not name or "/" in name or len(name) > 30:
        raise ConfigError(f"{where} is no name of shared memory; write shm:NAME with a short word, such as shm:glstar")
    # In /dev/shm if it exists, so that containers that share the memory share the lock.
    shared = ("/dev/shm", "/tmp")  # noqa: S108 - one fixed directory for all processes, whatever their TMPDIR
    directory = gettempdir() if _IS_WINDOWS else next((path for path in shared if Path(path).is_dir()), gettempdir())
    return Path(directory) / f"glstar-{name}.lock"


def _rename(staged: StagedFile) -> None:
    """Rename a staged file; on Windows, retry while a reader has the old one open."""
    until_s = time.monotonic() + _RETRY_S
    while True:
        try:
            staged.rename()
        except PermissionError:
            if time.monotonic() > until_s:
                raise
            time.sleep(_POLL_INTERVAL_S)
        else:
            return


def _memory_for_writing(where: str, size_bytes: int) -> SharedMemory:
    """Return shared memory of this name, new or left by a dead writer; the caller holds the lock."""
    name = where.removeprefix(_SHARED)
    until_s = time.monotonic() + _RETRY_S
    try:
        while True:
            with suppress(FileExistsError):
                return SharedMemory(name, create=True, size=size_bytes)
            with suppress(FileNotFoundError):
                if not _is_latest_frame(name):
                    raise ExportError(where, "is shared memory of another program; choose another name")
                existing = SharedMemory(name)
                if existing.size >= size_bytes:
                    return existing
                existing_bytes = existing.size
                _end(existing)
                if time.monotonic() > until_s:
                    # Windows keeps it while any process has it open.
                    message = (
                        f"{existing_bytes} bytes are held open by readers, {size_bytes} are needed; close the readers"
                    )
                    raise ExportError(where, f"{message}, or choose another name")
            time.sleep(_POLL_INTERVAL_S)
    except OSError as error:
        raise ExportError(where, f"shared memory cannot be made ({error.strerror}); choose another name") from error


def _is_latest_frame(name: str) -> bool:
    """Return whether shared memory was created by a `LatestFrameWriter`."""
    memory = _opened(name)
    try:
        return bytes(_buffer(memory)[: len(_MAGIC)]) in {_MAGIC, _ENDED}
    finally:
        memory.close()


def _end(memory: SharedMemory) -> None:
    """Mark shared memory as ended for its readers, and remove its name."""
    _buffer(memory)[: len(_ENDED)] = _ENDED
    memory.close()
    with suppress(FileNotFoundError):
        memory.unlink()


def _opened(name: str) -> SharedMemory:
    """Open shared memory that another process owns and will remove."""
    if sys.version_info >= (3, 13):
        return SharedMemory(name, track=False)
    # Before 3.13, Python removes at exit all shared memory that it has opened, even that of other processes.
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
