"""The whole model of one photograph, measured on images drawn with NumPy whose parameters are known."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from glstar.calibrate import PhotographModel, PlateSolution, calibrate, detect_stars, identify_near, measure_photograph
from glstar.calibrate.brightnessterms import fit_brightness_terms
from glstar.calibrate.skymeasurement import before_clipping
from glstar.camera.vignetting import Vignetting
from glstar.errors import CalibrationError
from tests.support.plainphotos import REFERENCE, imperfect, pinhole_camera

# What `imperfect` draws.
TRUE = {"psf_sigma_px": 1.3, "psf_beta": 3.0, "gain_dn_per_e": 0.5, "band_slope": -0.5}
CORNER_LOSS, GRADIENT_DN, READ_DN, SKY_DN = 0.35, 25.0, 3.0, 40.0


@cache
def measured(seed: int, **given: float) -> PhotographModel:
    drawn = imperfect(seed, **given)
    detected = detect_stars(drawn.image)
    matches = identify_near(detected, REFERENCE, PlateSolution(pinhole_camera(drawn, 42.0), drawn.C_camera_eq))
    return measure_photograph(
        calibrate(drawn.image, detected, REFERENCE, matches, method="by attitude", exposure_s=0.5)
    )


def full(seed: int) -> PhotographModel:
    return measured(
        seed,
        moffat_beta=TRUE["psf_beta"],
        corner_loss=CORNER_LOSS,
        gradient_dn=GRADIENT_DN,
        dn_per_e=TRUE["gain_dn_per_e"],
        band_slope=TRUE["band_slope"],
    )


@pytest.mark.parametrize("seed", [1, 2])
def test_each_parameter_is_recovered_within_its_standard_error(seed):
    model = full(seed)
    keys = model.calibration.sensor.keys
    found = {**keys, **{name.partition(".")[2]: value for name, value in keys["effects"].items()}}
    for name, true in TRUE.items():
        error = model.standard_error[name]
        assert abs(found[name] - true) < 4 * error, (name, found[name], error)
        assert error < 0.15 * abs(true), name
    camera = model.calibration.matches.solution.camera
    corner = Vignetting.of(keys["effects"]).of_stars(camera, [[0.0, 0.0]])[0]
    assert corner == pytest.approx(1 - CORNER_LOSS, abs=4 * model.standard_error["vignetting_r2"])


def test_the_zero_point_is_that_of_the_drawn_stars():
    model = full(1)
    sensor = model.calibration.sensor
    # `imperfect` draws an amplitude of 36 DN at 5.6 mag.
    assert float(sensor.peak_dn(5.6, 0.5)) == pytest.approx(
        36.0, rel=4 * model.standard_error["vmag_0_e_per_s"] / sensor.electrons.vmag_0_e_per_s, abs=0
    )


def test_the_map_of_the_sky_is_the_drawn_sky():
    model = full(1)
    height, width = model.sky.level_dn.shape
    columns, rows = np.meshgrid(np.arange(width), np.arange(height))
    corner2 = ((columns - width / 2) ** 2 + (rows - height / 2) ** 2) / (width**2 + height**2) * 4
    drawn = SKY_DN * (1 - CORNER_LOSS * corner2) + GRADIENT_DN * (columns / (width - 1) - 0.5)
    off = (model.sky.level_dn - drawn)[16:-16, 16:-16]
    assert model.has_map
    # Faint stars without a detection lift the mean by a few hundredths of a DN.
    assert np.sqrt((off**2).mean()) < 3 * model.sky.error_dn
    assert np.abs(off).max() < 8 * model.sky.error_dn


def test_the_map_of_a_mirrored_photograph_is_that_of_the_scene():
    model = full(1)
    solution = replace(model.calibration.matches.solution, mirrored=True)
    mirrored = replace(model.calibration, matches=replace(model.calibration.matches, solution=solution))
    np.testing.assert_array_equal(replace(model, calibration=mirrored).sky_texels, model.sky_texels[:, ::-1])


def test_the_noise_is_a_line_through_read_noise_and_gain():
    noise = full(2).noise
    expected = READ_DN**2 + TRUE["gain_dn_per_e"] * noise.level_dn
    np.testing.assert_allclose(np.sqrt(noise.variance_dn2), np.sqrt(expected), rtol=0.02, atol=0)


def test_a_plain_photograph_needs_no_more_than_the_paper_s_sensor():
    model = measured(4)
    assert model.calibration.sensor.electrons is None
    assert not model.has_map
    assert not {"sensor.band", "lens.vignetting", "sensor.psf_growth"} & model.calibration.sensor.effects.keys()
    assert any("does not grow" in reason for reason in model.refused)
    assert model.calibration.sensor.psf_sigma_px == pytest.approx(1.3, abs=0.03)


def test_the_written_model_names_its_tables_and_errors():
    written = full(1).to_toml("c.sky.tiff", "c.hot.tiff", "c.brightness.csv")
    assert 'sky_map = "c.sky.tiff"' in written
    assert "dark_frame" not in written  # no hot pixel is on the image
    assert "[lens]\nvignetting = " in written
    assert "gain_dn_per_e" in written.split("[sensor]")[0]


@pytest.mark.parametrize("mean", [-1.0, 0.5, 2.0, 12.0])
def test_a_sky_cut_off_at_zero_is_restored(mean):
    values = np.maximum(np.random.default_rng(3).normal(mean, 2.0, 2_000_000), 0.0)
    restored = before_clipping(np.array(values.mean()), np.array(values.std()))
    np.testing.assert_allclose(restored, (mean, 2.0), rtol=0, atol=0.02)


def test_colour_and_loss_are_left_out_where_chance_explains_them():
    rng = np.random.default_rng(5)
    found = 0
    for _ in range(100):
        vmag, bv, r = rng.uniform(2, 6, 40), rng.normal(0.6, 0.5, 40), rng.uniform(0, 1, 40)
        flux = 1e5 * 10 ** (-0.4 * (vmag + rng.normal(0, 0.15, 40)))
        terms = fit_brightness_terms(flux, 0.01 * flux, vmag, bv, r, np.ones(40, bool))
        found += (terms.colour is not None) + (terms.loss_mag is not None)
    assert found <= 6  # 2 expected


def test_few_stars_are_refused_with_their_number():
    drawn = imperfect(1)
    detected = detect_stars(drawn.image)
    matches = identify_near(detected, REFERENCE, PlateSolution(pinhole_camera(drawn, 42.0), drawn.C_camera_eq))
    calibration = calibrate(drawn.image, detected, REFERENCE, matches, method="by attitude", exposure_s=0.5)
    object.__setattr__(detected, "noise_dn", detected.noise_dn * 50)
    with pytest.raises(CalibrationError, match=r"needs 6 stars .* and the image has 0"):
        measure_photograph(calibration)


@pytest.mark.parametrize("exponent", [1.0, 0.8])
def test_the_power_of_the_response_is_measured_from_fluxes(exponent):
    rng = np.random.default_rng(9)
    vmag, bv, r = rng.uniform(1, 6, 80), rng.normal(0.6, 0.4, 80), rng.uniform(0, 1, 80)
    flux = 1e5 * 10 ** (-0.4 * exponent * (vmag + rng.normal(0, 0.05, 80)))
    slope = fit_brightness_terms(flux, 0.01 * flux, vmag, bv, r, np.ones(80, bool)).magnitude_slope
    assert slope.standard_error < 0.01
    assert 1 + slope.value == pytest.approx(exponent, rel=0, abs=3 * slope.standard_error)
