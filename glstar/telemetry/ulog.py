"""PX4's ULog (``.ulg``): which attitude, which place, which UTC.

A log is a row of messages, each a size, a letter and a body: definitions first (``F`` tells the fields of a topic,
``A`` gives a topic a number), then samples (``D``).  pyulog decodes them.  It is handed only the whole messages of the
few topics that matter, because it may not come to an end with a damaged file.

=======================================  ==============================================  =============================
topic                                    fields                                          used for
=======================================  ==============================================  =============================
vehicle_attitude                         q[0..3], body to NED; quat_reset_counter        attitude
vehicle_global_position                  lat, lon (deg), alt (m)                         place
vehicle_gps_position, sensor_gps         latitude_deg, longitude_deg, altitude_msl_m;    place, where there is no
                                         lat, lon (1e-7 deg), alt (mm) until 2022        vehicle_global_position
the same                                 time_utc_usec, timestamp_time_relative          UTC
=======================================  ==============================================  =============================

Every topic with a quaternion can be named instead: ``"vehicle_attitude_groundtruth"`` of a simulator,
``"estimator_attitude[1]"`` of one estimator among several.  Heights are above mean sea level.
"""

import io
import mmap
import os
import re
import struct
from collections.abc import Iterator
from dataclasses import dataclass, field
from os import PathLike
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from glstar.errors import LogFormatError
from glstar.rotation import conjugate
from glstar.telemetry.quiet import quiet
from glstar.telemetry.sound import UNIT_TOLERANCE, YEAR_2010_S, YEAR_2100_S, no_places, places, sound_times
from glstar.telemetry.source import AttitudeSamples, ClockSamples, PositionSamples, Samples, TelemetrySource

__all__ = ["ULOG_MAGIC", "ULogReader"]

ULOG_MAGIC: Final = b"ULog\x01\x12\x35"

Float = NDArray[np.float64]

_ATTITUDE = "vehicle_attitude"
_POSITION = "vehicle_global_position"
_RECEIVERS = ("vehicle_gps_position", "sensor_gps")
_FIX_3D = 3
# A sample is taken at most so long before it is published.
_SAMPLED_BEFORE_US = 1e6


class ULogReader(TelemetrySource):
    """A PX4 log as a telemetry source; its clock is the autopilot's time since boot.

    Damage is passed over: of a log that is cut off, or has bad bytes in it, every whole message counts.

    Parameters
    ----------
    path : path-like
        The log.
    attitude : str
        ``"auto"``: vehicle_attitude.  Or a topic by name, and one instance of it as ``"estimator_attitude[1]"``.

    Raises
    ------
    LogFormatError
        If the file holds no topic that matters, or is of a newer kind of ULog.
    """

    def __init__(self, path: str | PathLike[str], *, attitude: str = "auto") -> None:
        self.name = os.fspath(path)
        self._attitude = attitude
        name, instance = re.fullmatch(r"(.*?)(?:\[(\d{1,3})\])?", attitude.strip().lower(), re.DOTALL).groups()  # type: ignore[union-attr]
        self._topic = _ATTITUDE if name == "auto" else name
        self._instance = None if instance is None else int(instance)
        self._topics = _Topics(self.name, (self._topic, _POSITION, *_RECEIVERS))

    def samples(self) -> Iterator[Samples]:
        """Yield the attitude, the places and the UTC of the whole log, a batch each.

        Raises
        ------
        LogFormatError
            If the log has no attitude, or not the one that was asked for.
        """
        yield self._attitudes()
        yield _positions(self._topics)
        yield _utc(self._topics)

    def close(self) -> None:
        """Do nothing: the file is open only while it is read."""

    def _attitudes(self) -> AttitudeSamples:
        instances = {number: sound for number, topic in self._topics[self._topic] if (sound := _attitude_of(topic))}
        if not instances or self._instance not in (None, *instances):
            raise self._no_attitude()
        instance = min(instances) if self._instance is None else self._instance
        clock_s, q_body_ned, stretch = instances[instance]
        source = self._topic
        if len(instances) > 1:
            source += f" instance {instance} of {' and '.join(map(str, sorted(instances)))}"
        return AttitudeSamples(clock_s, q_body_ned, stretch, source)

    def _no_attitude(self) -> LogFormatError:
        log, offered = self._topics, self._topics.with_quaternion()
        if offered and (self._topic not in offered or self._instance is not None):
            message = f"the log has no attitude {self._attitude!r}; it has {', '.join(offered)}"
        elif offered:
            message = f"the log has no sound sample of {self._topic}"
        else:
            cut = "" if log.whole_bytes == log.file_bytes else f" in {log.whole_bytes} whole bytes of {log.file_bytes}"
            message = f"the log has no attitude: no {_ATTITUDE} among its {len(log.names)} topics{cut}"
        return LogFormatError(self.name, message, offset=log.whole_bytes)


