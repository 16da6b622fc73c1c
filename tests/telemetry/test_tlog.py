"""Telemetry logs: real ones, compared with known facts and the autopilot's log, and written ones for special cases."""

import os
import random
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from pymavlink.dialects.v20 import common

from glstar.errors import LogFormatError
from glstar.rotation import conjugate, multiply
from glstar.sky.place.site import Site
from glstar.sky.place.timescale import parse_utc
from glstar.telemetry import (
    LogFacts,
    RateSamples,
    TelemetryLogReader,
    TelemetrySource,
    open_flight,
    open_source,
    survey,
)
from glstar.telemetry.mavlink import packets as tlogfile
from glstar.telemetry.mavlink.packets import LogPackets
from tests.support import tlog
from tests.support.tlog import ADELAIDE, BOOT_S, ELEVEN_S, LOGS, ROV, Log, simulated, times

needs_logs = pytest.mark.skipif(not ADELAIDE.exists(), reason=f"no sample logs in {LOGS}")

HOME = Site(latitude_rad=np.deg2rad(-34.93), longitude_rad=np.deg2rad(138.60), height_m=48.0)


def yaw_deg(q_body_ned: np.ndarray) -> np.ndarray:
    return np.rad2deg(2 * np.arctan2(-q_body_ned[..., 3], q_body_ned[..., 0]))


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "log.tlog"


turn = tlog.turn


# --- real logs ------------------------------------------------------------------------------------------------------
@needs_logs
def test_only_required_packets_are_decoded_and_each_once(monkeypatch: pytest.MonkeyPatch) -> None:
    """Decoding takes most of the time: only a quarter of the 75,000 packets is decoded."""
    decoded: list[bytes] = []

    def noted() -> Callable[[bytes], object]:
        decode = decoder()
        return lambda packet: (decoded.append(packet), decode(packet))[1]

    decoder = tlogfile._decoder
    monkeypatch.setattr(tlogfile, "_decoder", noted)

    flight = open_flight(ADELAIDE)

    # Sequence number and check sum differ between nearly all packets.
    assert len(decoded) - len(set(decoded)) < 100
    assert flight.attitude.utc_s.size < len(decoded) < LogPackets(str(ADELAIDE)).count / 3


@needs_logs
def test_the_adelaide_flight_is_what_was_flown() -> None:
    flight = open_flight(ADELAIDE)

    assert flight.attitude.first_s == pytest.approx(parse_utc("2024-03-10T11:00:01.681Z"), abs=0.002)
    assert flight.attitude.utc_s.size == 16607
    assert (flight.attitude_source, flight.position_source) == ("ATTITUDE, 100.0 Hz", "GLOBAL_POSITION_INT")
    assert flight.utc_source == "SYSTEM_TIME, 317 readings"
    site = flight.position.at(flight.attitude.first_s)
    assert np.rad2deg([site.latitude_rad, site.longitude_rad]) == pytest.approx([-34.81, 138.62], abs=0.005)


@needs_logs
def test_the_autopilots_own_log_of_the_same_flight_agrees() -> None:
    sent, logged = open_flight(ADELAIDE).attitude, open_flight(LOGS / "plane_SITL_adelaide_200Hz.BIN").attitude

    def separation_deg(later_s: float) -> float:
        at_s = sent.utc_s[(sent.utc_s > logged.first_s + 0.1) & (sent.utc_s < logged.last_s - 0.1)]
        turn = multiply(logged.at(at_s - later_s), conjugate(sent.at(at_s)))
        return float(np.rad2deg(2 * np.arctan2(np.linalg.norm(turn[:, 1:], axis=-1), np.abs(turn[:, 0]))).max())

    shifts_s = np.arange(-0.030, 0.031, 0.001)
    separations_deg = np.array([separation_deg(shift) for shift in shifts_s])

    assert separations_deg.min() < 0.1
    assert abs(shifts_s[separations_deg.argmin()]) < 0.005


