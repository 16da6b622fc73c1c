"""When a camera was triggered, by every log that says so, and the exposures at these times."""

import json
import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any

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
from tests.support import tlog
from tests.support import ulog as px4
from tests.support.bags import ENU_FLU, START_NS, TIMES_S, Bag
from tests.support.dataflash import Log, TextLog, times
from tests.support.triggers import BOOT_S, ELEVEN_S, TRIGGERS_S, dataflash


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


def plan_of(
    flight: Flight, duration_s: float = 0.5, at: str = "camera", **limits: float | None
) -> list[tuple[int, float]]:
    exposure = Config().override(**{"exposure.at": at, "exposure.duration_s": duration_s}).exposure
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


# --- answers, failures and losses -----------------------------------------------------------------------------------
def px4_flight(path: Path, duration_s: float = 10.0) -> px4.Log:
    """Write attitude and fixes of a PX4 log; boot time 30 s is 11:00 UTC."""
    log = px4.Log()
    for t_s in px4.times(duration_s=duration_s):
        log.attitude(t_s)
    for t_s in px4.times(duration_s=duration_s, rate_hz=5):
        log.gps(t_s)
    return log


def seconds(flight: Flight, camera: str = "camera") -> list[float]:
    return np.round(flight.triggers_of(camera).utc_s - ELEVEN_S, 3).tolist()


@pytest.mark.parametrize("unanswered", [(), (1, 3)])
def test_triggers_and_answers_in_one_topic_are_one_exposure_each(tmp_path: Path, unanswered: tuple[int, ...]) -> None:
    log = px4_flight(tmp_path)
    for number, t_s in enumerate(TRIGGERS_S):
        log.trigger(BOOT_S + t_s, number)
        if number not in unanswered:
            log.trigger(BOOT_S + t_s + 0.12, number, feedback=True)

    flight = open_flight(log.save(tmp_path / "log.ulg"))

    assert seconds(flight) == [t_s + 0.12 for number, t_s in enumerate(TRIGGERS_S) if number not in unanswered]
    lost = "2 of 4 triggers (camera_trigger) have no answer and are left out"
    assert flight.notes == ((lost,) if unanswered else ())


def test_answers_in_another_instance_are_of_the_same_camera(tmp_path: Path) -> None:
    log = px4_flight(tmp_path)
    for number, t_s in enumerate(TRIGGERS_S):
        log.trigger(BOOT_S + t_s, number)
        log.trigger(BOOT_S + t_s + 0.12, number, feedback=True, instance=1)

    assert seconds(open_flight(log.save(tmp_path / "log.ulg"))) == [t_s + 0.12 for t_s in TRIGGERS_S]


def test_failed_captures_are_left_out_and_counted(tmp_path: Path) -> None:
    log = px4_flight(tmp_path)
    for number, t_s in enumerate(TRIGGERS_S):
        log.capture(BOOT_S + t_s, number, result=(1, 0, -1, 0)[number])

    flight = open_flight(log.save(tmp_path / "log.ulg"))

    assert seconds(flight) == [TRIGGERS_S[0], TRIGGERS_S[2]]
    assert flight.notes == ("2 of 4 captures (camera_capture) failed and are left out",)


def test_captures_that_all_failed_are_no_exposures(tmp_path: Path) -> None:
    log = px4_flight(tmp_path)
    for number, t_s in enumerate(TRIGGERS_S):
        log.trigger(BOOT_S + t_s, number)
        log.capture(BOOT_S + t_s, number, result=0)

    flight = open_flight(log.save(tmp_path / "log.ulg"))

    assert flight.triggers == ()
    assert flight.notes == ("4 of 4 captures (camera_capture) failed and are left out",)


def test_triggers_are_used_while_px4_makes_no_captures_without_a_position(tmp_path: Path) -> None:
    log = px4_flight(tmp_path)
    for number, t_s in enumerate(TRIGGERS_S):
        log.trigger(BOOT_S + t_s, number)
        if number > 1:
            log.capture(BOOT_S + t_s, number)

    flight = open_flight(log.save(tmp_path / "log.ulg"))

    assert seconds(flight) == TRIGGERS_S
    assert flight.notes == ("2 of 4 triggers (camera_trigger) have no camera_capture: PX4 had no position",)


