"""Rows, boots, states of a simulator and attitudes of a gimbal that a link keeps, from numbers made by hand."""

from math import inf, radians
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from glstar.link.gimbal import LinkGimbal
from glstar.link.history import History, HistorySnapshot, PastBoot, RowBuffer, SimulatorState
from glstar.link.packets import MessageId
from glstar.rotation import quaternion_from_euler
from glstar.sky.place.site import Site
from glstar.telemetry import FlightOptions

Q = np.array([0.5, -0.5, 0.5, 0.5])
NAMES = {"attitude_source": "ATTITUDE", "position_source": "P", "utc_source": "U", "name": "live"}


def times(rows: Any) -> list[float]:
    return [float(row[0]) for row in rows]


def test_a_buffer_has_the_latest_rows_up_to_its_number() -> None:
    rows = RowBuffer(2, 3)
    assert len(rows) == 0
    for k in range(20):
        rows.append((k, 10.0 * k))
        expected = list(range(max(k - 2, 0), k + 1))
        assert rows.latest(-inf).tolist() == [[j, 10.0 * j] for j in expected]
        assert len(rows) == len(expected)
    rows.replace_last((30.0, 7.0))
    assert rows.latest(18.0).tolist() == [[18.0, 180.0], [30.0, 7.0]]
    copy = rows.latest(-inf)
    copy[:] = 0.0
    assert rows.latest(-inf).tolist() == [[17.0, 170.0], [18.0, 180.0], [30.0, 7.0]]
    rows.clear()
    assert (len(rows), rows.latest(-inf).tolist()) == (0, [])


def test_a_buffer_grows_and_drops_rows_of_long_ago_when_it_is_full() -> None:
    rows = RowBuffer(1, 5000)
    for k in range(12_000):
        rows.append((k,))
        if k in {4095, 4096, 5200, 8192, 9999, 10_000, 11_999}:
            assert times(rows.latest(-inf)) == list(range(max(0, k - 4999), k + 1))
    # Twenty rows are full: of them two are not older than 2.5.
    few = RowBuffer(1, 10, 2.5)
    for k in range(21):
        few.append((k,))
        assert len(few) == (3 if k == 20 else min(k + 1, 10))
    assert times(few.latest(-inf)) == [18, 19, 20]


def test_one_position_of_an_interval_is_kept_and_the_latest() -> None:
    history = History()
    assert not history.has_position
    for at_s, expected in (
        (0.0, [0.0]),
        (0.05, [0.0, 0.05]),
        (0.1, [0.0, 0.1]),
        (0.19, [0.0, 0.19]),
        (0.2, [0.0, 0.2]),
        (0.25, [0.0, 0.2, 0.25]),
        (0.45, [0.0, 0.2, 0.45]),
        (0.7, [0.0, 0.2, 0.45, 0.7]),
    ):
        history.add_position(at_s, 0.1, 0.2, 30.0 + at_s, every_s=0.2)
        assert history.snapshot().positions.tolist() == [[t, 0.1, 0.2, 30.0 + t] for t in expected]
    assert history.has_position
    every = History()
    for at_s in (0.0, 0.05, 0.1):
        every.add_position(at_s, 0.1, 0.2, 30.0)
    assert times(every.snapshot().positions) == [0.0, 0.05, 0.1]


def filled(history: History, first_s: float, count: int, height_m: float = 30.0) -> None:
    for k in range(count):
        history.add_attitude(first_s + k, Q)
        history.add_position(first_s + k, 0.1, 0.2, height_m)


def test_a_snapshot_has_the_attitudes_of_the_last_seconds_and_all_positions() -> None:
    history = History(10.0)
    assert history.latest_boot_s is None
    filled(history, 100.0, 5)
    history.add_attitude(103.5, Q)  # overtaken
    assert history.latest_boot_s == 104.0

    snapshot = history.snapshot(2.0)

    assert times(snapshot.attitudes) == [102.0, 103.0, 104.0, 103.5]
    assert times(snapshot.positions) == [100.0, 101.0, 102.0, 103.0, 104.0]
    assert (snapshot.last_s, snapshot.past) == (2.0, ())
    assert history.snapshot().last_s == history.snapshot(50.0).last_s == 10.0


