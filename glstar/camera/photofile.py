"""Photographs as files of any format: their pixels as the sensor read them, and their EXIF.

One rule holds for all formats and all readers: no image is turned or mirrored, whatever its EXIF says, because a camera
file and a mount describe the sensor.  Row 0 is the row that the sensor read first; FITS files with ``ROWORDER``
``BOTTOM-UP`` store it last.  What was decided about a file is in `PhotoPixels.notes`.
"""

import logging
import re
import struct
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime, timedelta, timezone
from io import BytesIO
from itertools import islice
from math import isfinite
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from glstar.system.imagefiles import (
    MOST_DIRECTORIES,
    PNG_SIGNATURE,
    image_size,
    is_whole_png,
    read_fits,
    tiff_directories,
)
from glstar.system.installation import install_command
from glstar.system.userinput import FewReads, refuse_many_pixels

# exifread logs every PNG without EXIF, and tifffile damage; without a handler they would go to the terminal.
for _library in ("exifread", "tifffile"):
    logging.getLogger(_library).addHandler(logging.NullHandler())

_FITS = b"SIMPLE  ="
_JPEG = b"\xff\xd8\xff"
_TIFF = (b"II*\0", b"MM\0*")
_BIG_TIFF = (b"II+\0", b"MM\0+")
_HEAD_BYTES = 1 << 16
_HEIF_BRANDS = (b"heic", b"heix", b"hevc", b"heim", b"heis", b"mif1", b"msf1", b"avif")
# Raw files that are no TIFF: Fujifilm, Olympus, Panasonic, Sigma and Minolta.
_RAW_SIGNATURES = (b"FUJIFILMCCD-RAW", b"IIRO", b"IIRS", b"MMOR", b"IIU\0", b"FOVb", b"\0MRM")
# First bytes of the other formats that OpenCV reads.
_PORTABLE_MAPS = tuple(f"P{kind}".encode() for kind in "1234567fF")
_SIGNATURES = (
    *(b"\x89PNG", _JPEG, b"BM", b"GIF8"),
    *(b"\0\0\0\x0cjP  ", b"\xff\x4f\xff\x51"),  # JPEG 2000
    *(b"\x76\x2f\x31\x01", b"#?RGBE", b"#?RADIANCE"),  # OpenEXR, Radiance
    b"\x59\xa6\x6a\x95",  # Sun raster
    *_BIG_TIFF,
    *_PORTABLE_MAPS,
    *_RAW_SIGNATURES,
)
_LARGEST_DN = 65535
# Stored numbers to a digital number of 15 to 9 bits that is in the highest of 16.
_LEFT_ALIGNED = frozenset(2.0**shift for shift in range(1, 8))
# Tags of TIFF directories.
_COMPRESSION, _PHOTOMETRIC, _ORIENTATION, _DNG_VERSION = 259, 262, 274, 50706
_COLOUR_FILTERS, _LINEAR_RAW = 32803, 34892
_UNCOMPRESSED = 1
# Compressions of Nikon, Sony, Samsung and Pentax.
_RAW_COMPRESSIONS = frozenset((34713, 32767, 32770, 65535))
# Photometric interpretations that need no conversion of colours: white or black is zero, RGB, a mosaic.
_WHITE_IS_ZERO, _RGB = 0, 2
_PLAIN_COLOURS = (_WHITE_IS_ZERO, 1, _RGB, _COLOUR_FILTERS)
_PACKED_BITS = (10, 12, 14)
# Samples of a pixel of a TIFF: colours, opacity and some planes of other programs.
_MOST_SAMPLES = 16
# Empty lowest bits that prove that 8 to 14 bits are in the highest of 16, if this many levels occur.
_PROVEN_SHIFTS = (8, 6, 4, 2)
_LEAST_LEVELS = 8


# Zones are whole quarters of an hour; a GPS time that is farther than this from one belongs to an older fix.
_QUARTER_S = 900
_GPS_AGE_S = 120


@dataclass(frozen=True, slots=True)
class Exif:
    """When, for how long and where an image was exposed, by its EXIF."""

    utc_s: float | None = None  # UTC seconds since 1970; without a zone, the camera's clock is taken as UTC
    zone: str | None = None  # A label of the zone; None if it is unknown
    grain_s: float = 1.0  # Unit of the time, s: 1 without sub-seconds, and with those that are all 0
    exposure_s: float | None = None  # Exposure time, s
    site_deg: tuple[float, float] | None = None  # Latitude, north positive, and longitude, east positive, deg
    orientation: int = 1  # How the image is to be turned for display; 1 for not at all


