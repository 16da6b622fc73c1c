"""Run lengths of a trail mask, as COCO counts them: down the columns."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from glstar.errors import ExportError
from glstar.export.images import decode
from glstar.export.masks import MASK_SUFFIXES

__all__ = ["MaskRuns"]

_SUFFIX: Final = MASK_SUFFIXES["trails"]


@dataclass(frozen=True, slots=True, eq=False)
class MaskRuns:
    """The pixels of each star in the trail mask of a frame.

    Attributes
    ----------
    shape : (int, int)
        Rows and columns.
    pixels : (n,) int64
        Pixels of all stars, counted down the columns, sorted by star and then by position.
    firsts : (k,) int64
        Where the pixels of each value of the mask begin, from 0, followed by n.
    """

    shape: tuple[int, int]
    pixels: NDArray[np.int64]
    firsts: NDArray[np.int64]

    @classmethod
    def of(cls, mask: NDArray[Any]) -> "MaskRuns":
        """Return the runs of a mask.

        Parameters
        ----------
        mask : (rows, columns) uint16
            As ``glstar export --masks`` writes it.

        Returns
        -------
        MaskRuns
        """
        down = mask.ravel(order="F")
        lit = np.flatnonzero(down)
        pixels = lit[np.argsort(down[lit], kind="stable")]
        firsts = np.searchsorted(down[pixels], np.arange(int(mask.max(initial=0)) + 2))
        return cls((mask.shape[0], mask.shape[1]), pixels, firsts)

    @classmethod
    def beside(cls, image: Path) -> "MaskRuns | None":
        """Return the runs of the mask beside an image; None without one.

        Parameters
        ----------
        image : Path

        Returns
        -------
        MaskRuns or None

        Raises
        ------
        ExportError
            If it cannot be read.
        """
        path = image.with_name(f"{image.name.split('.')[0]}{_SUFFIX}")
        if not path.is_file():
            return None
        try:
            return cls.of(decode(path.read_bytes(), path.suffix))
        except (OSError, ValueError) as error:
            raise ExportError(path, f"cannot be read ({error}); run glstar export again") from error

    def _of(self, index: int) -> NDArray[np.int64]:
        """Return the pixels of a star, by its place in the truth from 0."""
        value = index + 1
        return (
            self.pixels[self.firsts[value] : self.firsts[value + 1]]
            if value + 1 < len(self.firsts)
            else self.pixels[:0]
        )

    def annotation(self, index: int) -> dict[str, Any]:
        """Return ``segmentation``, ``bbox`` and ``area`` of a star; empty if no pixel shows it.

        Parameters
        ----------
        index : int
            Its place in the list of stars, followed by that of bodies, from 0.

        Returns
        -------
        dict
        """
        pixels = self._of(index)
        if not pixels.size:
            return {}
        starts = np.flatnonzero(np.diff(pixels, prepend=-2) != 1)
        begin, end = pixels[starts], pixels[np.append(starts[1:], len(pixels)) - 1] + 1
        # Alternating numbers of other pixels and of the star's, from the first pixel to the last.
        bounds = np.column_stack([begin, end]).ravel()
        counts = np.diff(np.concatenate([[0], bounds, [self.shape[0] * self.shape[1]]]))
        column, row = np.divmod(pixels, self.shape[0])
        left, top = int(column.min()), int(row.min())
        return {
            "segmentation": {"counts": counts.tolist(), "size": list(self.shape)},
            "bbox": [left, top, int(column.max()) + 1 - left, int(row.max()) + 1 - top],
            "area": len(pixels),
        }
