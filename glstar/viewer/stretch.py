"""The display stretch: from digital numbers to brightness on the screen and in saved views."""

from dataclasses import dataclass, replace
from enum import StrEnum
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from glstar.camera.sensor import Sensor
from glstar.statistics import robust_std
from glstar.viewer.colourmap import ColourMap

__all__ = ["Stretch", "StretchKind"]

# Of the asinh stretch: the gain of faint signals is 8 / asinh(8) = 2.9 times that of a linear stretch.
_SOFTENING: Final = 8.0
# Limits of the keys that double and halve the boost.
_MIN_BOOST: Final = 1 / 8
_MAX_BOOST: Final = 1024.0

# Of the stretch that fits an image: number of rows used, the percentile shown white, the least range in standard
# deviations of the sky, and the least distance of white from black as a fraction of the largest digital number.
_SAMPLED_ROWS: Final = 500
_BRIGHT_PERCENTILE: Final = 99.95
_LEAST_RANGE: Final = 20.0
_LEAST_LEVELS: Final = 1e-6

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
    colours : ColourMap
        The colours of the brightness.
    """

    kind: StretchKind = StretchKind.ASINH
    boost: float = 1.0
    black: float = 0.0
    colours: ColourMap = ColourMap.GREY

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

    def fitted(self, pixels: NDArray[Any], white_dn: int) -> "Stretch":
        """Return a stretch whose limits fit an image: the sky is dark, and faint stars can be seen.

        Parameters
        ----------
        pixels : (height, width) uint8 or uint16
            Digital numbers.
        white_dn : int
            The largest possible digital number.

        Returns
        -------
        Stretch
            Black is one standard deviation below the median, white at the brightest 0.05 % of the pixels, and at least
            twenty standard deviations higher than black.
        """
        sample = pixels[:: max(1, pixels.shape[0] // _SAMPLED_ROWS)].ravel()
        sky_dn = float(np.median(sample))
        deviation_dn = max(robust_std(sample, sky_dn), 0.5)
        black_dn = max(sky_dn - deviation_dn, 0.0)
        bright_dn = float(np.percentile(sample, _BRIGHT_PERCENTILE))
        return self.between(black_dn / white_dn, max(bright_dn, black_dn + _LEAST_RANGE * deviation_dn) / white_dn)

    @property
    def white(self) -> float:
        """The level shown white, as a fraction of the largest digital number; it may lie above 1."""
        return self.black + 1 / self.boost

    def between(self, black: float, white: float) -> "Stretch":
        """Return the stretch with other limits.

        Parameters
        ----------
        black, white : float
            The levels shown black and white, as fractions of the largest digital number.

        Returns
        -------
        Stretch
        """
        return replace(self, black=black, boost=1 / max(white - black, _LEAST_LEVELS))

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
        return replace(self, boost=min(max(self.boost * factor, _MIN_BOOST), _MAX_BOOST))

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
        return replace(self, boost=self.boost * ratio, black=self.black / ratio)

    def other_kind(self) -> "Stretch":
        """Return the linear stretch of an asinh one, and the asinh stretch of a linear one."""
        kind = StretchKind.LINEAR if self.kind is StretchKind.ASINH else StretchKind.ASINH
        return replace(self, kind=kind)
