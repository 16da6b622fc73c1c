"""The own clock of a table, converted to UTC by a column with UTC of which some cells may be wrong.

A cell repeats the UTC of the last fix, often truncated to seconds: only the row in which a value occurs first reads the
clock, and UTC then lies between that row and the one before it.  Offset and rate are those with which most of these
readings agree; others are cut.  Where the offset steps for longer than a glitch, another boot begins.
"""

from dataclasses import dataclass
from itertools import pairwise
from math import nan

import numpy as np

from glstar.arrays import Float, Integer, Mask
from glstar.telemetry.boots import find_boots, within
from glstar.telemetry.source import Boot, valid_times

# Readings agree with a clock within this time, s, or within the interval of rows: as those of logs do.
_SAME_CLOCK_S = 0.5
# The rate of a clock differs less from that of UTC; otherwise its unit is wrong.
_MAX_RATE = 0.01
# A clock keeps the rate of UTC if at least this fraction of its readings agree with it then.
_NO_RATE_FRACTION = 0.98
# A smaller drift over the table is none, s.
_SMALLEST_DRIFT_S = 0.002
# Readings of UTC with whole seconds: each is early by up to a second.
_WHOLE_S = 1e-6
# Number of readings, and of pairs of them, from which rates are estimated.
_SUBSAMPLE = 200
_PAIRS = 400
# Fewest readings of another clock within a table, and largest number of such clocks.
_FEWEST_READINGS = 3
_MAX_CLOCKS = 8
# With more steps back of the clock, the rows are simply not sorted.
_MAX_STEPS_BACK = 20
# A time that steps by more, s, and comes back within the length of a glitch, s, was wrong in between.
_JUMP_S = 0.5
_GLITCH_S = 10.0
# Rows at longer intervals say nothing about boots, s.
_SLOW_ROWS_S = 2.0


@dataclass(frozen=True, slots=True, eq=False)
class ClockFit:
    """UTC of (n,) rows of a boot by their clock."""

    rate: float  # Seconds of UTC per second of the clock, minus 1
    reference_s: float  # Time of the clock at which both scales of it agree, s
    utc_minus_clock_s: float  # UTC minus the clock at the rate of UTC, s
    rows: Integer  # (k,) rows with readings that agree
    utc_s: Float  # (k,) their UTC, s since 1970
    cut: Integer  # Rows whose UTC disagrees
    largest_s: float  # Largest disagreement, s; 0 without one
    reason: str = ""  # Why there is no UTC; empty if there is

    def at_rate_of_utc(self, clock_s: Float) -> Float:
        """Return times of the clock, s, at the rate of UTC."""
        return clock_s + self.rate * (clock_s - self.reference_s)


@dataclass(frozen=True, slots=True, eq=False)
class _Readings:
    """Rows in which a value of UTC occurs first."""

    rows: Integer  # (n,)
    clock_s: Float  # (n,) clock in that row
    before_s: Float  # (n,) clock in the row before it
    utc_s: Float  # (n,)
    are_held: bool  # Whether most values are repeated in the rows after it, or have whole seconds

    def only(self, which: Mask) -> "_Readings":
        columns = (self.rows, self.clock_s, self.before_s, self.utc_s)
        return _Readings(*(column[which] for column in columns), self.are_held)  # type: ignore[arg-type]

    @property
    def offset_s(self) -> Float:
        return self.utc_s - self.clock_s

    @property
    def tolerance_s(self) -> float:
        return max(_SAME_CLOCK_S, float(np.median(self.clock_s - self.before_s)) if self.rows.size else 0.0)

    def at_rate(self, rate: float, reference_s: float) -> "_Readings":
        clock_s, before_s = (times + rate * (times - reference_s) for times in (self.clock_s, self.before_s))
        return _Readings(self.rows, clock_s, before_s, self.utc_s, self.are_held)


def has_whole_seconds(utc_s: Float) -> bool:
    """Return whether most of (n,) readings of UTC, s, have whole seconds."""
    utc_s = utc_s[np.isfinite(utc_s)]
    return utc_s.size > 0 and float(np.mean(np.abs(utc_s - np.round(utc_s)) < _WHOLE_S)) > 0.5


