"""What a MAVLink camera sends, field by field, and when it takes a command for another one."""

from math import isnan, nan
from typing import Any

import pytest

from glstar import __version__
from glstar.link.camera import CameraComponent, CameraFacts, Capture, CapturedImage, VideoFacts
from glstar.link.camera.component import _Now
from glstar.link.clock import BootClock
from glstar.link.packets import Framer, dialect
from glstar.link.receiver import Receiver

M = dialect()
UTC_S = 1_710_068_400.0
STATION = (255, 190)


def now(host_s: float = 20.0, *, utc_s: float | None = 0.0, sender: tuple[int, int] = STATION, **others: Any) -> _Now:
    """Return the arrival of a command; UTC is that above `UTC_S`."""
    known = None if utc_s is None else UTC_S + utc_s
    return _Now(
        host_s, known, others.get("boot_ms", 20_125), 12.5, sender, others.get("boot", 0), others.get("gimbal", 0)
    )


def camera(*, delay_s: float = 0.0, component: int | None = None, **facts: Any) -> CameraComponent:
    whole: dict[str, Any] = {"horizontal_field_deg": 54.4, "video": VideoFacts(5600, 12.5)} | facts
    described = CameraFacts("night", 641, 483, 0.5, 3.0, lambda: (1000.0, 250.0), **whole)
    return CameraComponent(described, delay_s=delay_s, **({} if component is None else {"component": component}))


def fields(message: Any) -> dict[str, Any]:
    """Return the fields of a message as it arrives, without NaN."""
    link = M.MAVLink(None, 7, 100)
    arrived = M.MAVLink(None).decode(bytearray(message.pack(link)))
    found = {name: getattr(arrived, name) for name in arrived.get_fieldnames()}
    return {name: value for name, value in found.items() if not (isinstance(value, float) and isnan(value))}


def test_what_the_camera_states_is_whole() -> None:
    one = camera(definition=(7, "http://127.0.0.1/c.xml"), on_gimbal=True)
    major, minor, patch = (int(part) for part in __version__.split(".")[:3])

    about = fields(one._information(now(gimbal=3)))
    assert bytes(about.pop("vendor_name")) == b"glstar".ljust(32, b"\0")
    assert bytes(about.pop("model_name")) == b"night".ljust(32, b"\0")
    assert about == {
        "time_boot_ms": 20_125,
        "firmware_version": major + 256 * minor + 65536 * patch,
        "resolution_h": 641,
        "resolution_v": 483,
        "lens_id": 0,
        "flags": M.CAMERA_CAP_FLAGS_CAPTURE_IMAGE | M.CAMERA_CAP_FLAGS_HAS_VIDEO_STREAM,
        "cam_definition_version": 7,
        "cam_definition_uri": "http://127.0.0.1/c.xml",
        "gimbal_device_id": 3,
        "camera_device_id": 0,
    }
    plain = fields(camera(video=None)._information(now(gimbal=3)))
    assert (plain["flags"], plain["gimbal_device_id"]) == (M.CAMERA_CAP_FLAGS_CAPTURE_IMAGE, 0)
    assert (plain["cam_definition_version"], plain["cam_definition_uri"]) == (0, "")
    long = CameraComponent(CameraFacts("x" * 40, 4, 4, 0.5, 3.0, lambda: (1.0, 1.0)))
    assert bytes(fields(long._information(now()))["model_name"]) == b"x" * 31 + b"\0"

    assert fields(one._settings(now())) == {
        "time_boot_ms": 20_125,
        "mode_id": M.CAMERA_MODE_IMAGE,
        "camera_device_id": 0,
    }
    storage = fields(one._storage(now()))
    assert {name: value for name, value in storage.items() if not name.startswith(("type", "name", "storage_u"))} == {
        "time_boot_ms": 20_125,
        "storage_id": 1,
        "storage_count": 1,
        "status": M.STORAGE_STATUS_READY,
        "total_capacity": 1000.0,
        "used_capacity": 750.0,
        "available_capacity": 250.0,
    }
    video = {
        "stream_id": 1,
        "flags": M.VIDEO_STREAM_STATUS_FLAGS_RUNNING,
        "framerate": 12.5,
        "resolution_h": 640,
        "resolution_v": 482,
        "bitrate": 0,
        "rotation": 0,
        "hfov": 54,
        "camera_device_id": 0,
    }
    assert fields(one._video_status(now())) == video
    assert fields(one._video_information(now())) == video | {
        "count": 1,
        "type": M.VIDEO_STREAM_TYPE_RTPUDP,
        "name": "night sky",
        "uri": "5600",
        "encoding": M.VIDEO_STREAM_ENCODING_H264,
    }
    beat = fields(one._heartbeat())
    assert beat == {
        "type": M.MAV_TYPE_CAMERA,
        "autopilot": M.MAV_AUTOPILOT_INVALID,
        "base_mode": 0,
        "custom_mode": 0,
        "system_status": M.MAV_STATE_ACTIVE,
        "mavlink_version": 3,
    }


