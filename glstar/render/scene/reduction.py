"""Faint long trails at half and at a quarter of the image's resolution.

A trail takes time with its length and not with its brightness.  A trail that is faint everywhere is drawn on pixels two
or four times as wide, and interpolated linearly between wide pixels.  Its light stays, and its profile changes by as
small a part of its peak as the cut around a star.
"""

from collections.abc import Iterable, Sequence
from dataclasses import replace
from functools import lru_cache
from math import ceil, hypot, sqrt
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from glstar.camera.model import Camera
from glstar.camera.sensor.pointspread import TRUNCATION_DN, PsfComponent
from glstar.camera.sensor.sensor import Sensor
from glstar.render.motion.pointing import MotionTable, Pointing
from glstar.render.motion.starpaths import parameter_at
from glstar.render.motion.trailmodels import AnalyticSegments
from glstar.render.scene.bodies import BODIES
from glstar.render.scene.scene import Scene
from glstar.render.scene.starcomponents import drawn_peak_dn

# Widths of reduced pixels, px, the finest first.
SCALES = (2, 4)
# Largest error of the profile of a long trail, relative to its peak, by the width of reduced pixels and the star's
# standard deviation in them: of slanted and upright trails at any position, with `drawn_variance_px2`.
_WIDTHS = (0.25, 0.31, 0.375, 0.5, 0.62, 0.75, 1.0, 1.25, 1.5, 2.0, 2.5, 4.0)
_ERRORS = {
    2: (0.67, 0.59, 0.50, 0.34, 0.20, 0.12, 0.065, 0.041, 0.028, 0.016, 0.010, 0.004),
    4: (0.70, 0.62, 0.55, 0.39, 0.25, 0.16, 0.090, 0.056, 0.039, 0.022, 0.014, 0.0055),
}
# Largest error of a trail, DN.
LARGEST_ERROR_DN = TRUNCATION_DN
# Variance of what is drawn in units of a reduced pixel squared: from 0.35 on, samples of a Gaussian add up to its flux
# within 0.2 %, wherever they lie.
_MIN_VARIANCE = 0.35
# Part of the variance of linear interpolation, 1/6 of a reduced pixel squared, by which a star is drawn narrower.
_NARROWING = 0.4 / 6
# Length of a long trail, standard deviations.
_LONG_SIGMA = 6.0
# Costs in px of the length of trails, measured on Mesa llvmpipe: both ends of a trail; what is done once a frame; and
# the interpolation of each pixel.
_PER_STAR_PX, _FIXED_PX, _PER_PIXEL = 60.0, 150_000.0, 0.55
# The fewest stars on the widest pixels; fewer are drawn with those on finer ones.
_FEWEST = 100
# How many segments become one, by the width of pixels.  Errors grow as the third power: at most 0.4 % of the trail and
# 0.02 px become 3 % and 0.16 px, where interpolation changes the profile by a half.
_FEWER = {2: 1, 4: 2}
# Largest distance between paths in fewer segments and the same paths in all of them, reduced px.
_LARGEST_DISTANCE_PX = 0.05


class ReducedScenes(NamedTuple):
    """Scenes of one Gaussian per star, divided by the resolution at which they are drawn."""

    full: tuple[Scene, ...]
    # By the width of a pixel, px: scenes with the camera and the sensor of wide pixels; empty where that saves nothing.
    reduced: dict[int, tuple[Scene, ...]]


def reduced_scenes(scenes: Iterable[Scene]) -> ReducedScenes:
    """Return scenes of one Gaussian per star, `starcomponents.gaussian_scenes`, divided by resolution."""
    scenes = tuple(scenes)
    widths_px = [_pixel_widths(scene) for scene in scenes]
    if not _are_worth_reducing(scenes, widths_px):
        return ReducedScenes(scenes, {})
    divided = {
        scale: tuple(
            _of_stars(scene, of_stars == scale, scale)
            for scene, of_stars in zip(scenes, widths_px, strict=True)
            if scale == 1 or (of_stars == scale).any()
        )
        for scale in (1, *SCALES)
    }
    full = divided.pop(1)
    return ReducedScenes(full, {scale: of_scale for scale, of_scale in divided.items() if of_scale})


def reduced_camera(camera: Camera, scale: int) -> Camera:
    """Return a camera with pixels `scale` times as wide, the first of which begins at the corner of the image."""
    return Camera(
        ceil(camera.width_px / scale),
        ceil(camera.height_px / scale),
        camera.fx_px / scale,
        camera.fy_px / scale,
        (camera.cx_px + 0.5) / scale - 0.5,
        (camera.cy_px + 0.5) / scale - 0.5,
        camera.skew_px / scale,
        camera.lens,
    )


