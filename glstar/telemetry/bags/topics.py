"""Topics of a bag: their messages as columns, what these measure, and what a topic is for by its name."""

import re
from array import array
from collections import Counter, defaultdict
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np

from glstar.arrays import Float, Mask
from glstar.rotation import slerp
from glstar.sky.place.timescale import GPS_EPOCH_S, TAI_MINUS_GPS_S, leap_seconds
from glstar.telemetry import source

IMU = "sensor_msgs/msg/Imu"
FIX = "sensor_msgs/msg/NavSatFix"
GEO = "geographic_msgs/msg/GeoPoseStamped"
TIME = "sensor_msgs/msg/TimeReference"
CAMERA = "sensor_msgs/msg/CameraInfo"
# Messages of PX4, which the bridge of uXRCE-DDS publishes: FRD to NED, microseconds since boot or by the host's UTC.
PX4_ATTITUDE, PX4_ODOMETRY = "px4_msgs/msg/VehicleAttitude", "px4_msgs/msg/VehicleOdometry"
PX4_GYROS, PX4_RATES = "px4_msgs/msg/SensorCombined", "px4_msgs/msg/VehicleAngularVelocity"
PX4_PLACE, PX4_GPS = "px4_msgs/msg/VehicleGlobalPosition", "px4_msgs/msg/SensorGps"
PX4_OLD_GPS = "px4_msgs/msg/VehicleGpsPosition"
PX4 = frozenset({PX4_ATTITUDE, PX4_ODOMETRY, PX4_GYROS, PX4_RATES, PX4_PLACE, PX4_GPS, PX4_OLD_GPS})
# VehicleOdometry: the world of its orientation, by its number.
_PX4_WORLDS = {1: "NED", 2: "FRD"}
_FIX_3D = 3
# An orientation with this variance about an axis is not known, rad^2: drivers write 1e6 and 99999.
_UNKNOWN_RAD2 = 10.0


def _pose_orientation(message: Any) -> Any:
    return message.pose.orientation


def _nested_orientation(message: Any) -> Any:
    return message.pose.pose.orientation


# Messages with attitude, in the order of choice, and how each gives its orientation.
ATTITUDES: Mapping[str, Callable[[Any], Any]] = {
    PX4_ATTITUDE: lambda message: message.q,
    GEO: _pose_orientation,
    IMU: lambda message: message.orientation,
    "geometry_msgs/msg/PoseStamped": _pose_orientation,
    "geometry_msgs/msg/PoseWithCovarianceStamped": _nested_orientation,
    "geometry_msgs/msg/QuaternionStamped": lambda message: message.quaternion,
    "nav_msgs/msg/Odometry": _nested_orientation,
    PX4_ODOMETRY: lambda message: message.q,
}
PLACES, TIMES = {GEO, FIX, PX4_PLACE, PX4_GPS, PX4_OLD_GPS}, {TIME, PX4_GPS, PX4_OLD_GPS}
RATES = {IMU, PX4_GYROS, PX4_RATES}
KINDS = frozenset({*ATTITUDES, *PLACES, *TIMES, *RATES, CAMERA})


