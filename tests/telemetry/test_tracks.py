"""Tracks of position: UTC and place agree with the libraries of the formats."""

import datetime as dt
import io
from collections.abc import Callable
from pathlib import Path

import aerofiles.igc
import gpxpy.gpx
import numpy as np
import pynmea2
import pytest
import simplekml

from glstar.config import Config
from glstar.errors import ConfigError, LogFormatError
from glstar.system.resources import asset
from glstar.telemetry import open_flight, read_track

START = dt.datetime(2024, 3, 10, 23, 59, 40, tzinfo=dt.UTC)
# Across midnight and the date line.
TIMES_S = np.arange(40)
LATITUDE_DEG, LONGITUDE_DEG = -17.5 - 1e-4 * TIMES_S, (179.998 + 2e-4 * TIMES_S + 180) % 360 - 180
HEIGHT_M = 900.0 + TIMES_S


def times() -> list[dt.datetime]:
    return [START + dt.timedelta(seconds=int(t)) for t in TIMES_S]


def gpx(path: Path) -> None:
    track = gpxpy.gpx.GPX()
    track.tracks.append(gpxpy.gpx.GPXTrack())
    track.tracks[0].segments.append(gpxpy.gpx.GPXTrackSegment())
    for time, *place in zip(times(), LATITUDE_DEG, LONGITUDE_DEG, HEIGHT_M, strict=True):
        point = gpxpy.gpx.GPXTrackPoint(*place, time=time)
        track.tracks[0].segments[0].points.append(point)
    path.write_text(track.to_xml())


def kml_document() -> simplekml.Kml:
    document = simplekml.Kml()
    track = document.newgxtrack()
    track.newwhen([f"{time:%Y-%m-%dT%H:%M:%SZ}" for time in times()])
    track.newgxcoord(list(zip(LONGITUDE_DEG, LATITUDE_DEG, HEIGHT_M, strict=True)))
    return document


def kml(path: Path) -> None:
    kml_document().save(str(path))


def kmz(path: Path) -> None:
    kml_document().savekmz(str(path))


def kml_points(path: Path) -> None:
    document = simplekml.Kml()
    for time, latitude, longitude, height in zip(times(), LATITUDE_DEG, LONGITUDE_DEG, HEIGHT_M, strict=True):
        point = document.newpoint(coords=[(longitude, latitude, height)])
        point.timestamp.when = f"{time:%Y-%m-%dT%H:%M:%SZ}"
    document.save(str(path))


def angle(degrees: float, digits: int, sides: str) -> tuple[str, str]:
    whole = int(abs(degrees))
    return f"{whole:0{digits}d}{(abs(degrees) - whole) * 60:08.5f}", sides[int(degrees < 0)]


def nmea(path: Path) -> None:
    lines = []
    for time, latitude, longitude, height in zip(times(), LATITUDE_DEG, LONGITUDE_DEG, HEIGHT_M, strict=True):
        place = (*angle(latitude, 2, "NS"), *angle(longitude, 3, "EW"))
        stamp = f"{time:%H%M%S}.000"
        lines.append(
            pynmea2.GGA("GN", "GGA", (stamp, *place, "1", "12", "0.7", f"{height - 50}", "M", "50.0", "M", "", ""))
        )
        lines.append(pynmea2.RMC("GN", "RMC", (stamp, "A", *place, "12.0", "90.0", f"{time:%d%m%y}", "", "", "A")))
    texts = [str(line) for line in lines]
    # A sentence with a wrong checksum, and one without a fix.
    texts += [
        "$GNRMC,120000.000,A,0000.0,N,00000.0,E,0,0,100324,,,A*00",
        str(pynmea2.RMC("GP", "RMC", ("120000", "V", *[""] * 10))),
    ]
    path.write_text("\r\n".join(texts) + "\r\n")


def igc(path: Path) -> None:
    with path.open("wb") as file:
        writer = aerofiles.igc.Writer(file)
        writer.write_headers({
            "manufacturer_code": "XCS", "logger_id": "TBX", "date": START.date(), "fix_accuracy": 50, "pilot": "Ada",
            "glider_type": "DG", "glider_id": "D-1", "firmware_version": "1", "hardware_version": "1",
            "logger_type": "x", "gps_receiver": "u-blox", "pressure_sensor": "x",
        })  # fmt: skip
        for time, latitude, longitude, height in zip(times(), LATITUDE_DEG, LONGITUDE_DEG, HEIGHT_M, strict=True):
            writer.write_fix(
                time.time(), latitude=latitude, longitude=longitude, valid=True, pressure_alt=1, gps_alt=int(height)
            )


@pytest.mark.parametrize(
    ("write", "kind"),
    [(gpx, "GPX"), (kml, "KML"), (kmz, "KMZ"), (kml_points, "KML"), (nmea, "NMEA"), (igc, "IGC")],
)
def test_a_track_agrees_with_what_the_library_of_its_format_wrote(
    tmp_path: Path, write: Callable[[Path], None], kind: str
) -> None:
    write(tmp_path / "track")

    found = read_track(str(tmp_path / "track"))

    assert found.source == f"track, {kind}, 40 fixes"
    utc_s = START.timestamp() + TIMES_S
    np.testing.assert_allclose(found.track.utc_s, utc_s, rtol=0, atol=1e-3)
    latitude_rad, longitude_rad, height_m = found.track.coordinates(utc_s)
    # IGC has thousandths of a minute: 1.9 m.
    metres = 1.9 if kind == "IGC" else 1.0
    np.testing.assert_allclose(np.rad2deg(latitude_rad), LATITUDE_DEG, rtol=0, atol=metres / 111e3)
    turns = (np.rad2deg(longitude_rad) - LONGITUDE_DEG + 180) % 360 - 180
    np.testing.assert_allclose(turns, 0, rtol=0, atol=metres / 111e3)
    np.testing.assert_allclose(height_m, HEIGHT_M, rtol=0, atol=0.1)


