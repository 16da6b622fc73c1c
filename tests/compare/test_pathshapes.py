"""Shapes of star paths and of their motions, against linear algebra written out."""

from dataclasses import replace

import numpy as np
import pytest

from glstar.camera.exposure import Exposure
from glstar.compare.prediction import (
    ExposedPaths,
    Trails,
    _clear_and_alone,
    _trail_jacobians,
    exposed_paths,
    moved_path,
    offsets_and_directions,
    stamp_of,
    trail_jacobian,
)
from tests.support.scenes import NIGHT_UTC_S, camera, sky_over_adelaide

U = np.linspace(-1, 1, 21)
# A bent path upwards to the left, a straight one to the right, and a short one.
BENT = np.column_stack([50 - 20 * U + 4 * U**2, 70 - 15 * U - 3 * U**2])
STRAIGHT = np.column_stack([80 + 15 * U, 30 + 0 * U])
SHORT = np.column_stack([20 + 0.5 * U, 90 + 0.5 * U])


def trails(paths: list[np.ndarray], **changes) -> Trails:
    k = len(paths)
    values = {
        "catalogue": "bsc5",
        "star_id": np.arange(1, k + 1, dtype=np.int32),
        "name": tuple(f"star {i}" for i in range(k)),
        "vmag": np.arange(k, dtype=float),
        "path_px": np.stack(paths, axis=1),
        "signal_dn": np.zeros((120, 120), np.float32),
        "pixels_dn": np.zeros((120, 120), np.float32),
        "headroom_dn": 1e6,
        "sigma_px": 1.5,
        "jacobian": np.arange(k * 32.0).reshape(k, 4, 8),
        "signal_to_noise": np.arange(k) + 10.0,
    }
    return Trails(**values | changes)


def test_trails_have_length_width_and_order() -> None:
    path = np.array([[0.0, 0], [3, 4], [3, 10]])
    found = trails([path, path / 2, path / 11 * 4 * 1.5, path / 11 * 6.01], sigma_px=1.5)

    assert tuple(found.length_px) == pytest.approx((11, 5.5, 6, 6.01))
    # A length of four standard deviations has no direction yet.
    assert found.elongated.tolist() == [True, False, False, True]
    assert found.half_width_px == 3.5 * 1.5 + 0.5
    some = found.only(np.array([2, 0]))
    assert (some.star_id.tolist(), some.name, some.vmag.tolist()) == ([3, 1], ("star 2", "star 0"), [2.0, 0.0])
    assert (some.signal_to_noise.tolist(), some.jacobian[:, 0, 0].tolist()) == ([12.0, 10.0], [64.0, 0.0])
    np.testing.assert_array_equal(some.path_px, found.path_px[:, [2, 0]])


def test_rates_are_those_of_each_short_exposure() -> None:
    s = np.arange(5) * 0.25
    values = np.concatenate([s**2 - s, 100 - 3 * s**2])[:, np.newaxis] * [1.0, 2.0]
    paths = ExposedPaths(np.zeros((10, 1, 3)), 0.25, np.ones(1), np.zeros(10), pieces=2)
    expected = np.concatenate([2 * s - 1, -6 * s])[:, np.newaxis] * [1.0, 2.0]
    # Differences of second order are exact for a parabola, at the ends too.
    np.testing.assert_allclose(paths.rate_of(values), expected, rtol=0, atol=1e-12)


def test_directions_are_principal_axes_from_start_to_end() -> None:
    paths = np.stack([BENT, BENT[::-1], STRAIGHT, STRAIGHT[::-1]], axis=1)
    offset, along = offsets_and_directions(paths)
    np.testing.assert_allclose(offset.sum(axis=0), 0, rtol=0, atol=1e-9)
    np.testing.assert_allclose(offset + paths.mean(axis=0), paths, rtol=1e-7)
    axis = np.linalg.svd(BENT - BENT.mean(axis=0))[2][0]
    axis *= -np.sign(axis[0])  # BENT goes to the left
    np.testing.assert_allclose(along, [axis, -axis, [1, 0], [-1, 0]], rtol=0, atol=1e-12)


