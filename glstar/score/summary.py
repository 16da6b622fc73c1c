"""Summary of all frames: counts, medians, root mean squares and 90 % quantiles, in total and in bins.

The runs of a data set: flights under the samples of a sweep, and how much their scores differ.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from glstar.camera.model import AttitudeError
from glstar.score.frames import FrameScore, Outcome, StarScore
from glstar.sky.place.apparent import ARCSEC_RAD

Float = NDArray[np.float64]

_KM_PER_NAUTICAL_MILE: Final = 1.852
_TURN_RAD: Final = 2 * np.pi
# Smallest number of positions to fit a circle to.
_LEAST_FIXES: Final = 4


@dataclass(frozen=True, slots=True)
class Spread:
    """The spread of an error."""

    count: int
    median: float  # The median, the root mean square and the 90 % quantile
    rms: float
    p90: float

    def scaled(self, factor: float) -> "Spread":
        """Return the spread in another unit."""
        return Spread(self.count, *(value * factor for value in (self.median, self.rms, self.p90)))

    @classmethod
    def of(cls, values: Sequence[float | None]) -> "Spread | None":
        """Return the spread of the known values; None if there is none."""
        known = np.array([value for value in values if value is not None], dtype=np.float64)
        if known.size == 0:
            return None
        size = np.abs(known)
        return cls(
            known.size,
            float(np.median(size)),
            float(np.sqrt(np.mean(size**2))),
            float(np.percentile(size, 90, method="inverted_cdf")),
        )


@dataclass(frozen=True, slots=True)
class Orbit:
    """The positions of one full turn of the heading."""

    frames: int  # Solved positions in it
    mean_km: float  # Distance of their mean from the mean of the truth
    # The same, weighted by the range of headings of each answer: a systematic error of the mount cancels.
    weighted_mean_km: float
    circle_km: float | None  # Distance of the centre of the circle fitted to their errors; None with fewer than four
    radius_km: float | None  # That circle's radius


@dataclass(frozen=True, slots=True)
class Summary:
    """Summary of all frames or of the frames of a bin."""

    frames: int
    solved: int
    refused: int
    false: int
    boresight_rad: Spread | None  # Of solved frames
    roll_rad: Spread | None
    # Errors of the rotation fit to the true pixels, and of the answers against this fit.
    boresight_floor_rad: Spread | None
    boresight_above_floor_rad: Spread | None
    position_km: Spread | None
    in_ellipse: int  # Number of positions whose error ellipse contains the truth, and of those with an ellipse
    with_ellipse: int
    stated_confidence: float | None  # Mean confidence of those ellipses
    # Fraction of identified stars that are correct, and fraction of detectable stars that were found.
    precision: float | None
    recall: float | None
    centroid_px: Spread | None  # Of each frame's root mean square
    run_time_s: Spread | None
    # Fraction of the frames with identified stars in which two or more are right and none is wrong, as LOST counts.
    lost_rate: float | None
    # Mean over frames of max((found - 2 wrong) / max(detectable, 1), -1), as ESA's Star Trackers: First Contact.
    kelvins: float | None

    @property
    def position_nautical_miles(self) -> Spread | None:
        """`position_km` in nautical miles."""
        return None if self.position_km is None else self.position_km.scaled(1 / _KM_PER_NAUTICAL_MILE)


@dataclass(frozen=True, slots=True)
class Bin:
    """A quantity by which frames are grouped."""

    name: str  # With its unit
    of: Callable[[FrameScore], float]  # Returns the quantity of a frame's score; NaN if it has none
    edges: tuple[float, ...]  # Lower edge of each bin except the first

    def grouped(self, scores: Sequence[FrameScore]) -> list[tuple[str, list[FrameScore]]]:
        """Return the labels and frames of the bins that are not empty; frames without the quantity are in none."""
        groups: list[tuple[str, list[FrameScore]]] = []
        bounds = (-np.inf, *self.edges, np.inf)
        for low, high in pairwise(bounds):
            inside = [score for score in scores if low <= self.of(score) < high]
            if inside:
                label = f"< {high:g}" if low == -np.inf else f">= {low:g}" if high == np.inf else f"{low:g} to {high:g}"
                groups.append((label, inside))
        return groups


_LIT: Final = "moon_illuminated_fraction"
_AWAY: Final = "moon_separation_deg"


def _condition(score: FrameScore, key: str) -> float:
    return score.truth.conditions.get(key, float("nan"))


def _of_moon_up(score: FrameScore, key: str) -> float:
    return _condition(score, key) if _condition(score, "moon_altitude_deg") > 0 else float("nan")


BINS: Final = (
    Bin("exposure, s", lambda score: score.truth.duration_s, (0.05, 0.2, 0.5, 1.0, 2.0)),
    Bin("trail length, px", lambda score: score.truth.trail_length_px, (1.0, 5.0, 20.0, 100.0)),
    Bin("detectable stars", lambda score: float(score.truth.is_detectable.sum()), (5.0, 10.0, 20.0, 50.0)),
    Bin("transmission of cloud", lambda score: _condition(score, "cloud_transmission"), (0.2, 0.4, 0.6, 0.8, 0.99)),
    Bin("altitude of the Moon, deg", lambda score: _condition(score, "moon_altitude_deg"), (0.0, 15.0, 30.0, 60.0)),
    Bin("lit fraction of a Moon above the horizon", lambda score: _of_moon_up(score, _LIT), (0.25, 0.5, 0.75)),
    Bin("axis to a Moon above the horizon, deg", lambda score: _of_moon_up(score, _AWAY), (15.0, 30.0, 60.0, 90.0)),
    Bin("altitude of the Sun, deg", lambda score: _condition(score, "sun_altitude_deg"), (-18.0, -12.0, -6.0, 0.0)),
)


def summarized(scores: Sequence[FrameScore]) -> Summary:
    """Return the summary of frames."""
    solved = [score for score in scores if score.outcome == Outcome.SOLVED]
    answered = [score for score in scores if score.outcome != Outcome.REFUSED]
    stars = [score.stars for score in answered if score.stars is not None]
    positions = [score.position for score in solved if score.position is not None]
    stated = [score for score in answered if score.position is not None and score.position.in_ellipse is not None]
    identified, detectable = sum(one.identified for one in stars), sum(one.detectable for one in stars)
    confidences = [score.answer.ellipse.confidence for score in stated if score.answer and score.answer.ellipse]
    return Summary(
        frames=len(scores),
        solved=len(solved),
        refused=len(scores) - len(answered),
        false=len(answered) - len(solved),
        boresight_rad=Spread.of([_part(score.attitude, "boresight_rad") for score in solved]),
        roll_rad=Spread.of([_part(score.attitude, "roll_rad") for score in solved]),
        boresight_floor_rad=Spread.of([_part(score.floor, "boresight_rad") for score in solved]),
        boresight_above_floor_rad=Spread.of([_part(score.above_floor, "boresight_rad") for score in solved]),
        position_km=Spread.of([position.distance_km for position in positions]),
        in_ellipse=sum(bool(score.position and score.position.in_ellipse) for score in stated),
        with_ellipse=len(stated),
        stated_confidence=float(np.mean(confidences)) if confidences else None,
        precision=sum(one.correct for one in stars) / identified if identified else None,
        recall=sum(one.found for one in stars) / detectable if detectable else None,
        centroid_px=Spread.of([one.centroid_rms_px for one in stars]),
        run_time_s=Spread.of([None if score.answer is None else score.answer.run_time_s for score in answered]),
        lost_rate=float(np.mean([one.correct >= 2 and one.correct == one.identified for one in stars]))
        if stars
        else None,
        kelvins=float(np.mean([_kelvins(one) for one in stars])) if stars else None,
    )


def _kelvins(stars: StarScore) -> float:
    wrong = stars.identified - stars.correct
    return max((stars.found - 2 * wrong) / max(stars.detectable, 1), -1.0)


def _part(error: AttitudeError | None, part: str) -> float | None:
    return None if error is None else float(getattr(error, part))


def orbits(scores: Sequence[FrameScore]) -> list[Orbit]:
    """Return the positions of each full turn of the heading.

    `scores`: of one flight, sorted by time.  Returns: empty if the heading makes no full turn, or without answered
    positions.
    """
    placed = [score for score in scores if score.outcome == Outcome.SOLVED and score.position is not None]
    if len(placed) < _LEAST_FIXES:
        return []
    headings = np.unwrap([score.truth.yaw_rad for score in scores])
    index = {id(score): k for k, score in enumerate(scores)}
    turned = np.abs(headings - headings[0])
    found = []
    for turn in range(int(turned[-1] / _TURN_RAD)):
        inside = [s for s in placed if turn <= turned[index[id(s)]] / _TURN_RAD < turn + 1]
        if len(inside) >= _LEAST_FIXES:
            found.append(_orbit(inside, np.array([turned[index[id(score)]] for score in inside])))
    return found


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
    """Return a summary or an error as plain objects, angles in arcseconds: ``roll_rad`` becomes ``roll_arcsec``."""
    if not hasattr(value, "__dataclass_fields__"):
        return value
    parts = {name: getattr(value, name) for name in value.__dataclass_fields__}
    return {
        (f"{name.removesuffix('_rad')}_arcsec" if name.endswith("_rad") else name): (
            as_json(_in_arcsec(part)) if name.endswith("_rad") else as_json(part)
        )
        for name, part in parts.items()
    }


def _in_arcsec(angle: Spread | float | None) -> Spread | float | None:
    if isinstance(angle, Spread):
        return angle.scaled(1 / ARCSEC_RAD)
    return None if angle is None else float(angle / ARCSEC_RAD)


# A setting with more values than this is grouped into as many ranges as `_RANGES`, each with equally many values.
_MOST_VALUES: Final = 8
_RANGES: Final = 4


@dataclass(frozen=True, slots=True, eq=False)
class Run:
    """One flight under one sample of a sweep: a repetition of an experiment, where only seeds vary."""

    flight: str  # Its name; empty for an export of one flight
    sample: int
    settings: dict[str, Any]  # The settings of the sample, by dotted key
    summary: Summary
    orbits: tuple[Orbit, ...]


@dataclass(frozen=True, slots=True)
class RunSpread:
    """The spread of the runs' results: how far one result may be off by chance."""

    runs: int
    solved_fraction: Spread | None  # Fraction of its frames that each run solved
    boresight_rad: Spread | None  # Of the runs' medians
    roll_rad: Spread | None
    position_km: Spread | None
    # Of all orbits of all runs: the mean position, weighted by heading, and the centre of the circle.
    orbit_mean_km: Spread | None
    orbit_weighted_km: Spread | None
    orbit_circle_km: Spread | None


