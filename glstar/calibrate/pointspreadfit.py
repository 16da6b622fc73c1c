"""The shape of the stars of a photograph as keys of the sensor: Moffat wings, ellipticity and growth off axis."""

from dataclasses import replace
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

from glstar.calibrate.calibration import Calibration
from glstar.calibrate.misfit import RadialProfile
from glstar.camera.sensor import PIXEL_VARIANCE_PX2, EffectValue

__all__ = ["fit_moffat", "with_point_spread"]

Float = NDArray[np.float64]

_SIGMA_PER_FWHM: Final = 1 / (2 * np.sqrt(2 * np.log(2)))
# Range of the exponent; above the upper limit a Moffat profile is a Gaussian.
_BETA: Final = (2.0, 20.0)
_GAUSSIAN_BETA: Final = 15.0
# Mean square of the distance from the centre of stars all over an image, over that of a corner.
_MEAN_SQUARE_DISTANCE: Final = 1 / 3
_LARGEST_ELLIPTICITY: Final = 0.4
# What the notes on the effects begin with that the sensor then has.
_EXPLAINED: Final = ("the stars have wings", "the stars are elliptical", "the stars in the corner are")


def with_point_spread(calibration: Calibration) -> Calibration:
    """Return a calibration whose sensor has the shape of the stars besides their width.

    Parameters
    ----------
    calibration : Calibration

    Returns
    -------
    Calibration
        Ellipticity and growth only where they are significant.  Width and amplitude are those of the Moffat profile on
        the axis.
    """
    sensor, misfit = calibration.sensor, calibration.misfit
    effects: dict[str, EffectValue] = dict(sensor.effects)
    found = []
    sigma_px, peak_dn = sensor.psf_sigma_px, sensor.reference_peak_dn
    if misfit.stacked is not None:
        beta, width, amplitude = fit_moffat(misfit.stacked)
        if beta < _GAUSSIAN_BETA:
            recorded_px2 = sigma_px**2 + PIXEL_VARIANCE_PX2
            narrower_px2 = max(width**2 * recorded_px2 - PIXEL_VARIANCE_PX2, 0.01)
            # The flux of a Gaussian of this width over that of the wider one that was fitted.
            peak_dn *= amplitude * (sigma_px**2 / recorded_px2) * (width**2 * recorded_px2 / narrower_px2)
            sigma_px = float(np.sqrt(narrower_px2))
            effects |= {"sensor.psf": "moffat", "sensor.psf_beta": round(beta, 3)}
            found.append(f"Moffat profile of beta {beta:.2f}")
    growth = misfit.corner_growth
    if growth is not None and growth.exceeds(0.0) and growth.value > 0:
        effects["sensor.psf_growth"] = round(growth.value, 4)
        sigma_px /= 1 + growth.value * _MEAN_SQUARE_DISTANCE
        peak_dn *= (1 + growth.value * _MEAN_SQUARE_DISTANCE) ** 2
        found.append(f"growth to the corners {growth.value:.3f} ± {growth.standard_error:.3f}")
    if misfit.ellipticity is not None and misfit.ellipticity.exceeds(0.0):
        ellipticity = min(1 - 1 / misfit.axis_ratio, _LARGEST_ELLIPTICITY)
        effects["sensor.psf_ellipticity"] = round(ellipticity, 4)
        effects["sensor.psf_angle_deg"] = round(float(np.rad2deg(misfit.long_axis_rad)), 1)
        found.append(f"ellipticity {ellipticity:.3f} ± {misfit.ellipticity.standard_error:.3f}")
    shaped = replace(sensor, psf_sigma_px=sigma_px, reference_peak_dn=float(peak_dn), effects=effects)
    kept = tuple(note for note in calibration.notes if not note.startswith(_EXPLAINED))
    notes = (*kept, f"shape of the stars: {', '.join(found) if found else 'plain Gaussians'}")
    return replace(calibration, sensor=shaped, notes=notes)


def fit_moffat(stacked: RadialProfile) -> tuple[float, float, float]:
    """Fit a Moffat profile to the median profile of the stars.

    Parameters
    ----------
    stacked : RadialProfile

    Returns
    -------
    beta : float
        Exponent, 2 to 20.
    width : float
        Width at half maximum over that of the Gaussian fit of the same stars.
    amplitude : float
        Amplitude over that of the Gaussian fit.

    Notes
    -----
    Least squares over the bins up to 8 sigma, weighted with the square root of their area, so that wings count.
    """
    radius, brightness = stacked.radius_sigma, stacked.brightness
    known = np.isfinite(brightness)
    radius, brightness = radius[known], brightness[known]
    weight = np.sqrt(radius)

    def residuals(parameters: Float) -> Float:
        amplitude, alpha, beta = parameters
        return np.asarray(weight * (amplitude * (1 + (radius / alpha) ** 2) ** -beta - brightness))

    fitted = least_squares(residuals, (1.0, 2.5, 4.0), bounds=((0.2, 0.2, _BETA[0]), (5.0, 20.0, _BETA[1])))
    amplitude, alpha, beta = fitted.x.tolist()
    return beta, 2 * alpha * np.sqrt(2 ** (1 / beta) - 1) * _SIGMA_PER_FWHM, amplitude
