"""The camera's orientation at several times: directions with refraction, and horizons, by angles on the sphere."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from glstar.camera.exposure import Exposure
from glstar.camera.model import Mount
from glstar.flight import AttitudeTrack, Flight, PositionTrack
from glstar.render.motion import pointing as pointing_module
from glstar.render.motion.pointing import CameraMotion, MotionTable, Pointing, rates_rad_per_s
from glstar.render.motion.starpaths import times_per_block
from glstar.rotation import matrix_from_quaternion
from glstar.sky.air.refraction import refraction_rad
from glstar.sky.observed.stars import Sky
from glstar.sky.place.horizon import HorizonProfile, diurnal_aberration_rad
from tests.support.scenes import ADELAIDE, NIGHT_UTC_S, camera, sky_over_adelaide

TIMES, STARS = 3, 400
SCALE, SINE_HORIZON = 0.83, -0.021
PROFILE = HorizonProfile((0.3, 1.9, 4.4), (0.31, -0.02, 0.17))
# Largest error of the rational fit of refraction, which is proportional to its scale, rad.
FIT_RAD = 5e-7
# Below this the refraction is that of -1 deg as a displacement, not as an angle.
LOWEST_RAD = np.deg2rad(-1.0)


def unit(vectors: np.ndarray) -> np.ndarray:
    return vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)


def three_times(**changed: object) -> Pointing:
    """Return a camera, a zenith and a velocity, 1 % of that of light, which are different at three times."""
    rng = np.random.default_rng(4)
    C = Rotation.random(TIMES, random_state=2).as_matrix()
    zenith = unit(np.array([0.3, -0.5, 0.6]) + 0.2 * rng.normal(size=(TIMES, 3)))
    return replace(Pointing(C, zenith, 0.01 * rng.normal(size=(TIMES, 3)), SCALE, SINE_HORIZON), **changed)


def near_horizon(pointing: Pointing) -> np.ndarray:
    """Return directions all around, within 0.1 rad of the horizontal of the middle time and higher."""
    rng = np.random.default_rng(8)
    level = unit(np.cross(rng.normal(size=(STARS, 3)), pointing.zenith_eq[1]))
    return unit(level + rng.uniform(-0.1, 0.6, (STARS, 1)) * pointing.zenith_eq[1])


def seen(pointing: Pointing, directions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return unit vectors of observed directions, (n, m, 3), and true altitudes, rad, by rotations in the vertical."""
    moved = unit(directions + pointing.velocity_eq[:, np.newaxis])
    sine = np.einsum("nk,nmk->nm", pointing.zenith_eq, moved)
    altitude_rad = np.arcsin(sine)
    level = unit(moved - sine[..., np.newaxis] * pointing.zenith_eq[:, np.newaxis])
    apparent = altitude_rad + refraction_rad(altitude_rad, pointing.refraction_scale)
    lifted = np.cos(apparent)[..., np.newaxis] * level
    return lifted + np.sin(apparent)[..., np.newaxis] * pointing.zenith_eq[:, np.newaxis], altitude_rad


def azimuth_rad(vectors: np.ndarray, zenith: np.ndarray, pole: np.ndarray) -> np.ndarray:
    """Return azimuths from north through east, (m,), about one zenith and pole."""
    east = unit(np.cross(pole, zenith))
    return np.arctan2(vectors @ east, vectors @ np.cross(zenith, east))


def test_observed_directions_are_lifted_in_the_vertical_and_turned_into_the_camera() -> None:
    pointing = three_times(velocity_eq=three_times().velocity_eq * 1e-4)
    directions = near_horizon(pointing)
    expected, altitude_rad = seen(pointing, directions)
    apparent_rad = altitude_rad + refraction_rad(altitude_rad, SCALE)
    in_camera = np.einsum("nij,nmj->nmi", pointing.C_camera_eq, expected)
    found = pointing.to_camera(directions, below_horizon=True)
    is_fitted = altitude_rad > LOWEST_RAD
    np.testing.assert_allclose(unit(found)[is_fitted], in_camera[is_fitted], rtol=0, atol=FIT_RAD)
    each = directions[[5, 90, 300]]
    np.testing.assert_allclose(pointing.each_to_camera(each, below_horizon=True), found[range(3), [5, 90, 300]],
                               rtol=0, atol=1e-11)  # fmt: skip
    # Refraction of 0.5 deg: stars are up from 0.5 deg below the horizon on, but never from 1 deg on.
    is_up = apparent_rad > np.arcsin(SINE_HORIZON)
    seen_px = pointing.to_camera(directions)
    clear = np.abs(apparent_rad - np.arcsin(SINE_HORIZON)) > 1e-6
    # Below -1 deg of the horizon itself the refraction of -1 deg would lift no star.
    assert np.isfinite(seen_px).all(axis=-1)[clear].tolist() == is_up[clear].tolist()
    assert 20 < np.count_nonzero(~is_up[1]) < 100
    np.testing.assert_array_equal(seen_px[is_up & clear], found[is_up & clear])
    for time in range(TIMES):
        alone = pointing[np.full(STARS, time)].each_to_camera(directions)
        np.testing.assert_allclose(alone, seen_px[time], rtol=0, atol=1e-11)


