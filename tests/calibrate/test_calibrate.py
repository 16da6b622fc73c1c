"""Calibration from one photograph: the known sensor of a rendered image must be recovered."""

import re
from dataclasses import replace
from functools import cache
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from scipy.stats import theilslopes

from glstar.calibrate.geometry.camera import refraction_notes
from glstar.calibrate.geometry.lensfit import with_refraction
from glstar.calibrate.identify.hints import Label, identify_by_labels, identify_near
from glstar.calibrate.identify.lost import identify_lost
from glstar.calibrate.identify.matching import mutual_nearest, refine
from glstar.calibrate.identify.platesolution import PlateSolution, ReferenceStars, is_significant, require_significant
from glstar.calibrate.photo.detection import DetectedStars, detect_stars
from glstar.calibrate.photo.photograph import Photograph, read_image
from glstar.calibrate.photo.psf import dilution, draw_stars, fit_stars, profile
from glstar.calibrate.sensor.calibration import Calibration, calibrate
from glstar.calibrate.sensor.fit import fit_brightness
from glstar.calibrate.sensor.report import draw_report
from glstar.camera.model import Camera
from glstar.camera.sensor.sensor import Sensor
from glstar.config import Config
from glstar.errors import CalibrationError
from glstar.rotation import about_x, about_y, about_z
from glstar.sky.photometry import brightness_ratio
from glstar.sky.place.apparent import right_ascension_declination
from glstar.system.installation import install_command
from tests.support.reference import profile as drawn_profile
from tests.support.starphotos import ALL_STARS, EXPOSURE_S, StarPhoto

PHOTOS = Path(__file__).parents[3] / "shared" / "images"
REAL = pytest.mark.skipif(not PHOTOS.exists(), reason="the photographs are not on this machine")

pytestmark = pytest.mark.usefixtures("kept_patterns")
SENSORS = {
    "a dark sky": Sensor(reference_peak_dn=1500.0, psf_sigma_px=1.2),
    "a sharp lens": Sensor(reference_peak_dn=1500.0, psf_sigma_px=0.6, sky_mean_dn=30.0),
    "a soft lens": Sensor(reference_peak_dn=800.0, psf_sigma_px=2.5, sky_std_dn=2.0),
    "a bright sky": Sensor(reference_peak_dn=1500.0, psf_sigma_px=1.0, sky_mean_dn=60.0, sky_std_dn=5.0),
    "sixteen bits": Sensor(reference_peak_dn=2e5, psf_sigma_px=1.0, sky_mean_dn=900.0, sky_std_dn=60.0, bit_depth=16),
}


@cache
def photo(name: str = "a dark sky") -> StarPhoto:
    return StarPhoto.of(SENSORS[name])


@cache
def detected(name: str = "a dark sky") -> DetectedStars:
    return detect_stars(photo(name).image)


@cache
def calibrated(name: str = "a dark sky") -> Calibration:
    drawn, stars = photo(name), detected(name)
    matches = identify_near(stars, drawn.reference, drawn.solution)
    return calibrate(drawn.image, stars, drawn.reference, matches, method="by attitude", exposure_s=EXPOSURE_S)


def turned(solution: PlateSolution, *, x_deg: float = 0.0, y_deg: float = 0.0, z_deg: float = 0.0) -> PlateSolution:
    """Return a solution with a rotated camera."""
    C = about_z(np.deg2rad(z_deg)) @ about_y(np.deg2rad(y_deg)) @ about_x(np.deg2rad(x_deg))
    return replace(solution, C_camera_eq=C @ solution.C_camera_eq)


def angle_arcsec(C: np.ndarray) -> float:
    return float(np.rad2deg(Rotation.from_matrix(C).magnitude()) * 3600)


# --- the point spread function ----------------------------------------------------------------------------------------


def test_pixel_integration_agrees_with_the_reference_renderer() -> None:
    offset_px = np.linspace(-6, 6, 101)
    for sigma_px in (0.3, 0.69, 0.7, 1.2, 3.0):
        drawn = drawn_profile(offset_px, Sensor(psf_sigma_px=sigma_px))
        np.testing.assert_allclose(profile(offset_px, sigma_px), drawn, rtol=0, atol=1e-14)


@pytest.mark.parametrize("sigma_px", [0.5, 0.69, 0.71, 1.0, 2.5])
def test_a_fit_of_a_noiseless_star_is_exact(sigma_px: float) -> None:
    xy_px, peak_dn = np.array([[20.3, 31.7], [70.49, 44.01], [50.0, 80.0]]), np.array([30.0, 200.0, 5.0])
    image = draw_stars((100, 120), xy_px, peak_dn, sigma_px) + 17.0

    found = fit_stars(image, np.ones_like(image, dtype=bool), np.rint(xy_px), start_sigma_px=1.3)

    assert found.converged.all()
    np.testing.assert_allclose(found.xy_px, xy_px, rtol=0, atol=1e-3)  # px
    np.testing.assert_allclose(found.sigma_px, sigma_px, rtol=2e-3)
    np.testing.assert_allclose(found.peak_dn, peak_dn, rtol=4e-3)
    np.testing.assert_allclose(found.sky_dn, 17.0, rtol=0, atol=0.05)  # DN


