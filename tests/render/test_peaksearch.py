"""The search for the brightest place, blocks of recorded paths, and which stars are drawn on wider pixels."""

from itertools import pairwise
from types import SimpleNamespace

import numpy as np
import pytest

from glstar.render.effects import lensfalloff
from glstar.render.motion.trailmodels import AnalyticSegments
from glstar.render.readout.rows import RecordedPart
from glstar.render.scene import reduction
from glstar.render.scene.culling import DrawList
from glstar.render.scene.occlusion import NEVER, _crossings
from glstar.render.truth.linechains import _path
from glstar.render.truth.peaks import _Search
from tests.support.scenes import camera


class Hills:
    """One Gaussian hill for each star, of any direction and height."""

    def __init__(self, peak_px: np.ndarray, height: np.ndarray, shape: np.ndarray) -> None:
        self.peak_px, self.height, self.shape = peak_px, height, shape

    def signal(self, x_px: np.ndarray, y_px: np.ndarray) -> np.ndarray:
        dx, dy = x_px - self.peak_px[:, 0], y_px - self.peak_px[:, 1]
        xx, xy, yy = self.shape.T
        return self.height * np.exp(-(xx * dx * dx + 2 * xy * dx * dy + yy * dy * dy) / 2)

    def of_points(self, stars: np.ndarray) -> "Hills":
        return Hills(self.peak_px[stars], self.height[stars], self.shape[stars])


def test_a_paraboloid_through_the_logarithms_leads_to_the_top_of_a_gaussian_hill() -> None:
    rng = np.random.default_rng(8)
    count, sigma = 40, 1.3
    width, length, angle = rng.uniform(1.0, 1.6, count), rng.uniform(1.6, 5.0, count), rng.uniform(0, np.pi, count)
    c, s, a, b = np.cos(angle), np.sin(angle), width**-2.0, length**-2.0
    shape = np.column_stack([a * s * s + b * c * c, (b - a) * s * c, a * c * c + b * s * s])
    peak = rng.uniform(-0.6, 0.6, (count, 2))
    hills = Hills(peak, rng.uniform(0.5, 2.0, count), shape)
    limits = [np.full((2, 1, count), edge) for edge in (-50.0, 50.0)]
    search = _Search(sigma, [hills], limits)
    search._signal_at(np.zeros((2, 1, count)))
    some = search.of(np.arange(count) % 2 == 0)
    search.around()
    np.testing.assert_allclose(search.largest, hills.height, rtol=1e-9)
    np.testing.assert_allclose(search._best_px[:, 0].T, peak, rtol=0, atol=1e-5)
    some.around()
    np.testing.assert_array_equal(some.largest, search.largest[::2])
    # Only the nearest place of the image counts.
    edge = _Search(sigma, [Hills(np.array([[3.0, 0.4]]), np.ones(1), np.array([[1.0, 0, 1]]))], [
        np.array([[[low]], [[-9.0]]]) if low < 0 else np.array([[[low]], [[9.0]]]) for low in (-9.0, 1.0)
    ])  # fmt: skip
    edge._signal_at(np.zeros((2, 1, 1)))
    edge.around()
    assert edge._best_px[0, 0, 0] == 1.0
    assert edge.largest[0] == pytest.approx(np.exp(-2.0), rel=2e-3)


def test_two_hills_add_up_and_the_largest_place_is_kept() -> None:
    one = Hills(np.array([[0.0, 0.0]]), np.array([2.0]), np.array([[1.0, 0, 1]]))
    other = Hills(np.array([[1.0, 0.0]]), np.array([3.0]), np.array([[1.0, 0, 1]]))
    search = _Search(1.0, [one, other], [np.full((2, 1, 1), edge) for edge in (-9.0, 9.0)])
    signal = search._signal_at(np.array([[[0.0], [1.0], [5.0]], [[0.0], [0.0], [0.0]]]))
    near, far = np.exp(-0.5), np.exp(-12.5)
    np.testing.assert_allclose(signal[:, 0], [2 + 3 * near, 3 + 2 * near, 2 * far + 3 * np.exp(-8.0)], rtol=1e-12)
    assert (search.largest[0], search._best_px[:, 0, 0].tolist()) == (signal[1, 0], [1.0, 0.0])
    search._signal_at(np.array([[[3.0]], [[0.0]]]))
    assert search.largest[0] == signal[1, 0]