def test_the_aberration_of_a_fast_observer_is_added_before_refraction() -> None:
    pointing = three_times()
    directions = near_horizon(pointing)
    s = np.einsum("nk,nmk->nm", pointing.zenith_eq, directions + pointing.velocity_eq[:, np.newaxis])
    heights = pointing.heights(directions)
    altitude_rad = np.arcsin(s)
    # q = sin R / cos(h + R) of the definition of the displacement.
    lift_rad = refraction_rad(altitude_rad, SCALE)
    q = np.sin(lift_rad) / np.cos(altitude_rad + lift_rad)
    lowest = np.sin(np.deg2rad(-1.0)) + SINE_HORIZON
    expected = np.where(s < lowest, np.minimum(s + q - SINE_HORIZON, s - lowest), s + q - SINE_HORIZON)
    is_fitted = altitude_rad > LOWEST_RAD
    np.testing.assert_allclose(heights[is_fitted], expected[is_fitted], rtol=0, atol=FIT_RAD)
    assert (heights[s < lowest] < 0).all()
    lift = q[..., np.newaxis] * pointing.zenith_eq[:, np.newaxis]
    in_camera = np.einsum("nij,nmj->nmi", pointing.C_camera_eq, directions + pointing.velocity_eq[:, np.newaxis] + lift)
    up = is_fitted & (heights > 0)
    np.testing.assert_allclose(pointing.to_camera(directions)[up], in_camera[up], rtol=0, atol=FIT_RAD)
    assert np.isnan(pointing.to_camera(directions)[heights < 0]).all()


def test_a_deep_horizon_hides_what_no_refraction_could_lift() -> None:
    """Of dense air the displacement at -1 deg, which is used below, would lift a star from any depth it has."""
    pointing = replace(three_times(), C_camera_eq=np.tile(np.eye(3), (3, 1, 1)), zenith_eq=np.tile([0.0, 0, 1], (3, 1)),
                       velocity_eq=np.zeros((3, 3)), refraction_scale=9.0)  # fmt: skip
    lowest = np.sin(np.deg2rad(-1.0)) + SINE_HORIZON
    sines = np.array([lowest + 1e-4, lowest - 1e-4, lowest - 0.01])
    directions = np.column_stack([np.sqrt(1 - sines**2), 0 * sines, sines])
    np.testing.assert_allclose(pointing.heights(directions)[:, 1:], [[-1e-4, -0.01]] * 3, rtol=0, atol=1e-12)
    assert (pointing.heights(directions)[:, 0] > 0.04).all()
    np.testing.assert_array_equal(np.isnan(pointing.to_camera(directions)[:, :, 0]), [[False, True, True]] * 3)
    np.testing.assert_array_equal(np.isnan(pointing.each_to_camera(directions)[:, 0]), [False, True, True])


