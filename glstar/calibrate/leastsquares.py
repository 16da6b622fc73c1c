"""Levenberg-Marquardt least squares on cameras and attitudes, with an analytic Jacobian.

Rotations are composed step by step, so that no parametrisation of the attitude is needed.
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

# Converged when a step reduces the sum of squares by less than this fraction.
_CONVERGED: Final = 1e-10
# Below this fraction the minimum is near.
_NEAR: Final = 0.1
_NOTHING: Final = 1e-12
_FIRST_DAMPING, _MOST_DAMPING = 1e-3, 1e9
# Step of the numerical derivative in the normalised image plane.
_STEP: Final = 1e-6


@dataclass(frozen=True, slots=True, eq=False)
class Minimum(Generic[State]):
    """A minimum of a robust sum of squares.

    Attributes
    ----------
    state : object
        The fitted state.
    residual : (n,) float64
    slopes : (n, k) float64
        Jacobian of the residuals by the free parameters.
    scale : (n,) float64
        Residuals beyond this have a reduced influence.
    """

    state: State
    residual: Float
    slopes: Float
    scale: Float

    @property
    def root(self) -> Float:
        """The square root of one plus the squared scaled residuals, (n,) float64."""
        return np.asarray(np.sqrt(1 + (self.residual / self.scale) ** 2))

    @property
    def cost(self) -> float:
        """Half the robust sum of squares."""
        return float(np.sum(self.residual**2 / (self.root + 1)))

    @property
    def information(self) -> Float:
        """The information matrix: the inverse of the parameters' covariance, (k, k) float64."""
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
    """Return the state that minimises the robust sum of squares, starting from a given one.

    Parameters
    ----------
    start : object
    measured : callable
        Returns the residuals of a state (n,), and their Jacobian (n, k) by the step of `moved`, at 0.
    moved : callable
        Returns the state a step (k,) away from a state.
    scale : (n,) array_like
        Scale of SciPy's ``soft_l1`` loss: larger residuals count linearly.  Infinity for least squares.
    most_steps : int
        Largest number of steps.

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
        # Far from the minimum these weights never overshoot; near it they are the curvature of the loss.
        normal = (best.slopes.T / (root**3 if near else root)) @ best.slopes
        # A parameter that no residual depends on keeps its value.
        diagonal = np.maximum(np.diag(normal), _NOTHING)
        step = np.asarray(np.linalg.solve(normal + np.diag(damping * diagonal), -gradient), dtype=np.float64)
        state = moved(best.state, step)
        trial = Minimum(state, *measured(state), scale)
        less = best.cost - trial.cost
        still, near = abs(less) <= _CONVERGED * best.cost, 0 <= less < _NEAR * best.cost
        best, damping = (trial, damping / 10) if less >= 0 else (best, damping * 10)
        if still or damping > _MOST_DAMPING:
            break
    return best


def projection_jacobian(camera: Camera, direction_camera: Float) -> tuple[Float, Float, Float]:
    """Return distorted positions of directions, and their derivatives.

    Parameters
    ----------
    camera : Camera
    direction_camera : (n, 3) float64
        In the camera frame.

    Returns
    -------
    bent : (n, 2) float64
        Distorted positions in the normalised image plane: the camera matrix maps them to pixels.
    by_position : (n, 2, 2) float64
        Derivatives of pixels by undistorted normalised positions.
    by_turn : (n, 2, 3) float64
        Derivatives of pixels by the rotation vector of `glstar.rotation.quaternion_from_turn`, px/rad.
    """
    plane = direction_camera[:, :2] / np.where(direction_camera[:, 2:] > 1e-9, direction_camera[:, 2:], np.nan)
    matrix = camera.K[:2, :2]
    if camera.lens is None:
        bent, by_position = plane, np.broadcast_to(matrix, (len(plane), 2, 2))
    else:
        step = _STEP * np.array([[0.0, 0.0], [1.0, 0.0], [-1.0, 0.0], [0.0, 1.0], [0.0, -1.0]])
        bent, right, left, down, up = camera.lens.distort(plane + step[:, np.newaxis])
        by_position = matrix @ (np.stack([right - left, down - up], axis=-1) / (2 * _STEP))
    x, y = plane.T
    turned = np.empty((len(plane), 2, 3))
    turned[:, 0] = np.column_stack([x * y, -1 - x * x, y])
    turned[:, 1] = np.column_stack([1 + y * y, -x * y, -x])
    return bent, np.asarray(by_position), np.asarray(by_position @ turned)
