"""DataFlash logs: real ones against their facts and against pymavlink, and written ones for every trap."""

import os
import struct
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import ClassVar

import numpy as np
import pytest
from pymavlink.DFReader import DFReader_binary

from glstar.errors import LogFormatError
from glstar.resources import asset
from glstar.rotation import conjugate, multiply, quaternion_from_euler
from glstar.site import Site
from glstar.telemetry import DataFlashReader, TelemetrySource, open_flight
from glstar.telemetry.dataflash import _Records
from glstar.timescale import parse_utc

CHECKOUT = Path(__file__).parents[2]
LOGS = CHECKOUT.parent / "shared" / "logs"
ADELAIDE = LOGS / "plane_SITL_adelaide_200Hz.BIN"
SKYWALKER = LOGS / "plane_skywalkerX8_TestLog2.reenc.BIN"
DEMO = asset("adelaide.BIN")

needs_logs = pytest.mark.skipif(not ADELAIDE.exists(), reason=f"no sample logs in {LOGS}")

HOME = Site(latitude_rad=np.deg2rad(-34.93), longitude_rad=np.deg2rad(138.60), height_m=48.0)
# GPS week 2305 begins on 2024-03-10; 11:00:00 UTC is 18 s later by GPS time.
WEEK, ELEVEN_MS = 2305, (11 * 3600 + 18) * 1000
ELEVEN_S = parse_utc("2024-03-10T11:00:00Z")
BOOT_S = 30.0


def angle_deg(q1: np.ndarray, q2: np.ndarray) -> np.ndarray:
    turn = multiply(q1, conjugate(q2))
    return np.rad2deg(2 * np.arctan2(np.linalg.norm(turn[..., 1:], axis=-1), np.abs(turn[..., 0])))


class Log:
    """A DataFlash file, written record by record; the first of a name brings its definition."""

    CODES: ClassVar = {"B": "B", "Q": "Q", "H": "H", "I": "I", "f": "f", "c": "h", "C": "H", "L": "i", "Z": "64s"}

    def __init__(self) -> None:
        self.data = b""
        self.kinds: dict[str, int] = {}

    def add(self, name: str, letters: str, fields: str, *values: float) -> "Log":
        body = struct.Struct("<" + "".join(self.CODES[letter] for letter in letters))
        if name not in self.kinds:
            self.kinds[name] = 1 + len(self.kinds)
            layout = (self.kinds[name], body.size + 3, name.encode(), letters.encode(), fields.encode())
            self.data += b"\xa3\x95\x80" + struct.pack("<BB4s16s64s", *layout)
        self.data += bytes([0xA3, 0x95, self.kinds[name]]) + body.pack(*values)
        return self

    def att(
        self, t_s: float, roll_deg: float = 0.0, pitch_deg: float = 0.0, yaw_deg: float = 0.0, aekf: int = 3
    ) -> None:
        angles = (round(100 * angle) for angle in (roll_deg, pitch_deg, yaw_deg))
        self.add("ATT", "QccCB", "TimeUS,Roll,Pitch,Yaw,AEKF", round(t_s * 1e6), *angles, aekf)

    def xkq(self, t_s: float, lane: int, yaw_deg: float, name: str = "XKQ") -> None:
        q_ned_body = conjugate(quaternion_from_euler(0.0, 0.0, np.deg2rad(yaw_deg)))
        self.add(name, "QBffff", "TimeUS,C,Q1,Q2,Q3,Q4", round(t_s * 1e6), lane, *q_ned_body)

    def xkf4(self, t_s: float, primary: int) -> None:
        self.add("XKF4", "QBB", "TimeUS,C,PI", round(t_s * 1e6), 0, primary)

    def pos(self, t_s: float, latitude_deg: float = -34.93, longitude_deg: float = 138.60) -> None:
        place = (round(latitude_deg * 1e7), round(longitude_deg * 1e7), 48.0)
        self.add("POS", "QLLf", "TimeUS,Lat,Lng,Alt", round(t_s * 1e6), *place)

    def gps(
        self,
        t_s: float,
        *,
        lag_s: float = 0.020,
        status: int = 3,
        week: int = WEEK,
        receiver: int = 0,
        in_use: int = 1,
        latitude_deg: float = -34.93,
    ) -> None:
        """Write the sample of boot time `t_s`, `lag_s` after it was taken; boot time 30 s is 11:00 UTC."""
        ms = ELEVEN_MS + round((t_s - BOOT_S) * 1000)
        written_us, place = round((t_s + lag_s) * 1e6), (round(latitude_deg * 1e7), 1386000000, 48.0)
        self.add(
            "GPS",
            "QBBIHLLfB",
            "TimeUS,I,Status,GMS,GWk,Lat,Lng,Alt,U",
            written_us,
            receiver,
            status,
            ms,
            week,
            *place,
            in_use,
        )

    def gpa(self, t_s: float, *, lag_s: float = 0.0, receiver: int = 0) -> None:
        self.add("GPA", "QBI", "TimeUS,I,SMS", round((t_s + lag_s) * 1e6), receiver, round(t_s * 1000))

    def save(self, path: Path) -> Path:
        path.write_bytes(self.data)
        return path


