"""The status of a telemetry link, its events and its latest attitude."""

from dataclasses import dataclass
from typing import Final

from glstar.link.endpoint import Endpoint
from glstar.link.messages import GIMBAL_NAMES
from glstar.link.simulatorstate import SIMULATOR_NAMES

__all__ = ["GIMBAL_LACK", "LatestAttitude", "LinkEvent", "LinkStatus", "no_packets_message"]

# More bytes without a packet are not MAVLink at this baud rate.
_NOISE_BYTES: Final = 300
GIMBAL_LACK: Final = f'no {GIMBAL_NAMES} now ([mount] gimbal = "level" or "none" needs none)'


@dataclass(frozen=True, slots=True)
class LinkEvent:
    """An event on a link.

    Attributes
    ----------
    number : int
        Running number of the event.
    utc_s : float
        Time by the computer's clock, UTC seconds since 1970.
    message : str
    """

    number: int
    utc_s: float
    message: str


@dataclass(frozen=True, slots=True)
class LinkStatus:
    """The status of a link.

    Attributes
    ----------
    endpoint : str
        As the user named it.
    state : {"opening", "waiting", "live", "timeout", "closed"}
        ``waiting``: open, without packets yet; ``timeout``: no packets for two seconds, after some had arrived.
    problem : str or None
        What is wrong, for the user.
    vehicle : str or None
        Kind of vehicle.
    sysid : int or None
        Its MAVLink system.
    systems : tuple of int
        MAVLink systems of all autopilots on the link.
    rate_hz : float
        Rate of the attitude over the last two seconds, Hz.
    age_s : float or None
        Time since the arrival of the latest attitude, s.
    packets, lost, bad_bytes : int
        Number of packets received and lost, and of bytes that belong to no packet.
    utc_source : str or None
        Where UTC comes from; None if it is unknown.
    position_source : str or None
        Where the position comes from; None if it is unknown.
    recorded_bytes : int
        Size of the recording, bytes.
    lacks_simulator : bool
        Whether the sky is drawn from a simulator's own state, and none was received.
    lacks_gimbal : bool
        Whether the camera is on a gimbal whose attitude is not received, or not any more.
    """

    endpoint: str
    state: str
    problem: str | None
    vehicle: str | None
    sysid: int | None
    systems: tuple[int, ...]
    rate_hz: float
    age_s: float | None
    packets: int
    lost: int
    bad_bytes: int
    utc_source: str | None
    position_source: str | None
    recorded_bytes: int
    lacks_simulator: bool = False
    lacks_gimbal: bool = False

    @property
    def missing(self) -> tuple[str, ...]:
        """What is missing for a flight, and how to provide it."""
        missing = []
        if self.age_s is None:
            missing.append("no attitude yet")
        if self.lacks_simulator:
            missing.append(f"no {SIMULATOR_NAMES} yet (--truth estimator needs none)")
        if self.lacks_gimbal:
            missing.append(GIMBAL_LACK)
        if self.utc_source is None:
            missing.append("no UTC yet (--utc-now takes the computer's clock)")
        if self.position_source is None:
            missing.append("no position yet (--lat, --lon)")
        return tuple(missing)


@dataclass(frozen=True, slots=True)
class LatestAttitude:
    """Times of the latest attitude of a link.

    Attributes
    ----------
    utc_s : float
        Its time, UTC seconds since 1970.
    arrival_s : float
        Its arrival by `time.monotonic`, s.
    utc_minus_boot_s : float
        UTC minus the autopilot's time since boot, s; it changes if UTC is set, or after a reboot.
    boot : int
        Number of the boot, from 0.
    utc_minus_host_s : float
        UTC minus `time.monotonic`, s, without the delays of the link.
    """

    utc_s: float
    arrival_s: float
    utc_minus_boot_s: float
    boot: int = 0
    utc_minus_host_s: float = 0.0

    def utc_step_s(self, before: "LatestAttitude") -> float:
        """Return by how much UTC was changed since an earlier attitude, s; a reboot by itself does not change it.

        Parameters
        ----------
        before : LatestAttitude

        Returns
        -------
        float
        """
        if self.boot == before.boot:
            return self.utc_minus_boot_s - before.utc_minus_boot_s
        return self.utc_minus_host_s - before.utc_minus_host_s


def no_packets_message(endpoint: Endpoint, waited_s: float, noise_bytes: int) -> str:
    """Return what to check if no packets arrive.

    Parameters
    ----------
    endpoint : Endpoint
    waited_s : float
        Time since the last packet, s.
    noise_bytes : int
        Number of bytes received since then.

    Returns
    -------
    str
    """
    if noise_bytes > _NOISE_BYTES:
        if endpoint.kind == "serial":
            return (
                f"{noise_bytes} bytes and no packet at {endpoint.baud} baud: a wrong baud rate?"
                f" Radios are set to 57600, autopilots to 57600 or 115200 ({endpoint.device},115200)"
            )
        return f"{noise_bytes} bytes and no packet among them: is the sender using MAVLink?"
    advice = {
        "serial": "is the vehicle on, and the port and its baud rate the right ones?",
        "udpin": f"is something else listening on UDP port {endpoint.port}, or sending elsewhere?"
        f" QGroundControl and MAVProxy forward a copy: mavproxy.py --out 127.0.0.1:{endpoint.port}",
        "udpout": f"does a program listen on UDP port {endpoint.port} there?",
        "tcp": "is the vehicle on?",
        "tcpin": "has no program connected?",
    }
    return f"no packets on {endpoint.text} for {int(waited_s)} s; {advice[endpoint.kind]}"
