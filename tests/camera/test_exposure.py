"""When the shutter is open, and into how many parts that time is cut."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from glstar.camera.exposure import Exposure
from glstar.config import ExposureSection
from glstar.errors import ConfigError

# A float64 of UTC seconds in our days is good to this.
CLOCK_S = 2.5e-7
ADELAIDE_UTC_S = 1710068400.0


def test_sub_exposures_lie_in_the_middle_of_equal_parts() -> None:
    np.testing.assert_array_equal(Exposure(100.0, 0.5).sub_utc_s(4), [100.0625, 100.1875, 100.3125, 100.4375])


def test_one_sub_exposure_lies_in_the_middle_of_the_exposure() -> None:
    exposure = Exposure(ADELAIDE_UTC_S, 0.5)

    assert exposure.sub_utc_s(1) == [exposure.mid_utc_s]


@given(st.integers(1, 2000), st.floats(0.001, 60.0))
def test_the_sub_exposures_of_a_steady_motion_keep_its_centroid_and_its_ends(n: int, duration_s: float) -> None:
    # Left ends of the parts would shift the centroid by L / 2n.
    exposure = Exposure(ADELAIDE_UTC_S, duration_s)
    sub_utc_s = exposure.sub_utc_s(n)

    assert sub_utc_s.shape == (n,)
    assert (sub_utc_s - exposure.mid_utc_s).mean() == pytest.approx(0.0, abs=CLOCK_S)
    assert sub_utc_s[0] - exposure.start_utc_s == pytest.approx(duration_s / n / 2, abs=CLOCK_S)
    assert exposure.stop_utc_s - sub_utc_s[-1] == pytest.approx(duration_s / n / 2, abs=2 * CLOCK_S)


def test_an_exposure_has_a_middle_and_an_end() -> None:
    exposure = Exposure(ADELAIDE_UTC_S, 0.5)

    assert exposure.mid_utc_s == ADELAIDE_UTC_S + 0.25
    assert exposure.stop_utc_s == ADELAIDE_UTC_S + 0.5


@pytest.mark.parametrize(
    ("duration_s", "rate_hz", "expected"),
    [
        (0.5, 200.0, 100),
        (0.07, 200.0, 14),  # 14.000000000000002 in binary
        (0.0701, 200.0, 15),
        (0.001, 200.0, 1),
        (1e-9, 200.0, 1),
        (1.0, 30.0, 30),
        (0.1, 25.0, 3),
        (60.0, 200.0, 12000),
    ],
)
def test_the_rate_determines_the_minimum_number_of_sub_exposures(
    duration_s: float, rate_hz: float, expected: int
) -> None:
    assert Exposure(0.0, duration_s, rate_hz).min_sub_exposures == expected


@given(st.integers(1, 20000))
def test_a_multiple_of_5_ms_has_that_number_of_sub_exposures(n: int) -> None:
    assert Exposure(0.0, n * 0.005).min_sub_exposures == n
    assert Exposure(0.0, n / 200).min_sub_exposures == n


@given(st.floats(1e-6, 1000.0), st.floats(0.1, 1000.0))
def test_no_sub_exposure_is_longer_than_the_rate_allows(duration_s: float, rate_hz: float) -> None:
    n = Exposure(0.0, duration_s, rate_hz).min_sub_exposures

    assert n >= 1
    assert duration_s / n <= (1 + 1e-8) / rate_hz


@pytest.mark.parametrize("key", ["duration_s", "rate_hz"])
@pytest.mark.parametrize("number", [0.0, -0.5, float("nan"), float("inf")])
def test_an_exposure_without_duration_is_refused_with_the_name_of_the_key(key: str, number: float) -> None:
    with pytest.raises(ConfigError, match=rf"exposure\.{key}: must be a positive number, not {number}") as caught:
        Exposure(0.0, **{"duration_s": 0.5, "rate_hz": 200.0} | {key: number})

    assert caught.value.key == f"exposure.{key}"


def test_an_exposure_cannot_be_changed() -> None:
    with pytest.raises(AttributeError):
        Exposure(0.0, 0.5).duration_s = 1.0


@given(st.floats(0.01, 1000.0), st.floats(0.001, 100.0), st.floats(0.001, 100.0))
def test_the_exposures_that_fit_are_those_that_end_in_time(
    length_s: float, duration_s: float, interval_s: float
) -> None:
    section = ExposureSection(duration_s=duration_s, interval_s=interval_s)
    count = section.count_within(length_s)
    last = section.nth(count - 1, ADELAIDE_UTC_S)
    one_more = section.nth(count, ADELAIDE_UTC_S)

    assert count == 0 or last.stop_utc_s <= ADELAIDE_UTC_S + length_s + 1e-6
    assert one_more.stop_utc_s > ADELAIDE_UTC_S + length_s


def test_exposures_that_fill_the_flight_to_the_end_all_fit() -> None:
    # 25 half seconds fit into 12.5 s, though 12.5 s of UTC may lack a quarter of a microsecond.
    section = ExposureSection(duration_s=0.5, interval_s=0.5)

    assert section.count_within(12.5 - CLOCK_S) == 25
    assert section.count_within(0.5) == 1
    assert section.count_within(0.4) == 0
    # The clock has a resolution of a microsecond: the last exposure may end half of it late.
    short = ExposureSection(duration_s=1e-3, interval_s=1e-3)
    assert short.count_within(0.002 - 0.45e-6) == 2
    assert short.count_within(0.002 - 0.55e-6) == 1


def test_exposures_are_counted_for_an_absurdly_short_interval() -> None:
    assert ExposureSection(interval_s=1e-310).count_within(100.0) == 2**53 + 1


def test_short_exposures_begin_with_the_stack_and_the_last_ends_with_it() -> None:
    for readout_s, gap_s in ((0.0, 0.0), (0.0, 0.3), (0.05, 0.02)):
        stack = Exposure(ADELAIDE_UTC_S, 0.1, frames=7, gap_s=gap_s, readout_s=readout_s)
        shorts, times = stack.short_exposures(), stack.short_times_s()
        starts = [short.start_utc_s for short in shorts]
        np.testing.assert_allclose(np.diff(starts), 0.1 + gap_s, rtol=0, atol=2 * CLOCK_S)
        assert starts[0] == ADELAIDE_UTC_S
        assert shorts[-1].stop_utc_s <= stack.stop_utc_s
        assert shorts[-1].stop_utc_s == pytest.approx(stack.stop_utc_s, rel=0, abs=CLOCK_S)
        assert stack.span_s == pytest.approx(0.7 + 6 * gap_s + readout_s, rel=0, abs=1e-12)
        np.testing.assert_allclose(times[:, 1] - times[:, 0], 0.1 + readout_s, rtol=0, atol=2 * CLOCK_S)
        assert times[-1, 1] == stack.stop_utc_s
        assert (times[1:, 0] == times[:-1, 1]).all() == (gap_s == readout_s == 0.0)
        assert all(short.frames == 1 and short.readout_s == readout_s for short in shorts)
        assert stack.mid_utc_s == pytest.approx(ADELAIDE_UTC_S + stack.span_s / 2, rel=0, abs=CLOCK_S)


def test_a_rolling_shutter_reads_a_short_exposure_before_the_next() -> None:
    assert Exposure(0.0, 0.1, frames=2, gap_s=0.2, readout_s=0.1 + 0.2).frames == 2
    assert Exposure(0.0, 0.1, frames=2, gap_s=0.2, readout_s=0.3 * (1 + 0.9e-9)).frames == 2
    assert Exposure(0.0, 0.1, frames=1, readout_s=0.5).frames == 1
    with pytest.raises(ConfigError, match=r"take at least 0\.200001") as caught:
        Exposure(0.0, 0.1, frames=2, gap_s=0.2, readout_s=0.3000005)
    assert caught.value.key == "exposure.gap_s"


def test_rows_open_one_after_the_other_in_the_direction_of_the_readout() -> None:
    corners = np.array([[0.0, 0.0], [4.0, 0.0], [0.0, 2.0], [4.0, 2.0]])
    for readout, opens in {
        "down": [0, 0, 0.6, 0.6],
        "up": [0.6, 0.6, 0, 0],
        "right": [0, 0.6, 0, 0.6],
        "left": [0.6, 0, 0.6, 0],
    }.items():
        exposure = Exposure(0.0, 1.0, readout_s=0.6, readout=readout)
        np.testing.assert_allclose(exposure.opening_at_s(corners, 5, 3), opens, rtol=0, atol=1e-12)
        back = exposure.with_readout_s(-0.3)
        np.testing.assert_allclose(back.opening_at_s(corners, 5, 3), 0.3 - np.divide(opens, 2), rtol=0, atol=1e-12)
        assert exposure.with_readout_s(0.0).readout == readout
        assert exposure.opening_s(1, 1) == (0.0, 0.0, 0.0)


def test_a_stack_adds_or_averages_its_digital_numbers() -> None:
    total, mean = (Exposure(0.0, 0.1, frames=16, stack=stack) for stack in ("sum", "mean"))
    assert (total.signal_factor, mean.signal_factor) == (16, 1)
    assert total.full_scale_dn(4095) == 65520
    assert mean.full_scale_dn(65535) == 65535
    assert Exposure(0.0, 0.1, frames=257).full_scale_dn(255) == 65535
    with pytest.raises(ConfigError, match="take at most 15"):
        total.full_scale_dn(4096 + 100)


def test_a_shortened_stack_keeps_its_rhythm() -> None:
    short = Exposure(0.0, 0.5, frames=3, gap_s=0.1).shortened(0.2)
    assert (short.duration_s, short.frames) == (0.2, 3)
    assert short.gap_s == pytest.approx(0.4, rel=1e-12)
    assert Exposure(0.0, 0.5, gap_s=0.1).shortened(0.6).gap_s == 0.1


@pytest.mark.parametrize(
    ("keys", "key"),
    [
        ({"start_utc_s": np.inf}, "start_utc_s"),
        ({"rate_hz": np.inf}, "rate_hz"),
        ({"duration_s": np.inf}, "duration_s"),
        ({"path_tolerance_px": -1e-9}, "path_tolerance_px"),
        ({"faintest_dn": np.nan}, "faintest_dn"),
        ({"trail": "x"}, "trail"),
        ({"readout_s": -1e-9}, "readout_s"),
        ({"readout_s": np.inf}, "readout_s"),
        ({"readout": "x"}, "readout"),
        ({"frames": 0}, "frames"),
        ({"frames": 1.5}, "frames"),
        ({"gap_s": -1e-9}, "gap_s"),
        ({"gap_s": np.inf}, "gap_s"),
        ({"stack": "x"}, "stack"),
    ],
)
def test_what_no_exposure_can_be_names_its_key(keys: dict, key: str) -> None:
    with pytest.raises(ConfigError) as caught:
        Exposure(**{"start_utc_s": 0.0, "duration_s": 1.0} | keys)
    assert caught.value.key == f"exposure.{key}"
    allowed = {"path_tolerance_px": 0.0, "faintest_dn": 0.0, "readout_s": 0.0, "frames": 1, "gap_s": 0.0}
    assert getattr(Exposure(0.0, 1.0, **allowed), key) is not None


def test_an_exposure_has_the_defaults_of_the_manual() -> None:
    plain = Exposure(5.0, 0.7)
    assert plain == Exposure(5.0, 0.7, 200.0, "auto", 0.0, "down", 0.01, 0.02, 1, 0.0, "sum")


def test_a_stack_has_up_to_1000_exposures() -> None:
    assert Exposure(0.0, 0.1, frames=1000).frames == 1000
    assert Exposure(0.0, 0.1, frames=2).frames == 2
    with pytest.raises(ConfigError, match=r"exposure\.frames: must be a whole number from 1 to 1000, not 1001"):
        Exposure(0.0, 0.1, frames=1001)


@pytest.mark.parametrize("key", ["path_tolerance_px", "faintest_dn", "gap_s"])
@pytest.mark.parametrize("number", [np.inf, np.nan, -0.1])
def test_a_limit_that_is_negative_or_not_finite_is_refused(key: str, number: float) -> None:
    with pytest.raises(ConfigError, match=rf"exposure\.{key}: must be a number.*, 0 or more, not {number}"):
        Exposure(0.0, 1.0, **{key: number})


def test_the_time_that_a_readout_needs_is_rounded_up() -> None:
    with pytest.raises(ConfigError) as caught:
        Exposure(0.0, 0.25, frames=3, gap_s=0.125, readout_s=0.5000004)
    assert str(caught.value) == (
        "exposure.gap_s: is 0.125, so that short exposures follow every 0.375 s, but the rolling shutter takes 0.5 s"
        " to read one; take at least 0.250001"
    )


def test_a_span_is_that_of_all_rows_and_short_exposures() -> None:
    stack = Exposure(50.0, 0.25, frames=5, gap_s=0.375, readout_s=0.125)
    assert (stack.span_s, stack.mid_utc_s, stack.stop_utc_s) == (2.875, 51.4375, 52.875)
    assert stack.min_sub_exposures == 575
    assert (stack.first.frames, stack.first.span_s) == (1, 0.375)
    np.testing.assert_array_equal(stack.short_times_s()[:, 0], 50 + 0.625 * np.arange(5))
    np.testing.assert_array_equal(stack.short_times_s()[:, 1], 50.375 + 0.625 * np.arange(5))
    np.testing.assert_array_equal(stack.sub_utc_s(2), [50.71875, 52.15625])


def test_an_image_of_two_rows_opens_within_its_readout() -> None:
    exposure = Exposure(0.0, 1.0, readout_s=0.6)
    assert exposure.opening_s(5, 2) == (0.0, 0.6, 0.0)
    assert exposure.opening_s(5, 1) == (0.0, 0.0, 0.0)


def test_a_sum_has_65535_dn_at_most() -> None:
    assert Exposure(0.0, 0.1, frames=15).full_scale_dn(4369) == 65535
    with pytest.raises(ConfigError) as caught:
        Exposure(0.0, 0.1, frames=16).full_scale_dn(4096)
    assert str(caught.value) == (
        "exposure.frames: is 16, and the sum of 16 exposures of up to 4096 DN reaches 65536 DN, more than 16 bits hold"
        ' (65535 DN); take at most 15, a smaller sensor.bit_depth, or exposure.stack = "mean"'
    )
