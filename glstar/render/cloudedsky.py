"""Stars and bodies behind a sheet of cloud: the transmission of each segment or sub-exposure of their trails."""

from dataclasses import dataclass, replace
from typing import Final, Self

import numpy as np
from numpy.typing import NDArray

from glstar.camera.exposure import Exposure
from glstar.camera.sensor import Sensor
from glstar.render.bodysources import BodySources
from glstar.render.cameramotion import CameraMotion
from glstar.render.clouds import CloudPassage, cloud_passage, cloud_sheet
from glstar.render.culling import DrawList
from glstar.render.pointing import Pointing
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
    """A sheet of cloud during one exposure.

    Attributes
    ----------
    sheet : CloudSheet
    motion : CameraMotion
    exposure : Exposure
    """

    sheet: CloudSheet
    motion: CameraMotion
    exposure: Exposure

    @classmethod
    def of(cls, motion: CameraMotion, sensor: Sensor, exposure: Exposure) -> Self | None:
        """Return the cloud over a camera; None without cloud."""
        sheet = cloud_sheet(sensor, motion)
        return None if sheet is None else cls(sheet, motion, exposure)

    def passage(self, stars: StarField, draw_list: DrawList) -> CloudPassage:
        """Return the transmission for the stars of a draw list over the exposure."""
        return cloud_passage(self.sheet, self.motion, self.exposure, stars.direction_eq[draw_list.index])

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
        directions = stars.direction_eq[draw_list.index]
        if bodies is not None:
            directions = np.concatenate([directions, bodies.stars.direction_eq[bodies.draw_list.index]])
        if not len(directions):
            return trails, draw_list, bodies
        passage = cloud_passage(self.sheet, self.motion, self.exposure, directions)
        parts = (
            np.ceil(_largest_changes(passage, trails.time_fraction) / _LARGEST_CHANGE)
            .clip(1, _MAX_PARTS)
            .astype(np.intp)
        )
        trails = trails if parts.max() == 1 else _divided(trails, parts)
        first, last = (CloudPassage(part) for part in np.split(passage.transmission, [len(draw_list)], axis=1))
        if len(draw_list):
            draw_list = _with_passage(draw_list, first, trails.time_fraction)
        if bodies is not None and len(bodies.draw_list):
            bodies = replace(bodies, draw_list=_with_passage(bodies.draw_list, last, trails.time_fraction))
        return trails, draw_list, bodies


def _with_passage(draw_list: DrawList, passage: CloudPassage, time_fraction: Float) -> DrawList:
    return replace(draw_list, passage=np.ascontiguousarray(passage.means(time_fraction).T, dtype=np.float32))


def _largest_changes(passage: CloudPassage, time_fraction: Float) -> Float:
    """Return by how much the transmission changes most within each segment, (s,)."""
    changes = np.abs(np.diff(passage.transmission, axis=0)).max(axis=1)
    along = np.concatenate([[0.0], np.cumsum(changes)])
    ends = np.concatenate([[0.0], np.cumsum(time_fraction)])
    return np.asarray(np.diff(np.interp(ends / ends[-1], np.linspace(0, 1, len(along)), along)))


def _divided(trails: AnalyticSegments, parts: NDArray[np.intp]) -> AnalyticSegments:
    """Return trails along the same conics, each segment divided into some equal parts."""
    pointing = trails.pointing
    segment = np.repeat(np.arange(len(parts)), 2 * parts)
    first = np.repeat(np.cumsum(2 * parts) - 2 * parts, 2 * parts)
    elapsed = (np.arange(len(segment)) - first) / (2 * parts[segment])
    u, weight = elapsed[:, np.newaxis, np.newaxis], trails.end_weight[segment][:, np.newaxis, np.newaxis]
    C = pointing.C_camera_eq
    start, middle, end = C[2 * segment] * weight, C[2 * segment + 1], C[2 * segment + 2] * weight
    between = start + u * (4 * middle - 3 * start - end + u * 2 * (start - 2 * middle + end))
    between /= np.linalg.norm(between, axis=2, keepdims=True).mean(axis=1, keepdims=True)
    zenith, velocity = (_between(v, segment, elapsed) for v in (pointing.zenith_eq, pointing.velocity_eq))
    fine = Pointing(
        np.concatenate([between, C[-1:]]),
        np.concatenate([zenith / np.linalg.norm(zenith, axis=1, keepdims=True), pointing.zenith_eq[-1:]]),
        np.concatenate([velocity, pointing.velocity_eq[-1:]]),
        pointing.refraction_scale,
        pointing.sine_horizon,
    )
    return AnalyticSegments(fine, np.repeat(trails.time_fraction / parts, parts))


def _between(vectors: Float, segment: NDArray[np.intp], elapsed: Float) -> Float:
    """Return vectors between those at the ends of segments."""
    part = elapsed[:, np.newaxis]
    return np.asarray((1 - part) * vectors[2 * segment] + part * vectors[2 * segment + 2])


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
