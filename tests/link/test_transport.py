"""Bytes over sockets, and the messages for errors of ports."""

import errno
import re
import socket
from pathlib import Path
from types import SimpleNamespace

import pytest
from serial.tools import list_ports

from glstar.errors import LinkError
from glstar.link import Endpoint, Transport, open_transport
from glstar.link import transport as links
from glstar.link.transport import _error_text, _port_error, _require_serial_port, _socket_error, serial_ports
from tests.support.links import free_port, until

PORT = Endpoint.parse("/dev/ttyUSB0,57600")


TAKEN = (
    "another program uses this port; close it, or let MAVProxy share it: mavproxy.py --master /dev/ttyUSB0 --out"
    " 127.0.0.1:14550, and listen with udpin:14550"
)
NO_PORT = "is no serial port; there are /dev/ttyS1, /dev/ttyUSB0"
FORBIDDEN = "you may not open this port; join the group 'dialout': sudo usermod -aG dialout $USER, and log in again"


@pytest.fixture
def two_ports(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let this computer have two ports, beside one of the mainboard that does not exist."""
    names = {"/dev/ttyUSB0": "USB VID:PID", "/dev/ttyS0": "n/a", "/dev/ttyS1": "PNP0501"}
    ports = [SimpleNamespace(device=name, hwid=hwid, description=name[5:]) for name, hwid in names.items()]
    monkeypatch.setattr(list_ports, "comports", lambda: ports)


@pytest.mark.parametrize(
    ("error", "message"),
    [
        (OSError(errno.EACCES, "text"), FORBIDDEN),
        (OSError(errno.EPERM, "text"), FORBIDDEN),
        (OSError(errno.EBUSY, "text"), TAKEN),
        (OSError(errno.EAGAIN, "text"), TAKEN),
        (OSError(errno.EIO, "Could not exclusively lock port"), TAKEN),
        (OSError(errno.ENOTTY, "text"), NO_PORT),
        (OSError(errno.EINVAL, "text"), NO_PORT),
        (OSError(errno.ENODEV, "text"), NO_PORT),
        (OSError(errno.ENXIO, "text"), NO_PORT),
        (OSError(errno.EIO, "Input/output  error"), "the port cannot be opened: Input/output error"),
        # As pyserial hides the number, and a number that is none of an error.
        (OSError(f"Could not configure port: ({errno.ENOTTY}, 'text')"), NO_PORT),
        (OSError(f"could not open port: ({errno.EACCES}, 'text')"), FORBIDDEN),
        (OSError("of no number"), "the port cannot be opened: of no number"),
        (
            OSError(errno.EIO, f"text ({errno.EBUSY}, 'text')"),
            f"the port cannot be opened: text ({errno.EBUSY}, 'text')",
        ),
    ],
)
def test_each_error_of_a_port_has_its_own_message(
    error: OSError, message: str, two_ports: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(links.sys, "platform", "linux")
    assert _port_error(PORT, error) == message


@pytest.mark.parametrize(
    ("link", "error", "message"),
    [
        ("tcpin:127.0.0.1:5760", OSError(errno.EADDRINUSE, ""), "another program listens on TCP port 5760; is QGro"),
        ("udpin:127.0.0.1:14550", OSError(errno.EADDRINUSE, ""), "another program listens on UDP port 14550; is QGro"),
        ("udpin:127.0.0.1:80", OSError(errno.EACCES, ""), "you may not listen on UDP port 80; take one above 1023"),
        ("tcpin:127.0.0.1:80", OSError(errno.EPERM, ""), "you may not listen on TCP port 80; take one above 1023"),
        ("udpin:10.0.0.9:80", OSError(errno.EADDRNOTAVAIL, ""), "10.0.0.9 is no address of this computer; listen on"),
        ("tcp:10.0.0.9:5760", ConnectionRefusedError(), "no program listens on TCP port 5760 there; is the simulator"),
        ("tcp:10.0.0.9:5760", TimeoutError(), "10.0.0.9 does not answer; is its address right?"),
        ("tcp:10.0.0.9:5760", OSError(errno.EIO, "text\n of it"), "the connection failed: text of it"),
    ],
)
def test_each_error_of_a_socket_has_its_own_message(link: str, error: OSError, message: str) -> None:
    assert _socket_error(Endpoint.parse(link), error).startswith(message)


def test_an_error_without_a_text_has_its_name() -> None:
    texts = [_error_text(error) for error in (OSError(errno.EIO, "of the system"), ValueError(" a\n b "), OSError())]
    assert texts == ["of the system", "a b", "OSError"]


def test_ports_are_sorted_and_those_that_do_not_exist_are_left_out(
    two_ports: None, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    assert [port.device for port in serial_ports()] == ["/dev/ttyS1", "/dev/ttyUSB0"]

    (tmp_path / "flight.tlog").touch()
    for name, message in (
        ("none", "there is no such serial port; there are /dev/ttyS1, /dev/ttyUSB0"),
        ("flight.tlog", "is a file, not a port; a flight log is replayed with 'glstar export'"),
        (".", NO_PORT),
    ):
        port = Endpoint.parse(f"{tmp_path / name},57600")
        with pytest.raises(LinkError, match=re.escape(message)):
            _require_serial_port(port)
    _require_serial_port(Endpoint.parse("/dev/null,57600"))
    monkeypatch.setattr(list_ports, "comports", list)
    assert _port_error(PORT, OSError(errno.ENODEV, "")) == "is no serial port; there is none; is it plugged in?"


def received(transport: Transport) -> bytes:
    got = until(lambda: transport.read(0.05), "bytes")
    assert isinstance(got, bytes)
    return got


def test_udp_carries_packets_in_both_directions_after_the_first_packet() -> None:
    port = free_port()
    with (
        open_transport(Endpoint.parse(f"udpin:127.0.0.1:{port}")) as ground,
        open_transport(Endpoint.parse(f"udpout:127.0.0.1:{port}")) as vehicle,
    ):
        ground.write(b"not connected yet")
        vehicle.write(b"up")
        assert received(ground) == b"up"
        ground.write(b"down")
        assert received(vehicle) == b"down"


def test_udp_without_a_listener_is_no_error() -> None:
    with open_transport(Endpoint.parse(f"udpout:127.0.0.1:{free_port()}")) as vehicle:
        for _ in range(3):
            vehicle.write(b"hello?")
            assert vehicle.read(0.02) == b""


def test_packets_are_sent_to_few_recent_senders_only() -> None:
    port = free_port()
    with open_transport(Endpoint.parse(f"udpin:127.0.0.1:{port}")) as ground:
        many = [socket.socket(socket.AF_INET, socket.SOCK_DGRAM) for _ in range(20)]
        for one in many:
            one.settimeout(0.05)
            one.sendto(b"x", ("127.0.0.1", port))
            received(ground)
        ground.write(b"answer")
        answered = []
        for one in many:
            try:
                answered.append(one.recv(10))
            except TimeoutError:
                answered.append(b"")
            one.close()

    assert answered == [b""] * 12 + [b"answer"] * 8


def test_a_tcp_listener_accepts_the_next_connection() -> None:
    port = free_port(socket.SOCK_STREAM)
    with open_transport(Endpoint.parse(f"tcpin:127.0.0.1:{port}")) as server:
        server.write(b"not connected yet")
        for _ in range(2):
            with open_transport(Endpoint.parse(f"tcp:127.0.0.1:{port}")) as client:
                client.write(b"up")
                assert received(server) == b"up"
                server.write(b"down")
                assert received(client) == b"down"
            server.read(0.2)


def test_a_closed_tcp_connection_is_reported() -> None:
    port = free_port(socket.SOCK_STREAM)
    with open_transport(Endpoint.parse(f"tcpin:127.0.0.1:{port}")) as server:
        client = open_transport(Endpoint.parse(f"tcp:127.0.0.1:{port}"))
        client.write(b"up")
        received(server)
    with client, pytest.raises(LinkError, match="closed the connection"):
        until(lambda: client.read(0.05), "the end")


def test_an_unknown_host_is_reported() -> None:
    with pytest.raises(LinkError, match="no host is called"):
        open_transport(Endpoint.parse("tcp:nobody.invalid:5760"))


def test_one_read_of_udp_ends_with_the_packet_that_makes_64_kb_and_the_next_has_the_others() -> None:
    port = free_port()
    with open_transport(Endpoint.parse(f"udpin:127.0.0.1:{port}")) as ground:
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as vehicle:
            for number in range(70):
                vehicle.sendto(bytes([number]) * 1000, ("127.0.0.1", port))
        first, second = received(ground), received(ground)

    # 66 packets of 1000 bytes are the first to have 65536.
    assert first == b"".join(bytes([number]) * 1000 for number in range(66))
    assert second == b"".join(bytes([number]) * 1000 for number in range(66, 70))


def test_tcp_sends_at_once_never_blocks_a_read_and_reports_a_lost_connection() -> None:
    port = free_port(socket.SOCK_STREAM)
    with open_transport(Endpoint.parse(f"tcpin:127.0.0.1:{port}")) as server:
        client = open_transport(Endpoint.parse(f"tcp:127.0.0.1:{port}"))
        assert server._listener.gettimeout() == 0.0
        assert server.read(1.0) == b""  # accepts
        for end in (client, server):
            assert end._connection.getsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY) == 1
            assert end._connection.gettimeout() == 0.0
            end.write(b"packet")
            assert end._connection.gettimeout() == 0.0
        assert (client.read(1.0), server.read(1.0)) == (b"packet", b"packet")
        client.close()
        until(lambda: server.read(0.05) == b"" and server._connection is None, "the end")
        server.write(b"to nobody")
        with open_transport(Endpoint.parse(f"tcp:127.0.0.1:{port}")) as client:
            server.read(1.0)
            server._connection.close()
            server.write(b"over a closed socket")
            assert server._connection is None
            with pytest.raises(LinkError, match="the other end has closed the connection"):
                until(lambda: client.write(b"x" * 10_000), "the end")
