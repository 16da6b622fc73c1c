"""Exposure control against the closed form of its filter, on a linear sensor without noise."""

from dataclasses import replace
from math import ceil, log

import numpy as np
import pytest

from glstar.camera.exposure import ControlledExposure, Exposure, ExposureControl

CONTROL = ExposureControl("mean", 0.16, 99.0, (0.001, 0.5), (1.0, 16.0), 2, 0.2)


def flown(control: ExposureControl, brightness: np.ndarray, gain: float = 1.0) -> np.ndarray:
    """Return exposure time, gain and level of each frame, (n, 3), of a scene of some levels per second."""
    state, rows = ControlledExposure.begun(control, gain), []
    for per_s in brightness:
        duration_s, factor = state.settings
        level = min(duration_s * factor * per_s, 1.0)
        rows.append((duration_s, factor, level))
        state = state.after(level)
    return np.array(rows)


@pytest.mark.parametrize("delay", [1, 2, 5])
@pytest.mark.parametrize("speed", [0.2, 0.6, 1.0])
def test_the_level_settles_as_the_filter_says_whatever_the_delay(delay: int, speed: float) -> None:
    """A scene ten times too bright, not saturated: the excess falls by 1 - speed a frame, faster near the target."""
    control = replace(CONTROL, delay_frames=delay, speed=speed, limits_s=(0.001, 0.1))
    found = flown(control, np.full(60, 10.0))

    excess = found[:, 0] / 0.016 - 1
    frames = 0 if speed == 1 else ceil(log(excess[0] / 0.2) / -log(1 - speed))
    np.testing.assert_array_equal(found[:delay, 0], 0.1)
    falls = (1 - speed) ** np.arange(max(frames, 1))
    np.testing.assert_allclose(excess[delay - 1 : delay - 1 + len(falls)], excess[0] * falls, rtol=0, atol=1e-4)
    # Then at the square root of the speed to within the 2 % that are left alone.
    assert (np.abs(found[delay + frames + 6 :, 2] / 0.16 - 1) < 0.02).all()
    assert (found[:, 1] == 1.0).all()


def test_a_saturated_scene_is_left_by_a_constant_factor_a_frame() -> None:
    found = flown(replace(CONTROL, speed=1.0, delay_frames=1), np.full(6, 1000.0))

    np.testing.assert_allclose(found[:4, 0], [0.5, 0.08, 0.0128, 0.002048], rtol=1e-6)
    # The shortest exposure is the limit: what is left of the light is too much.
    np.testing.assert_array_equal(found[4:, 0], 0.001)


def test_the_gain_rises_only_at_the_longest_exposure_and_both_stay_in_their_limits() -> None:
    dark = 0.16 / 0.5 / np.geomspace(0.01, 100.0, 400)
    found = flown(replace(CONTROL, speed=1.0), dark)

    duration_s, gain, level = found.T
    assert duration_s.min() >= 0.001
    assert duration_s.max() == 0.5
    assert gain.min() == 1.0
    assert 15.68 < gain.max() <= 16.0  # the last 2 % are left alone
    assert (gain[duration_s < 0.5] == 1.0).all()
    # 2.3 % fewer light a frame: two frames of delay and the 2 % that are left alone.
    inside = (gain < 15.0) & (np.arange(400) > 10)
    np.testing.assert_allclose(level[inside], 0.16, rtol=0.08)
    assert level[-1] == pytest.approx(0.16 * gain[-1] / 100, rel=1e-6)


@pytest.mark.parametrize("level", [0.0, -0.01])
def test_a_black_frame_asks_for_ten_times_as_much(level: float) -> None:
    state = ControlledExposure.begun(replace(CONTROL, speed=1.0, delay_frames=1, gain_limits=(1.0, 100.0)), 1.0)

    assert state.after(level).settings == (0.5, 10.0)


def test_mean_and_percentile_are_measured_from_the_black_level() -> None:
    pixels = np.array([[100, 100, 100, 1100]], dtype=np.uint16)

    assert CONTROL.level(pixels, 100, 1100) == pytest.approx(0.25)
    assert replace(CONTROL, metering="percentile", percentile=75.0).level(pixels, 100, 1100) == 0.0
    assert replace(CONTROL, metering="percentile", percentile=76.0).level(pixels, 100, 1100) == 1.0


def test_short_exposures_keep_their_times_when_they_become_shorter() -> None:
    """A rolling shutter that reads for 40 ms: exposures of 5 ms follow each other as those of 50 ms did."""
    stack = Exposure(100.0, 0.05, readout_s=0.04, frames=4, gap_s=0.01)

    short = stack.shortened(0.005)

    np.testing.assert_allclose(short.short_times_s()[:, 0], stack.short_times_s()[:, 0], rtol=0, atol=1e-7)
    assert short.span_s == pytest.approx(3 * 0.06 + 0.005 + 0.04)
    assert replace(stack, frames=1).shortened(0.005).span_s == pytest.approx(0.045)


