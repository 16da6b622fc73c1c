"""What records of a flight have in common: their times."""

from dataclasses import dataclass, replace
from typing import Self

import numpy as np
from numpy.typing import NDArray

__all__ = ["TimedRecord"]


@dataclass(frozen=True, slots=True, eq=False)
class TimedRecord:
    """Something that a log states at several times.

    Attributes
    ----------
    utc_s : (n,) float64
        UTC seconds since 1970.
    """

    utc_s: NDArray[np.float64]

    def shifted(self, shift_s: float) -> Self:
        """Return the record with all times shifted.

        Parameters
        ----------
        shift_s : float
            Added to all times, s.

        Returns
        -------
        TimedRecord
            Of the same class.
        """
        return replace(self, utc_s=self.utc_s + shift_s)
