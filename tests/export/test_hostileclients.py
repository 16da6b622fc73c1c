"""Sockets of frames and answers with clients that are too many, too slow, or not meant."""

import json
import random
import socket
import time
from collections.abc import Iterator
from contextlib import ExitStack
from typing import Any

import numpy as np
import pytest
import zmq

from glstar.config import Config
from glstar.export.publish import outputs, stream
from glstar.export.publish.outputs import MOST_CLIENTS, MjpegServer
from glstar.export.publish.stream import LARGEST_MESSAGE, MOST_CONNECTIONS, AnswerReceiver, FrameStream
from tests.scripts import hostile_clients
from tests.support.links import free_port, soon, until

NAV = {"frame": 3, "utc": {"start": "2024-03-10T11:00:00.250000Z"}}
RNG = random.Random(1)
RAMP = np.add.outer(np.arange(48) * 2, np.arange(64)).astype(np.uint8)


@pytest.fixture
def served() -> Iterator[tuple[MjpegServer, int]]:
    port = free_port(socket.SOCK_STREAM)
    with MjpegServer(f"http://{port}", Config().sensor()) as server:
        server.write(RAMP, b"", NAV)
        yield server, port


def asked(port: int, request: bytes) -> socket.socket:
    connection = socket.create_connection(("127.0.0.1", port), 10)
    connection.settimeout(20)
    connection.sendall(request)
    return connection


def status_of(connection: socket.socket) -> str:
    """Return the status of an answer; empty if the connection was closed without one."""
    try:
        return connection.recv(12).decode().rpartition(" ")[2]
    except ConnectionError:
        return ""


# --- MJPEG ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("host", "status"),
    [
        ("127.0.0.1:{port}", "200"),
        ("localhost:{port}", "200"),
        ("LOCALHOST", "200"),
        ("[::1]:{port}", "200"),
        ("evil.example", "403"),
        ("evil.example:{port}", "403"),
        ("127.0.0.1.evil.example:{port}", "403"),
        ("192.168.1.7:{port}", "403"),
        ("", "403"),
    ],
)
def test_only_a_request_for_this_server_is_answered(host: str, status: str, served: tuple[MjpegServer, int]) -> None:
    """A web page whose name was pointed to 127.0.0.1 sends that name."""
    _, port = served
    for path in ("/", "/frame.jpg"):
        request = f"GET {path} HTTP/1.1\r\nHost: {host.format(port=port)}\r\n\r\n"
        with asked(port, request.encode()) as connection:
            assert status_of(connection) == status


def test_clients_beyond_the_limit_are_refused_until_one_leaves(served: tuple[MjpegServer, int]) -> None:
    server, port = served
    request = hostile_clients.request(port)
    with ExitStack() as opened:
        clients = [opened.enter_context(asked(port, request)) for _ in range(MOST_CLIENTS)]
        assert {status_of(client) for client in clients} == {"200"}
        with asked(port, request) as late:
            assert status_of(late) in {"503", ""}
        server.write(RAMP + np.uint8(1), b"", NAV)
        assert all(b"glstar-frame" in client.recv(4096) for client in clients)
        clients.pop().close()

        def is_served() -> bool:
            server.write(RAMP, b"", NAV)
            with asked(port, request) as again:
                return status_of(again) == "200"

        until(is_served, "a place")


