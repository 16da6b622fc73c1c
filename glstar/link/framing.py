"""MAVLink packets in a stream of bytes, byte for byte as they came.

pymavlink has the tables and decodes what is inside a packet; its own parser drops, behind a false beginning, as many
bytes as that claims, and the good packets in them.  Here every byte is tried that may begin a packet.
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
        Of its message.
    system, component : int
        Who sent it.
    sequence : int
        Counts the packets of its sender, 0 to 255.
    content : bytes
        The whole packet.
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
        """The first four bytes of what it tells: in most messages the time since boot."""
        head = _HEAD_V2 if self.content[0] == _V2 else _HEAD_V1
        return self.content[head : head + 4]

    @property
    def signed(self) -> bool:
        """Whether it carries a signature."""
        return self.content[0] == _V2 and bool(self.content[2] & _SIGNED)


class Framer:
    """Takes bytes as they come and gives whole packets whose sums are right.

    What it holds back is bounded by the longest packet.

    Attributes
    ----------
    bad_bytes : int
        How many bytes belonged to no packet.
    """

    def __init__(self) -> None:
        from pymavlink.generator.mavcrc import x25crc  # noqa: PLC0415 - when a link is opened

        self._extra = {number: int(message.crc_extra) for number, message in dialect().mavlink_map.items()}
        self._sum: Any = x25crc
        self._held = b""
        # Whether what is held begins where a packet ended.
        self._in_step = True
        self.bad_bytes = 0

    def feed(self, received: bytes) -> Iterator[Packet]:
        """Yield the packets that are whole now.

        Parameters
        ----------
        received : bytes
            What came after what came before.
        """
        stream, at = self._held + received, 0
        while at < len(stream):
            start = _next_magic(stream, at)
            self._in_step = self._in_step and start == at
            self.bad_bytes += start - at
            at = start
            stop = _stop(stream, at)
            if stop is None or stop > len(stream):
                break
            packet = self._packet(stream[at:stop], followed=stop == len(stream) or stream[stop] in {_V1, _V2})
            self._in_step = packet is not None
            if packet is None:
                self.bad_bytes += 1
                at += 1
            else:
                at = stop
                yield packet
        self._held = stream[at:]

    def settle(self) -> Iterator[Packet]:
        """Yield the packets behind a beginning that was false; to be called where nothing comes for a while.

        A packet that is only half there stays, until another is found behind it.
        """
        at = 1
        while (at := _next_magic(self._held, at)) < len(self._held):
            stop = _stop(self._held, at)
            found = self._packet(self._held[at:stop], followed=False) if stop and stop <= len(self._held) else None
            if found is None:
                at += 1
                continue
            self.bad_bytes += at
            self._held = self._held[stop:]
            at = 0
            yield found

    def _packet(self, content: bytes, *, followed: bool) -> Packet | None:
        """Return the packet of these bytes; None where they are none."""
        if content[0] == _V2:
            if content[2] & ~_SIGNED:
                return None
            number = int.from_bytes(content[7:10], "little")
            sequence, system, component = content[4:7]
            end = len(content) - (_SIGNATURE if content[2] & _SIGNED else 0) - _SUM
        else:
            sequence, system, component, number = content[2:6]
            end = len(content) - _SUM
        told = int.from_bytes(content[end : end + _SUM], "little")
        fits = _fitting_extra(self._sum(content[1:end]).crc, told)
        if fits is None:
            return None
        if number not in self._extra:
            # A message of somebody's own: the first of its kind tells its extra byte.  So does one false packet in 256;
            # it must stand between packets too, or it could hide good ones.
            if not (self._in_step and followed):
                return None
            self._extra[number] = fits
        elif self._extra[number] != fits:
            return None
        return Packet(number, system, component, sequence, content)


def _next_magic(stream: bytes, start: int) -> int:
    """Return where the next packet may begin; the end where none does."""
    found = [at for at in (stream.find(_V2, start), stream.find(_V1, start)) if at >= 0]
    return min(found, default=len(stream))


def _stop(stream: bytes, at: int) -> int | None:
    """Return where a packet that begins here would end; None where too little is there to tell."""
    if len(stream) < at + 3:
        return None
    if stream[at] == _V1:
        return at + _HEAD_V1 + stream[at + 1] + _SUM
    return at + _HEAD_V2 + stream[at + 1] + _SUM + (_SIGNATURE if stream[at + 2] & _SIGNED else 0)


def _fitting_extra(summed: int, told: int) -> int | None:
    """Return the byte that turns one sum into another when it is added; None where there is none.

    Every message adds such a byte of its own to its packets' sums, which says what fields it has.
    """
    mixed = _MIXED.get(told ^ summed >> 8)
    return None if mixed is None else mixed ^ summed & 0xFF


def _mixture(byte: int) -> int:
    """Return what CRC-16/MCRF4XX makes of a byte mixed with its low half."""
    byte ^= byte << 4 & 0xFF
    return byte << 8 ^ byte << 3 ^ byte >> 4


_MIXED: Final = {_mixture(byte): byte for byte in range(256)}
