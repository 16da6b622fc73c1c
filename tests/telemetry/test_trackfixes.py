"""Fixes of tracks, element by element: hand-made sentences, records and elements with known times and places."""

import zipfile
from collections import Counter
from functools import reduce
from operator import xor
from pathlib import Path

import numpy as np
import pytest

from glstar.errors import LogFormatError
from glstar.sky.place.timescale import parse_utc
from glstar.telemetry import tracks
from glstar.telemetry.tracks import read_track

nan = np.nan
DAY_S = 86400.0
MIDNIGHT_S = parse_utc("2024-03-10T00:00:00Z")
ELEVEN_S = MIDNIGHT_S + 11 * 3600


def fixes(parse: object, text: str) -> tuple[list[list[float]], dict[str, int]]:
    """Return the fixes in a text, and what is passed over."""
    passed: Counter[str] = Counter()
    found = [list(fix) for fix in parse(text, passed)]
    return found, {reason: count for reason, count in passed.items() if count}


def same(found: list[list[float]], expected: list[tuple[float, ...]]) -> bool:
    return len(found) == len(expected) and np.allclose(found, expected, rtol=0, atol=1e-9, equal_nan=True)


# --- NMEA -----------------------------------------------------------------------------------------------------------
def sentence(body: str) -> str:
    return f"${body}*{reduce(xor, body.encode(), 0):02X}"


def rmc(clock: str = "110002.50", state: str = "A", date: str = "100324", *more: str, place: str = "") -> str:
    return ",".join(["GPRMC", clock, state, place or "3455.5000,S,13836.2500,E", "12.5", "90.5", date, *more])


def gga(
    clock: str = "110002.50", quality: str = "1", height: str = "50.5", geoid: str = "-3.25", place: str = ""
) -> str:
    return f"GPGGA,{clock},{place or '3456.0000,S,13837.0000,E'},{quality},9,0.8,{height},M,{geoid},M,,"


def nmea(*bodies: str) -> tuple[list[list[float]], dict[str, int]]:
    return fixes(tracks._nmea, "\r\n".join(map(sentence, bodies)))


AT = (ELEVEN_S + 2.5, -(34 + 55.5 / 60), 138 + 36.25 / 60)


def test_the_place_of_rmc_has_the_height_of_gga() -> None:
    assert same(nmea(rmc())[0], [(*AT, nan)])
    assert same(nmea(rmc(), gga())[0], [(*AT, 47.25)])
    assert same(nmea(gga(), rmc())[0], [(*AT, 47.25)])
    of_gga = (ELEVEN_S + 2.5, -(34 + 56.0 / 60), 138 + 37.0 / 60, 50.5)
    zda = "GPZDA,110002.50,10,03,2024,00,00"
    assert same(nmea(zda, gga(geoid=""))[0], [of_gga])
    assert same(nmea(gga(height=""), zda)[0], [(*of_gga[:3], nan)])
    assert same(nmea(gga(height="x"), zda)[0], [(*of_gga[:3], nan)])
    assert same(nmea(rmc("110002.5004"), gga("110002.4996"))[0], [(*AT, 47.25)])
    assert nmea(zda) == ([], {})
    assert same(nmea("GPZDA,110002.50,10,03,2024", gga(geoid=""))[0], [of_gga])


def test_angles_of_nmea_have_degrees_and_minutes() -> None:
    assert tracks._nmea_angle("3455.5", "N") == pytest.approx(34 + 55.5 / 60, rel=1e-15)
    assert tracks._nmea_angle("13836.25", "W") == pytest.approx(-138 - 36.25 / 60, rel=1e-15)
    assert tracks._nmea_angle("03836", "E") == pytest.approx(38.6, rel=1e-15)
    assert tracks._nmea_angle("730.", "S") == pytest.approx(-7.5, rel=1e-15)
    for text, side in (("3455.5", "n"), ("3455.5", ""), ("55.5", "N"), ("123455.5", "N"), ("-3455.5", "N"), ("", "N")):
        with pytest.raises(ValueError, match="is no angle"):
            tracks._nmea_angle(text, side)


def test_a_time_of_day_has_six_digits() -> None:
    assert tracks._time_of_day_s("123456.75") == 12 * 3600 + 34 * 60 + 56.75
    assert tracks._time_of_day_s("010203") == 3723.0
    for text in ("12345", "1234567", "", "12345x", "123456.7x"):
        with pytest.raises(ValueError, match="is no time"):
            tracks._time_of_day_s(text)


