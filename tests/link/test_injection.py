"""Positions that are sent to an autopilot, and where they are not."""

import re
from collections.abc import Callable
from datetime import UTC, datetime
from math import isnan
from typing import Any

import numpy as np
import pytest

from glstar.errors import ConfigError
from glstar.link import Endpoint, InjectedMessage, Injector, Packet, PositionFix
from glstar.link.clock import BootClock
from glstar.link.receiver import Receiver
from tests.support.jitter import JitterCorrection
from tests.support.sender import MAVLINK, UTC_S, Sender, flying, system_time

HERE = Endpoint.parse("udpin:127.0.0.1:14550")


def hearing(
    *, with_utc: bool = True, velocity_m_per_s: tuple[float, float] | None = None, **parameters: float
) -> Receiver:
    """Return a receiver of system 7, whose UTC is `UTC_S` at the time 0, heard until 10 s."""
    heard, _ = flying()
    plane = Sender(7)
    heard.receive(plane.heartbeat(), 0.0)
    for step in range(5 if with_utc else 0):
        heard.receive(system_time(plane, 100.0 + step, UTC_S + step), float(step))
    for name, value in parameters.items():
        heard.receive(plane(MAVLINK.MAVLink_param_value_message(name.encode(), value, 9, 1, 0)), 5.0)
    if velocity_m_per_s is not None:
        heard.receive(position(plane, 10.0, velocity_m_per_s), 10.0)
    return heard


def position(plane: Sender, sent_s: float, velocity_m_per_s: tuple[float, float]) -> Packet:
    boot_ms, speeds = round(1000 * (100 + sent_s)), (round(100 * speed) for speed in velocity_m_per_s)
    return plane(MAVLINK.MAVLink_global_position_int_message(boot_ms, -349300000, 1386000000, 0, 0, *speeds, 0, 0))


def sent(injector: Injector, arrival_s: float, heard: Receiver | None = None) -> list[Any]:
    """Return what is sent at a time."""
    packets = injector.due(heard or hearing(), arrival_s)
    return [MAVLINK.MAVLink(None).decode(bytearray(packet)) for packet in packets]


def test_a_position_has_its_delay_and_its_accuracy() -> None:
    injector = Injector(HERE)
    injector.add(PositionFix(np.deg2rad(-34.93), np.deg2rad(138.6), UTC_S + 9.25, 1234.5))
    (command,) = sent(injector, 10.0)

    assert command.get_type() == "COMMAND_INT"
    assert (command.target_system, command.target_component) == (7, 1)
    assert command.command == MAVLINK.MAV_CMD_EXTERNAL_POSITION_ESTIMATE == 43003
    assert command.frame == MAVLINK.MAV_FRAME_GLOBAL
    assert (command.x, command.y) == (-349300000, 1386000000)
    assert isnan(command.z)
    assert command.param1 == 0.0  # the first
    assert command.param2 == pytest.approx(0.75, rel=0, abs=1e-5)
    assert command.param3 == pytest.approx(1234.5, rel=0, abs=1e-3)
    assert (command.get_srcSystem(), command.get_srcComponent()) == (255, 191)
    assert injector.sent == 1
    assert sent(injector, 11.0) == []  # once only


def test_a_simulators_clock_counts_the_times_of_positions_and_stands_still_in_a_pause() -> None:
    """At ten times real time, ArduPlane took each position for one of 0.5 s before: its correction of jitter."""
    heard, plane, injector = Receiver(BootClock(is_vehicle_time=True), lambda _: None), Sender(7), Injector(HERE)
    heard.receive(plane.heartbeat(), 0.0)
    local, errors_s, times_s = JitterCorrection(), [], []
    # A second of the simulator every 0.1 s, and then a pause of 30 s.
    for step in range(20):
        heard.receive(system_time(plane, 100.0 + step, UTC_S + step), 0.1 * step)
        injector.add(PositionFix(-0.6, 2.4, UTC_S + step - 0.25))
        (command,) = sent(injector, 0.1 * step + (30.0 if step == 19 else 0.0), heard)
        times_s.append(command.param1)
        errors_s.append(local.applied_s(command, 100.0 + step) - (100.0 + step - 0.25))

    assert times_s == list(range(20))
    np.testing.assert_allclose(errors_s, 0.0, rtol=0, atol=1e-3)
    assert not injector.messages