@dataclass(frozen=True, slots=True, eq=False)
class PhotoPixels:
    """The content of a photograph."""

    # (height, width) or (height, width, 3) uint8 or uint16: grey, or blue, green and red, as OpenCV has them.
    pixels: NDArray[Any]
    white_dn: int | None = None  # The digital number at which the camera saturates; None if the file does not say so
    notes: tuple[str, ...] = ()  # What the user should know of how the file was read
    exif: Exif = field(default_factory=Exif)


def has_image_signature(start: bytes) -> bool:
    """Return whether the first 16 bytes of a file, or more, begin an image of a format that glstar reads."""
    is_webp = start.startswith(b"RIFF") and start[8:12] == b"WEBP"
    return start.startswith((*_SIGNATURES, *_TIFF, _FITS)) or is_webp or _is_heif(start) or _is_raw_box(start)


def decode_photo(content: bytes, *, demosaiced: bool = True, floats: bool = False) -> PhotoPixels:
    """Return the pixels of an image file of any format, as the sensor read them.

    `demosaiced` turns the mosaic of a raw file into a colour image, by bilinear interpolation of its digital numbers;
    black level and white balance stay as they are.  `floats`: whether numbers of other types than uint8 and uint16 are
    allowed.  Raises ValueError if the file is damaged, cut off or too large, has
    other numbers than a camera's, or the library that reads it is not installed; the message continues "FILE: ".
    """
    if content.startswith(_JPEG) and _is_cut_off(content):
        raise ValueError("is a JPEG that is cut off: the end of the image is missing; copy it again")
    if content.startswith(PNG_SIGNATURE) and not is_whole_png(content):
        raise ValueError("is a PNG that is cut off or damaged: the end of the image is missing; copy it again")
    if (size_px := image_size(content)) is not None:
        refuse_many_pixels(*size_px)
    if content.startswith(_FITS):
        photo = _decoded_fits(content)
    elif kind := _kind_of_raw(content):
        photo = _decoded_raw(content, kind, demosaiced=demosaiced)
    elif _is_heif(content):
        photo = _decoded_heif(content)
    else:
        photo = _decoded_common(content, floats=floats)
    exif = exif_of(BytesIO(content))
    turned = f"EXIF turns the image for display (orientation {exif.orientation}); pixels are as the sensor read them"
    return replace(photo, exif=exif, notes=(*photo.notes, *([turned] if exif.orientation > 1 else [])))


def _is_cut_off(jpeg: bytes) -> bool:
    """Return whether the last scan of a JPEG has no end; some decoders silently fill the rest with grey."""
    end, scan = b"\xff\xd9", b"\xff\xda"
    # Usually nothing follows the end marker, and a search through megabytes is unnecessary.
    return end not in jpeg[-64:] and jpeg.rfind(end) < jpeg.rfind(scan)


def _decoded_common(content: bytes, *, floats: bool) -> PhotoPixels:
    """Return the pixels of a JPEG, PNG, TIFF, WebP and whatever else OpenCV reads."""
    pixels, packed_bits, is_inverted = None, None, False
    if content.startswith((*_TIFF, *_BIG_TIFF)):
        pixels, packed_bits, is_inverted, content = _decoded_tiff(content)
    if pixels is None:
        import cv2  # noqa: PLC0415 - cv2, only when an image is read

        # Of an unknown size, decoding might fill the memory.
        is_sized = image_size(content) is not None
        try:
            pixels = cv2.imdecode(np.frombuffer(content, np.uint8), cv2.IMREAD_UNCHANGED) if is_sized else None
        except cv2.error:
            pixels = None
    if pixels is None:
        raise ValueError("is no image that can be read; JPEG, PNG, TIFF, WebP, FITS, DNG and other raw files, HEIC can")
    if (pixels.dtype not in (np.uint8, np.uint16) and not floats) or pixels.ndim not in (2, 3):
        raise ValueError(
            f"holds {pixels.dtype} in {pixels.ndim} axes; only grey or colour images of 8 or 16 bits are supported"
        )
    if pixels.ndim == 3:
        # Two or four channels: the last one is opacity, not light.
        pixels = pixels[..., 0] if pixels.shape[2] < 3 else pixels[..., :3]
    if packed_bits is not None:
        # OpenCV moves the numbers to the highest of 16 bits.
        moved = _FILE_BITS - packed_bits
        plain = pixels if (pixels & ((1 << moved) - 1)).any() else pixels >> np.uint16(moved)
        white_dn = 2**packed_bits - 1
        return PhotoPixels(np.ascontiguousarray(white_dn - plain if is_inverted else plain), white_dn)
    stated = stated_shift_bits(content)
    shifted = as_digital_numbers(pixels, stated)
    if shifted is not pixels:
        return PhotoPixels(shifted, 2 ** (_FILE_BITS - stated) - 1)
    return _aligned(np.ascontiguousarray(pixels))


