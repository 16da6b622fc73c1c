"""The page of a score: ``index.html`` beside score.json, with the worst frames, truth and answers drawn over them."""

from collections.abc import Iterator, Mapping, Sequence
from math import degrees
from pathlib import Path
from typing import Any

import numpy as np

from glstar.arrays import Float
from glstar.errors import ExportError
from glstar.export.report.charts import curve
from glstar.export.report.html import (
    TRUTH_SWITCHES,
    columns,
    evenly,
    page,
    paragraph,
    section,
    table,
    thumbnails,
    viewer,
)
from glstar.export.truth.lines import read_truth
from glstar.score.answers import ObservedStars
from glstar.score.frames import FrameScore, FrameTruth, Outcome
from glstar.score.metrics import ERRORS
from glstar.score.scoring import Score
from glstar.sky.place.apparent import ARCSEC_RAD

# Frames that are shown, and frames of a curve.
_WORST, _MOST_POINTS = 12, 2000
# Stars of an answer that are drawn, and half of the size of their crosses, px.
_MOST_STARS, _CROSS_PX = 200, 5.0
_SWITCHES = {**TRUTH_SWITCHES, "answers": "answer"}


def score_page(found: Score, directory: Path, answers: Path, *, star_px: float) -> bytes:
    """Return the page of a score of `answers` to the export in a directory.

    A star within `star_px` px of the true one is right. Raises ExportError if the truth cannot be read.
    """
    whole, worst = found.summary, worst_frames(found.frames)
    pictures = dict(_pictures(directory, worst, star_px))
    shown = [pictures[one.truth.frame] for one in worst if one.truth.frame in pictures]
    order = {one["frame"]: k for k, (one, _) in enumerate(shown)}
    counts = [("frames", whole.frames), ("solved", whole.solved), ("refused", whole.refused), ("false", whole.false)]
    sections = [
        section(
            "Result",
            paragraph("A navigator's answers against the exact truth of simulated frames, by glstar."),
            table(("", ""), [(name, str(count)) for name, count in counts] + _rates(found)),
        ),
        section("Errors of solved frames", table(("", "median", "rms", "90 %", "frames"), _errors(found))),
        section("Errors by frame", columns("curves", _curves(found, order))),
    ]
    if shown:
        note = (
            f"The {len(shown)} worst frames: false ones first, then those with the largest error of the optical axis or"
            " else of the position, then refused ones. Blue: stars of the answer, and lines from the true position of"
            " detectable stars to where the answered attitude puts them; red: stars with a wrong number or place."
        )
        small = thumbnails((f"{one['frame']} {one['outcome']}", jpeg) for one, jpeg in shown)
        sections.append(section("Worst frames", paragraph(note), viewer(_SWITCHES), small))
    if found.faults:
        rows = [(fault,) for fault in found.faults[:100]]
        sections.append(section(f"Lines that are not counted: {len(found.faults)}", table(("",), rows), is_closed=True))
    title = f"Score of {answers.name} on {directory.absolute().name}"
    return page(title, sections, {"frames": [one for one, _ in shown]})


def worst_frames(scores: Sequence[FrameScore]) -> list[FrameScore]:
    """Return the worst frames, at most 12: false ones, then those with the largest error, then refused ones."""

    def badness(one: FrameScore) -> tuple[int, float]:
        rank = {Outcome.FALSE: 2, Outcome.SOLVED: 1, Outcome.REFUSED: 0}[one.outcome]
        if one.attitude is not None:
            return rank, one.attitude.boresight_rad
        return rank, 0.0 if one.position is None else one.position.distance_km

    return sorted(scores, key=badness, reverse=True)[:_WORST]


def _rates(found: Score) -> list[tuple[str, str]]:
    labels = {"precision": "stars identified: precision", "recall": "recall of the detectable stars"}
    known = {label: found.summary.number(name) for name, label in labels.items()}
    return [(label, f"{value:.1%}") for label, value in known.items() if value is not None]


def _errors(found: Score) -> Iterator[tuple[str, ...]]:
    for metric in ERRORS:
        spread = found.summary.spread(metric.name)
        if spread is None:
            continue
        for unit in metric.units:
            scaled = spread.scaled(unit.per_value)
            numbers = (f"{n:.3g}" for n in (scaled.median, scaled.rms, scaled.p90))
            yield unit.label.replace("  ", "\u2003"), *numbers, str(scaled.count)