@pytest.mark.parametrize(
    ("body", "is_fix"),
    [
        (rmc(state="V"), False),
        (rmc(state=""), False),
        (rmc("110002.50", "A", "100324", "", "", "N"), False),
        (rmc("110002.50", "A", "100324", "", "", "E"), False),
        (rmc("110002.50", "A", "100324", "", "", "A"), True),
        (rmc("110002.50", "A", "100324", "", "E"), True),  # of the magnetic variation
    ],
)
def test_a_sentence_without_a_fix_makes_its_time_invalid(body: str, is_fix: bool) -> None:
    found, passed = nmea(body, rmc("110003.50"))
    later = (AT[0] + 1, *AT[1:], nan)
    assert same(found, [(*AT, nan), later] if is_fix else [later])
    assert passed == ({} if is_fix else {"times without a fix": 1})


@pytest.mark.parametrize("quality", ["0", "6", "", "1", "2", "5"])
def test_the_quality_of_gga_makes_its_time_invalid(quality: str) -> None:
    found, passed = nmea(rmc(), gga(quality=quality))
    is_fix = quality in {"1", "2", "5"}
    assert same(found, [(*AT, 47.25)] if is_fix else [])
    assert passed == ({} if is_fix else {"times without a fix": 1})


def test_sentences_without_place_time_or_date_are_counted() -> None:
    assert nmea(rmc(), rmc("110004.50", place="3455.5,S,,E"))[1] == {"sentences without a readable place": 1}
    assert nmea(rmc(), rmc("1100"), gga("x"))[1] == {"sentences without a time": 2}
    assert nmea(rmc(), rmc(date="102124"))[1] == {"sentences without a time": 1}
    assert nmea(gga(), gga("110003.50")) == ([], {"sentences without a date": 2})
    assert nmea(rmc(), "GPRMC,110003.50,A,3455.5,S", "GPGSV,1", "GPVTG,1,2")[1] == {}
    assert nmea("GPZDA,110002.50,10,03,,00,00", gga())[1] == {"sentences without a date": 2}


def test_a_sentence_has_the_date_of_the_nearer_one_beside_it() -> None:
    before, after = rmc("235958", date="100324"), rmc("000002", date="110324")
    for clock, day in (("235959", 0), ("000001", 1), ("115957", 1), ("120003", 0)):
        found, _ = nmea(before, gga(clock), after)
        at_s = MIDNIGHT_S + DAY_S * day + tracks._time_of_day_s(clock)
        assert any(fix[0] == at_s for fix in found), clock
    # Before the first date and after the last one there is only one.
    assert nmea(gga("000001"), before)[0][0][0] == MIDNIGHT_S + DAY_S + 1
    assert nmea(before, gga("000001"))[0][1][0] == MIDNIGHT_S + DAY_S + 1
    assert nmea(after, gga("235959"))[0][1][0] == MIDNIGHT_S + DAY_S - 1
    assert tracks._nearest_utc_s([1000.0, 1000.0 + 3 * DAY_S], 1010.0) == 1010.0
    assert tracks._nearest_utc_s([1000.0, 1000.0 + 3 * DAY_S + 8], 1010.0) == 1010.0 + 3 * DAY_S


def test_dates_of_nmea() -> None:
    assert tracks._nmea_date(rmc(date="311299").split(",")) == parse_utc("1999-12-31T00:00:00Z")
    assert tracks._nmea_date(rmc(date="010180").split(",")) == parse_utc("1980-01-01T00:00:00Z")
    assert tracks._nmea_date(rmc(date="010179").split(",")) == parse_utc("2079-01-01T00:00:00Z")
    assert tracks._nmea_date(["GPZDA", "110002", "7", "3", "2024", "0", "0"]) == parse_utc("2024-03-07T00:00:00Z")
    assert tracks._nmea_date(["GPZDA", "110002", "07", "03", "", "0", "0"]) is None
    assert tracks._nmea_date(rmc(date="").split(",")) is None
    assert tracks._nmea_date(gga().split(",")) is None


