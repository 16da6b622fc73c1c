"""Outputs of live frames around sockets, encoders and devices made by hand."""

import json
from collections import deque
from fractions import Fraction
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import zmq

from glstar.config import Config
from glstar.errors import ExportError
from glstar.export.publish import outputs, stream, videostream
from glstar.export.publish.foxgloveserver import FoxgloveServer
from glstar.export.publish.latest import LatestFrameWriter
from glstar.export.publish.outputs import FrameOutputs, MjpegServer, VideoDevice, _host_of, open_frame_output
from glstar.export.publish.stream import AnswerReceiver, FrameStream, _Gate, host_and_port
from glstar.export.publish.videostream import RtpAddress, VideoStream
from glstar.sky.place.timescale import format_utc

CAMERA = Config().override(**{"camera.width_px": 7, "camera.height_px": 5, "camera.fx_px": 60.0, "camera.fy_px": 60.0})
PIXELS = np.arange(35, dtype=np.uint8).reshape(5, 7)
UTC_S = 1_710_068_400.0


def test_which_outputs_need_what_the_aircraft_knows() -> None:
    assert FrameStream.needs_nav
    assert MjpegServer.needs_nav
    assert VideoStream.needs_nav
    assert not FoxgloveServer.needs_nav
    assert not VideoDevice.needs_nav
    assert not LatestFrameWriter.needs_nav
    with_nav, without = SimpleNamespace(needs_nav=True), SimpleNamespace(needs_nav=False)
    assert FrameOutputs([without, with_nav]).needs_nav  # type: ignore[list-item]
    assert not FrameOutputs([without, without]).needs_nav  # type: ignore[list-item]


def test_the_name_of_an_output_says_what_it_is(monkeypatch: pytest.MonkeyPatch) -> None:
    made: list[Any] = []
    for name in ("FrameStream", "MjpegServer", "VideoDevice", "LatestFrameWriter"):
        monkeypatch.setattr(outputs, name, lambda *parts, name=name, **options: made.append((name, parts, options)))
    camera, sensor = CAMERA.camera(), CAMERA.sensor()

    for where in ("zmq://5555", "http://8080", "video:/dev/video10", "shm:glstar", "latest"):
        open_frame_output(where, camera, sensor, interval_s=0.25)
    open_frame_output("zmq://5555", camera, sensor, interval_s=0.25, summed=3, with_truth=True)
    open_frame_output("http://8080", camera, sensor, interval_s=0.25, summed=3)
    open_frame_output("video:", camera, sensor, interval_s=0.25, summed=3)

    assert made == [
        ("FrameStream", ("zmq://5555",), {"with_truth": False}),
        ("MjpegServer", ("http://8080", sensor), {"summed": 1}),
        ("VideoDevice", ("video:/dev/video10", camera, sensor), {"frames_per_s": 4.0, "summed": 1}),
        ("LatestFrameWriter", ("shm:glstar", 35), {}),
        ("LatestFrameWriter", ("latest", 35), {}),
        ("FrameStream", ("zmq://5555",), {"with_truth": True}),
        ("MjpegServer", ("http://8080", sensor), {"summed": 3}),
        ("VideoDevice", ("video:", camera, sensor), {"frames_per_s": 4.0, "summed": 3}),
    ]


@pytest.mark.parametrize(
    ("named", "host"),
    [
        (" LocalHost:8080 ", "localhost"),
        ("glstar.local", "glstar.local"),
        ("[::1]:8080", "::1"),
        ("[::1]", "::1"),
        ("::1", "::1"),
        ("10.0.0.9:80", "10.0.0.9"),
    ],
)
def test_the_host_of_a_request_is_without_its_port(named: str, host: str) -> None:
    assert _host_of(named) == host


