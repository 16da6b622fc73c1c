"""Limits of what a receiver takes for the autopilot's: its velocity, fixes, parameters, replies and losses."""

from types import SimpleNamespace
from typing import Any

import pytest

from glstar.link.packets import MessageId
from glstar.link.receiver import Receiver
from tests.support.sender import MAVLINK, UTC_S, Sender, flying, receiver, system_time


def heard(**options: Any) -> tuple[Receiver, list[str], Sender]:
    """Return a receiver of system 7, from which it has heard at 0 s."""
    found, said = receiver(**options)
    plane = Sender(7)
    found.receive(plane.heartbeat(), 0.0)
    return found, said, plane


def place(boot_s: float = 1.0, lat: int = -349300000, lon: int = 1386000000) -> Any:
    return MAVLINK.MAVLink_global_position_int_message(
        round(1000 * boot_s), lat, lon, 50_000, 12_500, 2_000, -800, 150, 0
    )


def fix(kind: int = 3, lat: int = -349300000) -> Any:
    return MAVLINK.MAVLink_gps_raw_int_message(0, kind, lat, 1386000000, 70_000, 1, 1, 1, 1, 9)


def test_a_velocity_is_known_for_two_seconds() -> None:
    found, _, plane = heard()
    assert found.velocity(0.0) is None
    found.receive(plane(place()), 10.0)

    assert found.velocity(12.0) == (20.0, -8.0, 1.5)
    assert found.velocity(12.01) is None
    assert found.above_home_m == 12.5
    assert (found.sends_position, found.position_source) == (True, "GLOBAL_POSITION_INT")


@pytest.mark.parametrize(("kind", "has_fix"), [(2, False), (3, True), (6, True)])
def test_a_fix_of_three_dimensions_is_one_for_two_seconds(kind: int, has_fix: bool) -> None:
    found, _, plane = heard()
    assert not found.has_fix(0.0)
    found.receive(plane(fix(3)), 9.0)
    found.receive(plane(fix(kind)), 10.0)
    assert (found.has_fix(12.0), found.has_fix(12.01)) == (has_fix, False)


def test_fixes_are_positions_only_while_there_are_no_others() -> None:
    found, _, plane = heard()
    found.receive(plane(fix()), 0.5)  # there is no attitude yet
    assert not found.history.has_position
    found.receive(plane.angles(100.0), 1.0)
    found.receive(plane(fix(2)), 1.1)
    found.receive(plane(fix(lat=-100000000)), 1.2)
    found.receive(plane(place(100.3, lat=0, lon=0)), 1.3)  # no place, but a message with one
    found.receive(plane(fix()), 1.4)
    found.receive(plane(place(100.5)), 1.5)
    found.receive(plane(place(100.6, lat=0)), 1.6)

    rows = found.history.snapshot().positions
    assert rows[:, 0].tolist() == pytest.approx([100.0, 100.5, 100.6], rel=0, abs=1e-6)
    assert rows[:, 3].tolist() == [70.0, 50.0, 50.0]


def test_parameters_of_gnss_receivers_are_kept_with_the_boot_of_their_change() -> None:
    found, _, plane = heard()
    for name, value in ((b"GPS1_TYPE", 1), (b"GPS1_TYPE", 1), (b"OTHER", 3), (b"GPS2_TYPE", 0)):
        found.receive(plane(MAVLINK.MAVLink_param_value_message(name, value, 9, 1, 0)), 1.0)
    assert (found.parameters, found.changed) == ({"GPS1_TYPE": 1.0, "GPS2_TYPE": 0.0}, {})
    found.receive(plane(MAVLINK.MAVLink_param_value_message(b"GPS2_TYPE", 14, 9, 1, 0)), 1.0)
    assert (found.parameters["GPS2_TYPE"], found.changed) == (14.0, {"GPS2_TYPE": 0})


def test_replies_to_requests_are_kept_and_those_to_positions_reported() -> None:
    found, said, plane = heard()
    said.clear()

    def reply(command: int, result: int) -> None:
        found.receive(plane(MAVLINK.MAVLink_command_ack_message(command, result)), 1.0)

    assert (found.ack, found.acks) == (None, [])
    reply(511, MAVLINK.MAV_RESULT_DENIED)
    reply(400, MAVLINK.MAV_RESULT_FAILED)
    reply(511, MAVLINK.MAV_RESULT_ACCEPTED)
    assert (found.ack, found.acks, said) == (0, [2, 0], [])
    for _ in range(2):
        reply(43003, MAVLINK.MAV_RESULT_ACCEPTED)
    assert said == ["the autopilot accepts the positions"]
    reply(43003, MAVLINK.MAV_RESULT_DENIED)
    assert len(said) == 2
    assert "MAV_RESULT_DENIED" in said[1] or "DENIED" in said[1]