def test_a_position_as_of_a_gps_receiver_is_that_of_now_with_the_velocity_of_the_autopilot() -> None:
    injector = Injector(HERE, message="gps_input")
    injector.add(PositionFix(np.deg2rad(-34.93), np.deg2rad(138.6), UTC_S + 9.25, 87.5))
    injector.add(PositionFix(np.deg2rad(-34.93), np.deg2rad(138.6), UTC_S + 10, 100.0))
    known, new = sent(injector, 10.0, hearing(velocity_m_per_s=(20.0, -8.0), GPS1_TYPE=14))

    assert known.get_type() == "GPS_INPUT"
    # 15 m north and 6 m west in 0.75 s: 1e-7 deg of latitude is 11.09 mm there, of longitude 9.14 mm (WGS84).
    assert known.lat + 349300000 == pytest.approx(15 / 0.011093, rel=0, abs=2)
    assert known.lon - 1386000000 == pytest.approx(-6 / 0.009139, rel=0, abs=2)
    assert known.fix_type == 3
    assert (known.vn, known.ve, known.vd) == (20.0, -8.0, 0.0)
    assert known.speed_accuracy == 3.0
    assert known.time_usec == round((UTC_S + 10) * 1e6)
    # 2024-03-10 11:00 UTC is a Sunday: the GPS week 2305 begins at its midnight, and GPS is 18 s ahead of UTC.
    assert datetime.fromtimestamp(UTC_S, UTC).isoformat() == "2024-03-10T11:00:00+00:00"
    assert (known.time_week, known.time_week_ms) == (2305, (11 * 3600 + 18 + 10) * 1000)
    assert known.horiz_accuracy == pytest.approx(87.5, rel=0, abs=1e-3)
    flags = ("ALT", "HDOP", "VDOP", "VERTICAL_ACCURACY")
    ignored = sum(getattr(MAVLINK, f"GPS_INPUT_IGNORE_FLAG_{flag}") for flag in flags)
    assert known.ignore_flags == ignored
    assert (new.lat, new.lon) == (-349300000, 1386000000)


@pytest.mark.parametrize(("sigma_m", "stated"), [(None, "not stated"), (1234.5, "1.23 km"), (100.5, "0.101 km")])
def test_a_position_that_gps_input_would_make_too_accurate_is_not_sent(sigma_m: float | None, stated: str) -> None:
    """ArduPlane 4.7.0-dev (NavEKF3_core::readGpsData) took 24 km for 0.5 m, and crashed half a minute later."""
    injector = Injector(HERE, message="gps_input")
    injector.add(PositionFix(0.1, 0.2, UTC_S + 9.25, sigma_m))

    assert sent(injector, 10.0, hearing(velocity_m_per_s=(1.0, 0.0), GPS1_TYPE=14)) == []
    assert list(injector.messages) == [
        f"the position of 11:00:09.2 is not sent: its accuracy is {stated}, and ArduPilot takes one of GPS_INPUT for"
        " 100 m or less; --inject-as external_position keeps it"
    ]


