"""Light of clouds: moonlight, twilight, airglow and town glow that a sheet of cloud scatters."""

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from glstar.sky.cloudsheet import SheetCrossing

__all__ = ["CloudLights", "cloud_from_above", "cloud_from_below"]

Float = NDArray[np.float64]

# Asymmetry of scattering by droplets and ice in visible light.
_ASYMMETRY: Final = 0.85
# Two-stream approximation of a layer that absorbs nothing: its transmission is 1 / (1 + this times the optical depth).
_TWO_STREAM: Final = 0.75 * (1 - _ASYMMETRY)
# A cloud that reflects light R of a town from below brightens the sky of the town by 1 + this R: ten times under an
# overcast of optical depth 5 (Kyba and others 2011, PLoS ONE 6, e17307: 10.1 in Berlin).
_TOWN_AMPLIFICATION: Final = 25.0
_ARCSEC2_PER_SR: Final = (648000 / np.pi) ** 2
# The Moon lights no cloud from below this sine of its altitude.
_LOWEST_SINE: Final = 0.02


@dataclass(frozen=True, slots=True)
class CloudLights:
    """What lights a sheet of cloud.

    Attributes
    ----------
    moon_flux : float
        Flux of the Moon below the air, over that of magnitude 0.
    sine_moon : float
        Sine of its apparent altitude.
    mean_sky : float
        Mean brightness of the sky above the sheet, flux of magnitude 0 per square arcsecond.
    """

    moon_flux: float
    sine_moon: float
    mean_sky: float


def _diffuse(optical_depth: Float) -> Float:
    """Return the transmission of a layer for diffuse light, two-stream, without absorption."""
    return 1 / (1 + _TWO_STREAM * optical_depth)


def cloud_from_below(
    crossing: SheetCrossing, cosine_to_moon: Float, sky: Float, town: Float, lights: CloudLights
) -> Float:
    """Return the brightness of the sky behind, in and below a sheet of cloud.

    Parameters
    ----------
    crossing : SheetCrossing
        Of the directions.
    cosine_to_moon : (...) float64
        Of the angle to the Moon.
    sky : (...) float64
        Brightness of the sky without the sheet and without towns, flux of magnitude 0 per square arcsecond.
    town : (...) float64
        Brightness of the town's light in the air below the sheet.
    lights : CloudLights

    Returns
    -------
    (...) float64

    Notes
    -----
    The flux that a layer without absorption transmits is 1 / (1 + 0.1125 t) of optical depth t (two-stream); what of it
    is not direct is scattered: light of a single scattering by Henyey and Greenstein's law about the Moon, the rest
    alike in all directions.
    """
    depth, seen = crossing.optical_depth, crossing.optical_depth * crossing.slant
    brightness = np.exp(-seen) * sky + (_diffuse(seen) - np.exp(-seen)) * lights.mean_sky
    brightness = brightness + town * (1 + _TOWN_AMPLIFICATION * (1 - _diffuse(depth)))
    if lights.sine_moon <= _LOWEST_SINE or lights.moon_flux == 0:
        return np.asarray(brightness)
    slanted = depth / lights.sine_moon
    scattered = _diffuse(slanted) - np.exp(-slanted)
    once = np.where(slanted > 0, slanted * np.exp(-slanted) / np.maximum(-np.expm1(-slanted), 1e-30), 1.0)
    forward = (1 - _ASYMMETRY**2) / (1 + _ASYMMETRY**2 - 2 * _ASYMMETRY * cosine_to_moon) ** 1.5 / (4 * np.pi)
    towards = np.expm1(-seen) / np.minimum(np.expm1(-slanted), -1e-30)
    per_sr = scattered * towards * (once * forward + (1 - once) * lights.sine_moon / np.pi)
    return np.asarray(brightness + lights.moon_flux / _ARCSEC2_PER_SR * per_sr)


def cloud_from_above(crossing: SheetCrossing, ground: float, lights: CloudLights) -> Float:
    """Return the brightness of the ground through a sheet of cloud below the observer, with the light of its top.

    Parameters
    ----------
    crossing : SheetCrossing
        Of directions below the horizon.
    ground : float
        Brightness of the ground, flux of magnitude 0 per square arcsecond.
    lights : CloudLights

    Returns
    -------
    (...) float64
    """
    depth = crossing.optical_depth
    brightness = ground * _diffuse(depth) + (1 - _diffuse(depth * crossing.slant)) * lights.mean_sky
    if lights.sine_moon > _LOWEST_SINE:
        reflected = 1 - _diffuse(depth / lights.sine_moon)
        brightness = brightness + lights.moon_flux / _ARCSEC2_PER_SR * lights.sine_moon / np.pi * reflected
    return np.asarray(brightness)
