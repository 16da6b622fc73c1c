"""Searches for simulated trails in real images, on images whose trails were moved by known amounts."""

from types import SimpleNamespace

import numpy as np
import pytest

from glstar.camera.exposure import Exposure
from glstar.camera.sensor.sensor import Sensor
from glstar.compare.detection import SubtractedImage, subtract_background
from glstar.compare.flights import _by_signed_readout, _count_sources, _named, _saturation_dn, _span
from glstar.compare.pairs import (
    CrossCorrelation,
    Pairing,
    _common_motion,
    _scatter_px,
    coarse_side,
    measure,
    pair_trails,
    shrunk,
)
from glstar.compare.prediction import moved_path
from glstar.compare.trailfit import FoundTrail, find_trail
from tests.compare.test_pathshapes import trails

SIGMA_PX = 1.5
U = np.linspace(-1, 1, 81)
PATH = np.column_stack([60 + 18 * U + 2 * U**2, 50 + 9 * U])


def drawn(path: np.ndarray, flux: float, shape: tuple[int, int] = (100, 120)) -> np.ndarray:
    """Return the image of a path of Gaussian cross-section."""
    x, y = (
        np.exp(-((np.arange(n) - path[:, k, np.newaxis]) ** 2) / (2 * SIGMA_PX**2)) for k, n in ((0, 120), (1, 100))
    )
    return (flux / len(path) / (2 * np.pi * SIGMA_PX**2) * (y[:, : shape[0]].T @ x[:, : shape[1]])).astype(np.float32)


def real_image(above_dn: np.ndarray, noise_dn: float = 2.0) -> SubtractedImage:
    return SubtractedImage(above_dn, np.full_like(above_dn, noise_dn), np.ones(above_dn.shape, bool))


def found_with(modes: list[float], std_px: float = 0.1, **changes) -> FoundTrail:
    covariance = np.diag([std_px**2, (std_px / 2) ** 2, 1e-4, 1e-4])
    values = {"bent": True, "brightness": 1.0, "brightness_std": 0.1, "sky_dn": 0.0, "saturated": False} | changes
    return FoundTrail(np.array(modes), covariance, **values)


@pytest.mark.parametrize("bends", [True, False])
def test_a_fit_recovers_shift_stretch_turn_brightness_and_sky(bends: bool) -> None:
    modes = np.array([4.3, -3.6, 0.06, -0.05]) * ([1, 1, 1, 1] if bends else [1, 1, 0, 0])
    template = drawn(PATH, 30000.0)
    # A longer trail of the same brightness per pixel has more flux.
    sky = real_image(drawn(moved_path(PATH, modes), 1.3 * 30000 * (1 + modes[2])) + np.float32(3.0))
    expected = {"expected_px": np.array([3.0, -3.0]), "window_px": 3.0}
    found = find_trail(sky, template, PATH, 3.5 * SIGMA_PX + 0.5, bends=bends, **expected)

    assert found is not None
    np.testing.assert_allclose(found.modes[:2], modes[:2], rtol=0, atol=0.02)
    np.testing.assert_allclose(found.modes[2:], modes[2:], rtol=0, atol=3e-3)
    assert (found.brightness, found.sky_dn) == (pytest.approx(1.3, rel=0.01), pytest.approx(3.0, abs=0.5))
    assert (found.bent, found.saturated) == (bends, False)

    # The covariance is the inverse of the information of brightness, sky and modes, by differences of drawn images.
    def image(p: np.ndarray) -> np.ndarray:
        path = moved_path(PATH, np.append(p[2:], [] if bends else [0, 0]))
        return (p[0] * drawn(path, 30000 * (1 + (p[4] if bends else 0))) + p[1]).astype(float)

    at, steps = np.array([1.3, 3, *modes[: 4 if bends else 2]]), np.array([0.01, 0.1, 0.05, 0.05, 2e-3, 2e-3])
    steps = steps[: len(at)]
    slopes = [(image(at + s) - image(at - s)) / (2 * s.sum()) for s in np.diag(steps)]
    mask = drawn(moved_path(PATH, modes), 1.0) > 1e-7
    J = np.column_stack([slope[mask] for slope in slopes]) / 2.0
    covariance = np.linalg.inv(J.T @ J)
    assert found.brightness_std == pytest.approx(np.sqrt(covariance[0, 0]), rel=0.2)
    found_std = np.sqrt(np.diag(found.covariance))[: len(at) - 2]
    expected_std = np.sqrt(np.diag(covariance)[2:] + [0.005**2, 0.005**2, 0, 0][: len(at) - 2])
    np.testing.assert_allclose(found_std, expected_std, rtol=0.15)
    # Nothing is found away from the trail, outside of the image, or where the trail is fainter than five sigma.
    assert find_trail(sky, template, PATH, 5.75, expected_px=np.array([-20.0, 0]), window_px=3.0, bends=bends) is None
    assert find_trail(sky, template, PATH - np.array([50, 0]), 5.75, bends=bends, **expected) is None
    for noise_dn, is_found in ((430.0, True), (480.0, False)):  # 5.3 and 4.7 sigma
        faint = find_trail(real_image(sky.above_dn, noise_dn), template, PATH, 5.75, bends=bends, **expected)
        assert (faint is not None) == is_found


