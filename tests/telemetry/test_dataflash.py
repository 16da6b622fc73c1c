"""DataFlash logs: real ones, compared with known facts and pymavlink, and written ones for special cases."""

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from pymavlink.DFReader import FORMAT_TO_STRUCT, DFReader_binary

from glstar.errors import LogFormatError
from glstar.rotation import conjugate, multiply, quaternion_from_euler
from glstar.sky.place.timescale import parse_utc
from glstar.system.resources import asset
from glstar.telemetry import DataFlashReader, LogFacts, RateSamples, TelemetrySource, open_flight
from glstar.telemetry.dataflash.records import _DIVISORS, _TYPES, BinaryRecords
from tests.support.dataflash import BOOT_S, ELEVEN_S, HOME, WEEK, Log, TextLog, angle_deg, beginning, times

CHECKOUT = Path(__file__).parents[2]
LOGS = CHECKOUT.parent / "shared" / "logs"
ADELAIDE = LOGS / "plane_SITL_adelaide_200Hz.BIN"
SKYWALKER = LOGS / "plane_skywalkerX8_TestLog2.reenc.BIN"
DEMO = asset("adelaide.BIN")

needs_logs = pytest.mark.skipif(not ADELAIDE.exists(), reason=f"no sample logs in {LOGS}")


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "log.BIN"


@pytest.fixture
def level() -> Log:
    """Return a log of level flight to the north, with position and UTC."""
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
    assert flight.attitude_source == "XKQ lane 0, nearest to ATT, 200.0 Hz"
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
def test_quaternions_of_the_ekf_agree_with_att(log: Path) -> None:
    ekf, att = open_flight(log).attitude, open_flight(log, attitude="ATT").attitude

    common = np.intersect1d(ekf.utc_s, att.utc_s, return_indices=True)
    difference_deg = angle_deg(ekf.q_body_ned[common[1]], att.q_body_ned[common[2]])

    assert common[0].size > 1300
    assert difference_deg.max() < 0.02  # ATT is rounded to 0.01 deg, three times


@needs_logs
def test_the_ekf_is_near_the_simulators_truth() -> None:
    ekf, truth = open_flight(ADELAIDE).attitude, open_flight(ADELAIDE, attitude="SIM").attitude

    difference_deg = angle_deg(ekf.q_body_ned, truth.at(ekf.utc_s.clip(truth.first_s, truth.last_s)))

    assert np.median(difference_deg) < 0.5
    assert difference_deg.max() < 1.4


@needs_logs
def test_the_demonstration_flight_is_part_of_the_simulated_log(tmp_path: Path) -> None:
    script = [sys.executable, "-m", "tests.scripts.make_demo_flight", ADELAIDE, "-o", tmp_path / "demo.BIN"]
    subprocess.run(script, cwd=CHECKOUT, check=True, capture_output=True)

    assert (tmp_path / "demo.BIN").read_bytes() == DEMO.read_bytes()


def test_the_demonstration_flight_is_small_and_complete() -> None:
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
def test_columns_hold_what_pymavlink_reads(log: Path, tmp_path: Path) -> None:
    log = beginning(log, tmp_path)
    records = BinaryRecords(str(log))
    with DFReader_binary(str(log)) as reader:
        counted = {name: len(reader.offsets[kind]) for name, kind in reader.name_to_id.items()}
        assert {name: records.count(name) for name in records.names} == {n: c for n, c in counted.items() if c}
        for name in ("XKQ", "ATT", "AHR2", "SIM", "POS", "GPS", "IMU"):
            if name not in records:
                continue
            fields = records.fields(name)
            reader.rewind()
            messages = [reader.recv_match(type=name, strict=True) for _ in range(records.count(name))]
            for field, column in zip(fields, records.columns(name, *fields), strict=True):
                np.testing.assert_array_equal(column, [getattr(m, field) for m in messages], err_msg=field)
        for name, field in (("MSG", "Message"), ("PARM", "Name")):
            reader.rewind()
            texts = [getattr(reader.recv_match(type=name, strict=True), field) for _ in range(records.count(name))]
            assert records.texts(name, field) == texts


