"""Reading of anybody's star table: CSV or FITS, with a map from its columns."""

import csv
import gzip
import io
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from glstar.errors import CatalogueError
from glstar.sky.startable import CatalogueColumns, bv_from_tycho, space_motion_to_j2000, vmag_from_gaia, vmag_from_tycho
from glstar.system.installation import install_command

__all__ = ["QUANTITIES", "read_mapped"]

Float = NDArray[np.float64]

_MAS_RAD: Final = np.pi / 648000 / 1000
_LARGEST_NUMBER: Final = 2**31 - 1

# What a table may give, and names of columns, in lower case, that are taken without a map: of Gaia's archive, of the
# CDS's tables (ASCC-2.5, UCAC4, Hipparcos) and glstar's own.
QUANTITIES: Final[Mapping[str, tuple[str, ...]]] = {
    "number": ("number", "source_id", "hip", "hr", "ucac4", "ascc", "id"),
    "designation": ("designation", "name"),
    "ra_deg": ("ra_deg", "ra", "raj2000", "_raj2000", "radeg", "ra_icrs"),
    "ra_hours": ("ra_hours", "rahour"),
    "dec_deg": ("dec_deg", "dec", "dej2000", "_dej2000", "dedeg", "de_icrs"),
    "pm_ra_mas_per_yr": ("pm_ra_mas_per_yr", "pmra"),
    "pm_dec_mas_per_yr": ("pm_dec_mas_per_yr", "pmdec", "pmde"),
    "parallax_mas": ("parallax_mas", "parallax", "plx"),
    "radial_velocity_km_per_s": ("radial_velocity_km_per_s", "radial_velocity", "rv"),
    "vmag": ("vmag", "johnson_v"),
    "bv": ("bv", "b-v", "b_v"),
    "bmag": ("bmag",),
    "g_mag": ("g_mag", "phot_g_mean_mag", "gmag"),
    "bp_rp": ("bp_rp", "bp-rp"),
    "bt_mag": ("bt_mag", "btmag"),
    "vt_mag": ("vt_mag", "vtmag"),
    "epoch_yr": ("epoch_yr", "ref_epoch"),
}


@dataclass(frozen=True, slots=True, eq=False)
class _Columns:
    """The columns of a table by their names, and which of them gives which quantity."""

    path: Path
    by_name: Mapping[str, Sequence[Any] | NDArray[Any]]
    chosen: Mapping[str, str]

    def numbers(self, quantity: str) -> Float | None:
        """Return a column as numbers, NaN for blanks; None if no column gives the quantity."""
        if quantity not in self.chosen:
            return None
        column = self.by_name[self.chosen[quantity]]
        try:
            if isinstance(column, np.ndarray) and column.dtype.kind in "fiu":
                return column.astype(np.float64)
            blanks = {"", "null", "nan", "none", "--"}
            return np.array([float("nan") if str(v).strip().lower() in blanks else float(v) for v in column])
        except ValueError as error:
            raise CatalogueError(
                self.path, f"its column {self.chosen[quantity]} has a value that is no number"
            ) from error

    def unless_missing(self, quantity: str) -> Float:
        """Return a column as numbers; NaN for all stars if no column gives the quantity."""
        values = self.numbers(quantity)
        return np.full(len(next(iter(self.by_name.values()))), np.nan) if values is None else values


