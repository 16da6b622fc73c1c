"""Images as digital numbers: decoded to grey, scaled to the size of the simulated image, or rectified."""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Self

import cv2
import numpy as np
from numpy.typing import NDArray

from glstar.camera.model import Camera
from glstar.camera.photofile import decode_photo, has_image_signature
from glstar.errors import CalibrationError, ImagesError, reading
from glstar.system.userinput import read_whole

# Digital numbers of 8 or 16 bits.
Grey = NDArray[np.unsignedinteger[Any]]

_SIGNATURE_BYTES = 16
# Largest side of an image that OpenCV's remap accepts, px.
_MOST_PX = 32766
# Types that it interpolates.
_REMAPPED = (np.uint8, np.uint16, np.int16, np.float32, np.float64)
# Rows whose positions are computed together; limits memory.
_BLOCK_ROWS = 256


@dataclass(frozen=True, slots=True, eq=False)
class FittedImage:
    """A real image as large as the simulated one."""

    pixels: Grey  # (height, width) uint8 or uint16: digital numbers, read only; 0 outside of the real image
    left: int  # The part that the real image covers, px: columns left to right - 1, rows top to bottom - 1
    top: int
    right: int
    bottom: int
    note: str = ""  # How the image was scaled, for the user; empty if it was not
    # The largest digital number of its camera, if that is known: see `with_full_scale`.
    full_scale_dn: int | None = None

    @property
    def white_dn(self) -> int:
        """The largest digital number of its camera, or of the file's depth: 255 or 65535."""
        return int(np.iinfo(self.pixels.dtype).max) if self.full_scale_dn is None else self.full_scale_dn

    def with_full_scale(self, full_scale_dn: int) -> Self:
        """Return the image as one of a camera with this full scale, if it may be: 12 bits in a file of 16.

        `full_scale_dn`: the largest digital number of the simulated sensor.  The image is unchanged if it or the sensor
        has 8 bits, or if a pixel exceeds the full scale.
        """
        is_deep = self.pixels.dtype == np.uint16 and full_scale_dn > np.iinfo(np.uint8).max
        return replace(self, full_scale_dn=full_scale_dn) if is_deep and self.pixels.max() <= full_scale_dn else self


def is_image(path: Path) -> bool:
    """Return whether a file begins like an image that glstar reads; raises OSError if it cannot be read."""
    with path.open("rb") as file:
        return has_image_signature(file.read(_SIGNATURE_BYTES))


def read_grey(path: Path) -> Grey:
    """Return an image file as grey digital numbers, as the sensor has them: unrotated, unscaled.

    `path`: any format of `glstar.camera.photofile`.  Returns (height, width) uint8 or uint16: colour becomes grey by
    the value channel of HSV, the largest of red, green and blue.  Raises ImagesError if it cannot be read.  Teague &
    Chahl, section 2.5: the value channel preserves the brightness of a star of any colour.
    """
    with reading(path, ImagesError):
        pixels = decode_photo(read_whole(path)).pixels
    if pixels.ndim == 2:
        return pixels
    blue, green, red = cv2.split(pixels)
    value: Grey = cv2.max(cv2.max(blue, green), red)
    return value


def fit(pixels: Grey, width_px: int, height_px: int) -> FittedImage:
    """Return an image scaled to fit into another size, centred, with its aspect ratio unchanged.

    `pixels` (h, w) uint8 or uint16; `width_px`, `height_px`: the requested size, px.  Scaling aligns the images'
    edges, as binning does, not the centres of their corner pixels.  Shrinking averages over areas, so that no star is
    lost between samples; enlarging is bilinear.
    """
    height, width = pixels.shape
    if (width, height) == (width_px, height_px):
        pixels = np.ascontiguousarray(pixels)
        pixels.flags.writeable = False
        return FittedImage(pixels, 0, 0, width_px, height_px)
    scale = min(width_px / width, height_px / height)
    size = max(1, round(width * scale)), max(1, round(height * scale))
    scaled = cv2.resize(pixels, size, interpolation=cv2.INTER_AREA if scale < 1 else cv2.INTER_LINEAR)
    left, top = (width_px - size[0]) // 2, (height_px - size[1]) // 2
    whole: Grey = np.zeros((height_px, width_px), pixels.dtype)
    whole[top : top + size[1], left : left + size[0]] = scaled
    whole.flags.writeable = False
    note = f"{width} x {height} px, scaled by {scale:.4g} to fit {width_px} x {height_px} px, centred"
    return FittedImage(whole, left, top, left + size[0], top + size[1], note)


def rectify(image: NDArray[Any], camera: Camera) -> tuple[NDArray[Any], Camera]:
    """Return an image as a pinhole would have recorded it, and the pinhole: of the same size and camera matrix.

    `image` is (height, width) or (height, width, channels) of uint8, uint16, int16, float32 or float64; row 0 is the
    top.  The result is zero where the lens has no image; without a lens it is the image itself.  Values are
    interpolated (bicubic): the level of the sky is preserved, and the flux of a star changes with the local
    magnification of the lens; centroids are preserved.  Raises CalibrationError if the image has another size than the
    camera, or its numbers are of another type.  Teague & Chahl, section 2.3.
    """
    if image.shape[:2] != (camera.height_px, camera.width_px):
        raise CalibrationError(
            f"the image is {image.shape[1]} x {image.shape[0]} px and the camera {camera.width_px} x"
            f" {camera.height_px}; rectify images as the camera records them, neither binned nor rotated"
        )
    if image.dtype not in _REMAPPED:
        names = ", ".join(np.dtype(each).name for each in _REMAPPED)
        raise CalibrationError(f"the image holds {image.dtype}; rectify images of {names}")
    pinhole = camera.pinhole
    if camera.lens is None:
        return image, pinhole
    if max(image.shape[:2]) > _MOST_PX:
        raise CalibrationError(f"an image of {image.shape[1]} x {image.shape[0]} px is too large to be rectified")
    from_px = np.empty((camera.height_px, camera.width_px, 2), np.float32)
    for top in range(0, camera.height_px, _BLOCK_ROWS):
        rows, columns = np.mgrid[top : min(top + _BLOCK_ROWS, camera.height_px), : camera.width_px]
        from_px[top : top + _BLOCK_ROWS] = camera.project(pinhole.unit_vectors(np.stack([columns, rows], axis=-1)))
    # Positions without an image are moved far outside of it, where remap returns 0.
    np.nan_to_num(from_px, copy=False, nan=-1e4)
    rectified = cv2.remap(image, from_px, None, cv2.INTER_CUBIC, borderMode=cv2.BORDER_CONSTANT, borderValue=0)
    return np.asarray(rectified), pinhole
