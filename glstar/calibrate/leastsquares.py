"""Least squares on cameras and attitudes: Levenberg and Marquardt's method with slopes in closed form.

SciPy's solvers ask for each slope by trying; here a place's slopes are known, and a rotation goes on from where the
last step left it, so that it needs no chart.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Final, Generic, TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from glstar.camera.model import Camera

__all__ = ["Minimum", "minimise", "projection_jacobian"]

Float = NDArray[np.float64]
State = TypeVar("State")

# Done when a step makes the sum of squares smaller by less than this share; given up when no step makes it smaller.
_STILL: Final = 1e-10
# From where a step makes it smaller by less than this share the end is near.
_NEAR: Final = 0.1
_NOTHING: Final = 1e-12
_FIRST_DAMPING, _MOST_DAMPING = 1e-3, 1e9
# A step in the pinhole's plane over which a lens is straight.
_STEP: Final = 1e-6


@dataclass(frozen=True, slots=True, eq=False)
class Minimum(Generic[State]):
    """Where a search came to rest.

    Attributes
    ----------
    state : object
        What was moved.
    residual : (n,) float64
    slopes : (n, k) float64
        Of the residuals by the numbers that were free.
    scale : (n,) float64
        From here on each residual pulls less.
    """

    state: State
    residual: Float
    slopes: Float
    scale: Float

    @property
    def root(self) -> Float:
        """By how much less each residual pulls than its square would have it, (n,) float64, 1 and more."""
        return np.asarray(np.sqrt(1 + (self.residual / self.scale) ** 2))

    @property
    def cost(self) -> float:
        """Half the sum of squares, softened."""
        return float(np.sum(self.residual**2 / (self.root + 1)))

    @property
    def information(self) -> Float:
        """What the residuals say of the numbers: the inverse of their covariance, (k, k) float64."""
        root = self.root
        return np.asarray((self.slopes.T * ((root + 1) / (2 * root**2))) @ self.slopes)


def minimise(
    start: State,
    measured: Callable[[State], tuple[Float, Float]],
    moved: Callable[[State, Float], State],
    *,
    scale: ArrayLike,
    most_steps: int = 100,
) -> Minimum[State]:
    """Return the state near to a first one whose residuals have the least sum of squares, the far ones softened.

    Parameters
    ----------
    start : object
    measured : callable
        Gives the residuals of a state (n,) and their slopes (n, k) by the numbers of `moved`, at none.
    moved : callable
        Gives the state that k small numbers lead to from a state.
    scale : (n,) array_like
        From here on a residual counts by its size, no longer by its square: SciPy's ``soft_l1`` loss.  Infinity for
        one that always counts by its square.
    most_steps : int
        How many are tried at the most.

    Returns
    -------
    Minimum
    """
    residual, slopes = measured(start)
    scale = np.broadcast_to(np.asarray(scale, dtype=np.float64), residual.shape)
    best = Minimum(start, residual, slopes, scale)
    damping, near = _FIRST_DAMPING, False
    for _ in range(most_steps):
        root = best.root
        gradient = best.slopes.T @ (best.residual / root)
        # Far off, weights that never step too far; near, the loss's own curvature, which steps right.
        normal = (best.slopes.T / (root**3 if near else root)) @ best.slopes
        # A number of which the residuals say nothing stays.
        diagonal = np.maximum(np.diag(normal), _NOTHING)
        step = np.asarray(np.linalg.solve(normal + np.diag(damping * diagonal), -gradient), dtype=np.float64)
        state = moved(best.state, step)
        trial = Minimum(state, *measured(state), scale)
        less = best.cost - trial.cost
        still, near = abs(less) <= _STILL * best.cost, 0 <= less < _NEAR * best.cost
        best, damping = (trial, damping / 10) if less >= 0 else (best, damping * 10)
        if still or damping > _MOST_DAMPING:
            break
    return best


def projection_jacobian(camera: Camera, direction_camera: Float) -> tuple[Float, Float, Float]:
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
