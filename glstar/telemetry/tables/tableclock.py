"""The own clock of a table, converted to UTC by a column with UTC of which some cells may be wrong.

A cell repeats the UTC of the last fix, often truncated to seconds: only the row in which a value occurs first reads the
clock, and UTC then lies between that row and the one before it.  Offset and rate are those with which most of these
readings agree; others are cut.  Where the offset steps for longer than a glitch, another boot begins.
"""

import re
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from itertools import pairwise
from math import nan, remainder

import numpy as np

from glstar.arrays import Float, Integer, Mask, robust_std
from glstar.errors import LogFormatError
from glstar.sky.place.timescale import CLOCK_GRAIN_S, GPS_EPOCH_S, ROLLOVER_WEEKS, WEEK_S, format_utc, leap_seconds
from glstar.telemetry.boots import find_boots, within
from glstar.telemetry.source import Boot, plausible_utc, valid_times
from glstar.telemetry.tables.files import TableFile

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
# Number of readings, of cells, and of pairs of them, from which rates are estimated.
_SUBSAMPLE = 200
_CELLS = 2000
_PAIRS = 200
# At least this fraction of the cells of a boot agree; those of a clock that stands still do not.
_FEWEST_AGREEING = 0.25
# At least this fraction of those that do not stand still agree; otherwise either of two clocks may be wrong.
_FEWEST_AGREEING_MOVING = 0.6
# A smaller step back of the clock is no other boot, s.
_BACK_S = 0.1
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
# Columns of GPS time, and of the number of its week, by their names.
_GPS_TIME = re.compile(r"gps|gnss|week|(?<![a-z])i?tow(?![a-z])", re.IGNORECASE)
_GPS_WEEK = re.compile(r"(gps|gnss)?(wn|gwk|wk|week)(no|num|number)?", re.IGNORECASE)
# A column with UTC is behind the time of its row by less, s: the interval of fixes, and truncated seconds.
_FIX_S = 5.0
# Seconds since 1980 of a flight before 2026, taken as seconds since 1970, s: before 2017.
_EARLY_S = 1483228800.0


@dataclass(frozen=True, slots=True, eq=False)
class ClockFit:
    """UTC of (n,) rows of a boot by their clock."""

    rate: float  # Seconds of UTC per second of the clock, minus 1
    reference_s: float  # Time of the clock at which both scales of it agree, s
    utc_minus_clock_s: float  # UTC minus the clock at the rate of UTC, s
    cells: int  # Number of rows with UTC
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
        return replace(
            self,
            rows=self.rows[which],
            clock_s=self.clock_s[which],
            before_s=self.before_s[which],
            utc_s=self.utc_s[which],
        )

    @property
    def offset_s(self) -> Float:
        return self.utc_s - self.clock_s

    def at_rate(self, rate: float, reference_s: float) -> "_Readings":
        clock_s, before_s = (times + rate * (times - reference_s) for times in (self.clock_s, self.before_s))
        return replace(self, clock_s=clock_s, before_s=before_s)


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
    usual_s = float(np.median(np.abs(steps_s))) if steps_s.size else 0.0
    if steps_s.size < 2 or np.count_nonzero(steps_s < 0) > _MAX_STEPS_BACK or usual_s > _SLOW_ROWS_S:
        return (Boot(1),)
    back_s, hold_s = max(_BACK_S, 1.5 * usual_s), _usual_hold_s(clock_s, utc_s)
    timed = np.flatnonzero(np.isfinite(clock_s))
    # A line across a step back would fit both of its sides, with a rate that neither has.
    starts = timed[1:][np.diff(clock_s[timed]) < -back_s]
    found = [
        part
        for cells in np.split(timed, np.searchsorted(timed, starts))
        for part in _lines(clock_s, utc_s, cells[np.isfinite(utc_s[cells])], usual_s, hold_s)
    ]
    at = np.concatenate([np.empty(0, dtype=np.int64), *(part for part, _ in found)])
    agreed_s = np.concatenate([np.empty(0), *(part for _, part in found)])
    order = np.argsort(at)
    readings_of_utc = (at[order], clock_s[at[order]], agreed_s[order])
    return find_boots([(rows, clock_s)], readings_of_utc, back_s=back_s, checked=True)


