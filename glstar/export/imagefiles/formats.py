"""Image files and videos: encoding, decoding, and the detection of damaged files."""

import os
import struct
import sys
import zlib
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from fractions import Fraction
from importlib.util import find_spec
from io import BytesIO
from pathlib import Path
from types import TracebackType
from typing import Any, Literal, Self

import cv2
import numpy as np
import tifffile
from zlib_ng import zlib_ng

from glstar.camera.exposure import Exposure
from glstar.camera.photofile import MAX_SAMPLE_VALUE, as_digital_numbers, stated_shift_bits
from glstar.camera.sensor.sensor import Sensor
from glstar.errors import ConfigError, ExportError
from glstar.export.directory import explain_disk_errors
from glstar.export.imagefiles.fits import FITS_START, damage_of_fits, decode_fits
from glstar.export.imagefiles.processing import CameraProcessing, encode_jpeg, to_8_bits
from glstar.render.effects import scaled_keys
from glstar.system.files import TEMPORARY, make_directory, publish
from glstar.system.imagefiles import PNG_SIGNATURE, encode_png, image_size
from glstar.system.userinput import refuse_many_pixels

# Suffixes of videos.
VIDEOS = (".webm", ".mp4")
# Encoders of PyAV by suffix, with their options: quality instead of a bit rate, and speed, for the window waits.
_ENCODERS = {
    ".webm": ("libvpx-vp9", {"deadline": "realtime", "cpu-used": "8", "row-mt": "1", "crf": "28", "b": "0"}),
    ".mp4": ("libx264", {"preset": "veryfast", "crf": "20"}),
}
# Codes of OpenCV's encoders by suffix.
_FOUR_CC = {".webm": "VP90", ".mp4": "mp4v"}


class VideoFile:
    """A video that is being written; a context manager, which discards the video unless `finish` was called.

    `path`: .webm has VP9, which browsers and notebooks play; .mp4 has H.264 with PyAV, which they play too, and
    MPEG-4 part 2 without it, which they do not.  `width_px`, `height_px`: size of the pictures; the codecs need even
    sides: of an odd side, the video omits the last row or column; `frames_per_s`: frame rate, 1/s.  `count`: number of
    frames written.  Raises ExportError if the video cannot be written.
    """

    def __init__(self, path: Path, width_px: int, height_px: int, frames_per_s: float) -> None:
        if path.suffix.lower() not in VIDEOS:
            raise ExportError(path, f"is no name for a video; it must end with {' or '.join(VIDEOS)}")
        if min(width_px, height_px) < 2:
            raise ExportError(path, f"would have pictures of {width_px} x {height_px} px, and a video needs 2 x 2")
        self.path, self.count = path, 0
        self._size = width_px - width_px % 2, height_px - height_px % 2
        self._temporary = path.with_name(f"{TEMPORARY}{path.name}")
        self._writer: _PyAVWriter | _OpenCVWriter | None = None
        with explain_disk_errors(path):
            make_directory(path.parent)
            # Create the file exclusively: the codec would follow a link of this name, and it reports no reason when it
            # cannot write.
            self._temporary.unlink(missing_ok=True)
            self._temporary.open("xb").close()
        try:
            writer = _PyAVWriter if is_pyav_installed() else _OpenCVWriter
            self._writer = writer(self._temporary, self._size, frames_per_s)
        except ValueError as error:
            self.discard()
            raise ExportError(path, f"cannot be encoded at {frames_per_s:g} frames/s: {error}") from error

    def write(self, picture: np.ndarray[Any, np.dtype[np.uint8]]) -> None:
        """Add a frame; `picture` (height, width) or (height, width, 3) uint8: grey, or blue, green, red."""
        assert self._writer is not None
        width_px, height_px = self._size
        cut = np.ascontiguousarray(picture[:height_px, :width_px])
        self._writer.write(cut if cut.ndim == 3 else cv2.cvtColor(cut, cv2.COLOR_GRAY2BGR))
        self.count += 1

    def finish(self) -> None:
        """Complete the video and give the file its name.

        Raises ExportError if it cannot be read back with all its frames.
        """
        assert self._writer is not None
        try:
            with explain_disk_errors(self.path):
                self._writer.release()
            if _count_frames(self._temporary) != self.count or not self.count:
                raise ExportError(self.path, "could not be written completely; is the disk full?")
            with explain_disk_errors(self.path):
                publish(self._temporary, self.path)
        finally:
            self.discard()

    def discard(self) -> None:
        """Remove what has been written, unless it is complete."""
        if self._writer is not None:
            with suppress(OSError):
                self._writer.release()
        self._temporary.unlink(missing_ok=True)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.discard()


