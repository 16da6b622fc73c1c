"""The reference brightness: which stars a fit uses, and all of its numbers, against SciPy and by hand."""

from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.integrate import quad
from scipy.stats import theilslopes

from glstar.calibrate.identify.platesolution import PlateSolution, sidereal_trails
from glstar.calibrate.photo.photograph import Photograph
from glstar.calibrate.photo.psf import draw_stars
from glstar.calibrate.sensor.fit import (
    BrightnessFit,
    MeasuredStars,
    _blended,
    _fit_in_range,
    _measurable,
    _median,
    _median_error,
    _moving,
    _refuse_shaken,
    fit_brightness,
    fit_sensor,
)
from glstar.camera.model import Camera
from glstar.errors import CalibrationError

SIGMA_PX, NOISE_DN, RANGE_DN = 1.4, 2.5, 3200.0
# Brightness of a star of magnitude 4, DN.
PEAK_DN = 900.0
WIGGLE = np.array([0.021, -0.034, 0.008, -0.013, 0.027, -0.002, 0.017])


def measured(
    vmag: np.ndarray, peak_dn: np.ndarray, trail_px: np.ndarray | None = None, **flags: object
) -> MeasuredStars:
    count, zero = len(vmag), np.zeros(len(vmag))
    flag = {name: np.isin(np.arange(count), flags.get(name, [])) for name in ("saturated", "blended")}
    trail_px = np.zeros((count, 2)) if trail_px is None else trail_px
    names, numbers = tuple(map(str, range(count))), np.arange(count, dtype=np.int32)
    pair = np.zeros((count, 2))
    return MeasuredStars(
        "bsc5", numbers, names, vmag, pair, pair, peak_dn, zero, zero, **flag, psf_sigma_error_px=0.0, trail_px=trail_px
    )


def law(vmag: np.ndarray) -> np.ndarray:
    return PEAK_DN * 10 ** (-0.4 * (vmag - 4.0))


def magnitude_of(peak_dn: float) -> float:
    return 4.0 - 2.5 * np.log10(peak_dn / PEAK_DN)


def test_the_median_criterion_reduces_each_star_to_the_reference() -> None:
    vmag = np.array([2.13, 3.4, 3.923, 5.07, 4.21, 4.66, 1.0])
    off = np.array([0.11, -0.07, 0.02, 0.19, -0.3, -0.16, 2.0])
    peak = 500.0 * 10 ** (-0.4 * (vmag + off))
    used = np.array([True, True, True, True, False, True, False])
    fit = fit_brightness(vmag, peak, used)
    middle = np.median(off[used])
    assert fit.criterion == "median"
    assert fit.reference_vmag == 3.92
    assert fit.reference_peak_dn == pytest.approx(500.0 * 10 ** (-0.4 * (3.92 + middle)), rel=1e-12)
    assert fit.used is used
    scatter = 1.4826 * np.median(np.abs(off[used] - middle))
    assert fit.scatter_mag == pytest.approx(scatter, rel=1e-9)
    assert fit.error_mag == pytest.approx(np.sqrt(np.pi / 2) * scatter / np.sqrt(5), rel=1e-9)
    slope, _, low, high = theilslopes(np.log10(peak[used]), vmag[used])
    assert (fit.slope_dex_per_mag, fit.slope_low_dex_per_mag, fit.slope_high_dex_per_mag) == pytest.approx(
        (slope, low, high), rel=1e-12
    )
    sloping = np.array([True, True, False, True, True, True, True])
    slope, _, low, high = theilslopes(np.log10(peak[sloping]), vmag[sloping])
    other = fit_brightness(vmag, peak, used, sloping=sloping)
    assert (other.slope_dex_per_mag, other.slope_low_dex_per_mag, other.slope_high_dex_per_mag) == pytest.approx(
        (slope, low, high), rel=1e-12
    )
    assert (other.reference_peak_dn, other.scatter_mag) == (fit.reference_peak_dn, fit.scatter_mag)


