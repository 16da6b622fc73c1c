"""The display stretch: from digital numbers to brightness on the screen and in saved views."""

from dataclasses import dataclass
from enum import StrEnum
from typing import Final

import numpy as np
from numpy.typing import NDArray

from glstar.camera.sensor import Sensor

__all__ = ["Stretch", "StretchKind"]

# Of the asinh stretch: the gain of faint signals is 8 / asinh(8) = 2.9 times that of a linear stretch.
_SOFTENING: Final = 8.0
# Limits of the keys that double and halve the boost.
_MIN_BOOST: Final = 1 / 8
_MAX_BOOST: Final = 1024.0

# The initial boost, and the peak, as a fraction of white, that a star of V 3 has in the bundled camera at rest after
# 0.5 s.  A camera with fainter stars gets more boost, so that its stars look as bright.
_BOOST: Final = 5.0
_STAR_PEAK: Final = 150 / 255


class StretchKind(StrEnum):
    """The curve of a display stretch."""

    LINEAR = "linear"
    ASINH = "asinh"


@dataclass(frozen=True, slots=True)
class Stretch:
    """A display stretch; it changes the screen, never the data.

    Attributes
    ----------
    kind : StretchKind
        Linear, or asinh, which brightens faint signals without clipping bright ones.
    boost : float
        Gain, as of a longer exposure; the paper shows its figures with 4.
    black : float
        The level shown black, as a fraction of white.
    """

    kind: StretchKind = StretchKind.ASINH
    boost: float = 1.0
    black: float = 0.0

    @classmethod
    def for_sensor(cls, sensor: Sensor) -> "Stretch":
        """Return the initial stretch: the sky is black, and stars are as bright as those of the bundled camera.

        A sensor whose digital numbers fill a small part of its range would be black otherwise.

        Parameters
        ----------
        sensor : Sensor

        Returns
        -------
        Stretch
        """
        peak = float(sensor.peak_dn([3.0], 0.5)[0]) / sensor.saturation_dn
        boost = _BOOST * max(1.0, _STAR_PEAK / peak) if peak > 0 else _BOOST
        return cls(boost=boost, black=sensor.background_mean_dn(0.5) / sensor.saturation_dn)

    @property
    def softening(self) -> float:
        """The scale of the asinh stretch; 0 for a linear one."""
        return _SOFTENING if self.kind is StretchKind.ASINH else 0.0

    def __call__(self, signal: NDArray[np.float32]) -> NDArray[np.float32]:
        """Return brightness, as ``display.frag`` computes it.

        Parameters
        ----------
        signal : (...) float32
            As a fraction of white.

        Returns
        -------
        (...) float32
            0 to 1.
        """
        linear: NDArray[np.float32] = np.clip((signal - np.float32(self.black)) * np.float32(self.boost), 0, 1)
        if not self.softening:
            return linear
        return np.asarray(np.arcsinh(self.softening * linear) / np.arcsinh(self.softening), dtype=np.float32)

    def brighter(self, factor: float) -> "Stretch":
        """Return a stretch with the boost multiplied by a factor, limited to 1/8 and 1024.

        Parameters
        ----------
        factor : float

        Returns
        -------
        Stretch
        """
        return Stretch(self.kind, min(max(self.boost * factor, _MIN_BOOST), _MAX_BOOST), self.black)

    def for_white(self, before_dn: int, now_dn: int) -> "Stretch":
        """Return the stretch that shows digital numbers as bright as before after the white level has changed.

        Parameters
        ----------
        before_dn, now_dn : int
            The largest digital number of the sensor, before and after the change.

        Returns
        -------
        Stretch
        """
        if before_dn == now_dn:
            return self
        ratio = now_dn / before_dn
        return Stretch(self.kind, self.boost * ratio, self.black / ratio)

    def other_kind(self) -> "Stretch":
        """Return the linear stretch of an asinh one, and the asinh stretch of a linear one."""
        kind = StretchKind.LINEAR if self.kind is StretchKind.ASINH else StretchKind.ASINH
        return Stretch(kind, self.boost, self.black)