def is_pyav_installed() -> bool:
    """Return whether PyAV is, the extra ``film``: its encoders write H.264, and VP9 ten times as fast as OpenCV's."""
    return find_spec("av") is not None


@contextmanager
def _silent_libraries() -> Iterator[None]:
    """Suppress what C libraries write to standard error: FFmpeg remarks on each WebM that its tag is another one."""
    sys.stderr.flush()
    before = os.dup(2)
    try:
        with open(os.devnull, "wb") as nowhere:  # noqa: PTH123 - a device
            os.dup2(nowhere.fileno(), 2)
        yield
    finally:
        os.dup2(before, 2)
        os.close(before)


class _OpenCVWriter:
    """Encodes a video of pictures of a size, px, with OpenCV; raises ValueError if it has no encoder."""

    def __init__(self, path: Path, size_px: tuple[int, int], frames_per_s: float) -> None:
        codec = cv2.VideoWriter.fourcc(*_FOUR_CC[path.suffix.lower()])
        with _silent_libraries():
            self._writer = cv2.VideoWriter(str(path), codec, frames_per_s, size_px, isColor=True)
        if not self._writer.isOpened():
            raise ValueError("OpenCV has no encoder for it")

    def write(self, picture: np.ndarray[Any, np.dtype[np.uint8]]) -> None:
        self._writer.write(picture)

    def release(self) -> None:
        self._writer.release()


class _PyAVWriter:
    """Encodes a video of pictures of a size, px, with PyAV; raises ValueError if it has no encoder."""

    def __init__(self, path: Path, size_px: tuple[int, int], frames_per_s: float) -> None:
        import av  # noqa: PLC0415 - an extra

        codec, options = _ENCODERS[path.suffix.lower()]
        self._av, self._is_open = av, True
        # The index before the frames: a browser shows the first before it has the last.
        self._file = av.open(str(path), "w", options={"movflags": "faststart"} if path.suffix.lower() == ".mp4" else {})
        try:
            self._stream = self._file.add_stream(codec, rate=Fraction(frames_per_s).limit_denominator(1000))
            self._stream.width, self._stream.height = size_px
            self._stream.pix_fmt, self._stream.options = "yuv420p", options
        except (ValueError, av.FFmpegError) as error:
            self._file.close()
            raise ValueError(str(error)) from error

    def write(self, picture: np.ndarray[Any, np.dtype[np.uint8]]) -> None:
        frame = self._av.VideoFrame.from_ndarray(picture, format="bgr24")
        self._file.mux(self._stream.encode(frame))

    def release(self) -> None:
        if self._is_open:
            self._is_open = False
            try:
                self._file.mux(self._stream.encode(None))
            finally:
                self._file.close()


def _count_frames(path: Path) -> int:
    """Return the number of frames of a video that can be read back; the encoder reports no errors."""
    reader = cv2.VideoCapture(str(path))
    try:
        count = 0
        while reader.grab():
            count += 1
        return count
    finally:
        reader.release()


ImageFormat = Literal["png", "png16", "tiff", "fits", "jpeg"]

_PNG_HEADER = struct.Struct(">IIB")  # width, height, bits
_PNG_END = b"\0\0\0\0IEND\xae\x42\x60\x82"
_JPEG_START = b"\xff\xd8"
_JPEG_END = b"\xff\xd9"
# Bytes read to find the header and directory of a TIFF written by tifffile.
_TIFF_START = 1024
# Position of the colour type in a PNG, and its value for red, green and blue.
_PNG_COLOUR_TYPE, _PNG_RGB = 25, 2
# The last bytes of a TIFF with EXIF, which lies after its pixels.
EXIF_END = b"glstar EXIF\0"
_EXIF_IFD = 0x8769
_TIFF_SHORT, _STRIP_OFFSETS, _STRIP_BYTE_COUNTS = 3, 273, 279
SUFFIX: dict[ImageFormat, str] = {
    "png": ".png",
    "png16": ".png",
    "tiff": ".tiff",
    "fits": ".fits",
    "jpeg": ".jpg",
}


