"""The formulae of apparent places to their last digits, far from J2000, where a wrong coefficient shows."""

import erfa
import numpy as np
import pytest

from glstar.sky.place.apparent import (
    ErfaAstrometry,
    PaperAstrometry,
    aberration_velocity,
    direction,
    mean_obliquity_rad,
    nutation_rad,
    precession_matrix,
    proper_motion,
    right_ascension_declination,
    sun_direction,
)
from glstar.sky.place.horizon import C_ned_eq
from glstar.sky.place.timescale import (
    centuries_since_j2000,
    mean_sidereal_time_rad,
    parse_utc,
    tt_julian_date,
    ut1_julian_date,
)

ARCSEC = np.pi / 648000
DEG = np.pi / 180
CENTURIES = (1.37, -1.61, 0.283)
STARS = tuple(
    np.array(column)
    for column in (
        (0.7, 3.9, 5.6),
        (0.4, -1.2, 1.1),
        (2.0 * ARCSEC, -3.6 * ARCSEC, 0.7 * ARCSEC),
        (-1.1 * ARCSEC, 0.5 * ARCSEC, 2.3 * ARCSEC),
    )
)


@pytest.mark.parametrize("t", CENTURIES)
def test_nutation_has_the_terms_of_meeus_chapter_22(t: float) -> None:
    node, sun, moon = 125.04452 - 1934.136261 * t, 280.4665 + 36000.7698 * t, 218.3165 + 481267.8813 * t
    terms = ((node, -17.20, 9.20), (2 * sun, -1.32, 0.57), (2 * moon, -0.23, 0.10), (2 * node, 0.21, -0.09))
    in_longitude = sum(sine * np.sin(angle * DEG) for angle, sine, _ in terms)
    in_obliquity = sum(cosine * np.cos(angle * DEG) for angle, _, cosine in terms)
    np.testing.assert_allclose(np.array(nutation_rad(t)) / ARCSEC, [in_longitude, in_obliquity], rtol=0, atol=1e-8)


@pytest.mark.parametrize("t", CENTURIES)
def test_obliquity_and_precession_are_those_of_meeus(t: float) -> None:
    # Eq. (22.2) in degrees: 46.8150", 0.00059" and 0.001813".
    degrees = 23.439291 - 0.013004166 * t - 1.639e-7 * t**2 + 5.0361e-7 * t**3
    assert mean_obliquity_rad(t) / DEG == pytest.approx(degrees, rel=0, abs=1e-13)
    # Eq. (21.3): zeta, z and theta; eq. (21.4) as three rotations of the axes, by the components of their products.
    zeta = (2306.2181 * t + 0.30188 * t**2 + 0.017998 * t**3) * ARCSEC
    z = (2306.2181 * t + 1.09468 * t**2 + 0.018203 * t**3) * ARCSEC
    theta = (2004.3109 * t - 0.42665 * t**2 - 0.041833 * t**3) * ARCSEC
    a, d = STARS[:2]
    A = np.cos(d) * np.sin(a + zeta)
    B = np.cos(theta) * np.cos(d) * np.cos(a + zeta) - np.sin(theta) * np.sin(d)
    C = np.sin(theta) * np.cos(d) * np.cos(a + zeta) + np.cos(theta) * np.sin(d)
    expected = direction(np.arctan2(A, B) + z, np.arcsin(C))
    np.testing.assert_allclose(direction(a, d) @ precession_matrix(t).T, expected, rtol=0, atol=1e-13)


@pytest.mark.parametrize("t", CENTURIES)
def test_aberration_has_the_series_of_meeus_chapter_25(t: float) -> None:
    anomaly = (357.52911 + 35999.05029 * t - 0.0001537 * t**2) * DEG
    centre = (
        (1.914602 - 0.004817 * t - 0.000014 * t**2) * np.sin(anomaly)
        + (0.019993 - 0.000101 * t) * np.sin(2 * anomaly)
        + 0.000289 * np.sin(3 * anomaly)
    )
    sun = (280.46646 + 36000.76983 * t + 0.0003032 * t**2 + centre) * DEG
    eccentricity = 0.016708634 - 0.000042037 * t - 0.0000001267 * t**2
    perihelion = (102.93735 + 1.71946 * t + 0.00046 * t**2) * DEG
    # Along the ecliptic, as complex numbers; then turned to the equator.
    velocity = 1j * (eccentricity * np.exp(1j * perihelion) - np.exp(1j * sun))
    tilt = erfa.rx(-mean_obliquity_rad(t), np.eye(3))
    expected = tilt @ [velocity.real, velocity.imag, 0.0] * 20.49552
    np.testing.assert_allclose(aberration_velocity(t) / ARCSEC, expected, rtol=0, atol=1e-8)


