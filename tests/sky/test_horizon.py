"""The horizon: azimuth and altitude, refraction and its inverse, diurnal aberration."""

import erfa
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from glstar.sky.air.refraction import (
    LOWEST_ALTITUDE_RAD,
    bennett_refraction_rad,
    refraction_displacement,
    refraction_rad,
    refraction_scale,
    true_altitude_rad,
)
from glstar.sky.place.apparent import direction
from glstar.sky.place.horizon import (
    C_ned_eq,
    azimuth_altitude_rad,
    diurnal_aberration_rad,
    hour_angle_rad,
    ned_direction,
    ned_to_azimuth_altitude_rad,
)

ARCSEC = np.pi / 648000
ARCMIN = np.pi / 10800
DEG = np.pi / 180
SECOND_OF_TIME = np.pi / 43200
NORTH, EAST, DOWN = np.eye(3)

many = settings(deadline=None, max_examples=200)
angles = st.floats(-2 * np.pi, 2 * np.pi)
latitudes = st.floats(-np.pi / 2, np.pi / 2)

# From the lowest altitude that is drawn to the zenith, closer together where refraction bends.
ALTITUDES = np.concatenate([np.linspace(-1, 5, 6001), np.linspace(5.01, 90, 8500)]) * DEG
AIRS = (0.6, 0.8, 1.0, 1.2, 1.35)


def test_venus_over_washington_agrees_with_meeus() -> None:
    # Meeus, example 13.b: 1987 April 10, 19h21m UT; azimuth 68.0337 deg from the SOUTH, altitude 15.1249 deg.
    sidereal_at_greenwich = (8 * 3600 + 34 * 60 + 56.853) * SECOND_OF_TIME
    east_longitude = -(5 * 3600 + 8 * 60 + 15.7) * SECOND_OF_TIME  # Meeus counts it westward
    latitude = (38 + 55 / 60 + 17 / 3600) * DEG
    ra, dec = (23 * 3600 + 9 * 60 + 16.641) * SECOND_OF_TIME, -(6 + 43 / 60 + 11.61 / 3600) * DEG

    hour_angle = hour_angle_rad(sidereal_at_greenwich + east_longitude, ra)
    azimuth, altitude = azimuth_altitude_rad(hour_angle, dec, latitude)

    assert hour_angle == pytest.approx(64.352133 * DEG, abs=1e-6 * DEG, rel=0)
    assert azimuth == pytest.approx((68.0337 + 180) * DEG, abs=1e-4 * DEG, rel=0)
    assert altitude == pytest.approx(15.1249 * DEG, abs=1e-4 * DEG, rel=0)


@many
@given(angles, angles)
def test_an_hour_angle_runs_from_minus_half_a_turn_to_half_a_turn(sidereal_rad: float, ra_rad: float) -> None:
    hour_angle = hour_angle_rad(sidereal_rad, ra_rad)

    assert -np.pi <= hour_angle <= np.pi
    assert np.exp(1j * hour_angle) == pytest.approx(np.exp(1j * (sidereal_rad - ra_rad)), abs=1e-12)


def test_a_star_past_the_meridian_is_in_the_west() -> None:
    azimuth, _ = azimuth_altitude_rad([0.1, -0.1], 0.0, 0.5)

    assert np.pi < azimuth[0] < 3 * np.pi / 2
    assert np.pi / 2 < azimuth[1] < np.pi


@pytest.mark.parametrize("latitude_deg", [-90.0, -34.93, 0.0, 45.0, 90.0])
@pytest.mark.parametrize("dec_deg", [-90.0, 90.0])
def test_the_celestial_poles_have_an_azimuth_and_the_altitude_of_the_latitude(
    latitude_deg: float, dec_deg: float
) -> None:
    azimuth, altitude = azimuth_altitude_rad(np.linspace(-np.pi, np.pi, 25), dec_deg * DEG, latitude_deg * DEG)

    assert np.isfinite(azimuth).all()
    np.testing.assert_allclose(altitude, np.sign(dec_deg) * latitude_deg * DEG, rtol=0, atol=1e-9 * ARCSEC + 1e-15)
    if abs(latitude_deg) < 90:
        pole_is_south = dec_deg < 0
        np.testing.assert_allclose(np.cos(azimuth), -1.0 if pole_is_south else 1.0, rtol=0, atol=1e-12)


def test_a_star_at_the_zenith_has_an_azimuth_and_an_accurate_altitude() -> None:
    # asin, as in eq. (23), knows an altitude of 89.999 deg to no better than 1e-6" in float64, 3" in float32.
    latitude = -34.93 * DEG
    dec = latitude + np.array([0.0, 1e-3, 1e-6, 1e-9]) * ARCSEC

    azimuth, altitude = azimuth_altitude_rad(0.0, dec, latitude)

    assert np.isfinite(azimuth).all()
    np.testing.assert_allclose(np.pi / 2 - altitude, dec - latitude, rtol=0, atol=1e-15)


