"""ArduPilot's DataFlash logs (``.BIN``): which attitude, which place, which UTC.

A log is a row of records, each ``A3 95 type`` and a body whose layout a FMT record of the same file has told; pymavlink
knows what the letters of a layout mean.  What glstar reads of them:

==========  ==================================================  =========================================
message     fields                                              used for
==========  ==================================================  =========================================
XKQ, NKQ    C (lane), Q1..Q4, body to NED                       attitude, where logged
XKF4, NKF4  PI, the lane that flies the aircraft                which lane counts when
ATT         Roll, Pitch, Yaw, rounded to 0.01 deg               attitude, where there is no XKQ
POS         Lat, Lng, Alt                                       place
GPS         GWk, GMS (week, ms), Status, Lat, Lng, Alt, I, U    UTC; place, where there is no POS
GPA         SMS, boot time of a GPS sample, ms                  UTC without the lag of logging
==========  ==================================================  =========================================

XKQ is the attitude of the autopilot's board, ATT that of the aircraft: they differ by AHRS_TRIM.  AHR2 is the backup
estimator, many degrees off in yaw at times; it is read only when named.  Heights are above mean sea level.
"""

import io
import os
import re
import struct
from collections.abc import Callable, Iterator
from contextlib import redirect_stderr, redirect_stdout
from dataclasses import dataclass
from functools import lru_cache
from os import PathLike
from typing import Any

import numpy as np
from numpy.typing import NDArray

from glstar.errors import LogFormatError
from glstar.rotation import conjugate, multiply, quaternion_from_euler
from glstar.telemetry.quiet import quiet
from glstar.telemetry.sound import UNIT_TOLERANCE, YEAR_2010_S, YEAR_2100_S, no_places, places, sound_times
from glstar.telemetry.source import AttitudeSamples, ClockSamples, PositionSamples, Samples, TelemetrySource
from glstar.timescale import tai_minus_utc_s

__all__ = ["DATAFLASH_MAGIC", "DataFlashReader"]

DATAFLASH_MAGIC = b"\xa3\x95\x80"

Float = NDArray[np.float64]
Integer = NDArray[np.int64]

_HEAD1, _HEAD2, _FMT = DATAFLASH_MAGIC
_FMT_LAYOUT = struct.Struct("<BB4s16s64s")  # type, length, name, layout, columns
_HEAD_BYTES = 3

_GPS_EPOCH_S = 315964800.0  # 1980-01-06, unix seconds
_WEEK_S = 604800.0
_TAI_MINUS_GPS_S = 19.0
_FIX_3D = 3

# The EKF's quaternions: EKF3's, and those of EKF2 before it.
_OF_LANES = ("XKQ", "NKQ")
# GPS records are written so long after the moment that they tell: 16 to 30 ms in the mean of logs with GPA, 21 ms by
# SYSTEM_TIME in the telemetry log of the Adelaide flight.
_LOGGED_LATE_S = 0.020
# A GPA record belongs to the GPS record of the same receiver that was written in the same breath.
_SAME_BREATH_S = 0.05
# All lanes are logged alike.  One with so small a part of the samples of another is a damaged number.
_RARE = 0.01


