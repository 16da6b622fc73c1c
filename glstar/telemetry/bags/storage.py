"""Files of ROS bags and MCAP recordings: their messages as columns, topic by topic, to the last whole record.

A file is recognised by its first bytes, whatever its name.  ROS 1 bags are read from start to end, without their index,
and MCAP without its summary: a recorder that was killed wrote neither.  rosbags decodes the messages; what it cannot
decode is counted, and schemas of other topics are never parsed.
"""

import bz2
import io
import sqlite3
import struct
from collections.abc import Callable, Iterator
from contextlib import closing
from dataclasses import dataclass, field
from functools import lru_cache
from os import PathLike
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple
from urllib.parse import quote

from glstar.errors import LogFormatError
from glstar.system.files import UnpackedFolder
from glstar.system.userinput import Unpacking, limit_of
from glstar.telemetry.bags.topics import KINDS, Topic

_MCAP, _SQLITE, _ROS1, _ZSTD = b"\x89MCAP0\r\n", b"SQLite format 3\x00", b"#ROSBAG V2.0\n", b"\x28\xb5\x2f\xfd"
MAGICS = (_MCAP, _SQLITE, b"#ROSBAG")
# Files in the directory of a ROS 2 bag, also compressed.
_STORAGES = (".mcap", ".db3", ".mcap.zstd", ".db3.zstd")
# Opcodes of the records of a ROS 1 bag: https://wiki.ros.org/Bags/Format/2.0.
_MESSAGE, _CHUNK, _CONNECTION = 2, 5, 7
# Records of MCAP, https://mcap.dev/spec: opcode and length of each; channel, number, times of a message.
_RECORD, _MESSAGE_HEAD = struct.Struct("<BQ"), struct.Struct("<HIQQ")
_CUT = "it ends within a record"


@dataclass(slots=True)
class Bag:
    """What glstar reads from a bag."""

    name: str
    format: str = "ROS bag"
    topics: dict[str, Topic] = field(default_factory=dict)
    kinds: set[str] = field(default_factory=set)  # All kinds of messages
    notes: list[str] = field(default_factory=list)
    unread_bytes: int = 0

    def topic(self, channel: "_Channel") -> Topic:
        """Return the topic of a channel; the second kind of message on a topic is a topic of its own."""
        name = channel.topic
        if name in self.topics and self.topics[name].kind != channel.kind:
            short = channel.kind.rpartition("/")[2]
            if (name := f"{name} ({short})") not in self.topics:
                self.notes.append(f"{channel.topic} has messages of two kinds: those of {short} are listed as {name!r}")
        if name not in self.topics:
            self.topics[name] = Topic(name, channel.kind)
        return self.topics[name]


class _Channel(NamedTuple):
    """A topic in a file, and how its messages are serialised."""

    topic: str
    kind: str
    definition: str = ""  # Empty if the file has none
    is_idl: bool = False
    is_ros1: bool = False

    def decode(self, raw: bytes) -> Any:
        """Return a message, which rosbag2 may have compressed on its own; CDR begins with 0."""
        if raw.startswith(_ZSTD):
            raw = _inflated("zstd", raw)
        return _decoder(self.kind, self.definition, is_idl=self.is_idl, is_ros1=self.is_ros1)(raw)


class _WholeReads:
    """A stream that raises EOFError rather than return fewer bytes than requested."""

    def __init__(self, stream: BinaryIO) -> None:
        self._stream = stream
        self.size = stream.seek(0, io.SEEK_END)
        self.position = stream.seek(0)

    def read(self, count: int) -> bytes:
        if count > self.size - self.position:
            raise EOFError(_CUT)
        self.position += count
        return self._stream.read(count)

    def rest_from(self, start: int) -> bytes:
        """Return all bytes from a position, without a change of its own."""
        self._stream.seek(start)
        rest = self._stream.read()
        self._stream.seek(self.position)
        return rest

    def rewind(self) -> None:
        self.position = self._stream.seek(0)

    def sized(self) -> bytes:
        """Read bytes with their number before them, as ROS 1 writes them."""
        return self.read(struct.unpack("<I", self.read(4))[0])


_Messages = Iterator[tuple[_Channel, int, bytes]]


