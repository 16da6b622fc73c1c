"""Unevenness over a photograph: brightness, sky, noise and ellipses on exact surfaces, and which stars count."""

from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.signal import convolve2d

from glstar.arrays import robust_std
from glstar.calibrate.photo.photograph import Photograph
from glstar.calibrate.photo.psf import star_shapes
from glstar.calibrate.sensor import misfitmeasurement
from glstar.calibrate.sensor.fit import BrightnessFit
from glstar.calibrate.sensor.misfit import Measurement
from glstar.calibrate.sensor.misfitmeasurement import (
    _brightness_map,
    _corner_loss,
    _covers_corner,
    _fit_radial,
    _gradient,
    _growth,
    _patch_noise,
    _star_profile,
    _weighted_median,
    corner_distance,
    measure_ellipticity,
    measure_misfit,
    measure_noise_structure,
)
from glstar.camera.sensor.sensor import Sensor


class Stars(SimpleNamespace):
    """The part of `MeasuredStars` that a measurement uses."""

    def __len__(self) -> int:
        return len(self.xy_px)


def picture(pixels: np.ndarray) -> Photograph:
    return Photograph(Path("a.png"), pixels, 12, "grey", None)


def law(used: np.ndarray) -> BrightnessFit:
    return BrightnessFit("median", 4.0, 800.0, used, 0.1, 0.01, -0.4, -0.42, -0.38)


def test_the_map_of_brightness_has_the_median_of_each_part() -> None:
    """Three rows and four columns; stars beside the image belong to the nearest part."""
    image = picture(np.zeros((90, 160)))
    xy = np.array([[39.0, 29], [41, 29], [5, 5], [20, 28], [-3, 31], [170, 95], [121, 61], [100, 45]])
    off = np.array([0.1, 0.2, 0.3, 0.7, 0.4, 0.5, 0.9, 0.6])
    nan = np.nan
    expected = [[0.3, 0.2, nan, nan], [0.4, nan, 0.6, nan], [nan, nan, nan, 0.7]]
    np.testing.assert_allclose(_brightness_map(image, xy, off), expected, rtol=1e-12)


@pytest.mark.parametrize("slope", [(6.0, 3.0), (-6.0, 3.0), (-4.0, -7.0)])
def test_the_gradient_is_that_from_one_side_or_corner_to_the_other(slope: tuple[float, float]) -> None:
    """Slopes are per half diagonal; a plane and a paraboloid are found exactly."""
    height, width = 121, 201
    y, x = np.indices((height, width))
    half = np.hypot(width - 1, height - 1) / 2
    u, v = (x - 100) / half, (y - 60) / half
    bowl = -5.0 * (u**2 + v**2)
    gradient, towards_rad, rest_dn, without_bowl_dn = _gradient(40 + slope[0] * u + slope[1] * v + bowl)
    corners = [abs(slope[0]) * 200 / half, abs(slope[1]) * 120 / half]
    assert gradient.value == pytest.approx(sum(corners), rel=1e-9)
    assert gradient.standard_error == pytest.approx(0, abs=1e-9)
    assert towards_rad == pytest.approx(np.arctan2(slope[1], slope[0]) % (2 * np.pi), rel=1e-9)
    assert without_bowl_dn == pytest.approx(0, abs=1e-9)
    rows, columns = (np.rint(np.linspace(0, side - 1, 16)).astype(int) for side in (height, width))
    sampled = bowl[np.ix_(rows, columns)]
    assert rest_dn == pytest.approx(robust_std(sampled, np.median(sampled)), rel=1e-6)


def test_the_error_of_a_gradient_is_twice_that_of_independent_points() -> None:
    """The plane's slopes on 16 x 16 points of noise 1; neighbouring points share tiles."""
    rng = np.random.default_rng(3)
    errors, values, rests = [], [], []
    for _ in range(40):
        gradient, _, rest_dn, without_bowl_dn = _gradient(rng.standard_normal((60, 90)))
        errors.append(gradient.standard_error)
        values.append(gradient.value)
        rests.append((rest_dn, without_bowl_dn))
    # Slope over offsets u: 1 / sqrt(sum u^2); sides are 2 cos and 2 sin of the diagonal.
    sides = np.array([89.0, 59.0])
    along = (np.rint(np.linspace(0, side, 16)) - side / 2 for side in sides)
    variances = [(2 * side) ** 2 / (16 * np.sum(u**2)) / 4 for side, u in zip(sides, along, strict=True)]
    assert np.median(errors) == pytest.approx(2 * np.sqrt(sum(variances)), rel=0.1)
    assert np.mean(values) < 2 * np.median(errors)
    np.testing.assert_allclose(np.mean(rests, axis=0), 1.0, rtol=0, atol=0.05)


