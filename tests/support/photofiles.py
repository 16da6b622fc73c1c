"""Images of known pixels in every container that strangers have, with decoys: thumbnails, turns, empty bits.

Each file is written by its format's own library; only packed TIFF samples, which none writes, are packed here.
"""

import struct
from collections.abc import Callable
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import cv2
import numpy as np
import piexif
import pillow_heif
import tifffile
from astropy.io import fits
from numpy.typing import NDArray
from PIL import Image

from glstar.calibrate.photo.photograph import read_image
from glstar.camera.photofile import read_exif
from glstar.errors import CalibrationError, ImagesError
from glstar.images.decoding import read_grey
from tests.support.dng import dng

Pixels = NDArray[Any]
Rng = np.random.Generator

# 2024-03-10 21:30:00 at UTC + 10:30, exposed for half a second at 34.93 S 138.6 E.
UTC_S, EXPOSURE_S, SITE_DEG = 1710068400.0, 0.5, (-34.93, 138.6)


@dataclass(eq=False)
class ImageCase:
    """An image file of a stranger and what is in it."""

    what: str
    content: bytes
    grey: Pixels  # (height, width) digital numbers as the sensor read them: of colours the largest
    bits: int | None = None  # Bits of the converter; None if the file does not say
    tolerance_dn: float = 0.0  # Of formats with losses
    has_exif: bool = False
    may_refuse: bool = False
    is_mosaic: bool = False  # Then grey readers interpolate its colours


def verdict(case: ImageCase) -> str:
    """Return ``"right"`` or ``"refused"``, or a line on what is wrong."""
    with TemporaryDirectory() as folder:
        path = Path(folder) / "image"
        path.write_bytes(case.content)
        try:
            photograph, grey = read_image(path, demosaiced=False), read_grey(path)
        except (CalibrationError, ImagesError) as error:
            return "refused" if case.may_refuse and "\n" not in str(error) else f"{case.what}: refused: {error}"
        exif = read_exif(path)
    if case.is_mosaic and grey.shape == case.grey.shape:
        grey = case.grey
    for pixels in (photograph.pixels_dn, grey.astype(float)):
        if pixels.shape != case.grey.shape:
            return f"{case.what}: {pixels.shape} for {case.grey.shape}"
        if not np.abs(pixels - case.grey).max() <= case.tolerance_dn:
            return f"{case.what}: off by {np.abs(pixels - case.grey).max()} DN of {case.grey.max()}"
    if case.bits not in (None, photograph.bit_depth):
        return f"{case.what}: {photograph.bit_depth} bits"
    known = (exif.utc_s, exif.exposure_s, exif.site_deg and tuple(np.round(exif.site_deg, 6)), photograph.exposure_s)
    if case.has_exif and known != (UTC_S, EXPOSURE_S, SITE_DEG, EXPOSURE_S):
        return f"{case.what}: EXIF {known}"
    return "right"


# --- pixels and EXIF --------------------------------------------------------------------------------------------------


def _mosaic(rng: Rng, bits: int, shape: tuple[int, int] = (64, 96)) -> Pixels:
    """Return noise of all levels, with a corner that shows turns and mirrors."""
    pixels = rng.integers(0, 2**bits - 1, shape, endpoint=True).astype(np.uint16 if bits > 8 else np.uint8)
    pixels[:8, :16] = 2**bits - 1
    return pixels


