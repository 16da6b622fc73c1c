"""Writes frames so that a power failure loses none: files are flushed in groups, then their lines of truth are written.

The order for each frame, which holds on every file system:

1. the image (and the light) is written under a temporary name,
2. flushed, together with those of the frames around it, on a thread that drawing does not wait for,
3. renamed: a file that has its name is whole,
4. the line of truth is written.

A power failure may lose the steps that have not been flushed, in any order.  Whatever it leaves, a frame with files and
line has them whole, and any other frame is drawn again.  The flush of the next group makes the names and lines of the
last one durable.
"""

import time
from collections import deque
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import AbstractContextManager, nullcontext, suppress
from math import inf
from pathlib import Path
from threading import Lock
from types import TracebackType
from typing import IO, Final, Self

from glstar.export.truthfile import TruthFile
from glstar.system.durable import StagedFile, flush, flush_directory, flush_handle

__all__ = ["FrameWriter"]

# Frames are flushed in groups, each on several threads: 0.2 to 0.7 ms of an ext4 disk for each frame instead of 3.4 ms
# by single frames.  While ext4 commits its journal nobody makes or renames files, so groups are at least this far
# apart, s, unless they are large.
_GROUP_S: Final = 0.5
# Fewer frames wait up to as long for others.
_GROUP_FRAMES: Final = 8
# More memory is not kept from the system, nor more frames put at risk of a kill.
_MOST_FRAMES: Final = 64
_MOST_BYTES: Final = 1 << 26


class FrameWriter:
    """Writes frames and their truth in an order that survives a power failure; a context manager.

    Leaving it writes what is complete and removes what is not.  `stage` may be called from any thread, everything else
    from one thread.

    Parameters
    ----------
    truth : TruthFile
    lines : binary file
        What `truth.growing` gave.
    group_s : float
        How long a frame may wait for others to be flushed with it, s.
    writing : callable
        Returns a context in which files are staged, renamed, and vouched for; it raises where that is no longer
        allowed: `Export.writing`.
    """

    def __init__(
        self,
        truth: TruthFile,
        lines: IO[bytes],
        *,
        group_s: float = _GROUP_S,
        writing: Callable[[], AbstractContextManager[None]] = nullcontext,
    ) -> None:
        self._truth, self._lines, self._group_s, self._writing = truth, lines, group_s, writing
        self._lock = Lock()
        self._staged: dict[int, list[StagedFile]] = {}  # by frame
        self._waiting: deque[tuple[int, bytes]] = deque()
        self._waiting_since_s = 0.0
        self._waiting_bytes = 0
        self._flushed_at_s = -inf
        self._group: deque[tuple[int, bytes]] = deque()  # being flushed, or flushed and to be renamed
        self._flushed: Future[None] | None = None
        self._directories: set[Path] = set()  # with names that have not been flushed
        self._flusher = ThreadPoolExecutor(1, "glstar-flush")
        self._helpers = ThreadPoolExecutor(_GROUP_FRAMES, "glstar-flush-file")

    def stage(self, number: int, path: Path, content: bytes) -> None:
        """Write a file of a frame under a temporary name.

        Parameters
        ----------
        number : int
            The frame.
        path : Path
        content : bytes

        Raises
        ------
        OSError
            If it cannot be written.
        """
        staged = StagedFile.beside(path)
        with self._lock:
            self._staged.setdefault(number, []).append(staged)
            self._waiting_bytes += len(content)
        with self._writing():
            staged.write(content)

    def add(self, number: int, line: bytes) -> Iterator[int]:
        """Take a frame whose files have been staged.

        Parameters
        ----------
        number : int
        line : bytes
            Its line of truth.

        Yields
        ------
        int
            Frames that are complete on the disk by now, as from `poll`.

        Raises
        ------
        OSError
            If a frame cannot be written.
        """
        if not self._waiting:
            self._waiting_since_s = time.monotonic()
        self._waiting.append((number, line))
        yield from self.poll()

    def poll(self) -> Iterator[int]:
        """Rename the files that have been flushed, and flush the next group if it is due.

        Yields
        ------
        int
            Frames whose files have their names, and that have their line of truth, in the order of `add`.

        Raises
        ------
        OSError
            If a frame cannot be written.
        """
        is_large = len(self._waiting) >= _MOST_FRAMES or self._waiting_bytes >= _MOST_BYTES
        if self._flushed is not None and (self._flushed.done() or is_large):
            yield from self._commit()
        if self._flushed is None and self._waiting and (is_large or self._is_due()):
            self._begin_flush()

    def _is_due(self) -> bool:
        now_s = time.monotonic()
        since_s = self._waiting_since_s if len(self._waiting) < _GROUP_FRAMES else self._flushed_at_s
        return now_s - since_s >= self._group_s

    def drain(self) -> Iterator[int]:
        """Write all frames that have been added.

        Yields
        ------
        int
            As from `poll`.

        Raises
        ------
        OSError
            If a frame cannot be written.
        """
        while self._flushed is not None or self._waiting:
            if self._flushed is None:
                self._begin_flush()
            yield from self._commit()

    def _begin_flush(self) -> None:
        self._group, self._waiting = self._waiting, deque()
        self._flushed_at_s = time.monotonic()
        with self._lock:
            self._waiting_bytes = 0
            temporaries = [staged.temporary for number, _ in self._group for staged in self._staged.get(number, ())]
        directories, self._directories = self._directories, set()
        self._flushed = self._flusher.submit(self._flush, temporaries, directories)

    def _flush(self, temporaries: list[Path], directories: set[Path]) -> None:
        flush(temporaries, executor=self._helpers)
        if directories:  # of the group before: its names and lines
            of_lines = self._helpers.submit(flush_handle, self._lines.fileno())
            deque(self._helpers.map(flush_directory, directories), maxlen=0)
            of_lines.result()

    def _commit(self) -> Iterator[int]:
        """Rename the files of the group once they are flushed, each frame's before its line of truth."""
        assert self._flushed is not None
        self._flushed.result()
        while self._group:
            number, line = self._group.popleft()
            with self._lock:
                files = self._staged.pop(number, [])
            try:
                with self._writing():
                    for file in files:
                        file.rename()
                        self._directories.add(file.path.parent)
                    self._truth.append(self._lines, number, line)
            except BaseException:
                for file in files:
                    file.discard()
                raise
            yield number
        self._flushed = None

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        try:
            if error is None:
                deque(self.drain(), maxlen=0)
            else:
                with suppress(Exception):  # the first error is the one to report
                    deque(self.drain(), maxlen=0)
        finally:
            self._flusher.shutdown()
            self._helpers.shutdown()
            for files in self._staged.values():
                for file in files:
                    file.discard()
