"""Bags of any kind, written by the rosbags library."""

from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as Writer2
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from scipy.spatial.transform import Rotation

START_NS = 1710068400_250000000
TIMES_S = np.arange(100) * 0.04
YAW_DEG, PITCH_DEG, ROLL_DEG = 350 + 9 * TIMES_S, 4 * np.sin(TIMES_S), 20 * np.cos(TIMES_S)
NED_FRD = Rotation.from_euler("ZYX", np.column_stack([YAW_DEG, PITCH_DEG, ROLL_DEG]), degrees=True)
ENU_FLU = (
    Rotation.from_matrix(np.array([[0.0, 1, 0], [1, 0, 0], [0, 0, -1]]))
    * NED_FRD
    * Rotation.from_matrix(np.diag([1.0, -1, -1]))
)
NO = np.zeros(9)
NO_ORIENTATION = np.array([-1.0, *np.zeros(8)])

GEOGRAPHIC = {
    "geographic_msgs/msg/GeoPoint": "float64 latitude\nfloat64 longitude\nfloat64 altitude",
    "geographic_msgs/msg/GeoPose": "GeoPoint position\ngeometry_msgs/Quaternion orientation",
    "geographic_msgs/msg/GeoPoseStamped": "std_msgs/Header header\nGeoPose pose",
}
IMU, FIX, TIME = "sensor_msgs/msg/Imu", "sensor_msgs/msg/NavSatFix", "sensor_msgs/msg/TimeReference"
GEO, POSE, QUATERNION = (
    "geographic_msgs/msg/GeoPoseStamped",
    "geometry_msgs/msg/PoseStamped",
    "geometry_msgs/msg/QuaternionStamped",
)
POSE_COV, ODOMETRY = "geometry_msgs/msg/PoseWithCovarianceStamped", "nav_msgs/msg/Odometry"


@cache
def _store(distribution: Stores) -> Any:
    store = get_typestore(distribution)
    for name, definition in GEOGRAPHIC.items():
        store.register(get_types_from_msg(definition, name))
    return store


