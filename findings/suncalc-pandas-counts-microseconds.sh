#!/bin/sh
# suncalc 0.1.3 with pandas 3 places the Sun of an array of times in January 1970: the altitude is -13 deg instead of 75, silently.
#
# Expected: get_position and get_times give for an array what they give for each of its times, with any version of pandas.
# What happens: the times of an array are turned into whole numbers, and these are taken for nanoseconds.  pandas 3 keeps microseconds, so
#   that each date is counted as 1/1000 of its time since 1970.  One datetime is right; arrays, series and indices made of
#   datetimes or of text are on 1970-01-21.  With pandas 2 they are right, but datetime64[us] of NumPy is not.
# Why it matters: dark hours and the Sun's glare are planned for a series of times.  A day of samples shrinks to 86 s: their altitudes are
#   plausible, nearly constant numbers of one evening.  The package sets no upper limit on pandas.
# Source: https://github.com/kylebarron/suncalc-py (to_milliseconds); https://pandas.pydata.org/docs/whatsnew/v3.0.0.html (resolution).
set -eu
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet suncalc==0.1.3 pandas==3.1.1 numpy==2.4.6
"$folder/venv/bin/python" -W ignore - <<'PYTHON'
import sys
from datetime import datetime
from importlib.metadata import version

import numpy as np
import pandas as pd
import suncalc

LON_DEG, LAT_DEG = 138.6, -34.9
noon = datetime(2026, 11, 28, 3)
print(f"suncalc {version('suncalc')}, pandas {version('pandas')}: {noon} UTC, longitude {LON_DEG} deg, latitude {LAT_DEG} deg")
times = {
    "datetime": noon,
    "array of datetimes": np.array([noon, noon]),
    "DatetimeIndex of text": pd.to_datetime([str(noon), str(noon)]),
    "Series": pd.Series([noon, noon]),
    "DatetimeIndex in ns": pd.DatetimeIndex([noon, noon]).as_unit("ns"),
}
altitudes_deg = {}
for name, time in times.items():
    place = (LON_DEG, LAT_DEG) if time is noon else (np.full(2, LON_DEG), np.full(2, LAT_DEG))
    altitudes_deg[name] = float(np.rad2deg(np.ravel(suncalc.get_position(time, *place)["altitude"])[0]))
    sunrise = np.ravel(suncalc.get_times(time, *place)["sunrise"])[0]
    print(f"{name:22s}: altitude of the Sun {altitudes_deg[name]:6.2f} deg, sunrise {sunrise}")
right = [altitudes_deg["datetime"], altitudes_deg["DatetimeIndex in ns"]]
wrong = [altitudes_deg[name] for name in ("array of datetimes", "DatetimeIndex of text", "Series")]
sys.exit(0 if all(75 < one < 75.3 for one in right) and all(-13 < one < -12 for one in wrong) else "this has changed")
PYTHON
