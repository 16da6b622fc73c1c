"""Foxglove's WebSocket protocol: a client written from its documentation subscribes, and draws the truth."""

import base64
import json
import struct
import sys
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from typer.testing import CliRunner

from glstar.cli import app
from glstar.config import Config
from glstar.errors import ConfigError
from glstar.export.publish.foxgloveserver import FoxgloveServer
from glstar.sky.place.timescale import parse_utc
from tests.support.autopilot import SMALL, lines, simulated
from tests.support.links import free_port, interrupted_when

pytest.importorskip("foxglove", reason="foxglove-sdk is not installed")
client = pytest.importorskip("websockets.sync.client", reason="websockets is not installed")

SCHEMAS = {
    "/camera/image": "foxglove.CompressedImage",
    "/camera/calibration": "foxglove.CameraCalibration",
    "/camera/annotations": "foxglove.ImageAnnotations",
    "/tf": "foxglove.FrameTransforms",
    "/fix": "foxglove.LocationFix",
}


def fields(content: bytes) -> dict[int, list[Any]]:
    """Return the fields of a protobuf message by number: integers, 8 bytes of a double, or bytes."""
    found: dict[int, list[Any]] = {}
    at = 0

    def varint() -> int:
        nonlocal at
        value = shift = 0
        while True:
            byte = content[at]
            at += 1
            value |= (byte & 0x7F) << shift
            shift += 7
            if byte < 0x80:
                return value

    while at < len(content):
        key = varint()
        match key & 7:
            case 0:
                value: Any = varint()
            case 1:
                value, at = struct.unpack_from("<d", content, at)[0], at + 8
            case 2:
                length = varint()
                value, at = content[at : at + length], at + length
            case 5:
                value, at = struct.unpack_from("<I", content, at)[0], at + 4
            case kind:
                pytest.fail(f"wire type {kind}")
        found.setdefault(key >> 3, []).append(value)
    return found


def point(content: bytes) -> tuple[float, float]:
    x, y = fields(content).get(1, [0.0]), fields(content).get(2, [0.0])
    return x[0], y[0]


def doubles(content: bytes) -> np.ndarray:
    return np.frombuffer(content, "<f8")


def received(port: int, sets: int) -> Iterator[tuple[str, int, bytes]]:
    """Subscribe to all topics, and yield topic, time, ns, and content of messages, for a number of images."""
    with client.connect(
        f"ws://127.0.0.1:{port}", subprotocols=["foxglove.sdk.v1"], max_size=None, proxy=None
    ) as socket:
        topics: dict[int, str] = {}
        while sets:
            message = socket.recv(timeout=20)
            if isinstance(message, str):
                about = json.loads(message)
                if about["op"] == "serverInfo":
                    assert about["name"] == "glstar"
                    assert "time" in about["capabilities"]
                if about["op"] == "advertise":
                    for channel in about["channels"]:
                        assert channel["schemaName"] == SCHEMAS[channel["topic"]]
                        assert channel["encoding"] == "protobuf"
                        assert base64.b64decode(channel["schema"])
                        topics[channel["id"]] = channel["topic"]
                    asked = [{"id": number, "channelId": number} for number in topics]
                    socket.send(json.dumps({"op": "subscribe", "subscriptions": asked}))
                continue
            if message[0] == 1:  # of a message: subscription, time, content
                number, stamp_ns = struct.unpack_from("<IQ", message, 1)
                yield topics[number], stamp_ns, message[13:]
                sets -= topics[number] == "/camera/image"
            elif message[0] == 2:
                yield "time", struct.unpack_from("<Q", message, 1)[0], b""


