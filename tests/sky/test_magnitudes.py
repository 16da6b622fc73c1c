"""Magnitudes and brightness, eqs (36) and (37)."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from glstar.sky.observed.solarsystem import planet_vmag
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


@pytest.mark.parametrize(
    ("name", "sun_au", "earth_au", "phase_deg", "vmag"),
    [
        ("Mercury", 0.310295423552, 1.32182643625754, 1.1677, -2.477),
        ("Mercury", 0.413629222334, 0.92644808718613, 90.1662, 0.181),
        ("Mercury", 0.448947624811, 0.56004973217883, 178.7284, 7.167),
        ("Venus", 0.722722540169, 1.71607489554051, 1.3232, -3.917),
        ("Venus", 0.721480714554, 0.37762511206232, 124.1348, -4.916),
        ("Venus", 0.726166592736, 0.28889582420642, 179.1845, -3.090),
        ("Jupiter", 5.446231815414, 6.44985867459088, 0.2446, -1.667),
        ("Jupiter", 4.957681473205, 3.95393078136013, 0.3431, -2.934),
    ],
)
def test_planets_have_the_magnitudes_of_the_test_cases_of_mallama_and_hilton(
    name: str, sun_au: float, earth_au: float, phase_deg: float, vmag: float
) -> None:
    x = np.array([1.0, 0.0, 0.0])
    found = planet_vmag(name, sun_au * x, earth_au * x, np.deg2rad(phase_deg), 2018.0)
    assert found == pytest.approx(vmag, rel=0, abs=1e-3)
