"""The sensor's numbers against integrals and closed forms, each limit from both sides."""

from dataclasses import replace
from math import hypot, nan, sqrt

import numpy as np
import pytest
from scipy.integrate import quad
from scipy.stats import norm

from glstar.camera.sensor.pointspread import PointSpread, PsfComponent, gaussian_radius_px
from glstar.camera.sensor.sensor import (
    PIXEL_PART_VARIANCE_PX2,
    PIXEL_PLACES_PX,
    PIXEL_WEIGHTS,
    ElectronModel,
    Sensor,
    limiting_mag,
    noise_equivalent_area_px2,
)
from glstar.errors import ConfigError

# Every number differs from the others and from 1.
MODEL = ElectronModel(
    vmag_0_e_per_s=7e4,
    sky_e_per_s=30.0,
    gain_dn_per_e=0.25,
    analogue_gain=3.0,
    full_well_e=4000.0,
    black_level_dn=120.0,
    read_noise_before_gain_e=2.0,
    read_noise_after_gain_e=4.5,
    dark_current_e_per_s=5.0,
    dark_doubling_c=6.0,
    temperature_c=31.0,
)
SENSOR = Sensor(bit_depth=12, psf_sigma_px=1.5, electrons=MODEL)


def test_three_gaussians_along_a_side_have_the_moments_of_a_pixel() -> None:
    """Even moments of a square pixel of side 1: 1/12, 1/80 and 1/448."""
    x, w, v = np.array(PIXEL_PLACES_PX), np.array(PIXEL_WEIGHTS), PIXEL_PART_VARIANCE_PX2
    assert w.sum() == pytest.approx(1.0, rel=1e-7)
    assert w @ x == pytest.approx(0.0, abs=1e-12)
    assert w @ (x**2 + v) == pytest.approx(1 / 12, rel=1e-6)
    assert w @ (x**4 + 6 * x**2 * v + 3 * v**2) == pytest.approx(1 / 80, rel=1e-6)
    assert w @ (x**6 + 15 * x**4 * v + 45 * x**2 * v**2 + 15 * v**3) == pytest.approx(1 / 448, rel=1e-5)


@pytest.mark.parametrize("mean_e", [0.0, 100.0, 3400.0, 3700.0, 3900.0, 4000.0, 4150.0, 4400.0, 6000.0])
def test_counts_that_are_cut_at_the_full_well_have_the_moments_of_a_cut_normal_law(mean_e: float) -> None:
    sigma = sqrt(mean_e)
    mean, variance = MODEL.cut_at_full_well(mean_e)
    if not mean_e:
        assert (mean, variance) == (0.0, 0.0)
        return
    law = norm(mean_e, sigma)
    above = law.sf(4000.0)
    first = (
        quad(lambda x: x * law.pdf(x), mean_e - 12 * sigma, 4000.0, points=[min(mean_e, 3999.0)])[0]
        if mean_e - 12 * sigma < 4000
        else 0.0
    )
    expected = first + 4000 * above
    second = (
        quad(lambda x: (x - expected) ** 2 * law.pdf(x), mean_e - 12 * sigma, 4000.0, points=[min(mean_e, 3999.0)])[0]
        if mean_e - 12 * sigma < 4000
        else 0.0
    )
    assert mean == pytest.approx(expected, rel=1e-7)
    assert variance == pytest.approx(second + (4000 - expected) ** 2 * above, rel=1e-5, abs=1e-5)
    assert variance >= 0


def test_the_background_is_that_of_sky_and_dark_current() -> None:
    # 5 e/s at 25 degrees double at 31; 40 e/s over 3 s.
    assert MODEL.dark_e_per_s == 10.0
    assert MODEL.sky_and_dark_e(3.0) == 120.0
    assert MODEL.dn_per_e == 0.75
    assert MODEL.read_noise_e == 2.5
    assert MODEL.background_e(3.0) == 120.0
    assert MODEL.background_variance_e2(3.0) == 120 + 6.25
    assert SENSOR.background_mean_dn(3.0) == 120 + 0.75 * 120
    assert SENSOR.background_std_dn(3.0) == pytest.approx(0.75 * sqrt(126.25), rel=1e-12)
    full = MODEL.cut_at_full_well(3920.0)
    assert (MODEL.background_e(98.0), MODEL.background_variance_e2(98.0)) == (full[0], full[1] + 6.25)
    assert MODEL.variance_e2([10.0, 20.0]).tolist() == [16.25, 26.25]
    paper = Sensor(sky_mean_dn=17.0, sky_std_dn=2.5)
    assert (paper.background_mean_dn(3.0), paper.background_std_dn(3.0)) == (17.0, 2.5)


