"""PX4 logs: real ones, compared with known facts and pyulog, and written ones for special cases."""

import random
import re
import struct
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from pyulog import ULog

from glstar.errors import LogFormatError
from glstar.rotation import conjugate, multiply, quaternion_from_euler
from glstar.sky.place.site import Site
from glstar.sky.place.timescale import parse_utc
from glstar.telemetry import LogFacts, RateSamples, TelemetrySource, ULogReader, open_flight
from tests.support.ulog import BOOT_S, ELEVEN_S, LOGS, PLANE, VTOL, Log, times

COPTER = LOGS / "copter_pyulog_sample.ulg"

needs_logs = pytest.mark.skipif(not PLANE.exists(), reason=f"no sample logs in {LOGS}")

HOME = Site(latitude_rad=np.deg2rad(-34.93), longitude_rad=np.deg2rad(138.60), height_m=48.0)


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "log.ulg"


@pytest.fixture
def turn() -> Log:
    """A log of a turn at 10 deg/s, with place and UTC."""
    log = Log()
    for t in times():
        log.attitude(t, 10.0 * (t - BOOT_S))
    for t in times(rate_hz=5):
        log.gps(t)
    return log


# --- real logs ------------------------------------------------------------------------------------------------------
@needs_logs
@pytest.mark.parametrize(
    ("log", "utc", "length_s", "rate_hz", "place_deg", "sources"),
    [
        (
            PLANE,
            "2017-04-17T21:04:30Z",
            530.0,
            86.3,
            (45.22, -93.14),
            ("vehicle_attitude, 89.8 Hz", "vehicle_global_position", "vehicle_gps_position.time_utc_usec, 2622 fixes"),
        ),
        (
            VTOL,
            "2021-04-21T06:30:58Z",
            6.5,
            204.6,
            (63.417, 10.408),
            ("vehicle_attitude, 204.6 Hz", "vehicle_gps_position", "vehicle_gps_position.time_utc_usec, 32 fixes"),
        ),
    ],
    ids=["plane", "VTOL"],
)
def test_a_flight_is_what_was_flown(
    log: Path, utc: str, length_s: float, rate_hz: float, place_deg: tuple[float, float], sources: tuple[str, ...]
) -> None:
    flight = open_flight(log)

    assert flight.attitude.first_s == pytest.approx(parse_utc(utc), abs=0.6)
    assert flight.attitude.last_s - flight.attitude.first_s == pytest.approx(length_s, abs=0.1)
    assert flight.attitude.rate_hz == pytest.approx(rate_hz, abs=0.1)
    site = flight.position.at(flight.attitude.first_s)
    assert np.rad2deg([site.latitude_rad, site.longitude_rad]) == pytest.approx(place_deg, abs=0.006)
    assert (flight.attitude_source, flight.position_source, flight.utc_source) == sources


@needs_logs
@pytest.mark.parametrize("log", [PLANE, COPTER, VTOL], ids=["plane", "copter", "VTOL"])
def test_all_attitudes_that_pyulog_reads_are_read(log: Path) -> None:
    there = ULog(str(log)).get_dataset("vehicle_attitude").data

    attitude = open_flight(log, utc_start=ELEVEN_S, site=HOME).attitude

    q_ned_body = np.stack([there[f"q[{i}]"] for i in range(4)], axis=-1).astype(np.float64)
    np.testing.assert_allclose(conjugate(attitude.q_body_ned), q_ned_body, rtol=0, atol=1e-6)
    np.testing.assert_allclose(
        attitude.utc_s - attitude.first_s, (there["timestamp"] - there["timestamp"][0]) * 1e-6, rtol=0, atol=1e-6
    )


@needs_logs
def test_a_log_without_gps_is_refused_unless_time_and_position_are_given() -> None:
    with pytest.raises(LogFormatError) as caught:
        open_flight(COPTER)
    assert str(caught.value) == (
        f"{COPTER}: the log has no UTC (it has no vehicle_gps_position)"
        " and no position (it has neither vehicle_global_position nor vehicle_gps_position);"
        " give the UTC of its first attitude as utc_start (--utc-start)"
        " and its position as latitude_deg and longitude_deg (--lat, --lon)"
    )

    flight = open_flight(COPTER, utc_start=ELEVEN_S, site=HOME)
    assert flight.attitude.last_s - ELEVEN_S == pytest.approx(69.0, abs=0.2)
    assert flight.attitude_source == "vehicle_attitude, 93.7 Hz"


