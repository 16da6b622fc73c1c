"""Bytes over a serial port, UDP or TCP, with advice if a link cannot be opened."""

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
from typing import Any, Protocol, Self

from glstar.errors import LinkError
from glstar.link.endpoint import Endpoint

# Largest number of bytes of one read; more remain in the buffer of the operating system.
_READ_BYTES = 65536
# Size of that buffer for UDP, bytes: a second of a fast link while a frame is drawn.
_BUFFER_BYTES = 4 * 2**20
# Packets are sent to this many latest senders on a UDP port.
_MAX_PEERS = 8
# Timeout of a connection, s.
_CONNECT_S = 3.0


class Transport(Protocol):
    """An open link that carries bytes; a context manager."""

    endpoint: Endpoint

    @abstractmethod
    def read(self, timeout_s: float) -> bytes:
        """Wait for bytes and return them, none after the timeout; raises LinkError if the link is lost."""

    @abstractmethod
    def write(self, packet: bytes) -> None:
        """Send a packet; it is dropped if the other end is not connected yet; raises LinkError if the link is lost."""

    @abstractmethod
    def close(self) -> None:
        """Close the link; may be called twice."""

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()


def open_transport(endpoint: Endpoint) -> Transport:
    """Open a link, to be closed or used in a ``with`` statement; raises LinkError with advice if this fails."""
    transports: dict[str, Callable[[Endpoint], Transport]] = {
        "serial": _Serial,
        "udpin": _Udp,
        "udpout": _Udp,
        "tcp": _TcpClient,
        "tcpin": _TcpServer,
    }
    return transports[endpoint.kind](endpoint)


# --- serial ports -----------------------------------------------------------------------------------------------------


class SerialPort(Protocol):
    """A serial port of this computer, as pyserial describes it."""

    device: str  # ``/dev/ttyUSB0``
    description: str  # The connected device


def serial_ports() -> list[SerialPort]:
    """Return the serial ports of this computer, without ports of the mainboard that do not exist physically."""
    from serial.tools.list_ports import comports  # noqa: PLC0415 - when serial ports are listed

    return sorted((port for port in comports() if port.hwid != "n/a"), key=lambda port: port.device)


class _Serial(Transport):
    def __init__(self, endpoint: Endpoint) -> None:
        import serial  # noqa: PLC0415 - when a serial port is opened

        self.endpoint = endpoint
        _require_serial_port(endpoint)
        # Two programs that read one port would each receive a part of the bytes.
        exclusive = True if os.name == "posix" else None
        try:
            self._port = serial.Serial(
                endpoint.device, endpoint.baud, timeout=0, write_timeout=1.0, exclusive=exclusive
            )
        except ValueError as error:
            raise LinkError(endpoint.text, f"the port refuses {endpoint.baud} baud: {error}") from error
        except OSError as error:
            raise LinkError(endpoint.text, _port_error(endpoint, error)) from error
        self._errors: tuple[type[Exception], ...] = (OSError, serial.SerialException, TypeError, ValueError)
        self._too_slow: type[Exception] = serial.SerialTimeoutException

    def read(self, timeout_s: float) -> bytes:
        try:
            return bytes(self._port.read(_READ_BYTES)) if self._has_bytes(timeout_s) else b""
        except self._errors as error:
            raise self._gone(error) from error

    def _gone(self, error: Exception) -> LinkError:
        return LinkError(self.endpoint.text, f"the port is gone ({_error_text(error)}); is it still plugged in?")

    def _has_bytes(self, timeout_s: float) -> bool:
        if os.name == "posix":
            return _readable(self._port, timeout_s)
        until_s = time.monotonic() + timeout_s
        while not self._port.in_waiting and time.monotonic() < until_s:
            time.sleep(0.001)
        return bool(self._port.in_waiting)

    def write(self, packet: bytes) -> None:
        try:
            self._port.write(packet)
        except self._too_slow:
            return  # a radio without its other end accepts no more bytes
        except self._errors as error:
            raise self._gone(error) from error

    def close(self) -> None:
        self._port.close()