@needs_logs
def test_utc_of_a_ground_station_is_used_if_the_autopilot_has_none() -> None:
    flight = open_flight(ROV)

    assert flight.attitude.first_s == pytest.approx(parse_utc("2023-05-04T17:15:40.8Z"), abs=0.1)
    assert flight.attitude.last_s - flight.attitude.first_s == pytest.approx(263.6, abs=0.1)
    assert flight.attitude_source == "ATTITUDE, 19.9 Hz"
    assert flight.utc_source == "SYSTEM_TIME of system 255, component 190, on arrival, 2 readings"
    site = flight.position.at(flight.attitude.first_s)
    assert np.rad2deg([site.latitude_rad, site.longitude_rad]) == pytest.approx([48.386, -124.631], abs=0.001)


# --- which attitude -------------------------------------------------------------------------------------------------
@pytest.mark.parametrize("v1", [False, True], ids=["MAVLink 2", "MAVLink 1"])
def test_angles_are_an_attitude(path: Path, v1: bool) -> None:
    log = Log()
    for t in times():
        log.attitude(t, 10.0 * (t - BOOT_S), v1=v1)

    flight = open_flight(log.save(path), utc_start=ELEVEN_S, site=HOME)

    np.testing.assert_allclose(
        yaw_deg(flight.attitude.at(ELEVEN_S + np.array([0.5, 1.5]))), [5.0, 15.0], rtol=0, atol=1e-4
    )


def test_the_quaternion_is_preferred_to_angles_unless_it_is_sparse(path: Path, turn: Log) -> None:
    for t in times():
        turn.quaternion(t, 90.0)
    flight = open_flight(turn.save(path))
    assert flight.attitude_source == "ATTITUDE_QUATERNION, 50.0 Hz"
    np.testing.assert_allclose(yaw_deg(flight.attitude.q_body_ned), 90.0, rtol=0, atol=1e-4)
    assert open_flight(path, attitude="attitude").attitude_source == "ATTITUDE, 50.0 Hz"

    rare = Log()
    for t in times():
        rare.attitude(t)
    for t in times(rate_hz=4):
        rare.quaternion(t, 90.0)
    assert open_flight(rare.save(path), utc_start=ELEVEN_S, site=HOME).attitude_source == "ATTITUDE, 50.0 Hz"


def test_samples_before_the_alignment_of_an_estimator_are_dropped(path: Path) -> None:
    log = Log()
    for t in times():
        log.quaternion(t, 0.0 if t < BOOT_S + 0.99 else 90.0)

    assert open_flight(log.save(path), utc_start=ELEVEN_S, site=HOME).attitude.utc_s.size == 51


def test_a_missing_attitude_is_refused_with_the_available_ones(path: Path, turn: Log) -> None:
    turn.save(path)

    with pytest.raises(LogFormatError) as caught:
        open_flight(path, attitude="XKQ")

    assert str(caught.value) == f"{path}: the log has no attitude 'XKQ'; it has ATTITUDE"


def test_a_log_without_attitude_is_refused(path: Path) -> None:
    log = Log()
    log.heartbeat()
    log.place(BOOT_S)

    with pytest.raises(LogFormatError, match="no attitude: no ATTITUDE_QUATERNION or ATTITUDE in 2 packets"):
        open_flight(log.save(path))


# --- which vehicle --------------------------------------------------------------------------------------------------
def test_attitudes_of_other_components_are_ignored(path: Path) -> None:
    log = Log()
    log.heartbeat(sender=(1, 154), autopilot=8)  # a gimbal, which reports its own attitude
    log.heartbeat(sender=(255, 190), autopilot=8)
    log.heartbeat(sender=(1, 1))
    for t in times():
        log.attitude(t, 45.0, sender=(1, 154))
        log.attitude(t, 5.0)

    flight = open_flight(log.save(path), utc_start=ELEVEN_S, site=HOME)

    np.testing.assert_allclose(yaw_deg(flight.attitude.q_body_ned), 5.0, rtol=0, atol=1e-4)
    assert flight.attitude_source == "ATTITUDE, 50.0 Hz"