def test_previous_boots_are_kept_at_their_utc_and_make_gaps_of_a_flight() -> None:
    history = History(1000.0)
    filled(history, 100.0, 5, 30.0)
    history.begin_boot(1000.0)
    assert (history.latest_boot_s, history.has_position) == (None, True)
    filled(history, 2.0, 3, 40.0)

    flight = history.snapshot().flight(1200.0, **NAMES, options=FlightOptions(time_offset_s=0.75))

    assert flight is not None
    assert flight.attitude.utc_s.tolist() == [1100, 1101, 1102, 1103, 1104, 1202, 1203, 1204]
    np.testing.assert_allclose(flight.attitude.q_body_ned, [Q] * 8, rtol=0, atol=1e-12)
    [gap] = flight.attitude.gaps
    assert (gap.start_utc_s, gap.stop_utc_s) == (1104, 1202)
    assert "reboot" in gap.reason
    assert [flight.position.at(utc_s).height_m for utc_s in (1100, 1204)] == [30.0, 40.0]
    assert (flight.name, flight.position_source, flight.utc_source) == ("live", "P", "U")
    assert flight.time_offset_s == 0.75
    assert flight.attitude_source == "ATTITUDE, 1.0 Hz"
    # A given site replaces the positions.
    fixed = history.snapshot().flight(1200.0, **NAMES, options=FlightOptions(site=Site(0.3, 0.4, 50.0)))
    assert fixed is not None
    assert fixed.position.at(1150).height_m == 50.0
    # Of 3 s, nothing is of the previous boot; of 101 s, its last four attitudes.
    for last_s, count in ((3.0, 3), (99.9, 8 - 5), (101.0, 3 + 2), (103.0, 3 + 4)):
        snapshot = History(1000.0)
        filled(snapshot, 100.0, 5)
        snapshot.begin_boot(1000.0)
        filled(snapshot, 2.0, 3)
        flight = snapshot.snapshot(last_s).flight(1200.0, **NAMES)
        assert flight is not None
        assert len(flight.attitude.utc_s) == count


def test_boots_of_unknown_utc_or_of_long_ago_or_that_overlap_are_dropped() -> None:
    history = History(60.0)
    filled(history, 100.0, 5)
    history.begin_boot(None)
    assert not history.has_position
    assert history.snapshot().past == ()
    filled(history, 10.0, 3)
    history.begin_boot(1000.0)  # 1010 to 1012
    filled(history, 10.0, 3)
    history.begin_boot(1060.5)  # 1070.5 to 1072.5: 60 s before are 1012.5
    [past] = history.snapshot().past
    assert times(past.attitudes) == [1070.5, 1071.5, 1072.5]
    assert times(past.positions) == [1070.5, 1071.5, 1072.5]
    history.begin_boot(1060.5)  # without attitudes, nothing has ended
    assert len(history.snapshot().past) == 1
    filled(history, 10.0, 3)
    history.begin_boot(1122.0)  # 1132 to 1134: the last 60 s have nothing of the boot before
    filled(history, 10.0, 3)
    for utc_minus_boot_s, count in ((1123.9, 3), (1124.1, 6)):  # from 1133.9, or 1134.1 on
        flight = history.snapshot().flight(utc_minus_boot_s, **NAMES)
        assert flight is not None
        assert len(flight.attitude.utc_s) == count


def test_a_flight_needs_two_attitudes_of_this_boot_or_more_and_a_position() -> None:
    attitudes, positions = np.array([[1.0, *Q], [2.0, *Q]]), np.array([[1.0, 0.1, 0.2, 30.0]])
    past = PastBoot(attitudes, positions)

    assert HistorySnapshot(attitudes, positions).flight(1000.0, **NAMES) is not None
    assert HistorySnapshot(attitudes[:1], positions).flight(1000.0, **NAMES) is None
    assert HistorySnapshot(attitudes, positions[:0]).flight(1000.0, **NAMES) is None
    assert HistorySnapshot(attitudes[:0], positions, (past,)).flight(1000.0, **NAMES) is None
    joined = HistorySnapshot(attitudes[:1], positions[:0], (past,)).flight(1000.0, **NAMES)
    assert joined is not None
    assert joined.attitude.utc_s.tolist() == [1.0, 2.0, 1001.0]
    estimate = HistorySnapshot(attitudes, positions[:0]).estimate(1000.0, attitude_source="A")
    assert estimate is not None
    assert (estimate.position, estimate.attitude_source) == (None, "A, 1.0 Hz")


