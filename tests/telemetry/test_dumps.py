"""CSV exports of logs by other programs give the flight of the log."""

import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pymavlink
import pytest
import pyulog.ulog2csv

from glstar.errors import LogFormatError
from glstar.flight import Flight
from glstar.rotation import conjugate, multiply
from glstar.sky.place.site import Site
from glstar.telemetry import Recording, open_flight, open_source
from tests.support import tlog, ulog
from tests.support.dataflash import ELEVEN_S, Log, beginning
from tests.support.dataflash import times as dataflash_times

needs_logs = pytest.mark.skipif(not tlog.ADELAIDE.exists(), reason=f"no sample logs in {tlog.LOGS}")
MAVLOGDUMP = Path(pymavlink.__file__).parent / "tools" / "mavlogdump.py"
HOME = Site(latitude_rad=np.deg2rad(-34.93), longitude_rad=np.deg2rad(138.60), height_m=48.0)


def dumped(log: Path, path: Path, types: str, *options: str) -> Path:
    """Run mavlogdump in a separate process, because importing it changes the process."""
    program = [sys.executable, str(MAVLOGDUMP), "--format", "csv", "--types", types, *options, str(log)]
    with path.open("w") as file:
        subprocess.run(program, stdout=file, stderr=subprocess.DEVNULL, check=True)
    return path


def as_csv(log: Path, folder: Path, topics: str | None = None, delimiter: str = ",") -> None:
    pyulog.ulog2csv.convert_ulog2csv(str(log), topics, str(folder), delimiter, None, None)


def difference_deg(one: Flight, other: Flight) -> float:
    """Return the largest angle between two flights at the samples of the first."""
    at_s = one.attitude.utc_s
    at_s = at_s[(at_s >= other.attitude.first_s) & (at_s <= other.attitude.last_s)]
    turn = multiply(other.attitude.at(at_s), conjugate(one.attitude.at(at_s)))
    return float(np.rad2deg(2 * np.arctan2(np.linalg.norm(turn[:, 1:], axis=-1), np.abs(turn[:, 0]))).max())


# --- ulog2csv -------------------------------------------------------------------------------------------------------
@needs_logs
@pytest.mark.parametrize("log", [ulog.PLANE, ulog.VTOL], ids=["plane", "VTOL"])
@pytest.mark.parametrize("named", ["vehicle_attitude_0", "vehicle_gps_position_0"])
def test_the_files_of_ulog2csv_give_the_flight_of_the_log(log: Path, named: str, tmp_path: Path) -> None:
    topics = "vehicle_attitude,vehicle_global_position,vehicle_gps_position,vehicle_status,vehicle_angular_velocity"
    as_csv(log, tmp_path, topics)

    flight, expected = open_flight(tmp_path / f"{log.stem}_{named}.csv"), open_flight(log)

    np.testing.assert_allclose(flight.attitude.utc_s, expected.attitude.utc_s, rtol=0, atol=1e-6)
    assert difference_deg(expected, flight) < 1e-4
    np.testing.assert_allclose(flight.position.latitude_rad, expected.position.latitude_rad, rtol=0, atol=1e-12)
    assert flight.utc_source == expected.utc_source


@needs_logs
def test_a_single_file_of_ulog2csv_names_the_missing_ones(tmp_path: Path) -> None:
    as_csv(ulog.VTOL, tmp_path, "vehicle_attitude")
    path = tmp_path / f"{ulog.VTOL.stem}_vehicle_attitude_0.csv"

    with pytest.raises(LogFormatError) as caught:
        open_flight(path)

    log = ulog.VTOL.stem
    assert f"no UTC (no {log}_vehicle_gps_position_0.csv lies beside it)" in str(caught.value)
    assert f"(neither {log}_vehicle_global_position_0.csv nor {log}_vehicle_gps_position_0.csv" in str(caught.value)
    assert open_flight(path, utc_start=ulog.ELEVEN_S, site=HOME).attitude.utc_s.size == 1298


def test_a_file_of_ulog2csv_may_be_renamed_and_have_other_separators(tmp_path: Path) -> None:
    log = ulog.Log()
    for t in ulog.times():
        log.attitude(t, 10.0 * (t - ulog.BOOT_S))
    as_csv(log.save(tmp_path / "log.ulg"), tmp_path, delimiter=";")
    path = (tmp_path / "log_vehicle_attitude_0.csv").rename(tmp_path / "mine.csv")

    flight = open_flight(path, utc_start=ulog.ELEVEN_S, site=HOME)

    np.testing.assert_allclose(ulog_yaw_deg(flight), [5.0, 15.0], rtol=0, atol=1e-3)
    with pytest.raises(LogFormatError, match=r"should be LOG_vehicle_attitude_0.csv, as ulog2csv wrote it"):
        open_flight(path)


