"""Which topics of a bag are the flight, with decoys beside them, and bags of strange files."""

import gzip
import io
import sqlite3
import struct
from collections.abc import Callable
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest
import zstandard
from mcap.opcode import Opcode
from mcap.stream_reader import StreamReader
from mcap.writer import CompressionType, Writer
from scipy.spatial.transform import Rotation

from glstar.errors import LogFormatError
from glstar.rotation import turn_between
from glstar.telemetry import open_flight, open_source, read_flight, survey
from glstar.telemetry.bags.topics import vehicles_of
from tests.support.bags import (
    ENU_FLU,
    GEO,
    IMU,
    NO_ORIENTATION,
    ODOMETRY,
    POSE,
    POSE_COV,
    START_NS,
    TIMES_S,
    Bag,
    Px4Bag,
    written,
)
from tests.support.randombags import PLANNED, judged, random_bag
from tests.telemetry.test_rosbag import HOME, require_agreement

Decoy = Callable[[Bag, int, int], None]
UPSIDE_DOWN = Rotation.from_euler("ZYX", [0, 0, 170], degrees=True)


def flight_with(path: Path, *decoys: Decoy, space: str = "", start_ns: int = START_NS) -> Path:
    """Write a true flight and decoys, each called for every sample; return the bag."""
    with Bag(path, "mcap") as bag:
        for k in range(TIMES_S.size):
            bag.imu(k, start_ns, ENU_FLU, topic=f"{space}/mavros/imu/data")
            if k % 10 == 0:
                bag.fix(k, start_ns, topic=f"{space}/mavros/global_position/raw/fix")
            for decoy in decoys:
                decoy(bag, k, start_ns + round(TIMES_S[k] * 1e9))
    return path


def oriented(kind: str, topic: str, rotation: Rotation, *, times: int = 1, frame_id: str = "map") -> Decoy:
    """Return a decoy that writes a constant orientation, several times for each sample."""

    def add(bag: Bag, k: int, stamp_ns: int) -> None:
        del k
        for repeat in range(times):
            bag.oriented(kind, topic, stamp_ns + repeat * 1_000_000, rotation, frame_id, rate=(0.1, 0.1, 0.1))

    return add


@pytest.mark.parametrize(("kind", "topic"), PLANNED)
def test_what_is_planned_or_sent_to_the_autopilot_is_not_the_attitude(tmp_path: Path, kind: str, topic: str) -> None:
    def moving(bag: Bag, k: int, stamp_ns: int) -> None:
        bag.oriented(kind, f"/{topic}", stamp_ns, ENU_FLU[k] * UPSIDE_DOWN, place=(10.0, 20.0, 30.0))

    flight = open_flight(flight_with(tmp_path / "bag", moving))

    require_agreement(flight)
    assert flight.position_source == "/mavros/global_position/raw/fix"
    assert any(f"passed over: /{topic} (" in note for note in flight.notes)


def test_a_setpoint_is_used_if_it_is_named(tmp_path: Path) -> None:
    path = flight_with(tmp_path / "bag", oriented(POSE, "/mavros/setpoint_position/local", UPSIDE_DOWN))

    flight = open_flight(path, attitude="/mavros/setpoint_position/local")

    assert any("is used because it is named" in note for note in flight.notes)


@pytest.mark.parametrize("fault", ["identity", "fixed", "minus one", "unknown", "zero", "own"])
def test_an_imu_that_estimates_no_orientation_is_passed_over(tmp_path: Path, fault: str) -> None:
    covariance = {"minus one": NO_ORIENTATION, "unknown": np.diag([1e6] * 3).ravel()}.get(fault, np.zeros(9))

    def livox(bag: Bag, k: int, stamp_ns: int) -> None:
        rotation = {"identity": Rotation.identity(), "fixed": UPSIDE_DOWN}.get(fault, ENU_FLU[k] * UPSIDE_DOWN)
        for repeat in range(4):
            bag.oriented(
                IMU, "/livox/imu", stamp_ns + repeat * 1_000_000, rotation, "livox_frame", rate=(0.1, 0.1, 0.1),
                covariance=covariance, quaternion=(0.0, 0.0, 0.0, 0.0) if fault == "zero" else None,
            )  # fmt: skip

    flight = open_flight(flight_with(tmp_path / "bag", livox))

    require_agreement(flight)
    assert fault == "own" or any("passed over: /livox/imu (" in note for note in flight.notes)


def test_an_attitude_that_stops_moving_is_passed_over(tmp_path: Path) -> None:
    def stuck(bag: Bag, k: int, stamp_ns: int) -> None:
        for repeat in range(4):
            bag.oriented(IMU, "/imu/data", stamp_ns + repeat * 1_000_000, ENU_FLU[min(k, 20)], "imu_link")

    flight = open_flight(flight_with(tmp_path / "bag", stuck))

    require_agreement(flight)
    assert any(
        "/imu/data (its orientation is constant while that of /mavros/imu/data turns)" in n for n in flight.notes
    )


