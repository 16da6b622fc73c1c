"""The image as the camera's processing writes it: what ``[output]`` makes of the simulated one."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from glstar.errors import ConfigError
from glstar.export.processing import CameraProcessing, process
from glstar.render.scene import Scene

__all__ = ["ProcessedImage", "why_not_processed"]


def why_not_processed(scene: Scene) -> str:
    """Return why the image of a scene has no processed form.

    Parameters
    ----------
    scene : Scene

    Returns
    -------
    str
        A message; empty if ``[output]`` processes it.
    """
    try:
        is_active = CameraProcessing.of(scene.sensor).is_active
    except ConfigError as error:
        return str(error)
    if not is_active:
        return 'the camera writes the raw image; settings with [output] process = "isp" develop it'
    if scene.exposure.signal_factor > 1:
        return 'sums of raw images are not processed; exposure.stack = "mean" is'
    return ""


class ProcessedImage:
    """The processed form of the latest image, kept until there is another array of pixels."""

    def __init__(self) -> None:
        self._made: tuple[NDArray[Any], NDArray[np.uint8]] | None = None

    def of(self, pixels: NDArray[Any], scene: Scene) -> NDArray[np.uint8]:
        """Return an image of 8 bits as `glstar.export` writes it.

        Parameters
        ----------
        pixels : (height, width) uint8 or uint16
            Raw digital numbers.
        scene : Scene
            For which `why_not_processed` has no reason.

        Returns
        -------
        (height, width, 3) uint8
            Red, green and blue, which are equal in a grey image.
        """
        if self._made is None or self._made[0] is not pixels:
            made = np.asarray(process(pixels, scene.sensor, sixteen_bits=False), dtype=np.uint8)
            colours = np.repeat(made[..., np.newaxis], 3, axis=2) if made.ndim == 2 else made
            self._made = pixels, np.ascontiguousarray(colours)
        return self._made[1]
