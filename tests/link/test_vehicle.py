"""A flight that is sent as an autopilot sends it: its messages, their times, and its answers to requests."""

from collections import Counter
from math import cos, hypot, radians
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from glstar.errors import ConfigError
from glstar.flight import AttitudeTrack, Flight, Gap, PositionTrack
from glstar.link import vehicle as vehiclefile
from glstar.link.packets import Framer, dialect
from glstar.link.vehicle import PlayedFlight, Vehicle

M = dialect()
UTC_S = 1_710_068_400.0
# Turn rates about the axes of the aircraft are constant: it yaws.
YAW_DEG, YAW_RATE_DEG_PER_S = 350.0, 8.0
EARTH_M = 6371008.8


def flight_of(length_s: float = 2.05, *gaps_s: tuple[float, float]) -> Flight:
    """Return an aircraft at latitude -60 deg that flies 30 m/s north, 40 m/s east and climbs at 2.5 m/s."""
    at_s = np.linspace(0.0, length_s, 42)
    yaw = Rotation.from_euler("Z", (YAW_DEG + YAW_RATE_DEG_PER_S * at_s)[:, np.newaxis], degrees=True)
    gaps = tuple(Gap(UTC_S + start, UTC_S + stop, "a data gap") for start, stop in gaps_s)
    track = AttitudeTrack(UTC_S + at_s, np.roll(yaw.inv().as_quat(), 1, axis=-1), gaps=gaps)
    around_s = np.array([-10.0, 10.0 + length_s])
    latitude_rad = radians(-60) + 30.0 * around_s / EARTH_M
    longitude_rad = radians(179.9999) + 40.0 * around_s / EARTH_M / cos(radians(60))
    position = PositionTrack.from_samples(UTC_S + around_s, latitude_rad, longitude_rad, 300.0 + 2.5 * around_s)
    return Flight(track, position)


class Cable:
    """A transport that keeps what is written; each read takes its time, and returns what waits."""

    def __init__(self, clock: list[float], *, slow_s: float = 0.0) -> None:
        self.clock, self.slow_s = clock, slow_s
        self.sent: list[Any] = []
        self.waiting: list[bytes] = []
        self.reads_s: list[float] = []
        self._framer = Framer()

    def write(self, packet: bytes) -> None:
        [one] = self._framer.feed(packet)
        self.sent.append(M.MAVLink(None).decode(bytearray(one.content)))

    def read(self, timeout_s: float) -> bytes:
        self.reads_s.append(timeout_s)
        self.clock[0] += max(timeout_s, self.slow_s, 1e-6)
        return self.waiting.pop(0) if self.waiting else b""

    def of(self, kind: str) -> list[Any]:
        return [message for message in self.sent if message.get_type() == kind]


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> list[float]:
    now_s = [50.0]
    monkeypatch.setattr(vehiclefile, "time", SimpleNamespace(monotonic=lambda: now_s[0]))
    return now_s


def vehicle_of(clock: list[float], flight: Flight | None = None, **options: Any) -> tuple[Vehicle, Cable]:
    cable = Cable(clock, slow_s=options.pop("slow_s", 0.0))
    return Vehicle(flight or flight_of(), cable, **options), cable  # type: ignore[arg-type]


def test_messages_are_sent_at_their_rates_until_the_flight_ends(clock: list[float]) -> None:
    vehicle, cable = vehicle_of(clock)
    seconds: list[float] = []

    played = vehicle.run(on_second=seconds.append)

    assert Counter(message.get_type() for message in cable.sent) == {
        "HEARTBEAT": 3,
        "SYSTEM_TIME": 5,
        "ATTITUDE": 21,
        "ATTITUDE_QUATERNION": 103,
        "GLOBAL_POSITION_INT": 11,
        "GPS_RAW_INT": 3,
    }
    assert played == PlayedFlight(pytest.approx(2.05), 146, 0)
    assert [message.time_boot_ms for message in cable.of("ATTITUDE")] == list(range(0, 2001, 100))
    assert [message.get_seq() for message in cable.sent] == [k % 256 for k in range(146)]
    assert {(message.get_srcSystem(), message.get_srcComponent()) for message in cable.sent} == {(1, 1)}
    assert seconds == pytest.approx([1.0, 2.0], rel=0, abs=0.021)
    assert max(cable.reads_s) <= 0.1
    assert clock[0] == pytest.approx(52.05, rel=0, abs=0.1)


