"""Robust spreads are those of normal values."""

import numpy as np
import pytest

from glstar.arrays import robust_std


def test_the_robust_std_of_normal_values_is_their_standard_deviation() -> None:
    values = np.random.default_rng(1).normal(5.0, 3.0, 100_000)

    assert robust_std(values, 5.0) == pytest.approx(3.0, rel=0.02)


def test_ten_percent_of_outliers_change_the_robust_std_by_less_than_20_percent() -> None:
    values = np.random.default_rng(1).normal(0.0, 3.0, 10_000)
    values[::10] = 1e6

    assert robust_std(values) == pytest.approx(3.0, rel=0.2)
    assert robust_std([]) == 0.0