# --- which attitude -------------------------------------------------------------------------------------------------
@needs_logs
def test_any_attitude_can_be_named() -> None:
    for asked, reported in {
        "ATT": "ATT",
        "att": "ATT",
        "XKQ1": "XKQ lane 1",
        "XKQ[1]": "XKQ lane 1",
        "AHR2": "AHR2",
        "SIM": "SIM",
    }.items():
        assert open_flight(ADELAIDE, attitude=asked).attitude_source == f"{reported}, 200.0 Hz"


@needs_logs
@pytest.mark.parametrize("unknown", ["VISP", "AHR", "XKQ2", "[", ""])
def test_an_unknown_attitude_is_refused_with_the_known_ones(unknown: str) -> None:
    with pytest.raises(LogFormatError) as caught:
        open_flight(ADELAIDE, attitude=unknown)

    offered = "AHR2 200.0 Hz; ATT 200.0 Hz; SIM 200.0 Hz; XKQ[0] and XKQ[1] 200.0 Hz"
    assert str(caught.value) == f"{ADELAIDE}: the log has no attitude {unknown!r}; it has {offered}"


def test_the_primary_lane_is_used_and_a_switch_is_no_rotation(path: Path, level: Log) -> None:
    for t in times():
        level.xkq(t, 0, 10.0)
        level.xkq(t, 1, 17.6)
        level.xkf4(t, primary=0 if t < BOOT_S + 0.999 else 1)

    flight = open_flight(level.save(path))

    q = flight.attitude.at(ELEVEN_S + np.array([0.5, 1.5]))
    np.testing.assert_allclose(q, quaternion_from_euler(0.0, 0.0, np.deg2rad([10.0, 17.6])), rtol=0, atol=1e-6)
    [gap] = flight.attitude.gaps
    np.testing.assert_allclose([gap.start_utc_s, gap.stop_utc_s], [ELEVEN_S + 0.96, ELEVEN_S + 1.0], rtol=0, atol=1e-5)
    assert flight.attitude_source == "XKQ lane 0 and 1 by XKF4.PI, 25.0 Hz"


def test_a_primary_lane_that_is_not_logged_leaves_the_lane_nearest_to_att(path: Path, level: Log) -> None:
    for t in times():
        level.xkq(t, 0, 10.0)
        level.xkq(t, 1, 0.02)
        level.xkf4(t, primary=7)

    assert open_flight(level.save(path)).attitude_source == "XKQ lane 1, nearest to ATT, 25.0 Hz"


def test_without_xkf4_and_att_the_lowest_lane_is_used_and_reported(path: Path) -> None:
    log = Log()
    for t in times():
        log.xkq(t, 0, 10.0)
        log.xkq(t, 1, 17.6)

    flight = open_flight(log.save(path), utc_start=ELEVEN_S, site=HOME)

    assert flight.attitude_source == "XKQ lane 0, the lowest of 0 and 1, 25.0 Hz"


def test_lanes_with_separate_messages_are_read(path: Path) -> None:
    log = Log()
    for t in times():
        log.xkq(t, 0, 10.0, name="NKQ1")
        log.xkq(t, 0, 17.6, name="NKQ2")
        log.att(t, yaw_deg=17.6)

    flight = open_flight(log.save(path), utc_start=ELEVEN_S, site=HOME)

    assert flight.attitude_source == "NKQ lane 1, nearest to ATT, 25.0 Hz"


def test_ekf2_is_used_if_it_is_active(path: Path, level: Log) -> None:
    log = Log()
    for t in times():
        log.att(t, aekf=2)
        log.xkq(t, 0, 10.0)
        log.xkq(t, 0, 5.0, name="NKQ")

    assert open_flight(log.save(path), utc_start=ELEVEN_S, site=HOME).attitude_source == "NKQ lane 0, 25.0 Hz"


def test_samples_before_the_alignment_of_an_ekf_are_dropped(path: Path, level: Log) -> None:
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


def test_a_log_without_attitude_is_refused_with_its_messages(path: Path) -> None:
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


@needs_logs
def test_every_attitude_has_a_name_by_which_it_can_be_asked_for() -> None:
    with DataFlashReader(ADELAIDE) as source:
        named = dict(source.attitudes())

    assert list(named) == ["AHR2", "ATT", "SIM", "XKQ[0]", "XKQ[1]"]
    for name, batch in named.items():
        asked = open_flight(ADELAIDE, attitude=name).attitude
        assert asked.utc_s.size == np.unique(batch.clock_s).size
        assert angle_deg(asked.q_body_ned[7], batch.q_body_ned[np.argsort(batch.clock_s)[7]]) < 1e-9