def encode(
    pixels: np.ndarray[Any, Any], image_format: ImageFormat, *, jpeg_quality: int = 93, shift_bits: int = 0
) -> bytes:
    """Return an image as the bytes of its file, except FITS, which needs a scene.

    `pixels` (height, width), or (height, width, 3) red, green and blue, uint8 or uint16, are digital numbers. All
    formats but JPEG are lossless. `shift_bits` says by how many bits the numbers are shifted up in a file of 16 bits,
    which states it; `decode` undoes it.
    """
    if image_format == "jpeg":
        return encode_jpeg(pixels, jpeg_quality)
    if image_format == "tiff":
        return tiff(pixels.astype(np.uint16, copy=False), shift_bits=shift_bits)
    if pixels.ndim == 3:
        return encode_png(pixels)
    if shift_bits:
        return encode_png(pixels.astype(np.uint16) << shift_bits, significant_bits=16 - shift_bits)
    pixel_type = np.uint16 if image_format == "png16" else np.uint8
    return encode_png(pixels.astype(pixel_type, copy=False))


def fit_format(image_format: ImageFormat | None, sensor: Sensor, *, summed: int = 1) -> tuple[ImageFormat, Sensor]:
    """Return an image format for the sensor, and the sensor with the bit depth of that format.

    The format of None is 8-bit PNG, or 16-bit PNG if the sensor has more than 8 bits. A sensor of at most 8 bits gets
    16 in a 16-bit format, and its full scale stays full scale; the sensor of a sum of short exposures (`summed` is
    `Exposure.signal_factor`) keeps its bits. Raises ConfigError if the sensor, or the sum, has more bits than the
    format.
    """
    if summed > 1:
        return _fit_sum(image_format, sensor, summed), sensor
    if CameraProcessing.of(sensor).is_active:  # which makes 8 or 16 bits of any number
        return image_format or "png", sensor
    if image_format is None:
        return ("png" if sensor.bit_depth <= 8 else "png16"), sensor
    if image_format in {"png", "jpeg"} and sensor.bit_depth > 8:
        raise ConfigError(
            f"a sensor of {sensor.bit_depth} bits does not fit into 8-bit {image_format.upper()}; use --format png16,"
            ' tiff or fits, or [output] process = "isp"',
            key="sensor.bit_depth",
        )
    if image_format not in {"png", "jpeg"} and sensor.bit_depth <= 8:
        return image_format, sensor.with_bit_depth(16, scaled_keys())
    return image_format, sensor


def _fit_sum(image_format: ImageFormat | None, sensor: Sensor, summed: int) -> ImageFormat:
    """Return the format of sums of short exposures; raise if they do not fit."""
    if CameraProcessing.of(sensor).is_active:
        raise ConfigError(
            'adds raw images, which [output] process cannot develop afterwards; use exposure.stack = "mean"',
            key="exposure.stack",
        )
    Exposure(0.0, 1.0, frames=summed).full_scale_dn(sensor.saturation_dn)  # raises if it does not fit into 16 bits
    if image_format in {"png", "jpeg"}:
        raise ConfigError(
            f"adds {summed} exposures, which do not fit into 8-bit {image_format.upper()}; use --format png16, tiff or"
            ' fits, or exposure.stack = "mean"',
            key="exposure.stack",
        )
    return image_format or "png16"


def tiff(
    pixels: np.ndarray[Any, Any],
    *,
    date_time: str | None = None,
    tags: Sequence[tuple[int, int]] = (),
    shift_bits: int = 0,
) -> bytes:
    """Return an array as an uncompressed TIFF, without a date, so that equal pixels give equal bytes.

    `pixels` are (height, width) or (height, width, 3), uint16 or float32; `date_time` is such as "2024:03:10 11:00:00";
    `tags` are further tags, each with a number of 32 bits. The tag MaxSampleValue states by how many bits uint16 is
    shifted up.
    """
    target = BytesIO()
    photometric = "rgb" if pixels.ndim == 3 else "minisblack"
    more = [(tag, "I", 1, number, True) for tag, number in tags]
    if shift_bits:
        pixels = pixels << shift_bits
        more.append((MAX_SAMPLE_VALUE, "H", 1, (0xFFFF >> shift_bits) << shift_bits, True))
    tifffile.imwrite(
        target, pixels, photometric=photometric, metadata=None, software="glstar", datetime=date_time, extratags=more
    )
    return target.getvalue()


