"""Frames as H.264: RTP as it arrives at a socket and in FFmpeg, and the transport stream as ffprobe reads it."""

import json
import re
import shutil
import socket
import struct
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from itertools import pairwise
from pathlib import Path
from threading import Thread
from typing import Any

import cv2
import numpy as np
import pytest
from typer.testing import CliRunner

from glstar.cli import app
from glstar.config import Config
from glstar.errors import ConfigError, ExportError
from glstar.export.publish.outputs import FrameOutputs
from glstar.export.publish.videostream import RtpAddress, VideoStream, check_video
from glstar.sky.place.timescale import format_utc
from tests.support.autopilot import SMALL, UTC_S, simulated
from tests.support.links import free_port, interrupted_when, until

CONFIG = Config().override(
    **{"camera.width_px": 65, "camera.height_px": 48, "camera.fx_px": 60.0, "camera.fy_px": 60.0}
)
# A ramp with a star.
PIXELS = np.add.outer(np.arange(48), np.arange(65)).astype(np.uint8)
PIXELS[20, 30] = 255
NTP_UNIX_S = 2_208_988_800
needs_ffmpeg = pytest.mark.skipif(shutil.which("ffprobe") is None, reason="FFmpeg's commands are not installed")


def video(where: str | Path, *, interval_s: float = 0.1) -> VideoStream:
    return VideoStream(str(where), CONFIG.camera(), CONFIG.sensor(), interval_s=interval_s)


def nav(utc_s: float) -> dict[str, Any]:
    return {"utc": {"start": format_utc(utc_s)}}


def free_pair() -> int:
    """Return a port that is free together with the next one, of RTCP."""
    while True:
        port = free_port()
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as one:
            try:
                one.bind(("127.0.0.1", port + 1))
            except OSError:
                continue
        if port < 65000:
            return port


@contextmanager
def receiving(port: int) -> Iterator[list[bytes]]:
    """Collect the packets that arrive at a port."""
    packets: list[bytes] = []
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as here:
        here.bind(("127.0.0.1", port))
        here.settimeout(0.05)
        ending = []

        def receive() -> None:
            while not ending:
                try:
                    packets.append(here.recv(65536))
                except TimeoutError:
                    continue

        thread = Thread(target=receive)
        thread.start()
        try:
            yield packets
        finally:
            ending.append(True)
            thread.join()


def test_rtp_packets_are_in_sequence_with_the_times_of_the_exposures() -> None:
    port, starts_s = free_pair(), UTC_S + 0.00073 + np.array([0.0, 0.1, 0.2, 0.35, 1.35])
    with receiving(port) as packets, receiving(port + 1) as reports:
        with video(f"rtp://127.0.0.1:{port}") as stream:
            for start_s in starts_s:
                stream.write(PIXELS, b"", nav(start_s))
        until(lambda: reports and sum(packet[1] >> 7 for packet in packets) == 5, "all packets")

    heads = [struct.unpack_from(">BBHII", packet) for packet in packets]
    assert {head[0] for head in heads} == {0x80}
    assert {head[1] & 0x7F for head in heads} == {96}
    assert {len(packet) <= 1200 for packet in packets} == {True}
    assert {(after[2] - before[2]) % 2**16 for before, after in pairwise(heads)} == {1}
    # The marker ends each frame.
    ticks = np.array([(head[3] - heads[0][3]) % 2**32 for head in heads if head[1] >> 7])
    np.testing.assert_allclose(ticks / 90_000, starts_s - starts_s[0], rtol=0, atol=1e-5)
    # A sender report relates the time stamps to UTC, modulo the 13 hours of their 32 bits.
    ntp_s, fraction, stamp = struct.unpack_from(">III", reports[0], 8)
    utc_s = ntp_s - NTP_UNIX_S + fraction / 2**32
    ahead_ticks = ((utc_s - starts_s[0]) * 90_000 - (stamp - heads[0][3])) % 2**32
    assert min(ahead_ticks, 2**32 - ahead_ticks) / 90_000 == pytest.approx(0.0, rel=0, abs=2e-5)


