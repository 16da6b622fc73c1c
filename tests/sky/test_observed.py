"""The sky over a place and a time."""

import erfa
import numpy as np
import pytest

from glstar.sky.air.refraction import refraction_rad, refraction_scale
from glstar.sky.catalogue.reading import StarCatalogue
from glstar.sky.observed.stars import Sky
from glstar.sky.place.apparent import ASTROMETRY
from glstar.sky.place.horizon import C_ned_eq, azimuth_altitude_rad, hour_angle_rad, ned_direction
from glstar.sky.place.site import Site
from glstar.sky.place.timescale import parse_utc

ARCSEC = np.pi / 648000
DEG = np.pi / 180

ADELAIDE = Site(-34.93 * DEG, 138.60 * DEG, height_m=48.0)
EVENING_UTC_S = parse_utc("2024-03-10T11:00:00Z")
SIRIUS, CANOPUS = 2491, 2326

# What issue 2 asks of places.
PLACES = {"paper": 0.7 * ARCSEC, "erfa": 0.05 * ARCSEC}
# Diurnal aberration, which `Sky` adds and the angles of the paper leave out.
DIURNAL_ABERRATION = 0.3192 * ARCSEC


@pytest.fixture(scope="module")
def bright() -> StarCatalogue:
    """The stars that the unaided eye sees."""
    return StarCatalogue.open("bsc5").brighter_than(6.5)


def angle_rad(one: np.ndarray, other: np.ndarray) -> np.ndarray:
    """The angles between unit vectors that nearly agree."""
    return 2 * np.arcsin(np.linalg.norm(one - other, axis=-1) / 2)


def observed_by_erfa(stars: StarCatalogue, utc_s: float, site: Site) -> np.ndarray:
    """Return NED directions without air or polar motion, UT1 = UTC."""
    day = np.floor(utc_s / 86400)
    astrom, _ = erfa.apco13(
        *(2440587.5 + day, (utc_s - day * 86400) / 86400, 0.0),
        *(site.longitude_rad, site.latitude_rad, site.height_m),
        *(0.0, 0.0, 0.0, 0.0, 0.0, 0.55),
    )
    pm_ra = stars.pm_ra_cosdec_rad_per_yr / np.cos(stars.dec_rad)
    cirs = erfa.atciq(stars.ra_rad, stars.dec_rad, pm_ra, stars.pm_dec_rad_per_yr, 0.0, 0.0, astrom)
    azimuth_rad, zenith_distance_rad, *_ = erfa.atioq(*cirs, astrom)
    return ned_direction(azimuth_rad, np.pi / 2 - zenith_distance_rad)


@pytest.mark.parametrize("road", PLACES)
def test_sirius_and_canopus_over_adelaide_agree_with_erfa(road: str) -> None:
    stars = StarCatalogue.open("bsc5").by_id([SIRIUS, CANOPUS])
    places = Sky(stars, ASTROMETRY[road]).observed_places(EVENING_UTC_S, ADELAIDE)

    ours = ned_direction(places.azimuth_rad, places.altitude_rad)
    assert angle_rad(ours, observed_by_erfa(stars, EVENING_UTC_S, ADELAIDE)).max() < PLACES[road]
    # Two bright stars high over an Australian autumn evening: Canopus in the south, Sirius in the north.
    assert list(places.stars.name) == ["Sirius", "Canopus"]
    assert (places.altitude_rad > 60 * DEG).all()
    assert abs(np.cos(places.azimuth_rad[1])) > np.cos(60 * DEG)
    assert np.cos(places.azimuth_rad[1]) < 0 < np.cos(places.azimuth_rad[0])


@pytest.mark.parametrize("road", PLACES)
def test_the_whole_bright_star_catalogue_agrees_with_erfa(bright: StarCatalogue, road: str) -> None:
    places = Sky(bright, ASTROMETRY[road]).observed_places(EVENING_UTC_S, ADELAIDE)

    off = angle_rad(
        ned_direction(places.azimuth_rad, places.altitude_rad), observed_by_erfa(bright, EVENING_UTC_S, ADELAIDE)
    )
    assert off.max() < PLACES[road]


@pytest.mark.parametrize("road", PLACES)
def test_the_observed_places_are_those_of_eqs_22_to_29(bright: StarCatalogue, road: str) -> None:
    places = Sky(bright, ASTROMETRY[road]).observed_places(EVENING_UTC_S, ADELAIDE)
    sidereal_rad = ASTROMETRY[road].sidereal_time_rad(EVENING_UTC_S, 0.0) + ADELAIDE.longitude_rad
    azimuth, altitude = azimuth_altitude_rad(
        hour_angle_rad(sidereal_rad, places.ra_rad), places.dec_rad, ADELAIDE.latitude_rad
    )

    off = angle_rad(ned_direction(places.azimuth_rad, places.altitude_rad), ned_direction(azimuth, altitude))
    east_of = np.hypot(ned_direction(azimuth, altitude)[:, 0], ned_direction(azimuth, altitude)[:, 2])
    # The observer's motion shifts each star towards the east point, by the sine of its distance from it.
    np.testing.assert_allclose(
        off, DIURNAL_ABERRATION * np.cos(ADELAIDE.latitude_rad) * east_of, rtol=0, atol=1e-3 * ARCSEC
    )
    scale = refraction_scale(ADELAIDE.pressure_hpa, ADELAIDE.temperature_c)
    np.testing.assert_allclose(
        places.apparent_altitude_rad - places.altitude_rad,
        refraction_rad(places.altitude_rad, scale),
        rtol=0,
        atol=1e-9 * ARCSEC,
    )


