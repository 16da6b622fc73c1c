"""Where paths leave most light and what they share with themselves, against images of them on fine pixels."""

import numpy as np
import pytest
from scipy.special import erf

from glstar.render.truth import brightest
from glstar.render.truth.brightest import FAR_PX, _Lines, _smoothed, brightest_points
from glstar.render.truth.linechains import LineChain
from tests.support.scenes import camera

LENS = camera(60, 40, 300.0)
SIGMA = 1.4
# Side of the pixels on which images are computed, px.
CELL_PX = 0.2


def chain_of(path_px: np.ndarray) -> LineChain:
    """Return the chain through positions of one star, (n + 1, 2) px, of equal durations."""
    count = len(path_px) - 1
    return LineChain.of(path_px.T[:, :, np.newaxis].copy(), np.full(count, 1 / count), None)


def image_of(path_px: np.ndarray, sigma: float, passing: np.ndarray | float = 1.0) -> np.ndarray:
    """Return the light of a path on the image over its flux, 1/px^2, from many positions along it."""
    count = len(path_px) - 1
    parts = max(8, 2000 // count)
    along = (np.arange(parts) + 0.5) / parts
    at = (path_px[:-1, np.newaxis] + along[:, np.newaxis] * np.diff(path_px, axis=0)[:, np.newaxis]).reshape(-1, 2)
    weight = np.repeat(np.broadcast_to(passing, count), parts) / (count * parts)
    across, down = (
        np.exp(-((np.arange(-0.5 + CELL_PX / 2, side - 0.5, CELL_PX) - at[:, [axis]]) ** 2) / (2 * sigma**2))
        for axis, side in ((0, 60), (1, 40))
    )
    return (down * weight[:, np.newaxis]).T @ across / (2 * np.pi * sigma**2)


def share_of(path_px: np.ndarray) -> float:
    along = (np.arange(4000) + 0.5) / 4000 * (len(path_px) - 1)
    at = np.column_stack([np.interp(along, np.arange(len(path_px)), path_px[:, axis]) for axis in (0, 1)])
    return float(LENS.contains(at).mean())


def line(start: tuple[float, float], end: tuple[float, float], count: int = 16) -> np.ndarray:
    return np.array(start) + np.linspace(0, 1, count + 1)[:, np.newaxis] * (np.array(end) - start)


def loop(count: int = 48) -> np.ndarray:
    angle = np.linspace(0, 2 * np.pi, count + 1)
    return np.column_stack([30 + 12 * np.sin(angle), 20 + 9 * np.sin(2 * angle)])


def shaken(count: int, amplitude: float, at: tuple[float, float], turn: float = 0.0) -> np.ndarray:
    t = np.linspace(0, 1, count + 1)
    wave = np.column_stack([np.sin(2 * np.pi * 7.3 * t), np.cos(2 * np.pi * 11.1 * t + 1)])
    return np.array(at) + amplitude * wave + turn * t[:, np.newaxis] * [1.0, 0.4]


PATHS = {
    "rest": line((20.3, 15.1), (20.3, 15.1)),
    "line": line((10.0, 8.0), (43.0, 30.0)),
    "long-lines": line((5.0, 6.0), (55.0, 36.0), 4),
    "loop": loop(),
    "shaken": shaken(400, 2.0, (30.0, 20.0)),
    "shaken-turning": shaken(900, 1.0, (20.0, 12.0), 25.0),
}


@pytest.mark.parametrize("name", sorted(PATHS))
@pytest.mark.parametrize("is_clouded", [False, True])
def test_the_integral_of_the_square_and_the_promised_signal_are_those_of_an_image(name: str, is_clouded: bool) -> None:
    path = PATHS[name]
    count = len(path) - 1
    passing = np.linspace(1.0, 0.4, count) if is_clouded else np.ones(count)
    found = brightest_points(LENS, SIGMA, [chain_of(path)], [passing[:, np.newaxis] if is_clouded else None])
    image = image_of(path, SIGMA, passing)
    square = (image**2).sum() * CELL_PX**2
    assert found.square_per_px2[0] == pytest.approx(square, rel=0.015)
    assert found.promised_per_px2[0, 0] == pytest.approx(image.max(), rel=0.06)
    x_px, y_px = found.point_px[0, 0]
    at = image[int((y_px + 0.5) / CELL_PX), int((x_px + 0.5) / CELL_PX)]
    assert at > 0.85 * image.max()


@pytest.mark.parametrize("path", [
    line((-6.0, 20.0), (9.0, 22.0)), line((54.0, 12.0), (66.0, 9.0)), line((30.0, -8.0), (33.0, 7.0)),
    line((-4.0, 31.0), (10.0, 47.0)), line((0.4, 5.0), (0.6, 30.0)), line((59.2, 30.0), (59.0, 12.0)),
    line((20.0, 39.4), (20.0, 39.4)), line((0.8, 11.0), (0.8, 11.0)),
    shaken(300, 1.5, (0.3, 20.0)), shaken(300, 2.5, (30.0, 38.8)), line((-1.2, 5.0), (0.2, 30.0)),
])  # fmt: skip
def test_of_a_path_across_the_border_the_light_on_the_image_counts(path: np.ndarray) -> None:
    found = brightest_points(LENS, SIGMA, [chain_of(path)], [None])
    share = share_of(path)
    square = (image_of(path, SIGMA) ** 2).sum() * CELL_PX**2
    assert found.square_per_px2[0] * share == pytest.approx(square, rel=0.015)
    assert 0.02 < share <= 1


def test_a_path_beside_the_image_promises_what_arrives_at_its_border() -> None:
    beside = [line((62.0, 20.0), (62.0, 20.0)), line((80.0, 20.0), (80.0, 20.0)), line((30.0, 20.0), (30.0, 20.0))]
    xy = np.stack(beside, axis=-1).transpose(1, 0, 2)
    chain = LineChain.of(xy, np.full(16, 1 / 16), None)
    found = brightest_points(LENS, SIGMA, [chain], [None])
    peak = 1 / (2 * np.pi * SIGMA**2)
    arrives = np.exp(-(2.5**2) / (2 * SIGMA**2))
    assert found.promised_per_px2[0, 0] == pytest.approx(peak * arrives, rel=1e-4)
    # Farther than five sigma it is negative, by the distance.
    assert found.promised_per_px2[0, 1] == pytest.approx(-20.5 / SIGMA, rel=1e-6)
    assert found.promised_per_px2[0, 2] == pytest.approx(peak, rel=1e-4)
    assert found.square_per_px2[:2].tolist() == [0.0, 0.0]


def test_several_chains_are_lines_one_after_the_other() -> None:
    path, other = line((10.0, 8.0), (30.0, 20.0)), line((30.0, 20.0), (43.0, 33.0))
    halves = [LineChain.of(one.T[:, :, np.newaxis].copy(), np.full(16, 1 / 32), None) for one in (path, other)]
    passing = [np.full((16, 1), 0.9), np.full((16, 1), 0.3)]
    found = brightest_points(LENS, SIGMA, halves, passing)
    image = (0.9 * image_of(path, SIGMA) + 0.3 * image_of(other, SIGMA)) / 2
    assert found.square_per_px2[0] == pytest.approx((image**2).sum() * CELL_PX**2, rel=0.02)
    assert found.promised_per_px2[0, 0] == pytest.approx(image.max(), rel=0.05)


def straight(count: int, length_px: float, stars: int = 2) -> LineChain:
    steps = np.arange(count + 1) * length_px
    xy = np.stack([5 + steps[:, np.newaxis] * [0.8, 0.6], 5 + steps[:, np.newaxis] * [0.6, 0.8]])
    return LineChain.of(xy[..., :stars], np.full(count, 1 / count), None)


@pytest.mark.parametrize(("count", "length_px", "parts"), [
    (16, 1.2, 1), (16, 5.59, 1), (16, 5.61, 2), (16, 11.3, 3), (16, 1e3, 18), (40, 1e3, 7), (400, 6.0, 1),
])  # fmt: skip
def test_long_lines_are_divided_into_parts_of_four_sigma(count: int, length_px: float, parts: int) -> None:
    wide = camera(int(30 * count * length_px), int(30 * count * length_px), 300.0)
    chain = straight(count, length_px)
    found = _Lines.of([chain], SIGMA, wide)
    assert found.parts == parts
    assert found.first is None
    assert found.spread_px2 is None
    np.testing.assert_allclose(found.step_px, np.repeat(chain.step_px, parts, axis=1) / parts, rtol=1e-12)
    np.testing.assert_allclose(found.weight, np.full((count * parts, 2), 1 / (count * parts)), rtol=1e-12)
    along = (np.arange(count * parts) + 0.5)[:, np.newaxis] * length_px / parts
    np.testing.assert_allclose(found.middle_px[0], 5 + along * [0.8, 0.6], rtol=1e-9)
    values = np.arange(count * 2.0).reshape(count, 2)
    np.testing.assert_array_equal(found.means(values), np.repeat(values, parts, axis=0))


@pytest.mark.parametrize(("count", "length_px", "short_sigma", "group"), [
    (64, 0.5, 1.5, 4), (64, 0.53, 1.5, 3), (64, 0.1, 1.5, 8), (80, 0.1, 1.5, 10), (64, 0.5, 0.1, 1),
    (1201, 3.0, 1.5, 3), (1200, 3.0, 1.5, 2), (601, 3.0, 1.5, 2), (600, 3.0, 1.5, 1), (64, 0.06, 0.1, 2),
])  # fmt: skip
def test_short_lines_are_groups_of_a_length(count: int, length_px: float, short_sigma: float, group: int) -> None:
    wide = camera(int(30 * count * length_px) + 60, int(30 * count * length_px) + 60, 300.0)
    chain = straight(count, length_px)
    chains = [chain] if short_sigma == 1.5 else [chain[np.array([0, 1])]]
    found = _Lines.of(chains, SIGMA, wide, short_sigma)
    if group == 1:
        assert found.first is None
        return
    assert found.first.tolist() == list(range(0, count, group))
    if short_sigma == 1.5:
        np.testing.assert_array_equal(_Lines.of(chains, SIGMA, wide).first, found.first)


def test_groups_have_the_mean_and_the_variance_of_the_light_of_their_lines() -> None:
    rng = np.random.default_rng(5)
    xy = [30 + np.cumsum(rng.normal(size=(2, 45, 3)) * 0.25, axis=1) for _ in range(2)]
    recorded = [rng.uniform(0.1, 1.0, (44, 3)) for _ in range(2)]
    recorded[0][3:7, 1] = 0.0
    chains = [LineChain.of(one, np.full(44, 1 / 88), of) for one, of in zip(xy, recorded, strict=True)]
    found = _Lines.of(chains, SIGMA, LENS)
    size = int(found.first[1])
    assert 1 < size < 12
    # No group has lines of two chains.
    assert found.first.tolist() == [*range(0, 44, size), *range(44, 88, size)]
    ends = [*found.first[1:], 88]
    along = (np.arange(200) + 0.5) / 200
    for k, (first, last) in enumerate(zip(found.first, ends, strict=True)):
        of, own = (xy[0], recorded[0]) if first < 44 else (xy[1], recorded[1])
        begin, end = first % 44, (last - 1) % 44 + 1
        for star in range(3):
            start, stop = of[:, begin:end, star], of[:, begin + 1 : end + 1, star]
            at = start[:, :, np.newaxis] + along * (stop - start)[:, :, np.newaxis]
            light = np.repeat(np.maximum(own[begin:end, star], 1e-12)[:, np.newaxis], 200, axis=1)
            mean = (at * light).sum(axis=(1, 2)) / light.sum()
            off = at - mean[:, np.newaxis, np.newaxis]
            spread = [(off[i] * off[j] * light).sum() / light.sum() for i, j in ((0, 0), (0, 1), (1, 1))]
            np.testing.assert_allclose(found.middle_px[:, k, star], mean, rtol=0, atol=1e-4)
            np.testing.assert_allclose(found.spread_px2[:, k, star], spread, rtol=1e-3, atol=1e-4)
            np.testing.assert_allclose(found.step_px[:, k, star], stop[:, -1] - start[:, 0], rtol=0, atol=1e-9)
            assert found.weight[k, star] == pytest.approx(own[begin:end, star].sum(), rel=1e-9, abs=1e-15)
    values = rng.normal(size=(88, 3))
    means = [values[first:last].mean(axis=0) for first, last in zip(found.first, ends, strict=True)]
    np.testing.assert_allclose(found.means(values), means, rtol=1e-9)


def test_lines_far_outside_are_clipped_and_lines_on_the_image_decide() -> None:
    xy = np.array([[[5.0], [7.0], [9.0], [2e8]], [[5.0], [5.0], [5.0], [-3e8]]])
    found = _Lines.of([LineChain.of(xy, np.full(3, 1 / 3), None)], SIGMA, LENS)
    assert found.parts == 1
    assert (found.middle_px[:, 2, 0].tolist(), found.step_px[:, 2, 0].tolist()) == ([FAR_PX, -FAR_PX],) * 2
    # Without a line on the image, lines are as long as 1 px: one of sigma 0.2 px has parts of 0.8 px.
    beside = _Lines.of([LineChain.of(xy + 1e3, np.full(3, 1 / 3), None)], 0.2, LENS)
    assert beside.parts == 2


def test_light_from_neighbours_is_that_of_the_star_that_is_longest_on_the_image() -> None:
    rng = np.random.default_rng(6)
    lines = _Lines(rng.uniform(0, 6, (2, 9, 3)), np.zeros((2, 9, 3)), rng.uniform(0.1, 1, (9, 3)))
    passing, on_image = rng.uniform(0, 1, (9, 3)), np.ones((9, 3))
    on_image[:2, 0], on_image[:4, 2] = 0.0, 0.0
    found = _smoothed(lines, passing, SIGMA, on_image)
    x, y = lines.middle_px[..., 1]
    near = np.exp(-(np.subtract.outer(x, x) ** 2 + np.subtract.outer(y, y) ** 2) / (4 * SIGMA**2)) * lines.weight[:, 1]
    np.testing.assert_allclose(found, near @ passing / near.sum(axis=1, keepdims=True), rtol=1e-9)
    empty = np.zeros((9, 0))
    assert _smoothed(lines, empty, SIGMA, empty) is empty


@pytest.mark.parametrize("has_groups", [False, True])
def test_signals_at_the_middles_of_lines_are_exact_of_the_own_line_and_gaussian_of_others(has_groups: bool) -> None:
    rng = np.random.default_rng(2)
    spread_px2 = np.stack([np.full((5, 2), each) for each in (0.8, 0.3, 0.5)]) if has_groups else None
    lines = _Lines(
        rng.uniform(0, 9, (2, 5, 2)), rng.uniform(-4, 4, (2, 5, 2)), rng.uniform(0.1, 0.3, (5, 2)), spread_px2
    )
    lines.step_px[:, 0] = 0.0
    narrow, wide = brightest._signals_and_overlaps(
        lines, brightest._as_gaussians(lines, SIGMA), SIGMA, np.ones((5, 2), np.bool_)
    )
    for star in range(2):
        for at in range(5):
            expected = [0.0, 0.0]
            for of in range(5):
                step = lines.step_px[:, of, star]
                off = lines.middle_px[:, at, star] - lines.middle_px[:, of, star]
                if has_groups:
                    covariance = 2 * SIGMA**2 * np.eye(2) + 2 * np.array([[0.8, 0.3], [0.3, 0.5]])
                else:
                    covariance = 2 * SIGMA**2 * np.eye(2) + np.outer(step, step) / 12
                light = np.exp(-off @ np.linalg.inv(covariance) @ off / 2)
                area = np.sqrt(np.linalg.det(covariance))
                own = at == of and not has_groups
                for k, sigma in enumerate((SIGMA, np.sqrt(2) * SIGMA)):
                    length = max(np.hypot(*step), 1e-3 * np.sqrt(2) * SIGMA)
                    exact = erf(length / (2 * np.sqrt(2) * sigma)) / (length * np.sqrt(2 * np.pi) * sigma)
                    # The signal of the narrow star is the square of the wide one's.
                    gaussian = light / (2 * np.pi * area) if k else light**2 / (np.pi * area)
                    expected[k] += lines.weight[of, star] * (exact if own else gaussian)
            assert narrow[at, star] == pytest.approx(expected[0], rel=2e-4)
            assert wide[at, star] == pytest.approx(expected[1], rel=2e-4)


def test_hidden_parts_of_a_path_promise_nothing() -> None:
    path = line((10.0, 8.0), (43.0, 30.0))
    xy = path.T[:, :, np.newaxis].copy()
    xy[:, 11:] = np.nan
    found = brightest_points(LENS, SIGMA, [LineChain.of(xy, np.full(16, 1 / 16), None)], [None])
    image = image_of(path[:11], SIGMA) * 10 / 16
    assert found.promised_per_px2[0, 0] == pytest.approx(image.max(), rel=0.05)
    assert found.square_per_px2[0] * 10 / 16 == pytest.approx((image**2).sum() * CELL_PX**2, rel=0.02)
