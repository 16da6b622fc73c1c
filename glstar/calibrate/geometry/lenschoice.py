"""The choice of a lens model: lenses are tried from the simplest on, and Bayes' information criterion decides."""

from dataclasses import dataclass, replace
from typing import Literal, NamedTuple

import numpy as np

from glstar.arrays import Float, robust_std
from glstar.calibrate.identify.leastsquares import (
    CameraPoses,
    FreeParameters,
    IdentifiedStars,
    fit_parameters,
    is_one_to_one,
    standard_errors,
)
from glstar.calibrate.identify.platesolution import PlateSolution
from glstar.camera.distortion import Lens, LensModel
from glstar.camera.model import Camera
from glstar.errors import CalibrationError

LensChoice = Literal["auto", "none", "plumb_bob", "rational", "fisheye"]


class LensCandidate(NamedTuple):
    """A lens model, the indices of its free coefficients, and whether the principal point is free."""

    model: LensModel | None
    coefficients: tuple[int, ...]
    principal_point: bool

    @property
    def radial(self) -> int:
        """The number of radial coefficients."""
        return sum(k not in {2, 3} or self.model == "fisheye" for k in self.coefficients)

    def parameters(self, images: int) -> int:
        """Return the number of free parameters, with an attitude for each image."""
        return 3 * images + 1 + 2 * self.principal_point + len(self.coefficients)

    @property
    def label(self) -> str:
        """The model and its free parameters, for the user."""
        kind = "pinhole" if self.model is None else f"{self.model} of {len(self.coefficients)}"
        return kind + (", principal point" if self.principal_point else "")


# From the simplest to the most complicated.
_CANDIDATES = (
    LensCandidate(None, (), principal_point=False),
    LensCandidate(None, (), principal_point=True),
    LensCandidate("plumb_bob", (0,), principal_point=False),
    LensCandidate("plumb_bob", (0,), principal_point=True),
    LensCandidate("plumb_bob", (0, 1), principal_point=False),
    LensCandidate("plumb_bob", (0, 1), principal_point=True),
    LensCandidate("plumb_bob", (0, 1, 4), principal_point=True),
    LensCandidate("plumb_bob", (0, 1, 2, 3), principal_point=True),
    LensCandidate("plumb_bob", (0, 1, 2, 3, 4), principal_point=True),
    LensCandidate("fisheye", (), principal_point=False),
    LensCandidate("fisheye", (), principal_point=True),
    LensCandidate("fisheye", (0,), principal_point=True),
    LensCandidate("fisheye", (0, 1), principal_point=True),
    LensCandidate("fisheye", (0, 1, 2), principal_point=True),
    LensCandidate("fisheye", (0, 1, 2, 3), principal_point=True),
    LensCandidate("rational", (0, 1, 4, 5, 6), principal_point=True),
    LensCandidate("rational", (0, 1, 2, 3, 4, 5, 6, 7), principal_point=True),
)


@dataclass(frozen=True, slots=True)
class _Selection:
    """Thresholds of the choice of a lens."""

    # A more complicated lens must lower the criterion by this much ("very strong" evidence of Kass and Raftery).
    margin: float = 10.0
    # A rational lens is tried if the best of the other lenses uses all parameters of a plumb_bob, including attitude
    # and focal length.
    plumb_bob_parameters: int = 11
    stars_per_parameter: int = 2
    # If no star lies farther out than this fraction of the distance to the corner, a second radial coefficient would
    # extrapolate there.
    corner_fraction: float = 0.8
    # The noise is at least this, px, and found from residuals smoothed by a cubic polynomial if there are enough stars.
    min_noise_px: float = 0.005
    stars_for_polynomial: int = 16
    min_stars: int = 6


_SELECTION = _Selection()


@dataclass(frozen=True, slots=True)
class LensTrial:
    """A lens model that was tried."""

    label: str  # The model and its free parameters
    parameters: int  # Number of free parameters, the attitudes included
    rms_px: float  # Root mean square distance between detected and predicted positions, px
    criterion: float  # Bayes' information criterion; smaller is better


@dataclass(frozen=True, slots=True, eq=False)
class BestLens:
    """The lens that identified stars justify."""

    poses: CameraPoses  # The camera with the lens, and its attitude in each image
    chosen: LensTrial
    candidate: LensCandidate  # The chosen model and its free coefficients
    # Tuple of (LensTrial, model or None): all trials, the simplest first.
    trials: tuple[tuple[LensTrial, LensModel | None], ...]
    sd: dict[str, float]  # Standard errors of the fitted parameters of the camera


