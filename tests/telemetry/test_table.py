"""CSV tables, files of other kinds, and scripted flights."""

import os
from itertools import permutations
from pathlib import Path

import numpy as np
import pytest

from glstar.errors import LogFormatError
from glstar.rotation import quaternion_from_euler
from glstar.sky.place.site import Site
from glstar.sky.place.timescale import parse_utc
from glstar.telemetry import (
    FlightOptions,
    Recording,
    ScriptedFlight,
    TelemetrySource,
    open_flight,
    open_source,
    read_flight,
)

ELEVEN_S = parse_utc("2024-03-10T11:00:00Z")
HOME = Site(latitude_rad=np.deg2rad(-34.93), longitude_rad=np.deg2rad(138.60), height_m=48.0)

EULER = """\
utc,roll_deg,pitch_deg,yaw_deg,latitude_deg,longitude_deg,height_m
2024-03-10T11:00:00Z,0,0,350,-34.93,138.60,48
2024-03-10T11:00:00.100Z,10,-5,0,-34.93,138.60,48
2024-03-10T11:00:00.200Z,20,-10,10,-34.93,138.60,48
"""


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "flight.csv"


def refusal(path: Path, **options: object) -> str:
    """Return the error message of a refused file, without its name."""
    with pytest.raises(LogFormatError) as caught:
        open_flight(path, **options)
    message = str(caught.value)
    assert message.startswith(f"{path}: ")
    assert "\n" not in message
    return message.removeprefix(f"{path}: ")


# --- tables that are read -------------------------------------------------------------------------------------------
def test_a_table_of_euler_angles_is_a_flight(path: Path) -> None:
    path.write_text(EULER)

    flight = open_flight(path)

    np.testing.assert_allclose(flight.attitude.utc_s, ELEVEN_S + np.array([0.0, 0.1, 0.2]), rtol=0, atol=1e-6)
    expected = quaternion_from_euler(*np.deg2rad([[0, 10, 20], [0, -5, -10], [350, 0, 10]]))
    np.testing.assert_allclose(flight.attitude.q_body_ned, expected, rtol=0, atol=1e-15)
    assert np.rad2deg(flight.position.latitude_rad) == pytest.approx([-34.93] * 3)
    assert flight.position.height_m.tolist() == [48.0] * 3
    assert flight.name == "flight.csv"
    assert flight.attitude_source == "table, 10.0 Hz"


def test_quaternions_are_read_unchanged(path: Path) -> None:
    path.write_text(f"utc_s,qw,qx,qy,qz\n{ELEVEN_S},1,0,0,0\n{ELEVEN_S + 1},0.8,0.6,0,0\n")

    flight = open_flight(path, site=HOME)

    np.testing.assert_allclose(flight.attitude.q_body_ned, [[1, 0, 0, 0], [0.8, 0.6, 0, 0]], rtol=0, atol=1e-15)


def test_columns_may_be_in_any_order(path: Path) -> None:
    path.write_text(EULER)
    expected = open_flight(path)
    rows = [line.split(",") for line in EULER.splitlines()]
    for order in list(permutations(range(7)))[::997]:
        path.write_text("".join(",".join(row[i] for i in order) + "\n" for row in rows))
        flight = open_flight(path)
        np.testing.assert_array_equal(flight.attitude.q_body_ned, expected.attitude.q_body_ned)
        np.testing.assert_array_equal(flight.position.longitude_rad, expected.position.longitude_rad)


