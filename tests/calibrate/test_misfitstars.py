"""Which stars show a misfit: shapes, wings and rings of profiles, with hand-made stars."""

from types import SimpleNamespace

import numpy as np
import pytest

from glstar.calibrate.sensor import misfitmeasurement
from glstar.calibrate.sensor.misfit import Measurement
from glstar.calibrate.sensor.misfitmeasurement import (
    _star_profile,
    _weighted_median,
    measure_misfit,
)
from glstar.camera.sensor.sensor import Sensor
from tests.support.handmade import Stars, law, picture


def misfit_of(monkeypatch: pytest.MonkeyPatch, count: int = 160, trail_px: float = 0.0, drawn_out_px: float = 0.0):
    """Return a misfit whose shapes are not measured, its stars, and the stars whose shapes were asked for."""
    rng = np.random.default_rng(10)
    xy = rng.uniform(0, [399, 299], (count, 2))
    noise = np.full(count, 4.0)
    signal = np.linspace(200, 30, count)
    if count == 60:
        signal[-2:] = 20.0, 19.5
    vmag = 3.9 - 2.5 * np.log10(signal * 4 / 800)
    saturated, blended = np.arange(count) == 3, np.arange(count) == 5
    stars = Stars(
        xy_px=xy,
        peak_dn=signal * 4,
        noise_dn=noise,
        vmag=vmag,
        sigma_px=np.full(count, 1.3),
        saturated=saturated,
        blended=blended,
        longest_trail_px=trail_px,
    )
    used = np.arange(count) % 3 != 0
    detection = np.arange(count)[::-1].copy()
    solution = SimpleNamespace(camera=SimpleNamespace(width_px=400, cx_px=190.0, cy_px=160.0), mirrored=False)
    matches = SimpleNamespace(solution=solution, detection=detection)
    detected = SimpleNamespace(
        background=SimpleNamespace(level_dn=np.full((300, 400), 20.0), noise_dn=np.full((300, 400), 4.0)),
        xy_px=xy,
        psf_sigma_px=1.3,
        drawn_out_px=drawn_out_px,
    )
    asked: dict[str, object] = {}

    def wings(image: object, detected: object, chosen: object, sigma_px: float, signal: object) -> tuple:
        asked.update(chosen=chosen, sigma_px=sigma_px, signal=signal)
        return Measurement(0.01, 0.02), None

    def ellipticity(image: object, detected: object, xy_px: object, sigma_px: float) -> tuple:
        asked.update(xy_px=xy_px)
        return Measurement(0.03, 0.04), 0.5

    monkeypatch.setattr(misfitmeasurement, "measure_wings", wings)
    monkeypatch.setattr(misfitmeasurement, "measure_ellipticity", ellipticity)
    image = picture(20 + 4 * rng.standard_normal((300, 400)))
    return measure_misfit(image, detected, matches, Sensor(psf_sigma_px=1.4), law(used), stars), stars, asked


def test_shapes_are_measured_on_the_150_brightest_lone_stars(monkeypatch: pytest.MonkeyPatch) -> None:
    found, stars, asked = misfit_of(monkeypatch)
    signal = stars.peak_dn / 4.0
    lone = [k for k in range(160) if k not in {3, 5}]
    assert len(lone) > 150
    expected = lone[:150]  # they are in the order of their brightness
    assert asked["chosen"].tolist() == (159 - np.array(expected)).tolist()
    np.testing.assert_allclose(asked["signal"], signal[expected], rtol=1e-12)
    np.testing.assert_array_equal(asked["xy_px"], stars.xy_px[expected])
    assert asked["sigma_px"] == 1.4
    assert (found.wing_fraction, found.ellipticity, found.long_axis_rad) == (
        Measurement(0.01, 0.02),
        Measurement(0.03, 0.04),
        0.5,
    )
    # All stars are a tenth of a magnitude too faint, evenly.
    assert found.corner_growth.value == pytest.approx(0, abs=1e-9)
    assert found.corner_loss_mag.value == pytest.approx(0, abs=1e-9)
    assert np.nanmax(np.abs(found.brightness_map_mag - 0.1)) < 1e-9
    assert found.mean_loss_mag == pytest.approx(0, abs=1e-9)
    assert found.gradient_dn.value == pytest.approx(0, abs=1e-9)
    assert found.neighbour_correlation.value == pytest.approx(0, abs=0.03)


def test_shapes_are_measured_on_stars_of_twenty_times_the_noise(monkeypatch: pytest.MonkeyPatch) -> None:
    _, stars, asked = misfit_of(monkeypatch, 60)
    expected = [k for k in range(59) if k not in {3, 5}]
    np.testing.assert_array_equal(asked["xy_px"], stars.xy_px[expected])