def test_saturated_pixels_are_left_out_of_a_fit() -> None:
    template = drawn(PATH, 30000.0)
    above = drawn(PATH + np.array([1.0, 0.5]), 30000.0)
    limit = 0.9 * above.max()
    sky = SubtractedImage(np.minimum(above, limit), np.full_like(above, 2.0), above < limit)
    found = find_trail(sky, template, PATH, 5.75, expected_px=np.zeros(2), window_px=3.0, bends=False)
    assert found is not None
    assert found.saturated
    assert tuple(found.modes) == pytest.approx((1.0, 0.5, 0, 0), abs=0.02)
    assert found.brightness == pytest.approx(1.0, rel=0.01)


def test_the_cross_correlation_is_the_sum_over_overlapping_pixels() -> None:
    rng = np.random.default_rng(8)
    real, expected = rng.normal(0, 3, (11, 14)).astype(np.float32), rng.normal(2, 4, (11, 14)).astype(np.float32)
    search = CrossCorrelation(real, 2.4)
    found = search.to(expected)

    a, b = np.clip(real, -1, 6), np.clip(expected, 0, 6)
    padded = np.pad(a - a.mean(), 3)
    direct = np.array([
        [np.sum((b - b.mean()) * padded[3 + dy : 14 + dy, 3 + dx : 17 + dx]) for dx in range(-3, 4)]
        for dy in range(-3, 4)
    ]) / np.linalg.norm(b)  # fmt: skip
    dy, dx = np.mgrid[-3:4, -3:4]
    direct[dx**2 + dy**2 > 2.9**2] = -np.inf
    np.testing.assert_allclose(found, direct, rtol=1e-4, atol=1e-4)
    row, column = np.unravel_index(np.argmax(direct), (7, 7))
    assert search.best(found).tolist() == [column - 3, row - 3]
    # A shift of less than a pixel is searched for one pixel away.
    assert CrossCorrelation(real, 0.2).to(expected).shape == (3, 3)


def test_images_are_binned_to_the_size_of_the_search() -> None:
    image = np.random.default_rng(1).uniform(0, 9, (11, 14)).astype(np.float32)
    blocks = image[:9, :12].reshape(3, 3, 4, 3).mean(axis=(1, 3))
    np.testing.assert_allclose(shrunk(image, 3), blocks, rtol=1e-6)
    shapes = [((512, 100), 1), ((513, 100), 2), ((100, 1024), 2), ((1025, 9), 3), ((5, 5), 1)]
    assert [coarse_side(shape, 512) for shape, _ in shapes] == [side for _, side in shapes]


def common(count: int = 60):
    rng = np.random.default_rng(6)
    jacobian = np.zeros((count, 4, 8))
    x, y = rng.uniform(-1, 1, (2, count))
    jacobian[:, :2, :3] = 900 * np.stack(
        [np.stack([x * y, -1 - x * x, y], -1), np.stack([1 + y * y, -x * y, -x], -1)], 1
    )
    motion = np.array([2e-3, -3e-3, 4e-3])
    return SimpleNamespace(jacobian=jacobian), motion, jacobian[:, :2, :3] @ motion


def test_the_common_motion_is_that_of_most_trails() -> None:
    simulated, motion, shift = common()
    shift[:4] += [[1.30, 0], [0, -1.40], [30, 10], [-1.30, 0]]
    found = [found_with([*each, 0, 0]) for each in shift.tolist()]
    found[9] = None
    fitted, agrees = _common_motion(simulated, found)

    # The limit is 1 px and three standard errors of 0.1 + 0.02 px: 1.36 px.
    assert np.flatnonzero(~agrees).tolist() == [1, 2, 9]
    np.testing.assert_allclose(fitted, motion, rtol=0, atol=5e-5)
    nothing, none = _common_motion(simulated, [None] * 60)
    assert (nothing.tolist(), none.any()) == ([0, 0, 0], False)