def test_a_pixel_without_noise_has_no_ratio() -> None:
    silent = replace(MODEL, read_noise_before_gain_e=0.0, read_noise_after_gain_e=0.0)
    assert silent.pixel_electrons(120.0) == (0.0, 0.0)
    assert silent.pixel_electrons(120.0 + 0.75 * 49) == (49.0, 7.0)
    assert MODEL.pixel_electrons(120.0 + 0.75 * 30) == pytest.approx((30.0, 30 / sqrt(36.25)), rel=1e-12)
    assert silent.signal_to_noise([0.0, 90.0], 12.0, 0.0).tolist() == [0.0, pytest.approx(sqrt(90), rel=1e-12)]
    ratio = MODEL.signal_to_noise([250.0, 900.0], [12.0, 20.0], 3.0)
    np.testing.assert_allclose(ratio, [250 / sqrt(250 + 12 * 126.25), 900 / sqrt(900 + 20 * 126.25)], rtol=1e-12)


def test_a_pixel_is_full_at_the_lower_limit_of_well_and_converter() -> None:
    # 4000 e less 5 times 2.5 e are 3987.5 e, and 0.75 DN each.
    assert SENSOR.full_dn == int(120 + 0.75 * 3987.5)
    assert replace(SENSOR, bit_depth=11).full_dn == 2047
    assert Sensor(bit_depth=10).full_dn == 1023
    # Noise takes away half of the well at most.
    noisy = replace(MODEL, read_noise_before_gain_e=500.0)
    assert replace(SENSOR, electrons=noisy).full_dn == int(120 + 0.75 * 2000)
    half = replace(MODEL, read_noise_before_gain_e=398.0, read_noise_after_gain_e=0.0)
    assert replace(SENSOR, electrons=half).full_dn == int(120 + 0.75 * 2010)


def test_amplitudes_in_electrons_follow_from_the_flux() -> None:
    flux_e = 7e4 * 0.5 * 10 ** (-0.4 * np.array([2.5, 5.0]))
    np.testing.assert_allclose(SENSOR.flux_of_magnitude_dn([2.5, 5.0], 0.5), 0.75 * flux_e, rtol=1e-12)
    np.testing.assert_allclose(SENSOR.peak_dn([2.5, 5.0], 0.5), 0.75 * flux_e / (2 * np.pi * 2.25), rtol=1e-12)


SHAPES = {
    "sensor.psf_wing_fraction": 0.2,
    "sensor.psf_wing_sigma_px": 5.0,
    "sensor.psf_ellipticity": 0.3,
    "sensor.psf_angle_deg": 30.0,
    "sensor.psf_growth": 0.5,
    "sensor.psf_tilt": 0.25,
}


