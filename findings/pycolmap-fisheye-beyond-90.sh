#!/bin/sh
# pycolmap 4.2.1 turns a fisheye's pixel at 91 deg from the axis into a direction at 58 deg.
#
# Expected: cam_from_img() of OPENCV_FISHEYE, SIMPLE_RADIAL_FISHEYE or RADIAL_FISHEYE is the inverse of the projection, and NaN
#   where it has none, as img_from_cam() is NaN beyond 90 deg.
# What happens: it returns (u, v), the direction (u, v, 1).  Up to 89.99 deg that is right; beyond 90 deg the angle in radians takes
#   the place of its tangent: 91 deg gives u = 1.588, which is 57.8 deg, 95 deg 58.9 deg and 110 deg 62.5 deg.  Such pixels are
#   ordinary pixels of an image of 185 deg and more; the result is finite, and nothing marks it.
# Why it matters: a star near the horizon of an all-sky image appears 33 deg higher than it is, among stars that are there, and a
#   match or a fit of the lens takes it for one of them.
# Source: https://colmap.github.io/cameras.html; BaseFisheyeCameraModel in colmap/sensor/models.h.
set -eu
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet pycolmap==4.2.1 numpy==2.3.5
"$folder/venv/bin/python" - <<'PYTHON'
import sys
from importlib.metadata import version

import numpy as np
import pycolmap

models = {
    "OPENCV_FISHEYE": [300.0, 300.0, 600.0, 600.0, 0.0, 0.0, 0.0, 0.0],
    "SIMPLE_RADIAL_FISHEYE": [300.0, 600.0, 600.0, 0.0],
    "RADIAL_FISHEYE": [300.0, 600.0, 600.0, 0.0, 0.0],
}
print(f"pycolmap {version('pycolmap')}: images of 1200 x 1200 px, r = 300 px times the angle from the axis")
holds = True
for model, parameters in models.items():
    camera = pycolmap.Camera(model=model, width=1200, height=1200, params=parameters)
    for angle_deg in (60.0, 89.9, 91.0, 95.0, 110.0):
        angle = np.radians(angle_deg)
        u, _ = camera.cam_from_img(np.array([[600.0 + 300.0 * angle, 600.0]]))[0]
        returned_deg = np.degrees(np.arctan(u))
        forward = camera.img_from_cam(np.array([[np.sin(angle), 0.0, np.cos(angle)]]))[0]
        print(f"{model}: pixel at {angle_deg} deg: direction at {returned_deg:.1f} deg; img_from_cam of {angle_deg} deg: {forward}")
        holds &= abs(returned_deg - (angle_deg if angle_deg < 90 else np.degrees(np.arctan(angle)))) < 0.01
sys.exit(0 if holds else "this has changed")
PYTHON
