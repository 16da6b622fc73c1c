"""The loop with a simulator: the sky of its true state, the autopilot's estimate in nav.jsonl."""

import io
import json
import socket
import threading
import time
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import zmq
from typer.testing import CliRunner

from glstar.camera.exposure import Exposure
from glstar.cli import app
from glstar.cli.flights.navigatoranswers import InjectedAnswers
from glstar.config import Config
from glstar.link import Endpoint, Injector
from glstar.sky.place.timescale import parse_utc
from tests.support.autopilot import (
    BIAS_RAD,
    ESTIMATED_DEG,
    MAVLINK,
    SMALL,
    TRUE_DEG,
    angle_rad,
    estimated_yaw_rad,
    lines,
    simulated,
    true_yaw_rad,
)
from tests.support.links import free_port, has_frames, interrupted_when, until

DEG = np.pi / 180


def test_the_sky_is_the_simulators_and_the_navigator_knows_the_estimate(tmp_path: Path) -> None:
    port, frames, config = free_port(), tmp_path / "frames", tmp_path / "small.toml"
    config.write_text(SMALL)
    words = f"live udpin:127.0.0.1:{port} --truth sim_state --every 0.2 --exposure 0.2 --duration 60 -c {config}"
    with simulated(port) as autopilot, interrupted_when(lambda: has_frames(frames, 6)):
        result = CliRunner().invoke(app, [*words.split(), "--export", str(frames)])
    assert result.exit_code == 0, result.output
    # Without --inject nothing but heartbeats and requests is sent.
    sent = {message.get_type() for message in autopilot.received}
    assert "HEARTBEAT" in sent
    assert sent <= {"HEARTBEAT", "COMMAND_LONG", "REQUEST_DATA_STREAM"}

    truth, nav = lines(frames / "truth.jsonl"), lines(frames / "nav.jsonl")
    assert [line["frame"] for line in nav] == [line["frame"] for line in truth]
    assert not (frames / "nav.jsonl.partial").exists()
    errors_rad = []
    for drawn, known in zip(truth, nav, strict=True):
        utc_s = parse_utc(drawn["utc_mid"])
        errors_rad.append(angle_rad(true_yaw_rad(utc_s), drawn["q_body_ned"]))
        assert known["schema"] == "glstar-nav-1"
        assert parse_utc(known["utc"]["middle"]) == pytest.approx(utc_s, rel=0, abs=1e-5)
        assert angle_rad(estimated_yaw_rad(utc_s), known["q_body_ned"]["middle"]) < 0.001 * DEG
        # 1 deg of yaw at 0.2 rad of pitch and more: the estimate is not the truth.
        assert angle_rad(true_yaw_rad(utc_s), known["q_body_ned"]["middle"]) > 0.9 * BIAS_RAD
        assert drawn["site"]["latitude_deg"] == pytest.approx(TRUE_DEG[0], rel=0, abs=1e-6)
        assert drawn["site"]["height_m"] == pytest.approx(TRUE_DEG[2], rel=0, abs=1e-6)
        assert known["position"]["latitude_deg"] == pytest.approx(ESTIMATED_DEG[0], rel=0, abs=1e-6)
    # A delayed packet may move one state by up to an interval of 20 ms: 0.1 deg at 5 deg/s.
    assert max(errors_rad) < 0.11 * DEG
    assert np.median(errors_rad) < 0.02 * DEG
    manifest = json.loads((frames / "manifest.json").read_text())
    assert manifest["flight"]["attitude"].startswith("SIM_STATE, ")


def test_rates_that_the_autopilots_loop_cannot_serve_are_requested_lower(tmp_path: Path) -> None:
    """ArduPlane denies 100 Hz: the sky was then drawn from SIMSTATE, which has no height, of its data stream."""
    port, frames, config = free_port(), tmp_path / "frames", tmp_path / "small.toml"
    config.write_text(SMALL)
    words = f"live udpin:127.0.0.1:{port} --truth sim_state --every 0.2 --exposure 0.2 --duration 60 -c {config}"
    with simulated(port, loop_hz=50.0) as autopilot, interrupted_when(lambda: has_frames(frames, 6)):
        result = CliRunner().invoke(app, [*words.split(), "--export", str(frames)])
    assert result.exit_code == 0, result.output

    asked_hz: dict[int, list[float]] = {}
    for message in autopilot.received:
        if message.get_type() == "COMMAND_LONG" and message.param2:
            asked_hz.setdefault(int(message.param1), []).append(round(1e6 / message.param2, 6))
    assert asked_hz[MAVLINK.MAVLINK_MSG_ID_ATTITUDE_QUATERNION] == [100.0, 50.0, 40.0]
    assert asked_hz[MAVLINK.MAVLINK_MSG_ID_SIM_STATE] == [100.0, 50.0, 40.0]
    assert not asked_hz.keys() & {MAVLINK.MAVLINK_MSG_ID_ATTITUDE, MAVLINK.MAVLINK_MSG_ID_SIMSTATE}
    manifest = json.loads((frames / "manifest.json").read_text())
    assert manifest["flight"]["attitude"].startswith("SIM_STATE, ")


