"""Deep catalogues from the tables that users bring, against published records and ERFA."""

import gzip
import io
import re
from pathlib import Path

import erfa
import numpy as np
import pytest
from typer.testing import CliRunner

from glstar.cli.machine.catalogue import app
from glstar.errors import CatalogueError
from glstar.sky.catalogue.deep import build_gaia, build_hip_main, build_table, build_tycho2
from glstar.sky.catalogue.reading import StarCatalogue, star_label, tycho_number
from glstar.sky.catalogue.writing import space_motion_to_j2000, vmag_from_gaia
from tests.support.cataloguefiles import HIP_1, SIRIUS, TYC_1, WITHOUT_MEAN

MAS = np.pi / 648000 / 1000


def test_the_main_table_of_hipparcos_is_read(tmp_path: Path) -> None:
    source = tmp_path / "hip_main.dat"
    source.write_text(HIP_1 + "\n", encoding="ascii")
    star = build_hip_main(tmp_path / "hip.sqlite", source).by_id([1])
    assert star.catalogue == "hipparcos"
    # 8.75 years of proper motion.
    ra_deg = 0.00091185 - 8.75 * 5.20e-3 / 3600 / np.cos(np.deg2rad(1.08901332))
    dec_deg = 1.08901332 - 8.75 * 1.88e-3 / 3600
    np.testing.assert_allclose(np.rad2deg([star.ra_rad[0], star.dec_rad[0]]), [ra_deg, dec_deg], rtol=0, atol=1e-9)
    np.testing.assert_allclose([star.vmag[0], star.bv[0]], [9.10, 0.482], rtol=0, atol=1e-9)
    np.testing.assert_allclose(star.parallax_rad[0] / MAS, 3.54, rtol=0, atol=1e-6)


def test_tycho_2_is_read_with_its_supplement_plain_or_compressed(tmp_path: Path) -> None:
    (tmp_path / "tyc2.dat.00.gz").write_bytes(gzip.compress(f"{TYC_1}\n{WITHOUT_MEAN}\n".encode()))
    (tmp_path / "suppl_1.dat").write_text(SIRIUS + "\r\n", encoding="ascii", newline="")
    stars = build_tycho2(tmp_path / "tycho2.sqlite", [tmp_path]).brighter_than(20.0)
    assert stars.catalogue == "tycho2"
    assert [star_label(stars.catalogue, n) for n in stars.star_id] == ["TYC 5949-2777-1", "TYC 2-12-3", "TYC 1-8-1"]
    # Places at J2000: Sirius as SIMBAD gives it (06 45 08.917, -16 42 58.02), TYC 1-8-1 as published.
    degrees = np.rad2deg([stars.ra_rad, stars.dec_rad]).T
    np.testing.assert_allclose(degrees[0], [101.287155, -16.716116], rtol=0, atol=2e-6)
    np.testing.assert_allclose(degrees[1], [2.31754222, 2.23186444], rtol=0, atol=1e-9)
    np.testing.assert_allclose(degrees[2], [2.31750494, 2.23184345], rtol=0, atol=1e-9)
    np.testing.assert_allclose(stars.pm_ra_cosdec_rad_per_yr[2] / MAS, -16.3, rtol=0, atol=1e-6)
    # V = VT - 0.090 (BT - VT), B - V = 0.850 (BT - VT).
    np.testing.assert_allclose(stars.vmag, [-1.088, 12.01, 12.146], rtol=0, atol=1e-9)
    np.testing.assert_allclose(stars.bv, [np.nan, 0.85, 0.0], rtol=0, atol=1e-9)


def test_the_largest_tycho_number_fits_and_is_written_back() -> None:
    number = tycho_number("9537 12121 3")
    assert number < 2**31
    assert star_label("tycho2", number) == "TYC 9537-12121-3"


@pytest.mark.parametrize("content", ["", "1,2,3\n", HIP_1[:100], TYC_1.replace("2.31750494", "2.3175o494")])
def test_a_file_that_is_no_part_of_tycho_2_is_refused(tmp_path: Path, content: str) -> None:
    (tmp_path / "tyc2.dat").write_text(content, encoding="ascii")
    with pytest.raises(CatalogueError, match=r"tyc2\.dat: (is no table of Tycho-2: line 1|holds no star)"):
        build_tycho2(tmp_path / "out.sqlite", [tmp_path / "tyc2.dat"])
    assert not (tmp_path / "out.sqlite").exists()


