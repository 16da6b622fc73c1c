#!/bin/sh
# GalSim 2.8.5 wraps what does not fit into an integer image: a bright star has a dark hole, a dark pixel becomes white.
#
# Expected: pixels of an unsigned 16-bit image stop at 65535, as a camera's do, or the overflow is an error or a warning.
# What happens: Image(dtype=numpy.uint16) keeps the lowest 16 bits.  A star of 1,000,000 counts, whose peak pixel has 146,607,
#   reads 15,535 there, less than the pixels around it.  Noise of 10 counts on a sky of 5 turns negative pixels into values
#   near 65,535, so that the mean of the image rises by thousands.  Neither prints a warning.
# Why it matters: saturated stars are the brightest objects of a night image; a training set drawn so teaches holes.  Draw
#   into float images, clip, and convert at the end.
# Source: https://galsim-developers.github.io/GalSim/_build/html/image.html ("array of any numeric type").
set -eu
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet galsim==2.8.5
"$folder/venv/bin/python" -W error - <<'PYTHON'
import sys

import galsim
import numpy as np

star = galsim.Gaussian(sigma=1.0, flux=1e6)
wide = star.drawImage(image=galsim.Image(21, 21, dtype=np.int32), scale=1.0).array
narrow = star.drawImage(image=galsim.Image(21, 21, dtype=np.uint16), scale=1.0).array
print(f"GalSim {galsim.__version__}, middle row of a star of 1,000,000 counts")
print("int32 ", wide[10, 8:13])
print("uint16", narrow[10, 8:13])

sky = galsim.Image(200, 200, dtype=np.uint16)
sky.fill(5)
sky.addNoise(galsim.GaussianNoise(galsim.BaseDeviate(1), sigma=10))
print(f"sky of 5 counts with a noise of 10: mean {sky.array.mean():.0f}, largest {sky.array.max()}")
holds = narrow[10, 10] == wide[10, 10] - 2 * 65536 and sky.array.mean() > 10000
sys.exit(0 if holds else "this has changed")
PYTHON