def _attitude_of(topic: dict[str, Float]) -> tuple[Float, Float, NDArray[np.int64]] | None:
    """Return times, quaternions and stretches of a topic, without what no aircraft can have meant."""
    names = ("timestamp", "q[0]", "q[1]", "q[2]", "q[3]")
    if not set(names) <= set(topic):
        return None
    clock_us, *components = (topic[name] for name in names)
    if (sampled_us := topic.get("timestamp_sample")) is not None:
        clock_us = np.where(np.abs(clock_us - sampled_us) < _SAMPLED_BEFORE_US, sampled_us, clock_us)
    clock_s, q = clock_us * 1e-6, conjugate(np.stack(components, axis=-1))

    with np.errstate(over="ignore", invalid="ignore"):
        sound = np.abs(np.linalg.norm(q, axis=-1) - 1) < UNIT_TOLERANCE  # False for NaN too
    sound &= sound_times(clock_s)
    clock_s, q = clock_s[sound], q[sound]
    order = np.argsort(clock_s, kind="stable")
    stretch = np.zeros(clock_s.size, dtype=np.int64)
    if (resets := topic.get("quat_reset_counter")) is not None and order.size:
        # The estimator found that it was wrong and turned at once: no rotation of the aircraft.
        stretch[order[1:]] = np.cumsum(np.diff(resets[sound][order]) != 0)
    return (clock_s, q, stretch) if clock_s.size else None


def _positions(log: "_Topics") -> PositionSamples:
    for name in (_POSITION, *_RECEIVERS):
        for _, topic in log[name]:
            fixed = _fixed(topic)
            if (columns := _place_of(topic)) is None:
                continue
            latitude_deg, longitude_deg, height_m = (column[fixed] for column in columns)
            known = places(topic["timestamp"][fixed] * 1e-6, latitude_deg, longitude_deg, height_m, name)
            if known.clock_s.size:
                return known
    if any(log[name] for name in _RECEIVERS):
        return no_places("its GPS never had a 3D fix")
    return no_places(f"it has neither {_POSITION} nor {_RECEIVERS[0]}")


def _fixed(topic: dict[str, Float]) -> NDArray[np.bool_]:
    """Return which samples know where they are: all of an estimator's, those with a 3D fix of a receiver's."""
    for name, least in (("fix_type", _FIX_3D), ("lat_lon_valid", 1)):
        if name in topic:
            return np.asarray(topic[name] >= least)
    return np.ones(topic["timestamp"].size, dtype=bool)


def _place_of(topic: dict[str, Float]) -> tuple[Float, Float, Float] | None:
    """Return latitude and longitude (deg) and height (m) of a topic, under their new names or their old ones."""
    if {"latitude_deg", "longitude_deg", "altitude_msl_m"} <= set(topic):
        return topic["latitude_deg"], topic["longitude_deg"], topic["altitude_msl_m"]
    if not {"lat", "lon", "alt"} <= set(topic):
        return None
    if "fix_type" in topic:
        return topic["lat"] / 1e7, topic["lon"] / 1e7, topic["alt"] / 1e3
    return topic["lat"], topic["lon"], topic["alt"]


