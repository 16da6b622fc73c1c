"""The camera from identified stars: focal length, principal point and lens, together with the attitude.

An information criterion chooses the complexity of the lens; see `glstar.calibrate.geometry.lenschoice`.  In a narrow
field of view the principal point is nearly degenerate with the attitude: it keeps its given value, or stays in the
middle of the image.  Several images share one lens, and each has an attitude of its own.  A camera whose residuals are
far above the noise of the centroids is refused.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.special import xlogy

from glstar.arrays import Float, Index, robust_std
from glstar.calibrate.geometry.lenschoice import BestLens, LensChoice, LensTrial, best_lens, fit_candidate, simple_lens
from glstar.calibrate.identify.leastsquares import IdentifiedStars
from glstar.calibrate.identify.matching import mutual_nearest, offset_probability, significant
from glstar.calibrate.identify.platesolution import Matches, PlateSolution, ReferenceStars
from glstar.calibrate.notes import Note, NoteKind
from glstar.calibrate.photo.detection import DetectedStars
from glstar.camera.distortion import COEFFICIENTS
from glstar.camera.model import Camera
from glstar.errors import CalibrationError

# Smallest error of a centroid, due to pixels and catalogue, px.
_LEAST_NOISE_PX = 0.05
# Error of the centre of a saturated star over its width, and of a trail over its length.
_SATURATED_FRACTION = 0.5
_TRAIL_FRACTION = 0.25
# A camera is rejected if its residuals exceed this multiple of the noise, a pixel and the width of a star ...
_MOST_NOISE = 5.0
_MOST_PX = 1.0
# ... or if the root mean square exceeds this multiple of that limit, or more than this fraction of stars exceeds it.
_FAR_SIGMA = 3.0
_MOST_FAR_FRACTION = 0.2


@dataclass(frozen=True, slots=True)
class _Circle:
    """When the end of an image circle is seen in the stars."""

    stars: int = 50  # Number of bright stars needed
    missing: float = 12.0  # Number of them that would have been found beyond the circle
    false_fraction: float = 0.1  # Of those, the largest fraction that may seem to be found


_CIRCLE = _Circle()


def centroid_noise_px(detected: DetectedStars, detection: NDArray[np.intp]) -> float:
    """Return the median standard deviation of the centroids of detected stars in x and in y, px.

    `detection` (k,) intp: indices of the stars.  The Cramer-Rao bound of a Gaussian of amplitude A in noise s is s / A
    sqrt(2 / pi) px, independent of its width.
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

    `identified`: the stars identified before the camera was fitted; `matches`: the matches with the fitted camera;
    `lens`: the fitted model, for the message: ``a pinhole``; `advice`: the advice in the message.  Raises
    CalibrationError if the typical residual is more than five times the noise, and more than a pixel and the width of a
    star, or if many of the identified stars have residuals above that limit.
    """
    noise_px = centroid_noise_px(detected, matches.detection)
    most_px = max(_MOST_NOISE * noise_px, _MOST_PX, detected.psf_sigma_px)
    solution, detected_px = matches.solution, detected.xy_px[identified.detection]
    recorded = reference.recorded(solution.C_camera_eq, identified.star, detected_px, solution.camera)
    off_px = np.linalg.norm(detected_px - solution.project(recorded), axis=1)
    far = ~(off_px <= _FAR_SIGMA * most_px)
    typical = robust_std(matches.residual_px) <= most_px and matches.rms_px <= _FAR_SIGMA * most_px
    if typical and far.mean() <= _MOST_FAR_FRACTION:
        return
    if reference.C_ned_eq is None:
        advice += "; near the horizon, refraction bends an image too: give --utc, --lat and --lon"
    raise CalibrationError(
        f"{len(identified)} stars are identified, but {lens} leaves {int(far.sum())} of them more than"
        f" {_FAR_SIGMA * most_px:.1f} px from where they are found (those that still match: {matches.rms_px:.2f} px"
        f" rms), and their centres are measured to {noise_px:.2f} px: this is not the camera's lens; {advice}",
        stars_used=len(matches),
    )


# Matching and fitting alternate at most this often.
_ROUNDS = 6
# Matching radius: this multiple of the 90th percentile of the residuals, and at least this many px.
_RADIUS_PER_RESIDUAL = 3.0
_MIN_RADIUS_PX = 1.0
# Stars are matched down to the faintest match plus this, mag.
_FAINTER_MAG = 0.5
# With fewer stars no lens is fitted unless the user chose a model.
_STARS_FOR_A_LENS = 12


@dataclass(frozen=True, slots=True, eq=False)
class CameraFit:
    """The camera of an image, fitted to its identified stars."""

    matches: Matches  # With the refined solution: its camera has the lens, and its `k1` is 0
    trials: tuple[LensTrial, ...]  # All lenses tried, the simplest first
    chosen: LensTrial
    pinhole_rms_px: float  # Residual of the best pinhole, px; infinite if no pinhole projects all stars
    # Distance of the outermost star from the principal point, over that of the farthest corner, or over the radius of
    # the image circle if that is smaller.
    corner_fraction: float

    @property
    def camera(self) -> Camera:
        """The camera."""
        return self.matches.solution.camera

    @property
    def sd(self) -> dict[str, float]:
        """Standard errors of ``fx_px``, ``cx_px``, ``cy_px`` and the coefficients, of those that were free."""
        return self.matches.standard_error

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
    """Indices of matched catalogue stars and detections, with the expected number of false pairs."""

    star: Index  # (n,) intp
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

    `matches`: stars identified with a pinhole, or with a pinhole and k1; more are matched with the fitted lens; `lens`
    {"auto", "none", "plumb_bob", "rational", "fisheye"}: the model; with ``"auto"`` the one that the stars justify,
    with ``"none"`` a pinhole.  The loss is robust (soft L1): a false match has little influence.  Raises
    CalibrationError if there are too few stars for any lens of that model.
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
        stars.corner_fraction(solution.camera),
    )


def fit_lens(
    detected: DetectedStars, reference: ReferenceStars, matches: Matches, *, lens: LensChoice = "auto"
) -> Matches:
    """Return the matches with the lens that the stars justify, or with the chosen model, if the residuals allow it.

    `matches`: as for `fit_camera`; `lens` {"auto", "none", "plumb_bob", "rational", "fisheye"}: with ``"auto"`` and
    fewer than twelve stars the camera is unchanged.  A note names the lens.  Raises CalibrationError if the residuals
    of such a lens are too large.
    """
    identified = matches
    if lens == "auto" and len(matches) < _STARS_FOR_A_LENS:
        fitted = "a pinhole with radial distortion"
    else:
        fit = fit_camera(detected, reference, matches, lens=lens)
        # A pinhole is the expected result and needs no note.
        is_noted = lens != "auto" or fit.camera.lens is not None
        notes = (Note(NoteKind.CAMERA, fit.summary),) if is_noted else ()
        matches = replace(fit.matches, notes=(*matches.notes, *notes))
        fitted = f"the best of all lens models ({fit.chosen.label})" if lens == "auto" else f"a {lens} lens"
        fitted = "a pinhole" if lens == "none" else fitted
    advice = (
        "give an image as the camera took it, neither cropped nor stitched" if lens == "auto" else "use --lens auto"
    )
    require_explained(detected, reference, identified, matches, lens=fitted, advice=advice)
    return _within_circle(reference, matches)


def _within_circle(reference: ReferenceStars, matches: Matches) -> Matches:
    """Return the matches behind a fisheye whose image circle ends where the bright stars of the catalogue do."""
    solution = matches.solution
    lens = solution.camera.lens
    bright = matches.predicted[: len(matches)]
    if lens is None or lens.model != "fisheye" or len(bright) < _CIRCLE.stars:
        return matches
    cosine = reference.to_camera(solution.C_camera_eq)[bright, 2]
    order = np.argsort(-cosine)
    angle_rad, found = np.arccos(np.clip(cosine[order], -1, 1)), np.isin(bright, matches.star)[order]
    # The division into stars within and beyond the circle that explains best which ones were found.
    within = np.arange(1, len(found))
    found_within = np.cumsum(found)[:-1]
    beyond, found_beyond = len(found) - within, found.sum() - found_within
    both = ((within, found_within), (beyond, found_beyond))
    best = int(np.argmax(sum(xlogy(n, n / count) + xlogy(count - n, 1 - n / count) for count, n in both)))
    fraction = found_within[best] / within[best]
    if (
        fraction * beyond[best] < _CIRCLE.missing
        or found_beyond[best] > _CIRCLE.false_fraction * fraction * beyond[best]
    ):
        return matches
    end_rad = float(angle_rad[best : best + 2].mean())
    camera = replace(solution.camera, lens=replace(lens, max_angle_rad=float(np.deg2rad(np.rad2deg(end_rad).round(2)))))
    solution = replace(solution, camera=camera)
    predicted, predicted_xy = solution.stars_on_image(reference)
    kept = np.isin(matches.star, predicted)
    text = f"the image circle ends {np.rad2deg(end_rad):.1f} deg off the axis: bright stars beyond it are missing"
    return replace(
        matches,
        solution=solution,
        star=matches.star[kept],
        detection=matches.detection[kept],
        residual_px=matches.residual_px[kept],
        predicted=predicted,
        predicted_xy_px=predicted_xy,
        notes=(*matches.notes, Note(NoteKind.CAMERA, text)),
    )


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

    `matches`: those that the fit started from; `solution`: the fitted one; `stars`: the stars of the pairs; `sd`:
    standard errors of the camera's parameters by the scatter of the stars; that of unknown refraction is added.
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
        standard_error=with_refraction(sd, reference, solution),
    )


def with_refraction(sd: dict[str, float], reference: ReferenceStars, solution: PlateSolution) -> dict[str, float]:
    """Return standard errors of a camera's parameters, including the refraction if time and site do not state it."""
    of_focal, of_point = reference.refraction_error(solution.C_camera_eq[2])
    more = {"fx_px": of_focal, "cx_px": of_point, "cy_px": of_point}
    f_px = solution.camera.fx_px
    return {name: float(np.hypot(error, f_px * more.get(name, 0.0))) for name, error in sd.items()}


