"""Files of ROS bags and MCAP recordings: their messages as columns, topic by topic, to the last whole record.

A file is recognised by its first bytes, whatever its name.  ROS 1 bags are read from start to end, without their index,
and MCAP without its summary: a recorder that was killed wrote neither.  rosbags decodes the messages; what it cannot
decode is counted, and schemas of other topics are never parsed.
"""

import bz2
import io
import sqlite3
import struct
import tempfile
from array import array
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import closing
from dataclasses import dataclass, field
from functools import cached_property, lru_cache
from os import PathLike
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple
from urllib.parse import quote

import numpy as np

from glstar.arrays import Float, Mask
from glstar.errors import LogFormatError
from glstar.telemetry import source

_MCAP, _SQLITE, _ROS1, _ZSTD = b"\x89MCAP0\r\n", b"SQLite format 3\x00", b"#ROSBAG V2.0\n", b"\x28\xb5\x2f\xfd"
MAGICS = (_MCAP, _SQLITE, b"#ROSBAG")
# Files in the directory of a ROS 2 bag, also compressed.
_STORAGES = (".mcap", ".db3", ".mcap.zstd", ".db3.zstd")
# Opcodes of the records of a ROS 1 bag: https://wiki.ros.org/Bags/Format/2.0.
_MESSAGE, _CHUNK, _CONNECTION = 2, 5, 7

IMU = "sensor_msgs/msg/Imu"
FIX = "sensor_msgs/msg/NavSatFix"
GEO = "geographic_msgs/msg/GeoPoseStamped"
TIME = "sensor_msgs/msg/TimeReference"
CAMERA = "sensor_msgs/msg/CameraInfo"
# An orientation with this variance about an axis is not known, rad^2: drivers write 1e6 and 99999.
_UNKNOWN_RAD2 = 10.0


def _pose_orientation(message: Any) -> Any:
    return message.pose.orientation


def _nested_orientation(message: Any) -> Any:
    return message.pose.pose.orientation


# Messages with attitude, in the order of choice, and how each gives its orientation.
ATTITUDES: Mapping[str, Callable[[Any], Any]] = {
    GEO: _pose_orientation,
    IMU: lambda message: message.orientation,
    "geometry_msgs/msg/PoseStamped": _pose_orientation,
    "geometry_msgs/msg/PoseWithCovarianceStamped": _nested_orientation,
    "geometry_msgs/msg/QuaternionStamped": lambda message: message.quaternion,
    "nav_msgs/msg/Odometry": _nested_orientation,
}
_KINDS = frozenset({*ATTITUDES, FIX, TIME, CAMERA})


# An orientation that turns less does not move: the rounding of float64, rad.
_STILL_RAD = 1e-6
# One that turns more moves, rad.
_TURNS_RAD = np.deg2rad(0.5)
# A sensor that stands still for this long, and for this part of the log, while the vehicle turns, is frozen.
_FROZEN_S, _FROZEN_PART = 1.0, 0.1
# Readings of UTC that scatter more about their median are of no use, s.
_UTC_SCATTER_S = 0.5
# Cosine between the mean direction of the accelerometers and the axis of the world that is up.
_UPRIGHT = 0.8

# What glstar takes from a message, as columns of a table.
_COLUMNS = {
    "received_s": slice(0, 1),
    "stamp_s": slice(1, 2),
    "orientation": slice(2, 6),  # (w, x, y, z)
    "rate_rad_per_s": slice(6, 9),
    "acceleration": slice(9, 12),  # m/s^2
    "position": slice(12, 15),  # latitude and longitude, deg; height, m
    "utc_s": slice(15, 16),
}
_WIDTH = 16


