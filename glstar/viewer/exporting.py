"""Exports that run in the background while the window is used.

An export has a thread and a headless OpenGL context of its own, like ``glstar export``, and writes the same files as
the command line.  On the window's context every frame of the export would delay a frame of the window.
"""

from collections.abc import Callable
from pathlib import Path
from threading import Event, Thread
from typing import Final

from glstar.config import Config
from glstar.errors import ExportError, GlstarError
from glstar.export.executors import SerialExecutor
from glstar.export.liveexport import LiveExport
from glstar.export.run import Export
from glstar.link import Link
from glstar.render.opengl import GLRenderer

__all__ = ["BackgroundExport", "BackgroundLiveExport"]


class _Cancelled(Exception):  # noqa: N818 - not an error: the user cancelled
    pass


class BackgroundExport:
    """An export that is running.

    Parameters
    ----------
    make : callable
        Returns the export; called on the thread of the export.
    directory : Path
        Where the frames go, for messages.

    Attributes
    ----------
    done, of : int
        Number of frames written, and of all frames; `of` is 0 if that is not known.
    directory : Path
    error : str
        A message about the error; empty if there was none.
    """

    # Longest time that closing the window waits for the frame being written, s.
    _JOIN_S: Final = 60.0

    def __init__(self, make: Callable[[], Export], directory: Path) -> None:
        self.directory = directory
        self.done = self.of = 0
        self.error = ""
        self._make = make
        self._begin()

    def _begin(self) -> None:
        """Start the thread."""
        self._cancelled = Event()
        self._thread = Thread(target=self._run, name="glstar-export", daemon=True)
        self._thread.start()

    def _run(self) -> None:
        try:
            self._export()
        except _Cancelled:
            pass
        except GlstarError as error:
            self.error = str(error)
        except FileNotFoundError as error:
            # The flight is in memory, but the manifest contains a hash of the log.
            self.error = str(ExportError(error.filename or self.directory, "is missing; put it back to export from it"))
        except OSError as error:
            self.error = str(ExportError(self.directory, f"cannot be written ({error.strerror or error})"))

    def _export(self) -> None:
        job = self._make()
        self.of = len(job.numbers)
        with GLRenderer.headless() as renderer:
            job.run(SerialExecutor(renderer), on_frame=self._count)

    def _count(self, done: int, of: int) -> None:
        self.done, self.of = done, of
        if self._cancelled.is_set() and done < of:
            raise _Cancelled

    @property
    def running(self) -> bool:
        """Whether it is still running."""
        return self._thread.is_alive()

    def cancel(self) -> None:
        """Stop after the current frame; the frames written are complete, and stay."""
        self._cancelled.set()

    def wait(self) -> None:
        """Wait until the thread has ended."""
        self._thread.join(self._JOIN_S)

    @property
    def summary(self) -> str:
        """The result, as a message."""
        if self.error:
            return self.error
        if self._cancelled.is_set() and self.done < self.of:
            return f"export stopped: {self.done} of {self.of} frames are in {self.directory}"
        return f"{self.done} frame{'s' * (self.done != 1)} and the truth: {self.directory}"


class BackgroundLiveExport(BackgroundExport):
    """An export of the frames of a link, as they are exposed, until it is stopped.

    Parameters
    ----------
    config : Config
    link : Link
        Open; it stays the caller's.
    directory : Path
    seed : int
        From which the noise seed of every frame is derived.
    """

    def __init__(self, config: Config, link: Link, directory: Path, *, seed: int) -> None:
        self.directory = directory
        self.done = self.of = 0
        self.error = ""
        command = f"glstar live {link.endpoint.text} --export {directory}"
        self._job = LiveExport(config, link, directory=directory, seed=seed, command=command)
        self._begin()

    def _export(self) -> None:
        with GLRenderer.headless() as renderer:
            self._job.run(renderer, on_frame=self._count_frames)

    def _count_frames(self, done: int) -> None:
        self.done = done

    def cancel(self) -> None:
        """Stop after the current frame."""
        self._job.stop()
