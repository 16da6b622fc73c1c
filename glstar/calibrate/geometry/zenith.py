"""The zenith of a photograph without time or site, from the refraction that moves its stars.

Refraction lifts stars towards the zenith, the more the lower they are: it makes the sky flatter by up to a thousandth
30 deg above the horizon, which no lens does.  Lens and zenith are fitted in turn.
"""

from dataclasses import dataclass, replace
from typing import Self

import numpy as np

from glstar.arrays import Float
from glstar.calibrate.geometry.lenschoice import LensCandidate, best_lens, scatter_px
from glstar.calibrate.geometry.lensfit import fit_camera
from glstar.calibrate.identify.leastsquares import CameraPoses, FreeParameters, IdentifiedStars, fit_parameters
from glstar.calibrate.identify.platesolution import Matches, PlateSolution, ReferenceStars
from glstar.calibrate.minimise import Minimum, minimise
from glstar.calibrate.photo.detection import DetectedStars
from glstar.errors import CalibrationError
from glstar.sky.air.refraction import refraction_displacement

# With fewer identified stars the zenith is not sought.
_LEAST_STARS = 30
# Altitudes of the optical axis and directions of the zenith on the image that are tried first, deg.
_ALTITUDES_DEG = (5.0, 8.0, 12.0, 16.0, 20.0, 25.0, 30.0, 37.0, 45.0, 53.0, 62.0, 72.0, 83.0)
_DIRECTIONS_DEG = tuple(range(0, 360, 20))
# Lens and zenith are fitted in turn at most this often.
_ROUNDS = 4
# The zenith must lower Bayes' information criterion by this much, against none and against one at the opposite side.
_MARGIN = 2.0
# A zenith that is known no better than this is not used, rad.
_LARGEST_ERROR_RAD = np.deg2rad(12.0)
# Fraction of the stars that may be below the horizon of the zenith found: false matches.
_FALSE_FRACTION = 0.02
# If the stars prefer this fraction of the air, the camera was not on the ground and the zenith is not where it seems.
_THINNER = (0.25, 0.05)
# Only stars near the horizon show thin air: sine of the altitude.
_LOW = 0.35
_STEP_RAD = 0.01
# Refraction is differentiated by the zenith over this angle.
_NUDGE_RAD = 1e-5


@dataclass(frozen=True, slots=True, eq=False)
class _Trial:
    """A zenith with its lens and Bayes' information criterion."""

    criterion: float
    zenith_eq: Float
    candidate: LensCandidate


