"""What a scene is composed of, against integrals and definitions written out: ridges, cloud, culling and discs."""

from dataclasses import replace
from itertools import pairwise
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from glstar.camera.distortion import Lens
from glstar.camera.exposure import Exposure
from glstar.camera.sensor.sensor import Sensor
from glstar.render.motion.pointing import Pointing
from glstar.render.motion.trailmodels import AnalyticSegments
from glstar.render.scene.attenuation import Attenuation, StarScintillation, _with_passage
from glstar.render.scene.bodies import (
    _disc_axes,
    _points_of_disc,
    _radiance,
    _two_points,
    body_field,
    disc_on_image,
    disc_sources,
    star_sigma_rad,
)
from glstar.render.scene.culling import (
    DrawList,
    StarCuller,
    TouchingStars,
    _largest_rotation_rad,
    _outward_normals,
    _while_seen,
)
from glstar.render.scene.occlusion import NEVER, Ridge, _crossings, _part_above, divided
from glstar.render.scene.transmission import Sources, Transmission, transmission_through
from glstar.sky.observed.solarsystem import Body
from tests.support.scenes import camera, star_field

LENS = camera(320, 240, 300.0)


def rotated(times: np.ndarray, rates=(0.3, -0.2, 0.5)) -> Pointing:
    """Return a camera that turns uniformly, under a zenith that moves."""
    C = Rotation.from_rotvec(np.outer(times, rates)).as_matrix()
    zenith = np.column_stack([np.sin(0.4 * times), 0 * times, np.cos(0.4 * times)])
    return Pointing(C, zenith, np.column_stack([times, times**2, 0 * times]) * 1e-6, 1.0)


def test_transmissions_are_linear_between_times_and_integrated_exactly() -> None:
    rng = np.random.default_rng(1)
    fraction = rng.random((6, 3))
    transmission, even = Transmission(fraction), np.linspace(0, 1, 6)
    at = np.array([-0.1, 0.0, 0.13, 0.4, 0.77, 1.0, 2.0])
    expected = np.column_stack([np.interp(at, even, one) for one in fraction.T])
    np.testing.assert_allclose(transmission.at(at), expected, rtol=0, atol=1e-12)
    parts = np.array([0.1, 0.35, 0.05, 0.5])
    ends = np.concatenate([[0], np.cumsum(parts)])
    for k, (first, last) in enumerate(pairwise(ends)):
        dense = first + (np.arange(100_000) + 0.5) / 100_000 * (last - first)
        mean = [np.interp(dense, even, one).mean() for one in fraction.T]
        np.testing.assert_allclose(transmission.means(3 * parts)[k], mean, rtol=0, atol=1e-6)
    np.testing.assert_allclose(transmission.mean, np.trapezoid(fraction, even, axis=0), rtol=0, atol=1e-12)
    two = [SimpleNamespace(fraction=lambda _s, n, f=f: np.full((n, 2), f)) for f in (0.5, 0.3)]
    np.testing.assert_allclose(
        transmission_through(two, Sources(np.zeros((2, 3)), np.zeros(0)), 4).fraction, 0.15, rtol=1e-7
    )


def test_the_part_above_zero_is_that_of_a_line() -> None:
    rng = np.random.default_rng(2)
    first, last = rng.normal(0, 1, (2, 40))
    first[:5], last[:5] = [0.0, 0, -1, 2, -0.5], [0.0, 1, 0, 2, -0.5]
    line = first + (np.arange(20_000)[:, np.newaxis] + 0.5) / 20_000 * (last - first)
    np.testing.assert_allclose(_part_above(first, last), (line >= 0).mean(axis=0), rtol=0, atol=1e-4)


def ridge(heights: np.ndarray | None = None, *, seconds: float = 20.0, px_per_rad: float = 1000.0) -> Ridge:
    def pointings(times_s: np.ndarray):
        assert (times_s[0], times_s[-1]) == (100.0, 100.0 + seconds)
        return (SimpleNamespace(clearance=lambda _: heights),)

    return Ridge(SimpleNamespace(pointings=pointings), Exposure(100.0, seconds), px_per_rad)


