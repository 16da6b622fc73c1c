"""Expected brightness of star trails: the signal at the brightest point, and the area that its light covers."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from math import sqrt

import numpy as np
from numpy.typing import NDArray

from glstar.camera.limitingmagnitude import noise_equivalent_area_px2
from glstar.camera.sensor import Sensor
from glstar.render.brightestpoints import brightest_points
from glstar.render.clouds import CloudPassage
from glstar.render.gaussianscenes import psf_scale
from glstar.render.linechains import LineChain, Stars, line_chains
from glstar.render.rowtimes import RecordedTimes
from glstar.render.scene import Scene
from glstar.sky.starcolours import USUAL_BV

__all__ = ["TrailPeaks", "trail_peaks"]

Float = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class TrailPeaks:
    """Expected brightness of m stars.

    Attributes
    ----------
    peak_fraction_per_px2 : (m,) float64
        Signal at the brightest point of a trail on the image, over the flux of the star.
    area_px2 : (m,) float64
        Noise-equivalent area of the trail: the squared flux over the integral of the squared signal.  That of a part of
        the trail is the same part of it.
    """

    peak_fraction_per_px2: Float
    area_px2: Float


def trail_peaks(
    scene: Scene,
    direction_eq: Float,
    passage: CloudPassage | None = None,
    nodes_px: Float | None = None,
    recorded: RecordedTimes | None = None,
    *,
    bv: Float | float = USUAL_BV,
) -> TrailPeaks:
    """Return the expected brightness of trails along the true paths of stars.

    Parameters
    ----------
    scene : Scene
    direction_eq : (m, 3) float64
        Geocentric apparent unit vectors, true equator and equinox.
    passage : CloudPassage, optional
        What cloud transmits of the stars: the peak is that of the dimmed trail, over the flux above the cloud.
    nodes_px : (2, n, m) float64, optional
        Their `ConicPaths.nodes_px`, if these are known.
    recorded : RecordedTimes, optional
        When a rolling shutter records them: fractions are of the flux that it records.
    bv : (m,) float64 or float
        Their colours B - V.

    Returns
    -------
    TrailPeaks

    Notes
    -----
    The path is a chain of lines, whose light is a Gaussian across and a difference of error functions along, for each
    Gaussian of a star's profile.  It is evaluated at the points that `brightest_points` finds.  A Gaussian at rest has
    the area 4 pi sigma^2, and a long trail of length L the area 2 sqrt(pi) sigma L.  Areas of other profiles are larger
    by a factor for stars at rest and another for long trails, between which it is interpolated.
    """
    chains = list(line_chains(scene, direction_eq, nodes_px, recorded))
    transmissions = _transmissions(chains, passage)
    points = brightest_points(scene, direction_eq, chains, transmissions)
    scales = psf_scale(scene, direction_eq, bv)
    profiles = list(_profiles(scene.sensor, scales))
    peak = np.max([_signal_at(point, chains, transmissions, profiles) for point in points.point_px], axis=0)
    mean = np.ones(1) if passage is None else passage.mean
    dimmed = peak / np.maximum(mean, 1e-30)
    area_px2 = mean * mean / np.maximum(points.square_per_px2, 1e-30)
    # No signal is everywhere larger than its peak; of a path off the image nothing else is known.
    area_px2 = np.where(points.square_per_px2 > 0, area_px2, sqrt(2) / np.maximum(dimmed, 1e-30))
    return TrailPeaks(peak, _area_over_core(scene.sensor, scales, dimmed) * area_px2)


def _signal_at(
    point_px: Float,
    chains: Sequence[LineChain],
    transmissions: Sequence[Float | None],
    profiles: Sequence[tuple[Stars, list[tuple[float, float, Float]]]],
) -> Float:
    """Return the signal at one point per star, (m,), with all the Gaussians of its profile."""
    signal = np.zeros(len(point_px))
    for chain, transmission in zip(chains, transmissions, strict=True):
        for stars, gaussians in profiles:
            of_stars, passing = chain[stars], None if transmission is None else transmission[:, stars]
            for fraction, sigma_px, offset_px in gaussians:
                signal[stars] += fraction * of_stars.signal_at(point_px[stars] - offset_px, sigma_px, passing)
    return signal


def _profiles(sensor: Sensor, scales: Float) -> Iterator[tuple[Stars, list[tuple[float, float, Float]]]]:
    """Yield the stars with each profile, and its Gaussians: fraction of the flux, sigma in px, offset (x, y) in px."""
    if sensor.point_spread.is_gaussian:
        yield slice(None), [(1.0, sensor.effective_sigma_px, np.zeros(2))]
        return
    for scale in np.unique(scales).tolist():
        yield (
            np.flatnonzero(scales == scale),
            [
                (one.flux_fraction, sensor.of_component(one).effective_sigma_px, np.array(one.offset_px))
                for one in sensor.point_spread.components(sensor.psf_sigma_px, scale=scale)
            ],
        )


def _area_over_core(sensor: Sensor, scales: Float, peak: Float) -> Float | float:
    """Return the noise-equivalent areas of trails, over those that Gaussians of the width on the axis would leave."""
    if sensor.point_spread.is_gaussian:
        return 1.0
    parts = [
        (one.flux_fraction, sensor.of_component(one).effective_sigma_px ** 2)
        for one in sensor.point_spread.circular(sensor.psf_sigma_px)
    ]
    core_px2 = sensor.effective_sigma_px**2
    at_rest = noise_equivalent_area_px2(sensor) / (4 * np.pi * core_px2)
    overlap = sum(f * g / sqrt(2 * np.pi * (s + t)) for f, s in parts for g, t in parts)
    along_line = 1 / (sqrt(4 * np.pi * core_px2) * overlap)
    rest_per_px2 = sum(fraction / (2 * np.pi * variance) for fraction, variance in parts)
    concentration = np.minimum(peak * scales**2 / rest_per_px2, 1.0)
    return np.asarray((along_line + (at_rest - along_line) * concentration) * scales ** (1 + concentration))


def _transmissions(chains: Sequence[LineChain], passage: CloudPassage | None) -> list[Float | None]:
    """Return what cloud transmits of the stars during each line of each chain, (n, m); None for all."""
    if passage is None:
        return [None] * len(chains)
    means = passage.means(np.concatenate([chain.duration for chain in chains]))
    return list(np.split(means, np.cumsum([len(chain) for chain in chains])[:-1]))