def test_the_first_of_several_vehicles_or_the_named_one_is_used_and_reported(path: Path) -> None:
    log = Log()
    for system in (7, 2, 9):
        log.heartbeat(sender=(system, 1))
    for t in times():
        log.attitude(t, 20.0, sender=(2, 1))
        log.attitude(t, 70.0, sender=(7, 1))
    log.save(path)

    first = open_flight(path, utc_start=ELEVEN_S, site=HOME)
    assert first.attitude_source == "ATTITUDE of system 2 (of 2 and 7; sysid chooses), 50.0 Hz"
    np.testing.assert_allclose(yaw_deg(first.attitude.q_body_ned), 20.0, rtol=0, atol=1e-4)

    named = open_flight(path, utc_start=ELEVEN_S, site=HOME, sysid=7)
    np.testing.assert_allclose(yaw_deg(named.attitude.q_body_ned), 70.0, rtol=0, atol=1e-4)

    with pytest.raises(LogFormatError, match=r"no attitude of system 9 \(sysid\); it has that of system 2 and 7$"):
        open_flight(path, sysid=9)


# --- UTC and position -----------------------------------------------------------------------------------------------
def test_utc_comes_from_the_autopilot_not_from_the_recorder(path: Path, turn: Log) -> None:
    turn.time(BOOT_S + 1, utc_s=0.0)
    turn.time(BOOT_S + 1, utc_s=315964800.0)
    turn.time(BOOT_S + 1, utc_s=ELEVEN_S + 5)  # a late one

    flight = open_flight(turn.save(path))

    assert flight.attitude.first_s == pytest.approx(ELEVEN_S, abs=1e-6)
    assert flight.utc_source == "SYSTEM_TIME, 12 readings"


@pytest.mark.parametrize(("until_s", "off_s"), [(12.0, -3600.5), (18.5, -0.3), (3.0, 86400.0), (2.5, 40.0)])
def test_utc_after_a_correction_is_used(path: Path, until_s: float, off_s: float) -> None:
    """The autopilot has the clock of a ground station until its GPS knows UTC."""
    log = Log()
    for t in times(duration_s=20.0, rate_hz=5):
        log.attitude(t)
        log.place(t)
        if round(5 * t) % 5 == 0:
            log.time(t, utc_s=ELEVEN_S + t - BOOT_S + (off_s if t < BOOT_S + until_s else 0.0))

    flight = open_flight(log.save(path))

    assert flight.attitude.first_s == pytest.approx(ELEVEN_S, abs=1e-3)
    [note] = flight.notes
    left_out = int(np.ceil(until_s))
    assert note == (
        f"{left_out} of 21 readings of SYSTEM_TIME are left out: the autopilot then corrected its UTC by"
        f" {-off_s:+.1f} s without a reboot, as when its GPS replaces the clock of a ground station"
    )


def test_a_last_reading_that_differs_is_reported(path: Path, turn: Log) -> None:
    turn.time(BOOT_S + 2.5, utc_s=ELEVEN_S + 3602.5)

    flight = open_flight(turn.save(path))

    assert flight.attitude.first_s == pytest.approx(ELEVEN_S, abs=1e-3)
    assert flight.notes == ("the last reading of SYSTEM_TIME is +3600.0 s from the others, which are used",)


@pytest.mark.parametrize("length_s", [40.0, 400.0])
def test_utc_that_is_corrected_while_the_link_is_lost_is_one_boot(path: Path, length_s: float) -> None:
    log = Log()
    for t in times(duration_s=length_s, rate_hz=5):
        if not 0.3 * length_s < t - BOOT_S < 0.6 * length_s:
            log.attitude(t)
            log.place(t)
            log.time(t, utc_s=ELEVEN_S + t - BOOT_S - (3600.0 if t - BOOT_S < 0.5 * length_s else 0.0))

    flight = open_flight(log.save(path))

    assert (flight.attitude.first_s, flight.attitude.last_s) == (
        pytest.approx(ELEVEN_S, abs=1e-3),
        pytest.approx(ELEVEN_S + length_s, abs=1e-3),
    )


