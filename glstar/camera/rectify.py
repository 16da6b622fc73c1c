"""Images of a lens made into those of a pinhole, before they are compared: what the paper does with its own."""

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from glstar.camera.model import Camera
from glstar.errors import CalibrationError

__all__ = ["rectify"]

# OpenCV's remap takes images of fewer than 2**15 pixels a side.
_MOST_PX = 32767
_BLOCK_ROWS = 256


def rectify(image: NDArray[Any], camera: Camera) -> tuple[NDArray[Any], Camera]:
    """Return an image as a pinhole of the same size, focal length and principal point would have recorded it.

    Parameters
    ----------
    image : (height, width) or (height, width, channels) uint8, uint16, float32 or float64
        As `camera` recorded it; row 0 is the top.
    camera : Camera
        With its lens.  Without one, the image is returned as it is.

    Returns
    -------
    image : the same shape and dtype
        Zero where `camera` saw nothing.
    camera : Camera
        The pinhole.

    Raises
    ------
    CalibrationError
        If the image is not of the camera's size.

    Notes
    -----
    Teague & Chahl, section 2.3.  Values are interpolated (bicubic), not gathered: the sky keeps its level, and a star's
    total light changes with the area that the lens gave it; a centroid keeps its place.
    """
    if image.shape[:2] != (camera.height_px, camera.width_px):
        raise CalibrationError(
            f"the image is {image.shape[1]} x {image.shape[0]} px and the camera {camera.width_px} x"
            f" {camera.height_px}; rectify images as the camera gives them, neither binned nor turned"
        )
    pinhole = camera.pinhole
    if camera.lens is None:
        return image, pinhole
    if max(image.shape[:2]) > _MOST_PX:
        raise CalibrationError(f"an image of {image.shape[1]} x {image.shape[0]} px is too large to be rectified")
    from_px = np.empty((camera.height_px, camera.width_px, 2), np.float32)
    for top in range(0, camera.height_px, _BLOCK_ROWS):
        rows, columns = np.mgrid[top : min(top + _BLOCK_ROWS, camera.height_px), : camera.width_px]
        from_px[top : top + _BLOCK_ROWS] = camera.project(pinhole.unproject(np.stack([columns, rows], axis=-1)))
    # What the lens never saw lies far outside of the image.
    np.nan_to_num(from_px, copy=False, nan=-1e4)
    rectified = cv2.remap(image, from_px, None, cv2.INTER_CUBIC, borderMode=cv2.BORDER_CONSTANT, borderValue=0)
    return np.asarray(rectified), pinhole