def test_the_files_of_ulog2csv_give_the_triggers_of_the_log(tmp_path: Path) -> None:
    log = ulog.Log()
    for t in ulog.times(duration_s=4.0):
        log.attitude(t)
        log.gps(t)
    for number in range(3):
        log.trigger(ulog.BOOT_S + number + 0.5, number)
        log.trigger(ulog.BOOT_S + number + 0.6, number, feedback=True)
    as_csv(log.save(tmp_path / "log.ulg"), tmp_path)

    flight = open_flight(tmp_path / "log_vehicle_attitude_0.csv")

    exposed_s = flight.triggers_of("camera").utc_s - ELEVEN_S
    np.testing.assert_allclose(exposed_s, [0.6, 1.6, 2.6], rtol=0, atol=1e-3)


def test_the_named_attitude_of_ulog2csv_files_is_used(tmp_path: Path) -> None:
    log = ulog.Log()
    for t in ulog.times():
        log.attitude(t, 10.0)
        log.attitude(t, 20.0, name="estimator_attitude", instance=0)
        log.attitude(t, 30.0, name="estimator_attitude", instance=1)
        log.gps(t)
    as_csv(log.save(tmp_path / "log.ulg"), tmp_path)

    def yaw_deg(file: str, attitude: str = "auto") -> float:
        return float(ulog_yaw_deg(open_flight(tmp_path / file, attitude=attitude)).round(3)[0])

    assert yaw_deg("log_vehicle_attitude_0.csv") == 10.0
    assert yaw_deg("log_sensor_gps_0.csv") == 10.0
    assert yaw_deg("log_estimator_attitude_1.csv") == 30.0
    assert yaw_deg("log_vehicle_attitude_0.csv", "estimator_attitude") == 20.0
    with open_source(tmp_path / "log_vehicle_attitude_0.csv") as source:
        assert [name for name, _ in source.attitudes()] == [
            "estimator_attitude[0]",
            "estimator_attitude[1]",
            "vehicle_attitude",
        ]


def ulog_yaw_deg(flight: Flight) -> np.ndarray:
    q = flight.attitude.at(flight.attitude.first_s + np.array([0.5, 1.5]))
    return np.rad2deg(2 * np.arctan2(-q[:, 3], q[:, 0]))


# --- mavlogdump of a telemetry log ----------------------------------------------------------------------------------
@needs_logs
@pytest.mark.parametrize("log", [tlog.ADELAIDE, tlog.ROV], ids=["plane", "submarine"])
@pytest.mark.parametrize("separator", [",", ";"])
def test_mavlogdumps_table_gives_the_flight_of_the_telemetry_log(log: Path, separator: str, tmp_path: Path) -> None:
    types = "ATTITUDE,SYSTEM_TIME,GLOBAL_POSITION_INT,HEARTBEAT,STATUSTEXT"
    whole, log = log, tmp_path / log.name
    log.write_bytes(whole.read_bytes()[:700_000])
    path = dumped(log, tmp_path / "log.csv", types, "--csv_sep", separator)

    flight, expected = open_flight(path), open_flight(log)

    np.testing.assert_allclose(flight.attitude.utc_s, expected.attitude.utc_s, rtol=0, atol=1e-6)
    assert difference_deg(expected, flight) < 1e-6
    np.testing.assert_allclose(flight.position.latitude_rad, expected.position.latitude_rad, rtol=0, atol=1e-12)
    with open_source(path) as source, open_source(log) as reported:
        assert source.facts().vehicle == reported.facts().vehicle
        assert source.facts().firmware == reported.facts().firmware


def test_a_table_without_system_time_is_refused_with_the_missing_message(tmp_path: Path, turn: tlog.Log) -> None:
    path = dumped(turn.save(tmp_path / "log.tlog"), tmp_path / "log.csv", "ATTITUDE")

    with pytest.raises(LogFormatError) as caught:
        open_flight(path)

    assert "no SYSTEM_TIME in the table: write it again with mavlogdump --types ...,SYSTEM_TIME" in str(caught.value)
    assert "the recorder's own clock said 2026-01-01T00:00:00.500000Z" in str(caught.value)
    assert "write it again with mavlogdump --types ...,GLOBAL_POSITION_INT" in str(caught.value)