def _aligned(pixels: NDArray[Any]) -> PhotoPixels:
    """Return pixels of 16 bits as digital numbers, if the data prove that these are in the highest bits."""
    used = int(np.bitwise_or.reduce(pixels, axis=None)) if pixels.dtype == np.uint16 else 0
    shift = next((bits for bits in _PROVEN_SHIFTS if used and used % (1 << bits) == 0), 0)
    plain = pixels >> np.uint16(shift) if shift else pixels
    # Few levels, such as those of a test pattern, have empty bits by chance.
    if not shift or np.count_nonzero(np.bincount(plain.ravel())) < _LEAST_LEVELS:
        return PhotoPixels(pixels)
    bits, multiples = _FILE_BITS - shift, f"its numbers are multiples of {1 << shift}"
    # Smaller numbers may be in the lowest bits, scaled up.
    if pixels.max() < 2**bits:
        return PhotoPixels(pixels, notes=(f"{multiples} below {2**bits}: they are taken as they are",))
    return PhotoPixels(plain, 2**bits - 1, (f"{multiples}: they are taken as {bits} bits in the highest of 16",))


def _decoded_tiff(content: bytes) -> tuple[NDArray[Any] | None, int | None, bool, bytes]:
    """Return the pixels of a TIFF, blue first, or None to leave them to OpenCV.

    Beside them: the bits of packed numbers, whether these count from white, and the file for OpenCV, which then does
    not turn the image.
    """
    import tifffile  # noqa: PLC0415 - only when a TIFF is read

    try:
        tiff = tifffile.TiffFile(BytesIO(content))
        page = _full_page(tiff)
        # A tag of several values, where the format has one, is damage too: only numbers have a sum.
        sum((page.imagewidth, page.imagelength, page.samplesperpixel, page.bitspersample))
    except Exception:  # damage: OpenCV is tried next
        return None, None, False, content
    refuse_many_pixels(page.imagewidth, page.imagelength)
    if page.samplesperpixel > _MOST_SAMPLES:
        raise ValueError(f"has {page.samplesperpixel} samples a pixel; grey and colour images have 1 to 4")
    if (turned := page.tags.get(_ORIENTATION)) is not None:
        upright, at = (1).to_bytes(2, "little" if tiff.byteorder == "<" else "big"), turned.valueoffset
        content = content[:at] + upright + content[at + len(upright) :]
    is_inverted, is_rgb = page.photometric == _WHITE_IS_ZERO, page.photometric == _RGB
    if page.bitspersample in _PACKED_BITS:
        # Some programs state 12 bits and write two bytes for each; OpenCV would unpack them.
        is_packed = sum(page.databytecounts) != 2 * page.imagewidth * page.imagelength * page.samplesperpixel
        if page.compression == _UNCOMPRESSED and not is_packed:
            stated = f"states {page.bitspersample} bits a sample and holds 16"
            raise ValueError(f"{stated}; write it with BitsPerSample = 16")
        return None, page.bitspersample, is_inverted, content
    # OpenCV makes 0 and 255 of single bits.
    if page.photometric not in _PLAIN_COLOURS or page.bitspersample == 1:
        return None, None, False, content
    try:
        # Not OpenCV: it mixes up the channels of planar images.
        pixels: NDArray[Any] = page.asarray()
    except Exception:  # unsupported compression or damage: OpenCV is tried next
        return None, None, False, content
    if page.axes == "SYX":
        pixels = np.moveaxis(pixels, 0, -1)
    if is_rgb and pixels.ndim == 3 and pixels.shape[2] >= 3:
        pixels = pixels[..., 2::-1]
    return np.iinfo(pixels.dtype).max - pixels if is_inverted else pixels, None, False, content


def _full_page(tiff: Any) -> Any:
    """Return the largest page of a TIFF that is not a thumbnail, also of those below another; the first of equals."""
    pages = [page for first in islice(tiff.pages, MOST_DIRECTORIES) for page in (first, *(first.pages or ()))]
    full = [page for page in pages if not page.is_reduced] or pages
    return max(full, key=lambda page: page.imagewidth * page.imagelength)