def test_an_autopilot_that_would_ignore_gps_input_is_asked_and_gets_none() -> None:
    injector = Injector(HERE, message="gps_input")
    injector.add(PositionFix(0.1, 0.2, UTC_S + 9.25, 50.0))

    asked = sent(injector, 10.0)
    assert [(one.get_type(), one.param_id, one.param_index) for one in asked] == [
        ("PARAM_REQUEST_READ", "GPS1_TYPE", -1),
        ("PARAM_REQUEST_READ", "GPS_TYPE", -1),
        ("PARAM_REQUEST_READ", "GPS2_TYPE", -1),
        ("PARAM_REQUEST_READ", "GPS_TYPE2", -1),
    ]
    assert sent(injector, 10.5) == []
    # The type of the second receiver may follow.
    assert sent(injector, 10.6, hearing(velocity_m_per_s=(1.0, 0.0), GPS_TYPE=1)) == []
    assert (injector.sent, injector.refused) == (0, 0)
    assert sent(injector, 11.0, hearing(velocity_m_per_s=(1.0, 0.0), GPS_TYPE=1)) == []
    assert (injector.sent, injector.refused) == (0, 1)
    assert list(injector.messages) == [
        "the position of 11:00:09.2 is not sent: GPS_TYPE is 1; set it to 14 (MAVLink) and restart the autopilot"
    ]
    injector.add(PositionFix(0.1, 0.2, UTC_S + 9.25, 50.0))
    assert sent(injector, 11.1, hearing(velocity_m_per_s=(1.0, 0.0), GPS1_TYPE=1, GPS2_TYPE=0)) == []
    assert "GPS1_TYPE is 1 and GPS2_TYPE is 0; set one to 14 (MAVLink)" in injector.messages[-1]
    injector.add(PositionFix(0.1, 0.2, UTC_S + 9.25, 50.0))
    assert sent(injector, 11.2, hearing(GPS1_TYPE=14)) == []
    assert "needs the velocity of GLOBAL_POSITION_INT" in injector.messages[-1]


def test_a_standing_refusal_is_said_once_a_minute_with_its_number() -> None:
    injector, heard = Injector(HERE, message="gps_input"), hearing(velocity_m_per_s=(1.0, 0.0), GPS1_TYPE=1)
    sent(injector, 9.0)
    for second in range(130):
        injector.add(PositionFix(0.1, 0.2, UTC_S + 9.25 + second, 50.0))
        assert sent(injector, 10.0 + second, heard) == []

    reason = "GPS1_TYPE is 1; set it to 14 (MAVLink) and restart the autopilot"
    assert injector.refused == 130
    assert list(injector.messages) == [
        f"the position of 11:00:09.2 is not sent: {reason}",
        f"the position of 11:01:09.2 is not sent: {reason} (59 others neither since the last line)",
        f"the position of 11:02:09.2 is not sent: {reason} (59 others neither since the last line)",
    ]
    # Another reason is said at once, and the first one again after it.
    injector.add(PositionFix(0.1, 0.2, UTC_S + 100.0, 50.0))
    injector.add(PositionFix(0.1, 0.2, UTC_S + 139.0, 50.0))
    sent(injector, 140.0, heard)
    assert "it is 40.0 s old" in injector.messages[-2]
    assert injector.messages[-2].endswith(" (9 others neither since the last line)")
    assert injector.messages[-1].endswith(f"11:02:19.0 is not sent: {reason}")


def test_gps_input_goes_to_the_receiver_that_takes_it_beside_one_that_is_denied() -> None:
    injector = Injector(HERE, message="gps_input")
    for _ in range(2):
        injector.add(PositionFix(0.1, 0.2, UTC_S + 9.25, 50.0))

    one, other = sent(injector, 10.0, hearing(velocity_m_per_s=(1.0, 0.0), GPS1_TYPE=1, GPS2_TYPE=14))

    # ArduPlane 4.7.0-dev: AP_GPS_MAV::handle_msg drops what has another number; AP_GPS::update_primary takes the
    # receiver with more satellites, and NavEKF3::calcGpsGoodToAlign demands six.
    assert (one.gps_id, one.satellites_visible) == (1, 6)
    assert (other.gps_id, other.satellites_visible) == (1, 6)
    assert not injector.messages


def test_a_receiver_that_was_made_one_of_mavlink_in_flight_is_reported_once() -> None:
    """ArduPlane 4.7.0-dev takes another kind of a receiver that sends data at its next start."""
    heard, plane, injector = (
        hearing(velocity_m_per_s=(1.0, 0.0), GPS1_TYPE=1),
        Sender(7),
        Injector(HERE, message="gps_input"),
    )
    heard.receive(plane(MAVLINK.MAVLink_param_value_message(b"GPS1_TYPE", 14, 9, 1, 0)), 10.0)
    for _ in range(2):
        injector.add(PositionFix(0.1, 0.2, UTC_S + 9.25, 50.0))

    assert [one.gps_id for one in sent(injector, 10.0, heard)] == [0, 0]
    assert list(injector.messages) == [
        "GPS1_TYPE was changed: the autopilot may ignore the positions until it is restarted"
    ]