def test_a_ground_stations_utc_in_the_table_is_not_taken_for_the_autopilots(tmp_path: Path, turn: tlog.Log) -> None:
    for t in tlog.times(rate_hz=10):
        turn.time(t, sender=(255, 190), utc_s=tlog.ELEVEN_S + 60, boot_ms=0)
        turn.heartbeat(t, sender=(255, 190), autopilot=8)
    path = dumped(turn.save(tmp_path / "log.tlog"), tmp_path / "log.csv", "ATTITUDE,SYSTEM_TIME,GLOBAL_POSITION_INT")

    flight = open_flight(path)

    assert flight.attitude.first_s == pytest.approx(tlog.ELEVEN_S, abs=1e-3)
    assert flight.utc_source == "SYSTEM_TIME, 11 readings"


@pytest.mark.parametrize("separator", [",", ";"])
def test_a_table_of_a_simulators_state_is_read_like_its_log(tmp_path: Path, separator: str) -> None:
    log = tlog.simulated(timed_by_utc=False).save(tmp_path / "log.tlog")
    path = dumped(log, tmp_path / "log.csv", "HIL_STATE_QUATERNION,SYSTEM_TIME", "--csv_sep", separator)

    flight, expected = open_flight(path), open_flight(log)

    assert flight.attitude_source == expected.attitude_source
    np.testing.assert_allclose(flight.attitude.utc_s, expected.attitude.utc_s, rtol=0, atol=1e-6)
    assert difference_deg(expected, flight) < 1e-6
    np.testing.assert_allclose(flight.position.longitude_rad, expected.position.longitude_rad, rtol=0, atol=1e-12)
    assert flight.notes == expected.notes


@pytest.mark.parametrize("ahead_s", [1000.0, 2.0, 0.007])
def test_a_table_of_several_vehicles_is_refused(tmp_path: Path, ahead_s: float) -> None:
    log = tlog.Log()
    for t in tlog.times():
        log.attitude(t, 20.0, sender=(1, 1))
        log.attitude(t + ahead_s, 70.0, sender=(2, 1))
    path = dumped(log.save(tmp_path / "log.tlog"), tmp_path / "log.csv", "ATTITUDE")

    with pytest.raises(LogFormatError) as caught:
        open_flight(path)

    assert str(caught.value) == (
        f"{path}: has ATTITUDE of several vehicles, and no column with their systems; write one vehicle's with"
        " mavlogdump.py --source-system 1, or give the .tlog itself and --sysid 1"
    )


def test_the_place_of_another_vehicle_is_not_the_attitudes(tmp_path: Path, turn: tlog.Log) -> None:
    for t in tlog.times(rate_hz=10):
        place = (516000000, 100000, 48000)
        other = tlog.common.MAVLink_global_position_int_message(tlog.ms(t + 1000.0), *place, 0, 0, 0, 0, 0)
        turn.add(other, t, sender=(2, 1))
    path = dumped(turn.save(tmp_path / "log.tlog"), tmp_path / "log.csv", "ATTITUDE,SYSTEM_TIME,GLOBAL_POSITION_INT")

    position = open_flight(path).position

    np.testing.assert_allclose(np.rad2deg(position.latitude_rad), -34.93, rtol=0, atol=1e-6)


def test_rates_are_in_the_table_too(tmp_path: Path, turn: tlog.Log) -> None:
    for t in tlog.times(rate_hz=100):
        turn.imu(t, [0.0, 0.0, 0.175])
    path = dumped(turn.save(tmp_path / "log.tlog"), tmp_path / "log.csv", "ATTITUDE,HEARTBEAT,RAW_IMU")

    with open_source(path) as source:
        rates = Recording.read(source).rates

    assert rates.source == "RAW_IMU"
    np.testing.assert_allclose(rates.rate_rad_per_s, [[0.0, 0.0, 0.175]] * 201, rtol=0, atol=1e-9)


turn = tlog.turn


# --- mavlogdump of a DataFlash log ----------------------------------------------------------------------------------
SITL = tlog.LOGS / "plane_SITL_adelaide_200Hz.BIN"
SKYWALKER = tlog.LOGS / "plane_skywalkerX8_TestLog2.reenc.BIN"


