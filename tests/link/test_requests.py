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


def test_a_request_is_for_one_message_and_nothing_else_and_the_heartbeat_is_that_of_an_active_station() -> None:
    beat, *asked = decoded(Requests(40.0).due(heard(), 0.0))

    assert (beat.system_status, beat.mavlink_version) == (MAVLINK.MAV_STATE_ACTIVE, 3)
    assert [(one.param1, one.param2) for one in asked] == [(33, 200_000.0), (2, 500_000.0), (31, 25_000.0)]
    for one in asked:
        assert one.confirmation == one.param3 == one.param4 == one.param5 == one.param6 == one.param7 == 0


def requested(requests: Requests, listening: Receiver, now_s: float) -> dict[int, float]:
    """Return the rates that are requested, by message, Hz, without heartbeats and data streams."""
    packets = [message for message in decoded(requests.due(listening, now_s)) if message.get_type() == "COMMAND_LONG"]
    return {int(message.param1): round(1e6 / message.param2, 3) for message in packets}


def streams(requests: Requests, listening: Receiver, now_s: float) -> list[tuple[int, ...]]:
    """Return the data streams that are requested, with their rates, Hz, and whether they are to be sent."""
    packets = decoded(requests.due(listening, now_s))
    found = [message for message in packets if message.get_type() == "REQUEST_DATA_STREAM"]
    assert {(message.target_system, message.target_component) for message in found} <= {(7, 1)}
    return [(message.req_stream_id, message.req_message_rate, message.start_stop) for message in found]


def test_a_silent_autopilot_is_asked_every_two_seconds_and_after_eight_rounds_every_half_minute() -> None:
    requests, listening = Requests(50.0), heard()
    asked = {half / 2: requested(requests, listening, half / 2) for half in range(170)}
    asked = {at_s: found for at_s, found in asked.items() if found}

    assert list(asked) == [0, 2, 4, 6, 8, 10, 12, 14, 44, 74]
    assert asked[0] == {33: 5, 2: 2, 31: 50}
    assert asked[2] == {33: 5, 2: 2, 24: 1, 31: 50}
    # Messages that can replace others, from the third round on.
    for at_s in (4, 14, 74):
        assert asked[at_s] == {33: 5, 2: 2, 24: 1, 31: 50, 30: 50}


def test_data_streams_are_requested_from_the_fifth_round_on_or_where_single_messages_are_not_supported() -> None:
    requests, listening = Requests(50.0), heard()
    asked = [streams(requests, listening, 2.0 * number) for number in range(6)]
    assert asked[:4] == [[]] * 4
    # Position, time, GNSS and attitude.
    assert asked[4] == asked[5] == [(6, 5, 1), (12, 2, 1), (2, 1, 1), (10, 50, 1)]

    for result, expected in ((MAVLINK.MAV_RESULT_UNSUPPORTED, asked[4]), (MAVLINK.MAV_RESULT_FAILED, [])):
        requests, plane, (listening, _) = Requests(50.0), Sender(7), receiver()
        listening.receive(plane.heartbeat(), 0.0)
        assert streams(requests, listening, 0.0) == []
        listening.receive(plane(MAVLINK.MAVLink_command_ack_message(511, result)), 0.1)
        assert streams(requests, listening, 2.0) == expected
        # A rejection has the messages requested that can replace others.
        assert requested(requests, listening, 4.0).keys() == {33, 2, 24, 31, 30}

    slow, listening = Requests(0.4), heard()
    assert [streams(slow, listening, 2.0 * number) for number in range(5)][4][-1] == (10, 1, 1)


@pytest.mark.parametrize(("wants_gimbal", "rates_hz"), [(False, {}), (True, {285: 20.0})])
def test_the_attitude_of_a_gimbal_is_requested_on_request_at_half_of_the_rate(
    wants_gimbal: bool, rates_hz: dict[int, float]
) -> None:
    requests = Requests(40.0, wants_gimbal=wants_gimbal) if wants_gimbal else Requests(40.0)

    assert requested(requests, heard(), 0.0) == {33: 5, 2: 2, 31: 40} | rates_hz


def receive_evenly(listening: Receiver, plane: Sender, message: Any, count: int) -> None:
    """Receive a message evenly from 0.001 s to 2 s."""
    for k in range(count):
        listening.receive(plane(message), 2.0 * (k + 1) / count if count else 0.0)


@pytest.mark.parametrize(("is_rejected", "fewest"), [(False, 30), (True, 70)])
def test_a_rate_is_granted_from_three_tenths_of_it_on_or_seven_after_a_rejection(
    is_rejected: bool, fewest: int
) -> None:
    for count in (fewest - 1, fewest):
        requests, plane, (listening, _) = Requests(50.0), Sender(7), receiver()
        listening.receive(plane.heartbeat(), 0.0)
        requests.due(listening, 0.0)
        if is_rejected:
            listening.receive(plane(MAVLINK.MAVLink_command_ack_message(511, MAVLINK.MAV_RESULT_FAILED)), 0.001)
        for k in range(count):
            listening.receive(plane.quaternion(2.0 * (k + 1) / count, 0.6, 0.8, 0.0, 0.0), 2.0 * (k + 1) / count)
        assert (31 in requested(requests, listening, 2.0)) == (count < fewest)


def test_other_messages_are_requested_below_three_tenths_of_their_rate() -> None:
    """Three positions in two seconds are enough of 5 Hz, and two times of 2 Hz."""
    place = MAVLINK.MAVLink_global_position_int_message(1000, -349300000, 1386000000, 0, 0, 0, 0, 0, 0)
    time = MAVLINK.MAVLink_system_time_message(0, 1000)
    for message, number, fewest in ((place, 33, 3), (time, 2, 2)):
        for count in (fewest - 1, fewest):
            requests, plane, (listening, _) = Requests(50.0), Sender(7), receiver()
            listening.receive(plane.heartbeat(), 0.0)
            receive_evenly(listening, plane, message, count)
            assert (number in requested(requests, listening, 2.0)) == (count < fewest)


def test_another_autopilot_is_asked_at_once_and_the_previous_one_gets_its_default_rates() -> None:
    requests, first, (second, _) = Requests(50.0), heard(), receiver()
    second.receive(Sender(9).heartbeat(), 0.0)
    requests.due(first, 0.0)

    asked = [message for message in decoded(requests.due(second, 0.5)) if message.get_type() == "COMMAND_LONG"]

    assert [(one.target_system, int(one.param1), one.param2) for one in asked] == [
        (7, 2, 0.0),
        (7, 31, 0.0),
        (7, 33, 0.0),
        (9, 33, 200_000.0),
        (9, 2, 500_000.0),
        (9, 31, 20_000.0),
    ]
    # A restarted autopilot gets the requests again, and none gets default rates.
    second.clock.boot += 1
    assert requested(requests, second, 1.0) == {33: 5, 2: 2, 31: 50}


def test_a_denied_message_that_is_received_is_no_more_requested_at_a_lower_rate() -> None:
    requests, plane, (listening, _) = Requests(100.0), Sender(7), receiver()
    listening.receive(plane.heartbeat(), 0.0)
    requests.due(listening, 0.0)
    for result in (MAVLINK.MAV_RESULT_ACCEPTED, MAVLINK.MAV_RESULT_ACCEPTED, MAVLINK.MAV_RESULT_DENIED):
        listening.receive(plane(MAVLINK.MAVLink_command_ack_message(511, result)), 0.1)

    # Only the third is lowered, and without the message that can replace it.
    assert requested(requests, listening, 0.2) == {31: 50}
