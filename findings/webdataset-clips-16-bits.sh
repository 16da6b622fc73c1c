#!/bin/sh
# webdataset 1.0.2 makes every number of a 16-bit PNG above 255 white, silently: of a dark sky and its stars nothing is left.
#
# Expected: decode("l8") or decode("rgb8") scales 16 bits to 8, and decode("pil") keeps the image as Pillow opens it (mode I;16).
# What happens: all of them convert the image to 8 bits per colour, and Pillow's conversion from I;16 cuts off at 255.  Decoders of
#   floating point ("l", "rgb") divide what is left by 255.  The same happens with datasets 5.2.0 when Image(mode="L") or "RGB" is
#   asked for; its Image() without a mode keeps the numbers.
# Why it matters: star images are kept in 16 bits because the stars are faint.  A sky at 6 % of the scale becomes as white as the stars,
#   the files are right, and training goes on with images without any content.  A decoder of one's own (OpenCV, IMREAD_UNCHANGED) keeps them.
# Source: https://github.com/webdataset/webdataset (autodecode.py, ImageHandler); the modes of Pillow in its handbook (concepts)
set -eu
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
cd "$folder"
python3 -m venv venv
venv/bin/pip install --quiet webdataset==1.0.2 datasets==5.2.0 pillow==13.0.0 numpy==2.4.6
HF_HUB_OFFLINE=1 venv/bin/python -W ignore - <<'PYTHON'
import io
import sys
import tarfile
from importlib.metadata import version

import datasets
import numpy as np
import PIL.Image
import webdataset

# A sky of 4000 DN with noise, one star, and one pixel at 100 DN.
image = np.random.default_rng(1).normal(4000, 60, (40, 60)).astype(np.uint16)
image[20, 30], image[5, 5] = 50000, 100
png = io.BytesIO()
PIL.Image.fromarray(image).save(png, "PNG")
with tarfile.open("frames.tar", "w") as tar:
    member = tarfile.TarInfo("0.png")
    member.size = len(png.getvalue())
    tar.addfile(member, io.BytesIO(png.getvalue()))
print(f"webdataset {version('webdataset')}, Pillow {version('pillow')}: sky {np.median(image):.0f}, star 50000, dark pixel 100 DN")
ok = True
for how in ("pil", "pill", "l8", "rgb8", "l", "rgb"):
    pixels = np.asarray(next(iter(webdataset.WebDataset("frames.tar", shardshuffle=False).decode(how)))["png"])
    values = [float(np.ravel(pixels[place])[0]) for place in ((10, 10), (20, 30), (5, 5))]
    scale = 1 / 255 if how in ("l", "rgb") else 1
    print(f"decode({how!r:7}): {pixels.dtype!s:8} sky {values[0]:6.2f}, star {values[1]:6.2f}, dark pixel {values[2]:6.2f}")
    ok &= bool(np.allclose(values, np.array([255, 255, 100]) * scale, rtol=1e-6))
for mode in (None, "L", "RGB"):
    made = datasets.Dataset.from_dict({"image": [{"bytes": png.getvalue(), "path": None}]})
    pixels = np.asarray(made.cast_column("image", datasets.Image(mode=mode))[0]["image"])
    values = [float(np.ravel(pixels[place])[0]) for place in ((10, 10), (20, 30), (5, 5))]
    print(f"datasets {version('datasets')}, Image(mode={mode!r}): {pixels.dtype} {values}")
    ok &= values == ([float(image[10, 10]), 50000, 100] if mode is None else [255, 255, 100])
sys.exit(0 if ok else "this has changed")
PYTHON
