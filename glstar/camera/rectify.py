"""Rectification: images of a lens resampled to those of a pinhole, as the paper does before comparing."""

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from glstar.camera.model import Camera
from glstar.errors import CalibrationError

# Largest side of an image that OpenCV's remap accepts, px.
_MOST_PX = 32767
# Rows whose positions are computed together; limits memory.
_BLOCK_ROWS = 256


def rectify(image: NDArray[Any], camera: Camera) -> tuple[NDArray[Any], Camera]:
    """Return an image as a pinhole would have recorded it, and the pinhole: of the same size and camera matrix.

    `image` is (height, width) or (height, width, channels) of uint8, uint16, float32 or float64; row 0 is the top.  The
    result is zero where the lens has no image; without a lens it is the image itself.  Values are interpolated
    (bicubic): the level of the sky is preserved, and the flux of a star changes with the local magnification of the
    lens; centroids are preserved.  Raises CalibrationError if the size of the image is not that of the camera.  Teague
    & Chahl, section 2.3.
    """
    if image.shape[:2] != (camera.height_px, camera.width_px):
        raise CalibrationError(
            f"the image is {image.shape[1]} x {image.shape[0]} px and the camera {camera.width_px} x"
            f" {camera.height_px}; rectify images as the camera records them, neither binned nor rotated"
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
    # Positions without an image are moved far outside of it, where remap returns 0.
    np.nan_to_num(from_px, copy=False, nan=-1e4)
    rectified = cv2.remap(image, from_px, None, cv2.INTER_CUBIC, borderMode=cv2.BORDER_CONSTANT, borderValue=0)
    return np.asarray(rectified), pinhole