class DataFlashReader(TelemetrySource):
    """A DataFlash log as a telemetry source; its clock is the autopilot's time since boot.

    Damage is passed over: of a log that is cut off, or has bad bytes in it, every whole record counts.

    Parameters
    ----------
    path : path-like
        The log.
    attitude : str
        ``"auto"``: the EKF lane that flew the aircraft, else ATT.  Or a message by name, ``"ATT"``, ``"AHR2"``,
        ``"SIM"``, and one lane of it as ``"XKQ1"`` or ``"XKQ[1]"``.

    Raises
    ------
    LogFormatError
        If the file holds no whole record.
    """

    def __init__(self, path: str | PathLike[str], *, attitude: str = "auto") -> None:
        self.name = os.fspath(path)
        self._attitude = attitude
        self._log = _Records(self.name)

    def samples(self) -> Iterator[Samples]:
        """Yield the attitude, the places and the UTC of the whole log, a batch each.

        Raises
        ------
        LogFormatError
            If the log has no attitude, or not the one that was asked for.
        """
        yield self._attitudes()
        yield _positions(self._log)
        yield _utc(self._log)

    def close(self) -> None:
        """Let go of the file."""
        self._log.close()

    def _attitudes(self) -> AttitudeSamples:
        if self._attitude.lower() == "auto":
            # AEKF says which EKF feeds ATT: 2 where NKQ, an older filter that may run beside, is the one that flies.
            in_use = self._log.columns("ATT", "AEKF")
            older_first = in_use is not None and in_use[0].size > 0 and np.median(in_use[0]) == 2
            for name in (*(reversed(_OF_LANES) if older_first else _OF_LANES), "ATT"):
                if (estimate := _Estimate.of(self._log, name)) is not None:
                    return estimate.primary(self._log)
            raise self._error(f"the log has no attitude: {self._what_it_holds()}")

        name, lane = self._attitude.upper(), None
        estimate = _Estimate.of(self._log, name)
        if estimate is None and (asked := re.fullmatch(r"(.+?)(?:(\d)|\[(\d+)\])", name)):
            estimate, lane = _Estimate.of(self._log, asked[1]), int(asked[2] or asked[3])
        if estimate is None or (lane is not None and lane not in estimate.lanes):
            offered = [estimate.summary() for estimate in _estimates(self._log)]
            if not offered:
                raise self._error(f"the log has no attitude: {self._what_it_holds()}")
            raise self._error(f"the log has no attitude {self._attitude!r}; it has {'; '.join(offered)}")
        return estimate.primary(self._log) if lane is None else estimate.only(lane)

    def _what_it_holds(self) -> str:
        if any("TimeMS" in self._log.fields(name) for name in self._log.names):
            return "its records are stamped with TimeMS (ArduPilot before 2015), which glstar does not read yet"
        cut = "" if self._log.whole_bytes == self._log.file_bytes else f" in {self._log.extent()}"
        return f"no XKQ, NKQ or ATT among the messages {', '.join(self._log.names)}{cut}"

    def _error(self, message: str) -> LogFormatError:
        return LogFormatError(self.name, message, offset=self._log.whole_bytes)


