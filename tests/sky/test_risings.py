"""Rise and set, against Skyfield with DE421, and of stars that never set."""

import warnings

import numpy as np
import pytest

from glstar.sky.catalogue.messier import messier_objects
from glstar.sky.catalogue.reading import StarCatalogue
from glstar.sky.observed.risings import body_rise_and_set, star_rise_and_set
from glstar.sky.observed.stars import Sky
from glstar.sky.place.apparent import ASTROMETRY
from glstar.sky.place.site import Site
from glstar.sky.place.timescale import parse_utc

ADELAIDE = Site(np.deg2rad(-34.93), np.deg2rad(138.6), 50.0)
UTC_S = parse_utc("2024-03-25T03:00:00Z")


@pytest.fixture(scope="module")
def sky() -> Sky:
    return Sky(StarCatalogue.open("bsc5").by_id([]), ASTROMETRY["erfa"], 0.0)


@pytest.fixture(scope="module")
def skyfield_times():
    """Yield Skyfield's rise and set of a body, by the almanac's 34' of refraction and the upper limb."""
    api, almanac, data = (pytest.importorskip(f"skyfield.{name}") for name in ("api", "almanac", "iokit"))
    skyfield_data = pytest.importorskip("skyfield_data")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)  # a file of Earth orientation, which is not used, has expired
        folder = skyfield_data.get_skyfield_data_path()
    ephemeris = data.load_file(f"{folder}/de421.bsp")
    times = api.load.timescale(builtin=True)

    def of(body: str, horizon_deg: float) -> list[float]:
        observer = ephemeris["earth"] + api.wgs84.latlon(-34.93, 138.6, 50.0)
        first, last = times.utc(2024, 3, 25, 3), times.utc(2024, 3, 26, 4)
        ends = []
        for find in (almanac.find_risings, almanac.find_settings):
            found, _ = find(observer, ephemeris[body], first, last, horizon_degrees=horizon_deg)
            ends.append((found[0].utc_datetime()).timestamp())
        return ends

    yield of
    ephemeris.close()


@pytest.mark.parametrize(
    ("name", "body", "horizon_deg"),
    [
        ("Sun", "sun", -0.8333),
        ("Moon", "moon", -0.8333),
        ("Jupiter", "jupiter barycenter", -0.5667),
        ("Mars", "mars", -0.5667),
    ],
)
def test_bodies_rise_and_set_as_in_skyfield(sky, skyfield_times, name, body, horizon_deg):
    """20 s are 4' of altitude: the almanac's 34' hold for other air than glstar's."""
    rise_s, set_s = skyfield_times(body, horizon_deg)
    found = body_rise_and_set(sky, name, UTC_S, ADELAIDE)
    assert found.rise_utc_s == pytest.approx(rise_s, abs=20.0)
    assert found.set_utc_s == pytest.approx(set_s, abs=20.0)


def test_the_southern_cross_never_sets_at_adelaide_and_polaris_never_rises(sky):
    acrux, polaris = (
        np.array([np.cos(dec) * np.cos(ra), np.cos(dec) * np.sin(ra), np.sin(dec)])
        for ra, dec in (np.deg2rad([186.65, -63.1]), np.deg2rad([37.95, 89.26]))
    )
    assert star_rise_and_set(sky, acrux, UTC_S, ADELAIDE) == (None, None, True)
    assert star_rise_and_set(sky, polaris, UTC_S, ADELAIDE) == (None, None, False)


def test_a_star_on_the_equator_is_up_for_half_a_sidereal_day(sky):
    """And 34' of refraction at each end: 2.8 min at this latitude."""
    direction_eq = np.array([1.0, 0.0, 0.0])
    found = star_rise_and_set(sky, direction_eq, UTC_S, ADELAIDE)
    up_s = (found.set_utc_s - found.rise_utc_s) % 86164.1
    assert up_s == pytest.approx(86164.1 / 2 + 2 * 34 / 15 * 60 / np.cos(ADELAIDE.latitude_rad), abs=30.0)


def test_messier_s_objects_are_where_they_are_known_to_be():
    """The Andromeda Galaxy and the Crab Nebula, RA and dec of 2000 by the NASA/IPAC Extragalactic Database."""
    objects = messier_objects()
    assert [each.number for each in objects] == list(range(1, 111))
    crab, andromeda = objects[0], objects[30]
    assert (crab.name, crab.designation, crab.kind) == ("Crab Nebula", "NGC 1952", "supernova remnant")
    np.testing.assert_allclose(np.rad2deg([crab.ra_rad, crab.dec_rad]), [83.633, 22.014], rtol=0, atol=0.02)
    assert andromeda.designation == "NGC 224"
    np.testing.assert_allclose(np.rad2deg([andromeda.ra_rad, andromeda.dec_rad]), [10.685, 41.269], rtol=0, atol=0.02)
