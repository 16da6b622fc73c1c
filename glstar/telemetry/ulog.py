"""PX4's ULog (``.ulg``), and the CSV files of its topics.

=======================================  ==============================================  =============================
topic                                    fields                                          used for
=======================================  ==============================================  =============================
vehicle_attitude                         q[0..3], body to NED; quat_reset_counter        attitude
vehicle_global_position                  lat, lon (deg), alt (m)                         position
vehicle_gps_position, sensor_gps         latitude_deg, longitude_deg, altitude_msl_m;    position, if there is no
                                         lat, lon (1e-7 deg), alt (mm) until 2022        vehicle_global_position
the same                                 time_utc_usec, timestamp_time_relative          UTC
information boot_time_utc_us                                                             UTC, if no receiver has it
vehicle_angular_velocity                 xyz[0..2]                                       rates, from the most frequent
sensor_combined                          gyro_rad[0..2], gyro_rad_s[0..2] until 2017     the same
sensor_gyro                              x, y, z                                         the same
camera_capture                           timestamp, timestamp_utc, result                when the camera was triggered
camera_trigger                           timestamp, timestamp_utc, feedback              the same, without captures
gimbal_device_attitude_status            q[0..3], device_flags                           attitude of a gimbal
mount_orientation                        attitude_euler_angle[0..2] (rad)                the same, if there is none of
                                                                                         the above
vehicle_status                           system_type; nav_state                          the vehicle; flight modes
logged messages                                                                          messages on the timeline
=======================================  ==============================================  =============================

Other topics with a quaternion are read if named: ``"vehicle_attitude_groundtruth"`` of a simulator,
``"estimator_attitude[1]"`` of one of several estimators.  Heights are above mean sea level.

pyulog's ``ulog2csv`` writes a CSV file for each instance of a topic: ``flight.ulg`` becomes
``flight_vehicle_attitude_0.csv``, ``flight_vehicle_gps_position_0.csv`` and so on, with ``timestamp``, the time since
boot in microseconds, and the fields of the topic.  The other files are found by their names in the same directory.
"""

import os
import re
from collections.abc import Collection, Iterator, Sequence
from dataclasses import replace
from functools import cached_property
from os import PathLike

import numpy as np
from numpy.typing import NDArray

from glstar.arrays import Float, Integer, Mask
from glstar.errors import LogFormatError
from glstar.flight import ONLY_CAMERA, EventKind
from glstar.rotation import conjugate
from glstar.telemetry import source
from glstar.telemetry.boots import find_boots
from glstar.telemetry.mavlink.vehicles import angle_samples, px4_navigation_state, status_samples, vehicle_kind, version
from glstar.telemetry.ulogfile import CsvTopics, LogTopics, Topics, joined_logs

_MAGIC = b"ULog\x01\x12\x35"

# Times, quaternions and segment numbers of one instance of a topic.
_Attitude = tuple[Float, Float, NDArray[np.int64]]
# Which samples of a receiver have UTC, their times since boot, s, and UTC, s since 1970.
_Readings = tuple[Mask, Float, Float]

