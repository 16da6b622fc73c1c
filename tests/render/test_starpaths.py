"""Star paths over an exposure: their closed forms against their samples."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from glstar.camera.distortion import Lens
from glstar.render.motion.starpaths import (
    ConicPaths,
    SampledPaths,
    SegmentSamples,
    end_rates_px,
    end_weights,
    parameter_at,
    probe_rays,
)
from glstar.rotation import matrix_from_quaternion, quaternion_from_turn
from tests.support.scenes import camera

STARS = 40
# With this spacing of samples a segment of these paths has between 1 and 30 of them, and hundreds.
COARSE_PX, FINE_PX = 13.0, 0.2
LENS = camera(400, 300, 500.0)


def random_paths(segments, spacing_px=COARSE_PX, seed=0):
    random = np.random.default_rng(seed)
    nodes = LENS.unit_vectors(random.uniform(-50, 400, (2 * segments + 1, STARS, 2)))
    nodes /= nodes[..., 2:]
    nodes *= 1.0 + 0.02 * np.arange(2 * segments + 1)[:, np.newaxis, np.newaxis]
    time_fraction, weight = random.dirichlet(np.ones(segments)), random.uniform(1.0, 1.005, segments)
    return ConicPaths(LENS, np.moveaxis(nodes, -1, 0), weight, time_fraction, spacing_px)


def all_samples(paths):
    """Return all samples, (n, m, 2) px, and the time fraction of each."""
    xy, time_fractions = zip(*paths.samples(np.arange(STARS)), strict=True)
    return np.concatenate(xy), np.concatenate(time_fractions)


def sampled(paths):
    xy, time_fraction = all_samples(paths)
    return SampledPaths(np.moveaxis(xy, -1, 0), time_fraction)


def weighted_sum_px(paths):
    """Return the mean position of each star, (2, m) px."""
    if isinstance(paths, SampledPaths):
        return paths.weighted_sum_px
    return paths.weighted_sum_of(np.ones((len(paths.time_fraction), STARS), dtype=np.bool_))


@pytest.mark.parametrize("deg", [0.0, 1.0, 10.0, 60.0])
def test_a_steady_rotation_is_a_conic_and_uniform_in_time(deg):
    """A single segment, about any axis: its path is within 1e-8 px of the true rotation."""
    random = np.random.default_rng(5)
    axis = random.normal(size=3)
    axis /= np.linalg.norm(axis)
    directions = LENS.unit_vectors(random.uniform([0, 0], [400, 300], (STARS, 2)))
    directions /= np.linalg.norm(directions, axis=-1, keepdims=True)

    def rotated(fraction):
        angle_rad = np.deg2rad(deg) * (np.atleast_1d(fraction) - 0.5)
        return matrix_from_quaternion(quaternion_from_turn(angle_rad[:, np.newaxis] * axis))

    nodes = rotated([0.0, 0.5, 1.0]) @ directions.T
    weight = end_weights(rotated(0.0), rotated(1.0))
    assert weight == pytest.approx(1 / np.cos(np.deg2rad(deg) / 4) ** 2)
    paths = ConicPaths(LENS, np.moveaxis(nodes, 1, 0), weight, np.ones(1), 1.0)
    elapsed = np.linspace(0.0, 1.0, 21)
    expected = LENS.project(np.swapaxes(rotated(elapsed) @ directions.T, 1, 2))
    np.testing.assert_allclose(paths.positions(np.zeros(21, dtype=np.intp), elapsed), expected, rtol=0, atol=1e-8)


@pytest.mark.parametrize("segments", [1, 2, 7, 60])
def test_the_weighted_sum_is_that_of_all_samples(segments):
    paths = sampled(random_paths(segments))
    xy, time_fraction = all_samples(paths)
    assert time_fraction.sum() == pytest.approx(1.0)
    np.testing.assert_allclose(paths.weighted_sum_px.T, np.einsum("n,nmk->mk", time_fraction, xy), rtol=0, atol=1e-10)
    # That of conics is an integral.
    paths = random_paths(segments, FINE_PX)
    xy, time_fraction = all_samples(paths)
    np.testing.assert_allclose(weighted_sum_px(paths).T, np.einsum("n,nmk->mk", time_fraction, xy), rtol=0, atol=3e-4)


@pytest.mark.parametrize("segments", [1, 2, 7, 60])
def test_no_sample_is_out_of_bounds_and_the_bounds_of_straight_paths_are_tight(segments):
    paths = random_paths(segments, FINE_PX)
    low, high = paths.bounds_px
    xy, _ = all_samples(paths)
    assert (xy >= low - 1e-9).all()
    assert (xy <= high + 1e-9).all()
    straight = paths.nodes.copy()
    straight[:, 1::2] = (straight[:, :-2:2] + straight[:, 2::2]) / 2
    low, high = replace(paths, nodes=straight).bounds_px
    xy = np.moveaxis(LENS.project(np.moveaxis(straight, 0, -1)), -1, 0)
    np.testing.assert_allclose(low, xy.min(axis=1).T, rtol=0, atol=1e-9)
    np.testing.assert_allclose(high, xy.max(axis=1).T, rtol=0, atol=1e-9)


@pytest.mark.parametrize("segments", [1, 2, 7, 60])
@pytest.mark.parametrize("spacing_px", [COARSE_PX, FINE_PX])
def test_the_pieces_of_paths_are_the_paths_a_few_segments_at_a_time(segments, spacing_px):
    paths = random_paths(segments, spacing_px)
    pieces = list(paths.pieces())
    if spacing_px == FINE_PX:
        assert len(pieces) == segments
    else:
        assert len(pieces) <= 1 + paths.sample_counts.sum() / 100
    for of_pieces, of_paths in zip(zip(*map(all_samples, pieces), strict=True), all_samples(paths), strict=True):
        np.testing.assert_allclose(np.concatenate(of_pieces), of_paths, rtol=0, atol=1e-9)
    np.testing.assert_allclose(sum(map(weighted_sum_px, pieces)), weighted_sum_px(paths), rtol=0, atol=1e-9)


@pytest.mark.parametrize(("finer", "least"), [(1, 1), (3, 1), (2, 30)])
def test_samples_of_single_segments_are_those_of_the_whole_paths(finer, least):
    paths = random_paths(7)
    fine = replace(paths, spacing_px=paths.spacing_px)
    vars(fine)["sample_counts"] = np.maximum(finer * paths.sample_counts, least)
    xy, time_fraction = all_samples(fine)
    change = np.gradient(xy[..., 0], axis=0)
    ends = np.cumsum(fine.sample_counts)
    # The first segment of a star and the last one have a neighbour on one side only.
    segment, star = np.array([0, 2, 2, 6]), np.array([5, 1, 9, 30])
    (samples,) = paths.segment_samples(segment, star, finer, least)
    own = np.concatenate([np.arange(ends[k] - fine.sample_counts[k], ends[k]) for k in segment])
    np.testing.assert_array_equal(samples.star, np.repeat(star, fine.sample_counts[segment]))
    np.testing.assert_allclose(samples.xy_px[samples.own], xy[own, samples.star], rtol=0, atol=1e-9)
    np.testing.assert_allclose(samples.time_fraction, time_fraction[own], rtol=0, atol=1e-15)
    np.testing.assert_allclose(samples.begins, (np.cumsum(time_fraction) - time_fraction)[own], rtol=0, atol=1e-12)
    x_px, step_px = samples.own_values(samples.xy_px[:, 0])
    np.testing.assert_allclose(x_px, xy[own, samples.star, 0], rtol=0, atol=1e-9)
    np.testing.assert_allclose(step_px, change[own, samples.star], rtol=0, atol=1e-9)


def test_the_bounds_of_paths_are_those_of_their_segments():
    paths = random_paths(5, FINE_PX)
    low, high = paths.segment_bounds_px
    first = 0
    (xy, _) = all_samples(paths)
    for k, count in enumerate(paths.sample_counts):
        of_segment = np.moveaxis(xy[first : first + count], -1, 0)
        assert (of_segment.min(axis=1) >= low[:, k] - 1e-9).all()
        assert (of_segment.max(axis=1) <= high[:, k] + 1e-9).all()
        first += count


@pytest.mark.parametrize("kind", [lambda paths: paths, sampled], ids=["conics", "samples"])
def test_a_star_that_is_hidden_for_some_time_has_no_bounds_and_no_sum(kind):
    paths = random_paths(5)
    paths.nodes[:, 3, 7] = np.nan
    paths = kind(paths)
    hidden = np.arange(STARS) == 7
    np.testing.assert_array_equal(np.isnan(paths.bounds_px), np.broadcast_to(hidden[:, np.newaxis], (2, STARS, 2)))
    np.testing.assert_array_equal(np.isnan(weighted_sum_px(paths)), np.broadcast_to(hidden, (2, STARS)))
    xy, _ = all_samples(paths)
    assert 0 < np.isnan(xy[:, 7, 0]).sum() < len(xy)


@pytest.mark.parametrize("kind", [lambda paths: paths, sampled], ids=["conics", "samples"])
def test_samples_of_some_stars_equal_those_of_all(kind):
    paths = kind(random_paths(3))
    xy, _ = all_samples(paths)
    stars = np.array([31, 4, 5])
    np.testing.assert_array_equal(np.concatenate([some for some, _ in paths.samples(stars)]), xy[:, stars])
    assert list(paths.samples(np.array([], dtype=np.intp))) == []


def exact_px(paths: ConicPaths, elapsed: np.ndarray) -> np.ndarray:
    """Return positions at elapsed fractions of all segments, (segments, n, m, 2) px, by barycentric interpolation."""
    positions = []
    for k, weight in enumerate(paths.weight):
        angle = np.arctan(np.sqrt(weight - 1))
        u = (1 + np.tan((2 * elapsed - 1) * angle) / np.tan(angle)) / 2
        start, middle, end = paths.nodes[:, 2 * k : 2 * k + 3].transpose(1, 2, 0)
        lagrange = 2 * (u - 0.5) * (u - 1) * weight, 4 * u * (1 - u), 2 * u * (u - 0.5) * weight
        positions.append(LENS.project(sum(of[:, np.newaxis, np.newaxis] * node for of, node in
                                          zip(lagrange, (start, middle, end), strict=True))))  # fmt: skip
    return np.array(positions)


def test_the_ends_of_a_rotation_have_the_weight_of_a_quarter_of_it() -> None:
    ends = Rotation.from_rotvec([[0.3, -0.2, 0.4], [0.0, 0.0, 2.0], [0.0, 0.0, np.pi]]).as_matrix()
    starts = Rotation.from_rotvec([[0.3, -0.2, 0.1], [0.0, 0.0, 0.5], [0.0, 0.0, 0.0]]).as_matrix()
    angles = [np.arccos((np.trace(starts[k].T @ ends[k]) - 1) / 2) for k in range(3)]
    np.testing.assert_allclose(end_weights(starts, ends), 1 / np.cos(np.array(angles) / 4) ** 2, rtol=1e-7)
    elapsed = np.array([0.0, 0.2, 0.5, 0.9, 1.0])
    angle = np.arctan(np.sqrt(0.3))
    expected = 0.5 + np.tan((2 * elapsed - 1) * angle) / np.sqrt(0.3) / 2
    np.testing.assert_allclose(parameter_at(elapsed, np.full(5, 1.3)), expected, rtol=1e-12)
    np.testing.assert_allclose(parameter_at(elapsed, np.ones(5)), elapsed, rtol=0, atol=1e-9)


def test_positions_are_those_of_the_quadratics_through_weighted_ends() -> None:
    paths = replace(random_paths(3), weight=np.array([1.1, 1.3, 1.02]))
    elapsed = np.array([0.0, 0.15, 0.5, 0.8, 1.0])
    exact = exact_px(paths, elapsed)
    for segment in ([0] * 5, [2, 0, 1, 1, 0]):
        found = paths.positions(np.array(segment), elapsed)
        np.testing.assert_allclose(found, exact[segment, np.arange(5)], rtol=0, atol=1e-8)
    ends_px = np.concatenate([exact[:, 0], exact[-1:, -1]])
    np.testing.assert_allclose(np.moveaxis(paths.nodes_px[:, ::2], 0, -1), ends_px, rtol=0, atol=1e-8)
    # Samples lie in the middle of equal parts of the time of a segment.
    xy, time_fraction = all_samples(paths)
    counts = paths.sample_counts
    first = 0
    for k, count in enumerate(counts):
        expected = exact_px(paths, (np.arange(count) + 0.5) / count)[k]
        np.testing.assert_allclose(xy[first : first + count], expected, rtol=0, atol=1e-8)
        np.testing.assert_allclose(time_fraction[first : first + count], paths.time_fraction[k] / count, rtol=1e-12)
        first += count
    assert first == len(xy)


def test_a_segment_has_a_sample_for_each_spacing_of_its_longest_chord_and_for_each_hundredth_of_the_time() -> None:
    # One star on the image, one whose middle is beside it and one that is hidden at the end.
    path_px = np.array([[[10.0, 20], [40, 60], [70, 100.0], [120, 100], [150, 100]],
                        [[10.0, 20], [-40, 60], [370, 200.0], [399, 100], [420, 250]],
                        [[10.0, 20], [40, 60], [np.nan, 100], [60, 80], [50, 90]]])  # fmt: skip
    rays = LENS.unit_vectors(path_px)
    nodes = np.moveaxis(rays / rays[..., 2:], (0, 1, 2), (2, 1, 0))
    paths = ConicPaths(LENS, nodes, np.array([1.001, 1.001]), np.array([0.7, 0.3]), 2.5)
    # 100 px, and 80 px and 70.7 px: of the star at the border.
    assert paths.sample_counts.tolist() == [70, 32]
    # Its middle is on the image, at (399, 100), by half a pixel.
    assert replace(paths, spacing_px=1.2).sample_counts.tolist() == [84, 67]
    assert replace(paths, nodes=nodes[..., :1], spacing_px=0.99).sample_counts.tolist() == [102, 81]
    assert replace(paths, nodes=nodes[..., 2:], spacing_px=0.99).sample_counts.tolist() == [70, 30]
    assert replace(paths, spacing_px=np.inf).sample_counts.tolist() == [70, 30]


@pytest.mark.parametrize(("counts", "pieces"), [
    ([50, 50, 99], [3]), ([50, 50, 100], [2, 1]), ([199, 1, 199, 2, 500, 300], [1, 2, 1, 1, 1]), ([700], [1]),
])  # fmt: skip
def test_a_piece_of_paths_has_200_samples_or_one_segment(counts: list[int], pieces: list[int]) -> None:
    paths = random_paths(len(counts))
    vars(paths)["sample_counts"] = np.array(counts)
    found = list(paths.pieces())
    assert [len(piece.time_fraction) for piece in found] == pieces
    assert np.concatenate([piece.sample_counts for piece in found]).tolist() == counts
    first = 0
    for piece, count in zip(found, pieces, strict=True):
        of = slice(2 * first, 2 * (first + count) + 1)
        np.testing.assert_array_equal(piece.nodes, paths.nodes[:, of])
        np.testing.assert_array_equal(piece.nodes_px, paths.nodes_px[:, of])
        np.testing.assert_array_equal(piece.weight, paths.weight[first : first + count])
        np.testing.assert_array_equal(piece.time_fraction, paths.time_fraction[first : first + count])
        first += count


def test_the_bounds_of_a_conic_are_its_ends_and_where_its_tangents_meet() -> None:
    paths = replace(random_paths(3), weight=np.array([1.1, 1.3, 1.02]))
    low, high = paths.segment_bounds_px
    for k, weight in enumerate(paths.weight):
        start, middle, end = paths.nodes[:, 2 * k : 2 * k + 3].transpose(1, 2, 0) * [[[weight]], [[1.0]], [[weight]]]
        tangents = LENS.project(2 * middle - (start + end) / 2)
        corners = np.stack([LENS.project(start), tangents, LENS.project(end)])
        np.testing.assert_allclose(low[:, k].T, corners.min(axis=0), rtol=0, atol=1e-8)
        np.testing.assert_allclose(high[:, k].T, corners.max(axis=0), rtol=0, atol=1e-8)
    whole = paths.bounds_px
    np.testing.assert_allclose(whole, [low.min(axis=1).T, high.max(axis=1).T], rtol=0, atol=1e-12)


def test_the_bounds_behind_a_lens_hold_five_times_and_a_quarter_of_how_far_a_path_bends_between_them() -> None:
    paths = replace(random_paths(3), weight=np.array([1.1, 1.3, 1.02]))
    seen = replace(paths, camera=replace(LENS, lens=Lens("fisheye", (0.0, 0.0, 0.0, 0.0))))
    at_px = np.moveaxis(np.stack([seen.positions(np.arange(3), np.full(3, u)) for u in np.arange(5) / 4]), -1, 0)
    bends = [np.abs(at_px[:, k] - 2 * at_px[:, k + 1] + at_px[:, k + 2]) / 4 for k in (0, 2)]
    low, high = seen.segment_bounds_px
    np.testing.assert_allclose(low, at_px.min(axis=1) - np.maximum(*bends), rtol=0, atol=1e-8)
    np.testing.assert_allclose(high, at_px.max(axis=1) + np.maximum(*bends), rtol=0, atol=1e-8)


def test_integrals_of_counted_segments_are_those_of_dense_positions() -> None:
    paths = replace(random_paths(4), weight=np.array([1.003, 1.005, 1.002, 1.004]))
    rng = np.random.default_rng(6)
    counted = rng.random((4, STARS)) < 0.6
    begin, end = np.sort(rng.uniform(-0.1, 1.1, (2, STARS)), axis=0)
    steps = 2000
    dense = exact_px(paths, (np.arange(steps) + 0.5) / steps)
    ends = np.cumsum(paths.time_fraction)
    time = (ends - paths.time_fraction)[:, np.newaxis] + paths.time_fraction[:, np.newaxis] * (
        np.arange(steps) + 0.5
    ) / steps
    weight = np.repeat(paths.time_fraction / steps, steps).reshape(4, steps, 1) * counted[:, np.newaxis]
    sums = np.einsum("snm,snmx->xm", weight, dense)
    np.testing.assert_allclose(paths.weighted_sum_of(counted), sums, rtol=0, atol=2e-3)
    inside = (time[..., np.newaxis] > begin) & (time[..., np.newaxis] < end)
    found_time, found_px = paths.integral_between(begin, end, counted)
    np.testing.assert_allclose(found_time, (weight * inside).sum(axis=(0, 1)), rtol=0, atol=2e-3)
    exact = np.einsum("snm,snmx->xm", weight * inside, dense)
    np.testing.assert_allclose(found_px, exact, rtol=0, atol=0.4)
    # Whole segments are counted exactly.
    whole = np.append(0.0, ends)
    time_of, px_of = paths.integral_between(np.full(STARS, whole[1]), np.full(STARS, whole[3]), counted)
    np.testing.assert_allclose(time_of, paths.time_fraction[1:3] @ counted[1:3], rtol=0, atol=1e-12)
    np.testing.assert_allclose(px_of, np.einsum("snm,snmx->xm", weight[1:3], dense[1:3]), rtol=0, atol=2e-3)


def test_sums_and_rests_of_samples_without_a_neighbour() -> None:
    number, own = np.array([0, 0, 1, 2, 5, 5]), np.array([1, 2, 4])
    values = np.array([1.0, 2.0, 4.0, 9.0, 16.0, 30.0])
    samples = SegmentSamples(np.zeros((6, 2)), number, own, own, np.zeros(3), np.zeros(3))
    at, step = samples.own_values(values)
    assert at.tolist() == [2.0, 4.0, 16.0]
    assert step.tolist() == [3.0, 3.5, 7.0]
    two = SampledPaths(np.arange(12.0).reshape(2, 3, 2), np.array([0.2, 0.3, 0.5]))
    assert two.is_at_rest is False
    np.testing.assert_allclose(two.weighted_sum_px, [[2.6, 3.6], [8.6, 9.6]], rtol=1e-12)
    np.testing.assert_allclose(two.bounds_px, [[[0, 6], [1, 7]], [[4, 10], [5, 11]]], rtol=1e-12)


def test_the_rates_at_the_ends_are_derivatives_of_the_projected_quadratic() -> None:
    start, middle, end = np.random.default_rng(4).normal(size=(3, 5, 3)) * 0.1 + [0, 0, 1]

    def at(u: float) -> np.ndarray:
        return LENS.project(2 * (u - 0.5) * (u - 1) * start + 4 * u * (1 - u) * middle + 2 * u * (u - 0.5) * end)

    rates = end_rates_px(LENS, start, middle, end)
    step = 1e-6
    expected = [(at(u + step) - at(u - step)) / (2 * step) for u in (0.0, 1.0)]
    np.testing.assert_allclose(rates, expected, rtol=0, atol=1e-5)


def test_probes_are_at_the_corners_and_sides_and_within_the_limit_of_a_lens() -> None:
    rays = probe_rays(LENS)
    columns, rows = np.meshgrid([-0.5, 199.5, 399.5], [-0.5, 149.5, 299.5])
    np.testing.assert_allclose(
        LENS.project(rays.T), np.column_stack([columns.ravel(), rows.ravel()]), rtol=0, atol=1e-9
    )
    assert not rays.flags.writeable
    barrel = replace(LENS, lens=Lens("fisheye", (0.0, 0.0, 0.0, 0.0)))
    seen = barrel.project(probe_rays(barrel).T)
    columns, rows = np.meshgrid(-0.5 + 100.0 * np.arange(5), -0.5 + 75.0 * np.arange(5))
    np.testing.assert_allclose(seen, np.column_stack([columns.ravel(), rows.ravel()]), rtol=0, atol=1e-6)
    # Within 0.97 of an image circle: the corners, 250 px from the axis, are not, and next are those at 213.6 px.
    f_px = 240.0 / np.deg2rad(176.0)
    next_px = np.hypot(200, 75)
    for factor, count in ((1.0, 21), (next_px / 240 / 0.97 * 0.99, 17), (next_px / 240 / 0.97 * 1.01, 21)):
        circle = replace(barrel, fx_px=f_px * factor, fy_px=f_px * factor)
        assert probe_rays(circle).shape == (3, count)
