"""The MAVLink messages of a link, and how often they can be had."""

from typing import Any, Final

from glstar.link.endpoint import Endpoint
from glstar.telemetry.suppressedoutput import quiet

__all__ = [
    "ATTITUDE",
    "ATTITUDE_QUATERNION",
    "GPS",
    "HEARTBEAT",
    "HIL_STATE",
    "POSITION",
    "SYSTEM_TIME",
    "carried_rate_hz",
    "dialect",
]

HEARTBEAT, SYSTEM_TIME, GPS, ATTITUDE, ATTITUDE_QUATERNION, POSITION, COMMAND_ACK = 0, 2, 24, 30, 31, 33, 77
# HIL_STATE_QUATERNION: a simulator's own attitude and position.
HIL_STATE: Final = 115

# An attitude is so long, and all else that is asked for takes so much.
_ATTITUDE_BYTES: Final = 56
_OTHERS_BYTES_PER_S: Final = 270.0
# Of what the port could carry: a radio has other things to say, and half of the air is for the way back.
_SHARE: Final = 0.55
_RATES_HZ: Final = (100.0, 50.0, 40.0, 25.0, 20.0, 10.0, 5.0, 4.0, 2.0, 1.0)


def carried_rate_hz(endpoint: Endpoint) -> float:
    """Return how often a link can carry an attitude.

    Parameters
    ----------
    endpoint : Endpoint

    Returns
    -------
    float
        Hz: 100 where the link is no radio, 50 at 57600 baud, 1 at the least.
    """
    room = endpoint.bytes_per_s
    if room is None:
        return _RATES_HZ[0]
    fits_hz = (_SHARE * room - _OTHERS_BYTES_PER_S) / _ATTITUDE_BYTES
    return next((rate_hz for rate_hz in _RATES_HZ if rate_hz <= fits_hz), _RATES_HZ[-1])


def dialect() -> Any:
    """Return pymavlink's tables of all dialects, imported on first use: a module."""
    with quiet():
        from pymavlink.dialects.v20 import all as every  # noqa: PLC0415 - when a link is opened
    return every