def read_bag(name: str) -> Bag:
    """Read the messages with attitude, gyros, position, time or triggers of a bag: a file, or a directory of files.

    What lies beyond damage is left out, and noted.  Raises LogFormatError if no message can be read, or a library is
    missing.
    """
    try:
        import mcap.stream_reader  # noqa: F401, PLC0415 - an extra, when a bag is read
        import rosbags.typesys  # noqa: F401, PLC0415 - the same
    except ImportError:
        needed = "is a ROS bag, which needs the libraries rosbags and mcap: pip install rosbags mcap"
        raise LogFormatError(name, needed) from None
    path, bag = Path(name), Bag(name)
    files = [path]
    if path.is_dir():
        files = sorted(file for file in path.iterdir() if file.name.endswith(_STORAGES) and file.is_file())
    if not files:
        raise LogFormatError(name, "is the directory of a ROS 2 bag without its .mcap or .db3 files")
    damage = [error for file in files if (error := _read_file(bag, file)) is not None]
    if damage and not bag.topics:
        raise LogFormatError(name, f"cannot be read as a ROS bag: {_reason(damage[0])}") from damage[0]
    for topic in bag.topics.values():
        topic.sort()
        if topic.undecoded:
            bag.notes.append(f"{topic.undecoded} messages of {topic.name} cannot be decoded and are left out")
    return bag


def is_bag_directory(path: str | PathLike[str]) -> bool:
    """Return whether a directory is a ROS 2 bag: a recorder that was killed leaves NAME/NAME_0.mcap only."""
    folder = Path(path)
    if not folder.is_dir():
        return False
    recorded = (file.name for file in folder.glob("*_[0-9]*") if file.name.startswith(folder.name))
    return (folder / "metadata.yaml").is_file() or any(name.endswith(_STORAGES) for name in recorded)


def _read_file(bag: Bag, path: Path) -> Exception | None:
    """Add the messages of a file; return the damage at which it breaks off, None if it is whole."""
    with path.open("rb") as file:
        stream = _WholeReads(file)
        try:
            for channel, received_ns, raw in _messages(bag, stream, path):
                topic = bag.topic(channel)
                try:
                    topic.add(channel.decode(raw), received_ns * 1e-9)
                except Exception:
                    topic.undecoded += 1
                    topic.undefined = not channel.definition and not len(topic)
        except Exception as error:
            where = f"in {path.name}"
            if stream.position:  # of a database it is not known
                bag.unread_bytes += stream.size - stream.position
                where = f"at byte {stream.position} of {stream.size} of {path.name}"
            bag.notes.append(f"the recording breaks off {where}, and its last messages are lost: {_reason(error)}")
            return error
    return None


def _reason(error: Exception) -> str:
    return " ".join(str(error).split()) or type(error).__name__


def _messages(bag: Bag, stream: _WholeReads, path: Path) -> _Messages:
    """Yield the messages of `KINDS` of a file that is recognised by its first bytes."""
    head = stream.read(min(stream.size, 16))
    stream.rewind()
    if head.startswith(_ROS1):
        bag.format = "ROS 1 bag"
        return _ros1(bag, stream)
    bag.format = "ROS 2 bag"
    if head.startswith(_MCAP):
        return _mcap(bag, stream)
    if head.startswith(_SQLITE):
        return _sqlite(bag, path)
    if head.startswith(_ZSTD):
        return _compressed(bag, path)
    raise ValueError("it begins like no bag that glstar knows, such as a bag of ROS 1 before version 2.0")


def _mcap(bag: Bag, stream: _WholeReads) -> _Messages:
    from mcap.records import Chunk, Message  # noqa: PLC0415 - see `read_bag`
    from mcap.stream_reader import StreamReader  # noqa: PLC0415 - the same

    schemas: dict[int, Any] = {}
    channels: dict[int, _Channel] = {}
    start = 0
    try:
        for record in StreamReader(stream, emit_chunks=True, record_size_limit=None).records:  # type: ignore[arg-type]
            start = stream.position
            if isinstance(record, Chunk):
                yield from _mcap_chunk(bag, record, schemas, channels)
            elif not isinstance(record, Message):
                _learn(bag, record, schemas, channels)
            elif record.channel_id in channels:
                yield channels[record.channel_id], record.log_time, record.data
    except EOFError:
        if chunk := _cut_chunk(stream, start):
            yield from _mcap_chunk(bag, chunk, schemas, channels)
        raise


def _mcap_chunk(bag: Bag, chunk: Any, schemas: dict[int, Any], channels: dict[int, _Channel]) -> _Messages:
    """Yield the messages of a chunk, without an object for each record, of which there are many."""
    from mcap.data_stream import ReadDataStream  # noqa: PLC0415 - see `read_bag`
    from mcap.opcode import Opcode  # noqa: PLC0415 - the same
    from mcap.records import Channel, Schema  # noqa: PLC0415 - the same

    about: dict[int, Any] = {Opcode.SCHEMA: Schema, Opcode.CHANNEL: Channel}
    content, start = _inflated(chunk.compression, chunk.data), 0
    while start + _RECORD.size <= len(content):
        opcode, length = _RECORD.unpack_from(content, start)
        body, stop = start + _RECORD.size, start + _RECORD.size + length
        if stop > len(content):
            break
        if opcode == Opcode.MESSAGE:
            number, _, received_ns, _ = _MESSAGE_HEAD.unpack_from(content, body)
            if number in channels:
                yield channels[number], received_ns, content[body + _MESSAGE_HEAD.size : stop]
        elif opcode in about:
            record = about[opcode].read(ReadDataStream(io.BytesIO(content[body:stop])))
            _learn(bag, record, schemas, channels)
        start = stop
    if start < len(content) == chunk.uncompressed_size:
        bag.notes.append("a chunk of the recording is damaged, and its last messages are lost")


