#!/bin/sh
# OpenCV's fisheye model places what lies beyond 90 deg from the axis on the opposite side of the image, silently.
#
# Expected: cv2.fisheye.projectPoints takes the angle from the axis (the model's own variable, theta), so that a lens of 200 deg shows a
#   star at 91 deg a little farther out than one at 89 deg; or it gives NaN for what it cannot project.
# What happens: the point is divided by its depth first.  A negative depth turns its direction around, and the angle is that of the opposite
#   direction: a star at 91 deg is drawn at 89 deg on the other side, one at 110 deg at 70 deg, all well inside of the image.
# Why it matters: fisheyes of 180 to 220 deg are usual for whole-sky cameras.  Stars beyond 90 deg become false stars among the true ones.
#   A calibration that tests its points by their place in the image keeps them.  Whoever projects a sky must select by the vector.
# Source: https://docs.opencv.org/5.x/db/d58/group__calib3d__fisheye.html (theta = atan(r)); modules/3d, fisheye.cpp
set -eu
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet opencv-contrib-python-headless==5.0.0.93 numpy==2.4.6
"$folder/venv/bin/python" - <<'PYTHON'
import sys

import cv2
import numpy as np

FOCAL_PX, CENTRE_PX = 300.0, 700.0
K = np.array([[FOCAL_PX, 0, CENTRE_PX], [0, FOCAL_PX, CENTRE_PX], [0, 0, 1]])
print(f"OpenCV {cv2.__version__}: equidistant fisheye, {FOCAL_PX:.0f} px per rad, centre at {CENTRE_PX:.0f} px")
ok = True
for angle_deg in (60, 80, 89, 91, 100, 110):
    angle_rad = np.deg2rad(angle_deg)
    direction = np.array([[[np.sin(angle_rad), 0.0, np.cos(angle_rad)]]])
    pixels, _ = cv2.fisheye.projectPoints(direction, np.zeros(3), np.zeros(3), K, np.zeros(4))
    x, model = float(pixels.ravel()[0]), CENTRE_PX + FOCAL_PX * angle_rad
    print(f"{angle_deg:3d} deg to the right of the axis: x = {x:7.1f} px, by the angle {model:7.1f} px")
    turned = CENTRE_PX - FOCAL_PX * np.deg2rad(180 - angle_deg)
    ok &= abs(x - (model if angle_deg < 90 else turned)) < 0.01
sys.exit(0 if ok else "this has changed")
PYTHON
