"""Flights played over loopback and pseudo-terminals: the link's flight equals that of its log."""

import json
import os
import random
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from typer.testing import CliRunner

from glstar.cli import app
from glstar.config import Config
from glstar.errors import LinkError
from glstar.export.publish.latest import LatestFrameReader
from glstar.flight import Flight
from glstar.link import Endpoint, Framer, Link, Recorder, open_transport, supervisor
from glstar.link.packets import dialect
from glstar.sky.place.timescale import parse_utc
from glstar.system.resources import asset
from tests.support.links import Plug, farthest_rad, free_port, has_frames, interrupted_when, playing, until

DEG = np.pi / 180
POSIX = pytest.mark.skipif(os.name != "posix", reason="needs pseudo-terminals")


@pytest.fixture(scope="module")
def flight() -> Flight:
    return Config().open_flight(asset("adelaide.BIN"))


@pytest.fixture(autouse=True)
def _no_thread_stays() -> Iterator[None]:
    before = set(threading.enumerate())
    yield
    assert set(threading.enumerate()) <= before


def has_flown(link: Link, seconds: float = 1.0) -> Flight:
    """Return the link's flight when it is long enough."""

    def found() -> Flight | None:
        flight = link.flight()
        return flight if flight and flight.attitude.last_s - flight.attitude.first_s > seconds else None

    result = until(found, f"{seconds} s of flight")
    assert isinstance(result, Flight)
    return result


# The command line; it restores the handler of Ctrl-C, since a process in the background ignores SIGINT.
WITH_CTRL_C = """
import signal
signal.signal(signal.SIGINT, signal.default_int_handler)
from glstar.cli import app
app()
"""


# --- the flight of a link ---------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("vehicle", "ground"), [("udpout", "udpin"), ("tcpin", "tcp")])
def test_the_attitude_of_a_network_link_is_that_of_the_log_at_its_utc(
    vehicle: str, ground: str, flight: Flight
) -> None:
    port = free_port(socket.SOCK_STREAM)
    with (
        playing(flight, f"{vehicle}:127.0.0.1:{port}", rate_hz=10, start_s=5.0),
        Link(Endpoint.parse(f"{ground}:127.0.0.1:{port}"), rate_hz=50) as link,
    ):
        until(lambda: link.status().rate_hz > 40, "the rate that was asked for")
        received = has_flown(link)
        status = link.status()

    assert farthest_rad(received.attitude, flight.attitude) < 0.001 * DEG
    assert received.attitude_source.startswith("ATTITUDE_QUATERNION")
    assert received.utc_source.startswith("SYSTEM_TIME")
    assert np.rad2deg(received.position.at(received.attitude.last_s).latitude_rad) == pytest.approx(-34.81, abs=0.01)
    assert (status.state, status.sysid, status.vehicle, status.lost) == ("live", 1, "fixed wing", 0)


