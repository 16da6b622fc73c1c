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

import re
import time
from collections import deque
from collections.abc import Mapping
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
_ADDRESS = re.compile(r"(?:(\[[0-9a-fA-F:]+\]|[^:/\[\]]+):)?(\d{1,5})/?")
# Servers are for programs on this computer unless a host is named.
LOOPBACK = "127.0.0.1"
# Frames that wait for a slow subscriber before further ones are dropped.
_WAITING = 2
# Interval at which the end is looked for, ms.
_POLL_MS = 100
# Time to send what waits when a socket is closed, ms.
_LINGER_MS = 1000
# Largest message with answers, bytes: a connection that sends a larger one is closed.
LARGEST_MESSAGE = 1_000_000
# Most lines of a message with answers.
_MOST_LINES = 1_000
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

    needs_nav = True

    def __init__(self, where: str, *, with_truth: bool = False) -> None:
        zmq = _library()
        self._with_truth = with_truth
        settings = {zmq.SNDHWM: _WAITING, zmq.TCP_MAXRT: _STALLED_MS, zmq.MAXMSGSIZE: _LARGEST_SUBSCRIPTION}
        self._bound = _BoundSocket(where, zmq.PUB, "--latest-frame", settings)

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
        self._bound.socket.send_multipart([orjson.dumps(header), content])

    def close(self) -> None:
        """Send what waits, for a second at most, and close the socket."""
        self._bound.close(linger_ms=_LINGER_MS)

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
        self._bound = _BoundSocket(where, zmq.PULL, "--answers", settings)

    def lines(self, timeout_s: float) -> list[str]:
        """Return the lines of the next message; none if nothing arrives within `timeout_s`.

        A message that is no text, or has too many lines, is one line, which is no answer.
        """
        if not self._bound.socket.poll(round(timeout_s * 1e3)):
            return []
        content = bytes(self._bound.socket.recv())
        try:
            lines = content.decode().split("\n")
        except UnicodeDecodeError:
            return [f"{len(content)} bytes that are no text"]
        return lines if len(lines) <= _MOST_LINES else [f"{len(lines)} lines in one message, of at most {_MOST_LINES}"]

    def close(self) -> None:
        """Close the socket."""
        self._bound.close(linger_ms=0)


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


class _Gate:
    """Admits `MOST_CONNECTIONS` at a time to a socket, on a thread of its own, by ZeroMQ's authentication protocol.

    https://rfc.zeromq.org/spec/27: before a connection may send, ZeroMQ asks the socket ``inproc://zeromq.zap.01`` of
    its context; one that is refused is closed after the time to introduce itself.
    """

    def __init__(self, guarded: Any) -> None:
        zmq = _library()
        self._zmq = zmq
        guarded.setsockopt(zmq.ZAP_DOMAIN, b"glstar")
        self._requests = guarded.context.socket(zmq.REP)
        self._requests.bind("inproc://zeromq.zap.01")
        failures = zmq.EVENT_HANDSHAKE_FAILED_NO_DETAIL | zmq.EVENT_HANDSHAKE_FAILED_PROTOCOL
        wanted = zmq.EVENT_HANDSHAKE_SUCCEEDED | failures | zmq.EVENT_DISCONNECTED
        self._events = guarded.get_monitor_socket(wanted)
        self._guarded = guarded
        # Number of connections, and until when others that were admitted may introduce themselves, s.
        self._established = 0
        self._introducing_s: deque[float] = deque()
        # Whether the next end of a connection is of one that has not introduced itself.
        self._has_failed = False
        self._ending = Event()
        self._thread = Thread(target=self._run, name="glstar-gate", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """End the thread and close its sockets; a second call does nothing."""
        if not self._ending.is_set():
            self._ending.set()
            self._thread.join()
            self._guarded.disable_monitor()
            self._events.close(linger=0)
            self._requests.close(linger=0)

    def _run(self) -> None:
        poller = self._zmq.Poller()
        poller.register(self._events)
        poller.register(self._requests)
        while not self._ending.is_set():
            ready = dict(poller.poll(_POLL_MS))
            while ready and self._events.poll(0):
                self._follow()
            if self._requests in ready:
                version, number, *_ = self._requests.recv_multipart()
                status, text = (b"200", b"") if self._admits() else (b"300", b"too many connections")
                self._requests.send_multipart([version, number, status, text, b"", b""])

    def _follow(self) -> None:
        """Take an event of the socket."""
        from zmq.utils.monitor import recv_monitor_message  # noqa: PLC0415 - an extra

        event = recv_monitor_message(self._events)["event"]
        if event == self._zmq.EVENT_HANDSHAKE_SUCCEEDED:
            self._established += 1
            if self._introducing_s:
                self._introducing_s.popleft()
        elif event == self._zmq.EVENT_DISCONNECTED:
            self._established -= not self._has_failed
            self._has_failed = False
        else:
            self._has_failed = True

    def _admits(self) -> bool:
        """Return whether another connection may be admitted, and count it."""
        now_s = time.monotonic()
        while self._introducing_s and self._introducing_s[0] < now_s:
            self._introducing_s.popleft()
        if self._established + len(self._introducing_s) >= MOST_CONNECTIONS:
            return False
        self._introducing_s.append(now_s + _HANDSHAKE_MS / 1e3)
        return True


class _BoundSocket:
    """A socket of ZeroMQ that is bound to an address, in a context of its own, with a limit of connections.

    Raises ConfigError if the address is not valid or in use.
    """

    def __init__(self, where: str, kind: int, option: str, settings: Mapping[int, int]) -> None:
        zmq, address = _library(), _address(where, option)
        self._context = zmq.Context()
        self.socket = self._context.socket(kind)
        for name, value in {zmq.HANDSHAKE_IVL: _HANDSHAKE_MS, zmq.IPV6: int("[" in address), **settings}.items():
            self.socket.setsockopt(name, value)
        self._gate = _Gate(self.socket)
        try:
            self.socket.bind(address)
        except zmq.ZMQError as error:
            self.close(linger_ms=0)
            raise ConfigError(f"{option} {where} cannot be opened: {error}") from error

    def close(self, *, linger_ms: int) -> None:
        """Send what waits, for a time, and close the socket; a second call does nothing."""
        self._gate.close()
        self.socket.close(linger=linger_ms)
        self._context.term()


def _address(where: str, option: str) -> str:
    """Return the address that ZeroMQ takes."""
    address = host_and_port(where, STREAM)
    if address is None:
        raise ConfigError(f"{option} {where} is no address; write zmq://HOST:PORT, or zmq://PORT for this computer")
    return "tcp://{}:{}".format(*address)


def host_and_port(where: str, scheme: str) -> tuple[str, int] | None:
    """Return the host and the port of ``PORT`` or ``HOST:PORT`` after a scheme; None if they are not valid.

    Numbers of IPv6 keep their brackets; without a host it is this computer.
    """
    parts = _ADDRESS.fullmatch(where.removeprefix(scheme)) if where.startswith(scheme) else None
    if parts is None or not 0 < int(parts[2]) < 65536:
        return None
    return parts[1] or LOOPBACK, int(parts[2])


def _library() -> ModuleType:
    try:
        import zmq  # noqa: PLC0415 - an extra
    except ImportError as error:
        raise ConfigError(f"zmq:// needs pyzmq: {install_command('stream')}") from error
    return zmq
