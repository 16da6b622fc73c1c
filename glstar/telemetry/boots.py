"""Detection of reboots in a log: each boot has its own clock, and its UTC says nothing about another boot.

A file holds several boots if its logger never closes it, or if files were joined.  `find_boots` finds them from the
order of the records in the file:

==================================================  ==================================================================
mark                                                meaning
==================================================  ==================================================================
the head of a log file                              another file begins
the clock of one kind of record goes back by 0.1 s  another boot, or another part of one
the clock goes forward by more than 5 s             perhaps another boot
UTC minus the clock changes by more than 0.5 s      another boot, or a receiver that was wrong for some seconds
==================================================  ==================================================================

Pieces between these marks belong to one boot if UTC minus the clock agrees and their times do not overlap.  A piece
without UTC is not assigned to the boot of another file.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from itertools import pairwise, product
from math import inf
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from glstar.arrays import Float, Integer
from glstar.telemetry.source import EVERYWHERE, Boot, Span, spikes

# File positions and times by the clock, s, of each kind of records.
_Series = Sequence[tuple[Integer, Float]]
# File positions, times by the clock and by another one, s.
_Readings = tuple[Integer, Float, Float]

# A larger step back between records of one kind is a reboot, s; they are written in the order of their times.
_BACK_S = 0.1
# Pieces of one boot may overlap by this time, s.
_OVERLAP_S = 1.0
# A larger step forward may be a reboot, s; SD cards stall for a second or two.
_FORWARD_S = 5.0
# UTC minus the clock agrees within this time, s: GPS records are logged up to 0.3 s late, but two boots never begin
# within half a second of each other.
_SAME_CLOCK_S = 0.5
# A link may delay single packets by seconds, but not all packets of several seconds, s.
_SAME_ARRIVAL_S = 1.0
# A receiver that is wrong for a shorter time, while the records continue, is no boot, s.
_GLITCH_S = 10.0
# Length of the running median of UTC readings: two wrong ones in a row change nothing.
_MEDIAN_OF = 5
# Longest interval of records that continue, in median intervals.
_UNBROKEN = 3.0
# A piece with fewer records is damaged.
_FEWEST_RECORDS = 3


_Mark = Literal["start", "head", "back", "forward", "step"]


@dataclass(slots=True, eq=False)
class _Piece:
    """A part of a file between two marks."""

    span: Span
    follows: _Mark  # At its start
    first_s: float = inf
    last_s: float = -inf
    records: int = 0
    utc_minus_clock_s: float | None = None
    arrival_minus_clock_s: float | None = None
    # UTC minus the clock steps at its start, while the records continue.
    unbroken: bool = False
    # The previous piece, without damaged ones.
    after: "_Piece | None" = None
    # The span without the records beside a cut.
    inner: Span = (0, 0)

    def __post_init__(self) -> None:
        self.inner = self.span


@dataclass(slots=True, eq=False)
class _Boot:
    """The pieces of one boot, in the order of the file."""

    pieces: list[_Piece] = field(default_factory=list)

    @property
    def utc_minus_clock_s(self) -> float | None:
        with_utc = [piece for piece in self.pieces if piece.utc_minus_clock_s is not None]
        return max(with_utc, key=lambda piece: piece.records).utc_minus_clock_s if with_utc else None

    @property
    def arrival_minus_clock_s(self) -> float | None:
        return self.pieces[-1].arrival_minus_clock_s

    @property
    def last_s(self) -> float:
        return max(piece.last_s for piece in self.pieces)

    @property
    def records(self) -> int:
        return sum(piece.records for piece in self.pieces)

    def overlaps(self, other: _Piece) -> bool:
        """Return whether the times of a piece and of the boot overlap by more than a second."""
        return any(
            piece.first_s < other.last_s - _OVERLAP_S and other.first_s < piece.last_s - _OVERLAP_S
            for piece in self.pieces
        )


def within(position: Integer, spans: Sequence[Span]) -> NDArray[np.bool_]:
    """Return which of (n,) positions in a file are within any of some half-open ranges."""
    inside = np.zeros(position.shape, dtype=np.bool_)
    for start, stop in spans:
        inside |= (position >= start) & (position < stop)
    return inside


def find_boots(
    series: _Series,
    readings: _Readings,
    heads: Sequence[int] = (),
    alike: Callable[[int, int], bool] = lambda one, other: True,  # noqa: ARG005 - logs without layouts
    *,
    knows_utc: bool | None = None,
    arrivals: _Readings | None = None,
    back_s: float = _BACK_S,
    checked: bool = False,
) -> tuple[Boot, ...]:
    """Return the boots of a log, at least one; a single boot without damage spans all positions.

    `series`: (n,) increasing positions in the file and times by the clock of each kind of record; NaN for damaged ones.
    `readings`: of UTC, s since 1970.  `heads`: positions at which another log file begins.  `alike`: whether records at
    two positions have the same layouts, as records of one boot do.  `knows_utc`: whether the log has UTC, so that a
    piece without readings is not assigned by its order; by default whether there are readings.  `arrivals`: records
    with an arrival time by the recorder's clock; they separate boots without UTC readings.  `back_s`: the smallest step
    back of the clock of one kind of record that begins another boot, s.  `checked`: whether records have checksums.
    Without them, the first half of a record before a cut and the second half of another one after it may look like a
    record; the records beside a cut are then assigned to no boot.
    """
    valid = [_valid_series(position, clock_s, back_s) for position, clock_s in series]
    valid = [(position, clock_s) for position, clock_s in valid if position.size]
    readings = _finite_readings(*readings)
    pieces = _cut_at_clock(valid, heads, back_s)
    pieces = [part for piece in pieces for part in _cut_at_steps(piece, valid, readings)]
    if arrivals is not None:
        pieces = [part for piece in pieces for part in _cut_at_arrivals(piece, arrivals)]
    if not checked:
        _find_halves(pieces, valid)
    for piece in pieces:
        _measure(piece, valid, readings, arrivals)
    strict = bool(readings[0].size) if knows_utc is None else knows_utc
    boots = _assigned(pieces, lambda piece, boot: _is_of(piece, boot, strict) and _agree(piece, boot, alike))
    used = [piece for piece in pieces if any(piece in boot.pieces for boot in boots)]
    in_order = len(used) == len(pieces) and all(piece.follows != "back" for piece in pieces)
    if not boots or (len(boots) == 1 and in_order):
        return (Boot(1),)
    _leave_out_halves(used, boots)
    spans = [tuple(piece.span for piece in boot.pieces) for boot in boots]
    return _with_doubts([(Boot(number, spans[number - 1]), boot) for number, boot in enumerate(boots, start=1)])


def _find_halves(pieces: Sequence[_Piece], series: _Series) -> None:
    """Set the spans of pieces without the records beside a cut, which may be halves of two records."""
    position = np.sort(np.concatenate([p for p, _ in series])) if series else np.empty(0, dtype=np.int64)
    for before, after in pairwise(pieces):
        if after.follows in ("back", "forward"):
            last = int(np.searchsorted(position, after.span[0])) - 1
            first = int(np.searchsorted(position, after.span[0], side="right"))
            before.inner = (before.inner[0], int(position[last]) if last >= 0 else before.inner[1])
            after.inner = (int(position[first]) if first < position.size else after.span[1], after.inner[1])


def _leave_out_halves(pieces: Sequence[_Piece], boots: "Sequence[_Boot]") -> None:
    """Remove the records beside a cut, unless the clock only went forward within a boot."""
    for before, after in pairwise(pieces):
        together = any(before in boot.pieces and after in boot.pieces for boot in boots)
        if before.span[1] == after.span[0] and (after.follows == "back" or not together):
            before.span = (before.span[0], before.inner[1])
            after.span = (after.inner[0], after.span[1])


def _valid_series(position: Integer, clock_s: Float, back_s: float) -> tuple[Integer, Float]:
    """Return a series without damaged times."""
    finite = np.isfinite(clock_s)
    position, clock_s = position[finite], clock_s[finite]
    valid = ~spikes(clock_s, back_s)
    return position[valid], clock_s[valid]


def _finite_readings(position: Integer, clock_s: Float, utc_s: Float) -> _Readings:
    finite = np.isfinite(clock_s) & np.isfinite(utc_s)
    return position[finite], clock_s[finite], utc_s[finite]


def _cut_at_clock(series: _Series, heads: Sequence[int], back_s: float) -> list[_Piece]:
    """Return the pieces between heads of files and jumps of the clock."""
    marks: dict[int, _Mark] = {head: "head" for head in heads if head > 0}
    # Jumps forward are searched between jumps back.
    searches: list[tuple[_Mark, Callable[[_Series], list[tuple[int, int]]]]]
    searches = [("back", partial(_backward, back_s=back_s)), ("forward", _forward)]
    for kind, find in searches:
        for start, stop in pairwise([0, *sorted(marks), EVERYWHERE]):
            jumps = find([(p[(p >= start) & (p < stop)], c[(p >= start) & (p < stop)]) for p, c in series])
            marks |= dict.fromkeys(_covering(jumps), kind)
    bounds = [0, *sorted(marks), EVERYWHERE]
    kinds: list[_Mark] = ["start", *(marks[at] for at in sorted(marks))]
    return [_Piece(span, kind) for span, kind in zip(pairwise(bounds), kinds, strict=True)]


def _backward(series: _Series, back_s: float) -> list[tuple[int, int]]:
    """Return where the clock of most kinds of records steps back, as the positions before and after."""
    steps = [[(int(p[i]), int(p[i + 1])) for i in np.flatnonzero(np.diff(c) < -back_s)] for p, c in series]
    jumps = []
    for of_kind in steps:
        for before, after in of_kind:
            spanning = [p.size for p, _ in series if p.size and p[0] <= before and p[-1] >= after]
            agreeing = [
                p.size
                for (p, _), others in zip(series, steps, strict=True)
                if any(start < after and before < stop for start, stop in others)
            ]
            if 2 * sum(agreeing) >= sum(spanning):
                jumps.append((before, after))
    return jumps


def _forward(series: _Series) -> list[tuple[int, int]]:
    """Return where the clock of all records together steps forward, as the positions before and after."""
    if not series:
        return []
    position = np.concatenate([p for p, _ in series])
    clock_s = np.concatenate([c for _, c in series])
    order = np.argsort(position, kind="stable")
    position, clock_s = position[order], clock_s[order]
    if not clock_s.size:
        return []
    highest = np.maximum.accumulate(clock_s[:-1]) if clock_s.size > 1 else np.empty(0)
    # Compared with the previous record and with the latest time before it: records may be slightly out of order.
    forward = (np.diff(clock_s) > _FORWARD_S) & (clock_s[1:] - highest > _FORWARD_S)
    return [(int(position[i]), int(position[i + 1])) for i in np.flatnonzero(forward)]


def _covering(intervals: Sequence[tuple[int, int]]) -> list[int]:
    """Return the smallest set of positions such that each interval (before, after] contains one of them."""
    positions: list[int] = []
    for before, after in sorted(intervals, key=lambda interval: interval[1]):
        if not positions or before >= positions[-1]:
            positions.append(int(after))
    return positions


def _cut_at_steps(piece: _Piece, series: _Series, readings: _Readings) -> list[_Piece]:
    """Split a piece where UTC minus the clock steps."""
    inside = within(readings[0], (piece.span,))
    position, offset_s = readings[0][inside], (readings[2] - readings[1])[inside]
    if position.size < 2:
        return [piece]
    smooth_s = running_median(offset_s)
    steps = []
    for i in np.flatnonzero(np.abs(np.diff(smooth_s)) > _SAME_CLOCK_S).tolist():
        near = np.arange(max(0, i - 2), min(offset_s.size, i + 4))
        before_step = near[np.abs(offset_s[near] - smooth_s[i]) < _SAME_CLOCK_S]
        after_step = near[np.abs(offset_s[near] - smooth_s[i + 1]) < _SAME_CLOCK_S]
        ends = (before_step.max(initial=0), after_step.min(initial=offset_s.size - 1))
        if before_step.size and after_step.size:
            steps.append((int(position[min(ends)]), int(position[max(ends)])))
    parts = [piece]
    for before, after in sorted(set(steps)):
        last = parts[-1]
        if before < last.span[0] or after <= before:
            continue
        # The position of the step between the two readings is unknown: records between them belong to neither part.
        unbroken = _continues(series, before, after)
        parts[-1] = replace(last, span=(last.span[0], before + 1))
        parts.append(_Piece((after, last.span[1]), "step", unbroken=unbroken))
    return _without_glitches(parts, readings)


def _cut_at_arrivals(piece: _Piece, arrivals: _Readings) -> list[_Piece]:
    """Split a piece where the recorder's clock minus the autopilot's steps."""
    inside = within(arrivals[0], (piece.span,))
    position, offset_s = arrivals[0][inside], (arrivals[2] - arrivals[1])[inside]
    if position.size < _MEDIAN_OF:
        return [piece]
    steps = np.flatnonzero(np.abs(np.diff(running_median(offset_s))) > _SAME_ARRIVAL_S)
    # The running median steps one or two records later: the largest change nearby is the step.
    near = {int(i + np.argmax(np.abs(np.diff(offset_s[max(0, i - 2) : i + 4]))) - min(i, 2)) for i in steps.tolist()}
    bounds = [piece.span[0], *(int(position[i + 1]) for i in sorted(near)), piece.span[1]]
    kinds: list[_Mark] = ["forward"] * (len(near) + 1)
    kinds[0] = piece.follows
    return [_Piece(span, kind) for span, kind in zip(pairwise(bounds), kinds, strict=True) if span[0] < span[1]]


def running_median(values: Float) -> Float:
    """Return the running median, constant at the ends."""
    half = _MEDIAN_OF // 2
    if values.size < _MEDIAN_OF:
        return np.full(values.size, np.median(values))
    inner = np.median(np.lib.stride_tricks.sliding_window_view(values, _MEDIAN_OF), axis=-1)
    return np.concatenate([np.full(half, inner[0]), inner, np.full(half, inner[-1])])


def _continues(series: _Series, before: int, after: int) -> bool:
    """Return whether the series with most records continues between two positions."""
    if not series:
        return False
    position, clock_s = max(series, key=lambda records: records[0].size)
    first, last = np.searchsorted(position, before, side="right") - 1, np.searchsorted(position, after)
    part_s = clock_s[max(0, first) : last + 1]
    if part_s.size < 2 or clock_s.size < 3:
        return False
    usual_s = float(np.median(np.abs(np.diff(clock_s))))
    steps_s = np.diff(part_s)
    return bool((steps_s >= 0).all() and steps_s.max() <= _UNBROKEN * usual_s)


def _without_glitches(parts: list[_Piece], readings: _Readings) -> list[_Piece]:
    """Join parts that are separated only by a receiver's error: short, while the records continue."""
    while (pair := _same_boot(parts, readings)) is not None:
        first, second = parts[pair], parts[pair + 1]
        parts[pair : pair + 2] = [replace(first, span=(first.span[0], second.span[1]))]
    return parts


