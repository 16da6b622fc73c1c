"""Frames written while the window lives on.

The work has a thread and a headless context of its own, the very ones that ``glstar export`` uses: what it writes is
what the command line writes, images are compressed and written without the window waiting, and contexts belong to
threads.  Taking turns on the window's context would hold it up by a whole frame, compression included, each time.
"""

from collections.abc import Callable
from pathlib import Path
from threading import Event, Thread
from typing import Final

from glstar.errors import ExportError, GlstarError
from glstar.export.executors import SerialExecutor
from glstar.export.run import Export
from glstar.render.opengl import GLRenderer

__all__ = ["BackgroundExport"]


class _Cancelled(Exception):  # noqa: N818 - no error: somebody asked for it
    pass


class BackgroundExport:
    """An export under way.

    Parameters
    ----------
    make : callable
        Returns the job; called on the export's own thread.
    directory : Path
        Where the frames go, for words.

    Attributes
    ----------
    done, of : int
        Frames written, and all.
    directory : Path
    error : str
        What went wrong, in words; empty where nothing did.
    """

    _JOIN_S: Final = 60.0

    def __init__(self, make: Callable[[], Export], directory: Path) -> None:
        self.directory = directory
        self.done = self.of = 0
        self.error = ""
        self._make = make
        self._cancelled = Event()
        self._thread = Thread(target=self._run, name="glstar-export", daemon=True)
        self._thread.start()

    def _run(self) -> None:
        try:
            job = self._make()
            self.of = len(job.numbers)
            with GLRenderer.headless() as renderer:
                job.run(SerialExecutor(renderer), on_frame=self._tell)
        except _Cancelled:
            pass
        except GlstarError as error:
            self.error = str(error)
        except FileNotFoundError as error:
            # The flight is in memory, but its frames are named after the log's content.
            self.error = str(ExportError(error.filename or self.directory, "is gone; put it back to export from it"))
        except OSError as error:
            self.error = str(ExportError(self.directory, f"cannot be written ({error.strerror or error})"))

    def _tell(self, done: int, of: int) -> None:
        self.done, self.of = done, of
        if self._cancelled.is_set() and done < of:
            raise _Cancelled

    @property
    def running(self) -> bool:
        """Whether it is still at work."""
        return self._thread.is_alive()

    def cancel(self) -> None:
        """Stop after the frame at hand; the frames that are there are whole, and stay."""
        self._cancelled.set()

    def wait(self) -> None:
        """Wait until it has ended."""
        self._thread.join(self._JOIN_S)

    @property
    def summary(self) -> str:
        """What came of it, in words."""
        if self.error:
            return self.error
        if self._cancelled.is_set() and self.done < self.of:
            return f"export stopped: {self.done} of {self.of} frames are in {self.directory}, whole"
        return f"{self.done} frame{'s' * (self.done != 1)} and the truth: {self.directory}"
