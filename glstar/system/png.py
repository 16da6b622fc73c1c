"""Greyscale PNG files: the same pixels give the same bytes on every processor."""

import struct
from collections.abc import Iterator
from itertools import chain
from typing import Any, Final

import numpy as np
from zlib_ng import zlib_ng

__all__ = ["PNG_SIGNATURE", "encode_png"]

PNG_SIGNATURE: Final = b"\x89PNG\r\n\x1a\n"

# Fraction of bytes that begin a run of four equal ones from which coding runs makes a smaller file.  Gaussian noise
# around 0 DN has 0.34 at a standard deviation of 0.7 DN (2.03 MB with runs, 1.94 without) and 0.50 at 0.5 DN (1.65 and
# 1.79 MB); around 16 DN with 3 DN, 0.001: 41 ms with runs, 30 without, for the same size.
_RUN_FRACTION: Final = 0.4
_SAMPLED_ROWS: Final = 64


def encode_png(pixels: np.ndarray[Any, Any], *, significant_bits: int | None = None) -> bytes:
    """Return an image as the bytes of a greyscale PNG file.

    Parameters
    ----------
    pixels : (height, width) uint8 or uint16
        Digital numbers; 8 or 16 bits per pixel in the file.
    significant_bits : int, optional
        Number of the highest bits that have the digital number, if it is shifted up; the file states it (sBIT).

    Returns
    -------
    bytes

    Notes
    -----
    Noise has no pattern that a row filter or a string search could find: Huffman coding alone makes a file that is a
    tenth smaller than OpenCV's, in a third of the time.  Images with long runs of equal pixels, such as those without
    noise, are coded with runs.
    """
    height_px, width_px = pixels.shape
    rows = pixels.astype(">u2").view(np.uint8).reshape(height_px, -1) if pixels.dtype == np.uint16 else pixels
    unfiltered = np.empty((height_px, rows.shape[1] + 1), np.uint8)
    unfiltered[:, 0] = 0
    unfiltered[:, 1:] = rows
    strategy = zlib_ng.Z_RLE if _has_runs(rows) else zlib_ng.Z_HUFFMAN_ONLY
    deflate = zlib_ng.compressobj(1, zlib_ng.DEFLATED, zlib_ng.MAX_WBITS, 9, strategy)
    header = struct.pack(">IIBBBBB", width_px, height_px, 8 * pixels.itemsize, 0, 0, 0, 0)  # greyscale
    stated = () if significant_bits is None else ((b"sBIT", bytes((significant_bits,))),)
    chunks = ((b"IHDR", header), *stated, (b"IDAT", deflate.compress(unfiltered), deflate.flush()), (b"IEND",))
    # Joined once at the end: a large image is several megabytes, and copying it holds up other threads.
    return b"".join(chain([PNG_SIGNATURE], *(_chunk(*chunk) for chunk in chunks)))


def _has_runs(rows: np.ndarray[Any, Any]) -> bool:
    """Return whether runs of equal bytes are frequent in a sample of rows."""
    sample = rows[:: max(1, len(rows) // _SAMPLED_ROWS)]
    equal = sample[:, 1:] == sample[:, :-1]
    runs = equal[:, 2:] & equal[:, 1:-1] & equal[:, :-2]
    return bool(runs.size and np.count_nonzero(runs) >= _RUN_FRACTION * runs.size)


def _chunk(kind: bytes, *content: bytes) -> Iterator[bytes]:
    """Yield the parts of a PNG chunk: length, type, content, CRC-32 of type and content."""
    yield struct.pack(">I", sum(map(len, content)))
    checksum = 0
    for part in (kind, *content):
        yield part
        checksum = zlib_ng.crc32(part, checksum)
    yield struct.pack(">I", checksum)
