"""Contrast: how light becomes brightness on the screen and in saved views."""

from dataclasses import dataclass
from enum import StrEnum
from typing import Final

import numpy as np
from numpy.typing import NDArray

__all__ = ["Stretch", "StretchKind"]

_SOFTENING: Final = 8.0
_LEAST_BOOST, _MOST_BOOST = 1 / 8, 1024.0


class StretchKind(StrEnum):
    """How light becomes brightness on the screen."""

    LINEAR = "linear"
    ASINH = "asinh"


@dataclass(frozen=True, slots=True)
class Stretch:
    """Contrast on the screen; the data stay what they are.

    Attributes
    ----------
    kind : StretchKind
        Linear, or asinh: faint light lifted, bright light kept apart.
    boost : float
        How many times as bright, as a longer exposure would be: the paper shows its figures with 4.
    black : float
        What is shown black, as a share of white.
    """

    kind: StretchKind = StretchKind.ASINH
    boost: float = 1.0
    black: float = 0.0

    @property
    def softening(self) -> float:
        """The asinh's; 0 for a linear stretch."""
        return _SOFTENING if self.kind is StretchKind.ASINH else 0.0

    def __call__(self, share: NDArray[np.float32]) -> NDArray[np.float32]:
        """Return brightness, as ``display.frag`` computes it.

        Parameters
        ----------
        share : (...) float32
            Light as a share of white.

        Returns
        -------
        (...) float32
            0 to 1.
        """
        light: NDArray[np.float32] = np.clip((share - np.float32(self.black)) * np.float32(self.boost), 0, 1)
        if not self.softening:
            return light
        return np.asarray(np.arcsinh(self.softening * light) / np.arcsinh(self.softening), dtype=np.float32)

    def brighter(self, factor: float) -> "Stretch":
        """Return a stretch that shows so many times as bright, within 1/8 and 1024.

        Parameters
        ----------
        factor : float

        Returns
        -------
        Stretch
        """
        return Stretch(self.kind, min(max(self.boost * factor, _LEAST_BOOST), _MOST_BOOST), self.black)

    def for_white(self, before_dn: int, now_dn: int) -> "Stretch":
        """Return the stretch that shows the same digital numbers as before where another number is white.

        Parameters
        ----------
        before_dn, now_dn : int
            The largest digital number of the sensor.

        Returns
        -------
        Stretch
        """
        if before_dn == now_dn:
            return self
        ratio = now_dn / before_dn
        return Stretch(self.kind, self.boost * ratio, self.black / ratio)

    def other_kind(self) -> "Stretch":
        """Return the linear stretch for an asinh one, and the other way round."""
        kind = StretchKind.LINEAR if self.kind is StretchKind.ASINH else StretchKind.ASINH
        return Stretch(kind, self.boost, self.black)
