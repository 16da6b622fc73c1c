"""Robust spreads are those of normal values."""

import numpy as np
import pytest

from glstar.statistics import robust_std


def test_the_robust_spread_of_normal_values_is_their_standard_deviation() -> None:
    values = np.random.default_rng(1).normal(5.0, 3.0, 100_000)

    assert robust_std(values, 5.0) == pytest.approx(3.0, rel=0.02)


def test_a_tenth_of_wild_values_moves_the_robust_spread_by_less_than_a_fifth() -> None:
    values = np.random.default_rng(1).normal(0.0, 3.0, 10_000)
    values[::10] = 1e6

    assert robust_std(values) == pytest.approx(3.0, rel=0.2)
    assert robust_std([]) == 0.0
