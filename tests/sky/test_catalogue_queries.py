"""Queries of a small catalogue by brute force, and messages about files and stars word for word."""

import re
import sqlite3
from collections.abc import Callable
from contextlib import closing
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from glstar.errors import CatalogueError
from glstar.sky.catalogue import reading
from glstar.sky.catalogue.bright import build_bsc5, build_hipparcos, to_j2000, vmag_from_hp
from glstar.sky.catalogue.reading import CatalogueFile, CatalogueRow, StarCatalogue
from glstar.sky.catalogue.writing import write_catalogue


@pytest.fixture(scope="module")
def rows() -> list[CatalogueRow]:
    random = np.random.default_rng(8)
    ra, dec = random.uniform(0, 2 * np.pi, 700), np.arcsin(random.uniform(-1, 1, 700))
    mags = random.integers(0, 90, 700) / 10
    return [
        CatalogueRow(
            3 * k + 5, "Star 7" if k == 7 else "", f"no {k}", ra[k], dec[k], k * 1e-9, -k * 1e-9, mags[k], None
        )
        if k % 3
        else CatalogueRow(3 * k + 5, "", "", ra[k], dec[k], 1e-8, 2e-8, mags[k], k / 1000, k * 1e-9, k / 4)
        for k in range(700)
    ]


@pytest.fixture(scope="module")
def small(rows: list[CatalogueRow], tmp_path_factory: pytest.TempPathFactory) -> CatalogueFile:
    path = tmp_path_factory.mktemp("small") / "small.sqlite"
    write_catalogue(path, rows, {"numbering": "HIP", "title": "small"})
    return StarCatalogue.open(path)


def sorted_rows(rows: list[CatalogueRow], keep: Callable[[CatalogueRow], bool]) -> list[CatalogueRow]:
    return sorted(filter(keep, rows), key=lambda row: (row.vmag, row.number))


def test_stars_up_to_a_magnitude_have_all_columns(small: CatalogueFile, rows: list[CatalogueRow]) -> None:
    for limit in (4.5, 8.9, -1.0):
        expected = sorted_rows(rows, lambda row, limit=limit: row.vmag <= limit)
        stars = small.brighter_than(limit)
        assert stars.catalogue == "hipparcos"
        assert len(stars) == len(expected)
        assert stars.star_id.tolist() == [row.number for row in expected]
        assert stars.name == tuple(row.name or row.designation for row in expected)
        for name in ("ra_rad", "dec_rad", "pm_ra_cosdec_rad_per_yr", "pm_dec_rad_per_yr", "vmag", "parallax_rad"):
            np.testing.assert_array_equal(getattr(stars, name), [getattr(row, name) for row in expected])
        np.testing.assert_array_equal(stars.bv, [np.nan if row.bv is None else row.bv for row in expected])
        velocities = [row.radial_velocity_m_per_s or 0.0 for row in expected]
        np.testing.assert_array_equal(stars.radial_velocity_m_per_s, velocities)
    whole = small.brighter_than(9.0)
    part = whole.brightest(4.5)
    assert part.star_id.tolist() == small.brighter_than(4.5).star_id.tolist()
    assert (part.catalogue, part.name) == ("hipparcos", whole.name[: len(part)])
    assert (small.count, small.first_number, small.last_number, small.schema) == (700, 5, 2102, 2)
    assert (small.numbering, small.note) == ("HIP", "")


@pytest.mark.parametrize(
    ("ra_deg", "dec_deg", "radius_deg"),
    [(3, 10, 8), (357, -40, 10), (180, 0, 25), (40, 85, 8), (40, -80, 15), (200, 60, 29), (100, 5, 100), (100, 5, 180),
     (10, 20, 0), (355, 70, 15)],
)  # fmt: skip
def test_a_cone_has_the_stars_of_brute_force(
    small: CatalogueFile, rows: list[CatalogueRow], ra_deg: float, dec_deg: float, radius_deg: float
) -> None:
    ra, dec = np.deg2rad([ra_deg, dec_deg])
    axis = 3.0 * np.array([np.cos(dec) * np.cos(ra), np.cos(dec) * np.sin(ra), np.sin(dec)])

    def is_inside(row: CatalogueRow) -> bool:
        half_chord = np.sin((row.dec_rad - dec) / 2) ** 2
        half_chord += np.cos(dec) * np.cos(row.dec_rad) * np.sin((row.ra_rad - ra) / 2) ** 2
        return 2 * np.arcsin(min(1.0, np.sqrt(half_chord))) <= np.deg2rad(radius_deg) and row.vmag <= 7.0

    found = small.within(axis, np.deg2rad(radius_deg), vmag=7.0)
    assert found.star_id.tolist() == [row.number for row in sorted_rows(rows, is_inside)]
    boxes = reading._boxes(axis / 3.0, np.deg2rad(radius_deg))
    assert len(boxes) == (2 if (ra_deg, dec_deg) in ((3, 10), (357, -40), (10, 20), (355, 70)) and radius_deg else 1)


