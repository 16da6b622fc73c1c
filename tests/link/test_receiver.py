"""Attitude, position and time of an autopilot, from single packets."""

import tracemalloc
from pathlib import Path

import numpy as np
import pytest

from glstar.flight import Flight
from glstar.link import Framer, Packet
from glstar.link.clock import BootClock
from glstar.link.history import RowBuffer
from glstar.link.receiver import Receiver
from glstar.rotation import euler_from_quaternion, quaternion_from_euler
from glstar.sky.place.site import Site
from glstar.telemetry import FlightOptions
from tests.support.sender import MAVLINK, UTC_S, Sender, flying, receiver, system_time

LOGS = Path(__file__).parents[3] / "shared" / "logs"


def attitude_rad(heard: Receiver) -> tuple[float, ...]:
    flight = heard.history.snapshot().flight(0.0, name="", attitude_source="", position_source="", utc_source="")
    assert flight is not None
    return tuple(float(angle) for angle in euler_from_quaternion(flight.attitude.q_body_ned[-1]))


def test_only_senders_with_an_autopilots_heartbeat_are_autopilots() -> None:
    heard, _ = receiver()
    station, gimbal, mute, plane = Sender(255, 190), Sender(1, 154), Sender(3), Sender(1)
    heard.receive(station.heartbeat(autopilot=8), 0.0)
    heard.receive(gimbal.heartbeat(autopilot=8), 0.0)
    heard.receive(mute.angles(1.0), 0.0)
    assert heard.chosen is None

    heard.receive(plane.heartbeat(), 0.1)

    assert heard.chosen == (1, 1)
    assert heard.vehicle == "ArduPlane"


def test_no_other_autopilot_replaces_the_requested_one() -> None:
    """Neither at first, nor if the requested one is missing or times out."""
    heard, messages = receiver(sysid=9)
    plane = Sender(1)
    for second in range(20):
        heard.receive(plane.heartbeat(), float(second))
        heard.receive(plane.angles(float(second)), float(second))
    assert heard.chosen is None
    assert heard.systems == (1,)
    assert heard.history.latest_boot_s is None
    assert not any("listening" in words for words in messages)

    asked_for = Sender(9)
    heard.receive(asked_for.heartbeat(), 20.0)
    for second in range(21, 40):
        heard.receive(plane.heartbeat(), float(second))
        heard.receive(plane.angles(float(second)), float(second))
    assert heard.chosen == (9, 1)
    assert heard.history.latest_boot_s is None


def test_an_autopilot_that_reports_attitude_replaces_one_that_does_not() -> None:
    heard, reported = receiver()
    tracker, plane = Sender(1), Sender(2)
    for second in range(8):
        heard.receive(tracker.heartbeat(), float(second))
        heard.receive(plane.heartbeat(), float(second))

    assert heard.chosen == (2, 1)
    assert any("listening to system 2" in words for words in reported)


def test_missing_packets_of_the_autopilot_are_losses_and_those_of_others_are_not() -> None:
    """A router forwards heartbeats of a ground station, and none of its other packets."""
    heard, _ = receiver()
    plane, station = Sender(1), Sender(255, 190)
    heard.receive(plane.heartbeat(), 0.0)
    for number in range(600):
        packet = plane.angles(number / 100)
        if number % 10:
            heard.receive(packet, number / 100)
        forwarded = station.heartbeat(8)
        if number % 3 == 0:
            heard.receive(forwarded, number / 100)

    assert heard.lost == pytest.approx(60, abs=1)
    assert heard.packets == 1 + 540 + 200
    assert heard.counted == 1 + 540


@pytest.mark.skipif(not LOGS.is_dir(), reason="needs the real logs of ../shared")
def test_a_recorded_link_without_losses_has_none() -> None:
    """ArduPilot forwarded the heartbeats of a ground station, and nothing else of it."""
    raw, framer, (heard, _) = (LOGS / "plane_SITL_gnss_denied.tlog").read_bytes(), Framer(), flying()
    at = 0
    while at < len(raw):
        stop = at + 8 + raw[at + 9] + 12
        for packet in framer.feed(raw[at + 8 : stop]):
            heard.receive(packet, int.from_bytes(raw[at : at + 8], "big") * 1e-6)
        at = stop

    assert heard.chosen == (1, 1)
    assert heard.packets > 10_000
    assert heard.counted < heard.packets
    assert heard.lost == 0


