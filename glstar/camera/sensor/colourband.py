"""The colour response of a camera: magnitudes in its band from V and B - V, and the mosaic of its colour filters."""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache
from types import MappingProxyType
from typing import Any, Literal, get_args

import numpy as np
from numpy.typing import ArrayLike

from glstar.arrays import Float
from glstar.errors import ConfigError
from glstar.sky.photometry import VALID_BV

BandName = Literal["v", "imx477", "imx219", "ov5647", "bare", "custom"]
Mosaic = Literal["none", "rggb", "bggr", "grbg", "gbrg"]
Channel = Literal["r", "g", "b"]

BAND_CHOICES: tuple[str, ...] = get_args(BandName)
MOSAIC_CHOICES: tuple[str, ...] = get_args(Mosaic)


@dataclass(frozen=True, slots=True)
class _Response:
    """Magnitude in one band minus V: slope c + curvature c^2, with c = B - V; and photons of an A0 star of V 0."""

    slope: float
    curvature: float
    # Photons/s/cm^2 counted with a response whose peak is 1, over those of the mean of an RGGB cell.
    photons: float = 1.0
    wavelength_nm: float = 550.0  # Mean wavelength of the light of a star of B - V 0.65 that is counted


# Synthetic photometry of 108 spectra (Pickles 1998, PASP 110, 863) from 400 to 700 nm, with the colour filters of the
# Raspberry Pi HQ camera and its infra-red filter Hoya CM500, fitted for 23 types from B0 to M2, dwarfs and giants; zero
# at A0 V.  Residuals, rms (largest): mean 0.007 (0.02), R 0.033 (0.10, K dwarfs), G 0.008 (0.02), B 0.026 (0.08) mag.
_IMX477: Mapping[str, _Response] = MappingProxyType(
    {
        "mean": _Response(0.292, -0.056, 1.0, 522.0),
        "r": _Response(-0.183, -0.014, 2.5 / 8.0, 584.0),
        "g": _Response(0.141, -0.016, 9.7 / 8.0, 532.0),
        "b": _Response(0.741, -0.061, 9.9 / 8.0, 470.0),
    }
)
# The same integrals for 51 spectra from B1 to M2, dwarfs and giants, with the colour filters of the Raspberry Pi Camera
# Modules 2 and 1 (data sheets, digitised by K. Hufkens), against the spectra's own B - V (Bessell 1990).  Their
# infra-red filter is taken as a cut at 700 nm.  Residuals, rms (largest): IMX219 mean 0.009 (0.03), R 0.027 (0.08),
# G 0.004 (0.01), B 0.009 (0.03); OV5647 0.011 (0.04), 0.028 (0.08), 0.006 (0.02), 0.009 (0.03) mag.
_IMX219: Mapping[str, _Response] = MappingProxyType(
    {
        "mean": _Response(0.142, -0.086, 1.0, 554.0),
        "r": _Response(-0.359, -0.035, 0.727, 618.0),
        "g": _Response(0.075, -0.032, 1.126, 549.0),
        "b": _Response(0.673, -0.077, 1.022, 488.0),
    }
)
_OV5647: Mapping[str, _Response] = MappingProxyType(
    {
        "mean": _Response(0.186, -0.103, 1.0, 552.0),
        "r": _Response(-0.340, -0.052, 0.703, 620.0),
        "g": _Response(0.037, -0.039, 0.969, 555.0),
        "b": _Response(0.685, -0.050, 1.359, 482.0),
    }
)
# A sensor without infra-red filter: measured by PiFinder on an IMX462, m = V - 0.8 (B - V).  Its wavelength is assumed.
_BARE: Mapping[str, _Response] = MappingProxyType({"mean": _Response(-0.8, 0.0, 1.0, 650.0)})
_V: Mapping[str, _Response] = MappingProxyType({"mean": _Response(0.0, 0.0)})
_OF_BAND = MappingProxyType({"v": _V, "imx477": _IMX477, "imx219": _IMX219, "ov5647": _OV5647, "bare": _BARE})
# Bands whose red, green and blue are known: a mosaic needs one of them.
BANDS_WITH_COLOURS = tuple(band for band, responses in _OF_BAND.items() if "r" in responses)


