"""When a camera was triggered, by every log that says so, and the exposures at these times."""

import json
import struct
from pathlib import Path

import cv2
import numpy as np
import pytest
from pymavlink.dialects.v20 import ardupilotmega as common
from typer.testing import CliRunner

from glstar.cli import app
from glstar.config import Config
from glstar.errors import ConfigError, ImagesError
from glstar.export.plan.frames import plan_frames
from glstar.flight import Flight
from glstar.images import triggered_images
from glstar.sky.place.timescale import parse_utc
from glstar.telemetry import open_flight
from tests.support.dataflash import Log
from tests.telemetry.test_rosbag import ENU_FLU, START_NS, TIMES_S, Bag

ELEVEN_S = parse_utc("2024-03-10T11:00:00Z")
BOOT_S = 30.0
# Seconds after 11:00:00 UTC, which is boot time 30 s.
TRIGGERS_S = [1.25, 3.5, 3.9, 7.125]


def dataflash(path: Path, record: str = "CAM", gap: tuple[float, float] = (99.0, 99.0)) -> Path:
    """Write ten seconds of attitude and triggers; boot time 30 s is 11:00 UTC."""
    log = Log()
    for k in range(501):
        t_s = k * 0.02
        if not gap[0] < t_s < gap[1]:
            log.att(BOOT_S + t_s, yaw_deg=t_s)
        if k % 10 == 0:
            log.gps(BOOT_S + t_s)
            log.gpa(BOOT_S + t_s)
            log.pos(BOOT_S + t_s)
    for number, t_s in enumerate(TRIGGERS_S):
        log.add(record, "QH", "TimeUS,Img", round((BOOT_S + t_s) * 1e6), number)
    return log.save(path)


def telemetry(path: Path, *, utc: bool) -> Path:
    link, packets = common.MAVLink(None, 1, 1), []

    def add(message: common.MAVLink_message, t_s: float) -> None:
        stamp_us = round((ELEVEN_S + 0.4 + t_s) * 1e6)
        packets.append(struct.pack(">Q", stamp_us) + bytes(message.pack(link)))

    for k in range(501):
        t_s = k * 0.02
        ms = round((BOOT_S + t_s) * 1e3)
        add(common.MAVLink_attitude_message(ms, 0.0, 0.0, 0.01 * t_s, 0.0, 0.0, 0.0), t_s)
        if k % 25 == 0:
            add(common.MAVLink_heartbeat_message(1, 3, 0, 0, 4, 3), t_s)
            add(common.MAVLink_system_time_message(round((ELEVEN_S + t_s) * 1e6), ms), t_s)
            add(common.MAVLink_global_position_int_message(ms, -349300000, 1386000000, 48000, 0, 0, 0, 0, 0), t_s)
        for number, trigger_s in enumerate(TRIGGERS_S):
            if abs(trigger_s - t_s + 0.01) < 0.0101:
                time_us = round(((ELEVEN_S if utc else BOOT_S) + trigger_s) * 1e6)
                place = (-349300000, 1386000000, 48.0, 48.0, 0.0, 0.0, 0.0, 0.0)
                feedback = common.MAVLink_camera_feedback_message(time_us, 1, 0, number, *place, 0)
                add(feedback, t_s)
                add(feedback, t_s + 0.01)
    path.write_bytes(b"".join(packets))
    return path


class ULogWriter:
    """Writes topics of a PX4 log."""

    def __init__(self) -> None:
        self.head = b"ULog\x01\x12\x35\x01" + struct.pack("<Q", 0)
        self.definitions, self.samples = b"", b""
        self.topics: dict[str, tuple[int, str]] = {}

    def add(self, name: str, fields: str, layout: str, *values: float) -> None:
        def message(kind: str, body: bytes) -> bytes:
            return struct.pack("<Hc", len(body), kind.encode()) + body

        if name not in self.topics:
            self.topics[name] = (len(self.topics), layout)
            self.definitions += message("F", f"{name}:{fields}".encode())
            self.samples += message("A", struct.pack("<BH", 0, self.topics[name][0]) + name.encode())
        self.samples += message("D", struct.pack("<H" + layout, self.topics[name][0], *values))