@pytest.mark.parametrize(
    ("old", "new", "why"),
    [
        ("0001 00008 1", "000199999999999999999 1 1", "is no table of Tycho-2: line 1 has a field that is no number"),
        ("0001 00008 1", "0099999 00008 1", "gives number 19999800081 a number of 1.99998e+10"),
        ("  2.31750494", "       1e999", "holds the number inf, which no star has"),
        ("  2.23184345", " 99.23184345", "gives number 200081 a dec_rad of 1.73192"),
        ("  -16.3", "-163e12", "holds the number -1.63e+14, which no star has"),
        ("  -16.3", " -163e9", "gives number 200081 a pm_ra_cosdec_rad_per_yr of -790"),
        ("|12.146|0.223", "|82.146|0.223", "gives number 200081 the magnitude 88.4"),
    ],
)
def test_a_star_of_tycho_2_with_an_absurd_number_is_refused(tmp_path: Path, old: str, new: str, why: str) -> None:
    assert old in TYC_1
    (tmp_path / "tyc2.dat").write_text(TYC_1.replace(old, new), encoding="ascii")
    with pytest.raises(CatalogueError, match=rf"tyc2\.dat: {re.escape(why)}"):
        build_tycho2(tmp_path / "out.sqlite", [tmp_path / "tyc2.dat"])
    assert not (tmp_path / "out.sqlite").exists()


def test_a_star_of_hipparcos_with_a_number_beyond_64_bits_is_refused(tmp_path: Path) -> None:
    (tmp_path / "hip_main.dat").write_text(HIP_1.replace("           1| |", f"{10**20}| |", 1), encoding="ascii")
    with pytest.raises(CatalogueError, match=r"hip_main\.dat: is no table of hip_main\.dat: line 1 has a field"):
        build_hip_main(tmp_path / "out.sqlite", tmp_path / "hip_main.dat")


def test_space_motion_follows_erfa_with_parallax_and_radial_velocity() -> None:
    # Barnard's Star at J2016 (Gaia DR3), whose perspective acceleration is 1.2 mas/yr^2: 0.15" in 16 years.
    place_deg, pm_mas = (269.4485, 4.73942), (-801.551, 10362.394)
    ra, dec, pm_ra, pm_dec = space_motion_to_j2000(
        ([np.deg2rad(place_deg[0])], [np.deg2rad(place_deg[1])]),
        ([pm_mas[0] * MAS], [pm_mas[1] * MAS]),
        [546.976 * MAS],
        [-110470.0],
        2016.0,
    )
    radians = np.deg2rad(place_deg)
    pm = pm_mas[0] * MAS / np.cos(radians[1]), pm_mas[1] * MAS
    there = erfa.starpm(*radians, *pm, 0.546976, -110.47, 2451545.0, 16 * 365.25, 2451545.0, 0.0)
    np.testing.assert_allclose([ra[0], dec[0]], there[:2], rtol=0, atol=1e-12)
    np.testing.assert_allclose([pm_ra[0] / np.cos(dec[0]), pm_dec[0]], there[2:4], rtol=0, atol=1e-14)
    linear = radians[1] - 16 * pm_mas[1] * MAS
    assert 0.1 < abs(dec[0] - linear) / MAS / 1000 < 0.2


def test_v_of_gaia_is_that_of_the_published_relation() -> None:
    # Gaia EDR3 documentation, table 5.9, worked in decimals: x = 1 gives G - V = -0.21414.
    np.testing.assert_allclose(vmag_from_gaia([10.0, 10.0], [1.0, 0.0]), [10.21414, 10.02704], rtol=0, atol=1e-9)


CSV = """\
source_id,ra,dec,parallax,pmra,pmdec,radial_velocity,phot_g_mean_mag,bp_rp,ref_epoch
4472832130942575872,269.4485,4.73942,546.976,-801.551,10362.394,-110.47,8.1939,2.8338,2016.0
5853498713190525696,217.392321,-62.676075,768.0665,-3781.741,769.465,null,8.9848,3.8047,2016.0
"""


@pytest.mark.parametrize("kind", ["csv", "csv.gz", "fits"])
def test_a_table_of_gaias_archive_is_read_by_its_own_columns(tmp_path: Path, kind: str) -> None:
    source = tmp_path / f"stars.{kind}"
    if kind == "csv":
        source.write_text(CSV, encoding="utf-8")
    elif kind == "csv.gz":
        source.write_bytes(gzip.compress(CSV.encode()))
    else:
        table = pytest.importorskip("astropy.table").Table.read(CSV.replace("null", "nan"), format="ascii.csv")
        packed = io.BytesIO()
        table.write(packed, format="fits")
        source.write_bytes(packed.getvalue())
    stars = build_gaia(tmp_path / "gaia.sqlite", source, {}).brighter_than(20.0)
    assert stars.name == ("Gaia DR3 4472832130942575872", "Gaia DR3 5853498713190525696")
    # Johnson V of Barnard's Star is 9.51, of Proxima 11.13 (SIMBAD); for stars as red as these the relation is off by
    # up to 0.2 mag, as the manual says.
    np.testing.assert_allclose(stars.vmag, [9.51, 11.13], rtol=0, atol=0.2)
    # Barnard's Star at J2000 by Hipparcos (van Leeuwen 2007), without radial velocity: 17 57 48.49803, +04 41 36.2072.
    place = np.rad2deg([stars.ra_rad[0], stars.dec_rad[0]])
    np.testing.assert_allclose(place, [269.452075, 4.693391], rtol=0, atol=0.1 / 3600)
    np.testing.assert_allclose(stars.radial_velocity_m_per_s, [-110470, 0], rtol=0, atol=0.1)


