"""Images of strangers: their pixels as the sensor read them, their bits and their EXIF, in every container."""

import struct
import sys
from contextlib import suppress
from io import BytesIO
from pathlib import Path

import cv2
import numpy as np
import piexif
import pytest
import tifffile
from astropy.io import fits
from PIL import Image
from typer.testing import CliRunner

from glstar.calibrate.photo.photograph import read_image
from glstar.camera.camerafile import camera_to_yaml
from glstar.camera.model import Camera
from glstar.camera.photofile import _is_cut_off, as_digital_numbers, has_image_signature, read_exif, stated_shift_bits
from glstar.cli import app
from glstar.errors import CalibrationError, ImagesError
from glstar.images.decoding import read_grey
from glstar.images.times import time_of
from tests.support import photofiles
from tests.support.dng import dng
from tests.support.photofiles import EXPOSURE_S, SITE_DEG, UTC_S, exif_block

LEVELS = np.arange(64 * 96, dtype=np.uint16).reshape(64, 96) % 4096


def saved(path: Path, content: bytes) -> Path:
    path.write_bytes(content)
    return path


@pytest.mark.parametrize("orientation", [1, 3, 6])
def test_all_readers_take_the_pixels_as_the_sensor_read_them(tmp_path: Path, orientation: int) -> None:
    pixels = np.zeros((64, 96), np.uint8)
    pixels[:8, :16] = 200
    path = tmp_path / "one.png"
    Image.fromarray(pixels).save(path, exif=exif_block(orientation))
    camera = saved(tmp_path / "c.yaml", camera_to_yaml(Camera(96, 64, 90.0, 90.0, 47.5, 31.5)).encode())

    image = read_image(path)
    rectified = CliRunner().invoke(
        app, ["camera", "rectify", str(path), "-c", str(camera), "-o", str(tmp_path / "r.png")]
    )

    np.testing.assert_array_equal(image.pixels_dn, pixels)
    np.testing.assert_array_equal(read_grey(path), pixels)
    assert rectified.exit_code == 0, rectified.output
    np.testing.assert_array_equal(cv2.imread(str(tmp_path / "r.png"), cv2.IMREAD_UNCHANGED), pixels)
    turned = f"EXIF turns the image for display (orientation {orientation}); pixels are as the sensor read them"
    assert image.notes == ((turned,) if orientation > 1 else ())
    assert (f"note: {turned}" in rectified.stderr) == (orientation > 1)


def test_bits_in_the_highest_of_sixteen_are_recognised_where_the_data_prove_it(tmp_path: Path) -> None:
    path = tmp_path / "one.tiff"
    tifffile.imwrite(path, (LEVELS << 4).astype(np.uint16))
    image = read_image(path)
    np.testing.assert_array_equal(image.pixels_dn, LEVELS)
    np.testing.assert_array_equal(read_grey(path), LEVELS)
    assert (image.bit_depth, image.notes) == (
        12,
        ("its numbers are multiples of 16: they are taken as 12 bits in the highest of 16",),
    )

    # Smaller numbers may be eight bits in the highest of twelve.
    tifffile.imwrite(path, (LEVELS % 256 << 4).astype(np.uint16))
    image = read_image(path)
    np.testing.assert_array_equal(image.pixels_dn, LEVELS % 256 << 4)
    assert image.notes == ("its numbers are multiples of 16 below 4096: they are taken as they are",)
    # A level or two prove nothing.
    tifffile.imwrite(path, ((LEVELS > 99) * 40000).astype(np.uint16))
    assert read_image(path).pixels_dn.max() == 40000


def test_the_bits_of_a_packed_tiff_are_those_that_it_states(tmp_path: Path) -> None:
    rng = np.random.default_rng(1)
    for _ in range(16):
        case = photofiles.packed_tiff(rng)
        image = read_image(saved(tmp_path / "one.tiff", case.content))
        np.testing.assert_array_equal(image.pixels_dn, case.grey)
        assert image.bit_depth == case.bits


