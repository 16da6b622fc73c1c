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

# What a table must have; what else stands in it is for people.
COLUMNS: Final = ("hr", "vmag", "camera_mag")
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
    hr : (n,) int32
        Numbers in the catalogue that the camera was calibrated with.
    vmag : (n,) float64
        Their magnitudes there.
    camera_mag : (n,) float64
        The magnitudes with which the sensor's one reference gives their brightness.
    """

    path: Path
    sha256: str
    hr: NDArray[np.int32]
    vmag: Float
    camera_mag: Float

    def __post_init__(self) -> None:
        for array in (self.hr, self.vmag, self.camera_mag):
            array.flags.writeable = False

    def __len__(self) -> int:
        return int(self.hr.size)

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
            CSV with a header; the columns ``hr``, ``vmag`` and ``camera_mag`` count, as ``glstar calibrate`` writes
            them.

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
        missing = [name for name in COLUMNS if not rows or name not in rows[0]]
        if missing:
            words = f"is no table of star brightness: it has no stars, or no column {', '.join(missing)}"
            raise CalibrationError(words, path=path)
        numbers = []
        for line, row in enumerate(rows, start=2):
            try:
                numbers.append((int(row["hr"]), float(row["vmag"]), float(row["camera_mag"])))
            except (TypeError, ValueError) as error:
                words = f"is no table of star brightness: line {line} holds what is no number"
                raise CalibrationError(words, path=path) from error
        try:
            hr = np.array([number for number, _, _ in numbers], dtype=np.int32)
        except OverflowError as error:
            raise CalibrationError(f"is no table of star brightness: {error}", path=path) from error
        vmag, camera_mag = np.array([magnitudes for _, *magnitudes in numbers]).T
        if not np.isfinite([vmag, camera_mag]).all() or len(np.unique(hr)) < len(hr):
            raise CalibrationError("is no table of star brightness: a star twice, or no number", path=path)
        return cls(path, hashlib.sha256(content).hexdigest(), hr, vmag.copy(), camera_mag.copy())

    def magnitudes(self, hr: NDArray[np.int32], vmag: Float) -> Float:
        """Return the magnitudes with which stars of a catalogue are drawn.

        Parameters
        ----------
        hr : (m,) int32
            Their numbers.
        vmag : (m,) float64
            Their magnitudes in the catalogue.

        Returns
        -------
        (m,) float64
            The table's where it knows the star, else the catalogue's.

        Raises
        ------
        CalibrationError
            If the table's stars are others than the catalogue's: HR is not HIP.
        """
        place = {int(number): k for k, number in enumerate(self.hr)}
        known = np.array([k for k, number in enumerate(hr) if int(number) in place], dtype=np.intp)
        row = np.array([place[int(number)] for number in hr[known]], dtype=np.intp)
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