@needs_logs
@pytest.mark.parametrize(
    ("log", "messages"),
    [(SITL, ("XKQ", "ATT", "GPS", "POS", "MSG")), (SKYWALKER, ("ATT", "GPS"))],
    ids=["simulator", "flying wing"],
)
def test_mavlogdumps_tables_give_the_flight_of_the_dataflash_log(
    log: Path, messages: tuple[str, ...], tmp_path: Path
) -> None:
    log = beginning(log, tmp_path)
    first, *_ = paths = [dumped(log, tmp_path / f"flight_{name}.csv", name) for name in messages]

    flight, expected = open_flight(first), open_flight(log)

    np.testing.assert_allclose(flight.attitude.utc_s, expected.attitude.utc_s, rtol=0, atol=1e-6)
    assert difference_deg(expected, flight) < 1e-5
    np.testing.assert_allclose(flight.position.latitude_rad, expected.position.latitude_rad, rtol=0, atol=1e-12)
    assert (flight.utc_source, flight.attitude_source) == (expected.utc_source, expected.attitude_source)
    # The attitude of the opened table is used; if it has none, the best one in the directory.
    assert open_flight(paths[-1]).attitude_source == expected.attitude_source
    assert open_flight(tmp_path / "flight_ATT.csv").attitude_source.startswith("ATT")


@needs_logs
def test_a_single_dataflash_table_has_utc_with_the_leap_seconds_of_its_date(
    tmp_path: Path,
) -> None:
    alone = dumped(SKYWALKER, tmp_path / "flight_ATT.csv", "ATT")

    with pytest.raises(LogFormatError, match=r"neither flight_POS.csv nor flight_GPS.csv lies beside it"):
        open_flight(alone)

    flight, expected = open_flight(alone, site=HOME), open_flight(SKYWALKER)
    # The first fix of this log lags by 2.4 s; wrong leap seconds would add 2 s.
    assert flight.attitude.first_s - expected.attitude.first_s == pytest.approx(-2.361, abs=0.002)
    assert "timestamps of mavlogdump, by the first GPS fix" in flight.utc_source
    assert "16 leap seconds" in flight.utc_source


@needs_logs
def test_timestamps_of_a_simulators_table_agree_with_its_gps(tmp_path: Path) -> None:
    log = beginning(SITL, tmp_path)
    alone = dumped(log, tmp_path / "mine.csv", "XKQ")

    flight, expected = open_flight(alone, site=HOME), open_flight(log)

    assert flight.attitude.first_s == pytest.approx(expected.attitude.first_s, abs=0.002)


def ten_seconds(folder: Path, name: str, fields: str, row: str) -> Path:
    """Write a table as mavlogdump does, a row a second."""
    rows = [f"timestamp,TimeUS,{fields}"] + [f"{ELEVEN_S + k},{k}000000,{row}" for k in range(10)]
    path = folder / f"flight_{name}.csv"
    path.write_text("\n".join(rows) + "\n")
    return path


def test_a_reset_message_with_a_comma_is_read_from_a_table(tmp_path: Path) -> None:
    path = ten_seconds(tmp_path, "ATT", "Roll,Pitch,Yaw", "0,0,90")
    line = f"{ELEVEN_S + 4.5},4500000,EKF2 IMU1 ground mag anomaly, yaw re-aligned"
    (tmp_path / "flight_MSG.csv").write_text(f"timestamp,TimeUS,Message\n{line}\n")

    [gap] = open_flight(path, utc_start=ELEVEN_S, site=HOME).attitude.gaps

    assert (gap.start_utc_s - ELEVEN_S, gap.reason) == (4.0, "a reset of the EKF's yaw")


def test_an_absurd_gps_week_in_a_table_is_ignored(tmp_path: Path) -> None:
    path = ten_seconds(tmp_path, "ATT", "Roll,Pitch,Yaw", "0,0,90")
    ten_seconds(tmp_path, "GPS", "Status,GMS,GWk", "3,39618000,1e305")

    assert open_flight(path, site=HOME).utc_source.startswith("timestamps of mavlogdump")


# --- the recipe of the manual, and other files in the directory -----------------------------------------------------
PAGE = Path(__file__).parents[2] / "assets" / "manual" / "logs.md"