def test_a_box_is_searched_along_its_narrower_band() -> None:
    assert "star_ra_dec_vmag" in reading._within(1.0, 1.1, -0.2, 0.3)
    assert "star_dec_ra_vmag" in reading._within(0.5, 2.0, 0.4, 0.5)
    # A lune of 0.1 of the sky, and zones around the pole of 0.0955 and 0.1045.
    assert "star_dec_ra_vmag" in reading._within(1.0, 1.0 + 0.2 * np.pi, np.arcsin(0.809), np.pi / 2)
    assert "star_ra_dec_vmag" in reading._within(1.0, 1.0 + 0.2 * np.pi, np.arcsin(0.791), np.pi / 2)


def test_stars_are_found_by_number_in_parts(small: CatalogueFile, rows: list[CatalogueRow]) -> None:
    numbers = [row.number for row in rows[20:640]]
    found = small.by_id([*reversed(numbers), numbers[0]])
    expected = sorted_rows(rows, lambda row: row.number in set(numbers))
    assert found.star_id.tolist() == [row.number for row in expected]

    def refusal(*star_id: int) -> str:
        with pytest.raises(CatalogueError) as refused:
            small.by_id(star_id)
        return str(refused.value).removeprefix(f"{small.path}: ")

    holds = "it holds HIP 5 to 2102"
    assert refusal(3, 5) == f"the catalogue has no HIP 3; {holds}"
    assert refusal(2103) == f"the catalogue has no HIP 2103; {holds}"
    assert refusal(6) == f"the catalogue has no HIP 6; {holds}, 1398 in between left out"
    gaps = f"{holds}, 1398 in between left out"
    assert refusal(30, 31, 32, 33, 34, 36) == f"the catalogue has no HIP 30, 31, 33, 34, 36; {gaps}"
    assert refusal(5000, 30, 31, 33, 34, 36, 37) == f"the catalogue has no HIP 30, 31, 33, 34, 36 and 2 more; {gaps}"


def test_an_older_file_of_hipparcos_says_what_it_lacks(small: CatalogueFile) -> None:
    assert replace(small, schema=1).note == (
        f"{small.path}: this Hipparcos file of an earlier glstar has no parallaxes, which move the nearest stars by up"
        " to 0.8 arcsec; build it again with `glstar sky catalogue build hipparcos --force`"
    )
    assert replace(small, schema=1, provenance={"numbering": "HR"}).note == ""
    assert replace(small, provenance={}).numbering == "number"
    assert [replace(small, provenance={"numbering": p}).catalogue for p in ("HR", "TYC", "Gaia row", "x")] == [
        "bsc5", "tycho2", "gaia", "",
    ]  # fmt: skip


@pytest.mark.parametrize(
    ("statement", "message"),
    [
        ("PRAGMA user_version = 3", "has tables of version 3 and this glstar reads versions 1 and 2; build it again"),
        ("PRAGMA user_version = 0", "has tables of version 0 and this glstar reads versions 1 and 2; build it again"),
        ("PRAGMA application_id = 7", "is a SQLite file but no glstar catalogue; name one that"),
        ("DELETE FROM star", "is a glstar catalogue without a star; build it again with"),
        (
            "CREATE VIEW more AS SELECT * FROM star",
            "has views or triggers, which `glstar sky catalogue build` does not",
        ),
    ],
)
def test_a_changed_file_is_refused(small: CatalogueFile, tmp_path: Path, statement: str, message: str) -> None:
    path = tmp_path / "changed.sqlite"
    path.write_bytes(small.path.read_bytes())
    with closing(sqlite3.connect(path)) as connection:
        connection.execute(statement)
        connection.commit()
    with pytest.raises(CatalogueError) as refused:
        StarCatalogue.open(path)
    assert str(refused.value).startswith(f"{path}: {message}")


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"", "is empty; build it again with `glstar sky catalogue build`"),
        (b"SQLite format 3\0" + b"\0" * 83, "is no SQLite file; name one that `glstar sky catalogue build` wrote"),
        (b"SQLite format 2\0" + b"\0" * 84, "is no SQLite file; name one that `glstar sky catalogue build` wrote"),
        (b"SQLite format 3\0" + b"\0" * 84, "is a SQLite file but no glstar catalogue; name one that `glstar sky"),
    ],
)
def test_a_file_that_is_no_catalogue_is_refused(tmp_path: Path, content: bytes, message: str) -> None:
    path = tmp_path / "none.sqlite"
    path.write_bytes(content)
    with pytest.raises(CatalogueError) as refused:
        StarCatalogue.open(path)
    assert str(refused.value).startswith(f"{path}: {message}")


