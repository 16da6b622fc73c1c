"""Read thousands of strangers' camera files and images: the truth or a refusal, never another answer.

python -m tests.scripts.strange_cameras --count 2000 --seed 1
"""

import argparse
from collections import Counter

import numpy as np

from tests.support import camerafiles, photofiles


def main() -> int:
    """Run both generators, print each wrong answer and the counts, and return 1 if there is a wrong answer."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--count", type=int, default=2000, help="files of each kind")
    parser.add_argument("--seed", type=int, default=1)
    options = parser.parse_args()
    wrong = 0
    for name, support in (("camera files", camerafiles), ("images", photofiles)):
        counts: Counter[str] = Counter()
        for number in range(options.count):
            verdict = support.verdict(support.random_case(np.random.default_rng([options.seed, number])))
            counts[verdict if verdict in ("right", "refused") else "wrong"] += 1
            if verdict not in ("right", "refused"):
                print(f"{name}, seed {options.seed}, number {number}: {verdict}")
        print(f"{name}: {dict(counts)}")
        wrong += counts["wrong"]
    return int(wrong > 0)


if __name__ == "__main__":
    raise SystemExit(main())