_ATTITUDE = "vehicle_attitude"
# Attitudes of the aircraft; gimbals, setpoints and cameras have quaternions too.
_ATTITUDES = re.compile(r"(vehicle|estimator|external_ins)_attitude(_groundtruth)?")
_POSITION = "vehicle_global_position"
_RECEIVERS = ("vehicle_gps_position", "sensor_gps")
# Topics with gyro rates, the best first, and the names of their three columns in all versions.
_GYROS = {
    "vehicle_angular_velocity": [("xyz[0]", "xyz[1]", "xyz[2]")],
    "sensor_combined": [
        ("gyro_rad[0]", "gyro_rad[1]", "gyro_rad[2]"),
        ("gyro_rad_s[0]", "gyro_rad_s[1]", "gyro_rad_s[2]"),
    ],
    "sensor_gyro": [("x", "y", "z")],
}
# Topics of a gimbal, the best first: their fields, and the function that reads those.
_GIMBALS = {
    "gimbal_device_attitude_status": (("device_flags", "q[0]", "q[1]", "q[2]", "q[3]"), status_samples),
    "mount_orientation": (
        tuple(f"attitude_euler_angle[{axis}]" for axis in range(3)),
        lambda clock_s, angles_rad, name: angle_samples(clock_s, np.rad2deg(angles_rad), name),
    ),
}
# Topics of a triggered camera, the most exact one first.
_CAPTURE, _TRIGGER = "camera_capture", "camera_trigger"
# Largest difference between the UTC of a trigger and that of the log, s: PX4 sets its clock by a GPS, not exactly.
_CLOCK_ERROR_S = 0.5
_STATUS = "vehicle_status"
# Information about the log: UTC at boot, us since 1970, if the autopilot's clock was set before the log began.
_BOOT_TIME = "boot_time_utc_us"
_UTC_AT_BOOT = (
    f"the only UTC of the log is {_BOOT_TIME}, by PX4's own clock: a GPS or a ground station set it before the log"
    " began, perhaps a second off; --utc-start replaces it"
)
# Topics by which reboots are detected: those that are logged at a steady rate.
_CLOCKED = (_ATTITUDE, *_GYROS, _POSITION, *_RECEIVERS)
_FIX_3D = 3
# Largest delay between a sample and its publication, us.
_SAMPLED_BEFORE_US = 1e6
# Largest age of a UTC reading, s: receivers send UTC once a second at least.  Some drivers write a difference of two
# clocks into that field, or nothing at all.
_OLDEST_S = 2.0
# Ages are not used if a smaller fraction of them is valid: a random number of 32 bits is within 2 s once in a thousand.
_FEWEST_AGES = 0.05
# Fields of the topics that are read, which tables of other origin do not have.
_TYPICAL_FIELDS = frozenset(
    ("q[0]", "xyz[0]", "gyro_rad[0]", "gyro_rad_s[0]", "time_utc_usec", "system_type", "terrain_alt")
)
_FIELD = re.compile(r"[A-Za-z_][\w.\[\]]*")


