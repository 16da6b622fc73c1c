"""Tracks of strangers: fixes that are none, damaged elements, and unusual but valid files."""

import io
import re
import zipfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from glstar.errors import LogFormatError
from glstar.sky.place.timescale import parse_utc
from glstar.telemetry import open_flight, read_track
from tests.support.trackfiles import make_track

# tests/scripts/strange_flights.py makes thousands of others.
SEEDS = range(60)
FIRST_S = parse_utc("2024-03-10T11:00:00Z")


@pytest.mark.parametrize("seed", SEEDS)
def test_a_track_with_wrong_fixes_is_true_or_refused(tmp_path: Path, seed: int) -> None:
    case = make_track(tmp_path, seed)

    track = read_track(str(case.path)).track

    utc_s = np.linspace(case.first_s, case.last_s, 300)
    assert case.error_m(utc_s, *track.coordinates(utc_s)) < 5, case


def table(path: Path, first_s: float = FIRST_S, length_s: float = 20.0) -> Path:
    """Write a log without positions."""
    times_s = first_s + np.arange(0.0, length_s, 0.1)
    rows = "\n".join(f"{t:.3f},1,2,3" for t in times_s)
    path.write_text(f"utc_s,roll_deg,pitch_deg,yaw_deg\n{rows}\n", encoding="utf-8")
    return path


def b_records(kind: str, place: str, seconds: range) -> str:
    return "".join(f"B1100{second:02d}{place}{kind}0010000105\n" for second in seconds)


HOME, ZERO = "3455800S13836000E", "0000000N00000000E"


def test_the_place_of_a_receiver_without_a_fix_is_none(tmp_path: Path) -> None:
    (tmp_path / "track.igc").write_text(
        "AXXXABC FLIGHT:1\nHFDTE100324\n" + b_records("V", ZERO, range(10)) + b_records("A", HOME, range(10, 20))
    )

    flight = open_flight(table(tmp_path / "eve.csv"), position=str(tmp_path / "track.igc"))

    for utc_s in FIRST_S + np.array([0.0, 5.0, 9.5, 15.0]):
        site = flight.position.at(utc_s)
        np.testing.assert_allclose(
            np.rad2deg([site.latitude_rad, site.longitude_rad]), [-34.93, 138.6], rtol=0, atol=1e-6
        )
    assert any("10 without a 3D fix (V)" in note for note in flight.notes)


def gpx(points: list[tuple[float, float, float, float]]) -> str:
    """Return a track of seconds, latitude, longitude and height."""
    texts = "".join(
        f'<trkpt lat="{latitude}" lon="{longitude}"><ele>{height}</ele>'
        f"<time>2024-03-10T11:00:{second:02.0f}Z</time></trkpt>"
        for second, latitude, longitude, height in points
    )
    return (
        f'<?xml version="1.0"?><gpx xmlns="http://www.topografix.com/GPX/1/1"><trk><trkseg>{texts}</trkseg></trk></gpx>'
    )


@pytest.mark.parametrize(
    ("wrong", "reason"),
    [
        ((0.0, 0.0, 0.0), "1 at 0 N 0 E, beyond a pole or at an impossible height"),
        ((-34.93, 138.6, -20000.0), "1 at 0 N 0 E, beyond a pole or at an impossible height"),
        ((-34.93, 138.6, 60000.0), "1 too far from the others for an aircraft"),
        ((-34.83, 138.6, 100.0), "1 too far from the others for an aircraft"),
        ((48.1, 11.6, 100.0), "1 too far from the others for an aircraft"),
    ],
)
def test_a_wrong_fix_is_passed_over_and_counted(tmp_path: Path, wrong: tuple[float, ...], reason: str) -> None:
    points = [(float(k), -34.93, 138.6, 100.0) for k in range(20)]
    points[7] = (7.0, *wrong)
    (tmp_path / "track.gpx").write_text(gpx(points))

    found = read_track(str(tmp_path / "track.gpx"))

    latitude_rad, longitude_rad, height_m = found.track.coordinates(FIRST_S + np.linspace(0, 19, 100))
    np.testing.assert_allclose(np.rad2deg(latitude_rad), -34.93, rtol=0, atol=1e-9)
    np.testing.assert_allclose(np.rad2deg(longitude_rad), 138.6, rtol=0, atol=1e-9)
    np.testing.assert_allclose(height_m, 100, rtol=0, atol=1e-6)
    assert found.source == "track.gpx, GPX, 19 fixes"
    assert found.notes == (f"of the track track.gpx were passed over: {reason}",)


