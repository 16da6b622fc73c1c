"""The whole model of one photograph, measured on images drawn with NumPy whose parameters are known."""

from dataclasses import replace
from functools import cache
from types import SimpleNamespace

import cv2
import numpy as np
import pytest

from glstar.calibrate.identify.hints import identify_near
from glstar.calibrate.identify.platesolution import PlateSolution
from glstar.calibrate.photo.detection import detect_stars
from glstar.calibrate.photo.sky import SkyMap, before_clipping
from glstar.calibrate.sensor.brightness import fit_brightness_terms
from glstar.calibrate.sensor.calibration import calibrate
from glstar.calibrate.sensor.photographmodel import PhotographModel, _vignetting, measure_photograph
from glstar.calibrate.twin import compare_twin, neighbour_noise_dn, render_twin
from glstar.camera.distortion import Lens
from glstar.camera.model import Camera
from glstar.camera.vignetting import Vignetting
from glstar.config import Config
from glstar.errors import CalibrationError
from glstar.render.scene.scene import Frame, Scene
from glstar.sky.photometry import star_colours
from tests.support.plainphotos import REFERENCE, imperfect, own_deviations, pinhole_camera

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


@pytest.mark.parametrize("tilt", [0.25, 0.7])
def test_the_tilt_of_a_sensor_is_recovered_within_its_standard_error(tilt):
    # Before the larger tilt is fitted, the widths of the stars look like the widest wings of a Moffat profile.
    model = measured(3, moffat_beta=3.0, dn_per_e=0.5, gradient_dn=25.0, tilt=tilt)
    psf, error = model.joint.psf, model.standard_error
    assert psf.psf_tilt == pytest.approx(tilt, rel=0, abs=3 * error["psf_tilt"])
    assert error["psf_tilt"] < 0.05
    assert np.rad2deg(psf.psf_tilt_angle_rad) == pytest.approx(0, abs=3 * error["psf_tilt_angle_deg"])
    assert psf.psf == "moffat"
    assert psf.psf_beta == pytest.approx(3.0, rel=0, abs=3 * error["psf_beta"])


def test_stars_have_the_brightness_of_the_photograph_as_far_as_its_noise_allows():
    model = measured(1, moffat_beta=3.0, dn_per_e=0.5, gradient_dn=25.0, own_mag=0.25)
    table = model.brightness
    row = {int(number): k for k, number in enumerate(REFERENCE.stars.star_id)}
    true_mag = 0.25 * own_deviations()[[row[int(number)] for number in table.star_id]]
    # The zero point of the sensor has the mean of the stars in it.
    off_mag = table.off_mag - true_mag - np.median(table.off_mag - true_mag)
    assert len(table) > 60
    assert np.std(off_mag) < 0.5 * np.std(true_mag)
    assert np.abs(off_mag / table.error_mag).mean() < 1.2


def test_stars_of_the_catalogue_s_brightness_have_the_band_of_the_camera():
    table = full(1).brightness
    row = {int(number): k for k, number in enumerate(REFERENCE.stars.star_id)}
    colours = star_colours(REFERENCE.stars)[[row[int(number)] for number in table.star_id]]
    off_mag = table.off_mag - TRUE["band_slope"] * np.nan_to_num(colours, nan=0.65).clip(-0.3, 1.7)
    assert abs(np.median(off_mag)) < 0.05
    assert np.std(off_mag) < 0.06


class Kept:
    """A renderer that keeps the scene."""

    def __init__(self) -> None:
        self.scene: Scene | None = None

    def render(self, scene: Scene, *, seed: int) -> Frame:
        self.scene = scene
        return SimpleNamespace(pixels=np.zeros((scene.camera.height_px, scene.camera.width_px), np.uint8))


def test_the_stars_of_a_twin_are_drawn_in_the_middle_of_each_part_of_the_exposure(tmp_path):
    model = replace(full(1), moved=True)
    (tmp_path / "c.brightness.csv").write_text(model.brightness.to_csv(), encoding="utf-8")
    cv2.imwrite(str(tmp_path / "c.sky.tiff"), model.sky_texels)
    (tmp_path / "c.toml").write_text(model.to_toml("c.sky.tiff", "c.hot.tiff", "c.brightness.csv"), encoding="utf-8")
    kept = Kept()
    render_twin(model, Config.load(tmp_path / "c.toml"), kept)
    scene, star = kept.scene, model.calibration.matches.star[:1]
    direction_eq = scene.stars.direction_eq[star]
    count = len(scene.trails)
    drawn_px = scene.trails.positions(scene.camera, direction_eq, (np.arange(count) + 0.5) / count)[:, 0]
    start_px, middle_px, end_px = scene.camera.project(scene.shutter.to_camera(direction_eq))[:, 0]
    length_px = np.linalg.norm(end_px - start_px)
    assert length_px > 0.02
    np.testing.assert_allclose(drawn_px.mean(axis=0), middle_px, rtol=0, atol=0.01 * length_px)
    spread_px = np.sqrt(((drawn_px - middle_px) ** 2).sum(axis=1).mean())
    # That of a star that moves steadily, which has length / sqrt(12), without that of each part.
    assert spread_px == pytest.approx(length_px * np.sqrt((1 - 1 / count**2) / 12), rel=0.01, abs=0)


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