def recorded_part(sizes: tuple[int, ...]) -> RecordedPart:
    fractions = np.array([0.1, 0.2, 0.05, 0.15, 0.3, 0.2])
    xy = np.arange(6 * 3 * 2.0).reshape(6, 3, 2)

    def samples(stars: np.ndarray):
        first = 0
        for size in sizes:
            yield xy[first : first + size, stars], fractions[first : first + size]
            first += size

    paths = SimpleNamespace(time_fraction=fractions, samples=samples)
    return RecordedPart(paths, np.array([-0.5, 0.12, 0.9]), np.array([0.35, 0.6, 1.7]), 1.25, 2)


@pytest.mark.parametrize("sizes", [(6,), (2, 3, 1), (1, 1, 1, 1, 1, 1)])
def test_samples_are_weighted_by_the_time_in_which_their_row_is_open(sizes: tuple[int, ...]) -> None:
    part, stars = recorded_part(sizes), np.array([2, 0, 1])
    xy, fraction, weight = (np.concatenate(each) for each in zip(*part.samples(stars), strict=True))
    ends = np.array([0.0, 0.1, 0.3, 0.35, 0.5, 0.8, 1.0])
    for column, (opens, closes) in enumerate([(0.9, 1.7), (-0.5, 0.35), (0.12, 0.6)]):
        overlap = [max(0.0, min(b, closes) - max(a, opens)) for a, b in pairwise(ends)]
        np.testing.assert_allclose(weight[:, column], 1.25 * np.array(overlap), rtol=0, atol=1e-12)
    np.testing.assert_allclose(fraction, np.diff(ends) / 2, rtol=1e-12)
    np.testing.assert_array_equal(xy[:, :, 0], np.arange(36.0).reshape(6, 3, 2)[:, stars, 0])
    np.testing.assert_allclose(part.recorded, 1.25 * np.array([0.35, 0.48, 0.1]), rtol=1e-12)
    begins, ends = np.array([0.0, 0.3, 0.2, -0.7]), np.array([0.2, 0.4, 0.3, -0.6])
    between = part.recorded_between(begins, ends, np.array([1, 0, 2, 0]))
    np.testing.assert_allclose(between, 1.25 * np.array([0.08, 0.05, 0.0, 0.0]), rtol=0, atol=1e-12)


def test_sub_exposures_are_lines_of_equal_durations_the_last_at_rest() -> None:
    class Pointing:
        def to_camera(self, directions: np.ndarray) -> np.ndarray:
            return np.stack([directions + np.array([0.1 * k, 0, 0]) for k in range(4)])

    scene, trails = SimpleNamespace(camera=camera()), SimpleNamespace(pointing=Pointing())
    xy_px, duration = _path(scene, trails, np.array([[0.0, 0.1, 1.0]]), None)
    np.testing.assert_allclose(duration, [0.25] * 4, rtol=1e-12)
    np.testing.assert_allclose(xy_px[0, :, 0], 159.5 + 30.0 * np.array([0, 1, 2, 3, 3]), rtol=1e-12)
    np.testing.assert_allclose(xy_px[1, :, 0], 119.5 + 30.0, rtol=1e-12)


@pytest.mark.parametrize(
    ("heights", "times"),
    [
        ([0.0, -1.0, -2.0], [0.0, 0.0]),  # on the horizon it is up, and sets at once
        ([0.0, 1.0, 2.0], [0.0, NEVER]),
        ([2.0, 1.0, 0.0], [0.0, NEVER]),
        ([-2.0, -1.0, 0.0], [1.0, NEVER]),
        ([-1.0, 0.0, 1.0], [0.5, NEVER]),
    ],
)
def test_a_star_on_the_horizon_is_up(heights: list[float], times: list[float]) -> None:
    found = _crossings(np.array(heights)[:, np.newaxis], np.ones(1))
    np.testing.assert_allclose(found[0], times, rtol=0, atol=1e-12)