@dataclass(frozen=True, eq=False)
class _RefractedStars:
    """Identified stars of one image, whose refraction depends on the zenith."""

    direction_eq: Float  # (k, 3)
    xy_px: Float  # (k, 2)
    solution: PlateSolution
    refraction_scale: float
    noise_px: float  # The scatter of the stars; refraction hardly changes it
    plain_candidate: LensCandidate  # The lens that the stars justify without refraction

    @classmethod
    def of(cls, identified: IdentifiedStars, solution: PlateSolution, refraction_scale: float) -> Self:
        """Return stars that were identified with a plate solution."""
        noise_px = scatter_px(identified, solution.camera, solution.C_camera_eq)
        plain = best_lens((identified,), (solution,), "auto").candidate
        return cls(identified.apparent, identified.xy_px, solution, refraction_scale, noise_px, plain)

    def at(self, zenith_eq: Float | None) -> IdentifiedStars:
        """Return the stars with the refraction of a zenith, or without refraction."""
        if zenith_eq is None:
            return IdentifiedStars(self.direction_eq, self.xy_px)
        lifted = refraction_displacement(self.direction_eq @ zenith_eq, self.refraction_scale)
        return IdentifiedStars(self.direction_eq + lifted[:, np.newaxis] * zenith_eq, self.xy_px)

    def best_candidate(self, zenith_eq: Float) -> LensCandidate:
        """Return the lens that the stars justify with a zenith."""
        return best_lens((self.at(zenith_eq),), (self.solution,), "auto").candidate

    def fit(self, zenith_eq: Float | None, candidate: LensCandidate) -> Minimum[CameraPoses] | None:
        """Return the best camera with a zenith; None if there is none."""
        start = CameraPoses(self.solution.camera, (self.solution.C_camera_eq,))
        return fit_parameters(self._free(zenith_eq, candidate), start, candidate.model)

    def _free(self, zenith_eq: Float | None, candidate: LensCandidate) -> FreeParameters:
        """Return the parameters of the camera that are fitted with a zenith."""
        prior = self.solution.prior_camera or self.solution.camera
        return FreeParameters(
            (self.at(zenith_eq),), prior, (self.noise_px,), candidate.coefficients, candidate.principal_point
        )

    def cost(self, zenith_eq: Float | None, candidate: LensCandidate) -> float:
        """Return the robust sum of squares of the best camera, over the noise; infinite if there is none."""
        fit = self.fit(zenith_eq, candidate)
        return np.inf if fit is None else 2 * fit.cost

    def criterion(self, zenith_eq: Float | None, candidate: LensCandidate) -> float:
        """Return Bayes' information criterion; a star counts as one observation, as in `best_lens`."""
        count, parameters = len(self.xy_px), candidate.parameters(1) + 2 * (zenith_eq is not None)
        return float(count * np.log(max(self.cost(zenith_eq, candidate), 1e-12) / count) + parameters * np.log(count))

    def zenith_eq(self, altitude_rad: float, direction_rad: float) -> Float:
        """Return the zenith by the altitude of the optical axis and by its direction on the image, from the top."""
        up = np.array([np.sin(direction_rad), -np.cos(direction_rad), 0.0])
        in_camera = np.array([0.0, 0.0, np.sin(altitude_rad)]) + np.cos(altitude_rad) * up
        return np.asarray(in_camera @ self.solution.C_camera_eq)

    def improved(self, place_rad: Float, candidate: LensCandidate) -> Float:
        """Return altitude and direction of least cost near others, rad: they are fitted together with the camera."""
        fit = self.fit(self.zenith_eq(*place_rad), candidate)
        if fit is None:
            return place_rad

        def measured(state: tuple[CameraPoses, Float]) -> tuple[Float, Float]:
            poses, place = state
            free = self._free(self.zenith_eq(*place), candidate)
            residual, slopes = free.residuals(poses)
            by_place = np.zeros((len(residual), 2))
            by_place[: self.xy_px.size] = self._by_place(poses, place) / self.noise_px
            return residual, np.column_stack([slopes, by_place])

        def moved(state: tuple[CameraPoses, Float], step: Float) -> tuple[CameraPoses, Float]:
            poses, place = state
            return self._free(None, candidate).stepped(poses, step[:-2]), place + step[-2:]

        try:
            return minimise((fit.state, place_rad), measured, moved, scale=fit.scale).state[1]
        except (ValueError, np.linalg.LinAlgError, CalibrationError):
            return place_rad

    def _by_place(self, poses: CameraPoses, place_rad: Float) -> Float:
        """Return the derivatives of the stars' x, y by altitude and direction of the zenith, px/rad, (2 k, 2)."""
        [C_camera_eq] = poses.C_camera_eq
        apparent, *nudged = (
            self.at(self.zenith_eq(*place)).apparent for place in place_rad + _NUDGE_RAD * np.eye(3, 2, -1)
        )
        rates = (np.stack(nudged) - apparent) / _NUDGE_RAD
        by_place = poses.camera.project_with_rates(apparent @ C_camera_eq.T, rates @ C_camera_eq.T)[1]
        return np.nan_to_num(by_place).reshape(2, -1).T

    def first_place(self, candidate: LensCandidate) -> Float:
        """Return the best of many altitudes and directions, rad, for a camera that answers refraction linearly."""
        fit = self.fit(None, candidate)
        if fit is None:
            raise CalibrationError("no camera fits the stars", stars_used=len(self.xy_px))
        camera, [C_camera_eq] = fit.state.camera, fit.state.C_camera_eq
        weight = 1 / np.sqrt(fit.root)
        absorbed = np.linalg.qr(fit.slopes * weight[:, np.newaxis])[0]
        unmoved_px = camera.project(self.direction_eq @ C_camera_eq.T)

        def cost(place: Float) -> float:
            moved_px = camera.project(self.at(self.zenith_eq(*place)).apparent @ C_camera_eq.T) - unmoved_px
            residual = fit.residual.copy()
            residual[: moved_px.size] += np.nan_to_num(moved_px).ravel() / self.noise_px
            residual *= weight
            residual -= absorbed @ (absorbed.T @ residual)
            return float(residual @ residual)

        places = np.deg2rad([(up, along) for up in _ALTITUDES_DEG for along in _DIRECTIONS_DEG])
        return np.asarray(min(places, key=cost))

    def error_rad(self, zenith_eq: Float, candidate: LensCandidate) -> float:
        """Return the standard error of a zenith in its worst direction, rad; infinite if the cost has no minimum."""
        across = np.linalg.svd(zenith_eq[np.newaxis])[2][1:]
        steps = _STEP_RAD * np.array([(1, 1), (1, -1), (-1, 1), (-1, -1), (1, 0), (-1, 0), (0, 1), (0, -1), (0, 0)])
        values = []
        for step in steps:
            tilted = zenith_eq + step @ across
            values.append(self.cost(tilted / np.linalg.norm(tilted), candidate))
        both = (values[0] - values[1] - values[2] + values[3]) / 4
        one, other = values[4] + values[5] - 2 * values[8], values[6] + values[7] - 2 * values[8]
        # Half the second derivatives of the sum of squares are the information of the zenith.
        least = float(np.linalg.eigvalsh(np.array([[one, both], [both, other]]) / (2 * _STEP_RAD**2))[0])
        return float(np.sqrt(values[8] / len(self.xy_px) / least)) if least > 0 else np.inf


