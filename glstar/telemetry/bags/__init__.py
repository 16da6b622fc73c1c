"""ROS 1 and ROS 2 bags (``.bag``, a directory, ``.db3``, ``.mcap``), read by the rosbags library.

==========================================  ===========================================  ==============================
message                                     fields                                       used for
==========================================  ===========================================  ==============================
px4_msgs/VehicleAttitude, VehicleOdometry   q (FRD to NED)                               attitude
sensor_msgs/Imu                             orientation, angular_velocity                attitude, gyro rates
geographic_msgs/GeoPoseStamped              pose                                         attitude, position
geometry_msgs/PoseStamped, and with         pose.orientation                             attitude
covariance; QuaternionStamped
nav_msgs/Odometry                           pose.pose.orientation                        attitude
sensor_msgs/NavSatFix                       latitude, longitude, altitude, status        position
px4_msgs/VehicleGlobalPosition              lat, lon, alt                                position
px4_msgs/SensorGps                          latitude_deg, ..., time_utc_usec             position, UTC
px4_msgs/SensorCombined                     gyro_rad                                     gyro rates
sensor_msgs/CameraInfo                      header.stamp                                 when the camera exposed
sensor_msgs/TimeReference                   header.stamp, time_ref                       UTC
==========================================  ===========================================  ==============================

Orientations turn the body (forward, left, up) into the world (east, north, up), as REP 103 and REP 145 say.  The
options of the bag, a word in the frame of a pose ("map_ned") and the accelerometers of an Imu may say otherwise: the
frame_id of an Imu is the sensor's.  The clock is that of the header stamps.  A time that is ahead of the recorder's
clock by the leap seconds of GPS time or TAI counts that scale, and is converted.

Topics of setpoints, of estimates that are sent to the autopilot and of gimbals, and an Imu that does not estimate its
orientation are used only if the user names them.  The first part of a topic is a vehicle where another topic's first
part is like it (``/uav1``, ``/uav2``); a flight has topics of one vehicle.  Attitudes that do not turn alike are not of
one body: the autopilot's or an Imu's is used beside poses, and otherwise the user must name one.
"""

import os
from collections import Counter
from collections.abc import Collection, Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import takewhile
from os import PathLike
from typing import Any, Literal, Self, get_args, get_type_hints

import numpy as np

from glstar.arrays import Float
from glstar.errors import ConfigError, LogFormatError
from glstar.flight.gyroaided import GyroAlignment
from glstar.sky.place.timescale import format_utc
from glstar.system.userinput import did_you_mean
from glstar.telemetry import source
from glstar.telemetry.bags.storage import MAGICS, Bag, is_bag_directory, read_bag
from glstar.telemetry.bags.topics import (
    ATTITUDES,
    CAMERA,
    DEVICE,
    FIX,
    IMU,
    OF_GPS,
    PLACES,
    PX4,
    PX4_ODOMETRY,
    RATES,
    TIMES,
    WORLDS,
    Topic,
    are_of_two_bodies,
    has_word,
    purpose_of,
    utc_of_scale,
    vehicles_of,
    words_of,
)
from glstar.telemetry.tables.mapped import q_body_ned_of

__all__ = ["BagOptions", "BagReader", "is_bag", "is_bag_directory"]

# Messages of local frames, whose azimuth may be relative to the start.
_RELATIVE = {
    "nav_msgs/msg/Odometry",
    "geometry_msgs/msg/PoseStamped",
    "geometry_msgs/msg/PoseWithCovarianceStamped",
}

# Frames that are no world of an aircraft: an object as a sensor sees it, and the axes of the Earth.
_NO_WORLD = {"camera", "cam", "optical", "lidar", "ecef", "earth"}

# Two TimeReferences that differ more are reported, s.
_UTC_DIFFERENCE_S = 0.2
# A clock that is behind another one by more was never set, s.
_NEVER_SET_S = 86400.0
# Two positions of one flight are closer, deg.
_SAME_PLACE_DEG = 0.02


@dataclass(frozen=True, slots=True)
class BagOptions:
    """How the topics of a bag are read."""

    position: str = ""  # Topic with the position; by default the NavSatFix nearest to the attitude by its name
    rates: str = ""  # Topic with the gyro rates; by default those that turn as the attitude does
    utc: str = ""  # Topic with TimeReference; by default the one that counts UTC
    # Axes that orientations refer to; "auto" is ENU, unless a word of the frame or the accelerometers say otherwise.
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


