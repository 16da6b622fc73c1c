"""MAVLink packets in a stream of bytes.

pymavlink decodes the contents of packets.  Its stream parser is not used: after a false start of a packet it drops as
many bytes as the false packet claims, with the valid packets in them.  Here every possible start of a packet is tried.
"""

from collections.abc import Iterator
from typing import Any, Final, NamedTuple

from glstar.link.messages import dialect

__all__ = ["Framer", "Packet"]

_V1, _V2 = 0xFE, 0xFD
_HEAD_V1, _HEAD_V2, _SUM, _SIGNATURE = 6, 10, 2, 13
_SIGNED: Final = 1


class Packet(NamedTuple):
    """One packet.

    Attributes
    ----------
    number : int
        Message number.
    system, component : int
        The sender.
    sequence : int
        Running number of the packets of its sender, 0 to 255.
    content : bytes
        The complete packet.
    """

    number: int
    system: int
    component: int
    sequence: int
    content: bytes

    @property
    def sender(self) -> tuple[int, int]:
        """System and component."""
        return self.system, self.component

    @property
    def begins(self) -> bytes:
        """The first four bytes of the payload: in most messages the time since boot."""
        head = _HEAD_V2 if self.content[0] == _V2 else _HEAD_V1
        return self.content[head : head + 4]

    @property
    def signed(self) -> bool:
        """Whether it has a signature."""
        return self.content[0] == _V2 and bool(self.content[2] & _SIGNED)


class Framer:
    """Extracts complete packets with correct checksums from received bytes.

    At most one incomplete packet is buffered.

    Attributes
    ----------
    bad_bytes : int
        Number of bytes that belong to no packet.
    """

    def __init__(self) -> None:
        from pymavlink.generator.mavcrc import x25crc  # noqa: PLC0415 - when a link is opened

        self._extra = {number: int(message.crc_extra) for number, message in dialect().mavlink_map.items()}
        self._sum: Any = x25crc
        self._buffered = b""
        # Whether the buffered bytes begin at the end of a packet.
        self._follows_packet = True
        self.bad_bytes = 0

    def feed(self, received: bytes) -> Iterator[Packet]:
        """Yield the packets that are complete with further bytes.

        Parameters
        ----------
        received : bytes
            The next bytes of the stream.
        """
        stream, at = self._buffered + received, 0
        while at < len(stream):
            start = _next_magic(stream, at)
            self._follows_packet = self._follows_packet and start == at
            self.bad_bytes += start - at
            at = start
            stop = _stop(stream, at)
            if stop is None or stop > len(stream):
                break
            packet = self._packet(stream[at:stop], followed=stop == len(stream) or stream[stop] in {_V1, _V2})
            self._follows_packet = packet is not None
            if packet is None:
                self.bad_bytes += 1
                at += 1
            else:
                at = stop
                yield packet
        self._buffered = stream[at:]

    def flush(self) -> Iterator[Packet]:
        """Yield the packets after a false start of a packet; to be called if no bytes arrive for a while.

        An incomplete packet remains buffered until another one is found after it.
        """
        at = 1
        while (at := _next_magic(self._buffered, at)) < len(self._buffered):
            stop = _stop(self._buffered, at)
            found = (
                self._packet(self._buffered[at:stop], followed=False) if stop and stop <= len(self._buffered) else None
            )
            if found is None:
                at += 1
                continue
            self.bad_bytes += at
            self._buffered = self._buffered[stop:]
            at = 0
            yield found

    def _packet(self, content: bytes, *, followed: bool) -> Packet | None:
        """Return the packet in some bytes; None if they are no packet."""
        if content[0] == _V2:
            if content[2] & ~_SIGNED:
                return None
            number = int.from_bytes(content[7:10], "little")
            sequence, system, component = content[4:7]
            end = len(content) - (_SIGNATURE if content[2] & _SIGNED else 0) - _SUM
        else:
            sequence, system, component, number = content[2:6]
            end = len(content) - _SUM
        checksum = int.from_bytes(content[end : end + _SUM], "little")
        extra = _matching_extra(self._sum(content[1:end]).crc, checksum)
        if extra is None:
            return None
        if number not in self._extra:
            # A message of an unknown dialect: its first packet determines its CRC_EXTRA.  One false packet in 256 would
            # pass, so that it must also be between two packets.
            if not (self._follows_packet and followed):
                return None
            self._extra[number] = extra
        elif self._extra[number] != extra:
            return None
        return Packet(number, system, component, sequence, content)


def _next_magic(stream: bytes, start: int) -> int:
    """Return the offset at which the next packet may begin; the end if there is none."""
    found = [at for at in (stream.find(_V2, start), stream.find(_V1, start)) if at >= 0]
    return min(found, default=len(stream))


def _stop(stream: bytes, at: int) -> int | None:
    """Return the end of a packet that begins at an offset; None if there are too few bytes."""
    if len(stream) < at + 3:
        return None
    if stream[at] == _V1:
        return at + _HEAD_V1 + stream[at + 1] + _SUM
    return at + _HEAD_V2 + stream[at + 1] + _SUM + (_SIGNATURE if stream[at + 2] & _SIGNED else 0)


def _matching_extra(crc: int, checksum: int) -> int | None:
    """Return the CRC_EXTRA byte that, appended to a packet with a given CRC, gives its checksum; None if none does.

    CRC_EXTRA depends on the fields of the message.
    """
    mixed = _MIXED.get(checksum ^ crc >> 8)
    return None if mixed is None else mixed ^ crc & 0xFF


def _mixture(byte: int) -> int:
    """Return the change of CRC-16/MCRF4XX by a byte that is already combined with the low byte of the CRC."""
    byte ^= byte << 4 & 0xFF
    return byte << 8 ^ byte << 3 ^ byte >> 4


_MIXED: Final = {_mixture(byte): byte for byte in range(256)}
