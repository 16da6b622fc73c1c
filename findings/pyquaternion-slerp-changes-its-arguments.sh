#!/bin/sh
# pyquaternion 0.9.9 changes the quaternions that it interpolates between: slerp negates the first one in place.
#
# Expected: Quaternion.slerp(q0, q1, amount) returns a quaternion, and q0 and q1 stay as they were.
# What happens: if the dot product of both is negative, the sign of q0 is changed in the object of the caller, and both are
#   normalized in place.  An attitude log that is interpolated becomes another one: signs flip where samples were passed.
# Why it matters: -q is the same attitude, but not the same numbers.  Differences of neighbours, rates by (q1 - q0) / dt, means
#   and files written afterwards are wrong, and only after the first interpolation.  Pass copies.
# Source: https://kieranwynn.github.io/pyquaternion/ (Quaternion.slerp).
set -eu
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet pyquaternion==0.9.9 numpy==2.4.6
"$folder/venv/bin/python" - <<'PYTHON'
import sys
from importlib.metadata import version

from pyquaternion import Quaternion

first, second = Quaternion(axis=[0, 0, 1], degrees=10), -Quaternion(axis=[0, 0, 1], degrees=30)
before = first.elements.copy()
Quaternion.slerp(first, second, 0.5)
print(f"pyquaternion {version('pyquaternion')}")
print(f"the first quaternion before: {before}, after slerp: {first.elements}")
sys.exit(0 if (first.elements == -before).all() else "this has changed")
PYTHON