def test_utc_of_another_component_counts_when_it_arrives_before_that_of_another_system(path: Path) -> None:
    log = Log()
    for t in times():
        log.attitude(t)
        log.place(t)
    log.time(BOOT_S + 1, utc_s=0.0)
    log.time(BOOT_S + 1, sender=(255, 190), utc_s=ELEVEN_S + 60, boot_ms=0)
    log.time(BOOT_S + 1, sender=(1, 191), boot_ms=5)

    flight = open_flight(log.save(path))

    assert flight.attitude.first_s == pytest.approx(ELEVEN_S, abs=1e-3)
    assert flight.utc_source == "SYSTEM_TIME of system 1, component 191, on arrival, 1 readings"


def test_a_log_without_utc_is_refused_with_the_recorders_time(path: Path) -> None:
    log = Log()
    for t in times():
        log.attitude(t)
    log.save(path)

    with pytest.raises(LogFormatError) as caught:
        open_flight(path)

    assert str(caught.value) == (
        f"{path}: the log has no UTC (it has no SYSTEM_TIME;"
        " the recorder's own clock said 2026-01-01T00:00:00.500000Z)"
        " and no position (it has no GLOBAL_POSITION_INT);"
        " give the UTC of its first attitude as utc_start (--utc-start)"
        " and its position as latitude_deg and longitude_deg (--lat, --lon)"
    )


def test_an_estimator_without_an_origin_has_no_position(path: Path, turn: Log) -> None:
    turn.place(BOOT_S + 0.01, 0.0000165, 0.000016)

    flight = open_flight(turn.save(path))

    np.testing.assert_allclose(np.rad2deg(flight.position.latitude_rad), -34.93, rtol=0, atol=1e-9)


# --- gyro rates and vehicle -----------------------------------------------------------------------------------------
@pytest.mark.parametrize("name", ["raw", "scaled", "highres"])
def test_gyro_rates_are_converted_to_rad_per_s(path: Path, turn: Log, name: str) -> None:
    for t in times(rate_hz=100):
        turn.imu(t, [0.1, -0.2, 0.175], name)

    with TelemetryLogReader(turn.save(path)) as source:
        *_, rates = source.samples()

    assert isinstance(rates, RateSamples)
    np.testing.assert_allclose(rates.rate_rad_per_s, [[0.1, -0.2, 0.175]] * 201, rtol=0, atol=1e-6)
    np.testing.assert_allclose(rates.clock_s, list(times(rate_hz=100)), rtol=0, atol=1e-3)


def test_a_32_bit_microsecond_count_of_a_gyro_is_unwrapped(path: Path, turn: Log) -> None:
    hours = Log()
    hours.heartbeat(20000.0)
    for t in times(start_s=20000.0):
        hours.attitude(t)
        hours.imu(t, [0.0, 0.0, 0.1], boot_us=round(t * 1e6) % 2**32)

    with TelemetryLogReader(hours.save(path)) as source:
        *_, rates = source.samples()

    np.testing.assert_allclose(rates.clock_s, list(times(start_s=20000.0)), rtol=0, atol=1e-3)


def test_sparse_gyro_rates_and_rates_without_a_unit_are_ignored(path: Path, turn: Log) -> None:
    for t in times(rate_hz=2):
        turn.imu(t, [0.0, 0.0, 0.1])
    other = Log()
    other.heartbeat(autopilot=12)
    for t in times():
        other.attitude(t)
        other.imu(t, [0.0, 0.0, 0.1])

    for log in (turn, other):
        with TelemetryLogReader(log.save(path)) as source:
            assert not any(isinstance(batch, RateSamples) for batch in source.samples())


@needs_logs
def test_vehicle_and_firmware_of_real_logs_are_read() -> None:
    with TelemetryLogReader(ROV) as source:
        facts, named = source.facts(), [name for name, _ in source.attitudes()]

    assert (facts.vehicle, facts.firmware) == ("ArduSub", "ArduSub V4.1.1 BETA5 (66c674c1)")
    assert named == ["ATTITUDE"]


