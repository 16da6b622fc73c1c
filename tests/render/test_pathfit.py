"""Least-squares segments, against the interpolated attitude itself."""

import json
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest

from glstar.camera.exposure import Exposure
from glstar.camera.model import Mount
from glstar.flight import AttitudeTrack, Flight, PositionTrack
from glstar.render.motion import segmentfit
from glstar.render.motion.segmentation import ROLLING_POSITION_PX
from glstar.render.motion.segmentfit import LIMITS, STIFFNESS, SampledMotion, node_corrections
from glstar.render.scene.scene import Frame, Scene
from glstar.render.simulator import Simulator
from glstar.render.truth.frame import frame_truth
from glstar.render.truth.peaks import trail_peaks
from glstar.rotation import quaternion_from_euler
from tests.support.scenes import ADELAIDE, NIGHT_UTC_S, camera, sky_over_adelaide

LENS = camera(1014, 760, 967.7425)
EXPOSURE = Exposure(NIGHT_UTC_S + 0.213, 0.5, trail="analytic")
CORNERS_AND_MORE = [(0, 0), (1013, 0), (0, 759), (1013, 759), (500, 300), (250, 700), (900, 120)]


def flown(t: np.ndarray, angles_rad: np.ndarray, interpolation: str = "slerp") -> Simulator:
    still = sky_over_adelaide(LENS)
    track = AttitudeTrack.from_samples(NIGHT_UTC_S + t, quaternion_from_euler(*angles_rad), interpolation=interpolation)
    return Simulator.of(Flight(track, PositionTrack.fixed(ADELAIDE)), still.sky, LENS, Mount(), still.sensor)


def rough(hz: float, interpolation: str = "slerp", seed: int = 0) -> Simulator:
    """Return an aircraft that turns at some deg/s and shakes by a tenth of a degree, with the noise of a log."""
    random, t = np.random.default_rng(seed), np.arange(0.0, 1.0, 1 / hz)
    shaken = [
        np.sin(2 * np.pi * f * t + p) for f, p in zip(random.uniform(2, 12, 3), random.uniform(0, 6, 3), strict=True)
    ]
    angles_deg = 0.1 * np.array(shaken) + np.outer([8.0, -3.0, 5.0], t) + 0.002 * random.normal(size=(3, t.size))
    return flown(t, np.deg2rad(angles_deg), interpolation)