# --- a simulator's state ----------------------------------------------------------------------------------------------


def simstate(yaw_rad: float, *, lat: int = -349300000, lng: int = 1386000000) -> SimpleNamespace:
    return SimpleNamespace(roll=0.1, pitch=0.2, yaw=yaw_rad, lat=lat, lng=lng)


def states(state: SimulatorState) -> list[float]:
    return times(state.history.snapshot().attitudes)


def test_states_lie_between_the_attitudes_before_and_after_them() -> None:
    state = SimulatorState(60.0)
    state.receive(MessageId.SIMSTATE, simstate(0.05), 4.9)
    state.pair(100.0, 5.0)  # the states before the first attitude have no time
    assert states(state) == []
    for arrival_s in (4.9, 5.004, 5.010, 5.03, 5.04):
        state.receive(MessageId.SIMSTATE, simstate(arrival_s - 5), arrival_s)
    state.pair(100.02, 5.025)
    # The first at the attitude before it, the fourth at the one after it; the fifth is not later than the fourth.
    assert states(state) == pytest.approx([100.0, 100.004, 100.01, 100.02], rel=0, abs=1e-9)
    state.receive(MessageId.SIMSTATE, simstate(0.3), 5.03)
    state.pair(100.02, 5.028)  # an older attitude changes nothing
    state.pair(100.01, 5.029)
    assert len(states(state)) == 4
    state.receive(MessageId.SIMSTATE, simstate(0.35), 5.035)
    state.pair(100.04, 5.035)
    # The last one was sent with the attitude.
    assert states(state)[4:] == pytest.approx([100.025, 100.04], rel=0, abs=1e-9)
    yaws = state.history.snapshot().attitudes[-1, 1:]
    np.testing.assert_allclose(yaws, quaternion_from_euler(0.1, 0.2, 0.35), rtol=0, atol=1e-12)
    # After a reboot there is no attitude before.
    state.begin_boot(1000.0)
    state.receive(MessageId.SIMSTATE, simstate(0.3), 5.2)
    state.pair(100.3, 5.3)
    assert states(state) == []


def test_states_of_a_simulators_clock_lie_at_the_fraction_of_their_arrival() -> None:
    state = SimulatorState(60.0, is_vehicle_time=True)
    state.pair(100.0, 5.0)
    for arrival_s in (5.1, 5.3, 5.7):
        state.receive(MessageId.SIMSTATE, simstate(0.1), arrival_s)
    state.pair(102.0, 5.4)
    assert states(state) == pytest.approx([100.5, 101.5, 102.0], rel=0, abs=1e-9)
    state.receive(MessageId.SIMSTATE, simstate(0.1), 5.5)
    state.pair(103.0, 5.8)
    # Read together, a state has the latest fraction: a third.
    state.receive(MessageId.SIMSTATE, simstate(0.1), 5.8)
    state.pair(106.0, 5.8)
    assert states(state)[3:] == pytest.approx([102.25, 103.75], rel=0, abs=1e-9)


def test_the_best_message_of_a_simulator_is_used_for_two_seconds_after_its_last() -> None:
    state = SimulatorState(60.0)
    assert (state.source, state.position_source) == (None, None)
    state.receive(MessageId.SIMSTATE, simstate(0.1), 5.0)
    assert (state.source, state.position_source) == ("SIMSTATE", "SIMSTATE, height 0 m")
    state.height_m = 120.0
    assert state.position_source == "SIMSTATE, height of GLOBAL_POSITION_INT"
    best = SimpleNamespace(q1=0.0, q2=0.0, q3=0.0, q4=0.0, roll=0.1, pitch=0.2, yaw=0.3, lat=-34.93, lon=138.6)
    best = SimpleNamespace(**vars(best), lat_int=0, lon_int=0, alt=250.0)
    state.receive(MessageId.SIM_STATE, best, 6.0)
    assert (state.source, state.position_source) == ("SIM_STATE", "SIM_STATE")
    state.receive(MessageId.SIMSTATE, simstate(0.1), 7.9)
    assert state.source == "SIM_STATE"
    assert state.rate_hz(7.9) == 0.5  # an ignored message has no rate
    state.receive(MessageId.SIMSTATE, simstate(0.1), 8.0)
    assert state.source == "SIMSTATE"


