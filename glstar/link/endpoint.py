"""Connection strings of telemetry links.

==============================================  =======================================================================
string                                          meaning
==============================================  =======================================================================
``/dev/ttyUSB0``, ``/dev/ttyUSB0,57600``        a serial port, with its baud rate
``/dev/serial/by-id/...``, ``COM14,57600``      the same
``serial:///dev/ttyUSB0:57600``                 the same
``udpin:127.0.0.1:14550``, ``udp:14550``        listen for UDP on an address of this computer
``udpout:192.168.1.7:14550``                    send to a UDP listener, which then replies
``tcp:127.0.0.1:5760``                          connect to a TCP listener
``tcpin:127.0.0.1:5760``                        listen for TCP on an address of this computer
``udp://...``, ``tcp://...``                    the same with slashes
==============================================  =======================================================================

Without an address, glstar listens on 127.0.0.1, to which no other computer can send; ``udpin:0.0.0.0:14550`` listens on
all interfaces.
"""

import re
from dataclasses import dataclass
from ipaddress import ip_address
from typing import Literal, Self

from glstar.errors import ConfigError
from glstar.system.userinput import nearest_word

EndpointKind = Literal["serial", "udpin", "udpout", "tcp", "tcpin"]

_HERE = "127.0.0.1"
_UDP_PORT, _TCP_PORT = 14550, 5760
# Default baud rate, that of radios, MAVProxy and QGroundControl.
_BAUD = 57600
_KINDS: dict[str, EndpointKind] = {
    "serial": "serial",
    "udp": "udpin",
    "udpin": "udpin",
    "udpout": "udpout",
    "tcp": "tcp",
    "tcpout": "tcp",
    "tcpin": "tcpin",
}
_EXAMPLES = "/dev/ttyUSB0,57600, COM14,57600, udpin:127.0.0.1:14550, udpout:HOST:14550, tcp:HOST:5760 or tcpin::5760"
_WINDOWS_PORT = re.compile(r"(?:\\\\\.\\)?COM\d+", re.IGNORECASE)
_SCHEME = re.compile(r"([^:/\s]+):(//)?(.*)", re.DOTALL)
_BAUDS = (1200, 12_500_000)


@dataclass(frozen=True, slots=True)
class Endpoint:
    """One end of a telemetry link."""

    kind: EndpointKind
    text: str  # The connection string
    device: str = ""  # The serial port; empty for others
    baud: int = 0  # Its baud rate, bits/s; 0 for others
    host: str = ""  # Name or address; empty for a serial port
    port: int = 0  # UDP or TCP port; 0 for a serial port

    @property
    def is_on_this_computer(self) -> bool:
        """Whether the other end can only be a program on this computer."""
        try:
            return ip_address(self.host).is_loopback
        except ValueError:
            return self.host == "localhost"

    @classmethod
    def parse(cls, text: str) -> Self:
        """Parse a connection string of the table of this module, without opening the link.

        Raises ConfigError, with advice, if it is invalid.

        Examples
        --------
        >>> Endpoint.parse("/dev/ttyUSB0,57600")
        Endpoint(kind='serial', text='/dev/ttyUSB0,57600', device='/dev/ttyUSB0', baud=57600, host='', port=0)
        """
        text = text.strip()
        if not text:
            raise ConfigError(f"a link needs a name, such as {_EXAMPLES}")
        if text.startswith("/") or _WINDOWS_PORT.match(text):
            return cls._serial(text, text)
        split = _SCHEME.fullmatch(text)
        if split is None:
            raise ConfigError(f"{text} is no link; name one as {_EXAMPLES}")
        scheme, _, rest = split.groups()
        kind = _KINDS.get(scheme.lower())
        if kind is None:
            raise ConfigError(_unknown(text, scheme, rest))
        if kind == "serial":
            # In a URL the baud rate may follow a colon instead of a comma.
            return cls._serial(text, re.sub(r":(\d+)$", r",\1", rest))
        return cls._internet(kind, text, rest)

    @property
    def is_radio(self) -> bool:
        """Whether the baud rate limits it: a serial port that is not a native USB device."""
        return self.kind == "serial" and "ACM" not in self.device and "usbmodem" not in self.device

    @property
    def bytes_per_s(self) -> float | None:
        """Its capacity, bytes/s; None if it is not limited."""
        # Eight data bits, a start bit and a stop bit.
        return self.baud / 10 if self.is_radio else None

    @classmethod
    def _serial(cls, text: str, rest: str) -> Self:
        device, comma, rate = rest.partition(",")
        if not device:
            raise ConfigError(f"{text} names no serial port; 'glstar live' without arguments lists them")
        if not comma:
            return cls("serial", text, device=device, baud=_BAUD)
        if not rate.strip().isdigit() or not _BAUDS[0] <= int(rate) <= _BAUDS[1]:
            raise ConfigError(
                f"{text}: {rate.strip() or 'nothing'} is no baud rate; radios are set to 57600, USB ports to 115200"
            )
        return cls("serial", text, device=device, baud=int(rate))

    @classmethod
    def _internet(cls, kind: EndpointKind, text: str, rest: str) -> Self:
        local, at, remote = rest.rstrip("/").partition("@")
        if at:
            # mavros writes udp://LOCAL@REMOTE.
            if kind != "udpin":
                raise ConfigError(f"{text}: only udp:// accepts an @; write {kind}:HOST:PORT")
            if local:
                raise ConfigError(f"{text}: listen (udpin:{local}) or send first (udpout:{remote}); not both at once")
            kind, rest = "udpout", remote
        else:
            rest = local
        default = _UDP_PORT if kind.startswith("udp") else _TCP_PORT
        host, port = _host_and_port(text, rest, default)
        if not host and not kind.endswith("in"):
            raise ConfigError(f"{text} has no host; write {kind}:HOST:{port}, such as {kind}:127.0.0.1:{port}")
        return cls(kind, text, host=host or _HERE, port=port)


def _host_and_port(text: str, rest: str, default: int) -> tuple[str, int]:
    """Return host and port of ``host:port``, ``[::1]:port``, ``:port``, ``port`` or ``host``."""
    bracketed = re.fullmatch(r"\[([^\]]+)\](?::(.*))?", rest)
    if bracketed:
        host, port = bracketed[1], bracketed[2]
    elif rest.isdigit():
        host, port = "", rest
    elif rest.count(":") > 1:
        raise ConfigError(f"{text}: write an address with colons in brackets, such as [::1]:{default}")
    else:
        host, colon, port = rest.partition(":")
        port = port if colon else None
    if port is None or port == "":
        return host, default
    if not port.isdigit() or not 1 <= int(port) <= 65535:
        raise ConfigError(f"{text}: {port} is no port; ports are numbers from 1 to 65535, and usually {default}")
    return host, int(port)


def _unknown(text: str, scheme: str, rest: str) -> str:
    """Return the message for an unknown kind of link."""
    if scheme.lower() == "mcast":
        return f"{text}: glstar does not listen to multicast; let MAVProxy forward a copy: --out 127.0.0.1:14550"
    near = nearest_word(scheme.lower(), _KINDS)
    if near is not None:
        return f"{text}: {scheme} is no kind of link (did you mean {near}:{rest}?)"
    if re.match(r"\d+$", rest):
        return f"{text} has no kind: udpin:{text} listens for UDP, tcp:{text} connects to a TCP server"
    return f"{text} is no link; name one as {_EXAMPLES}"