def test_checksums_decide_where_most_sentences_have_them() -> None:
    good, wrong, bare = sentence(rmc()), sentence(rmc("110003.50"))[:-2] + "zz", f"${rmc('110004.50')}"
    reason = "sentences with a wrong checksum or without one"
    found, passed = fixes(tracks._nmea, f"{good}\n{wrong}\n{bare}")
    assert ([fix[0] for fix in found], passed) == ([AT[0]], {reason: 2})
    found, passed = fixes(tracks._nmea, f"{good}\n{bare}\n{bare}")
    assert ([fix[0] for fix in found], passed) == ([AT[0], AT[0] + 2], {})
    found, passed = fixes(tracks._nmea, f"{good}\n{bare}")
    assert ([fix[0] for fix in found], passed) == ([AT[0]], {reason: 1})
    lower = sentence(rmc()).rpartition("*")
    [(fields, has_sum, is_right)] = tracks._nmea_sentences(f"12:00:00 {lower[0]}*{lower[2].lower()} tail")
    assert (fields, has_sum, is_right) == (rmc().split(","), True, True)
    two = list(tracks._nmea_sentences(f"x{good}{bare}"))
    assert [(fields[1], has_sum, is_right) for fields, has_sum, is_right in two] == [
        ("110002.50", True, True),
        ("110004.50", False, False),
    ]


# --- IGC ------------------------------------------------------------------------------------------------------------
HEADER = "AXXX001\nHFDTE100324\n"
RECORD = "B1100023455500S13836250E{}0123400567"  # time, place, validity, pressure and GNSS heights


def igc(text: str) -> tuple[list[list[float]], dict[str, int]]:
    return fixes(tracks._igc, text)


PLACE_IGC = (-(34 + 55.5 / 60), 138 + 36.25 / 60)


def test_records_of_igc_have_heights_by_gnss_or_by_pressure() -> None:
    assert same(igc(HEADER + RECORD.format("A"))[0], [(ELEVEN_S + 2, *PLACE_IGC, 567.0)])
    assert igc(HEADER + RECORD.format("V")) == ([[ELEVEN_S + 2, *PLACE_IGC, 1234.0]], {})
    both = f"{HEADER}{RECORD.format('V')}\n{RECORD.format('A')}\n{RECORD.format('V')}"
    assert igc(both) == ([[ELEVEN_S + 2, *PLACE_IGC, 567.0]], {"without a 3D fix (V)": 2})
    other = "B2359583455500N13836250WA-0120-0034"
    assert same(igc(HEADER + other)[0], [(MIDNIGHT_S + DAY_S - 2, 34 + 55.5 / 60, -138 - 36.25 / 60, -34.0)])
    assert igc(HEADER + RECORD.format("X") + "\nB12\nBXX")[1] == {"unreadable B records": 2}


def test_times_of_igc_go_on_after_midnight() -> None:
    def at(clock: str) -> str:
        return f"B{clock}{RECORD.format('A')[7:]}"

    clocks = ["235958", "000001", "000000", "120002", "000003"]
    found, _ = igc(HEADER + "\n".join(map(at, clocks)))
    past_s = [86398, DAY_S + 1, DAY_S, DAY_S + 43202, DAY_S + 3]  # 12 h back is the same day, more is the next
    assert [fix[0] - MIDNIGHT_S for fix in found] == past_s
    # A second date begins another day.
    found, _ = igc(f"{HEADER}{at('235958')}\nHFDTEDATE:120324,01\n{at('000001')}")
    assert [fix[0] - MIDNIGHT_S for fix in found] == [86398, 2 * DAY_S + 1]
    found, _ = igc(f"{HEADER}{at('120000')}\n{at('000001')}\n{at('000000')}")
    assert [fix[0] - MIDNIGHT_S for fix in found] == [43200, 1, 0]


def test_fractions_of_seconds_of_igc_are_in_the_columns_of_the_header() -> None:
    line = RECORD.format("A") + "99" + "375" + "88"
    found, _ = igc(f"{HEADER}I023637FXA3840TDS\n{line}")
    assert found[0][0] == ELEVEN_S + 2.375
    assert igc(f"{HEADER}I013637FXA\n{line}")[0][0][0] == ELEVEN_S + 2
    assert igc(f"{HEADER}I013840TDS\n{line[:37]}x75")[0][0][0] == ELEVEN_S + 2


