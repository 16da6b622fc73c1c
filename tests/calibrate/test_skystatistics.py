"""Statistics of backgrounds, dark frames and repeated stars, against definitions and numbers of known parameters."""

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter
from scipy.stats import norm, sigmaclip, truncnorm

from glstar.calibrate.photo.detection import (
    _any_within,
    _at,
    _clipped_gaussian,
    _clipped_moments,
    _fit_clipped_gaussian,
    _is_compact,
    _lit_tiles,
    _most_peaks,
    _one_each,
    _quantile,
    _starless,
    _tile_px,
    _typical_sigma_px,
    background_of,
    sky_level,
    tile_statistics,
)
from glstar.calibrate.photo.photograph import Photograph
from glstar.calibrate.photo.sky import (
    _CLIPPED_STD,
    NoiseAgainstLevel,
    SkyMap,
    _clipped_variance,
    _misfit_of_gamma,
    _smoothed,
    before_clipping,
    gamma_of_noise,
    measure_noise,
    measure_sky,
    starless_pixels,
)
from glstar.calibrate.sensor.combine import Observations, _clipped_std, _deviations_mag, _repeat_mag
from glstar.calibrate.sensor.photontransfer import _gain, _half_variance, _mean_and_variance, _prnu, photon_transfer


def photo(pixels: np.ndarray, bits: int = 8) -> Photograph:
    return Photograph(Path("a.png"), pixels.astype(float), bits, "grey", None)


def test_clipped_moments_are_those_of_a_gaussian_without_its_stars() -> None:
    rng = np.random.default_rng(1)
    values = np.sort(np.concatenate([rng.normal(50, 4, 40_000), rng.uniform(70, 250, 300)])).astype(np.float32)
    mean, std = _clipped_moments(values)
    inside = sigmaclip(values.astype(float), 3.0, 3.0)[0]
    # A Gaussian cut at three standard deviations has 98.7 % of its standard deviation.
    whole = inside.std() / np.sqrt(truncnorm.var(-3, 3))
    assert mean == pytest.approx(inside.mean(), abs=0.02)
    assert std == pytest.approx(whole, rel=3e-3)
    assert std == pytest.approx(4, rel=0.01)
    assert _clipped_moments(np.full(9, 7.0, np.float32)) == (7.0, 0.05)
    ordered = np.sort(rng.normal(0, 1, 38)).astype(np.float32)
    for fraction in (0.0, 0.25, 0.37, 1.0):
        assert _quantile(ordered, fraction) == pytest.approx(np.quantile(ordered, fraction), abs=1e-6)


def test_tiles_have_the_moments_of_their_pixels() -> None:
    rng = np.random.default_rng(2)
    image = rng.normal(20, 3, (130, 200)) + 10 * (np.arange(200) >= 128)
    level, noise = tile_statistics(image)
    assert level.shape == (3, 4)
    np.testing.assert_allclose(level[:2], [[20, 20, 30, 30]] * 2, rtol=0, atol=0.35)
    np.testing.assert_allclose(noise[:2, :3], 3, rtol=0.06)
    # A tile is 64 px, or a 32nd of the longer side, but no longer than the image.
    assert [_tile_px(shape) for shape in ((100, 200), (2048, 100), (2049, 100), (4000, 3000), (20, 90))] == [
        *(64, 64, 65, 125, 20)
    ]
    background = background_of(np.full((130, 200), 7.0))
    assert (background.level_dn == 7).all()
    np.testing.assert_allclose(background.noise_dn, 0.05, rtol=1e-6)
    assert background.is_lit.all()


def circle_of(radius: float, *, inside: float = 100.0, outside: float = 2.0, shape=(24, 32)) -> np.ndarray:
    rows, columns = np.indices(shape)
    return np.where(np.hypot(rows - 11.5, columns - 15.5) < radius, inside, outside)


