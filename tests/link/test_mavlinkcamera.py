"""The MAVLink camera: a ground station written from the protocol alone commands it."""

import struct
from collections.abc import Iterator, Mapping
from math import nan
from pathlib import Path
from typing import Any
from urllib.request import urlopen
from xml.etree import ElementTree as ET

import av
import numpy as np
import pytest
from typer.testing import CliRunner

from glstar.cli import app
from glstar.errors import ConfigError
from glstar.link.camera import (
    CameraComponent,
    CameraFacts,
    CameraParameter,
    CapturedImage,
    VideoFacts,
    camera_definition,
)
from glstar.link.clock import BootClock
from glstar.link.packets import Framer, dialect
from glstar.link.receiver import Receiver
from glstar.rotation import matrix_from_quaternion
from glstar.sky.place.timescale import parse_utc
from tests.support.autopilot import BOOT_S, MAVLINK, SMALL, UTC_S, SimulatedAutopilot, lines, simulated
from tests.support.links import free_port, interrupted_when

M = dialect()
STATION = (255, 190)


class Bench:
    """A camera on a link whose vehicle booted at `time.monotonic` 0, and a station that commands it."""

    def __init__(self, *, exposure_s: float = 0.5, delay_s: float = 0.0, has_utc: bool = True, **facts_: Any) -> None:
        facts = CameraFacts("night", 641, 480, exposure_s, 3.0, lambda: (1000.0, 250.0), **facts_)
        self.camera = CameraComponent(facts, delay_s=delay_s)
        self.receiver = Receiver(BootClock(), lambda _: None)
        self.now_s = 20.0
        self._framer, self._read = Framer(), Framer()
        self._vehicle, self._station = M.MAVLink(None, srcSystem=7, srcComponent=1), M.MAVLink(None, *STATION)
        self._station.srcSystem, self._station.srcComponent = STATION
        self.feed(M.MAVLink_heartbeat_message(1, 3, 0, 0, 4, 3), self._vehicle)
        if has_utc:
            self.feed(M.MAVLink_system_time_message(round((UTC_S + self.now_s) * 1e6), round(self.now_s * 1e3)))
        self.feed(M.MAVLink_global_position_int_message(round(self.now_s * 1e3), 1, 1, 0, 12_500, 0, 0, 0, 0))
        self.sent()

    def feed(self, message: Any, link: Any = None) -> None:
        link = link or self._vehicle
        for packet in self._framer.feed(message.pack(link)):
            self.receiver.receive(packet, self.now_s)
            self.camera.receive(packet, self.receiver, self.now_s)
        link.seq = (link.seq + 1) % 256

    def sent(self) -> list[Any]:
        """Return what the camera sends now, without heartbeats."""
        packets = b"".join(self.camera.due(self.receiver, self.now_s))
        messages = [M.MAVLink(None).decode(bytearray(packet.content)) for packet in self._read.feed(packets)]
        assert {(one.get_srcSystem(), one.get_srcComponent()) for one in messages} <= {(7, 100)}
        return [one for one in messages if one.get_type() != "HEARTBEAT"]

    def command(self, number: int, *parameters: float, target: tuple[int, int] = (7, 100), again: int = 0) -> list[Any]:
        """Send a COMMAND_LONG, and return what the camera sends in return."""
        values = [*parameters, *[0.0] * (7 - len(parameters))]
        self.feed(M.MAVLink_command_long_message(*target, number, again, *values), self._station)
        return self.sent()

    def result(self, *words: Any, **options: Any) -> int:
        [ack, *_] = self.command(*words, **options)
        assert ack.get_type() == "COMMAND_ACK"
        assert (ack.command, ack.target_system, ack.target_component) == (words[0], *STATION)
        return int(ack.result)


@pytest.mark.parametrize(
    ("requested", "older", "kind"),
    [
        (259, (521, 1), "CAMERA_INFORMATION"),
        (260, (522, 1), "CAMERA_SETTINGS"),
        (261, (525, 0, 1), "STORAGE_INFORMATION"),
        (262, (527, 1), "CAMERA_CAPTURE_STATUS"),
    ],
)
def test_what_it_is_can_be_asked_for_by_both_kinds_of_request(
    requested: int, older: tuple[float, ...], kind: str
) -> None:
    bench = Bench()

    for answer in (bench.command(512, requested), bench.command(int(older[0]), *older[1:])):
        assert [one.get_type() for one in answer] == ["COMMAND_ACK", kind]
        assert answer[0].result == M.MAV_RESULT_ACCEPTED
        assert answer[1].time_boot_ms == 20_000