def solver(frames: Path, answers: Path, over: threading.Event, sigma_km: float = 2.0) -> None:
    """Answer each frame 0.1 km north of where the truth says, with a circle of one standard deviation."""
    answered = 0
    while not over.wait(0.02):
        partial = frames / "nav.jsonl.partial"
        known: list[Any] = []
        with suppress(FileNotFoundError):  # until the first frame, and after the last
            known = lines(partial) if partial.read_bytes().endswith(b"\n") else []
        with answers.open("a") as file:
            for line in known[answered:]:
                circle = {"ellipse_major_km": sigma_km, "ellipse_minor_km": sigma_km, "ellipse_azimuth_deg": 0}
                circle |= {"ellipse_confidence": -np.expm1(-0.5)}
                answer = {"frame": line["frame"], "latitude_deg": TRUE_DEG[0] + 0.0009, "longitude_deg": TRUE_DEG[1]}
                file.write(json.dumps({**answer, **circle}) + "\n")
                answered += 1


def test_injected_answers_arrive_with_their_delay_and_accuracy(tmp_path: Path) -> None:
    port, frames, answers, config = free_port(), tmp_path / "frames", tmp_path / "answers", tmp_path / "small.toml"
    config.write_text(SMALL)
    stale = '{"frame": 0, "latitude_deg": 1.0, "longitude_deg": 1.0}\n'
    answers.write_text(stale)
    words = f"live udpin:127.0.0.1:{port} --truth sim_state --every 0.3 --exposure 0.2 --duration 60 -c {config}"
    more = ["--json", "--export", str(frames), "--inject", "--answers", str(answers)]
    over = threading.Event()
    thread = threading.Thread(target=solver, args=(frames, answers, over))
    thread.start()
    with simulated(port) as autopilot:
        fixes: list[Any] = []

        def has_fixes() -> bool:
            fixes[:] = [message for message in autopilot.received if message.get_type() == "COMMAND_INT"]
            return len(fixes) >= 4

        with interrupted_when(has_fixes):
            result = CliRunner().invoke(app, [*words.split(), *more])
    over.set()
    thread.join()
    assert result.exit_code == 0, result.output

    assert json.loads(result.stdout)["injected"] >= 4
    assert "the autopilot accepts the positions" in result.stderr
    for fix in fixes:
        assert fix.command == MAVLINK.MAV_CMD_EXTERNAL_POSITION_ESTIMATE
        assert (fix.x, fix.y) == (round((TRUE_DEG[0] + 0.0009) * 1e7), round(TRUE_DEG[1] * 1e7))
        # The middle of an exposure of 0.2 s is at least 0.1 s ago.
        assert 0.1 <= fix.param2 < 5.0
        assert fix.param3 == pytest.approx(2000.0, rel=0, abs=0.1)
    kinds = {message.get_type() for message in autopilot.received}
    assert kinds <= {"HEARTBEAT", "COMMAND_LONG", "REQUEST_DATA_STREAM", "COMMAND_INT"}


@pytest.mark.parametrize(("message", "sigma_km"), [("gps_input", 0.08), ("global_position_sensor", 2.0)])
def test_answers_are_injected_as_another_message(tmp_path: Path, message: str, sigma_km: float) -> None:
    port, frames, answers, config = free_port(), tmp_path / "frames", tmp_path / "answers", tmp_path / "small.toml"
    config.write_text(SMALL)
    words = f"live udpin:127.0.0.1:{port} --truth sim_state --every 0.3 --exposure 0.2 --duration 60 -c {config}"
    more = ["--export", str(frames), "--inject", "--inject-as", message, "--answers", str(answers)]
    over = threading.Event()
    thread = threading.Thread(target=solver, args=(frames, answers, over, sigma_km))
    thread.start()
    with simulated(port) as autopilot:

        def fixes() -> list[Any]:
            return [one for one in autopilot.received if one.get_type() == message.upper()]

        with interrupted_when(lambda: len(fixes()) >= 2):
            result = CliRunner().invoke(app, [*words.split(), *more])
    over.set()
    thread.join()
    assert result.exit_code == 0, result.output
    for fix in fixes():
        assert (fix.lat, fix.lon) == (round((TRUE_DEG[0] + 0.0009) * 1e7), round(TRUE_DEG[1] * 1e7))
        sigma_m = fix.horiz_accuracy if message == "gps_input" else fix.eph
        assert sigma_m == pytest.approx(1000 * sigma_km, rel=0, abs=0.1)
    kinds = {one.get_type() for one in autopilot.received}
    asked = {"PARAM_REQUEST_READ"} if message == "gps_input" else set()
    assert kinds <= {"HEARTBEAT", "COMMAND_LONG", "REQUEST_DATA_STREAM", message.upper()} | asked


