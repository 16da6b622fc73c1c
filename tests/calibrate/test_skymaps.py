"""Maps of a sky that is cut off at 0, its noise, and the gamma that the noise allows, against non-negative fits."""

from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.optimize import nnls
from scipy.stats import norm

from glstar.calibrate.photo import sky as module
from glstar.calibrate.photo.detection import background_of
from glstar.calibrate.photo.photograph import Photograph
from glstar.calibrate.photo.sky import (
    NoiseAgainstLevel,
    SkyMap,
    _clipped_variance,
    _smoothed,
    fit_gamma,
    gamma_of_noise,
    measure_noise,
    measure_sky,
)


def detected_on(pixels: np.ndarray) -> SimpleNamespace:
    return SimpleNamespace(
        psf_sigma_px=1.0,
        signal_to_noise=np.zeros(0),
        saturated=np.zeros(0, bool),
        xy_px=np.zeros((0, 2)),
        background=background_of(pixels),
    )


def map_of(pixels: np.ndarray) -> SkyMap:
    return measure_sky(Photograph(Path("a.png"), pixels, 8, "grey", None), detected_on(pixels), np.zeros((0, 2)))


@pytest.mark.parametrize(("mean", "std"), [(0.6, 2.0), (2.5, 1.5)])
def test_the_level_of_a_cut_off_sky_is_that_before_the_cut(mean: float, std: float) -> None:
    rng = np.random.default_rng(4)
    pixels = np.maximum(np.rint(rng.normal(mean, std, (160, 224))), 0.0)
    found = map_of(pixels)
    assert found.level_dn.mean() == pytest.approx(mean, abs=0.08)
    # The mean of what was recorded is larger.
    cut = mean * norm.cdf(mean / std) + std * norm.pdf(mean / std)
    assert cut > mean + 0.02
    np.testing.assert_allclose(found.residual_dn, pixels - found.level_dn, rtol=1e-7, atol=1e-9)


def test_a_sky_with_few_pixels_at_0_is_the_mean_without_outliers() -> None:
    rng = np.random.default_rng(5)
    pixels = np.rint(rng.normal(30, 2.0, (160, 224)))
    pixels[rng.random(pixels.shape) < 0.0015] = 0
    pixels[rng.random(pixels.shape) < 0.01] += 40
    found = map_of(pixels)
    background = background_of(pixels)
    level, good = background.level_dn, None
    for _ in range(4):
        good = np.abs(pixels - level) < 3.5 * np.maximum(background.noise_dn, 0.7)
        texels, error = _smoothed(np.where(good, pixels, 0.0), good, 16, background.level_dn)
        level = np.asarray(module._at_pixels(texels, pixels.shape))
    np.testing.assert_allclose(found.texels_dn, texels, rtol=1e-9)
    np.testing.assert_allclose(found.level_dn, level, rtol=1e-9)
    assert found.error_dn == pytest.approx(error * np.median(background.noise_dn))
    assert good.mean() < 0.995


def test_the_noise_of_a_cut_off_sky_is_that_before_the_cut() -> None:
    rng = np.random.default_rng(6)
    level = np.linspace(0.5, 12.0, 384) * np.ones((384, 1))
    pixels = np.maximum(np.rint(level + rng.normal(0, 1, level.shape) * np.sqrt(1.5 + 0.25 * level)), 0.0)
    sky = SkyMap(np.zeros((1, 1)), level, pixels - level, np.ones(level.shape, bool), 0.1)
    found = measure_noise(sky)
    assert found.dn_per_e == pytest.approx(0.25, abs=0.04)
    assert found.at_zero_dn2 == pytest.approx(1.5, abs=0.15)
    assert len(found.level_dn) == 12
    # 144 blocks of 32 px in order of their level, twelve each.
    middle = np.sort(np.repeat(level[0].reshape(12, 32).mean(axis=1), 12))
    np.testing.assert_allclose(found.level_dn, middle.reshape(12, 12).mean(axis=1), rtol=0, atol=0.12)
    blocks = (pixels - level).reshape(12, 32, 12, 32).swapaxes(1, 2).reshape(144, -1)
    plain = _clipped_variance(blocks, np.ones(blocks.shape, bool)).reshape(12, 12)
    # Far above 0 nothing is cut.
    np.testing.assert_allclose(found.variance_dn2[-3:], np.median(plain, axis=0)[-3:], rtol=1e-9)
    assert found.variance_dn2[0] > 1.2 * np.median(plain[:, 0])
    errors = np.maximum(1.25 * plain.std(axis=0) / np.sqrt(12), np.median(plain, axis=0) * np.sqrt(2 / (1024 * 12)))
    np.testing.assert_allclose(found.variance_error_dn2[-3:], errors[-3:], rtol=1e-9)
    x, y, error = found.level_dn, found.variance_dn2, found.variance_error_dn2
    (slope, at_zero), covariance = np.polyfit(x, y, 1, w=1 / error, cov="unscaled")
    assert (found.dn_per_e, found.at_zero_dn2) == pytest.approx((slope, at_zero), rel=1e-6)
    excess = np.sum(((y - at_zero - slope * x) / error) ** 2) / 10
    assert found.dn_per_e_error == pytest.approx(np.sqrt(covariance[0, 0] * max(excess, 1)), rel=1e-6)


