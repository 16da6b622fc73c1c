"""Read random bags with decoys beside the truth: ``python tests/scripts/random_bags.py --count 2000 --seed 0``.

Each bag must give the true flight or be refused; another answer is printed, and the script then ends with an error.
"""

import argparse
import sys
import tempfile
import time
from collections import Counter
from pathlib import Path

import numpy as np

from tests.support.randombags import judged, random_bag


def main() -> int:
    """Return the number of bags that gave another flight."""
    options = argparse.ArgumentParser(description=__doc__)
    options.add_argument("--count", type=int, default=2000)
    options.add_argument("--seed", type=int, default=0)
    options.add_argument("--seconds", type=float, default=float("inf"), help="stop after this time")
    given = options.parse_args()
    end_s = time.monotonic() + given.seconds
    results = Counter[str]()
    for seed in range(given.seed, given.seed + given.count):
        if time.monotonic() > end_s:
            break
        with tempfile.TemporaryDirectory(prefix="glstar-") as folder:
            made = random_bag(np.random.default_rng(seed), Path(folder))
            result = judged(made)
        results[result.partition(":")[0] or "right"] += 1
        if result:
            print(f"seed {seed}: {result}\n    of {', '.join(made.said)}", flush=True)
    print(", ".join(f"{count} {result}" for result, count in results.items()))
    return results["wrong"]


if __name__ == "__main__":
    sys.exit(min(main(), 1))
