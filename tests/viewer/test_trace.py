"""Lines of many samples on few pixels: no extremum may be lost."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from glstar.viewer.flight.traces import Trace, _corners

many = settings(deadline=None, max_examples=150)


def unbroken(n: int) -> np.ndarray:
    return np.zeros(max(n - 1, 0), dtype=np.bool_)


def noise(n: int, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    return np.arange(n, dtype=np.float64), np.random.default_rng(seed).normal(size=n)


def segments(y: np.ndarray) -> list[np.ndarray]:
    """Return the continuous parts of a plotted line, which NaN interrupts."""
    return [part[np.isfinite(part)] for part in np.split(y, np.flatnonzero(np.isnan(y)))]


def test_few_samples_are_plotted_as_they_are() -> None:
    x, y = noise(100)
    shown = Trace(x, y, unbroken(100)).thinned(-1.0, 100.0, 200)

    np.testing.assert_array_equal(shown, (x, y))


@many
@given(st.integers(2, 5000), st.integers(10, 500), st.floats(0.0, 0.9), st.floats(0.01, 1.0), st.integers(0, 9))
def test_the_minimum_and_maximum_of_any_part_are_plotted(
    n: int, columns: int, begin: float, share: float, seed: int
) -> None:
    x, y = noise(n, seed)
    start, stop = begin * n, (begin + share) * n
    shown_x, shown_y = Trace(x, y, unbroken(n)).thinned(start, stop, columns)
    inside = y[(x >= start) & (x <= stop)]

    assert np.all(np.diff(shown_x) >= 0)
    assert set(shown_y) <= set(y)
    if inside.size:
        assert shown_y.min() <= inside.min()
        assert shown_y.max() >= inside.max()


@many
@given(st.integers(2, 100_000), st.integers(10, 2000))
def test_a_plot_has_at_most_three_points_per_column(n: int, columns: int) -> None:
    x, y = noise(n)
    shown_x, _ = Trace(x, y, unbroken(n)).thinned(-1.0, float(n), columns)

    assert shown_x.size <= 3 * columns + 10


@many
@given(st.integers(0, 99_999), st.integers(300, 2000))
def test_a_single_spike_among_100000_samples_is_plotted_at_its_time(spike: int, columns: int) -> None:
    x, y = np.arange(100_000.0), np.zeros(100_000)
    y[spike] = 90.0
    shown_x, shown_y = Trace(x, y, unbroken(100_000)).thinned(0.0, 1e5, columns)

    where = shown_x[shown_y.argmax()]
    assert shown_y.max() == 90.0
    # Within two columns.
    assert abs(where - spike) <= 2e5 / columns


@many
@given(st.integers(10, 3000), st.integers(10, 300), st.sets(st.integers(1, 2999), max_size=6))
def test_no_line_is_drawn_across_a_break(n: int, columns: int, breaks: set[int]) -> None:
    # Each segment has its own height: a line across a break would leave it.
    at = np.array(sorted(b for b in breaks if b < n), dtype=np.int64)
    x = np.arange(n, dtype=np.float64)
    y = np.searchsorted(at, x, side="right").astype(np.float64)
    broken = unbroken(n)
    broken[at - 1] = True

    trace = Trace(x, y, broken)
    handfuls = n // 2 ** max(round(np.log2(max(n / columns, 1))), 0)
    _, shown = trace.thinned(-1.0, float(n), columns)
    if len(at) < handfuls:
        assert [part.tolist() for part in segments(shown)] == [
            [height] * part.size for height, part in enumerate(segments(shown))
        ]
        assert len(segments(shown)) == len(at) + 1


def test_a_line_that_breaks_at_every_sample_fills_the_screen() -> None:
    n = 50_000
    x, y = noise(n)
    shown_x, shown = Trace(x, y, ~unbroken(n)).thinned(0.0, float(n), 500)

    assert shown_x.size <= 1500
    assert np.isfinite(shown).all()


@pytest.mark.parametrize("part", [(-20.0, -10.0), (200.0, 300.0)])
def test_a_view_outside_the_samples_has_almost_no_points(part: tuple[float, float]) -> None:
    x, y = noise(100)
    shown_x, _ = Trace(x, y, unbroken(100)).thinned(*part, 500)

    assert shown_x.size <= 3


def test_a_view_between_two_samples_shows_the_line() -> None:
    x, y = noise(100)
    shown_x, _ = Trace(x, y, unbroken(100)).thinned(50.2, 50.8, 500)

    assert shown_x.min() <= 50
    assert shown_x.max() >= 51


@pytest.mark.parametrize("n", [0, 1])
def test_a_trace_may_have_no_sample_or_one(n: int) -> None:
    x, y = noise(n)
    shown_x, shown_y = Trace(x, y, unbroken(n)).thinned(0.0, 1.0, 500)

    assert shown_x.size == shown_y.size == n


# --- points that are left out of a part that rests ---


@many
@given(st.integers(2, 3000), st.floats(0.001, 1.0), st.integers(0, 9))
def test_the_line_passes_within_the_tolerance_of_every_point_left_out(n: int, tolerance: float, seed: int) -> None:
    # A walk, as an attitude is: straight in some parts and rough in others.
    x, step = noise(n, seed)
    y = np.cumsum(step * (np.sin(x / 100) > 0.5)) * 0.1
    trace = Trace(x, y, unbroken(n))
    trace.thinned(-1.0, float(n), n, tolerance)
    shown_x, shown_y = trace.thinned(-1.0, float(n), n, tolerance)

    np.testing.assert_allclose(np.interp(x, shown_x, shown_y), y, rtol=0, atol=tolerance * (1 + 1e-9) + 1e-12)
    # The axis, which fits the line, does not move.
    assert (shown_y.min(), shown_y.max()) == (y.min(), y.max())


def test_a_straight_line_keeps_its_ends_and_its_breaks() -> None:
    x = np.arange(1000.0)
    broken = unbroken(1000)
    broken[399] = True
    trace = Trace(x, np.where(x < 400, 2 * x, 2 * x - 2000), broken)
    moving = trace.thinned(-1.0, 1000.0, 1000, 0.1)
    at_rest = trace.thinned(-1.0, 1000.0, 1000, 0.1)

    assert moving[0].size == 1001
    assert [part.tolist() for part in segments(at_rest[1])] == [[0.0, 798.0], [-1200.0, -2.0]]
    assert at_rest[0][np.isfinite(at_rest[1])].tolist() == [0.0, 399.0, 400.0, 999.0]


def test_a_spike_between_samples_of_the_same_time_is_kept() -> None:
    x = np.repeat(np.arange(50.0), 2)
    y = np.zeros(100)
    y[41] = 30.0
    y[71] = -7.0
    trace = Trace(x, y, unbroken(100))
    trace.thinned(-1.0, 50.0, 200, 0.5)

    shown_x, shown_y = trace.thinned(-1.0, 50.0, 200, 0.5)
    assert shown_y.max() == 30.0
    assert -7.0 in shown_y
    assert shown_x[shown_y == -7.0].tolist() == [35.0]


@pytest.mark.parametrize(
    ("height", "kept"),
    [
        # A change of slope below the highest point, and one at it.
        ([0, 1, 2, 3, 3.5, 4, 4.5, 5], [0, 3, 7]),
        ([0, 1, 2, 3, 4, 3, 2, 1, 0.5], [0, 4, 7, 8]),
        ([3, 2, 1, 0, 1, 2, 4, 6, 8], [0, 3, 5, 8]),
    ],
)
def test_straight_parts_keep_their_ends_alone(height: list[float], kept: list[int]) -> None:
    assert _corners(np.arange(len(height), dtype=float), np.array(height, dtype=float), 1e-9) == kept


def test_both_sides_of_a_break_are_kept() -> None:
    height = np.array([0.0, 1, 2, np.nan, 5, 6, 7, 8])
    assert _corners(np.arange(8.0), height, 1e-9) == [0, 2, 3, 4, 7]
    assert _corners(np.arange(3.0), np.full(3, np.nan), 1e-9) == [0, 1, 2]
