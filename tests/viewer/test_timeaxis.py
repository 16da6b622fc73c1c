"""The time axis: zoom and pan stay inside the flight, ticks are round."""

from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from glstar.sky.place.timescale import parse_utc
from glstar.viewer.flight.traces import TimeAxis

many = settings(deadline=None, max_examples=200)
lengths_s = st.floats(0.005, 100_000.0)
NIGHT_UTC_S = parse_utc("2024-03-10T10:59:47.25Z")


def showing(start_s: float, stop_s: float) -> TimeAxis:
    axis = TimeAxis(600.0)
    axis.start_s, axis.stop_s = start_s, stop_s
    return axis


def test_the_complete_flight_is_shown_at_first() -> None:
    axis = TimeAxis(600.0)

    assert (axis.start_s, axis.stop_s) == (-3.0, 603.0)


@many
@given(st.floats(0.0, 600.0), st.floats(0.1, 1.0))
def test_zooming_keeps_the_time_under_the_mouse(at_s: float, factor: float) -> None:
    axis = TimeAxis(600.0)
    for _ in range(4):
        share = (at_s - axis.start_s) / axis.span_s
        axis.zoom(at_s, factor)
        assert (at_s - axis.start_s) / axis.span_s == pytest.approx(share, abs=1e-6)


@many
@given(
    lengths_s,
    st.lists(st.tuples(st.sampled_from(["zoom", "pan", "follow"]), st.floats(-1.0, 2.0), st.floats(0.01, 100.0))),
)
def test_zoom_and_pan_stay_inside_the_flight(length_s: float, deeds: list[tuple[str, float, float]]) -> None:
    axis = TimeAxis(length_s)
    whole = TimeAxis(length_s)
    for deed, share, factor in deeds:
        at_s = share * length_s
        axis.zoom(at_s, factor) if deed == "zoom" else getattr(axis, deed)(at_s)
        assert whole.start_s <= axis.start_s < axis.stop_s <= whole.stop_s
        assert axis.span_s >= min(0.00999, 0.999 * whole.span_s)


@many
@given(lengths_s, st.floats(0.0, 1.0), st.floats(0.0, 1.0), st.floats(0.01, 1.0))
def test_a_followed_play_head_is_in_view(length_s: float, from_share: float, to_share: float, factor: float) -> None:
    axis = TimeAxis(length_s)
    axis.zoom(from_share * length_s, factor)
    before = axis.span_s
    axis.follow(to_share * length_s)

    assert axis.start_s <= to_share * length_s <= axis.stop_s
    assert axis.span_s == pytest.approx(before, rel=1e-6)


def test_a_play_head_that_moves_inside_the_view_does_not_move_the_view() -> None:
    axis = showing(100.0, 200.0)
    axis.follow(150.0)
    assert axis.start_s == pytest.approx(100.0)

    # At nine tenths of the width the axis begins to scroll.
    axis.follow(191.0)
    assert axis.start_s == pytest.approx(101.0)
    axis.follow(500.0)
    assert axis.start_s == pytest.approx(450.0)


@pytest.mark.parametrize(
    ("span", "of_day", "labels"),
    [
        ((0.0, 600.0), False, ["0", "100", "200", "300", "400", "500", "600"]),
        ((100.0, 101.0), False, ["100.0", "100.2", "100.4", "100.6", "100.8", "101.0"]),
        ((100.0, 100.02), False, ["100.000", "100.005", "100.010", "100.015", "100.020"]),
        ((0.0, 600.0), True, ["11:00", "11:02", "11:04", "11:06", "11:08"]),
        ((12.0, 43.0), True, ["11:00:00", "11:00:05", "11:00:10", "11:00:15", "11:00:20", "11:00:25", "11:00:30"]),
        ((12.7, 13.8), True, ["11:00:00.0", "11:00:00.2", "11:00:00.4", "11:00:00.6", "11:00:00.8", "11:00:01.0"]),
    ],
)
def test_ticks_are_at_round_times(span: tuple[float, float], of_day: bool, labels: list[str]) -> None:
    axis = showing(*span)
    seconds, ticks = axis.ticks(600.0, first_utc_s=NIGHT_UTC_S if of_day else None)

    assert ticks == labels
    if of_day:
        midnight_s = NIGHT_UTC_S % 86400
        np.testing.assert_allclose(
            midnight_s + np.array(seconds), [parse_day_s(label) for label in ticks], rtol=0, atol=1e-6
        )
    else:
        np.testing.assert_allclose(seconds, [float(label) for label in ticks], rtol=0, atol=1e-9)


