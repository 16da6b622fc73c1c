"""Bodies and frames to their last digits: each step written out again with ERFA, and bounds on both sides."""

from dataclasses import replace
from pathlib import Path

import erfa
import numpy as np
import pytest

from glstar.errors import CatalogueError, ConfigError
from glstar.rotation import about_z
from glstar.sky.air.refraction import refraction_rad
from glstar.sky.catalogue.reading import StarCatalogue
from glstar.sky.observed import solarsystem
from glstar.sky.observed.risings import _crossings, body_rise_and_set, star_rise_and_set
from glstar.sky.observed.solarsystem import (
    AU_KM,
    BODIES,
    LIGHT_KM_PER_DAY,
    PLANETS,
    earth_state,
    earthshine_vmag,
    is_corrected,
    moon_km,
    moon_over,
    moon_vmag,
    observed_bodies,
    planet_km,
    planet_vmag,
    sun_vmag,
)
from glstar.sky.observed.stars import SIDEREAL_RAD_PER_S, Sky, sun_altitude_rad
from glstar.sky.place.apparent import ASTROMETRY, direction
from glstar.sky.place.horizon import C_ned_eq, HorizonProfile, dip_rad, ned_direction
from glstar.sky.place.site import Site, geocentric_m
from glstar.sky.place.timescale import EarthOrientation, parse_utc, tt_julian_date

SITE = Site(np.deg2rad(-31.0), np.deg2rad(147.0), 2500.0, 760.0, 4.0)
UTC_S = parse_utc("2027-09-04T13:14:15.5Z")
RADII_KM = {
    "Sun": 695700, "Moon": 1737.4, "Mercury": 2439.7, "Venus": 6051.8, "Mars": 3396.19, "Jupiter": 71492,
    "Saturn": 60268, "Uranus": 25559, "Neptune": 24764,
}  # fmt: skip


def sky_of(**keys: object) -> Sky:
    return Sky(StarCatalogue.open("bsc5").by_id([2491]), ASTROMETRY["erfa"], **({"dut1_s": 0.2} | keys))