def test_it_states_size_storage_and_that_it_takes_images() -> None:
    bench = Bench()

    about, storage = bench.command(512, 259)[1], bench.command(512, 261)[1]

    assert bytes(about.vendor_name).rstrip(b"\0") == b"glstar"
    assert bytes(about.model_name).rstrip(b"\0") == b"night"
    assert (about.resolution_h, about.resolution_v) == (641, 480)
    assert about.flags == M.CAMERA_CAP_FLAGS_CAPTURE_IMAGE
    assert (storage.total_capacity, storage.used_capacity, storage.available_capacity) == (1000.0, 750.0, 250.0)


def test_a_video_stream_is_stated_where_there_is_one() -> None:
    bench = Bench(video=VideoFacts(5600, 10.0), horizontal_field_deg=54.4)

    assert bench.command(512, 259)[1].flags == M.CAMERA_CAP_FLAGS_CAPTURE_IMAGE | M.CAMERA_CAP_FLAGS_HAS_VIDEO_STREAM
    for words in ((512, 269, 0), (512, 269, 1), (512, 269, nan), (2504, 0), (2504, 1)):
        ack, stream = bench.command(*words)
        assert (ack.result, stream.get_type()) == (M.MAV_RESULT_ACCEPTED, "VIDEO_STREAM_INFORMATION")
        assert (stream.type, stream.encoding) == (M.VIDEO_STREAM_TYPE_RTPUDP, M.VIDEO_STREAM_ENCODING_H264)
        # Of RTP, the UDP port at which the ground station listens.
        assert (stream.stream_id, stream.count, stream.uri) == (1, 1, "5600")
        # H.264 has even sizes.
        assert (stream.resolution_h, stream.resolution_v, stream.framerate, stream.hfov) == (640, 480, 10.0, 54)
    for words in ((512, 270, 1), (2505, 1)):
        status = bench.command(*words)[1]
        assert (status.get_type(), status.flags) == ("VIDEO_STREAM_STATUS", M.VIDEO_STREAM_STATUS_FLAGS_RUNNING)
    assert bench.result(512, 269, 2) == M.MAV_RESULT_DENIED


SETTINGS = (
    CameraParameter("CAM_SHUTTERSPD", "exposure.duration_s", 0.5, 0.001, 60.0, "s", "Exposure time"),
    CameraParameter("CAM_FRAMES", "exposure.frames", 1, 1, 8, "", "Short exposures", is_whole=True),
)


def changed(settings: Mapping[str, float]) -> tuple[float, float]:
    """Take exposures of up to 2 s in all, every 3 s."""
    span_s = settings["exposure.duration_s"] * settings["exposure.frames"]
    if span_s > 2.0:
        raise ConfigError("is too long", key="exposure.duration_s")
    return span_s, 3.0


class Settings(Bench):
    """A camera whose settings a station changes."""

    def __init__(self) -> None:
        super().__init__(parameters=SETTINGS, changed=changed, definition=(7, "http://127.0.0.1:1/camera.xml"))

    def answers(self, message: Any) -> list[Any]:
        self.feed(message, self._station)
        return self.sent()

    def set(self, name: bytes, content: bytes, kind: int, *, target: tuple[int, int] = (7, 100)) -> tuple[int, bytes]:
        [ack] = self.answers(M.MAVLink_param_ext_set_message(*target, name, content.ljust(128, b"\0"), kind))
        assert ack.get_type() == "PARAM_EXT_ACK"
        return ack.param_result, ack._param_value_raw.ljust(4, b"\0")[:4]


