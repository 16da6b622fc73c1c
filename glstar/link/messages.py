"""The MAVLink messages of a link, and the rate of attitude that it can carry."""

from typing import Any, Final

from glstar.link.endpoint import Endpoint
from glstar.telemetry.gimbals import GIMBAL_MESSAGES
from glstar.telemetry.suppressedoutput import suppressed_output

__all__ = [
    "ATTITUDE",
    "ATTITUDE_QUATERNION",
    "EXTERNAL_POSITION_ESTIMATE",
    "GIMBAL_DEVICE_STATUS",
    "GIMBAL_NAMES",
    "GIMBAL_NUMBERS",
    "GPS",
    "HEARTBEAT",
    "HIL_STATE",
    "MOUNT_ORIENTATION",
    "MOUNT_STATUS",
    "POSITION",
    "SIMSTATE",
    "SIM_STATE",
    "SYSTEM_TIME",
    "carried_rate_hz",
    "dialect",
]

HEARTBEAT, SYSTEM_TIME, GPS, ATTITUDE, ATTITUDE_QUATERNION, POSITION, COMMAND_ACK = 0, 2, 24, 30, 31, 33, 77
# HIL_STATE_QUATERNION: attitude and position of a simulator.
HIL_STATE: Final = 115
# SIM_STATE and SIMSTATE: the same in ArduPilot, without a time.
SIM_STATE, SIMSTATE = 108, 164
# GIMBAL_DEVICE_ATTITUDE_STATUS, and what older autopilots send.
GIMBAL_DEVICE_STATUS, MOUNT_ORIENTATION, MOUNT_STATUS = 285, 265, 158
GIMBAL_NUMBERS: Final = dict(zip((GIMBAL_DEVICE_STATUS, MOUNT_ORIENTATION, MOUNT_STATUS), GIMBAL_MESSAGES, strict=True))
GIMBAL_NAMES: Final = " or ".join(", ".join(GIMBAL_MESSAGES).rsplit(", ", 1))
# MAV_CMD_EXTERNAL_POSITION_ESTIMATE.
EXTERNAL_POSITION_ESTIMATE: Final = 43003

# Size of a packet with attitude, bytes, and the rate of all other requested messages, bytes/s.
_ATTITUDE_BYTES: Final = 56
_OTHERS_BYTES_PER_S: Final = 270.0
# Usable fraction of the baud rate: a radio also carries other messages, and the opposite direction.
_USABLE_FRACTION: Final = 0.55
_RATES_HZ: Final = (100.0, 50.0, 40.0, 25.0, 20.0, 10.0, 5.0, 4.0, 2.0, 1.0)


def carried_rate_hz(endpoint: Endpoint) -> float:
    """Return the highest rate of attitude that a link can carry.

    Parameters
    ----------
    endpoint : Endpoint

    Returns
    -------
    float
        Hz: 100 if the link is no serial radio, 50 at 57600 baud, at least 1.
    """
    capacity = endpoint.bytes_per_s
    if capacity is None:
        return _RATES_HZ[0]
    fits_hz = (_USABLE_FRACTION * capacity - _OTHERS_BYTES_PER_S) / _ATTITUDE_BYTES
    return next((rate_hz for rate_hz in _RATES_HZ if rate_hz <= fits_hz), _RATES_HZ[-1])


def dialect() -> Any:
    """Return pymavlink's module of all dialects, imported on first use."""
    with suppressed_output():
        from pymavlink.dialects.v20 import all as every  # noqa: PLC0415 - when a link is opened
    return every