def ulog(path: Path, *, utc: bool) -> Path:
    log = ULogWriter()
    for k in range(501):
        t_us = round((BOOT_S + k * 0.02) * 1e6)
        log.add(
            "vehicle_attitude",
            "uint64_t timestamp;float[4] q;uint8_t quat_reset_counter;",
            "QffffB",
            t_us,
            1,
            0,
            0,
            0,
            0,
        )
        if k % 25 == 0:
            utc_us = round((ELEVEN_S + k * 0.02) * 1e6)
            fields = "uint64_t timestamp;uint64_t time_utc_usec;int32_t lat;int32_t lon;int32_t alt;uint8_t fix_type;"
            log.add("vehicle_gps_position", fields, "QQiiiB", t_us, utc_us, -349300000, 1386000000, 48000, 3)
    for number, t_s in enumerate(TRIGGERS_S):
        utc_us = round((ELEVEN_S + t_s) * 1e6) if utc else 0
        fields = "uint64_t timestamp;uint64_t timestamp_utc;uint32_t seq;"
        # Logged 30 ms late, if the camera knows UTC itself.
        log.add("camera_capture", fields, "QQI", round((BOOT_S + t_s + 0.03 * utc) * 1e6), utc_us, number)
    path.write_bytes(log.head + log.definitions + log.samples)
    return path


def the_log(folder: Path, kind: str) -> Path:
    if kind.isupper():
        return dataflash(folder / "flight.BIN", kind)
    form, _, utc = kind.partition(" ")
    return (telemetry if form == "tlog" else ulog)(folder / f"flight.{form}", utc=utc == "utc")


@pytest.mark.parametrize("kind", ["CAM", "TRIG", "tlog utc", "tlog", "ulog utc", "ulog"])
def test_triggers_are_read_to_a_millisecond(tmp_path: Path, kind: str) -> None:
    flight = open_flight(the_log(tmp_path, kind))

    np.testing.assert_allclose(flight.triggers_of("camera").utc_s, ELEVEN_S + np.array(TRIGGERS_S), rtol=0, atol=1e-3)


def test_another_utc_of_the_flight_moves_the_triggers(tmp_path: Path) -> None:
    for kind in ("CAM", "tlog"):
        flight = open_flight(the_log(tmp_path, kind), utc_start=ELEVEN_S + 3600)

        np.testing.assert_allclose(
            flight.triggers_of("camera").utc_s, ELEVEN_S + 3600 + np.array(TRIGGERS_S), rtol=0, atol=1e-3
        )


def plan_of(flight: Flight, duration_s: float = 0.5, **limits: float | None) -> list[tuple[int, float]]:
    exposure = Config().override(**{"exposure.at": "camera", "exposure.duration_s": duration_s}).exposure
    given = {"start_s": 0.0, "stop_s": None, "frames": None} | limits
    frames = plan_frames(flight, exposure, **given).frames
    return [(frame.number, round(frame.exposure.start_utc_s - ELEVEN_S, 3)) for frame in frames]


def test_each_trigger_is_an_exposure_with_its_number(tmp_path: Path) -> None:
    flight = open_flight(dataflash(tmp_path / "flight.BIN"))

    assert plan_of(flight) == list(enumerate(TRIGGERS_S))
    assert plan_of(flight, start_s=2.0, stop_s=4.2) == [(1, 3.5)]
    assert plan_of(flight, frames=2) == [(0, 1.25), (1, 3.5)]
    # The attitude ends at 10 s.
    assert plan_of(flight, duration_s=4.0) == [(0, 1.25), (1, 3.5), (2, 3.9)]
    with pytest.raises(
        ConfigError, match=r"none of the 4 triggers of the camera \(CAM\) is followed by 9 s of attitude"
    ):
        plan_of(flight, duration_s=9.0)


