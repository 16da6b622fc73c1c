"""ROS bags, written by the rosbags library: attitude, UTC and position agree with SciPy."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as Writer2
from rosbags.typesys import Stores, get_typestore
from scipy.spatial.transform import Rotation, Slerp
from typer.testing import CliRunner

from glstar.cli import app
from glstar.errors import ConfigError, LogFormatError
from glstar.flight import Flight
from glstar.rotation import matrix_from_quaternion
from glstar.sky.place.site import Site
from glstar.telemetry import RateSamples, open_flight, open_source

START_NS = 1710068400_250000000
TIMES_S = np.arange(100) * 0.04
YAW_DEG, PITCH_DEG, ROLL_DEG = 350 + 9 * TIMES_S, 4 * np.sin(TIMES_S), 20 * np.cos(TIMES_S)
NED_FRD = Rotation.from_euler("ZYX", np.column_stack([YAW_DEG, PITCH_DEG, ROLL_DEG]), degrees=True)
ENU_FLU = (
    Rotation.from_matrix(np.array([[0.0, 1, 0], [1, 0, 0], [0, 0, -1]]))
    * NED_FRD
    * Rotation.from_matrix(np.diag([1.0, -1, -1]))
)
HOME = Site(latitude_rad=np.deg2rad(-34.93), longitude_rad=np.deg2rad(138.60))
NO = np.zeros(9)


class Bag:
    """A bag of any kind, written message by message."""

    def __init__(self, path: Path, kind: str) -> None:
        self.is1 = kind == "bag"
        self.store = get_typestore(Stores.ROS1_NOETIC if self.is1 else Stores.ROS2_HUMBLE)
        plugin = StoragePlugin.MCAP if kind == "mcap" else StoragePlugin.SQLITE3
        self.writer: Any = Writer1(path) if self.is1 else Writer2(path, version=9, storage_plugin=plugin)
        self.connections: dict[str, Any] = {}
        self.count = 0

    def __enter__(self) -> "Bag":
        self.writer.open()
        return self

    def __exit__(self, *_: object) -> None:
        self.writer.close()

    def make(self, name: str, **fields: Any) -> Any:
        return self.store.types[name](**fields)

    def header(self, stamp_ns: int, frame_id: str) -> Any:
        stamp = self.make("builtin_interfaces/msg/Time", sec=stamp_ns // 10**9, nanosec=stamp_ns % 10**9)
        own = {"seq": 0} if self.is1 else {}
        return self.make("std_msgs/msg/Header", stamp=stamp, frame_id=frame_id, **own)

    def quaternion(self, x: float, y: float, z: float, w: float) -> Any:
        return self.make("geometry_msgs/msg/Quaternion", x=x, y=y, z=z, w=w)

    def vector(self, *xyz: float) -> Any:
        return self.make("geometry_msgs/msg/Vector3", **dict(zip("xyz", map(float, xyz), strict=True)))

    def write(self, topic: str, kind: str, received_ns: int, **fields: Any) -> None:
        if topic not in self.connections:
            self.connections[topic] = self.writer.add_connection(topic, kind, typestore=self.store)
        serialize = self.store.serialize_ros1 if self.is1 else self.store.serialize_cdr
        self.writer.write(self.connections[topic], received_ns, serialize(self.make(kind, **fields), kind))

    def imu(
        self, k: int, start_ns: int, rotation: Rotation, frame_id: str = "imu_link", topic: str = "/imu/data"
    ) -> None:
        stamp_ns = start_ns + round(TIMES_S[k] * 1e9)
        self.write(
            topic, "sensor_msgs/msg/Imu", stamp_ns + 3_000_000,
            header=self.header(stamp_ns, frame_id), orientation=self.quaternion(*rotation[k].as_quat()),
            orientation_covariance=NO, angular_velocity=self.vector(0.1, 0.2, 0.3), angular_velocity_covariance=NO,
            linear_acceleration=self.vector(0, 0, 9.8), linear_acceleration_covariance=NO,
        )  # fmt: skip

    def fix(self, k: int, start_ns: int, status: int = 0, topic: str = "/fix") -> None:
        stamp_ns = start_ns + round(TIMES_S[k] * 1e9)
        own = self.make("sensor_msgs/msg/NavSatStatus", status=status, service=1)
        self.write(
            topic, "sensor_msgs/msg/NavSatFix", stamp_ns, header=self.header(stamp_ns, "gps"), status=own,
            latitude=-34.93 + 1e-5 * TIMES_S[k], longitude=138.6, altitude=150.0 + TIMES_S[k],
            position_covariance=NO, position_covariance_type=0,
        )  # fmt: skip

    def camera_info(self, k: int, start_ns: int, topic: str) -> None:
        stamp_ns = start_ns + round(TIMES_S[k] * 1e9)
        letters = str.upper if self.is1 else str.lower
        matrices = {letters(name): np.zeros(size) for name, size in (("d", 5), ("k", 9), ("r", 9), ("p", 12))}
        self.write(
            topic, "sensor_msgs/msg/CameraInfo", stamp_ns, header=self.header(stamp_ns, "camera"), height=4, width=4,
            distortion_model="plumb_bob", **matrices, binning_x=0, binning_y=0,
            roi=self.make(
                "sensor_msgs/msg/RegionOfInterest", x_offset=0, y_offset=0, height=0, width=0, do_rectify=False
            ),
        )  # fmt: skip


def written(path: Path, kind: str, start_ns: int = START_NS) -> Path:
    """Write a bag with attitude and position; return what a user would name."""
    with Bag(path, kind) as bag:
        for k in range(TIMES_S.size):
            bag.imu(k, start_ns, ENU_FLU)
            if k % 5 == 0:
                bag.fix(k, start_ns, status=-1 if k == 0 else 0)
    return path


def require_agreement(flight: Flight, start_s: float = START_NS * 1e-9) -> None:
    between_s = TIMES_S[2:-2] + 0.0123
    truth = Slerp(TIMES_S, NED_FRD)(between_s).as_matrix()
    C_body_ned = matrix_from_quaternion(flight.attitude.at(between_s + start_s))
    assert np.rad2deg(Rotation.from_matrix(C_body_ned @ truth).magnitude().max()) < 0.001
    assert abs(flight.attitude.first_s - start_s) < 1e-3


@pytest.mark.parametrize("kind", ["bag", "db3", "mcap"])
def test_a_bag_of_each_kind_is_a_flight(tmp_path: Path, kind: str) -> None:
    path = written(tmp_path / ("flight.bag" if kind == "bag" else "flight"), kind)

    # Also the file inside the directory of a ROS 2 bag.
    for one in [path, *(path.glob(f"*.{kind}") if path.is_dir() else [])]:
        flight = open_flight(one)

        require_agreement(flight)
        assert flight.attitude_source == "/imu/data, 25.0 Hz"
        assert flight.position_source == "/fix"
        assert "by the clock of the computer" in flight.utc_source
        site = flight.position.at(START_NS * 1e-9 + 2)
        assert abs(np.rad2deg(site.latitude_rad) - (-34.93 + 2e-5)) * 111e3 < 1
        assert abs(site.height_m - 152) < 1


def test_info_and_export_take_the_directory_of_a_bag(tmp_path: Path) -> None:
    path = written(tmp_path / "flight", "mcap")

    shown = CliRunner().invoke(app, ["info", str(path)])
    exported = CliRunner().invoke(
        app, ["export", str(path), "-o", str(tmp_path / "out"), "--exposure", "0.5", "--frames", "1"]
    )

    assert shown.exit_code == 0, shown.output
    assert "ROS 2 bag" in shown.output
    assert "/imu/data" in shown.output
    assert exported.exit_code == 0, exported.output
    assert (tmp_path / "out" / "frame_000000.png").exists()


def test_ned_orientations_are_recognised_by_their_frame_or_by_the_option(tmp_path: Path) -> None:
    with Bag(tmp_path / "flight.bag", "bag") as bag:
        for k in range(TIMES_S.size):
            bag.imu(k, START_NS, NED_FRD, "imu_ned")
            bag.imu(k, START_NS, NED_FRD, "base", topic="/other")

    for attitude, columns in (("/imu/data", None), ("/other", "world=NED,body=FRD"), ("/other", "world=NED")):
        require_agreement(open_flight(tmp_path / "flight.bag", site=HOME, attitude=attitude, columns=columns))


def test_rates_are_turned_into_forward_right_down(tmp_path: Path) -> None:
    with open_source(written(tmp_path / "flight", "db3")) as source:
        (rates,) = [one for one in source.samples() if isinstance(one, RateSamples)]

    np.testing.assert_allclose(rates.rate_rad_per_s[0], [0.1, -0.2, -0.3], rtol=0, atol=1e-12)


def test_stamps_of_a_simulator_are_converted_by_time_reference(tmp_path: Path) -> None:
    offset_ns = START_NS - 5_000_000_000
    with Bag(tmp_path / "flight", "mcap") as bag:
        for k in range(TIMES_S.size):
            bag.imu(k, 5_000_000_000, ENU_FLU)
            bag.fix(k, 5_000_000_000)
            stamp_ns = 5_000_000_000 + round(TIMES_S[k] * 1e9)
            utc_ns = stamp_ns + offset_ns
            bag.write(
                "/time_reference", "sensor_msgs/msg/TimeReference", stamp_ns, header=bag.header(stamp_ns, ""),
                time_ref=bag.make("builtin_interfaces/msg/Time", sec=utc_ns // 10**9, nanosec=utc_ns % 10**9),
                source="gps",
            )  # fmt: skip

    flight = open_flight(tmp_path / "flight")

    require_agreement(flight)
    assert flight.utc_source == "/time_reference, 100 readings"


def test_stamps_of_a_simulator_without_utc_are_no_utc(tmp_path: Path) -> None:
    path = written(tmp_path / "flight", "mcap", start_ns=5_000_000_000)

    with pytest.raises(
        LogFormatError, match=r"the log has no UTC \(its stamps are no UTC, and it has no TimeReference\)"
    ):
        open_flight(path)

    require_agreement(open_flight(path, utc_start=START_NS * 1e-9))


def test_topics_can_be_chosen(tmp_path: Path) -> None:
    with Bag(tmp_path / "flight", "mcap") as bag:
        for k in range(TIMES_S.size):
            bag.imu(k, START_NS, ENU_FLU)
            bag.fix(k, START_NS)
            pose = bag.make(
                "geometry_msgs/msg/Pose",
                position=bag.make("geometry_msgs/msg/Point", x=0.0, y=0.0, z=0.0),
                orientation=bag.quaternion(0.0, 0.0, 0.0, 1.0),
            )
            stamp_ns = START_NS + round(TIMES_S[k] * 1e9)
            bag.write(
                "/odom", "nav_msgs/msg/Odometry", stamp_ns, header=bag.header(stamp_ns, "odom"), child_frame_id="base",
                pose=bag.make("geometry_msgs/msg/PoseWithCovariance", pose=pose, covariance=np.zeros(36)),
                twist=bag.make(
                    "geometry_msgs/msg/TwistWithCovariance",
                    twist=bag.make("geometry_msgs/msg/Twist", linear=bag.vector(0, 0, 0), angular=bag.vector(0, 0, 0)),
                    covariance=np.zeros(36),
                ),
            )  # fmt: skip
            bag.fix(k, START_NS, topic="/gps/other")

    flight = open_flight(tmp_path / "flight", attitude="/odom", columns="position=/gps/other")

    # Without rotation the nose points east.
    C_body_ned = matrix_from_quaternion(flight.attitude.at(np.array([START_NS * 1e-9 + 1])))[0]
    np.testing.assert_allclose(C_body_ned[0], [0, 1, 0], rtol=0, atol=1e-9)
    assert flight.position_source == "/gps/other"
    assert any("may be relative to the start" in note for note in flight.notes)
    with pytest.raises(LogFormatError, match=r"no attitude '/nope' \(--attitude\); it has /imu/data \(Imu\), /odom"):
        open_flight(tmp_path / "flight", attitude="/nope")
    with pytest.raises(LogFormatError, match=r"no position '/nope' \(--columns position=\); it has /fix, /gps/other"):
        open_flight(tmp_path / "flight", columns="position=/nope")
    with pytest.raises(ConfigError, match=r"'wrld=NED' says nothing about a bag \(did you mean world\?\)"):
        open_flight(tmp_path / "flight", columns="wrld=NED")


def test_an_imu_without_orientation_is_no_attitude(tmp_path: Path) -> None:
    with Bag(tmp_path / "flight", "mcap") as bag:
        for k in range(5):
            bag.fix(k, START_NS)

    with pytest.raises(LogFormatError, match=r"the bag has no attitude: .*it has sensor_msgs/NavSatFix"):
        open_flight(tmp_path / "flight")


@pytest.mark.parametrize("name", ["flight.bag", "flight.mcap", "flight.db3"])
def test_a_damaged_bag_is_refused_in_one_line(tmp_path: Path, name: str) -> None:
    kind = name.rpartition(".")[2]
    path = written(tmp_path / ("whole.bag" if kind == "bag" else "whole"), kind)
    whole = path if kind == "bag" else next(path.glob(f"*.{kind}"))
    (tmp_path / name).write_bytes(whole.read_bytes()[:3000])

    with pytest.raises(LogFormatError) as caught:
        open_flight(tmp_path / name)

    assert str(caught.value).startswith(f"{tmp_path / name}: cannot be read as a ROS bag: ")
    assert "\n" not in str(caught.value)