@pytest.mark.parametrize("trail_px", [0.0, 0.7, 3.0, 12.0])
def test_the_peak_of_a_trail_is_lower_by_its_trail_loss(trail_px: float) -> None:
    """The expected loss is the mean of the Gaussian over the trail about its middle."""
    u = (np.arange(10_000) + 0.5) / 10_000 - 0.5
    expected = np.exp(-0.5 * (trail_px * u / 1.3) ** 2).mean()

    slanted = dilution(np.array([[0.6 * trail_px, -0.8 * trail_px]]), 1.3)

    assert slanted[0] == pytest.approx(expected, rel=1e-6)


def test_a_fit_of_stars_in_noise_is_unbiased() -> None:
    # equations.md, section 5: peak 80, noise 3, sigma 1: a scatter of 0.028 px in sigma.
    rng = np.random.default_rng(3)
    grid = np.arange(20, 980, 24.0)
    xy_px = np.array([(x, y) for x in grid for y in grid]) + rng.uniform(-0.5, 0.5, (len(grid) ** 2, 2))
    image = draw_stars((1000, 1000), xy_px, np.full(len(xy_px), 80.0), 1.0) + rng.normal(10, 3, (1000, 1000))

    found = fit_stars(image, np.ones_like(image, dtype=bool), np.rint(xy_px), start_sigma_px=1.3)

    assert np.mean(found.sigma_px) == pytest.approx(1.0, abs=0.004)  # px; its standard error is 0.0007
    assert np.std(found.sigma_px) == pytest.approx(0.028, abs=0.004)
    assert np.mean(found.peak_dn) == pytest.approx(80.0, abs=0.4)  # DN
    assert np.abs(np.mean(found.xy_px - xy_px, axis=0)).max() < 0.003  # px


@pytest.mark.parametrize("sigma_px", [0.7, 1.0])
def test_noise_makes_faint_stars_neither_brighter_nor_sharper(sigma_px: float) -> None:
    # At a signal-to-noise ratio of 10, least squares is biased by up to 1 % in brightness and 1.5 % in width.
    rng = np.random.default_rng(5)
    grid = np.arange(20, 1180, 29.0)
    xy_px = np.array([(x, y) for x in grid for y in grid]) + rng.uniform(-0.5, 0.5, (len(grid) ** 2, 2))
    light = draw_stars((1200, 1200), xy_px, np.full(len(xy_px), 30.0), sigma_px)
    fixed, free = [], []
    for _ in range(2):
        image = light + rng.normal(10, 3, light.shape)
        for found, width_px in ((fixed, sigma_px), (free, None)):
            everywhere = np.ones_like(image, dtype=bool)
            found.append(fit_stars(image, everywhere, np.rint(xy_px), start_sigma_px=sigma_px, sigma_px=width_px))

    def off(values: list[np.ndarray], true: float) -> tuple[float, float]:
        """Return the relative error of the median, and its standard error."""
        ratio = np.concatenate(values) / true - 1
        return float(np.median(ratio)), 1.25 * float(np.std(ratio)) / np.sqrt(len(ratio))

    peak, peak_error = off([stars.unbiased_peak_dn for stars in fixed], 30.0)
    raw_peak, _ = off([stars.peak_dn for stars in fixed], 30.0)
    width, width_error = off([stars.unbiased_sigma_px for stars in free], sigma_px)
    assert abs(peak) < 3 * peak_error + 0.001
    assert abs(peak) < raw_peak
    assert abs(width) < 3 * width_error + 0.002


# --- detection --------------------------------------------------------------------------------------------------------


def test_hot_pixels_and_stars_at_the_edge_are_no_stars() -> None:
    rng = np.random.default_rng(5)
    xy_px = np.array([[100.2, 80.4], [200.7, 150.1], [300.0, 60.5], [60.3, 220.8], [1.0, 100.0], [250.0, 298.6]])
    pixels = draw_stars((300, 400), xy_px, np.full(6, 150.0), 1.1) + rng.normal(20, 2, (300, 400))
    for x, y in ((30, 30), (350, 200), (180, 250)):
        pixels[y, x] = 240
    image = Photograph(Path("drawn.png"), np.floor(pixels + 0.5), 8, "grey", None)

    stars = detect_stars(image)

    assert (len(stars), stars.hot_pixels, stars.at_the_edge) == (4, 3, 2)
    order = np.argsort(stars.xy_px[:, 0])
    np.testing.assert_allclose(stars.xy_px[order], xy_px[[3, 0, 1, 2]], rtol=0, atol=0.05)  # px


def test_the_brightest_stars_are_flagged_as_saturated() -> None:
    stars, drawn = calibrated().stars, photo()
    peak_dn = drawn.sensor.peak_dn(stars.vmag, EXPOSURE_S) * drawn.sensor.effective_peak + drawn.sensor.sky_mean_dn
    alone = ~stars.blended
    assert stars.saturated[alone & (peak_dn > 1.5 * 255)].all()
    assert not stars.saturated[alone & (peak_dn < 0.9 * 250)].any()


def test_an_empty_sky_has_no_stars() -> None:
    noise = np.floor(np.random.default_rng(1).normal(20, 3, (400, 500)) + 0.5)
    stars = detect_stars(Photograph(Path("dark.png"), noise, 8, "grey", None))
    assert len(stars) <= 1  # about one noise peak above 5 sigma in several million pixels
    assert stars.sky.mean_dn == pytest.approx(20, abs=0.05)  # DN