def test_lanes_that_had_messages_of_their_own_are_named_as_lanes(path: Path) -> None:
    log = Log()
    for t in times():
        log.xkq(t, 0, 10.0, name="NKQ1")
        log.xkq(t, 0, 17.6, name="NKQ2")

    with DataFlashReader(log.save(path)) as source:
        named = {name: batch.source for name, batch in source.attitudes()}
    flight = open_flight(path, attitude="NKQ2", utc_start=ELEVEN_S, site=HOME)

    assert named == {"NKQ[0]": "NKQ lane 0", "NKQ[1]": "NKQ lane 1"}
    assert flight.attitude_source == "NKQ2 lane 1, 25.0 Hz"


# --- resets of the estimator ----------------------------------------------------------------------------------------
def gaps(path: Path, log: Log, **options: str) -> list[tuple[float, float, str]]:
    """Return the gaps of a log's flight, boot times in s, and their reasons."""
    found = open_flight(log.save(path), utc_start=ELEVEN_S, site=HOME, **options).attitude.gaps
    since_boot_s = BOOT_S - ELEVEN_S
    return [(round(g.start_utc_s + since_boot_s, 3), round(g.stop_utc_s + since_boot_s, 3), g.reason) for g in found]


@pytest.mark.parametrize("log", [Log(), TextLog()], ids=["binary", "text"])
@pytest.mark.parametrize(
    "reported",
    [
        62,
        "EKF3 IMU0 MAG0 in-flight yaw alignment complete",
        "EKF2 IMU1 ground mag anomaly, yaw re-aligned",
        "EKF3 IMU0 yaw aligned to GPS velocity",
        "EKF3 IMU0 emergency yaw reset",
    ],
)
def test_a_reset_of_the_yaw_is_no_rotation(path: Path, log: Log, reported: int | str) -> None:
    log = type(log)()
    for t in times():
        if t == BOOT_S + 1.0:
            (log.ev if isinstance(reported, int) else log.msg)(t - 0.001, reported)
        log.xkq(t, 0, 10.0 if t < BOOT_S + 1.0 else 12.0)
        log.att(t, yaw_deg=10.0 if t < BOOT_S + 1.0 else 12.0)

    expected = [(30.96, 31.0, "a reset of the EKF's yaw")]
    assert gaps(path, log) == expected
    assert gaps(path, log, attitude="ATT") == expected


@pytest.mark.parametrize(
    "reported", [10, 60, "EKF3 IMU0 origin set", "EKF3 IMU0 is using GPS", "PreArm: EKF3 Yaw inconsistent 12 deg"]
)
def test_events_that_do_not_change_attitude_are_no_gaps(path: Path, reported: int | str) -> None:
    log = Log()
    for t in times():
        log.xkq(t, 0, 10.0)
        if t == BOOT_S + 1.0:
            (log.ev if isinstance(reported, int) else log.msg)(t - 0.001, reported)

    assert gaps(path, log) == []


def test_the_backup_estimator_is_not_reset_with_the_ekf(path: Path) -> None:
    log = Log()
    for t in times():
        log.add("AHR2", "Qccc", "TimeUS,Roll,Pitch,Yaw", round(t * 1e6), 0, 0, 0)
    log.ev(BOOT_S + 1.0, 62)

    assert gaps(path, log, attitude="AHR2") == []


def test_att_may_jump_anywhere_between_two_records_of_the_lane(path: Path) -> None:
    log = Log()
    for i, t in enumerate(times()):
        log.att(t, yaw_deg=10.0 if t < BOOT_S + 1.05 else 12.0)
        if i % 5 == 0:
            log.xkf4(t, primary=0 if t < BOOT_S + 1.1 else 1)

    reported = gaps(path, log)

    assert {reason for *_, reason in reported} == {"a switch of the EKF lane"}
    assert (reported[0][0], reported[-1][1]) == (31.0, 31.2)
    assert [start for start, *_ in reported[1:]] == [stop for _, stop, _ in reported[:-1]]


