#!/bin/sh
# sep 1.4.1 and photutils 3.0.0 measure the background of an image of integers up to 1.3 DN wrong, whatever its noise.
#
# Expected: rounding to whole numbers is harmless once the noise is 1 DN or more: the mean of 260,000 pixels is right to 0.01 DN.
# What happens: both estimate the mode as 2.5 median - 1.5 mean.  The median of integers is an integer, so that the background is
#   wrong by 2.5 times its distance from the true level: at 20.45 DN with a noise of 3 DN sep.Background is 1.05 DN too low, photutils'
#   default in Background2D (SExtractorBackground) 0.9 DN; at 20.55 DN both are 1.0 DN too high.  MMMBackground, 3 median - 2 mean,
#   is 1.3 DN off.  The clipped mean is right, and so is sep after uniform noise of +-0.5 DN has been added to the pixels.
# Why it matters: 8-bit and short exposures of star cameras are such images.  An aperture of 5 px radius has 79 pixels: 80 DN too
#   much or too little, a tenth of a faint star, with a sign that follows the sky's level through the night.
# Source: https://sep.readthedocs.io/ (Background); https://photutils.readthedocs.io/en/stable/background.html.
set -eu
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet sep==1.4.1 photutils==3.0.0 numpy==2.3.5 scipy==1.17.1
"$folder/venv/bin/python" -W ignore - <<'PYTHON'
import sys
from importlib.metadata import version

import numpy as np
import sep
from astropy.stats import SigmaClip
from photutils.background import Background2D, MeanBackground, MMMBackground

rng = np.random.default_rng(3)
print(f"sep {version('sep')}, photutils {version('photutils')}: background minus truth, DN")
holds = True
for noise in (1.0, 3.0, 5.0):
    for level in (20.0, 20.25, 20.45, 20.55, 20.75):
        image = np.rint(rng.normal(level, noise, (512, 512)))
        dithered = image + rng.uniform(-0.5, 0.5, image.shape)
        off = {
            "sep": sep.Background(image.astype(np.float32)).globalback - level,
            "Background2D": float(np.mean(Background2D(image, 64).background)) - level,
            "MMMBackground": float(MMMBackground(sigma_clip=SigmaClip(3))(image)) - level,
            "MeanBackground": float(MeanBackground(sigma_clip=SigmaClip(3))(image)) - level,
            "sep, dithered": sep.Background(dithered.astype(np.float32)).globalback - level,
        }
        print(f"level {level:5.2f}, noise {noise}: " + ", ".join(f"{name} {each:+.2f}" for name, each in off.items()))
        if noise == 3.0 and level == 20.45:
            holds &= off["sep"] < -0.8 and off["Background2D"] < -0.8 and off["MMMBackground"] < -1.1
        holds &= abs(off["MeanBackground"]) < 0.05 and abs(off["sep, dithered"]) < 0.1
sys.exit(0 if holds else "this has changed")
PYTHON
