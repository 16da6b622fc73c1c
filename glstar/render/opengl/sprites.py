"""Sprites of stars that a driver draws: each covers several sub-exposures of one Gaussian."""

from dataclasses import replace

import numpy as np

from glstar.camera.truncation import PLAIN
from glstar.errors import RenderError
from glstar.render.opengl.subexposurepass import SUB_EXPOSURES_PER_SPRITE
from glstar.render.scene import Scene
from glstar.render.trailmodels import SAMPLE_SPACING_SIGMA, SubExposures

__all__ = ["with_drawable_sprites"]


def with_drawable_sprites(scene: Scene, core_sigma_px: float, point_size_px: float) -> Scene:
    """Return a scene of plain Gaussians whose sprites are not larger than a driver draws.

    Parameters
    ----------
    scene : Scene
    core_sigma_px : float
        The narrowest Gaussian of the whole point spread function, which decides the distance of sub-exposures, px.
    point_size_px : float
        The largest sprite of the driver, px.

    Returns
    -------
    Scene
        With smaller truncation radii if necessary, of 3.5 sigma or more.

    Raises
    ------
    RenderError
        If such sprites are too large.
    """
    sensor, draw_list = scene.sensor, scene.draw_list
    moves = isinstance(scene.trails, SubExposures) and len(scene.trails) > 1
    extent_px = SAMPLE_SPACING_SIGMA * SUB_EXPOSURES_PER_SPRITE * core_sigma_px if moves else 0.0
    sprite_px = 2 * float(draw_list.truncation_radius_px.max(initial=0.0)) + extent_px
    if sprite_px <= point_size_px:
        return scene
    fitting_px = (point_size_px - extent_px) / 2
    if fitting_px < PLAIN.min_sigma * sensor.effective_sigma_px:
        raise RenderError(
            f"psf_sigma_px = {sensor.psf_sigma_px:g} requires sprites of {sprite_px:.0f} px"
            f" and this driver draws at most {point_size_px:.0f} px;"
            f" sigma may be {sensor.psf_sigma_px * point_size_px / sprite_px:.1f} px"
        )
    radii_px = np.minimum(draw_list.truncation_radius_px, fitting_px)
    return replace(scene, draw_list=replace(draw_list, truncation_radius_px=radii_px))