def test_a_station_reads_all_settings_as_bytes() -> None:
    bench = Settings()

    listed = bench.answers(M.MAVLink_param_ext_request_list_message(7, 100))
    assert {one.get_type() for one in listed} == {"PARAM_EXT_VALUE"}
    assert [(one.param_id, one.param_type, one.param_count, one.param_index) for one in listed] == [
        ("CAM_MODE", M.MAV_PARAM_EXT_TYPE_UINT32, 3, 0),
        ("CAM_SHUTTERSPD", M.MAV_PARAM_EXT_TYPE_REAL32, 3, 1),
        ("CAM_FRAMES", M.MAV_PARAM_EXT_TYPE_UINT32, 3, 2),
    ]
    # pymavlink cuts zeros at the end of a packet.
    assert [one._param_value_raw.rstrip(b"\0") for one in listed] == [b"", b"\x00\x00\x00\x3f", b"\x01"]
    for name, index in ((b"CAM_FRAMES", -1), (b"", 2)):
        [one] = bench.answers(M.MAVLink_param_ext_request_read_message(7, 100, name, index))
        assert one.param_id == "CAM_FRAMES"
    assert bench.answers(M.MAVLink_param_ext_request_read_message(7, 100, b"CAM_ISO", -1)) == []
    assert bench.answers(M.MAVLink_param_ext_request_read_message(7, 100, b"", 3)) == []
    assert bench.answers(M.MAVLink_param_ext_request_list_message(7, 101)) == []
    about = bench.command(512, 259)[1]
    assert (about.cam_definition_version, about.cam_definition_uri) == (7, "http://127.0.0.1:1/camera.xml")


def test_a_changed_exposure_is_that_of_the_next_picture() -> None:
    bench = Settings()
    bench.command(2000, 0, 0, 1, 1)

    assert bench.set(b"CAM_SHUTTERSPD", struct.pack("<f", 0.1), 9) == (M.PARAM_ACK_ACCEPTED, struct.pack("<f", 0.1))
    bench.now_s += 0.6  # the first one took 0.5 s
    assert bench.set(b"CAM_FRAMES", b"\x03", 5) == (M.PARAM_ACK_ACCEPTED, b"\x03\0\0\0")
    assert bench.result(2000, 0, 0, 1, 2) == M.MAV_RESULT_ACCEPTED
    bench.now_s += 0.29
    assert bench.result(2000, 0, 0, 1, 3) == M.MAV_RESULT_TEMPORARILY_REJECTED
    bench.now_s += 0.02
    assert bench.result(2000, 0, 0, 1, 4) == M.MAV_RESULT_ACCEPTED

    captures = []
    while (capture := bench.camera.next()) is not None:
        captures.append(capture.settings)
        bench.camera.captured(CapturedImage(capture))
    assert captures == [
        {"exposure.duration_s": 0.5, "exposure.frames": 1},
        *[{"exposure.duration_s": 0.1, "exposure.frames": 3}] * 2,
    ]


@pytest.mark.parametrize(
    ("name", "content", "kind"),
    [
        (b"CAM_SHUTTERSPD", struct.pack("<f", 60.1), 9),  # above the largest value
        (b"CAM_SHUTTERSPD", struct.pack("<f", nan), 9),
        (b"CAM_SHUTTERSPD", struct.pack("<f", 3.0), 9),  # which the camera cannot
        (b"CAM_SHUTTERSPD", struct.pack("<d", 0.1), 10),  # another type
        (b"CAM_FRAMES", b"\0", 5),
        (b"CAM_MODE", b"\1", 5),  # video
        (b"CAM_ISO", b"\1", 5),
    ],
)
def test_a_setting_that_cannot_be_is_refused_and_kept(name: bytes, content: bytes, kind: int) -> None:
    bench = Settings()

    assert bench.set(name, content, kind)[0] == M.PARAM_ACK_VALUE_UNSUPPORTED

    assert bench.camera.settings == {"exposure.duration_s": 0.5, "exposure.frames": 1}
    assert bench.set(b"CAM_MODE", b"", 5) == (M.PARAM_ACK_ACCEPTED, b"\0" * 4)


