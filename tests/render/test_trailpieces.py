"""Pieces of trails, against the stars' own positions along the segments, in float64."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.special import erf

from glstar.camera.exposure import Exposure
from glstar.camera.sensor.pointspread import TRUNCATION_DN
from glstar.render.motion import starpaths
from glstar.render.motion.trailmodels import AnalyticSegments, CameraPath, TrailPieces
from glstar.render.readout.pieces import (
    FAINT_LIMITS,
    FAINT_PEAK_DN,
    PIECE_LIMITS,
    PIECES_PER_SPRITE,
    SNAPPING_PX,
    PieceCosts,
    in_pieces,
    trail_pieces,
)
from glstar.render.scene.bodies import BODIES
from glstar.render.truth.linechains import normal_from_middle
from tests.render.test_pathfit import CORNERS_AND_MORE, EXPOSURE, LENS, flown, rough
from tests.support.scenes import NIGHT_UTC_S

SIGMA_PX = 1.3
FREE = PieceCosts(min_segments=1, pieces_per_segment=np.inf)


def at_pixels(pieces: TrailPieces, xy_px: list[tuple[int, int]], piece: int) -> np.ndarray:
    """Return the directions of stars that are at pixels during a piece."""
    return LENS.unit_vectors(xy_px) @ pieces.pointing.C_camera_eq[piece]


def per_turn_px(xy_px: np.ndarray) -> np.ndarray:
    """Return derivatives of positions with respect to the rotation vector of the camera, (m, 2, 3), by differences."""
    rays, step_rad = LENS.unit_vectors(xy_px), 1e-6
    turned = [LENS.project(rays + step_rad * np.cross(axis, rays)) for axis in np.eye(3)]
    return np.stack([(moved - xy_px) / step_rad for moved in turned], axis=-1)


@pytest.mark.parametrize("hz", [25.0, 200.0])
def test_a_piece_has_the_mean_and_the_covariance_of_the_stars_motion_during_it(hz):
    trails = rough(hz).scene(EXPOSURE).trails
    pieces = trail_pieces(trails, LENS, SIGMA_PX)
    assert len(pieces) > 10
    ends = np.concatenate([[0.0], np.cumsum(pieces.time_fraction)])
    assert ends[-1] == pytest.approx(1.0, abs=1e-12)
    for piece in (0, len(pieces) // 2, len(pieces) - 1):
        direction_eq = at_pixels(pieces, CORNERS_AND_MORE, piece)
        time = ends[piece] + (np.arange(4000) + 0.5) / 4000 * pieces.time_fraction[piece]
        path_px = trails.positions(LENS, direction_eq, time)
        mean_px = LENS.project(pieces.pointing.to_camera(direction_eq))[piece]
        np.testing.assert_allclose(mean_px, path_px.mean(axis=0), rtol=0, atol=3e-4)
        off_px = path_px - path_px.mean(axis=0)
        expected_px2 = np.einsum("tmi,tmj->mij", off_px, off_px) / len(time)
        moved = per_turn_px(mean_px)
        covariance_px2 = moved @ pieces.covariance_rad2[piece] @ np.swapaxes(moved, 1, 2)
        np.testing.assert_allclose(covariance_px2, expected_px2, rtol=0, atol=2e-3 * expected_px2.max())


def test_no_star_of_the_image_moves_further_than_a_piece_may_be_long():
    trails = rough(200.0).scene(EXPOSURE).trails
    pieces = trail_pieces(trails, LENS, SIGMA_PX)
    ends = np.concatenate([[0.0], np.cumsum(pieces.time_fraction)])
    for piece in range(len(pieces)):
        direction_eq = at_pixels(pieces, CORNERS_AND_MORE, piece)
        path_px = trails.positions(LENS, direction_eq, np.linspace(ends[piece], ends[piece + 1] - 1e-12, 50))
        length_px = np.linalg.norm(np.diff(path_px, axis=0), axis=-1).sum(axis=0).max()
        assert length_px < 1.02 * PIECE_LIMITS.length_sigma * SIGMA_PX


def test_stars_that_do_not_move_take_one_piece():
    t = np.arange(0.0, 1.0, 0.02)
    pieces = trail_pieces(flown(t, np.zeros((3, t.size))).scene(EXPOSURE).trails, LENS, SIGMA_PX)
    assert len(pieces) == 1
    np.testing.assert_allclose(pieces.time_fraction, [1.0], rtol=0, atol=1e-15)


def test_a_motion_that_stops_suddenly_takes_shorter_pieces():
    """A Gaussian does not represent a star that rests and then jumps: its third moments are too large."""
    t = np.arange(0.0, 1.0, 0.01)
    jump_rad = 1.2 * SIGMA_PX / LENS.fx_px * np.clip((t - 0.60) / 0.02, 0.0, 1.0)
    trails = flown(t, np.array([np.zeros_like(t), np.zeros_like(t), jump_rad])).scene(EXPOSURE).trails
    coarse = trail_pieces(trails, LENS, SIGMA_PX, replace(PIECE_LIMITS, skewness_error=np.inf))
    assert len(coarse) < len(trail_pieces(trails, LENS, SIGMA_PX))


def swinging(amplitude_px: float) -> AnalyticSegments:
    """Return the trails of stars that swing at 5 Hz, at the middle of the image by an amplitude in px."""
    t = np.arange(0.0, 1.0, 0.002)
    swing_rad = amplitude_px / LENS.fx_px * np.cos(2 * np.pi * 5 * (t + NIGHT_UTC_S - EXPOSURE.start_utc_s))
    trails = flown(t, np.array([np.zeros_like(t), np.zeros_like(t), swing_rad])).scene(EXPOSURE).trails
    assert isinstance(trails, AnalyticSegments)
    return trails


def test_a_swing_within_the_width_of_a_star_takes_shorter_pieces():
    """A Gaussian is too sharp for a star that is longest at both ends of its swing."""
    one = swinging(1.0)
    rays = LENS.unit_vectors(CORNERS_AND_MORE) @ one.pointing.C_camera_eq[0]
    moving_eq = rays / np.linalg.norm(rays, axis=1, keepdims=True)
    time = (np.arange(4000) + 0.5) / 4000
    lengths_px = np.linalg.norm(np.diff(one.positions(LENS, moving_eq, time), axis=0), axis=-1).sum(axis=0)
    fastest = int(lengths_px.argmax())
    trails = swinging(5 * 1.4 * SIGMA_PX / lengths_px[fastest])
    coarse = trail_pieces(trails, LENS, SIGMA_PX, replace(PIECE_LIMITS, kurtosis_error=np.inf))
    fine = trail_pieces(trails, LENS, SIGMA_PX)
    assert len(coarse) == 5 < len(fine)
    path_px = trails.positions(LENS, moving_eq[[fastest]], time)[:, 0]
    at_px = path_px.mean(axis=0, keepdims=True)
    expected = np.exp(-((path_px - at_px) ** 2).sum(axis=1) / (2 * SIGMA_PX**2)).mean()
    off = [abs(flux_of(pieces, moving_eq[fastest], at_px)[0] / expected - 1) for pieces in (coarse, fine)]
    assert off[0] > 0.006
    assert off[1] < 0.003


@pytest.mark.parametrize("axis", [0, 1])
def test_the_error_of_a_piece_is_that_of_its_third_moment(axis):
    """The third derivative of a Gaussian is 1.380 at most: an Edgeworth series, with the third moment of a parabola."""
    t = np.arange(0.0, 1.0, 0.002)
    turned_rad = 1.2 * SIGMA_PX / LENS.fx_px * ((t + NIGHT_UTC_S - EXPOSURE.start_utc_s) / EXPOSURE.duration_s) ** 2
    angles_rad = np.zeros((3, t.size))
    angles_rad[axis] = turned_rad
    trails = flown(t, angles_rad).scene(EXPOSURE).trails
    path = CameraPath(trails, LENS)
    moments = path.moments(np.array([0.0, float(len(trails))]))
    skewness, _ = path.errors(moments, SIGMA_PX)
    direction_eq = starpaths.probe_rays(LENS).T @ moments.C_mean[0]
    time = (np.arange(4000) + 0.5) / 4000
    path_px = trails.positions(LENS, direction_eq / np.linalg.norm(direction_eq, axis=1, keepdims=True), time)
    off = (path_px - path_px.mean(axis=0)) / SIGMA_PX
    second = (off**2).sum(axis=-1).mean(axis=0)
    cubes = np.einsum("tpi,tpj,tpk->pijk", off, off, off) / len(time)
    expected = 1.380 / 6 * np.sqrt((cubes**2).sum(axis=(1, 2, 3))) / (1 + second) ** 1.5
    assert expected.max() > 5e-4
    np.testing.assert_allclose(skewness, expected.max(), rtol=0, atol=0.03 * expected.max())


def test_pieces_are_drawn_where_they_cost_less_of_narrow_stars_too():
    scene = rough(200.0).scene(Exposure(NIGHT_UTC_S + 0.213, 0.5, trail="analytic"))
    divided = in_pieces(scene, scene.trails)
    assert divided is not None
    assert sum(len(part.scene.draw_list) for part in divided.parts) + len(divided.rest.draw_list) == len(
        scene.draw_list
    )
    narrow = replace(scene, sensor=replace(scene.sensor, psf_sigma_px=0.6))
    assert in_pieces(narrow, scene.trails, FREE) is not None
    few = PieceCosts(pieces_per_segment=len(divided.parts[0].pieces) / len(scene.trails) - 0.1)
    assert in_pieces(scene, scene.trails, few) is None
    steady = flown(np.arange(0.0, 1.0, 0.02), np.outer([0.1, 0.0, 0.0], np.arange(0.0, 1.0, 0.02))).scene(EXPOSURE)
    assert in_pieces(steady, steady.trails) is None


def test_a_piece_is_dimmed_by_the_cloud_of_its_own_segments():
    scene = rough(200.0).scene(EXPOSURE)
    passage = np.ones((len(scene.draw_list), len(scene.trails)), np.float32)
    passage[:, 3:] = 0.5
    divided = in_pieces(replace(scene, draw_list=replace(scene.draw_list, passage=passage)), scene.trails, FREE)
    assert divided is not None
    (part,) = divided.parts
    ends = np.cumsum(part.pieces.time_fraction)
    edge = scene.trails.time_fraction[:3].sum()
    assert np.abs(ends - edge).min() < 1e-12
    expected = np.where(ends < edge + 1e-9, 1.0, 0.5)
    np.testing.assert_allclose(part.scene.draw_list.passage, np.tile(expected, (len(passage), 1)), rtol=0, atol=1e-6)


def flux_of(pieces: TrailPieces, direction_eq: np.ndarray, at_px: np.ndarray) -> np.ndarray:
    """Return the flux of the pieces of a star at some pixels, (n,), of an amplitude of 1 if it did not move."""
    centre_px = LENS.project(pieces.pointing.to_camera(direction_eq[np.newaxis]))[:, 0]
    moved = per_turn_px(centre_px)
    covariance_px2 = moved @ pieces.covariance_rad2 @ np.swapaxes(moved, 1, 2) + SIGMA_PX**2 * np.eye(2)
    off_px = at_px[:, np.newaxis] - centre_px
    exponent = np.einsum("nki,kij,nkj->nk", off_px, np.linalg.inv(covariance_px2), off_px) / 2
    return np.exp(-exponent) @ (pieces.time_fraction * SIGMA_PX**2 / np.sqrt(np.linalg.det(covariance_px2)))


@pytest.mark.parametrize(("limits", "fraction"), [(PIECE_LIMITS, 0.005), (FAINT_LIMITS, TRUNCATION_DN / FAINT_PEAK_DN)])
@pytest.mark.parametrize("hz", [25.0, 200.0])
def test_the_flux_of_pieces_is_that_of_the_path_within_what_its_brightness_allows(hz, limits, fraction):
    trails = rough(hz).scene(EXPOSURE).trails
    pieces = trail_pieces(trails, LENS, SIGMA_PX, limits)
    (direction_eq,) = at_pixels(pieces, CORNERS_AND_MORE[-1:], len(pieces) // 2)
    time = (np.arange(4000) + 0.5) / 4000
    path_px = trails.positions(LENS, direction_eq[np.newaxis], time)[:, 0]
    around_px = SIGMA_PX * np.random.default_rng(1).normal(size=(300, 2))
    at_px = path_px[np.linspace(0, 3999, 300).astype(int)] + around_px
    distance2_px2 = ((at_px[:, np.newaxis] - path_px) ** 2).sum(axis=-1)
    expected = np.exp(-distance2_px2 / (2 * SIGMA_PX**2)).mean(axis=1)
    largest = np.abs(flux_of(pieces, direction_eq, at_px) - expected).max() / expected.max()
    assert largest < fraction
    if limits is FAINT_LIMITS:
        assert len(pieces) < 0.75 * len(trail_pieces(trails, LENS, SIGMA_PX))


def test_only_stars_that_are_faint_everywhere_take_longer_pieces():
    scene = rough(200.0).scene(EXPOSURE)
    divided = in_pieces(scene, scene.trails, replace(FREE, min_faint_sprites=0.0))
    assert divided is not None
    bright, faint = divided.parts
    assert len(faint.pieces) < len(bright.pieces)
    for part, is_faint in ((bright, False), (faint, True)):
        drawn, sensor = part.scene.draw_list, scene.sensor
        peak_dn = sensor.peak_dn(drawn.observed_mag(scene.stars), EXPOSURE.duration_s)
        assert len(drawn) > 0
        assert ((sensor.max_trail_peak_dn(peak_dn, drawn.min_trail_px) < FAINT_PEAK_DN) == is_faint).all()
    few = in_pieces(scene, scene.trails, replace(FREE, min_faint_sprites=1e6))
    assert few is not None
    assert [len(part.pieces) for part in few.parts] == [len(bright.pieces)]
    # The sources of a disc are faint one by one, and bright together.
    discs = replace(scene, stars=replace(scene.stars, catalogue=BODIES))
    of_discs = in_pieces(discs, scene.trails, replace(FREE, min_faint_sprites=0.0))
    assert of_discs is not None
    assert [len(part.pieces) for part in of_discs.parts] == [len(bright.pieces)]


def sprite_sides_px(pieces: TrailPieces, direction_eq: np.ndarray, radius_px: float) -> np.ndarray:
    """Return the larger sides of the squares around every four Gaussians up to a radius, (sprites, m)."""
    centre_px = LENS.project(pieces.pointing.to_camera(direction_eq))
    reach_px = np.empty_like(centre_px)
    for piece, covariance_rad2 in enumerate(pieces.covariance_rad2):
        moved = per_turn_px(centre_px[piece])
        variance_px2 = np.einsum("mij,jk,mik->mi", moved, covariance_rad2, moved)
        reach_px[piece] = radius_px * np.sqrt(1 + variance_px2 / SIGMA_PX**2)
    firsts = np.arange(0, len(pieces), PIECES_PER_SPRITE)
    low_px = np.minimum.reduceat(centre_px - reach_px, firsts)
    high_px = np.maximum.reduceat(centre_px + reach_px, firsts)
    return (high_px - low_px).max(axis=-1) + 2 * SNAPPING_PX


@pytest.mark.parametrize("radius_px", [4.0, 30.0, 100.0])
def test_no_sprite_of_pieces_is_larger_than_the_bound_and_some_are_nearly_as_large(radius_px):
    trails = rough(200.0).scene(EXPOSURE).trails
    pieces = trail_pieces(trails, LENS, SIGMA_PX)
    direction_eq = at_pixels(pieces, CORNERS_AND_MORE, len(pieces) // 2)
    largest_px = np.nanmax(sprite_sides_px(pieces, direction_eq, radius_px))
    bound_px = PIECE_LIMITS.sprite_px(np.array([radius_px]), SIGMA_PX)[0]
    assert 0.7 * bound_px < largest_px <= bound_px


def test_stars_whose_sprites_are_larger_than_the_driver_draws_are_drawn_in_segments():
    scene = rough(200.0).scene(EXPOSURE)
    radius_px = np.linspace(3.0, 40.0, len(scene.draw_list))
    scene = replace(scene, draw_list=replace(scene.draw_list, truncation_radius_px=radius_px))
    divided = in_pieces(scene, scene.trails, FREE, largest_point_px=64.0)
    assert divided is not None
    sigma_px, drawn = scene.sensor.effective_sigma_px, divided.parts[0].scene.draw_list
    assert (PIECE_LIMITS.sprite_px(drawn.truncation_radius_px, sigma_px) <= 64.0).all()
    assert divided.rest.draw_list.truncation_radius_px.max() == 40.0
    assert len(drawn) + len(divided.rest.draw_list) == len(radius_px)
    assert len(drawn) > 0


def test_the_integral_of_a_gaussian_is_that_of_scipy():
    z = np.concatenate([np.linspace(-9.0, 9.0, 3001), [-1e-3, 0.0, 1e-3]]).astype(np.float32)
    np.testing.assert_allclose(
        normal_from_middle(z.copy()), erf(z.astype(np.float64) / np.sqrt(2)) / 2, rtol=0, atol=3e-7
    )
