"""The messages that glstar sends on a link."""

from typing import Any

import pytest

from glstar.link.outgoing import Requests
from glstar.link.packets import MessageId, dialect
from glstar.link.receiver import Receiver
from tests.support.sender import Sender, receiver

MAVLINK = dialect()


def decoded(packets: list[bytes]) -> list[Any]:
    link = MAVLINK.MAVLink(None)
    return [link.decode(bytearray(packet)) for packet in packets]


def intervals_us(packets: list[bytes]) -> dict[int, float]:
    """Return the intervals that are requested, by message."""
    asked = [message for message in decoded(packets) if message.get_type() == "COMMAND_LONG"]
    assert {message.command for message in asked} <= {MAVLINK.MAV_CMD_SET_MESSAGE_INTERVAL}
    assert {(message.target_system, message.target_component) for message in asked} <= {(7, 1)}
    return {int(message.param1): message.param2 for message in asked}


def heard() -> Receiver:
    """Return a receiver that listens to system 7."""
    listening, _ = receiver()
    listening.receive(Sender(7).heartbeat(), 0.0)
    return listening


def test_glstar_is_a_ground_station_and_never_an_aircraft() -> None:
    (beat,) = decoded(Requests(50.0).due(receiver()[0], 0.0))

    assert beat.get_type() == "HEARTBEAT"
    assert beat.type == MAVLINK.MAV_TYPE_GCS
    assert beat.autopilot == MAVLINK.MAV_AUTOPILOT_INVALID
    assert (beat.base_mode, beat.custom_mode) == (0, 0)  # neither armed nor in a flight mode
    assert (beat.get_srcSystem(), beat.get_srcComponent()) == (255, 191)


def test_heartbeats_come_once_a_second() -> None:
    requests, alone = Requests(50.0), receiver()[0]
    sent = [step / 10 for step in range(50) if requests.due(alone, step / 10)]

    assert sent == pytest.approx([0.0, 1.0, 2.0, 3.0, 4.0])


def test_missing_messages_are_requested_and_their_rates_are_restored_on_closing() -> None:
    requests, listening = Requests(50.0), heard()

    asked = intervals_us(requests.due(listening, 0.0))
    assert asked == {
        MessageId.GLOBAL_POSITION_INT: 200_000.0,
        MessageId.SYSTEM_TIME: 500_000.0,
        MessageId.ATTITUDE_QUATERNION: 20_000.0,
    }
    # No reply: the alternative messages are requested too.
    for second in range(1, 10):
        asked |= intervals_us(requests.due(listening, float(second)))
    assert asked.keys() == {
        MessageId.GLOBAL_POSITION_INT,
        MessageId.SYSTEM_TIME,
        MessageId.ATTITUDE_QUATERNION,
        MessageId.ATTITUDE,
        MessageId.GPS_RAW_INT,
    }

    # An interval of 0 restores the vehicle's default rate.
    assert intervals_us(requests.default_rate_requests(listening)) == dict.fromkeys(asked, 0.0)


def test_a_simulators_state_is_requested_at_the_rate_of_the_attitude_if_the_sky_is_drawn_from_it() -> None:
    requests = Requests(50.0)
    listening, _ = receiver(with_simulator=True)
    listening.receive(Sender(7).heartbeat(), 0.0)

    assert intervals_us(requests.due(listening, 0.0))[MessageId.SIM_STATE] == 20_000.0
    asked: dict[int, float] = {}
    for second in range(1, 10):
        asked |= intervals_us(requests.due(listening, float(second)))
    assert asked[MessageId.HIL_STATE_QUATERNION] == asked[MessageId.SIMSTATE] == 20_000.0


def test_messages_that_were_not_requested_are_not_restored() -> None:
    requests = Requests(50.0)

    assert requests.default_rate_requests(heard()) == []
    assert requests.default_rate_requests(receiver()[0]) == []


def test_a_message_that_is_denied_at_any_rate_is_replaced_by_another_one() -> None:
    plane, (listening, _) = Sender(7), receiver()
    listening.receive(plane.heartbeat(), 0.0)
    requests, asked_hz = Requests(100.0), []
    for second in range(0, 16, 2):
        for number, interval_us in intervals_us(requests.due(listening, float(second))).items():
            denied = MAVLINK.MAVLink_command_ack_message(511, MAVLINK.MAV_RESULT_DENIED)
            listening.receive(plane(denied), second + 0.1)
            if number in {MessageId.ATTITUDE_QUATERNION, MessageId.ATTITUDE}:
                asked_hz.append((number, 1e6 / interval_us))

    assert asked_hz[:4] == [(MessageId.ATTITUDE_QUATERNION, rate_hz) for rate_hz in (100.0, 50.0, 40.0, 25.0)]
    assert (MessageId.ATTITUDE, 100.0) in asked_hz
    assert (MessageId.ATTITUDE, 25.0) in asked_hz
    assert min(rate_hz for _, rate_hz in asked_hz) == 25.0
