"""Decoding of image files to grey digital numbers, and scaling to the size of the simulated image."""

from dataclasses import dataclass, replace
from io import BytesIO
from pathlib import Path
from typing import Any, Self

import cv2
import numpy as np
import tifffile
from numpy.typing import NDArray

from glstar.camera.photofile import as_digital_numbers, decode_photo, has_image_signature, stated_shift_bits
from glstar.errors import ImagesError
from glstar.system.imagefiles import size_error

# Digital numbers of 8 or 16 bits.
Grey = NDArray[np.unsignedinteger[Any]]

_JPEG = b"\xff\xd8\xff"
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

    `path`: PNG, JPEG, TIFF or another format that OpenCV or tifffile reads, of 8 or 16 bits; DNG; HEIC; FITS of one
    channel.  Returns (height, width) uint8 or uint16: colour becomes grey by the value channel of HSV, the largest of
    red, green and blue; numbers that a grey PNG or TIFF states to be shifted up (``[output] align``) are shifted
    back.  Raises ImagesError if it cannot be read, is cut off, is larger than
    `glstar.system.imagefiles.MAX_MEGAPIXELS`, or holds other numbers.  Teague & Chahl, section 2.5: the value channel
    preserves the brightness of a star of any colour.
    """
    try:
        content = path.read_bytes()
    except OSError as error:
        raise ImagesError(path, f"cannot be read: {error.strerror or error}") from error
    if content.startswith(_JPEG) and _is_cut_off(content):
        raise ImagesError(path, "is a JPEG that is cut off")
    too_large = size_error(content)
    if too_large is not None:
        raise ImagesError(path, too_large)
    try:
        photo = decode_photo(content)
    except ValueError as error:
        raise ImagesError(path, str(error)) from error
    pixels = _decoded(content) if photo is None else photo.pixels
    if pixels is None:
        raise ImagesError(path, "is broken, or of a kind that glstar does not read")
    if pixels.dtype not in (np.uint8, np.uint16) or pixels.ndim not in (2, 3):
        raise ImagesError(
            path,
            f"holds {pixels.dtype} in {pixels.ndim} axes; only grey or colour images of 8 or 16 bits are supported",
        )
    if pixels.ndim == 2:
        return as_digital_numbers(pixels, stated_shift_bits(content))
    # Two or four channels: the last one is opacity, not light.
    colours = cv2.split(pixels)[: pixels.shape[2] - (pixels.shape[2] in (2, 4))]
    value: Grey = colours[0]
    for colour in colours[1:]:
        value = cv2.max(value, colour)
    return value


def _is_cut_off(jpeg: bytes) -> bool:
    """Return whether the last scan of a JPEG has no end; some decoders silently fill the rest with grey."""
    end, scan = b"\xff\xd9", b"\xff\xda"
    # Usually nothing follows the end marker, and a search through megabytes is unnecessary.
    return end not in jpeg[-64:] and jpeg.rfind(end) < jpeg.rfind(scan)


def _decoded(content: bytes) -> NDArray[Any] | None:
    """Return pixels as (height, width) or (height, width, channels), or None if no library can read them."""
    if content[:2] in (b"II", b"MM"):
        # tifffile first: OpenCV mixes up the channels of planar images.
        try:
            with tifffile.TiffFile(BytesIO(content)) as tiff:
                page = tiff.pages.first
                pixels: NDArray[Any] = page.asarray()
                return np.moveaxis(pixels, 0, -1) if page.axes == "SYX" else pixels
        except Exception:  # noqa: S110 - unsupported compression or damage: OpenCV is tried next
            pass
    try:
        image: NDArray[Any] | None = cv2.imdecode(np.frombuffer(content, np.uint8), cv2.IMREAD_UNCHANGED)
    except cv2.error:
        return None
    return image


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
