"""The fit of clock, mount and readout, against the dense equations of all images with their own errors."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.stats import chi2, t

from glstar.camera.model import Mount
from glstar.compare import alignment
from glstar.compare.alignment import (
    _PRIOR,
    _added_turn,
    _attitude_std_rad,
    _combined,
    _common_grain_std,
    _covariance,
    _estimate,
    _grain_notes,
    _image_equations,
    _is_turning,
    _jackknife_std,
    _NormalEquations,
    _own_errors,
    _State,
    _turn_std_rad,
    best_own_delay_s,
    fit_alignment,
    fit_own_delay,
)
from glstar.compare.trailfit import FoundTrail
from glstar.rotation import matrix_from_quaternion, quaternion_from_matrix, quaternion_from_turn, turn_from_quaternion

ALL = np.ones(5, dtype=bool)
# Columns of an image's own errors: three rotations, three that grow, and its time.
OWN = [0, 1, 2, 5, 6, 7, 3]


def equations(count: int, *, grain_s: float = 0.0, noise: float = 1.0, seed: int = 1, turn_std_rad: float = 0.003):
    """Return the normal equations of images with random trails, attitude errors and times, and the true motions."""
    rng = np.random.default_rng(seed)
    true = np.array([0.01, -0.02, 0.015, 0.03, 0.01])
    images = []
    for number in range(count):
        J = rng.normal(0, 1, (40, 8)) * [900, 900, 300, 200, 100, 80, 80, 30]
        J[:, 3] = J[:, :3] @ rng.normal(0, 0.3, 3)  # a delay is a rotation about the axis of the turn
        own = np.concatenate([rng.normal(0, turn_std_rad, 3), np.zeros(3), [rng.uniform(-0.5, 0.5) * grain_s]])
        values = J[:, :5] @ true + J[:, OWN] @ own + rng.normal(0, noise, 40)
        images.append(
            _NormalEquations(J.T @ J / noise**2, J.T @ values / noise**2, 40, 0.3, number=number, grain_s=grain_s)
        )
    return images, true


def dense(images, std_rad):
    """Return the normal matrix and right-hand side of the shared motions and the own errors of all images."""
    size = 5 + 7 * len(images)
    normal, right = np.zeros((size, size)), np.zeros(size)
    normal[:5, :5] = np.diag(np.array([1, 1, 1, 10, 10.0]) ** -2)
    for k, image in enumerate(images):
        to = np.zeros((8, size))
        to[:5, :5] = np.eye(8)[:5, :5]
        to[OWN, 5 + 7 * k : 12 + 7 * k] = np.eye(7)
        normal += to.T @ image.normal @ to
        right += to.T @ image.right
        time_std = max(image.grain_s / np.sqrt(12), 1e-7)
        stds = np.array([*[std_rad[0]] * 3, *[std_rad[1]] * 3, time_std])
        normal[5 + 7 * k : 12 + 7 * k, 5 + 7 * k : 12 + 7 * k] += np.diag(stds**-2)
    return normal, right


@pytest.mark.parametrize("free", [[0, 1, 2, 3, 4], [3], [0, 1, 2]])
def test_marginalized_errors_are_those_of_the_dense_equations(free: list[int]) -> None:
    images, _ = equations(4, grain_s=0.2)
    mask = np.isin(np.arange(5), free)

    def losses(std_rad):
        normal, right = dense(images, std_rad)
        kept = [*free, *range(5, len(right))]
        normal, right = normal[np.ix_(kept, kept)], right[kept]
        solved = np.linalg.solve(normal, right)
        log_stds = 3 * len(images) * np.log(np.array(std_rad) ** 2).sum()
        return solved, np.linalg.inv(normal), np.linalg.slogdet(normal)[1] + log_stds - right @ solved

    std_rad = np.array([0.004, 0.002])
    solved, inverse, loss = losses(std_rad)
    motion, covariance, log_loss = _combined(images, mask, std_rad)
    n = len(free)
    np.testing.assert_allclose(motion[free], solved[:n], rtol=1e-6)
    np.testing.assert_allclose(covariance[np.ix_(free, free)], inverse[:n, :n], rtol=1e-6, atol=1e-15)
    assert not motion[~mask].any()
    assert not covariance[~mask].any()
    for other in ([0.001, 0.002], [0.004, 0.01]):
        difference = _combined(images, mask, np.array(other))[2] - log_loss
        assert difference == pytest.approx(losses(other)[2] - loss, rel=1e-6)
    for k, image in enumerate(images):
        np.testing.assert_allclose(_own_errors(image, motion, std_rad), solved[n + 7 * k : n + 7 * k + 7], rtol=1e-5)


def test_the_covariance_is_that_of_the_linear_estimate_with_the_true_errors() -> None:
    images, _ = equations(3, grain_s=0.1)
    std_rad, true_std_rad = np.array([0.004, 1e-7]), np.array([0.006, 0.003])
    for free in (ALL, np.array([True, True, True, False, False])):
        # The prior is one more measurement of each motion that is fitted.
        prior = _combined(images, free, std_rad)[1] / [1, 1, 1, 10, 10]
        expected = prior @ prior.T
        for k, image in enumerate(images):
            # The estimate is linear in the right-hand side of each image.
            def response(m: int, k: int = k, free: np.ndarray = free):
                rights = [replace(one, right=np.eye(8)[m] * (j == k)) for j, one in enumerate(images)]
                return _combined(rights, free, std_rad)[0]

            A = np.column_stack([response(m) for m in range(8)])
            stds = np.array([*[0.006] * 3, *[0.003] * 3, 0.1 / np.sqrt(12)])
            own = image.normal[:, OWN] * stds
            expected += A @ (image.normal + own @ own.T) @ A.T
        np.testing.assert_allclose(_covariance(images, free, std_rad, true_std_rad), expected, rtol=1e-5, atol=1e-14)


@pytest.mark.parametrize("differs", [0.0, 1e-9, 1e-7, 1e-6, 1e-5, 1e-4])
@pytest.mark.parametrize("seed", range(5))
def test_motions_that_the_images_do_not_determine_are_not_fitted(seed: int, differs: float) -> None:
    """Delay and readout turn the camera alike in each image, exactly or nearly so."""
    images = []
    rng = np.random.default_rng(seed)
    for number in range(4):
        J = rng.normal(0, 1, (40, 8)) * [900, 900, 300, 200, 100, 80, 80, 30]
        J[:, 3] = J[:, :3] @ [0.2, 0.3, 0.1 + differs * number]
        J[:, 4] = 0.5 * J[:, 3] + differs * number * J[:, 0]
        values = J[:, :3] @ rng.normal(0, 0.003, 3) + rng.normal(0, 1, 40)
        images.append(_NormalEquations(J.T @ J, J.T @ values, 40, 0.3, number=number, grain_s=0.0))
    free = ALL.copy()
    notes = alignment._estimated(images, free)[1]
    assert (free.tolist(), len(notes)) == ([True, True, True, False, False], 2)
    determined, _ = equations(4)
    free = ALL.copy()
    assert (alignment._estimated(determined, free)[1], free.all()) == ([], True)


def test_the_jackknife_leaves_out_each_image_and_is_wider_for_few() -> None:
    images, _ = equations(5)
    std_rad = np.array([0.003, 1e-7])
    without = np.array([_combined(images[:k] + images[k + 1 :], ALL, std_rad)[0] for k in range(5)])
    squares = 4 / 5 * ((without - without.mean(axis=0)) ** 2).sum(axis=0)
    # Twice the error is a 95.45 % interval.
    expected = t.ppf(0.97725, 4) / 2 * np.sqrt(squares)
    np.testing.assert_allclose(_jackknife_std(images, ALL, std_rad), expected, rtol=1e-6)
    assert _jackknife_std(images[:3], ALL, std_rad).all()
    assert not _jackknife_std(images[:2], ALL, std_rad).any()


def test_attitude_errors_have_the_standard_deviation_of_the_images() -> None:
    for true in (0.002, 0.02):
        images, _ = equations(60, turn_std_rad=true)
        assert _turn_std_rad(images, ALL) == pytest.approx(true, rel=0.2)
        both = _attitude_std_rad(images[:20], ALL)
        assert both[0] == pytest.approx(true, rel=0.4)
        # There is no growth.
        assert both[1] < 0.2 * true


def test_motions_are_recovered_and_outliers_are_set_aside() -> None:
    images, true = equations(9)
    estimate = _estimate(images, ALL)
    assert estimate.set_aside == 0
    assert (np.abs(estimate.motion - true) < 4 * estimate.std).all()
    assert (estimate.std < [0.006, 0.006, 0.006, 0.02, 0.02]).all()
    wrong = replace(images[4], right=images[4].right + images[4].normal[:, :3] @ [0.2, 0.1, 0.0])
    kept = _estimate([*images[:4], wrong, *images[5:]], ALL)
    others = _estimate([*images[:4], *images[5:]], ALL)
    assert kept.set_aside == 1
    np.testing.assert_allclose(kept.motion, others.motion, rtol=1e-6)
    np.testing.assert_allclose(kept.std, others.std, rtol=1e-6)
    assert len(kept.own_s) == 9
    # Of three images none can be set aside.
    assert _estimate([images[0], wrong, images[1]], ALL).set_aside == 0


def test_times_in_steps_have_a_common_error() -> None:
    """All were cut off or rounded: +-1/4 step; what the images scatter less than a uniform error may be common, too."""
    images, _ = equations(4, grain_s=1.0)
    std_rad, own_s = np.array([0.003, 1e-7]), np.array([0.1, -0.1, 0.2, -0.2])
    shifted = [replace(image, right=image.grain_s * image.normal[:, 3]) for image in images]
    effect = np.abs(_combined(shifted, ALL, std_rad)[0])
    expected = effect * np.sqrt(1 / 16 + 1 / 12 - 0.025)
    np.testing.assert_allclose(_common_grain_std(images, own_s, ALL, std_rad), expected, rtol=1e-9)
    np.testing.assert_allclose(_common_grain_std(images, 4 * own_s, ALL, std_rad), effect / 4, rtol=1e-9)
    half = [replace(image, grain_s=0.5) for image in images]
    shifted = [replace(image, right=0.5 * image.normal[:, 3]) for image in half]
    effect = np.abs(_combined(shifted, ALL, std_rad)[0])
    # In units of half a second, the times scatter by a tenth, more than a uniform error.
    np.testing.assert_allclose(_common_grain_std(half, own_s, ALL, std_rad), effect / 4, rtol=1e-9)
    exact = [replace(image, grain_s=0.0) for image in images]
    assert not _common_grain_std(exact, own_s, ALL, std_rad).any()


def test_remarks_name_steps_above_a_millisecond() -> None:
    images, _ = equations(3)
    grains = [replace(image, grain_s=g) for image, g in zip(images, [0.001, 1.0, 0.01], strict=True)]
    assert _grain_notes(grains)[0].startswith("2 of 3 images have times in steps of 1 s;")
    assert _grain_notes(grains[:1]) == []


@pytest.mark.parametrize(("speed", "turns"), [(19.9, False), (20.1, True)])
def test_an_aircraft_turns_above_twenty_times_the_rate_of_the_sky(speed: float, turns: bool) -> None:
    slow = [replace(image, speed_rad_per_s=0.0) for image in equations(2)[0]]
    fast = replace(slow[0], speed_rad_per_s=speed * 2 * np.pi / 86164)
    assert _is_turning([*slow, fast]) == turns


def test_turns_of_a_mount_are_combined_and_the_readout_is_limited() -> None:
    mount = Mount(0.3, -0.2, 0.5)
    first, second = np.array([0.1, -0.2, 0.05]), np.array([-0.02, 0.04, 0.3])
    both = _added_turn(mount, first, second)
    C = [matrix_from_quaternion(quaternion_from_turn(turn)) for turn in (first, second, both)]
    np.testing.assert_allclose(C[2], C[1] @ C[0], rtol=0, atol=1e-12)

    state = _State(first, 0.5, 0.4, np.zeros(2))
    moved = state.moved(np.array([*second, -0.2, 0.05]), np.array([1.0, 2.0]), mount)
    np.testing.assert_allclose(moved.turn_rad, both, rtol=1e-7)
    assert (moved.delay_s, moved.readout_s, moved.own_s.tolist()) == (0.3, pytest.approx(0.45), [1.0, 2.0])
    limits = [state.moved(np.array([0, 0, 0, 0, step]), state.own_s, mount).readout_s for step in (0.2, -2.0)]
    assert limits == [0.5, -0.5]


def pairing(values: np.ndarray, jacobian: np.ndarray, *, bent: np.ndarray, covariance: np.ndarray):
    found = tuple(
        FoundTrail(value, one if b else one * np.outer([1, 1, 0, 0], [1, 1, 0, 0]), bool(b), 1.0, 0.1, 0.0, False)
        for value, b, one in zip(values, bent, covariance, strict=True)
    )
    signal = SimpleNamespace(jacobian=jacobian)
    return SimpleNamespace(trails=signal, found=found, found_indices=list(range(len(found))))


def trails_of_image(count: int, seed: int = 3):
    rng = np.random.default_rng(seed)
    jacobian = rng.normal(0, 1, (count, 4, 8)) * np.array([500, 500, 0.2, 1])[:, np.newaxis]
    jacobian[..., 3] *= 0.4
    factors = rng.normal(0, 1, (count, 4, 4)) * np.array([0.1, 0.1, 0.01, 0.01])[:, np.newaxis]
    covariance = factors @ np.swapaxes(factors, 1, 2) + np.diag([0.01, 0.01, 1e-4, 1e-4])
    return rng, jacobian, covariance


def test_equations_of_an_image_weigh_its_trails_by_cauchy() -> None:
    rng, jacobian, covariance = trails_of_image(12)
    motion, bent = rng.normal(0, 1e-3, 8), np.arange(12) % 3 > 0
    noise = 2.0 * np.array([rng.multivariate_normal(np.zeros(4), one) for one in covariance])
    values = jacobian @ motion + noise
    values[5] += [3.0, -2.0, 0, 0]
    found = _image_equations(pairing(values, jacobian, bent=bent, covariance=covariance), 800.0, fit_readout=True)

    sizes = np.where(bent, 4, 2)
    weight = np.ones(12)
    for _ in range(10):
        normal, right = np.zeros((8, 8)), np.zeros(8)
        for k, m in enumerate(sizes):
            information = weight[k] * np.linalg.inv(covariance[k, :m, :m])
            normal += jacobian[k, :m].T @ information @ jacobian[k, :m]
            right += jacobian[k, :m].T @ information @ values[k, :m]
        fitted = np.linalg.solve(normal + np.diag(_PRIOR**-2), right)
        residual = values - jacobian @ fitted
        ratio = np.array([
            residual[k, :m] @ np.linalg.solve(covariance[k, :m, :m], residual[k, :m]) / chi2.ppf(0.5, m)
            for k, m in enumerate(sizes)
        ])  # fmt: skip
        spread = max(1.0, np.median(ratio))
        weight = 1 / (1 + ratio / (6 * spread))
    assert spread > 1
    np.testing.assert_allclose(found.normal, normal / spread, rtol=1e-8)
    np.testing.assert_allclose(found.right, right / spread, rtol=1e-8)
    assert found.stars == 12
    speed_px = np.hypot(jacobian[:, 0, 3], jacobian[:, 1, 3])
    assert found.speed_rad_per_s == pytest.approx(np.sqrt((speed_px**2).mean()) / 800)
    without = _image_equations(pairing(values, jacobian, bent=bent, covariance=covariance), 800.0, fit_readout=False)
    assert not without.normal[4].any()
    assert without.right[4] == 0


class Images:
    """Trails of images of a camera that turns about a different axis in each, as far as they are off a state."""

    def __init__(self, count: int, *, rates: float = 0.4, own_s: tuple[float, ...] = ()) -> None:
        rng = np.random.default_rng(12)
        self.mount = Mount(0.1, 0.2, -0.3)
        self.turn_rad, self.delay_s, self.readout_s = np.array([4e-3, -6e-3, 5e-3]), 0.08, -0.06
        self.own_s = np.array(own_s or (0.0,) * count)
        self.calls: list[int] = []
        self.seen = []
        for _ in range(count):
            x, y = rng.uniform(-0.6, 0.6, (2, 25))
            J = np.zeros((25, 4, 8))
            across = np.stack([x * y, -1 - x * x, y], -1), np.stack([1 + y * y, -x * y, -x], -1)
            J[:, :2, :3] = 900 * np.stack(across, 1)
            J[..., 3] = J[..., :3] @ (rates * rng.normal(0, 1, 3))
            J[..., 4] = (y[:, np.newaxis] + 0.6) / 1.2 * J[..., 3]
            J[..., 5:] = rng.uniform(-0.1, 0.1, (25, 1, 1)) * J[..., :3]
            attitude = rng.normal(0, 2e-4, 3)
            noise = rng.normal(0, 0.05, (25, 2))
            self.seen.append((J, attitude, noise))

    def __call__(self, number: int, mount: Mount, delay_s: float, readout_s: float):
        self.calls.append(number)
        J, attitude, noise = self.seen[number]
        from_given = turn_from_quaternion(quaternion_from_matrix(mount.C_camera_body @ self.mount.C_camera_body.T))
        off = [*(self.turn_rad - from_given + attitude), self.delay_s + self.own_s[number] - delay_s]
        values = np.zeros((25, 4))
        values[:, :2] = J[:, :2, :5] @ [*off, self.readout_s - readout_s] + noise
        covariance = np.tile(np.diag([0.05**2, 0.05**2, 1.0, 1.0]), (25, 1, 1))
        return pairing(values, J, bent=np.zeros(25, bool), covariance=covariance)


def test_clock_mount_and_readout_are_fitted_together() -> None:
    images, steps = Images(6), []
    found = fit_alignment(
        *(images, 6, images.mount),
        fit_time=True,
        fit_mount=True,
        fit_readout=True,
        readout_s=0.02,
        focal_px=900.0,
        on_step=lambda done, of: steps.append((done, of)),
    )
    assert (found.fitted_time, found.fitted_mount, found.fitted_readout, found.notes) == (True, True, True, ())
    assert np.abs(found.turn_rad - images.turn_rad).max() < 4e-4
    assert found.delay_s == pytest.approx(0.08, abs=3 * found.delay_std_s)
    assert found.readout_s == pytest.approx(-0.06, abs=3 * found.readout_std_s)
    assert (found.delay_std_s < 3e-3, found.readout_std_s < 3e-3) == (True, True)
    assert (found.images, found.stars, found.set_aside) == (6, 150, 0)
    assert found.attitude_std_rad == pytest.approx(2e-4, rel=0.7)
    assert found.opens_opposite
    assert not replace(found, fitted_readout=False).opens_opposite
    assert not replace(found, readout_std_s=0.021).opens_opposite
    assert replace(found, readout_std_s=0.0199).opens_opposite
    C = matrix_from_quaternion(quaternion_from_turn(found.turn_rad)) @ images.mount.C_camera_body
    np.testing.assert_allclose(found.mount.C_camera_body, C, rtol=0, atol=1e-9)
    angles = [found.mount_keys[f"mount.{key}_deg"] for key in ("yaw", "pitch", "roll")]
    assert angles == pytest.approx(np.rad2deg([found.mount.yaw_rad, found.mount.pitch_rad, found.mount.roll_rad]))
    assert steps == [(k + 1, 48) for k in range(len(images.calls))]
    # A linear problem has converged after a second iteration, or a third for the composition of rotations.
    assert 12 <= len(steps) <= 18
    # From the solution itself, once.
    images.calls.clear()
    start = found.turn_rad, found.delay_s, found.readout_s
    again = fit_alignment(
        *(images, 6, images.mount),
        fit_time=True,
        fit_mount=True,
        fit_readout=True,
        focal_px=900.0,
        start=start,
    )
    assert len(images.calls) == 6
    assert again.delay_s == pytest.approx(found.delay_s, abs=1e-4)


def test_an_image_of_another_attitude_is_set_aside() -> None:
    images = Images(6)
    J, _, noise = images.seen[2]
    images.seen[2] = J, np.array([0.02, -0.01, 0.0]), noise
    arguments = {"fit_time": True, "fit_mount": True, "fit_readout": True, "focal_px": 900.0}
    found = fit_alignment(images, 6, images.mount, **arguments)
    assert (found.images, found.set_aside, found.stars) == (5, 1, 150)
    assert np.abs(found.turn_rad - images.turn_rad).max() < 6e-4


@pytest.mark.parametrize("grain_s", [0.0, 0.5])
def test_a_clock_and_a_readout_are_fitted_up_to_an_error(grain_s: float, monkeypatch: pytest.MonkeyPatch) -> None:
    images, _ = equations(3, grain_s=grain_s)
    most_s = 0.05 + 0.6 * grain_s
    for clock_s, readout_s in ((0.99, 0.99), (0.99, 1.01), (1.01, 0.99), (1.01, 1.01)):
        std = np.array([1.0, 1, 1, clock_s * most_s, readout_s * 0.02])
        monkeypatch.setattr(alignment, "_estimate", lambda _images, _free, std=std: SimpleNamespace(std=std))
        free = np.ones(5, dtype=bool)
        notes = alignment._estimated(images, free)[1]
        assert free.tolist() == [True, True, True, clock_s < 1, readout_s < 1]
        assert len(notes) == (clock_s > 1) + (readout_s > 1)


def test_given_parameters_stay_and_a_single_image_says_what_it_hides() -> None:
    images = Images(3)
    images.delay_s = images.readout_s = 0.0
    found = fit_alignment(images, 3, images.mount, fit_time=False, fit_mount=True, focal_px=900.0)
    assert (found.delay_s, found.readout_s, found.fitted_time, found.fitted_readout) == (0.0, 0.0, False, False)
    assert np.isnan([found.delay_std_s, found.readout_std_s]).all()
    assert np.abs(found.turn_rad - images.turn_rad).max() < 4e-4
    clock = Images(1)
    clock.turn_rad, clock.readout_s = np.zeros(3), 0.0
    found = fit_alignment(clock, 1, clock.mount, fit_time=True, fit_mount=False, focal_px=900.0)
    assert found.mount is clock.mount
    assert (found.turn_rad.tolist(), np.isnan(found.turn_std_rad).all()) == ([0, 0, 0], True)
    assert found.delay_s == pytest.approx(0.08, abs=5e-3)
    assert "single image" in found.notes[0]
    assert fit_alignment(lambda *_: None, 2, Mount(), fit_time=True, fit_mount=True, focal_px=900.0) is None


def test_clock_and_readout_of_a_camera_that_hardly_turns_are_not_fitted() -> None:
    images = Images(4, rates=5e-4)
    start = np.zeros(3), 0.5, 0.04
    arguments = {"fit_time": True, "fit_mount": True, "fit_readout": True, "readout_s": 0.03, "focal_px": 900.0}
    found = fit_alignment(images, 4, images.mount, **arguments, start=start)
    assert (found.fitted_time, found.fitted_readout, found.fitted_mount) == (False, False, True)
    assert (found.delay_s, found.readout_s) == (0.0, 0.03)
    assert "the clock's offset or the readout time" in found.notes[0]


def test_a_clock_of_one_rate_and_a_readout_of_few_rows_are_not_fitted() -> None:
    images = Images(4)
    for number, (J, *rest) in enumerate(images.seen):
        J[..., 3] = J[..., :3] @ [0.2, 0.3, 0.1 + 1e-4 * number]  # nearly the same rate in all images
        J[..., 4] = 0.5 * J[..., 3] + 3e-5 * number * J[..., 0]
        images.seen[number] = (J, *rest)
    arguments = {"fit_time": True, "fit_mount": True, "fit_readout": True, "focal_px": 900.0}
    found = fit_alignment(images, 4, images.mount, **arguments)
    assert (found.fitted_time, found.fitted_readout) == (False, False)
    assert [note.split(" only to")[0] for note in found.notes] == [
        "the trails determine the readout time",
        "the trails determine the clock's offset",
    ]


def test_delays_of_images_in_whole_seconds_are_fitted_beside_the_common_one() -> None:
    own_s = (0.3, -0.2, 0.45, -0.4, 0.1, 0.0)
    images = Images(6, own_s=own_s)
    images.readout_s = 0.0
    found = fit_alignment(
        *(images, 6, images.mount),
        fit_time=True,
        fit_mount=True,
        focal_px=900.0,
        grains_s=[1.0] * 6,
        own_start_s=[0.05] * 6,
    )
    assert np.abs(found.turn_rad - images.turn_rad).max() < 1e-3
    assert found.delay_s == pytest.approx(0.08 + np.mean(own_s), abs=0.05)
    # Cut off or rounded: a quarter of a second, at least.
    assert 0.25 <= found.delay_std_s < 0.5
    assert found.notes[0].startswith("6 of 6 images")


@pytest.mark.parametrize("true_s", [0.3, -0.6, 2.0])
def test_the_own_delay_of_an_image_is_the_most_likely_one(true_s: float) -> None:
    _, jacobian, covariance = trails_of_image(15)
    jacobian[..., 4:] = 0
    grain_s, turn_std_rad = 1.0, 0.05
    tried = []

    def find(own_s: float):
        tried.append(own_s)
        values = jacobian[..., 3] * (true_s - own_s)
        return pairing(values, jacobian, bent=np.ones(15, bool), covariance=covariance)

    own_s, last = fit_own_delay(find, 0.1, 800.0, grain_s, turn_std_rad)
    assert own_s == pytest.approx(min(true_s, 0.75), abs=2e-3)
    assert last is not None
    assert len(tried) <= 3
    assert fit_own_delay(lambda _: None, 0.1, 800.0, grain_s, turn_std_rad) == (0.1, None)


def test_priors_hold_the_own_delay_of_trails_that_hardly_move() -> None:
    """The prior of the time has the variances of a uniform error and of the rule; the attitude's error competes."""
    _, jacobian, covariance = trails_of_image(6)
    jacobian[..., 4:] = 0
    jacobian[..., 3] = 1e-4 * jacobian[..., :3] @ [1.0, 2.0, -1.0]
    values = jacobian[..., 3] * 1.0

    def find(own_s: float):
        return pairing(values - jacobian[..., 3] * own_s, jacobian, bent=np.ones(6, bool), covariance=covariance)

    turn_std_rad, grain_s = 1e-4, 0.8
    J = jacobian[..., :4].reshape(-1, 4)
    weights = np.zeros((24, 24))
    for k in range(6):
        weights[4 * k : 4 * k + 4, 4 * k : 4 * k + 4] = np.linalg.inv(covariance[k])
    prior = np.diag([1e8, 1e8, 1e8, 1 / (0.64 * (1 / 12 + 1 / 16))])
    expected = np.linalg.solve(J.T @ weights @ J + prior, J.T @ weights @ values.ravel())[3]
    assert 0.01 < expected < 0.5
    assert fit_own_delay(find, 0.0, 800.0, grain_s, turn_std_rad)[0] == pytest.approx(expected, rel=0.02)


def test_the_best_of_many_delays_finds_most_of_the_signal() -> None:
    tried = []

    def find(own_s: float):
        tried.append(own_s)
        return None if abs(own_s) > 1.2 else SimpleNamespace(found_signal=1 - abs(own_s - 0.62))

    assert best_own_delay_s(find, 2.0) == pytest.approx(0.6)
    np.testing.assert_allclose(tried, np.arange(-15, 16) / 10, rtol=0, atol=1e-12)
    assert best_own_delay_s(lambda _: None, 2.0) is None
