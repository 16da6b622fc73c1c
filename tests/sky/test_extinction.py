"""Extinction, against the tables of Green 1992, and the stars that it dims."""

from dataclasses import replace

import numpy as np
import orjson
import pytest

from glstar.camera.exposure import Exposure
from glstar.camera.model import Mount
from glstar.camera.sensor.sensor import Sensor
from glstar.config import Config
from glstar.config.reading import extinction_of
from glstar.render.opengl import GLRenderer
from glstar.render.truth.frame import frame_truth
from glstar.sky.air.extinction import Extinction, air_mass
from tests.support.scenes import NIGHT_UTC_S, camera, sky_over_adelaide

# Green 1992, International Comet Quarterly 14, 55, Table Ia: extinction, mag, by zenith distance, deg, at 0, 0.5, 1, 2
# and 3 km above the sea; all rows, checked against the copy in J. Warell's comet_extinction.m (SAAF, 2024).
GREEN = {
    1: (0.28, 0.24, 0.21, 0.16, 0.13),
    10: (0.29, 0.24, 0.21, 0.16, 0.13),
    20: (0.30, 0.25, 0.22, 0.17, 0.14),
    30: (0.32, 0.28, 0.24, 0.19, 0.15),
    40: (0.37, 0.31, 0.27, 0.21, 0.17),
    45: (0.40, 0.34, 0.29, 0.23, 0.19),
    50: (0.44, 0.37, 0.32, 0.25, 0.21),
    55: (0.49, 0.42, 0.36, 0.28, 0.23),
    60: (0.56, 0.48, 0.41, 0.32, 0.26),
    62: (0.60, 0.51, 0.44, 0.34, 0.28),
    64: (0.64, 0.54, 0.47, 0.37, 0.30),
    66: (0.69, 0.59, 0.51, 0.39, 0.32),
    68: (0.75, 0.64, 0.55, 0.43, 0.35),
    70: (0.82, 0.70, 0.60, 0.47, 0.39),
    71: (0.86, 0.73, 0.63, 0.49, 0.40),
    72: (0.91, 0.77, 0.66, 0.52, 0.43),
    73: (0.96, 0.81, 0.70, 0.55, 0.45),
    74: (1.02, 0.86, 0.74, 0.58, 0.48),
    75: (1.08, 0.92, 0.79, 0.62, 0.51),
    76: (1.15, 0.98, 0.84, 0.66, 0.54),
    77: (1.24, 1.05, 0.91, 0.71, 0.58),
    78: (1.34, 1.13, 0.98, 0.76, 0.63),
    79: (1.45, 1.23, 1.06, 0.83, 0.68),
    80: (1.59, 1.34, 1.16, 0.91, 0.74),
    81: (1.75, 1.48, 1.28, 1.00, 0.82),
    82: (1.94, 1.65, 1.42, 1.11, 0.91),
    83: (2.19, 1.86, 1.60, 1.25, 1.03),
    84: (2.50, 2.12, 1.83, 1.43, 1.17),
    85: (2.91, 2.46, 2.13, 1.66, 1.36),
    86: (3.45, 2.93, 2.53, 1.97, 1.62),
    87: (4.23, 3.59, 3.10, 2.42, 1.99),
    88: (5.41, 4.59, 3.96, 3.09, 2.54),
    89: (7.38, 6.26, 5.40, 4.22, 3.46),
    90: (11.24, 9.53, 8.23, 6.42, 5.28),
}
HEIGHTS_M = (0.0, 500.0, 1000.0, 2000.0, 3000.0)


@pytest.mark.parametrize("zenith_deg", GREEN)
def test_extinction_is_that_of_greens_tables(zenith_deg: int) -> None:
    mass = air_mass(np.cos(np.deg2rad(zenith_deg)))
    ours = [Extinction().zenith_mag(height_m) * mass for height_m in HEIGHTS_M]
    np.testing.assert_allclose(ours, GREEN[zenith_deg], rtol=0, atol=0.006)


def test_the_air_mass_is_that_of_kasten_and_young_down_to_two_degrees() -> None:
    # Kasten & Young 1989, eq. (3), by the apparent altitude in degrees.
    altitude_deg = np.arange(2.0, 91.0)
    sine = np.sin(np.deg2rad(altitude_deg))
    np.testing.assert_allclose(air_mass(sine), 1 / (sine + 0.50572 * (altitude_deg + 6.07995) ** -1.6364), rtol=0.015)


