#!/bin/sh
# rawpy 0.28.0 develops the same sky up to a third brighter if the image's brightest pixel is above three quarters of the scale.
#
# Expected: postprocess(gamma=(1, 1), no_auto_bright=True, output_bps=16) is linear, with one scale for all images of a camera: white
#   less black becomes 65535.
# What happens: adjust_maximum_thr is 0.75 unless one sets it: if the brightest pixel is above three quarters of the file's white
#   level, it becomes the white level.  In a DNG with black 512 and white 16383 a sky of 1512 DN is 4129 with a star of 12300 DN, 5489
#   with one of 12450 DN and 4231 with one of 16000 DN.  rawpy's white_level is 16383 each time.  adjust_maximum_thr=0 keeps the scale.
# Why it matters: in a series of images each star and the sky jump by up to 0.31 mag when one star grows brighter, or moves into
#   the middle of a pixel; dark and light frames have different scales.  Saturated images are right, which hides it.
# Source: https://letmaik.github.io/rawpy/api/rawpy.Params.html (adjust_maximum_thr); LibRaw's adjust_maximum().
set -eu
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet rawpy==0.28.0 tifffile==2026.3.3 numpy==2.4.6
"$folder/venv/bin/python" -W ignore - "$folder/image.dng" <<'PYTHON'
import sys
from importlib.metadata import version

import numpy as np
import rawpy
import tifffile

BLACK_DN, WHITE_DN, SKY_DN = 512, 16383, 1512


def write_dng(path, raw):
    """Write a DNG of one light for all colours: the sensor's colours are XYZ, its pattern is RGGB."""
    unit = tuple(number for one in np.eye(3, dtype=int).ravel().tolist() for number in (one, 1))
    pattern = [(33421, "H", 2, (2, 2), True), (33422, "B", 4, (0, 1, 1, 2), True)]
    levels = [(50714, "H", 1, BLACK_DN, True), (50717, "H", 1, WHITE_DN, True)]
    colours = [(50721, "2i", 9, unit, True), (50728, "2I", 3, (1, 1) * 3, True), (50778, "H", 1, 21, True)]
    names = [(50706, "B", 4, (1, 4, 0, 0), True)] + [(tag, "s", 0, "Test", True) for tag in (50708, 271, 272)]
    tifffile.imwrite(path, raw, photometric=32803, extratags=pattern + levels + colours + names, metadata=None)


print(f"rawpy {version('rawpy')}, LibRaw {'.'.join(map(str, rawpy.libraw_version))}: a sky of {SKY_DN} DN")
linear = {"gamma": (1, 1), "no_auto_bright": True, "output_bps": 16, "user_wb": [1, 1, 1, 1], "output_color": rawpy.ColorSpace.raw}
expected = (SKY_DN - BLACK_DN) / (WHITE_DN - BLACK_DN) * 65535
skies = {}
for star_dn in (3000, 12300, 12450, 12800, 14000, 16000, 16383):
    raw = np.full((64, 64), SKY_DN, np.uint16)
    raw[20:24, 20:24] = star_dn
    write_dng(sys.argv[1], raw)
    with rawpy.imread(sys.argv[1]) as image:
        read, white_dn = image.raw_image.copy(), image.white_level
        developed = [image.postprocess(**linear)[50, 50], image.postprocess(adjust_maximum_thr=0.0, **linear)[50, 50]]
    assert np.array_equal(read, raw) and white_dn == WHITE_DN
    skies[star_dn] = [int(one[1]) for one in developed]
    default, fixed = skies[star_dn]
    print(f"brightest pixel {star_dn:5d} DN: sky {default}, with adjust_maximum_thr=0 {fixed}; expected {expected:.0f}")
steady = all(abs(one[1] - expected) < 2 for one in skies.values()) and abs(skies[12300][0] - expected) < 2
sys.exit(0 if steady and skies[12450][0] > 1.3 * expected and skies[14000][0] > 1.15 * expected else "this has changed")
PYTHON
