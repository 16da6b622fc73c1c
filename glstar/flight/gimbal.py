"""Gimbals: the attitude of the platform that carries the camera, from the aircraft's attitude or from a log."""

from dataclasses import dataclass, replace
from math import inf
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from glstar.arrays import Float
from glstar.errors import TelemetryError
from glstar.flight.attitude import AttitudeTrack, Interpolation
from glstar.flight.flight import Flight, GimbalAttitude
from glstar.rotation import euler_from_quaternion, multiply, quaternion_from_euler

GimbalMode = Literal["none", "level", "log"]

_LACKS = (
    "has no attitude of a gimbal: no GIMBAL_DEVICE_ATTITUDE_STATUS, MOUNT_ORIENTATION or MOUNT_STATUS, no MNT and no"
    ' topic gimbal_device_attitude_status or mount_orientation; take [mount] gimbal = "level" or "none"'
)


@dataclass(frozen=True, slots=True)
class Gimbal:
    """What carries the camera: the aircraft itself, or a platform that a gimbal turns."""

    # ``"level"``: a platform that stays level and follows the heading; ``"log"``: as the flight recorded it.
    mode: GimbalMode = "none"
    roll_limit_rad: float = inf  # Largest roll and pitch of the aircraft that a level platform compensates, rad
    pitch_limit_rad: float = inf
    lag_s: float = 0.0  # Time constant with which a level platform compensates roll and pitch, s
    heading_lag_s: float = 0.0  # Time constant with which a level platform follows the heading, s

    def carried(self, flight: Flight) -> Flight:
        """Return a flight, also one that a gimbal has returned, with the attitude of the platform of the camera.

        Its `aircraft_attitude` stays the aircraft's.  Raises TelemetryError if the gimbal's attitude is not
        recorded.
        """
        own = flight.aircraft_attitude
        if self.mode == "none":
            return flight if flight.own_attitude is None else replace(flight, attitude=own, own_attitude=None)
        if self.mode == "level":
            return replace(flight, attitude=self._levelled(own), own_attitude=own)
        if flight.gimbal is None:
            raise TelemetryError(f"{flight.name} {_LACKS}")
        return replace(flight, attitude=_recorded(flight.gimbal, own, flight.name), own_attitude=own)

    def _levelled(self, own: AttitudeTrack) -> AttitudeTrack:
        """Return the attitude of a level platform at the samples of the aircraft's attitude.

        Its roll and pitch are the aircraft's minus what the joints compensate; the joints follow with a
        first-order lag, exactly for angles that are linear between samples, and begin again after each gap.
        """
        roll, pitch, heading = euler_from_quaternion(own.q_body_ned)
        joint_roll = np.clip(roll, -self.roll_limit_rad, self.roll_limit_rad)
        joint_pitch = np.clip(pitch, -self.pitch_limit_rad, self.pitch_limit_rad)
        first = np.zeros(own.utc_s.size, dtype=np.bool_)
        first[0] = True
        first[np.searchsorted(own.utc_s, [gap.stop_utc_s for gap in own.gaps]).clip(max=first.size - 1)] = True
        platform = quaternion_from_euler(
            roll - lagged(own.utc_s, joint_roll, first, self.lag_s),
            pitch - lagged(own.utc_s, joint_pitch, first, self.lag_s),
            lagged(own.utc_s, np.unwrap(heading), first, self.heading_lag_s),
        )
        # The gyros measure the aircraft's rates, not the platform's; their samples are dense enough for a spline.
        interpolation = "spline" if own.interpolation == "gyro" else own.interpolation
        return AttitudeTrack(own.utc_s, platform, own.gaps, interpolation)


NO_GIMBAL = Gimbal()


def lagged(t_s: Float, value: Float, first: NDArray[np.bool_], lag_s: float) -> Float:
    """Return the response, (n,), of a first-order lag to a value, (n,), that is linear between samples.

    `t_s` (n,): increasing times, s; `first` (n,) bool: samples at which the response begins at the value itself;
    `lag_s`: time constant T, s; 0 returns the value.  T y' + y = x with x = x0 + r t has y = x0 + r (t - T) + (y0 - x0
    + r T) exp(-t/T).
    """
    if lag_s <= 0:
        return value
    step_s = np.diff(t_s)
    rate = np.diff(value) / step_s
    keep = np.exp(-step_s / lag_s)
    drive = value[1:] - rate * lag_s - keep * (value[:-1] - rate * lag_s)
    response = np.empty_like(value)
    current = float(value[0])
    for k, begins in enumerate(first.tolist()):
        current = float(value[k]) if begins else float(keep[k - 1]) * current + float(drive[k - 1])
        response[k] = current
    return response


def _recorded(gimbal: GimbalAttitude, own: AttitudeTrack, name: str) -> AttitudeTrack:
    """Return the attitude of a recorded platform, NED to platform."""
    inside = (gimbal.utc_s >= own.first_s) & (gimbal.utc_s <= own.last_s)
    for gap in own.gaps:
        inside &= (gimbal.utc_s <= gap.start_utc_s) | (gimbal.utc_s >= gap.stop_utc_s)
    if np.count_nonzero(inside) < 2:
        raise TelemetryError(
            f"{name}: fewer than two samples of {gimbal.source} lie within the attitude of the aircraft;"
            ' take [mount] gimbal = "level" or "none"'
        )
    utc_s, q_gimbal_reference = gimbal.utc_s[inside], gimbal.q_gimbal_reference[inside]
    _, _, heading = euler_from_quaternion(own.at(utc_s))
    heading = np.where(gimbal.is_earth[inside], 0.0, heading)
    q_reference_ned = quaternion_from_euler(np.zeros_like(heading), np.zeros_like(heading), heading)
    # The heading is not known within a gap of the aircraft's attitude.
    segment = np.searchsorted([gap.stop_utc_s for gap in own.gaps], utc_s, side="right")
    interpolation: Interpolation = "slerp" if own.interpolation == "slerp" else "spline"
    return AttitudeTrack.from_samples(
        utc_s,
        multiply(q_gimbal_reference, q_reference_ned),
        segment=segment,
        break_reason="a gap in the aircraft's attitude",
        interpolation=interpolation,
    )
