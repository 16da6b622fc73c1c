"""Summaries of frames, orbits of the heading, and the runs of a data set with the spread of their results."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from glstar.arrays import Float
from glstar.score.frames import FrameScore, Outcome
from glstar.score.metrics import METRICS, MOST_VALUES, Group, Spread
from glstar.sky.place.apparent import ARCSEC_RAD

_TURN_RAD = 2 * np.pi
# Smallest number of positions to fit a circle to.
_LEAST_FIXES = 4


@dataclass(frozen=True, slots=True)
class Orbit:
    """The positions of one full turn of the heading."""

    frames: int  # Solved positions in it
    mean_km: float  # Distance of their mean from the mean of the truth
    # The same, weighted by the range of headings of each answer: a systematic error of the mount cancels.
    weighted_mean_km: float
    circle_km: float | None  # Distance of the centre of the circle fitted to their errors; None with fewer than four
    radius_km: float | None  # That circle's radius


@dataclass(frozen=True, slots=True, eq=False)
class Summary:
    """Summary of all frames or of the frames of a bin."""

    frames: int
    solved: int
    refused: int
    false: int
    values: Mapping[str, Spread | float | None]  # By `Metric.name`; None where no frame has the quantity

    def spread(self, name: str) -> Spread | None:
        """Return the spread of an error."""
        value = self.values[name]
        assert value is None or isinstance(value, Spread)
        return value

    def number(self, name: str) -> float | None:
        """Return a metric that has one value for all frames."""
        value = self.values[name]
        assert not isinstance(value, Spread)
        return value

    @property
    def json(self) -> dict[str, Any]:
        """The summary as plain objects, angles in arcseconds."""
        counts = {name: getattr(self, name) for name in ("frames", "solved", "refused", "false")}
        return counts | {metric.json_key: as_json(metric.in_json(self.values[metric.name])) for metric in METRICS}


def summarized(scores: Sequence[FrameScore]) -> Summary:
    """Return the summary of frames."""
    group = Group.of(scores)
    return Summary(
        frames=len(scores),
        solved=len(group.solved),
        refused=len(scores) - len(group.answered),
        false=len(group.answered) - len(group.solved),
        values={metric.name: metric.summarized(group) for metric in METRICS},
    )


def orbits(scores: Sequence[FrameScore]) -> list[Orbit]:
    """Return the positions of each full turn of the heading; `scores` are those of one flight, sorted by time.

    Empty if the heading makes no full turn, or without answered positions.
    """
    placed = [score for score in scores if score.outcome == Outcome.SOLVED and score.position is not None]
    if len(placed) < _LEAST_FIXES:
        return []
    headings = np.unwrap([score.truth.yaw_rad for score in scores])
    index = {id(score): k for k, score in enumerate(scores)}
    turned = np.abs(headings - headings[0])
    complete = []
    for turn in range(int(turned[-1] / _TURN_RAD)):
        inside = [s for s in placed if turn <= turned[index[id(s)]] / _TURN_RAD < turn + 1]
        if len(inside) >= _LEAST_FIXES:
            complete.append(_orbit(inside, np.array([turned[index[id(score)]] for score in inside])))
    return complete


def _orbit(scores: Sequence[FrameScore], turned_rad: Float) -> Orbit:
    """Return the summary of the positions of one turn."""
    errors: Float = np.array([(s.position.north_km, s.position.east_km) for s in scores if s.position is not None])
    # Each position is weighted by half of the heading difference between its neighbours; the turn is closed.
    after = np.diff(np.append(turned_rad, turned_rad[0] + _TURN_RAD))
    weights = (after + np.roll(after, 1)) / 2
    # Kasa's circle: 2 x xc + 2 y yc + c = x^2 + y^2.
    design = np.column_stack([2 * errors, np.ones(len(errors))])
    (x, y, c), _, rank, _ = np.linalg.lstsq(design, (errors**2).sum(axis=1), rcond=None)
    is_circle = rank == design.shape[1]
    return Orbit(
        len(scores),
        float(np.hypot(*errors.mean(axis=0))),
        float(np.hypot(*(weights @ errors / weights.sum()))),
        float(np.hypot(x, y)) if is_circle else None,
        float(np.sqrt(max(c + x**2 + y**2, 0.0))) if is_circle else None,
    )


def as_json(value: Any) -> Any:
    """Return a spread or an error as plain objects, angles in arcseconds: ``roll_rad`` becomes ``roll_arcsec``."""
    if not hasattr(value, "__dataclass_fields__"):
        return value
    parts = {name: getattr(value, name) for name in value.__dataclass_fields__}
    return {
        (f"{name.removesuffix('_rad')}_arcsec" if name.endswith("_rad") else name): (
            float(part / ARCSEC_RAD) if name.endswith("_rad") else part
        )
        for name, part in parts.items()
    }


@dataclass(frozen=True, slots=True, eq=False)
class Run:
    """One flight under one sample of a sweep: a repetition of an experiment, where only seeds vary."""

    flight: str  # Its name; empty for an export of one flight
    sample: int
    settings: dict[str, Any]  # The settings of the sample, by dotted key
    summary: Summary
    orbits: tuple[Orbit, ...]


@dataclass(frozen=True, slots=True)
class RunMetric:
    """A result of a run, whose spread over runs says how far one result may be off by chance."""

    json_key: str  # With the unit in score.json
    label: str  # With its printed unit
    text: str  # Definition, Markdown
    of: Callable[[Run], Sequence[float | None]]  # A value for the run, or one for each of its orbits
    per_value: float = 1.0  # Printed number, and that in score.json, over the value


def _median(name: str) -> Callable[[Run], Sequence[float | None]]:
    """Return the median of a metric over the frames of a run."""
    return lambda run: [None if (spread := run.summary.spread(name)) is None else spread.median]


RUN_METRICS = (
    RunMetric(
        "solved_fraction",
        "solved fraction",
        "fraction of its frames that each run solved",
        lambda run: [run.summary.solved / run.summary.frames],
    ),
    *(
        RunMetric(
            metric.json_key,
            f"median {metric.units[0].label}",
            f"of the runs' medians of `{metric.json_key}`",
            _median(metric.name),
            metric.units[0].per_value,
        )
        for metric in METRICS
        if metric.in_runs
    ),
    RunMetric(
        "orbit_mean_km",
        "mean of an orbit, km",
        "distance of the mean position of each orbit from that of the truth",
        lambda run: [orbit.mean_km for orbit in run.orbits],
    ),
    RunMetric(
        "orbit_weighted_km",
        "mean weighted by heading, km",
        "the same, weighted by heading",
        lambda run: [orbit.weighted_mean_km for orbit in run.orbits],
    ),
    RunMetric(
        "orbit_circle_km",
        "centre of the circle, km",
        "distance of the centre of the circle fitted to the errors of each orbit",
        lambda run: [orbit.circle_km for orbit in run.orbits],
    ),
)


def runs_of(scores: Sequence[FrameScore]) -> list[Run]:
    """Return the runs of a score, in the order of the truth; one for an export of one flight."""
    grouped: dict[tuple[str, int], list[FrameScore]] = {}
    for score in scores:
        grouped.setdefault(score.truth.run, []).append(score)
    return [
        Run(flight, sample, dict(inside[0].truth.settings), summarized(inside), tuple(orbits(inside)))
        for (flight, sample), inside in grouped.items()
    ]


def orbits_by_setting(runs: Sequence[Run]) -> dict[str, dict[str, list[Orbit]]]:
    """Return the orbits of runs by the value of each setting that varies, except seeds and those drawn at random."""
    grouped = {}
    for key in dict.fromkeys(key for run in runs for key in run.settings if not key.endswith(".seed")):
        by_value: dict[str, list[Orbit]] = {}
        for run in runs:
            if key in run.settings and run.orbits:
                by_value.setdefault(str(run.settings[key]), []).extend(run.orbits)
        if 1 < len(by_value) <= MOST_VALUES:
            grouped[key] = by_value
    return grouped


def spread_of_runs(runs: Sequence[Run]) -> dict[str, Spread | None] | None:
    """Return the spread of each of `RUN_METRICS` over several runs, by its key in score.json; None for one run."""
    if len(runs) < 2:
        return None
    spreads = {metric: Spread.of([value for run in runs for value in metric.of(run)]) for metric in RUN_METRICS}
    return {
        metric.json_key: None if spread is None else spread.scaled(metric.per_value)
        for metric, spread in spreads.items()
    }
