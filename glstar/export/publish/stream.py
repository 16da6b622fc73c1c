"""Frames for other processes as ZeroMQ messages, and the sockets of a navigator's answers.

A navigator runs beside ``glstar live LINK --latest-frame zmq://127.0.0.1:5556`` and subscribes to that address.  Each
message has two parts: a header in JSON and the pixels, row by row from the top, little-endian.

===============  =======================================================================================
key of a header  holds
===============  =======================================================================================
schema           ``"glstar-frame-1"``
frame            number of the frame
utc              UTC of the start, the middle and the end of the exposure, by the clock of the navigator
shape, dtype     height and width; ``"uint8"`` or ``"uint16"``
nav              what the aircraft knows, a line of ``nav.jsonl``
sent_unix_s      when it was sent, by the computer's clock, seconds since 1970
truth            the line of ``truth.jsonl``; only with ``--with-truth``
===============  =======================================================================================

A subscriber that is slower than the frames misses some.
"""

import os
import re
import socket
import time
from collections.abc import Mapping
from contextlib import suppress
from threading import Event, Thread
from types import ModuleType
from typing import Any, Self

import numpy as np
import orjson
from numpy.typing import NDArray

from glstar.errors import ConfigError
from glstar.system.installation import install_command

FRAME_SCHEMA = "glstar-frame-1"
STREAM = "zmq://"
_ADDRESS = re.compile(r"zmq://(?:(\[[0-9a-fA-F:]+\]|[^:/\[\]]+):)?(\d{1,5})/?")
_LOOPBACK = "127.0.0.1"
# Frames that wait for a slow subscriber before further ones are dropped.
_WAITING = 2
# Interval at which the end is looked for, ms.
_POLL_MS = 100
# Time to send what waits when a socket is closed, ms.
_LINGER_MS = 1000
# Largest message with answers, bytes: a connection that sends a larger one is closed.
LARGEST_MESSAGE = 1_000_000
# Messages with answers of each connection that wait to be read.
_WAITING_ANSWERS = 1
# Connections at a time to each socket; further ones are closed.
MOST_CONNECTIONS = 8
# Largest message of a subscriber, bytes: what it subscribes to.
_LARGEST_SUBSCRIPTION = 1_000
# Time for a connection to introduce itself, and for a subscriber to take what was sent, ms.
_HANDSHAKE_MS, _STALLED_MS = 5_000, 10_000


class FrameStream:
    """Publishes frames, with the truth in the header on request; a context manager.

    `where` is ``zmq://HOST:PORT``, or ``zmq://PORT`` on this computer only. Raises ConfigError if the address is not
    valid or in use, or pyzmq is not installed.
    """

    def __init__(self, where: str, *, with_truth: bool = False) -> None:
        zmq = _library()
        self._with_truth = with_truth
        settings = {zmq.SNDHWM: _WAITING, zmq.TCP_MAXRT: _STALLED_MS, zmq.MAXMSGSIZE: _LARGEST_SUBSCRIPTION}
        self._socket, self._connections = _bound(where, zmq.PUB, "--latest-frame", settings)

    def write(self, pixels: NDArray[Any], truth: bytes, nav: dict[str, Any]) -> None:
        """Send a frame to all who are subscribed.

        `pixels` (height, width) uint8 or uint16; `truth`: the line of ``truth.jsonl``; `nav`: the record of the
        navigator.
        """
        header = {
            "schema": FRAME_SCHEMA,
            "frame": nav["frame"],
            "utc": nav["utc"],
            "shape": list(pixels.shape),
            "dtype": pixels.dtype.name,
            "nav": nav,
            "sent_unix_s": time.time(),
        }
        if self._with_truth:
            header["truth"] = orjson.Fragment(truth.rstrip())
        content = np.ascontiguousarray(pixels, dtype=pixels.dtype.newbyteorder("<")).tobytes()
        self._socket.send_multipart([orjson.dumps(header), content])

    def close(self) -> None:
        """Send what waits, for a second at most, and close the socket."""
        self._connections.end()
        self._socket.close(linger=_LINGER_MS)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


class AnswerReceiver:
    """Receives the answers of navigators as JSON lines; used from one thread.

    `where` is ``zmq://HOST:PORT``, or ``zmq://PORT`` on this computer only. Raises ConfigError if the address is not
    valid or in use, or pyzmq is not installed.
    """

    def __init__(self, where: str) -> None:
        zmq = _library()
        settings = {zmq.MAXMSGSIZE: LARGEST_MESSAGE, zmq.RCVHWM: _WAITING_ANSWERS}
        self._socket, self._connections = _bound(where, zmq.PULL, "--answers", settings)

    def lines(self, timeout_s: float) -> list[str]:
        """Return the lines of the next message; none if nothing arrives within `timeout_s`."""
        if not self._socket.poll(round(timeout_s * 1e3)):
            return []
        return bytes(self._socket.recv()).decode("utf-8", errors="replace").splitlines()

    def close(self) -> None:
        """Close the socket."""
        self._connections.end()
        self._socket.close(linger=0)