def test_gpxpy_reads_the_same_fixes(tmp_path: Path) -> None:
    gpx(tmp_path / "track.gpx")

    points = gpxpy.parse(io.StringIO((tmp_path / "track.gpx").read_text())).tracks[0].segments[0].points
    found = read_track(str(tmp_path / "track.gpx")).track

    np.testing.assert_allclose(found.utc_s, [point.time.timestamp() for point in points], rtol=0, atol=1e-6)
    np.testing.assert_allclose(np.rad2deg(found.latitude_rad), [point.latitude for point in points], rtol=0, atol=1e-9)


def gpx_of(path: Path, first: str, last: str) -> Path:
    points = "".join(
        f'<trkpt lat="{lat}" lon="10"><ele>5</ele><time>{time}</time></trkpt>'
        for lat, time in ((50, first), (51, last))
    )
    path.write_text(f'<gpx xmlns="http://www.topografix.com/GPX/1/1"><trk><trkseg>{points}</trkseg></trk></gpx>')
    return path


def test_a_track_replaces_the_positions_of_a_log(tmp_path: Path) -> None:
    path = gpx_of(tmp_path / "track.gpx", "2024-03-10T10:00:00Z", "2024-03-10T12:00:00Z")
    log = asset("adelaide.BIN")
    own = open_flight(log)

    flight = open_flight(log, position=str(path))
    config = Config.load(write_config(tmp_path, 'position = "track.gpx"'))

    site = flight.position.at(own.attitude.first_s)
    expected_deg = np.interp(own.attitude.first_s, flight.position.utc_s, [50, 51])
    assert abs(np.rad2deg(site.latitude_rad) - expected_deg) < 1e-9
    assert flight.position_source == "track.gpx, GPX, 2 fixes"
    np.testing.assert_array_equal(flight.attitude.q_body_ned, own.attitude.q_body_ned)
    assert config.open_flight(log).position.at(own.attitude.first_s) == site
    found, _ = config.survey_flight(log)
    assert found.position_source == "track.gpx, GPX, 2 fixes"


def write_config(folder: Path, keys: str) -> Path:
    (folder / "night.toml").write_text(f"[flight]\n{keys}\n")
    return folder / "night.toml"


def test_a_track_of_another_night_is_refused(tmp_path: Path) -> None:
    path = gpx_of(tmp_path / "track.gpx", "2024-03-11T10:00:00Z", "2024-03-11T12:00:00Z")

    with pytest.raises(
        LogFormatError, match=r"the track track.gpx, GPX, 2 fixes lies from 2024-03-11T10:00:00.*the flight"
    ):
        open_flight(asset("adelaide.BIN"), position=str(path))


@pytest.mark.parametrize(("date", "is_rolled"), [("2004-07-25", True), ("2004-07-24", False)])
def test_a_gpx_of_a_receiver_whose_week_has_rolled_over_is_refused(tmp_path: Path, date: str, is_rolled: bool) -> None:
    path = gpx_of(tmp_path / "track.gpx", f"{date}T10:00:00Z", f"{date}T12:00:00Z")

    with pytest.raises(LogFormatError, match="GPX, 2 fixes lies from 2004") as caught:
        open_flight(asset("adelaide.BIN"), position=str(path))

    assert ("1024 weeks early" in str(caught.value)) == is_rolled


def test_a_track_that_ends_early_is_reported(tmp_path: Path) -> None:
    first = open_flight(asset("adelaide.BIN")).attitude.first_s
    ends = f"{dt.datetime.fromtimestamp(first + 20, dt.UTC):%Y-%m-%dT%H:%M:%SZ}"
    path = gpx_of(tmp_path / "track.gpx", "2024-03-10T10:00:00Z", ends)

    notes = open_flight(asset("adelaide.BIN"), position=str(path)).notes

    assert any("there its nearest fix is used" in note for note in notes)


def test_a_track_and_a_place_in_numbers_are_one_too_many(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"flight.position: is a track, but a place is given in numbers too"):
        Config.load(write_config(tmp_path, 'position = "track.gpx"\nlatitude_deg = 1\nlongitude_deg = 2'))


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("hello", "is no track that glstar knows: GPX, KML, KMZ, NMEA or IGC"),
        ('<gpx><trk><trkseg><trkpt lat="1" lon="2"/></trkseg></trk></gpx>', r"has no places with times in it \(GPX\)"),
        ('<gpx><trk><trkseg><trkpt lat="1" lon="2">', "cannot be read as a track: "),
        ('<!DOCTYPE x [<!ENTITY a "b">]><gpx></gpx>', "it declares entities"),
        (
            "<kml><Placemark><LineString><coordinates>1,2,3</coordinates></LineString></Placemark></kml>",
            "has no places",
        ),
    ],
)
def test_a_file_that_is_no_track_is_refused(tmp_path: Path, text: str, message: str) -> None:
    (tmp_path / "track").write_text(text)

    with pytest.raises(LogFormatError, match=message):
        read_track(str(tmp_path / "track"))


@pytest.mark.parametrize(("write", "kind"), [(nmea, "an NMEA"), (igc, "an IGC"), (gpx, "a GPX"), (kml, "a KML")])
def test_a_track_alone_is_named_in_the_message(tmp_path: Path, write: Callable[[Path], None], kind: str) -> None:
    write(tmp_path / "track")

    with pytest.raises(
        LogFormatError, match=f"this is {kind} track; it has positions but no attitude: --position takes it"
    ):
        open_flight(tmp_path / "track")
