"""Ways over an exposure: what is told of them at once, against what every look at them tells."""

import numpy as np
import pytest

from glstar.way import Parabolas, Places

STARS = 40


def bent_ways(segments, seed=0):
    random = np.random.default_rng(seed)
    knots_px = random.uniform(-50, 400, (2, 2 * segments + 1, STARS))
    share = random.dirichlet(np.ones(segments))
    return Parabolas(knots_px, share, random.integers(1, 30, segments))


def looked_at(ways):
    """Return all places that are looked at, (n, m, 2) px, and the share of each."""
    places, shares = zip(*ways.looks(np.arange(STARS)), strict=True)
    return np.concatenate(places), np.concatenate(shares)


def places_of(ways):
    xy, share = looked_at(ways)
    return Places(np.moveaxis(xy, -1, 0), share)


@pytest.mark.parametrize("segments", [1, 2, 7, 60])
@pytest.mark.parametrize("kind", [lambda ways: ways, places_of], ids=["parabolas", "places"])
def test_the_sum_that_is_told_at_once_is_that_of_every_look(kind, segments):
    ways = kind(bent_ways(segments))
    xy, share = looked_at(ways)
    assert share.sum() == pytest.approx(1.0)
    np.testing.assert_allclose(ways.sum_px.T, np.einsum("n,nmk->mk", share, xy), rtol=0, atol=1e-10)


@pytest.mark.parametrize("segments", [1, 2, 7, 60])
def test_no_look_leaves_the_box_and_that_of_straight_ways_ends_where_they_do(segments):
    ways = bent_ways(segments)
    lowest, highest = ways.box_px
    xy, _ = looked_at(Parabolas(ways.knots_px, ways.share, np.full(segments, 500)))
    assert (xy >= lowest - 1e-9).all()
    assert (xy <= highest + 1e-9).all()
    straight = ways.knots_px.copy()
    straight[:, 1::2] = (straight[:, :-2:2] + straight[:, 2::2]) / 2
    lowest, highest = Parabolas(straight, ways.share, ways.counts).box_px
    np.testing.assert_allclose(lowest, straight.min(axis=1).T)
    np.testing.assert_allclose(highest, straight.max(axis=1).T)


@pytest.mark.parametrize("kind", [lambda ways: ways, places_of], ids=["parabolas", "places"])
def test_a_way_that_lies_nowhere_for_a_while_has_no_box_and_no_sum(kind):
    ways = bent_ways(5)
    ways.knots_px[:, 3, 7] = np.nan
    ways = kind(ways)
    nowhere = np.arange(STARS) == 7
    np.testing.assert_array_equal(np.isnan(ways.box_px), np.broadcast_to(nowhere[:, np.newaxis], (2, STARS, 2)))
    np.testing.assert_array_equal(np.isnan(ways.sum_px), np.broadcast_to(nowhere, (2, STARS)))
    xy, _ = looked_at(ways)
    assert 0 < np.isnan(xy[:, 7, 0]).sum() < len(xy)


@pytest.mark.parametrize("kind", [lambda ways: ways, places_of], ids=["parabolas", "places"])
def test_some_of_the_stars_are_where_they_are_among_all(kind):
    ways = kind(bent_ways(3))
    xy, _ = looked_at(ways)
    which = np.array([31, 4, 5])
    np.testing.assert_array_equal(np.concatenate([some for some, _ in ways.looks(which)]), xy[:, which])
    assert list(ways.looks(np.array([], dtype=np.intp))) == []
