#!/bin/sh
# photutils 3.0.0 does not find saturated stars: half of those with 30 saturated pixels, 9 of 10 with 53; IRAFStarFinder none.
#
# Expected: the brightest stars of an image are found first; saturation costs some accuracy.
# What happens: of 40 stars of sigma 1.5 px on 8 bits IRAFStarFinder misses 28 with 13 saturated pixels each, and all with 30.
#   DAOStarFinder misses 23 with 30 and 37 with 53, because their plateaus are not round.  roundness_range=None finds all, but at a
#   pixel at the edge of the plateau: 1.0 px off (rms) with 30 saturated pixels, 1.8 px with 53.  find_peaks returns each pixel of
#   the plateau as a peak: 53 for one star.
# Why it matters: pattern matching starts from the brightest stars, and they are what saturates.  1.8 px of a 60 deg camera with
#   1000 columns are 6', and a list without its brightest stars has no sign of it.
# Source: https://photutils.readthedocs.io/en/stable/detection.html (sharpness_range, roundness_range, find_peaks).
set -eu
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet photutils==3.0.0 numpy==2.3.5 scipy==1.17.1
"$folder/venv/bin/python" -W ignore - <<'PYTHON'
import sys
from importlib.metadata import version

import numpy as np
from photutils.detection import DAOStarFinder, IRAFStarFinder, find_peaks

rows, columns = np.mgrid[:61, :61]
trials = 40
print(f"photutils {version('photutils')}: {trials} stars of sigma 1.5 px on 8 bits, noise 2 DN, threshold 15 DN")
results = {}
for peak_dn in (200, 600, 2000, 4000, 10000):
    rng = np.random.default_rng(0)
    saturated, peaks = [], []
    names = ("DAOStarFinder", "DAOStarFinder, roundness_range=None", "IRAFStarFinder")
    missed, off = dict.fromkeys(names, 0), {name: [] for name in names}
    for _ in range(trials):
        x, y = 30 + rng.uniform(-0.5, 0.5, 2)
        star = peak_dn * np.exp(-((columns - x) ** 2 + (rows - y) ** 2) / 2 / 1.5**2)
        image = np.clip(np.rint(10 + rng.normal(0, 2, rows.shape) + star), 0, 255) - 10
        saturated.append((image == 245).sum())
        peaks.append(len(find_peaks(image, 15, box_size=5)))
        for finder in (DAOStarFinder, IRAFStarFinder):
            table = finder(threshold=15, fwhm=3.53)(image)
            if finder is DAOStarFinder:
                any_shape = finder(threshold=15, fwhm=3.53, roundness_range=None)(image)
                near = np.hypot(any_shape["x_centroid"] - x, any_shape["y_centroid"] - y)
                off["DAOStarFinder, roundness_range=None"].append(near.min())
            if table is None:
                missed[finder.__name__] += 1
            else:
                off[finder.__name__].append(np.hypot(table["x_centroid"] - x, table["y_centroid"] - y).min())
    results[peak_dn] = missed, off, np.mean(peaks)
    print(f"{np.mean(saturated):.0f} saturated pixels: find_peaks returns {np.mean(peaks):.0f} peaks")
    for name, errors in off.items():
        where = f"rms {np.sqrt(np.mean(np.square(errors))):.2f} px, at most {max(errors):.2f} px off" if errors else "none found"
        print(f"  {name}: {missed[name]} missed; {where}")
holds = results[2000][0]["IRAFStarFinder"] == trials and max(results[4000][1]["DAOStarFinder"]) > 1
holds &= results[10000][0]["DAOStarFinder"] > trials / 2 and results[2000][2] > 20 and results[200][0]["DAOStarFinder"] == 0
sys.exit(0 if holds else "this has changed")
PYTHON
