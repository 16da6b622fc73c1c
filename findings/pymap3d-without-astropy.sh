#!/bin/sh
# pymap3d 3.2.0 returns another place in the sky if astropy is installed: 0.2 degrees away, without a word.
#
# Expected: azel2radec and radec2azel give the same coordinates on every computer, or say in which frame they are.
# What happens: with astropy they are of ICRS (J2000); without it the functions fall back to Vallado's formulas, which have
#   neither precession, nutation nor aberration, and take right ascension and declination for those of the date.  In November
#   2026 one star's altitude over Adelaide differs by 0.22 deg.
# Why it matters: for a navigator by stars 0.22 deg is 24 km; the same script changes its answer with the environment.
# Source: https://github.com/geospace-code/pymap3d (README: "optional: astropy"; pymap3d.radec2azel, pymap3d.vallado).
set -eu
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
cat > "$folder/star.py" <<'PYTHON'
import datetime

import pymap3d

try:
    from astropy.utils import iers

    # No downloads: the table that astropy ships holds the day's UT1 to some milliseconds.
    iers.conf.auto_download, iers.conf.auto_max_age, iers.conf.iers_degraded_accuracy = False, None, "ignore"
except ImportError:
    pass
utc = datetime.datetime(2026, 11, 28, 11, 0, 0)
azimuth_deg, altitude_deg = pymap3d.radec2azel(100.0, -20.0, -34.93, 138.60, utc)
print(float(azimuth_deg), float(altitude_deg))
PYTHON
for libraries in "" "astropy==7.2.0"; do
    python3 -m venv --clear "$folder/venv"
    # shellcheck disable=SC2086 - no word if there is no library
    "$folder/venv/bin/pip" install --quiet pymap3d==3.2.0 numpy==2.3.5 $libraries
    place=$("$folder/venv/bin/python" -W ignore "$folder/star.py" 2>/dev/null)
    echo "pymap3d 3.2.0 ${libraries:-without astropy}: azimuth and altitude, deg: $place"
    echo "$place" >> "$folder/places"
done
python3 - "$folder/places" <<'PYTHON'
import sys
from pathlib import Path

one, other = ([float(word) for word in line.split()] for line in Path(sys.argv[1]).read_text().splitlines())
print(f"difference of the altitudes: {abs(one[1] - other[1]):.3f} deg")
sys.exit(0 if 0.15 < abs(one[1] - other[1]) < 0.3 else "this has changed")
PYTHON