def test_the_definition_file_describes_the_settings_and_another_one_has_another_version() -> None:
    version, content = camera_definition("night", SETTINGS)

    root = ET.fromstring(content)
    definition = root.find("definition")
    assert definition is not None
    assert definition.attrib == {"version": str(version)}
    assert [(one.tag, one.text) for one in definition] == [("model", "night"), ("vendor", "glstar")]
    parameters = root.findall("parameters/parameter")
    assert [(one.get("name"), one.get("type")) for one in parameters] == [
        ("CAM_MODE", "uint32"),
        ("CAM_SHUTTERSPD", "float"),
        ("CAM_FRAMES", "uint32"),
    ]
    assert [(one.get("default"), one.get("min"), one.get("max")) for one in parameters[1:]] == [
        ("0.5", "0.001", "60"),
        ("1", "1", "8"),
    ]
    assert all(one.findtext("description") for one in parameters)
    assert 0 < version < 2**16
    other = (SETTINGS[0]._replace(value=0.25), SETTINGS[1])
    assert camera_definition("night", other)[0] != version == camera_definition("night", SETTINGS)[0]


def test_a_camera_on_a_gimbal_names_it() -> None:
    bench, fixed = Bench(on_gimbal=True), Bench()
    status = M.MAVLink_gimbal_device_attitude_status_message(0, 0, 20_000, 0, [1, 0, 0, 0], 0, 0, 0, 0)

    assert bench.command(512, 259)[1].gimbal_device_id == 0
    for one in (bench, fixed):
        one.feed(status, M.MAVLink(None, srcSystem=7, srcComponent=154))
    assert bench.command(512, 259)[1].gimbal_device_id == 154
    assert fixed.command(512, 259)[1].gimbal_device_id == 0


def test_a_picture_begins_when_it_is_commanded_plus_the_delay() -> None:
    bench = Bench(delay_s=0.02)

    assert bench.result(2000, 0, 0, 1, 4) == M.MAV_RESULT_ACCEPTED

    capture = bench.camera.next()
    assert capture is not None
    assert capture.start_utc_s == pytest.approx(UTC_S + 20.02, rel=0, abs=1e-6)
    assert (capture.index, capture.command, capture.sender, capture.sequence) == (0, "IMAGE_START_CAPTURE", STATION, 4)
    bench.now_s = 21.0
    bench.camera.captured(CapturedImage(capture, -34.93, 138.6, 300.0, (1, 0, 0, 0), "file:///frames/frame_000000.png"))
    [image] = bench.sent()
    assert image.time_utc == round((UTC_S + 20.02) * 1e6)
    assert image.time_boot_ms == 20_020
    assert (image.lat, image.lon, image.alt, image.relative_alt) == (-349_300_000, 1_386_000_000, 300_000, 12_500)
    assert (image.image_index, image.capture_result) == (0, 1)
    assert image.file_url == "file:///frames/frame_000000.png"
    assert bench.camera.next() is None
    for again in (bench.command(2002, 0), bench.command(512, 263, 0)):
        assert again[1].to_dict() == image.to_dict()
    assert bench.result(2002, 1) == M.MAV_RESULT_DENIED


@pytest.mark.parametrize(
    ("first", "second", "pictures"),
    [
        ((0, 0, 1, 4), {"words": (0, 0, 1, 4)}, 1),  # the same sequence number
        ((0, 0, 1, 4), {"words": (0, 0, 1, 5)}, 2),
        ((0, 0, 1, 0), {"words": (0, 0, 1, 0), "again": 1}, 1),  # not acknowledged, so sent again
        ((0, 0, 1, 0), {"words": (0, 0, 1, 0)}, 2),
    ],
)
def test_a_command_that_is_repeated_takes_one_picture(
    first: tuple[float, ...], second: dict[str, Any], pictures: int
) -> None:
    bench = Bench()
    bench.command(2000, *first)
    bench.now_s += 1.0

    assert bench.result(2000, *second["words"], again=second.get("again", 0)) == M.MAV_RESULT_ACCEPTED

    assert len(taken(bench)) == pictures


