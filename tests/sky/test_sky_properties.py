"""What is true of every sky, over every place, at every time."""

import erfa
import numpy as np
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from glstar.render.motion.pointing import Pointing
from glstar.sky.air.refraction import (
    LOWEST_ALTITUDE_RAD,
    refraction_displacement,
    refraction_rad,
    refraction_scale,
    true_altitude_rad,
)
from glstar.sky.catalogue.reading import StarCatalogue
from glstar.sky.observed.stars import Sky
from glstar.sky.place.apparent import ASTROMETRY, direction, precession_matrix, right_ascension_declination
from glstar.sky.place.horizon import C_ned_eq, diurnal_aberration_rad, ned_direction, ned_to_azimuth_altitude_rad
from glstar.sky.place.site import Site
from glstar.sky.place.timescale import parse_utc, tt_julian_date

ARCSEC = np.pi / 648000
DEG = np.pi / 180
SIDEREAL_DAY_S = 86164.0905

many = settings(deadline=None, max_examples=60)

times = st.floats(parse_utc("2000-01-01"), parse_utc("2035-12-31"))
latitudes = st.floats(-np.pi / 2, np.pi / 2)
longitudes = st.floats(-np.pi, np.pi)
altitudes = st.floats(-1.0 * DEG, 90.0 * DEG)
scales = st.floats(0.0, 1.35)
roads = st.sampled_from(sorted(ASTROMETRY))
airs = st.tuples(st.floats(0.0, 1080.0), st.floats(-40.0, 45.0))


@st.composite
def sky_models(draw: st.DrawFn) -> Sky:
    """A sky with a few stars without proper motion, with either astrometry."""
    n = draw(st.integers(1, 8))
    random = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    zeros = np.zeros((4, n))
    stars = StarCatalogue(
        "bsc5",
        np.arange(1, n + 1, dtype=np.int32),
        ("",) * n,
        random.uniform(0, 2 * np.pi, n),
        np.arcsin(random.uniform(-1, 1, n)),
        *zeros,
    )
    return Sky(stars, ASTROMETRY[draw(roads)])


sites = st.builds(
    lambda latitude, longitude, height, air: Site(latitude, longitude, height, *air),
    latitudes,
    longitudes,
    st.floats(0.0, 12000.0),
    airs,
)


def angle_rad(one: np.ndarray, other: np.ndarray) -> np.ndarray:
    """The angles between unit vectors that nearly agree."""
    return 2 * np.arcsin(np.clip(np.linalg.norm(one - other, axis=-1) / 2, 0, 1))


@many
@given(sky_models(), times)
def test_apparent_directions_are_unit_vectors_near_the_catalogues(sky: Sky, utc_s: float) -> None:
    stars = sky.star_field(utc_s)

    np.testing.assert_allclose(np.linalg.norm(stars.direction_eq, axis=-1), 1.0, rtol=0, atol=1e-14)
    # Aberration moves a star by 20.8" at most, the Sun's gravity by 1.75" at its limb.
    assert angle_rad(sky.catalogue.direction @ stars.C_eq_icrs.T, stars.direction_eq).max() < 23 * ARCSEC


@many
@given(sky_models(), times, sites)
def test_paper_and_erfa_agree_on_every_place_away_from_the_sun(sky: Sky, utc_s: float, site: Site) -> None:
    paper, rigorous = (
        Sky(sky.catalogue, road).observed_places(utc_s, site) for road in (ASTROMETRY["paper"], ASTROMETRY["erfa"])
    )
    separation_rad = angle_rad(
        ned_direction(paper.azimuth_rad, paper.altitude_rad), ned_direction(rigorous.azimuth_rad, rigorous.altitude_rad)
    )

    # Light deflection, which the paper leaves out, is 1.75" at the Sun's limb and 0.05" ten degrees off.
    towards_sun = -erfa.epv00(*tt_julian_date(utc_s))[0]["p"]
    from_sun_rad = np.arccos(np.clip(sky.catalogue.direction @ towards_sun / np.linalg.norm(towards_sun), -1, 1))
    assert (separation_rad[from_sun_rad > 10 * DEG] < 0.7 * ARCSEC).all()