# --- which attitude -------------------------------------------------------------------------------------------------
def test_the_quaternion_is_turned_from_body_to_ned_into_ned_to_body(path: Path, turn: Log) -> None:
    q = open_flight(turn.save(path)).attitude.at(ELEVEN_S + np.array([0.5, 1.5]))

    np.testing.assert_allclose(q, quaternion_from_euler(0.0, 0.0, np.deg2rad([5.0, 15.0])), rtol=0, atol=1e-6)


def test_attitudes_are_timed_by_their_samples(path: Path, turn: Log) -> None:
    log = Log()
    for t in times():
        log.attitude(t, sampled=True)

    source = open_flight(log.save(path), utc_start=ELEVEN_S, site=HOME).attitude

    assert source.utc_s[1] - source.utc_s[0] == pytest.approx(0.02, abs=1e-6)
    with ULogReader(path) as reader:
        assert next(iter(reader.samples())).clock_s[0] == pytest.approx(BOOT_S, abs=1e-6)


def test_a_correction_of_the_estimator_is_no_rotation(path: Path) -> None:
    log = Log()
    for t in times():
        corrected = t > BOOT_S + 0.99
        log.attitude(t, 40.0 if corrected else 0.0, quat_reset_counter=("uint8_t", 255 if not corrected else 0))
        log.gps(t)

    gaps = open_flight(log.save(path)).attitude.gaps

    [gap] = gaps
    np.testing.assert_allclose([gap.start_utc_s, gap.stop_utc_s], [ELEVEN_S + 0.98, ELEVEN_S + 1.0], rtol=0, atol=1e-5)


def test_a_small_correction_is_a_reset_by_its_counter(path: Path) -> None:
    log = Log()
    for t in times():
        corrected = t > BOOT_S + 0.99
        log.attitude(t, 0.5 if corrected else 0.0, quat_reset_counter=("uint8_t", 7 if not corrected else 8))
        log.gps(t)

    [gap] = open_flight(log.save(path)).attitude.gaps

    assert gap.reason == "a reset of the estimator"
    assert gap.start_utc_s == pytest.approx(ELEVEN_S + 0.98, abs=1e-5)


def test_another_attitude_is_read_by_its_name(path: Path, turn: Log) -> None:
    for t in times():
        turn.attitude(t, 90.0, name="vehicle_attitude_groundtruth")
        turn.attitude(t, 91.0, name="estimator_attitude", instance=0)
        turn.attitude(t, 92.0, name="estimator_attitude", instance=1)
    turn.save(path)

    def yaw_deg(attitude: str) -> float:
        q = open_flight(path, attitude=attitude).attitude.q_body_ned[0]
        return round(float(np.rad2deg(2 * np.arctan2(-q[3], q[0]))), 3)

    assert yaw_deg("auto") == 0.0
    assert yaw_deg("vehicle_attitude_groundtruth") == 90.0
    assert yaw_deg("Estimator_attitude[1]") == 92.0
    assert yaw_deg("estimator_attitude") == 91.0
    assert open_flight(path, attitude="estimator_attitude").attitude_source == (
        "estimator_attitude instance 0 of 0 and 1, 50.0 Hz"
    )


@pytest.mark.parametrize("unknown", ["ATT", "estimator_attitude", "vehicle_attitude[3]", "sensor_gps", "a\n[b"])
def test_a_missing_attitude_is_refused_with_the_available_ones(path: Path, turn: Log, unknown: str) -> None:
    turn.save(path)

    with pytest.raises(LogFormatError) as caught:
        open_flight(path, attitude=unknown)

    assert str(caught.value) == f"{path}: the log has no attitude {unknown!r}; it has vehicle_attitude"


