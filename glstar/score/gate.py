"""Limits that a score must keep, for the checks of a repository: a TOML file of ``[[limit]]`` tables.

=========  ============================================================================================================
key        meaning
=========  ============================================================================================================
metric     a key of ``summary`` in score.json, ``solved_fraction``, ``refused_fraction``, ``false_fraction``, or of the
           whole set an orbit's (``orbit_mean_km``) or ``invalid_lines``
statistic  of an error: ``median`` (default), ``rms`` or ``p90``
at_most    the largest value that passes
at_least   the smallest value that passes
by         what frames are grouped by: ``flight``, a setting of a sweep, or the title of a table that the score prints
group      the group that the limit is for; without it each group has to keep it
=========  ============================================================================================================

A limit without a value fails: there is no answer, or no frame is in the group.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from math import isfinite, nan
from pathlib import Path
from typing import Any

from glstar.config.reading import toml_of
from glstar.errors import ConfigError
from glstar.score.frames import FrameScore
from glstar.score.metrics import BINS, METRICS, Spread, as_json, settings_bins, summarized
from glstar.score.scoring import RUN_METRICS, Score
from glstar.system.userinput import did_you_mean

EXAMPLE = """\
# Limits of a score: glstar score SET ANSWERS --gate gate.toml ends with status 1 if one of them is not kept.

[[limit]]
metric = "solved_fraction"   # of all frames; errors below are those of solved frames
at_least = 0.9

[[limit]]
metric = "false"             # frames that were answered wrongly
at_most = 0

[[limit]]
metric = "boresight_arcsec"  # or roll_arcsec, position_km, centroid_px, run_time_s
statistic = "p90"            # or "median" (default), "rms"
at_most = 120

