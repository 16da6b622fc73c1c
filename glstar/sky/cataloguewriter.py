"""Writing of star catalogue files: SQLite with indices for cones and magnitudes."""

import os
import sqlite3
from collections.abc import Iterable, Mapping, Sequence
from contextlib import closing, suppress
from pathlib import Path
from typing import NamedTuple

from glstar.errors import ExportError
from glstar.sky.catalogue import APPLICATION_ID

__all__ = ["CatalogueRow", "write_catalogue", "write_rows"]

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


class CatalogueRow(NamedTuple):
    """One row of the table `star`."""

    number: int
    name: str
    designation: str
    ra_rad: float
    dec_rad: float
    pm_ra_cosdec_rad_per_yr: float
    pm_dec_rad_per_yr: float
    vmag: float
    bv: float | None
    parallax_rad: float = 0.0
    radial_velocity_m_per_s: float | None = None


def write_catalogue(path: Path, stars: Sequence[CatalogueRow], provenance: Mapping[str, str]) -> None:
    """Write a catalogue file atomically: to a temporary file in the same folder, which is then renamed.

    Parameters
    ----------
    path : Path
        The file; an existing one is replaced.
    stars : sequence of CatalogueRow
    provenance : mapping of str to str
        The source of the stars and how they were processed, in the order to show it.

    Raises
    ------
    ExportError
        If the file cannot be written.
    """
    rows = [tuple(star) for star in stars]
    knows_distances = any(star.parallax_rad or star.radial_velocity_m_per_s is not None for star in stars)
    if not knows_distances:
        rows = [row[: -len(_OF_DISTANCE)] for row in rows]
    _write(path, rows, provenance, knows_distances=knows_distances)


def write_rows(path: Path, rows: Iterable[tuple[object, ...]], provenance: Mapping[str, str]) -> None:
    """Write a catalogue file row by row, for millions of stars; see `write_catalogue`.

    Parameters
    ----------
    path : Path
        The file; an existing one is replaced.
    rows : iterable of tuple
        In the order of `CatalogueRow`, sorted by number.
    provenance : mapping of str to str

    Raises
    ------
    ExportError
        If the file cannot be written.
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