def find_zenith(
    detected: DetectedStars, reference: ReferenceStars, matches: Matches, *, refraction_scale: float
) -> ReferenceStars:
    """Return the reference stars with the zenith that the refraction of a photograph shows, if it shows one.

    `matches`: identified stars; `refraction_scale`: the result of `glstar.sky.air.refraction.refraction_scale` for the
    air; 0 for no refraction.  The stars are unchanged if they have a zenith already, or if there are fewer than 30
    stars.  They are also unchanged if Bayes' information criterion prefers a lens without refraction or much thinner
    air, or does not distinguish the zenith from one on the opposite side of the image.  The refraction is that of
    Teague & Chahl, eq. (25).
    """
    if not refraction_scale or reference.zenith_eq.any() or reference.rows is not None or len(matches) < _LEAST_STARS:
        return reference
    try:
        fitted = fit_camera(detected, reference, matches).matches
        identified = IdentifiedStars.of(
            detected, reference.to_camera(np.eye(3)), fitted.solution, fitted.star, fitted.detection
        )
        return _with_zenith(_RefractedStars.of(identified, fitted.solution, refraction_scale), reference)
    except CalibrationError:  # there is no camera yet: the fit of the lens says so
        return reference


def _with_zenith(stars: _RefractedStars, reference: ReferenceStars) -> ReferenceStars:
    best, other = _best_zeniths(stars)
    others = min(other.criterion, stars.criterion(None, stars.plain_candidate))
    error_rad = stars.error_rad(best.zenith_eq, best.candidate)
    below = float(np.mean(stars.direction_eq @ best.zenith_eq < 0))
    if best.criterion > others - _MARGIN or not error_rad < _LARGEST_ERROR_RAD or below > _FALSE_FRACTION:
        return reference
    lowest = float(np.min(stars.direction_eq @ best.zenith_eq))
    for thinner in _THINNER if lowest < _LOW else ():
        # The amount of air is one parameter more.
        in_thin_air = _best_zeniths(replace(stars, refraction_scale=thinner * stars.refraction_scale))[0]
        if in_thin_air.criterion + np.log(len(stars.xy_px)) < best.criterion - _MARGIN:
            return reference
    return replace(
        reference, zenith_eq=best.zenith_eq, refraction_scale=stars.refraction_scale, zenith_error_rad=error_rad
    )


def _best_zeniths(stars: _RefractedStars) -> tuple[_Trial, _Trial]:
    """Return the best zenith, and the best on the other side of the image: to first order both refract alike."""
    candidate = stars.plain_candidate
    first = stars.first_place(candidate)
    for _ in range(_ROUNDS):
        places = [stars.improved(place, candidate) for place in (first, first + np.array([0.0, np.pi]))]
        zeniths = [stars.zenith_eq(*place) for place in places]
        trials = [_Trial(stars.criterion(zenith_eq, candidate), zenith_eq, candidate) for zenith_eq in zeniths]
        best, other = sorted(trials, key=lambda trial: trial.criterion)
        first = places[trials.index(best)]
        candidate = stars.best_candidate(best.zenith_eq)
        if candidate == best.candidate:
            break
    return best, other
