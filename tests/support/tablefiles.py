"""Random tables of other programs with a clock and UTC, of which some cells are wrong, and the truth about them."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pandas as pd

from glstar.arrays import Float

START_S = 1710068400.0  # 2024-03-10 11:00:00 UTC
_DEG_PER_S = 0.5


@dataclass(frozen=True, slots=True, eq=False)
class TableCase:
    """A table, and what glstar may find in it."""

    path: Path
    decoys: tuple[str, ...]
    tolerance_s: float  # Of the UTC of any attitude
    columns: str | None = None
    must_read: bool = True  # Whether a refusal is an error


def yaw_deg(utc_s: Float) -> Float:
    """Return the heading of the aircraft at UTC seconds since 1970, deg: it says what time it is."""
    return (100 + _DEG_PER_S * (utc_s - START_S)) % 360


def utc_of_yaw(heading_deg: Float) -> Float:
    """Return UTC, seconds since 1970, of headings of `yaw_deg`, for 6 minutes before and after the start."""
    return START_S + ((heading_deg - 100 + 180) % 360 - 180) / _DEG_PER_S


def _one_odd(random: np.random.Generator, utc_s: Float, true_s: Float) -> Float:
    row, count = random.integers(utc_s.size), random.integers(1, 4)
    shift_s = random.choice([3600.0, -3600.0, 60.0, -1.0e7, 86400.0, -18.0, 5.0])
    odd_s = utc_s.copy()
    odd_s[row : row + count] += shift_s
    return odd_s


def _scattered(random: np.random.Generator, utc_s: Float, true_s: Float) -> Float:
    odd = random.random(utc_s.size) < 0.05
    return np.where(odd, utc_s + random.choice([3600.0, -86400.0, 7.0]), utc_s)


def _before_lock(random: np.random.Generator, utc_s: Float, true_s: Float) -> Float:
    until_s = true_s[0] + random.uniform(0.1, 0.35) * np.ptp(true_s)
    return np.where(true_s < until_s, utc_s + random.choice([-1e7, 1e7, -315964800.0, -619315200.0]), utc_s)


def _without_leap_seconds(random: np.random.Generator, utc_s: Float, true_s: Float) -> Float:
    until_s = true_s[0] + random.uniform(0.05, 0.35) * np.ptp(true_s)
    return np.where(true_s < until_s, utc_s + 18, utc_s)


def _stands_at_start(random: np.random.Generator, utc_s: Float, true_s: Float) -> Float:
    until_s = true_s[0] + random.uniform(0.05, 0.4) * np.ptp(true_s)
    held_s = utc_s[0] if random.random() < 0.5 else START_S - random.uniform(100, 1e7) // 1
    return np.where(true_s < until_s, held_s, utc_s)


def _stands_at_end(random: np.random.Generator, utc_s: Float, true_s: Float) -> Float:
    return np.minimum(utc_s, utc_s[int(random.uniform(0.6, 0.95) * utc_s.size)])


def _stands_within(random: np.random.Generator, utc_s: Float, true_s: Float) -> Float:
    first = int(random.integers(0, utc_s.size))
    last = first + int(random.uniform(0.1, 0.6) * utc_s.size)
    return np.where((np.arange(utc_s.size) > first) & (np.arange(utc_s.size) < last), utc_s[first], utc_s)


def _empty(random: np.random.Generator, utc_s: Float, true_s: Float) -> Float:
    return np.where(random.random(utc_s.size) < random.uniform(0.1, 0.8), np.nan, utc_s)


UTC_DECOYS: dict[str, Callable[[np.random.Generator, Float, Float], Float]] = {
    "one odd": _one_odd,
    "scattered": _scattered,
    "before lock": _before_lock,
    "without leap seconds": _without_leap_seconds,
    "stands at start": _stands_at_start,
    "stands at end": _stands_at_end,
    "stands within": _stands_within,
    "empty": _empty,
}
_LONG = {"before lock", "without leap seconds", "stands at start", "stands at end", "stands within"}
CLOCK_DECOYS = ("rate", "step", "reset", "odd time")


def _texts(utc_s: Float, decimals: int) -> list[str]:
    stamps = [None if not np.isfinite(t) else pd.to_datetime(np.round(t, 6), unit="s") for t in utc_s]
    length = 19 + (decimals > 0) + decimals
    return ["" if t is None else f"{t:%Y-%m-%d %H:%M:%S.%f}"[:length] for t in stamps]


def make_table(folder: Path, seed: int) -> TableCase:
    """Write a table of a random kind with random decoys."""
    random = np.random.default_rng(seed)
    step_s = float(random.choice([0.02, 0.1, 0.1, 0.101, 0.2, 0.0333, 0.5]))
    rows = int(random.uniform(30, 200) / step_s)
    true_s = START_S + random.uniform(0, 20) + step_s * np.arange(rows)
    if random.random() < 0.3:
        true_s = np.sort(true_s + random.uniform(-0.3, 0.3, rows) * step_s)
    true_s = np.round(true_s, 4)
    whole = random.random() < 0.5
    # The receiver has a fix every 0.2 s or second, or UTC is as fine as the rows.
    hold_s = float(random.choice([1.0, 0.2])) if random.random() < 0.4 else 0.0
    utc_s = np.floor(true_s) if whole else np.floor(true_s / hold_s) * hold_s if hold_s else true_s
    clock_s = true_s - true_s[0] + random.choice([0.0, -5.0, 100.0])
    decoys = [str(decoy) for decoy in random.choice([*UTC_DECOYS], int(random.integers(0, 3)), replace=False)]
    # Of two long faults the second one may leave less of the right UTC than of the wrong one.
    decoys = decoys[:1] if len(_LONG & set(decoys)) > 1 else decoys
    for decoy in decoys:
        utc_s = UTC_DECOYS[decoy](random, utc_s, true_s)
    clock_s, clock_decoy = _clock(random, clock_s, may_step=not _LONG & set(decoys))
    decoys += [clock_decoy] if clock_decoy else []
    tolerance_s = 0.02 + (step_s * 1.7 if whole or hold_s else 0.0)
    if clock_decoy == "rate":
        tolerance_s += 0.1
    table = pd.DataFrame({
        "time(millisecond)": np.round(clock_s * 1e3, 1), "datetime(utc)": _texts(utc_s, 0 if whole else 4),
        "latitude": -34.93, "longitude": 138.6, "altitude_above_seaLevel(meters)": 100.0,
        "compass_heading(degrees)": np.round(yaw_deg(true_s), 6), "pitch(degrees)": 20.0, "roll(degrees)": 10.0,
    })  # fmt: skip
    path = folder / f"table{seed}.csv"
    table.to_csv(path, index=False)
    return TableCase(path, tuple(decoys), tolerance_s, must_read=len(decoys) < 2)


def _clock(random: np.random.Generator, clock_s: Float, *, may_step: bool) -> tuple[Float, str]:
    """Return the clock of a table with a random fault, and its name; empty without one."""
    kind = str(random.choice([*CLOCK_DECOYS, *[""] * 8]))
    kind = "" if kind in {"step", "reset"} and not may_step else kind
    middle = int(random.uniform(0.3, 0.7) * clock_s.size)
    after = np.arange(clock_s.size) >= middle
    if kind == "rate":
        return clock_s * (1 + random.choice([-1, 1]) * 10 ** random.uniform(-5, -3)), kind
    if kind == "step":
        return np.where(after, clock_s + random.choice([-2.0, 3.0, 40.0, -30.0]), clock_s), kind
    if kind == "reset":
        return np.where(after, clock_s - clock_s[middle], clock_s), kind
    if kind == "odd time":
        odd_s = clock_s.copy()
        odd_s[middle] += random.choice([3600.0, -100.0, 1e6])
        return odd_s, kind
    return clock_s, kind


def largest_error_s(flight_utc_s: Float, heading_deg: Float) -> float:
    """Return the largest difference between the UTC of attitudes and that of their headings, s."""
    return float(np.abs(flight_utc_s - utc_of_yaw(heading_deg)).max())
