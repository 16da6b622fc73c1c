#!/bin/sh
# astral 3.2 returns the Moon's altitude as seen from the centre of the Earth: 1 deg too high near the horizon.
#
# Expected: moon.elevation(observer, time) is what the observer sees, as sun.elevation is to 0.003 deg.
# What happens: the Moon's parallax is left out: with the Moon at 13 deg it is 1.00 deg too high, at 26 deg 0.92 deg; the azimuth is
#   right.  At astral's own moonrise, right to a minute, its elevation() is +0.3 deg; the Moon's centre is then at -0.8 deg.
# Why it matters: moonlight, exclusion zones and dark hours of a night flight are planned with it; 1 deg are two Moon diameters,
#   and a camera pointed by it misses the Moon in a narrow field.
# Source: https://astral.readthedocs.io/ (astral.moon.elevation); moon.py has no parallax in its transformation.
set -eu
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet astral==3.2 skyfield==1.55 skyfield-data==7.0.0 numpy==2.3.5
"$folder/venv/bin/python" -W ignore - <<'PYTHON'
import datetime
import sys
from importlib.metadata import version

from astral import Observer, moon, sun
from skyfield.api import Loader, wgs84
from skyfield_data import get_skyfield_data_path

load = Loader(get_skyfield_data_path(), verbose=False)
scale, jpl = load.timescale(builtin=True), load("de421.bsp")
observer = Observer(-34.9, 138.6, 0.0)
site = jpl["earth"] + wgs84.latlon(-34.9, 138.6, 0.0)

print(f"astral {version('astral')} against skyfield with DE421, Adelaide, without refraction")
high, sun_error = [], 0.0
rise = moon.moonrise(observer, datetime.date(2026, 11, 24))
for time in (rise, *(datetime.datetime(2026, 11, 24, hour, tzinfo=datetime.timezone.utc) for hour in (11, 13, 15, 18))):
    at = site.at(scale.from_datetime(time))
    altitude, azimuth, _ = at.observe(jpl["moon"]).apparent().altaz()
    theirs = moon.elevation(observer, time), moon.azimuth(observer, time)
    high.append(theirs[0] - altitude.degrees)
    sun_altitude = at.observe(jpl["sun"]).apparent().altaz()[0].degrees
    sun_error = max(sun_error, abs(sun.elevation(observer, time, with_refraction=False) - sun_altitude))
    print(
        f"{time:%H:%M:%S}{' (its moonrise)' if time == rise else ''}: Moon at {theirs[0]:.2f} deg, truly {altitude.degrees:.2f} deg,"
        f" {high[-1]:+.2f} deg; azimuth {theirs[1] - azimuth.degrees:+.3f} deg"
    )
print(f"Sun: at most {sun_error:.4f} deg off")
sys.exit(0 if min(high) > 0.8 and max(high) > 0.95 and sun_error < 0.01 else "this has changed")
PYTHON
