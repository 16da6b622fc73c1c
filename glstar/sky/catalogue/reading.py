"""Star catalogues: mean places at J2000, proper motions, parallaxes and magnitudes of stars.

A catalogue is one SQLite file with indices for searches by magnitude and by direction::

    catalogue = StarCatalogue.open("bsc5")                    # or "hipparcos", or a file
    catalogue.brighter_than(6.5)                              # a StarCatalogue of 8404 stars
    catalogue.within(direction, radius_rad, vmag=6.5)         # those within a cone
    catalogue.by_id([2491, 2326])                             # Sirius and Canopus

`CatalogueFile` is a catalogue on disk; `StarCatalogue` holds the stars of a query as arrays in memory.  The file is
opened for each query and closed after it, so any thread may query it and nothing has to be closed.
"""

import hashlib
import os
import sqlite3
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import closing, contextmanager
from dataclasses import dataclass, field, fields
from pathlib import Path
from types import MappingProxyType
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray
from platformdirs import user_data_path

from glstar.arrays import Float
from glstar.errors import CatalogueError, reason_of
from glstar.system.resources import asset

NAMES = ("bsc5", "hipparcos", "tycho2", "gaia")
ALL_NAMES = f"{', '.join(NAMES[:-1])} or {NAMES[-1]}"
# The prefix of a star's number in each catalogue, as SIMBAD writes it: HR 2491, HIP 32349, TYC 1-8-1.
PREFIXES = {"bsc5": "HR", "hipparcos": "HIP", "tycho2": "TYC", "gaia": "Gaia row"}
# A Tycho number, TYC a-b-c, as one number below 2^31: a * 200000 + b * 10 + c; b is at most 12121, c at most 3.
_TYC_FIRST, _TYC_SECOND = 200_000, 10

# The header of a catalogue file has "glst" in ASCII as its application ID, and the version of the tables as its user
# version: 1 without parallaxes and radial velocities, 2 with them.
APPLICATION_ID = 0x676C7374
SCHEMAS = (1, 2)

# Margin of the box around a cone, rad (0.2 mas), so that rounding excludes no star; the cone itself is exact.
_MARGIN_RAD = 1e-9

# Number of rows that are held as Python objects at once.
_ROWS_AT_ONCE = 100_000

# Number of stars per query: SQLite limits the parameters of a statement to 999 in older versions.
_NUMBERS_AT_ONCE = 500

_COLUMNS = """
    SELECT number, name, designation, ra_rad, dec_rad, pm_ra_cosdec_rad_per_yr, pm_dec_rad_per_yr, vmag, bv,
"""
# The last columns of a row, by the version of the tables.
_DISTANCES = {1: "0.0, 0.0 FROM star ", 2: "parallax_rad, radial_velocity_m_per_s FROM star "}
_BOX = "WHERE ra_rad BETWEEN ? AND ? AND dec_rad BETWEEN ? AND ? AND vmag <= ?"
_BRIGHTER_THAN = "INDEXED BY star_vmag WHERE vmag <= ? ORDER BY vmag, number"
_WITHIN_BY_RA = "INDEXED BY star_ra_dec_vmag " + _BOX
_WITHIN_BY_DEC = "INDEXED BY star_dec_ra_vmag " + _BOX
_BY_NUMBER = "WHERE number IN ({})"


def star_label(catalogue: str, star_id: int) -> str:
    """Return a star's designation by its number in a catalogue: ``"HR 2491"``; ``"star 2491"`` in an unknown one."""
    if catalogue == "tycho2":
        first, rest = divmod(int(star_id), _TYC_FIRST)
        return f"TYC {first}-{rest // _TYC_SECOND}-{rest % _TYC_SECOND}"
    return f"{PREFIXES.get(catalogue, 'star')} {star_id}"


