"""Create the corrections of ERFA's ephemerides, ``assets/ephemeris.npz``, from the package de421.

    pip install de421 jplephem
    python -m tests.scripts.make_ephemeris

DE421 (Folkner, Williams & Boggs 2009, IPN Progress Report 42-178) is a work of the Jet Propulsion Laboratory in the
public domain; the packages de421 and jplephem are by Brandon Rhodes (MIT).  The differences DE421 - ERFA from 1990 to
2050 are interpolated at Chebyshev nodes and rounded.  The same packages give the same file.
"""

from pathlib import Path

import de421
import erfa
import numpy as np
from jplephem.ephem import Ephemeris
from numpy.polynomial.chebyshev import chebfit
from numpy.typing import NDArray

from glstar.sky.observed.solarsystem import AU_KM, PLANETS

ASSET = Path(__file__).parents[2] / "assets" / "ephemeris.npz"

# 1990 January 1 to 2051 March 1, with room for the light time.
FIRST_JD, LAST_JD = 2447892.5, 2470232.0

# Length of a series (days), degree, unit (km) and type: the worst errors from 1990 to 2050 are 0.6" for the Moon
# and below 0.25" for the planets, at their smallest distances from the Earth.
SERIES = {
    "moon": (16, 12, 0.25, np.int8),
    "mercury": (88, 6, 5.0, np.int16),
    "venus": (128, 12, 5.0, np.int16),
    "mars": (256, 12, 10.0, np.int16),
    "jupiter": (512, 8, 100.0, np.int16),
    "saturn": (512, 6, 200.0, np.int16),
    "uranus": (1024, 6, 500.0, np.int16),
    "neptune": (2048, 8, 1000.0, np.int16),
}
# Additional nodes: the fit is then close to the best one.
EXTRA_NODES = 8


def difference_km(name: str, jd: NDArray[np.float64], de: Ephemeris) -> NDArray[np.float64]:
    """Return DE421 minus ERFA, (n, 3) km: of the Moon from the Earth, or of a planet from the Sun."""
    if name == "moon":
        return de.position("moon", jd).T - erfa.moon98(jd, 0.0)["p"] * AU_KM
    heliocentric = (de.position(name, jd) - de.position("sun", jd)).T
    return heliocentric - erfa.plan94(jd, 0.0, PLANETS[name.capitalize()])["p"] * AU_KM


def coefficients(name: str, de: Ephemeris) -> NDArray[np.int8] | NDArray[np.int16]:
    """Return the rounded series of one body, (pieces, 3, degree + 1)."""
    days, degree, step_km, dtype = SERIES[name]
    pieces, nodes = int(np.ceil((LAST_JD - FIRST_JD) / days)), degree + 1 + EXTRA_NODES
    x = np.cos(np.pi * (np.arange(nodes) + 0.5) / nodes)
    jd = FIRST_JD + days * (np.arange(pieces)[:, np.newaxis] + (x + 1) / 2)
    values = difference_km(name, jd.ravel(), de).reshape(pieces, nodes, 3)
    series = chebfit(x, values.transpose(1, 0, 2).reshape(nodes, -1), degree).reshape(degree + 1, pieces, 3)
    whole = np.round(series.transpose(1, 2, 0) / step_km)
    assert np.abs(whole).max() <= np.iinfo(dtype).max, name
    return whole.astype(dtype)


def main() -> None:
    """Write the asset."""
    de = Ephemeris(de421)
    arrays = {name: coefficients(name, de) for name in SERIES}
    scales = {f"{name}_scale": np.array(values[:3:2], dtype=np.float64) for name, values in SERIES.items()}
    provenance = "DE421 - ERFA (plan94, moon98), km, ICRS axes; made by tests/scripts/make_ephemeris.py"
    np.savez_compressed(ASSET, first_jd=FIRST_JD, provenance=provenance, **scales, **arrays)
    print(f"{ASSET}: {ASSET.stat().st_size} bytes")


if __name__ == "__main__":
    main()