def test_diurnal_aberration_moves_stars_towards_the_east(bright: StarCatalogue) -> None:
    sky = Sky(bright)
    places = sky.observed_places(EVENING_UTC_S, ADELAIDE)
    C = sky.C_ned_eq([EVENING_UTC_S], ADELAIDE.latitude_rad, ADELAIDE.longitude_rad)[0]
    shift = ned_direction(places.azimuth_rad, places.altitude_rad) - places.stars.direction_eq @ C.T

    assert (shift[:, 1] >= -1e-15).all()
    assert shift[:, 1].max() == pytest.approx(DIURNAL_ABERRATION * np.cos(ADELAIDE.latitude_rad), rel=0.01)


def test_a_star_field_has_the_catalogues_stars_in_their_order(bright: StarCatalogue) -> None:
    stars = Sky(bright).star_field(EVENING_UTC_S)

    assert len(stars) == len(bright) == 8404
    np.testing.assert_array_equal(stars.star_id, bright.star_id)
    np.testing.assert_array_equal(stars.vmag, bright.vmag)
    assert stars.name == bright.name
    assert stars.epoch_utc_s == EVENING_UTC_S
    np.testing.assert_allclose(np.linalg.norm(stars.direction_eq, axis=-1), 1.0, rtol=0, atol=1e-14)


def test_a_star_field_cannot_be_changed(bright: StarCatalogue) -> None:
    stars = Sky(bright).star_field(EVENING_UTC_S)

    for array in (stars.star_id, stars.vmag, stars.direction_eq, stars.C_eq_icrs):
        with pytest.raises(ValueError, match="read-only"):
            array[...] = 0


def test_the_matrix_of_a_star_field_maps_catalogue_directions_near_apparent_ones(bright: StarCatalogue) -> None:
    stars = Sky(bright).star_field(EVENING_UTC_S)

    off = angle_rad(bright.direction @ stars.C_eq_icrs.T, stars.direction_eq)
    # What is left is aberration, and 24 years of proper motion.
    assert np.median(off) < 21 * ARCSEC
    assert off.max() < 24.2 * 7.1 * ARCSEC + 21 * ARCSEC  # Groombridge 1830 goes fastest


def test_without_refraction_apparent_and_true_altitudes_are_equal(bright: StarCatalogue) -> None:
    sky = Sky(bright, refraction=False)
    places = sky.observed_places(EVENING_UTC_S, ADELAIDE)

    assert sky.refraction_scale(ADELAIDE) == 0.0
    np.testing.assert_array_equal(places.apparent_altitude_rad, places.altitude_rad)


def test_thin_air_refracts_less(bright: StarCatalogue) -> None:
    thin = Site(ADELAIDE.latitude_rad, ADELAIDE.longitude_rad, ADELAIDE.height_m, pressure_hpa=505.0)
    lift, thin_lift = (
        places.apparent_altitude_rad - places.altitude_rad
        for places in (Sky(bright).observed_places(EVENING_UTC_S, site) for site in (ADELAIDE, thin))
    )

    assert Sky(bright).refraction_scale(thin) == 0.5
    np.testing.assert_allclose(thin_lift, lift / 2, rtol=0, atol=1e-9 * ARCSEC)


@pytest.mark.parametrize("road", PLACES)
def test_the_matrices_of_one_exposure_advance_with_the_sidereal_time(bright: StarCatalogue, road: str) -> None:
    # The sidereal angle is computed once and extrapolated; ten minutes later it must still be right.
    sky = Sky(bright, ASTROMETRY[road], dut1_s=0.2)
    times = EVENING_UTC_S + np.array([0.0, 0.005, 1.0, 600.0])
    C = sky.C_ned_eq(times, np.full(4, ADELAIDE.latitude_rad), np.linspace(2.41, 2.42, 4))

    assert C.shape == (4, 3, 3)
    for one, utc_s, longitude_rad in zip(C, times, np.linspace(2.41, 2.42, 4), strict=True):
        sidereal_rad = ASTROMETRY[road].sidereal_time_rad(utc_s, 0.2) + longitude_rad
        np.testing.assert_allclose(one, C_ned_eq(ADELAIDE.latitude_rad, sidereal_rad), rtol=0, atol=1e-3 * ARCSEC)


def test_dut1_turns_the_sky_westward(bright: StarCatalogue) -> None:
    stars = StarCatalogue.open("bsc5").by_id([SIRIUS])
    early, late = (Sky(stars, dut1_s=dut1_s).observed_places(EVENING_UTC_S, ADELAIDE) for dut1_s in (0.0, 0.5))
    waited = Sky(stars).observed_places(EVENING_UTC_S + 0.5, ADELAIDE)

    assert abs(late.azimuth_rad - early.azimuth_rad) > 5 * ARCSEC
    np.testing.assert_allclose(late.azimuth_rad, waited.azimuth_rad, rtol=0, atol=1e-3 * ARCSEC)
    np.testing.assert_allclose(late.altitude_rad, waited.altitude_rad, rtol=0, atol=1e-3 * ARCSEC)


def test_apparent_places_change_by_three_hundredths_of_an_arcsecond_in_an_hour(bright: StarCatalogue) -> None:
    for road in PLACES:
        sky = Sky(bright, ASTROMETRY[road])
        now, later = (sky.star_field(EVENING_UTC_S + t).direction_eq for t in (0.0, 3600.0))
        assert angle_rad(now, later).max() < 0.03 * ARCSEC