def test_exact_trails_weigh_more_in_the_common_motion() -> None:
    simulated, _, shift = common()
    rng = np.random.default_rng(9)
    std = np.where(np.arange(60) < 30, 0.02, 0.4)
    shift = shift + rng.normal(0, 1, (60, 2)) * 0.3
    found = [found_with([*each, 0, 0], s) for each, s in zip(shift.tolist(), std.tolist(), strict=True)]
    fitted, agrees = _common_motion(simulated, found)
    jacobian = simulated.jacobian[:, :2, :3]
    motion = fitted
    for _ in range(30):  # iterated weights from the definition
        residual = np.linalg.norm(shift - jacobian @ motion, axis=1)
        limit = max(6 * np.median(residual) / 1.1774, 1.0)
        weight = np.maximum(1 - (residual / (1.5 * limit + 3 * (std + 0.02))) ** 2, 0) ** 2 / (std + 0.02) ** 2
        root = np.sqrt(weight)[:, np.newaxis, np.newaxis]
        motion = np.linalg.lstsq((root * jacobian).reshape(-1, 3), (root[..., 0] * shift).ravel(), rcond=None)[0]
    np.testing.assert_allclose(fitted, motion, rtol=1e-4)
    assert agrees.all()
    distance = np.linalg.norm(shift - jacobian @ fitted, axis=1)
    assert _scatter_px(simulated, found, fitted) == pytest.approx(
        np.median(distance) / np.sqrt(2 * np.log(2)), rel=1e-4
    )
    assert np.isnan(_scatter_px(simulated, [None] * 60, fitted))


def test_one_star_gives_the_smallest_rotation() -> None:
    simulated, _, shift = common(1)
    fitted, agrees = _common_motion(simulated, [found_with([*shift[0].tolist(), 0, 0])])
    jacobian = simulated.jacobian[0, :2, :3]
    # Each rotation counts in units that move a star by up to 1 px.
    scale = np.abs(jacobian).max(axis=0)
    np.testing.assert_allclose(fitted, np.linalg.pinv(jacobian / scale) @ shift[0] / scale, rtol=1e-5)
    assert agrees.all()


def test_trails_are_found_after_a_shift_of_the_whole_image() -> None:
    paths = [PATH * 0.5 + at for at in ([0, 0], [50, 10], [10, 45])]
    image = sum(drawn(path, 8000.0) for path in paths)
    simulated = trails(paths, signal_dn=image, pixels_dn=image, jacobian=np.zeros((3, 4, 8)))
    simulated.jacobian[:, 0, 1] = simulated.jacobian[:, 1, 0] = 100.0
    real = sum(drawn(path + np.array([6.3, -4.2]), 8000.0) for path in paths)
    rng = np.random.default_rng(2)
    sky = real_image((real + rng.normal(0, 2, real.shape)).astype(np.float32))
    paired = pair_trails(sky, simulated, search_px=9.0)
    assert paired.found_indices == [0, 1, 2]
    np.testing.assert_allclose(paired.motion, [-0.042, 0.063, 0], rtol=0, atol=1e-3)
    assert paired.found_signal == 1.0
    near = pair_trails(sky, simulated, search_px=9.0, expected_px=np.tile([6.0, -5.0], (3, 1)))
    assert near.found_indices == [0, 1, 2]
    nothing = pair_trails(real_image(np.zeros_like(image)), simulated, search_px=9.0)
    assert (nothing.found, nothing.astray, nothing.motion.tolist()) == ((None,) * 3, 0, [0, 0, 0])


