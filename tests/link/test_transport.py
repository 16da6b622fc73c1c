"""Bytes over sockets, and the messages for errors of ports."""

import errno
import socket

import pytest

from glstar.errors import LinkError
from glstar.link import Endpoint, Transport, open_transport
from glstar.link.transport import _port_error
from tests.support.links import free_port, until

PORT = Endpoint.parse("/dev/ttyUSB0,57600")


@pytest.mark.parametrize(
    ("number", "message"),
    [
        (errno.EACCES, "dialout"),
        (errno.EBUSY, "another program uses this port"),
        (errno.EAGAIN, "another program uses this port"),
        (errno.ENOTTY, "is no serial port"),
        (errno.EIO, "cannot be opened"),
    ],
)
def test_each_error_of_a_port_has_its_own_message(number: int, message: str) -> None:
    assert message in _port_error(PORT, OSError(number, "text of the system"))


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
