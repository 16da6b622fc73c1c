"""A sender of MAVLink packets, and the receiver that takes them."""

from typing import Any

from glstar.link import Framer, Packet
from glstar.link.clock import BootClock
from glstar.link.packets import dialect
from glstar.link.receiver import Receiver

MAVLINK = dialect()


class Sender:
    """Creates packets of one system."""

    def __init__(self, system: int, component: int = 1) -> None:
        self.link = MAVLINK.MAVLink(None, srcSystem=system, srcComponent=component)
        self.framer = Framer()

    def __call__(self, message: Any) -> Packet:
        (packet,) = self.framer.feed(bytes(message.pack(self.link)))
        self.link.seq = (self.link.seq + 1) % 256
        return packet

    def heartbeat(self, autopilot: int = 3) -> Packet:
        return self(MAVLINK.MAVLink_heartbeat_message(1, autopilot, 0, 0, 4, 3))

    def angles(self, boot_s: float, yaw_rad: float = 0.0) -> Packet:
        return self(MAVLINK.MAVLink_attitude_message(round(boot_s * 1000), 0.1, 0.2, yaw_rad, 0, 0, 0))

    def quaternion(self, boot_s: float, *q: float) -> Packet:
        return self(MAVLINK.MAVLink_attitude_quaternion_message(round(boot_s * 1000), *q, 0, 0, 0))


def receiver(**options: Any) -> tuple[Receiver, list[str]]:
    reported: list[str] = []
    return Receiver(BootClock(start_utc_s=0.0), reported.append, **options), reported


UTC_S = 1_710_068_400.0


def system_time(sender: Sender, boot_s: float, utc_s: float) -> Packet:
    return sender(MAVLINK.MAVLink_system_time_message(round(utc_s * 1e6), round(boot_s * 1000)))


def flying() -> tuple[Receiver, list[str]]:
    """Return a receiver with a chosen autopilot and its UTC."""
    messages: list[str] = []
    return Receiver(BootClock(), messages.append), messages


def packets(count: int, *, sign: bool = False) -> list[bytes]:
    """Return packets of several messages, as an autopilot sends them."""
    mavlink = dialect()
    link = mavlink.MAVLink(None, srcSystem=7, srcComponent=1)
    if sign:
        link.signing.secret_key, link.signing.sign_outgoing = bytes(32), True
    made = []
    for number in range(count):
        messages: list[Any] = [
            mavlink.MAVLink_attitude_message(number, 0.1, 0.2, 3.0, 0.0, 0.0, 0.0),
            mavlink.MAVLink_heartbeat_message(1, 3, 0, 0, 4, 3),
            mavlink.MAVLink_statustext_message(6, b"\xfd\xfe a text with what begins packets \xfd\x09", 0, 0),
        ]
        made.append(bytes(messages[number % 3].pack(link)))
        link.seq = (link.seq + 1) % 256
    return made