def test_a_missing_file_is_named_with_what_to_do(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("GLSTAR_DATA_DIR", str(tmp_path))
    monkeypatch.setattr(reading, "asset", lambda name: tmp_path / name)
    for asked, message in (
        ("gaia", "does not exist yet; run `glstar sky catalogue build gaia`"),
        ("bsc5", "is missing from this installation; run `glstar sky catalogue build bsc5`"),
        (tmp_path / "x.sqlite", "does not exist; name a catalogue file, bsc5, hipparcos, tycho2 or gaia"),
        (tmp_path, "is a directory; name a catalogue file, bsc5, hipparcos, tycho2 or gaia"),
    ):
        with pytest.raises(CatalogueError) as refused:
            StarCatalogue.open(asked)
        assert str(refused.value).endswith(f": {message}")


def test_no_star_has_larger_numbers(small: CatalogueFile) -> None:
    row = CatalogueRow(5, "", "", 0.1, 0.2, 0.0, 0.0, 3.0, None, 0.0, None)
    limits = {
        "number": 2**31 - 1, "ra_rad": 2 * np.pi, "dec_rad": np.pi / 2, "pm_ra_cosdec_rad_per_yr": 1.0,
        "pm_dec_rad_per_yr": 1.0, "vmag": 100.0, "bv": 100.0, "parallax_rad": 1.0, "radial_velocity_m_per_s": 3e8,
    }  # fmt: skip
    assert dict(reading.LARGEST) == limits
    for name, limit in limits.items():
        for sign in (1, -1):
            assert len(reading._rows([row, row._replace(**{name: sign * limit})])) == 2
            beyond = sign * (limit + 1 if name == "number" else limit * 1.04)
            with pytest.raises(sqlite3.DataError, match=re.escape(f"a star has a {name} of more than {limit:g}")):
                reading._rows([row, row._replace(**{name: beyond})])
    for name, value in (("number", 5.0), ("name", 5), ("designation", None), ("bv", "x"), ("vmag", None)):
        with pytest.raises(sqlite3.DataError, match=f"^a star has a {name} of another type$"):
            reading._rows([row, row._replace(**{name: value})])


def test_columns_of_a_catalogue_have_one_length(small: CatalogueFile) -> None:
    stars = small.by_id([5, 8])
    with pytest.raises(ValueError, match=r"^a catalogue of 2 names cannot have a column of shape \(3,\)$"):
        replace(stars, vmag=np.zeros(3))
    plain = StarCatalogue("", stars.star_id, ("", ""), *(np.zeros(2) for _ in range(6)))
    assert (plain.parallax_rad.tolist(), plain.radial_velocity_m_per_s.tolist()) == ([0, 0], [0, 0])
    with pytest.raises(ValueError, match="read-only"):
        plain.parallax_rad[0] = 1


def test_harmanecs_v_and_a_straight_motion() -> None:
    hp, bv = np.array([5.0, 6.0, 7.0, 8.0]), np.array([1.2, np.nan, -0.4, 2.3])
    colour = np.array([1.2, 0.61, -0.25, 2.0])
    expected = hp - 0.2964 * colour + 0.1110 * colour**2 + 0.0157 * colour**3 + 0.0072
    np.testing.assert_allclose(vmag_from_hp(hp, bv), expected, rtol=1e-14)
    # A star on the equator at 0 h that moves by 0.3 rad a year to the east for 8.75 years: on a line in space.
    ra, dec, pm_ra, pm_dec = to_j2000([0.0], [0.0], [0.3], [0.0], epoch_yr=1991.25)
    assert (ra[0], dec[0]) == pytest.approx((np.arctan(0.3 * 8.75), 0.0), rel=1e-14)
    assert (pm_ra[0], pm_dec[0]) == pytest.approx((0.3 / (1 + (0.3 * 8.75) ** 2), 0.0), rel=1e-14, abs=1e-16)
    ra, dec, pm_ra, pm_dec = to_j2000([6.28], [0.3], [0.0], [0.02], epoch_yr=2010.0)
    assert (ra[0], dec[0]) == pytest.approx((6.28, 0.3 - np.arctan(0.2)), rel=1e-14)
    assert (pm_ra[0], pm_dec[0]) == pytest.approx((0.0, 0.02 / 1.04), rel=1e-13, abs=1e-16)


HIP2 = (
    "{hip} 5 0 1  {ra}  {dec}  {plx}  44.48  -11.85 0.09 0.10 0.11 0.11 0.13 127 1.08 2 0.0 0  {hp} 0.0021 0.014 1"
    " {bv} {bv_error} {vi} 1.02"
)
PLAIN = {"hip": 32349, "ra": 1.7678, "dec": -0.2917, "plx": 379.21, "hp": -1.0, "bv": 0.009, "bv_error": 0, "vi": 0}


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ([{"ra": 6.29}], "gives number 32349 a place that is not in the sky"),
        ([{"ra": -0.01}], "gives number 32349 a place that is not in the sky"),
        ([{"dec": 1.58}], "gives number 32349 a place that is not in the sky"),
        ([{}, {}], "holds number 32349 twice"),
        ([{"hp": 21.0}], "gives number 32349 the magnitude 21.0"),
        ([{"hp": -2.1}], "gives number 32349 the magnitude -2.1"),
        ([], "holds no star"),
    ],
)
def test_a_table_of_hipparcos_is_refused_with_its_star(
    tmp_path: Path, changes: list[dict[str, float]], message: str
) -> None:
    source = tmp_path / "hip2.dat"
    source.write_text("\n".join(HIP2.format(**PLAIN | {"hip": 32349} | change) for change in changes) + "\n")
    with pytest.raises(CatalogueError) as refused:
        build_hipparcos(tmp_path / "out.sqlite", source)
    assert str(refused.value) == f"{source}: {message}; give the wheel or the table itself with --from"


