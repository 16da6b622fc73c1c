"""Alignment of digital numbers of fewer than 16 bits within the 16 bits of a file's pixels."""

import struct
from contextlib import suppress
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

__all__ = ["MAX_SAMPLE_VALUE", "as_digital_numbers", "shift_bits", "stated_shift_bits"]

# Tag of TIFF 6.0 with the largest value that a pixel can have.
MAX_SAMPLE_VALUE: Final = 281
_FILE_BITS: Final = 16
_PNG: Final = b"\x89PNG\r\n\x1a\n"
_TIFF: Final = (b"II*\0", b"MM\0*")
_TIFF_SHORT: Final = 3


def shift_bits(full_scale_dn: int) -> int:
    """Return by how many bits digital numbers are shifted up to fill the pixels of a file.

    Parameters
    ----------
    full_scale_dn : int
        The largest digital number.

    Returns
    -------
    int
        4 for 12 bits in 16; 0 if 8 bits hold the numbers.
    """
    bits = int(full_scale_dn).bit_length()
    return 0 if bits <= 8 else _FILE_BITS - bits


def stated_shift_bits(content: bytes) -> int:
    """Return by how many bits an image file says that its digital numbers are shifted up.

    Parameters
    ----------
    content : bytes
        A PNG or TIFF of one channel; 0 for other files.

    Returns
    -------
    int
        0 to 15.

    Notes
    -----
    PNG specification, third edition, section 11.3.2.7 (sBIT); TIFF 6.0, section 8 (MaxSampleValue).
    """
    if content.startswith(_PNG):
        return _shift_of_png(content)
    return _shift_of_tiff(content) if content.startswith(_TIFF) else 0


def as_digital_numbers(pixels: NDArray[Any], shift: int) -> NDArray[Any]:
    """Return digital numbers that a file has shifted up.

    Parameters
    ----------
    pixels : (height, width) array
    shift : int
        From `stated_shift_bits`.

    Returns
    -------
    (height, width) array
        The same pixels if they are not of 16 bits, or if some have bits below the shift: a file of another program may
        state its significant bits and leave the numbers where they are.
    """
    if not shift or pixels.dtype != np.uint16 or pixels.ndim != 2 or (pixels & ((1 << shift) - 1)).any():
        return pixels
    return pixels >> np.uint16(shift)


def _shift_of_png(content: bytes) -> int:
    at = len(_PNG)
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
