"""The camera from identified stars: focal length, principal point and lens, together with the attitude.

Identified stars are points of known direction distributed over the image.  The complexity of the lens is chosen by an
information criterion; see `glstar.calibrate.lenstrials`.  In a narrow field of view the principal point is nearly
degenerate with the attitude: it keeps its given value, or stays in the middle of the image.
"""

from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from glstar.calibrate.detect import DetectedStars
from glstar.calibrate.lensparameters import IdentifiedStars
from glstar.calibrate.lenstrials import BestLens, LensChoice, LensTrial, best_lens, simple_lens
from glstar.calibrate.matches import Matches
from glstar.calibrate.matching import mutual_nearest, offset_probability
from glstar.calibrate.platesolution import PlateSolution
from glstar.calibrate.referencestars import ReferenceStars
from glstar.calibrate.residuals import require_explained
from glstar.calibrate.significance import significant
from glstar.camera.model import Camera
from glstar.errors import CalibrationError

__all__ = ["CameraFit", "Pairs", "fit_camera", "fit_lens", "match_again", "matches_of"]

Float = NDArray[np.float64]
Index = NDArray[np.intp]

# Matching and fitting alternate at most this often.
_ROUNDS: Final = 6
# Matching radius: this multiple of the 90th percentile of the residuals, and at least this many px.
_RADIUS_PER_RESIDUAL: Final = 3.0
_MIN_RADIUS_PX: Final = 1.0
# Stars are matched down to the faintest match plus this, mag.
_FAINTER_MAG: Final = 0.5
# With fewer stars no lens is fitted unless the user chose a model.
_STARS_FOR_A_LENS: Final = 12


@dataclass(frozen=True, slots=True, eq=False)
class CameraFit:
    """The camera of an image, fitted to its identified stars.

    Attributes
    ----------
    matches : Matches
        With the refined solution: its camera has the lens, and its `k1` is 0.
    trials : tuple of LensTrial
        All lenses tried, the simplest first.
    chosen : LensTrial
    pinhole_rms_px : float
        Residual of the best pinhole, px; infinite if no pinhole projects all stars.
    sd : dict
        Standard errors of ``fx_px``, ``cx_px``, ``cy_px`` and the coefficients, of those that were free.
    corner_fraction : float
        Distance of the outermost star from the principal point, over that of the farthest corner, or over the radius
        of the image circle if that is smaller.
    """

    matches: Matches
    trials: tuple[LensTrial, ...]
    chosen: LensTrial
    pinhole_rms_px: float
    sd: dict[str, float]
    corner_fraction: float

    @property
    def camera(self) -> Camera:
        """The camera."""
        return self.matches.solution.camera

    @property
    def summary(self) -> str:
        """The fit in one line, for the user."""
        lens = "a pinhole" if self.camera.lens is None else str(self.camera.lens)
        pinhole = f"as a pinhole {self.pinhole_rms_px:.3f}" if np.isfinite(self.pinhole_rms_px) else "no pinhole fits"
        error_px = self.sd["fx_px"]
        return (
            f"lens fitted to {len(self.matches)} stars: {lens}, f = {self.camera.fx_px:.2f} ± {error_px:.2f} px,"
            f" {self.chosen.rms_px:.3f} px rms ({pinhole}); the stars cover {100 * self.corner_fraction:.0f} % of the"
            " distance to the corners"
        )


@dataclass(frozen=True, slots=True, eq=False)
class Pairs:
    """Indices of matched catalogue stars and detections, with the expected number of false pairs.

    Attributes
    ----------
    star, detection : (n,) intp
    expected_by_chance : float
    """

    star: Index
    detection: Index
    expected_by_chance: float

    def __len__(self) -> int:
        return len(self.star)

    def is_same(self, other: "Pairs") -> bool:
        """Return whether both have the same pairs."""
        return np.array_equal(self.star, other.star) and np.array_equal(self.detection, other.detection)


def fit_camera(
    detected: DetectedStars, reference: ReferenceStars, matches: Matches, *, lens: LensChoice = "auto"
) -> CameraFit:
    """Return the camera fitted to the identified stars of an image.

    Parameters
    ----------
    detected : DetectedStars
    reference : ReferenceStars
    matches : Matches
        Stars identified with a pinhole, or with a pinhole and k1; more are matched with the fitted lens.
    lens : {"auto", "none", "plumb_bob", "rational", "fisheye"}
        The model; with ``"auto"`` the one that the stars justify, with ``"none"`` a pinhole.

    Returns
    -------
    CameraFit
        By a robust loss (soft L1): a false match has little influence.

    Raises
    ------
    CalibrationError
        If there are too few stars for any lens of that model.
    """
    apparent = reference.to_camera(np.eye(3))
    pairs, solution = Pairs(matches.star, matches.detection, matches.expected_by_chance), matches.solution

    def stars_of(solution: PlateSolution, pairs: Pairs) -> IdentifiedStars:
        return IdentifiedStars.of(detected, apparent, solution, pairs.star, pairs.detection, reference.rows)

    # A simple lens extends the matches outwards, up to the corners.
    for _ in range(_ROUNDS):
        solution = simple_lens(stars_of(solution, pairs), solution, lens)
        again = match_again(detected, reference, apparent, solution, pairs.star)
        if len(again) < len(pairs) // 2 or np.array_equal(again.star, pairs.star):
            break
        pairs = again
    # The choice of the lens is repeated until the matches do not change.
    best = best_lens((stars_of(solution, pairs),), (solution,), lens)
    solution = _solution_of(best, solution)
    for _ in range(_ROUNDS):
        again = match_again(detected, reference, apparent, solution, pairs.star)
        if len(again) < len(pairs) // 2 or again.is_same(pairs):
            break
        try:
            best = best_lens((stars_of(solution, again),), (solution,), lens)
        except CalibrationError:  # too few stars are left: `fit_lens` judges the residuals of all
            break
        pairs, solution = again, _solution_of(best, solution)
    stars = stars_of(solution, pairs)
    pinhole_rms_px = min((trial.rms_px for trial, model in best.trials if model is None), default=np.inf)
    return CameraFit(
        matches_of(reference, matches, solution, pairs, stars, best.sd),
        tuple(trial for trial, _ in best.trials),
        best.chosen,
        pinhole_rms_px,
        best.sd,
        stars.corner_fraction(solution.camera),
    )


