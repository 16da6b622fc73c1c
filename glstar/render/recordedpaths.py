"""The paths of stars while a rolling shutter records them."""

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from glstar.render.rowtimes import RecordedTimes, RowTimeSearch, recorded_times
from glstar.render.scene import Scene
from glstar.render.starpaths import ConicPaths, SampledPaths

__all__ = ["RecordedPart", "recorded_parts", "recorded_paths", "recorded_positions", "recorded_samples"]

Float = NDArray[np.float64]


class RecordedPart(NamedTuple):
    """The true paths of stars during a part of an exposure, and when a rolling shutter records them.

    Attributes
    ----------
    paths : SampledPaths or ConicPaths
    opens, closes : (k,) float64
        When each star is first and last recorded: fractions of a short exposure since the start of the part.
    scale : float
        The length of a short exposure, over the time for which all short exposures expose a row.
    shorts : int
        Number of short exposures.
    """

    paths: SampledPaths | ConicPaths
    opens: Float
    closes: Float
    scale: float
    shorts: int

    @property
    def recorded(self) -> Float:
        """How long each star is recorded, (k,), over the time for which all short exposures expose a row."""
        last = float(self.paths.time_fraction.sum())
        return np.asarray((self.closes.clip(0.0, last) - self.opens.clip(0.0, last)).clip(min=0.0) * self.scale)

    def samples(self, stars: NDArray[np.intp]) -> Iterator[tuple[Float, Float, Float]]:
        """Yield samples of the paths of some of the stars: see `recorded_samples`."""
        end, opens, closes = 0.0, self.opens[stars], self.closes[stars]
        for xy_px, time_fraction in self.paths.samples(stars):
            ends = end + np.cumsum(time_fraction)[:, np.newaxis]
            weight = np.minimum(ends, closes)
            weight -= np.maximum(ends - time_fraction[:, np.newaxis], opens)
            np.maximum(weight, 0.0, out=weight)
            weight *= self.scale
            yield xy_px, time_fraction / self.shorts, weight
            end = float(ends[-1, 0])


def recorded_parts(scene: Scene, direction_eq: Float, recorded: RecordedTimes | None = None) -> Iterator[RecordedPart]:
    """Yield the true paths of stars and when a rolling shutter records them; parameters of `recorded_samples`."""
    shorts = scene.shorts or (scene,)
    recorded = recorded_times(scene, direction_eq) if recorded is None else recorded
    for short, times in zip(shorts, recorded.shorts or (recorded,), strict=True):
        span_s, begin = short.exposure.span_s, 0.0
        scale = span_s / (short.exposure.duration_s * len(shorts))
        for paths in short.star_paths(direction_eq):
            yield RecordedPart(
                paths, times.opens_s / span_s - begin, times.closes_s / span_s - begin, scale, len(shorts)
            )
            begin += float(paths.time_fraction.sum())


def recorded_samples(
    scene: Scene, direction_eq: Float, recorded: RecordedTimes | None = None
) -> Iterator[tuple[Float, Float, Float]]:
    """Yield the true paths of stars while a rolling shutter records them.

    Parameters
    ----------
    scene : Scene
        With a readout time; of a single exposure or of a stacked image.
    direction_eq : (k, 3) float64
        Geocentric apparent unit vectors, true equator and equinox.
    recorded : RecordedTimes, optional
        `recorded_times` of the same, if known.

    Yields
    ------
    xy_px : (n, k, 2) float64
        Positions at n times; NaN behind the camera and below the horizon.
    time_fraction : (n,) float64
        The parts of the time from the first opening to the last closing.
    weight : (n, k) float64
        The parts of the exposure time in which the row of each star is open: their sum over all times is
        `RecordedTimes.exposed_s` over the exposure time of all short exposures.
    """
    for part in recorded_parts(scene, direction_eq, recorded):
        yield from part.samples(np.arange(len(direction_eq)))


def recorded_paths(scene: Scene, direction_eq: Float, count: int) -> tuple[Float, Float]:
    """Return the paths of stars while a rolling shutter records them.

    Parameters
    ----------
    scene : Scene
        With a readout time.
    direction_eq : (k, 3) float64
        Geocentric apparent unit vectors, true equator and equinox.
    count : int
        Number of times, n: the middles of equal parts of the time during which each star is recorded.

    Returns
    -------
    in_camera : (n, k, 3) float64
        Vectors in the camera frame; NaN below the horizon.
    exposed_s : (k,) float64
        How long each star is recorded, s.
    """
    return _recorded(scene, direction_eq, (np.arange(count) + 0.5) / count)


def recorded_positions(scene: Scene, direction_eq: Float, fractions: Float) -> Float:
    """Return where stars are at fractions of the time during which each is recorded, by any shutter.

    Parameters
    ----------
    scene : Scene
    direction_eq : (k, 3) float64
        Geocentric apparent unit vectors, true equator and equinox.
    fractions : (n,) float64
        0 as a star's own row opens, or a global shutter; 1 as it closes.  Of a stacked image, of the time during which
        the shutter is open.

    Returns
    -------
    (n, k, 2) float64
        Positions (x, y), px; NaN behind the camera and below the horizon.
    """
    if scene.exposure.readout_s == 0 or scene.motion is None:
        return scene.positions(direction_eq, fractions)
    if not scene.shorts:
        return scene.camera.project(_recorded(scene, direction_eq, fractions)[0])
    count, xy_px = len(scene.shorts), np.empty((len(fractions), len(direction_eq), 2))
    which = np.minimum((fractions * count).astype(np.intp), count - 1)
    for k in np.unique(which).tolist():
        xy_px[which == k] = recorded_positions(scene.shorts[k], direction_eq, fractions[which == k] * count - k)
    return xy_px


def _recorded(scene: Scene, direction_eq: Float, fractions: Float) -> tuple[Float, Float]:
    """Return `recorded_paths` at fractions of the time during which each star is recorded."""
    if not len(direction_eq):
        return np.zeros((len(fractions), 0, 3)), np.zeros(0)
    rows = RowTimeSearch(scene)
    times = rows.times(direction_eq)
    own_s = times.opens_s + fractions[:, np.newaxis] * (times.closes_s - times.opens_s)
    in_camera = [rows.in_camera(direction_eq, since_s) for since_s in own_s]
    return np.stack(in_camera), times.exposed_s
