"""The panel of shifts in `compare.png`: significant means of noisy pairs."""

from dataclasses import replace

import numpy as np

from glstar.compare.comparison import shift_grid
from glstar.compare.pairs import Pair

ANY_PAIR = Pair("image.png", "bsc5", 1, "", 2.0, *[0.0] * 7, False, *[0.0] * 10)


def noisy_pairs(count: int, turn: float) -> list[Pair]:
    """Return pairs over an image that is rotated about its middle; fainter pairs have larger noise."""
    rng = np.random.default_rng(7)
    pairs = []
    for x, y in rng.uniform(0, (1280, 960), (count, 2)):
        signal = 10 + 20 * rng.pareto(1.5)
        u, v = turn * np.array([480 - y, x - 640]) + rng.normal(0, 20 / signal, 2)
        pairs.append(replace(ANY_PAIR, x_px=x, y_px=y, shift_x_px=u, shift_y_px=v, signal_to_noise=signal))
    return pairs


def test_the_panel_of_shifts_shows_a_rotation_below_the_noise_of_single_pairs() -> None:
    grid = shift_grid(noisy_pairs(600, 4e-4))

    true = 4e-4 * np.column_stack([480 - grid.middle_px[:, 1], grid.middle_px[:, 0] - 640])
    far = np.linalg.norm(true, axis=1) > 0.2
    cosine = np.sum(grid.shift_px * true, axis=1) / np.linalg.norm(grid.shift_px, axis=1) / np.linalg.norm(true, axis=1)
    assert grid.pairs.sum() == 600
    assert grid.clear[far].mean() > 0.5
    assert (cosine[grid.clear & far] > 0.7).all()
    # Unweighted means would be less accurate: faint pairs scatter by 1 px or more.
    assert np.sqrt(np.mean((grid.shift_px - true) ** 2)) < 0.12


def test_without_a_shift_few_cells_exceed_their_noise() -> None:
    grid = shift_grid(noisy_pairs(2000, 0.0))

    assert len(grid.clear) > 40
    assert grid.clear.mean() < 0.15


def test_a_single_pair_is_shown_as_insignificant() -> None:
    grid = shift_grid([replace(ANY_PAIR, x_px=5.0, y_px=7.0, shift_x_px=0.3, signal_to_noise=20.0)])

    np.testing.assert_allclose(grid.middle_px, [[5.0, 7.0]], rtol=0, atol=1e-12)
    np.testing.assert_allclose(grid.shift_px, [[0.3, 0.0]], rtol=0, atol=1e-12)
    assert not grid.clear.any()