def test_a_table_is_read_by_a_map_of_columns(tmp_path: Path) -> None:
    source = tmp_path / "survey.csv"
    source.write_text("star,alpha,delta,m\n7,10.0,-20.0,8.5\n9,11.0,-21.0,\n", encoding="utf-8")
    runner, out = CliRunner(), tmp_path / "survey.sqlite"
    columns = [f"--column={c}" for c in ("number=star", "ra_deg=alpha", "dec_deg=delta", "vmag=m")]
    result = runner.invoke(app, ["build", "table", "--from", str(source), "-o", str(out), *columns])
    assert result.exit_code == 0, result.output
    assert "1 stars, V 8.50" in result.output.replace("\n", "")
    assert "the brightest of the sky are missing" in result.output
    stars = StarCatalogue.open(out).brighter_than(20)
    assert (stars.catalogue, stars.star_id.tolist(), stars.vmag.tolist()) == ("", [7], [8.5])
    with pytest.raises(CatalogueError, match="has no column of right ascension and declination among star, alpha"):
        build_table(out, source, {"number": "star"})
    with pytest.raises(CatalogueError, match="has no column 'V'; it has star, alpha, delta, m"):
        build_table(out, source, {"vmag": "V"})
    (tmp_path / "stars.parquet").write_bytes(b"PAR1....PAR1")
    with pytest.raises(CatalogueError, match="Parquet table; write it as CSV or FITS"):
        build_table(out, tmp_path / "stars.parquet", {})
    again = runner.invoke(app, ["build", "table", "--from", str(source), "-o", str(out), *columns])
    assert "exists already; --force replaces it" in str(again.exception)


@pytest.mark.parametrize("code", ["-99", "99.99", "-99.999", "1e20", "-9999", "inf", ""])
def test_codes_of_missing_values_are_no_magnitudes_colours_or_motions(tmp_path: Path, code: str) -> None:
    source = tmp_path / "survey.csv"
    rows = ["1,10,-20,8.5,0.5,3", f"2,11,-21,{code},0.5,3", f"3,12,-22,9.5,{code},1e{300 if code else 20}"]
    source.write_text("\n".join(["id,ra,dec,vmag,bv,pmra", *rows]), encoding="utf-8")

    build_table(tmp_path / "survey.sqlite", source, {})

    stars = StarCatalogue.open(tmp_path / "survey.sqlite").brighter_than(30)
    np.testing.assert_array_equal(stars.star_id, [1, 3])
    np.testing.assert_array_equal(stars.vmag, [8.5, 9.5])
    np.testing.assert_array_equal(stars.bv, [0.5, np.nan])
    np.testing.assert_allclose(stars.pm_ra_cosdec_rad_per_yr, [3 * MAS, 0], rtol=0, atol=1e-15)


@pytest.mark.parametrize(
    ("damaged", "by"),
    [(b"XTENSION= 'BINTABLE'", b"XTENSION= 'BI\0TABLE'"), (b"XTENSION= 'BINTABLE'", b"XTENSION= 'FOREIGN '")],
)
def test_a_fits_file_whose_table_is_damaged_is_refused(tmp_path: Path, damaged: bytes, by: bytes) -> None:
    """astropy gives units of other kinds, whose data are missing or no table."""
    fits = pytest.importorskip("astropy.io.fits")
    source = tmp_path / "stars.fits"
    fits.BinTableHDU.from_columns([fits.Column("vmag", "E", array=np.arange(9.0))]).writeto(source)
    source.write_bytes(source.read_bytes().replace(damaged, by))
    with pytest.raises(CatalogueError, match="is a FITS file without a table"):
        build_table(tmp_path / "stars.sqlite", source, {})


def test_more_stars_than_one_chunk_are_read_in_the_order_of_brightness(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    source = tmp_path / "many.csv"
    rng = np.random.default_rng(3)
    vmag = rng.uniform(1, 12, 250).round(2)
    lines = [f"{k + 1},{k},{k / 5 - 20},{v}" for k, v in enumerate(vmag)]
    source.write_text("\n".join(["id,ra,dec,vmag", *lines]), encoding="utf-8")
    catalogue = build_table(tmp_path / "many.sqlite", source, {})
    whole = catalogue.brighter_than(11.0)
    monkeypatch.setattr("glstar.sky.catalogue.reading._ROWS_AT_ONCE", 40)
    parts = catalogue.brighter_than(11.0)
    assert (
        parts.star_id.tolist()
        == whole.star_id.tolist()
        == [k + 1 for k in np.argsort(vmag, kind="stable") if vmag[k] <= 11]
    )
    assert parts.name == whole.name
    np.testing.assert_array_equal(parts.direction, whole.direction)