# An orientation that turns less does not move: the rounding of float64, rad.
_STILL_RAD = 1e-6
# One that turns more moves, rad.
_TURNS_RAD = np.deg2rad(0.5)
# A sensor that stands still for this long, and for this part of the log, while the vehicle turns, is frozen.
_FROZEN_S, _FROZEN_PART = 1.0, 0.1
# Readings of UTC that scatter more about their median are of no use, s.
_UTC_SCATTER_S = 0.5
# Stamps of two topics that are received with delays that differ more are of two clocks, s.
_SAME_CLOCK_S = 5.0
# Words of frames that are the axes of a world or of a body.
WORLDS = ("NED", "ENU", "NWU")
_BODIES = ("FRD", "FLU")
# PX4 logs the age of its UTC, which is no age beyond this, s.
_LARGEST_AGE_S = 2.0
# Two attitudes of one body turn by the same angles between any two times, within this angle and this part of it.
_ALIKE_DEG, _ALIKE_PART = 2.0, 0.05
_COMPARED_TIMES = 60
# UTC by a receiver, and the clock of the recorder, differ by less than this unless they count another time scale, s.
_SAME_SCALE_S = 0.5
# The same for seconds since 1980 that are taken as seconds since 1970, s.
_SAME_EPOCH_S = 60.0
# Accelerometers of aircraft have ranges of up to 16 g; damaged numbers have any, m/s^2.
_LARGEST_M_PER_S2 = 1e4
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
    "resets": slice(16, 17),  # Number of resets of the estimator
}
_WIDTH = max(columns.stop for columns in _COLUMNS.values())


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
    undefined: bool = False  # Whether the bag has no definition of them
    _cells: "array[float]" = field(default_factory=lambda: array("d"))

    def add(self, message: Any, received_s: float) -> None:
        """Append a message that was recorded at `received_s`, UTC seconds of the recorder."""
        row = [np.nan] * _WIDTH
        row[0] = received_s
        if self.kind in PX4:
            self._add_px4(row, message)
        else:
            self._add_ros(row, message, received_s)
        self._cells.extend(row)

    def _add_ros(self, row: list[float], message: Any, received_s: float) -> None:
        """Complete the row of a message with a header."""
        header = message.header
        stamp_s = header.stamp.sec + header.stamp.nanosec * 1e-9
        row[:2] = received_s, stamp_s or received_s
        if self.kind in ATTITUDES:
            q = ATTITUDES[self.kind](message)
            row[_COLUMNS["orientation"]] = q.w, q.x, q.y, q.z
            self.child_frame_id = self.child_frame_id or getattr(message, "child_frame_id", "")
        if self.kind == IMU:
            self._add_gyros(row, message)
        elif self.kind == FIX and message.status.status >= 0:
            row[_COLUMNS["position"]] = message.latitude, message.longitude, message.altitude
        elif self.kind == GEO:
            at = message.pose.position
            row[_COLUMNS["position"]] = at.latitude, at.longitude, at.altitude
        elif self.kind == TIME:
            self.origin = self.origin or message.source
            row[_COLUMNS["utc_s"]] = [message.time_ref.sec + message.time_ref.nanosec * 1e-9]
        self.frame_id = self.frame_id or header.frame_id

    def _add_px4(self, row: list[float], message: Any) -> None:
        """Complete the row of a message of PX4, whose timestamps are microseconds; (w, x, y, z) is body to NED."""
        stamp_s = (getattr(message, "timestamp_sample", 0) or message.timestamp) * 1e-6
        if self.kind in ATTITUDES:
            row[_COLUMNS["orientation"]] = ATTITUDES[self.kind](message)
            counters = (getattr(message, name, 0.0) for name in ("quat_reset_counter", "reset_counter"))
            row[_COLUMNS["resets"]] = [float(sum(counters))]
            self.frame_id = self.frame_id or _PX4_WORLDS.get(getattr(message, "pose_frame", 1), "unknown")
        elif self.kind == PX4_GYROS:
            row[_COLUMNS["rate_rad_per_s"]] = message.gyro_rad
        elif self.kind == PX4_RATES:
            row[_COLUMNS["rate_rad_per_s"]] = message.xyz
        elif self.kind == PX4_PLACE:
            if getattr(message, "lat_lon_valid", True) and getattr(message, "alt_valid", True):
                row[_COLUMNS["position"]] = message.lat, message.lon, message.alt
        else:
            # The age of the UTC when it was logged, as in ULog.
            age_s = message.timestamp_time_relative * 1e-6
            stamp_s = message.timestamp * 1e-6 + (age_s if abs(age_s) <= _LARGEST_AGE_S else 0.0)
            if message.fix_type >= _FIX_3D:
                row[_COLUMNS["position"]] = (
                    (message.latitude_deg, message.longitude_deg, message.altitude_msl_m)
                    if hasattr(message, "latitude_deg")
                    else (message.lat * 1e-7, message.lon * 1e-7, message.alt * 1e-3)
                )
                row[_COLUMNS["utc_s"]] = [message.time_utc_usec * 1e-6]
        row[1] = stamp_s

    def _add_gyros(self, row: list[float], message: Any) -> None:
        """Complete the row of an Imu, which says by covariances what it does not measure."""
        variance = message.orientation_covariance[::4]
        self.unknown += max(variance) > _UNKNOWN_RAD2
        if variance[0] == -1:
            self.unmeasured += 1
            row[_COLUMNS["orientation"]] = [np.nan] * 4
        rate, acceleration = message.angular_velocity, message.linear_acceleration
        if message.angular_velocity_covariance[0] != -1:
            row[_COLUMNS["rate_rad_per_s"]] = rate.x, rate.y, rate.z
        if message.linear_acceleration_covariance[0] != -1:
            row[_COLUMNS["acceleration"]] = acceleration.x, acceleration.y, acceleration.z

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
        used = self.is_oriented & (np.abs(acceleration) < _LARGEST_M_PER_S2).all(axis=-1)
        if not used.any():
            return False
        (w, x, y, z), a = self.column("orientation")[used].T, acceleration[used]
        third = np.stack([2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)], axis=-1)
        length = float(np.linalg.norm(a, axis=-1).mean())
        return length > 0 and float((third * a).sum(axis=-1).mean()) < -_UPRIGHT * length

    @property
    def is_of_device(self) -> bool:
        """Whether its name says that it is of another sensor than the aircraft's attitude."""
        return has_word(DEVICE, f"{self.name} {self.frame_id}")

    @property
    def is_interface(self) -> bool:
        """Whether it is of the interface of an autopilot."""
        return self.kind == PX4_ATTITUDE or any(map(INTERFACE.fullmatch, self.name.split("/")))

    @property
    def authority(self) -> int:
        """How surely its attitude is measured: 2 by an autopilot, 1 by an Imu, 0 unknown."""
        return 2 if self.is_interface else int(self.kind == IMU)

    def axes(self, world: str, body: str) -> tuple[str, str]:
        """Return the axes of world and body; "auto" is what the topic says."""
        frames = {word.upper() for word in words_of(self.frame_id)} if self.kind != IMU else set()
        own = {word.upper() for word in words_of(self.child_frame_id)}
        if world == "auto" and self.kind in PX4:
            world = "NED"
        elif world == "auto":
            world = next((axes for axes in WORLDS if axes in frames), "NED" if self.is_up_down else "ENU")
        if body == "auto":
            body = next((axes for axes in _BODIES if axes in own), "FRD" if world == "NED" else "FLU")
        return world, body

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
        rate = rate[source.valid_rates(rate)]
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

    def turns_otherwise(self, other: "Topic") -> float:
        """Return by how much the angles between times differ from another attitude's angles, deg; 0 if they are alike.

        Angles between two times are the same for two sensors of one body, whatever their axes and their worlds.
        """
        tracks = [
            (times_s[topic.is_oriented], topic.column("orientation")[topic.is_oriented])
            for times_s, topic in ((self.clock_s(other), self), (other.column("stamp_s"), other))
        ]
        first_s, last_s = max(times_s.min() for times_s, _ in tracks), min(times_s.max() for times_s, _ in tracks)
        if not first_s < last_s:
            return 0.0
        at_s = np.linspace(first_s, last_s, _COMPARED_TIMES)
        one, another = (np.rad2deg(_angles_between(_interpolated(times_s, q, at_s))) for times_s, q in tracks)
        differs_deg = float(np.median(np.abs(one - another)))
        is_alike = differs_deg <= _ALIKE_DEG + _ALIKE_PART * float(np.median(np.concatenate([one, another])))
        return 0.0 if is_alike else differs_deg

    def positions(self, attitude: "Topic") -> source.PositionSamples:
        """Return the valid positions of a NavSatFix or a GeoPose, by the clock of an attitude."""
        latitude_deg, longitude_deg, height_m = self.column("position").T
        return source.position_samples(self.clock_s(attitude), latitude_deg, longitude_deg, height_m, self.name)

    def utc_readings(self, attitude: "Topic") -> tuple[Float, Float]:
        """Return the clock of an attitude and UTC by a TimeReference, (n,) s each; empty if it does not count UTC."""
        clock_s, utc_s = self.clock_s(attitude), self.column("utc_s")
        valid = source.plausible_utc(utc_s) & source.valid_rare_times(clock_s)
        clock_s, utc_s = clock_s[valid], utc_s[valid]
        if not utc_s.size:
            return clock_s, utc_s
        off_s = utc_s - clock_s
        near = np.abs(off_s - np.median(off_s)) < _UTC_SCATTER_S
        advances = utc_s.size == 1 or np.ptp(utc_s) > 0 or np.ptp(clock_s) == 0
        good = near if advances and np.count_nonzero(near) > utc_s.size / 2 else np.zeros_like(near)
        return clock_s[good], utc_s[good]

    @cached_property
    def late_s(self) -> float:
        """Median time from the stamps of the headers to reception, s: large if they are of another clock."""
        return float(np.median(self.column("received_s") - self.column("stamp_s")))

    @cached_property
    def scale_of_stamps(self) -> tuple[float, str]:
        """What turns the stamps into UTC, s, and the time scale that they count; see `utc_of_scale`."""
        return utc_of_scale(-self.late_s, float(np.median(self.column("received_s"))))

    def clock_s(self, other: "Topic") -> Float:
        """Return the stamps of the headers by the clock of another topic, (n,) s: by reception if they have another."""
        return self.column("received_s") - other.late_s if self.is_other_clock(other) else self.column("stamp_s")

    def is_other_clock(self, other: "Topic") -> bool:
        """Return whether the stamps are of another clock than another topic's stamps."""
        return abs(self.late_s - other.late_s) > _SAME_CLOCK_S

    @property
    def short_kind(self) -> str:
        """The message without its package, for messages to the user."""
        return self.kind.rpartition("/")[2]


