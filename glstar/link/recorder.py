"""Every packet of a link in a telemetry log, as ground stations write it."""

import os
import time
from collections.abc import Iterable
from pathlib import Path
from types import TracebackType
from typing import Self

from glstar.errors import LinkError
from glstar.link.framing import Packet

__all__ = ["Recorder"]


class Recorder:
    """Writes packets as they came behind eight bytes of the computer's clock: a ``.tlog``.

    Each writing is one call of the operating system, of whole packets: who is killed leaves a log that ends with one.

    Parameters
    ----------
    path : Path
        A new file.

    Attributes
    ----------
    path : Path
    bytes : int
        How much was written.

    Raises
    ------
    LinkError
        If it is there already, or cannot be made.
    """

    def __init__(self, path: Path) -> None:
        self.path, self.bytes = path, 0
        self._stamp_us = 0
        try:
            self._handle = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL | getattr(os, "O_BINARY", 0), 0o666)
        except FileExistsError:
            raise LinkError(str(path), "is there already; record to another file") from None
        except OSError as error:
            raise LinkError(str(path), f"cannot be written ({error.strerror})") from error
        self._open = True

    def write(self, packets: Iterable[Packet]) -> None:
        """Write packets that have just come.

        Parameters
        ----------
        packets : iterable of Packet

        Raises
        ------
        LinkError
            If the disk is full, or the like; nothing is written after that.
        """
        # A clock that is set back must not turn the log round.
        self._stamp_us = max(time.time_ns() // 1000, self._stamp_us)
        stamp = self._stamp_us.to_bytes(8, "big")
        content = b"".join(stamp + packet.content for packet in packets)
        if not content or not self._open:
            return
        try:
            written = os.write(self._handle, content)
            if written < len(content):
                os.ftruncate(self._handle, self.bytes)
                raise OSError(None, "the disk is full")  # noqa: TRY301 - the same words as for any other fault
        except OSError as error:
            self.close()
            raise LinkError(str(self.path), f"recording has stopped: {error.strerror}") from error
        self.bytes += written

    def close(self) -> None:
        """Let go of the file, and leave none where nothing came; it may be called twice."""
        if self._open:
            self._open = False
            os.close(self._handle)
            if not self.bytes:
                self.path.unlink(missing_ok=True)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()
