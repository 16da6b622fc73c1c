"""Writing of star catalogue files: SQLite with indices for cones and magnitudes, from rows or from columns at J2000."""

import os
import sqlite3
import warnings
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import closing, suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from glstar.arrays import Float
from glstar.errors import ExportError
from glstar.sky.catalogue.reading import APPLICATION_ID, CatalogueRow

_TABLES = """
CREATE TABLE star (
    number INTEGER PRIMARY KEY,             -- HR or HIP, as the provenance says
    name TEXT NOT NULL,                     -- proper name, or ''
    designation TEXT NOT NULL,              -- Bayer, else Flamsteed, or ''
    ra_rad REAL NOT NULL,                   -- equinox and epoch J2000, [0, 2 pi)
    dec_rad REAL NOT NULL,
    pm_ra_cosdec_rad_per_yr REAL NOT NULL,  -- on the sky: the factor cos(dec) included
    pm_dec_rad_per_yr REAL NOT NULL,
    vmag REAL NOT NULL,                     -- Johnson V
    bv REAL                                 -- Johnson B - V, NULL where unknown
);
CREATE TABLE provenance (key TEXT NOT NULL, value TEXT NOT NULL);
"""

# Columns of version 2 of the tables: the parallax, 0 if it is unknown, and the radial velocity, positive away from the
# Sun, NULL if it is unknown.
_DISTANCES = """
ALTER TABLE star ADD COLUMN parallax_rad REAL NOT NULL DEFAULT 0;
ALTER TABLE star ADD COLUMN radial_velocity_m_per_s REAL;
"""
_OF_DISTANCE = ("parallax_rad", "radial_velocity_m_per_s")

# Created after the stars.  A search in a cone uses the second or the third index, whichever band of the sky
# is narrower; their further columns let SQLite skip stars outside of the box without reading them.
_INDICES = """
CREATE INDEX star_vmag ON star (vmag);
CREATE INDEX star_ra_dec_vmag ON star (ra_rad, dec_rad, vmag);
CREATE INDEX star_dec_ra_vmag ON star (dec_rad, ra_rad, vmag);
"""

_ARCSEC_RAD = np.pi / 648000
# Julian dates of J2000.
_J2000 = (2451545.0, 0.0)
_DAYS_PER_YR = 365.25
# The range of BP - RP in which the relation between V and G holds, mag.
_BP_RP_RANGE = (-0.5, 5.0)


def write_catalogue(path: Path, stars: Sequence[CatalogueRow], provenance: Mapping[str, str]) -> None:
    """Write a catalogue file atomically: to a temporary file in the same folder, which is then renamed.

    `path`: the file; an existing one is replaced; `provenance`: the source of the stars and how they were processed, in
    the order to show it.  Raises ExportError if the file cannot be written.
    """
    rows = [tuple(star) for star in stars]
    knows_distances = any(star.parallax_rad or star.radial_velocity_m_per_s is not None for star in stars)
    if not knows_distances:
        rows = [row[: -len(_OF_DISTANCE)] for row in rows]
    _write(path, rows, provenance, knows_distances=knows_distances)


def write_rows(path: Path, rows: Iterable[tuple[object, ...]], provenance: Mapping[str, str]) -> None:
    """Write a catalogue file row by row, for millions of stars; see `write_catalogue`.

    `path`: the file; an existing one is replaced; `rows`: in the order of `CatalogueRow`, sorted by number.  Raises
    ExportError if the file cannot be written.
    """
    _write(path, rows, provenance, knows_distances=True)


