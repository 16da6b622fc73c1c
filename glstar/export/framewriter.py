"""Writing of frames so that they survive a power failure: files are flushed in groups, then their truth is written.

The steps for each frame, in an order that is safe on every file system:

1. its files are written under temporary names,
2. flushed, together with those of other frames, on a background thread,
3. renamed, so that a file with its final name is complete,
4. the line of truth is appended.

A power failure may lose any steps that have not been flushed.  If a frame has its files and its line afterwards, they
are complete; any other frame is drawn again.  The flush of the next group makes the names and lines of the previous one
durable.
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

# Minimum interval between the flushes of two groups, s, unless the group is large.  No process can create or rename
# files while ext4 commits its journal.  Groups take 0.2 to 0.7 ms per frame on ext4, single frames 3.4 ms.
_GROUP_INTERVAL_S: Final = 0.5
# A smaller group waits up to the same time for more frames.
_GROUP_FRAMES: Final = 8
# A group of this size is flushed at once: it limits the dirty memory, and the frames that a kill can lose.
_MAX_GROUP_FRAMES: Final = 64
_MAX_GROUP_BYTES: Final = 1 << 26


class FrameWriter:
    """Writes frames and their truth in an order that survives a power failure; a context manager.

    Leaving the context writes the frames that have been added and removes other staged files.  `stage` may be called
    from any thread, all other methods from one thread.

    Parameters
    ----------
    truth : TruthFile
    lines : binary file
        From `TruthFile.open_for_append`.
    group_s : float
        Minimum interval between flushes, s.
    writing : callable
        Returns a context in which files may be written; entering it raises if another run has taken over the directory:
        `FrameTask.writing`.
    """

    def __init__(
        self,
        truth: TruthFile,
        lines: IO[bytes],
        *,
        group_s: float = _GROUP_INTERVAL_S,
        writing: Callable[[], AbstractContextManager[None]] = nullcontext,
    ) -> None:
        self._truth, self._lines, self._group_s, self._writing = truth, lines, group_s, writing
        self._lock = Lock()
        self._staged: dict[int, list[StagedFile]] = {}  # by frame number
        self._waiting: deque[tuple[int, bytes]] = deque()
        self._waiting_since_s = 0.0
        self._waiting_bytes = 0
        self._flushed_at_s = -inf
        self._group: deque[tuple[int, bytes]] = deque()  # being flushed, or flushed and not renamed yet
        self._flushed: Future[None] | None = None
        self._directories: set[Path] = set()  # with new names that have not been flushed
        self._flusher = ThreadPoolExecutor(1, "glstar-flush")
        self._helpers = ThreadPoolExecutor(_GROUP_FRAMES, "glstar-flush-file")

    def stage(self, number: int, path: Path, content: bytes) -> None:
        """Write a file of a frame under a temporary name.

        Parameters
        ----------
        number : int
            Frame number.
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
        """Add a frame whose files have been staged.

        Parameters
        ----------
        number : int
        line : bytes
            Its line of truth.

        Yields
        ------
        int
            Frames that are complete on the disk, as from `poll`.

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
            Frames whose files are renamed and whose line of truth is appended, in the order of `add`.

        Raises
        ------
        OSError
            If a frame cannot be written.
        """
        is_large = len(self._waiting) >= _MAX_GROUP_FRAMES or self._waiting_bytes >= _MAX_GROUP_BYTES
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
        if directories:  # names and lines of the previous group
            of_lines = self._helpers.submit(flush_handle, self._lines.fileno())
            deque(self._helpers.map(flush_directory, directories), maxlen=0)
            of_lines.result()

    def _commit(self) -> Iterator[int]:
        """Rename the files of the flushed group, and append the line of truth of each frame after its files."""
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
                with suppress(Exception):  # report the first error
                    deque(self.drain(), maxlen=0)
        finally:
            self._flusher.shutdown()
            self._helpers.shutdown()
            for files in self._staged.values():
                for file in files:
                    file.discard()
