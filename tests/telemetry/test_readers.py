"""Which reader opens a file and with which options, members of archives, other files, and described flights."""

import gzip
import warnings
import zipfile
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from glstar.errors import ConfigError, LogFormatError
from glstar.flight.synthetic.syntheticflight import SyntheticFlight
from glstar.sky.place.site import Site
from glstar.sky.place.timescale import parse_utc
from glstar.telemetry import ScriptedFlight, _described, _reader, formats, open_source, synthetic
from glstar.telemetry.bags import BagReader
from glstar.telemetry.formats import LOG_FORMATS, LogFormat, is_packed, log_format, other_file, unpack
from glstar.telemetry.mavlink.tlog import TelemetryLogReader, stream_reader
from glstar.telemetry.synthetic import parse_description, synthetic_flight
from glstar.telemetry.tables.mapped import MappedTableReader, column_map
from glstar.telemetry.tables.native import TableReader
from glstar.telemetry.ulog import ULogReader

OF = {entry.name: entry for entry in LOG_FORMATS}
TLOG, ULOG, STREAM, BAG = (OF[name] for name in ("MAVLink telemetry logs", "PX4 ULog", "MAVLink streams", "ROS bags"))
PARQUET, CSV = OF["Parquet tables"], LOG_FORMATS[-1]


def refusal(act: object, *arguments: object, **more: object) -> str:
    with pytest.raises((LogFormatError, ConfigError)) as caught:
        act(*arguments, **more)
    return str(caught.value)


# --- options of readers ---------------------------------------------------------------------------------------------
def opened(kind: LogFormat, **options: object) -> tuple[object, dict[str, object]]:
    """Return the reader of a format, and the options that it gets."""
    reader = _reader("a.log", kind, *(options.get(name) for name in ("sysid", "vehicle", "columns")))
    return (reader.func, reader.keywords) if isinstance(reader, partial) else (reader, {})


def test_readers_get_the_options_of_their_format() -> None:
    assert opened(TLOG) == (TelemetryLogReader, {"sysid": None})
    assert opened(TLOG, sysid=3) == opened(TLOG, vehicle="3") == opened(TLOG, vehicle="3", sysid=3)
    assert opened(TLOG, vehicle="3") == (TelemetryLogReader, {"sysid": 3})
    assert opened(STREAM, vehicle="3") == (stream_reader, {"sysid": 3})
    assert opened(BAG, vehicle="uav1", columns="world=NED") == (BagReader, {"columns": "world=NED", "vehicle": "uav1"})
    assert opened(BAG) == (BagReader, {"columns": None, "vehicle": None})
    assert opened(ULOG) == (ULogReader, {})
    assert opened(PARQUET) == (MappedTableReader, {})
    assert opened(CSV) == (TableReader, {})
    assert opened(CSV, columns="tum") == (MappedTableReader, {"columns": column_map("tum")})


@pytest.mark.parametrize(
    ("kind", "options", "message"),
    [
        (TLOG, {"vehicle": "uav1"}, "vehicle must be the MAVLink system of one, such as 1, not 'uav1'"),
        (TLOG, {"vehicle": "3", "sysid": 4}, "vehicle must be the MAVLink system of one, such as 1, not '3'"),
        (ULOG, {"sysid": 4}, "is no telemetry log of several vehicles; leave out sysid, which is 4"),
        (BAG, {"sysid": 4}, "is no telemetry log of several vehicles; leave out sysid, which is 4"),
        (ULOG, {"vehicle": "3"}, "is no log of several vehicles; leave out vehicle, which is '3'"),
        (CSV, {"vehicle": "3"}, "is no log of several vehicles; leave out vehicle, which is '3'"),
        (ULOG, {"columns": "tum"}, "is no table but of the format PX4 ULog; leave out columns (--columns)"),
        (
            TLOG,
            {"columns": "tum"},
            "is no table but of the format MAVLink telemetry logs; leave out columns (--columns)",
        ),
    ],
)
def test_options_of_another_format_are_refused(kind: LogFormat, options: dict[str, object], message: str) -> None:
    assert refusal(opened, kind, **options) == f"a.log: {message}"


