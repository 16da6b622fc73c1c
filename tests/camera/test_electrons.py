"""The electron model: noises, gains, temperature, and the signal-to-noise ratio."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import norm

from glstar.camera.sensor.sensor import ElectronModel, Sensor
from glstar.errors import ConfigError

MODEL = ElectronModel(vmag_0_e_per_s=9e4, sky_e_per_s=4.0, gain_dn_per_e=0.25, analogue_gain=4.0)


def test_the_dark_current_doubles_every_seven_degrees() -> None:
    warm = replace(MODEL, dark_current_e_per_s=0.2, dark_doubling_c=7.0, temperature_c=46.0)

    assert MODEL.dark_e_per_s == pytest.approx(0.2, rel=1e-15)
    assert warm.dark_e_per_s == pytest.approx(1.6, rel=1e-15)


def test_read_noise_behind_the_amplifier_shrinks_with_the_gain() -> None:
    # The IMX477 of a photographer's photon transfer study: 3.2 e at gain 1, 1.5 e at 16.
    imx477 = ElectronModel(read_noise_before_gain_e=1.5, read_noise_after_gain_e=2.8)

    assert imx477.read_noise_e == pytest.approx(3.18, abs=0.005)
    assert replace(imx477, analogue_gain=16.0).read_noise_e == pytest.approx(1.51, abs=0.005)


def test_the_flux_of_a_star_is_its_electrons_times_the_gain_whatever_its_width() -> None:
    for sigma_px in (0.7, 1.2, 3.0):
        sensor = Sensor(psf_sigma_px=sigma_px, bit_depth=12, electrons=MODEL)

        # 90000 e/s * 10^(-0.4 * 3) * 0.5 s, at 1 DN/e.
        assert sensor.flux_of_magnitude_dn(3.0, 0.5) == pytest.approx(2839.3, rel=1e-4)
        assert sensor.peak_dn(3.0, 0.5) == pytest.approx(2839.3 / (2 * np.pi * sigma_px**2), rel=1e-4)


def test_the_background_has_black_level_sky_and_dark_current() -> None:
    sensor = Sensor(bit_depth=12, electrons=replace(MODEL, dark_current_e_per_s=1.0, black_level_dn=256.0))

    # 1 DN/e: 5 e/s over 2 s, and their shot noise with the read noise of 1.5 e and 2.8 / 4 e.
    assert sensor.background_mean_dn(2.0) == pytest.approx(266.0, rel=1e-15)
    assert sensor.background_std_dn(2.0) == pytest.approx(np.sqrt(10 + 1.5**2 + 0.7**2), rel=1e-15)


def test_another_bit_depth_keeps_the_fraction_of_full_scale() -> None:
    twelve = Sensor(bit_depth=12, electrons=MODEL)
    sixteen = twelve.with_bit_depth(16, ())

    for value in (lambda s: s.background_mean_dn(1.0), lambda s: float(s.peak_dn(2.0, 1.0))):
        assert value(sixteen) / 65535 == pytest.approx(value(twelve) / 4095, rel=1e-14)


def test_stars_leave_the_same_signal_whatever_the_noise_and_another_with_another_gain() -> None:
    sensor = Sensor(bit_depth=12, electrons=MODEL)

    assert sensor.leaves_same_signal(replace(sensor, electrons=replace(MODEL, temperature_c=50.0, sky_e_per_s=9.0)))
    assert not sensor.leaves_same_signal(replace(sensor, electrons=replace(MODEL, analogue_gain=2.0)))
    assert not sensor.leaves_same_signal(Sensor(bit_depth=12))
    assert not Sensor(bit_depth=12).leaves_same_signal(sensor)


def test_the_signal_to_noise_ratio_is_that_of_a_weighted_measurement() -> None:
    # Brute force: a Gaussian star of 300 e on a background of known variance, measured with its profile as weight.
    sigma_px, flux_e = 2.0, 300.0
    model = replace(MODEL, sky_e_per_s=0.0, dark_current_e_per_s=0.0, read_noise_before_gain_e=30.0)
    x = np.arange(-20.0, 21.0)
    profile = norm.pdf(x, scale=sigma_px)
    profile = np.outer(profile, profile)
    rng = np.random.default_rng(3)
    pixels = flux_e * profile + rng.normal(0, model.read_noise_e, (4000, *profile.shape))
    measured = (pixels * profile).sum(axis=(1, 2)) / (profile**2).sum()

    snr = model.signal_to_noise(flux_e, 4 * np.pi * sigma_px**2, 1.0)

    assert measured.mean() / measured.std() == pytest.approx(float(snr), rel=0.05)


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("gain_dn_per_e", 0.0),
        ("full_well_e", -1.0),
        ("analogue_gain", float("nan")),
        ("sky_e_per_s", -0.1),
        ("read_noise_before_gain_e", float("inf")),
        ("temperature_c", float("nan")),
    ],
)
def test_an_impossible_number_is_refused_by_its_key(key: str, value: float) -> None:
    with pytest.raises(ConfigError) as refused:
        replace(MODEL, **{key: value})

    assert refused.value.key == f"sensor.{key}"


def test_a_black_level_above_the_range_is_refused() -> None:
    with pytest.raises(ConfigError, match=r"below the saturation of 8 bits, 255 DN, not 256") as refused:
        Sensor(bit_depth=8, electrons=MODEL)

    assert refused.value.key == "sensor.black_level_dn"


def test_a_pixel_is_read_in_electrons_with_its_signal_to_noise_ratio() -> None:
    model = replace(MODEL, black_level_dn=100.0, read_noise_before_gain_e=3.0, read_noise_after_gain_e=0.0)

    # 400 DN above the black level at 1 DN/e: 400 e with a noise of sqrt(400 + 9) e.
    assert model.pixel_electrons(500.0) == pytest.approx((400.0, 400 / np.sqrt(409)))
    assert model.pixel_electrons(90.0) == (-10.0, 0.0)
