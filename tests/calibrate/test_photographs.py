"""Photographs read as one channel: which numbers they hold, of how many bits, and what they become again."""

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from glstar.calibrate.photo import photograph as module
from glstar.calibrate.photo.photograph import (
    Photograph,
    _exposure_of_fits,
    encoded_image,
    linearised,
    read_image,
    recorded_again,
)
from glstar.camera.photofile import Exif, PhotoPixels
from glstar.errors import CalibrationError, ConfigError


def decoded(monkeypatch: pytest.MonkeyPatch, path: Path, pixels: np.ndarray, content: bytes = b"content", **more):
    """Make a file that decodes to pixels; the list holds whether a mosaic is turned into colours."""
    asked: list[bool] = []

    def decode(read: bytes, *, demosaiced: bool) -> PhotoPixels:
        assert read == content
        asked.append(demosaiced)
        return PhotoPixels(pixels, **more)

    path.write_bytes(content)
    monkeypatch.setattr(module, "decode_photo", decode)
    return asked


def test_channels_are_those_of_opencv(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    rng = np.random.default_rng(1)
    pixels = rng.integers(0, 255, (40, 50, 4)).astype(np.uint8)
    path = tmp_path / "a.png"
    asked = decoded(monkeypatch, path, pixels, notes=("turned",), exif=Exif(exposure_s=0.25))
    colours = pixels[..., :3].astype(float)
    for channel, expected in (
        ("blue", colours[..., 0]), ("green", colours[..., 1]), ("red", colours[..., 2]),
        ("mean", colours.mean(axis=2)), ("value", colours.max(axis=2)),
    ):  # fmt: skip
        image = read_image(path, channel=channel)
        np.testing.assert_allclose(image.pixels_dn, expected, rtol=1e-12)
        assert (image.channel, image.bit_depth, image.exposure_s, image.notes) == (channel, 8, 0.25, ("turned",))
    assert image.pixels_dn.dtype == np.float64
    assert (image.path, image.exif.exposure_s, image.gamma, image.recorded_bits) == (path, 0.25, "linear", 8)
    assert read_image(str(path)).channel == "value"
    assert asked == [True] * 6
    read_image(path, demosaiced=False)
    assert asked[-1] is False
    decoded(monkeypatch, path, pixels[..., 0])
    assert read_image(path, channel="red").channel == "grey"


def test_the_bits_are_those_stated_given_or_proven(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "a.png"

    def depth(largest: int, white_dn: int | None = None, **more: object) -> tuple[int, float]:
        pixels = np.full((40, 50), 16, np.uint16)
        pixels[3, 4] = largest
        decoded(monkeypatch, path, pixels, white_dn=white_dn)
        image = read_image(path, **more)
        return image.bit_depth, float(image.pixels_dn.max())

    assert [depth(2**bits - 1)[0] for bits in (8, 10, 12, 14, 16)] == [8, 10, 12, 14, 16]
    assert [depth(largest)[0] for largest in (254, 256, 4094, 511, 2047, 8191)] == [16] * 6
    assert [depth(100, white_dn)[0] for white_dn in (1023, 16000, 4096)] == [10, 14, 13]
    assert depth(4095, bit_depth=13) == (13, 4095)
    assert depth(1023, bit_depth=10) == (10, 1023)
    # Left-aligned numbers are shifted, if their lowest bits are empty.
    assert depth(65520, bit_depth=12) == (12, 4095)
    assert depth(4096, bit_depth=12) == (12, 256)
    for largest, bits in ((65521, 12), (4097, 12)):
        text = f"holds the number {largest}, which {bits} bits cannot; leave out --bit-depth or set it higher"
        with pytest.raises(CalibrationError, match=text) as caught:
            depth(largest, bit_depth=bits)
        assert str(path) in str(caught.value)
    with pytest.raises(CalibrationError, match="holds the number 4200, which 12 bits cannot"):
        depth(4200, 4095)
    eight = np.full((40, 50), 7, np.uint8)
    decoded(monkeypatch, path, eight)
    assert read_image(path).bit_depth == 8


@pytest.mark.parametrize(
    ("shape", "is_enough"), [((32, 50), True), ((50, 32), True), ((31, 50), False), ((50, 31), False)]
)
def test_a_star_field_has_32_pixels_on_each_side(tmp_path: Path, shape, is_enough: bool) -> None:
    path = tmp_path / "a.png"
    cv2.imwrite(str(path), np.full(shape, 7, np.uint8))
    if is_enough:
        assert read_image(path).pixels_dn.shape == shape
        return
    with pytest.raises(
        CalibrationError, match=f"is an image of {shape[1]} x {shape[0]} px; a star field needs 32 or more"
    ):
        read_image(path)


@pytest.mark.parametrize(("card", "exposure_s"), [
    (b"EXPTIME =                 0.25", 0.25), (b"EXPOSURE= 2.5D-1", 0.25), (b"EXPTIME = 1e+2", 100.0),
    (b"EXPTIME = 1.2.3", None), (b"EXPTIME = 0.0", None), (b"EXPTIMES= 5", None), (b"", None),
])  # fmt: skip
def test_the_exposure_of_a_fits_file_is_in_its_header(card, exposure_s, tmp_path, monkeypatch) -> None:
    content = b"SIMPLE  =                    T".ljust(80) + card
    assert _exposure_of_fits(content) == exposure_s
    path = tmp_path / "a.fits"
    # What the header states counts, not EXIF.
    decoded(monkeypatch, path, np.full((40, 50), 7, np.uint8), content, exif=Exif(exposure_s=9.0))
    assert read_image(path).exposure_s == exposure_s
    assert _exposure_of_fits(b" " * (2**16 - len(card)) + card) == exposure_s
    assert _exposure_of_fits(b" " * (2**16 + 80) + b"EXPTIME = 1") is None


PLAIN = Photograph(Path("a.png"), np.arange(256.0).reshape(8, 32) * 4, 10, "grey", None)


def test_light_is_the_inverse_of_the_tone_curve() -> None:
    assert linearised(PLAIN, "linear") is PLAIN
    assert PLAIN.output_keys == {}
    assert (PLAIN.saturation_dn, replace(PLAIN, bit_depth=12).saturation_dn) == (1023, 4095)
    light = linearised(PLAIN, "2.2")
    np.testing.assert_allclose(light.pixels_dn, 65535 * (PLAIN.pixels_dn / 1023) ** 2.2, rtol=1e-12)
    assert (light.bit_depth, light.recorded_bits, light.gamma) == (16, 10, 2.2)
    assert light.output_keys == {"output.process": "isp", "output.subtract_black": False, "output.gamma": 2.2}
    srgb = linearised(PLAIN, "srgb")
    x = PLAIN.pixels_dn / 1023
    expected = np.where(x <= 0.04045, x / 12.92, ((x + 0.055) / 1.055) ** 2.4)  # IEC 61966-2-1
    np.testing.assert_allclose(srgb.pixels_dn, 65535 * expected, rtol=0, atol=0.5)
    assert srgb.gamma == "srgb"
    for gamma in (0.1, 10, "10.0"):
        assert linearised(PLAIN, gamma).gamma == float(gamma)
    for gamma in (0.099, 10.1, "film", "nan"):
        text = f"--gamma is linear, srgb, rpi, fit, or a number from 0.1 to 10, not {gamma!r}"
        with pytest.raises(ConfigError, match=text):
            linearised(PLAIN, gamma)


def test_recorded_pixels_have_the_bits_of_the_file() -> None:
    pixels = np.array([[0, 1000, 30000, 65535]], np.uint16)
    assert recorded_again(PLAIN, pixels) is pixels
    light = linearised(PLAIN, 2.0)
    ten = recorded_again(light, pixels)
    assert ten.dtype == np.uint16
    assert ten.tolist() == [np.floor(1023 * np.sqrt(pixels[0] / 65535) + 0.5).tolist()]
    eight = recorded_again(replace(light, recorded_bits=8), pixels)
    assert (eight.dtype, eight.tolist()) == (np.uint8, [[0, 31, 173, 255]])
    assert recorded_again(replace(light, recorded_bits=9), pixels).dtype == np.uint16


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16, np.float32])
def test_images_are_encoded_as_they_are(dtype) -> None:
    pixels = np.arange(12, dtype=dtype).reshape(3, 4)
    colour = np.dstack([pixels, pixels + 1, pixels + 2])
    for suffix, one in (
        (".tiff", pixels),
        (".tiff", colour),
        *([] if dtype == np.float32 else [(".png", pixels), (".png", colour)]),
    ):
        content = encoded_image(suffix, one)
        read = cv2.imdecode(np.frombuffer(content, np.uint8), cv2.IMREAD_UNCHANGED)
        assert read.dtype == dtype
        np.testing.assert_array_equal(read, one)
        assert content.startswith(b"\x89PNG" if suffix == ".png" else b"II*")
