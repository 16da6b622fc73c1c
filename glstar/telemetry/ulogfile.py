"""The topics of a ULog file, or of the CSV files that ulog2csv writes of it.

A log is a sequence of messages, each with a size, a letter and a body.  Definitions come first: ``F`` defines the
fields of a topic, ``A`` assigns a number to a topic, ``I`` is information about the log.  Then come samples (``D``).
pyulog decodes the complete messages of one topic at a time, on first use, because with a damaged file it may never
finish.
"""

import io
import mmap
import os
import re
import struct
from abc import abstractmethod
from array import array
from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from copy import copy
from dataclasses import dataclass, field, replace
from itertools import pairwise
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from glstar.arrays import Float, Integer
from glstar.errors import LogFormatError
from glstar.telemetry.boots import within
from glstar.telemetry.source import Span, suppressed_output
from glstar.telemetry.tables.files import Dump, dump_separator


class Topics(Protocol):
    """Topics by name: the instances of each, and the columns of each instance."""

    # Facts about the autopilot: ``sys_name``, ``ver_sw``, ``ver_sw_release``, ``ver_hw``, ``boot_time_utc_us``.
    about: Mapping[str, str | int]
    whole_bytes: int  # End of the last complete message in the file
    unread_bytes: int  # Bytes of the file that belong to no message

    @property
    @abstractmethod
    def names(self) -> list[str]:
        """The names of all topics, sorted."""

    @abstractmethod
    def count(self, name: str) -> int:
        """Return the number of samples of a topic, of all instances together; 0 if it was not logged."""

    @abstractmethod
    def __getitem__(self, name: str) -> list[tuple[int, dict[str, Float]]]:
        """Return the instances of a topic, sorted by number; none if it was not logged."""

    @abstractmethod
    def with_quaternion(self) -> list[str]:
        """Return the names of all topics with a quaternion."""

    @abstractmethod
    def lack(self, *names: str) -> str:
        """Return that the log has none of some topics, for messages."""

    @abstractmethod
    def extent(self) -> str:
        """Return how much of the file could be read, for messages; empty if all of it."""

    def messages(self) -> list[tuple[float, str]]:
        """Return the logged messages: time since boot, s, and text."""
        return []

    @abstractmethod
    def stamps(self, name: str) -> list[tuple[Integer, Float]]:
        """Return file positions and times, s since boot, of the samples of each instance of a topic."""

    @property
    def start(self) -> int:
        """Offset of the log in the file."""
        return 0

    @abstractmethod
    def only(self, spans: Sequence[Span]) -> "Topics":
        """Return the samples within some ranges of positions, as topics."""


