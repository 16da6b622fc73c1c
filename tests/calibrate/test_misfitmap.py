"""Unevenness over a photograph: brightness, sky, noise and ellipses on exact surfaces, and which stars count."""

from types import SimpleNamespace

import numpy as np
import pytest
from scipy.signal import convolve2d

from glstar.arrays import robust_std
from glstar.calibrate.photo.photograph import Photograph
from glstar.calibrate.photo.psf import star_shapes
from glstar.calibrate.sensor import misfitmeasurement
from glstar.calibrate.sensor.misfitmeasurement import (
    _brightness_map,
    _corner_loss,
    _covers_corner,
    _fit_radial,
    _gradient,
    _growth,
    _offsets,
    _patch_noise,
    corner_distance,
    measure_ellipticity,
    measure_noise_structure,
)
from tests.support.handmade import Stars, law, picture


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
    xy = np.array([[30.4, 40.6], [125.0, 3.0], [4.2, 100.3], [-30.0, 50.0], [-9.5, 80.0]])
    correlation, lattice = _patch_noise(noise, 2.4, xy, 1.5)
    starless = np.abs(noise) < 3.5 * 2.4
    assert not starless[60, 70]
    for x, y in xy[:3]:  # the others are too far away
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
    for value_dn, counts in ((0.979 * 4095, True), (0.98 * 4095, False)):
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
    np.testing.assert_allclose(design.T @ (robust * residual), 0, rtol=0, atol=1e-4)
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


@pytest.mark.parametrize("axis", [(30.0, 25.0), (70.0, 25.0), (30.0, 55.0), (70.0, 55.0)])
def test_the_farthest_corner_is_opposite_to_the_axis(axis: tuple[float, float]) -> None:
    corner = np.array([100.0 if axis[0] < 50 else 0.0, 80.0 if axis[1] < 40 else 0.0])
    found = _offsets(np.array([corner]), (81, 101), np.array(axis))
    assert np.linalg.norm(found) == pytest.approx(1.0, rel=1e-12)
