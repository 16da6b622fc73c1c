"""The paper's series over centuries, where small terms are seen, against ERFA's."""

import erfa
import numpy as np
import pytest

from glstar.sky.place.apparent import mean_obliquity_rad, nutation_rad, precession_matrix, right_ascension_declination

ARCSEC = np.pi / 648000
J2000_JD = 2451545.0


@pytest.mark.parametrize("t", [-10.0, -2.0, 2.0, 10.0])
def test_precession_and_obliquity_are_those_of_the_iau_over_centuries(t: float) -> None:
    np.testing.assert_allclose(
        precession_matrix(t), erfa.pmat76(J2000_JD, 36525 * t), rtol=0, atol=abs(t) ** 3 * 1e-5 * ARCSEC
    )
    assert mean_obliquity_rad(t) == pytest.approx(erfa.obl80(J2000_JD, 36525 * t), rel=0, abs=abs(t) * 2e-3 * ARCSEC)


def test_the_four_terms_of_nutation_are_those_of_iau_1980() -> None:
    # What is left of the full series has no part of the paper's four arguments.
    t = np.linspace(-2.0, 2.0, 8001)
    left = np.array([nutation_rad(one) for one in t]) - np.stack(erfa.nut80(J2000_JD, 36525 * t), axis=-1)
    node, sun, moon = (
        np.deg2rad(at_j2000 + rate * t)
        for at_j2000, rate in ((125.04452, -1934.136261), (280.4665, 36000.7698), (218.3165, 481267.8813))
    )
    waves = np.stack([wave(a) for wave in (np.sin, np.cos) for a in (node, 2 * sun, 2 * moon, 2 * node)], axis=-1)
    amplitudes = np.linalg.lstsq(waves, left / ARCSEC, rcond=None)[0]
    assert np.abs(amplitudes).max() < 0.008


def test_right_ascension_and_declination_keep_the_shape_of_their_vectors() -> None:
    vectors = np.array([[[2.0, 0.0, 0.0], [0.0, 3.0, 0.0]], [[0.0, -1.0, 1.0], [-1.0, 0.0, -1.0]]])
    ra_rad, dec_rad = right_ascension_declination(vectors)
    np.testing.assert_allclose(np.rad2deg(ra_rad), [[0, 90], [270, 180]], rtol=0, atol=1e-12)
    np.testing.assert_allclose(np.rad2deg(dec_rad), [[0, 0], [45, -45]], rtol=0, atol=1e-12)
