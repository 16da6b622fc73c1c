"""The lights of the sky one by one, with each number different from 0 and 1, against their formulae."""

from dataclasses import replace

import numpy as np
import pytest

from glstar.sky.air.extinction import Extinction
from glstar.sky.air.skybrightness import (
    LIGHT_LEVELS,
    SkyLights,
    SkyState,
    SkyView,
    light_name,
    moonlight_nl,
    nanolamberts_to_mag,
    sky_radiance,
    twilight_mag,
)

AIR = Extinction(rayleigh_mag=0.13, aerosol_mag=0.21, aerosol_scale_m=1700.0, ozone_mag=0.02)
VIEW = SkyView(
    sine_altitude=np.array([[0.3, -0.1], [0.8, 0.55]]),
    azimuth_rad=np.array([[0.4, 2.0], [3.5, 5.9]]),
    moon_separation_rad=np.deg2rad([[4.0, 9.2], [40.0, 130.0]]),
    sun_separation_rad=np.deg2rad([[3.0, 60.0], [110.0, 7.0]]),
)
DARK = SkyLights(21.2, moonlight=False, twilight=False)
STATE = SkyState(AIR, 1400.0, np.deg2rad(-7.7), np.deg2rad(31.0), -0.9)
SINE = np.array([[0.3, 0.0], [0.8, 0.55]])
MASS = 1 / np.sqrt(1 - 0.96 * (1 - SINE**2))


def added(state: SkyState = STATE, **lights: object) -> np.ndarray:
    """Return what some lights add to the dark sky."""
    return sky_radiance(VIEW, replace(DARK, **lights), state) - sky_radiance(VIEW, DARK, state)


def scattered(mass: np.ndarray | float, k: float) -> np.ndarray:
    return 1 - 10 ** (-0.4 * k * np.asarray(mass))


def test_the_dark_sky_has_the_gradient_of_airglow() -> None:
    k = AIR.zenith_mag(1400.0)
    expected = 10 ** (-0.4 * 21.2) * (0.4 + 0.6 * MASS) * 10 ** (-0.4 * k * (MASS - 1))
    np.testing.assert_allclose(sky_radiance(VIEW, DARK, STATE), expected, rtol=1e-12)
    assert SkyLights() == SkyLights(21.6, True, True, 30.0, None, 0.1)


def test_moonlight_is_scattered_by_what_air_and_aerosol_the_height_leaves() -> None:
    k, at_sea = AIR.zenith_mag(1400.0), AIR.zenith_mag(0.0)
    air = AIR.rayleigh_at_mag(1400.0) / k / (0.13 / at_sea)
    aerosol = AIR.aerosol_at_mag(1400.0) / k / (0.21 / at_sea)
    degrees = np.rad2deg(VIEW.moon_separation_rad)
    moon_mass = 1 / np.sqrt(1 - 0.96 * np.cos(np.deg2rad(31.0)) ** 2)
    alpha = np.rad2deg(0.9)
    illuminance = 10 ** (-0.4 * (3.84 + 0.026 * alpha + 4e-9 * alpha**4))
    by_air = 10**5.36 * (1.06 + np.cos(VIEW.moon_separation_rad) ** 2)
    by_aerosol = np.where(degrees < 8.4, 6.2e7 / degrees**2, 10 ** (6.15 - degrees / 40))
    light_nl = (air * by_air + aerosol * by_aerosol) * illuminance * 10 ** (-0.4 * k * moon_mass) * scattered(MASS, k)
    # Garstang: B = 34.08 exp(20.7233 - 0.92104 V).
    mag = (20.7233 - np.log(light_nl / 34.08)) / 0.92104
    np.testing.assert_allclose(nanolamberts_to_mag(light_nl), mag, rtol=1e-13)
    np.testing.assert_allclose(added(moonlight=True), 10 ** (-0.4 * mag), rtol=1e-6)
    below = replace(STATE, moon_altitude_rad=np.deg2rad(-0.5))
    at_horizon = replace(STATE, moon_altitude_rad=0.0)
    ratio = added(below, moonlight=True) / added(at_horizon, moonlight=True)
    np.testing.assert_allclose(ratio, 10 ** (-0.4 * 1.3 * 0.5), rtol=1e-6)
    # Of the aureole's law only within 10 deg, where it is above the other one to 8.4 deg.
    near = moonlight_nl(np.deg2rad([8.3, 8.5, 9.9, 10.1]), 1.5, 1.2, 0.0, 0.2, rayleigh=0.0)
    expected = np.array([6.2e7 / 8.3**2, *(10 ** (6.15 - d / 40) for d in (8.5, 9.9, 10.1))])
    np.testing.assert_allclose(near / near[1], expected / expected[1], rtol=1e-9)


