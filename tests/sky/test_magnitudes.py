"""Magnitudes and brightness, eqs (36) and (37)."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from glstar.sky.photometry import brightness_ratio, magnitude_difference


def test_a_star_one_magnitude_fainter_has_two_fifths_of_the_flux() -> None:
    # Eq. (37) printed without its minus makes it 2.51 times as bright.
    assert brightness_ratio(1.0) == pytest.approx(0.3981, abs=1e-4)


def test_five_magnitudes_are_a_factor_of_one_hundred() -> None:
    assert brightness_ratio(5.0) == pytest.approx(0.01, rel=1e-15)
    assert brightness_ratio(-5.0) == pytest.approx(100.0, rel=1e-15)
    assert brightness_ratio(0.0) == 1.0


def test_sirius_outshines_a_star_of_the_sixth_magnitude_nine_hundredfold() -> None:
    assert brightness_ratio(-1.46 - 6.0) == pytest.approx(964.0, abs=1.0)


def test_half_the_flux_is_three_quarters_of_a_magnitude() -> None:
    assert magnitude_difference(0.5) == pytest.approx(0.7526, abs=1e-4)


@given(st.floats(-30.0, 30.0))
def test_eqs_36_and_37_are_inverse_functions(magnitudes: float) -> None:
    assert magnitude_difference(brightness_ratio(magnitudes)) == pytest.approx(magnitudes, abs=1e-13)


@given(st.floats(-20.0, 20.0), st.floats(-20.0, 20.0))
def test_differences_of_magnitude_add_where_brightness_multiplies(one: float, other: float) -> None:
    assert brightness_ratio(one + other) == pytest.approx(brightness_ratio(one) * brightness_ratio(other), rel=1e-12)


def test_magnitudes_are_converted_for_arrays() -> None:
    np.testing.assert_allclose(brightness_ratio([[0.0, 2.5], [5.0, -2.5]]), [[1.0, 0.1], [0.01, 10.0]], rtol=1e-14)
