"""Left-aligned images: ``[output] align = "high"`` shifts 12 bits to the highest of 16, and readers shift them back."""

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
import tifffile
from astropy.io import fits
from typer.testing import CliRunner

from glstar.calibrate.photo.photograph import read_image
from glstar.camera.photofile import as_digital_numbers, shift_bits, stated_shift_bits
from glstar.cli import app
from glstar.errors import CalibrationError
from glstar.export.imagefiles.formats import _eight_bits, decode, encode
from glstar.images.decoding import read_grey

SETTINGS = """
[camera]
width_px = 160
height_px = 120
fx_px = 150.0
fy_px = 150.0
[sensor]
bit_depth = 12
sky_mean_dn = 300.0
sky_std_dn = 20.0
"""
HIGH = '[output]\nalign = "high"\n'
STORED_BY = {"png16": ".png", "tiff": ".tiff", "fits": ".fits"}
NUMBERS = np.random.default_rng(3).integers(0, 4096, (48, 64), dtype=np.uint16)


def exported(folder: Path, *, more="", options=(), verify=False) -> tuple[Path, dict, dict, str]:
    """Export one frame; return its file, its truth, the manifest and standard error."""
    folder.mkdir(exist_ok=True)
    (folder / "c.toml").write_text(SETTINGS + more)
    command = ["export", "-o", str(folder / "d"), "-c", str(folder / "c.toml"), "--frames", "1", *options]
    done = CliRunner().invoke(app, command)
    assert done.exit_code == 0, done.output
    assert not verify or CliRunner().invoke(app, [*command, "--verify"]).exit_code == 0
    line = json.loads((folder / "d" / "truth.jsonl").read_text())
    return folder / "d" / line["file"], line, json.loads((folder / "d" / "manifest.json").read_text()), done.stderr


@pytest.fixture(scope="module")
def low(tmp_path_factory):
    return exported(tmp_path_factory.mktemp("low"), options=("--masks",))


def stored(file: Path) -> np.ndarray:
    """Return the numbers of a file as other programs read them; of FITS the unsigned integers."""
    if file.suffix == ".fits":
        return (fits.getdata(file, do_not_scale_image_data=True).astype(np.int32) + 32768).astype(np.uint16)
    return tifffile.imread(file) if file.suffix == ".tiff" else cv2.imread(str(file), cv2.IMREAD_UNCHANGED)


@pytest.mark.parametrize("image_format", STORED_BY)
def test_every_format_is_shifted_and_read_back(image_format, low, tmp_path):
    low_file, low_line, low_manifest, low_note = low
    options = ("--format", image_format, "--masks", *(() if image_format == "fits" else ("--exif",)))
    file, line, manifest, note = exported(tmp_path, more=HIGH, options=options, verify=True)
    raw = stored(low_file)
    assert np.array_equal(stored(file), raw << 4)
    assert np.array_equal(decode(file.read_bytes(), file.suffix), raw)
    assert np.array_equal(read_grey(file), raw)
    image = read_image(file)
    assert np.array_equal(image.pixels_dn, raw)
    assert (image.bit_depth, image.saturation_dn) == (12, 4095)
    assert ("output" in low_line, line["output"]) == (False, {"align": "high", "shift_bits": 4})
    assert {**line, "output": 0, "file": ""} == {**low_line, "output": 0, "file": ""}  # peaks and fluxes stay in DN
    assert ("shift_bits" in low_manifest, manifest["shift_bits"]) == (False, 4)
    assert ("hold 12 bits" in low_note, "hold 12 bits" in note) == (True, False)
    for mask in low_file.parent.glob("frame_*.*.png"):
        assert (file.parent / mask.name).read_bytes() == mask.read_bytes()
    if image_format == "fits":  # astropy scales the numbers back
        assert np.array_equal(fits.getdata(file), raw)
        assert fits.getheader(file)["SATURATE"] == 4095


def test_a_processed_image_fills_its_file_whatever_the_alignment(tmp_path):
    processed = '[output]\nprocess = "isp"\n'
    low_file, low_line, *_ = exported(tmp_path / "low", more=processed)
    file, line, manifest, note = exported(tmp_path / "high", more=processed + 'align = "high"\n')
    assert (file.read_bytes(), line) == (low_file.read_bytes(), low_line)
    assert "shift_bits" not in manifest
    assert "image viewers" not in note


def test_a_sum_of_four_exposures_of_12_bits_is_shifted_by_two(tmp_path):
    stack = HIGH + '[exposure]\nduration_s = 0.1\nframes = 4\nstack = "sum"\n'
    file, line, manifest, _ = exported(tmp_path, more=stack)
    assert (line["output"]["shift_bits"], manifest["shift_bits"]) == (2, 2)
    assert np.array_equal(stored(file), decode(file.read_bytes(), ".png") << 2)


@pytest.mark.parametrize(
    ("full_scale_dn", "shift"), [(255, 0), (1023, 6), (4095, 4), (4 * 4095, 2), (16383, 2), (65535, 0)]
)
def test_the_highest_number_ends_at_the_highest_bit(full_scale_dn, shift):
    assert shift_bits(full_scale_dn) == shift


@pytest.mark.parametrize("image_format", ["png16", "tiff"])
def test_a_calibration_knows_the_bits_of_a_shifted_image(image_format, tmp_path):
    file = tmp_path / f"dark{STORED_BY[image_format]}"
    file.write_bytes(encode(NUMBERS, image_format, shift_bits=4))
    image = read_image(file)
    assert (image.bit_depth, image.saturation_dn) == (12, 4095)
    assert np.array_equal(image.pixels_dn, NUMBERS)
    assert np.abs(_eight_bits(file, 4095) - NUMBERS / 4095 * 255).max() <= 1


def test_a_left_aligned_image_of_a_camera_is_read_with_its_bit_depth(tmp_path):
    cv2.imwrite(str(tmp_path / "camera.png"), NUMBERS << 4)  # without a word on its bits
    assert np.array_equal(read_image(tmp_path / "camera.png", bit_depth=12).pixels_dn, NUMBERS)
    cv2.imwrite(str(tmp_path / "camera.png"), (NUMBERS << 4) + 1)
    with pytest.raises(CalibrationError, match="12 bits cannot"):
        read_image(tmp_path / "camera.png", bit_depth=12)


def test_numbers_in_the_lowest_bits_stay_although_the_file_states_12_bits():
    content = encode(NUMBERS, "png16", shift_bits=4)
    assert as_digital_numbers(NUMBERS, stated_shift_bits(content)) is NUMBERS
