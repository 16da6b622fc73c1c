"""Links as they are: damage, losses, noise, floods.  Live goes on, nothing good is lost, and what happened is said."""

import os
import random
import resource
import socket
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from glstar.config import Config
from glstar.link import Endpoint, Framer, Link, Recorder
from glstar.resources import asset
from glstar.track import Flight
from tests.links import Plug, farthest_rad, free_port, playing, until

DEG = np.pi / 180
POSIX = pytest.mark.skipif(os.name != "posix", reason="needs pseudo-terminals")

# A vehicle gone mad: 10,000 packets a second, each millisecond's attitude ten times.
FLOOD = """
import socket, sys, time
from glstar.link.messages import dialect
mavlink = dialect()
link = mavlink.MAVLink(None, srcSystem=1, srcComponent=1)
server = socket.create_server(("127.0.0.1", int(sys.argv[1])))
ground, _ = server.accept()
sent, began_s = 0, time.monotonic()
while time.monotonic() - began_s < float(sys.argv[2]):
    due, packets = int(1e4 * (time.monotonic() - began_s)), []
    while sent < due:
        boot_ms = sent // 10
        if sent % 10_000 == 0:
            message = mavlink.MAVLink_heartbeat_message(1, 3, 0, 0, 4, 3)
        elif sent % 5_000 == 1:
            message = mavlink.MAVLink_system_time_message(1_710_068_400_000_000 + 1000 * boot_ms, boot_ms)
        elif sent % 2_000 == 2:
            message = mavlink.MAVLink_global_position_int_message(boot_ms, -349300000, 1386000000, 0, 0, 0, 0, 0, 0)
        else:
            message = mavlink.MAVLink_attitude_quaternion_message(boot_ms, 0.6, 0.8, 0, 0, 0, 0, 0)
        packets.append(message.pack(link))
        link.seq = (link.seq + 1) % 256
        sent += 1
    ground.sendall(b"".join(packets))
    time.sleep(0.002)
print(sent, flush=True)
ground.recv(1 << 20)
time.sleep(60)
"""


@pytest.fixture(scope="module")
def flight() -> Flight:
    return Config().open_flight(asset("adelaide.BIN"))


def recorded(log: Path) -> list[bytes]:
    """Return the packets of a telemetry log."""
    raw, at, packets = log.read_bytes(), 0, []
    while at < len(raw):
        length = raw[at + 9] + (12 + 13 * (raw[at + 10] & 1) if raw[at + 8] == 0xFD else 8)
        packets.append(raw[at + 8 : at + 8 + length])
        at += 8 + length
    assert at == len(raw)
    return packets


def words_of(link: Link) -> list[str]:
    return [event.words for event in link.events()]


@POSIX
def test_of_flipped_bytes_and_dropped_packets_every_good_packet_is_recorded(flight: Flight, tmp_path: Path) -> None:
    chance = random.Random(7)
    good: list[bytes] = []
    over = False

    def damage(packet: bytes) -> bytes:
        if over or chance.random() < 0.05:
            return b""
        came = bytes(byte ^ (1 << chance.randrange(8)) if chance.random() < 0.01 else byte for byte in packet)
        if came == packet:
            good.append(bytes(packet))
        return came

    log = tmp_path / "flight.tlog"
    plug = Plug(tmp_path / "ttyUSB0", damage)
    with (
        Recorder(log) as recorder,
        Link(Endpoint.parse(f"{plug.port},57600"), recorder=recorder) as link,
        playing(flight, plug, rate_hz=50),
    ):
        until(lambda: link.status().packets > 150, "packets")
        words = until(lambda: [words for words in words_of(link) if words.startswith(("damage", "loss"))], "words")
        told, state = link.flight(), link.status().state
        over = True  # what is still in a cable that is pulled out is lost
        until(lambda: link.status().packets == len(good), "every good packet")

    assert recorded(log) == good
    assert state == "live"
    assert told is not None
    assert farthest_rad(told.attitude, flight.attitude) < 0.001 * DEG
    assert words[0].split(":")[0] in {"damage", "loss"}


