#!/bin/sh
# numpy-quaternion 2024.0.13: the mean of attitudes near heading 180 deg points to -25 deg: mean_rotor_in_chordal_metric keeps signs.
#
# Expected: mean_rotor_in_chordal_metric returns, as it says, the rotor closest to all of them in the least-squares sense.  q and -q are
#   the same rotation, so that the sign of a sample does not matter.
# What happens: it is the plain sum, made a unit again.  Of a turn from 170 to 190 deg, written with w >= 0 as scipy's
#   as_quat(canonical=True) does, one half has the other sign and cancels: the mean has a heading of -25 deg instead of 180,
#   with the right pitch and roll.  With the times as second argument it is -26 deg.  unflip_rotors() before it cures it.
# Why it matters: such means turn a camera's attitude or its mounting relative to an IMU from many samples into one.  North and east
#   are right, south is not; the result is a unit quaternion and nothing marks it.
# Source: https://quaternion.readthedocs.io/ (quaternion.means.mean_rotor_in_chordal_metric; squad says that signs must not flip,
#   this function does not).
set -eu
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet numpy-quaternion==2024.0.13 numpy==2.4.6 scipy==1.17.1
"$folder/venv/bin/python" -W ignore - <<'PYTHON'
import sys
from importlib.metadata import version

import numpy as np
import quaternion
from scipy.spatial.transform import Rotation


def degrees_of(rotor):
    """Return yaw, pitch and roll of a quaternion."""
    w, x, y, z = quaternion.as_float_array(rotor)
    return Rotation.from_quat([x, y, z, w]).as_euler("ZYX", degrees=True)


print(f"numpy-quaternion {version('numpy-quaternion')}")
time_s = np.linspace(0, 10, 101)
errors_deg = {}
for middle_deg in (0, 90, 180):
    turn = Rotation.from_euler("ZYX", np.stack([middle_deg + 2 * (time_s - 5), 0 * time_s + 3, 0 * time_s - 6], axis=1), degrees=True)
    samples = quaternion.from_float_array(turn.as_quat(canonical=True, scalar_first=True))
    means = {
        "mean_rotor_in_chordal_metric": quaternion.mean_rotor_in_chordal_metric(samples),
        "the same with times": quaternion.mean_rotor_in_chordal_metric(samples, time_s),
        "after unflip_rotors": quaternion.mean_rotor_in_chordal_metric(quaternion.unflip_rotors(samples)),
    }
    print(f"a turn of 20 deg about {middle_deg} deg, mean of scipy {np.round(turn.mean().as_euler('ZYX', degrees=True), 2)}")
    for name, mean in means.items():
        angles = degrees_of(mean)
        errors_deg[middle_deg, name] = abs((angles[0] - middle_deg + 180) % 360 - 180)
        print(f"  {name}: yaw, pitch, roll {np.round(angles, 2)}")
right = [error for (middle, name), error in errors_deg.items() if middle != 180 or name.startswith("after")]
wrong = [error for (middle, name), error in errors_deg.items() if middle == 180 and not name.startswith("after")]
sys.exit(0 if max(right) < 0.1 and min(wrong) > 90 else "this has changed")
PYTHON
