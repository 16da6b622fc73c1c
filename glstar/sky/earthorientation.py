"""Earth orientation: UT1 - UTC and polar motion from the tables of the IERS.

The tables are part of the optional package astropy-iers-data; nothing is downloaded.  Without it, or for times outside
its table, UT1 = UTC and a fixed pole are assumed: errors of up to 13" and 0.5".
"""

import hashlib
import importlib.util
import warnings
from dataclasses import dataclass
from functools import lru_cache
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any, Final

import erfa
import numpy as np
from numpy.typing import NDArray

from glstar.sky.timescale import format_utc, tai_minus_utc_s

__all__ = ["EarthOrientation", "described_earth_orientation", "earth_orientation", "has_earth_orientation"]

Float = NDArray[np.float64]

_PACKAGE: Final = "astropy_iers_data"
_DISTRIBUTION: Final = "astropy-iers-data"
_TABLE: Final = "finals2000A.all"
_UNIX_EPOCH_MJD: Final = 40587.0
_DAY_S: Final = 86400.0
_ARCSEC_RAD: Final = np.pi / 648000

# Columns of finals2000A.all, from 0: first the final values of Bulletin B, which exist up to a few months ago, then the
# rapid and predicted values of Bulletin A.
_MJD: Final = slice(7, 15)
_X_POLE_ARCSEC: Final = (slice(134, 144), slice(18, 27))
_Y_POLE_ARCSEC: Final = (slice(144, 154), slice(37, 46))
_DUT1_S: Final = (slice(154, 165), slice(58, 68))


@dataclass(frozen=True, slots=True)
class EarthOrientation:
    """Earth orientation parameters at one time.

    Attributes
    ----------
    dut1_s : float
        UT1 - UTC, s.
    x_pole_rad, y_pole_rad : float
        Position of the celestial intermediate pole on the Earth: towards Greenwich, and towards 90 deg west, rad.
    """

    dut1_s: float = 0.0
    x_pole_rad: float = 0.0
    y_pole_rad: float = 0.0

    @property
    def polar_motion(self) -> Float:
        """Matrix from the frame of the intermediate pole to the terrestrial frame (ITRS), (3, 3) float64."""
        return np.asarray(erfa.pom00(self.x_pole_rad, self.y_pole_rad, 0.0), dtype=np.float64)


@dataclass(frozen=True, slots=True, eq=False)
class _Table:
    """Daily values of the IERS table, and their source."""

    utc_s: Float
    ut1_minus_tai_s: Float
    x_pole_rad: Float
    y_pole_rad: Float
    source: str
    sha256: str


def earth_orientation(utc_s: float) -> EarthOrientation | None:
    """Return the Earth orientation parameters, interpolated between the days of the IERS table.

    Parameters
    ----------
    utc_s : float
        UTC seconds since 1970.

    Returns
    -------
    EarthOrientation or None
        None if no table is installed or it does not cover the time.
    """
    table = _table()
    if table is None or not table.utc_s[0] <= utc_s <= table.utc_s[-1]:
        return None
    # UT1 - TAI is interpolated, because it has no leap seconds.
    values = (table.ut1_minus_tai_s, table.x_pole_rad, table.y_pole_rad)
    ut1_minus_tai_s, x_pole_rad, y_pole_rad = (float(np.interp(utc_s, table.utc_s, value)) for value in values)
    return EarthOrientation(ut1_minus_tai_s + tai_minus_utc_s(utc_s), x_pole_rad, y_pole_rad)


def has_earth_orientation() -> bool:
    """Return whether an IERS table is installed.

    Returns
    -------
    bool
    """
    return _table() is not None


def described_earth_orientation(utc_s: float) -> dict[str, Any]:
    """Return the manifest's entry about the Earth orientation.

    Parameters
    ----------
    utc_s : float
        A time of the export: the flight's first attitude, UTC seconds since 1970.

    Returns
    -------
    dict
        Source and values; empty if no table is installed.
    """
    table = _table()
    if table is None:
        return {}
    source = {"source": table.source, "sha256": table.sha256}
    found = earth_orientation(utc_s)
    if found is None:
        covers = f"{format_utc(table.utc_s[0])[:10]} to {format_utc(table.utc_s[-1])[:10]}"
        return {"earth_orientation": source | {"covers": covers, "dut1_s": 0.0}}
    values = {
        "utc": format_utc(utc_s),
        "dut1_s": round(found.dut1_s, 7),
        "x_pole_arcsec": round(found.x_pole_rad / _ARCSEC_RAD, 6),
        "y_pole_arcsec": round(found.y_pole_rad / _ARCSEC_RAD, 6),
    }
    return {"earth_orientation": source | values}


@lru_cache(maxsize=1)
def _table() -> _Table | None:
    """Return the table of the installed package; None if there is none."""
    spec = importlib.util.find_spec(_PACKAGE)
    for folder in (spec.submodule_search_locations or ()) if spec else ():
        path = Path(folder) / "data" / _TABLE
        if path.is_file():
            try:
                source = f"{_DISTRIBUTION} {version(_DISTRIBUTION)}, {_TABLE}"
            except PackageNotFoundError:
                source = f"{_DISTRIBUTION}, {_TABLE}"
            return _read(path.read_bytes(), source)
    return None


def _read(content: bytes, source: str) -> _Table:
    # The last days have no prediction yet: skip them.
    lines = [line for line in content.decode("ascii").splitlines() if line[_DUT1_S[1]].strip()]
    mjd = np.array([float(line[_MJD]) for line in lines])
    x_pole_arcsec, y_pole_arcsec, dut1_s = (
        np.array([float(line[final].strip() or line[rapid]) for line in lines])
        for final, rapid in (_X_POLE_ARCSEC, _Y_POLE_ARCSEC, _DUT1_S)
    )
    with warnings.catch_warnings():
        # "Dubious year": no leap second is announced for the years of the predictions.
        warnings.simplefilter("ignore", erfa.ErfaWarning)
        year, month, day, _ = erfa.jd2cal(2400000.5, mjd)
        leap_s = erfa.dat(year, month, day, 0.0)
    return _Table(
        utc_s=(mjd - _UNIX_EPOCH_MJD) * _DAY_S,
        ut1_minus_tai_s=dut1_s - leap_s,
        x_pole_rad=x_pole_arcsec * _ARCSEC_RAD,
        y_pole_rad=y_pole_arcsec * _ARCSEC_RAD,
        source=source,
        sha256=hashlib.sha256(content).hexdigest(),
    )