def _utc(log: "_Topics") -> ClockSamples:
    nothing = np.empty(0)
    for name in _RECEIVERS:
        for _, topic in log[name]:
            if "time_utc_usec" not in topic:
                continue
            utc_s = topic["time_utc_usec"] * 1e-6
            # A receiver that tells the time once a second repeats it; this says how old it is.
            clock_s = (topic["timestamp"] + topic.get("timestamp_time_relative", 0.0)) * 1e-6
            told = (utc_s >= YEAR_2010_S) & (utc_s < YEAR_2100_S) & sound_times(topic["timestamp"] * 1e-6)
            if told.any():
                return ClockSamples(clock_s[told], utc_s[told], f"{name}.time_utc_usec, {told.sum()} fixes")
    if any(log[name] for name in _RECEIVERS):
        return ClockSamples(nothing, nothing, "its GPS never told a time after 2010")
    return ClockSamples(nothing, nothing, f"it has no {_RECEIVERS[0]}")


class _Topics:
    """Some topics of a ULog file: of each its instances, and of each of these its columns, as float64."""

    def __init__(self, path: str, wanted: tuple[str, ...]) -> None:
        with Path(path).open("rb") as file:
            self.file_bytes = os.fstat(file.fileno()).st_size
            if self.file_bytes < _FILE_HEAD_BYTES:
                raise LogFormatError(path, f"the log is cut off in its head: {self.file_bytes} bytes", offset=0)
            with mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as raw:
                excerpt = _excerpt(raw, frozenset(wanted))
        if excerpt.unknown:
            raise LogFormatError(path, "is a newer kind of ULog, which pyulog does not know", offset=_FILE_HEAD_BYTES)
        self.whole_bytes = excerpt.whole_bytes
        self.names = sorted({name for _, name in excerpt.subscribed.values()})
        self._formats = excerpt.formats
        self._instances: dict[str, list[tuple[int, dict[str, Float]]]] = {}
        for topic in _decoded(path, excerpt):
            self._instances.setdefault(topic.name, []).append((topic.multi_id, _columns(topic.data)))

    def __getitem__(self, name: str) -> list[tuple[int, dict[str, Float]]]:
        """Return the instances of a topic, by rising number; none where it was not logged."""
        return self._instances.get(name, [])

    def with_quaternion(self) -> list[str]:
        """Return the names of all logged topics that tell an attitude."""
        return [name for name in self.names if b"float[4] q;" in self._formats.get(name, b"")]


def _columns(fields: dict[str, NDArray[Any]]) -> dict[str, Float]:
    with np.errstate(invalid="ignore"):  # damaged floats may be signalling NaNs
        return {name: column.astype(np.float64) for name, column in fields.items()}


def _decoded(path: str, excerpt: "_Excerpt") -> list[Any]:
    """Return pyulog's reading of an excerpt, imported on first use."""
    with quiet():
        from pyulog import ULog  # noqa: PLC0415

        try:
            topics = ULog(io.BytesIO(b"".join((excerpt.head, *excerpt.definitions, *excerpt.samples)))).data_list
        except Exception as error:  # pyulog raises what damage makes Python raise: RecursionError, TypeError, ...
            raise LogFormatError(
                path, f"its definitions are damaged: {type(error).__name__} in pyulog", offset=excerpt.whole_bytes
            ) from error
    return [topic for topic in topics if "timestamp" in topic.data]


# --- the messages of the file -----------------------------------------------------------------------------------------

_FILE_HEAD_BYTES = 16
_HEAD = struct.Struct("<HB")
_SUBSCRIPTION = struct.Struct("<BH")
_FLAGS = struct.Struct("<8s8s")

# The least and the most bytes of each kind of message.
_MOST = 0xFFFF
_SIZES: Final = {
    ord("B"): (16, 100),  # flags
    ord("F"): (3, _MOST),  # format
    ord("I"): (3, _MOST),  # information
    ord("M"): (4, _MOST),  # information in parts
    ord("P"): (3, _MOST),  # parameter
    ord("Q"): (4, _MOST),  # its default
    ord("A"): (4, 300),  # subscription: instance, number and name of a topic
    ord("R"): (2, 2),  # its end
    ord("D"): (3, _MOST),  # sample
    ord("L"): (9, _MOST),  # text
    ord("C"): (11, _MOST),  # tagged text
    ord("S"): (8, 8),  # synchronisation
    ord("O"): (2, 2),  # dropout
}
_FLAG, _FORMAT, _SUBSCRIBE, _SAMPLE = b"BFAD"
# Wherever a head may begin, overlapping: two bytes of size, a letter.
_ANYWHERE = re.compile(rb"(?s)(?=..[BFIMPQARDLCSO])")
# So many heads in a row are no chance.
_ROW = 3
# A format: a name, then fields.  The topics that matter have some twenty fields; pyulog would make any number.
_FIELDS = re.compile(rb"([\w/\-]+):((?:[\w/\-]+(?:\[\d{1,3}\])? \w+;){1,200})")