def _lines(
    clock_s: Float, utc_s: Float, cells: Integer, usual_s: float, hold_s: float
) -> Iterator[tuple[Integer, Float]]:
    """Yield the rows of the readings of each clock among (k,) cells, and their UTC by that clock, s.

    `usual_s`: interval of rows; `hold_s`: how long UTC stands still between two fixes, s.
    """
    remaining = np.ones(cells.size, dtype=bool)
    for _ in range(_MAX_CLOCKS):
        if np.count_nonzero(remaining) < _FEWEST_READINGS:
            break
        offset_s, agree = _line(clock_s[cells], utc_s[cells], remaining, usual_s, hold_s)
        readings = _readings(clock_s, utc_s, cells[agree])
        if readings.rows.size < _FEWEST_READINGS:
            break
        # Without the scatter of readings within a row, which is no step.
        yield readings.rows, readings.clock_s + offset_s
        remaining &= ~agree


def fitted_clock(clock_s: Float, utc_s: Float) -> ClockFit:
    """Return offset and rate of the clock of the rows of a boot.

    `clock_s` (n,): the clock, s; `utc_s` (n,): its readings of UTC, s since 1970; NaN where there is none.
    """
    nothing = np.empty(0, dtype=np.int64)
    cells = np.flatnonzero(np.isfinite(clock_s) & np.isfinite(utc_s))

    def refused(reason: str) -> ClockFit:
        return ClockFit(0.0, 0.0, nan, cells.size, nothing, np.empty(0), nothing, 0.0, reason)

    usual_s = float(np.median(np.abs(np.diff(clock_s)))) if clock_s.size > 1 else 0.0
    hold_s = _usual_hold_s(clock_s, utc_s)
    if reason := _no_utc(clock_s[cells], utc_s[cells], usual_s):
        return refused(reason)
    agree = _line(clock_s[cells], utc_s[cells], np.ones(cells.size, dtype=bool), usual_s, hold_s)[1]
    used = _readings(clock_s, utc_s, cells[agree])
    if np.count_nonzero(agree) < _FEWEST_AGREEING * cells.size or not used.rows.size:
        return refused(_disagreement(clock_s[cells], utc_s[cells], int(np.count_nonzero(agree))))
    moving = _moving(clock_s[cells], utc_s[cells], 1.5 * hold_s + usual_s)
    if np.count_nonzero(agree & moving) < _FEWEST_AGREEING_MOVING * np.count_nonzero(moving):
        return refused("its UTC has two different times, and most cells agree with neither")
    used = used.only(_near(used, usual_s))
    rate, reference_s = _refined_rate(used), float(np.median(used.clock_s))
    at_rate = used.at_rate(rate, reference_s)
    if used.are_held:
        # UTC minus the clock is largest just after the tick, but no more than the row before it allows.
        offset_s = _most_common(at_rate.offset_s, at_rate.utc_s - at_rate.before_s)[0]
    else:
        offset_s = float(np.median(at_rate.offset_s))
    ahead_s = utc_s[cells] - offset_s - clock_s[cells] - rate * (clock_s[cells] - reference_s)
    odd = (ahead_s > max(_SAME_CLOCK_S, usual_s)) | (ahead_s < -max(_SAME_CLOCK_S, usual_s) - hold_s)
    largest_s = float(np.abs(ahead_s[odd]).max(initial=0.0))
    return ClockFit(rate, reference_s, offset_s, cells.size, used.rows, used.utc_s, cells[odd], largest_s)


def _no_utc(clock_s: Float, utc_s: Float, usual_s: float) -> str:
    """Return why (k,) cells of UTC are of no use; empty if they are.  `usual_s`: interval of rows."""
    if not clock_s.size:
        return "its time counts from its own start, and it has no column with UTC"
    return "its UTC stands still" if np.ptp(utc_s) == 0 and np.ptp(clock_s) > 1 + usual_s else ""


