"""Scoring of a file of answers against an export: frames, orbits of the heading, runs and their spread, and plots."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from glstar.arrays import Float
from glstar.camera.model import AttitudeError
from glstar.errors import AnswersError
from glstar.export.truth.lines import DETECTABLE_SNR
from glstar.score.answers import Answer, AnswerFile, FirstAnswers, read_answers
from glstar.score.frames import FrameScore, FrameTruth, Limits, Outcome, read_frame_truths, score_frame
from glstar.score.metrics import (
    BINS,
    METRICS,
    MOST_VALUES,
    Bin,
    Spread,
    Summary,
    as_json,
    drawn_settings,
    settings_bins,
    summarized,
)
from glstar.sky.place.apparent import ARCSEC_RAD

_TURN_RAD = 2 * np.pi
# Smallest number of positions to fit a circle to.
_LEAST_FIXES = 4
_COLOURS = {Outcome.SOLVED: "tab:blue", Outcome.FALSE: "tab:red"}


@dataclass(frozen=True, slots=True)
class Orbit:
    """The positions of one full turn of the heading."""

    frames: int  # Solved positions in it
    mean_km: float  # Distance of their mean from the mean of the truth
    # The same, weighted by the range of headings of each answer: a systematic error of the mount cancels.
    weighted_mean_km: float
    circle_km: float | None  # Distance of the centre of the circle fitted to their errors; None with fewer than four
    radius_km: float | None  # That circle's radius


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


@dataclass(frozen=True, slots=True, eq=False)
class Score:
    """The score of a file of answers."""

    frames: tuple[FrameScore, ...]  # One for each frame of the truth, in its order
    summary: Summary
    # The same by each of `BINS`, and each setting of a sweep, of which frames occupy two: name; label and summary
    bins: tuple[tuple[str, tuple[tuple[str, Summary], ...]], ...]
    runs: tuple[Run, ...]  # One for each flight and sample of a data set
    drawn: frozenset[str] = frozenset()  # Names of the bins that are ranges of a setting that was drawn at random
    faults: tuple[str, ...] = ()  # What is wrong with each line that is no valid answer to a frame

    @property
    def orbits(self) -> tuple[Orbit, ...]:
        """The orbits of all runs."""
        return tuple(orbit for run in self.runs for orbit in run.orbits)

    @property
    def spread(self) -> dict[str, Spread | None] | None:
        """The spread over several runs of each of `RUN_METRICS`, by its key in `json`; None for one run."""
        return spread_of_runs(self.runs)

    @property
    def json(self) -> dict[str, Any]:
        """The score as plain objects, for a JSON file: angles in arcseconds, distances in km."""
        return {
            "schema": "glstar-score-1",
            "summary": self.summary.json,
            "bins": {name: {label: summary.json for label, summary in groups} for name, groups in self.bins},
            "orbits": [as_json(orbit) for orbit in self.orbits],
            **({"runs": self._runs_json()} if len(self.runs) > 1 else {}),
            "frames": [_frame_json(one) for one in self.frames],
            **({"invalid_lines": list(self.faults)} if self.faults else {}),
        }

    def _runs_json(self) -> dict[str, Any]:
        each = [
            {
                "flight": run.flight,
                "sample": run.sample,
                "settings": run.settings,
                "summary": run.summary.json,
                "orbits": [as_json(orbit) for orbit in run.orbits],
            }
            for run in self.runs
        ]
        spread = {key: as_json(value) for key, value in (self.spread or {}).items()}
        return {"spread": {"runs": len(self.runs)} | spread, "each": each}


def score(directory: Path, answers: Path, *, limits: Limits | None = None, least_snr: float = DETECTABLE_SNR) -> Score:
    """Score a navigator's answers against the truth of an export.

    `directory` has ``truth.jsonl`` and ``manifest.json``; `answers` is a file as `glstar.score.answers` describes it.
    Beyond `limits` an answer is false; stars are detectable from the signal-to-noise ratio `least_snr`.  Raises
    AnswersError if a file cannot be read, or no line of it is a valid answer to a frame.
    """
    truths = read_frame_truths(directory, least_snr=least_snr)
    matched, faults = matched_answers(answers, truths)
    frames = tuple(score_frame(truth, matched.get(truth.frame), limits or Limits()) for truth in truths)
    grouped = [*((one.name, one.grouped(frames)) for one in BINS), *settings_bins(frames)]
    binned = (
        (name, tuple((label, summarized(inside)) for label, inside in groups))
        for name, groups in grouped
        if len(groups) > 1
    )
    return Score(
        frames,
        summarized(frames),
        tuple(binned),
        tuple(runs_of(frames)),
        drawn_settings(frames),
        faults,
    )


def matched_answers(path: Path, truths: Sequence[FrameTruth]) -> tuple[dict[int, Answer], tuple[str, ...]]:
    """Return the valid answers of a file by frame number, and what is wrong with each other line.

    Raises AnswersError if the file cannot be read, or no line of it is a valid answer to a frame.
    """
    given = read_answers(path)
    matched, unmatched = _matched(given, truths)
    return matched, (*given.faults, *unmatched)


def _matched(given: AnswerFile, truths: Sequence[FrameTruth]) -> tuple[dict[int, Answer], list[str]]:
    """Return the answers by frame number, and what is wrong with those that answer no frame or contradict theirs."""
    by_name = {name: truth for truth in truths for name in (truth.frame, truth.file)}
    extent = f"the truth has {len(truths)}, {truths[0].file} to {truths[-1].file}"
    matched: dict[int, Answer] = {}
    faults = []
    first = FirstAnswers()
    for answer in given.answers:
        truth = None if answer.of is None else by_name.get(answer.of)
        if truth is None:
            faults.append(f"line {answer.line} answers frame {answer.of}; {extent}")
        elif contradiction := truth.contradiction(answer):
            faults.append(f"line {answer.line} contradicts itself: {contradiction}")
        elif objection := first.objection(answer, truth.frame):
            faults.append(objection)
        else:
            matched[truth.frame] = answer
    if not matched:
        raise AnswersError(given.path, faults[0])
    return matched, faults


def _frame_json(one: FrameScore) -> dict[str, Any]:
    errors = {"attitude": one.attitude, "floor": one.floor, "above_floor": one.above_floor}
    return {
        "frame": one.truth.frame,
        "file": one.truth.file,
        "outcome": str(one.outcome),
        **{name: as_json(error) for name, error in errors.items() if error is not None},
        **({"position": as_json(one.position) | {"distance_km": one.position.distance_km}} if one.position else {}),
        **({"stars": as_json(one.stars)} if one.stars else {}),
        "trail_length_px": one.truth.trail_length_px,
        "detectable_stars": int(one.truth.is_detectable.sum()),
        **one.truth.conditions,
    }


def draw_score(score: Score, path: Path) -> None:
    """Draw errors of attitude and position as an image file; `path`: output file; its suffix selects the format."""
    import matplotlib as mpl  # noqa: PLC0415 - slow to import

    mpl.use("Agg")
    from matplotlib import pyplot as plt  # noqa: PLC0415 - slow to import

    shown = [one for one in BINS if one.is_plotted and len({one.of(frame) for frame in score.frames}) > 1]
    rows = 2 + (len(shown) + 1) // 2
    figure, axes = plt.subplots(rows, 2, figsize=(11, 4 * rows), layout="constrained")
    boresight, roll, ground, outcome, *others = axes.flat
    for condition, axis in zip(shown, others, strict=False):
        _draw_condition(score, condition, axis)
    for axis in others[len(shown) :]:
        axis.set_axis_off()
    for kind, colour in _COLOURS.items():
        frames = [one for one in score.frames if one.outcome == kind]
        for axis, part in ((boresight, "boresight_rad"), (roll, "roll_rad")):
            errors = [(one.truth.trail_length_px, one.attitude) for one in frames if one.attitude is not None]
            axis.plot(
                [x for x, _ in errors], [_arcsec(error, part) for _, error in errors], ".", color=colour, label=kind
            )
        fixes = [one.position for one in frames if one.position is not None]
        ground.plot([fix.east_km for fix in fixes], [fix.north_km for fix in fixes], ".", color=colour, label=kind)
    floors = [(one.truth.trail_length_px, one.floor) for one in score.frames if one.floor is not None]
    boresight.plot(
        [x for x, _ in floors],
        [_arcsec(error, "boresight_rad") for _, error in floors],
        "_",
        color="0.6",
        label="plain fit",
    )
    boresight.set(xlabel="trail length, px", ylabel="boresight error, arcsec", yscale="log")
    roll.set(xlabel="trail length, px", ylabel="|roll error|, arcsec", yscale="log")
    ground.set(xlabel="east, km", ylabel="north, km", aspect="equal", title="position errors")
    ground.axhline(0, color="0.8", zorder=0)
    ground.axvline(0, color="0.8", zorder=0)
    counts = (score.summary.solved, score.summary.refused, score.summary.false)
    outcome.bar(["solved", "refused", "false"], counts, color=["tab:blue", "0.6", "tab:red"])
    outcome.set(ylabel="frames")
    for axis in (boresight, ground):
        if axis.get_legend_handles_labels()[0]:
            axis.legend(fontsize="small")
    figure.savefig(path, dpi=110)
    plt.close(figure)


def _draw_condition(score: Score, condition: Bin, axis: Any) -> None:
    """Draw errors of the optical axis against a condition; refused frames at the lower edge."""
    values = [(frame, value) for frame in score.frames if (value := condition.of(frame)) is not None]
    for kind, colour in _COLOURS.items():
        errors = [
            (value, _arcsec(frame.attitude, "boresight_rad"))
            for frame, value in values
            if frame.outcome == kind and frame.attitude is not None
        ]
        axis.plot([x for x, _ in errors], [y for _, y in errors], ".", color=colour, label=kind)
    refused = [value for frame, value in values if frame.outcome == Outcome.REFUSED]
    axis.plot(refused, [0.02] * len(refused), "|", color="0.6", transform=axis.get_xaxis_transform(), label="refused")
    axis.set(xlabel=condition.name, ylabel="boresight error, arcsec", yscale="log")


def _arcsec(error: AttitudeError, part: str) -> float:
    # A logarithmic axis has no zero.
    return max(abs(float(getattr(error, part))) / ARCSEC_RAD, float(np.finfo(np.float32).tiny))