@pytest.mark.parametrize(("year", "century"), [("80", "19"), ("99", "19"), ("79", "20"), ("00", "20")])
def test_years_of_two_digits(year: str, century: str) -> None:
    assert tracks._century(year) == century
    [[utc_s, *_]], _ = igc(f"AXXX001\nHFDTE0103{year}\n{RECORD.format('A')}")
    assert utc_s == parse_utc(f"{century}{year}-03-01T11:00:02Z")


# --- XML ------------------------------------------------------------------------------------------------------------
def test_fixes_of_gpx() -> None:
    points = (
        '<trkpt lat="-34.5" lon="138.5"><ele> 50.5 </ele><time>2024-03-10T11:00:02.5Z</time><fix>3d</fix></trkpt>'
        '<trkpt lat="-34.6" lon="138.6"><time>2024-03-10T11:00:03z</time></trkpt>'
        '<trkpt lat="-34.6" lon="138.6"><ele>x</ele><time>2024-03-10T24:00:00Z</time></trkpt>'
        '<trkpt lat="1" lon="2"><time>2024-03-10T11:00:04Z</time><fix>none</fix></trkpt>'
        '<trkpt lat="1" lon="2"></trkpt><trkpt lat="1" lon="2"/>'
        '<trkpt lat="1" lon="2"><time>2024-03-10</time></trkpt><trkpt lat="1"><time>2024-03-10T11:00:04Z</time></trkpt>'
        '<wpt lat="7" lon="8"><time>2024-03-10T11:00:04Z</time></wpt>'
    )
    found, passed = fixes(tracks._gpx, f'<gpx xmlns="http://www.topografix.com/GPX/1/1"><trk>{points}</trk></gpx>')
    assert same(
        found,
        [
            (ELEVEN_S + 2.5, -34.5, 138.5, 50.5),
            (ELEVEN_S + 3, -34.6, 138.6, nan),
            (MIDNIGHT_S + DAY_S, -34.6, 138.6, nan),
        ],
    )
    assert passed == {"without a fix": 1, "without a time": 2, "without a readable place or time": 2}


def kml(body: str) -> tuple[list[list[float]], dict[str, int]]:
    head = '<kml xmlns="http://www.opengis.net/kml/2.2" xmlns:gx="http://www.google.com/kml/ext/2.2">'
    return fixes(tracks._kml, f"{head}{body}</kml>")


WHENS = "<when>2024-03-10T11:00:02Z</when><when>2024-03-10T11:00:03Z</when>"
COORDS = "<gx:coord>138.5 -34.5 50.5</gx:coord><gx:coord>138.6 -34.6 60.5</gx:coord>"
TWO = [(ELEVEN_S + 2, -34.5, 138.5, 50.5), (ELEVEN_S + 3, -34.6, 138.6, 60.5)]
GROUND = "<altitudeMode>relativeToGround</altitudeMode>"
ABOVE = "heights above ground, which are none above sea level"


def test_fixes_of_a_track_of_kml() -> None:
    assert same(kml(f"<gx:Track>{WHENS}{COORDS}</gx:Track>")[0], TWO)
    assert kml(f"<gx:Track>{WHENS}{COORDS}</gx:Track>")[1] == {}
    level = "<gx:coord>138.5 -34.5</gx:coord>" * 2
    assert kml(f"<gx:Track>{GROUND}{WHENS}{level}</gx:Track>")[1] == {}
    low = [(*fix[:3], nan) for fix in TWO]
    found, passed = kml(f"<gx:Track>{GROUND}{WHENS}{COORDS}</gx:Track>")
    assert (same(found, low), passed) == (True, {ABOVE: 2})
    absolute = "<altitudeMode>absolute</altitudeMode>"
    within = f"<gx:MultiTrack>{GROUND}<gx:Track>{{}}{WHENS}{COORDS}</gx:Track></gx:MultiTrack>"
    assert same(kml(within.format(absolute))[0], TWO)
    assert same(kml(within.format(""))[0], low)
    for mode in ("clampToGround", "relativeToSeaFloor", "clampToSeaFloor"):
        spelled = f"<gx:altitudeMode>{mode}</gx:altitudeMode>"
        assert same(kml(f"<gx:Track>{spelled}{WHENS}{COORDS}</gx:Track>")[0], low)
    with pytest.raises(ValueError, match="a gx:Track has 2 times and 1 places"):
        kml(f"<gx:Track>{WHENS}<gx:coord>1 2 3</gx:coord></gx:Track>")
    found, passed = kml(f"<gx:Track>{WHENS}<gx:coord>138.5 -34.5</gx:coord><gx:coord>138.5</gx:coord></gx:Track>")
    assert same(found, [(*TWO[0][:3], nan)])
    assert passed == {"without a readable place or time": 1}