def test_the_loss_in_the_corner_is_that_of_the_stars_of_the_fit() -> None:
    rng = np.random.default_rng(4)
    xy = rng.uniform(0, [299, 199], (60, 2))
    axis = np.array([140.0, 90.0])
    used = np.arange(60) % 5 != 0
    corner = np.hypot(299 - 140, 199 - 90)
    offset = (xy - axis) / corner
    r2 = (offset**2).sum(axis=1)
    off = 0.2 + 0.1 * offset[:, 0] - 0.3 * offset[:, 1] + 0.4 * r2
    off[~used] = 7.0
    image, stars = SimpleNamespace(pixels_dn=np.zeros((200, 300))), SimpleNamespace(xy_px=xy)
    loss, mean_mag = _corner_loss(image, stars, law(used), off, axis)
    assert loss.value == pytest.approx(0.4, rel=1e-6)
    assert loss.standard_error == pytest.approx(0, abs=1e-9)
    assert mean_mag == pytest.approx(0.4 * r2[used].mean(), rel=1e-6)
    off[used] += 0.1 * rng.standard_normal(used.sum())
    loss, _ = _corner_loss(image, stars, law(used), off, axis)
    assert loss.value == pytest.approx(0.4, abs=4 * loss.standard_error)
    design = np.column_stack([np.ones(60), offset, r2])[used]
    assert loss.standard_error == pytest.approx(0.1 * np.sqrt(np.linalg.inv(design.T @ design)[3, 3]), rel=0.3)
    assert _corner_loss(image, stars, law(np.arange(60) < 19), off, axis) == (None, 0.0)
    matches = SimpleNamespace(
        solution=SimpleNamespace(camera=SimpleNamespace(width_px=300, cx_px=140.0, cy_px=90.0), mirrored=False)
    )
    np.testing.assert_allclose(corner_distance(image, matches, xy), np.sqrt(r2), rtol=1e-12)


def coloured(seed: int, shape: tuple[int, int]) -> np.ndarray:
    """Return noise of 2 DN that is correlated, and stronger at odd rows and columns."""
    noise = convolve2d(
        np.random.default_rng(seed).standard_normal(shape), [[0.2, 0.3], [0.4, 1.0]], mode="same", boundary="wrap"
    )
    noise[1::2, 1::2] *= 1.3
    noise[::2, 1::2] *= 1.1
    return 2 * noise


def test_the_noise_of_a_patch_has_a_correlation_and_a_variance_for_each_pixel_of_the_lattice() -> None:
    noise = coloured(1, (120, 130)) + 0.7
    noise[60, 70], noise[60, 90] = 8.5, 3.5 * 2.4  # stars: 3.5 times 2.4 DN and more
    xy = np.array([[30.4, 40.6], [125.0, 3.0], [-30.0, 50.0], [-9.5, 80.0]])
    correlation, lattice = _patch_noise(noise, 2.4, xy, 1.5)
    starless = np.abs(noise) < 3.5 * 2.4
    assert not starless[60, 70]
    for x, y in xy[:2]:  # the others are too far away
        # Squares of 5 sigma and 2 px are left out.
        rows, columns = np.indices(noise.shape)
        first, last = np.trunc([[x - 9.5, y - 9.5], [x + 9.5, y + 9.5]])
        starless &= ~((columns >= first[0]) & (columns <= last[0]) & (rows >= first[1]) & (rows <= last[1]))
    residual = np.where(starless, noise - noise[starless].mean(), 0)
    variance = (residual**2).sum() / starless.sum()

    def at_lag(lag: int) -> float:
        products = (residual[lag:] * residual[:-lag]).sum() + (residual[:, lag:] * residual[:, :-lag]).sum()
        return products / ((starless[lag:] & starless[:-lag]).sum() + (starless[:, lag:] & starless[:, :-lag]).sum())

    assert correlation == pytest.approx((at_lag(1) - at_lag(6)) / variance, rel=1e-9)
    parts = [(residual[r::2, c::2] ** 2).sum() / starless[r::2, c::2].sum() for r in (0, 1) for c in (0, 1)]
    np.testing.assert_allclose(lattice, np.array(parts) / np.mean(parts), rtol=1e-9)


