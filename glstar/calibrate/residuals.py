"""Validation of a fitted camera: its residuals against the noise of the centroids."""

from typing import Final

import numpy as np
from numpy.typing import NDArray

from glstar.calibrate.detect import DetectedStars
from glstar.calibrate.matches import Matches
from glstar.calibrate.referencestars import ReferenceStars
from glstar.errors import CalibrationError
from glstar.statistics import robust_std

__all__ = ["centroid_noise_px", "require_explained"]

Float = NDArray[np.float64]

# Smallest error of a centroid, due to pixels and catalogue, px.
_LEAST_NOISE_PX: Final = 0.05
# Error of the centre of a saturated star over its width, and of a trail over its length.
_SATURATED_FRACTION: Final = 0.5
_TRAIL_FRACTION: Final = 0.25
# A camera is rejected if its residuals exceed this multiple of the noise, a pixel and the width of a star ...
_MOST_NOISE: Final = 5.0
_MOST_PX: Final = 1.0
# ... or if the root mean square exceeds this multiple of that limit, or more than this fraction of stars exceeds it.
_FAR: Final = 3.0
_MOST_FAR_FRACTION: Final = 0.2


def centroid_noise_px(detected: DetectedStars, detection: NDArray[np.intp]) -> float:
    """Return the median standard deviation of the centroids of detected stars in x and in y, px.

    Parameters
    ----------
    detected : DetectedStars
    detection : (k,) intp
        Indices of the stars.

    Returns
    -------
    float

    Notes
    -----
    The Cramer-Rao bound of a Gaussian of amplitude A in noise s is s / A sqrt(2 / pi) px, independent of its width.
    """
    noise_px = np.sqrt(2 / np.pi) / detected.signal_to_noise[detection]
    noise_px = np.hypot(noise_px, _LEAST_NOISE_PX)
    saturated_px = _SATURATED_FRACTION * detected.psf_sigma_px
    noise_px = np.where(detected.saturated[detection], np.maximum(noise_px, saturated_px), noise_px)
    return float(np.hypot(np.median(noise_px), _TRAIL_FRACTION * detected.drawn_out_px))


def require_explained(
    detected: DetectedStars, reference: ReferenceStars, identified: Matches, matches: Matches, *, lens: str, advice: str
) -> None:
    """Raise an error if a camera's residuals are far above the noise of the centroids.

    Parameters
    ----------
    detected : DetectedStars
    reference : ReferenceStars
    identified : Matches
        The stars identified before the camera was fitted.
    matches : Matches
        The matches with the fitted camera.
    lens : str
        The fitted model, for the message: ``a pinhole``.
    advice : str
        The advice in the message.

    Raises
    ------
    CalibrationError
        If the typical residual is more than five times the noise, and more than a pixel and the width of a star, or if
        many of the identified stars have residuals above that limit.
    """
    noise_px = centroid_noise_px(detected, matches.detection)
    most_px = max(_MOST_NOISE * noise_px, _MOST_PX, detected.psf_sigma_px)
    solution, found = matches.solution, detected.xy_px[identified.detection]
    placed = solution.project(reference.recorded(solution.C_camera_eq, identified.star, found, solution.camera))
    off_px = np.linalg.norm(found - placed, axis=1)
    far = ~(off_px <= _FAR * most_px)
    typical = robust_std(matches.residual_px) <= most_px and matches.rms_px <= _FAR * most_px
    if typical and far.mean() <= _MOST_FAR_FRACTION:
        return
    if reference.C_ned_eq is None:
        advice += "; near the horizon, refraction bends an image too: give --utc, --lat and --lon"
    raise CalibrationError(
        f"{len(identified)} stars are identified, but {lens} leaves {int(far.sum())} of them more than"
        f" {_FAR * most_px:.1f} px from where they are found (those that still match: {matches.rms_px:.2f} px rms), and"
        f" their centres are measured to {noise_px:.2f} px: this is not the camera's lens; {advice}",
        stars_used=len(matches),
    )