@many
@given(st.floats(-np.pi, np.pi), latitudes, latitudes)
def test_azimuth_and_altitude_agree_with_erfa(hour_angle: float, dec: float, latitude: float) -> None:
    azimuth, altitude = azimuth_altitude_rad(hour_angle, dec, latitude)
    expected = erfa.hd2ae(hour_angle, dec, latitude)

    np.testing.assert_allclose(ned_direction(azimuth, altitude), ned_direction(*expected), rtol=0, atol=1e-14)
    assert 0.0 <= azimuth <= 2 * np.pi


@many
@given(st.floats(-np.pi, np.pi), latitudes, latitudes)
def test_the_azimuth_is_that_of_eq_24_corrected(hour_angle: float, dec: float, latitude: float) -> None:
    if min(np.cos(dec), np.cos(latitude)) < 1e-6:
        return
    azimuth, altitude = azimuth_altitude_rad(hour_angle, dec, latitude)
    expected = np.pi + np.arctan2(
        np.sin(hour_angle), np.cos(hour_angle) * np.sin(latitude) - np.tan(dec) * np.cos(latitude)
    )

    np.testing.assert_allclose(ned_direction(azimuth, altitude), ned_direction(expected, altitude), rtol=0, atol=1e-9)


@many
@given(angles, latitudes, angles, latitudes)
def test_the_matrix_and_the_angles_agree(ra: float, dec: float, sidereal: float, latitude: float) -> None:
    through_angles = ned_direction(*azimuth_altitude_rad(hour_angle_rad(sidereal, ra), dec, latitude))

    np.testing.assert_allclose(C_ned_eq(latitude, sidereal) @ direction(ra, dec), through_angles, rtol=0, atol=1e-14)


@many
@given(latitudes, angles)
def test_the_matrix_to_north_east_down_is_a_rotation(latitude: float, sidereal: float) -> None:
    C = C_ned_eq(latitude, sidereal)

    np.testing.assert_allclose(C @ C.T, np.eye(3), rtol=0, atol=1e-14)
    assert np.linalg.det(C) == pytest.approx(1.0)
    # Its last row points down: away from the direction of the zenith.
    np.testing.assert_allclose(-C[2], direction(sidereal, latitude), rtol=0, atol=1e-14)


def test_matrices_are_computed_for_arrays() -> None:
    C = C_ned_eq(np.array([0.1, 0.2, 0.3]), 1.0)

    assert C.shape == (3, 3, 3)
    np.testing.assert_array_equal(C[1], C_ned_eq(0.2, 1.0))


@many
@given(st.floats(0.0, 2 * np.pi, exclude_max=True), latitudes)
def test_azimuth_and_altitude_are_the_inverse_of_eq_29(azimuth: float, altitude: float) -> None:
    u = ned_direction(azimuth, altitude)
    back = ned_to_azimuth_altitude_rad(3.0 * u)

    assert np.linalg.norm(u) == pytest.approx(1.0, abs=1e-15, rel=0)
    np.testing.assert_allclose(ned_direction(*back), u, rtol=0, atol=1e-15)
    assert back[1] == pytest.approx(altitude, abs=1e-12)


def test_azimuth_runs_from_north_through_east() -> None:
    directions = ned_direction(np.array([0.0, 90.0, 180.0, 270.0]) * DEG, np.zeros(4))

    np.testing.assert_allclose(directions, [NORTH, EAST, -NORTH, -EAST], rtol=0, atol=1e-15)
    np.testing.assert_allclose(ned_direction(1.0, np.pi / 2), -DOWN, rtol=0, atol=1e-15)


def test_refraction_of_an_apparent_half_degree_is_that_of_meeus() -> None:
    # Meeus, chapter 16: Bennett's 28.754' at an apparent altitude of 0.5 deg.
    assert bennett_refraction_rad(0.5 * DEG) == pytest.approx(28.754 * ARCMIN, abs=5e-4 * ARCMIN, rel=0)


def test_refraction_of_the_suns_upper_limb_is_that_of_meeus() -> None:
    # The same example: the true altitude 33.25' gives 24.618' without the zenith's constant of 0.0019'.
    assert refraction_rad(33.25 * ARCMIN) == pytest.approx((24.618 + 0.0019) * ARCMIN, abs=2e-3 * ARCMIN, rel=0)


def test_refraction_is_eq_25_and_the_constant_of_the_zenith() -> None:
    h = np.rad2deg(ALTITUDES)
    arcmin = 1.02 / np.tan(np.deg2rad(h + 10.3 / (h + 5.11)))

    np.testing.assert_allclose(refraction_rad(ALTITUDES), (arcmin + 0.0019279) * ARCMIN, atol=1e-9 * ARCSEC, rtol=0)


def test_refraction_at_the_zenith_is_zero() -> None:
    # Eq. (25) as printed moves it by -0.116", past the zenith.
    assert abs(refraction_rad(np.pi / 2)) < 1e-4 * ARCSEC
    assert (refraction_rad(ALTITUDES) > -1e-4 * ARCSEC).all()