def test_an_autopilot_that_does_not_answer_for_its_parameter_gets_positions_with_a_warning() -> None:
    injector = Injector(HERE, message="gps_input")
    injector.add(PositionFix(0.1, 0.2, UTC_S + 9.25, 50.0))
    heard = hearing(velocity_m_per_s=(1.0, 0.0))

    kinds = [[one.get_type() for one in sent(injector, 8.0 + step, heard)] for step in range(6)]

    assert kinds == [["PARAM_REQUEST_READ"] * 4] * 4 + [["GPS_INPUT"], []]
    assert list(injector.messages) == ["the autopilot does not state GPS1_TYPE: it may ignore the positions"]


def test_a_position_of_a_sensor_has_its_delay_and_its_accuracy() -> None:
    injector = Injector(HERE, message="global_position_sensor")
    injector.add(PositionFix(np.deg2rad(-34.93), np.deg2rad(138.6), UTC_S + 9.25, 1234.5))
    injector.add(PositionFix(np.deg2rad(-34.93), np.deg2rad(138.6), UTC_S + 9.25))
    (known,) = sent(injector, 10.0)

    assert known.get_type() == "GLOBAL_POSITION_SENSOR"
    assert (known.target_system, known.target_component) == (7, 1)
    assert (known.lat, known.lon) == (-349300000, 1386000000)
    assert known.time_usec == pytest.approx((UTC_S + 10) * 1e6, rel=0, abs=10)
    assert known.processing_time == pytest.approx(0.75e6, rel=0, abs=10)
    assert known.eph == pytest.approx(1234.5, rel=0, abs=1e-3)
    assert isnan(known.alt)
    assert isnan(known.alt_ellipsoid)
    assert isnan(known.epv)
    # PX4 1.17.0-alpha1 (aux_global_position_control.cpp) took positions by the stars for 1 m: up to 332 km off.
    assert list(injector.messages) == [
        "the position of 11:00:09.2 is not sent: its accuracy is not stated, and PX4 takes that for 1 m; the answer"
        " needs an error ellipse"
    ]


def test_a_position_of_a_sensor_is_moved_to_where_the_aircraft_is_now() -> None:
    """PX4 1.17.0-alpha1 dates it by its arrival, and drops the sensor 0 (mavlink_receiver.cpp, EKF2_AGP0_ID)."""
    injector = Injector(HERE, message="global_position_sensor")
    injector.add(PositionFix(np.deg2rad(-34.93), np.deg2rad(138.6), UTC_S + 9.25, 1234.5))
    (moved,) = sent(injector, 10.0, hearing(velocity_m_per_s=(20.0, -8.0)))

    # 15 m north and 6 m west in 0.75 s, as of GPS_INPUT.
    assert moved.lat + 349300000 == pytest.approx(15 / 0.011093, rel=0, abs=2)
    assert moved.lon - 1386000000 == pytest.approx(-6 / 0.009139, rel=0, abs=2)
    assert (moved.id, moved.processing_time) == (1, 0)
    assert moved.time_usec == pytest.approx((UTC_S + 10) * 1e6, rel=0, abs=10)
    assert moved.eph == pytest.approx(1234.5, rel=0, abs=1e-3)


