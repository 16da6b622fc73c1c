"""Files of bags byte by byte: headers and chunks of ROS 1, records of MCAP, databases, and channels."""

import bz2
import io
import sqlite3
import struct
from pathlib import Path
from types import SimpleNamespace

import lz4.frame
import numpy as np
import pytest
import zstandard
from mcap.writer import CompressionType, Writer

from glstar.errors import LogFormatError
from glstar.telemetry.bags import is_bag, storage
from glstar.telemetry.bags.storage import Bag, _Channel, _WholeReads, is_bag_directory, read_bag
from glstar.telemetry.bags.topics import CAMERA, FIX, IMU, TIME

INFO = "sensor_msgs/CameraInfo"
# A message of a kind that is read; its definition is in the bag.
STAMPED = "Header header\ntime time_ref\nstring source\n"
MESSAGE_TEXT = STAMPED + "=" * 80 + "\nMSG: std_msgs/Header\nuint32 seq\ntime stamp\nstring frame_id\n"


# --- parts ----------------------------------------------------------------------------------------------------------
def test_a_stream_gives_whole_reads() -> None:
    stream = _WholeReads(io.BytesIO(b"abc\x02\0\0\0deXYZ"))
    assert (stream.size, stream.position) == (12, 0)
    assert (stream.read(3), stream.position) == (b"abc", 3)
    assert (stream.sized(), stream.position) == (b"de", 9)
    assert (stream.rest_from(1), stream.position) == (b"bc\x02\0\0\0deXYZ", 9)
    assert stream.read(2) == b"XY"
    with pytest.raises(EOFError, match="it ends within a record"):
        stream.read(2)
    assert stream.position == 11
    assert stream.read(1) == b"Z"
    stream.rewind()
    assert (stream.position, stream.read(1)) == (0, b"a")


def field(name: bytes, value: bytes) -> bytes:
    return struct.pack("<I", len(name) + 1 + len(value)) + name + b"=" + value


def test_fields_of_a_header_of_ros_1() -> None:
    header = field(b"op", b"\x02") + field(b"a", b"b=c") + field(b"op", b"\x05")
    assert storage._fields(header) == {b"op": b"\x05", b"a": b"b=c"}
    assert storage._fields(b"") == {}
    for cut in (1, len(header) - 1):
        with pytest.raises((EOFError, struct.error)):
            storage._fields(header[:cut])


def test_kinds_have_the_names_of_ros_2() -> None:
    assert storage._full_kind("sensor_msgs/Imu") == storage._full_kind(IMU) == IMU
    assert storage._full_kind("a/srv/b") == "a/srv/b"


def test_kinds_that_are_defined_in_idl_are_decoded_by_their_definitions() -> None:
    """Also if the definition of a kind brings those of its parts, each below a line and its name."""
    line = "=" * 80
    two = "module demo { module msg { struct Two { uint32 a; double b; demo::msg::Inner c; }; }; };\n"
    inner = "module demo { module msg { struct Inner { int16 d; }; }; };\n"
    together = f"{line}\nIDL: demo/msg/Two\n{two}{line}\nIDL: demo/msg/Inner\n{inner}"
    little_endian = b"\0\1\0\0"

    alone = storage._decoder("demo/msg/Inner", inner, is_idl=True, is_ros1=False)
    both = storage._decoder("demo/msg/Two", together, is_idl=True, is_ros1=False)

    assert alone(little_endian + struct.pack("<h", -3)).d == -3
    found = both(little_endian + struct.pack("<I4xdh", 7, 2.5, -4))
    assert (found.a, found.b, found.c.d) == (7, 2.5, -4)


def test_a_second_kind_on_a_topic_is_a_topic_of_its_own() -> None:
    bag = Bag("x.bag")
    first = bag.topic(_Channel("/a", IMU))
    second = bag.topic(_Channel("/a", FIX))
    assert bag.topic(_Channel("/a", IMU)) is first
    assert bag.topic(_Channel("/a", FIX)) is second
    assert (first.name, second.name, second.kind) == ("/a", "/a (NavSatFix)", FIX)
    assert list(bag.topics) == ["/a", "/a (NavSatFix)"]
    assert bag.notes == ["/a has messages of two kinds: those of NavSatFix are listed as '/a (NavSatFix)'"]


def test_content_is_inflated_by_its_name() -> None:
    data = b"content " * 50
    zstd = zstandard.ZstdCompressor().compress(data)
    for name, packed in (
        ("", data),
        ("none", data),
        ("zstd", zstd),
        ("lz4", lz4.frame.compress(data)),
        ("bz2", bz2.compress(data)),
    ):
        assert storage._inflated(name, packed) == data
    assert data.startswith(storage._inflated("bz2", bz2.compress(data)[:-4]))
    with pytest.raises(ValueError, match="its compression 'x' is not known"):
        storage._inflated("x", data)