def times(duration_s: float = 2.0, rate_hz: float = 25.0) -> Iterator[float]:
    return (BOOT_S + i / rate_hz for i in range(int(duration_s * rate_hz) + 1))


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "log.BIN"


@pytest.fixture
def level() -> Log:
    """A log of level flight to the north, with place and UTC."""
    log = Log()
    for t in times():
        log.att(t)
        log.pos(t)
    for t in times(rate_hz=5):
        log.gps(t)
    return log


# --- real logs ------------------------------------------------------------------------------------------------------
@needs_logs
def test_the_adelaide_flight_is_what_was_flown() -> None:
    flight = open_flight(ADELAIDE)

    assert flight.attitude.first_s == pytest.approx(parse_utc("2024-03-10T11:00:34.265Z"), abs=0.002)
    assert flight.attitude.last_s - flight.attitude.first_s == pytest.approx(134.475, abs=0.001)
    assert flight.attitude.rate_hz == pytest.approx(200.0, abs=0.1)
    assert flight.attitude.gaps == ()
    assert flight.attitude_source == "XKQ lane 0, nearest to ATT, 200.1 Hz"
    assert flight.utc_source == "GPS time when logged (no GPA), 672 fixes, 18 leap seconds"
    site = flight.position.at(flight.attitude.first_s)
    assert np.rad2deg([site.latitude_rad, site.longitude_rad]) == pytest.approx([-34.81, 138.62], abs=1e-6)


@needs_logs
def test_a_flight_of_2013_had_16_leap_seconds() -> None:
    flight = open_flight(SKYWALKER)

    assert flight.attitude.first_s == pytest.approx(parse_utc("2013-11-29T22:00:00Z"), abs=1.0)
    assert flight.attitude.last_s - flight.attitude.first_s == pytest.approx(613.1, abs=0.1)
    assert flight.attitude.rate_hz == pytest.approx(50.0, abs=0.1)
    assert "16 leap seconds" in flight.utc_source
    assert (flight.attitude_source, flight.position_source) == ("ATT, 50.0 Hz", "GPS")
    site = flight.position.at(flight.attitude.first_s)
    assert np.rad2deg([site.latitude_rad, site.longitude_rad]) == pytest.approx([-37.96, 144.765], abs=0.001)


@pytest.mark.parametrize("log", [pytest.param(ADELAIDE, marks=needs_logs), DEMO], ids=["whole", "demo"])
def test_the_ekf_says_in_quaternions_what_att_says_in_angles(log: Path) -> None:
    ekf, att = open_flight(log).attitude, open_flight(log, attitude="ATT").attitude

    common = np.intersect1d(ekf.utc_s, att.utc_s, return_indices=True)
    apart_deg = angle_deg(ekf.q_body_ned[common[1]], att.q_body_ned[common[2]])

    assert common[0].size > 1300
    assert apart_deg.max() < 0.02  # ATT is rounded to 0.01 deg, three times


