"""The camera from the stars: focal length, principal point and lens, with the attitude, from identified stars.

Stars are points whose directions are known to arcseconds, all over the image: better than any chessboard.  How much of
a lens they tell is for them to say.  Lenses are tried from the simplest on, and a more complicated one is taken only
where Bayes' information criterion is clearly for it; in a narrow view the principal point can hardly be told from the
attitude, and stays where it was given, or in the middle.
"""

from dataclasses import dataclass, replace
from typing import Final, Literal

import numpy as np
from numpy.typing import NDArray

from glstar.calibrate.detect import DetectedStars
from glstar.calibrate.identify import (
    CENTRAL_RADIUS_RAD,
    MIN_STARS,
    Matches,
    PlateSolution,
    ReferenceStars,
    match,
    mutual_nearest,
    offset_probability,
)
from glstar.calibrate.leastsquares import Minimum, minimise, projection_jacobian
from glstar.calibrate.residuals import require_explained
from glstar.calibrate.significance import significant
from glstar.camera.distortion import COEFFICIENTS, Lens, LensModel
from glstar.camera.model import Camera
from glstar.errors import CalibrationError
from glstar.rotation import matrix_from_quaternion, quaternion_from_turn
from glstar.statistics import robust_std

__all__ = ["CameraFit", "LensChoice", "Trial", "fit_camera", "fit_lens", "refine_outwards"]

Float = NDArray[np.float64]
Index = NDArray[np.intp]
LensChoice = Literal["auto", "none", "plumb_bob", "rational", "fisheye"]

# What may be free of a lens, the simplest first: the model, which of its coefficients, and whether the principal point
# is free too.
_TRIALS: Final[tuple[tuple[LensModel | None, tuple[int, ...], bool], ...]] = (
    (None, (), False),
    (None, (), True),
    ("plumb_bob", (0,), False),
    ("plumb_bob", (0,), True),
    ("plumb_bob", (0, 1), False),
    ("plumb_bob", (0, 1), True),
    ("plumb_bob", (0, 1, 4), True),
    ("plumb_bob", (0, 1, 2, 3), True),
    ("plumb_bob", (0, 1, 2, 3, 4), True),
    ("fisheye", (), False),
    ("fisheye", (), True),
    ("fisheye", (0,), True),
    ("fisheye", (0, 1), True),
    ("fisheye", (0, 1, 2), True),
    ("fisheye", (0, 1, 2, 3), True),
    ("rational", (0, 1, 4, 5, 6), True),
    ("rational", (0, 1, 2, 3, 4, 5, 6, 7), True),
)
# By so much the criterion must be better for a more complicated lens: "very strong" in Kass and Raftery's words.
_CLEARLY: Final = 10.0
# A rational lens is tried where a plumb_bob needs all of its numbers.
_MANY: Final = 11
# For each number that is free so many stars.
_STARS_A_NUMBER: Final = 2
# Where stars reach less far than this share of the way to the corner, a second radial term is a guess there.
_FAR_OUT: Final = 0.8
# What is thought of the principal point before: standard deviation from where it was given over the image's width.
_MIDDLE_SD: Final = 0.02
_ROUNDS: Final = 6
_MOST_STEPS: Final = 100
# Stars are matched anew within so many times the distance under which nine of ten lie.
_RADIUS: Final = 3.0
_LEAST_RADIUS_PX: Final = 1.0
_FAINTER_MAG: Final = 0.5
_LEAST_NOISE_PX: Final = 0.005
# From so many times the noise on a star pulls less than its distance would have it.
_SOFT: Final = 2.0
_LEAST_STARS: Final = 6
# With fewer stars no lens is fitted unless somebody asks for one.
_STARS_FOR_A_LENS: Final = 12
# Stars are followed outwards from the middle in steps of so much, and looked for where the lens of those within puts
# them, to this share of the image's width.
_OUTWARDS: Final = 1.2
_OUTER_RADIUS: Final = 0.005
# A lens of so many numbers goes well with stars as far out as this, shares of the way to the corner.
_NUMBERS_BY_SHARE: Final = ((0.0, 1), (0.4, 2), (0.65, 3), (0.9, 4))
# What is thought of a rational lens's denominator before, k4, k5, k6, and the standard deviation of each: above and
# below can do the same, and without this they do it against each other, up to a pole behind the farthest star.
_BELOW: Final = (0.5, 0.0, 0.0)
_BELOW_SD: Final = 0.3
# A lens must be one to one over the image, and so much beyond its corner.
_BEYOND: Final = 1.02


