"""``[sweep]``: what varies from one part of a data set to the next."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from datetime import datetime
from itertools import chain
from math import exp, isfinite, log, prod
from types import UnionType
from typing import Any, Final, Self, TypeGuard, get_args

import numpy as np
from numpy.typing import NDArray

from glstar.config.sections import SECTIONS
from glstar.config.validation import Fault, did_you_mean, key_text, shown
from glstar.sky.timescale import format_utc, parse_utc

__all__ = ["MOST_SAMPLES", "START", "Axis", "Sweep"]

# A data set of more samples is a slip of the finger: a year of drawing on a hundred processors, and each takes memory.
MOST_SAMPLES: Final = 10_000_000
_UNREADABLE: Final = 10**18

# Not a key of the config but a flag: where in the flight the exposures begin, s from its first attitude.
START: Final = "start_s"
# How the log is read cannot vary within it.
_OF_THE_READING: Final = (
    "flight.attitude",
    "flight.sysid",
    "flight.boot",
    "flight.max_gap_s",
    "flight.interpolation",
)
_OF_A_RANGE: Final = {"min", "max", "log"}


@dataclass(frozen=True, slots=True)
class Axis:
    """One key that varies.

    Attributes
    ----------
    key : str
        Dotted, as ``"exposure.duration_s"``.
    values : tuple
        What it is in turn; empty where it is drawn at random.
    least, most : float
        Between what it is drawn; times in UTC seconds since 1970.
    log : bool
        Whether its logarithm is drawn evenly, instead of itself.
    kind : {"float", "int", "utc"}
        What is drawn.
    """

    key: str
    values: tuple[Any, ...] = ()
    least: float = 0.0
    most: float = 0.0
    log: bool = False
    kind: str = "float"

    def drawn(self, chance: NDArray[np.float64]) -> list[Any]:
        """Return random values.

        Parameters
        ----------
        chance : (n,) float64
            From 0 to 1, without 1.

        Returns
        -------
        list of float, int or str
            A time is written out.
        """
        if self.kind == "int":
            whole: list[Any] = np.floor(self.least + chance * (self.most - self.least + 1)).astype(np.int64).tolist()
            return whole
        if self.log:
            return [exp(value) for value in (log(self.least) + chance * log(self.most / self.least)).tolist()]
        values: list[Any] = (self.least + chance * (self.most - self.least)).tolist()
        return [format_utc(value) for value in values] if self.kind == "utc" else values

    @property
    def ends(self) -> tuple[Any, ...]:
        """All its values, or the two between which it is drawn: if they can be meant, so can the others."""
        if self.values:
            return self.values
        ends = (self.least, self.most)
        return (
            tuple(map(format_utc, ends))
            if self.kind == "utc"
            else ends
            if self.kind == "float"
            else tuple(map(round, ends))
        )


@dataclass(frozen=True, slots=True)
class Sweep:
    """What varies: every combination of the lists, and of each so many random draws of the ranges.

    Attributes
    ----------
    axes : tuple of Axis
    draws : int
        How many of each combination.
    seed : int
        Of the random draws.
    """

    axes: tuple[Axis, ...] = ()
    draws: int = 1
    seed: int = 0

    def __len__(self) -> int:
        return self.combinations * self.draws

    @property
    def combinations(self) -> int:
        """How many combinations of the lists there are."""
        return prod(len(axis.values) for axis in self.axes if axis.values)

    def __bool__(self) -> bool:
        return bool(self.axes) or self.draws > 1

    def sample(self, number: int, *, salt: int = 0) -> dict[str, Any]:
        """Return one of its settings, by dotted key.

        Parameters
        ----------
        number : int
            Which, from 0; the last list varies fastest, but for the draws.
        salt : int
            Of another one the draws are others: a flight's place in the data set.

        Returns
        -------
        dict
            The same whoever asks, and however many draws there are before or after it.
        """
        return {axis.key: self._values(axis, number, 1, salt)[0] for axis in self.axes}

    def column(self, key: str, *, salt: int = 0) -> list[Any]:
        """Return what one key is in every sample; much faster than asking each.

        Parameters
        ----------
        key : str
            Of one of the axes.
        salt : int
            As for `sample`.

        Returns
        -------
        list
        """
        [axis] = [axis for axis in self.axes if axis.key == key]
        return list(
            chain.from_iterable(
                self._values(axis, first, self.draws, salt) for first in range(0, len(self), self.draws)
            )
        )

    def _values(self, axis: Axis, number: int, count: int, salt: int) -> list[Any]:
        """Return an axis's values in some samples of one combination."""
        combination, draw = divmod(number, self.draws)
        if axis.values:
            later = self.axes[self.axes.index(axis) + 1 :]
            turn = combination // prod(len(other.values) for other in later if other.values)
            return [axis.values[turn % len(axis.values)]] * count
        # Every axis and every combination has a stream of its own, of which a draw is one number.
        stream = np.random.PCG64([self.seed, salt, combination, self.axes.index(axis)])
        return axis.drawn(np.random.Generator(stream.advance(draw)).random(count))

    def extremes(self) -> Iterator[dict[str, Any]]:
        """Return settings among which every value of a list, and both ends of every range, stand at least once.

        Yields
        ------
        dict
        """
        usual = {axis.key: axis.ends[0] for axis in self.axes}
        for axis in self.axes:
            for value in axis.ends:
                yield usual | {axis.key: value}

    def told(self) -> dict[str, Any]:
        """Return what it says, ready for JSON.

        Returns
        -------
        dict
        """
        varies: dict[str, Any] = {
            axis.key: list(axis.values) or {"min": axis.ends[0], "max": axis.ends[1], "log": axis.log}
            for axis in self.axes
        }
        return {"draws": self.draws, "seed": self.seed, "varies": varies}

    @classmethod
    def of(cls, table: object, faults: list[Fault]) -> Self:
        """Return the sweep of a table; what cannot be meant joins the faults.

        Parameters
        ----------
        table : object
            What TOML holds under ``[sweep]``.
        faults : list of (key, message)

        Returns
        -------
        Sweep
        """
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
                for key, varied in value.items():
                    axes.extend(_axis(f"{name}.{key}", varied, faults))
            else:
                faults.append((f"sweep.{key_text(name)}", f"cannot vary{did_you_mean(name, _names())}"))
        sweep = cls(tuple(axes), counts["draws"], counts["seed"])
        samples = sweep.combinations * sweep.draws
        if samples > MOST_SAMPLES:
            words = f"asks for {samples:,} samples" if samples < _UNREADABLE else "asks for samples without end"
            faults.append(("sweep", f"{words}; at most {MOST_SAMPLES:,} can be planned: fewer draws, or shorter lists"))
            return cls()
        return sweep


