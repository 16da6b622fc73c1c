"""Column maps: which columns of a table hold time, attitude, position and rates, in which units and frames.

A map is one of the ready ones (``assets/columnmaps.toml``), a TOML file, or words such as
``time=t_ms,time_unit=ms,time_epoch=start,roll=phi,pitch=theta,yaw=psi``.
"""

import re
import tomllib
from collections.abc import Collection, Mapping
from dataclasses import dataclass, fields
from functools import cache
from typing import Any, Final, Literal, Self, get_args, get_origin, get_type_hints

from glstar.errors import ConfigError
from glstar.system.inputfile import read_text
from glstar.system.nearmiss import did_you_mean
from glstar.system.resources import asset

__all__ = ["ANGLES_RAD", "ColumnMap", "column_map", "is_map_file", "ready_map", "ready_maps"]

# Size limit of a map, bytes.
_LARGEST_BYTES: Final = 2**20
_ASSET: Final = "columnmaps.toml"

# Units of angles, rad.
ANGLES_RAD: Final = {"deg": 0.017453292519943295, "rad": 1.0, "decideg": 0.0017453292519943296}

Names = tuple[str, ...]
World = Literal["NED", "ENU", "NWU"]
Body = Literal["FRD", "FLU"]


@dataclass(frozen=True, slots=True, kw_only=True)
class ColumnMap:
    """What the columns of a table mean.

    Columns are tuples of alternative names, of which the first one in the table is used; a minus sign before a
    name reverses the sign of its numbers.

    Attributes
    ----------
    title : str
        The format, for messages.
    names : tuple of str
        Names of the columns of a table without a header.
    sign : tuple of str
        Columns by which a table is recognised without ``--columns``.
    time : tuple of str
        Time of a row, in `time_unit` since `time_epoch`.
    time_unit : {"s", "ms", "us", "ns"}
    time_epoch : {"unix", "gps", "week", "start"}
        1970 in UTC; 1980-01-06 in GPS time; the beginning of the GPS week in `gps_week`; any, such as boot.
    gps_week : tuple of str
        GPS week number, for the epoch "week".
    utc : tuple of str
        UTC of a row, ISO 8601; without `time` it is the time, beside it its readings of UTC.
    utc_date : tuple of str
        Its date, if it is in another column.
    roll, pitch, yaw : tuple of str
        Euler angles (yaw, then pitch, then roll) from world to body, in `angle_unit`.
    angle_unit : {"deg", "rad", "decideg"}
    quaternion : tuple of str
        The four columns w, x, y, z.
    quaternion_xyz : tuple of str
        The columns x, y, z, if w >= 0 follows from the unit norm.
    quaternion_scale : float
        Number of units of a quaternion of norm 1.
    rotates : {"body_to_world", "world_to_body"}
        Components of vectors that the quaternion turns: body ones into world ones (ROS, PX4), or the opposite.
    world : {"NED", "ENU", "NWU"}
        Axes of the world: north, east, down; east, north, up; north, west, up.
    body : {"FRD", "FLU"}
        Axes of the body: forward, right, down; or forward, left, up.
    latitude, longitude : tuple of str
        WGS84, in `place_unit`.
    place_unit : {"deg", "rad", "1e-7deg"}
    height, height_ft : tuple of str
        Height in m or in ft; the first one in the table is used.
    roll_rate, pitch_rate, yaw_rate : tuple of str
        Gyro rates about the axes of the body, in `rate_unit`.
    rate_unit : {"deg", "rad"}
        Per second.
    note : str
        A remark for the user.
    """

    title: str = "table"
    names: Names = ()
    sign: Names = ()
    time: Names = ()
    time_unit: Literal["s", "ms", "us", "ns"] = "s"
    time_epoch: Literal["unix", "gps", "week", "start"] = "unix"
    gps_week: Names = ()
    utc: Names = ()
    utc_date: Names = ()
    roll: Names = ()
    pitch: Names = ()
    yaw: Names = ()
    angle_unit: Literal["deg", "rad", "decideg"] = "deg"
    quaternion: Names = ()
    quaternion_xyz: Names = ()
    quaternion_scale: float = 1.0
    rotates: Literal["body_to_world", "world_to_body"] = "body_to_world"
    world: World = "NED"
    body: Body = "FRD"
    latitude: Names = ()
    longitude: Names = ()
    place_unit: Literal["deg", "rad", "1e-7deg"] = "deg"
    height: Names = ()
    height_ft: Names = ()
    roll_rate: Names = ()
    pitch_rate: Names = ()
    yaw_rate: Names = ()
    rate_unit: Literal["deg", "rad"] = "deg"
    note: str = ""

    @classmethod
    def of(cls, keys: Mapping[str, Any], source: str) -> Self:
        """Return the map of a TOML table.

        Parameters
        ----------
        keys : mapping of str to object
            Keys by the names of the attributes; a single column may be a string.
        source : str
            Where they are from, for messages.

        Returns
        -------
        ColumnMap

        Raises
        ------
        ConfigError
            If a key or a value is unknown, or keys belong together and one is missing.
        """
        hints = get_type_hints(cls)
        known = [field.name for field in fields(cls)]
        values: dict[str, Any] = {}
        for key, value in keys.items():
            if key not in hints:
                raise ConfigError(f"{source}: {key!r} is no key of a column map{did_you_mean(key, known)}")
            values[key] = _value(f"{source}: {key}", hints[key], value)
        made = cls(**values)
        if fault := made._fault():
            raise ConfigError(f"{source}: {fault}")
        return made

    def _fault(self) -> str:
        """Return which keys are missing; empty if the map is complete."""
        angles, rates = (self.roll, self.pitch, self.yaw), (self.roll_rate, self.pitch_rate, self.yaw_rate)
        faults = {
            "a column map needs time or utc": not self.time and not self.utc,
            'time_epoch = "week" and gps_week belong together': (self.time_epoch == "week") != bool(self.gps_week),
            "roll, pitch and yaw belong together": any(angles) and not all(angles),
            "attitude twice; give roll, pitch and yaw, or quaternion": any(angles)
            + bool(self.quaternion)
            + bool(self.quaternion_xyz)
            > 1,
            "quaternion must be the four columns w, x, y, z": len(self.quaternion) not in {0, 4},
            "quaternion_xyz must be the three columns x, y, z": len(self.quaternion_xyz) not in {0, 3},
            "latitude and longitude belong together": bool(self.latitude) != bool(self.longitude),
            "roll_rate, pitch_rate and yaw_rate belong together": any(rates) and not all(rates),
        }
        return next((fault for fault, is_there in faults.items() if is_there), "")

    def found(self, alternatives: Names, header: Collection[str]) -> str | None:
        """Return the first of some alternative columns that a table has, perhaps with a minus sign; None without one.

        Parameters
        ----------
        alternatives : tuple of str
        header : collection of str
            Columns of the table.

        Returns
        -------
        str or None
        """
        return next((name for name in alternatives if name.removeprefix("-") in header or name in header), None)


