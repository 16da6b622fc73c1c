"""Brightness and magnitudes, colours of stars, and their magnitudes in a camera's band.

Colours are B - V of the catalogue, or of Hipparcos for the bundled catalogue, which has none.  `StarBrightness` holds
magnitudes that `glstar camera calibrate` measured, instead of the catalogue's V.
"""

import csv
import hashlib
from dataclasses import dataclass, replace
from functools import cache
from os import PathLike
from pathlib import Path
from typing import Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from glstar.arrays import Float
from glstar.errors import CalibrationError, reading
from glstar.sky.catalogue.starfield import StarField
from glstar.system.resources import asset
from glstar.system.userinput import read_bytes, refuse_repeated

# Mean B - V of the stars of the Bright Star Catalogue; assumed for stars without a measurement.
USUAL_BV = 0.65
# Colours B - V beyond which what depends on them, such as the polynomials of a band, is constant.
VALID_BV = (-0.3, 1.7)

_ALL = slice(None)

# The required columns; `catalogue` is optional.  Tables of glstar 0.2 and earlier have ``hr`` instead of ``star_id``.
COLUMNS = ("star_id", "vmag", "camera_mag")
# Size limit of a table, bytes: a table of all stars of Hipparcos has 4 MB.
_LARGEST_BYTES = 64 * 2**20
# A star of the table and a star of the catalogue with the same number are the same if their V differ by less, mag.
_SAME_MAG = 0.1
# The table belongs to another catalogue if more than this fraction of its stars are not the same.
_MAX_MISMATCHES = 0.1


def brightness_ratio(magnitude_difference: ArrayLike) -> NDArray[np.float64]:
    """Return the brightness ratios, B_x / B_r (...), of stars and their reference.

    `magnitude_difference` (...): m_x - m_r, positive for a star fainter than the reference.  Teague & Chahl, eq. (37).
    Departs from eq. (37), which is printed without the minus sign: a star one magnitude fainter is 0.398 times as
    bright, not 2.51 times.

    Examples
    --------
    >>> float(brightness_ratio(-5.0))
    100.0
    """
    return np.power(10.0, -0.4 * np.asarray(magnitude_difference, dtype=np.float64))


def magnitude_difference(brightness_ratio: ArrayLike) -> NDArray[np.float64]:
    """Return the magnitude differences, m_x - m_r (...), of stars and their reference, positive for a fainter star.

    `brightness_ratio` (...): B_x / B_r, above 0.  Teague & Chahl, eq. (36).
    """
    return -2.5 * np.log10(np.asarray(brightness_ratio, dtype=np.float64))


def star_colours(stars: StarField, some: slice | NDArray[np.integer] = _ALL) -> Float:
    """Return the colours B - V of some stars, (n,); NaN where neither the catalogue nor Hipparcos has a colour."""
    star_id = stars.star_id[some]
    bv = np.full(len(star_id), np.nan) if stars.bv is None else stars.bv[some].astype(np.float64)
    missing = np.isnan(bv)
    if stars.catalogue == "bsc5" and missing.any():
        numbers, colours = _bundled()
        at = np.searchsorted(numbers, star_id).clip(max=len(numbers) - 1)
        bv = np.where(missing & (numbers[at] == star_id), colours[at], bv)
    return bv


@cache
def _bundled() -> tuple[NDArray[np.int32], Float]:
    """Return numbers (Harvard Revised), increasing, and B - V of Hipparcos for the bundled stars."""
    with np.load(asset("bsc5-colours.npz")) as colours:
        return colours["hr"].astype(np.int32), colours["bv_mmag"] / 1000


