"""The camera clock's offset, the mount's angles and the readout time, fitted to the trails of real images.

Each trail gives four residuals: shifts along x and y, stretch and turn.  The residuals are linear in a rotation of the
camera (the mount's error), in a delay (the clock's error, larger where the aircraft turns faster) and in a rolling
shutter's readout time (a delay times the number of the row).  Residuals are also linear in each image's attitude error,
a second rotation that may grow during the exposure.  The attitude error dominates the budget, so its size is estimated
with the other parameters; its growth only widens the uncertainty.  Times in whole seconds add a delay of each image,
which is fitted too; the uncertainty includes that the camera may have cut off or rounded all times.  ``python -m
tests.bench.clockoffset`` checks the stated errors.
"""

import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize, minimize_scalar
from scipy.special import gammaincinv, stdtrit

from glstar.arrays import Float
from glstar.camera.model import Mount
from glstar.compare.pairs import Pairing
from glstar.rotation import matrix_from_quaternion, quaternion_from_matrix, quaternion_from_turn, turn_from_quaternion

# The motions: three rotations of the camera, time, and the readout time.
_TURN = slice(0, 3)
_TIME = 3
_READOUT = 4
_SHARED = slice(0, 5)
_MOTIONS = 5
# The errors of each image: three rotations, three that grow during the exposure, and its time.
_OWN = np.array([0, 1, 2, 5, 6, 7, _TIME])
# Prior standard deviations of the motions, rad and s: so wide that they only keep the equations solvable.
_PRIOR = np.array([1.0, 1.0, 1.0, 10.0, 10.0, 1.0, 1.0, 1.0])
_MAX_ITERATIONS = 8
# The fit has converged when each step is below this fraction of the standard error, or below these (rad, s).
_CONVERGED_FRACTION = 0.05
_CONVERGED = np.array([1e-6, 1e-6, 1e-6, 2e-5, 2e-5])
# Iterations of the time of a single image, and delays that are tried if a cross-correlation does not find it.
_OWN_ITERATIONS, _OWN_TRIES = 4, 31
# The times of single images have converged below this step, s.
_CONVERGED_OWN_S = 1e-3
# The smallest standard deviation of the time of an image, s: 0 has no inverse.
_MIN_TIME_STD_S = 1e-7
# The true number less the written one, in units: 0 to 1 if it is cut off, -0.5 to 0.5 if it is rounded.  The middle of
# both, and the largest distance from it.
MIDDLE_GRAINS, MOST_GRAINS = 0.25, 0.75
# Variances, in squared units: of a number within its unit, and of the unknown rule.
_WITHIN_GRAIN, _RULE = 1 / 12, 1 / 16
# A clock offset with a larger standard error is not reported, s.
_MAX_CLOCK_STD_S = 0.05
# The same for times in whole seconds or another unit, in that unit, beside `_MAX_CLOCK_STD_S`.
_MAX_CLOCK_STD_GRAINS = 0.6
# A readout time with a larger standard error is not reported, s: the sensors of the presets take 8 to 87 ms.
_MAX_READOUT_STD_S = 0.02
# Bound of the readout time during the fit, s.
_MAX_READOUT_S = 0.5
# Rows open in the opposite direction if the readout time is below zero by this many standard errors.
_SIGNIFICANT = 3.0
# Trails slower than 20 times the rotation of the sky (rad/s) are those of an aircraft that does not turn.
_SIDEREAL_RATE_RAD_PER_S = 7.292e-5
_MIN_SIDEREAL_RATES = 20.0
# Bounds of the attitude error, rad, and the number of grid points between them where its search starts.
_MIN_ATTITUDE_RAD, _MAX_ATTITUDE_RAD = 1e-7, 0.2
_GRID_POINTS = 13
# An image is excluded if its attitude error is this many times the median one.
_OUTLIER_RATIO = 6.0
# The jackknife needs this many images.
_MIN_JACKKNIFE = 3
# Times in smaller steps, s, are exact.
_EXACT_S = 1e-3
# Probability of a normal deviate below two standard deviations.
_BELOW_TWO_SIGMA = 0.97725


