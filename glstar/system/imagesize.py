"""The size of an image, read from the header of its file.

A PNG of 100 KB can decode to gigabytes, so the size is checked before an image is decoded.
"""

import struct
from typing import Final

__all__ = ["MAX_MEGAPIXELS", "image_size", "size_error"]

# Largest image that is decoded, megapixels: more than any current sensor (150), and calibration of it takes 16 GB.
MAX_MEGAPIXELS: Final = 200

_PNG: Final = b"\x89PNG\r\n\x1a\n"
_JPEG: Final = b"\xff\xd8"
_TIFF: Final = (b"II*\0", b"MM\0*", b"II+\0", b"MM\0+")
_BMP: Final = b"BM"
# TIFF tags of the size, their possible types (SHORT, LONG, LONG8), and the most directory entries that are read.
_TIFF_WIDTH: Final = 256
_TIFF_HEIGHT: Final = 257
_TIFF_INTEGERS: Final = {3: "H", 4: "I", 16: "Q"}
_MOST_TIFF_ENTRIES: Final = 4096
# JPEG markers that start a frame header (SOF0 to SOF15); C4, C8 and CC in their range mean something else.
_FRAME_HEADERS: Final = frozenset(range(0xC0, 0xD0)) - {0xC4, 0xC8, 0xCC}
# JPEG markers without a length: TEM, RST0 to RST7, SOI.
_BARE_MARKERS: Final = frozenset({0x01, *range(0xD0, 0xD9)})


def image_size(content: bytes) -> tuple[int, int] | None:
    """Return the width and height that an image file's header declares.

    Parameters
    ----------
    content : bytes
        The whole file.

    Returns
    -------
    tuple of int, or None
        Width and height, px, of the first image; None if it is no PNG, JPEG, TIFF or BMP, or the header is damaged.
    """
    try:
        if content.startswith(_PNG):
            return struct.unpack_from(">II", content, 16)
        if content.startswith(_JPEG):
            return _jpeg_size(content)
        if content.startswith(_TIFF):
            return _tiff_size(content)
        if content.startswith(_BMP):
            width, height = struct.unpack_from("<ii", content, 18)
            return abs(width), abs(height)
    except struct.error:
        pass
    return None


def size_error(content: bytes) -> str | None:
    """Return why an image file is too large to decode.

    Parameters
    ----------
    content : bytes
        The whole file.

    Returns
    -------
    str or None
        A message without the file's name; None if the image may be decoded.
    """
    size = image_size(content)
    if size is None or size[0] * size[1] <= MAX_MEGAPIXELS * 1_000_000:
        return None
    width, height = size
    return (
        f"is {width} x {height} px, {width * height / 1e6:.0f} megapixels; glstar reads images of up to"
        f" {MAX_MEGAPIXELS} megapixels: crop or bin it"
    )


def _jpeg_size(content: bytes) -> tuple[int, int] | None:
    at = 2
    while at + 4 <= len(content):
        if content[at] != 0xFF:
            return None
        marker = content[at + 1]
        if marker == 0xFF:  # a fill byte
            at += 1
        elif marker in _BARE_MARKERS:
            at += 2
        elif marker in _FRAME_HEADERS:
            height, width = struct.unpack_from(">HH", content, at + 5)
            return width, height
        else:
            at += 2 + int(struct.unpack_from(">H", content, at + 2)[0])
    return None


def _tiff_size(content: bytes) -> tuple[int, int] | None:
    order = "<" if content.startswith(b"II") else ">"
    big = content[2:4] in (b"+\0", b"\0+")
    # A directory is a count and its entries: tag, type, number of values, and a single value in place.
    (first,) = struct.unpack_from(order + ("Q" if big else "I"), content, 8 if big else 4)
    (count,) = struct.unpack_from(order + ("Q" if big else "H"), content, first)
    at, step, value_at = (first + 8, 20, 12) if big else (first + 2, 12, 8)
    sides: dict[int, int] = {}
    for entry in range(at, at + step * min(count, _MOST_TIFF_ENTRIES), step):
        tag, kind = struct.unpack_from(order + "HH", content, entry)
        if tag in (_TIFF_WIDTH, _TIFF_HEIGHT) and kind in _TIFF_INTEGERS:
            (sides[tag],) = struct.unpack_from(order + _TIFF_INTEGERS[kind], content, entry + value_at)
    return (sides[_TIFF_WIDTH], sides[_TIFF_HEIGHT]) if len(sides) == 2 else None