def _write(
    path: Path, rows: Iterable[tuple[object, ...]], provenance: Mapping[str, str], *, knows_distances: bool
) -> None:
    beside = path.with_name(f".{path.name}.{os.getpid()}")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        beside.unlink(missing_ok=True)
        # No dates and no host names: the same stars give the same bytes.
        columns = len(CatalogueRow._fields) - (0 if knows_distances else len(_OF_DISTANCE))
        schema, tables = (2, _TABLES + _DISTANCES) if knows_distances else (1, _TABLES)
        with closing(sqlite3.connect(beside, isolation_level=None)) as connection:
            connection.executescript(
                "PRAGMA page_size = 4096; PRAGMA encoding = 'UTF-8';"
                "PRAGMA journal_mode = MEMORY; PRAGMA synchronous = OFF;"
                f"PRAGMA application_id = {APPLICATION_ID}; PRAGMA user_version = {schema}; {tables}"
            )
            connection.execute("BEGIN")
            connection.executemany(f"INSERT INTO star VALUES ({','.join('?' * columns)})", rows)  # noqa: S608
            connection.executemany("INSERT INTO provenance VALUES (?, ?)", provenance.items())
            connection.execute("COMMIT")
            connection.executescript(f"{_INDICES} VACUUM;")
        with beside.open("rb+") as file:
            os.fsync(file.fileno())
        beside.replace(path)
    except (OSError, sqlite3.Error) as error:
        raise ExportError(path, f"cannot be written: {getattr(error, 'strerror', None) or error}") from error
    finally:
        with suppress(OSError):
            beside.unlink(missing_ok=True)


@dataclass(frozen=True, slots=True, eq=False)
class CatalogueColumns:
    """Stars at equinox and epoch J2000, as columns."""

    number: NDArray[np.int64]  # (n,) numbers in the catalogue, each once
    ra_rad: Float  # (n,) right ascension, ICRS, in [0, 2 pi)
    dec_rad: Float  # (n,) declination, ICRS
    pm_ra_cosdec_rad_per_yr: Float  # (n,)
    pm_dec_rad_per_yr: Float  # (n,)
    parallax_rad: Float  # (n,) 0 where unknown
    radial_velocity_m_per_s: Float  # (n,) NaN where unknown
    vmag: Float  # (n,) Johnson V
    bv: Float  # (n,) Johnson B - V; NaN where unknown
    name: tuple[str, ...] = ()  # n names, or none
    designation: tuple[str, ...] = ()  # n designations, or none

    def __len__(self) -> int:
        return int(self.number.size)

    def __getitem__(self, stars: NDArray[np.intp] | NDArray[np.bool_]) -> Self:
        index = np.arange(len(self))[stars]
        name, designation = (tuple(words[k] for k in index) if words else () for words in (self.name, self.designation))
        return replace(
            self,
            number=self.number[index],
            ra_rad=self.ra_rad[index],
            dec_rad=self.dec_rad[index],
            pm_ra_cosdec_rad_per_yr=self.pm_ra_cosdec_rad_per_yr[index],
            pm_dec_rad_per_yr=self.pm_dec_rad_per_yr[index],
            parallax_rad=self.parallax_rad[index],
            radial_velocity_m_per_s=self.radial_velocity_m_per_s[index],
            vmag=self.vmag[index],
            bv=self.bv[index],
            name=name,
            designation=designation,
        )

    def rows(self) -> Iterator[tuple[object, ...]]:
        """Yield the stars in the order of the columns of a catalogue file; places are rounded to 0.2 microarcsec."""
        bv = [None if np.isnan(v) else v for v in self.bv.round(3).tolist()]
        velocity = [None if np.isnan(v) else v for v in self.radial_velocity_m_per_s.round(1).tolist()]
        blank = ("",) * len(self)
        return zip(
            self.number.tolist(),
            self.name or blank,
            self.designation or blank,
            self.ra_rad.round(12).tolist(),
            self.dec_rad.round(12).tolist(),
            self.pm_ra_cosdec_rad_per_yr.round(16).tolist(),
            self.pm_dec_rad_per_yr.round(16).tolist(),
            self.vmag.round(3).tolist(),
            bv,
            self.parallax_rad.round(16).tolist(),
            velocity,
            strict=True,
        )