def first_of_each_time(utc_s: Float) -> Mask:
    """Return which of (n,) rows are the first one with their time, s; not those of a first time that is held."""
    finite = np.flatnonzero(np.isfinite(utc_s))
    values, first, count = np.unique(utc_s[finite], return_index=True, return_counts=True)
    mask = np.zeros(utc_s.size, dtype=bool)
    mask[finite[first]] = True
    # How long the first value had been held before the table began is unknown.
    if values.size > 1:
        start = int(np.argmin(first))
        mask[finite[first[start]]] = count[start] == 1 and np.median(count) == 1
    return mask


def in_first_second(utc_s: Float) -> Mask:
    """Return which of (n,) rows repeat the first time, s, if times are truncated to seconds: they are later than it."""
    count = np.unique(utc_s, return_counts=True)[1]
    if count.size < 2 or np.median(count) < _FEWEST_READINGS or not has_whole_seconds(utc_s):
        return np.zeros(utc_s.size, dtype=bool)
    return np.asarray(utc_s == utc_s[0])


def clock_boots(clock_s: Float, utc_s: Float) -> tuple[Boot, ...]:
    """Return the boots of a table, whose positions are rows: its clock steps back, or steps against its UTC.

    `clock_s` (n,): the clock, s; `utc_s` (n,): its readings of UTC, s since 1970; NaN where there is none.
    """
    rows = np.arange(clock_s.size)
    steps_s = np.diff(clock_s[np.isfinite(clock_s)])
    if steps_s.size < 2 or np.count_nonzero(steps_s < 0) > _MAX_STEPS_BACK or np.median(steps_s) > _SLOW_ROWS_S:
        return (Boot(1),)
    readings = _readings(clock_s, utc_s)
    agreed_s = readings.utc_s.copy()
    remaining = np.ones(readings.rows.size, dtype=bool)
    for _ in range(_MAX_CLOCKS):
        if np.count_nonzero(remaining) < _FEWEST_READINGS:
            break
        part = readings.only(remaining)
        offset_s, rate = _line(part)
        line_s = offset_s + rate * (readings.clock_s - part.clock_s[0])
        agree = remaining & (np.abs(readings.offset_s - line_s) <= readings.tolerance_s)
        if np.count_nonzero(agree) < _FEWEST_READINGS:
            break
        # Without the scatter of readings within a row, which is no step.
        agreed_s[agree] = readings.clock_s[agree] + offset_s
        remaining &= ~agree
    return find_boots([(rows, clock_s)], (readings.rows, readings.clock_s, agreed_s), checked=True)


def fitted_clock(clock_s: Float, utc_s: Float) -> ClockFit:
    """Return offset and rate of the clock of the rows of a boot.

    `clock_s` (n,): the clock, s; `utc_s` (n,): its readings of UTC, s since 1970; NaN where there is none.
    """
    nothing = np.empty(0, dtype=np.int64)
    cells = np.flatnonzero(np.isfinite(clock_s) & np.isfinite(utc_s))
    readings = _readings(clock_s, utc_s)

    def refused(reason: str) -> ClockFit:
        return ClockFit(0.0, 0.0, nan, nothing, np.empty(0), nothing, 0.0, reason)

    if not cells.size:
        return refused("its time counts from its own start, and it has no column with UTC")
    if np.ptp(utc_s[cells]) == 0 and np.ptp(clock_s[cells]) > 1 + readings.tolerance_s:
        return refused("its UTC stands still")
    if (unit := _wrong_rate(readings)) is not None:
        return refused(f"in one second of its clock its UTC goes on by {unit:.6g} s; check time_unit")
    offset_s, rate = _line(readings)
    line_s = offset_s + rate * (readings.clock_s - readings.clock_s[0])
    agree = np.abs(readings.offset_s - line_s) <= readings.tolerance_s
    if 2 * np.count_nonzero(agree) <= readings.rows.size:
        return refused(f"of its {readings.rows.size} readings of UTC no more than half agree with its clock")
    used = readings.only(agree)
    rate, reference_s = _refined_rate(used), float(np.median(used.clock_s))
    at_rate = used.at_rate(rate, reference_s)
    if readings.are_held:
        # UTC minus the clock is largest just after the tick, but no more than the row before it allows.
        offset_s = _most_common(at_rate.offset_s, at_rate.utc_s - at_rate.before_s)[0]
    else:
        offset_s = float(np.median(at_rate.offset_s))
    cell_clock_s = clock_s[cells] + rate * (clock_s[cells] - reference_s)
    ahead_s = utc_s[cells] - cell_clock_s - offset_s
    held_s = _usual_hold_s(readings)
    odd = (ahead_s > readings.tolerance_s) | (ahead_s < -readings.tolerance_s - held_s)
    largest_s = float(np.abs(ahead_s[odd]).max(initial=0.0))
    return ClockFit(rate, reference_s, offset_s, used.rows, used.utc_s, cells[odd], largest_s)