def test_a_trigger_of_px4_is_one_picture_without_a_complaint() -> None:
    """Sent to each of six components, with a sequence of all (PX4 1.17.0-alpha1, streams/CAMERA_TRIGGER.hpp)."""
    bench, acks = Bench(exposure_s=0.2), list[tuple[int, int]]()
    for trigger in range(3):
        for camera in range(6):
            start = (0.0, 0.0, 1.0, 6.0 * trigger + camera + 1, nan, nan, nan)
            for number, values in ((2000, start), (203, (nan, nan, nan, nan, 1.0, nan, nan))):
                bench.feed(M.MAVLink_command_long_message(7, 100 + camera, number, 0, *values))
                acks += [(one.command, one.result) for one in bench.sent()]
        bench.now_s += 1.0

    assert taken(bench) == pytest.approx([20.0, 21.0, 22.0], rel=0, abs=1e-6)
    assert acks == [(2000, M.MAV_RESULT_ACCEPTED), (203, M.MAV_RESULT_ACCEPTED)] * 3
    assert not bench.camera.messages
    # Such a command by itself is a picture.
    assert bench.result(203, 0, 0, 0, 0, 1) == M.MAV_RESULT_ACCEPTED
    assert len(taken(bench)) == 1


def test_after_a_reboot_the_first_sequence_number_is_a_new_command() -> None:
    """ArduPlane 4.7.0-dev counts its commands from 1 after each boot (AP_Camera_MAVLinkCamV2::trigger_pic)."""
    bench = Bench()
    assert bench.result(2000, 0, 0, 1, 1) == M.MAV_RESULT_ACCEPTED
    bench.now_s += 30.0
    for boot_s in (1.0, 1.5):
        bench.feed(M.MAVLink_system_time_message(round((UTC_S + bench.now_s) * 1e6), round(boot_s * 1e3)))
        bench.now_s += 0.5

    assert bench.result(2000, 0, 0, 1, 1) == M.MAV_RESULT_ACCEPTED

    assert len(taken(bench)) == 2


def taken(bench: Bench) -> list[float]:
    """Draw all pictures, and return when each began, s from the boot."""
    starts_s = []
    while (capture := bench.camera.next()) is not None:
        starts_s.append(capture.start_utc_s - UTC_S)
        bench.camera.captured(CapturedImage(capture))
    return starts_s


def test_a_picture_during_another_one_is_rejected_for_now() -> None:
    bench = Bench(exposure_s=2.0)
    bench.command(2000, 0, 0, 1, 1)
    bench.now_s += 1.9

    assert bench.result(2000, 0, 0, 1, 2) == M.MAV_RESULT_TEMPORARILY_REJECTED
    bench.now_s += 0.2
    assert bench.result(2000, 0, 0, 1, 3) == M.MAV_RESULT_ACCEPTED
    np.testing.assert_allclose(taken(bench), [20.0, 22.1], rtol=0, atol=1e-6)


def test_a_series_is_taken_at_its_own_times_however_late_the_link_is() -> None:
    bench = Bench()
    assert bench.result(2000, 0, 1.5, 4, 0) == M.MAV_RESULT_ACCEPTED

    for now_s in (20.7, 23.2, 23.3, 40.0):
        bench.now_s = now_s
        bench.sent()
    np.testing.assert_allclose(taken(bench), [20.0, 21.5, 23.0, 24.5], rtol=0, atol=1e-6)
    assert bench.command(512, 262)[1].image_count == 4


@pytest.mark.parametrize(("start", "stop"), [((2000, 0, 1.0, 0, 0), (2001,)), ((2003, 1), (2003, 0))])
def test_a_series_without_end_is_stopped(start: tuple[float, ...], stop: tuple[float, ...]) -> None:
    bench = Bench()
    bench.command(int(start[0]), *start[1:])
    every_s = 1.0 if start[0] == 2000 else 3.0
    status = bench.command(512, 262)[1]
    assert status.image_interval == every_s
    assert status.image_status == 3  # a series, and an exposure
    bench.now_s = 20.1 + 3 * every_s
    bench.sent()

    assert bench.result(int(stop[0]), *stop[1:]) == M.MAV_RESULT_ACCEPTED

    bench.now_s += 100.0
    bench.sent()
    np.testing.assert_allclose(taken(bench), 20.0 + every_s * np.arange(4), rtol=0, atol=1e-6)
    assert bench.command(512, 262)[1].image_status == 0


def test_an_interval_shorter_than_the_exposure_is_that_of_the_exposure() -> None:
    bench = Bench(exposure_s=0.5)
    bench.command(2000, 0, 0.1, 3, 0)

    assert bench.command(512, 262)[1].image_interval == 0.5
    assert "shorter than an exposure" in bench.camera.messages[0]
    bench.now_s += 5
    bench.sent()
    np.testing.assert_allclose(taken(bench), [20.0, 20.5, 21.0], rtol=0, atol=1e-6)


