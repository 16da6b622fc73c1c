"""Image files: their size by the header, TIFF directories, FITS, PNG encoding, and copies to the desktop's clipboard.

A PNG of 100 KB can decode to gigabytes, so the size is checked before an image is decoded.  The same greyscale pixels
give the same bytes of PNG on every processor.  GLFW and imgui copy text only.
"""

import os
import re
import shutil
import struct
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import suppress
from itertools import chain
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from numpy.typing import NDArray
from zlib_ng import zlib_ng

from glstar.system.userinput import refuse_many_pixels

_JPEG = b"\xff\xd8"
_TIFF = (b"II*\0", b"MM\0*", b"II+\0", b"MM\0+")
# Beginning of the codestream of a JPEG 2000 and its size: SOC and SIZ.
_CODESTREAM = b"\xff\x4f\xff\x51"
# Longest header of text, bytes.
_TEXT_BYTES = 4096
# TIFF tags of the size, their possible types (SHORT, LONG, LONG8), and the most directory entries that are read.
_TIFF_WIDTH = 256
_TIFF_HEIGHT = 257
_TIFF_INTEGERS = {1: "B", 3: "H", 4: "I", 13: "I", 16: "Q"}
_MOST_TIFF_ENTRIES = 4096
# TIFF tag of directories below another, and the most directories and values of a tag that are read.
_TIFF_SUB_IFDS = 330
MOST_DIRECTORIES = 16
_MOST_TIFF_VALUES = 64
_CARD_BYTES = 80
_FITS_BLOCK_BYTES = 2880
# Keys of the scale of the numbers in a FITS file, with their defaults, and types by the value of BITPIX.
_FITS_SCALE = (("BSCALE", 1.0), ("BZERO", 0.0))
_FITS_TYPES = {"8": ">u1", "16": ">i2", "32": ">i4", "-32": ">f4", "-64": ">f8"}
# JPEG markers that start a frame header (SOF0 to SOF15); C4, C8 and CC in their range mean something else.
_FRAME_HEADERS = frozenset(range(0xC0, 0xD0)) - {0xC4, 0xC8, 0xCC}
# JPEG markers without a length: TEM, RST0 to RST7, SOI.
_BARE_MARKERS = frozenset({0x01, *range(0xD0, 0xD9)})

PNG_SIGNATURE = b"\x89PNG\r\n\x1a\n"

# Fraction of bytes that begin a run of four equal ones from which coding runs makes a smaller file.  Gaussian noise
# around 0 DN has 0.34 at a standard deviation of 0.7 DN (2.03 MB with runs, 1.94 without) and 0.50 at 0.5 DN (1.65 and
# 1.79 MB); around 16 DN with 3 DN, 0.001: 41 ms with runs, 30 without, for the same size.
_RUN_FRACTION = 0.4
_SAMPLED_ROWS = 64

# Time for the system's program to take the image, s.
_TIMEOUT_S = 5.0


def image_size(content: bytes) -> tuple[int, int] | None:
    """Return the width and height, px, that the header of an image file declares for its first image.

    Knows the formats that OpenCV decodes; returns None for other or damaged files.
    """
    try:
        for signature, size_of in _SIZES.items():
            if content.startswith(signature):
                return size_of(content)
    except (struct.error, ValueError, OverflowError):  # an offset of 64 bits may be larger than any file
        pass
    return None


def _bmp_size(content: bytes) -> tuple[int, int]:
    if struct.unpack_from("<I", content, 14) == (12,):  # the header of OS/2
        return struct.unpack_from("<HH", content, 18)
    width, height = struct.unpack_from("<ii", content, 18)
    return abs(width), abs(height)


