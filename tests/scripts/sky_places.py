"""What ``glstar sky`` lists at random times and sites, against Skyfield and ERFA: ``poe check-sky``.

Each view has a dozen stars, the nine bodies and four satellites, by the paper's formulae or by ERFA.

    --count N      views, 200 by default
    --seed N       the first of their seeds
"""

import argparse
import sys
import tempfile
from collections import defaultdict
from pathlib import Path

import numpy as np

from tests.support.horizonplaces import CLAIMS_ARCSEC, Listed, listed_beside_authorities


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--count", type=int, default=200)
    parser.add_argument("--seed", type=int, default=0)
    given = parser.parse_args()
    listed: dict[tuple[str, str], list[Listed]] = defaultdict(list)
    with tempfile.TemporaryDirectory() as folder:
        for seed in range(given.seed, given.seed + given.count):
            for one in listed_beside_authorities(seed, Path(folder)):
                listed[one.kind, one.astrometry].append(one)
                if one.excess > 1:
                    print(f"seed {seed}: {one.name} is {one.excess:.2f} times its claim off: {one}", flush=True)
    for key, rows in sorted(listed.items()):
        off = np.array([(one.horizon_arcsec, one.equator_arcsec) for one in rows])
        print(
            f"{' '.join(key)}: {len(rows)} rows; at most {off.max(axis=0).round(4)} arcsec, claimed"
            f" {CLAIMS_ARCSEC[key]}"
        )
    return int(any(one.excess > 1 for rows in listed.values() for one in rows))


if __name__ == "__main__":
    sys.exit(main())