def test_a_trigger_in_a_gap_is_skipped_and_counted(tmp_path: Path) -> None:
    flight = open_flight(dataflash(tmp_path / "flight.BIN", gap=(3.6, 5.0)))
    exposure = Config().override(**{"exposure.at": "camera"}).exposure

    plan = plan_frames(flight, exposure, start_s=0.0, stop_s=None, frames=None)

    assert [frame.number for frame in plan.frames] == [0, 3]
    assert [(frame.number, frame.reason) for frame in plan.skipped] == [(1, "a data gap"), (2, "a data gap")]


def test_export_and_info_at_the_camera(tmp_path: Path) -> None:
    path, out = dataflash(tmp_path / "flight.BIN"), tmp_path / "out"
    runner = CliRunner()

    shown = runner.invoke(app, ["info", str(path)])
    made = runner.invoke(
        app, ["export", str(path), "-o", str(out), "--at", "camera", "--exposure", "0.2", "--frames", "2"]
    )
    unable = runner.invoke(app, ["export", "-o", str(tmp_path / "none"), "--at", "camera"])

    assert "4 triggers (CAM), from 1.2 s to 7.1 s after the first attitude" in shown.output
    assert made.exit_code == 0, made.output
    truth = (out / "truth.jsonl").read_text().splitlines()
    assert [line.partition('"utc_start":"')[2][:26] for line in truth] == [
        "2024-03-10T11:00:01.250000",
        "2024-03-10T11:00:03.500000",
    ]
    assert unable.exit_code == 1
    assert "adelaide.BIN does not say when a camera was triggered" in unable.output


def test_images_take_the_times_of_the_triggers_in_natural_order(tmp_path: Path) -> None:
    flight = open_flight(dataflash(tmp_path / "flight.BIN"), time_offset_s=2.0)
    (tmp_path / "images").mkdir()
    for name in ("image2.png", "image10.png", "image1.png"):
        cv2.imwrite(str(tmp_path / "images" / name), np.zeros((4, 4), dtype=np.uint8))

    with pytest.raises(ImagesError, match=r"holds 3 images, but flight.BIN has 4 triggers \(CAM\)"):
        triggered_images([tmp_path / "images"], flight)
    cv2.imwrite(str(tmp_path / "images" / "image11.png"), np.zeros((4, 4), dtype=np.uint8))
    images = triggered_images([tmp_path / "images"], flight)

    assert [image.path.name for image in images] == ["image1.png", "image2.png", "image10.png", "image11.png"]
    # By the camera's clock, which is 2 s ahead.
    times_s = [image.time.utc_s - 2.0 - ELEVEN_S for image in images]
    np.testing.assert_allclose(times_s, TRIGGERS_S, rtol=0, atol=1e-3)


def test_the_shutter_opens_later_than_the_trigger(tmp_path: Path) -> None:
    flight = open_flight(dataflash(tmp_path / "flight.BIN"))
    exposure = Config().override(**{"exposure.at": "camera", "exposure.at_delay_s": 0.125}).exposure
    folder = tmp_path / "images"
    folder.mkdir()
    for name in "abcd":
        cv2.imwrite(str(folder / f"{name}.png"), np.zeros((4, 4), np.uint8))

    plan = plan_frames(flight, exposure, start_s=0.0, stop_s=None, frames=None)
    images = triggered_images([folder], flight, delay_s=0.125)

    opened_s = flight.triggers_of("camera").utc_s + 0.125
    np.testing.assert_allclose([f.exposure.start_utc_s for f in plan.frames], opened_s, rtol=0, atol=1e-6)
    np.testing.assert_allclose([i.time.utc_s for i in images], opened_s, rtol=0, atol=1e-6)