def test_the_curvature_of_a_band_is_recovered():
    rng = np.random.default_rng(6)
    vmag, bv, r = rng.uniform(2, 6, 150), rng.uniform(-0.2, 1.7, 150), rng.uniform(0, 1, 150)
    flux = 1e5 * 10 ** (-0.4 * (vmag + 0.15 * bv - 0.17 * bv**2 + rng.normal(0, 0.05, 150)))
    terms = fit_brightness_terms(flux, 0.01 * flux, vmag, bv, r, np.ones(150, bool))
    for found, true in ((terms.colour, 0.15), (terms.curvature, -0.17)):
        assert found.value == pytest.approx(true, rel=0, abs=3 * found.standard_error)
        assert found.standard_error < 0.04
    assert terms.loss_mag is None


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


@pytest.mark.parametrize("dark_dn", [40.0, 0.0])
def test_the_noise_of_a_twin_is_compared_by_neighbours_at_equal_level(dark_dn):
    # A map with errors, hot pixels, and a sky that whole numbers cut off at 0.
    rng = np.random.default_rng(1)
    across = np.linspace(0, 1, 400)[np.newaxis] * np.ones((300, 1))
    level = dark_dn + 12 * across**2
    sky = SkyMap(level, level + 3 * np.cos(9 * across), np.zeros_like(level), np.ones(level.shape, bool), 0.1)

    def image(std_dn):
        return np.floor(np.clip(level + std_dn * rng.normal(size=level.shape), 0, 255) + 0.5)

    one = image(0.4 + 0.1 * across)
    one[rng.integers(0, 300, 40), rng.integers(0, 400, 40)] = 250
    found = neighbour_noise_dn(sky, (one, image(0.4 + 0.1 * across), image(2 * (0.4 + 0.1 * across))))
    assert found.shape[1] >= 8
    np.testing.assert_allclose(found[2] / found[1], 1, rtol=0, atol=0.1)
    ends = found[3] / found[1]
    # Rounding adds 0.29 DN to both.
    bright = found[0] > dark_dn + 3
    expected = np.hypot(2 * (0.4 + 0.07), 0.29) / np.hypot(0.4 + 0.07, 0.29)
    np.testing.assert_allclose(ends[bright], expected, rtol=0, atol=0.2)


def test_clipped_stars_are_left_out_of_the_figures_of_a_twin():
    model = full(1)
    image = model.calibration.image
    at = np.rint(model.calibration.detected.xy_px[model.calibration.matches.detection]).astype(int)
    clipped = image.pixels_dn.copy()
    x, y = next((x, y) for x, y in at.tolist() if clipped[y - 4 : y + 5, x - 4 : x + 5].max() < 200)
    clipped[y - 1 : y + 2, x - 1 : x + 2] = 255
    pixels = image.pixels_dn.astype(np.uint8)
    plain = compare_twin(model, pixels, pixels, pixels).figures
    of_clipped = replace(model, calibration=replace(model.calibration, image=replace(image, pixels_dn=clipped)))
    figures = compare_twin(of_clipped, pixels, pixels, pixels).figures
    assert plain.peak_error == figures.peak_error == plain.profile_error == figures.profile_error == 0
    assert figures.stars < plain.stars


@pytest.mark.parametrize("loss_mag", [0.0, 1.0, 3.0])
def test_the_vignetting_of_a_small_image_circle_is_right_where_stars_are(loss_mag: float) -> None:
    """Of a fisheye whose circle ends at 0.47 of half the diagonal: farther out it maps nothing."""
    lens = Lens("fisheye", (-0.0445, 0.00268, -0.00146, 0.0))
    fisheye = Camera(5184, 3456, 1035.0, 1035.0, 2597.0, 1723.0, lens=lens)
    keys = _vignetting(fisheye, loss_mag, 0.47)
    sensor = Config().override(**keys).sensor()
    half_px = np.hypot(5184, 3456) / 2
    r = np.linspace(0.0, 0.47, 30)
    xy_px = np.column_stack([2597.0 - half_px * r * 0.83, 1723.0 - half_px * r * 0.55])

    fitted = Vignetting.of(sensor.effects).of_stars(fisheye, xy_px)

    np.testing.assert_allclose(fitted, 10 ** (-0.4 * loss_mag * r**2), rtol=0.03)
