"""Magnitudes of a table of star brightness: each refusal word for word, and which stars are the same."""

from hashlib import sha256
from pathlib import Path

import numpy as np
import pytest

from glstar.errors import CalibrationError
from glstar.sky import photometry
from glstar.sky.catalogue.starfield import StarField
from glstar.sky.photometry import StarBrightness, brightness_ratio, magnitude_difference, star_colours

NONE = "is no table of star brightness: "


def table_of(folder: Path, text: str) -> Path:
    path = folder / "table.csv"
    path.write_text(text, encoding="utf-8")
    return path


def field(
    star_id: list[int], vmag: list[float], *, bv: list[float] | None = None, catalogue: str = "bsc5"
) -> StarField:
    return StarField(
        catalogue=catalogue,
        star_id=np.array(star_id, np.int32),
        name=("",) * len(star_id),
        vmag=np.array(vmag),
        direction_eq=np.tile([0.0, 0.6, 0.8], (len(star_id), 1)),
        epoch_utc_s=0.0,
        C_eq_icrs=np.eye(3),
        bv=None if bv is None else np.array(bv, np.float32),
    )


def test_magnitudes_and_ratios_are_pogsons() -> None:
    np.testing.assert_allclose(brightness_ratio([2.5, -1.0, 7.5]), [0.1, 10**0.4, 1e-3], rtol=1e-14)
    np.testing.assert_allclose(magnitude_difference([0.1, 100.0]), [2.5, -5.0], rtol=1e-14)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", NONE + "it has no stars, or no column star_id, vmag, camera_mag"),
        ("star_id,vmag,camera_mag\n", NONE + "it has no stars, or no column star_id, vmag, camera_mag"),
        ("star_id,camera_mag\n1,2\n", NONE + "it has no stars, or no column vmag"),
        ("star_id,vmag,camera_mag\n1,2,3\n2,3,x\n", NONE + "line 3 has a value that is not a number"),
        ("star_id,vmag,camera_mag\n1,2,3\n2,3\n", NONE + "line 3 has a value that is not a number"),
        ("star_id,vmag,camera_mag\n1.5,2,3\n", NONE + "line 2 has a value that is not a number"),
        ("star_id,vmag,camera_mag\n1,2,3\n2,inf,3\n", NONE + "a star twice, or no number"),
        ("star_id,vmag,camera_mag\n1,2,3\n2,3,nan\n", NONE + "a star twice, or no number"),
        ("star_id,vmag,camera_mag\n3,2,3\n1,3,3\n3,2,3\n", NONE + "a star twice, or no number"),
        (
            "catalogue,star_id,vmag,camera_mag\nbsc5,3,2,3\ngaia,1,3,3\n",
            NONE + "its stars are of several catalogues",
        ),
    ],
)
def test_a_table_is_refused_with_its_fault(tmp_path: Path, text: str, message: str) -> None:
    path = table_of(tmp_path, text)
    with pytest.raises(CalibrationError) as refused:
        StarBrightness.open(path)
    assert str(refused.value) == f"{path}: {message}"


def test_numbers_beyond_32_bits_and_other_bytes_are_refused(tmp_path: Path) -> None:
    with pytest.raises(
        CalibrationError, match="is no table of star brightness: Python integer 2147483648 out of bounds"
    ):
        StarBrightness.open(table_of(tmp_path, "star_id,vmag,camera_mag\n2147483648,2,3\n"))
    path = tmp_path / "other.csv"
    path.write_bytes(b"star_id,vmag,camera_mag\n1,2,\xff\n")
    with pytest.raises(
        CalibrationError, match=r"other\.csv: is no table of star brightness: 'utf-8' codec can't decode"
    ):
        StarBrightness.open(path)


