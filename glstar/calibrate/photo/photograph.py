"""Photographs, read as one channel of digital numbers."""

import re
from contextlib import suppress
from dataclasses import dataclass, field, replace
from math import nan
from os import PathLike
from pathlib import Path
from typing import Any, Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from glstar.camera.photofile import Exif, as_digital_numbers, decode_photo
from glstar.camera.sensor.tonecurve import GAMMAS, light_before, recorded_by
from glstar.errors import CalibrationError, ConfigError, reading
from glstar.system.imagefiles import encode_png
from glstar.system.userinput import read_whole

Channel = Literal["value", "red", "green", "blue", "mean"]

_DEPTHS = (8, 10, 12, 14, 16)
# OpenCV's order.
_PLANE: dict[str, int] = {"blue": 0, "green": 1, "red": 2}
_HEADER_BYTES = 64 * 1024
# First characters of a FITS file, and its exposure, s.
_FITS_BEGIN = b"SIMPLE  ="
_FITS_EXPOSURE = re.compile(rb"(?:EXPTIME |EXPOSURE)= +([0-9.]+(?:[eEdD][-+]?[0-9]+)?)")

# Smallest side of an image of stars.
_LEAST_SIDE_PX = 32


@dataclass(frozen=True, slots=True, eq=False)
class Photograph:
    """A photograph of the sky."""

    path: Path
    pixels_dn: NDArray[np.float64]  # (height, width) digital numbers, as the sensor read them; row 0 is the top
    bit_depth: int  # Bits of a digital number: it saturates at 2**bit_depth - 1
    # {"value", "red", "green", "blue", "mean", "grey"}: the colour channel; ``"grey"`` for a monochrome image.
    channel: str
    exposure_s: float | None  # Exposure stated in the file, s
    # The tone curve of the file, if `pixels_dn` are the light before it: see `linearised`.
    gamma: str | float = "linear"
    recorded_bits: int = 8  # Bits of the file, if it has a tone curve
    notes: tuple[str, ...] = ()  # How the file was read, for the user
    exif: Exif = field(default_factory=Exif)  # Its own time and place

    @property
    def output_keys(self) -> dict[str, str | float | bool]:
        """The keys of ``[output]`` with which a simulated camera processes images as the photograph's camera did."""
        if self.gamma == "linear":
            return {}
        return {"output.process": "isp", "output.subtract_black": False, "output.gamma": self.gamma}

    @property
    def saturation_dn(self) -> int:
        """The largest digital number of its bit depth."""
        return int(2**self.bit_depth - 1)


def read_image(
    path: str | PathLike[str], *, channel: Channel = "value", bit_depth: int | None = None, demosaiced: bool = True
) -> Photograph:
    """Return an image as one channel, as the sensor read it.

    The file is of any format of `glstar.camera.photofile`.  `channel` of a colour image: ``"value"`` is the V
    of HSV, the brightest of the three (Teague & Chahl, section 2.5).  `bit_depth` is that of the converter if it is
    smaller than that of the file: 12 for a raw image in 16 bits, whether its numbers are in the lowest bits or,
    left-aligned, in the highest.  Its default is 8, or for a 16-bit file the depth that its empty bits prove or whose
    largest number occurs in the image, else 16.  A raw file states it, and so does a grey PNG, TIFF or FITS file whose
    numbers are shifted up to the highest bits.  `demosaiced`: whether a raw mosaic becomes a colour image.  Raises
    CalibrationError if the file cannot be read, is cut off, is too large
    (`glstar.system.userinput.LIMITS`), or is no photograph.
    """
    path = Path(path)
    with reading(path, CalibrationError):
        content = read_whole(path)
        photo = decode_photo(content, demosaiced=demosaiced)
    pixels, white_dn = photo.pixels, photo.white_dn
    grey, name = _one_channel(pixels, channel)
    if min(grey.shape) < _LEAST_SIDE_PX:
        message = f"is an image of {grey.shape[1]} x {grey.shape[0]} px; a star field needs {_LEAST_SIDE_PX} or more"
        raise CalibrationError(message, path=path)
    stated = _depth_of(pixels) if white_dn is None else white_dn.bit_length()
    depth = stated if bit_depth is None else bit_depth
    if bit_depth is not None and grey.max() > 2**depth - 1:
        grey = as_digital_numbers(grey, 16 - depth)
    if grey.max() > 2**depth - 1:
        message = f"holds the number {grey.max():g}, which {depth} bits cannot; leave out --bit-depth or set it higher"
        raise CalibrationError(message, path=path)
    exposure_s = _exposure_of_fits(content) if content.startswith(_FITS_BEGIN) else photo.exif.exposure_s
    return Photograph(path, grey.astype(np.float64), depth, name, exposure_s, notes=photo.notes, exif=photo.exif)