@pytest.mark.parametrize(
    ("where", "expected"),
    [
        ("zmq://5555", ("127.0.0.1", 5555)),
        ("zmq://10.0.0.9:1", ("10.0.0.9", 1)),
        ("zmq://[fe80::1]:65535", ("[fe80::1]", 65535)),
        ("zmq://0", None),
        ("zmq://65536", None),
        ("http://5555", None),
        ("5555", None),
    ],
)
def test_an_address_has_a_host_and_a_port(where: str, expected: tuple[str, int] | None) -> None:
    assert host_and_port(where, "zmq://") == expected


# --- ZeroMQ -----------------------------------------------------------------------------------------------------------


class Socket:
    """A socket that records what is sent, and receives what is waiting."""

    def __init__(self, *waiting: bytes) -> None:
        self.sent: list[list[bytes]] = []
        self.polled_ms: list[int] = []
        self.waiting = deque(waiting)

    def send_multipart(self, parts: list[bytes]) -> None:
        self.sent.append(parts)

    def poll(self, timeout_ms: int) -> bool:
        self.polled_ms.append(timeout_ms)
        return bool(self.waiting)

    def recv(self) -> bytes:
        return self.waiting.popleft()


class Bound:
    def __init__(self, socket: Socket, made: list[Any], *parts: Any) -> None:
        self.socket = socket
        made.append(parts)

    def close(self, *, linger_ms: int) -> None:
        self.socket.sent.append([b"closed", str(linger_ms).encode()])


def test_a_frame_has_its_header_and_its_pixels_and_the_truth_on_request(monkeypatch: pytest.MonkeyPatch) -> None:
    socket, made = Socket(), list[Any]()
    monkeypatch.setattr(stream, "_BoundSocket", lambda *parts: Bound(socket, made, *parts))
    monkeypatch.setattr(stream.time, "time", lambda: 1234.5)
    nav = {"frame": 7, "utc": {"start": "T"}, "rates": None}
    deep = np.array([[1, 258, 3], [4, 5, 6]], dtype=">u2")

    with FrameStream("zmq://5555") as plain:
        plain.write(deep, b'{"frame": 7}\n', nav)
    FrameStream("zmq://5555", with_truth=True).write(PIXELS, b'{"frame": 7}\n', nav)

    header, content = socket.sent[0]
    assert json.loads(header) == {
        "schema": "glstar-frame-1",
        "frame": 7,
        "utc": {"start": "T"},
        "shape": [2, 3],
        "dtype": "uint16",
        "nav": nav,
        "sent_unix_s": 1234.5,
    }
    assert content == bytes([1, 0, 2, 1, 3, 0, 4, 0, 5, 0, 6, 0])
    assert socket.sent[1] == [b"closed", b"1000"]
    header, content = socket.sent[2]
    assert json.loads(header)["truth"] == {"frame": 7}
    assert content == bytes(range(35))
    settings = {zmq.SNDHWM: 2, zmq.TCP_MAXRT: 10_000, zmq.MAXMSGSIZE: 1000}
    assert made == [("zmq://5555", zmq.PUB, "--latest-frame", settings)] * 2


def test_the_lines_of_a_message_are_answers(monkeypatch: pytest.MonkeyPatch) -> None:
    whole, long = "\n".join("a" * 1000).encode(), "\n".join("a" * 1001).encode()
    socket, made = Socket(b"one\ntwo", b"\xff\xfe\xff", whole, long), list[Any]()
    monkeypatch.setattr(stream, "_BoundSocket", lambda *parts: Bound(socket, made, *parts))
    receiver = AnswerReceiver("zmq://5555")

    assert receiver.lines(0.25) == ["one", "two"]
    assert receiver.lines(0.25) == ["3 bytes that are no text"]
    assert receiver.lines(0.25) == ["a"] * 1000
    assert receiver.lines(0.25) == ["1001 lines in one message, of at most 1000"]
    assert receiver.lines(1.5) == []
    assert socket.polled_ms == [250, 250, 250, 250, 1500]
    receiver.close()
    assert socket.sent == [[b"closed", b"0"]]
    assert made == [("zmq://5555", zmq.PULL, "--answers", {zmq.MAXMSGSIZE: 1_000_000, zmq.RCVHWM: 1})]