class ULogReader(source.TelemetrySource):
    """A PX4 log as a telemetry source; its clock is the autopilot's time since boot.

    Every complete message of a truncated or damaged log is read.  The options are those of `open_source`: `attitude`
    is ``"auto"`` for vehicle_attitude, or a topic, or one instance of it as ``"estimator_attitude[1]"``.  Raises
    LogFormatError if the file is truncated within its head, or a newer version of ULog.
    """

    format = "PX4 ULog"

    def __init__(self, path: str | PathLike[str], *, attitude: str = "auto", boot: int | None = None) -> None:
        self.name = os.fspath(path)
        self._attitude = attitude
        self._boot = boot
        name, instance = re.fullmatch(r"(.*?)(?:\[(\d{1,3})\])?", attitude.strip().lower(), re.DOTALL).groups()  # type: ignore[union-attr]
        self._topic = _ATTITUDE if name == "auto" else name
        self._instance = None if instance is None else int(instance)
        self._logs = self._open()

    def samples(self) -> Iterator[source.Samples]:
        """Yield attitude, position and UTC of the log, a batch each; the gyro rates last.

        Topics are decoded on demand: the first three batches do not wait for the gyro rates.  Raises LogFormatError if
        the log has no attitude, or not the requested one.
        """
        boots = [(boot.number, log) for boot in self.boots() for log in self._of_boot(boot)]
        refusals: list[LogFormatError] = []
        flew = []
        for number, log in boots:
            try:
                attitude = self._attitudes(log)
            except LogFormatError as error:
                refusals.append(error)
                continue
            flew.append((number, log))
            yield replace(attitude, boot=number)
            yield replace(_positions(log), boot=number)
            yield replace(_utc(log), boot=number)
        if not flew:
            raise refusals[0] if refusals else self._no_attitude(self._logs[0])
        for number, log in flew:
            yield from (replace(events, boot=number) for events in _events(log))
            yield from (replace(rates, boot=number) for rates in _rates(log))
            yield from (replace(triggers, boot=number) for triggers in _triggers(log))
            yield from (replace(gimbal, boot=number) for gimbal in _gimbal(log))

    def boots(self) -> tuple[source.Boot, ...]:
        """Return the boots of the autopilot in the file, or the requested one.

        Raises LogFormatError if the file has no such boot.
        """
        return source.chosen_boots(self.name, self._found_boots, self._boot)

    def facts(self, boots: Collection[int] = ()) -> source.LogFacts:
        """Return the vehicle and its firmware; `boots`: numbers of the boots; by default all."""
        parts = [log for boot in self.boots() if not boots or boot.number in boots for log in self._of_boot(boot)]
        unread_bytes = sum(log.unread_bytes for log in self._logs)
        return source.LogFacts.joined(self.format, [_facts(self.format, log) for log in parts], unread_bytes)

    def attitudes(self) -> Iterator[tuple[str, source.AttitudeSamples]]:
        """Yield every attitude of the aircraft in the log, with its name, boot by boot."""
        for boot in self.boots():
            for log in self._of_boot(boot):
                for name in filter(_ATTITUDES.fullmatch, log.with_quaternion()):
                    instances = _instances(log, name)
                    for number in sorted(instances):
                        named = name if len(instances) == 1 else f"{name}[{number}]"
                        yield named, replace(_named(instances, number, name), boot=boot.number)

    def close(self) -> None:
        """Do nothing: the file is only open while it is read."""

    def _open(self) -> list[Topics]:
        """Return the logs in the file."""
        return [LogTopics(self.name, start, stop) for start, stop in joined_logs(self.name)]

    @cached_property
    def _found_boots(self) -> tuple[source.Boot, ...]:
        return find_boots(
            [stamps for log in self._logs for name in _CLOCKED for stamps in log.stamps(name)],
            _clock_readings(self._logs),
            [log.start for log in self._logs],
            lambda one, other: self._log_at(one) is self._log_at(other),
        )

    def _log_at(self, position: int) -> Topics:
        return next((log for log in reversed(self._logs) if log.start <= position), self._logs[0])

    def _of_boot(self, boot: source.Boot) -> list[Topics]:
        """Return the part of a log with a boot."""
        if boot == source.Boot(1):
            return self._logs[:1]
        return [self._log_at(boot.spans[0][0]).only(boot.spans)]

    def _attitudes(self, log: Topics) -> source.AttitudeSamples:
        instances = _instances(log, self._topic)
        if not instances or self._instance not in (None, *instances):
            raise self._no_attitude(log)
        return _named(instances, min(instances) if self._instance is None else self._instance, self._topic)

    def _no_attitude(self, log: Topics) -> LogFormatError:
        offered = log.with_quaternion()
        if offered and (self._topic not in offered or self._instance is not None):
            message = f"the log has no attitude {self._attitude!r}; it has {', '.join(offered)}"
        elif offered:
            message = f"the log has no valid sample of {self._topic}"
        else:
            message = f"the log has no attitude: no {_ATTITUDE} among its {len(log.names)} topics{log.extent()}"
        return LogFormatError(self.name, message, offset=log.whole_bytes)


def is_ulog(head: bytes) -> bool:
    """Return whether a file is a ULog, by its first bytes."""
    return head.startswith(_MAGIC)


def is_ulog2csv(header: str) -> bool:
    """Return whether a table was exported by ulog2csv, by its first line."""
    first, mark, rest = header.strip().partition("timestamp")
    if first or not mark or not rest:
        return False
    fields = rest[1:].split(rest[0])
    return all(map(_FIELD.fullmatch, fields)) and not _TYPICAL_FIELDS.isdisjoint(fields)


