"""Conversion of an autopilot's time since boot to UTC."""

import random

import pytest

from glstar.link.clock import BootClock

UTC_S = 1_710_068_400.0
MS = 1e-3


def test_utc_is_the_median_of_the_readings_at_any_delay() -> None:
    chance, clock = random.Random(1), BootClock()
    for second in range(100):
        delay_s = chance.uniform(0.0, 0.3)
        boot_s = clock.add_packet(second, 5000.0 + second + delay_s)
        wrong_s = 3.0 if second == 50 else chance.uniform(-1, 1) * MS
        clock.read_utc(boot_s, UTC_S + second + wrong_s)

    assert clock.utc_minus_boot_s == pytest.approx(UTC_S, rel=0, abs=0.5 * MS)
    assert clock.source == "SYSTEM_TIME, 31 readings"


def test_the_latest_reading_has_no_more_weight_than_the_others() -> None:
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


def test_the_computers_clock_is_used_without_jitter_of_the_link() -> None:
    chance, clock = random.Random(2), BootClock(utc_minus_host_s=UTC_S - 5000.0)
    for step in range(2000):
        clock.add_packet(step / 50, 5000.0 + step / 50 + chance.expovariate(1 / 0.02))

    assert clock.utc_minus_boot_s == pytest.approx(UTC_S, rel=0, abs=1 * MS)
    assert clock.source == "the computer's clock"


def test_temporary_delays_do_not_move_the_computers_clock() -> None:
    """Packets of the first seconds are not delayed; later ones are delayed by 60 to 80 ms for most of a minute."""
    chance, clock = random.Random(4), BootClock(utc_minus_host_s=UTC_S - 5000.0)
    for step in range(2500):
        late_s = chance.uniform(0.0, 0.02) + (0.06 if step > 200 else 0.0)
        clock.add_packet(step / 50, 5000.0 + step / 50 + late_s)

    assert clock.host_minus_boot_s == pytest.approx(5000.0, rel=0, abs=1 * MS)
    assert clock.utc_minus_boot_s == pytest.approx(UTC_S, rel=0, abs=1 * MS)


def test_a_clock_drift_of_20_ppm_costs_less_than_5_ms_in_an_hour() -> None:
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


def test_after_a_reboot_the_computers_clock_continues_utc_until_the_next_reading() -> None:
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


def test_late_packets_and_32_bit_wraps_are_no_reboots() -> None:
    clock = BootClock()
    clock.add_packet(100.0, 5000.0)
    clock.add_packet(99.5, 5000.1)
    assert clock.boot == 0

    clock, last_s = BootClock(), 2**32 / 1000 - 0.01
    clock.add_packet(last_s, 6000.0)
    assert clock.add_packet(0.01, 6000.02) == pytest.approx(last_s + 0.02, abs=1e-6)
    assert clock.boot == 0


def test_the_first_of_two_concurrent_clocks_is_used() -> None:
    for other_s in (1000.0, -40.0):
        clock = BootClock()
        for step in range(300):
            now_s = step / 50
            assert clock.add_packet(50.0 + now_s, 5000.0 + now_s) == 50.0 + now_s
            assert clock.add_packet(50.0 + other_s + now_s, 5000.001 + now_s) is None
        assert clock.has_two_clocks
        assert clock.boot == 0

        # As soon as the first one has timed out, the other is used.
        heard = [clock.add_packet(50.0 + other_s + now_s, 5000.0 + now_s) for now_s in (6.0, 6.3, 6.6, 6.9)]
        assert heard[:2] == [None, None]
        assert heard[2:] == pytest.approx([56.6 + other_s, 56.9 + other_s], abs=1e-6)
        assert (clock.boot, clock.has_two_clocks) == (1, False)


def test_a_gap_of_any_length_is_no_reboot() -> None:
    clock = BootClock()
    assert clock.add_packet(50.0, 5000.0) == 50.0
    assert clock.add_packet(150.0, 5100.2) == 150.0
    # Nor is a flight that is played faster.
    assert [clock.add_packet(150.0 + step, 5100.2 + step / 60) for step in (1, 2, 3)] == [151.0, 152.0, 153.0]
    assert clock.boot == 0


def test_a_given_utc_of_the_first_packet_is_used() -> None:
    clock = BootClock(start_utc_s=UTC_S, host_source="given")
    for second in range(10):
        clock.read_utc(clock.add_packet(50.0 + second, 5000.0 + second), UTC_S + 12345)

    assert clock.utc_minus_boot_s == pytest.approx(UTC_S - 50.0, abs=1e-6)
    assert clock.source == "given"

    # It is the given one after a reboot, too.
    clock.add_packet(1.0, 5100.0)
    assert clock.boot == 1
    assert clock.utc_minus_boot_s == pytest.approx(UTC_S + 100.0 - 1.0, abs=1e-6)
    assert clock.source == "given"


def test_utc_of_a_ground_station_is_used_if_the_autopilot_has_none() -> None:
    clock = BootClock()
    for second in range(10):
        clock.read_utc(clock.add_packet(second, 5000.0 + second), 0.0)
        clock.read_others_utc(UTC_S + second, 5000.0 + second)

    assert clock.utc_minus_boot_s == pytest.approx(UTC_S, abs=1e-6)
    assert "another system" in str(clock.source)