@pytest.mark.parametrize(("autopilot", "fix_type", "count"), [(12, 3, 1), (12, 1, 0), (3, 3, 0)])
def test_px4_with_a_gnss_fix_is_reported_once(autopilot: int, fix_type: int, count: int) -> None:
    """PX4 1.17.0-alpha1 accepted positions of 50 m beside GNSS, until its gyro bias and airspeed failed its checks."""
    heard, _ = flying()
    plane, injector = Sender(7), Injector(HERE)
    heard.receive(plane(MAVLINK.MAVLink_heartbeat_message(1, autopilot, 0, 0, 4, 3)), 0.0)
    heard.receive(system_time(plane, 100.0, UTC_S), 0.0)
    fix = (-349300000, 1386000000, 300_000, 100, 100, 0, 0, 10)
    heard.receive(plane(MAVLINK.MAVLink_gps_raw_int_message(109_900_000, fix_type, *fix)), 9.9)
    for _ in range(2):
        injector.add(PositionFix(0.1, 0.2, UTC_S + 9.25))

    assert len(sent(injector, 10.0, heard)) == 2
    assert len(injector.messages) == count
    assert all("although its GNSS receiver has a fix" in message for message in injector.messages)


def test_a_position_waits_for_the_autopilot_and_its_utc() -> None:
    injector = Injector(HERE)
    injector.add(PositionFix(0.1, 0.2, UTC_S))

    assert sent(injector, 10.0, hearing(with_utc=False)) == []
    (command,) = sent(injector, 4.0)
    assert isnan(command.param3)
    assert command.param2 == pytest.approx(4.0, rel=0, abs=1e-3)


def test_the_time_of_transmission_counts_from_the_first_position_and_never_wraps() -> None:
    injector = Injector(HERE)
    heard = hearing()
    for arrival_s in (3599.0, 3602.0, 3599.0 + 9 * 3600):
        injector.add(PositionFix(0.1, 0.2, UTC_S + arrival_s - 1.0))
        (command,) = sent(injector, arrival_s, heard)
        assert command.param1 == pytest.approx(arrival_s - 3599.0, rel=0, abs=2e-3)


def test_a_position_that_is_too_old_for_an_autopilot_is_not_sent() -> None:
    injector = Injector(HERE)
    injector.add(PositionFix(0.1, 0.2, UTC_S - 145.0))
    injector.add(PositionFix(0.1, 0.2, UTC_S + 5.5))

    (command,) = sent(injector, 10.0)

    assert command.param2 == pytest.approx(4.5, rel=0, abs=1e-5)
    assert (injector.sent, injector.refused) == (1, 1)
    (message,) = injector.messages
    assert message.startswith("the position of 10:57:35.0 is not sent: it is 155.0 s old, and an autopilot takes older")


def test_a_position_that_the_aircraft_cannot_have_reached_is_not_sent() -> None:
    """A degree of the equator is 111.32 km (WGS84)."""
    injector = Injector(HERE, max_km=50.0)
    heard = hearing()

    def is_sent(longitude_deg: float, utc_s: float) -> bool:
        injector.add(PositionFix(0.0, np.deg2rad(longitude_deg), utc_s))
        return bool(sent(injector, utc_s - UTC_S + 0.5, heard))

    assert is_sent(20.0, UTC_S + 10)
    assert not is_sent(20.5, UTC_S + 20)  # 55.66 km: more than 50 km and 1 km that it can have flown
    assert injector.messages[-1].endswith(
        "it is 56 km from the previous one, 10 s before; --inject-max-km allows 50 km more than the flight"
    )
    assert is_sent(20.4, UTC_S + 30)
    assert is_sent(20.9, UTC_S + 100)  # 55.66 km after 70 s
    # A first position that was wrong does not shut out all others: three in a row agree.
    assert [is_sent(30.0 + k / 100, UTC_S + 110 + k) for k in range(4)] == [False, False, True, True]
    assert [is_sent(longitude_deg, UTC_S + 200) for longitude_deg in (50.0, 60.0, 50.0, 60.0)] == [False] * 4
    assert injector.refused == 7


