"""Curves on the sky that depend only on the camera and the epoch: grids, the horizon, constellations."""

from functools import lru_cache
from math import asin, ceil, pi, tan
from typing import Final

import numpy as np
from numpy.typing import NDArray

from glstar.camera.model import Camera
from glstar.sky.apparent import ASTROMETRY, direction
from glstar.sky.catalogue import StarCatalogue
from glstar.sky.constellations import constellations
from glstar.sky.horizon import ned_direction
from glstar.sky.horizonprofile import HorizonProfile
from glstar.viewer.curves import REFRACTION_CURVATURE, Curves, great_circle, max_step_rad, parallel

__all__ = ["COMPASS_POINTS", "ConstellationFigures", "Grids", "compass_ned", "horizon_curve"]

Float = NDArray[np.float64]

# Spacings of the grids: degrees of declination and altitude, minutes of right ascension.  The widest is used that is
# at most the half diagonal of the image.
_SPACINGS: Final = ((10, 60), (5, 20), (2, 10), (1, 5))

COMPASS_POINTS: Final = (
    *("N", "NNE", "NE", "ENE", "E", "ESE", "SE", "SSE"),
    *("S", "SSW", "SW", "WSW", "W", "WNW", "NW", "NNW"),
)

# The end of a constellation's line is a catalogue star if one lies within this angle; the farthest known is 9".
_SAME_STAR_RAD: Final = np.deg2rad(15 / 3600)
# Magnitude limit of those stars.
_FIGURE_VMAG_LIMIT: Final = 7.0


class Grids:
    """The grids for a camera, sampled as finely as its image needs.

    Parameters
    ----------
    camera : Camera

    Attributes
    ----------
    altaz : Curves
        In apparent directions north, east, down.
    equatorial : Curves
        In geocentric apparent directions.
    altaz_labels, equatorial_labels : tuple of str
        One label for each curve.
    """

    def __init__(self, camera: Camera) -> None:
        self.camera = camera
        radius_rad = camera.field_radius_rad
        degrees, minutes = next((pair for pair in _SPACINGS if np.deg2rad(pair[0]) <= radius_rad), _SPACINGS[-1])
        last = 90 - degrees
        step_rad, refracted_step_rad = max_step_rad(camera, 0.0), max_step_rad(camera, REFRACTION_CURVATURE)

        altitudes, azimuths = range(degrees, 90, degrees), range(0, 360, degrees)
        altaz = [_ned(parallel(h, max_step_rad(camera, np.tan(h)))) for h in np.deg2rad(altitudes)]
        for azimuth in azimuths:
            top = 90 if azimuth % 30 == 0 else last
            altaz.append(great_circle(ned_direction(np.deg2rad(azimuth), np.deg2rad([0, top])), step_rad))

        declinations, meridians = range(-last, 90, degrees), range(0, 24 * 60, minutes)
        equatorial = [
            parallel(dec, max_step_rad(camera, REFRACTION_CURVATURE + abs(np.tan(dec))))
            for dec in np.deg2rad(declinations)
        ]
        for minute in meridians:
            top = 90 if minute % 180 == 0 else last
            ends = direction(np.deg2rad(minute / 4), np.deg2rad([-top, 0, top]))
            equatorial.append(great_circle(ends, refracted_step_rad))

        self.altaz, self.equatorial = Curves.of(altaz), Curves.of(equatorial)
        self.altaz_labels = (*(f"alt {h}°" for h in altitudes), *(f"az {az}°" for az in azimuths))
        self.equatorial_labels = (
            *(f"{dec:+d}°" if dec else "0°" for dec in declinations),
            *map(_hours, meridians),
        )


# A still aircraft keeps its horizon; one that climbs needs another for every frame.
@lru_cache(maxsize=4)
def horizon_curve(camera: Camera, sine_horizon: float, profile: HorizonProfile | None = None) -> Curves:
    """Return the apparent horizon.

    Parameters
    ----------
    camera : Camera
        The curve is sampled as finely as its image needs.
    sine_horizon : float
        Sine of the apparent altitude of the horizon.
    profile : HorizonProfile, optional
        The horizon by azimuth, instead.

    Returns
    -------
    Curves
        In apparent directions north, east, down.
    """
    if profile is not None:
        steps = ceil(2 * pi / max_step_rad(camera, tan(max(profile.highest_rad, -profile.lowest_rad))))
        azimuth_rad = np.union1d(np.linspace(0, 2 * pi, steps + 1), profile.azimuths_rad)
        return Curves.of([ned_direction(azimuth_rad, profile.altitude_rad(azimuth_rad))])
    altitude_rad = asin(sine_horizon)
    return Curves.of([_ned(parallel(altitude_rad, max_step_rad(camera, abs(tan(altitude_rad)))))])


