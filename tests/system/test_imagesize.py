"""Images too large for the memory are refused by their header, before a pixel is decoded."""

import struct
import tracemalloc
import zlib
from io import BytesIO
from pathlib import Path

import cv2
import numpy as np
import pytest
import tifffile
from typer.testing import CliRunner

from glstar.calibrate.photo.photograph import read_image
from glstar.camera.camerafile import camera_to_yaml
from glstar.camera.model import Camera
from glstar.camera.photofile import Exif, decode_photo, exif_of
from glstar.camera.sensor import pixelpattern
from glstar.camera.sensor.pixelpattern import read_map
from glstar.cli import app
from glstar.errors import CalibrationError, ConfigError, ImagesError
from glstar.images import read_grey
from glstar.system.imagefiles import encode_png, image_size, tiff_directories
from glstar.system.userinput import FewReads, refuse_many_pixels

HUGE = (32000, 32000)


def png(width: int, height: int) -> bytes:
    """Return a PNG with a header of any size and a few pixels."""

    def chunk(kind: bytes, body: bytes) -> bytes:
        return struct.pack(">I", len(body)) + kind + body + struct.pack(">I", zlib.crc32(kind + body))

    header = struct.pack(">IIBBBBB", width, height, 8, 0, 0, 0, 0)
    pixels = zlib.compress(bytes(1 << 16))
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header) + chunk(b"IDAT", pixels) + chunk(b"IEND", b"")


def jpeg(width: int, height: int) -> bytes:
    """Return a JPEG whose frame header says it has another size."""
    content = bytearray(cv2.imencode(".jpg", np.zeros((16, 16), np.uint8))[1].tobytes())
    frame = content.index(b"\xff\xc0")
    content[frame + 5 : frame + 9] = struct.pack(">HH", height, width)
    return bytes(content)


def tiff(width: int, height: int) -> bytes:
    """Return a TIFF of one strip that says it has another size."""
    tags = [(256, 4, width), (257, 4, height), (258, 3, 8), (259, 3, 1), (262, 3, 1), (273, 4, 200)]
    tags += [(277, 3, 1), (278, 4, height), (279, 4, 64)]
    body = b"".join(struct.pack("<HHII", code, kind, 1, value) for code, kind, value in tags)
    head = b"II*\0" + struct.pack("<IH", 8, len(tags)) + body + bytes(4)
    return head.ljust(200, b"\0") + bytes(64)


FORMATS = {".png": png, ".jpg": jpeg, ".tiff": tiff}


@pytest.mark.parametrize("suffix", FORMATS)
def test_the_size_of_an_image_is_read_from_its_header(suffix: str) -> None:
    assert image_size(FORMATS[suffix](*HUGE)) == HUGE
    assert image_size(FORMATS[suffix](1280, 960)) == (1280, 960)