@pytest.mark.parametrize(
    ("name", "most"),
    [("lz4", lz4.frame.compress), ("bz2", bz2.compress), ("zstd", zstandard.ZstdCompressor().compress)],
)
def test_content_above_the_limit_is_refused(monkeypatch: pytest.MonkeyPatch, name: str, most: object) -> None:
    monkeypatch.setenv("GLSTAR_MAX_CONTENT_MIB", "0.0001")
    with pytest.raises(ValueError, match="GLSTAR_MAX_CONTENT_MIB"):
        storage._inflated(name, most(b"x" * 10_000))


def test_channels_of_mcap() -> None:
    def channel(
        encoding: str, schema: object = SimpleNamespace(name="sensor_msgs/Imu", encoding="ros2idl", data=b"d")
    ) -> _Channel:
        return storage._mcap_channel(SimpleNamespace(topic="/a", message_encoding=encoding), schema)

    assert channel("cdr") == _Channel("/a", IMU, "d", True, False)
    assert channel("ros1", SimpleNamespace(name=IMU, encoding="ros2msg", data=b"d")) == _Channel(
        "/a", IMU, "d", False, True
    )
    assert channel("json") == channel("cdr", None) == _Channel("/a", "")


def test_a_bag_is_known_by_its_first_bytes_or_its_directory(tmp_path: Path) -> None:
    for head in (b"\x89MCAP0\r\nx", b"SQLite format 3\x00", b"#ROSBAG V1.2\n"):
        assert is_bag(head)
    assert not is_bag(b"\x89MCAP1\r\n")
    folder = tmp_path / "run"
    assert not is_bag_directory(folder)
    folder.mkdir()
    assert not is_bag_directory(folder)
    for name, is_one in (
        ("other_0.mcap", False),
        ("run_x.mcap", False),
        ("run_0.txt", False),
        ("run_0.db3.zstd", True),
    ):
        (folder / name).touch()
        assert is_bag_directory(folder) is is_one
        (folder / name).unlink()
    (folder / "metadata.yaml").touch()
    assert is_bag_directory(folder)
    with pytest.raises(LogFormatError, match=r"is the directory of a ROS 2 bag without its \.mcap or \.db3 files"):
        read_bag(str(folder))


# --- a bag of ROS 1 -------------------------------------------------------------------------------------------------
def record(data: bytes, **header: bytes) -> bytes:
    fields = b"".join(field(name.encode(), value) for name, value in header.items())
    return struct.pack("<I", len(fields)) + fields + struct.pack("<I", len(data)) + data


def connection(number: int, topic: str, kind: str, text: str = MESSAGE_TEXT) -> bytes:
    about = field(b"type", kind.encode()) + field(b"message_definition", text.encode())
    return record(about, op=b"\x07", conn=struct.pack("<I", number), topic=topic.encode())


def message(number: int, received_s: float, stamp_s: int, utc_s: int) -> bytes:
    time = struct.pack("<II", int(received_s), round(received_s % 1 * 1e9))
    data = struct.pack("<III", 5, stamp_s, 250_000_000) + struct.pack("<I", 3) + b"gps" + struct.pack("<II", utc_s, 0)
    data += struct.pack("<I", 2) + b"of"
    return record(data, op=b"\x02", conn=struct.pack("<I", number), time=time)


def chunk(content: bytes, compression: bytes = b"none") -> bytes:
    packed = {b"none": content, b"bz2": bz2.compress(content), b"lz4": lz4.frame.compress(content)}[compression]
    return record(packed, op=b"\x05", compression=compression, size=struct.pack("<I", len(content)))


HEAD = b"#ROSBAG V2.0\n" + record(b" " * 20, op=b"\x03")
REFERENCE = "sensor_msgs/TimeReference"


def read(path: Path, *parts: bytes) -> Bag:
    path.write_bytes(HEAD + b"".join(parts))
    return read_bag(str(path))


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "a.bag"


