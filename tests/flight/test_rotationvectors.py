"""Rates and accelerations of rotation vectors against SciPy's rotations, differentiated numerically."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from glstar.flight.gyroaided import gyro_aided
from glstar.flight.spline import angular_acceleration, cubic, rate_of_vector, vector_of_rate
from glstar.rotation import quaternion_from_turn, turn_between

# Angles of rotation vectors, rad, on both sides of 0.1, below which series are used.
ANGLES = (0.0, 1e-6, 0.03, 0.0999, 0.1001, 0.5, 1.5, 3.0)


def vectors(angle_rad: float) -> tuple[np.ndarray, np.ndarray]:
    """Return rotation vectors of some angle, and derivatives, (20, 3)."""
    rng = np.random.default_rng(5)
    turns = rng.normal(size=(20, 3))
    return angle_rad * turns / np.linalg.norm(turns, axis=-1, keepdims=True), rng.normal(size=(20, 3))


def body_rate(turn: np.ndarray, derivative: np.ndarray, step: float = 1e-5) -> np.ndarray:
    """Return the rate about the body's axes: frames turn by the rotation vector, so a body's own is on the right."""
    before, after = (Rotation.from_rotvec(turn + sign * step * derivative) for sign in (-1, 1))
    return (before.inv() * after).as_rotvec() / (2 * step)


@pytest.mark.parametrize("angle_rad", ANGLES)
def test_rates_of_rotation_vectors_and_back(angle_rad: float) -> None:
    turn, derivative = vectors(angle_rad)
    rate = body_rate(turn, derivative)
    np.testing.assert_allclose((rate_of_vector(turn) @ derivative[..., None])[..., 0], rate, rtol=0, atol=1e-8)
    np.testing.assert_allclose((vector_of_rate(turn) @ rate[..., None])[..., 0], derivative, rtol=0, atol=1e-8)


@pytest.mark.parametrize("angle_rad", ANGLES)
def test_the_acceleration_of_a_steadily_changing_rotation_vector(angle_rad: float) -> None:
    turn, derivative = vectors(angle_rad)
    step = 1e-4
    ends = [(rate_of_vector(turn + s * step * derivative) @ derivative[..., None])[..., 0] for s in (-1, 1)]
    np.testing.assert_allclose(
        angular_acceleration(turn, derivative), (ends[1] - ends[0]) / (2 * step), rtol=0, atol=1e-7
    )


@pytest.mark.parametrize("angle_rad", [0.02, 0.0999])
def test_the_series_of_small_angles_are_exact_to_rounding(angle_rad: float) -> None:
    turn, _ = vectors(angle_rad)
    inverse = np.linalg.inv(rate_of_vector(turn))
    np.testing.assert_allclose(vector_of_rate(turn), inverse, rtol=0, atol=2e-12)


def test_a_cubic_has_the_end_and_the_slopes_asked_for() -> None:
    rng = np.random.default_rng(2)
    step, end, first, last = rng.uniform(0.1, 2, 5), *rng.normal(size=(3, 5, 3))
    c = cubic(step, end, first, last)
    h = step[:, np.newaxis]
    np.testing.assert_allclose(c[:, 0] * h + c[:, 1] * h**2 + c[:, 2] * h**3, end, rtol=0, atol=1e-12)
    np.testing.assert_allclose(c[:, 0], first, rtol=0, atol=1e-12)
    np.testing.assert_allclose(c[:, 0] + 2 * c[:, 1] * h + 3 * c[:, 2] * h**2, last, rtol=0, atol=1e-12)


def test_the_curve_has_the_rates_of_the_gyros_and_of_their_drift_at_its_samples() -> None:
    # A body that turns at a steady rate about all axes, and gyros with a constant error of one of them.
    rate, error = np.array([0.3, -0.5, 0.8]), np.array([0.0, 0.02, 0.0])
    t, rate_t = np.arange(0, 4, 0.5), np.arange(0, 4, 0.05)
    q = quaternion_from_turn(t[:, np.newaxis] * rate)
    readings = np.broadcast_to(rate + error, (rate_t.size, 3))
    curve = gyro_aided(t, q, rate_t, readings)
    assert curve.t_s.size > 2 * t.size
    # Both sides of a sample have the rate of the body, to the square of the error's turn in an interval.
    for begin_s, end_s in ((-2e-5, -1e-5), (1e-5, 2e-5)):
        begin, end = (curve.at(curve.t_s[20:40] + side_s) for side_s in (begin_s, end_s))
        found = turn_between(begin, end) / 1e-5
        np.testing.assert_allclose(found, np.broadcast_to(rate, found.shape), rtol=0, atol=0.005)