@dataclass(frozen=True, slots=True, eq=False)
class _Estimate:
    """All that one message says about attitude: times, quaternions, and the lane of each."""

    name: str
    clock_s: Float
    q_body_ned: Float
    lane: Integer

    @classmethod
    def of(cls, log: "_Records", name: str) -> "_Estimate | None":
        """Return what a message says, without what no aircraft can have meant; None where nothing is left."""
        # Until 2020 each lane had a message of its own: XKQ1 was lane 0, XKQ2 lane 1.
        spellings = [(name, None)] if name in log else [(f"{name}{lane + 1}", lane) for lane in range(3)]
        parts = [part for spelling, lane in spellings if (part := cls._read(log, spelling, lane)) is not None]
        if not parts:
            return None
        clock_s, q, lanes = (np.concatenate(column) for column in zip(*parts, strict=True))
        return cls(name, clock_s, q, lanes) if clock_s.size else None

    @staticmethod
    def _read(log: "_Records", name: str, lane: int | None) -> tuple[Float, Float, Integer] | None:
        if (quaternion := log.columns(name, "TimeUS", "Q1", "Q2", "Q3", "Q4")) is not None:
            clock_us, *components = quaternion
            q = conjugate(np.stack(components, axis=-1))
        elif (angles := log.columns(name, "TimeUS", "Roll", "Pitch", "Yaw")) is not None:
            clock_us, *euler_deg = angles
            q = quaternion_from_euler(*np.deg2rad(euler_deg))
        else:
            return None
        lanes = _numbered(log, name, "C") if lane is None else np.full(clock_us.size, lane)
        clock_s = clock_us * 1e-6

        sound = np.abs(np.linalg.norm(q, axis=-1) - 1) < UNIT_TOLERANCE  # False for NaN too
        found, count = np.unique(lanes, return_counts=True)
        sound &= np.isin(lanes, found[count >= _RARE * np.max(count, initial=0)])
        for one in found:
            mine = np.flatnonzero(lanes == one)
            sound[mine[~sound_times(clock_s[mine])]] = False
            if name[:3] in _OF_LANES:
                # An EKF logs (1, 0, 0, 0) until it has found out where down and north are.
                aligned = (q[mine] != (1.0, 0.0, 0.0, 0.0)).any(axis=-1)
                sound[mine[: np.argmax(aligned) if aligned.any() else None]] = False
        return clock_s[sound], q[sound], lanes[sound]

    @property
    def lanes(self) -> list[int]:
        """The lanes there are, rising."""
        return [int(lane) for lane in np.unique(self.lane)]

    def only(self, lane: int, why: str = "") -> AttitudeSamples:
        """Return one lane from beginning to end."""
        return self._samples(self.lane == lane, f"{self.name} lane {lane}{why}")

    def primary(self, log: "_Records") -> AttitudeSamples:
        """Return the lane that flew the aircraft, whichever it was at each time."""
        deciding = f"{self.name[:2]}F4"
        if len(self.lanes) == 1:
            only = f" lane {self.lanes[0]}" if self.name[:3] in _OF_LANES else ""
            return self._samples(np.ones(self.lane.size, dtype=bool), f"{self.name}{only}")
        decided = log.columns(deciding, "TimeUS", "PI")
        if decided is not None and decided[0].size:
            order = np.argsort(decided[0], kind="stable")
            since_s, lane = decided[0][order] * 1e-6, decided[1][order]
            flew = self.lane == lane[(np.searchsorted(since_s, self.clock_s, side="right") - 1).clip(min=0)]
            if np.count_nonzero(flew) >= 2:
                lanes = [int(lane) for lane in np.unique(self.lane[flew])]
                return self._samples(flew, f"{self.name} lane {_and(lanes)} by {deciding}.PI")
        return self._nearest_to_att(log)

    def _nearest_to_att(self, log: "_Records") -> AttitudeSamples:
        """Return the lane that agrees best with ATT, which is always of the lane that flies."""
        att = _Estimate.of(log, "ATT")
        if att is None:  # then nothing tells them apart
            return self.only(self.lanes[0], f", the lowest of {_and(self.lanes)}")

        def deviation_deg(lane: int) -> float:
            mine = self.lane == lane
            near = _nearest(att.clock_s, self.clock_s[mine])
            turn = multiply(self.q_body_ned[mine], conjugate(att.q_body_ned[near]))
            angle_rad = 2 * np.arctan2(np.linalg.norm(turn[:, 1:], axis=-1), np.abs(turn[:, 0]))
            # No finer than ATT is written: lanes as near as that are equals, and of equals the first one counts.
            return round(float(np.rad2deg(np.median(angle_rad))), 2)

        return self.only(min(self.lanes, key=deviation_deg), ", nearest to ATT")

    def summary(self) -> str:
        """Return the name, the lanes and the rate, for a list to choose from."""
        lanes = self.lanes
        clock_s = np.unique(self.clock_s[self.lane == lanes[0]])
        rate = f" {1 / np.median(np.diff(clock_s)):.1f} Hz" if clock_s.size > 1 else " once"
        return self.name + (f" lane {_and(lanes)}" if len(lanes) > 1 else "") + rate

    def _samples(self, which: NDArray[np.bool_], source: str) -> AttitudeSamples:
        return AttitudeSamples(self.clock_s[which], self.q_body_ned[which], self.lane[which], source)