def ekf2_log(path: Path) -> Path:
    """Write the log of an aircraft with an EKF2 and a board trim of 2.2 deg, by which ATT and NKQ differ."""
    log = Log()
    log.data = b"\xa3\x95\x80\x80\x59FMT\0BBnNZ".ljust(25, b"\0") + b"Type,Length,Name,Format,Columns".ljust(64, b"\0")
    for t in dataflash_times():
        log.att(t, yaw_deg=10.0, aekf=2)
        log.xkq(t, 0, 10.9, name="NKQ")
        log.pos(t)
    for t in dataflash_times(rate_hz=5):
        log.gps(t)
    return log.save(path)


def test_the_recipe_of_the_manual_gives_the_flight_of_the_log_of_an_ekf2(tmp_path: Path) -> None:
    [types] = re.findall(r"for type in (.*); do", PAGE.read_text(encoding="utf-8"))
    log = ekf2_log(tmp_path / "flight.BIN")
    for name in types.split():
        if name in ("NKQ", "ATT", "GPS", "POS"):
            dumped(log, tmp_path / f"flight_{name}.csv", name)
        else:  # mavlogdump's message for a type that the log does not have
            (tmp_path / f"flight_{name}.csv").write_text(f"Specified type '{name}' not found in log file\n")

    expected = open_flight(log)
    flight = open_flight(tmp_path / "flight_GPS.csv")

    assert {"XKQ", "XKF4", "NKQ", "NKF4", "ATT", "GPS", "GPA", "POS", "MSG", "EV"} <= set(types.split())
    assert flight.attitude_source == expected.attitude_source == "NKQ lane 0, 25.0 Hz"
    assert difference_deg(expected, flight) < 1e-4
    assert flight.notes == ()


def test_an_unrelated_table_in_the_directory_is_left_out_and_reported(tmp_path: Path) -> None:
    path = ten_seconds(tmp_path, "ATT", "Roll,Pitch,Yaw", "0,0,90")
    ten_seconds(tmp_path, "GPS", "Status,GMS,GWk,Lat,Lng,Alt", "3,39618000,2305,-34.93,138.6,48")
    (tmp_path / "flight_POS.csv").write_bytes(b"\xff\xfe\x00\x80" * 100)
    (tmp_path / "flight_IMU.csv").write_text("time,GyrX\n1,2\n3,4\n")

    flight = open_flight(path)

    assert flight.position_source == "GPS"
    assert set(flight.notes) == {
        "flight_POS.csv beside it is left out: is no text: it is not UTF-8",
        "flight_IMU.csv beside it is left out: is no table of mavlogdump: it does not begin with timestamp,TimeUS",
    }


def test_an_unreadable_file_in_the_directory_is_left_out_and_reported(tmp_path: Path) -> None:
    log = ulog.Log()
    for t in ulog.times():
        log.attitude(t, 10.0)
        log.gps(t)
    as_csv(log.save(tmp_path / "log.ulg"), tmp_path)
    (tmp_path / "log_vehicle_global_position_0.csv").write_bytes(b"\xff\xfe\x00\x80" * 100)

    flight = open_flight(tmp_path / "log_vehicle_attitude_0.csv")

    assert flight.position_source == "sensor_gps"
    assert flight.notes == ("log_vehicle_global_position_0.csv beside it is left out: is no text: it is not UTF-8",)


def test_opening_the_table_of_messages_keeps_them(tmp_path: Path) -> None:
    ten_seconds(tmp_path, "ATT", "Roll,Pitch,Yaw", "0,0,90")
    path = tmp_path / "flight_MSG.csv"
    path.write_text(
        f"timestamp,TimeUS,Message\n{ELEVEN_S + 4.5},4500000,EKF2 IMU1 ground mag anomaly, yaw re-aligned\n"
    )

    [gap] = open_flight(path, utc_start=ELEVEN_S, site=HOME).attitude.gaps

    assert gap.reason == "a reset of the EKF's yaw"


def test_opening_the_table_of_att_uses_it_and_reports_the_alternative(tmp_path: Path) -> None:
    path = ten_seconds(tmp_path, "ATT", "Roll,Pitch,Yaw", "0,0,90")
    ten_seconds(tmp_path, "XKQ", "C,Q1,Q2,Q3,Q4", "0,0.7071068,0,0,0.7071068")

    flight = open_flight(path, utc_start=ELEVEN_S, site=HOME)

    assert flight.attitude_source == "ATT, 1.0 Hz"
    assert flight.notes == (
        "ATT is taken, because its table was named; flight_XKQ.csv beside it has XKQ (--attitude XKQ)",
    )
    assert open_flight(path, utc_start=ELEVEN_S, site=HOME, attitude="XKQ").notes == ()
