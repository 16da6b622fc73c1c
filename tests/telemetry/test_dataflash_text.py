"""DataFlash logs as text: they give the flight of the binary log, and damaged lines are dropped."""

from pathlib import Path

import numpy as np
import pytest
from pymavlink.DFReader import DFReader_text

from glstar.errors import LogFormatError
from glstar.system.resources import asset
from glstar.telemetry import DataFlashReader, open_flight
from glstar.telemetry.dataflash.records import BinaryRecords
from glstar.telemetry.dataflash.text import TextRecords
from tests.support.dataflash import BOOT_S, ELEVEN_S, HOME, TextLog, angle_deg, as_text, beginning, times

LOGS = Path(__file__).parents[3] / "shared" / "logs"
ADELAIDE, SKYWALKER = LOGS / "plane_SITL_adelaide_200Hz.BIN", LOGS / "plane_skywalkerX8_TestLog2.reenc.BIN"
DEMO = asset("adelaide.BIN")

needs_logs = pytest.mark.skipif(not ADELAIDE.exists(), reason=f"no sample logs in {LOGS}")

# Floats have six decimals: each of four components has an error of at most 0.5e-6, the angle twice their norm.
SIX_DECIMALS_DEG = np.rad2deg(2 * np.sqrt(4) * 0.5e-6) * 1.001


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "log.log"


@pytest.fixture
def level() -> TextLog:
    """A log of level flight to the north, with place and UTC."""
    log = TextLog()
    for t in times():
        log.att(t)
        log.pos(t)
    for t in times(rate_hz=5):
        log.gps(t)
    return log


# --- real logs ------------------------------------------------------------------------------------------------------
@pytest.mark.parametrize(
    "log",
    [DEMO, *(pytest.param(log, marks=needs_logs) for log in (SKYWALKER, ADELAIDE))],
    ids=["demo", "skywalker", "adelaide"],
)
def test_a_log_written_as_text_is_the_same_flight(path: Path, log: Path) -> None:
    log = beginning(log, path.parent)
    path.write_bytes(as_text(log))

    binary, text = open_flight(log), open_flight(path)

    np.testing.assert_array_equal(text.attitude.utc_s, binary.attitude.utc_s)
    assert angle_deg(text.attitude.q_body_ned, binary.attitude.q_body_ned).max() < SIX_DECIMALS_DEG
    np.testing.assert_array_equal(text.position.utc_s, binary.position.utc_s)
    np.testing.assert_allclose(text.position.latitude_rad, binary.position.latitude_rad, rtol=0, atol=1e-15)
    np.testing.assert_allclose(text.position.height_m, binary.position.height_m, rtol=0, atol=0.5e-6)
    assert (text.attitude_source, text.position_source, text.utc_source) == (
        binary.attitude_source,
        binary.position_source,
        binary.utc_source,
    )
    with DataFlashReader(log) as one, DataFlashReader(path) as other:
        assert other.facts().firmware == one.facts().firmware
        assert other.facts().format == "ArduPilot DataFlash as text"
        assert [name for name, _ in other.attitudes()] == [name for name, _ in one.attitudes()]


def test_columns_hold_what_pymavlink_reads_of_a_text(path: Path) -> None:
    path.write_bytes(as_text(DEMO))
    records = TextRecords(str(path))

    assert [(name, records.count(name)) for name in records.names if name != "FMT"] == [
        (name, of_binary.count(name))
        for of_binary in [BinaryRecords(str(DEMO))]
        for name in of_binary.names
        if name != "FMT"
    ]
    with DFReader_text(str(path)) as reader:
        for name in ("XKQ", "ATT", "POS", "GPS"):
            fields = records.fields(name)
            reader.rewind()
            messages = [reader.recv_match(type=name, strict=True) for _ in range(records.count(name))]
            for field, column in zip(fields, records.columns(name, *fields), strict=True):
                np.testing.assert_array_equal(column, [getattr(m, field) for m in messages], err_msg=field)


# --- text before and between the records ----------------------------------------------------------------------------
@pytest.mark.parametrize(
    "banner",
    [
        b"\xef\xbb\xbf",
        b"\r\n\r\n\n",
        b"Init ArduPlane V2.74\r\n\r\nFree RAM: 4049\r\nLog]: dump 7\r\n",
        b"1, 2, 3\n,\n,,,,\nFMT\n",
    ],
    ids=["BOM", "blank lines", "console", "junk"],
)
def test_a_text_may_begin_with_lines_that_are_no_records(path: Path, level: TextLog, banner: bytes) -> None:
    path.write_bytes(banner + level.data)

    assert open_flight(path).attitude.utc_s.size == 51


