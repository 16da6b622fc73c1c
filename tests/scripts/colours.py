"""Magnitudes of stars in a camera's band against integrals over the spectra of Pickles (1998, PASP 110, 863).

    python -m tests.scripts.colours SPECTRA PASSBANDS BAND:RESPONSE.csv ...

SPECTRA is the directory of the library's uk*.dat files and PASSBANDS that of Bessell_B.dat and Bessell_V.dat (Bessell
1990); both lie in the source archive of pyhdust on PyPI, in refs/stars and refs/filters.  RESPONSE.csv has a header
and the columns wavelength (nm), red, green, blue.  The table gives the polynomial fitted to the integrals, the photons
of an A0 star of magnitude 0 through a response of peak 1, and how far glstar's magnitudes are from the integrals; the
exit status is 1 if the root mean square exceeds 0.03 mag in G, B or the mean, or 0.1 mag in R.
"""

import argparse
import re
import sys
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from glstar.camera.sensor.colourband import BandName, Channel, ColourBand

Float = NDArray[np.float64]

_WAVELENGTH_A = np.arange(3500.0, 7505.0, 5.0)
# Types that most stars of the catalogue have.
_TYPES = re.compile(r"uk((b\d+|a\d+|f\d+|g\d+|k\d+|m[0-2])(v|iii))")
_VALID_BV = (-0.3, 1.7)
_LIMITS_MAG = {"mean": 0.03, "r": 0.1, "g": 0.03, "b": 0.03}
# Photons of Vega (V 0.03) at 5556 A, 1/(s cm^2 A): 3.44e-9 erg/(s cm^2 A), Hayes (1985).
_VEGA_PHOTONS, _VEGA_A = 3.44e-9 / (6.62607e-27 * 2.99792458e18 / 5556), 5556.0


def table(path: Path, **options: object) -> Float:
    return np.loadtxt(path, **options)  # type: ignore[call-overload, no-any-return]


def sampled(wavelength_a: Float, values: Float) -> Float:
    return np.interp(_WAVELENGTH_A, wavelength_a, values, left=0.0, right=0.0)


def integral(values: Float) -> float:
    return float(np.trapezoid(values, _WAVELENGTH_A))


def magnitude(flux: Float, response: Float) -> float:
    """Return the magnitude of the photons that a response counts."""
    return -2.5 * float(np.log10(integral(flux * response * _WAVELENGTH_A)))


def responses_of(path: Path) -> dict[str, Float]:
    wavelength_nm, *colours = table(path, delimiter=",", skiprows=1).T
    r, g, b = (sampled(10 * wavelength_nm, colour) / max(one.max() for one in colours) for colour in colours)
    return {"mean": (r + 2 * g + b) / 4, "r": r, "g": g, "b": b}


def photons_per_s_cm2(a0: Float, response: Float) -> float:
    """Return the photons of an A0 star of magnitude 0, 1/(s cm^2)."""
    at_vega = np.interp(_VEGA_A, _WAVELENGTH_A, a0 * _WAVELENGTH_A)
    return _VEGA_PHOTONS * 10 ** (0.4 * 0.03) * integral(a0 * response * _WAVELENGTH_A) / float(at_vega)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("spectra", type=Path)
    parser.add_argument("passbands", type=Path)
    parser.add_argument("bands", nargs="+", metavar="BAND:RESPONSE.csv")
    given = parser.parse_args()
    b, v = (sampled(*table(given.passbands / f"Bessell_{band}.dat").T[:2]) for band in "BV")
    spectra = {
        found[1]: sampled(*table(path).T[:2])
        for path in sorted(given.spectra.glob("uk*.dat"))
        if (found := _TYPES.fullmatch(path.stem))
    }
    a0 = spectra["a0v"]

    def minus_v(flux: Float, response: Float) -> float:
        """Return the magnitude minus V, 0 for an A0 star."""
        return magnitude(flux, response) - magnitude(flux, v) - (magnitude(a0, response) - magnitude(a0, v))

    chosen = {name: minus_v(flux, b) for name, flux in spectra.items()}
    chosen = {name: bv for name, bv in chosen.items() if _VALID_BV[0] <= bv <= _VALID_BV[1]}
    bv = np.array(list(chosen.values()))
    print(
        f"{len(bv)} spectra\n| band | channel | slope | curvature | photons | rms, mag | largest | of |\n|{'---|' * 8}"
    )
    failed = False
    for one in given.bands:
        name, path = one.split(":", 1)
        band: BandName = name
        for channel, response in responses_of(Path(path)).items():
            of_channel: Channel | None = None if channel == "mean" else channel  # type: ignore[assignment]
            expected = np.array([minus_v(spectra[each], response) for each in chosen])
            slope, curvature = np.linalg.lstsq(np.column_stack([bv, bv**2]), expected, rcond=None)[0].tolist()
            error = ColourBand(band=band).magnitude_minus_v(bv, of_channel) - expected
            rms, worst = float(np.sqrt(np.mean(error**2))), int(np.abs(error).argmax())
            failed |= rms > _LIMITS_MAG[channel]
            print(
                f"| {name} | {channel} | {slope:.3f} | {curvature:.3f} | {photons_per_s_cm2(a0, response):.3g} |"
                f" {rms:.3f} | {abs(error[worst]):.3f} | {list(chosen)[worst]} |"
            )
    return int(failed)


if __name__ == "__main__":
    sys.exit(main())