@pytest.mark.parametrize("mean_dn", [1.0, 3.0, 10.0])
def test_the_sky_level_is_measured_despite_clipping_at_zero(mean_dn: float) -> None:
    sensor = Sensor(reference_peak_dn=900.0, sky_mean_dn=mean_dn, sky_std_dn=3.0)
    sky = detect_stars(StarPhoto.of(sensor, size=(600, 400)).image).sky
    assert sky.mean_dn == pytest.approx(mean_dn, abs=0.1)  # DN
    assert sky.std_dn == pytest.approx(3.0, rel=0.02)


@pytest.mark.parametrize(("mean_dn", "pedestal_dn"), [(30.0, 0.0), (30.0, 2.0), (8.0, 0.0), (0.4, 0.0), (0.4, 2.0)])
def test_the_sky_of_an_all_sky_image_is_that_inside_of_the_image_circle(mean_dn: float, pedestal_dn: float) -> None:
    rng = np.random.default_rng(4)
    row, column = np.mgrid[:800, :1200]
    distance = np.hypot(column - 610, row - 395) / 380
    # Darker towards its rim, as behind such lenses.
    sky_dn = np.where(distance < 1, mean_dn * (1 - 0.5 * distance**2), 0.0)
    noise = rng.normal(0.0, np.where(distance < 1, 1.2, 0.0))
    pixels = np.clip(np.rint(sky_dn + noise + pedestal_dn), 0, 255)

    detected = detect_stars(Photograph(Path("sky.png"), pixels, 8, "grey", None))

    if mean_dn > 5:
        assert not detected.background.is_sky[distance > 1.1].any()
        assert detected.background.is_sky[distance < 0.6].all()
        assert detected.sky.std_dn == pytest.approx(1.2, rel=0.1)  # with the gradient inside of tiles
        inside = detected.background.is_sky & (distance < 1)
        assert detected.sky.mean_dn == pytest.approx(pedestal_dn + sky_dn[inside].mean(), abs=0.2 + 0.01 * mean_dn)
    else:  # a sky below its noise shows no circle
        assert detected.background.is_sky.all()


@pytest.mark.parametrize("sky", ["beside the Earth's limb", "around the Moon", "between two hills", "in dark corners"])
def test_a_dark_sky_beside_a_bright_one_is_no_image_circle(sky: str) -> None:
    row, column = np.mgrid[:800, :1200]
    distance = np.hypot(column - 600, row - 400)
    levels = {
        "beside the Earth's limb": np.where(row + 0.4 * column > 800, 150.0, 5.0),
        "around the Moon": 2 + 150 * np.exp(-((distance / 200) ** 2)),
        "between two hills": np.where(np.abs(column - 600) < 250, 120.0, 3.0),
        "in dark corners": 100 * np.maximum(1 - 0.9 * (distance / 720) ** 2, 0.08),
    }
    noise = np.random.default_rng(6).normal(0.0, 1.5, row.shape)
    pixels = np.clip(np.rint(levels[sky] + noise), 0, 255)
    assert detect_stars(Photograph(Path("sky.png"), pixels, 8, "grey", None)).background.is_lit.all()


# --- recovery of the sensor -------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", SENSORS)
def test_a_known_sensor_is_recovered_from_its_image(name: str) -> None:
    true, found = SENSORS[name], calibrated(name).sensor

    peak_dn = found.peak_dn([true.reference_vmag], true.reference_exposure_s)[0]
    assert peak_dn == pytest.approx(true.reference_peak_dn, rel=0.01)
    assert found.psf_sigma_px == pytest.approx(true.psf_sigma_px, rel=0.01)
    assert found.sky_mean_dn == pytest.approx(true.sky_mean_dn, abs=max(0.1, true.sky_std_dn / 50))  # DN
    assert found.sky_std_dn == pytest.approx(true.sky_std_dn, rel=0.02)
    assert (found.bit_depth, found.reference_exposure_s) == (true.bit_depth, EXPOSURE_S)


@pytest.mark.parametrize("name", SENSORS)
def test_stars_are_detected_at_their_positions_and_identified(name: str) -> None:
    found, drawn = calibrated(name), photo(name)
    off_px = np.linalg.norm(found.stars.xy_px - drawn.true_xy_px(found.stars.star_id), axis=1)
    signal = found.stars.peak_dn / found.stars.noise_dn
    clear = ~found.stars.blended & ~found.stars.saturated & (signal > 25)

    assert clear.sum() > 20
    assert off_px[clear].max() < 0.15  # px
    assert np.sqrt((off_px[clear] ** 2).mean()) < 0.05
    assert off_px[~found.stars.blended].max() < 2.0  # px: no star is misidentified


@pytest.mark.parametrize("name", SENSORS)
def test_nearly_all_stars_two_magnitudes_above_the_limit_are_identified(name: str) -> None:
    found, drawn = calibrated(name), photo(name)
    limit_vmag = found.brightness.reference_vmag + 2.5 * np.log10(
        found.sensor.reference_peak_dn / (5 * found.sensor.sky_std_dn)
    )
    predicted, xy_px = drawn.solution.stars_on_image(drawn.reference)
    inside = ((xy_px > 5) & (xy_px < np.array(drawn.image.pixels_dn.shape[::-1]) - 6)).all(axis=1)
    bright = drawn.reference.stars.vmag[predicted] < limit_vmag - 2
    # Stars closer than the image resolves are blended.
    separation_px = np.linalg.norm(xy_px[:, None] - xy_px, axis=-1) + 1e3 * np.eye(len(xy_px))
    expected = predicted[inside & bright & (separation_px.min(axis=1) > 6 * drawn.sensor.effective_sigma_px)]

    assert len(expected) > 20
    assert np.isin(expected, found.matches.star).mean() >= 0.95


