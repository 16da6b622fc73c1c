"""The sensor: amplitudes, pixels that integrate over their area, and truncation of the point spread function."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from glstar.camera.sensor.sensor import Sensor
from glstar.errors import ConfigError

# equations.md, section 7: the L1 error of one static star against the integral over each pixel.
# A widened Gaussian is drawn where its error is below a thousandth: from 1.1 px.
WIDENED_L1 = {0.7: 0.0046, 0.85: 0.0023, 1.0: 0.0012, 1.1: 0.00086, 1.2: 0.0006, 1.5: 0.0003, 2.0: 0.0001}
SAMPLED_L1 = {0.7: 0.118, 0.85: 0.082, 1.0: 0.060, 1.2: 0.042, 1.5: 0.027, 2.0: 0.015}

erf = np.vectorize(math.erf)


def integrated(offset_px: np.ndarray, sigma_px: float) -> np.ndarray:
    """Return the integral over each pixel, along one axis, of a Gaussian of amplitude 1."""
    integral = erf((offset_px + 0.5) / (sigma_px * np.sqrt(2))) - erf((offset_px - 0.5) / (sigma_px * np.sqrt(2)))
    return sigma_px * np.sqrt(np.pi / 2) * integral


def drawn(offset_px: np.ndarray, sensor: Sensor) -> np.ndarray:
    """Return the profile that the sensor draws, along one axis, of a star of amplitude 1."""
    return np.sqrt(sensor.effective_peak) * np.exp(-0.5 * (offset_px / sensor.effective_sigma_px) ** 2)


def l1_error(sensor: Sensor) -> float:
    """Return the mean over 200 positions within a pixel of the L1 error, in units of the flux of the star."""
    errors = []
    for x, y in np.random.default_rng(7).uniform(-0.5, 0.5, (200, 2)):
        columns, rows = (np.arange(-16, 17) - centre for centre in (x, y))
        truth = np.outer(integrated(rows, sensor.psf_sigma_px), integrated(columns, sensor.psf_sigma_px))
        star = np.outer(drawn(rows, sensor), drawn(columns, sensor))
        errors.append(np.abs(star - truth).sum() / sensor.flux_dn(1.0))
    return float(np.mean(errors))


@pytest.mark.parametrize("sigma_px", WIDENED_L1)
def test_a_widened_gaussian_approximates_the_integral_over_a_pixel(sigma_px: float) -> None:
    sensor = Sensor(psf_sigma_px=sigma_px, pixel="integrated")

    expected = WIDENED_L1[sigma_px]
    assert sensor.needs_erf == (expected > 1e-3)
    assert l1_error(sensor) == pytest.approx(expected, rel=0.05, abs=0.5e-4)


@pytest.mark.parametrize("sigma_px", SAMPLED_L1)
def test_a_gaussian_sampled_at_the_pixel_centre_has_an_error_of_percents(sigma_px: float) -> None:
    sensor = Sensor(psf_sigma_px=sigma_px, pixel="sampled")

    assert l1_error(sensor) == pytest.approx(SAMPLED_L1[sigma_px], rel=0.05)


@pytest.mark.parametrize("sigma_px", [0.3, 0.7, 1.2, 3.0])
def test_an_integrated_star_is_wider_by_the_variance_of_a_pixel_and_keeps_its_flux(sigma_px: float) -> None:
    sensor = Sensor(psf_sigma_px=sigma_px)

    assert sensor.effective_sigma_px == pytest.approx(math.sqrt(sigma_px**2 + 1 / 12), rel=1e-15)
    assert 2 * np.pi * sensor.effective_sigma_px**2 * sensor.effective_peak == pytest.approx(
        sensor.flux_dn(1.0), rel=1e-14
    )


def test_a_sampled_star_is_the_point_spread_function_itself() -> None:
    sensor = Sensor(psf_sigma_px=0.5, pixel="sampled")

    assert sensor.effective_sigma_px == 0.5
    assert sensor.effective_peak == 1.0
    assert not sensor.needs_erf


def test_below_a_sigma_of_1_1_px_an_integrated_star_needs_erf() -> None:
    assert Sensor(psf_sigma_px=1.09).needs_erf
    assert not Sensor(psf_sigma_px=1.1).needs_erf


def test_the_reference_star_has_the_reference_amplitude() -> None:
    sensor = Sensor(reference_vmag=3.0, reference_peak_dn=150.0, reference_exposure_s=0.5)

    assert sensor.peak_dn(3.0, 0.5) == 150.0


def test_amplitudes_follow_eq_37() -> None:
    sensor = Sensor(reference_vmag=3.0, reference_peak_dn=150.0, reference_exposure_s=0.5)

    np.testing.assert_allclose(
        sensor.peak_dn([-1.46, 3.0, 4.0, 5.5, 8.0], 0.5),
        150.0 * 10.0 ** (-(np.array([-1.46, 3.0, 4.0, 5.5, 8.0]) - 3.0) / 2.5),
        rtol=1e-14,
    )
    assert sensor.peak_dn(4.0, 0.5) == pytest.approx(59.7, abs=0.1)


@given(st.floats(0.001, 60.0))
def test_the_amplitude_is_proportional_to_the_exposure_time(duration_s: float) -> None:
    sensor = Sensor(reference_exposure_s=0.5)

    assert sensor.peak_dn(5.0, duration_s) == pytest.approx(sensor.peak_dn(5.0, 0.5) * duration_s / 0.5, rel=1e-14)


@pytest.mark.parametrize("sigma_px", [0.4, 1.2, 2.5])
def test_the_flux_is_the_sum_over_all_pixels(sigma_px: float) -> None:
    offset_px = np.arange(-30, 31) - 0.37
    image = 80.0 * np.outer(integrated(offset_px, sigma_px), integrated(offset_px, sigma_px))

    assert Sensor(psf_sigma_px=sigma_px).flux_dn(80.0) == pytest.approx(image.sum(), rel=1e-12)


@pytest.mark.parametrize("sigma_px", [0.4, 0.7, 1.2, 3.0])
@pytest.mark.parametrize("pixel", ["integrated", "sampled"])
@pytest.mark.parametrize("peak_dn", [1e-3, 0.5, 20.0, 255.0, 1e4, 1e7])
def test_a_star_is_truncated_below_0_02_dn(sigma_px: float, pixel: str, peak_dn: float) -> None:
    sensor = Sensor(psf_sigma_px=sigma_px, pixel=pixel)
    radius_px = sensor.truncation_radius_px(peak_dn)

    for offset_px in np.array([[radius_px, 0.0], [0.0, radius_px], [radius_px, radius_px]]):
        profile = integrated(offset_px, sigma_px) if sensor.needs_erf else drawn(offset_px, sensor)
        at_the_edge = peak_dn * profile.prod()
        assert at_the_edge <= 0.02 * (1 + 1e-9)
        assert at_the_edge <= 1e-4 * peak_dn * (1 + 1e-9)


@pytest.mark.parametrize("sigma_px", [0.7, 1.2, 3.0])
@pytest.mark.parametrize("peak_dn", [1e-3, 20.0, 1e7])
@pytest.mark.parametrize("trail_px", [0.0, 1.0, 30.0, 3000.0, 1e9])
def test_at_most_a_thousandth_of_the_flux_is_outside_the_truncation_radius(
    sigma_px: float, peak_dn: float, trail_px: float
) -> None:
    sensor = Sensor(psf_sigma_px=sigma_px)
    radius_sigma = float(sensor.truncation_radius_px(peak_dn, trail_px)) / sensor.effective_sigma_px

    assert 1 - math.erf(radius_sigma / math.sqrt(2)) ** 2 < 1e-3


@pytest.mark.parametrize("peak_dn", [20.0, 255.0, 1e4])
@pytest.mark.parametrize("trail_px", [5.0, 100.0, 1000.0])
def test_a_trail_is_truncated_below_0_02_dn(peak_dn: float, trail_px: float) -> None:
    # The signal along the centre line of a long trail, and across it at the truncation radius.
    sensor = Sensor(psf_sigma_px=1.2)
    sigma_px, radius_px = sensor.effective_sigma_px, float(sensor.truncation_radius_px(peak_dn, trail_px))
    along = sigma_px * math.sqrt(2 * np.pi) / trail_px
    at_the_edge = peak_dn * sensor.effective_peak * along * math.exp(-0.5 * (radius_px / sigma_px) ** 2)

    assert at_the_edge <= 0.02 * (1 + 1e-9)


@pytest.mark.parametrize("peak_dn", [0.5, 20.0, 255.0, 1e4])
@pytest.mark.parametrize("trail_px", [0.0, 5.0, 100.0, 1000.0])
def test_renormalized_flux_is_truncated_below_0_02_dn(peak_dn: float, trail_px: float) -> None:
    sensor = Sensor(psf_sigma_px=1.2)
    sigma_px = sensor.effective_sigma_px
    radius_px = float(sensor.truncation_radius_px(peak_dn, trail_px, renormalized=True))
    middle_dn = float(sensor.max_trail_peak_dn(peak_dn, trail_px))
    at_the_edge = middle_dn * math.exp(-0.5 * (radius_px / sigma_px) ** 2)
    added_back_dn = middle_dn * (1 / math.erf(radius_px / sigma_px / math.sqrt(2)) - 1)

    assert radius_px <= sensor.truncation_radius_px(peak_dn, trail_px)
    for difference_dn in (at_the_edge, added_back_dn):
        assert difference_dn <= 0.02 * (1 + 1e-9)
        assert difference_dn <= 1e-3 * peak_dn * (1 + 1e-9)


def test_the_truncation_radius_grows_with_brightness_and_shrinks_with_speed() -> None:
    sensor = Sensor()

    assert (np.diff(sensor.truncation_radius_px(200.0, np.linspace(0.0, 500.0, 50))) <= 0).all()
    assert (np.diff(sensor.truncation_radius_px(np.geomspace(1e-3, 1e6, 50))) >= 0).all()
    assert sensor.truncation_radius_px(1e6) > sensor.truncation_radius_px(1.0)
    assert sensor.truncation_radius_px(200.0, 500.0) < sensor.truncation_radius_px(200.0)


def test_a_star_without_flux_has_a_finite_truncation_radius() -> None:
    assert np.isfinite(Sensor().truncation_radius_px(0.0, 100.0))


@pytest.mark.parametrize(("bit_depth", "saturation_dn"), [(1, 1), (8, 255), (10, 1023), (12, 4095), (16, 65535)])
def test_a_sensor_saturates_at_the_largest_number_of_its_converter(bit_depth: int, saturation_dn: int) -> None:
    assert Sensor(bit_depth=bit_depth).saturation_dn == saturation_dn


@pytest.mark.parametrize("bit_depth", [8, 10, 12, 16])
def test_another_bit_depth_keeps_fractions_of_full_scale(bit_depth: int) -> None:
    sensor = Sensor()
    other = sensor.with_bit_depth(bit_depth, ())

    assert other.bit_depth == bit_depth
    for dn in ("reference_peak_dn", "sky_mean_dn", "sky_std_dn"):
        assert getattr(other, dn) / other.saturation_dn == pytest.approx(
            getattr(sensor, dn) / sensor.saturation_dn, rel=1e-14
        )
    assert (other.psf_sigma_px, other.reference_vmag, other.pixel) == (1.2, 3.0, "integrated")
    assert other.with_bit_depth(8, ()).reference_peak_dn == pytest.approx(sensor.reference_peak_dn, rel=1e-14)


@pytest.mark.parametrize("key", ["reference_peak_dn", "reference_exposure_s", "psf_sigma_px"])
@pytest.mark.parametrize("number", [0.0, -1.0, float("nan"), float("inf")])
def test_a_number_that_is_not_positive_is_refused_with_the_name_of_the_key(key: str, number: float) -> None:
    with pytest.raises(ConfigError, match=rf"sensor\.{key}: must be a positive number, not {number}") as caught:
        Sensor(**{key: number})

    assert caught.value.key == f"sensor.{key}"


@pytest.mark.parametrize("key", ["sky_mean_dn", "sky_std_dn"])
@pytest.mark.parametrize("number", [-1.0, float("nan"), float("inf")])
def test_a_negative_sky_is_refused_with_the_name_of_the_key(key: str, number: float) -> None:
    with pytest.raises(ConfigError, match=f"must be a number of DN, 0 or more, not {number}") as caught:
        Sensor(**{key: number})

    assert caught.value.key == f"sensor.{key}"


def test_a_sky_of_zero_level_and_zero_noise_is_valid() -> None:
    assert Sensor(sky_mean_dn=0.0, sky_std_dn=0.0).sky_std_dn == 0.0


@pytest.mark.parametrize("vmag", [float("nan"), float("inf")])
def test_a_reference_star_without_a_finite_magnitude_is_refused(vmag: float) -> None:
    with pytest.raises(ConfigError, match="must be a magnitude") as caught:
        Sensor(reference_vmag=vmag)

    assert caught.value.key == "sensor.reference_vmag"


@pytest.mark.parametrize("bit_depth", [0, 17, -8])
def test_a_converter_has_1_to_16_bits(bit_depth: int) -> None:
    with pytest.raises(ConfigError, match=f"must lie between 1 and 16, not {bit_depth}") as caught:
        Sensor(bit_depth=bit_depth)

    assert caught.value.key == "sensor.bit_depth"


def test_with_bit_depth_refuses_17_bits() -> None:
    with pytest.raises(ConfigError, match="must lie between 1 and 16, not 17"):
        Sensor().with_bit_depth(17, ())


def test_effect_keys_in_digital_numbers_are_scaled_to_another_bit_depth() -> None:
    sensor = Sensor(bit_depth=8, effects={"hot_pixels.peak_dn": 100.0, "hot_pixels.rate": 0.5, "hot_pixels.model": "a"})

    assert sensor.with_bit_depth(16, {"hot_pixels.peak_dn"}).effects == {
        "hot_pixels.peak_dn": 25700.0,
        "hot_pixels.rate": 0.5,
        "hot_pixels.model": "a",
    }
    assert sensor.leaves_same_signal(Sensor(), {"hot_pixels.kind"})
    assert not sensor.leaves_same_signal(Sensor(), {"hot_pixels.rate"})
    assert not sensor.leaves_same_signal(Sensor())
    assert sensor != Sensor()


def test_five_magnitudes_are_a_factor_of_a_hundred_in_flux_and_twice_the_exposure_twice_the_flux() -> None:
    sensor = Sensor(reference_vmag=3.0, reference_peak_dn=150.0, reference_exposure_s=0.5, psf_sigma_px=1.2)
    flux_dn = sensor.flux_of_magnitude_dn([3.0, 8.0], 0.5)

    # A Gaussian of amplitude 150 DN and sigma 1.2 px sums to 2 pi sigma^2 times its amplitude.
    assert flux_dn == pytest.approx([1357.168, 13.57168], rel=1e-6)
    assert sensor.flux_of_magnitude_dn([3.0], 1.0) == pytest.approx([2 * 1357.168], rel=1e-6)


def test_a_gaussian_of_several_ends_at_a_tenth_of_what_a_single_one_leaves_out():
    sensor, peak_dn = Sensor(psf_sigma_px=4.0), np.array([0.05, 1.0, 100.0])
    radius_px = sensor.component_radius_px(peak_dn, 0.0, renormalized=True)
    edge_dn = peak_dn * np.exp(-((radius_px / sensor.effective_sigma_px) ** 2) / 2)
    assert edge_dn == pytest.approx([0.002, 0.002, 0.02], rel=1e-9, abs=0)