def parse_day_s(label: str) -> float:
    parts = [float(part) for part in label.split(":")]
    return sum(part * unit for part, unit in zip(parts, (3600, 60, 1), strict=False))


def test_times_of_day_restart_at_midnight() -> None:
    _, labels = TimeAxis(7200.0).ticks(400.0, first_utc_s=parse_utc("2024-03-10T23:10:00Z"))

    assert labels == ["23:30", "00:00", "00:30", "01:00"]


@many
@given(lengths_s, st.floats(1e-4, 1.0), st.floats(100.0, 4000.0), st.booleans())
def test_labels_do_not_overlap_and_are_different(length_s: float, factor: float, width_px: float, of_day: bool) -> None:
    axis = TimeAxis(length_s)
    axis.zoom(length_s / 3, factor)
    seconds, labels = axis.ticks(width_px, first_utc_s=NIGHT_UTC_S if of_day else None)

    assert len(set(labels)) == len(labels) or axis.span_s > 86400
    assert all(axis.start_s - 1e-6 <= second <= axis.stop_s + 1e-6 for second in seconds)
    for one, next_one in pairwise(seconds):
        assert (next_one - one) * width_px / axis.span_s >= 89


def test_a_growing_flight_is_shown_completely_at_first_and_then_its_last_minute() -> None:
    axis = TimeAxis(0.5, max_span_s=60.0)
    for second in np.arange(1.0, 200.0, 0.7):
        axis.grow(0.0, float(second))
        axis.follow(float(second))
        assert axis.stop_s > second
        assert axis.span_s == pytest.approx(min(1.01 * second, 60.0), abs=0.5)


def test_an_earlier_part_of_a_growing_flight_stays_in_view() -> None:
    axis = TimeAxis(100.0, max_span_s=60.0)
    axis.zoom(10.0, 0.1)
    shown = axis.start_s, axis.stop_s
    axis.grow(0.0, 300.0)
    assert (axis.start_s, axis.stop_s) == shown
    # Samples dropped from the buffer cannot be shown.
    axis.grow(200.0, 800.0)
    assert axis.start_s == pytest.approx(197.0)
    assert axis.span_s == pytest.approx(shown[1] - shown[0])
    axis.fit()
    axis.grow(300.0, 900.0)
    assert (axis.start_s, axis.stop_s) == pytest.approx((297.0, 903.0))


def test_a_zoomed_part_of_a_growing_flight_stays_zoomed() -> None:
    axis = TimeAxis(600.0)
    axis.grow(0.0, 602.0)
    # A complete flight stays complete, with its margins of 1/200.
    assert (axis.start_s, axis.stop_s) == pytest.approx((-3.01, 605.01))
    axis.zoom(300.0, 0.1)
    before = axis.start_s, axis.stop_s
    axis.grow(0.0, 610.0)
    assert (axis.start_s, axis.stop_s) == pytest.approx(before)
    # With the end in view, the end stays in view.
    axis.pan(1000.0)
    span_s = axis.span_s
    axis.grow(0.0, 700.0)
    assert axis.span_s == pytest.approx(span_s)
    assert axis.stop_s == pytest.approx(703.5)


@pytest.mark.parametrize(
    ("second", "start_s"),
    [
        # Of 100 to 200 s: inside from a tenth to nine tenths, just outside up to a length beyond, and far away.
        (110.5, 100.0),
        (189.5, 100.0),
        (105.0, 95.0),
        (195.0, 105.0),
        (1.0, -3.0),
        (299.0, 209.0),
        (301.0, 251.0),
        (400.0, 350.0),
    ],
)
def test_a_play_head_is_followed_to_the_edge_and_from_afar_to_the_middle(second: float, start_s: float) -> None:
    axis = showing(100.0, 200.0)
    axis.follow(second)
    assert (axis.start_s, axis.span_s) == pytest.approx((start_s, 100.0))


def test_a_hundredth_of_a_second_is_the_smallest_part() -> None:
    axis = TimeAxis(600.0)
    axis.zoom(300.0, 1e-9)
    assert axis.span_s == pytest.approx(0.01, rel=1e-9)
