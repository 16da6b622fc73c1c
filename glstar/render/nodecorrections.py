"""Least squares of continuous segments: the corrections of their starts, middles and ends."""

from typing import Final

import numpy as np
from numpy.typing import NDArray

__all__ = ["STIFFNESS", "node_corrections"]

Float = NDArray[np.float64]

# Weight of no correction relative to the mean weight of the samples: segments shorter than three samples leave some
# corrections undetermined.
STIFFNESS: Final = 1e-7


def node_corrections(basis: Float, segment: NDArray[np.intp], turn: Float, weight: Float, count: int) -> Float:
    """Return the corrections of nodes that minimise the weighted squares of what they leave of rotations.

    Parameters
    ----------
    basis : (n, 3) float64
        Weight of the start, the middle and the end of its segment in each sample.
    segment : (n,) intp
        The segment that contains each sample, increasing; each has at least one.
    turn : (n, 3) float64
        Rotation vectors that the corrections shall add up to, rad.
    weight : (n,) float64
        Weights of the samples.
    count : int
        Number of nodes: the start, the middle and the end of the first segment, which is the start of the second, and
        so on.

    Returns
    -------
    (count, 3) float64
        Rotation vectors, rad.

    Notes
    -----
    A sample depends on the three nodes of its segment.  The middle one has no other samples, and is eliminated first;
    the equations of the ends have three diagonals.  They are solved in a time proportional to the number of nodes, and
    on one thread: NumPy's dense products and solver would keep all threads of OpenBLAS busy, and round differently with
    another number of them.  SciPy's banded solver would take a worker longer to load than ten images to draw.
    """
    weighted = basis * weight[:, np.newaxis]
    first, second = np.array([(0, 0), (1, 1), (2, 2), (0, 1), (1, 2), (0, 2)]).T
    products = weighted[:, first] * basis[:, second]
    right = (weighted[:, :, np.newaxis] * turn[:, np.newaxis]).reshape(-1, 9)
    columns = np.concatenate([products, right], axis=1)
    sums = np.add.reduceat(columns, segment.searchsorted(np.arange(count // 2)))
    stiffness = STIFFNESS * sums[:, :3].sum() / count
    middle, to_start, to_end = sums[:, 1:2] + stiffness, sums[:, 3:4], sums[:, 4:5]
    of_start, of_middle, of_end = (sums[:, at : at + 3] for at in (6, 9, 12))
    # The diagonal and the right sides of the ends of the segments, and what is beside the diagonal.
    ends = np.zeros((count // 2 + 1, 4))
    ends[:-1] += np.hstack([sums[:, :1] - to_start * to_start / middle, of_start - to_start / middle * of_middle])
    ends[1:] += np.hstack([sums[:, 2:3] - to_end * to_end / middle, of_end - to_end / middle * of_middle])
    ends[:, 0] += stiffness
    beside = sums[:, 5:] - to_start * to_end / middle
    corrections = np.empty((count, 3))
    corrections[::2] = _tridiagonal_solution(ends[:, 0].tolist(), beside[:, 0].tolist(), ends[:, 1:].T.tolist()).T
    known = to_start * corrections[:-2:2] + to_end * corrections[2::2]
    corrections[1::2] = (of_middle - known) / middle
    return corrections


def _tridiagonal_solution(diagonal: list[float], beside: list[float], right: list[list[float]]) -> Float:
    """Return the solutions, (k, n), of symmetric positive definite equations with k right sides of n numbers.

    `beside` has the n - 1 elements below the diagonal.  By elimination (Thomas), in Python: LAPACK would be no faster.
    """
    factors = []
    for row, element in enumerate(beside):
        factors.append(element / diagonal[row])
        diagonal[row + 1] -= factors[-1] * element
    solutions = []
    for values in right:
        for row, factor in enumerate(factors):
            values[row + 1] -= factor * values[row]
        solution = [values[-1] / diagonal[-1]]
        for row in range(len(factors) - 1, -1, -1):
            solution.append(values[row] / diagonal[row] - factors[row] * solution[-1])
        solutions.append(solution[::-1])
    return np.array(solutions)
