"""Frames on a virtual video device, for programs that read a camera by its number or path.

On Linux the device belongs to the kernel module v4l2loopback, on Windows and macOS to OBS.
"""

from types import TracebackType
from typing import Any, Final, Self

import cv2
import numpy as np
from numpy.typing import NDArray

from glstar.camera.model import Camera
from glstar.camera.sensor import Sensor
from glstar.errors import ConfigError
from glstar.export.processing import shown_as_8_bits
from glstar.system.installation import install_command

__all__ = ["VIDEO", "VideoDevice"]

VIDEO: Final = "video:"


class VideoDevice:
    """Shows frames on a virtual video device; a context manager.

    Parameters
    ----------
    where : str
        ``video:`` for the first device, ``video:/dev/video10`` for a device on Linux.
    camera : Camera
    sensor : Sensor
        Of the frames: ``[output]`` processes them, otherwise its saturation is white.
    frames_per_s : float
        What the device says of its rate, 1/s.
    summed : int
        Number of short exposures whose sum a frame is.

    Raises
    ------
    ConfigError
        If pyvirtualcam is not installed, or there is no such device.
    """

    def __init__(self, where: str, camera: Camera, sensor: Sensor, *, frames_per_s: float, summed: int = 1) -> None:
        library, device = _library(), where.removeprefix(VIDEO) or None
        self._sensor, self._summed = sensor, summed
        try:
            self._device = library.Camera(camera.width_px, camera.height_px, frames_per_s, device=device)
        except RuntimeError as error:
            reason = " ".join(str(error).split())
            raise ConfigError(
                f"{where} cannot be opened ({reason}); on Linux, make a device: sudo modprobe v4l2loopback"
            ) from error

    def write(self, pixels: NDArray[Any], _truth: bytes, _nav: dict[str, Any]) -> None:
        """Show a frame.

        Parameters
        ----------
        pixels : (height, width) uint8 or uint16
        """
        shown = shown_as_8_bits(pixels, self._sensor, summed=self._summed)
        self._device.send(np.ascontiguousarray(shown if shown.ndim == 3 else cv2.cvtColor(shown, cv2.COLOR_GRAY2RGB)))

    def close(self) -> None:
        """Give the device back; a second call does nothing."""
        self._device.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()


def _library() -> Any:
    try:
        import pyvirtualcam  # noqa: PLC0415 - an extra
    except ImportError as error:
        raise ConfigError(f"video: needs pyvirtualcam: {install_command('video')}") from error
    return pyvirtualcam
