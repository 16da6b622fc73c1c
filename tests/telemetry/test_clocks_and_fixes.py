"""Requirements on all readers: positions before a fix, UTC to a millisecond, missing vehicles."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from pymavlink.dialects.v20 import common

from glstar.config import Config
from glstar.errors import LogFormatError
from glstar.export.plan.frames import ExportOptions
from glstar.export.run.prepare import prepare_export
from glstar.sky.place.timescale import parse_utc
from glstar.telemetry import Recording, open_flight, open_source
from tests.support.dataflash import Log as DataFlash
from tests.support.dataflash import TextLog
from tests.support.tlog import BOOT_S
from tests.support.tlog import Log as Telemetry
from tests.support.ulog import Log as ULog

ELEVEN_S = parse_utc("2024-03-10T11:00:00Z")
# The receiver has a fix from this time on; before, it reports 0 N 0 E.
FIX_S = 2.0
STEPS_S = np.arange(0.0, 4.01, 0.1)


def table(folder: Path, *, moment: str = "utc_s") -> Path:
    rows = [f"{moment},roll_deg,pitch_deg,yaw_deg,latitude_deg,longitude_deg,height_m"]
    for t in STEPS_S.tolist():
        place = "0,0,0" if t < FIX_S else "-34.93,138.6,48"
        when = f"{ELEVEN_S + t:.3f}" if moment == "utc_s" else f"2024-03-10T11:00:{t:06.3f}Z"
        rows.append(f"{when},0,0,{t},{place}")
    path = folder / "flight.csv"
    path.write_text("\n".join(rows))
    return path


def dataflash(folder: Path, *, kind: type[DataFlash] = DataFlash, position: str = "POS") -> Path:
    log = kind()
    for t in STEPS_S.tolist():
        log.att(BOOT_S + t, yaw_deg=t)
        place = (0, 0, 0.0) if t < FIX_S else (-349300000, 1386000000, 48.0)
        if position == "POS":
            log.add("POS", "QLLf", "TimeUS,Lat,Lng,Alt", round((BOOT_S + t) * 1e6), *place)
        ms = (11 * 3600 + 18) * 1000 + round(t * 1000)
        values = (round((BOOT_S + t + 0.02) * 1e6), 3, ms, 2305, *place)
        log.add("GPS", "QBIHLLf", "TimeUS,Status,GMS,GWk,Lat,Lng,Alt", *values)
    return log.save(folder / "log.BIN")


def text(folder: Path) -> Path:
    return dataflash(folder, kind=TextLog)


def dataflash_without_pos(folder: Path) -> Path:
    return dataflash(folder, position="GPS")


def telemetry(folder: Path, *, position: str = "GLOBAL_POSITION_INT") -> Path:
    log = Telemetry()
    for t in STEPS_S.tolist():
        log.attitude(BOOT_S + t, t)
        log.time(BOOT_S + t)
        place = (0, 0) if t < FIX_S else (-34.93, 138.60)
        if position == "GLOBAL_POSITION_INT":
            log.place(BOOT_S + t, *place)
        else:
            fix = (3, round(place[0] * 1e7), round(place[1] * 1e7), 48000, 100, 100, 0, 0, 9)
            log.add(common.MAVLink_gps_raw_int_message(round((BOOT_S + t) * 1e6), *fix), BOOT_S + t)
    return log.save(folder / "log.tlog")


def telemetry_without_estimate(folder: Path) -> Path:
    return telemetry(folder, position="GPS_RAW_INT")


def px4(folder: Path) -> Path:
    log = ULog()
    for t in STEPS_S.tolist():
        log.attitude(BOOT_S + t, t)
        log.gps(BOOT_S + t)
        place = (0.0, 0.0, 0.0) if t < FIX_S else (-34.93, 138.60, 48.0)
        values = {name: ("double", value) for name, value in zip(("lat", "lon"), place, strict=False)}
        log.add("vehicle_global_position", BOOT_S + t, **values, alt=("float", place[2]))
    return log.save(folder / "log.ulg")


def dump(folder: Path) -> Path:
    att, pos, gps = ["timestamp,TimeUS,Roll,Pitch,Yaw"], ["timestamp,TimeUS,Lat,Lng,Alt"], []
    gps.append("timestamp,TimeUS,Status,GMS,GWk,Lat,Lng,Alt")
    for t in STEPS_S.tolist():
        us = round((BOOT_S + t) * 1e6)
        place = "0.0,0.0,0.0" if t < FIX_S else "-34.93,138.6,48.0"
        att.append(f"0,{us},0,0,{t}")
        pos.append(f"0,{us},{place}")
        gps.append(f"0,{us + 20000},3,{(11 * 3600 + 18) * 1000 + round(t * 1000)},2305,{place}")
    for name, rows in (("POS", pos), ("GPS", gps), ("ATT", att)):
        (folder / f"log_{name}.csv").write_text("\n".join(rows))
    return folder / "log_ATT.csv"


WRITERS = (table, dataflash, text, dataflash_without_pos, telemetry, telemetry_without_estimate, px4, dump)


@pytest.mark.parametrize("written", WRITERS)
def test_zero_north_zero_east_before_a_fix_is_no_position_in_any_format(
    tmp_path: Path, written: Callable[[Path], Path]
) -> None:
    flight = open_flight(written(tmp_path))

    # Before the fix the first position is used, without interpolation from 0 N 0 E.
    for t in (0.0, 1.0, 1.99, 2.0, 3.0):
        site = flight.position.at(ELEVEN_S + t)
        assert np.rad2deg([site.latitude_rad, site.longitude_rad]) == pytest.approx([-34.93, 138.6], abs=1e-6)
        assert site.height_m == pytest.approx(48.0, abs=0.01)


def test_a_table_without_a_fix_asks_for_the_position(tmp_path: Path) -> None:
    path = table(tmp_path)
    path.write_text(path.read_text().replace("-34.93,138.6,48", "0,0,0"))

    with pytest.raises(
        LogFormatError, match=r"no position \(latitude_deg and longitude_deg are empty, or 0 as without"
    ):
        open_flight(path)


@pytest.mark.parametrize("written", WRITERS)
def test_the_first_attitude_has_its_utc_to_two_milliseconds_in_any_format(
    tmp_path: Path, written: Callable[[Path], Path]
) -> None:
    attitude = open_flight(written(tmp_path)).attitude

    np.testing.assert_allclose(attitude.utc_s, ELEVEN_S + STEPS_S, rtol=0, atol=2e-3)


@pytest.mark.parametrize("moment", ["utc", "utc_s"])
def test_a_tables_times_are_utc_to_the_microsecond(tmp_path: Path, moment: str) -> None:
    flight = open_flight(table(tmp_path, moment=moment))

    np.testing.assert_allclose(flight.attitude.utc_s, ELEVEN_S + STEPS_S, rtol=0, atol=1e-6)
    np.testing.assert_allclose(flight.position.utc_s, ELEVEN_S + STEPS_S[STEPS_S >= FIX_S - 1e-9], rtol=0, atol=1e-6)


def test_gyros_of_a_table_are_read_at_the_time_of_their_row(tmp_path: Path) -> None:
    path = table(tmp_path)
    head, *rows = path.read_text().splitlines()
    head += ",roll_rate_deg_per_s,pitch_rate_deg_per_s,yaw_rate_deg_per_s"
    path.write_text("\n".join([head, *(f"{row},0,0,{n}" for n, row in enumerate(rows))]))

    with open_source(path) as source:
        rates = Recording.read(source).rates

    np.testing.assert_allclose(rates.clock_s, ELEVEN_S + STEPS_S, rtol=0, atol=1e-6)
    np.testing.assert_allclose(np.rad2deg(rates.rate_rad_per_s[:, 2]), np.arange(STEPS_S.size), rtol=0, atol=1e-9)


# --- missing vehicles -----------------------------------------------------------------------------------------------
@pytest.mark.parametrize("absent", [1, 3, 200])
def test_a_vehicle_that_is_not_in_the_log_is_not_replaced_by_another(tmp_path: Path, absent: int) -> None:
    log = Telemetry()
    for system in (2, 7):
        log.heartbeat(sender=(system, 1))
        for t in STEPS_S.tolist():
            log.attitude(BOOT_S + t, t, sender=(system, 1))
            log.time(BOOT_S + t, sender=(system, 1))
    path = log.save(tmp_path / "log.tlog")

    with pytest.raises(
        LogFormatError, match=rf"no attitude of system {absent} \(sysid\); it has that of system 2 and 7$"
    ):
        open_flight(path, sysid=absent)


@pytest.mark.parametrize("written", [table, dataflash, text, px4, dump])
def test_a_log_that_knows_no_vehicles_refuses_the_number_of_one(
    tmp_path: Path, written: Callable[[Path], Path]
) -> None:
    with pytest.raises(LogFormatError, match="is no telemetry log of several vehicles; leave out sysid, which is 3"):
        open_flight(written(tmp_path), sysid=3)


def test_the_csv_of_a_telemetry_log_refuses_a_system_number(tmp_path: Path) -> None:
    rows = ["timestamp,ATTITUDE.time_boot_ms,ATTITUDE.roll,ATTITUDE.pitch,ATTITUDE.yaw"]
    rows += [f"{ELEVEN_S + t},{round(1000 * t) + 1000},0,0,0" for t in STEPS_S.tolist()]
    path = tmp_path / "dump.csv"
    path.write_text("\n".join(rows))

    with pytest.raises(LogFormatError, match="is no telemetry log of several vehicles; leave out sysid, which is 3"):
        open_flight(path, sysid=3)


def test_telemetry_before_alignment_is_left_out_and_reported(tmp_path: Path) -> None:
    log = Telemetry()
    for t in np.arange(0.0, 10.0, 0.04).tolist():
        log.attitude(BOOT_S + t, 10.0)
        if t < 8.0:
            log.add(
                common.MAVLink_attitude_quaternion_message(round((BOOT_S + t) * 1e3), 1.0, 0, 0, 0, 0, 0, 0), BOOT_S + t
            )
        else:
            log.quaternion(BOOT_S + t, 10.0)
        log.time(BOOT_S + t)
        log.place(BOOT_S + t)

    flight = open_flight(log.save(tmp_path / "log.tlog"))

    assert flight.attitude.first_s == pytest.approx(ELEVEN_S + 8.0, abs=2e-3)
    assert flight.notes == (
        "the first 8.0 s of ATTITUDE_QUATERNION are left out, before its estimator was aligned: 2.0 s remain;"
        " --attitude ATTITUDE covers 10.0 s",
    )


# --- accuracy of UTC ------------------------------------------------------------------------------------------------
def log_with_gpa(folder: Path, lag_s: float) -> Path:
    """Write a log with a delay between GPS samples and their records, which GPA reports."""
    log = DataFlash()
    for t in STEPS_S.tolist():
        log.att(BOOT_S + t)
        log.pos(BOOT_S + t)
        log.gps(BOOT_S + t, lag_s=lag_s)
        log.gpa(BOOT_S + t, lag_s=lag_s)
    return log.save(folder / "gpa.BIN")


@pytest.mark.parametrize("lag_s", [0.0004, 0.008, 0.035])
def test_the_lag_of_gps_records_is_measured_by_gpa(tmp_path: Path, lag_s: float) -> None:
    flight = open_flight(log_with_gpa(tmp_path, lag_s))

    [clock] = flight.clocks
    assert (clock.readings, clock.lag_is_measured) == (STEPS_S.size, True)
    assert clock.lag_s == pytest.approx(lag_s, abs=0.0002)
    assert flight.attitude.first_s == pytest.approx(ELEVEN_S, abs=1e-3)


def test_an_assumed_lag_is_reported_as_assumed(tmp_path: Path) -> None:
    [clock] = open_flight(dataflash(tmp_path)).clocks

    assert (clock.lag_s, clock.lag_is_measured) == (0.02, False)


def test_the_spread_of_the_readings_of_utc_is_reported(tmp_path: Path) -> None:
    log = Telemetry()
    for n, t in enumerate(STEPS_S.tolist()):
        log.attitude(BOOT_S + t)
        log.place(BOOT_S + t)
        log.time(BOOT_S + t, utc_s=ELEVEN_S + t + (115_200.0 if n == 20 else 0.003 * (n % 2)))

    flight = open_flight(log.save(tmp_path / "log.tlog"))

    [clock] = flight.clocks
    assert clock.largest_s == pytest.approx(115_200.0, abs=0.01)
    assert clock.spread_s == pytest.approx(0.003, abs=0.001)
    assert clock.lag_s is None
    assert flight.attitude.first_s == pytest.approx(ELEVEN_S, abs=4e-3)


def test_a_flight_whose_utc_was_given_reports_no_readings(tmp_path: Path) -> None:
    assert open_flight(dataflash(tmp_path), utc_start=ELEVEN_S).clocks == ()
    assert open_flight(table(tmp_path)).clocks == ()


def test_the_manifest_has_lag_spread_and_notes(tmp_path: Path) -> None:
    first = dataflash(tmp_path).read_bytes()
    path = tmp_path / "joined.BIN"
    head = b"\xa3\x95\x80\x80\x59FMT\0BBnNZ".ljust(25, b"\0") + b"Type,Length,Name,Format,Columns".ljust(64, b"\0")
    path.write_bytes(first + head + first)

    manifest = prepare_export(Config(), path, tmp_path / "frames", ExportOptions(frames=1)).manifest

    assert manifest["flight"]["clocks"] == [
        {"readings": 41, "spread_s": 0.0, "largest_s": 0.0, "lag_s": 0.02, "lag_is_measured": False, "cut": 0}
    ]
    assert manifest["flight"]["notes"][1].startswith("boot 2, 4.0 s, is left out: it is at the same time as boot 1")
