"""Position fixes that are sent to an autopilot, only if the user enables it.

A fix is sent as MAV_CMD_EXTERNAL_POSITION_ESTIMATE (43003) in a COMMAND_INT: latitude and longitude, the time since
the instant that it is for, and its standard deviation.  The autopilot subtracts this delay from the time of arrival.
"""

from collections import deque
from dataclasses import dataclass
from ipaddress import ip_address
from math import nan
from typing import Final

import numpy as np

from glstar.errors import ConfigError
from glstar.link.endpoint import Endpoint
from glstar.link.messages import EXTERNAL_POSITION_ESTIMATE, dialect
from glstar.link.receiver import Receiver

__all__ = ["Injector", "PositionFix"]

# System of ground stations, and component MAV_COMP_ID_ONBOARD_COMPUTER, as for requests.
_SYSTEM, _COMPONENT = 255, 191
# The sender's time wraps around, s: float32 has a resolution of 0.24 ms below it.
_WRAP_S: Final = 3600.0


@dataclass(frozen=True, slots=True)
class PositionFix:
    """A position that a navigator found.

    Attributes
    ----------
    latitude_rad, longitude_rad : float
        WGS84.
    utc_s : float
        When the aircraft was there, UTC seconds since 1970.
    sigma_m : float or None
        Standard deviation of each horizontal component, m; None if unknown.
    """

    latitude_rad: float
    longitude_rad: float
    utc_s: float
    sigma_m: float | None = None


class Injector:
    """A queue of position fixes for the autopilot of a link.

    Parameters
    ----------
    endpoint : Endpoint
        The link.
    host : str, optional
        Its host or serial port, named once more if it is not this computer.

    Attributes
    ----------
    sent : int
        Number of fixes sent.

    Raises
    ------
    ConfigError
        If the link leaves this computer and its host is not named, or another one is.
    """

    def __init__(self, endpoint: Endpoint, host: str | None = None) -> None:
        other = endpoint.device if endpoint.kind == "serial" else endpoint.host
        if host is None and not (endpoint.kind != "serial" and _is_loopback(endpoint.host)):
            raise ConfigError(
                f"positions would be sent over {endpoint.text}, which leaves this computer; if the vehicle there may"
                f" follow them, say so with --inject-host {other}"
            )
        if host is not None and host != other:
            raise ConfigError(f"--inject-host {host} is not the host of {endpoint.text}, which is {other}")
        self.sent = 0
        self._fixes: deque[PositionFix] = deque()
        self._mavlink = dialect()
        self._link = self._mavlink.MAVLink(None, srcSystem=_SYSTEM, srcComponent=_COMPONENT)

    def add(self, fix: PositionFix) -> None:
        """Send a fix as soon as the autopilot and UTC are known; may be called from any thread.

        Parameters
        ----------
        fix : PositionFix
        """
        self._fixes.append(fix)

    def due(self, receiver: Receiver, now_s: float) -> list[bytes]:
        """Return the packets to be sent now.

        Parameters
        ----------
        receiver : Receiver
        now_s : float
            Time by `time.monotonic`, s.

        Returns
        -------
        list of bytes
        """
        utc_minus_host_s = receiver.clock.utc_minus_host_s
        if receiver.chosen is None or utc_minus_host_s is None:
            return []
        packets = []
        while self._fixes:
            fix = self._fixes.popleft()
            delay_s = max(now_s + utc_minus_host_s - fix.utc_s, 0.0)
            packets.append(self._packed(fix, receiver.chosen, now_s, delay_s))
        self.sent += len(packets)
        return packets

    def _packed(self, fix: PositionFix, target: tuple[int, int], now_s: float, delay_s: float) -> bytes:
        degrees = (round(float(np.rad2deg(angle)) * 1e7) for angle in (fix.latitude_rad, fix.longitude_rad))
        message = self._mavlink.MAVLink_command_int_message(
            *target,
            self._mavlink.MAV_FRAME_GLOBAL,
            EXTERNAL_POSITION_ESTIMATE,
            0,
            0,
            now_s % _WRAP_S,
            delay_s,
            nan if fix.sigma_m is None else fix.sigma_m,
            0.0,
            *degrees,
            nan,
        )
        packed = bytes(message.pack(self._link))
        self._link.seq = (self._link.seq + 1) % 256
        return packed


def _is_loopback(host: str) -> bool:
    """Return whether a host is this computer."""
    try:
        return ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"