A, B = -349300000, 1386000000


@pytest.mark.parametrize(
    ("number", "fields", "expected"),
    [
        (MessageId.SIMSTATE, {"lat": A, "lng": B}, (-34.93, 138.6, 120.0)),
        (MessageId.SIMSTATE, {"lat": 0, "lng": B}, (0.0, 138.6, 120.0)),
        (MessageId.SIMSTATE, {"lat": 0, "lng": 0}, None),
        (MessageId.SIMSTATE, {"lat": 900000010, "lng": B}, None),
        (MessageId.SIMSTATE, {"lat": 900000000, "lng": -1800000000}, (90.0, -180.0, 120.0)),
        (MessageId.SIMSTATE, {"lat": A, "lng": 1800000010}, None),
        (MessageId.HIL_STATE_QUATERNION, {"lat": A, "lon": B, "alt": 250_500}, (-34.93, 138.6, 250.5)),
        (MessageId.HIL_STATE_QUATERNION, {"lat": A, "lon": B, "alt": -1_000_000}, (-34.93, 138.6, -1000.0)),
        (MessageId.HIL_STATE_QUATERNION, {"lat": A, "lon": B, "alt": -1_000_001}, None),
        (MessageId.HIL_STATE_QUATERNION, {"lat": A, "lon": B, "alt": 100_000_001}, None),
        (MessageId.SIM_STATE, {"lat": -34.93, "lon": 138.6, "alt": 7.5}, (-34.93, 138.6, 7.5)),
        (MessageId.SIM_STATE, {"lat": float(A), "lon": 45.5, "alt": 7.5}, (-34.93, 4.55e-6, 7.5)),
        (MessageId.SIM_STATE, {"lat": 12.5, "lon": float(B), "alt": 7.5}, (1.25e-6, 138.6, 7.5)),
        (MessageId.SIM_STATE, {"lat": 1.0, "lon": 2.0, "alt": 7.5, "lat_int": A, "lon_int": B}, (-34.93, 138.6, 7.5)),
        (MessageId.SIM_STATE, {"lat": 1.0, "lon": 2.0, "alt": 7.5, "lat_int": A}, (-34.93, 0.0, 7.5)),
    ],
)
def test_the_place_of_a_state_is_in_the_units_of_its_message(
    number: MessageId, fields: dict[str, Any], expected: tuple[float, float, float] | None
) -> None:
    state = SimulatorState(60.0)
    state.height_m = 120.0
    ahead = {"roll": 0.1, "pitch": 0.2, "yaw": 0.3, "lat_int": 0, "lon_int": 0, "q1": 0.5, "q2": 0.5, "q3": -0.5}
    message = SimpleNamespace(**(ahead | {"q4": 0.5, "attitude_quaternion": [0.5, 0.5, -0.5, 0.5]} | fields))

    state.pair(100.0, 5.0)
    state.receive(number, message, 5.5)
    state.pair(101.0, 6.0)

    [(boot_s, *q)] = state.history.snapshot().attitudes.tolist()
    assert boot_s == 100.5
    angles = quaternion_from_euler(0.1, 0.2, 0.3).tolist()
    assert q == pytest.approx(angles if number == MessageId.SIMSTATE else [0.5, -0.5, 0.5, -0.5])
    places = state.history.snapshot().positions.tolist()
    if expected is None:
        assert places == []
    else:
        [place] = places
        assert place == pytest.approx([100.5, radians(expected[0]), radians(expected[1]), expected[2]], rel=1e-12)


# --- a gimbal ---------------------------------------------------------------------------------------------------------

CLOCK = SimpleNamespace(host_minus_boot_s=5.0)


def gimbal(keep_s: float = 60.0) -> LinkGimbal:
    return LinkGimbal(CLOCK, keep_s)  # type: ignore[arg-type]


def orientation(boot_s: float, **others: Any) -> SimpleNamespace:
    return SimpleNamespace(time_boot_ms=round(1000 * boot_s), roll=1.5, pitch=35.0, yaw=-25.0, **others)


