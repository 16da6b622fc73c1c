"""The limiting magnitude against the formulas of the sensor, and its area against sums over a fine grid."""

from dataclasses import replace

import numpy as np
import pytest

from glstar.camera.sensor.sensor import ElectronModel, Sensor, limiting_mag, noise_equivalent_area_px2


def squared_profile_area_px2(sensor: Sensor) -> float:
    """Return 1 over the integral of the squared profile, summed on a grid of a tenth of a pixel."""
    axis_px = np.arange(-60, 60, 0.1)
    x, y = np.meshgrid(axis_px, axis_px)
    profile = np.zeros_like(x)
    for one in sensor.point_spread.components(sensor.psf_sigma_px):
        variance = one.sigma_px**2 + (1 / 12 if sensor.pixel == "integrated" else 0.0)
        radius2 = (x - one.offset_px[0]) ** 2 + (y - one.offset_px[1]) ** 2
        profile += one.flux_fraction * np.exp(-radius2 / (2 * variance)) / (2 * np.pi * variance)
    assert profile.sum() * 0.01 == pytest.approx(1.0, abs=0.02)
    return float(1 / ((profile**2).sum() * 0.01))


@pytest.mark.parametrize(
    "sensor",
    [
        Sensor(pixel="sampled"),
        Sensor(effects={"sensor.psf": "moffat", "sensor.psf_beta": 3.0}),
        Sensor(effects={"sensor.psf_ellipticity": 0.3, "sensor.psf_angle_deg": 30.0}),
        Sensor(effects={"sensor.psf_wing_fraction": 0.2, "sensor.psf_wing_sigma_px": 5.0}),
    ],
    ids=["gaussian", "moffat", "ellipse", "wings"],
)
def test_the_area_of_a_star_is_that_of_its_squared_profile(sensor: Sensor) -> None:
    assert noise_equivalent_area_px2(sensor) == pytest.approx(squared_profile_area_px2(sensor), rel=1e-3)


def test_a_star_of_the_limiting_magnitude_has_snr_5_in_the_noise_of_the_paper() -> None:
    sensor, area_px2 = Sensor(), 40.0
    flux_dn = float(sensor.flux_of_magnitude_dn(limiting_mag(sensor, 0.5, area_px2), 0.5))
    assert flux_dn / np.sqrt(area_px2 * (sensor.sky_std_dn**2 + 1 / 12)) == pytest.approx(5.0, rel=1e-9)


@pytest.mark.parametrize("sky_e", [0.0, 300.0])
def test_a_star_of_the_limiting_magnitude_has_snr_5_in_electrons(sky_e: float) -> None:
    # Rounding is 0.002 e^2 at this gain.
    model = ElectronModel(gain_dn_per_e=7.0, black_level_dn=100.0, sky_e_per_s=40.0)
    sensor = Sensor(bit_depth=16, electrons=model)
    mag = limiting_mag(sensor, 2.0, 30.0, sky_dn=7.0 * sky_e)
    flux_e = float(sensor.flux_of_magnitude_dn(mag, 2.0)) / 7.0
    with_sky = replace(model, sky_e_per_s=40.0 + sky_e / 2.0)
    assert float(with_sky.signal_to_noise(flux_e, 30.0, 2.0)) == pytest.approx(5.0, rel=1e-4)


def test_a_sum_of_short_exposures_goes_deeper_by_the_square_root_of_their_number() -> None:
    model = ElectronModel(gain_dn_per_e=7.0, black_level_dn=100.0, sky_e_per_s=40.0)
    sensor = Sensor(bit_depth=16, electrons=model)
    flux_e = float(sensor.flux_of_magnitude_dn(limiting_mag(sensor, 2.0, 30.0, frames=9), 2.0)) / 7.0
    assert 3.0 * float(model.signal_to_noise(flux_e, 30.0, 2.0)) == pytest.approx(5.0, rel=1e-4)


def test_nothing_is_seen_in_a_background_that_saturates() -> None:
    model = ElectronModel(full_well_e=1000.0)
    assert np.isnan(limiting_mag(Sensor(bit_depth=12, electrons=model), 1.0, 20.0, sky_dn=0.47 * 1100))
    assert np.isnan(limiting_mag(Sensor(), 1.0, 20.0, sky_dn=240.0))
    assert np.isfinite(limiting_mag(Sensor(), 1.0, 20.0, sky_dn=200.0))