def _webp_size(content: bytes) -> tuple[int, int] | None:
    """Return the size in the first chunk of a WebP: that of a lossy or lossless image, or of the canvas (RFC 9649)."""
    kind = content[12:16]
    if content[8:12] != b"WEBP" or len(content) < 30:
        return None
    if kind == b"VP8 ":
        width, height = struct.unpack_from("<HH", content, 26)
        return width & 0x3FFF, height & 0x3FFF
    if kind == b"VP8L":
        (bits,) = struct.unpack_from("<I", content, 21)
        return (bits & 0x3FFF) + 1, (bits >> 14 & 0x3FFF) + 1
    if kind == b"VP8X":
        return int.from_bytes(content[24:27], "little") + 1, int.from_bytes(content[27:30], "little") + 1
    return None


def _jpeg2000_size(content: bytes) -> tuple[int, int] | None:
    """Return the size in the codestream of a JPEG 2000: the reference grid without its offset (ISO 15444-1, A.5.1)."""
    at = content.find(_CODESTREAM)
    if at < 0:
        return None
    width, height, left, top = struct.unpack_from(">IIII", content, at + 8)
    return max(width - left, 0), max(height - top, 0)


def _text_size(content: bytes) -> tuple[int, int] | None:
    """Return the size of a portable map, whose header is of numbers between white space and comments."""
    words = re.sub(rb"#[^\n]*", b"", content[:_TEXT_BYTES]).split()
    if words[0] == b"P7":
        return int(words[words.index(b"WIDTH") + 1]), int(words[words.index(b"HEIGHT") + 1])
    return (int(words[1]), int(words[2])) if len(words) > 2 else None


def _radiance_size(content: bytes) -> tuple[int, int] | None:
    found = re.search(rb"\n-Y +(\d{1,9}) +\+X +(\d{1,9})\n", content[:_TEXT_BYTES])
    return None if found is None else (int(found[2]), int(found[1]))


def _png_size(content: bytes) -> tuple[int, int]:
    return struct.unpack_from(">II", content, 16)


def is_whole_png(content: bytes) -> bool:
    """Return whether the chunks of a PNG lie in the file, to the last one: OpenCV takes memory for any stated length.

    Raises ValueError if a frame of an animation is larger than the largest image.
    """
    at = len(PNG_SIGNATURE)
    while at + 8 <= len(content):
        length, kind = struct.unpack_from(">I4s", content, at)
        if at + 12 + length > len(content):
            return False
        if kind == b"IEND":
            return True
        if kind == b"fcTL" and length >= 12:
            refuse_many_pixels(*struct.unpack_from(">II", content, at + 12))
        at += 12 + length
    return False


def _gif_size(content: bytes) -> tuple[int, int]:
    return struct.unpack_from("<HH", content, 6)


def _sun_raster_size(content: bytes) -> tuple[int, int]:
    return struct.unpack_from(">II", content, 4)


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


_SIZES: dict[tuple[bytes, ...], Callable[[bytes], tuple[int, int] | None]] = {
    (PNG_SIGNATURE,): _png_size,
    (_JPEG,): _jpeg_size,
    _TIFF: _tiff_size,
    (b"BM",): _bmp_size,
    (b"RIFF",): _webp_size,
    (b"\0\0\0\x0cjP  ", _CODESTREAM): _jpeg2000_size,
    (b"GIF8",): _gif_size,
    tuple(f"P{kind}".encode() for kind in "1234567fF"): _text_size,
    (b"#?RGBE", b"#?RADIANCE"): _radiance_size,
    (b"\x59\xa6\x6a\x95",): _sun_raster_size,
}