def tycho_number(text: str) -> int:
    """Return the number of a Tycho star, a * 200000 + b * 10 + c, of its numbers ``"a b c"`` or ``"a-b-c"``."""
    first, second, third = map(int, text.replace("-", " ").split())
    return first * _TYC_FIRST + second * _TYC_SECOND + third


def catalogue_path(name_or_path: str | os.PathLike[str]) -> Path:
    """Return the path of a catalogue, whether or not the file exists.

    `name_or_path`: ``"bsc5"``: bundled with glstar; ``"hipparcos"``, ``"tycho2"``, ``"gaia"``: in the user's data
    directory, or in the directory of the environment variable ``GLSTAR_DATA_DIR``; anything else is a path.
    """
    if name_or_path == "bsc5":
        return asset("bsc5.sqlite")
    if name_or_path in NAMES:
        directory = os.environ.get("GLSTAR_DATA_DIR")
        return (Path(directory) if directory else user_data_path("glstar", appauthor=False)) / f"{name_or_path}.sqlite"
    return Path(name_or_path)


class CatalogueRow(NamedTuple):
    """One row of the table `star`, in the order of `_COLUMNS`."""

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


_NUMBER = frozenset({float, int})
# Types of a column's values, of a damaged file or a stranger's too; `_NUMBER` for the others.
_TYPES: Mapping[str, frozenset[type]] = {
    "number": frozenset({int}),
    "name": frozenset({str}),
    "designation": frozenset({str}),
    "bv": _NUMBER | {type(None)},
    "radial_velocity_m_per_s": _NUMBER | {type(None)},
}
# Largest sizes of a column's values; larger ones are no stars, and overflow.
LARGEST: Mapping[str, float] = {
    "number": 2**31 - 1,
    "ra_rad": 2 * np.pi,
    "dec_rad": np.pi / 2,
    "pm_ra_cosdec_rad_per_yr": 1.0,
    "pm_dec_rad_per_yr": 1.0,
    "vmag": 100.0,
    "bv": 100.0,
    "parallax_rad": 1.0,
    "radial_velocity_m_per_s": 3e8,
}


