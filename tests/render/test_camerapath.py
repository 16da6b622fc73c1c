"""The path of the camera and its division into pieces, by positions and means at many times."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from glstar.render.motion.pointing import Pointing
from glstar.render.motion.starpaths import end_weights, probe_rays
from glstar.render.motion.trailmodels import (
    SAMPLE_SPACING_SIGMA,
    AnalyticSegments,
    CameraPath,
    SubExposureRule,
    SubExposures,
    _interpolated,
    _px_per_turn,
    _Quadrature,
)
from tests.support.scenes import camera

LENS = camera(300, 200, 400.0)
MARKS = np.array([0.0, 0.2, 0.5, 1.0])
DIRECTIONS = LENS.unit_vectors([(40, 30), (250, 20), (150, 100), (20, 180)])


def turning(t: np.ndarray) -> Pointing:
    turns = np.column_stack([0.02 * t, 0.05 * t**2, 0.03 * np.sin(2 * t)])
    zenith = np.column_stack([0.1 * t, 0.3 - 0.2 * t, 1 + 0 * t])
    return Pointing(Rotation.from_rotvec(turns).as_matrix(), zenith, np.column_stack([t, -t, 2 * t]) * 1e-6, 0.0)


def trails() -> AnalyticSegments:
    """Return three segments of different lengths, during which the camera turns by 1.5 deg and more."""
    times = np.interp(np.arange(7) / 2, np.arange(4), MARKS)
    return AnalyticSegments(turning(times), np.diff(MARKS))


def orientation(number: float) -> np.ndarray:
    """Return the drawn orientation at a number of segments, times its factor."""
    one, segment = trails(), min(int(number), 2)
    start, middle, end = one.pointing.C_camera_eq[2 * segment : 2 * segment + 3]
    weight = end_weights(start[np.newaxis], end[np.newaxis])[0]
    angle = np.arctan(np.sqrt(weight - 1))
    u = (1 + np.tan((2 * (number - segment) - 1) * angle) / np.tan(angle)) / 2
    return 2 * (u - 0.5) * (u - 1) * weight * start + 4 * u * (1 - u) * middle + 2 * u * (u - 0.5) * weight * end


def dense(begin: float, end: float, count: int = 100) -> tuple[np.ndarray, np.ndarray]:
    """Return orientations at even times between two numbers of segments, and the segment of each."""
    at_s = np.interp([begin, end], np.arange(4), MARKS)
    times = at_s[0] + (np.arange(count) + 0.5) / count * (at_s[1] - at_s[0])
    numbers = np.interp(times, MARKS, np.arange(4))
    return np.array([orientation(number) for number in numbers]), numbers.astype(int)


def test_segments_say_when_they_end_how_long_they_are_and_how_long_trails_are() -> None:
    one = trails()
    assert len(one) == 3
    np.testing.assert_allclose(one.marks, MARKS, rtol=0, atol=1e-12)
    np.testing.assert_allclose(one.half_fractions(1.2), [0.12, 0.12, 0.18, 0.18, 0.3, 0.3], rtol=1e-12)
    halves = np.array([0.1, 0.1, 0.2, 0.1, 0.3, 0.2])
    assert replace(one, half_fraction=halves).half_fractions(1.2) is halves
    C = one.pointing.C_camera_eq
    np.testing.assert_allclose(one.end_weight, end_weights(C[[0, 2, 4]], C[[2, 4, 6]]), rtol=1e-12)
    turned = Rotation.from_matrix(C)
    steps = np.array([(turned[k + 1] * turned[k].inv()).magnitude() for k in range(6)])
    assert one.longest_trail_px(LENS) == pytest.approx(steps.sum() * LENS.max_px_per_rad, rel=1e-9)
    longest = (steps[::2] + steps[1::2]).max() * LENS.max_px_per_rad
    assert one.longest_segment_px(LENS) == pytest.approx(longest, rel=1e-9)


def test_positions_of_segments_are_those_of_the_drawn_orientation_at_any_time() -> None:
    times = np.array([0.0, 0.1, 0.2, 0.35, 0.5, 0.9, 1.0])
    found = trails().positions(LENS, DIRECTIONS, times)
    numbers = np.interp(times, MARKS, np.arange(4))
    expected = [LENS.project(DIRECTIONS @ orientation(number).T) for number in numbers]
    np.testing.assert_allclose(found, expected, rtol=0, atol=2e-3)
    (paths,) = trails().star_paths(LENS, DIRECTIONS, 1.7)
    assert paths.spacing_px == pytest.approx(1.5 * 1.7)
    assert SAMPLE_SPACING_SIGMA == 1.5
    np.testing.assert_allclose(paths.time_fraction, np.diff(MARKS), rtol=1e-12)


@pytest.mark.parametrize(("minimum", "spacing", "trail", "count"), [
    (20, 1.6, 100.0, 63), (20, 1.6, 31.9, 20), (20, 1.6, 32.1, 21), (7, 2.0, 14.0, 7), (7, 2.0, 16.0, 8),
])  # fmt: skip
def test_sub_exposures_are_as_many_as_their_spacing_needs(
    minimum: int, spacing: float, trail: float, count: int
) -> None:
    assert SubExposureRule(minimum, spacing).count(trail) == count


def test_stars_rest_in_sub_exposures_of_equal_length() -> None:
    one = SubExposures(turning(np.arange(5) / 5))
    found = list(one.star_paths(LENS, DIRECTIONS, 1.0))
    assert [part.is_at_rest for part in found] == [True]
    np.testing.assert_allclose(found[0].time_fraction, np.full(5, 0.2), rtol=1e-12)
    expected = LENS.project(one.pointing.to_camera(DIRECTIONS))
    np.testing.assert_allclose(np.moveaxis(found[0].xy_px, 0, -1), expected, rtol=1e-12)
    many = list(SubExposures(turning(np.arange(20) / 20)).star_paths(LENS, np.tile(DIRECTIONS, (1000, 1)), 1.0))
    assert [len(part.time_fraction) for part in many] == [8, 8, 4]
    assert sum(part.time_fraction.sum() for part in many) == pytest.approx(1.0, rel=1e-12)


def chords_px() -> np.ndarray:
    """Return the longest movement of a star of the field in each quarter of a segment, px."""
    lengths = []
    for segment in range(3):
        directions = trails().pointing.C_camera_eq[2 * segment + 1].T @ probe_rays(LENS)
        xy = [LENS.project((orientation(segment + min(k / 4, 1 - 1e-12)) @ directions).T) for k in range(5)]
        lengths.extend(np.linalg.norm(np.diff(xy, axis=0), axis=-1).max(axis=-1))
    return np.array(lengths)


@pytest.mark.parametrize(("length_px", "fewest"), [(0.2, 1), (3.0, 1), (9.0, 1), (9.0, 12), (1e4, 1), (1e4, 2)])
def test_pieces_are_equal_lengths_of_the_path_of_the_fastest_star(length_px: float, fewest: int) -> None:
    elapsed = np.concatenate([[0.0], np.cumsum(chords_px())])
    bounds = CameraPath(trails(), LENS).bounds_of_equal_lengths(length_px, fewest)
    count = max(fewest, int(np.ceil(elapsed[-1] / length_px)))
    expected = np.interp(np.arange(count + 1) / count * elapsed[-1], elapsed, np.arange(13)) / 4
    np.testing.assert_allclose(bounds, expected, rtol=0, atol=1e-9)
    if fewest == 1:
        np.testing.assert_array_equal(bounds, CameraPath(trails(), LENS).bounds_of_equal_lengths(length_px))
    np.testing.assert_allclose(
        CameraPath(trails(), LENS).times(bounds), np.interp(bounds, np.arange(4), MARKS), rtol=0, atol=1e-12
    )


def test_parts_of_segments_have_the_drawn_orientation_at_their_start_middle_and_end() -> None:
    path = CameraPath(trails(), LENS)
    assert len(path) == 3
    begins, ends = np.array([0.0, 0.3, 1.0, 2.4]), np.array([0.3, 1.0, 1.6, 3.0])
    found = path.pointings(begins, ends)
    at = np.column_stack([begins, (begins + ends) / 2, ends])
    for k, number in enumerate(at.ravel()):
        inside = number - 1e-9 if k % 3 == 2 else number
        np.testing.assert_allclose(found.C_camera_eq[k], orientation(inside), rtol=0, atol=1e-8)
    times = np.interp(at.ravel(), np.arange(4), MARKS)
    np.testing.assert_allclose(found.velocity_eq, np.outer(times, [1, -1, 2]) * 1e-6, rtol=0, atol=1e-12)
    zenith = np.column_stack([0.1 * times, 0.3 - 0.2 * times, np.ones_like(times)])
    np.testing.assert_allclose(found.zenith_eq, zenith, rtol=0, atol=1e-12)


BOUNDS = np.array([0.0, 0.4, 1.3, 2.0, 2.6, 3.0])


def test_pieces_have_the_mean_and_the_covariance_of_the_motion_during_them() -> None:
    path = CameraPath(trails(), LENS)
    moments = path.moments(BOUNDS)
    pieces = path.pieces(moments)
    times = np.interp(BOUNDS, np.arange(4), MARKS)
    assert len(pieces) == 5
    assert pieces.bounds is moments.bounds is BOUNDS
    np.testing.assert_allclose(pieces.time_fraction, np.diff(times), rtol=1e-12)
    of_segments = np.zeros((3, 5))
    for k in range(5):
        C, segment = dense(*BOUNDS[k : k + 2])
        mean = C.mean(axis=0)
        np.testing.assert_allclose(moments.C_mean[k], mean, rtol=0, atol=2e-7)
        turns = -Rotation.from_matrix(C @ np.linalg.inv(mean)).as_rotvec()
        expected = turns.T @ turns / len(turns)
        np.testing.assert_allclose(pieces.covariance_rad2[k], expected, rtol=0, atol=2e-3 * np.abs(expected).max())
        for number in range(3):
            overlap = min(MARKS[number + 1], times[k + 1]) - max(MARKS[number], times[k])
            of_segments[number, k] = max(overlap, 0) / (times[k + 1] - times[k])
        assert set(segment.tolist()) == set(np.flatnonzero(of_segments[:, k] > 0).tolist())
    np.testing.assert_allclose(pieces.of_segments, of_segments, rtol=0, atol=1e-12)
    np.testing.assert_array_equal(pieces.pointing.C_camera_eq, moments.C_mean)
    # The zenith at the middle between both ends, as numbers of segments.
    middles = np.interp((BOUNDS[1:] + BOUNDS[:-1]) / 2, np.arange(4), MARKS)
    np.testing.assert_allclose(pieces.pointing.velocity_eq, np.outer(middles, [1, -1, 2]) * 1e-6, rtol=0, atol=1e-12)


def test_errors_of_pieces_are_those_of_their_third_moments_and_fourth_cumulants() -> None:
    sigma = 1.3
    path = CameraPath(trails(), LENS)
    skewness, kurtosis = path.errors(path.moments(BOUNDS), sigma)
    rays = probe_rays(LENS)
    for k in range(5):
        C, _ = dense(*BOUNDS[k : k + 2])
        directions = np.linalg.inv(C.mean(axis=0)) @ rays
        off = LENS.project(np.swapaxes(C @ directions, 1, 2)) - LENS.project(rays.T)
        off = (off - off.mean(axis=0)) / sigma
        second = (off**2).sum(axis=-1).mean(axis=0)
        covariance = np.einsum("tpi,tpj->pij", off, off) / len(off)
        third = np.einsum("tpi,tpj,tpk->pijk", off, off, off) / len(off)
        norm = np.sqrt((third**2).sum(axis=(1, 2, 3)))
        expected = (1.3801 / 6 * norm / (1 + second) ** 1.5).max()
        assert skewness[k] == pytest.approx(expected, rel=0.05, abs=1e-5)
        fourth = ((off**2).sum(axis=-1) ** 2).mean(axis=0)
        cumulant = fourth - second**2 - 2 * (covariance**2).sum(axis=(1, 2))
        expected = (np.abs(cumulant) / 8 / (1 + second) ** 2).max()
        assert kurtosis[k] == pytest.approx(expected, rel=0.02)
    assert skewness.max() > 1e-3


def test_probes_move_by_their_displacement_per_turn_of_the_camera() -> None:
    rays = probe_rays(LENS)
    found = _px_per_turn(LENS)
    assert found.shape == (2, 3, 9)
    for axis in range(3):
        step = 1e-6 * np.eye(3)[axis]
        moved = [LENS.project(Rotation.from_rotvec(sign * step).apply(rays.T.copy())) for sign in (1, -1)]
        np.testing.assert_allclose(found[:, axis], ((moved[0] - moved[1]) / 2e-6).T, rtol=0, atol=1e-4)
    assert not found.flags.writeable


def test_quadrature_nodes_integrate_fifth_powers_over_pieces_of_several_segments() -> None:
    fraction, bounds = np.array([0.2, 0.3, 0.5]), np.array([0.0, 0.4, 2.5, 3.0])
    nodes = _Quadrature.of(fraction, bounds)
    assert nodes.segment.tolist() == [0] * 6 + [1] * 3 + [2] * 6
    assert nodes.piece.tolist() == [0] * 3 + [1] * 9 + [2] * 3
    assert nodes.first.tolist() == [0, 3, 12]
    np.testing.assert_allclose(nodes.duration, [0.08, 0.67, 0.25], rtol=1e-12)
    time = MARKS[nodes.segment] + nodes.u * fraction[nodes.segment]
    ends = np.interp(bounds, np.arange(4), MARKS)
    powers = np.stack([time**k for k in range(6)], axis=1)
    expected = [[(b ** (k + 1) - a ** (k + 1)) / (k + 1) / (b - a) for k in range(6)] for a, b in pairwise(ends)]
    np.testing.assert_allclose(nodes.mean(powers), expected, rtol=1e-12)
    np.testing.assert_allclose(nodes.mean(powers[:, 3]), np.array(expected)[:, 3], rtol=1e-12)


def test_the_sky_is_interpolated_between_halves_of_segments() -> None:
    pointing = turning(np.array([0.0, 0.1, 0.2, 0.3, 0.5]))
    found = _interpolated(pointing, np.array([0.0, 0.25, 2.5, 3.75, 4.0]))
    times = np.array([0.0, 0.025, 0.25, 0.45, 0.5])
    np.testing.assert_allclose(found.velocity_eq, np.outer(times, [1, -1, 2]) * 1e-6, rtol=0, atol=1e-15)
    zenith = np.column_stack([0.1 * times, 0.3 - 0.2 * times, np.ones_like(times)])
    np.testing.assert_allclose(found.zenith_eq, zenith, rtol=0, atol=1e-12)
    assert found.C_camera_eq is pointing.C_camera_eq