def utc_of_scale(off_s: float, recorder_s: float) -> tuple[float, str]:
    """Return what turns a time into UTC, s, and the time scale that it counts.

    `off_s`: the time minus the recorder's time, s; `recorder_s`: the latter, UTC seconds since 1970.
    """
    if source.YEAR_2010_S <= recorder_s < source.YEAR_2100_S:
        gps_s = leap_seconds(recorder_s + TAI_MINUS_GPS_S)
        for name, ahead_s, within_s in (
            ("GPS time", gps_s, _SAME_SCALE_S),
            ("TAI", gps_s + TAI_MINUS_GPS_S, _SAME_SCALE_S),
            ("GPS time since 1980", gps_s - GPS_EPOCH_S, _SAME_EPOCH_S),
        ):
            if abs(off_s - ahead_s) < within_s:
                return -ahead_s, name
    return 0.0, ""


def _interpolated(times_s: Float, q: Float, at_s: Float) -> Float:
    """Return (n, 4) orientations between samples at other times, (m,) s."""
    times_s, first = np.unique(times_s, return_index=True)
    after = np.clip(np.searchsorted(times_s, at_s), 1, times_s.size - 1)
    part = (at_s - times_s[after - 1]) / (times_s[after] - times_s[after - 1])
    q = q[first] / source.quaternion_lengths(q[first])[:, np.newaxis]
    return slerp(q[after - 1], q[after], part)