# Finds the trails of an image, by number, with a mount, a delay of the exposures, s, and a readout time, s, negative if
# the rows open in the opposite direction; None outside of the flight.
FindTrails = Callable[[int, Mount, float, float], Pairing | None]


@dataclass(frozen=True, slots=True, eq=False)
class Alignment:
    """A fitted clock offset, mount and readout time.

    A standard error is half of a 95 % interval, so with few images it exceeds the scatter of the fit: by Student's t,
    2.3 times for three images and 1.1 times for twelve.
    """

    mount: Mount  # The fitted mount, or the given one
    # (3,) rotation of the camera from the given mount to the fitted one, about the camera's right, down and forward
    # axes, rad; zeros if the mount was not fitted.
    turn_rad: Float
    turn_std_rad: Float  # (3,) its standard errors, rad
    # Delay of the exposures against the given times on the flight's clock, s: the camera clock's offset is smaller by
    # this.
    delay_s: float
    delay_std_s: float  # Its standard error, s; NaN if the clock was not fitted
    # Readout time of the rolling shutter, s, the fitted or the given one; negative if the rows open in the opposite
    # direction of the given one.
    readout_s: float
    readout_std_s: float  # Its standard error, s; NaN if it was not fitted
    attitude_std_rad: float  # Standard deviation of the flight's attitude error from image to image, per axis, rad
    images: int  # Number of images and stars in the fit
    stars: int
    set_aside: int  # Number of images that were excluded because of their attitude error
    fitted_time: bool
    fitted_mount: bool
    fitted_readout: bool
    # For the user: why a parameter was not fitted, and which errors the uncertainty does not include.
    notes: tuple[str, ...]

    @property
    def mount_keys(self) -> dict[str, float]:
        """The fitted angles of the mount as settings: dotted keys, deg."""
        angles = {"yaw_deg": self.mount.yaw_rad, "pitch_deg": self.mount.pitch_rad, "roll_deg": self.mount.roll_rad}
        return {f"mount.{key}": float(np.rad2deg(angle)) for key, angle in angles.items()}

    @property
    def opens_opposite(self) -> bool:
        """Whether the rows open in the opposite direction of the given one, beyond the error of the fit."""
        return self.fitted_readout and self.readout_s < -_SIGNIFICANT * self.readout_std_s


@dataclass(frozen=True, slots=True, eq=False)
class _State:
    """The parameters of one iteration: the camera's rotation, the delay and the readout time, as in `Alignment`."""

    turn_rad: Float
    delay_s: float
    readout_s: float
    own_s: Float  # (n,) delay of each image beside the common one, s: 0 where times are exact

    def moved(self, motion: Float, own_s: Float, mount: Mount) -> "_State":
        """Return the parameters after a motion, with other delays of the images."""
        readout_s = float(np.clip(self.readout_s + motion[_READOUT], -_MAX_READOUT_S, _MAX_READOUT_S))
        delay_s = self.delay_s + float(motion[_TIME])
        return _State(_added_turn(mount, self.turn_rad, motion[_TURN]), delay_s, readout_s, own_s)


@dataclass(frozen=True, slots=True, eq=False)
class _NormalEquations:
    """The normal equations of one image, normal @ motion = right, its number of stars and the speed of its trails."""

    normal: Float
    right: Float
    stars: int
    speed_rad_per_s: float
    number: int = 0  # of the image
    grain_s: float = 0.0  # unit in which its time was cut off or rounded

    def own_std(self, std_rad: Float) -> Float:
        """Return the standard deviations of the image's own errors, (7,); `std_rad` (2,): of rotation and growth."""
        time_std_s = max(self.grain_s * np.sqrt(_WITHIN_GRAIN), _MIN_TIME_STD_S)
        return np.append(np.repeat(std_rad, 3), time_std_s)