@needs_logs
def test_the_ekf_is_near_the_simulators_truth() -> None:
    ekf, truth = open_flight(ADELAIDE).attitude, open_flight(ADELAIDE, attitude="SIM").attitude

    apart_deg = angle_deg(ekf.q_body_ned, truth.at(ekf.utc_s.clip(truth.first_s, truth.last_s)))

    assert np.median(apart_deg) < 0.5
    assert apart_deg.max() < 1.4


@needs_logs
def test_the_demonstration_flight_is_cut_from_the_whole_one(tmp_path: Path) -> None:
    script = [sys.executable, "-m", "tests.make_demo_flight", ADELAIDE, "-o", tmp_path / "demo.BIN"]
    subprocess.run(script, cwd=CHECKOUT, check=True, capture_output=True)

    assert (tmp_path / "demo.BIN").read_bytes() == DEMO.read_bytes()


def test_the_demonstration_flight_is_small_and_whole() -> None:
    flight = open_flight(DEMO)

    assert DEMO.stat().st_size <= 500_000
    assert flight.attitude.last_s - flight.attitude.first_s > 134
    assert flight.attitude.rate_hz == pytest.approx(100.0, abs=0.1)
    assert flight.attitude.gaps == ()


@pytest.mark.parametrize(
    "log",
    [DEMO, *(pytest.param(log, marks=needs_logs) for log in (SKYWALKER, ADELAIDE))],
    ids=["demo", "skywalker", "adelaide"],
)
def test_columns_hold_what_pymavlink_reads(log: Path) -> None:
    records = _Records(str(log))
    with DFReader_binary(str(log)) as reader:
        counted = {name: len(reader.offsets[kind]) for name, kind in reader.name_to_id.items()}
        assert {name: records.count(name) for name in records.names} == {n: c for n, c in counted.items() if c}
        for name in ("XKQ", "ATT", "POS", "GPS"):
            if name not in records:
                continue
            fields = records.fields(name)
            reader.rewind()
            first = [reader.recv_match(type=name, strict=True) for _ in range(min(records.count(name), 500))]
            columns = records.columns(name, *fields)
            for field, column in zip(fields, columns, strict=True):
                np.testing.assert_array_equal(column[: len(first)], [getattr(m, field) for m in first], err_msg=field)


# --- which attitude -------------------------------------------------------------------------------------------------
@needs_logs
def test_any_attitude_can_be_named() -> None:
    for asked, told in {
        "ATT": "ATT",
        "att": "ATT",
        "XKQ1": "XKQ lane 1",
        "XKQ[1]": "XKQ lane 1",
        "AHR2": "AHR2",
        "SIM": "SIM",
    }.items():
        assert open_flight(ADELAIDE, attitude=asked).attitude_source == f"{told}, 200.1 Hz"


@needs_logs
@pytest.mark.parametrize("unknown", ["VISP", "XKQ2", "[", ""])
def test_an_unknown_attitude_is_answered_with_the_known_ones(unknown: str) -> None:
    with pytest.raises(LogFormatError) as caught:
        open_flight(ADELAIDE, attitude=unknown)

    offered = "AHR2 200.1 Hz; ATT 200.1 Hz; SIM 200.1 Hz; XKQ lane 0 and 1 200.1 Hz"
    assert str(caught.value) == f"{ADELAIDE}: the log has no attitude {unknown!r}; it has {offered}"


def test_the_primary_lane_counts_while_it_is_primary_and_a_switch_is_no_rotation(path: Path, level: Log) -> None:
    for t in times():
        level.xkq(t, 0, 10.0)
        level.xkq(t, 1, 17.6)
        level.xkf4(t, primary=0 if t < BOOT_S + 0.999 else 1)

    flight = open_flight(level.save(path))

    q = flight.attitude.at(ELEVEN_S + np.array([0.5, 1.5]))
    np.testing.assert_allclose(q, quaternion_from_euler(0.0, 0.0, np.deg2rad([10.0, 17.6])), atol=1e-6)
    [gap] = flight.attitude.gaps
    np.testing.assert_allclose([gap.start_utc_s, gap.stop_utc_s], [ELEVEN_S + 0.96, ELEVEN_S + 1.0], atol=1e-5)
    assert flight.attitude_source == "XKQ lane 0 and 1 by XKF4.PI, 25.0 Hz"


