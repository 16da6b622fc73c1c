"""The newest frame, handed from one process to another: pixels and truth, in shared memory or in a file.

A navigation algorithm runs beside ``glstar live LINK --latest-frame shm:sky`` and reads

>>> with LatestFrameReader("shm:sky") as latest:  # doctest: +SKIP
...     while (frame := latest.wait(timeout_s=10)) is not None:
...         print(frame.truth["utc_mid"], frame.pixels.mean(), frame.truth["q_body_ned"])

This module needs NumPy and nothing else of glstar's; other languages read the same bytes, little-endian:

======  =====  =================================================================
offset  bytes  what
======  =====  =================================================================
0       8      ``GLSTARF1``
8       8      counts the writings, twice each: odd while one is under way
16      4      bytes of truth
20      4      width, px
24      4      height, px
28      4      bytes of a pixel: 1 or 2
32      4      CRC-32 of truth and pixels
40             truth: the frame's line of ``truth.jsonl``
...            pixels, row by row from the top
======  =====  =================================================================

In shared memory a reader copies, and takes the copy if the count is even and stayed the same, and the sum is right.
"""

import json
import os
import struct
import sys
import time
import zlib
from dataclasses import dataclass
from multiprocessing import resource_tracker
from multiprocessing.shared_memory import SharedMemory
from pathlib import Path
from types import TracebackType
from typing import Any, Final, Self

import numpy as np

from glstar.errors import ConfigError, ExportError

__all__ = ["LatestFrame", "LatestFrameReader", "LatestFrameWriter"]

_MAGIC: Final = b"GLSTARF1"
_HEAD: Final = struct.Struct("<8sQ5I4x")
_COUNT: Final = struct.Struct("<Q")
_COUNT_AT: Final = 8
# Room for the truth of a frame: ten thousand stars.
_TRUTH_BYTES: Final = 4 * 2**20
_SHARED: Final = "shm:"
# How often a reader looks, s.
_GLANCE_S: Final = 0.002


@dataclass(frozen=True, slots=True, eq=False)
class LatestFrame:
    """A frame with its truth.

    Attributes
    ----------
    pixels : (height, width) uint8 or uint16
    truth : dict
        See `glstar.truth.frame_truth`.
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
        If the name cannot be meant.
    ExportError
        If it cannot be written.
    """

    def __init__(self, where: str, pixels: int) -> None:
        self._where, self._writings = where, 0
        self._memory: SharedMemory | None = None
        if where.startswith(_SHARED):
            self._memory = _new_memory(where, _HEAD.size + _TRUTH_BYTES + 2 * pixels)

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
        numbers = len(truth), width_px, height_px, pixels.itemsize, zlib.crc32(body)
        head = _HEAD.pack(_MAGIC, 2 * self._writings, *numbers)
        if self._memory is None:
            self._replace_file(head + body)
            return
        room = _room(self._memory)
        if len(head) + len(body) > len(room):
            raise ExportError(self._where, f"a frame of {len(body)} bytes does not fit into {len(room)}")
        _COUNT.pack_into(room, _COUNT_AT, 2 * self._writings - 1)
        room[len(head) : len(head) + len(body)] = body
        room[_COUNT_AT + _COUNT.size : len(head)] = head[_COUNT_AT + _COUNT.size :]
        room[:_COUNT_AT] = _MAGIC
        _COUNT.pack_into(room, _COUNT_AT, 2 * self._writings)

    def close(self) -> None:
        """Take shared memory away; a file stays.  It may be called twice."""
        if self._memory is not None:
            self._memory.close()
            self._memory.unlink()
            self._memory = None

    def _replace_file(self, content: bytes) -> None:
        path = Path(self._where)
        temporary = path.with_name(f".glstar-writing-{path.name}")
        try:
            temporary.write_bytes(content)
            temporary.replace(path)
        except OSError as error:
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
        self._attachments = 0
        # What was given last: of which attachment, or a file of which time, and its count.
        self._given: tuple[int, int] | None = None

    def read(self) -> LatestFrame | None:
        """Return the newest frame.

        Returns
        -------
        LatestFrame or None
            None where there is none, or none since the last reading.
        """
        content = self._file() if not self._where.startswith(_SHARED) else self._shared()
        if content is None:
            return None
        of, raw = content
        magic, count, truth_bytes, width_px, height_px, pixel_bytes, told = _HEAD.unpack_from(raw)
        stop = _HEAD.size + truth_bytes + width_px * height_px * pixel_bytes
        body = raw[_HEAD.size : stop]
        if magic != _MAGIC or (of, count) == self._given or len(raw) < stop or zlib.crc32(body) != told:
            return None
        self._given = of, count
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
            time.sleep(_GLANCE_S)
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

    def _file(self) -> tuple[int, bytes] | None:
        try:
            with Path(self._where).open("rb") as file:
                raw = file.read()
                # Of a file that is replaced every time, the time tells its writers apart.
                return os.fstat(file.fileno()).st_mtime_ns, raw
        except FileNotFoundError:
            return None

    def _shared(self) -> tuple[int, bytes] | None:
        if self._memory is None or not _is_there(self._memory):
            self.close()
            try:
                self._memory = _attached(self._where.removeprefix(_SHARED))
                self._attachments += 1
            except (FileNotFoundError, ValueError):
                return None
        room = _room(self._memory)
        (count,) = _COUNT.unpack_from(room, _COUNT_AT)
        if count % 2 or not count or self._given == (self._attachments, count):
            return None
        _, _, truth_bytes, width_px, height_px, pixel_bytes, _ = _HEAD.unpack_from(room)
        raw = bytes(room[: _HEAD.size + truth_bytes + width_px * height_px * pixel_bytes])
        return (self._attachments, raw) if _COUNT.unpack_from(room, _COUNT_AT)[0] == count else None


def _new_memory(where: str, size_bytes: int) -> SharedMemory:
    """Return shared memory of this name; what a killed writer left under it is taken away."""
    name = where.removeprefix(_SHARED)
    if not name or "/" in name or len(name) > 30:
        raise ConfigError(f"{where} names no shared memory; write shm:NAME, a short word such as shm:glstar")
    try:
        try:
            return SharedMemory(name, create=True, size=size_bytes)
        except FileExistsError:
            left = SharedMemory(name)
            left.close()
            left.unlink()
            return SharedMemory(name, create=True, size=size_bytes)
    except OSError as error:
        raise ExportError(where, f"shared memory cannot be made ({error.strerror})") from error


def _attached(name: str) -> SharedMemory:
    """Return shared memory that another process owns, and takes away."""
    if sys.version_info >= (3, 13):
        return SharedMemory(name, track=False)
    # Before 3.13 Python takes away, when it ends, all shared memory that it ever saw: also that of others.
    register = resource_tracker.register
    resource_tracker.register = lambda *_: None
    try:
        return SharedMemory(name)
    finally:
        resource_tracker.register = register


def _room(memory: SharedMemory) -> memoryview:
    room = memory.buf
    assert room is not None  # it is not closed
    return room


def _is_there(memory: SharedMemory) -> bool:
    """Return whether memory is still that of its name; where that cannot be told, it is."""
    handle = getattr(memory, "_fd", -1)
    if handle < 0:
        return True
    return os.fstat(handle).st_nlink > 0