@dataclass(slots=True)
class _Excerpt:
    """What of a log matters: messages as they stand in the file."""

    head: bytes = b""
    definitions: list[bytes] = field(default_factory=list)
    samples: list[bytes] = field(default_factory=list)
    formats: dict[str, bytes] = field(default_factory=dict)
    subscribed: dict[int, tuple[int, str]] = field(default_factory=dict)
    unknown: bool = False
    whole_bytes: int = _FILE_HEAD_BYTES


def _excerpt(raw: mmap.mmap, wanted: frozenset[str]) -> _Excerpt:
    """Return the whole messages that define and hold some topics."""
    found = _Excerpt(head=raw[:_FILE_HEAD_BYTES])
    taken: set[int] = set()
    end, at, before = len(raw), _FILE_HEAD_BYTES, _FILE_HEAD_BYTES - 1
    while at < end:
        stop = _stop(raw, at)
        if stop is None:
            # This head is damaged, or the size of the one before it.
            at = _resumed(raw, before + 1, found.subscribed)
            before = at
            continue
        kind = raw[at + 2]
        if kind == _SAMPLE:
            if _number(raw, at) in taken:
                found.samples.append(raw[at:stop])
        elif kind in (_FORMAT, _SUBSCRIBE, _FLAG):
            _define(found, raw[at:stop], kind, wanted, taken)
            found.unknown |= kind == _FLAG and at == _FILE_HEAD_BYTES and _needs_more(raw[at + 3 : stop])
        found.whole_bytes = stop
        before, at = at, stop
    return found


def _stop(raw: mmap.mmap, at: int) -> int | None:
    """Return where the message ends that begins at an offset; None where none can begin."""
    if at + _HEAD.size > len(raw):
        return None
    size, kind = _HEAD.unpack_from(raw, at)
    least, most = _SIZES.get(kind, (1, 0))
    stop: int = at + _HEAD.size + size
    return stop if least <= size <= most and stop <= len(raw) else None


def _number(raw: mmap.mmap, at: int) -> int:
    """Return the number of the topic that a sample is of; -1 at the end of the file."""
    number = raw[at + _HEAD.size : at + _HEAD.size + 2]
    return int.from_bytes(number, "little") if len(number) == 2 else -1


def _resumed(raw: mmap.mmap, start: int, subscribed: dict[int, tuple[int, str]]) -> int:
    """Return the first offset from which messages follow each other again; the end where they do not."""
    for candidate in _ANYWHERE.finditer(raw, start):
        stop: int | None = candidate.start()
        for _ in range(_ROW):
            if stop == len(raw):
                break
            if stop is None or (raw[stop + 2 : stop + 3] == b"D" and _number(raw, stop) not in subscribed):
                stop = None
                break
            stop = _stop(raw, stop)
        if stop is not None:
            return candidate.start()
    return len(raw)


def _define(found: _Excerpt, message: bytes, kind: int, wanted: frozenset[str], taken: set[int]) -> None:
    """Take in a format or a subscription; the first of a name, and of a number, counts."""
    body = message[_HEAD.size :]
    if kind == _FORMAT and (fields := _FIELDS.fullmatch(body)):
        name = fields[1].decode()
        if name not in found.formats:
            found.formats[name] = fields[2]
            if name in wanted:
                found.definitions.append(message)
    elif kind == _SUBSCRIBE:
        instance, number = _SUBSCRIPTION.unpack_from(body)
        name = body[_SUBSCRIPTION.size :].decode(errors="replace")
        if number not in found.subscribed:
            found.subscribed[number] = instance, name
            if name in wanted and name in found.formats:
                found.definitions.append(message)
                taken.add(number)


def _needs_more(flags: bytes) -> bool:
    """Return whether a log asks for abilities that pyulog lacks; appended data, the first bit, it has."""
    _, incompatible = _FLAGS.unpack_from(flags)
    return any(incompatible[1:]) or incompatible[0] > 1