@pytest.mark.parametrize("suffix", [".png", ".jpg", ".tiff", ".bmp"])
def test_the_size_in_the_header_is_that_of_the_decoded_image(tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"sky{suffix}"
    pixels = np.random.default_rng(1).integers(0, 255, (48, 64, 3), dtype=np.uint8)
    if suffix == ".tiff":
        tifffile.imwrite(path, pixels)
    else:
        cv2.imwrite(str(path), pixels)
    assert image_size(path.read_bytes()) == (64, 48)


@pytest.mark.parametrize("byteorder", ["<", ">"])
@pytest.mark.parametrize("bigtiff", [False, True])
def test_the_size_of_any_kind_of_tiff_is_read(tmp_path: Path, byteorder: str, bigtiff: bool) -> None:
    path = tmp_path / "sky.tiff"
    tifffile.imwrite(path, np.zeros((48, 64), np.uint16), byteorder=byteorder, bigtiff=bigtiff)
    assert image_size(path.read_bytes()) == (64, 48)


# The first directory of a BigTIFF, and directories below others, may be said to lie beyond any file.
BEYOND = b"II+\0\x08\0\0\0" + b"\xff" * 8
SUB_BEYOND = struct.pack("<2sHIHHHIII", b"II", 42, 8, 1, 330, 16, 1, 26, 0) + b"\xff" * 8


@pytest.mark.parametrize(
    "content",
    [b"", b"\x89PNG\r\n\x1a\n", b"\xff\xd8\xff\xe0", b"II*\0", b"BM", b"no image", BEYOND, SUB_BEYOND],
)
def test_a_damaged_header_gives_no_size(content: bytes) -> None:
    assert image_size(content) is None
    assert all(330 in directory for directory in tiff_directories(content))


def test_the_largest_sensors_are_within_the_limit() -> None:
    refuse_many_pixels(*image_size(png(14204, 10652)))


@pytest.mark.parametrize("suffix", FORMATS)
def test_an_image_too_large_is_refused_before_it_is_decoded(
    tmp_path: Path, suffix: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / f"huge{suffix}"
    path.write_bytes(FORMATS[suffix](*HUGE))
    for decoder in ("imdecode", "imread"):
        monkeypatch.setattr(cv2, decoder, lambda *_: pytest.fail("the image was decoded"))
    message = "is 32000 x 32000 px, 1024 megapixels; glstar reads up to 200 megapixels"

    with pytest.raises(CalibrationError, match=message):
        read_image(path)
    with pytest.raises(ImagesError, match=message):
        read_grey(path)


@pytest.mark.parametrize(
    "command",
    [
        ("camera", "calibrate", "IMAGE", "--fov", "60", "--exposure", "1", "-o", "OUT.toml"),
        ("camera", "rectify", "IMAGE", "-c", "CAMERA", "-o", "OUT.png"),
    ],
    ids=["calibrate", "rectify"],
)
def test_a_command_refuses_it_in_one_line(tmp_path: Path, command: tuple[str, ...]) -> None:
    (tmp_path / "huge.png").write_bytes(png(*HUGE))
    camera = Camera(*HUGE, 9e3, 9e3, 16e3, 16e3)
    (tmp_path / "camera.yaml").write_text(camera_to_yaml(camera, "For a test."), encoding="utf-8")
    files = {"IMAGE": "huge.png", "CAMERA": "camera.yaml", "OUT.toml": "out.toml", "OUT.png": "out.png"}

    result = CliRunner().invoke(app, [str(tmp_path / files[word]) if word in files else word for word in command])

    assert result.exit_code == 1, result.output
    assert "1024 megapixels" in result.stderr
    assert result.stderr.count("\n") == 1
    assert not list(tmp_path.glob("out.*"))


def fits(pixels: np.ndarray) -> bytes:
    """Return a FITS file of unsigned numbers of 16 bits."""
    cards = ["SIMPLE  = T", "BITPIX  = 16", "NAXIS   = 2", f"NAXIS1  = {pixels.shape[1]}", f"NAXIS2  = {len(pixels)}"]
    header = "".join(f"{card:80}" for card in [*cards, "END"]).encode().ljust(2880)
    return header + pixels.astype(">i2").tobytes().ljust(2880 * 5, b"\0")


def sized(suffix: str, channels: int = 3, options: tuple[int, ...] = ()) -> bytes:
    """Return an image of 64 x 48 px of any format that OpenCV writes."""
    floats = suffix in {".pfm", ".hdr"}
    shape = (48, 64) if channels == 1 else (48, 64, channels)
    pixels = np.random.default_rng(1).integers(0, 255, shape, dtype=np.uint8)
    written, content = cv2.imencode(suffix, pixels.astype(np.float32) if floats else pixels, options)
    assert written
    return content.tobytes()


OTHER_FORMATS = {
    "lossless WebP": sized(".webp"),
    "lossy WebP": sized(".webp", options=(cv2.IMWRITE_WEBP_QUALITY, 50)),
    "WebP with opacity": sized(".webp", 4, (cv2.IMWRITE_WEBP_QUALITY, 50)),
    "JPEG 2000": sized(".jp2"),
    "GIF": sized(".gif"),
    "PPM": sized(".ppm"),
    "PGM with a comment": b"P5 # by hand\n64\n# 9 9\n48 255\n" + bytes(48 * 64),
    "PAM": sized(".pam"),
    "PFM": sized(".pfm"),
    "Radiance": sized(".hdr"),
    "Sun raster": sized(".ras"),
    "BMP": sized(".bmp"),
}


@pytest.mark.parametrize("name", OTHER_FORMATS)
def test_every_format_is_refused_by_its_header_if_it_is_above_the_limit(
    tmp_path: Path, name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    content = OTHER_FORMATS[name]
    assert image_size(content) == (64, 48)
    (tmp_path / "sky").write_bytes(content)
    decode_photo(content, floats=True)

    monkeypatch.setenv("GLSTAR_MAX_MEGAPIXELS", "0.003")
    monkeypatch.setattr(cv2, "imdecode", lambda *_: pytest.fail("the image was decoded"))

    message = r"is 64 x 48 px, 0.003072 megapixels; glstar reads up to 0.003 megapixels \(GLSTAR_MAX_MEGAPIXELS raises"
    with pytest.raises(ImagesError, match=message):
        read_grey(tmp_path / "sky")


@pytest.mark.parametrize("length", [0xFFFFFFFF, 1 << 20])
def test_a_png_with_a_chunk_longer_than_the_file_is_not_decoded(monkeypatch: pytest.MonkeyPatch, length: int) -> None:
    monkeypatch.setattr(cv2, "imdecode", lambda *_: pytest.fail("the image was decoded"))
    content = encode_png(np.zeros((48, 64), np.uint8))
    at = content.index(b"IDAT") - 4

    with pytest.raises(ValueError, match="is a PNG that is cut off or damaged"):
        decode_photo(content[:at] + struct.pack(">I", length) + content[at + 4 :])


def test_an_image_of_unknown_size_is_not_decoded(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(cv2, "imdecode", lambda *_: pytest.fail("the image was decoded"))

    with pytest.raises(ValueError, match="is no image that can be read"):
        decode_photo(b"RIFF\0\0\0\0WEBPANIM" + bytes(64))


@pytest.mark.parametrize("suffix", [".npy", ".fits", ".png"])
def test_a_map_is_refused_by_its_header_if_it_is_above_the_limit(
    tmp_path: Path, suffix: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / f"flat{suffix}"
    pixels = np.ones((48, 64), np.uint16)
    if suffix == ".npy":
        np.save(path, pixels)
    else:
        path.write_bytes(encode_png(pixels) if suffix == ".png" else fits(pixels))
    assert read_map(str(path)).shape == (48, 64)

    monkeypatch.setenv("GLSTAR_MAX_MEGAPIXELS", "0.003")
    read_map_again = pixelpattern._read_map.__wrapped__
    monkeypatch.setattr(pixelpattern, "_read_map", read_map_again)

    with pytest.raises(ConfigError, match=r"flat\.\w+: .*is 64 x 48 px, 0.003072 megapixels"):
        read_map(str(path))


def test_a_map_that_declares_more_than_it_holds_takes_no_memory(tmp_path: Path) -> None:
    header = b"{'descr': '<f8', 'fortran_order': False, 'shape': (10000, 10000)}".ljust(117) + b"\n"
    (tmp_path / "flat.npy").write_bytes(b"\x93NUMPY\1\0" + struct.pack("<H", len(header)) + header + bytes(64))

    tracemalloc.start()
    with pytest.raises(ConfigError, match=r"flat\.npy: it is damaged or cut off"):
        read_map(str(tmp_path / "flat.npy"))
    assert tracemalloc.get_traced_memory()[1] < 1_000_000
    tracemalloc.stop()


@pytest.mark.parametrize(
    "axes", ["NAXIS1  = 64", "NAXIS2  = 48", "NAXIS1  = 64\nNAXIS2  = 0", "NAXIS1  = -1\nNAXIS2  = 9"]
)
def test_a_fits_without_pixels_is_refused(tmp_path: Path, axes: str) -> None:
    cards = ["SIMPLE  = T", "BITPIX  = 16", "NAXIS   = 2", *axes.split("\n"), "END"]
    (tmp_path / "flat.fits").write_bytes("".join(f"{card:80}" for card in cards).encode().ljust(2880) + bytes(2880))

    with pytest.raises(
        ConfigError, match=r"flat\.fits: its (first unit with data is not an image|image has no pixels)"
    ):
        read_map(str(tmp_path / "flat.fits"))


def test_a_limit_that_is_no_number_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("GLSTAR_MAX_MEGAPIXELS", "many")

    with pytest.raises(ValueError, match="the environment variable GLSTAR_MAX_MEGAPIXELS is 'many', not a number"):
        refuse_many_pixels(1, 1)


def test_exif_with_thousands_of_tags_is_none() -> None:
    # A directory of 65535 tags, all of one byte.
    directory = struct.pack("<H", 0xFFFF) + struct.pack("<HHII", 256, 1, 1, 0) * 0xFFFF
    content = b"II*\0" + struct.pack("<I", 8) + directory
    file = FewReads(BytesIO(content))

    assert exif_of(BytesIO(content)) == Exif()
    assert [file.read(1) for _ in range(10_000)] == [content[k : k + 1] for k in range(10_000)]
    with pytest.raises(ValueError, match="has too many records in its header"):
        file.read(1)
    assert file.seek(0) == 0