def test_a_star_is_up_in_the_half_intervals_in_which_it_is_above_the_ridge() -> None:
    heights = np.array([[1.0, -1, 3], [1, 2, -1], [1, 1, 1], [1, -4, 2]])
    found = ridge(heights).fraction(Sources(np.zeros((3, 3)), np.zeros(0)), 4)
    even = np.arange(4)
    for k in range(4):
        inside = np.linspace(max(k - 0.5, 0), min(k + 0.5, 3), 200_001)
        up = np.column_stack([np.interp(inside, even, one) >= 0 for one in heights.T])
        np.testing.assert_allclose(found[k], up.mean(axis=0), rtol=0, atol=1e-4)


def test_ridges_are_sampled_and_divided_by_the_motion_of_the_sky() -> None:
    rate = 7.2921e-5  # rad/s
    for seconds, px_per_rad in ((20.0, 1000.0), (100.0, 3000.0), (1.0, 100.0), (3000.0, 9000.0)):
        moved_px = rate * seconds * px_per_rad
        expected = np.clip(np.ceil(moved_px / 0.1) + 1, 5, 513)
        assert ridge(seconds=seconds, px_per_rad=px_per_rad).min_times == expected
    one = ridge(seconds=100.0, px_per_rad=1000.0)  # 7.3 px
    fraction = np.ones((11, 2))
    fraction[4:] = [1.0, 0.0]
    # Of segments that end at 0.2, 0.3, 0.6 and 1 those between 0.3 and 0.4 of the exposure.
    parts = one.parts(fraction, np.array([0.2, 0.1, 0.3, 0.4]))
    assert parts.tolist() == [1, 1, np.ceil(7.2921 * 0.3 / 0.05), 1]
    assert one.parts(fraction, np.array([0.35, 0.65])).tolist() == [np.ceil(7.2921 * 0.35 / 0.05), 95]
    assert ridge(px_per_rad=1.0).parts(fraction, np.array([1.0])).tolist() == [16]
    assert ridge(px_per_rad=1e6).parts(fraction, np.array([1.0])).tolist() == [512]


def test_divided_segments_follow_the_same_conics() -> None:
    times = np.array([0.0, 0.2, 0.4, 0.7, 1.0])
    trails = AnalyticSegments(replace(rotated(times), pole_eq=rotated(times).zenith_eq[:, ::-1]), np.array([0.4, 0.6]))
    assert divided(trails, np.array([1, 1])) is trails
    fine = divided(trails, np.array([2, 3]))
    np.testing.assert_allclose(fine.time_fraction, [0.2, 0.2, 0.2, 0.2, 0.2], rtol=1e-7)
    elapsed = [(0, np.arange(4) / 4), (1, np.arange(6) / 6)]
    C, weight = trails.pointing.C_camera_eq, trails.end_weight
    row = 0
    for segment, at in elapsed:
        ends = 2 * segment, 2 * segment + 2
        nodes = np.array([C[ends[0]] * weight[segment], C[ends[0] + 1], C[ends[1]] * weight[segment]])
        for u in at:
            lagrange = np.array([2 * (u - 0.5) * (u - 1), -4 * u * (u - 1), 2 * u * (u - 0.5)])
            matrix = np.tensordot(lagrange, nodes, 1)
            matrix /= np.linalg.norm(matrix, axis=1).mean()
            np.testing.assert_allclose(fine.pointing.C_camera_eq[row], matrix, rtol=0, atol=1e-12)
            zenith, velocity, pole = (
                (1 - u) * v[ends[0]] + u * v[ends[1]]
                for v in (trails.pointing.zenith_eq, trails.pointing.velocity_eq, trails.pointing.pole_eq)
            )
            np.testing.assert_allclose(
                fine.pointing.zenith_eq[row], zenith / np.linalg.norm(zenith), rtol=0, atol=1e-12
            )
            np.testing.assert_allclose(fine.pointing.velocity_eq[row], velocity, rtol=0, atol=1e-18)
            np.testing.assert_allclose(fine.pointing.pole_eq[row], pole, rtol=0, atol=1e-12)
            row += 1
    np.testing.assert_array_equal(fine.pointing.C_camera_eq[-1], C[-1])
    assert (len(fine.pointing), row) == (11, 10)