def test_a_moved_path_is_shifted_then_turned_about_its_mean_and_stretched_along_its_axis() -> None:
    modes = np.array([1.5, -2.5, 0.2, 0.3])
    offset = (BENT - BENT.mean(axis=0)) @ [1, 1j]
    axis = np.linalg.svd(BENT - BENT.mean(axis=0))[2][0] @ [1, 1j]
    along, across = (offset * np.conj(axis)).real, (offset * np.conj(axis)).imag
    expected = BENT.mean(axis=0) @ [1, 1j] + (1.5 - 2.5j) + (1.2 * along + 1j * across) * axis * np.exp(0.3j)
    np.testing.assert_allclose(moved_path(BENT, modes) @ [1, 1j], expected, rtol=1e-12)


def test_the_jacobian_of_a_trail_is_that_of_its_shift_stretch_and_turn() -> None:
    found = trails([BENT, STRAIGHT, SHORT])
    rng = np.random.default_rng(2)
    true = rng.normal(0, 1, (3, 4, 5))
    true[:, 2:] *= 1e-2
    true[2, 2:] = 0  # The short one has neither length nor direction.
    step = 1e-6
    fields = np.zeros((len(U), 3, 2, 5))
    for k, path in enumerate([BENT, STRAIGHT, SHORT]):
        for m in range(5):
            fields[:, k, :, m] = (moved_path(path, step * true[k, :, m]) - path) / step
    fields[:, 2] += U[:, np.newaxis, np.newaxis]  # a stretch that is not resolved

    np.testing.assert_allclose(trail_jacobian(fields, found), true, rtol=1e-5, atol=1e-6)


def test_bright_isolated_trails_are_chosen_by_their_signal() -> None:
    paths = [np.column_stack([U * 4 + x, 0 * U + y]) for x, y in [(30, 20), (80, 20), (30, 60), (80, 60), (60, 100)]]
    image = np.random.default_rng(4).uniform(0, 0.01, (120, 120)).astype(np.float32)
    rows, columns = np.indices(image.shape)
    for amount, path in zip([5, 9, 7, 3, 8], paths, strict=True):
        squares = (columns - path[:, :1, np.newaxis]) ** 2 + (rows - path[:, 1:, np.newaxis]) ** 2
        image += (amount * np.exp(-squares / (2 * 1.5**2)).sum(axis=0)).astype(np.float32)
    found = trails(paths, signal_dn=image)
    light = [stamp.of(image)[stamp.mask].astype(float) for stamp in (stamp_of(p, 5.75) for p in paths)]
    signal = np.array([np.sqrt((one**2).sum()) / 2.5 for one in light])
    total = np.array([one.sum() for one in light])
    # The second star has 4.9 %, the third 5.1 % of its flux from others.
    flux = total / [1.0, 1.049, 1.051, 1.0, 1.0]

    chosen, selected = _clear_and_alone(found, flux, 2.5, signal[3], 10)
    assert chosen.tolist() == [1, 4, 0, 3]
    assert selected.signal_to_noise.tolist() == pytest.approx(signal[chosen].tolist())
    assert (selected.star_id.tolist(), selected.blended) == ([2, 5, 1, 4], 1)
    # A trail below the limit counts neither as found nor as blended.
    chosen, selected = _clear_and_alone(found, flux, 2.5, signal[2] * 1.001, 1)
    assert (chosen.tolist(), selected.blended) == ([1], 0)


