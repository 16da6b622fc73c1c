"""Bytes over sockets, and the words for what is wrong with a port."""

import errno
import socket

import pytest

from glstar.errors import LinkError
from glstar.link import Endpoint, Transport, open_transport
from glstar.link.transport import _port_error
from tests.support.links import free_port, until

PORT = Endpoint.parse("/dev/ttyUSB0,57600")


@pytest.mark.parametrize(
    ("number", "words"),
    [
        (errno.EACCES, "dialout"),
        (errno.EBUSY, "another program uses this port"),
        (errno.EAGAIN, "another program uses this port"),
        (errno.ENOTTY, "is no serial port"),
        (errno.EIO, "cannot be opened"),
    ],
)
def test_each_fault_of_a_port_has_its_own_sentence(number: int, words: str) -> None:
    assert words in _port_error(PORT, OSError(number, "said the system"))


def said(transport: Transport) -> bytes:
    got = until(lambda: transport.read(0.05), "bytes")
    assert isinstance(got, bytes)
    return got


def test_udp_carries_packets_in_both_directions_after_the_first_packet() -> None:
    port = free_port()
    with (
        open_transport(Endpoint.parse(f"udpin:127.0.0.1:{port}")) as ground,
        open_transport(Endpoint.parse(f"udpout:127.0.0.1:{port}")) as vehicle,
    ):
        ground.write(b"into the blue")
        vehicle.write(b"up")
        assert said(ground) == b"up"
        ground.write(b"down")
        assert said(vehicle) == b"down"


def test_udp_to_nobody_is_no_fault() -> None:
    with open_transport(Endpoint.parse(f"udpout:127.0.0.1:{free_port()}")) as vehicle:
        for _ in range(3):
            vehicle.write(b"hello?")
            assert vehicle.read(0.02) == b""


def test_answers_go_to_a_few_who_spoke_lately_and_not_to_a_town() -> None:
    port = free_port()
    with open_transport(Endpoint.parse(f"udpin:127.0.0.1:{port}")) as ground:
        many = [socket.socket(socket.AF_INET, socket.SOCK_DGRAM) for _ in range(20)]
        for one in many:
            one.settimeout(0.05)
            one.sendto(b"x", ("127.0.0.1", port))
            said(ground)
        ground.write(b"answer")
        answered = []
        for one in many:
            try:
                answered.append(one.recv(10))
            except TimeoutError:
                answered.append(b"")
            one.close()

    assert answered == [b""] * 12 + [b"answer"] * 8


def test_who_listens_for_tcp_takes_the_next_when_one_leaves() -> None:
    port = free_port(socket.SOCK_STREAM)
    with open_transport(Endpoint.parse(f"tcpin:127.0.0.1:{port}")) as server:
        server.write(b"nobody is there")
        for _ in range(2):
            with open_transport(Endpoint.parse(f"tcp:127.0.0.1:{port}")) as client:
                client.write(b"up")
                assert said(server) == b"up"
                server.write(b"down")
                assert said(client) == b"down"
            server.read(0.2)


def test_a_server_that_leaves_is_reported() -> None:
    port = free_port(socket.SOCK_STREAM)
    with open_transport(Endpoint.parse(f"tcpin:127.0.0.1:{port}")) as server:
        client = open_transport(Endpoint.parse(f"tcp:127.0.0.1:{port}"))
        client.write(b"up")
        said(server)
    with client, pytest.raises(LinkError, match="closed the connection"):
        until(lambda: client.read(0.05), "the end")


def test_a_name_that_nobody_has_is_reported() -> None:
    with pytest.raises(LinkError, match="no host is called"):
        open_transport(Endpoint.parse("tcp:nobody.invalid:5760"))
