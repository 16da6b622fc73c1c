"""A simulator's truth beside an autopilot's estimates, from single packets with known arrival times."""

from typing import Any

import numpy as np
import pytest

from glstar.link.clock import BootClock
from glstar.link.history import SimulatorState
from glstar.link.receiver import Receiver
from glstar.rotation import euler_from_quaternion
from tests.support.autopilot import body_to_ned
from tests.support.sender import MAVLINK, Sender

DEG = np.pi / 180


def simstate(sender: Sender, yaw_rad: float) -> Any:
    return sender(MAVLINK.MAVLink_simstate_message(0.1, 0.2, yaw_rad, *(0.0,) * 6, -349300000, 1386000000))


def sim_state(lat: float, lon: float, lat_int: int = 0, lon_int: int = 0, q: tuple[float, ...] | None = None) -> Any:
    q = body_to_ned(0.1, 0.2, 0.3) if q is None else q
    return MAVLINK.MAVLink_sim_state_message(
        *q, 0.1, 0.2, 0.3, *(0.0,) * 6, lat, lon, 250.0, 0, 0, 0, 0, 0, lat_int, lon_int
    )


def listening() -> tuple[Receiver, Sender]:
    heard, plane = Receiver(BootClock(start_utc_s=0.0), lambda _: None, with_simulator=True), Sender(1)
    heard.receive(plane.heartbeat(), 0.0)
    return heard, plane


def history_of(heard: Receiver) -> np.ndarray[Any, Any]:
    assert heard.simulator is not None
    return heard.simulator.history.snapshot().attitudes


def test_a_state_without_a_time_has_that_of_its_arrival_between_two_attitudes() -> None:
    heard, plane = listening()
    heard.receive(plane.angles(100.000), 5.000)
    heard.receive(simstate(plane, 0.3), 5.012)
    assert len(history_of(heard)) == 0  # the attitude after it is not known yet
    heard.receive(plane.angles(100.020), 5.020)

    ((boot_s, *q_body_ned),) = history_of(heard)
    assert boot_s == pytest.approx(100.012, rel=0, abs=1e-9)
    assert [float(angle) for angle in euler_from_quaternion(np.array(q_body_ned))] == pytest.approx(
        [0.1, 0.2, 0.3], rel=0, abs=1e-6
    )


def test_states_of_a_delayed_burst_lie_between_their_attitudes_and_never_go_back() -> None:
    """The computer was busy for 0.2 s: all packets of that time are read at once."""
    heard, plane = listening()
    heard.receive(plane.angles(100.00), 5.00)
    for number in range(1, 11):
        heard.receive(simstate(plane, 0.01 * number), 5.2)
        heard.receive(plane.angles(100.0 + 0.02 * number), 5.2)

    times_s = history_of(heard)[:, 0]
    assert (np.diff(times_s) > 0).all()
    assert times_s[0] >= 100.0
    # Each pair was sent together, 20 ms after the one before: no state is older than one interval.
    yaw = np.array(euler_from_quaternion(history_of(heard)[:, 1:])[2])
    assert (times_s - (100.0 + 2 * yaw) >= -0.0201).all()
    assert (times_s - (100.0 + 2 * yaw) <= 1e-6).all()


def test_the_best_of_several_messages_is_used_alone() -> None:
    heard, plane = listening()
    for step in range(20):
        at_s = 0.05 * step
        heard.receive(plane(sim_state(-34.93, 138.6)), at_s)
        heard.receive(simstate(plane, 2.0), at_s + 0.01)
        heard.receive(plane.angles(100.0 + at_s), at_s + 0.02)

    assert heard.simulator is not None
    assert heard.simulator.source == heard.simulator.position_source == "SIM_STATE"
    yaw_rad = euler_from_quaternion(history_of(heard)[:, 1:])[2]
    np.testing.assert_allclose(np.asarray(yaw_rad), 0.3, rtol=0, atol=1e-6)
    # The estimates are not mixed with it.
    estimated_rad = euler_from_quaternion(heard.history.snapshot().attitudes[:, 1:])[2]
    np.testing.assert_allclose(np.asarray(estimated_rad), 0.0, rtol=0, atol=1e-6)


@pytest.mark.parametrize(
    ("message", "tolerance_deg"),
    [
        (sim_state(-34.93, 138.6), 1e-5),  # as MAVLink defines it; float32
        (sim_state(-349300000.0, 1386000000.0), 1e-5),  # as ArduPilot filled it before the integers
        (sim_state(-349300000.0, 1386000000.0, -349300000, 1386000000), 1e-9),
    ],
)
def test_a_position_is_read_in_each_of_its_units(message: Any, tolerance_deg: float) -> None:
    state, sender = SimulatorState(600.0), Sender(1)
    decoded = MAVLINK.MAVLink(None).decode(bytearray(sender(message).content))
    for step in range(3):
        state.pair(100.0 + step, float(step))
        state.receive(108, decoded, step + 0.5)

    positions = state.history.snapshot().positions
    np.testing.assert_allclose(np.rad2deg(positions[:, 1:3]), [[-34.93, 138.6]] * 2, rtol=0, atol=tolerance_deg)
    np.testing.assert_allclose(positions[:, 3], 250.0, rtol=0, atol=1e-9)


def test_the_latest_position_is_that_of_the_latest_state_and_earlier_ones_are_thinned() -> None:
    """At 22 m/s a position of up to 0.2 s before put the end of a flight 4 m back."""
    state, sender = SimulatorState(600.0), Sender(1)
    for step in range(48):
        state.pair(100.0 + 0.025 * step, 0.025 * step)
        moving = sim_state(-34.93 + 1e-5 * step, 138.6)
        state.receive(108, MAVLINK.MAVLink(None).decode(bytearray(sender(moving).content)), 0.025 * step)
    state.pair(101.2, 1.2)

    latest_s, positions = state.history.latest_boot_s, state.history.snapshot().positions
    assert latest_s == pytest.approx(101.175, rel=0, abs=1e-9)
    assert positions[-1, 0] == latest_s
    np.testing.assert_allclose(np.diff(positions[:-1, 0]), 0.2, rtol=0, atol=0.026)
    np.testing.assert_allclose(
        np.rad2deg(positions[:, 1]), -34.93 + 1e-5 * (positions[:, 0] - 100.0) / 0.025, rtol=0, atol=1e-5
    )


def test_invalid_states_are_dropped() -> None:
    state, sender = SimulatorState(600.0), Sender(1)
    for step, message in enumerate([sim_state(0.0, 0.0), sim_state(1.0, 1.0, q=(np.nan,) * 4), sim_state(95e7, 2e9)]):
        state.pair(100.0 + step, float(step))
        state.receive(108, MAVLINK.MAVLink(None).decode(bytearray(sender(message).content)), step + 0.5)
    state.pair(110.0, 10.0)

    assert len(state.history.snapshot().attitudes) == 2
    assert not state.history.has_position


def test_a_reboot_begins_the_truth_again() -> None:
    heard, plane = listening()
    for step in range(10):
        heard.receive(simstate(plane, 0.3), 0.1 * step)
        heard.receive(plane.angles(100.0 + 0.1 * step), 0.1 * step)
    heard.receive(plane.angles(2.0), 2.0)
    heard.receive(simstate(plane, 0.4), 2.01)
    heard.receive(plane.angles(2.02), 2.02)

    assert history_of(heard)[:, 0].tolist() == pytest.approx([2.01], rel=0, abs=1e-9)
