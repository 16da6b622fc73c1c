"""Where frames go while they are drawn, besides files: other processes, a browser, a video device.

``cv2.VideoCapture("http://127.0.0.1:8090")`` reads the MJPEG stream of ``glstar live LINK --latest-frame
http://127.0.0.1:8090``; ``/frame.jpg`` is the latest frame alone. Each part of the stream has the start of its exposure
by the clock of the navigator, in seconds since 1970, in the header ``X-Timestamp``.

A virtual video device is a camera with a number or path. On Linux it belongs to the kernel module v4l2loopback, on
Windows and macOS to OBS.
"""

import io
import select
import socket
import time
from collections.abc import Sequence
from contextlib import ExitStack, suppress
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from socketserver import TCPServer
from threading import BoundedSemaphore, Condition, Thread
from typing import Any, Protocol, Self

import cv2
import numpy as np
from numpy.typing import NDArray

from glstar.camera.model import Camera
from glstar.camera.sensor.sensor import Sensor
from glstar.errors import ConfigError
from glstar.export.imagefiles.processing import CameraProcessing, encode_jpeg, shown_as_8_bits
from glstar.export.publish.latest import LatestFrameWriter
from glstar.export.publish.stream import LOOPBACK, STREAM, FrameStream, host_and_port
from glstar.sky.place.timescale import parse_utc
from glstar.system.installation import install_command

HTTP = "http://"
_BOUNDARY = "glstar-frame"
# Interval at which the thread of a waiting client checks if the server or the client has ended, s.
_POLL_INTERVAL_S = 0.25
# Clients at a time; further ones are refused.
MOST_CLIENTS = 16
# Time for a client to send its request, and to take a frame, s.
_REQUEST_TIMEOUT_S, _FRAME_TIMEOUT_S = 5.0, 10.0
# Largest request, bytes.
_LARGEST_REQUEST = 8192
_BUSY = b"HTTP/1.0 503 Service Unavailable\r\nContent-Length: 0\r\nConnection: close\r\n\r\n"


class MjpegServer:
    """Serves frames as they are drawn; a context manager. A client that is slower than the frames misses some.

    `where` is ``http://HOST:PORT``, or ``http://PORT`` on this computer only. There are 16 clients at most. Each has 5
    s to send a request, 10 s to take a frame, and names this server in the header Host, which foreign web pages do not.
    Frames are processed by ``[output]`` of
    the sensor, otherwise its saturation is white; `summed` is the number of short exposures whose sum a frame is.
    Raises ConfigError if the address is not valid or in use.
    """

    needs_nav = True

    def __init__(self, where: str, sensor: Sensor, *, summed: int = 1) -> None:
        self._sensor, self._summed, self._quality = sensor, summed, CameraProcessing.of(sensor).jpeg_quality
        self._latest = _Latest()
        host, port = _address(where)
        try:
            self._server = _Server((host, port), _FrameClient, self._latest)
        except OSError as error:
            raise ConfigError(f"{where} cannot be opened ({error.strerror})") from error
        self._thread = Thread(target=self._server.serve_forever, name="glstar-mjpeg", daemon=True)
        self._thread.start()

    def write(self, pixels: NDArray[Any], _truth: bytes, nav: dict[str, Any]) -> None:
        """Send a frame to all clients.

        `pixels` (height, width) uint8 or uint16; `nav`: the record of the navigator, for the UTC of its clock.
        """
        start_s = parse_utc(nav["utc"]["start"])
        self._latest.set(
            encode_jpeg(shown_as_8_bits(pixels, self._sensor, summed=self._summed), self._quality), start_s
        )

    def close(self) -> None:
        """End all streams; a second call does nothing."""
        self._latest.end()
        self._server.shutdown()
        self._server.server_close()
        self._thread.join()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


class _Latest:
    """The latest JPEG, for which any number of threads can wait."""

    def __init__(self) -> None:
        self._changed = Condition()
        self._number, self._jpeg, self._utc_s = 0, b"", 0.0
        self.has_ended = False

    def set(self, jpeg: bytes, utc_s: float) -> None:
        with self._changed:
            self._number, self._jpeg, self._utc_s = self._number + 1, jpeg, utc_s
            self._changed.notify_all()

    def end(self) -> None:
        with self._changed:
            self.has_ended = True
            self._changed.notify_all()

    def after(self, number: int) -> tuple[int, bytes, float] | None:
        """Return the number, content and UTC of a frame later than a number; None after a while without one."""
        with self._changed:
            self._changed.wait_for(lambda: self.has_ended or self._number > number, _POLL_INTERVAL_S)
            return (self._number, self._jpeg, self._utc_s) if self._number > number else None