def test_an_answer_that_cannot_be_sent_is_reported(tmp_path: Path) -> None:
    source, messages = tmp_path / "answers", list[str]()
    exposure = Exposure(1e9, 0.5)
    injector = Injector(Endpoint.parse("udpin:127.0.0.1:1"))
    config = Config().override(**{"flight.time_offset_s": 40.0, "navigator.clock_offset_s": -10.0})
    with InjectedAnswers(source, injector, {3: exposure, "frame_000003.png": exposure}, config, messages.append):
        source.write_text(
            '{"frame": 4, "latitude_deg": 1, "longitude_deg": 2}\n{"frame": 3\n{"frame": 3, "status": "refused"}\n'
            '{"frame": 3, "latitude_deg": 1, "longitude_deg": 2, "instant": "end"}\n'
            '{"file": "frame_000003.png", "latitude_deg": 1, "longitude_deg": 2}\n'
            '{"frame": 3, "file": "frame_000004.png", "latitude_deg": 1, "longitude_deg": 2}\n'
            '{"file": "frame_000003.png", "utc": "2001-09-09T01:46:40Z", "latitude_deg": 1, "longitude_deg": 2}\n'
            '{"file": "frame_000003.png", "utc": "2001-09-09T01:47:10Z", "latitude_deg": 1, "longitude_deg": 2,'
            ' "replaces": true}\n'
            '{"frame": 3, "latitude'
        )
        until(lambda: len(injector._fixes) == 2, "the two answers")

    assert [fix.utc_s for fix in injector._fixes] == [exposure.stop_utc_s, exposure.mid_utc_s]
    assert len(messages) == 5
    assert "line 1 answers frame 4, which was not drawn" in messages[0]
    assert "line 2 is no JSON" in messages[1]
    assert "line 5 answers frame frame_000003.png again; line 4 counts" in messages[2]
    assert "line 6 contradicts itself: frame 3 is not frame_000004.png" in messages[3]
    assert "line 7 contradicts itself: its utc is -30.2 s from the middle of frame frame_000003.png" in messages[4]


HOSTILE = [
    b'{"frame": 3, "latitude_deg": 138.6, "longitude_deg": -34.93}',
    b'{"frame": 3, "latitude_deg": 1, "longitude_deg": 1e12}',
    b'{"frame": 3, "latitude_deg": 1e999, "longitude_deg": 2}',
    b'{"frame": 3, "stars": [[1, 2, 9223372036854775808]]}',
    b'{"frame": ' + b"9" * 400 + b"}",
    b"[" * 3000,
    b"\xff\xfe\x00",
    b"x" * 1_500_000,
    b'{"frame": 3, "latitude_deg": NaN, "longitude_deg": 2}',
    b'{"frame": 3, "latitude_deg": 1, "longitude_deg": 2, "ellipse_major_km": 1e300, "ellipse_minor_km": 1,'
    b' "ellipse_azimuth_deg": 0}',
]


@pytest.mark.parametrize("source", ["file", "socket", "pipe"])
def test_whatever_arrives_the_answers_after_it_are_sent(source: str, tmp_path: Path, monkeypatch) -> None:
    messages = list[str]()
    exposure = Exposure(1e9, 0.5)
    injector = Injector(Endpoint.parse("udpin:127.0.0.1:1"))
    right = b'{"frame": 4, "latitude_deg": -34.93, "longitude_deg": 498.6}'
    port, path = free_port(socket.SOCK_STREAM), tmp_path / "answers"
    where = {"file": path, "socket": f"zmq://127.0.0.1:{port}", "pipe": Path("-")}[source]
    lines = [*HOSTILE, right]
    if source == "pipe":
        monkeypatch.setattr("sys.stdin", io.TextIOWrapper(io.BytesIO(b"\n".join(lines))))
    with InjectedAnswers(where, injector, {3: Exposure(0.9e9, 0.5), 4: exposure}, Config(), messages.append):
        if source == "file":
            path.write_bytes(b"\n".join(lines) + b"\n")
        if source == "socket":
            # A client that sends too much is cut off, and with it what it has sent since; others are not.
            for part in (lines[:8], lines[8:]):
                push = zmq.Context.instance().socket(zmq.PUSH)
                push.connect(f"tcp://127.0.0.1:{port}")
                for line in part:
                    push.send(line)
                push.close()
        until(lambda: injector._fixes, "the answer")

    (fix,) = injector._fixes
    assert np.rad2deg([fix.latitude_rad, fix.longitude_rad]) == pytest.approx([-34.93, 138.6], rel=0, abs=1e-9)
    assert len(messages) == len(HOSTILE) - (source == "socket")
    assert all(len(message) < 400 for message in messages)


