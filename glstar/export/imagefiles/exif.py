"""EXIF of images: UTC, exposure time and position, for tools that read photographs."""

import struct
import zlib
from datetime import UTC, datetime, timedelta
from fractions import Fraction
from math import floor
from pathlib import Path
from typing import Any

from glstar.camera.photofile import stated_shift_bits
from glstar.errors import ExportError
from glstar.export.directory import explain_disk_errors, image_path
from glstar.export.imagefiles.formats import EXIF_END, decode, tiff
from glstar.export.imagefiles.processing import encode_jpeg
from glstar.export.truth.lines import count_frames_of_truth, read_truth
from glstar.sky.place.timescale import parse_utc
from glstar.system.files import write_atomically

# Types of EXIF values: text, 16-bit and 32-bit numbers, and quotients of two 32-bit numbers.
_BYTE, _TEXT, _SHORT, _LONG, _RATIONAL = 1, 2, 3, 4, 5
_EXIF_IFD, _GPS_IFD = 0x8769, 0x8825
# Private tags in place of these links, which tifffile does not write.
_STANDS_FOR = {_EXIF_IFD: 65000, _GPS_IFD: 65001}
_JPEG_QUALITY = 95
_PNG_HEAD_BYTES = 8 + 25  # signature and IHDR
# Where a PNG and a JPEG of glstar have the mark of their EXIF.
_PNG_EXIF = slice(_PNG_HEAD_BYTES + 4, _PNG_HEAD_BYTES + 8)
_JPEG_EXIF, _APP1 = slice(2, 4), b"\xff\xe1"
_Tag = tuple[int, int, int, bytes]


def write_photographs(directory: Path, output: Path, kind: str) -> int:
    """Write the frames of an export as images with EXIF to a new directory, and return their number.

    JPEG has 8 bits and loses faint noise. Raises ExportError if the directory exists, or a frame cannot be read or
    written.
    """
    if output.exists():
        raise ExportError(output, "exists already; name another directory, or remove it")
    count = count_frames_of_truth(directory)
    with explain_disk_errors(output):
        output.mkdir(parents=True)
        for line in read_truth(directory):
            source = image_path(directory, line)
            try:
                content = source.read_bytes()
                if kind == "png" and source.suffix != ".png":
                    raise ExportError(source, "is no PNG; use --to jpeg, or export with --format png")
                image = with_exif(content if kind == "png" else _jpeg(content, source), f".{kind}", line)
            except (OSError, ValueError) as error:
                raise ExportError(source, f"cannot be read ({error})") from error
            write_atomically(output / Path(line["file"]).with_suffix(f".{kind}").name, image)
    return count


def with_exif(content: bytes, suffix: str, line: dict[str, Any]) -> bytes:
    """Return a PNG, JPEG or TIFF that glstar encoded with the EXIF of its frame; pixels stay as they are.

    `line` is the frame's truth. A file that has EXIF already is returned as it is.
    """
    if content[_PNG_EXIF] == b"eXIf" or content[_JPEG_EXIF] == _APP1 or content.endswith(EXIF_END):
        return content
    if suffix == ".png":
        exif = exif_of(line)
        chunk = struct.pack(">I", len(exif)) + b"eXIf" + exif
        chunk += struct.pack(">I", zlib.crc32(b"eXIf" + exif))
        return content[:_PNG_HEAD_BYTES] + chunk + content[_PNG_HEAD_BYTES:]
    if suffix == ".tiff":
        return _tiff_with_exif(content, line)
    segment = b"Exif\0\0" + exif_of(line)
    return content[:2] + _APP1 + struct.pack(">H", len(segment) + 2) + segment + content[2:]


def exif_of(line: dict[str, Any]) -> bytes:
    """Return the EXIF of a line of truth, as a TIFF structure.

    Times are the start of the exposure by the camera's clock, in UTC; the height is above the ellipsoid.
    """
    stamp, shot, place = _tags(line)
    first = [_text(0x010F, "glstar"), _text(0x0131, "glstar"), _text(0x0132, stamp)]
    head_bytes = 8
    exif_at = head_bytes + _size(first) + 2 * 12
    gps_at = exif_at + _size(shot)
    first += [(_EXIF_IFD, _LONG, 1, struct.pack("<I", exif_at)), (_GPS_IFD, _LONG, 1, struct.pack("<I", gps_at))]
    body = _directory(first, head_bytes) + _directory(shot, exif_at) + _directory(place, gps_at)
    return b"II*\0" + struct.pack("<I", head_bytes) + body


