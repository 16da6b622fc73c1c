"""Tables of other programs as telemetry sources, by a column map.

A `ColumnMap` says which columns of a table hold time, attitude, position and rates, in which units and frames.  It is
one of the ready ones (``assets/columnmaps.toml``), a TOML file, or words such as
``time=t_ms,time_unit=ms,time_epoch=start,roll=phi,pitch=theta,yaw=psi``.
"""

import os
import re
import tomllib
from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass, fields, replace
from functools import cache, cached_property
from math import nan
from os import PathLike
from pathlib import Path
from typing import Any, Literal, Self, get_args, get_origin, get_type_hints

import numpy as np

from glstar.arrays import Float, Mask
from glstar.errors import ConfigError, LogFormatError, reading
from glstar.rotation import conjugate, multiply, quaternion_from_euler
from glstar.sky.place.timescale import GPS_EPOCH_S, WEEK_S, leap_seconds
from glstar.system.resources import asset
from glstar.system.userinput import did_you_mean, nearest_word, read_toml
from glstar.telemetry import source
from glstar.telemetry.tables.files import TABLE_UNIT_TOLERANCE, TableKind, read_table, refuse_other_attitudes
from glstar.telemetry.tables.tableclock import (
    ClockFit,
    clock_boots,
    described_cuts,
    early_remarks,
    first_of_each_time,
    fitted_clock,
    has_whole_seconds,
    left_out_rows,
    most_agree,
    rows_of,
    scale_fault,
    valid_rows,
)

# Size limit of a map, bytes.
_LARGEST_BYTES = 2**20
_ASSET = "columnmaps.toml"

# Units of angles, rad.
_ANGLES_RAD = {"deg": 0.017453292519943295, "rad": 1.0, "decideg": 0.0017453292519943296}

_UNITS_S = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}
_PLACE_RAD = {**_ANGLES_RAD, "1e-7deg": _ANGLES_RAD["deg"] * 1e-7}
_FOOT_M = 0.3048
_YEAR_S = 365.25 * 86400
# Firmware whose blackbox has heights in metres: Betaflight before 4, Cleanflight; the first bytes name it.
_IN_METRES = re.compile(rb"Firmware revision[\"',;\t ]+(Cleanflight|Betaflight [0-3]\.)")
_SETTINGS_BYTES = 1 << 16
# A clock whose rate differs more from that of UTC is reported; crystals differ by up to 50 millionths.
_NOTABLE_RATE = 5e-5

# Rotations between frames: q_world_ned by the axes of the world, and from forward, left, up to forward, right, down.
_HALF = float(np.sqrt(0.5))
_Q_WORLD_NED = {
    "NED": np.array([1.0, 0.0, 0.0, 0.0]),
    "ENU": np.array([0.0, _HALF, _HALF, 0.0]),
    "NWU": np.array([0.0, 1.0, 0.0, 0.0]),
}
_Q_FRD_FLU = np.array([0.0, 1.0, 0.0, 0.0])

Names = tuple[str, ...]
World = Literal["NED", "ENU", "NWU"]
Body = Literal["FRD", "FLU"]