@pytest.mark.parametrize("utc", ["1890-03-04T05:06:07", "2130-10-11T12:13:14"])
@pytest.mark.filterwarnings("ignore::erfa.ErfaWarning")
def test_apparent_places_take_the_steps_in_their_order(utc: str) -> None:
    utc_s = parse_utc(utc)
    t = centuries_since_j2000(tt_julian_date(utc_s))
    ra, dec, pm_ra_cosdec, pm_dec = STARS
    moved = ra + 100 * t * pm_ra_cosdec / np.cos(dec), dec + 100 * t * pm_dec
    np.testing.assert_allclose(proper_motion(*STARS, 100 * t), moved, rtol=1e-14)
    of_date = direction(*moved) @ precession_matrix(t).T + aberration_velocity(t)
    in_longitude, in_obliquity = nutation_rad(t)
    nutation = erfa.numat(mean_obliquity_rad(t), in_longitude, in_obliquity)
    expected = of_date @ nutation.T
    expected /= np.linalg.norm(expected, axis=1)[:, np.newaxis]
    paper = PaperAstrometry()
    np.testing.assert_allclose(paper.apparent_directions(*STARS, utc_s), expected, rtol=0, atol=1e-14)
    np.testing.assert_allclose(paper.C_eq_icrs(utc_s), nutation @ precession_matrix(t), rtol=0, atol=1e-14)
    # The equation of the equinoxes has the true obliquity.
    sidereal = mean_sidereal_time_rad(ut1_julian_date(utc_s, 0.3))
    sidereal += in_longitude * np.cos(mean_obliquity_rad(t) + in_obliquity)
    assert paper.sidereal_time_rad(utc_s, 0.3) == pytest.approx(sidereal % (2 * np.pi), rel=0, abs=1e-14)


def test_erfas_places_have_parallax_and_radial_velocity_in_erfas_units() -> None:
    utc_s = parse_utc("2031-10-11T12:13:14")
    ra, dec, pm_ra_cosdec, pm_dec = STARS
    parallax_arcsec, velocity_km_per_s = np.array([0.1, 0.75, 0.3]), np.array([-20.0, 35.0, 240.0])
    tt = tt_julian_date(utc_s)
    ra_cirs, dec_apparent, origins = erfa.atci13(
        ra, dec, pm_ra_cosdec / np.cos(dec), pm_dec, parallax_arcsec, velocity_km_per_s, *tt
    )
    found = ErfaAstrometry().apparent_directions(
        *STARS, utc_s, parallax_rad=parallax_arcsec * ARCSEC, radial_velocity_m_per_s=1000 * velocity_km_per_s
    )
    np.testing.assert_allclose(found, direction(ra_cirs - origins, dec_apparent), rtol=0, atol=1e-14)
    plain = erfa.atci13(ra, dec, pm_ra_cosdec / np.cos(dec), pm_dec, 0.0, 0.0, *tt)
    expected = direction(plain[0] - origins, plain[1])
    np.testing.assert_allclose(ErfaAstrometry().apparent_directions(*STARS, utc_s), expected, rtol=0, atol=1e-14)
    sidereal = erfa.gst06a(*ut1_julian_date(utc_s, -0.4), *tt)
    assert ErfaAstrometry().sidereal_time_rad(utc_s, -0.4) == pytest.approx(sidereal, rel=0, abs=1e-12)


@pytest.mark.parametrize("utc", ["2024-03-20T03:06:00", "2024-05-05", "2026-11-17T08:00:00"])
def test_the_sun_is_where_the_almanac_s_short_formula_has_it(utc: str) -> None:
    # Astronomical Almanac, page C5: within 0.01 deg from 1950 to 2050.
    utc_s = parse_utc(utc)
    n = utc_s / 86400 + 2440587.5 - 2451545.0
    anomaly = (357.528 + 0.9856003 * n) * DEG
    longitude = (280.460 + 0.9856474 * n + 1.915 * np.sin(anomaly) + 0.020 * np.sin(2 * anomaly)) * DEG
    obliquity = (23.439 - 4e-7 * n) * DEG
    expected = [np.cos(longitude), np.cos(obliquity) * np.sin(longitude), np.sin(obliquity) * np.sin(longitude)]
    found = sun_direction(utc_s)
    assert found.shape == (3,)
    np.testing.assert_allclose(found, expected, rtol=0, atol=0.02 * DEG)
    assert np.linalg.norm(found) == pytest.approx(1.0, rel=0, abs=1e-15)


def test_directions_broadcast_and_have_their_angles_back() -> None:
    found = direction([[0.3], [4.0]], [0.2, -0.9, 1.4])
    assert found.shape == (2, 3, 3)
    # North, then the longitude of date: the zenith of C_ned_eq.
    np.testing.assert_allclose(found[1, 1], -C_ned_eq(-0.9, 4.0)[2], rtol=0, atol=1e-15)
    ra, dec = right_ascension_declination(0.3 * found)
    np.testing.assert_allclose(ra, [[0.3] * 3, [4.0] * 3], rtol=1e-14)
    np.testing.assert_allclose(dec, [[0.2, -0.9, 1.4]] * 2, rtol=1e-13)