def _angles_between(q: Float) -> Float:
    """Return the angles between all pairs of (m, 4) orientations, rad."""
    one, other = np.triu_indices(len(q), 1)
    return _angles_rad(q[one], q[other])


def _angles_rad(q1: Float, q2: Float) -> Float:
    """Return the angles between unit quaternions, (n, 4), rad."""
    chord = np.minimum(np.linalg.norm(q1 - q2, axis=-1), np.linalg.norm(q1 + q2, axis=-1))
    return np.asarray(4 * np.arcsin(np.minimum(chord / 2, 1.0)))


# Regular expressions of many words are compiled when they are first used, which takes 30 ms.

# Words of topics that say where a vehicle should be, or where something else is; the longer ones also within a word.
_PLANNED = (
    r".*(setpoint|waypoint|goal|target|desired|command|reference|planned).*|cmd|sp|ref|plans?|planner|trajectory|path"
    r"|mission|home|origin|offset|initial|initialpose|clicked|teleop|joy|markers?|tags?|aruco|apriltags?|landing|takeoff"
    r"|predict(ed|ion)|station|beacon|dock|des|demand(ed)?|nominal|wanted|intended|wps?|traj|tgt|setpt|carrot|lookahead"
    r"|rally|next|traffic|intruder|adsb|obstacles?|detect(ed|ions?)?|objects?|person|people|pad|gcs"
    r"|requests?|requested|hover|hold|rtl|rth|roi|poi|look_?at|lookat|launch|fence|geofence|virtual"
)
_GIMBAL = "gimbal|mount|turret|ptu|pantilt"
# Topics below mavros that are sent to the autopilot: estimates of other programs, and simulated sensors.
_MAVROS_INPUT = re.compile("vision|vision_pose|vision_speed|mocap|fake_gps|hil|hil_.*|gps_input|gps_rtk")
# Nodes that are the interface of an autopilot.
INTERFACE = re.compile("mavros|fmu|ap|dji_sdk|dji_osdk_ros|psdk_ros2|autopilot|fcu")
# Words of sensors other than that of the aircraft's attitude.
DEVICE = (
    "cam|camera|realsense|d4[0-9]*i?|t265|l515|zed.?|oakd?|stereo|depth|infra|lidar|laser|livox|avia|ouster|os.?|velodyne"
    "|hesai|rslidar|radar|leica|phone|event|dvs|sonar|uwb"
)
# Words of parts of a vehicle: as the first part of a topic, none of them is a vehicle.
PART = (
    f"{DEVICE}|imus?|ahrs|ins|gps|gnss|rtk|navsat|navsatfix|fix|mag|compass|baro|sensors?|devices?|platform|nav"
    "|navigation|localization|odom|odometry|ekf|ukf|filter|filtered|raw|state|estimator|fusion|slam|vio|lio|tf|left|right"
    "|front|rear|back|top|bottom|up|down|primary|secondary|main|backup|aux|antenna|receiver|rover|base|port|channel|lane"
    "|instance|vectornav|vn|xsens|mti|microstrain|gx|sbg|ellipse|novatel|ublox|septentrio|applanix|oxts|lord|adis|bno|mpu"
    "|phidgets|pixhawk|trimble|piksi|emlid|vicon|optitrack|mocap|vrpn|qualisys|ground|truth|sim|gazebo|topic|data"
)
# A part of a topic that is a vehicle by its name: uav, drone_1, leader.
OF_GPS = "gps|gnss|pps|utc|mavros|fcu|ublox"
_VEHICLE = (
    r"(uav|uas|drone|robot|quad|quadrotor|quadcopter|copter|multirotor|hexacopter|octocopter|vtol|plane|aircraft"
    r"|vehicle|agent|ugv|usv|uuv|boat|leader|follower|wingman|alpha|bravo|charlie|delta|mav|px4)([_-]?\d+|[_-][a-z])?"
)
# Name of the vehicle whose topics have no name space, beside others that have one.
UNNAMED = "unnamed"
_NUMBERED = re.compile(r"(.*?)(?:[_-]?\d+|[_-][a-z])")
_WORD = re.compile(r"[A-Z]+(?![a-z])|[A-Z]?[a-z]+|\d+")


