"""Rotation vectors, their time derivatives, and the angular rate of the body."""

from typing import Final

import numpy as np
from numpy.typing import NDArray

__all__ = ["angular_acceleration", "apply", "cubic", "rate_of_vector", "vector_of_rate"]

Float = NDArray[np.float64]

# Below this angle, rad, the closed forms lose digits by cancellation; three terms of the series are exact there.
_SERIES_RAD: Final = 0.1


def rate_of_vector(turn_rad: Float) -> Float:
    """Return the matrices from the time derivative of a rotation vector to the body rate.

    Parameters
    ----------
    turn_rad : (n, 3) float64
        Rotation vectors, rad.

    Returns
    -------
    (n, 3, 3) float64
    """
    angle = np.linalg.norm(turn_rad, axis=-1)
    cross = _cross(turn_rad)
    half = np.sinc(angle / (2 * np.pi)) ** 2 / 2
    matrix: Float = np.eye(3) - _scaled(half, cross) + _scaled(_third(angle), cross @ cross)
    return matrix


def vector_of_rate(turn_rad: Float) -> Float:
    """Return the matrices from the body rate to the time derivative of a rotation vector: the inverse of the above.

    Parameters
    ----------
    turn_rad : (n, 3) float64
        Rotation vectors, rad.

    Returns
    -------
    (n, 3, 3) float64
    """
    angle = np.linalg.norm(turn_rad, axis=-1)
    cross = _cross(turn_rad)
    small = angle < _SERIES_RAD
    safe = np.where(small, 1.0, angle)
    square = angle * angle
    factor = np.where(small, 1 / 12 + square / 720 + square**2 / 30240, (1 - safe / 2 / np.tan(safe / 2)) / safe**2)
    matrix: Float = np.eye(3) + cross / 2 + _scaled(factor, cross @ cross)
    return matrix


def angular_acceleration(turn_rad: Float, derivative: Float) -> Float:
    """Return the angular acceleration of a body whose rotation vector changes at a constant rate.

    Parameters
    ----------
    turn_rad : (n, 3) float64
        Rotation vectors, rad.
    derivative : (n, 3) float64
        Their time derivatives, rad/s.

    Returns
    -------
    (n, 3) float64
        Angular accelerations in body axes, rad/s^2.
    """
    angle = np.linalg.norm(turn_rad, axis=-1)
    small = angle < _SERIES_RAD
    x, square = np.where(small, 1.0, angle), angle * angle
    first = np.where(small, -1 / 12 + square / 180 - square**2 / 6720, (x * np.sin(x) + 2 * np.cos(x) - 2) / x**4)
    second = np.where(
        small, -1 / 60 + square / 1260 - square**2 / 60480, (3 * np.sin(x) - x * np.cos(x) - 2 * x) / x**5
    )
    along = np.sum(turn_rad * derivative, axis=-1)
    once = np.cross(turn_rad, derivative)
    acceleration: Float = (
        -(along * first)[:, np.newaxis] * once
        + (along * second)[:, np.newaxis] * np.cross(turn_rad, once)
        + _third(angle)[:, np.newaxis] * np.cross(derivative, once)
    )
    return acceleration


def cubic(step_s: Float, turn_rad: Float, begin: Float, end: Float) -> Float:
    """Return cubic polynomials for rotation vectors that start at zero, from their derivatives at both ends.

    Parameters
    ----------
    step_s : (n,) float64
        Length of each interval, s.
    turn_rad : (n, 3) float64
        Rotation vectors at the ends of the intervals, rad.
    begin, end : (n, 3) float64
        Time derivatives at the start and at the end, rad/s.

    Returns
    -------
    (n, 3, 3) float64
        Coefficients of time, its square and its cube: rad/s, rad/s^2, rad/s^3.
    """
    h = step_s[:, np.newaxis]
    mean = turn_rad / h
    return np.stack([begin, (3 * mean - 2 * begin - end) / h, (begin + end - 2 * mean) / h**2], axis=-2)


def apply(matrix: Float, vector: Float) -> Float:
    """Return (n, 3, 3) matrices times (n, 3) vectors."""
    product: Float = (matrix @ vector[..., np.newaxis])[..., 0]
    return product


def _third(angle: Float) -> Float:
    """Return (x - sin x) / x^3."""
    small = angle < _SERIES_RAD
    safe, square = np.where(small, 1.0, angle), angle * angle
    return np.where(small, 1 / 6 - square / 120 + square**2 / 5040, (safe - np.sin(safe)) / safe**3)


def _cross(v: Float) -> Float:
    """Return the skew-symmetric matrices of the cross product by each vector, (n, 3, 3)."""
    matrix = np.zeros((len(v), 3, 3))
    matrix[:, 0, 1], matrix[:, 0, 2], matrix[:, 1, 2] = -v[:, 2], v[:, 1], -v[:, 0]
    skew_symmetric: Float = matrix - matrix.transpose(0, 2, 1)
    return skew_symmetric


def _scaled(factor: Float, matrix: Float) -> Float:
    return factor[:, np.newaxis, np.newaxis] * matrix