@needs_logs
def test_the_gyros_of_a_real_log_turn_as_its_attitude_does() -> None:
    packets = LogPackets(str(ROV))
    raw, attitude = packets.rows("RAW_IMU", (1, 1)), packets.rows("ATTITUDE", (1, 1))
    t, euler = attitude[:, 4] / 1e3, np.unwrap(attitude[:, 5:], axis=0)
    rate = np.gradient(euler, t, axis=0)  # in level flight the rates of the angles are about the body rates
    for axis in range(3):
        smooth = np.convolve(rate[:, axis], np.ones(5) / 5, "same")
        seen = np.interp(raw[:, 4] / 1e6, t, smooth)
        assert np.corrcoef(seen, raw[:, 5 + axis])[0, 1] > 0.9
        assert np.polyfit(seen, raw[:, 5 + axis] * 1e-3, 1)[0] == pytest.approx(1.0, abs=0.25)


def test_the_firmware_comes_from_the_version_without_a_banner(path: Path) -> None:
    log = Log()
    log.heartbeat(autopilot=12)
    version = (0, 0x010E0300 | 255, 0, 0, 0, [0] * 8, [0] * 8, [0] * 8, 0, 0, 0)
    log.add(common.MAVLink_autopilot_version_message(*version), BOOT_S)
    for t in times():
        log.attitude(t)
        log.quaternion(t)

    with TelemetryLogReader(log.save(path)) as source:
        assert source.facts() == LogFacts("MAVLink telemetry log", "PX4 fixed wing", "PX4 v1.14.3")
        assert [name for name, _ in source.attitudes()] == ["ATTITUDE_QUATERNION", "ATTITUDE"]


def test_positions_of_a_receiver_are_used_without_an_estimators(path: Path) -> None:
    log = Log()
    for t in times():
        log.attitude(t)
        log.place(t, 0.0, 0.0)
    for t in times(rate_hz=5):
        fix = 1 if t < BOOT_S + 0.9 else 3
        place = (-349300000, 1386000000, 48000) if fix == 3 else (0, 0, 0)
        log.add(common.MAVLink_gps_raw_int_message(round(t * 1e6), fix, *place, 0, 0, 0, 0, 9), t)

    flight = open_flight(log.save(path), utc_start=ELEVEN_S)

    assert flight.position_source == "GPS_RAW_INT"
    np.testing.assert_allclose(np.rad2deg(flight.position.latitude_rad), -34.93, rtol=0, atol=1e-9)


# --- the autopilot's clock ------------------------------------------------------------------------------------------
def test_a_reboot_begins_a_segment_and_utc_continues(path: Path, turn: Log) -> None:
    turn.stamp_s += 60.0 + BOOT_S  # a minute after the first boot's 30 s, the autopilot begins at 0 again
    for t in times(start_s=0.0):
        turn.attitude(t, 120.0)
        turn.time(t, utc_s=ELEVEN_S + 60.0 + t)

    attitude = open_flight(turn.save(path)).attitude

    [gap] = attitude.gaps
    np.testing.assert_allclose([gap.start_utc_s, gap.stop_utc_s], [ELEVEN_S + 2.0, ELEVEN_S + 60.0], rtol=0, atol=1e-3)
    np.testing.assert_allclose(yaw_deg(attitude.at(ELEVEN_S + np.array([1.0, 61.0]))), [10.0, 120.0], rtol=0, atol=1e-3)


def test_a_boot_without_utc_is_placed_by_the_recorders_clock(path: Path, turn: Log) -> None:
    turn.stamp_s += 60.0 + BOOT_S
    for t in times(start_s=0.0):
        turn.attitude(t, 120.0)

    attitude = open_flight(turn.save(path)).attitude

    assert attitude.last_s == pytest.approx(ELEVEN_S + 62.0, abs=1e-3)