def _disagreement(clock_s: Float, utc_s: Float, agreeing: int) -> str:
    """Return why few of (k,) cells of UTC agree with a clock."""
    unit = _median_slope(clock_s, utc_s)
    if unit == 0:
        return "its UTC stands still most of the time"
    if not 1 - _MAX_RATE < unit < 1 + _MAX_RATE:
        return f"in a second of its clock, its UTC goes on by {unit:.4g} s; check time_unit"
    return f"of its {utc_s.size} cells of UTC no more than {agreeing} agree with its clock"


def most_agree(fits: Sequence[ClockFit]) -> bool:
    """Return whether enough cells of UTC of all boots of a table agree with their clocks."""
    agreeing = sum(fit.cells - fit.cut.size for fit in fits if not fit.reason)
    return agreeing >= _FEWEST_AGREEING * sum(fit.cells for fit in fits)


def _readings(clock_s: Float, utc_s: Float, cells: Integer) -> _Readings:
    """Return which of the cells of UTC, (k,) rows, hold a value first."""
    only_s = np.full(utc_s.size, nan)
    only_s[cells] = utc_s[cells]
    rows = np.flatnonzero(first_of_each_time(only_s))
    repeated = rows.size < 0.9 * cells.size
    # Of values that are repeated, an empty cell before the first is missing: it may have held the same.
    timed = np.isfinite(clock_s) & np.isfinite(utc_s) if repeated else np.isfinite(clock_s)
    all_s, place = clock_s[timed], np.cumsum(timed)[rows] - 1
    step_s = float(np.median(np.abs(np.diff(all_s)))) if all_s.size > 1 else 0.0
    before_s = all_s[np.maximum(place - 1, 0)]
    # After a step back of the clock, and in the first row, the row before says nothing.
    before_s = np.where((place > 0) & (before_s < clock_s[rows]), before_s, clock_s[rows] - step_s)
    return _Readings(rows, clock_s[rows], before_s, utc_s[rows], bool(repeated or has_whole_seconds(utc_s[rows])))


def _usual_hold_s(clock_s: Float, utc_s: Float) -> float:
    """Return for how long a value of UTC is usually repeated, s; a truncated second for a second."""
    cells = np.flatnonzero(np.isfinite(clock_s) & np.isfinite(utc_s))
    changes = cells[1:][np.diff(utc_s[cells]) != 0]
    hold_s = float(np.median(np.abs(np.diff(clock_s[changes])))) if changes.size > 1 else 0.0
    return max(hold_s, 1.0) if has_whole_seconds(utc_s[cells]) else hold_s


def _moving(clock_s: Float, utc_s: Float, hold_s: float) -> Mask:
    """Return which of (k,) cells of UTC do not stand still: they have their value for no longer than is usual."""
    begins = np.concatenate([[True], np.diff(utc_s) != 0])
    start = np.maximum.accumulate(np.where(begins, np.arange(utc_s.size), 0))
    return np.asarray(np.abs(clock_s - clock_s[start]) <= hold_s)


def _near(readings: _Readings, usual_s: float) -> Mask:
    """Return which of (n,) readings agree with most of them about the offset, without rate."""
    margin_s = max(_SAME_CLOCK_S, usual_s)
    low_s = _most_common(readings.offset_s - margin_s, readings.offset_s + margin_s)[0]
    return np.asarray(np.abs(readings.offset_s - low_s) <= margin_s + _SMALLEST_DRIFT_S)


def _most_common(low: Float, high: Float) -> tuple[float, int]:
    """Return where most of (n,) closed intervals overlap, its lower end, and how many do."""
    low, high = np.sort(low), np.sort(high)
    # At each lower end: the intervals that have begun, without those that have ended before.
    count = np.searchsorted(low, low, side="right") - np.searchsorted(high, low)
    best = int(np.argmax(count))
    return float(low[best]), int(count[best])