class BagReader(source.TelemetrySource):
    """A ROS bag as a telemetry source; its clock is that of the header stamps.

    `path` is a bag of ROS 1 or ROS 2, an MCAP recording, or the directory of a ROS 2 bag.  `attitude` is a topic, or
    ``"auto"`` for the first one of the kinds in the table above that is valid and moves.  `columns` are `BagOptions` as
    text; `vehicle` is the name space of one of several vehicles.  Raises LogFormatError if the bag cannot be read, or
    has no such topic.
    """

    one_clock = True

    def __init__(
        self,
        path: str | PathLike[str],
        *,
        attitude: str = "auto",
        boot: int | None = None,
        columns: str | None = None,
        vehicle: str | None = None,
    ) -> None:
        self.name = os.fspath(path)
        self._attitude = "" if attitude.lower() == "auto" else attitude
        self._options = BagOptions.of(columns)
        self._requested = None if vehicle is None else vehicle.strip("/")
        self._unlike: list[str] = []
        source.check_only_boot(self.name, boot)

    def samples(self) -> Iterator[source.Samples]:
        """Yield attitude, position, UTC, rates and triggers of one vehicle.

        Raises LogFormatError if the bag has no attitude, or not the requested one.
        """
        topic = self._attitude_topic
        attitude = self._attitude_of(topic)
        position, utc = self._position(topic), self._utc(topic)
        rates, about_rates = self._rates(topic, attitude)
        notes = (*attitude.notes, *self._notes(topic), *about_rates, *self._utc_notes(topic), *self._bag.notes)
        notes += () if self._options.position else _doubts_of_position(topic.name, position.source)
        yield replace(attitude, notes=notes)
        yield position
        yield utc
        if rates is not None:
            yield rates
        for info in self._of_vehicle({CAMERA}):
            clock_s = info.clock_s(topic)
            yield source.TriggerSamples(clock_s, np.full(clock_s.size, np.nan), info.name, camera=info.name)

    def attitudes(self) -> Iterator[tuple[str, source.AttitudeSamples]]:
        """Yield every topic with an attitude."""
        for topic in self._with_attitude:
            yield topic.name, self._attitude_of(topic)

    def facts(self, boots: Collection[int] = ()) -> source.LogFacts:  # noqa: ARG002 - there is one boot
        """Return the format."""
        return source.LogFacts(self._bag.format, unread_bytes=self._bag.unread_bytes)

    def close(self) -> None:
        """Do nothing: the bag is only open while it is read."""

    @cached_property
    def _bag(self) -> Bag:
        return read_bag(self.name)

    @cached_property
    def _topics(self) -> dict[str, Topic]:
        return {name: topic for name, topic in self._bag.topics.items() if len(topic)}

    @cached_property
    def _with_attitude(self) -> list[Topic]:
        """The topics with valid orientations."""
        return [t for t in self._topics.values() if t.kind in ATTITUDES and t.is_oriented.any()]

    @cached_property
    def _vehicles(self) -> dict[str, str]:
        """The vehicle of each topic, by its name; empty for topics of none or of all."""
        return vehicles_of({name: topic.kind for name, topic in self._topics.items()})

    @cached_property
    def _vehicle(self) -> str:
        """The vehicle of the flight; empty if the bag has a single one."""
        names = sorted(set(self._vehicles.values()) - {""})
        if self._requested is not None:
            if self._requested not in names:
                has = ", ".join(names) or "one vehicle, without a name"
                raise LogFormatError(self.name, f"the bag has no vehicle {self._requested!r} (--vehicle); it has {has}")
            return self._requested
        if self._attitude in self._topics:
            return self._vehicles[self._attitude]
        fixes = [t for t in self._topics.values() if t.kind in PLACES and not purpose_of(t.name)]
        with_fix = {self._vehicles[t.name] for t in fixes if t.positions(t).clock_s.size}
        samples = Counter[str]()
        for topic in self._with_attitude:
            samples[self._vehicles[topic.name]] += 0 if self._doubt(topic) else len(topic)
        usable = sorted(name for name, count in samples.items() if count)
        return max(usable, key=lambda name: (name in with_fix, name in names, samples[name]), default="")

    def _of_vehicle(self, kinds: Collection[str]) -> list[Topic]:
        """Return the topics of some kinds of the vehicle of the flight or, if it has none, the topics of no vehicle."""
        of_kind = [topic for topic in self._topics.values() if topic.kind in kinds]
        own = [topic for topic in of_kind if self._vehicles[topic.name] == self._vehicle]
        is_shared = all(not self._vehicles[topic.name] for topic in of_kind)
        return own or (of_kind if is_shared else [])

    @cached_property
    def _attitude_topic(self) -> Topic:
        """The topic with the attitude."""
        with_attitude = {topic.name: topic for topic in self._with_attitude}
        if self._attitude:
            if self._attitude not in with_attitude:
                listed = ", ".join(f"{name} ({topic.short_kind})" for name, topic in with_attitude.items())
                has = f"it has {listed or 'none'}"
                raise LogFormatError(self.name, f"the bag has no attitude {self._attitude!r} (--attitude); {has}")
            topic = with_attitude[self._attitude]
            if self._requested is not None and self._vehicles[topic.name] != self._vehicle:
                raise LogFormatError(self.name, f"{topic.name} (--attitude) is not of {self._vehicle} (--vehicle)")
            return topic
        usable = [topic for topic in self._of_vehicle(ATTITUDES) if not self._doubt(topic)]
        if not usable:
            raise LogFormatError(self.name, self._no_attitude())
        order = list(ATTITUDES)
        ranked = sorted(
            usable,
            key=lambda topic: (
                topic.is_of_device,
                topic.authority == 0,
                order.index(topic.kind),
                not topic.is_interface,
                -np.count_nonzero(topic.is_oriented),
            ),
        )
        return self._of_one_body(ranked)

    def _of_one_body(self, ranked: list[Topic]) -> Topic:
        """Return the first of some attitudes, or another one that gyros confirm.

        Raises LogFormatError if others do not turn as it does, and nothing says which is the aircraft's.
        """
        best, unlike = ranked[0], _unlike(ranked[0], ranked)
        if rivals := [topic for topic in unlike if topic.authority >= best.authority]:
            confirmed = [topic for topic in (best, *rivals) if self._rates(topic, self._attitude_of(topic))[0]]
            if best.authority or len(confirmed) != 1:
                differ_deg = rivals[0].turns_otherwise(best)
                differ = f"the angles that {best.name} and {rivals[0].name} turn by differ by {differ_deg:.0f} deg"
                remedy = "they are not of one body, and nothing says which is the aircraft; name one with --attitude"
                raise LogFormatError(self.name, f"{differ}: {remedy}")
            best, unlike = confirmed[0], _unlike(confirmed[0], ranked)
        self._unlike = [topic.name for topic in unlike]
        return best

    def _no_attitude(self) -> str:
        """Return why the bag has no attitude, for messages."""
        doubts = [f"{t.name} ({t.short_kind}): {self._doubt(t)}" for t in self._of_vehicle(ATTITUDES)]
        if doubts:
            named = " (--attitude takes it nevertheless)" if self._with_attitude else ""
            return f"the bag has no attitude that can be used: {'; '.join(doubts[:4])}{named}"
        if undefined := [topic for topic in self._bag.topics.values() if topic.undefined]:
            named = ", ".join(f"{topic.name} ({topic.kind.replace('/msg/', '/')})" for topic in undefined[:4])
            lacks = f"the bag has no definitions of the messages of {named}, which older recorders left out"
            return f"{lacks}; convert it to MCAP where their package is installed: ros2 bag convert"
        kinds = ", ".join(sorted(kind.replace("/msg/", "/") for kind in self._bag.kinds if kind)[:8]) or "no messages"
        return f"the bag has no attitude: no Imu, Pose or Odometry; it has {kinds}"

    @cached_property
    def _doubts(self) -> dict[str, str]:
        return {topic.name: self._doubt_of(topic) for topic in self._topics.values() if topic.kind in ATTITUDES}

    def _doubt(self, topic: Topic) -> str:
        """Return why an attitude is not used unless it is named; empty if it is good."""
        return self._doubts[topic.name]

    def _doubt_of(self, topic: Topic) -> str:
        if not topic.is_oriented.any():
            return (
                "its covariance says that it has no orientation" if topic.unmeasured else "it has no unit quaternions"
            )
        if topic.unknown > len(topic) / 2:
            return "its covariance says that its orientation is not known"
        if purpose := purpose_of(topic.name):
            return purpose
        frame = {*words_of(topic.frame_id)}
        foreign = frame & ({"optical"} if topic.kind == IMU else _NO_WORLD)
        if foreign and not frame & {axes.lower() for axes in WORLDS}:
            owner = "the Earth" if foreign <= {"ecef", "earth"} else "a sensor"
            return f"its frame {topic.frame_id!r} is that of {owner}"
        if _NO_WORLD & {*words_of(topic.child_frame_id)}:
            return f"its body {topic.child_frame_id!r} is a sensor"
        others = [
            other
            for other in self._topics.values()
            if other is not topic and other.kind in ATTITUDES and not purpose_of(other.name)
            if self._vehicles[other.name] == self._vehicles[topic.name]
        ]
        return topic.frozen_beside(others)

    def _notes(self, chosen: Topic) -> list[str]:
        """Return remarks on what was passed over."""
        notes = []
        vehicles = sorted(set(self._vehicles.values()) - {""})
        if vehicles:
            notes.append(
                f"the bag holds {len(vehicles)} vehicles ({', '.join(vehicles)}); this flight is"
                f" {self._vehicle or 'of none of them'} (--vehicle takes another one)"
            )
        others = [topic for topic in self._of_vehicle(ATTITUDES) if topic is not chosen]
        if passed := [f"{topic.name} ({self._doubt(topic)})" for topic in others if self._doubt(topic)]:
            notes.append(f"passed over: {', '.join(passed)}")
        if doubt := self._doubt(chosen):
            notes.append(f"{chosen.name} is used because it is named: {doubt}")
        if self._unlike:
            notes.append(
                f"passed over: {', '.join(self._unlike)}, which do not turn as {chosen.name} does (--attitude)"
            )
        others = [topic for topic in self._of_vehicle({*PLACES, *TIMES, CAMERA}) if topic.is_other_clock(chosen)]
        if others:
            named = ", ".join(f"{topic.name} ({topic.late_s - chosen.late_s:.0f} s)" for topic in others)
            notes.append(
                f"stamps of another clock than that of {chosen.name} are replaced by times of reception: {named}"
            )
        return notes

    def _attitude_of(self, topic: Topic) -> source.AttitudeSamples:
        world, body = topic.axes(self._options.world, self._options.body)
        clock_s, q = topic.column("stamp_s"), topic.column("orientation")
        valid = topic.is_oriented & source.valid_rare_times(clock_s)
        q_body_ned = q_body_ned_of(
            q[valid] / source.quaternion_lengths(q[valid])[:, np.newaxis], world, body, "body_to_world"
        )
        notes = [f"orientations of {topic.name} are taken from {body} to {world} (--columns world=...,body=...)"]
        if topic.kind == IMU and world == "NED" and self._options.world == "auto":
            notes[0] = f"{notes[0]}: its accelerometers find up opposite to the third axis of its world"
        elif topic.kind == IMU and "ned" in words_of(topic.frame_id) and self._options.world == "auto":
            notes[0] = f"{notes[0]}: the frame {topic.frame_id!r} is the sensor's and does not say what its world is"
        if topic.kind in _RELATIVE or (topic.kind == PX4_ODOMETRY and topic.frame_id != "NED"):
            frame = f"{topic.short_kind} in {topic.frame_id!r}"
            notes.append(f"{topic.name} is {frame}: its azimuth may be relative to the start")
        # A reset of the estimator is no rotation of the aircraft.
        changes = np.nan_to_num(np.diff(topic.column("resets")[valid], prepend=np.nan)) != 0
        segment = np.cumsum(changes, dtype=np.int64)
        reason = "attitude resets" if topic.kind in PX4 else ""
        return source.AttitudeSamples(clock_s[valid], q_body_ned, segment, topic.name, reason, notes=tuple(notes))

    def _named(self, option: str, kinds: Collection[str]) -> Topic | None:
        """Return the topic that an option names; None if it is not given."""
        name: str = getattr(self._options, option)
        topics = {topic.name: topic for topic in self._topics.values() if topic.kind in kinds}
        if name and name not in topics:
            has = f"it has {', '.join(topics) or 'none'}"
            raise LogFormatError(self.name, f"the bag has no {option} {name!r} (--columns {option}=); {has}")
        return topics[name] if name else None

    def _position(self, attitude: Topic) -> source.PositionSamples:
        if (named := self._named("position", PLACES)) is not None:
            samples = named.positions(attitude)
            return samples if samples.clock_s.size else source.no_position_samples(f"{named.name} never had a fix")
        topics = [t for t in self._of_vehicle(PLACES) if not purpose_of(t.name) and t.name not in self._unlike]
        read = [(topic, topic.positions(attitude)) for topic in topics]
        usable = [(topic, samples) for topic, samples in read if samples.clock_s.size]
        if not usable:
            return source.no_position_samples(self._no_position(topics))

        def rank(pair: tuple[Topic, source.PositionSamples]) -> tuple[bool, int, bool, int]:
            is_base = "base" in words_of(pair[0].name)  # of an RTK receiver
            return not is_base, _shared_parts(pair[0].name, attitude.name), pair[0].kind == FIX, pair[1].clock_s.size

        topic, best = max(usable, key=rank)
        for other, samples in usable:
            is_equal = rank((other, samples))[:2] == rank((topic, best))[:2] and other is not topic
            distance_deg = _distance_deg(best, samples)
            if is_equal and distance_deg > _SAME_PLACE_DEG:
                both = f"{topic.name} and {other.name} are {distance_deg * 111:.0f} km from each other"
                remedy = "nothing says which is the aircraft; name one with --columns position=TOPIC"
                raise LogFormatError(self.name, f"{both}, and {remedy}")
        return best

    def _no_position(self, topics: list[Topic]) -> str:
        """Return why there is no position, for messages."""
        if topics:
            return f"{', '.join(topic.name for topic in topics)} never had a fix"
        every = [topic.name for topic in self._topics.values() if topic.kind in PLACES]
        if not every:
            return "it has no NavSatFix"
        own = self._vehicle or "this vehicle"
        return f"{own} has none; --columns position= takes another one of {', '.join(every)}"

    def _utc(self, attitude: Topic) -> source.ClockSamples:
        """Return readings of UTC: TimeReference, otherwise the stamps themselves, if they are times of this century."""
        if self._utc_topics:
            topic, readings, _ = self._utc_topics[0]
            return source.ClockSamples(*readings, f"{topic.name}, {readings[0].size} readings")
        clock_s = attitude.column("stamp_s")
        clock_s = clock_s[source.valid_rare_times(clock_s)]
        if clock_s.size and source.YEAR_2010_S <= float(np.median(clock_s)) < source.YEAR_2100_S:
            utc_s = clock_s + attitude.scale_of_stamps[0]
            return source.ClockSamples(clock_s, utc_s, f"stamps of {attitude.name}, by the clock of the computer")
        has = "its TimeReference counts no UTC" if self._of_vehicle(TIMES) else "it has no TimeReference"
        first_s = float(attitude.column("received_s").min())
        received = f"; its recorder received the first attitude at {format_utc(first_s)}"
        is_utc = source.YEAR_2010_S <= first_s < source.YEAR_2100_S
        return source.no_clock_samples(f"its stamps are no UTC, and {has}{received if is_utc else ''}")

    @cached_property
    def _utc_topics(self) -> list[tuple[Topic, tuple[Float, Float], str]]:
        """The TimeReferences that count UTC, with stamps, readings and time scale, the best one first."""
        named, attitude = self._named("utc", TIMES), self._attitude_topic
        usable = []
        for topic in self._of_vehicle(TIMES) if named is None else [named]:
            clock_s, utc_s = topic.utc_readings(attitude)
            if utc_s.size:
                recorder_s = clock_s + attitude.late_s
                correction_s, scale = utc_of_scale(_offset_s((recorder_s, utc_s)), float(np.median(recorder_s)))
                usable.append((topic, (clock_s, utc_s + correction_s), scale))
        offset_s = {topic.name: _offset_s(readings) for topic, readings, _ in usable}
        return sorted(
            usable,
            key=lambda found: (
                has_word(DEVICE, found[0].name),
                not has_word(OF_GPS, f"{found[0].name} {found[0].origin}"),
                offset_s[found[0].name] < max(offset_s.values()) - _NEVER_SET_S,
                -found[1][0].size,
            ),
        )

    def _utc_notes(self, attitude: Topic) -> list[str]:
        """Return remarks on the time scales, and on TimeReferences that are not used."""
        usable = [topic.name for topic, _, _ in self._utc_topics]
        notes = [f"{t.name} is passed over: it counts no UTC" for t in self._of_vehicle(TIMES) if t.name not in usable]
        scales = [(topic.name, scale) for topic, _, scale in self._utc_topics[:1]]
        for name, scale in scales or [(f"the stamps of {attitude.name}", attitude.scale_of_stamps[1])]:
            if scale:
                notes.append(f"{name} count {scale}, as the clock of the recorder shows: converted to UTC")
        for other, readings, _ in self._utc_topics[1:]:
            off_s = _offset_s(readings) - _offset_s(self._utc_topics[0][1])
            if abs(off_s) > _UTC_DIFFERENCE_S:
                differs = f"differs by {off_s:.3f} s from {usable[0]}, which is used"
                notes.append(f"the UTC of {other.name} {differs} (--columns utc=TOPIC)")
        return notes

    def _rates(self, topic: Topic, attitude: source.AttitudeSamples) -> tuple[source.RateSamples | None, list[str]]:
        """Return the gyro rates that turn as the attitude does, and remarks on others."""
        named = self._named("rates", RATES)
        refused: list[str] = []
        usable: list[tuple[tuple[bool, bool, bool, int], source.RateSamples]] = []
        for imu in self._of_vehicle(RATES) if named is None else [named]:
            if imu.is_other_clock(topic):
                refused.append(f"{imu.name} (its stamps are of another clock)")
                continue
            clock_s, rate = imu.column("stamp_s"), imu.column("rate_rad_per_s")
            if imu.axes(self._options.world, self._options.body)[1] == "FLU":
                rate = rate * np.array([1.0, -1.0, -1.0])
            valid = source.valid_rare_times(clock_s) & source.valid_rates(rate)
            clock_s, rate = clock_s[valid], rate[valid]
            found = GyroAlignment.of(attitude.clock_s, attitude.q_body_ned, clock_s, rate)
            if found is None:
                continue
            if found.C_body_gyro is None:
                refused.append(f"{imu.name} (off by {found.residual_deg_per_s:.1f} deg/s)")
                continue
            turned = f", turned by {found.angle_deg:.1f} deg into the axes of {topic.name}" if found.angle_deg else ""
            rates = source.RateSamples(clock_s, rate @ found.C_body_gyro.T, f"{imu.name}{turned}")
            usable.append(((bool(turned), has_word(DEVICE, imu.name), imu is not topic, -clock_s.size), rates))
        notes = [f"gyros that do not turn as the attitude does are not used: {', '.join(refused)}"] if refused else []
        return min(usable, key=lambda pair: pair[0], default=(None, None))[1], notes


