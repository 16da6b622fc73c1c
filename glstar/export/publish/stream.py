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
from collections.abc import Mapping
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
# Time to send what waits when a socket is closed, ms.
_LINGER_MS = 1000
# Largest message with answers, bytes: a connection that sends a larger one is closed.
_LARGEST_MESSAGE = 4_000_000


class FrameStream:
    """Publishes frames, with the truth in the header on request; a context manager.

    `where` is ``zmq://HOST:PORT``, or ``zmq://PORT`` on this computer only. Raises ConfigError if the address is not
    valid or in use, or pyzmq is not installed.
    """

    def __init__(self, where: str, *, with_truth: bool = False) -> None:
        zmq = _library()
        self._with_truth = with_truth
        self._socket = _bound(where, zmq.PUB, "--latest-frame", {zmq.SNDHWM: _WAITING})

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
        self._socket = _bound(where, zmq.PULL, "--answers", {zmq.MAXMSGSIZE: _LARGEST_MESSAGE})

    def lines(self, timeout_s: float) -> list[str]:
        """Return the lines of the next message; none if nothing arrives within `timeout_s`."""
        if not self._socket.poll(round(timeout_s * 1e3)):
            return []
        return bytes(self._socket.recv()).decode("utf-8", errors="replace").splitlines()

    def close(self) -> None:
        """Close the socket."""
        self._socket.close(linger=0)


def send_answers(where: str, lines: list[str], timeout_s: float) -> None:
    """Send JSON lines, as `glstar.score` reads them, to ``glstar live --answers zmq://...``.

    `where` is ``zmq://HOST:PORT``, or ``zmq://PORT`` on this computer; the receiver has `timeout_s` to appear. Raises
    ConfigError if the address is not valid, nobody receives there, or pyzmq is not installed.
    """
    zmq, address = _library(), _address(where, "answer")
    socket = zmq.Context.instance().socket(zmq.PUSH)
    try:
        # Only to a receiver that is there: an answer must not wait for one and arrive too late.
        socket.setsockopt(zmq.IMMEDIATE, 1)
        socket.connect(address)
        for line in lines:
            if not socket.poll(round(timeout_s * 1e3), zmq.POLLOUT):
                raise ConfigError(
                    f"nobody receives answers at {where}; start glstar live ... --inject --answers {where}"
                )
            socket.send(line.encode())
    finally:
        socket.close(linger=_LINGER_MS)


def _bound(where: str, kind: int, option: str, settings: Mapping[int, int]) -> Any:
    """Return a socket with options of ZeroMQ that is bound to an address."""
    zmq, address = _library(), _address(where, option)
    socket = zmq.Context.instance().socket(kind)
    for name, value in settings.items():
        socket.setsockopt(name, value)
    try:
        socket.bind(address)
    except zmq.ZMQError as error:
        socket.close(linger=0)
        raise ConfigError(f"{option} {where} cannot be opened: {error}") from error
    return socket


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