def test_the_quaternion_is_used_unless_the_angles_are_twice_as_frequent() -> None:
    for quaternions, source in ((50, "ATTITUDE_QUATERNION"), (4, "ATTITUDE")):
        heard, _ = receiver()
        plane = Sender(1)
        heard.receive(plane.heartbeat(), 0.0)
        for step in range(40):
            at_s = step / 10
            heard.receive(plane.angles(at_s), at_s)
            for part in range(quaternions // 10 if quaternions >= 10 else step % 3 == 0):
                heard.receive(plane.quaternion(at_s + part / 100, 0.0, 1.0, 0.0, 0.0), at_s + part / 100)
        assert heard.attitude_source == source


def test_attitudes_before_the_alignment_are_dropped() -> None:
    heard, _ = receiver()
    plane = Sender(1)
    heard.receive(plane.heartbeat(), 0.0)
    heard.receive(plane.quaternion(1.0, 1.0, 0.0, 0.0, 0.0), 0.1)
    heard.receive(plane.quaternion(1.1, np.nan, 0.0, 0.0, 0.0), 0.2)
    heard.receive(plane.quaternion(1.2, 0.5, 0.0, 0.0, 0.0), 0.3)
    assert heard.history.latest_boot_s is None

    heard.receive(plane.quaternion(1.3, 0.0, 1.0, 0.0, 0.0), 0.4)
    assert heard.history.latest_boot_s == 1.3


def test_zero_positions_are_dropped_and_fixes_are_used_without_other_positions() -> None:
    heard, _ = receiver()
    plane = Sender(1)
    heard.receive(plane.heartbeat(), 0.0)
    heard.receive(plane.angles(1.0), 0.1)
    for fix_type in (2, 3):
        assert not heard.history.has_position
        gps = MAVLINK.MAVLink_gps_raw_int_message(0, fix_type, -348000000, 1386000000, 50_000, 1, 1, 0, 0, 9)
        heard.receive(plane(gps), 0.2)
    assert heard.history.has_position

    other, _ = receiver()
    other.receive(plane.heartbeat(), 0.0)
    other.receive(plane(MAVLINK.MAVLink_global_position_int_message(1000, 0, 0, 0, 0, 0, 0, 0, 0)), 0.1)
    assert not other.history.has_position


def test_memory_does_not_grow_over_a_long_flight() -> None:
    heard, _ = receiver(keep_s=100.0)
    plane = Sender(1)
    heard.receive(plane.heartbeat(), 0.0)
    # One packet object with changing contents: only the memory of the receiver is measured.
    packet = plane.quaternion(0.0, 0.0, 1.0, 0.0, 0.0)
    message = heard._decode(bytearray(packet.content))
    heard._decode = lambda _: message
    sizes = []
    tracemalloc.start()
    for step in range(25_000):
        message.time_boot_ms = step * 20
        content = packet.content[:10] + message.time_boot_ms.to_bytes(4, "little") + packet.content[14:]
        heard.receive(packet._replace(sequence=step % 256, content=content), step / 50)
        if step in {12_000, 24_999}:
            sizes.append(tracemalloc.get_traced_memory()[0])
    tracemalloc.stop()

    assert sizes[1] < sizes[0] + 20_000
    assert heard.history.latest_boot_s == pytest.approx(499.98, abs=1e-6)


def test_rows_keep_the_latest_in_order() -> None:
    rows = RowBuffer(2, most=10)
    for number in range(1000):
        rows.append((float(number), -float(number)))
        first = max(0, number - 9)
        np.testing.assert_array_equal(rows.latest(-np.inf)[:, 0], np.arange(first, number + 1))
    np.testing.assert_array_equal(rows.latest(997.5), [[998.0, -998.0], [999.0, -999.0]])


def test_old_rows_are_dropped_and_the_buffer_stays_small() -> None:
    rows = RowBuffer(3, most=100_000, span=6000.0)
    for number in range(100_000):
        rows.append((float(number), 0.0, 0.0))
        if number % 997 == 0:
            assert len(rows.latest(number - 6000.0)) == min(number, 6000) + 1
    assert len(rows._buffer) <= 16_384


def test_after_a_restart_the_attitude_is_that_of_the_new_boot() -> None:
    heard, reported = receiver()
    plane = Sender(1)
    heard.receive(plane.heartbeat(), 0.0)
    heard.receive(plane.angles(100.0, 1.0), 1.0)
    heard.receive(plane.angles(1.0, 2.0), 2.0)

    assert heard.history.latest_boot_s == 1.0
    assert reported[-1] == "the autopilot was restarted; its clock begins again"
    heard.receive(plane(MAVLINK.MAVLink_global_position_int_message(1010, -348000000, 1, 0, 0, 0, 0, 0, 0)), 2.0)
    heard.receive(plane.angles(1.02, 2.0), 2.02)
    assert attitude_rad(heard) == pytest.approx((0.1, 0.2, 2.0), abs=1e-6)


def test_the_first_of_attitudes_with_equal_timestamps_is_used() -> None:
    heard, _ = receiver()
    plane = Sender(1)
    heard.receive(plane.heartbeat(), 0.0)
    for yaw_rad in (1.0, 2.0, 3.0):
        heard.receive(plane.angles(1.0, yaw_rad), 1.0)
    heard.receive(plane.angles(0.9, 0.5), 1.1)

    assert heard.packets == 5
    attitudes = heard.history.snapshot().attitudes
    np.testing.assert_allclose(attitudes[:, 0], [1.0, 0.9], rtol=0, atol=1e-6)
    assert [float(euler_from_quaternion(q)[2]) for q in attitudes[:, 1:]] == pytest.approx([1.0, 0.5], abs=1e-6)


# --- reboots and clocks that are set -------------------------------------------------------------------------------


def fly(heard: Receiver, plane: Sender, boot_s: float, arrival_s: float, seconds: float, utc_s: float | None) -> None:
    """Send 50 attitudes a second to a receiver; without SYSTEM_TIME if UTC is None."""
    heard.receive(plane.heartbeat(), arrival_s)
    for step in range(round(seconds * 50)):
        at_s = step / 50
        heard.receive(plane.angles(boot_s + at_s, 0.01 * (arrival_s + at_s)), arrival_s + at_s)
        if utc_s is not None and step % 25 == 0:
            heard.receive(system_time(plane, boot_s + at_s, utc_s + at_s), arrival_s + at_s)


def flight_of(heard: Receiver, last_s: float = np.inf) -> Flight:
    assert heard.clock.utc_minus_boot_s is not None
    flight = heard.history.snapshot(last_s).flight(
        heard.clock.utc_minus_boot_s,
        name="",
        attitude_source="",
        position_source="",
        utc_source="",
        options=FlightOptions(site=Site(0.0, 0.0)),
    )
    assert flight is not None
    return flight


def check_attitude(flight: Flight) -> None:
    """Check that the yaw of each sample encodes its time: 0.01 rad a second."""
    track = flight.attitude
    yaw_rad = euler_from_quaternion(track.q_body_ned)[2]
    np.testing.assert_allclose(np.asarray(yaw_rad), 0.01 * (track.utc_s - UTC_S), rtol=0, atol=2e-5)


def test_a_reboot_is_a_gap_and_earlier_samples_keep_their_utc() -> None:
    heard, _ = flying()
    fly(heard, Sender(1), 100.0, 0.0, 10.0, UTC_S)
    fly(heard, Sender(1), 3.0, 14.0, 5.0, None)

    flight = flight_of(heard)
    (gap,) = flight.attitude.gaps
    assert gap.reason == "a reboot of the autopilot"
    assert (gap.start_utc_s, gap.stop_utc_s) == pytest.approx((UTC_S + 9.98, UTC_S + 14.0), rel=0, abs=1e-3)
    assert flight.attitude.first_s == pytest.approx(UTC_S, rel=0, abs=1e-3)
    check_attitude(flight)
    # A reading of UTC after the reboot does not move earlier samples.
    fly(heard, Sender(1), 8.0, 19.0, 3.0, UTC_S + 19.0)
    check_attitude(flight_of(heard))
    # A flight of the last seconds has no samples from before it.
    assert flight_of(heard, 4.0).attitude.gaps == ()


def test_several_reboots_are_several_gaps_within_the_requested_duration() -> None:
    messages: list[str] = []
    heard = Receiver(BootClock(), messages.append, keep_s=30.0)
    for boot in range(6):
        fly(heard, Sender(1), 5.0, 12.0 * boot, 10.0, UTC_S + 12.0 * boot)

    track = flight_of(heard).attitude
    assert [gap.reason for gap in track.gaps] == ["a reboot of the autopilot"] * 2
    assert track.last_s - track.first_s == pytest.approx(30.0, abs=0.05)
    check_attitude(flight_of(heard))


def test_samples_before_a_clock_was_set_back_are_dropped() -> None:
    """A replayed vehicle begins at an earlier UTC: the two flights are separate."""
    heard, _ = flying()
    fly(heard, Sender(1), 100.0, 0.0, 10.0, UTC_S)
    fly(heard, Sender(1), 1.0, 12.0, 5.0, UTC_S - 500.0)

    track = flight_of(heard).attitude
    assert track.gaps == ()
    assert track.first_s == pytest.approx(UTC_S - 500.0, rel=0, abs=1e-3)


def test_utc_that_is_set_is_reported_once_with_its_step() -> None:
    heard, messages = flying()
    plane = Sender(1)
    fly(heard, plane, 100.0, 0.0, 10.0, UTC_S)
    fly(heard, plane, 110.0, 10.0, 10.0, UTC_S + 47.0)

    assert [words for words in messages if "set" in words] == [
        "UTC was set by +37.000 s (SYSTEM_TIME); images follow the new one"
    ]


def test_a_restarted_sender_has_lost_no_packets() -> None:
    """Its sequence numbers restart: the step from 200 to 0 is not a loss of 55 packets."""
    heard, _ = flying()
    first = Sender(1)
    fly(heard, first, 100.0, 0.0, 3.9, None)
    assert heard.lost == 0
    fly(heard, Sender(1), 1.0, 4.5, 1.0, None)

    assert heard.lost == 0


def test_missing_sequence_numbers_are_losses_and_pauses_are_not() -> None:
    heard, _ = flying()
    plane = Sender(1)
    heard.receive(plane.heartbeat(), 0.0)
    for _ in range(40):
        plane.heartbeat()  # these do not arrive
    heard.receive(plane.heartbeat(), 1.0)
    assert heard.lost == 40
    for _ in range(40):
        plane.heartbeat()
    heard.receive(plane.heartbeat(), 10.0)

    assert heard.lost == 40


# --- a simulator's own state ----------------------------------------------------------------------------------------


def hil_state(sender: Sender, stamped_s: float, yaw_rad: float) -> Packet:
    q = quaternion_from_euler(0.0, 0.0, yaw_rad)
    place = (-349300000, 1386000000, 300_000)
    body_to_ned = (float(q[0]), *(-q[1:]).tolist())
    return sender(
        MAVLINK.MAVLink_hil_state_quaternion_message(
            round(stamped_s * 1e6), body_to_ned, 0, 0, 0, *place, 0, 0, 0, 0, 0, 0, 0, 0
        )
    )


@pytest.mark.parametrize("stamped_by_utc", [True, False])
def test_a_simulators_state_is_attitude_position_and_time(stamped_by_utc: bool) -> None:
    heard, _ = flying()
    plane = Sender(1)
    heard.receive(plane.heartbeat(), 0.0)
    for step in range(100):
        at_s = step / 50
        stamped_s = UTC_S + at_s if stamped_by_utc else 70.0 + at_s
        heard.receive(hil_state(plane, stamped_s, 0.01 * at_s), at_s)
        if not stamped_by_utc and step % 25 == 0:
            heard.receive(system_time(plane, 70.0 + at_s, UTC_S + at_s), at_s)

    assert heard.attitude_source == "HIL_STATE_QUATERNION"
    assert heard.position_source == "HIL_STATE_QUATERNION"
    assert heard.history.has_position
    flight = flight_of(heard)
    assert flight.attitude.first_s == pytest.approx(UTC_S, rel=0, abs=1e-3)
    assert flight.attitude.rate_hz == pytest.approx(50.0, rel=1e-3)
    check_attitude(flight)
    places = heard.history.snapshot().positions
    assert len(places) == 11  # five a second, and the latest
    place = places[-1]
    np.testing.assert_allclose(np.rad2deg(place[1:3]), [-34.93, 138.6], rtol=0, atol=1e-9)
    assert place[3] == 300.0


def test_a_simulators_state_without_a_time_begins_no_clock() -> None:
    """PX4 1.17.0-alpha1 leaves its time 0: the first attitude after it was taken for a restart of the autopilot."""
    heard, messages = flying()
    plane = Sender(1)
    heard.receive(plane.heartbeat(), 0.0)
    for step in range(100):
        at_s = step / 50
        heard.receive(hil_state(plane, 0.0, 0.01 * at_s), at_s)
        if step >= 25:
            heard.receive(plane.angles(70.0 + at_s, 0.01 * at_s), at_s + 0.001)
        if step % 25 == 0:
            heard.receive(system_time(plane, 70.0 + at_s, UTC_S + at_s), at_s)

    assert heard.attitude_source == "ATTITUDE"
    assert heard.clock.boot == 0
    assert not [message for message in messages if "restarted" in message]
    assert flight_of(heard).attitude.first_s == pytest.approx(UTC_S + 0.5, rel=0, abs=1e-3)


def test_the_autopilots_attitude_is_preferred_to_a_simulators_state() -> None:
    heard, messages = flying()
    plane = Sender(1)
    heard.receive(plane.heartbeat(), 0.0)
    for step in range(200):
        at_s = step / 50
        heard.receive(plane.angles(70.0 + at_s, 0.01 * at_s), at_s)
        heard.receive(hil_state(plane, UTC_S + at_s, 2.0), at_s)
        if step % 25 == 0:
            heard.receive(system_time(plane, 70.0 + at_s, UTC_S + at_s), at_s)

    assert heard.attitude_source == "ATTITUDE"
    assert len(heard.history.snapshot().attitudes) == 200
    check_attitude(flight_of(heard))
    assert not any("two autopilots" in words for words in messages)