@dataclass(frozen=True, slots=True, eq=False)
class StarBrightness:
    """Magnitudes of stars in the band of one camera; equal if the files are equal.

    A camera that is more sensitive to red than V measures smaller magnitudes for red stars, and it does not resolve
    close pairs.
    """

    path: Path
    sha256: str  # SHA-256 of the file
    catalogue: str  # catalogue used for the calibration; empty if the table does not name it
    star_id: NDArray[np.int32]  # (n,) numbers in that catalogue
    vmag: Float  # (n,) V magnitudes in that catalogue
    camera_mag: Float  # (n,) magnitudes in the band of the camera, with the zero point of ``[sensor]``

    def __post_init__(self) -> None:
        for array in (self.star_id, self.vmag, self.camera_mag):
            array.flags.writeable = False

    def __len__(self) -> int:
        return int(self.star_id.size)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, StarBrightness) and self.sha256 == other.sha256

    def __hash__(self) -> int:
        return hash(self.sha256)

    @classmethod
    def open(cls, path: str | PathLike[str]) -> Self:
        """Read a table from a file.

        `path`: CSV as written by ``glstar camera calibrate``, with the columns ``catalogue``, ``star_id`` (``hr`` in
        older tables), ``vmag`` and ``camera_mag``.  Raises CalibrationError if the file cannot be read, lacks a column,
        contains a value that is not a number, or a star twice.
        """
        path = Path(path)
        with reading(path, CalibrationError, "is no table of star brightness"):
            return cls._read(path)

    @classmethod
    def _read(cls, path: Path) -> Self:
        content = read_bytes(path, _LARGEST_BYTES)
        try:
            text = content.decode("utf-8-sig")
        except UnicodeDecodeError as error:
            raise ValueError(f"is no table of star brightness: {error}") from error
        table = csv.DictReader(text.splitlines())
        refuse_repeated(table.fieldnames or ())
        rows = list(table)
        for row in rows:
            if "hr" in row:
                row.setdefault("star_id", row.pop("hr"))
        missing = [name for name in COLUMNS if not rows or name not in rows[0]]
        if missing:
            message = f"is no table of star brightness: it has no stars, or no column {', '.join(missing)}"
            raise CalibrationError(message, path=path)
        numbers = []
        for line, row in enumerate(rows, start=2):
            try:
                numbers.append((int(row["star_id"]), float(row["vmag"]), float(row["camera_mag"])))
            except (TypeError, ValueError) as error:
                message = f"is no table of star brightness: line {line} has a value that is not a number"
                raise CalibrationError(message, path=path) from error
        try:
            star_id = np.array([number for number, _, _ in numbers], dtype=np.int32)
        except OverflowError as error:
            raise CalibrationError(f"is no table of star brightness: {error}", path=path) from error
        vmag, camera_mag = np.array([magnitudes for _, *magnitudes in numbers]).T
        if not np.isfinite([vmag, camera_mag]).all() or len(np.unique(star_id)) < len(star_id):
            raise CalibrationError("is no table of star brightness: a star twice, or no number", path=path)
        catalogues = {row.get("catalogue", "") for row in rows}
        if len(catalogues) > 1:
            raise CalibrationError("is no table of star brightness: its stars are of several catalogues", path=path)
        sha256 = hashlib.sha256(content).hexdigest()
        return cls(path, sha256, catalogues.pop() or "", star_id, vmag.copy(), camera_mag.copy())

    def magnitudes(self, catalogue: str, star_id: NDArray[np.int32], vmag: Float) -> Float:
        """Return the magnitudes of the table, (m,); those of the catalogue for stars that are not in the table.

        `catalogue`: as in `StarCatalogue`; `star_id`, `vmag` (m,): the stars' numbers and V magnitudes there.  Raises
        CalibrationError if the table belongs to another catalogue.
        """
        if self.catalogue and catalogue and self.catalogue != catalogue:
            raise CalibrationError(
                f"is of the catalogue {self.catalogue}, and the simulation uses {catalogue}; set sky.catalogue to"
                f" {self.catalogue}, which the camera was calibrated with",
                path=self.path,
            )
        magnitudes = np.array(vmag, dtype=np.float64)
        known, row = self._rows_of(star_id, vmag)
        magnitudes[known] = self.camera_mag[row]
        return magnitudes

    def applied(self, stars: StarField) -> StarField:
        """Return stars with the magnitudes of the table; raises CalibrationError if it is of another catalogue."""
        magnitudes = self.magnitudes(stars.catalogue, stars.star_id, stars.vmag)
        is_measured = np.zeros(len(stars), dtype=np.bool_)
        is_measured[self._rows_of(stars.star_id, stars.vmag)[0]] = True
        return replace(stars, measured_mag=magnitudes, is_measured=is_measured)

    def _rows_of(self, star_id: NDArray[np.int32], vmag: Float) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
        """Return the indices of the stars that are in the table, and their rows."""
        row_of = {int(number): row for row, number in enumerate(self.star_id)}
        known = np.array([k for k, number in enumerate(star_id) if int(number) in row_of], dtype=np.intp)
        row = np.array([row_of[int(number)] for number in star_id[known]], dtype=np.intp)
        differs = np.abs(self.vmag[row] - vmag[known]) > _SAME_MAG
        if known.size and differs.mean() > _MAX_MISMATCHES:
            raise CalibrationError(
                f"is of another catalogue: {int(differs.sum())} of its {known.size} stars have other magnitudes"
                " there; set sky.catalogue to the one that the camera was calibrated with",
                path=self.path,
            )
        return known[~differs], row[~differs]