class Ulog2csvReader(ULogReader):
    """The files of ulog2csv as a telemetry source; its clock is the autopilot's time since boot.

    `path` is any of the files; `attitude`, as of `ULogReader`, is by default the attitude in that file, else
    vehicle_attitude in the directory.  Raises LogFormatError if the file cannot be read.
    """

    format = "CSV of PX4 ULog, by ulog2csv"

    def _open(self) -> list[Topics]:
        topics = CsvTopics(self.name)
        if self._attitude.strip().lower() == "auto" and topics.own_quaternion:
            self._topic, self._instance = topics.own
        return [topics]

    def samples(self) -> Iterator[source.Samples]:
        """Yield attitude, position, UTC and gyro rates of the log, a batch each.

        Raises LogFormatError if the log has no attitude, or not the requested one.
        """
        for batch in super().samples():
            yield replace(batch, notes=self._notes) if isinstance(batch, source.AttitudeSamples) else batch

    @property
    def _notes(self) -> tuple[str, ...]:
        """Remarks on files in the directory that are left out."""
        [topics] = self._logs
        if not isinstance(topics, CsvTopics):
            return ()
        for name in topics.names:
            topics.count(name)
        return tuple(topics.left_out)

    @cached_property
    def _found_boots(self) -> tuple[source.Boot, ...]:
        # The order of rows in different files is unknown: each file is examined separately.
        [topics] = self._logs
        position, clock_s, utc_s = _clock_readings(self._logs)
        nothing = position[:0], clock_s[:0], utc_s[:0]
        receiver = next((name for name in _RECEIVERS if topics.count(name)), None) if position.size else None
        for name in _CLOCKED:
            for stamps in topics.stamps(name):
                boots = find_boots([stamps], (position, clock_s, utc_s) if name == receiver else nothing)
                if len(boots) > 1:
                    restarts = f"the time since boot of {name} restarts: {len(boots)} boots"
                    raise LogFormatError(self.name, f"{restarts}; give the .ulg files themselves")
        return (source.Boot(1),)


def _facts(kind_of_log: str, log: Topics) -> source.LogFacts:
    about = log.about
    system = str(about.get("sys_name", "")) or "PX4"
    kind = next((kind for _, status in log[_STATUS] if (kind := vehicle_kind(status.get("system_type")))), None)
    release = about.get("ver_sw_release")
    commit = str(about.get("ver_sw", ""))[:8]
    hardware = about.get("ver_hw")
    firmware = [
        version(release) if isinstance(release, int) else "",
        f"({commit})" if commit else "",
        f"on {hardware}" if hardware else "",
    ]
    firmware = [part for part in firmware if part]
    vehicle = f"{system} {kind}" if kind else system
    return source.LogFacts(kind_of_log, vehicle, " ".join([system, *firmware]) if firmware else None)


def _clock_readings(logs: Sequence[Topics]) -> tuple[Integer, Float, Float]:
    """Return file positions of UTC readings, the time since boot, s, and UTC, s since 1970."""
    parts: list[tuple[Integer, Float, Float]] = [(np.empty(0, dtype=np.int64), np.empty(0), np.empty(0))]
    for log in logs:
        if (receiver := _receiver(log)) is None:
            continue
        name, topic, (valid, clock_s, utc_s) = receiver
        # The samples of one of several receivers are found among all samples of the topic.
        found = ((position, _in_order(topic["timestamp"] * 1e-6, stamp_s)) for position, stamp_s in log.stamps(name))
        parts.extend((position[at][valid], clock_s[valid], utc_s[valid]) for position, at in found if at is not None)
    position, clock_s, utc_s = (np.concatenate(column) for column in zip(*parts, strict=True))
    order = np.argsort(position, kind="stable")
    return position[order], clock_s[order], utc_s[order]


def _in_order(selected: Float, values: Float) -> Integer | None:
    """Return the indices of selected values in a sequence that has them in the same order; None if it does not."""
    if np.array_equal(selected, values):
        return np.arange(values.size)
    indices: list[int] = []
    at = 0
    for value in selected.tolist():
        matches = np.flatnonzero(values[at:] == value)
        if not matches.size:
            return None
        at += int(matches[0])
        indices.append(at)
        at += 1
    return np.array(indices, dtype=np.int64)


def _instances(log: Topics, topic: str) -> dict[int, _Attitude]:
    return {number: valid for number, columns in log[topic] if (valid := _attitude_of(columns))}


def _named(instances: dict[int, _Attitude], number: int, topic: str) -> source.AttitudeSamples:
    """Return the attitude of one of several instances."""
    name = topic
    if len(instances) > 1:
        name += f" instance {number} of {' and '.join(map(str, sorted(instances)))}"
    return source.AttitudeSamples(*instances[number], name)