@pytest.mark.parametrize("seed", range(5))
def test_the_paper_s_criterion_takes_the_star_that_predicts_the_others_best(seed: int) -> None:
    rng = np.random.default_rng(seed)
    vmag = np.array([2.1, 3.4, 3.9, 5.0, 4.2, 4.6]) * (1.0 if seed % 2 else 0.1)
    peak = 500.0 * 10 ** (-0.4 * (vmag + rng.normal(0, 0.4, 6)))
    used = np.arange(6) != 4
    fit = fit_brightness(vmag, peak, used, criterion="paper")
    costs = [
        sum((peak[i] - peak[r] * 10 ** (-0.4 * (vmag[i] - vmag[r]))) ** 2 for i in np.flatnonzero(used))
        for r in np.flatnonzero(used)
    ]
    best = np.flatnonzero(used)[int(np.argmin(costs))]
    assert (fit.criterion, fit.reference_vmag, fit.reference_peak_dn) == ("paper", vmag[best], peak[best])


def test_stars_of_one_magnitude_have_no_slope() -> None:
    fit = fit_brightness(np.full(4, 3.0), np.array([10.0, 11.0, 12.0, 14.0]), np.ones(4, bool))
    assert np.isnan(fit.slope_dex_per_mag)
    assert (fit.slope_low_dex_per_mag, fit.slope_high_dex_per_mag) == (-np.inf, np.inf)
    assert fit.linear
    assert fit.reference_peak_dn == pytest.approx(np.sqrt(11 * 12), rel=1e-12)


@pytest.mark.parametrize("seed", range(4))
def test_the_slope_of_tied_magnitudes_is_that_of_scipy(seed: int) -> None:
    rng = np.random.default_rng(seed)
    count = 14 + 16 * seed
    vmag, log_peak = rng.integers(20, 30 + 10 * seed, count) / 10, rng.integers(0, 40 + 200 * seed, count) / 100
    fit = fit_brightness(vmag, 10**log_peak, np.ones(count, bool))
    slope, _, low, high = theilslopes(log_peak, vmag)
    assert (fit.slope_dex_per_mag, fit.slope_low_dex_per_mag, fit.slope_high_dex_per_mag) == pytest.approx(
        (slope, low, high), rel=1e-9, abs=1e-12
    )


class Matched(SimpleNamespace):
    """The part of `Matches` that a fit of the sensor uses."""

    def __len__(self) -> int:
        return len(self.star)


def in_range(stars: MeasuredStars, *, complete_vmag: float = 9.0, **given: object) -> BrightnessFit:
    return _fit_in_range(stars, given.pop("criterion", "median"), SIGMA_PX, NOISE_DN, RANGE_DN, complete_vmag)