@pytest.mark.parametrize(
    "write",
    [
        lambda text: text.encode("utf-16"),
        lambda text: text.replace('"1.0"?', '"1.0" encoding="UTF-16"?').encode("utf-16-le"),
        lambda text: text.replace("<?xml", "\ufeff<?xml").encode(),
        lambda text: text.replace('"1.0"?', '"1.0" encoding="ISO-8859-1"?').encode("latin-1"),
        lambda text: re.sub(r"<(/?)(?=[a-z])", r"<\1g:", text).replace("xmlns", "xmlns:g").encode(),
        lambda text: text.replace("<gpx", f"<!-- {'x' * 9000} -->\n<gpx").encode(),
        lambda text: text.replace("<time>", "<time>\n ").replace("Z</time>", ".000z\n</time>").encode(),
        # The recorder lost its power.
        lambda text: text.encode()[:-45],
        lambda text: text.replace('lat="-34.93"', 'lat="?"', 1).encode(),
        lambda text: text.replace("2024-03-10T11:00:03Z", "soon").encode(),
        lambda text: text.replace("<ele>100.0</ele>", "", 3).encode(),
    ],
)  # fmt: skip
def test_unusual_and_damaged_gpx_files_are_read(tmp_path: Path, write: Callable[[str], bytes]) -> None:
    text = gpx([(float(k), -34.93, 138.6, 100.0) for k in range(20)])
    (tmp_path / "track.gpx").write_bytes(write(text))

    found = read_track(str(tmp_path / "track.gpx"))

    assert found.track.utc_s.size >= 18
    np.testing.assert_allclose(found.track.utc_s % 1, 0, rtol=0, atol=1e-6)
    np.testing.assert_allclose(np.rad2deg(found.track.latitude_rad), -34.93, rtol=0, atol=1e-9)
    np.testing.assert_allclose(found.track.height_m, 100, rtol=0, atol=1e-9)


def test_the_end_of_a_day_is_the_next_midnight(tmp_path: Path) -> None:
    text = gpx([(0.0, -34.93, 138.6, 100.0), (1.0, -34.93, 138.6, 100.0)])
    text = text.replace("2024-03-10T11:00:00Z", "2024-03-10T23:59:59Z").replace(
        "2024-03-10T11:00:01", "2024-03-10T24:00:00"
    )
    (tmp_path / "track.gpx").write_text(text)

    np.testing.assert_allclose(
        read_track(str(tmp_path / "track.gpx")).track.utc_s,
        [parse_utc("2024-03-10T23:59:59Z"), parse_utc("2024-03-11T00:00:00Z")],
        rtol=0,
        atol=1e-6,
    )


@pytest.mark.parametrize(
    "header",
    [
        "HFDTE100324",
        "HFDTEDATE:100324,01",
        "HFDTEDATE100324",
        "HFDTE 100324",
        "HFDTE DATE: 10 03 24",
        "HPDTE100324",
        "hfdte100324",
    ],
)
def test_dates_of_igc_files_have_many_forms(tmp_path: Path, header: str) -> None:
    (tmp_path / "track.igc").write_text(f"AXXXABC FLIGHT:1\n{header}\n" + b_records("A", HOME, range(20)) + "B1100")

    found = read_track(str(tmp_path / "track.igc"))

    np.testing.assert_allclose(found.track.utc_s, FIRST_S + np.arange(20), rtol=0, atol=1e-6)
    assert found.notes == ("of the track track.igc were passed over: 1 unreadable B records",)


def test_fractions_of_seconds_of_igc_files_are_read(tmp_path: Path) -> None:
    records = "".join(f"B110000{HOME}A0010000105{fraction}\n" for fraction in "02468")
    (tmp_path / "track.igc").write_text(f"AXXXABC\nHFDTE100324\nI013636TDS\n{records}")

    np.testing.assert_allclose(
        read_track(str(tmp_path / "track.igc")).track.utc_s, FIRST_S + np.arange(0, 1, 0.2), rtol=0, atol=1e-6
    )