def _line(clock_s: Float, utc_s: Float, chosen: Mask, usual_s: float, hold_s: float) -> tuple[float, Mask]:
    """Return UTC minus the clock with which most of some (k,) cells of UTC agree, s, and which of them do.

    `chosen` (k,): the cells; `usual_s`: interval of rows; `hold_s`: how long a value is repeated.
    """
    rows = np.flatnonzero(chosen)
    some = rows[:: max(1, rows.size // _CELLS)]
    origin_s = float(np.median(clock_s[some]))
    past_s, offset_s = clock_s[some] - origin_s, (utc_s - clock_s)[some]
    # With the resolution of seconds since 1970.
    reach_s = max(_SAME_CLOCK_S, usual_s) + hold_s / 2 + CLOCK_GRAIN_S

    def count_at(rate: float) -> tuple[int, float]:
        level_s = offset_s - rate * past_s
        low_s, count = _most_common(level_s - reach_s, level_s + reach_s)
        near_s = level_s[np.abs(level_s - low_s) <= reach_s + CLOCK_GRAIN_S]
        return count, (float(near_s.min()) + float(near_s.max())) / 2

    count, best_s = count_at(0.0)
    rate = 0.0
    if count < 0.9 * some.size:
        one, other = np.random.default_rng(0).integers(0, some.size, (2, _PAIRS))
        between_s = past_s[other] - past_s[one]
        distant = np.abs(between_s) > np.ptp(past_s) / 4
        slopes = (offset_s[other] - offset_s[one])[distant] / between_s[distant]
        for slope in np.unique(slopes[np.abs(slopes) <= _MAX_RATE]).tolist():
            more, level_s = count_at(slope)
            if more > 1.1 * count + 1:
                count, best_s, rate = more, level_s, slope
    ahead_s = utc_s - clock_s - best_s - rate * (clock_s - origin_s)
    return best_s, chosen & (np.abs(ahead_s) <= reach_s)


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
    scatter_s = robust_std(residual_s, float(np.median(residual_s)))
    is_drift = abs(rate) * span_s > max(3 * scatter_s, _SMALLEST_DRIFT_S)
    return rate if is_drift and abs(rate) <= _MAX_RATE else 0.0


def _median_slope(x: Float, y: Float) -> float:
    """Return the median slope between distant points (Theil and Sen)."""
    chosen = np.unique(np.linspace(0, x.size - 1, min(x.size, _SUBSAMPLE)).astype(int))
    one, other = np.triu_indices(chosen.size, 1)
    run, rise = x[chosen[other]] - x[chosen[one]], y[chosen[other]] - y[chosen[one]]
    distant = np.abs(run) >= np.ptp(x) / 4
    return float(np.median(rise[distant] / run[distant])) if distant.any() else 0.0


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


def scale_fault(table: TableFile, name: str, time_s: Float, epoch: str, utc_name: str | None, utc_s: Float) -> str:
    """Return why a table's time is no UTC although its column map says so; empty if nothing contradicts it.

    `name`, `time_s` (n,): the column of the time, and UTC by the map, s since 1970; `epoch`: from when it counts by the
    map; `utc_name`, `utc_s` (n,): the column that the map names for UTC, and its UTC.
    """
    fault = "" if epoch in {"gps", "week"} else _gps_time_fault(table, name, time_s, is_stated=epoch == "unix")
    return fault or ("" if utc_name in {None, name} else _contradiction(f"{name} is", time_s, f"{utc_name}", utc_s))


def _gps_time_fault(table: TableFile, name: str, time_s: Float, *, is_stated: bool) -> str:
    """Return why times that count from 1970 by a map may count GPS time; `is_stated`: whether the user says so."""
    week = _gps_week(table)
    median_s = float(np.nanmedian(time_s)) if np.isfinite(time_s).any() else 0.0
    stated = f"{name} counts seconds since 1970 by this map"
    if week and 0 <= median_s <= WEEK_S:
        return f"{stated}, but within one week, beside a GPS week; give time_epoch=week,gps_week=COLUMN"
    if week and plausible_utc(np.array([median_s]))[0]:
        weeks_s, rollover_s = week * WEEK_S, ROLLOVER_WEEKS * WEEK_S
        off_1980, off_1970 = (abs(remainder(s - weeks_s, rollover_s)) for s in (median_s, median_s - GPS_EPOCH_S))
        if off_1970 > 2 * WEEK_S >= off_1980:
            return f"{stated}, but its GPS week counts them from 1980; give time_epoch=gps"
    if is_stated or not median_s or not _GPS_TIME.search(name):
        return ""
    dates = " and ".join(
        f"time_epoch={epoch} makes it {format_utc(seconds)[:10]}"
        for epoch, seconds in (("gps", median_s + GPS_EPOCH_S), ("unix", median_s))
        if plausible_utc(np.array([seconds]))[0]
    )
    return f"{name} is GPS time by its name, and nothing says from when it counts: {dates or 'give time_epoch'}"


def _gps_week(table: TableFile) -> float:
    """Return the median of the GPS weeks in a column that is named so; 0 without one."""
    for name in table.columns:
        if _GPS_WEEK.fullmatch(re.sub(r"[^A-Za-z]", "", name)):
            with suppress(LogFormatError):
                week = table.numbers(name)
                return float(np.median(week[week > 0])) if (week > 0).any() else 0.0
    return 0.0


def _contradiction(time_is: str, time_s: Float, utc_name: str, utc_s: Float) -> str:
    """Return by how much (n,) UTC of rows, s since 1970, contradicts another column's UTC; empty if it does not."""
    both = plausible_utc(time_s) & plausible_utc(utc_s)
    ahead_s = (time_s - utc_s)[both]
    low_s, median_s, high_s = np.quantile(ahead_s, (0.1, 0.5, 0.9)).tolist() if both.any() else (0.0,) * 3
    if abs(median_s) <= _FIX_S or high_s - low_s > _FIX_S:
        return ""
    leap_s = leap_seconds(float(np.median(utc_s[both])))
    of_gps = {"GPS time since 1980 (time_epoch=gps)": leap_s - GPS_EPOCH_S, "GPS time": leap_s}
    scale = next((f": it counts {scale}" for scale, off_s in of_gps.items() if abs(median_s - off_s) < _FIX_S), "")
    side = "ahead of" if median_s > 0 else "behind"
    return f"{time_is} {abs(median_s):.1f} s {side} {utc_name}{scale}; name one of both"


def early_remarks(utc_s: Float, epoch: str) -> list[str]:
    """Return remarks on (n,) UTC, s since 1970, that would fit a recent flight if it counted from 1980.

    `epoch`: from when it counts by the map; "auto" if the map does not say so.
    """
    utc_s = utc_s[plausible_utc(utc_s)]
    if epoch != "auto" or not utc_s.size or float(np.median(utc_s)) >= _EARLY_S:
        return []
    read, otherwise = (format_utc(float(np.median(utc_s)) + seconds)[:10] for seconds in (0.0, GPS_EPOCH_S))
    return [f"its times are taken as seconds since 1970, {read}; time_epoch=gps, since 1980, makes them {otherwise}"]


def described_cuts(fit: ClockFit, lines: Integer) -> str:
    """Return a remark on the cells of UTC that disagree with a clock.  `lines` (n,): line of each row."""
    verb = "disagrees" if fit.cut.size == 1 else "disagree"
    return (
        f"{fit.cut.size} of its {fit.cells} cells of UTC {verb} with its clock by up to {fit.largest_s:.1f} s"
        f" (the first one in line {int(lines[fit.cut.min()])}) and {'is' if fit.cut.size == 1 else 'are'} not used"
    )


def left_out_rows(count: int) -> str:
    """Return a remark on a number of rows with an impossible time."""
    return (
        f"{count} row{'s have' if count > 1 else ' has'} an impossible time and {'are' if count > 1 else 'is'} left out"
    )
