"""ROS 1 and ROS 2 bags (``.bag``, a directory, ``.db3``, ``.mcap``), read by the rosbags library.

==========================================  ===========================================  ==============================
message                                     fields                                       used for
==========================================  ===========================================  ==============================
sensor_msgs/Imu                             orientation, angular_velocity                attitude, gyro rates
geographic_msgs/GeoPoseStamped              pose                                         attitude, position
geometry_msgs/PoseStamped, and with         pose.orientation                             attitude
covariance; QuaternionStamped
nav_msgs/Odometry                           pose.pose.orientation                        attitude
sensor_msgs/NavSatFix                       latitude, longitude, altitude, status        position
sensor_msgs/CameraInfo                      header.stamp                                 when the camera exposed
sensor_msgs/TimeReference                   header.stamp, time_ref                       UTC
==========================================  ===========================================  ==============================

Orientations turn the body (forward, left, up) into the world (east, north, up), as REP 103 and REP 145 say, unless the
options of the bag or a frame_id that contains "ned" say otherwise.  The clock is that of the header stamps.
"""

import os
from collections.abc import Callable, Collection, Iterator, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from os import PathLike
from pathlib import Path
from typing import Any, Literal, Self, get_args, get_type_hints

import numpy as np

from glstar.errors import ConfigError, LogFormatError
from glstar.system.userinput import did_you_mean
from glstar.telemetry import source
from glstar.telemetry.tables.mapped import q_body_ned_of

_MAGICS = (b"#ROSBAG", b"\x89MCAP0\r\n", b"SQLite format 3\x00")
_METADATA = "metadata.yaml"


def _pose_orientation(message: Any) -> Any:
    return message.pose.orientation


def _nested_orientation(message: Any) -> Any:
    return message.pose.pose.orientation


def _imu_orientation(message: Any) -> Any:
    """Return the orientation of an Imu; None without one, which it says by its covariance."""
    return None if message.orientation_covariance[0] == -1 else message.orientation


# Messages with attitude, in the order of choice, and how each gives its orientation.
_ATTITUDES: Mapping[str, Callable[[Any], Any]] = {
    "geographic_msgs/msg/GeoPoseStamped": _pose_orientation,
    "sensor_msgs/msg/Imu": _imu_orientation,
    "geometry_msgs/msg/PoseStamped": _pose_orientation,
    "geometry_msgs/msg/PoseWithCovarianceStamped": _nested_orientation,
    "geometry_msgs/msg/QuaternionStamped": lambda message: message.quaternion,
    "nav_msgs/msg/Odometry": _nested_orientation,
}
_IMU = "sensor_msgs/msg/Imu"
_FIX = "sensor_msgs/msg/NavSatFix"
_GEO = "geographic_msgs/msg/GeoPoseStamped"
_TIME = "sensor_msgs/msg/TimeReference"
_CAMERA = "sensor_msgs/msg/CameraInfo"
# Messages of local frames, whose azimuth may be relative to the start.
_RELATIVE = {"nav_msgs/msg/Odometry", "geometry_msgs/msg/PoseStamped"}


@dataclass(frozen=True, slots=True)
class BagOptions:
    """How the topics of a bag are read."""

    position: str = ""  # Topic with the position; by default the most frequent NavSatFix
    rates: str = ""  # Topic with the gyro rates; by default that of the attitude, or the most frequent Imu
    utc: str = ""  # Topic with TimeReference; by default the most frequent one
    # Axes that orientations refer to; "auto" is ENU, or NED if the frame_id contains "ned".
    world: Literal["auto", "ENU", "NED", "NWU"] = "auto"
    body: Literal["auto", "FLU", "FRD"] = "auto"  # Axes of the body; "auto" is FLU, or FRD with NED

    @classmethod
    def of(cls, text: str | None) -> Self:
        """Return the options that ``--columns`` gives, such as ``world=NED,body=FRD,position=/gps/fix``.

        Raises ConfigError if a key or a value is unknown.
        """
        values: dict[str, Any] = {}
        hints = get_type_hints(cls)
        for word in text.split(",") if text else ():
            key, _, value = word.partition("=")
            if key not in hints:
                raise ConfigError(f"columns: {word!r} says nothing about a bag{did_you_mean(key, list(hints))}")
            if (choices := get_args(hints[key])) and value not in choices:
                raise ConfigError(f"columns: {key} must be one of {', '.join(choices)}, not {value!r}")
            values[key] = value
        return cls(**values)


