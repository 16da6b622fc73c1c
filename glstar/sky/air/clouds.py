"""A sheet of cloud: its optical depth, its transmission, and the moonlight, sky and town light that it scatters."""

from dataclasses import dataclass
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from glstar.arrays import Float

# Mean radius of the Earth, m.
_EARTH_RADIUS_M = 6371008.8
# Cells along a side of the periodic field, a power of two, and its side in units of the largest structures.
_CELLS = 1024
_PERIOD_SCALES = 16.0
# Power per area falls as the wave number to minus this power: that of the light of clouds below some 500 m, which is
# smoother than their water (Davis and others 1997, J. Atmos. Sci. 54, 241).
_SPECTRAL_SLOPE = 11 / 3

# Asymmetry of scattering by droplets and ice in visible light.
_ASYMMETRY = 0.85
# Two-stream approximation of a layer that absorbs nothing: its transmission is 1 / (1 + this times the optical depth).
_TWO_STREAM = 0.75 * (1 - _ASYMMETRY)
# A cloud that reflects light R of a town from below brightens the sky of the town by 1 + this R: ten times under an
# overcast of optical depth 5 (Kyba and others 2011, PLoS ONE 6, e17307: 10.1 in Berlin).
_TOWN_AMPLIFICATION = 25.0
_ARCSEC2_PER_SR = (648000 / np.pi) ** 2
# The Moon lights no cloud from below this sine of its altitude.
_LOWEST_SINE = 0.02


class SheetCrossing(NamedTuple):
    """Where lines of sight cross a sheet."""

    optical_depth: Float  # (...) of the sheet there, vertically; 0 where a line does not cross it
    slant: Float  # (...) 1 over the cosine of the angle between the line and the vertical there

    @property
    def transmission(self) -> Float:
        """Fraction of light that passes along the line, (...)."""
        return np.exp(-self.optical_depth * self.slant)


@dataclass(frozen=True, slots=True)
class CloudSheet:
    """A thin sheet of cloud at a constant height, which drifts with the wind.

    A Gaussian random field f with a power law for its spectrum, of unit variance, is cut at its quantile f0 of 1 -
    coverage: the optical depth is D (1 - exp(-(f - f0) / edge)) where f > f0.  The field repeats after 16 `scale_m`.
    """

    coverage: float  # fraction of the sheet that is cloud, 0 to 1
    optical_depth: float  # vertical optical depth far from an edge
    height_m: float  # from the same zero as the height of the aircraft
    scale_m: float  # size of the largest structures
    edge: float  # width of the edges, in standard deviations of the field that makes the structures
    wind_m_s: float  # speed at which it drifts
    wind_from_rad: float  # azimuth from which the wind blows
    seed: int
    latitude_rad: float = 0.0  # origin of the coordinates on the sheet
    longitude_rad: float = 0.0

    @property
    def cell_m(self) -> float:
        """Size of the smallest structures, m."""
        return self.scale_m * _PERIOD_SCALES / _CELLS

    def depth_at(self, east_m: ArrayLike, north_m: ArrayLike, utc_s: ArrayLike) -> Float:
        """Return vertical optical depths of the sheet, (...).

        `east_m`, `north_m` (...): distances from the origin; `utc_s` (...): UTC seconds since 1970.
        """
        drift_m = self.wind_m_s * np.asarray(utc_s)
        x = (np.asarray(east_m) + drift_m * np.sin(self.wind_from_rad)) / self.cell_m
        y = (np.asarray(north_m) + drift_m * np.cos(self.wind_from_rad)) / self.cell_m
        field, levels = _field(self.seed)
        above = _spline(field, x, y) - levels[round((1 - self.coverage) * (len(levels) - 1))]
        return np.asarray(self.optical_depth * -np.expm1(-np.maximum(above, 0.0) / self.edge))

    def crossed(
        self,
        sine_altitude: Float,
        east: Float,
        north: Float,
        site: tuple[ArrayLike, ArrayLike, ArrayLike],
        utc_s: ArrayLike,
    ) -> SheetCrossing:
        """Return the crossings of straight lines of sight with the sheet on a sphere, upwards or downwards.

        `sine_altitude` (...): sines of apparent altitudes; `east`, `north` (...): sine and cosine of the azimuth;
        `site`: latitude and longitude, rad, and height, m, of observers, either all below the sheet or all above it;
        `utc_s` (...): UTC seconds since 1970.  A line without a direction, NaN, crosses nothing.
        """
        latitude_rad, longitude_rad, height_m = (np.asarray(number, dtype=np.float64) for number in site)
        radius_m, above_m = _EARTH_RADIUS_M + height_m, self.height_m - height_m
        along = radius_m * sine_altitude
        square = along * along + above_m * (2 * radius_m + above_m)
        root = np.sqrt(np.maximum(square, 0.0))
        sheet_radius_m = radius_m + above_m
        if np.all(above_m >= 0):  # the only positive solution, without cancellation
            crosses = sine_altitude > -1.0
            path_m = np.where(
                along > 0, above_m * (2 * radius_m + above_m) / np.maximum(along + root, 1e-9), root - along
            )
        else:
            crosses = (square > 0) & (along < 0)
            path_m = np.where(crosses, above_m * (2 * radius_m + above_m) / np.minimum(along - root, -1e-9), 0.0)
        cosine = np.sqrt(np.maximum(1 - sine_altitude * sine_altitude, 0.0))
        arc_m = _EARTH_RADIUS_M * np.arctan2(path_m * cosine, radius_m + path_m * sine_altitude)
        slant = sheet_radius_m / np.fmax(np.abs(along + path_m), 1e-9)
        origin_east_m = _EARTH_RADIUS_M * np.cos(self.latitude_rad) * _wrapped(longitude_rad - self.longitude_rad)
        origin_north_m = _EARTH_RADIUS_M * (latitude_rad - self.latitude_rad)
        east_m, north_m = np.nan_to_num(arc_m * east), np.nan_to_num(arc_m * north)
        depth = self.depth_at(origin_east_m + east_m, origin_north_m + north_m, utc_s)
        return SheetCrossing(np.where(crosses, depth, 0.0), slant)


