"""Decoding of image files to grey digital numbers, and scaling to the size of the simulated image."""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Self

import cv2
import numpy as np
from numpy.typing import NDArray

from glstar.camera.photofile import decode_photo, has_image_signature
from glstar.errors import ImagesError

# Digital numbers of 8 or 16 bits.
Grey = NDArray[np.unsignedinteger[Any]]

_SIGNATURE_BYTES = 16


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
    try:
        pixels = decode_photo(path.read_bytes()).pixels
    except OSError as error:
        raise ImagesError(path, f"cannot be read: {error.strerror or error}") from error
    except ValueError as error:
        raise ImagesError(path, str(error)) from error
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
