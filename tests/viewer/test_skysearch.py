"""Search by name, against names that every atlas lists."""

import numpy as np
import pytest

from glstar.sky.catalogue.reading import StarCatalogue
from glstar.sky.observed.stars import Sky
from glstar.sky.place.site import Site
from glstar.viewer.skyobjects import ObjectKind, SkySearch, object_direction_eq


@pytest.fixture(scope="module")
def search():
    return SkySearch(StarCatalogue.open("bsc5").brighter_than(6.5))


@pytest.mark.parametrize(
    ("query", "name"),
    [
        ("sirius", "Sirius"),
        ("SIRI", "Sirius"),
        ("HR 2491", "Sirius"),
        ("2491", "Sirius"),
        ("hr2491", "Sirius"),
        ("M31", "M31"),
        ("m 31", "M31"),
        ("NGC 224", "M31"),
        ("ngc224", "M31"),
        ("\N{GREEK SMALL LETTER ALPHA} CMa", "Sirius"),
        ("alpha cma", "Sirius"),
        ("alp cma", "Sirius"),
        ("61 Cyg", "61 Cyg"),
        ("kentaurus", "Rigil Kentaurus"),
        ("Ori", "Orion"),
        ("orion", "Orion"),
        ("crux", "Crux"),
        ("jup", "Jupiter"),
        ("Moon", "Moon"),
    ],
)
def test_the_best_match_is_the_one_that_an_atlas_gives(search, query, name):
    assert search.matches(query)[0].name == name


@pytest.mark.parametrize("query", ["", "   ", "no such star", "HR 99999"])
def test_a_query_without_a_match_finds_nothing(search, query):
    assert search.matches(query) == []


def test_equally_good_matches_are_sorted_by_magnitude(search):
    stars = [match for match in search.matches("alp", limit=50) if match.kind is ObjectKind.STAR]
    designated = [star.vmag for star in stars if star.name.startswith("Alp")]
    assert designated == sorted(designated)
    assert len(search.matches("a", limit=7)) == 7


def test_hipparcos_numbers_are_those_of_the_catalogue_in_use(search):
    sirius = search.star(2491)
    assert sirius is not None
    assert sirius.label == "Sirius (\N{GREEK SMALL LETTER ALPHA} CMa, HR 2491)"
    assert search.star(32349) is None


@pytest.mark.parametrize(
    ("query", "ra_deg", "dec_deg", "within_deg"),
    # J2000 positions of the Astronomical Almanac; precession to 2024 is 0.35 deg at most.
    [("Sirius", 101.287, -16.716, 0.4), ("Canopus", 95.988, -52.696, 0.4), ("Crux", 187.5, -60.0, 5.0)],
)
def test_directions_are_those_of_the_almanac(search, query, ra_deg, dec_deg, within_deg):
    sky = Sky(StarCatalogue.open("bsc5").brighter_than(6.5))
    utc_s = 1710068400.0
    site = Site(np.deg2rad(-34.93), np.deg2rad(138.6), 300.0)
    found = object_direction_eq(search.matches(query)[0], sky, sky.star_field(utc_s), utc_s, site)
    ra, dec = np.deg2rad([ra_deg, dec_deg])
    expected = np.array([np.cos(dec) * np.cos(ra), np.cos(dec) * np.sin(ra), np.sin(dec)])
    assert np.rad2deg(np.arccos(found @ expected)) < within_deg
