"""Bytes over a serial port, UDP or TCP, and what to do when they cannot flow."""

import errno
import os
import re
import select
import socket
import stat
import sys
import time
from abc import abstractmethod
from collections.abc import Callable
from pathlib import Path
from types import TracebackType
from typing import Any, Final, Protocol, Self

from glstar.errors import LinkError
from glstar.link.endpoint import Endpoint

__all__ = ["SerialPort", "Transport", "open_transport", "serial_ports"]

# So much is taken at once: what a flood brings meanwhile waits, or is dropped, in the system.
_READ_BYTES: Final = 65536
_ROOM_BYTES: Final = 4 * 2**20
# An answer goes to everybody who was heard lately on a UDP port, but not to a whole town.
_MOST_PEERS: Final = 8
_CONNECT_S: Final = 3.0


class Transport(Protocol):
    """An open link that carries bytes; a context manager.

    Attributes
    ----------
    endpoint : Endpoint
    """

    endpoint: Endpoint

    @abstractmethod
    def read(self, timeout_s: float) -> bytes:
        """Return what has arrived, after waiting for the first byte.

        Parameters
        ----------
        timeout_s : float
            How long to wait, s.

        Returns
        -------
        bytes
            Nothing where nothing came.

        Raises
        ------
        LinkError
            If the link is gone.
        """

    @abstractmethod
    def write(self, packet: bytes) -> None:
        """Send a packet; where nobody is there yet it is dropped.

        Parameters
        ----------
        packet : bytes

        Raises
        ------
        LinkError
            If the link is gone.
        """

    @abstractmethod
    def close(self) -> None:
        """Let go of the port; it may be called twice."""

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()


def open_transport(endpoint: Endpoint) -> Transport:
    """Open a link.

    Parameters
    ----------
    endpoint : Endpoint

    Returns
    -------
    Transport
        To be closed, or used in a ``with`` statement.

    Raises
    ------
    LinkError
        If it cannot be opened, with what to do about it.
    """
    ways: dict[str, Callable[[Endpoint], Transport]] = {
        "serial": _Serial,
        "udpin": _Udp,
        "udpout": _Udp,
        "tcp": _TcpClient,
        "tcpin": _TcpServer,
    }
    return ways[endpoint.kind](endpoint)


# --- serial ports -----------------------------------------------------------------------------------------------------


class SerialPort(Protocol):
    """A serial port that this computer has, as pyserial tells of it.

    Attributes
    ----------
    device : str
        Its name: ``/dev/ttyUSB0``.
    description : str
        What is plugged in, in words.
    """

    device: str
    description: str


def serial_ports() -> list[SerialPort]:
    """Return the serial ports of this computer that something is plugged into.

    Returns
    -------
    list of SerialPort
        Ports that a mainboard only has on paper are left out.
    """
    from serial.tools.list_ports import comports  # noqa: PLC0415 - when it is needed

    return sorted((port for port in comports() if port.hwid != "n/a"), key=lambda port: port.device)


class _Serial(Transport):
    def __init__(self, endpoint: Endpoint) -> None:
        import serial  # noqa: PLC0415 - when it is needed

        self.endpoint = endpoint
        _refuse_no_port(endpoint)
        # A port that somebody else reads gives each of the two half of the bytes.
        alone = True if os.name == "posix" else None
        try:
            self._port = serial.Serial(endpoint.device, endpoint.baud, timeout=0, write_timeout=1.0, exclusive=alone)
        except ValueError as error:
            raise LinkError(endpoint.text, f"the port refuses {endpoint.baud} baud: {error}") from error
        except OSError as error:
            raise LinkError(endpoint.text, _why_no_port(endpoint, error)) from error
        self._errors: tuple[type[Exception], ...] = (OSError, serial.SerialException, TypeError, ValueError)
        self._too_slow: type[Exception] = serial.SerialTimeoutException

    def read(self, timeout_s: float) -> bytes:
        try:
            return bytes(self._port.read(_READ_BYTES)) if self._has_bytes(timeout_s) else b""
        except self._errors as error:
            raise LinkError(
                self.endpoint.text, f"the port is gone ({_words(error)}); is it still plugged in?"
            ) from error

    def _has_bytes(self, timeout_s: float) -> bool:
        if os.name == "posix":
            return bool(select.select([self._port], [], [], max(timeout_s, 0.0))[0])
        until_s = time.monotonic() + timeout_s
        while not (there := self._port.in_waiting) and time.monotonic() < until_s:
            time.sleep(0.001)
        return bool(there)

    def write(self, packet: bytes) -> None:
        try:
            self._port.write(packet)
        except self._too_slow:
            return  # a radio whose other end is off takes nothing any more: nobody is there
        except self._errors as error:
            raise LinkError(
                self.endpoint.text, f"the port is gone ({_words(error)}); is it still plugged in?"
            ) from error

    def close(self) -> None:
        self._port.close()


