"""Headers, checksums and polynomials of FITS files, against astropy and numbers made by hand."""

import re
from dataclasses import replace
from io import BytesIO
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from astropy.io import fits
from astropy.time import Time

from glstar.camera.exposure import Exposure
from glstar.export.imagefiles import fits as fitsfile
from glstar.export.imagefiles.fits import (
    SipCoordinates,
    _encoded_checksum,
    _exponents,
    _grid,
    _line,
    _matrices,
    _ones_complement_sum,
    _Polynomial,
    damage_of_fits,
    decode_fits,
    encode_fits,
    without_truth,
)
from glstar.export.imagefiles.formats import decode, encode, find_damage, tiff
from glstar.render.scene.scene import Frame
from glstar.sky.place.site import Site

UTC_S = 1_710_068_400.0  # 2024-03-10T11:00:00Z
PIXELS = np.arange(35, dtype=np.uint16).reshape(5, 7) * 117
WCS = SipCoordinates(
    radial=np.zeros(0),
    crpix_px=np.array([3.25, 2.5]),
    crval_rad=np.radians([123.5, -45.25]),
    cd_rad=np.radians([[0.01, 0.002], [-0.003, 0.04]]),
    a=np.array([[0, 0, 0.5], [0, 0.25, 0], [0, 0, 0]]),
    b=np.array([[0, 0, 0], [0, 0, 0], [0.125, 0, 0]]),
    ap=np.array([[0.75, 0, 0], [0, 0, 0], [0, 0, 0]]),
    bp=np.zeros((3, 3)),
    rms_px=0.001,
    max_px=0.002,
    inverse_max_px=0.003,
)
STACKED = Exposure(UTC_S, 0.5, frames=3, gap_s=0.25, stack="mean")
SENSOR = {"analogue_gain": 2.0, "gain_dn_per_e": 0.5, "temperature_c": -10.0, "black_level_dn": 16.0, "mosaic": "rggb"}


def scene_of(exposure: Exposure = STACKED, **keys: Any) -> Any:
    sensor = SimpleNamespace(saturation_dn=4095, keys=keys or SENSOR, effects={"sensor.sky_mean_dn": 12.5})
    site = Site(np.radians(-34.5), np.radians(138.25), 312.5)
    return SimpleNamespace(exposure=exposure, site=site, sensor=sensor, time_offset_s=0.125)


def encoded(monkeypatch: pytest.MonkeyPatch, wcs: SipCoordinates | None = WCS, **options: Any) -> bytes:
    monkeypatch.setattr(fitsfile, "fit_sip", lambda _: wcs)
    scene = options.pop("scene", scene_of())
    return encode_fits(scene, Frame(PIXELS, scene.exposure, 7), number=3, **options)


STRUCTURE = {"SIMPLE": True, "BITPIX": 16, "NAXIS": 2, "NAXIS1": 7, "NAXIS2": 5, "BZERO": 32768, "BSCALE": 1}
# The stack ends after three exposures and two pauses: 2 s.
TIMES = {
    "DATE-OBS": "2024-03-10T11:00:00.000000",
    "DATE-AVG": "2024-03-10T11:00:01.000000",
    "DATE-END": "2024-03-10T11:00:02.000000",
    **{f"MJD-{name}": Time(UTC_S + k, format="unix").mjd for k, name in ((0, "OBS"), (1, "AVG"), (2, "END"))},
    "TIMESYS": "UTC",
    "CLKOFFS": 0.125,
}
LENGTH = {"EXPTIME": 0.5, "NCOMBINE": 3, "SUBEXP": 0.5, "SUBGAP": 0.25}
PLACE = {"SITELAT": -34.5, "SITELONG": 138.25, "SITEELEV": 312.5, "IMAGETYP": "Light Frame", "ROWORDER": "TOP-DOWN"}
NUMBERS = {"FRAME": 3, "SEED": 7, "SWCREATE": "glstar"}
CAMERA = {"SATURATE": 4095, "BUNIT": "adu", "GAIN": 2.0, "DNPERE": 0.5, "CCD-TEMP": -10.0, "BLKLEVEL": 16.0}
CAMERA |= {"SKYLEVEL": 12.5, "BAYERPAT": "RGGB"}
COORDINATES = {
    "WCSAXES": 2,
    "CTYPE1": "RA---TAN-SIP",
    "CTYPE2": "DEC--TAN-SIP",
    "RADESYS": "ICRS",
    "CRPIX1": 4.25,
    "CRVAL1": 123.5,
    "CUNIT1": "deg",
    "CRPIX2": 3.5,
    "CRVAL2": -45.25,
    "CUNIT2": "deg",
    "CD1_1": 0.01,
    "CD1_2": 0.002,
    "CD2_1": -0.003,
    "CD2_2": 0.04,
    "WCSRMS": 0.001,
    "WCSMAX": 0.002,
    "WCSIMAX": 0.003,
    "A_ORDER": 2,
    "A_0_2": 0.5,
    "A_1_1": 0.25,
    "B_ORDER": 2,
    "B_2_0": 0.125,
    "AP_ORDER": 2,
    "AP_0_0": 0.75,
    "BP_ORDER": 2,
}


