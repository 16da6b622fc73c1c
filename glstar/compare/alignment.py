"""The camera clock's offset and the mount's angles, found from the trails of real images.

Every star of every image tells how far its trail is from where it was predicted, how much longer it is and how it is
turned.  All of it jacobian, linearly for small errors, to the mount's error (a turn of the camera, the same in every
image), to the clock's (a shift along the path, faster where the aircraft turns faster) and to the attitude's own error
(another turn in every image, which grows or shrinks while the shutter is open: an error of the heading turns with the
aircraft, a log of few samples cuts corners).  The last is what limits the others: how large it is, and how much it
grows, is estimated along with them.  The growth counts in the uncertainty: without it a clock read from how trails are
stretched would be many times too sure of itself.
"""

import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize, minimize_scalar
from scipy.stats import chi2
from scipy.stats import t as student

from glstar.camera.exposure import Exposure
from glstar.camera.model import Mount
from glstar.compare.backgroundsubtraction import SubtractedImage
from glstar.compare.pairs import CrossCorrelation, Pairing, coarse_side, shrunk
from glstar.render.simulator import Simulator
from glstar.rotation import matrix_from_quaternion, quaternion_from_matrix, quaternion_from_turn, turn_from_quaternion

__all__ = ["Alignment", "fit_alignment", "likely_start"]

Float = NDArray[np.float64]

# Of the motions: three turns of the camera, and time.
_TURN: Final = slice(0, 3)
_TIME: Final = 3
_SHARED: Final = slice(0, 4)
# What each image has for itself, its attitude's error: three turns, and three that grow during the exposure.
_OWN: Final = np.array([0, 1, 2, 4, 5, 6])
# What is thought of them before anything is seen, rad and s: so much that it does not count.
_PRIOR: Final = np.array([1.0, 1.0, 1.0, 10.0, 1.0, 1.0, 1.0])
_MOST_ROUNDS: Final = 8
# Done when a round moves nothing by more than this share of its uncertainty, or by this.
_STILL_SHARE: Final = 0.05
_STILL: Final = np.array([1e-6, 1e-6, 1e-6, 2e-5])
# A clock's offset that is not known better than this, s, is not known.
_USEFUL_S: Final = 0.05
# Trails that go no faster than so many times the sky itself are those of an aircraft that stands still.
_SKY_RAD_PER_S: Final = 7.292e-5
_STILL_SKIES: Final = 20.0
# The attitude's error is sought between these, rad.
_LEAST_ATTITUDE_RAD, _MOST_ATTITUDE_RAD = 1e-7, 0.2
# ... first at so many sizes.
_TRIED_SIZES: Final = 13
# An image whose attitude is so many times as wrong as the usual one has no say.
_ASTRAY: Final = 6.0
# From so many images on they tell by themselves how far they disagree.
_LEAST_JACKKNIFE: Final = 3
# The share of a normal distribution below two standard deviations.
_WITHIN_TWO: Final = 0.97725
# The coarse search looks at so many images, made so small, with so many moments each, at offsets so far
# apart, s, and so many either way.
_COARSE_SIDE_PX: Final = 192
_COARSE_IMAGES: Final = 6
_COARSE_MOMENTS: Final = 24
_COARSE_STEP_S: Final = 0.0125
_MOST_COARSE_OFFSETS: Final = 200
_COARSE_STARS: Final = 150

# Looks for the trails of one image, with a mount, so much later (s); None where it cannot.
FindTrails = Callable[[int, Mount, float], Pairing | None]


@dataclass(frozen=True, slots=True, eq=False)
class Alignment:
    """What makes the trails agree.

    Attributes
    ----------
    mount : Mount
        As fitted, or as it was.
    turn_rad : (3,) float64
        By how much the camera is turned from where the mount was thought to be, about its own right, down and forward
        axes, rad; zeros where the mount was not fitted.
    turn_std_rad : (3,) float64
    delay_s : float
        By how much later, by the flight's clock, the exposures were than was thought, s: the camera clock's offset is
        smaller by this.
    delay_std_s : float
        NaN where it was not fitted.
    attitude_std_rad : float
        How wrong the flight's attitude is from image to image, about each axis, rad, as the trails tell.
    images, stars : int
        What it rests on.
    set_aside : int
        How many images were set aside, for their attitude is too wrong.
    fitted_time, fitted_mount : bool
    notes : tuple of str
        What a reader should know: why something was not fitted, what the uncertainty leaves out.
    """

    mount: Mount
    turn_rad: Float
    turn_std_rad: Float
    delay_s: float
    delay_std_s: float
    attitude_std_rad: float
    images: int
    stars: int
    set_aside: int
    fitted_time: bool
    fitted_mount: bool
    notes: tuple[str, ...]


