"""Which parts of paths are on the image, and which stars cross saturated pixels, by brute force."""

import json
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.integrate import quad
from scipy.stats import norm

from glstar.render.truth.brightest import _candidates, _grouped, _Lines, _parts_on_image
from glstar.render.truth.frame import rows_of
from glstar.render.truth.linechains import normal_from_middle
from glstar.render.truth.statistics import _Inside, _parts_inside, _parts_within, _SaturationMap
from tests.support.scenes import camera

LENS = camera(100, 80, 300.0)


@pytest.mark.parametrize("side", [31, 32, 33, 64, 97])
def test_stars_near_saturated_pixels_are_those_whose_bounds_hold_a_cell_with_one(side: int) -> None:
    rng = np.random.default_rng(side)
    pixels = np.zeros((side, side + 20), np.uint16)
    at = rng.integers(0, [[side], [side + 20]], (2, 3))
    pixels[tuple(at)] = [200, 201, 199]
    low = rng.uniform(-30, side + 30, (300, 2))
    bounds = np.stack([low, low + rng.uniform(0, 25, (300, 2))])
    bounds[1, 0], bounds[0, 1] = np.nan, np.nan  # a path that is hidden for some time
    near = set(_SaturationMap(pixels, 200).near(bounds).tolist())
    last = np.array([side + 19, side - 1])
    for star, (first, end) in enumerate(np.moveaxis(bounds, 1, 0)):
        left, top = np.clip(np.nan_to_num(np.rint(first), nan=0.0), 0, last).astype(int) // 32
        right, bottom = np.clip(np.where(np.isnan(end), last, np.rint(end)), 0, last).astype(int) // 32
        cells = pixels[32 * top : 32 * bottom + 32, 32 * left : 32 * right + 32]
        assert (star in near) == (cells >= 200).any()
    flags = pixels >= 200
    assert set(_SaturationMap(flags, 65535).near(bounds).tolist()) == near


def test_a_star_crosses_the_pixel_that_its_centre_is_nearest_to() -> None:
    pixels = np.zeros((80, 100), np.uint8)
    pixels[20, 70], pixels[0, 0] = 255, 255
    xy = np.array([[[69.6, 20.4], [69.4, 20.0], [70.4, 19.6], [70.0, 20.6], [70.0, 20.0], [20.0, 70.0]]])
    on_image = np.array([[True, True, True, True, False, True]])
    crossed = _SaturationMap(pixels, 255).crossed_by(xy, on_image)
    assert crossed.tolist() == [True, False, True, False, False, False]
    # Once is enough.
    twice = np.concatenate([np.full_like(xy, 50.0), xy])
    assert _SaturationMap(pixels, 255).crossed_by(twice, np.repeat(on_image, 2, axis=0)).tolist() == crossed.tolist()
    assert not _SaturationMap(np.minimum(pixels, 254), 255).crossed_by(xy, on_image).any()


@pytest.mark.parametrize(
    ("bounds", "touches", "on_image", "is_known"),
    [
        ((2.0, 3.0, 90.0, 70.0), True, True, True),
        ((-0.4, -0.4, 99.4, 79.4), True, True, True),
        ((-0.6, 10.0, 50.0, 20.0), False, False, False),  # its centre leaves the image
        ((50.0, 10.0, 99.6, 20.0), False, False, False),
        ((50.0, -0.6, 60.0, 20.0), False, False, False),
        ((50.0, 60.0, 60.0, 79.6), False, False, False),
        ((-5.4, 10.0, -0.6, 20.0), True, False, True),  # beside the image, within the 5 px of its light
        ((-5.6, 10.0, -0.6, 20.0), False, False, False),
        ((-9.0, 10.0, -5.6, 20.0), False, False, True),
        ((-9.0, 10.0, -5.4, 20.0), False, False, False),
        ((104.6, 10.0, 120.0, 20.0), False, False, True),
        ((104.4, 10.0, 120.0, 20.0), False, False, False),
        ((10.0, 84.6, 20.0, 99.0), False, False, True),
        ((10.0, 84.4, 20.0, 99.0), False, False, False),
        ((10.0, -9.0, 20.0, -5.6), False, False, True),
        ((10.0, -9.0, 20.0, -5.4), False, False, False),
        ((np.nan, 10.0, 20.0, 30.0), False, False, False),
    ],
)
def test_bounds_say_whether_a_path_is_on_the_image_all_the_time(bounds, touches, on_image, is_known) -> None:
    left, top, right, bottom = bounds
    scene = SimpleNamespace(camera=LENS, listed=SimpleNamespace(truncation_radius_px=np.array([5.0])))
    inside = _Inside.of(scene, np.array([[left], [top]]), np.array([[right], [bottom]]))
    assert [one.tolist() for one in inside] == [[touches], [on_image], [is_known]]