def test_a_primary_lane_that_is_not_logged_leaves_the_lane_nearest_to_att(path: Path, level: Log) -> None:
    for t in times():
        level.xkq(t, 0, 10.0)
        level.xkq(t, 1, 0.02)
        level.xkf4(t, primary=7)

    assert open_flight(level.save(path)).attitude_source == "XKQ lane 1, nearest to ATT, 25.0 Hz"


def test_without_xkf4_and_att_the_lowest_lane_is_taken_and_said(path: Path) -> None:
    log = Log()
    for t in times():
        log.xkq(t, 0, 10.0)
        log.xkq(t, 1, 17.6)

    flight = open_flight(log.save(path), utc_start=ELEVEN_S, site=HOME)

    assert flight.attitude_source == "XKQ lane 0, the lowest of 0 and 1, 25.0 Hz"


def test_lanes_had_messages_of_their_own_once(path: Path) -> None:
    log = Log()
    for t in times():
        log.xkq(t, 0, 10.0, name="NKQ1")
        log.xkq(t, 0, 17.6, name="NKQ2")
        log.att(t, yaw_deg=17.6)

    flight = open_flight(log.save(path), utc_start=ELEVEN_S, site=HOME)

    assert flight.attitude_source == "NKQ lane 1, nearest to ATT, 25.0 Hz"


def test_ekf2_is_believed_where_it_flies(path: Path, level: Log) -> None:
    log = Log()
    for t in times():
        log.att(t, aekf=2)
        log.xkq(t, 0, 10.0)
        log.xkq(t, 0, 5.0, name="NKQ")

    assert open_flight(log.save(path), utc_start=ELEVEN_S, site=HOME).attitude_source == "NKQ lane 0, 25.0 Hz"


def test_an_ekf_before_alignment_says_nothing(path: Path, level: Log) -> None:
    for t in times():
        level.xkq(t, 0, 0.0 if t < BOOT_S + 0.999 else 90.0)

    flight = open_flight(level.save(path))

    assert flight.attitude.first_s == pytest.approx(ELEVEN_S + 1.0, abs=1e-5)


def test_att_is_taken_where_there_is_no_ekf_quaternion(path: Path) -> None:
    log = Log()
    for t in times():
        log.att(t, 10.0, -5.0, 270.0)
        log.pos(t)
        log.gps(t)

    flight = open_flight(log.save(path))

    expected = quaternion_from_euler(*np.deg2rad([10.0, -5.0, 270.0]))
    assert angle_deg(flight.attitude.q_body_ned, expected).max() < 1e-9
    assert flight.attitude_source == "ATT, 25.0 Hz"


def test_a_log_without_attitude_says_what_it_holds(path: Path) -> None:
    log = Log()
    for t in times():
        log.pos(t)
        log.gps(t)

    with pytest.raises(LogFormatError, match=r"no attitude: no XKQ, NKQ or ATT among the messages GPS, POS$"):
        open_flight(log.save(path))


def test_a_log_with_one_attitude_is_too_short(path: Path) -> None:
    log = Log()
    log.att(BOOT_S)

    with pytest.raises(LogFormatError, match="needs two attitude samples or more; this log has 1"):
        open_flight(log.save(path))


def test_an_old_log_in_milliseconds_is_refused_in_words(path: Path) -> None:
    log = Log()
    for ms in range(0, 1000, 20):
        log.add("ATT", "IccC", "TimeMS,Roll,Pitch,Yaw", ms, 0, 0, 0)

    with pytest.raises(LogFormatError, match="TimeMS"):
        open_flight(log.save(path))


# --- which UTC ------------------------------------------------------------------------------------------------------
def test_gps_time_holds_at_the_moment_of_its_sample_not_of_its_logging(path: Path, level: Log) -> None:
    log = Log()
    for t in times():
        log.att(t)
        log.pos(t)
    for i, t in enumerate(times(rate_hz=5)):
        lag_s = 0.016 + 0.01 * (i % 3)
        log.gpa(t - 0.08, lag_s=lag_s + 0.08, receiver=1)  # written in the same breath, sampled earlier
        log.gps(t, lag_s=lag_s)
        log.gpa(t, lag_s=lag_s)

    flight = open_flight(log.save(path))

    assert flight.attitude.first_s == pytest.approx(ELEVEN_S, abs=1e-6)
    assert flight.utc_source == "GPS time at GPA.SMS, 11 fixes, 18 leap seconds"