@pytest.mark.parametrize(
    ("option", "value"), [("attitude", "XKQ"), ("sysid", 1), ("boot", 2), ("boot", 0), ("vehicle", "1")]
)
def test_a_described_flight_has_no_options(option: str, value: object) -> None:
    usual = {"attitude": "auto", "sysid": None, "boot": None, "vehicle": None}
    said = f"fly:hover: a synthetic flight has one attitude; leave out {option}"
    assert refusal(_described, "fly:hover", **usual | {option: value}) == said
    short = "fly:hover?duration_s=0.1"
    assert _described(short, **usual | {"attitude": "AUTO", "boot": 1}).name == short


def test_what_is_no_log_is_refused(tmp_path: Path) -> None:
    for link in ("tcp:host:1", "UDPIN:0:1", "serial:/dev/x", "/dev/ttyUSB0,57600", "COM3,115200"):
        assert refusal(open_source, link) == f"{link}: is a link, not a file; glstar live {link} shows what it sends"
    assert refusal(open_source, tmp_path) == f"{tmp_path}: is a directory; name the log inside it"
    empty = tmp_path / "empty.log"
    empty.touch()
    assert refusal(open_source, empty) == f"{empty}: is empty: 0 bytes"
    missing = tmp_path / "missing.log"
    assert refusal(open_source, missing).endswith("; demo is the bundled flight")
    image = tmp_path / "a.bin"
    image.write_bytes(b"\x89PNG\r\n\x1a\n")
    assert refusal(open_source, image) == f"{image}: this is a PNG image ({formats.READABLE})"
    assert refusal(open_source, f"{image}::x") == f"{image}::x: only a zip archive has members"
    packed = tmp_path / "a.gz"
    packed.write_bytes(gzip.compress(b"utc"))
    assert refusal(open_source, f"{packed}::x") == f"{packed}::x: only a zip archive has members"
    named = tmp_path / "udp:a"
    named.write_bytes(b"\x89PNG\r\n\x1a\n")
    assert "a PNG image" in refusal(open_source, named)


# --- archives -------------------------------------------------------------------------------------------------------
TABLE = "utc_s,roll_deg,pitch_deg,yaw_deg\n1710068400,1,2,3\n"
ULOG_HEAD = b"ULog\x01\x12\x35\x01" + bytes(8)


def archive(path: Path, **members: str | bytes) -> str:
    with zipfile.ZipFile(path, "w") as packed:
        for name, content in members.items():
            packed.writestr(name.replace("__", "/").replace("_dot_", "."), content)
    return str(path)


def member_of(name: str) -> str:
    folder, path = unpack(name)
    with folder:
        return path.relative_to(folder.path).as_posix()


@pytest.mark.parametrize(
    ("head", "packed"),
    [
        (b"\x1f\x8bx", True),
        (b"PK\x03\x04x", True),
        (b"PK\x03\x04 doc.kml", False),
        (b"PK\x03\x04" + bytes(200) + b"doc.kml", True),
        (b"PK\x03\x04 xl/a", False),
        (b"PK\x05\x06", False),
    ],
)
def test_archives_are_known_by_their_first_bytes(head: bytes, packed: bool) -> None:
    assert is_packed(head) is packed