def test_a_frame_that_is_not_measured_keeps_what_was_decided_last() -> None:
    """The queue of three frames goes on; the frame after them has the last decision, too."""
    state = ControlledExposure.begun(replace(CONTROL, delay_frames=3), 1.0)
    for level in (0.8, 0.7, 0.6):
        state = state.after(level)
    first, second, third = state.queue
    assert len({first, second, third}) == 3

    later = state.unmeasured()

    assert later.queue == (second, third, third)
    assert (later.product_s, later.settings) == (state.product_s, second)


# Every number differs, and nothing is 1: the shortest product is 0.003 s, the longest 4 s.
ODD = ExposureControl("mean", 0.25, 90.0, (0.002, 0.5), (1.5, 8.0), 3, 0.36)


@pytest.mark.parametrize(
    ("product_s", "measured_s", "level", "expected_s"),
    [
        (0.1, 0.2, 0.5, 0.1),  # half of what was measured: the present product is right
        (0.1, 0.2, 0.5 / 1.019, 0.1),  # 1.9 % are left alone,
        (0.1, 0.2, 0.5 * 1.019, 0.1),
        (0.1, 0.2, 0.5 / 1.021, 0.1 + 0.6 * 0.0021),  # and 2.1 % not: near the target at the root of the speed
        (0.1, 0.2, 0.5 * 1.2 / 1.21, 0.1),
        (0.1 / 1.21, 0.2, 0.5, 0.1 / 1.21 + 0.6 * (0.1 - 0.1 / 1.21)),
        (0.081, 0.2, 0.5, 0.081 + 0.6 * 0.019),  # 19 % of what is wanted are near,
        (0.079, 0.2, 0.5, 0.079 + 0.36 * 0.021),  # 21 % are not
        (0.119, 0.2, 0.5, 0.119 - 0.6 * 0.019),
        (0.121, 0.2, 0.5, 0.121 - 0.36 * 0.021),
        (0.1, 0.2, 0.001, 0.1 + 0.36 * 1.9),  # ten times as much at most
        (0.1, 0.2, 0.02, 0.1 + 0.36 * 1.9),
        (0.1, 0.2, 0.026, 0.1 + 0.36 * (0.2 * 0.25 / 0.026 - 0.1)),
        (2.0, 3.0, 0.1, 2.0 + 0.36 * 2.0),  # the longest exposure with the largest gain
        (0.01, 0.002, 0.9, 0.01 - 0.36 * 0.007),  # the shortest with the smallest
    ],
)
def test_the_product_of_time_and_gain_goes_to_the_target(
    product_s: float, measured_s: float, level: float, expected_s: float
) -> None:
    assert ODD.product_after(product_s, measured_s, level) == pytest.approx(expected_s, rel=1e-9)


def test_the_limits_of_the_filter_are_exact() -> None:
    """Two hundredths of the product are a change, and a fifth of what is wanted is not near."""
    slow = replace(ODD, limits_s=(0.002, 100.0))
    assert slow.product_after(50.0, 51.0, 0.25) == pytest.approx(50 + 0.6, rel=1e-12)
    assert slow.product_after(40.0, 50.0, 0.25) == pytest.approx(40 + 0.36 * 10, rel=1e-12)


@pytest.mark.parametrize(
    ("product_s", "expected"),
    [
        (0.1234567, (0.082304, 1.5)),  # whole microseconds
        (0.0012, (0.002, 1.5)),
        (0.75, (0.5, 1.5)),
        (0.7512345678, (0.5, 1.5025)),  # four decimals
        (3.9, (0.5, 7.8)),
        (5.0, (0.5, 8.0)),
    ],
)
def test_a_product_is_divided_into_time_first(product_s: float, expected: tuple[float, float]) -> None:
    assert ODD.divided(product_s) == expected


@pytest.mark.parametrize(("gain", "first"), [(1.0, 1.5), (2.5, 2.5), (9.0, 8.0)])
def test_control_begins_with_the_longest_time_and_the_gain_of_the_sensor(gain: float, first: float) -> None:
    state = ControlledExposure.begun(ODD, gain)
    assert (state.product_s, state.queue, state.settings) == (0.5 * first, ((0.5, first),) * 3, (0.5, first))
    # By default the frame that is measured has the settings.
    after = state.after(0.5)
    assert after.product_s == ODD.product_after(0.5 * first, 0.5 * first, 0.5)
    assert after.queue == (*state.queue[1:], ODD.divided(after.product_s))
    assert state.after(0.5, 0.3).product_s == ODD.product_after(0.5 * first, 0.3, 0.5)


def test_a_frame_of_two_that_is_not_measured_keeps_the_last_decision() -> None:
    state = ControlledExposure(ODD, 0.1, ((0.1, 2.0), (0.2, 3.0), (0.3, 4.0), (0.4, 5.0)))
    assert state.unmeasured().queue == ((0.2, 3.0), (0.3, 4.0), (0.4, 5.0), (0.4, 5.0))


def test_a_level_is_the_mean_over_the_range() -> None:
    pixels = np.array([[200, 300, 700], [260, 480, 1060]], dtype=np.uint16)
    assert ODD.level(pixels, 60.0, 1060.0) == pytest.approx(0.44, rel=1e-12)
    assert replace(ODD, metering="percentile", percentile=50.0).level(pixels, 60.0, 1060.0) == pytest.approx(0.24)