@pytest.mark.parametrize(
    ("words", "result"),
    [
        ((2000, 0, 0, nan, 0), M.MAV_RESULT_DENIED),
        ((2000, 0, nan, 3, 0), M.MAV_RESULT_DENIED),
        ((2000, 0, -1, 0, 0), M.MAV_RESULT_DENIED),
        ((2000, 0, 1, 1e9, 0), M.MAV_RESULT_DENIED),
        ((530, 0, 1), M.MAV_RESULT_DENIED),  # video
        ((530, 0, 0), M.MAV_RESULT_ACCEPTED),
        ((203, 0, 0, 0, 0, 0), M.MAV_RESULT_ACCEPTED),  # nothing to do
        ((512, nan), M.MAV_RESULT_UNSUPPORTED),
        ((512, 269), M.MAV_RESULT_UNSUPPORTED),  # no video stream
        ((2504, 1), M.MAV_RESULT_UNSUPPORTED),
        ((526, 1, 1), M.MAV_RESULT_UNSUPPORTED),  # nobody formats a disk
        ((2500, 0, 1), M.MAV_RESULT_UNSUPPORTED),
    ],
)
def test_what_it_cannot_do_is_answered_and_takes_no_picture(words: tuple[Any, ...], result: int) -> None:
    bench = Bench()

    assert bench.result(*words) == result

    assert bench.camera.next() is None


def test_commands_to_others_are_not_answered() -> None:
    bench = Bench()

    assert bench.command(2000, 0, 0, 1, 1, target=(8, 100)) == []
    assert bench.command(2000, 0, 0, 1, 1, target=(7, 1)) == []
    assert bench.command(400, 1, target=(7, 0)) == []  # arming, to all components
    assert bench.camera.next() is None
    assert bench.result(2000, 0, 0, 1, 1, target=(7, 0)) == M.MAV_RESULT_ACCEPTED


def test_an_autopilot_triggers_it_by_the_old_command_and_as_an_integer_command() -> None:
    bench = Bench()

    assert bench.result(203, 0, 0, 0, 0, 1) == M.MAV_RESULT_ACCEPTED
    bench.now_s += 1.0
    bench.feed(M.MAVLink_command_int_message(7, 100, 0, 203, 0, 0, 0, 0, 0, 0, 1, 0, 0))
    [ack] = bench.sent()
    assert (ack.result, ack.target_system, ack.target_component) == (M.MAV_RESULT_ACCEPTED, 7, 1)
    assert len(taken(bench)) == 2


def test_without_utc_no_picture_is_taken() -> None:
    bench = Bench(has_utc=False)

    assert bench.result(2000, 0, 0, 1, 1) == M.MAV_RESULT_TEMPORARILY_REJECTED
    assert bench.result(2000, 0, 1, 0, 0) == M.MAV_RESULT_TEMPORARILY_REJECTED
    assert "UTC is not known yet" in bench.camera.messages[0]


class Setting(SimulatedAutopilot):
    """A vehicle whose ground station reads the camera's definition, sets exposure and gain, and takes a picture."""

    def __init__(self, port: int) -> None:
        super().__init__(port)
        self.definition = b""
        self.results: dict[str, int] = {}

    def messages(self, step: int, elapsed_s: float) -> Iterator[Any]:
        yield from super().messages(step, elapsed_s)
        self.results |= {one.param_id: one.param_result for one in self.got("PARAM_EXT_ACK")}
        if not self.definition:
            for about in self.got("CAMERA_INFORMATION"):
                with urlopen(about.cam_definition_uri) as answer:
                    self.definition = answer.read()
        if step > 100 and step % 25 == 0:
            target = 1, 100
            if not self.definition:
                yield _FromStation(MAVLINK.MAVLink_command_long_message(*target, 512, 0, 259, 0, 0, 0, 0, 0, 0))
            elif len(self.results) < 2:
                for name, value in ((b"CAM_SHUTTERSPD", 0.25), (b"CAM_GAIN", 4.0)):
                    content = struct.pack("<f", value).ljust(128, b"\0")
                    yield _FromStation(MAVLINK.MAVLink_param_ext_set_message(*target, name, content, 9))
            else:
                yield _FromStation(MAVLINK.MAVLink_command_long_message(*target, 2000, 0, 0, 0, 1, 1, 0, 0, 0))

    def got(self, kind: str) -> list[Any]:
        return [one for one in self.received if one.get_type() == kind]