def test_the_log_of_an_archive(tmp_path: Path) -> None:
    path = tmp_path / "a.zip"
    assert (
        member_of(archive(path, a__b_dot_ulg=ULOG_HEAD, readme_dot_txt="text", c_dot_png=b"\x89PNG\r\n\x1a\n"))
        == "a/b.ulg"
    )
    assert member_of(archive(path, own_dot_csv=TABLE, _dot_hidden=TABLE)) == "own.csv"
    assert member_of(archive(path, a__deep__er__b_dot_ulg=ULOG_HEAD)) == "a/deep/er/b.ulg"
    two = archive(path, a__b_dot_ulg=ULOG_HEAD, c__b_dot_ulg=ULOG_HEAD, d_dot_ulg=ULOG_HEAD, e_dot_csv=TABLE)
    held = "a/b.ulg, c/b.ulg, d.ulg"
    assert refusal(unpack, two) == f"{two}: holds 3 logs ({held}); name one, such as a.zip::a/b.ulg"
    assert [member_of(f"{two}::{one}") for one in ("c/b.ulg", "/a\\b.ulg", "d.ulg", "e.csv")] == [
        "c/b.ulg",
        "a/b.ulg",
        "d.ulg",
        "e.csv",
    ]
    every = f"it holds {held}, e.csv"
    assert refusal(unpack, f"{two}::b.ulg") == f"{two}::b.ulg: the archive has several logs of that name; {every}"
    assert refusal(unpack, f"{two}::x") == f"{two}::x: the archive has no logs of that name; {every}"
    none = archive(path, c_dot_png=b"\x89PNG\r\n\x1a\n")
    assert refusal(unpack, none) == f"{none}: is a zip archive without a log"
    assert refusal(unpack, f"{none}::x") == f"{none}::x: the archive has no logs of that name; it holds no log"
    many = archive(path, **{f"f{k:02d}_dot_ulg": ULOG_HEAD for k in range(21)})
    listed = ", ".join(f"f{k:02d}.ulg" for k in range(20))
    assert refusal(unpack, many) == f"{many}: holds 21 logs ({listed}, ...); name one, such as a.zip::f00.ulg"
    exactly = archive(path, **{f"f{k:02d}_dot_ulg": ULOG_HEAD for k in range(20)})
    assert f"holds 20 logs ({listed});" in refusal(unpack, exactly)
    with zipfile.ZipFile(path, "w") as packed, warnings.catch_warnings():
        warnings.simplefilter("ignore")
        packed.writestr("x.ulg", ULOG_HEAD)
        packed.writestr("x.ulg", ULOG_HEAD + b"2")
    assert member_of(f"{path}::x.ulg") == "x.ulg"
    assert refusal(unpack, str(path)) == f"{path}: holds 2 logs (x.ulg, x.ulg#2); name one, such as a.zip::x.ulg"
    assert member_of(f"{path}::x.ulg#2") == "#2/x.ulg"
    zipped = tmp_path / "log.ulg.gz"
    zipped.write_bytes(gzip.compress(ULOG_HEAD))
    assert member_of(str(zipped)) == "log.ulg"


def test_names_of_members_stay_in_the_folder(tmp_path: Path) -> None:
    for member, path in (
        ("../../a", "a"),
        ("/a//b", "a/b"),
        ("C:/a", "C_/a"),
        ("..", "log"),
        ("", "log"),
        ("a/./b", "a/b"),
    ):
        assert formats._inside(tmp_path, member) == tmp_path / path


TRACK = "track; it has positions but no attitude: --position takes it"
PRINTED = "what mavlogdump.py prints; give the log itself, or its CSV (mavlogdump.py --format csv)"


@pytest.mark.parametrize(
    ("head", "name", "kind"),
    [
        (b"\xef\xbb\xbf \n<html>", "x", "a web page or XML; was it saved from a browser?"),
        (b"<?xml?><gpx>", "x", f"a GPX {TRACK}"),
        (b"PK\x03\x04 doc.kml", "x", TRACK.replace("track", "a track of Google Earth (KMZ)")),
        (b"PK\x03\x04", "x", "a zip archive without a log"),
        (b"$GPGGA,", "x", f"an NMEA {TRACK}"),
        (b"AXXX1\r\nx\nHFDTE", "x", f"an IGC {TRACK}"),
        (b"2024-03-10 20:30:34.26: ATT {", "x", PRINTED),
        (b"a\0", "DJIFlight.txt", "no log that glstar knows; DJI encrypts its flight records"),
        (b"a\0", "x", "no log that glstar knows"),
        (b"a", "DJIFlight.txt", None),
        (b"AXXX\n" + b"x\n" * 5 + b"HFDTE", "x", None),
    ],
)
def test_other_files_are_named(head: bytes, name: str, kind: str | None) -> None:
    assert other_file(head, name) == kind


