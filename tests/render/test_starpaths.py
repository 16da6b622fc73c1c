"""Star paths over an exposure: their closed forms against their samples."""

from dataclasses import replace

import numpy as np
import pytest

from glstar.render.motion.starpaths import ConicPaths, SampledPaths, end_weights
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