def test_a_gaussian_of_several_has_its_part_of_the_flux() -> None:
    shaped = Sensor(reference_peak_dn=400.0, psf_sigma_px=1.5, effects=SHAPES | {"lens.vignetting": "cos4"})
    part = PsfComponent(0.3, 2.2, (1.0, -0.5))
    one = shaped.of_component(part)
    assert one.effects == {"lens.vignetting": "cos4"}
    assert (one.psf_sigma_px, one.point_spread.is_gaussian) == (2.2, True)
    assert float(one.flux_of_magnitude_dn(3.0, 0.5)) == pytest.approx(
        0.3 * float(shaped.flux_of_magnitude_dn(3.0, 0.5)), rel=1e-12
    )
    counting = replace(shaped, bit_depth=12, electrons=MODEL)
    assert counting.of_component(part).electrons == replace(MODEL, vmag_0_e_per_s=0.3 * 7e4)
    # The narrowest Gaussian, on the narrow side of the tilt, and the widest with its offset.
    narrow = 1.5 * 0.75 * sqrt(0.7)
    assert shaped.core.psf_sigma_px == pytest.approx(narrow, rel=1e-12)
    wide = 1.75 * 1.5
    farthest = max(hypot(*one.offset_px) for one in shaped.point_spread.components(1.5, scale=1.75))
    assert farthest > wide
    expected = max(sqrt(wide**2 * 0.7 + 1 / 12) + farthest / 8, sqrt(25 + 1 / 12))
    assert shaped.widest_sigma_px == pytest.approx(expected, rel=1e-12)
    assert replace(shaped, effects={"sensor.psf_ellipticity": 0.4}).widest_sigma_px == pytest.approx(
        max(
            sqrt(1.5**2 * 0.6 + 1 / 12) + hypot(*one.offset_px) / 8
            for one in PointSpread(psf_ellipticity=0.4).components(1.5)
        ),
        rel=1e-12,
    )
    plain = Sensor(psf_sigma_px=1.5)
    assert plain.core is plain
    assert plain.widest_sigma_px == sqrt(1.5**2 + 1 / 12)


def test_the_peak_of_a_trail_is_bounded_by_the_mean_width_of_its_gaussians() -> None:
    plain = Sensor(psf_sigma_px=1.5)
    sigma = sqrt(1.5**2 + 1 / 12)
    np.testing.assert_allclose(
        plain.max_trail_peak_dn(90.0, [1.0, 20.0]), [90.0, 90 * sigma * sqrt(2 * np.pi) / 20], rtol=1e-12
    )
    shaped = Sensor(psf_sigma_px=1.5, effects=SHAPES)
    # Amplitudes of core and wings of four fifths and a fifth of the flux.
    peaks = np.array([0.8 / 2.25, 0.2 / 25])
    widths = np.sqrt(np.array([2.25, 25.0]) + 1 / 12)
    longest = 1.75 / sqrt(0.7) * (peaks @ widths) / peaks.sum()
    assert float(shaped.max_trail_peak_dn(90.0, 40.0)) == pytest.approx(90 * longest * sqrt(2 * np.pi) / 40, rel=1e-9)


def test_a_radius_is_where_the_signal_falls_below_its_limits() -> None:
    """Plain: 0.02 DN, a ten-thousandth of the peak and 3.5 sigma; renormalized: a thousandth, 1.5 sigma and 1.2 px."""
    one, faded = np.ones(()), np.full((), 400.0)

    def radius(sigma: float, peak: float, reduction: np.ndarray = one, **given: object) -> float:
        return float(gaussian_radius_px(sigma, peak, reduction, **{"renormalized": False} | given))

    assert radius(2.0, 5000.0) == pytest.approx(2 * sqrt(2 * np.log(5000 / 0.02)), rel=1e-12)
    assert radius(2.0, 1.0) == pytest.approx(2 * sqrt(2 * np.log(1e4)), rel=1e-12)
    assert radius(2.0, 1.0, faded) == 7.0
    assert radius(2.0, 5000.0, faded) == pytest.approx(2 * sqrt(2 * np.log(5000 / 0.02 / 400)), rel=1e-12)
    assert radius(2.0, 1.0, renormalized=True) == pytest.approx(2 * sqrt(2 * np.log(1e3)), rel=1e-12)
    assert radius(2.0, 1.0, faded * 2, renormalized=True) == 3.0
    assert radius(0.5, 1.0, faded * 2, renormalized=True) == 1.2
    # Below the faintest signal nothing matters.
    assert radius(2.0, 8.0, faintest_dn=0.01) == pytest.approx(2 * sqrt(2 * np.log(800)), rel=1e-12)
    assert radius(2.0, 8.0, faded / 4, faintest_dn=0.01) == 7.0
    assert radius(2.0, 0.005, faintest_dn=0.01, renormalized=True) == 3.0