def compass_ned(sine_horizon: float, profile: HorizonProfile | None = None) -> Float:
    """Return the directions of the compass points on the horizon, (16, 3) float64 north, east, down.

    Parameters
    ----------
    sine_horizon : float
        Sine of the apparent altitude of the horizon.
    profile : HorizonProfile, optional
        The horizon by azimuth, instead.
    """
    azimuth_rad = np.arange(len(COMPASS_POINTS)) * (2 * np.pi / len(COMPASS_POINTS))
    return ned_direction(azimuth_rad, asin(sine_horizon) if profile is None else profile.altitude_rad(azimuth_rad))


def _ned(by_azimuth: Float) -> Float:
    """Return directions of longitude = azimuth and latitude = altitude as north, east, down: z changes its sign."""
    return by_azimuth * [1.0, 1.0, -1.0]


def _hours(minutes: int) -> str:
    hours, rest = divmod(minutes, 60)
    return f"{hours}h{rest:02d}" if rest else f"{hours}h"


class ConstellationFigures:
    """The lines and the names of the constellations at the epoch of a star field.

    Parameters
    ----------
    catalogue : StarCatalogue
        Its proper motions move the ends of the lines; ends that are no stars of the catalogue stay at J2000.

    Attributes
    ----------
    names : tuple of str
    """

    def __init__(self, catalogue: StarCatalogue) -> None:
        figures = constellations()
        self.names = tuple(figure.name for figure in figures)
        self._label_rad = np.array([figure.label_rad for figure in figures])
        lines = [line for figure in figures for line in figure.lines_rad]
        self._lengths = [len(line) for line in lines]
        self._ends = _with_proper_motion(np.concatenate(lines), catalogue)
        self._prepared_for: tuple[float, Camera] | None = None
        self._curves = Curves.of([])
        self._label_eq = np.empty((0, 3))

    def curves(self, epoch_utc_s: float, camera: Camera) -> Curves:
        """Return the lines in geocentric apparent directions.

        Parameters
        ----------
        epoch_utc_s : float
            UTC seconds since 1970.
        camera : Camera

        Returns
        -------
        Curves
        """
        self._prepare(epoch_utc_s, camera)
        return self._curves

    def label_eq(self, epoch_utc_s: float, camera: Camera) -> Float:
        """Return the directions of the names, (n, 3) float64, geocentric apparent; parameters as of `curves`."""
        self._prepare(epoch_utc_s, camera)
        return self._label_eq

    def _prepare(self, epoch_utc_s: float, camera: Camera) -> None:
        if self._prepared_for == (epoch_utc_s, camera):
            return
        # Either kind of astrometry will do: they agree to 0.7".
        to_apparent = ASTROMETRY["erfa"].apparent_directions
        ends = np.split(to_apparent(*self._ends, epoch_utc_s), np.cumsum(self._lengths)[:-1])
        step_rad = max_step_rad(camera, REFRACTION_CURVATURE)
        self._curves = Curves.of([great_circle(line, step_rad) for line in ends])
        no_motion = np.zeros(len(self._label_rad))
        ra_rad, dec_rad = self._label_rad[:, 0], self._label_rad[:, 1]
        self._label_eq = to_apparent(ra_rad, dec_rad, no_motion, no_motion, epoch_utc_s)
        self._prepared_for = (epoch_utc_s, camera)


def _with_proper_motion(j2000_rad: Float, catalogue: StarCatalogue) -> tuple[Float, Float, Float, Float]:
    """Return right ascension, declination and proper motions of the stars at J2000 positions (n, 2)."""
    ra_rad, dec_rad = j2000_rad.T.copy()
    pm_ra, pm_dec = np.zeros_like(ra_rad), np.zeros_like(ra_rad)
    bright = np.flatnonzero(catalogue.vmag <= _FIGURE_VMAG_LIMIT)
    bright = bright[np.argsort(catalogue.dec_rad[bright])]
    star_dec = catalogue.dec_rad[bright]
    star_direction, wanted = catalogue.direction[bright], direction(ra_rad, dec_rad)
    south = np.searchsorted(star_dec, dec_rad - _SAME_STAR_RAD)
    north = np.searchsorted(star_dec, dec_rad + _SAME_STAR_RAD)
    for i, (first, last) in enumerate(zip(south.tolist(), north.tolist(), strict=True)):
        chord = np.linalg.norm(star_direction[first:last] - wanted[i], axis=1)
        if chord.size and chord.min() < _SAME_STAR_RAD:
            star = bright[first + int(chord.argmin())]
            ra_rad[i], dec_rad[i] = catalogue.ra_rad[star], catalogue.dec_rad[star]
            pm_ra[i], pm_dec[i] = catalogue.pm_ra_cosdec_rad_per_yr[star], catalogue.pm_dec_rad_per_yr[star]
    return ra_rad, dec_rad, pm_ra, pm_dec
