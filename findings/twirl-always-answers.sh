#!/bin/sh
# twirl 0.6.0 returns world coordinates for an image of another field, and for a mirrored one: nothing says that they are wrong.
#
# Expected: compute_wcs has min_match=0.8, the fraction of stars that must match; without a match it returns None or raises.
# What happens: random points, none of which is a star of the catalogue, get a WCS.  Its pixels are not square (one side is
#   1.7 times the other, and differs from run to run of other points), which is the only sign.  A mirrored image is solved
#   with an rms of 0.002 px and a positive determinant; a camera cannot take it.
# Why it matters: a navigator that believes each returned WCS is sent anywhere by a frame of cloud.  Check scale, squareness,
#   parity and residuals before use.
# Source: https://twirl.readthedocs.io/ (compute_wcs).
set -eu
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet twirl==0.6.0 numpy==2.3.5 scipy==1.17.1 astropy==7.2.0
"$folder/venv/bin/python" -W ignore - <<'PYTHON'
import sys
from importlib.metadata import version

import numpy as np
import twirl
from astropy.wcs import WCS

rng = np.random.default_rng(1)
sky = np.column_stack([150 + rng.uniform(-0.5, 0.5, 15) / np.cos(np.deg2rad(20)), 20 + rng.uniform(-0.5, 0.5, 15)])
true = WCS(naxis=2)
true.wcs.ctype, true.wcs.crval, true.wcs.crpix = ["RA---TAN", "DEC--TAN"], [150, 20], [501, 501]
true.wcs.cdelt = [-0.001, 0.001]
stars = np.column_stack(true.all_world2pix(*sky.T, 0))
mirrored = stars * [-1, 1] + [1000, 0]

print(f"twirl {version('twirl')}")
wcs = twirl.compute_wcs(mirrored, sky)
rms_px = np.sqrt(np.mean((np.column_stack(wcs.all_world2pix(*sky.T, 0)) - mirrored) ** 2))
print(f"mirrored image: solved, rms {rms_px:.4f} px, determinant {np.linalg.det(wcs.pixel_scale_matrix):+.1e} deg^2")
answered = 0
for seed in range(10):
    points = np.random.default_rng(seed).uniform(0, 1000, (15, 2))
    try:
        found = twirl.compute_wcs(points, sky)
    except Exception as error:  # an exception would be an honest answer
        print(f"random points {seed}: {error!r}")
        continue
    if found is not None:
        answered += 1
        scales = [scale.to_value("arcsec") for scale in found.proj_plane_pixel_scales()]
        print(f"random points {seed}: solved, {scales[0]:.2f} x {scales[1]:.2f} arcsec per pixel (true: 3.60)")
sys.exit(0 if rms_px < 0.1 and answered >= 5 else "this has changed")
PYTHON