def faint_scene(peak_dn: np.ndarray, trail_px: np.ndarray, *, mosaic: str = "none", catalogue: str = "bsc5"):
    sensor = SimpleNamespace(
        colour=SimpleNamespace(mosaic=mosaic),
        effective_sigma_px=1.5,
        max_trail_peak_dn=lambda peak, _trail: peak,
    )
    draw_list = DrawList(np.arange(len(peak_dn), dtype=np.int32), np.ones(len(peak_dn)), trail_px)
    stars = SimpleNamespace(catalogue=catalogue)
    trails = AnalyticSegments(None, np.ones(1))
    return SimpleNamespace(
        draw_list=draw_list, sensor=sensor, stars=stars, trails=trails, camera=camera(100, 80), peak_dn=peak_dn
    )


def test_faint_long_trails_are_drawn_on_pixels_of_which_the_error_is_below_the_cut(monkeypatch) -> None:
    """At 1.5 px, errors of 12 % on pixels of 2 px and 55 % on 4 px: 0.02 DN of 0.167 and 0.0364 DN; from 9 px on."""
    monkeypatch.setattr(reduction, "drawn_peak_dn", lambda scene: scene.peak_dn)
    peak = np.array([0.170, 0.163, 0.0370, 0.0357, 0.01, 0.01])
    trail = np.array([50.0, 50, 50, 50, 9.1, 8.9])
    assert reduction._pixel_widths(faint_scene(peak, trail)).tolist() == [1, 2, 2, 2, 2, 1]
    # From 100 stars on also on the widest pixels.
    many = np.tile(peak, 50), np.tile(trail, 50)
    assert reduction._pixel_widths(faint_scene(*many)).tolist() == [1, 2, 2, 4, 4, 1] * 50
    for count, widest in ((99, 2), (100, 4)):
        assert set(reduction._pixel_widths(faint_scene(np.full(count, 0.01), np.full(count, 50.0)))) == {widest}
    for plain in ({"mosaic": "rggb"}, {"catalogue": "bodies"}):
        assert set(reduction._pixel_widths(faint_scene(*many, **plain))) == {1}


def test_wider_pixels_are_used_where_they_save_more_than_they_cost() -> None:
    """An image of 100 x 80 px costs 150,000 px and 0.55 a pixel; a star saves its length on the image and 60 px."""
    cost_px, diagonal_px = 150_000 + 0.55 * 8000, np.hypot(100, 80)
    for length_px, saved_px in ((50.0, 110.0), (500.0, diagonal_px + 60)):
        for part, is_worth in ((0.999, False), (1.001, True)):
            count = round(part * cost_px / saved_px)
            scene = faint_scene(np.zeros(count + 5), np.full(count + 5, length_px))
            widths = np.array([2] * count + [1] * 5, np.int8)
            assert reduction._are_worth_reducing([scene], [widths]) == is_worth
            halves = [faint_scene(np.zeros(len(w)), np.full(len(w), length_px)) for w in np.array_split(widths, 2)]
            assert reduction._are_worth_reducing(halves, np.array_split(widths, 2)) == is_worth
    assert not reduction._are_worth_reducing([], [])


@pytest.mark.parametrize(("bits", "curvature"), [(16, 0.025), (12, 0.025), (9, 0.025), (8, 0.00625)])
def test_second_derivatives_of_the_falloff_are_used_where_they_change_half_a_fragment(monkeypatch, bits, curvature):
    """By 5e-6, at 4 px from its middle or 8 px with 8 bits; the shorter focal length is 200 px."""
    scene = SimpleNamespace(
        camera=SimpleNamespace(fx_px=400.0, fy_px=200.0), sensor=SimpleNamespace(bit_depth=bits, effects={})
    )
    for part, curved in ((0.98, 0), (1.02, 1)):
        fit = SimpleNamespace(curvature=part * curvature, star=(1.0, 2.0, 3.0))
        stand_in = SimpleNamespace(of=lambda _, fit=fit: SimpleNamespace(fit=lambda _: fit))
        monkeypatch.setattr(lensfalloff, "Vignetting", stand_in)
        assert lensfalloff._options({}, scene) == {"FALLOFF_TERMS": 3, "FALLOFF_CURVED": curved}


@pytest.mark.parametrize("count", [1, 3, 4, 5, 8])
def test_coefficients_fill_two_vectors_of_four(count: int) -> None:
    given = tuple(float(k + 1) for k in range(count))
    low, high = lensfalloff._two_vectors(given)
    assert (len(low), len(high)) == (4, 4)
    assert (*low, *high) == given + (0.0,) * (8 - count)