@dataclass(frozen=True, slots=True, kw_only=True)
class ColumnMap:
    """What the columns of a table mean.

    Columns are tuples of alternative names, of which the first one in the table is used; a minus sign before a name
    reverses the sign of its numbers.
    """

    title: str = "table"  # The format, for messages
    names: Names = ()  # Names of the columns of a table without a header
    sign: Names = ()  # Columns by which a table is recognised without ``--columns``
    time: Names = ()  # Time of a row, in `time_unit` since `time_epoch`
    time_unit: Literal["s", "ms", "us", "ns"] = "s"
    # 1970 in UTC; 1980-01-06 in GPS time; the beginning of the GPS week in `gps_week`; any, such as boot.  "auto" is
    # 1970 unless the name of the column says GPS time.
    time_epoch: Literal["auto", "unix", "gps", "week", "start"] = "auto"
    gps_week: Names = ()  # GPS week number, for the epoch "week"
    utc: Names = ()  # UTC of a row, ISO 8601; without `time` it is the time, beside it its readings of UTC
    utc_date: Names = ()  # Its date, if it is in another column
    roll: Names = ()  # Euler angles (yaw, then pitch, then roll) from world to body, in `angle_unit`
    pitch: Names = ()
    yaw: Names = ()
    angle_unit: Literal["deg", "rad", "decideg"] = "deg"
    quaternion: Names = ()  # The four columns w, x, y, z
    quaternion_xyz: Names = ()  # The columns x, y, z, if w >= 0 follows from the unit norm
    quaternion_scale: float = 1.0  # Number of units of a quaternion of norm 1
    # Components of vectors that the quaternion turns: body ones into world ones (ROS, PX4), or the opposite.
    rotates: Literal["body_to_world", "world_to_body"] = "body_to_world"
    # {"NED", "ENU", "NWU"}: axes of the world: north, east, down; east, north, up; north, west, up.
    world: World = "NED"
    body: Body = "FRD"  # {"FRD", "FLU"}: axes of the body: forward, right, down; or forward, left, up
    latitude: Names = ()  # WGS84, in `place_unit`
    longitude: Names = ()
    place_unit: Literal["deg", "rad", "1e-7deg"] = "deg"
    height: Names = ()  # Height in m, ft or dm; the first one in the table is used
    height_ft: Names = ()
    height_dm: Names = ()  # In tenths of a metre
    roll_rate: Names = ()  # Gyro rates about the axes of the body, in `rate_unit`
    pitch_rate: Names = ()
    yaw_rate: Names = ()
    rate_unit: Literal["deg", "rad"] = "deg"  # Per second
    note: str = ""  # A remark for the user

    @classmethod
    def of(cls, keys: Mapping[str, Any], origin: str) -> Self:
        """Return the map of a TOML table whose keys are the names of the attributes; a single column may be a string.

        `origin`: where the keys are from, for messages.  Raises ConfigError if a key or a value is unknown, or keys
        belong together and one is missing.
        """
        hints = get_type_hints(cls)
        attributes = [field.name for field in fields(cls)]
        values: dict[str, Any] = {}
        for key, value in keys.items():
            if key not in hints:
                raise ConfigError(f"{origin}: {key!r} is no key of a column map{did_you_mean(key, attributes)}")
            values[key] = _value(f"{origin}: {key}", hints[key], value)
        columns = cls(**values)
        if fault := columns._fault():
            raise ConfigError(f"{origin}: {fault}")
        return columns

    def _fault(self) -> str:
        """Return which keys are missing; empty if the map is complete."""
        angles = (self.roll, self.pitch, self.yaw)
        rates = (self.roll_rate, self.pitch_rate, self.yaw_rate)
        attitudes = any(angles) + bool(self.quaternion) + bool(self.quaternion_xyz)
        faults = {
            "a column map needs time or utc": not self.time and not self.utc,
            'time_epoch = "week" and gps_week belong together': (self.time_epoch == "week") != bool(self.gps_week),
            "roll, pitch and yaw belong together": any(angles) and not all(angles),
            "attitude twice; give roll, pitch and yaw, or quaternion": attitudes > 1,
            "quaternion must be the four columns w, x, y, z": len(self.quaternion) not in {0, 4},
            "quaternion_xyz must be the three columns x, y, z": len(self.quaternion_xyz) not in {0, 3},
            "latitude and longitude belong together": bool(self.latitude) != bool(self.longitude),
            "roll_rate, pitch_rate and yaw_rate belong together": any(rates) and not all(rates),
        }
        return next((fault for fault, is_there in faults.items() if is_there), "")

    def found(self, alternatives: Names, header: Collection[str]) -> str | None:
        """Return the first of alternative columns, perhaps with a minus sign, that is in a header; None without one."""
        return next((name for name in alternatives if name.removeprefix("-") in header or name in header), None)


def _value(where: str, hint: Any, value: Any) -> Any:
    """Return a value of a map, converted to its type."""
    if hint is float:
        try:
            number = float(value)
        except (TypeError, ValueError, OverflowError):
            number = 0.0
        if not 0 < number < 1e12:
            raise ConfigError(f"{where} must be a positive number, not {value!r:.40}")
        return number
    if hint is str:
        return str(value)
    if get_origin(hint) is Literal:
        choices = get_args(hint)
        if value not in choices:
            raise ConfigError(f"{where} must be one of {', '.join(choices)}, not {value!r}")
        return value
    names = (value,) if isinstance(value, str) else value
    if not isinstance(names, list | tuple) or not names or not all(isinstance(name, str) and name for name in names):
        raise ConfigError(f"{where} must be the name of a column, or a list of names, not {value!r}")
    return tuple(name.strip() for name in names)