@dataclass(frozen=True, slots=True)
class ColourBand:
    """How a camera sees the colours of stars; raises ConfigError if a value is not valid; `key` names it."""

    # {"v", "imx477", "imx219", "ov5647", "bare", "custom"}: band of the magnitudes: V, the Raspberry Pi HQ camera,
    # Camera Module 2 or 1 with their filters, a sensor without infra-red filter, or the two coefficients below.
    band: BandName = "v"
    band_slope: float = 0.0  # With "custom": magnitude in the band minus V is slope c + curvature c^2, c = B - V
    band_curvature: float = 0.0
    # {"none", "rggb", "bggr", "grbg", "gbrg"}: colour filters of the pixels: of the top row from the left, then of the
    # second.
    mosaic: Mosaic = "none"
    sky_bv: float = 0.9  # B - V of the sky background, for the mosaic

    def __post_init__(self) -> None:
        if self.band not in BAND_CHOICES:
            raise ConfigError(f"must be one of {', '.join(BAND_CHOICES)}, not {self.band!r}", key="sensor.band")
        if self.mosaic not in MOSAIC_CHOICES:
            raise ConfigError(f"must be one of {', '.join(MOSAIC_CHOICES)}, not {self.mosaic!r}", key="sensor.mosaic")
        if self.mosaic != "none" and self.band not in BANDS_WITH_COLOURS:
            choices = " or ".join(f'"{band}"' for band in BANDS_WITH_COLOURS)
            raise ConfigError(
                f'needs the response of each colour, and [sensor] band = "{self.band}" has one of all light; take'
                f" band = {choices}",
                key="sensor.mosaic",
            )
        if self.band != "custom" and (self.band_slope or self.band_curvature):
            raise ConfigError('belongs to band = "custom"', key="sensor.band_slope")

    @classmethod
    def of(cls, effects: Mapping[str, object]) -> "ColourBand":
        """Return the colour response of the keys of a sensor, given `Sensor.effects`; others have their defaults."""
        return _of_values(tuple(effects.get(f"sensor.{key}") for key in cls.__slots__))

    @property
    def is_v(self) -> bool:
        """Whether stars have their V magnitudes."""
        return self.band == "v"

    def magnitude_minus_v(self, bv: ArrayLike, channel: Channel | None = None) -> Float:
        """Return the magnitude of stars in the camera's band minus V, (...), 0 for B - V = 0.

        `bv` (...) is used from -0.3 to 1.7; `channel` is one of the mosaic, None for the mean of its cells, or a
        monochrome sensor.
        """
        response = self._responses["mean" if channel is None else channel]
        c = np.clip(np.asarray(bv, dtype=np.float64), *VALID_BV)
        return np.asarray(response.slope * c + response.curvature * c * c)

    def wavelength_nm(self, channel: Channel | None = None) -> float:
        """Return the mean wavelength of the light that a channel of the mosaic counts, or the mean of all pixels, nm.

        It is the mean for a star of B - V 0.65; stars from A0 to M0 are within 15 nm.  With "custom" it is 550 nm, that
        of V.
        """
        return self._responses["mean" if channel is None else channel].wavelength_nm

    def photons(self, channel: Channel) -> float:
        """Return the signal of an A0 star in pixels of one channel over the mean of the mosaic's cells."""
        return self._responses[channel].photons

    def channel_at(self, column: int, row: int) -> Channel:
        """Return the channel of a pixel."""
        return self.mosaic[2 * (row % 2) + column % 2]  # type: ignore[return-value] # a letter of a `Mosaic`

    @property
    def sky_ratio(self) -> dict[Channel, float]:
        """Background in the pixels of each channel over the mean of the mosaic's cells."""
        fainter = {channel: float(self.magnitude_minus_v(self.sky_bv, channel)) for channel in _RGB}
        level = {channel: self.photons(channel) * 10 ** (-0.4 * fainter[channel]) for channel in _RGB}
        mean = (level["r"] + 2 * level["g"] + level["b"]) / 4
        return {channel: value / mean for channel, value in level.items()}

    @property
    def _responses(self) -> Mapping[str, _Response]:
        if self.band == "custom":
            return {"mean": _Response(self.band_slope, self.band_curvature)}
        return _OF_BAND[self.band]


_RGB: tuple[Channel, ...] = ("r", "g", "b")


@lru_cache(maxsize=64)
def _of_values(values: tuple[Any, ...]) -> ColourBand:
    keys = zip(ColourBand.__slots__, values, strict=True)
    return ColourBand(**{key: value for key, value in keys if value is not None})
