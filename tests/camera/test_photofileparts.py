"""Parts of image files by hand: signatures, bits, turns and EXIF, each limit from both sides."""

import struct
from datetime import UTC, datetime, timedelta, timezone
from io import BytesIO
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
import tifffile
from astropy.io import fits

from glstar.camera import photofile
from glstar.camera.photofile import (
    Exif,
    PhotoPixels,
    _aligned,
    _as_stored,
    _bilinear,
    _decoded_fits,
    _exif_block,
    _fraction_s,
    _is_cut_off,
    _kind_of_raw,
    _numbers,
    _site_deg,
    _white_dn_of_fits,
    _zone_by_gps_s,
    decode_photo,
    exif_of,
    has_image_signature,
    read_exif,
    shift_bits,
    stated_shift_bits,
    zone_of,
)
from tests.support.dng import dng
from tests.support.exif import (
    DATE_TIME_ORIGINAL,
    EXPOSURE_TIME,
    GPS_DATE_STAMP,
    GPS_TIME_STAMP,
    OFFSET_TIME_ORIGINAL,
    SUB_SEC_TIME_ORIGINAL,
    jpeg_with_exif,
)

LEVELS = np.arange(40 * 60, dtype=np.uint16).reshape(40, 60)


def tiff(pixels: np.ndarray, **given: object) -> bytes:
    target = BytesIO()
    tifffile.imwrite(target, pixels, **given)
    return target.getvalue()


def png(pixels: np.ndarray) -> bytes:
    return cv2.imencode(".png", pixels)[1].tobytes()


@pytest.mark.parametrize(
    "start",
    [
        *(
            b"\x89PNG",
            b"\xff\xd8\xff",
            b"BM",
            b"GIF8",
            b"II*\0",
            b"MM\0*",
            b"II+\0",
            b"MM\0+",
            b"SIMPLE  =",
            b"P5",
            b"PF",
        ),
        *(b"RIFF\x10\0\0\0WEBP", b"\0\0\0\x18ftypheic", b"\0\0\0\x18ftypavif", b"\0\0\0\x18ftypmif1"),
        *(b"\0\0\0\x18ftypcrx ", b"\0\0\0\x0cjP  ", b"\x76\x2f\x31\x01", b"#?RGBE", b"\x59\xa6\x6a\x95"),
        *(b"FUJIFILMCCD-RAW", b"IIRO", b"FOVb", b"\0MRM"),
    ],
)
def test_an_image_is_known_by_its_first_bytes(start: bytes) -> None:
    assert has_image_signature(start + bytes(16))
    assert not has_image_signature(b"x" + start + bytes(16))


@pytest.mark.parametrize("start", [b"", b"RIFF\x10\0\0\0WAVE", b"\0\0\0\x18ftypisom", b"P8", b"P", b"II*\1", b"GIF7"])
def test_other_files_are_no_images(start: bytes) -> None:
    assert not has_image_signature(start + bytes(16))


def test_the_end_of_a_jpeg_follows_its_last_scan_or_ends_the_file() -> None:
    scan, end = b"\xff\xda", b"\xff\xd9"
    first = b"\xff\xd8" + scan + bytes(100) + end
    assert _is_cut_off(first + bytes(200) + scan + bytes(70))
    assert not _is_cut_off(first + bytes(70))
    # In the last 64 bytes the end counts, also before another scan.
    assert not _is_cut_off(first + scan + bytes(60))
    assert _is_cut_off(first + scan + bytes(61))
    assert not _is_cut_off(b"\xff\xd8" + bytes(100))


@pytest.mark.parametrize(
    ("full_scale", "shift"), [(1, 0), (255, 0), (256, 7), (1023, 6), (4095, 4), (4096, 3), (65535, 0)]
)
def test_numbers_of_more_than_eight_bits_fill_sixteen(full_scale: int, shift: int) -> None:
    assert shift_bits(full_scale) == shift


@pytest.mark.parametrize(
    ("largest", "shift"), [(0xFFF0, 4), (0xFFFE, 1), (0xFFFF, 0), (0x8000, 15), (0x0FFF, 0), (0xFF70, 0), (0, 0)]
)
def test_the_largest_value_of_a_tiff_is_a_run_of_ones_to_the_top(largest: int, shift: int) -> None:
    content = tiff(LEVELS, extratags=[(281, "H", 1, largest, True)])
    assert stated_shift_bits(content) == shift
    assert stated_shift_bits(tiff(LEVELS)) == 0
    assert stated_shift_bits(b"BM" + content) == 0


