"""Random logs of autopilots with decoys beside the truth: ``poe search-autopilot-logs``.

Each file is a valid ULog, DataFlash log or telemetry log, see `tests.support.autopilotlogs`.  glstar must read the
truth from it or refuse it; any other answer is printed with the seed of the file, and makes the script fail.
"""

import argparse
import sys
import tempfile
from collections import Counter
from pathlib import Path

from tests.support.autopilotlogs import judge, random_log


def main() -> int:
    """Make, open and judge logs; return 1 if any was read wrong."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--count", type=int, default=2000, help="number of logs")
    parser.add_argument("--seed", type=int, default=0, help="seed of the first log")
    arguments = parser.parse_args()
    outcomes: Counter[str] = Counter()
    for seed in range(arguments.seed, arguments.seed + arguments.count):
        with tempfile.TemporaryDirectory(prefix="glstar-") as folder:
            case = random_log(seed, Path(folder))
            verdict = judge(case)
        outcome = "refused" if verdict.startswith("refused") else "wrong" if verdict else "right"
        outcomes[outcome] += 1
        if verdict:
            print(f"{seed}: {case.path.name}: {verdict} ({', '.join(case.decoys)})", flush=True)
    print(f"{arguments.count} logs: " + ", ".join(f"{outcomes[kind]} {kind}" for kind in ("right", "refused", "wrong")))
    return 1 if outcomes["wrong"] else 0


if __name__ == "__main__":
    sys.exit(main())