def test_a_log_without_attitude_is_refused(path: Path) -> None:
    log = Log()
    for t in times():
        log.gps(t)

    with pytest.raises(LogFormatError, match=r"the log has no attitude: no vehicle_attitude among its 1 topics$"):
        open_flight(log.save(path))


# --- UTC and position -----------------------------------------------------------------------------------------------
@pytest.mark.parametrize("new", [True, False], ids=["latitude_deg", "lat"])
def test_time_and_position_of_a_receiver_are_read_by_new_and_old_names(path: Path, new: bool) -> None:
    log = Log()
    for t in times():
        log.attitude(t)
        log.gps(t, new=new)

    flight = open_flight(log.save(path))

    site = flight.position.at(ELEVEN_S)
    assert flight.attitude.first_s == pytest.approx(ELEVEN_S, abs=1e-6)
    assert np.rad2deg([site.latitude_rad, site.longitude_rad]) == pytest.approx([-34.93, 138.60], abs=1e-9)
    assert site.height_m == pytest.approx(48.0)


def test_the_estimators_position_is_preferred_to_the_receivers(path: Path, turn: Log) -> None:
    for t in times(rate_hz=10):
        place = {"lat": ("double", -34.94), "lon": ("double", 138.61), "alt": ("float", 50.0)}
        turn.add("vehicle_global_position", t, **place)

    flight = open_flight(turn.save(path))

    assert np.rad2deg(flight.position.at(ELEVEN_S).latitude_rad) == pytest.approx(-34.94, abs=1e-9)
    assert flight.position_source == "vehicle_global_position"


def test_the_age_of_a_repeated_time_is_added(path: Path) -> None:
    log = Log()
    for t in times():
        log.attitude(t)
    for i, t in enumerate(times(rate_hz=5)):
        log.gps(t, age_s=0.2 * (i % 5))

    assert open_flight(log.save(path)).attitude.first_s == pytest.approx(ELEVEN_S, abs=1e-6)


@pytest.mark.parametrize("logged_age_s", [-1351.3, 1351.3, 2147.0, 3.0])
def test_an_age_of_utc_beyond_two_seconds_is_not_used(path: Path, logged_age_s: float) -> None:
    log = Log()
    for t in times():
        log.attitude(t)
        log.gps(t, logged_age_s=logged_age_s)

    flight = open_flight(log.save(path))

    assert flight.attitude.first_s == pytest.approx(ELEVEN_S, abs=1e-6)
    assert flight.notes == (
        "sensor_gps.timestamp_time_relative is not used:"
        f" by it the UTC readings were {logged_age_s:.0f} s old when logged",
    )


@pytest.mark.parametrize("logged_age_s", [0.0, 1351.3])
def test_a_repeated_time_without_an_age_is_used_once(path: Path, logged_age_s: float) -> None:
    log = Log()
    for t in times(duration_s=10.0, rate_hz=5):
        log.attitude(t)
        log.gps(t, age_s=(t - BOOT_S) % 1.0, logged_age_s=logged_age_s)

    assert open_flight(log.save(path)).attitude.first_s == pytest.approx(ELEVEN_S, abs=1e-3)


def test_readings_of_utc_that_are_too_old_are_left_out(path: Path) -> None:
    """A receiver with a UTC reading every ten seconds repeats it: those with a valid age are used."""
    log = Log()
    for t in times(duration_s=20.0, rate_hz=5):
        log.attitude(t)
        log.gps(t, age_s=(t - BOOT_S) % 10.0)

    flight = open_flight(log.save(path))

    assert flight.attitude.first_s == pytest.approx(ELEVEN_S, abs=1e-6)
    assert flight.notes == (
        "78 of 101 UTC readings are left out: by sensor_gps.timestamp_time_relative they were more than 2 s old when"
        " logged",
    )


