"""Rotation vectors that change, and how fast the body turns meanwhile."""

from typing import Final

import numpy as np
from numpy.typing import NDArray

__all__ = ["apply", "bend", "cubic", "rate_of_vector", "vector_of_rate"]

Float = NDArray[np.float64]

# Below this turn (rad) differences of sines lose digits, and three terms of their series are exact.
_SERIES_RAD: Final = 0.1


def rate_of_vector(turn_rad: Float) -> Float:
    """Return the matrices that make the body's rate of the change of its rotation vector.

    Parameters
    ----------
    turn_rad : (n, 3) float64
        The rotation vectors, rad.

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
    """Return the matrices that make the change of a rotation vector of the body's rate: the inverse of the other.

    Parameters
    ----------
    turn_rad : (n, 3) float64
        The rotation vectors, rad.

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


def bend(turn_rad: Float, change: Float) -> Float:
    """Return the angular acceleration of a body whose rotation vector changes evenly.

    Parameters
    ----------
    turn_rad : (n, 3) float64
        The rotation vectors, rad.
    change : (n, 3) float64
        How they change, rad/s.

    Returns
    -------
    (n, 3) float64
        rad/s^2.
    """
    angle = np.linalg.norm(turn_rad, axis=-1)
    small = angle < _SERIES_RAD
    x, square = np.where(small, 1.0, angle), angle * angle
    first = np.where(small, -1 / 12 + square / 180 - square**2 / 6720, (x * np.sin(x) + 2 * np.cos(x) - 2) / x**4)
    second = np.where(
        small, -1 / 60 + square / 1260 - square**2 / 60480, (3 * np.sin(x) - x * np.cos(x) - 2 * x) / x**5
    )
    along = np.sum(turn_rad * change, axis=-1)
    once = np.cross(turn_rad, change)
    bend: Float = (
        -(along * first)[:, np.newaxis] * once
        + (along * second)[:, np.newaxis] * np.cross(turn_rad, once)
        + _third(angle)[:, np.newaxis] * np.cross(change, once)
    )
    return bend


def cubic(step_s: Float, turn_rad: Float, begin: Float, end: Float) -> Float:
    """Return the cubic polynomials of rotation vectors that begin at none, with the given changes at both ends.

    Parameters
    ----------
    step_s : (n,) float64
        How long each lasts, s.
    turn_rad : (n, 3) float64
        The rotation vectors at the ends, rad.
    begin, end : (n, 3) float64
        How they change at the beginnings and at the ends, rad/s.

    Returns
    -------
    (n, 3, 3) float64
        The coefficients of time, its square and its cube; rad/s, rad/s^2, rad/s^3.
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
    """Return the (n, 3, 3) matrices of the cross product by each of some vectors."""
    matrix = np.zeros((len(v), 3, 3))
    matrix[:, 0, 1], matrix[:, 0, 2], matrix[:, 1, 2] = -v[:, 2], v[:, 1], -v[:, 0]
    skew: Float = matrix - matrix.transpose(0, 2, 1)
    return skew


def _scaled(factor: Float, matrix: Float) -> Float:
    return factor[:, np.newaxis, np.newaxis] * matrix
