"""Limits of the fit of a trail: its search window, its prior, and when a trail counts as found."""

from dataclasses import replace
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
from scipy.ndimage import affine_transform
from scipy.optimize import least_squares

from glstar.compare import pairs
from glstar.compare.detection import SubtractedImage
from glstar.compare.pairs import Pairing, _first_detections, _spread_px, measure, pair_trails
from glstar.compare.prediction import Stamp, moved_path, stamp_of
from glstar.compare.trailfit import _brightest_offset, find_trail
from tests.compare.test_pathshapes import trails
from tests.compare.test_trailpairing import PATH, SIGMA_PX, U, drawn, found_with, real_image

WIDE_PX = 3.5 * SIGMA_PX + 0.5
SHORT = np.column_stack([60 + 6 * U, 50 + 3 * U])


@pytest.mark.parametrize("at", [(0, 0), (3, 1), (14, 20), (28, 29), (16, 30), (31, 12)])
@pytest.mark.parametrize(("expected", "window_px"), [((0.4, -0.4), 3.0), ((2.4, -1.6), 2.2), ((-3.0, 5.0), 7.0)])
def test_the_brightest_offset_is_the_largest_correlation_within_window_and_image(at, expected, window_px) -> None:
    """A window is smaller at the edges of the image; only pixels of the mask count."""
    rng = np.random.default_rng(4)
    image = rng.normal(0, 1, (36, 40)).astype(np.float32)
    template = rng.uniform(0, 2, (6, 8)).astype(np.float32)
    mask = rng.random((6, 8)) > 0.4
    stamp = Stamp(*at, mask)
    found = _brightest_offset(real_image(image), template, stamp, np.array(expected), window_px)

    reach = int(np.ceil(window_px))
    best, largest = None, -np.inf
    for dy in range(round(expected[1]) - reach, round(expected[1]) + reach + 1):
        for dx in range(round(expected[0]) - reach, round(expected[0]) + reach + 1):
            left, top = at[0] + dx, at[1] + dy
            if 0 <= left <= 40 - 8 and 0 <= top <= 36 - 6:
                product = float((image[top : top + 6, left : left + 8] * template)[mask].sum())
                if product > largest:
                    best, largest = [dx, dy], product
    assert (None if found is None else found.tolist()) == best


def deformed(image: np.ndarray, modes: np.ndarray) -> np.ndarray:
    """Return an image of `SHORT` shifted, stretched along the trail, then turned about its middle, by SciPy."""
    along, across = np.array([2.0, 1.0]) / np.sqrt(5), np.array([-1.0, 2.0]) / np.sqrt(5)
    turn = modes[3]
    turned_along = np.array([along[0] * np.cos(turn) - along[1] * np.sin(turn), along @ [np.sin(turn), np.cos(turn)]])
    turned_across = np.array([-turned_along[1], turned_along[0]])
    back = np.outer(along, turned_along) / (1 + modes[2]) + np.outer(across, turned_across)
    middle = SHORT.mean(axis=0)
    offset = middle - back @ (middle + modes[:2])
    return affine_transform(image, back[::-1, ::-1], offset[::-1], order=3, mode="nearest")


@pytest.mark.parametrize(("stretch", "turn"), [(0.25, 0.0), (0.0, 0.3), (-0.2, -0.25)])
def test_a_prior_of_three_tenths_pulls_the_stretch_and_turn_of_a_faint_trail(stretch: float, turn: float) -> None:
    image, noise_dn = drawn(SHORT, 30000.0).astype(float), 520.0
    real = deformed(image, np.array([0, 0, stretch, turn]))
    sky = real_image(real.astype(np.float32), noise_dn)
    found = find_trail(
        sky, image.astype(np.float32), SHORT, WIDE_PX, expected_px=np.zeros(2), window_px=2.0, bends=True
    )

    # The same by SciPy: the aperture and the dark pixels around it.
    stamp = stamp_of(SHORT, WIDE_PX, margin_px=3)
    template = stamp.of(image)
    beside = cv2.dilate(stamp.mask.astype(np.uint8), np.ones((5, 5), np.uint8)) > 0
    counts = stamp.mask | (beside & (template < 0.02 * template.max()))

    def off(p: np.ndarray) -> np.ndarray:
        model = p[0] * deformed(image, p[2:]) + 100 * p[1]
        return np.append(stamp.of(model - real)[counts] / noise_dn, p[4:] / 0.3)

    best = least_squares(off, [1.0, 0, 0, 0, 0, 0], diff_step=1e-4, x_scale=[1, 1, 1, 1, 0.1, 0.1])
    assert found is not None
    np.testing.assert_allclose(found.modes[2:], best.x[4:], rtol=0.01, atol=0.003)
    assert np.abs(best.x[4:]).sum() < 0.91 * (abs(stretch) + abs(turn))
    covariance = np.linalg.inv(best.jac.T @ best.jac)
    np.testing.assert_allclose(np.diag(found.covariance)[2:], np.diag(covariance)[4:], rtol=0.05)
    assert found.brightness_std == pytest.approx(np.sqrt(covariance[0, 0]), rel=0.02)