def _kind_of_raw(content: bytes) -> str:
    """Return the kind of a camera's raw file for messages; empty for an image file."""
    if content.startswith(_RAW_SIGNATURES) or _is_raw_box(content):
        return "raw file of a camera"
    if not content.startswith(_TIFF):
        return ""
    directories = tiff_directories(content)
    if any(_DNG_VERSION in directory for directory in directories[:1]):
        return "DNG"
    # Canon marks its files; others have a thumbnail first, and the mosaic in a directory below it.
    is_raw = content[8:10] == b"CR" or any(
        set(directory.get(_COMPRESSION, ())) & _RAW_COMPRESSIONS
        or (number and directory.get(_PHOTOMETRIC) in ((_COLOUR_FILTERS,), (_LINEAR_RAW,)))
        for number, directory in enumerate(directories)
    )
    return "raw file of a camera" if is_raw else ""


def _is_raw_box(start: bytes) -> bool:
    """Return whether a file begins as Canon's CR3."""
    return start[4:12] == b"ftypcrx "


def _is_heif(start: bytes) -> bool:
    return start[4:8] == b"ftyp" and start[8:12] in _HEIF_BRANDS


def _decoded_fits(content: bytes) -> PhotoPixels:
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
    numbers = pixels.astype(np.uint16)
    white_dn = _white_dn_of_fits(content)
    return _aligned(numbers) if white_dn is None else PhotoPixels(numbers, white_dn)


def _white_dn_of_fits(content: bytes) -> int | None:
    """Return the largest digital number of a file whose numbers are in the highest of 16 bits; None of another."""
    scale = re.search(rb"BSCALE  = +([0-9.]+)", content[:_HEAD_BYTES])
    per_dn = 1 / float(scale[1]) if scale is not None and float(scale[1]) else 1.0
    return (_LARGEST_DN + 1) // int(per_dn) - 1 if per_dn in _LEFT_ALIGNED else None


def _decoded_raw(content: bytes, kind: str, *, demosaiced: bool) -> PhotoPixels:
    try:
        import rawpy  # noqa: PLC0415 - an extra, only when a raw file is read
    except ImportError as error:
        raise ValueError(f"is a {kind}, which needs rawpy: {install_command('raw')}") from error
    try:
        with rawpy.imread(BytesIO(content)) as raw:
            refuse_many_pixels(raw.sizes.raw_width, raw.sizes.raw_height)
            mosaic = np.array(raw.raw_image_visible)
            white_dn = int(raw.white_level)
            colours = raw.raw_pattern
            pattern = "" if colours is None else "".join(raw.color_desc.decode()[int(c)] for c in np.ravel(colours))
    except (rawpy.LibRawError, IndexError) as error:
        instead = "" if kind == "DNG" else "; convert it to DNG or to a TIFF of 16 bits"
        raise ValueError(f"is a {kind} that cannot be decoded ({_text_of(error)}){instead}") from error
    if mosaic.ndim != 2 or mosaic.dtype != np.uint16:
        raise ValueError(f"is a {kind} without the camera's own numbers; glstar reads raw mosaics of up to 16 bits")
    if demosaiced and len(set(pattern)) > 1:
        mosaic = _bilinear(mosaic, pattern, kind)
    return PhotoPixels(np.ascontiguousarray(mosaic), white_dn)


def _text_of(error: Exception) -> str:
    """Return LibRaw's message, which is of bytes."""
    text = error.args[0] if error.args else ""
    return text.decode("ascii", "replace") if isinstance(text, bytes) else str(text)


def _bilinear(mosaic: NDArray[np.uint16], pattern: str, kind: str) -> NDArray[np.uint16]:
    """Return a mosaic as blue, green and red."""
    import cv2  # noqa: PLC0415 - cv2, only when a raw image is read

    codes = {
        "RGGB": cv2.COLOR_BayerRGGB2BGR,
        "BGGR": cv2.COLOR_BayerBGGR2BGR,
        "GRBG": cv2.COLOR_BayerGRBG2BGR,
        "GBRG": cv2.COLOR_BayerGBRG2BGR,
    }
    if pattern not in codes:
        raise ValueError(f"is a {kind} with the mosaic {pattern[:36]}; glstar reads RGGB, BGGR, GRBG and GBRG")
    return np.asarray(cv2.cvtColor(mosaic, codes[pattern]), dtype=np.uint16)


