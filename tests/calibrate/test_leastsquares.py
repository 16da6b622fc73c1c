"""Analytic Jacobians against finite differences, and the minimisation that uses them."""

import numpy as np
import pytest
from numpy.typing import NDArray

from glstar.calibrate.identify.leastsquares import Minimum, minimise, projection_jacobian
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

    bent, _, by_turn = projection_jacobian(camera, DIRECTIONS)
    numerical = np.stack([(turned(step) - turned(-step)) / 2e-5 for step in 1e-5 * np.eye(3)], axis=-1)
    assert bent @ camera.K[:2, :2].T + (600.0, 470.0) == pytest.approx(camera.project(DIRECTIONS), abs=1e-9)
    assert by_turn == pytest.approx(numerical, abs=1e-3)  # px/rad; the values are of the order of 1000


def test_a_large_rotation_is_found_from_a_distant_start() -> None:
    camera = Camera(1280, 960, 1000.0, 1000.0, 639.5, 479.5)
    there = matrix_from_quaternion(quaternion_from_turn([0.1, -0.15, 0.2]))
    wanted = camera.project(DIRECTIONS @ there.T)

    def measured(C: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        off = (camera.project(DIRECTIONS @ C.T) - wanted).ravel()
        return off, projection_jacobian(camera, DIRECTIONS @ C.T)[2].reshape(-1, 3)

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