def fit_alignment(
    find_trails: FindTrails,
    count: int,
    mount: Mount,
    *,
    fit_time: bool,
    fit_mount: bool,
    fit_readout: bool = False,
    readout_s: float = 0.0,
    focal_px: float,
    start: tuple[Float, float, float] | None = None,
    grains_s: Sequence[float] = (),
    own_start_s: Sequence[float] = (),
    on_step: Callable[[int, int], None] | None = None,
) -> Alignment | None:
    """Fit clock offset, mount, readout time, or several of them to the trails of real images.

    `find_trails`: returns the trails of one image; `count`: number of images; `mount`: the mount to start from;
    `readout_s`: the configured readout time, s; `focal_px`: focal length, px; `start`: a rotation of the camera (3,),
    rad, a delay, s, and a readout time, s, to start from; `grains_s`: the unit in which the time of each image was cut
    off or rounded, s, 0 for exact ones; `own_start_s`: the delay of each image to start from; `on_step`: called with
    the number of images done, and the largest possible number.  Returns None if no image shows its trails.

    Gauss-Newton; images are rendered again in every iteration.  A robust fit combines the stars of each image.  The
    variances of the attitude error and of its growth follow from restricted maximum likelihood.  The stated
    uncertainty is the larger of the covariance's and the jackknife's, widened by Student's t for few images.
    """
    steps = itertools.count(1)
    report = (lambda: on_step(next(steps), count * _MAX_ITERATIONS)) if on_step else (lambda: None)
    grains = np.array([*grains_s] or [0.0] * count)
    given = _State(np.zeros(3), 0.0, readout_s, np.array([*own_start_s] or [0.0] * count))

    def equations_at(state: _State, free: NDArray[np.bool_]) -> list[_NormalEquations]:
        current = _turned(mount, state.turn_rad) if state.turn_rad.any() else mount
        return _equations_of_images(find_trails, grains, current, state, free, focal_px, report)

    free = np.array([fit_mount] * 3 + [fit_time, fit_readout])
    return _iterated(equations_at, mount, free, given, given if start is None else _State(*start, given.own_s))


def _iterated(
    equations_at: Callable[[_State, NDArray[np.bool_]], list[_NormalEquations]],
    mount: Mount,
    free: NDArray[np.bool_],
    given: _State,
    state: _State,
) -> Alignment | None:
    """Return the result of Gauss-Newton iterations from a start; parameters that are not determined are as given."""
    notes, fit_time = list[str](), bool(free[_TIME])
    for _ in range(_MAX_ITERATIONS):
        equations = equations_at(state, free)
        if not equations:
            return None
        estimate, dropped = _estimated(equations, free)
        if dropped:
            notes += dropped
            delay_s = given.delay_s if fit_time and not free[_TIME] else state.delay_s
            readout_s = state.readout_s if free[_READOUT] else given.readout_s
            state = _State(state.turn_rad, delay_s, readout_s, state.own_s)
        own_s = state.own_s.copy()
        own_s[[image.number for image in equations]] = estimate.own_s
        moved_s = float(np.abs(own_s - state.own_s).max())
        # The motion of a parameter that is not fitted is 0.
        state = state.moved(estimate.motion, own_s, mount)
        small = np.maximum(_CONVERGED_FRACTION * estimate.std, _CONVERGED)
        if not dropped and moved_s <= _CONVERGED_OWN_S and (np.abs(estimate.motion) <= small).all():
            break
    return _alignment(mount, state, estimate, free, equations, notes)


def _equations_of_images(
    find_trails: FindTrails,
    grains_s: Float,
    mount: Mount,
    state: _State,
    free: NDArray[np.bool_],
    focal_px: float,
    report: Callable[[], None],
) -> list[_NormalEquations]:
    """Return the normal equations of all images that show their trails, and report after each image."""
    equations = []
    for number, (grain_s, own_s) in enumerate(zip(grains_s.tolist(), state.own_s.tolist(), strict=True)):
        pairing = find_trails(number, mount, state.delay_s + own_s, state.readout_s)
        report()
        if pairing is not None and pairing.found_indices:
            image = _image_equations(pairing, focal_px, fit_readout=bool(free[_READOUT]))
            # The image's own delay is estimated as a whole, not its change.
            right = image.right + own_s * image.normal[:, _TIME]
            equations.append(replace(image, right=right, number=number, grain_s=grain_s))
    return equations