def _names() -> list[str]:
    every = [f"{name}.{key}" for name, model in SECTIONS.items() for key in model.model_fields]
    return ["draws", "seed", START, *(name for name in every if name not in _OF_THE_READING)]


def _axis(key: str, value: object, faults: list[Fault]) -> Iterator[Axis]:
    """Yield what varies so, unless it cannot be meant."""
    fault = f"sweep.{key_text(key)}"
    if key not in _names():
        faults.append((fault, f"cannot vary{did_you_mean(key, _names(), or_else='')}"))
    elif isinstance(value, list) and value:
        if key == START and (wrong := [one for one in value if not _is_number(one)]):
            faults.append((fault, f"must be numbers of seconds, not {shown(wrong[0])}"))
            return
        yield Axis(key, tuple(one.isoformat() if isinstance(one, datetime) else one for one in value))
    elif isinstance(value, Mapping) and {"min", "max"} <= value.keys() <= _OF_A_RANGE:
        yield from _range(key, value, faults)
    else:
        words = f"must be a list, such as [1, 2], or a range, {{ min = 1, max = 2 }}, not {shown(value)}"
        faults.append((fault, words))


def _range(key: str, value: Mapping[str, Any], faults: list[Fault]) -> Iterator[Axis]:
    kind = _kind(key)
    is_log = value.get("log", False)
    try:
        least, most = (parse_utc(_text(value[end])) if kind == "utc" else _number(value[end]) for end in ("min", "max"))
    except ValueError as error:
        faults.append((f"sweep.{key}", f"is no range: {error}"))
        return
    if kind == "other":
        faults.append((f"sweep.{key}", "takes no range, for it is no number; give a list"))
    elif not least <= most or is_log not in (True, False) or (is_log and (least <= 0 or kind != "float")):
        needs = "max must not be less than min, and log = true needs positive numbers that need not be whole"
        faults.append((f"sweep.{key}", f"is no range: {needs}"))
    else:
        yield Axis(key, (), least, most, is_log, kind)


def _kind(key: str) -> str:
    """Return of what kind a key's values are."""
    if key == START:
        return "float"
    if key == "flight.utc_start":
        return "utc"
    section, _, name = key.partition(".")
    annotation: Any = SECTIONS[section].model_fields[name].annotation
    kinds = set(get_args(annotation)) - {type(None)} if isinstance(annotation, UnionType) else {annotation}
    return "float" if kinds == {float} else "int" if kinds == {int} else "other"


def _is_number(value: object) -> TypeGuard[float]:
    return not isinstance(value, bool) and isinstance(value, int | float) and isfinite(value)


def _number(value: object) -> float:
    if not _is_number(value):
        raise ValueError(f"{shown(value)} is no number")
    return float(value)


def _text(value: object) -> str:
    return value.isoformat() if isinstance(value, datetime) else str(value)