def runs_of(scores: Sequence[FrameScore]) -> list[Run]:
    """Return the runs of a score, in the order of the truth; returns one for an export of one flight."""
    grouped: dict[tuple[str, int], list[FrameScore]] = {}
    for score in scores:
        grouped.setdefault(score.truth.run, []).append(score)
    return [
        Run(flight, sample, dict(inside[0].truth.settings), summarized(inside), tuple(orbits(inside)))
        for (flight, sample), inside in grouped.items()
    ]


def spread_of_runs(runs: Sequence[Run]) -> RunSpread | None:
    """Return the spread of several runs; None for one."""
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

    Yields `name`: the dotted key; `groups` list of (str, list of FrameScore): label and frames of each value, or of
    ranges of a setting with many values.
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
    """Return the settings of a sweep that `settings_bins` groups into ranges, because they were drawn at random."""
    keys = dict.fromkeys(key for score in scores for key in score.truth.settings)
    values = {key: {score.truth.settings[key] for score in scores if key in score.truth.settings} for key in keys}
    return frozenset(key for key, different in values.items() if len(different) > _MOST_VALUES)


def _in_ranges(
    key: str, values: Sequence[float], scores: Sequence[FrameScore]
) -> Iterator[tuple[str, list[FrameScore]]]:
    for part in np.array_split(np.array(values), _RANGES):
        low, high = float(part[0]), float(part[-1])
        yield f"{low:.4g} to {high:.4g}", [score for score in scores if low <= score.truth.settings[key] <= high]