def _tiff_with_exif(content: bytes, line: dict[str, Any]) -> bytes:
    """Return a TIFF with its EXIF after the pixels; links in the first directory lead to it."""
    stamp, shot, place = _tags(line)
    pixels, shift = decode(content, ".tiff"), stated_shift_bits(content)

    def gps_at(exif_at: int) -> int:
        return exif_at + _size(shot)

    def written(exif_at: int) -> bytes:
        links = {_EXIF_IFD: exif_at, _GPS_IFD: gps_at(exif_at)}
        tags = [(_STANDS_FOR[tag], at) for tag, at in links.items()]
        whole = tiff(pixels, date_time=stamp, tags=tags, shift_bits=shift)
        for tag in links:  # the directory precedes the pixels
            whole = whole.replace(_entry(_STANDS_FOR[tag]), _entry(tag), 1)
        return whole

    exif_at = len(written(0))
    return written(exif_at) + _directory(shot, exif_at) + _directory(place, gps_at(exif_at)) + EXIF_END


def _entry(tag: int) -> bytes:
    """Return the beginning of a TIFF directory's entry of one 32-bit number."""
    return struct.pack("<HHI", tag, _LONG, 1)


def _tags(line: dict[str, Any]) -> tuple[str, list[_Tag], list[_Tag]]:
    """Return the time as EXIF states it, the tags of the exposure and the tags of the position."""
    start_us = round(parse_utc(line["camera_utc_start"]) * 1e6)
    time = datetime(1970, 1, 1, tzinfo=UTC) + timedelta(microseconds=start_us)
    site = line["site"]
    exposure = Fraction(line["duration_s"]).limit_denominator(1_000_000)
    stamp, fraction = f"{time:%Y:%m:%d %H:%M:%S}", f"{start_us % 1_000_000:06d}"
    shot = [
        _rationals(0x829A, exposure),
        _text(0x9003, stamp),
        _text(0x9004, stamp),
        _text(0x9011, "+00:00"),
        _text(0x9012, "+00:00"),
        _text(0x9291, fraction),
        _text(0x9292, fraction),
    ]
    place = [
        (0, _BYTE, 4, bytes((2, 3, 0, 0))),
        _text(1, "N" if site["latitude_deg"] >= 0 else "S"),
        _rationals(2, *_degrees(abs(site["latitude_deg"]))),
        _text(3, "E" if site["longitude_deg"] >= 0 else "W"),
        _rationals(4, *_degrees(abs(site["longitude_deg"]))),
        (5, _BYTE, 1, bytes((int(site["height_m"] < 0),))),
        _rationals(6, Fraction(abs(site["height_m"])).limit_denominator(1000)),
        _rationals(
            7, Fraction(time.hour), Fraction(time.minute), Fraction(time.second * 10**6 + time.microsecond, 10**6)
        ),
        _text(29, f"{time:%Y:%m:%d}"),
    ]
    return stamp, shot, place


def _degrees(angle_deg: float) -> tuple[Fraction, Fraction, Fraction]:
    """Return degrees, minutes and seconds, to 1e-7 arcseconds."""
    degrees = floor(angle_deg)
    minutes = floor((angle_deg - degrees) * 60)
    seconds = ((angle_deg - degrees) * 60 - minutes) * 60
    return Fraction(degrees), Fraction(minutes), Fraction(round(seconds * 10**7), 10**7)


def _text(tag: int, text: str) -> _Tag:
    return tag, _TEXT, len(text) + 1, text.encode("ascii") + b"\0"


def _rationals(tag: int, *numbers: Fraction) -> _Tag:
    return tag, _RATIONAL, len(numbers), b"".join(struct.pack("<II", n.numerator, n.denominator) for n in numbers)


def _size(tags: list[_Tag]) -> int:
    """Return the size of a directory with its values, bytes."""
    return 2 + 12 * len(tags) + 4 + sum(len(data) + len(data) % 2 for *_, data in tags if len(data) > 4)


def _directory(tags: list[_Tag], offset: int) -> bytes:
    """Return a directory (IFD) of tags, followed by the values that do not fit into it."""
    entries, values = b"", b""
    values_at = offset + 2 + 12 * len(tags) + 4
    for tag, kind, count, data in sorted(tags):
        if len(data) > 4:
            value = struct.pack("<I", values_at + len(values))
            values += data + b"\0" * (len(data) % 2)
        else:
            value = data.ljust(4, b"\0")
        entries += struct.pack("<HHI", tag, kind, count) + value
    return struct.pack("<H", len(tags)) + entries + struct.pack("<I", 0) + values


def _jpeg(content: bytes, source: Path) -> bytes:
    if source.suffix == ".jpg":
        return content
    pixels = decode(content, source.suffix)
    if pixels.dtype.itemsize > 1:
        raise ExportError(source, "has 16 bits, and JPEG has 8; export with --format png")
    return encode_jpeg(pixels, _JPEG_QUALITY)
