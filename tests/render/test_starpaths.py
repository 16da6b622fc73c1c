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
    np.testing.assert_allclose(paths.weighted_sum_px.T, np.einsum("n,nmk->mk", time_fraction, xy), rtol=0, atol=3e-4)


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
    weighted_sum_px = sum(piece.weighted_sum_px for piece in pieces)
    np.testing.assert_allclose(weighted_sum_px, paths.weighted_sum_px, rtol=0, atol=1e-9)


@pytest.mark.parametrize("kind", [lambda paths: paths, sampled], ids=["conics", "samples"])
def test_a_star_that_is_hidden_for_some_time_has_no_bounds_and_no_sum(kind):
    paths = random_paths(5)
    paths.nodes[:, 3, 7] = np.nan
    paths = kind(paths)
    hidden = np.arange(STARS) == 7
    np.testing.assert_array_equal(np.isnan(paths.bounds_px), np.broadcast_to(hidden[:, np.newaxis], (2, STARS, 2)))
    np.testing.assert_array_equal(np.isnan(paths.weighted_sum_px), np.broadcast_to(hidden, (2, STARS)))
    xy, _ = all_samples(paths)
    assert 0 < np.isnan(xy[:, 7, 0]).sum() < len(xy)


@pytest.mark.parametrize("kind", [lambda paths: paths, sampled], ids=["conics", "samples"])
def test_samples_of_some_stars_equal_those_of_all(kind):
    paths = kind(random_paths(3))
    xy, _ = all_samples(paths)
    stars = np.array([31, 4, 5])
    np.testing.assert_array_equal(np.concatenate([some for some, _ in paths.samples(stars)]), xy[:, stars])
    assert list(paths.samples(np.array([], dtype=np.intp))) == []
