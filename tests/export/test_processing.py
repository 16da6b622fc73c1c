"""Camera processing: what ``[output]`` makes of a raw image."""

import json
from dataclasses import replace

import cv2
import numpy as np
import pytest
import tifffile
from typer.testing import CliRunner

from glstar.camera.sensor.sensor import ElectronModel, Sensor
from glstar.camera.sensor.tonecurve import _interpolated, _named_curve
from glstar.cli import app
from glstar.config import Config
from glstar.errors import ConfigError
from glstar.export.imagefiles.formats import _eight_bits, decode, find_damage, fit_format
from glstar.export.imagefiles.processing import process, to_8_bits

SETTINGS = """
[camera]
width_px = 160
height_px = 120
fx_px = 150.0
fy_px = 150.0
[sensor]
band = "imx477"
mosaic = "rggb"
[output]
process = "isp"
demosaic = "bilinear"
gamma = "srgb"
"""


def sensor_with(bits: int = 12, *, black_dn: float | None = None, mosaic: str = "none", **output) -> Sensor:
    colour = {} if mosaic == "none" else {"sensor.band": "imx477", "sensor.mosaic": mosaic}
    effects = colour | {"output.process": "isp"} | {f"output.{key}": value for key, value in output.items()}
    model = None if black_dn is None else ElectronModel(black_level_dn=black_dn)
    return replace(Sensor(bit_depth=bits, effects=effects), electrons=model)


def test_half_of_the_noise_of_a_black_sky_is_cut_off_with_the_black_level():
    sigma_dn = 40.0
    raw = np.rint(np.random.default_rng(1).normal(256, sigma_dn, (400, 400))).astype(np.uint16)
    clipped = process(raw, sensor_with(black_dn=256.0), sixteen_bits=True) / 65535 * (4095 - 256)
    # The mean of a half-normal distribution, sigma / sqrt(2 pi).
    assert clipped.mean() == pytest.approx(sigma_dn * 0.398942, abs=0.15)
    kept = process(raw, sensor_with(black_dn=256.0, subtract_black=False), sixteen_bits=True) / 65535 * 4095
    assert kept.std() == pytest.approx(sigma_dn, rel=0.01, abs=0)


@pytest.mark.parametrize(
    ("gamma", "raw", "toned"),
    [
        ("linear", 1000, 1000 / 4095),
        ("srgb", 737, 0.46140),  # 18 % grey: IEC 61966-2-1
        ("srgb", 8, 12.92 * 8 / 4095),
        ("rpi", 64, 5042.5 / 65535),  # 64 / 4095 is 1024.2 of 65535
        ("rpi", 2047, 54871.5 / 65535),  # 32759.5, between 30720 and 32768
    ],
)
def test_tone_curves_have_their_published_values(gamma, raw, toned):
    pixels = np.full((4, 4), raw, np.uint16)
    assert process(pixels, sensor_with(gamma=gamma), sixteen_bits=True)[1, 1] / 65535 == pytest.approx(toned, abs=1e-4)


@pytest.mark.parametrize("gamma", ["linear", "srgb", "rpi"])
def test_a_tone_curve_is_applied_as_numpy_interpolates_it(gamma):
    table = _named_curve(gamma)
    numbers = np.arange(65536)
    values = np.concatenate([numbers / 65535, numbers / np.float32(65535), np.random.default_rng(4).random(100_000)])
    values = np.concatenate([values.astype(np.float32), np.float32([0, 1, 1e-9, 1 - 2**-24])]).reshape(2, -1)
    np.testing.assert_array_equal(_interpolated(values, table), np.interp(values, np.linspace(0, 1, 65536), table))


def test_the_correction_of_defects_takes_a_hot_pixel_of_its_colour_and_leaves_a_wide_star():
    rows, columns = np.indices((60, 60))
    star = 3000 * np.exp(-((rows - 40) ** 2 + (columns - 40) ** 2) / (2 * 2.5**2))
    raw = (100 + star).astype(np.uint16)
    raw[20, 20] = 3000
    raw[20, 21] = 2900  # of another colour: no reason to keep its neighbour
    corrected = process(
        raw, sensor_with(mosaic="rggb", defect_correction=True, red_gain=1.0, blue_gain=1.0), sixteen_bits=True
    )
    corrected = corrected / 65535 * 4095
    assert corrected[20, 20] == pytest.approx(100, abs=1)
    assert corrected[20, 21] == pytest.approx(100, abs=1)
    assert np.abs(corrected - raw)[30:, 30:].max() < 1