@dataclass
class Topic:
    """The messages of one kind on a topic, as columns in the order of reception; NaN where a message does not say."""

    name: str
    kind: str
    frame_id: str = ""
    child_frame_id: str = ""
    origin: str = ""  # Where a TimeReference says that its time comes from
    unmeasured: int = 0  # Number of messages whose covariance says that they have no orientation
    unknown: int = 0  # Number of messages whose covariance says that their orientation may be any
    undecoded: int = 0  # Number of messages that rosbags cannot decode
    _cells: "array[float]" = field(default_factory=lambda: array("d"))

    def add(self, message: Any, received_s: float) -> None:
        """Append a message that was recorded at `received_s`, UTC seconds of the recorder."""
        header = message.header
        stamp_s = header.stamp.sec + header.stamp.nanosec * 1e-9
        row = [np.nan] * _WIDTH
        row[:2] = received_s, stamp_s or received_s
        if self.kind in ATTITUDES:
            q = ATTITUDES[self.kind](message)
            row[2:6] = q.w, q.x, q.y, q.z
            self.child_frame_id = self.child_frame_id or getattr(message, "child_frame_id", "")
        if self.kind == IMU:
            self._add_gyros(row, message)
        elif self.kind == FIX and message.status.status >= 0:
            row[12:15] = message.latitude, message.longitude, message.altitude
        elif self.kind == GEO:
            at = message.pose.position
            row[12:15] = at.latitude, at.longitude, at.altitude
        elif self.kind == TIME:
            self.origin = self.origin or message.source
            row[15] = message.time_ref.sec + message.time_ref.nanosec * 1e-9
        self.frame_id = self.frame_id or header.frame_id
        self._cells.extend(row)

    def _add_gyros(self, row: list[float], message: Any) -> None:
        """Complete the row of an Imu, which says by covariances what it does not measure."""
        variance = message.orientation_covariance[::4]
        self.unknown += max(variance) > _UNKNOWN_RAD2
        if variance[0] == -1:
            self.unmeasured += 1
            row[2:6] = [np.nan] * 4
        rate, acceleration = message.angular_velocity, message.linear_acceleration
        if message.angular_velocity_covariance[0] != -1:
            row[6:9] = rate.x, rate.y, rate.z
        if message.linear_acceleration_covariance[0] != -1:
            row[9:12] = acceleration.x, acceleration.y, acceleration.z

    def __len__(self) -> int:
        return len(self._cells) // _WIDTH

    def sort(self) -> None:
        """Sort by reception: chunks of a file, and files of a bag, may overlap."""
        order = np.argsort(self.column("received_s"), kind="stable")
        self._cells = array("d", self._table[order].tobytes())

    def column(self, name: str) -> Float:
        """Return a column of `_COLUMNS`, (n,) or (n, k)."""
        column = self._table[:, _COLUMNS[name]]
        return column[:, 0] if column.shape[1] == 1 else column

    @property
    def _table(self) -> Float:
        return np.frombuffer(self._cells, dtype=np.float64).reshape(-1, _WIDTH)

    @cached_property
    def is_oriented(self) -> Mask:
        """(n,) bool: which messages have an orientation."""
        return source.unit_quaternions(self.column("orientation"))

    @cached_property
    def is_up_down(self) -> bool:
        """Whether the third axis of the world is down by the accelerometers of an Imu; at rest they read upwards."""
        acceleration = self.column("acceleration")
        used = self.is_oriented & np.isfinite(acceleration).all(axis=-1)
        if not used.any():
            return False
        (w, x, y, z), a = self.column("orientation")[used].T, acceleration[used]
        third = np.stack([2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)], axis=-1)
        length = float(np.linalg.norm(a, axis=-1).mean())
        return length > 0 and float((third * a).sum(axis=-1).mean()) < -_UPRIGHT * length

    def frozen_beside(self, others: Iterable["Topic"]) -> str:
        """Return why the orientation is none: it stands still while its gyros or other attitudes turn; empty if not."""
        clock_s, q = self.column("stamp_s")[self.is_oriented], self.column("orientation")[self.is_oriented]
        moves = np.flatnonzero(np.concatenate([[True], _angles_rad(q[1:], q[:-1]) > _STILL_RAD, [True]]))
        longest = int(np.argmax(np.diff(moves)))
        first, stop = int(moves[longest]), int(moves[longest + 1])
        start_s, end_s = float(clock_s[first]), float(clock_s[stop - 1])
        is_whole = stop - first == q.shape[0]
        if not is_whole and end_s - start_s < max(_FROZEN_S, _FROZEN_PART * float(np.ptp(clock_s))):
            return ""
        rate = self.column("rate_rad_per_s")[self.is_oriented][first:stop]
        rate = rate[np.isfinite(rate).all(axis=-1)]
        # Already the noise of gyros moves an orientation that is estimated from them.
        mean = float(np.linalg.norm(rate.mean(axis=0))) if rate.size else 0.0
        if (is_whole and rate.any()) or mean > 2 * _TURNS_RAD:
            return "its orientation is constant while its gyros turn"
        for other in others:
            times_s, turned = other.column("stamp_s"), other.column("orientation")
            turned = turned[other.is_oriented & (times_s >= start_s) & (times_s <= end_s)]
            if turned.size and _angles_rad(turned, turned[:1]).max() > _TURNS_RAD:
                return f"its orientation is constant while that of {other.name} turns"
        return ""

    def positions(self) -> source.PositionSamples:
        """Return the valid positions of a NavSatFix or a GeoPose."""
        latitude_deg, longitude_deg, height_m = self.column("position").T
        return source.position_samples(self.column("stamp_s"), latitude_deg, longitude_deg, height_m, self.name)

    def utc_readings(self) -> tuple[Float, Float]:
        """Return stamps and UTC of a TimeReference, (n,) s each; empty if it does not count UTC."""
        clock_s, utc_s = self.column("stamp_s"), self.column("utc_s")
        valid = source.plausible_utc(utc_s) & source.valid_rare_times(clock_s)
        clock_s, utc_s = clock_s[valid], utc_s[valid]
        if not utc_s.size:
            return clock_s, utc_s
        off_s = utc_s - clock_s
        near = np.abs(off_s - np.median(off_s)) < _UTC_SCATTER_S
        advances = utc_s.size == 1 or np.ptp(utc_s) > 0 or np.ptp(clock_s) == 0
        good = near if advances and np.count_nonzero(near) > utc_s.size / 2 else np.zeros_like(near)
        return clock_s[good], utc_s[good]

    @property
    def short_kind(self) -> str:
        """The message without its package, for messages to the user."""
        return self.kind.rpartition("/")[2]