def _readings(clock_s: Float, utc_s: Float) -> _Readings:
    """Return the rows in which a value of UTC occurs first."""
    timed = np.isfinite(clock_s)
    cells = timed & np.isfinite(utc_s)
    first = first_of_each_time(np.where(cells, utc_s, nan))
    rows = np.flatnonzero(first)
    all_s, place = clock_s[timed], np.cumsum(timed)[rows] - 1
    step_s = float(np.median(np.abs(np.diff(all_s)))) if all_s.size > 1 else 0.0
    before_s = np.where(place > 0, all_s[np.maximum(place - 1, 0)] if all_s.size else 0.0, clock_s[rows] - step_s)
    # After a step back of the clock the row before says nothing.
    before_s = np.where(before_s < clock_s[rows], before_s, clock_s[rows] - step_s)
    repeated = rows.size < 0.9 * np.count_nonzero(cells)
    return _Readings(rows, clock_s[rows], before_s, utc_s[rows], bool(repeated or has_whole_seconds(utc_s[rows])))


def _usual_hold_s(readings: _Readings) -> float:
    """Return for how long a value of UTC is usually repeated, s; a truncated second for at least a second."""
    if not readings.are_held or readings.rows.size < 2:
        return 1.0 if has_whole_seconds(readings.utc_s) else 0.0
    return max(float(np.median(np.abs(np.diff(readings.utc_s)))), 1.0 if has_whole_seconds(readings.utc_s) else 0.0)


def _most_common(low: Float, high: Float) -> tuple[float, int]:
    """Return where most of (n,) closed intervals overlap, its lower end, and how many do."""
    ends = np.concatenate([low, high])
    begins = np.concatenate([np.ones(low.size, dtype=np.int64), -np.ones(high.size, dtype=np.int64)])
    order = np.lexsort((-begins, ends))
    count = np.cumsum(begins[order])
    best = int(np.argmax(count))
    return float(ends[order][best]), int(count[best])


def _line(readings: _Readings) -> tuple[float, float]:
    """Return the offset at the first reading, s, and the rate of the line with which most readings agree."""
    clock_s, offset_s, tolerance_s = readings.clock_s - readings.clock_s[0], readings.offset_s, readings.tolerance_s

    def count_at(rate: float) -> tuple[int, float]:
        level_s = offset_s - rate * clock_s
        low_s, count = _most_common(level_s - tolerance_s, level_s + tolerance_s)
        near_s = level_s[(level_s >= low_s - tolerance_s) & (level_s <= low_s + tolerance_s)]
        return count, float(np.median(near_s))

    count, best_s = count_at(0.0)
    rate = 0.0
    if count >= 0.9 * offset_s.size:
        return best_s, rate
    random = np.random.default_rng(0)
    one, other = random.integers(0, offset_s.size, (2, _PAIRS))
    apart = clock_s[one] != clock_s[other]
    slopes = (offset_s[other] - offset_s[one])[apart] / (clock_s[other] - clock_s[one])[apart]
    for slope in np.unique(slopes[np.abs(slopes) <= _MAX_RATE]).tolist():
        more, level_s = count_at(slope)
        if more > 1.1 * count + 1:
            count, best_s, rate = more, level_s, slope
    return best_s, rate