@pytest.mark.parametrize(("order", "is_turned"), [("TOP-DOWN", False), ("BOTTOM-UP", True), (None, False)])
@pytest.mark.parametrize("planes", [False, True])
def test_rows_of_fits_begin_at_the_top(tmp_path: Path, order: str | None, is_turned: bool, planes: bool) -> None:
    stored = LEVELS[::-1] if is_turned else LEVELS
    unit = fits.PrimaryHDU(stored[np.newaxis] if planes else stored)
    if order is not None:
        unit.header["ROWORDER"] = order
    unit.writeto(tmp_path / "one.fits")

    np.testing.assert_array_equal(read_image(tmp_path / "one.fits").pixels_dn, LEVELS)
    np.testing.assert_array_equal(read_grey(tmp_path / "one.fits"), LEVELS)


def test_a_fits_file_of_three_planes_is_refused(tmp_path: Path) -> None:
    fits.PrimaryHDU(np.stack([LEVELS] * 3)).writeto(tmp_path / "rgb.fits")

    with pytest.raises(CalibrationError, match="not an image of one channel"):
        read_image(tmp_path / "rgb.fits")


def test_the_thumbnail_of_a_raw_file_is_never_read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = saved(tmp_path / "one.nef", photofiles.thumbnail_first(np.random.default_rng(0)).content)

    assert read_image(path, demosaiced=False).pixels_dn.shape == (400, 600)
    assert read_grey(path).shape == (400, 600)

    monkeypatch.setitem(sys.modules, "rawpy", None)
    with pytest.raises(CalibrationError, match=r"is a raw file of a camera, which needs rawpy: pip install .*\[raw\]"):
        read_image(path)
    with pytest.raises(ImagesError, match="is a raw file of a camera, which needs rawpy"):
        read_grey(path)


@pytest.mark.parametrize(
    "start", [b"FUJIFILMCCD-RAW 0201", b"IIRO\x08\0\0\0", b"IIU\0\x18\0\0\0", b"\0\0\0\x18ftypcrx \0\0\0\1"]
)
def test_a_raw_file_that_cannot_be_decoded_is_one_line_with_a_remedy(tmp_path: Path, start: bytes) -> None:
    path = saved(tmp_path / "one.raw", start + bytes(4000))

    assert has_image_signature(path.read_bytes()[:16])
    with pytest.raises(CalibrationError, match=r"is a raw file of a camera that cannot be decoded \(.*\); convert it"):
        read_image(path)


def test_a_tiff_with_a_thumbnail_first_is_read_at_its_full_size(tmp_path: Path) -> None:
    with tifffile.TiffWriter(tmp_path / "one.tiff") as writer:
        writer.write(np.full((12, 16), 99, np.uint8), subfiletype=1)
        writer.write(LEVELS)

    np.testing.assert_array_equal(read_grey(tmp_path / "one.tiff"), LEVELS)


@pytest.mark.parametrize("tag", [256, 257, 258, 277])
def test_a_tag_of_a_tiff_with_two_values_for_one_is_damage(tmp_path: Path, tag: int) -> None:
    """Widths, heights, bits and samples a pixel; the other reader of TIFF files decides."""
    path = tmp_path / "one.tiff"
    tifffile.imwrite(path, LEVELS)
    with tifffile.TiffFile(path) as tiff:
        at = tiff.pages[0].tags[tag].offset
    content = bytearray(path.read_bytes())
    content[at + 2 : at + 8] = struct.pack("<HI", 3, 2)  # two unsigned shorts
    path.write_bytes(content)

    pixels = None
    with suppress(CalibrationError):
        pixels = read_image(path).pixels_dn

    assert pixels is None or np.array_equal(pixels, LEVELS)


def test_white_is_zero_of_a_tiff_is_inverted(tmp_path: Path) -> None:
    tifffile.imwrite(tmp_path / "one.tiff", 65535 - LEVELS, photometric="miniswhite")

    np.testing.assert_array_equal(read_grey(tmp_path / "one.tiff"), LEVELS)


@pytest.mark.parametrize("container", [photofiles.heic, photofiles.webp, photofiles.jpeg, photofiles.png])
def test_exif_of_all_containers_is_read(tmp_path: Path, container) -> None:
    path = saved(tmp_path / "one", container(np.random.default_rng(2)).content)

    exif, time = read_exif(path), time_of(path)

    assert time is not None
    assert (time.utc_s, time.source, time.exposure_s) == (UTC_S, "EXIF, zone +10:30", EXPOSURE_S)
    assert (exif.utc_s, exif.exposure_s) == (UTC_S, EXPOSURE_S)
    assert exif.site_deg == pytest.approx(SITE_DEG)
    assert read_image(path).exposure_s == EXPOSURE_S