def _angles_rad(q1: Float, q2: Float) -> Float:
    """Return the angles between unit quaternions, (n, 4), rad."""
    apart = np.minimum(np.linalg.norm(q1 - q2, axis=-1), np.linalg.norm(q1 + q2, axis=-1))
    return np.asarray(4 * np.arcsin(np.minimum(apart / 2, 1.0)))


@dataclass(slots=True)
class Bag:
    """What glstar reads from a bag."""

    name: str
    format: str = "ROS bag"
    topics: dict[str, Topic] = field(default_factory=dict)
    kinds: set[str] = field(default_factory=set)  # All kinds of messages
    notes: list[str] = field(default_factory=list)
    unread_bytes: int = 0


class _Channel(NamedTuple):
    """A topic in a file, and how its messages are serialised."""

    topic: str
    kind: str
    definition: str = ""  # Empty if the file has none
    is_idl: bool = False
    is_ros1: bool = False

    def decode(self, raw: bytes) -> Any:
        """Return a message."""
        return _decoder(self.kind, self.definition, is_idl=self.is_idl, is_ros1=self.is_ros1)(raw)


class _WholeReads:
    """A stream that raises EOFError rather than return fewer bytes than requested."""

    def __init__(self, stream: BinaryIO) -> None:
        self._stream = stream
        self.size = stream.seek(0, io.SEEK_END)
        stream.seek(0)

    def read(self, count: int) -> bytes:
        if count > self.size - self._stream.tell():
            raise EOFError("it ends within a record")
        return self._stream.read(count)

    def tell(self) -> int:
        return self._stream.tell()

    def rest(self) -> BinaryIO:
        """Return the underlying stream."""
        return self._stream

    def rewind(self) -> None:
        self._stream.seek(0)

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
    for file in files:
        _read_file(bag, file)
    if not files:
        raise LogFormatError(name, "is the directory of a ROS 2 bag without its .mcap or .db3 files")
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


def _read_file(bag: Bag, path: Path) -> None:
    """Add the messages of a file; raises LogFormatError if there are none before the first damage."""
    count = 0
    with path.open("rb") as file:
        stream = _WholeReads(file)
        try:
            for channel, received_ns, raw in _messages(bag, stream, path):
                count += 1
                if channel.kind not in _KINDS:
                    continue
                topic = _topic(bag, channel)
                try:
                    topic.add(channel.decode(raw), received_ns * 1e-9)
                except Exception:
                    topic.undecoded += 1
        except Exception as error:
            reason = " ".join(str(error).split()) or type(error).__name__
            if not count:
                raise LogFormatError(bag.name, f"cannot be read as a ROS bag: {reason}") from error
            bag.unread_bytes += stream.size - stream.tell()
            where = f"at byte {stream.tell()} of {stream.size} of {path.name}" if stream.tell() else f"in {path.name}"
            bag.notes.append(f"the recording breaks off {where}, and its last messages are lost: {reason}")


def _topic(bag: Bag, channel: _Channel) -> Topic:
    """Return the topic of a channel; the second kind of message on a topic is a topic of its own."""
    name = channel.topic
    if name in bag.topics and bag.topics[name].kind != channel.kind:
        short = channel.kind.rpartition("/")[2]
        if (name := f"{name} ({short})") not in bag.topics:
            bag.notes.append(f"{channel.topic} has messages of two kinds: those of {short} are listed as {name!r}")
    return bag.topics.setdefault(name, Topic(name, channel.kind))


def _messages(bag: Bag, stream: _WholeReads, path: Path) -> _Messages:
    """Yield all messages of a file that is recognised by its first bytes."""
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
        return _compressed(bag, stream)
    raise ValueError("it begins like no bag that glstar knows, such as a bag of ROS 1 before version 2.0")