@pytest.mark.parametrize("mosaic", ["rggb", "bggr", "grbg", "gbrg"])
@pytest.mark.parametrize("demosaic", ["bilinear", "edges"])
def test_a_uniform_colour_is_demosaiced_to_itself(mosaic, demosaic):
    colour = {"r": 400, "g": 1200, "b": 800}
    raw = np.empty((16, 16), np.uint16)
    for at, channel in enumerate(mosaic):
        raw[at // 2 :: 2, at % 2 :: 2] = colour[channel]
    sensor = sensor_with(mosaic=mosaic, demosaic=demosaic, red_gain=2.0, blue_gain=1.5)
    made = process(raw, sensor, sixteen_bits=True) / 65535 * 4095
    assert np.abs(made[4:-4, 4:-4] - (800, 1200, 1200)).max() < 0.2
    grey = process(raw, replace(sensor, effects={**sensor.effects, "output.channel": "max"}), sixteen_bits=False)
    assert grey.shape == (16, 16)
    assert grey[8, 8] == round(1200 / 4095 * 255)


def test_a_colour_matrix_keeps_grey_and_saturates_colours():
    raw = np.full((16, 16), 1000, np.uint16)
    sensor = sensor_with(mosaic="rggb", demosaic="bilinear", colour_matrix="rpi", red_gain=1.0, blue_gain=1.0)
    assert np.abs(process(raw, sensor, sixteen_bits=True) / 65535 * 4095 - 1000).max() < 0.5
    raw[::2, ::2] = 1500  # more red
    red, green, blue = process(raw, sensor, sixteen_bits=True)[8, 8] / 65535 * 4095
    assert red == pytest.approx(2000, abs=1)
    assert (green, blue) == (pytest.approx(800, abs=1), pytest.approx(975, abs=1))


@pytest.mark.parametrize(("at", "rows"), [((0, 0), (2000, 800, 975)), ((1, 1), (875, 775, 1850))])
def test_a_colour_matrix_has_the_contrast_of_its_columns(at, rows):
    """Half as much again of red or of blue, beside grey of 1000."""
    raw = np.full((16, 16), 1000, np.uint16)
    raw[at[0] :: 2, at[1] :: 2] = 1500
    sensor = sensor_with(mosaic="rggb", demosaic="bilinear", colour_matrix="rpi", red_gain=1.0, blue_gain=1.0)
    assert process(raw, sensor, sixteen_bits=True)[8, 8] / 65535 * 4095 == pytest.approx(rows, abs=1)


@pytest.mark.parametrize("channel", ["luma", "green", "max"])
@pytest.mark.parametrize("colour", [(1000, 200, 400), (200, 900, 500), (300, 100, 1200)])
def test_one_channel_is_green_the_largest_or_the_luminance_of_bt_601(channel, colour):
    raw = np.empty((16, 16), np.uint16)
    raw[::2, ::2], raw[1::2, 1::2] = colour[0], colour[2]
    raw[::2, 1::2] = raw[1::2, ::2] = colour[1]
    sensor = sensor_with(mosaic="rggb", demosaic="bilinear", red_gain=1.0, blue_gain=1.0, channel=channel)
    luminance = 0.299 * colour[0] + 0.587 * colour[1] + 0.114 * colour[2]  # ITU-R BT.601-7, section 2.5.1
    expected = {"luma": luminance, "green": colour[1], "max": max(colour)}[channel]
    assert process(raw, sensor, sixteen_bits=True)[8, 8] / 65535 * 4095 == pytest.approx(expected, abs=0.2)


@pytest.mark.parametrize("white_dn", [255, 1023, 4095, 65535])
def test_digital_numbers_on_a_screen_are_rounded_and_end_at_white(white_dn):
    pixels = np.unique(np.linspace(0, white_dn, 700).astype(np.uint16))
    expected = np.floor(pixels.astype(float) * 255 / white_dn + 0.5)
    np.testing.assert_array_equal(to_8_bits(pixels, white_dn), expected)
    assert to_8_bits(np.array([0, 3000, 65535], np.uint16), 3000).tolist() == [0, 255, 255]


def test_denoising_smooths_noise_and_keeps_a_bright_star():
    rng = np.random.default_rng(2)
    raw = rng.normal(400, 20, (100, 100))
    raw[50, 50] = 3500
    sensor = sensor_with(denoise=0.02)
    made = process(raw.astype(np.uint16), sensor, sixteen_bits=True) / 65535 * 4095
    assert made[:40, :40].std() < 0.4 * 20
    assert made[50, 50] == pytest.approx(3500, abs=2)


def test_processing_needs_the_mosaic_that_it_demosaics():
    with pytest.raises(ConfigError) as error:
        process(np.zeros((4, 4), np.uint16), sensor_with(demosaic="bilinear"), sixteen_bits=False)
    assert error.value.key == "output.demosaic"


def test_a_processed_image_of_12_bits_fits_into_8(tmp_path):
    assert fit_format(None, sensor_with())[0] == "png"
    with pytest.raises(ConfigError, match="JPEG"):
        fit_format("jpeg", Sensor(bit_depth=12))


@pytest.mark.parametrize(
    ("image_format", "suffix", "kind"),
    [("jpeg", ".jpg", np.uint8), ("png", ".png", np.uint8), ("png16", ".png", np.uint16), ("tiff", ".tiff", np.uint16)],
)
def test_colour_images_of_every_format_are_exported_and_verified(image_format, suffix, kind, tmp_path):
    (tmp_path / "c.toml").write_text(SETTINGS)
    command = ["export", "-o", str(tmp_path / "d"), "-c", str(tmp_path / "c.toml"), "--frames", "1"]
    command += ["--format", image_format]
    assert CliRunner().invoke(app, command).exit_code == 0
    assert CliRunner().invoke(app, [*command, "--verify"]).exit_code == 0
    file = tmp_path / "d" / f"frame_000000{suffix}"
    pixels = decode(file.read_bytes(), suffix)
    assert pixels.shape == (120, 160, 3)
    assert pixels.dtype == kind
    read = tifffile.imread(file) if suffix == ".tiff" else cv2.imread(str(file), cv2.IMREAD_UNCHANGED)[..., ::-1]
    assert np.array_equal(read, pixels)
    assert find_damage(file) == ""
    file.write_bytes(file.read_bytes()[:-40])
    assert find_damage(file) != ""
    line = json.loads((tmp_path / "d" / "truth.jsonl").read_text())
    assert line["output"]["gamma"] == "srgb"


def test_fits_holds_the_raw_mosaic_whatever_the_processing(tmp_path):
    (tmp_path / "c.toml").write_text(SETTINGS)
    command = ["export", "-o", str(tmp_path / "d"), "-c", str(tmp_path / "c.toml"), "--frames", "1", "--format", "fits"]
    assert CliRunner().invoke(app, command).exit_code == 0
    content = (tmp_path / "d" / "frame_000000.fits").read_bytes()
    assert decode(content, ".fits").shape == (120, 160)
    assert b"BAYERPAT= 'RGGB    '" in content


def test_output_is_raw_by_default():
    assert Config().sensor().effects == {}


@pytest.mark.parametrize(("kind", "colour"), [(np.uint8, False), (np.uint8, True), (np.uint16, True)])
def test_a_processed_image_has_its_own_full_scale_in_a_video(kind, colour, tmp_path):
    half = np.full((8, 8, 3) if colour else (8, 8), np.iinfo(kind).max // 2, kind)
    cv2.imwrite(str(tmp_path / "frame.png"), half)
    shown = _eight_bits(tmp_path / "frame.png", 4095)  # of a sensor of 12 bits
    assert np.abs(shown.astype(int) - 127).max() <= 1