def _unlike(best: Topic, others: list[Topic]) -> list[Topic]:
    """Return the attitudes of others that do not turn as one does, without sensors that have attitudes of their own."""
    return [topic for topic in others if topic is not best and not topic.is_of_device and topic.turns_otherwise(best)]


def _doubts_of_position(attitude: str, position: str) -> tuple[str, ...]:
    """Return a remark on a topic with the position that may be of another vehicle than the attitude."""
    doubt = f"{position} may be of another vehicle than {attitude}, by their name spaces (--columns position=TOPIC)"
    return (doubt,) if are_of_two_bodies(attitude, position) else ()


def _offset_s(readings: tuple[Float, Float]) -> float:
    """Return the median of UTC minus the clock of readings of both, s."""
    return float(np.median(readings[1] - readings[0]))


def _distance_deg(first: source.PositionSamples, second: source.PositionSamples) -> float:
    """Return the distance between the medians of two positions, deg."""
    north = np.median(first.latitude_rad) - np.median(second.latitude_rad)
    east = (np.median(first.longitude_rad) - np.median(second.longitude_rad)) * np.cos(np.median(first.latitude_rad))
    return float(np.rad2deg(np.hypot(north, east)))


def _shared_parts(first: str, second: str) -> int:
    """Return how many parts two topics have in common at their start."""
    pairs = zip(first.strip("/").split("/"), second.strip("/").split("/"), strict=False)
    return sum(1 for _ in takewhile(lambda pair: pair[0] == pair[1], pairs))


def is_bag(head: bytes) -> bool:
    """Return whether a file is a ROS bag, an MCAP recording, or the database of a ROS 2 bag, by its first bytes."""
    return head.startswith(MAGICS)
