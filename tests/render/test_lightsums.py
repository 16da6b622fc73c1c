"""Sums of the light of lines along paths: over all pairs, one by one, in float64."""

import numpy as np
import pytest

from glstar.render.truth import lightsums
from glstar.render.truth.lightsums import Gaussians, light_sums

# Lengths are in sqrt(2) sigma: five sigma.
FAR = 5 / np.sqrt(2)


def gaussians(x: np.ndarray, y: np.ndarray, *, extent: float = 0.0, wide: float = 0.5, seed: int = 1) -> Gaussians:
    """Return lines, (n, m), of different heights and of the same width, or of any oblique shape."""
    rng = np.random.default_rng(seed)
    a, c = -wide * rng.uniform(0.5, 1.0, (2, *x.shape))
    b = 0.8 * np.sqrt(a * c) * rng.uniform(-1, 1, x.shape)
    half = np.broadcast_to(np.array([extent, extent / 2])[:, np.newaxis, np.newaxis], (2, *x.shape))
    values = (x, y, a, b, c, rng.uniform(0.5, 2.0, x.shape), half)
    return Gaussians(*(np.array(each, np.float32) for each in values))


def pairs(lines: Gaussians) -> tuple[np.ndarray, np.ndarray]:
    """Return the light of each line at the middle of each, (to, of, m), and its square over the height."""
    x, y, a, b, c, height = (np.asarray(each, np.float64) for each in lines[:6])
    dx, dy = x[:, np.newaxis] - x, y[:, np.newaxis] - y
    light = np.exp(a * dx**2 + b * dx * dy + c * dy**2)
    return height * light, height * light**2


@pytest.mark.parametrize("count", [1, 2, 8, 15, 17, 40, 61])
def test_every_line_that_is_near_adds_its_light(count: int) -> None:
    """Paths go around a circle one and a half times, so that they return to where they were."""
    rng = np.random.default_rng(count)
    angle = np.linspace(0, 3 * np.pi, count)[:, np.newaxis] + rng.uniform(0, 6, 5)
    x, y = 2 * np.cos(angle) + 0.1 * rng.normal(size=angle.shape), 2 * np.sin(angle)
    lines = gaussians(x, y, extent=0.4, wide=2.0)
    found = light_sums(lines, np.ones(angle.shape, np.bool_))
    for sums, of_pairs in zip(found, pairs(lines), strict=True):
        # Farther than five sigma is nothing of such narrow ones.
        np.testing.assert_allclose(sums, of_pairs.sum(axis=1), rtol=2e-5)


def test_stars_are_summed_in_several_blocks_as_in_one(monkeypatch: pytest.MonkeyPatch) -> None:
    rng = np.random.default_rng(2)
    lines = gaussians(*rng.uniform(0, 2, (2, 50, 9)), extent=0.2)
    needed = np.ones((50, 9), np.bool_)
    whole = light_sums(lines, needed)
    for pair, sums in zip(pairs(lines), whole, strict=True):
        np.testing.assert_allclose(sums, pair.sum(axis=1), rtol=2e-5)
    for at_once in (100, 64 * 3, 1):
        monkeypatch.setattr(lightsums, "PAIRS_AT_ONCE", max(at_once, 64))
        np.testing.assert_allclose(light_sums(lines, needed), whole, rtol=1e-5)


@pytest.mark.parametrize(("distance", "is_near"), [(0.98 * FAR + 0.5, True), (1.02 * FAR + 0.5, False)])
def test_lines_count_up_to_five_sigma_beyond_the_longest_of_them(distance: float, is_near: bool) -> None:
    """Of lines that are so wide that it shows."""
    x = np.array([[0.0], [distance]])
    lines = gaussians(x, 0 * x, extent=0.5 / np.sqrt(1.25), wide=0.01)
    (light, square), (narrow, wide) = pairs(lines), light_sums(lines, np.ones((2, 1), np.bool_))
    expected = [of.sum(axis=1) if is_near else of[[0, 1], [0, 1]] for of in (light, square)]
    np.testing.assert_allclose([narrow, wide], expected, rtol=1e-5)


def test_a_line_has_its_own_block_and_the_next_ones_as_neighbours_and_others_if_they_are_near() -> None:
    """The lines of block 0 and 3 are near, 1 and 2 far away: each line at another place than the rest of its block."""
    block = np.arange(29) // 8
    x = np.select([block == 1, block == 2, block == 3], [100.0, 200.0, 0.5], 0.0) + np.arange(29) % 8 * 0.3
    lines = gaussians(np.column_stack([x, x + 1000 * block]), np.zeros((29, 2)))
    light, square = (of.copy() for of in pairs(lines))
    is_near = np.abs(block[:, np.newaxis] - block) % 3 == 0
    needed = np.ones((29, 2), np.bool_)
    found = light_sums(lines, needed)
    for of, sums in zip((light, square), found, strict=True):
        np.testing.assert_allclose(sums[:, 0], (of[..., 0] * is_near).sum(axis=1), rtol=2e-5)
        np.testing.assert_allclose(sums[:, 1], (of[..., 1] * (block[:, np.newaxis] == block)).sum(axis=1), rtol=2e-5)
    # What is not needed is not added: only within the block.
    needed[:24] = False
    some = light_sums(lines, needed)
    for of, sums in zip((light, square), some, strict=True):
        own = np.where(block[:, np.newaxis] == 3, is_near, block[:, np.newaxis] == block)
        np.testing.assert_allclose(sums[:, 0], (of[..., 0] * own).sum(axis=1), rtol=2e-5)


@pytest.mark.parametrize("axis", [0, 1])
@pytest.mark.parametrize("side", [-1, 1])
@pytest.mark.parametrize(("gap", "is_near"), [(0.98 * FAR, True), (1.02 * FAR, False)])
def test_blocks_are_near_if_their_extents_are_within_five_sigma(
    axis: int, side: int, gap: float, is_near: bool
) -> None:
    place = np.repeat([0.0, 500.0, side * (1.2 + gap)], 8)[:, np.newaxis]
    at = [0 * place, 0 * place]
    at[axis] = place
    half = np.zeros((2, 24, 1))
    half[axis] = 0.6
    lines = gaussians(*at)._replace(half=half.astype(np.float32))
    star, target, source = lightsums._near_blocks(lines, np.ones((24, 1), np.bool_))
    assert list(zip(star.tolist(), target.tolist(), source.tolist(), strict=True)) == (
        [(0, 0, 2), (0, 2, 0)] if is_near else []
    )
    needed = np.zeros((24, 1), np.bool_)
    needed[20] = True
    star, target, source = lightsums._near_blocks(lines, needed)
    assert (target.tolist(), source.tolist()) == (([2], [0]) if is_near else ([], []))


def test_light_at_lines_is_that_of_all_lines_of_their_stars() -> None:
    rng = np.random.default_rng(9)
    lines = gaussians(*rng.uniform(0, 3, (2, 7, 4)))
    line, star = np.array([3, 0, 6]), np.array([2, 3, 0])
    expected = pairs(lines)[0][line, :, star].T
    np.testing.assert_allclose(lines.light(line, star), expected, rtol=1e-5)


def test_exponents_are_cut_off_at_40_and_at_zero() -> None:
    exponent = np.array([-41.0, -39.0, -1.0, 0.0, 1e-3], np.float32)
    found = lightsums._exponential(exponent)
    np.testing.assert_allclose(found, np.exp([-40.0, -39.0, -1.0, 0.0, 0.0]), rtol=1e-6)
    assert found is exponent