def test_a_late_first_fix_moves_nothing(path: Path) -> None:
    log = Log()
    for t in times():
        log.att(t)
        log.pos(t)
    for i, t in enumerate(times(rate_hz=5)):
        log.gps(t, lag_s=0.140 if i == 0 else 0.020)

    assert open_flight(log.save(path)).attitude.first_s == pytest.approx(ELEVEN_S, abs=1e-6)


def test_records_without_a_fix_tell_no_time(path: Path) -> None:
    log = Log()
    for t in times():
        log.att(t)
        log.pos(t)
    for t in times(rate_hz=5):
        log.gps(t, status=1, week=1800)
        log.gps(t, status=3, week=0)
    log.gps(BOOT_S + 1.0)

    assert open_flight(log.save(path)).attitude.first_s == pytest.approx(ELEVEN_S, abs=1e-6)


@pytest.mark.parametrize(
    ("gps", "reason"),
    [
        (None, "it has no GPS records"),
        ({"status": 1}, "its GPS never had a 3D fix and a week"),
        ({"week": 0}, "its GPS never had a 3D fix and a week"),
        ({"week": WEEK - 2048}, "its GPS says week 257, 1985: the receiver's week has rolled over"),
    ],
    ids=["no GPS", "no fix", "week 0", "rolled over"],
)
def test_a_log_without_utc_says_why_and_takes_it_from_the_user(
    path: Path, gps: dict[str, int] | None, reason: str
) -> None:
    log = Log()
    for t in times():
        log.att(t)
        log.pos(t)
        if gps is not None:
            log.gps(t, **gps)
    log.save(path)

    with pytest.raises(LogFormatError) as caught:
        open_flight(path)
    remedy = "give the UTC of its first attitude as utc_start (--utc-start)"
    assert str(caught.value) == f"{path}: the log has no UTC ({reason}); {remedy}"

    flight = open_flight(path, utc_start=ELEVEN_S + 7.0)
    assert flight.attitude.first_s == ELEVEN_S + 7.0
    assert flight.utc_source == "given: the first attitude at 2024-03-10T11:00:07.000000Z"


def test_a_camera_clock_ahead_of_the_log_sees_everything_later(path: Path, level: Log) -> None:
    level.save(path)

    flight = open_flight(path, time_offset_s=0.25)

    assert flight.attitude.first_s == pytest.approx(ELEVEN_S + 0.25, abs=1e-6)
    assert flight.position.utc_s[0] == pytest.approx(ELEVEN_S + 0.25, abs=1e-6)


# --- which place ----------------------------------------------------------------------------------------------------
def test_gps_tells_the_place_where_there_is_no_pos(path: Path) -> None:
    log = Log()
    for t in times():
        log.att(t)
        log.gps(t, receiver=0, in_use=0, latitude_deg=10.0)
        log.gps(t, receiver=1, in_use=1, latitude_deg=-34.93)
    log.pos(BOOT_S, 0.0, 0.0)  # an EKF without an origin

    flight = open_flight(log.save(path))

    assert flight.position_source == "GPS"
    np.testing.assert_allclose(np.rad2deg(flight.position.latitude_rad), -34.93, atol=1e-9)


def test_a_log_without_a_place_says_so_and_takes_it_from_the_user(path: Path) -> None:
    log = Log()
    for t in times():
        log.att(t)
    log.save(path)

    with pytest.raises(LogFormatError, match=r"no position \(it has neither POS nor GPS records\); give its place"):
        open_flight(path, utc_start=ELEVEN_S)

    flight = open_flight(path, utc_start=ELEVEN_S, site=HOME)
    assert flight.position.at(ELEVEN_S).latitude_rad == HOME.latitude_rad
    assert flight.position_source == "given"


