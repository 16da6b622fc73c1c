"""Expected peaks and areas of trails of all profiles, against fine images and integrals of the profile."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.integrate import quad
from scipy.special import erf

from glstar.camera.sensor.pointspread import PsfComponent
from glstar.camera.sensor.sensor import Sensor, noise_equivalent_area_px2
from glstar.render.motion.trailmodels import AnalyticSegments
from glstar.render.scene.scene import Scene
from glstar.render.scene.transmission import Transmission
from glstar.render.truth.linechains import LineChain
from glstar.render.truth.peaks import _area_over_core, _profiles, _recorded, _Search, _transmissions, trail_peaks
from tests.support.scenes import camera, stars_at

LENS = camera(120, 90, 300.0)
PLAIN = Sensor(psf_sigma_px=1.6)
VARIANCE = 1.6**2 + 1 / 12
WINGS = replace(PLAIN, effects={"sensor.psf_wing_fraction": 0.3, "sensor.psf_wing_sigma_px": 5.0})
PARTS = ((0.7, VARIANCE), (0.3, 25 + 1 / 12))


def scene_of(sensor: Sensor, length_px: float, xy_px: tuple[float, float] = (55.0, 40.0)) -> Scene:
    """Return a star that moves by a length, mostly to the right."""
    turn = length_px / 300.0
    scene = stars_at([xy_px], [3.0], sensor=sensor, lens=LENS, n=1, turn=lambda u: (-0.8 * turn * u, 0.6 * turn * u))
    return replace(scene, trails=AnalyticSegments(scene.shutter, np.ones(1)))


def signal_beside(off_px: float, length_px: float, parts: tuple[tuple[float, float], ...] = PARTS) -> float:
    """Return the signal of the middle of a trail beside it over its flux, 1/px^2."""
    return sum(
        fraction * np.exp(-(off_px**2) / (2 * variance)) / np.sqrt(2 * np.pi * variance)
        * (erf(length_px / np.sqrt(8 * variance)) / length_px if length_px else 1 / np.sqrt(2 * np.pi * variance))
        for fraction, variance in parts
    )  # fmt: skip


@pytest.mark.parametrize("length_px", [0.0, 2.0, 12.0, 45.0])
def test_a_gaussian_at_rest_and_a_trail_have_their_peak_and_area(length_px: float) -> None:
    scene = scene_of(PLAIN, length_px)
    path = LENS.project(scene.trails.pointing.to_camera(scene.stars.direction_eq))[:, 0]
    moved_px = float(np.hypot(*(path[-1] - path[0])))
    found = trail_peaks(scene, scene.stars.direction_eq)
    peak = signal_beside(0.0, moved_px, ((1.0, VARIANCE),))
    # The scale of a pinhole grows towards the ends of a long trail, by 0.3 %.
    assert found.peak_fraction_per_px2[0] == pytest.approx(peak, rel=4e-3)
    along = np.linspace(-moved_px / 2, moved_px / 2, 2001) if moved_px else np.zeros(2)
    pairs = np.exp(-(np.subtract.outer(along[::4], along) ** 2) / (4 * VARIANCE)).mean()
    assert found.area_px2[0] == pytest.approx(4 * np.pi * VARIANCE / pairs, rel=0.01)


@pytest.mark.parametrize("length_px", [0.0, 80.0])
def test_stars_with_wings_have_lower_peaks_and_larger_areas(length_px: float) -> None:
    scene = scene_of(WINGS, length_px)
    found = trail_peaks(scene, scene.stars.direction_eq)
    assert found.peak_fraction_per_px2[0] == pytest.approx(signal_beside(0.0, length_px), rel=2e-3)
    if length_px == 0:
        square = quad(lambda r: 2 * np.pi * r * signal_beside(r, 0.0) ** 2, 0, 60)[0]
    else:  # of a part in the middle of a long trail
        square = quad(lambda off: (signal_beside(off, 1e4) * 1e4) ** 2, -60, 60)[0] / length_px
    assert found.area_px2[0] == pytest.approx(1 / square, rel=0.05 if length_px else 0.01)


def test_between_rest_and_a_long_trail_areas_are_interpolated_by_the_peak() -> None:
    scale, plain = np.array([1.0, 1.0, 1.0, 1.3, 1.3]), ((1.0, VARIANCE),)
    at_rest = signal_beside(0.0, 0.0)
    peaks = np.array([at_rest, 0.3 * at_rest, 0.0, 0.3 * at_rest / 1.69, 9.0])
    square = quad(lambda r: 2 * np.pi * r * signal_beside(r, 0.0) ** 2, 0, 60)[0]
    rest = 1 / square / (4 * np.pi * VARIANCE)
    line = (
        quad(lambda off: signal_beside(off, 1e6, plain) ** 2, -60, 60)[0]
        / quad(lambda off: signal_beside(off, 1e6) ** 2, -60, 60)[0]
    )
    concentration = np.array([1.0, 0.3, 0.0, 0.3, 1.0])
    expected = (line + (rest - line) * concentration) * scale ** (1 + concentration)
    np.testing.assert_allclose(_area_over_core(WINGS, scale, peaks), expected, rtol=1e-3)
    assert _area_over_core(PLAIN, scale, peaks) == 1.0


@pytest.mark.parametrize("sigma_px", [0.3, 0.5, 0.89])
def test_a_narrow_star_is_recorded_by_pixels_as_nine_gaussians(sigma_px: float) -> None:
    sensor = Sensor(psf_sigma_px=sigma_px)
    parts = _recorded(sensor, PsfComponent(0.6, sigma_px, (0.2, -0.1)))
    assert len(parts) == 9
    assert sum(fraction for fraction, _, _ in parts) == pytest.approx(0.6, rel=1e-6)
    for x, y in ((0.2, -0.1), (0.7, 0.4), (-0.5, 1.1)):
        signal = sum(
            f * np.exp(-((x - dx) ** 2 + (y - dy) ** 2) / (2 * s**2)) / (2 * np.pi * s**2) for f, s, (dx, dy) in parts
        )
        exact = 0.6 * np.prod([
            (erf((at + 0.5) / (np.sqrt(2) * sigma_px)) - erf((at - 0.5) / (np.sqrt(2) * sigma_px))) / 2
            for at in (x - 0.2, y + 0.1)
        ])  # fmt: skip
        assert signal == pytest.approx(exact, rel=0.02, abs=0.004)


def test_wide_stars_and_sampled_pixels_are_one_gaussian() -> None:
    for sensor, variance in (
        (Sensor(psf_sigma_px=0.91), 0.91**2 + 1 / 12),
        (Sensor(psf_sigma_px=0.5, pixel="sampled"), 0.25),
    ):
        ((fraction, sigma, offset),) = _recorded(sensor, PsfComponent(0.6, sensor.psf_sigma_px, (0.2, -0.1)))
        assert (fraction, offset.tolist()) == (0.6, [0.2, -0.1])
        assert sigma == pytest.approx(np.sqrt(variance), rel=1e-9)


def test_each_width_has_its_own_stars() -> None:
    growing = replace(PLAIN, effects={"sensor.psf_growth": 0.8})
    scales = np.array([1.2, 1.0, 1.2])
    (first, one), (second, other) = _profiles(growing, scales)
    assert (first.tolist(), second.tolist()) == ([1], [0, 2])
    for parts, scale in ((one, 1.0), (other, 1.2)):
        ((fraction, sigma, offset),) = parts
        assert (fraction, offset.tolist()) == (1.0, [0.0, 0.0])
        assert sigma == pytest.approx(np.sqrt((1.6 * scale) ** 2 + 1 / 12), rel=1e-9)
    ((stars, parts),) = _profiles(PLAIN, np.ones(3))
    assert stars == slice(None)
    assert parts[0][1] == pytest.approx(np.sqrt(VARIANCE), rel=1e-12)


@pytest.mark.parametrize("passage", [Transmission(np.full((3, 1), 0.4)), Transmission(np.array([[1.0], [0.2], [0.6]]))])
def test_cloud_lowers_the_peak_and_not_the_area_of_an_evenly_dimmed_trail(passage: Transmission) -> None:
    scene = scene_of(PLAIN, 45.0)
    clear = trail_peaks(scene, scene.stars.direction_eq)
    dimmed = trail_peaks(scene, scene.stars.direction_eq, passage)
    fraction = passage.at(np.linspace(0, 1, 400))[:, 0]
    along = np.linspace(-22.5, 22.5, 400)
    kernel = np.exp(-(np.subtract.outer(np.linspace(-24, 24, 800), along) ** 2) / (2 * VARIANCE))
    signal = kernel @ fraction / 400 / (2 * np.pi * VARIANCE)
    assert dimmed.peak_fraction_per_px2[0] == pytest.approx(signal.max(), rel=0.01)
    pairs = np.exp(-(np.subtract.outer(along, along) ** 2) / (4 * VARIANCE))
    overlap = (fraction @ pairs @ fraction) / fraction.sum() ** 2
    assert dimmed.area_px2[0] == pytest.approx(4 * np.pi * VARIANCE / overlap, rel=0.01)
    if np.ptp(passage.fraction) == 0:
        assert dimmed.area_px2[0] == pytest.approx(clear.area_px2[0], rel=1e-6)
        assert dimmed.peak_fraction_per_px2[0] == pytest.approx(0.4 * clear.peak_fraction_per_px2[0], rel=1e-6)


def test_beside_the_image_the_area_is_bounded_by_the_peak() -> None:
    scene = scene_of(PLAIN, 0.0, (122.0, 40.0))
    found = trail_peaks(scene, scene.stars.direction_eq)
    peak = np.exp(-(2.5**2) / (2 * VARIANCE)) / (2 * np.pi * VARIANCE)
    assert found.peak_fraction_per_px2[0] == pytest.approx(peak, rel=2e-3)
    assert found.area_px2[0] == pytest.approx(np.sqrt(2) / peak, rel=2e-3)


def test_a_path_that_returns_is_brightest_where_its_parts_add_up() -> None:
    """Two parts are beside each other by 1.3 sigma: between them is more light than on either."""
    there = np.column_stack([np.linspace(30, 80, 60), np.full(60, 40.0)])
    back = np.column_stack([np.linspace(80, 30, 60), np.full(60, 40.0 + 1.3 * np.sqrt(VARIANCE))])
    path = np.concatenate([there, back])
    count = len(path)
    rays = LENS.unit_vectors(path)
    # A camera that points at each position in turn, with the star ahead of the middle pixel.
    scene = scene_of(PLAIN, 0.0, (59.5, 44.5))
    pointing = SimpleNamespace(to_camera=lambda _eq: rays[:, np.newaxis])
    shown = SimpleNamespace(
        camera=LENS, sensor=PLAIN, exposure=scene.exposure, listing=None, trails=SimpleNamespace(pointing=pointing),
        shutter=scene.shutter,
    )  # fmt: skip
    found = trail_peaks(shown, scene.stars.direction_eq)
    y = np.linspace(38, 44, 601)
    x = np.arange(50.0, 60.0, 0.25)
    off = (x[:, np.newaxis, np.newaxis] - path[:, 0]) ** 2 + (y[:, np.newaxis] - path[:, 1]) ** 2
    signal = np.exp(-off / (2 * VARIANCE)).sum(axis=2) / (count * 2 * np.pi * VARIANCE)
    assert found.peak_fraction_per_px2[0] == pytest.approx(signal.max(), rel=0.01)


def test_a_search_along_a_line_says_whether_there_is_more_light_beside_it() -> None:
    asked = []

    class Part:
        """Light that falls to both sides, or that is steeper on one of them or along the line."""

        def __init__(self, shape: tuple[float, float, float]) -> None:
            self.shape = shape

        def near(self, middle_px: np.ndarray, reach_px: np.ndarray) -> list[object]:
            asked.append((middle_px.tolist(), reach_px.tolist()))
            return [self]

        def signal(self, x_px: np.ndarray, y_px: np.ndarray) -> np.ndarray:
            along, beside, curve = self.shape
            s, p = 0.6 * x_px + 0.8 * y_px, -0.8 * x_px + 0.6 * y_px
            return np.exp(along * s + beside * p - curve * p * p)

    middle, step = np.array([[60.0, 40.0]]), np.array([[6.0, 8.0]])
    # 0.3 % along 10 px; 5 % between 0.72 px on either side.
    for along, beside, may_gain in (
        (0.0, 0.0, False), (0.00028, 0.0, False), (0.00032, 0.0, True),
        (0.0, 0.0335, False), (0.0, 0.036, True), (0.0, -0.036, True),
    ):  # fmt: skip
        shape = (along, beside, 0.3)
        search = _Search.along(LENS, 1.2, [Part(shape)], middle, step)
        assert search.may_gain.tolist() == [may_gain]
        ends = [np.exp(shape[0] * s) for s in (0.0, -2.5, 2.5, -5.0, 5.0)]
        assert search.largest[0] == pytest.approx(max(ends), rel=1e-9)
    # Half of the length of the line and three of the steps around it.
    assert asked[0] == ([[60.0, 40.0]], [pytest.approx(5 + 3 * 0.6 * 1.2)])
    _Search.along(LENS, 1.2, [Part((0.0, 0.0, 0.0))], middle, 0 * step)
    assert asked[-1][1] == [pytest.approx(0.36 + 3 * 0.6 * 1.2)]
    # The place is one of the image.
    at_border = _Search.along(LENS, 1.2, [Part((0.0, 0.0, 0.0))], np.array([[122.0, -3.0]]), step)
    assert at_border.largest[0] == 1.0
    np.testing.assert_allclose(
        [limit[:, 0, 0] for limit in at_border._limits_px], [[-122.5, 2.5], [-2.5, 92.5]], rtol=1e-12
    )


def test_what_cloud_transmits_is_the_mean_during_each_line_of_each_chain() -> None:
    chains = [LineChain.of(np.zeros((2, 3, 1)), np.array(of), None) for of in ([0.1, 0.3], [0.4, 0.2])]
    passage = Transmission(np.array([[1.0], [0.5], [0.8]]))
    first, second = _transmissions(chains, passage)
    means = passage.means(np.array([0.1, 0.3, 0.4, 0.2]))
    np.testing.assert_allclose(np.concatenate([first, second]), means, rtol=1e-12)
    assert (first.shape, second.shape) == ((2, 1), (2, 1))
    assert _transmissions(chains, None) == [None, None]


def test_the_concentration_of_a_narrow_star_is_relative_to_what_a_pixel_records_of_it() -> None:
    narrow = Sensor(psf_sigma_px=0.5, effects={"sensor.psf_wing_fraction": 0.3, "sensor.psf_wing_sigma_px": 5.0})
    core = erf(0.5 / (np.sqrt(2) * 0.5)) ** 2
    peak = 0.7 * core + 0.3 / (2 * np.pi * (25 + 1 / 12))
    rest = noise_equivalent_area_px2(narrow) / (4 * np.pi * (0.25 + 1 / 12))
    found = _area_over_core(narrow, np.ones(3), np.array([peak, peak / 2, 0.0]))
    assert found[0] == pytest.approx(rest, rel=2e-3)
    # A half of the peak is halfway between a star at rest and a long trail.
    assert found[1] == pytest.approx((found[0] + found[2]) / 2, rel=2e-3)
    assert found[2] < 0.9 * found[0]


@pytest.mark.parametrize(("sensor", "x_px"), [(WINGS, 55.0), (PLAIN, 122.0)])
def test_even_cloud_leaves_the_area_of_every_trail(sensor: Sensor, x_px: float) -> None:
    scene = scene_of(sensor, 10.0, (x_px, 40.0))
    even = Transmission(np.full((2, 1), 0.4))
    clear, dimmed = (trail_peaks(scene, scene.stars.direction_eq, passage) for passage in (None, even))
    assert dimmed.area_px2[0] == pytest.approx(clear.area_px2[0], rel=1e-6)
    assert dimmed.peak_fraction_per_px2[0] == pytest.approx(0.4 * clear.peak_fraction_per_px2[0], rel=1e-6)


def test_a_star_at_rest_is_searched_along_the_rows_of_the_image() -> None:
    asked = []
    stand_in = SimpleNamespace(
        near=lambda _middle, _reach: [
            SimpleNamespace(signal=lambda x, y: (asked.append(np.stack([x, y])[..., 0].T), np.ones_like(x))[1])
        ]
    )
    _Search.along(LENS, 1.2, [stand_in], np.array([[60.0, 40.0]]), np.zeros((1, 2)))
    side = 0.6 * 1.2
    along = [(side * part, 0.0) for part in (0.0, -0.25, 0.25, -0.5, 0.5)]
    np.testing.assert_allclose(asked[0], [*along, (0.0, -side), (0.0, side)], rtol=0, atol=1e-12)