def test_a_picture_is_reported_with_its_time_place_attitude_and_file() -> None:
    capture = Capture(4, UTC_S + 7.25, "IMAGE_START_CAPTURE", STATION, 9)
    image = CapturedImage(capture, -34.5, 138.25, 312.125, (0.5, -0.5, 0.25, 0.125), "file:///a/frame_000004.png")

    found = fields(camera()._image(image, now(utc_s=10.0)))

    assert found == {
        # 2.75 s before the time since boot, 20.125 s.
        "time_boot_ms": 17_375,
        "time_utc": round((UTC_S + 7.25) * 1e6),
        "camera_id": 0,
        "lat": -345_000_000,
        "lon": 1_382_500_000,
        "alt": 312_125,
        "relative_alt": 12_500,
        "q": [0.5, -0.5, 0.25, 0.125],
        "image_index": 4,
        "capture_result": 1,
        "file_url": "file:///a/frame_000004.png",
    }
    # A picture from before the boot, or while UTC is unknown.
    assert fields(camera()._image(image, now(utc_s=100.0)))["time_boot_ms"] == 0
    assert fields(camera()._image(image, now(utc_s=None)))["time_boot_ms"] == 20_125
    failed = fields(camera()._image(CapturedImage(capture), now()))
    assert (failed["capture_result"], failed["file_url"], failed["lat"], failed["alt"]) == (0, "", 0, 0)
    assert all(isnan(part) for part in failed["q"])
    for length, kept in ((204, 204), (205, 0)):
        url = "file:///" + "d" * (length - 8 - 11) + "/frame_4.png"[:11]
        assert len(url) == length
        named = fields(camera()._image(image._replace(url=url), now()))["file_url"]
        assert named == (url if kept else "frame_4.pn")
    named = fields(camera()._image(image._replace(url="file:///d/" + "e" * 300 + ".png"), now()))["file_url"]
    assert named == "e" * 200 + ".png"
    assert capture.about == {
        "image_index": 4,
        "command": {"name": "IMAGE_START_CAPTURE", "system": 255, "component": 190, "sequence": 9},
    }


def start(number: float = 1.0, *, interval_s: float = 0.0, sequence: float = 0.0, again: int = 0) -> Any:
    return M.MAVLink_command_long_message(7, 100, 2000, again, 0, interval_s, number, sequence, 0, 0, 0)


def taken(one: CameraComponent) -> list[tuple[Any, ...]]:
    return [(capture.index, capture.start_utc_s - UTC_S, capture.command, capture.sequence) for capture in one._waiting]


ACCEPTED, LATER, DENIED = M.MAV_RESULT_ACCEPTED, M.MAV_RESULT_TEMPORARILY_REJECTED, M.MAV_RESULT_DENIED
NAME = "IMAGE_START_CAPTURE"