def fit_lens(
    detected: DetectedStars, reference: ReferenceStars, matches: Matches, *, lens: LensChoice = "auto"
) -> Matches:
    """Return the matches with the lens that the stars justify, or with the chosen model, if the residuals allow it.

    Parameters
    ----------
    detected : DetectedStars
    reference : ReferenceStars
    matches : Matches
        As for `fit_camera`.
    lens : {"auto", "none", "plumb_bob", "rational", "fisheye"}
        With ``"auto"`` and fewer than twelve stars the camera is unchanged.

    Returns
    -------
    Matches
        Its notes name the lens.

    Raises
    ------
    CalibrationError
        If the residuals of such a lens are too large.
    """
    identified = matches
    if lens == "auto" and len(matches) < _STARS_FOR_A_LENS:
        fitted = "a pinhole with radial distortion"
    else:
        fit = fit_camera(detected, reference, matches, lens=lens)
        # A pinhole is the expected result and needs no note.
        noted = lens != "auto" or fit.camera.lens is not None
        matches = replace(fit.matches, notes=(*matches.notes, fit.summary) if noted else matches.notes)
        fitted = f"the best of all lens models ({fit.chosen.label})" if lens == "auto" else f"a {lens} lens"
        fitted = "a pinhole" if lens == "none" else fitted
    advice = (
        "give an image as the camera took it, neither cropped nor stitched" if lens == "auto" else "use --lens auto"
    )
    require_explained(detected, reference, identified, matches, lens=fitted, advice=advice)
    return matches


def _solution_of(best: BestLens, solution: PlateSolution) -> PlateSolution:
    return replace(solution, camera=best.poses.camera, C_camera_eq=best.poses.C_camera_eq[0], k1=0.0)


def matches_of(
    reference: ReferenceStars,
    matches: Matches,
    solution: PlateSolution,
    pairs: Pairs,
    stars: IdentifiedStars,
    sd: dict[str, float],
) -> Matches:
    """Return matches with a fitted camera, its predictions and residuals.

    Parameters
    ----------
    reference : ReferenceStars
    matches : Matches
        Those that the fit started from.
    solution : PlateSolution
        The fitted one.
    pairs : Pairs
    stars : IdentifiedStars
        The stars of the pairs.
    sd : dict of str to float
        Standard errors of the camera's parameters.

    Returns
    -------
    Matches
    """
    predicted, predicted_xy = solution.stars_on_image(reference)
    residual = stars.residual_px(solution.camera, solution.C_camera_eq)
    if solution.mirrored:
        residual = residual * [-1.0, 1.0]
    return replace(
        matches,
        solution=solution,
        star=pairs.star,
        detection=pairs.detection,
        residual_px=residual,
        predicted=predicted,
        predicted_xy_px=predicted_xy,
        expected_by_chance=pairs.expected_by_chance,
        standard_error=sd,
    )


def match_again(
    detected: DetectedStars, reference: ReferenceStars, apparent: Float, solution: PlateSolution, before: Index
) -> Pairs:
    """Return the significant pairs of predicted and detected stars with a fitted camera.

    Parameters
    ----------
    detected : DetectedStars
    reference : ReferenceStars
    apparent : (n, 3) float64
        Apparent directions of all reference stars.
    solution : PlateSolution
    before : (k,) intp
        The stars matched before; they limit the magnitude of the new matches.

    Returns
    -------
    Pairs
    """
    xy = solution.placed(apparent, reference.rows)
    faintest = reference.stars.vmag[before].max() + _FAINTER_MAG
    on_image = np.flatnonzero(solution.camera.contains(xy) & (reference.stars.vmag <= faintest))
    if not len(on_image):
        return Pairs(on_image, on_image, 0.0)
    detection, distance_px = mutual_nearest(xy[on_image], detected.xy_px, _MIN_RADIUS_PX)
    known = np.isin(on_image, before)
    known &= np.isfinite(distance_px)
    typical_px = float(np.quantile(distance_px[known], 0.9)) if known.any() else _MIN_RADIUS_PX
    radius_px = max(_RADIUS_PER_RESIDUAL * min(typical_px, 3 * _MIN_RADIUS_PX), _MIN_RADIUS_PX)
    matched = distance_px < radius_px
    density_per_px2 = len(detected) / (solution.camera.width_px * solution.camera.height_px)
    offset_px = detected.xy_px[detection] - xy[on_image]
    probability = offset_probability(offset_px, matched, np.ones(len(matched)), density_per_px2, radius_px)
    kept = significant(probability)
    return Pairs(on_image[kept], detection[kept], float((1 - probability[kept]).sum()))