@pytest.mark.parametrize("kind", ["uint64_t", "int64_t"])
def test_utc_at_boot_is_used_if_no_receiver_has_utc(path: Path, kind: str) -> None:
    log = Log()
    log.CODES = log.CODES | {"int64_t": "q"}
    log.about("boot_time_utc_us", kind, round((ELEVEN_S - BOOT_S) * 1e6))
    for t in times():
        log.attitude(t)
        log.gps(t, utc_s=0.0)

    flight = open_flight(log.save(path))

    assert flight.attitude.first_s == pytest.approx(ELEVEN_S, abs=1e-6)
    assert (flight.utc_source, flight.clocks) == ("boot_time_utc_us", ())
    assert flight.notes[0].startswith("the only UTC of the log is boot_time_utc_us, by PX4's own clock")


def test_utc_of_a_receiver_is_preferred_to_utc_at_boot(path: Path, turn: Log) -> None:
    turn.about("boot_time_utc_us", "uint64_t", round((ELEVEN_S - BOOT_S + 100.0) * 1e6))

    flight = open_flight(turn.save(path))

    assert (flight.attitude.first_s, flight.notes) == (pytest.approx(ELEVEN_S, abs=1e-6), ())


def test_utc_at_boot_before_2010_is_none(path: Path) -> None:
    log = Log()
    log.about("boot_time_utc_us", "uint64_t", 946684800_000000)
    for t in times():
        log.attitude(t)

    with pytest.raises(LogFormatError, match=r"the log has no UTC \(it has no vehicle_gps_position\)"):
        open_flight(log.save(path))


def test_utc_of_a_receiver_with_a_fix_is_preferred(path: Path) -> None:
    """A receiver without a fix has a date of its own, whether it gets a fix later or not."""
    log = Log()
    for t in times(duration_s=10.0, rate_hz=5):
        log.attitude(t)
        log.gps(t, fix=0, utc_s=ELEVEN_S + 4e6 + t)
        log.gps(t, fix=0 if t < BOOT_S + 8.0 else 3, utc_s=ELEVEN_S - 4e6 + t if t < BOOT_S + 8.0 else None, instance=1)

    assert open_flight(log.save(path)).attitude.first_s == pytest.approx(ELEVEN_S, abs=1e-6)


@pytest.mark.parametrize("utc_s", [0.0, 315964800.0], ids=["zero", "1980"])
def test_a_receiver_without_time_or_fix_is_not_used(path: Path, utc_s: float) -> None:
    log = Log()
    for t in times():
        log.attitude(t)
        log.gps(t, utc_s=utc_s, fix=1)

    with pytest.raises(LogFormatError, match=r"GPS never had a time after 2010\) and no position \(its GPS never had"):
        open_flight(log.save(path))


def test_a_simulators_clock_may_be_utc(path: Path) -> None:
    log = Log()
    for t in times():
        log.attitude(ELEVEN_S + t)
        log.gps(ELEVEN_S + t, utc_s=ELEVEN_S + t)

    assert open_flight(log.save(path)).attitude.first_s == pytest.approx(ELEVEN_S + BOOT_S, abs=1e-6)


# --- gyro rates and vehicle -----------------------------------------------------------------------------------------
@needs_logs
@pytest.mark.parametrize(
    ("log", "vehicle", "firmware"),
    [
        (PLANE, "PX4 fixed wing", None),
        (COPTER, "PX4 quadrotor", "PX4 (fd483321) on AUAV_X21"),
        (VTOL, "PX4 VTOL", "PX4 v1.11.2-dev (8583f1da) on CUBEPILOT_CUBEORANGE"),
    ],
    ids=["plane", "copter", "VTOL"],
)
def test_vehicle_and_firmware_of_a_log_are_read(log: Path, vehicle: str, firmware: str | None) -> None:
    with ULogReader(log) as source:
        assert source.facts() == LogFacts("PX4 ULog", vehicle, firmware)


