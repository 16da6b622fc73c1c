"""Photographs that a camera has processed with a tone curve: their light, and the gamma that their noise shows."""

from dataclasses import replace
from math import nan
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from glstar.calibrate.detect import DetectedStars
from glstar.calibrate.photograph import Photograph
from glstar.calibrate.skymeasurement import NoiseAgainstLevel, measure_noise, measure_sky
from glstar.camera.tonecurve import GAMMAS, light_before, recorded_by
from glstar.errors import ConfigError

__all__ = ["GammaFit", "fit_gamma", "gamma_of_noise", "linearised", "recorded_again"]

Float = NDArray[np.float64]

# Bits of a photograph's light: fine enough for the steps of 8 recorded bits.
_BITS: Final = 16
# Gammas that are tried: from much darker to much brighter than a screen's 2.2, in steps of 0.5 %.
_GAMMAS: Final = np.exp(np.arange(np.log(0.25), np.log(4.0), 0.005))
# Levels whose variance is smaller than this are not used, DN^2: the rounding to whole numbers is not noise.
_LEAST_VARIANCE_DN2: Final = 1.0
_LEAST_LEVELS: Final = 5
# The variance of a level is right to this fraction: the sky is not quite smooth inside a block.
_VARIANCE_ERROR: Final = 0.05


def linearised(image: Photograph, gamma: str | float) -> Photograph:
    """Return the light of a photograph that a tone curve has processed.

    Parameters
    ----------
    image : Photograph
        As recorded.
    gamma : str or float
        As in ``[output] gamma``: ``"srgb"``, ``"rpi"``, or g for a recorded value that grows as the light to the power
        of 1 / g.

    Returns
    -------
    Photograph
        Of 16 bits, proportional to the light; the same where `gamma` is ``"linear"``.

    Raises
    ------
    ConfigError
        If there is no such curve.
    """
    if gamma == "linear":
        return image
    curve = _checked(gamma)
    light = light_before(image.pixels_dn / image.saturation_dn, curve)
    return replace(image, pixels_dn=light * (2**_BITS - 1), bit_depth=_BITS, recorded_bits=image.bit_depth, gamma=curve)


def recorded_again(image: Photograph, pixels: NDArray[Any]) -> NDArray[Any]:
    """Return raw pixels as the camera of a photograph records them.

    Parameters
    ----------
    image : Photograph
    pixels : (height, width) uint8 or uint16
        Raw, with the bits of `image`.

    Returns
    -------
    (height, width) uint8 or uint16
        Processed with its tone curve, with the bits of its file.
    """
    if image.gamma == "linear":
        return pixels
    recorded = recorded_by(pixels / image.saturation_dn, image.gamma)
    return np.asarray(recorded * (2**image.recorded_bits - 1) + 0.5).astype(
        np.uint16 if image.recorded_bits > 8 else np.uint8
    )


def _checked(gamma: str | float) -> str | float:
    """Return the name of a tone curve, or a number."""
    if gamma in GAMMAS:
        return gamma
    try:
        number = float(gamma)
    except ValueError:
        number = nan
    if not 0.1 <= number <= 10:
        raise ConfigError(f"--gamma is {', '.join(GAMMAS)}, fit, or a number from 0.1 to 10, not {gamma!r}")
    return number


class GammaFit(NamedTuple):
    """The gamma of a tone curve by the noise of an image.

    Attributes
    ----------
    value : float
        The one nearest to 1 that the noise allows, within one standard error; 1 if it allows a linear image.
    low, high : float
        The range that it allows, within two standard errors.
    """

    value: float
    low: float
    high: float


def fit_gamma(image: Photograph, detected: DetectedStars) -> GammaFit:
    """Return the gamma of a photograph's tone curve, by the noise of its sky.

    Parameters
    ----------
    image : Photograph
        As recorded.
    detected : DetectedStars

    Returns
    -------
    GammaFit
    """
    noise = measure_noise(measure_sky(image, detected, np.zeros((0, 2))))
    return _ANY if noise is None else gamma_of_noise(noise, image.saturation_dn)


def gamma_of_noise(noise: NoiseAgainstLevel, white_dn: float) -> GammaFit:
    """Return the gamma with which the variance of the light grows linearly with the light.

    Parameters
    ----------
    noise : NoiseAgainstLevel
        As recorded.
    white_dn : float
        The largest digital number.

    Returns
    -------
    GammaFit

    Notes
    -----
    Photon transfer, EMVA 1288 eq. (9), in the light x = (DN / white)^g: the variance of DN times (dx / dDN)^2 is a line
    with an intercept, the read noise, and a slope, the gain, that are not negative.  Read noise and gamma bend the line
    alike: that with the least gamma is taken.
    """
    used = (noise.variance_dn2 > _LEAST_VARIANCE_DN2) & (noise.level_dn > 0)
    if used.sum() < _LEAST_LEVELS:
        return _ANY
    level, variance = noise.level_dn[used] / white_dn, noise.variance_dn2[used]
    error = np.hypot(noise.variance_error_dn2[used] / variance, _VARIANCE_ERROR)
    chi2 = np.array([_misfit(level**g, variance * (g * level ** (g - 1)) ** 2, error) for g in _GAMMAS.tolist()])
    unit = max(1.0, float(chi2.min()) / int(used.sum() - 3))
    near, allowed = (_GAMMAS[chi2 <= chi2.min() + count * unit] for count in (1, 4))
    low, high = float(allowed.min()), float(allowed.max())
    value = 1.0 if low <= 1 <= high else float(near[np.abs(np.log(near)).argmin()])
    return GammaFit(value, low, high)


_ANY: Final = GammaFit(1.0, float(_GAMMAS[0]), float(_GAMMAS[-1]))


def _misfit(light: Float, variance: Float, relative_error: Float) -> float:
    """Return the sum of squares of variances off a line whose intercept and slope are not negative."""
    design = np.column_stack([np.ones_like(light), light]) / (relative_error * variance)[:, np.newaxis]
    ones = 1 / relative_error
    trials = []
    for columns in ([0, 1], [0], [1]):
        found = np.linalg.lstsq(design[:, columns], ones, rcond=None)[0]
        if (found >= 0).all():
            trials.append(float(np.sum((ones - design[:, columns] @ found) ** 2)))
    return min(trials)
