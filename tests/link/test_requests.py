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
    requests, asked = Requests(100.0), []
    for step in range(320):
        now_s = step / 20
        for number, interval_us in intervals_us(requests.due(listening, now_s)).items():
            denied = MAVLINK.MAVLink_command_ack_message(511, MAVLINK.MAV_RESULT_DENIED)
            listening.receive(plane(denied), now_s + 0.01)
            if number in {MessageId.ATTITUDE_QUATERNION, MessageId.ATTITUDE}:
                asked.append((now_s, number, 1e6 / interval_us))

    rates_hz = 100.0, 50.0, 40.0, 25.0
    # Each denial is answered at once, and ends with the lowest rate.
    assert asked[:4] == [(step / 20, MessageId.ATTITUDE_QUATERNION, hz) for step, hz in enumerate(rates_hz)]
    for hz in rates_hz:
        assert any(number == MessageId.ATTITUDE and at_hz == hz for _, number, at_hz in asked)
    assert min(hz for _, _, hz in asked) == 25.0
    # Then all are requested again every two seconds.
    assert len({at_s for at_s, _, _ in asked if at_s >= 1.0}) <= 8


def test_without_all_replies_a_denial_lowers_what_is_missing() -> None:
    plane, (listening, _) = Sender(7), receiver()
    listening.receive(plane.heartbeat(), 0.0)
    requests = Requests(100.0)
    assert len(intervals_us(requests.due(listening, 0.0))) == 3
    listening.receive(plane(MAVLINK.MAVLink_command_ack_message(511, MAVLINK.MAV_RESULT_DENIED)), 0.1)

    assert intervals_us(requests.due(listening, 1.9)) == {}
    assert intervals_us(requests.due(listening, 2.0)) == {MessageId.ATTITUDE_QUATERNION: 20_000.0}