@pytest.mark.parametrize("has_pole", [False, True])
def test_clearance_is_the_height_above_the_profile_below_a_star(has_pole: bool) -> None:
    pole = unit(np.array([[0.1, 0.2, 0.9], [-0.5, 0.1, 0.7], [0.3, -0.4, 0.8]]))
    still = three_times(velocity_eq=np.zeros((TIMES, 3)), profile=PROFILE, sine_horizon=-0.03)
    pointing = replace(still, pole_eq=pole) if has_pole else still
    directions = near_horizon(pointing)
    lifted, altitude_rad = seen(pointing, directions)
    apparent_rad = altitude_rad + refraction_rad(altitude_rad, SCALE)
    is_fitted = altitude_rad > LOWEST_RAD
    sine = pointing.sine_apparent_altitude(directions)
    np.testing.assert_allclose(sine[is_fitted], np.sin(apparent_rad)[is_fitted], rtol=0, atol=FIT_RAD)
    below_rad = np.stack([
        PROFILE.altitude_rad(azimuth_rad(of_stars, zenith, about if has_pole else np.array([0, 0, 1.0])))
        for of_stars, zenith, about in zip(lifted, pointing.zenith_eq, pole, strict=True)
    ])  # fmt: skip
    clearance = np.sin(apparent_rad) - np.sin(below_rad)
    np.testing.assert_allclose(pointing.clearance(directions)[is_fitted], clearance[is_fitted], rtol=0, atol=FIT_RAD)
    hidden = (clearance < 0) | (apparent_rad < np.arcsin(-0.03))
    np.testing.assert_array_equal(np.isnan(pointing.to_camera(directions)[..., 2]), hidden)
    assert 100 < np.count_nonzero(hidden[1]) < 300
    assert np.isfinite(pointing.to_camera(directions, below_horizon=True)).all()
    for time in range(TIMES):
        many = pointing[np.full(STARS, time)]
        np.testing.assert_array_equal(np.isnan(many.each_to_camera(directions)[:, 2]), hidden[time])
        assert np.isfinite(many.each_to_camera(directions, below_horizon=True)).all()
        np.testing.assert_array_equal(many.zenith_eq[7], pointing.zenith_eq[time])
        assert (many.pole_eq is None) != has_pole


def test_without_a_profile_clearance_is_that_of_the_sine_of_the_horizon() -> None:
    pointing = three_times()
    directions = near_horizon(pointing)
    expected = pointing.sine_apparent_altitude(directions) - SINE_HORIZON
    np.testing.assert_allclose(pointing.clearance(directions), expected, rtol=0, atol=1e-15)
    pole = np.array([0.0, 0.0, 1.0])
    profiled = replace(pointing, profile=PROFILE)
    sine, zenith = np.full(STARS, 0.2), pointing.zenith_eq[2]
    np.testing.assert_array_equal(
        profiled.above_horizon(directions.reshape(2, -1, 3), zenith, sine.reshape(2, -1)).ravel(),
        profiled.above_horizon(directions, zenith, sine),
    )
    np.testing.assert_allclose(
        profiled.above_horizon(directions, zenith, sine), profiled.above_horizon(directions, zenith, sine, pole),
        rtol=0, atol=1e-12,
    )  # fmt: skip


def test_blocks_share_their_overlap_and_none_is_empty() -> None:
    stars = 4000
    size = times_per_block(stars)
    assert size == 8
    assert (times_per_block(0), times_per_block(1), times_per_block(1000)) == (32768, 32768, 32)
    times = np.arange(20)
    pointing = Pointing(
        times[:, np.newaxis, np.newaxis] * np.ones((20, 3, 3)), np.zeros((20, 3)), np.zeros((20, 3)), 0.0
    )

    def numbers(overlap: int, count: int) -> list[list[int]]:
        return [part.C_camera_eq[:, 0, 0].tolist() for part in pointing[:count].blocks(stars, overlap=overlap)]

    assert numbers(0, 20) == [[*range(8)], [*range(8, 16)], [*range(16, 20)]]
    assert numbers(1, 20) == [[*range(9)], [*range(8, 17)], [*range(16, 20)]]
    assert numbers(1, 17) == [[*range(9)], [*range(8, 17)]]
    assert numbers(3, 2) == [[0, 1]]
    assert [len(part) for part in pointing.blocks(stars)] == [8, 8, 4]


def moving_motion(**sky: object) -> CameraMotion:
    """Return an aircraft that climbs, flies north-east and turns within a second."""
    t = NIGHT_UTC_S + np.array([0.0, 0.4, 1.0])
    q = np.array([[0.9, 0.1, -0.3, 0.2], [0.8, 0.2, -0.3, 0.3], [0.7, 0.3, -0.4, 0.5]])
    attitude = AttitudeTrack.from_samples(t, q / np.linalg.norm(q, axis=1, keepdims=True))
    position = PositionTrack.from_samples(t, [-0.61, -0.60, -0.57], [2.41, 2.43, 2.44], [900.0, 1000.0, 1500.0])
    still = sky_over_adelaide_stars()
    return CameraMotion(Flight(attitude, position), replace(still, **sky), Mount(0.1, 0.2, 0.3), 870.0, -7.0)


def sky_over_adelaide_stars() -> Sky:
    return sky_over_adelaide(camera(), vmag_limit=1.0).sky


