"""Recording of the packets of a link to a telemetry log, as ground stations write it."""

import os
import time
from collections.abc import Callable, Iterable
from contextlib import suppress
from pathlib import Path
from threading import Event, Lock, Thread
from types import TracebackType
from typing import Final, Self

from glstar.errors import LinkError
from glstar.link.framing import Packet
from glstar.system.durable import flush_directory, flush_handle

__all__ = ["LinkRecording", "Recorder"]


# Interval between flushes to the disk, s: a power failure loses the packets of this time.
_FLUSH_EVERY_S: Final = 1.0


class Recorder:
    """Writes packets to a ``.tlog``, each after its arrival time by the computer's clock.

    Each write is one system call with complete packets: if the process is killed, the log ends with a complete packet.
    A separate thread flushes the file to the disk once a second while packets are received.

    Parameters
    ----------
    path : Path
        A new file.
    flush_every_s : float
        Interval between flushes to the disk, s.

    Attributes
    ----------
    path : Path
    bytes : int
        Size of the file.

    Raises
    ------
    LinkError
        If the file exists, or cannot be created.
    """

    def __init__(self, path: Path, *, flush_every_s: float = _FLUSH_EVERY_S) -> None:
        self.path, self.bytes = path, 0
        self._stamp_us = 0
        try:
            self._handle = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL | getattr(os, "O_BINARY", 0), 0o666)
        except FileExistsError:
            raise LinkError(str(path), "is there already; record to another file") from None
        except OSError as error:
            raise LinkError(str(path), f"cannot be written ({error.strerror})") from error
        self._open = True
        self._closing = Event()
        self._flusher = Thread(target=self._flush_regularly, args=(flush_every_s,), name="glstar-record", daemon=True)
        self._flusher.start()

    def write(self, packets: Iterable[Packet]) -> None:
        """Write packets that have just arrived.

        Parameters
        ----------
        packets : iterable of Packet

        Raises
        ------
        LinkError
            If the file cannot be written, as on a full disk; nothing more is written.
        """
        # If the clock is set back, arrival times stay the same instead of decreasing.
        self._stamp_us = max(time.time_ns() // 1000, self._stamp_us)
        stamp = self._stamp_us.to_bytes(8, "big")
        content = b"".join(stamp + packet.content for packet in packets)
        if not content or not self._open:
            return
        try:
            written = os.write(self._handle, content)
            if written < len(content):
                os.ftruncate(self._handle, self.bytes)
                raise OSError(None, "the disk is full")  # noqa: TRY301 - the same message as for other errors
        except OSError as error:
            self.close()
            raise LinkError(str(self.path), f"recording has stopped: {error.strerror}") from error
        self.bytes += written

    def close(self) -> None:
        """Flush and close the file, and remove it if it is empty; may be called twice."""
        if self._open:
            self._open = False
            self._closing.set()
            self._flusher.join()
            with suppress(OSError):  # a disk that is full or gone has been reported
                flush_handle(self._handle)
            os.close(self._handle)
            if not self.bytes:
                self.path.unlink(missing_ok=True)

    def _flush_regularly(self, every_s: float) -> None:
        """Flush the directory once, and the file whenever it has grown."""
        with suppress(OSError):  # the next write reports a disk that is gone
            flush_directory(self.path.parent)
        flushed_bytes = 0
        while not self._closing.wait(every_s):
            received_bytes = self.bytes
            if received_bytes > flushed_bytes:
                with suppress(OSError):
                    flush_handle(self._handle)
                flushed_bytes = received_bytes

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()


class LinkRecording:
    """The recording of a link, which can begin and end while the link is open; for any thread.

    Parameters
    ----------
    recorder : Recorder or None
        Takes the packets at first.
    report : callable
        Called with the message of each event.
    """

    def __init__(self, recorder: Recorder | None, report: Callable[[str], None]) -> None:
        self._recorder, self._report = recorder, report
        self._records = recorder is not None
        # Guards the recorder: no packet is written to a file that is being closed.
        self._lock = Lock()

    @property
    def path(self) -> Path | None:
        """The file that is being written; None if there is none."""
        return self._recorder.path if self._recorder is not None and self._records else None

    @property
    def bytes(self) -> int:
        """Size of the latest recording, bytes; 0 if there is none."""
        return 0 if self._recorder is None else self._recorder.bytes

    def begin(self, path: Path) -> None:
        """Record to a new file from now on; a recording before that ends.

        Parameters
        ----------
        path : Path

        Raises
        ------
        LinkError
            If the file exists, or cannot be created; a recording before that goes on.
        """
        recorder = Recorder(path)
        self.end()
        with self._lock:
            self._recorder, self._records = recorder, True
        self._report(f"recording to {path}")

    def end(self) -> None:
        """Close the file, which is complete then; without a recording nothing happens."""
        with self._lock:
            recorder, recorded, self._records = self._recorder, self._records, False
            if recorder is not None and recorded:
                recorder.close()
        if recorder is not None and recorded:
            self._report(f"recorded {recorder.bytes} bytes: {recorder.path}")

    def write(self, packets: Iterable[Packet]) -> None:
        """Record packets that have just arrived; a file that cannot be written is reported, and ends.

        Parameters
        ----------
        packets : iterable of Packet
        """
        try:
            with self._lock:
                if self._recorder is not None and self._records:
                    self._recorder.write(packets)
        except LinkError as error:
            self._records = False
            self._report(str(error))