@POSIX
def test_after_ten_seconds_of_garbage_the_link_is_live_again_at_once(flight: Flight, tmp_path: Path) -> None:
    chance = random.Random(3)
    garbage = False
    good: list[bytes] = []

    def damage(packet: bytes) -> bytes:
        if garbage:
            return chance.randbytes(10 * len(packet))
        good.append(bytes(packet))
        return packet

    log = tmp_path / "flight.tlog"
    plug = Plug(tmp_path / "ttyUSB0", damage)
    with (
        Recorder(log) as recorder,
        Link(Endpoint.parse(f"{plug.port},57600"), recorder=recorder) as link,
        playing(flight, plug, rate_hz=50),
    ):
        until(lambda: link.status().rate_hz > 40, "the attitude")
        garbage = True
        until(lambda: "wrong baud rate?" in str(link.status().trouble), "the sentence")
        time.sleep(8.0)
        garbage = False
        newest = link.newest()
        assert newest is not None
        until(lambda: link.wait_for(newest.utc_s + 1.0, 0.1), "an attitude after the garbage", 3.0)
        until(lambda: link.status().rate_hz > 40, "the rate", 5.0)
        assert link.status().trouble is None
        said = words_of(link)
        # The first packet after the garbage may lie behind a beginning of none; all others are there.
        time.sleep(0.3)
        packets, sent = recorded(log), list(good)

    assert "packets come again" in said
    assert any("wrong baud rate?" in words for words in said)
    lost = [packet for packet in sent[:-20] if packet not in set(packets)]
    assert len(lost) <= 1
    assert set(packets) <= set(good)


def test_a_flood_is_borne_recorded_to_the_last_packet_and_told(tmp_path: Path) -> None:
    port, log, seconds = free_port(socket.SOCK_STREAM), tmp_path / "flight.tlog", 5.0
    words = [sys.executable, "-c", FLOOD, str(port), str(seconds)]
    with subprocess.Popen(words, stdout=subprocess.PIPE, text=True) as sender:
        try:
            until(lambda: is_listening(port), "the sender")
            with Recorder(log) as recorder, Link(Endpoint.parse(f"tcp:127.0.0.1:{port}"), recorder=recorder) as link:
                until(lambda: link.status().packets > 10_000, "packets")
                memory_kb = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
                worked_s, packets = time.process_time(), link.status().packets
                # Meanwhile the flight can be looked at.
                while sender.poll() is None and link.status().packets < 35_000:
                    found = link.flight(5.5)
                    time.sleep(0.1)
                cost_s = (time.process_time() - worked_s) / (link.status().packets - packets)
                assert found is not None
                assert found.attitude.rate_hz == pytest.approx(1000, rel=0.01)
                assert sender.stdout is not None
                sent = int(sender.stdout.readline())
                until(lambda: link.status().packets >= sent, "all packets")
                until(lambda: "no flood any more" in words_of(link), "the end of the flood", 5.0)
                grown_kb = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - memory_kb
                assert link.status().lost == 0
                assert any(words.endswith("a flood") for words in words_of(link))
        finally:
            sender.kill()

    assert sent > 20_000
    assert len(recorded(log)) == sent
    assert cost_s < 100e-6
    assert grown_kb < 40_000


def is_listening(port: int) -> bool:
    """Return whether a TCP port is taken."""
    with socket.socket() as one:
        try:
            one.bind(("127.0.0.1", port))
        except OSError:
            return True
    return False


def test_framing_what_a_log_holds_finds_the_same_packets(tmp_path: Path) -> None:
    """What reads the logs of these tests is checked against glstar's own reader."""
    with Recorder(tmp_path / "x.tlog") as recorder:
        from tests.unit.test_link_framing import packets  # noqa: PLC0415

        made = packets(30) + packets(30, sign=True)
        recorder.write(Framer().feed(b"".join(made)))

    assert recorded(tmp_path / "x.tlog") == made