def _alignment(
    mount: Mount,
    state: _State,
    estimate: "_Estimate",
    free: NDArray[np.bool_],
    equations: Sequence[_NormalEquations],
    notes: list[str],
) -> Alignment:
    """Return the result of the last iteration; NaN as the standard error of a parameter that was not fitted."""
    if len(equations) == 1:
        hidden = "a single image does not reveal its attitude error, so the uncertainty excludes it; use more images"
        notes = [*notes, hidden]
    notes = notes + _grain_notes(equations)
    fitted_mount, fitted_time, fitted_readout = bool(free[0]), bool(free[_TIME]), bool(free[_READOUT])
    return Alignment(
        mount=_turned(mount, state.turn_rad) if fitted_mount else mount,
        turn_rad=state.turn_rad if fitted_mount else np.zeros(3),
        turn_std_rad=estimate.std[_TURN] if fitted_mount else np.full(3, np.nan),
        delay_s=state.delay_s,
        delay_std_s=float(estimate.std[_TIME]) if fitted_time else float("nan"),
        readout_s=state.readout_s,
        readout_std_s=float(estimate.std[_READOUT]) if fitted_readout else float("nan"),
        attitude_std_rad=estimate.attitude_std_rad,
        images=len(equations) - estimate.set_aside,
        stars=sum(image.stars for image in equations),
        set_aside=estimate.set_aside,
        fitted_time=fitted_time,
        fitted_mount=fitted_mount,
        fitted_readout=fitted_readout,
        notes=tuple(notes),
    )


def _estimated(equations: Sequence[_NormalEquations], free: NDArray[np.bool_]) -> tuple["_Estimate", list[str]]:
    """Return the motions, and why clock offset or readout time are not among them; those are no longer `free`."""
    notes = []
    if free[[_TIME, _READOUT]].any() and not _is_turning(equations):
        names = {_TIME: "the clock's offset", _READOUT: "the readout time"}
        notes.append(
            "the aircraft hardly turned during the exposures, so the trails do not determine"
            f" {' or '.join(name for which, name in names.items() if free[which])}; take images from a turn"
        )
        free[[_TIME, _READOUT]] = False
    estimate = _estimate(equations, free)
    if free[_READOUT] and estimate.std[_READOUT] > _MAX_READOUT_STD_S:
        notes.append(
            f"the trails determine the readout time only to {estimate.std[_READOUT]:.2g} s; take images from faster"
            " turns, with stars from the first to the last row"
        )
        free[_READOUT] = False
        estimate = _estimate(equations, free)
    coarsest_s = max(image.grain_s for image in equations)
    if free[_TIME] and estimate.std[_TIME] > _MAX_CLOCK_STD_S + _MAX_CLOCK_STD_GRAINS * coarsest_s:
        notes.append(
            f"the trails determine the clock's offset only to {estimate.std[_TIME]:.2g} s, because the aircraft turned"
            " at the same rate in every image; take images from turns of several rates, or do not fit the mount"
        )
        free[_TIME] = False
        estimate = _estimate(equations, free)
    return estimate, notes


def _turned(mount: Mount, turn_rad: Float) -> Mount:
    """Return a mount with its camera rotated about the camera's axes."""
    C = matrix_from_quaternion(quaternion_from_turn(turn_rad)) @ mount.C_camera_body
    return Mount.from_matrix(C, reading=mount.reading)


def _added_turn(mount: Mount, turn_rad: Float, step_rad: Float) -> Float:
    """Return the rotation vector of a mount's rotation followed by another one, (3,) rad."""
    C = matrix_from_quaternion(quaternion_from_turn(step_rad)) @ _turned(mount, turn_rad).C_camera_body
    return turn_from_quaternion(quaternion_from_matrix(C @ mount.C_camera_body.T))


