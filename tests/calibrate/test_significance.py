"""Significance of matches between catalogue stars and detections, on random positions with known truth."""

import numpy as np
import pytest
from scipy.spatial import KDTree

from glstar.calibrate.identify.matching import chance_pairs, match_probability, significant

SIDE_PX = 1500.0
RADIUS_PX = 6.0


def nearest(stars: np.ndarray, detections: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the distance and index of each star's nearest detection; the distance is infinite beyond the radius."""
    distance_px, index = KDTree(detections).query(stars)
    return np.where(distance_px < RADIUS_PX, distance_px, np.inf), index


def sky(seed: int, *, stars: int = 300, seen: int = 60, false: int = 600, scatter_px: float = 0.8):
    """Return the distances of 300 stars, of which the 60 brightest are detected among 600 false detections."""
    rng = np.random.default_rng(seed)
    xy = rng.uniform(0, SIDE_PX, (stars, 2))
    real = xy[:seen] + rng.normal(0, scatter_px, (seen, 2))
    distance_px, index = nearest(xy, np.concatenate([real, rng.uniform(0, SIDE_PX, (false, 2))]))
    return distance_px, index == np.arange(stars)


def probability_of(distance_px: np.ndarray, *, detections: int, scatter_px: float = 0.8) -> np.ndarray:
    return match_probability(distance_px, np.full(len(distance_px), scatter_px), detections / SIDE_PX**2, RADIUS_PX)


def test_chance_matches_are_stars_times_detections_times_circle_over_area() -> None:
    found = [
        int(np.isfinite(sky(seed, seen=0)[0]).sum()) for seed in range(40)
    ]  # no star is detected: all pairs are chance
    assert chance_pairs(300, 600, RADIUS_PX, SIDE_PX**2) == pytest.approx(np.mean(found), rel=0.1)


def test_faint_stars_that_pair_by_chance_are_left_out_and_bright_ones_kept() -> None:
    kept_real = kept_false = real = false = 0
    for seed in range(20):
        distance_px, true = sky(seed)
        kept = significant(probability_of(distance_px, detections=660))
        kept_real, kept_false = kept_real + (kept & true)[:60].sum(), kept_false + (kept & ~true).sum()
        real, false = real + true[:60].sum(), false + (np.isfinite(distance_px) & ~true).sum()
    assert false > 20 * 5  # matches within the circle, without a test of significance
    assert kept_false <= 20 * 0.5
    assert kept_real > 0.95 * real


def test_the_expected_number_of_false_matches_agrees_with_simulations() -> None:
    expected = happened = 0.0
    for seed in range(60):
        distance_px, _ = sky(seed, seen=150, scatter_px=1.5)
        detected = np.arange(300) < 150
        probability = probability_of(distance_px, detections=750, scatter_px=1.5)
        close = probability > 0.5
        expected, happened = expected + (1 - probability[close]).sum(), happened + (close & ~detected).sum()
    assert happened > 20
    assert expected == pytest.approx(happened, rel=0.5)


def test_random_dots_are_never_a_significant_number_of_matches() -> None:
    for seed in range(20):
        distance_px, _ = sky(seed, seen=0)
        assert significant(probability_of(distance_px, detections=600)).sum() <= 3


def test_a_star_without_a_detection_has_no_probability() -> None:
    distance_px = np.array([0.1, np.inf, 0.2, 0.1])
    probability = probability_of(distance_px, detections=4)
    assert probability[1] == 0
    assert (probability[[0, 2, 3]] > 0.99).all()
    np.testing.assert_array_equal(significant(probability), [True, False, True, True])
