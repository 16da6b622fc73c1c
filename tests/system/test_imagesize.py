"""Images too large for the memory are refused by their header, before a pixel is decoded."""

import struct
import zlib
from pathlib import Path

import cv2
import numpy as np
import pytest
import tifffile
from typer.testing import CliRunner

from glstar.calibrate.photo.photograph import read_image
from glstar.camera.camerafile import camera_to_yaml
from glstar.camera.model import Camera
from glstar.cli import app
from glstar.errors import CalibrationError, ImagesError
from glstar.images import read_grey
from glstar.system.imagefiles import image_size, size_error

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
    assert size_error(path.read_bytes()) is None


@pytest.mark.parametrize("byteorder", ["<", ">"])
@pytest.mark.parametrize("bigtiff", [False, True])
def test_the_size_of_any_kind_of_tiff_is_read(tmp_path: Path, byteorder: str, bigtiff: bool) -> None:
    path = tmp_path / "sky.tiff"
    tifffile.imwrite(path, np.zeros((48, 64), np.uint16), byteorder=byteorder, bigtiff=bigtiff)
    assert image_size(path.read_bytes()) == (64, 48)


@pytest.mark.parametrize("content", [b"", b"\x89PNG\r\n\x1a\n", b"\xff\xd8\xff\xe0", b"II*\0", b"BM", b"no image"])
def test_a_damaged_header_gives_no_size(content: bytes) -> None:
    assert image_size(content) is None


def test_the_largest_sensors_are_within_the_limit() -> None:
    assert size_error(png(14204, 10652)) is None


@pytest.mark.parametrize("suffix", FORMATS)
def test_an_image_too_large_is_refused_before_it_is_decoded(
    tmp_path: Path, suffix: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / f"huge{suffix}"
    path.write_bytes(FORMATS[suffix](*HUGE))
    for decoder in ("imdecode", "imread"):
        monkeypatch.setattr(cv2, decoder, lambda *_: pytest.fail("the image was decoded"))
    message = "is 32000 x 32000 px, 1024 megapixels; glstar reads images of up to 200 megapixels"

    with pytest.raises(CalibrationError, match=message):
        read_image(path)
    with pytest.raises(ImagesError, match=message):
        read_grey(path)


@pytest.mark.parametrize(
    "command",
    [
        ("calibrate", "IMAGE", "--fov", "60", "--exposure", "1", "-o", "OUT.toml"),
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
