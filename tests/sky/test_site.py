"""Places of observation and their air."""

import numpy as np
import pytest

from glstar.config import Config
from glstar.errors import ConfigError
from glstar.sky.air.refraction import refraction_scale
from glstar.sky.place.site import (
    Site,
    geocentric_m,
    geodetic,
    local_ned_m,
    north_east_down_m,
    north_east_of,
    radii_of_curvature_m,
    semi_axes_m,
    surface_offset_km,
)

DEG = np.pi / 180


def test_a_site_is_at_height_0_in_standard_air_by_default() -> None:
    site = Site(-34.93 * DEG, 138.60 * DEG)

    assert (site.height_m, site.pressure_hpa, site.temperature_c) == (0.0, 1010.0, 10.0)


def test_standard_air_is_the_air_of_eqs_25_and_27() -> None:
    site = Site(0.0, 0.0)

    assert refraction_scale(site.pressure_hpa, site.temperature_c) == 1.0


@pytest.mark.parametrize("latitude_deg", [-90.0, 90.0])
def test_the_poles_are_valid_sites(latitude_deg: float) -> None:
    assert Site(latitude_deg * DEG, 0.0).latitude_rad == latitude_deg * DEG


@pytest.mark.parametrize("longitude_deg", [-180.0, 180.0, 221.4, 360.0])
def test_longitudes_may_be_given_up_to_180_or_360_degrees(longitude_deg: float) -> None:
    assert Site(0.0, longitude_deg * DEG).longitude_rad == longitude_deg * DEG


@pytest.mark.parametrize("latitude_deg", [-90.001, 91.0, 138.6])
def test_a_latitude_beyond_the_pole_is_refused_in_degrees(latitude_deg: float) -> None:
    with pytest.raises(ConfigError, match=f"latitude {latitude_deg:.6f} deg lies beyond the pole; .* -90 to 90"):
        Site(latitude_deg * DEG, 0.0)


def test_degrees_instead_of_radians_are_refused() -> None:
    with pytest.raises(ConfigError, match="beyond the pole"):
        Site(-34.93, 138.60)
    with pytest.raises(ConfigError, match="more than a turn"):
        Site(-34.93 * DEG, 138.60)


@pytest.mark.parametrize("longitude_deg", [-360.1, 400.0])
def test_a_longitude_of_more_than_a_turn_is_refused(longitude_deg: float) -> None:
    with pytest.raises(ConfigError, match=r"is more than a turn; it runs from -180 to 180, or 0 to 360"):
        Site(0.0, longitude_deg * DEG)


def test_a_negative_pressure_is_refused_and_zero_means_no_air() -> None:
    with pytest.raises(ConfigError, match=r"-1\.0 hPa is negative; give the station pressure, or 0 for no air"):
        Site(0.0, 0.0, pressure_hpa=-1.0)
    assert Site(0.0, 0.0, pressure_hpa=0.0).pressure_hpa == 0.0


@pytest.mark.parametrize("temperature_c", [-273.0, -300.0])
def test_a_temperature_below_absolute_zero_is_refused(temperature_c: float) -> None:
    # 273, as eq. (28) has it, so that its denominator never vanishes.
    with pytest.raises(ConfigError, match="below absolute zero"):
        Site(0.0, 0.0, temperature_c=temperature_c)


@pytest.mark.parametrize("key", ["latitude_rad", "longitude_rad", "height_m", "pressure_hpa", "temperature_c"])
@pytest.mark.parametrize("number", [float("nan"), float("inf"), float("-inf")])
def test_a_site_needs_finite_numbers(key: str, number: float) -> None:
    with pytest.raises(ConfigError, match="finite numbers"):
        Site(**{"latitude_rad": 0.0, "longitude_rad": 0.0} | {key: number})


