"""The status of a telemetry link, its events, its latest attitude, and the quality of its packets."""

from dataclasses import dataclass
from typing import Literal

from glstar.link.endpoint import Endpoint
from glstar.link.history import SIMULATOR_NAMES
from glstar.link.packets import GIMBAL_NAMES

# More bytes without a packet are not MAVLink at this baud rate.
_NOISE_BYTES = 300
GIMBAL_LACK = f'no {GIMBAL_NAMES} now ([mount] gimbal = "level" or "none" needs none)'


LinkState = Literal["opening", "waiting", "live", "timeout", "closed"]


@dataclass(frozen=True, slots=True)
class LinkEvent:
    """An event on a link."""

    number: int  # Running number of the event
    utc_s: float  # Time by the computer's clock, UTC seconds since 1970
    message: str


@dataclass(frozen=True, slots=True)
class LinkStatus:
    """The status of a link."""

    endpoint: str  # As the user named it
    # ``waiting``: open, without packets yet; ``timeout``: no packets for two seconds, after some had arrived.
    state: LinkState
    problem: str | None  # The fault, for the user
    vehicle: str | None  # Kind of vehicle
    sysid: int | None  # Its MAVLink system
    systems: tuple[int, ...]  # MAVLink systems of all autopilots on the link
    rate_hz: float  # Rate of the attitude over the last two seconds, Hz
    age_s: float | None  # Time since the arrival of the latest attitude, s
    packets: int  # Number of packets received and lost, and of bytes that belong to no packet
    lost: int
    bad_bytes: int
    utc_source: str | None  # Where UTC comes from; None if it is unknown
    position_source: str | None  # Where the position comes from; None if it is unknown
    recorded_bytes: int  # Size of the recording, bytes
    lacks_simulator: bool = False  # Whether the sky is drawn from a simulator's own state, and none was received
    lacks_gimbal: bool = False  # Whether the camera is on a gimbal whose attitude is not received, or not any more

    @property
    def missing(self) -> tuple[str, ...]:
        """The data that a flight lacks, and how to provide each."""
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
    """Times of the latest attitude of a link."""

    utc_s: float  # Its time, UTC seconds since 1970
    arrival_s: float  # Its arrival by `time.monotonic`, s
    utc_minus_boot_s: float  # UTC minus the autopilot's time since boot, s; it changes if UTC is set, or after a reboot
    boot: int = 0  # Number of the boot, from 0
    utc_minus_host_s: float = 0.0  # UTC minus `time.monotonic`, s, without the delays of the link

    @property
    def boot_s(self) -> float:
        """Its time since boot, s."""
        return self.utc_s - self.utc_minus_boot_s

    def utc_step_s(self, before: "LatestAttitude") -> float:
        """Return by how much UTC was changed since an earlier attitude, s; a reboot by itself does not change it."""
        if self.boot == before.boot:
            return self.utc_minus_boot_s - before.utc_minus_boot_s
        return self.utc_minus_host_s - before.utc_minus_host_s


def no_packets_message(endpoint: Endpoint, waited_s: float, noise_bytes: int) -> str:
    """Return what to check if no packets arrive, and a number of other bytes, for a time, s."""
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


# Interval between evaluations of the counters, s.
_WINDOW_S = 2.0
# No autopilot sends more packets per second on request.
_FLOOD_HZ = 2000.0
# A larger fraction of bad bytes, or of lost packets, is reported; the report is withdrawn below half of it.
_REPORTED_FRACTION = 0.02


class Quality:
    """Reports damaged, lost and excessive packets of a link: each problem once, and once that it has ended."""

    def __init__(self) -> None:
        self._since_s: float | None = None
        self._before = (0, 0, 0, 0, 0)
        self._problems: set[str] = set()

    def update(self, now_s: float, *, packets: int, counted: int, lost: int, bytes_: int, bad_bytes: int) -> list[str]:
        """Return messages to report, by totals since the link was opened; `now_s`: time by `time.monotonic`, s.

        `counted`: packets of the autopilot, to which `lost` belongs.
        """
        counts = packets, counted, lost, bytes_, bad_bytes
        if self._since_s is None:
            self._since_s = now_s
            self._before = counts
        passed_s = now_s - self._since_s
        if passed_s < _WINDOW_S:
            return []
        received, sequenced, missed, total, bad = (
            now - before for now, before in zip(counts, self._before, strict=True)
        )
        self._since_s = now_s
        self._before = counts
        packets_hz = received / passed_s
        bad_fraction = bad / max(total, 1)
        lost_fraction = missed / max(sequenced + missed, 1)
        damage = f"damage: {bad_fraction:.0%} of the bytes belong to no packet"
        loss = f"loss: {lost_fraction:.0%} of the packets do not arrive"
        return [
            *self._change("flood", packets_hz / _FLOOD_HZ, f"{packets_hz:.0f} packets a second: a flood"),
            *self._change("damage", bad_fraction / _REPORTED_FRACTION, damage),
            *self._change("loss", lost_fraction / _REPORTED_FRACTION, loss),
        ]

    def _change(self, problem: str, severity: float, message: str) -> list[str]:
        """Return the message if a problem begins (severity above 1), or that it has ended (below 1/2)."""
        if severity > 1 and problem not in self._problems:
            self._problems.add(problem)
            return [message]
        if severity < 0.5 and problem in self._problems:
            self._problems.remove(problem)
            return [f"no {problem} any more"]
        return []