def test_only_attitudes_of_the_aircraft_are_listed(path: Path, turn: Log) -> None:
    for t in times():
        turn.attitude(t, 91.0, name="estimator_attitude", instance=0)
        turn.attitude(t, 92.0, name="estimator_attitude", instance=1)
        turn.attitude(t, 90.0, name="vehicle_attitude_groundtruth")
        turn.attitude(t, 12.0, name="gimbal_device_attitude_status")
    turn.save(path)

    with ULogReader(path) as source:
        reported = dict(source.attitudes())

    assert list(reported) == [
        "estimator_attitude[0]",
        "estimator_attitude[1]",
        "vehicle_attitude",
        "vehicle_attitude_groundtruth",
    ]
    for name, samples in reported.items():
        with ULogReader(path, attitude=name) as source:
            np.testing.assert_array_equal(next(source.samples()).q_body_ned, samples.q_body_ned)


@pytest.mark.parametrize("name", ["gyro_rad", "gyro_rad_s"])
def test_rates_come_from_the_most_frequent_topic(path: Path, turn: Log, name: str) -> None:
    for t in times():
        turn.add("vehicle_angular_velocity", t, xyz=("float", [9.0, 9.0, 9.0]))
    for t in times(rate_hz=100):
        turn.add("sensor_combined", t, **{name: ("float", [0.1, -0.2, 0.175])})

    with ULogReader(turn.save(path)) as source:
        *_, rates = source.samples()

    assert isinstance(rates, RateSamples)
    assert rates.source == "sensor_combined"
    np.testing.assert_allclose(rates.rate_rad_per_s, [[0.1, -0.2, 0.175]] * 201, rtol=0, atol=1e-7)
    np.testing.assert_allclose(rates.clock_s, list(times(rate_hz=100)), rtol=0, atol=1e-6)


@needs_logs
def test_the_gyros_of_a_real_log_turn_as_its_attitude_does() -> None:
    with ULogReader(COPTER) as source:
        attitude, *_, rates = source.samples()

    q_ned_body = conjugate(attitude.q_body_ned)
    turn = multiply(conjugate(q_ned_body[:-1]), q_ned_body[1:])  # in the axes of the body
    step_s = np.diff(attitude.clock_s)
    seen = 2 * turn[:, 1:] * np.sign(turn[:, :1]) / step_s[:, np.newaxis]
    middle_s = attitude.clock_s[:-1] + step_s / 2
    for axis in range(3):
        measured = np.interp(middle_s, rates.clock_s, rates.rate_rad_per_s[:, axis])
        assert np.corrcoef(seen[:, axis], measured)[0, 1] > 0.98
        assert np.polyfit(seen[:, axis], measured, 1)[0] == pytest.approx(1.0, abs=0.05)


