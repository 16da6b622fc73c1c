"""One lens fitted to several images of one camera: joint least squares with an attitude for each image."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np

from glstar.calibrate.detect import DetectedStars
from glstar.calibrate.lensfit import Pairs, fit_lens, match_again, matches_of
from glstar.calibrate.lensparameters import IdentifiedStars
from glstar.calibrate.lenstrials import BestLens, LensChoice, LensTrial, best_lens, fit_candidate
from glstar.calibrate.matches import Matches
from glstar.calibrate.platesolution import PlateSolution
from glstar.calibrate.referencestars import ReferenceStars
from glstar.calibrate.residuals import require_explained
from glstar.camera.distortion import COEFFICIENTS
from glstar.camera.model import Camera
from glstar.errors import CalibrationError

__all__ = ["SharedLensFit", "SingleImageFit", "fit_shared_lens", "require_one_camera"]

# Matching and fitting alternate at most this often.
_ROUNDS: Final = 6
# The focal lengths of one camera's images agree to this fraction.
_FOCAL_TOLERANCE: Final = 0.01


@dataclass(frozen=True, slots=True, eq=False)
class SingleImageFit:
    """The same lens model fitted to a single image.

    Attributes
    ----------
    camera : Camera
    standard_error : dict of str to float
        Of the fitted parameters.
    """

    camera: Camera
    standard_error: dict[str, float]


@dataclass(frozen=True, slots=True, eq=False)
class SharedLensFit:
    """One lens fitted to several images of a camera.

    Attributes
    ----------
    matches : tuple of Matches
        One for each image, all with the shared camera and each with its own attitude.
    chosen : LensTrial
        The lens model, with the residual over all images.
    standard_error : dict of str to float
        Of ``fx_px``, ``cx_px``, ``cy_px`` and the coefficients, of those that were fitted.
    single : tuple of SingleImageFit or None
        The same model fitted to each image separately; None if an image has too few stars.
    """

    matches: tuple[Matches, ...]
    chosen: LensTrial
    standard_error: dict[str, float]
    single: tuple[SingleImageFit | None, ...]

    @property
    def camera(self) -> Camera:
        """The shared camera."""
        return self.matches[0].solution.camera

    @property
    def summary(self) -> str:
        """The fit in one line, for the user."""
        camera = self.camera
        lens = "a pinhole" if camera.lens is None else str(camera.lens)
        errors_px = [fit.standard_error["fx_px"] for fit in self.single if fit is not None]
        alone = f" (from one image ± {min(errors_px):.2f} to {max(errors_px):.2f})" if errors_px else ""
        return (
            f"one lens fitted to {sum(map(len, self.matches))} stars of {len(self.matches)} images: {lens}, f ="
            f" {camera.fx_px:.2f} ± {self.standard_error['fx_px']:.2f} px{alone}, {self.chosen.rms_px:.3f} px rms"
        )

    def to_json(self, names: Sequence[str]) -> dict[str, Any]:
        """Return the fit as JSON-serialisable values.

        Parameters
        ----------
        names : sequence of str
            The images' file names.

        Returns
        -------
        dict
        """
        names_of_fitted = tuple(self.standard_error)
        return {
            "lens": self.chosen.label,
            "stars": sum(map(len, self.matches)),
            "rms_px": self.chosen.rms_px,
            "parameters": _parameters(self.camera, names_of_fitted),
            "standard_error": self.standard_error,
            "single_images": [
                {"file": name}
                if fit is None
                else {
                    "file": name,
                    "parameters": _parameters(fit.camera, names_of_fitted),
                    "standard_error": fit.standard_error,
                }
                for name, fit in zip(names, self.single, strict=True)
            ],
        }


def fit_shared_lens(
    names: Sequence[str],
    detected: Sequence[DetectedStars],
    reference: Sequence[ReferenceStars],
    identified: Sequence[Matches],
    *,
    lens: LensChoice = "auto",
) -> SharedLensFit:
    """Fit one camera with one lens to several images, each with an attitude of its own.

    Parameters
    ----------
    names : sequence of str
        The images' names, for error messages.
    detected, reference, identified : sequence
        Detections, reference stars and identified stars of each image.
    lens : {"auto", "none", "plumb_bob", "rational", "fisheye"}
        The model; ``"auto"`` chooses the one that all stars together justify, ``"none"`` is a pinhole.

    Returns
    -------
    SharedLensFit

    Raises
    ------
    CalibrationError
        If the images are not of one camera, or if the residuals of such a lens are too large.

    Notes
    -----
    Least squares over focal length, principal point, distortion coefficients and three rotation parameters for each
    image, with a robust loss (soft L1).  Positions are weighted by the noise of their image.
    """
    single = [fit_lens(d, r, m, lens=lens) for d, r, m in zip(detected, reference, identified, strict=True)]
    require_one_camera(names, [matches.solution.camera for matches in single])
    best, solutions, pairs, stars = _fit_jointly(detected, reference, single, lens)
    matches = tuple(
        matches_of(r, m, s, p, part, best.sd)
        for r, m, s, p, part in zip(reference, identified, solutions, pairs, stars, strict=True)
    )
    _require_all_explained(names, detected, reference, single, matches, best)
    fits = [fit_candidate(best.candidate, part, s) for part, s in zip(stars, solutions, strict=True)]
    alone = tuple(None if fit is None else SingleImageFit(*fit) for fit in fits)
    return SharedLensFit(matches, best.chosen, best.sd, alone)


def _fit_jointly(
    detected: Sequence[DetectedStars], reference: Sequence[ReferenceStars], single: Sequence[Matches], lens: LensChoice
) -> tuple[BestLens, list[PlateSolution], list[Pairs], tuple[IdentifiedStars, ...]]:
    """Return the shared lens, and the solution, the pairs and the stars of each image; matching is repeated with it."""
    apparent = [part.to_camera(np.eye(3)) for part in reference]
    start = max(single, key=len).solution
    prior = start.prior_camera or start.camera
    solutions = [replace(m.solution, camera=start.camera, k1=start.k1, prior_camera=prior) for m in single]
    pairs = [Pairs(matches.star, matches.detection, matches.expected_by_chance) for matches in single]

    def stars_of(pairs: list[Pairs]) -> tuple[IdentifiedStars, ...]:
        return tuple(
            IdentifiedStars.of(d, a, s, p.star, p.detection, r.rows)
            for d, r, a, s, p in zip(detected, reference, apparent, solutions, pairs, strict=True)
        )

    best = best_lens(stars_of(pairs), tuple(solutions), lens)
    solutions = _solutions_of(best, solutions)
    for _ in range(_ROUNDS):
        again = [
            match_again(d, r, a, s, p.star)
            for d, r, a, s, p in zip(detected, reference, apparent, solutions, pairs, strict=True)
        ]
        fewer = any(len(new) < len(old) // 2 for new, old in zip(again, pairs, strict=True))
        if fewer or all(new.is_same(old) for new, old in zip(again, pairs, strict=True)):
            break
        pairs = again
        best = best_lens(stars_of(pairs), tuple(solutions), lens)
        solutions = _solutions_of(best, solutions)
    return best, solutions, pairs, stars_of(pairs)


def require_one_camera(names: Sequence[str], cameras: Sequence[Camera]) -> None:
    """Raise an error for images of different size or focal length.

    Parameters
    ----------
    names : sequence of str
    cameras : sequence of Camera

    Raises
    ------
    CalibrationError
        If any two cannot be of one camera.
    """
    first = cameras[0]
    for name, camera in zip(names[1:], cameras[1:], strict=True):
        if (first.width_px, first.height_px) != (camera.width_px, camera.height_px):
            raise CalibrationError(
                f"{names[0]} is {first.width_px} x {first.height_px} px and {name} {camera.width_px} x"
                f" {camera.height_px} px: not one camera; calibrate them separately"
            )
        if abs(np.log(first.fx_px / camera.fx_px)) > _FOCAL_TOLERANCE:
            raise CalibrationError(
                f"{names[0]} has f = {first.fx_px:.1f} px and {name} f = {camera.fx_px:.1f} px: not one lens, or it was"
                " zoomed; calibrate them separately"
            )


def _solutions_of(best: BestLens, solutions: Sequence[PlateSolution]) -> list[PlateSolution]:
    return [
        replace(solution, camera=best.poses.camera, C_camera_eq=C, k1=0.0)
        for solution, C in zip(solutions, best.poses.C_camera_eq, strict=True)
    ]


def _require_all_explained(
    names: Sequence[str],
    detected: Sequence[DetectedStars],
    reference: Sequence[ReferenceStars],
    single: Sequence[Matches],
    matches: Sequence[Matches],
    best: BestLens,
) -> None:
    for name, d, r, before, after in zip(names, detected, reference, single, matches, strict=True):
        try:
            require_explained(
                d,
                r,
                before,
                after,
                lens=f"the lens of all images ({best.chosen.label})",
                advice="leave this image out, or calibrate it separately",
            )
        except CalibrationError as error:
            raise CalibrationError(f"{name}: {error}", stars_used=error.stars_used) from error


def _parameters(camera: Camera, names: Sequence[str]) -> dict[str, float]:
    """Return fitted parameters of a camera by name."""
    coefficients = {}
    if camera.lens is not None:
        coefficients = dict(zip(COEFFICIENTS[camera.lens.model], camera.lens.coefficients, strict=False))
    return {name: coefficients[name] if name in coefficients else float(getattr(camera, name)) for name in names}