def test_the_attitude_and_the_focal_length_are_recovered() -> None:
    drawn = photo()
    solution = identify_near(detected(), drawn.reference, turned(drawn.solution, x_deg=2, y_deg=-1, z_deg=3)).solution
    assert angle_arcsec(solution.C_camera_eq @ drawn.solution.C_camera_eq.T) < 20
    assert solution.camera.fx_px == pytest.approx(drawn.lens.fx_px, rel=1e-3)
    assert not solution.mirrored


# --- trails -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("exposure_s", "sigma_px"), [(10.0, 0.8), (30.0, 0.8), (30.0, 1.5)])
def test_sidereal_trails_give_the_same_sensor_as_point_stars(exposure_s: float, sigma_px: float) -> None:
    # Trails of up to 5 px in 30 s; fitted as round stars they would be at least 50 % wider.
    true = Sensor(reference_peak_dn=3000.0, reference_exposure_s=exposure_s, psf_sigma_px=sigma_px)
    drawn = StarPhoto.of(true, fov_deg=22, exposure_s=exposure_s)
    stars = detect_stars(drawn.image)
    matches = identify_near(stars, drawn.reference, drawn.solution)
    found = calibrate(drawn.image, stars, drawn.reference, matches, method="", exposure_s=exposure_s)

    assert found.stars.moved
    assert found.stars.longest_trail_px == pytest.approx(7.292e-5 * exposure_s * drawn.lens.fx_px, rel=0.1)
    assert found.sensor.psf_sigma_px == pytest.approx(sigma_px, rel=0.02)
    peak_dn = found.sensor.peak_dn([true.reference_vmag], exposure_s)[0]
    assert peak_dn == pytest.approx(true.reference_peak_dn, rel=0.045)  # 0.05 mag
    assert any("sidereal motion" in note.text for note in found.notes)


def test_a_tracking_mount_leaves_no_sidereal_trails() -> None:
    drawn = StarPhoto.of(Sensor(reference_peak_dn=3000.0), fov_deg=22)
    stars = detect_stars(drawn.image)
    matches = identify_near(stars, drawn.reference, drawn.solution)
    found = calibrate(drawn.image, stars, drawn.reference, matches, method="", exposure_s=30.0)
    assert not found.stars.moved
    assert found.sensor.psf_sigma_px == pytest.approx(1.2, rel=0.01)


def test_a_camera_that_shook_is_reported_without_a_psf_width() -> None:
    still = photo()
    # A shift by seven pixels to the right during the exposure.
    pixels = np.mean([np.roll(still.image.pixels_dn, step, axis=1) for step in range(-3, 4)], axis=0)
    shaken = still.with_pixels(np.floor(pixels + np.random.default_rng(1).normal(0, 2.5, pixels.shape) + 0.5))
    stars = detect_stars(shaken)
    assert stars.drawn_out_px == pytest.approx(7, rel=0.25)
    matches = identify_near(stars, still.reference, still.solution)
    with pytest.raises(CalibrationError, match=r"trails of about \d px, and sidereal motion explains 0"):
        calibrate(shaken, stars, still.reference, matches, method="", exposure_s=EXPOSURE_S)


@pytest.mark.parametrize("name", SENSORS)
def test_round_stars_are_not_reported_as_elongated(name: str) -> None:
    assert detected(name).drawn_out_px == 0


# --- the criteria of brightness ---------------------------------------------------------------------------------------


def test_the_slope_of_brightness_over_magnitude_agrees_with_scipy() -> None:
    rng = np.random.default_rng(4)
    vmag = np.round(rng.uniform(2, 7, 80), 1)  # with ties
    peak_dn = 100 * brightness_ratio(vmag - 5) * 10 ** rng.normal(0, 0.1, 80)
    fit = fit_brightness(vmag, peak_dn, np.ones(80, dtype=bool))
    slope, _, low, high = theilslopes(np.log10(peak_dn), vmag)
    assert fit.slope_dex_per_mag == pytest.approx(slope, abs=1e-12)
    assert (fit.slope_low_dex_per_mag, fit.slope_high_dex_per_mag) == pytest.approx((low, high), abs=1e-12)


def test_the_paper_s_criterion_picks_the_star_that_predicts_the_others_best() -> None:
    vmag, peak_dn = np.array([1.0, 2.0, 3.0]), np.array([100.0, 42.0, 10.0])
    norms = [np.linalg.norm(peak_dn[r] * brightness_ratio(vmag - vmag[r]) - peak_dn) for r in range(3)]
    fit = fit_brightness(vmag, peak_dn, np.ones(3, dtype=bool), criterion="paper")
    best = int(np.argmin(norms))
    assert (fit.reference_vmag, fit.reference_peak_dn) == (vmag[best], peak_dn[best])


def test_the_median_is_unbiased_where_the_paper_s_criterion_is_not() -> None:
    # equations.md, row 38: eq. (38) is -0.109 +- 0.168 mag off, the median of logarithms -0.008 +- 0.087.
    rng = np.random.default_rng(38)
    error_mag: dict[str, list[float]] = {"median": [], "paper": []}
    for _ in range(400):
        vmag = rng.uniform(1, 5, 40)
        peak_dn = 150 * brightness_ratio(vmag - 3 + rng.normal(0, 0.42, 40))
        for criterion, errors in error_mag.items():
            fit = fit_brightness(vmag, peak_dn, np.ones(40, dtype=bool), criterion=criterion)  # type: ignore[arg-type]
            errors.append(2.5 * float(np.log10(fit.peak_dn(np.array([3.0]))[0] / 150)))
    assert abs(np.mean(error_mag["median"])) < 0.02  # mag
    assert np.std(error_mag["median"]) < 0.12
    assert np.std(error_mag["paper"]) > 1.5 * np.std(error_mag["median"])


