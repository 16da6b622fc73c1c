"""Links with damage, losses, noise and floods: the link stays live, loses no intact packet and reports each problem."""

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
from glstar.flight import Flight
from glstar.link import Endpoint, Framer, Link, Recorder, Transport, open_transport, supervisor
from glstar.link.packets import dialect
from glstar.system.resources import asset
from tests.support.links import Plug, farthest_rad, free_port, playing, until
from tests.support.sender import packets

DEG = np.pi / 180
POSIX = pytest.mark.skipif(os.name != "posix", reason="needs pseudo-terminals")

# A sender of 10,000 packets a second, each attitude ten times within its millisecond.
FLOOD = """
import socket, sys, time
from glstar.link.packets import dialect
mavlink = dialect()
link = mavlink.MAVLink(None, srcSystem=1, srcComponent=1)
server = socket.create_server(("127.0.0.1", int(sys.argv[1])))
ground, _ = server.accept()
sent, began_s = 0, time.monotonic()
while sent < int(sys.argv[2]):
    due, packets = min(int(1e4 * (time.monotonic() - began_s)), int(sys.argv[2])), []
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


def messages_of(link: Link) -> list[str]:
    """Return the messages of a link's events."""
    return [event.message for event in link.events()]


@POSIX
def test_every_intact_packet_is_recorded_despite_flipped_bytes_and_dropped_packets(
    flight: Flight, tmp_path: Path
) -> None:
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
        messages = until(lambda: [m for m in messages_of(link) if m.startswith(("damage", "loss"))], "messages")
        received, state = link.flight(), link.status().state
        over = True  # packets still in an unplugged cable would be lost
        until(lambda: link.status().packets == len(good), "every intact packet")

    assert recorded(log) == good
    assert state == "live"
    assert received is not None
    assert farthest_rad(received.attitude, flight.attitude) < 0.001 * DEG
    assert messages[0].split(":")[0] in {"damage", "loss"}


@POSIX
def test_a_link_reopened_after_garbage_is_live_again_and_loses_no_packet(
    flight: Flight, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    chance = random.Random(3)
    garbage = over = False
    good: list[bytes] = []
    opened: list[Endpoint] = []

    def opening(endpoint: Endpoint) -> Transport:
        opened.append(endpoint)
        return open_transport(endpoint)

    def damage(packet: bytes) -> bytes:
        if over:
            return b""
        if garbage:
            return chance.randbytes(10 * len(packet))
        good.append(bytes(packet))
        return packet

    monkeypatch.setattr(supervisor, "open_transport", opening)
    log = tmp_path / "flight.tlog"
    plug = Plug(tmp_path / "ttyUSB0", damage)
    with (
        Recorder(log) as recorder,
        Link(Endpoint.parse(f"{plug.port},57600"), recorder=recorder) as link,
        playing(flight, plug, rate_hz=50),
    ):
        until(lambda: link.status().rate_hz > 40, "the attitude")
        garbage = True
        until(lambda: "wrong baud rate?" in str(link.status().problem), "the message")
        until(lambda: len(opened) > 1, "the link to be opened again")
        garbage = False
        latest = link.latest()
        assert latest is not None
        until(lambda: link.wait_for(latest.utc_s + 1.0, 0.1), "an attitude after the garbage")
        until(lambda: link.status().rate_hz > 40, "the rate")
        assert link.status().problem is None
        messages = messages_of(link)
        # The first packet after the garbage may be hidden by a false packet start; all others are recorded.
        over = True
        until(lambda: log.read_bytes().endswith(good[-1]), "the last packet")
        packets = recorded(log)

    assert "packets are received again" in messages
    assert any("wrong baud rate?" in message for message in messages)
    lost = [packet for packet in good if packet not in set(packets)]
    assert len(lost) <= 1
    assert set(packets) <= set(good)


def test_a_flood_is_recorded_to_the_last_packet_and_reported(tmp_path: Path) -> None:
    port, log, sent = free_port(socket.SOCK_STREAM), tmp_path / "flight.tlog", 50_000
    command = [sys.executable, "-c", FLOOD, str(port), str(sent)]
    with subprocess.Popen(command) as sender:
        try:
            until(lambda: is_listening(port), "the sender")
            with Recorder(log) as recorder, Link(Endpoint.parse(f"tcp:127.0.0.1:{port}"), recorder=recorder) as link:
                until(lambda: link.status().packets > 10_000, "packets")
                memory_kb = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
                worked_s, packets = time.process_time(), link.status().packets
                # Meanwhile the flight can be read.
                for count in range(15_000, 40_000, 5_000):
                    until(lambda: link.status().packets >= count, f"{count} packets", 60.0)  # noqa: B023
                    found = link.flight(5.5)
                    assert found is not None
                    assert found.attitude.rate_hz == pytest.approx(1000, rel=0.01)
                cost_s = (time.process_time() - worked_s) / (link.status().packets - packets)
                until(lambda: link.status().packets >= sent, "all packets", 60.0)
                until(lambda: "no flood any more" in messages_of(link), "the end of the flood")
                grown_kb = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - memory_kb
                assert link.status().lost == 0
                assert any(message.endswith("a flood") for message in messages_of(link))
        finally:
            sender.kill()

    packets_sent = recorded(log)
    assert len(packets_sent) == sent
    # A packet costs a few times as much processor time as pymavlink's decoder.
    assert cost_s < 6 * decoding_s(packets_sent[:5000])
    assert grown_kb < 40_000


def decoding_s(packets: list[bytes]) -> float:
    """Return pymavlink's processor time to decode a packet on this machine, s."""
    decode, began_s = dialect().MAVLink(None).decode, time.process_time()
    for packet in packets:
        decode(bytearray(packet))
    return (time.process_time() - began_s) / len(packets)


def is_listening(port: int) -> bool:
    """Return whether a TCP port is taken."""
    with socket.socket() as one:
        try:
            one.bind(("127.0.0.1", port))
        except OSError:
            return True
    return False


def test_the_reader_of_these_tests_finds_the_packets_of_the_framer(tmp_path: Path) -> None:
    """`recorded` finds in a log the packets that the framer wrote."""
    with Recorder(tmp_path / "x.tlog") as recorder:
        made = packets(30) + packets(30, sign=True)
        recorder.write(Framer().feed(b"".join(made)))

    assert recorded(tmp_path / "x.tlog") == made