def test_a_wrapped_clock_is_continued(path: Path) -> None:
    log, over_s = Log(), 2**32 / 1000
    for t in times(start_s=over_s - 1.0):
        log.attitude(t, 10.0 * (t - over_s + 1))

    attitude = open_flight(log.save(path), utc_start=ELEVEN_S, site=HOME).attitude

    assert attitude.last_s - attitude.first_s == pytest.approx(2.0, abs=1e-3)
    assert attitude.gaps == ()
    np.testing.assert_allclose(yaw_deg(attitude.at([ELEVEN_S + 1.5])), 15.0, rtol=0, atol=0.01)


def test_the_utc_of_a_clock_that_wraps_goes_on_in_one_boot(path: Path) -> None:
    log, begins_s = Log(), 2**32 / 1000 - 15.0
    for k, t in enumerate(times(30.0, start_s=begins_s)):
        log.attitude(t, 2.0 * (t - begins_s))
        if k % 25 == 0:
            log.time(t, utc_s=ELEVEN_S + t - begins_s)
    log.save(path)

    attitude = open_flight(path, site=HOME).attitude

    with open_source(path) as source:
        assert len(source.boots()) == 1
    assert attitude.first_s == pytest.approx(ELEVEN_S, rel=0, abs=2e-3)
    assert attitude.last_s == pytest.approx(ELEVEN_S + 30.0, rel=0, abs=2e-3)
    np.testing.assert_allclose(yaw_deg(attitude.at([ELEVEN_S + 25.0])), 50.0, rtol=0, atol=0.01)


def test_packets_out_of_order_are_sorted(path: Path, turn: Log) -> None:
    head, *rest = turn.packets
    for at in range(0, 90, 10):
        rest[at], rest[at + 3] = rest[at + 3], rest[at]
    turn.packets = [head, *rest]

    attitude = open_flight(turn.save(path)).attitude

    assert attitude.utc_s.size == 101
    assert attitude.gaps == ()


# --- damage ---------------------------------------------------------------------------------------------------------
def test_a_log_cut_inside_a_packet_ends_with_the_one_before(path: Path, turn: Log) -> None:
    path.write_bytes(b"".join(turn.packets[:60]) + turn.packets[60][:20])

    assert open_flight(path, utc_start=ELEVEN_S, site=HOME).attitude.utc_s.size == 59


def test_damaged_bytes_lose_only_the_packets_that_contain_them(path: Path, turn: Log) -> None:
    damaged = [bytearray(packet) for packet in turn.packets]
    damaged[10][8] ^= 0xFF  # where a packet begins
    damaged[20][9] ^= 0x05  # how long it is
    damaged[30][20] ^= 0x01  # what it says
    damaged[40] = bytearray(b"noise")
    path.write_bytes(b"".join(damaged))

    attitude = open_flight(path).attitude

    kept = np.setdiff1d(np.arange(101), np.array([10, 20, 30, 40]) - 1)
    np.testing.assert_allclose(attitude.utc_s, ELEVEN_S + kept / 50, rtol=0, atol=1e-5)


def test_a_log_with_damaged_first_packets_is_recognised(path: Path, turn: Log) -> None:
    data = bytearray(turn.data())
    data[0] = 0x7F  # the stamp
    data[len(turn.packets[0]) + 8] = 0  # the second packet
    path.write_bytes(data)

    assert open_flight(path).attitude.utc_s.size == 100


def test_damaged_logs_are_read_or_refused_without_output(
    path: Path, turn: Log, capfd: pytest.CaptureFixture[str]
) -> None:
    data, chance = turn.data(), random.Random(3)
    flights = 0
    for _ in range(300):
        mutant = bytearray(data[: chance.choice([len(data), chance.randrange(20, len(data))])])
        for _ in range(chance.randrange(12)):
            mutant[chance.randrange(chance.choice([600, len(mutant)])) % len(mutant)] = chance.randrange(256)
        path.write_bytes(data[:9] + mutant[9:])
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
    with TelemetryLogReader(turn.save(path)) as source:
        assert isinstance(source, TelemetrySource)
        # Attitude, position, UTC, and the flight mode of the heartbeats.
        assert len(list(source.samples())) == 4
    source.close()
    path.unlink()