def test_a_link_that_dies_ends_the_command_with_one_line(tmp_path: Path, monkeypatch) -> None:
    def die(*_: object) -> None:
        raise ZeroDivisionError("made for a test")

    port = free_port()
    words = f"live udpin:127.0.0.1:{port} --duration 60 --record {tmp_path / 'flight.tlog'} --headless"
    monkeypatch.setattr("glstar.link.receiver.Receiver._on_heartbeat", die)
    began_s = time.monotonic()
    with simulated(port):
        result = CliRunner().invoke(app, words.split())

    assert result.exit_code == 1
    assert result.output.splitlines()[-1].endswith(
        "ended by an internal error of glstar: ZeroDivisionError('made for a test')"
    )
    assert time.monotonic() - began_s < 30


def test_answers_that_cannot_be_read_any_more_end_the_command_with_one_line(tmp_path: Path, monkeypatch) -> None:
    port, frames, config = free_port(), tmp_path / "frames", tmp_path / "small.toml"
    config.write_text(SMALL)
    answers = tmp_path / "answers"

    def die(*_: object) -> None:
        raise ZeroDivisionError("made for a test")

    monkeypatch.setattr("glstar.cli.flights.navigatoranswers.parse_answer", die)
    answers.touch()
    words = f"live udpin:127.0.0.1:{port} --every 0.3 --exposure 0.2 --duration 60 -c {config} --export {frames}"
    began_s = time.monotonic()

    def answering() -> None:
        until(lambda: has_frames(frames, 1), "a frame")
        answers.write_text("{}\n")

    thread = threading.Thread(target=answering)
    thread.start()
    with simulated(port):
        result = CliRunner().invoke(app, [*words.split(), "--inject", "--answers", str(answers)])
    thread.join()

    assert result.exit_code == 1
    assert "could not be read to the end: made for a test" in result.output.splitlines()[-1]
    assert time.monotonic() - began_s < 40
    assert (frames / "truth.jsonl").exists()  # what was drawn is complete


@pytest.mark.parametrize(
    ("flags", "words"),
    [
        (["--inject", "--answers", "a"], "--export or --latest-frame"),
        (["--inject", "--export", "frames"], "add --answers"),
        (["--answers", "a", "--export", "frames"], "belongs to --inject"),
        (["--inject-as", "gps_input", "--export", "frames"], "belongs to --inject"),
    ],
)
def test_incomplete_flags_of_injection_are_usage_errors(flags: list[str], words: str) -> None:
    result = CliRunner().invoke(app, ["live", f"udpin:127.0.0.1:{free_port()}", *flags], env={"COLUMNS": "200"})

    assert result.exit_code == 2
    assert words in result.stderr


def test_a_link_without_a_simulators_state_says_so_in_one_line(tmp_path: Path) -> None:
    port = free_port()
    words = f"live udpin:127.0.0.1:{port} --truth sim_state --duration 1 --export {tmp_path / 'frames'}"
    with simulated(port, None):
        result = CliRunner().invoke(app, words.split())

    assert result.exit_code == 1
    assert "sent no SIM_STATE, HIL_STATE_QUATERNION or SIMSTATE" in result.output.splitlines()[-1]


def test_a_message_of_a_log_is_no_estimate_of_a_link(tmp_path: Path) -> None:
    port, config = free_port(), tmp_path / "att.toml"
    config.write_text('[navigator]\nattitude = "ATT"\n')
    words = f"live udpin:127.0.0.1:{port} --truth sim_state --duration 1 -c {config} --export {tmp_path / 'frames'}"
    result = CliRunner().invoke(app, words.split())

    assert result.exit_code == 1
    assert "navigator.attitude" in result.output
    assert "a message of a log" in result.output
    assert not (tmp_path / "frames" / "manifest.json").exists()