@pytest.mark.parametrize(
    "fix",
    [
        (2.5, 0.1, UTC_S + 9.25),
        (0.1, 3.2, UTC_S + 9.25),
        (float("nan"), 0.1, UTC_S + 9.25),
        (0.1, float("inf"), UTC_S + 9.25),
        (0.1, 0.2, float("nan")),
        (0.1, 0.2, float("inf")),
    ],
)
def test_what_is_no_place_on_earth_is_not_sent(fix: tuple[float, float, float]) -> None:
    injector = Injector(HERE)
    injector.add(PositionFix(*fix))
    injector.add(PositionFix(0.1, 0.2, UTC_S + 9.25, 1e30))
    injector.add(PositionFix(0.1, 0.2, UTC_S + 9.25, 1e3))

    assert len(sent(injector, 10.0)) == 1
    assert injector.refused == 2


def test_each_autopilot_that_is_listened_to_is_asked_for_its_parameter() -> None:
    injector = Injector(HERE, message="gps_input")
    heard = hearing(velocity_m_per_s=(1.0, 0.0))
    assert [len(sent(injector, 8.0 + step, heard)) for step in range(5)] == [4, 4, 4, 4, 0]

    other = hearing()
    other.chosen = (8, 1)
    assert {one.target_system for one in sent(injector, 13.0, other)} == {8}


@pytest.mark.parametrize("message", ["external_position", "global_position_sensor", "gps_input"])
@pytest.mark.parametrize("uptime_s", [5.0, 3 * 3600.0])
def test_an_autopilot_applies_a_position_at_its_instant(message: InjectedMessage, uptime_s: float) -> None:
    """Solver delays from 0.2 to 4 s, and up to 20 ms on the link, by a model of ArduPilot's correction of jitter."""
    rng = np.random.default_rng(7)
    plane, heard = Sender(7), hearing(GPS1_TYPE=14)
    injector, clock = Injector(HERE, message=message), JitterCorrection()
    speed_m_per_s, m_per_e7 = 20.0, 0.0110575  # due north from the equator
    offsets_s = []
    for step in range(150):
        utc_s = UTC_S + uptime_s + 30.0 * step
        now_s = utc_s + rng.uniform(0.2, 4.0) - UTC_S
        heard.receive(position(plane, now_s, (speed_m_per_s, 0.0)), now_s)
        place = PositionFix(np.deg2rad(speed_m_per_s * (utc_s - UTC_S) / m_per_e7 * 1e-7), 0.0, utc_s, 100.0)
        injector.add(place)
        (fix,) = sent(injector, now_s, heard)
        applied_s = clock.applied_s(fix, UTC_S + now_s + rng.uniform(0.0, 0.02))
        latitude_e7 = fix.x if message == "external_position" else fix.lat
        flown_s = latitude_e7 * m_per_e7 / speed_m_per_s  # when the aircraft was there
        offsets_s.append(applied_s - UTC_S - flown_s)

    assert np.abs(offsets_s).max() < 0.05


def heard_over(plane: Sender, uptime_s: float, *, with_velocity: bool) -> Callable[[Receiver, float], None]:
    """Return a function that sends what an autopilot sends until a time, by UTC; 32 bits of milliseconds wrap."""
    boot_utc_s = UTC_S - uptime_s

    def until(heard: Receiver, utc_s: float) -> None:
        for back_s in (1.0, 0.5, 0.0):
            boot_ms = round(1000 * (utc_s - back_s - boot_utc_s)) % 2**32
            arrival_s = utc_s - back_s - UTC_S
            heard.receive(plane(MAVLINK.MAVLink_system_time_message(round((utc_s - back_s) * 1e6), boot_ms)), arrival_s)
            if with_velocity:
                moved = MAVLINK.MAVLink_global_position_int_message(boot_ms, 1, 1, 0, 0, 2000, 0, 0, 0)
                heard.receive(plane(moved), arrival_s)

    return until


