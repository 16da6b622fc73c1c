"""Numbers of messages, running numbers, unknown dialects and recordings of a link."""

from pathlib import Path
from typing import Any

import pytest

from glstar.errors import LinkError
from glstar.link import packets as packetfile
from glstar.link.packets import Framer, LinkRecording, MessageId, Packer, Packet, Recorder, _matching_extra, dialect
from tests.support.sender import Sender

MAVLINK = dialect()


def test_messages_have_the_numbers_of_mavlink() -> None:
    for message in MessageId:
        assert MAVLINK.mavlink_map[int(message)].msgname == message.name


def test_packets_of_a_sender_are_numbered_from_0_to_255() -> None:
    packer, other = Packer(), Packer(3, 100)
    beat = MAVLINK.MAVLink_heartbeat_message(6, 8, 0, 0, 4, 3)
    (first, *_), numbers = Framer().feed(other(beat)), []
    for _ in range(258):
        (packet,) = Framer().feed(packer(beat))
        assert packet.sender == (255, 191)
        numbers.append(packet.sequence)
    assert numbers == [*range(256), 0, 1]
    assert (first.sender, first.sequence, first.number) == ((3, 100), 0, 0)


def test_the_first_bytes_of_a_payload_are_its_time_in_both_versions() -> None:
    attitude = MAVLINK.MAVLink_attitude_message(0x04030201, 0.1, 0.2, 0.3, 0, 0, 0)
    second, first = MAVLINK.MAVLink(None, 7, 1), MAVLINK.MAVLink(None, 7, 1)
    for link, is_first in ((second, False), (first, True)):
        whole = bytes(attitude.pack(link, force_mavlink1=is_first))
        assert whole[0] == (0xFE if is_first else 0xFD)
        (packet,) = Framer().feed(whole)
        assert (packet.begins, packet.number, packet.sender) == (bytes([1, 2, 3, 4]), 30, (7, 1))
        assert not packet.signed


def test_the_extra_byte_of_a_checksum_is_found_for_every_message() -> None:
    content = b"any content"
    for extra in range(256):
        whole = MAVLINK.x25crc(content + bytes([extra])).crc
        assert _matching_extra(MAVLINK.x25crc(content).crc, whole) == extra
    matched = sum(_matching_extra(MAVLINK.x25crc(content).crc, checksum) is not None for checksum in range(65536))
    assert matched == 256


def unknown(content: bytes, extra: int = 77, *, number: int = 4_000_000) -> bytes:
    """Return a packet of a message of no dialect."""
    head = MAVLINK.MAVLink_header(number, 0, 0, len(content), 0, 1, 1).pack()
    whole = bytes(head) + content
    return whole + int(MAVLINK.x25crc(whole[1:] + bytes([extra])).crc).to_bytes(2, "little")


def fed(framer: Framer, stream: bytes) -> list[bytes]:
    return [packet.content for packet in framer.feed(stream)]


def test_an_unknown_message_is_first_taken_between_two_packets_alone() -> None:
    own, other = unknown(b"abc"), bytes(Packer()(MAVLINK.MAVLink_heartbeat_message(6, 8, 0, 0, 4, 3)))
    assert fed(Framer(), own) == [own]  # the stream begins and ends with it
    assert fed(Framer(), other + own + other) == [other, own, other]
    # After bytes of no packet, or before some, it is none.
    after, before = Framer(), Framer()
    assert fed(after, b"\0" + own + other) == [other]
    assert after.bad_bytes == 1 + len(own)
    assert fed(before, own + b"\0" + other) == [other]
    assert before.bad_bytes == 1 + len(own)
    # Once its CRC_EXTRA is known it is taken everywhere, and another one is damage.
    assert fed(Framer(), own + b"\0" + own + b"\0") == []
    known = Framer()
    assert fed(known, own) == [own]
    assert fed(known, b"\0" + own + b"\0") == [own]
    assert fed(known, unknown(b"abc", 78)) == []


def test_an_unknown_message_after_a_false_start_is_no_packet_at_a_pause() -> None:
    own, framer = unknown(b"abc"), Framer()
    assert fed(framer, b"\xfd\xff\x00" + own) == []
    assert list(framer.flush()) == []
    beat, framer = Sender(7).heartbeat().content, Framer()
    assert fed(framer, b"\xfd\xff\x00" + beat + b"\xfd\x20") == []
    assert [packet.content for packet in framer.flush()] == [beat]
    assert framer.bad_bytes == 3
    # The beginning of a packet is still there.
    assert framer._buffered == b"\xfd\x20"


def test_a_packet_with_unknown_flags_is_no_packet() -> None:
    beat = bytearray(Sender(7).heartbeat().content)
    beat[2] = 2

    assert fed(Framer(), bytes(beat)) == []