@dataclass(frozen=True, slots=True, eq=False)
class _NormalEquations:
    """What one image tells of the motions: the normal matrix and right side of its least squares, and its speed."""

    normal: Float
    right: Float
    stars: int
    speed_rad_per_s: float


def fit_alignment(
    look: FindTrails,
    count: int,
    mount: Mount,
    *,
    fit_time: bool,
    fit_mount: bool,
    focal_px: float,
    start: tuple[Float, float] | None = None,
    on_step: Callable[[int, int], None] | None = None,
) -> Alignment | None:
    """Return the clock's offset, the mount, or both, that make trails agree.

    Parameters
    ----------
    look : callable
        Finds the trails of one image, by its number, with a mount, so much later (s).
    count : int
        How many images there are.
    mount : Mount
        As it is thought to be.
    fit_time, fit_mount : bool
        What to find.
    focal_px : float
        Focal length, px.
    start : ((3,) float64, float), optional
        Where to begin: a turn of the camera (rad) and how much later (s).
    on_step : callable
        Called with how many images have been looked at, and how many may be at most.

    Returns
    -------
    Alignment or None
        None where no image shows its trails.

    Notes
    -----
    Gauss-Newton with new renderings in every round.  In each image a robust fit gives what its stars tell together;
    over the images the attitude's own error, a turn and its growth during the exposure, counts as noise whose sizes are
    found by restricted maximum likelihood.  The uncertainty is that of the covariance or of the jackknife over the
    images, widened where they are few, whichever is larger: ``python -m tests.bench.clockoffset`` checks it.
    """
    tell = on_step or (lambda *_: None)
    turn_rad, delay_s = (np.zeros(3), 0.0) if start is None else start
    C_first = mount.C_camera_body
    notes: list[str] = []
    done = 0
    wanted = np.array([fit_mount] * 3 + [fit_time])
    for _ in range(_MOST_ROUNDS):
        now = replace(mount) if not turn_rad.any() else _turned(C_first, turn_rad, mount)
        equations = []
        for number in range(count):
            pairing = look(number, now, delay_s)
            done += 1
            tell(done, count * _MOST_ROUNDS)
            if pairing is not None and pairing.found_indices:
                equations.append(_image_equations(pairing, focal_px))
        if not equations:
            return None
        if wanted[_TIME] and not _moving(equations):
            notes.append(
                "the aircraft hardly turned while the shutter was open, so that no trail tells when it was; take images"
                " from a turn"
            )
            wanted[_TIME], delay_s = False, 0.0
        answer = _answer(equations, wanted)
        std = answer.std
        if wanted[_TIME] and std[_TIME] > _USEFUL_S:
            notes.append(
                f"the trails tell the clock's offset to {std[_TIME]:.2g} s only, for the aircraft turned alike in every"
                " image; take images from turns of several rates, or do not fit the mount"
            )
            wanted[_TIME], delay_s = False, 0.0
            answer = _answer(equations, wanted)
            std = answer.std
        if not wanted.any():
            break
        delay_s += float(answer.motion[_TIME])
        C = (
            matrix_from_quaternion(quaternion_from_turn(answer.motion[_TURN]))
            @ _turned(C_first, turn_rad, mount).C_camera_body
        )
        turn_rad = turn_from_quaternion(quaternion_from_matrix(C @ C_first.T))
        if (np.abs(answer.motion) <= np.maximum(_STILL_SHARE * std, _STILL)).all():
            break
    if len(equations) == 1:
        notes.append("one image cannot tell how wrong its attitude is, and the uncertainty leaves that out; take more")
    return Alignment(
        mount=_turned(C_first, turn_rad, mount) if wanted[0] else mount,
        turn_rad=turn_rad if wanted[0] else np.zeros(3),
        turn_std_rad=std[_TURN] if wanted[0] else np.full(3, np.nan),
        delay_s=delay_s,
        delay_std_s=float(std[_TIME]) if wanted[_TIME] else float("nan"),
        attitude_std_rad=answer.attitude_std_rad,
        images=len(equations) - answer.set_aside,
        stars=sum(one.stars for one in equations),
        set_aside=answer.set_aside,
        fitted_time=bool(wanted[_TIME]),
        fitted_mount=bool(wanted[0]),
        notes=tuple(notes),
    )


