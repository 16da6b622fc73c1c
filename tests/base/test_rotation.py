"""Rotations: eq. (30), quaternions, and interpolation between attitudes."""

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from glstar.rotation import (
    about_x,
    about_y,
    about_z,
    conjugate,
    euler_from_quaternion,
    matrix_from_euler,
    matrix_from_quaternion,
    multiply,
    quaternion_from_euler,
    quaternion_from_matrix,
    quaternion_from_turn,
    slerp,
    turn_between,
    turn_from_matrix,
    turn_from_quaternion,
)

ARCSEC = np.pi / 648000
DEG = np.pi / 180
FORWARD, RIGHT, DOWN = NORTH, EAST, _ = np.eye(3)
IDENTITY = np.array([1.0, 0.0, 0.0, 0.0])

many = settings(deadline=None, max_examples=200)
angles = st.floats(-np.pi, np.pi)
fractions = st.floats(0.0, 1.0)


@st.composite
def quaternions(draw: st.DrawFn) -> np.ndarray:
    """Any unit quaternion, of either sign."""
    q = np.array(draw(st.lists(st.floats(-1.0, 1.0), min_size=4, max_size=4)))
    length = np.linalg.norm(q)
    assume(length > 1e-3)
    return q / length


def turned_by(axis: int, angle_rad: float) -> np.ndarray:
    """The quaternion of a turn about one axis."""
    q = np.zeros(4)
    q[0], q[1 + axis] = np.cos(angle_rad / 2), np.sin(angle_rad / 2)
    return q


def between_rad(one: np.ndarray, other: np.ndarray) -> np.ndarray:
    """The angle between two attitudes, whatever the signs of their quaternions."""
    difference = multiply(one, conjugate(other))
    return 2 * np.arctan2(np.linalg.norm(difference[..., 1:], axis=-1), np.abs(difference[..., 0]))


@many
@given(angles, angles, angles)
def test_the_attitude_matrix_is_eq_30_letter_by_letter(p: float, q: float, r: float) -> None:
    s, c = np.sin, np.cos
    eq_30 = [
        [c(q) * c(r), c(q) * s(r), -s(q)],
        [-c(p) * s(r) + s(p) * s(q) * c(r), c(p) * c(r) + s(p) * s(q) * s(r), s(p) * c(q)],
        [s(p) * s(r) + c(p) * s(q) * c(r), -s(p) * c(r) + c(p) * s(q) * s(r), c(p) * c(q)],
    ]

    np.testing.assert_allclose(matrix_from_euler(p, q, r), eq_30, rtol=0, atol=1e-15)


def test_a_level_aircraft_heading_north_has_the_axes_of_north_east_down() -> None:
    np.testing.assert_array_equal(matrix_from_euler(0.0, 0.0, 0.0), np.eye(3))
    np.testing.assert_array_equal(np.abs(quaternion_from_euler(0.0, 0.0, 0.0)), IDENTITY)


def test_at_a_yaw_of_90_degrees_forward_is_east() -> None:
    # As ArduPilot and PX4 count it: yaw from north through east.
    C_ned_body = matrix_from_euler(0.0, 0.0, 90 * DEG).T

    np.testing.assert_allclose(C_ned_body @ FORWARD, EAST, rtol=0, atol=1e-15)
    np.testing.assert_allclose(C_ned_body @ RIGHT, -NORTH, rtol=0, atol=1e-15)


def test_a_positive_pitch_raises_the_nose() -> None:
    C_ned_body = matrix_from_euler(0.0, 30 * DEG, 0.0).T

    np.testing.assert_allclose(C_ned_body @ FORWARD, [np.cos(30 * DEG), 0.0, -np.sin(30 * DEG)], rtol=0, atol=1e-15)


def test_a_positive_roll_lowers_the_right_wing() -> None:
    C_ned_body = matrix_from_euler(30 * DEG, 0.0, 0.0).T

    np.testing.assert_allclose(C_ned_body @ RIGHT, [0.0, np.cos(30 * DEG), np.sin(30 * DEG)], rtol=0, atol=1e-15)


def test_an_autopilots_quaternion_turns_body_into_ned_and_ours_is_its_conjugate() -> None:
    # ArduPilot and PX4 log (cos yaw/2, 0, 0, sin yaw/2) for a yaw: body to NED.
    logged = np.array([np.cos(45 * DEG), 0.0, 0.0, np.sin(45 * DEG)])

    np.testing.assert_allclose(matrix_from_quaternion(logged) @ FORWARD, EAST, rtol=0, atol=1e-15)
    np.testing.assert_allclose(
        between_rad(conjugate(logged), quaternion_from_euler(0.0, 0.0, 90 * DEG)), 0, rtol=0, atol=1e-15
    )


