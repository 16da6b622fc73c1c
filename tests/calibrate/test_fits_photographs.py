"""FITS photographs, written by astropy or by hand."""

from pathlib import Path

import numpy as np
import pytest

from glstar.calibrate.photo.photograph import read_image
from glstar.calibrate.sensor.photontransfer import images_in
from glstar.errors import CalibrationError


def written(path: Path, pixels: np.ndarray, exposure_s: float | None = None) -> Path:
    fits = pytest.importorskip("astropy.io.fits")
    unit = fits.PrimaryHDU(pixels)
    if exposure_s is not None:
        unit.header["EXPTIME"] = (exposure_s, "s")
    unit.writeto(path)
    return path


def test_pixels_bits_and_exposure_of_a_fits_file_are_read(tmp_path):
    pixels = np.random.default_rng(1).integers(0, 4096, (48, 64)).astype(np.uint16)
    pixels[0, 0] = 4095
    image = read_image(written(tmp_path / "one.fits", pixels, 0.25))
    np.testing.assert_array_equal(image.pixels_dn, pixels)
    assert (image.bit_depth, image.exposure_s) == (12, 0.25)
    assert [path.name for path in images_in(tmp_path)] == ["one.fits"]


@pytest.mark.parametrize(("stated", "exposure_s"), [(b"2.5D-1", 0.25), (b"1.2.3", None)])
def test_exposures_of_strange_fits_files_are_read_or_unknown(tmp_path, stated, exposure_s):
    path = written(tmp_path / "one.fits", np.ones((48, 64), np.uint16), 0.25)
    path.write_bytes(path.read_bytes().replace(b"0.25".rjust(20), stated.rjust(20)))
    assert read_image(path).exposure_s == exposure_s


@pytest.mark.parametrize("value", [-1.0, 0.5])
def test_numbers_that_no_camera_writes_are_refused(tmp_path, value):
    path = written(tmp_path / "flat.fits", np.full((48, 64), value, np.float32))
    with pytest.raises(CalibrationError, match="holds numbers from"):
        read_image(path)


def test_a_fits_file_that_is_cut_off_is_refused(tmp_path):
    path = written(tmp_path / "one.fits", np.ones((48, 64), np.int16))
    path.write_bytes(path.read_bytes()[:4000])
    with pytest.raises(CalibrationError, match="cut off"):
        read_image(path)


def test_an_image_in_an_extension_after_an_empty_first_unit_is_read(tmp_path):
    fits = pytest.importorskip("astropy.io.fits")
    pixels = np.random.default_rng(2).integers(0, 4096, (48, 64)).astype(np.uint16)
    science = fits.ImageHDU(pixels, fits.Header({"EXPTIME": 0.25}), "SCI")
    quality = fits.ImageHDU(np.zeros((48, 64), np.int16), name="DQ")
    path = tmp_path / "one.fits"
    fits.HDUList([fits.PrimaryHDU(), science, quality]).writeto(path)
    image = read_image(path)
    np.testing.assert_array_equal(image.pixels_dn, pixels)
    assert image.exposure_s == 0.25


def test_an_image_in_packed_tiles_is_refused_with_what_unpacks_it(tmp_path):
    fits = pytest.importorskip("astropy.io.fits")
    path = tmp_path / "one.fits.fz"
    fits.HDUList([fits.PrimaryHDU(), fits.CompImageHDU(np.ones((48, 64), np.int16))]).writeto(path)
    with pytest.raises(CalibrationError, match=r"packed in tiles \(\.fz\); unpack it with funpack"):
        read_image(path)


def test_a_table_in_an_extension_is_no_image(tmp_path):
    fits = pytest.importorskip("astropy.io.fits")
    path = tmp_path / "stars.fits"
    table = fits.BinTableHDU.from_columns([fits.Column("mag", "B", array=np.arange(9, dtype=np.uint8))])
    fits.HDUList([fits.PrimaryHDU(), table]).writeto(path)
    with pytest.raises(CalibrationError, match="first unit with data is not an image of one channel"):
        read_image(path)