def _image_equations(pairing: Pairing, focal_px: float, *, fit_readout: bool) -> _NormalEquations:
    """Return the normal equations of one image by a robust fit of its trails."""
    detected = pairing.found_indices
    count = len(detected)
    jacobian = pairing.trails.jacobian[detected].copy()
    if not fit_readout:
        jacobian[..., _READOUT] = 0
    measured, information = np.zeros((count, 4)), np.zeros((count, 4, 4))
    degrees = np.zeros(count, dtype=np.intp)  # of freedom of each trail
    for row, star in enumerate(detected):
        trail = pairing.found[star]
        assert trail is not None
        modes = degrees[row] = 4 if trail.bent else 2
        jacobian[row, modes:] = 0
        measured[row, :modes] = trail.modes[:modes]
        information[row, :modes, :modes] = np.linalg.inv(trail.covariance[:modes, :modes])
    weight = np.ones(count)
    for _ in range(10):
        normal = np.einsum("k,kia,kij,kjb->ab", weight, jacobian, information, jacobian)
        right = np.einsum("k,kia,kij,kj->a", weight, jacobian, information, measured)
        residual = measured - jacobian @ np.linalg.solve(normal + np.diag(_PRIOR**-2), right)
        # Over the median of chi squared: 1 if noise alone causes the residuals.
        ratio = np.einsum("ki,kij,kj->k", residual, information, residual) / (2 * gammaincinv(degrees / 2, 0.5))
        spread = max(1.0, float(np.median(ratio)))
        # Cauchy's weights.
        weight = 1 / (1 + ratio / (6 * spread))
    speed_px = np.linalg.norm(pairing.trails.jacobian[detected, :2, 3], axis=-1)
    return _NormalEquations(normal / spread, right / spread, count, float(np.sqrt(np.mean(speed_px**2))) / focal_px)


def fit_own_delay(
    find: Callable[[float], Pairing | None], start_s: float, focal_px: float, grain_s: float, turn_std_rad: float
) -> tuple[float, Pairing | None]:
    """Return the delay of one image whose time has a unit, s, that fits its trails best, and these trails.

    `find`: finds its trails at a delay; `turn_std_rad`: standard deviation of its attitude error.
    """
    free = [*range(3), _TIME]
    precision = np.diag([*[turn_std_rad**-2] * 3, 1 / (grain_s**2 * (_WITHIN_GRAIN + _RULE))])
    own_s = start_s
    for _ in range(_OWN_ITERATIONS):
        pairing, before_s = find(own_s), own_s
        if pairing is None or not pairing.found_indices:
            break
        image = _image_equations(pairing, focal_px, fit_readout=False)
        right = image.right[free] + own_s * image.normal[free, _TIME]
        motion = np.linalg.solve(image.normal[np.ix_(free, free)] + precision, right)
        own_s = float(np.clip(motion[-1], -MOST_GRAINS * grain_s, MOST_GRAINS * grain_s))
        if abs(own_s - before_s) < _CONVERGED_OWN_S:
            break
    return own_s, pairing


def best_own_delay_s(find: Callable[[float], Pairing | None], grain_s: float) -> float | None:
    """Return the delay of one image, of many within the unit of its time, at which most of its light is found.

    `find`: finds its trails at a delay; None if it is no evidence.  Returns None if there is none at any delay.
    """
    most_s = MOST_GRAINS * grain_s
    found = [(find(tried_s), tried_s) for tried_s in np.linspace(-most_s, most_s, _OWN_TRIES).tolist()]
    evidence = [(pairing.found_signal, tried_s) for pairing, tried_s in found if pairing is not None]
    return max(evidence)[1] if evidence else None


def _is_turning(equations: Sequence[_NormalEquations]) -> bool:
    return max(image.speed_rad_per_s for image in equations) > _MIN_SIDEREAL_RATES * _SIDEREAL_RATE_RAD_PER_S


@dataclass(frozen=True, slots=True, eq=False)
class _Estimate:
    """Fitted motions with their standard errors."""

    motion: Float
    std: Float
    attitude_std_rad: float
    set_aside: int
    own_s: Float  # (n,) delays of the images beside the common one