def test_crossings_are_roots_of_the_quadratic_through_three_heights() -> None:
    durations = np.array([0.3, 0.7])
    # Roots at elapsed fractions of each segment: a rise, a set and rise, a set in the second, none.
    roots = [((0, 0.2),), ((0, 0.6), (1, 0.25)), ((1, 0.8),), ()]
    heights = np.zeros((5, 4))
    u = np.array([0.0, 0.5, 1.0])
    heights[:3, 0], heights[2:, 0] = (u - 0.2) * (u + 2), 1.3 * (2 + u) * 0.8 * 3 / 2.6 / 1.2
    heights[2, 0] = 0.8 * 3
    heights[:3, 1] = (0.6 - u) * (2 - u)
    heights[2:, 1] = -0.4 * (0.25 - u) / 0.25 * (3 - u) / 3
    heights[:3, 2], heights[2:, 2] = 2 - u, (0.8 - u) * (2.5 + u) / 2
    heights[:, 3] = -1
    begins = np.array([0.0, 0.3])
    times = _crossings(heights, durations)
    at = [[begins[s] + r * durations[s] for s, r in one] for one in roots]
    np.testing.assert_allclose(times[0], [at[0][0], NEVER], rtol=0, atol=1e-12)
    np.testing.assert_allclose(times[1], [at[1][1], at[1][0]], rtol=0, atol=1e-12)
    np.testing.assert_allclose(times[2], [0.0, at[2][0]], rtol=0, atol=1e-12)
    assert times[3].tolist() == [NEVER, NEVER]


def test_scintillation_is_sampled_every_two_px_but_not_more_often_than_it_changes() -> None:
    def times(turned_px: float, seconds: float) -> int:
        pointing = SimpleNamespace(rotation_rad=np.full(16, turned_px / 1000 / 16))
        motion = SimpleNamespace(pointings=lambda t: (pointing,) if len(t) == 17 else ())
        return StarScintillation(None, motion, Exposure(50.0, seconds), 1000.0).min_times

    assert times(100.1, 1.0) == 52
    assert times(31.9, 1.0) == 17  # 16 steps
    assert times(29.9, 1.0) == 2  # 15 steps are too few
    assert times(5000.0, 0.0999) == 51
    assert times(5000.0, 9.0) == 513


def test_segments_are_divided_where_the_light_of_a_bright_star_changes() -> None:
    rng = np.random.default_rng(4)
    fraction, brightness = rng.random((9, 5)) * [1, 1, 1, 0.3, 1e-5], np.array([1.0, 0.5, 0.01, 0.2, 3.0])
    limits = SimpleNamespace(max_change=0.07), SimpleNamespace(max_change=0.11)
    attenuation = Attenuation(limits[0], limits[1])
    parts = attenuation._gradual_parts(fraction, np.array([0.2, 0.05, 0.75]), brightness)

    largest = fraction.max(axis=0)
    relative_to = np.clip(np.maximum(largest, 0.05 * (brightness * largest).max() / brightness), 1e-3, 1.0)
    change = (np.abs(np.diff(fraction, axis=0)) / relative_to).max(axis=1)
    per_segment = []
    for first, last in ((0, 0.2), (0.2, 0.25), (0.25, 1.0)):
        inside = np.clip(np.minimum(last * 8, np.arange(1, 9)) - np.maximum(first * 8, np.arange(8)), 0, 1)
        per_segment.append((inside * change).sum())
    assert parts.tolist() == np.clip(np.ceil(np.array(per_segment) / 0.07), 1, 32).tolist()
    steep = attenuation._gradual_parts(np.array([[1.0], [0.0]] * 20), np.array([1.0]), np.ones(1))
    assert steep.tolist() == [32]
    assert attenuation.gradual == limits
    assert attenuation.attenuators == limits
    assert Attenuation().min_times == 2
    listed = _with_passage(
        DrawList(np.arange(5, dtype=np.int32), np.ones(5)), Transmission(fraction), np.array([0.5, 0.5])
    )
    np.testing.assert_allclose(listed.passage, Transmission(fraction).means(np.array([0.5, 0.5])).T, rtol=1e-6)


