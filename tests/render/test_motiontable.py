"""The table of the camera's orientation, and integrals of paths between times of each star, against dense positions."""

from dataclasses import replace

import numpy as np
import pytest

from glstar.render.motion.pointing import MotionTable
from tests.render.test_pathfit import CORNERS_AND_MORE, EXPOSURE, LENS, flown, rough

SECOND = np.arange(0.0, 1.0, 0.02)


@pytest.mark.parametrize(
    "simulator",
    [
        *(rough(hz, how) for hz in (10.0, 200.0) for how in ("slerp", "spline")),
        flown(SECOND, [5.0 * SECOND, 0 * SECOND, SECOND]),
    ],
    ids=["10", "10-spline", "200", "200-spline", "286-deg-per-s"],
)
def test_the_table_has_the_orientation_of_the_attitude_at_any_time(simulator):
    motion, exposure = simulator.motion, replace(EXPOSURE, readout_s=0.05)
    since_s = np.random.default_rng(1).uniform(0.0, exposure.span_s, 2000)
    (expected,) = motion.pointings(exposure.start_utc_s + since_s)
    table = MotionTable.of(motion, exposure).at(since_s)
    # UTC in seconds is rounded to 2e-7 s, a thousandth of a pixel at the highest rate.
    np.testing.assert_allclose(table.C_camera_eq, expected.C_camera_eq, rtol=0, atol=3e-3 / LENS.fx_px)
    np.testing.assert_allclose(table.zenith_eq, expected.zenith_eq, rtol=0, atol=1e-9)
    np.testing.assert_allclose(table.velocity_eq, expected.velocity_eq, rtol=0, atol=1e-12)


def test_an_exposure_of_very_many_parts_has_no_table():
    long = replace(EXPOSURE, start_utc_s=EXPOSURE.start_utc_s - 600.0, duration_s=600.0)
    assert MotionTable.of(rough(200.0).motion, long) is None


def test_a_slow_exposure_needs_no_more_parts_than_the_log_has_intervals():
    turn = flown(SECOND, np.deg2rad([5.0 * SECOND, 0 * SECOND, SECOND]))
    table = MotionTable.of(turn.motion, replace(EXPOSURE, readout_s=0.05))
    # Of 0.55 s in intervals of 0.02 s.
    assert len(table.ends_s) < 35


def test_the_integral_of_a_path_between_two_times_is_that_of_many_positions():
    scene = rough(50.0).scene(EXPOSURE)
    middle = len(scene.trails)
    directions_eq = LENS.unit_vectors(CORNERS_AND_MORE) @ scene.trails.pointing.C_camera_eq[middle]
    directions_eq /= np.linalg.norm(directions_eq, axis=1, keepdims=True)
    begin, end = np.random.default_rng(2).uniform([[0.0], [0.5]], [[0.5], [1.0]], (2, len(directions_eq)))
    end[0] = begin[0] + 1e-3
    (paths,) = scene.trails.star_paths(LENS, directions_eq, 1e3)
    steps = (np.arange(4000) + 0.5) / 4000
    every_segment = np.ones((len(paths.time_fraction), len(directions_eq)), dtype=np.bool_)
    time_between, between_px = paths.integral_between(begin, end, every_segment)
    np.testing.assert_allclose(time_between, end - begin, rtol=0, atol=1e-12)
    for star, integral_px in enumerate(between_px.T):
        time = begin[star] + (end[star] - begin[star]) * steps
        expected_px = scene.positions(directions_eq[star : star + 1], time)[:, 0].mean(axis=0)
        np.testing.assert_allclose(integral_px / (end[star] - begin[star]), expected_px, rtol=0, atol=1e-3)


def test_a_spline_is_divided_at_its_samples_and_in_the_middle_between_them():
    table = MotionTable.of(rough(100.0, "spline").motion, replace(EXPOSURE, duration_s=0.1, readout_s=0.0))
    # A sample every 10 ms, the first 7 ms after the start; a part of a spline takes 5 ms at most.
    inside_s = [k * 0.01 - 0.003 for k in range(1, 11)]
    steps_s = [k * 0.005 for k in range(21)]
    ends_s = np.unique(np.round([*inside_s, *steps_s], 6))
    np.testing.assert_allclose(table.ends_s[::2], ends_s, rtol=0, atol=5e-7)
    np.testing.assert_allclose(table.ends_s[1::2], (ends_s[1:] + ends_s[:-1]) / 2, rtol=0, atol=5e-7)