def space_motion_to_j2000(
    place_rad: tuple[ArrayLike, ArrayLike],
    pm_rad_per_yr: tuple[ArrayLike, ArrayLike],
    parallax_rad: ArrayLike,
    radial_velocity_m_per_s: ArrayLike,
    epoch_yr: float,
) -> tuple[Float, Float, Float, Float]:
    """Return places and proper motions at J2000 of stars that move along straight lines in space.

    `place_rad`: right ascensions and declinations, (n,) each, ICRS at the epoch; `pm_rad_per_yr`: proper motions, (n,)
    each, in right ascension, cos(dec) included, and in declination, per Julian year; NaN for unknown; `parallax_rad`
    (n,): NaN or negative for unknown; `radial_velocity_m_per_s` (n,): NaN for unknown; `epoch_yr`: Julian year,
    barycentric.  Returns right ascensions, declinations and proper motions in both, (n,) each.

    ERFA's `pmsafe`: space motion with the time that light takes (Stumpff 1985), and with a small parallax where there
    is none.
    """
    ra, dec = (np.asarray(angle, dtype=np.float64) for angle in place_rad)
    pm_ra, pm_dec = (np.nan_to_num(np.asarray(pm, dtype=np.float64)) for pm in pm_rad_per_yr)
    if epoch_yr == 2000.0:
        return ra % (2 * np.pi), dec, pm_ra, pm_dec
    parallax = np.nan_to_num(np.asarray(parallax_rad, dtype=np.float64)).clip(min=0.0) / _ARCSEC_RAD
    velocity = np.nan_to_num(np.asarray(radial_velocity_m_per_s, dtype=np.float64)) / 1000
    import erfa  # noqa: PLC0415 - only for another epoch

    epoch = (_J2000[0], (epoch_yr - 2000.0) * _DAYS_PER_YR)
    with warnings.catch_warnings(action="ignore", category=erfa.ErfaWarning):  # that it assumes a small parallax
        new_ra, new_dec, new_pm_ra, new_pm_dec, _, _ = erfa.pmsafe(
            ra, dec, pm_ra / np.cos(dec), pm_dec, parallax, velocity, *epoch, *_J2000
        )
    return new_ra % (2 * np.pi), new_dec, new_pm_ra * np.cos(new_dec), new_pm_dec


def vmag_from_tycho(bt_mag: ArrayLike, vt_mag: ArrayLike) -> Float:
    """Return Johnson V from Tycho's magnitudes.

    `bt_mag`, `vt_mag` (n,): B_T and V_T; NaN for unknown.  Without B_T, V is V_T, as for B - V 0; without V_T, it is
    NaN.

    ESA 1997, The Hipparcos and Tycho Catalogues, vol. 1, section 1.3, appendix 4: V = V_T - 0.090 (B_T - V_T), within
    0.015 mag for unreddened stars of B - V from -0.2 to 1.8.
    """
    bt, vt = np.asarray(bt_mag, dtype=np.float64), np.asarray(vt_mag, dtype=np.float64)
    return np.asarray(vt - 0.090 * np.nan_to_num(bt - vt))


def bv_from_tycho(bt_mag: ArrayLike, vt_mag: ArrayLike) -> Float:
    """Return Johnson B - V, (n,), from Tycho's magnitudes: 0.850 (B_T - V_T), as for `vmag_from_tycho`."""
    return np.asarray(0.850 * (np.asarray(bt_mag, dtype=np.float64) - np.asarray(vt_mag, dtype=np.float64)))


def vmag_from_gaia(g_mag: ArrayLike, bp_rp: ArrayLike) -> Float:
    """Return Johnson V from Gaia's G and BP - RP.

    `bp_rp` (n,): clipped to -0.5 to 5, and 0.82 (the Sun's) where it is NaN.

    Gaia EDR3 documentation, section 5.5.1, table 5.9: G - V = -0.02704 + 0.01424 x - 0.2156 x^2 + 0.01426 x^3 with x
    = BP - RP; scatter 0.03 mag.
    """
    x = np.nan_to_num(np.asarray(bp_rp, dtype=np.float64), nan=0.82).clip(*_BP_RP_RANGE)
    return np.asarray(g_mag, dtype=np.float64) - (-0.02704 + x * (0.01424 + x * (-0.2156 + x * 0.01426)))
