"""The brightness of each star as one photograph records it, besides what the sensor model explains."""

from typing import Final

import numpy as np
from numpy.typing import NDArray

from glstar.calibrate.brightnessterms import BrightnessTerms
from glstar.calibrate.calibration import Calibration
from glstar.calibrate.combine import Observations, StarTable, solve_brightness
from glstar.camera.colourband import ColourBand
from glstar.render.colourscenes import colours_used

__all__ = ["recorded_brightness"]

Float = NDArray[np.float64]

# Stars below this signal-to-noise ratio say nothing that the catalogue does not say better.
_LEAST_SNR: Final = 3.0
# Standard error of a flux besides its noise, mag: the profile is not exactly that of every star.
_LEAST_ERROR_MAG: Final = 0.02


def recorded_brightness(
    calibration: Calibration, terms: BrightnessTerms, colour: ColourBand, flux_dn: Float, error_dn: Float
) -> StarTable:
    """Return the magnitudes of the matched stars in the camera's band.

    Parameters
    ----------
    calibration : Calibration
    terms : BrightnessTerms
        What their brightness depends on.
    colour : ColourBand
        The camera's band.
    flux_dn, error_dn : (n,) float64
        Of the matched stars, with standard errors, DN.

    Returns
    -------
    StarTable
        Of the stars that are neither saturated nor blended.

    Notes
    -----
    A star differs from the catalogue because it varies, because its light is that of several stars or of a nebula, or
    because of air and cloud before it.  The deviations are shrunk towards their median, as those of several
    photographs are: a star whose noise is as large as the spread of all stars keeps half of its deviation.
    """
    stars, reference = calibration.stars, calibration.reference.stars
    measured = np.isfinite(terms.residual_mag) & (flux_dn > _LEAST_SNR * error_dn)
    chosen = np.flatnonzero(measured & ~stars.saturated & ~stars.blended)
    noise_mag = 2.5 / np.log(10) * error_dn[chosen] / flux_dn[chosen]
    order = np.arange(len(chosen))
    seen = Observations(np.zeros_like(order), order, terms.residual_mag[chosen], np.hypot(noise_mag, _LEAST_ERROR_MAG))
    off_mag, error_mag, zero_mag, _ = solve_brightness(seen, len(chosen), 1)
    matched = calibration.matches.star[chosen]
    of_band = colour.magnitude_minus_v(colours_used(reference, matched))
    names = tuple(reference.name[k] for k in matched.tolist())
    return StarTable(
        reference.catalogue, reference.star_id[matched], names, stars.vmag[chosen], of_band + zero_mag[0] + off_mag,
        error_mag, np.ones_like(order),
    )  # fmt: skip