def test_a_tiff_that_states_its_shift_has_the_bits_of_the_sensor() -> None:
    content = tiff(LEVELS << 4, extratags=[(281, "H", 1, 0xFFF0, True)])
    photo = decode_photo(content)
    np.testing.assert_array_equal(photo.pixels, LEVELS)
    assert (photo.white_dn, photo.notes) == (4095, ())
    unshifted = decode_photo(tiff(LEVELS, extratags=[(281, "H", 1, 0xFFF0, True)]))
    np.testing.assert_array_equal(unshifted.pixels, LEVELS)
    assert unshifted.white_dn is None


@pytest.mark.parametrize(("shift", "bits"), [(8, 8), (6, 10), (4, 12), (2, 14)])
def test_empty_bits_prove_the_depth_of_the_converter(shift: int, bits: int) -> None:
    pixels = (LEVELS % 2**bits << shift).astype(np.uint16)
    pixels[0, 0] = (2**bits - 1) << shift
    photo = _aligned(pixels)
    np.testing.assert_array_equal(photo.pixels, pixels >> shift)
    assert (photo.white_dn, photo.notes) == (
        2**bits - 1,
        (f"its numbers are multiples of {2**shift}: they are taken as {bits} bits in the highest of 16",),
    )


def test_empty_bits_prove_nothing_for_few_levels_or_small_numbers() -> None:
    for levels, proven in ((8, True), (7, False)):
        pixels = (np.arange(200).reshape(10, 20) % levels + 4089).astype(np.uint16) << 4
        photo = _aligned(pixels)
        assert (photo.white_dn == 4095, photo.pixels is not pixels) == (proven, proven)
        assert bool(photo.notes) == proven
    # An odd shift proves the next even one: multiples of 8 are of 4.
    odd = (LEVELS.astype(np.uint16) << 3) + 40000
    assert _aligned(odd).white_dn == 16383
    assert _aligned((LEVELS << 1).astype(np.uint16)).white_dn is None
    for largest, taken in ((4096, True), (4080, False)):
        pixels = (np.arange(255, dtype=np.uint16) << 4).reshape(15, 17)
        pixels[0, 0] = largest
        photo = _aligned(pixels)
        assert (photo.white_dn is not None) == taken
        if not taken:
            assert photo.pixels is pixels
            assert photo.notes == ("its numbers are multiples of 16 below 4096: they are taken as they are",)
    eight = np.zeros((4, 5), np.uint8)
    assert _aligned(eight).pixels is eight
    assert _aligned(np.zeros((4, 5), np.uint16)).white_dn is None


def test_opacity_is_no_light() -> None:
    colours = np.random.default_rng(1).integers(0, 256, (12, 15, 4), dtype=np.uint8)
    photo = decode_photo(png(colours))
    np.testing.assert_array_equal(photo.pixels, colours[..., :3])
    grey = decode_photo(
        tiff(colours[..., :2], photometric="minisblack", planarconfig="contig", extrasamples=["unassalpha"])
    )
    np.testing.assert_array_equal(grey.pixels, colours[..., 0])
    # Red first in a TIFF becomes blue first; planes do, too.
    for planar in ("contig", "separate"):
        stored = colours[..., :3] if planar == "contig" else np.moveaxis(colours[..., :3], -1, 0)
        found = decode_photo(tiff(np.ascontiguousarray(stored), photometric="rgb", planarconfig=planar))
        np.testing.assert_array_equal(found.pixels, colours[..., 2::-1])


def test_numbers_of_other_types_are_read_where_they_are_allowed() -> None:
    content = tiff(np.linspace(0, 1, 200, dtype=np.float32).reshape(10, 20))
    with pytest.raises(ValueError, match="holds float32 in 2 axes; only grey or colour images of 8 or 16 bits"):
        decode_photo(content)
    assert decode_photo(content, floats=True).pixels.dtype == np.float32


@pytest.mark.parametrize(("samples", "is_read"), [(16, True), (17, False)])
def test_a_tiff_has_sixteen_samples_a_pixel_at_most(samples: int, is_read: bool) -> None:
    content = tiff(np.zeros((10, 20, samples), np.uint8), photometric="minisblack", planarconfig="contig")
    if is_read:
        assert decode_photo(content).pixels.shape[:2] == (10, 20)
    else:
        with pytest.raises(ValueError, match="has 17 samples a pixel; grey and colour images have 1 to 4"):
            decode_photo(content)