def test_a_bag_of_an_imu_without_orientation_says_why(tmp_path: Path) -> None:
    with Bag(tmp_path / "bag", "mcap") as bag:
        for k in range(TIMES_S.size):
            stamp_ns = START_NS + round(TIMES_S[k] * 1e9)
            bag.oriented(IMU, "/imu/data_raw", stamp_ns, ENU_FLU[k], covariance=NO_ORIENTATION)

    with pytest.raises(LogFormatError, match=r"/imu/data_raw \(Imu\): its covariance says that it has no orientation$"):
        open_flight(tmp_path / "bag")


def test_the_azimuth_of_every_pose_in_a_local_frame_is_noted(tmp_path: Path) -> None:
    for number, kind in enumerate((POSE, POSE_COV, ODOMETRY)):
        with Bag(tmp_path / f"bag{number}", "db3") as bag:
            for k in range(TIMES_S.size):
                bag.pose(k, START_NS, ENU_FLU, "map", "/pose", kind)
                bag.fix(k, START_NS)

        flight = open_flight(tmp_path / f"bag{number}")

        require_agreement(flight)
        assert any("its azimuth may be relative to the start" in note for note in flight.notes)


def two_vehicles(path: Path, first: str, second: str) -> Path:
    """Write a flight of one vehicle, and of another one that has more positions, 240 km away."""

    def other(bag: Bag, k: int, stamp_ns: int) -> None:
        bag.imu(k, START_NS, ENU_FLU * UPSIDE_DOWN, topic=f"/{second}/mavros/imu/data")
        bag.placed(f"/{second}/mavros/global_position/raw/fix", stamp_ns, (-33.0, 140.0, 500.0))

    return flight_with(path, other, space=f"/{first}")


@pytest.mark.parametrize("names", [("uav1", "uav2"), ("alpha", "bravo"), ("swarm/r1", "swarm/r2"), ("v/1", "v/2")])
def test_two_vehicles_are_never_mixed(tmp_path: Path, names: tuple[str, str]) -> None:
    path = two_vehicles(tmp_path / "bag", *names)
    vehicles = [name.rpartition("/")[2] for name in names]

    first, second = (open_flight(path, vehicle=name) for name in vehicles)

    require_agreement(first)
    assert np.rad2deg(first.position.at(0).latitude_rad) == pytest.approx(-34.93, abs=1e-3)
    assert np.rad2deg(second.position.at(0).latitude_rad) == pytest.approx(-33.0, abs=1e-3)
    assert second.attitude_source.startswith(f"/{names[1]}/")
    assert any(f"holds 2 vehicles ({', '.join(vehicles)})" in note for note in open_flight(path).notes)
    with pytest.raises(LogFormatError, match=rf"no vehicle 'x' \(--vehicle\); it has {vehicles[0]}, {vehicles[1]}$"):
        open_flight(path, vehicle="x")


def test_the_position_of_another_vehicle_is_not_taken(tmp_path: Path) -> None:
    with Bag(tmp_path / "bag", "mcap") as bag:
        for k in range(TIMES_S.size):
            bag.imu(k, START_NS, ENU_FLU, topic="/uav1/imu/data")
            bag.fix(k, START_NS, topic="/uav2/fix")

    with pytest.raises(LogFormatError, match=r"no position \(uav1 has none; --columns position= takes another one of"):
        open_flight(tmp_path / "bag")

    require_agreement(open_flight(tmp_path / "bag", columns="position=/uav2/fix"))


@pytest.mark.parametrize(
    ("attitude", "fix", "doubts"),
    [
        ("/red/imu", "/blue/fix", 1),
        ("/red/ahrs/imu", "/blue/gps/fix", 1),
        ("/red/imu", "/red/gps/fix", 0),
        ("/red/imu", "/fix", 0),
        ("/vectornav/imu", "/ublox/fix", 0),
        ("/mavros/imu/data", "/blue/fix", 0),
    ],
)
@pytest.mark.parametrize("named", [False, True])
def test_a_position_of_another_name_space_is_noted(
    tmp_path: Path, attitude: str, fix: str, doubts: int, named: bool
) -> None:
    with Bag(tmp_path / "bag", "mcap") as bag:
        for k in range(TIMES_S.size):
            bag.imu(k, START_NS, ENU_FLU, topic=attitude)
            bag.fix(k, START_NS, topic=fix)

    notes = open_flight(tmp_path / "bag", attitude=attitude if named else "auto").notes
    confirmed = open_flight(tmp_path / "bag", columns=f"position={fix}").notes

    assert sum(f"{fix} may be of another vehicle than {attitude}" in note for note in notes) == doubts
    assert not any("another vehicle" in note for note in confirmed)


def test_distant_positions_in_one_name_space_are_refused(tmp_path: Path) -> None:
    def other(bag: Bag, k: int, stamp_ns: int) -> None:
        del k
        bag.placed("/mavros/global_position/other", stamp_ns, (-33.0, 140.0, 500.0))

    path = flight_with(tmp_path / "bag", other)

    with pytest.raises(
        LogFormatError, match=r"km from each other, and nothing says which is the aircraft; name one with --col"
    ):
        open_flight(path)