def test_only_the_corners_around_a_bright_disc_are_outside_of_an_image_circle() -> None:
    noise = np.ones((24, 32))
    level = circle_of(11.0)
    np.testing.assert_array_equal(_lit_tiles(level, noise), level > 50)
    for dark in (
        circle_of(25.0),  # no corner is black
        np.where(np.arange(32) < 16, 100.0, 2.0) * np.ones((24, 1)),  # a limb
        np.where(np.indices((24, 32)).sum(axis=0) % 2, 100.0, 2.0),  # no disc
        circle_of(11.0, outside=11.0),  # above a tenth of the sky
        circle_of(11.0, inside=4.9, outside=0.0),  # within five standard deviations
        100 * np.exp(-((np.indices((24, 32)).T - [11.5, 15.5]) ** 2).sum(axis=-1).T / 60),  # gradual glare
    ):
        assert _lit_tiles(dark, noise).all()
    assert not _lit_tiles(circle_of(11.0, inside=5.2, outside=0.0), noise).all()
    assert not _lit_tiles(circle_of(11.0, outside=9.9), noise).all()
    wide = np.pad(circle_of(11.0), 0)
    background = background_of(np.kron(wide, np.ones((64, 64)))[: 24 * 64, : 32 * 64] + 0.0)
    lit = background.is_lit[32::64, 32::64]
    np.testing.assert_array_equal(lit, wide > 50)
    # The surroundings of the sky are lit, too: a margin of one tile.
    assert background.is_sky.sum() < background.is_lit.sum()
    inner = np.pad(wide > 50, 1, constant_values=True)
    expected = np.lib.stride_tricks.sliding_window_view(inner, (3, 3)).all(axis=(2, 3))
    np.testing.assert_array_equal(background.is_sky[32::64, 32::64], expected)


@pytest.mark.parametrize(("mean", "std"), [(1.0, 2.0), (0.3, 1.2), (2.5, 1.5)])
def test_a_sky_that_is_cut_off_at_0_is_the_gaussian_before(mean: float, std: float) -> None:
    rng = np.random.default_rng(5)
    values = np.maximum(np.rint(rng.normal(mean, std, 200_000)), 0)
    assert _fit_clipped_gaussian(values.astype(np.intp)) == pytest.approx((mean, std), abs=0.03)
    image = values.reshape(400, 500)
    image[:100] += 40  # a quarter of the image is much brighter: medians of the parts
    assert _clipped_gaussian(image, np.ones(image.shape, bool)) == pytest.approx((mean, std), abs=0.06)
    z = np.maximum(rng.normal(mean, std, 400_000), 0)
    whole = before_clipping(np.array([z.mean()]), np.array([z.std()]))
    assert (float(whole[0][0]), float(whole[1][0])) == pytest.approx((mean, std), rel=0.02, abs=0.02)


def test_a_sky_far_above_0_is_unchanged_by_the_cut() -> None:
    mean, std = before_clipping(np.array([70.0, 12.0]), np.array([10.0, 2.0]))
    assert (mean.tolist(), std.tolist()) == (pytest.approx([70, 12]), pytest.approx([10, 2]))
    z = np.array([-2.0, -1.0, 0.0, 1.5])
    cut_mean = z * norm.cdf(z) + norm.pdf(z)
    cut_std = np.sqrt((z**2 + 1) * norm.cdf(z) + z * norm.pdf(z) - cut_mean**2)
    found = before_clipping(3 * cut_mean, 3 * cut_std)
    np.testing.assert_allclose(found[0], 3 * z, rtol=0, atol=0.02)
    np.testing.assert_allclose(found[1], 3, rtol=1e-3)


def test_the_level_of_a_sky_excludes_rounding_and_its_gradient() -> None:
    rng = np.random.default_rng(6)
    ramp = np.linspace(69, 71, 320)
    image = np.rint(ramp + rng.normal(0, 1.0, (256, 320)))
    level = sky_level(image, background_of(image), np.ones(image.shape, bool))
    assert level.mean_dn == pytest.approx(70, abs=0.3)
    assert level.std_dn == pytest.approx(1.0, rel=0.05)
    assert level.unevenness_dn == pytest.approx(1.4826 * 0.5, rel=0.15)
    assert (level.clipped_fraction, level.pixels > 0.98 * image.size) == (0.0, True)
    dark = np.maximum(np.rint(rng.normal(1, 2, (256, 320))), 0)
    cut = sky_level(dark, background_of(dark), np.ones(dark.shape, bool))
    assert (cut.mean_dn, cut.std_dn) == pytest.approx((1, 2), abs=0.08)
    assert cut.clipped_fraction == pytest.approx(norm.cdf(-0.25), abs=0.01)
    # Too few pixels without stars are no sky: all count.
    few = np.zeros(image.shape, bool)
    few[0, :99] = True
    assert sky_level(image, background_of(image), few).mean_dn == pytest.approx(70, abs=0.3)