def paths_px(simulator: Simulator, scene: Scene, times: int = 1501) -> tuple[np.ndarray, np.ndarray]:
    """Return true and drawn positions, (times, k, 2) px each, evenly from the first row's opening to the last's end."""
    time = np.linspace(0.0, 1.0, times)
    pointing = simulator.pointing(EXPOSURE.start_utc_s + time * scene.exposure.span_s)
    directions = LENS.unit_vectors(CORNERS_AND_MORE) @ pointing.C_camera_eq[times // 2]
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    return LENS.project(pointing.to_camera(directions)), scene.positions(directions, time)


def off_px(simulator: Simulator, scene: Scene, times: int = 1501) -> tuple[float, float]:
    """Return the largest distances of drawn positions from true ones, and of their means, px."""
    true, drawn = paths_px(simulator, scene, times)
    stays = LENS.contains(true).all(axis=0)
    assert stays.sum() >= 3
    distance_px = np.linalg.norm(drawn - true, axis=-1)[LENS.contains(true)]
    weight = np.full(times, 1 / (times - 1))
    weight[[0, -1]] /= 2
    means_px = np.einsum("n,nkx->kx", weight, (drawn - true)[:, stays])
    return float(distance_px.max()), float(np.linalg.norm(means_px, axis=-1).max())


@pytest.mark.parametrize("interpolation", ["slerp", "spline"])
@pytest.mark.parametrize("hz", [10.0, 50.0, 200.0])
@pytest.mark.parametrize("tolerance_px", [0.01, 0.05])
def test_drawn_paths_are_within_the_tolerance_of_the_interpolated_attitude(hz, interpolation, tolerance_px):
    simulator = rough(hz, interpolation)
    scene = simulator.scene(replace(EXPOSURE, path_tolerance_px=tolerance_px))
    largest_px, _ = off_px(simulator, scene)
    # A spline may bend a little more between the times at which it is compared.
    assert largest_px <= 1.1 * tolerance_px


@pytest.mark.parametrize("seed", range(3))
def test_while_rows_open_and_close_paths_are_within_half_the_tolerance(seed):
    simulator, readout_s = rough(200.0, seed=seed), 0.1
    scene = simulator.scene(replace(EXPOSURE, readout_s=readout_s))
    true, drawn = paths_px(simulator, scene, 2401)
    distance_px = np.where(LENS.contains(true), np.linalg.norm(drawn - true, axis=-1), 0.0).max(axis=1)
    time_s = np.linspace(0.0, scene.exposure.span_s, 2401)
    is_end = np.minimum(time_s, time_s[-1] - time_s) <= readout_s
    assert distance_px[is_end].max() <= 1.1 * ROLLING_POSITION_PX
    assert ROLLING_POSITION_PX < distance_px.max() <= 1.1 * 0.01


def test_only_short_segments_are_sampled_more_finely_and_the_samples_are_those_of_the_motion():
    motion = rough(50.0, "spline").motion
    nodes_s = EXPOSURE.start_utc_s + np.linspace(0.0, 0.5, 26)
    samples = SampledMotion.of(motion, nodes_s, 2)
    knots_s = np.sort(np.append(nodes_s[::5], nodes_s[10] + [2e-4, 4e-4]))
    resolved = samples.resolving(motion, knots_s)
    counts = np.diff(resolved.times_s.searchsorted(knots_s - 1e-7))
    assert counts.min() >= LIMITS.few_samples - 1
    assert len(resolved.times_s) < LIMITS.max_even_parts * len(nodes_s) + 20
    assert (np.diff(resolved.times_s) > 1e-7).all()
    (expected,) = motion.pointings(resolved.times_s)
    np.testing.assert_allclose(resolved.pointing.C_camera_eq, expected.C_camera_eq, rtol=0, atol=1e-10)
    np.testing.assert_allclose(resolved.pointing.zenith_eq, expected.zenith_eq, rtol=0, atol=1e-10)


def test_an_exposure_is_sampled_at_least_32_times_with_an_even_number_of_parts(monkeypatch):
    parts = []

    class SampledError(Exception):
        pass

    def sampled(motion, nodes_s, count):
        parts.append(count)
        raise SampledError

    monkeypatch.setattr(SampledMotion, "of", sampled)
    for intervals in range(1, 41):
        with pytest.raises(SampledError):
            segmentfit.fitted_segments(None, np.arange(intervals + 1.0), LENS, 1.3, 0.01, psf_sigma_px=1.2)
    assert parts == [next(n for n in range(2, 33, 2) if n * intervals >= 32) for intervals in range(1, 41)]


def test_segments_are_divided_as_often_as_their_error_demands():
    """Ten segments of 1 s, and a log with samples every 0.1 s in the first half only, which has none at 1/3 and 2/3."""
    nodes_s = np.append(np.arange(0.0, 5.0, 0.1), np.arange(5.0, 11.0))
    nan, inf = np.nan, np.inf
    # The error falls with the third power of the length: 8 needs 2 parts, 8.1 and 27 need 3, and one above 1 needs 2.
    deviation = np.array([0.9, 1.0, 20.0, 1.05, 0.5, 27.0, 5.0, 1.0, 20.0, nan])
    drawing = np.array([0.9, 1.0, 1.5, 1.05, 8.1, 3.0, nan, 1e6, 30.0, inf])
    # Where the rate may change: at the samples nearest to 1/3 and 2/3, and at the middle.
    expected = [2.3, 2.7, 3.5, 4 + 1 / 3, 4 + 2 / 3]
    # Elsewhere evenly, into at most 24 parts, and into four if the error is unknown.
    expected += [5 + 1 / 3, 5 + 2 / 3, 6.25, 6.5, 6.75, *(7 + np.arange(1, 24) / 24)]
    expected += [*(8 + np.arange(1, 4) / 4), 9.25, 9.5, 9.75]
    found = segmentfit._divided(np.arange(11.0), nodes_s, deviation, drawing)
    np.testing.assert_allclose(found, np.sort([*range(11), *expected]), rtol=0, atol=1e-9)


def test_a_path_that_cannot_be_drawn_is_divided_evenly_although_the_log_has_samples():
    nodes_s = np.arange(0.0, 2.05, 0.1)
    knots_s = np.array([0.0, 1.0, 2.0])
    found = segmentfit._divided(knots_s, nodes_s, np.array([2.0, 20.0]), np.array([20.0, 20.0]))
    np.testing.assert_allclose(found, [0.0, 1 / 3, 2 / 3, 1.0, 1.3, 1.7, 2.0], rtol=0, atol=1e-9)
    # Two samples inside are enough for three parts, and one is not; samples at the ends are not inside.
    for inside, expected in (([0.2, 0.9], [0.2, 0.9]), ([0.4], [1 / 3, 2 / 3]), ([], [1 / 3, 2 / 3])):
        found = segmentfit._divided(np.array([0.0, 1.0]), np.array([0.0, *inside, 1.0]), np.array([20.0]), np.zeros(1))
        np.testing.assert_allclose(found, [0.0, *expected, 1.0], rtol=0, atol=1e-9)


@pytest.mark.parametrize("hz", [50.0, 200.0])
def test_the_mean_of_a_fitted_path_is_that_of_the_attitude(hz):
    simulator = rough(hz)
    _, mean_px = off_px(simulator, simulator.scene(EXPOSURE))
    assert mean_px <= 5e-4


@pytest.mark.parametrize("exposure", [EXPOSURE, replace(EXPOSURE, duration_s=0.1, frames=2, gap_s=0.05)])
def test_truth_has_the_expected_peaks_of_paths_that_are_projected_again(exposure):
    scene = rough(200.0).scene(exposure)
    trails = scene.trails.shorts[0] if exposure.frames > 1 else scene.trails
    assert len(trails) >= 8
    pixels = np.zeros((LENS.height_px, LENS.width_px), dtype=np.uint8)
    line = json.loads(frame_truth(scene, Frame(pixels, exposure, 0), number=0, file="a.png"))
    star_id = np.array([star["star_id"] for star in line["stars"]])
    index = np.flatnonzero(np.isin(scene.stars.star_id, star_id))
    peaks = trail_peaks(scene, scene.stars.direction_eq[index])
    flux_dn = dict(zip(star_id, [star["flux_dn"] for star in line["stars"]], strict=True))
    expected = {
        number: flux_dn[number] * peak
        for number, peak in zip(scene.stars.star_id[index], peaks.peak_fraction_per_px2, strict=True)
    }
    for star in line["stars"]:
        assert star["trail_peak_dn"] == pytest.approx(expected[star["star_id"]], rel=1e-5, abs=1e-5)


def test_a_wider_tolerance_needs_fewer_segments_and_none_needs_most():
    simulator = rough(200.0)
    counts = [
        len(simulator.scene(replace(EXPOSURE, path_tolerance_px=tolerance_px)).trails)
        for tolerance_px in (0.05, 0.02, 0.0)
    ]
    assert counts == sorted(counts)
    assert counts[0] < 0.7 * counts[-1]


def test_a_steady_turn_needs_hardly_more_segments_than_an_exact_path():
    t = np.arange(0.0, 1.0, 0.005)
    for deg_per_s in (10.0, 100.0, 300.0):
        simulator = flown(t, np.deg2rad(np.outer([deg_per_s, 0.0, 0.0], t) - 40.0))
        exact, fitted = (len(simulator.scene(replace(EXPOSURE, path_tolerance_px=px)).trails) for px in (0.0, 0.01))
        assert fitted <= 1.3 * exact + 1


def test_an_attitude_that_changes_at_every_sample_is_followed_or_drawn_exactly():
    random, t = np.random.default_rng(3), np.arange(0.0, 1.0, 0.005)
    simulator = flown(t, np.deg2rad(np.cumsum(random.normal(size=(3, t.size)) * 0.2, axis=1)))
    largest_px, _ = off_px(simulator, simulator.scene(EXPOSURE))
    assert largest_px <= 0.03


def test_a_long_exposure_is_fitted_in_blocks():
    t = np.arange(0.0, 3.0, 0.002)
    simulator = flown(t, np.deg2rad(0.2 * np.sin(2 * np.pi * np.outer([7.0, 5.0, 3.0], t))))
    exposure = replace(EXPOSURE, duration_s=2.5)
    scene = simulator.scene(exposure)
    time = np.linspace(0.0, 1.0, 2001)
    pointing = simulator.pointing(exposure.start_utc_s + time * exposure.duration_s)
    directions = LENS.unit_vectors([(500, 300), (100, 100)]) @ pointing.C_camera_eq[1000]
    true = LENS.project(pointing.to_camera(directions))
    assert np.linalg.norm(scene.positions(directions, time) - true, axis=-1).max() <= 0.011


@pytest.mark.parametrize("segments", [1, 2, 5, 60])
def test_the_corrections_of_the_nodes_are_those_of_a_dense_least_squares_solver(segments: int) -> None:
    rng = np.random.default_rng(segments)
    samples, count = 20 * segments, 2 * segments + 1
    segment = np.sort(np.concatenate([np.arange(segments), rng.integers(0, segments, samples - segments)]))
    u = rng.uniform(size=samples)
    basis = np.stack([(1 - u) * (1 - 2 * u), 4 * u * (1 - u), u * (2 * u - 1)], axis=1)
    turn, weight = rng.normal(size=(samples, 3)), rng.uniform(0.1, 1.0, samples)
    design = np.zeros((samples, count))
    np.put_along_axis(design, 2 * segment[:, np.newaxis] + np.arange(3), basis, axis=1)
    # Ridge regression as additional rows: STIFFNESS relative to the mean of the diagonal.
    root = np.sqrt(weight)[:, np.newaxis]
    ridge = STIFFNESS * (root * design * root * design).sum() / count
    rows = np.concatenate([root * design, np.sqrt(ridge) * np.eye(count)])
    expected = np.linalg.lstsq(rows, np.concatenate([root * turn, np.zeros((count, 3))]), rcond=None)[0]

    found = node_corrections(basis, segment, turn, weight, count)
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-6 * np.abs(expected).max())


def test_a_path_is_fitted_without_scipy_which_takes_long_to_load():
    program = """
import sys
import numpy as np
from glstar.render import simulator
from glstar.render.motion import segmentfit
segmentfit.node_corrections(np.ones((4, 3)) / 3, np.zeros(4, dtype=int), np.ones((4, 3)), np.ones(4), 3)
assert not any(name.startswith("scipy") for name in sys.modules)
"""
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr) == (0, "")