def test_the_stated_error_of_the_reference_brightness_matches_its_scatter() -> None:
    rng = np.random.default_rng(39)
    z = []
    for _ in range(400):
        vmag = rng.uniform(1, 5, 40)
        peak_dn = 150 * brightness_ratio(vmag - 3 + rng.normal(0, 0.42, 40))
        fit = fit_brightness(vmag, peak_dn, np.ones(40, dtype=bool))
        z.append(2.5 * np.log10(fit.peak_dn(np.array([3.0]))[0] / 150) / fit.error_mag)
    assert np.std(z) == pytest.approx(1.0, abs=0.15)  # its standard error is 0.035
    assert abs(np.mean(z)) < 0.2


def test_large_position_residuals_are_reported() -> None:
    right = calibrated()
    shaken = np.random.default_rng(5).normal(0.0, 0.5, right.matches.residual_px.shape)
    detected_ = replace(right.detected, xy_px=right.detected.xy_px.copy())
    detected_.xy_px[right.matches.detection] += shaken
    wrong = replace(right.matches, residual_px=right.matches.residual_px + shaken)

    found = calibrate(right.image, detected_, right.reference, wrong, method="by hand", exposure_s=0.5)

    assert not any("rms from the stars" in note.text for note in right.notes)
    assert any("px rms from the stars" in note.text for note in found.notes)


def test_a_compressive_response_is_reported() -> None:
    drawn = photo("sixteen bits")
    above = np.maximum(drawn.image.pixels_dn - 900, 0)
    squeezed = drawn.with_pixels(np.floor(900 + np.minimum(drawn.image.pixels_dn - 900, 0) + 60 * (above / 60) ** 0.8))
    stars = detect_stars(squeezed)
    matches = identify_near(stars, drawn.reference, drawn.solution)
    found = calibrate(squeezed, stars, drawn.reference, matches, method="", exposure_s=EXPOSURE_S)
    assert not found.brightness.linear
    assert any("the response is not linear" in note.text for note in found.notes)
    assert calibrated("sixteen bits").brightness.linear


# --- identification ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda pixels: pixels[:, ::-1], "mirrored"),
        (lambda pixels: pixels[::-1, ::-1], "turned by 180 deg"),
        (lambda pixels: pixels[::-1], "mirrored"),
    ],
)
def test_a_flipped_or_rotated_image_is_recognised_and_reported(change, words: str) -> None:
    drawn = photo()
    stars = detect_stars(drawn.with_pixels(np.ascontiguousarray(change(drawn.image.pixels_dn))))
    matches = identify_near(stars, drawn.reference, drawn.solution)
    assert any(words in note.text for note in matches.notes)
    assert len(matches) > 0.95 * len(calibrated().matches)


def test_a_rough_focal_length_is_enough_with_an_attitude() -> None:
    drawn = photo()
    lens = replace(drawn.lens, fx_px=1.1 * drawn.lens.fx_px, fy_px=1.1 * drawn.lens.fy_px)
    rough = replace(turned(drawn.solution, x_deg=1), camera=lens)
    matches = identify_near(detected(), drawn.reference, rough, focal_known=False)
    assert matches.solution.camera.fx_px == pytest.approx(drawn.lens.fx_px, rel=1e-3)


def test_an_attitude_in_another_part_of_the_sky_is_rejected() -> None:
    drawn = photo()
    with pytest.raises(CalibrationError, match="are not among them") as caught:
        identify_near(detected(), drawn.reference, turned(drawn.solution, x_deg=60))
    assert caught.value.stars_needed == 4


@pytest.mark.parametrize("mirrored", [False, True])
def test_stars_are_recognised_by_their_pattern_alone(mirrored: bool) -> None:
    pytest.importorskip("tetra3rs")
    drawn, stars = photo(), detected()
    if mirrored:
        xy_px = stars.xy_px.copy()
        xy_px[:, 0] = drawn.lens.width_px - 1 - xy_px[:, 0]
        stars = replace(stars, xy_px=xy_px)
    lens = replace(drawn.lens, fx_px=1.1 * drawn.lens.fx_px, fy_px=1.1 * drawn.lens.fy_px)

    matches = identify_lost(stars, ReferenceStars.anywhere(drawn.sky, drawn.exposure.mid_utc_s), ALL_STARS, lens)

    assert matches.solution.mirrored == mirrored
    assert matches.solution.camera.fx_px == pytest.approx(drawn.lens.fx_px, rel=1e-3)
    named = calibrated().matches
    assert set(zip(matches.star, matches.detection, strict=True)) >= set(
        zip(named.star[:300], named.detection[:300], strict=True)
    )