@dataclass(frozen=True, slots=True)
class Trial:
    """One lens that was tried.

    Attributes
    ----------
    words : str
        The model and what was free of it.
    numbers : int
        How many numbers were free, the attitude's three included.
    rms_px : float
        Distance between stars found and predicted.
    criterion : float
        Bayes' information criterion; less is better.
    """

    words: str
    numbers: int
    rms_px: float
    criterion: float


@dataclass(frozen=True, slots=True, eq=False)
class CameraFit:
    """What the stars say of a camera.

    Attributes
    ----------
    matches : Matches
        With the refined solution: its camera has the lens, and no `bend` beside it.
    trials : tuple of Trial
        What was tried, the simplest first.
    chosen : Trial
    pinhole_rms_px : float
        Of the best pinhole; infinite if none sees all the stars.
    sd : dict
        Standard errors of ``fx_px``, ``cx_px``, ``cy_px`` and the coefficients, of those that were free.
    reach_share : float
        How far from the principal point the farthest star is, over the farthest corner, or over the edge of the image
        circle where that is nearer.
    """

    matches: Matches
    trials: tuple[Trial, ...]
    chosen: Trial
    pinhole_rms_px: float
    sd: dict[str, float]
    reach_share: float

    @property
    def camera(self) -> Camera:
        """The camera."""
        return self.matches.solution.camera

    @property
    def words(self) -> str:
        """What a person should know, in a line."""
        lens = "a pinhole" if self.camera.lens is None else str(self.camera.lens)
        pinhole = f"as a pinhole {self.pinhole_rms_px:.3f}" if np.isfinite(self.pinhole_rms_px) else "no pinhole"
        return (
            f"{len(self.matches)} stars say: {lens}, f = {self.camera.fx_px:.2f} ± {self.sd['fx_px']:.2f} px,"
            f" {self.chosen.rms_px:.3f} px rms ({pinhole}); they reach {100 * self.reach_share:.0f} % of the way to the"
            " corners"
        )


def fit_camera(
    detected: DetectedStars, reference: ReferenceStars, matches: Matches, *, lens: LensChoice = "auto"
) -> CameraFit:
    """Return the camera that identified stars say.

    Parameters
    ----------
    detected : DetectedStars
    reference : ReferenceStars
    matches : Matches
        Stars identified as if behind a pinhole, or one with a little bend; more are found where the lens puts them.
    lens : {"auto", "none", "plumb_bob", "rational", "fisheye"}
        The model, or what the stars justify: of all, or of none.

    Returns
    -------
    CameraFit

    Raises
    ------
    CalibrationError
        If there are too few stars for any lens of that model.

    Notes
    -----
    Distances are robust (soft L1), so that a star that is none pulls little.
    """
    apparent = reference.to_camera(np.eye(3))
    pairs, solution = (matches.star, matches.detection), matches.solution
    # Behind some lens or other the stars meet better and better, out to the corners ...
    expected = matches.expected_by_chance
    for _ in range(_ROUNDS):
        solution = _grown(_Stars.of(detected, apparent, solution, *pairs), solution, lens)
        *again, chance = _met(detected, reference, apparent, solution, pairs[0])
        if len(again[0]) < len(pairs[0]) // 2 or np.array_equal(again[0], pairs[0]):
            break
        pairs, expected = (again[0], again[1]), chance
    # ... and then say which, until the same stars match behind the lens that they say.
    best = _best(_Stars.of(detected, apparent, solution, *pairs), solution, lens)
    for _ in range(_ROUNDS):
        *again, chance = _met(detected, reference, apparent, best.solution, pairs[0])
        if len(again[0]) < len(pairs[0]) // 2 or np.array_equal(again, pairs):
            break
        try:
            best = _best(_Stars.of(detected, apparent, best.solution, *again), best.solution, lens)
        except CalibrationError:  # the stars that are left say less: `fit_lens` judges the others' residuals
            break
        pairs, expected = (again[0], again[1]), chance
    stars, solution = _Stars.of(detected, apparent, best.solution, *pairs), best.solution
    predicted, predicted_xy = solution.stars_on_image(reference)
    residual = stars.off_px(solution.camera, solution.C_camera_eq)
    if solution.mirrored:
        residual = residual * [-1.0, 1.0]
    refined = replace(
        matches,
        solution=solution,
        star=pairs[0],
        detection=pairs[1],
        residual_px=residual,
        predicted=predicted,
        predicted_xy_px=predicted_xy,
        expected_by_chance=expected,
        standard_error=best.sd,
    )
    pinhole_rms_px = min((trial.rms_px for trial, model in best.trials if model is None), default=np.inf)
    return CameraFit(
        refined,
        tuple(trial for trial, _ in best.trials),
        best.chosen,
        pinhole_rms_px,
        best.sd,
        stars.reach(solution.camera),
    )