class _Server(ThreadingHTTPServer):
    daemon_threads = True
    request_queue_size = 64

    def __init__(self, address: tuple[str, int], client: "type[_Client]", latest: _Latest, page: bytes = b"") -> None:
        self.latest, self.page, self.named = latest, page, address[0].lower()
        self._places = BoundedSemaphore(MOST_CLIENTS)
        self.address_family = socket.AF_INET6 if ":" in address[0] else socket.AF_INET
        super().__init__(address, client)

    def server_bind(self) -> None:
        """Bind the socket, without the library's search for its name in the network."""
        TCPServer.server_bind(self)
        self.server_name, self.server_port = str(self.server_address[0]), int(self.server_address[1])

    def process_request(self, request: Any, client_address: Any) -> None:
        """Serve a client on a thread of its own, or refuse it."""
        if self._places.acquire(blocking=False):
            super().process_request(request, client_address)
            return
        with suppress(OSError):
            request.setblocking(False)
            request.send(_BUSY)
        self.shutdown_request(request)

    def process_request_thread(self, request: Any, client_address: Any) -> None:
        """Serve a client."""
        try:
            super().process_request_thread(request, client_address)
        finally:
            self._places.release()

    def handle_error(self, request: Any, client_address: Any) -> None:
        """Print nothing: a client that goes away is no error."""


class _Client(BaseHTTPRequestHandler):
    server: _Server
    timeout = _FRAME_TIMEOUT_S

    def setup(self) -> None:
        """Read the request, of which a client could send one byte a minute, or no end; such a one gets no answer."""
        super().setup()
        until_s, head = time.monotonic() + _REQUEST_TIMEOUT_S, b""
        while b"\r\n\r\n" not in head and b"\n\n" not in head:
            self.connection.settimeout(max(until_s - time.monotonic(), 0.001))
            received = self.connection.recv(_LARGEST_REQUEST)
            if not received or len(head) > _LARGEST_REQUEST:
                head = b""
                break
            head += received
        self.connection.settimeout(_FRAME_TIMEOUT_S)
        self.rfile.close()
        self.rfile = io.BufferedReader(io.BytesIO(head))

    def parse_request(self) -> bool:
        """Parse the request; refuse one that names another host."""
        if not super().parse_request():
            return False
        named = self.headers.get("Host")
        if named is None or _host_of(named) in self._own_names():
            return True
        self.send_error(HTTPStatus.FORBIDDEN, "this server has another name")
        return False

    def _own_names(self) -> set[str]:
        """Return the names of this computer's loopback, of the address of the server, and of the connection."""
        return {"localhost", "127.0.0.1", "::1", self.server.named, str(self.connection.getsockname()[0])}

    def _is_gone(self) -> bool:
        """Return whether the client has closed the connection."""
        ready, _, _ = select.select([self.connection], [], [], 0.0)
        return bool(ready) and not self.connection.recv(1, socket.MSG_PEEK)

    def log_message(self, format: str, *arguments: Any) -> None:  # noqa: A002 - the name in the standard library
        """Print nothing."""


class _FrameClient(_Client):
    def do_GET(self) -> None:
        """Answer a client."""
        if self.path == "/frame.jpg":
            self._send_one()
        elif self.path == "/":
            self._send_stream()
        else:
            self.send_error(HTTPStatus.NOT_FOUND, "the stream is /, the latest frame /frame.jpg")

    def _send_one(self) -> None:
        frame = None
        while frame is None and not self.server.latest.has_ended and not self._is_gone():
            frame = self.server.latest.after(0)
        if frame is not None:
            self.send_response(HTTPStatus.OK)
            self._send_jpeg(*frame[1:])

    def _send_stream(self) -> None:
        self.send_response(HTTPStatus.OK)
        self.send_header("Cache-Control", "no-store")
        self.send_header("Content-Type", f"multipart/x-mixed-replace; boundary={_BOUNDARY}")
        self.end_headers()
        number = 0
        while not self.server.latest.has_ended:
            frame = self.server.latest.after(number)
            if frame is not None:
                number = frame[0]
                self.wfile.write(f"--{_BOUNDARY}\r\n".encode())
                self._send_jpeg(*frame[1:])
                self.wfile.write(b"\r\n")
            elif self._is_gone():
                return

    def _send_jpeg(self, jpeg: bytes, utc_s: float) -> None:
        self.send_header("Content-Type", "image/jpeg")
        self.send_header("Content-Length", str(len(jpeg)))
        self.send_header("X-Timestamp", f"{utc_s:.6f}")
        self.end_headers()
        self.wfile.write(jpeg)


class _PageClient(_Client):
    def do_GET(self) -> None:
        """Answer a client."""
        self.send_response(HTTPStatus.OK)
        self.send_header("Content-Type", "application/xml")
        self.send_header("Content-Length", str(len(self.server.page)))
        self.end_headers()
        self.wfile.write(self.server.page)


