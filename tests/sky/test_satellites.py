"""Satellites: their places against skyfield, their brightness and the Earth's shadow against closed forms."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from glstar.cli import app
from glstar.errors import ConfigError
from glstar.sky.catalogue.reading import StarCatalogue
from glstar.sky.observed.satellites import Satellites, lit_fraction, satellite_vmag
from glstar.sky.observed.stars import Sky
from glstar.sky.place.horizon import ned_to_azimuth_altitude_rad
from glstar.sky.place.site import Site
from glstar.sky.place.timescale import parse_utc
from tests.support.satellites import HIGHER, PASS, dut1_s, elements, seen_by_skyfield, with_checksum

EPOCH_S = parse_utc("2024-03-18T10:00:00Z")
SITES = [Site(np.deg2rad(lat), np.deg2rad(lon), h) for lat, lon, h in ((-34.93, 138.6, 300.0), (68.0, -20.0, 9000.0))]
ARCSEC = np.pi / 648000


@pytest.fixture
def file(tmp_path: Path) -> Path:
    path = tmp_path / "some.tle"
    path.write_text(elements(PASS, *HIGHER), encoding="utf-8")
    return path


@pytest.mark.parametrize("site", SITES, ids=["Adelaide", "Arctic"])
def test_directions_and_ranges_are_those_of_skyfield(file: Path, site: Site) -> None:
    for satellite, pair in zip(Satellites.open(file).satellites, (PASS, *HIGHER), strict=True):
        for utc_s in EPOCH_S + np.arange(0.0, 86400.0, 7000.0):
            sky = Sky(StarCatalogue.open("bsc5").by_id([]), dut1_s=dut1_s(utc_s))
            seen = satellite.seen(sky, np.array([utc_s]), site.latitude_rad, site.longitude_rad, site.height_m)
            ned = sky.C_ned_eq([utc_s], site.latitude_rad, site.longitude_rad)[0] @ seen.direction_eq[0]
            expected = seen_by_skyfield(pair, utc_s, site)
            range_km = np.linalg.norm(expected)
            assert np.linalg.norm(ned - expected / range_km) < 0.2 * ARCSEC
            assert seen.range_km[0] == pytest.approx(range_km, rel=0, abs=0.01)


def test_several_times_at_once_are_the_same_as_one_by_one(file: Path) -> None:
    sky, satellite, site = Sky(StarCatalogue.open("bsc5").by_id([])), Satellites.open(file).satellites[0], SITES[0]
    utc_s = EPOCH_S + np.arange(0.0, 60.0, 10.0)
    along = (np.full(6, site.latitude_rad) + np.arange(6) * 1e-5, np.full(6, site.longitude_rad), np.full(6, 300.0))
    together = satellite.seen(sky, utc_s, *along)
    for k in range(6):
        one = satellite.seen(sky, utc_s[k : k + 1], *(of[k : k + 1] for of in along))
        # Their sidereal times are extrapolated from the first of them.
        np.testing.assert_allclose(together.direction_eq[k], one.direction_eq[0], rtol=0, atol=1e-9)
        assert together.range_km[k] == pytest.approx(one.range_km[0], rel=0, abs=1e-6)


def test_the_satellites_near_a_direction_are_found(file: Path) -> None:
    sky, known, site = Sky(StarCatalogue.open("bsc5").by_id([])), Satellites.open(file), SITES[0]
    utc_s = parse_utc("2024-03-18T10:37:40Z")
    place = site.latitude_rad, site.longitude_rad, site.height_m
    for satellite in known.satellites:
        towards = satellite.seen(sky, np.array([utc_s]), *place).direction_eq[0]
        assert satellite in list(known.near(sky, utc_s, 0.1, site, towards, 0.01))
        away = np.roll(towards, 1)
        assert satellite not in list(known.near(sky, utc_s, 0.1, site, away, 0.01))
    # The low one moves by 10 deg and more in ten seconds: it may be there at another time of the exposure.
    low = known.satellites[0]
    before = low.seen(sky, np.array([utc_s - 5.0]), *place).direction_eq[0]
    assert low not in list(known.near(sky, utc_s, 0.1, site, before, 0.01))
    assert low in list(known.near(sky, utc_s, 10.0, site, before, 0.01))


def test_brightness_follows_range_and_phase() -> None:
    assert satellite_vmag(4.0, 1000.0, np.pi / 2) == pytest.approx(4.0, rel=0, abs=1e-12)
    assert satellite_vmag(4.0, 500.0, np.pi / 2) == pytest.approx(4.0 - 2.5 * np.log10(4), rel=0, abs=1e-12)
    # A Lambert sphere is pi times as bright at full phase as half lit.
    assert satellite_vmag(4.0, 1000.0, 0.0) == pytest.approx(4.0 - 2.5 * np.log10(np.pi), rel=0, abs=1e-12)
    assert satellite_vmag(4.0, 1000.0, np.deg2rad(179.0)) > 12


def test_a_lambert_sphere_has_the_phase_function_of_its_integral() -> None:
    """The sum over the lit and visible part of a sphere, in a grid of its surface."""
    theta = (np.arange(400) + 0.5) / 400 * np.pi
    phi = (np.arange(800) + 0.5) / 800 * 2 * np.pi
    theta, phi = np.meshgrid(theta, phi)
    normal = np.stack([np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)])
    for angle in np.deg2rad([20.0, 60.0, 120.0]):
        sun = np.array([np.cos(angle), np.sin(angle), 0.0])
        towards_sun = np.maximum(np.einsum("i,ijk", sun, normal), 0)
        light = (np.maximum(normal[0], 0) * towards_sun * np.sin(theta)).sum()
        half = (np.maximum(normal[0], 0) * np.maximum(normal[1], 0) * np.sin(theta)).sum()
        assert satellite_vmag(0.0, 1000.0, angle) == pytest.approx(-2.5 * np.log10(light / half), rel=0, abs=1e-3)


def test_the_shadow_has_the_width_of_umbra_and_penumbra() -> None:
    sun, radius_km = np.array([1.0, 0.0, 0.0]), 6371.0 + 400.0
    angle = np.pi - np.arcsin(6371.0 / radius_km)  # from the Sun, where its centre is on the edge of the Earth

    def lit(more_deg: float) -> float:
        a = angle - np.deg2rad(more_deg)
        return float(lit_fraction(radius_km * np.array([np.cos(a), np.sin(a), 0.0]), sun))

    assert lit(0.0) == pytest.approx(0.5, rel=0, abs=1e-9)
    assert (lit(0.27), lit(-0.27), lit(90.0)) == (1.0, 0.0, 1.0)
    # A quarter of its diameter: the segment of a circle.
    part = (np.arccos(0.5) - 0.5 * np.sqrt(0.75)) / np.pi
    assert lit(-0.2666 / 2) == pytest.approx(part, rel=0, abs=1e-6)


def test_files_with_and_without_names_are_read(tmp_path: Path) -> None:
    path = tmp_path / "bare.tle"
    path.write_text("# comment\n\n" + elements(PASS, HIGHER[0], names=False), encoding="utf-8")
    bare = Satellites.open(path, 3.0).satellites
    assert [one.name for one in bare] == ["satellite 99001", "satellite 99002"]
    assert {one.standard_mag for one in bare} == {3.0}
    path.write_text(elements(PASS).replace("SATELLITE", "0 SATELLITE"), encoding="utf-8")
    assert [one.name for one in Satellites.open(path).satellites] == ["SATELLITE 1"]


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", "has no two-line elements"),
        (elements(PASS).replace("51.6400", "51.6500"), r"line 3: its checksum is \d, and .* \d: damaged"),
        (elements(PASS)[:-5], r"line 3: has 6. characters, and elements 69"),
        ("\n".join(elements(PASS).splitlines()[:2]), "ends within the elements of a satellite"),
        (elements(PASS).replace("SATELLITE 1\n", "A\nB\n"), "line 2: must be line 1 of the elements of A"),
        ("\n".join(elements(PASS, HIGHER[0]).splitlines()[i] for i in (0, 1, 5)), "must be line 2 of satellite 99001"),
        ("\n".join(elements(PASS).splitlines()[2:]), "line 1: line 2 of elements without its line 1"),
    ],
    ids=["empty", "damaged", "cut", "half", "two names", "another", "second alone"],
)  # fmt: skip
def test_a_damaged_file_is_refused_with_its_line(tmp_path: Path, text: str, words: str) -> None:
    path = tmp_path / "bad.tle"
    path.write_text(text, encoding="utf-8")
    with pytest.raises(ConfigError, match=words) as caught:
        Satellites.open(path)
    assert caught.value.key == "sky.satellites"
    with pytest.raises(ConfigError, match="cannot be read"):
        Satellites.open(tmp_path / "none.tle")


def test_the_command_lists_them_with_the_age_of_their_elements(file: Path) -> None:
    words = f"sky --satellites {file} --lat -34.93 --lon 138.60 --height 300".split()
    now = CliRunner().invoke(app, [*words, "--utc", "2024-03-18T10:37:30Z", "--json"])
    rows = {row["name"]: row for row in json.loads(now.stdout)}
    ned = seen_by_skyfield(PASS, parse_utc("2024-03-18T10:37:30Z"), SITES[0])
    assert rows["SATELLITE 1"]["range_km"] == pytest.approx(np.linalg.norm(ned), rel=0, abs=0.05)
    assert rows["SATELLITE 1"]["lit"] == 1.0
    altitudes = [row["altitude_deg"] for row in rows.values()]
    assert altitudes == sorted(altitudes, reverse=True)
    assert min(altitudes) > 0
    late = CliRunner().invoke(app, [*words, "--utc", "2024-06-18T10:37:30Z", "--all"])
    assert "satellites may be degrees from their places" in " ".join(late.stdout.split())
    both = CliRunner().invoke(app, [*words, "--bodies"], env={"COLUMNS": "200"})
    assert (both.exit_code, "leave one out" in both.stderr) == (2, True)


def test_old_elements_are_said(file: Path) -> None:
    known = Satellites.open(file)
    assert known.age_note(EPOCH_S) == ""
    note = known.age_note(EPOCH_S + 40 * 86400)
    assert "4 of 4 elements are up to 40 days from the exposures" in note
    single = replace(known, satellites=known.satellites[:1])
    assert "its elements are up to 40 days" in single.age_note(EPOCH_S - 40 * 86400)


def test_a_low_pass_is_high_over_adelaide(file: Path) -> None:
    """The pass of the pictures: skyfield sees it 58 deg high in the north-west."""
    ned = seen_by_skyfield(PASS, parse_utc("2024-03-18T10:37:30Z"), SITES[0])
    azimuth_rad, altitude_rad = ned_to_azimuth_altitude_rad(ned)
    assert np.rad2deg([azimuth_rad, altitude_rad]) == pytest.approx([304.9, 58.3], rel=0, abs=0.2)
    assert with_checksum(PASS[0]) == PASS[0]
