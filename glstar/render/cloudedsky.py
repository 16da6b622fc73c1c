"""Stars and bodies behind cloud and ridges: what arrives of each segment or sub-exposure of their trails."""

from dataclasses import dataclass, replace
from typing import Final, Self

import numpy as np
from numpy.typing import NDArray

from glstar.camera.exposure import Exposure
from glstar.camera.model import Camera
from glstar.camera.sensor import Sensor
from glstar.render.bodysources import BodySources
from glstar.render.cameramotion import CameraMotion
from glstar.render.clouds import CloudPassage, cloud_passage, cloud_sheet
from glstar.render.culling import DrawList, TouchingStars
from glstar.render.ridges import divided, ridge_parts, ridge_passage, ridge_times
from glstar.render.scene import Scene
from glstar.render.trailmodels import AnalyticSegments
from glstar.sky.cloudsheet import CloudSheet
from glstar.sky.starfield import StarField

__all__ = ["CloudedSky", "scene_passage"]

Float = NDArray[np.float64]

# Segments are divided until no star's transmission changes by more than this within one.
_LARGEST_CHANGE: Final = 0.04
# Parts of a segment at most.
_MAX_PARTS: Final = 32


@dataclass(frozen=True, slots=True, eq=False)
class CloudedSky:
    """What a sheet of cloud and a horizon profile leave of the stars during one exposure.

    Attributes
    ----------
    sheet : CloudSheet or None
    motion : CameraMotion
        With the profile in its sky.
    exposure : Exposure
    px_per_rad : float
        Scale of the image.
    """

    sheet: CloudSheet | None
    motion: CameraMotion
    exposure: Exposure
    px_per_rad: float

    @classmethod
    def of(cls, motion: CameraMotion, camera: Camera, sensor: Sensor, exposure: Exposure) -> Self | None:
        """Return the sky over a camera; None without cloud and without a horizon profile."""
        sheet = cloud_sheet(sensor, motion)
        if sheet is None and motion.sky.profile is None:
            return None
        return cls(sheet, motion, exposure, max(camera.fx_px, camera.fy_px))

    def _passages(self, direction_eq: Float) -> tuple[CloudPassage | None, CloudPassage | None]:
        """Return what cloud transmits of stars, and the part of the time in which they are above the profile."""
        if self.motion.sky.profile is None:
            assert self.sheet is not None
            return cloud_passage(self.sheet, self.motion, self.exposure, direction_eq), None
        times = ridge_times(self.exposure, self.px_per_rad)
        if self.sheet is None:
            return None, ridge_passage(self.motion, self.exposure, direction_eq, times)
        cloud = cloud_passage(self.sheet, self.motion, self.exposure, direction_eq, times)
        return cloud, ridge_passage(self.motion, self.exposure, direction_eq, len(cloud.transmission))

    def divided_at_ridges(
        self, trails: AnalyticSegments, touching: TouchingStars, bodies: BodySources | None
    ) -> AnalyticSegments:
        """Return trails of shorter segments where a star or a body sets or rises behind the horizon profile.

        Parameters
        ----------
        trails : AnalyticSegments
        touching : TouchingStars
            The stars that may touch the image.
        bodies : BodySources or None

        Returns
        -------
        AnalyticSegments
        """
        directions = _directions(touching.culler.stars, touching.index, bodies)
        if self.motion.sky.profile is None or not len(directions):
            return trails
        ridge = ridge_passage(self.motion, self.exposure, directions, ridge_times(self.exposure, self.px_per_rad))
        return divided(trails, ridge_parts(ridge, self.exposure, trails.time_fraction, self.px_per_rad))

    def passage(self, stars: StarField, draw_list: DrawList) -> CloudPassage:
        """Return what arrives of the stars of a draw list over the exposure."""
        return _product(*self._passages(stars.direction_eq[draw_list.index]))

    def dimmed(self, stars: StarField, draw_list: DrawList, time_fraction: Float) -> DrawList:
        """Return a draw list with its passage.

        Parameters
        ----------
        stars : StarField
        draw_list : DrawList
        time_fraction : (s,) float64
            Durations of the segments or sub-exposures; they add up to 1.

        Returns
        -------
        DrawList
        """
        if not len(draw_list):
            return draw_list
        return _with_passage(draw_list, self.passage(stars, draw_list), time_fraction)

    def dimmed_bodies(self, bodies: BodySources | None, time_fraction: Float) -> BodySources | None:
        """Return bodies whose draw list has its passage."""
        if bodies is None:
            return None
        return replace(bodies, draw_list=self.dimmed(bodies.stars, bodies.draw_list, time_fraction))

    def behind(
        self, trails: AnalyticSegments, stars: StarField, draw_list: DrawList, bodies: BodySources | None
    ) -> tuple[AnalyticSegments, DrawList, BodySources | None]:
        """Return analytic trails, the stars and the bodies with their passage.

        Parameters
        ----------
        trails : AnalyticSegments
        stars : StarField
        draw_list : DrawList
        bodies : BodySources or None

        Returns
        -------
        trails : AnalyticSegments
            Of shorter segments, where the transmission changes much within one.
        draw_list : DrawList
        bodies : BodySources or None
        """
        directions = _directions(stars, draw_list.index, bodies)
        if not len(directions):
            return trails, draw_list, bodies
        cloud, ridge = self._passages(directions)
        parts = np.ones(len(trails), dtype=np.intp)
        if cloud is not None:
            changes = np.ceil(_largest_changes(cloud, trails.time_fraction) / _LARGEST_CHANGE)
            parts = changes.clip(1, _MAX_PARTS).astype(np.intp)
        if ridge is not None:
            parts = np.maximum(parts, ridge_parts(ridge, self.exposure, trails.time_fraction, self.px_per_rad))
        trails, passage = divided(trails, parts), _product(cloud, ridge)
        first, last = (CloudPassage(part) for part in np.split(passage.transmission, [len(draw_list)], axis=1))
        if len(draw_list):
            draw_list = _with_passage(draw_list, first, trails.time_fraction)
        if bodies is not None and len(bodies.draw_list):
            bodies = replace(bodies, draw_list=_with_passage(bodies.draw_list, last, trails.time_fraction))
        return trails, draw_list, bodies