def test_two_instances_of_captures_are_two_cameras(tmp_path: Path) -> None:
    log = px4_flight(tmp_path)
    for number, t_s in enumerate(TRIGGERS_S):
        log.capture(BOOT_S + t_s, number)
        if number:
            log.capture(BOOT_S + t_s + 0.5, number, instance=1)

    flight = open_flight(log.save(tmp_path / "log.ulg"))

    assert seconds(flight, "camera:0") == TRIGGERS_S
    assert seconds(flight, "camera:1") == [t_s + 0.5 for t_s in TRIGGERS_S[1:]]


def test_utc_of_a_trigger_that_the_clock_contradicts_is_not_used(tmp_path: Path) -> None:
    log = px4_flight(tmp_path)
    for number, t_s in enumerate(TRIGGERS_S):
        log.trigger(BOOT_S + t_s, number, utc_s=ELEVEN_S + t_s - (3600.0 if number < 2 else 0.0))

    flight = open_flight(log.save(tmp_path / "log.ulg"))

    assert seconds(flight) == TRIGGERS_S
    assert flight.notes == (
        "2 of 4 times of camera_trigger are -3600.0 s from the UTC of the log: its own clock dates these triggers",
    )


@pytest.mark.parametrize("kind", [Log, TextLog])
def test_each_camera_of_a_dataflash_log_has_its_own_triggers(tmp_path: Path, kind: type[Log]) -> None:
    log = kind()
    for t_s in times(duration_s=10.0):
        log.att(t_s)
        log.pos(t_s)
    for t_s in times(duration_s=10.0, rate_hz=5):
        log.gps(t_s)
        log.gpa(t_s)
    for number, t_s in enumerate(TRIGGERS_S):
        log.camera("TRIG", BOOT_S + t_s - 0.1, 1, number)
        log.camera("CAM", BOOT_S + t_s, 0, number)
        if number < 3:
            log.camera("CAM", BOOT_S + t_s + 0.25, 1, number)
        log.camera("TRIG", BOOT_S + t_s + 0.4, 2, number)

    flight = open_flight(log.save(tmp_path / "log.BIN"))

    assert seconds(flight, "camera:0") == TRIGGERS_S
    assert seconds(flight, "camera:1") == [t_s + 0.25 for t_s in TRIGGERS_S[:3]]
    assert seconds(flight, "camera:2") == [t_s + 0.4 for t_s in TRIGGERS_S]
    assert flight.notes == ("1 of 4 triggers of camera:1 (TRIG) have no answer (CAM)",)
    assert plan_of(flight, at="camera:1") == [(n, t_s + 0.25) for n, t_s in enumerate(TRIGGERS_S[:3])]


def feedback(path: Path, shots: list[tuple[float, float, int, int]]) -> Path:
    """Write ten seconds of a telemetry log; shots: time of arrival, time_usec in s, img_idx and cam_idx."""
    return telemetry_with(path, shots, tlog.Log.feedback)


def telemetry_with(path: Path, shots: list[Any], add: Callable[..., None]) -> Path:
    """Write ten seconds of a telemetry log, with a packet at the arrival of each shot."""
    log = tlog.Log()
    log.heartbeat()
    shots = sorted(shots)
    for k, t_s in enumerate(tlog.times(duration_s=10.0)):
        log.attitude(t_s)
        if k % 10 == 0:
            log.place(t_s)
            log.time(t_s)
        while shots and BOOT_S + shots[0][0] < t_s + 0.02:
            arrival_s, *shot = shots.pop(0)
            add(log, BOOT_S + arrival_s, *shot)
    return log.save(path)


def test_feedback_without_a_time_is_dated_by_arrival_and_numbered_by_the_camera(tmp_path: Path) -> None:
    shots = [(t_s + 0.03, 0.0 if n < 2 else ELEVEN_S + t_s, n, 0) for n, t_s in enumerate(TRIGGERS_S)]
    again = [(t_s + 0.5, time_s, n, camera) for t_s, time_s, n, camera in shots]

    flight = open_flight(feedback(tmp_path / "log.tlog", shots + again))

    assert plan_of(flight) == [(0, 1.28), (1, 3.53), (2, 3.9), (3, 7.125)]
    assert flight.notes == (
        "2 of 4 triggers of camera:0 have no time in CAMERA_FEEDBACK: their packets' arrival dates them, after the"
        " exposure",
    )