def _estimates(log: "_Records") -> Iterator[_Estimate]:
    """Yield every attitude that the log has."""
    for name in log.names:
        if (estimate := _Estimate.of(log, name)) is not None:
            yield estimate


def _positions(log: "_Records") -> PositionSamples:
    names = ("TimeUS", "Lat", "Lng", "Alt")
    if (columns := log.columns("POS", *names)) is not None and (known := _places(columns, "POS")).clock_s.size:
        return known
    if "GPS" not in log:
        return no_places("it has neither POS nor GPS records")
    if (fixes := _fixes(log, *names)) is not None and (known := _places(fixes[1], "GPS")).clock_s.size:
        return known
    return no_places("its GPS never had a 3D fix")


def _places(columns: list[Float], source: str) -> PositionSamples:
    clock_us, latitude_deg, longitude_deg, height_m = columns
    return places(clock_us * 1e-6, latitude_deg, longitude_deg, height_m, source)


def _utc(log: "_Records") -> ClockSamples:
    nothing = np.empty(0)
    if "GPS" not in log:
        return ClockSamples(nothing, nothing, "it has no GPS records")
    fixes = _fixes(log, "TimeUS", "GWk", "GMS")
    if fixes is None:
        return ClockSamples(nothing, nothing, "its GPS records have no week and milliseconds (GWk, GMS)")
    receiver, (clock_us, week, week_ms) = fixes
    fixed = week > 0
    if not fixed.any():
        return ClockSamples(nothing, nothing, "its GPS never had a 3D fix and a week")

    gps_s = _GPS_EPOCH_S + week * _WEEK_S + week_ms * 1e-3
    believable = fixed & (gps_s >= YEAR_2010_S) & (gps_s < YEAR_2100_S)
    if not believable.any():
        odd = f"its GPS says week {np.median(week[fixed]):.0f}, {1980 + np.median(week[fixed]) / 52.18:.0f}"
        return ClockSamples(nothing, nothing, f"{odd}: the receiver's week has rolled over")
    clock_s, gps_s = clock_us[believable] * 1e-6, gps_s[believable]
    sampled_s = _sampled_s(log, receiver, clock_s)
    if np.isfinite(sampled_s).any():
        stamped, how = np.isfinite(sampled_s), "GPS time at GPA.SMS"
        clock_s, gps_s = sampled_s[stamped], gps_s[stamped]
    else:
        clock_s, how = clock_s - _LOGGED_LATE_S, "GPS time when logged (no GPA)"
    leap_s = _leap_seconds(float(np.median(gps_s)))
    return ClockSamples(clock_s, gps_s - leap_s, f"{how}, {gps_s.size} fixes, {leap_s:.0f} leap seconds")


def _leap_seconds(gps_s: float) -> float:
    """Return GPS time - UTC at a GPS time, s."""
    return tai_minus_utc_s(gps_s - (tai_minus_utc_s(gps_s) - _TAI_MINUS_GPS_S)) - _TAI_MINUS_GPS_S


def _fixes(log: "_Records", *names: str) -> tuple[int, list[Float]] | None:
    """Return the number of the GPS receiver in use, and columns of those of its records that have a 3D fix."""
    columns = log.columns("GPS", "TimeUS", "Status", *names)
    if columns is None:
        return None
    receivers, in_use = _numbered(log, "GPS", "I"), log.columns("GPS", "U")
    fixed = columns[1] >= _FIX_3D
    if in_use is not None and (fixed & (in_use[0] == 1)).any():
        fixed &= in_use[0] == 1
    found, count = np.unique(receivers[fixed], return_counts=True)
    receiver = int(found[count.argmax()]) if found.size else 0
    fixed &= (receivers == receiver) & sound_times(columns[0] * 1e-6)
    return receiver, [column[fixed] for column in columns[2:]]