def _turned(C_camera_body: Float, turn_rad: Float, mount: Mount) -> Mount:
    """Return a mount turned about the camera's axes, its angles read as those of another one."""
    C = matrix_from_quaternion(quaternion_from_turn(turn_rad)) @ C_camera_body
    return Mount.from_matrix(C, reading=mount.reading)


def _image_equations(pairing: Pairing, focal_px: float) -> _NormalEquations:
    """Return what one image's trails tell together; those that do not go with the others count for less."""
    there = pairing.found_indices
    P, y, W = pairing.trails.jacobian[there].copy(), np.zeros((len(there), 4)), np.zeros((len(there), 4, 4))
    dof = np.zeros(len(there), dtype=np.intp)
    for n, k in enumerate(there):
        trail = pairing.found[k]
        assert trail is not None
        m = dof[n] = 4 if trail.bent else 2
        P[n, m:] = 0
        y[n, :m] = trail.modes[:m]
        W[n, :m, :m] = np.linalg.inv(trail.covariance[:m, :m])
    weight = np.ones(len(y))
    for _ in range(10):
        N = np.einsum("k,kia,kij,kjb->ab", weight, P, W, P)
        g = np.einsum("k,kia,kij,kj->a", weight, P, W, y)
        left = y - P @ np.linalg.solve(N + np.diag(_PRIOR**-2), g)
        # As many times as noise alone would leave.
        ratio = np.einsum("ki,kij,kj->k", left, W, left) / chi2.median(dof)
        spread = max(1.0, float(np.median(ratio)))
        # Cauchy's weights.
        weight = 1 / (1 + ratio / (6 * spread))
    speed_px = np.linalg.norm(pairing.trails.jacobian[pairing.found_indices, :2, 3], axis=-1)
    return _NormalEquations(N / spread, g / spread, len(y), float(np.sqrt(np.mean(speed_px**2))) / focal_px)


def _moving(equations: Sequence[_NormalEquations]) -> bool:
    return max(one.speed_rad_per_s for one in equations) > _STILL_SKIES * _SKY_RAD_PER_S


@dataclass(frozen=True, slots=True, eq=False)
class _Answer:
    motion: Float
    std: Float
    attitude_std_rad: float
    set_aside: int


def _answer(equations: Sequence[_NormalEquations], wanted: NDArray[np.bool_]) -> _Answer:
    """Return the motions that all images agree on, images of a wrong attitude set aside."""
    kept = np.ones(len(equations), dtype=np.bool_)
    for _ in range(4):
        some = [one for one, keep in zip(equations, kept, strict=True) if keep]
        # A growing turn would take up what the clock's own error leaves: it widens the uncertainty alone.
        std_rad = np.array([_turn_std_rad(some, wanted), _LEAST_ATTITUDE_RAD])
        motion = _combined(some, wanted, std_rad)[0]
        off_rad = np.array([np.linalg.norm(_own_turn(one, motion, std_rad)) for one in equations])
        limit_rad = max(_ASTRAY * float(np.median(off_rad[kept])) / 1.538, 1e-4)
        still = off_rad <= limit_rad
        if len(some) < 4 or (still == kept).all():
            break
        kept = still
    true_std_rad = _attitude_std_rad(some, wanted)
    covariance = _covariance(some, wanted, std_rad, true_std_rad)
    # What else goes wrong, and not alike in all, shows only in how the images disagree.
    std = np.maximum(np.sqrt(np.diag(covariance)), _jackknife_std(some, wanted, std_rad))
    return _Answer(motion, std, float(true_std_rad[0]), int((~kept).sum()))


def _covariance(
    equations: Sequence[_NormalEquations], wanted: NDArray[np.bool_], std_rad: Float, true_std_rad: Float
) -> Float:
    """Return the motions' covariance, (4, 4), where they are combined with `std_rad` and `true_std_rad` is true."""
    N, V = np.diag(_PRIOR[_SHARED] ** -2), np.zeros((4, 4))
    for one in equations:
        own = one.normal[np.ix_(_OWN, _OWN)] + np.diag(np.repeat(std_rad**-2, 3))
        # What the image's right side is multiplied by on its way into the motions' one.
        K = np.eye(4, len(one.right))
        K[:, _OWN] -= np.linalg.solve(own, one.normal[_OWN, _SHARED]).T
        N = N + K @ one.normal[:, _SHARED]
        true = one.normal[:, _OWN] * np.repeat(true_std_rad, 3)
        V = V + K @ (one.normal + true @ true.T) @ K.T
    free = np.ix_(wanted, wanted)
    covariance = np.zeros((4, 4))
    if wanted.any():
        inverse = np.linalg.inv(N[free])
        covariance[free] = inverse @ V[free] @ inverse
    return covariance