def test_the_part_of_the_air_follows_a_given_pressure() -> None:
    low, thin = (Extinction(pressure_hpa=p).zenith_mag(0.0) for p in (1013.25, 506.625))
    np.testing.assert_allclose(low, 0.2811, rtol=0, atol=1e-9)
    np.testing.assert_allclose(low - thin, 0.1451 / 2, rtol=0, atol=1e-9)


def test_the_parts_of_the_extinction_follow_the_wavelength() -> None:
    # The air, mag per air mass, by Bodhaine et al. 1999; its power for aerosol; 0.030 mag of 300 DU of ozone at 550 nm.
    for wavelength_nm, air_mag in ((462.0, 0.215), (527.0, 0.126), (550.0, 0.105), (575.0, 0.088)):
        air = Extinction(rayleigh_mag=0.1435).at_wavelength(wavelength_nm)
        np.testing.assert_allclose(air.rayleigh_mag, air_mag, rtol=0, atol=6e-4)
        np.testing.assert_allclose(air.aerosol_mag, 0.12 * (wavelength_nm / 510) ** -1.3, rtol=1e-12)
    np.testing.assert_allclose(Extinction(ozone_mag=0.0145).at_wavelength(550.0).ozone_mag, 0.030, rtol=0, atol=0.002)
    there = Extinction().at_wavelength(470.0)
    assert there.zenith_mag(0.0) > Extinction().zenith_mag(0.0) > there.at_wavelength(584.0).zenith_mag(0.0)
    np.testing.assert_allclose(there.at_wavelength(510.0).zenith_mag(0.0), 0.2811, rtol=0, atol=1e-12)


@pytest.mark.parametrize("trail", ["analytic", "sprites"])
def test_stars_are_drawn_fainter_by_the_extinction_in_truth(trail: str) -> None:
    sensor = Sensor(bit_depth=16, reference_peak_dn=20_000.0)
    simulator = sky_over_adelaide(
        camera(), mount=Mount(0.0, np.deg2rad(20), 0.0), sensor=sensor, yaw_rate_rad_per_s=0.02
    )
    exposure = Exposure(NIGHT_UTC_S + 4, 0.5, trail=trail)
    above = simulator.scene(exposure)
    below = replace(simulator, extinction=Extinction()).scene(exposure)
    with GLRenderer.headless() as renderer:
        bright, dim = (renderer.render(scene, seed=0, light=True) for scene in (above, below))
    before, after = (
        orjson.loads(frame_truth(scene, frame, number=0, file="a.png"))
        for scene, frame in ((above, bright), (below, dim))
    )
    flux = {star["star_id"]: star["flux_dn"] for star in before["stars"] if star["in_frame"] == 1}
    compared = [star for star in after["stars"] if star["star_id"] in flux and star["in_frame"] == 1]
    assert len(compared) > 50
    assert "extinction_mag" not in before["stars"][0]
    for star in compared:
        expected = 10 ** (-0.4 * star["extinction_mag"])
        np.testing.assert_allclose(star["flux_dn"], flux[star["star_id"]] * expected, rtol=1e-6)
    np.testing.assert_allclose(after["zenith_extinction_mag"], Extinction().zenith_mag(below.site.height_m), rtol=1e-5)
    # The drawn light as a whole, whose stars have different altitudes.
    ratio = sum(star["flux_dn"] for star in compared) / sum(flux[star["star_id"]] for star in compared)
    np.testing.assert_allclose(dim.light_dn.sum() / bright.light_dn.sum(), ratio, rtol=0.02)
    brightest = max(compared, key=lambda star: star["flux_dn"])
    column, row = round(brightest["centroid_x_px"]), round(brightest["centroid_y_px"])
    window = np.s_[max(row - 12, 0) : row + 13, max(column - 12, 0) : column + 13]
    np.testing.assert_allclose(
        dim.light_dn[window].sum() / bright.light_dn[window].sum(),
        10 ** (-0.4 * brightest["extinction_mag"]),
        rtol=3e-3,
    )


def test_the_config_chooses_height_or_pressure() -> None:
    def extinction(**keys: object) -> Extinction | None:
        config = Config().override(**{key.replace("__", "."): value for key, value in keys.items()})
        return extinction_of(config.sky, config.air)

    assert extinction() is None
    assert extinction(sky__extinction="pressure", air__pressure_hpa=700.0) == Extinction(pressure_hpa=700.0)
    assert extinction(sky__extinction="standard", air__aerosol_mag=0.3) == Extinction(aerosol_mag=0.3)