def test_stars_beside_a_roof_are_enough() -> None:
    # A roof hides half of the sky, and its bright edge is full of detections: most of the brightest stars are missing.
    pytest.importorskip("tetra3rs")
    drawn, rng = photo(), np.random.default_rng(8)
    pixels = drawn.image.pixels_dn.copy()
    pixels[:, 330:] = rng.normal(6, 2, (600, 470))
    pixels[:, 340:420:12] = 180 + rng.normal(0, 25, (600, 7))
    stars = detect_stars(drawn.with_pixels(np.floor(np.clip(pixels, 0, 255) + 0.5)))
    reference = ReferenceStars.anywhere(drawn.sky, drawn.exposure.mid_utc_s)

    for matches in (
        identify_lost(stars, reference, ALL_STARS, drawn.lens),
        identify_near(stars, reference, drawn.solution),
    ):
        off_px = np.linalg.norm(
            stars.xy_px[matches.detection] - drawn.true_xy_px(reference.stars.star_id[matches.star]), axis=1
        )
        bright = matches.predicted[: len(matches)]
        assert np.isin(bright, matches.star).mean() < 0.5
        assert matches.false_alarm < 1e-12
        assert np.median(off_px) < 0.2
        assert matches.solution.camera.fx_px == pytest.approx(drawn.lens.fx_px, rel=2e-3)


@pytest.mark.parametrize("clustered", [False, True])
def test_a_wrong_field_is_never_accepted_however_the_detections_cluster(clustered: bool) -> None:
    drawn, rng = photo(), np.random.default_rng(12)
    reference = drawn.reference
    for _ in range(60):
        count = int(rng.integers(50, 1000))
        xy_px = rng.uniform((5, 5), (795, 595), (count, 2))
        if clustered:
            lamps = rng.uniform((50, 50), (750, 550), (6, 2))
            xy_px = np.clip(lamps[rng.integers(0, 6, count)] + rng.normal(0, 25, (count, 2)), 5, 590)
        some = rng.integers(0, len(detected()), count)
        dots = replace(
            detected(),
            **{name: getattr(detected(), name)[some] for name in ("peak_dn", "sigma_px", "noise_dn", "saturated")},
            xy_px=xy_px,
        )
        attitude = Rotation.random(random_state=rng).as_matrix()
        matches = refine(dots, reference, replace(drawn.solution, C_camera_eq=attitude))
        assert matches is None or not is_significant(matches)


def test_too_few_matches_are_rejected_with_the_number_needed() -> None:
    drawn = photo()
    matches = refine(detected(), drawn.reference, drawn.solution)
    assert matches is not None
    assert 8 < matches.needed < 40
    few = slice(0, 5)
    scarce = replace(matches, star=matches.star[few], detection=matches.detection[few], chance=1.0, false_alarm=1e-3)
    with pytest.raises(CalibrationError, match=rf"5 agree with the catalogue, and {matches.needed} are needed"):
        require_significant(detected(), scarce)


def test_a_star_too_bright_for_a_fit_is_located_by_its_centroid() -> None:
    xy_px = np.array([[100.3, 80.6], [200.7, 150.1], [300.0, 60.5], [60.3, 220.8]])
    light = draw_stars((300, 400), xy_px, np.array([1e9, 150, 150, 150]), 1.1)
    pixels = np.minimum(light + np.random.default_rng(5).normal(20, 2, (300, 400)), 255)
    stars = detect_stars(Photograph(Path("drawn.png"), np.floor(pixels + 0.5), 8, "grey", None))

    assert len(stars) == 4
    assert stars.saturated[0]
    np.testing.assert_allclose(stars.xy_px[0], xy_px[0], rtol=0, atol=0.6)  # px


def test_a_lamp_and_a_bright_bar_are_no_stars() -> None:
    pixels = np.random.default_rng(5).normal(20, 2, (300, 400))
    pixels[100:160, 100:160] = 255
    pixels[200:203, 50:90] = 255
    assert len(detect_stars(Photograph(Path("drawn.png"), np.floor(pixels + 0.5), 8, "grey", None))) == 0


def test_the_brighter_of_two_blended_stars_is_matched() -> None:
    stars = np.array([[100.3, 50.0], [100.0, 50.0], [200.0, 80.0], [204.0, 80.0]])
    detection, distance_px = mutual_nearest(stars, np.array([[203.5, 80.0], [100.0, 50.0]]), 1.2)
    np.testing.assert_array_equal(detection, [1, 1, 0, 0])
    np.testing.assert_allclose(distance_px, [0.3, np.inf, np.inf, 0.5], rtol=0, atol=1e-12)


def test_a_missing_plate_solver_is_reported(monkeypatch) -> None:
    monkeypatch.setitem(__import__("sys").modules, "tetra3rs", None)
    drawn = photo()
    with pytest.raises(CalibrationError, match=re.escape(install_command("solve"))):
        identify_lost(detected(), drawn.reference, ALL_STARS, drawn.lens)


def test_random_dots_are_never_recognised() -> None:
    pytest.importorskip("tetra3rs")
    drawn, rng = photo(), np.random.default_rng(11)
    for number in range(2):
        dots = replace(detected(), xy_px=rng.uniform((5, 5), (795, 595), detected().xy_px.shape))
        with pytest.raises(CalibrationError):
            identify_lost(dots, ReferenceStars.anywhere(drawn.sky, 0.0), ALL_STARS, drawn.lens)
        if number == 0:
            with pytest.raises(CalibrationError):
                identify_near(dots, drawn.reference, drawn.solution)


@pytest.mark.parametrize("focal_known", [True, False])
def test_three_labels_are_enough(focal_known: bool) -> None:
    drawn, named = photo(), calibrated().stars
    labels = [Label(*np.round(named.xy_px[k]), int(named.star_id[k])) for k in (0, 7, 19)]
    matches = identify_by_labels(detected(), drawn.reference, labels, drawn.lens, focal_known=focal_known)
    assert len(matches) == len(calibrated().matches)