class PageServer:
    """Serves one XML document on this computer, under any path, at a port that is free; a context manager."""

    def __init__(self, content: bytes) -> None:
        self._server = _Server((LOOPBACK, 0), _PageClient, _Latest(), content)
        self.address = f"{HTTP}{LOOPBACK}:{self._server.server_port}"
        self._thread = Thread(target=self._server.serve_forever, name="glstar-page", daemon=True)
        self._thread.start()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._server.shutdown()
        self._server.server_close()
        self._thread.join()


def _host_of(named: str) -> str:
    """Return the host of a header Host, without the port."""
    host = named.strip().lower()
    if host.startswith("["):
        return host[1:].partition("]")[0]
    return host.rpartition(":")[0] if host.count(":") == 1 else host


def _address(where: str) -> tuple[str, int]:
    address = host_and_port(where, HTTP)
    if address is None:
        raise ConfigError(f"{where} is no address; write http://HOST:PORT, or http://PORT for this computer")
    return address[0].strip("[]"), address[1]


VIDEO = "video:"


class VideoDevice:
    """Shows frames on a virtual video device; a context manager.

    `where` is ``video:`` for the first device, or ``video:/dev/video10`` for a device on Linux; `frames_per_s` is what
    the device says of its rate. Frames are shown as by `MjpegServer`. Raises ConfigError if pyvirtualcam is not
    installed, or there is no such device.
    """

    needs_nav = False

    def __init__(self, where: str, camera: Camera, sensor: Sensor, *, frames_per_s: float, summed: int = 1) -> None:
        library, device = _library(), where.removeprefix(VIDEO) or None
        self._sensor, self._summed = sensor, summed
        try:
            self._device = library.Camera(camera.width_px, camera.height_px, frames_per_s, device=device)
        except RuntimeError as error:
            reason = " ".join(str(error).split())
            raise ConfigError(
                f"{where} cannot be opened ({reason}); on Linux, make a device: sudo modprobe v4l2loopback"
            ) from error

    def write(self, pixels: NDArray[Any], _truth: bytes, _nav: dict[str, Any]) -> None:
        """Show a frame; `pixels` (height, width) uint8 or uint16."""
        shown = shown_as_8_bits(pixels, self._sensor, summed=self._summed)
        self._device.send(np.ascontiguousarray(shown if shown.ndim == 3 else cv2.cvtColor(shown, cv2.COLOR_GRAY2RGB)))

    def close(self) -> None:
        """Give the device back; a second call does nothing."""
        self._device.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def _library() -> Any:
    try:
        import pyvirtualcam  # noqa: PLC0415 - an extra
    except ImportError as error:
        raise ConfigError(f"video: needs pyvirtualcam: {install_command('video')}") from error
    return pyvirtualcam


class FrameOutput(Protocol):
    """Receives each frame as soon as it is drawn."""

    needs_nav: bool  # Whether `write` needs what the aircraft knows

    def write(self, pixels: NDArray[Any], truth: bytes, nav: dict[str, Any]) -> None:
        """Pass a frame on.

        `pixels` (height, width) uint8 or uint16: raw digital numbers; `truth`: the line of ``truth.jsonl``; `nav`: what
        the aircraft knows: the line of ``nav.jsonl``; empty if the output does not need it.
        """
        ...

    def close(self) -> None:
        """End the output; a second call does nothing."""
        ...


class FrameOutputs:
    """Several outputs as one; `close` ends all of them."""

    def __init__(self, outputs: Sequence[FrameOutput]) -> None:
        self._outputs = tuple(outputs)
        self.needs_nav = any(output.needs_nav for output in self._outputs)

    def write(self, pixels: NDArray[Any], truth: bytes, nav: dict[str, Any]) -> None:
        """Pass a frame on to each, in their order."""
        for output in self._outputs:
            output.write(pixels, truth, nav)

    def close(self) -> None:
        """End each, also if another one fails."""
        with ExitStack() as ending:
            for output in self._outputs:
                ending.callback(output.close)


def open_frame_output(
    where: str, camera: Camera, sensor: Sensor, *, interval_s: float, summed: int = 1, with_truth: bool = False
) -> FrameOutput:
    """Open an output of frames: ``shm:NAME``, a file, ``zmq://HOST:PORT``, ``http://HOST:PORT`` or ``video:DEVICE``.

    `interval_s` is the time between frames, s, and `summed` the number of short exposures whose sum a frame is; with
    `with_truth` ``zmq://`` sends the truth, too. Raises ConfigError if the name is not valid, the address is in use, or
    a library or device is missing; ExportError if another process writes to a name.
    """
    if where.startswith(STREAM):
        return FrameStream(where, with_truth=with_truth)
    if where.startswith(HTTP):
        return MjpegServer(where, sensor, summed=summed)
    if where.startswith(VIDEO):
        return VideoDevice(where, camera, sensor, frames_per_s=1 / interval_s, summed=summed)
    return LatestFrameWriter(where, camera.width_px * camera.height_px)