def find_damage(path: Path) -> str:
    """Return a message on the damage of an image file, judged by its size, beginning and end without decoding it.

    It finds such damage as a power failure or a full disk leaves in a PNG, TIFF or FITS file that glstar wrote; empty
    if there is none. Raises OSError if it cannot be read.
    """
    with path.open("rb", buffering=0) as file:
        size = os.fstat(file.fileno()).st_size
        start = file.read(FITS_START if path.suffix == SUFFIX["fits"] else _TIFF_START)
        file.seek(-min(size, len(_PNG_END)), os.SEEK_END)
        return _damage(path.suffix, size, start, file.read())


def _damage(suffix: str, size: int, start: bytes, end: bytes) -> str:
    if not size:
        return "is empty (0 bytes)"
    if not any(start):
        return "begins with zeros"
    if suffix in {SUFFIX["tiff"], SUFFIX["fits"]}:
        return _damage_of_tiff(start, size, end) if suffix == SUFFIX["tiff"] else damage_of_fits(start, size)
    signature, ending = (_JPEG_START, _JPEG_END) if suffix == SUFFIX["jpeg"] else (PNG_SIGNATURE, _PNG_END)
    kind = "JPEG" if suffix == SUFFIX["jpeg"] else "PNG"
    if not start.startswith(signature):
        return f"does not begin as a {kind}"
    last = "IEND" if kind == "PNG" else "EOI"
    return "" if end.endswith(ending) else f"is cut short or damaged: no {last} at the end of its {size} bytes"


def _damage_of_tiff(start: bytes, size: int, file_end: bytes) -> str:
    """Return a message on the damage of a little-endian TIFF with one strip, whose directory precedes its pixels."""
    if not start.startswith(b"II*\0"):
        return "does not begin as a TIFF"
    values: dict[int, int] = {}
    with suppress(struct.error):
        (directory,) = struct.unpack_from("<I", start, 4)
        (entries,) = struct.unpack_from("<H", start, directory)
        for entry in range(entries):
            tag, kind, _, value = struct.unpack_from("<HHII", start, directory + 2 + 12 * entry)
            values[tag] = value & 0xFFFF if kind == _TIFF_SHORT else value
    if not values.keys() >= {_STRIP_OFFSETS, _STRIP_BYTE_COUNTS}:
        return "has a damaged TIFF directory"
    end = values[_STRIP_OFFSETS] + values[_STRIP_BYTE_COUNTS]
    if size < end:
        return f"is cut short: {size} of {end} bytes"
    return "is cut short or damaged: no end of its EXIF" if _EXIF_IFD in values and file_end != EXIF_END else ""


def decode(content: bytes, suffix: str) -> np.ndarray[Any, Any]:
    """Decode an image that glstar wrote, and verify all its checksums.

    Returns (height, width) or (height, width, 3) uint8, uint16 or float32; numbers that ``[output] align`` has shifted
    up are shifted back. Raises ValueError if it is damaged; the message continues "FILE: ".
    """
    if damage := _damage(suffix, len(content), content[:FITS_START], content[-len(_PNG_END) :]):
        raise ValueError(damage)
    if (size_px := image_size(content)) is not None:
        refuse_many_pixels(*size_px)
    if suffix == SUFFIX["fits"]:
        return decode_fits(content)
    if suffix == SUFFIX["jpeg"] or (suffix == SUFFIX["png"] and content[_PNG_COLOUR_TYPE] == _PNG_RGB):
        return _decode_by_opencv(content)
    if suffix == ".tiff":
        try:
            pixels = np.asarray(tifffile.imread(BytesIO(content)))
        except Exception as error:  # tifffile may raise anything for damaged bytes
            raise ValueError(f"cannot be decoded ({error})") from error
    else:
        pixels = _decode_png(content)
    return as_digital_numbers(pixels, stated_shift_bits(content))