def _pixel_widths(scene: Scene) -> NDArray[np.int8]:
    """Return the width of the pixels that each star of the draw list is drawn on, (k,) px: 1, 2 or 4."""
    drawn, sensor = scene.draw_list, scene.sensor
    widths_px = np.ones(len(drawn), np.int8)
    is_plain = scene.stars.catalogue != BODIES and sensor.colour.mosaic == "none"
    if not (is_plain and isinstance(scene.trails, AnalyticSegments) and len(drawn)):
        return widths_px
    sigma_px = sensor.effective_sigma_px
    is_long = drawn.min_trail_px > _LONG_SIGMA * sigma_px
    peak_dn = sensor.max_trail_peak_dn(drawn_peak_dn(scene), drawn.min_trail_px)
    for scale in SCALES:
        error = np.interp(sigma_px / scale, _WIDTHS, _ERRORS[scale], left=np.inf)
        is_faint = is_long & (error * peak_dn < LARGEST_ERROR_DN)
        if scale == SCALES[0] or np.count_nonzero(is_faint) >= _FEWEST:
            widths_px[is_faint] = scale
    return widths_px


def _are_worth_reducing(scenes: Sequence[Scene], widths_px: Sequence[NDArray[np.int8]]) -> bool:
    """Return whether drawing stars on pixels of these widths saves more than it costs."""
    if not scenes:
        return False
    camera = scenes[0].camera
    diagonal_px = hypot(camera.width_px, camera.height_px)
    saved_px = sum(
        float((np.minimum(scene.draw_list.min_trail_px[of_stars > 1], diagonal_px) + _PER_STAR_PX).sum())
        for scene, of_stars in zip(scenes, widths_px, strict=True)
    )
    return saved_px > _FIXED_PX + _PER_PIXEL * camera.width_px * camera.height_px


def _of_stars(scene: Scene, stars: NDArray[np.bool_], scale: int) -> Scene:
    """Return the scene with some of its stars, drawn on pixels of some width."""
    draw_list = scene.draw_list[stars]
    if scale == 1:
        return replace(scene, draw_list=draw_list)
    trail_px = draw_list.min_trail_px / scale
    assert isinstance(scene.trails, AnalyticSegments)
    camera = _reduced_camera(scene.camera, scale)
    reduced = replace(
        scene,
        camera=camera,
        trails=scene.trails
        if draw_list.passage is not None
        else _in_fewer_segments(scene.trails, camera.max_px_per_rad, _FEWER[scale]),
        sensor=_reduced_sensor(scene.sensor, scale),
        draw_list=replace(draw_list, min_trail_px=trail_px),
    )
    radius_px = reduced.sensor.truncation_radius_px(drawn_peak_dn(reduced), trail_px, renormalized=True)
    return replace(reduced, draw_list=replace(reduced.draw_list, truncation_radius_px=radius_px))


def _in_fewer_segments(trails: AnalyticSegments, px_per_rad: float, fraction: int) -> AnalyticSegments:
    """Return trails in a fraction of the segments, of equal durations, where paths stay within a part of a pixel.

    Otherwise returns the same.
    """
    count = -(-len(trails) // fraction)
    if count == len(trails):
        return trails
    table = MotionTable(trails.marks, trails.pointing)
    fewer = AnalyticSegments(_upright(table.at(np.linspace(0.0, 1.0, 2 * count + 1))), np.full(count, 1 / count))
    quarters = (np.arange(2 * count) + 0.5) / (2 * count)
    off_rad = _distance_rad(fewer, _upright(table.at(quarters)))
    return fewer if off_rad * px_per_rad < _LARGEST_DISTANCE_PX else trails


def _upright(pointing: Pointing) -> Pointing:
    """Return a pointing with matrices of the size of rotations."""
    C = pointing.C_camera_eq
    return replace(pointing, C_camera_eq=C * (sqrt(3) / np.linalg.norm(C, axis=(1, 2), keepdims=True)))


def _distance_rad(trails: AnalyticSegments, quarters: Pointing) -> float:
    """Return the largest angle between the camera's orientations of trails and true ones.

    `quarters`: the true ones after a quarter and three quarters of each segment.
    """
    weight = np.repeat(trails.end_weight, 2)[:, np.newaxis, np.newaxis]
    elapsed = np.tile([0.25, 0.75], len(trails))[:, np.newaxis, np.newaxis]
    C, u = trails.pointing.C_camera_eq, parameter_at(elapsed, weight)
    start, middle, end = (np.repeat(of, 2, axis=0) for of in (C[:-2:2], C[1::2], C[2::2]))
    start, end = start * weight, end * weight
    along = start + u * (4 * middle - 3 * start - end + 2 * u * (start - 2 * middle + end))
    along *= sqrt(3) / np.linalg.norm(along, axis=(1, 2), keepdims=True)
    return float(np.linalg.norm(along - quarters.C_camera_eq, axis=(1, 2)).max()) / sqrt(2)


# Every scene of a flight has the same camera.
_reduced_camera = lru_cache(maxsize=64)(reduced_camera)


def _reduced_sensor(sensor: Sensor, scale: int) -> Sensor:
    """Return the sensor with which stars leave the same light per pixel of the image on wider pixels."""
    sigma_px = sqrt(drawn_variance_px2(sensor.effective_sigma_px, scale)) / scale
    return replace(sensor.of_component(PsfComponent(1 / scale**2, sigma_px)), pixel="sampled")


def drawn_variance_px2(sigma_px: float, scale: int) -> float:
    """Return the variance of a star as it is drawn on wider pixels, px^2."""
    return max(sigma_px**2 - _NARROWING * scale**2, _MIN_VARIANCE * scale**2)