@dataclass(slots=True)
class _Topic:
    """The messages of a topic, as columns."""

    kind: str
    frame_id: str = ""
    stamps_s: list[float] = field(default_factory=list)
    orientations: list[tuple[float, float, float, float]] = field(default_factory=list)
    rates: list[tuple[float, float, float]] = field(default_factory=list)
    positions: list[tuple[float, float, float]] = field(default_factory=list)  # Latitude, longitude, deg; height, m
    utc_s: list[float] = field(default_factory=list)

    def add(self, message: Any, received_s: float) -> None:
        header = message.header
        stamp_s = header.stamp.sec + header.stamp.nanosec * 1e-9
        self.frame_id = self.frame_id or header.frame_id
        self.stamps_s.append(stamp_s or received_s)
        if self.kind in _ATTITUDES:
            q = _ATTITUDES[self.kind](message)
            self.orientations.append((np.nan,) * 4 if q is None else (q.w, q.x, q.y, q.z))
        if self.kind == _IMU:
            rate = message.angular_velocity
            has_rate = message.angular_velocity_covariance[0] != -1
            self.rates.append((rate.x, rate.y, rate.z) if has_rate else (np.nan,) * 3)
        if self.kind == _FIX:
            has_fix = message.status.status >= 0
            fix = (message.latitude, message.longitude, message.altitude)
            self.positions.append(fix if has_fix else (np.nan,) * 3)
        if self.kind == _GEO:
            position = message.pose.position
            self.positions.append((position.latitude, position.longitude, position.altitude))
        if self.kind == _TIME:
            self.utc_s.append(message.time_ref.sec + message.time_ref.nanosec * 1e-9)

    @property
    def short_kind(self) -> str:
        """The message without its package, for messages to the user."""
        return self.kind.split("/")[-1]

    @property
    def has_attitude(self) -> bool:
        return bool(source.unit_quaternions(np.array(self.orientations).reshape(-1, 4)).any())