def _attitude_of(topic: dict[str, Float]) -> _Attitude | None:
    """Return times, quaternions and segment numbers of the valid samples of a topic."""
    names = ("timestamp", "q[0]", "q[1]", "q[2]", "q[3]")
    if not set(names) <= set(topic):
        return None
    clock_s = _sampled_s(topic)
    q = conjugate(np.stack([topic[name] for name in names[1:]], axis=-1))
    valid = source.unit_quaternions(q) & source.valid_times(clock_s)
    clock_s, q = clock_s[valid], q[valid]
    order = np.argsort(clock_s, kind="stable")
    segment = np.zeros(clock_s.size, dtype=np.int64)
    if (resets := topic.get("quat_reset_counter")) is not None and order.size:
        # A reset of the estimator is no rotation of the aircraft.
        count = resets[valid][order]
        segment[order[1:]] = np.cumsum(count[1:] != count[:-1])
    return (clock_s, q, segment) if clock_s.size else None


def _sampled_s(topic: dict[str, Float]) -> Float:
    """Return the times at which the samples of a topic were taken, s since boot."""
    clock_us = topic["timestamp"]
    if (sampled_us := topic.get("timestamp_sample")) is not None:
        clock_us = np.where(np.abs(clock_us - sampled_us) < _SAMPLED_BEFORE_US, sampled_us, clock_us)
    return clock_us * 1e-6


def _positions(log: Topics) -> source.PositionSamples:
    for name in (_POSITION, *_RECEIVERS):
        for _, topic in log[name]:
            fixed = _fixed(topic)
            if (columns := _coordinates(topic)) is None:
                continue
            latitude_deg, longitude_deg, height_m = (column[fixed] for column in columns)
            clock_s = topic["timestamp"][fixed] * 1e-6
            positions = source.position_samples(clock_s, latitude_deg, longitude_deg, height_m, name)
            if positions.clock_s.size:
                return positions
    if any(log[name] for name in _RECEIVERS):
        return source.no_position_samples("its GPS never had a 3D fix")
    return source.no_position_samples(log.lack(_POSITION, _RECEIVERS[0]))


def _fixed(topic: dict[str, Float]) -> NDArray[np.bool_]:
    """Return which samples have a position: all of an estimator, those with a 3D fix of a receiver."""
    for name, least in (("fix_type", _FIX_3D), ("lat_lon_valid", 1)):
        if name in topic:
            return np.asarray(topic[name] >= least)
    return np.ones(topic["timestamp"].size, dtype=bool)


def _coordinates(topic: dict[str, Float]) -> tuple[Float, Float, Float] | None:
    """Return latitude and longitude, deg, and height, m, of a topic, under their new or old names."""
    if {"latitude_deg", "longitude_deg", "altitude_msl_m"} <= set(topic):
        return topic["latitude_deg"], topic["longitude_deg"], topic["altitude_msl_m"]
    if not {"lat", "lon", "alt"} <= set(topic):
        return None
    if "fix_type" in topic:
        return topic["lat"] / 1e7, topic["lon"] / 1e7, topic["alt"] / 1e3
    return topic["lat"], topic["lon"], topic["alt"]


def _utc(log: Topics) -> source.ClockSamples:
    """Return the UTC readings of a receiver, else what PX4's own clock said at boot."""
    if (receiver := _receiver(log)) is not None:
        name, topic, (valid, clock_s, utc_s) = receiver
        origin = f"{name}.time_utc_usec, {valid.sum()} fixes"
        return source.ClockSamples(clock_s[valid], utc_s[valid], origin, notes=_age_notes(name, topic))
    boot_utc_s = np.array([float(log.about.get(_BOOT_TIME, 0)) * 1e-6])
    if source.plausible_utc(boot_utc_s).all():
        return source.ClockSamples(np.zeros(1), boot_utc_s, _BOOT_TIME, notes=(_UTC_AT_BOOT,))
    if any(log[name] for name in _RECEIVERS):
        return source.no_clock_samples("its GPS never had a time after 2010")
    return source.no_clock_samples(log.lack(_RECEIVERS[0]))