@POSIX
def test_a_link_recovers_when_its_port_is_unplugged_and_plugged_in_again(
    flight: Flight, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    # When the port is back, the link tries again at once and not after the pause.
    monkeypatch.setattr(supervisor, "_FIRST_PAUSE_S", 600.0)
    monkeypatch.setattr(supervisor, "_LONGEST_PAUSE_S", 600.0)
    plug = Plug(tmp_path / "ttyUSB0")
    with playing(flight, plug, rate_hz=50) as vehicle, Link(Endpoint.parse(f"{plug.port},57600")) as link:
        has_flown(link, 0.5)
        plug.pull_out()
        problem = until(lambda: link.status().problem, "the problem")
        assert "still plugged in?" in problem or "no such serial port" in problem
        packets, played_s = link.status().packets, vehicle._now_s
        until(lambda: vehicle._now_s > played_s + 2.5, "more of the flight")
        assert link.status().packets == packets

        plug.plug_in()
        until(lambda: link.status().packets > packets + 20, "packets after the port is back")
        received = has_flown(link)

        assert link.status().problem is None
        assert "packets are received again" in [event.message for event in link.events()]
        # One gap while unplugged; short gaps only where the vehicle dropped late packets on a busy machine.
        gaps = received.attitude.gaps
        assert len(gaps) == 1 or vehicle._dropped
        assert {gap.reason for gap in gaps} == {"a data gap"}
        assert [gap for gap in gaps if gap.duration_s > 2.0] == [max(gaps, key=lambda gap: gap.duration_s)]
        assert farthest_rad(received.attitude, flight.attitude) < 0.001 * DEG


@POSIX
def test_damaged_bytes_cost_packets_but_never_a_wrong_attitude(flight: Flight, tmp_path: Path) -> None:
    chance = random.Random(1)

    def damage(packet: bytes) -> bytes:
        flipped = (byte ^ (1 << chance.randrange(8)) if chance.random() < 0.01 else byte for byte in packet)
        return bytes(byte for byte in flipped if chance.random() >= 0.005)

    plug = Plug(tmp_path / "ttyUSB0", damage)
    with playing(flight, plug, rate_hz=50), Link(Endpoint.parse(str(plug.port))) as link:
        received = has_flown(link, 2.0)
        status = link.status()

    assert farthest_rad(received.attitude, flight.attitude) < 0.001 * DEG
    assert status.lost > 10
    assert status.bad_bytes > 100


def test_a_flight_continues_after_a_restart_that_resets_the_sender_s_clock(flight: Flight) -> None:
    port = free_port()
    with Link(Endpoint.parse(f"udpin:127.0.0.1:{port}")) as link:
        with playing(flight, f"udpout:127.0.0.1:{port}", rate_hz=50, speed=8.0):
            has_flown(link, 8.0)
        with playing(flight, f"udpout:127.0.0.1:{port}", rate_hz=50, start_s=100.0):
            until(lambda: any("restarted" in event.message for event in link.events()), "the restart")
            until(lambda: str(link.status().utc_source).startswith("SYSTEM_TIME"), "UTC")
            until(
                lambda: (
                    (heard := link.flight()) is not None and heard.attitude.last_s > flight.attitude.first_s + 101.0
                ),
                "a second of flight",
            )
            received = has_flown(link)

    # The flight before the restart is kept, and nothing is interpolated across it.
    (gap,) = (gap for gap in received.attitude.gaps if gap.reason == "a reboot of the autopilot")
    assert received.attitude.first_s < flight.attitude.first_s + 1.0
    assert gap.stop_utc_s >= flight.attitude.first_s + 100.0
    assert farthest_rad(received.attitude, flight.attitude) < 0.001 * DEG


@pytest.mark.parametrize(("requested", "used"), [(None, 1), (2, 2)])
def test_the_first_of_two_autopilots_is_used_or_the_requested_one(
    requested: int | None, used: int, flight: Flight
) -> None:
    port = free_port()
    with (
        Link(Endpoint.parse(f"udpin:127.0.0.1:{port}"), sysid=requested) as link,
        playing(flight, f"udpout:127.0.0.1:{port}"),
    ):
        until(lambda: 1 in link.status().systems, "the first")
        with playing(flight, f"udpout:127.0.0.1:{port}", start_s=60.0, sysid=2):
            until(lambda: link.status().systems == (1, 2), "the second")
            received = has_flown(link)

    assert link.status().sysid == used
    assert farthest_rad(received.attitude, flight.attitude) < 0.001 * DEG
    assert (received.attitude.last_s > flight.attitude.first_s + 60.0) == (used == 2)


def test_a_vehicle_that_refuses_intervals_is_asked_for_streams(flight: Flight) -> None:
    port = free_port()

    def refuse(command: Any, sender: tuple[int, int]) -> Any:
        result = dialect().MAV_RESULT_UNSUPPORTED
        return dialect().MAVLink_command_ack_message(command.command, result, 0, 0, *sender)

    with (
        playing(flight, f"udpout:127.0.0.1:{port}", rate_hz=0.5) as vehicle,
        Link(Endpoint.parse(f"udpin:127.0.0.1:{port}"), rate_hz=20) as link,
    ):
        vehicle._execute = refuse  # type: ignore[method-assign]
        until(lambda: link.status().rate_hz > 15, "the stream")
        received = has_flown(link)

    assert received.attitude_source.startswith("ATTITUDE,")
    assert farthest_rad(received.attitude, flight.attitude) < 0.001 * DEG


def test_the_usual_message_rates_are_restored_on_leaving(flight: Flight) -> None:
    port = free_port()
    with playing(flight, f"udpout:127.0.0.1:{port}", rate_hz=10) as vehicle:
        usual_s = dict(vehicle._interval_s)
        with Link(Endpoint.parse(f"udpin:127.0.0.1:{port}"), rate_hz=50):
            until(lambda: vehicle._interval_s != usual_s, "another rate")
        until(lambda: vehicle._interval_s == usual_s, "the usual rates")


def test_glstar_only_ever_sends_heartbeats_and_message_requests(flight: Flight) -> None:
    mavlink = dialect()
    evil = mavlink.MAVLink(None, srcSystem=1, srcComponent=1)
    port = free_port()
    sent: list[Any] = []
    with (
        Link(Endpoint.parse(f"udpin:127.0.0.1:{port}")) as link,
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as peer,
    ):
        peer.settimeout(0.1)
        framer = Framer()
        for number in sorted(mavlink.mavlink_map):
            kind = mavlink.mavlink_map[number]
            whole = evil.heartbeat_encode(1, 3, 0, 0, 4, 3).pack(evil)
            content = bytes(kind.unpacker.size) if number else whole[10:-2]
            head = bytes([0xFD, len(content), 0, 0, 0, 1, 1]) + number.to_bytes(3, "little") + content
            total = mavlink.x25crc(head[1:] + bytes([kind.crc_extra])).crc
            peer.sendto(head + total.to_bytes(2, "little"), ("127.0.0.1", port))
        # Until all packets have arrived and glstar has requested messages four times.
        end_s, requests = time.monotonic() + 60.0, 0
        while requests < 4 or link.status().packets <= 300:
            with suppress(TimeoutError):
                replies = [evil.decode(bytearray(p.content)) for p in framer.feed(peer.recv(4096))]
                requests += any(message.get_type() == "COMMAND_LONG" for message in replies)
                sent += replies
            assert time.monotonic() < end_s

    assert {message.get_type() for message in sent} <= {"HEARTBEAT", "COMMAND_LONG", "REQUEST_DATA_STREAM"}
    assert {message.command for message in sent if message.get_type() == "COMMAND_LONG"} == {
        mavlink.MAV_CMD_SET_MESSAGE_INTERVAL
    }


# --- messages about problems ------------------------------------------------------------------------------------------


def test_a_busy_udp_port_is_reported_and_not_shared(tmp_path: Path) -> None:
    port = free_port()
    with open_transport(Endpoint.parse(f"udpin:127.0.0.1:{port}")), pytest.raises(LinkError) as refusal:
        Link(Endpoint.parse(f"udpin:127.0.0.1:{port}")).__enter__()

    assert f"another program listens on UDP port {port}" in str(refusal.value)


@POSIX
def test_each_kind_of_invalid_port_has_a_message_of_its_own(tmp_path: Path) -> None:
    (tmp_path / "flight.tlog").write_bytes(b"x")
    for name, words in (
        (f"{tmp_path}/flight.tlog", "is a file, not a port"),
        (f"{tmp_path}/ttyUSB7", "there is no such serial port"),
        (f"{tmp_path}", "is no serial port"),
        ("/dev/null", "is no serial port"),
        (f"tcp:127.0.0.1:{free_port(socket.SOCK_STREAM)}", "no program listens on TCP port"),
        ("udpin:203.0.113.7:14550", "is no address of this computer"),
    ):
        with pytest.raises(LinkError) as refusal:
            open_transport(Endpoint.parse(name))
        assert words in str(refusal.value), name


@POSIX
def test_a_serial_port_used_by_another_program_is_reported(tmp_path: Path) -> None:
    plug = Plug(tmp_path / "ttyUSB0")
    with plug, open_transport(Endpoint.parse(str(plug.port))), pytest.raises(LinkError) as refusal:
        open_transport(Endpoint.parse(str(plug.port)))

    assert "another program uses this port" in str(refusal.value)


@POSIX
def test_bytes_without_packets_are_a_wrong_baud_rate(flight: Flight, tmp_path: Path) -> None:
    chance = random.Random(3)
    plug = Plug(tmp_path / "ttyUSB0", lambda packet: chance.randbytes(len(packet)))
    with playing(flight, plug, rate_hz=50), Link(Endpoint.parse(f"{plug.port},57600")) as link:
        until(lambda: "wrong baud rate?" in str(link.status().problem), "the message")


def test_a_link_without_packets_suggests_that_another_program_listens() -> None:
    with Link(Endpoint.parse(f"udpin:127.0.0.1:{free_port()}")) as link:
        problem = until(lambda: link.status().problem, "the message")

    assert "no packets on udpin" in problem
    assert "QGroundControl" in problem


# --- the command line -------------------------------------------------------------------------------------------------


def test_every_frame_of_a_live_export_has_the_attitude_of_the_log_at_its_utc(flight: Flight, tmp_path: Path) -> None:
    port = free_port()
    with playing(flight, f"udpout:127.0.0.1:{port}", rate_hz=50, start_s=20.0):
        words = f"live udpin:127.0.0.1:{port} --duration 90 --every 0.5 --exposure 0.2 --json".split()
        more = [
            "--time-offset",
            "-7.5",
            "--export",
            str(tmp_path / "frames"),
            "--record",
            str(tmp_path / "flight.tlog"),
        ]
        with interrupted_when(lambda: has_frames(tmp_path / "frames", 4)):
            result = CliRunner().invoke(app, [*words, *more])
    assert result.exit_code == 0, result.output
    facts = json.loads(result.stdout)

    lines = [json.loads(line) for line in (tmp_path / "frames" / "truth.jsonl").read_text().splitlines()]
    assert len(lines) == facts["drawn"] >= 3
    for line in lines:
        assert line["schema"] == "glstar-truth-2"
        assert (tmp_path / "frames" / line["file"]).read_bytes().startswith(b"\x89PNG")
        expected = flight.attitude.at(parse_utc(line["utc_mid"]))
        assert 2 * np.arccos(min(abs(expected @ line["q_body_ned"]), 1.0)) < 0.1 * DEG
        # The camera's clock is 7.5 s behind.
        later_s = parse_utc(line["camera_utc_mid"]) - parse_utc(line["utc_mid"])
        assert later_s == pytest.approx(-7.5, abs=1e-5)
    manifest = json.loads((tmp_path / "frames" / "manifest.json").read_text())
    assert manifest["frames"] == len(lines)
    assert manifest["flight"]["utc"].startswith("SYSTEM_TIME")
    assert 0 < facts["latency_median_s"] <= facts["latency_95_s"]
    # The recording is the same flight.
    recorded = Config().open_flight(tmp_path / "flight.tlog")
    assert farthest_rad(recorded.attitude, flight.attitude) < 0.001 * DEG


def test_a_directory_with_frames_is_not_overwritten(flight: Flight, tmp_path: Path) -> None:
    (tmp_path / "frame_000000.png").write_bytes(b"dear")
    port = free_port()
    with playing(flight, f"udpout:127.0.0.1:{port}"):
        result = CliRunner().invoke(app, ["live", f"udpin:127.0.0.1:{port}", "--export", str(tmp_path)])

    assert result.exit_code == 1
    assert "holds frames already" in result.output
    assert (tmp_path / "frame_000000.png").read_bytes() == b"dear"


@POSIX
def test_a_recording_is_complete_to_the_last_packet_after_a_kill(flight: Flight, tmp_path: Path) -> None:
    port, log = free_port(), tmp_path / "flight.tlog"
    with playing(flight, f"udpout:127.0.0.1:{port}", rate_hz=100):
        words = [sys.executable, "-m", "glstar", "live", f"udpin:127.0.0.1:{port}", "--record", str(log), "--headless"]
        with subprocess.Popen(words, stderr=subprocess.DEVNULL) as child:
            until(lambda: log.exists() and log.stat().st_size > 20_000, "a recording")
            child.send_signal(signal.SIGKILL)

    raw, at, framer = log.read_bytes(), 0, Framer()
    while at < len(raw):
        assert abs(int.from_bytes(raw[at : at + 8], "big") * 1e-6 - time.time()) < 600
        length = raw[at + 9] + 12
        (packet,) = framer.feed(raw[at + 8 : at + 8 + length])
        at += 8 + len(packet.content)
    assert at == len(raw)
    result = CliRunner().invoke(app, ["info", str(log), "--json"])
    assert result.exit_code == 0, result.output
    assert farthest_rad(Config().open_flight(log).attitude, flight.attitude) < 0.001 * DEG


def test_a_recording_is_never_overwritten(tmp_path: Path) -> None:
    (tmp_path / "flight.tlog").write_bytes(b"dear")
    with pytest.raises(LinkError, match="is there already"):
        Recorder(tmp_path / "flight.tlog")


def test_another_process_reads_the_latest_frame(flight: Flight) -> None:
    port = free_port()
    name = f"shm:glstar{port}"
    words = [sys.executable, "-c", WITH_CTRL_C, "live", f"udpin:127.0.0.1:{port}", "--latest-frame", name]
    more = ["--every", "0.2", "--exposure", "0.2", "--duration", "90", "--time-offset", "3600"]
    with (
        playing(flight, f"udpout:127.0.0.1:{port}", rate_hz=50),
        subprocess.Popen([*words, *more], stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True) as child,
        LatestFrameReader(name) as latest,
    ):
        frames = [latest.wait(60.0), latest.wait(60.0)]
        child.send_signal(signal.SIGINT)
        _, said = child.communicate(timeout=60)

    assert child.returncode == 0, said
    assert "resource_tracker" not in said
    first, second = frames
    assert first is not None
    assert second is not None
    assert first.truth["frame"] < second.truth["frame"]
    assert first.pixels.shape == (760, 1014)
    later_s = parse_utc(second.truth["camera_utc_mid"]) - parse_utc(second.truth["utc_mid"])
    assert later_s == pytest.approx(3600.0, abs=1e-5)
    expected = flight.attitude.at(parse_utc(second.truth["utc_mid"]))
    assert 2 * np.arccos(min(abs(expected @ second.truth["q_body_ned"]), 1.0)) < 0.1 * DEG
    with LatestFrameReader(name) as gone:
        assert gone.read() is None


def test_a_flight_without_utc_and_position_uses_those_of_the_command_line(flight: Flight, tmp_path: Path) -> None:
    port = free_port()
    with playing(flight, f"udpout:127.0.0.1:{port}", rate_hz=50) as vehicle:
        for number in (2, 24, 33):  # SYSTEM_TIME, GPS_RAW_INT, GLOBAL_POSITION_INT
            vehicle._makers[number] = lambda _: None
        words = f"live udpin:127.0.0.1:{port} --duration 90 --every 1 --exposure 0.2".split()
        more = ["--export", str(tmp_path / "frames"), "--utc-now", "--lat", "-34.8", "--lon", "138.6"]
        with interrupted_when(lambda: has_frames(tmp_path / "frames", 1)):
            result = CliRunner().invoke(app, [*words, *more])

    assert result.exit_code == 0, result.output
    assert "UTC: the computer's clock" in result.output
    line = json.loads((tmp_path / "frames" / "truth.jsonl").read_text().splitlines()[0])
    assert parse_utc(line["utc_mid"]) == pytest.approx(time.time(), abs=60)
    assert line["site"]["latitude_deg"] == pytest.approx(-34.8)


def test_a_link_that_does_not_open_leaves_no_recording(tmp_path: Path) -> None:
    log = tmp_path / "flight.tlog"
    words = ["live", f"tcp:127.0.0.1:{free_port(socket.SOCK_STREAM)}", "--record", str(log)]
    result = CliRunner().invoke(app, words)

    assert result.exit_code == 1
    assert "no program listens on TCP port" in result.output
    assert not log.exists()


def test_without_a_link_the_ports_are_listed_with_an_example() -> None:
    result = CliRunner().invoke(app, ["live"])

    assert result.exit_code == 0
    assert "serial port" in result.output
    assert "udpin:127.0.0.1:14550" in result.output


def test_a_log_given_as_a_link_is_refused(tmp_path: Path) -> None:
    log = tmp_path / "flight.tlog"
    log.write_bytes(b"x")
    result = CliRunner().invoke(app, ["live", str(log), "--export", str(tmp_path / "frames")])

    assert result.exit_code == 1
    assert "is a file, not a link" in result.output


def test_replay_link_plays_to_the_end_and_reports_its_duration(tmp_path: Path) -> None:
    words = f"live replay {asset('adelaide.BIN')} udpout:127.0.0.1:{free_port()} --speed 200 --start 34.5 --rate 20"
    result = CliRunner().invoke(app, words.split())

    assert result.exit_code == 0, result.output
    assert "100.0 s played" in result.output


@pytest.mark.parametrize(
    ("flags", "words"),
    [
        (["--headless"], "without a window there is nothing to do but --record"),
        (["--headless", "--stats", "s.json"], "--stats needs --duration"),
        (["--export", "frames", "--screenshot", "s.png"], "open no window"),
        (["--show", "clouds"], "clouds"),
        (["--size", "large"], "1280x800"),
    ],
)
def test_invalid_flags_of_the_window_are_usage_errors(flags: list[str], words: str) -> None:
    port = free_port()
    result = CliRunner().invoke(app, ["live", f"udpin:127.0.0.1:{port}", *flags], env={"COLUMNS": "200"})

    assert result.exit_code == 2
    assert words in result.stderr


def test_live_without_a_display_draws_what_the_window_would_show(flight: Flight, tmp_path: Path) -> None:
    port, shot, stats, log = free_port(), tmp_path / "shot.png", tmp_path / "stats.json", tmp_path / "flight.tlog"
    words = f"live udpin:127.0.0.1:{port} --headless --duration 4 --size 1000x700 --json".split()
    files = ["--screenshot", str(shot), "--stats", str(stats), "--record", str(log)]
    with playing(flight, f"udpout:127.0.0.1:{port}", rate_hz=50, start_s=20.0):
        result = CliRunner().invoke(app, [*words, *files])
    assert result.exit_code == 0, result.output
    facts, report = json.loads(result.stdout), json.loads(stats.read_text())

    assert cv2.imread(str(shot)).shape == (700, 1000, 3)
    assert report["image"] == [1014, 760]
    assert report["mode"] == "sliding"
    assert report["link"]["images"] == facts["drawn"] >= 3
    assert 0 < report["link"]["latency_ms"]["median"] <= report["link"]["latency_ms"]["p95"]
    assert 0 < report["link"]["recorded_bytes"] <= facts["recorded_bytes"] <= log.stat().st_size
    assert "UTC from SYSTEM_TIME" in result.stderr


def test_a_link_without_packets_draws_and_reports_its_status(tmp_path: Path) -> None:
    shot = tmp_path / "shot.png"
    words = f"live udpin:127.0.0.1:{free_port()} --headless --duration 3 --screenshot {shot}".split()
    result = CliRunner().invoke(app, words)

    assert result.exit_code == 1
    assert "no packets on udpin" in result.output
    assert shot.exists()
