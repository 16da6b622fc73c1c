"""Levenberg-Marquardt least squares: one robust problem on any state, or many small problems at once.

SciPy's ``least_squares`` takes vectors, which attitudes are not, and one problem at a time, where an image has a
thousand stars.  Problems with bounds and numerical derivatives are left to it.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Generic, TypeVar

import numpy as np
from numpy.typing import ArrayLike

from glstar.arrays import Float, Index, Mask

State = TypeVar("State")

# Converged when a step reduces the sum of squares by less than this fraction.
_CONVERGED = 1e-10
# Below this fraction the minimum is near.
_NEAR_MINIMUM = 0.1
_NOTHING = 1e-12
_FIRST_DAMPING = 1e-3
_LEAST_DAMPING = 1e-9
_MOST_DAMPING = 1e9


@dataclass(frozen=True, slots=True, eq=False)
class Minimum(Generic[State]):
    """A minimum of a robust sum of squares."""

    state: State  # The fitted state
    residual: Float  # (n,)
    slopes: Float  # (n, k) Jacobian of the residuals by the free parameters
    scale: Float  # (n,) residuals beyond this have a reduced influence

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

    `measured`: returns the residuals of a state (n,), and their Jacobian (n, k) by the step of `moved`, at 0; `moved`:
    returns the state a step (k,) away from a state; `scale` (n,): scale of SciPy's ``soft_l1`` loss: larger residuals
    count linearly; infinity for least squares; `most_steps`: largest number of steps.
    """
    residual, slopes = measured(start)
    scale = np.broadcast_to(np.asarray(scale, dtype=np.float64), residual.shape)
    best = Minimum(start, residual, slopes, scale)
    damping = _FIRST_DAMPING
    is_near = False
    for _ in range(most_steps):
        root = best.root
        gradient = best.slopes.T @ (best.residual / root)
        # Far from the minimum these weights never overshoot; near it they are the curvature of the loss.
        normal = (best.slopes.T / (root**3 if is_near else root)) @ best.slopes
        # A parameter that no residual depends on keeps its value.
        diagonal = np.maximum(np.diag(normal), _NOTHING)
        step = np.asarray(np.linalg.solve(normal + np.diag(damping * diagonal), -gradient), dtype=np.float64)
        state = moved(best.state, step)
        trial = Minimum(state, *measured(state), scale)
        decrease = best.cost - trial.cost
        has_converged = abs(decrease) <= _CONVERGED * best.cost
        is_near = 0 <= decrease < _NEAR_MINIMUM * best.cost
        if decrease >= 0:
            best = trial
            damping /= 10
        else:
            damping *= 10
        if has_converged or damping > _MOST_DAMPING:
            break
    return best


def _unchanged(values: Float) -> Float:
    return values


def minimise_each(
    start: Float,
    normal_equations: Callable[[Float, Index], tuple[Float, Float, Float]],
    is_small: Callable[[Float], Mask],
    *,
    step_of: Callable[[Float], Float] = _unchanged,
    bounded: Callable[[Float], Float] = _unchanged,
    most_steps: int = 100,
) -> tuple[Float, Float, Float, Mask]:
    """Return the parameters (n, p) that minimise the sums of squares of n problems, each with a damping of its own.

    `start` (n, p); `normal_equations`: takes parameters (m, p) and the indices of their problems (m,), and returns sums
    of squares (m,), J^T r (m, k) and J^T J (m, k, k): r is data minus model, J the model's derivatives; `is_small` (m,
    p) -> (m,): whether a step ends a problem; `step_of` (m, k) -> (m, p): the step of the parameters from the solution
    of the damped equations; `bounded` (m, p) -> (m, p): the nearest allowed parameters.  Returns also the sums of
    squares (n,), J^T J (n, k, k), and whether the last step was small (n,).
    """
    p = start.copy()
    cost, gradient, normal = normal_equations(p, np.arange(len(p)))
    damping = np.full(len(p), _FIRST_DAMPING)
    is_moving = np.ones(len(p), dtype=np.bool_)
    for _ in range(most_steps):
        k = np.flatnonzero(is_moving)
        if not k.size:
            break
        damped = normal[k]
        diagonal = np.einsum("nii->ni", damped)
        diagonal += damping[k, np.newaxis] * diagonal + _NOTHING
        step = step_of(np.asarray(np.linalg.solve(damped, gradient[k][..., np.newaxis])[..., 0], dtype=np.float64))
        trial = bounded(p[k] + step)
        trial_cost, trial_gradient, trial_normal = normal_equations(trial, k)
        better = trial_cost <= cost[k]
        improved = k[better]
        p[improved], cost[improved] = trial[better], trial_cost[better]
        gradient[improved], normal[improved] = trial_gradient[better], trial_normal[better]
        damping[k] = np.clip(np.where(better, damping[k] / 8, damping[k] * 6), _LEAST_DAMPING, _MOST_DAMPING)
        is_moving[k[is_small(step)]] = False
    return p, cost, normal, ~is_moving