def test_a_switch_and_a_reset_share_a_reason(path: Path) -> None:
    log = Log()
    for t in times():
        log.xkq(t, 0, 10.0)
        log.xkq(t, 1, 11.0)
        log.xkf4(t, primary=0 if t < BOOT_S + 0.5 else 1)
    log.ev(BOOT_S + 1.0, 62)

    reason = "a switch of the EKF lane or a reset of the EKF's yaw"
    assert gaps(path, log) == [(30.48, 30.52, reason), (30.96, 31.0, reason)]


# --- vehicle and firmware -------------------------------------------------------------------------------------------
@needs_logs
def test_the_adelaide_log_names_its_vehicle() -> None:
    with DataFlashReader(ADELAIDE) as source:
        assert source.facts() == LogFacts("ArduPilot DataFlash", "ArduPlane", "ArduPlane V4.6.0-dev (fbb78585)", "EKF3")


@needs_logs
def test_a_log_without_firmware_is_known_by_its_parameters() -> None:
    with DataFlashReader(SKYWALKER) as source:
        assert source.facts() == LogFacts("ArduPilot DataFlash", "ArduPlane", None)


@pytest.mark.parametrize(
    ("text", "vehicle", "firmware"),
    [
        ("APM:Copter V3.3-rc1 (acf71d5f)", "ArduCopter", "APM:Copter V3.3-rc1 (acf71d5f)"),
        ("ArduCopter V4.6.3v2-SFD (5282cc3d)", "ArduCopter", "ArduCopter V4.6.3v2-SFD (5282cc3d)"),
        ("Frame: QUAD/X, Rover is near", None, None),
    ],
)
def test_the_firmware_comes_from_the_messages_of_the_log(
    path: Path, text: str, vehicle: str | None, firmware: str | None
) -> None:
    log = Log()
    log.msg(BOOT_S, "EKF3 IMU0 initialised")
    log.msg(BOOT_S, text)

    with DataFlashReader(log.save(path)) as source:
        assert source.facts() == LogFacts("ArduPilot DataFlash", vehicle, firmware)


def test_a_version_record_is_preferred_to_a_message(path: Path) -> None:
    log = Log()
    log.msg(BOOT_S, "ArduPlane V4.1.0 (00000000)")
    log.add("VER", "QBZ", "TimeUS,BU,FWS", 0, 3, "ArduPlane V4.5.1 (1a2b3c4d)")

    with DataFlashReader(log.save(path)) as source:
        assert source.facts().firmware == "ArduPlane V4.5.1 (1a2b3c4d)"


# --- turn rates -----------------------------------------------------------------------------------------------------
def rates(path: Path) -> RateSamples:
    with DataFlashReader(path) as source:
        [batch] = [batch for batch in source.samples() if isinstance(batch, RateSamples)]
    return batch


@needs_logs
def test_the_gyros_turn_as_the_attitude_does_about_each_axis() -> None:
    measured, flown = rates(SKYWALKER), open_flight(SKYWALKER, utc_start=0.0).attitude
    with DataFlashReader(SKYWALKER) as source:
        clock_s = flown.utc_s + next(iter(source.samples())).clock_s.min()

    # A body that turns by w dt sees fixed directions turn by -w dt.  Differences are over 0.1 s because ATT is rounded.
    step = 5
    turn = multiply(flown.q_body_ned[step:], conjugate(flown.q_body_ned[:-step]))
    turn_rad = 2 * np.sign(turn[:, :1]) * turn[:, 1:]
    turned_rad_per_s = -turn_rad / (clock_s[step:] - clock_s[:-step])[:, np.newaxis]
    middle_s = (clock_s[step:] + clock_s[:-step]) / 2

    for axis in range(3):
        gyro = np.interp(middle_s, measured.clock_s, measured.rate_rad_per_s[:, axis])
        assert np.corrcoef(gyro, turned_rad_per_s[:, axis])[0, 1] > 0.99
        assert np.polyfit(gyro, turned_rad_per_s[:, axis], 1)[0] == pytest.approx(1.0, abs=0.02)
    assert measured.source == "IMU 0"
    assert measured.clock_s.size == 30650