def test_fixes_of_placemarks_of_kml() -> None:
    when = "<TimeStamp><when>2024-03-10T11:00:02Z</when></TimeStamp>"
    point = "<Point>{}<coordinates>138.5,-34.5,50.5</coordinates></Point>"
    assert same(kml(f"<Placemark>{when}{point.format('')}</Placemark>")[0], TWO[:1])
    found, passed = kml(f"<Placemark>{when}{point.format(GROUND)}</Placemark>")
    assert (same(found, [(*TWO[0][:3], nan)]), passed) == (True, {ABOVE: 1})
    assert kml(f"<Placemark>{when}</Placemark><Placemark>{point.format('')}</Placemark>") == ([], {})
    assert kml(f"<Placemark><TimeStamp/>{point.format('')}</Placemark>")[1] == {"without a readable place or time": 1}
    assert kml(f"<Placemark>{when}<Point/></Placemark>")[1] == {"without a readable place or time": 1}


def test_a_document_that_ends_early_is_read_to_its_damage() -> None:
    point = '<trkpt lat="-34.5" lon="138.5"><time>2024-03-10T11:00:02Z</time></trkpt>'
    found, passed = fixes(tracks._gpx, f"<gpx><trk>{point}{point}<trkpt")
    assert len(found) == 2
    [(reason, count)] = passed.items()
    assert count == 1
    assert reason.startswith("all after its damage or end (")
    with pytest.raises(tracks.ET.ParseError):
        fixes(tracks._gpx, "<gpx><trk>")
    with pytest.raises(ValueError, match="it declares entities, which no track needs"):
        fixes(tracks._gpx, '<!DOCTYPE gpx [<!ENTITY a "b">]><gpx></gpx>')


@pytest.mark.parametrize(("depth", "is_refused"), [(64, False), (65, True)])
def test_a_document_may_be_64_elements_deep(depth: int, is_refused: bool) -> None:
    text = "<gpx>" + "<a>" * (depth - 1) + "</a>" * (depth - 1) + "</gpx>"
    if is_refused:
        with pytest.raises(ValueError, match="has 65 levels; glstar reads up to 64 levels"):
            fixes(tracks._gpx, text)
    else:
        assert fixes(tracks._gpx, text) == ([], {})


# --- texts and formats ----------------------------------------------------------------------------------------------
@pytest.mark.parametrize(
    ("content", "text"),
    [
        ("<gpx>\u00e4".encode(), "<gpx>\u00e4"),
        ("\ufeff<gpx>\u00e4".encode(), "<gpx>\u00e4"),
        ("\ufeff<gpx>\u00e4".encode("utf-16-le"), "<gpx>\u00e4"),
        ("\ufeff<gpx>\u00e4".encode("utf-16-be"), "<gpx>\u00e4"),
        ("<gpx>\u00e4".encode("utf-16-le"), "<gpx>\u00e4"),
        ("<gpx>\u00e4".encode("utf-16-be"), "<gpx>\u00e4"),
        ('<?xml encoding="latin-1"?>\u00e4'.encode("latin-1"), '<?xml encoding="latin-1"?>\u00e4'),
        (b'<?xml encoding="nonsense"?>a', '<?xml encoding="nonsense"?>a'),
        *(
            (f'<?xml encoding="{name}"?>\\x41 +AGE-'.encode(), f'<?xml encoding="{name}"?>\\x41 +AGE-')
            for name in ("unicode_escape", "raw-unicode-escape", "UTF7", "punycode", "idna", "undefined")
        ),
    ],
)
def test_a_text_has_the_encoding_that_it_says(content: bytes, text: str) -> None:
    assert tracks._text(content) == text