def _jackknife_std(equations: Sequence[_NormalEquations], wanted: NDArray[np.bool_], std_rad: Float) -> Float:
    """Return how uncertain the motions are, (4,), by what each image changes when it is left out; 0 for too few."""
    count = len(equations)
    if count < _LEAST_JACKKNIFE:
        return np.zeros(4)
    without = np.array([_combined([*equations[:k], *equations[k + 1 :]], wanted, std_rad)[0] for k in range(count)])
    # Few images tell their own scatter badly: twice the deviation shall hold for 95 %, by Student's t.
    few = float(student.ppf(_WITHIN_TWO, count - 1)) / 2
    return np.asarray(few * np.sqrt((count - 1) * without.var(axis=0)))


def _own_turn(one: _NormalEquations, motion: Float, std_rad: Float) -> Float:
    """Return the attitude's error in one image, (3,) rad, as it is most likely."""
    left = (one.right - one.normal[:, _SHARED] @ motion)[_OWN]
    own = one.normal[np.ix_(_OWN, _OWN)] + np.diag(np.repeat(std_rad**-2, 3))
    return np.asarray(np.linalg.solve(own, left)[_TURN])


def _combined(
    equations: Sequence[_NormalEquations], wanted: NDArray[np.bool_], std_rad: Float
) -> tuple[Float, Float, float]:
    """Return the motions, their covariance, and minus twice the log of the restricted likelihood.

    The attitude's error of each image is integrated out; `std_rad`, (2,), is that of its turn and of how much it grows
    during the exposure.
    """
    normal, right = np.stack([one.normal for one in equations]), np.stack([one.right for one in equations])
    own = normal[:, _OWN[:, np.newaxis], _OWN] + np.diag(np.repeat(std_rad**-2, 3))
    across = normal[:, _SHARED][:, :, _OWN]
    seen = np.concatenate([np.swapaxes(across, 1, 2), right[:, _OWN, np.newaxis]], axis=2)
    solved = np.linalg.solve(own, seen)
    N = np.diag(_PRIOR[_SHARED] ** -2) + (normal[:, _SHARED, _SHARED] - across @ solved[..., :4]).sum(axis=0)
    g = (right[:, _SHARED] - (across @ solved[..., 4:])[..., 0]).sum(axis=0)
    unlikely = float(np.linalg.slogdet(own)[1].sum()) + 6 * len(equations) * float(np.log(std_rad).sum())
    unlikely -= float(np.sum(right[:, _OWN] * solved[..., 4]))
    free = np.ix_(wanted, wanted)
    covariance, motion = np.zeros((4, 4)), np.zeros(4)
    if wanted.any():
        covariance[free] = np.linalg.inv(N[free])
        motion[wanted] = covariance[free] @ g[wanted]
        unlikely += float(np.linalg.slogdet(N[free])[1]) - float(g[wanted] @ motion[wanted])
    return motion, covariance, unlikely


def _turn_std_rad(equations: Sequence[_NormalEquations], wanted: NDArray[np.bool_]) -> float:
    """Return how wrong the attitude is from image to image, rad, if it does not change within an exposure."""
    best = minimize_scalar(
        lambda log_std: _combined(equations, wanted, np.array([np.exp(log_std), _LEAST_ATTITUDE_RAD]))[2],
        bounds=(np.log(_LEAST_ATTITUDE_RAD), np.log(_MOST_ATTITUDE_RAD)),
        method="bounded",
        options={"xatol": 0.01},
    )
    return float(np.exp(best.x))


def _attitude_std_rad(equations: Sequence[_NormalEquations], wanted: NDArray[np.bool_]) -> Float:
    """Return how wrong the attitude is from image to image, and by how much more at an exposure's end, (2,) rad."""
    low, high = np.log([_LEAST_ATTITUDE_RAD, _MOST_ATTITUDE_RAD])

    def unlikely(log_std: Float) -> float:
        return _combined(equations, wanted, np.exp(log_std))[2]

    # More than one valley: what the turns do not explain, growing ones may.
    sizes = np.linspace(low, high, _TRIED_SIZES)
    start = min(itertools.product(sizes, sizes), key=lambda pair: unlikely(np.array(pair)))
    options = {"xatol": 0.02, "fatol": 1e-3, "maxfev": 80}
    best = minimize(unlikely, start, method="Nelder-Mead", bounds=[(low, high)] * 2, options=options)
    return np.asarray(np.exp(best.x))


