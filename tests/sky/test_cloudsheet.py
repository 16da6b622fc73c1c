"""The sheet of cloud: cover, spectrum, drift, and energy of its light."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.ndimage import map_coordinates
from scipy.stats import poisson

from glstar.sky.air.clouds import CloudLights, CloudSheet, SheetCrossing, cloud_from_above, cloud_from_below

EARTH_M = 6371008.8  # mean radius of the Earth
SHEET = CloudSheet(0.4, 2.0, 4000.0, 2000.0, 1.0, 20.0, np.deg2rad(270.0), 1)


@pytest.mark.parametrize("coverage", [0.1, 0.4, 0.9, 1.0])
def test_cloud_covers_the_fraction_that_was_asked_for(coverage: float) -> None:
    sheet = CloudSheet(coverage, 2.0, 4000.0, 2000.0, 1.0, 0.0, 0.0, 3)
    x, y = np.random.default_rng(0).uniform(0, 32_000, (2, 40_000))
    depth = sheet.depth_at(x, y, 0.0)
    assert np.mean(depth > 0) == pytest.approx(coverage, rel=0, abs=0.01)
    assert depth.max() < 2.0


def test_cloud_drifts_with_the_wind() -> None:
    x, y = np.random.default_rng(0).uniform(0, 32_000, (2, 100))
    # From the west: after 50 s the cloud is 1000 m farther east.
    np.testing.assert_allclose(
        SHEET.depth_at(x + 1000.0, y, 1.71e9 + 50.0), SHEET.depth_at(x, y, 1.71e9), rtol=0, atol=1e-4
    )


def test_the_spectrum_of_the_field_is_a_power_law() -> None:
    sheet = CloudSheet(1.0, 1.0, 4000.0, 2000.0, 1e6, 0.0, 0.0, 3)  # so wide an edge that the depth is linear
    x = np.arange(1024) * sheet.cell_m
    power = np.zeros(513)
    for y in np.linspace(0, 32_000, 60):
        power += np.abs(np.fft.rfft(sheet.depth_at(x, np.full_like(x, y), 0.0))) ** 2
    k = np.arange(40, 120)
    slope = np.polyfit(np.log(k), np.log(power[k]), 1)[0]
    assert slope == pytest.approx(-8 / 3, rel=0, abs=0.25)


def test_lines_of_sight_meet_the_sheet_of_a_round_earth() -> None:
    for altitude_deg in (0.0, 5.0, 40.0, 90.0):
        a = np.deg2rad(altitude_deg)
        crossing = SHEET.crossed(np.array([np.sin(a)]), np.zeros(1), np.ones(1), (0.0, 0.0, 500.0), 0.0)
        radius, sheet = 6371008.8 + 500.0, 6371008.8 + 4000.0
        sine_there = radius * np.cos(a) / sheet  # the impact parameter stays
        assert crossing.slant[0] == pytest.approx(1 / np.sqrt(1 - sine_there**2), rel=1e-6, abs=0)


def test_no_cloud_has_the_light_of_the_sky_and_thick_cloud_that_of_the_layer() -> None:
    lights = CloudLights(1e5, 0.5, 1e-8)
    sky, town, cosine = np.array([2e-8]), np.array([1e-8]), np.array([0.3])
    none = cloud_from_below(SheetCrossing(np.zeros(1), np.ones(1)), cosine, sky, town, lights)
    np.testing.assert_allclose(none, sky + town, rtol=1e-12, atol=0)
    above = cloud_from_above(SheetCrossing(np.zeros(1), np.ones(1)), 3e-9, lights)
    np.testing.assert_allclose(above, 3e-9, rtol=1e-12, atol=0)
    # What a layer without absorption transmits and reflects of the Moon adds up to what falls on it.
    depth = 5.0
    up, azimuth = np.meshgrid(np.linspace(1e-3, 1, 400), np.linspace(0, 2 * np.pi, 200))
    cosine = up * 0.5 + np.sqrt(1 - up**2) * np.sqrt(0.75) * np.cos(azimuth)
    crossing = SheetCrossing(np.full_like(up, depth), 1 / up)
    moon = cloud_from_below(crossing, cosine, np.zeros_like(up), np.zeros_like(up), CloudLights(1e5, 0.5, 0.0))
    flux = 2 * np.pi * np.mean(moon * up) * (648000 / np.pi) ** 2 / (1e5 * 0.5)
    reflected = cloud_from_above(crossing, 0.0, CloudLights(1e5, 0.5, 0.0)).mean() * np.pi * 4.2545e10 / (1e5 * 0.5)
    assert flux + reflected + np.exp(-depth / 0.5) == pytest.approx(1.0, rel=0, abs=0.1)


@pytest.mark.parametrize("depth", [1e-4, 0.3, 2.0, 8.0])
@pytest.mark.parametrize("sine_moon", [0.2, 0.9])
def test_light_of_the_moon_is_scattered_once_or_often(depth: float, sine_moon: float) -> None:
    slant, cosine, flux = 1.5, np.array([0.95, 0.5, -0.3]), 1e5
    crossing = SheetCrossing(np.full(3, depth), np.full(3, slant))
    dark = np.zeros(3)
    found = cloud_from_below(crossing, cosine, dark, dark, CloudLights(flux, sine_moon, 0.0))
    # Photons meet a number of drops of Poisson's law along the Moon's light: those which met one are spread by Henyey
    # and Greenstein's law of asymmetry 0.85, those which met several equally over the hemisphere.
    along_moon, along_sight = (poisson(depth * factor) for factor in (1 / sine_moon, slant))
    once = along_moon.pmf(1) / along_moon.sf(0)
    forward = (1 - 0.85**2) / (4 * np.pi * (1 + 0.85**2 - 1.7 * cosine) ** 1.5)
    arriving = 1 / (1 + 0.1125 * depth / sine_moon) - along_moon.pmf(0)
    spread = once * forward + (1 - once) * sine_moon / np.pi
    expected = flux * arriving * along_sight.sf(0) / along_moon.sf(0) * spread / (3600 * 180 / np.pi) ** 2
    np.testing.assert_allclose(found, expected, rtol=1e-6)


def test_cloud_dims_the_sky_behind_and_brightens_the_town_below() -> None:
    crossing, one = SheetCrossing(np.array([2.0]), np.array([1.5])), np.ones(1)
    moonless = CloudLights(0.0, 0.5, 0.0)
    np.testing.assert_allclose(cloud_from_below(crossing, 0 * one, one, 0 * one, moonless), np.exp(-3.0), rtol=1e-12)
    # What is not direct of the diffuse 1 / (1 + 0.1125 t) comes from the mean of the sky.
    lit = cloud_from_below(crossing, 0 * one, 0 * one, 0 * one, CloudLights(0.0, 0.5, 1.0))
    np.testing.assert_allclose(lit, 1 / 1.3375 - np.exp(-3.0), rtol=1e-12)
    town = cloud_from_below(crossing, 0 * one, 0 * one, one, moonless)
    reflected = 1 - 1 / 1.225
    thick = cloud_from_below(SheetCrossing(np.array([1e9]), np.array([1.5])), 0 * one, 0 * one, one, moonless)
    np.testing.assert_allclose((town - 1) / (thick - 1), reflected, rtol=1e-6)
    # From above: the ground through the layer, the sky and the Moon reflected by it.
    above = [
        cloud_from_above(crossing, ground, CloudLights(0.0, 0.5, sky))[0] for ground, sky in ((1.0, 0.0), (0.0, 1.0))
    ]
    np.testing.assert_allclose(above, [1 / 1.225, 1 - 1 / 1.3375], rtol=1e-12)
    by_moon = cloud_from_above(crossing, 0.0, CloudLights(1e5, 0.5, 0.0))
    np.testing.assert_allclose(by_moon, 1e5 * 0.5 / np.pi * (1 - 1 / 1.45) / (648000 / np.pi) ** 2, rtol=1e-9)


def ray_crossings(altitude_rad, azimuth_rad, site, sheet_m):
    """Return where straight lines cross a sphere: angles along the sphere, and cosines to the vertical there."""
    height_m = site[2]
    up = np.array([0.0, 0.0, 1.0])
    start = (EARTH_M + height_m) * up
    towards = np.stack(
        [np.cos(altitude_rad) * np.sin(azimuth_rad), np.cos(altitude_rad) * np.cos(azimuth_rad), np.sin(altitude_rad)],
        axis=-1,
    )
    b = towards @ start
    c = start @ start - (EARTH_M + sheet_m) ** 2
    with np.errstate(invalid="ignore"):
        root = np.sqrt(b * b - c)
    path = -b + root if sheet_m > height_m else -b - root
    there = start + path[..., np.newaxis] * towards
    vertical = there / np.linalg.norm(there, axis=-1, keepdims=True)
    return np.arctan2(np.hypot(there[..., 0], there[..., 1]), there[..., 2]), np.abs((vertical * towards).sum(axis=-1))


@pytest.mark.parametrize("height_m", [300.0, 9000.0])
def test_lines_of_sight_cross_the_sheet_at_its_coordinates(height_m: float) -> None:
    sheet = replace(SHEET, latitude_rad=0.6, longitude_rad=np.pi - 0.001)
    altitude = np.deg2rad([[3.0, 20.0, 85.0], [40.0, 0.0, 60.0]]) * (1 if height_m < 4000 else -1)
    altitude[1, 1] = np.deg2rad(0.4 if height_m < 4000 else -4.0)
    azimuth = np.array([[0.3, 2.0, 4.0], [5.5, 1.0, 6.0]])
    # Beyond the meridian of 180 deg.
    site = (0.601, -np.pi + 0.002, height_m)
    found = sheet.crossed(np.sin(altitude), np.sin(azimuth), np.cos(azimuth), site, 5000.0)
    angle, cosine = ray_crossings(altitude, azimuth, site, 4000.0)
    np.testing.assert_allclose(found.slant, 1 / cosine, rtol=1e-6)
    east_m = EARTH_M * (angle * np.sin(azimuth) + np.cos(0.6) * 0.003)
    north_m = EARTH_M * (angle * np.cos(azimuth) + 0.001)
    expected = sheet.depth_at(east_m, north_m, 5000.0)
    np.testing.assert_allclose(found.optical_depth, expected, rtol=0, atol=1e-3)
    assert np.count_nonzero(expected) >= 2
    np.testing.assert_allclose(found.transmission, np.exp(-found.optical_depth / cosine), rtol=1e-5)


def test_lines_that_miss_the_sheet_have_no_cloud() -> None:
    sheet = replace(SHEET, coverage=1.0)
    sine, east, north = np.sin(np.deg2rad([10.0, 0.0, -0.5, -2.0, -30.0, -90.0])), np.zeros(6), np.ones(6)
    above = sheet.crossed(sine, east, north, (0.1, 0.2, 9000.0), 0.0)
    # From 9 km the sheet at 4 km begins 2.27 deg below the horizontal.
    assert (above.optical_depth > 0).tolist() == [False, False, False, False, True, True]
    assert above.slant[5] == pytest.approx(1.0, rel=1e-9)
    below = sheet.crossed(sine, east, north, (0.1, 0.2, 900.0), 0.0)
    assert (below.optical_depth > 0).tolist() == [True, True, True, True, True, False]
    nothing = sheet.crossed(np.array([np.nan]), np.array([np.nan]), np.array([np.nan]), (0.1, 0.2, 900.0), 0.0)
    assert nothing.optical_depth.tolist() == [0.0]
    # In the plane of the sheet a line leaves it upwards where it is.
    at_height = sheet.crossed(np.array([0.5]), np.zeros(1), np.ones(1), (0.0, 0.0, 4000.0), 0.0)
    assert at_height.optical_depth[0] == pytest.approx(float(sheet.depth_at(0.0, 0.0, 0.0)), rel=1e-9)


def test_the_field_is_a_spline_of_filtered_noise() -> None:
    noise = np.random.default_rng(5).standard_normal((1024, 1024))
    wave = np.fft.fftfreq(1024, 1 / 1024)
    # Structures of 1/16 of the period are the largest; power falls as k^(-11/3).
    power = (wave**2 + wave[:, np.newaxis] ** 2 + 16.0**2) ** (-11 / 6)
    power[0, 0] = 0.0
    cells = np.fft.ifft2(np.fft.fft2(noise) * np.sqrt(power)).real

    def spline(x: np.ndarray, y: np.ndarray) -> np.ndarray:
        return map_coordinates(cells, [y, x], order=2, mode="grid-wrap", prefilter=False)

    sample = spline(*np.meshgrid(np.arange(0, 1024, 4) + 0.5, np.arange(0, 1024, 4) + 0.5)).ravel()
    sheet = CloudSheet(0.3, 1.7, 4000.0, 6000.0, 0.8, 12.0, np.deg2rad(200.0), 5)
    assert sheet.cell_m == 93.75
    east_m, north_m = np.random.default_rng(1).uniform(-2e5, 2e5, (2, 400))
    utc_s = 1234.5
    x = (east_m + 12.0 * utc_s * np.sin(np.deg2rad(200.0))) / 93.75
    y = (north_m + 12.0 * utc_s * np.cos(np.deg2rad(200.0))) / 93.75
    least = np.sort(sample)[round(0.7 * (sample.size - 1))]
    above = (spline(x, y) - least) / sample.std()
    expected = 1.7 * (1 - np.exp(-np.maximum(above, 0) / 0.8))
    np.testing.assert_allclose(sheet.depth_at(east_m, north_m, utc_s), expected, rtol=0, atol=1e-9)
    assert 60 < np.count_nonzero(expected) < 180


def test_the_moon_lights_cloud_from_a_fiftieth_of_the_sine_of_its_altitude() -> None:
    crossing, one = SheetCrossing(np.array([0.8, 0.0]), np.array([1.5, 1.2])), np.ones(2)
    for sine, is_lit in ((0.0192, False), (0.02, False), (0.0208, True), (0.3, True)):
        lights = CloudLights(1e5, sine, 1e-9)
        dark = CloudLights(0.0, sine, 1e-9)
        for lit, unlit in (
            (
                cloud_from_below(crossing, 0.2 * one, one, one, lights),
                cloud_from_below(crossing, 0.2 * one, one, one, dark),
            ),
            (cloud_from_above(crossing, 1e-9, lights), cloud_from_above(crossing, 1e-9, dark)),
        ):
            assert (lit[0] > unlit[0]) == is_lit
            assert lit[1] == unlit[1]
    # Ten times the glow of a town under an optical depth of 5: 1 + 25 R.
    crossing = SheetCrossing(np.array([5.0]), np.array([1.0]))
    town = cloud_from_below(crossing, one[:1], 0 * one[:1], one[:1], CloudLights(0.0, 0.5, 0.0))
    assert town[0] == pytest.approx(1 + 25 * (1 - 1 / (1 + 0.1125 * 5)), rel=1e-12)