@pytest.mark.parametrize(
    ("content", "kind"),
    [
        (b"<gpx>", "GPX"),
        (b"\xef\xbb\xbf <?xml version='1.0'?><!-- <kml> --><gpx>", "GPX"),
        (b"<k:kml>", "KML"),
        ("\ufeff<kml>".encode("utf-16-le"), "KML"),
        (b"AXXX\nHFDTE100324", "IGC"),
        (b"\r\n AXXX\nB110002", "IGC"),
        (b"x $GPRMC,1", "NMEA"),
        (b"$GNZDA,1", "NMEA"),
        (b"A $GPGGA,1", "NMEA"),
        (b"<html>$GPGGA,1", "NMEA"),
        (b"<html>", None),
        (b"AXXX", None),
        (b"$GPGSV,1", None),
    ],
)
def test_the_format_of_a_track_is_that_of_its_content(content: bytes, kind: str | None) -> None:
    if kind is None:
        with pytest.raises(LogFormatError, match="is no track that glstar knows: GPX, KML, KMZ, NMEA or IGC"):
            tracks._format("x", content)
    else:
        assert tracks._format("x", content)[0] == kind


def test_an_archive_holds_a_track(tmp_path: Path) -> None:
    path = tmp_path / "a.kmz"
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("a.png", b"x")
        archive.writestr("B.KML", b"<kml>one")
    assert tracks._format(str(path), path.read_bytes())[::2] == ("KMZ", "<kml>one")
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("a.png", b"x")
    with pytest.raises(LogFormatError, match="is a zip archive without a track"):
        tracks._format(str(path), path.read_bytes())


@pytest.mark.parametrize("text", ["2024-03-10", "noon", ""])
def test_a_date_without_a_time_of_day_is_no_time(text: str) -> None:
    with pytest.raises(ValueError, match="has no time of day"):
        tracks._utc_s(text)


# --- which fixes are valid ------------------------------------------------------------------------------------------
def valid(*rows: tuple[float, float, float, float]) -> tuple[list[list[float]], dict[str, int]]:
    passed: Counter[str] = Counter({"before": 3})
    found = tracks._valid(np.array(rows), passed).tolist()
    assert passed.pop("before") == 3
    return found, dict(passed)


def test_fixes_of_no_aircraft_are_counted() -> None:
    good = [(ELEVEN_S + k, -34.5 + 1e-4 * k, 138.5, 50.5 + k) for k in range(6)]
    assert same(valid(*good)[0], good)
    east = [(utc_s, latitude, longitude - 360 + 0.0, height) for utc_s, latitude, longitude, height in good]
    assert same(valid(*((a, b, c + 360, d) for a, b, c, d in east))[0], good)
    found, passed = valid(*((a, b, 221.5, d) for a, b, _, d in good))
    assert (same(found, [(a, b, 221.5, d) for a, b, _, d in good]), passed) == (True, {})
    year_1990_s = 631152000.0
    found, passed = valid((nan, *good[0][1:]), (year_1990_s - 1, *good[0][1:]), *good)
    assert (same(found, good), passed) == (True, {"without a date": 2})
    assert same(valid((year_1990_s, -34.5, 138.5, 50.5))[0], [(year_1990_s, -34.5, 138.5, 50.5)])
    wrong = [(ELEVEN_S + 6, 0.0, 0.0, 50.0), (ELEVEN_S + 7, 91.0, 138.5, 50.0), (ELEVEN_S + 8, -34.5, 361.0, 50.0)]
    found, passed = valid(*good, *wrong, (ELEVEN_S + 9, -34.5, 138.5, 1e6))
    assert (same(found, good), passed) == (True, {"at 0 N 0 E, beyond a pole or at an impossible height": 4})
    found, passed = valid(*good, (ELEVEN_S + 6, -35.5, 138.5, 50.0))
    assert (same(found, good), passed) == (True, {"too far from the others for an aircraft": 1})
    lost = [*good[:3], (*good[3][:3], 0.0), *good[4:]]
    high = [(a, b, c, d + 500 if d else d) for a, b, c, d in lost]
    found, passed = valid(*high)
    assert same(found, [(a, b, c, d or nan) for a, b, c, d in high])
    assert passed == {"heights of 0 m that are none, between others": 1}


def test_two_places_are_refused() -> None:
    one = [(ELEVEN_S + 2 * k, -34.5, 138.5, 50.5) for k in range(10)]
    other = [(ELEVEN_S + 2 * k + 1, -44.5, 138.5, 50.5) for k in range(9)]
    with pytest.raises(ValueError, match="its positions are of two places, 10 at"):
        valid(*sorted([*one, *other]))