def kml_track(mode: str, positions: list[str]) -> str:
    whens = "".join(f"<when>2024-03-10T11:00:{k:02d}Z</when>" for k in range(len(positions)))
    coords = "".join(f"<gx:coord>{position}</gx:coord>" for position in positions)
    return (
        '<?xml version="1.0"?><kml xmlns="http://www.opengis.net/kml/2.2" xmlns:gx="http://www.google.com/kml/ext/2.2">'
        f"<Placemark><gx:Track>{mode}{whens}{coords}</gx:Track></Placemark></kml>"
    )


def test_an_empty_element_of_kml_is_skipped_and_counted(tmp_path: Path) -> None:
    (tmp_path / "track.kml").write_text(kml_track("", ["138.6 -34.93 100"] * 9 + [""] + ["138.6 -34.93 100"] * 10))

    found = read_track(str(tmp_path / "track.kml"))

    np.testing.assert_allclose(found.track.utc_s, FIRST_S + np.delete(np.arange(20), 9), rtol=0, atol=1e-6)
    assert found.notes == ("of the track track.kml were passed over: 1 without a readable place or time",)


def test_a_track_within_another_has_its_mode_of_heights(tmp_path: Path) -> None:
    """A gx:MultiTrack states the mode for all, and a track may state its own."""
    text = kml_track("", ["138.6 -34.93 100"] * 20).replace("<gx:Track>", "<gx:MultiTrack>MODE<gx:Track>OWN")
    text = text.replace("</gx:Track>", "</gx:Track></gx:MultiTrack>")
    relative, absolute = (f"<altitudeMode>{mode}</altitudeMode>" for mode in ("relativeToGround", "absolute"))
    for mode, own, height_m in ((relative, "", 0.0), (absolute, "", 100.0), (relative, absolute, 100.0)):
        (tmp_path / "track.kml").write_text(text.replace("MODE", mode).replace("OWN", own))
        np.testing.assert_allclose(read_track(str(tmp_path / "track.kml")).track.height_m, height_m, rtol=0, atol=1e-9)


@pytest.mark.parametrize(
    ("mode", "height_m"),
    [
        ("", 100),
        ("<altitudeMode>absolute</altitudeMode>", 100),
        ("<altitudeMode>relativeToGround</altitudeMode>", 0),
        ("<gx:altitudeMode>relativeToSeaFloor</gx:altitudeMode>", 0),
        ("<altitudeMode>clampToGround</altitudeMode>", 0),
    ],
)
def test_heights_above_ground_are_not_above_sea_level(tmp_path: Path, mode: str, height_m: float) -> None:
    (tmp_path / "track.kml").write_text(kml_track(mode, ["138.6 -34.93 100"] * 20))

    found = read_track(str(tmp_path / "track.kml"))

    np.testing.assert_allclose(found.track.height_m, height_m, rtol=0, atol=1e-9)
    assert any("has no heights above sea level: 0 m is taken" in note for note in found.notes) == (height_m == 0)


def sentence(body: str, *, checksum: bool = True) -> str:
    total = 0
    for byte in body.encode():
        total ^= byte
    return f"${body}*{total:02X}" if checksum else f"${body}"


def gga(time: str, height: float = 100.0, place: str = "3455.8000,S,13836.0000,E", quality: int = 1) -> str:
    return f"GPGGA,{time},{place},{quality},10,0.9,{height},M,-3.2,M,,"


def rmc(time: str, date: str = "100324", place: str = "3455.8000,S,13836.0000,E", state: str = "A") -> str:
    return f"GPRMC,{time},{state},{place},0.0,0.0,{date},,,A"


def nmea_of(path: Path, bodies: list[str], *, checksum: bool = True) -> Path:
    path.write_text("".join(f"{sentence(body, checksum=checksum)}\r\n" for body in bodies))
    return path


SECONDS = [f"1100{k:02d}.00" for k in range(20)]


def test_the_height_of_nmea_is_of_the_same_day(tmp_path: Path) -> None:
    bodies = [
        body
        for date, height in (("090324", 900.0), ("100324", 100.0), ("110324", 1900.0))
        for second in SECONDS
        for body in (gga(second, height), rmc(second, date))
    ]

    found = read_track(str(nmea_of(tmp_path / "track.nmea", bodies)))

    _, _, height_m = found.track.coordinates(FIRST_S + np.arange(20))
    np.testing.assert_allclose(height_m, 96.8, rtol=0, atol=1e-6)


