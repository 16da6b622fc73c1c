"""The Sun, the Moon and the planets, compared with Skyfield and DE421 at 60 dates and places."""

import json
import warnings
from dataclasses import dataclass
from datetime import datetime
from functools import cache
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner

from glstar.cli import app
from glstar.sky.catalogue.reading import StarCatalogue
from glstar.sky.observed.solarsystem import (
    AU_KM,
    BODIES,
    Body,
    earthshine_vmag,
    is_corrected,
    moon_km,
    moon_vmag,
    observed_bodies,
)
from glstar.sky.observed.stars import Sky
from glstar.sky.place.apparent import ASTROMETRY, direction
from glstar.sky.place.horizon import ned_direction
from glstar.sky.place.site import Site
from glstar.sky.place.timescale import parse_utc, tt_julian_date

skyfield_api = pytest.importorskip("skyfield.api")
magnitudelib = pytest.importorskip("skyfield.magnitudelib")
skyfield_data = pytest.importorskip("skyfield_data")

ARCSEC_RAD = np.pi / 648000
DATES = 60
FIRST, LAST = "2000-01-01T00:00:00Z", "2035-01-01T00:00:00Z"
BARYCENTRES = {"Jupiter", "Saturn", "Uranus", "Neptune"}


@dataclass(frozen=True)
class Pair:
    """A body by glstar, and the same by Skyfield."""

    ours: Body
    ned: np.ndarray
    distance_km: float
    phase_angle_deg: float
    illuminated_fraction: float
    bright_limb_rad: float
    vmag: float


def sky(*, astrometry: str = "erfa", dut1_s: float = 0.0) -> Sky:
    return Sky(StarCatalogue.open("bsc5").by_id([2491]), ASTROMETRY[astrometry], dut1_s)


@cache
def skyfield_tables() -> tuple[Any, Any]:
    """Return Skyfield's ephemeris DE421 and its time scale."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # the package's table of UT1, which is not read, has expired
        folder = skyfield_data.get_skyfield_data_path()
    loader = skyfield_api.Loader(folder, verbose=False)
    return loader("de421.bsp"), loader.timescale(builtin=True)


@pytest.fixture(scope="module")
def pairs() -> dict[str, list[Pair]]:
    """Return 60 dates and places of each body."""
    ephemeris, timescale = skyfield_tables()
    random = np.random.default_rng(421)
    found: dict[str, list[Pair]] = {name: [] for name in BODIES}
    for _ in range(DATES):
        utc_s = random.uniform(parse_utc(FIRST), parse_utc(LAST))
        latitude_rad, longitude_rad = np.arcsin(random.uniform(-1, 1)), random.uniform(-np.pi, np.pi)
        height_m = random.uniform(0, 10_000)
        time = timescale.tt_jd(*tt_julian_date(utc_s))
        place = skyfield_api.wgs84.latlon(np.rad2deg(latitude_rad), np.rad2deg(longitude_rad), elevation_m=height_m)
        observer = (ephemeris["earth"] + place).at(time)
        bodies = observed_bodies(sky(dut1_s=time.dut1), utc_s, Site(latitude_rad, longitude_rad, height_m))
        for body in bodies:
            found[body.name].append(skyfield_pair(body, observer, ephemeris, timescale))
    return found


def skyfield_pair(body: Body, observer: Any, ephemeris: Any, timescale: Any) -> Pair:
    """Return a body with Skyfield's numbers of it."""
    sun = ephemeris["sun"]
    astrometric = observer.observe(ephemeris[f"{body.name} barycenter" if body.name in BARYCENTRES else body.name])
    altitude, azimuth, distance = astrometric.apparent().altaz()
    of_date = astrometric.apparent().radec("date"), observer.observe(sun).apparent().radec("date")
    (ra, dec), (sun_ra, sun_dec) = (((a.radians, d.radians)) for a, d, _ in of_date)
    # Meeus, eq. (48.5).
    limb_rad = np.arctan2(
        np.cos(sun_dec) * np.sin(sun_ra - ra),
        np.sin(sun_dec) * np.cos(dec) - np.cos(sun_dec) * np.sin(dec) * np.cos(sun_ra - ra),
    )
    return Pair(
        ours=body,
        ned=ned_direction(azimuth.radians, altitude.radians),
        distance_km=distance.km,
        phase_angle_deg=0.0 if body.name == "Sun" else float(astrometric.phase_angle(sun).degrees),
        illuminated_fraction=1.0 if body.name == "Sun" else float(astrometric.fraction_illuminated(sun)),
        bright_limb_rad=float(limb_rad),
        vmag=np.nan if body.name in ("Sun", "Moon") else skyfield_vmag(astrometric, ephemeris, timescale),
    )