def read_mapped(path: Path, columns: Mapping[str, str], epoch_yr: float | None = None) -> CatalogueColumns:
    """Read a star table.

    Parameters
    ----------
    path : Path
        CSV with a header (also ``.csv.gz``), or FITS with a table.
    columns : mapping of str to str
        Quantity, a key of `QUANTITIES`, to the name of the table's column; others are found by their usual names.
    epoch_yr : float, optional
        Julian year of the places; without it, the column ``epoch_yr`` or ``ref_epoch``, else 2000.

    Returns
    -------
    CatalogueColumns
        At J2000.  Stars without a magnitude, or without a place, are left out.  Stars are numbered by brightness where
        the table has no numbers, or numbers above 2^31; those are then their designations.

    Raises
    ------
    CatalogueError
        If the table cannot be read, or lacks places or magnitudes.
    """
    by_name = _read(path)
    table = _Columns(path, by_name, _chosen(path, by_name, columns))
    ra = table.numbers("ra_deg")
    if ra is None and "ra_hours" in table.chosen:
        ra = 15 * table.unless_missing("ra_hours")
    dec = table.numbers("dec_deg")
    if ra is None or dec is None:
        raise CatalogueError(path, f"has no column of right ascension and declination among {_named(by_name)};{_HINT}")
    vmag, bv = _magnitudes(table)
    epoch = _epochs(table, len(ra), epoch_yr)
    _check_places(path, ra, dec)
    usable = ~(np.isnan(ra) | np.isnan(dec) | np.isnan(vmag))
    parallax = table.unless_missing("parallax_mas")
    velocity = table.unless_missing("radial_velocity_km_per_s")
    pm = table.unless_missing("pm_ra_mas_per_yr"), table.unless_missing("pm_dec_mas_per_yr")
    moved = _moved(
        np.deg2rad([ra, dec]),
        np.array(pm) * _MAS_RAD,
        parallax * _MAS_RAD,
        velocity * 1000,
        epoch * np.where(usable, 1, np.nan),
    )
    number, designation = _numbers(table, vmag)
    parallax_rad = np.nan_to_num(parallax).clip(min=0) * _MAS_RAD
    stars = CatalogueColumns(
        number,
        *(moved[0], moved[1], moved[2], moved[3]),
        parallax_rad=parallax_rad,
        radial_velocity_m_per_s=velocity * 1000,
        vmag=vmag,
        bv=bv,
        designation=designation,
    )[usable]
    if not len(stars):
        raise CatalogueError(path, "holds no star with a place and a magnitude")
    return stars


def _moved(
    place_rad: Float, pm_rad_per_yr: Float, parallax_rad: Float, velocity_m_per_s: Float, epoch_yr: Float
) -> Float:
    """Return places and proper motions at J2000, (4, n), of stars with an epoch each; 0 where that is NaN."""
    moved = np.zeros((4, len(epoch_yr)))
    for one in np.unique(epoch_yr[~np.isnan(epoch_yr)]):
        of = epoch_yr == one
        place, pm = place_rad[:, of], pm_rad_per_yr[:, of]
        moved[:, of] = space_motion_to_j2000(
            (place[0], place[1]), (pm[0], pm[1]), parallax_rad[of], velocity_m_per_s[of], float(one)
        )
    return moved


def _epochs(table: _Columns, count: int, epoch_yr: float | None) -> Float:
    """Return the epochs of the places, Julian years."""
    if epoch_yr is not None:
        epoch = np.full(count, epoch_yr)
    else:
        epoch = np.nan_to_num(table.unless_missing("epoch_yr"), nan=2000.0)
    if not ((epoch > 1800) & (epoch < 2200)).all():
        raise CatalogueError(table.path, "gives an epoch that is no year from 1800 to 2200; set it with --epoch")
    return epoch


def _check_places(path: Path, ra: Float, dec: Float) -> None:
    """Raise CatalogueError unless right ascensions and declinations, deg, are NaN or in the sky."""
    if (np.abs(dec) > 90).any() or (ra < 0).any() or (ra > 360).any():
        raise CatalogueError(path, "gives a star a place that is not in the sky: places are in degrees")


_HINT: Final = " name them with --column, such as --column ra_deg=RA"


def _magnitudes(table: _Columns) -> tuple[Float, Float]:
    """Return V and B - V of the first kind of magnitudes that the table has."""
    bv = table.unless_missing("bv")
    vmag = table.numbers("vmag")
    if vmag is not None:
        bmag = table.numbers("bmag")
        return vmag, np.where(np.isnan(bv), bmag - vmag, bv) if bmag is not None else bv
    if "vt_mag" in table.chosen:
        bt, vt = table.unless_missing("bt_mag"), table.unless_missing("vt_mag")
        return vmag_from_tycho(bt, vt), np.where(np.isnan(bv), bv_from_tycho(bt, vt), bv)
    if "g_mag" in table.chosen:
        return vmag_from_gaia(table.unless_missing("g_mag"), table.unless_missing("bp_rp")), bv
    raise CatalogueError(
        table.path,
        f"has no column of V magnitudes, nor of Tycho's V_T or Gaia's G, among {_named(table.by_name)};"
        " name one with --column, such as --column vmag=V",
    )