def test_a_header_has_every_card_in_its_order(monkeypatch: pytest.MonkeyPatch) -> None:
    content = encoded(monkeypatch)

    assert len(content) == 2 * 2880 + 2880
    whole = fits.getheader(BytesIO(content), checksum=True)
    header = dict(whole)
    np.testing.assert_array_equal(fits.getdata(BytesIO(content)), PIXELS)
    comments = {key: whole.comments[key] for key in ("SITELAT", "CLKOFFS", "EXPTIME", "CD1_1", "A_0_2")}
    assert list(header)[-2:] == ["DATASUM", "CHECKSUM"]
    del header["DATASUM"], header["CHECKSUM"]
    expected = STRUCTURE | TIMES | LENGTH | PLACE | NUMBERS | CAMERA | COORDINATES
    assert list(header) == list(expected)
    for key, value in expected.items():
        assert header[key] == (pytest.approx(value, rel=1e-14, abs=1e-12) if isinstance(value, float) else value)
    assert comments == {
        "SITELAT": "deg north, WGS84",
        "CLKOFFS": "s, the camera's clock minus UTC",
        "EXPTIME": "s, of the mean",
        "CD1_1": "deg/px",
        "A_0_2": "",
    }


def test_a_header_says_what_an_exposure_and_a_sensor_have(monkeypatch: pytest.MonkeyPatch) -> None:
    summed = encoded(monkeypatch, scene=scene_of(replace(STACKED, stack="sum"), mosaic="none"))
    header = fits.getheader(BytesIO(summed))
    assert (header["EXPTIME"], header["SUBEXP"], header["SATURATE"]) == (1.5, 0.5, 3 * 4095)
    assert not {"GAIN", "BAYERPAT"} & set(header)
    single = fits.getheader(BytesIO(encoded(monkeypatch, None, scene=scene_of(Exposure(UTC_S, 0.5)))))
    assert single["EXPTIME"] == 0.5
    assert not {"NCOMBINE", "SUBEXP", "SUBGAP", "WCSAXES", "CTYPE1"} & set(single)
    wide = replace(WCS, radial=np.array([1.0, -0.25, *[0.5] * 8]))
    header = fits.getheader(BytesIO(encoded(monkeypatch, wide)))
    assert (header["CTYPE1"], header["CTYPE2"]) == ("RA---ZPN-SIP", "DEC--ZPN-SIP")
    assert [header[f"PV2_{k}"] for k in range(1, 20, 2)] == [1.0, -0.25, *[0.5] * 8]
    assert header.comments["PV2_1"] == "of the angle from the reference, rad"


def test_shifted_numbers_are_scaled_back_by_the_header_and_by_glstar(monkeypatch: pytest.MonkeyPatch) -> None:
    content = encoded(monkeypatch, shift_bits=4)

    with fits.open(BytesIO(content)) as file:
        np.testing.assert_array_equal(file[0].data, PIXELS)
    raw = fits.open(BytesIO(content), do_not_scale_image_data=True)[0]
    assert (raw.header["BZERO"], raw.header["BSCALE"]) == (2048, 0.0625)
    np.testing.assert_array_equal(raw.data.astype(int) + 32768, PIXELS.astype(int) * 16)
    np.testing.assert_array_equal(decode_fits(content), PIXELS, strict=True)
    np.testing.assert_array_equal(decode_fits(encoded(monkeypatch)), PIXELS, strict=True)


