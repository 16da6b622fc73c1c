"""Pairing of simulated trails with the trails of a real image, and their differences: eqs (44)-(46) and more."""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.fft import irfft2, next_fast_len, rfft2

from glstar.arrays import Float
from glstar.compare.detection import SubtractedImage
from glstar.compare.prediction import Stamp, Trails, moved_path, stamp_of
from glstar.compare.trailfit import FoundTrail, find_trail

# The common shift is searched for on images binned to at most this size, px.
_COARSE_SIDE_PX = 512
# Signals are clipped at this many standard deviations of the noise, so that one planet does not dominate.
_MAX_SIGNAL = 6.0
# Search windows around predicted positions, px.  The first one grows with the distance from the centre by a roll of
# 0.012 rad; the second one follows the motion that the first search found.
_FIRST_WINDOW_PX = 4.0
_MAX_ROLL_RAD = 0.012
_SECOND_WINDOW_PX = 3.0
# A trail is an outlier beyond this many times the scatter, and this many px, from the common motion.
_OUTLIER_SCATTERS = 6.0
_OUTLIER_PX = 1.0
# Median of the distance from the middle of a Gaussian in two dimensions, in standard deviations per axis.
_RAYLEIGH_MEDIAN = 1.1774
# Relative damping of motions that the stars do not determine.
_DAMPING = 1e-9


@dataclass(frozen=True, slots=True, eq=False)
class Cutouts:
    """Cutouts of one pair, DN above the background."""

    real: NDArray[np.float32]  # (h, w)
    simulated: NDArray[np.float32]  # (h, w)


@dataclass(frozen=True, slots=True, eq=False)
class Pairing:
    """The result of a search for trails in one real image."""

    trails: Trails  # The predicted trails
    found: tuple[FoundTrail | None, ...]  # one for each predicted trail; None if it was not found, or is an outlier
    astray: int  # trails that were found but are outliers of the common motion
    motion: Float  # (m,) the small motion of the camera that fits the trails; see `Trails.jacobian`
    # Standard deviation, per axis, of the trails that were found about that motion, px; NaN if none was.
    scatter_px: float = np.nan

    @property
    def found_indices(self) -> list[int]:
        """Indices of the trails that were found."""
        return [k for k, trail in enumerate(self.found) if trail is not None]

    @property
    def found_signal(self) -> float:
        """The part of the predicted signal that was found: squared signal-to-noise ratios, 0 to 1."""
        squares = self.trails.signal_to_noise**2
        return float(squares[self.found_indices].sum() / max(squares.sum(), 1e-300))


@dataclass(frozen=True, slots=True)
class Pair:
    """One star on one real image and on its simulated counterpart.

    Differences are simulated minus real.
    """

    image: str  # The real image's name
    catalogue: str  # The catalogue that numbers the star; empty if it is unknown
    star_id: int  # Its number there; 0 if the star is unknown
    name: str
    vmag: float
    x_px: float  # middle of the simulated trail
    y_px: float
    signal_to_noise: float  # simulated trail over the noise of the real image
    # Peak intensities above the background by the fit of the whole trail, DN. The real one is the peak that the star's
    # flux would have along the simulated path.
    peak_real_dn: float
    peak_simulated_dn: float
    pixel_real_dn: float  # The brightest pixels above the background, as in the paper, DN; noise included
    pixel_simulated_dn: float
    saturated: bool  # Whether the real or the simulated trail has saturated pixels
    centroid_px: float  # L of eq. (46) in a common region of interest: distance of the centroids in the image, px
    # L of eq. (46), each in the smallest region of interest of its own trail, as in the paper: the distribution of the
    # flux along the trail, px.
    shape_px: float
    # The same for a straight line of constant brightness, whose centroid is the centre of its region, px.
    baseline_px: float
    noise_px: float  # Standard deviation of the real centroid due to noise, px
    # Shift of the trail by the fit; the standard deviation is that of the better determined direction.
    shift_x_px: float
    shift_y_px: float
    shift_std_px: float
    length_px: float  # Length of the simulated trail, px
    # NaN for a trail too short to have them; directions are positive clockwise on the image.
    length_difference_px: float
    direction_difference_rad: float

    @property
    def beyond_noise_px(self) -> float:
        """Centroid distance minus twice its standard deviation, px."""
        return self.centroid_px - 2 * self.noise_px