class LogTopics(Topics):
    """The topics of the log between two offsets of a ULog file; see `joined_logs`.

    Raises LogFormatError if the file ends within its head, or is a newer version of ULog.
    """

    def __init__(self, path: str, start: int = 0, stop: int | None = None) -> None:
        self._path = path
        self._start = start
        with Path(path).open("rb") as file:
            self._file_bytes = os.fstat(file.fileno()).st_size
            if self._file_bytes < _FILE_HEAD_BYTES:
                raise LogFormatError(
                    path, f"the log is cut off in its head: {self._file_bytes} bytes; copy it again", offset=0
                )
            with mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as raw:
                self._index = _index(raw, start, len(raw) if stop is None else stop)
        if self._index.unknown:
            raise LogFormatError(path, "is a newer kind of ULog, which pyulog does not know", offset=_FILE_HEAD_BYTES)
        self.whole_bytes = self._index.whole_bytes
        self.unread_bytes = self._index.unread_bytes
        self.about = self._index.about
        self._numbers: dict[str, list[int]] = defaultdict(list)
        for number, (_, name) in self._index.subscribed.items():
            self._numbers[name].append(number)
        self._decoded: dict[str, list[tuple[int, dict[str, Float]]]] = {}

    @property
    def names(self) -> list[str]:
        """The names of all topics in the log, sorted."""
        return sorted(self._numbers)

    def count(self, name: str) -> int:
        """Return the number of samples of a topic."""
        return sum(len(self._index.samples.get(number, ())) for number in self._numbers.get(name, ()))

    def __getitem__(self, name: str) -> list[tuple[int, dict[str, Float]]]:
        """Return the instances of a topic; none if it was not logged, or its definition is damaged."""
        if name not in self._decoded:
            topics = self._decode(name) if name in self._index.formats and self.count(name) else []
            instances = [(topic.multi_id, _columns(topic.data)) for topic in topics if topic.name == name]
            self._decoded[name] = [(number, columns) for number, columns in instances if "timestamp" in columns]
        return self._decoded[name]

    def with_quaternion(self) -> list[str]:
        """Return the names of all topics with a quaternion."""
        formats = self._index.formats
        return [name for name in self.names if name in formats and b"float[4] q;" in formats[name]]

    def stamps(self, name: str) -> list[tuple[Integer, Float]]:
        """Return file positions and times, s since boot, of the samples of each instance of a topic."""
        raw = np.memmap(self._path, dtype=np.uint8, mode="r")
        stamps = []
        for number in self._numbers.get(name, ()):
            at = np.array(self._index.samples.get(number, ()), dtype=np.int64)
            # Every sample begins with its timestamp, microseconds in 64 bits.
            at = at[at + _SAMPLE_HEAD.size + 8 <= raw.size]
            bodies = raw[at[:, np.newaxis] + _SAMPLE_HEAD.size + np.arange(8)]
            stamps.append((at, np.ascontiguousarray(bodies).view("<u8")[:, 0] * 1e-6))
        return stamps

    def messages(self) -> list[tuple[float, str]]:
        """Return the logged messages in the order of the file: time since boot, s, and text."""
        return [(clock_s, text) for _, clock_s, text in self._index.messages]

    @property
    def start(self) -> int:
        """Offset of the log in the file, bytes."""
        return self._start

    def only(self, spans: Sequence[Span]) -> "LogTopics":
        """Return the samples within some ranges of positions, as topics."""
        samples = {}
        for number, starts in self._index.samples.items():
            at = np.array(starts, dtype=np.int64)
            samples[number] = array("Q", at[within(at, spans)].tolist())
        messages = [message for message in self._index.messages if within(np.array(message[:1]), spans)[0]]
        selected = copy(self)
        selected._index = replace(self._index, samples=samples, messages=messages)  # noqa: SLF001 - of its own class
        selected._decoded = {}  # noqa: SLF001 - of its own class
        return selected

    def extent(self) -> str:
        """Return how much of the file could be read, for messages; empty if all of it."""
        is_complete = self.whole_bytes == self._file_bytes
        return "" if is_complete else f" in {self.whole_bytes} whole bytes of {self._file_bytes}"

    def lack(self, *names: str) -> str:
        """Return that the log has none of some topics, for messages."""
        return f"it has neither {' nor '.join(names)}" if len(names) > 1 else f"it has no {names[0]}"

    def _decode(self, name: str) -> list[Any]:
        """Decode one topic with pyulog, imported on first use."""
        index = self._index
        with Path(self._path).open("rb") as file, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as raw:
            parts = [raw[:_FILE_HEAD_BYTES], index.formats[name]]
            parts += [index.subscriptions[number] for number in self._numbers[name]]
            starts = sorted(at for number in self._numbers[name] for at in index.samples.get(number, ()))
            parts += [raw[at : at + _HEAD.size + _HEAD.unpack_from(raw, at)[0]] for at in starts]
        with suppressed_output():
            from pyulog import ULog  # noqa: PLC0415 - when a topic is decoded

            try:
                topics: list[Any] = ULog(io.BytesIO(b"".join(parts))).data_list
            except Exception:  # of damaged data pyulog raises any exception: RecursionError, KeyError, ...
                return []
        return topics


def _columns(fields: dict[str, NDArray[Any]]) -> dict[str, Float]:
    with np.errstate(invalid="ignore"):  # damaged floats may be signalling NaNs
        return {name: column.astype(np.float64) for name, column in fields.items()}


# --- the messages of the file -----------------------------------------------------------------------------------------

_FILE_HEAD_BYTES = 16
_FILE_HEAD = re.compile(rb"ULog\x01\x12\x35")
_HEAD, _SAMPLE_HEAD = struct.Struct("<HB"), struct.Struct("<HBH")
_LEAST_SAMPLE = 3
_SUBSCRIPTION = struct.Struct("<BH")
_FLAGS = struct.Struct("<8s8s")