def test_what_a_log_lacks_is_said_at_once(path: Path) -> None:
    log = Log()
    for t in times():
        log.att(t)

    with pytest.raises(LogFormatError) as caught:
        open_flight(log.save(path))

    assert str(caught.value) == (
        f"{path}: the log has no UTC (it has no GPS records) and no position (it has neither POS nor GPS records);"
        " give the UTC of its first attitude as utc_start (--utc-start)"
        " and its place as latitude_deg and longitude_deg (--lat, --lon)"
    )


# --- damage ---------------------------------------------------------------------------------------------------------
def test_a_log_cut_inside_a_record_ends_with_the_one_before(path: Path, level: Log) -> None:
    path.write_bytes(DEMO.read_bytes()[:200_001])

    flight = open_flight(path)

    assert 30 < flight.attitude.last_s - flight.attitude.first_s < 134


@pytest.mark.parametrize("size", [3, 50, 89, 95])
def test_a_log_cut_at_its_head_holds_no_flight(path: Path, size: int) -> None:
    path.write_bytes(DEMO.read_bytes()[:size])

    with pytest.raises(LogFormatError, match=r"cut off or damaged|no attitude"):
        open_flight(path)


def test_bad_bytes_cost_the_records_they_lie_in_and_no_others(path: Path) -> None:
    data = bytearray(DEMO.read_bytes())
    data[250_000:250_100] = bytes(100)
    path.write_bytes(data)

    whole, damaged = open_flight(DEMO).attitude, open_flight(path).attitude

    assert 1 <= whole.utc_s.size - damaged.utc_s.size <= 5
    np.testing.assert_array_equal(damaged.utc_s, whole.utc_s[np.isin(whole.utc_s, damaged.utc_s)])


def test_a_record_with_an_absurd_time_or_place_is_left_out(path: Path, level: Log) -> None:
    level.att(1e9)
    level.pos(1e9)
    level.pos(BOOT_S + 2.02, 89.0, 10.0)
    for t in (2.04, 2.08, 2.12):
        level.att(BOOT_S + t)
        level.pos(BOOT_S + t)

    flight = open_flight(level.save(path))

    assert flight.attitude.last_s == pytest.approx(ELEVEN_S + 2.12, abs=1e-6)
    assert flight.attitude.utc_s.size == 54
    np.testing.assert_allclose(np.rad2deg(flight.position.latitude_rad), -34.93, atol=1e-9)


def test_a_damaged_lane_number_makes_no_lane(path: Path, level: Log) -> None:
    for t in times(20.0):
        level.xkq(t, 0, 0.01)
    level.xkq(BOOT_S + 20.01, 77, 0.0001)

    assert open_flight(level.save(path)).attitude_source == "XKQ lane 0, 25.0 Hz"


def test_nothing_is_printed_whatever_the_damage(path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    data = bytearray(DEMO.read_bytes())
    data[100:140] = b"\xff" * 40  # inside of a definition
    data[-5:] = b""
    path.write_bytes(data)

    open_flight(path)

    assert capfd.readouterr() == ("", "")


# --- manners --------------------------------------------------------------------------------------------------------
def test_a_reader_is_a_telemetry_source_and_may_be_closed_twice(path: Path, level: Log) -> None:
    with DataFlashReader(level.save(path)) as source:
        assert isinstance(source, TelemetrySource)
        assert len(list(source.samples())) == 3
    source.close()
    path.unlink()


def test_importing_telemetry_imports_no_pymavlink_and_reading_leaves_the_environment_alone() -> None:
    program = f"""
import os, sys
import glstar.telemetry
heavy = [name for name in ("pymavlink", "moderngl", "cv2") if name in sys.modules]
assert not heavy, heavy
before = dict(os.environ)
glstar.telemetry.open_flight({str(DEMO)!r})
assert "pymavlink.DFReader" in sys.modules
assert dict(os.environ) == before
"""
    clean = {key: value for key, value in os.environ.items() if not key.startswith("MAVLINK")}
    done = subprocess.run([sys.executable, "-c", program], env=clean, capture_output=True, text=True, check=False)

    assert (done.returncode, done.stdout, done.stderr) == (0, "", "")
