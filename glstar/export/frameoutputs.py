"""Where frames go while they are drawn, besides files: other processes, a browser, a video device."""

from typing import Any, Protocol

from numpy.typing import NDArray

from glstar.camera.model import Camera
from glstar.camera.sensor import Sensor
from glstar.export.framestream import STREAM, FrameStream
from glstar.export.latestframe import LatestFrameWriter
from glstar.export.mjpegserver import HTTP, MjpegServer
from glstar.export.videodevice import VIDEO, VideoDevice

__all__ = ["FrameOutput", "open_frame_output"]


class FrameOutput(Protocol):
    """Receives each frame as soon as it is drawn."""

    def write(self, pixels: NDArray[Any], truth: bytes, nav: dict[str, Any]) -> None:
        """Pass a frame on.

        Parameters
        ----------
        pixels : (height, width) uint8 or uint16
            Raw digital numbers.
        truth : bytes
            The line of ``truth.jsonl``.
        nav : dict
            What the aircraft knows: the line of ``nav.jsonl``; empty if the output does not need it.
        """
        ...

    def close(self) -> None:
        """End the output; a second call does nothing."""
        ...


def open_frame_output(
    where: str, camera: Camera, sensor: Sensor, *, interval_s: float, summed: int = 1, with_truth: bool = False
) -> FrameOutput:
    """Open an output of frames.

    Parameters
    ----------
    where : str
        ``shm:NAME``, a file, ``zmq://HOST:PORT``, ``http://HOST:PORT`` or ``video:DEVICE``.
    camera : Camera
    sensor : Sensor
        Of the frames.
    interval_s : float
        Time between frames, s.
    summed : int
        Number of short exposures whose sum a frame is.
    with_truth : bool
        Whether ``zmq://`` sends the truth, too.

    Returns
    -------
    FrameOutput

    Raises
    ------
    ConfigError
        If the name is not valid, the address is in use, or a library or device is missing.
    ExportError
        If another process writes to a name.
    """
    if where.startswith(STREAM):
        return FrameStream(where, with_truth=with_truth)
    if where.startswith(HTTP):
        return MjpegServer(where, sensor, summed=summed)
    if where.startswith(VIDEO):
        return VideoDevice(where, camera, sensor, frames_per_s=1 / interval_s, summed=summed)
    return LatestFrameWriter(where, camera.width_px * camera.height_px)