@pytest.mark.parametrize(
    "dress",
    [
        lambda text: "\ufeff" + text,
        lambda text: text.replace("\n", "\r\n"),
        lambda text: text.replace(",", ";"),
        lambda text: text.replace(",", "\t"),
        lambda text: "# from the aircraft\n\n" + text.replace("\n", "\n\n  # a remark, with a comma\n", 1),
        lambda text: text.upper().replace(",", " , "),
        lambda text: text.replace("Z,", "+00:00,"),
        lambda text: text.replace("Z,", ","),
        lambda text: text.replace("T11:", "T21:30:").replace(":30:00:", ":30:").replace("Z,", "+10:30,"),
        lambda text: text.replace("utc,", '"utc",'),
        lambda text: text.removesuffix("\n"),
        lambda text: text + "2024-03-10T11:00:00.300Z,30,-1",
        lambda text: text + "2024-03-10T11:00:00.200Z,99,0,0,0,0,0\n",
    ],
    ids=[
        "BOM",
        "CRLF",
        "semicolons",
        "tabs",
        "comments",
        "capitals",
        "offset",
        "naive",
        "half-hours",
        "quotes",
        "unended",
        "cut",
        "repeated",
    ],
)
def test_tables_of_many_dialects_are_read(path: Path, dress: object) -> None:
    path.write_text(EULER)
    expected = open_flight(path)
    path.write_bytes(dress(EULER).encode())

    flight = open_flight(path)

    np.testing.assert_allclose(flight.attitude.utc_s, expected.attitude.utc_s, rtol=0, atol=1e-6)
    np.testing.assert_array_equal(flight.attitude.q_body_ned, expected.attitude.q_body_ned)


def test_rows_out_of_order_are_sorted(path: Path) -> None:
    head, *rows = EULER.splitlines(keepends=True)
    path.write_text(head + "".join(reversed(rows)))

    assert np.all(np.diff(open_flight(path).attitude.utc_s) > 0)


def test_a_table_without_heights_is_at_sea_level(path: Path) -> None:
    path.write_text("\n".join(line.rpartition(",")[0] for line in EULER.splitlines()))

    assert open_flight(path).position.height_m.tolist() == [0.0] * 3


def test_attitude_and_position_may_have_different_rates(path: Path) -> None:
    path.write_text(EULER + "2024-03-10T11:00:00.15Z,,,,-34.9301,138.6001,\n2024-03-10T11:00:00.3Z,1,2,3,,,\n")

    flight = open_flight(path)

    assert flight.attitude.utc_s.size == 4
    assert flight.position.utc_s.size == 4


def test_a_table_may_have_body_rates(path: Path) -> None:
    head, *rows = EULER.splitlines()
    head += ",roll_rate_deg_per_s,pitch_rate_deg_per_s,yaw_rate_deg_per_s"
    path.write_text("\n".join([head, *(row + ",90,0,-45" for row in rows[:2]), rows[2] + ",,,"]))

    with open_source(path) as source:
        rates = Recording.read(source).rates

    np.testing.assert_allclose(rates.rate_rad_per_s, [[np.pi / 2, 0.0, -np.pi / 4]] * 2, rtol=0, atol=1e-12)
    np.testing.assert_allclose(rates.clock_s, ELEVEN_S + np.array([0.0, 0.1]), rtol=0, atol=1e-6)

    path.write_text(path.read_text().replace(",90,0,-45", ",90000,0,-45"))
    assert refusal(path).startswith("line 2, column roll_rate_deg_per_s: 90000 begins a turn faster than any gyro")
    path.write_text(EULER.replace("height_m", "yaw_rate_deg_per_s"))
    assert refusal(path).startswith("line 1: no column roll_rate_deg_per_s")


def test_position_start_and_offset_from_the_user_are_used(path: Path) -> None:
    path.write_text(EULER)

    flight = open_flight(path, site=HOME, utc_start=ELEVEN_S + 60.0, time_offset_s=-0.5)

    assert flight.attitude.first_s == pytest.approx(ELEVEN_S + 60.0, rel=0, abs=1e-6)
    assert flight.time_offset_s == -0.5
    assert flight.position.at(flight.attitude.first_s).height_m == 48.0


