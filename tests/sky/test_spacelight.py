"""Zodiacal light and the Galaxy: published values, no light counted twice, and the drawn sky."""

import erfa
import numpy as np
import pytest

from glstar.sky.air.skybrightness import (
    S10_MAG_ARCSEC2,
    STARLIGHT_IN_DARK_SKY_S10,
    ZODIACAL_IN_DARK_SKY_S10,
    beyond_the_air_s10,
    diffuse_transmission,
    galaxy_s10,
    zodiacal_s10,
)
from glstar.system.resources import asset

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


def test_the_zodiacal_light_has_each_number_of_the_published_table():
    table = """
        15 9000 5300 2690 1450 870 590 410 196 114 78 60
        20 5000 3500 1880 1100 710 495 355 185 110 77 60
        25 3000 2210 1350  860 585 425 320 174 106 76 60
        30 1940 1460  955  660 480 365 285 162 102 74 60
        35 1290  990  710  530 400 310 250 151  98 73 60
        40  925  735  545  415 325 264 220 140  94 72 60
        45  710  570  435  345 278 228 195 130  91 70 60
        60  395  345  275  228 190 163 143 105  81 67 60
        75  264  248  210  177 153 134 118  91  73 64 60
        90  202  196  176  151 130 115 103  81  67 62 60
       105  166  164  154  133 117 104  93  75  64 60 60
       120  147  145  138  120 108  98  88  70  60 58 60
       135  140  139  130  115 105  95  86  70  60 57 60
       150  140  139  129  116 107  99  91  75  62 56 60
       165  153  150  140  129 118 110 102  81  64 56 60
       180  180  166  152  139 127 116 105  82  65 56 60
    """
    rows = np.array([line.split() for line in table.strip().splitlines()], dtype=float)
    latitude_deg = np.array([0, 5, 10, 15, 20, 25, 30, 45, 60, 75, 90])
    longitude_deg = rows[:, :1]
    for turned in (longitude_deg, -longitude_deg, longitude_deg + 720, 360 - longitude_deg):
        found = zodiacal_s10(np.deg2rad(turned), np.deg2rad(-latitude_deg))
        np.testing.assert_allclose(found, rows[:, 1:], rtol=1e-9)
    # Nearer to the Sun it is that at 15 deg; between nodes its logarithm is linear.
    np.testing.assert_allclose(zodiacal_s10(np.deg2rad([3.0, -14.0]), np.deg2rad([5.0, 10.0])), [5300, 2690], rtol=1e-9)
    assert zodiacal_s10(np.deg2rad(17.5), 0.0) == pytest.approx(np.sqrt(9000 * 5000), rel=1e-9)
    weights = {(45, 30): 0.8 * 0.6, (60, 30): 0.2 * 0.6, (45, 45): 0.8 * 0.4, (60, 45): 0.2 * 0.4}
    numbers = {(45, 30): 195, (60, 30): 143, (45, 45): 130, (60, 45): 105}
    expected = np.exp(sum(weight * np.log(numbers[at]) for at, weight in weights.items()))
    assert zodiacal_s10(np.deg2rad(48.0), np.deg2rad(36.0)) == pytest.approx(expected, rel=1e-9)


def test_the_galaxy_is_bilinear_between_the_nodes_of_its_map():
    with np.load(asset("galaxy.npz")) as stored:
        faint, listed = (10 ** (stored[name] / 80.0) for name in ("faint", "listed"))
    assert faint.shape == (73, 144)

    def at(row, column):
        return faint[row, column % 144] + 0.4 * listed[row, column % 144]

    # 2.5 deg between the nodes; of V 6.5 to 10, the stars fainter than 8.6 are not drawn.
    for latitude_deg, longitude_deg in ((-31.0, 61.0), (12.0, 359.0), (89.0, -20.5)):
        row, column = int((latitude_deg + 90) // 2.5), int(longitude_deg % 360 // 2.5)
        down, across = (latitude_deg + 90) / 2.5 - row, longitude_deg % 360 / 2.5 - column
        expected = (1 - down) * ((1 - across) * at(row, column) + across * at(row, column + 1))
        expected += down * ((1 - across) * at(row + 1, column) + across * at(row + 1, column + 1))
        found = galaxy_s10(np.deg2rad(longitude_deg), np.deg2rad(latitude_deg), 8.6)
        assert found == pytest.approx(expected, rel=1e-9)
    poles = galaxy_s10(np.zeros(2), np.deg2rad([-90.0, 90.0]))
    np.testing.assert_allclose(poles, [faint[0, 0] + listed[0, 0], faint[72, 0] + listed[72, 0]], rtol=1e-9)


def test_extended_light_loses_three_quarters_of_the_extinction_of_a_star():
    np.testing.assert_allclose(
        diffuse_transmission(0.3, [1.0, 2.5]), 10 ** (-0.4 * 0.75 * 0.3 * np.array([1, 2.5])), rtol=1e-12
    )
    # 10 mag per square degree of 3600^2 square arcseconds; the parts of a dark sky by Benn & Ellison 1998.
    assert pytest.approx(10 + 2.5 * np.log10(3600.0**2), rel=0, abs=6e-5) == S10_MAG_ARCSEC2
    assert (ZODIACAL_IN_DARK_SKY_S10, STARLIGHT_IN_DARK_SKY_S10) == (60.0, 15.0)