def _refuse_no_port(endpoint: Endpoint) -> None:
    """Refuse what is no serial port, in words; pyserial would open anything."""
    path = Path(endpoint.device)
    if os.name != "posix":
        return
    try:
        mode = path.stat().st_mode
    except FileNotFoundError:
        raise LinkError(endpoint.text, f"there is no such serial port; {_ports_there_are()}") from None
    except OSError as error:
        raise LinkError(endpoint.text, _words(error)) from error
    if stat.S_ISREG(mode):
        raise LinkError(endpoint.text, "is a file, not a port; a flight log is replayed with 'glstar export'")
    if not stat.S_ISCHR(mode):
        raise LinkError(endpoint.text, f"is no serial port; {_ports_there_are()}")


def _ports_there_are() -> str:
    ports = serial_ports()
    return f"there are {', '.join(port.device for port in ports)}" if ports else "there is none; is it plugged in?"


def _why_no_port(endpoint: Endpoint, error: OSError) -> str:
    # pyserial hides the number of what it met while it set the port up: "Could not configure port: (25, '...')".
    hidden = re.search(r"\((\d+), ", str(error))
    number = int(hidden[1]) if error.errno is None and hidden else error.errno
    if number in {errno.EACCES, errno.EPERM}:
        advice = ": sudo usermod -aG dialout $USER, and log in anew" if sys.platform == "linux" else ""
        return f"you may not open this port; join the group 'dialout'{advice}"
    if number in {errno.EBUSY, errno.EAGAIN, errno.EWOULDBLOCK} or "exclusively lock" in str(error):
        return (
            "another program uses this port; close it, or let MAVProxy share it:"
            f" mavproxy.py --master {endpoint.device} --out 127.0.0.1:14550, and listen with udpin:14550"
        )
    if number in {errno.ENOTTY, errno.EINVAL, errno.ENODEV, errno.ENXIO}:
        return f"is no serial port; {_ports_there_are()}"
    return f"the port cannot be opened: {_words(error)}"


# --- UDP --------------------------------------------------------------------------------------------------------------


class _Udp(Transport):
    """Listening (``udpin``: answers go to all who were heard), or speaking first (``udpout``)."""

    def __init__(self, endpoint: Endpoint) -> None:
        self.endpoint = endpoint
        # Who was heard, the latest last.
        self._peers: dict[Any, None] = {}
        self._listens = endpoint.kind == "udpin"
        family, address = _resolved(endpoint, socket.SOCK_DGRAM)
        self._socket = socket.socket(family, socket.SOCK_DGRAM)
        try:
            # Never SO_REUSEADDR: two programs on one port would take each other's packets without a word.
            # Room for what comes while a frame is drawn; the system gives as much of it as it allows.
            self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, _ROOM_BYTES)
            if self._listens:
                self._socket.bind(address)
            else:
                self._socket.connect(address)
            self._socket.setblocking(False)
        except OSError as error:
            self._socket.close()
            raise LinkError(endpoint.text, _why_no_socket(endpoint, error)) from error

    def read(self, timeout_s: float) -> bytes:
        if not _readable(self._socket, timeout_s):
            return b""
        got: list[bytes] = []
        size = 0
        try:
            while size < _READ_BYTES:
                datagram, peer = self._socket.recvfrom(_READ_BYTES)
                got.append(datagram)
                size += len(datagram)
                if self._listens:
                    self._peers.pop(peer, None)
                    self._peers[peer] = None
                    if len(self._peers) > _MOST_PEERS:
                        del self._peers[next(iter(self._peers))]
        except (BlockingIOError, ConnectionError):
            pass  # nothing more; or nobody there listens, yet
        except OSError as error:
            raise LinkError(self.endpoint.text, f"the network is gone ({_words(error)})") from error
        return b"".join(got)

    def write(self, packet: bytes) -> None:
        try:
            if self._listens:
                for peer in self._peers:
                    self._socket.sendto(packet, peer)
            else:
                self._socket.send(packet)
        except (BlockingIOError, ConnectionError):
            pass  # the queue is full; or nobody there listens, yet
        except OSError as error:
            raise LinkError(self.endpoint.text, f"the network is gone ({_words(error)})") from error

    def close(self) -> None:
        self._socket.close()


# --- TCP --------------------------------------------------------------------------------------------------------------


class _Tcp(Transport):
    """What both ends of a connection have in common; None where there is none."""

    _connection: socket.socket | None = None
    _CLOSED: Final = "the other end has closed the connection"

    def _receive(self, connection: socket.socket, timeout_s: float) -> bytes | None:
        """Return what has arrived; None where the other end has left."""
        if not _readable(connection, timeout_s):
            return b""
        try:
            return connection.recv(_READ_BYTES) or None
        except BlockingIOError:
            return b""
        except OSError:
            return None

    def _send(self, connection: socket.socket, packet: bytes) -> bool:
        """Send a packet whole; return whether the other end is still there."""
        try:
            connection.settimeout(1.0)
            connection.sendall(packet)
            connection.setblocking(False)
        except OSError:
            return False
        return True