# --- damage ---------------------------------------------------------------------------------------------------------
def test_a_log_cut_inside_a_message_ends_with_the_one_before(path: Path, turn: Log) -> None:
    data = turn.data()
    path.write_bytes(data[: len(data) // 2])

    attitude = open_flight(path, utc_start=ELEVEN_S, site=HOME).attitude

    assert attitude.last_s == pytest.approx(ELEVEN_S + 1.1, abs=0.4)
    assert attitude.gaps == ()


def test_damaged_bytes_lose_only_the_messages_that_contain_them(path: Path, turn: Log) -> None:
    data = bytearray(turn.data())
    size = len(turn.samples[0])
    begin = data.index(turn.samples[30])
    data[begin : begin + 2 * size] = bytes(2 * size)  # two samples whole
    data[begin + 10 * size] ^= 0x40  # the size of another
    path.write_bytes(data)

    attitude = open_flight(path).attitude

    lost = ELEVEN_S + np.array([30, 31, 40]) / 50
    expected = np.setdiff1d(np.round(ELEVEN_S + np.arange(101) / 50, 3), np.round(lost, 3))
    np.testing.assert_allclose(attitude.utc_s, expected, rtol=0, atol=1e-5)


def test_a_log_is_read_on_among_messages_of_other_kinds(path: Path, turn: Log) -> None:
    size = len(turn.samples[0])
    text = Log.message("L", b"6" + struct.pack("<Q", 31_000_000) + b"Takeoff detected")
    turn.samples[31:] = [part for sample in turn.samples[31:] for part in (text, sample)]
    data = bytearray(turn.data())
    begin = data.index(turn.samples[30])
    # One sample is damaged: another size, and the number of a topic that nothing subscribes to.
    data[begin : begin + size] = turn.samples[30][:3] + b"\xc8\0" + bytes(size - 5)
    data[begin] ^= 0x40
    path.write_bytes(data)

    attitude = open_flight(path).attitude

    expected = np.delete(ELEVEN_S + np.arange(101) / 50, 30)
    np.testing.assert_allclose(attitude.utc_s, expected, rtol=0, atol=1e-5)


def test_unknown_messages_are_skipped(path: Path, turn: Log) -> None:
    path.write_bytes(turn.data(Log.message("S", bytes(8)), Log.message("I", b"\x08char[2] ver_hwAB")))

    assert open_flight(path).attitude.utc_s.size == 101


def test_a_newer_version_of_ulog_is_refused(path: Path, turn: Log) -> None:
    turn.head += Log.message("B", bytes(8) + b"\x02" + bytes(7 + 24))

    with pytest.raises(LogFormatError, match="newer kind of ULog"):
        open_flight(turn.save(path))


def test_data_appended_after_a_crash_are_read(path: Path, turn: Log) -> None:
    turn.head += Log.message("B", bytes(8) + b"\x01" + bytes(7) + struct.pack("<3Q", 700, 0, 0))

    assert open_flight(turn.save(path)).attitude.utc_s.size == 101


@pytest.mark.parametrize(
    "layout",
    [b"vehicle_attitude:vehicle_attitude[9] x;", b"vehicle_attitude:float[999999999] q;", b"vehicle_attitude:float"],
    ids=["within itself", "endless", "cut"],
)
def test_invalid_definitions_are_ignored(path: Path, turn: Log, layout: bytes) -> None:
    turn.formats["vehicle_attitude"] = Log.message("F", layout)

    with pytest.raises(LogFormatError, match=r"no attitude|definitions are damaged"):
        open_flight(turn.save(path))


def test_damaged_logs_are_read_or_refused_without_output(
    path: Path, turn: Log, capfd: pytest.CaptureFixture[str]
) -> None:
    data, chance = turn.data(), random.Random(3)
    flights = 0
    for _ in range(300):
        mutant = bytearray(data[: chance.choice([len(data), chance.randrange(len(data))])])
        for _ in range(chance.randrange(12)):
            mutant[chance.randrange(chance.choice([600, len(mutant)])) % len(mutant)] = chance.randrange(256)
        path.write_bytes(data[:8] + mutant[8:])
        try:
            flight = open_flight(path, site=HOME)
        except LogFormatError as error:
            assert "\n" not in str(error)  # noqa: PT017
        else:
            flights += 1
            assert flight.attitude.last_s - flight.attitude.first_s < 30 * 86400

    assert flights > 50
    assert capfd.readouterr() == ("", "")


# --- side effects ---------------------------------------------------------------------------------------------------
def test_a_reader_is_a_telemetry_source_and_may_be_closed_twice(path: Path, turn: Log) -> None:
    with ULogReader(turn.save(path)) as source:
        assert isinstance(source, TelemetrySource)
        assert len(list(source.samples())) == 3
    source.close()
    path.unlink()


def test_importing_telemetry_imports_no_pyulog(path: Path, turn: Log) -> None:
    turn.save(path)
    program = f"""
import sys
import glstar.telemetry
assert "pyulog" not in sys.modules
glstar.telemetry.open_flight({str(path)!r})
assert "pyulog" in sys.modules
"""
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=False)

    assert (done.returncode, done.stdout, done.stderr) == (0, "", "")


def test_a_large_file_of_zeros_is_refused_quickly(path: Path) -> None:
    with path.open("wb") as file:
        file.write(Log().data()[:16])
        file.truncate(100_000_000)

    began_s = time.process_time()
    with pytest.raises(LogFormatError, match="no attitude"):
        open_flight(path)
    took_s = time.process_time() - began_s

    zeros = path.read_bytes()[16:]
    began_s = time.process_time()
    assert re.search(rb"[BFIMPQARDLCSO]", zeros) is None  # byte by byte
    # Looking for a record at each zero takes seven times as long as this search.
    assert took_s < 3 * (time.process_time() - began_s)
