"""A scene as a sum of scenes whose stars are plain Gaussians: how stars with wings are drawn."""

from dataclasses import replace
from math import hypot
from typing import Final

import numpy as np
from numpy.typing import NDArray

from glstar.camera.pointspread import PsfComponent
from glstar.camera.truncation import FAINTEST_COMPONENT_DN
from glstar.render.colourscenes import colours_used, drawn_peak_dn
from glstar.render.scene import Scene
from glstar.render.trailmodels import AnalyticSegments, SubExposures
from glstar.sky.starcolours import USUAL_BV

__all__ = ["gaussian_scenes", "psf_scale"]

# Stars whose widths differ by less than this are drawn together: with the mean of their range, 1 % from each.
_WIDTH_STEP: Final = 0.02


def psf_scale(
    scene: Scene, direction_eq: NDArray[np.float64], bv: NDArray[np.float64] | float = USUAL_BV
) -> NDArray[np.float64]:
    """Return the widths of stars over ``psf_sigma_px``, where they are in the middle of the exposure.

    Parameters
    ----------
    scene : Scene
    direction_eq : (k, 3) float64
        Geocentric apparent unit vectors, true equator and equinox.
    bv : (k,) float64 or float
        Colours B - V.

    Returns
    -------
    (k,) float64
        As drawn: in steps of 2 %.
    """
    psf, camera = scene.sensor.point_spread, scene.camera
    if not psf.varies:
        return np.ones(len(direction_eq))
    centre_px = np.array([camera.cx_px, camera.cy_px])
    xy_px = camera.project(scene.shutter[1:2].to_camera(direction_eq, below_horizon=True))[0]
    half_diagonal_px = hypot(camera.width_px, camera.height_px) / 2
    offset = (xy_px - centre_px) / half_diagonal_px
    # A star that is behind the camera then, or far outside the image, touches it near a corner.
    offset[np.isnan(offset).any(axis=1)] = 1.0
    offset /= np.maximum(np.linalg.norm(offset, axis=1, keepdims=True), 1.0)
    scale = psf.scale_at(offset, bv)
    steps = np.floor(np.log(scale) / np.log1p(_WIDTH_STEP))
    return np.asarray((1 + _WIDTH_STEP) ** (steps + 0.5))


def gaussian_scenes(scene: Scene) -> list[Scene]:
    """Return scenes that add up to a scene, each with one circular Gaussian per star.

    Parameters
    ----------
    scene : Scene

    Returns
    -------
    list of Scene
        The scene itself if its stars are plain Gaussians, and those of its bodies and satellites.  An offset of a
        Gaussian is an offset of the principal point.
    """
    bodies = scene.body_scene
    others = [*([] if bodies is None else [bodies]), *scene.satellites]
    return [one for part in (scene, *others) for one in _split(part)]


def _split(scene: Scene) -> list[Scene]:
    """Return scenes that add up to the stars of a scene."""
    psf = scene.sensor.point_spread
    if psf.is_gaussian:
        return [scene if scene.sensor.colour.mosaic == "none" else _with_radii(scene)]
    scales = psf_scale(scene, scene.stars.direction_eq[scene.visible], colours_used(scene.stars, scene.visible))
    made = []
    for scale in np.unique(scales).tolist():
        stars = scene.with_visible(scales == scale)
        for component in psf.components(scene.sensor.psf_sigma_px, scale=scale):
            one = _of_component(stars, component)
            if len(one.draw_list):
                made.append(one)
    return made


def _with_radii(scene: Scene) -> Scene:
    """Return a scene of plain Gaussians, each drawn as far as its brightest colour of the mosaic demands."""
    draw_list, sensor = scene.draw_list, scene.sensor
    analytic = isinstance(scene.trails, AnalyticSegments)
    radius_px = sensor.truncation_radius_px(drawn_peak_dn(scene), draw_list.min_trail_px, renormalized=analytic)
    radius_px = np.maximum(scene.camera.max_magnification * radius_px, draw_list.truncation_radius_px)
    return replace(scene, draw_list=replace(draw_list, truncation_radius_px=radius_px))


def _of_component(scene: Scene, component: PsfComponent) -> Scene:
    sensor, camera, draw_list = scene.sensor.of_component(component), scene.camera, scene.draw_list
    peak_dn = drawn_peak_dn(replace(scene, sensor=sensor))
    trail_px = draw_list.min_trail_px
    kept = sensor.max_trail_peak_dn(peak_dn, trail_px) >= FAINTEST_COMPONENT_DN
    analytic = isinstance(scene.trails, AnalyticSegments)
    radius_px = sensor.component_radius_px(peak_dn[kept], trail_px[kept], renormalized=analytic)
    dx_px, dy_px = component.offset_px
    if dx_px or dy_px:
        camera = replace(camera, cx_px=camera.cx_px + dx_px, cy_px=camera.cy_px + dy_px)
    stars = replace(draw_list[kept], truncation_radius_px=scene.camera.max_magnification * radius_px)
    trails = scene.trails
    if isinstance(trails, SubExposures):
        trails = trails.for_sigma(scene.camera, sensor.effective_sigma_px)
        group = len(scene.trails) // len(trails)
        if stars.passage is not None and group > 1:
            stars = replace(stars, passage=stars.passage_of_groups(group))
    return replace(scene, sensor=sensor, camera=camera, draw_list=stars, trails=trails, bodies=None)