def _learn(bag: Bag, record: Any, schemas: dict[int, Any], channels: dict[int, _Channel]) -> None:
    """Remember what a record says about messages; `channels` are those with messages of `KINDS`."""
    from mcap.records import Channel, Header, Schema  # noqa: PLC0415 - see `read_bag`

    if isinstance(record, Header):
        bag.format = "ROS 1 bag (MCAP)" if record.profile == "ros1" else "ROS 2 bag (MCAP)"
    elif isinstance(record, Schema):
        schemas[record.id] = record
    elif isinstance(record, Channel):
        channel = _mcap_channel(record, schemas.get(record.schema_id))
        bag.kinds.add(channel.kind)
        if channel.kind in KINDS:
            channels[record.id] = channel


def _cut_chunk(stream: _WholeReads, start: int) -> Any:
    """Return what there is of the chunk at a position, whose end is missing; None if there is another record."""
    from mcap.data_stream import ReadDataStream  # noqa: PLC0415 - see `read_bag`
    from mcap.opcode import Opcode  # noqa: PLC0415 - the same
    from mcap.records import Chunk  # noqa: PLC0415 - the same

    rest = io.BytesIO(stream.rest_from(start))
    if rest.read(_RECORD.size)[:1] != bytes([Opcode.CHUNK]):
        return None
    try:
        return Chunk.read(ReadDataStream(rest))
    except Exception:  # it ends before its messages
        return None


def _mcap_channel(record: Any, schema: Any) -> _Channel:
    """Return a channel of MCAP; its kind is empty if its messages are none of ROS."""
    encodings = {"cdr": False, "ros1": True}
    if schema is None or record.message_encoding not in encodings:
        return _Channel(record.topic, "")
    definition = schema.data.decode("utf-8", "replace")
    is_idl = schema.encoding in {"ros2idl", "omgidl"}
    return _Channel(
        record.topic, _full_kind(schema.name), definition, is_idl, is_ros1=encodings[record.message_encoding]
    )


def _sqlite(bag: Bag, path: Path) -> _Messages:
    """Yield the messages of a database, with those that a killed recorder left in its write-ahead log."""
    address = f"file:{quote(str(path.absolute()))}"
    try:
        database = sqlite3.connect(f"{address}?mode=ro", uri=True)
        database.execute("SELECT count(*) FROM topics").fetchone()
    except sqlite3.OperationalError:  # in a folder that cannot be written the log cannot be read
        database = sqlite3.connect(f"{address}?immutable=1", uri=True)
    with closing(database):
        # A view may have rows without end.
        if database.execute("SELECT 1 FROM sqlite_master WHERE type NOT IN ('table', 'index')").fetchone():
            raise ValueError("its database has views or triggers, which no recorder writes")
        definitions: dict[str, tuple[str, bool]] = {}
        if database.execute("SELECT 1 FROM sqlite_master WHERE name = 'message_definitions'").fetchone():
            rows = database.execute("SELECT topic_type, encoded_message_definition, encoding FROM message_definitions")
            definitions = {kind: (text, encoding == "ros2idl") for kind, text, encoding in rows}
        channels: dict[int, _Channel] = {}
        for number, name, kind, serialised in database.execute(
            "SELECT id, name, type, serialization_format FROM topics"
        ):
            bag.kinds.add(kind if serialised == "cdr" else "")
            if serialised == "cdr" and kind in KINDS:
                channels[number] = _Channel(name, kind, *definitions.get(kind, ("", False)))
        # Images and point clouds lie in pages of their own, which are not read.
        marks = ", ".join("?" * len(channels))
        query = f"SELECT topic_id, timestamp, data FROM messages WHERE topic_id IN ({marks})"  # noqa: S608 - marks only
        for number, received_ns, raw in database.execute(query, [*channels]):
            yield channels[number], received_ns, raw


