"""Packets in a stream of bytes: valid ones, damaged ones, and unknown messages."""

import random
from collections import Counter

import pytest

from glstar.link import Framer
from glstar.link.packets import dialect
from tests.support.sender import packets


def fed(stream: bytes, framer: Framer, step: int = 13) -> list[bytes]:
    return [packet.content for at in range(0, len(stream), step) for packet in framer.feed(stream[at : at + step])]


@pytest.mark.parametrize("step", [1, 7, 64, 100_000])
@pytest.mark.parametrize("sign", [False, True])
def test_packets_are_extracted_from_chunks_of_any_size(step: int, sign: bool) -> None:
    sent, framer = packets(60, sign=sign), Framer()

    assert fed(b"".join(sent), framer, step) == sent
    assert framer.bad_bytes == 0


def test_a_packet_reports_its_sender_its_message_and_its_place_in_the_sequence() -> None:
    (first, second, _) = Framer().feed(b"".join(packets(3)))

    assert (first.number, first.sender, first.sequence) == (30, (7, 1), 0)
    assert (second.number, second.sequence, second.signed) == (0, 1, False)


def test_all_valid_packets_and_no_damaged_ones_are_extracted() -> None:
    chance = random.Random(1)
    sent = packets(3000)
    damaged = [
        bytes(byte ^ (1 << chance.randrange(8)) if chance.random() < 0.01 else byte for byte in packet)
        for packet in sent
    ]
    good = Counter(packet for packet, came in zip(sent, damaged, strict=True) if packet == came)

    framer = Framer()
    got = Counter(fed(b"".join(damaged), framer))
    got.update(packet.content for packet in framer.flush())

    assert good.total() > 1000
    assert good - got == Counter()
    # A wrong 16-bit checksum passes by chance once in 65536.
    assert (got - good).total() <= 1


def test_a_packet_after_a_false_start_is_extracted_at_a_pause() -> None:
    (first, second, third), framer = packets(3), Framer()

    assert fed(first + b"\xfd\xff\x00" + second + third[:9], framer) == [first]
    assert [packet.content for packet in framer.flush()] == [second]
    assert list(framer.flush()) == []
    assert fed(third[9:], framer) == [third]
    assert framer.bad_bytes == 3


def test_garbage_between_packets_loses_no_packets_and_is_not_accumulated() -> None:
    chance, framer = random.Random(2), Framer()
    sent = packets(200)
    stream = b"".join(chance.randbytes(chance.randrange(200)) + packet for packet in sent)

    got = fed(stream + bytes(300), framer)

    assert [packet for packet in got if packet in set(sent)] == sent
    assert framer.bad_bytes == pytest.approx(len(stream) + 300 - sum(map(len, got)), abs=300)
    for _ in framer.feed(chance.randbytes(100_000)):
        pass
    assert len(framer._buffered) < 300


def test_unknown_messages_are_accepted_if_their_checksums_are_consistent() -> None:
    mavlink = dialect()
    link = mavlink.MAVLink(None, srcSystem=1, srcComponent=1)

    def own(content: bytes) -> bytes:
        # A message number of no dialect, with another CRC_EXTRA.
        head = mavlink.MAVLink_header(4_000_000, 0, 0, len(content), 0, 1, 1).pack()
        whole = bytes(head) + content
        total = mavlink.x25crc(whole[1:] + bytes([77])).crc
        return whole + total.to_bytes(2, "little")

    assert link is not None
    sent = [own(bytes([n, 2, 3])) for n in range(5)]
    damaged = sent[0][:-1] + bytes([sent[0][-1] ^ 0x40])

    assert fed(b"".join(sent), Framer()) == sent
    framer = Framer()
    assert fed(sent[1] + damaged + sent[2], framer) == [sent[1], sent[2]]