def test_air_without_parts_scatters_no_moonlight() -> None:
    nothing = Extinction(0.0, 0.0, 1500.0, 0.0)
    vacuum = Extinction(aerosol_mag=0.0, ozone_mag=0.0, pressure_hpa=0.0)
    ozone = Extinction(0.0, 0.0, 1500.0, 0.3)
    for air in (nothing, vacuum, ozone):
        state = replace(STATE, extinction=air)
        assert added(state, moonlight=True).max() < 1e-15
    clean = replace(STATE, extinction=Extinction(0.13, 0.0, 1500.0, 0.02))
    assert added(clean, moonlight=True).min() > 1e-11


def test_twilight_has_schaefers_gradient_towards_the_sun() -> None:
    k, at_sea = AIR.zenith_mag(1400.0), AIR.zenith_mag(0.0)
    at_zenith = 10 ** (-0.4 * (11.84 + 1.518 * 2.7 - 0.057 * 2.7**2)) - 10 ** (-0.4 * 21.6)
    towards_sun = 97.7 / np.maximum(np.rad2deg(VIEW.sun_separation_rad), 5.0)
    zenith_deg = np.rad2deg(np.arccos(SINE))
    expected = at_zenith * towards_sun * scattered(MASS, k) / scattered(1.0, at_sea)
    expected *= 10 ** (0.4 * zenith_deg / (360 * max(k, 0.2)))
    np.testing.assert_allclose(added(twilight=True), expected, rtol=1e-9)
    assert twilight_mag(np.deg2rad(-7.7)) == pytest.approx(11.84 + 1.518 * 2.7 - 0.057 * 2.7**2, rel=1e-12)
    night = replace(STATE, sun_altitude_rad=np.deg2rad(-15.9))
    np.testing.assert_array_equal(added(night, twilight=True), np.zeros((2, 2)))


def test_a_town_glows_towards_its_azimuth_or_all_around() -> None:
    k, at_sea = AIR.zenith_mag(1400.0), AIR.zenith_mag(0.0)
    depth = scattered(1.0, k) / scattered(1.0, at_sea)
    towards = ((1 + np.cos(VIEW.azimuth_rad - 1.3)) / 2) ** 2
    expected = 10 ** (-0.4 * 19.3) * (1 + 8 * towards * (1 - SINE) ** 3) * depth
    np.testing.assert_allclose(added(town_mag_arcsec2=19.3, town_azimuth_rad=1.3), expected, rtol=1e-9)
    around = 10 ** (-0.4 * 19.3) * (1 + 4 * (1 - SINE) ** 3) * depth
    np.testing.assert_allclose(added(town_mag_arcsec2=19.3), around, rtol=1e-9)
    assert not added(town_mag_arcsec2=30.0).any()


def test_lights_are_named_from_day_to_night() -> None:
    names = [name for name, _ in LIGHT_LEVELS]
    assert names == ["day", "civil twilight", "nautical twilight", "astronomical twilight", "night"]
    altitudes_deg = (40.0, -0.8, -0.86, -5.9, -6.1, -12.1, -18.1, -90.0)
    expected = [names[k] for k in (0, 0, 1, 1, 2, 3, 4, 4)]
    assert [light_name(np.deg2rad(deg)) for deg in altitudes_deg] == expected
