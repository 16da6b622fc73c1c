"""Metrics of a score, their summary over frames, and the quantities by which frames are grouped."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from math import degrees
from typing import Any

import numpy as np

from glstar.camera.model import AttitudeError
from glstar.score.frames import FrameScore, Outcome, StarScore
from glstar.sky.place.apparent import ARCSEC_RAD

_PER_ARCSEC = 1 / ARCSEC_RAD
_KM_PER_NAUTICAL_MILE = 1.852


@dataclass(frozen=True, slots=True)
class Spread:
    """The spread of an error."""

    count: int
    median: float
    rms: float  # Root mean square
    p90: float  # 90 % quantile

    def scaled(self, factor: float) -> "Spread":
        """Return the spread in another unit."""
        return Spread(self.count, *(value * factor for value in (self.median, self.rms, self.p90)))

    @classmethod
    def of(cls, values: Sequence[float | None]) -> "Spread | None":
        """Return the spread of the known values; None if there is none."""
        size = np.abs(np.array([value for value in values if value is not None], dtype=np.float64))
        if size.size == 0:
            return None
        return cls(
            size.size,
            float(np.median(size)),
            float(np.sqrt(np.mean(size**2))),
            float(np.percentile(size, 90, method="inverted_cdf")),
        )


@dataclass(frozen=True, slots=True)
class Group:
    """Frames that are summarized together, by outcome."""

    solved: list[FrameScore]
    answered: list[FrameScore]  # Solved or false

    @classmethod
    def of(cls, scores: Sequence[FrameScore]) -> "Group":
        """Return the group of frames."""
        answered = [score for score in scores if score.outcome != Outcome.REFUSED]
        return cls([score for score in answered if score.outcome == Outcome.SOLVED], answered)

    @property
    def stars(self) -> list[StarScore]:
        """The scores of the answered frames with stars."""
        return [score.stars for score in self.answered if score.stars is not None]

    @property
    def in_ellipse(self) -> list[bool]:
        """Whether the ellipse of each answer with one contains the truth."""
        inside = [None if score.position is None else score.position.in_ellipse for score in self.answered]
        return [value for value in inside if value is not None]


@dataclass(frozen=True, slots=True)
class Unit:
    """A unit in which a metric is printed."""

    label: str  # Row of the table of errors, with the unit
    per_value: float = 1.0  # Printed number over the value


@dataclass(frozen=True, slots=True)
class Metric:
    """A quantity that a score has of the frames of a group."""

    name: str  # With the unit of its value
    json_key: str  # With the unit in score.json
    text: str  # Definition, Markdown
    summarized: Callable[[Group], Spread | float | None]
    units: tuple[Unit, ...] = ()  # The first is that of score.json; none for a metric that is no error
    part_of: str = ""  # Metric below which it is printed
    in_bins: bool = False  # Whether the tables of bins have its median
    in_runs: bool = False  # Whether its medians are compared between runs

    def in_json(self, value: Spread | float | None) -> Spread | float | None:
        """Return a summarized value in the unit of score.json."""
        return value.scaled(self.units[0].per_value) if isinstance(value, Spread) else value


def _solved(of: Callable[[FrameScore], float | None]) -> Callable[[Group], Spread | None]:
    """Return the spread over solved frames of a quantity of a frame."""
    return lambda group: Spread.of([of(score) for score in group.solved])


def _boresight_rad(error: AttitudeError | None) -> float | None:
    return None if error is None else error.boresight_rad


def _ratio(count: int, of: int) -> float | None:
    return count / of if of else None


def _mean(values: Sequence[float]) -> float | None:
    return float(np.mean(values)) if values else None


def _stated_confidence(group: Group) -> float | None:
    stated = [score for score in group.answered if score.position is not None and score.position.in_ellipse is not None]
    return _mean([score.answer.ellipse.confidence for score in stated if score.answer and score.answer.ellipse])


def _kelvins(stars: StarScore) -> float:
    wrong = stars.identified - stars.correct
    return max((stars.found - 2 * wrong) / max(stars.detectable, 1), -1.0)


# In the order of score.json.
METRICS = (
    Metric(
        "boresight_rad",
        "boresight_arcsec",
        "angle between the true and the answered optical axis",
        _solved(lambda score: _boresight_rad(score.attitude)),
        (Unit("boresight, arcsec", _PER_ARCSEC),),
        in_bins=True,
        in_runs=True,
    ),
    Metric(
        "roll_rad",
        "roll_arcsec",
        "error of the rotation about the optical axis",
        _solved(lambda score: None if score.attitude is None else score.attitude.roll_rad),
        (Unit("roll, arcsec", _PER_ARCSEC),),
        in_runs=True,
    ),
    Metric(
        "boresight_floor_rad",
        "boresight_floor_arcsec",
        "boresight error of a plain rotation fitted to the true pixels of the detectable stars",
        _solved(lambda score: _boresight_rad(score.floor)),
        (Unit("  of a plain rotation fit (floor)", _PER_ARCSEC),),
        part_of="boresight_rad",
    ),
    Metric(
        "boresight_above_floor_rad",
        "boresight_above_floor_arcsec",
        "boresight error of the answer against that fit",
        _solved(lambda score: _boresight_rad(score.above_floor)),
        (Unit("  above that floor", _PER_ARCSEC),),
        part_of="boresight_rad",
    ),
    Metric(
        "position_km",
        "position_km",
        "error of the position along the surface",
        _solved(lambda score: None if score.position is None else score.position.distance_km),
        (Unit("position, km"), Unit("position, nautical miles", 1 / _KM_PER_NAUTICAL_MILE)),
        in_bins=True,
        in_runs=True,
    ),
    Metric(
        "in_ellipse",
        "in_ellipse",
        "number of positions whose error ellipse contains the truth",
        lambda group: sum(group.in_ellipse),
    ),
    Metric("with_ellipse", "with_ellipse", "number of positions with an ellipse", lambda group: len(group.in_ellipse)),
    Metric("stated_confidence", "stated_confidence", "mean confidence of these ellipses", _stated_confidence),
    Metric(
        "precision",
        "precision",
        "fraction of identified stars that are right in number and position",
        lambda group: _ratio(sum(one.correct for one in group.stars), sum(one.identified for one in group.stars)),
    ),
    Metric(
        "recall",
        "recall",
        "fraction of detectable stars that were found",
        lambda group: _ratio(sum(one.found for one in group.stars), sum(one.detectable for one in group.stars)),
    ),
    Metric(
        "centroid_px",
        "centroid_px",
        "root mean square error of the positions of a frame's correct stars",
        lambda group: Spread.of([one.centroid_rms_px for one in group.stars]),
        (Unit("centroids, px (rms of a frame)"),),
    ),
    Metric(
        "run_time_s",
        "run_time_s",
        "run time of the navigator",
        lambda group: Spread.of([score.answer.run_time_s for score in group.answered if score.answer]),
        (Unit("run time, s"),),
    ),
    Metric(
        "lost_rate",
        "lost_rate",
        "fraction of the frames with stars in which two or more are right and none is wrong, as LOST counts",
        lambda group: _mean([one.correct >= 2 and one.correct == one.identified for one in group.stars]),
    ),
    Metric(
        "kelvins",
        "kelvins",
        "mean over frames of max((found - 2 wrong) / max(detectable, 1), -1), as in ESA's competition on star trackers",
        lambda group: _mean([_kelvins(one) for one in group.stars]),
    ),
)

# The errors in the order of the printed table: below each one its parts.
ERRORS = tuple(
    metric
    for whole in METRICS
    if whole.units and not whole.part_of
    for metric in (whole, *(part for part in METRICS if part.part_of == whole.name))
)


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


@dataclass(frozen=True, slots=True)
class Bin:
    """A quantity by which frames are grouped."""

    name: str  # With its unit
    of: Callable[[FrameScore], float | None]  # Returns the quantity of a frame's score; None if it has none
    edges: tuple[float, ...]  # Lower edge of each bin except the first
    is_plotted: bool = False  # Whether errors are plotted against it if it varies

    def grouped(self, scores: Sequence[FrameScore]) -> list[tuple[str, list[FrameScore]]]:
        """Return the labels and frames of the bins that are not empty; frames without the quantity are in none."""
        groups: list[tuple[str, list[FrameScore]]] = []
        quantities = [(score, value) for score in scores if (value := self.of(score)) is not None]
        for low, high in pairwise((-np.inf, *self.edges, np.inf)):
            inside = [score for score, value in quantities if low <= value < high]
            if inside:
                label = f"< {high:g}" if low == -np.inf else f">= {low:g}" if high == np.inf else f"{low:g} to {high:g}"
                groups.append((label, inside))
        return groups


def _condition(key: str) -> Callable[[FrameScore], float | None]:
    return lambda score: score.truth.conditions.get(key)


def _of_moon_up(key: str) -> Callable[[FrameScore], float | None]:
    """Return a condition of frames with the Moon above the horizon."""

    def of(score: FrameScore) -> float | None:
        conditions = score.truth.conditions
        return conditions.get(key) if conditions.get("moon_altitude_deg", -90.0) > 0 else None

    return of


def _rate_deg_per_s(score: FrameScore) -> float | None:
    rate_rad_per_s = score.truth.rate_rad_per_s
    return None if rate_rad_per_s is None else degrees(rate_rad_per_s)


BINS = (
    Bin("exposure, s", lambda score: score.truth.duration_s, (0.05, 0.2, 0.5, 1.0, 2.0)),
    Bin("rate, deg/s", _rate_deg_per_s, (1.0, 5.0, 20.0, 50.0, 100.0)),
    Bin("field, deg", lambda score: degrees(score.truth.camera.horizontal_field_rad), (10.0, 20.0, 40.0, 60.0, 90.0)),
    Bin("trail length, px", lambda score: score.truth.trail_length_px, (1.0, 5.0, 20.0, 100.0)),
    Bin("detectable stars", lambda score: float(score.truth.is_detectable.sum()), (5.0, 10.0, 20.0, 50.0)),
    Bin("transmission of cloud", _condition("cloud_transmission"), (0.2, 0.4, 0.6, 0.8, 0.99), is_plotted=True),
    Bin("altitude of the Moon, deg", _condition("moon_altitude_deg"), (0.0, 15.0, 30.0, 60.0), is_plotted=True),
    Bin("lit fraction of a Moon above the horizon", _of_moon_up("moon_illuminated_fraction"), (0.25, 0.5, 0.75)),
    Bin("axis to a Moon above the horizon, deg", _of_moon_up("moon_separation_deg"), (15.0, 30.0, 60.0, 90.0)),
    Bin("altitude of the Sun, deg", _condition("sun_altitude_deg"), (-18.0, -12.0, -6.0, 0.0), is_plotted=True),
)

# A setting with more values than this is grouped into as many ranges as `_RANGES`, each with equally many values.
MOST_VALUES = 8
_RANGES = 4


def settings_bins(scores: Sequence[FrameScore]) -> Iterator[tuple[str, list[tuple[str, list[FrameScore]]]]]:
    """Yield the dotted key of each setting of a sweep that varies, except seeds, and its groups of frames.

    A group is the label and the frames of a value, or of a range of a setting with many values.
    """
    for key in dict.fromkeys(key for score in scores for key in score.truth.settings):
        varied = [score for score in scores if key in score.truth.settings]
        values = sorted({score.truth.settings[key] for score in varied}, key=lambda value: (str(type(value)), value))
        if key.endswith(".seed") or len(values) < 2:
            continue
        if len(values) <= MOST_VALUES:
            yield key, [(str(value), [s for s in varied if s.truth.settings[key] == value]) for value in values]
        elif all(isinstance(value, int | float) for value in values):
            yield key, list(_in_ranges(key, values, varied))


def drawn_settings(scores: Sequence[FrameScore]) -> frozenset[str]:
    """Return the settings of a sweep that `settings_bins` groups into ranges, because they were drawn at random."""
    keys = dict.fromkeys(key for score in scores for key in score.truth.settings)
    values = {key: {score.truth.settings[key] for score in scores if key in score.truth.settings} for key in keys}
    return frozenset(key for key, different in values.items() if len(different) > MOST_VALUES)


def _in_ranges(
    key: str, values: Sequence[float], scores: Sequence[FrameScore]
) -> Iterator[tuple[str, list[FrameScore]]]:
    for part in np.array_split(np.array(values), _RANGES):
        low, high = float(part[0]), float(part[-1])
        yield f"{low:.4g} to {high:.4g}", [score for score in scores if low <= score.truth.settings[key] <= high]
