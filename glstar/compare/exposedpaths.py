"""Sampled star paths while the shutter is open: of single exposures, rolling shutters and stacked exposures."""

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from glstar.render.recordedpaths import recorded_paths
from glstar.render.scene import Scene

__all__ = ["ExposedPaths", "exposed_paths"]

Float = NDArray[np.float64]

# Largest number of samples along a path.
_MAX_SAMPLES: Final = 240
# Smallest number in each piece of the path of a stacked image: a rate at its ends needs three.
_LEAST_SAMPLES: Final = 3
# Number of samples along a path that a rolling shutter records.
_ROLLING_SAMPLES: Final = 64


@dataclass(frozen=True, slots=True, eq=False)
class ExposedPaths:
    """Paths of stars at n times that are evenly spaced while the shutter is open.

    Attributes
    ----------
    in_camera : (n, k, 3) float64
        Vectors in the camera frame; NaN below the horizon.
    step_s : float
        Time between two samples of one piece, s.
    exposed_fraction : (k,) float64
        How long each star is recorded over the exposure time.
    since_mid : (n,) float64
        Times after the middle, over the time from the first opening to the last closing: -1/2 to 1/2.
    pieces : int
        Number of pieces with gaps between, of as many samples each: the short exposures of a stacked image.
    """

    in_camera: Float
    step_s: float
    exposed_fraction: Float
    since_mid: Float
    pieces: int = 1

    def rate_of(self, values: Float) -> Float:
        """Return the derivative by time of values at the samples, (n, ...) float64, 1/s, each piece by itself."""
        pieces = values.reshape(self.pieces, len(values) // self.pieces, *values.shape[1:])
        return np.asarray(np.gradient(pieces, self.step_s, axis=1, edge_order=2).reshape(values.shape))


def exposed_paths(scene: Scene, direction_eq: Float) -> ExposedPaths:
    """Return the sampled paths of stars while the shutter is open.

    Parameters
    ----------
    scene : Scene
        Of a single exposure, or of a stacked image.
    direction_eq : (k, 3) float64
        Geocentric apparent unit vectors, true equator and equinox.

    Returns
    -------
    ExposedPaths
        Under a rolling shutter while the row of each star is open.  A delay of the exposure also delays its rows, so
        that the time between samples in which a star moves is that of a star at rest.
    """
    if not scene.shorts:
        return _single(scene, direction_eq)
    parts = [_single(short, direction_eq) for short in scene.shorts]
    # Each short exposure has the same weight in the centre of the trail.
    count = min(max(_MAX_SAMPLES // len(parts), _LEAST_SAMPLES), *(len(part.in_camera) for part in parts))
    even = (np.arange(count) + 0.5) / count
    starts_s = scene.exposure.short_times_s()[:, 0] - scene.exposure.start_utc_s
    duration_s = scene.exposure.duration_s
    # Of each star's own rows: all of them are delayed alike.
    open_s = scene.exposure.span_s - scene.exposure.readout_s
    since_start_s = (starts_s[:, np.newaxis] + even * duration_s).ravel()
    return ExposedPaths(
        np.concatenate([part.in_camera[(even * len(part.in_camera)).astype(np.intp)] for part in parts]),
        duration_s / count,
        np.mean([part.exposed_fraction for part in parts], axis=0),
        since_start_s / open_s - 0.5,
        len(parts),
    )


def _single(scene: Scene, direction_eq: Float) -> ExposedPaths:
    """Return the paths of a single exposure."""
    duration_s = scene.exposure.duration_s
    if scene.exposure.readout_s and scene.motion is not None:
        in_camera, exposed_s = recorded_paths(scene, direction_eq, _ROLLING_SAMPLES)
        step_s, exposed_fraction = duration_s / _ROLLING_SAMPLES, exposed_s / duration_s
    else:
        step = max(1, len(scene.trails.pointing) // _MAX_SAMPLES)
        in_camera = scene.trails.pointing[::step].to_camera(direction_eq)
        step_s = duration_s * step / max(len(scene.trails.pointing), 1)
        exposed_fraction = np.ones(len(direction_eq))
    since_mid = (np.arange(len(in_camera)) + 0.5) / len(in_camera) - 0.5
    return ExposedPaths(in_camera, step_s, exposed_fraction, since_mid)
