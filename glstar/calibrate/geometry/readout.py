"""The readout time of a rolling shutter from photographs that a turning aircraft took.

While the rows are read the aircraft turns, and each row sees the stars from another attitude: the image is sheared and
stretched, which the attitude and the lens of one photograph cannot imitate.  Least squares over the readout time, the
camera and an attitude for each image.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from glstar.arrays import Float
from glstar.calibrate.geometry.lenschoice import BestLens, LensChoice, best_lens, scatter_px
from glstar.calibrate.geometry.lensfit import require_one_camera
from glstar.calibrate.identify.leastsquares import (
    CameraPoses,
    FreeParameters,
    IdentifiedStars,
)
from glstar.calibrate.identify.matching import refine, without_k1
from glstar.calibrate.identify.platesolution import Matches, PlateSolution, ReferenceStars, is_significant
from glstar.calibrate.identify.rollingshutter import ReadoutTime, RowTurns
from glstar.calibrate.minimise import Minimum, minimise
from glstar.calibrate.photo.detection import DetectedStars
from glstar.camera.model import Camera
from glstar.errors import CalibrationError

# Readout times are searched up to this, s; sensors need 5 to 130 ms.
LONGEST_READOUT_S = 0.25


@dataclass(frozen=True, slots=True)
class _Limits:
    """How the readout time is searched, and when it counts as measured."""

    # Two times of the search differ at the border of the image by this, px, and number at most this on each side.
    step_px: float = 6.0
    most_steps: int = 40
    # ... and are tried with this number of images, those of the fastest turns.
    searched: int = 2
    # Rounds of choosing a lens, fitting and matching, until the readout time changes by less than this part of its
    # standard error.
    rounds: int = 6
    converged: float = 0.1
    most_steps_of_a_fit: int = 50
    # Number of stars of all images that the lens is chosen with.
    stars_of_a_lens: int = 1500
    # Residuals beyond this multiple of the noise have a reduced influence (soft L1 loss).
    soft_noise: float = 2.0
    # Largest standard error of a readout time that is reported, s.
    most_std_s: float = 0.02


_LIMITS = _Limits()


@dataclass(frozen=True, slots=True, eq=False)
class ReadoutFit:
    """The readout time of a rolling shutter, fitted to one or more images."""

    time: ReadoutTime
    reference: tuple[ReferenceStars, ...]  # Of each image, with this readout time
    matches: tuple[Matches, ...]  # The identified stars of each image, matched again with this readout time


@dataclass(frozen=True, slots=True, eq=False)
class _State:
    """The camera with its attitude in each image, and the readout time."""

    poses: CameraPoses
    readout_s: float


def search_readout(
    detected: Sequence[DetectedStars], reference: Sequence[ReferenceStars], identified: Sequence[Matches]
) -> float:
    """Return the readout time with which most stars match, to start a fit from.

    `detected`, `reference`, `identified`: detections, reference stars with the turns of their rows, and identified
    stars of some images; the readout time in `reference` need not be right.  The time, s, is negative if the rows open
    against the given direction, and that of `reference` if no other matches more stars.
    """
    images = [
        (d, r, m, r.rows.rate_rad_per_s(LONGEST_READOUT_S) * m.solution.camera.fx_px)
        for d, r, m in zip(detected, reference, identified, strict=True)
        if r.rows is not None
    ]
    searched = sorted(images, key=lambda image: -image[-1])[: _LIMITS.searched]
    given_s = next(part.rows.readout_s for part in reference if part.rows is not None)
    # Half the readout time passes between the middle row and the border.
    step_s = max(2 * _LIMITS.step_px / max(searched[0][-1], 1e-6), LONGEST_READOUT_S / _LIMITS.most_steps)
    count = int(LONGEST_READOUT_S / step_s)

    def merit(readout_s: float) -> tuple[int, float]:
        matches = [
            matched
            for d, r, m, _ in searched
            if (matched := _matched(d, _with_readout([r], readout_s)[0], m.solution)) is not None
        ]
        return sum(map(len, matches)), -sum(matched.rms_px for matched in matches)

    times_s: list[float] = (np.arange(-count, count + 1) * step_s).tolist()
    return max((given_s, *times_s), key=merit)


def fit_readout(
    names: Sequence[str],
    detected: Sequence[DetectedStars],
    reference: Sequence[ReferenceStars],
    identified: Sequence[Matches],
    *,
    lens: LensChoice = "auto",
) -> ReadoutFit:
    """Fit the readout time of a rolling shutter to one or more images of one camera on a turning aircraft.

    `names`: the images' names, for error messages; `detected`, `reference`, `identified`: detections, reference stars
    with the turns of their rows, and identified stars of each image.  All have a readout time that shifts no star by
    more than 1 % of the image's width (`search_readout`).  `lens` {"auto", "none", "plumb_bob", "rational", "fisheye"}.
    Raises CalibrationError if the aircraft turned too little to measure the readout time, or if the images are not of
    one camera.
    """
    turns = [part.rows for part in reference if part.rows is not None]
    readout_s = turns[0].readout_s
    matches = list(identified)
    for _ in range(_LIMITS.rounds):
        reference = _with_readout(reference, readout_s)
        matches = [_matched_again(*part) for part in zip(detected, reference, matches, strict=True)]
        require_one_camera(names, [found.solution.camera for found in matches])
        stars, solutions = _stars_and_solutions(detected, reference, matches)
        # Some stars suffice to choose the lens, and all are fitted.
        every = -(-sum(map(len, stars)) // _LIMITS.stars_of_a_lens)
        best = best_lens(tuple(part.every(every) for part in stars), solutions, lens)
        fit = _joint_fit(best, solutions, stars, readout_s)
        std_s, before_s = _std_s(fit), readout_s
        if not std_s <= _LIMITS.most_std_s:
            raise _too_little_turn(turns, std_s, sum(map(len, stars)))
        readout_s = float(np.clip(fit.state.readout_s, -LONGEST_READOUT_S, LONGEST_READOUT_S))
        if abs(readout_s - before_s) < _LIMITS.converged * std_s:
            break
    reference = _with_readout(reference, readout_s)
    span_s = max(abs(readout_s), std_s)
    rows = turns[0].with_readout_s(readout_s)
    time = ReadoutTime(
        readout_s=abs(readout_s),
        std_s=std_s,
        direction=rows.direction,
        opposite=rows.direction != rows.readout,
        stars=sum(map(len, stars)),
        images=len(names),
        turn_rad=max(part.rate_rad_per_s(span_s) for part in turns) * abs(readout_s),
    )
    matches = [replace(_matched_again(*part), readout=time) for part in zip(detected, reference, matches, strict=True)]
    return ReadoutFit(time, tuple(reference), tuple(matches))


def _with_readout(reference: Sequence[ReferenceStars], readout_s: float) -> list[ReferenceStars]:
    return [
        replace(part, rows=None if part.rows is None else part.rows.with_readout_s(readout_s)) for part in reference
    ]


def _matched(detected: DetectedStars, reference: ReferenceStars, solution: PlateSolution) -> Matches | None:
    """Return the stars matched with another readout time; None if chance explains them."""
    if solution.camera.lens is None:
        # Principal point and distortion may have made up for a wrong readout time.
        solution = without_k1(solution, solution.prior_camera or solution.camera)
    matches = refine(detected, reference, solution)
    return matches if matches is not None and is_significant(matches) else None


def _matched_again(detected: DetectedStars, reference: ReferenceStars, matches: Matches) -> Matches:
    """Return the stars matched with another readout time; as before if chance explains the new matches."""
    refined = _matched(detected, reference, matches.solution)
    return matches if refined is None else replace(refined, notes=matches.notes)


def _stars_and_solutions(
    detected: Sequence[DetectedStars], reference: Sequence[ReferenceStars], matches: Sequence[Matches]
) -> tuple[tuple[IdentifiedStars, ...], tuple[PlateSolution, ...]]:
    """Return the identified stars of each image, and the solutions, with the camera of the image with most stars."""
    start = max(matches, key=len).solution
    prior = start.prior_camera or start.camera
    solutions = tuple(replace(m.solution, camera=start.camera, k1=start.k1, prior_camera=prior) for m in matches)
    stars = tuple(
        IdentifiedStars.of(d, r.to_camera(np.eye(3)), s, m.star, m.detection, r.rows)
        for d, r, s, m in zip(detected, reference, solutions, matches, strict=True)
    )
    return stars, solutions


def _joint_fit(
    best: BestLens, solutions: Sequence[PlateSolution], stars: tuple[IdentifiedStars, ...], readout_s: float
) -> Minimum[_State]:
    """Return the camera, the attitudes and the readout time that fit the stars best, starting from a readout time.

    Directions change in proportion to the readout time; the caller turns them again.
    """
    noises_px = tuple(
        scatter_px(part, best.poses.camera, C) for part, C in zip(stars, best.poses.C_camera_eq, strict=True)
    )
    prior = solutions[0].prior_camera or solutions[0].camera
    free = FreeParameters(stars, prior, noises_px, best.candidate.coefficients, best.candidate.principal_point)

    def measured(state: _State) -> tuple[Float, Float]:
        moved = tuple(_moved(part, state.readout_s - readout_s) for part in stars)
        residual, slopes = replace(free, stars=moved).residuals(state.poses)
        column = np.concatenate(
            [
                _by_readout(part, state.poses.camera, C) / sd_px
                for part, C, sd_px in zip(moved, state.poses.C_camera_eq, noises_px, strict=True)
            ]
        )
        return residual, np.column_stack([slopes, np.append(column, np.zeros(len(residual) - len(column)))])

    def stepped(state: _State, step: Float) -> _State:
        return _State(free.stepped(state.poses, step[:-1]), state.readout_s + float(step[-1]))

    start = _State(best.poses, readout_s)
    positions = 2 * sum(map(len, stars))
    # Priors keep their full weight.
    scale = np.append(np.full(positions, _LIMITS.soft_noise), np.full(len(measured(start)[0]) - positions, np.inf))
    return minimise(start, measured, stepped, scale=scale, most_steps=_LIMITS.most_steps_of_a_fit)


def _moved(stars: IdentifiedStars, later_s: float) -> IdentifiedStars:
    """Return stars as a longer readout time turns them."""
    assert stars.by_readout is not None
    return replace(stars, apparent=stars.apparent + later_s * stars.by_readout)


def _by_readout(stars: IdentifiedStars, camera: Camera, C_camera_eq: Float) -> Float:
    """Return the derivative of the predicted positions by the readout time, (2 n,) float64, px/s."""
    assert stars.by_readout is not None
    direction, change = stars.apparent @ C_camera_eq.T, stars.by_readout @ C_camera_eq.T
    return np.nan_to_num(camera.project_with_rates(direction, change)[1]).ravel()


def _std_s(fit: Minimum[_State]) -> float:
    """Return the standard error of the readout time, s; infinity if the stars do not depend on it."""
    information = fit.information
    with_others = information[-1, :-1]
    own = information[-1, -1] - with_others @ np.linalg.lstsq(information[:-1, :-1], with_others, rcond=None)[0]
    degrees = max(len(fit.residual) - fit.slopes.shape[1], 1)
    if not own > 1e-9 * information[-1, -1]:
        return float("inf")
    return float(np.sqrt(max(2 * fit.cost / degrees, 1e-12) / own))


def _too_little_turn(turns: Sequence[RowTurns], std_s: float, stars: int) -> CalibrationError:
    rate_deg_per_s = np.rad2deg(max(part.rate_rad_per_s(LONGEST_READOUT_S) for part in turns))
    reached = f"only to {1e3 * std_s:.3g} ms" if np.isfinite(std_s) else "not at all"
    images = f"{len(turns)} images" if len(turns) > 1 else "one image"
    return CalibrationError(
        f"the aircraft turned at up to {rate_deg_per_s:.3g} deg/s while the rows were read: {stars} stars of {images}"
        f" determine the readout time {reached}, and {1e3 * _LIMITS.most_std_s:g} ms are needed; take photographs in a"
        " faster turn, with stars from the first to the last row, or leave --fit-readout out",
        stars_used=stars,
    )