def simple_lens(stars: IdentifiedStars, solution: PlateSolution, choice: LensChoice) -> PlateSolution:
    """Return the solution with a lens of few parameters that fits well enough to match more stars.

    `choice` {"auto", "none", "plumb_bob", "rational", "fisheye"}.
    """
    camera = _with_k1_as_lens((stars,), solution.camera, (solution.C_camera_eq,), solution.k1)
    is_fisheye = camera.lens is not None and camera.lens.model == "fisheye"
    model: LensModel = "fisheye" if choice == "fisheye" or is_fisheye else "plumb_bob"
    many: tuple[tuple[int, ...], ...] = ((0, 1, 2, 3), (0, 1, 2)) if model == "fisheye" else ()
    noise_px = scatter_px(stars, solution.camera, solution.C_camera_eq)
    for coefficients, principal_point in (
        *((free, True) for free in many),
        ((0, 1), True),
        ((0,), True),
        ((0,), False),
    ):
        candidate = LensCandidate(model, coefficients, principal_point)
        if candidate.parameters(1) * _SELECTION.stars_per_parameter > len(stars):
            continue
        if len(coefficients) > 1 and stars.corner_fraction(solution.camera) < _SELECTION.corner_fraction:
            continue
        free = FreeParameters((stars,), solution.prior_camera or camera, (noise_px,), coefficients, principal_point)
        trial = _try_candidate(candidate, free, CameraPoses(camera, (solution.C_camera_eq,)))
        if trial is not None:
            poses = trial[0]
            return replace(
                solution,
                camera=poses.camera,
                C_camera_eq=poses.C_camera_eq[0],
                k1=0.0,
                prior_camera=solution.prior_camera or solution.camera,
            )
    return replace(solution, camera=camera, k1=0.0)


def best_lens(stars: tuple[IdentifiedStars, ...], solutions: tuple[PlateSolution, ...], choice: LensChoice) -> BestLens:
    """Return the lens that the stars of one or more images of a camera justify.

    `stars`: one for each image; `solutions`: one for each image; the fit starts from the camera of the first; `choice`
    {"auto", "none", "plumb_bob", "rational", "fisheye"}: the model; with ``"auto"`` any, with ``"none"`` a pinhole.
    Raises CalibrationError if there are too few stars for any lens of that model, or if none fits.
    """
    first, attitudes = solutions[0], tuple(solution.C_camera_eq for solution in solutions)
    camera = _with_k1_as_lens(stars, first.camera, attitudes, first.k1)
    noise_px = tuple(scatter_px(part, camera, C) for part, C in zip(stars, attitudes, strict=True))
    corner_fraction = max(part.corner_fraction(first.camera) for part in stars)
    count = sum(map(len, stars))
    best: BestLens | None = None
    attempted = False
    trials: list[tuple[LensTrial, LensModel | None]] = []
    for candidate in _CANDIDATES:
        parameters = candidate.parameters(len(stars))
        if not _is_allowed(candidate, choice, best, images=len(stars)):
            continue
        if parameters * _SELECTION.stars_per_parameter > count:
            continue
        if candidate.radial > 1 and corner_fraction < _SELECTION.corner_fraction:
            continue
        eligible = choice in {"auto", "none"} or candidate.model == choice
        attempted = attempted or eligible
        free = FreeParameters(
            stars, first.prior_camera or camera, noise_px, candidate.coefficients, candidate.principal_point
        )
        fit = _try_candidate(candidate, free, CameraPoses(camera, attitudes))
        if fit is None:
            continue
        poses, trial, sd = fit
        trials.append((trial, candidate.model))
        if eligible and (best is None or trial.criterion < best.chosen.criterion - _SELECTION.margin):
            best = BestLens(poses, trial, candidate, (), sd)
    if best is None:
        angle_rad = max(part.largest_angle_rad(C) for part, C in zip(stars, attitudes, strict=True))
        raise _no_lens(choice, count, angle_rad, attempted=attempted)
    return replace(best, trials=tuple(trials))


def fit_candidate(
    candidate: LensCandidate, stars: IdentifiedStars, solution: PlateSolution
) -> tuple[Camera, dict[str, float]] | None:
    """Return the camera with one lens model fitted to one image, and its standard errors.

    `solution`: the fit starts from it.
    """
    if candidate.parameters(1) * _SELECTION.stars_per_parameter > len(stars):
        return None
    camera, C_camera_eq = solution.camera, solution.C_camera_eq
    noise_px = scatter_px(stars, camera, C_camera_eq)
    prior = solution.prior_camera or camera
    free = FreeParameters((stars,), prior, (noise_px,), candidate.coefficients, candidate.principal_point)
    trial = _try_candidate(candidate, free, CameraPoses(camera, (C_camera_eq,)))
    return None if trial is None else (trial[0].camera, trial[2])


