"""Sub-exposures, the largest sprites of a driver, and lines as Gaussians, against matrices and definitions."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from glstar.camera.sensor.sensor import Sensor
from glstar.errors import RenderError
from glstar.render.motion.pointing import Pointing
from glstar.render.motion.trailmodels import SubExposures
from glstar.render.opengl.passes.subexposure import sprite_px, with_drawable_sprites
from glstar.render.scene.scene import Scene
from glstar.render.truth.brightest import _as_gaussians, _Lines
from tests.support.scenes import camera, stars_at

LENS = camera()


def sub_exposures(angles_rad: np.ndarray) -> SubExposures:
    C = Rotation.from_rotvec(np.outer(angles_rad, [0.0, 1.0, 0])).as_matrix()
    zenith = np.column_stack([angles_rad, 0 * angles_rad, 1 + 0 * angles_rad])
    return SubExposures(Pointing(C, zenith, zenith * 1e-6, 0.0))


@pytest.mark.parametrize(("time", "index"), [(0.0, 0), (0.199, 0), (0.201, 1), (0.799, 3), (0.999, 4), (1.0, 4)])
def test_a_star_is_drawn_in_the_sub_exposure_that_contains_a_time(time: float, index: int) -> None:
    trail = sub_exposures(np.arange(5) * 0.01)
    direction = np.array([[0.0, 0.0, 1.0]])
    x_px = trail.positions(LENS, direction, np.array([time]))[0, 0, 0]
    expected = LENS.project(trail.pointing.to_camera(direction))[index, 0, 0]
    assert x_px == expected


@pytest.mark.parametrize("group", [1, 2, 3, 4, 6, 12])
def test_groups_of_sub_exposures_are_drawn_in_their_middles(group: int) -> None:
    """The largest group of equal numbers is taken whose spacing is at most 1.5 sigma."""
    step_rad = 1e-4
    trail = sub_exposures(np.arange(12) * step_rad)
    step_px = step_rad * LENS.max_px_per_rad
    # A group of n sub-exposures is n steps long.
    for part, fewer in ((1.01, group), (0.99, max((n for n in (1, 2, 3, 4, 6, 12) if n < group), default=1))):
        found = trail.for_sigma(LENS, part * group * step_px / 1.5)
        assert len(found) == 12 // fewer
        middles = np.arange(12).reshape(-1, fewer).mean(axis=1) * step_rad
        expected = sub_exposures(middles).pointing
        for name in ("C_camera_eq", "zenith_eq", "velocity_eq"):
            np.testing.assert_allclose(getattr(found.pointing, name), getattr(expected, name), rtol=0, atol=2e-8)


def scene_with_radius(radius_px: float, sub_exposures: int) -> Scene:
    scene = stars_at([[100.0, 90.0], [160.0, 120.0]], [3.0, 3.0], sensor=Sensor(psf_sigma_px=2.0), lens=LENS,
                     n=sub_exposures)  # fmt: skip
    return replace(scene, draw_list=replace(scene.draw_list, truncation_radius_px=np.array([radius_px, 4.0])))


@pytest.mark.parametrize("moves", [False, True])
def test_sprites_are_as_large_as_the_driver_draws(moves: bool) -> None:
    sensor = Sensor(psf_sigma_px=2.0)
    core_px = 1.7
    extent_px = sprite_px(0.0, core_px) if moves else 0.0
    # Sub-exposures at most 1.5 sigma from one to the next share a sprite.
    assert sprite_px(2.0, core_px) - sprite_px(0.0, core_px) == pytest.approx(2 * 3.5 * 2.0)
    assert sprite_px(0.0, 2 * core_px) == pytest.approx(2 * sprite_px(0.0, core_px))
    assert sprite_px(0.0, 1.0) / 1.5 == round(sprite_px(0.0, 1.0) / 1.5)
    scene = scene_with_radius(20.0, 5 if moves else 1)
    assert with_drawable_sprites(scene, core_px, 40.0 + extent_px, sensor) is scene
    fitted = with_drawable_sprites(scene, core_px, 39.0 + extent_px, sensor)
    np.testing.assert_allclose(fitted.draw_list.truncation_radius_px, [19.5, 4.0], rtol=1e-12)
    least_px = 3.5 * scene.sensor.effective_sigma_px
    with_drawable_sprites(scene, core_px, 2 * least_px * 1.001 + extent_px, sensor)
    with pytest.raises(RenderError, match=r"sensor.psf_sigma_px = 2 requires sprites of"):
        with_drawable_sprites(scene, core_px, 2 * least_px * 0.999 + extent_px, sensor)
    with pytest.raises(RenderError, match=r"it may be 1 px"):
        with_drawable_sprites(scene, core_px, 2 * least_px * 0.52 + extent_px, sensor)


@pytest.mark.parametrize("are_groups", [False, True])
def test_lines_are_gaussians_of_their_variance_and_that_of_wide_stars(are_groups: bool) -> None:
    rng = np.random.default_rng(5)
    sigma, middle, step = 1.4, rng.uniform(0, 50, (2, 6, 1)), rng.uniform(-6, 6, (2, 6, 1))
    weight = rng.random((6, 1))
    root = rng.normal(0, 1.5, (6, 2, 2))
    spread = root @ np.swapaxes(root, 1, 2)
    of_groups = np.stack([spread[:, 0, 0], spread[:, 0, 1], spread[:, 1, 1]])[:, :, np.newaxis]
    found = _as_gaussians(_Lines(middle, step, weight, of_groups if are_groups else None), sigma)
    x, y, xx, xy, yy, height = (np.asarray(each, np.float64)[:, 0] for each in list(found)[:6])
    np.testing.assert_allclose(np.stack([x, y]), (middle - middle[:, :1])[..., 0] / (np.sqrt(2) * sigma), atol=1e-5,
                               rtol=0)  # fmt: skip
    for k in range(6):
        # A uniform line has a twelfth of its squared length; a group twice its variance: in units of 2 sigma^2.
        of_line = np.outer(step[:, k, 0], step[:, k, 0]) / 12
        covariance = np.eye(2) + (2 * spread[k] if are_groups else of_line) / (2 * sigma**2)
        inverse = np.linalg.inv(covariance)
        np.testing.assert_allclose([xx[k], xy[k], yy[k]], [-inverse[0, 0] / 2, -inverse[0, 1], -inverse[1, 1] / 2],
                                   rtol=1e-5, atol=1e-6)  # fmt: skip
        assert height[k] == pytest.approx(weight[k, 0] / np.sqrt(np.linalg.det(covariance)), rel=1e-5)