def words_of(name: str) -> list[str]:
    """Return the words of a topic or a frame, in lower case: ``local_NED``, ``baseLink``."""
    return [word.lower() for word in _WORD.findall(name)]


def has_word(words: str, name: str) -> bool:
    """Return whether a topic or a frame has one of some words, a regular expression."""
    return any(map(re.compile(words).fullmatch, {*words_of(name), *re.split("[^a-z0-9]+", name.lower())}))


def purpose_of(name: str) -> str:
    """Return what a topic is for if it is not what the vehicle measures, by its name; otherwise empty."""
    parts = [*name.strip("/").split("/"), "", ""]
    if has_word(_PLANNED, name):
        return "by its name where something should be or another thing is, not a measurement"
    if has_word(_GIMBAL, name):
        return "by its name of a gimbal"
    for node, part, last in zip(parts, parts[1:], parts[2:], strict=False):
        is_input = _MAVROS_INPUT.fullmatch(part) or (part, last) == ("odometry", "out")
        if (node == "mavros" and is_input) or (node == "fmu" and part == "in"):
            return "sent to the autopilot by another program"
    return ""


def are_of_two_bodies(first: str, second: str) -> bool:
    """Return whether two topics are below different names, and neither name is a part of a vehicle."""
    above = [
        [part for part in name.strip("/").split("/")[:-1] if not has_word(PART, part) and not INTERFACE.fullmatch(part)]
        for name in (first, second)
    ]
    return all(above) and above[0][0] != above[1][0]