[[limit]]
metric = "solved_fraction"
by = "rate, deg/s"           # or "field, deg", "flight", "exposure, s", "trail length, px", a setting of a sweep
group = "1 to 5"             # leave it out if every group has to keep the limit
at_least = 0.8
"""

_COUNTS = ("frames", "solved", "refused", "false")
_FRACTIONS = {f"{name}_fraction": name for name in _COUNTS[1:]}
_ERRORS = frozenset(metric.json_key for metric in METRICS if metric.units)
# Metrics that one group of frames has not: orbits have frames in several of them.
_ORBITS = {metric.json_key: metric for metric in RUN_METRICS if metric.json_key.startswith("orbit_")}
_SPREADS = _ERRORS.union(_ORBITS)
_INVALID_LINES = "invalid_lines"
_NAMES = (*_COUNTS, *_FRACTIONS, *(metric.json_key for metric in METRICS), *_ORBITS, _INVALID_LINES)
_STATISTICS = ("median", "rms", "p90")
_KEYS = ("metric", "statistic", "at_most", "at_least", "by", "group")
_FLIGHT = "flight"
# Metrics that say how many frames an error is of.
_COVERAGE = frozenset({"solved", "refused", *_FRACTIONS})

# Groups of frames by label, by the name of what they are grouped by.
Groups = Mapping[str, Sequence[tuple[str, Sequence[FrameScore]]]]


@dataclass(frozen=True, slots=True)
class GateLimit:
    """A bound of a metric."""

    metric: str
    statistic: str | None  # Of an error: {"median", "rms", "p90"}
    by: str | None
    group: str | None  # Label of one group; None: every group
    bound: float
    is_upper: bool  # Whether greater values fail, or smaller ones

    @property
    def title(self) -> str:
        """The limited quantity, for a message."""
        return self.metric if self.statistic is None else f"{self.metric} ({self.statistic})"


@dataclass(frozen=True, slots=True)
class Verdict:
    """Whether a score keeps a limit."""

    limit: GateLimit
    group: str | None  # Label of the group of frames, as the limit spells it if it is for one
    value: float  # NaN if there is none
    count: int  # Frames that the value is of
    frames: int  # Frames of the group
    lacks: str = ""  # Why there is no value

    @property
    def passed(self) -> bool:
        """Whether there is a value, and it keeps the limit."""
        return self._excess <= 0

    @property
    def text(self) -> str:
        """The verdict as one line."""
        limit = self.limit
        where = "" if limit.by is None else f", {limit.by}" + ("" if self.group is None else f": {self.group}")
        bound = f"{'at most' if limit.is_upper else 'at least'} {limit.bound:g}"
        if self.lacks:
            return f"FAILED  {limit.title}{where}: no value, {bound}; {self.lacks}"
        off = "" if self.passed else f", {self._excess:.4g} too {'much' if limit.is_upper else 'little'}"
        of = f"{self.count} of {self.frames}" if self.count != self.frames else f"{self.frames}"
        word = "holds " if self.passed else "FAILED"
        return f"{word}  {limit.title}{where}: {self.value:.4g}, {bound}{off} ({of} frames)"

    @property
    def json(self) -> dict[str, Any]:
        """The verdict as plain objects; ``value`` is null if there is none."""
        has_value = isfinite(self.value)
        return {
            "passed": self.passed,
            "metric": self.limit.metric,
            "statistic": self.limit.statistic,
            "at_most" if self.limit.is_upper else "at_least": self.limit.bound,
            "value": self.value if has_value else None,
            "excess": max(self._excess, 0.0) if has_value else None,
            "by": self.limit.by,
            "group": self.group,
            "count": self.count,
            "frames": self.frames,
            **({"reason": self.lacks} if self.lacks else {}),
        }

    @property
    def _excess(self) -> float:
        """How far the value is beyond the limit, negative if it keeps it; NaN without a value."""
        return (self.value - self.limit.bound) * (1 if self.limit.is_upper else -1)


def read_gate(path: Path) -> tuple[GateLimit, ...]:
    """Read the limits of a file; raises ConfigError if it cannot be read, or one of them is not valid."""
    document = toml_of(path)
    tables = document.pop("limit", [])
    if document:
        known = did_you_mean(next(iter(document)), ["limit"], or_else="; write [[limit]] tables")
        raise ConfigError(f"{next(iter(document))} is no part of a gate{known}", file=path)
    if not isinstance(tables, list) or not all(isinstance(table, dict) for table in tables):
        raise ConfigError("limit is written in double brackets, [[limit]], once for each limit", file=path)
    if not tables:
        raise ConfigError("holds no limit; glstar score --gate example prints a file to start with", file=path)
    return tuple(limit for number, table in enumerate(tables, 1) for limit in _limits(path, number, table))


def _limits(path: Path, number: int, table: Mapping[str, Any]) -> Iterator[GateLimit]:
    """Yield the limit of a table, or both of one with a smallest and a largest value."""
    key = f"limit {number}"
    if (fault := _metric_fault(table) or _scope_fault(table)) is not None:
        raise ConfigError(fault, file=path, key=key)
    metric, statistic, by, group = (table.get(name) for name in ("metric", "statistic", "by", "group"))
    bounds = [name for name in ("at_most", "at_least") if name in table]
    if not bounds:
        raise ConfigError(f"has no bound of {metric}; give at_most or at_least", file=path, key=key)
    for name in bounds:
        value = table[name]
        if isinstance(value, bool) or not isinstance(value, int | float) or not isfinite(value):
            raise ConfigError(f"{name} is {value!r}, not a finite number", file=path, key=key)
        kind = (statistic or _STATISTICS[0]) if metric in _SPREADS else None
        yield GateLimit(metric or "", kind, by, None if group is None else str(group), float(value), name == "at_most")


def _metric_fault(table: Mapping[str, Any]) -> str | None:
    """Return what is wrong with the keys or the metric of a limit."""
    for key, value in table.items():
        if key not in _KEYS:
            return f"{key} is no key of a limit{did_you_mean(key, _KEYS)}"
        if key in {"metric", "statistic", "by"} and not isinstance(value, str):
            return f"{key} is {value!r}, not a name in quotes"
    metric = table.get("metric", "")
    if not metric:
        return 'has no metric; give one, as in metric = "solved_fraction"'
    if metric not in _NAMES:
        longer = " or ".join(name for name in _NAMES if name.startswith(metric.lower()))
        return f"{metric!r} is no metric" + (f" (did you mean {longer}?)" if longer else did_you_mean(metric, _NAMES))
    return None


def _scope_fault(table: Mapping[str, Any]) -> str | None:
    """Return what is wrong with the statistic or the group of frames of a limit with a known metric."""
    metric, statistic, by, group = (table.get(name) for name in ("metric", "statistic", "by", "group"))
    if statistic is not None and metric not in _SPREADS:
        return f"{metric} has one value, and no statistic; leave statistic out"
    if statistic is not None and statistic not in _STATISTICS:
        return f"{statistic!r} is no statistic of an error{did_you_mean(statistic, _STATISTICS)}"
    if group is not None and by is None:
        return f'group is {group!r}, and by is missing: say what frames are grouped by, as in by = "rate, deg/s"'
    if by is not None and metric in {*_ORBITS, _INVALID_LINES}:
        return f"{metric} is one of the whole set; leave out by"
    return None


def gate_note(limits: Sequence[GateLimit]) -> str | None:
    """Return what limits leave open: errors are taken from solved frames, be it one; None if they say how many."""
    errors = [limit.metric for limit in limits if limit.metric in _ERRORS]
    if not errors or any(limit.metric in _COVERAGE for limit in limits):
        return None
    return (
        f"no limit says how many frames must be solved, and {errors[0]} is that of solved frames; limit solved_fraction"
    )


def judged(limits: Sequence[GateLimit], score: Score) -> list[Verdict]:
    """Return the verdict on each limit, one for each group of a limit on all of them."""
    groups = _groups(score.frames) if any(limit.by is not None for limit in limits) else {}
    return [verdict for limit in limits for verdict in _verdicts(limit, score, groups)]


def _groups(frames: Sequence[FrameScore]) -> Groups:
    """Return frames by everything that they can be grouped by; a flight has its name."""
    flights: dict[str, list[FrameScore]] = {}
    for frame in frames:
        flights.setdefault(frame.truth.run[0], []).append(frame)
    named = [(name, inside) for name, inside in flights.items() if name]
    return {one.name: one.grouped(frames) for one in BINS} | {_FLIGHT: named} | dict(settings_bins(frames))


def _verdicts(limit: GateLimit, score: Score, groups: Groups) -> Iterator[Verdict]:
    if limit.by is None:
        yield _verdict(limit, None, score.frames, score)
        return
    found = next((name for name in groups if _spelling(limit.by) in (_spelling(name), _quantity(name))), None)
    if found is None:
        known = f"; they are by {'; '.join(groups)}"
        lacks = f"frames are not grouped by {limit.by!r}{did_you_mean(limit.by, groups, or_else=known)}"
        yield Verdict(limit, limit.group, nan, 0, 0, lacks)
        return
    wanted = None if limit.group is None else _spelling(limit.group)
    chosen = [(label, inside) for label, inside in groups[found] if wanted in (None, _spelling(label))]
    for label, inside in chosen:
        yield _verdict(limit, label if limit.group is None else limit.group, inside, score)
    if not chosen:
        labels = ", ".join(label for label, _ in groups[found]) or "none"
        yield Verdict(limit, limit.group, nan, 0, 0, f"no frame is in this group; groups with frames: {labels}")


def _quantity(name: str) -> str:
    """Return the spelling of a name without its unit: that of 'rate' for 'rate, deg/s'."""
    return _spelling(name.partition(",")[0])


def _spelling(name: str) -> str:
    """Return a name without case, blanks, commas and underscores, in which those of groups still differ."""
    return "".join(letter for letter in name.lower() if letter not in " ,_")


def _verdict(limit: GateLimit, label: str | None, frames: Sequence[FrameScore], score: Score) -> Verdict:
    """Return the verdict on a limit for some frames of a score."""
    value, count = _value(limit, frames, score)
    if value is not None and isfinite(value):
        return Verdict(limit, label, float(value), count, len(frames))
    return Verdict(limit, label, nan, 0, len(frames), f"none of {len(frames)} frames has it")


def _value(limit: GateLimit, frames: Sequence[FrameScore], score: Score) -> tuple[float | None, int]:
    """Return the value of a metric over frames, and the number of frames that it is of."""
    if limit.metric == _INVALID_LINES:
        return len(score.faults), len(frames)
    if limit.metric in _ORBITS:
        spread = _orbit_spread(limit.metric, score)
        return (None, 0) if spread is None else (spread[limit.statistic or ""], len(frames))
    summary = (score.summary if limit.by is None else summarized(frames)).json
    if limit.metric in _FRACTIONS:
        return (summary[_FRACTIONS[limit.metric]] / len(frames) if frames else None), len(frames)
    value = summary[limit.metric]
    if isinstance(value, dict):
        return value[limit.statistic], value["count"]
    return value, len(frames)


def _orbit_spread(metric: str, score: Score) -> dict[str, Any] | None:
    spread = Spread.of([value for run in score.runs for value in _ORBITS[metric].of(run)])
    return None if spread is None else as_json(spread)