def _refined_rate(readings: _Readings) -> float:
    """Return the rate of UTC against the clock, minus 1, by readings that agree; 0 if they agree without."""
    low_s, high_s = readings.offset_s, readings.utc_s - readings.before_s
    span_s = float(np.ptp(readings.clock_s))
    if low_s.size < _FEWEST_READINGS or span_s <= 0:
        return 0.0
    if readings.are_held:
        margin_s = 0.1 * (high_s - low_s) + _SMALLEST_DRIFT_S
        if _most_common(low_s - margin_s, high_s + margin_s)[1] >= _NO_RATE_FRACTION * low_s.size:
            return 0.0
    rate = _median_slope(readings.clock_s, low_s)
    residual_s = low_s - rate * readings.clock_s
    scatter_s = 1.4826 * float(np.median(np.abs(residual_s - np.median(residual_s))))
    is_drift = abs(rate) * span_s > max(3 * scatter_s, _SMALLEST_DRIFT_S)
    return rate if is_drift and abs(rate) <= _MAX_RATE else 0.0


def _median_slope(x: Float, y: Float) -> float:
    """Return the median slope between distant points (Theil and Sen)."""
    chosen = np.unique(np.linspace(0, x.size - 1, min(x.size, _SUBSAMPLE)).astype(int))
    one, other = np.triu_indices(chosen.size, 1)
    apart = x[chosen[other]] - x[chosen[one]]
    distant = np.abs(apart) >= np.ptp(x) / 4
    return float(np.median((y[chosen[other]] - y[chosen[one]])[distant] / apart[distant])) if distant.any() else 0.0


def _wrong_rate(readings: _Readings) -> float | None:
    """Return the rate of UTC against a clock in another unit than it says; None if the unit is right."""
    if readings.rows.size < _FEWEST_READINGS or np.ptp(readings.clock_s) <= 0:
        return None
    slope = _median_slope(readings.clock_s, readings.utc_s)
    return None if 0.5 < slope < 2 or slope <= 0 else slope


def valid_rows(clock_s: Float) -> Mask:
    """Return which of (n,) times of rows, s, are valid: finite, and no excursion that soon comes back.

    Rows that are not sorted are all valid if finite.
    """
    finite = np.isfinite(clock_s)
    steps_s = np.diff(clock_s[finite])
    if np.count_nonzero(steps_s < 0) > max(_MAX_STEPS_BACK, 0.02 * clock_s.size):
        return finite
    valid = valid_times(clock_s)
    rows = np.flatnonzero(valid)
    times_s = clock_s[rows]
    if rows.size < _FEWEST_READINGS:
        return valid
    usual_s = float(np.median(np.abs(np.diff(times_s))))
    longest = max(2, int(_GLITCH_S / usual_s)) if usual_s > 0 else 2
    jumps = np.flatnonzero((np.diff(times_s) < -_JUMP_S) | (np.diff(times_s) > _JUMP_S + 3 * usual_s))
    start = 0
    for one, other in pairwise(jumps.tolist()):
        before_s, inside_s, after_s = times_s[one], times_s[one + 1 : other + 1], times_s[other + 1]
        # The time goes on after the excursion as if it had not been.
        continues = 0 <= after_s - before_s <= 3 * (other + 1 - one) * usual_s + _JUMP_S
        outside = bool((inside_s > after_s).all() or (inside_s < before_s).all())
        if one >= start and continues and outside and inside_s.size <= longest:
            valid[rows[one + 1 : other + 1]] = False
            start = other + 1
    return valid


def rows_of(boot: Boot, size: int) -> Mask:
    """Return which of the rows of a table belong to a boot."""
    return within(np.arange(size), boot.spans)


def described_cuts(fit: ClockFit, cells: int, lines: Integer) -> str:
    """Return a remark on the cells of UTC that disagree with a clock.  `lines` (n,): line of each row."""
    verb = "disagrees" if fit.cut.size == 1 else "disagree"
    return (
        f"{fit.cut.size} of its {cells} cells of UTC {verb} with its clock by up to {fit.largest_s:.1f} s"
        f" (the first one in line {int(lines[fit.cut.min()])}) and {'is' if fit.cut.size == 1 else 'are'} not used"
    )


def left_out_rows(count: int) -> str:
    """Return a remark on a number of rows with an impossible time."""
    return f"{count} row{'s have' if count > 1 else ' has'} an impossible time and {'are' if count > 1 else 'is'} left out"
