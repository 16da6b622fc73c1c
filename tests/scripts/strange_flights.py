"""Random tables and tracks with wrong times and fixes among them, against the truth: neither may be wrong.

``python tests/scripts/strange_flights.py tables --count 2000 --seed 0`` makes tables, ``tracks`` makes tracks.  Each is
read rightly or refused; the script prints the others and exits with 1.
"""

import argparse
import sys
import tempfile
from collections import Counter
from pathlib import Path

import numpy as np

from glstar.errors import LogFormatError
from glstar.rotation import euler_from_quaternion
from glstar.telemetry import open_flight, read_track
from tests.support.tablefiles import largest_error_s, make_table
from tests.support.trackfiles import make_track

# Largest error of a position on a track, m: IGC has thousandths of a minute.
_TRACK_M = 5.0


def table_outcome(folder: Path, seed: int) -> tuple[str, object]:
    """Return "right", "refused", "refused without need" or "wrong" for a table, and the table."""
    case = make_table(folder, seed)
    try:
        attitude = open_flight(case.path).attitude
    except LogFormatError:
        return "refused without need" if case.must_read else "refused", case
    error_s = largest_error_s(attitude.utc_s, np.rad2deg(euler_from_quaternion(attitude.q_body_ned)[2]))
    return "right" if error_s < case.tolerance_s else f"wrong by {error_s:.3f} s", case


def track_outcome(folder: Path, seed: int) -> tuple[str, object]:
    """Return "right", "refused" or "wrong" for a track, and the track."""
    case = make_track(folder, seed)
    try:
        track = read_track(str(case.path)).track
    except LogFormatError:
        return "refused", case
    utc_s = np.linspace(case.first_s, case.last_s, 300)
    error_m = case.error_m(utc_s, *track.coordinates(utc_s))
    return "right" if error_m < _TRACK_M else f"wrong by {error_m:.0f} m", case


def main() -> int:
    """Make the files, and print how many were read rightly."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("kind", choices=["tables", "tracks"])
    parser.add_argument("--count", type=int, default=2000)
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    outcome_of = table_outcome if options.kind == "tables" else track_outcome
    outcomes: Counter[str] = Counter()
    for seed in range(options.seed, options.seed + options.count):
        with tempfile.TemporaryDirectory() as folder:
            outcome, case = outcome_of(Path(folder), seed)
        outcomes[outcome.split(" by ")[0]] += 1
        if outcome not in {"right", "refused"}:
            print(seed, outcome, case)
    print(dict(outcomes))
    return int(bool(set(outcomes) - {"right", "refused"}))


if __name__ == "__main__":
    sys.exit(main())
