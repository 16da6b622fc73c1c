"""The two trail models: an exposure is summed from sub-exposures, or integrated analytically over segments.

A `TrailModel` holds the camera's orientation over one exposure in the form that its renderer pass consumes, and
computes from the same numbers where each star is drawn: truth and overlays use that.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from math import ceil
from typing import Final, Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from glstar.camera.model import Camera
from glstar.render.pointing import Pointing
from glstar.render.starpaths import ConicPaths, SampledPaths, end_weights

__all__ = ["SAMPLE_SPACING_SIGMA", "AnalyticSegments", "SubExposureRule", "SubExposures", "TrailModel"]

Float = NDArray[np.float64]

# Distance between sub-exposures along a trail, sigma: a sampling ripple of 0.03 % at 1.5 sigma, 1.4 % at 2, 22 % at 3.
SAMPLE_SPACING_SIGMA: Final = 1.5


class TrailModel(Protocol):
    """How the stars move over one exposure."""

    @property
    def pointing(self) -> Pointing:
        """The camera's orientation at the times that the model is built on."""
        ...

    def __len__(self) -> int:
        """Return the number of sub-exposures or segments."""
        ...

    def positions(self, camera: Camera, direction_eq: ArrayLike, time: Float) -> Float:
        """Return where stars are drawn at some times of the exposure.

        Parameters
        ----------
        camera : Camera
        direction_eq : (m, 3) array_like
            Geocentric apparent unit vectors, true equator and equinox.
        time : (n,) float64
            Elapsed fraction of the exposure, 0 to 1.

        Returns
        -------
        (n, m, 2) float64
            Positions (x, y), px; NaN behind the camera and below the horizon.
        """
        ...

    def star_paths(
        self, camera: Camera, direction_eq: ArrayLike, sigma_px: float
    ) -> Iterator[SampledPaths | ConicPaths]:
        """Yield the paths of stars as they are drawn, in one or several consecutive parts of the exposure.

        Parameters
        ----------
        camera : Camera
        direction_eq : (m, 3) array_like
            Geocentric apparent unit vectors, true equator and equinox.
        sigma_px : float
            Standard deviation of a star as the pixels record it, px; it sets the spacing of samples.

        Yields
        ------
        SampledPaths or ConicPaths
            All the stars over a part of the exposure.
        """
        ...


