"""UTC of SYSTEM_TIME: which readings are of one boot, and which are before a correction, from both sides of limits."""

import numpy as np
import pytest

from glstar.arrays import Float
from glstar.telemetry.mavlink.clock import _corrected

UTC_S = 1.75e9


def readings(boot_s: Float, utc_minus_boot_s: Float, stamp_minus_boot_s: Float | float = 5000.0) -> Float:
    """Return (n, 6) packets: position in the file, clock, system, component, ms since boot, us of UTC."""
    heads = np.arange(boot_s.size), boot_s + stamp_minus_boot_s, np.ones(boot_s.size), np.ones(boot_s.size)
    return np.column_stack([*heads, boot_s * 1e3, (UTC_S + boot_s + utc_minus_boot_s) * 1e6])


def utc_minus_boot_s(rows: Float) -> Float:
    return np.round(rows[:, 5] * 1e-6 - rows[:, 4] * 1e-3 - UTC_S, 4)


def test_readings_before_a_correction_get_that_of_the_last_ones() -> None:
    boot_s = 10.0 + np.arange(12.0)
    rows, used, notes = _corrected(readings(boot_s, np.where(boot_s < 14, -8.0, 0.5)))
    assert used.tolist() == [False] * 4 + [True] * 8
    np.testing.assert_allclose(utc_minus_boot_s(rows), 0.5, rtol=0, atol=1e-3)
    assert len(notes) == 1
    assert notes[0].startswith("4 of 12 readings of SYSTEM_TIME are left out")
    assert "by +8.5 s without a reboot" in notes[0]


@pytest.mark.parametrize(("step_s", "is_corrected"), [(0.096, False), (0.104, True), (-0.096, False), (-0.104, True)])
def test_a_step_of_a_tenth_of_a_second_is_a_correction(step_s: float, is_corrected: bool) -> None:
    boot_s = np.arange(12.0)
    _, used, notes = _corrected(readings(boot_s, np.where(boot_s < 5, 0.0, step_s)))
    assert used.tolist() == [not is_corrected] * 5 + [True] * 7
    assert bool(notes) is is_corrected


@pytest.mark.parametrize(("step_s", "is_corrected"), [(0.97, False), (1.03, True)])
def test_a_step_of_five_usual_differences_is_a_correction(step_s: float, is_corrected: bool) -> None:
    """Readings differ by 0.2 s, up and down."""
    boot_s = np.arange(41.0)
    offset_s = np.where(boot_s % 2, 0.2, 0.0) + np.where(boot_s < 20, 0.0, step_s + 0.2)
    _, used, _ = _corrected(readings(boot_s, offset_s))
    assert used[20:].all()
    assert used[:20].all() == (not is_corrected)


@pytest.mark.parametrize(("wrong", "is_kept"), [(2, False), (3, True)])
def test_fewer_than_three_readings_are_no_level(wrong: int, is_kept: bool) -> None:
    """In the middle: readings of another time are left out as errors, or are a level, then corrected back."""
    boot_s = np.arange(20.0)
    is_wrong = (boot_s >= 8) & (boot_s < 8 + wrong)
    rows, used, notes = _corrected(readings(boot_s, np.where(is_wrong, 30.0, 0.0)))
    if is_kept:
        np.testing.assert_array_equal(used, ~is_wrong)
        assert notes
        np.testing.assert_allclose(utc_minus_boot_s(rows), 0.0, rtol=0, atol=1e-3)
    else:
        assert used.all()
        assert notes == ()


@pytest.mark.parametrize(("last", "note"), [(1, "the last reading of SYSTEM_TIME is +30.0 s from the others"), (2, "")])
def test_two_last_readings_are_a_correction_and_one_is_remarked(last: int, note: str) -> None:
    boot_s = np.arange(20.0)
    is_last = boot_s >= 20 - last
    _, used, notes = _corrected(readings(boot_s, np.where(is_last, 30.0, 0.0)))
    assert len(notes) == 1
    if note:
        assert used.all()
        assert notes[0] == f"{note}, which are used"
    else:
        np.testing.assert_array_equal(used, is_last)


@pytest.mark.parametrize(
    ("boot_step_s", "stamp_step_s", "utc_step_s", "is_one_boot"),
    [
        (1.0, 0.97, 30.0, True),  # the recorder's clock goes on within a second
        (1.0, -0.97, 30.0, True),
        (1.0, 1.03, 30.0, False),
        (1.0, -1.03, 30.0, False),
        (1.0, 900.0, 0.48, True),  # UTC does within half a second
        (1.0, 900.0, -0.48, True),
        (1.0, 900.0, 0.52, False),
        (1.0, 900.0, -0.52, False),
        (3550.0, 0.0, 30.0, True),  # an hour later
        (3650.0, 0.0, 30.0, False),
        (-2.0, 0.0, 30.0, False),  # a time since boot that goes back
    ],
)
def test_two_readings_are_of_one_boot_if_a_clock_goes_on(
    boot_step_s: float, stamp_step_s: float, utc_step_s: float, is_one_boot: bool
) -> None:
    """Only within a boot is UTC corrected."""
    later = np.arange(20) >= 10
    boot_s = np.where(later, 99.0 + boot_step_s + np.arange(20) - 10, 90.0 + np.arange(20))
    rows = readings(boot_s, np.where(later, utc_step_s, 0.0), 5000.0 + np.where(later, stamp_step_s, 0.0))
    _, used, notes = _corrected(rows)
    np.testing.assert_array_equal(used, later | (not is_one_boot))
    assert bool(notes) is is_one_boot


@pytest.mark.parametrize("interval_s", [0.0, 0.25])
def test_readings_that_are_quick_or_at_one_time_are_of_one_boot(interval_s: float) -> None:
    later = np.arange(20) >= 10
    _, used, _ = _corrected(readings(50.0 + interval_s * np.arange(20.0), np.where(later, 8.0, 0.0)))
    np.testing.assert_array_equal(used, later)


def test_a_remark_names_the_whole_correction_of_several() -> None:
    """UTC is 20 s early, then 12 s, then right: two corrections, of 20 s together."""
    boot_s = np.arange(30.0)
    rows, used, notes = _corrected(readings(boot_s, np.where(boot_s < 6, -20.0, np.where(boot_s < 14, -12.0, 0.0))))
    np.testing.assert_array_equal(used, boot_s >= 14)
    np.testing.assert_allclose(utc_minus_boot_s(rows), 0.0, rtol=0, atol=1e-3)
    assert len(notes) == 1
    assert notes[0].startswith("14 of 30 readings of SYSTEM_TIME are left out")
    assert "by +20.0 s without a reboot" in notes[0]