@pytest.mark.parametrize(("off_px", "is_found"), [(4.9, True), (5.1, False)])
def test_a_trail_may_lie_two_pixels_outside_of_its_window(off_px: float, is_found: bool) -> None:
    """The window ends at whole pixels, and the fit moves on from them."""
    sky = real_image(drawn(PATH + np.array([off_px, 0]), 30000.0))
    found = find_trail(sky, drawn(PATH, 30000.0), PATH, WIDE_PX, expected_px=np.zeros(2), window_px=3.0, bends=False)
    assert (found is not None) == is_found


@pytest.mark.parametrize(("pixels", "is_found"), [(11, False), (12, True)])
def test_a_fit_needs_twelve_pixels(pixels: int, is_found: bool) -> None:
    above = drawn(SHORT, 30000.0)
    usable = np.zeros(above.shape, bool)
    usable.flat[np.argsort(-above, axis=None)[:pixels]] = True
    sky = SubtractedImage(above, np.full_like(above, 2.0), usable)
    found = find_trail(sky, above, SHORT, WIDE_PX, expected_px=np.zeros(2), window_px=1.0, bends=False)
    assert (found is not None) == is_found


@pytest.mark.parametrize(("part", "is_found"), [(0.56, True), (0.64, False)])
def test_a_trail_whose_rest_has_six_tenths_of_its_power_is_another(part: float, is_found: bool) -> None:
    """A pattern that no motion of the trail makes: alternately brighter and darker pixels."""
    above = drawn(PATH, 30000.0)
    stamp = stamp_of(PATH, WIDE_PX, margin_px=3)
    rows, columns = np.indices(above.shape)
    pattern = np.where((rows + columns) % 2, 1.0, -1.0)
    aperture = stamp_of(PATH, WIDE_PX)
    inside = np.zeros(above.shape, bool)
    inside[
        aperture.top : aperture.top + aperture.mask.shape[0], aperture.left : aperture.left + aperture.mask.shape[1]
    ] = aperture.mask
    power = float((stamp.of(above)[stamp.mask].astype(float) ** 2).sum())
    rest = (pattern * inside * np.sqrt(part * power / inside.sum())).astype(np.float32)
    found = find_trail(
        real_image(above + rest, 1.0), above, PATH, WIDE_PX, expected_px=np.zeros(2), window_px=2.0, bends=False
    )
    assert (found is not None) == is_found
    if found is not None:
        # The rest widens the error: chi squared over the degrees of freedom is that of the pattern.
        still = find_trail(
            real_image(above, 1.0), above, PATH, WIDE_PX, expected_px=np.zeros(2), window_px=2.0, bends=False
        )
        assert found.brightness_std > 10 * still.brightness_std


@pytest.mark.parametrize(("stretch", "is_found"), [(0.57, True), (0.75, False)])
def test_a_stretch_ends_at_six_tenths(stretch: float, is_found: bool) -> None:
    real = drawn(moved_path(SHORT, np.array([0, 0, stretch, 0])), 30000 * (1 + stretch))
    found = find_trail(
        real_image(real), drawn(SHORT, 30000.0), SHORT, WIDE_PX, expected_px=np.zeros(2), window_px=2.0, bends=True
    )
    assert (found is not None) == is_found


def test_the_first_windows_grow_with_bins_and_the_distance_from_the_centre(monkeypatch) -> None:
    """Bins of two pixels: the common shift is a multiple of 2 px; 4 px, a bin, and 0.012 of the distance."""
    shape = (300, 600)
    rng = np.random.default_rng(3)
    middles = np.array([[60.0, 60], [300, 150], [520, 220]])
    paths = [middle + np.column_stack([9 * U, 6 * U]) for middle in middles]

    def scene(shift: np.ndarray) -> np.ndarray:
        total = np.zeros(shape)
        for path in paths:
            x, y = (
                np.exp(-((np.arange(n) - (path + shift)[:, k, None]) ** 2) / 4.5)
                for k, n in ((0, shape[1]), (1, shape[0]))
            )
            total += 20 * y.T @ x / 10
        return total.astype(np.float32)

    simulated = trails(paths, signal_dn=scene(np.zeros(2)), jacobian=np.zeros((3, 4, 8)))
    noise = rng.normal(0, 2, shape).astype(np.float32)
    asked = []
    monkeypatch.setattr(pairs, "find_trail", lambda *_args, **settings: asked.append(SimpleNamespace(**settings)))
    _first_detections(real_image(scene(np.array([14.0, -8.0])) + noise), simulated, 30.0)
    assert [one.expected_px.tolist() for one in asked] == [[14.0, -8.0]] * 3
    distance = np.hypot(*(middles - [300, 150]).T)
    np.testing.assert_allclose([one.window_px for one in asked], 4 + 2 + 0.012 * distance, rtol=1e-6)
    assert not any(one.bends for one in asked)