def _one_channel(pixels: NDArray[Any], channel: Channel) -> tuple[NDArray[Any], str]:
    if pixels.ndim == 2:
        return pixels, "grey"
    colours = pixels[..., :3]
    if channel == "value":
        return colours.max(axis=-1), channel
    if channel == "mean":
        return colours.mean(axis=-1), channel
    return colours[..., _PLANE[channel]], channel


def _depth_of(pixels: NDArray[Any]) -> int:
    if pixels.dtype == np.uint8:
        return 8
    return next((depth for depth in _DEPTHS if int(pixels.max()) == 2**depth - 1), 16)


def _exposure_of_fits(content: bytes) -> float | None:
    """Return the exposure that the header of a FITS file states, s, or None."""
    exposure = _FITS_EXPOSURE.search(content[:_HEADER_BYTES])
    with suppress(ValueError):  # 1.2.3
        # The standard allows FORTRAN's D for the exponent.
        return (float(exposure[1].upper().replace(b"D", b"E")) or None) if exposure else None
    return None


# Bits of a photograph's light: fine enough for the steps of 8 recorded bits.
_LIGHT_BITS = 16


def linearised(image: Photograph, gamma: str | float) -> Photograph:
    """Return the light of a photograph that a tone curve has processed.

    `image`: as recorded; `gamma`: as in ``[output] gamma``: ``"srgb"``, ``"rpi"``, or g for a recorded value that grows
    as the light to the power of 1 / g; ``"linear"`` changes nothing.  The light has 16 bits.  Raises ConfigError if
    there is no such curve.
    """
    if gamma == "linear":
        return image
    curve = _checked_gamma(gamma)
    light = light_before(image.pixels_dn / image.saturation_dn, curve)
    return replace(
        image, pixels_dn=light * (2**_LIGHT_BITS - 1), bit_depth=_LIGHT_BITS, recorded_bits=image.bit_depth, gamma=curve
    )


def recorded_again(image: Photograph, pixels: NDArray[Any]) -> NDArray[Any]:
    """Return raw pixels as the camera of a photograph records them.

    `pixels` (height, width) uint8 or uint16: raw, with the bits of `image`.  Returns (height, width) uint8 or uint16:
    processed with its tone curve, with the bits of its file.
    """
    if image.gamma == "linear":
        return pixels
    recorded = recorded_by(pixels / image.saturation_dn, image.gamma)
    return np.asarray(recorded * (2**image.recorded_bits - 1) + 0.5).astype(
        np.uint16 if image.recorded_bits > 8 else np.uint8
    )


def _checked_gamma(gamma: str | float) -> str | float:
    """Return the name of a tone curve, or a number."""
    if gamma in GAMMAS:
        return gamma
    try:
        number = float(gamma)
    except ValueError:
        number = nan
    if not 0.1 <= number <= 10:
        raise ConfigError(f"--gamma is {', '.join(GAMMAS)}, fit, or a number from 0.1 to 10, not {gamma!r}")
    return number


def encoded_image(suffix: str, pixels: NDArray[Any]) -> bytes:
    """Return the content of an image file; `suffix`: that of its format, such as ``.png``."""
    if suffix == ".png" and pixels.ndim == 2 and pixels.dtype in (np.uint8, np.uint16):
        return encode_png(pixels)
    _, content = cv2.imencode(suffix, pixels)
    return content.tobytes()