def test_what_foxglove_draws_is_the_truth_of_a_live_link(tmp_path: Path) -> None:
    port, out, config, frames = free_port(), free_port(), tmp_path / "small.toml", tmp_path / "frames"
    text = SMALL.replace("[navigator]", 'lens = "fisheye"\ndistortion = [0.01, 0.002, 0.0, 0.0]\n[navigator]')
    config.write_text(text.replace("64", "320").replace("48", "240"))
    words = f"live udpin:127.0.0.1:{port} --truth sim_state --exposure 0.2 --every 0.3 --duration 60 -c {config}"
    got: dict[str, list[tuple[int, bytes]]] = {}

    def listen() -> None:
        while True:
            try:
                for topic, stamp_ns, content in received(out, 4):
                    got.setdefault(topic, []).append((stamp_ns, content))
            except OSError:  # not open yet
                continue
            return

    listener = threading.Thread(target=listen, daemon=True)
    listener.start()
    with simulated(port), interrupted_when(lambda: not listener.is_alive()):
        result = CliRunner().invoke(app, [*words.split(), "--export", str(frames), "--foxglove", str(out)])

    assert result.exit_code == 0, result.output
    assert f"ws://127.0.0.1:{out}" in result.output
    truth = {round(parse_utc(line["utc_mid"]) * 1e6) * 1000: line for line in lines(frames / "truth.jsonl")}
    complete = sorted({stamp_ns for stamp_ns, _ in got["/camera/image"]} & {ns for ns, _ in got["/camera/annotations"]})
    assert len(complete) >= 3
    assert set(complete) <= {stamp_ns for stamp_ns, _ in got["time"]} | {complete[0]}
    by_topic = {topic: dict(messages) for topic, messages in got.items()}
    for stamp_ns in complete:
        line = truth[stamp_ns]
        image = fields(by_topic["/camera/image"][stamp_ns])
        pixels = cv2.imread(str(frames / line["file"]), cv2.IMREAD_UNCHANGED)
        shown = cv2.imdecode(np.frombuffer(image[2][0], np.uint8), cv2.IMREAD_UNCHANGED)
        np.testing.assert_array_equal(shown, pixels)
        assert (image[3], image[4]) == ([b"png"], [b"camera_optical"])
        camera = fields(by_topic["/camera/calibration"][stamp_ns])
        assert (camera[2], camera[3], camera[4]) == ([320], [240], [b"kannala_brandt"])
        np.testing.assert_allclose(doubles(camera[5][0]), [0.01, 0.002, 0.0, 0.0], rtol=0, atol=1e-12)
        np.testing.assert_allclose(doubles(camera[6][0]).reshape(3, 3), line["camera"]["K"], rtol=0, atol=1e-9)
        drawn = fields(by_topic["/camera/annotations"][stamp_ns])
        centres = np.array([point(fields(circle)[2][0]) for circle in drawn[1]])
        stars = [star for star in line["stars"] if star["x_px"] is not None]
        # Foxglove counts from the corner of the top left pixel; 0.01 px is the tolerance.
        expected = np.array([(star["x_px"], star["y_px"]) for star in stars]) + 0.5
        np.testing.assert_allclose(centres, expected, rtol=0, atol=1e-9)
        strip = fields(drawn[2][0])
        assert strip[2] == [4]  # LINE_LIST
        assert len(strip[3]) % 2 == 0
        fix = fields(by_topic["/fix"][stamp_ns])
        assert (fix[1][0], fix[2][0]) == (line["site"]["latitude_deg"], line["site"]["longitude_deg"])
        turns = [fields(one) for one in fields(by_topic["/tf"][stamp_ns])[1]]
        assert [(one[2], one[3]) for one in turns] == [
            ([b"map"], [b"base_link"]),
            ([b"base_link"], [b"camera_optical"]),
        ]


def test_wrong_and_taken_addresses_and_a_missing_library_are_one_clear_line(monkeypatch: pytest.MonkeyPatch) -> None:
    sensor, port = Config().sensor(), free_port()
    for wrong in ("0", "70000", "127.0.0.1", "http://127.0.0.1:8765"):
        with pytest.raises(ConfigError, match="is no address; write a port such as 8765"):
            FoxgloveServer(wrong, sensor)
    with FoxgloveServer(str(port), sensor), pytest.raises(ConfigError, match="cannot be opened"):
        FoxgloveServer(f"127.0.0.1:{port}", sensor)
    monkeypatch.setitem(sys.modules, "foxglove", None)
    with pytest.raises(ConfigError, match=r"needs foxglove-sdk: .*\[foxglove\]"):
        FoxgloveServer(str(port), sensor)