def test_the_first_gyro_is_used_without_damaged_rates(path: Path, level: Log) -> None:
    for t in times():
        level.imu(t, 0.1, 0.2, 0.3, instance=2)
        level.imu(t, 0.4, 0.5, 0.6, instance=1)
    level.imu(BOOT_S + 0.01, 1e30, 0.0, 0.0, instance=1)
    level.imu(BOOT_S + 0.02, float("nan"), 0.0, 0.0, instance=0)

    measured = rates(level.save(path))

    assert measured.source == "IMU 1"
    np.testing.assert_allclose(measured.rate_rad_per_s, [[0.4, 0.5, 0.6]] * 51, rtol=1e-6)


def test_old_logs_number_the_gyros(path: Path, level: Log) -> None:
    for t in times():
        level.add("IMU2", "Ifff", "TimeMS,GyrX,GyrY,GyrZ", round(t * 1e3), 0.4, 0.5, 0.6)

    measured = rates(level.save(path))

    assert (measured.source, measured.clock_s[0]) == ("IMU2 0", BOOT_S)


@pytest.mark.parametrize(("duration_s", "source"), [(2.0, "GYR 0"), (1.0, "IMU 0")], ids=["whole", "part"])
def test_raw_gyro_samples_are_used_if_they_cover_the_flight(
    path: Path, level: Log, duration_s: float, source: str
) -> None:
    for t in times():
        level.imu(t, 0.1, 0.2, 0.3)
    for t in times(duration_s, 1000.0):
        level.gyr(t, 0.1, 0.2, 0.3)

    measured = rates(level.save(path))

    assert measured.source == source
    assert measured.clock_s[0] == BOOT_S  # SampleUS, not the 10 ms later at which it was written


def test_a_log_without_gyros_reports_no_rates(path: Path, level: Log) -> None:
    with DataFlashReader(level.save(path)) as source:
        assert [type(batch).__name__ for batch in source.samples()] == [
            "AttitudeSamples",
            "PositionSamples",
            "ClockSamples",
        ]


# --- before 2015 ----------------------------------------------------------------------------------------------------
def old_gps(log: Log, t_s: float, *, status: int = 3, lag_s: float = 0.020) -> None:
    """Write a GPS record of ArduPilot 3: TimeMS is the GPS week's, T the time since boot."""
    fields = "Status,TimeMS,Week,NSats,HDop,Lat,Lng,RelAlt,Alt,Spd,GCrs,VZ,T"
    week_ms = (11 * 3600 + 18) * 1000 + round((t_s - BOOT_S) * 1000)
    place = -349300000, 1386000000, 0, 4800
    log.add(
        "GPS", "BIHBcLLeeEefI", fields, status, week_ms, WEEK, 10, 120, *place, 0, 0, 0.0, round((t_s + lag_s) * 1e3)
    )


def old_att(log: Log, t_s: float, yaw_deg: float = 0.0) -> None:
    fields = "TimeMS,DesRoll,Roll,DesPitch,Pitch,DesYaw,Yaw"
    log.add("ATT", "IccccCC", fields, round(t_s * 1e3), 0, 1000, 0, -500, 0, round(100 * yaw_deg))


@pytest.mark.parametrize("form", [Log, TextLog])
def test_a_log_in_milliseconds_is_a_flight(path: Path, form: type[Log]) -> None:
    log = form()
    log.add("MSG", "Z", "Message", "ArduPlane V3.2.1 (80bcf9d5)")
    for t in times():
        old_att(log, t, 270.0)
        log.add("IMU", "Iffffff", "TimeMS,GyrX,GyrY,GyrZ,AccX,AccY,AccZ", round(t * 1e3), 0.1, 0.2, 0.3, 0, 0, -9.8)
    old_gps(log, BOOT_S - 5.0, status=1, lag_s=3.0)
    for t in times(rate_hz=5):
        old_gps(log, t)

    flight = open_flight(log.save(path))

    assert flight.attitude.first_s == pytest.approx(ELEVEN_S, abs=0.001)
    assert angle_deg(flight.attitude.q_body_ned, quaternion_from_euler(*np.deg2rad([10.0, -5.0, 270.0]))).max() < 1e-9
    site = flight.position.at(ELEVEN_S)
    assert (np.rad2deg(site.latitude_rad), np.rad2deg(site.longitude_rad)) == pytest.approx((-34.93, 138.60), abs=1e-9)
    assert site.height_m == 48.0
    assert flight.utc_source == "GPS time when logged (no GPA), 11 fixes, 18 leap seconds"
    assert rates(path).clock_s[0] == BOOT_S
    with DataFlashReader(path) as source:
        assert source.facts().firmware == "ArduPlane V3.2.1 (80bcf9d5)"