def vehicles_of(kinds: Mapping[str, str]) -> dict[str, str]:
    """Return the vehicle of each topic, empty if it belongs to none, by the kinds of topics with these names.

    A part of a topic is a vehicle if it is called so (``drone_1``), if it is above the interface of an autopilot
    (``/alpha/mavros``), or if it is numbered (``/r1``, ``/r2``).  It is one too if another part has two equal topics
    below (``/red/odom`` and ``/red/fix``, as ``/blue`` has).  With a single vehicle, all topics are its own.
    """
    parts = {name: name.strip("/").split("/") for name in kinds}
    numbered: defaultdict[tuple[str, ...], set[str]] = defaultdict(set)
    alike: defaultdict[tuple[str, ...], set[str]] = defaultdict(set)
    found: set[str] = set()
    for name, path in parts.items():
        for depth, part in enumerate(path[:-1]):
            if INTERFACE.fullmatch(part):
                break
            if has_word(PART, part):
                continue
            if re.fullmatch(_VEHICLE, part.lower()) or INTERFACE.fullmatch(path[depth + 1]):
                found.add(part)
            stem = _NUMBERED.fullmatch(part.lower())
            if stem is not None and (stem[1] or not depth or not has_word(PART, path[depth - 1])):
                numbered[(*path[:depth], stem[1])].add(part)
            if not purpose_of(name):
                alike[(*path[:depth], "", kinds[name], *path[depth + 1 :])].add(part)
    for group in numbered.values():
        found |= group if len(group) > 1 else set()
    times = Counter(part for group in alike.values() if len(group) > 1 for part in group)
    found |= {part for part, count in times.items() if count > 1}
    # Beside a vehicle, another first part that is no part of one is a vehicle too: /uav1/imu, /husky/fix.
    for name, path in parts.items() if found else ():
        is_flight = kinds[name] in {*ATTITUDES, FIX} and not purpose_of(name)
        if is_flight and len(path) > 1 and not found & {*path} and not has_word(PART, path[0]):
            found |= {path[0]} - {part for part in path if INTERFACE.fullmatch(part)}
    vehicles = {name: "/".join(part for part in path[:-1] if part in found) for name, path in parts.items()}
    # An autopilot without a name space beside others with one: the first of several simulated ones.
    is_unnamed = any(INTERFACE.fullmatch(path[0]) for path in parts.values())
    if is_unnamed and any(vehicles.values()):
        vehicles = {name: vehicle or UNNAMED for name, vehicle in vehicles.items()}
    return vehicles if len(set(vehicles.values()) - {""}) > 1 else dict.fromkeys(kinds, "")
