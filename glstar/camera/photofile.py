"""Photographs in formats that OpenCV does not read (DNG, HEIC and FITS), and numbers shifted up within 16 bits."""

import re
import struct
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from io import BytesIO
from typing import Any

import numpy as np
from numpy.typing import NDArray

from glstar.camera.sensor.pixelpattern import read_fits
from glstar.system.imagefiles import MAX_MEGAPIXELS, PNG_SIGNATURE
from glstar.system.installation import install_command

_FITS = b"SIMPLE  ="
_TIFF = (b"II*\0", b"MM\0*")
# The tag DNGVersion as an entry of a TIFF directory, of either byte order, and where the directory may lie.
_DNG_TAGS = (b"\x12\xc6\x01\x00\x04\x00\x00\x00", b"\xc6\x12\x00\x01\x00\x00\x00\x04")
_HEAD_BYTES = 1 << 16
_HEIF_BRANDS = (b"heic", b"heix", b"hevc", b"heim", b"heis", b"mif1", b"msf1", b"avif")
# First bytes of the other formats that OpenCV reads.
_PORTABLE_MAPS = tuple(f"P{kind}".encode() for kind in "1234567fF")
_SIGNATURES = (
    b"\x89PNG",
    b"\xff\xd8\xff",  # JPEG
    b"BM",
    b"GIF8",
    b"\0\0\0\x0cjP  ",  # JPEG 2000
    b"\xff\x4f\xff\x51",
    b"\x76\x2f\x31\x01",  # OpenEXR
    b"#?RGBE",
    b"#?RADIANCE",
    b"\x59\xa6\x6a\x95",  # Sun raster
    b"II+\0",  # BigTIFF
    b"MM\0+",
    *_PORTABLE_MAPS,
)
_LARGEST_DN = 65535
# Stored numbers to a digital number of 15 to 9 bits that is in the highest of 16.
_LEFT_ALIGNED = frozenset(2.0**shift for shift in range(1, 8))
# LibRaw's number of a rotation, and the quarter turns to the left that make the image upright.
_QUARTER_TURNS = {3: 2, 5: 1, 6: 3}


@dataclass(frozen=True, slots=True, eq=False)
class PhotoPixels:
    """The content of a photograph."""

    # (height, width) or (height, width, 3) uint8 or uint16: grey, or blue, green and red, as OpenCV has them.
    pixels: NDArray[Any]
    white_dn: int | None = None  # The digital number at which the camera saturates; None if the file does not say so
    exif: bytes = b""  # EXIF as a TIFF file has it, if it does not begin the file itself; empty if there is none


def has_image_signature(start: bytes) -> bool:
    """Return whether the first 16 bytes of a file, or more, are those of an image format that glstar reads."""
    is_webp = start.startswith(b"RIFF") and start[8:12] == b"WEBP"
    return start.startswith((*_SIGNATURES, *_TIFF, _FITS)) or is_webp or _is_heif(start)


def decode_photo(content: bytes, *, demosaiced: bool = True, upright: bool = False) -> PhotoPixels | None:
    """Return the pixels of a DNG, HEIC or FITS file; None for a file of another kind.

    `demosaiced` turns a DNG's mosaic into a colour image, by bilinear interpolation of its digital numbers; black level
    and white balance stay as they are.  `upright` rotates a DNG as it says that it was taken.  Raises ValueError if the
    file is damaged or too large, or the library that reads it is not installed; the message continues "FILE: ".
    """
    if content.startswith(_FITS):
        return PhotoPixels(_decoded_fits(content), _white_dn_of_fits(content))
    if content.startswith(_TIFF) and any(tag in content[:_HEAD_BYTES] for tag in _DNG_TAGS):
        return _decoded_dng(content, demosaiced=demosaiced, upright=upright)
    if _is_heif(content):
        return _decoded_heif(content)
    return None


def _is_heif(start: bytes) -> bool:
    return start[4:8] == b"ftyp" and start[8:12] in _HEIF_BRANDS


def _decoded_fits(content: bytes) -> NDArray[np.uint16]:
    """Return the whole numbers of a FITS file's first image."""
    try:
        pixels = read_fits(content)
    except ValueError as error:
        raise ValueError(f"is no image that can be read: {error}") from error
    if pixels.min() < 0 or pixels.max() > _LARGEST_DN or (pixels != np.rint(pixels)).any():
        raise ValueError(
            f"holds numbers from {pixels.min():g} to {pixels.max():g}; glstar needs a camera's own, whole and from 0 to"
            f" {_LARGEST_DN}"
        )
    return pixels.astype(np.uint16)


def _white_dn_of_fits(content: bytes) -> int | None:
    """Return the largest digital number of a file whose numbers are in the highest of 16 bits; None of another."""
    scale = re.search(rb"BSCALE  = +([0-9.]+)", content[:_HEAD_BYTES])
    per_dn = 1 / float(scale[1]) if scale is not None and float(scale[1]) else 1.0
    return (_LARGEST_DN + 1) // int(per_dn) - 1 if per_dn in _LEFT_ALIGNED else None


def _decoded_dng(content: bytes, *, demosaiced: bool, upright: bool) -> PhotoPixels:
    try:
        import rawpy  # noqa: PLC0415 - an extra, only when a DNG is read
    except ImportError as error:
        raise ValueError(f"is a DNG, which needs rawpy: {install_command('raw')}") from error
    try:
        with rawpy.imread(BytesIO(content)) as raw:
            _refuse_large(raw.sizes.raw_width, raw.sizes.raw_height)
            mosaic = np.array(raw.raw_image_visible)
            white_dn = int(raw.white_level)
            quarters = _QUARTER_TURNS.get(raw.sizes.flip, 0) if upright else 0
            pattern = "".join(raw.color_desc.decode()[int(colour)] for colour in np.asarray(raw.raw_pattern).ravel())
    except rawpy.LibRawError as error:
        raise ValueError(f"is a DNG that cannot be decoded ({error})") from error
    if mosaic.ndim != 2 or mosaic.dtype != np.uint16:
        raise ValueError("is a DNG without the camera's own numbers; glstar reads raw mosaics of up to 16 bits")
    if demosaiced and len(set(pattern)) > 1:
        mosaic = _bilinear(mosaic, pattern)
    return PhotoPixels(np.ascontiguousarray(np.rot90(mosaic, quarters)), white_dn)