def _receiver(log: Topics) -> tuple[str, dict[str, Float], _Readings] | None:
    """Return topic, columns and UTC readings of the first receiver with a fix, else of the first with UTC."""
    known = [
        (name, topic, readings)
        for name in _RECEIVERS
        for _, topic in log[name]
        if (readings := _readings(topic)) is not None and readings[0].any()
    ]
    return next((one for one in known if (one[2][0] & _fixed(one[1])).any()), known[0] if known else None)


def _readings(topic: dict[str, Float]) -> _Readings | None:
    """Return which samples of a receiver have UTC, their times since boot, s, and UTC, s since 1970."""
    if "time_utc_usec" not in topic:
        return None
    utc_s = topic["time_utc_usec"] * 1e-6
    age_s, has_age = _ages(topic)
    clock_s = topic["timestamp"] * 1e-6 - age_s
    valid = source.plausible_utc(utc_s) & source.valid_times(topic["timestamp"] * 1e-6) & has_age
    # Before its first fix a receiver reports the date of its own clock, which may be of any year.
    fixed = valid & _fixed(topic)
    return (fixed if fixed.any() else valid), clock_s, utc_s


def _ages(topic: dict[str, Float]) -> tuple[Float, Mask]:
    """Return the ages of UTC readings, s, and which readings are valid.

    A receiver with one UTC reading a second repeats it, with its age; without ages only the first of equal ones is new.
    """
    age_s = _logged_ages(topic)
    valid = np.abs(age_s) <= _OLDEST_S
    if np.count_nonzero(valid) > _FEWEST_AGES * age_s.size and age_s[valid].any():
        return age_s, valid
    is_new = np.diff(topic["time_utc_usec"], prepend=np.nan) != 0
    return np.zeros_like(age_s), is_new


def _logged_ages(topic: dict[str, Float]) -> Float:
    """Return the ages of UTC readings as they are logged, s; 0 without the field."""
    return -topic.get("timestamp_time_relative", np.zeros(topic["timestamp"].size)) * 1e-6


def _age_notes(name: str, topic: dict[str, Float]) -> tuple[str, ...]:
    """Return a remark if the ages of the UTC readings of a receiver are not used, or some readings are left out."""
    age_s, (used_s, _) = _logged_ages(topic), _ages(topic)
    field = f"{name}.timestamp_time_relative"
    odd = ~(np.abs(age_s) <= _OLDEST_S)
    if not odd.any():
        return ()
    if used_s.any():
        left_out = f"{np.count_nonzero(odd)} of {odd.size} UTC readings are left out"
        return (f"{left_out}: by {field} they were more than {_OLDEST_S:g} s old when logged",)
    return (f"{field} is not used: by it the UTC readings were {np.median(age_s[odd]):.0f} s old when logged",)


def _rates(log: Topics) -> Iterator[source.RateSamples]:
    """Yield the gyro rates of the most frequent topic; nothing if the log has none."""
    for name in sorted(_GYROS, key=log.count, reverse=True):
        for _, topic in log[name]:
            columns = next((columns for columns in _GYROS[name] if set(columns) <= set(topic)), None)
            if columns is None:
                continue
            clock_s = _sampled_s(topic)
            rate = np.stack([topic[column] for column in columns], axis=-1)
            valid = source.valid_times(clock_s) & source.valid_rates(rate)
            if np.count_nonzero(valid) > 1:
                yield source.RateSamples(clock_s[valid], rate[valid], name)
                return


def _triggers(log: Topics) -> Iterator[source.TriggerSamples]:
    """Yield when each camera was triggered, an instance each: its captures, else its answers, else the triggers."""
    captures, triggers = _captures(log), _sent_or_answered(log)
    if len(captures) == 1 and len(triggers) == 1:
        # Captures are copies of triggers, but PX4 makes none before it knows its position.
        [capture], [trigger] = captures.values(), triggers.values()
        missing = trigger.clock_s.size - capture.clock_s.size
        if missing > 0 and not capture.notes and np.isin(capture.clock_s, trigger.clock_s).all():
            note = f"{missing} of {trigger.clock_s.size} triggers ({_TRIGGER}) have no {_CAPTURE}: PX4 had no position"
            captures = {number: replace(trigger, notes=(*trigger.notes, note)) for number in captures}
    cameras = captures or triggers
    for number, samples in cameras.items():
        yield replace(samples, camera=f"{ONLY_CAMERA}:{number}")


