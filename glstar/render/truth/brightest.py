"""Where paths of stars leave most light on the image, and how much of it each star shares with itself.

Paths are chains of straight lines; what each line receives from the others is summed for each star.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from math import ceil, pi, sqrt
from typing import NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from glstar.arrays import Float, Float32
from glstar.camera.model import Camera
from glstar.render.truth.lightsums import FAR_SIGMA, PAIRS_AT_ONCE, Gaussians, light_sums
from glstar.render.truth.linechains import LineChain, normal_from_middle, square_distance_px2

# Lines of a path, at most: groups of neighbours if there are more; and as far as lines are divided.
_MOST_LINES = 600
_MOST_DIVIDED = 300
# Lines that are together shorter than this, sigma, are one group; and of stars that cross the border of the image.
_SHORT_SIGMA = 1.5
_SHORT_AT_BORDER_SIGMA = 0.1
# Lines that are longer than this, sigma, are divided, because another part of the path may cross them anywhere.
_LONG_SIGMA = 4.0
# Lines of a path along which the signal is evaluated exactly; their separation, sigma; and part of the largest
# signal at the middle of a line that they have.
_CANDIDATES = 4
_SEPARATION_SIGMA = 2.0
_PROMISING = 0.85
# If a smaller part of a trail than this is on the image, the part of its light there is not known.
_LEAST_SHARE = 1e-6
# Lines within a distance of the border of the image, sigma, may share light that is on its other side; it matters if
# they have this part of the integral of the square.
_BORDER_SIGMA = 2.5
_LEAST_PART = 0.3
# Where no light is, px.
FAR_PX = 1e7


@dataclass(frozen=True, slots=True, eq=False)
class BrightestPoints:
    """Points of m trails at which the signal is largest, and the integral of its square."""

    # (k, m, 2) the k points of each trail on the image that promise most light, or the nearest ones to the image, px:
    # middles of lines.
    point_px: Float
    step_px: Float  # (k, m, 2) from the starts to the ends of these lines, px
    promised_per_px2: Float  # (k, m) signals over the flux that are expected there
    # (m,) the integral of the squared signal over the squared flux above the cloud, 1/px^2; of a path that is partly on
    # the image, that over the part on it, divided by this part of the time.
    square_per_px2: Float


def brightest_points(
    camera: Camera, sigma_px: float, chains: Sequence[LineChain], transmissions: Sequence[Float | None]
) -> BrightestPoints:
    """Return where stars of a width leave most light on the image.

    `chains` are their paths in each short exposure, and `transmissions` what reaches the camera during each line of
    each chain, (n, m) or None. The square of the signal of a path, summed over the image, is the mean along the path of
    the signal that stars sqrt(2) times as wide would leave: two Gaussians overlap like one with the sum of their
    variances.
    """
    lines = _Lines.of(chains, sigma_px, camera)
    light, square, share = _light_and_square(lines, camera, sigma_px, transmissions)
    crossing = ((share > 0) & (share < 1)).nonzero()[0]
    if lines.first is not None and crossing.size:
        finer = _Lines.of([chain[crossing] for chain in chains], sigma_px, camera, _SHORT_AT_BORDER_SIGMA)
        of_crossing = [each if each is None else each[:, crossing] for each in transmissions]
        square[crossing] = _light_and_square(finer, camera, sigma_px, of_crossing)[1]
    return BrightestPoints(*_candidates(lines, light, _SEPARATION_SIGMA * sigma_px), square)


class _Lines(NamedTuple):
    """The lines of several chains one after the other: at most some hundred; groups of them, or parts of long ones."""

    middle_px: Float  # (2, n, m) middles (x, y), and vectors from the starts to the ends, px
    step_px: Float
    weight: Float  # (n, m) the fraction of each star's flux
    # (3, n, m) or None: the variance along x, the covariance and the variance along y of the light of groups, px^2.
    spread_px2: Float | None = None
    first: NDArray[np.intp] | None = None  # The first line of each group
    parts: int = 1  # Or into how many parts they are divided

    @classmethod
    def of(
        cls, chains: Sequence[LineChain], sigma_px: float, camera: Camera, short_sigma: float = _SHORT_SIGMA
    ) -> Self:
        """Return the lines of chains, for stars of a width; those that are together shorter than a length as groups."""
        # Far outside, the polynomial of a lens may be anywhere.
        middle_px, step_px = (
            _joined([getattr(chain, name) for chain in chains]).clip(-FAR_PX, FAR_PX)
            for name in ("middle_px", "step_px")
        )
        weight, length_px = (_joined([getattr(chain, name) for chain in chains]) for name in ("weight", "length_px"))
        count = len(weight)
        on_image = length_px[camera.contains(np.moveaxis(middle_px, 0, -1))]
        usual_px, longest_px = (on_image.mean(), np.quantile(on_image, 0.95)) if on_image.size else (1.0, 1.0)
        group = max(-(-count // _MOST_LINES), min(int(short_sigma * sigma_px / max(usual_px, 1e-9)), count // 8))
        if group <= 1:
            parts = max(1, min(ceil(longest_px / (_LONG_SIGMA * sigma_px)), _MOST_DIVIDED // count))
            along = np.tile((np.arange(parts) + 0.5) / parts - 0.5, count)[:, np.newaxis]
            middle_px, step_px, weight = (np.repeat(each, parts, axis=-2) for each in (middle_px, step_px, weight))
            return cls(middle_px + along * step_px, step_px / parts, weight / parts, parts=parts)
        # Groups of the lines of one chain: to the next one is a gap.
        first = np.concatenate([np.arange(*ends, group) for ends in pairwise(np.cumsum([0, *map(len, chains)]))])
        light, steps = np.maximum(weight, 1e-12), _grouped(step_px, first)
        total = _grouped(light, first)
        middles = _grouped(light * middle_px, first) / total
        spread_px2 = np.stack(
            [
                _grouped(light * (step_px[i] * step_px[j] / 12 + middle_px[i] * middle_px[j]), first) / total
                - middles[i] * middles[j]
                for i, j in ((0, 0), (0, 1), (1, 1))
            ]
        )
        return cls(middles, steps, _grouped(weight, first), spread_px2, first)

    def means(self, values: Float) -> Float:
        """Return the means of values of the lines of the chains, (..., n, m)."""
        return np.repeat(values if self.first is None else _grouped(values, self.first, mean=True), self.parts, axis=-2)


def _light_and_square(
    lines: _Lines, camera: Camera, sigma_px: float, transmissions: Sequence[Float | None]
) -> tuple[Float, Float, Float]:
    """Return the signals on the image near lines, (n, m) 1/px^2, and of their stars, (m,) both, two values.

    These are `BrightestPoints.square_per_px2` and the part of the path on the image.
    """
    outside_px = camera.distance_outside_px(lines.middle_px.transpose(1, 2, 0))
    # The sum over pixels of what two lines share is cut off at the border as if it were narrower by a pixel's variance.
    shared_px = sqrt(max(sigma_px**2 / 2 - 1 / 12, 0.01))
    on_image, lit = _parts_on_image(lines, camera, outside_px, shared_px)
    gaussians = _as_gaussians(lines, sigma_px)
    signals, overlaps = _signals_and_overlaps(lines, gaussians, sigma_px, outside_px < FAR_SIGMA * sigma_px)
    clouded = [transmission for transmission in transmissions if transmission is not None]
    passing = lines.means(_joined(clouded)) if clouded else np.ones_like(lines.weight)
    nearby = _smoothed(lines, passing, sigma_px, on_image) if clouded else passing
    # Of lines beside the image, what arrives at its border.
    light: Float = np.where(lines.weight > 0, signals * nearby, 0.0)
    beside = (outside_px > 0).nonzero()
    sigmas = outside_px[beside] / sigma_px
    light[beside] = np.where(sigmas < FAR_SIGMA, light[beside] * np.exp(-0.5 * sigmas * sigmas), -sigmas)
    overlaps *= lines.weight
    square = np.einsum("nm,nm,nm,nm->m", lit, overlaps, passing, nearby)
    near_border = np.abs(outside_px) < _BORDER_SIGMA * sigma_px
    matters = near_border & (np.einsum("nm,nm->m", near_border, overlaps) > _LEAST_PART * square)
    square += _shared_at_border(lines, gaussians, camera, shared_px, matters, lit, passing) / (4 * pi * sigma_px**2)
    share = np.einsum("nm,nm->m", on_image, lines.weight)
    return light, np.where(share > _LEAST_SHARE, square / np.maximum(share, _LEAST_SHARE), 0.0), share


def _joined(values: list[Float]) -> Float:
    """Return the values of several chains one after the other; a single chain is not copied."""
    return values[0] if len(values) == 1 else np.concatenate(values, axis=-2)


def _grouped(values: Float, first: NDArray[np.intp], *, mean: bool = False) -> Float:
    """Return the sums or means of groups of consecutive lines, (..., k, m) of (..., n, m), given their first lines."""
    sums = np.add.reduceat(values, first, axis=-2)
    return sums / np.diff(first, append=values.shape[-2])[:, np.newaxis] if mean else np.asarray(sums)


def _parts_on_image(lines: _Lines, camera: Camera, outside_px: Float, sigma_px: float) -> tuple[Float, Float]:
    """Return which parts of lines are on the image, and which parts of the light of a width along them, (n, m) both.

    `outside_px` (n, m): `Camera.distance_outside_px` of their middles.
    """
    on_image = (outside_px <= 0).astype(np.float64)
    lit = on_image.copy()
    half_px = np.sqrt(np.square(lines.step_px).sum(axis=0)) / 2
    across = (np.abs(outside_px) < half_px + 4 * sigma_px).nonzero()
    middle_px, half_step_px = lines.middle_px[:, *across].T, lines.step_px[:, *across].T / 2
    # Inwards from the border to both ends; a line that is along it has two equal ends.
    first, last = (-camera.distance_outside_px(at) for at in (middle_px - half_step_px, middle_px + half_step_px))
    low, high = np.minimum(first, last) - 0.01 * sigma_px, np.maximum(first, last) + 0.01 * sigma_px
    on_image[across] = (high / (high - low)).clip(0.0, 1.0)
    integrals = []
    for end in (high, low):
        z = (end / sigma_px).astype(np.float32)
        integrals.append(z * (normal_from_middle(z) + 0.5) + np.exp(-0.5 * z * z) / sqrt(2 * pi))
    lit[across] = ((integrals[0] - integrals[1]) * sigma_px / (high - low)).clip(0.0, 1.0)
    return on_image, lit


def _shared_at_border(
    lines: _Lines,
    gaussians: Gaussians,
    camera: Camera,
    shared_px: float,
    matters: NDArray[np.bool_],
    lit: Float,
    passing: Float,
) -> Float:
    """Return what lacks in the integrals of squares that take the part on the image, `lit`, at each line, (m,).

    What two lines share of their light is halfway between them, `shared_px` wide.  `matters` (n, m): at which lines
    that is counted; `passing` (n, m): what cloud transmits.
    """
    lacking, size_px = np.zeros(lines.weight.shape[1]), np.array([[camera.width_px], [camera.height_px]])
    line, star = matters.nonzero()
    at_once = max(1, PAIRS_AT_ONCE // len(lines.weight))
    for first in range(0, len(line), at_once):
        own, of = line[first : first + at_once], star[first : first + at_once]
        own_px, middle_px, step_px = lines.middle_px[:, own, of], lines.middle_px[..., of], lines.step_px[..., of]
        light = gaussians.light(own, of) * passing[:, of]
        if lines.spread_px2 is None:  # A long line shares its own light all along itself
            light[own, np.arange(len(own))] = 0.0
        outside_px = camera.distance_outside_px(((middle_px + own_px[:, np.newaxis]) / 2).T).T
        # Across the border that is nearer, the middle of two lines is spread by both of their lengths.
        beside, above = np.abs(own_px - (size_px - 1) / 2) - size_px / 2
        across_px = np.where(beside > above, step_px[0], step_px[1])
        spread_px = np.sqrt(shared_px**2 + (across_px**2 + across_px[own, np.arange(len(own))] ** 2) / 48)
        change = 0.5 - normal_from_middle(outside_px / spread_px) - lit[own, of]
        shared = lines.weight[own, of] * passing[own, of] * np.einsum("np,np->p", light, change)
        lacking += np.bincount(of, shared, len(lacking))
    return lacking


def _smoothed(lines: _Lines, passing: Float, sigma_px: float, on_image: Float) -> Float:
    """Return what cloud transmits of the light that arrives at each line from its neighbours, (n, m).

    The neighbours of one star serve for all.
    """
    if not passing.shape[1]:
        return passing
    star = int(on_image.sum(axis=0).argmax())
    off_px = lines.middle_px[:, :, np.newaxis, star] - lines.middle_px[:, np.newaxis, :, star]
    near = np.exp(np.einsum("aij,aij->ij", off_px, off_px) / (-4 * sigma_px**2))
    near *= np.maximum(lines.weight[:, star], 1e-12)
    return np.asarray((near @ passing) / near.sum(axis=1)[:, np.newaxis])


def _candidates(lines: _Lines, signals: Float, separation_px: float) -> tuple[Float, Float, Float]:
    """Return the middles of the lines with the largest signals, their steps, (k, m, 2) px both, and these signals.

    They are separate; those that promise little are infinitely far away.
    """
    stars = np.arange(signals.shape[1])
    chosen: list[tuple[Float, Float, Float]] = []
    largest = signals.max(axis=0)
    for _ in range(_CANDIDATES):
        best = signals.argmax(axis=0)
        middle_px, step_px = (each[:, best, stars].T for each in (lines.middle_px, lines.step_px))
        promised = signals[best, stars]
        is_promising = promised > _PROMISING * largest if chosen else np.ones(len(stars), np.bool_)
        if not is_promising.any():
            break
        chosen.append((np.where(is_promising[:, np.newaxis], middle_px, FAR_PX), step_px, promised))
        near = square_distance_px2(lines.middle_px, *middle_px.T) < separation_px * separation_px
        signals[near.nonzero()] = -np.inf  # for few of many, faster than by the mask
    middles_px, steps_px, promised_per_px2 = (np.stack(each) for each in zip(*chosen, strict=True))
    return middles_px, steps_px, promised_per_px2


def _as_gaussians(lines: _Lines, sigma_px: float) -> Gaussians:
    """Return lines as the Gaussians that stars sqrt(2) times as wide leave; lengths in sqrt(2) sigma.

    A line is exact in its own middle, and a Gaussian elsewhere: of its variance for the wide stars, together within
    3 %, and for the others of that which makes their signal the square of the wide one.  Groups of lines are Gaussians
    of twice their variance, because the mean over another group that is alike is sought, not the signal at its middle.
    """
    x, y = (lines.middle_px - lines.middle_px[:, :1]) / (sqrt(2) * sigma_px)  # single precision begins here
    step_x, step_y = (lines.step_px / (sqrt(2) * sigma_px)).astype(np.float32)
    if lines.spread_px2 is None:
        xx, xy, yy = (one * other / 12 for one, other in ((step_x, step_x), (step_x, step_y), (step_y, step_y)))
        determinant = 1 + xx + yy
    else:
        xx, xy, yy = lines.spread_px2 / sigma_px**2
        determinant = np.maximum((1 + xx) * (1 + yy) - xy * xy, 1.0)
    height = lines.weight / np.sqrt(determinant)
    values = x, y, -0.5 * (1 + yy) / determinant, xy / determinant, -0.5 * (1 + xx) / determinant, height
    half = np.sqrt(3 * np.maximum(np.stack([xx, yy]), 0.0))
    return Gaussians(*(each.astype(np.float32) for each in (*values, half)))


def _signals_and_overlaps(
    lines: _Lines, gaussians: Gaussians, sigma_px: float, is_needed: NDArray[np.bool_]
) -> tuple[Float32, Float32]:
    """Return the signals of stars and of stars sqrt(2) times as wide at the middles of all lines, (n, m) 1/px^2.

    `is_needed` (n, m): of which lines; those of others may be too small.
    """
    wide, narrow = light_sums(gaussians, is_needed)
    step = lines.step_px / (sqrt(2) * sigma_px)
    length = np.sqrt(np.maximum(np.square(step).sum(axis=0), 1e-6)).astype(np.float32)
    for signal, scale in ((wide, 1.0), (narrow, sqrt(2))):
        at = scale * length
        if lines.spread_px2 is None:
            signal[...] += lines.weight * (sqrt(2 * np.pi) * 2 * normal_from_middle(at / 2) / at) - gaussians.height
        signal[...] *= scale * scale / (4 * np.pi * sigma_px * sigma_px)
    return narrow, wide