class Bag:
    """A bag of any kind, written message by message."""

    def __init__(self, path: Path, kind: str) -> None:
        self.is1 = kind == "bag"
        self.store = _store(Stores.ROS1_NOETIC if self.is1 else Stores.ROS2_HUMBLE)
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

    def oriented(
        self, kind: str, topic: str, stamp_ns: int, rotation: Rotation, frame_id: str = "map", *,
        rate: ArrayLike = (0.0, 0.0, 0.0), acceleration: ArrayLike = (0.0, 0.0, 0.0), covariance: Any = NO,
        place: tuple[float, float, float] = (0.0, 0.0, 0.0), late_ns: int = 0, quaternion: Any = None,
        child_frame_id: str = "base_link",
    ) -> None:  # fmt: skip
        """Write a message of any kind with an orientation; `place`: latitude, longitude, deg, and height, m."""
        header, q = self.header(stamp_ns, frame_id), self.quaternion(*rotation.as_quat())
        q = q if quaternion is None else self.quaternion(*quaternion)
        fields: dict[str, Any] = {"header": header}
        if kind == IMU:
            fields |= {"orientation": q, "orientation_covariance": covariance, "angular_velocity": self.vector(*rate)}
            fields |= {"angular_velocity_covariance": NO, "linear_acceleration": self.vector(*acceleration)}
            fields |= {"linear_acceleration_covariance": NO}
        elif kind == QUATERNION:
            fields["quaternion"] = q
        elif kind == GEO:
            point = dict(zip(("latitude", "longitude", "altitude"), place, strict=True))
            position = self.make("geographic_msgs/msg/GeoPoint", **point)
            fields["pose"] = self.make("geographic_msgs/msg/GeoPose", position=position, orientation=q)
        else:
            origin = self.make("geometry_msgs/msg/Point", x=0.0, y=0.0, z=0.0)
            pose = self.make("geometry_msgs/msg/Pose", position=origin, orientation=q)
            with_covariance = {"pose": pose, "covariance": np.zeros(36)}
            fields["pose"] = (
                pose if kind == POSE else self.make("geometry_msgs/msg/PoseWithCovariance", **with_covariance)
            )
        if kind == ODOMETRY:
            twist = self.make("geometry_msgs/msg/Twist", linear=self.vector(0, 0, 0), angular=self.vector(0, 0, 0))
            with_covariance = {"twist": twist, "covariance": np.zeros(36)}
            fields["twist"] = self.make("geometry_msgs/msg/TwistWithCovariance", **with_covariance)
            fields["child_frame_id"] = child_frame_id
        self.write(topic, kind, stamp_ns + late_ns, **fields)

    def imu(
        self, k: int, start_ns: int, rotation: Rotation, frame_id: str = "imu_link", topic: str = "/imu/data",
        up: float = 1.0,
    ) -> None:  # fmt: skip
        """Write a body that turns by `rotation` between body and world, whose third axis is up, or down with -1."""
        before, after = max(k - 1, 0), min(k + 1, TIMES_S.size - 1)
        turn = (rotation[before].inv() * rotation[after]).as_rotvec() / (TIMES_S[after] - TIMES_S[before])
        force = rotation[k].inv().apply([0, 0, 9.8 * up])
        stamp_ns = start_ns + round(TIMES_S[k] * 1e9)
        self.oriented(IMU, topic, stamp_ns, rotation[k], frame_id, rate=turn, acceleration=force, late_ns=3_000_000)

    def pose(self, k: int, start_ns: int, rotation: Rotation, frame_id: str, topic: str, kind: str = POSE) -> None:
        self.oriented(kind, topic, start_ns + round(TIMES_S[k] * 1e9), rotation[k], frame_id)

    def fix(self, k: int, start_ns: int, status: int = 0, topic: str = "/fix") -> None:
        place = (-34.93 + 1e-5 * TIMES_S[k], 138.6, 150.0 + TIMES_S[k])
        self.placed(topic, start_ns + round(TIMES_S[k] * 1e9), place, status)

    def placed(self, topic: str, stamp_ns: int, place: tuple[float, float, float], status: int = 0) -> None:
        """Write a NavSatFix; `place`: latitude, longitude, deg, and height, m."""
        self.write(
            topic, FIX, stamp_ns, header=self.header(stamp_ns, "gps"),
            status=self.make("sensor_msgs/msg/NavSatStatus", status=status, service=1),
            latitude=place[0], longitude=place[1], altitude=place[2], position_covariance=NO,
            position_covariance_type=0,
        )  # fmt: skip

    def time(
        self, topic: str, stamp_ns: int, utc_ns: int, origin: str = "gps", *, received_ns: int | None = None
    ) -> None:
        """Write a TimeReference."""
        header = self.header(stamp_ns, "")
        self.write(
            topic, TIME, stamp_ns if received_ns is None else received_ns, header=header, source=origin,
            time_ref=self.make("builtin_interfaces/msg/Time", sec=utc_ns // 10**9, nanosec=utc_ns % 10**9),
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


# Messages of PX4 1.14 and 1.16 without the fields that have no meaning for glstar; the bridge sends them as they are.
PX4 = {
    "px4_msgs/msg/VehicleAttitude": """
        uint32 MESSAGE_VERSION = 0
        uint64 timestamp
        uint64 timestamp_sample
        float32[4] q
        float32[4] delta_q_reset
        uint8 quat_reset_counter""",
    "px4_msgs/msg/VehicleOdometry": """
        uint64 timestamp
        uint64 timestamp_sample
        uint8 POSE_FRAME_NED = 1
        uint8 POSE_FRAME_FRD = 2
        uint8 pose_frame
        float32[3] position
        float32[4] q
        float32[3] angular_velocity
        uint8 reset_counter""",
    "px4_msgs/msg/VehicleGlobalPosition": """
        uint64 timestamp
        uint64 timestamp_sample
        float64 lat
        float64 lon
        float32 alt
        bool lat_lon_valid
        bool alt_valid""",
    "px4_msgs/msg/SensorGps": """
        uint64 timestamp
        uint64 timestamp_sample
        float64 latitude_deg
        float64 longitude_deg
        float64 altitude_msl_m
        uint8 fix_type
        int32 timestamp_time_relative
        uint64 time_utc_usec""",
    "px4_msgs/msg/SensorCombined": """
        uint64 timestamp
        float32[3] gyro_rad
        float32[3] accelerometer_m_s2""",
}


class Px4Bag(Bag):
    """A bag of PX4's topics, which have timestamps in microseconds and no headers."""

    def __init__(self, path: Path, kind: str) -> None:
        super().__init__(path, kind)
        self.store = get_typestore(Stores.ROS2_HUMBLE)
        for name, definition in PX4.items():
            self.store.register(get_types_from_msg(definition, name))

    def flight(self, boot_ns: int, *, attitude: str = "vehicle_attitude", utc: bool = True, node: str = "/fmu") -> None:
        """Write the flight with timestamps that begin at `boot_ns`, and the position and UTC of its receiver."""
        f32 = np.float32
        for k, t_s in enumerate(TIMES_S):
            received_ns = START_NS + round(t_s * 1e9) + 4_000_000
            us = (boot_ns + round(t_s * 1e9)) // 1000
            x, y, z, w = NED_FRD[k].as_quat()
            q = np.array([w, x, y, z], dtype=f32)
            own: dict[str, Any] = {"delta_q_reset": np.zeros(4, f32), "quat_reset_counter": int(k >= 60)}
            kind = "px4_msgs/msg/VehicleAttitude"
            if attitude != "vehicle_attitude":
                kind = "px4_msgs/msg/VehicleOdometry"
                own = {"pose_frame": 1, "position": np.zeros(3, f32), "angular_velocity": np.zeros(3, f32)}
                own |= {"reset_counter": 0}
            self.write(f"{node}/out/{attitude}", kind, received_ns, timestamp=us + 900, timestamp_sample=us, q=q, **own)
            before, after = NED_FRD[max(k - 1, 0)], NED_FRD[min(k + 1, TIMES_S.size - 1)]
            rate = (before.inv() * after).as_rotvec() / (TIMES_S[min(k + 1, TIMES_S.size - 1)] - TIMES_S[max(k - 1, 0)])
            self.write(
                f"{node}/out/sensor_combined", "px4_msgs/msg/SensorCombined", received_ns, timestamp=us,
                gyro_rad=rate.astype(f32), accelerometer_m_s2=np.zeros(3, f32),
            )  # fmt: skip
            if k % 5 == 0:
                place = {"lat": -34.93, "lon": 138.6, "alt": f32(150.0), "lat_lon_valid": k > 0, "alt_valid": True}
                topic = f"{node}/out/vehicle_global_position"
                times_us = {"timestamp": us, "timestamp_sample": us}
                self.write(topic, "px4_msgs/msg/VehicleGlobalPosition", received_ns, **times_us, **place)
                self.write(
                    f"{node}/out/vehicle_gps_position", "px4_msgs/msg/SensorGps", received_ns, timestamp=us,
                    timestamp_sample=us, latitude_deg=-34.93, longitude_deg=138.6, altitude_msl_m=150.0, fix_type=3,
                    timestamp_time_relative=-120_000,
                    time_utc_usec=(START_NS + round(t_s * 1e9)) // 1000 - 120_000 if utc else 0,
                )  # fmt: skip