class BagReader(source.TelemetrySource):
    """A ROS bag as a telemetry source; its clock is that of the header stamps.

    `path` is a ``.bag``, ``.mcap`` or ``.db3`` file, or the directory of a ROS 2 bag.  `attitude` is a topic, or
    ``"auto"`` for the most frequent one of the first kind in the table above.  `columns` are `BagOptions` as text.
    Raises LogFormatError if the bag cannot be read, or has no such topic.
    """

    one_clock = True

    def __init__(
        self,
        path: str | PathLike[str],
        *,
        attitude: str = "auto",
        boot: int | None = None,
        columns: str | None = None,
    ) -> None:
        self.name = os.fspath(path)
        self._attitude = attitude
        self._options = BagOptions.of(columns)
        source.check_only_boot(self.name, boot)
        self._format = "ROS bag"

    def samples(self) -> Iterator[source.Samples]:
        """Yield attitude, position, UTC and rates, a batch each.

        Raises LogFormatError if the bag has no attitude, or not the requested one.
        """
        name = self._attitude_topic()
        yield self._attitude_of(name)
        yield self._position()
        yield self._utc(name)
        if (rates := self._rates(name)) is not None:
            yield rates
        for info, topic in self._topics.items():
            if topic.kind == _CAMERA and topic.stamps_s:
                clock_s = np.array(topic.stamps_s)
                yield source.TriggerSamples(clock_s, np.full(clock_s.size, np.nan), info, camera=info)

    def attitudes(self) -> Iterator[tuple[str, source.AttitudeSamples]]:
        """Yield every topic with an attitude."""
        for name, topic in self._topics.items():
            if topic.has_attitude:
                yield name, self._attitude_of(name)

    def facts(self, boots: Collection[int] = ()) -> source.LogFacts:  # noqa: ARG002 - there is one boot
        """Return the format."""
        return source.LogFacts(self._format if self._topics is not None else "")

    def close(self) -> None:
        """Do nothing: the bag is only open while it is read."""

    @cached_property
    def _topics(self) -> dict[str, _Topic]:
        """The topics with messages of the table above, by name."""
        try:
            from rosbags.highlevel import AnyReader  # noqa: PLC0415 - an extra, when a bag is read
            from rosbags.typesys import Stores, get_typestore  # noqa: PLC0415 - the same
        except ImportError:
            raise LogFormatError(
                self.name, "is a ROS bag, which needs the rosbags library: pip install rosbags"
            ) from None
        kinds = {*_ATTITUDES, _FIX, _TIME, _CAMERA}
        topics: dict[str, _Topic] = {}
        try:
            with AnyReader([Path(self.name)], default_typestore=get_typestore(Stores.ROS2_HUMBLE)) as bag:
                self._format = "ROS 2 bag" if bag.is2 else "ROS 1 bag"
                if self.name.endswith(".mcap"):
                    self._format += " (MCAP)"
                connections = [connection for connection in bag.connections if connection.msgtype in kinds]
                for connection in connections:
                    topics.setdefault(connection.topic, _Topic(connection.msgtype))
                for connection, received_ns, raw in bag.messages(connections) if connections else ():
                    topics[connection.topic].add(bag.deserialize(raw, connection.msgtype), received_ns * 1e-9)
                self._kinds = sorted({connection.msgtype.replace("/msg/", "/") for connection in bag.connections})
        except LogFormatError:
            raise
        except Exception as error:  # of a damaged bag the library raises any exception
            reason = " ".join(str(error).split()) or type(error).__name__
            raise LogFormatError(self.name, f"cannot be read as a ROS bag: {reason}") from error
        return topics

    def _attitude_topic(self) -> str:
        """Return the topic with the attitude."""
        with_attitude = {name: topic for name, topic in self._topics.items() if topic.has_attitude}
        if self._attitude.lower() != "auto":
            if self._attitude not in with_attitude:
                listed = ", ".join(f"{name} ({topic.short_kind})" for name, topic in with_attitude.items())
                has = f"it has {listed or 'none'}"
                raise LogFormatError(self.name, f"the bag has no attitude {self._attitude!r} (--attitude); {has}")
            return self._attitude
        if not with_attitude:
            kinds = ", ".join(self._kinds[:8]) or "no messages"
            raise LogFormatError(self.name, f"the bag has no attitude: no Imu, Pose or Odometry; it has {kinds}")
        order = list(_ATTITUDES)
        rank = {name: (order.index(topic.kind), -len(topic.stamps_s)) for name, topic in with_attitude.items()}
        return min(rank, key=rank.__getitem__)

    def _frames(self, topic: _Topic) -> tuple[str, str]:
        """Return the axes of world and body of a topic."""
        says_ned = "ned" in topic.frame_id.lower()
        world: str = self._options.world
        if world == "auto":
            world = "NED" if says_ned else "ENU"
        body: str = self._options.body
        if body == "auto":
            body = "FRD" if world == "NED" else "FLU"
        return world, body

    def _attitude_of(self, name: str) -> source.AttitudeSamples:
        topic = self._topics[name]
        world, body = self._frames(topic)
        clock_s, q = np.array(topic.stamps_s), np.array(topic.orientations)
        norm = source.quaternion_lengths(q)
        valid = source.unit_quaternions(q) & source.valid_rare_times(clock_s)
        q_body_ned = q_body_ned_of(q[valid] / norm[valid, np.newaxis], world, body, "body_to_world")
        notes = [f"orientations of {name} are taken from {body} to {world} (--columns world=...,body=...)"]
        if topic.kind in _RELATIVE:
            frame = f"{topic.short_kind} in {topic.frame_id!r}"
            notes.append(f"{name} is {frame}: its azimuth may be relative to the start")
        segment = np.zeros(np.count_nonzero(valid), dtype=np.int64)
        return source.AttitudeSamples(clock_s[valid], q_body_ned, segment, name, notes=tuple(notes))

    def _chosen(self, option: str, requested: str, *kinds: str) -> str | None:
        """Return the requested topic, or the most frequent one, of the last kind that there is; None without any."""
        topics = {name: topic for name, topic in self._topics.items() if topic.kind in kinds and topic.stamps_s}
        if requested:
            if requested not in topics:
                has = f"it has {', '.join(topics) or 'none'}"
                raise LogFormatError(self.name, f"the bag has no {option} {requested!r} (--columns {option}=); {has}")
            return requested
        rank = {name: (topic.kind == kinds[-1], len(topic.stamps_s)) for name, topic in topics.items()}
        return max(rank, key=rank.__getitem__, default=None)

    def _position(self) -> source.PositionSamples:
        name = self._chosen("position", self._options.position, _GEO, _FIX)
        if name is None:
            return source.no_position_samples("it has no NavSatFix")
        topic = self._topics[name]
        latitude_deg, longitude_deg, height_m = np.array(topic.positions).T
        samples = source.position_samples(np.array(topic.stamps_s), latitude_deg, longitude_deg, height_m, name)
        return samples if samples.clock_s.size else source.no_position_samples(f"{name} never had a fix")

    def _utc(self, attitude: str) -> source.ClockSamples:
        """Return readings of UTC: TimeReference, otherwise the stamps themselves, if they are times of this century."""
        name = self._chosen("utc", self._options.utc, _TIME)
        if name is not None:
            topic = self._topics[name]
            clock_s, utc_s = np.array(topic.stamps_s), np.array(topic.utc_s)
            valid = source.plausible_utc(utc_s)
            if valid.any():
                return source.ClockSamples(clock_s[valid], utc_s[valid], f"{name}, {np.count_nonzero(valid)} readings")
        clock_s = np.array(self._topics[attitude].stamps_s)
        clock_s = clock_s[source.valid_rare_times(clock_s)]
        if clock_s.size and source.YEAR_2010_S <= float(np.median(clock_s)) < source.YEAR_2100_S:
            return source.ClockSamples(clock_s, clock_s, f"stamps of {attitude}, by the clock of the computer")
        return source.no_clock_samples("its stamps are no UTC, and it has no TimeReference")

    def _rates(self, attitude: str) -> source.RateSamples | None:
        requested = self._options.rates or (attitude if self._topics[attitude].kind == _IMU else "")
        name = self._chosen("rates", requested, _IMU)
        if name is None:
            return None
        topic = self._topics[name]
        clock_s, rate = np.array(topic.stamps_s), np.array(topic.rates)
        if self._frames(topic)[1] == "FLU":
            rate = rate * np.array([1.0, -1.0, -1.0])
        valid = source.valid_rare_times(clock_s) & source.valid_rates(rate)
        return source.RateSamples(clock_s[valid], rate[valid], name) if valid.any() else None


def is_bag(head: bytes) -> bool:
    """Return whether a file is a ROS bag, an MCAP recording, or the database of a ROS 2 bag, by its first bytes."""
    return head.startswith(_MAGICS)


def is_bag_directory(path: str | PathLike[str]) -> bool:
    """Return whether a directory is a ROS 2 bag."""
    return (Path(path) / _METADATA).is_file()