@pytest.fixture
def gate(monkeypatch: pytest.MonkeyPatch) -> tuple[_Gate, list[float]]:
    """Return a gate without sockets, and the time of its clock, s."""
    gate, now_s = object.__new__(_Gate), [100.0]
    gate._zmq, gate._established, gate._introducing_s, gate._has_failed = zmq, 0, deque(), False
    monkeypatch.setattr(stream.time, "monotonic", lambda: now_s[0])
    return gate, now_s


def follow(gate: _Gate, event: int, monkeypatch: pytest.MonkeyPatch) -> None:
    gate._events = None
    monkeypatch.setattr("zmq.utils.monitor.recv_monitor_message", lambda _: {"event": event})
    gate._follow()


def test_eight_connections_are_admitted_until_one_ends_or_has_not_introduced_itself_for_five_seconds(
    gate: tuple[_Gate, list[float]], monkeypatch: pytest.MonkeyPatch
) -> None:
    guard, now_s = gate
    assert [guard._admits() for _ in range(9)] == [True] * 8 + [False]
    now_s[0] = 104.9
    assert not guard._admits()
    now_s[0] = 105.1  # none of the eight has introduced itself
    assert guard._admits()
    follow(guard, zmq.EVENT_HANDSHAKE_SUCCEEDED, monkeypatch)
    assert (guard._established, len(guard._introducing_s)) == (1, 0)
    assert [guard._admits() for _ in range(8)] == [True] * 7 + [False]
    # One fails to introduce itself: its end is none of an established connection.
    follow(guard, zmq.EVENT_HANDSHAKE_FAILED_NO_DETAIL, monkeypatch)
    follow(guard, zmq.EVENT_DISCONNECTED, monkeypatch)
    assert guard._established == 1
    follow(guard, zmq.EVENT_DISCONNECTED, monkeypatch)
    assert guard._established == 0
    assert [guard._admits() for _ in range(2)] == [True, False]


# --- video ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("host", "family"), [("10.0.0.9", "IP4"), ("fe80::1", "IP6")])
def test_the_description_of_a_session_is_that_of_h264(host: str, family: str) -> None:
    where = f"rtp://[{host}]:5000" if ":" in host else f"rtp://{host}:5000"
    assert RtpAddress.parse(where).sdp.split("\r\n") == [
        "v=0",
        f"o=- 0 0 IN {family} {host}",
        "s=glstar",
        f"c=IN {family} {host}",
        "t=0 0",
        "m=video 5000 RTP/AVP 96",
        "a=rtpmap:96 H264/90000",
        "a=fmtp:96 packetization-mode=1",
        "",
    ]


class Encoder:
    """PyAV of this test: records what is opened and encoded."""

    FFmpegError = OSError

    def __init__(self) -> None:
        self.opened: list[Any] = []
        self.ticks: list[Any] = []
        self.shapes: list[Any] = []
        self.metadata: dict[str, str] = {}
        self.codec_context = SimpleNamespace()
        self.VideoFrame = SimpleNamespace(from_ndarray=self._picture)
        self.closed = 0

    def _picture(self, pixels: Any) -> SimpleNamespace:
        self.shapes.append(pixels.shape)
        return SimpleNamespace()

    def open(self, where: str, mode: str, **options: Any) -> "Encoder":
        self.opened.append((where, mode, options))
        return self

    def add_stream(self, codec: str, **options: Any) -> "Encoder":
        self.opened.append((codec, options))
        return self

    def encode(self, picture: Any) -> Any:
        return picture

    def mux(self, picture: Any) -> None:
        self.ticks.append(None if picture is None else (picture.pts, picture.time_base))

    def close(self) -> None:
        self.closed += 1


def nav(utc_s: float) -> dict[str, Any]:
    return {"utc": {"start": format_utc(utc_s)}}