def tiff_directories(content: bytes) -> list[dict[int, tuple[int, ...]]]:
    """Return the directories of a TIFF, those below others included, as integers by tag."""
    found: list[dict[int, tuple[int, ...]]] = []
    order = "<" if content.startswith(b"II") else ">"
    offsets = []
    with suppress(struct.error):  # damaged: the reader of the pixels reports it
        offsets = list(struct.unpack_from(f"{order}I", content, 4))
    while offsets and len(found) < MOST_DIRECTORIES:
        at = offsets.pop(0)
        if not at:
            continue
        with suppress(struct.error, OverflowError):
            (entries,) = struct.unpack_from(f"{order}H", content, at)
            directory: dict[int, tuple[int, ...]] = {}
            for entry in range(at + 2, at + 2 + 12 * entries, 12):
                tag, kind, count, value = struct.unpack_from(f"{order}HHII", content, entry)
                if kind in _TIFF_INTEGERS and count <= _MOST_TIFF_VALUES:
                    layout = f"{order}{count}{_TIFF_INTEGERS[kind]}"
                    inside = struct.calcsize(layout) <= 4
                    directory[tag] = struct.unpack_from(layout, content, entry + 8 if inside else value)
            found.append(directory)
            offsets += directory.get(_TIFF_SUB_IFDS, ())
            offsets += struct.unpack_from(f"{order}I", content, at + 2 + 12 * entries)
    return found


def read_fits(content: bytes) -> NDArray[np.float64]:
    """Return the first image of a FITS file, in physical values, (height, width); row 0 is the top.

    It is in the first header unit, or in an extension if that has no data.  The first row of the file is the top unless
    ROWORDER is BOTTOM-UP.  Raises ValueError if it is damaged, packed in tiles, or no image of one channel.  FITS
    Standard 4.0, sections 3.3 and 3.4 (units), 4.4.2 (BSCALE, BZERO), 5 (data, big-endian) and 10 (tiles).
    """
    if not content.startswith(b"SIMPLE  ="):
        raise ValueError("it is no FITS file")
    cards, begin = _fits_unit(content, 0)
    while cards.get("NAXIS") == "0" and content.startswith(b"XTENSION=", begin):
        cards, begin = _fits_unit(content, begin)
    if cards.get("ZIMAGE") == "T":
        raise ValueError("its image is packed in tiles (.fz); unpack it with funpack, or with astropy")
    dtype = _FITS_TYPES.get(cards.get("BITPIX", ""))
    axes = cards.get("NAXIS", "")
    # A single plane may have further axes.
    sides = [cards.get(key, "") for key in ("NAXIS2", "NAXIS1")]
    is_plane = axes in {"2", "3", "4"} and all(cards.get(f"NAXIS{axis}") == "1" for axis in range(3, int(axes) + 1))
    is_image = "IMAGE" in cards.get("XTENSION", "IMAGE")
    if dtype is None or not is_image or not is_plane or not all(side.isdecimal() for side in sides):
        raise ValueError("its first unit with data is not an image of one channel")
    shape = int(sides[0]), int(sides[1])
    refuse_many_pixels(shape[1], shape[0])
    if not all(shape):
        raise ValueError("its image has no pixels")
    if len(content) - begin < shape[0] * shape[1] * np.dtype(dtype).itemsize:
        raise ValueError("it is cut off")
    stored = np.frombuffer(content, dtype, count=shape[0] * shape[1], offset=begin).reshape(shape)
    if cards.get("ROWORDER", "").strip("' ").upper().replace("_", "-") == "BOTTOM-UP":
        stored = stored[::-1]
    # The standard allows FORTRAN's D for the exponent.
    scale, zero = (_fits_number(cards.get(key, ""), key, default) for key, default in _FITS_SCALE)
    with np.errstate(over="ignore", invalid="ignore"):
        return np.asarray(stored * scale + zero, dtype=np.float64)


