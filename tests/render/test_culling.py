"""Which stars touch an image between the sampled times, and how long their steps are, by hand-made paths."""

from dataclasses import replace
from math import hypot

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from glstar.camera.distortion import Lens
from glstar.camera.model import Camera
from glstar.camera.sensor.sensor import Sensor
from glstar.render.motion import pointing as pointing_module
from glstar.render.motion.pointing import Pointing
from glstar.render.motion.starpaths import view_limit_rad
from glstar.render.scene.culling import StarCuller, _outward_normals
from tests.support.scenes import camera, star_field

LENS = camera(320, 240, 300.0)
MARGIN_PX = 3.0


def pitched(angles_rad: list[float]) -> Pointing:
    """Return a camera that is pitched by some angles from the axis, without refraction, under a far zenith."""
    C = Rotation.from_rotvec(np.outer(angles_rad, [1.0, 0, 0])).as_matrix()
    zenith = np.tile([0.0, 0.0, 1.0], (len(C), 1))
    return Pointing(C, zenith, 0 * zenith, 0.0)


def steps(xy_px, angles_rad: list[float], time_fraction=None, lens: Camera = LENS, margin_px=MARGIN_PX):
    """Return what the culler finds of stars at given pixels of a camera that is not pitched, and their paths."""
    direction = lens.unit_vectors(np.array(xy_px, dtype=np.float64))
    pointing = pitched(angles_rad)
    culler = StarCuller(star_field(direction, np.full(len(direction), 3.0)), lens, Sensor())
    fractions = np.full(len(angles_rad) - 1, 1 / (len(angles_rad) - 1)) if time_fraction is None else time_fraction
    found = culler._steps(
        pointing, fractions, np.arange(len(direction)), np.full(len(direction), margin_px), np.ptp(angles_rad)
    )
    return found, lens.project(pointing.to_camera(direction))


@pytest.mark.parametrize(("part", "touches"), [(0.97, False), (1.03, True)])
def test_a_star_may_graze_the_image_within_half_a_step(part: float, touches: bool) -> None:
    """Its ends are 10 px and more to the left of the image, where it is drawn up to 3 px."""
    half_rad = part * 7.0 / 300.0
    (found, _, longest_px), path = steps([(-10.5, 119.5)], [-half_rad, half_rad])
    # Along the left border, by twice the 7 px between its path and what is drawn.
    assert np.linalg.norm(path[1] - path[0]) == pytest.approx(14 * part, rel=0.005)
    assert found.tolist() == [touches]
    assert longest_px == 0.0  # of a star on the image


def test_half_a_step_counts_of_the_two_times_beside_it() -> None:
    """A long step far from the image does not let a star graze it in a short one."""
    (found, slowest_px, _), path = steps([(-20.5, 119.5)], [0.0, 0.01, 0.9, 0.91])
    first, second, _ = np.linalg.norm(np.diff(path, axis=0), axis=-1)[:, 0]
    assert first < 4
    assert second > 100
    assert found.tolist() == [True]  # within half of the second step, which begins beside the image
    (found, slowest_px, _), path = steps([(-20.5, 119.5)], [-0.01, 0.0, 0.01])
    assert found.tolist() == [False]
    # A step of 300 px, whose ends are both above the image, and a short one, which ends beside it.
    (found, slowest_px, _), path = steps([(-20.5, 119.5)], [1.1, 0.7, 0.01, 0.0])
    assert np.linalg.norm(np.diff(path, axis=0), axis=-1)[2, 0] < 5
    assert slowest_px[0] == pytest.approx(3 * np.linalg.norm(np.diff(path, axis=0), axis=-1).min())


@pytest.mark.parametrize(("outside_px", "touches"), [(0.98, True), (1.02, False)])
def test_no_step_across_the_image_is_longer_than_its_diagonal(outside_px: float, touches: bool) -> None:
    beside_px = outside_px * (MARGIN_PX + hypot(320, 240) / 2)
    (found, _, longest_px), path = steps([(-0.5 - beside_px, 119.5)], [0.0, 1.25])
    assert np.linalg.norm(path[1] - path[0]) > 800
    assert found.tolist() == [touches]
    assert longest_px == 0.0


@pytest.mark.parametrize("angles_rad", [[0.0, 0.02, 0.9, 0.92], [0.92, 0.9, 0.02, 0.0]])
def test_the_longest_step_has_an_end_on_the_image(angles_rad: list[float]) -> None:
    (found, _, longest_px), path = steps([(160.0, 120.0), (100.0, 100.0)], angles_rad)
    lengths = np.linalg.norm(np.diff(path, axis=0), axis=-1)
    assert found.tolist() == [True, True]
    # The second step leaves the image; a third one of either star would be longer, but is outside.
    assert longest_px == pytest.approx(lengths[1].max())
    (_, _, longest_px), path = steps([(160.0, 120.0)], [0.0, 0.02, 1.2, 1.3])
    lengths = np.linalg.norm(np.diff(path, axis=0), axis=-1)[:, 0]
    assert lengths[2] > 300
    assert longest_px == pytest.approx(lengths[1])


def test_rates_are_those_of_the_durations_between_times() -> None:
    fraction = np.array([0.5, 0.1, 0.4])
    (_, slowest_px, _), path = steps([(160.0, 120.0)], [0.0, 0.05, 0.08, 0.1], fraction)
    lengths = np.linalg.norm(np.diff(path, axis=0), axis=-1)[:, 0]
    assert slowest_px[0] == pytest.approx((lengths / fraction).min())