def edges(trail_px: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
    """Return magnitudes of stars about each limit, and the trails of all."""
    # A trail's peak over that of a star at rest: the mean of the Gaussian along it; the pixel widens it further.
    along = 1.0
    if trail_px:
        along = quad(lambda t: np.exp(-((t * trail_px) ** 2) / (2 * SIGMA_PX**2)), -0.5, 0.5)[0]
    recorded = SIGMA_PX**2 / (SIGMA_PX**2 + 1 / 12)
    full = RANGE_DN / (along * recorded)
    peaks = [
        0.97 * full,
        0.93 * full,
        0.87 * full,
        0.505 * full,
        0.495 * full,
        10.4 * NOISE_DN / along,
        9.6 * NOISE_DN / along,
    ]
    between = np.geomspace(0.4 * full, 14 * NOISE_DN / along, 14)
    return np.array([magnitude_of(peak) for peak in (*peaks, *between)]), np.array([trail_px * 0.6, -trail_px * 0.8])


@pytest.mark.parametrize("trail_px", [0.0, 5.0])
def test_a_fit_uses_stars_expected_between_the_noise_and_half_of_the_range(trail_px: float) -> None:
    vmag, trail = edges(trail_px)
    count = len(vmag)
    peak = law(vmag + np.resize(WIGGLE, count) / 10)
    stars = measured(vmag, peak, np.tile(trail, (count, 1)), saturated=[9], blended=[11])
    fit = in_range(stars)
    lone = ~np.isin(np.arange(count), [9, 11])
    within = lone & ~np.isin(np.arange(count), [0, 1, 2, 3, 6])
    assert fit.used.tolist() == within.tolist()
    # The slope is measured on stars up to nine tenths of the range.
    sloping = within | np.isin(np.arange(count), [2, 3])
    assert sloping.sum() == 16
    slope, _, low, high = theilslopes(np.log10(peak[sloping]), vmag[sloping])
    assert (fit.slope_dex_per_mag, fit.slope_low_dex_per_mag, fit.slope_high_dex_per_mag) == pytest.approx(
        (slope, low, high), rel=1e-9
    )
    # On the stars of the brighter half of the catalogue, if they are fifteen; else on those of the fit.
    order = np.sort(vmag[sloping])
    fifteen = sloping & (vmag <= order[14])
    fit = in_range(stars, complete_vmag=float(order[14]))
    slope, _, low, high = theilslopes(np.log10(peak[fifteen]), vmag[fifteen])
    assert (fit.slope_dex_per_mag, fit.slope_low_dex_per_mag, fit.slope_high_dex_per_mag) == pytest.approx(
        (slope, low, high), rel=1e-9
    )
    fit = in_range(stars, complete_vmag=float(order[14]) - 0.001)
    slope, _, low, high = theilslopes(np.log10(peak[within]), vmag[within])
    assert (fit.slope_dex_per_mag, fit.slope_low_dex_per_mag, fit.slope_high_dex_per_mag) == pytest.approx(
        (slope, low, high), rel=1e-9
    )
    assert in_range(stars, criterion="paper").criterion == "paper"


def test_stars_are_chosen_by_their_expected_brightness_if_enough_remain() -> None:
    """Six stars within the range are chosen by magnitude; with five, all that are measured above the noise stay."""
    bright = [magnitude_of(0.8 * RANGE_DN), magnitude_of(0.7 * RANGE_DN)]
    for count in (6, 5):
        vmag = np.array([*bright, *np.linspace(4.0, 5.5, count)])
        # A faint star that is measured above the noise, and the first one below it.
        vmag = np.append(vmag, magnitude_of(5 * NOISE_DN))
        peak = law(vmag)
        peak[-1] = 12 * NOISE_DN
        fit = in_range(measured(vmag, peak))
        if count == 6:
            assert fit.used.tolist() == [False, False] + [True] * count + [False]
        else:
            assert fit.used.all()
    # Of too few above the noise, all that have light count.
    faint = measured(np.array([4.0, 4.5, 5.0, 5.5, 6.0]), np.array([9.0, 9.5, 10.4, -1.0, 0.0]) * NOISE_DN)
    assert in_range(faint).used.tolist() == [True, True, True, False, False]
    some = measured(np.array([4.0, 4.5, 5.0, 5.5, 6.0]), np.array([10.4, 10.5, 10.6, 9.6, 2.0]) * NOISE_DN)
    assert in_range(some).used.tolist() == [True, True, True, False, False]


def test_three_stars_must_be_measurable() -> None:
    matches = Matched(star=np.arange(6))
    saturated, blended = np.array([1, 1, 0, 0, 0, 0], bool), np.array([0, 1, 1, 0, 0, 0], bool)
    assert _measurable(matches, saturated, blended).tolist() == [False, False, False, True, True, True]
    blended[3] = True
    with pytest.raises(
        CalibrationError, match="of 6 identified stars 2 are saturated and 2 can be measured, but 3 are needed"
    ) as caught:
        _measurable(matches, saturated, blended)
    assert (caught.value.stars_used, caught.value.stars_needed) == (2, 3)


def test_measured_stars_moved_if_one_has_a_trail() -> None:
    vmag = np.array([3.0, 4.0])
    at_rest, moved = measured(vmag, vmag), measured(vmag, vmag, np.array([[0.0, 0.0], [3.0, -4.0]]))
    assert (at_rest.moved, at_rest.longest_trail_px, len(at_rest)) == (False, 0.0, 2)
    assert (moved.moved, moved.longest_trail_px) == (True, 5.0)
    assert measured(np.empty(0), np.empty(0)).longest_trail_px == 0.0


def test_a_weighted_median_is_interpolated_and_its_error_is_that_of_resampled_stars() -> None:
    # Weights up to the middle of each value: 1, 3.5, 6.25; half of all is 3.75.
    assert _median(np.array([5.0, 2.0, 3.0]), np.array([2.5, 2.0, 3.0])) == pytest.approx(
        3 + 2 * 0.25 / 2.75, rel=1e-12
    )
    rng = np.random.default_rng(2)
    values = rng.normal(1.3, 0.2, 400)
    # The median of a normal distribution has the standard error 1.2533 sigma / sqrt(n).
    assert _median_error(values, np.ones(400)) == pytest.approx(1.2533 * 0.2 / 20, rel=0.4)
    errors = [np.std([_median(values[k], np.ones(400)) for k in np.random.default_rng(0).integers(0, 400, (200, 400))])]
    assert _median_error(values, np.ones(400)) == pytest.approx(errors[0], rel=1e-12)


def fake_fits(
    monkeypatch: pytest.MonkeyPatch, moving_dn: list[float], standing_dn: list[float]
) -> list[SimpleNamespace]:
    """Replace the fit of stars by one with given misfits of trails and of points, and return its calls."""
    calls: list[SimpleNamespace] = []

    def fit_stars(above_dn: np.ndarray, usable: np.ndarray, xy_px: np.ndarray, **given: object) -> SimpleNamespace:
        calls.append(SimpleNamespace(above_dn=above_dn, usable=usable, xy_px=xy_px, **given))
        misfit = np.array(moving_dn if np.any(given["trail_px"]) else standing_dn)
        return SimpleNamespace(misfit_dn=misfit, unbiased_sigma_px=misfit / 10)

    monkeypatch.setattr("glstar.calibrate.sensor.fit.fit_stars", fit_stars)
    return calls


def test_trails_are_fitted_if_they_are_long_and_fit_most_bright_stars_better(monkeypatch: pytest.MonkeyPatch) -> None:
    detected = SimpleNamespace(
        xy_px=np.arange(8.0).reshape(4, 2), psf_sigma_px=1.5, sigma_px=np.array([1.1, 1.2, 1.3, 1.4]), drawn_out_px=0.0
    )
    above, usable, identified = np.zeros((3, 3)), np.ones((3, 3), bool), np.array([3, 0, 1])
    bright = np.array([True, True, False])
    calls = fake_fits(monkeypatch, [2.0, 3.0, 9.0], [2.3, 2.9, 1.0])
    # Three tenths of a sigma is too short.
    for length_px, fitted in ((0.44, False), (0.46, True)):
        trail = np.array([[0.0, 0.1], [0.6 * length_px, -0.8 * length_px], [0.0, 0.0], [0.2, 0.0]])
        width_px, moved = _moving(above, usable, detected, identified, bright, trail)
        assert (len(calls), moved) == (2 * fitted, fitted)
        assert width_px.tolist() == ([0.2, 0.3, 0.9] if fitted else [1.4, 1.1, 1.2])
    for call, fitted_trail in zip(calls, (trail, np.zeros((4, 2))), strict=True):
        assert call.start_sigma_px == 1.5
        np.testing.assert_array_equal(call.trail_px, fitted_trail)
        np.testing.assert_array_equal(call.stamp_trail_px, trail)
        assert call.only is identified
    assert _moving(above, usable, detected, identified, bright, np.zeros((0, 2)))[1] is False
    assert len(calls) == 2
    exact = SimpleNamespace(**vars(detected) | {"psf_sigma_px": 2.0})
    assert _moving(above, usable, exact, identified, bright, np.array([[0.6, 0.0], [0.0, 0.0]]))[1]
    # Trails that fit as well as points are none.
    fake_fits(monkeypatch, [2.0, 3.0, 0.1], [2.0, 3.0, 9.0])
    assert not _moving(above, usable, detected, identified, bright, trail)[1]
    # Points fit better in the geometric mean of both bright stars, although a faint one is better as a trail.
    fake_fits(monkeypatch, [2.0, 3.0, 0.1], [1.9, 3.1, 9.0])
    assert not _moving(above, usable, detected, identified, bright, trail)[1]
    # The detected width has a sixth of the trail in it, and stars are no narrower than half a pixel.
    for drawn_out_px, start_px in ((4.2, 0.8), (5.7, 0.55), (6.3, 0.5)):
        detected.drawn_out_px = drawn_out_px
        calls = fake_fits(monkeypatch, [2.0, 3.0, 0.1], [1.9, 3.1, 9.0])
        _moving(above, usable, detected, identified, bright, trail)
        assert [call.start_sigma_px for call in calls] == pytest.approx([start_px] * 2, rel=1e-12)


def one_photograph() -> tuple[Photograph, SimpleNamespace, SimpleNamespace, Matched]:
    """Return a photograph of eleven stars on a sloping sky, seven of them identified, and what was detected."""
    true_px, sky_dn = 1.35, 100 + 0.3 * np.arange(150)[np.newaxis] + 0.2 * np.arange(110)[:, np.newaxis]
    columns, rows = np.meshgrid([20.3, 55.8, 90.1, 125.6], [18.2, 54.7, 92.4])
    xy = np.column_stack([columns.ravel(), rows.ravel()])[:11]
    peak = np.array([3000.0, 900, 700, 500, 400, 300, 250, 200, 150, 120, 90])
    pixels = sky_dn + draw_stars((110, 150), xy, peak, true_px)
    noise = np.full(11, 7.0) + 0.1 * np.arange(11)
    noise[6] = 250 / 9.9
    detected = SimpleNamespace(
        xy_px=xy,
        peak_dn=1.1 * peak,
        sigma_px=1.35 + np.array([0.3, 0.05, -0.04, 0.02, 0.01, -0.03, 0.2, 0.07, -0.06, 0.04, 0.08]),
        noise_dn=noise,
        signal_to_noise=peak / noise,
        saturated=np.arange(11) == 0,
        psf_sigma_px=1.3,
        background=SimpleNamespace(level_dn=sky_dn),
        sky=SimpleNamespace(mean_dn=110.0, std_dn=6.5),
        drawn_out_px=0.0,
    )
    order = np.array([0, 1, 2, 3, 4, 5, 6])
    stars = SimpleNamespace(
        catalogue="bsc5",
        star_id=np.arange(50, 57, dtype=np.int32),
        name=tuple("abcdefg"),
        vmag=4.0 - 2.5 * np.log10(peak[:7] / 1000),
    )
    lens = Camera(150, 110, 900.0, 900.0, 74.5, 54.5)
    matches = Matched(
        star=order,
        detection=order,
        residual_px=np.full((7, 2), 0.1),
        predicted=order,
        predicted_xy_px=xy[:7],
        solution=PlateSolution(lens, np.eye(3)[[1, 2, 0]]),
    )
    image = Photograph(Path("a.png"), pixels, 12, "grey", None)
    return image, detected, SimpleNamespace(stars=stars), matches


def test_a_sensor_has_the_median_width_of_bright_stars_and_the_amplitudes_for_it() -> None:
    image, detected, reference, matches = one_photograph()
    sensor, fit, stars = fit_sensor(image, detected, reference, matches, exposure_s=0.25)
    # Star 0 is saturated, and star 6 has a signal-to-noise ratio below 10.  Weights are squares up to 60.
    wide = slice(1, 6)
    weights = np.minimum(detected.signal_to_noise[wide], 60.0) ** 2
    typical = _median(detected.sigma_px[wide], weights)
    assert sensor.psf_sigma_px == typical
    assert stars.psf_sigma_error_px == _median_error(detected.sigma_px[wide], weights)
    assert len(set(weights[:2])) == 1  # the first two are brighter than that
    assert stars.peak_dn[0] == detected.peak_dn[0]
    # A Gaussian of another width than the one drawn fits best with the amplitude of their overlap; pixels widen both.
    drawn2, fitted2 = 1.35**2, typical**2
    overlap = 2 * drawn2 * (fitted2 + 1 / 12) / (fitted2 * (drawn2 + fitted2 + 1 / 6))
    np.testing.assert_allclose(stars.peak_dn[1:] / [900, 700, 500, 400, 300, 250], overlap, rtol=2e-3)
    assert (sensor.reference_exposure_s, sensor.sky_mean_dn, sensor.sky_std_dn, sensor.bit_depth) == (
        0.25,
        110.0,
        6.5,
        12,
    )
    assert (sensor.reference_vmag, sensor.reference_peak_dn) == (fit.reference_vmag, fit.reference_peak_dn)
    # Without trails the widths are those of the detections.
    assert stars.sigma_px.tolist() == detected.sigma_px[:7].tolist()
    assert not stars.moved
    assert fit.criterion == "median"
    assert stars.noise_dn.tolist() == detected.noise_dn[:7].tolist()
    assert (stars.name, stars.catalogue, stars.star_id.tolist()) == (tuple("abcdefg"), "bsc5", list(range(50, 57)))
    assert fit_sensor(image, detected, reference, matches, exposure_s=0.25, criterion="paper")[1].criterion == "paper"


def test_pixels_near_the_largest_number_do_not_count() -> None:
    """A wrong pixel beside a star is left out from 98 % of the range on, in whole numbers; below it changes the fit."""
    image, detected, reference, matches = one_photograph()
    right = fit_sensor(image, detected, reference, matches, exposure_s=0.25)[2].peak_dn
    for value_dn, counts in ((np.floor(0.98 * 4095), False), (np.floor(0.98 * 4095) - 1, True)):
        image.pixels_dn[55, 91] = value_dn
        found = fit_sensor(image, detected, reference, matches, exposure_s=0.25)[2].peak_dn
        assert (abs(found[6] / right[6] - 1) > 0.02) == counts
        np.testing.assert_allclose(found[:6], right[:6], rtol=1e-9)


def test_few_bright_stars_give_the_width_together_with_faint_ones() -> None:
    image, detected, reference, matches = one_photograph()
    for bright in (3, 2):
        detected.signal_to_noise = np.where(np.arange(11) <= bright, 10.0, 9.0)
        sensor = fit_sensor(image, detected, reference, matches, exposure_s=0.25)[0]
        wide = slice(1, 1 + bright) if bright == 3 else slice(1, 7)
        assert sensor.psf_sigma_px == _median(detected.sigma_px[wide], detected.signal_to_noise[wide] ** 2)


def test_trails_of_the_turning_sky_are_taken_out() -> None:
    """Stars drawn as trails of 5 px keep the width and the amplitude of stars at rest."""
    image, detected, reference, matches = one_photograph()
    trail_px = sidereal_trails(matches.solution, detected.xy_px, 90.0)
    assert np.linalg.norm(trail_px, axis=1).min() > 5
    level_dn = detected.background.level_dn
    peak = np.array([3000.0, 900, 700, 500, 400, 300, 250, 200, 150, 120, 90])
    image.pixels_dn[:] = level_dn + draw_stars((110, 150), detected.xy_px, peak, 1.35, trail_px=trail_px)
    sensor, _, stars = fit_sensor(image, detected, reference, matches, exposure_s=90.0)
    assert sensor.psf_sigma_px == pytest.approx(1.35, rel=1e-3)
    np.testing.assert_allclose(stars.peak_dn[1:], peak[1:7], rtol=1e-3)
    np.testing.assert_allclose(stars.sigma_px[1:], 1.35, rtol=1e-3)
    np.testing.assert_array_equal(stars.trail_px, trail_px[:7])
    assert stars.moved


def test_limits_of_blends_and_trails_are_their_first_values() -> None:
    """A neighbour fainter by 3.5 mag exactly is none; nor is a camera shaken with 2.5 sigma more than its trails."""
    reference = SimpleNamespace(stars=SimpleNamespace(vmag=np.array([2.0, 5.5, 2.0, 5.25])))
    places = np.array([[0.0, 0.0], [3.0, 0.0], [100.0, 0.0], [103.0, 0.0]])
    matches = Matched(star=np.array([0, 2]), predicted=np.arange(4), predicted_xy_px=places)
    assert _blended(reference, matches, 1.5).tolist() == [False, True]
    _refuse_shaken(SimpleNamespace(drawn_out_px=5.0), np.zeros((3, 2)), 2.0)
    with pytest.raises(CalibrationError, match=r"trails of about 5 px, and sidereal motion explains 0\.0 px"):
        _refuse_shaken(SimpleNamespace(drawn_out_px=5.01), np.zeros((3, 2)), 2.0)
