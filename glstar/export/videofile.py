"""Videos that are written frame by frame: complete under their name, or absent."""

from pathlib import Path
from types import TracebackType
from typing import Any, Self

import cv2
import numpy as np

from glstar.errors import ExportError
from glstar.export.diskerrors import explain_disk_errors
from glstar.system.durable import TEMPORARY, make_directory, publish

__all__ = ["VideoFile"]


class VideoFile:
    """An MPEG-4 video that is being written; a context manager, which discards the video unless `finish` was called.

    Parameters
    ----------
    path : Path
        Must end with .mp4.
    width_px, height_px : int
        Size of the pictures.  The codec needs even sides: of an odd side, the video omits the last row or column.
    frames_per_s : float
        Frame rate, 1/s.

    Attributes
    ----------
    path : Path
    count : int
        Number of frames written.

    Raises
    ------
    ExportError
        If the video cannot be written.
    """

    def __init__(self, path: Path, width_px: int, height_px: int, frames_per_s: float) -> None:
        if path.suffix.lower() != ".mp4":
            raise ExportError(path, "is no name for a video; it must end with .mp4")
        if min(width_px, height_px) < 2:
            raise ExportError(path, f"would have pictures of {width_px} x {height_px} px, and a video needs 2 x 2")
        self.path, self.count = path, 0
        self._size = width_px - width_px % 2, height_px - height_px % 2
        self._temporary = path.with_name(f"{TEMPORARY}{path.name}")
        self._writer: Any = None
        with explain_disk_errors(path):
            make_directory(path.parent)
            # Create the file exclusively: the codec would follow a link of this name, and it reports no reason when it
            # cannot write.
            self._temporary.unlink(missing_ok=True)
            self._temporary.open("xb").close()
        codec = cv2.VideoWriter.fourcc(*"mp4v")
        self._writer = cv2.VideoWriter(str(self._temporary), codec, frames_per_s, self._size, isColor=True)
        if not self._writer.isOpened():
            self.discard()
            raise ExportError(path, f"cannot be encoded: OpenCV has no MPEG-4 encoder for {frames_per_s:g} frames/s")

    def write(self, picture: np.ndarray[Any, np.dtype[np.uint8]]) -> None:
        """Add a frame.

        Parameters
        ----------
        picture : (height, width) or (height, width, 3) uint8
            Grey, or blue, green, red.
        """
        width_px, height_px = self._size
        cut = np.ascontiguousarray(picture[:height_px, :width_px])
        self._writer.write(cut if cut.ndim == 3 else cv2.cvtColor(cut, cv2.COLOR_GRAY2BGR))
        self.count += 1

    def finish(self) -> None:
        """Complete the video and give the file its name.

        Raises
        ------
        ExportError
            If it cannot be read back with all its frames.
        """
        self._writer.release()
        try:
            if _count_frames(self._temporary) != self.count or not self.count:
                raise ExportError(self.path, "could not be written completely; is the disk full?")
            with explain_disk_errors(self.path):
                publish(self._temporary, self.path)
        finally:
            self.discard()

    def discard(self) -> None:
        """Remove what has been written, unless it is complete."""
        if self._writer is not None:
            self._writer.release()
        self._temporary.unlink(missing_ok=True)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.discard()


def _count_frames(path: Path) -> int:
    """Return the number of frames of a video that can be read back; the encoder reports no errors."""
    reader = cv2.VideoCapture(str(path))
    try:
        count = 0
        while reader.grab():
            count += 1
        return count
    finally:
        reader.release()