@pytest.mark.parametrize("sent", [b"", b"GET / HT", b"GET / HTTP/1.1\r\nHost: localhost\r\nX: y"])
def test_a_request_without_an_end_is_dropped(
    sent: bytes, served: tuple[MjpegServer, int], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(outputs, "_REQUEST_TIMEOUT_S", 0.3)
    with asked(served[1], sent) as connection:
        began_s = time.monotonic()
        assert status_of(connection) == ""
        assert time.monotonic() - began_s < 10


def test_a_request_that_trickles_is_dropped(served: tuple[MjpegServer, int], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(outputs, "_REQUEST_TIMEOUT_S", 0.5)

    def is_dropped(connection: socket.socket) -> bool:
        try:
            connection.sendall(b"x")
        except ConnectionError:
            return True
        time.sleep(0.1)
        return False

    with asked(served[1], b"GET /") as connection:
        until(lambda: is_dropped(connection), "the end")


@pytest.mark.parametrize("sent", [b"GET /" + b"x" * 100_000, b"GET / HTTP/1.1\r\nX: " + b"y" * 100_000, bytes(100_000)])
def test_a_request_that_is_too_long_is_refused(sent: bytes, served: tuple[MjpegServer, int]) -> None:
    with socket.create_connection(("127.0.0.1", served[1]), 10) as connection:
        connection.settimeout(10)
        try:
            connection.sendall(sent)
        except ConnectionError:
            return
        assert status_of(connection) != "200"


def test_a_client_that_takes_no_frames_is_dropped(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(outputs, "_FRAME_TIMEOUT_S", 0.3)
    noise = np.random.default_rng(1).integers(0, 256, (960, 1280), dtype=np.uint8)
    port = free_port(socket.SOCK_STREAM)
    with MjpegServer(f"http://{port}", Config().sensor()) as server, ExitStack() as opened:
        connections = [hostile_clients.reads_nothing(port, RNG) for _ in range(MOST_CLIENTS)]
        for connection in connections:
            opened.enter_context(connection)

        def is_served() -> bool:
            server.write(noise, b"", NAV)  # never waits
            with asked(port, hostile_clients.request(port, "/frame.jpg")) as client:
                return status_of(client) == "200"

        until(is_served, "a place")


# --- ZeroMQ -----------------------------------------------------------------------------------------------------------


def received(connection: socket.socket, timeout_s: float) -> bytes:
    connection.settimeout(timeout_s)
    try:
        return connection.recv(1 << 20)
    except (TimeoutError, ConnectionError):
        return b""


def test_subscribers_beyond_the_limit_get_no_frames_until_one_leaves() -> None:
    port = free_port(socket.SOCK_STREAM)
    with FrameStream(f"zmq://{port}") as frames, ExitStack() as opened:
        clients = [
            opened.enter_context(hostile_clients.introduced(port, b"SUB", patience_s=20.0))
            for _ in range(MOST_CONNECTIONS)
        ]
        late = opened.enter_context(hostile_clients.introduced(port, b"SUB", patience_s=1.0))
        for client in (*clients, late):
            client.sendall(b"\x00\x01\x01")
        time.sleep(0.5)  # until the subscriptions are in force
        frames.write(RAMP, b"{}", NAV)

        assert all(any(b"glstar-frame-1" in received(client, 10) for _ in range(3)) for client in clients)
        assert not any(b"glstar-frame-1" in received(late, 0.5) for _ in range(3))

        for client in clients:
            client.close()
        with zmq.Context() as context, context.socket(zmq.SUB) as friendly:
            friendly.subscribe(b"")
            friendly.connect(f"tcp://127.0.0.1:{port}")

            def has_frame() -> Any:
                frames.write(RAMP, b"{}", NAV)
                return friendly.poll(100)

            until(has_frame, "a frame")
            assert json.loads(friendly.recv_multipart()[0])["frame"] == 3


@pytest.mark.parametrize(
    ("sent", "line"),
    [
        (b'{"frame": 1}\n{"frame": 2}', '{"frame": 1}'),
        (b"\xff\xfe" * 50, "100 bytes that are no text"),
        (b"\n" * 5000, "5001 lines in one message, of at most 1000"),
    ],
)
def test_what_is_no_answer_is_one_line(sent: bytes, line: str) -> None:
    port = free_port(socket.SOCK_STREAM)
    receiver = AnswerReceiver(f"zmq://{port}")
    with zmq.Context() as context, context.socket(zmq.PUSH) as sender:
        sender.setsockopt(zmq.LINGER, 0)
        sender.connect(f"tcp://127.0.0.1:{port}")
        sender.send(sent)
        assert until(lambda: receiver.lines(0.1), "the message")[0] == line
    receiver.close()


def test_a_message_that_is_too_large_ends_its_connection_and_no_other() -> None:
    port = free_port(socket.SOCK_STREAM)
    receiver = AnswerReceiver(f"zmq://{port}")
    with (
        hostile_clients.introduced(port, b"PUSH", patience_s=20.0) as hostile,
        zmq.Context() as context,
        context.socket(zmq.PUSH) as sender,
    ):
        sender.setsockopt(zmq.LINGER, 0)
        hostile.sendall(b"\x02" + (LARGEST_MESSAGE + 1).to_bytes(8, "big"))

        def is_closed() -> bool:
            try:
                hostile.sendall(bytes(1000))
            except ConnectionError:
                return True
            return False

        until(is_closed, "the end of the connection")
        sender.connect(f"tcp://127.0.0.1:{port}")
        sender.send(b'{"frame": 5}')
        assert until(lambda: receiver.lines(0.1), "an answer") == ['{"frame": 5}']
    receiver.close()


@pytest.mark.parametrize("opened", [FrameStream, AnswerReceiver])
def test_a_connection_that_does_not_introduce_itself_is_closed(opened: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(stream, "_HANDSHAKE_MS", 300)
    port = free_port(socket.SOCK_STREAM)
    bound = opened(f"zmq://{port}")
    with asked(port, b"") as silent:

        def is_closed() -> bool:
            silent.settimeout(0.1)
            try:
                return silent.recv(100) == b""
            except TimeoutError:
                return False
            except ConnectionError:
                return True

        assert soon(is_closed, 20)
    bound.close()


@pytest.mark.slow
@pytest.mark.timeout(900)
def test_hostile_clients_cost_little_memory_and_frames_go_on() -> None:
    """A sample of ``python -m tests.scripts.hostile_clients``."""
    rows = list(hostile_clients.search("http", 60, 4.0, 1, {"read nothing", "name another host"}))
    rows += hostile_clients.search("answers", 60, 4.0, 1, {"send messages of 1 MB"})

    assert [str(row) for row in rows if not row.is_good] == []
    assert len(rows) == 3