@cache
def ready_maps() -> Mapping[str, ColumnMap]:
    """Return the maps of ``assets/columnmaps.toml``, by name."""
    tables = tomllib.loads(asset(_ASSET).read_text(encoding="utf-8"))
    return {name: ColumnMap.of(keys, f"{_ASSET}: {name}") for name, keys in tables.items()}


def ready_map(header: Collection[str]) -> ColumnMap | None:
    """Return the ready map of a table by its header; None if there is none."""
    return next((columns for columns in ready_maps().values() if set(columns.sign) <= set(header)), None)


def is_map_file(text: str) -> bool:
    """Return whether the value of ``--columns`` is the name of a file."""
    return text.lower().endswith(".toml") and "=" not in text


def column_map(text: str) -> ColumnMap:
    """Return the map that ``--columns`` names: a ready one, a TOML file, or ``key=column,key=a|b`` with lists.

    Raises ConfigError if there is no such map, or it is not valid.
    """
    if is_map_file(text):
        with reading(text, ConfigError):
            keys = read_toml(text, _LARGEST_BYTES)
        return ColumnMap.of(keys, text)
    if "=" in text:
        words = (word.partition("=") for word in re.split(r",(?=\w+=)", text))
        return ColumnMap.of({key.strip(): _listed(value) for key, _, value in words}, "columns")
    maps = ready_maps()
    if text not in maps:
        raise ConfigError(
            f"columns: there is no column map {text!r}{did_you_mean(text, maps, or_else='')}; give one of"
            f" {', '.join(maps)}, a .toml file, or key=column,key=column"
        )
    return maps[text]


def _listed(value: str) -> str | list[str]:
    return value.split("|") if "|" in value else value


# glstar's own columns, for tables that are no CSV.
_GLSTAR_MAP = ColumnMap(
    title="table",
    time=("utc_s",),
    time_epoch="unix",
    utc=("utc",),
    roll=("roll_deg",),
    pitch=("pitch_deg",),
    yaw=("yaw_deg",),
    latitude=("latitude_deg",),
    longitude=("longitude_deg",),
    height=("height_m",),
    roll_rate=("roll_rate_deg_per_s",),
    pitch_rate=("pitch_rate_deg_per_s",),
    yaw_rate=("yaw_rate_deg_per_s",),
)
_GLSTAR_QUATERNION = replace(
    _GLSTAR_MAP, roll=(), pitch=(), yaw=(), quaternion=("qw", "qx", "qy", "qz"), rotates="world_to_body"
)


def q_body_ned_of(q: Float, world: str, body: str, rotates: str) -> Float:
    """Return q_body_ned = q_frd_body q_body_world q_world_ned of (n, 4) unit quaternions between other frames.

    `world` {"NED", "ENU", "NWU"}; `body` {"FRD", "FLU"}; `rotates` {"body_to_world", "world_to_body"}: which components
    of vectors `q` turns into which.
    """
    q_body_world = conjugate(q) if rotates == "body_to_world" else q
    turned = multiply(q_body_world, _Q_WORLD_NED[world])
    return multiply(_Q_FRD_FLU, turned) if body == "FLU" else turned