class CrossCorrelation:
    """Cross-correlation of a real image with simulated ones, over small shifts.

    `significance` (h, w) float32: the real image in units of its noise; `most_px`: the largest shift, px.
    """

    def __init__(self, significance: NDArray[np.float32], most_px: float) -> None:
        reach = max(1, int(np.ceil(most_px)))
        self._size = tuple(next_fast_len(length + reach, real=True) for length in significance.shape)
        self._real = self._transformed(np.clip(significance, -1.0, _MAX_SIGNAL))
        self._shifts = np.arange(-reach, reach + 1)
        self._far = np.hypot(*np.meshgrid(self._shifts, self._shifts)) > most_px + 0.5

    def _transformed(self, image: NDArray[np.float32]) -> NDArray[np.complex64]:
        return np.asarray(rfft2(image - image.mean(), self._size))

    def to(self, density: NDArray[np.float32]) -> NDArray[np.float32]:
        """Return the cross-correlation with a simulated image.

        `density` (h, w): in units of the real image's noise.  Returns (2 r + 1, 2 r + 1) values, for shifts of the real
        image by -r to r px down (rows) and to the right (columns); -inf beyond the largest shift.
        """
        expected = np.clip(density, 0.0, _MAX_SIGNAL)
        product = np.conj(self._transformed(expected)) * self._real
        likeness = irfft2(product, self._size) / max(float(np.linalg.norm(expected)), 1e-9)
        near = likeness[np.ix_(self._shifts, self._shifts)]
        near[self._far] = -np.inf
        return np.asarray(near)

    def best(self, likeness: NDArray[np.float32]) -> Float:
        """Return the shift of the largest correlation, (x, y), px."""
        row, column = np.unravel_index(int(np.argmax(likeness)), likeness.shape)
        return np.array([self._shifts[column], self._shifts[row]], dtype=np.float64)


def shrunk(image: NDArray[np.float32], side: int) -> NDArray[np.float32]:
    """Return the means of blocks of side x side pixels; incomplete blocks at the right and bottom are dropped."""
    height, width = image.shape[0] // side * side, image.shape[1] // side * side
    size = width // side, height // side
    return np.asarray(cv2.resize(image[:height, :width], size, interpolation=cv2.INTER_AREA), dtype=np.float32)


