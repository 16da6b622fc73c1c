"""Rotations of coordinates: matrices, quaternions and Euler angles.

Names end in the target frame and the source frame; in a product, the inner frames cancel::

    C_camera_ned = C_camera_body @ C_body_ned
    q_camera_ned = multiply(q_camera_body, q_body_ned)

A matrix `C_to_from` transforms the components of a vector from one frame to another.  A quaternion `q_to_from` is
(w, x, y, z) and represents the same rotation: ``v_to = q v_from q*``.  Autopilots log the opposite direction (body to
NED): glstar's `q_body_ned` is the conjugate of the logged quaternion.
"""

import numpy as np
from numpy.typing import ArrayLike, NDArray

Float = NDArray[np.float64]

# Below this angle between two quaternions, rad, slerp is linear: its sines lose digits, and the difference is below
# the resolution of float64.
_LINEAR_RAD = 1e-8


def about_x(angle_rad: ArrayLike) -> Float:
    """Return R1, the coordinate transformations, (..., 3, 3), for right-handed rotations of the axes about x."""
    c, s, zero, one = _cosine_sine(angle_rad)
    return _stack([[one, zero, zero], [zero, c, s], [zero, -s, c]])


def about_y(angle_rad: ArrayLike) -> Float:
    """Return R2, the coordinate transformations, (..., 3, 3), for right-handed rotations of the axes about y."""
    c, s, zero, one = _cosine_sine(angle_rad)
    return _stack([[c, zero, -s], [zero, one, zero], [s, zero, c]])


def about_z(angle_rad: ArrayLike) -> Float:
    """Return R3, the coordinate transformations, (..., 3, 3), for right-handed rotations of the axes about z."""
    angle = np.asarray(angle_rad, dtype=np.float64)
    C = np.zeros((*angle.shape, 3, 3))
    # Every scene needs hundreds of them.
    C[..., 0, 0] = C[..., 1, 1] = np.cos(angle)
    C[..., 0, 1] = sine = np.sin(angle)
    C[..., 1, 0] = -sine
    C[..., 2, 2] = 1.0
    return C


def matrix_from_euler(roll_rad: ArrayLike, pitch_rad: ArrayLike, yaw_rad: ArrayLike) -> Float:
    """Return C_body_ned, (..., 3, 3), of aerospace Euler angles, (...): yaw, then pitch, then roll.

    Teague & Chahl, eq. (30) = R1(roll) R2(pitch) R3(yaw).
    """
    return about_x(roll_rad) @ about_y(pitch_rad) @ about_z(yaw_rad)


def quaternion_from_euler(roll_rad: ArrayLike, pitch_rad: ArrayLike, yaw_rad: ArrayLike) -> Float:
    """Return q_body_ned, (..., 4), of aerospace Euler angles, (...): the quaternion of Teague & Chahl, eq. (30)."""
    half = [np.asarray(angle, dtype=np.float64) / 2 for angle in np.broadcast_arrays(roll_rad, pitch_rad, yaw_rad)]
    (cr, cp, cy), (sr, sp, sy) = (np.cos(angle) for angle in half), (np.sin(angle) for angle in half)
    q_ned_body = np.stack(
        [
            cr * cp * cy + sr * sp * sy,
            sr * cp * cy - cr * sp * sy,
            cr * sp * cy + sr * cp * sy,
            cr * cp * sy - sr * sp * cy,
        ],
        axis=-1,
    )
    return conjugate(q_ned_body)


def euler_from_quaternion(q_body_ned: ArrayLike) -> tuple[Float, Float, Float]:
    """Return roll and yaw, -pi to pi, and pitch, -pi/2 to pi/2, of attitudes, (..., 4), in the order roll, pitch, yaw.

    At a pitch of +-pi/2 only the difference or the sum of roll and yaw is defined.
    """
    w, x, y, z = np.moveaxis(conjugate(q_body_ned), -1, 0)
    return (
        np.arctan2(2 * (w * x + y * z), 1 - 2 * (x * x + y * y)),
        np.arcsin(np.clip(2 * (w * y - z * x), -1, 1)),
        np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z)),
    )