# --- recordings -------------------------------------------------------------------------------------------------------


def packet(content: bytes) -> Packet:
    return Packet(0, 1, 1, 0, content)


@pytest.fixture
def now_us(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """Return the time of the computer's clock, us."""
    times = [1_710_068_400_000_001]
    monkeypatch.setattr(packetfile.time, "time_ns", lambda: times[0] * 1000 + 999)
    return times


def record(stamp_us: int, content: bytes) -> bytes:
    return stamp_us.to_bytes(8, "big") + content


def test_packets_are_recorded_after_their_arrival_which_never_decreases(tmp_path: Path, now_us: list[int]) -> None:
    path, first_us = tmp_path / "a.tlog", now_us[0]
    with Recorder(path) as recorder:
        recorder.write([packet(b"one"), packet(b"two")])
        recorder.write([])
        now_us[0] -= 5
        recorder.write([packet(b"three")])
        now_us[0] += 12
        recorder.write([packet(b"four")])
        assert recorder.bytes == 4 * 8 + 3 + 3 + 5 + 4
        with pytest.raises(LinkError, match="is there already; record to another file"):
            Recorder(path)
    recorder.write([packet(b"after the end")])
    recorder.close()

    stamps = ((first_us, b"one"), (first_us, b"two"), (first_us, b"three"), (first_us + 7, b"four"))
    assert path.read_bytes() == b"".join(record(*one) for one in stamps)
    with pytest.raises(LinkError, match=r"cannot be written \(No such file or directory\)"):
        Recorder(tmp_path / "no" / "a.tlog")


def test_an_empty_recording_leaves_no_file(tmp_path: Path) -> None:
    for is_removed in (False, True):
        path = tmp_path / "a.tlog"
        recorder = Recorder(path)
        assert path.exists()
        if is_removed:
            path.unlink()
        recorder.close()
        assert not path.exists()


def test_a_full_disk_ends_a_recording_with_a_complete_packet(
    tmp_path: Path, now_us: list[int], monkeypatch: pytest.MonkeyPatch
) -> None:
    path, said = tmp_path / "a.tlog", list[str]()
    recording = LinkRecording(Recorder(path), said.append)
    recording.write([packet(b"one")])
    original = packetfile.os.write
    monkeypatch.setattr(packetfile.os, "write", lambda handle, content: original(handle, content[:-2]))
    recording.write([packet(b"two")])
    monkeypatch.undo()
    recording.write([packet(b"three")])

    assert said == [f"{path}: recording has stopped: the disk is full"]
    assert path.read_bytes() == record(now_us[0], b"one")
    assert (recording.path, recording.bytes) == (None, 11)
    recording.end()
    assert len(said) == 1


def test_a_recording_begins_and_ends_while_the_link_is_open(tmp_path: Path, now_us: list[int]) -> None:
    said: list[str] = []
    recording = LinkRecording(None, said.append)
    recording.write([packet(b"nowhere")])
    recording.end()
    assert (recording.path, recording.bytes, said) == (None, 0, [])

    one, two = tmp_path / "1.tlog", tmp_path / "2.tlog"
    recording.begin(one)
    assert recording.path == one
    recording.write([packet(b"one")])
    with pytest.raises(LinkError, match="is there already"):
        recording.begin(one)
    recording.write([packet(b"two")])
    recording.begin(two)
    recording.write([packet(b"three")])
    assert (recording.path, recording.bytes) == (two, 13)
    recording.end()
    recording.end()
    recording.write([packet(b"four")])

    assert one.read_bytes() == record(now_us[0], b"one") + record(now_us[0], b"two")
    assert two.read_bytes() == record(now_us[0], b"three")
    assert (recording.path, recording.bytes) == (None, 13)
    assert said == [
        f"recording to {one}",
        f"recorded 22 bytes: {one}",
        f"recording to {two}",
        f"recorded 13 bytes: {two}",
    ]


def test_a_recording_is_flushed_whenever_it_has_grown(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    flushed: list[Any] = []
    monkeypatch.setattr(packetfile, "flush_handle", flushed.append)
    recorder = object.__new__(Recorder)
    recorder.path, recorder.bytes, recorder._handle = tmp_path / "a.tlog", 0, 7
    sizes = iter([0, 1, 1, 9, None])

    class Closing:
        def wait(self, every_s: float) -> bool:
            assert every_s == 0.25
            size = next(sizes)
            recorder.bytes = recorder.bytes if size is None else size
            return size is None

    recorder._closing = Closing()  # type: ignore[assignment]
    recorder._flush_regularly(0.25)

    assert flushed == [7, 7]
