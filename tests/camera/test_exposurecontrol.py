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