def test_shapes_need_eight_stars_with_short_trails(monkeypatch: pytest.MonkeyPatch) -> None:
    for count, measured in ((10, True), (9, False)):  # two of them are saturated or blended
        found, _, asked = misfit_of(monkeypatch, count)
        assert ("chosen" in asked, found.wing_fraction is not None) == (measured, measured)
        assert found.corner_growth is None
    # Half a sigma of a trail is too long; elongated stars have wings but no ellipse.
    for trail_px, measured in ((0.69, True), (0.5 * 1.4, False), (0.71, False)):
        found, _, asked = misfit_of(monkeypatch, trail_px=trail_px)
        assert ("chosen" in asked, found.ellipticity is not None) == (measured, measured)
    found, _, _ = misfit_of(monkeypatch, drawn_out_px=3.0)
    assert (found.wing_fraction is not None, found.ellipticity, found.long_axis_rad) == (True, None, 0.0)


def test_the_brightness_of_wider_stars_is_not_underestimated() -> None:
    """Stars that widen to the corner keep their flux: their amplitude for one width is that of the overlap."""
    rng = np.random.default_rng(11)
    count, axis = 120, np.array([199.5, 149.5])
    xy = rng.uniform(0, [399, 299], (count, 2))
    r2 = ((xy - axis) ** 2).sum(axis=1) / (axis**2).sum()
    width = 1.4 * (1 + 0.3 * r2)
    width /= np.median(width) / 1.4
    fitted2, real2 = 1.4**2 + 1 / 12, width**2 + 1 / 12
    vmag = rng.uniform(3, 5, count)
    peak = 800 * 10 ** (-0.4 * (vmag - 4)) * 2 * fitted2 / (fitted2 + real2)
    none = np.zeros(count, bool)
    stars = Stars(
        xy_px=xy,
        peak_dn=peak,
        noise_dn=np.full(count, 4.0),
        vmag=vmag,
        sigma_px=width,
        saturated=none,
        blended=none,
        longest_trail_px=9.0,
    )
    solution = SimpleNamespace(camera=SimpleNamespace(width_px=400, cx_px=199.5, cy_px=149.5), mirrored=False)
    level = np.full((300, 400), 20.0)
    background = SimpleNamespace(level_dn=level, noise_dn=level)
    detected = SimpleNamespace(background=background, xy_px=xy, psf_sigma_px=1.3, drawn_out_px=0.0)
    matches = SimpleNamespace(solution=solution, detection=np.arange(count))
    found = measure_misfit(picture(level), detected, matches, Sensor(psf_sigma_px=1.4), law(~none), stars)
    assert found.corner_growth.value == pytest.approx(0.3, rel=1e-3)
    assert found.corner_loss_mag.value == pytest.approx(0, abs=1e-3)
    assert np.nanmax(np.abs(found.brightness_map_mag)) < 1e-3
    assert (found.wing_fraction, found.stacked, found.ellipticity, found.neighbour_correlation) == (
        None,
        None,
        None,
        None,
    )
    # Twenty stars of ten times the noise decide about the growth.
    for ratio, enough in ((10.4, True), (9.6, False)):
        noise = np.where(np.arange(count) < 19, 4.0, np.where(np.arange(count) == 19, peak / ratio, peak))
        one = measure_misfit(
            picture(level),
            detected,
            matches,
            Sensor(psf_sigma_px=1.4),
            law(~none),
            replace_stars(stars, noise_dn=noise),
        )
        assert (one.corner_growth is not None) == enough
    # Faint stars do not decide about the growth.
    faint = replace_stars(stars, noise_dn=np.where(np.arange(count) < 19, 4.0, peak / 9.9))
    assert (
        measure_misfit(picture(level), detected, matches, Sensor(psf_sigma_px=1.4), law(~none), faint).corner_growth
        is None
    )


def replace_stars(stars: Stars, **given: object) -> Stars:
    return Stars(**vars(stars) | given)