def test_a_part_of_a_flight_is_played_faster_and_again(clock: list[float]) -> None:
    vehicle, cable = vehicle_of(clock, start_s=0.54, speed=2.0, rate_hz=20.0, sysid=7, loop=True)
    stop: Any = SimpleNamespace(is_set=lambda: len(cable.of("ATTITUDE_QUATERNION")) >= 52)

    played = vehicle.run(stop)

    # Of 1.51 s each round has 31 quaternions, and their time since boot begins at 0.
    stamps = [message.time_boot_ms for message in cable.of("ATTITUDE_QUATERNION")]
    assert stamps[:31] == list(range(0, 1501, 50))
    assert stamps[31:52] == list(range(0, 1001, 50))
    assert cable.of("SYSTEM_TIME")[1].time_unix_usec == round((UTC_S + 0.54 + 0.5) * 1e6)
    assert 2.5 <= played.duration_s < 2.6
    assert {message.get_srcSystem() for message in cable.sent} == {7}
    # Twice as fast as the clock.
    assert clock[0] - 50 == pytest.approx(played.duration_s / 2, rel=0, abs=0.06)


def test_messages_that_the_link_cannot_carry_are_dropped(clock: list[float]) -> None:
    vehicle, cable = vehicle_of(clock, slow_s=1.005)

    played = vehicle.run()

    # After 1.005 s those of the last 0.2 s are sent: from 0.80 s on; 0.02 to 0.78 s are missing.
    stamps = [message.time_boot_ms for message in cable.of("ATTITUDE_QUATERNION")]
    assert stamps == [0, *range(800, 1001, 20), *range(1800, 2001, 20)]
    assert [message.time_boot_ms for message in cable.of("ATTITUDE")] == [0, 800, 900, 1000, 1800, 1900, 2000]
    # Of 50 Hz 39 are missing each time, of 10 Hz seven, of 5 Hz three; slower ones are late, but there.
    assert played.dropped == 2 * (39 + 7 + 3)
    assert [message.time_boot_ms for message in cable.of("SYSTEM_TIME")] == [0, 500, 1000, 1500, 2000]
    assert played.packets == len(cable.sent)