def earth_km(tt: tuple[float, float]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the Earth from the Sun, and its place and velocity, km a day, from the barycentre."""
    heliocentric, barycentric = erfa.epv00(*tt)
    return tuple(149597870.7 * of for of in (heliocentric["p"], barycentric["p"], barycentric["v"]))


def barycentric_km(name: str, tt: tuple[float, float]) -> np.ndarray:
    heliocentric, barycentric, _ = earth_km(tt)
    if name == "Moon":
        return barycentric + moon_km(tt)
    return barycentric - heliocentric + (planet_km(name, tt) if name != "Sun" else 0)


def observer_km(tt: tuple[float, float], sky: Sky) -> np.ndarray:
    """Return where the observer is from the barycentre: the place on the Earth, turned by the sidereal time."""
    to_icrs = sky.astrometry.C_eq_icrs(UTC_S).T
    place = geocentric_m(SITE.latitude_rad, SITE.longitude_rad, SITE.height_m) / 1000
    angle = sky.astrometry.sidereal_time_rad(UTC_S, 0.2)
    turned = np.array([
        [np.cos(angle), -np.sin(angle), 0], [np.sin(angle), np.cos(angle), 0], [0, 0, 1]
    ]) @ place  # fmt: skip
    return earth_km(tt)[1] + to_icrs @ turned


@pytest.mark.parametrize("name", BODIES)
def test_a_body_is_where_its_light_arrives_from(name: str) -> None:
    sky, tt = sky_of(), tt_julian_date(UTC_S)
    body = observed_bodies(sky, UTC_S, SITE, (name,))[0]
    here = observer_km(tt, sky)
    heliocentric, barycentric, velocity = earth_km(tt)
    sun_now = barycentric - heliocentric
    days = 0.0
    for _ in range(6):
        then = tt[0], tt[1] - days
        from_here = barycentric_km(name, then) - here
        days = float(np.linalg.norm(from_here)) / (299792.458 * 86400)
    sun_then = earth_km(then)[1] - earth_km(then)[0]
    from_sun = barycentric_km(name, then) - sun_then
    from_sun_to_here = (here - sun_now) / 149597870.7
    sun_au = float(np.linalg.norm(from_sun_to_here))
    seen = from_here / np.linalg.norm(from_here)
    if name not in ("Sun", "Moon"):
        seen = erfa.ld(1.0, seen, from_sun / np.linalg.norm(from_sun), from_sun_to_here / sun_au, sun_au, 1e-6)
    beta = velocity / (299792.458 * 86400)
    to_eq = sky.astrometry.C_eq_icrs(UTC_S)

    def aberrated(towards: np.ndarray) -> np.ndarray:
        return to_eq @ erfa.ab(towards, beta, sun_au, np.sqrt(1 - beta @ beta))

    expected = aberrated(seen)
    assert body.name == name
    np.testing.assert_allclose(body.direction_eq, expected, rtol=0, atol=1e-11)
    distance_km = float(np.linalg.norm(from_here))
    assert body.distance_km == pytest.approx(distance_km, rel=1e-10)
    assert np.sin(body.angular_radius_rad) * distance_km == pytest.approx(RADII_KM[name], rel=1e-9)
    to_ned = sky.C_ned_eq([UTC_S], SITE.latitude_rad, SITE.longitude_rad)[0]
    # The parallel of the site turns once in a sidereal day.
    place_m = geocentric_m(SITE.latitude_rad, SITE.longitude_rad, SITE.height_m)
    speed = 7.292115e-5 * np.hypot(*place_m[:2]) / 299792458.0
    turned = to_ned @ expected + [0.0, speed, 0.0]
    np.testing.assert_allclose(body.diurnal_aberration_eq, to_ned.T @ [0.0, speed, 0.0], rtol=0, atol=1e-12)
    turned /= np.linalg.norm(turned)
    np.testing.assert_allclose(ned_direction(body.azimuth_rad, body.altitude_rad), turned, rtol=0, atol=1e-11)
    np.testing.assert_allclose(direction(*body.ra_dec_rad), to_ned.T @ turned, rtol=0, atol=1e-11)
    scale = 760 / 1010 * 283 / 277
    refracted = body.altitude_rad + refraction_rad(body.altitude_rad, scale)
    assert body.apparent_altitude_rad == pytest.approx(refracted, rel=0, abs=1e-13)
    if name == "Sun":
        assert (body.phase_angle_rad, body.bright_limb_rad, body.sun_direction_eq.any()) == (0.0, None, False)
        assert body.vmag == pytest.approx(sun_vmag(distance_km / AU_KM), rel=0, abs=1e-9)
        assert (body.earthshine_vmag, body.light_vmag, body.illuminated_fraction) == (None, body.vmag, 1.0)
        return
    to_sun = -from_sun / np.linalg.norm(from_sun)
    np.testing.assert_allclose(body.sun_direction_eq, to_eq @ to_sun, rtol=0, atol=1e-11)
    phase = np.arccos(to_sun @ -from_here / distance_km)
    assert body.phase_angle_rad == pytest.approx(phase, rel=0, abs=1e-9)
    assert body.illuminated_fraction == pytest.approx((1 + to_sun @ -from_here / distance_km) / 2, rel=0, abs=1e-9)
    # Meeus, eq. (48.5).
    sun = aberrated((sun_now - here) / np.linalg.norm(sun_now - here))
    (ra, dec), (sun_ra, sun_dec) = ((np.arctan2(y, x), np.arcsin(z)) for x, y, z in (expected, sun))
    limb = np.arctan2(
        np.cos(sun_dec) * np.sin(sun_ra - ra),
        np.sin(sun_dec) * np.cos(dec) - np.cos(sun_dec) * np.sin(dec) * np.cos(sun_ra - ra),
    )
    assert body.bright_limb_rad == pytest.approx(limb % (2 * np.pi), rel=0, abs=1e-8)
    if name != "Moon":
        year = 2000 + (tt[0] - 2451545 + tt[1]) / 365.25
        mag = planet_vmag(name, from_sun / AU_KM, from_here / AU_KM, float(phase), year)
        assert body.vmag == pytest.approx(mag, rel=0, abs=1e-7)
        assert body.earthshine_vmag is None
        return
    assert body.vmag == pytest.approx(moon_vmag(phase, distance_km, np.linalg.norm(from_sun) / AU_KM), rel=0, abs=1e-9)
    from_earth = barycentric_km("Moon", then) - barycentric
    earth_phase = np.arccos(from_earth @ -heliocentric / np.linalg.norm(from_earth) / np.linalg.norm(heliocentric))
    moon_distance_km, sun_distance_au = np.linalg.norm(from_earth), np.linalg.norm(heliocentric) / AU_KM
    # Mallama & Hilton 2018, eq. (5): the Earth from the Moon; it lights the Moon as the Sun of -26.75 does.
    a = np.rad2deg(earth_phase)
    earth_mag = -3.99 - 1.060e-3 * a + 2.054e-4 * a * a + 5 * np.log10(moon_distance_km / AU_KM * sun_distance_au)
    earthshine = -12.73 + 5 * np.log10(distance_km / 384400.0) + earth_mag + 26.75
    assert body.earthshine_vmag == pytest.approx(earthshine, rel=0, abs=1e-7)
    assert earthshine_vmag(earth_phase, moon_distance_km, sun_distance_au, distance_km) == pytest.approx(earthshine)
    both = -2.5 * np.log10(10 ** (-0.4 * body.vmag) + 10 ** (-0.4 * earthshine))
    assert body.light_vmag == pytest.approx(both, rel=0, abs=1e-7)


def test_constants_of_the_solar_system_are_the_defined_ones() -> None:
    assert (AU_KM, LIGHT_KM_PER_DAY) == (149597870.7, 299792.458 * 86400)
    assert tuple(RADII_KM) == BODIES
    numbers = {"Mercury": 1, "Venus": 2, "Mars": 4, "Jupiter": 5, "Saturn": 6, "Uranus": 7, "Neptune": 8}
    assert numbers == PLANETS
    tt = tt_julian_date(UTC_S)
    state = earth_state(tt)
    heliocentric, barycentric, velocity = earth_km(tt)
    np.testing.assert_allclose(state.heliocentric_km, heliocentric, rtol=1e-14)
    np.testing.assert_allclose(state.barycentric_km, barycentric, rtol=1e-14)
    np.testing.assert_allclose(state.velocity_km_per_day, velocity, rtol=1e-14)
    np.testing.assert_allclose(state.sun_km, barycentric - heliocentric, rtol=1e-14)


def test_corrections_are_chebyshev_series_of_whole_numbers(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    first_jd = 2461000.5
    content = {"first_jd": np.array(first_jd)}
    pieces = np.array([[[5, -3, 2], [1, 4, -6], [-7, 8, 9]], [[50, -30, 20], [10, 40, -60], [-70, 80, 90]]], np.int8)
    for name in ("moon", *(planet.lower() for planet in PLANETS)):
        content |= {name: pieces, f"{name}_scale": np.array([16.0, 2.5])}
    path = tmp_path / "ephemeris.npz"
    np.savez(path, **content)
    monkeypatch.setattr(solarsystem, "asset", lambda _name: path)
    monkeypatch.setattr(solarsystem, "_corrections", solarsystem._corrections.__wrapped__)
    # 4 days into the second series: x = -0.5, T2 = -0.5.
    tt = (first_jd + 19.75, 0.25)
    expected = 2.5 * np.array([50 + 15 - 10, 10 - 20 + 30, -70 - 40 - 45])
    moon = erfa.moon98(*tt)["p"] * AU_KM
    np.testing.assert_allclose(moon_km(tt) - moon, expected, rtol=0, atol=1e-6)
    mars = erfa.plan94(*tt, 4)["p"] * AU_KM
    np.testing.assert_allclose(planet_km("Mars", tt) - mars, expected, rtol=0, atol=1e-6)
    for days, is_inside in ((-0.01, False), (0.0, True), (31.99, True), (32.0, False)):
        at = (first_jd, days)
        assert is_corrected(at) == is_inside
        difference = moon_km(at) - erfa.moon98(*at)["p"] * AU_KM
        assert (np.abs(difference).max() > 1) == is_inside
    np.savez(path, **{name: values for name, values in content.items() if name != "venus"})
    with pytest.raises(CatalogueError, match=r"ephemeris\.npz.* is damaged; install glstar again"):
        moon_km(tt)
    path.unlink()
    with pytest.raises(CatalogueError, match=r"cannot be read \(No such file or directory\); install glstar again"):
        moon_km(tt)


def test_the_moon_over_a_site_has_the_earth_orientation_of_the_table() -> None:
    moon = moon_over(UTC_S, SITE)
    expected = observed_bodies(sky_of(dut1_s=None), UTC_S, SITE, ("Moon",))[0]
    assert (moon.azimuth_rad, moon.apparent_altitude_rad) == (expected.azimuth_rad, expected.apparent_altitude_rad)


def test_frames_turn_with_the_sidereal_day_and_the_pole(monkeypatch: pytest.MonkeyPatch) -> None:
    assert 2 * np.pi / SIDEREAL_RAD_PER_S == pytest.approx(86164.0905, rel=1e-8)
    times = UTC_S + np.array([0.0, 100.0, 250.0])
    latitude, longitude = np.array([0.3, -0.7, 1.1]), np.array([-2.0, 0.4, 3.0])
    sky = sky_of(dut1_s=0.4)
    at_greenwich = sky.astrometry.sidereal_time_rad(UTC_S, 0.4) + 2 * np.pi * (times - UTC_S) / 86164.0905
    found = sky.C_ned_eq(times, latitude, longitude)
    for k in range(3):
        np.testing.assert_allclose(found[k], C_ned_eq(latitude[k], at_greenwich[k] + longitude[k]), rtol=0, atol=1e-9)
    moved = EarthOrientation(0.4, 2e-4, -3e-4)
    monkeypatch.setattr("glstar.sky.observed.stars.earth_orientation", lambda utc_s: moved if utc_s < 2e9 else None)
    auto = sky_of(dut1_s=None)
    assert auto.earth(UTC_S) is moved
    assert auto.earth(2.1e9) == EarthOrientation()
    assert sky.earth(UTC_S) == EarthOrientation(0.4)
    found = auto.C_ned_eq(times, latitude, longitude)
    for k in range(3):
        expected = C_ned_eq(latitude[k], longitude[k]) @ moved.polar_motion @ about_z(at_greenwich[k])
        np.testing.assert_allclose(found[k], expected, rtol=0, atol=1e-9)
    # The pole along one axis alone is not the fixed one.
    for x_pole, y_pole in ((2e-4, 0.0), (0.0, 3e-4), (2e-4, 2e-4)):
        moved = EarthOrientation(0.4, x_pole, y_pole)
        assert np.abs(auto.C_ned_eq(times, latitude, longitude) - sky.C_ned_eq(times, latitude, longitude)).max() > 1e-4
    with pytest.raises(ConfigError) as refused:
        sky_of(dut1_s=-1.04)
    assert str(refused.value) == "sky.dut1_s: UT1 - UTC is -1.04 s; leap seconds keep it between -0.9 and 0.9"
    assert (sky_of(dut1_s=-1.0).dut1_s, sky_of(dut1_s=1.0).dut1_s) == (-1.0, 1.0)
    assert (Sky(sky.catalogue).dut1_s, Sky(sky.catalogue).astrometry) == (0.0, ASTROMETRY["paper"])


def test_the_horizon_of_a_sky_is_flat_dips_or_has_a_profile() -> None:
    sky = sky_of()
    assert (sky.sine_horizon(3000.0), sky.dip, sky.profile, sky.satellites) == (0.0, False, None, None)
    assert replace(sky, dip=True).sine_horizon(3000.0) == pytest.approx(-np.sin(dip_rad(3000.0)), rel=1e-12)
    profile = HorizonProfile((0.1, 2.0), (0.2, 0.05))
    lowest = np.sin(0.05 - np.deg2rad(1.0))
    assert replace(sky, dip=True, profile=profile).sine_horizon(3000.0) == pytest.approx(lowest, rel=1e-12)
    assert sky.refraction_scale(SITE) == pytest.approx(760 / 1010 * 283 / 277, rel=1e-12)
    assert replace(sky, refraction=False).refraction_scale(SITE) == 0.0


def test_places_of_stars_have_aberration_and_refraction() -> None:
    sky = sky_of()
    places = sky.observed_places(UTC_S, SITE)
    (body_up,) = places.altitude_rad
    to_ned = sky.C_ned_eq([UTC_S], SITE.latitude_rad, SITE.longitude_rad)[0]
    place_m = geocentric_m(SITE.latitude_rad, SITE.longitude_rad, SITE.height_m)
    speed = 7.292115e-5 * np.hypot(*place_m[:2]) / 299792458.0
    seen = to_ned @ places.stars.direction_eq[0] + [0.0, speed, 0.0]
    seen /= np.linalg.norm(seen)
    np.testing.assert_allclose(ned_direction(places.azimuth_rad, places.altitude_rad)[0], seen, rtol=0, atol=1e-11)
    expected = body_up + refraction_rad(body_up, 760 / 1010 * 283 / 277)
    np.testing.assert_allclose(places.apparent_altitude_rad, [expected], rtol=0, atol=1e-13)
    np.testing.assert_allclose(direction(places.ra_rad, places.dec_rad), places.stars.direction_eq, rtol=0, atol=1e-14)
    sun = observed_bodies(sky_of(dut1_s=0.0), UTC_S, SITE, ("Sun",))[0]
    # Without aberration and parallax: 20" and 9".
    assert sun_altitude_rad(UTC_S, SITE) == pytest.approx(sun.altitude_rad, rel=0, abs=1.5e-4)


def test_an_altitude_crosses_zero_upwards_and_downwards() -> None:
    begins_s = 1.7e9

    def wave(times_s: np.ndarray, *, lag_s: float) -> np.ndarray:
        return np.sin(2 * np.pi * (times_s - begins_s - lag_s) / 30_000.0)

    up_first = _crossings(lambda times_s: wave(times_s, lag_s=4321.0), begins_s)
    assert (up_first.rise_utc_s, up_first.set_utc_s) == pytest.approx((begins_s + 4321.0, begins_s + 19321.0), abs=0.02)
    assert up_first.is_up is False
    assert up_first.rise_utc_s >= begins_s + 4321.0
    down_first = _crossings(lambda times_s: wave(times_s, lag_s=-10_000.0), begins_s)
    expected = begins_s + 20_000.0, begins_s + 5000.0
    assert (down_first.rise_utc_s, down_first.set_utc_s) == pytest.approx(expected, abs=0.02)
    assert down_first.is_up is True
    # Only within a day and an hour: the last sample is 10 min before its end.
    for at_s, is_found in ((89_300.0, True), (89_500.0, False)):
        late = _crossings(lambda times_s, at_s=at_s: times_s - begins_s - at_s, begins_s)
        assert (late.rise_utc_s is not None) == is_found
    soon = _crossings(lambda times_s: times_s - begins_s - 0.4, begins_s)
    assert (soon.rise_utc_s, soon.is_up) == (pytest.approx(begins_s + 0.4, rel=0, abs=0.02), False)
    assert _crossings(lambda times_s: np.full(len(times_s), 0.1), 0.0) == (None, None, True)
    assert _crossings(lambda times_s: np.zeros(len(times_s)), 0.0) == (None, None, False)


def test_stars_and_limbs_rise_refracted() -> None:
    sky = sky_of()
    star = direction(2.0, -0.3)
    found = star_rise_and_set(sky, star, UTC_S, SITE)
    moon = body_rise_and_set(sky, "Moon", UTC_S, SITE)
    for utc_s in (found.rise_utc_s, found.set_utc_s):
        ned = sky.C_ned_eq([utc_s], SITE.latitude_rad, SITE.longitude_rad)[0] @ star
        up = np.arcsin(-ned[2])
        # 15" a second of time.
        assert up + refraction_rad(up, sky.refraction_scale(SITE)) == pytest.approx(0.0, rel=0, abs=2e-6)
    for utc_s in (moon.rise_utc_s, moon.set_utc_s):
        body = observed_bodies(sky, utc_s, SITE, ("Moon",))[0]
        assert body.apparent_altitude_rad == pytest.approx(-body.angular_radius_rad, rel=0, abs=2e-6)
    assert found.is_up == (found.set_utc_s < found.rise_utc_s)
