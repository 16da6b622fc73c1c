"""Stars that set and rise behind a horizon profile during an exposure."""

from dataclasses import replace
from math import ceil
from typing import Final

import numpy as np
from numpy.typing import NDArray

from glstar.camera.exposure import Exposure
from glstar.render.cameramotion import CameraMotion
from glstar.render.clouds import CloudPassage
from glstar.render.trailmodels import AnalyticSegments
from glstar.sky.observed import SIDEREAL_RAD_PER_S

__all__ = ["divided", "ridge_parts", "ridge_passage", "ridge_times"]

Float = NDArray[np.float64]

# Between the times at which the height of stars above the horizon is computed, they move by this at most, px.
_STEP_PX: Final = 0.1
# These times at least and at most.
_MIN_TIMES, _MAX_TIMES = 5, 513
# Segments in which a star sets or rises are divided into parts in which stars move by this at most, px.
_PART_PX: Final = 0.05
# Parts of such a segment at least and at most: a star that hardly moves may set too.
_MIN_PARTS, _MAX_PARTS = 16, 512


def _set_px(exposure: Exposure, px_per_rad: float) -> float:
    """Return by how much stars move with respect to the ground during an exposure, px."""
    return SIDEREAL_RAD_PER_S * (exposure.stop_utc_s - exposure.start_utc_s) * px_per_rad


def ridge_times(exposure: Exposure, px_per_rad: float) -> int:
    """Return at how many times the height of stars above a horizon profile has to be computed.

    Parameters
    ----------
    exposure : Exposure
    px_per_rad : float
        Scale of the image.

    Returns
    -------
    int
    """
    return int(np.clip(ceil(_set_px(exposure, px_per_rad) / _STEP_PX) + 1, _MIN_TIMES, _MAX_TIMES))


def ridge_passage(motion: CameraMotion, exposure: Exposure, direction_eq: Float, times: int) -> CloudPassage:
    """Return the part of the time in which stars are above a horizon profile.

    Parameters
    ----------
    motion : CameraMotion
        Of the flight, with a profile in its sky.
    exposure : Exposure
        A single one.
    direction_eq : (m, 3) float64
        Geocentric apparent unit vectors, true equator and equinox.
    times : int
        Number of equidistant times, n.

    Returns
    -------
    CloudPassage
        At each time the part of the half intervals before and after it in which a star is up, if its height above the
        horizon changes linearly in each.  So the integral over the exposure is exact.
    """
    (pointing,) = motion.pointings(np.linspace(exposure.start_utc_s, exposure.stop_utc_s, times))
    height = pointing.clearance(direction_eq)
    middle = (height[1:] + height[:-1]) / 2
    before, after = _part_above(middle, height[1:]), _part_above(height[:-1], middle)
    inside = (before[:-1] + after[1:]) / 2
    return CloudPassage(np.concatenate([after[:1], inside, before[-1:]]))


def _part_above(first: Float, last: Float) -> Float:
    """Return the part in which a quantity is positive that changes linearly from one value to another."""
    low, high = np.minimum(first, last), np.maximum(first, last)
    span = high - low
    part = (high.clip(min=0.0) - low.clip(min=0.0)) / np.where(span > 0, span, 1.0)
    return np.where(span > 0, part, np.where(low >= 0, 1.0, 0.0))


def ridge_parts(passage: CloudPassage, exposure: Exposure, time_fraction: Float, px_per_rad: float) -> NDArray[np.intp]:
    """Return into how many equal parts segments are divided, so that trails end at the ridge.

    Parameters
    ----------
    passage : CloudPassage
        Of `ridge_passage`.
    exposure : Exposure
    time_fraction : (s,) float64
        Durations of the segments; they add up to 1.
    px_per_rad : float
        Scale of the image.

    Returns
    -------
    (s,) intp
        1 where no star sets or rises.
    """
    parts = np.ceil(_set_px(exposure, px_per_rad) * time_fraction / _PART_PX).clip(_MIN_PARTS, _MAX_PARTS)
    changes = (np.diff(passage.transmission, axis=0) != 0).any(axis=1)
    before = np.concatenate([[0], np.cumsum(changes)])
    ends = np.concatenate([[0.0], np.cumsum(time_fraction)]) / time_fraction.sum() * len(changes)
    # Of all intervals that a segment touches.
    first, last = np.floor(ends[:-1] + 1e-9).astype(np.intp), np.ceil(ends[1:] - 1e-9).astype(np.intp)
    return np.where(before[last] > before[first], parts, 1).astype(np.intp)


def divided(trails: AnalyticSegments, parts: NDArray[np.intp]) -> AnalyticSegments:
    """Return trails along the same conics, each segment divided into some equal parts.

    Parameters
    ----------
    trails : AnalyticSegments
    parts : (s,) intp
        Of each segment.

    Returns
    -------
    AnalyticSegments
    """
    if parts.max() == 1:
        return trails
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
    unit_zenith = zenith / np.linalg.norm(zenith, axis=1, keepdims=True)
    pole = pointing.pole_eq
    fine = replace(
        pointing,
        C_camera_eq=np.concatenate([between, C[-1:]]),
        zenith_eq=np.concatenate([unit_zenith, pointing.zenith_eq[-1:]]),
        velocity_eq=np.concatenate([velocity, pointing.velocity_eq[-1:]]),
        pole_eq=None if pole is None else np.concatenate([_between(pole, segment, elapsed), pole[-1:]]),
    )
    return AnalyticSegments(fine, np.repeat(trails.time_fraction / parts, parts))


def _between(vectors: Float, segment: NDArray[np.intp], elapsed: Float) -> Float:
    """Return vectors between those at the ends of segments."""
    part = elapsed[:, np.newaxis]
    return np.asarray((1 - part) * vectors[2 * segment] + part * vectors[2 * segment + 2])