def test_each_message_has_the_state_of_the_flight_at_its_time(clock: list[float]) -> None:
    vehicle, _ = vehicle_of(clock)
    boot_ms, at_s = 1500, 1.5
    yaw_deg = (YAW_DEG + YAW_RATE_DEG_PER_S * at_s) % 360  # 2 deg

    beat = vehicle._heartbeat(0)
    armed = M.MAV_MODE_FLAG_SAFETY_ARMED | M.MAV_MODE_FLAG_STABILIZE_ENABLED
    assert (beat.type, beat.autopilot, beat.base_mode) == (M.MAV_TYPE_FIXED_WING, M.MAV_AUTOPILOT_GENERIC, armed)
    assert (beat.custom_mode, beat.system_status, beat.mavlink_version) == (0, M.MAV_STATE_ACTIVE, 3)
    time = vehicle._system_time(boot_ms)
    assert (time.time_unix_usec, time.time_boot_ms) == (round((UTC_S + 1.5) * 1e6), 1500)
    q = vehicle._quaternion(boot_ms)
    body = Rotation.from_quat([q.q2, q.q3, q.q4, q.q1])
    assert (body * Rotation.from_euler("Z", yaw_deg, degrees=True).inv()).magnitude() < 1e-7
    angles = vehicle._euler(boot_ms)
    assert (angles.roll, angles.pitch, angles.yaw) == pytest.approx((0, 0, radians(yaw_deg)), rel=0, abs=1e-7)
    for message in (q, angles):
        assert message.time_boot_ms == 1500
        rates = (message.rollspeed, message.pitchspeed, message.yawspeed)
        assert rates == pytest.approx((0, 0, radians(YAW_RATE_DEG_PER_S)), rel=0, abs=1e-4)
    place, fix = vehicle._position(boot_ms), vehicle._gps(boot_ms)
    east_deg = 179.9999 + np.degrees(40 * 1.5 / EARTH_M / cos(radians(60)))
    expected = (-60 + np.degrees(30 * 1.5 / EARTH_M), east_deg - 360, 303_750)
    for message in (place, fix):
        assert (message.lat * 1e-7, message.lon * 1e-7) == pytest.approx(expected[:2], rel=0, abs=2e-7)
        assert message.alt == pytest.approx(expected[2], rel=0, abs=1)
    assert (place.time_boot_ms, place.relative_alt, place.hdg) == (1500, place.alt, 200)
    assert (place.vx, place.vy, place.vz) == pytest.approx((3000, 4000, -250), rel=0, abs=2)
    assert (fix.time_usec, fix.fix_type) == (round((UTC_S + 1.5) * 1e6), M.GPS_FIX_TYPE_3D_FIX)
    assert (fix.eph, fix.epv, fix.satellites_visible) == (65535, 65535, 255)
    assert fix.vel == pytest.approx(100 * hypot(30, 40), rel=0, abs=2)
    assert fix.cog == pytest.approx(5313, rel=0, abs=3)  # atan(4 / 3)


def test_in_a_gap_there_is_no_attitude_and_no_heading(clock: list[float]) -> None:
    vehicle, cable = vehicle_of(clock, flight_of(2.05, (0.5, 1.0)))

    for boot_ms, is_known in ((490, True), (510, False), (990, False), (1010, True)):
        assert (vehicle._quaternion(boot_ms) is not None) == is_known
        assert (vehicle._euler(boot_ms) is not None) == is_known
        assert (vehicle._position(boot_ms).hdg != 65535) == is_known
    vehicle.run()
    assert 78 <= len(cable.of("ATTITUDE_QUATERNION")) <= 80


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"start_s": -0.1}, "--start -0.1 s lies outside the flight, whose attitude lasts 2.050 s"),
        ({"start_s": 2.06}, "--start 2.06 s lies outside the flight, whose attitude lasts 2.050 s"),
        ({"rate_hz": 0.0}, "--rate 0 Hz cannot be sent; it must be above 0 and at most 1000"),
        ({"rate_hz": 1001.0}, "--rate 1001 Hz cannot be sent; it must be above 0 and at most 1000"),
        ({"speed": 0.0}, "--speed 0 cannot be played; it must be above 0 and at most 1000"),
        ({"speed": 1001.0}, "--speed 1001 cannot be played; it must be above 0 and at most 1000"),
    ],
)
def test_what_cannot_be_played_is_refused(options: dict[str, float], message: str, clock: list[float]) -> None:
    with pytest.raises(ConfigError) as refused:
        vehicle_of(clock, **options)
    assert str(refused.value) == message
    for allowed in ({"start_s": 0.0, "rate_hz": 1000.0, "speed": 1000.0}, {"start_s": 2.0}):
        vehicle_of(clock, **allowed)


@pytest.fixture
def played(clock: list[float]) -> tuple[Vehicle, Cable]:
    """Return a vehicle 1.25 s after its boot."""
    vehicle, cable = vehicle_of(clock, rate_hz=20.0, sysid=7)
    vehicle._now_s = 1.25
    return vehicle, cable


def answered(vehicle: Vehicle, cable: Cable, message: Any) -> list[Any]:
    """Return the messages that a vehicle sends for one of a station."""
    before = len(cable.sent)
    vehicle._process(message.pack(M.MAVLink(None, 255, 190)))
    return cable.sent[before:]