MOUNT = SimpleNamespace(pointing_a=3500, pointing_b=150, pointing_c=-2500)


def heard(found: LinkGimbal, boot_s: float, number: MessageId = MessageId.MOUNT_ORIENTATION, **others: Any) -> None:
    found.receive(number, orientation(boot_s), boot_s + 5, component=1, autopilot=1, boot_s=boot_s, **others)


def test_attitudes_of_a_gimbal_are_used_up_to_that_of_the_aircraft() -> None:
    found = gimbal()
    assert found.samples(1000.0) is None
    assert found.is_silent(0.0)
    for boot_s in (10.0, 10.5, 11.0, 11.5):
        heard(found, boot_s)
    found.pair(None, 16.0)
    assert found.latest_boot_s is None
    found.pair(10.5, 16.25)

    assert (found.latest_boot_s, found.arrival_s, found.source) == (10.5, 16.25, "MOUNT_ORIENTATION")
    assert (found.is_silent(18.25), found.is_silent(18.26)) == (False, True)
    found.pair(11.25, 17.0)
    heard(found, 10.9)  # overtaken
    found.pair(12.0, 18.0)
    samples = found.samples(1000.0)
    assert samples is not None
    assert samples.clock_s.tolist() == [1010.0, 1010.5, 1011.0, 1011.5]
    np.testing.assert_allclose(
        samples.q_gimbal_reference, [quaternion_from_euler(*map(radians, (1.5, 35.0, -25.0)))] * 4, rtol=0, atol=1e-12
    )
    assert samples.is_earth.tolist() == [False] * 4
    assert found.rate_hz(16.5) == 2.5
    latest = found.samples(1000.0, 0.75)
    assert latest is not None
    assert latest.clock_s.tolist() == [1011.0, 1011.5]


def test_the_gimbal_is_that_of_the_autopilots_message_or_its_component() -> None:
    for component, fields, device in (
        (5, {}, 5),
        (5, {"gimbal_device_id": 0}, 5),
        (5, {"gimbal_device_id": 3}, 3),
        (154, {"gimbal_device_id": 3}, 154),
    ):
        found = gimbal()
        assert found.device == 0
        message = orientation(1.0, **fields)
        found.receive(MessageId.MOUNT_ORIENTATION, message, 6.0, component=component, autopilot=5, boot_s=1.0)
        assert found.device == device


def test_messages_without_the_autopilots_time_have_that_of_their_arrival_or_of_the_gimbals_clock() -> None:
    found = gimbal()
    for arrival_s in (7.0, 7.5):
        found.receive(MessageId.MOUNT_STATUS, MOUNT, arrival_s, component=1, autopilot=1, boot_s=None)
    found.pair(20.0, 8.0)
    samples = found.samples(0.0)
    assert samples is not None
    assert samples.clock_s.tolist() == [2.0, 2.5]
    # Its clock began 50 s before the autopilot's; the second packet is 0.2 s late.
    found = gimbal()
    for boot_s, late_s in ((2.0, 0.0), (2.5, 0.2), (3.0, 0.1)):
        message = orientation(boot_s + 50)
        arrival_s = boot_s + 5 + late_s
        found.receive(MessageId.MOUNT_ORIENTATION, message, arrival_s, component=154, autopilot=1, boot_s=None)
    found.pair(20.0, 8.0)
    samples = found.samples(0.0)
    assert samples is not None
    assert samples.clock_s.tolist() == pytest.approx([2.0, 2.5, 3.0], rel=0, abs=1e-9)
    unknown = LinkGimbal(SimpleNamespace(host_minus_boot_s=None), 60.0)  # type: ignore[arg-type]
    unknown.receive(MessageId.MOUNT_STATUS, MOUNT, 7.0, component=1, autopilot=1, boot_s=None)
    unknown.pair(20.0, 8.0)
    assert (unknown.samples(0.0), unknown.rate_hz(7.0)) == (None, 0.0)