@dataclass(frozen=True, slots=True, eq=False)
class StarCatalogue:
    """Stars of a catalogue, the brightest first; stars of equal magnitude are sorted by number.

    Attributes
    ----------
    catalogue : str
        The catalogue that numbers the stars: ``"bsc5"``, ``"hipparcos"``, or ``""`` if it is unknown.
    star_id : (n,) int32
        The stars' numbers in that catalogue: HR for ``bsc5``, HIP for ``hipparcos``.
    name : tuple of str, n long
        The star's proper name (Sirius), else its designation (α² CVn, 61 Cyg), else ``""``.
    ra_rad, dec_rad : (n,) float64
        Mean right ascension in [0, 2 pi) and declination, equinox and epoch J2000, rad.
    pm_ra_cosdec_rad_per_yr, pm_dec_rad_per_yr : (n,) float64
        Proper motion, rad per Julian year; the one in right ascension includes cos(dec).
    vmag : (n,) float64
        Johnson V magnitude.
    bv : (n,) float64
        Johnson B - V, mag; NaN where the catalogue has none.
    parallax_rad : (n,) float64
        Parallax, rad; 0 where the catalogue has none.
    radial_velocity_m_per_s : (n,) float64
        Radial velocity, m/s, away from the Sun positive; 0 where the catalogue has none.
    """

    catalogue: str
    star_id: NDArray[np.int32]
    name: tuple[str, ...]
    ra_rad: Float
    dec_rad: Float
    pm_ra_cosdec_rad_per_yr: Float
    pm_dec_rad_per_yr: Float
    vmag: Float
    bv: Float
    parallax_rad: Float = field(default_factory=lambda: np.empty(0))
    radial_velocity_m_per_s: Float = field(default_factory=lambda: np.empty(0))

    def __post_init__(self) -> None:
        for name in ("parallax_rad", "radial_velocity_m_per_s"):
            if getattr(self, name).size == 0:
                object.__setattr__(self, name, np.zeros(len(self.name)))
        arrays = (self.star_id, self.ra_rad, self.dec_rad, self.pm_ra_cosdec_rad_per_yr, self.pm_dec_rad_per_yr)
        for array in (*arrays, self.vmag, self.bv, self.parallax_rad, self.radial_velocity_m_per_s):
            if array.shape != (len(self.name),):
                raise ValueError(f"a catalogue of {len(self.name)} names cannot have a column of shape {array.shape}")
            array.flags.writeable = False

    def __len__(self) -> int:
        return len(self.name)

    def brightest(self, vmag: float) -> "StarCatalogue":
        """Return the stars up to a magnitude limit.

        Parameters
        ----------
        vmag : float
            The faintest V magnitude, inclusive.

        Returns
        -------
        StarCatalogue
        """
        n = int(np.searchsorted(self.vmag, vmag, side="right"))
        columns = {column.name: getattr(self, column.name)[:n] for column in fields(self) if column.name != "catalogue"}
        return StarCatalogue(self.catalogue, **columns)

    @property
    def direction(self) -> Float:
        """Unit vectors of equinox and epoch J2000, (n, 3) float64; axes: the equinox, 6 h, the north pole."""
        return _direction(self.ra_rad, self.dec_rad)

    @staticmethod
    def open(name_or_path: str | os.PathLike[str]) -> "CatalogueFile":
        """Open and check a catalogue file.

        Parameters
        ----------
        name_or_path : str or path
            ``"bsc5"``, ``"hipparcos"``, or the path of a file written by `glstar.sky.catalogue.bright`.

        Returns
        -------
        CatalogueFile

        Raises
        ------
        CatalogueError
            If the file does not exist or is not a glstar catalogue.
        """
        path = catalogue_path(name_or_path)
        schema = _checked_schema(path, name_or_path)
        with _reading(path) as connection:
            provenance = dict(connection.execute("SELECT key, value FROM provenance ORDER BY rowid"))
            facts = connection.execute(
                "SELECT count(*), min(number), max(number), min(vmag), max(vmag) FROM star"
            ).fetchone()
            if facts[0] and not (set(map(type, facts[:3])) == {int} and set(map(type, facts[3:])) <= {int, float}):
                raise sqlite3.DataError("a star has a number or a magnitude of another type")
        if facts[0] == 0:
            raise CatalogueError(
                path, "is a glstar catalogue without a star; build it again with `glstar sky catalogue build`"
            )
        return CatalogueFile(path, MappingProxyType(provenance), *(*facts, schema))