def packet(sequence: int) -> Any:
    return SimpleNamespace(sender=(7, 1), sequence=sequence)


@pytest.mark.parametrize(
    ("sequence", "after_s", "lost"),
    [(11, 1.0, 0), (14, 1.0, 3), (138, 1.0, 127), (139, 1.0, 0), (9, 1.0, 0), (14, 1.99, 3), (14, 2.01, 0)],
)
def test_missing_sequence_numbers_are_losses_up_to_half_of_all_and_two_seconds(
    sequence: int, after_s: float, lost: int
) -> None:
    found, _, _ = heard()
    found._sequence, before = (10, 100.0), found.counted

    found._count_lost(packet(sequence), 100.0 + after_s)

    assert (found.lost, found.counted) == (lost, before + 1)
    assert found._sequence == (sequence, 100.0 + after_s)
    # At a reboot within two seconds the numbers have restarted: nothing was lost.
    late, _, _ = heard()
    for passed_s, kept in ((1.99, 0), (2.01, 3)):
        late.lost, late._jump = 3, (3, 100.0)
        late._discard_jump(100.0 + passed_s)
        assert late.lost == kept
        late._discard_jump(100.0 + passed_s)
        assert late.lost == kept


def test_a_silent_autopilot_is_replaced_after_five_seconds_and_64_are_known() -> None:
    for second_s, chosen in ((5.0, 7), (5.1, 9)):
        found, said, _ = heard()
        found.receive(Sender(9).heartbeat(), second_s)
        assert found.chosen == (chosen, 1)
        assert any("sends no attitude; listening to system 9" in words for words in said) == (chosen == 9)
    found, _, _ = heard()
    for system in range(8, 80):
        found.receive(Sender(system).heartbeat(), 0.1)
    assert found.systems == tuple(range(7, 71))


def test_the_receiver_of_another_autopilot_goes_on_with_the_counters() -> None:
    found, _, plane = heard()
    for k in range(5):
        found.receive(plane.angles(100.0 + k), float(k))
    found.receive(Sender(9).heartbeat(), 4.5)
    found.lost = 3
    following, said = receiver(sysid=9)
    following.continue_from(found, 6.0)
    assert (following.packets, following.counted, following.lost) == (7, 6, 3)
    assert (following.chosen, following.vehicle, following.systems) == ((9, 1), "ArduPlane", (7, 9))
    assert said == ["autopilots are systems 7 and 9; listening to 9 (--sysid chooses another)"]
    unknown, _ = receiver(sysid=11)
    unknown.continue_from(found, 6.0)
    assert (unknown.chosen, unknown.vehicle) == (None, None)


def test_rates_of_attitude_are_those_of_the_most_frequent_message() -> None:
    found, _, plane = heard()
    for k in range(20):
        found.receive(plane.angles(100.0 + k / 10), k / 10)
        if k % 2 == 0:
            found.receive(plane.quaternion(100.0 + k / 10, 0.6, 0.8, 0.0, 0.0), k / 10)
    assert found.rate_hz(MessageId.ATTITUDE, 2.0) == 10.0
    assert found.rate_hz(MessageId.ATTITUDE_QUATERNION, 2.0) == 5.0
    assert found.attitude_rate_hz(2.0) == 10.0
    # Twice as frequent angles do not replace the quaternion.
    assert found.attitude_source == "ATTITUDE_QUATERNION"


def test_utc_that_is_set_by_more_than_a_tenth_of_a_second_is_reported() -> None:
    for step_s, count in ((0.09, 0), (0.11, 1)):
        found, said = flying()
        plane = Sender(7)
        found.receive(plane.heartbeat(), 0.0)
        for k in range(17):
            found.receive(system_time(plane, 100.0 + k, UTC_S + k + (step_s if k >= 12 else 0.0)), float(k))
        assert said[1] == "UTC from SYSTEM_TIME"
        steps = [words for words in said if "UTC was set by" in words]
        assert len(steps) == count
        if count:
            assert steps == [f"UTC was set by +{step_s:.3f} s (SYSTEM_TIME); images follow the new one"]