def test_a_data_set_has_the_triggers_of_every_sample(tmp_path: Path) -> None:
    paths = [dataflash(tmp_path / "whole.BIN"), dataflash(tmp_path / "torn.BIN", gap=(3.6, 5.0))]
    (tmp_path / "set.toml").write_text(
        "[camera]\nwidth_px = 64\nheight_px = 48\nfx_px = 60.0\nfy_px = 60.0\n[exposure]\nduration_s = 0.2\n"
        "[sweep]\nexposure.at_delay_s = [0.0, 0.25]\n"
    )
    words = ["export", *map(str, paths), "-o", str(tmp_path / "set"), "-c", str(tmp_path / "set.toml")]

    made = CliRunner().invoke(app, [*words, "--at", "camera", "--workers", "1"])

    assert made.exit_code == 0, made.output
    lines = [json.loads(line) for line in (tmp_path / "set" / "truth.jsonl").read_text().splitlines()]
    opened = [(line["flight"], line["frame"], round(parse_utc(line["utc_start"]) - ELEVEN_S, 3)) for line in lines]
    whole = [("whole.BIN", n, t) for n, t in enumerate([*TRIGGERS_S, *(t + 0.25 for t in TRIGGERS_S)])]
    # The second trigger opens 0.1 s before the gap, the third within it.
    torn = [("torn.BIN", n, t) for n, t in ((8, 1.25), (11, 7.125), (12, 1.5), (15, 7.375))]
    assert opened == whole + torn
    skipped = json.loads((tmp_path / "set" / "manifest.json").read_text())["skipped"]
    assert [frame["number"] for frame in skipped] == [9, 10, 13, 14]


def two_cameras(path: Path) -> Path:
    """Write a flight with a camera that is triggered at `TRIGGERS_S`, and another one 0.5 s later, once less."""
    with Bag(path, "mcap") as bag:
        for k in range(TIMES_S.size):
            bag.imu(k, START_NS, ENU_FLU)
            bag.fix(k, START_NS)
        for k in (10, 30, 50):
            bag.camera_info(k, START_NS, "/cam0/camera_info")
            if k > 10:
                bag.camera_info(k + 5, START_NS, "/cam1/camera_info")
    return path


def test_triggers_of_two_cameras_are_never_merged(tmp_path: Path) -> None:
    path = two_cameras(tmp_path / "bag")
    flight = open_flight(path)

    first_s, second_s = (flight.triggers_of(f"/cam{k}/camera_info").utc_s - START_NS * 1e-9 for k in (0, 1))
    shown = CliRunner().invoke(app, ["info", str(path)])
    made = CliRunner().invoke(app, ["export", str(path), "-o", str(tmp_path / "out"), "--at", "camera"])

    np.testing.assert_allclose(first_s, TIMES_S[[10, 30, 50]], rtol=0, atol=1e-6)
    np.testing.assert_allclose(second_s, TIMES_S[[35, 55]], rtol=0, atol=1e-6)
    assert "3 triggers (/cam0/camera_info)" in shown.output
    assert "--at /cam1/camera_info exposes at them" in shown.output
    assert made.exit_code == 1
    assert (
        "has triggers of 2 cameras; give one to --at: /cam0/camera_info (3 triggers), /cam1/camera_info" in made.output
    )
    with pytest.raises(ConfigError, match=r"no triggers of '/cam2' \(--at\); it has /cam0/camera_info \(3 triggers\)"):
        flight.triggers_of("/cam2")


def test_an_export_exposes_at_the_triggers_of_the_chosen_camera(tmp_path: Path) -> None:
    flight = open_flight(two_cameras(tmp_path / "bag"))
    exposure = Config().override(**{"exposure.at": "/cam1/camera_info", "exposure.duration_s": 0.1}).exposure

    frames = plan_frames(flight, exposure, start_s=0.0, stop_s=None, frames=None).frames

    opened_s = [frame.exposure.start_utc_s - START_NS * 1e-9 for frame in frames]
    np.testing.assert_allclose(opened_s, TIMES_S[[35, 55]], rtol=0, atol=1e-6)
    with pytest.raises(ConfigError, match=r"exposure\.at.*must be \"camera\", or of several"):
        Config().override(**{"exposure.at": "cam1"})