def test_wings_are_weighted_means_of_what_exceeds_each_gaussian(monkeypatch: pytest.MonkeyPatch) -> None:
    """Stars that have no profile, or whose fit did not converge, do not count; weights grow to a ratio of 60."""
    rng = np.random.default_rng(12)
    chosen, signal = np.arange(20, 32), np.linspace(45, 75, 12)
    sigma, peak = rng.uniform(1.1, 1.6, 12), rng.uniform(300, 900, 12)
    profiles = [
        None if k == 4 else tuple(rng.uniform(0.2, 9.0 if part == 0 else 1.0, 80) for part in range(3))
        for k in range(12)
    ]
    for one in filter(None, profiles):
        one[0][0] = 3.0  # counts as outside
    fits = SimpleNamespace(
        sigma_px=sigma, peak_dn=peak, xy_px=rng.uniform(0, 90, (12, 2)), converged=np.arange(12) != 6
    )
    calls = []

    def fit_stars(above, usable, xy_px, *, start_sigma_px, only):
        calls.append((above, usable, xy_px, start_sigma_px, only))
        return fits

    def star_profile(above, usable, xy_px, star, sigma_px, centre):
        k = star - 20
        assert (sigma_px, centre.tolist()) == (sigma[k], fits.xy_px[k].tolist())
        return profiles[k]

    monkeypatch.setattr(misfitmeasurement, "fit_stars", fit_stars)
    monkeypatch.setattr(misfitmeasurement, "_star_profile", star_profile)
    pixels = np.full((30, 40), 70.0)
    pixels[2, 3], pixels[4, 5], pixels[6, 7] = 0.979 * 4095, 0.981 * 4095, 0.98 * 4095
    detected = SimpleNamespace(background=SimpleNamespace(level_dn=np.full((30, 40), 20.0)), xy_px="places")
    found, stacked = misfitmeasurement.measure_wings(picture(pixels), detected, chosen, 1.4, signal)
    above, usable, places, start_px, only = calls[0]
    np.testing.assert_array_equal(above, pixels - 20)
    assert np.argwhere(~usable).tolist() == [[4, 5], [6, 7]]
    assert (places, start_px, only is chosen) == ("places", 1.4, True)
    wings, weights, rows = [], [], []
    for k in sorted(set(range(12)) - {4, 6}):
        radius, light, gaussian = profiles[k]
        outside = (radius >= 3) & (radius < 8)
        # The area of the ring, px^2, in sigma as recorded, over the flux of the Gaussian.
        ring = np.pi * (64 - 9) * (sigma[k] ** 2 + 1 / 12)
        wings.append(ring * np.mean((light - peak[k] * gaussian)[outside]) / (2 * np.pi * sigma[k] ** 2 * peak[k]))
        weights.append(min(signal[k], 60.0) ** 2)
        recorded = peak[k] * sigma[k] ** 2 / (sigma[k] ** 2 + 1 / 12)
        parts = [(radius >= 0.5 * n) & (radius < 0.5 * n + 0.5) for n in range(16)]
        rows.append([np.mean(light[part]) / recorded if part.any() else np.nan for part in parts])
    values, heavy = np.array(wings), np.array(weights)
    assert found.value == pytest.approx(_weighted_median(values, heavy), rel=1e-9)
    some = np.random.default_rng(0).integers(0, 10, (200, 10))
    assert found.standard_error == pytest.approx(
        np.std([_weighted_median(values[k], heavy[k]) for k in some]), rel=1e-9
    )
    np.testing.assert_allclose(stacked.brightness, np.nanmedian(rows, axis=0), rtol=1e-9)


def test_rings_of_a_profile_begin_at_their_first_radius_and_end_before_their_last() -> None:
    """A star of 2 px as recorded, on a pixel: many radii are whole numbers."""
    sigma_px, centre, near = float(np.sqrt(4 - 1 / 12)), np.array([60.0, 60.0]), np.array([90.0, 60.0])
    above = np.random.default_rng(16).standard_normal((130, 130))
    usable = np.ones(above.shape, bool)
    rows, columns = np.indices(above.shape)
    distance = np.hypot(columns - 60, rows - 60) / 2
    good = np.hypot(columns - 90, rows - 60) > 10
    ring = good & (distance >= 9) & (distance < 12)
    for limit in (3, 8, 9, 12):
        assert (distance == limit).any()
    radius, light, _ = _star_profile(above, usable, np.array([centre, near]), 0, sigma_px, centre)
    inside = good & (distance < 8)
    np.testing.assert_array_equal(radius, distance[inside])
    np.testing.assert_allclose(light, above[inside] - above[ring].mean(), rtol=0, atol=1e-12)
    # Forty pixels of the wings are enough, from three sigma on and below eight.
    wing = np.flatnonzero(good & (distance >= 3) & (distance < 8))
    wing = [*wing[distance.flat[wing] == 3], *wing[distance.flat[wing] != 3]]
    for count, enough in ((40, True), (39, False)):
        some = usable.copy()
        some.flat[wing[count:]] = False
        found = _star_profile(above, some, centre[np.newaxis], 0, sigma_px, centre)
        assert (found is not None) == enough