def test_the_gps_week_is_no_clock_of_the_log(path: Path) -> None:
    log = Log()
    for t in times():
        old_att(log, t)
        log.add("GPS", "BIHLLe", "Status,TimeMS,Week,Lat,Lng,Alt", 3, 39618000, WEEK, -349300000, 1386000000, 4800)

    unstamped = "its GPS records are not stamped with the time since boot (TimeUS or T)"
    with pytest.raises(LogFormatError) as caught:
        open_flight(log.save(path))
    assert f"no UTC ({unstamped}) and no position ({unstamped})" in str(caught.value)

    assert open_flight(path, utc_start=ELEVEN_S, site=HOME).attitude.first_s == ELEVEN_S


def test_attitudes_without_timestamps_are_refused(path: Path) -> None:
    log = Log()
    for t in times():
        log.add("ATT", "cccccCC", "RollIn,Roll,PitchIn,Pitch,YawIn,Yaw,NavYaw", 0, 0, 0, 0, 0, 0, 0)
        old_gps(log, t)

    with pytest.raises(LogFormatError, match="its ATT records are not stamped with a time"):
        open_flight(log.save(path))


# --- which UTC ------------------------------------------------------------------------------------------------------
def test_gps_time_applies_to_the_sample_not_to_the_record(path: Path, level: Log) -> None:
    log = Log()
    for t in times():
        log.att(t)
        log.pos(t)
    for i, t in enumerate(times(rate_hz=5)):
        lag_s = 0.016 + 0.01 * (i % 3)
        log.gpa(t - 0.08, lag_s=lag_s + 0.08, receiver=1)  # written at the same time, sampled earlier
        log.gps(t, lag_s=lag_s)
        log.gpa(t, lag_s=lag_s)

    flight = open_flight(log.save(path))

    assert flight.attitude.first_s == pytest.approx(ELEVEN_S, abs=1e-6)
    assert flight.utc_source == "GPS time at GPA.SMS, 11 fixes, 18 leap seconds"


def test_a_late_first_fix_does_not_change_utc(path: Path) -> None:
    log = Log()
    for t in times():
        log.att(t)
        log.pos(t)
    for i, t in enumerate(times(rate_hz=5)):
        log.gps(t, lag_s=0.140 if i == 0 else 0.020)

    assert open_flight(log.save(path)).attitude.first_s == pytest.approx(ELEVEN_S, abs=1e-6)