def _fits_unit(content: bytes, at: int) -> tuple[dict[str, str], int]:
    """Return the values of the header of the unit at a byte of a FITS file, by keyword, and where its data begin."""
    cards: dict[str, str] = {}
    end = at
    for end in range(at + _CARD_BYTES, len(content), _CARD_BYTES):
        card = content[end - _CARD_BYTES : end].decode("ascii", "replace")
        if card.startswith("END "):
            break
        if card[8:10] == "= ":
            cards[card[:8].strip()] = card[10:].split("/")[0].strip()
    return cards, -(-end // _FITS_BLOCK_BYTES) * _FITS_BLOCK_BYTES


def _fits_number(text: str, key: str, default: float) -> float:
    try:
        return float(text.replace("D", "E") or default)
    except ValueError:
        raise ValueError(f"its {key} is {text[:20]!r}, not a number") from None


def encode_png(pixels: np.ndarray[Any, Any], *, significant_bits: int | None = None) -> bytes:
    """Return an image as the bytes of a PNG file.

    `pixels` (height, width), or (height, width, 3) red, green and blue: uint8 or uint16, 8 or 16 bits per channel in
    the file; `significant_bits`: number of the highest bits that hold the digital number of a greyscale image that is
    shifted up; the file states it (sBIT).

    The noise of a greyscale image has no pattern that a row filter or a string search could find: Huffman coding alone
    makes a file that is a tenth smaller than OpenCV's, in a third of the time.  Images with long runs of equal pixels,
    such as those without noise, are coded with runs.
    """
    if pixels.ndim == 3:
        import cv2  # noqa: PLC0415 - only for colour

        return bytes(cv2.imencode(".png", np.ascontiguousarray(pixels[..., ::-1]))[1])
    height_px, width_px = pixels.shape
    rows = pixels.astype(">u2").view(np.uint8).reshape(height_px, -1) if pixels.dtype == np.uint16 else pixels
    unfiltered = np.empty((height_px, rows.shape[1] + 1), np.uint8)
    unfiltered[:, 0] = 0
    unfiltered[:, 1:] = rows
    strategy = zlib_ng.Z_RLE if _has_runs(rows) else zlib_ng.Z_HUFFMAN_ONLY
    deflate = zlib_ng.compressobj(1, zlib_ng.DEFLATED, zlib_ng.MAX_WBITS, 9, strategy)
    header = struct.pack(">IIBBBBB", width_px, height_px, 8 * pixels.itemsize, 0, 0, 0, 0)  # greyscale
    depth = () if significant_bits is None else ((b"sBIT", bytes((significant_bits,))),)
    chunks = ((b"IHDR", header), *depth, (b"IDAT", deflate.compress(unfiltered), deflate.flush()), (b"IEND",))
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


def copy_png(content: bytes) -> str:
    """Copy a PNG file to the clipboard with a program of the system; return why it could not, or an empty string."""
    if sys.platform in {"win32", "darwin"}:
        with TemporaryDirectory() as folder:
            file = Path(folder) / "picture.png"
            file.write_bytes(content)
            return _run(_from_file(file), b"")
    # These programs stay in the background and serve the image until something else is copied.
    programs = [["xclip", "-selection", "clipboard", "-t", "image/png"]]
    if os.environ.get("WAYLAND_DISPLAY"):
        programs.insert(0, ["wl-copy", "--type", "image/png"])
    for command in programs:
        if shutil.which(command[0]):
            return _run(command, content)
    return "copying a picture needs xclip, or wl-clipboard on Wayland: apt-get install xclip"


def _from_file(file: Path) -> list[str]:
    """Return the command that copies a PNG file on macOS or Windows."""
    if sys.platform == "darwin":
        return ["osascript", "-e", f'set the clipboard to (read (POSIX file "{file}") as «class PNGf»)']
    program = (
        "Add-Type -AssemblyName System.Windows.Forms,System.Drawing;"
        f"[Windows.Forms.Clipboard]::SetImage([Drawing.Image]::FromFile('{file}'))"
    )
    return ["powershell", "-NoProfile", "-STA", "-Command", program]


def _run(command: list[str], content: bytes) -> str:
    """Run a command with an image as its input; return why it failed, or an empty string."""
    try:
        # No pipes for its output: the program that serves the image would keep them open.
        process = subprocess.run(  # noqa: S603 - fixed programs
            command,
            input=content,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            timeout=_TIMEOUT_S,
            check=False,
        )
    except (OSError, subprocess.TimeoutExpired) as error:
        return f"the picture could not be copied: {error}"
    if process.returncode != 0:
        return f"the picture could not be copied: {command[0]} ended with {process.returncode}"
    return ""