def matrix_from_quaternion(q: ArrayLike) -> Float:
    """Return the matrices of unit quaternions, (..., 4): C_to_from, (..., 3, 3), of q_to_from."""
    q = np.asarray(q, dtype=np.float64)
    # One product of matrices for all quaternions, because a scene needs hundreds of them.
    doubled = 2 * q[..., :, np.newaxis] * q[..., np.newaxis, :]
    C: Float = doubled.reshape(*q.shape[:-1], 16) @ _MATRIX_OF_PRODUCTS
    C[..., ::4] += 1  # the diagonal
    return C.reshape(*q.shape[:-1], 3, 3)


def _matrix_of_products() -> Float:
    """Return the linear map from the doubled products ww, wx, ... of a quaternion to C - I, (16, 9)."""
    w, x, y, z = np.eye(4)
    wx, wy, wz, xy, xz, yz = (np.outer(a, b) for a, b in ((w, x), (w, y), (w, z), (x, y), (x, z), (y, z)))
    xx, yy, zz = np.outer(x, x), np.outer(y, y), np.outer(z, z)
    rows = [[-yy - zz, xy - wz, xz + wy], [xy + wz, -xx - zz, yz - wx], [xz - wy, yz + wx, -xx - yy]]
    return np.ascontiguousarray(np.reshape(rows, (9, 16)).T)


_MATRIX_OF_PRODUCTS = _matrix_of_products()


def quaternion_from_matrix(C: ArrayLike) -> Float:
    """Return the unit quaternion of one rotation matrix, w >= 0: q_to_from, (4,), of C_to_from, (3, 3)."""
    C = np.asarray(C, dtype=np.float64)
    # Bar-Itzhack's symmetric matrix: its eigenvector of the largest eigenvalue is the quaternion, whatever the angle.
    skew = np.array([C[2, 1] - C[1, 2], C[0, 2] - C[2, 0], C[1, 0] - C[0, 1]])
    symmetric = np.empty((4, 4))
    symmetric[0, 0] = np.trace(C)
    symmetric[0, 1:] = symmetric[1:, 0] = skew
    symmetric[1:, 1:] = C + C.T - np.trace(C) * np.eye(3)
    q: Float = np.linalg.eigh(symmetric)[1][:, -1]
    return -q if q[0] < 0 else q


def quaternion_from_turn(turn_rad: ArrayLike) -> Float:
    """Return q_to_from, (..., 4), for rotations of the axes by rotation vectors.

    `turn_rad` (..., 3): the axis times the angle, right-handed; the same three numbers in both frames.
    """
    turn = np.asarray(turn_rad, dtype=np.float64)
    x, y, z = turn[..., 0], turn[..., 1], turn[..., 2]
    half = np.sqrt(x * x + y * y + z * z) / 2
    q = np.empty((*turn.shape[:-1], 4))
    q[..., 0] = np.cos(half)
    q[..., 1:] = turn * (-np.sinc(half / np.pi) / 2)[..., np.newaxis]
    return q


def turn_from_quaternion(q: ArrayLike) -> Float:
    """Return rotation vectors, (..., 3), of quaternions of either sign, by the smaller angle, at most pi.

    The inverse of `quaternion_from_turn`.
    """
    q = np.asarray(q, dtype=np.float64)
    w, sine = q[..., 0], np.linalg.norm(q[..., 1:], axis=-1)
    half = np.arctan2(sine, np.abs(w))  # keeps its digits at small angles, where arccos has none
    # The angle divided by the sine of its half; 2 at an angle of 0.
    scale = np.copysign(2 / np.sinc(half / np.pi) / np.hypot(w, sine), -w)
    return np.asarray(scale[..., np.newaxis] * q[..., 1:])


def turn_from_matrix(C: ArrayLike) -> Float:
    """Return rotation vectors, (..., 3), of matrices C_to_from, (..., 3, 3).

    The rotations are by less than 180 deg, at which the axis is ambiguous.
    """
    C = np.asarray(C, dtype=np.float64)
    twice_sine = (C - np.swapaxes(C, -1, -2))[..., [1, 2, 0], [2, 0, 1]]
    angle = np.arctan2(np.linalg.norm(twice_sine, axis=-1), np.trace(C, axis1=-2, axis2=-1) - 1)
    return np.asarray(twice_sine / (2 * np.sinc(angle / np.pi))[..., np.newaxis])


