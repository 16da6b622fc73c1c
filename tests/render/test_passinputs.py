"""Texels of segments and pieces, the stars near the image, and scenes that are drawn together, as arrays."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from glstar.camera.sensor.sensor import Sensor
from glstar.render.motion.pointing import Pointing
from glstar.render.motion.segmentation import SHAPE_LIMITS
from glstar.render.motion.starpaths import view_radius_rad
from glstar.render.motion.trailmodels import AnalyticSegments, SubExposures, TrailPieces
from glstar.render.opengl.passes import path, piece, trail
from glstar.render.opengl.textures import pointing_texels
from glstar.render.readout.openings import EndPieces, SegmentColumns
from glstar.render.readout.pieces import ScenePart
from glstar.render.scene.culling import DrawList
from glstar.render.scene.scene import Scene
from glstar.rotation import about_x, about_y
from tests.support.scenes import camera, star_field, stars_at

LENS = camera(64, 48, 120.0)
DEG = np.pi / 180


def pointing_of(about_y_deg: list[float], about_x_deg: list[float] | float = 0.0) -> Pointing:
    """Return cameras that turn to the right and upwards."""
    across = np.array(about_y_deg) * DEG
    C = about_x(np.broadcast_to(np.array(about_x_deg) * DEG, across.shape)) @ about_y(across)
    ahead = np.tile([0.0, 0.0, 1.0], (len(across), 1))
    return Pointing(C, ahead, 0 * ahead, 0.0)


def segments_of(about_y_deg: list[float], fractions: list[float]) -> AnalyticSegments:
    return AnalyticSegments(pointing_of(about_y_deg), np.array(fractions))


def scene_of(trails: Any, directions: np.ndarray, radius_px: list[float] | None = None, **more: Any) -> Scene:
    base = stars_at([[5.0, 5.0]], [3.0], sensor=more.pop("sensor", Sensor()), lens=LENS)
    count = len(directions)
    radii = np.full(count, 4.0) if radius_px is None else np.array(radius_px)
    drawn = more.pop("drawn", DrawList(np.arange(count, dtype=np.int32), radii))
    field = star_field(directions, np.linspace(1, 5, count))
    return replace(base, stars=field, trails=trails, draw_list=drawn, **more)


def test_segments_have_durations_weights_and_starts() -> None:
    trails = segments_of([0.0, 1.0, 2.5, 3.0, 5.0, 5.5, 5.7], [0.2, 0.5, 0.3])
    texels = trail._segment_texels(trails)
    np.testing.assert_array_equal(texels[..., :3], pointing_texels(trails.pointing)[..., :3])
    fourth = texels[..., 3]
    np.testing.assert_allclose(fourth[:-1:2, 0], [0.2, 0.5, 0.3], rtol=1e-6)
    np.testing.assert_allclose(fourth[:-1:2, 1], trails.end_weight, rtol=1e-6)
    np.testing.assert_allclose(fourth[:-1:2, 2], [0.0, 0.2, 0.7], rtol=0, atol=1e-7)
    assert not fourth[1::2].any()
    assert not fourth[-1].any()
    assert not fourth[:, 3:].any()


def test_parts_of_trails_have_star_radius_transmission_and_times() -> None:
    drawn = DrawList(np.array([7, 2, 5], np.int32), np.array([3.0, 4.0, 6.0]), extinction_mag=np.array([0.5, 1.0, 2.0]))
    scene = scene_of(None, np.eye(3)[[0] * 8], drawn=drawn)
    parts = SegmentColumns(np.array([2, 0, 2, 1]), np.array([[0.1, 0.2], [0.3, 0.4], [0.5, 0.6], [0.7, 0.8]]))
    texels = trail._texels_of_parts(scene, parts)
    assert (texels.shape, texels.dtype) == ((2, 4, 3), np.float32)
    passed = 10 ** (-0.4 * np.array([0.5, 1.0, 2.0]))
    expected = np.column_stack([[7, 2, 5], [3, 4, 6], passed])[[2, 0, 2, 1]]
    np.testing.assert_allclose(texels[0], expected, rtol=1e-6)
    np.testing.assert_allclose(texels[1, :, :2], parts.rises_and_sets, rtol=1e-6)
    assert not texels[1, :, 2].any()
    of_stars = piece._texels_of_stars(ScenePart(scene, None, np.array([[1, 2, 3], [4, 5, 6]])))
    np.testing.assert_allclose(of_stars[0], np.column_stack([[7, 2, 5], [3, 4, 6], passed]), rtol=1e-6)
    assert of_stars[1].tolist() == [[1, 4, 0], [2, 5, 0], [3, 6, 0]]
    assert not piece._texels_of_stars(ScenePart(scene, None))[1].any()


def angles_rad(pointing: Pointing, directions: np.ndarray) -> np.ndarray:
    return np.arccos(np.clip(pointing.boresight_eq @ directions.T, -1, 1))


def around(count: int) -> np.ndarray:
    """Return directions within 50 deg of the axis."""
    random = np.random.default_rng(6)
    angle, turn = np.arccos(random.uniform(np.cos(50 * DEG), 1, count)), random.uniform(0, 2 * np.pi, count)
    return np.column_stack([np.sin(angle) * np.cos(turn), np.sin(angle) * np.sin(turn), np.cos(angle)])


def test_stars_are_near_the_image_in_a_segment_by_a_cone_around_three_boresights() -> None:
    trails = segments_of([0.0, 3.0, 9.0, 10.0, 11.0, 14.0, 18.0], [0.2, 0.5, 0.3])
    directions = around(3000)
    radii = np.full(3000, 4.0)
    radii[17] = 9.0
    scene = scene_of(trails, directions, radii.tolist(), drawn=DrawList(np.arange(3000, dtype=np.int32)[::-1], radii))
    stars = np.arange(3000)[5:2990:2]
    chosen = directions[::-1][stars]
    # The largest radius beside the image, half of the largest turn between two times, and a degree for refraction.
    for times, largest_deg in ((slice(0, 7), 6.0), (slice(2, 7), 4.0)):
        found = trail._near_image(scene, trails, times, stars)
        radius = view_radius_rad(LENS, 10.0) + largest_deg / 2 * DEG + 1 * DEG
        inside = angles_rad(trails.pointing[times], chosen) < radius
        expected = inside[:-2:2] | inside[1:-1:2] | inside[2::2]
        assert found.shape == expected.shape
        np.testing.assert_array_equal(found, expected)
        assert 50 < np.count_nonzero(found) < found.size - 50
    # Turns beyond half a turn, and everything in the cone.
    wild = segments_of([0.0, 170.0, 350.0], [1.0])
    assert trail._near_image(scene_of(wild, directions), wild, slice(0, 3), stars).all()


def pieces_of(about_y_deg: list[float]) -> TrailPieces:
    count = len(about_y_deg)
    covariance = np.arange(9.0 * count).reshape(count, 3, 3)
    covariance = covariance + covariance.swapaxes(1, 2)
    return TrailPieces(
        pointing_of(about_y_deg), covariance, np.linspace(0.1, 0.2, count), np.ones((1, count)), np.arange(count + 1.0)
    )


def test_pieces_have_orientation_covariance_and_duration() -> None:
    pieces = pieces_of([0.0, 1.0, 2.0, 4.0, 5.0])
    texels = piece._piece_texels(pieces)
    assert (texels.shape, texels.dtype) == ((8, 7, 4), np.float32)
    np.testing.assert_array_equal(texels[:, :5], pointing_texels(pieces.pointing, multiple=4))
    for k in range(5):
        c = pieces.covariance_rad2[k]
        expected = [[c[0, 0], c[0, 1], c[0, 2], pieces.time_fraction[k]], [c[1, 1], c[1, 2], c[2, 2], 0.0]]
        np.testing.assert_allclose(texels[k, 5:], expected, rtol=1e-6)
    assert not texels[5:].any()


def test_stars_are_near_the_image_in_four_pieces_by_a_cone_around_the_first() -> None:
    angles = [0.0, 1.0, 2.0, 5.0, 7.0, 8.0, 9.0, 10.0, 14.0, 15.0]
    pieces = pieces_of(angles)
    directions = around(3000)
    radii = np.full(3000, 4.0)
    radii[17] = 9.0
    scene = scene_of(
        segments_of([0.0, 1.0, 2.0], [1.0]), directions, drawn=DrawList(np.arange(3000, dtype=np.int32)[::-1], radii)
    )
    chosen = directions[::-1][5:2990]
    drawn = np.stack([np.arange(3000) % 9, np.arange(3000) % 9 + 3])
    for rows, swing_deg, firsts in ((slice(0, 10), 5.0, [0, 4, 8]), (slice(4, 10), 3.0, [4, 8])):
        # The chord between orientations is that of their boresights.
        radius = view_radius_rad(LENS, 27.0) + swing_deg * DEG + 1 * DEG
        expected = angles_rad(pieces.pointing, chosen)[firsts] < radius
        found = piece._near_image(ScenePart(scene, pieces), rows, slice(5, 2990))
        np.testing.assert_array_equal(found, expected)
        assert 50 < np.count_nonzero(found) < found.size - 50
        # Of a rolling shutter, only where one of the four is recorded.
        begin, stop = drawn[:, 5:2990]
        overlaps = [(first + 4 > begin) & (first < stop) for first in firsts]
        found = piece._near_image(ScenePart(scene, pieces, drawn), rows, slice(5, 2990))
        np.testing.assert_array_equal(found, expected & np.array(overlaps))
    assert piece._near_image(ScenePart(scene, pieces_of([0.0, 180.0])), slice(0, 2), slice(5, 2990)).all()


def test_pieces_that_are_recorded_in_part_have_start_and_duration() -> None:
    ends = EndPieces(
        pointing_of([0, 1, 2, 4, 5, 6]), np.array([0.1, 0.4]), np.array([0.2, 0.3]),
        np.array([3, 5, 4100, 4096, 2]), np.array([0, 1, 1024, 1100, 1023]),
    )  # fmt: skip
    texels = piece._end_texels(ends)
    assert texels.shape == (2, 3, 5, 4)
    np.testing.assert_array_equal(texels.reshape(6, 5, 4)[..., :3], pointing_texels(ends.pointing)[..., :3])
    np.testing.assert_allclose(texels[:, 0, 0, 3], [0.1, 0.4], rtol=1e-6)
    np.testing.assert_allclose(texels[:, 0, 1, 3], [0.2, 0.3], rtol=1e-6)
    assert np.count_nonzero(texels[..., 3]) == 4
    first = piece._sprites(ends, 0, 0)
    assert (first.dtype, first.tolist()) == (np.uint16, [[3, 0], [5, 1], [2, 1023]])
    assert piece._sprites(ends, 4096, 1024).tolist() == [[4, 0], [0, 76]]
    assert piece._sprites(ends, 4, 0).tolist() == [[1, 1]]
    assert piece._sprites(ends, 0, 1).tolist() == [[5, 0], [2, 1022]]


@pytest.mark.parametrize("sigma_px", [1.2, 2.5])
def test_segments_are_surely_short_below_half_of_the_limit(sigma_px: float) -> None:
    sensor = Sensor(psf_sigma_px=sigma_px)
    limit_px = 0.5 * SHAPE_LIMITS.short_sigma * sensor.effective_sigma_px
    for part, is_short in ((0.97, True), (1.03, False)):
        # The second segment is the longest one.
        turn_deg = part * limit_px / LENS.max_px_per_rad / DEG
        trails = segments_of([0.0, 0.1 * turn_deg, 0.2 * turn_deg, 0.8 * turn_deg, 1.2 * turn_deg], [0.5, 0.5])
        assert path.surely_short(scene_of(trails, around(2), sensor=sensor), trails) == is_short


def short_scenes(turn_px: float, sigmas_px: tuple[float, ...] = (2.0, 1.3)) -> list[Scene]:
    turn_deg = turn_px / LENS.max_px_per_rad / DEG
    trails = segments_of([0.0, turn_deg / 2, turn_deg], [1.0])
    first = scene_of(trails, around(5), sensor=Sensor(psf_sigma_px=sigmas_px[0]))
    others = (
        replace(first, sensor=Sensor(psf_sigma_px=sigma), draw_list=first.draw_list[1:4]) for sigma in sigmas_px[1:]
    )
    return [first, *others]


def together(scenes: list[Scene], *, rolling: bool = False) -> list[list[int]]:
    numbers = {id(scene): number for number, scene in enumerate(scenes)}
    return [[numbers[id(scene)] for scene in some] for some in path.drawn_together(scenes, rolling=rolling)]


def test_gaussians_of_slow_stars_are_drawn_together() -> None:
    # Half a standard deviation of the narrowest one.
    limit_px = 0.5 * Sensor(psf_sigma_px=1.3).effective_sigma_px
    for part, expected in ((0.97, [[0, 1]]), (1.03, [[0], [1]])):
        scenes = short_scenes(part * limit_px)
        assert together(scenes) == expected
    scenes = short_scenes(0.1)
    other = replace(scenes[1], stars=replace(scenes[1].stars))
    elsewhere = replace(scenes[1], camera=camera(64, 48, 121.0))
    empty = replace(scenes[1], draw_list=scenes[1].draw_list[:0])
    assert together([scenes[0], empty, scenes[1], other, elsewhere]) == [[0, 2], [3], [4]]
    assert together([scenes[0]]) == [[0]]
    copied = replace(scenes[1], trails=replace(scenes[1].trails))
    assert together([scenes[0], copied]) == [[0], [1]]
    # Not of many segments, nor as sub-exposures.
    for count, expected in ((5, [[0, 1]]), (6, [[0], [1]])):
        many = segments_of(np.linspace(0, 0.01, 2 * count + 1).tolist(), [1 / count] * count)
        assert together([replace(scene, trails=many) for scene in scenes]) == expected
    sprites = SubExposures(pointing_of([0.0, 0.01]))
    assert together([replace(scene, trails=sprites) for scene in scenes]) == [[0], [1]]


def test_under_a_rolling_shutter_long_trails_are_drawn_one_by_one(monkeypatch: pytest.MonkeyPatch) -> None:
    scenes = short_scenes(0.1)
    asked: list[tuple[Any, ...]] = []

    def worth(*given: Any) -> bool:
        asked.append(given)
        return True

    monkeypatch.setattr(path, "are_worth_dividing", worth)
    assert together(scenes) == [[0, 1]]
    assert together(scenes, rolling=True) == [[0], [1]]
    assert asked == [(scenes[0].trails, LENS, scenes[1].sensor.effective_sigma_px)]
    monkeypatch.setattr(path, "are_worth_dividing", lambda *_given: False)
    assert together(scenes, rolling=True) == [[0, 1]]


def test_scenes_are_joined_star_by_star() -> None:
    first, second = short_scenes(0.1)
    plain, _ = path.in_one_scene([first, second])
    assert (plain.draw_list.extinction_mag, plain.draw_list.passage) == (None, None)
    one = replace(
        first.draw_list, min_trail_px=np.arange(5.0), extinction_mag=np.arange(5.0) + 10,
        passage=np.arange(10, dtype=np.float32).reshape(5, 2),
    )  # fmt: skip
    other = replace(
        second.draw_list, truncation_radius_px=np.array([7.0, 8, 9]), min_trail_px=np.arange(3.0) + 20,
        extinction_mag=np.arange(3.0) + 30, passage=-np.arange(6, dtype=np.float32).reshape(3, 2),
    )  # fmt: skip
    scenes = [replace(first, draw_list=one), replace(second, draw_list=other)]
    joined, components = path.in_one_scene(scenes)
    assert (joined.stars, joined.sensor) == (first.stars, first.sensor)
    assert components.sensors == (first.sensor, second.sensor)
    assert components.of_star.tolist() == [0] * 5 + [1] * 3
    drawn = joined.draw_list
    assert drawn.index.tolist() == [0, 1, 2, 3, 4, 1, 2, 3]
    assert drawn.truncation_radius_px.tolist() == [4.0] * 5 + [7, 8, 9]
    assert drawn.min_trail_px.tolist() == [0, 1, 2, 3, 4, 20, 21, 22]
    assert drawn.extinction_mag is not None
    assert drawn.extinction_mag.tolist() == [10, 11, 12, 13, 14, 30, 31, 32]
    np.testing.assert_array_equal(drawn.passage, np.concatenate([one.passage, other.passage]))
