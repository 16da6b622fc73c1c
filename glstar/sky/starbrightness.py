"""How bright a camera sees each star: the catalogue's V magnitude is not its own."""

import csv
import hashlib
from dataclasses import dataclass
from os import PathLike
from pathlib import Path
from typing import Final, Self

import numpy as np
from numpy.typing import NDArray

from glstar.errors import CalibrationError
from glstar.system.inputfile import read_bytes

__all__ = ["COLUMNS", "StarBrightness"]

Float = NDArray[np.float64]

# The required columns.  `catalogue` is read where it is there; tables of glstar 0.2 and before name `star_id` ``hr``.
COLUMNS: Final = ("star_id", "vmag", "camera_mag")
# A table of every star of Hipparcos takes 4 MB; larger than this is another file.
_LARGEST_BYTES: Final = 64 * 2**20
# More than this apart, magnitudes, a star of the table and one of the catalogue are not the same star ...
_SAME_MAG: Final = 0.1
# ... and where more than this share is not, the table is of another catalogue.
_STRANGERS: Final = 0.1


@dataclass(frozen=True, slots=True, eq=False)
class StarBrightness:
    """Magnitudes of stars as one camera sees them; two tables are equal whose files are.

    A sensor that sees more red than the eye sees red stars brighter than V says; a close pair is one star to it.

    Attributes
    ----------
    path : Path
    sha256 : str
        Of the file.
    catalogue : str
        The catalogue that the camera was calibrated with; empty where the table does not say.
    star_id : (n,) int32
        The stars' numbers in that catalogue.
    vmag : (n,) float64
        Their magnitudes there.
    camera_mag : (n,) float64
        The magnitudes with which the sensor's one reference gives their brightness.
    """

    path: Path
    sha256: str
    catalogue: str
    star_id: NDArray[np.int32]
    vmag: Float
    camera_mag: Float

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
        """Return the table of a file.

        Parameters
        ----------
        path : path-like
            CSV with a header; the columns ``catalogue``, ``star_id``, ``vmag`` and ``camera_mag`` are read, as
            ``glstar calibrate`` writes them; ``hr`` of older tables is read as ``star_id``.

        Returns
        -------
        StarBrightness

        Raises
        ------
        CalibrationError
            If it cannot be read, lacks a column, holds what is no number, or a star twice.
        """
        path = Path(path)
        try:
            content = read_bytes(path, _LARGEST_BYTES)
        except ValueError as error:
            raise CalibrationError(str(error), path=path) from error
        try:
            rows = list(csv.DictReader(content.decode("utf-8-sig").splitlines()))
        except (UnicodeDecodeError, csv.Error) as error:
            raise CalibrationError(f"is no table of star brightness: {error}", path=path) from error
        for row in rows:
            if "hr" in row:
                row.setdefault("star_id", row.pop("hr"))
        missing = [name for name in COLUMNS if not rows or name not in rows[0]]
        if missing:
            words = f"is no table of star brightness: it has no stars, or no column {', '.join(missing)}"
            raise CalibrationError(words, path=path)
        numbers = []
        for line, row in enumerate(rows, start=2):
            try:
                numbers.append((int(row["star_id"]), float(row["vmag"]), float(row["camera_mag"])))
            except (TypeError, ValueError) as error:
                words = f"is no table of star brightness: line {line} holds what is no number"
                raise CalibrationError(words, path=path) from error
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
        return cls(
            path, hashlib.sha256(content).hexdigest(), catalogues.pop() or "", star_id, vmag.copy(), camera_mag.copy()
        )

    def magnitudes(self, catalogue: str, star_id: NDArray[np.int32], vmag: Float) -> Float:
        """Return the magnitudes with which stars of a catalogue are drawn.

        Parameters
        ----------
        catalogue : str
            The catalogue, as in `glstar.sky.catalogue.StarCatalogue`.
        star_id : (m,) int32
            The stars' numbers there.
        vmag : (m,) float64
            Their magnitudes in the catalogue.

        Returns
        -------
        (m,) float64
            The table's where it knows the star, else the catalogue's.

        Raises
        ------
        CalibrationError
            If the table is of another catalogue.
        """
        if self.catalogue and catalogue and self.catalogue != catalogue:
            raise CalibrationError(
                f"is of the catalogue {self.catalogue}, and the simulation uses {catalogue}; set sky.catalogue to"
                f" {self.catalogue}, which the camera was calibrated with",
                path=self.path,
            )
        row_of = {int(number): k for k, number in enumerate(self.star_id)}
        known = np.array([k for k, number in enumerate(star_id) if int(number) in row_of], dtype=np.intp)
        row = np.array([row_of[int(number)] for number in star_id[known]], dtype=np.intp)
        strangers = np.abs(self.vmag[row] - vmag[known]) > _SAME_MAG
        if known.size and strangers.mean() > _STRANGERS:
            raise CalibrationError(
                f"is of another catalogue: {int(strangers.sum())} of its {known.size} stars have other magnitudes"
                " there; set sky.catalogue to the one that the camera was calibrated with",
                path=self.path,
            )
        magnitudes = np.array(vmag, dtype=np.float64)
        magnitudes[known[~strangers]] = self.camera_mag[row[~strangers]]
        return magnitudes
