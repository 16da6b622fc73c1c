"""Paths of stars as chains of straight lines, and the signal that they leave on the image."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Final, Self

import numpy as np
from numpy.typing import NDArray

from glstar.render.rowtimes import OpenPath, RecordedTimes
from glstar.render.scene import Scene
from glstar.render.stacking import StackedTrails
from glstar.render.trailmodels import AnalyticSegments, TrailModel

__all__ = ["LineChain", "Stars", "line_chains", "normal_cumulative"]

Float = NDArray[np.float64]
Stars = slice | NDArray[np.intp]

# Lines of an exposure, at least.
_MIN_PARTS: Final = 16
# Lines that are shorter than this, sigma, are wide Gaussians instead: the difference is below 1e-4.
_SHORT_SIGMA: Final = 0.5
# Lines whose ends are farther than this, sigma, add less than 1e-5.
_FAR_SIGMA: Final = 5.0


@dataclass(frozen=True, slots=True, eq=False)
class LineChain:
    """Paths of m stars as chains of n lines.

    Attributes
    ----------
    middle_px : (2, n, m) float64
        Middles of the lines, px.
    step_px : (2, n, m) float64
        From their starts to their ends, px; 0 where a star is not visible.
    length_px : (n, m) float64
        Lengths of the lines, px.
    duration : (n,) float64
        The fraction of the exposure of each line.
    hidden : (n, m) bool or None
        Which lines have an end that is not visible; None if all are visible.
    recorded : (n, m) float64 or None
        Under a rolling shutter, the fraction of each star's own exposure of each line; None for `duration`.
    """

    middle_px: Float
    step_px: Float
    length_px: Float
    duration: Float
    hidden: NDArray[np.bool_] | None
    recorded: Float | None

    @classmethod
    def of(cls, xy_px: Float, duration: Float, recorded: Float | None) -> Self:
        """Return the chain through positions, (2, n + 1, m) px; NaN where a star is not visible."""
        step_px = xy_px[:, 1:] - xy_px[:, :-1]
        length_px = np.sqrt(step_px[0] * step_px[0] + step_px[1] * step_px[1])  # five times as fast as hypot
        hidden = None
        if not np.isfinite(length_px.sum()):
            hidden, xy_px = ~np.isfinite(length_px), np.nan_to_num(xy_px)
            step_px[:, hidden] = 0.0
            length_px[hidden] = 0.0
        return cls((xy_px[:, 1:] + xy_px[:, :-1]) / 2, step_px, length_px, duration, hidden, recorded)

    def __len__(self) -> int:
        return len(self.duration)

    def __getitem__(self, stars: Stars) -> Self:
        """Return the chain of some stars."""
        hidden = None if self.hidden is None else self.hidden[:, stars]
        recorded = None if self.recorded is None else self.recorded[:, stars]
        vectors = self.middle_px[..., stars], self.step_px[..., stars]
        return type(self)(*vectors, self.length_px[:, stars], self.duration, hidden, recorded)

    @property
    def is_whole(self) -> NDArray[np.bool_]:
        """Which stars are visible all the time, (m,)."""
        is_hidden = np.zeros(self.middle_px.shape[2:], np.bool_) if self.hidden is None else self.hidden.any(axis=0)
        return np.asarray(~is_hidden)

    @property
    def weight(self) -> Float:
        """The fraction of each star's flux that each line has, (n, m)."""
        weight = self.recorded
        if weight is None:
            weight = np.broadcast_to(self.duration[:, np.newaxis], self.length_px.shape)
        return weight if self.hidden is None else np.where(self.hidden, 0.0, weight)

    def signal_at(self, point_px: Float, sigma_px: float, transmission: Float | None) -> Float:
        """Return the signal at one point per star, over the flux of the star.

        Parameters
        ----------
        point_px : (m, 2) float64
            Positions (x, y), px.
        sigma_px : float
            Standard deviation of the stars, px.
        transmission : (n, m) float64 or None
            What reaches the camera during each line; None for 1.

        Returns
        -------
        (m,) float64
            1/px^2.
        """
        off_px = point_px.T[:, np.newaxis] - self.middle_px
        # Most lines are too far to matter.
        reach = self.length_px / 2 + _FAR_SIGMA * sigma_px
        reach *= reach
        is_near = np.einsum("anm,anm->nm", off_px, off_px) < reach
        if self.hidden is not None:
            is_near &= ~self.hidden
        near = np.flatnonzero(is_near)
        line, star = np.divmod(near, len(point_px))
        length_px = np.maximum(self.length_px.ravel().take(near), 1e-9)
        along_x, along_y = (step.ravel().take(near) / length_px for step in self.step_px)
        off_x, off_y = (off.ravel().take(near) / sigma_px for off in off_px)
        s = off_x * along_x + off_y * along_y
        across = off_x * along_y - off_y * along_x
        weight = self.duration.take(line) if self.recorded is None else self.recorded.ravel().take(near)
        signal = weight * _density(s, length_px / sigma_px) * np.exp(-0.5 * across * across)
        if transmission is not None:
            signal *= transmission.ravel().take(near)
        summed = np.bincount(star, signal, minlength=len(point_px))
        return np.asarray(summed / (np.sqrt(2 * np.pi) * sigma_px**2))