def test_dates_of_nmea_whose_week_has_rolled_over_are_corrected(tmp_path: Path) -> None:
    # 1024 weeks before 2024-03-10; the first sentences still have the receiver's date after power-on.
    bodies = [body for second in SECONDS for body in (gga(second), rmc(second, "250704"))]
    path = nmea_of(tmp_path / "track.nmea", [rmc("110000.00", "060180"), *bodies])

    found = read_track(str(path))

    np.testing.assert_allclose(found.fix_utc_s, FIRST_S + np.arange(20), rtol=0, atol=1e-6)
    assert found.source == "track.nmea, NMEA with dates 1024 weeks later, 20 fixes"
    assert "dates before 2010: the week of its receiver has rolled over" in found.notes[-1]


@pytest.mark.parametrize("order", [(0, 1), (1, 0)])
@pytest.mark.parametrize("second", [rmc, lambda time: f"GPZDA,{time},10,03,2024,00,00"])
@pytest.mark.parametrize("before", ["", "\\s:rcv1,c:1710068400*5A\\", "2024-03-10 11:00:00.123 ", "[1710068400.2] "])
@pytest.mark.parametrize("checksum", [True, False])
def test_sentences_of_nmea_have_many_forms(
    tmp_path: Path, order: tuple[int, int], second: Callable[[str], str], before: str, checksum: bool
) -> None:
    bodies = [(gga(time), second(time))[k] for time in SECONDS for k in order]
    text = "".join(f"{before}{sentence(body, checksum=checksum)}\r\n" for body in bodies)
    (tmp_path / "track.nmea").write_text(text)

    found = read_track(str(tmp_path / "track.nmea"))

    np.testing.assert_allclose(found.track.utc_s, FIRST_S + np.arange(20), rtol=0, atol=1e-6)
    np.testing.assert_allclose(np.rad2deg(found.track.latitude_rad), -34.93, rtol=0, atol=1e-9)
    np.testing.assert_allclose(found.track.height_m, 96.8, rtol=0, atol=1e-6)


@pytest.mark.parametrize(
    "wrong",
    [
        rmc("110007.00", place="0000.0000,N,00000.0000,E", state="V"),
        rmc("110007.00", place=",,,"),
        gga("110007.00", place="0000.0000,N,00000.0000,E", quality=0),
        gga("110007.00", place="4800.0000,N,01136.0000,E", quality=6),
        rmc("110007.00", place="4800.0000,N,01136.0000,E"),
        rmc("110007.00", place="3455.8000,S,13836.0000,E", date=""),
        rmc("1100", place="4800.0000,N,01136.0000,E"),
        rmc("110007.00", place=f"{'9' * 400}.0,S,13836.0000,E"),
        rmc("110007.00", place=f"3455.8000,S,{'0' * 5000},E"),
    ],
)
def test_a_wrong_sentence_is_skipped(tmp_path: Path, wrong: str) -> None:
    bodies = [body for time in SECONDS for body in (gga(time), rmc(time))]
    bodies[14 if wrong.startswith("GPGGA") else 15] = wrong

    found = read_track(str(nmea_of(tmp_path / "track.nmea", bodies)))

    latitude_rad, _, height_m = found.track.coordinates(FIRST_S + np.linspace(0, 19, 100))
    np.testing.assert_allclose(np.rad2deg(latitude_rad), -34.93, rtol=0, atol=1e-9)
    np.testing.assert_allclose(height_m, 96.8, rtol=0, atol=1e-6)


def test_a_track_without_a_fix_near_the_flight_is_refused(tmp_path: Path) -> None:
    text = gpx([(float(k), -34.93, 138.6, 100.0) for k in range(20)])
    later = text.replace("2024-03-10T11", "2024-03-12T11")
    points = [part.partition("<trkseg>")[2].partition("</trkseg>")[0] for part in (text, later)]
    (tmp_path / "track.gpx").write_text(text.replace(points[0], "".join(points)))
    log = table(tmp_path / "flight.csv", FIRST_S + 86400)

    with pytest.raises(LogFormatError, match=r"track.gpx, GPX, 40 fixes has no fix during the flight .*for 48.0 h"):
        open_flight(log, position=str(tmp_path / "track.gpx"))