def test_below_minus_one_degree_refraction_is_constant() -> None:
    # Eq. (25) turns back at -1.9 deg and explodes at -5.11 deg.
    below = np.linspace(-90.0, -1.0, 8901) * DEG

    np.testing.assert_array_equal(refraction_rad(below), refraction_rad(-1.0 * DEG))
    np.testing.assert_array_equal(
        refraction_displacement(np.sin(below - 1e-9)), refraction_displacement(np.sin(LOWEST_ALTITUDE_RAD))
    )
    assert refraction_rad(-1.0 * DEG) == pytest.approx(38.8 * ARCMIN, abs=0.5 * ARCMIN, rel=0)


def test_refraction_keeps_the_order_of_altitudes() -> None:
    for scale in AIRS:
        assert (np.diff(ALTITUDES + refraction_rad(ALTITUDES, scale)) > 0).all()


def test_bennett_inverts_eq_25_to_four_arcseconds_above_the_horizon() -> None:
    # 3.70" by the formulae as printed; the constant of the zenith in eq. (25) adds 0.116".
    altitudes = ALTITUDES[ALTITUDES >= 0]
    lift = refraction_rad(altitudes)

    off = np.abs(lift - bennett_refraction_rad(altitudes + lift)).max()
    assert off == pytest.approx(3.82 * ARCSEC, abs=0.01 * ARCSEC, rel=0)
    as_printed = lift - 0.0019279 * ARCMIN
    assert np.abs(as_printed - bennett_refraction_rad(altitudes + as_printed)).max() <= 3.7 * ARCSEC + 0.005 * ARCSEC


@pytest.mark.parametrize("scale", [0.0, *AIRS])
def test_the_exact_inverse_removes_refraction(scale: float) -> None:
    apparent = ALTITUDES + refraction_rad(ALTITUDES, scale)

    np.testing.assert_allclose(true_altitude_rad(apparent, scale), ALTITUDES, atol=1e-6 * ARCSEC, rtol=0)


def lifted_by_rad(altitude_rad: np.ndarray, scale: float) -> np.ndarray:
    """By how much the zenith's share raises a unit vector."""
    lift = refraction_displacement(np.sin(altitude_rad), scale)
    return np.arctan2(np.sin(altitude_rad) + lift, np.cos(altitude_rad)) - altitude_rad


def test_the_rational_fit_agrees_with_eq_25_to_a_hundredth_of_an_arcsecond() -> None:
    off = np.abs(lifted_by_rad(ALTITUDES, 1.0) - refraction_rad(ALTITUDES, 1.0))

    assert off.max() < 0.01 * ARCSEC
    assert off.max() < 0.0025 * ARCSEC  # as its docstring says


@pytest.mark.parametrize("scale", AIRS)
def test_scaling_the_displacement_equals_scaling_the_refraction(scale: float) -> None:
    off = np.abs(lifted_by_rad(ALTITUDES, scale) - refraction_rad(ALTITUDES, scale))

    assert off.max() < 0.15 * ARCSEC


def test_without_air_there_is_no_refraction() -> None:
    assert not refraction_displacement(np.sin(ALTITUDES), 0.0).any()
    assert not refraction_rad(ALTITUDES, 0.0).any()


@pytest.mark.parametrize(
    ("pressure_hpa", "temperature_c", "expected"),
    [(1010.0, 10.0, 1.0), (505.0, 10.0, 0.5), (1010.0, 293.0, 0.5), (0.0, 10.0, 0.0), (1010.0, -20.0, 283 / 253)],
)
def test_refraction_follows_the_density_of_the_air(pressure_hpa: float, temperature_c: float, expected: float) -> None:
    assert refraction_scale(pressure_hpa, temperature_c) == pytest.approx(expected, rel=1e-15)


@pytest.mark.parametrize("latitude_deg", [-90.0, -60.0, -34.93, 0.0, 23.4, 45.0, 78.0, 90.0])
def test_diurnal_aberration_is_a_third_of_an_arcsecond_times_the_cosine_of_the_latitude(latitude_deg: float) -> None:
    latitude = latitude_deg * DEG

    assert diurnal_aberration_rad(latitude) == pytest.approx(
        0.3192 * ARCSEC * np.cos(latitude), abs=0.002 * ARCSEC, rel=0
    )


@pytest.mark.parametrize("latitude_deg", [-60.0, -34.93, 0.0, 45.0, 78.0])
@pytest.mark.parametrize("height_m", [0.0, 12000.0])
def test_diurnal_aberration_agrees_with_erfa(latitude_deg: float, height_m: float) -> None:
    light_m_per_s = 299792458.0
    observer = erfa.pvtob(2.4, latitude_deg * DEG, height_m, 0.0, 0.0, 0.0, 1.0)

    assert diurnal_aberration_rad(latitude_deg * DEG, height_m) == pytest.approx(
        np.linalg.norm(observer["v"]) / light_m_per_s, abs=1e-6 * ARCSEC, rel=0
    )


def test_there_is_no_diurnal_aberration_at_the_pole() -> None:
    assert abs(diurnal_aberration_rad(np.pi / 2, 10000.0)) < 1e-12 * ARCSEC