def coarse_side(shape: tuple[int, ...], most: int) -> int:
    """Return the bin size, px, that makes an image of this shape at most `most` px wide and high."""
    return max(1, -(-max(shape) // most))


def pair_trails(sky: SubtractedImage, trails: Trails, *, search_px: float, expected_px: Float | None = None) -> Pairing:
    """Find the trails of a simulated image in a real one.

    `search_px`: the largest shift of the whole image, px; `expected_px` (k, 2): expected shift of each trail, to 1 or 2
    px; if it is given, the common shift is not searched for.

    Four steps: the common shift by cross-correlation, each trail near its shifted position, the motion of the camera
    that most trails agree on, and each trail near its position by that motion.
    """
    if not len(trails):
        return Pairing(trails, (), 0, np.zeros(3))
    if expected_px is None:
        motion, agrees = _common_motion(trails, _first_detections(sky, trails, search_px))
        if not agrees.any():
            return Pairing(trails, (None,) * len(trails), 0, motion)
        expected_px = trails.jacobian[:, :2, :3] @ motion
    detections = _detections(sky, trails, expected_px, np.full(len(trails), _SECOND_WINDOW_PX), bend=True)
    motion, agrees = _common_motion(trails, detections)
    outliers = sum(trail is not None and not agrees[k] for k, trail in enumerate(detections))
    kept = tuple(trail if agrees[k] else None for k, trail in enumerate(detections))
    return Pairing(trails, kept, outliers, motion, _scatter_px(trails, kept, motion))


def _scatter_px(trails: Trails, found: Sequence[FoundTrail | None], motion: Float) -> float:
    """Return the standard deviation per axis of trails about a motion of the camera, px; NaN without trails."""
    distance_px = [
        np.linalg.norm(trail.modes[:2] - turn @ motion)
        for turn, trail in zip(trails.jacobian[:, :2, :3], found, strict=True)
        if trail is not None
    ]
    return float(np.median(distance_px)) / _RAYLEIGH_MEDIAN if distance_px else np.nan


def _first_detections(sky: SubtractedImage, trails: Trails, search_px: float) -> list[FoundTrail | None]:
    """Find the trails near the shift of the largest cross-correlation."""
    shape = sky.above_dn.shape
    side = coarse_side(shape, _COARSE_SIDE_PX)
    likeness = CrossCorrelation(shrunk(sky.significance(trails.sigma_px), side), search_px / side)
    smooth = cv2.GaussianBlur(trails.signal_dn / sky.noise_dn, (0, 0), trails.sigma_px)
    density = shrunk(smooth, side) * np.float32(2 * np.sqrt(np.pi) * trails.sigma_px)
    shift_px = likeness.best(likeness.to(density)) * side
    middle = trails.path_px.mean(axis=0)
    from_centre_px = np.linalg.norm(middle - np.array(shape[::-1]) / 2, axis=-1)
    windows_px = _FIRST_WINDOW_PX + side + _MAX_ROLL_RAD * from_centre_px
    return _detections(sky, trails, np.tile(shift_px, (len(trails), 1)), windows_px, bend=False)


def _detections(
    sky: SubtractedImage, trails: Trails, expected_px: Float, windows_px: Float, *, bend: bool
) -> list[FoundTrail | None]:
    elongated = trails.elongated & bend
    return [
        find_trail(
            sky,
            trails.signal_dn,
            trails.path_px[:, k],
            trails.half_width_px,
            expected_px=expected_px[k],
            window_px=float(windows_px[k]),
            bends=bool(elongated[k]),
        )
        for k in range(len(trails))
    ]


def _common_motion(trails: Trails, found: Sequence[FoundTrail | None]) -> tuple[Float, NDArray[np.bool_]]:
    """Return the rotation of the camera that most of the trails agree on, and a mask of those that do."""
    turns = trails.jacobian[:, :2, :3]
    detected = np.array([trail is not None for trail in found])
    if not detected.any():
        return np.zeros(turns.shape[-1]), detected
    jacobian = turns[detected]
    shift_px = np.array([trail.modes[:2] for trail in found if trail is not None])
    std_px = np.array([_spread_px(trail) for trail in found if trail is not None])
    scale = np.abs(jacobian).max(axis=(0, 1)) + 1e-300
    scaled = jacobian / scale
    weight = np.ones(len(shift_px))
    for _ in range(12):
        information = weight / std_px**2
        normal = np.einsum("k,kip,kiq->pq", information, scaled, scaled)
        # A single star does not determine a rotation about itself; the damping selects the smallest motion.
        normal += np.diag(np.full(len(normal), _DAMPING * max(np.trace(normal), 1e-300)))
        motion = np.linalg.solve(normal, np.einsum("k,kip,ki->p", information, scaled, shift_px)) / scale
        residual_px = np.linalg.norm(shift_px - jacobian @ motion, axis=-1)
        spread_px = float(np.median(residual_px)) / _RAYLEIGH_MEDIAN
        limit_px = max(_OUTLIER_SCATTERS * spread_px, _OUTLIER_PX)
        # Tukey's biweight: wrongly identified stars have no weight.
        weight = np.clip(1 - (residual_px / (1.5 * limit_px + 3 * std_px)) ** 2, 0, None) ** 2 + 1e-9
    agrees = detected.copy()
    agrees[detected] = residual_px <= limit_px + 3 * std_px
    return motion, agrees


def _spread_px(trail: FoundTrail) -> float:
    return float(np.sqrt(np.linalg.eigvalsh(trail.covariance[:2, :2])[-1])) + 0.02


@dataclass(frozen=True, slots=True, eq=False)
class Measures:
    """Measurements of one real image."""

    pairs: tuple[Pair, ...]
    pictures: tuple[Cutouts, ...]  # one for each pair


def measure(image: str, sky: SubtractedImage, pairing: Pairing) -> Measures:
    """Return the paper's measurements of every trail that was found.

    `image`: the real image's name.  Teague & Chahl, section 3, eqs (44)-(46), with three departures from eq. (44).  The
    background is subtracted because it pulls every centroid to the centre of the region.  Pixels outside of the trail's
    aperture are excluded.  The centre of a region is computed from the centres of its pixels, to a fraction of a pixel.
    """
    pairs, pictures = [], []
    for k in pairing.found_indices:
        found = pairing.found[k]
        assert found is not None
        pair, picture = _measured(image, sky, pairing.trails, k, found)
        pairs.append(pair)
        pictures.append(picture)
    return Measures(tuple(pairs), tuple(pictures))


def _measured(image: str, sky: SubtractedImage, trails: Trails, k: int, found: FoundTrail) -> tuple[Pair, Cutouts]:
    path = trails.path_px[:, k]
    moved = moved_path(path, found.modes)
    stamp = stamp_of(path, trails.half_width_px)
    real_stamp = _clipped(stamp_of(moved, trails.half_width_px), sky.above_dn.shape)
    simulated = np.where(stamp.mask, stamp.of(trails.signal_dn), 0).astype(np.float64).clip(max=trails.headroom_dn)
    real = np.where(real_stamp.mask, real_stamp.of(sky.above_dn) - found.sky_dn, 0).astype(np.float64)
    centroid_simulated, _ = _centroid(simulated, stamp, 0.0)
    noise_dn = float(real_stamp.of(sky.noise_dn).mean())
    centroid_real, noise_px = _centroid(real, real_stamp, noise_dn)
    middle_simulated, middle_real = _middle(path), _middle(moved)
    shape = (centroid_simulated - middle_simulated) - (centroid_real - middle_real)
    length_px = float(trails.length_px[k])
    modes, covariance = found.modes, found.covariance
    peak_dn = float(simulated.max())
    saturated = found.saturated or peak_dn >= trails.headroom_dn
    middle = path.mean(axis=0)
    pair = Pair(
        image=image,
        catalogue=trails.catalogue,
        star_id=int(trails.star_id[k]),
        name=trails.name[k],
        vmag=float(trails.vmag[k]),
        x_px=float(middle[0]),
        y_px=float(middle[1]),
        signal_to_noise=float(trails.signal_to_noise[k]),
        # The flux of the real trail over the simulated length: a longer trail is fainter per pixel.
        peak_real_dn=found.brightness * (1 + float(modes[2])) * peak_dn,
        peak_simulated_dn=peak_dn,
        pixel_real_dn=float(real.max()),
        pixel_simulated_dn=float(np.where(stamp.mask, stamp.of(trails.pixels_dn), -np.inf).max()),
        saturated=saturated,
        centroid_px=float(np.linalg.norm(centroid_simulated - centroid_real)),
        shape_px=float(np.linalg.norm(shape)),
        baseline_px=float(np.linalg.norm(centroid_real - middle_real)),
        noise_px=noise_px,
        shift_x_px=-float(modes[0]),
        shift_y_px=-float(modes[1]),
        shift_std_px=float(np.sqrt(np.linalg.eigvalsh(covariance[:2, :2])[0])),
        length_px=length_px,
        length_difference_px=-float(modes[2]) * length_px if found.bent else float("nan"),
        direction_difference_rad=-float(modes[3]) if found.bent else float("nan"),
    )
    return pair, _picture(sky, trails, path, moved, found)


def _middle(path_px: Float) -> Float:
    """Return the centre of a path's bounding box, (2,) px."""
    return np.asarray((path_px.min(axis=0) + path_px.max(axis=0)) / 2)


def _clipped(stamp: Stamp, shape: tuple[int, ...]) -> Stamp:
    """Return the part of a stamp that lies on an image."""
    height, width = stamp.mask.shape
    left, top = max(0, stamp.left), max(0, stamp.top)
    right, bottom = min(shape[1], stamp.left + width), min(shape[0], stamp.top + height)
    rows = slice(top - stamp.top, bottom - stamp.top)
    return Stamp(left, top, stamp.mask[rows, left - stamp.left : right - stamp.left])


def _centroid(light: Float, stamp: Stamp, noise_dn: float) -> tuple[Float, float]:
    """Return the centroid of eq. (44) in image coordinates, px, and its standard deviation due to noise, px."""
    total = float(light.sum())
    rows, columns = np.nonzero(stamp.mask)
    weights = light[rows, columns]
    position = np.column_stack([columns, rows]).astype(np.float64)
    centre = weights @ position / total
    noise_px = noise_dn * float(np.sqrt(np.sum((position - centre) ** 2))) / abs(total)
    return centre + np.array([stamp.left, stamp.top]), noise_px


def _picture(sky: SubtractedImage, trails: Trails, path: Float, moved: Float, found: FoundTrail) -> Cutouts:
    both = _clipped(stamp_of(np.vstack([path, moved]), trails.half_width_px, margin_px=4), sky.above_dn.shape)
    return Cutouts(
        (both.of(sky.above_dn) - found.sky_dn).astype(np.float32), both.of(trails.pixels_dn).astype(np.float32).copy()
    )