def _curves(found: Score, order: Mapping[int, int]) -> list[str]:
    frames = [found.frames[k] for k in evenly(len(found.frames), _MOST_POINTS)]
    values: dict[str, list[float | None]] = {
        "error of the optical axis, arcsec": [
            None if one.attitude is None else one.attitude.boresight_rad / ARCSEC_RAD for one in frames
        ],
        "error of the rotation about it, arcsec": [
            None if one.attitude is None else abs(one.attitude.roll_rad) / ARCSEC_RAD for one in frames
        ],
        "error of the position, km": [None if one.position is None else one.position.distance_km for one in frames],
        "detectable stars that are not identified": [
            None if one.stars is None else one.stars.detectable - one.stars.found for one in frames
        ],
    }
    return [
        curve(
            title,
            [
                (order.get(one.truth.frame), one.truth.frame, value, str(one.outcome))
                for one, value in zip(frames, numbers, strict=True)
            ],
            is_log="error" in title,
            is_line=False,
        )
        for title, numbers in values.items()
    ]


def _pictures(
    directory: Path, worst: Sequence[FrameScore], star_px: float
) -> Iterator[tuple[int, tuple[dict[str, Any], bytes]]]:
    """Return the drawing and the JPEG of each frame whose image can be read, by frame number."""
    from glstar.export.report.pictures import drawing_of, picture_of  # noqa: PLC0415 - OpenCV

    scores = {one.truth.frame: one for one in worst}
    folder = directory if directory.is_dir() else directory.parent
    for line in read_truth(directory):
        one = scores.get(line["frame"])
        if one is None:
            continue
        try:
            picture = picture_of(folder, line, len(worst))
        except ExportError:  # a set may be scored without its images
            continue
        drawn = {"facts": _facts(one), "outcome": str(one.outcome), "answer": _answer_marks(one, star_px)}
        yield one.truth.frame, (drawing_of(line) | drawn, picture.jpeg)


def _facts(one: FrameScore) -> str:
    facts = [str(one.outcome)]
    if one.attitude is not None:
        facts += [
            f"optical axis {degrees(one.attitude.boresight_rad):.3g} deg off",
            f"rotation about it {degrees(one.attitude.roll_rad):.3g} deg off",
        ]
    if one.position is not None:
        facts.append(f"position {one.position.distance_km:.3g} km off")
    if one.stars is not None:
        facts.append(f"{one.stars.correct} of {one.stars.identified} identified stars right")
    return "; ".join([*facts, f"{int(one.truth.is_detectable.sum())} detectable stars"])


def _answer_marks(one: FrameScore, star_px: float) -> list[tuple[str, str]]:
    """Return the drawing of an answer: the class of a path, and its data."""
    if one.answer is None:
        return []
    marks = [] if one.answer.stars is None else _star_marks(one.truth, one.answer.stars, star_px)
    if one.answer.C_camera_icrs is not None:
        marks += _shift_marks(one.truth, one.answer.instant, one.answer.C_camera_icrs)
    return marks


def _star_marks(truth: FrameTruth, stars: ObservedStars, star_px: float) -> list[tuple[str, str]]:
    """Return a cross for each star of an answer."""
    index = {number: k for k, number in enumerate(truth.star_id.tolist())}
    marks = []
    for xy, number in list(zip(stars.xy_px, stars.star_id.tolist(), strict=True))[:_MOST_STARS]:
        k = index.get(number)
        off_px = np.inf if k is None else float(np.hypot(*(xy - truth.xy_px[stars.at][k])))
        is_right = number < 0 or off_px <= star_px or (k is not None and truth.distance_from_trail(k, xy) <= star_px)
        x, y, arm = float(xy[0]), float(xy[1]), _CROSS_PX
        if np.hypot(x, y) < 1e6:
            cross = f"M{x - arm:.1f} {y:.1f}h{2 * arm:g}M{x:.1f} {y - arm:.1f}v{2 * arm:g}"
            marks.append(("answers" if is_right else "wrong", cross))
    return marks


def _shift_marks(truth: FrameTruth, instant: str, C_answered_icrs: Float) -> list[tuple[str, str]]:
    """Return lines from detectable stars to their positions under an answered attitude."""
    true = truth.attitude(instant)
    if true is None:
        return []
    from_px = truth.xy_px[instant][truth.is_detectable][:_MOST_STARS]
    turned = truth.camera.unit_vectors(from_px) @ (C_answered_icrs @ true.T).T
    to_px = truth.camera.project(turned)
    known = np.isfinite(from_px).all(axis=1) & np.isfinite(to_px).all(axis=1) & (np.abs(to_px) < 1e5).all(axis=1)
    pairs = np.hstack([from_px, to_px])[known].tolist()
    return [("answers", f"M{x:.1f} {y:.1f}L{x_to:.1f} {y_to:.1f}") for x, y, x_to, y_to in pairs]