def _bilinear(mosaic: NDArray[np.uint16], pattern: str) -> NDArray[np.uint16]:
    """Return a mosaic as blue, green and red."""
    import cv2  # noqa: PLC0415 - cv2, only when a raw image is read

    codes = {
        "RGGB": cv2.COLOR_BayerRGGB2BGR,
        "BGGR": cv2.COLOR_BayerBGGR2BGR,
        "GRBG": cv2.COLOR_BayerGRBG2BGR,
        "GBRG": cv2.COLOR_BayerGBRG2BGR,
    }
    if pattern not in codes:
        raise ValueError(f"is a DNG with the mosaic {pattern or '?'}; glstar reads RGGB, BGGR, GRBG and GBRG")
    return np.asarray(cv2.cvtColor(mosaic, codes[pattern]), dtype=np.uint16)


def _decoded_heif(content: bytes) -> PhotoPixels:
    try:
        import pillow_heif  # noqa: PLC0415 - an extra, only when a HEIC is read
    except ImportError as error:
        raise ValueError(f"is a HEIC image, which needs pillow-heif: {install_command('heic')}") from error
    with _damage_of_heic_explained():
        image = pillow_heif.open_heif(BytesIO(content), convert_hdr_to_8bit=False, bgr_mode=True)
    _refuse_large(*image.size)
    with _damage_of_heic_explained():
        pixels = np.asarray(image)
    bits = int(image.info.get("bit_depth", 8))
    if pixels.dtype == np.uint16:  # pillow-heif moves the bits of deeper images to the top of 16
        pixels = pixels >> (16 - bits)
    exif = (image.info.get("exif") or b"").removeprefix(b"Exif\0\0")
    return PhotoPixels(np.ascontiguousarray(pixels if pixels.ndim == 2 else pixels[..., :3]), 2**bits - 1, exif)


@contextmanager
def _damage_of_heic_explained() -> Iterator[None]:
    try:
        yield
    except (OSError, RuntimeError, EOFError, SyntaxError, ValueError) as error:
        raise ValueError(f"is a HEIC image that cannot be decoded ({error})") from error


def _refuse_large(width_px: int, height_px: int) -> None:
    if width_px * height_px > MAX_MEGAPIXELS * 1e6:
        raise ValueError(f"has {width_px} x {height_px} px; glstar reads up to {MAX_MEGAPIXELS} megapixels")


# Tag of TIFF 6.0 with the largest value that a pixel can have.
MAX_SAMPLE_VALUE = 281
_FILE_BITS = 16
_TIFF_SHORT = 3


def shift_bits(full_scale_dn: int) -> int:
    """Return by how many bits digital numbers are shifted up to fill the pixels of a file.

    It is 4 for 12 bits in 16, and 0 if 8 bits hold the largest number.
    """
    bits = int(full_scale_dn).bit_length()
    return 0 if bits <= 8 else _FILE_BITS - bits


def stated_shift_bits(content: bytes) -> int:
    """Return by how many bits, 0 to 15, a PNG or TIFF says that its digital numbers are shifted up; 0 for other files.

    PNG specification, third edition, section 11.3.2.7 (sBIT); TIFF 6.0, section 8 (MaxSampleValue).
    """
    if content.startswith(PNG_SIGNATURE):
        return _shift_of_png(content)
    return _shift_of_tiff(content) if content.startswith(_TIFF) else 0


def as_digital_numbers(pixels: NDArray[Any], shift: int) -> NDArray[Any]:
    """Return the digital numbers, (height, width), that a file has shifted up by `stated_shift_bits`.

    Pixels stay if they are not of 16 bits, or if some have bits below the shift: a file of another program may state
    its significant bits and leave the numbers where they are.
    """
    if not shift or pixels.dtype != np.uint16 or pixels.ndim != 2 or (pixels & ((1 << shift) - 1)).any():
        return pixels
    return pixels >> np.uint16(shift)


def _shift_of_png(content: bytes) -> int:
    at = len(PNG_SIGNATURE)
    while at + 8 <= len(content):
        (length,) = struct.unpack_from(">I", content, at)
        kind, data = content[at + 4 : at + 8], content[at + 8 : at + 8 + length]
        if kind == b"IDAT":
            return 0
        if kind == b"sBIT" and length == 1 and data:
            return max(_FILE_BITS - data[0], 0) if data[0] else 0
        at += 12 + length
    return 0


def _shift_of_tiff(content: bytes) -> int:
    largest = 0
    order = "<" if content.startswith(b"II") else ">"
    with suppress(struct.error):  # damaged: the reader of the pixels reports it
        (directory,) = struct.unpack_from(f"{order}I", content, 4)
        (entries,) = struct.unpack_from(f"{order}H", content, directory)
        for entry in range(entries):
            tag, kind, _, value = struct.unpack_from(f"{order}HHIH", content, directory + 2 + 12 * entry)
            if (tag, kind) == (MAX_SAMPLE_VALUE, _TIFF_SHORT):
                largest = value
    # A run of ones that ends at the highest of 16 bits.
    shift = (largest & -largest).bit_length() - 1
    return shift if largest and largest == (0xFFFF >> shift) << shift else 0
