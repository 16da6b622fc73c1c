"""The attitude of a gimbal on a link, from single packets with known arrival times, against SciPy's rotations."""

from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from glstar.flight import Flight
from glstar.flight.gimbal import Gimbal
from glstar.link.clock import BootClock
from glstar.link.receiver import Receiver
from tests.support.sender import MAVLINK, Sender

# The platform keeps this roll and pitch while its yaw against the heading grows.
ROLL_DEG, PITCH_DEG, YAW_DEG, RATE_DEG_PER_S = 1.5, 35.0, -25.0, 40.0
EARTH, VEHICLE = 64, 32
HEADING_RAD = 0.7
# The clock of the gimbal is this far from that of the autopilot.
OWN_S = 50.0


def platform(boot_s: float, *, heading_deg: float = 0.0) -> Rotation:
    """Return the rotation from the platform to its frame of reference."""
    yaw_deg = YAW_DEG + RATE_DEG_PER_S * (boot_s - 100.0) + heading_deg
    return Rotation.from_euler("ZYX", [yaw_deg, PITCH_DEG, ROLL_DEG], degrees=True)


def status(sender: Sender, boot_s: float, *, flags: int = VEHICLE, own_s: float = 0.0) -> Any:
    x, y, z, w = platform(boot_s, heading_deg=np.rad2deg(HEADING_RAD) if flags == EARTH else 0.0).as_quat()
    boot_ms = round((boot_s + own_s) * 1e3)
    return sender(MAVLINK.MAVLink_gimbal_device_attitude_status_message(0, 0, boot_ms, flags, [w, x, y, z], 0, 0, 0, 0))


def orientation(sender: Sender, boot_s: float) -> Any:
    yaw_deg = YAW_DEG + RATE_DEG_PER_S * (boot_s - 100.0)
    return sender(MAVLINK.MAVLink_mount_orientation_message(round(boot_s * 1e3), ROLL_DEG, PITCH_DEG, yaw_deg))


def mount(sender: Sender, boot_s: float) -> Any:
    yaw_deg = YAW_DEG + RATE_DEG_PER_S * (boot_s - 100.0)
    return sender(
        MAVLINK.MAVLink_mount_status_message(255, 190, *(round(100 * one) for one in (PITCH_DEG, ROLL_DEG, yaw_deg)))
    )


def listening() -> tuple[Receiver, Sender]:
    heard, plane = Receiver(BootClock(start_utc_s=0.0), lambda _: None), Sender(1)
    heard.receive(plane.heartbeat(), 0.0)
    return heard, plane


def error_deg(heard: Receiver) -> float:
    """Return the largest error of the platform's attitude at its samples."""
    flight = heard.history.snapshot().flight(0.0, name="", attitude_source="", position_source="", utc_source="")
    samples = heard.gimbal.samples(0.0)
    assert flight is not None
    assert samples is not None
    shown = Gimbal("log").carried(Flight(flight.attitude, flight.position, gimbal=samples.over_utc(0.0))).attitude
    angles = []
    for utc_s, (w, x, y, z) in zip(shown.utc_s, shown.q_body_ned, strict=True):
        to_ned = Rotation.from_euler("Z", HEADING_RAD) * platform(utc_s)
        angles.append((Rotation.from_quat([x, y, z, w]) * to_ned).magnitude())
    return float(np.rad2deg(np.max(angles)))


@pytest.mark.parametrize("kind", ["vehicle", "earth", "orientation", "mount", "own clock"])
def test_the_platform_has_the_attitude_that_the_gimbal_states(kind: str) -> None:
    heard, plane = listening()
    camera = Sender(1, 154)
    place = MAVLINK.MAVLink_global_position_int_message(100_000, -349300000, 1386000000, 48000, 0, 0, 0, 0, 0)
    heard.receive(plane(place), 5.0)
    for step in range(100):
        boot_s, arrival_s = 100.0 + 0.02 * step, 5.0 + 0.02 * step
        heard.receive(plane.angles(boot_s, HEADING_RAD), arrival_s)
        match kind:
            case "vehicle" | "earth":
                packet = status(plane, boot_s, flags=EARTH if kind == "earth" else VEHICLE)
            case "orientation":
                packet = orientation(plane, boot_s)
            case "mount":
                packet = mount(plane, boot_s)
            case _:
                packet = status(camera, boot_s, own_s=OWN_S)
        # Every third packet of a clock of its own is late.
        heard.receive(packet, arrival_s + (0.004 * (step % 3) if kind == "own clock" else 0.0))

    # MOUNT_STATUS is rounded to 0.01 deg; the attitudes are float32.
    assert error_deg(heard) < (0.02 if kind == "mount" else 1e-4)
    assert heard.gimbal.latest_boot_s == pytest.approx(101.96 if kind != "mount" else 101.98, rel=0, abs=0.021)


def test_an_attitude_later_than_the_aircrafts_waits_for_it() -> None:
    heard, plane = listening()
    heard.receive(plane.angles(100.00), 5.000)
    heard.receive(status(plane, 100.03), 5.010)
    heard.receive(plane.angles(100.02), 5.020)
    assert heard.gimbal.latest_boot_s is None
    heard.receive(plane.angles(100.04), 5.040)

    assert heard.gimbal.latest_boot_s == pytest.approx(100.03, rel=0, abs=1e-9)
    assert heard.gimbal.arrival_s == 5.040


def test_the_best_message_is_used_until_it_falls_silent() -> None:
    heard, plane = listening()
    camera, other = Sender(1, 154), Sender(2, 154)
    for step in range(30):
        boot_s, arrival_s = 100.0 + 0.1 * step, 5.0 + 0.1 * step
        heard.receive(orientation(plane, boot_s), arrival_s)
        heard.receive(status(other, boot_s), arrival_s)
        if step < 5:
            heard.receive(status(camera, boot_s, own_s=OWN_S), arrival_s)
        heard.receive(plane.angles(boot_s + 0.01), arrival_s + 0.01)
        if step == 20:
            assert heard.gimbal.source == "GIMBAL_DEVICE_ATTITUDE_STATUS"
    samples = heard.gimbal.samples(0.0)
    assert samples is not None
    assert samples.source == "MOUNT_ORIENTATION"
    # Nothing of the 2 s before, and nothing of another system.
    assert np.diff(samples.clock_s).max() == pytest.approx(2.0, rel=0, abs=0.11)


def test_attitudes_before_a_reboot_are_kept_at_their_utc() -> None:
    heard, plane = listening()
    for step in range(20):
        heard.receive(plane.angles(100.0 + 0.1 * step), 5.0 + 0.1 * step)
        heard.receive(status(plane, 100.0 + 0.1 * step), 5.0 + 0.1 * step)
    utc_minus_boot_s = heard.clock.utc_minus_boot_s
    assert utc_minus_boot_s is not None
    for step in range(20):
        heard.receive(plane.angles(2.0 + 0.1 * step), 12.0 + 0.1 * step)
        heard.receive(status(plane, 2.0 + 0.1 * step), 12.0 + 0.1 * step)
    assert heard.clock.boot == 1
    assert heard.clock.utc_minus_boot_s is not None
    samples = heard.gimbal.samples(heard.clock.utc_minus_boot_s)
    assert samples is not None
    expected = np.concatenate([0.1 * np.arange(19), 7.0 + 0.1 * np.arange(19)])
    assert samples.clock_s == pytest.approx(expected, rel=0, abs=0.001)