def test_a_picture_begins_after_the_delay_and_none_while_another_is_exposed() -> None:
    one = camera(delay_s=0.125)

    assert one._start(start(sequence=3), now(utc_s=10.0)) == ACCEPTED
    assert one._start(start(), now(21.0, utc_s=10.49)) == LATER
    assert one._start(start(), now(22.0, utc_s=10.5)) == ACCEPTED
    assert taken(one) == [(0, 10.125, NAME, 3), (1, 10.625, NAME, 0)]
    assert list(one.messages) == [f"{NAME}: no picture, because the camera exposes another one"]
    assert one._start(start(), now(utc_s=None)) == LATER
    assert one.messages[-1] == f"{NAME}: no picture, because UTC is not known yet"
    for number in (nan, -1.0, 100_001.0):
        assert one._start(start(number), now(utc_s=30.0)) == DENIED
    for interval_s in (nan, -0.5):
        assert one._start(start(3, interval_s=interval_s), now(utc_s=30.0)) == DENIED
    assert one._start(start(sequence=-2), now(utc_s=30.0)) == ACCEPTED
    assert taken(one)[-1] == (2, 30.125, NAME, 0)


@pytest.mark.parametrize(
    ("first", "second", "after_s", "count"),
    [
        ({"sequence": 3}, {"sequence": 3}, 100.0, 1),
        ({"sequence": 3}, {"sequence": 4}, 1.0, 2),
        ({}, {"again": 1}, 4.9, 1),
        ({}, {"again": 1}, 5.1, 2),
        ({}, {"again": 0}, 1.0, 2),
    ],
)
def test_a_repeated_command_is_one_picture(
    first: dict[str, Any], second: dict[str, Any], after_s: float, count: int
) -> None:
    one = camera()
    assert one._start(start(**first), now(20.0, utc_s=10.0)) == ACCEPTED
    assert one._start(start(**second), now(20.0 + after_s, utc_s=10.0 + after_s)) == ACCEPTED
    assert len(taken(one)) == count
    # Of another sender, or after a reboot, it is another command.
    assert one._start(start(**second), now(20.1 + after_s, utc_s=200.0, sender=(255, 191))) == ACCEPTED
    assert one._start(start(**second), now(20.1 + after_s, utc_s=210.0, boot=1)) == ACCEPTED
    assert len(taken(one)) == count + 2


@pytest.mark.parametrize(("after_s", "result", "count"), [(0.096, ACCEPTED, 1), (0.104, LATER, 1), (0.6, ACCEPTED, 2)])
def test_the_older_form_of_a_trigger_at_once_is_the_same(after_s: float, result: int, count: int) -> None:
    digicam = M.MAVLink_command_long_message(7, 100, 203, 0, 0, 0, 0, 0, 1, 0, 0)
    one = camera()
    one._start(start(), now(20.0, utc_s=10.0))
    assert one._digicam(digicam, now(20.0 + after_s, utc_s=10.0 + after_s)) == result
    assert len(taken(one)) == count
    alone = camera()
    assert alone._digicam(digicam, now(20.0, utc_s=10.0)) == ACCEPTED
    assert alone._digicam(digicam, now(20.05, utc_s=11.0)) == ACCEPTED
    assert [capture[2] for capture in taken(alone)] == ["DO_DIGICAM_CONTROL"] * 2
    integer = M.MAVLink_command_int_message(7, 100, 0, 203, 0, 0, 0, 0, 0, 0, 1, 0, 0)
    assert alone._digicam(integer, now(30.0, utc_s=12.0)) == ACCEPTED
    none = M.MAVLink_command_long_message(7, 100, 203, 0, 0, 0, 0, 0, 0, 0, 0)
    assert alone._digicam(none, now(40.0, utc_s=13.0)) == ACCEPTED
    assert len(taken(alone)) == 3


