#!/bin/sh
# AHRS 0.4.0: its estimators of one attitude from one sample disagree; one returns the inverse, one takes the other sign.
#
# Expected: all estimators of the package take `acc` and `mag` of a body and return the attitude as a quaternion of the same
#   direction, so that one can be exchanged for another: yaw 100, pitch 20, roll 10 deg for the sample below.
# What happens: with `acc` along gravity Tilt, FAMC, QUEST and Davenport return that attitude; SAAM returns its inverse, with the
#   same words in its documentation; FQA returns it only if `acc` is the specific force, the other sign, as sensors measure it.
#   Yaw, pitch and roll of the wrong ones are plausible numbers.
# Why it matters: an attitude made of a camera's own IMU puts the stars elsewhere.  Compare with a known attitude that has three
#   different angles: level or due north, most of the errors vanish.
# Source: https://ahrs.readthedocs.io/ (filters).
set -eu
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet ahrs==0.4.0 numpy==2.4.6 scipy==1.17.1
"$folder/venv/bin/python" -W ignore - <<'PYTHON'
import sys
from importlib.metadata import version

import numpy as np
from ahrs import filters
from scipy.spatial.transform import Rotation

DIP_DEG = 60.0
true = Rotation.from_euler("ZYX", [100, 20, 10], degrees=True)
gravity = true.inv().apply([0, 0, 9.81])
magnetic = true.inv().apply(50 * np.array([np.cos(np.deg2rad(DIP_DEG)), 0, np.sin(np.deg2rad(DIP_DEG))]))
estimators = {
    "Tilt": filters.Tilt(),
    "FAMC": filters.FAMC(),
    "QUEST": filters.QUEST(magnetic_dip=DIP_DEG),
    "Davenport": filters.Davenport(magnetic_dip=DIP_DEG),
    "SAAM": filters.SAAM(),
    "FQA": filters.FQA(mag_ref=true.apply(magnetic)),
}
print(f"AHRS {version('ahrs')}")
right = {}
for name, estimator in estimators.items():
    for sign in (1, -1):
        w, x, y, z = np.ravel(estimator.estimate(sign * gravity, magnetic))
        found = Rotation.from_quat([x, y, z, w])
        off_deg = [np.rad2deg((true.inv() * one).magnitude()) for one in (found, found.inv())]
        right[name, sign] = tuple(off < 0.1 for off in off_deg)
        angles = np.round(found.as_euler("ZYX", degrees=True), 1)
        along = "along gravity" if sign > 0 else "specific force"
        print(f"{name:9s} acc {along:14s}: {off_deg[0]:6.1f} deg off, its inverse {off_deg[1]:6.1f} deg; yaw, pitch, roll {angles}")
as_expected = all(right[name, 1] == (True, False) for name in ("Tilt", "FAMC", "QUEST", "Davenport"))
sys.exit(0 if as_expected and right["SAAM", 1] == (False, True) and right["FQA", -1][0] and not right["FQA", 1][0] else "this has changed")
PYTHON