def test_a_draw_list_keeps_its_columns_together() -> None:
    passage = np.arange(21, dtype=np.float32).reshape(3, 7)
    listed = DrawList(
        np.array([4, 2, 7], np.int32), np.array([1.0, 2, 3]), np.array([5.0, 6, 7]), np.array([0.0, 1, 2.5]), passage
    )
    np.testing.assert_allclose(listed.transmission, [1, 10**-0.4, 0.1], rtol=1e-7)
    some = listed[np.array([True, False, True])]
    assert (some.index.tolist(), some.truncation_radius_px.tolist(), some.min_trail_px.tolist()) == (
        [4, 7],
        [1, 3],
        [5, 7],
    )
    assert (some.extinction_mag.tolist(), some.passage[1].tolist()) == ([0, 2.5], passage[2].tolist())
    assert listed[:1].passage.tolist() == passage[:1].tolist()
    groups = listed.passage_of_groups(3)
    np.testing.assert_allclose(groups[0], [1, 4, 6], rtol=1e-7)
    np.testing.assert_allclose(groups[2], [15, 18, 20], rtol=1e-7)
    plain = DrawList(np.array([1, 0], np.int32), np.ones(2))
    assert (plain.passage_of_groups(3).shape, plain.transmission.tolist()) == ((0, 0), [1, 1])
    assert (plain.min_trail_px.tolist(), plain[1:].passage, len(plain)) == ([0, 0], None, 2)
    stars = star_field(np.tile([0.0, 0, 1], (8, 1)), np.arange(8.0))
    assert listed.observed_mag(stars).tolist() == [4, 3, 9.5]
    assert plain.observed_mag(stars).tolist() == [1, 0]


def test_rotations_and_sides_of_the_image_are_those_of_its_corners() -> None:
    rng = np.random.default_rng(5)
    C, other = (Rotation.random(30, random_state=seed).as_matrix() for seed in (1, 2))
    angles = np.arccos((np.trace(np.swapaxes(C, 1, 2) @ other, axis1=1, axis2=2) - 1) / 2)
    assert _largest_rotation_rad(C, other) == pytest.approx(angles.max())
    normals = _outward_normals(LENS)
    np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1, rtol=1e-7)
    xy = rng.uniform(-200, 500, (400, 2))
    outside = (normals @ LENS.unit_vectors(xy).T).max(axis=0) > 0
    x, y = xy.T
    np.testing.assert_array_equal(outside, (x < -0.5) | (x > 319.5) | (y < -0.5) | (y > 239.5))