@pytest.mark.parametrize(
    ("key", "limits"), [("height_m", (-1000, 1e5)), ("pressure_hpa", (0, 1200)), ("temperature_c", (-120, 100))]
)
def test_air_and_height_have_the_limits_of_the_config(key: str, limits: tuple[float, float]) -> None:
    for number in limits:
        assert getattr(Site(0.0, 0.0, **{key: number}), key) == number
        beyond = np.nextafter(number, number * 2 if number else -1.0)
        with pytest.raises(ConfigError):
            Site(0.0, 0.0, **{key: float(beyond)})
        dotted = f"{'flight' if key == 'height_m' else 'air'}.{key}"
        place = {"flight.latitude_deg": 0.0, "flight.longitude_deg": 0.0}
        Config().override(**place, **{dotted: float(number)})
        with pytest.raises(ConfigError, match=key):
            Config().override(**place, **{dotted: float(beyond)})


EQUATOR_M, POLAR_M = 6378137.0, 6356752.314245179  # WGS84


def test_the_ellipsoid_is_wgs84() -> None:
    np.testing.assert_allclose(semi_axes_m(), [EQUATOR_M, EQUATOR_M, POLAR_M], rtol=1e-15)
    e2 = 1 - (POLAR_M / EQUATOR_M) ** 2
    latitude_rad = np.array([-80.0, -35.0, 5.0, 52.0]) * DEG
    w = 1 - e2 * np.sin(latitude_rad) ** 2
    along_m, across_m = radii_of_curvature_m(latitude_rad)
    np.testing.assert_allclose(along_m, EQUATOR_M * (1 - e2) / w**1.5, rtol=1e-14)
    np.testing.assert_allclose(across_m, EQUATOR_M / np.sqrt(w), rtol=1e-14)
    longitude_rad, height_m = np.array([10.0, 138.0, -70.0, 200.0]) * DEG, np.array([0.0, 1234.0, -50.0, 9e3])
    position_m = geocentric_m(latitude_rad, longitude_rad, height_m)
    from_axis_m = (across_m + height_m) * np.cos(latitude_rad)
    up_m = ((POLAR_M / EQUATOR_M) ** 2 * across_m + height_m) * np.sin(latitude_rad)
    expected = [from_axis_m * np.cos(longitude_rad), from_axis_m * np.sin(longitude_rad), up_m]
    np.testing.assert_allclose(position_m, np.transpose(expected), rtol=0, atol=1e-8)
    back = geodetic(position_m)
    np.testing.assert_allclose(back[0], latitude_rad, rtol=1e-13)
    np.testing.assert_allclose(np.cos(back[1] - longitude_rad), 1.0, rtol=1e-13)
    np.testing.assert_allclose(back[2], height_m, rtol=0, atol=1e-7)


def test_positions_are_north_east_and_down_of_a_site() -> None:
    site = Site(-35.0 * DEG, 138.0 * DEG, 300.0)
    at_m = geocentric_m(site.latitude_rad, site.longitude_rad, site.height_m)
    s, c = np.sin(138.0 * DEG), np.cos(138.0 * DEG)
    up = np.array([np.cos(-35.0 * DEG) * c, np.cos(-35.0 * DEG) * s, np.sin(-35.0 * DEG)])
    east = np.array([-s, c, 0.0])
    axes = np.array([np.cross(up, east), east, -up])
    places = np.array([[-34.9, 138.3, 1500.0], [-35.2, 137.6, 10.0]]) * [DEG, DEG, 1.0]
    chord_m = geocentric_m(*places.T) - at_m
    found = north_east_down_m(site, *places.T)
    np.testing.assert_allclose(found, chord_m @ axes.T, rtol=0, atol=1e-7)
    np.testing.assert_allclose(local_ned_m(site, geocentric_m(*places.T)), found, rtol=0, atol=1e-7)
    # North and east first: 0.1 deg and 0.3 deg, and above.
    assert found[0] == pytest.approx([11_130.0, 27_390.0, -1132.0], rel=0.01)
    latitude_rad, longitude_rad = north_east_of(site, 3000.0, -2000.0)
    ground = Site(site.latitude_rad, site.longitude_rad)
    near_m = north_east_down_m(ground, latitude_rad, longitude_rad, 0.0)
    # The surface falls by 13e6 m^2 over the diameter of the Earth.
    np.testing.assert_allclose(near_m[:2], [3000.0, -2000.0], rtol=0, atol=2e-3)
    assert near_m[2] == pytest.approx(1.02, rel=0.01)