@pytest.mark.parametrize(
    ("pages", "expected"),
    [([(10, 20), (30, 40)], (30, 40)), ([(30, 40), (10, 20)], (30, 40)), ([(20, 60), (30, 40)], (20, 60))],
)
def test_the_largest_page_is_read_and_the_first_of_equals(pages: list, expected: tuple) -> None:
    target = BytesIO()
    with tifffile.TiffWriter(target) as writer:
        for number, shape in enumerate(pages):
            writer.write(np.full(shape, number + 1, np.uint8))
    photo = decode_photo(target.getvalue())
    assert photo.pixels.shape == expected
    assert photo.pixels[0, 0] == pages.index(expected) + 1


def fits_file(pixels: np.ndarray, **header: object) -> bytes:
    unit = fits.PrimaryHDU(pixels)
    unit.header.update(header)
    target = BytesIO()
    unit.writeto(target)
    return target.getvalue()


@pytest.mark.parametrize(
    ("scale", "white_dn"),
    [
        (b"0.0625", 4095),
        (b"0.5", 32767),
        (b"0.0078125", 511),
        (b"0.00390625", None),
        (b"0.3", None),
        (b"1.0", None),
        (b"0.0", None),
    ],
)
def test_a_scale_below_one_of_fits_states_the_shift(scale: bytes, white_dn: int | None) -> None:
    assert _white_dn_of_fits(b"BSCALE  =   " + scale + b" / x") == white_dn
    assert _white_dn_of_fits(b"BITPIX  =   16") is None


def test_fits_holds_whole_numbers_of_sixteen_bits() -> None:
    photo = _decoded_fits(fits_file(LEVELS[::-1] + np.uint16(60000)))
    assert (photo.pixels.dtype, photo.pixels.max()) == (np.uint16, 62399)
    for wrong, said in ((-1.0, "numbers from -1 to 2399"), (65536.0, "from 1 to 65536"), (0.5, "from 0.5 to 2399")):
        pixels = LEVELS.astype(np.float32)
        pixels[0, 0] = wrong
        with pytest.raises(ValueError, match=f"{said}; glstar needs a camera's own, whole and from 0 to 65535"):
            _decoded_fits(fits_file(pixels))
    edge = LEVELS.astype(np.float32)
    edge[0, 0] = 65535.0
    assert _decoded_fits(fits_file(edge)).pixels.max() == 65535