def test_a_star_that_is_seen_at_a_single_time_has_no_rate() -> None:
    (found, slowest_px, longest_px), path = steps([(160.0, 120.0), (100.0, 90.0)], [-2.0, 0.0, 2.0])
    assert np.isnan(path[[0, 2]]).all()
    assert (found.tolist(), slowest_px.tolist(), longest_px) == ([True, True], [0.0, 0.0], 0.0)


def test_steps_of_many_blocks_are_those_of_one(monkeypatch: pytest.MonkeyPatch) -> None:
    xy = [(160.0, 120.0), (-8.0, 20.0), (40.0, 700.0), (330.0, 120.0), (-300.0, 120.0)]
    angles, fraction = np.linspace(-0.5, 0.5, 8) ** 3 * 4, np.array([0.1, 0.2, 0.15, 0.05, 0.25, 0.1, 0.15])
    whole, _ = steps(xy, angles.tolist(), fraction)
    monkeypatch.setattr(pointing_module, "times_per_block", lambda _: 2)
    parts, _ = steps(xy, angles.tolist(), fraction)
    for of_whole, of_parts in zip(whole, parts, strict=True):
        np.testing.assert_array_equal(of_parts, of_whole)


@pytest.mark.parametrize(("part", "touches"), [(0.98, True), (1.02, False)])
def test_stars_beside_the_image_are_drawn_up_to_their_radius_and_a_pixel(part: float, touches: bool) -> None:
    sensor = Sensor()
    margin_px = sensor.truncation_radius_px(sensor.peak_dn(np.array([2.0]), 0.5))[0] + 1
    assert margin_px < 20  # one pixel is more than what is tested
    direction = LENS.unit_vectors([(319.5 + part * margin_px, 120.0)])
    pointing = pitched([0.0, 0.0, 0.0])
    culler = StarCuller(star_field(direction, np.array([2.0])), LENS, sensor)
    assert (len(culler.touching(pointing, np.full(2, 0.5), 0.5).index) == 1) == touches


def test_a_star_that_leaves_the_image_counts_with_the_step_at_the_farthest_corner() -> None:
    """It goes nearly at right angles to the axis, where its position on the image is far outside."""
    direction = LENS.unit_vectors([(160.0, 120.0)])
    angles_rad = [0.0, 0.75, 1.5]
    touching = StarCuller(star_field(direction, np.array([2.0])), LENS, Sensor()).touching(
        pitched(angles_rad), np.full(2, 0.5), 0.5
    )
    # f / cos^2 of the angle of the farthest corner, and 0.75 rad.
    assert touching.longest_step_px == pytest.approx(
        min(0.75 * 300 * (1 + 200**2 / 300**2), 300 * np.tan(0.75)), rel=5e-3
    )


CIRCLE = Lens("fisheye", (-0.3, 0.0, 0.0, 0.0))


def circle(width_px: int) -> Camera:
    """Return a camera whose lens maps directions up to 60.4 deg only: r = f (a - 0.3 a^3) is largest there."""
    return replace(camera(width_px, width_px, 300.0), lens=CIRCLE)


@pytest.mark.parametrize("part", [0.97, 1.03])
def test_a_star_may_come_into_view_between_two_times_where_the_lens_ends_on_the_image(part: float) -> None:
    wide, narrow = circle(1000), circle(200)
    limit_rad = view_limit_rad(wide)
    assert limit_rad == pytest.approx(np.sqrt(1 / 0.9), abs=1e-3)
    step_rad = 0.1
    for lens in (wide, narrow):
        angle = limit_rad + part * step_rad
        in_camera = np.array([[[0.0, np.sin(angle), np.cos(angle)], [0.0, 0.0, 1.0]]]) * 1.001
        xy = lens.project(in_camera)
        found = StarCuller(star_field(in_camera[0], np.ones(2)), lens, Sensor())._passes_limit(in_camera, xy, step_rad)
        if lens is wide:
            # The star on the axis has a position: others decide whether it touches.
            assert found.tolist() == [part < 1, False]
        else:
            assert found is False  # the lens covers the image
    assert StarCuller(star_field(in_camera[0], np.ones(2)), LENS, Sensor())._passes_limit(in_camera, xy, 0.1) is False


def test_stars_near_the_limit_of_a_lens_touch_by_their_steps() -> None:
    """With a step of 0.2 rad: stars that are behind the limit at both times, 0.15 and 0.25 rad from it."""
    lens = circle(1000)
    limit_rad = view_limit_rad(lens)
    angles = limit_rad + np.array([0.15, 0.25])
    direction = np.column_stack([np.sin(angles), 0 * angles, np.cos(angles)])
    pointing = pitched([0.0, 0.2, 0.0])
    culler = StarCuller(star_field(direction, np.ones(2)), lens, Sensor())
    touches, _, _ = culler._steps(pointing, np.full(2, 0.5), np.arange(2), np.full(2, 3.0), 0.2)
    assert touches.tolist() == [True, False]


def test_the_sides_of_the_image_are_planes_through_its_border() -> None:
    normals = _outward_normals(LENS)
    top, right, bottom, left = (
        LENS.unit_vectors(at) for at in ([(30.0, -0.5), (300.0, -0.5)], [(319.5, 20.0), (319.5, 230.0)],
                                         [(30.0, 239.5), (300.0, 239.5)], [(-0.5, 20.0), (-0.5, 230.0)])
    )  # fmt: skip
    for rays in (top, right, bottom, left):
        outside = normals @ rays.T
        np.testing.assert_allclose(outside.max(axis=0), 0.0, rtol=0, atol=1e-12)
        assert np.count_nonzero(np.abs(outside) < 1e-12) == 2
