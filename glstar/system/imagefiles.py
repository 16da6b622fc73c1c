"""Image files: their size by the header, TIFF directories, FITS, PNG encoding, and copies to the desktop's clipboard.

A PNG of 100 KB can decode to gigabytes, so the size is checked before an image is decoded.  The same greyscale pixels
give the same bytes of PNG on every processor.  GLFW and imgui copy text only.
"""

import os
import shutil
import struct
import subprocess
import sys
from collections.abc import Iterator
from contextlib import suppress
from itertools import chain
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from numpy.typing import NDArray
from zlib_ng import zlib_ng

# Largest image that is decoded, megapixels: more than any current sensor (150), and calibration of it takes 16 GB.
MAX_MEGAPIXELS = 200

_JPEG = b"\xff\xd8"
_TIFF = (b"II*\0", b"MM\0*", b"II+\0", b"MM\0+")
_BMP = b"BM"
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
    """Return the width and height, px, that the header of a PNG, JPEG, TIFF or BMP file declares for its first image.

    Returns None for other or damaged files.
    """
    try:
        if content.startswith(PNG_SIGNATURE):
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
    """Return why an image file is too large to decode, without its name; None if it may be decoded."""
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
        with suppress(struct.error):
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
    """Return the image of the first header unit of a FITS file, in physical values, (height, width); row 0 is the top.

    The first row of the file is the top unless ROWORDER is BOTTOM-UP.  Raises ValueError if it is damaged, or no image
    of one channel.  FITS Standard 4.0, sections 3.3 (header), 4.4.2 (BSCALE, BZERO) and 5 (data, big-endian).
    """
    if not content.startswith(b"SIMPLE  ="):
        raise ValueError("it is no FITS file")
    cards: dict[str, str] = {}
    end = 0
    for end in range(_CARD_BYTES, len(content), _CARD_BYTES):
        card = content[end - _CARD_BYTES : end].decode("ascii", "replace")
        if card.startswith("END "):
            break
        if card[8:10] == "= ":
            cards[card[:8].strip()] = card[10:].split("/")[0].strip()
    dtype = _FITS_TYPES.get(cards.get("BITPIX", ""))
    axes = cards.get("NAXIS", "")
    # A single plane may have further axes.
    sides = [cards.get(key, "") for key in ("NAXIS2", "NAXIS1")]
    is_plane = axes in {"2", "3", "4"} and all(cards.get(f"NAXIS{axis}") == "1" for axis in range(3, int(axes) + 1))
    if dtype is None or not is_plane or not all(side.isdecimal() for side in sides):
        raise ValueError("its first unit is not an image of one channel")
    shape = int(sides[0]), int(sides[1])
    begin = -(-end // _FITS_BLOCK_BYTES) * _FITS_BLOCK_BYTES
    if len(content) - begin < shape[0] * shape[1] * np.dtype(dtype).itemsize:
        raise ValueError("it is cut off")
    stored = np.frombuffer(content, dtype, count=shape[0] * shape[1], offset=begin).reshape(shape)
    if cards.get("ROWORDER", "").strip("' ").upper().replace("_", "-") == "BOTTOM-UP":
        stored = stored[::-1]
    # The standard allows FORTRAN's D for the exponent.
    scale, zero = (float(cards.get(key, "").replace("D", "E") or default) for key, default in _FITS_SCALE)
    return np.asarray(stored * scale + zero, dtype=np.float64)


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