@pytest.mark.parametrize("pattern", ["RGGB", "BGGR", "GRBG", "GBRG"])
def test_a_mosaic_has_its_colours_at_the_letters_of_its_pattern(pattern: str) -> None:
    colours = {"R": 900, "G": 500, "B": 100}
    rows, columns = np.indices((12, 14))
    mosaic = np.zeros((12, 14), np.uint16)
    for k, letter in enumerate(pattern):
        mosaic[(rows % 2 == k // 2) & (columns % 2 == k % 2)] = colours[letter]
    inside = _bilinear(mosaic, pattern, "DNG")[2:-2, 2:-2]
    assert inside.reshape(-1, 3).tolist() == [[100, 500, 900]] * inside[..., 0].size
    with pytest.raises(ValueError, match="is a DNG with the mosaic RGBG; glstar reads RGGB, BGGR, GRBG and GBRG"):
        _bilinear(mosaic, "RGBG", "DNG")


@pytest.mark.parametrize(
    ("boxes", "turn"),
    [
        ([], lambda p: p),
        ([(b"irot", 1)], lambda p: np.rot90(p, -1)),
        ([(b"irot", 3)], lambda p: np.rot90(p, -3)),
        ([(b"imir", 0)], lambda p: p[::-1]),
        ([(b"imir", 1)], lambda p: p[:, ::-1]),
        ([(b"irot", 1), (b"imir", 0)], lambda p: np.rot90(p[::-1], -1)),
        ([(b"irot", 1), (b"irot", 1)], lambda p: np.rot90(p, -1)),
    ],
)
def test_a_heic_is_turned_back(boxes: list, turn) -> None:
    """irot turns against the clock by quarters; imir mirrors rows or columns; the last box acts last."""
    pixels = np.arange(12).reshape(3, 4)
    content = b"ftyp" + b"".join(b"\0\0\0\x09" + kind + bytes([value]) for kind, value in boxes)
    np.testing.assert_array_equal(_as_stored(pixels, content), turn(pixels))
    with pytest.raises(ValueError, match="with parts that are turned differently; export it as JPEG"):
        _as_stored(pixels, content + b"\0\0\0\x09irot\x02\0\0\0\x09irot\x01")


def directory(*tags: tuple[int, int]) -> bytes:
    """Return a TIFF of one directory of short numbers."""
    listed = struct.pack("<H", len(tags)) + b"".join(struct.pack("<HHIHH", tag, 3, 1, value, 0) for tag, value in tags)
    return b"II*\0" + struct.pack("<I", 8) + listed + bytes(4)


@pytest.mark.parametrize(
    ("content", "kind"),
    [
        (directory((256, 4), (259, 1)), ""),
        (directory((256, 4), (259, 34713)), "raw file of a camera"),
        (directory((256, 4), (259, 32767)), "raw file of a camera"),
        (directory((256, 4), (259, 32770)), "raw file of a camera"),
        (directory((256, 4), (259, 65535)), "raw file of a camera"),
        (directory((256, 4), (259, 34712)), ""),
        (directory((256, 4), (50706, 1)), "DNG"),
        (directory((256, 4), (262, 32803)), ""),  # the mosaic of a scientific camera
        (b"II*\0\x10\0\0\0CR\x02\0" + bytes(40), "raw file of a camera"),
        (b"IIRO" + bytes(40), "raw file of a camera"),
        (b"\0\0\0\x18ftypcrx " + bytes(40), "raw file of a camera"),
        (b"\x89PNG" + bytes(40), ""),
    ],
)  # fmt: skip
def test_raw_files_are_known_by_their_tags(content: bytes, kind: str) -> None:
    assert _kind_of_raw(content) == kind


def test_a_mosaic_below_a_thumbnail_is_raw() -> None:
    target = BytesIO()
    with tifffile.TiffWriter(target) as writer:
        writer.write(np.zeros((12, 16), np.uint8))
        writer.write(LEVELS, photometric=32803)
    assert _kind_of_raw(target.getvalue()) == "raw file of a camera"
    linear = bytearray(target.getvalue())
    at = linear.rindex(struct.pack("<HHIH", 262, 3, 1, 32803))
    linear[at + 8 : at + 10] = struct.pack("<H", 34892)
    assert _kind_of_raw(bytes(linear)) == "raw file of a camera"
    linear[at + 8 : at + 10] = struct.pack("<H", 34891)
    assert _kind_of_raw(bytes(linear)) == ""


@pytest.mark.parametrize("bits", [10, 12, 14])
def test_a_tiff_that_states_packed_bits_and_holds_sixteen_is_refused(bits: int) -> None:
    content = bytearray(tiff(LEVELS))
    at = content.index(struct.pack("<HHIH", 258, 3, 1, 16))
    content[at + 8 : at + 10] = struct.pack("<H", bits)
    with pytest.raises(ValueError, match=f"states {bits} bits a sample and holds 16; write it with BitsPerSample = 16"):
        decode_photo(bytes(content))


def test_white_is_zero_of_eight_bits_is_inverted() -> None:
    pixels = (LEVELS % 256).astype(np.uint8)
    np.testing.assert_array_equal(decode_photo(tiff(255 - pixels, photometric="miniswhite")).pixels, pixels)


def test_the_mosaic_of_a_dng_becomes_colours_unless_it_is_to_stay() -> None:
    content = dng(LEVELS + np.uint16(100))
    assert decode_photo(content).pixels.ndim == 3
    np.testing.assert_array_equal(decode_photo(content, demosaiced=False).pixels, LEVELS + 100)


# --- EXIF -------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("text", "hours"),
    [("Z", 0), ("+09:30", 9.5), ("+0930", 9.5), ("-03:45", -3.75), (" -1100 ", -11), ("+00:00", 0)],
)
def test_zones_are_read_with_their_sign(text: str, hours: float) -> None:
    assert zone_of(text) == (UTC if text == "Z" else timezone(timedelta(hours=hours)))


@pytest.mark.parametrize("text", ["", "z", "09:30", "+9:30", "+09:3", "+09-30", "+09:30Z", "UTC"])
def test_what_is_no_zone_is_refused(text: str) -> None:
    with pytest.raises(ValueError, match=r".*"):
        zone_of(text)


def test_digits_are_fractions_of_a_second() -> None:
    assert [_fraction_s(text) for text in ("5", "25", "007", "", "x", "-1", "1.5")] == [0.5, 0.25, 0.007, 0, 0, 0, 0]


def tag(*values: object) -> SimpleNamespace:
    return SimpleNamespace(values=values)


def test_numbers_of_a_tag_are_those_of_exif_image_and_gps() -> None:
    tags = {
        "EXIF A": tag(1, 2.5),
        "Image A": tag(9),
        "Image B": tag(3),
        "GPS C": tag(4, 5),
        "EXIF D": tag("x"),
        "GPS D": tag(7),
    }
    assert [_numbers(tags, name) for name in "ABCDE"] == [(1.0, 2.5), (3.0,), (4.0, 5.0), (), ()]


LOCAL = datetime(2024, 3, 10, 21, 30, 0, tzinfo=UTC)


def gps_time(hour: float, minute: float, second: float, date: str = "2024:03:10") -> dict:
    return {"GPS GPSTimeStamp": tag(hour, minute, second), "GPS GPSDate": date}


@pytest.mark.parametrize(
    ("tags", "zone_s"),
    [
        (gps_time(11, 0, 0), 37800),
        (gps_time(11, 1, 59), 37800),  # a clock may be two minutes off,
        (gps_time(11, 2, 0), 37800),
        (gps_time(11, 2, 1), None),  # and not more
        (gps_time(10, 58, 1), 37800),
        (gps_time(10, 57, 59), None),
        (gps_time(10, 45, 30), 38700),
        (gps_time(23, 30, 0), -7200),
        (gps_time(7, 30, 0), 50400),  # 14 hours are the largest zone
        (gps_time(7, 15, 0), None),
        (gps_time(11, 30, 0, "2024:03:11"), -50400),
        (gps_time(11, 45, 0, "2024:03:11"), None),
        (gps_time(11, 0, 0, " 2024:03:10\0"), 37800),
        (gps_time(11, 0, 0, "2024-03-10"), None),
        ({"GPS GPSTimeStamp": tag(11, 0), "GPS GPSDate": "2024:03:10"}, None),
        ({}, None),
    ],
)
def test_a_zone_is_the_clock_minus_the_gps_time_in_quarters(tags: dict, zone_s: int | None) -> None:
    assert _zone_by_gps_s(tags, LOCAL) == zone_s


def place(latitude: tuple, north: str, longitude: tuple, east: str, **more: str) -> dict:
    return {
        "GPS GPSLatitude": tag(*latitude),
        "GPS GPSLatitudeRef": north,
        "GPS GPSLongitude": tag(*longitude),
        "GPS GPSLongitudeRef": east,
        **{f"GPS {name}": value for name, value in more.items()},
    }


@pytest.mark.parametrize(
    ("tags", "site_deg"),
    [
        (place((34, 30, 36), "S", (138, 15, 18), "E"), (-34.51, 138.255)),
        (place((34, 30, 36), "North", (138, 15, 18), " w\0"), (34.51, -138.255)),
        (place((34, 30, 36), "S", (138, 15, 18), "E", GPSStatus="A"), (-34.51, 138.255)),
        (place((34, 30, 36), "S", (138, 15, 18), "E", GPSStatus="V"), None),
        (place((34, 30, 36), "E", (138, 15, 18), "E"), None),
        (place((34, 30, 36), "S", (138, 15, 18), "S"), None),
        (place((34, 30), "S", (138, 15, 18), "E"), None),
        (place((90, 0, 0), "S", (180, 0, 0), "E"), (-90.0, 180.0)),
        (place((90, 0, 1), "S", (138, 15, 18), "E"), None),
        (place((34, 30, 36), "S", (180, 0, 1), "E"), None),
        (place((-1, 0, 0), "S", (138, 15, 18), "E"), None),
        (place((0, 0, 0), "N", (0, 0, 0), "E"), None),
        (place((0, 0, 0), "N", (5, 0, 0), "E"), (0.0, 5.0)),
        ({}, None),
    ],
)
def test_a_place_is_read_with_its_hemispheres(tags: dict, site_deg: tuple | None) -> None:
    assert _site_deg(tags) == (None if site_deg is None else pytest.approx(site_deg, rel=1e-12))


UTC_S = LOCAL.timestamp()


@pytest.mark.parametrize(
    ("given", "gps", "expected"),
    [
        ({}, None, Exif(UTC_S)),
        ({SUB_SEC_TIME_ORIGINAL: "25"}, None, Exif(UTC_S + 0.25, None, 0.01)),
        ({SUB_SEC_TIME_ORIGINAL: "000"}, None, Exif(UTC_S)),
        ({SUB_SEC_TIME_ORIGINAL: "500"}, None, Exif(UTC_S + 0.5, None, 0.001)),
        ({OFFSET_TIME_ORIGINAL: "+10:30", SUB_SEC_TIME_ORIGINAL: "5"}, None, Exif(UTC_S - 37799.5, "zone +10:30", 0.1)),
        ({OFFSET_TIME_ORIGINAL: "x"}, None, Exif(UTC_S)),
        (
            {},
            {GPS_TIME_STAMP: [(11, 1), (0, 1), (30, 1)], GPS_DATE_STAMP: "2024:03:10"},
            Exif(UTC_S - 37800, "zone +10.5 h by its GPS time"),
        ),
        ({EXPOSURE_TIME: [(1, 8)]}, None, Exif(UTC_S, exposure_s=0.125)),
        ({EXPOSURE_TIME: [(0, 8)]}, None, Exif(UTC_S)),
        ({EXPOSURE_TIME: [(1, 8), (1, 4)]}, None, Exif(UTC_S)),
        ({EXPOSURE_TIME: [(1, 0)]}, None, Exif(UTC_S)),
    ],
)
def test_the_time_of_an_image_is_that_of_its_exif(given: dict, gps: dict | None, expected: Exif) -> None:
    content = jpeg_with_exif(np.zeros((16, 16), np.uint8), {DATE_TIME_ORIGINAL: "2024:03:10 21:30:00", **given}, gps)
    assert exif_of(BytesIO(content)) == expected
    assert decode_photo(content).exif == expected


def test_an_image_without_a_time_keeps_its_exposure(tmp_path: Path) -> None:
    content = jpeg_with_exif(np.zeros((16, 16), np.uint8), {EXPOSURE_TIME: [(1, 8)]})
    assert exif_of(BytesIO(content)) == Exif(exposure_s=0.125)
    assert read_exif(tmp_path / "none.jpg") == Exif() == Exif(None, None, 1.0, None, None, 1)


@pytest.mark.parametrize(("value", "orientation"), [(0, 1), (1, 1), (8, 8), (9, 1)])
def test_an_orientation_is_from_1_to_8(monkeypatch: pytest.MonkeyPatch, value: int, orientation: int) -> None:
    monkeypatch.setattr(photofile, "_exif_tags", lambda _: {"Image Orientation": tag(value)})
    assert exif_of(BytesIO()).orientation == orientation
    photo = decode_photo(png(np.zeros((8, 9), np.uint8)))
    assert bool(photo.notes) == (orientation > 1)
    monkeypatch.setattr(photofile, "_exif_tags", lambda _: {"Image Orientation": tag(3, 4)})
    assert exif_of(BytesIO()).orientation == 1


def test_the_exif_of_a_webp_is_in_a_chunk_of_its_own() -> None:
    """Chunks have even lengths in the file."""
    body = b"Exif\0\0II*\0rest"

    def webp(*chunks: tuple[bytes, bytes]) -> BytesIO:
        parts = b"".join(kind + struct.pack("<I", len(data)) + data + bytes(len(data) % 2) for kind, data in chunks)
        return BytesIO(b"RIFF" + struct.pack("<I", len(parts) + 4) + b"WEBP" + parts)

    assert _exif_block(webp((b"VP8 ", b"abc"), (b"ALPH", b"abcd"), (b"EXIF", body))) == b"II*\0rest"
    assert _exif_block(webp((b"EXIF", b"MM\0*rest"))) == b"MM\0*rest"
    assert _exif_block(webp((b"VP8 ", b"abc"))) == b""
    assert _exif_block(BytesIO(b"\xff\xd8\xff" + bytes(20))) is None
    avif = b"\0\0\0\x18ftypavif" + bytes(9) + b"Exif\0\0xx" + b"Exif\0\0MM\0*rest"
    assert _exif_block(BytesIO(avif)) == b"MM\0*rest"
    assert _exif_block(BytesIO(avif[:30])) == b""


def test_the_content_of_a_photograph_has_no_notes_by_default() -> None:
    photo = PhotoPixels(LEVELS)
    assert (photo.white_dn, photo.notes, photo.exif) == (None, (), Exif())
    found = decode_photo(png(LEVELS))
    np.testing.assert_array_equal(found.pixels, LEVELS)
    assert (found.white_dn, found.notes) == (None, ())