def line_chains(
    scene: Scene, direction_eq: Float, nodes_px: Float | None = None, recorded: RecordedTimes | None = None
) -> Iterator[LineChain]:
    """Yield the chain of each short exposure of a stacked image, or of the exposure, while its rows are open.

    Parameters
    ----------
    scene : Scene
    direction_eq : (m, 3) float64
        Geocentric apparent unit vectors, true equator and equinox.
    nodes_px : (2, n, m) float64, optional
        Their `ConicPaths.nodes_px`, if these are known.
    recorded : RecordedTimes, optional
        When a rolling shutter records them; without it the times are those of the lines.

    Yields
    ------
    LineChain
    """
    trails = scene.trails if scene.listing is None else scene.listing.trails
    if not isinstance(trails, StackedTrails):
        xy_px, duration = _path(scene, trails, direction_eq, nodes_px)
        yield LineChain.of(*_while_open(scene, xy_px, duration, recorded))
        return
    rows = [None] * len(trails.shorts) if recorded is None else recorded.shorts
    for short, times in zip(trails.shorts, rows, strict=True):
        xy_px, duration = _path(scene, short, direction_eq, None)
        yield LineChain.of(*_while_open(scene, xy_px, duration / len(trails.shorts), times))


def _path(scene: Scene, trails: TrailModel, direction_eq: Float, nodes_px: Float | None) -> tuple[Float, Float]:
    """Return positions along paths, (2, n, m) px, and the fractions of the exposure between them, (n - 1,)."""
    if isinstance(trails, AnalyticSegments) and 2 * len(trails) >= _MIN_PARTS:
        if nodes_px is None:
            nodes_px = np.moveaxis(scene.camera.project(trails.pointing.to_camera(direction_eq)), -1, 0)
        return nodes_px, np.repeat(trails.time_fraction / 2, 2)
    if isinstance(trails, AnalyticSegments):
        parts = 2 * -(-_MIN_PARTS // (2 * len(trails)))
        weight = np.repeat(trails.time_fraction / parts, parts)
        times = np.concatenate([[0.0], np.cumsum(weight)])
        xy_px = trails.positions(scene.camera, direction_eq, np.minimum(times, 1.0))
        return np.moveaxis(xy_px, -1, 0), weight
    xy_px = np.moveaxis(scene.camera.project(trails.pointing.to_camera(direction_eq)), -1, 0)
    xy_px = np.concatenate([xy_px, xy_px[:, -1:]], axis=1)
    return xy_px, np.full(xy_px.shape[1] - 1, 1 / (xy_px.shape[1] - 1))


def _while_open(
    scene: Scene, xy_px: Float, duration: Float, recorded: RecordedTimes | None
) -> tuple[Float, Float, Float | None]:
    """Return the arguments of `LineChain.of`: under a rolling shutter, the path between a star's opening and closing.

    What is before and after is left as lines of no length and no light.
    """
    exposure = scene.exposure.first
    if exposure.readout_s == 0:
        return xy_px, duration, None
    share = duration.sum()
    ends_s = (exposure.span_s / share) * np.concatenate([[0.0], np.cumsum(duration)])
    times = OpenPath.along(xy_px, ends_s, exposure, scene.camera) if recorded is None else OpenPath.of(recorded)
    ends_s = ends_s[:, np.newaxis]
    # Most of the path is between the opening and the closing of all stars.
    before = slice(0, int(np.searchsorted(ends_s[:, 0], times.opens_s.max(initial=0.0))))
    after = slice(int(np.searchsorted(ends_s[:, 0], times.closes_s.min(initial=np.inf), side="right")), None)
    xy_px = xy_px.copy()
    xy_px[:, before] = np.where(ends_s[before] < times.opens_s, times.first_px[:, np.newaxis], xy_px[:, before])
    xy_px[:, after] = np.where(ends_s[after] > times.closes_s, times.last_px[:, np.newaxis], xy_px[:, after])
    open_s = np.diff(ends_s.clip(times.opens_s, times.closes_s), axis=0)
    open_s *= share / np.maximum(times.closes_s - times.opens_s, 1e-12)
    return xy_px, duration, open_s


def _density(s: Float, length: Float) -> Float:
    """Return the light per sigma of lines at a distance s from their middles along them; lengths in sigma."""
    density = np.empty_like(s)
    is_short = length < _SHORT_SIGMA
    short, long = np.flatnonzero(is_short), np.flatnonzero(~is_short)
    size = length.take(short)
    variance = 1 + size * size / 12
    off = s.take(short)
    density[short] = np.exp(-0.5 * off * off / variance) / np.sqrt(2 * np.pi * variance)
    size, at = length.take(long), s.take(long)
    density[long] = (normal_cumulative(at + size / 2) - normal_cumulative(at - size / 2)) / size
    return density


def normal_cumulative(z: Float) -> Float:
    """Return the cumulative distribution of the unit Gaussian.

    Parameters
    ----------
    z : (...) float64

    Returns
    -------
    (...) float64
        To 1e-7.

    Notes
    -----
    Abramowitz & Stegun, 26.2.17.
    """
    t = 1 / (1 + 0.2316419 * np.abs(z))
    polynomial = t * (0.319381530 + t * (-0.356563782 + t * (1.781477937 + t * (-1.821255978 + t * 1.330274429))))
    tail = np.exp(-0.5 * z * z) / np.sqrt(2 * np.pi) * polynomial
    return np.asarray(np.where(z < 0, tail, 1 - tail))