class _TcpClient(_Tcp):
    def __init__(self, endpoint: Endpoint) -> None:
        self.endpoint = endpoint
        family, address = _resolved(endpoint, socket.SOCK_STREAM)
        self._connection = socket.socket(family, socket.SOCK_STREAM)
        try:
            self._connection.settimeout(_CONNECT_S)
            self._connection.connect(address)
            _prompt(self._connection)
        except OSError as error:
            self._connection.close()
            raise LinkError(endpoint.text, _why_no_socket(endpoint, error)) from error

    def read(self, timeout_s: float) -> bytes:
        assert self._connection is not None
        got = self._receive(self._connection, timeout_s)
        if got is None:
            raise LinkError(self.endpoint.text, self._CLOSED)
        return got

    def write(self, packet: bytes) -> None:
        assert self._connection is not None
        if not self._send(self._connection, packet):
            raise LinkError(self.endpoint.text, self._CLOSED)

    def close(self) -> None:
        assert self._connection is not None
        self._connection.close()


class _TcpServer(_Tcp):
    """One connection at a time; when it ends, the next may come."""

    def __init__(self, endpoint: Endpoint) -> None:
        self.endpoint = endpoint
        family, address = _resolved(endpoint, socket.SOCK_STREAM)
        self._listener = socket.socket(family, socket.SOCK_STREAM)
        try:
            # Of TCP this only means: an earlier connection that lingers does not count.
            if os.name == "posix":
                self._listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            self._listener.bind(address)
            self._listener.listen(1)
            self._listener.setblocking(False)
        except OSError as error:
            self._listener.close()
            raise LinkError(endpoint.text, _why_no_socket(endpoint, error)) from error

    def read(self, timeout_s: float) -> bytes:
        if self._connection is None:
            if not _readable(self._listener, timeout_s):
                return b""
            try:
                self._connection, _ = self._listener.accept()
                _prompt(self._connection)
            except OSError:
                return b""  # it left before it was greeted
            return b""
        got = self._receive(self._connection, timeout_s)
        if got is None:
            self._hang_up()
        return got or b""

    def write(self, packet: bytes) -> None:
        if self._connection is not None and not self._send(self._connection, packet):
            self._hang_up()

    def close(self) -> None:
        self._hang_up()
        self._listener.close()

    def _hang_up(self) -> None:
        if self._connection is not None:
            self._connection.close()
            self._connection = None


# --- sockets ----------------------------------------------------------------------------------------------------------


def _resolved(endpoint: Endpoint, kind: socket.SocketKind) -> tuple[socket.AddressFamily, Any]:
    """Return the family and address of an endpoint."""
    try:
        found = socket.getaddrinfo(endpoint.host, endpoint.port, type=kind)
    except OSError as error:
        raise LinkError(endpoint.text, f"nobody is called {endpoint.host} ({_words(error)})") from error
    family, _, _, _, address = found[0]
    return family, address


def _prompt(connection: socket.socket) -> None:
    """Let small packets go at once, and reading return at once."""
    connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    connection.setblocking(False)


def _readable(one: socket.socket, timeout_s: float) -> bool:
    return bool(select.select([one], [], [], max(timeout_s, 0.0))[0])


def _why_no_socket(endpoint: Endpoint, error: OSError) -> str:
    what = "UDP" if endpoint.kind.startswith("udp") else "TCP"
    if error.errno == errno.EADDRINUSE:
        return (
            f"another program listens on {what} port {endpoint.port}; is QGroundControl or MAVProxy running?"
            " Close it, or let it forward a copy to another port: mavproxy.py --out 127.0.0.1:14551"
        )
    if error.errno in {errno.EACCES, errno.EPERM}:
        return f"you may not listen on {what} port {endpoint.port}; take one above 1023"
    if error.errno == errno.EADDRNOTAVAIL:
        return f"{endpoint.host} is no address of this computer; listen on 127.0.0.1, or on 0.0.0.0 for all of them"
    if isinstance(error, ConnectionRefusedError):
        return f"nobody listens on TCP port {endpoint.port} there; is the simulator or autopilot running?"
    if isinstance(error, TimeoutError):
        return f"{endpoint.host} does not answer; is its address right?"
    return f"the connection failed: {_words(error)}"


def _words(error: Exception) -> str:
    text = error.strerror if isinstance(error, OSError) and error.strerror else str(error)
    return " ".join(text.split()) or type(error).__name__