def test_a_fix_is_held_between_two_flights() -> None:
    times_s = np.array([100.0, 200.0, 200.0 + 4 * 3600, 30_000.0, 60_000.0])
    columns = np.stack([times_s, np.arange(5.0) + 1, np.arange(5.0) + 10, np.arange(5.0) + 100])
    held = tracks._held_between_flights(columns)
    middle_s = (200.0 + 4 * 3600 + 30_000) / 2, 45_000.0
    expected_s = [100, 200, 14600, middle_s[0] - 1e-3, middle_s[0], 30000, 45000 - 1e-3, 45000, 60000]
    np.testing.assert_allclose(held[0], expected_s, rtol=0, atol=1e-9)
    np.testing.assert_array_equal(held[1], [1, 2, 3, 3, 4, 4, 4, 5, 5])
    np.testing.assert_array_equal(held[2:] - held[1], np.tile([[9.0], [99.0]], 9))


# --- a whole track --------------------------------------------------------------------------------------------------
def track(tmp_path: Path, *points: str, name: str = "t.gpx", head: str = "gpx") -> tracks.GivenTrack:
    (tmp_path / name).write_text(f"<{head}><trk>{''.join(points)}</trk></{head}>")
    return read_track(str(tmp_path / name))


def point(k: int, height: str = "", day: str = "2024-03-10") -> str:
    return f'<trkpt lat="{-34.5 + 1e-4 * k}" lon="138.5">{height}<time>{day}T11:00:{k:02d}Z</time></trkpt>'


def test_a_track_is_its_fixes_sorted(tmp_path: Path) -> None:
    given = track(tmp_path, point(3, "<ele>53</ele>"), point(1, "<ele>51</ele>"), point(2), "<trkpt/>")
    assert given.source == "t.gpx, GPX, 3 fixes"
    assert given.notes == ("of the track t.gpx were passed over: 1 without a time",)
    np.testing.assert_array_equal(given.fix_utc_s, ELEVEN_S + np.array([1.0, 2.0, 3.0]))
    site = given.track.at(ELEVEN_S + 2.0)
    assert (np.rad2deg(site.latitude_rad), np.rad2deg(site.longitude_rad), site.height_m) == (
        pytest.approx(-34.4998, abs=1e-9),
        pytest.approx(138.5, abs=1e-9),
        pytest.approx(52.0, abs=1e-9),
    )


def test_a_track_without_heights_is_at_sea_level(tmp_path: Path) -> None:
    given = track(tmp_path, point(1), point(2))
    assert given.notes == ("the track t.gpx has no heights above sea level: 0 m is taken",)
    assert given.track.at(ELEVEN_S + 1.5).height_m == 0.0


def test_a_track_without_places_says_what_it_has(tmp_path: Path) -> None:
    path = tmp_path / "t.gpx"
    for points, why in (([], ""), (["<trkpt/>", "<trkpt/>"], "; passed over: 2 without a time")):
        with pytest.raises(LogFormatError) as caught:
            track(tmp_path, *points)
        assert str(caught.value) == f"{path}: has no places with times in it (GPX){why}"


@pytest.mark.parametrize(("date", "weeks"), [("311209", 1024), ("010110", 0), ("311289", None), ("010190", 1024)])
def test_dates_of_nmea_before_2010_are_1024_weeks_later(tmp_path: Path, date: str, weeks: int | None) -> None:
    path = tmp_path / "t.nmea"
    path.write_text("\n".join(sentence(rmc(f"11000{k}", date=date)) for k in range(3)))
    if weeks is None:
        with pytest.raises(
            LogFormatError, match=r"has no places with times in it \(NMEA\); passed over: 3 without a date"
        ):
            read_track(str(path))
        return
    given = read_track(str(path))
    year = {"09": "2009", "10": "2010", "90": "1990"}[date[4:]]
    first_s = parse_utc(f"{year}-{date[2:4]}-{date[:2]}T11:00:00Z") + weeks * 7 * DAY_S
    np.testing.assert_array_equal(given.fix_utc_s, first_s + np.arange(3))
    later = " with dates 1024 weeks later" if weeks else ""
    assert given.source == f"t.nmea, NMEA{later}, 3 fixes"
    rolled = (
        "the track t.nmea has dates before 2010: the week of its receiver has rolled over, and 1024 weeks are added"
    )
    assert (rolled in given.notes) is bool(weeks)