def test_an_offset_along_the_surface_is_an_arc() -> None:
    site = Site(-35.0 * DEG, 138.0 * DEG, 9000.0)
    along_m, across_m = radii_of_curvature_m(site.latitude_rad)
    north_km, east_km = surface_offset_km(site, -34.9 * DEG, 138.0 * DEG)
    assert north_km == pytest.approx(0.1 * DEG * along_m / 1000, rel=1e-5)
    assert east_km == pytest.approx(0.0, rel=0, abs=1e-9)
    north_km, east_km = surface_offset_km(site, -35.0 * DEG, 137.8 * DEG)
    assert east_km == pytest.approx(-0.2 * DEG * across_m * np.cos(35.0 * DEG) / 1000, rel=1e-5)
    assert abs(north_km) < 0.03
    assert surface_offset_km(site, site.latitude_rad, site.longitude_rad) == (0.0, 0.0)
    # A third of a turn along the equator, and nearly half a turn: as an arc of a sphere of its radius.
    equator = Site(0.0, 10.0 * DEG)
    for degrees in (120.0, 179.0):
        north_km, east_km = surface_offset_km(equator, 0.0, (10.0 + degrees) * DEG)
        assert (north_km, east_km) == pytest.approx((0.0, degrees * DEG * EQUATOR_M / 1000), rel=1e-9, abs=1e-6)
    # From the equator to the pole there are 10 002 km along a meridian.
    north_km, _ = surface_offset_km(equator, 90.0 * DEG, 10.0 * DEG)
    assert north_km == pytest.approx(10_002.0, rel=2e-3)


@pytest.mark.parametrize(
    ("numbers", "message"),
    [
        ((1.6, 0.0), "latitude 91.673247 deg lies beyond the pole; it runs from -90 to 90"),
        ((0.1, -6.4), "longitude -366.692989 deg is more than a turn; it runs from -180 to 180, or 0 to 360"),
        ((0.1, 0.2, 0.0, -0.5), "a pressure of -0.5 hPa is negative; give the station pressure, or 0 for no air"),
        ((0.1, 0.2, 0.0, 900.0, -273.5), "an air temperature of -273.5 deg C is below absolute zero"),
        ((0.1, 0.2, -1001.0), "a height of -1001 m is not possible; it must be from -1000 to 100000 m"),
        ((0.1, 0.2, 0.0, 1201.0), "a pressure of 1201 hPa is not possible; it must be from 0 to 1200 hPa"),
        (
            (0.1, 0.2, 0.0, 900.0, -272.0),
            "an air temperature of -272 deg C is not possible; it must be from -120 to 100 deg C",
        ),
        ((0.1, 0.2, np.inf), "a site needs finite numbers, not (0.1, 0.2, inf, 1010.0, 10.0)"),
    ],
)
def test_a_refusal_says_what_a_site_allows(numbers: tuple[float, ...], message: str) -> None:
    with pytest.raises(ConfigError) as refused:
        Site(*numbers)
    assert str(refused.value) == message


def test_rounding_may_pass_the_pole_and_the_turn() -> None:
    assert Site(np.pi / 2 + 5e-13, 2 * np.pi + 5e-13).height_m == 0.0
    for numbers in ((np.pi / 2 + 5e-12, 0.0), (0.0, 2 * np.pi + 5e-12)):
        with pytest.raises(ConfigError):
            Site(*numbers)
