#!/bin/sh
# astropy 8.0.2: a SkyCoord that was once made with a pressure stays refracted in AltAz frames that are made without one.
#
# Expected: AltAz() without a pressure is airless, as its documentation says; a place that was observed through air and
#   transformed to ICRS has no air left, so that its airless altitude is 5.2' below the observed 10 deg.
# What happens: SkyCoord.transform_to lets attributes of the source replace those of the target that were not written out, and
#   ICRS keeps the pressure unseen.  The "airless" altitude is the refracted one, to the last digit.
# Why it matters: images are compared with places that have refraction where none was asked for: 5' at 10 deg.  Write
#   pressure=0*u.hPa, transform frames instead of SkyCoord, or pass merge_attributes=False.
# Source: https://docs.astropy.org/en/stable/api/astropy.coordinates.SkyCoord.html (transform_to, merge_attributes).
set -eu
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet astropy==8.0.2 numpy==2.4.6
"$folder/venv/bin/python" -W error - <<'PYTHON'
import sys

import astropy
import astropy.units as u
from astropy.coordinates import ICRS, AltAz, EarthLocation, SkyCoord
from astropy.time import Time

where = {
    "obstime": Time("2024-03-10T11:00:00"),
    "location": EarthLocation.from_geodetic(138.6 * u.deg, -34.93 * u.deg, 0 * u.m),
}
air = {"pressure": 1010 * u.hPa, "temperature": 10 * u.deg_C, "relative_humidity": 0.5, "obswl": 0.55 * u.micron}
observed = SkyCoord(AltAz(alt=10 * u.deg, az=90 * u.deg, **where, **air))
star = observed.transform_to(ICRS())
asked = {
    "AltAz() of the SkyCoord": star.transform_to(AltAz(**where)),
    "AltAz(pressure=0) of the SkyCoord": star.transform_to(AltAz(**where, pressure=0 * u.hPa)),
    "AltAz() of a new SkyCoord": SkyCoord(star.ra, star.dec).transform_to(AltAz(**where)),
}
print(f"astropy {astropy.__version__}")
below = {name: 60 * (10 - place.alt.deg) for name, place in asked.items()}
for name, arcmin in below.items():
    print(f"{name}: {arcmin:.2f} arcmin below the observed altitude")
kept, explicit, new = below.values()
sys.exit(0 if abs(kept) < 0.01 and explicit > 5 and abs(new - explicit) < 0.1 else "this has changed")
PYTHON