@dataclass(frozen=True, slots=True, eq=False)
class CatalogueFile:
    """A star catalogue on disk, opened by `StarCatalogue.open`."""

    path: Path
    provenance: Mapping[str, str]  # source of the stars and how they were processed
    count: int  # number of stars
    first_number: int  # lowest number of a star (HR or HIP)
    last_number: int  # highest number of a star
    brightest_vmag: float
    faintest_vmag: float
    schema: int  # version of its tables: 1 without parallaxes and radial velocities, 2 with them

    @property
    def numbering(self) -> str:
        """The prefix of its star numbers: ``"HR"`` or ``"HIP"``."""
        return self.provenance.get("numbering", "number")

    @property
    def catalogue(self) -> str:
        """The catalogue that numbers the stars: ``"bsc5"``, ``"hipparcos"``, or ``""`` if it is unknown."""
        return next((name for name, prefix in PREFIXES.items() if prefix == self.numbering), "")

    @property
    def note(self) -> str:
        """A message about a limitation of the file; empty if there is none."""
        if self.catalogue == "hipparcos" and self.schema == 1:
            return (
                f"{self.path}: this Hipparcos file of an earlier glstar has no parallaxes, which move the nearest stars"
                " by up to 0.8 arcsec; build it again with `glstar sky catalogue build hipparcos --force`"
            )
        return ""

    @property
    def sha256(self) -> str:
        """The SHA-256 of the file, in hexadecimal."""
        try:
            with self.path.open("rb") as file:
                return hashlib.file_digest(file, "sha256").hexdigest()
        except OSError as error:
            raise CatalogueError(self.path, f"cannot be read: {error.strerror}") from error

    def brighter_than(self, vmag: float) -> StarCatalogue:
        """Return the stars up to a magnitude limit; `vmag`: the faintest V magnitude, inclusive."""
        with _reading(self.path) as connection:
            return _many_stars(self.catalogue, _query(connection, _BRIGHTER_THAN, (float(vmag),)))

    def within(self, direction: ArrayLike, radius_rad: float, *, vmag: float = np.inf) -> StarCatalogue:
        """Return the stars within a cone, by their mean places at J2000.

        `direction` (3,): the cone's axis, equinox J2000, of any length: a row of `StarCatalogue.direction`;
        `radius_rad`: the largest angle from the axis, inclusive, rad; `vmag`: the faintest V magnitude, inclusive.
        Raises ValueError if the axis is not a vector of finite length above 0, or the radius is negative or NaN.
        """
        axis = np.asarray(direction, dtype=np.float64)
        length = float(np.linalg.norm(axis))
        if axis.shape != (3,) or not np.isfinite(length) or length == 0:
            raise ValueError(f"a cone's axis is a vector of three numbers with a length, not {direction!r}")
        if not radius_rad >= 0:
            raise ValueError(f"a cone has a radius of 0 rad or more, not {radius_rad}")
        axis = axis / length

        rows: list[CatalogueRow] = []
        with _reading(self.path) as connection:
            for box in _boxes(axis, radius_rad):
                rows += _rows(_query(connection, _within(*box), (*box, float(vmag))))
        directions = _direction(np.array([row.ra_rad for row in rows]), np.array([row.dec_rad for row in rows]))
        # The arc cosine of the dot product would lose arcseconds at small angles.
        angle_rad = np.arctan2(np.linalg.norm(np.cross(directions, axis), axis=-1), directions @ axis)
        inside = (row for row, angle in zip(rows, angle_rad, strict=True) if angle <= radius_rad)
        return _stars(self.catalogue, inside)

    def by_id(self, star_ids: Iterable[int]) -> StarCatalogue:
        """Return the stars with given numbers (HR or HIP), the brightest first, each once.

        Raises CatalogueError if the catalogue lacks one of the numbers.
        """
        numbers = sorted({int(star_id) for star_id in star_ids})
        rows: list[CatalogueRow] = []
        with _reading(self.path) as connection:
            for start in range(0, len(numbers), _NUMBERS_AT_ONCE):
                part = numbers[start : start + _NUMBERS_AT_ONCE]
                rows += _rows(_query(connection, _BY_NUMBER.format(",".join("?" * len(part))), part))
        missing = sorted(set(numbers) - {row.number for row in rows})
        if missing:
            raise CatalogueError(self.path, self._lacks(missing))
        return _stars(self.catalogue, rows)

    def _lacks(self, missing: list[int]) -> str:
        """Return a message about numbers that the catalogue lacks."""
        shown = ", ".join(map(str, missing[:5])) + (f" and {len(missing) - 5} more" if len(missing) > 5 else "")
        message = (
            f"the catalogue has no {self.numbering} {shown};"
            f" it holds {self.numbering} {self.first_number} to {self.last_number}"
        )
        gaps = self.last_number - self.first_number + 1 - self.count
        if gaps and any(self.first_number <= number <= self.last_number for number in missing):
            message += f", {gaps} in between left out"
        return message