@pytest.mark.parametrize("wavelength_nm", [420.0, 470.0, 584.0, 620.0, 700.0])
def test_scattering_by_the_air_falls_as_nicolet_says(wavelength_nm: float) -> None:
    # Nicolet 1984 (Planet. Space Sci. 32, 1467): wavelength^-(4 + x), x = 0.389 w + 0.09426 / w - 0.3228, w in um;
    # to 0.550 um, and x = 0.04 beyond.
    def cross_section(um: float) -> float:
        return um ** -(4 + (0.389 * um + 0.09426 / um - 0.3228 if um < 0.55 else 0.04))

    found = Extinction().at_wavelength(wavelength_nm).rayleigh_mag / 0.1451
    expected = cross_section(wavelength_nm / 1000) / cross_section(0.51)
    assert found == pytest.approx(expected, rel=0.01)


def test_the_parts_fall_with_height_by_their_own_scales() -> None:
    air = Extinction(rayleigh_mag=0.2, aerosol_mag=0.3, aerosol_scale_m=2000.0, ozone_mag=0.05)
    assert air.rayleigh_at_mag(7996.0) == pytest.approx(0.2 / np.e, rel=1e-12)
    assert air.aerosol_at_mag(4000.0) == pytest.approx(0.3 / np.e**2, rel=1e-12)
    assert air.zenith_mag(1e6) == pytest.approx(0.05, rel=1e-9)
    # Serdyuchenko et al. 2014 for the Chappuis band: 1.60 at 510 nm, 5.12 at 600 nm.
    assert air.at_wavelength(600.0).ozone_mag == pytest.approx(0.05 * 5.12 / 1.60, rel=1e-12)


def test_the_air_mass_is_forty_at_the_horizon_and_below() -> None:
    assert air_mass([0.0, -0.3]) == pytest.approx([40.0, 40.0], rel=1e-12)
    assert air_mass([1.0, 0.5]) == pytest.approx([1.0, 2.0], rel=1e-3)


def test_ozone_and_scattering_have_their_published_spectra() -> None:
    # Serdyuchenko et al. 2014 at 243 K, 1e-21 cm^2, and Bodhaine et al. 1999, eq. (30), times 1e-28 cm^2.
    chappuis = {
        420: 0.03, 440: 0.13, 460: 0.36, 480: 0.72, 500: 1.24, 510: 1.60, 525: 2.20, 550: 3.40, 575: 4.75, 600: 5.12,
        625: 4.05, 650: 2.60, 700: 0.95,
    }  # fmt: skip

    def cross_section(nm: float) -> float:
        um2 = (nm / 1e3) ** 2
        return (1.0455996 - 341.29061 / um2 - 0.90230850 * um2) / (1 + 0.0027059889 / um2 - 85.968563 * um2)

    air = Extinction(0.2, 0.3, 2000.0, 0.05, pressure_hpa=800.0, by_channel=True)
    for nm, ozone in chappuis.items():
        there = air.at_wavelength(nm)
        assert there.ozone_mag == pytest.approx(0.05 * ozone / 1.60, rel=1e-12)
        assert there.rayleigh_mag == pytest.approx(0.2 * cross_section(nm) / cross_section(510), rel=1e-12)
        assert there.aerosol_mag == pytest.approx(0.3 * (510 / nm) ** 1.3, rel=1e-12)
        assert replace(there, rayleigh_mag=0.2, aerosol_mag=0.3, ozone_mag=0.05, wavelength_nm=510.0) == air
        assert there.wavelength_nm == nm
        # From there to another wavelength, as directly.
        onward, directly = there.at_wavelength(590.0), air.at_wavelength(590.0)
        assert onward.zenith_mag(0.0) == pytest.approx(directly.zenith_mag(0.0), rel=1e-12)
    assert air.at_wavelength(585.0).ozone_mag == pytest.approx(0.05 * (0.6 * 4.75 + 0.4 * 5.12) / 1.6, rel=1e-12)


def test_usual_air_is_greens_and_pressure_replaces_height() -> None:
    usual = Extinction()
    assert usual == Extinction(0.1451, 0.120, 1500.0, 0.016, None, 510.0, by_channel=False)
    assert usual.zenith_mag(2000.0) == pytest.approx(
        0.1451 * np.exp(-2000 / 7996) + 0.12 * np.exp(-2000 / 1500) + 0.016, rel=1e-12
    )
    thin = Extinction(pressure_hpa=700.0)
    assert thin.rayleigh_at_mag(2000.0) == pytest.approx(0.1451 * 700 / 1013.25, rel=1e-12)
    s = np.array([0.02, 0.3, 0.8])
    np.testing.assert_allclose(air_mass(s), 1 / (s + 0.025 * np.exp(-11 * s)), rtol=1e-14)