def test_simulated_trails_are_cut_off_where_a_pixel_saturates() -> None:
    image = drawn(PATH, 30000.0)
    limit = float(image.max()) / 2
    simulated = trails([PATH], signal_dn=image, pixels_dn=image, headroom_dn=limit)
    [pair] = measure("a.png", real_image(image), Pairing(simulated, (found_with([0, 0, 0, 0]),), 0, np.zeros(3))).pairs
    assert (pair.peak_simulated_dn, pair.peak_real_dn) == (limit, limit)
    assert pair.pixel_simulated_dn == image.max()
    assert pair.saturated
    above = trails([PATH], signal_dn=image, pixels_dn=image, headroom_dn=1.01 * float(image.max()))
    [pair] = measure("a.png", real_image(image), Pairing(above, (found_with([0, 0, 0, 0]),), 0, np.zeros(3))).pairs
    assert not pair.saturated


@pytest.mark.parametrize("side", [1, 2])
def test_the_expected_signal_is_in_units_of_the_noise_of_a_matched_sum(side: int, monkeypatch) -> None:
    """A star whose smoothed flux is f has the significance f 2 sqrt(pi) sigma / noise, as a mean over its bin."""
    shape = (300 * side, 400 * side)
    rows, columns = np.indices(shape)
    signal = 90 * np.exp(-((columns - 160) ** 2 + (rows - 120) ** 2) / (2 * SIGMA_PX**2))
    noise = np.where(columns < 200, 3.0, 6.0).astype(np.float32)
    given = []

    class Correlation:
        def __init__(self, significance, most_px) -> None:
            given.append((significance.shape, most_px))

        def to(self, density):
            given.append(density)
            return "likeness"

        def best(self, likeness):
            assert likeness == "likeness"
            return np.array([2.0, -3.0])

    monkeypatch.setattr(pairs, "CrossCorrelation", Correlation)
    monkeypatch.setattr(pairs, "find_trail", lambda *_args, expected_px, **_: expected_px.tolist())
    sky = SubtractedImage(np.zeros(shape, np.float32), noise, np.ones(shape, bool))
    simulated = trails([PATH], signal_dn=signal.astype(np.float32), sigma_px=SIGMA_PX, jacobian=np.zeros((1, 4, 8)))
    assert _first_detections(sky, simulated, 30.0) == [[2.0 * side, -3.0 * side]]
    (binned, most_px), density = given
    assert (binned, density.shape, most_px) == ((300, 400), (300, 400), 30.0 / side)
    # Smoothed by its own width, a Gaussian of amplitude 90 has half of it.
    smooth = (
        45 * np.exp(-((columns - 160) ** 2 + (rows - 120) ** 2) / (4 * SIGMA_PX**2)) * 2 * np.sqrt(np.pi) * SIGMA_PX / 3
    )
    expected = smooth.reshape(300, side, 400, side).mean(axis=(1, 3))
    near = np.s_[110 // side : 130 // side, 150 // side : 170 // side]
    np.testing.assert_allclose(density[near], expected[near], rtol=0, atol=0.01 * expected.max())


def test_a_trail_counts_by_its_worse_direction() -> None:
    covariance = np.zeros((4, 4))
    covariance[:2, :2] = [[0.05, 0.03], [0.03, 0.05]]
    # Variances of 0.08 and 0.02 along the diagonals, and 0.02 px of errors of the interpolation.
    assert _spread_px(replace(found_with([0, 0, 0, 0]), covariance=covariance)) == pytest.approx(np.sqrt(0.08) + 0.02)


def test_without_trails_there_is_no_motion() -> None:
    nothing = trails([PATH]).only(np.zeros(0, int))
    found = pair_trails(real_image(np.zeros((100, 120), np.float32)), nothing, search_px=9.0)
    assert (found.found, found.astray, found.motion.tolist(), found.found_indices) == ((), 0, [0, 0, 0], [])
