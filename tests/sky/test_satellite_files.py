"""Satellites near a direction, the age of their elements, and each refusal of a file word for word."""

import builtins
import os
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from glstar.errors import ConfigError
from glstar.sky.catalogue.reading import StarCatalogue
from glstar.sky.observed.satellites import Satellites, SatelliteView, lit_fraction, satellite_vmag, visible_vmag
from glstar.sky.observed.stars import Sky
from glstar.sky.place.site import Site
from glstar.sky.place.timescale import parse_utc
from tests.support.satellites import HIGHER, PASS, elements, with_checksum

EPOCH_S = parse_utc("2024-03-18T10:00:00Z")
SITE = Site(np.deg2rad(-34.93), np.deg2rad(138.6), 300.0)
ONE, TWO = (with_checksum(line) for line in PASS)


def written(folder: Path, text: str) -> Path:
    path = folder / "some.tle"
    path.write_text(text, encoding="utf-8")
    return path


def wrong_sum(line: str) -> str:
    return f"{line[:68]}{(int(line[68]) + 3) % 10}"


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("# nothing\n\n", " has no two-line elements"),
        (f"A\n{ONE}\n", " ends within the elements of a satellite"),
        (f"{ONE}\n{TWO}\nB\n", " ends within the elements of a satellite"),
        (f"A\n\nB\n{ONE}\n{TWO}\n", ", line 3: must be line 1 of the elements of A"),
        (f"A\n{ONE}\n{ONE}\n", ", line 3: must be line 2 of satellite 99001"),
        (f"{ONE}\n{with_checksum(HIGHER[0][1])}\n", ", line 2: must be line 2 of satellite 99001"),
        (f"A\n{TWO}\n", ", line 2: line 2 of elements without its line 1"),
        (f"{TWO[:68]}\n", ", line 1: line 2 of elements without its line 1"),
        (f"A\n{ONE[:68]}\n", ", line 2: has 68 characters, and elements 69 with a checksum"),
        (f"A\n{ONE[:68]}x\n", ", line 2: has 69 characters, and elements 69 with a checksum"),
        (f"A\n{ONE}\n{TWO[:60]}\n", ", line 3: has 60 characters, and elements 69 with a checksum"),
        (
            f"A\n{wrong_sum(ONE)}\n{TWO}\n",
            f", line 2: its checksum is {(int(ONE[68]) + 3) % 10}, and that of its digits {ONE[68]}: damaged",
        ),
    ],
)
def test_a_file_is_refused_with_its_fault(tmp_path: Path, text: str, message: str) -> None:
    path = written(tmp_path, text)
    with pytest.raises(ConfigError) as refused:
        Satellites.open(path)
    assert str(refused.value) == f"sky.satellites: {path}{message}"


def test_elements_without_an_orbit_are_refused(tmp_path: Path) -> None:
    # A mean motion of 0.
    nowhere = with_checksum(TWO[:52] + " 0.00000000" + TWO[63:])
    path = written(tmp_path, f"A\n{ONE}\n{nowhere}\n")
    with pytest.raises(ConfigError, match=r"some\.tle, line 3: describes no orbit \(SGP4 error [1-6]\)$"):
        Satellites.open(path)


def test_names_numbers_and_magnitudes_are_those_of_the_file(tmp_path: Path) -> None:
    second = [with_checksum(line) for line in HIGHER[0]]
    # A line of a name may begin like elements; digits after the checksum are not read.
    text = f"0 FIRST ONE  \n{ONE}\n{TWO} 77\n\n{second[0]}\n{second[1]}\n1 SHORT NAME\n{ONE}\n{TWO}\n"
    path = written(tmp_path, text)
    known = Satellites.open(path)
    assert [(one.name, one.number) for one in known.satellites] == [
        ("FIRST ONE", 99001), ("satellite 99002", 99002), ("1 SHORT NAME", 99001),
    ]  # fmt: skip
    assert known.satellites[0].lines == (ONE, TWO)
    assert {one.standard_mag for one in known.satellites} == {4.5}
    assert known.path == path
    assert Satellites.open(path) is known
    assert Satellites.open(path, 3.0).satellites[1].standard_mag == 3.0
    path.write_text(text.replace("FIRST", "OTHER"), encoding="utf-8")
    os.utime(path, ns=(0, path.stat().st_mtime_ns + 5_000_000_000))
    assert Satellites.open(path).satellites[0].name == "OTHER ONE"


def test_without_sgp4_a_file_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    imported: Callable[..., object] = builtins.__import__

    def without(name: str, *others: object) -> object:
        if name == "sgp4":
            raise ImportError(name)
        return imported(name, *others)

    monkeypatch.setattr(builtins, "__import__", without)
    with pytest.raises(ConfigError) as refused:
        Satellites.open(written(tmp_path, elements(PASS)))
    assert str(refused.value) == "sky.satellites: satellites need the package sgp4: pip install sgp4"