def _mcap(bag: Bag, stream: Any) -> _Messages:
    from mcap.records import Channel, Header, Message, Schema  # noqa: PLC0415 - see `read_bag`
    from mcap.stream_reader import StreamReader  # noqa: PLC0415 - the same

    schemas: dict[int, Schema] = {}
    channels: dict[int, _Channel] = {}
    for record in StreamReader(stream, record_size_limit=None).records:
        if isinstance(record, Header):
            bag.format = "ROS 1 bag (MCAP)" if record.profile == "ros1" else "ROS 2 bag (MCAP)"
        elif isinstance(record, Schema):
            schemas[record.id] = record
        elif isinstance(record, Channel):
            channels[record.id] = channel = _mcap_channel(record, schemas.get(record.schema_id))
            bag.kinds.add(channel.kind)
        elif isinstance(record, Message) and record.channel_id in channels:
            yield channels[record.channel_id], record.log_time, _unpacked(record.data)


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
        definitions: dict[str, tuple[str, bool]] = {}
        if database.execute("SELECT 1 FROM sqlite_master WHERE name = 'message_definitions'").fetchone():
            rows = database.execute("SELECT topic_type, encoded_message_definition, encoding FROM message_definitions")
            definitions = {kind: (text, encoding == "ros2idl") for kind, text, encoding in rows}
        channels = {
            number: _Channel(name, kind if serialised == "cdr" else "", *definitions.get(kind, ("", False)))
            for number, name, kind, serialised in database.execute(
                "SELECT id, name, type, serialization_format FROM topics"
            )
        }
        bag.kinds.update(channel.kind for channel in channels.values())
        for number, received_ns, raw in database.execute("SELECT topic_id, timestamp, data FROM messages"):
            if number in channels:
                yield channels[number], received_ns, _unpacked(raw)


def _compressed(bag: Bag, stream: Any) -> _Messages:
    """Yield the messages of a file in a ROS 2 bag that is compressed as a whole."""
    import zstandard  # noqa: PLC0415 - a dependency of mcap

    with tempfile.TemporaryDirectory(prefix="glstar-", ignore_cleanup_errors=True) as folder:
        path = Path(folder) / "storage"
        with path.open("wb") as whole:
            zstandard.ZstdDecompressor().copy_stream(stream.rest(), whole)
        with path.open("rb") as file:
            yield from _messages(bag, _WholeReads(file), path)


def _unpacked(raw: bytes) -> bytes:
    """Return a message that rosbag2 may have compressed on its own; CDR begins with 0."""
    if not raw.startswith(_ZSTD):
        return raw
    import zstandard  # noqa: PLC0415 - a dependency of mcap

    return bytes(zstandard.decompress(raw))


def _ros1(bag: Bag, stream: _WholeReads, channels: dict[bytes, _Channel] | None = None) -> _Messages:
    """Yield the messages of a ROS 1 bag, or of one of its chunks: `channels` are those by their number so far."""
    if channels is None:
        channels = {}
        stream.read(len(_ROS1))
    while stream.tell() < stream.size:
        header, data = _fields(stream.sized()), stream.sized()
        operation = header[b"op"][0]
        if operation == _CONNECTION:
            about = _fields(data)
            kind, definition = about[b"type"].decode(), about[b"message_definition"].decode("utf-8", "replace")
            channels[header[b"conn"]] = _Channel(header[b"topic"].decode(), _full_kind(kind), definition, is_ros1=True)
            bag.kinds.add(_full_kind(kind))
        elif operation == _MESSAGE and header[b"conn"] in channels:
            seconds, nanoseconds = struct.unpack("<II", header[b"time"])
            yield channels[header[b"conn"]], seconds * 10**9 + nanoseconds, data
        elif operation == _CHUNK and data:
            content = _DECOMPRESS[header[b"compression"]](data)
            yield from _ros1(bag, _WholeReads(io.BytesIO(content)), channels)


def _lz4(data: bytes) -> bytes:
    import lz4.frame  # noqa: PLC0415 - a dependency of rosbags

    return bytes(lz4.frame.decompress(data))


_DECOMPRESS: Mapping[bytes, Callable[[bytes], bytes]] = {b"none": bytes, b"bz2": bz2.decompress, b"lz4": _lz4}


def _fields(header: bytes) -> dict[bytes, bytes]:
    """Return the fields of the header of a ROS 1 record, by name."""
    stream = _WholeReads(io.BytesIO(header))
    fields: dict[bytes, bytes] = {}
    while stream.tell() < stream.size:
        name, _, value = stream.sized().partition(b"=")
        fields[name] = value
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