def test_peaks_are_spread_over_the_image_if_there_are_too_many() -> None:
    rng = np.random.default_rng(3)
    xy = rng.uniform(0, 160, (1400, 2))
    xy[:1100] = rng.uniform(0, 30, (1100, 2))  # a town in the corner has the highest peaks
    kept = _most_peaks(xy, 160)
    assert (len(kept), kept[:500].tolist()) == (1000, list(range(500)))
    part = [tuple(one) for one in (xy // 10).astype(int).tolist()]
    rank: dict[int, int] = {}
    seen: dict[tuple[int, ...], int] = {}
    for k, one in enumerate(part):
        rank[k] = seen[one] = seen.get(one, -1) + 1
    rest = sorted(range(500, 1400), key=lambda k: (rank[k], k))[:500]
    assert kept.tolist() == [*range(500), *sorted(rest)]
    assert _most_peaks(xy[:1000], 160).tolist() == list(range(1000))


def test_saturated_patches_are_one_peak_and_compact_as_a_star() -> None:
    saturated = np.zeros((80, 120), bool)
    saturated[10:15, 20:25] = True  # a star
    saturated[40, 10:40] = True  # a line
    saturated[60:65, 60:71] = True  # twice as wide as high, and more
    saturated[60:65, 90:100] = True
    saturated[5:45, 80:118] = True  # large
    xy = np.array([[50.0, 50], [21, 11], [23, 14], [15, 40], [65, 62], [95, 62], [99, 20]])
    assert _one_each(xy, saturated).tolist() == [[50, 50], [22, 12], [24.5, 40], [65, 62], [94.5, 62], [98.5, 24.5]]
    assert _one_each(xy, np.zeros_like(saturated)).tolist() == xy.tolist()
    assert _is_compact(saturated, xy, 1.0).tolist() == [False, True, True, False, False, True, False]
    # Longer stars are those of a wider point spread: 10 px and 10 sigma.
    assert _is_compact(saturated, xy[-1:], 2.9).tolist() == [False]
    assert _is_compact(saturated, xy[-1:], 3.0).tolist() == [True]
    cross = np.zeros((20, 20), bool)
    cross[9, 4:15] = cross[4:15, 9] = True
    assert not _is_compact(cross, np.array([[9.0, 9.0]]), 1.0).any()


def test_the_typical_width_is_that_of_the_brighter_half_without_hot_pixels() -> None:
    peak, sigma = np.array([10.0, 20, 30, 40, 50, 60]), np.array([9.0, 9, 1.5, 1.2, 0.2, 1.4])
    stars = SimpleNamespace(converged=np.array([1, 1, 1, 1, 1, 0], bool), peak_dn=peak, sigma_px=sigma)
    # 10, 20, 30 and 40 DN are stars: the brighter half is 30 and 40.
    assert _typical_sigma_px(stars) == pytest.approx(1.35)
    assert _typical_sigma_px(stars, np.array([1, 0, 0, 0, 0, 1], bool)) == 9.0
    assert _typical_sigma_px(stars, np.array([0, 0, 0, 0, 0, 1], bool)) == pytest.approx(1.35)
    stars.converged[:] = False
    assert _typical_sigma_px(stars) == 1.3


def test_pixels_near_positions_are_found_and_hidden() -> None:
    mask = np.zeros((40, 60), bool)
    mask[20, 30] = True
    # A radius of 1.5 sigma, rounded up, and one pixel: 4 px.
    near = _any_within(mask, np.array([[34.0, 20.0], [35.0, 20.0], [30.0, 16.0], [59.0, 39.0]]), 2.0)
    assert near.tolist() == [True, False, True, False]
    image = np.arange(12).reshape(3, 4)
    assert _at(image, np.array([[1.4, 1.6], [-3.0, 9.0], [3.4, 0.0]])).tolist() == [9, 8, 3]
    for peak, noise in ((100.0, 1.0), (-4.0, 2.0), (0.001, 1.0)):
        radius = 2 * np.hypot(1.2, 0.3) * np.sqrt(2 * np.log(max(10 * abs(peak) / noise, np.e)))
        radius = np.ceil(min(radius, 6.0))
        free = _starless((40, 60), np.array([[30.0, 20.0]]), np.array([peak]), np.array([noise]), 1.2)
        assert (~free[20]).sum() == 2 * radius + 1
        assert (~free).sum() == pytest.approx(np.pi * radius**2, rel=0.3)


def test_the_sky_away_from_stars_is_used() -> None:
    pixels = np.full((120, 160), 50.0)
    pixels[100, 100] = 250.0
    is_sky = np.ones((120, 160), bool)
    is_sky[:5] = False
    detected = SimpleNamespace(
        psf_sigma_px=2.0,
        signal_to_noise=np.array([100.0, 0.5]),
        saturated=np.array([False, True]),
        xy_px=np.array([[40.0, 60.0], [100.0, 60.0]]),
        background=SimpleNamespace(is_sky=is_sky),
    )
    dark = starless_pixels(photo(pixels), detected, np.array([[140.0, 60.0]]))
    # 3 px and sigma times 2.5 and 0.8 ln(signal over noise); 1.6 times of a saturated star.
    radii = [round(3 + 2 * (2.5 + 0.8 * np.log(100))), round(1.6 * 8.0), 8]
    for x, radius in zip((40, 100, 140), radii, strict=True):
        assert (~dark[60, x - radius : x + radius + 1]).all()
        assert dark[60, x - radius - 1]
        assert x + radius + 1 >= 160 or dark[60, x + radius + 1]
    assert not dark[100, 100]
    assert not dark[:5].any()
    assert dark[5:40].all()


def test_a_sky_map_is_a_weighted_mean_around_each_texel() -> None:
    rng = np.random.default_rng(7)
    good = rng.random((128, 160)) > 0.3
    values, elsewhere = np.where(good, rng.normal(30, 2, (128, 160)), 0.0), np.full((128, 160), 30.0)
    texels, error = _smoothed(values, good, 16, elsewhere)
    weight = gaussian_filter(good + 1e-3, 8.0, mode="mirror", truncate=6)
    mean = gaussian_filter(values + 0.03, 8.0, mode="mirror", truncate=6) / weight
    np.testing.assert_allclose(texels, mean.reshape(8, 16, 10, 16).mean(axis=(1, 3)), rtol=2e-3)
    # The error is that of the scatter of texels of white noise.
    white, _ = _smoothed(rng.normal(0, 1, (640, 640)), np.ones((640, 640), bool), 16, np.zeros((640, 640)))
    assert error == pytest.approx(white[2:-2, 2:-2].std(), rel=0.1)

    level = 40 + 10 * np.sin(np.arange(320) / 60) + 0.02 * np.arange(256)[:, np.newaxis]
    pixels = np.rint(level + rng.normal(0, 1.5, (256, 320)))
    pixels[100:103, 200:203] = 230
    detected = SimpleNamespace(
        psf_sigma_px=1.0,
        signal_to_noise=np.zeros(0),
        saturated=np.zeros(0, bool),
        xy_px=np.zeros((0, 2)),
        background=background_of(pixels),
    )
    # At most 128 texels: of 17 px each for 2080 px.
    wide = np.full((40, 2080), 9.0)
    of_wide = SimpleNamespace(**vars(detected) | {"background": background_of(wide)})
    assert measure_sky(photo(wide), of_wide, np.zeros((0, 2))).texels_dn.shape == (3, 123)
    found = measure_sky(photo(pixels), detected, np.zeros((0, 2)))
    assert found.texels_dn.shape == (16, 20)
    assert np.sqrt(np.mean((found.level_dn - level)[20:-20, 20:-20] ** 2)) < 0.25
    np.testing.assert_allclose(found.residual_dn, pixels - found.level_dn, rtol=1e-7)
    assert found.error_dn == pytest.approx(float(np.median(detected.background.noise_dn)) * error)


@pytest.mark.parametrize("gain", [0.25, 0.0])
def test_the_noise_of_a_sky_grows_by_the_gain(gain: float) -> None:
    rng = np.random.default_rng(11)
    level = np.linspace(40, 200, 512) * np.ones((512, 1))
    residual = np.rint(level + rng.normal(0, 1, level.shape) * np.sqrt(3.0 + gain * level)) - level
    is_sky = rng.random(level.shape) > 0.2
    residual[rng.random(level.shape) < 1e-3] += 60  # faint stars
    found = measure_noise(SkyMap(np.zeros((1, 1)), level, residual, is_sky, 0.1))
    assert found.dn_per_e == pytest.approx(gain, abs=max(4 * found.dn_per_e_error, 1e-3))
    assert found.dn_per_e_error < 0.006
    assert found.at_zero_dn2 == pytest.approx(3.0, abs=0.9)
    assert found.is_shot_noise == (gain > 0)
    assert len(found.level_dn) == 12
    line = found.at_zero_dn2 + found.dn_per_e * found.level_dn
    assert np.abs((found.variance_dn2 - line) / found.variance_error_dn2).max() < 4
    np.testing.assert_allclose(
        found.variance_at_dn2(np.array([0.0, 100])), found.at_zero_dn2 + found.dn_per_e * np.array([0, 100]), rtol=1e-7
    )
    assert found.variance_at_dn2(np.array([-1e5 if gain else 0.0]))[0] >= 1e-3
    clear = [replace(found, dn_per_e=gain, dn_per_e_error=1.0).is_shot_noise for gain in (4.0, 4.01, 4.3)]
    assert clear == [False, True, True]
    block = SkyMap(np.zeros((1, 1)), level[:64, :320], residual[:64, :320], is_sky[:64, :320], 0.1)
    assert measure_noise(block) is None  # 20 blocks
    hidden = SkyMap(np.zeros((1, 1)), level, residual, rng.random(level.shape) < 0.2, 0.1)
    assert measure_noise(hidden) is None


def test_the_variance_of_a_block_excludes_outliers_and_rounding() -> None:
    rng = np.random.default_rng(12)
    residual = np.rint(rng.normal(0.3, 2.0, (6, 20_000)))
    is_sky = rng.random(residual.shape) > 0.5
    residual[:, ::50] += 40
    np.testing.assert_allclose(_clipped_variance(residual, is_sky), 4.0, rtol=0.08)
    fine = np.rint(rng.normal(0.0, 0.7, (1, 400_000)))
    assert _clipped_variance(fine, np.ones(fine.shape, bool))[0] == pytest.approx(0.49, rel=0.008)
    assert _clipped_variance(np.zeros((1, 50)), np.ones((1, 50), bool)).tolist() == [1e-3]
    # A Gaussian cut at 3.5 standard deviations has less variance.
    assert pytest.approx(np.sqrt(truncnorm.var(-3.5, 3.5)), rel=1e-9) == _CLIPPED_STD


@pytest.mark.parametrize("gamma", [1.0, 2.2, 0.5])
def test_the_gamma_makes_the_variance_grow_with_the_light(gamma: float) -> None:
    light = np.linspace(0.05, 0.8, 12)
    variance_of_light = 2e-5 + 4e-4 * light
    level = light ** (1 / gamma)
    variance = variance_of_light * (level ** (1 - gamma) / gamma) ** 2
    noise = NoiseAgainstLevel(1000 * level, 1e6 * variance, 1e4 * variance, 1.0, 0.1, 0.0)
    found = gamma_of_noise(noise, 1000.0)
    assert found.low <= gamma * 1.005
    assert found.high >= gamma * 0.995
    assert abs(np.log(found.value)) <= abs(np.log(gamma)) + 0.006
    assert found.high / found.low < 2.5
    few = NoiseAgainstLevel(
        *(one[:4] for one in (noise.level_dn, noise.variance_dn2, noise.variance_error_dn2)), 1.0, 0.1, 0.0
    )
    assert gamma_of_noise(few, 1000.0).value == 1.0
    # A line of positive intercept and slope has no misfit, another has one.
    assert _misfit_of_gamma(light, 1 + 3 * light, 0.1 * np.ones(12)) == pytest.approx(0, abs=1e-20)
    falling = 4 - 3 * light
    relative = np.full(12, 0.1)
    weights = 1 / (relative * falling)
    best = (weights**2 @ falling) / (weights**2).sum()
    expected = min(((weights * (falling - best)) ** 2).sum(), 1e9)
    assert _misfit_of_gamma(light, falling, relative) == pytest.approx(expected)


def test_repeated_stars_scatter_by_their_unbiased_deviations() -> None:
    rng = np.random.default_rng(13)
    star, image = np.repeat(np.arange(500), 2), np.tile([0, 1], 500)
    zero = np.array([0.2, -0.1])
    off = rng.normal(0, 1, 500)[star] + zero[image] + rng.normal(0, 0.05, 1000)
    seen = Observations(np.append(image, 0), np.append(star, 500), np.append(off, 3.0), np.full(1001, 0.05))
    deviations = _deviations_mag(seen, zero)
    rest = off - zero[image]
    pairs = rest.reshape(-1, 2)
    expected = ((pairs - pairs.mean(axis=1, keepdims=True)) * np.sqrt(2)).ravel()
    np.testing.assert_allclose(deviations, expected, rtol=0, atol=1e-12)
    kept = expected[np.abs(expected) <= 3 * 1.4826 * np.median(np.abs(expected))]
    assert _repeat_mag(seen, zero) == pytest.approx(np.sqrt((kept**2).mean()))
    assert _repeat_mag(seen, zero) == pytest.approx(0.05, rel=0.1)
    single = Observations(image[:1], star[:1], off[:1], off[:1])
    assert np.isnan(_repeat_mag(single, zero))
    values = np.array([1.0, -1, 1, -1, 4.4, 4.5])
    assert _clipped_std(values) == pytest.approx(np.sqrt((4 + 4.4**2) / 5))
    assert _clipped_std(np.zeros(0)) == 0


def test_photon_transfer_follows_its_definitions() -> None:
    rng = np.random.default_rng(14)
    shape, gain = (300, 400), 2.0
    darks = [photo(np.rint(100 + rng.normal(0, 3, shape)), 12) for _ in range(4)]
    mean, variance = _mean_and_variance(darks)
    np.testing.assert_allclose(mean, np.mean([dark.pixels_dn for dark in darks], axis=0), rtol=1e-7)
    differences = [darks[k].pixels_dn - darks[k + 1].pixels_dn for k in (0, 2)]
    assert variance == pytest.approx(np.mean([d.var() / 2 for d in differences]), rel=1e-3)
    outliers = differences[0].copy()
    outliers[0, :9] = 4000
    assert _half_variance(outliers) == pytest.approx(outliers[1:].var() / 2, rel=0.02)
    usable = np.ones(shape, bool)
    usable[:150] = False
    assert _half_variance(differences[0], usable) == pytest.approx(differences[0][150:].var() / 2, rel=1e-6)

    def flat(electrons: float, factor: float = 1.0) -> Photograph:
        return photo(np.rint(100 + gain * rng.poisson(electrons * factor, shape) + rng.normal(0, 3, shape)), 12)

    flats = [flat(300), flat(300, 1.015), flat(1200), flat(1200, 1.01), flat(800), flat(800, 1.03)]
    flats += [flat(1700), flat(1700)]  # above 80 % of the range
    everywhere = np.ones(shape, bool)
    found, error = _gain(flats, mean, variance, everywhere)
    means, variances = [], []
    for one, other in ((0, 1), (2, 3)):
        a, b = flats[one].pixels_dn - mean, flats[other].pixels_dn - mean
        means.append((a.mean() + b.mean()) / 2)
        low, high = sorted([a, b], key=np.mean)
        variances.append((low - high * low.mean() / high.mean()).var() / 2 - variance)
    x, y = np.array(means), np.array(variances)
    weight = 1 / (y + variance) ** 2
    assert found == pytest.approx((weight * x * y).sum() / (weight * x * x).sum(), rel=1e-3)
    assert found == pytest.approx(gain, rel=0.02)
    assert error == pytest.approx(np.sqrt(2 / 120_000 / (weight * x * x).sum()), rel=1e-3)

    above = np.full(shape, 500.0)
    response = rng.normal(1, 0.05, shape)
    noise = (gain * 500 + 9.0) / 8 / 500**2
    assert _prnu(response, above, gain, 8, everywhere, 3.0) == pytest.approx(np.sqrt(response.var() - noise), rel=1e-9)
    assert _prnu(np.ones(shape), above, gain, 8, everywhere, 3.0) == 0
    result = photon_transfer(darks, flats)
    assert result.read_noise_dn == pytest.approx(np.sqrt(variance - 1 / 12))
    assert result.keys["full_well_e"] == pytest.approx((4095 - result.black_level_dn) / result.dn_per_e)
    assert result.keys["read_noise_before_gain_e"] == pytest.approx(result.read_noise_dn / result.dn_per_e)
    assert (result.dark_frames, result.flat_fields) == (4, 8)
    hot = [photo(dark.pixels_dn.copy(), 12) for dark in darks]
    sigma = 1.4826 * np.median(np.abs(mean - np.median(mean)))
    for image in hot:
        image.pixels_dn[5, 5], image.pixels_dn[6, 6] = 100 + 10.6 * sigma, 100 + 9.4 * sigma
    assert photon_transfer(hot).hot == 1