def _same_boot(parts: Sequence[_Piece], readings: _Readings) -> int | None:
    """Return the first of two neighbouring parts of one boot: one has UTC for some seconds only, or both agree."""
    inside = [within(readings[0], (part.span,)) for part in parts]
    lengths_s = [float(np.ptp(readings[1][rows])) if rows.any() else 0.0 for rows in inside]
    offset_s = [float(np.median((readings[2] - readings[1])[rows])) if rows.any() else np.nan for rows in inside]
    for k in range(len(parts) - 1):
        alike = abs(offset_s[k] - offset_s[k + 1]) < _SAME_CLOCK_S
        if parts[k + 1].unbroken and (alike or min(lengths_s[k : k + 2]) < _GLITCH_S):
            return k
    return None


def _measure(
    piece: _Piece,
    series: _Series,
    readings: _Readings,
    arrivals: _Readings | None,
) -> None:
    """Set first and last time of a piece, and UTC and the recorder's clock minus its clock."""
    for position, clock_s in series:
        times_s = clock_s[within(position, (piece.inner,))]
        piece.records += times_s.size
        piece.first_s = min(piece.first_s, float(times_s.min(initial=inf)))
        piece.last_s = max(piece.last_s, float(times_s.max(initial=-inf)))
    piece.utc_minus_clock_s = _offset_s(piece, readings)
    piece.arrival_minus_clock_s = None if arrivals is None else _offset_s(piece, arrivals)