# Smallest and largest size of each kind of message, bytes.
_MOST = 0xFFFF
_SIZES = {
    ord("B"): (16, 100),  # flags
    ord("F"): (3, _MOST),  # format
    ord("I"): (3, _MOST),  # information
    ord("M"): (4, _MOST),  # information in parts
    ord("P"): (3, _MOST),  # parameter
    ord("Q"): (4, _MOST),  # its default
    ord("A"): (4, 300),  # subscription: instance, number and name of a topic
    ord("R"): (2, 2),  # end of a subscription
    ord("D"): (_LEAST_SAMPLE, _MOST),  # sample: number of a topic, and its fields
    ord("L"): (9, _MOST),  # text
    ord("C"): (11, _MOST),  # tagged text
    ord("S"): (8, 8),  # synchronisation
    ord("O"): (2, 2),  # dropout
}
_FLAG, _FORMAT, _SUBSCRIBE, _SAMPLE, _INFORMATION = b"BFADI"
_DEFINING = frozenset(b"BFAI")
# Texts: level, tag of the one kind, and time since boot, us; the text follows.
_MESSAGES = {ord("L"): struct.Struct("<BQ"), ord("C"): struct.Struct("<BHQ")}
# The letter of a message, after two bytes with its size.
_LETTER = re.compile(rb"[BFIMPQARDLCSO]")
# After damage the next message is searched in pieces of this size; pieces of zeros are skipped, as in a file whose end
# was never written.
_PIECE_BYTES = 1 << 20
# Number of consecutive messages that are not there by chance.
_ROW = 3
# A format: a name and its fields, at most 200; the topics that glstar reads have about twenty.
_FIELDS = re.compile(rb"([\w/\-]+):((?:[\w/\-]+(?:\[\d{1,3}\])? \w+;){1,200})")

# Information messages about the autopilot: text or a number.
_FACT = re.compile(rb"(char\[\d{1,3}\]|uint32_t|u?int64_t) (sys_name|ver_sw|ver_sw_release|ver_hw|boot_time_utc_us)")
_NUMBER_BYTES = {b"uint32_t": 4, b"uint64_t": 8, b"int64_t": 8}


@dataclass(slots=True)
class _Index:
    """Definitions of a log, and the offsets of its samples."""

    formats: dict[str, bytes] = field(default_factory=dict)  # By the name of the topic
    subscriptions: dict[int, bytes] = field(default_factory=dict)  # By number
    subscribed: dict[int, tuple[int, str]] = field(default_factory=dict)  # Instance and name of the topic, by number
    samples: dict[int, "array[int]"] = field(default_factory=dict)  # Offsets of the samples, by number
    about: dict[str, str | int] = field(default_factory=dict)  # Facts about the autopilot
    messages: list[tuple[int, float, str]] = field(default_factory=list)  # Offset, time since boot, s, and text
    unknown: bool = False  # Whether it has features that pyulog lacks
    whole_bytes: int = _FILE_HEAD_BYTES
    unread_bytes: int = 0


def joined_logs(path: str) -> list[tuple[int, int]]:
    """Return begin and end of each log in a file, bytes; logs that were joined have a head each."""
    with Path(path).open("rb") as file:
        if os.fstat(file.fileno()).st_size < _FILE_HEAD_BYTES:
            return [(0, _FILE_HEAD_BYTES)]
        with mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as raw:
            heads = [head.start() for head in _FILE_HEAD.finditer(raw)]
            # A head is followed by a message or the end of the file.
            begins = [at for at in heads if at > 0 and _stop(raw, at + _FILE_HEAD_BYTES, len(raw)) is not None]
            return list(pairwise([0, *begins, len(raw)]))