def _require_serial_port(endpoint: Endpoint) -> None:
    """Raise an error if the device is no serial port; pyserial would open any file."""
    path = Path(endpoint.device)
    if os.name != "posix":
        return
    try:
        mode = path.stat().st_mode
    except FileNotFoundError:
        raise LinkError(endpoint.text, f"there is no such serial port; {_available_ports()}") from None
    except OSError as error:
        raise LinkError(endpoint.text, _error_text(error)) from error
    if stat.S_ISREG(mode):
        raise LinkError(endpoint.text, "is a file, not a port; a flight log is replayed with 'glstar export'")
    if not stat.S_ISCHR(mode):
        raise LinkError(endpoint.text, f"is no serial port; {_available_ports()}")


def _available_ports() -> str:
    ports = serial_ports()
    return f"there are {', '.join(port.device for port in ports)}" if ports else "there is none; is it plugged in?"


def _port_error(endpoint: Endpoint, error: OSError) -> str:
    # pyserial reports some errors without errno, as text: "Could not configure port: (25, '...')".
    hidden = re.search(r"\((\d+), ", str(error))
    number = int(hidden[1]) if error.errno is None and hidden else error.errno
    if number in {errno.EACCES, errno.EPERM}:
        advice = ": sudo usermod -aG dialout $USER, and log in again" if sys.platform == "linux" else ""
        return f"you may not open this port; join the group 'dialout'{advice}"
    if number in {errno.EBUSY, errno.EAGAIN, errno.EWOULDBLOCK} or "exclusively lock" in str(error):
        return (
            "another program uses this port; close it, or let MAVProxy share it:"
            f" mavproxy.py --master {endpoint.device} --out 127.0.0.1:14550, and listen with udpin:14550"
        )
    if number in {errno.ENOTTY, errno.EINVAL, errno.ENODEV, errno.ENXIO}:
        return f"is no serial port; {_available_ports()}"
    return f"the port cannot be opened: {_error_text(error)}"


# --- UDP --------------------------------------------------------------------------------------------------------------


class _Udp(Transport):
    """UDP: ``udpin`` listens and replies to all latest senders, ``udpout`` sends first."""

    def __init__(self, endpoint: Endpoint) -> None:
        self.endpoint = endpoint
        # Senders, the latest last.
        self._peers: dict[Any, None] = {}
        self._listens = endpoint.kind == "udpin"
        family, address = _resolved(endpoint, socket.SOCK_DGRAM)
        self._socket = socket.socket(family, socket.SOCK_DGRAM)
        try:
            # Without SO_REUSEADDR: two programs on one port would silently take each other's packets.
            # The system may grant a smaller buffer.
            self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, _BUFFER_BYTES)
            if self._listens:
                self._socket.bind(address)
            else:
                self._socket.connect(address)
            self._socket.setblocking(False)
        except OSError as error:
            self._socket.close()
            raise LinkError(endpoint.text, _socket_error(endpoint, error)) from error

    def read(self, timeout_s: float) -> bytes:
        if not _readable(self._socket, timeout_s):
            return b""
        datagrams: list[bytes] = []
        size = 0
        try:
            while size < _READ_BYTES:
                datagram, peer = self._socket.recvfrom(_READ_BYTES)
                datagrams.append(datagram)
                size += len(datagram)
                if self._listens:
                    self._peers.pop(peer, None)
                    self._peers[peer] = None
                    if len(self._peers) > _MAX_PEERS:
                        del self._peers[next(iter(self._peers))]
        except (BlockingIOError, ConnectionError):
            pass  # no more packets, or no listener yet
        except OSError as error:
            raise LinkError(self.endpoint.text, f"the network is gone ({_error_text(error)})") from error
        return b"".join(datagrams)

    def write(self, packet: bytes) -> None:
        try:
            if self._listens:
                for peer in self._peers:
                    self._socket.sendto(packet, peer)
            else:
                self._socket.send(packet)
        except (BlockingIOError, ConnectionError):
            pass  # the queue is full, or no listener yet
        except OSError as error:
            raise LinkError(self.endpoint.text, f"the network is gone ({_error_text(error)})") from error

    def close(self) -> None:
        self._socket.close()


# --- TCP --------------------------------------------------------------------------------------------------------------


