"""How long pieces of trails may be, where they are divided, and which stars they are drawn of."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from glstar.render.motion.trailmodels import CameraPath
from glstar.render.readout import pieces as pieces_module
from glstar.render.readout.pieces import (
    FAINT_LIMITS,
    PIECE_LIMITS,
    PieceCosts,
    PieceLimits,
    _are_faint,
    _classes,
    _divided,
    _unlike_segments,
    trail_pieces,
)
from glstar.render.scene.bodies import BODIES
from tests.render.test_camerapath import LENS, trails


def test_sprites_are_as_wide_as_a_star_half_of_the_time_at_either_end_and_the_path_of_four_pieces() -> None:
    limits = PieceLimits(length_sigma=1.6)
    widening = np.sqrt(1 + 1.6**2 / 4)
    assert limits.widening == pytest.approx(widening, rel=1e-12)
    radius = np.array([3.0, 11.0])
    np.testing.assert_allclose(limits.reach_px(radius, 1.3), radius * widening + 1.6 * 1.3 + 0.125, rtol=1e-12)
    np.testing.assert_allclose(limits.sprite_px(radius, 1.3), 2 * radius * widening + 4 * 1.6 * 1.3 + 0.25, rtol=1e-12)


def test_faint_stars_have_pieces_of_their_own_where_that_saves_enough_sprites() -> None:
    is_up = np.arange(40) % 4 > 0
    is_faint = np.arange(40) % 3 == 0
    both = np.count_nonzero(is_up & is_faint)
    sigma, costs = 1.4, PieceCosts(min_faint_sprites=70.0)
    saved_per_px = (1 / 1.55 - 1 / 2.4) / (sigma * 4)
    enough_px = 70.0 / both / saved_per_px
    ((stars, limits),) = _classes(0.99 * enough_px, is_up, is_faint, sigma, costs)
    assert (stars is is_up, limits is PIECE_LIMITS) == (True, True)
    (bright, of_bright), (faint, of_faint) = _classes(1.01 * enough_px, is_up, is_faint, sigma, costs)
    np.testing.assert_array_equal(bright, is_up & ~is_faint)
    np.testing.assert_array_equal(faint, is_up & is_faint)
    assert (of_bright is PIECE_LIMITS, of_faint is FAINT_LIMITS) == (True, True)
    # No class is empty.
    ((stars, limits),) = _classes(1e9, is_up, np.ones(40, np.bool_), sigma, costs)
    np.testing.assert_array_equal(stars, is_up)
    assert limits is FAINT_LIMITS


def test_trails_below_forty_cuts_are_faint_but_those_of_discs_are_not(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(pieces_module, "drawn_peak_dn", lambda scene: scene.peak_dn)
    sensor = SimpleNamespace(max_trail_peak_dn=lambda peak, trail: peak / trail)
    scene = SimpleNamespace(
        stars=SimpleNamespace(catalogue="bsc5"), sensor=sensor, peak_dn=np.array([1.59, 1.61, 0.1]),
        draw_list=SimpleNamespace(min_trail_px=np.array([2.0, 2.0, 0.124]), __len__=lambda: 3),
    )  # fmt: skip
    assert _are_faint(scene).tolist() == [True, False, False]
    discs = SimpleNamespace(**vars(scene) | {"stars": SimpleNamespace(catalogue=BODIES), "draw_list": [0, 0, 0]})
    assert _are_faint(discs).tolist() == [False] * 3


def test_pieces_end_where_the_cloud_changes_by_two_percent() -> None:
    passage = np.array([[1.0, 0.985, 0.96, 0.96, 0.9, 0.915], [0.5, 0.5, 0.5, 0.479, 0.479, 0.4790]], np.float32)
    assert _unlike_segments(passage).tolist() == [2, 3, 4]
    assert _unlike_segments(None).tolist() == []
    assert _unlike_segments(passage[:0]).tolist() == []


def test_pieces_are_halved_until_their_errors_are_small_and_not_more_than_some(monkeypatch: pytest.MonkeyPatch) -> None:
    path = CameraPath(trails(), LENS)
    elapsed_px = path._elapsed_px[-1]
    limits = PieceLimits(length_sigma=elapsed_px / 1.3 / 2.5, skewness_error=0.02, kurtosis_error=0.03, halvings=3)
    even = path.bounds_of_equal_lengths(elapsed_px / 2.5)
    assert len(even) == 4

    def errors(_self: CameraPath, moments: object, sigma_px: float) -> tuple[np.ndarray, np.ndarray]:
        assert sigma_px == 1.3
        length = np.diff(moments.bounds)
        return np.where(moments.bounds[:-1] < 0.1, 0.025 * length, 0.0), np.where(length > 0.9, 0.031, 0.029)

    monkeypatch.setattr(CameraPath, "errors", errors)
    found = _divided(path, 1.3, limits, np.inf, np.zeros(0, np.intp))
    bounds = even
    for _ in range(3):
        length = np.diff(bounds)
        uneven = ((bounds[:-1] < 0.1) & (0.025 * length > 0.02)) | (length > 0.9)
        bounds = np.sort([*bounds, *((bounds[:-1] + bounds[1:])[uneven] / 2)])
    np.testing.assert_allclose(found.bounds, bounds, rtol=0, atol=1e-12)
    assert len(bounds) > 5
    np.testing.assert_array_equal(trail_pieces(trails(), LENS, 1.3, limits).bounds, found.bounds)
    # The limit counts what is evaluated.
    assert _divided(path, 1.3, limits, 2, np.zeros(0, np.intp)) is None
    assert trail_pieces(trails(), LENS, 1.3, limits, most=len(bounds) - 1) is not None
    once = replace(limits, halvings=1)
    assert len(_divided(path, 1.3, once, 3, np.zeros(0, np.intp))) == 3
    divided = _divided(path, 1.3, replace(limits, halvings=1), np.inf, np.array([1, 2]), 7)
    expected = np.unique([*path.bounds_of_equal_lengths(elapsed_px / 2.5, 7), 1.0, 2.0])
    np.testing.assert_allclose(divided.bounds, expected, rtol=0, atol=1e-12)