def test_reading_does_not_change_the_environment(path: Path, turn: Log) -> None:
    turn.save(path)
    program = f"""
import os, sys
import glstar.telemetry
assert "pymavlink" not in sys.modules
before = dict(os.environ)
glstar.telemetry.open_flight({str(path)!r})
assert "pymavlink.dialects.v20.common" in sys.modules
assert "pymavlink.mavutil" not in sys.modules
assert dict(os.environ) == before
"""
    clean = {key: value for key, value in os.environ.items() if not key.startswith("MAVLINK")}
    done = subprocess.run([sys.executable, "-c", program], env=clean, capture_output=True, text=True, check=False)

    assert (done.returncode, done.stdout, done.stderr) == (0, "", "")


@pytest.mark.parametrize("timed_by_utc", [True, False])
def test_a_simulators_state_is_attitude_position_and_time(path: Path, timed_by_utc: bool) -> None:
    flight = open_flight(simulated(timed_by_utc=timed_by_utc).save(path))

    assert flight.attitude.first_s == pytest.approx(ELEVEN_S, rel=0, abs=1e-3)
    assert flight.attitude.utc_s.size == 101
    np.testing.assert_allclose(
        yaw_deg(flight.attitude.q_body_ned), 10.0 * (flight.attitude.utc_s - ELEVEN_S), rtol=0, atol=1e-2
    )
    assert flight.attitude_source == "HIL_STATE_QUATERNION, 50.0 Hz"
    assert flight.position_source == "HIL_STATE_QUATERNION"
    site = flight.position.at(ELEVEN_S)
    np.testing.assert_allclose(np.rad2deg([site.latitude_rad, site.longitude_rad]), [-34.93, 138.6], rtol=0, atol=1e-9)
    assert site.height_m == 300.0
    expected = "HIL_STATE_QUATERNION, timed by UTC" if timed_by_utc else "SYSTEM_TIME, 11 readings"
    assert flight.utc_source == expected
    assert flight.notes == (
        "the attitude is a simulator's own state (HIL_STATE_QUATERNION), not an estimate of an autopilot",
    )


def test_an_autopilots_attitude_is_preferred_to_a_simulators_state(path: Path, turn: Log) -> None:
    for t in times():
        turn.hil_state(ELEVEN_S + 100.0 + t, 170.0, t)

    flight = open_flight(turn.save(path))

    assert flight.attitude_source == "ATTITUDE, 50.0 Hz"
    assert flight.notes == ()
    assert yaw_deg(flight.attitude.q_body_ned[-1]) == pytest.approx(20.0, rel=0, abs=1e-2)


def test_a_system_with_a_simulators_state_only_can_be_chosen_beside_another_system(path: Path, turn: Log) -> None:
    turn.heartbeat(sender=(2, 1))
    for t in times():
        turn.hil_state(t, 70.0, t, sender=(2, 1))
        turn.time(t, sender=(2, 1))

    assert open_flight(turn.save(path)).attitude_source == "ATTITUDE of system 1 (of 1 and 2; sysid chooses), 50.0 Hz"
    flight = open_flight(path, sysid=2)
    assert flight.attitude_source.startswith("HIL_STATE_QUATERNION of system 2")
    assert yaw_deg(flight.attitude.q_body_ned[0]) == pytest.approx(70.0, rel=0, abs=1e-2)


# --- data of another format -----------------------------------------------------------------------------------------
def test_the_second_half_of_a_log_of_another_format_is_reported(path: Path, turn: Log) -> None:
    chance = random.Random(16)
    path.write_bytes(turn.data() + chance.randbytes(200_000))

    with open_source(path) as source:
        found, flight = survey(source)

    assert flight.attitude.utc_s.size == 101
    assert found.notes == (
        "0.2 MB of the file, 98%, could not be read:"
        " damage, or part of a log of another format than MAVLink telemetry log",
    )


def test_a_few_damaged_bytes_are_not_reported(path: Path, turn: Log) -> None:
    path.write_bytes(turn.data() + bytes(1000))

    with open_source(path) as source:
        assert survey(source)[0].notes == ()
