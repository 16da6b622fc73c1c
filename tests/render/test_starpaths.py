"""Ways over an exposure: what is told of them at once, against what every look at them tells."""

from dataclasses import replace

import numpy as np
import pytest

from glstar.render.starpaths import Conics, Places, end_weights
from glstar.rotation import matrix_from_quaternion, quaternion_from_turn
from tests.support.scenes import camera

STARS = 40
# Looked at every so many pixels, a segment of these ways has between 1 and 30 looks, and it has hundreds.
SELDOM_PX, OFTEN_PX = 13.0, 0.2
LENS = camera(400, 300, 500.0)


def bent_ways(segments, apart_px=SELDOM_PX, seed=0):
    random = np.random.default_rng(seed)
    knots = LENS.unproject(random.uniform(-50, 400, (2 * segments + 1, STARS, 2)))
    knots *= 1.0 + 0.02 * np.arange(2 * segments + 1)[:, np.newaxis, np.newaxis]
    share, weight = random.dirichlet(np.ones(segments)), random.uniform(1.0, 1.005, segments)
    return Conics(LENS, np.moveaxis(knots, -1, 0), weight, share, apart_px)


def looked_at(ways):
    """Return all places that are looked at, (n, m, 2) px, and the share of each."""
    places, shares = zip(*ways.looks(np.arange(STARS)), strict=True)
    return np.concatenate(places), np.concatenate(shares)


def places_of(ways):
    xy, share = looked_at(ways)
    return Places(np.moveaxis(xy, -1, 0), share)


@pytest.mark.parametrize("deg", [0.0, 1.0, 10.0, 60.0])
def test_a_steady_turn_runs_through_a_conic_and_nearly_in_time(deg):
    """A single segment, whatever it turns about: from each look the way of the true turn is 1e-9 px away."""
    random = np.random.default_rng(5)
    axis = random.normal(size=3)
    axis /= np.linalg.norm(axis)
    directions = LENS.unproject(random.uniform([0, 0], [400, 300], (STARS, 2)))
    directions /= np.linalg.norm(directions, axis=-1, keepdims=True)

    def turned(share):
        angle_rad = np.deg2rad(deg) * (np.atleast_1d(share) - 0.5)
        return matrix_from_quaternion(quaternion_from_turn(angle_rad[:, np.newaxis] * axis))

    knots = turned([0.0, 0.5, 1.0]) @ directions.T
    weight = end_weights(turned(0.0), turned(1.0))
    assert weight == pytest.approx(1 / np.cos(np.deg2rad(deg) / 4) ** 2)
    ways = Conics(LENS, np.moveaxis(knots, 1, 0), weight, np.ones(1), 1.0)
    shares = np.linspace(0.0, 1.0, 21)
    # The tangent of half the angle runs evenly where the angle does not quite.
    t = np.tan(np.deg2rad(deg) / 4) * (2 * shares - 1)
    angle_share = 0.5 + 2 * np.arctan(t) / max(np.deg2rad(deg), 1e-12) if deg else shares
    expected = LENS.project(np.swapaxes(turned(angle_share) @ directions.T, 1, 2))
    np.testing.assert_allclose(ways.places(np.zeros(21, dtype=np.intp), shares), expected, rtol=0, atol=1e-9)
    assert np.abs(angle_share - shares).max() * deg < 0.065 * deg * (np.deg2rad(deg) / 2) ** 2 + 1e-9


@pytest.mark.parametrize("segments", [1, 2, 7, 60])
def test_the_sum_that_is_told_at_once_is_that_of_every_look(segments):
    places = places_of(bent_ways(segments))
    xy, share = looked_at(places)
    assert share.sum() == pytest.approx(1.0)
    np.testing.assert_allclose(places.sum_px.T, np.einsum("n,nmk->mk", share, xy), rtol=0, atol=1e-10)
    # Conics tell that of looks without end.
    ways = bent_ways(segments, OFTEN_PX)
    xy, share = looked_at(ways)
    np.testing.assert_allclose(ways.sum_px.T, np.einsum("n,nmk->mk", share, xy), rtol=0, atol=3e-4)


@pytest.mark.parametrize("segments", [1, 2, 7, 60])
def test_no_look_leaves_the_box_and_that_of_straight_ways_ends_where_they_do(segments):
    ways = bent_ways(segments, OFTEN_PX)
    lowest, highest = ways.box_px
    xy, _ = looked_at(ways)
    assert (xy >= lowest - 1e-9).all()
    assert (xy <= highest + 1e-9).all()
    straight = ways.knots.copy()
    straight[:, 1::2] = (straight[:, :-2:2] + straight[:, 2::2]) / 2
    lowest, highest = replace(ways, knots=straight).box_px
    xy = np.moveaxis(LENS.project(np.moveaxis(straight, 0, -1)), -1, 0)
    np.testing.assert_allclose(lowest, xy.min(axis=1).T, rtol=0, atol=1e-9)
    np.testing.assert_allclose(highest, xy.max(axis=1).T, rtol=0, atol=1e-9)


@pytest.mark.parametrize("segments", [1, 2, 7, 60])
@pytest.mark.parametrize("apart_px", [SELDOM_PX, OFTEN_PX])
def test_pieces_are_the_whole_a_few_segments_at_a_time(segments, apart_px):
    ways = bent_ways(segments, apart_px)
    pieces = list(ways.pieces())
    assert len(pieces) == segments if apart_px == OFTEN_PX else len(pieces) <= 1 + ways.counts.sum() / 100
    for of_pieces, of_ways in zip(zip(*map(looked_at, pieces), strict=True), looked_at(ways), strict=True):
        np.testing.assert_allclose(np.concatenate(of_pieces), of_ways, rtol=0, atol=1e-9)
    np.testing.assert_allclose(sum(piece.sum_px for piece in pieces), ways.sum_px, rtol=0, atol=1e-9)


@pytest.mark.parametrize("kind", [lambda ways: ways, places_of], ids=["conics", "places"])
def test_a_way_that_lies_nowhere_for_a_while_has_no_box_and_no_sum(kind):
    ways = bent_ways(5)
    ways.knots[:, 3, 7] = np.nan
    ways = kind(ways)
    nowhere = np.arange(STARS) == 7
    np.testing.assert_array_equal(np.isnan(ways.box_px), np.broadcast_to(nowhere[:, np.newaxis], (2, STARS, 2)))
    np.testing.assert_array_equal(np.isnan(ways.sum_px), np.broadcast_to(nowhere, (2, STARS)))
    xy, _ = looked_at(ways)
    assert 0 < np.isnan(xy[:, 7, 0]).sum() < len(xy)


@pytest.mark.parametrize("kind", [lambda ways: ways, places_of], ids=["conics", "places"])
def test_some_of_the_stars_are_where_they_are_among_all(kind):
    ways = kind(bent_ways(3))
    xy, _ = looked_at(ways)
    which = np.array([31, 4, 5])
    np.testing.assert_array_equal(np.concatenate([some for some, _ in ways.looks(which)]), xy[:, which])
    assert list(ways.looks(np.array([], dtype=np.intp))) == []
