"""Refinement of wide views: matches grow outwards from the middle of the image, together with a fisheye lens."""

from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from glstar.calibrate.detect import DetectedStars
from glstar.calibrate.lensparameters import CameraPoses, FreeParameters, IdentifiedStars, fit_parameters
from glstar.calibrate.matches import MIN_STARS, Matches
from glstar.calibrate.matching import match_stars
from glstar.calibrate.platesolution import CENTRAL_RADIUS_RAD, PlateSolution
from glstar.calibrate.referencestars import ReferenceStars
from glstar.statistics import robust_std

__all__ = ["refine_outwards"]


@dataclass(frozen=True, slots=True)
class _Growth:
    """How matching grows outwards."""

    # Each round extends the matched radius by this factor; the matching radius is this fraction of the image's width.
    factor: float = 1.2
    radius: float = 0.005
    # Rounds over the whole image, at the end.
    rounds: int = 6
    # Their matching radius: this multiple of the 90th percentile of the residuals, and at least this many px.
    radius_per_residual: float = 3.0
    min_radius_px: float = 1.0
    # Number of fisheye coefficients from this fraction of the distance to the corner on.
    coefficients: tuple[tuple[float, int], ...] = ((0.0, 1), (0.4, 2), (0.65, 3), (0.9, 4))
    stars_per_parameter: int = 2
    min_noise_px: float = 0.005


_GROWTH: Final = _Growth()


def refine_outwards(detected: DetectedStars, reference: ReferenceStars, solution: PlateSolution) -> Matches | None:
    """Match and refine a solution that is right near the middle of the image and has an approximate lens.

    Parameters
    ----------
    detected : DetectedStars
    reference : ReferenceStars
    solution : PlateSolution
        Its camera has a fisheye lens, and the focal length and attitude that fit the middle of the image.

    Returns
    -------
    Matches or None
        With a fisheye that fits up to the corners; None if fewer than four stars match towards the corners, or if
        the matches are insignificant.
    """
    camera, apparent = solution.camera, reference.to_camera(np.eye(3))
    assert camera.lens is not None
    solution = replace(solution, prior_camera=solution.prior_camera or camera)
    corner_px = float(np.hypot(camera.width_px, camera.height_px) / 2)
    within_px = camera.fx_px * float(camera.lens.distort([np.tan(CENTRAL_RADIUS_RAD), 0.0])[0])
    radius_px, rounds = _GROWTH.radius * camera.width_px, _GROWTH.rounds
    while rounds:
        matches = match_stars(detected, reference, solution, radius_px, within_px=within_px)
        if len(matches) < MIN_STARS or matches.chance >= 1:
            return None
        stars = IdentifiedStars.of(detected, apparent, solution, matches.star, matches.detection, reference.rows)
        refined = _with_fisheye(stars, solution, matches, within_px / corner_px)
        if refined is None:
            return None
        solution = refined
        if within_px < corner_px:
            within_px *= _GROWTH.factor
        else:
            residual_px = np.linalg.norm(stars.residual_px(solution.camera, solution.C_camera_eq), axis=1)
            next_px = _GROWTH.radius_per_residual * float(np.nanquantile(residual_px, 0.9))
            radius_px = max(min(next_px, radius_px), _GROWTH.min_radius_px)
            rounds -= 1
    return match_stars(detected, reference, solution, radius_px, deep=True)


def _with_fisheye(
    stars: IdentifiedStars, solution: PlateSolution, matches: Matches, corner_fraction: float
) -> PlateSolution | None:
    """Return the solution with a fisheye whose number of coefficients depends on the matched radius."""
    count = max(count for fraction, count in _GROWTH.coefficients if corner_fraction >= fraction)
    count = max(1, min(count, len(stars) // _GROWTH.stars_per_parameter - 6))
    noise_px = max(robust_std(matches.residual_px), _GROWTH.min_noise_px)
    prior = solution.prior_camera or solution.camera
    free = FreeParameters((stars,), prior, (noise_px,), tuple(range(count)), principal_point=True)
    fit = fit_parameters(free, CameraPoses(solution.camera, (solution.C_camera_eq,)), "fisheye")
    if fit is None:
        return None
    return replace(solution, camera=fit.state.camera, C_camera_eq=fit.state.C_camera_eq[0])