@pytest.mark.parametrize("seed", range(20))
@pytest.mark.parametrize("message", ["external_position", "global_position_sensor", "gps_input"])
def test_positions_at_any_uptime_are_applied_at_their_instant_or_refused(message: InjectedMessage, seed: int) -> None:
    """Delays up to 8 s, pauses up to ten minutes, wraps of 49.7 days and GPS weeks, 20 ms on the link."""
    rng = np.random.default_rng(seed)
    # A few hours before the clock wraps, after three hours, or anywhere in four days.
    uptime_s = [2**32 / 1000 - rng.uniform(0, 9000), 3 * 3600.0, rng.uniform(1, 4 * 86400)][seed % 3]
    plane, (heard, _) = Sender(7), flying()
    heard.receive(plane.heartbeat(), 0.0)
    heard.receive(plane(MAVLINK.MAVLink_param_value_message(b"GPS1_TYPE", 14.0, 9, 1, 0)), 0.0)
    lacks_velocity = seed % 5 == 4
    send = heard_over(plane, uptime_s, with_velocity=not lacks_velocity)
    injector, clock = Injector(HERE, message=message), JitterCorrection()
    speed_m_per_s, m_per_e7 = 20.0, 0.0110575  # due north from the equator
    utc_s, outcomes = UTC_S + 10.0, []
    for _ in range(130):
        utc_s += float(rng.choice([rng.uniform(1, 5), rng.uniform(5, 60), rng.uniform(60, 600)], p=[0.5, 0.4, 0.1]))
        delay_s = float(rng.choice([rng.uniform(0.2, 4.0), rng.uniform(4.0, 8.0)], p=[0.9, 0.1]))
        now_s = utc_s + delay_s - UTC_S
        send(heard, UTC_S + now_s)
        injector.add(PositionFix(np.deg2rad(speed_m_per_s * (utc_s - UTC_S) / m_per_e7 * 1e-7), 0.0, utc_s, 100.0))
        fixes = sent(injector, now_s, heard)
        others = re.findall(r"\((\d+) others neither", "\n".join(injector.messages))
        reasons = len(injector.messages) + sum(map(int, others)) + injector._reported[2]
        if delay_s > 5 or (lacks_velocity and message == "gps_input"):
            assert (fixes, reasons) == ([], len(outcomes) + 1 - injector.sent)
            outcomes.append(None)
            continue
        (fix,) = fixes
        applied_s = clock.applied_s(fix, UTC_S + now_s + rng.uniform(0.0, 0.02))
        latitude_e7 = fix.x if message == "external_position" else fix.lat
        outcomes.append(applied_s - UTC_S - latitude_e7 * m_per_e7 / speed_m_per_s)

    offsets_s = [offset_s for offset_s in outcomes if offset_s is not None]
    assert len(offsets_s) == injector.sent
    assert injector.refused == len(outcomes) - injector.sent
    assert max(map(abs, offsets_s), default=0.0) < 0.05


@pytest.mark.parametrize("link", ["udpin:127.0.0.1:1", "tcp:localhost:1", "udpout:[::1]:1", "udp:14550"])
def test_a_link_on_this_computer_needs_no_host(link: str) -> None:
    assert Injector(Endpoint.parse(link)).sent == 0


@pytest.mark.parametrize(
    ("link", "host"),
    [("udpin:0.0.0.0:1", "0.0.0.0"), ("tcp:192.168.1.7:1", "192.168.1.7"), ("/dev/ttyUSB0,57600", "/dev/ttyUSB0")],
)
def test_a_link_beyond_this_computer_needs_its_host_by_name(link: str, host: str) -> None:
    with pytest.raises(ConfigError, match=f"--inject-host {host}"):
        Injector(Endpoint.parse(link))
    with pytest.raises(ConfigError, match="is not the host"):
        Injector(Endpoint.parse(link), "192.168.1.8")
    assert Injector(Endpoint.parse(link), host).sent == 0


def test_the_autopilots_reply_is_reported_once() -> None:
    heard, messages = flying()
    plane = Sender(1)
    heard.receive(plane.heartbeat(), 0.0)
    for result in (4, 4, 0, 0, 2):
        heard.receive(plane(MAVLINK.MAVLink_command_ack_message(43003, result)), 1.0)

    assert messages[1:] == [
        "the autopilot uses no position now: MAV_RESULT_FAILED is its usual answer while GNSS is in use, or before its"
        " first position",
        "the autopilot accepts the positions",
        "the autopilot rejects the positions: MAV_RESULT_DENIED",
    ]
