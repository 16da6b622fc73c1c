"""Times, zones, places and orientations of EXIF by hand, each limit from both sides."""

import struct
from datetime import UTC, datetime, timedelta, timezone
from io import BytesIO
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest

from glstar.camera import photofile
from glstar.camera.photofile import (
    Exif,
    _exif_block,
    _fraction_s,
    _numbers,
    _site_deg,
    _zone_by_gps_s,
    decode_photo,
    exif_of,
    read_exif,
    zone_of,
)
from tests.support.exif import (
    DATE_TIME_ORIGINAL,
    EXPOSURE_TIME,
    GPS_DATE_STAMP,
    GPS_TIME_STAMP,
    OFFSET_TIME_ORIGINAL,
    SUB_SEC_TIME_ORIGINAL,
    jpeg_with_exif,
)


def png(pixels: np.ndarray) -> bytes:
    return cv2.imencode(".png", pixels)[1].tobytes()


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