def test_contradictory_labels_are_rejected() -> None:
    drawn, named = photo(), calibrated().stars
    labels = [Label(*named.xy_px[k], int(named.star_id[other])) for k, other in ((0, 7), (7, 19), (19, 3), (3, 0))]
    with pytest.raises(CalibrationError, match="the labels contradict each other"):
        identify_by_labels(detected(), drawn.reference, labels, drawn.lens, focal_known=True)
    with pytest.raises(CalibrationError, match="2 labels were given, and an attitude needs 3"):
        identify_by_labels(detected(), drawn.reference, labels[:2], drawn.lens, focal_known=True)
    unknown = [*labels[:2], Label(1.0, 2.0, 9999)]
    with pytest.raises(CalibrationError, match="HR 9999"):
        identify_by_labels(detected(), drawn.reference, unknown, drawn.lens, focal_known=True)


# --- output -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", SENSORS)
def test_the_model_s_own_images_have_no_misfit(name: str) -> None:
    found = calibrated(name)

    assert found.misfit.notes(found.sensor) == ()


def test_the_simulator_reads_the_written_calibration(tmp_path) -> None:
    (tmp_path / "calibration.toml").write_text(calibrated().to_toml(), encoding="utf-8")
    (tmp_path / "glstar.toml").write_text('[sensor]\nfile = "calibration.toml"\n', encoding="utf-8")

    assert Config.load(tmp_path / "glstar.toml").sensor() == calibrated().sensor
    whole = Config.load(tmp_path / "calibration.toml")
    assert whole.sensor() == calibrated().sensor
    assert whole.camera().fx_px == pytest.approx(photo().lens.fx_px, rel=1e-3)


def test_the_calibration_report_is_an_image_file() -> None:
    page = cv2.imdecode(np.frombuffer(draw_report(calibrated()), dtype=np.uint8), cv2.IMREAD_COLOR)
    assert page.shape[1] == 1650
    # The page shows the photograph unchanged: dark, with stars.
    assert 10 < page[200:700, 100:780].mean() < 80


def test_an_image_with_too_many_saturated_stars_is_rejected() -> None:
    drawn = StarPhoto.of(Sensor(reference_peak_dn=3e6), size=(400, 300), fov_deg=60)
    stars = detect_stars(drawn.image)
    with pytest.raises(CalibrationError) as caught:
        calibrate(
            drawn.image,
            stars,
            drawn.reference,
            identify_near(stars, drawn.reference, drawn.solution),
            method="",
            exposure_s=EXPOSURE_S,
        )
    assert caught.value.stars_needed is not None


# --- images -----------------------------------------------------------------------------------------------------------


def test_a_colour_image_is_read_as_its_brightest_channel_by_default(tmp_path) -> None:
    pixels = np.zeros((40, 60, 3), dtype=np.uint8)
    pixels[..., 0], pixels[..., 1], pixels[..., 2] = 10, 60, 35  # blue, green, red
    cv2.imwrite(str(tmp_path / "colour.png"), pixels)
    values = {
        channel: read_image(tmp_path / "colour.png", channel=channel).pixels_dn.mean()
        for channel in ("value", "red", "green", "blue", "mean")
    }
    assert values == {"value": 60, "red": 35, "green": 60, "blue": 10, "mean": 35}


@pytest.mark.parametrize(("largest", "depth"), [(4095, 12), (1000, 16), (65535, 16), (1023, 10)])
def test_the_bit_depth_is_derived_from_the_largest_value(tmp_path, largest: int, depth: int) -> None:
    pixels = np.full((40, 40), 300, dtype=np.uint16)
    pixels[3, 3] = largest
    cv2.imwrite(str(tmp_path / "raw.png"), pixels)
    assert read_image(tmp_path / "raw.png").bit_depth == depth
    with pytest.raises(CalibrationError, match="--bit-depth"):
        read_image(tmp_path / "raw.png", bit_depth=8)


def test_exif_gives_the_exposure_and_turns_no_pixels(tmp_path) -> None:
    pixels = np.zeros((40, 80), dtype=np.uint8)
    pixels[:, :20] = 200
    _, encoded = cv2.imencode(".jpg", pixels)

    # An EXIF segment by hand: orientation 6 (turn right), an exposure of 1/4 s.
    def entry(tag: int, kind: int, value: int) -> bytes:
        return (
            tag.to_bytes(2, "little")
            + kind.to_bytes(2, "little")
            + (1).to_bytes(4, "little")
            + value.to_bytes(4, "little")
        )

    exif = b"II*\0" + (8).to_bytes(4, "little")
    exif += (2).to_bytes(2, "little") + entry(0x0112, 3, 6) + entry(0x8769, 4, 38) + bytes(4)
    exif += (1).to_bytes(2, "little") + entry(0x829A, 5, 56) + bytes(4)
    exif += (1).to_bytes(4, "little") + (4).to_bytes(4, "little")
    segment = b"Exif\0\0" + exif
    jpeg = encoded.tobytes()
    whole = jpeg[:2] + b"\xff\xe1" + (len(segment) + 2).to_bytes(2, "big") + segment + jpeg[2:]
    (tmp_path / "held.jpg").write_bytes(whole)

    image = read_image(tmp_path / "held.jpg")

    assert image.pixels_dn.shape == (40, 80)
    assert image.pixels_dn[:, :15].mean() > 190
    assert image.exposure_s == 0.25


