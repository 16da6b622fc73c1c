"""Frames as MJPEG over HTTP and on a virtual video device, read as any program would."""

import sys
from collections.abc import Callable
from threading import Event, Thread
from types import SimpleNamespace
from typing import Any, Self
from urllib.error import HTTPError
from urllib.request import urlopen

import cv2
import numpy as np
import pytest
from typer.testing import CliRunner

from glstar.cli import app
from glstar.config import Config
from glstar.errors import ConfigError
from glstar.export.publish.outputs import MjpegServer, open_frame_output
from glstar.sky.place.timescale import parse_utc
from tests.support.autopilot import SMALL, UTC_S, simulated
from tests.support.links import free_port, interrupted_when

FOCAL = {"camera.fx_px": 60.0, "camera.fy_px": 60.0}
UTC = "2024-03-10T11:00:00.250000Z"
NAV = {"utc": {"start": UTC}}
# The navigator's clock is wrong: the true time is not for it.
TRUTH = b'{"utc_start":"2024-03-10T10:59:00.000000Z","camera_utc_start":"2024-03-10T10:59:00.000000Z"}\n'
# A smooth image, which JPEG keeps.
RAMP = np.add.outer(np.arange(48) * 2, np.arange(64)).astype(np.uint8)


def test_opencv_reads_the_stream_as_a_camera() -> None:
    port, ended = free_port(), Event()
    with MjpegServer(f"http://{port}", Config().sensor()) as server:

        def draw() -> None:
            number = 0
            while not ended.wait(0.02):
                number = (number + 1) % 5
                server.write(RAMP + np.uint8(20 * number), TRUTH, NAV)

        drawing = Thread(target=draw)
        drawing.start()
        try:
            camera = cv2.VideoCapture(f"http://127.0.0.1:{port}")
            frames = [camera.read()[1] for _ in range(3)]
            camera.release()
        finally:
            ended.set()
            drawing.join()
    levels = [int(frame[0, 0, 0]) for frame in frames]
    assert len(set(levels)) == 3
    for frame, level in zip(frames, levels, strict=True):
        np.testing.assert_allclose(frame[..., 0].astype(int) - level, RAMP, rtol=0, atol=4)


def test_each_part_has_its_time_and_the_latest_frame_is_a_file() -> None:
    port = free_port()
    with MjpegServer(f"http://127.0.0.1:{port}", Config().sensor()) as server:
        server.write(RAMP, TRUTH, NAV)
        with urlopen(f"http://127.0.0.1:{port}/frame.jpg") as answer:
            content = answer.read()
            assert float(answer.headers["X-Timestamp"]) == pytest.approx(parse_utc(UTC), rel=0, abs=1e-6)
        with urlopen(f"http://127.0.0.1:{port}") as stream:
            head = [stream.readline().strip() for _ in range(5)]
            assert stream.read(len(content)) == content
        with pytest.raises(HTTPError, match="404"):
            urlopen(f"http://127.0.0.1:{port}/other")
    assert head[0] == b"--glstar-frame"
    assert {b"Content-Type: image/jpeg", b"Content-Length: %d" % len(content)} <= set(head)
    shown = cv2.imdecode(np.frombuffer(content, np.uint8), cv2.IMREAD_GRAYSCALE)
    np.testing.assert_allclose(shown, RAMP, rtol=0, atol=3)


def test_saturation_is_white_in_sixteen_bits_and_in_sums() -> None:
    port, sensor = free_port(), Config().override(**{"sensor.bit_depth": 12}).sensor()
    with MjpegServer(f"http://{port}", sensor, summed=2) as server:
        server.write(np.full((48, 64), 4095, np.uint16), TRUTH, NAV)
        with urlopen(f"http://127.0.0.1:{port}/frame.jpg") as answer:
            image = cv2.imdecode(np.frombuffer(answer.read(), np.uint8), cv2.IMREAD_GRAYSCALE)
    assert np.abs(image.astype(int) - 128).max() <= 1


def test_wrong_and_taken_addresses_are_one_clear_line() -> None:
    sensor, port = Config().sensor(), free_port()
    for wrong in ("http://", "http://host", "http://127.0.0.1:70000", "http://127.0.0.1:8090/more"):
        with pytest.raises(ConfigError, match="is no address; write http://HOST:PORT"):
            MjpegServer(wrong, sensor)
    with MjpegServer(f"http://{port}", sensor), pytest.raises(ConfigError, match="cannot be opened"):
        MjpegServer(f"http://{port}", sensor)


class Device:
    """What pyvirtualcam gives, without the kernel's module."""

    made: list[Self] = []  # noqa: RUF012

    def __init__(self, width: int, height: int, fps: float, *, device: str | None) -> None:
        if device == "/dev/video99":
            raise RuntimeError("'v4l2loopback' backend: Device /dev/video99 does not exist.")
        self.about, self.sent, self.closed = (width, height, fps, device), list[Any](), False
        self.made.append(self)

    def send(self, image: Any) -> None:
        self.sent.append(image)

    def close(self) -> None:
        self.closed = True


def test_a_video_device_shows_frames(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "pyvirtualcam", SimpleNamespace(Camera=Device))
    config = Config().override(**{"camera.width_px": 64, "camera.height_px": 48, **FOCAL, "sensor.bit_depth": 12})

    output = open_frame_output("video:/dev/video10", config.camera(), config.sensor(), interval_s=0.5)
    output.write(np.full((48, 64), 2048, np.uint16), TRUTH, NAV)
    output.close()

    (device,) = Device.made
    assert device.about == (64, 48, 2.0, "/dev/video10")
    assert device.closed
    assert device.sent[0].shape == (48, 64, 3)
    assert (device.sent[0] == 128).all()
    with pytest.raises(ConfigError, match=r"video99 does not exist.*sudo modprobe v4l2loopback"):
        open_frame_output("video:/dev/video99", config.camera(), config.sensor(), interval_s=0.5)


def test_without_the_library_the_command_is_said(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "pyvirtualcam", None)
    config = Config()

    with pytest.raises(ConfigError, match=r"needs pyvirtualcam: .*\[video\]"):
        open_frame_output("video:", config.camera(), config.sensor(), interval_s=0.5)


def test_a_live_link_is_a_network_camera(tmp_path: Any) -> None:
    port, out, config, seen = free_port(), free_port(), tmp_path / "small.toml", list[bytes]()
    config.write_text(f"{SMALL}clock_offset_s = 1000.0\n")
    stamps_s = []
    words = f"live udpin:127.0.0.1:{port} --truth sim_state --every 0.2 --exposure 0.2 --duration 60 -c {config}"

    def has_frames() -> bool:
        try:
            with urlopen(f"http://127.0.0.1:{out}/frame.jpg", timeout=5) as answer:
                seen.append(answer.read())
                stamps_s.append(float(answer.headers["X-Timestamp"]))
        except OSError:
            return False
        return len(set(seen)) >= 2

    wanted: Callable[[], bool] = has_frames
    with simulated(port), interrupted_when(wanted):
        result = CliRunner().invoke(app, [*words.split(), "--latest-frame", f"http://{out}", "--json"])
    assert result.exit_code == 0, result.output
    assert cv2.imdecode(np.frombuffer(seen[-1], np.uint8), cv2.IMREAD_GRAYSCALE).shape == (48, 64)
    assert UTC_S + 1000 - 1 < stamps_s[-1] < UTC_S + 1000 + 60