def test_a_series_begins_when_the_camera_is_free_and_has_its_interval_and_number() -> None:
    one = camera(delay_s=0.25)
    one._start(start(), now(utc_s=10.0))
    assert one._start(start(3, interval_s=0.75), now(utc_s=10.1)) == ACCEPTED
    status = fields(one._status(now(utc_s=10.5)))
    assert status == {
        "time_boot_ms": 20_125,
        "image_status": 3,
        "video_status": 0,
        "image_interval": 0.75,
        "recording_time_ms": 0,
        "available_capacity": 250.0,
        "image_count": 1,
        "camera_device_id": 0,
    }
    assert one._start(start(), now(utc_s=20.0)) == LATER  # the series is not over
    # The first picture ends at 10.75 s, where the series begins.
    for utc_s, count in ((10.74, 1), (10.75, 2), (11.49, 2), (12.3, 4), (20.0, 4)):
        one._continue_series(now(utc_s=utc_s))
        assert len(taken(one)) == count
    assert [start_s for _, start_s, *_ in taken(one)] == [10.25, 10.75, 11.5, 12.25]
    status = fields(one._status(now(utc_s=12.74)))
    assert (status["image_status"], status["image_interval"], status["image_count"]) == (1, 0.0, 4)
    assert fields(one._status(now(utc_s=12.75)))["image_status"] == 0
    assert fields(one._status(now(utc_s=None)))["image_status"] == 0
    one._continue_series(now(utc_s=None))

    late = camera(delay_s=0.25)
    assert late._start(start(0, interval_s=0.25), now(utc_s=10.0)) == ACCEPTED
    assert list(late.messages) == [f"{NAME}: every 0.5 s: 0.25 s are shorter than an exposure"]
    late._continue_series(now(utc_s=11.3))
    assert [start_s for _, start_s, *_ in taken(late)] == [10.25, 10.75, 11.25]
    assert late._stop() == ACCEPTED
    late._continue_series(now(utc_s=20.0))
    assert len(taken(late)) == 3
    assert late._start(start(2, interval_s=1.0), now(utc_s=None)) == LATER
    assert late.messages[-1] == f"{NAME}: no pictures, because UTC is not known yet"


def test_pictures_that_wait_are_ten_thousand_at_most() -> None:
    one = camera()
    one._start_series(NAME, 0.5, 10_002, now(utc_s=0.0))
    one._continue_series(now(utc_s=6000.0))

    assert len(taken(one)) == 10_000
    assert list(one.messages) == [f"{NAME}: no picture, because 10000 wait to be drawn"] * 2
    assert one._take_one(NAME, start(), now(utc_s=7000.0), 0) == LATER


def test_the_camera_speaks_for_the_system_of_its_vehicle_once_a_second() -> None:
    one, vehicle, framer = camera(component=103), M.MAVLink(None, 7, 1), Framer()
    receiver = Receiver(BootClock(), lambda _: None)
    assert one.due(receiver, 20.0) == []
    [packet] = framer.feed(M.MAVLink_heartbeat_message(1, 3, 0, 0, 4, 3).pack(vehicle))
    receiver.receive(packet, 20.0)

    sent: list[Any] = []
    for tenth in range(200, 231):
        for content in one.due(receiver, tenth / 10):
            [beat] = Framer().feed(content)
            sent.append((tenth / 10, beat.system, beat.component, beat.sequence))
    assert sent == [(20.0, 7, 103, 0), (21.0, 7, 103, 1), (22.0, 7, 103, 2), (23.0, 7, 103, 3)]
    receiver.chosen = (9, 1)
    [content] = one.due(receiver, 24.0)
    [beat] = Framer().feed(content)
    assert (beat.system, beat.sequence) == (9, 0)
    # Without an attitude of a gimbal, its height and the clock of a vehicle that booted just now.
    assert _Now.of(receiver, 24.0, STATION) == (24.0, None, 0, 0.0, STATION, 0, 0)