def send_answers(where: str, lines: list[str], timeout_s: float) -> None:
    """Send JSON lines, as `glstar.score` reads them, to ``glstar live --answers zmq://...``.

    `where` is ``zmq://HOST:PORT``, or ``zmq://PORT`` on this computer; the receiver has `timeout_s` to appear. Raises
    ConfigError if the address is not valid, nobody receives there, or pyzmq is not installed.
    """
    zmq, address = _library(), _address(where, "answer")
    sender = zmq.Context.instance().socket(zmq.PUSH)
    try:
        # Only to a receiver that is there: an answer must not wait for one and arrive too late.
        sender.setsockopt(zmq.IMMEDIATE, 1)
        sender.connect(address)
        for line in lines:
            if not sender.poll(round(timeout_s * 1e3), zmq.POLLOUT):
                raise ConfigError(
                    f"nobody receives answers at {where}; start glstar live ... --inject --answers {where}"
                )
            sender.send(line.encode())
    finally:
        sender.close(linger=_LINGER_MS)


class _Connections:
    """Closes connections to a bound socket beyond `MOST_CONNECTIONS`, on a thread of its own."""

    def __init__(self, bound: Any) -> None:
        zmq = _library()
        self._accepted, self._ended = zmq.EVENT_ACCEPTED, {zmq.EVENT_DISCONNECTED, zmq.EVENT_CLOSED}
        self._events = bound.get_monitor_socket()
        self._bound, self._port = bound, int(bound.getsockopt_string(zmq.LAST_ENDPOINT).rpartition(":")[2])
        self._ending = Event()
        self._thread = Thread(target=self._run, name="glstar-connections", daemon=True)
        self._thread.start()

    def end(self) -> None:
        """End the thread; a second call does nothing."""
        if not self._ending.is_set():
            self._ending.set()
            self._thread.join()
            self._bound.disable_monitor()
            self._events.close(linger=0)

    def _run(self) -> None:
        from zmq.utils.monitor import recv_monitor_message  # noqa: PLC0415 - an extra

        handles: set[int] = set()
        while not self._ending.is_set():
            if not self._events.poll(_POLL_MS):
                continue
            event = recv_monitor_message(self._events)
            if event["event"] == self._accepted:
                if len(handles) < MOST_CONNECTIONS:
                    handles.add(event["value"])
                else:
                    self._shut(event["value"])
            elif event["event"] in self._ended:
                handles.discard(event["value"])

    def _shut(self, handle: int) -> None:
        """Shut a connection, which ZeroMQ then closes: the number may belong to a later one by now, or to none."""
        with suppress(OSError), socket.socket(fileno=os.dup(handle)) as connection:
            if connection.getsockname()[1] == self._port:
                connection.shutdown(socket.SHUT_RDWR)


def _bound(where: str, kind: int, option: str, settings: Mapping[int, int]) -> tuple[Any, _Connections]:
    """Return a socket with options of ZeroMQ that is bound to an address, and what limits its connections."""
    zmq, address = _library(), _address(where, option)
    bound = zmq.Context.instance().socket(kind)
    for name, value in {zmq.HANDSHAKE_IVL: _HANDSHAKE_MS, zmq.IPV6: int("[" in address), **settings}.items():
        bound.setsockopt(name, value)
    try:
        bound.bind(address)
    except zmq.ZMQError as error:
        bound.close(linger=0)
        raise ConfigError(f"{option} {where} cannot be opened: {error}") from error
    return bound, _Connections(bound)


def _address(where: str, option: str) -> str:
    """Return the address that ZeroMQ takes."""
    parts = _ADDRESS.fullmatch(where)
    if parts is None or not 0 < int(parts[2]) < 65536:
        raise ConfigError(f"{option} {where} is no address; write zmq://HOST:PORT, or zmq://PORT for this computer")
    return f"tcp://{parts[1] or _LOOPBACK}:{parts[2]}"


def _library() -> ModuleType:
    try:
        import zmq  # noqa: PLC0415 - an extra
    except ImportError as error:
        raise ConfigError(f"zmq:// needs pyzmq: {install_command('stream')}") from error
    return zmq