def _captures(log: Topics) -> dict[int, source.TriggerSamples]:
    """Return the captures by each instance of a camera, without those that failed."""
    captures = {}
    for number, topic in log[_CAPTURE]:
        # 1 for success, 0 for failure, -1 if the camera does not say.
        failed = topic.get("result", np.ones(topic["timestamp"].size)) == 0
        lost = f"{np.count_nonzero(failed)} of {failed.size} captures ({_CAPTURE}) failed and are left out"
        captures[number] = _trigger_samples(topic, ~failed, _CAPTURE, (lost,) if failed.any() else ())
    return {number: samples for number, samples in captures.items() if samples.clock_s.size or samples.notes}


def _sent_or_answered(log: Topics) -> dict[int, source.TriggerSamples]:
    """Return the answers of each instance of a camera, else the triggers sent to it: one topic has both."""
    topics = dict(log[_TRIGGER])
    answers = {n: topic.get("feedback", np.zeros(topic["timestamp"].size)) > 0 for n, topic in topics.items()}
    # Instances with answers only belong to those with triggers only.
    with_answers = [number for number, is_answer in answers.items() if is_answer.any()]
    only_answers = [number for number in with_answers if answers[number].all()]
    used = only_answers if only_answers and only_answers == with_answers else list(topics)
    sent = {n: int(np.count_nonzero(~answers[n])) for n in used}
    if used == only_answers and len(used) == 1:
        sent[used[0]] = sum(int(np.count_nonzero(~is_answer)) for is_answer in answers.values())
    triggers = {}
    for number in used:
        is_answer, lost = answers[number], sent[number] - int(np.count_nonzero(answers[number]))
        notes = (f"{lost} of {sent[number]} triggers ({_TRIGGER}) have no answer and are left out",)
        rows = is_answer if is_answer.any() else ~is_answer
        triggers[number] = _trigger_samples(
            topics[number], rows, _TRIGGER, notes if is_answer.any() and lost > 0 else ()
        )
    return triggers


def _trigger_samples(topic: dict[str, Float], rows: Mask, name: str, notes: tuple[str, ...]) -> source.TriggerSamples:
    """Return the triggers of some rows, (n,) bool, of a topic."""
    clock_s = topic["timestamp"] * 1e-6
    utc_s = topic.get("timestamp_utc", np.zeros(clock_s.size)) * 1e-6
    utc_s = np.where(source.plausible_utc(utc_s), utc_s, np.nan)
    valid = rows & source.valid_rare_times(clock_s)
    # PX4's own clock, which a GPS or a ground station set, may be wrong; the time since boot is not.
    return source.TriggerSamples(clock_s[valid], utc_s[valid], name, clock_error_s=_CLOCK_ERROR_S, notes=notes)


def _gimbal(log: Topics) -> Iterator[source.GimbalSamples]:
    """Yield the attitude of the gimbal, from the first topic that has one."""
    for name, (fields, samples_of) in _GIMBALS.items():
        for _, topic in log[name]:
            if set(fields) <= set(topic):
                values = np.stack([topic[field] for field in fields], axis=-1)
                samples = samples_of(topic["timestamp"] * 1e-6, values, name)
                if samples.clock_s.size > 1:
                    yield samples
                    return


def _events(log: Topics) -> Iterator[source.EventSamples]:
    """Yield flight modes and messages."""
    for _, topic in log[_STATUS]:
        if "nav_state" in topic:
            clock_s, state = topic["timestamp"] * 1e-6, topic["nav_state"]
            valid = source.valid_rare_times(clock_s) & np.isfinite(state)
            names = [px4_navigation_state(int(number)) for number in state[valid].tolist()]
            yield source.EventSamples.of(EventKind.MODE, clock_s[valid], names)
            break
    if messages := log.messages():
        clock_s = np.array([time_s for time_s, _ in messages])
        clock_s = np.where(source.valid_rare_times(clock_s), clock_s, np.nan)
        yield source.EventSamples.of(EventKind.MESSAGE, clock_s, [text for _, text in messages])