def test_the_most_special_format_is_first() -> None:
    assert log_format(ULOG_HEAD) is ULOG
    assert [entry.is_any_text for entry in LOG_FORMATS] == [False] * (len(LOG_FORMATS) - 1) + [True]
    assert log_format(b"PAR1") is PARQUET
    assert log_format(TABLE.encode()) is CSV
    assert log_format(b"timestamp,ATTITUDE.roll\n").reader is LOG_FORMATS[7].reader
    assert log_format(b"timestamp,TimeUS\n").reader is LOG_FORMATS[8].reader
    assert log_format(b"timestamp,q[0]\n").reader is LOG_FORMATS[9].reader
    assert log_format(b"fieldname,fieldvalue\n").reader is MappedTableReader
    assert log_format(b"\x89PNG\r\n\x1a\n") is None


# --- described flights ----------------------------------------------------------------------------------------------
def test_a_description_is_a_flight_by_its_keys() -> None:
    assert synthetic._waypoints("1.5,2.5;-3.5,4.5,60") == (
        Site(np.deg2rad(1.5), np.deg2rad(2.5)),
        Site(np.deg2rad(-3.5), np.deg2rad(4.5), 60.0),
    )
    [first, second] = synthetic._vibration("120,0.25;60,0.5,pitch")
    assert (first.frequency_hz, second.frequency_hz, second.axis) == (120.0, 60.0, "pitch")
    assert [synthetic._gusts(text) for text in ("none", "light", "moderate", "severe", "9.5")] == [
        0.0,
        7.7,
        15.4,
        23.2,
        9.5,
    ]
    keys = synthetic.KEYS
    assert {key for key, of in keys.items() if of.is_whole_number} == {"seed"}
    assert {"radius_m", "heading_deg", "gusts"} <= {key for key, of in keys.items() if of.is_number}
    assert not {"direction", "waypoints", "vibration", "utc_start", "seed"} & {
        key for key, of in keys.items() if of.is_number
    }
    flight = parse_description("fly:orbit?radius_m=300&direction=left&heading_deg=90&wind_m_per_s=8&wind_from_deg=180")
    assert isinstance(flight, SyntheticFlight)
    assert (flight.radius_m, flight.clockwise, flight.heading_rad) == (
        300.0,
        False,
        pytest.approx(np.pi / 2, abs=1e-12),
    )
    assert flight.airspeed_m_per_s == 18.0
    assert parse_description("fly:orbit").clockwise
    with pytest.warns(UserWarning, match="the key start_utc is called utc_start now; the old name goes with the next"):
        old = parse_description("fly:hover?start_utc=2024-03-11T11:00:00Z")
    assert old == parse_description("fly:hover?utc_start=2024-03-11T11:00:00Z")


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("fly:orbit?radius_m", "fly:orbit?radius_m: keys are written key=value and joined by &"),
        ("fly:orbit?turns=1&turns=2&radius_m=1&radius_m=2", "radius_m is given twice"),
        ("fly:orbits", "fly: 'orbits' is no path (did you mean orbit?); paths are "),
        ("fly:orbit?radius=3", "fly: 'radius' is no key (did you mean radius_m?); keys are latitude_deg, "),
        ("fly:orbit?radius_m=x", "fly: radius_m cannot be 'x'; it is: radius of an orbit, m"),
        ("fly:orbit?radius_m=inf", "fly: radius_m cannot be 'inf'; it is: radius of an orbit, m"),
        ("fly:orbit?radius_m=", "fly: radius_m cannot be ''; it is: radius of an orbit, m"),
        ("fly:orbit?direction=rigt", "fly: direction cannot be 'rigt' (did you mean right?); it is: turn of an orbit"),
        ("fly:orbit?gusts=ligt", "fly: gusts cannot be 'ligt' (did you mean light?); it is: Dryden gusts"),
        ("fly:waypoints?waypoints=1,2,3,4", "fly: waypoints cannot be '1,2,3,4'; it is: latitude,longitude[,height_m]"),
        ("fly:orbit?seed=1.5", "fly: seed cannot be '1.5'; it is: of gusts and vibration"),
    ],
)
def test_an_impossible_description_is_refused(text: str, message: str) -> None:
    assert message in refusal(parse_description, text)
    assert refusal(synthetic.SyntheticSource, text).count("fly:") <= 2