def test_the_cone_and_the_sides_hold_every_star_of_the_image() -> None:
    rng = np.random.default_rng(6)
    direction = rng.normal(0, 1, (20_000, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    stars = star_field(direction, np.full(len(direction), 3.0))
    sensor = SimpleNamespace(widest_sigma_px=1.5)
    culler = StarCuller(stars, LENS, sensor)
    pointing = rotated(np.linspace(0, 0.4, 21))
    pointing = replace(pointing, refraction_scale=0.0, zenith_eq=pointing.boresight_eq)
    seen = LENS.contains(LENS.project(pointing.to_camera(direction)), 12.0).any(axis=0)
    cone = culler._within_cone(pointing)
    step = _largest_rotation_rad(pointing.C_camera_eq[:-1], pointing.C_camera_eq[1:])
    sides = culler._within_sides(pointing, step, cone)
    assert set(np.flatnonzero(seen)) <= set(sides) <= set(cone)
    # The bounds are narrow: a cone around the image's corners, and its sides.
    assert len(sides) < 3.0 * seen.sum()
    middle = pointing.boresight_eq[10]
    swing = np.arccos(np.clip(pointing.boresight_eq @ middle, -1, 1)).max()
    half_diagonal = np.arctan(np.hypot(160.5, 120.5) / 300)
    angle = np.arccos(np.clip(direction[cone] @ middle, -1, 1)).max()
    assert half_diagonal + swing < angle < half_diagonal + swing + 0.08
    lens = replace(LENS, lens=Lens("plumb_bob", (-0.1, 0.0, 0.0, 0.0, 0.0)))
    np.testing.assert_array_equal(StarCuller(stars, lens, sensor)._within_sides(pointing, step, cone), cone)


def test_stars_that_touch_are_dimmed_by_the_air_in_the_middle_of_the_exposure() -> None:
    direction = LENS.unit_vectors([(160.0, 120.0), (40.0, 200.0), (-3.0, 100.0), (-60.0, 100.0)])
    culler = StarCuller(star_field(direction, np.full(4, 4.0)), LENS, Sensor(), 0.3)
    times = np.linspace(-0.02, 0.02, 9)
    zenith = np.column_stack([np.sin(0.5 + times), 0 * times, np.cos(0.5 + times)])
    C = Rotation.from_rotvec(np.outer(times, [0.0, 0.2, 0.0])).as_matrix()
    pointing = Pointing(C, zenith, np.zeros((9, 3)), 0.0)
    touching = culler.touching(pointing, np.full(8, 1 / 8), 0.5)
    assert touching.index.tolist() == [0, 1, 2]
    # Up to 60 deg from the zenith the air mass is nearly the secant of the distance.
    secant = 1 / (direction[:3] @ zenith[4])
    np.testing.assert_allclose(touching.extinction_mag, 0.3 * secant, rtol=0.005)
    np.testing.assert_allclose(touching.peak_dn, Sensor().peak_dn(4.0 + touching.extinction_mag, 0.5), rtol=1e-7)
    path = LENS.project(pointing.to_camera(direction[:3]))
    steps = np.linalg.norm(np.diff(path, axis=0), axis=-1)
    np.testing.assert_allclose(touching.slowest_px, 8 * steps.min(axis=0), rtol=1e-7)
    assert touching.longest_step_px == pytest.approx(steps.max())
    assert StarCuller(culler.stars, LENS, Sensor()).touching(pointing, np.full(8, 1 / 8), 0.5).extinction_mag is None


def test_stars_that_set_are_followed_below_the_horizon() -> None:
    pointing = replace(rotated(np.linspace(0, 1, 5), (0.0, 0, 0)), refraction_scale=0.0)
    direction = np.array([[0.0, 0, 1], [1, 0, -0.2], [-1, 0, 0.3], [0, 0.6, -0.8]])
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    up = pointing.zenith_eq @ direction.T >= 0
    assert [one.any() and not one.all() for one in up.T] == [False, True, True, False]
    seen = _while_seen(pointing, direction)
    assert np.isnan(seen[:, 3]).all()
    np.testing.assert_allclose(seen[:, :3], pointing.to_camera(direction[:3], below_horizon=True), rtol=1e-7)


def test_the_faintest_trails_are_left_out_up_to_a_fraction_of_the_light() -> None:
    peak = np.array([1000.0, 0.3, 0.1, 5.0, 0.25, 0.02])
    sensor = SimpleNamespace(
        truncation_radius_px=lambda peak, slowest=None, renormalized=False: peak + (renormalized * 1.0),
        max_trail_peak_dn=lambda peak, slowest: peak / (1 + slowest),
    )
    touching = TouchingStars(SimpleNamespace(sensor=sensor), np.arange(6, dtype=np.int32), peak, np.full(6, 9.0), 1.0)
    # 5e-4 of 1005.67 DN are 0.503 DN: 0.02, 0.1 and 0.25 DN, but not 0.3 DN more.
    assert touching.integrated(0.04).index.tolist() == [0, 1, 3]
    assert touching.integrated(0.012).index.tolist() == [0, 1, 3, 4]
    assert touching.integrated(0.001).index.tolist() == [0, 1, 2, 3, 4, 5]
    assert touching.integrated(0.001).truncation_radius_px.tolist() == (peak + 1).tolist()
    assert touching.summed.truncation_radius_px.tolist() == peak.tolist()
    assert touching.listed.min_trail_px.tolist() == [9.0] * 6


def body(name: str = "Moon", *, phase_rad: float = 1.0, radius_rad: float = 0.004, **changes) -> Body:
    sun = np.array([np.sin(phase_rad), 0.0, -np.cos(phase_rad)]) if name != "Sun" else np.zeros(3)
    limb = None if name == "Sun" else 0.3
    values = (np.array([0.0, 0, 1]), sun, 0.0, 0.5, 0.5, 4e5, radius_rad, phase_rad, limb, -10.0)
    return replace(Body(name, *values), **changes)


def test_two_points_have_the_moments_of_a_cell() -> None:
    rng = np.random.default_rng(7)
    places, light = np.sort(rng.uniform(-1, 1, (5, 8)), axis=1), rng.random((5, 8)) + 0.1
    at, flux = _two_points(places, light)
    for power in range(4):
        np.testing.assert_allclose(
            (flux * at**power).sum(axis=1), (light * places**power).sum(axis=1), rtol=0, atol=1e-12
        )


@pytest.mark.parametrize(("name", "phase_rad"), [("Moon", 0.0), ("Moon", 1.2), ("Moon", 2.6), ("Sun", 0.0)])
def test_points_of_a_disc_have_the_light_of_its_lit_part(name: str, phase_rad: float) -> None:
    x, y, light = _points_of_disc(body(name, phase_rad=phase_rad), phase_rad, 0.3)
    along = (np.arange(400) + 0.5) / 200 - 1
    xx, yy = np.meshgrid(along, along)
    z = np.sqrt(np.maximum(1 - xx**2 - yy**2, 0))
    if name == "Sun":
        radiance = np.where(z > 0, 1 - 0.6 * (1 - z), 0)
    else:
        mu0 = np.maximum(xx * np.sin(phase_rad) + z * np.cos(phase_rad), 0)
        radiance = np.where(z > 0, mu0 / np.maximum(mu0 + z, 1e-9), 0)
    for a, b in ((0, 0), (1, 0), (0, 1), (2, 0), (0, 2), (3, 0), (1, 2)):
        expected = (radiance * xx**a * yy**b).sum() / radiance.sum()
        assert (light * x**a * y**b).sum() / light.sum() == pytest.approx(expected, abs=2e-3)
    # The light of the disc itself, by the area of the sphere's projection.
    assert light.sum() == pytest.approx(radiance.sum() / 200**2, rel=5e-3)
    assert (x**2 + y**2).max() < 1
    assert len(x) < 4 * (np.pi / 0.3 + 1) * (2 / 0.3 + 1)


def test_the_limb_of_the_sun_is_darker_and_axes_point_to_the_light() -> None:
    longitude = np.array([0.0, 0.6, -0.9])
    np.testing.assert_allclose(
        _radiance(body("Sun"), 0.0, longitude, 0.7), 1 - 0.6 * (1 - 0.7 * np.cos(longitude)), rtol=1e-7
    )
    mu0, mu = np.cos(longitude - 0.5), np.cos(longitude)
    np.testing.assert_allclose(_radiance(body(), 0.5, longitude, 0.7), mu0 / (mu0 + mu), rtol=1e-7)
    across, up = _disc_axes(body(phase_rad=2.0))
    np.testing.assert_allclose([across, up], [[1, 0, 0], [0, 1, 0]], rtol=0, atol=1e-12)
    across, up = _disc_axes(body("Sun"))
    np.testing.assert_allclose(
        np.array([across, up, [0, 0, 1]]) @ np.array([across, up, [0, 0, 1]]).T, np.eye(3), rtol=0, atol=1e-12
    )


def test_small_discs_are_points_and_the_earth_lights_the_whole_disc() -> None:
    sigma = 1e-3
    for radius, points in ((0.0199e-3, 1), (0.0201e-3, 2)):
        directions, vmag = disc_sources(body(radius_rad=radius), sigma)
        assert (len(vmag) == 1) == (points == 1)
        assert -2.5 * np.log10((10 ** (-0.4 * vmag)).sum()) == pytest.approx(-10)
    lit, dim = body(radius_rad=0.005), body(radius_rad=0.005, earthshine_vmag=-3.0)
    directions, vmag = disc_sources(dim, sigma)
    of_sun = len(disc_sources(lit, sigma)[1])
    assert -2.5 * np.log10((10 ** (-0.4 * vmag[of_sun:])).sum()) == pytest.approx(-3)
    x = directions[:, 0] / directions[:, 2] / np.tan(0.005)
    assert np.average(x[of_sun:], weights=10 ** (-0.4 * vmag[of_sun:])) == pytest.approx(0, abs=1e-9)
    assert x[:of_sun].min() > -np.cos(1.0) - 1e-9
    assert x[of_sun:].min() < -0.9
    # Rows of 1.75 sigma: pi over 0.35 is 8.98.
    assert len(np.unique(np.round(directions[:of_sun, 1] / directions[:of_sun, 2], 12))) == 2 * 9

    stars = star_field(np.array([[0.0, 0, 1]]), np.zeros(1))
    bodies = (dim, body("Mars", radius_rad=0.005), lit)
    field = body_field(bodies, stars, np.array([sigma, sigma, 2 * sigma]), np.array([True, False, True]))
    counts = np.bincount(field.star_id)
    assert counts.tolist() == [len(vmag), 1, len(disc_sources(lit, 2 * sigma)[1])]
    assert (field.name[counts[0]], field.vmag[counts[0]], field.catalogue) == ("Mars", -10.0, "bodies")


def test_the_scale_of_an_image_is_the_largest_on_the_path_of_a_body() -> None:
    fisheye = replace(camera(1000, 1000, 300.0), lens=Lens("fisheye", (0.05, 0.0, 0.0, 0.0)))
    angle = np.deg2rad([[5.0, 30.0], [40.0, 45.0]])
    # r = f (a + k a^3): outwards f (1 + 3 k a^2), around f (a + k a^3) / sin a.
    a = angle[1]
    outwards, around = 300 * (1 + 0.15 * a**2), 300 * (a + 0.05 * a**3) / np.sin(a)
    np.testing.assert_allclose(star_sigma_rad(fisheye, 1.3, angle), 1.3 / np.maximum(outwards, around), rtol=1e-4)


def test_the_disc_on_the_image_has_the_diameter_and_the_limb_of_its_projection() -> None:
    turn = Rotation.from_euler("zx", [0.7, 0.3]).as_matrix()
    pointing = Pointing(turn[np.newaxis], np.array([[0.0, 0, 1]]), np.zeros((1, 3)), 0.0)
    diameter_px, limb_deg = disc_on_image(LENS, pointing, body(radius_rad=0.004))
    ring = np.array([[np.cos(a), np.sin(a), 0] for a in np.linspace(0, 2 * np.pi, 721)]) * np.sin(0.004)
    x, y = LENS.project(pointing.to_camera(np.array([0.0, 0, 1]) + ring))[0].T
    area = abs(np.sum(x[:-1] * y[1:] - x[1:] * y[:-1])) / 2
    assert diameter_px == pytest.approx(np.sqrt(4 * area / np.pi), rel=1e-4)
    assert limb_deg == pytest.approx(np.rad2deg(np.arctan2(y[0] - y[360], x[0] - x[360])), abs=1e-3)
    assert disc_on_image(LENS, pointing, body("Sun"))[1] is None
    behind = replace(pointing, C_camera_eq=-pointing.C_camera_eq)
    assert disc_on_image(LENS, behind, body()) == (None, None)
