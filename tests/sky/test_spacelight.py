"""Zodiacal light and the Galaxy: published values, no light counted twice, and the drawn sky."""

import erfa
import numpy as np
import pytest

from glstar.sky.air.skybrightness import S10_MAG_ARCSEC2, beyond_the_air_s10, galaxy_s10, zodiacal_s10

EVERYWHERE = np.meshgrid(np.deg2rad(np.arange(0.5, 360)), np.deg2rad(np.arange(-89.5, 90)))
AREA = np.cos(EVERYWHERE[1])


@pytest.mark.parametrize(
    ("from_sun_deg", "latitude_deg", "s10"), [(90, 0, 202), (-180, 0, 180), (45, 30, 195), (200, 90, 60), (270, 45, 81)]
)
def test_the_zodiacal_light_is_that_of_the_table(from_sun_deg, latitude_deg, s10):
    found = zodiacal_s10(np.deg2rad(from_sun_deg), np.deg2rad([latitude_deg, -latitude_deg]))
    np.testing.assert_allclose(found, s10, rtol=1e-9)


def test_the_zodiacal_light_has_the_published_surface_brightness():
    # Leinert et al. 1998, table 17: 259e-8 W/m2/sr/um at 90 deg from the Sun; V 22.0 there, 23.3 at the pole.
    mags = S10_MAG_ARCSEC2 - 2.5 * np.log10(zodiacal_s10(np.pi / 2, np.array([0.0, np.pi / 2])))
    np.testing.assert_allclose(mags, [22.0, 23.3], rtol=0, atol=0.06)


def test_the_galaxy_has_the_published_light_at_the_poles_and_along_the_equator():
    # Roach & Gordon 1973: 30 S10 at the poles, 160 to 640 along the equator.
    latitude_deg = np.abs(np.rad2deg(EVERYWHERE[1]))
    light = galaxy_s10(*EVERYWHERE)
    assert np.average(light[latitude_deg > 60], weights=AREA[latitude_deg > 60]) == pytest.approx(30, abs=3)
    along = light[np.abs(latitude_deg) < 2].reshape(-1, 36, 10).mean(axis=(0, 2))
    assert 100 < np.percentile(along, 5) < np.percentile(along, 95) < 700
    # The centre of the Galaxy and Carina are brighter than the other side.
    assert galaxy_s10(np.deg2rad(287.0), 0.0) > 2 * galaxy_s10(np.deg2rad(180.0), 0.0)


def test_drawn_stars_are_not_counted_twice():
    limits = [galaxy_s10(*EVERYWHERE, drawn_mag=limit) for limit in (6.0, 6.5, 8.25, 10.0, 12.0)]
    means = [np.average(light, weights=AREA) for light in limits]
    np.testing.assert_allclose(means[0], means[1], rtol=1e-12)
    np.testing.assert_allclose(means[2], (means[1] + means[3]) / 2, rtol=1e-9)
    np.testing.assert_allclose(means[3], means[4], rtol=1e-12)
    # The sum of the Gaia catalogue's stars from V 6.5 to 10 over the sky.
    np.testing.assert_allclose(means[1] - means[3], 31.2, rtol=0, atol=0.6)


def test_directions_are_turned_to_ecliptic_and_galaxy():
    sun = erfa.s2c(0.3, 0.1)
    ecliptic = erfa.ecm06(2451545.0, 0.0)
    opposite = erfa.c2s(ecliptic @ sun)[0] + np.pi
    towards = np.stack([erfa.s2c(opposite, 0.0) @ ecliptic, erfa.s2c(*erfa.g2icrs(np.deg2rad(287.0), 0.0))])
    one, other = (
        beyond_the_air_s10(towards, sun, zodiacal=which, galaxy=not which, drawn_mag=6.5) for which in (True, False)
    )
    assert one[0] == pytest.approx(180, rel=1e-6)
    assert other[1] == pytest.approx(float(galaxy_s10(np.deg2rad(287.0), 0.0)), rel=1e-6)


def test_light_has_the_shape_of_its_directions():
    directions = np.random.default_rng(1).normal(size=(4, 5, 3))
    directions /= np.linalg.norm(directions, axis=-1, keepdims=True)
    options = {"zodiacal": True, "galaxy": True, "drawn_mag": 6.5}
    found = beyond_the_air_s10(directions, np.array([0.0, 0.0, 1.0]), **options)
    each = [beyond_the_air_s10(one[np.newaxis], np.array([0.0, 0.0, 1.0]), **options)[0] for one in directions[2]]
    np.testing.assert_allclose(found[2], each, rtol=1e-12)
    none = beyond_the_air_s10(directions, np.array([0.0, 0.0, 1.0]), zodiacal=False, galaxy=False, drawn_mag=6.5)
    np.testing.assert_array_equal(none, np.zeros((4, 5)))


def test_the_zodiacal_light_has_the_sums_of_the_published_table():
    longitude_deg = np.array([15, 20, 25, 30, 35, 40, 45, 60, 75, 90, 105, 120, 135, 150, 165, 180])
    latitude_deg = np.array([0, 5, 10, 15, 20, 25, 30, 45, 60, 75, 90])
    at = zodiacal_s10(np.deg2rad(longitude_deg)[:, np.newaxis], np.deg2rad(latitude_deg))
    # The sums of the rows and of the columns of the published table (Leinert et al. 1998, table 16).
    np.testing.assert_allclose(
        at.sum(axis=1),
        [20758, 13472, 9166, 6543, 4862, 3795, 3112, 2052, 1592, 1343, 1190, 1092, 1057, 1074, 1163, 1248],
        rtol=0,
        atol=0.4,
    )
    np.testing.assert_allclose(
        at.sum(axis=0), [23652, 16457, 10069, 6668, 4803, 3711, 2964, 1868, 1311, 1056, 960], rtol=0, atol=0.4
    )
