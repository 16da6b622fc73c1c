"""A flight: attitude and position over UTC, interpolated between the samples of a log.

::

    flight.attitude.at(utc_s)       quaternions NED to body, by slerp, cubic spline or gyro rates
    flight.attitude.gaps            data gaps, and resets of the estimator: no interpolation there
    flight.position.at(utc_s)       a `Site`

====================  ==================================================================================================
module                holds
====================  ==================================================================================================
``attitude``          `AttitudeTrack`, its gaps, and resets of the estimator: turns that the aircraft did not make
``flight``            `Flight`: attitude, `PositionTrack`, where they come from; `FlightEvents`: modes and messages
``spline``            `RotationSpline`: a curve through attitudes with continuous rate and angular acceleration
``gyroaided``         `gyro_aided`: attitude between samples from integrated gyro rates, and the lag of the gyros
``gimbal``            `Gimbal`: the attitude of the platform that carries the camera
``navigator``         `EstimatedAttitude`: the attitude that the aircraft estimates, with the errors of an AHRS
``synthetic``         flights without a log: paths, gusts
====================  ==================================================================================================
"""

from glstar.flight.attitude import DATA_GAP, JUMP, AttitudeTrack, Gap, Interpolation, mean_rate_hz
from glstar.flight.flight import (
    ONLY_CAMERA,
    CameraTriggers,
    ClockQuality,
    EventKind,
    Flight,
    FlightEvents,
    GimbalAttitude,
    Pose,
    PositionTrack,
)

__all__ = [
    "DATA_GAP",
    "JUMP",
    "ONLY_CAMERA",
    "AttitudeTrack",
    "CameraTriggers",
    "ClockQuality",
    "EventKind",
    "Flight",
    "FlightEvents",
    "Gap",
    "GimbalAttitude",
    "Interpolation",
    "Pose",
    "PositionTrack",
    "mean_rate_hz",
]