@pytest.mark.parametrize(("kind", "topic"), [(ODOMETRY, "/ins"), (GEO, "/ins/fix")])
def test_the_position_below_the_attitude_or_in_it_is_that_of_the_aircraft(
    tmp_path: Path, kind: str, topic: str
) -> None:
    with Bag(tmp_path / "bag", "mcap") as bag:
        for k in range(TIMES_S.size):
            stamp_ns = START_NS + round(TIMES_S[k] * 1e9)
            bag.oriented(kind, topic, stamp_ns, ENU_FLU[k], place=(-34.93, 138.6, 150.0))
            if kind == ODOMETRY:
                bag.placed("/ins/fix", stamp_ns, (-34.93, 138.6, 150.0))
            bag.placed("/phone_fix", stamp_ns, (-33.0, 140.0, 500.0))

    flight = open_flight(tmp_path / "bag")

    require_agreement(flight)
    assert flight.position_source == "/ins/fix"


def test_stamps_of_another_clock_are_replaced_by_reception(tmp_path: Path) -> None:
    boot_ns = 30_000_000_000

    def others(bag: Bag, k: int, stamp_ns: int) -> None:
        since_ns = stamp_ns - START_NS + boot_ns
        bag.time("/gps/time_reference", since_ns, stamp_ns - 100_000_000_000, received_ns=stamp_ns)
        bag.oriented(
            IMU, "/boot/imu", since_ns, ENU_FLU[k], covariance=NO_ORIENTATION, rate=(1.0, 0.0, 0.0),
            late_ns=stamp_ns - since_ns,
        )  # fmt: skip

    flight = open_flight(flight_with(tmp_path / "bag", others))

    # As well as messages are received: the Imu 3 ms after its stamp.
    assert abs(flight.attitude.first_s - (START_NS * 1e-9 - 100.0)) < 0.005
    assert any("are replaced by times of reception: /gps/time_reference" in note for note in flight.notes)
    assert any("/boot/imu (its stamps are of another clock)" in note for note in flight.notes)


def test_parts_of_one_vehicle_are_no_vehicles() -> None:
    fix = "sensor_msgs/msg/NavSatFix"
    bags = (
        {"/imu/data": IMU, "/gps/fix": fix},
        {"/vectornav/imu": IMU, "/ublox/fix": fix, "/camera/imu": IMU},
        {"/imu_0/data": IMU, "/imu_1/data": IMU, "/gps_0/fix": fix, "/gps_1/fix": fix},
        {"/uav1/mavros/imu/data": IMU, "/uav1/mavros/local_position/pose": POSE, "/uav1/mavros/mocap/pose": POSE},
        {"/a200_0284/sensors/imu_0/data": IMU, "/a200_0284/sensors/gps_0/fix": fix, "/tf": POSE},
        {"/mavros/imu/data": IMU, "/rovio/odometry": ODOMETRY, "/okvis/odometry": ODOMETRY},
        {"/robot_localization/odometry/filtered": ODOMETRY, "/drone/imu": IMU},
    )

    assert [set(vehicles_of(kinds).values()) for kinds in bags] == [{""}] * len(bags)


def test_vehicles_of_several_name_spaces_are_found() -> None:
    fix = "sensor_msgs/msg/NavSatFix"
    shared = {"/gps/time_reference": "sensor_msgs/msg/TimeReference"}
    bags = (
        {"/uav1/imu": IMU, "/uav2/fix": fix},
        {"/red/imu": IMU, "/red/fix": fix, "/blue/imu": IMU, "/blue/fix": fix},
        {"/fmu/out/pose": POSE, "/px4_1/fmu/out/pose": POSE},
        {"/leader/imu": IMU, "/vicon/follower/pose": POSE},
        {"/uav1/imu": IMU, "/husky/fix": fix, "/camera/imu": IMU, "/goal/pose": POSE},
    )

    found = [sorted(set(vehicles_of(kinds | shared).values()) - {""}) for kinds in bags]

    assert found == [["uav1", "uav2"], ["blue", "red"], ["px4_1", "unnamed"], ["follower", "leader"], ["husky", "uav1"]]


@pytest.mark.parametrize("fault", ["boot", "1970", "frozen", "scattered"])
def test_a_time_reference_that_counts_no_utc_is_passed_over(tmp_path: Path, fault: str) -> None:
    late_ns = 100_000_000_000

    def clocks(bag: Bag, k: int, stamp_ns: int) -> None:
        utc_ns = stamp_ns - late_ns
        since_ns = utc_ns - START_NS
        read_ns = {
            "boot": 10**12 + since_ns,
            "1970": since_ns,
            "frozen": START_NS - 10**9,
            "scattered": utc_ns + k * 10**9,
        }
        for repeat in range(3):
            bag.time("/lidar/trigger_time", stamp_ns + repeat * 1_000_000, read_ns[fault])
        if k % 10 == 0:
            bag.time("/gps/time_reference", stamp_ns, utc_ns)

    flight = open_flight(flight_with(tmp_path / "bag", clocks, start_ns=START_NS + late_ns))

    require_agreement(flight)
    assert flight.utc_source == "/gps/time_reference, 10 readings"
    assert "/lidar/trigger_time is passed over: it counts no UTC" in flight.notes