def _index(raw: mmap.mmap, start: int, end: int) -> _Index:
    """Return definitions and samples of the log between two offsets of a file."""
    index = _Index(whole_bytes=start + _FILE_HEAD_BYTES)
    samples: defaultdict[int, array[int]] = defaultdict(lambda: array("Q"))
    at, before = start + _FILE_HEAD_BYTES, start + _FILE_HEAD_BYTES - 1
    while at < end:
        # Most messages are valid samples: they are handled first.
        size, kind, number = _SAMPLE_HEAD.unpack_from(raw, at) if at + _SAMPLE_HEAD.size <= end else (0, 0, 0)
        stop = at + _HEAD.size + size
        if kind == _SAMPLE and size >= _LEAST_SAMPLE and stop <= end:
            samples[number].append(at)
        elif (end_of_message := _stop(raw, at, end)) is not None:
            stop, kind = end_of_message, raw[at + 2]
            if kind in _MESSAGES:
                body = raw[at + _HEAD.size : stop]
                clock_us = _MESSAGES[kind].unpack_from(body)[-1]
                text = body[_MESSAGES[kind].size :].decode(errors="replace")
                index.messages.append((at, clock_us * 1e-6, text))
            elif kind in _DEFINING:
                _define(index, raw[at:stop], kind)
                index.unknown |= kind == _FLAG and at == start + _FILE_HEAD_BYTES and _needs_more(raw[at + 3 : stop])
        else:
            # This message is damaged, or the size of the previous one.
            resumed = _resumed(raw, before + 1, end, index.subscribed)
            index.unread_bytes += max(resumed - at, 0)
            at = before = resumed
            continue
        index.whole_bytes = stop
        before, at = at, stop
    index.samples = samples
    return index


def _stop(raw: mmap.mmap, at: int, end: int) -> int | None:
    """Return the end of the message that begins at an offset; None if there is no message."""
    if at + _HEAD.size > end:
        return None
    size, kind = _HEAD.unpack_from(raw, at)
    least, most = _SIZES.get(kind, (1, 0))
    stop: int = at + _HEAD.size + size
    return stop if least <= size <= most and stop <= end else None


def _number(raw: mmap.mmap, at: int) -> int:
    """Return the topic number of a sample; -1 at the end of the file."""
    number = raw[at + _HEAD.size : at + _HEAD.size + 2]
    return int.from_bytes(number, "little") if len(number) == 2 else -1


def _resumed(raw: mmap.mmap, start: int, end: int, subscribed: dict[int, tuple[int, str]]) -> int:
    """Return the next offset at which a sequence of messages begins; the end if there is none."""
    for letter in _letters(raw, start + _HEAD.size - 1, end):
        candidate = letter - _HEAD.size + 1
        stop: int | None = candidate
        for _ in range(_ROW):
            if stop == end:
                break
            if stop is None or (raw[stop + 2 : stop + 3] == b"D" and _number(raw, stop) not in subscribed):
                stop = None
                break
            stop = _stop(raw, stop, end)
        if stop is not None:
            return candidate
    return end


def _letters(raw: mmap.mmap, start: int, end: int) -> Iterator[int]:
    """Yield the offsets of letters of messages."""
    zeros = bytes(_PIECE_BYTES)
    for at in range(start, end, _PIECE_BYTES):
        stop = min(at + _PIECE_BYTES, end)
        if raw[at:stop] != zeros[: stop - at]:
            yield from (letter.start() for letter in _LETTER.finditer(raw, at, stop))


def _define(index: _Index, message: bytes, kind: int) -> None:
    """Add a format, a subscription or a fact; the first one of each name or number is used."""
    body = message[_HEAD.size :]
    if kind == _FORMAT and (fields := _FIELDS.fullmatch(body)):
        index.formats.setdefault(fields[1].decode(), message)
    elif kind == _SUBSCRIBE:
        instance, number = _SUBSCRIPTION.unpack_from(body)
        if number not in index.subscribed:
            index.subscribed[number] = instance, body[_SUBSCRIPTION.size :].decode(errors="replace")
            index.subscriptions[number] = message
    elif kind == _INFORMATION and (fact := _FACT.fullmatch(body[1 : 1 + body[0]])):
        value, name = body[1 + body[0] :], fact[2].decode()
        if fact[1] not in _NUMBER_BYTES:
            text = "".join(filter(str.isprintable, value.decode(errors="replace")))
            index.about.setdefault(name, text.strip())
        elif len(value) == _NUMBER_BYTES[fact[1]]:
            index.about.setdefault(name, int.from_bytes(value, "little", signed=fact[1] == b"int64_t"))


def _needs_more(flags: bytes) -> bool:
    """Return whether a log has incompatible features that pyulog lacks; it supports the first bit, appended data."""
    _, incompatible = _FLAGS.unpack_from(flags)
    return any(incompatible[1:]) or incompatible[0] > 1