def fit_lens(
    detected: DetectedStars, reference: ReferenceStars, matches: Matches, *, lens: LensChoice = "auto"
) -> Matches:
    """Return the identified stars behind the lens that they justify, or that was asked for, if it explains them.

    Parameters
    ----------
    detected : DetectedStars
    reference : ReferenceStars
    matches : Matches
        As `fit_camera` takes them.
    lens : {"auto", "none", "plumb_bob", "rational", "fisheye"}
        With ``"auto"`` fewer than twelve stars keep the camera that they have.

    Returns
    -------
    Matches
        Its notes say which lens was chosen.

    Raises
    ------
    CalibrationError
        If no such lens explains where the stars are.
    """
    identified = matches
    if lens == "auto" and len(matches) < _STARS_FOR_A_LENS:
        fitted = "a pinhole with radial distortion"
    else:
        fit = fit_camera(detected, reference, matches, lens=lens)
        # A pinhole is what everybody expects: nothing to note.
        noted = lens != "auto" or fit.camera.lens is not None
        matches = replace(fit.matches, notes=(*matches.notes, fit.words) if noted else matches.notes)
        fitted = f"the best of all lens models ({fit.chosen.words})" if lens == "auto" else f"a {lens} lens"
        fitted = "a pinhole" if lens == "none" else fitted
    other = "give an image as the camera took it, neither cropped nor stitched" if lens == "auto" else "use --lens auto"
    require_explained(detected, reference, identified, matches, lens=fitted, advice=other)
    return matches