@pytest.mark.parametrize("turned_deg", [0.0, 120.0])
def test_gyros_of_another_device_are_turned_into_the_axes_of_the_attitude(tmp_path: Path, turned_deg: float) -> None:
    sensor = Rotation.from_rotvec(np.deg2rad(turned_deg) * np.ones(3) / np.sqrt(3))
    fast_s = np.arange(0, 3.96, 0.005)
    angles_deg = np.stack([20 * np.sin(6 * fast_s), 15 * np.cos(5 * fast_s), 10 * np.sin(4 * fast_s)], axis=-1)
    turning = Rotation.from_euler("ZYX", angles_deg, degrees=True)
    with Bag(tmp_path / "bag", "mcap") as bag:
        rates = (turning[:-2].inv() * turning[2:]).as_rotvec() / 0.01
        for k, rate in enumerate(rates, 1):
            stamp_ns = START_NS + round(fast_s[k] * 1e9)
            bag.oriented(IMU, "/camera/imu", stamp_ns, turning[k], covariance=NO_ORIENTATION, rate=sensor.apply(rate))
            if k % 20 == 0:
                bag.oriented(POSE, "/mavros/local_position/pose", stamp_ns, turning[k])
                bag.placed("/fix", stamp_ns, (-34.93, 138.6, 100.0))

    flight = open_flight(tmp_path / "bag", interpolation="gyro")

    every = open_flight(tmp_path / "bag", attitude="/mavros/local_position/pose", interpolation="spline")
    between_s = np.linspace(every.attitude.first_s + 0.5, every.attitude.last_s - 0.5, 400)
    off = turn_between(flight.attitude.at(between_s), every.attitude.at(between_s))
    assert np.rad2deg(np.linalg.norm(off, axis=-1).max()) < 0.2
    assert (", turned by 1" in flight.attitude_source) == (turned_deg == 120.0)


def test_gyros_that_do_not_turn_as_the_attitude_does_are_refused(tmp_path: Path) -> None:
    with Bag(tmp_path / "bag", "mcap") as bag:
        for k in range(TIMES_S.size):
            stamp_ns = START_NS + round(TIMES_S[k] * 1e9)
            bag.oriented(POSE, "/pose", stamp_ns, ENU_FLU[k])
            bag.oriented(IMU, "/camera/imu", stamp_ns, ENU_FLU[k], covariance=NO_ORIENTATION, rate=(1.0, 0.0, 0.0))
            bag.fix(k, START_NS)

    flight = open_flight(tmp_path / "bag")
    with open_source(tmp_path / "bag") as source:
        report, _ = survey(source)

    assert any("gyros that do not turn as the attitude does are not used: /camera/imu" in n for n in flight.notes)
    assert report.gyros is None


def stored(path: Path) -> bytes:
    """Return the content of the MCAP file of a bag."""
    return next(path.glob("*.mcap")).read_bytes()


def mcap_of(
    path: Path, profile: str = "ros2", *, chunk_size: int = 4096, extra: Callable[[Writer], None] | None = None,
    compression: CompressionType = CompressionType.ZSTD,
) -> bytes:  # fmt: skip
    """Return the messages of a bag as MCAP of the mcap library, beside what `extra` writes."""
    out, schemas, channels = io.BytesIO(), {}, {}
    writer = Writer(out, chunk_size=chunk_size, compression=compression)
    writer.start(profile=profile)
    if extra is not None:
        extra(writer)
    for record in StreamReader(io.BytesIO(stored(path))).records:
        kind = type(record).__name__
        if kind == "Schema" and record.id not in schemas:
            schemas[record.id] = writer.register_schema(record.name, record.encoding, record.data)
        if kind == "Channel" and record.id not in channels:
            channels[record.id] = writer.register_channel(
                record.topic, record.message_encoding, schemas[record.schema_id]
            )
        if kind == "Message":
            writer.add_message(channels[record.channel_id], record.log_time, record.data, record.publish_time)
    writer.finish()
    return out.getvalue()


def odd_schemas(writer: Writer) -> None:
    """Write topics that are none of ROS, and one whose definition cannot be parsed."""
    json_id = writer.register_schema("foxglove.Pose", "jsonschema", b'{"type": "object"}')
    writer.add_message(writer.register_channel("/json", "json", json_id), 1, b"{}", 1)
    writer.add_message(writer.register_channel("/none", "protobuf", 0), 1, b"\0", 1)
    event = writer.register_schema("example_interfaces/srv/AddTwoInts_Event", "ros2msg", b"what is this?\n===\n")
    writer.add_message(writer.register_channel("/add/_service_event", "cdr", event), 1, b"\0\1\0\0", 1)


@pytest.mark.parametrize("profile", ["ros2", "", "px4"])
def test_an_odd_schema_or_profile_does_not_refuse_a_bag(tmp_path: Path, profile: str) -> None:
    path = tmp_path / "flight.mcap"
    path.write_bytes(mcap_of(written(tmp_path / "bag", "mcap"), profile, extra=odd_schemas))

    require_agreement(open_flight(path))


