"""Create the coastlines of the viewer's map, ``assets/coastlines.npz``, from Natural Earth as npm's world-atlas has it.

    npm pack world-atlas@2.0.2
    python -m tests.scripts.make_coastlines world-atlas-2.0.2.tgz

The land of Natural Earth (version 4.1, 1:10 million; public domain, https://www.naturalearthdata.com) is simplified
after Douglas and Peucker (1973) such that no left-out point is more than 0.05 deg from its line, and rounded to
0.01 deg; islands smaller than 0.05 deg, the cut along the antimeridian and the edge at the South Pole are left out.
The file holds the steps from point to point, 0.01 deg, and the number of points of each line.  The same archive gives
the same file.
"""

import json
import sys
import tarfile
from pathlib import Path

import numpy as np

ASSET = Path(__file__).parents[2] / "assets" / "coastlines.npz"
TOLERANCE_DEG = SMALLEST_DEG = 0.05
STEPS_PER_DEG = 100
# Points this near to the antimeridian or the South Pole are on the map's edge, deg.
EDGE_DEG = 0.005


def land(archive: Path) -> list[np.ndarray]:
    """Return the lines of a TopoJSON file: (n, 2) longitude and latitude, deg."""
    with tarfile.open(archive) as packed, packed.extractfile("package/land-10m.json") as file:
        topology = json.load(file)
    scale, corner = (np.array(topology["transform"][key]) for key in ("scale", "translate"))
    return [np.cumsum(np.array(arc), axis=0) * scale + corner for arc in topology["arcs"]]


def without_edges(line: np.ndarray) -> list[np.ndarray]:
    """Return the parts of a line that do not run along the antimeridian or the edge at the pole."""
    on_edge = (np.abs(line[:, 0]) > 180 - EDGE_DEG) | (line[:, 1] < -90 + EDGE_DEG)
    along = on_edge[:-1] & on_edge[1:]
    return [part for part in np.split(line, np.flatnonzero(along) + 1) if len(part) > 1]


def simplified(line: np.ndarray) -> np.ndarray:
    """Return the points of a line that others may not replace (Douglas & Peucker 1973)."""
    flat = line * np.column_stack([np.cos(np.deg2rad(line[:, 1])), np.ones(len(line))])
    kept = np.zeros(len(line), dtype=bool)
    kept[[0, -1]] = True
    parts = [(0, len(line) - 1)]
    while parts:
        first, last = parts.pop()
        if last - first < 2:
            continue
        chord, inner = flat[last] - flat[first], flat[first + 1 : last] - flat[first]
        length = np.hypot(*chord)
        away = np.abs(inner @ [-chord[1], chord[0]]) / length if length > 0 else np.hypot(*inner.T)
        farthest = int(away.argmax())
        if away[farthest] > TOLERANCE_DEG:
            middle = first + 1 + farthest
            kept[middle] = True
            parts += [(first, middle), (middle, last)]
    return line[kept]


def main() -> None:
    whole = [part for line in land(Path(sys.argv[1])) for part in without_edges(line)]
    lines = [simplified(line) for line in whole if np.ptp(line, axis=0).max() > SMALLEST_DEG]
    rounded = [np.round(line * STEPS_PER_DEG).astype(np.int32) for line in lines if len(line) > 2]
    steps = np.concatenate([np.diff(line, axis=0, prepend=0) for line in rounded])
    np.savez_compressed(
        ASSET,
        longitude_steps=steps[:, 0].astype(np.int16),
        latitude_steps=steps[:, 1].astype(np.int16),
        points=np.array([len(line) for line in rounded], dtype=np.int32),
    )
    print(f"{ASSET.name}: {len(rounded)} lines, {len(steps)} points, {ASSET.stat().st_size / 1000:.1f} kB")


if __name__ == "__main__":
    main()