def test_fixes_of_other_days_are_no_gap_of_the_flight(tmp_path: Path) -> None:
    text = gpx([(float(k), -34.93, 138.6, 100.0) for k in range(20)])
    points = text.partition("<trkseg>")[2].partition("</trkseg>")[0]
    (tmp_path / "track.gpx").write_text(text.replace(points, points + points.replace("2024-03-10", "2024-03-12")))

    flight = open_flight(table(tmp_path / "flight.csv"), position=str(tmp_path / "track.gpx"))

    assert not any("has no fix for" in note for note in flight.notes)
    assert flight.position.at(FIRST_S + 10).height_m == pytest.approx(100, rel=0, abs=1e-6)


def test_heights_of_zero_between_others_are_none(tmp_path: Path) -> None:
    """A receiver without a fix in three dimensions states 0; an aircraft at the level of the sea does too."""
    points = [(float(k), -34.93, 138.6, 0.0 if 5 <= k < 15 else 500.0) for k in range(20)]
    (tmp_path / "track.gpx").write_text(gpx(points))
    beach = [(float(k), -34.93, 138.6, max(0.0, 12.0 - 3 * k)) for k in range(20)]
    (tmp_path / "beach.gpx").write_text(gpx(beach))

    found = read_track(str(tmp_path / "track.gpx"))
    beach_m = read_track(str(tmp_path / "beach.gpx")).track.height_m

    np.testing.assert_allclose(found.track.height_m, 500, rtol=0, atol=1e-6)
    assert found.notes == ("of the track track.gpx were passed over: 10 heights of 0 m that are none, between others",)
    np.testing.assert_allclose(beach_m, [height for *_, height in beach], rtol=0, atol=1e-6)


def test_a_track_of_two_places_is_refused(tmp_path: Path) -> None:
    points = [(float(k), *((-34.93, 138.6) if k < 10 else (52.0, 5.0)), 100.0) for k in range(20)]
    (tmp_path / "track.gpx").write_text(gpx(points))
    log = "utc_s,roll_deg,pitch_deg,yaw_deg,latitude_deg,longitude_deg\n"
    rows = "\n".join(f"{FIRST_S + k},1,2,3,{latitude},{longitude}" for k, latitude, longitude, _ in points)
    (tmp_path / "flight.csv").write_text(log + rows)

    places = r"of two places, 10 at -34.93, 138.60 deg and 10 at 52.00, 5.00 deg, and nothing says which is the flight"
    with pytest.raises(LogFormatError, match=places):
        read_track(str(tmp_path / "track.gpx"))
    with pytest.raises(LogFormatError, match=places):
        open_flight(tmp_path / "flight.csv")


def test_positions_of_a_log_that_no_aircraft_reaches_are_left_out(tmp_path: Path) -> None:
    times_s = FIRST_S + np.arange(100) * 0.1
    rows = "\n".join(f"{t:.3f},1,2,3,{48.1 if 20 <= k < 30 else -34.93},138.6" for k, t in enumerate(times_s))
    header = "utc_s,roll_deg,pitch_deg,yaw_deg,latitude_deg,longitude_deg\n"
    (tmp_path / "flight.csv").write_text(header + rows)

    flight = open_flight(tmp_path / "flight.csv")

    assert abs(np.rad2deg(flight.position.at(FIRST_S + 2.5).latitude_rad) + 34.93) < 1e-9
    assert any(note.startswith("10 of 100 positions are too far from the others") for note in flight.notes)


def zipped(name: str, content: bytes) -> bytes:
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w") as archive:
        archive.writestr(name, content)
    return buffer.getvalue()


def encrypted(archive: bytes) -> bytes:
    """Return an archive of one member whose flags say that it is encrypted."""
    flagged = bytearray(archive)
    for signature, flags in ((b"PK\x03\x04", 6), (b"PK\x01\x02", 8)):
        flagged[archive.index(signature) + flags] |= 1
    return bytes(flagged)


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("nested.kmz", zipped("doc.kml", zipped("doc.kml", b"<kml/>")), "is no track that glstar knows"),
        ("secret.kmz", encrypted(zipped("doc.kml", b"<kml/>")), "cannot be read as a track: .* is encrypted"),
        # Took eight minutes when each comment was searched to the end of the file.
        ("comments.gpx", b"<?xml version='1.0'?>" + b"<!--" * 100_000, "is no track that glstar knows"),
    ],
)
def test_archives_and_comments_without_end_are_refused(tmp_path: Path, name: str, content: bytes, message: str) -> None:
    (tmp_path / name).write_bytes(content)

    with pytest.raises(LogFormatError, match=message):
        read_track(str(tmp_path / name))