def test_a_sprite_of_several_has_110_px_at_most() -> None:
    wide = Sensor(psf_sigma_px=30.0)
    assert float(wide.component_radius_px(1e9, 0.0, renormalized=False)) == 110.0
    wider = Sensor(psf_sigma_px=40.0)
    assert float(wider.component_radius_px(1e9, 0.0, renormalized=False)) == pytest.approx(
        3.5 * sqrt(1600 + 1 / 12), rel=1e-12
    )
    shaped = Sensor(reference_peak_dn=400.0, psf_sigma_px=1.5, effects=SHAPES)
    radii = []
    for part in shaped.point_spread.components(1.5, scale=1.75):
        gaussian = shaped.of_component(part)
        own = gaussian.component_radius_px(50.0 * gaussian.reference_peak_dn / 400, 3.0, renormalized=True)
        radii.append(hypot(*part.offset_px) + float(own))
    assert float(shaped.truncation_radius_px(50.0, 3.0, renormalized=True)) == pytest.approx(max(radii), rel=1e-12)


def test_sensors_leave_the_same_signal_if_only_sky_noise_and_depth_differ() -> None:
    one = Sensor(effects={"a.b": 1.0, "c.d": 2.0})
    assert one.leaves_same_signal(replace(one, sky_mean_dn=99.0, sky_std_dn=9.0, bit_depth=12))
    assert one.leaves_same_signal(replace(one, effects={"a.b": 1.0, "c.d": 3.0}), ["a.b"])
    assert not one.leaves_same_signal(replace(one, effects={"a.b": 1.0, "c.d": 3.0}), ["a.b", "c.d"])
    assert not one.leaves_same_signal(replace(one, effects={"a.b": 1.0, "c.d": 2.0, "e.f": 1.0}))
    assert not one.leaves_same_signal(replace(one, psf_sigma_px=1.3))
    assert not one.leaves_same_signal(replace(one, reference_peak_dn=151.0))
    for other in (replace(MODEL, vmag_0_e_per_s=7.1e4), replace(MODEL, gain_dn_per_e=0.26)):
        assert not SENSOR.leaves_same_signal(replace(SENSOR, electrons=other))
    # The gain is the product of both.
    assert SENSOR.leaves_same_signal(replace(SENSOR, electrons=replace(MODEL, gain_dn_per_e=0.75, analogue_gain=1.0)))


def test_another_bit_depth_scales_what_is_in_digital_numbers() -> None:
    sensor = Sensor(effects={"a.dn": 3, "b.text": "x", "c.other": 4.0}).with_bit_depth(12, ("a.dn", "b.text"))
    assert sensor.effects == {"a.dn": pytest.approx(3 * 4095 / 255), "b.text": "x", "c.other": 4.0}
    scale = 65535 / 4095
    deep = SENSOR.with_bit_depth(16, ())
    assert deep.electrons == replace(MODEL, gain_dn_per_e=0.25 * scale, black_level_dn=120 * scale)


def test_the_keys_of_a_sensor_are_those_of_its_noise_model() -> None:
    paper = Sensor(psf_sigma_px=1.5)
    assert paper.keys == {
        "reference_vmag": 3.0,
        "reference_peak_dn": 150.0,
        "reference_exposure_s": 0.5,
        "psf_sigma_px": 1.5,
        "sky_mean_dn": 16.0,
        "sky_std_dn": 3.0,
        "bit_depth": 8,
        "pixel": "integrated",
    }
    assert (paper.noise, SENSOR.noise) == ("paper", "electrons")
    counting = replace(SENSOR, effects={"a.b": 1.0}).keys
    assert counting == {
        "noise": "electrons",
        "psf_sigma_px": 1.5,
        "bit_depth": 12,
        "pixel": "integrated",
        **MODEL.keys,
        "effects": {"a.b": 1.0},
    }