def _decoded_heif(content: bytes) -> PhotoPixels:
    try:
        import pillow_heif  # noqa: PLC0415 - an extra, only when a HEIC is read
    except ImportError as error:
        raise ValueError(f"is a HEIC image, which needs pillow-heif: {install_command('heic')}") from error
    with _damage_of_heic_explained():
        image = pillow_heif.open_heif(BytesIO(content), convert_hdr_to_8bit=False, bgr_mode=True)
        size_px = image.size
    refuse_many_pixels(*size_px)
    with _damage_of_heic_explained():
        pixels = np.asarray(image)
    bits = int(image.info.get("bit_depth", 8))
    if pixels.dtype == np.uint16:  # pillow-heif moves the bits of deeper images to the top of 16
        pixels = pixels >> (16 - bits)
    colours = pixels if pixels.ndim == 2 else pixels[..., :3]
    return PhotoPixels(np.ascontiguousarray(_as_stored(colours, content)), 2**bits - 1)


def _as_stored(pixels: NDArray[Any], content: bytes) -> NDArray[Any]:
    """Return a HEIC's pixels before libheif turned them as its boxes say (ISO/IEC 23008-12, irot and imir)."""
    boxes = re.findall(rb"\0\0\0\x09(irot|imir)(.)", content[:_HEAD_BYTES], re.DOTALL)
    if len({kind for kind, _ in boxes}) < len(set(boxes)):
        raise ValueError("is a HEIC image with parts that are turned differently; export it as JPEG")
    for kind, value in reversed(list(dict.fromkeys(boxes))):
        is_turn = kind == b"irot"
        pixels = np.rot90(pixels, -(value[0] & 3)) if is_turn else np.flip(pixels, axis=value[0] & 1)
    return pixels


@contextmanager
def _damage_of_heic_explained() -> Iterator[None]:
    try:
        yield
    except (OSError, RuntimeError, EOFError, SyntaxError, ValueError, IndexError) as error:
        reason = " ".join(str(error).split())
        raise ValueError(f"is a HEIC image that cannot be decoded ({reason})") from error


# Tag of TIFF 6.0 with the largest value that a pixel can have.
MAX_SAMPLE_VALUE = 281
_FILE_BITS = 16


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
    largest = next(iter(tiff_directories(content)), {}).get(MAX_SAMPLE_VALUE, (0,))[0]
    # A run of ones that ends at the highest of 16 bits.
    shift = (largest & -largest).bit_length() - 1
    return shift if largest and largest == (0xFFFF >> shift) << shift else 0


def read_exif(path: Path) -> Exif:
    """Return the time, the exposure and the place in the EXIF of an image file; the defaults where it has none."""
    try:
        with path.open("rb") as file:
            return exif_of(file)
    except OSError:
        return Exif()


def exif_of(file: BinaryIO) -> Exif:
    """Return what `read_exif` does, of an open file."""
    tags = _exif_tags(file)
    exposure = _numbers(tags, "ExposureTime")
    orientation = _numbers(tags, "Orientation")
    exif = Exif(
        exposure_s=exposure[0] if len(exposure) == 1 and isfinite(exposure[0]) and exposure[0] > 0 else None,
        site_deg=_site_deg(tags),
        orientation=int(orientation[0]) if len(orientation) == 1 and orientation[0] in range(1, 9) else 1,
    )
    try:
        local = _exif_datetime(_text(tags, "DateTimeOriginal"))
    except ValueError:
        return exif
    digits = _text(tags, "SubSecTimeOriginal")
    local += timedelta(seconds=_fraction_s(digits))
    # Many cameras write zeros and have no sub-seconds.
    exif = replace(exif, grain_s=10.0 ** -len(digits) if digits.strip("0").isdecimal() else 1.0)
    offset = _text(tags, "OffsetTimeOriginal")
    with suppress(ValueError):
        return replace(exif, utc_s=local.replace(tzinfo=zone_of(offset)).timestamp(), zone=f"zone {offset}")
    zone_s = _zone_by_gps_s(tags, local)
    if zone_s is None:
        return replace(exif, utc_s=local.timestamp())
    return replace(exif, utc_s=local.timestamp() - zone_s, zone=f"zone {zone_s / 3600:+g} h by its GPS time")


def _exif_tags(file: BinaryIO) -> dict[str, Any]:
    """Return the EXIF tags of an image file by ExifRead's names; none if it has no valid EXIF."""
    import exifread  # noqa: PLC0415 - only when a photograph is read

    try:
        block = _exif_block(file)
        file.seek(0)
        source: Any = FewReads(file if block is None else BytesIO(block))
        return dict(exifread.process_file(source, details=False))
    except Exception:  # damaged EXIF raises many kinds of errors
        return {}