def _is_allowed(candidate: LensCandidate, choice: LensChoice, best: BestLens | None, *, images: int) -> bool:
    """Return whether a candidate belongs to the choice; pinholes always do, for comparison."""
    if choice == "none":
        return candidate.model is None
    if choice != "auto":
        return candidate.model in {None, choice}
    if candidate.model == "rational":
        # Only if the simpler lenses have used all their parameters.
        most = _SELECTION.plumb_bob_parameters + 3 * (images - 1)
        return best is not None and best.chosen.parameters >= most
    return True


def _no_lens(choice: LensChoice, count: int, angle_rad: float, *, attempted: bool) -> CalibrationError:
    kind = {"auto": "camera", "none": "pinhole"}.get(choice, f"{choice} lens")
    if attempted:
        message = (
            f"no {kind} projects the {count} identified stars, up to {np.rad2deg(angle_rad):.0f} deg off the"
            " optical axis, to one position each; use --lens auto"
        )
    else:
        message = f"{count} identified stars are too few, or too near to the middle, to fit a {kind}"
    needed = max(_SELECTION.min_stars, 4 * _SELECTION.stars_per_parameter)
    return CalibrationError(message, stars_used=count, stars_needed=needed)


def _try_candidate(
    candidate: LensCandidate, free: FreeParameters, start: CameraPoses
) -> tuple[CameraPoses, LensTrial, dict[str, float]] | None:
    """Return the fitted camera and attitudes, the trial and the standard errors; None if the lens is not one-to-one."""
    fit = fit_parameters(free, start, candidate.model)
    if fit is None or not is_one_to_one(fit.state.camera):
        return None
    residual_px = np.concatenate(
        [stars.residual_px(fit.state.camera, C) for stars, C in zip(free.stars, fit.state.C_camera_eq, strict=True)]
    )
    if not np.isfinite(residual_px).all():
        return None
    parameters = fit.slopes.shape[1]
    rms_px = float(np.sqrt((residual_px**2).sum(axis=1).mean()))
    # A star counts as one observation: its errors in x and y (a trail, a neighbour, coma) are correlated.
    count = len(residual_px)
    criterion = count * float(np.log(max(2 * fit.cost, 1e-12) / count)) + parameters * float(np.log(count))
    return fit.state, LensTrial(candidate.label, parameters, rms_px, criterion), standard_errors(fit, free)


def scatter_px(stars: IdentifiedStars, camera: Camera, C_camera_eq: Float) -> float:
    """Return the scatter of the residuals about a smooth polynomial of the position, which no lens reduces.

    `C_camera_eq` is (3, 3).
    """
    residual = np.nan_to_num(stars.residual_px(camera, C_camera_eq))
    if len(residual) < _SELECTION.stars_for_polynomial:
        return max(robust_std(residual), _SELECTION.min_noise_px)
    x, y = ((stars.xy_px - stars.xy_px.mean(axis=0)) / stars.xy_px.std(axis=0)).T
    terms = np.column_stack([x**i * y**j for i in range(4) for j in range(4 - i)])
    for _ in range(3):
        smooth = terms @ np.linalg.lstsq(terms, residual, rcond=None)[0]
        distance = np.linalg.norm(residual - smooth, axis=1)
        near = distance <= 4 * np.median(distance) + 1e-9
        residual, terms = residual[near], terms[near]
    rough = residual - terms @ np.linalg.lstsq(terms, residual, rcond=None)[0]
    return max(robust_std(rough), _SELECTION.min_noise_px)


def _with_k1_as_lens(
    stars: tuple[IdentifiedStars, ...], camera: Camera, attitudes: tuple[Float, ...], k1: float
) -> Camera:
    """Return the camera with the solution's k1 as its lens, if it has no lens and if all stars are in its domain."""
    if not k1 or camera.lens is not None:
        return camera
    with_lens = replace(camera, lens=Lens("plumb_bob", (k1,)))
    for part, C in zip(stars, attitudes, strict=True):
        if not np.isfinite(with_lens.project(part.apparent @ C.T)).all():
            return camera
    return with_lens