@many
@given(sky_models(), times, sites)
def test_azimuths_altitudes_and_right_ascensions_stay_in_their_ranges(sky: Sky, utc_s: float, site: Site) -> None:
    places = sky.observed_places(utc_s, site)

    for angle in (places.azimuth_rad, places.ra_rad):
        assert ((angle >= 0) & (angle <= 2 * np.pi)).all()
    for angle in (places.altitude_rad, places.dec_rad):
        assert (np.abs(angle) <= np.pi / 2).all()
    assert (places.apparent_altitude_rad >= places.altitude_rad - 1e-4 * ARCSEC).all()
    np.testing.assert_allclose(direction(places.ra_rad, places.dec_rad), places.stars.direction_eq, rtol=0, atol=1e-14)


@many
@given(sky_models(), times, sites)
def test_the_angles_and_the_vectors_of_the_renderer_give_the_same_directions(
    sky: Sky, utc_s: float, site: Site
) -> None:
    # `Sky.places` goes through altitudes and eq. (25), `Pointing` through q(s), as the GPU does.
    scale = sky.refraction_scale(site)
    assume(scale < 1.35)
    C = sky.C_ned_eq([utc_s], site.latitude_rad, site.longitude_rad)
    pointing = Pointing(C, -C[:, 2], diurnal_aberration_rad(site.latitude_rad, site.height_m) * C[:, 1], scale)
    places = sky.observed_places(utc_s, site)

    azimuth, altitude = ned_to_azimuth_altitude_rad(pointing.to_camera(places.stars.direction_eq)[0])
    drawn = np.isfinite(altitude)
    off = angle_rad(ned_direction(azimuth, altitude), ned_direction(places.azimuth_rad, places.apparent_altitude_rad))
    assert (off[drawn] < 0.15 * ARCSEC).all()
    # And the same stars are up, but for those within an arcsecond of the apparent horizon.
    clear_of_it = np.abs(places.apparent_altitude_rad) > ARCSEC
    np.testing.assert_array_equal(drawn[clear_of_it], (places.apparent_altitude_rad > 0)[clear_of_it])


@many
@given(st.floats(-1.5 * DEG, 1.0 * DEG), st.floats(0.0, 2 * np.pi), latitudes, scales)
def test_stars_are_up_if_refraction_raises_them_above_the_horizon(
    altitude: float, azimuth: float, latitude: float, scale: float
) -> None:
    apparent = altitude + refraction_rad(altitude, scale)
    assume(abs(apparent) > ARCSEC)
    C = C_ned_eq([latitude], [1.0])
    pointing = Pointing(C, -C[:, 2], np.zeros((1, 3)), scale)

    u_ned = pointing.to_camera(ned_direction([azimuth], [altitude]) @ C[0])[0, 0]
    assert np.isfinite(u_ned).all() == (apparent > 0)


@many
@given(sky_models(), times, latitudes, longitudes, st.floats(-np.pi, np.pi))
def test_a_step_to_the_east_equals_a_later_time(
    sky: Sky, utc_s: float, latitude: float, longitude: float, east_rad: float
) -> None:
    here = sky.C_ned_eq([utc_s], latitude, longitude + east_rad)[0]
    later = sky.C_ned_eq([utc_s + east_rad / (2 * np.pi) * SIDEREAL_DAY_S], latitude, longitude)[0]

    # UTC seconds are good to 2.4e-7 s, 4e-6"; nutation moves the equinox by up to 0.2" in half a day.
    np.testing.assert_allclose(here, later, rtol=0, atol=0.2 * ARCSEC)