def match_again(
    detected: DetectedStars, reference: ReferenceStars, apparent: Float, solution: PlateSolution, before: Index
) -> Pairs:
    """Return the significant pairs of predicted and detected stars with a fitted camera.

    `apparent` (n, 3): apparent directions of all reference stars; `before` (k,) intp: the stars matched before; they
    limit the magnitude of the new matches.
    """
    xy = solution.placed(apparent, reference.rows)
    faintest = reference.stars.vmag[before].max() + _FAINTER_MAG
    on_image = np.flatnonzero(solution.camera.contains(xy) & (reference.stars.vmag <= faintest))
    if not len(on_image):
        return Pairs(on_image, on_image, 0.0)
    detection, distance_px = mutual_nearest(xy[on_image], detected.xy_px, _MIN_RADIUS_PX)
    was_matched = np.isin(on_image, before)
    was_matched &= np.isfinite(distance_px)
    typical_px = float(np.quantile(distance_px[was_matched], 0.9)) if was_matched.any() else _MIN_RADIUS_PX
    radius_px = max(_RADIUS_PER_RESIDUAL * min(typical_px, 3 * _MIN_RADIUS_PX), _MIN_RADIUS_PX)
    matched = distance_px < radius_px
    density_per_px2 = len(detected) / (solution.camera.width_px * solution.camera.height_px)
    offset_px = detected.xy_px[detection] - xy[on_image]
    probability = offset_probability(offset_px, matched, np.ones(len(matched)), density_per_px2, radius_px)
    kept = significant(probability)
    return Pairs(on_image[kept], detection[kept], float((1 - probability[kept]).sum()))