def test_a_patch_needs_2000_pixels_that_vary() -> None:
    rng = np.random.default_rng(2)
    noise = rng.standard_normal((50, 40))
    none = np.empty((0, 2))
    assert _patch_noise(noise, 9.0, none, 1.0) is not None
    noise[3, 4] = 99.0
    assert _patch_noise(noise, 9.0, none, 1.0) is None
    flat = np.full((60, 60), 0.2)
    flat[::2] += 0.04
    assert _patch_noise(flat, 9.0, none, 1.0) is None  # a variance of 0.0004 DN^2
    flat[::2] += 0.04
    assert _patch_noise(flat, 9.0, none, 1.0) is not None  # of 0.0016
    # Each of the four needs 250 pixels, and a variance of its own.
    for side, enough in ((250, True), (249, False)):
        sparse = rng.standard_normal((80, 80))
        first = sparse[::2, ::2].ravel()
        first[side:] = 99.0
        sparse[::2, ::2] = first.reshape(40, 40)
        assert (_patch_noise(sparse, 9.0, none, 1.0) is not None) == enough
    # The limit of stars is 3.5 standard deviations, of 0.3 DN at least.
    small = 0.3 * rng.standard_normal((60, 60)).clip(-2, 2)
    small[5, 5], small[6, 6] = 1.0, 1.1
    found = _patch_noise(small, 0.1, none, 1.0)
    kept = np.ones(small.shape, bool)
    kept[6, 6] = False
    residual = np.where(kept, small - small[kept].mean(), 0)
    parts = np.array([(residual[r::2, c::2] ** 2).sum() / kept[r::2, c::2].sum() for r in (0, 1) for c in (0, 1)])
    np.testing.assert_allclose(found[1], parts / parts.mean(), rtol=1e-9)


def test_the_structure_of_the_noise_is_the_median_of_sixteen_patches() -> None:
    """Squares of 192 px from edge to edge, four along each side, begin at even pixels."""
    noise = coloured(5, (235, 401))
    level = 30 + 0.05 * np.arange(401)[np.newaxis] + np.zeros((235, 1))
    background = SimpleNamespace(level_dn=level, noise_dn=np.full(noise.shape, 2.5))
    xy = np.array([[100.0, 50.0], [300.2, 200.7]])
    detected = SimpleNamespace(background=background, xy_px=xy, psf_sigma_px=1.4)
    correlation, excess = measure_noise_structure(picture(level + noise), detected)
    found = [
        _patch_noise(noise[top : top + 192, left : left + 192], 2.5, xy - (left, top), 1.4)
        for top in (0, 14, 28, 42)
        for left in (0, 68, 138, 208)
    ]
    correlations, lattices = np.array([one[0] for one in found]), np.array([one[1] for one in found])
    assert correlation.value == pytest.approx(np.median(correlations), rel=1e-9)
    assert correlation.standard_error == pytest.approx(1.25 * correlations.std(ddof=1) / 4, rel=1e-9)
    middle = np.median(lattices, axis=0)
    ratio = np.sqrt(middle.max() / middle.min())
    assert excess.value == pytest.approx(ratio - 1, rel=1e-9)
    error = 1.25 * lattices.std(axis=0, ddof=1).max() / 4
    # Of the root of a quotient: half the relative errors of both, which are independent.
    assert excess.standard_error == pytest.approx(ratio * error / middle.min() / np.sqrt(2), rel=1e-9)
    # Smaller images have smaller patches.
    small = coloured(6, (101, 150))
    detected.background = SimpleNamespace(level_dn=np.zeros(small.shape), noise_dn=np.full(small.shape, 2.5))
    detected.xy_px = np.empty((0, 2))
    correlation, _ = measure_noise_structure(picture(small), detected)
    found = [_patch_noise(small[:100, x : x + 100], 2.5, detected.xy_px, 1.4)[0] for x in (0, 16, 32, 50)]
    assert correlation.value == pytest.approx(np.median(found), rel=1e-9)
    # Fewer than four patches with enough pixels are too few.
    small[40:, :] = 99.0
    small[:, 87:] = 99.0
    assert measure_noise_structure(picture(small), detected) == (None, None)