def skyfield_vmag(astrometric: Any, ephemeris: Any, timescale: Any) -> float:
    """Return Skyfield's magnitude, with the Sun in its place and not at the barycentre of the solar system."""
    then = timescale.tt_jd(astrometric.t.tt - astrometric.light_time)
    from_sun_au = astrometric.center_barycentric.xyz.au - ephemeris["sun"].at(then).xyz.au
    heliocentric = SimpleNamespace(
        target=astrometric.target,
        center_barycentric=SimpleNamespace(xyz=SimpleNamespace(au=from_sun_au)),
        xyz=astrometric.xyz,
        t=astrometric.t,
    )
    return float(magnitudelib.planetary_magnitude(heliocentric))


@pytest.mark.slow
@pytest.mark.parametrize("name", BODIES)
def test_bodies_lie_within_an_arcsecond_of_de421(pairs: dict[str, list[Pair]], name: str) -> None:
    for pair in pairs[name]:
        ours = ned_direction(pair.ours.azimuth_rad, pair.ours.altitude_rad)
        assert np.linalg.norm(ours - pair.ned) < 0.6 * ARCSEC_RAD
        np.testing.assert_allclose(pair.ours.distance_km, pair.distance_km, rtol=1e-5)


@pytest.mark.slow
@pytest.mark.parametrize("name", BODIES[1:])
def test_phases_agree_with_skyfield(pairs: dict[str, list[Pair]], name: str) -> None:
    for pair in pairs[name]:
        np.testing.assert_allclose(np.rad2deg(pair.ours.phase_angle_rad), pair.phase_angle_deg, rtol=0, atol=0.002)
        np.testing.assert_allclose(pair.ours.illuminated_fraction, pair.illuminated_fraction, rtol=0, atol=2e-5)
        if pair.phase_angle_deg > 5:
            turn_rad = pair.ours.bright_limb_rad - pair.bright_limb_rad
            assert abs((turn_rad + np.pi) % (2 * np.pi) - np.pi) < np.deg2rad(0.005)


@pytest.mark.slow
@pytest.mark.parametrize("name", BODIES[2:])
def test_magnitudes_of_planets_are_those_of_mallama_and_hilton(pairs: dict[str, list[Pair]], name: str) -> None:
    differences = np.array([pair.ours.vmag - pair.vmag for pair in pairs[name]])
    compared = differences[np.isfinite(differences)]  # Skyfield knows no Saturn with its rings wide open
    assert len(compared) > DATES // 2
    np.testing.assert_allclose(compared, 0, rtol=0, atol=1e-4)


def test_meeus_example_of_the_moon() -> None:
    # Meeus, examples 47.a and 48.a, 1992 April 12, 0h TD, geocentric: 368405.6 km by the complete theory ELP-2000/82,
    # phase angle 69.0756 deg, bright limb 285.0 deg.
    np.testing.assert_allclose(np.linalg.norm(moon_km((2448724.5, 0.0))), 368405.6, rtol=0, atol=1)
    place = observed_bodies(sky(), parse_utc("1992-04-11T23:59:01Z"), Site(0.0, 0.0), ("Moon",))[0]
    np.testing.assert_allclose(np.rad2deg(place.phase_angle_rad), 69.0756, rtol=0, atol=1)  # the parallax of the place
    np.testing.assert_allclose(np.rad2deg(place.bright_limb_rad), 285.0, rtol=0, atol=1)


@pytest.mark.parametrize("astrometry", ["paper", "erfa"])
def test_right_ascension_and_declination_are_those_of_azimuth_and_altitude(astrometry: str) -> None:
    # Diurnal aberration, up to 0.32 arcsec, is in both.
    of_date = sky(astrometry=astrometry)
    for utc, site in (("2026-06-20T12:07:27Z", Site(0.0, 0.0)), ("2031-01-01T00:00:00Z", Site(0.7, -2.0, 12_000.0))):
        utc_s = parse_utc(utc)
        C_ned_eq = of_date.C_ned_eq([utc_s], site.latitude_rad, site.longitude_rad)[0]
        for body in observed_bodies(of_date, utc_s, site):
            seen = direction(*body.ra_dec_rad)
            np.testing.assert_allclose(
                C_ned_eq @ seen, ned_direction(body.azimuth_rad, body.altitude_rad), rtol=0, atol=1e-5 * ARCSEC_RAD
            )
            separation_rad = np.linalg.norm(seen - body.direction_eq)
            assert separation_rad < 0.33 * ARCSEC_RAD


def test_the_moon_parallax_grows_with_height() -> None:
    utc_s = parse_utc("2024-03-18T08:00:00Z")
    low, high = (observed_bodies(sky(), utc_s, Site(-0.6, 2.4, h), ("Moon",))[0] for h in (0.0, 10_000.0))
    up = np.sin(low.altitude_rad)
    np.testing.assert_allclose(low.distance_km - high.distance_km, 10 * up, rtol=0, atol=0.01)
    np.testing.assert_allclose(
        high.altitude_rad - low.altitude_rad, -10 * np.cos(low.altitude_rad) / low.distance_km, rtol=0.01, atol=1e-9
    )