def _compressed(bag: Bag, packed: Path) -> _Messages:
    """Yield the messages of a file in a ROS 2 bag that is compressed as a whole."""
    import zstandard  # noqa: PLC0415 - a dependency of mcap

    unpacking = Unpacking(packed.stat().st_size, "unpacked_gib")
    with UnpackedFolder() as folder:
        path = folder / "storage"
        with packed.open("rb") as content, path.open("wb") as whole:
            unpacking.copy(zstandard.ZstdDecompressor().stream_reader(content, read_across_frames=True), whole)
        with path.open("rb") as file:
            yield from _messages(bag, _WholeReads(file), path)


def _ros1(bag: Bag, stream: _WholeReads, channels: dict[bytes, _Channel] | None = None) -> _Messages:
    """Yield the messages of a ROS 1 bag, or of one of its chunks: `channels` are the known ones, by number."""
    if channels is None:
        channels = {}
        stream.read(len(_ROS1))
    while stream.position < stream.size:
        header = _fields(stream.sized())
        (length,) = struct.unpack("<I", stream.read(4))
        operation, missing = header[b"op"][0], length - (stream.size - stream.position)
        data = stream.read(length - max(missing, 0))
        if operation == _CHUNK:
            # A recorder that was killed leaves the length of its last chunk at 0, and the records behind it.
            content = _inflated(header[b"compression"].decode(), data) if data else b""
            yield from _ros1(bag, _WholeReads(io.BytesIO(content)), channels)
        if missing > 0:
            raise EOFError(_CUT)
        if operation == _CONNECTION:
            about = _fields(data)
            kind, definition = _full_kind(about[b"type"].decode()), about[b"message_definition"]
            bag.kinds.add(kind)
            if kind in KINDS:
                channel = _Channel(header[b"topic"].decode(), kind, definition.decode("utf-8", "replace"), is_ros1=True)
                channels[header[b"conn"]] = channel
        elif operation == _MESSAGE and header[b"conn"] in channels:
            seconds, nanoseconds = struct.unpack("<II", header[b"time"])
            yield channels[header[b"conn"]], seconds * 10**9 + nanoseconds, data


def _inflated(compression: str, data: bytes) -> bytes:
    """Return the content of a chunk; if its end is missing, what there is."""
    import lz4.frame  # noqa: PLC0415 - a dependency of rosbags
    import zstandard  # noqa: PLC0415 - a dependency of mcap

    if compression in {"", "none"}:
        return data
    largest = int(limit_of("content_mib"))
    unpacking = Unpacking(len(data), "content_mib")
    if compression == "zstd":
        return unpacking.read(zstandard.ZstdDecompressor().stream_reader(data))
    decompressors: dict[str, Callable[[], Any]] = {"lz4": lz4.frame.LZ4FrameDecompressor, "bz2": bz2.BZ2Decompressor}
    if compression not in decompressors:
        raise ValueError(f"its compression {compression!r} is not known")
    content = bytes(decompressors[compression]().decompress(data, largest + 1))
    unpacking.add(len(content))
    return content


def _fields(header: bytes) -> dict[bytes, bytes]:
    """Return the fields of the header of a ROS 1 record, by name."""
    fields: dict[bytes, bytes] = {}
    start = 0
    while start < len(header):
        stop = start + 4 + struct.unpack_from("<I", header, start)[0]
        if stop > len(header):
            raise EOFError(_CUT)
        name, _, value = header[start + 4 : stop].partition(b"=")
        fields[name] = value
        start = stop
    return fields


def _full_kind(kind: str) -> str:
    """Return a kind of message as ROS 2 names it."""
    package, _, name = kind.partition("/")
    return kind if "/" in name else f"{package}/msg/{name}"


@lru_cache(maxsize=64)
def _decoder(kind: str, definition: str, *, is_idl: bool, is_ros1: bool) -> Callable[[bytes], Any]:
    """Return the function that decodes messages of a kind, by the definition in the bag, else by the usual one."""
    from rosbags.typesys import Stores, get_types_from_idl, get_types_from_msg, get_typestore  # noqa: PLC0415

    usual = Stores.ROS1_NOETIC if is_ros1 else Stores.ROS2_HUMBLE
    store = get_typestore(Stores.EMPTY)
    try:
        if is_idl:
            parts = [part.partition("\n")[2] for part in definition.split(f"{'=' * 80}\nIDL: ") if part]
            for part in parts if definition.startswith("=") else [definition]:
                store.register(get_types_from_idl(part))
        else:
            store.register(get_types_from_msg(definition, kind))
    except Exception:  # of a damaged definition the library raises any exception
        store = get_typestore(usual)
    if kind not in store.fielddefs:
        store = get_typestore(usual)
    decode = store.deserialize_ros1 if is_ros1 else store.deserialize_cdr
    return lambda raw: decode(raw, kind)
