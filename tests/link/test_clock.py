"""Which UTC an autopilot's time since boot is."""

import random

import pytest

from glstar.link.clock import BootClock

UTC_S = 1_710_068_400.0
MS = 1e-3


def test_the_median_of_its_readings_is_utc_whatever_the_link_delays() -> None:
    chance, clock = random.Random(1), BootClock()
    for second in range(100):
        delay_s = chance.uniform(0.0, 0.3)
        boot_s = clock.add_packet(second, 5000.0 + second + delay_s)
        wrong_s = 3.0 if second == 50 else chance.uniform(-1, 1) * MS
        clock.read_utc(boot_s, UTC_S + second + wrong_s)

    assert clock.utc_minus_boot_s == pytest.approx(UTC_S, rel=0, abs=0.5 * MS)
    assert clock.source == "SYSTEM_TIME, 31 readings"


def test_the_newest_reading_counts_no_more_than_any_other() -> None:
    clock = BootClock()
    for second in range(20):
        clock.read_utc(clock.add_packet(second, 5000.0 + second), UTC_S + second)
    clock.read_utc(clock.add_packet(20.0, 5020.0), UTC_S + 23.0)

    assert clock.utc_minus_boot_s == pytest.approx(UTC_S, abs=1e-6)


def test_before_a_fix_there_is_no_utc() -> None:
    clock = BootClock()
    clock.read_utc(clock.add_packet(1.0, 5001.0), 0.0)

    assert clock.utc_minus_boot_s is None
    assert clock.source is None


def test_the_computers_clock_serves_without_the_links_jitter() -> None:
    chance, clock = random.Random(2), BootClock(utc_minus_host_s=UTC_S - 5000.0)
    for step in range(2000):
        clock.add_packet(step / 50, 5000.0 + step / 50 + chance.expovariate(1 / 0.02))

    assert clock.utc_minus_boot_s == pytest.approx(UTC_S, rel=0, abs=1 * MS)
    assert clock.source == "the computer's clock"


def test_a_link_that_is_delayed_for_a_while_moves_the_computers_clock_by_nothing() -> None:
    """Packets are delayed by 60 to 80 ms for most of a minute; those of its first seconds came at once."""
    chance, clock = random.Random(4), BootClock(utc_minus_host_s=UTC_S - 5000.0)
    for step in range(2500):
        late_s = chance.uniform(0.0, 0.02) + (0.06 if step > 200 else 0.0)
        clock.add_packet(step / 50, 5000.0 + step / 50 + late_s)

    assert clock.host_minus_boot_s == pytest.approx(5000.0, rel=0, abs=1 * MS)
    assert clock.utc_minus_boot_s == pytest.approx(UTC_S, rel=0, abs=1 * MS)


def test_an_hour_of_a_quartz_that_is_20_millionths_wrong_costs_less_than_5_ms() -> None:
    for known in (True, False):
        clock = BootClock(utc_minus_host_s=UTC_S - 5000.0)
        for second in range(3600):
            boot_s = clock.add_packet(second * (1 + 20e-6), 5000.0 + second)
            if known:
                clock.read_utc(boot_s, UTC_S + second)
        assert clock.utc_minus_boot_s is not None
        assert clock.utc_minus_boot_s + boot_s == pytest.approx(UTC_S + 3599, rel=0, abs=5 * MS)


def test_an_autopilot_that_sets_its_clock_is_followed_within_seconds() -> None:
    clock = BootClock()
    for second in range(60):
        boot_s = clock.add_packet(second, 5000.0 + second)
        clock.read_utc(boot_s, UTC_S + second + (18.0 if second < 30 else 0.0))
        if second == 36:
            assert clock.utc_minus_boot_s == pytest.approx(UTC_S, abs=1e-6)


def test_after_a_reboot_utc_goes_on_by_the_computers_clock_until_it_is_reported_again() -> None:
    clock = BootClock()
    for second in range(60):
        clock.read_utc(clock.add_packet(100.0 + second, 5000.0 + second), UTC_S + second)
    assert clock.boot == 0

    boot_s = clock.add_packet(1.0, 5100.0)

    assert (clock.boot, boot_s) == (1, 1.0)
    assert clock.utc_minus_boot_s == pytest.approx(UTC_S + 100 - 1.0, abs=1e-6)
    assert "before the reboot" in str(clock.source)
    clock.read_utc(boot_s, UTC_S + 200)
    assert clock.source == "SYSTEM_TIME, 1 readings"


def test_a_packet_that_is_overtaken_is_no_reboot_and_a_wrap_of_32_bits_is_none() -> None:
    clock = BootClock()
    clock.add_packet(100.0, 5000.0)
    clock.add_packet(99.5, 5000.1)
    assert clock.boot == 0

    clock, last_s = BootClock(), 2**32 / 1000 - 0.01
    clock.add_packet(last_s, 6000.0)
    assert clock.add_packet(0.01, 6000.02) == pytest.approx(last_s + 0.02, abs=1e-6)
    assert clock.boot == 0


def test_of_two_clocks_that_stamp_beside_each_other_the_first_counts() -> None:
    for other_s in (1000.0, -40.0):
        clock = BootClock()
        for step in range(300):
            now_s = step / 50
            assert clock.add_packet(50.0 + now_s, 5000.0 + now_s) == 50.0 + now_s
            assert clock.add_packet(50.0 + other_s + now_s, 5000.001 + now_s) is None
        assert clock.has_two_clocks
        assert clock.boot == 0

        # When the first has fallen silent the other counts, at once.
        heard = [clock.add_packet(50.0 + other_s + now_s, 5000.0 + now_s) for now_s in (6.0, 6.3, 6.6, 6.9)]
        assert heard[:2] == [None, None]
        assert heard[2:] == pytest.approx([56.6 + other_s, 56.9 + other_s], abs=1e-6)
        assert (clock.boot, clock.has_two_clocks) == (1, False)


def test_a_gap_is_no_reboot_however_long() -> None:
    clock = BootClock()
    assert clock.add_packet(50.0, 5000.0) == 50.0
    assert clock.add_packet(150.0, 5100.2) == 150.0
    # Nor is what is played faster than it was flown.
    assert [clock.add_packet(150.0 + step, 5100.2 + step / 60) for step in (1, 2, 3)] == [151.0, 152.0, 153.0]
    assert clock.boot == 0


def test_utc_of_the_first_packet_may_be_given_and_counts_then() -> None:
    clock = BootClock(start_utc_s=UTC_S, host_source="given")
    for second in range(10):
        clock.read_utc(clock.add_packet(50.0 + second, 5000.0 + second), UTC_S + 12345)

    assert clock.utc_minus_boot_s == pytest.approx(UTC_S - 50.0, abs=1e-6)
    assert clock.source == "given"


def test_a_ground_station_that_knows_utc_serves_where_the_autopilot_does_not() -> None:
    clock = BootClock()
    for second in range(10):
        clock.read_utc(clock.add_packet(second, 5000.0 + second), 0.0)
        clock.read_others_utc(UTC_S + second, 5000.0 + second)

    assert clock.utc_minus_boot_s == pytest.approx(UTC_S, abs=1e-6)
    assert "another system" in str(clock.source)
