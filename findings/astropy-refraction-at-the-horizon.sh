#!/bin/sh
# astropy 8.0.2 refracts a star at the horizon by 11 arcminutes instead of 34: AltAz with a pressure is off below 5 deg.
#
# Expected: at an apparent altitude of 0, 1 and 2 deg the air bends the light by 34.5, 24.3 and 18.2 arcminutes (Bennett's
#   formula, which agrees with integrations through a standard atmosphere to 0.1').
# What happens: ERFA's refraction is A tan z + B tan^3 z, and is held constant near the horizon: 10.7' at 0, 1 and 2 deg.
#   Nothing is said.  From 10 deg up both agree to 0.1'.
# Why it matters: stars in the lowest 5 deg are up to 24' too low, and rise and set by two minutes at the wrong time; a
#   camera that looks along the horizon, or an image circle of 180 deg, is calibrated against wrong places.
# Source: https://docs.astropy.org/en/stable/api/astropy.coordinates.AltAz.html (pressure);
#   https://github.com/liberfa/erfa (eraRefco, eraAtioq); G. G. Bennett, Journal of Navigation 35 (1982).
set -eu
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet astropy==8.0.2 numpy==2.4.6
"$folder/venv/bin/python" -W error - <<'PYTHON'
import sys

import astropy
import astropy.units as u
import numpy as np
from astropy.coordinates import AltAz, EarthLocation, SkyCoord
from astropy.time import Time

where = {
    "obstime": Time("2024-03-10T11:00:00"),
    "location": EarthLocation.from_geodetic(138.6 * u.deg, -34.93 * u.deg, 0 * u.m),
}
air = {"pressure": 1010 * u.hPa, "temperature": 10 * u.deg_C, "relative_humidity": 0.5, "obswl": 0.55 * u.micron}
print(f"astropy {astropy.__version__}")
off = {}
for apparent_deg in (0, 1, 2, 5, 10, 20):
    seen = SkyCoord(AltAz(alt=apparent_deg * u.deg, az=90 * u.deg, **where, **air))
    bent = 60 * (apparent_deg - seen.transform_to(AltAz(**where, pressure=0 * u.hPa)).alt.deg)
    bennett = 1 / np.tan(np.deg2rad(apparent_deg + 7.31 / (apparent_deg + 4.4)))
    off[apparent_deg] = bent - bennett
    print(f"apparent altitude {apparent_deg:2d} deg: refraction {bent:5.2f}', Bennett {bennett:5.2f}'")
sys.exit(0 if off[0] < -20 and off[1] < -10 and abs(off[10]) < 0.2 and abs(off[20]) < 0.2 else "this has changed")
PYTHON
