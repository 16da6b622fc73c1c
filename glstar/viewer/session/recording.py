"""Exports in the background while the window is used, and videos of what it shows.

An export has a thread and a headless OpenGL context of its own, like ``glstar export``, and writes the same files as
the command line.  On the window's context every frame of the export would delay a frame of the window.
A video is recorded while the window is used, or of a range of the flight, picture by picture.
"""

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from math import floor, isfinite
from pathlib import Path
from threading import Event, Thread
from typing import Any

import cv2
import numpy as np

from glstar.config import Config
from glstar.errors import ConfigError, ExportError, GlstarError
from glstar.export.imagefiles.formats import VideoFile
from glstar.export.live import LiveExport
from glstar.export.run.executors import SerialExecutor
from glstar.export.run.export import Export
from glstar.link import Link
from glstar.render.opengl import GLRenderer
from glstar.viewer.flight.playhead import PlayHead


class _Cancelled(Exception):  # noqa: N818 - not an error: the user cancelled
    pass


class BackgroundExport:
    """An export that is running.

    `make`: returns the export; called on the thread of the export; `directory`: where the frames go, for messages.
    `done`, `of`: number of frames written, and of all frames; `of` is 0 if that is not known; `error`: a message about
    the error; empty if there was none.
    """

    # Longest time that closing the window waits for the frame being written, s.
    _JOIN_S = 60.0

    def __init__(self, make: Callable[[], Export], directory: Path) -> None:
        self._make = make
        self._begin(directory)

    def _begin(self, directory: Path) -> None:
        """Start the thread."""
        self.directory = directory
        self.done = self.of = 0
        self.error = ""
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
    def progress(self) -> tuple[float, str]:
        """The fraction that is done, 0 if that is not known, and a message."""
        if not self.of:
            return 0.0, f"{self.done} frames"
        return self.done / self.of, f"{self.done} of {self.of} frames"

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

    `link`: open; it stays the caller's; `seed`: from which the noise seed of every frame is derived.
    """

    def __init__(self, config: Config, link: Link, directory: Path, *, seed: int) -> None:
        command = f"glstar live {link.endpoint.text} --export {directory}"
        self._job = LiveExport(config, link, directory=directory, seed=seed, command=command)
        self._begin(directory)

    def _export(self) -> None:
        with GLRenderer.headless() as renderer:
            self._job.run(renderer, on_frame=self._count_frames)

    def _count_frames(self, done: int) -> None:
        self.done = done

    def cancel(self) -> None:
        """Stop after the current frame."""
        self._job.stop()


Picture = np.ndarray[Any, np.dtype[np.uint8]]

# Frames that the window needs to close the dialog in which a video was started.
_SETTLING_FRAMES = 3
# Most frames that one picture of a stalled window is repeated for.
_MOST_REPEATED = 300


class Video(ABC):
    """A video that is being recorded; the file is opened with the size of the first picture.

    `is_done`: whether the next step is to finish it.
    """

    is_done = False

    def __init__(self, path: Path, frames_per_s: float) -> None:
        self.path = path
        self._frames_per_s = frames_per_s
        self._file: VideoFile | None = None
        self._size: tuple[int, int] = (0, 0)

    @property
    @abstractmethod
    def progress(self) -> tuple[float, str]:
        """The fraction that is done, and a message."""

    @abstractmethod
    def prepare(self, head: PlayHead | None) -> bool:
        """Move the play head before a frame of the window; return whether time stands still for the video."""

    @abstractmethod
    def add(self, picture: Picture) -> None:
        """Add a picture of the window, (height, width, 3) uint8, blue, green, red."""

    def stop(self) -> None:
        """End the video with the frames recorded."""
        self.is_done = True

    def finish(self, head: PlayHead | None) -> int:  # noqa: ARG002 - some videos move the play head back
        """Complete the file; return its number of frames, 0 if there is no picture."""
        if self._file is None:
            return 0
        self._file.finish()
        return self._file.count

    def discard(self) -> None:
        """Stop, and remove the file."""
        if self._file is not None:
            self._file.discard()

    def _write(self, picture: Picture, times: int = 1) -> None:
        """Add a picture to the file; an image of another size is scaled to the size of the first."""
        if self._file is None:
            self._size = picture.shape[1], picture.shape[0]
            self._file = VideoFile(self.path, *self._size, self._frames_per_s)
        if (picture.shape[1], picture.shape[0]) != self._size:
            picture = np.asarray(cv2.resize(picture, self._size, interpolation=cv2.INTER_AREA), dtype=np.uint8)
        for _ in range(times):
            self._file.write(picture)


@dataclass(frozen=True, slots=True)
class VideoRange:
    """The part of a flight that a video shows, and how fast.

    Raises ConfigError if one of them is not valid, or no frame fits.
    """

    start_utc_s: float  # UTC seconds since 1970
    stop_utc_s: float
    speed: float = 1.0  # Seconds of flight per second of the video
    frames_per_s: float = 30.0  # Frame rate of the video, 1/s

    def __post_init__(self) -> None:
        for name, value, low, high in (("speed", self.speed, 1e-3, 1e3), ("frames/s", self.frames_per_s, 1.0, 240.0)):
            if not (isfinite(value) and low <= value <= high):
                raise ConfigError(f"a video needs {name} from {low:g} to {high:g}, not {value:g}")
        if not self.stop_utc_s > self.start_utc_s:
            raise ConfigError("the range of a video must end after its beginning")

    @property
    def count(self) -> int:
        """Number of frames, at least 1."""
        return floor((self.stop_utc_s - self.start_utc_s) / self.speed * self.frames_per_s + 1e-6) + 1

    def utc_s(self, number: int) -> float:
        """Return the time of a frame, UTC seconds since 1970; `number`: from 0."""
        return self.start_utc_s + number * self.speed / self.frames_per_s


class ScreenVideo(Video):
    """Records the picture while the viewer is used, at a constant frame rate of the clock.

    `clock`: returns seconds from any origin.
    """

    def __init__(self, path: Path, frames_per_s: float, clock: Callable[[], float]) -> None:
        super().__init__(path, frames_per_s)
        self._clock = clock
        self._began_s: float | None = None
        self._count = 0

    @property
    def progress(self) -> tuple[float, str]:
        """No fraction, and the seconds recorded."""
        return 0.0, f"{self._count / self._frames_per_s:.0f} s recorded"

    def prepare(self, head: PlayHead | None) -> bool:  # noqa: ARG002 - the play head is the user's
        """Leave the play head to the user."""
        return False

    def add(self, picture: Picture) -> None:
        """Add a picture as often as the frame rate needs it: once, not at all, or several times if the window is slow.

        `picture` (height, width, 3) uint8.
        """
        now_s = self._clock()
        self._began_s = now_s if self._began_s is None else self._began_s
        due = floor((now_s - self._began_s) * self._frames_per_s) + 1 - self._count
        if due > 0:
            self._write(picture, min(due, _MOST_REPEATED))
            self._count += due


class RangeVideo(Video):
    """Records a range of the flight: the play head goes to the time of each frame, however long drawing takes."""

    def __init__(self, path: Path, part: VideoRange) -> None:
        super().__init__(path, part.frames_per_s)
        self._part = part
        self._settling = _SETTLING_FRAMES
        self._number = 0
        self._before: tuple[float, bool] | None = None

    @property
    def progress(self) -> tuple[float, str]:
        """The fraction of frames that are recorded, and a message."""
        return self._number / self._part.count, f"{self._number} of {self._part.count} frames"

    def prepare(self, head: PlayHead | None) -> bool:
        """Move the play head to the next frame of the video; see `Video`."""
        if head is not None:
            if self._before is None:
                self._before = head.utc_s, head.playing
            head.seek(self._part.utc_s(self._number))
            head.playing = False
        return True

    def add(self, picture: Picture) -> None:
        """Add a picture, after the window is drawn without the dialog; `picture` (height, width, 3) uint8."""
        if self._settling:
            self._settling -= 1
            return
        self._write(picture)
        self._number += 1
        self.is_done = self._number >= self._part.count

    def finish(self, head: PlayHead | None) -> int:
        """Complete the file and put the play head where it was; see `Video`."""
        if head is not None and self._before is not None:
            utc_s, playing = self._before
            head.seek(utc_s)
            head.playing = playing
        return super().finish(head)