def _offset_s(piece: _Piece, readings: _Readings) -> float | None:
    """Return the median of another clock minus the autopilot's within a piece, s; None without readings."""
    inside = within(readings[0], (piece.inner,))
    return float(np.median((readings[2] - readings[1])[inside])) if inside.any() else None


def _assigned(pieces: Sequence[_Piece], same: Callable[[_Piece, _Boot], bool]) -> list[_Boot]:
    """Assign pieces to boots."""
    boots: list[_Boot] = []
    last: _Piece | None = None
    for piece in pieces:
        if piece.records < _FEWEST_RECORDS:
            continue
        piece.after, last = last, piece
        boot = next((boot for boot in boots if same(piece, boot)), None)
        if boot is None:
            boot = _Boot()
            boots.append(boot)
        boot.pieces.append(piece)
    return boots


def _agree(piece: _Piece, boot: _Boot, alike: Callable[[int, int], bool]) -> bool:
    return alike(boot.pieces[0].span[0], piece.span[0])


def _is_of(piece: _Piece, boot: _Boot, strict: bool) -> bool:
    """Return whether a piece belongs to a boot; if `strict`, a piece after a step forward does not without UTC."""
    if piece.utc_minus_clock_s is not None and boot.utc_minus_clock_s is not None:
        same = abs(piece.utc_minus_clock_s - boot.utc_minus_clock_s) < _SAME_CLOCK_S
        return same and not boot.overlaps(piece)
    pause_s = piece.first_s - boot.last_s
    if piece.follows == "head" or pause_s < -_OVERLAP_S:
        return False
    if piece.arrival_minus_clock_s is not None and boot.arrival_minus_clock_s is not None:
        return abs(piece.arrival_minus_clock_s - boot.arrival_minus_clock_s) < _SAME_ARRIVAL_S
    return piece.after is boot.pieces[-1] and (pause_s <= _FORWARD_S or not strict)


def _with_doubts(boots: Sequence[tuple[Boot, _Boot]]) -> tuple[Boot, ...]:
    """Mark boots whose UTC may be a receiver's error: it steps while the records continue."""
    labelled = []
    for boot, pieces in boots:
        doubt = ""
        for other_boot, others in boots:
            step_s = _unbroken_step_s(pieces, others)
            if step_s is not None and (others.records, other_boot.number) > (pieces.records, boot.number):
                doubt = f"UTC steps by {step_s:.1f} s between it and boot {other_boot.number}, but the clock goes on"
        labelled.append(replace(boot, doubt=doubt))
    return tuple(labelled)


def _unbroken_step_s(boot: _Boot, other: _Boot) -> float | None:
    """Return the step of UTC between two boots whose records continue, s; None if they do not."""
    for pair in product(boot.pieces, other.pieces):
        first, second = sorted(pair, key=lambda piece: piece.span[0])
        continues = second.unbroken and 0 <= second.first_s - first.last_s < _FORWARD_S
        if continues and first.utc_minus_clock_s is not None and second.utc_minus_clock_s is not None:
            return abs(first.utc_minus_clock_s - second.utc_minus_clock_s)
    return None
