"""Positions that are sent to an autopilot, and where they are not."""

from datetime import UTC, datetime
from math import isnan
from typing import Any

import numpy as np
import pytest

from glstar.errors import ConfigError
from glstar.link import Endpoint, Injector, PositionFix
from tests.support.sender import MAVLINK, UTC_S, Sender, flying, system_time

HERE = Endpoint.parse("udpin:127.0.0.1:14550")


def sent(injector: Injector, arrival_s: float, with_utc: bool = True) -> list[Any]:
    """Return what is sent at a time, to system 7 whose UTC is `UTC_S` at the time 0."""
    heard, _ = flying()
    plane = Sender(7)
    heard.receive(plane.heartbeat(), 0.0)
    for step in range(5 if with_utc else 0):
        heard.receive(system_time(plane, 100.0 + step, UTC_S + step), float(step))
    return [MAVLINK.MAVLink(None).decode(bytearray(packet)) for packet in injector.due(heard, arrival_s)]


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
    assert command.param1 == pytest.approx(10.0, rel=0, abs=1e-6)
    assert command.param2 == pytest.approx(0.75, rel=0, abs=1e-5)
    assert command.param3 == pytest.approx(1234.5, rel=0, abs=1e-3)
    assert (command.get_srcSystem(), command.get_srcComponent()) == (255, 191)
    assert injector.sent == 1
    assert sent(injector, 11.0) == []  # once only


def test_a_position_as_of_a_gps_receiver_has_the_gps_time_of_its_instant() -> None:
    injector = Injector(HERE, message="gps_input")
    injector.add(PositionFix(np.deg2rad(-34.93), np.deg2rad(138.6), UTC_S + 9.25, 1234.5))
    injector.add(PositionFix(0.1, 0.2, UTC_S + 9.25))
    known, vague = sent(injector, 10.0)

    assert known.get_type() == "GPS_INPUT"
    assert (known.lat, known.lon, known.fix_type) == (-349300000, 1386000000, 3)
    assert known.time_usec == round((UTC_S + 9.25) * 1e6)
    # 2024-03-10 11:00 UTC is a Sunday: the GPS week 2305 begins at its midnight, and GPS is 18 s ahead of UTC.
    assert datetime.fromtimestamp(UTC_S, UTC).isoformat() == "2024-03-10T11:00:00+00:00"
    assert (known.time_week, known.time_week_ms) == (2305, (11 * 3600 + 18 + 9.25) * 1000)
    assert known.horiz_accuracy == pytest.approx(1234.5, rel=0, abs=1e-3)
    accuracy = MAVLINK.GPS_INPUT_IGNORE_FLAG_HORIZONTAL_ACCURACY
    assert known.ignore_flags == 255 - accuracy
    assert vague.ignore_flags == 255


def test_a_position_of_a_sensor_has_its_delay_and_its_accuracy() -> None:
    injector = Injector(HERE, message="global_position_sensor")
    injector.add(PositionFix(np.deg2rad(-34.93), np.deg2rad(138.6), UTC_S + 9.25, 1234.5))
    injector.add(PositionFix(0.1, 0.2, UTC_S + 9.25))
    known, vague = sent(injector, 10.0)

    assert known.get_type() == "GLOBAL_POSITION_SENSOR"
    assert (known.target_system, known.target_component) == (7, 1)
    assert (known.lat, known.lon) == (-349300000, 1386000000)
    assert known.time_usec == pytest.approx((UTC_S + 10) * 1e6, rel=0, abs=10)
    assert known.processing_time == pytest.approx(0.75e6, rel=0, abs=10)
    assert known.eph == pytest.approx(1234.5, rel=0, abs=1e-3)
    assert isnan(known.alt)
    assert isnan(known.alt_ellipsoid)
    assert isnan(known.epv)
    assert isnan(vague.eph)


def test_a_position_waits_for_the_autopilot_and_its_utc() -> None:
    injector = Injector(HERE)
    injector.add(PositionFix(0.1, 0.2, UTC_S))

    assert sent(injector, 10.0, with_utc=False) == []
    (command,) = sent(injector, 3604.0)
    assert isnan(command.param3)
    assert command.param1 == pytest.approx(4.0, rel=0, abs=1e-6)  # wraps each hour
    assert command.param2 == pytest.approx(3604.0, rel=0, abs=1e-3)


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
    for result in (0, 0, 2):
        heard.receive(plane(MAVLINK.MAVLink_command_ack_message(43003, result)), 1.0)

    assert messages[1:] == [
        "the autopilot accepts the positions",
        "the autopilot rejects the positions: MAV_RESULT_DENIED",
    ]
