#!/bin/sh
# ccdproc 2.5.1 subtracts bias and dark frames of 16-bit files in 16 bits: pixels below the bias become 65535.
#
# Expected: CCDData.read() and subtract_bias() of the files of a camera give the difference, with negative values where noise is low.
# What happens: CCDData.read() keeps uint16, and uint16 minus uint16 wraps.  With a light frame of 100 and a bias of 98 DN 31 % of
#   the pixels are above 60000, and the mean is 20418 DN instead of 2.0.  subtract_dark() does the same with scale=False, but not with
#   scale=True; a master from combine() is float64 and right, so that only a single bias or dark frame fails.  No warning.
# Why it matters: a short exposure of stars is hardly above its bias.  Its sky becomes a field of saturated pixels, each a star or a
#   cosmic ray for the next step; a median over images hides it.
# Source: https://ccdproc.readthedocs.io/en/latest/reduction_toolbox.html (subtract_bias, subtract_dark).
set -eu
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet ccdproc==2.5.1 astropy==8.0.2 numpy==2.3.5 scipy==1.17.1
cd "$folder"
"$folder/venv/bin/python" -W ignore - <<'PYTHON'
import sys
from importlib.metadata import version

import astropy.units as u
import ccdproc
import numpy as np
from astropy.io import fits
from astropy.nddata import CCDData

rng = np.random.default_rng(0)
counts = {"light": np.rint(rng.normal(100, 5, (200, 200))), "bias": np.rint(rng.normal(98, 1, (200, 200)))}
for name, frame in counts.items():
    fits.PrimaryHDU(frame.astype(np.uint16)).writeto(f"{name}.fits")
light, bias = (CCDData.read(f"{name}.fits", unit="adu") for name in counts)
times = {"dark_exposure": 1 * u.s, "data_exposure": 1 * u.s}
results = {
    "subtract_bias": ccdproc.subtract_bias(light, bias),
    "subtract_dark, scale=False": ccdproc.subtract_dark(light, bias, scale=False, **times),
    "subtract_dark, scale=True": ccdproc.subtract_dark(light, bias, scale=True, **times),
    "subtract_bias of a combined bias": ccdproc.subtract_bias(light, ccdproc.combine([bias, bias, bias], method="average")),
}
truth = float(np.mean(counts["light"] - counts["bias"]))
print(f"ccdproc {version('ccdproc')}, frames read as {light.data.dtype}; true mean of the difference {truth:.2f} DN")
means = {}
for name, result in results.items():
    means[name] = float(np.mean(result.data))
    print(f"{name}: {result.data.dtype}, mean {means[name]:.2f} DN, {np.mean(result.data > 60000):.0%} of the pixels above 60000")
wraps = means["subtract_bias"] > 10000 and means["subtract_dark, scale=False"] > 10000
cured = all(abs(means[name] - truth) < 0.01 for name in list(results)[2:])
sys.exit(0 if wraps and cured else "this has changed")
PYTHON