def test_the_camera_at_several_arrays_of_times_is_composed_of_attitude_position_and_mount() -> None:
    motion = moving_motion(dip=True)
    times_s = [NIGHT_UTC_S + np.array(since) for since in ([0.1, 0.3, 0.45], [0.6, 0.9], [0.2])]
    latitude, longitude, height = motion.flight.position.coordinates(np.concatenate(times_s))
    C_ned_eq = motion.sky.C_ned_eq(np.concatenate(times_s), latitude, longitude)
    found = motion.at(*times_s)
    assert [len(one.pointing) for one in found] == [3, 2, 1]
    for one, numbers, middle, times in zip(found, ([0, 1, 2], [3, 4], [5]), (1, 4, 5), times_s, strict=True):
        q = motion.flight.attitude.at(times)
        np.testing.assert_array_equal(one.q_body_ned, q)
        C = motion.mount.C_camera_body @ matrix_from_quaternion(q) @ C_ned_eq[numbers]
        np.testing.assert_allclose(one.pointing.C_camera_eq, C, rtol=0, atol=1e-15)
        np.testing.assert_array_equal(one.pointing.boresight_eq, one.pointing.C_camera_eq[:, 2])
        np.testing.assert_array_equal(one.pointing.zenith_eq, -C_ned_eq[numbers][:, 2])
        site = one.site
        assert (site.latitude_rad, site.longitude_rad, site.height_m) == (
            latitude[middle], longitude[middle], height[middle],
        )  # fmt: skip
        assert (site.pressure_hpa, site.temperature_c) == (870.0, -7.0)
        east = diurnal_aberration_rad(site.latitude_rad, site.height_m) * C_ned_eq[numbers][:, 1]
        np.testing.assert_allclose(one.pointing.velocity_eq, east, rtol=1e-12)
        assert one.pointing.refraction_scale == pytest.approx(870 / 1010 * 283 / 266)
        assert one.pointing.sine_horizon == motion.sky.sine_horizon(site.height_m) < -0.01
        assert one.pointing.profile is None
    (profiled,) = replace(motion, sky=replace(motion.sky, profile=PROFILE)).pointings(times_s[1])
    assert profiled.profile is PROFILE
    turn = Rotation.from_matrix(found[0].pointing.C_camera_eq)
    steps = [(turn[k + 1] * turn[k].inv()).magnitude() for k in range(2)]
    np.testing.assert_allclose(found[0].pointing.rotation_rad, steps, rtol=1e-9)


def test_the_rate_is_that_of_the_camera_about_its_own_axes_in_the_middle_of_the_exposure() -> None:
    motion = moving_motion()

    def turned(first_s: float, last_s: float) -> np.ndarray:
        (pointing,) = motion.pointings(NIGHT_UTC_S + np.array([first_s, last_s]))
        before, after = pointing.C_camera_eq
        # Vectors turn against the camera.
        return -Rotation.from_matrix(after @ before.T).as_rotvec()

    # A knee of the turn rate at 0.4 s is where the step shows: half a millisecond on either side.
    at_knee = rates_rad_per_s(motion, Exposure(NIGHT_UTC_S + 0.3, 0.2001, rate_hz=100.0))
    np.testing.assert_allclose(at_knee, turned(0.39955, 0.40055) / 1e-3, rtol=1e-3)
    steady = rates_rad_per_s(motion, Exposure(NIGHT_UTC_S + 0.5, 0.2))
    np.testing.assert_allclose(steady, turned(0.5, 0.7) / 0.2, rtol=1e-3)
    # A quarter of it is before the knee.
    short = rates_rad_per_s(motion, Exposure(NIGHT_UTC_S + 0.3999, 4e-4))
    np.testing.assert_allclose(short, turned(0.3999, 0.4003) / 4e-4, rtol=3e-3)


def track(angles_rad: list[float], times_s: list[float]) -> AttitudeTrack:
    q = np.array([[np.cos(angle / 2), np.sin(angle / 2), 0, 0] for angle in angles_rad])
    return AttitudeTrack.from_samples(NIGHT_UTC_S + np.array(times_s), q)


def test_the_fastest_rate_is_that_between_the_samples_around_an_exposure() -> None:
    attitude = track([0.0, 0.5, 0.6, 0.9, 0.95, 1.95], [0.0, 0.1, 0.2, 0.3, 0.4, 0.5])
    fastest = pointing_module._fastest_rad_per_s
    # From the sample before the first to the last, which is the first one after the exposure.
    assert fastest(attitude, 2, 3) == pytest.approx(3.0, rel=1e-5)
    assert fastest(attitude, 1, 2) == pytest.approx(5.0, rel=1e-5)
    assert fastest(attitude, 4, 4) == pytest.approx(0.5, rel=1e-5)
    assert fastest(attitude, 4, 5) == pytest.approx(10.0, rel=1e-5)
    assert fastest(attitude, 0, 0) == 0.0