def test_a_table_has_its_columns_in_the_order_of_the_file(tmp_path: Path) -> None:
    text = "\ufeffvmag,hr,catalogue,camera_mag\n4.5,77,gaia,4.75\n3.25,12,gaia,3.5\n"
    path = table_of(tmp_path, text)
    table = StarBrightness.open(str(path))
    assert (len(table), table.path, table.catalogue) == (2, path, "gaia")
    assert table.sha256 == sha256(text.encode()).hexdigest()
    np.testing.assert_array_equal([table.star_id, table.vmag, table.camera_mag], [[77, 12], [4.5, 3.25], [4.75, 3.5]])
    assert table.star_id.dtype == np.int32
    for array in (table.star_id, table.vmag, table.camera_mag):
        with pytest.raises(ValueError, match="read-only"):
            array[0] = 1
    other = StarBrightness.open(table_of(tmp_path, text + "1.5,13,gaia,1.75\n"))
    assert table != other
    assert table != "gaia"
    assert len({hash(table), hash(other), hash(StarBrightness.open(path))}) == 2
    assert StarBrightness.open(table_of(tmp_path, "star_id,vmag,camera_mag\n1,2,3\n")).catalogue == ""


def test_stars_are_the_same_within_a_tenth_of_a_magnitude(tmp_path: Path) -> None:
    rows = [f"gaia,{k},{k / 10},{k / 10 - 0.3}" for k in range(1, 22)]
    table = StarBrightness.open(table_of(tmp_path, "catalogue,star_id,vmag,camera_mag\n" + "\n".join(rows)))
    # Of 20 known stars, two may differ by more.
    numbers = [40, *range(20, 0, -1)]
    vmag = [5.0, *(k / 10 for k in range(20, 0, -1))]
    vmag[1], vmag[2], vmag[20] = 2.0 - 0.104, 1.9 + 0.104, 0.1 + 0.096
    stars = field(numbers, vmag, catalogue="gaia")
    expected = np.array(vmag)
    expected[3:] = np.arange(18, 0, -1) / 10 - 0.3
    np.testing.assert_allclose(table.magnitudes("gaia", stars.star_id, stars.vmag), expected, rtol=1e-12)
    applied = table.applied(stars)
    np.testing.assert_allclose(applied.measured_mag, expected, rtol=1e-12)
    np.testing.assert_array_equal(applied.is_measured, [False] * 3 + [True] * 18)
    assert applied.vmag is stars.vmag
    vmag[3] = 1.0
    with pytest.raises(CalibrationError) as refused:
        table.applied(field(numbers, vmag, catalogue="gaia"))
    assert str(refused.value) == (
        f"{table.path}: is of another catalogue: 3 of its 20 stars have other magnitudes there; set sky.catalogue to"
        " the one that the camera was calibrated with"
    )
    with pytest.raises(CalibrationError) as refused:
        table.magnitudes("bsc5", stars.star_id, stars.vmag)
    assert str(refused.value) == (
        f"{table.path}: is of the catalogue gaia, and the simulation uses bsc5; set sky.catalogue to gaia, which the"
        " camera was calibrated with"
    )
    unknown = table.magnitudes("", np.array([99], np.int32), np.array([4.0]))
    np.testing.assert_array_equal(unknown, [4.0])


def test_colours_come_from_the_catalogue_or_hipparcos(monkeypatch: pytest.MonkeyPatch) -> None:
    bundled = np.array([3, 15, 40], np.int32), np.array([0.25, -0.125, 1.5])
    monkeypatch.setattr(photometry, "_bundled", lambda: bundled)
    nan = np.nan
    stars = field([40, 3, 2, 15, 41, 16], [1.0] * 6, bv=[0.5, nan, nan, nan, nan, 0.75])
    np.testing.assert_array_equal(star_colours(stars), [0.5, 0.25, nan, -0.125, nan, 0.75])
    np.testing.assert_array_equal(star_colours(stars, np.array([3, 1])), [-0.125, 0.25])
    plain = field([40, 3, 2], [1.0] * 3)
    np.testing.assert_array_equal(star_colours(plain, slice(1)), [1.5])
    other = field([40, 3, 2], [1.0] * 3, catalogue="gaia")
    np.testing.assert_array_equal(star_colours(other), [nan] * 3)


def test_the_bundled_colours_are_those_of_well_known_stars() -> None:
    # Hipparcos: Sirius, Rigel, Betelgeuse, Arcturus and Vega.
    stars = field([2491, 1713, 2061, 5340, 7001], [0.0] * 5)
    np.testing.assert_allclose(star_colours(stars), [0.009, -0.03, 1.5, 1.239, -0.001], rtol=0, atol=0.002)
    assert (photometry.USUAL_BV, photometry.VALID_BV) == (0.65, (-0.3, 1.7))