_TOPICS = (
    r"(?:vehicle|estimator|external_ins)_attitude(?:_groundtruth)?|vehicle_global_position|vehicle_gps_position"
    r"|sensor_gps|vehicle_angular_velocity|sensor_combined|sensor_gyro|vehicle_status|camera_capture|camera_trigger"
)
_FILE = re.compile(rf"(?P<log>.*)_(?P<topic>{_TOPICS})_(?P<instance>\d{{1,3}})\.csv", re.DOTALL | re.IGNORECASE)
_QUATERNION = "q[0]"
_UNNAMED = "vehicle_attitude"


class CsvTopics(Topics):
    """The topics of a log, one file each."""

    whole_bytes = unread_bytes = 0

    def __init__(self, path: str) -> None:
        self._path = Path(path)
        self.about: Mapping[str, str | int] = {}
        named = _FILE.fullmatch(self._path.name)
        self._log = named["log"] if named else None
        self.own = (named["topic"].lower(), int(named["instance"])) if named else (_UNNAMED, 0)
        self._read: dict[str, list[tuple[int, dict[str, Float]]]] = {}
        # Remarks on files in the directory that are left out.
        self.left_out: list[str] = []
        self._files: dict[tuple[str, int], Path] = {self.own: self._path}
        for beside in self._path.parent.iterdir() if named else ():
            other = _FILE.fullmatch(beside.name)
            if other and other["log"] == self._log:
                self._files.setdefault((other["topic"].lower(), int(other["instance"])), beside)
        self.own_quaternion = _QUATERNION in _fields(self._path)

    @property
    def names(self) -> list[str]:
        """The names of all topics with a file, sorted."""
        return sorted({topic for topic, _ in self._files})

    def count(self, name: str) -> int:
        """Return the number of samples of a topic."""
        return sum(columns["timestamp"].size for _, columns in self[name])

    def __getitem__(self, name: str) -> list[tuple[int, dict[str, Float]]]:
        """Return the instances of a topic, sorted by number."""
        if name not in self._read:
            instances = sorted(instance for topic, instance in self._files if topic == name)
            dumps = [(instance, self._columns(self._files[name, instance])) for instance in instances]
            self._read[name] = [(instance, columns) for instance, columns in dumps if "timestamp" in columns]
        return self._read[name]

    def with_quaternion(self) -> list[str]:
        """Return the names of all topics with a quaternion."""
        return sorted({topic for (topic, _), file in self._files.items() if _QUATERNION in _fields(file)})

    def extent(self) -> str:
        """Return an empty message: a truncated table cannot be distinguished from a complete one."""
        return ""

    def lack(self, *names: str) -> str:
        """Return which files are missing, for messages."""
        if self._log is None:
            return f"the name of the file should be LOG_{_UNNAMED}_0.csv, as ulog2csv wrote it, to find those beside it"
        files = [f"{self._log}_{name}_0.csv" for name in names]
        return f"neither {' nor '.join(files)} lies beside it" if len(files) > 1 else f"no {files[0]} lies beside it"

    def stamps(self, name: str) -> list[tuple[Integer, Float]]:
        """Return row numbers and times, s since boot, of each instance of a topic."""
        return [(np.arange(columns["timestamp"].size), columns["timestamp"] * 1e-6) for _, columns in self[name]]

    def only(self, spans: Sequence[Span]) -> Topics:
        """Return all topics: files of several boots are rejected."""
        del spans
        return self

    def _columns(self, file: Path) -> dict[str, Float]:
        """Return the columns of a file; none if it is another file in the directory and cannot be read."""
        try:
            return Dump(str(file)).columns
        except OSError as error:
            reason = error.strerror or str(error)
        except LogFormatError as error:
            reason = error.reason
        if file == self._path:
            raise LogFormatError(file, f"cannot be read: {reason}")
        self.left_out.append(f"{file.name} beside it is left out: {reason}")
        return {}


def _fields(file: Path) -> list[str]:
    """Return the names of the columns of a file; none if it is not text."""
    try:
        with file.open(encoding="utf-8-sig") as text:
            header = text.readline(1 << 16).strip()
    except (OSError, UnicodeDecodeError):
        return []
    return header.split(dump_separator(str(file)))