def test_an_electron_model_has_the_defaults_of_the_preset() -> None:
    assert ElectronModel().keys == {
        "vmag_0_e_per_s": 90_000.0,
        "sky_e_per_s": 0.0,
        "gain_dn_per_e": 0.47,
        "analogue_gain": 1.0,
        "full_well_e": 8200.0,
        "black_level_dn": 256.0,
        "read_noise_before_gain_e": 1.5,
        "read_noise_after_gain_e": 2.8,
        "dark_current_e_per_s": 0.2,
        "dark_doubling_c": 7.0,
        "temperature_c": 25.0,
    }


@pytest.mark.parametrize("key", ["vmag_0_e_per_s", "gain_dn_per_e", "analogue_gain", "full_well_e", "dark_doubling_c"])
def test_zero_or_infinity_is_no_positive_number(key: str) -> None:
    for number in (0.0, np.inf, nan):
        with pytest.raises(ConfigError, match=rf"sensor\.{key}: must be a positive number, not"):
            replace(MODEL, **{key: number})


@pytest.mark.parametrize("key", ["sky_e_per_s", "black_level_dn", "read_noise_after_gain_e", "dark_current_e_per_s"])
def test_zero_is_allowed_and_less_is_not(key: str) -> None:
    assert getattr(replace(MODEL, **{key: 0.0}), key) == 0.0
    for number in (-0.001, np.inf):
        with pytest.raises(ConfigError, match=rf"sensor\.{key}: must be a number, 0 or more, not"):
            replace(MODEL, **{key: number})


def test_the_black_level_lies_below_the_range() -> None:
    assert Sensor(bit_depth=8, electrons=replace(MODEL, black_level_dn=254.9)).saturation_dn == 255
    with pytest.raises(ConfigError, match="must be below the saturation of 8 bits, 255 DN, not 255"):
        Sensor(bit_depth=8, electrons=replace(MODEL, black_level_dn=255.0))


@pytest.mark.parametrize("frames", [1, 4])
def test_the_limiting_magnitude_solves_the_quadratic_equation_of_its_ratio(frames: int) -> None:
    area, sky_dn = 30.0, 21.0
    flux = float(SENSOR.flux_of_magnitude_dn(limiting_mag(SENSOR, 3.0, area, sky_dn=sky_dn, frames=frames), 3.0))
    variance = 0.75**2 * 126.25 + 0.75 * sky_dn + 1 / 12
    assert flux / sqrt(0.75 * flux + area * variance) * sqrt(frames) == pytest.approx(5.0, rel=1e-12)
    paper = Sensor(sky_mean_dn=17.0, sky_std_dn=2.5)
    flux = float(paper.flux_of_magnitude_dn(limiting_mag(paper, 0.5, area, frames=frames), 0.5))
    assert flux * sqrt(frames) == pytest.approx(5 * sqrt(area * (2.5**2 + 1 / 12)), rel=1e-12)
    assert limiting_mag(paper, 0.5, area, sky_dn=0.0) == limiting_mag(paper, 0.5, area)


def test_no_star_is_seen_once_well_or_converter_is_full() -> None:
    """The sky adds to 120 e: full at 3880 e, which is 2910 DN; a converter of 11 bits is full at 1837 DN."""
    for sky_dn, is_seen in ((2909.0, True), (2910.0, False), (2911.0, False)):
        assert np.isfinite(limiting_mag(SENSOR, 3.0, 30.0, sky_dn=sky_dn)) == is_seen
    for sky_dn, is_seen in ((1836.5, True), (1837.0, False), (1837.5, False)):
        assert np.isfinite(limiting_mag(replace(SENSOR, bit_depth=11), 3.0, 30.0, sky_dn=sky_dn)) == is_seen


def test_the_area_of_two_gaussians_is_that_of_their_overlaps() -> None:
    sensor = Sensor(psf_sigma_px=1.5, effects={"sensor.psf_wing_fraction": 0.2, "sensor.psf_wing_sigma_px": 5.0})
    a, b = 2.25 + 1 / 12, 25 + 1 / 12
    squared = 0.64 / (4 * np.pi * a) + 2 * 0.16 / (2 * np.pi * (a + b)) + 0.04 / (4 * np.pi * b)
    assert noise_equivalent_area_px2(sensor) == pytest.approx(1 / squared, rel=1e-12)