def test_exif_in_the_main_directory_of_a_dng_is_read(tmp_path: Path) -> None:
    tags = [(33434, "2I", 1, (1, 2), True), (36867, "s", 0, "2024:03:10 21:30:00", True)]
    path = saved(tmp_path / "pidng.dng", dng(LEVELS, extratags=[*tags, (36881, "s", 0, "+10:30", True)]))

    exif = read_exif(path)

    assert (exif.utc_s, exif.exposure_s) == (UTC_S, EXPOSURE_S)


@pytest.mark.parametrize(
    "gps",
    [
        {piexif.GPSIFD.GPSLatitudeRef: b"S", piexif.GPSIFD.GPSLatitude: ((34, 1), (0, 1), (0, 1))},
        {
            piexif.GPSIFD.GPSLatitudeRef: b"N",
            piexif.GPSIFD.GPSLatitude: ((0, 1), (0, 1), (0, 1)),
            piexif.GPSIFD.GPSLongitudeRef: b"E",
            piexif.GPSIFD.GPSLongitude: ((0, 1), (0, 1), (0, 1)),
        },
        {
            piexif.GPSIFD.GPSLatitudeRef: b"S",
            piexif.GPSIFD.GPSLatitude: ((34, 1), (0, 1), (0, 1)),
            piexif.GPSIFD.GPSLongitudeRef: b"E",
            piexif.GPSIFD.GPSLongitude: ((138, 1), (0, 1), (0, 1)),
            piexif.GPSIFD.GPSStatus: b"V",
        },
    ],
    ids=["no longitude", "zeros", "void"],
)
def test_a_place_without_a_fix_is_none(gps: dict[int, object], tmp_path: Path) -> None:
    target = BytesIO()
    Image.new("L", (64, 48)).save(target, "jpeg", exif=piexif.dump({"GPS": gps}))

    assert read_exif(saved(tmp_path / "one.jpg", target.getvalue())).site_deg is None


def test_random_images_are_right_or_refused() -> None:
    verdicts = [photofiles.verdict(photofiles.random_case(np.random.default_rng([6, k]))) for k in range(100)]

    assert [verdict for verdict in verdicts if verdict not in ("right", "refused")] == []


def test_significant_bits_of_a_png_are_those_of_its_one_channel() -> None:
    def png(*chunks: tuple[bytes, bytes]) -> bytes:
        parts = [struct.pack(">I", len(data)) + kind + data + bytes(4) for kind, data in chunks]
        return b"\x89PNG\r\n\x1a\n" + b"".join(parts)

    head, body = (b"IHDR", bytes(13)), (b"IDAT", b"\x0c")
    assert stated_shift_bits(png(head, (b"sBIT", b"\x0c"), body)) == 4
    assert stated_shift_bits(png(head, (b"sBIT", b"\x0c\x0c\x0c"), body)) == 0  # of colours
    assert stated_shift_bits(png(head, (b"tEXt", b"\x0c"), body)) == 0
    assert stated_shift_bits(png(head, (b"sBIT", b"\x00"), body)) == 0
    assert stated_shift_bits(png(head, (b"sBIT", b"\x11"), body)) == 0
    assert stated_shift_bits(png(head, body, (b"sBIT", b"\x0c"))) == 0


def test_shifted_numbers_are_moved_down_only_where_no_bit_is_lost() -> None:
    shifted = (LEVELS << 4).astype(np.uint16)
    np.testing.assert_array_equal(as_digital_numbers(shifted, 4), LEVELS)
    assert as_digital_numbers(shifted, 0) is shifted
    assert as_digital_numbers(shifted, 5) is shifted
    assert as_digital_numbers(LEVELS, 4) is LEVELS
    colours = np.stack([shifted] * 3, axis=-1)
    assert as_digital_numbers(colours, 4) is colours


@pytest.mark.parametrize(("tail", "is_cut"), [(b"", True), (b"\xff\xd9", False), (b"\xff\xd9" + bytes(500), False)])
def test_a_jpeg_without_an_end_after_its_last_scan_is_cut(tail: bytes, is_cut: bool) -> None:
    thumbnail = b"\xff\xda" + bytes(200) + b"\xff\xd9"
    assert _is_cut_off(b"\xff\xd8" + thumbnail + b"\xff\xda" + bytes(300) + tail) == is_cut