def test_records_without_a_fix_report_no_time(path: Path) -> None:
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
def test_a_log_without_utc_is_refused_with_a_reason_unless_utc_is_given(
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


def test_a_camera_clock_ahead_of_the_log_leaves_attitude_and_position_at_the_logs_utc(path: Path, level: Log) -> None:
    level.save(path)

    flight = open_flight(path, time_offset_s=0.25)

    assert flight.attitude.first_s == pytest.approx(ELEVEN_S, rel=0, abs=1e-6)
    assert flight.position.utc_s[0] == pytest.approx(ELEVEN_S, rel=0, abs=1e-6)
    assert flight.time_offset_s == 0.25


# --- position -------------------------------------------------------------------------------------------------------
def test_gps_positions_are_used_without_pos(path: Path) -> None:
    log = Log()
    for t in times():
        log.att(t)
        log.gps(t, receiver=0, in_use=0, latitude_deg=10.0)
        log.gps(t, receiver=1, in_use=1, latitude_deg=-34.93)
    log.pos(BOOT_S, 0.0, 0.0)  # an EKF without an origin

    flight = open_flight(log.save(path))

    assert flight.position_source == "GPS"
    np.testing.assert_allclose(np.rad2deg(flight.position.latitude_rad), -34.93, rtol=0, atol=1e-9)


def test_a_log_without_positions_is_refused_unless_one_is_given(path: Path) -> None:
    log = Log()
    for t in times():
        log.att(t)
    log.save(path)

    with pytest.raises(LogFormatError, match=r"no position \(it has neither POS nor GPS records\); give its position"):
        open_flight(path, utc_start=ELEVEN_S)

    flight = open_flight(path, utc_start=ELEVEN_S, site=HOME)
    assert flight.position.at(ELEVEN_S).latitude_rad == HOME.latitude_rad
    assert flight.position_source == "given"


def test_everything_that_a_log_lacks_is_reported_at_once(path: Path) -> None:
    log = Log()
    for t in times():
        log.att(t)

    with pytest.raises(LogFormatError) as caught:
        open_flight(log.save(path))

    assert str(caught.value) == (
        f"{path}: the log has no UTC (it has no GPS records) and no position (it has neither POS nor GPS records);"
        " give the UTC of its first attitude as utc_start (--utc-start)"
        " and its position as latitude_deg and longitude_deg (--lat, --lon)"
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


def test_damaged_bytes_lose_only_the_records_that_contain_them(path: Path) -> None:
    data = bytearray(DEMO.read_bytes())
    data[250_000:250_100] = bytes(100)
    path.write_bytes(data)

    whole, damaged = open_flight(DEMO).attitude, open_flight(path).attitude

    assert 1 <= whole.utc_s.size - damaged.utc_s.size <= 5
    np.testing.assert_array_equal(damaged.utc_s, whole.utc_s[np.isin(whole.utc_s, damaged.utc_s)])


def test_records_with_an_absurd_time_or_position_are_dropped(path: Path, level: Log) -> None:
    level.att(1e9)
    level.pos(1e9)
    level.pos(BOOT_S + 2.02, 89.0, 10.0)
    for t in (2.04, 2.08, 2.12):
        level.att(BOOT_S + t)
        level.pos(BOOT_S + t)

    flight = open_flight(level.save(path))

    assert flight.attitude.last_s == pytest.approx(ELEVEN_S + 2.12, abs=1e-6)
    assert flight.attitude.utc_s.size == 54
    np.testing.assert_allclose(np.rad2deg(flight.position.latitude_rad), -34.93, rtol=0, atol=1e-9)


def test_a_damaged_lane_number_makes_no_lane(path: Path, level: Log) -> None:
    for t in times(20.0):
        level.xkq(t, 0, 0.01)
    level.xkq(BOOT_S + 20.01, 77, 0.0001)

    assert open_flight(level.save(path)).attitude_source == "XKQ lane 0, 25.0 Hz"


def test_nothing_is_printed_whatever_the_damage(path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    data = bytearray(DEMO.read_bytes())
    data[100:140] = b"\xff" * 40  # within a definition
    data[-5:] = b""
    path.write_bytes(data)

    open_flight(path)

    assert capfd.readouterr() == ("", "")


# --- side effects ---------------------------------------------------------------------------------------------------
def test_a_reader_is_a_telemetry_source_and_may_be_closed_twice(path: Path, level: Log) -> None:
    with DataFlashReader(level.save(path)) as source:
        assert isinstance(source, TelemetrySource)
        assert len(list(source.samples())) == 3
    source.close()
    path.unlink()


def test_reading_a_log_imports_no_pymavlink_and_leaves_the_environment_alone() -> None:
    program = f"""
import os, sys
import glstar.telemetry
heavy = [name for name in ("pymavlink", "moderngl", "cv2") if name in sys.modules]
assert not heavy, heavy
before = dict(os.environ)
glstar.telemetry.open_flight({str(DEMO)!r})
assert "pymavlink" not in sys.modules
assert dict(os.environ) == before
"""
    clean = {key: value for key, value in os.environ.items() if not key.startswith("MAVLINK")}
    done = subprocess.run([sys.executable, "-c", program], env=clean, capture_output=True, text=True, check=False)

    assert (done.returncode, done.stdout, done.stderr) == (0, "", "")


def test_the_letters_of_layouts_are_those_of_pymavlink() -> None:
    types = {letter: np.dtype(code) for letter, code in _TYPES.items()}

    assert types.keys() == FORMAT_TO_STRUCT.keys()
    for letter, (code, factor, _) in FORMAT_TO_STRUCT.items():
        expected = np.dtype(f"S{code[:-1]}" if code.endswith("s") else f"<{code}")
        assert (types[letter], _DIVISORS.get(letter)) == (expected, factor and round(1 / factor))