# --- tables that are refused ----------------------------------------------------------------------------------------
@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ("utc,", "time,", "line 1: no column utc (ISO 8601) or utc_s; it has time, roll_deg, "),
        ("utc,", "utc_sec,", "line 1: no column utc (ISO 8601) or utc_s (is it named 'utc_sec'?); it has "),
        ("roll_deg", "roll", "line 1: no column roll_deg (is it named 'roll'?)"),
        ("longitude_deg", "lon_deg", "line 1: no column longitude_deg (is it named 'lon_deg'?)"),
        ("roll_deg,pitch_deg,yaw_deg", "a,b,c", "line 1: no attitude: neither roll_deg, pitch_deg, yaw_deg nor qw, "),
        ("roll_deg,pitch_deg,yaw_deg", "qw,qx,q3", "line 1: no column qy"),
        ("pitch_deg", "roll_deg", "line 1: column roll_deg appears twice"),
        (",-5,", ",north,", "line 3, column pitch_deg: 'north' is not a number"),
        ("Z,10,", "Z,10;5,", "line 3, column roll_deg: '10;5' is not a number"),
        ("00.100Z", "00.100 o'clock", 'line 3, column utc: "2024-03-10T11:00:00.100 o\'clock" is not an ISO 8601 time'),
        ("2024-03-10T11:00:00.100Z", "", "line 3, column utc: '' is not an ISO 8601 time"),
        ("10,-5,0,-34.93", "10,-5,0,-91", "line 3, column latitude_deg: -91 is beyond a pole"),
        ("10,-5,0,-34.93,138.6", "10,-5,0,-34.93,1386", "line 3, column longitude_deg: 13860 is more than a turn"),
        ("10,-5,0", "10,-5", "line 3: 6 fields, where the header names 7"),
        ("10,-5,0", '"10,-5,0', "line 3: a quoted field runs over its end"),
        (
            "2024-03-10T11:00:00.1",
            "1024-03-10T11:00:00.1",
            "line 3, column utc: 1024-03-10T11:00:00.100Z is no UTC bet",
        ),
    ],
)
def test_errors_in_a_table_are_reported_with_line_and_column(path: Path, old: str, new: str, said: str) -> None:
    assert EULER.count(old) >= 1
    path.write_text(EULER.replace(old, new, 1))

    assert refusal(path).startswith(said)


def test_a_number_with_a_decimal_comma_gets_a_hint(path: Path) -> None:
    path.write_text(EULER.replace(",", ";").replace("10;-5", "10,5;-5"))

    assert refusal(path) == "line 3, column roll_deg: '10,5' is not a number; write decimals with a point"


def test_lines_are_counted_with_comments_and_blanks(path: Path) -> None:
    path.write_text("# one\n\n" + EULER.replace(",-5,", ",?,"))

    with pytest.raises(LogFormatError, match=r"line 5, column pitch_deg: '\?'") as caught:
        open_flight(path)
    assert caught.value.offset == 5


@pytest.mark.parametrize("boot", ["12.5", "1.7e12"])
def test_seconds_since_boot_and_milliseconds_are_refused_as_utc(path: Path, boot: str) -> None:
    path.write_text(f"utc_s,roll_deg,pitch_deg,yaw_deg\n{boot},0,0,0\n")

    assert refusal(path) == f"line 2, column utc_s: {boot} is no UTC between 1972 and 2100, in seconds since 1970"


def test_attitude_in_two_notations_is_refused(path: Path) -> None:
    path.write_text("utc_s,roll_deg,pitch_deg,yaw_deg,qw,qx,qy,qz\n")

    assert refusal(path).startswith("line 1: attitude twice")


def test_a_quaternion_has_unit_length(path: Path) -> None:
    path.write_text(f"utc_s,qw,qx,qy,qz\n{ELEVEN_S},1,0,0,0\n{ELEVEN_S + 1},0.9,0,0,0\n")

    assert refusal(path, site=HOME) == "line 3, column qw: 0.9 begins a quaternion that is not of unit length"


def test_a_table_without_rows_or_positions_is_refused(path: Path) -> None:
    path.write_text(EULER.splitlines()[0])
    assert refusal(path) == "a flight needs two attitude samples or more; this log has 0"

    path.write_text(f"utc_s,qw,qx,qy,qz\n{ELEVEN_S},1,0,0,0\n{ELEVEN_S + 1},1,0,0,0\n")
    assert refusal(path) == (
        "the log has no position (no columns latitude_deg, longitude_deg);"
        " give its position as latitude_deg and longitude_deg (--lat, --lon)"
    )


def test_a_table_has_one_attitude(path: Path) -> None:
    path.write_text(EULER)

    assert refusal(path, attitude="XKQ") == "a table has one attitude, not 'XKQ'; leave attitude at 'auto'"