@pytest.mark.parametrize("compression", [b"none", b"bz2", b"lz4"])
def test_messages_of_chunks_and_without(path: Path, compression: bytes) -> None:
    inside = (
        connection(4, "/t", REFERENCE) + message(4, 9.5, 1000, 1700000001) + connection(5, "/x", "std_msgs/String", "")
    )
    bag = read(path, chunk(inside, compression), message(4, 8.25, 1001, 1700000002), message(5, 1.0, 1, 1))
    assert bag.format == "ROS 1 bag"
    assert bag.kinds == {TIME, "std_msgs/msg/String"}
    [topic] = bag.topics.values()
    assert (topic.name, topic.kind, topic.frame_id, topic.origin) == ("/t", TIME, "gps", "of")
    np.testing.assert_allclose(topic.column("received_s"), [8.25, 9.5], rtol=0, atol=1e-9)
    np.testing.assert_allclose(topic.column("stamp_s"), [1001.25, 1000.25], rtol=0, atol=1e-6)
    np.testing.assert_allclose(topic.column("utc_s"), [1700000002.0, 1700000001.0], rtol=0, atol=1e-6)
    assert (bag.notes, bag.unread_bytes, topic.undecoded, topic.undefined) == ([], 0, 0, False)


@pytest.mark.parametrize("cut", [1, 20, 60])
def test_a_bag_that_was_cut_is_read_to_its_last_message(path: Path, cut: int) -> None:
    whole = [connection(4, "/t", REFERENCE), message(4, 9.5, 1000, 1700000001), message(4, 9.75, 1001, 1700000002)]
    path.write_bytes(HEAD + b"".join(whole)[:-cut])
    bag = read_bag(str(path))
    size = path.stat().st_size
    [topic] = bag.topics.values()
    assert topic.column("received_s").tolist() == [9.5]
    [note] = bag.notes
    begin = len(HEAD) + len(whole[0]) + len(whole[1])
    assert bag.unread_bytes <= size - begin
    where = f"at byte {size - bag.unread_bytes} of {size} of a.bag"
    lost = "and its last messages are lost: it ends within a record"
    assert note == f"the recording breaks off {where}, {lost}"


def test_a_chunk_whose_end_is_missing_has_its_first_messages(path: Path) -> None:
    inside = connection(4, "/t", REFERENCE) + message(4, 9.5, 1000, 1700000001) + message(4, 9.75, 1001, 1700000002)
    path.write_bytes(HEAD + chunk(inside)[:-10])
    bag = read_bag(str(path))
    assert bag.topics["/t"].column("received_s").tolist() == [9.5]
    empty = record(b"", op=b"\x05", compression=b"none", size=b"\0\0\0\0")
    assert len(read(path, empty, inside).topics["/t"]) == 2


def test_messages_that_cannot_be_decoded_are_counted(path: Path) -> None:
    damaged = record(b"abc", op=b"\x02", conn=struct.pack("<I", 4), time=struct.pack("<II", 9, 0))
    bag = read(path, connection(4, "/t", REFERENCE), damaged, message(4, 9.5, 1000, 1700000001), damaged)
    assert (len(bag.topics["/t"]), bag.topics["/t"].undecoded, bag.topics["/t"].undefined) == (1, 2, False)
    assert bag.notes == ["2 messages of /t cannot be decoded and are left out"]
    path.write_bytes(b"#ROSBAG V1.2\n")
    with pytest.raises(LogFormatError, match="cannot be read as a ROS bag: it begins like no bag that glstar knows"):
        read_bag(str(path))


# --- databases ------------------------------------------------------------------------------------------------------
def test_a_database_has_topics_and_definitions(tmp_path: Path) -> None:
    path = tmp_path / "a.db3"
    with sqlite3.connect(path) as database:
        database.execute("CREATE TABLE topics (id INTEGER, name TEXT, type TEXT, serialization_format TEXT)")
        database.execute("CREATE TABLE messages (topic_id INTEGER, timestamp INTEGER, data BLOB)")
        database.execute(
            "CREATE TABLE message_definitions (topic_type TEXT, encoding TEXT, encoded_message_definition TEXT)"
        )
        topics = [(1, "/cam", CAMERA, "cdr"), (2, "/x", "std_msgs/msg/String", "cdr"), (3, "/j", IMU, "json")]
        database.executemany("INSERT INTO topics VALUES (?, ?, ?, ?)", topics)
        rows = [(1, 7_500_000_000, b"one"), (2, 1, b"no"), (3, 2, b"no"), (1, 8_500_000_000, b"two")]
        database.executemany("INSERT INTO messages VALUES (?, ?, ?)", rows)
        database.execute("INSERT INTO message_definitions VALUES (?, 'ros2idl', 'text')", (CAMERA,))
    database.close()
    bag = Bag("a.db3")
    channel = _Channel("/cam", CAMERA, "text", True)
    assert list(storage._sqlite(bag, path)) == [(channel, 7_500_000_000, b"one"), (channel, 8_500_000_000, b"two")]
    assert bag.kinds == {CAMERA, "std_msgs/msg/String", ""}
    with sqlite3.connect(path) as database:
        database.execute("DROP TABLE message_definitions")
    database.close()
    assert next(storage._sqlite(Bag("a.db3"), path))[0] == _Channel("/cam", CAMERA)
    with sqlite3.connect(path) as database:
        database.execute("CREATE VIEW v AS SELECT 1")
    database.close()
    with pytest.raises(ValueError, match="its database has views or triggers, which no recorder writes"):
        list(storage._sqlite(Bag("a.db3"), path))