def test_stars_of_hipparcos_have_colours_names_and_rounded_places(tmp_path: Path) -> None:
    source = tmp_path / "hip2.dat"
    lines = (
        PLAIN, PLAIN | {"hip": 5, "bv": 0, "hp": 8.5, "plx": -2.0}, PLAIN | {"hip": 9, "bv": 0, "vi": 0.5, "hp": 9.5},
        PLAIN | {"hip": 11, "bv": 0, "bv_error": 0.1, "hp": 10.5},
    )  # fmt: skip
    source.write_text("\n".join(HIP2.format(**line) for line in lines))
    built = build_hipparcos(str(tmp_path / "out.sqlite"), str(source))
    stars = built.brighter_than(20.0)
    assert stars.star_id.tolist() == [32349, 5, 9, 11]
    assert stars.name == ("Sirius", "", "", "")
    np.testing.assert_array_equal(stars.bv, [0.009, np.nan, 0.0, 0.0])
    expected = vmag_from_hp([-1.0, 8.5, 9.5, 10.5], [0.009, np.nan, 0.0, 0.0])
    np.testing.assert_allclose(stars.vmag, expected, rtol=0, atol=5.1e-4)
    assert all(round(mag, 3) == mag for mag in stars.vmag.tolist())
    mas = np.pi / 648000 / 1000
    np.testing.assert_allclose(stars.parallax_rad / mas, [379.21, 0, 379.21, 379.21], rtol=1e-9)
    moved = to_j2000([1.7678], [-0.2917], [44.48 * mas], [-11.85 * mas], epoch_yr=1991.25)
    np.testing.assert_allclose([stars.ra_rad[0], stars.dec_rad[0]], np.ravel(moved[:2]), rtol=0, atol=6e-13)
    np.testing.assert_allclose(stars.pm_ra_cosdec_rad_per_yr, np.full(4, moved[2][0]), rtol=0, atol=6e-17)
    np.testing.assert_allclose(stars.pm_dec_rad_per_yr, np.full(4, moved[3][0]), rtol=0, atol=6e-17)
    assert "1 stars without a colour have V as if B - V were 0.61" in built.provenance["magnitude"]
    assert built.provenance["source"] == "the file hip2.dat"
    with pytest.raises(CatalogueError, match=r"hip3\.dat: does not exist; give the wheel or the table itself with"):
        build_bsc5(tmp_path / "bsc.sqlite", tmp_path / "hip3.dat")