# --- files of other kinds -------------------------------------------------------------------------------------------
@pytest.mark.parametrize(
    ("content", "said"),
    [
        (b"", "is empty: 0 bytes"),
        (b"\n\n", "has only blank lines and comments"),
        (b"ULog\x01\x12\x35\x01", "the log is cut off in its head: 8 bytes"),
        (
            b"\x00\x06\x13\x4a\x5b\x2c\x10\x00\xfd\x09\x00",
            "the log has no attitude: no ATTITUDE_QUATERNION or ATTITUDE in 0",
        ),
        (
            b"FMT, 128, 89, FMT, BBnNZ, Type,Length\n",
            "the log has no attitude: no XKQ, NKQ or ATT among the messages FMT",
        ),
        (b"\x89PNG\r\n\x1a\n\x00", "this is a PNG image (glstar reads MAVLink telemetry logs (.tlog), ArduPilot"),
        (b"MATLAB 5.0 MAT-file, written by", "this is a MATLAB file (glstar reads"),
        ("utc,roll_deg".encode("utf-16"), "this is text in UTF-16; save it as UTF-8"),
        (b"ULogEnc\x01" + bytes(30), "this is an encrypted ULog; decrypt it first"),
        (b"<!DOCTYPE html>", "this is a web page or XML"),
        (b"some notes\n", "line 1: no table of a flight: its header would name utc or utc_s, ...; this line"),
        (b"\x01\x00\x02", "this is no log that glstar knows"),
        (b"utc,\xff\n", "is no text: it is not UTF-8"),
    ],
    ids=[
        "empty",
        "blank",
        "ULog",
        "tlog",
        "text-log",
        "PNG",
        "MATLAB",
        "UTF-16",
        "encrypted",
        "HTML",
        "notes",
        "binary",
        "latin",
    ],
)
def test_files_of_other_kinds_are_identified(path: Path, content: bytes, said: str) -> None:
    path.write_bytes(content)

    assert refusal(path).startswith(said)


def test_only_telemetry_logs_accept_a_system_number(path: Path) -> None:
    path.write_text(EULER)

    assert refusal(path, sysid=2) == "is no telemetry log of several vehicles; leave out sysid, which is 2"


def test_a_missing_file_and_a_directory_have_different_messages(tmp_path: Path) -> None:
    assert refusal(tmp_path / "gone.BIN") == "there is no such file; demo is the bundled flight"
    assert refusal(tmp_path) == "is a directory; name the log inside it"


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="no named pipes here")
def test_a_pipe_is_refused_without_waiting(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe")

    assert refusal(tmp_path / "pipe") == "is no file that can be read twice; save the log to disk first"


@pytest.mark.skipif(not hasattr(os, "geteuid") or os.geteuid() == 0, reason="root reads everything")
def test_a_file_without_read_permission_is_refused(path: Path) -> None:
    path.write_text(EULER)
    path.chmod(0)

    assert refusal(path) == "cannot be read: Permission denied"


# --- scripted flights -----------------------------------------------------------------------------------------------
def test_a_scripted_turn_has_a_constant_rate() -> None:
    flight = ScriptedFlight.steady(
        HOME, ELEVEN_S, duration_s=5.0, yaw_rad=1.0, yaw_rate_rad_per_s=np.deg2rad(8.0)
    ).flight()

    at_s = ELEVEN_S + np.array([0.0, 1.2345, 5.0])
    expected = quaternion_from_euler(0.0, 0.0, 1.0 + np.deg2rad(8.0) * (at_s - ELEVEN_S))
    np.testing.assert_allclose(flight.attitude.at(at_s), expected, rtol=0, atol=1e-7)
    assert flight.attitude.rate_hz == pytest.approx(200.0, abs=0.1)
    assert flight.position.at(ELEVEN_S + 2.0).longitude_rad == pytest.approx(HOME.longitude_rad, abs=1e-12)
    assert flight.name == "scripted flight"


def test_a_script_is_a_telemetry_source_like_any_other() -> None:
    with ScriptedFlight.steady(HOME, ELEVEN_S) as source:
        assert isinstance(source, TelemetrySource)
        flight = read_flight(source, FlightOptions(time_offset_s=2.0))

    assert (flight.attitude.first_s, flight.time_offset_s) == (ELEVEN_S, 2.0)
