"""The runs of a data set: flights under the samples of a sweep, and how much their scores differ."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np

from glstar.score.framescore import FrameScore
from glstar.score.scoresummary import Orbit, Spread, Summary, orbits, summarized

__all__ = ["Run", "RunSpread", "runs_of", "settings_bins", "spread_of_runs"]

# A setting with more values than this is grouped into as many ranges as `_RANGES`, each with equally many values.
_MOST_VALUES: Final = 8
_RANGES: Final = 4


@dataclass(frozen=True, slots=True, eq=False)
class Run:
    """One flight under one sample of a sweep: a repetition of an experiment, where only seeds vary.

    Attributes
    ----------
    flight : str
        Its name; empty for an export of one flight.
    sample : int
    settings : dict
        The settings of the sample, by dotted key.
    summary : Summary
    orbits : tuple of Orbit
    """

    flight: str
    sample: int
    settings: dict[str, Any]
    summary: Summary
    orbits: tuple[Orbit, ...]


@dataclass(frozen=True, slots=True)
class RunSpread:
    """The spread of the runs' results: how far one result may be off by chance.

    Attributes
    ----------
    runs : int
    solved_fraction : Spread
        Fraction of its frames that each run solved.
    boresight_rad, roll_rad, position_km : Spread or None
        Of the runs' medians.
    orbit_mean_km, orbit_weighted_km, orbit_circle_km : Spread or None
        Of all orbits of all runs: the mean position, weighted by heading, and the centre of the circle.
    """

    runs: int
    solved_fraction: Spread | None
    boresight_rad: Spread | None
    roll_rad: Spread | None
    position_km: Spread | None
    orbit_mean_km: Spread | None
    orbit_weighted_km: Spread | None
    orbit_circle_km: Spread | None


def runs_of(scores: Sequence[FrameScore]) -> list[Run]:
    """Return the runs of a score, in the order of the truth.

    Parameters
    ----------
    scores : sequence of FrameScore

    Returns
    -------
    list of Run
        One for an export of one flight.
    """
    grouped: dict[tuple[str, int], list[FrameScore]] = {}
    for score in scores:
        grouped.setdefault(score.truth.run, []).append(score)
    return [
        Run(flight, sample, dict(inside[0].truth.settings), summarized(inside), tuple(orbits(inside)))
        for (flight, sample), inside in grouped.items()
    ]


def spread_of_runs(runs: Sequence[Run]) -> RunSpread | None:
    """Return the spread of several runs; None for one.

    Parameters
    ----------
    runs : sequence of Run

    Returns
    -------
    RunSpread or None
    """
    if len(runs) < 2:
        return None
    flown = [orbit for run in runs for orbit in run.orbits]
    return RunSpread(
        len(runs),
        Spread.of([run.summary.solved / run.summary.frames for run in runs]),
        _medians([run.summary.boresight_rad for run in runs]),
        _medians([run.summary.roll_rad for run in runs]),
        _medians([run.summary.position_km for run in runs]),
        Spread.of([orbit.mean_km for orbit in flown]),
        Spread.of([orbit.weighted_mean_km for orbit in flown]),
        Spread.of([orbit.circle_km for orbit in flown]),
    )


def _medians(spreads: Sequence[Spread | None]) -> Spread | None:
    return Spread.of([None if one is None else one.median for one in spreads])


def settings_bins(scores: Sequence[FrameScore]) -> Iterator[tuple[str, list[tuple[str, list[FrameScore]]]]]:
    """Yield the frames grouped by each setting of a sweep that varies, except seeds.

    Parameters
    ----------
    scores : sequence of FrameScore

    Yields
    ------
    name : str
        The dotted key.
    groups : list of (str, list of FrameScore)
        Label and frames of each value, or of ranges of a setting with many values.
    """
    for key in dict.fromkeys(key for score in scores for key in score.truth.settings):
        known = [score for score in scores if key in score.truth.settings]
        values = sorted({score.truth.settings[key] for score in known}, key=lambda value: (str(type(value)), value))
        if key.endswith(".seed") or len(values) < 2:
            continue
        if len(values) <= _MOST_VALUES:
            yield key, [(str(value), [s for s in known if s.truth.settings[key] == value]) for value in values]
        elif all(isinstance(value, int | float) for value in values):
            yield key, list(_in_ranges(key, values, known))


def drawn_settings(scores: Sequence[FrameScore]) -> frozenset[str]:
    """Return the settings of a sweep that `settings_bins` groups into ranges, because they were drawn at random.

    Parameters
    ----------
    scores : sequence of FrameScore

    Returns
    -------
    frozenset of str
    """
    keys = dict.fromkeys(key for score in scores for key in score.truth.settings)
    values = {key: {score.truth.settings[key] for score in scores if key in score.truth.settings} for key in keys}
    return frozenset(key for key, different in values.items() if len(different) > _MOST_VALUES)


def _in_ranges(
    key: str, values: Sequence[float], scores: Sequence[FrameScore]
) -> Iterator[tuple[str, list[FrameScore]]]:
    for part in np.array_split(np.array(values), _RANGES):
        low, high = float(part[0]), float(part[-1])
        yield f"{low:.4g} to {high:.4g}", [score for score in scores if low <= score.truth.settings[key] <= high]
