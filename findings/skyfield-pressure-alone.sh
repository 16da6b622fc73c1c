#!/bin/sh
# skyfield 1.55 ignores altaz(pressure_mbar=...) without a temperature: the altitude has no refraction, and nothing says so.
#
# Expected: with temperature alone the pressure of a standard atmosphere is taken; with pressure alone, a standard temperature.
# What happens: altaz(temperature_C=10) refracts; altaz(pressure_mbar=1010) returns the same altitude as altaz(), exactly.
#   Even pressure_mbar='standard' does nothing by itself.  At 5 deg that is 9.5', at 35 deg 1.4'.
# Why it matters: logs of aircraft and weather stations have the pressure; who passes it alone compares a camera with stars that
#   are up to half a degree too low, and the error is a tilt that a fit of the mount absorbs.
# Source: https://rhodesmill.org/skyfield/api-position.html (altaz: "if you supply a temperature and pressure");
#   positionlib.py tests only whether temperature_C is None.
set -eu
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet skyfield==1.55 skyfield-data==7.0.0 numpy==2.3.5
"$folder/venv/bin/python" -W ignore - <<'PYTHON'
import sys
from importlib.metadata import version

from skyfield.api import Loader, Star, wgs84
from skyfield_data import get_skyfield_data_path

load = Loader(get_skyfield_data_path(), verbose=False)
time = load.timescale(builtin=True).utc(2026, 11, 28, 12)
site = load("de421.bsp")["earth"] + wgs84.latlon(-34.9, 138.6, 50)
air = [{}, {"pressure_mbar": 1010.0}, {"pressure_mbar": "standard"}, {"temperature_C": 10.0}]
air.append({"temperature_C": 10.0, "pressure_mbar": 1010.0})

print(f"skyfield {version('skyfield')}")
holds = True
for name, ra_hours, dec_deg in (("Rigel", 5.2423, -8.2017), ("a low star", 7.3, 0.0)):
    apparent = site.at(time).observe(Star(ra_hours=ra_hours, dec_degrees=dec_deg)).apparent()
    altitudes = [apparent.altaz(**each)[0].degrees for each in air]
    for each, altitude in zip(air, altitudes):
        print(f"{name}: altaz({each}): altitude {altitude:.4f} deg, {(altitude - altitudes[0]) * 60:.2f}' higher than without air")
    holds &= altitudes[1] == altitudes[2] == altitudes[0] and altitudes[3] > altitudes[0] + 1 / 60
sys.exit(0 if holds else "this has changed")
PYTHON