def test_messages_of_ros_1_in_mcap_are_read(tmp_path: Path) -> None:
    path, out = tmp_path / "flight.mcap", io.BytesIO()
    with Bag(tmp_path / "one.bag", "bag") as bag:
        writer = Writer(out)
        writer.start(profile="ros1")
        definition = bag.store.generate_msgdef(IMU, ros_version=1)[0]
        channel = writer.register_channel(
            "/imu/data", "ros1", writer.register_schema("sensor_msgs/Imu", "ros1msg", definition.encode())
        )
        bag.writer.write = lambda connection, received_ns, data: writer.add_message(  # type: ignore[method-assign]
            channel, received_ns, data, received_ns
        )
        for k in range(TIMES_S.size):
            bag.imu(k, START_NS, ENU_FLU)
        writer.finish()
    path.write_bytes(out.getvalue())

    require_agreement(open_flight(path, site=HOME))


def test_a_recording_that_was_cut_is_read_to_its_last_whole_record(tmp_path: Path) -> None:
    path = tmp_path / "flight.mcap"
    whole = mcap_of(written(tmp_path / "bag", "mcap"), chunk_size=2048)
    path.write_bytes(whole[: len(whole) * 2 // 3])

    flight = open_flight(path)

    assert 30 < flight.attitude.utc_s.size < 100
    assert abs(flight.attitude.first_s - START_NS * 1e-9) < 1e-6
    assert any("the recording breaks off at byte" in note for note in flight.notes)


def test_files_of_a_bag_without_a_message_do_not_refuse_the_others(tmp_path: Path) -> None:
    folder = tmp_path / "night"
    folder.mkdir()
    for number, content in enumerate((b"", stored(written(tmp_path / "bag", "mcap")), b"")):
        (folder / f"night_{number}.mcap").write_bytes(content)

    flight = open_flight(folder)

    require_agreement(flight)
    assert [note for note in flight.notes if "breaks off in night_2.mcap" in note]


def test_what_could_not_be_read_is_a_part_of_all_files_of_a_bag(tmp_path: Path) -> None:
    folder = tmp_path / "night"
    folder.mkdir()
    whole = mcap_of(
        written(tmp_path / "bag", "mcap"), extra=lambda writer: writer.add_attachment(0, 0, "a", "b", bytes(200_000))
    )
    (folder / "night_0.mcap").write_bytes(whole)
    (folder / "night_1.mcap").write_bytes(whole[:190_000])

    with open_source(folder) as source:
        report, _ = survey(source)

    assert report.file_bytes == len(whole) + 190_000
    (unread,) = (note for note in report.notes if "could not be read" in note)
    assert "0.2 MB of the file, 47%" in unread


def test_damage_within_a_chunk_is_noted_and_the_next_chunk_is_read(tmp_path: Path) -> None:
    path = tmp_path / "flight.mcap"
    content = bytearray(mcap_of(written(tmp_path / "bag", "mcap"), chunk_size=4096, compression=CompressionType.NONE))
    # The length of the first message: in the first chunk, after its schemas and channels.
    at = content.index(START_NS.to_bytes(8, "little"), content.index(b"/fix")) - 15
    assert content[at] == Opcode.MESSAGE
    content[at + 1 : at + 9] = (1 << 40).to_bytes(8, "little")
    path.write_bytes(content)

    flight = open_flight(path)

    assert 50 < flight.attitude.utc_s.size < 100
    assert "a chunk of the recording is damaged, and its last messages are lost" in flight.notes


def test_a_damaged_compressed_message_is_left_out(tmp_path: Path) -> None:
    path = tmp_path / "flight.db3"
    path.write_bytes(next(written(tmp_path / "bag", "db3").glob("*.db3")).read_bytes())
    with closing(sqlite3.connect(path)) as database, database:
        rows = database.execute("SELECT id, data FROM messages ORDER BY timestamp").fetchall()
        for number, (row, data) in enumerate(rows):
            packed = zstandard.compress(data)[: 10 if number == 70 else None]
            database.execute("UPDATE messages SET data = ? WHERE id = ?", (packed, row))

    flight = open_flight(path)

    assert flight.attitude.utc_s.size == 99
    assert "1 messages of /imu/data cannot be decoded and are left out" in flight.notes


def test_every_cut_of_a_recording_is_read_or_refused(tmp_path: Path) -> None:
    path = tmp_path / "flight"
    whole = mcap_of(written(tmp_path / "bag", "mcap"), chunk_size=2048)
    counts = []
    for length in range(len(whole), 8, -997):
        path.write_bytes(whole[:length])
        try:
            counts.append(open_flight(path).attitude.utc_s.size)
        except LogFormatError:
            counts.append(0)

    assert counts[0] == 100
    assert counts == sorted(counts, reverse=True)


def test_a_ros_1_bag_without_an_index_is_read(tmp_path: Path) -> None:
    content = written(tmp_path / "whole.bag", "bag").read_bytes()
    at = content.index(b"index_pos=") + len(b"index_pos=")
    (index,) = struct.unpack("<Q", content[at : at + 8])
    path = tmp_path / "flight.bag.active"
    path.write_bytes(content[:at] + bytes(8) + content[at + 8 : index])

    flight = open_flight(path)

    require_agreement(flight)
    assert not any("breaks off" in note for note in flight.notes)


@pytest.mark.parametrize("kind", ["bag", "mcap", "db3"])
@pytest.mark.parametrize("name", ["FLIGHT.{}", "flight", "flight.dat", "a #1?.{}"])
def test_a_bag_is_recognised_by_its_content(tmp_path: Path, kind: str, name: str) -> None:
    path = written(tmp_path / "whole.bag" if kind == "bag" else tmp_path / "whole", kind)
    file = path if kind == "bag" else next(path.glob(f"*.{kind}"))
    renamed = tmp_path / name.format(kind.upper())
    renamed.write_bytes(file.read_bytes())
    packed = tmp_path / f"{kind}.gz"
    packed.write_bytes(gzip.compress(renamed.read_bytes()))

    require_agreement(open_flight(renamed))
    require_agreement(open_flight(packed))


def test_what_a_killed_recorder_left_in_the_write_ahead_log_is_read(tmp_path: Path) -> None:
    path = tmp_path / "flight.db3"
    path.write_bytes(next(written(tmp_path / "bag", "db3").glob("*.db3")).read_bytes())
    database = sqlite3.connect(path)
    database.execute("PRAGMA journal_mode = WAL")
    database.execute("PRAGMA wal_autocheckpoint = 0")
    late = database.execute("SELECT topic_id, timestamp, data FROM messages ORDER BY timestamp").fetchall()[60:]
    database.execute("DELETE FROM messages WHERE timestamp >= ?", (late[0][1],))
    database.commit()
    database.execute("PRAGMA wal_checkpoint(TRUNCATE)")
    database.executemany("INSERT INTO messages (topic_id, timestamp, data) VALUES (?, ?, ?)", late)
    database.commit()
    folder = tmp_path / "killed"
    folder.mkdir()
    for file in tmp_path.glob("flight.db3*"):
        (folder / file.name).write_bytes(file.read_bytes())
    database.close()

    flight = open_flight(folder / "flight.db3")

    require_agreement(flight)
    assert flight.attitude.utc_s.size == 100


def test_a_directory_without_metadata_is_a_bag_if_its_recorder_was_killed(tmp_path: Path) -> None:
    folder = tmp_path / "night"
    folder.mkdir()
    (folder / "night_0.mcap").write_bytes(stored(written(tmp_path / "bag", "mcap")))

    require_agreement(open_flight(folder))


def test_two_kinds_on_one_topic_are_two_topics(tmp_path: Path) -> None:
    def pose(bag: Bag, k: int, stamp_ns: int) -> None:
        del k
        connection = bag.connections.pop("/mavros/imu/data")
        bag.connections["/mavros/imu/data"] = bag.connections.setdefault("pose", None) or bag.writer.add_connection(
            "/mavros/imu/data", POSE, typestore=bag.store
        )
        bag.connections["pose"] = bag.connections["/mavros/imu/data"]
        bag.oriented(POSE, "/mavros/imu/data", stamp_ns, UPSIDE_DOWN)
        bag.connections["/mavros/imu/data"] = connection

    flight = open_flight(flight_with(tmp_path / "bag", pose))

    require_agreement(flight)
    assert any("/mavros/imu/data has messages of two kinds" in note for note in flight.notes)


def test_a_vehicle_of_a_telemetry_log_is_its_system(tmp_path: Path) -> None:
    path = flight_with(tmp_path / "bag")

    with pytest.raises(LogFormatError, match=r"no vehicle '1' \(--vehicle\); it has one vehicle, without a name"):
        open_flight(path, vehicle="1")
    with pytest.raises(LogFormatError, match="is no log of several vehicles; leave out vehicle, which is 'uav1'"):
        open_flight(_table(tmp_path), vehicle="uav1")


def _table(folder: Path) -> Path:
    path = folder / "flight.csv"
    path.write_text(
        "utc,roll_deg,pitch_deg,yaw_deg,latitude_deg,longitude_deg,height_m\n1,0,0,0,0,1,2\n2,0,0,0,0,1,2\n"
    )
    return path


def test_random_bags_give_the_true_flight_or_are_refused(tmp_path: Path) -> None:
    for seed in range(6):
        folder = tmp_path / str(seed)
        folder.mkdir()
        made = random_bag(np.random.default_rng(seed), folder)
        assert not judged(made).startswith("wrong"), (seed, made.said)


def test_the_flight_of_a_bag_is_read_once(tmp_path: Path) -> None:
    with open_source(
        flight_with(tmp_path / "bag", oriented(GEO, "/mavros/setpoint_position/global", UPSIDE_DOWN))
    ) as log:
        names = [name for name, _ in log.attitudes()]
        flight = read_flight(log)

    assert names == ["/mavros/imu/data", "/mavros/setpoint_position/global"]
    require_agreement(flight)


# --- attitudes that do not turn alike -------------------------------------------------------------------------------
FASTER = Rotation.from_rotvec(np.outer(-8 * TIMES_S, [0, 0, 1]), degrees=True) * ENU_FLU


def turning(kind: str, topic: str, rotations: Rotation, frame_id: str = "map", **more: object) -> Decoy:
    """Return a decoy with an orientation of its own at each sample."""

    def add(bag: Bag, k: int, stamp_ns: int) -> None:
        bag.oriented(kind, topic, stamp_ns, rotations[k], frame_id, **more)  # type: ignore[arg-type]

    return add


@pytest.mark.parametrize("topic", ["/mission/geopose", "/fov/geopose", "/leader_of_us"])
def test_a_pose_that_turns_otherwise_is_passed_over_beside_an_imu(tmp_path: Path, topic: str) -> None:
    with Bag(tmp_path / "bag", "mcap") as bag:
        for k in range(TIMES_S.size):
            bag.imu(k, START_NS, ENU_FLU, topic="/vectornav/imu")
            bag.fix(k, START_NS)
            bag.oriented(GEO, topic, START_NS + round(TIMES_S[k] * 1e9), FASTER[k], place=(10.0, 20.0, 30.0))

    flight = open_flight(tmp_path / "bag")

    require_agreement(flight)
    assert any(f"passed over: {topic}" in note for note in flight.notes)
    assert flight.position_source == "/fix"


def test_poses_that_turn_otherwise_are_refused_and_gyros_decide(tmp_path: Path) -> None:
    def bag_with(name: str, *, gyros: bool) -> Path:
        with Bag(tmp_path / name, "mcap") as bag:
            for k in range(TIMES_S.size):
                stamp_ns = START_NS + round(TIMES_S[k] * 1e9)
                for topic, rotations in (("/a/pose", FASTER), ("/b/pose", ENU_FLU)):
                    bag.oriented(POSE, topic, stamp_ns, rotations[k])
                bag.fix(k, START_NS)
                if gyros:
                    before, after = ENU_FLU[max(k - 1, 0)], ENU_FLU[min(k + 1, TIMES_S.size - 1)]
                    span_s = TIMES_S[min(k + 1, TIMES_S.size - 1)] - TIMES_S[max(k - 1, 0)]
                    rate = (before.inv() * after).as_rotvec() / span_s
                    bag.oriented(IMU, "/imu/raw", stamp_ns, ENU_FLU[k], rate=rate, covariance=NO_ORIENTATION)
        return tmp_path / name

    poses = bag_with("poses", gyros=False)
    with pytest.raises(LogFormatError, match=r"/a/pose and /b/pose turn by differ by \d+ deg: .*--attitude"):
        open_flight(poses)
    require_agreement(open_flight(poses, attitude="/b/pose"))
    flight = open_flight(bag_with("with gyros", gyros=True))
    require_agreement(flight)
    assert any("passed over: /a/pose" in note for note in flight.notes)


def test_imus_of_two_bodies_without_vehicles_are_refused(tmp_path: Path) -> None:
    path = flight_without_vehicle(tmp_path / "bag")

    with pytest.raises(LogFormatError, match="not of one body, and nothing says which is the aircraft"):
        open_flight(path)


def flight_without_vehicle(path: Path) -> Path:
    """Write Imus of two bodies whose topics name no vehicle."""
    with Bag(path, "mcap") as bag:
        for k in range(TIMES_S.size):
            bag.imu(k, START_NS, ENU_FLU, topic="/imu_boat")
            bag.imu(k, START_NS, FASTER, topic="/imu_helicopter")
            bag.fix(k, START_NS)
    return path


# --- other time scales ----------------------------------------------------------------------------------------------
@pytest.mark.parametrize(
    ("ahead_s", "scale"),
    [(18.02, "GPS time"), (37.0, "TAI"), (18.0 - 315964800.0, "GPS time since 1980"), (17.0, ""), (0.0, "")],
)
@pytest.mark.parametrize("boot", [True, False])
def test_a_time_reference_of_another_scale_is_converted(
    tmp_path: Path, ahead_s: float, scale: str, *, boot: bool
) -> None:
    """The recorder's clock shows it; a clock that is off by another time is used."""
    late_ns = START_NS - 40_000_000_000 if boot else 0
    with Bag(tmp_path / "bag", "mcap") as bag:
        for k in range(TIMES_S.size):
            now_ns = START_NS + round(TIMES_S[k] * 1e9)
            bag.oriented(IMU, "/imu", now_ns - late_ns, ENU_FLU[k], late_ns=late_ns)
            bag.placed("/fix", now_ns, HOME_DEG)
            if k % 10 == 0:
                bag.time("/gnss/time", now_ns - late_ns, now_ns + round(ahead_s * 1e9), received_ns=now_ns)

    flight = open_flight(tmp_path / "bag")

    off_s = 0.02 if ahead_s == 18.02 else 0.0 if scale else ahead_s
    assert flight.attitude.first_s == pytest.approx(START_NS * 1e-9 + off_s, abs=1e-3)
    assert any(f"/gnss/time count {scale}" in note for note in flight.notes) == bool(scale)


HOME_DEG = (-34.93, 138.6, 100.0)


def test_stamps_of_gps_time_are_converted(tmp_path: Path) -> None:
    with Bag(tmp_path / "bag", "mcap") as bag:
        for k in range(TIMES_S.size):
            now_ns = START_NS + round(TIMES_S[k] * 1e9)
            bag.oriented(IMU, "/imu", now_ns + 18_000_000_000, ENU_FLU[k], late_ns=-18_000_000_000 + 3_000_000)
            bag.placed("/fix", now_ns, HOME_DEG)

    flight = open_flight(tmp_path / "bag")

    assert flight.attitude.first_s == pytest.approx(START_NS * 1e-9, abs=1e-3)
    assert any("the stamps of /imu count GPS time" in note for note in flight.notes)


def test_of_two_clocks_of_receivers_the_one_that_was_never_set_is_not_used(tmp_path: Path) -> None:
    late_ns = START_NS - 40_000_000_000
    with Bag(tmp_path / "bag", "mcap") as bag:
        for k in range(TIMES_S.size):
            now_ns = START_NS + round(TIMES_S[k] * 1e9)
            bag.oriented(IMU, "/imu", now_ns - late_ns, ENU_FLU[k], late_ns=late_ns)
            bag.placed("/fix", now_ns, HOME_DEG)
            bag.time("/gps/rtc", now_ns - late_ns, now_ns - 258462000_000000000, received_ns=now_ns)
            if k % 25 == 0:
                bag.time("/gnss/time", now_ns - late_ns, now_ns, received_ns=now_ns)

    assert open_flight(tmp_path / "bag").attitude.first_s == pytest.approx(START_NS * 1e-9, abs=1e-3)


# --- messages of PX4 ------------------------------------------------------------------------------------------------
@pytest.mark.parametrize("kind", ["mcap", "db3"])
@pytest.mark.parametrize("boot_ns", [START_NS, 40_000_000_000])
@pytest.mark.parametrize("attitude", ["vehicle_attitude", "vehicle_odometry"])
def test_px4_topics_are_a_flight_by_utc_or_since_boot(tmp_path: Path, kind: str, boot_ns: int, attitude: str) -> None:
    with Px4Bag(tmp_path / "bag", kind) as bag:
        bag.flight(boot_ns, attitude=attitude)

    flight = open_flight(tmp_path / "bag")

    require_agreement(flight)
    assert flight.attitude.first_s == pytest.approx(START_NS * 1e-9, abs=2e-3)
    assert flight.attitude_source == f"/fmu/out/{attitude}, 25.0 Hz"
    site = flight.position.at(START_NS * 1e-9 + 2.0)
    np.testing.assert_allclose(np.rad2deg([site.latitude_rad, site.longitude_rad]), [-34.93, 138.6], rtol=0, atol=1e-9)
    assert site.height_m == pytest.approx(150.0, rel=0, abs=1e-6)
    assert flight.utc_source.startswith("/fmu/out/vehicle_gps_position")
    open_flight(tmp_path / "bag", interpolation="gyro")


def test_px4_without_utc_of_a_receiver_is_timed_by_the_host_or_refused_with_its_time(tmp_path: Path) -> None:
    for name, boot_ns in (("synchronised", START_NS), ("since boot", 40_000_000_000)):
        with Px4Bag(tmp_path / name, "mcap") as bag:
            bag.flight(boot_ns, utc=False)

    assert open_flight(tmp_path / "synchronised").attitude.first_s == pytest.approx(START_NS * 1e-9, abs=2e-3)
    with pytest.raises(LogFormatError, match=r"its recorder received the first attitude at 2024-03-10T11:00:00\.25"):
        open_flight(tmp_path / "since boot")


def test_px4_setpoints_of_other_programs_are_not_the_attitude(tmp_path: Path) -> None:
    with Px4Bag(tmp_path / "bag", "mcap") as bag:
        bag.flight(START_NS)
        bag.flight(START_NS, attitude="vehicle_visual_odometry", node="/fmu/in")

    flight = open_flight(tmp_path / "bag")

    assert flight.attitude_source.startswith("/fmu/out/vehicle_attitude")


def test_px4_messages_without_definitions_are_refused_with_the_remedy(tmp_path: Path) -> None:
    """Recorders before ROS Iron write no definitions into a database."""
    with Px4Bag(tmp_path / "bag", "db3") as bag:
        bag.flight(START_NS)
    with closing(sqlite3.connect(next((tmp_path / "bag").glob("*.db3")))) as database:
        database.execute("DROP TABLE message_definitions")
        database.commit()

    with pytest.raises(
        LogFormatError,
        match=r"no definitions of the messages of /fmu/out/vehicle_attitude \(px4_msgs/VehicleAttitude\)",
    ) as refusal:
        open_flight(tmp_path / "bag")
    assert "convert it to MCAP where their package is installed: ros2 bag convert" in str(refusal.value)
