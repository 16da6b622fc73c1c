"""Least squares on cameras and attitudes: Levenberg and Marquardt's method with slopes in closed form.

SciPy's solvers ask for each slope by trying; here a place's slopes are known, and a rotation goes on from where the
last step left it, so that it needs no chart.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Final, Generic, TypeVar

import numpy as np
from numpy.typing import NDArray

from glstar.camera import Camera

__all__ = ["Solution", "place_slopes", "soft", "solved"]

Float = NDArray[np.float64]
State = TypeVar("State")

# Done when a step makes the sum of squares smaller by less than this share; given up when no step makes it smaller.
_STILL: Final = 1e-10
_NOTHING: Final = 1e-12
_FIRST_DAMPING, _MOST_DAMPING = 1e-3, 1e9
# A step in the pinhole's plane over which a lens is straight.
_STEP: Final = 1e-6


@dataclass(frozen=True, slots=True, eq=False)
class Solution(Generic[State]):
    """Where a search came to rest.

    Attributes
    ----------
    state : object
        What was moved.
    residual : (n,) float64
    slopes : (n, k) float64
        Of the residuals by the numbers that were free.
    """

    state: State
    residual: Float
    slopes: Float

    @property
    def cost(self) -> float:
        """Half the sum of squares."""
        return 0.5 * float(self.residual @ self.residual)


def solved(
    start: State,
    measured: Callable[[State], tuple[Float, Float]],
    moved: Callable[[State, Float], State],
    *,
    most_steps: int = 100,
) -> Solution[State]:
    """Return the state near to a first one whose residuals have the least sum of squares.

    Parameters
    ----------
    start : object
    measured : callable
        Gives the residuals of a state (n,) and their slopes (n, k) by the numbers of `moved`, at none.
    moved : callable
        Gives the state that k small numbers lead to from a state.
    most_steps : int
        How many are tried at the most.

    Returns
    -------
    Solution
    """
    best = Solution(start, *measured(start))
    damping = _FIRST_DAMPING
    for _ in range(most_steps):
        gradient, normal = best.slopes.T @ best.residual, best.slopes.T @ best.slopes
        # A number of which the residuals say nothing stays.
        diagonal = np.maximum(np.diag(normal), _NOTHING)
        step = np.asarray(np.linalg.solve(normal + np.diag(damping * diagonal), -gradient), dtype=np.float64)
        state = moved(best.state, step)
        trial = Solution(state, *measured(state))
        if trial.cost <= best.cost:
            still = best.cost - trial.cost <= _STILL * best.cost
            best, damping = trial, damping / 10
            if still:
                break
        else:
            damping *= 10
            if damping > _MOST_DAMPING:
                break
    return best


def soft(off: Float, scale: float) -> tuple[Float, Float]:
    """Return distances of which the far ones pull little, and their slopes by the distances.

    Parameters
    ----------
    off : (n,) float64
    scale : float
        From here on a distance counts less, in the same unit.

    Returns
    -------
    softened, slope : (n,) float64
        The sum of squares of the first is SciPy's ``soft_l1`` loss.
    """
    root = np.sqrt(1 + (off / scale) ** 2)
    share = np.sqrt(2 / (root + 1))
    return off * share, 1 / (root * share)


def place_slopes(camera: Camera, direction_camera: Float) -> tuple[Float, Float, Float]:
    """Return where directions fall, and how they move when the camera turns.

    Parameters
    ----------
    camera : Camera
    direction_camera : (n, 3) float64
        In the camera frame.

    Returns
    -------
    bent : (n, 2) float64
        In the pinhole's plane, behind the lens: what the camera matrix turns into pixels.
    by_place : (n, 2, 2) float64
        Pixels by the pinhole's plane before the lens.
    by_turn : (n, 2, 3) float64
        Pixels by the rotation vector of `glstar.rotation.quaternion_from_turn`, px/rad.
    """
    plane = direction_camera[:, :2] / np.where(direction_camera[:, 2:] > 1e-9, direction_camera[:, 2:], np.nan)
    matrix = camera.K[:2, :2]
    if camera.lens is None:
        bent, by_place = plane, np.broadcast_to(matrix, (len(plane), 2, 2))
    else:
        step = _STEP * np.array([[0.0, 0.0], [1.0, 0.0], [-1.0, 0.0], [0.0, 1.0], [0.0, -1.0]])
        bent, right, left, down, up = camera.lens.distort(plane + step[:, np.newaxis])
        by_place = matrix @ (np.stack([right - left, down - up], axis=-1) / (2 * _STEP))
    x, y = plane.T
    turned = np.empty((len(plane), 2, 3))
    turned[:, 0] = np.column_stack([x * y, -1 - x * x, y])
    turned[:, 1] = np.column_stack([1 + y * y, -x * y, -x])
    return bent, np.asarray(by_place), np.asarray(by_place @ turned)