def fitted_rotation(from_unit: Float, to_unit: Float) -> Float:
    """Return the least-squares rotation C, (3, 3), with to = C from, between two sets of unit vectors, (n, 3).

    Wahba's problem by singular value decomposition (Markley 1988).
    """
    u, _, vt = np.linalg.svd(to_unit.T @ from_unit)
    return np.asarray(u @ np.diag([1.0, 1.0, np.linalg.det(u) * np.linalg.det(vt)]) @ vt)


def turn_between(q1: ArrayLike, q2: ArrayLike) -> Float:
    """Return rotation vectors, (..., 3), from attitudes `q1` to `q2`, (..., 4), by the smaller angle.

    The quaternions q_to_from, of either sign, have the same source frame; the vectors are in the target frame (body for
    ``q_body_ned``).
    """
    return turn_from_quaternion(multiply(q2, conjugate(q1)))


def multiply(q_c_b: ArrayLike, q_b_a: ArrayLike) -> Float:
    """Return the products of quaternions, (..., 4): q_c_a of q_c_b and q_b_a."""
    a, b, c, d = np.moveaxis(np.asarray(q_c_b, dtype=np.float64), -1, 0)
    w, x, y, z = np.moveaxis(np.asarray(q_b_a, dtype=np.float64), -1, 0)
    return np.stack(
        [
            a * w - b * x - c * y - d * z,
            a * x + b * w + c * z - d * y,
            a * y - b * z + c * w + d * x,
            a * z + b * y - c * x + d * w,
        ],
        axis=-1,
    )


def conjugate(q: ArrayLike) -> Float:
    """Return the conjugates, (..., 4), which are the inverse rotations: q_from_to of q_to_from."""
    return np.asarray(np.asarray(q, dtype=np.float64) * np.array([1.0, -1.0, -1.0, -1.0]))


def slerp(q1: ArrayLike, q2: ArrayLike, u: ArrayLike) -> Float:
    """Interpolate between two quaternions along the shorter arc (spherical linear interpolation).

    `q1`, `q2` (..., 4): unit quaternions; `u` (...): fractions of the arc, 0 at `q1` and 1 at `q2`.

    Teague & Chahl, eq. (41).  Departs from eq. (41): q2 is negated if q1 . q2 < 0, because q and -q are the same
    attitude and a log may alternate between them.  Otherwise the interpolation would take the longer arc, with an error
    of 180 deg in its middle.
    """
    q1, q2 = np.asarray(q1, dtype=np.float64), np.asarray(q2, dtype=np.float64)
    u = np.asarray(u, dtype=np.float64)
    opposed = _dot(q1, q2) < 0
    if np.count_nonzero(opposed):
        q2 = np.where(opposed[..., np.newaxis], -q2, q2)
    # atan2 of the chord and the sum keeps its digits at small angles, where arccos has none.
    chord, total = q2 - q1, q2 + q1
    angle = 2 * np.arctan2(np.sqrt(_dot(chord, chord)), np.sqrt(_dot(total, total)))
    first, second, sine = np.sin((1 - u) * angle), np.sin(u * angle), np.sin(angle)
    linear = angle < _LINEAR_RAD
    if np.count_nonzero(linear):
        first = np.where(linear, 1 - u, first)
        second = np.where(linear, u, second)
        sine = np.where(linear, 1, sine)
    first, second = first / sine, second / sine
    q: Float = first[..., np.newaxis] * q1 + second[..., np.newaxis] * q2
    q /= np.sqrt(_dot(q, q))[..., np.newaxis]
    return q


def _dot(q1: Float, q2: Float) -> Float:
    """Return the dot products of pairs of quaternions, (...); `np.sum` over an axis of 4 takes three times as long."""
    products = q1 * q2
    return np.asarray(products[..., 0] + products[..., 1] + products[..., 2] + products[..., 3])


def _cosine_sine(angle_rad: ArrayLike) -> tuple[Float, Float, Float, Float]:
    """Return the cosines and sines of angles, zeros and ones."""
    angle = np.asarray(angle_rad, dtype=np.float64)
    return np.cos(angle), np.sin(angle), np.zeros_like(angle), np.ones_like(angle)


def _stack(rows: list[list[Float]]) -> Float:
    """Return the matrices, (..., 3, 3), of entries, (...)."""
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)