def ellipses(
    count: int, long_px: float, short_px: float, angle_deg: float
) -> tuple[Photograph, SimpleNamespace, np.ndarray]:
    """Return stars as pixels record them, a twelfth of a square pixel wider, on a level of 50 DN."""
    rng = np.random.default_rng(8)
    xy = np.column_stack([40 + 50 * (np.arange(count) % 5), 40 + 50 * (np.arange(count) // 5)]) + rng.uniform(
        -0.4, 0.4, (count, 2)
    )
    rows, columns = np.indices((180, 290))
    c, s = np.cos(np.deg2rad(angle_deg)), np.sin(np.deg2rad(angle_deg))
    above = np.zeros(rows.shape)
    for x, y in xy:
        long, short = c * (columns - x) + s * (rows - y), -s * (columns - x) + c * (rows - y)
        above += 900 * np.exp(-(long**2) / (2 * (long_px**2 + 1 / 12)) - short**2 / (2 * (short_px**2 + 1 / 12)))
    detected = SimpleNamespace(background=SimpleNamespace(level_dn=np.full(rows.shape, 50.0)))
    return picture(above + 50), detected, xy


@pytest.mark.parametrize("angle_deg", [25.0, 110.0])
def test_the_ellipticity_is_that_of_the_axes_without_the_pixel(angle_deg: float) -> None:
    image, detected, xy = ellipses(8, 2.1, 1.5, angle_deg)
    found, angle_rad = measure_ellipticity(image, detected, xy, 1.8)
    assert found.value == pytest.approx((2.1**2 - 1.5**2) / (2.1**2 + 1.5**2), rel=2e-3)
    assert found.standard_error < 1e-3
    assert np.rad2deg(angle_rad) == pytest.approx(angle_deg, abs=0.1)
    assert measure_ellipticity(image, detected, xy[:7], 1.8) == (None, 0.0)
    # A star with a pixel of 98 % of the range or more does not count.
    for value_dn, counts in ((0.979 * 4095, True), (0.981 * 4095, False)):
        image.pixels_dn[60, 60] = value_dn  # within the stamps of four stars
        assert (measure_ellipticity(image, detected, xy, 1.8)[0] is not None) == counts


def test_the_error_of_an_ellipticity_is_that_of_the_median_of_resampled_stars() -> None:
    image, detected, xy = ellipses(15, 2.1, 1.5, 25.0)
    image.pixels_dn[:] += 8 * np.random.default_rng(9).standard_normal(image.pixels_dn.shape)
    found, angle_rad = measure_ellipticity(image, detected, xy, 1.8)
    xx, yy, xy2 = star_shapes(image.pixels_dn - 50, np.ones(image.pixels_dn.shape, bool), xy, 1.8)
    parts = np.array([xx - yy, 2 * xy2]) / np.median(xx + yy - 1 / 6)
    middle = np.median(parts, axis=1)
    assert found.value == pytest.approx(np.hypot(*middle), rel=1e-9)
    assert angle_rad == pytest.approx(np.arctan2(middle[1], middle[0]) / 2, rel=1e-9)
    some = np.random.default_rng(0).integers(0, 15, (200, 15))
    assert found.standard_error == pytest.approx(np.median(parts[:, some], axis=2).std(axis=1).max(), rel=1e-9)


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


def radial_surface(count: int, seed: int) -> tuple[np.ndarray, ...]:
    rng = np.random.default_rng(seed)
    offset = rng.uniform(-0.8, 0.8, (count, 2))
    r2 = (offset**2).sum(axis=1)
    values = 1.3 + 0.1 * offset[:, 0] - 0.2 * offset[:, 1] + 0.4 * r2 + 0.05 * rng.standard_normal(count)
    values[:5] += 2.0
    return offset, r2, values


def test_a_radial_fit_solves_its_weighted_equations() -> None:
    offset, r2, values = radial_surface(80, 13)
    weights = np.random.default_rng(14).uniform(0.2, 3.0, 80)
    p, covariance = _fit_radial(offset, values, weights)
    design = np.column_stack([np.ones(80), offset, r2])
    residual = values - design @ p
    relative = weights / weights.mean()
    scaled = np.abs(residual) * np.sqrt(relative)
    robust = relative * np.minimum(1, 1.5 * 1.4826 * np.median(scaled) / scaled)
    np.testing.assert_allclose(design.T @ (robust * residual), 0, atol=1e-4)
    inverse = np.linalg.inv(design.T @ np.diag(robust) @ design)
    meat = design.T @ np.diag((robust * residual) ** 2) @ design
    np.testing.assert_allclose(covariance, inverse @ meat @ inverse * 80 / 76, rtol=1e-3)


def test_the_growth_is_weighted_with_the_signal_up_to_sixty() -> None:
    offset, r2, values = radial_surface(80, 15)
    axis, corner = np.array([140.0, 90.0]), np.hypot(299 - 140, 199 - 90)
    signal = np.linspace(20, 100, 80)
    good = np.arange(80) % 4 != 0
    image = SimpleNamespace(pixels_dn=np.zeros((200, 300)))
    stars = Stars(xy_px=axis + offset * corner, sigma_px=values)
    found, width = _growth(image, stars, good, signal, axis)
    p, covariance = _fit_radial(offset[good], values[good], np.minimum(signal[good], 60.0) ** 2)
    assert found.value == pytest.approx(p[3] / p[0], rel=1e-9)
    assert found.standard_error == pytest.approx(np.sqrt(covariance[3, 3]) / p[0], rel=1e-9)
    expected = 1 + found.value * r2
    np.testing.assert_allclose(width, expected / np.median(expected[good]), rtol=1e-9)
    # A width below 0 on the axis is none.
    found, width = _growth(image, Stars(xy_px=stars.xy_px, sigma_px=-values), good, signal, axis)
    assert (found, width.tolist()) == (None, [1.0] * 80)


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


def test_stars_much_smaller_than_their_kind_have_no_ellipse(monkeypatch: pytest.MonkeyPatch) -> None:
    """A tenth of the square of the typical width is the least size of a star without the pixel."""
    sizes = np.full(10, 4.0)
    sizes[2], sizes[5] = 0.104 * 1.8**2, 0.096 * 1.8**2
    share = np.linspace(0.1, 0.4, 10)
    xx, yy, xy = (sizes + 1 / 6) / 2 * (1 + share), (sizes + 1 / 6) / 2 * (1 - share), 0.1 * sizes
    monkeypatch.setattr(misfitmeasurement, "star_shapes", lambda *_: (xx, yy, xy))
    detected = SimpleNamespace(background=SimpleNamespace(level_dn=np.zeros((5, 6))))
    found, _ = measure_ellipticity(picture(np.zeros((5, 6))), detected, np.zeros((10, 2)), 1.8)
    good = np.arange(10) != 5
    parts = np.array([(xx - yy)[good], 2 * xy[good]]) / np.median((xx + yy - 1 / 6)[good])
    assert found.value == pytest.approx(np.hypot(*np.median(parts, axis=1)), rel=1e-9)


def test_the_error_of_a_gradient_is_that_of_its_fit_with_shared_tiles() -> None:
    level = 30 + np.random.default_rng(17).standard_normal((60, 90))
    rows, columns = (np.rint(np.linspace(0, side - 1, 16)).astype(int) for side in (60, 90))
    half = np.hypot(89, 59) / 2
    x, y = np.meshgrid((columns - 44.5) / half, (rows - 29.5) / half)
    offset = np.column_stack([x.ravel(), y.ravel()])
    p, covariance = _fit_radial(offset, level[np.ix_(rows, columns)].ravel(), np.ones(256))
    sides = np.array([89, 59]) / half
    gradient = _gradient(level)[0]
    assert gradient.value == pytest.approx(np.abs(p[1:3]) @ sides, rel=1e-9)
    expected = 2 * np.sqrt(np.diag(covariance)[1:3] @ sides**2)
    assert gradient.standard_error == pytest.approx(expected, rel=1e-9)


def test_a_corner_needs_a_tenth_of_the_stars() -> None:
    far = np.where(np.arange(30) == 3, 1.0, 0.1)
    assert not _covers_corner(np.column_stack([far, np.zeros(30)]))
    far[[5, 8, 9]] = 1.0
    assert _covers_corner(np.column_stack([far, np.zeros(30)]))


def test_narrow_stars_may_grow() -> None:
    offset, _, values = radial_surface(80, 15)
    axis, corner = np.array([140.0, 90.0]), np.hypot(299 - 140, 199 - 90)
    image, every = SimpleNamespace(pixels_dn=np.zeros((200, 300))), np.ones(80, bool)
    whole, half = (
        _growth(image, Stars(xy_px=axis + offset * corner, sigma_px=factor * values), every, np.full(80, 50.0), axis)[0]
        for factor in (1.0, 0.5)
    )
    assert (half.value, half.standard_error) == pytest.approx((whole.value, whole.standard_error), rel=1e-6)
