"""UT1 - UTC and the motion of the pole, against astropy's reader and ERFA."""

import json
from hashlib import sha256
from importlib.metadata import PackageNotFoundError
from importlib.util import find_spec
from pathlib import Path
from types import SimpleNamespace

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
from glstar.sky.place.timescale import (
    EarthOrientation,
    described_earth_orientation,
    earth_orientation,
    earth_orientation_note,
    has_earth_orientation,
    parse_utc,
)
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


def table_line(mjd: str, *, final: tuple[str, str, str] | None, rapid: tuple[str, str, str]) -> str:
    """Return a line of finals2000A.all by the columns of its description, from 1; letters fill what is between."""
    line = ["x"] * 187
    fields = {8: mjd.rjust(8), 19: rapid[0].rjust(9), 38: rapid[1].rjust(9), 59: rapid[2].rjust(10)}
    x_pole, y_pole, dut1 = final or ("", "", "")
    fields |= {135: x_pole.rjust(10), 145: y_pole.rjust(10), 155: dut1.rjust(11)}
    for column, text in fields.items():
        line[column - 1 : column - 1 + len(text)] = text
    return "".join(line)


@pytest.fixture
def small_table(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> bytes:
    """Install a table of four days around the leap second at the end of 2016, and a day without a prediction."""
    content = "\n".join([
        table_line("57753.00", final=("0.1234567", "0.2345678", "-0.40800013"), rapid=("9.0", "9.0", "9.0")),
        table_line("57754.00", final=("-.02345671", "-.33456782", "0.5910001"), rapid=("9.0", "9.0", "9.0")),
        table_line("57755.00", final=None, rapid=("12.345678", "-2.345678", "-0.6123456")),
        table_line("57757.00", final=None, rapid=("0.2", "0.4", "0.5800000")),
        table_line("57758.00", final=None, rapid=("", "", "")),
    ]).encode()  # fmt: skip
    (tmp_path / "data").mkdir()
    (tmp_path / "data" / "finals2000A.all").write_bytes(content)
    spec = SimpleNamespace(submodule_search_locations=[str(tmp_path)])
    monkeypatch.setattr("importlib.util.find_spec", lambda name: spec if name == "astropy_iers_data" else None)
    monkeypatch.setattr(earthorientation, "version", lambda name: {"astropy-iers-data": "0.2026"}[name])
    monkeypatch.setattr(earthorientation, "_table", earthorientation._table.__wrapped__)
    return content


def test_final_values_come_before_rapid_ones_and_ut1_is_interpolated_without_leap_seconds(small_table: bytes) -> None:
    def found(utc: str) -> list[float]:
        earth = earth_orientation(parse_utc(utc))
        assert earth is not None
        return [earth.x_pole_rad / ARCSEC, earth.y_pole_rad / ARCSEC, earth.dut1_s]

    assert has_earth_orientation()
    assert found("2016-12-31") == pytest.approx([0.1234567, 0.2345678, -0.40800013], rel=0, abs=1e-10)
    # UT1 - TAI falls from -36.40800013 to -36.4089999 s during that day; UTC is 36 s behind TAI until its end.
    third = [(2 * 0.1234567 - 0.02345671) / 3, (2 * 0.2345678 - 0.33456782) / 3, -0.40800013 - 0.00099977 / 3]
    assert found("2016-12-31T08:00:00") == pytest.approx(third, rel=0, abs=1e-10)
    assert found("2017-01-01") == pytest.approx([-0.02345671, -0.33456782, 0.5910001], rel=0, abs=1e-10)
    assert found("2017-01-02") == pytest.approx([12.345678, -2.345678, -0.6123456], rel=0, abs=1e-10)
    middle = [(12.345678 + 0.2) / 2, (0.4 - 2.345678) / 2, (0.58 - 0.6123456) / 2]
    assert found("2017-01-03") == pytest.approx(middle, rel=0, abs=1e-10)
    # After the table the last values continue; before it there are none.
    assert found("2017-03-03") == pytest.approx([0.2, 0.4, 0.58], rel=0, abs=1e-10)
    assert earth_orientation(parse_utc("2016-12-30T23:59:59")) is None


def test_the_manifest_and_a_note_say_what_a_table_has_of_a_time(small_table: bytes) -> None:
    source = {"source": "astropy-iers-data 0.2026, finals2000A.all", "sha256": sha256(small_table).hexdigest()}
    inside = parse_utc("2017-01-02T16:00:00")
    third = [(2 * 12.345678 + 0.2) / 3, (2 * -2.345678 + 0.4) / 3, (2 * -0.6123456 + 0.58) / 3]
    assert described_earth_orientation(inside) == {
        "earth_orientation": source
        | {"utc": "2017-01-02T16:00:00.000000Z", "dut1_s": round(third[2], 7)}
        | {"x_pole_arcsec": round(third[0], 6), "y_pole_arcsec": round(third[1], 6)}
    }
    covers = {"covers": "2016-12-31 to 2017-01-04"}
    before = parse_utc("2016-12-30T12:00:00")
    assert described_earth_orientation(before) == {"earth_orientation": source | covers | {"dut1_s": 0.0}}
    after = parse_utc("2017-02-13T12:00:00")
    described = described_earth_orientation(after)["earth_orientation"]
    assert described == source | covers | {"utc": "2017-02-13T12:00:00.000000Z", "dut1_s": 0.58} | {
        "x_pole_arcsec": 0.2,
        "y_pole_arcsec": 0.4,
    }
    for edge in ("2016-12-31", "2017-01-04"):
        assert "covers" not in described_earth_orientation(parse_utc(edge))["earth_orientation"]
        assert earth_orientation_note(parse_utc(edge)) == ""
    assert earth_orientation_note(before) == (
        "UT1 = UTC assumed (astropy-iers-data 0.2026, finals2000A.all begins on 2016-12-31): azimuths and altitudes may"
        " be 13 arcsec off, and more before UTC had whole leap seconds (1972)"
    )
    assert earth_orientation_note(after) == (
        "UT1 - UTC = +0.5800 s continues the last value of astropy-iers-data 0.2026, finals2000A.all, which ends on"
        " 2017-01-04, 40 days earlier: UT1 drifts by up to 17 arcsec a year; update astropy-iers-data"
    )


def test_without_the_package_a_note_says_how_to_install_it(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("importlib.util.find_spec", lambda _name: None)
    monkeypatch.setattr(earthorientation, "_table", earthorientation._table.__wrapped__)
    assert not has_earth_orientation()
    assert earth_orientation_note(1.7e9) == (
        "UT1 = UTC assumed (astropy-iers-data is not installed): azimuths and altitudes may be 13 arcsec off;"
        " pip install astropy-iers-data"
    )


def test_a_table_of_an_unknown_version_is_used(small_table: bytes, monkeypatch: pytest.MonkeyPatch) -> None:
    def unknown(name: str) -> str:
        raise PackageNotFoundError(name)

    monkeypatch.setattr(earthorientation, "version", unknown)
    assert described_earth_orientation(1483300000.0)["earth_orientation"]["source"] == (
        "astropy-iers-data, finals2000A.all"
    )


def test_the_pole_moves_towards_greenwich_and_90_degrees_west() -> None:
    still = EarthOrientation()
    assert (still.dut1_s, still.x_pole_rad, still.y_pole_rad) == (0.0, 0.0, 0.0)
    moved = EarthOrientation(0.1, 2e-4, -3e-4).polar_motion
    # ITRS coordinates of the intermediate pole, to first order: x towards Greenwich, -y towards 90 deg east.
    np.testing.assert_allclose(moved @ [0.0, 0.0, 1.0], [2e-4, 3e-4, 1.0], rtol=0, atol=1e-7)
    np.testing.assert_allclose(moved @ moved.T, np.eye(3), rtol=0, atol=1e-15)