@needs_ffmpeg
def test_ffmpeg_receives_ten_seconds_by_the_description_without_a_gap(tmp_path: Path) -> None:
    port, description = free_pair(), tmp_path / "night.sdp"
    description.write_text(RtpAddress("127.0.0.1", port).sdp, newline="")
    words = ["ffmpeg", "-v", "warning", "-protocol_whitelist", "file,rtp,udp", "-copyts", "-i", str(description)]
    words += ["-frames:v", "100", "-f", "framecrc", "-fps_mode", "passthrough", "-"]
    with subprocess.Popen(words, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as ffmpeg:
        time.sleep(0.5)
        with video(f"rtp://127.0.0.1:{port}") as stream:
            # Ten seconds of exposures, sent faster than they were taken.
            for number in range(140):
                if ffmpeg.poll() is not None:
                    break
                stream.write(PIXELS + np.uint8(number), b"", nav(UTC_S + number * 0.1))
                time.sleep(0.02)
            else:
                time.sleep(0.2)
        ffmpeg.terminate()
        out, problems = ffmpeg.communicate(timeout=20)

    rows = [line.split(",") for line in out.splitlines() if not line.startswith("#")]
    base = int(re.search(r"#tb 0: 1/(\d+)", out)[1])  # type: ignore[index]
    stamps_s = np.array([int(row[2]) for row in rows][1:]) / base
    assert len(rows) == 100
    np.testing.assert_allclose(np.diff(stamps_s), 0.1, rtol=0, atol=2 / base)
    assert not re.search("missed|lost|corrupt|conceal", problems), problems


@needs_ffmpeg
def test_a_transport_stream_has_the_times_of_the_exposures_and_the_image(tmp_path: Path) -> None:
    starts_s = UTC_S + np.array([0.0, 0.1, 0.25, 3.25, 3.35])
    with video(tmp_path / "night.ts") as stream:
        for start_s in starts_s:
            stream.write(PIXELS, b"", nav(start_s))

    words = ["ffprobe", "-v", "error", "-show_packets", "-show_streams", "-show_programs", "-of", "json"]
    about = json.loads(subprocess.check_output([*words, str(tmp_path / "night.ts")]))
    (shown,) = about["streams"]
    assert (shown["codec_name"], shown["width"], shown["height"]) == ("h264", 64, 48)
    stamps_s = np.array([float(packet["pts_time"]) for packet in about["packets"]])
    np.testing.assert_allclose(stamps_s - stamps_s[0], starts_s - starts_s[0], rtol=0, atol=1e-5)
    assert about["programs"][0]["tags"]["service_name"] == f"from {format_utc(starts_s[0])}"
    image = cv2.VideoCapture(str(tmp_path / "night.ts")).read()[1]
    assert image is not None
    np.testing.assert_allclose(image[..., 0].astype(int), PIXELS[:, :64], rtol=0, atol=20)
    assert image[20, 30, 0] > 150


def test_time_stamps_rise_where_the_clock_is_set_back(tmp_path: Path) -> None:
    with video(tmp_path / "night.ts", interval_s=0.5) as stream:
        for start_s in (UTC_S, UTC_S + 0.5, UTC_S - 100.0, UTC_S - 99.5):
            stream.write(PIXELS, b"", nav(start_s))

    import av  # noqa: PLC0415 - an extra

    with av.open(str(tmp_path / "night.ts")) as file:
        stamps_s = [float(packet.pts * packet.time_base) for packet in file.demux(video=0) if packet.pts is not None]
    np.testing.assert_allclose(np.diff(stamps_s), 0.5, rtol=0, atol=1e-5)


def test_a_stream_without_frames_leaves_no_file(tmp_path: Path) -> None:
    video(tmp_path / "night.ts").close()

    assert not (tmp_path / "night.ts").exists()


def test_bad_names_are_one_clear_line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "night.ts").touch()
    for wrong in ("rtp://127.0.0.1:70000", "rtp://127.0.0.1/more", "rtp://65535", "rtp://0"):
        with pytest.raises(ConfigError, match="is no address; write rtp://HOST:PORT"):
            video(wrong)
    with pytest.raises(ExportError, match="is there already"):
        video(tmp_path / "night.ts")
    with pytest.raises(ExportError, match="cannot be written"):
        video(tmp_path / "nowhere" / "night.ts")
    for name, words in (("udp://127.0.0.1:5600", "write rtp://"), ("night.mp4", "glstar export --video writes .webm")):
        result = CliRunner().invoke(app, ["live", "udpin:127.0.0.1:1", "--video", name])
        assert result.exit_code != 0
        assert words in str(result.exception) + result.output
    result = CliRunner().invoke(app, ["live", "udpin:127.0.0.1:1", "--video", "night.ts", "--sdp", "night.sdp"])
    assert result.exit_code == 2
    assert "rtp://HOST:PORT" in result.output
    monkeypatch.setitem(sys.modules, "av", None)
    with pytest.raises(ConfigError, match=r"needs PyAV: .*\[film\]"):
        video("rtp://5600")