def _estimate(equations: Sequence[_NormalEquations], free: NDArray[np.bool_]) -> _Estimate:
    """Return the least-squares motions, without the images whose attitude error is an outlier."""
    included = np.ones(len(equations), dtype=np.bool_)
    for _ in range(4):
        selected = [image for image, keep in zip(equations, included, strict=True) if keep]
        # A growing rotation would absorb the clock's error, so it enters the uncertainty only.
        std_rad = np.array([_turn_std_rad(selected, free), _MIN_ATTITUDE_RAD])
        motion = _combined(selected, free, std_rad)[0]
        own = np.array([_own_errors(image, motion, std_rad) for image in equations])
        error_rad = np.linalg.norm(own[:, _TURN], axis=1)
        limit_rad = max(_OUTLIER_RATIO * float(np.median(error_rad[included])) / 1.538, 1e-4)
        within = error_rad <= limit_rad
        if len(selected) < 4 or (within == included).all():
            break
        included = within
    true_std_rad = _attitude_std_rad(selected, free)
    covariance = _covariance(selected, free, std_rad, true_std_rad)
    # Errors that the model lacks and that differ between images show in the jackknife only.
    std = np.maximum(np.sqrt(np.diag(covariance)), _jackknife_std(selected, free, std_rad))
    std = np.hypot(std, _common_grain_std(selected, own[included, -1], free, std_rad))
    return _Estimate(motion, std, float(true_std_rad[0]), int((~included).sum()), own[:, -1])


def _common_grain_std(
    equations: Sequence[_NormalEquations], own_s: Float, free: NDArray[np.bool_], std_rad: Float
) -> Float:
    """Return the standard errors of the motions, (5,), by what the times of all images may have in common.

    They are cut off or rounded; and images at even intervals have the same fraction of a second, which then is no
    random part of each.  `own_s` (n,): the delays of the images beside the common one.
    """
    grains_s = np.array([image.grain_s for image in equations])
    coarse = grains_s > 0
    if not coarse.any():
        return np.zeros(_MOTIONS)
    scatter = float(np.var(own_s[coarse] / grains_s[coarse]))
    shifted = [replace(image, right=image.grain_s * image.normal[:, _TIME]) for image in equations]
    effect = np.abs(_combined(shifted, free, std_rad)[0])
    return np.asarray(effect * np.sqrt(_RULE + max(0.0, _WITHIN_GRAIN - scatter)))


def _grain_notes(equations: Sequence[_NormalEquations]) -> list[str]:
    """Return a remark on times in whole seconds or another unit; none if all are exact to a millisecond."""
    grains_s = [image.grain_s for image in equations if image.grain_s > _EXACT_S]
    if not grains_s:
        return []
    return [
        f"{len(grains_s)} of {len(equations)} images have times in steps of {max(grains_s):g} s; the uncertainty"
        " includes that the camera may cut off or round them: times with fractions of a second determine the clock"
        " better"
    ]


def _covariance(
    equations: Sequence[_NormalEquations], free: NDArray[np.bool_], std_rad: Float, true_std_rad: Float
) -> Float:
    """Return the covariance of the motions, (5, 5), if `std_rad` weights the images and `true_std_rad` is true.

    The prior counts as a measurement: without it, motions that the images do not determine would be exact.
    """
    normal = spread = np.diag(_PRIOR[_SHARED] ** -2)
    for image in equations:
        own = image.normal[np.ix_(_OWN, _OWN)] + np.diag(image.own_std(std_rad) ** -2)
        # The matrix that takes the image's right-hand side to that of the shared motions.
        to_shared = np.eye(_MOTIONS, len(image.right))
        to_shared[:, _OWN] -= np.linalg.solve(own, image.normal[_OWN, _SHARED]).T
        normal = normal + to_shared @ image.normal[:, _SHARED]
        errors = image.normal[:, _OWN] * image.own_std(true_std_rad)
        spread = spread + to_shared @ (image.normal + errors @ errors.T) @ to_shared.T
    block = np.ix_(free, free)
    covariance = np.zeros((_MOTIONS, _MOTIONS))
    if free.any():
        inverse = np.linalg.inv(normal[block])
        covariance[block] = inverse @ spread[block] @ inverse
    return covariance


def _jackknife_std(equations: Sequence[_NormalEquations], free: NDArray[np.bool_], std_rad: Float) -> Float:
    """Return the jackknife's standard errors of the motions, (5,); zeros for too few images."""
    count = len(equations)
    if count < _MIN_JACKKNIFE:
        return np.zeros(_MOTIONS)
    without = np.array([_combined([*equations[:k], *equations[k + 1 :]], free, std_rad)[0] for k in range(count)])
    # Student's t: twice the stated error is a 95 % interval for any number of images.
    few = float(stdtrit(count - 1, _BELOW_TWO_SIGMA)) / 2
    return np.asarray(few * np.sqrt((count - 1) * without.var(axis=0)))