def test_a_sample_is_the_path_from_halfway_before_to_halfway_after_it() -> None:
    outside, step = np.array([-3.0, -1.0, 0.0, 1.0, 1.9, 2.1, 6.0, 8.1]), np.full(8, 4.0)
    within, on_image = _parts_within(outside, step, np.full(8, 6.0))
    # A path from 2 px before to 2 px beyond each: the parts below 6 px and below 0 px.
    np.testing.assert_allclose(on_image, np.clip((2 - outside) / 4, 0, 1), rtol=0, atol=1e-12)
    np.testing.assert_allclose(within, np.clip((8 - outside) / 4, 0, 1), rtol=0, atol=1e-12)
    np.testing.assert_array_equal(_parts_within(outside, -step, np.full(8, 6.0)), [within, on_image])
    # Without a neighbour, all or nothing; nothing of what is not visible.
    beside = np.array([-0.1, 0.1, np.nan])
    within, on_image = _parts_within(beside, np.full(3, np.nan), np.full(3, 1.0))
    assert (within.tolist(), on_image.tolist()) == ([1, 1, 0], [1, 0, 0])


def test_the_parts_of_a_path_through_the_border_add_up_to_its_time_on_the_image() -> None:
    time = np.linspace(0, 1, 41)
    outside = np.column_stack([-7 + 30 * time, 12 - 15 * time])
    within, on_image = _parts_inside(outside, np.array([4.0, 5.0]))
    # Of a star that moves, parts of samples count.
    assert ((on_image > 0) & (on_image < 1)).any()
    np.testing.assert_array_equal(_parts_inside(outside, np.array([4.0, 5.0]), is_at_rest=False), [within, on_image])
    cell = np.gradient(time)
    np.testing.assert_allclose(cell @ on_image / cell.sum(), [7 / 30, 3 / 15], rtol=0, atol=0.5 / 41)
    np.testing.assert_allclose(cell @ within / cell.sum(), [11 / 30, 8 / 15], rtol=0, atol=0.5 / 41)
    for at_rest, count in ((True, 41), (False, 1)):
        found = _parts_inside(outside[:count], np.array([4.0, 5.0]), is_at_rest=at_rest)
        assert [one.dtype for one in found] == [bool, bool]
        np.testing.assert_array_equal(found[0], outside[:count] < [4.0, 5.0])
        np.testing.assert_array_equal(found[1], outside[:count] < 0)


def lines(middle_px, step_px) -> _Lines:
    middle, step = (np.array(each, dtype=np.float64).T[:, np.newaxis] for each in (middle_px, step_px))
    return _Lines(middle, step, np.full(middle.shape[1:], 1 / middle.shape[2]))