# Matching and fitting alternate at most this often.
_SHARED_ROUNDS = 6
# The focal lengths of one camera's images agree to this fraction.
_FOCAL_TOLERANCE = 0.01


@dataclass(frozen=True, slots=True, eq=False)
class SingleImageFit:
    """The same lens model fitted to a single image."""

    camera: Camera
    standard_error: dict[str, float]  # Of the fitted parameters


@dataclass(frozen=True, slots=True, eq=False)
class SharedLensFit:
    """One lens fitted to several images of a camera."""

    matches: tuple[Matches, ...]  # One for each image, all with the shared camera and each with its own attitude
    chosen: LensTrial  # The lens model, with the residual over all images
    # Of ``fx_px``, ``cx_px``, ``cy_px`` and the coefficients, of those that were fitted.
    standard_error: dict[str, float]
    # The same model fitted to each image separately; None if an image has too few stars.
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
        """Return the fit as JSON-serialisable values; `names`: the images' file names."""
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

    `names`: the images' names, for error messages; `detected`, `reference`, `identified`: detections, reference stars
    and identified stars of each image; `lens` {"auto", "none", "plumb_bob", "rational", "fisheye"}: the model;
    ``"auto"`` chooses the one that all stars together justify, ``"none"`` is a pinhole.  Raises CalibrationError if
    the images are not of one camera, or if the residuals of such a lens are too large.  Least squares over focal
    length, principal point, distortion coefficients and three rotation parameters for each image, with a robust loss
    (soft L1).  Positions are weighted by the noise of their image.
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
    alone = tuple(
        None if fit is None else SingleImageFit(fit[0], with_refraction(fit[1], r, s))
        for fit, r, s in zip(fits, reference, solutions, strict=True)
    )
    # The refraction of the images may be alike.
    shared_error = {name: max(part.standard_error[name] for part in matches) for name in best.sd}
    return SharedLensFit(matches, best.chosen, shared_error, alone)


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
    for _ in range(_SHARED_ROUNDS):
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

    Raises CalibrationError if any two cannot be of one camera.
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