def test_a_described_flight_is_a_source() -> None:
    opened_flight = synthetic.SyntheticSource("fly:hover?duration_s=2&rate_hz=10&utc_start=2024-03-10T11:00:00Z")
    attitude, position, clock = opened_flight.samples()
    assert attitude.clock_s.size == 21
    assert set(attitude.segment.tolist()) == {0}
    np.testing.assert_array_equal(clock.clock_s, [parse_utc("2024-03-10T11:00:00Z")])
    np.testing.assert_array_equal(clock.utc_s, clock.clock_s)
    assert (clock.source, attitude.source) == ("given", position.source)
    assert opened_flight.facts().format == "synthetic flight"
    assert opened_flight.one_clock
    assert synthetic_flight("hover", {"duration_s": "2"}).duration_s == 2.0
    assert synthetic.is_flight_description("fly:x")
    assert not synthetic.is_flight_description("x/fly:")


def test_a_scripted_flight_turns_at_constant_rates() -> None:
    site = Site(-0.6, 2.4, 70.0)
    rates = {"roll_rate_rad_per_s": 0.02, "pitch_rate_rad_per_s": -0.03, "yaw_rate_rad_per_s": 0.04}
    script = ScriptedFlight.steady(
        site, 1710068400.0, duration_s=2.0, rate_hz=5.0, roll_rad=0.1, pitch_rad=0.2, yaw_rad=0.3, **rates
    )
    attitude, position, clock = script.samples()
    np.testing.assert_allclose(attitude.clock_s, 0.2 * np.arange(11), rtol=1e-15)
    t = attitude.clock_s
    for angle, expected in zip(
        _euler(attitude.q_body_ned), (0.1 + 0.02 * t, 0.2 - 0.03 * t, 0.3 + 0.04 * t), strict=True
    ):
        np.testing.assert_allclose(angle, expected, rtol=0, atol=1e-12)
    assert (position.latitude_rad.tolist(), position.longitude_rad.tolist(), position.height_m.tolist()) == (
        [-0.6],
        [2.4],
        [70.0],
    )
    assert (position.clock_s.tolist(), clock.utc_s.tolist(), clock.clock_s.tolist()) == ([0.0], [1710068400.0], [0.0])
    usual = ScriptedFlight.steady(site, 1710068400.0)
    assert (usual.duration_s, usual.rate_hz, usual.name) == (10.0, 200.0, "scripted flight")
    np.testing.assert_allclose(usual.q_body_ned(np.array([3.0])), [[1.0, 0.0, 0.0, 0.0]], rtol=0, atol=1e-15)
    assert usual.flight().attitude.first_s == 1710068400.0


def _euler(q_body_ned: np.ndarray) -> tuple[np.ndarray, ...]:
    """Return roll, pitch and yaw of NED to body quaternions, by SciPy."""

    yaw, pitch, roll = Rotation.from_quat(q_body_ned[:, [1, 2, 3, 0]]).inv().as_euler("ZYX").T
    return roll, pitch, yaw
