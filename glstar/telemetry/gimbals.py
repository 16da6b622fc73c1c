"""The attitude of a gimbal in MAVLink packets and PX4 topics.

Roll and pitch are those of the platform against the horizon.  The yaw is against north or against the heading of the
aircraft: the flags of GIMBAL_DEVICE_ATTITUDE_STATUS say which, in older senders by their yaw lock; MOUNT_ORIENTATION,
MOUNT_STATUS and mount_orientation have the latter.
"""

from collections.abc import Iterator
from typing import Final

import numpy as np
from numpy.typing import NDArray

from glstar.rotation import conjugate, quaternion_from_euler
from glstar.telemetry.samplevalidation import UNIT_TOLERANCE, quaternion_lengths, valid_times
from glstar.telemetry.source import GimbalSamples
from glstar.telemetry.tlogclock import VehicleClock
from glstar.telemetry.tlogfile import COMPONENT, FIELDS_FROM, STAMP, SYSTEM, Packets, Sender
from glstar.telemetry.ulogfile import Topics

__all__ = [
    "GIMBAL_MESSAGES",
    "GIMBAL_STATUS",
    "gimbal_of_packets",
    "gimbal_of_topics",
    "gimbal_samples",
    "yaw_is_earth",
]

Float = NDArray[np.float64]

GIMBAL_STATUS: Final = "GIMBAL_DEVICE_ATTITUDE_STATUS"
# The best one first: of several, only the first is used.
GIMBAL_MESSAGES: Final = (GIMBAL_STATUS, "MOUNT_ORIENTATION", "MOUNT_STATUS")
# Bits of GIMBAL_DEVICE_FLAGS.
_YAW_LOCK, _YAW_IN_VEHICLE_FRAME, _YAW_IN_EARTH_FRAME = 16, 32, 64


def yaw_is_earth(flags: Float) -> NDArray[np.bool_]:
    """Return whether the yaw of a gimbal is against north, by its flags.

    Parameters
    ----------
    flags : (n,) float64
        GIMBAL_DEVICE_FLAGS.

    Returns
    -------
    (n,) bool
        By YAW_IN_EARTH_FRAME or YAW_IN_VEHICLE_FRAME; with neither of them, by YAW_LOCK.
    """
    bits = flags.astype(np.int64)
    locked = (bits & _YAW_LOCK > 0) & (bits & _YAW_IN_VEHICLE_FRAME == 0)
    return np.asarray((bits & _YAW_IN_EARTH_FRAME > 0) | locked)


def gimbal_of_packets(packets: Packets, sender: Sender, clock: VehicleClock, boot: int) -> Iterator[GimbalSamples]:
    """Yield the attitude of the gimbal of a system in a boot, from the first message that has one.

    Parameters
    ----------
    packets : Packets
    sender : (int, int)
        The autopilot: the gimbal belongs to its system, and has a time since boot of its own unless the autopilot
        itself sends its attitude.
    clock : VehicleClock
    boot : int

    Yields
    ------
    GimbalSamples
    """
    if packets.timestamps_are_utc(sender):
        return
    for name in GIMBAL_MESSAGES:
        rows = packets.message(name)
        rows = rows[rows[:, SYSTEM] == sender[0]] if len(rows) else rows
        rows = rows[clock.boot_of(rows) == boot] if len(rows) else rows
        if not len(rows):
            continue
        component = sender[1] if np.any(rows[:, COMPONENT] == sender[1]) else rows[0, COMPONENT]
        rows = rows[rows[:, COMPONENT] == component]
        values = rows[:, FIELDS_FROM:] if name == "MOUNT_STATUS" else rows[:, FIELDS_FROM + 1 :]
        if name == "MOUNT_STATUS":
            clock_s = clock.on_arrival(rows)
        elif component == sender[1]:
            clock_s = clock.read(rows)[0]
        else:
            clock_s = _on_own_clock(rows, clock)
        samples = gimbal_samples(name, clock_s, values)
        if samples.clock_s.size > 1:
            yield GimbalSamples(samples.clock_s, samples.q_gimbal_reference, samples.is_earth, samples.source, boot)
            return


def _on_own_clock(rows: Float, clock: VehicleClock) -> Float:
    """Return the autopilot's clock at packets of a gimbal with a clock of its own, s.

    Packets arrive late and never early: the earliest arrival relates the two clocks.
    """
    own_s = rows[:, FIELDS_FROM] / 1e3
    related: Float = own_s + np.min(clock.on_arrival(rows) - own_s)
    assert related.shape == rows[:, STAMP].shape
    return related


def gimbal_samples(name: str, clock_s: Float, values: Float) -> GimbalSamples:
    """Return the attitudes in the fields of MAVLink messages of a gimbal; invalid ones are left out.

    Parameters
    ----------
    name : str
        One of `GIMBAL_MESSAGES`.
    clock_s : (n,) float64
        Times of the messages, s.
    values : (n, k) float64
        The flags and the quaternion from the platform to the frame of reference of GIMBAL_DEVICE_ATTITUDE_STATUS; roll,
        pitch and yaw of MOUNT_ORIENTATION, deg; or pitch, roll and yaw of MOUNT_STATUS, 0.01 deg.

    Returns
    -------
    GimbalSamples
    """
    return _status(clock_s, values, name) if name == GIMBAL_STATUS else _angles(clock_s, values, name)


def _status(clock_s: Float, values: Float, name: str) -> GimbalSamples:
    q = conjugate(values[:, 1:5])
    valid = (np.abs(quaternion_lengths(q) - 1) < UNIT_TOLERANCE) & valid_times(clock_s)
    return GimbalSamples(clock_s[valid], q[valid], yaw_is_earth(values[valid, 0]), name)


def _angles(clock_s: Float, values: Float, name: str) -> GimbalSamples:
    """Return samples from angles in deg, or in 0.01 deg as MOUNT_STATUS has them, pitch first."""
    if name == "MOUNT_STATUS":
        pitch, roll, yaw = np.deg2rad(values.T / 100)
    else:
        roll, pitch, yaw = np.deg2rad(values.T)
    valid = np.isfinite(values).all(axis=-1) & valid_times(clock_s)
    q = quaternion_from_euler(roll, pitch, yaw)[valid]
    return GimbalSamples(clock_s[valid], q, np.zeros(len(q), dtype=np.bool_), name)


def gimbal_of_topics(log: Topics) -> Iterator[GimbalSamples]:
    """Yield the attitude of the gimbal of a PX4 log, from the first topic that has one.

    Parameters
    ----------
    log : Topics

    Yields
    ------
    GimbalSamples
    """
    for _, topic in log["gimbal_device_attitude_status"]:
        names = ("device_flags", "q[0]", "q[1]", "q[2]", "q[3]")
        if set(names) <= set(topic):
            values = np.stack([topic[name] for name in names], axis=-1)
            samples = _status(topic["timestamp"] * 1e-6, values, "gimbal_device_attitude_status")
            if samples.clock_s.size > 1:
                yield samples
                return
    for _, topic in log["mount_orientation"]:
        axes = [f"attitude_euler_angle[{axis}]" for axis in range(3)]
        if set(axes) <= set(topic):
            values = np.rad2deg(np.stack([topic[axis] for axis in axes], axis=-1))
            samples = _angles(topic["timestamp"] * 1e-6, values, "mount_orientation")
            if samples.clock_s.size > 1:
                yield samples
                return