def _numbers(table: _Columns, vmag: Float) -> tuple[NDArray[np.int64], tuple[str, ...]]:
    """Return the stars' numbers and designations."""
    named = tuple(map(str, table.by_name[table.chosen["designation"]])) if "designation" in table.chosen else ()
    text = list(map(str, table.by_name[table.chosen["number"]])) if "number" in table.chosen else []
    try:
        numbers = [int(word) for word in text]
    except ValueError:
        numbers = []
    if numbers and min(numbers) > 0 and max(numbers) <= _LARGEST_NUMBER and len(set(numbers)) == len(numbers):
        return np.array(numbers, dtype=np.int64), named
    rank = np.empty(len(vmag), dtype=np.int64)
    rank[np.argsort(vmag, kind="stable")] = np.arange(1, len(vmag) + 1)
    prefix = "Gaia DR3 " if table.chosen.get("number") == "source_id" else ""
    return rank, named or tuple(prefix + word for word in text)


def _chosen(path: Path, by_name: Mapping[str, Any], columns: Mapping[str, str]) -> dict[str, str]:
    """Return the column of each quantity that the table gives."""
    for quantity, name in columns.items():
        if quantity not in QUANTITIES:
            raise CatalogueError(path, f"cannot have a column of {quantity!r}; glstar reads {', '.join(QUANTITIES)}")
        if name not in by_name:
            raise CatalogueError(path, f"has no column {name!r}; it has {_named(by_name)}")
    lower = {name.lower(): name for name in reversed(list(by_name))}
    found = {}
    for quantity, names in QUANTITIES.items():
        usual = next((lower[name] for name in names if name in lower), None)
        if quantity in columns or usual is not None:
            found[quantity] = columns.get(quantity, str(usual))
    return found


def _named(by_name: Mapping[str, Any]) -> str:
    names = list(by_name)
    return ", ".join(names[:12]) + (f" and {len(names) - 12} more" if len(names) > 12 else "")


def _read(path: Path) -> dict[str, Any]:
    """Return the columns of a table."""
    try:
        content = path.read_bytes()
    except FileNotFoundError as error:
        raise CatalogueError(path, "does not exist") from error
    except OSError as error:
        raise CatalogueError(path, f"cannot be read: {error.strerror}") from error
    try:
        if content[:2] == b"\x1f\x8b":
            content = gzip.decompress(content)
        if content[:4] == b"PAR1":
            raise CatalogueError(path, "is an Apache Parquet table; write it as CSV or FITS")
        if content[:6] == b"SIMPLE":
            return _fits(path, content)
        rows = csv.reader(line for line in io.StringIO(content.decode("utf-8-sig")) if not line.startswith("#"))
        header = [name.strip() for name in next(rows, [])]
        columns = list(zip(*(row for row in rows if row), strict=True))
        return dict(zip(header, columns, strict=True))
    except (OSError, EOFError, ValueError, KeyError, IndexError, csv.Error, TypeError) as error:
        reason = " ".join(str(error).split()) or type(error).__name__
        raise CatalogueError(path, f"is no CSV or FITS table that glstar can read ({reason})") from error


def _fits(path: Path, content: bytes) -> dict[str, Any]:
    try:
        from astropy.io import fits  # noqa: PLC0415 - an extra
    except ImportError as error:
        raise CatalogueError(path, f"reading FITS needs astropy: {install_command('catalogue')}") from error
    with warnings.catch_warnings(action="ignore"), fits.open(io.BytesIO(content)) as units:
        data = next(unit for unit in units[1:] if unit.is_image is False).data
        columns = {name: np.array(data[name]) for name in data.names}
    return {name: c.astype(c.dtype.newbyteorder("=")) if c.dtype.kind in "fiu" else c for name, c in columns.items()}
