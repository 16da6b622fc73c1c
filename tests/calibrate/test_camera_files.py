"""Photographs as DNG and HEIC, read by calibration and comparison."""

import sys
from pathlib import Path

import numpy as np
import piexif
import pillow_heif
import pytest
from PIL import Image

from glstar.calibrate.identify.hints import identify_near
from glstar.calibrate.photo.detection import detect_stars
from glstar.calibrate.photo.photograph import Channel, read_image
from glstar.calibrate.sensor.photontransfer import images_in
from glstar.camera.photofile import decode_photo, has_image_signature
from glstar.camera.sensor.sensor import Sensor
from glstar.errors import CalibrationError, ImagesError
from glstar.images.decoding import is_image, read_grey
from tests.support.dng import dng
from tests.support.starphotos import StarPhoto

COLOURS_DN = {"r": 1200, "g": 700, "b": 300}


def mosaic_of(pattern: str, height_px: int = 64, width_px: int = 96) -> np.ndarray:
    """Return the mosaic of an even colour."""
    cell = np.array([COLOURS_DN[colour] for colour in pattern], np.uint16).reshape(2, 2)
    return np.tile(cell, (height_px // 2, width_px // 2))


@pytest.mark.parametrize("pattern", ["rggb", "bggr", "grbg", "gbrg"])
def test_a_dng_keeps_the_colours_of_its_mosaic(tmp_path: Path, pattern: str) -> None:
    path = tmp_path / "one.dng"
    path.write_bytes(dng(mosaic_of(pattern), pattern))

    for channel, colour in (("red", "r"), ("green", "g"), ("blue", "b"), ("value", "r")):
        image = read_image(path, channel=channel)
        assert (image.pixels_dn == COLOURS_DN[colour]).all()
        assert (image.bit_depth, image.pixels_dn.shape) == (12, (64, 96))
    assert (read_grey(path) == COLOURS_DN["r"]).all()
    np.testing.assert_array_equal(read_image(path, demosaiced=False).pixels_dn, mosaic_of(pattern))
    assert [found.name for found in images_in(tmp_path)] == ["one.dng"]


def test_a_turned_dng_is_read_as_the_sensor_has_it(tmp_path: Path) -> None:
    raw, path = mosaic_of("rggb"), tmp_path / "turned.dng"
    raw[:20, :40] = 3000  # at the top left of the sensor
    path.write_bytes(dng(raw, orientation=6))  # to be turned to the right

    image = read_image(path, demosaiced=False)

    np.testing.assert_array_equal(image.pixels_dn, raw)
    assert image.notes == ("EXIF turns the image for display (orientation 6); pixels are as the sensor read them",)
    assert read_grey(path).shape == (64, 96)


def test_stars_of_a_dng_give_the_camera(tmp_path: Path) -> None:
    photo = StarPhoto.of(
        Sensor(reference_peak_dn=30000.0, psf_sigma_px=1.4, sky_mean_dn=200.0, sky_std_dn=8.0, bit_depth=12)
    )
    path = tmp_path / "stars.dng"
    path.write_bytes(dng(photo.image.pixels_dn))

    image = read_image(path, channel="green")
    stars = detect_stars(image)
    matches = identify_near(stars, photo.reference, photo.solution)

    assert abs(matches.solution.camera.fx_px / photo.lens.fx_px - 1) < 3e-4
    assert image.bit_depth == 12


def heic(path: Path, orientation: int = 1) -> Path:
    """Write a HEIC of red, green and blue 200, 120, 40 with a black right third, exposed for a quarter of a second."""
    pixels = np.zeros((48, 96, 3), np.uint8)
    pixels[:, :64] = 200, 120, 40
    exif = piexif.dump(
        {"0th": {piexif.ImageIFD.Orientation: orientation}, "Exif": {piexif.ExifIFD.ExposureTime: (1, 4)}}
    )
    pillow_heif.from_pillow(Image.fromarray(pixels)).save(path, quality=95, exif=exif)
    return path


@pytest.mark.parametrize(("channel", "expected"), [("red", 200), ("green", 120), ("blue", 40), ("value", 200)])
def test_a_heic_of_a_telephone_is_read(tmp_path: Path, channel: Channel, expected: int) -> None:
    path = heic(tmp_path / "one.heic")

    image = read_image(path, channel=channel)

    assert image.pixels_dn.shape == (48, 96)
    np.testing.assert_allclose(image.pixels_dn[8:40, 8:56], expected, rtol=0, atol=3)
    np.testing.assert_allclose(image.pixels_dn[8:40, 72:88], 0, rtol=0, atol=3)
    assert (image.bit_depth, image.exposure_s) == (8, 0.25)
    assert is_image(path)


def test_ten_bits_of_a_heic_are_read(tmp_path: Path) -> None:
    pixels = np.full((64, 64, 3), 1023 << 6, np.uint16)
    pixels[:, :32] = 300 << 6
    pillow_heif.encode("RGB;16", (64, 64), pixels.tobytes(), tmp_path / "ten.heic", quality=-1, chroma=444)

    image = read_image(tmp_path / "ten.heic")

    np.testing.assert_allclose(image.pixels_dn[:, :32], 300, rtol=0, atol=3)
    np.testing.assert_allclose(image.pixels_dn[:, 32:], 1023, rtol=0, atol=3)
    assert (image.bit_depth, image.saturation_dn) == (10, 1023)


@pytest.mark.parametrize("orientation", range(1, 9))
def test_a_turned_heic_is_read_as_the_sensor_has_it(tmp_path: Path, orientation: int) -> None:
    image = read_image(heic(tmp_path / "turned.heic", orientation))

    assert image.pixels_dn.shape == (48, 96)
    assert image.pixels_dn[24, 20] > 150 > image.pixels_dn[24, 90]
    assert bool(image.notes) == (orientation > 1)


def test_a_huge_photograph_is_refused_before_it_is_decoded(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("GLSTAR_MAX_MEGAPIXELS", "0.004")
    raw = tmp_path / "one.dng"
    raw.write_bytes(dng(mosaic_of("rggb")))

    for path in (raw, heic(tmp_path / "one.heic")):
        with pytest.raises(CalibrationError, match=r"is 96 x (48|64) px, 0\.00\d+ megapixels; glstar reads up to"):
            read_image(path)


@pytest.mark.parametrize(
    ("library", "extra", "content"),
    [("rawpy", "raw", dng(mosaic_of("rggb"))), ("pillow_heif", "heic", b"\0\0\0\x1cftypheic" + bytes(40))],
)
def test_a_missing_library_is_named_with_its_command(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, library: str, extra: str, content: bytes
) -> None:
    path = tmp_path / "photo"
    path.write_bytes(content)
    monkeypatch.setitem(sys.modules, library, None)

    with pytest.raises(CalibrationError, match=rf"needs .*: pip install .*\[{extra}\]"):
        read_image(path)
    with pytest.raises(ImagesError, match=rf"needs .*: pip install .*\[{extra}\]"):
        read_grey(path)


def test_damaged_files_are_one_clear_line(tmp_path: Path) -> None:
    heic = tmp_path / "one.heic"
    pillow_heif.from_bytes("RGB", (96, 64), bytes(96 * 64 * 3)).save(heic)
    for content in (dng(mosaic_of("rggb"))[:3000], heic.read_bytes()[:200]):
        path = tmp_path / "cut"
        path.write_bytes(content)
        with pytest.raises(CalibrationError, match="cannot be decoded"):
            read_image(path)
    with pytest.raises(ValueError, match="is a PNG that is cut off"):
        decode_photo(b"\x89PNG\r\n\x1a\n")
    assert not has_image_signature(b"RIFF\0\0\0\0WAVEfmt ")
    assert has_image_signature(b"RIFF\0\0\0\0WEBPVP8 ")