def test_a_host_that_nobody_knows_is_refused_before_the_link_is_opened(monkeypatch: pytest.MonkeyPatch) -> None:
    def unknown(*_: object, **__: object) -> None:
        raise socket.gaierror(socket.EAI_NONAME, "Name or service not known")

    monkeypatch.setattr(socket, "getaddrinfo", unknown)
    with pytest.raises(ConfigError, match=r"^rtp://gcs:5600: the host gcs is not known \(Name or service not known\)$"):
        check_video("rtp://gcs:5600")


@pytest.mark.parametrize(
    ("where", "host", "port"),
    [
        ("rtp://", "127.0.0.1", 5600),
        ("rtp://5700", "127.0.0.1", 5700),
        ("rtp://10.0.0.2", "10.0.0.2", 5600),
        ("rtp://10.0.0.2:5700", "10.0.0.2", 5700),
        ("rtp://1", "127.0.0.1", 1),
        ("rtp://65534", "127.0.0.1", 65534),  # RTCP has the port above
    ],
)
def test_what_an_address_leaves_out_is_this_computer_and_the_usual_port(where: str, host: str, port: int) -> None:
    assert RtpAddress.parse(where) == (host, port)


def test_each_of_several_outputs_gets_the_frame_and_is_closed() -> None:
    class Output:
        def __init__(self, *, needs_nav: bool) -> None:
            self.needs_nav, self.got = needs_nav, list[Any]()

        def write(self, *frame: Any) -> None:
            self.got.append(frame)

        def close(self) -> None:
            self.got.append("closed")
            raise OSError

    one, other = Output(needs_nav=False), Output(needs_nav=True)
    both = FrameOutputs([one, other])
    both.write(PIXELS, b"truth", {})
    with pytest.raises(OSError):  # noqa: PT011 - that of the last one
        both.close()

    assert both.needs_nav
    assert not FrameOutputs([one]).needs_nav
    for output in (one, other):
        assert output.got == [(PIXELS, b"truth", {}), "closed"]


def test_a_link_is_a_video_of_the_camera_that_it_describes(tmp_path: Path) -> None:
    port, out, config = free_port(), free_pair(), tmp_path / "small.toml"
    config.write_text(SMALL)
    words = f"live udpin:127.0.0.1:{port} --exposure 0.1 --every 0.1 --duration 60 -c {config} --json"
    words += f" --video rtp://127.0.0.1:{out} --sdp {tmp_path / 'night.sdp'}"
    with receiving(out) as packets, simulated(port), interrupted_when(lambda: sum(p[1] >> 7 for p in packets) > 10):
        result = CliRunner().invoke(app, words.split())

    assert result.exit_code == 0, result.output
    assert f"m=video {out} RTP/AVP 96\r\n" in (tmp_path / "night.sdp").read_bytes().decode()
    stamps = np.array([struct.unpack_from(">I", packet, 4)[0] for packet in packets if packet[1] >> 7])
    # Frames end at attitudes, which come every 20 ms; a busy machine leaves out some of the frames, and delays single
    # ones, after which the next is on time.
    assert (np.diff(stamps) > 0).all()
    assert np.median(np.diff(stamps)) / 90_000 > 0.079
    assert (stamps[-1] - stamps[0]) / 90_000 > 0.1 * (len(stamps) - 1) - 0.021