def _checked_schema(path: Path, asked: str | os.PathLike[str]) -> int:
    """Return the version of a catalogue file's tables; raise CatalogueError if it is no glstar catalogue."""
    if path.is_dir():
        raise CatalogueError(path, f"is a directory; name a catalogue file, {ALL_NAMES}")
    if path.exists() and not path.is_file():
        raise CatalogueError(path, f"is no regular file; name a catalogue file, {ALL_NAMES}")
    try:
        with path.open("rb") as file:
            header = file.read(100)
    except FileNotFoundError as error:
        if asked in NAMES and asked != "bsc5":
            raise CatalogueError(path, f"does not exist yet; run `glstar sky catalogue build {asked}`") from error
        if asked == "bsc5":
            raise CatalogueError(
                path, "is missing from this installation; run `glstar sky catalogue build bsc5`"
            ) from error
        raise CatalogueError(path, f"does not exist; name a catalogue file, {ALL_NAMES}") from error
    except (OSError, ValueError) as error:
        raise CatalogueError(path, f"cannot be read: {getattr(error, 'strerror', None) or error}") from error
    if not header:
        raise CatalogueError(path, "is empty; build it again with `glstar sky catalogue build`")
    if len(header) < 100 or not header.startswith(b"SQLite format 3\0"):
        raise CatalogueError(path, "is no SQLite file; name one that `glstar sky catalogue build` wrote")
    # The user version and the application ID are at bytes 60 and 68 of an SQLite file, big-endian.
    schema, application_id = int.from_bytes(header[60:64]), int.from_bytes(header[68:72])
    if application_id != APPLICATION_ID:
        raise CatalogueError(
            path, "is a SQLite file but no glstar catalogue; name one that `glstar sky catalogue build` wrote"
        )
    if schema not in SCHEMAS:
        raise CatalogueError(
            path,
            f"has tables of version {schema} and this glstar reads versions {SCHEMAS[0]} and {SCHEMAS[1]};"
            " build it again with `glstar sky catalogue build`",
        )
    return schema


@contextmanager
def _reading(path: Path) -> Iterator[sqlite3.Connection]:
    """Yield a read-only connection and close it; raise CatalogueError if SQLite finds the file damaged."""
    try:
        # `immutable`: without lock and journal files, so that the disk may be read-only.
        with closing(sqlite3.connect(f"{path.resolve().as_uri()}?mode=ro&immutable=1", uri=True)) as connection:
            # A view may have rows without end.
            if connection.execute("SELECT 1 FROM sqlite_master WHERE type NOT IN ('table', 'index')").fetchone():
                raise CatalogueError(path, "has views or triggers, which `glstar sky catalogue build` does not write")
            yield connection
    # Messages of SQLite that quote a damaged file cannot always be decoded.
    except (sqlite3.Error, UnicodeDecodeError) as error:
        raise CatalogueError(
            path, f"is damaged ({reason_of(error)}); build it again with `glstar sky catalogue build`"
        ) from error


def _query(connection: sqlite3.Connection, condition: str, values: Sequence[float]) -> sqlite3.Cursor:
    """Return the rows of the stars that meet a condition, from tables of any known version."""
    [schema] = connection.execute("PRAGMA user_version").fetchone()
    return connection.execute(_statement(condition, schema), values)


def _statement(condition: str, schema: int) -> str:
    """Return the SQL statement that selects the stars that meet a condition."""
    return f"{_COLUMNS}{_DISTANCES[schema]}{condition}"


def _boxes(axis: Float, radius_rad: float) -> list[tuple[float, float, float, float]]:
    """Return boxes (lowest ra, highest ra, lowest dec, highest dec; rad) that cover a cone: two if it crosses 0 h."""
    radius = min(radius_rad + _MARGIN_RAD, np.pi)
    ra, dec = float(np.arctan2(axis[1], axis[0])) % (2 * np.pi), float(np.arctan2(axis[2], np.hypot(*axis[:2])))
    south, north = max(dec - radius, -np.pi / 2), min(dec + radius, np.pi / 2)
    if south == -np.pi / 2 or north == np.pi / 2:
        # A cone around a pole covers all right ascensions.
        return [(0.0, 2 * np.pi, south, north)]
    # Half width of the cone in right ascension, from a right-angled spherical triangle.
    half = float(np.arcsin(min(np.sin(radius) / np.cos(dec), 1.0))) + _MARGIN_RAD
    west, east = ra - half, ra + half
    if west < 0:
        return [(west + 2 * np.pi, 2 * np.pi, south, north), (0.0, east, south, north)]
    if east >= 2 * np.pi:
        return [(west, 2 * np.pi, south, north), (0.0, east - 2 * np.pi, south, north)]
    return [(west, east, south, north)]


