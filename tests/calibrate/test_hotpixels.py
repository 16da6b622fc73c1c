"""Hot pixels among the stars of an image drawn with NumPy: all bright ones are found, and no star."""

import numpy as np
import pytest

from glstar.calibrate.sensor.jointpsf import JointPsf
from glstar.calibrate.sensor.photographmodel import find_hot_pixels, light_beside_star
from glstar.camera.sensor.pointspread import PointSpread

SHAPE, READ_DN, DN_PER_E, STARS, HOT = (600, 800), 3.0, 0.5, 800, 120


def gaussian_stars(rng, sigma_px):
    """Return Gaussian stars integrated over 8 x 8 points of each pixel, and the pixels near them."""
    light, near = np.zeros(SHAPE), np.zeros(SHAPE, bool)
    half = 8
    points = (np.arange(-half, half + 1)[:, np.newaxis] + (np.arange(8) + 0.5) / 8 - 0.5).reshape(-1)
    for x, y, flux in zip(
        rng.uniform(half + 1, SHAPE[1] - half - 2, STARS), rng.uniform(half + 1, SHAPE[0] - half - 2, STARS),
        np.exp(rng.uniform(np.log(50), np.log(20_000), STARS)), strict=True,
    ):  # fmt: skip
        column, row = round(x), round(y)
        one, other = (np.exp(-((points - at) ** 2) / (2 * sigma_px**2)) for at in (y - row, x - column))
        star = np.outer(*(line.reshape(-1, 8).mean(axis=1) for line in (one, other))) / (2 * np.pi * sigma_px**2)
        part = np.s_[row - half : row + half + 1, column - half : column + half + 1]
        light[part] += flux * star
        near[part] = True
    return light, near


@pytest.mark.parametrize("sigma_px", [0.55, 1.3])
def test_bright_single_pixels_are_found_and_no_star(sigma_px):
    rng = np.random.default_rng(7)
    light, near = gaussian_stars(rng, sigma_px)
    free = np.flatnonzero(~near[2:-2:3, 2:-2:3])
    rows, columns = np.unravel_index(rng.choice(free, HOT, replace=False), near[2:-2:3, 2:-2:3].shape)
    excess_dn = rng.uniform(80, 500, HOT)
    light[3 * rows + 2, 3 * columns + 2] += excess_dn
    image = DN_PER_E * rng.poisson((light + 20) / DN_PER_E) - 20 + rng.normal(0, READ_DN, SHAPE)
    joint = JointPsf(PointSpread(), sigma_px, {}, STARS, 1.0)
    found = find_hot_pixels(image, np.full(SHAPE, READ_DN**2 + 20 * DN_PER_E), DN_PER_E, joint)
    expected = set(zip((3 * columns + 2).tolist(), (3 * rows + 2).tolist(), strict=True))
    assert set(zip(found.x_px.tolist(), found.y_px.tolist(), strict=True)) == expected
    map_dn = found.dark_frame_dn(SHAPE)
    np.testing.assert_allclose(
        map_dn[3 * rows + 2, 3 * columns + 2], excess_dn, rtol=0, atol=5 * np.sqrt(19 + DN_PER_E * 500)
    )
    assert np.count_nonzero(map_dn) == HOT


def test_stars_as_narrow_as_a_pixel_are_no_hot_pixels():
    rng = np.random.default_rng(8)
    light, _ = gaussian_stars(rng, 0.3)
    image = light + rng.normal(0, READ_DN, SHAPE)
    joint = JointPsf(PointSpread(), 0.3, {}, STARS, 1.0)
    assert not len(find_hot_pixels(image, np.full(SHAPE, READ_DN**2), 0.0, joint))


def test_the_light_beside_a_star_is_that_of_a_finely_sampled_one():
    points = (np.arange(-2, 3)[:, np.newaxis] + (np.arange(400) + 0.5) / 400 - 0.5).reshape(-1)
    line = np.exp(-(points**2) / (2 * 0.7**2)).reshape(5, 400).mean(axis=1)
    star = np.outer(line, line)
    expected = (star[1, 2] + star[3, 2] + star[2, 1] + star[2, 3]) / star[2, 2]
    joint = JointPsf(PointSpread(), 0.7, {}, 1, 1.0)
    assert light_beside_star(joint) == pytest.approx(expected, rel=0, abs=1e-5)


@pytest.mark.parametrize("sigma_px", [0.5, 1.3])
def test_pixels_without_light_beside_them_are_hot_but_not_at_the_edge(sigma_px: float) -> None:
    joint = JointPsf(PointSpread(), sigma_px, {}, 100, 1.0)
    above, variance = np.zeros((12, 15)), np.ones((12, 15))
    rows, columns = [0, 11, 5, 5, 1, 10, 6], [7, 7, 0, 14, 1, 13, 7]
    above[rows, columns] = 200.0 + np.arange(7)
    found = find_hot_pixels(above, variance, 0.0, joint)
    # Row by row: those of the edge are left out.
    np.testing.assert_array_equal(found.y_px, [1, 6, 10])
    np.testing.assert_array_equal(found.x_px, [1, 7, 13])
    np.testing.assert_array_equal(found.excess_dn, [204.0, 206.0, 205.0])
    # Half of the light of a centred star beside a pixel is the limit.
    share = light_beside_star(joint)
    for part, count in ((0.45, 1), (0.55, 0)):
        bright = np.zeros((9, 9))
        bright[4, 4] = 1e5
        bright[[3, 5, 4, 4], [4, 4, 3, 5]] = 1e5 * part * share / 4
        assert len(find_hot_pixels(bright, np.ones((9, 9)), 0.0, joint).x_px) == count