def likely_start(
    skies: Sequence[tuple[Exposure, SubtractedImage]],
    simulator: Simulator,
    *,
    search_px: float,
    search_s: float,
    on_step: Callable[[int, int], None] | None = None,
) -> tuple[Float, float]:
    """Return about how far off the mount and the clock are: where the trails of some images overlap best.

    Parameters
    ----------
    skies : sequence of (Exposure, SubtractedImage)
        Images; some six of them are looked at.
    simulator : Simulator
    search_px : float
        How far the images may be shifted, all alike, px.
    search_s : float
        How far the exposures may be off, s either way; 0 looks at no other time.
    on_step : callable
        Called with how many offsets of how many have been tried.

    Returns
    -------
    turn_rad : (3,) float64
        A turn of the camera about its right, down and forward axes.
    delay_s : float
    """
    tell = on_step or (lambda *_: None)
    chosen = [skies[k] for k in np.unique(np.linspace(0, len(skies) - 1, _COARSE_IMAGES).astype(int))]
    side = coarse_side(chosen[0][1].above_dn.shape, _COARSE_SIDE_PX)
    sigma_px = simulator.sensor.drawn_sigma_px
    seen = [CrossCorrelation(shrunk(sky.significance(sigma_px), side), search_px / side) for _, sky in chosen]
    each_way = min(int(np.ceil(search_s / _COARSE_STEP_S)), _MOST_COARSE_OFFSETS)
    offsets = np.linspace(-search_s, search_s, 2 * each_way + 1).tolist() if each_way else [0.0]
    track = simulator.flight.attitude
    best = -np.inf, np.zeros(2), 0.0
    for number, delay_s in enumerate(offsets):
        total: NDArray[np.float32] | None = None
        for (exposure, sky), likeness in zip(chosen, seen, strict=True):
            moved = replace(exposure, start_utc_s=exposure.start_utc_s + delay_s)
            if moved.start_utc_s < track.first_s or moved.stop_utc_s > track.last_s:
                continue
            here = likeness.to(_density(simulator, moved, sky, side))
            total = here if total is None else total + here
        tell(number + 1, len(offsets))
        if total is not None and total.max() > best[0]:
            best = float(total.max()), seen[0].best(total) * side, delay_s
    # A turn about the axes across moves the image's middle; that about the boresight the stars will tell.
    _, (x_px, y_px), delay_s = best
    camera = simulator.camera
    return np.array([y_px / camera.fy_px, -x_px / camera.fx_px, 0.0]), delay_s


def _density(simulator: Simulator, exposure: Exposure, sky: SubtractedImage, side: int) -> NDArray[np.float32]:
    """Return the light of the brightest stars along their paths, in times the noise, on a coarse grid."""
    sensor, camera = simulator.sensor, simulator.camera
    pointing = simulator.pointing(exposure.sub_utc_s(_COARSE_MOMENTS))
    middle = pointing.boresight_eq[len(pointing) // 2]
    within = np.flatnonzero(simulator.stars.direction_eq @ middle > np.cos(min(camera.reach_rad * 1.3, np.pi)))
    within = within[np.argsort(simulator.stars.camera_mag[within], kind="stable")][:_COARSE_STARS]
    xy = camera.project(pointing.to_camera(simulator.stars.direction_eq[within])) / side
    flux = sensor.flux_dn(sensor.peak_dn(simulator.stars.camera_mag[within], exposure.duration_s)) / _COARSE_MOMENTS
    on_image = np.isfinite(xy).all(axis=-1)
    y_px, x_px = xy[..., 1][on_image], xy[..., 0][on_image]
    edges = [np.arange(length // side + 1) - 0.5 for length in sky.above_dn.shape]
    weights = np.broadcast_to(flux, xy.shape[:2])[on_image]
    light = np.histogram2d(y_px, x_px, bins=edges, weights=weights)[0].astype(np.float32)
    sigma = max(sensor.drawn_sigma_px / side, 0.8)
    smooth = cv2.GaussianBlur(light, (0, 0), float(np.hypot(sigma, sensor.drawn_sigma_px / side)))
    return np.asarray(
        smooth * (2 * np.sqrt(np.pi) * sensor.drawn_sigma_px / (side**2 * sky.usual_noise_dn)), np.float32
    )
