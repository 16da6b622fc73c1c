"""Parts of image files by hand: signatures, bits, turns and EXIF, each limit from both sides."""

import struct
from io import BytesIO

import cv2
import numpy as np
import pytest
import tifffile
from astropy.io import fits

from glstar.camera.photofile import (
    Exif,
    PhotoPixels,
    _aligned,
    _as_stored,
    _bilinear,
    _decoded_fits,
    _is_cut_off,
    _kind_of_raw,
    _white_dn_of_fits,
    decode_photo,
    has_image_signature,
    shift_bits,
    stated_shift_bits,
)
from tests.support.dng import dng

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


def test_the_content_of_a_photograph_has_no_notes_by_default() -> None:
    photo = PhotoPixels(LEVELS)
    assert (photo.white_dn, photo.notes, photo.exif) == (None, (), Exif())
    found = decode_photo(png(LEVELS))
    np.testing.assert_array_equal(found.pixels, LEVELS)
    assert (found.white_dn, found.notes) == (None, ())