@dataclass(frozen=True, slots=True, eq=False)
class SubExposures:
    """A trail as the sum of n sub-exposures of equal length; the stars do not move during a sub-exposure.

    Attributes
    ----------
    pointing : Pointing
        In the middle of each sub-exposure: n times.

    Notes
    -----
    Teague & Chahl, section 2.6.
    """

    pointing: Pointing

    def __len__(self) -> int:
        return len(self.pointing)

    def positions(self, camera: Camera, direction_eq: ArrayLike, time: Float) -> Float:
        """Return where stars are drawn in the sub-exposures that contain some times: see `TrailModel.positions`."""
        index = np.minimum((time * len(self)).astype(np.intp), len(self) - 1)
        return camera.project(self.pointing.to_camera(direction_eq))[index]

    def for_sigma(self, camera: Camera, sigma_px: float) -> "SubExposures":
        """Return fewer sub-exposures that suffice for a wide point spread function.

        Parameters
        ----------
        camera : Camera
        sigma_px : float
            Standard deviation of a star in the image, px.

        Returns
        -------
        SubExposures
            The middle of each group of equal number; neighbouring ones differ by at most 1.5 sigma.
        """
        path_px = np.concatenate([[0.0], np.cumsum(self.pointing.rotation_rad)]) * camera.max_px_per_rad
        limit_px = SAMPLE_SPACING_SIGMA * sigma_px
        group = 1
        for k in (k for k in range(2, len(self) + 1) if len(self) % k == 0):
            within_px = path_px[k - 1 :: k] - path_px[::k]
            group = k if within_px.max() <= limit_px * (k - 1) / k else group
        return self if group == 1 else SubExposures(self._middles(group))

    def _middles(self, group: int) -> Pointing:
        """Return the orientations in the middle of groups of sub-exposures."""
        first, last = slice((group - 1) // 2, None, group), slice(group // 2, None, group)
        if group % 2:
            return self.pointing[first]
        # The mean of two orientations: they differ by less than a milliradian.
        early, late = self.pointing[first], self.pointing[last]
        means = {
            name: (getattr(early, name) + getattr(late, name)) / 2
            for name in ("C_camera_eq", "zenith_eq", "velocity_eq")
        }
        return replace(self.pointing, **means)

    def star_paths(
        self,
        camera: Camera,
        direction_eq: ArrayLike,
        sigma_px: float,  # noqa: ARG002 - the protocol's
    ) -> Iterator[SampledPaths]:
        """Yield the positions in each sub-exposure: see `TrailModel.star_paths`."""
        for block in self.pointing.blocks(len(np.asarray(direction_eq))):
            xy = camera.project(block.to_camera(direction_eq))
            yield SampledPaths(np.moveaxis(xy, -1, 0), np.full(len(block), 1 / len(self)), is_at_rest=True)


@dataclass(frozen=True, slots=True, eq=False)
class AnalyticSegments:
    """A trail as m segments, along each of which the flux is integrated in closed form: see `segmentation`.

    Attributes
    ----------
    pointing : Pointing
        At the start, the middle and the end of the first segment, which is the start of the second, and so on:
        2 m + 1 times.
    time_fraction : (m,) float64
        Duration of each segment as a fraction of the exposure; they add up to 1.
    half_fraction : (2 m,) float64 or None
        Durations of the halves of each segment, if they differ by the rounding of times.
    """

    pointing: Pointing
    time_fraction: Float
    half_fraction: Float | None = None

    def __len__(self) -> int:
        return len(self.time_fraction)

    @property
    def marks(self) -> Float:
        """Where segments begin and end, (m + 1,) fractions of the exposure."""
        return np.concatenate([[0.0], np.cumsum(self.time_fraction)])

    def half_fractions(self, span: float) -> Float:
        """Return the durations of the halves of each segment, (2 m,), given the sum of all in exposure times."""
        return np.repeat(self.time_fraction * (span / 2), 2) if self.half_fraction is None else self.half_fraction

    @property
    def end_weight(self) -> Float:
        """Projective weight of the ends of each segment, (m,): see `starpaths.end_weights`."""
        C = self.pointing.C_camera_eq
        return end_weights(C[:-2:2], C[2::2])

    def longest_trail_px(self, camera: Camera) -> float:
        """Return an upper bound of the length of any star's trail on the image, px."""
        return float(self.pointing.rotation_rad.sum() * camera.max_px_per_rad)

    def longest_segment_px(self, camera: Camera) -> float:
        """Return an upper bound of the length of any star's path on the image during a segment, px."""
        return float(self.pointing.rotation_rad.reshape(-1, 2).sum(axis=1).max() * camera.max_px_per_rad)

    def positions(self, camera: Camera, direction_eq: ArrayLike, time: Float) -> Float:
        """Return where stars are at some times: see `TrailModel.positions`."""
        ends = self.marks
        segment = np.searchsorted(ends, time, side="right").clip(1, len(ends) - 1) - 1
        paths = self._conic_paths(camera, direction_eq, spacing_px=np.inf)
        return paths.positions(segment, (time - ends[segment]) / self.time_fraction[segment])

    def star_paths(
        self, camera: Camera, direction_eq: ArrayLike, sigma_px: float
    ) -> Iterator[SampledPaths | ConicPaths]:
        """Yield conic paths, or behind a lens their samples every 1.5 sigma: see `TrailModel.star_paths`."""
        paths = self._conic_paths(camera, direction_eq, SAMPLE_SPACING_SIGMA * sigma_px)
        if camera.lens is None:
            yield from paths.pieces()
            return
        for xy, time_fraction in paths.samples(np.arange(paths.nodes.shape[2])):
            yield SampledPaths(np.moveaxis(xy, -1, 0), time_fraction)

    def _conic_paths(self, camera: Camera, direction_eq: ArrayLike, spacing_px: float) -> ConicPaths:
        nodes = self.pointing.to_camera(direction_eq).transpose(2, 0, 1)
        return ConicPaths(camera, nodes, self.end_weight, self.time_fraction, spacing_px)


@dataclass(frozen=True, slots=True)
class SubExposureRule:
    """How many sub-exposures an exposure takes, given the length of its longest trail.

    Attributes
    ----------
    min_count : int
        The number for stars that do not move.
    spacing_px : float
        Maximum distance between sub-exposures along a trail, px.
    """

    min_count: int
    spacing_px: float

    def count(self, trail_px: float) -> int:
        """Return the number of sub-exposures: max(min_count, ceil(trail / spacing)).

        Parameters
        ----------
        trail_px : float
            Length of the longest trail on the image, px.

        Returns
        -------
        int
        """
        return max(self.min_count, ceil(trail_px / self.spacing_px))