def test_a_station_sets_exposure_and_gain_of_a_flying_camera(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    port, frames, config = free_port(), tmp_path / "frames", tmp_path / "small.toml"
    config.write_text(SMALL + '[sensor]\nnoise = "electrons"\ngain_dn_per_e = 0.5\n')
    vehicle = Setting(port)
    monkeypatch.setattr("tests.support.autopilot.SimulatedAutopilot", lambda *_: vehicle)
    words = f"live udpin:127.0.0.1:{port} --truth sim_state --exposure 0.1 --duration 100 --max-gap 5 -c {config}"
    with simulated(port), interrupted_when(lambda: bool(vehicle.got("CAMERA_IMAGE_CAPTURED"))):
        result = CliRunner().invoke(app, [*words.split(), "--mavlink-camera", "--export", str(frames)])

    assert result.exit_code == 0, result.output
    assert vehicle.results == dict.fromkeys(("CAM_SHUTTERSPD", "CAM_GAIN"), MAVLINK.PARAM_ACK_ACCEPTED)
    names = [one.get("name") for one in ET.fromstring(vehicle.definition).findall("parameters/parameter")]
    assert names == ["CAM_MODE", "CAM_SHUTTERSPD", "CAM_INTERVAL", "CAM_GAIN"]  # a sum has no CAM_FRAMES
    [line] = lines(frames / "truth.jsonl")
    assert (line["duration_s"], line["sensor"]["dn_per_e"]) == (0.25, 2.0)


class _FromStation:
    """A message of the ground station, which the vehicle forwards."""

    link = MAVLINK.MAVLink(None, srcSystem=STATION[0], srcComponent=STATION[1])

    def __init__(self, message: Any) -> None:
        self._message = message

    def pack(self, _: Any) -> bytes:
        packed = bytes(self._message.pack(self.link))
        self.link.seq = (self.link.seq + 1) % 256
        return packed


class Commanding(SimulatedAutopilot):
    """A vehicle whose ground station takes 20 pictures by command and 10 at an interval, and floods the link."""

    def __init__(self, port: int) -> None:
        super().__init__(port)
        self.commanded_s: list[float] = []
        self.series_s = 0.0

    def captured(self) -> list[Any]:
        """Return the reports of pictures, in the order of their numbers; one may be sent again."""
        images = {one.image_index: one for one in self.received if one.get_type() == "CAMERA_IMAGE_CAPTURED"}
        return [images[number] for number in sorted(images)]

    def acknowledged(self) -> int:
        return sum(one.get_type() == "COMMAND_ACK" and one.command == 2000 for one in self.received)

    def messages(self, step: int, elapsed_s: float) -> Iterator[Any]:
        yield from super().messages(step, elapsed_s)
        taken = len(self.commanded_s)
        if step > 100 and step % 15 == 0 and taken < 20 and len(self.captured()) == taken <= self.acknowledged():
            self.commanded_s.append(elapsed_s)
            yield self.start(0, 1, taken + 1)
        elif step > 100 and step % 100 == 0 and self.acknowledged() < taken <= 20 and not self.series_s:
            yield self.start(0, 1, taken)  # as a station that gets no acknowledgement
        if len(self.captured()) == 20 and not self.series_s:
            self.series_s = elapsed_s
            yield self.start(0.2, 10, 0)
        for value in range(20):
            yield MAVLINK.MAVLink_named_value_float_message(0, b"flood", value)

    def start(self, interval_s: float, number: int, sequence: int) -> _FromStation:
        numbers = 0, interval_s, number, sequence, 0, 0, 0
        return _FromStation(MAVLINK.MAVLink_command_long_message(1, 100, 2000, 0, *numbers))


def test_a_ground_station_takes_pictures_and_their_files_exist(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    port, frames, config = free_port(), tmp_path / "frames", tmp_path / "small.toml"
    config.write_text(SMALL)
    vehicle = Commanding(port)
    monkeypatch.setattr("tests.support.autopilot.SimulatedAutopilot", lambda *_: vehicle)
    words = f"live udpin:127.0.0.1:{port} --truth sim_state --exposure 0.1 --duration 100 --max-gap 5 -c {config}"
    with simulated(port), interrupted_when(lambda: len(vehicle.captured()) >= 30):
        result = CliRunner().invoke(app, [*words.split(), "--mavlink-camera", "--export", str(frames)])

    assert result.exit_code == 0, result.output
    images, truth = vehicle.captured(), lines(frames / "truth.jsonl")
    assert [one.image_index for one in images] == list(range(30))
    assert [line["image_index"] for line in truth] == list(range(30))
    assert all(one.capture_result == 1 for one in images)
    assert [Path(one.file_url.removeprefix("file://")) for one in images] == [frames / line["file"] for line in truth]
    assert all((frames / line["file"]).stat().st_size for line in truth)
    starts_s = np.array([parse_utc(line["utc_start"]) for line in truth])
    np.testing.assert_allclose([one.time_utc * 1e-6 for one in images], starts_s, rtol=0, atol=2e-6)
    boots_s = [one.time_boot_ms / 1e3 for one in images]
    np.testing.assert_allclose(boots_s, BOOT_S + starts_s - UTC_S, rtol=0, atol=0.002)
    # A busy machine delays single packets.
    late_s = starts_s[:20] - (UTC_S + np.array(vehicle.commanded_s))
    assert abs(np.median(late_s)) < 0.005
    np.testing.assert_allclose(np.diff(starts_s[20:]), 0.2, rtol=0, atol=1e-5)
    sender = {"name": "IMAGE_START_CAPTURE", "system": STATION[0], "component": STATION[1]}
    assert [line["command"] for line in truth] == [sender | {"sequence": n} for n in [*range(1, 21), *[0] * 10]]
    for one, line in zip(images, truth, strict=True):
        boresight_ned = matrix_from_quaternion(np.array(one.q)) @ [1.0, 0.0, 0.0]
        C_body_ned = matrix_from_quaternion(np.array(line["q_body_ned"]))
        np.testing.assert_allclose(boresight_ned, C_body_ned.T @ np.array(line["C_camera_body"])[2], rtol=0, atol=1e-6)


def test_between_its_pictures_the_camera_films(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    port, frames, config, video = free_port(), tmp_path / "frames", tmp_path / "small.toml", tmp_path / "night.ts"
    config.write_text(SMALL)
    vehicle = Commanding(port)
    monkeypatch.setattr("tests.support.autopilot.SimulatedAutopilot", lambda *_: vehicle)
    words = f"live udpin:127.0.0.1:{port} --truth sim_state --exposure 0.1 --every 0.2 --duration 100 --max-gap 5"
    words += f" -c {config} --mavlink-camera --export {frames} --video {video}"
    with simulated(port), interrupted_when(lambda: len(vehicle.captured()) >= 5):
        result = CliRunner().invoke(app, words.split())

    assert result.exit_code == 0, result.output
    truth = lines(frames / "truth.jsonl")
    assert [line["image_index"] for line in truth] == list(range(len(truth)))
    assert [line["frame"] for line in truth] == list(range(len(truth)))
    assert len(list(frames.glob("frame_*"))) == len(truth)
    with av.open(str(video)) as file:
        stamps_s = [float(one.pts * one.time_base) for one in file.demux(video=0) if one.pts is not None]
    # The first command comes after two seconds, another one every 0.3 s at most.
    assert len(stamps_s) > len(truth) + 5


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--mavlink-camera"], "add --export DIRECTORY"),
        (["--mavlink-camera", "--export", "frames", "--every", "2"], "without commands"),
        (["--camera-id", "101"], "belong to --mavlink-camera"),
        (["--camera-delay", "0.1"], "belong to --mavlink-camera"),
    ],
)
def test_contradicting_options_of_the_camera_are_refused(words: list[str], message: str) -> None:
    result = CliRunner().invoke(app, ["live", "udpin:127.0.0.1:1", *words])

    assert result.exit_code == 2
    assert message in " ".join(result.stderr.replace("│", " ").split())