def command(number: int, first: float, second: float = 0.0, *, system: int = 7) -> Any:
    return M.MAVLink_command_long_message(system, 1, number, 0, first, second, 0, 0, 0, 0, 0)


def test_rates_are_changed_stopped_and_restored_by_command(played: tuple[Vehicle, Cable]) -> None:
    vehicle, cable = played
    for interval_us, expected_s in ((40_000.0, 0.04), (500.0, 0.001), (0.0, 0.05), (-1.0, None), (250_000.0, 0.25)):
        [ack] = answered(vehicle, cable, command(511, 31, interval_us))
        assert (ack.get_type(), ack.command, ack.result) == ("COMMAND_ACK", 511, M.MAV_RESULT_ACCEPTED)
        assert (ack.target_system, ack.target_component) == (255, 190)
        assert vehicle._interval_s.get(31) == (None if expected_s is None else pytest.approx(expected_s))
        assert vehicle._due_s[31] == 1.25
        interval, _ = answered(vehicle, cable, command(510, 31))
        stated = -1 if expected_s is None else round(1e6 * expected_s)
        assert (interval.get_type(), interval.message_id, interval.interval_us) == ("MESSAGE_INTERVAL", 31, stated)
    message, ack = answered(vehicle, cable, command(512, 30))
    assert (message.get_type(), message.time_boot_ms, ack.result) == ("ATTITUDE", 1250, M.MAV_RESULT_ACCEPTED)
    for wrong, result in (
        (command(511, 999, 1.0), M.MAV_RESULT_DENIED),
        (command(511, float("nan"), 1.0), M.MAV_RESULT_DENIED),
        (command(400, 30), M.MAV_RESULT_UNSUPPORTED),
    ):
        [ack] = answered(vehicle, cable, wrong)
        assert ack.result == result
    assert answered(vehicle, cable, command(512, 30, system=8)) == []
    assert len(answered(vehicle, cable, command(512, 30, system=0))) == 2


def test_data_streams_set_the_rates_of_their_messages(played: tuple[Vehicle, Cable]) -> None:
    vehicle, cable = played
    streams = {2: 24, 6: 33, 10: 30, 12: 2}
    defaults = dict(vehicle._interval_s)
    for stream, number in streams.items():
        request = M.MAVLink_request_data_stream_message(7, 1, stream, 4, 1)
        assert answered(vehicle, cable, request) == []
        assert vehicle._interval_s == defaults | {number: 0.25}
        vehicle._interval_s = dict(defaults)
        for rate_hz, is_on in ((0, 1), (4, 0)):
            answered(vehicle, cable, M.MAVLink_request_data_stream_message(7, 1, stream, rate_hz, is_on))
            assert vehicle._interval_s == {key: value for key, value in defaults.items() if key != number}
            vehicle._interval_s = dict(defaults)
    answered(vehicle, cable, M.MAVLink_request_data_stream_message(7, 1, 0, 8, 1))
    assert vehicle._interval_s == defaults | dict.fromkeys(streams.values(), 0.125)
    answered(vehicle, cable, M.MAVLink_request_data_stream_message(7, 1, 3, 5, 1))
    assert vehicle._interval_s == defaults | dict.fromkeys(streams.values(), 0.125)


def test_a_station_gets_one_parameter_and_an_empty_mission(played: tuple[Vehicle, Cable]) -> None:
    vehicle, cable = played
    read = M.MAVLink_param_request_read_message(7, 1, b"SYSID_THISMAV", -1)
    for request in (M.MAVLink_param_request_list_message(7, 1), read):
        [value] = answered(vehicle, cable, request)
        stated = value.param_id, value.param_value, value.param_type, value.param_count, value.param_index
        assert stated == ("SYSID_THISMAV", 7.0, M.MAV_PARAM_TYPE_REAL32, 1, 0)
    [count] = answered(vehicle, cable, M.MAVLink_mission_request_list_message(7, 1, 2))
    assert (count.get_type(), count.count, count.mission_type) == ("MISSION_COUNT", 0, 2)
    assert (count.target_system, count.target_component) == (255, 190)