def _within(west: float, east: float, south: float, north: float) -> str:
    """Return the condition for a box (rad), with the index of its band in ra or dec that covers less of the sky."""
    lune, zone = (east - west) / (2 * np.pi), (np.sin(north) - np.sin(south)) / 2
    return _WITHIN_BY_RA if lune < zone else _WITHIN_BY_DEC


def _rows(found: Iterable[tuple[object, ...]]) -> list[CatalogueRow]:
    """Return rows of `_COLUMNS`; raise sqlite3.DataError if a value has not the type of its column, or is too large.

    SQLite returns what a file has, whatever its tables declare.
    """
    rows = list(map(CatalogueRow._make, found))
    for name, values in zip(CatalogueRow._fields, zip(*rows, strict=True), strict=bool(rows)):
        if not set(map(type, values)) <= _TYPES.get(name, _NUMBER):
            raise sqlite3.DataError(f"a star has a {name} of another type")
        sizes = [0, *filter(None, values)] if name in LARGEST else [0]
        if max(sizes) > LARGEST.get(name, 0) or -min(sizes) > LARGEST.get(name, 0):
            raise sqlite3.DataError(f"a star has a {name} of more than {LARGEST[name]:g}")
    return rows


def _stars(catalogue: str, rows: Iterable[CatalogueRow]) -> StarCatalogue:
    """Return rows as arrays, the brightest first, then by number."""
    ordered = sorted(rows, key=lambda row: (row.vmag, row.number))
    columns = list(zip(*ordered, strict=True)) or [()] * len(CatalogueRow._fields)
    ra, dec, pm_ra, pm_dec, vmag, bv, parallax, velocity = (np.array(values, np.float64) for values in columns[3:])
    return StarCatalogue(
        catalogue=catalogue,
        star_id=np.array(columns[0], dtype=np.int32),
        name=tuple(row.name or row.designation for row in ordered),
        ra_rad=ra,
        dec_rad=dec,
        pm_ra_cosdec_rad_per_yr=pm_ra,
        pm_dec_rad_per_yr=pm_dec,
        vmag=vmag,
        bv=bv,
        parallax_rad=parallax,
        radial_velocity_m_per_s=np.nan_to_num(velocity),
    )


def _many_stars(catalogue: str, cursor: sqlite3.Cursor) -> StarCatalogue:
    """Return rows that are sorted already, as arrays, in chunks: millions of rows as tuples would take gigabytes."""
    cursor.row_factory = None
    parts = []
    while rows := cursor.fetchmany(_ROWS_AT_ONCE):
        parts.append(_stars(catalogue, _rows(rows)))
    if len(parts) == 1:
        return parts[0]
    if not parts:
        return _stars(catalogue, ())
    names = tuple(name for part in parts for name in part.name)
    columns = {
        column.name: np.concatenate([getattr(part, column.name) for part in parts])
        for column in fields(StarCatalogue)
        if column.name not in {"catalogue", "name"}
    }
    return StarCatalogue(catalogue, name=names, **columns)


def _direction(ra_rad: Float, dec_rad: Float) -> Float:
    """Return unit vectors, (n, 3)."""
    cos_dec = np.cos(dec_rad)
    return np.stack([cos_dec * np.cos(ra_rad), cos_dec * np.sin(ra_rad), np.sin(dec_rad)], axis=-1)