def test_a_large_image_is_searched_in_bins_and_outliers_are_counted() -> None:
    """Bins of 2 px over 600 px, twice the noise on the right, a turn about the middle, and one star that is another."""
    at = np.array([(x, y) for x in (60.0, 230, 390, 530) for y in (60.0, 200)]) + [[0, 0], [7, 3]] * 4
    middle = np.array([300.0, 130])
    paths = [at_k + np.column_stack([12 * U, 7 * U + U**2]) for at_k in at]
    offset = at - middle
    jacobian = np.zeros((8, 4, 8))
    jacobian[:, 0, 1] = jacobian[:, 1, 0] = 100.0
    jacobian[:, :2, 2] = offset[:, ::-1] * [-1, 1]
    motion = np.array([0.17, -0.21, 0.012])
    shifts = jacobian[:, :2, :3] @ motion
    shifts[5] += [2.2, 1.5]

    def scene_of(moves: np.ndarray) -> np.ndarray:
        rows, columns = (np.arange(n, dtype=float) for n in (260, 600))
        total = np.zeros((260, 600))
        for path, move in zip(paths, moves, strict=True):
            x, y = (np.exp(-((axis - (path + move)[:, k, None]) ** 2) / 4.5) for k, axis in ((0, columns), (1, rows)))
            total += 60 * y.T @ x / 10
        return total.astype(np.float32)

    image, noise = scene_of(np.zeros((8, 2))), np.full((260, 600), 2.0, np.float32)
    noise[:, 300:] = 4.0
    real = scene_of(shifts) + np.random.default_rng(1).normal(0, 1, image.shape).astype(np.float32) * noise
    sky = SubtractedImage(real, noise, np.ones(image.shape, bool))
    simulated = trails(paths, signal_dn=image, pixels_dn=image, jacobian=jacobian)
    found = pair_trails(sky, simulated, search_px=35.0)
    assert found.found_indices == [0, 1, 2, 3, 4, 6, 7]
    assert found.astray == 1
    assert (np.abs(found.motion - motion) < [1e-3, 1e-3, 5e-4]).all(), found.motion - motion
    assert all(found.found[k].bent for k in found.found_indices)
    assert pair_trails(sky, simulated.only(np.zeros(0, np.intp)), search_px=9.0).found == ()


def test_the_part_of_the_signal_that_was_found_is_of_squared_ratios() -> None:
    simulated = trails([PATH, PATH, PATH], signal_to_noise=np.array([3.0, 4.0, 12.0]))
    some = Pairing(simulated, (found_with([0, 0, 0, 0]), None, found_with([0, 0, 0, 0])), 0, np.zeros(3))
    assert some.found_indices == [0, 2]
    assert some.found_signal == pytest.approx(153 / 169)
    assert Pairing(simulated, (None,) * 3, 0, np.zeros(3)).found_signal == 0


def test_a_pair_has_the_differences_of_the_drawn_trails() -> None:
    modes = [1.2, -0.9, 0.1, 0.04]
    image = drawn(PATH, 30000.0)
    simulated = trails([PATH], signal_dn=image, pixels_dn=image + np.float32(0.5), vmag=np.array([3.5]))
    moved = moved_path(PATH, np.array(modes))
    above = drawn(moved, 1.2 * 30000 * 1.1) + np.float32(4.0)
    sky = real_image(above)
    found = found_with(modes, brightness=1.2, sky_dn=4.0)
    measures = measure("a.png", sky, Pairing(simulated, (found,), 0, np.zeros(3)))
    (pair,), (cutouts,) = measures.pairs, measures.pictures

    assert (pair.image, pair.star_id, pair.vmag, pair.name) == ("a.png", 1, 3.5, "star 0")
    assert (pair.x_px, pair.y_px) == pytest.approx(tuple(PATH.mean(axis=0)))
    # The same flux along the simulated path: 1.1 times the brightness per length.
    assert pair.peak_simulated_dn == pytest.approx(image.max())
    assert pair.peak_real_dn == pytest.approx(1.2 * 1.1 * image.max())
    assert (pair.pixel_real_dn, pair.pixel_simulated_dn) == pytest.approx((above.max() - 4, image.max() + 0.5))
    # The mean of a path and the middle of its box, from the drawn paths themselves.
    assert pair.centroid_px == pytest.approx(np.hypot(1.2, 0.9), abs=0.02)
    box, moved_box = ((p.min(axis=0) + p.max(axis=0)) / 2 for p in (PATH, moved))
    shape = (PATH.mean(axis=0) - box) - (moved.mean(axis=0) - moved_box)
    assert pair.shape_px == pytest.approx(np.linalg.norm(shape), abs=0.02)
    assert pair.baseline_px == pytest.approx(np.linalg.norm(moved.mean(axis=0) - moved_box), abs=0.02)
    assert (pair.shift_x_px, pair.shift_y_px, pair.shift_std_px) == pytest.approx((-1.2, 0.9, 0.05))
    length = np.linalg.norm(np.diff(PATH, axis=0), axis=1).sum()
    assert (pair.length_px, pair.length_difference_px) == pytest.approx((length, -0.1 * length))
    assert (pair.direction_difference_rad, pair.saturated) == (-0.04, False)
    assert pair.beyond_noise_px == pytest.approx(pair.centroid_px - 2 * pair.noise_px)
    # A uniform error of 2 DN over the aperture of the trail.
    pixels = np.stack(np.meshgrid(np.arange(120.0), np.arange(100.0)), axis=-1).reshape(-1, 2)
    aperture = pixels[np.linalg.norm(pixels[:, np.newaxis] - moved, axis=-1).min(axis=1) <= 6.0]
    spread = np.sqrt(((aperture - moved.mean(axis=0)) ** 2).sum())
    assert pair.noise_px == pytest.approx(2 * spread / (1.2 * 1.1 * 30000), rel=0.05)
    assert (cutouts.real.max(), cutouts.simulated.max()) == pytest.approx((above.max() - 4, image.max() + 0.5))
    assert cutouts.real.shape == cutouts.simulated.shape

    # A short trail has no length; the fit or the headroom makes it saturated.
    limited = trails([PATH], signal_dn=image, pixels_dn=image, headroom_dn=float(image.max()))
    for simulated_, other in ((simulated, found_with(modes, saturated=True)), (limited, found_with(modes, bent=False))):
        ((pair,), _) = (result := measure("a.png", sky, Pairing(simulated_, (other,), 0, np.zeros(3)))).pairs, result
        assert pair.saturated
    assert np.isnan(pair.length_difference_px)
    assert np.isnan(pair.direction_difference_rad)