def _directions(stars: StarField, index: NDArray[np.int32], bodies: BodySources | None) -> Float:
    """Return the directions of some stars and of the sources of bodies, (m, 3)."""
    directions = stars.direction_eq[index]
    if bodies is None:
        return directions
    return np.concatenate([directions, bodies.stars.direction_eq[bodies.draw_list.index]])


def _product(cloud: CloudPassage | None, ridge: CloudPassage | None) -> CloudPassage:
    """Return what arrives of stars behind cloud and a horizon profile, one of which may be missing."""
    if cloud is None or ridge is None:
        whole = cloud or ridge
        assert whole is not None
        return whole
    return CloudPassage(cloud.transmission * ridge.transmission)


def _with_passage(draw_list: DrawList, passage: CloudPassage, time_fraction: Float) -> DrawList:
    return replace(draw_list, passage=np.ascontiguousarray(passage.means(time_fraction).T, dtype=np.float32))


def _largest_changes(passage: CloudPassage, time_fraction: Float) -> Float:
    """Return by how much the transmission changes most within each segment, (s,)."""
    changes = np.abs(np.diff(passage.transmission, axis=0)).max(axis=1)
    along = np.concatenate([[0.0], np.cumsum(changes)])
    ends = np.concatenate([[0.0], np.cumsum(time_fraction)])
    return np.asarray(np.diff(np.interp(ends / ends[-1], np.linspace(0, 1, len(along)), along)))


def scene_passage(scene: Scene, direction_eq: Float) -> CloudPassage | None:
    """Return what cloud transmits of stars over the exposure of a scene.

    Parameters
    ----------
    scene : Scene
    direction_eq : (m, 3) float64
        Geocentric apparent unit vectors, true equator and equinox.

    Returns
    -------
    CloudPassage or None
        Of a stacked image, from the start of the first short exposure to the end of the last; None without cloud.
    """
    sheet = cloud_sheet(scene.sensor, scene.motion)
    if sheet is None or scene.motion is None:
        return None
    return cloud_passage(sheet, scene.motion, scene.exposure, direction_eq)