def _wrapped(angle_rad: Float) -> Float:
    return (angle_rad + np.pi) % (2 * np.pi) - np.pi


@lru_cache(maxsize=4)
def _field(seed: int) -> tuple[Float, Float]:
    """Return the spline coefficients of a periodic field of unit variance, and a sorted sample of its values."""
    noise = np.fft.rfft2(np.random.default_rng(seed).standard_normal((_CELLS, _CELLS)))
    ky, kx = np.fft.fftfreq(_CELLS)[:, np.newaxis] * _CELLS, np.fft.rfftfreq(_CELLS) * _CELLS
    amplitude = (kx * kx + ky * ky + _PERIOD_SCALES**2) ** (-_SPECTRAL_SLOPE / 4)
    amplitude[0, 0] = 0.0
    field = np.fft.irfft2(noise * amplitude, s=(_CELLS, _CELLS))
    side = np.arange(0, _CELLS, 4) + 0.5
    field = np.pad(field, 1, mode="wrap")
    values = _spline(field, *np.meshgrid(side, side))
    return (field - values.mean()) / values.std(), np.sort(((values - values.mean()) / values.std()).ravel())


def _spline(field: Float, x: Float, y: Float) -> Float:
    """Return the quadratic B-spline of a periodic field, which has a border of one cell, at some columns and rows."""
    (column, across), (row, down) = _taps(x), _taps(y)
    total = np.zeros(np.shape(x))
    first = row * (_CELLS + 2) + column
    for weight in down:
        along = across[0] * field.take(first)
        along += across[1] * field.take(first + 1)
        along += across[2] * field.take(first + 2)
        total += weight * along
        first += _CELLS + 2
    return total


def _taps(x: Float) -> tuple[NDArray[np.intp], tuple[Float, Float, Float]]:
    """Return the first of three cells of a field with a border, and their weights."""
    nearest = np.floor(x + 0.5)
    t = x - nearest
    weights = 0.5 * (0.5 - t) ** 2, 0.75 - t * t, 0.5 * (0.5 + t) ** 2
    return nearest.astype(np.intp) & (_CELLS - 1), weights


@dataclass(frozen=True, slots=True)
class CloudLights:
    """What lights a sheet of cloud."""

    moon_flux: float  # flux of the Moon below the air, over that of magnitude 0
    sine_moon: float  # sine of the Moon's apparent altitude
    mean_sky: float  # mean brightness of the sky above the sheet, flux of magnitude 0 per square arcsecond


def _diffuse(optical_depth: Float) -> Float:
    """Return the transmission of a layer for diffuse light, two-stream, without absorption."""
    return 1 / (1 + _TWO_STREAM * optical_depth)


def cloud_from_below(
    crossing: SheetCrossing, cosine_to_moon: Float, sky: Float, town: Float, lights: CloudLights
) -> Float:
    """Return the brightness of the sky behind, in and below a sheet of cloud, (...).

    `crossing`: crossings of the lines of sight; `cosine_to_moon` (...): cosines of the angles to the Moon; `sky` (...):
    brightness of the sky without the sheet and without towns, flux of magnitude 0 per square arcsecond; `town` (...):
    brightness of the town's light in the air below the sheet.

    A layer of optical depth t without absorption transmits the fraction 1 / (1 + 0.1125 t) of the flux (two-stream).
    The part of it that is not direct is scattered: once by Henyey and Greenstein's law about the Moon, and the rest
    equally in all directions.
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
    """Return the brightness, (...), of a sheet of cloud below the observer, and of the ground through it.

    `crossing`: crossings of lines of sight below the horizon; `ground`: brightness of the ground, flux of magnitude 0
    per square arcsecond.
    """
    depth = crossing.optical_depth
    brightness = ground * _diffuse(depth) + (1 - _diffuse(depth * crossing.slant)) * lights.mean_sky
    if lights.sine_moon > _LOWEST_SINE:
        reflected = 1 - _diffuse(depth / lights.sine_moon)
        brightness = brightness + lights.moon_flux / _ARCSEC2_PER_SR * lights.sine_moon / np.pi * reflected
    return np.asarray(brightness)