# --- MCAP -----------------------------------------------------------------------------------------------------------
OF_IMU = _Channel("/i", IMU)


def mcap_record(opcode: int, body: bytes) -> bytes:
    return struct.pack("<BQ", opcode, len(body)) + body


def mcap_message(channel: int, received_ns: int, data: bytes) -> bytes:
    """Return a message, https://mcap.dev/spec: channel, sequence, log time, publish time, data."""
    return mcap_record(5, struct.pack("<HIQQ", channel, 77, received_ns, 99) + data)


@pytest.mark.parametrize(
    ("rest", "lacking", "is_noted"),
    [
        (b"", 0, False),
        (b"\x05\xff", 0, True),
        (mcap_message(3, 8, b"cut")[:-1], 0, True),
        (b"\x05\xff", 1, False),  # of a chunk whose end is missing
    ],
)
def test_messages_of_a_chunk(rest: bytes, lacking: int, is_noted: bool) -> None:
    others = mcap_message(4, 6, b"no") + mcap_record(0x0C, b"xyz")
    content = mcap_message(3, 5, b"one") + others + mcap_message(3, 7, b"") + rest
    bag = Bag("a.mcap")
    of = SimpleNamespace(compression="", data=content, uncompressed_size=len(content) + lacking)
    assert list(storage._mcap_chunk(bag, of, {}, {3: OF_IMU})) == [(OF_IMU, 5, b"one"), (OF_IMU, 7, b"")]
    damaged = "a chunk of the recording is damaged, and its last messages are lost"
    assert bag.notes == ([damaged] if is_noted else [])


@pytest.mark.parametrize("compression", [CompressionType.NONE, CompressionType.ZSTD, CompressionType.LZ4])
@pytest.mark.parametrize("use_chunking", [True, False])
@pytest.mark.parametrize("profile", ["ros1", "ros2"])
def test_a_recording_of_mcap(tmp_path: Path, compression: CompressionType, use_chunking: bool, profile: str) -> None:
    path = tmp_path / "a.mcap"
    with path.open("wb") as file:
        writer = Writer(file, compression=compression, use_chunking=use_chunking)
        writer.start(profile, "x")
        schema = writer.register_schema("sensor_msgs/TimeReference", "ros1msg", MESSAGE_TEXT.encode())
        other = writer.register_schema("std_msgs/String", "ros1msg", b"string data\n")
        channel, text = writer.register_channel("/t", "ros1", schema), writer.register_channel("/x", "ros1", other)
        for k in range(3):
            data = struct.pack("<IIII", 5, 1000 + k, 250_000_000, 0) + struct.pack("<III", 1700000001 + k, 0, 0)
            writer.add_message(channel, 9_500_000_000 + k, data, 9)
            writer.add_message(text, 1, b"\0\0\0\0", 9)
        writer.finish()
    bag = read_bag(str(path))
    assert bag.format == ("ROS 1 bag (MCAP)" if profile == "ros1" else "ROS 2 bag (MCAP)")
    assert bag.kinds == {TIME, "std_msgs/msg/String"}
    [topic] = bag.topics.values()
    np.testing.assert_allclose(topic.column("stamp_s"), [1000.25, 1001.25, 1002.25], rtol=0, atol=1e-6)
    np.testing.assert_allclose(topic.column("utc_s"), 1700000001.0 + np.arange(3), rtol=0, atol=1e-6)
    np.testing.assert_allclose(topic.column("received_s"), 9.5, rtol=0, atol=1e-6)
    assert (bag.notes, bag.unread_bytes) == ([], 0)


def test_messages_without_a_definition_are_undefined(tmp_path: Path) -> None:
    bag = Bag("a")
    assert not bag.topic(_Channel("/t", TIME)).undefined
    path = tmp_path / "a.db3"
    with sqlite3.connect(path) as database:
        database.execute("CREATE TABLE topics (id INTEGER, name TEXT, type TEXT, serialization_format TEXT)")
        database.execute("CREATE TABLE messages (topic_id INTEGER, timestamp INTEGER, data BLOB)")
        database.execute("INSERT INTO topics VALUES (1, '/p', 'px4_msgs/msg/VehicleAttitude', 'cdr')")
        database.execute("INSERT INTO messages VALUES (1, 5, x'0001')")
    database.close()
    [topic] = read_bag(str(path)).topics.values()
    assert (topic.undefined, topic.undecoded, len(topic)) == (True, 1, 0)