def test_subtracted_images_know_noise_saturation_and_significance() -> None:
    rng = np.random.default_rng(11)
    pixels = np.clip(np.rint(100 + rng.normal(0, 5, (200, 240))), 0, 255)
    pixels[:20, :24] = 255
    pixels[30, 30], pixels[30, 40] = 249, 250  # 98 % of 255 are 249.9
    sky = subtract_background(pixels.astype(np.uint8), saturation_dn=255.0)
    assert (bool(sky.usable[30, 30]), bool(sky.usable[30, 40])) == (True, False)
    assert sky.saturated_fraction == pytest.approx(481 / 48000)
    assert sky.usual_noise_dn == pytest.approx(5.0, rel=0.06)
    # White noise has a significance of 1, whatever its smoothing; the floor of a flat image is not divided by 0.
    white = real_image(rng.normal(0, 7, (300, 300)).astype(np.float32), 7.0)
    assert white.significance(1.5).std() == pytest.approx(1.0, rel=0.05)
    assert not real_image(np.zeros((30, 30), np.float32)).significance(1.5).any()


def test_a_readout_time_is_longer_about_the_time_of_the_image() -> None:
    jacobian = np.arange(64.0).reshape(2, 4, 8)
    same = _by_signed_readout(jacobian, 0.5, 0.0)
    np.testing.assert_array_equal(same[..., 4], jacobian[..., 4] - 0.5 * jacobian[..., 3])
    np.testing.assert_array_equal(_by_signed_readout(jacobian, 0.5, -0.1)[..., 4], -same[..., 4])
    np.testing.assert_array_equal(np.delete(same, 4, axis=-1), np.delete(jacobian, 4, axis=-1))


def test_a_stack_is_saturated_where_one_short_exposure_may_be() -> None:
    pixels = np.full((4, 4), 90, np.uint16)
    sensor = Sensor(bit_depth=8)
    assert _saturation_dn(pixels, sensor, Exposure(0.0, 0.1)) == 255
    # One of three exposures at 255, the others at the background of 30 each; of a mean, a third of it.
    assert _saturation_dn(pixels, sensor, Exposure(0.0, 0.1, frames=3)) == pytest.approx(255 + 60)
    assert _saturation_dn(pixels // 3, sensor, Exposure(0.0, 0.1, frames=3, stack="mean")) == pytest.approx(85 + 20)


def test_sources_problems_and_spans_are_named() -> None:
    images = [SimpleNamespace(time=SimpleNamespace(source=source)) for source in ("EXIF", "name", "name")]
    assert _count_sources(images) == "2 by name, 1 by EXIF"
    assert (_named("a.png: is broken"), _named("is broken")) == (("a.png", "is broken"), ("", "is broken"))
    assert (_span(3599.5), _span(3600.0), _span(5400.0)) == ("3599.500 s", "1.0 h", "1.5 h")