def _numbered(log: "_Records", name: str, field: str) -> Integer:
    """Return which lane or receiver each record is of; older logs number the messages instead (XKQ2, GPS2)."""
    number = log.columns(name, field)
    with np.errstate(invalid="ignore"):
        return np.zeros(log.count(name), dtype=np.int64) if number is None else number[0].astype(np.int64)


def _sampled_s(log: "_Records", receiver: int, clock_s: Float) -> Float:
    """Return when the samples were taken whose GPS records were written then, s since boot; NaN where GPA is silent."""
    sampled_s = np.full(clock_s.size, np.nan)
    if (accuracy := log.columns("GPA", "TimeUS", "SMS")) is None:
        return sampled_s
    told = (accuracy[1] > 0) & (_numbered(log, "GPA", "I") == receiver)
    written_s, sms_s = accuracy[0][told] * 1e-6, accuracy[1][told] * 1e-3
    if written_s.size:
        near = _nearest(written_s, clock_s)
        together = np.abs(written_s[near] - clock_s) < _SAME_BREATH_S
        sampled_s[together] = sms_s[near][together]
    return sampled_s


def _nearest(times_s: Float, asked_s: Float) -> Integer:
    """Return the index of the time nearest to each one asked for."""
    order = np.argsort(times_s, kind="stable")
    rising = times_s[order]
    after = np.searchsorted(rising, asked_s).clip(max=rising.size - 1)
    before = (after - 1).clip(min=0)
    return order[np.where(asked_s - rising[before] <= rising[after] - asked_s, before, after)]


def _and(lanes: list[int]) -> str:
    return " and ".join(str(lane) for lane in lanes)


class _Records:
    """The records of a DataFlash file as columns, one array a field."""

    def __init__(self, path: str) -> None:
        self._raw: NDArray[np.uint8] = np.asarray(np.memmap(path, dtype=np.uint8, mode="r"))
        self.file_bytes = int(self._raw.size)
        heads = np.flatnonzero(self._raw[:-2] == _HEAD1)
        heads = heads[self._raw[heads + 1] == _HEAD2]
        kinds = self._raw[heads + 2]
        self._formats = self._definitions(heads[kinds == _FMT])
        lengths = np.zeros(256, dtype=np.int64)
        for kind, layout in self._formats.items():
            lengths[kind] = layout.length
        offsets, kinds = _whole(heads, kinds, lengths[kinds], self.file_bytes)
        self.whole_bytes = int(np.max(offsets + lengths[kinds], initial=0))
        # Later definitions of a name count, as in pymavlink.
        named = {layout.name: kind for kind, layout in self._formats.items()}
        self._offsets = {name: at for name, kind in named.items() if (at := offsets[kinds == kind]).size}
        self._kinds = {name: named[name] for name in self._offsets}
        if not self._offsets:
            raise LogFormatError(
                path, f"no whole record in {self.file_bytes} bytes: the log is cut off or damaged", offset=0
            )

    @property
    def names(self) -> list[str]:
        return sorted(self._offsets)

    def __contains__(self, name: str) -> bool:
        return name in self._offsets

    def count(self, name: str) -> int:
        return int(self._offsets[name].size)

    def extent(self) -> str:
        return f"{self.whole_bytes} whole bytes of {self.file_bytes}"

    def fields(self, name: str) -> tuple[str, ...]:
        """Return the field names of a message, none where the log does not have it."""
        return self._formats[self._kinds[name]].dtype.names or () if name in self else ()

    def columns(self, name: str, *fields: str) -> list[Float] | None:
        """Return fields of every record of a message, scaled; None where the log does not have them all."""
        if not set(fields) <= set(self.fields(name)) or name not in self:
            return None
        layout = self._formats[self._kinds[name]]
        bodies = np.lib.stride_tricks.sliding_window_view(self._raw, layout.length)[self._offsets[name]]
        records = np.ascontiguousarray(bodies[:, _HEAD_BYTES:]).view(layout.dtype)[:, 0]
        if any(records.dtype[field].kind not in "iuf" for field in fields):
            return None
        with np.errstate(invalid="ignore"):  # damaged floats may be signalling NaNs
            return [records[field].astype(np.float64) / layout.divisors.get(field, 1.0) for field in fields]

    def close(self) -> None:
        self._raw = np.empty(0, dtype=np.uint8)

    def _definitions(self, heads: Integer) -> dict[int, "_Layout"]:
        formats: dict[int, _Layout] = {}
        for head in heads:
            body = self._raw[head + _HEAD_BYTES : head + _HEAD_BYTES + _FMT_LAYOUT.size].tobytes()
            if len(body) == _FMT_LAYOUT.size and (layout := _Layout.of(body)) is not None:
                formats[body[0]] = layout
        return formats