@pytest.mark.parametrize(("about", "axis"), [(about_x, 0), (about_y, 1), (about_z, 2)])
def test_the_elementary_rotations_turn_the_axes_right_handedly(about, axis: int) -> None:
    first, second = np.eye(3)[(axis + 1) % 3], np.eye(3)[(axis + 2) % 3]

    # The axes turn by +90 deg: what lay along the second axis now lies along the first one's new place.
    np.testing.assert_allclose(about(90 * DEG) @ second, first, rtol=0, atol=1e-15)
    np.testing.assert_allclose(about(90 * DEG) @ np.eye(3)[axis], np.eye(3)[axis], rtol=0, atol=1e-15)


@many
@given(angles, angles, angles)
def test_euler_angles_give_the_same_attitude_as_matrix_and_as_quaternion(p: float, q: float, r: float) -> None:
    np.testing.assert_allclose(
        matrix_from_quaternion(quaternion_from_euler(p, q, r)), matrix_from_euler(p, q, r), rtol=0, atol=1e-14
    )


@many
@given(quaternions())
def test_the_quaternion_of_a_matrix_is_the_one_it_was_computed_from(q: np.ndarray) -> None:
    C = matrix_from_quaternion(q)
    back = quaternion_from_matrix(C)

    assert back[0] >= 0
    assert np.linalg.norm(back) == pytest.approx(1.0, abs=1e-14)
    assert between_rad(back, q) < 1e-13
    np.testing.assert_allclose(C @ C.T, np.eye(3), rtol=0, atol=1e-14)
    assert np.linalg.det(C) == pytest.approx(1.0)


@pytest.mark.parametrize("axis", [0, 1, 2])
@pytest.mark.parametrize("angle_deg", [0.0, 1e-6, 90.0, 179.999999, 180.0, -180.0])
def test_the_quaternion_of_a_matrix_is_right_at_180_degrees(axis: int, angle_deg: float) -> None:
    q = turned_by(axis, angle_deg * DEG)

    assert between_rad(quaternion_from_matrix(matrix_from_quaternion(q)), q) < 1e-13


@many
@given(quaternions())
def test_a_matrix_and_its_quaternion_have_the_same_rotation_vector(q: np.ndarray) -> None:
    turn_rad = turn_from_quaternion(q)
    assume(np.linalg.norm(turn_rad) < 3.1)

    several = np.stack([matrix_from_quaternion(q), np.eye(3)])
    np.testing.assert_allclose(turn_from_matrix(several), [turn_rad, np.zeros(3)], rtol=0, atol=1e-12)


@many
@given(quaternions(), quaternions())
def test_a_product_of_quaternions_is_the_product_of_their_matrices(q_c_b: np.ndarray, q_b_a: np.ndarray) -> None:
    C_c_a = matrix_from_quaternion(q_c_b) @ matrix_from_quaternion(q_b_a)

    np.testing.assert_allclose(matrix_from_quaternion(multiply(q_c_b, q_b_a)), C_c_a, rtol=0, atol=1e-14)


@many
@given(quaternions(), st.lists(st.floats(-1.0, 1.0), min_size=3, max_size=3))
def test_a_quaternion_rotates_a_vector_as_q_v_q_star(q: np.ndarray, v: list[float]) -> None:
    turned = multiply(multiply(q, np.array([0.0, *v])), conjugate(q))

    np.testing.assert_allclose(turned[1:], matrix_from_quaternion(q) @ v, rtol=0, atol=1e-14)


@many
@given(quaternions(), quaternions())
def test_the_turn_between_two_attitudes_rotates_the_first_to_the_second(q1: np.ndarray, q2: np.ndarray) -> None:
    turn_rad = turn_between(q1, q2)

    assert np.linalg.norm(turn_rad) == pytest.approx(between_rad(q1, q2), abs=1e-9)
    assert between_rad(multiply(quaternion_from_turn(turn_rad), q1), q2) == pytest.approx(0.0, abs=1e-9)


@many
@given(quaternions())
def test_the_conjugate_is_the_inverse_rotation(q: np.ndarray) -> None:
    np.testing.assert_allclose(multiply(q, conjugate(q)), IDENTITY, rtol=0, atol=1e-15)
    np.testing.assert_allclose(matrix_from_quaternion(conjugate(q)), matrix_from_quaternion(q).T, rtol=0, atol=1e-15)


def test_rotations_are_computed_for_arrays() -> None:
    q = quaternion_from_euler(np.zeros((4, 5)), 0.1, np.linspace(0, 1, 5))

    assert q.shape == (4, 5, 4)
    assert matrix_from_quaternion(q).shape == (4, 5, 3, 3)
    assert matrix_from_euler(np.zeros((4, 5)), 0.1, 0.0).shape == (4, 5, 3, 3)
    assert multiply(q, IDENTITY).shape == conjugate(q).shape == slerp(q, q, np.full((4, 5), 0.5)).shape == (4, 5, 4)