def test_the_number_of_feedback_goes_on_after_16_bits(tmp_path: Path) -> None:
    shots = [(t_s, ELEVEN_S + t_s, (65534 + n) % 2**16, 0) for n, t_s in enumerate(TRIGGERS_S)]

    flight = open_flight(feedback(tmp_path / "log.tlog", shots))

    assert plan_of(flight) == [(65534 + n, t_s) for n, t_s in enumerate(TRIGGERS_S)]
    assert flight.notes == ()


def test_lost_feedback_leaves_its_number_out(tmp_path: Path) -> None:
    shots = [(t_s, ELEVEN_S + t_s, n + 5, 0) for n, t_s in enumerate(TRIGGERS_S) if n != 1]

    flight = open_flight(feedback(tmp_path / "log.tlog", shots))

    assert plan_of(flight) == [(5, 1.25), (7, 3.9), (8, 7.125)]
    assert flight.notes == ("1 of the images 5 to 8 of camera:0 are missing in CAMERA_FEEDBACK: packets were lost",)


def test_each_camera_of_a_telemetry_log_has_its_own_triggers(tmp_path: Path) -> None:
    shots = [(t_s + k / 4, ELEVEN_S + t_s + k / 4, n, k) for k in (0, 1) for n, t_s in enumerate(TRIGGERS_S)]

    flight = open_flight(feedback(tmp_path / "log.tlog", shots))

    assert seconds(flight, "camera:0") == TRIGGERS_S
    assert seconds(flight, "camera:1") == [t_s + 0.25 for t_s in TRIGGERS_S]


def test_feedback_of_another_clock_is_dated_by_arrival(tmp_path: Path) -> None:
    """A UTC an hour from that of the autopilot, and a time before 2010 that is none since boot."""
    times_s = [ELEVEN_S - 3600.0, 315964800.0, BOOT_S + TRIGGERS_S[2], ELEVEN_S + TRIGGERS_S[3]]
    shots = [(t_s + 0.03, times_s[n], n, 0) for n, t_s in enumerate(TRIGGERS_S)]

    flight = open_flight(feedback(tmp_path / "log.tlog", shots))

    assert seconds(flight) == [1.28, 3.53, 3.9, 7.125]
    assert any("1 of 4 triggers of camera:0 have no time in CAMERA_FEEDBACK" in note for note in flight.notes)
    assert any("1 of 4 times of CAMERA_FEEDBACK are" in note for note in flight.notes)


def test_captures_of_px4_are_exposures_unless_they_failed(tmp_path: Path) -> None:
    """The second one failed, the third has no UTC; a camera that is a component of its own has another clock."""
    shots: list[Any] = [
        (t_s + 0.05, 0.0 if n == 2 else ELEVEN_S + t_s, BOOT_S + t_s, n, 1, n != 1, (1, 1))
        for n, t_s in enumerate(TRIGGERS_S)
    ]
    shots += [(t_s + 0.3, 0.0, 7.0 + t_s, n, 0, True, (1, 100)) for n, t_s in enumerate(TRIGGERS_S)]
    path = telemetry_with(tmp_path / "log.tlog", shots, tlog.Log.captured)

    flight = open_flight(path)

    assert plan_of(flight, at="camera:1") == [(0, 1.25), (2, 3.9), (3, 7.125)]
    assert seconds(flight, "camera:100") == [t_s + 0.3 for t_s in TRIGGERS_S]
    assert flight.notes == (
        "1 of 4 captures of camera:1 (CAMERA_IMAGE_CAPTURED) failed and are left out",
        "4 of 4 triggers of camera:100 have no time in CAMERA_IMAGE_CAPTURED: their packets' arrival dates them, after"
        " the exposure",
    )


def test_another_utc_of_the_flight_moves_triggers_with_utc_of_their_own(tmp_path: Path) -> None:
    shots = [(t_s + 0.4, ELEVEN_S + t_s, n, 0) for n, t_s in enumerate(TRIGGERS_S)]

    flight = open_flight(feedback(tmp_path / "log.tlog", shots), utc_start=ELEVEN_S + 3600)

    assert seconds(flight) == [3600 + t_s for t_s in TRIGGERS_S]