def _value(where: str, hint: Any, given: Any) -> Any:
    """Return a value of a map, converted to its type."""
    if hint is float:
        try:
            number = float(given)
        except (TypeError, ValueError):
            number = 0.0
        if not 0 < number < 1e12:
            raise ConfigError(f"{where} must be a positive number, not {given!r}")
        return number
    if hint is str:
        return str(given)
    if get_origin(hint) is Literal:
        choices = get_args(hint)
        if given not in choices:
            raise ConfigError(f"{where} must be one of {', '.join(choices)}, not {given!r}")
        return given
    names = (given,) if isinstance(given, str) else given
    if not isinstance(names, list | tuple) or not names or not all(isinstance(name, str) and name for name in names):
        raise ConfigError(f"{where} must be the name of a column, or a list of names, not {given!r}")
    return tuple(name.strip() for name in names)


@cache
def ready_maps() -> Mapping[str, ColumnMap]:
    """Return the maps of ``assets/columnmaps.toml``, by name.

    Returns
    -------
    mapping of str to ColumnMap
    """
    tables = tomllib.loads(asset(_ASSET).read_text(encoding="utf-8"))
    return {name: ColumnMap.of(keys, f"{_ASSET}: {name}") for name, keys in tables.items()}


def ready_map(header: Collection[str]) -> ColumnMap | None:
    """Return the ready map of a table by its header.

    Parameters
    ----------
    header : collection of str

    Returns
    -------
    ColumnMap or None
        None if the table is none of these.
    """
    return next((one for one in ready_maps().values() if set(one.sign) <= set(header)), None)


def is_map_file(text: str) -> bool:
    """Return whether the value of ``--columns`` is the name of a file.

    Parameters
    ----------
    text : str

    Returns
    -------
    bool
    """
    return text.lower().endswith(".toml") and "=" not in text


def column_map(text: str) -> ColumnMap:
    """Return the map that ``--columns`` names.

    Parameters
    ----------
    text : str
        Name of a ready map, path of a TOML file, or words ``key=column``, joined by commas; ``a|b`` is a list.

    Returns
    -------
    ColumnMap

    Raises
    ------
    ConfigError
        If there is no such map, or it is not valid.
    """
    if is_map_file(text):
        try:
            keys = tomllib.loads(read_text(text, _LARGEST_BYTES))
        except tomllib.TOMLDecodeError as error:
            raise ConfigError(f"{text}: {error} (TOML)") from None
        except ValueError as error:
            raise ConfigError(f"{text}: {error}") from None
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