@pytest.mark.parametrize("gamma", [0.5, 1.0, 1.8, 2.2])
@pytest.mark.parametrize("off", [0.0, 0.4])
def test_the_gammas_that_noise_allows_are_those_of_lines_that_are_not_negative(gamma: float, off: float) -> None:
    rng = np.random.default_rng(7)
    light = np.linspace(0.03, 0.7, 14)
    level = 900 * light ** (1 / gamma)
    variance = (3e-6 + 4e-5 * light) * (900 / gamma * light ** (1 / gamma - 1)) ** 2
    variance *= 1 + (0.04 + off) * rng.normal(size=14).clip(-1.5, 1.5)
    error = 0.03 * variance
    level[2], variance[4] = -level[2], 0.98  # neither is used
    noise = NoiseAgainstLevel(level, variance, error, 1.0, 1.0, 1.0)
    used = (variance > 1) & (level > 0)
    assert used.sum() >= 8
    x, v, e = level[used] / 900, variance[used], np.hypot(0.03, 0.05)
    gammas = np.exp(np.arange(np.log(0.25), np.log(4.0), 0.005))
    chi2 = []
    for g in gammas:
        scale = (g * x ** (g - 1)) ** 2 * v * e
        design = np.column_stack([1 / scale, x**g / scale])
        chi2.append(nnls(design, np.full(len(x), 1 / e))[1] ** 2)
    chi2 = np.array(chi2)
    unit = max(1.0, chi2.min() / (used.sum() - 3))
    assert (unit > 1) == (off > 0)
    near, allowed = gammas[chi2 <= chi2.min() + unit], gammas[chi2 <= chi2.min() + 4 * unit]
    found = gamma_of_noise(noise, 900.0)
    assert (found.low, found.high) == (pytest.approx(allowed.min()), pytest.approx(allowed.max()))
    is_linear = allowed.min() <= 1 <= allowed.max()
    assert found.value == pytest.approx(1.0 if is_linear else near[np.abs(np.log(near)).argmin()])


def test_a_gamma_needs_five_levels() -> None:
    level = np.linspace(100, 800, 9)
    variance = np.where(np.arange(9) < 5, 4.0 + 0.01 * level, 0.5)

    def found(count: int):
        some = np.where(np.arange(9) < count, variance, 0.5)
        return gamma_of_noise(NoiseAgainstLevel(level, some, 0.1 * some, 1.0, 1.0, 1.0), 900.0)

    unknown = (1.0, pytest.approx(0.25), pytest.approx(4.0, rel=0.005))
    assert found(4) == unknown
    assert found(5) != unknown
    assert found(5).high < 3.5


def test_the_gamma_of_an_image_is_that_of_its_noise(monkeypatch: pytest.MonkeyPatch) -> None:
    calls = []

    def mapped(image, detected, more_px):
        calls.append((image, detected, more_px.shape))
        return "map"

    monkeypatch.setattr(module, "measure_sky", mapped)
    monkeypatch.setattr(module, "measure_noise", lambda sky: noise if sky == "map" else "?")
    monkeypatch.setattr(module, "gamma_of_noise", lambda *arguments: arguments)
    image = Photograph(Path("a.png"), np.zeros((40, 40)), 10, "grey", None)
    noise = "noise"
    assert fit_gamma(image, "stars") == ("noise", 1023)
    assert calls == [(image, "stars", (0, 2))]
    noise = None
    assert fit_gamma(image, "stars") == (1.0, pytest.approx(0.25), pytest.approx(4.0, rel=0.005))
