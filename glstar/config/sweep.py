"""``[sweep]``: the settings that vary within a data set."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from datetime import datetime
from itertools import chain
from math import asin, degrees, exp, isfinite, log, prod, radians, sin
from types import UnionType
from typing import Annotated, Any, Literal, Self, TypeGuard, Union, get_args, get_origin

import numpy as np
from numpy.typing import NDArray

from glstar.config.keys import SECTIONS, Fault, key_text, shown, split_key
from glstar.sky.place.timescale import format_utc, parse_utc
from glstar.system.userinput import did_you_mean

# Larger data sets are taken for a mistake: a year of rendering on 100 processors, and every sample needs memory.
MAX_SAMPLES = 10_000_000
# Larger counts are not written out in messages.
_UNREADABLE = 10**18

# A flag of `glstar export` rather than a key: start of the exposures, s from the first attitude.
START = "start_s"
# Keys of reading the log, which do not vary within a flight.
_READING_KEYS = (
    "flight.attitude",
    "flight.sysid",
    "flight.vehicle",
    "flight.boot",
    "flight.max_gap_s",
    "flight.interpolation",
    "navigator.attitude",
)
# Keys whose values are times.
_TIMES = ("flight.utc_start", "flight.synthetic.utc_start")
_RANGE_KEYS = {"min", "max", "log", "sine"}


@dataclass(frozen=True, slots=True)
class Axis:
    """One key that varies."""

    key: str  # dotted key, such as ``"exposure.duration_s"``
    values: tuple[Any, ...] = ()  # the values in turn; empty for a random range
    least: float = 0.0  # lower bound of the random range; times in UTC seconds since 1970
    most: float = 0.0  # upper bound of the random range
    log: bool = False  # whether its logarithm is distributed uniformly
    kind: str = "float"  # type of the random values: "float", "int" or "utc"
    # Whether its sine is distributed uniformly: latitudes and altitudes in degrees, uniform over the sphere
    sine: bool = False

    def drawn(self, chance: NDArray[np.float64]) -> list[Any]:
        """Return random values of uniform random numbers in [0, 1), (n,); times are ISO 8601 strings."""
        if self.kind == "int":
            whole: list[Any] = np.floor(self.least + chance * (self.most - self.least + 1)).astype(np.int64).tolist()
            return whole
        if self.log:
            return [exp(value) for value in (log(self.least) + chance * log(self.most / self.least)).tolist()]
        if self.sine:
            low, high = sin(radians(self.least)), sin(radians(self.most))
            return [degrees(asin(value)) for value in (low + chance * (high - low)).tolist()]
        values: list[Any] = (self.least + chance * (self.most - self.least)).tolist()
        return [format_utc(value) for value in values] if self.kind == "utc" else values

    @property
    def ends(self) -> tuple[Any, ...]:
        """All values, or the bounds of a range: if they are valid, so are the values between."""
        if self.values:
            return self.values
        ends = (self.least, self.most)
        if self.kind == "float":
            return ends
        return tuple(map(format_utc if self.kind == "utc" else round, ends))


@dataclass(frozen=True, slots=True)
class Sweep:
    """Varying settings: all combinations of the lists, each with several random draws of the ranges."""

    axes: tuple[Axis, ...] = ()
    draws: int = 1  # number of draws per combination
    seed: int = 0  # seed of the random draws

    def __len__(self) -> int:
        return self.combinations * self.draws

    @property
    def combinations(self) -> int:
        """Number of combinations of the lists."""
        return prod(len(axis.values) for axis in self.axes if axis.values)

    def __bool__(self) -> bool:
        return bool(self.axes) or self.draws > 1

    def sample(self, number: int, *, salt: int = 0) -> dict[str, Any]:
        """Return the settings of one sample, by dotted key, which depend on seed, salt and number only.

        `number`: index of the sample; draws vary fastest, then the last list; `salt`: another stream of draws, such as
        the index of a flight in the data set.
        """
        return {axis.key: self._values(axis, number, 1, salt)[0] for axis in self.axes}

    def column(self, key: str, *, salt: int = 0) -> list[Any]:
        """Return the values of the key of an axis in all samples, much faster than `sample` for each."""
        [axis] = [axis for axis in self.axes if axis.key == key]
        parts = (self._values(axis, first, self.draws, salt) for first in range(0, len(self), self.draws))
        return list(chain.from_iterable(parts))

    def _values(self, axis: Axis, number: int, count: int, salt: int) -> list[Any]:
        """Return the values of an axis in consecutive samples of one combination."""
        combination, draw = divmod(number, self.draws)
        if axis.values:
            later = self.axes[self.axes.index(axis) + 1 :]
            turn = combination // prod(len(other.values) for other in later if other.values)
            return [axis.values[turn % len(axis.values)]] * count
        # Each axis and combination has its own random stream, and each draw takes one number from it.
        stream = np.random.PCG64([self.seed, salt, combination, self.axes.index(axis)])
        return axis.drawn(np.random.Generator(stream.advance(draw)).random(count))

    def extremes(self) -> Iterator[dict[str, Any]]:
        """Yield settings that contain every value of a list and both bounds of every range."""
        usual = {axis.key: axis.ends[0] for axis in self.axes}
        for axis in self.axes:
            for value in axis.ends:
                yield usual | {axis.key: value}

    def as_json(self) -> dict[str, Any]:
        """Return the sweep, ready for JSON."""
        varies: dict[str, Any] = {
            axis.key: list(axis.values)
            or {"min": axis.ends[0], "max": axis.ends[1], "log": axis.log} | ({"sine": True} if axis.sine else {})
            for axis in self.axes
        }
        return {"draws": self.draws, "seed": self.seed, "varies": varies}

    @classmethod
    def of(cls, table: object, faults: list[Fault]) -> Self:
        """Return the sweep of the value of ``sweep`` in a TOML file, and append its errors to a list."""
        if not isinstance(table, Mapping):
            faults.append(("sweep", f"must be a section, [sweep] with keys below it, not {shown(table)}"))
            return cls()
        counts = {"draws": 1, "seed": 0}
        axes: list[Axis] = []
        for name, value in table.items():
            if name in counts:
                if isinstance(value, bool) or not isinstance(value, int) or value < (name == "draws"):
                    least = "1" if name == "draws" else "0"
                    faults.append((f"sweep.{name}", f"must be a whole number, {least} or more, not {shown(value)}"))
                else:
                    counts[name] = value
            elif name == START:
                axes.extend(_axis(START, value, faults))
            elif name in SECTIONS and isinstance(value, Mapping):
                for key, varied in _with_dotted_keys(name, value):
                    axes.extend(_axis(key, varied, faults))
            else:
                faults.append((f"sweep.{key_text(name)}", f"cannot vary{did_you_mean(name, _names())}"))
        sweep = cls(tuple(axes), counts["draws"], counts["seed"])
        samples = sweep.combinations * sweep.draws
        if samples > MAX_SAMPLES:
            size = f"has {samples:,} samples" if samples < _UNREADABLE else "has too many samples"
            faults.append(("sweep", f"{size}; the limit is {MAX_SAMPLES:,}: use fewer draws or shorter lists"))
            return cls()
        return sweep


def _with_dotted_keys(name: str, table: Mapping[str, Any]) -> Iterator[tuple[str, Any]]:
    """Yield the dotted keys of a section and of the sections inside it."""
    for key, varied in table.items():
        dotted = f"{name}.{key}"
        if dotted in SECTIONS and isinstance(varied, Mapping):
            yield from _with_dotted_keys(dotted, varied)
        else:
            yield dotted, varied


def _names() -> list[str]:
    every = [f"{name}.{key}" for name, model in SECTIONS.items() for key in model.model_fields]
    return ["draws", "seed", START, *(name for name in every if name not in _READING_KEYS)]


def _axis(key: str, value: object, faults: list[Fault]) -> Iterator[Axis]:
    """Yield the axis of a key, or append an error."""
    fault = f"sweep.{key_text(key)}"
    if key not in _names():
        faults.append((fault, f"cannot vary{did_you_mean(key, _names(), or_else='')}"))
    elif isinstance(value, list) and value:
        if key == START and (wrong := [item for item in value if not _is_number(item)]):
            faults.append((fault, f"must be numbers of seconds, not {shown(wrong[0])}"))
            return
        yield Axis(key, tuple(item.isoformat() if isinstance(item, datetime) else item for item in value))
    elif isinstance(value, Mapping) and {"min", "max"} <= value.keys() <= _RANGE_KEYS:
        yield from _range(key, value, faults)
    else:
        message = f"must be a list, such as [1, 2], or a range, {{ min = 1, max = 2 }}, not {shown(value)}"
        faults.append((fault, message))


def _range(key: str, value: Mapping[str, Any], faults: list[Fault]) -> Iterator[Axis]:
    kind = _kind(key)
    is_log, is_sine = value.get("log", False), value.get("sine", False)
    try:
        least, most = (parse_utc(_text(value[end])) if kind == "utc" else _number(value[end]) for end in ("min", "max"))
    except ValueError as error:
        faults.append((f"sweep.{key}", f"is not a range: {error}"))
        return
    if kind == "other":
        faults.append((f"sweep.{key}", "is not a number and takes no range; give a list"))
    elif not least <= most or is_log not in (True, False) or (is_log and (least <= 0 or kind != "float")):
        needs = "max must be at least min, and log = true needs positive numbers and a key that is not an integer"
        faults.append((f"sweep.{key}", f"is not a range: {needs}"))
    elif is_sine not in (True, False) or (is_sine and not (key.endswith("_deg") and -90 <= least <= most <= 90)):
        needs = "sine = true needs an angle in degrees from -90 to 90, such as a latitude"
        faults.append((f"sweep.{key}", f"is not a range: {needs}"))
    elif is_sine and is_log:
        faults.append((f"sweep.{key}", "is not a range: log and sine exclude each other"))
    else:
        yield Axis(key, (), least, most, is_log, kind, is_sine)


def _kind(key: str) -> str:
    """Return the type of a key's values."""
    if key == START:
        return "float"
    if key in _TIMES:
        return "utc"
    section, name = split_key(key)
    annotation: Any = SECTIONS[section].model_fields[name].annotation
    kinds = set(get_args(annotation)) - {type(None)} if get_origin(annotation) in {UnionType, Union} else {annotation}
    # A number with limits, perhaps beside names.
    kinds = {get_args(kind)[0] if get_origin(kind) is Annotated else kind for kind in kinds}
    kinds = {str if get_origin(kind) is Literal and len(kinds) > 1 else kind for kind in kinds}
    if kinds in ({float}, {float, str}):
        return "float"
    return "int" if kinds == {int} else "other"


def _is_number(value: object) -> TypeGuard[float]:
    return not isinstance(value, bool) and isinstance(value, int | float) and isfinite(value)


def _number(value: object) -> float:
    if not _is_number(value):
        raise ValueError(f"{shown(value)} is not a number")
    return float(value)


def _text(value: object) -> str:
    return value.isoformat() if isinstance(value, datetime) else str(value)
