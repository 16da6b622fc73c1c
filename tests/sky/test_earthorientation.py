"""UT1 - UTC and the motion of the pole, against astropy's reader and ERFA."""

import json
from importlib.util import find_spec
from pathlib import Path

import erfa
import numpy as np
import pytest

from glstar.config import Config
from glstar.sky.catalogue.reading import StarCatalogue
from glstar.sky.observed.stars import Sky
from glstar.sky.place import timescale as earthorientation
from glstar.sky.place.apparent import ASTROMETRY
from glstar.sky.place.horizon import ned_direction
from glstar.sky.place.site import Site
from glstar.sky.place.timescale import described_earth_orientation, earth_orientation, earth_orientation_note, parse_utc
from tests.support.exports import SETTINGS, done, manifest_of, refused, table_of_a_flight, truth_of

ARCSEC = np.pi / 648000
ADELAIDE = Site(np.deg2rad(-34.93), np.deg2rad(138.60), 100.0, pressure_hpa=0.0)

installed = pytest.mark.skipif(find_spec("astropy_iers_data") is None, reason="astropy-iers-data is an extra")


@pytest.fixture
def without_table(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(earthorientation, "_table", lambda: None)


@installed
@pytest.mark.parametrize(
    "utc",
    ["1980-05-05T05:05:05", "2008-12-31T12:00:00", "2016-12-31T18:00:00", "2017-01-01T06:00:00", "2024-03-10T11:00:00"],
)
def test_the_orientation_agrees_with_astropy(utc: str) -> None:
    iers = pytest.importorskip("astropy.utils.iers")
    table = iers.IERS_A.open(iers.IERS_A_FILE)
    utc_s = parse_utc(utc)
    jd = (2440587.5 + utc_s // 86400, utc_s % 86400 / 86400)

    found = earth_orientation(utc_s)

    assert found is not None
    if "18:00" not in utc and "12:00" not in utc:  # astropy interpolates UT1 - UTC across the leap second of that night
        assert found.dut1_s == pytest.approx(table.ut1_utc(*jd).to_value("s"), abs=3e-5)
    x_pole, y_pole = (pole.to_value("rad") for pole in table.pm_xy(*jd))
    np.testing.assert_allclose([found.x_pole_rad, found.y_pole_rad], [x_pole, y_pole], rtol=0, atol=2e-4 * ARCSEC)


@installed
def test_ut1_is_continuous_across_a_leap_second() -> None:
    before, after = earth_orientation(parse_utc("2016-12-31T23:59:59")), earth_orientation(parse_utc("2017-01-01"))

    assert before is not None
    assert after is not None
    assert after.dut1_s - before.dut1_s == pytest.approx(1.0, abs=1e-5)
    assert before.dut1_s == pytest.approx(-0.4084, abs=1e-3)  # Bulletin B 348


@installed
def test_observed_places_agree_with_erfa_including_ut1_and_polar_motion() -> None:
    stars = StarCatalogue.open("bsc5").brighter_than(3.0)
    for utc in ("1995-07-01T03:00:00", "2008-06-01T12:00:00", "2024-03-10T11:00:00"):
        utc_s = parse_utc(utc)
        earth = earth_orientation(utc_s)
        assert earth is not None
        astrom, _ = erfa.apco13(
            *(2440587.5 + utc_s // 86400, utc_s % 86400 / 86400, earth.dut1_s),
            *(ADELAIDE.longitude_rad, ADELAIDE.latitude_rad, ADELAIDE.height_m),
            *(earth.x_pole_rad, earth.y_pole_rad, 0.0, 0.0, 0.0, 0.55),
        )
        pm_ra = stars.pm_ra_cosdec_rad_per_yr / np.cos(stars.dec_rad)
        cirs = erfa.atciq(stars.ra_rad, stars.dec_rad, pm_ra, stars.pm_dec_rad_per_yr, 0.0, 0.0, astrom)
        azimuth_rad, zenith_distance_rad, *_ = erfa.atioq(*cirs, astrom)
        expected = ned_direction(azimuth_rad, np.pi / 2 - zenith_distance_rad)

        places = Sky(stars, ASTROMETRY["erfa"], dut1_s=None).observed_places(utc_s, ADELAIDE)

        off_rad = np.linalg.norm(ned_direction(places.azimuth_rad, places.altitude_rad) - expected, axis=-1)
        assert np.median(off_rad) < 0.01 * ARCSEC
        fixed = Sky(stars, ASTROMETRY["erfa"], dut1_s=earth.dut1_s).observed_places(utc_s, ADELAIDE)
        moved_rad = np.linalg.norm(ned_direction(fixed.azimuth_rad, fixed.altitude_rad) - expected, axis=-1)
        assert np.median(moved_rad) > 0.05 * ARCSEC  # without the pole


def test_a_key_overrides_the_table_and_says_so_in_the_manifest(tmp_path: Path) -> None:
    (tmp_path / "flight.csv").write_text(table_of_a_flight(), encoding="utf-8")
    for name, more in (("auto", ""), ("given", "dut1_s = 0.0\n")):
        (tmp_path / f"{name}.toml").write_text(SETTINGS + more, encoding="utf-8")
        words = ("export", tmp_path / "flight.csv", "-c", tmp_path / f"{name}.toml", "--frames", 1, "-o")
        done(*words, tmp_path / name)
    auto, given = manifest_of(tmp_path / "auto"), manifest_of(tmp_path / "given")

    assert given["config"]["sky"]["dut1_s"] == 0.0
    assert "earth_orientation" not in given
    assert auto.get("earth_orientation") == described_earth_orientation(parse_utc(auto["flight"]["first_utc"])).get(
        "earth_orientation"
    )
    if find_spec("astropy_iers_data") is not None:
        assert auto["earth_orientation"]["dut1_s"] == pytest.approx(-0.00471, abs=1e-4)
        [one], [other] = truth_of(tmp_path / "auto"), truth_of(tmp_path / "given")
        assert one["C_camera_icrs"] != other["C_camera_icrs"]
        assert "earth_orientation" in refused(*words, tmp_path / "auto")


def test_without_the_package_ut1_is_utc_and_manifests_are_as_before(without_table: None, tmp_path: Path) -> None:
    assert earth_orientation(1.7e9) is None
    assert described_earth_orientation(1.7e9) == {}
    assert Config().resolved()["sky"]["dut1_s"] == 0.0
    stars = StarCatalogue.open("bsc5").brighter_than(1.0)
    np.testing.assert_array_equal(
        Sky(stars, dut1_s=None).C_ned_eq([1.7e9], [0.1], [0.2]), Sky(stars).C_ned_eq([1.7e9], [0.1], [0.2])
    )


@installed
@pytest.mark.parametrize("utc", ["1970-06-01", "2090-01-01"])
def test_for_times_outside_the_table_the_manifest_has_its_range(utc: str) -> None:
    described = described_earth_orientation(parse_utc(utc))["earth_orientation"]
    assert described["covers"].startswith("1973-01-02 to 20")
    assert json.dumps(described)


@installed
def test_before_the_table_ut1_is_utc() -> None:
    utc_s = parse_utc("1970-06-01")
    assert earth_orientation(utc_s) is None
    assert described_earth_orientation(utc_s)["earth_orientation"]["dut1_s"] == 0.0
    assert "begins on 1973-01-02" in earth_orientation_note(utc_s)


@installed
def test_after_the_table_the_last_values_continue_and_a_note_says_so() -> None:
    iers = pytest.importorskip("astropy.utils.iers")
    table = iers.IERS_A.open(iers.IERS_A_FILE)
    last = table[np.isfinite(table["UT1_UTC"])][-1]
    last_s = (last["MJD"].to_value("d") - 40587) * 86400

    for days in (0.0, 0.5, 1.0, 365.0, 3000.0):
        found = earth_orientation(last_s + 86400 * days)
        assert found is not None
        assert found.dut1_s == pytest.approx(last["UT1_UTC"].to_value("s"), abs=1e-7)
        poles_rad = [last[name].to_value("rad") for name in ("PM_x", "PM_y")]
        np.testing.assert_allclose([found.x_pole_rad, found.y_pole_rad], poles_rad, rtol=0, atol=1e-5 * ARCSEC)
        note = earth_orientation_note(last_s + 86400 * days)
        if days < 1:
            assert days > 0 or note == ""
        else:
            assert f"{days:.0f} days earlier" in note
    described = described_earth_orientation(last_s + 86400)["earth_orientation"]
    assert described["dut1_s"] == round(last["UT1_UTC"].to_value("s"), 7)
    assert described["covers"].startswith("1973-01-02 to 20")


def test_a_saved_config_has_no_dut1_from_the_table(tmp_path: Path) -> None:
    (tmp_path / "saved.toml").write_text(Config().to_toml(), encoding="utf-8")
    assert Config.load(tmp_path / "saved.toml").sky.dut1_s is None

    given = Config().override(**{"sky.dut1_s": 0.25})
    (tmp_path / "saved.toml").write_text(given.to_toml(), encoding="utf-8")
    assert Config.load(tmp_path / "saved.toml").sky.dut1_s == 0.25


@installed
def test_for_times_inside_the_table_the_manifest_has_no_range() -> None:
    described = described_earth_orientation(parse_utc("2024-03-10"))["earth_orientation"]
    assert "covers" not in described
