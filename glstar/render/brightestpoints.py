"""Where trails are brightest, and how much their own light overlaps, from the trails of example directions.

Neighbouring stars have similar paths: what each line of a path receives from all others is computed for a grid of
directions over the image, and interpolated for the stars.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from math import sqrt
from typing import Any, Final, NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from glstar.camera.model import Camera
from glstar.render.linechains import LineChain, line_chains, normal_cumulative
from glstar.render.scene import Scene

__all__ = ["BrightestPoints", "brightest_points"]

Float = NDArray[np.float64]
Float32 = NDArray[np.float32]

# Example directions across and down the image.
_GRID: Final = (8, 6)
_SMALLEST_GRID: Final = (3, 2)
# Pairs of lines of all example directions, at most: 20 ms.
_MOST_PAIRS: Final = 8_000_000
# Lines of a path, at most: groups of neighbours if there are more.
_MOST_LINES: Final = 64
# Points of a path at which the signal is evaluated exactly.
_CANDIDATES: Final = 2
# Pairs of lines that are computed at once: more of them fall out of the processor's cache.
_BLOCK: Final = 32_768
# Light that is farther than this, in units of the exponent, does not count; and smaller numbers are slow.
_FAR_EXPONENT: Final = np.float32(-40.0)


@dataclass(frozen=True, slots=True, eq=False)
class BrightestPoints:
    """Points of m trails at which the signal is largest, and the integral of its square.

    Attributes
    ----------
    point_px : (k, m, 2) float64
        The k points of each trail on the image that promise most light, or the nearest ones to the image, px.
    square_per_px2 : (m,) float64
        The integral of the squared signal over the squared flux above the cloud, 1/px^2; of a path that is partly on
        the image, that over the part on it, divided by this part of the time.
    """

    point_px: Float
    square_per_px2: Float


def brightest_points(
    scene: Scene,
    direction_eq: Float,
    chains: Sequence[LineChain],
    transmissions: Sequence[Float | None],
) -> BrightestPoints:
    """Return where stars leave most light on the image.

    Parameters
    ----------
    scene : Scene
    direction_eq : (m, 3) float64
        Geocentric apparent unit vectors, true equator and equinox.
    chains : sequence of LineChain
        Their paths, of each short exposure.
    transmissions : sequence of (n, m) float64 or None
        What reaches the camera during each line of each chain.

    Returns
    -------
    BrightestPoints

    Notes
    -----
    The square of the signal of a path, summed over the image, is the mean along the path of the signal that stars
    sqrt(2) times as wide would leave: two Gaussians overlap like one with the sum of their variances.
    """
    lines = _Lines.of(chains)
    outside_px = scene.camera.distance_outside_px(lines.middle_px.transpose(1, 2, 0))
    on_image = (outside_px <= 0).astype(np.float64)
    signals, overlaps = _interpolated(scene, direction_eq, lines)
    clouded = [transmission for transmission in transmissions if transmission is not None]
    passing = _grouped(_joined(clouded), mean=True) if clouded else np.ones_like(lines.weight)
    nearby = _smoothed(lines, passing, scene.sensor.effective_sigma_px, on_image) if clouded else passing
    light: Float = np.where(lines.weight > 0, signals * nearby, 0.0)
    light = np.where(outside_px > 0, -outside_px, light)
    on_image *= lines.weight
    square = np.einsum("nm,nm,nm,nm->m", on_image, overlaps, passing, nearby)
    square /= np.maximum(on_image.sum(axis=0), 1e-30)
    return BrightestPoints(_candidates(scene.camera, lines.middle_px, light), square)


class _Lines(NamedTuple):
    """The lines of several chains one after the other: at most some hundred, or groups of them.

    Attributes
    ----------
    middle_px, step_px : (2, n, m) float64
        Middles (x, y), and vectors from the starts to the ends, px.
    weight : (n, m) float64
        The fraction of each star's flux.
    is_whole : (m,) bool
        Which stars are visible all the time.
    """

    middle_px: Float
    step_px: Float
    weight: Float
    is_whole: NDArray[np.bool_]

    @classmethod
    def of(cls, chains: Sequence[LineChain]) -> Self:
        """Return the lines of chains."""
        middle_px = _grouped(_joined([chain.middle_px for chain in chains]), mean=True)
        step_px = _grouped(_joined([chain.step_px for chain in chains]))
        weight = _grouped(_joined([chain.weight for chain in chains]))
        return cls(middle_px, step_px, weight, np.all([chain.is_whole for chain in chains], axis=0))


def _joined(values: list[Float]) -> Float:
    """Return the values of several chains one after the other, without a copy of those of a single one."""
    return values[0] if len(values) == 1 else np.concatenate(values, axis=-2)


def _grouped(values: Float, *, mean: bool = False) -> Float:
    """Return the sums or means of groups of consecutive lines, (..., k, m) of (..., n, m), that are not too many."""
    count = values.shape[-2]
    size = -(-count // _MOST_LINES)
    if size == 1:
        return values
    whole = count - count % size
    sums = values[..., :whole, :].reshape(*values.shape[:-2], count // size, size, values.shape[-1]).sum(axis=-2)
    sizes = np.full(sums.shape[-2], size)
    if whole < count:
        sums = np.concatenate([sums, values[..., whole:, :].sum(axis=-2, keepdims=True)], axis=-2)
        sizes = np.append(sizes, count - whole)
    return np.asarray(sums / sizes[:, np.newaxis] if mean else sums)


def _smoothed(lines: _Lines, passing: Float, sigma_px: float, on_image: Float) -> Float:
    """Return what cloud transmits of the light that arrives at each line from its neighbours, (n, m).

    The neighbours are those of one star, for all.
    """
    if not passing.shape[1]:
        return passing
    star = int(on_image.sum(axis=0).argmax())
    off_px = lines.middle_px[:, :, np.newaxis, star] - lines.middle_px[:, np.newaxis, :, star]
    near = np.exp(np.einsum("aij,aij->ij", off_px, off_px) / (-4 * sigma_px**2))
    near *= np.maximum(lines.weight[:, star], 1e-12)
    return np.asarray((near @ passing) / near.sum(axis=1)[:, np.newaxis])


def _candidates(camera: Camera, middle_px: Float, signals: Float) -> Float:
    """Return the points of paths with the largest signals, on the image, (k, m, 2) px."""
    stars, points = np.arange(signals.shape[1]), []
    for _ in range(min(_CANDIDATES, len(signals))):
        best = signals.argmax(axis=0)
        points.append(middle_px[:, best, stars].T)
        signals[best, stars] = -np.inf
    return np.asarray(np.stack(points).clip(-0.5, np.array([camera.width_px, camera.height_px]) - 0.5))


def _interpolated(scene: Scene, direction_eq: Float, lines: _Lines) -> tuple[NDArray[Any], NDArray[Any]]:
    """Return the signal at the middle of each line, and that of stars sqrt(2) times as wide, (n, m) 1/px^2."""
    sigma_px, camera = scene.sensor.effective_sigma_px, scene.camera
    columns, rows = _grid_size(len(lines.weight))
    if len(direction_eq) <= columns * rows:
        return _signals_and_overlaps(lines, sigma_px)
    at_px = np.nan_to_num(camera.project(scene.shutter[1:2].to_camera(direction_eq, below_horizon=True))[0]).T
    size_px = np.array([camera.width_px, camera.height_px])
    low_px, high_px = at_px.min(axis=1).clip(-size_px, 0), at_px.max(axis=1).clip(size_px, 2 * size_px)
    x_px, y_px = (np.linspace(low_px[k], high_px[k], count) for k, count in enumerate((columns, rows)))
    example_px = np.stack(np.meshgrid(x_px, y_px), axis=-1).reshape(-1, 2)
    examples = _Lines.of(list(_chains_through(scene, example_px)))
    near = _bilinear(at_px, x_px, y_px) * examples.is_whole[:, np.newaxis]
    near = near / np.maximum(near.sum(axis=0), 1e-6)
    signals, overlaps = _signals_and_overlaps(examples, sigma_px)
    # In double precision: the rounding of a product depends on how many threads OpenBLAS has, and truth must not.
    return signals.astype(np.float64) @ near, overlaps.astype(np.float64) @ near


def _chains_through(scene: Scene, xy_px: Float) -> Iterator[LineChain]:
    """Yield the chains of directions that are at some positions in the middle of the exposure, (k, 2) px."""
    in_camera = scene.camera.unit_vectors(xy_px)
    in_camera = np.where(np.isnan(in_camera), np.array([0.0, 0.0, -1.0]), in_camera)  # behind it
    return line_chains(scene, in_camera @ scene.shutter.C_camera_eq[1])


def _grid_size(count: int) -> tuple[int, int]:
    """Return the numbers of example directions across and down for paths of `count` lines."""
    scale = min(1.0, sqrt(_MOST_PAIRS / (_GRID[0] * _GRID[1] * count * count)))
    columns, rows = (max(int(most * scale), least) for most, least in zip(_GRID, _SMALLEST_GRID, strict=True))
    return columns, rows


def _bilinear(xy_px: Float, x_px: Float, y_px: Float) -> Float:
    """Return the weights of the nodes of a grid at positions, (nodes, m), row by row; clamped at its border."""
    hats = []
    for at_px, nodes_px in zip(xy_px, (x_px, y_px), strict=True):
        steps = (at_px.clip(nodes_px[0], nodes_px[-1]) - nodes_px[:, np.newaxis]) / (nodes_px[1] - nodes_px[0])
        hats.append((1 - np.abs(steps)).clip(0.0))
    return np.asarray((hats[1][:, np.newaxis] * hats[0]).reshape(-1, xy_px.shape[1]))


def _signals_and_overlaps(lines: _Lines, sigma_px: float) -> tuple[Float32, Float32]:
    """Return the signals of stars and of stars sqrt(2) times as wide at the middles of all lines, (n, m) 1/px^2.

    A line is exact in its own middle, and a Gaussian elsewhere: of its variance for the wide stars, together within
    3 %, and for the others of that which makes their signal the square of the wide one.
    """
    from_start_px = lines.middle_px - lines.middle_px[:, :1]  # single precision begins here
    in_sigma = (px.T / (sqrt(2) * sigma_px) for px in (*from_start_px, *lines.step_px))
    x, y, step_x, step_y, weight = (np.ascontiguousarray(each, np.float32) for each in (*in_sigma, lines.weight.T))
    length2 = step_x * step_x + step_y * step_y
    variance = 1 + length2 / 12
    # The exponent is a x^2 + b x y + c y^2.
    squeeze = 1 / (24 * variance)
    a, b, c = squeeze * step_x * step_x - 0.5, 2 * squeeze * step_x * step_y, squeeze * step_y * step_y - 0.5
    wide, narrow = np.empty_like(weight), np.empty_like(weight)
    height = weight / np.sqrt(variance)
    per_block = max(1, _BLOCK // x.shape[1] ** 2)
    for first in range(0, len(x), per_block):
        block = slice(first, first + per_block)
        dx, dy = (axis[block, :, np.newaxis] - axis[block, np.newaxis] for axis in (x, y))
        exponent = a[block, np.newaxis] * dx
        exponent += b[block, np.newaxis] * dy
        exponent *= dx
        dy *= dy
        dy *= c[block, np.newaxis]
        exponent += dy
        # Rounding may exceed 0 beside very long lines.
        np.clip(exponent, _FAR_EXPONENT, np.float32(0.0), out=exponent)
        np.exp(exponent, out=exponent)
        # Without OpenBLAS, for the same reason.
        np.einsum("kij,kj->ki", exponent, height[block], out=wide[block])
        exponent *= exponent
        np.einsum("kij,kj->ki", exponent, height[block], out=narrow[block])
    length = np.sqrt(np.maximum(length2, 1e-6))
    for each, scale in ((wide, 1.0), (narrow, sqrt(2))):
        at = scale * length
        each[...] += weight * (sqrt(2 * np.pi) * (2 * normal_cumulative(at / 2) - 1) / at) - height
        each[...] *= scale * scale / (4 * np.pi * sigma_px * sigma_px)
    return narrow.T, wide.T