def test_the_motions_of_a_turning_camera_are_those_of_turned_and_delayed_vectors() -> None:
    simulator = sky_over_adelaide(camera(800, 600, 900.0), vmag_limit=4.5, refraction=False, roll_rate_rad_per_s=0.35)
    exposure = Exposure(NIGHT_UTC_S + 0.4, 0.2, trail="sprites", rate_hz=3600.0)
    scene = simulator.scene(exposure)
    stars = np.flatnonzero(scene.camera.contains(
        scene.camera.project(simulator.pointing(exposure.sub_utc_s(3)).to_camera(scene.stars.direction_eq)), -30
    ).all(axis=0))[:4]  # fmt: skip
    assert len(stars) == 4
    direction = scene.stars.direction_eq[stars]
    paths = exposed_paths(scene, direction)
    n = len(paths.in_camera)

    # Samples at the middles of n equal parts of the exposure.
    at = exposure.start_utc_s + (np.arange(n) + 0.5) / n * 0.2
    assert len(scene.trails.pointing) == 720
    np.testing.assert_allclose(paths.in_camera, simulator.pointing(at).to_camera(direction), rtol=0, atol=2e-6)
    assert (n, paths.step_s) == (240, pytest.approx(0.2 / 240))
    np.testing.assert_allclose(paths.since_mid, (np.arange(n) + 0.5) / n - 0.5, rtol=1e-7)
    np.testing.assert_array_equal(paths.exposed_fraction, np.ones(4))

    path = scene.camera.project(paths.in_camera)
    found = trails([path[:, k] for k in range(4)], sigma_px=0.5)
    jacobian = _trail_jacobians(scene, paths, np.arange(4), found)
    for axis in range(3):
        angle = 1e-4 * np.eye(3)[axis]
        K = np.array([[0, -angle[2], angle[1]], [angle[2], 0, -angle[0]], [-angle[1], angle[0], 0]])
        # The camera turns by +angle, its vectors by -angle.
        there, back = (scene.camera.project(paths.in_camera @ (np.eye(3) + s * K).T) for s in (-1, 1))
        shift = (there - back) / 2e-4
        np.testing.assert_allclose(jacobian[:, :2, axis], shift.mean(axis=0), rtol=1e-5, atol=1e-3)
        growing = (shift * paths.since_mid[:, np.newaxis, np.newaxis]).mean(axis=0)
        np.testing.assert_allclose(jacobian[:, :2, 5 + axis], growing, rtol=1e-5, atol=1e-3)
    later = scene.camera.project(simulator.pointing(at + 1e-3).to_camera(direction))
    earlier = scene.camera.project(simulator.pointing(at - 1e-3).to_camera(direction))
    speed = (later - earlier) / 2e-3
    np.testing.assert_allclose(jacobian[:, :2, 3], speed.mean(axis=0), rtol=1e-3, atol=0.05)
    # Row y of 600 opens after y / 600 of the readout time.
    rows = (path[..., 1:] + 0.5) / 600
    np.testing.assert_allclose(jacobian[:, :2, 4], (rows * speed).mean(axis=0), rtol=2e-3, atol=0.3)


def test_paths_of_a_stack_are_sampled_in_each_short_exposure() -> None:
    simulator = sky_over_adelaide(camera(800, 600, 900.0), vmag_limit=4.5, refraction=False, roll_rate_rad_per_s=0.35)
    exposure = Exposure(NIGHT_UTC_S + 0.4, 0.1, frames=3, gap_s=0.05)
    scene = simulator.scene(exposure)
    direction = scene.stars.direction_eq[:5]
    paths = exposed_paths(scene, direction)
    count = len(paths.in_camera) // 3

    assert paths.pieces == 3
    assert paths.step_s == pytest.approx(0.1 / count)
    since = (0.15 * np.arange(3)[:, np.newaxis] + (np.arange(count) + 0.5) / count * 0.1).ravel()
    # A sample is that of the sub-exposure in which its time lies.
    near = simulator.pointing(exposure.start_utc_s + since).to_camera(direction)
    np.testing.assert_allclose(paths.in_camera, near, rtol=0, atol=0.35 * 0.1 / count * 1.1)
    np.testing.assert_allclose(paths.since_mid, since / 0.4 - 0.5, rtol=0, atol=1e-6)
    np.testing.assert_allclose(paths.exposed_fraction, np.ones(5), rtol=1e-7)
    # Rows that open later are open as long: time counts from the opening of each.
    rolling = exposed_paths(simulator.scene(replace(exposure, readout_s=0.04)), direction)
    count = len(rolling.in_camera) // 3
    since = (0.15 * np.arange(3)[:, np.newaxis] + (np.arange(count) + 0.5) / count * 0.1).ravel()
    np.testing.assert_allclose(rolling.since_mid, since / 0.4 - 0.5, rtol=0, atol=1e-6)