@pytest.fixture
def encoder(monkeypatch: pytest.MonkeyPatch) -> Encoder:
    encoder = Encoder()
    monkeypatch.setattr(videostream, "_library", lambda: encoder)
    return encoder


@pytest.mark.parametrize(
    ("where", "url"),
    [
        ("rtp://5004", "rtp://127.0.0.1:5004?pkt_size=1200&localaddr=127.0.0.1"),
        ("rtp://10.0.0.9", "rtp://10.0.0.9:5600?pkt_size=1200"),
        ("rtp://[fe80::1]:5004", "rtp://[fe80::1]:5004?pkt_size=1200"),
    ],
)
def test_a_video_is_sent_with_the_utc_of_its_first_frame(where: str, url: str, encoder: Encoder) -> None:
    with VideoStream(where, CAMERA.camera(), CAMERA.sensor(), interval_s=0.4) as video:
        video.write(PIXELS, b"", nav(UTC_S + 0.2504))

    options = {"payload_type": "96", "start_time_realtime": "1710068400250000"}
    encoding = {"preset": "ultrafast", "tune": "zerolatency", "profile": "baseline", "crf": "18"}
    assert encoder.opened == [
        (url, "w", {"format": "rtp", "options": options}),
        ("libx264", {"rate": Fraction(5, 2), "options": encoding}),
    ]
    assert encoder.shapes == [(4, 6, 3)]
    assert (encoder.width, encoder.height, encoder.pix_fmt) == (6, 4, "yuv420p")  # type: ignore[attr-defined]
    assert encoder.codec_context.time_base == Fraction(1, 90_000)
    assert encoder.codec_context.gop_size == 2  # 1 s of 0.4 s
    assert encoder.ticks == [(36, Fraction(1, 90_000)), None]  # 0.4 ms after the millisecond in which it began
    assert encoder.closed == 1


def test_time_stamps_are_those_of_the_exposures_and_rise_where_the_clock_is_set_back(
    encoder: Encoder, tmp_path: Path
) -> None:
    path = tmp_path / "live.ts"
    video = VideoStream(str(path), CAMERA.camera(), CAMERA.sensor(), interval_s=3.0)
    for after_s in (0.0, 0.5, 2.0, -10.0, -9.5, -7.0):
        video.write(PIXELS, b"", nav(UTC_S + after_s))
    video.close()
    video.close()

    # The fourth frame is an interval after the third, and those after it follow it by their own times.
    seconds = [0.0, 0.5, 2.0, 5.0, 5.5, 8.0]
    assert encoder.ticks == [*((round(90_000 * second), Fraction(1, 90_000)) for second in seconds), None]
    assert encoder.opened[0] == (str(path), "w", {"format": "mpegts"})
    assert encoder.metadata == {"service_provider": "glstar", "service_name": f"from {format_utc(UTC_S)}"}
    assert (encoder.codec_context.gop_size, encoder.closed) == (1, 1)
    assert path.exists()
    with pytest.raises(ExportError, match="is there already; write the video to another file"):
        VideoStream(str(path), CAMERA.camera(), CAMERA.sensor(), interval_s=3.0)


def test_a_video_without_frames_leaves_no_file_and_a_removed_file_is_no_error(encoder: Encoder, tmp_path: Path) -> None:
    for is_removed in (False, True):
        path = tmp_path / "live.ts"
        video = VideoStream(str(path), CAMERA.camera(), CAMERA.sensor(), interval_s=0.4)
        assert path.exists()
        if is_removed:
            path.unlink()
        video.close()
        assert not path.exists()
    VideoStream("rtp://5004", CAMERA.camera(), CAMERA.sensor(), interval_s=0.4).close()
    slow = VideoStream("rtp://5004", CAMERA.camera(), CAMERA.sensor(), interval_s=5000.0)
    slow.write(PIXELS, b"", nav(UTC_S))
    assert encoder.opened[1][1]["rate"] == Fraction(1, 1000)  # the slowest
    assert encoder.closed == 0