def _exif_block(file: BinaryIO) -> bytes | None:
    """Return the EXIF of a HEIC, AVIF or WebP file as a TIFF of its own; None for files that ExifRead reads."""
    start = file.read(16)
    if start.startswith(b"RIFF") and start[8:12] == b"WEBP":
        file.seek(12)
        while len(head := file.read(8)) == 8:
            kind, length = struct.unpack("<4sI", head)
            if kind == b"EXIF":
                return file.read(length).removeprefix(b"Exif\0\0")
            file.seek(length + length % 2, 1)
        return b""
    if not _is_heif(start):
        return None
    # ExifRead 3.5.1 fails on the boxes of libheif.
    file.seek(0)
    content = file.read()
    with suppress(Exception):  # without the library, or of an AVIF, the block is found by its signature
        import pillow_heif  # noqa: PLC0415 - an extra, only when a HEIC is read

        block = pillow_heif.open_heif(BytesIO(content)).info.get("exif") or b""
        return bytes(block).removeprefix(b"Exif\0\0")
    found = re.search(rb"Exif\0\0(?=II\*\0|MM\0\*)", content)
    return content[found.end() :] if found else b""


def _tag(tags: dict[str, Any], name: str) -> Any:
    """Return a tag of EXIF, or of the main directory, where PiDNG writes it."""
    return tags.get(f"EXIF {name}", tags.get(f"Image {name}"))


def _text(tags: dict[str, Any], name: str) -> str:
    tag = _tag(tags, name)
    return "" if tag is None else str(tag).strip(" \0")


def _numbers(tags: dict[str, Any], name: str) -> tuple[float, ...]:
    """Return the values of a tag, also of GPS; none if one of them is no number."""
    with suppress(TypeError, ValueError, ZeroDivisionError):
        return tuple(float(value) for value in getattr(_tag(tags, name) or tags.get(f"GPS {name}"), "values", ()))
    return ()


def _exif_datetime(text: str) -> datetime:
    return datetime.strptime(text, "%Y:%m:%d %H:%M:%S").replace(tzinfo=UTC)


def _fraction_s(digits: str) -> float:
    return float(f"0.{digits}") if digits.isdecimal() else 0.0


def zone_of(text: str) -> timezone:
    """Return the zone of ``Z``, ``+09:30`` or ``+0930``; raise ValueError for anything else."""
    if text == "Z":
        return UTC
    found = re.fullmatch(r"([+-])(\d\d):?(\d\d)", text.strip())
    if found is None:
        raise ValueError(text)
    offset = timedelta(hours=int(found[2]), minutes=int(found[3]))
    return timezone(-offset if found[1] == "-" else offset)


def _zone_by_gps_s(tags: dict[str, Any], local: datetime) -> int | None:
    """Return the camera's clock minus the GPS time, rounded to a zone, s; None if it is not one."""
    try:
        hour, minute, second = _numbers(tags, "GPSTimeStamp")
        utc = datetime.strptime(str(tags.get("GPS GPSDate", "")).strip(" \0"), "%Y:%m:%d").replace(tzinfo=UTC)
    except ValueError:
        return None
    ahead_s = (local - utc).total_seconds() - (hour * 3600 + minute * 60 + second)
    zone_s = round(ahead_s / _QUARTER_S) * _QUARTER_S
    return zone_s if abs(ahead_s - zone_s) <= _GPS_AGE_S and abs(zone_s) <= 14 * 3600 else None


def _site_deg(tags: dict[str, Any]) -> tuple[float, float] | None:
    """Return latitude and longitude, deg; None unless both are given and valid."""
    if str(tags.get("GPS GPSStatus", "")).startswith("V"):  # void
        return None
    angles = []
    for name, positive, negative, largest in (("GPSLatitude", "N", "S", 90), ("GPSLongitude", "E", "W", 180)):
        parts, side = _numbers(tags, name), str(tags.get(f"GPS {name}Ref", "")).strip(" \0").upper()[:1]
        if len(parts) != 3 or side not in (positive, negative):
            return None
        angle_deg = parts[0] + parts[1] / 60 + parts[2] / 3600
        if not 0 <= angle_deg <= largest:
            return None
        angles.append(angle_deg if side == positive else -angle_deg)
    # A receiver without a fix writes zeros.
    return (angles[0], angles[1]) if any(angles) else None
