"""Analytic Jacobians against finite differences, and the minimisation that uses them."""

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.optimize import least_squares

from glstar.calibrate.identify.leastsquares import projection_jacobian
from glstar.calibrate.minimise import Minimum, minimise, minimise_each
from glstar.camera.distortion import Lens
from glstar.camera.model import Camera
from glstar.rotation import matrix_from_quaternion, quaternion_from_turn

DIRECTIONS = np.column_stack([np.random.default_rng(3).uniform(-0.5, 0.5, (40, 2)), np.ones(40)])


@pytest.mark.parametrize(
    "lens",
    [
        None,
        Lens("plumb_bob", (-0.2, 0.05, 0.001, -0.002, 0.01)),
        Lens("rational", (0.1, 0.02, 0.001, 0.002, 0.01, 0.2, 0.01, 0.02)),
        Lens("fisheye", (0.01, 0.02)),
    ],
    ids=lambda lens: "pinhole" if lens is None else lens.model,
)
def test_the_jacobian_agrees_with_finite_differences(lens: Lens | None) -> None:
    camera = Camera(1280, 960, 1000.0, 1010.0, 600.0, 470.0, 3.0, lens)

    def turned(turn: NDArray[np.float64]) -> NDArray[np.float64]:
        return camera.project(DIRECTIONS @ matrix_from_quaternion(quaternion_from_turn(turn)).T)

    bent, by_turn = projection_jacobian(camera, DIRECTIONS)
    numerical = np.stack([(turned(step) - turned(-step)) / 2e-5 for step in 1e-5 * np.eye(3)], axis=-1)
    assert bent @ camera.K[:2, :2].T + (600.0, 470.0) == pytest.approx(camera.project(DIRECTIONS), abs=1e-9)
    assert by_turn == pytest.approx(numerical, abs=1e-3)  # px/rad; the values are of the order of 1000