def table_of(attitude: AttitudeTrack, exposure: Exposure) -> MotionTable | None:
    """Return the table of a camera of which only the times are known: they are where its zenith would be."""

    def pointings(times_s: np.ndarray) -> list[Pointing]:
        since = times_s[:, np.newaxis] - exposure.start_utc_s
        return [Pointing(np.zeros((len(since), 3, 3)), since * [1.0, 0, 0], since * [0, 1.0, 0], 0.0)]

    return MotionTable.of(SimpleNamespace(flight=SimpleNamespace(attitude=attitude), pointings=pointings), exposure)


def test_parts_of_a_table_end_at_samples_of_the_log_and_after_33_mrad_of_turn() -> None:
    exposure = Exposure(NIGHT_UTC_S + 0.13, 0.2)
    table = table_of(track([0.0, 0.1, 0.3, 0.4, 0.45], [0.0, 0.1, 0.2, 0.3, 0.4]), exposure)
    # At most 2 rad/s: 33 mrad take 16.5 ms.
    expected = np.sort([0.0, 0.07, 0.17, 0.2, *(0.0165 * np.arange(1, 13))])
    np.testing.assert_allclose(table.ends_s, expected, rtol=0, atol=1e-6)
    times = np.empty(2 * len(expected) - 1)
    times[::2], times[1::2] = expected, (expected[1:] + expected[:-1]) / 2
    np.testing.assert_allclose(table.pointing.zenith_eq[:, 0], times, rtol=0, atol=1e-6)
    # A slow camera has a part per second at least.
    slow = table_of(track([0.0, 0.09, 0.18], [0.0, 3.0, 6.0]), Exposure(NIGHT_UTC_S + 0.5, 2.25))
    np.testing.assert_allclose(slow.ends_s, [0.0, 1.0, 2.0, 2.25], rtol=0, atol=1e-6)


@pytest.mark.parametrize(("samples", "steps", "has_table"), [(1900, 100, True), (1901, 100, False)])
def test_a_table_has_at_most_2000_samples_and_steps_together(samples: int, steps: int, has_table: bool) -> None:
    # One radian in the exposure would be 30 steps.
    turned = 0.033 * (steps + 0.5)
    inside = np.linspace(0.01, 0.99, samples)
    times = [-0.1, *inside.tolist(), 1.1]
    attitude = track([turned * time for time in times], times)
    assert (table_of(attitude, Exposure(NIGHT_UTC_S, 1.0)) is not None) == has_table


def test_a_table_also_interpolates_the_pole_of_a_turning_frame() -> None:
    def curve(since: np.ndarray) -> np.ndarray:
        """Return two quadratics, which meet at 1 s."""
        late = np.maximum(since - 1, 0)
        return np.column_stack([1 + since - since**2 + 3 * late**2, 2 - 0.5 * since + late, 0.3 * since**2 - 2 * late])

    nodes = curve(np.array([0.0, 0.5, 1.0, 2.0, 3.0]))
    pointing = Pointing(np.einsum("nk,j->nkj", nodes, [1.0, 2, 3]), 2 * nodes, 3 * nodes, 0.4, pole_eq=5 * nodes)
    table = MotionTable(np.array([0.0, 1.0, 3.0]), pointing)
    since = np.array([-0.2, 0.0, 0.3, 1.0, 1.7, 3.0, 3.1])
    expected = curve(since)
    at = table.at(since)
    np.testing.assert_allclose(at.C_camera_eq, np.einsum("nk,j->nkj", expected, [1.0, 2, 3]), rtol=0, atol=1e-12)
    for factor, found in ((2, at.zenith_eq), (3, at.velocity_eq), (5, at.pole_eq)):
        np.testing.assert_allclose(found, factor * expected, rtol=0, atol=1e-12)
    without = MotionTable(table.ends_s, replace(pointing, pole_eq=None)).at(since)
    np.testing.assert_allclose(without.velocity_eq, 3 * expected, rtol=0, atol=1e-12)
    assert without.pole_eq is None


def test_a_frame_of_a_fixed_site_has_its_latitude() -> None:
    flight = Flight(track([0.0, 0.1], [0.0, 1.0]), PositionTrack.fixed(ADELAIDE))
    motion = CameraMotion(flight, sky_over_adelaide_stars(), Mount(), 1010.0, 10.0)
    (pointing,) = motion.pointings(NIGHT_UTC_S + np.array([0.2, 0.7]))
    np.testing.assert_allclose(pointing.zenith_eq[:, 2], np.sin(ADELAIDE.latitude_rad), rtol=1e-12)