@pytest.mark.parametrize("sigma_px", [0.6, 1.5])
@pytest.mark.parametrize("middle_x", [-6.0, -2.6, -0.5, 0.7, 3.9, 40.0])
@pytest.mark.parametrize("step_x", [-6.0, 0.5, 9.0])
def test_the_light_of_a_line_across_the_border_is_the_integral_along_it(sigma_px, middle_x, step_x) -> None:
    one = lines([(middle_x, 40.0)], [(step_x, 1.0)])
    outside = LENS.distance_outside_px(np.array([[(middle_x, 40.0)]]))
    on_image, lit = _parts_on_image(one, LENS, outside, sigma_px)

    def light(along: float) -> float:
        return float(norm.cdf((middle_x + along * step_x + 0.5) / sigma_px))

    assert lit[0, 0] == pytest.approx(quad(light, -0.5, 0.5)[0], rel=0, abs=2e-3)
    inside = np.mean(middle_x + (np.arange(2000) / 2000 - 0.5) * step_x > -0.5)
    assert on_image[0, 0] == pytest.approx(inside, rel=0, abs=0.02)


def test_the_brightest_lines_of_a_star_are_separate_and_promising() -> None:
    middle = [(10.0, 10.0), (11.0, 10.0), (20.0, 10.0), (30.0, 10.0), (40.0, 10.0), (50.0, 10.0), (60.0, 10.0)]
    path = lines(middle, [(1.0, 0.0)] * 7)
    path = path._replace(middle_px=np.array(middle).T[:, :, np.newaxis], step_px=np.ones((2, 7, 1)))
    signals = np.array([1.0, 0.99, 0.86, 0.9, 0.84, 0.5, 0.88])[:, np.newaxis]
    middles, steps, promised = _candidates(path, signals.copy(), 2.0)
    assert middles[:, 0, 0].tolist() == [10.0, 30.0, 60.0, 20.0]
    assert promised[:, 0].tolist() == [1.0, 0.9, 0.88, 0.86]
    assert steps.shape == (4, 1, 2)
    # 11 px is near the first; 20 px and the others promise less than 85 %.
    middles, _, _ = _candidates(path, signals * np.array([1, 1, 0.9, 0.9, 1, 1, 0.9])[:, np.newaxis], 2.0)
    assert middles[:, 0, 0].tolist() == [10.0]
    middles, _, _ = _candidates(path, signals.copy(), 0.9)
    assert middles[:2, 0, 0].tolist() == [10.0, 11.0]


def test_groups_of_lines_have_the_sums_and_means_of_their_members() -> None:
    values = np.random.default_rng(3).random((2, 7, 3))
    first = np.array([0, 3, 4])
    sums, means = _grouped(values, first), _grouped(values, first, mean=True)
    for k, members in enumerate((slice(0, 3), slice(3, 4), slice(4, 7))):
        np.testing.assert_allclose(sums[:, k], values[:, members].sum(axis=1), rtol=1e-12)
        np.testing.assert_allclose(means[:, k], values[:, members].mean(axis=1), rtol=1e-12)


@pytest.mark.parametrize("count", [0, 1, 3])
def test_a_table_is_written_as_json_with_null_for_nan(count: int) -> None:
    rng = np.random.default_rng(4)
    number, pair, nodes = rng.random(count), rng.random((count, 2)), rng.random((count, 2, 2, 2))
    number[1:2], pair[-1:], nodes[:1, 0, 1] = np.nan, np.nan, np.nan
    columns = {"star_id": np.arange(count), "x": number, "at": pair, "nodes": nodes, "saturated": number > 0.5}

    def plain(value):
        if isinstance(value, list):
            parts = [plain(each) for each in value]
            return None if parts == [None, None] else parts
        return None if value != value else value

    expected = [{key: plain(values[k].tolist()) for key, values in columns.items()} for k in range(count)]
    assert json.loads(rows_of(columns)) == expected


def test_the_normal_integral_from_the_middle_is_that_of_the_tables() -> None:
    z = np.linspace(-7, 7, 1401, dtype=np.float32)
    np.testing.assert_allclose(normal_from_middle(z), norm.cdf(z.astype(np.float64)) - 0.5, rtol=0, atol=3e-7)