def test_full_moon_has_the_magnitude_of_allen() -> None:
    assert moon_vmag(0.0, 384400.0, 1.0) == pytest.approx(-12.73, abs=1e-9)
    assert moon_vmag(np.pi / 2, 384400.0, 1.0) == pytest.approx(-12.73 + 2.34 + 0.26244, abs=1e-9)


def test_earthshine_is_the_light_of_the_earth_that_a_full_moon_would_reflect() -> None:
    """The Earth seen from the Moon by Skyfield, over the Sun; Apollo 11 reported -3.2 (Agrawal 2016: -1.3 to -3.7)."""
    ephemeris, timescale = skyfield_tables()
    for utc in ("2024-03-10T11:00:00Z", "2024-03-14T11:00:00Z", "2024-03-18T11:00:00Z", "2024-03-25T01:00:00Z"):
        time, utc_s = timescale.from_datetime(datetime.fromisoformat(utc)), parse_utc(utc)
        seen = ephemeris["moon"].at(time).observe(ephemeris["earth"])
        from_sun_au = ephemeris["sun"].at(time).observe(ephemeris["earth"]).distance().au
        phase_deg = seen.phase_angle(ephemeris["sun"]).degrees
        earth = magnitudelib._earth_magnitude(from_sun_au, seen.distance().au, phase_deg)
        moon = observed_bodies(sky(), utc_s, Site(0.5, 1.0), ("Moon",))[0]
        expected = -12.73 + earth + 26.75 + 5 * np.log10(moon.distance_km / 384400.0)
        assert moon.earthshine_vmag == pytest.approx(expected, abs=0.001)
        both = 10 ** (-0.4 * moon.vmag) + 10 ** (-0.4 * moon.earthshine_vmag)
        assert moon.light_vmag == pytest.approx(-2.5 * np.log10(both), abs=1e-9)
    assert earthshine_vmag(0.0, 384400.0, 1.0, 384400.0) == pytest.approx(-2.92, abs=0.01)


def test_corrections_end_with_their_years() -> None:
    inside, after = (tt_julian_date(parse_utc(f"{year}-06-01")) for year in (2050, 2060))
    assert is_corrected(inside)
    assert not is_corrected(after)
    assert np.linalg.norm(moon_km(after)) == pytest.approx(0.00257 * AU_KM, rel=0.08)


def test_the_paper_frames_place_bodies_beside_those_of_erfa() -> None:
    utc_s, site = parse_utc("2030-06-01T12:00:00Z"), Site(0.5, -1.0)
    for paper, erfa in zip(
        observed_bodies(sky(astrometry="paper"), utc_s, site), observed_bodies(sky(), utc_s, site), strict=True
    ):
        ours, theirs = (ned_direction(body.azimuth_rad, body.altitude_rad) for body in (paper, erfa))
        assert np.linalg.norm(ours - theirs) < 0.7 * ARCSEC_RAD


def test_glstar_sky_lists_the_bodies() -> None:
    where = ["sky", "--lat", "-34.93", "--lon", "138.60", "--utc", "2024-03-18T11:00:00Z", "--bodies"]
    rows = json.loads(CliRunner().invoke(app, [*where, "--format", "json"]).stdout)
    assert [row["name"] for row in rows] == list(BODIES)
    moon = rows[1]
    assert list(moon) == [
        *("name", "azimuth_deg", "altitude_deg", "apparent_altitude_deg", "ra_deg", "dec_deg", "distance_km"),
        *("diameter_arcsec", "phase_angle_deg", "illuminated_fraction", "bright_limb_deg", "vmag"),
    ]
    # First quarter was on 2024-03-17 at 04:11 UTC; 31 hours later 63 % are lit.
    assert moon["illuminated_fraction"] == pytest.approx(0.63, abs=0.01)
    np.testing.assert_allclose(
        moon["diameter_arcsec"], 2 * np.arcsin(1737.4 / moon["distance_km"]) / ARCSEC_RAD, rtol=1e-6
    )
    lines = CliRunner().invoke(app, [*where, "--format", "csv"]).stdout.splitlines()
    assert len(lines) == len(BODIES) + 1
    table = CliRunner().invoke(app, where).stdout
    assert "Neptune" in table
    assert "DE421" in table


def test_the_sun_lights_bodies_from_its_side() -> None:
    for body in observed_bodies(sky(), parse_utc("2026-06-20T12:07:27Z"), Site(0.5, 1.0)):
        if body.name == "Sun":
            assert not body.sun_direction_eq.any()
            continue
        assert np.linalg.norm(body.sun_direction_eq) == pytest.approx(1.0, rel=1e-9)
        # The phase angle lies at the body between Sun and observer; aberration is 20 arcsec.
        angle_rad = np.arccos(-body.sun_direction_eq @ body.direction_eq)
        assert angle_rad == pytest.approx(body.phase_angle_rad, rel=0, abs=25 * ARCSEC_RAD)
        assert body.illuminated_fraction == pytest.approx((1 + np.cos(angle_rad)) / 2, rel=0, abs=1e-4)