@pytest.mark.parametrize("kind", ["jpg", "png"])
def test_a_truncated_image_is_rejected(tmp_path, kind: str) -> None:
    cv2.imwrite(str(tmp_path / f"whole.{kind}"), photo().image.pixels_dn.astype(np.uint8))
    content = (tmp_path / f"whole.{kind}").read_bytes()
    (tmp_path / f"half.{kind}").write_bytes(content[: len(content) // 2])
    with pytest.raises(CalibrationError, match="cut off"):
        read_image(tmp_path / f"half.{kind}")


@pytest.mark.parametrize(
    ("content", "words"), [(b"", "no image"), (b"GIF? no", "no image"), (None, "there is no such file")]
)
def test_a_file_that_is_not_an_image_is_rejected(tmp_path, content: bytes | None, words: str) -> None:
    if content is not None:
        (tmp_path / "none.jpg").write_bytes(content)
    with pytest.raises(CalibrationError, match=words):
        read_image(tmp_path / "none.jpg")


# --- real photographs -------------------------------------------------------------------------------------------------


@REAL
@pytest.mark.parametrize(
    ("name", "fov_deg", "f_px", "least", "rms_px"),
    [
        ("cisne_02sec.jpg", 25.0, 2657.7, 170, 0.3),
        ("vega_05sec.jpg", 30.0, 2657.7, 135, 0.4),
        ("polar_30sec.jpg", 27.0, 2657.7, 100, 0.7),
        ("2019-07-29T204726_Alt40_Azi135_Try1.tiff", 11.4, 5114.4, 27, 0.2),
        ("2019-07-29T204726_Alt60_Azi-45_Try1.tiff", 11.4, 5114.4, 12, 0.2),
    ],
)
def test_real_photographs_are_recognised_and_calibrated(
    name: str, fov_deg: float, f_px: float, least: int, rms_px: float
) -> None:
    pytest.importorskip("tetra3rs")
    image = read_image(PHOTOS / name)
    stars = detect_stars(image)
    height, width = image.pixels_dn.shape
    focal_px = width / 2 / np.tan(np.deg2rad(fov_deg) / 2)
    lens = replace(photo().lens, width_px=width, height_px=height, fx_px=focal_px, fy_px=focal_px)
    lens = replace(lens, cx_px=(width - 1) / 2, cy_px=(height - 1) / 2)
    reference = ReferenceStars.anywhere(photo().sky, photo().exposure.mid_utc_s)

    found = calibrate(
        image, stars, reference, identify_lost(stars, reference, ALL_STARS, lens), method="", exposure_s=1.0
    )

    assert len(found.stars) >= least
    assert found.matches.rms_px < rms_px
    assert found.matches.solution.camera.fx_px == pytest.approx(f_px, rel=0.002)
    assert found.brightness.scatter_mag < 0.3
    assert 0.4 < found.sensor.psf_sigma_px < 1.0


@REAL
@pytest.mark.parametrize(
    ("name", "fov_deg", "f_px", "radec_deg", "least"),
    [("IMG_007985.jpg", 27.0, 2663.0, (81.5, -9.3), 80), ("roof.jpg", 10.2, 2848.0, None, 17)],
)
def test_real_photographs_with_half_of_the_sky_hidden_are_recognised(
    name: str, fov_deg: float, f_px: float, radec_deg: tuple[float, float] | None, least: int
) -> None:
    pytest.importorskip("tetra3rs")
    image = read_image(PHOTOS / name)
    height, width = image.pixels_dn.shape
    focal_px = width / 2 / np.tan(np.deg2rad(fov_deg) / 2)
    lens = Camera(width, height, focal_px, focal_px, (width - 1) / 2, (height - 1) / 2)
    reference = ReferenceStars.anywhere(photo().sky, photo().exposure.mid_utc_s)

    matches = identify_lost(detect_stars(image), reference, ALL_STARS, lens)

    assert len(matches) >= least
    assert matches.rms_px < 0.5
    assert matches.solution.camera.fx_px == pytest.approx(f_px, rel=0.005)
    if radec_deg is not None:
        axis = matches.solution.camera.unit_vectors([(width - 1) / 2, (height - 1) / 2])
        ra_rad, dec_rad = right_ascension_declination(axis @ matches.solution.C_camera_eq @ reference.stars.C_eq_icrs)
        np.testing.assert_allclose(np.rad2deg([ra_rad, dec_rad]), radec_deg, rtol=0, atol=0.15)  # deg


@pytest.mark.parametrize(("error_px", "noted"), [(0.01, True), (5.0, False), (None, False)])
def test_a_precise_focal_length_without_time_and_site_is_noted_as_too_short(error_px, noted):
    """Refraction at the zenith is 58.3 arcsec a radian of zenith distance: a focal length 0.028 % shorter."""
    solution = SimpleNamespace(camera=SimpleNamespace(fx_px=1000.0), C_camera_eq=np.eye(3))
    reference = ReferenceStars.anywhere(photo().sky, photo().exposure.mid_utc_s)
    errors = {} if error_px is None else with_refraction({"fx_px": error_px}, reference, solution)
    matches = SimpleNamespace(standard_error=errors, solution=solution)

    without = refraction_notes(reference, matches)

    assert len(without) == noted
    assert all("0.03% too short" in note.text and "--utc" in note.text for note in without)
    assert refraction_notes(replace(reference, C_ned_eq=np.eye(3)), matches) == ()