def _whole(heads: Integer, kinds: NDArray[np.uint8], lengths: Integer, file_bytes: int) -> tuple[Integer, NDArray[Any]]:
    """Return the offsets and kinds of the heads that begin a whole record.

    The head's two bytes also turn up inside of records, and the file may be damaged anywhere.  So a head counts where
    a record can be: another one ends just before it, or begins just after it.  From there records follow each other,
    and what begins inside of one is none.
    """
    ends = heads + lengths
    known = (lengths > 0) & (ends <= file_bytes)
    # Of what follows the last record a byte or two may be all there is.
    linked = known & (_among(ends, heads) | (ends > file_bytes - 2) | _among(heads, np.sort(ends[known])))
    heads, kinds, ends = heads[linked], kinds[linked], ends[linked]

    record = np.ones(heads.size, dtype=bool)
    for index in np.flatnonzero(heads[1:] < ends[:-1]):
        if record[index]:
            record[index + 1 : np.searchsorted(heads, ends[index])] = False
    return heads[record], kinds[record]


def _among(values: Integer, rising: Integer) -> NDArray[np.bool_]:
    """Return which values occur in a rising array."""
    found: NDArray[np.bool_] = np.append(rising, -1)[np.searchsorted(rising, values)] == values
    return found


@dataclass(frozen=True, slots=True)
class _Layout:
    """How the records of one message lie in the file, as their FMT record tells."""

    name: str
    length: int
    dtype: np.dtype[np.void]
    divisors: dict[str, float]

    @classmethod
    def of(cls, body: bytes) -> "_Layout | None":
        """Return the layout of a FMT record, None where it makes no sense."""
        kind, length, *texts = _FMT_LAYOUT.unpack(body)
        read = _dataflash_format()
        try:
            name, letters, fields = (text.split(b"\0")[0].decode("ascii") for text in texts)
            form = read(kind, name, length, letters, fields)
        except Exception:  # pymavlink raises no less: a damaged definition, and what it defines is unknown
            return None
        # struct says 16s and B where NumPy says S16 and <B.
        codes = [f"S{size}" if size else f"<{code}" for size, code in re.findall(r"(\d*)(\w)", form.msg_struct[1:])]
        if len(codes) != len(form.columns) or len(set(form.columns)) != len(codes) or "" in form.columns:
            return None
        dtype = np.dtype(list(zip(form.columns, codes, strict=True)))
        if not name.isalnum() or dtype.itemsize + _HEAD_BYTES != length:
            return None
        # Divided by 1e7, not multiplied by 1e-7: the nearest float64 to what was meant, as in pymavlink.
        divisors = {c: float(round(1 / m)) for c, m in zip(form.columns, form.msg_mults, strict=True) if m}
        return cls(name, length, dtype, divisors)


@lru_cache(maxsize=1)
def _dataflash_format() -> Callable[..., Any]:
    """Return pymavlink's reading of FMT records, imported on first use."""
    with quiet():
        from pymavlink.DFReader import DFFormat  # noqa: PLC0415

    def silent(*fields: Any) -> Any:
        # It prints what it does not understand.
        with redirect_stdout(io.StringIO()), redirect_stderr(io.StringIO()):
            return DFFormat(*fields)

    return silent