def test_a_worse_message_of_a_gimbal_waits_for_two_seconds() -> None:
    found = gimbal()
    heard(found, 10.0)
    for boot_s, count in ((11.99, 1), (12.0, 2)):
        found.receive(MessageId.MOUNT_STATUS, MOUNT, boot_s + 5, component=1, autopilot=1, boot_s=boot_s)
        assert found.source == ("MOUNT_ORIENTATION" if count == 1 else "MOUNT_STATUS")
    # A better one is used at once, and those of the other that wait are dropped.
    heard(found, 12.1)
    found.pair(20.0, 25.0)
    samples = found.samples(0.0)
    assert samples is not None
    assert samples.clock_s.tolist() == [12.1]


def boots_of_a_gimbal(keep_s: float) -> LinkGimbal:
    """Return attitudes at 1010 to 1013 and 1030 to 1032 UTC, before this boot."""
    found = gimbal(keep_s)
    for first_s, count, utc_minus_boot_s in ((10.0, 4, 1000.0), (5.0, 3, 1025.0)):
        for k in range(count):
            heard(found, first_s + k)
        found.pair(100.0, 50.0)
        found.begin_boot(utc_minus_boot_s)
        assert (found.latest_boot_s, found.samples(0.0)) == (None, None)
    return found


@pytest.mark.parametrize(
    ("keep_s", "utc_minus_boot_s", "expected"),
    [
        (60.0, 1040.0, [1010, 1011, 1012, 1013, 1030, 1031, 1032, 1042, 1043, 1044]),
        (33.0, 1040.0, [1011, 1012, 1013, 1030, 1031, 1032, 1042, 1043, 1044]),
        (20.0, 1040.0, [1030, 1031, 1032, 1042, 1043, 1044]),
        (13.5, 1040.0, [1031, 1032, 1042, 1043, 1044]),
        (60.0, 1029.5, [1031.5, 1032.5, 1033.5]),  # overlaps the last boot
    ],
)
def test_previous_boots_of_a_gimbal_are_kept_at_their_utc(
    keep_s: float, utc_minus_boot_s: float, expected: list[float]
) -> None:
    found = boots_of_a_gimbal(keep_s)
    for boot_s in (2.0, 3.0, 4.0):
        heard(found, boot_s)
    found.pair(100.0, 60.0)

    samples = found.samples(utc_minus_boot_s)

    assert samples is not None
    assert samples.clock_s.tolist() == expected
    # A boot of unknown UTC is dropped, and previous boots of long ago are left out.
    found.begin_boot(None)
    heard(found, 2.0)
    found.pair(100.0, 60.0)
    samples = found.samples(1200.0)
    assert samples is not None
    assert samples.clock_s.tolist() == [1202]


def test_the_autopilots_own_message_is_better_than_the_same_of_another_component() -> None:
    found = gimbal()
    for component, boot_s in ((154, 10.0), (155, 10.5), (1, 11.0), (154, 11.5)):
        message = orientation(boot_s)
        found.receive(MessageId.MOUNT_ORIENTATION, message, boot_s, component=component, autopilot=1, boot_s=boot_s)
        assert found.device == {10.0: 154, 10.5: 154}.get(boot_s, 1)


def test_eight_previous_boots_and_a_thousand_waiting_states_are_kept() -> None:
    history, found, state = History(), gimbal(1e9), SimulatorState(60.0)
    assert history.snapshot().last_s == 600.0
    state.pair(100.0, 5.0)
    for k in range(1003):
        state.receive(MessageId.SIMSTATE, simstate(0.1), 5.0 + k / 1000)
        heard(found, 10.0 + k / 1000)
    state.pair(110.0, 15.0)
    found.pair(110.0, 15.0)
    samples = found.samples(0.0)
    assert samples is not None
    assert (len(states(state)), len(samples.clock_s)) == (1000, 1000)
    for boot in range(10):
        filled(history, 10.0, 2)
        heard(found, 12.0)
        found.pair(110.0, 15.0)
        history.begin_boot(20.0 * boot)
        found.begin_boot(20.0 * boot)
    heard(found, 12.0)
    found.pair(110.0, 15.0)
    samples = found.samples(1000.0)
    assert samples is not None
    assert [times(past.attitudes)[0] for past in history.snapshot().past] == [10 + 20 * k for k in range(2, 10)]
    assert samples.clock_s.tolist() == [*(12 + 20 * k for k in range(2, 10)), 1012]
