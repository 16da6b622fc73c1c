"""Photographs with a tone curve: their light, and the gamma that their noise shows."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from glstar.calibrate.identify.hints import identify_near
from glstar.calibrate.identify.platesolution import PlateSolution
from glstar.calibrate.photo.detection import detect_stars
from glstar.calibrate.photo.photograph import Photograph, linearised, recorded_again
from glstar.calibrate.photo.sky import NoiseAgainstLevel, gamma_of_noise
from glstar.calibrate.sensor.calibration import calibrate
from glstar.calibrate.sensor.photographmodel import measure_photograph
from glstar.camera.sensor.sensor import Sensor
from glstar.errors import ConfigError
from glstar.export.imagefiles.processing import process
from tests.support.plainphotos import REFERENCE, imperfect, pinhole_camera

WHITE_DN = 255.0


def noise_of(gamma: float, low_dn: float, high_dn: float, read_e: float) -> NoiseAgainstLevel:
    """Return the noise of a sensor with 5000 electrons at white behind a tone curve, measured to 2 %."""
    level_dn = np.linspace(low_dn, high_dn, 12)
    light_e = 5000 * (level_dn / WHITE_DN) ** gamma
    dn_per_e = WHITE_DN / gamma * (level_dn / WHITE_DN) ** (1 - gamma) / 5000
    variance_dn2 = (light_e + read_e**2) * dn_per_e**2 * (1 + 0.02 * np.random.default_rng(5).normal(size=12))
    return NoiseAgainstLevel(level_dn, variance_dn2, 0.02 * variance_dn2, 1.0, 1.0, 1.0)


@pytest.mark.parametrize("gamma", [0.6, 2.0, 2.2])
def test_the_gamma_of_a_wide_range_of_levels_is_found(gamma):
    found = gamma_of_noise(noise_of(gamma, 12.0, 180.0, read_e=2.0), WHITE_DN)
    assert found.value == pytest.approx(gamma, rel=0.1)
    assert found.low <= gamma <= found.high


@pytest.mark.parametrize("levels_dn", [(12.0, 180.0), (30.0, 45.0)])
def test_a_linear_image_stays_linear(levels_dn):
    assert gamma_of_noise(noise_of(1.0, *levels_dn, read_e=5.0), WHITE_DN).value == 1


def test_few_levels_allow_any_gamma():
    noise = noise_of(2.2, 12.0, 180.0, read_e=2.0)
    few = replace(
        noise, **{name: getattr(noise, name)[:3] for name in ("level_dn", "variance_dn2", "variance_error_dn2")}
    )
    assert gamma_of_noise(few, WHITE_DN) == (1.0, pytest.approx(0.25), pytest.approx(4.0, rel=0.01))


@pytest.mark.parametrize("gamma", ["srgb", "rpi", "0.7", "2.2"])
def test_light_recorded_again_is_the_photograph(gamma):
    every = np.arange(256.0).reshape(16, 16)
    image = Photograph(Path("drawn.jpg"), np.tile(every, (3, 4)), 8, "grey", None)
    light = linearised(image, gamma)
    assert light.saturation_dn == 65535
    assert light.pixels_dn.max() == 65535
    np.testing.assert_array_equal(recorded_again(light, light.pixels_dn), image.pixels_dn)


def test_the_twin_is_recorded_as_an_export_is_processed():
    image = linearised(Photograph(Path("drawn.jpg"), np.zeros((48, 64)), 8, "grey", None), "0.7")
    pixels = np.random.default_rng(2).integers(0, 65536, (48, 64)).astype(np.uint16)
    sensor = Sensor(bit_depth=16, effects=image.output_keys)
    np.testing.assert_array_equal(recorded_again(image, pixels), process(pixels, sensor, sixteen_bits=False))


@pytest.mark.parametrize("gamma", ["2.2x", "0", "-1", "film"])
def test_nonsense_is_refused(gamma):
    with pytest.raises(ConfigError, match="gamma"):
        linearised(Photograph(Path("drawn.jpg"), np.zeros((48, 64)), 8, "grey", None), gamma)


def test_gain_and_zero_point_of_a_processed_photograph_are_those_of_its_light():
    drawn = imperfect(2, moffat_beta=3.0, gradient_dn=25.0, dn_per_e=0.5)
    recorded = np.floor(255 * (drawn.image.pixels_dn / 255) ** (1 / 1.8) + 0.5)
    image = linearised(replace(drawn.image, pixels_dn=recorded), "1.8")
    detected = detect_stars(image)
    matches = identify_near(detected, REFERENCE, PlateSolution(pinhole_camera(drawn, 42.0), drawn.C_camera_eq))
    model = measure_photograph(calibrate(image, detected, REFERENCE, matches, method="by attitude", exposure_s=0.5))
    sensor = model.calibration.sensor
    assert sensor.bit_depth == 16
    assert sensor.electrons.gain_dn_per_e / 257 == pytest.approx(
        0.5, abs=4 * model.standard_error["gain_dn_per_e"] / 257
    )
    assert float(sensor.peak_dn(5.6, 0.5)) / 257 == pytest.approx(36.0, rel=0.05)
    written = model.to_toml("c.sky.tiff", "c.hot.tiff", "c.brightness.csv")
    assert '[output]\nprocess = "isp"\nsubtract_black = false\ngamma = 1.8' in written