def test_a_file_for_a_navigator_has_its_clock_and_neither_place_nor_coordinates(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    utc = {name: f"2024-03-10T12:00:0{k}.500000Z" for k, name in enumerate(("start", "middle", "end"))}

    content = without_truth(encoded(monkeypatch), utc)

    header = dict(fits.getheader(BytesIO(content)))
    with fits.open(BytesIO(content), checksum=True) as file:
        np.testing.assert_array_equal(file[0].data, PIXELS)
        assert file[0].verify_checksum() == file[0].verify_datasum() == 1
    times = {f"DATE-{k}": f"2024-03-10T12:00:0{n}.500000" for n, k in enumerate(("OBS", "AVG", "END"))}
    camera = {key: value for key, value in CAMERA.items() if key != "SKYLEVEL"}
    kept = {"IMAGETYP": "Light Frame", "ROWORDER": "TOP-DOWN", "FRAME": 3, "SWCREATE": "glstar"}
    del header["DATASUM"], header["CHECKSUM"]
    assert header == STRUCTURE | LENGTH | kept | camera | times


@pytest.mark.parametrize(
    ("card", "line"),
    [
        (("SIMPLE", True, "FITS"), "SIMPLE  =                    T / FITS"),
        (("X", False, ""), "X       =                    F"),
        (("NAXIS", 2, ""), "NAXIS   =                    2"),
        (("N", np.int64(12), "c"), "N       =                   12 / c"),
        (("NAME", "it's", "c"), "NAME    = 'it''s   '           / c"),
        (("LONG", "x" * 20, ""), f"LONG    = '{'x' * 20}'"),
        (("GAIN", 2.0, ""), "GAIN    =                  2.0"),
        (("TINY", 1e-20, ""), "TINY    =                1E-20"),
        (("HUGE", np.float64(-2.5e30), ""), "HUGE    =             -2.5E+30"),
    ],
)
def test_a_card_is_that_of_the_standard(card: Any, line: str) -> None:
    assert _line(*card) == line


@pytest.mark.parametrize("seed", range(6))
def test_checksums_are_those_of_astropy(seed: int) -> None:
    content = np.random.default_rng(seed).integers(200 if seed % 2 else 0, 256, 2880, dtype=np.uint8)
    total = _ones_complement_sum(content.tobytes())

    unit = fits.PrimaryHDU()
    assert total == unit._compute_checksum(content, 0)
    assert _encoded_checksum(total) == unit._char_encode(~np.uint32(total))
    assert _ones_complement_sum(b"\xff\xff\xff\xff" * 3) == 0xFFFFFFFF
    assert _ones_complement_sum(b"\x80\x00\x00\x01\x80\x00\x00\x03") == 5


def test_a_damaged_header_is_named() -> None:
    card = b"SIMPLE  =                    T".ljust(80)
    sides = b"NAXIS1  =                    7".ljust(80) + b"NAXIS2  =                  500".ljust(80)
    whole = (card + sides + b"END".ljust(80)).ljust(2880)
    # 7000 bytes of pixels have three blocks.
    assert damage_of_fits(whole, 4 * 2880) == ""
    assert damage_of_fits(whole, 4 * 2880 - 1) == f"is cut short: {4 * 2880 - 1} of {4 * 2880} bytes"
    assert damage_of_fits(whole[1:], 2880) == "does not begin as a FITS file"
    for damaged in (whole.replace(b"NAXIS1", b"NAXIS9"), whole.replace(b"NAXIS2", b"N"), whole.replace(b"END", b"EN ")):
        assert damage_of_fits(damaged, 4 * 2880) == "has a damaged FITS header"
    # A header whose END is the last card of its block.
    full = (card + sides + b"".ljust(80) * 32 + b"END".ljust(80)).ljust(2880)
    assert len(full) == 2880
    assert damage_of_fits(full, 4 * 2880) == ""
    assert damage_of_fits(card + sides + b"".ljust(80) * 33 + b"END".ljust(80), 5 * 2880) == ""


# --- polynomials ------------------------------------------------------------------------------------------------------


def test_a_polynomial_is_fitted_exactly_to_its_own_values() -> None:
    exponents = _exponents(3)
    assert exponents == [(0, 0), (0, 1), (0, 2), (0, 3), (1, 0), (1, 1), (1, 2), (2, 0), (2, 1), (3, 0)]
    points = np.random.default_rng(1).uniform(-300, 400, (80, 2))
    x, y = points.T
    values = np.column_stack([2 + 3 * x - 1e-3 * x * y + 1e-6 * y**3, 5 - y + 2e-3 * x**2 - 3e-6 * x**2 * y])

    fit = _Polynomial.fit(points, values, exponents)

    expected = {(0, 0): (2, 5), (0, 1): (0, -1), (1, 0): (3, 0), (1, 1): (-1e-3, 0), (0, 3): (1e-6, 0)}
    expected |= {(2, 0): (0, 2e-3), (2, 1): (0, -3e-6)}
    for exponent, found in zip(exponents, fit.coefficients, strict=True):
        size = 400.0 ** sum(exponent)
        np.testing.assert_allclose(found * size, np.array(expected.get(exponent, (0, 0))) * size, rtol=0, atol=1e-8)
    np.testing.assert_allclose(fit(points[:3]), values[:3], rtol=1e-12)
    x_terms, y_terms = _matrices(3, {(1, 2): np.array([4.0, 5.0]), (3, 0): np.array([6.0, 7.0])})
    assert (x_terms[1, 2], x_terms[3, 0], y_terms[1, 2], y_terms[3, 0]) == (4, 6, 5, 7)
    assert (x_terms.shape, np.count_nonzero(x_terms), np.count_nonzero(y_terms)) == ((4, 4), 2, 2)


def test_a_grid_extends_beyond_the_image_by_a_hundredth_of_its_sides() -> None:
    scene: Any = SimpleNamespace(camera=SimpleNamespace(width_px=101, height_px=51))

    grid = _grid(scene, np.array([-1.0, 0.5, 1.0]))

    columns, rows = (50 + 51.51 * np.array([-1, 0.5, 1]), 25 + 26.01 * np.array([-1, 0.5, 1]))
    np.testing.assert_allclose(grid, [(x, y) for y in rows for x in columns], rtol=0, atol=1e-9)


# --- other formats ----------------------------------------------------------------------------------------------------


def test_files_of_every_format_hold_their_numbers_and_their_damage_is_named(tmp_path: Any) -> None:
    deep = (np.arange(35, dtype=np.uint16).reshape(5, 7) * 1801) % 4096
    colour = np.arange(105, dtype=np.uint8).reshape(5, 7, 3)
    path = tmp_path / "frame"
    for pixels, kind, suffix in (
        (deep.astype(np.uint8), "png", ".png"),
        (deep, "png16", ".png"),
        (colour, "png", ".png"),
        (deep, "tiff", ".tiff"),
        (colour, "tiff", ".tiff"),
    ):
        content = encode(pixels, kind)  # type: ignore[arg-type]
        found = decode(content, suffix)
        np.testing.assert_array_equal(found, pixels)
        assert found.dtype == (np.uint16 if kind in {"png16", "tiff"} else np.uint8)
        file = path.with_suffix(suffix)
        for damaged, message in (
            (content, ""),
            (b"", "is empty (0 bytes)"),
            (bytes(len(content)), "begins with zeros"),
            (b"x" + content, f"does not begin as a {'TIFF' if kind == 'tiff' else 'PNG'}"),
        ):
            file.write_bytes(damaged)
            assert find_damage(file) == message
        file.write_bytes(content[:-1])
        size = len(content) - 1
        if kind == "tiff":
            assert find_damage(file) == f"is cut short: {size} of {len(content)} bytes"
            file.write_bytes(content[:6])
            assert find_damage(file) == "has a damaged TIFF directory"
        else:
            assert find_damage(file) == f"is cut short or damaged: no IEND at the end of its {size} bytes"
    for kind, suffix in (("png16", ".png"), ("tiff", ".tiff")):
        shifted = encode(deep, kind, shift_bits=4)  # type: ignore[arg-type]
        assert shifted != encode(deep, kind)  # type: ignore[arg-type]
        np.testing.assert_array_equal(decode(shifted, suffix), deep)
    jpeg = encode(colour, "jpeg")
    assert jpeg == encode(colour, "jpeg", jpeg_quality=93)
    path.with_suffix(".jpg").write_bytes(jpeg[:-1])
    assert find_damage(path.with_suffix(".jpg")) == (
        f"is cut short or damaged: no EOI at the end of its {len(jpeg) - 1} bytes"
    )
    np.testing.assert_array_equal(decode(tiff(np.float32([[0.5, 2.5]])), ".tiff"), [[0.5, 2.5]])


def test_a_png_with_a_wrong_checksum_or_too_few_rows_is_damaged() -> None:
    content = encode(np.arange(35, dtype=np.uint8).reshape(5, 7), "png")
    flipped = bytearray(content)
    flipped[45] ^= 1
    with pytest.raises(ValueError, match="is damaged: a wrong checksum in its chunk at byte 33"):
        decode(bytes(flipped), ".png")
    assert re.match(rb"\x89PNG", content)