def test_spaces_after_commas_are_ignored(path: Path, level: TextLog) -> None:
    path.write_bytes(level.data.replace(b", ", b",").replace(b"\n", b"\r\n"))

    assert open_flight(path).attitude.utc_s.size == 51


def test_a_message_may_contain_commas(path: Path, level: TextLog) -> None:
    level.msg(BOOT_S, "Mission: 1, 2, and ArduPlane V4.5.1 (1a2b3c4d)")

    with DataFlashReader(level.save(path)) as source:
        assert source.facts().firmware == "ArduPlane V4.5.1 (1a2b3c4d)"


# --- damage ---------------------------------------------------------------------------------------------------------
def test_a_truncated_last_line_is_dropped(path: Path, level: TextLog) -> None:
    level.att(BOOT_S + 2.04, yaw_deg=123.45)
    path.write_bytes(level.data[:-2])

    assert open_flight(path).attitude.utc_s.size == 51


@pytest.mark.parametrize(
    "line",
    [
        b"ATT, 30500000, 1.00, 2.00, 3.00\n",
        b"ATT, 30500000, 1.00, 2.00, 3.00, 3, 7\n",
        b"ATT, 30500000, nan, 2.00, 3.00, 3\n",
        b"ATT, 30500000, 1.00, -inf, 3.00, 3\n",
        b"ATT, 3050x000, 1.00, 2.00, 3.00, 3\n",
        b"ATT, 9e307, 1.00, 2.00, 3.00, 3\n",
        b"ATT, 30500000, 1.#QNAN, 2.00, 3.00, 3\n",
        b"ATT, " + b"9" * 5000 + b", 1.00, 2.00, 3.00, 3\n",
        b"ATT\n",
        b"\x00\xff\xfe,,,\n",
        b"x" * 9_000_000 + b"\n",
    ],
)
def test_a_damaged_line_loses_only_itself(path: Path, level: TextLog, line: bytes) -> None:
    half = level.data.index(b"\n", len(level.data) // 2) + 1
    path.write_bytes(level.data[:half] + line + level.data[half:])

    whole = open_flight(level.save(path.with_name("whole.log"))).attitude
    damaged = open_flight(path).attitude

    np.testing.assert_array_equal(damaged.utc_s, whole.utc_s)
    np.testing.assert_array_equal(damaged.q_body_ned, whole.q_body_ned)


def test_a_text_without_attitude_is_refused_with_its_last_line(path: Path) -> None:
    log = TextLog()
    log.pos(BOOT_S)
    log.pos(BOOT_S + 1.0)
    path.write_bytes(log.data + b"rubbish\nATT, 1, 2\n")

    with pytest.raises(LogFormatError, match=r"among the messages FMT, POS in 3 lines of 5$") as caught:
        open_flight(path)
    assert caught.value.offset == 3


def test_a_text_with_definitions_only_is_no_flight(path: Path) -> None:
    path.write_bytes(b"FMT, 128, 89, FMT, BBnNZ, Type,Length,Name,Format,Columns\n")

    with pytest.raises(LogFormatError, match="no attitude"):
        open_flight(path)


def test_a_text_truncated_in_its_first_line_has_no_record(path: Path) -> None:
    path.write_bytes(b"FMT, 128, 89, FMT, BBn")

    with pytest.raises(LogFormatError, match="no whole record in 0 lines"):
        open_flight(path)


def test_a_log_without_utc_and_place_takes_them_from_the_user(path: Path) -> None:
    log = TextLog()
    for t in times():
        log.xkq(t, 0, 45.0)

    flight = open_flight(log.save(path), utc_start=ELEVEN_S, site=HOME)

    assert flight.attitude_source == "XKQ lane 0, 25.0 Hz"


def test_a_text_may_be_closed_twice_and_its_file_removed(path: Path, level: TextLog) -> None:
    with DataFlashReader(level.save(path)) as source:
        list(source.samples())
    source.close()
    path.unlink()


def test_what_mavlogdump_prints_is_named(path: Path) -> None:
    path.write_text("2024-03-10 20:30:34.26: ATT {TimeUS : 34265000, Roll : 0.0, Pitch : 0.1, Yaw : 90.0}\n")

    with pytest.raises(LogFormatError, match=r"this is what mavlogdump\.py prints; give the log itself"):
        open_flight(path)