def _smooth(rng: Rng, shape: tuple[int, int] = (64, 96)) -> Pixels:
    """Return even quarters of different levels for formats with losses, uint8."""
    levels = rng.choice([10, 60, 110, 160, 210], 4, replace=False).astype(np.uint8)
    return np.kron(levels.reshape(2, 2), np.ones((shape[0] // 2, shape[1] // 2), np.uint8)).astype(np.uint8)


def exif_block(orientation: int = 1) -> bytes:
    """Return EXIF as piexif writes it."""
    photo = {
        piexif.ExifIFD.DateTimeOriginal: b"2024:03:10 21:30:00",
        piexif.ExifIFD.OffsetTimeOriginal: b"+10:30",
        piexif.ExifIFD.ExposureTime: (1, 2),
    }
    gps = {
        piexif.GPSIFD.GPSLatitudeRef: b"S",
        piexif.GPSIFD.GPSLatitude: ((34, 1), (5580, 100), (0, 1)),
        piexif.GPSIFD.GPSLongitudeRef: b"E",
        piexif.GPSIFD.GPSLongitude: ((138, 1), (36, 1), (0, 1)),
    }
    return bytes(piexif.dump({"0th": {piexif.ImageIFD.Orientation: orientation}, "Exif": photo, "GPS": gps}))


# --- containers -------------------------------------------------------------------------------------------------------


def png(rng: Rng) -> ImageCase:
    """Return a PNG, turned by its EXIF or not."""
    bits = int(rng.choice([8, 16]))
    pixels, orientation = _mosaic(rng, bits), int(rng.integers(1, 9))
    target = BytesIO()
    Image.fromarray(pixels).save(target, "png", exif=exif_block(orientation))
    return ImageCase(f"PNG {bits} bits, orientation {orientation}", target.getvalue(), pixels, bits, has_exif=True)


def jpeg(rng: Rng) -> ImageCase:
    """Return a JPEG, turned by its EXIF, with a thumbnail in it."""
    pixels, orientation = _smooth(rng), int(rng.integers(1, 9))
    exif = piexif.load(exif_block(orientation))
    exif["thumbnail"] = cv2.imencode(".jpg", np.full((120, 160), 200, np.uint8))[1].tobytes()
    exif["1st"] = {piexif.ImageIFD.Compression: 6}
    target = BytesIO()
    Image.fromarray(pixels).save(target, "jpeg", quality=95, exif=piexif.dump(exif))
    return ImageCase(f"JPEG, orientation {orientation}", target.getvalue(), pixels, 8, 6.0, has_exif=True)


def webp(rng: Rng) -> ImageCase:
    """Return a WebP without losses."""
    pixels, orientation = np.dstack([_mosaic(rng, 8)] * 3), int(rng.integers(1, 9))
    exif = exif_block(orientation)
    target = BytesIO()
    Image.fromarray(pixels).save(target, "webp", lossless=True, exif=exif if rng.random() < 0.5 else exif[6:])
    return ImageCase(f"WebP, orientation {orientation}", target.getvalue(), pixels[..., 0], 8, has_exif=True)


def heic(rng: Rng) -> ImageCase:
    """Return a HEIC, turned by its boxes and by its EXIF."""
    pixels, orientation = _smooth(rng), int(rng.integers(1, 9))
    target = BytesIO()
    image = Image.fromarray(np.dstack([pixels] * 3))
    pillow_heif.from_pillow(image).save(target, quality=95, exif=exif_block(orientation))
    return ImageCase(f"HEIC, orientation {orientation}", target.getvalue(), pixels, 8, 8.0, has_exif=True)


def tiff(rng: Rng) -> ImageCase:
    """Return a TIFF of 8 or 16 bits: grey or RGB, planar, either byte order, compressed, with a thumbnail or not."""
    bits, channels = int(rng.choice([8, 16])), int(rng.choice([1, 3, 4]))
    planes = [_mosaic(rng, bits) for _ in range(channels)]
    grey = np.max(planes[:3], axis=0)
    is_planar = channels == 3 and rng.random() < 0.5
    pixels = planes[0] if channels == 1 else np.stack(planes, axis=0 if is_planar else -1)
    options: dict[str, Any] = {
        "photometric": ("minisblack" if rng.random() < 0.7 else "miniswhite") if channels == 1 else "rgb",
        "compression": rng.choice([None, "zlib"]),
        "planarconfig": None if channels == 1 else "separate" if is_planar else "contig",
        "metadata": None,
    }
    if options["photometric"] == "miniswhite":
        pixels = np.iinfo(pixels.dtype).max - pixels
    thumbnail, target = rng.random() < 0.5, BytesIO()
    with tifffile.TiffWriter(target, byteorder=rng.choice(["<", ">"]), bigtiff=bool(rng.random() < 0.3)) as writer:
        if thumbnail:
            below = int(rng.integers(2))
            flag = int(rng.integers(2))
            writer.write(_mosaic(rng, 8, (12, 16)), subfiletype=flag, subifds=below, metadata=None)
        writer.write(pixels, **options)
    what = f"TIFF {bits} bits, {channels} channels, {options}, thumbnail {thumbnail}"
    return ImageCase(what, target.getvalue(), grey, bits)


def packed_tiff(rng: Rng) -> ImageCase:
    """Return an uncompressed TIFF whose samples of 10, 12 or 14 bits follow each other without a gap."""
    bits = int(rng.choice([10, 12, 14]))
    pixels = _mosaic(rng, bits, (int(rng.integers(33, 70)), int(rng.integers(33, 99))))
    if rng.random() < 0.3:
        pixels = (pixels // 40 * 1).astype(np.uint16)  # a dark image
    orientation, is_inverted = int(rng.integers(1, 9)), rng.random() < 0.2
    stored = 2**bits - 1 - pixels if is_inverted else pixels
    samples = (stored[..., np.newaxis] >> np.arange(bits - 1, -1, -1)) & 1
    rows = np.packbits(samples.reshape(len(pixels), -1).astype(np.uint8), axis=1).tobytes()
    order = str(rng.choice(["<", ">"]))
    height, width = pixels.shape
    entries = [
        (256, 4, width),
        (257, 4, height),
        (258, 3, bits),
        (259, 3, 1),
        (262, 3, int(not is_inverted)),
        (273, 4, 8),
    ]
    entries += [(274, 3, orientation), (277, 3, 1), (278, 4, height), (279, 4, len(rows)), (284, 3, 1)]
    body = struct.pack(f"{order}H", len(entries))
    for tag, kind, value in entries:
        body += struct.pack(f"{order}HHI", tag, kind, 1)
        body += struct.pack(f"{order}H2x" if kind == 3 else f"{order}I", value)
    head = (b"II*\0" if order == "<" else b"MM\0*") + struct.pack(f"{order}I", 8 + len(rows) + len(rows) % 2)
    content = head + rows + b"\0" * (len(rows) % 2) + body + bytes(4)
    what = f"TIFF packed {bits} bits {order}, width {width}, orientation {orientation}, inverted {is_inverted}"
    return ImageCase(what, content, pixels, bits)


def left_aligned(rng: Rng) -> ImageCase:
    """Return 10, 12 or 14 bits in the highest of 16, in PNG, TIFF or FITS."""
    bits = int(rng.choice([10, 12, 14]))
    pixels = _mosaic(rng, bits)
    content = _written(rng, (pixels << (16 - bits)).astype(np.uint16))
    return ImageCase(f"{bits} bits in the highest of 16", content, pixels, bits)


def right_aligned(rng: Rng) -> ImageCase:
    """Return 10, 12 or 14 bits in the lowest of 16; two of the levels occur, or none of those between."""
    bits = int(rng.choice([10, 12, 14]))
    pixels = _mosaic(rng, bits)
    kind = rng.integers(3)
    if kind == 1:
        step = 2 ** (16 - bits)
        pixels = (pixels // step * step).astype(np.uint16)
    elif kind == 2:
        pixels = ((pixels > 2 ** (bits - 1)) * np.uint16(2 ** (bits - 1))).astype(np.uint16)
    what = f"{bits} bits in the lowest of 16, kind {kind}"
    return ImageCase(what, _written(rng, pixels), pixels, bits if kind == 0 else None)


def _written(rng: Rng, pixels: Pixels) -> bytes:
    kind, target = rng.integers(3), BytesIO()
    if kind == 0:
        return bytes(cv2.imencode(".png", pixels)[1])
    if kind == 1:
        tifffile.imwrite(target, pixels, metadata=None)
    else:
        fits.PrimaryHDU(pixels).writeto(target)
    return target.getvalue()


def fits_file(rng: Rng) -> ImageCase:
    """Return a FITS file: rows from the top or the bottom, of one plane, unsigned, of 8 to 32 bits."""
    bits = int(rng.choice([8, 16]))
    pixels = _mosaic(rng, bits)
    order = str(rng.choice(["TOP-DOWN", "BOTTOM-UP", "bottom_up", ""]))
    stored = pixels[::-1] if order.upper().startswith("BOTTOM") else pixels
    stored = stored.astype(rng.choice([stored.dtype, np.dtype(np.int32), np.dtype(np.float32)]))
    unit = fits.PrimaryHDU(stored.reshape(*np.ones(rng.integers(3), dtype=int), *stored.shape))
    if order:
        unit.header["ROWORDER"] = order
    target = BytesIO()
    unit.writeto(target)
    return ImageCase(f"FITS {stored.dtype} {unit.data.ndim} axes {order}", target.getvalue(), pixels)


def raw(rng: Rng) -> ImageCase:
    """Return a DNG, turned or not."""
    pixels, orientation = _mosaic(rng, 12), int(rng.choice([1, 3, 6, 8]))
    content = dng(pixels, str(rng.choice(["rggb", "bggr"])), orientation=orientation)
    return ImageCase(f"DNG, orientation {orientation}", content, pixels, 12, is_mosaic=True)


def thumbnail_first(rng: Rng) -> ImageCase:
    """Return a raw file as NEF and its kin are: a thumbnail first, the mosaic in another directory."""
    pixels = _mosaic(rng, 12, (400, 600))
    make = (("NIKON CORPORATION", "NIKON D3300"), ("SONY", "ILCE-7M3"), ("Canon", "Canon EOS 5D"))[rng.integers(3)]
    tags: list[tuple[Any, ...]] = [(271, "s", 0, make[0], True), (272, "s", 0, make[1], True)]
    mosaic_tags: list[tuple[Any, ...]] = [(33421, "H", 2, (2, 2), True), (33422, "B", 4, (0, 1, 1, 2), True)]
    target = BytesIO()
    with tifffile.TiffWriter(target) as writer:
        thumbnail = rng.integers(0, 255, (120, 160, 3)).astype(np.uint8)
        writer.write(
            thumbnail, photometric="rgb", subfiletype=1, subifds=int(rng.integers(2)), extratags=tags, metadata=None
        )
        writer.write(pixels, photometric=32803, extratags=mosaic_tags, metadata=None)
    return ImageCase(f"raw file of {make[1]}", target.getvalue(), pixels, may_refuse=True, is_mosaic=True)


CONTAINERS: tuple[Callable[[Rng], ImageCase], ...] = (
    png, jpeg, webp, heic, tiff, tiff, packed_tiff, left_aligned, right_aligned, fits_file, raw, thumbnail_first
)  # fmt: skip


def random_case(rng: Rng) -> ImageCase:
    """Return an image in some container."""
    return CONTAINERS[rng.integers(len(CONTAINERS))](rng)