class MappedTableReader(source.TelemetrySource):
    """A table of text, Parquet or Excel as a telemetry source; its clock is the time of its rows.

    `columns` says what its columns mean; by default its header does.  A table has one attitude, ``"auto"``.  Raises
    LogFormatError if the table lacks columns, with the names of similar ones.
    """

    def __init__(
        self,
        path: str | PathLike[str],
        *,
        attitude: str = "auto",
        boot: int | None = None,
        columns: ColumnMap | None = None,
    ) -> None:
        self.name = os.fspath(path)
        refuse_other_attitudes(self.name, attitude)
        self._boot = boot
        self._table = read_table(self.name, () if columns is None else columns.names)
        self._map = columns or self._map_of_header()
        self._check()
        self.one_clock = self._is_utc

    def samples(self) -> Iterator[source.Samples]:
        """Yield attitude, position, UTC and, if the table has them, rates, a batch each for every boot.

        Raises LogFormatError if a cell is invalid, or the table has no such boot.
        """
        q, has_attitude = self._q_body_ned()
        for boot in self.boots():
            rows = self._rows_of(boot)
            if self._is_utc:
                clock_s, clock = self._clock_s, self._utc_clock(rows)
                notes: tuple[str, ...] = ()
                # Attitudes in rows that repeat a time are later than it.
                valid = first_of_each_time(np.where(rows & has_attitude, clock_s, nan))
            else:
                clock_s, clock, notes = self._own_clock(boot)
                valid = rows & has_attitude
            segment = np.zeros(np.count_nonzero(valid), dtype=np.int64)
            notes = (*self._notes(), *notes)
            attitude = source.AttitudeSamples(clock_s[valid], q[valid], segment, self._map.title, notes=notes)
            batches = (attitude, self._positions(clock_s, rows), clock, self._rates(clock_s, rows))
            yield from (replace(batch, boot=boot.number) for batch in batches if batch is not None)

    def boots(self) -> tuple[source.Boot, ...]:
        """Return the boots of the table, or the requested one: its clock steps back, or steps against UTC.

        Raises LogFormatError if the table has no such boot.
        """
        return source.chosen_boots(self.name, self._boots, self._boot)

    @cached_property
    def _boots(self) -> tuple[source.Boot, ...]:
        return clock_boots(self._clock_s, self._clock_s if self._is_utc else self._utc_column)

    def facts(self, boots: Collection[int] = ()) -> source.LogFacts:  # noqa: ARG002 - there is one boot
        """Return the format."""
        suffix = "" if self._table.kind is TableKind.CSV else f" ({self._table.kind})"
        return source.LogFacts(f"{self._map.title}{suffix}")

    def close(self) -> None:
        """Do nothing: the file was read at once."""

    def _map_of_header(self) -> ColumnMap:
        header = set(self._table.columns)
        own = _GLSTAR_QUATERNION if {"qw", "qx"} & header else _GLSTAR_MAP
        columns = own if header & {"utc", "utc_s"} else ready_map(header)
        if columns is None:
            names = ", ".join(list(self._table.columns)[:6])
            hint = "say with --columns what they mean (glstar manual logs)"
            raise LogFormatError(self.name, f"is a table with columns {names}, ...; {hint}")
        return columns

    def _name(self, alternatives: tuple[str, ...]) -> str | None:
        return self._map.found(alternatives, self._table.columns)

    def _require(self, *groups: tuple[str, ...]) -> None:
        for alternatives in groups:
            if alternatives and self._name(alternatives) is None:
                near = nearest_word(alternatives[0], self._table.columns, cutoff=0.5)
                hint = "" if near is None else f" (is it named {near!r}?)"
                raise LogFormatError(self.name, f"has no column {' or '.join(alternatives)}{hint}")

    def _check(self) -> None:
        """Raise an error if the table lacks columns of its map."""
        columns = self._map
        if self._name(columns.time) is None and self._name(columns.utc) is None:
            self._require(columns.time or columns.utc)
        components = [(component,) for component in columns.quaternion + columns.quaternion_xyz]
        attitude = [columns.roll, columns.pitch, columns.yaw, *components]
        if not any(attitude):
            raise LogFormatError(self.name, "has no attitude by this column map; name roll, pitch, yaw or quaternion")
        self._require(columns.gps_week, *attitude)

    @cached_property
    def _clock_s(self) -> Float:
        """Clock of each row, s; UTC unless the epoch is "start"; NaN where it is impossible."""
        return np.where(valid_rows(self._time_s), self._time_s, nan)

    @property
    def _dropped(self) -> int:
        """Number of rows with an impossible time."""
        return int(np.count_nonzero(np.isfinite(self._time_s)) - np.count_nonzero(np.isfinite(self._clock_s)))

    @cached_property
    def _time_s(self) -> Float:
        """Time of each row as in the table, s."""
        wanted, table = self._map, self._table
        name = self._name(wanted.time)
        if name is None:
            return self._plausible(self._utc_column, self._name(wanted.utc) or "")
        time_s = table.numbers(name) * _UNITS_S[wanted.time_unit]
        if wanted.time_epoch == "start":
            odd = np.isfinite(time_s) & (np.abs(time_s) > source.YEAR_2100_S)
            self._reject(odd, name, "is no time since a start; check time_unit and time_epoch")
            return time_s
        if wanted.time_epoch in {"gps", "week"}:
            week = self._name(wanted.gps_week)
            time_s = time_s + GPS_EPOCH_S + (0.0 if week is None else table.numbers(week) * WEEK_S)
            fixed_s = time_s[source.plausible_utc(time_s)]
            if fixed_s.size:
                # Without a fix the week is 0.
                time_s = np.where(time_s < source.YEAR_2010_S, nan, time_s)
            else:
                fixed_s = time_s[np.isfinite(time_s) & (np.abs(time_s) < source.YEAR_2100_S)]
            time_s = time_s - (leap_seconds(float(np.median(fixed_s))) if fixed_s.size else 0.0)
        if fault := scale_fault(table, name, time_s, wanted.time_epoch, self._name(wanted.utc), self._utc_column):
            raise LogFormatError(self.name, fault)
        return self._plausible(time_s, name)

    @cached_property
    def _utc_column(self) -> Float:
        name = self._name(self._map.utc)
        if name is None:
            return np.full(self._table.lines.size, nan)
        utc_s = self._table.times(name, self._name(self._map.utc_date))
        return utc_s if self._is_utc else np.where(utc_s >= source.YEAR_2010_S, utc_s, nan)

    def _plausible(self, utc_s: Float, column: str) -> Float:
        """Return UTC, s since 1970; raises LogFormatError if a row is not from 1970 to 2100."""
        odd = np.isfinite(utc_s) & ~((utc_s >= source.YEAR_2010_S - 40 * 365 * 86400) & (utc_s < source.YEAR_2100_S))
        if odd.any():
            row = int(np.argmax(odd))
            message = f"{utc_s[row]:g} s since 1970 is no UTC of a flight; check time_unit and time_epoch"
            raise self._table.error(row, column, message)
        return utc_s

    def _q_body_ned(self) -> tuple[Float, Mask]:
        """Return attitudes, and which rows have one."""
        wanted, table = self._map, self._table
        if wanted.roll:
            angles = [table.numbers(self._name(names) or "") for names in (wanted.roll, wanted.pitch, wanted.yaw)]
            q = quaternion_from_euler(*(angle * _ANGLES_RAD[wanted.angle_unit] for angle in angles))
            # Euler angles turn the world into the body: q_body_world.
            q_body_ned = q_body_ned_of(q, wanted.world, wanted.body, "world_to_body")
            return q_body_ned, np.asarray(np.isfinite(q_body_ned).all(axis=-1), dtype=bool)
        components = wanted.quaternion or wanted.quaternion_xyz
        q = np.stack([table.numbers(component) for component in components], axis=-1) / wanted.quaternion_scale
        if wanted.quaternion_xyz:
            squared = 1 - (q**2).sum(axis=-1)
            self._reject(squared < -TABLE_UNIT_TOLERANCE, components[0], "begins a quaternion longer than 1")
            q = np.column_stack([np.sqrt(np.clip(squared, 0, None)), q])
        norm = source.quaternion_lengths(q)
        # Many programs write zeros while there is no attitude.
        valid: Mask = np.asarray(np.isfinite(norm) & (norm > 0))
        odd = valid & (np.abs(norm - 1) > TABLE_UNIT_TOLERANCE)
        self._reject(odd, components[0], "begins a quaternion that is not of unit length")
        with np.errstate(invalid="ignore", divide="ignore"):
            q = q / norm[:, np.newaxis]
        return q_body_ned_of(q, wanted.world, wanted.body, wanted.rotates), valid

    def _reject(self, bad: Mask, column: str, why: str) -> None:
        if bad.any():
            row = int(np.argmax(bad))
            raise self._table.error(row, column, f"{self._table.columns[column.removeprefix('-')][row]} {why}")

    def _positions(self, clock_s: Float, rows: Mask) -> source.Samples:
        wanted, table = self._map, self._table
        names = self._name(wanted.latitude), self._name(wanted.longitude)
        if names[0] is None or names[1] is None:
            return source.no_position_samples("it has no columns with latitude and longitude")
        scale = np.rad2deg(_PLACE_RAD[wanted.place_unit])
        latitude_deg, longitude_deg = (table.numbers(name) * scale for name in names if name is not None)
        height_m = np.zeros(latitude_deg.size)
        tenth_m = 1.0 if wanted.height_dm and self._is_old_blackbox else 0.1
        for alternatives, unit_m in ((wanted.height, 1.0), (wanted.height_ft, _FOOT_M), (wanted.height_dm, tenth_m)):
            if (name := self._name(alternatives)) is not None:
                height_m = np.nan_to_num(table.numbers(name) * unit_m)
                break
        longitude_deg = np.where(longitude_deg > 180, longitude_deg - 360, longitude_deg)
        samples = source.position_samples(
            clock_s[rows], latitude_deg[rows], longitude_deg[rows], height_m[rows], self._map.title
        )
        return samples if samples.clock_s.size else source.no_position_samples("latitude and longitude are empty or 0")

    @cached_property
    def _is_old_blackbox(self) -> bool:
        """Whether the settings above the header name a firmware whose heights are in metres."""
        with Path(self.name).open("rb") as file:
            return _IN_METRES.search(file.read(_SETTINGS_BYTES)) is not None

    @property
    def _is_utc(self) -> bool:
        """Whether the clock of the table is UTC."""
        return self._map.time_epoch != "start" or self._name(self._map.time) is None

    def _utc_clock(self, rows: Mask) -> source.ClockSamples:
        """Return UTC readings of a boot whose clock is UTC."""
        clock_s = self._clock_s[rows]
        if self._map.time_epoch in {"gps", "week"} and clock_s.size and np.median(clock_s) < source.YEAR_2010_S:
            year = 1970 + int(np.median(clock_s) / _YEAR_S)
            return source.no_clock_samples(f"its GPS time says {year}: the receiver's week has rolled over")
        return source.ClockSamples(clock_s, clock_s, self._map.title)

    @cached_property
    def _fits(self) -> dict[int, ClockFit]:
        """UTC of each boot by its own clock, by its number."""
        inside = {boot.number: self._rows_of(boot) for boot in self._boots}
        return {n: fitted_clock(self._clock_s[rows], self._utc_column[rows]) for n, rows in inside.items()}

    def _rows_of(self, boot: source.Boot) -> Mask:
        return rows_of(boot, self._clock_s.size) & np.isfinite(self._clock_s)

    def _own_clock(self, boot: source.Boot) -> tuple[Float, source.ClockSamples, tuple[str, ...]]:
        """Return the clock at the rate of UTC, the readings of UTC of a boot, and remarks on them."""
        fit, inside = self._fits[boot.number], self._rows_of(boot)
        if fit.reason:
            return self._clock_s, source.no_clock_samples(fit.reason), ()
        if not most_agree([*self._fits.values()]):
            return self._clock_s, source.no_clock_samples("most of its cells of UTC disagree with its clock"), ()
        clock_s = fit.at_rate_of_utc(self._clock_s)
        notes = [described_cuts(fit, self._table.lines[inside])] if fit.cut.size else []
        if has_whole_seconds(fit.utc_s):
            notes.append("its UTC has whole seconds: the time of an attitude is uncertain by one sample interval")
        if abs(fit.rate) > _NOTABLE_RATE:
            notes.append(f"its clock gains {-1e6 * fit.rate:.0f} millionths on its UTC, which the times follow")
        clock = source.ClockSamples(
            clock_s[inside][fit.rows],
            fit.utc_s,
            f"{self._map.title}, {self._name(self._map.utc)}",
            utc_minus_clock_s=fit.utc_minus_clock_s,
            cut=fit.cut.size,
        )
        return clock_s, clock, tuple(notes)

    def _notes(self) -> tuple[str, ...]:
        notes = [self._map.note] if self._map.note else []
        if self._is_utc and self._name(self._map.time) is not None:
            notes += early_remarks(self._clock_s, self._map.time_epoch)
        if (name := self._name(self._map.height_dm)) is not None and self._name(self._map.height) is None:
            unit = "metres, as its firmware writes" if self._is_old_blackbox else "tenths of a metre"
            notes.append(f"{name} has no unit and is taken in {unit}")
        if dropped := self._dropped:
            notes.append(left_out_rows(dropped))
        return tuple(notes)

    def _rates(self, clock_s: Float, rows: Mask) -> source.RateSamples | None:
        wanted = self._map
        alternatives = (wanted.roll_rate, wanted.pitch_rate, wanted.yaw_rate)
        names = [name for axis in alternatives if (name := self._name(axis)) is not None]
        if len(names) < 3:
            return None
        rate = np.stack([self._table.numbers(name) for name in names], axis=-1) * _ANGLES_RAD[wanted.rate_unit]
        if wanted.body == "FLU":
            rate = rate * np.array([1.0, -1.0, -1.0])
        valid = np.isfinite(rate).all(axis=-1) & rows & source.valid_rates(rate)
        return source.RateSamples(clock_s[valid], rate[valid], self._map.title)