def refine_outwards(detected: DetectedStars, reference: ReferenceStars, solution: PlateSolution) -> Matches | None:
    """Match and refine from a solution that is right near the middle of the image, and has about the lens.

    Parameters
    ----------
    detected : DetectedStars
    reference : ReferenceStars
    solution : PlateSolution
        Its camera a fisheye, with the focal length and the attitude of the middle.

    Returns
    -------
    Matches or None
        Behind a fisheye that goes with them to the corners; None if fewer than four stars meet on the way there, or
        all may have met by chance.
    """
    camera, apparent = solution.camera, reference.to_camera(np.eye(3))
    assert camera.lens is not None
    solution = replace(solution, prior_camera=solution.prior_camera or camera)
    corner_px = float(np.hypot(camera.width_px, camera.height_px) / 2)
    within_px = camera.fx_px * float(camera.lens.distort([np.tan(CENTRAL_RADIUS_RAD), 0.0])[0])
    radius_px, rounds = _OUTER_RADIUS * camera.width_px, _ROUNDS
    while rounds:
        matches = match(detected, reference, solution, radius_px, within_px=within_px)
        if len(matches) < MIN_STARS or matches.chance >= 1:
            return None
        stars = _Stars.of(detected, apparent, solution, matches.star, matches.detection)
        count = max(count for share, count in _NUMBERS_BY_SHARE if within_px >= share * corner_px)
        count = max(1, min(count, len(stars.xy_px) // _STARS_A_NUMBER - 6))
        noise_px = max(robust_std(matches.residual_px), _LEAST_NOISE_PX)
        fit = _searched(stars, solution, noise_px, "fisheye", tuple(range(count)), middle=True)
        if fit is None:
            return None
        solution = replace(solution, camera=fit.state[0], C_camera_eq=fit.state[1])
        if within_px < corner_px:
            within_px *= _OUTWARDS
        else:
            left_px = np.linalg.norm(stars.off_px(*fit.state), axis=1)
            radius_px = max(min(_RADIUS * float(np.nanquantile(left_px, 0.9)), radius_px), _LEAST_RADIUS_PX)
            rounds -= 1
    return match(detected, reference, solution, radius_px, deep=True)


@dataclass(frozen=True, slots=True, eq=False)
class _Stars:
    """Identified stars: apparent directions (n, 3), true equator and equinox, and places (n, 2), unmirrored."""

    apparent: Float
    xy_px: Float

    @staticmethod
    def of(
        detected: DetectedStars, apparent: Float, solution: PlateSolution, star: Index, detection: Index
    ) -> "_Stars":
        xy = detected.xy_px[detection].copy()
        if solution.mirrored:
            xy[:, 0] = solution.camera.width_px - 1 - xy[:, 0]
        return _Stars(apparent[star], xy)

    def off_px(self, camera: Camera, C_camera_eq: Float) -> Float:
        """Return found minus predicted, (n, 2); NaN where the lens has no place."""
        return self.xy_px - camera.project(self.apparent @ C_camera_eq.T)

    def tangent(self, solution: PlateSolution) -> float:
        """Return how far from the axis the farthest star is, a tangent."""
        direction = self.apparent @ solution.C_camera_eq.T
        return float(np.max(np.hypot(direction[:, 0], direction[:, 1]) / np.maximum(direction[:, 2], 1e-3)))

    def reach(self, camera: Camera) -> float:
        """Return how far out the farthest star is, over the farthest corner or the edge of a fisheye's image circle."""
        centre = np.array([camera.cx_px, camera.cy_px])
        corners = [(x, y) for x in (-0.5, camera.width_px - 0.5) for y in (-0.5, camera.height_px - 0.5)]
        farthest = np.linalg.norm(np.array(corners) - centre, axis=1).max()
        if camera.lens is not None and camera.lens.model == "fisheye":
            # Beyond the image circle there are no stars.
            farthest = np.fmin(
                farthest, camera.fx_px * camera.lens.distort([min(0.999999 * camera.lens.limit, 1e6), 0.0])[0]
            )
        return float(np.linalg.norm(self.xy_px - centre, axis=1).max() / farthest)


@dataclass(frozen=True, slots=True, eq=False)
class _Best:
    solution: PlateSolution
    chosen: Trial
    trials: tuple[tuple[Trial, LensModel | None], ...]
    sd: dict[str, float]


def _grown(stars: _Stars, solution: PlateSolution, choice: LensChoice) -> PlateSolution:
    """Return the solution with a lens of few parameters that fits the stars well enough to match more of them."""
    start = _started(stars, solution)
    is_fisheye = start.camera.lens is not None and start.camera.lens.model == "fisheye"
    model: LensModel = "fisheye" if choice == "fisheye" or is_fisheye else "plumb_bob"
    many: tuple[tuple[int, ...], ...] = ((0, 1, 2, 3), (0, 1, 2)) if model == "fisheye" else ()
    for free, middle in (*((free, True) for free in many), ((0, 1), True), ((0,), True), ((0,), False)):
        if (4 + 2 * middle + len(free)) * _STARS_A_NUMBER > len(stars.xy_px):
            continue
        if len(free) > 1 and stars.reach(solution.camera) < _FAR_OUT:
            continue
        found = _fitted(stars, start, _noise_px(stars, solution), model, free, middle=middle)
        if found is not None:
            return replace(
                solution,
                camera=found[0][0],
                C_camera_eq=found[0][1],
                k1=0.0,
                prior_camera=solution.prior_camera or solution.camera,
            )
    return start


def _best(stars: _Stars, solution: PlateSolution, choice: LensChoice) -> _Best:
    """Return the lens that the stars justify, with all that were tried."""
    start = _started(stars, solution)
    noise_px = _noise_px(stars, start)
    reach = stars.reach(solution.camera)
    best: _Best | None = None
    asked = False
    trials: list[tuple[Trial, LensModel | None]] = []
    for model, free, middle in _TRIALS:
        numbers = 4 + 2 * middle + len(free)
        radial = sum(k not in {2, 3} or model == "fisheye" for k in free)
        if choice == "none" and model is not None:
            continue
        if choice not in {"auto", "none"} and model not in {None, choice}:
            continue
        # The most complicated only where the others are at their end.
        if choice == "auto" and model == "rational" and (best is None or best.chosen.numbers < _MANY):
            continue
        if numbers * _STARS_A_NUMBER > len(stars.xy_px) or (radial > 1 and reach < _FAR_OUT):
            continue
        wanted = choice in {"auto", "none"} or model == choice
        asked = asked or wanted
        found = _fitted(stars, start, noise_px, model, free, middle=middle)
        if found is None:
            continue
        fitted, trial, sd = found
        trials.append((trial, model))
        if not wanted:
            continue
        if best is None or trial.criterion < best.chosen.criterion - _CLEARLY:
            best = _Best(replace(solution, camera=fitted[0], C_camera_eq=fitted[1], k1=0.0), trial, (), sd)
    if best is None:
        kind = {"auto": "camera", "none": "pinhole"}.get(choice, f"{choice} lens")
        count = len(stars.xy_px)
        too_few = f"{count} identified stars are too few, or too near to the middle, to tell a {kind}"
        widest_deg = np.rad2deg(np.arctan(stars.tangent(solution)))
        none_such = (
            f"no {kind} puts the {count} identified stars, up to {widest_deg:.0f} deg off the optical axis, at one"
            " place each; use --lens auto"
        )
        raise CalibrationError(
            none_such if asked else too_few,
            stars_used=len(stars.xy_px),
            stars_needed=max(_LEAST_STARS, 4 * _STARS_A_NUMBER),
        )
    return replace(best, trials=tuple(trials))


def _noise_px(stars: _Stars, solution: PlateSolution) -> float:
    """Return how far off stars typically are when a smooth lens is allowed all it wants: what no lens explains."""
    off = np.nan_to_num(stars.off_px(solution.camera, solution.C_camera_eq))
    if len(off) < 10 + _LEAST_STARS:
        return max(robust_std(off), _LEAST_NOISE_PX)
    x, y = ((stars.xy_px - stars.xy_px.mean(axis=0)) / stars.xy_px.std(axis=0)).T
    terms = np.column_stack([x**i * y**j for i in range(4) for j in range(4 - i)])
    for _ in range(3):
        smooth = terms @ np.linalg.lstsq(terms, off, rcond=None)[0]
        left = np.linalg.norm(off - smooth, axis=1)
        near = left <= 4 * np.median(left) + 1e-9
        off, terms = off[near], terms[near]
    spread = off - terms @ np.linalg.lstsq(terms, off, rcond=None)[0]
    return max(robust_std(spread), _LEAST_NOISE_PX)


def _started(stars: _Stars, solution: PlateSolution) -> PlateSolution:
    """Return the solution with its little bend made a lens, if it has one: where fits start from."""
    if solution.k1 and solution.camera.lens is None:
        lens = Lens("plumb_bob", (solution.k1,))
        if np.isfinite(replace(solution.camera, lens=lens).project(stars.apparent @ solution.C_camera_eq.T)).all():
            return replace(solution, camera=replace(solution.camera, lens=lens), k1=0.0)
    return replace(solution, k1=0.0)


def _fitted(
    stars: _Stars,
    start: PlateSolution,
    noise_px: float,
    model: LensModel | None,
    free: tuple[int, ...],
    *,
    middle: bool,
) -> tuple[tuple[Camera, Float], Trial, dict[str, float]] | None:
    """Return camera and attitude, the trial and standard deviations; None for a lens that is none."""
    fit = _searched(stars, start, noise_px, model, free, middle=middle)
    if fit is None:
        return None
    camera, C_camera_eq = fit.state
    if not _one_to_one(camera):
        return None
    off = stars.off_px(camera, C_camera_eq)
    if not np.isfinite(off).all():
        return None
    numbers = fit.slopes.shape[1]
    rms_px = float(np.sqrt((off**2).sum(axis=1).mean()))
    words = ("pinhole" if model is None else f"{model} of {len(free)}") + (", principal point" if middle else "")
    # A star counts once, not twice: what moves it in x (a trail, a neighbour, coma) moves it in y.
    count_stars = len(off)
    criterion = count_stars * float(np.log(max(2 * fit.cost, 1e-12) / count_stars))
    criterion += numbers * float(np.log(count_stars))
    return (camera, C_camera_eq), Trial(words, numbers, rms_px, criterion), _deviations(fit, camera, free, middle)


def _searched(
    stars: _Stars,
    start: PlateSolution,
    noise_px: float,
    model: LensModel | None,
    free: tuple[int, ...],
    *,
    middle: bool,
) -> Minimum[tuple[Camera, Float]] | None:
    """Return camera and attitude that go best with the stars, whether or not it is a lens; None if there are none."""
    given = start.camera
    before = start.prior_camera or given
    guess = replace(
        given,
        cx_px=given.cx_px if middle else before.cx_px,
        cy_px=given.cy_px if middle else before.cy_px,
        lens=None if model is None else _like(given.lens, model, free, stars.tangent(start)),
    )
    freedom = _Freedom(stars, before, noise_px, free, middle)
    # What is thought before nothing softens.
    before_count = 2 * middle + len(freedom.below)
    scale = np.append(np.full(2 * len(stars.xy_px), _SOFT), np.full(before_count, np.inf))
    try:
        return minimise(
            (guess, start.C_camera_eq), freedom.measured, freedom.moved, scale=scale, most_steps=_MOST_STEPS
        )
    except (ValueError, np.linalg.LinAlgError, CalibrationError):
        return None


def _like(given: Lens | None, model: LensModel, free: tuple[int, ...], tangent: float) -> Lens:
    """Return the lens of a model that goes most like a given one, or a pinhole, as far out as a tangent."""
    r = np.linspace(0.0, tangent, 65)[1:]
    along = np.ones_like(r)
    if given is not None:
        # Decentring goes both ways.
        along = (given.distort(np.outer(r, [1, 0])) - given.distort(np.outer(r, [-1, 0])))[:, 0] / (2 * r)
    coefficients = np.zeros(max(free, default=-1) + 1)
    if model == "fisheye":
        theta = np.arctan(r)
        wanted, terms = along * r / theta - 1, theta[:, np.newaxis] ** np.array([2, 4, 6, 8])
        radial = list(free)
    else:
        if model == "rational":
            below = [k for k in free if k >= 5]
            coefficients[below] = [_BELOW[k - 5] for k in below]
            along = along * (1 + r[:, np.newaxis] ** (2 * np.array(below) - 8) @ coefficients[below])
        wanted, terms = along - 1, r[:, np.newaxis] ** np.array([2, 4, 0, 0, 6])
        radial = [k for k in free if k in {0, 1, 4}]
    seen = np.isfinite(wanted)
    coefficients[radial] = np.linalg.lstsq(terms[seen][:, radial], wanted[seen], rcond=None)[0]
    return Lens(model, tuple(coefficients.tolist()))


@dataclass(frozen=True, slots=True, eq=False)
class _Freedom:
    """What of a camera is free: attitude and focal length, perhaps the principal point, some of the coefficients."""

    stars: _Stars
    first: Camera
    noise_px: float
    free: tuple[int, ...]
    middle: bool

    @property
    def below(self) -> tuple[int, ...]:
        """Which of the free coefficients are a rational lens's denominator."""
        return tuple(k for k in self.free if 5 <= k <= 7)

    def moved(self, state: tuple[Camera, Float], step: Float) -> tuple[Camera, Float]:
        """Return camera and attitude a step away."""
        camera, C_camera_eq = state
        lens = camera.lens
        if lens is not None:
            coefficients = np.array(lens.coefficients)
            coefficients[list(self.free)] += step[4 + 2 * self.middle :]
            lens = Lens(lens.model, tuple(coefficients.tolist()))
        right, down = step[4:6] * camera.width_px if self.middle else (0.0, 0.0)
        longer = float(np.exp(np.clip(step[3], -1.0, 1.0)))
        camera = replace(
            camera,
            fx_px=camera.fx_px * longer,
            fy_px=camera.fy_px * longer,
            cx_px=camera.cx_px + float(right),
            cy_px=camera.cy_px + float(down),
            lens=lens,
        )
        return camera, matrix_from_quaternion(quaternion_from_turn(step[:3])) @ C_camera_eq

    def measured(self, state: tuple[Camera, Float]) -> tuple[Float, Float]:
        """Return how far stars are off, in units of the noise, and the principal point; with their slopes by a step."""
        camera, C_camera_eq = state
        width_px, matrix = camera.width_px, camera.K[:2, :2]
        direction = self.stars.apparent @ C_camera_eq.T
        bent, _, by_turn = projection_jacobian(camera, direction)
        slopes = np.zeros((len(bent), 2, 4 + 2 * self.middle + len(self.free)))
        slopes[:, :, :3] = by_turn
        slopes[:, :, 3] = bent @ matrix.T
        if self.middle:
            slopes[:, :, 4:6] = width_px * np.eye(2)
        if camera.lens is not None and self.free:
            by_coefficient = _by_coefficient(camera.lens, direction[:, :2] / direction[:, 2:])[:, :, list(self.free)]
            slopes[:, :, 4 + 2 * self.middle :] = matrix @ by_coefficient
        off = bent @ matrix.T + (camera.cx_px, camera.cy_px) - self.stars.xy_px
        # Where the lens has no place a star is far off, whatever else moves.
        lost = ~np.isfinite(off).all(axis=1) | ~np.isfinite(slopes).all(axis=(1, 2))
        off[lost], slopes[lost] = width_px, 0.0
        residual = off.ravel() / self.noise_px
        slopes = slopes.reshape(len(residual), -1) / self.noise_px
        thought, sure = np.zeros(0), np.zeros((0, slopes.shape[1]))
        if self.middle:
            aside = np.array([camera.cx_px - self.first.cx_px, camera.cy_px - self.first.cy_px])
            thought = aside / (width_px * _MIDDLE_SD)
            sure = np.eye(2, slopes.shape[1], 4) / _MIDDLE_SD
        for k in self.below:
            assert camera.lens is not None
            thought = np.append(thought, (camera.lens.coefficients[k] - _BELOW[k - 5]) / _BELOW_SD)
            number = 4 + 2 * self.middle + self.free.index(k)
            sure = np.vstack([sure, np.eye(1, slopes.shape[1], number) / _BELOW_SD])
        return np.concatenate([residual, thought]), np.concatenate([slopes, sure])


def _by_coefficient(lens: Lens, plane: Float) -> Float:
    """Return how places behind a lens move with its coefficients, (n, 2, 12), or (n, 2, 4) of a fisheye."""
    x, y = plane.T
    q = x * x + y * y
    if lens.model == "fisheye":
        r = np.maximum(np.sqrt(q), 1e-9)
        powers = np.arctan(r)[:, np.newaxis] ** np.array([3, 5, 7, 9])
        return np.asarray(plane[:, :, np.newaxis] * (powers / r[:, np.newaxis])[:, np.newaxis])
    k1, k2, _, _, k3, k4, k5, k6 = (*lens.coefficients, *(0.0,) * 8)[:8]
    below = 1 + q * (k4 + q * (k5 + q * k6))
    along = (1 + q * (k1 + q * (k2 + q * k3))) / below
    powers = np.column_stack([q, q**2, q**3]) / below[:, np.newaxis]
    outwards = plane[:, :, np.newaxis] * powers[:, np.newaxis]
    inwards = -along[:, np.newaxis, np.newaxis] * outwards
    decentred = np.array([[2 * x * y, q + 2 * x * x], [q + 2 * y * y, 2 * x * y]]).transpose(2, 0, 1)
    none = np.zeros_like(q)
    prism = np.array([[q, q**2, none, none], [none, none, q, q**2]]).transpose(2, 0, 1)
    return np.concatenate([outwards[:, :, :2], decentred, outwards[:, :, 2:], inwards, prism], axis=-1)


def _deviations(
    fit: Minimum[tuple[Camera, Float]], camera: Camera, free: tuple[int, ...], middle: bool
) -> dict[str, float]:
    """Return the standard deviations of what was free."""
    degrees = max(len(fit.residual) - fit.slopes.shape[1], 1)
    covariance = np.linalg.pinv(fit.information) * max(2 * fit.cost / degrees, 1e-12)
    sd = np.sqrt(np.maximum(np.diag(covariance), 0.0))
    named = {"fx_px": float(sd[3] * camera.fx_px)}
    if middle:
        named |= {"cx_px": float(sd[4] * camera.width_px), "cy_px": float(sd[5] * camera.width_px)}
    names = () if camera.lens is None else COEFFICIENTS[camera.lens.model]
    return named | {names[k]: float(sd[4 + 2 * middle + i]) for i, k in enumerate(free)}


def _one_to_one(camera: Camera) -> bool:
    """Return whether every place of the image and a little beyond sees one direction.

    A fisheye that turns back nowhere may leave the corners dark: they lie outside its image circle.
    """
    if camera.lens is None or (camera.lens.model == "fisheye" and np.isinf(camera.lens.limit)):
        return True
    middle = np.array([camera.cx_px, camera.cy_px])
    border = np.array(
        [(x, y) for x in np.linspace(-0.5, camera.width_px - 0.5, 9) for y in (-0.5, camera.height_px - 0.5)]
        + [(x, y) for x in (-0.5, camera.width_px - 0.5) for y in np.linspace(-0.5, camera.height_px - 0.5, 9)]
    )
    return bool(np.isfinite(camera.unproject(middle + _BEYOND * (border - middle))).all())


def _met(
    detected: DetectedStars, reference: ReferenceStars, apparent: Float, solution: PlateSolution, before: Index
) -> tuple[Index, Index, float]:
    """Return predicted and detected stars that match significantly, and how many of them chance may have brought.

    None is much fainter than those before.
    """
    xy = solution.project(apparent @ solution.C_camera_eq.T)
    faintest = reference.stars.vmag[before].max() + _FAINTER_MAG
    on_image = np.flatnonzero(solution.camera.contains(xy) & (reference.stars.vmag <= faintest))
    if not len(on_image):
        return on_image, on_image, 0.0
    detection, distance_px = mutual_nearest(xy[on_image], detected.xy_px, _LEAST_RADIUS_PX)
    known = np.isin(on_image, before)
    known &= np.isfinite(distance_px)
    usual_px = float(np.quantile(distance_px[known], 0.9)) if known.any() else _LEAST_RADIUS_PX
    within_px = max(_RADIUS * min(usual_px, 3 * _LEAST_RADIUS_PX), _LEAST_RADIUS_PX)
    met = distance_px < within_px
    density_per_px2 = len(detected) / (solution.camera.width_px * solution.camera.height_px)
    offset_px = detected.xy_px[detection] - xy[on_image]
    probability = offset_probability(offset_px, met, np.ones(len(met)), density_per_px2, within_px)
    kept = significant(probability)
    return on_image[kept], detection[kept], float((1 - probability[kept]).sum())