@many
@given(times, st.floats(-600.0, 600.0), latitudes, longitudes, roads)
def test_sidereal_time_is_extrapolated_within_an_exposure(
    utc_s: float, delay_s: float, latitude: float, longitude: float, road: str
) -> None:
    sky = Sky(StarCatalogue("bsc5", np.empty(0, np.int32), (), *np.empty((6, 0))), ASTROMETRY[road])
    carried = sky.C_ned_eq(np.array([utc_s, utc_s + delay_s]), latitude, longitude)[1]
    asked = sky.C_ned_eq([utc_s + delay_s], latitude, longitude)[0]

    np.testing.assert_allclose(carried, asked, rtol=0, atol=2e-3 * ARCSEC)


@many
@given(latitudes, st.floats(-10.0, 10.0), st.floats(0.0, 2 * np.pi), latitudes)
def test_the_matrix_to_north_east_down_has_its_transpose_as_inverse(
    latitude: float, sidereal: float, ra: float, dec: float
) -> None:
    C = C_ned_eq(latitude, sidereal)
    back_ra, back_dec = right_ascension_declination(C.T @ (C @ direction(ra, dec)))

    np.testing.assert_allclose(direction(back_ra, back_dec), direction(ra, dec), rtol=0, atol=1e-15)


@many
@given(st.floats(-0.5, 0.5), st.floats(-0.5, 0.5))
def test_precession_is_a_rotation_that_grows_with_time(t: float, further: float) -> None:
    P = precession_matrix(t)

    np.testing.assert_allclose(P @ P.T, np.eye(3), rtol=0, atol=1e-14)
    # 50.3" a year along the ecliptic.
    turned = np.arctan2(np.linalg.norm(P - P.T) / np.sqrt(8), (np.trace(P) - 1) / 2)
    np.testing.assert_allclose(turned, abs(t) * 5029 * ARCSEC, rtol=0, atol=2 * ARCSEC)


@many
@given(st.lists(altitudes, min_size=2, max_size=20, unique=True), scales)
def test_refraction_keeps_the_order_of_two_stars(stars: list[float], scale: float) -> None:
    true = np.sort(stars)
    assume((np.diff(true) > 1e-9).all())

    assert (np.diff(true + refraction_rad(true, scale)) > 0).all()


@many
@given(altitudes, scales)
def test_the_true_altitude_is_the_inverse_of_refraction(altitude: float, scale: float) -> None:
    apparent = altitude + refraction_rad(altitude, scale)

    assert abs(true_altitude_rad(apparent, scale) - altitude) < 1e-6 * ARCSEC


@many
@given(st.floats(-np.pi / 2, np.pi / 2), scales)
def test_refraction_is_never_negative(altitude: float, scale: float) -> None:
    assert refraction_rad(altitude, scale) >= -1e-4 * ARCSEC
    assert refraction_displacement(np.sin(altitude), scale) >= 0.0
    if altitude < LOWEST_ALTITUDE_RAD:
        assert refraction_rad(altitude, scale) == refraction_rad(LOWEST_ALTITUDE_RAD, scale)


@many
@given(st.floats(-40.0, 45.0), st.floats(1.0, 1080.0), st.floats(0.01, 50.0))
def test_colder_and_denser_air_refracts_more(temperature_c: float, pressure_hpa: float, more: float) -> None:
    scale = refraction_scale(pressure_hpa, temperature_c)

    assert refraction_scale(pressure_hpa + more, temperature_c) > scale
    assert refraction_scale(pressure_hpa, temperature_c + more) < scale


@many
@given(latitudes, st.floats(0.0, 20000.0))
def test_diurnal_aberration_never_exceeds_that_of_the_equator(latitude: float, height_m: float) -> None:
    assert 0.0 <= diurnal_aberration_rad(latitude, height_m) <= diurnal_aberration_rad(0.0, height_m)
    assert diurnal_aberration_rad(latitude) == diurnal_aberration_rad(-latitude)