def test_a_large_rotation_is_found_from_a_distant_start() -> None:
    camera = Camera(1280, 960, 1000.0, 1000.0, 639.5, 479.5)
    there = matrix_from_quaternion(quaternion_from_turn([0.1, -0.15, 0.2]))
    wanted = camera.project(DIRECTIONS @ there.T)

    def measured(C: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        off = (camera.project(DIRECTIONS @ C.T) - wanted).ravel()
        return off, projection_jacobian(camera, DIRECTIONS @ C.T)[1].reshape(-1, 3)

    def moved(C: NDArray[np.float64], step: NDArray[np.float64]) -> NDArray[np.float64]:
        return np.asarray(matrix_from_quaternion(quaternion_from_turn(step)) @ C)

    found = minimise(np.eye(3), measured, moved, scale=1.0)
    assert found.state == pytest.approx(there, abs=1e-9)
    assert found.cost == pytest.approx(0, abs=1e-9)


def test_outliers_are_weighted_by_the_soft_l1_loss_of_scipy() -> None:
    off, scale = np.array([-30.0, -1.0, 0.0, 0.5, 4.0]), 2.0

    def cost(shift: float) -> float:
        return Minimum(None, off - shift, -np.ones((5, 1)), np.full(5, scale)).cost

    assert cost(0.0) == pytest.approx(0.5 * scale**2 * np.sum(2 * (np.sqrt(1 + (off / scale) ** 2) - 1)), rel=1e-12)
    found = minimise(0.0, lambda p: (off - p, -np.ones((5, 1))), lambda p, step: float(p + step[0]), scale=scale)
    assert found.cost == pytest.approx(min(cost(shift) for shift in np.linspace(-2, 2, 4001)), rel=1e-7)


def test_exact_residuals_are_not_softened() -> None:
    off = np.array([10.0, 0.0])
    scale = np.array([np.inf, np.inf])
    found = minimise(0.0, lambda p: (off - p, -np.ones((2, 1))), lambda p, step: float(p + step[0]), scale=scale)
    assert found.state == pytest.approx(5.0)
    assert found.information == pytest.approx(np.array([[2.0]]))


def test_an_unconstrained_parameter_keeps_its_value() -> None:
    def measured(p: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        return np.array([p[0] - 3, 2 * (p[0] - 3)]), np.array([[1.0, 0.0], [2.0, 0.0]])

    assert minimise(np.array([0.0, 7.0]), measured, np.add, scale=1.0).state == pytest.approx([3.0, 7.0])


def decay(p: NDArray[np.float64], seed: int = 0) -> NDArray[np.float64]:
    """Return residuals of an exponential decay with noise and two outliers."""
    t, rng = np.linspace(0, 4, 40), np.random.default_rng(seed)
    values = 5 * np.exp(-1.3 * t) + 0.7 + 0.05 * rng.standard_normal(40)
    values[[7, 30]] += 2.0
    return np.asarray(p[0] * np.exp(-p[1] * t) + p[2] - values)


def decay_jacobian(p: NDArray[np.float64]) -> NDArray[np.float64]:
    t = np.linspace(0, 4, 40)
    falling = np.exp(-p[1] * t)
    return np.column_stack([falling, -p[0] * t * falling, np.ones(40)])


def rosenbrock(p: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.array([10 * (p[1] - p[0] ** 2), 1 - p[0]])


def rosenbrock_jacobian(p: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.array([[-20 * p[0], 10.0], [-1.0, 0.0]])


ARC_RAD = np.linspace(0, 2.0, 25)
ARC = 3 * np.column_stack([np.cos(ARC_RAD), np.sin(ARC_RAD)]) + (1.0, -2.0)
ARC += 0.02 * np.random.default_rng(5).standard_normal((25, 2))


def circle(p: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return distances of the points of an arc from a circle of centre (x, y) and radius p."""
    return np.asarray(np.hypot(*(ARC - p[:2]).T) - p[2])


def circle_jacobian(p: NDArray[np.float64]) -> NDArray[np.float64]:
    away = ARC - p[:2]
    return np.column_stack([-away / np.hypot(*away.T)[:, np.newaxis], -np.ones(25)])


@pytest.mark.parametrize(
    ("residuals", "jacobian", "start", "scale"),
    [
        (decay, decay_jacobian, (1.0, 0.5, 0.0), np.inf),
        (decay, decay_jacobian, (1.0, 0.5, 0.0), 0.1),
        (decay, decay_jacobian, (9.0, 3.0, -2.0), 0.5),
        (rosenbrock, rosenbrock_jacobian, (-1.2, 1.0), np.inf),
        (circle, circle_jacobian, (0.0, 0.0, 1.0), np.inf),
    ],
    ids=["decay", "decay with outliers", "distant decay", "Rosenbrock", "circle"],
)
def test_the_minimum_is_that_of_scipy(residuals, jacobian, start, scale) -> None:
    soft = {} if np.isinf(scale) else {"loss": "soft_l1", "f_scale": scale}
    theirs = least_squares(residuals, start, jacobian, xtol=1e-14, ftol=1e-14, gtol=1e-14, **soft)

    ours = minimise(np.array(start), lambda p: (residuals(p), jacobian(p)), np.add, scale=scale)

    assert ours.cost == pytest.approx(theirs.cost, rel=1e-6, abs=1e-12)
    assert ours.state == pytest.approx(theirs.x, rel=2e-4, abs=2e-4)


def test_each_of_many_problems_has_the_minimum_of_scipy() -> None:
    starts = np.tile([1.0, 0.5, 0.0], (20, 1))

    def normal_equations(p: NDArray[np.float64], seeds: NDArray[np.intp]) -> tuple[NDArray[np.float64], ...]:
        r = np.array([-decay(one, seed) for one, seed in zip(p, seeds, strict=True)])
        J = np.array([decay_jacobian(one) for one in p])
        return np.einsum("np,np->n", r, r), np.einsum("npk,np->nk", J, r), np.einsum("npk,npl->nkl", J, J)

    p, cost, normal, converged = minimise_each(starts, normal_equations, lambda step: np.abs(step).max(axis=1) < 1e-9)

    def jacobian(p: NDArray[np.float64], _: int) -> NDArray[np.float64]:
        return decay_jacobian(p)

    theirs = [least_squares(decay, starts[0], jacobian, args=(seed,), xtol=1e-14, ftol=1e-14) for seed in range(20)]
    assert converged.all()
    assert p == pytest.approx(np.array([found.x for found in theirs]), rel=1e-5)
    assert cost == pytest.approx([2 * found.cost for found in theirs], rel=1e-9)
    assert normal == pytest.approx(np.array([found.jac.T @ found.jac for found in theirs]), rel=1e-5)


def test_bounds_hold_and_a_problem_without_a_small_step_has_not_converged() -> None:
    def normal_equations(p: NDArray[np.float64], _: NDArray[np.intp]) -> tuple[NDArray[np.float64], ...]:
        return ((p - 3) ** 2)[:, 0], 3 - p, np.ones((len(p), 1, 1))

    bounded = minimise_each(
        np.zeros((2, 1)), normal_equations, lambda step: np.abs(step[:, 0]) < 1e-6, bounded=lambda p: np.minimum(p, 2.0)
    )
    assert bounded[0] == pytest.approx(np.full((2, 1), 2.0))
    assert not bounded[3].any()
