"""Scoring of a file of answers against an export."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from glstar.errors import AnswersError
from glstar.score.answers import Answer, read_answers
from glstar.score.frames import FrameScore, FrameTruth, Limits, read_frame_truths, score_frame
from glstar.score.summary import (
    BINS,
    Orbit,
    Run,
    RunSpread,
    Summary,
    as_json,
    drawn_settings,
    runs_of,
    settings_bins,
    spread_of_runs,
    summarized,
)

# Signal-to-noise ratio above which a matched filter detects a trail with few false alarms.
DETECTABLE_SNR = 10.0


@dataclass(frozen=True, slots=True, eq=False)
class Score:
    """The score of a file of answers."""

    frames: tuple[FrameScore, ...]  # One for each frame of the truth, in its order
    summary: Summary
    # Tuple of (str, tuple of (str, Summary)): the same by exposure, trail length, number of stars, transmission of
    # cloud, Moon, Sun and each setting of a sweep, where frames occupy two bins.
    bins: tuple[tuple[str, tuple[tuple[str, Summary], ...]], ...]
    runs: tuple[Run, ...]  # One for each flight and sample of a data set
    drawn: frozenset[str] = frozenset()  # Names of the bins that are ranges of a setting that was drawn at random

    @property
    def orbits(self) -> tuple[Orbit, ...]:
        """The orbits of all runs."""
        return tuple(orbit for run in self.runs for orbit in run.orbits)

    @property
    def spread(self) -> RunSpread | None:
        """The spread over several runs; None for one."""
        return spread_of_runs(self.runs)

    @property
    def json(self) -> dict[str, Any]:
        """The score as plain objects, for a JSON file: angles in arcseconds, distances in km."""
        return {
            "schema": "glstar-score-1",
            "summary": as_json(self.summary),
            "bins": {name: {label: as_json(one) for label, one in groups} for name, groups in self.bins},
            "orbits": [as_json(orbit) for orbit in self.orbits],
            **({"runs": self._runs_json()} if len(self.runs) > 1 else {}),
            "frames": [_frame_json(one) for one in self.frames],
        }

    def _runs_json(self) -> dict[str, Any]:
        each = [
            {
                "flight": run.flight,
                "sample": run.sample,
                "settings": run.settings,
                "summary": as_json(run.summary),
                "orbits": [as_json(orbit) for orbit in run.orbits],
            }
            for run in self.runs
        ]
        return {"spread": as_json(self.spread), "each": each}


def score(directory: Path, answers: Path, *, limits: Limits | None = None, least_snr: float = DETECTABLE_SNR) -> Score:
    """Score a navigator's answers against the truth of an export.

    `directory`: the export: its ``truth.jsonl`` and ``manifest.json``; `answers`: see `glstar.score.answers`; `limits`:
    limits beyond which an answer is false; `least_snr`: signal-to-noise ratio from which a star counts as detectable.
    Raises AnswersError if a file cannot be read, or an answer refers to a missing frame.
    """
    truths = read_frame_truths(directory, least_snr=least_snr)
    matched = _matched(answers, truths, read_answers(answers))
    frames = tuple(score_frame(truth, matched.get(truth.frame), limits or Limits()) for truth in truths)
    grouped = [*((one.name, one.grouped(frames)) for one in BINS), *settings_bins(frames)]
    binned = (
        (name, tuple((label, summarized(inside)) for label, inside in groups))
        for name, groups in grouped
        if len(groups) > 1
    )
    return Score(frames, summarized(frames), tuple(binned), tuple(runs_of(frames)), drawn_settings(frames))


def _matched(path: Path, truths: Sequence[FrameTruth], answers: Sequence[Answer]) -> dict[int, Answer]:
    """Return the answers by frame number."""
    by_file = {truth.file: truth.frame for truth in truths}
    numbers = set(by_file.values())
    matched: dict[int, Answer] = {}
    for answer in answers:
        number = by_file.get(answer.file or "") if answer.frame is None else answer.frame
        if number not in numbers or number is None:
            name = answer.file if answer.frame is None else answer.frame
            there = f"the truth has {len(numbers)}, {truths[0].file} to {truths[-1].file}"
            raise AnswersError(path, f"line {answer.line} answers frame {name}; {there}")
        if number in matched:
            raise AnswersError(path, f"answers frame {number} twice, in lines {matched[number].line} and {answer.line}")
        matched[number] = answer
    return matched


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