def test_elements_describe_two_weeks_on_both_sides(tmp_path: Path) -> None:
    known = Satellites.open(written(tmp_path, elements(PASS, *HIGHER)))
    # Epoch: day 78.41666667 of 2024, 10:00 UTC on 18 March.
    np.testing.assert_allclose(known.ages_days(EPOCH_S + 86400 * 2.25), [2.25] * 4, rtol=0, atol=1e-6)
    np.testing.assert_allclose(known.ages_days(EPOCH_S - 86400), [-1.0] * 4, rtol=0, atol=1e-6)
    for days in (-13.9, 13.9):
        assert known.age_note(EPOCH_S + 86400 * days) == ""
    for days in (-14.1, 14.1):
        assert known.age_note(EPOCH_S + 86400 * days) == (
            "some.tle: 4 of 4 elements are up to 14 days from the exposures; those of low orbits are good for 14:"
            " satellites may be degrees from their places"
        )
    older = with_checksum(ONE[:20] + "048.41666667" + ONE[32:])
    mixed = Satellites.open(written(tmp_path, f"{older}\n{TWO}\n{ONE}\n{TWO}\n"))
    assert mixed.age_note(EPOCH_S).startswith("some.tle: 1 of 2 elements are up to 30 days from the exposures;")
    single = replace(mixed, satellites=mixed.satellites[:1])
    assert single.age_note(EPOCH_S).startswith("some.tle: its elements are up to 30 days from the exposures;")


def test_satellites_are_near_within_an_angle_and_their_motion(tmp_path: Path) -> None:
    known = Satellites.open(written(tmp_path, elements(PASS, *HIGHER)))
    sky = Sky(StarCatalogue.open("bsc5").by_id([]))
    utc_s = parse_utc("2024-03-18T10:37:30Z")
    low = known.satellites[0]
    view = low.seen(sky, np.array([utc_s]), SITE.latitude_rad, SITE.longitude_rad, SITE.height_m)
    at, range_km = view.direction_eq[0], float(view.range_km[0])
    aside = np.cross(at, [0.0, 0.0, 1.0])
    aside /= np.linalg.norm(aside)
    # 12 km/s for half of the exposure.
    reach_rad = 0.05 + np.arcsin(12.0 * 3.0 / 2 / range_km)
    for part, is_near in ((0.97, True), (1.03, False)):
        towards = np.cos(part * reach_rad) * at + np.sin(part * reach_rad) * aside
        assert (low in list(known.near(sky, utc_s, 3.0, SITE, towards, 0.05))) == is_near
    # In a long exposure it may be anywhere on half of the sphere.
    sideways = np.cos(1.6) * at + np.sin(1.6) * aside
    assert low in list(known.near(sky, utc_s, 1000.0, SITE, sideways, 0.05))
    together = list(known.near(sky, utc_s, 0.1, SITE, at, np.pi))
    assert together == list(known.satellites)
    # Positions from the Earth's centre: 340 to 430 km high for the low one.
    assert np.linalg.norm(view.geocentric_eq_km[0]) == pytest.approx(6371 + 420, rel=0.02)


def test_an_ended_orbit_is_nowhere(tmp_path: Path) -> None:
    falling = with_checksum(ONE[:53] + " 99999-1" + ONE[61:])
    known = Satellites.open(written(tmp_path, f"{falling}\n{TWO}\n{elements(HIGHER[1], names=False)}"))
    sky = Sky(StarCatalogue.open("bsc5").by_id([]))
    late_s = EPOCH_S + 400 * 86400.0
    view = known.satellites[0].seen(sky, np.array([late_s, EPOCH_S]), *(np.full(2, x) for x in (-0.6, 2.4, 300.0)))
    assert np.isnan(view.direction_eq[0]).all()
    assert np.isfinite(view.direction_eq[1]).all()
    near = list(known.near(sky, late_s, 0.1, SITE, np.array([0.0, 0.0, 1.0]), np.pi))
    assert near == [known.satellites[1]]


def test_a_satellite_is_as_bright_as_its_phase_range_and_shadow(tmp_path: Path) -> None:
    satellite = Satellites.open(written(tmp_path, elements(PASS)), 5.5).satellites[0]
    sun = np.array([0.6, 0.0, 0.8])
    directions = np.array([[0.0, 1.0, 0.0], [0.8, 0.0, 0.6], [-0.6, 0.0, -0.8]])
    places_km = np.array([[4000.0, 6000.0, 500.0], [-4600.0, 500.0, -6000.0], [-3900.0, 0.0, -5200.0]])
    mags, lit = visible_vmag(satellite, SatelliteView(directions, np.array([500.0, 800.0, 2000.0]), places_km), sun)
    phases = np.arccos([0.0, -(0.48 + 0.48), 1.0])
    law = (np.sin(phases) + (np.pi - phases) * np.cos(phases)) / np.pi
    expected = 5.5 + 5 * np.log10([0.5, 0.8, 2.0]) - 2.5 * np.log10(law * np.pi)
    np.testing.assert_allclose(mags, expected, rtol=0, atol=1e-9)
    np.testing.assert_allclose(satellite_vmag(5.5, [500.0, 800.0, 2000.0], phases), expected, rtol=0, atol=1e-9)
    assert lit.tolist() == [1.0, lit[1], 0.0]
    # The angles of the Earth's edge and of the Sun at the satellite; a segment of the Sun's disc of 0.2666 deg.
    for less_deg in (-0.2, 0.1, 0.25):
        distance_km = 6371.0 + 700.0
        angle = np.pi - np.arcsin(6371.0 / distance_km) - np.deg2rad(less_deg)
        place = distance_km * np.array([np.cos(angle), np.sin(angle), 0.0])
        y = np.linspace(-1, 1, 400_001)
        above = np.trapezoid(np.sqrt(1 - y * y) * (y > -less_deg / 0.2666), y) * 2 / np.pi
        assert lit_fraction(place, np.array([1.0, 0.0, 0.0])) == pytest.approx(above, rel=0, abs=1e-4)
    # Within the mean radius of the Earth it is dark behind it.
    assert lit_fraction(np.array([-6000.0, 0.0, 0.0]), np.array([1.0, 0.0, 0.0])) == 0.0