def _own_errors(image: _NormalEquations, motion: Float, std_rad: Float) -> Float:
    """Return the most likely errors of one image, (7,): its rotation and the growth of it, rad, and its delay, s."""
    residual = (image.right - image.normal[:, _SHARED] @ motion)[_OWN]
    own = image.normal[np.ix_(_OWN, _OWN)] + np.diag(image.own_std(std_rad) ** -2)
    return np.asarray(np.linalg.solve(own, residual))


def _combined(
    equations: Sequence[_NormalEquations], free: NDArray[np.bool_], std_rad: Float
) -> tuple[Float, Float, float]:
    """Return the motions, their covariance, and minus twice the log of the restricted likelihood.

    The errors of each image are marginalized; `std_rad`, (2,), has the standard deviations of its rotation and of
    the growth during the exposure.
    """
    normals, rights = np.stack([image.normal for image in equations]), np.stack([image.right for image in equations])
    precisions = np.stack([image.own_std(std_rad) for image in equations]) ** -2.0
    own = normals[:, _OWN[:, np.newaxis], _OWN] + precisions[:, np.newaxis] * np.eye(len(_OWN))
    across = normals[:, _SHARED][:, :, _OWN]
    columns = np.concatenate([np.swapaxes(across, 1, 2), rights[:, _OWN, np.newaxis]], axis=2)
    solved = np.linalg.solve(own, columns)
    normal = np.diag(_PRIOR[_SHARED] ** -2)
    normal = normal + (normals[:, _SHARED, _SHARED] - across @ solved[..., :_MOTIONS]).sum(axis=0)
    right = (rights[:, _SHARED] - (across @ solved[..., _MOTIONS:])[..., 0]).sum(axis=0)
    log_loss = float(np.linalg.slogdet(own)[1].sum()) + 6 * len(equations) * float(np.log(std_rad).sum())
    log_loss -= float(np.sum(rights[:, _OWN] * solved[..., _MOTIONS]))
    block = np.ix_(free, free)
    covariance, motion = np.zeros((_MOTIONS, _MOTIONS)), np.zeros(_MOTIONS)
    if free.any():
        covariance[block] = np.linalg.inv(normal[block])
        motion[free] = covariance[block] @ right[free]
        log_loss += float(np.linalg.slogdet(normal[block])[1]) - float(right[free] @ motion[free])
    return motion, covariance, log_loss


def _turn_std_rad(equations: Sequence[_NormalEquations], free: NDArray[np.bool_]) -> float:
    """Return the standard deviation of an attitude error that is constant within an exposure, rad."""
    best = minimize_scalar(
        lambda log_std: _combined(equations, free, np.array([np.exp(log_std), _MIN_ATTITUDE_RAD]))[2],
        bounds=(np.log(_MIN_ATTITUDE_RAD), np.log(_MAX_ATTITUDE_RAD)),
        method="bounded",
        options={"xatol": 0.01},
    )
    return float(np.exp(best.x))


def _attitude_std_rad(equations: Sequence[_NormalEquations], free: NDArray[np.bool_]) -> Float:
    """Return the standard deviations of the attitude error and of its growth over an exposure, (2,) rad."""
    low, high = np.log([_MIN_ATTITUDE_RAD, _MAX_ATTITUDE_RAD])

    def log_loss(log_std: Float) -> float:
        return _combined(equations, free, np.exp(log_std))[2]

    # The likelihood has several minima, because growing rotations partly replace constant ones.
    sizes = np.linspace(low, high, _GRID_POINTS)
    start = min(itertools.product(sizes, sizes), key=lambda pair: log_loss(np.array(pair)))
    options = {"xatol": 0.02, "fatol": 1e-3, "maxfev": 80}
    best = minimize(log_loss, start, method="Nelder-Mead", bounds=[(low, high)] * 2, options=options)
    return np.asarray(np.exp(best.x))