@many
@given(quaternions(), quaternions())
def test_slerp_begins_and_ends_at_its_ends(q1: np.ndarray, q2: np.ndarray) -> None:
    assert between_rad(slerp(q1, q2, 0.0), q1) < 1e-7 * ARCSEC
    assert between_rad(slerp(q1, q2, 1.0), q2) < 1e-7 * ARCSEC


@many
@given(quaternions(), quaternions(), fractions)
def test_slerp_does_not_depend_on_the_sign_of_a_quaternion(q1: np.ndarray, q2: np.ndarray, u: float) -> None:
    assume(abs(q1 @ q2) > 1e-6)  # at 180 deg both arcs have the same length
    for sign1, sign2 in ((-1, 1), (1, -1), (-1, -1)):
        assert between_rad(slerp(sign1 * q1, sign2 * q2, u), slerp(q1, q2, u)) < 1e-5 * ARCSEC


def test_slerp_takes_the_shorter_arc_across_a_sign_change() -> None:
    # Eq. (41) as printed is 180 deg wrong here.
    q1, q2 = turned_by(2, 10 * DEG), -turned_by(2, 12 * DEG)

    assert between_rad(slerp(q1, q2, 0.5), turned_by(2, 11 * DEG)) < 1e-7 * ARCSEC


@many
@given(quaternions(), quaternions(), fractions)
def test_slerp_turns_at_a_constant_rate_along_the_shorter_arc(q1: np.ndarray, q2: np.ndarray, u: float) -> None:
    whole = between_rad(q1, q2)
    q = slerp(q1, q2, u)

    assert np.linalg.norm(q) == pytest.approx(1.0, abs=1e-15)
    assert between_rad(q1, q) == pytest.approx(u * whole, abs=1e-7 * ARCSEC)
    assert between_rad(q, q2) == pytest.approx((1 - u) * whole, abs=1e-7 * ARCSEC)


@pytest.mark.parametrize("angle_rad", [0.0, 1e-300, 1e-15, 1e-12, 0.9e-8, 1.1e-8, 1e-6, 1e-3])
@pytest.mark.parametrize("u", [0.0, 0.25, 0.5, 1.0])
def test_slerp_keeps_its_digits_at_small_angles(angle_rad: float, u: float) -> None:
    q = slerp(IDENTITY, turned_by(0, angle_rad), u)

    np.testing.assert_allclose(q, turned_by(0, u * angle_rad), atol=1e-16, rtol=1e-15)


@pytest.mark.parametrize("axis", [0, 1, 2])
@pytest.mark.parametrize("angle_deg", [179.9999, 180.0])
def test_slerp_takes_one_of_the_two_arcs_at_180_degrees(axis: int, angle_deg: float) -> None:
    q = slerp(IDENTITY, turned_by(axis, angle_deg * DEG), np.array([0.0, 0.25, 0.5, 0.75, 1.0]))

    np.testing.assert_allclose(
        between_rad(q, IDENTITY), np.array([0, 0.25, 0.5, 0.75, 1]) * angle_deg * DEG, rtol=0, atol=1e-9
    )


def test_slerp_agrees_with_scipy() -> None:
    transform = pytest.importorskip("scipy.spatial.transform")
    random = np.random.default_rng(41)
    u = np.linspace(0.0, 1.0, 11)
    for _ in range(50):
        q1, q2 = (q / np.linalg.norm(q) for q in random.normal(size=(2, 4)))
        rotations = transform.Rotation.from_quat(np.roll([q1, q2], -1, axis=-1))
        expected = np.roll(transform.Slerp([0.0, 1.0], rotations)(u).as_quat(), 1, axis=-1)
        assert between_rad(slerp(q1, q2, u), expected).max() < 1e-7 * ARCSEC


def test_matrices_and_quaternions_agree_with_scipy() -> None:
    transform = pytest.importorskip("scipy.spatial.transform")
    roll, pitch, yaw = np.random.default_rng(30).uniform(-np.pi, np.pi, (3, 50))
    body_to_ned = transform.Rotation.from_euler("ZYX", np.stack([yaw, pitch, roll], axis=-1))

    np.testing.assert_allclose(matrix_from_euler(roll, pitch, yaw), body_to_ned.inv().as_matrix(), rtol=0, atol=1e-14)
    expected = np.roll(body_to_ned.inv().as_quat(), 1, axis=-1)
    assert between_rad(quaternion_from_euler(roll, pitch, yaw), expected).max() < 1e-13


@many
@given(st.floats(-179, 179), st.floats(-89, 89), st.floats(-179, 179))
def test_euler_angles_are_the_inverse_of_their_quaternion(roll_deg: float, pitch_deg: float, yaw_deg: float) -> None:
    angles = np.deg2rad([roll_deg, pitch_deg, yaw_deg])
    for sign in (1, -1):
        found = np.array(euler_from_quaternion(sign * quaternion_from_euler(*angles)))
        np.testing.assert_allclose((found - angles + np.pi) % (2 * np.pi), np.pi, rtol=0, atol=1e-9)