def _decode_by_opencv(content: bytes) -> np.ndarray[Any, Any]:
    pixels = cv2.imdecode(np.frombuffer(content, np.uint8), cv2.IMREAD_UNCHANGED)
    if pixels is None:
        raise ValueError("cannot be decoded")
    return np.asarray(pixels if pixels.ndim == 2 else cv2.cvtColor(pixels, cv2.COLOR_BGR2RGB))


def _decode_png(content: bytes) -> np.ndarray[Any, Any]:
    at, deflated = len(PNG_SIGNATURE), b""
    width_px = height_px = bits = 0
    while at < len(content):
        length = int.from_bytes(content[at : at + 4])
        kind, data = content[at + 4 : at + 8], content[at + 8 : at + 8 + length]
        if content[at + 8 + length : at + 12 + length] != struct.pack(">I", zlib_ng.crc32(data, zlib_ng.crc32(kind))):
            raise ValueError(f"is damaged: a wrong checksum in its chunk at byte {at}")
        if kind == b"IHDR" and length >= _PNG_HEADER.size:
            width_px, height_px, bits = _PNG_HEADER.unpack_from(data)
        deflated += data if kind == b"IDAT" else b""
        at += 12 + length
    size = height_px * (1 + width_px * bits // 8)
    refuse_many_pixels(width_px, height_px)
    rows = np.frombuffer(_inflated(deflated, size), np.uint8)
    if bits not in {8, 16} or not size or rows.size != size:
        raise ValueError("is no PNG of glstar")
    rows = rows.reshape(height_px, -1)
    if rows[:, 0].any():
        raise ValueError("is no PNG of glstar: its rows are filtered")
    pixels = np.ascontiguousarray(rows[:, 1:])
    return pixels.view(">u2").astype(np.uint16) if bits == 16 else pixels


def _inflated(deflated: bytes, size: int) -> bytes:
    """Return up to one byte more than `size`."""
    inflater = zlib.decompressobj()
    try:
        content = inflater.decompress(deflated, size + 1)
    except zlib.error as error:
        raise ValueError(f"cannot be decoded ({error})") from error
    if not inflater.eof and len(content) <= size:
        raise ValueError("cannot be decoded (its data end too early)")
    return content


def write_video(images: list[Path], path: Path, *, frames_per_s: float, saturation_dn: int) -> None:
    """Write image files of one size as a video, atomically; `path` is that of a `VideoFile`.

    The digital number `saturation_dn` is shown as white. Raises ExportError if the video cannot be written.
    """
    if not images:
        raise ExportError(path, "no frame was drawn, and a video needs one")
    first = _eight_bits(images[0], saturation_dn)
    with VideoFile(path, first.shape[1], first.shape[0], frames_per_s) as video:
        for image in images:
            grey = _eight_bits(image, saturation_dn)
            if grey.shape != first.shape:
                raise ExportError(
                    image,
                    f"is {grey.shape[1]} x {grey.shape[0]} px and {images[0].name} {first.shape[1]} x {first.shape[0]}"
                    " px, and a video has frames of one size; leave out --video, or keep the camera's size out of the"
                    " sweep",
                )
            video.write(grey)
        video.finish()


def _eight_bits(path: Path, saturation_dn: int) -> np.ndarray[Any, np.dtype[np.uint8]]:
    # Not cv2.imread: on Windows it opens no path with letters outside the code page.
    content = path.read_bytes()
    pixels = cv2.imdecode(np.frombuffer(content, dtype=np.uint8), cv2.IMREAD_UNCHANGED)
    if pixels is None:
        raise ExportError(path, "is no image that can be read back for the video")
    pixels = as_digital_numbers(pixels, stated_shift_bits(content))
    full_scale = int(np.iinfo(pixels.dtype).max)
    if pixels.ndim == 3:  # processed, to the full scale of its type
        pixels, saturation_dn = cv2.cvtColor(pixels, cv2.COLOR_BGR2GRAY), full_scale
    saturation_dn = min(saturation_dn, full_scale)
    return to_8_bits(pixels, saturation_dn)