class _Tcp(Transport):
    """A TCP link; its connection is None if there is none."""

    _connection: socket.socket | None = None
    _CLOSED = "the other end has closed the connection"

    def _receive(self, connection: socket.socket, timeout_s: float) -> bytes | None:
        """Return received bytes; None if the other end has closed the connection."""
        if not _readable(connection, timeout_s):
            return b""
        try:
            return connection.recv(_READ_BYTES) or None
        except BlockingIOError:
            return b""
        except OSError:
            return None

    def _send(self, connection: socket.socket, packet: bytes) -> bool:
        """Send a complete packet; return whether the connection still exists."""
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
            _without_delay(self._connection)
        except OSError as error:
            self._connection.close()
            raise LinkError(endpoint.text, _socket_error(endpoint, error)) from error

    def read(self, timeout_s: float) -> bytes:
        assert self._connection is not None
        received = self._receive(self._connection, timeout_s)
        if received is None:
            raise LinkError(self.endpoint.text, self._CLOSED)
        return received

    def write(self, packet: bytes) -> None:
        assert self._connection is not None
        if not self._send(self._connection, packet):
            raise LinkError(self.endpoint.text, self._CLOSED)

    def close(self) -> None:
        assert self._connection is not None
        self._connection.close()


class _TcpServer(_Tcp):
    """Accepts one connection at a time."""

    def __init__(self, endpoint: Endpoint) -> None:
        self.endpoint = endpoint
        family, address = _resolved(endpoint, socket.SOCK_STREAM)
        self._listener = socket.socket(family, socket.SOCK_STREAM)
        try:
            # With TCP this only ignores an earlier connection that is still being closed.
            if os.name == "posix":
                self._listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            self._listener.bind(address)
            self._listener.listen(1)
            self._listener.setblocking(False)
        except OSError as error:
            self._listener.close()
            raise LinkError(endpoint.text, _socket_error(endpoint, error)) from error

    def read(self, timeout_s: float) -> bytes:
        if self._connection is None:
            if not _readable(self._listener, timeout_s):
                return b""
            try:
                self._connection, _ = self._listener.accept()
                _without_delay(self._connection)
            except OSError:
                return b""  # it was closed before it was accepted
            return b""
        received = self._receive(self._connection, timeout_s)
        if received is None:
            self._disconnect()
        return received or b""

    def write(self, packet: bytes) -> None:
        if self._connection is not None and not self._send(self._connection, packet):
            self._disconnect()

    def close(self) -> None:
        self._disconnect()
        self._listener.close()

    def _disconnect(self) -> None:
        if self._connection is not None:
            self._connection.close()
            self._connection = None


# --- sockets ----------------------------------------------------------------------------------------------------------


def _resolved(endpoint: Endpoint, kind: socket.SocketKind) -> tuple[socket.AddressFamily, Any]:
    """Return the family and address of an endpoint."""
    try:
        addresses = socket.getaddrinfo(endpoint.host, endpoint.port, type=kind)
    except OSError as error:
        raise LinkError(endpoint.text, f"no host is called {endpoint.host} ({_error_text(error)})") from error
    family, _, _, _, address = addresses[0]
    return family, address


def _without_delay(connection: socket.socket) -> None:
    """Send small packets without delay, and read without blocking."""
    connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    connection.setblocking(False)


def _readable(connection: Any, timeout_s: float) -> bool:
    """Return whether a socket or a serial port has bytes, after waiting for them, s."""
    return bool(select.select([connection], [], [], max(timeout_s, 0.0))[0])


def _socket_error(endpoint: Endpoint, error: OSError) -> str:
    protocol = "UDP" if endpoint.kind.startswith("udp") else "TCP"
    if error.errno == errno.EADDRINUSE:
        return (
            f"another program listens on {protocol} port {endpoint.port}; is QGroundControl or MAVProxy running?"
            " Close it, or let it forward a copy to another port: mavproxy.py --out 127.0.0.1:14551"
        )
    if error.errno in {errno.EACCES, errno.EPERM}:
        return f"you may not listen on {protocol} port {endpoint.port}; take one above 1023"
    if error.errno == errno.EADDRNOTAVAIL:
        return f"{endpoint.host} is no address of this computer; listen on 127.0.0.1, or on 0.0.0.0 for all of them"
    if isinstance(error, ConnectionRefusedError):
        return f"no program listens on TCP port {endpoint.port} there; is the simulator or autopilot running?"
    if isinstance(error, TimeoutError):
        return f"{endpoint.host} does not answer; is its address right?"
    return f"the connection failed: {_error_text(error)}"


def _error_text(error: Exception) -> str:
    text = error.strerror if isinstance(error, OSError) and error.strerror else str(error)
    return " ".join(text.split()) or type(error).__name__
