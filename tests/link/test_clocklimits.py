"""Limits of an autopilot's clock: delays, wraps, reboots, second clocks, and steps of UTC or of a simulator."""

import pytest

from glstar.link.clock import COMPUTER_CLOCK, BootClock
from glstar.link.status import LatestAttitude, LinkStatus

WRAP_S = 4294967.296  # 2^32 ms
UTC_S = 1_710_068_400.0


def at(*packets: tuple[float, float], **options: object) -> BootClock:
    """Return a clock that has received packets, (time since boot, arrival) each."""
    clock = BootClock(**options)  # type: ignore[arg-type]
    for packet in packets:
        assert clock.add_packet(*packet) == packet[0]
    return clock


def test_a_clock_knows_nothing_before_its_first_packet() -> None:
    clock = BootClock()

    assert clock.now(7.5) == (None, 0.0)
    assert (clock.utc_minus_boot_s, clock.utc_minus_host_s, clock.host_minus_boot_s, clock.source) == (None,) * 4
    assert (clock.boot, clock.is_vehicle_time, clock.has_two_clocks) == (0, False, False)
    clock.use_computer_clock(UTC_S)
    assert clock.now(7.5) == (None, 0.0)
    clock.add_packet(100.0, 105.0)
    assert clock.now(107.5) == (UTC_S + 107.5, 102.5)
    assert clock.now(4.0) == (UTC_S + 4.0, 0.0)  # before the boot
    assert clock.source == COMPUTER_CLOCK
    assert (clock.utc_minus_boot_s, clock.utc_minus_host_s) == (UTC_S + 5.0, UTC_S)


def test_the_smallest_delay_counts_for_a_minute_of_windows() -> None:
    clock = BootClock()
    for second in range(68):
        clock.add_packet(100.0 + second, 105.0 + second + {5: 0.0, 7: 0.1}.get(second, 0.5))
        # Windows begin after 0, 11, 22, 33, 44 and 55 s; the seventh, after 66 s, replaces the first.
        assert clock.host_minus_boot_s == (5.5 if second < 5 else 5.0 if second < 66 else 5.5)


def test_a_given_utc_is_that_of_the_first_packet_and_replaces_that_of_the_autopilot() -> None:
    clock = BootClock(start_utc_s=UTC_S)
    clock.add_packet(100.0, 105.0)
    clock.read_utc(100.0, UTC_S + 500)
    clock.use_computer_clock(UTC_S + 900)
    clock.add_packet(101.0, 106.0)

    assert clock.now(107.0) == (UTC_S + 2.0, 102.0)
    given = BootClock(utc_minus_host_s=UTC_S, host_source="the log")
    given.add_packet(100.0, 105.0)
    assert (given.source, given.now(106.0)) == ("the log", (UTC_S + 106.0, 101.0))


def test_the_time_since_boot_is_continued_when_its_32_bits_wrap() -> None:
    clock = at((WRAP_S - 0.75, 10.0))

    assert clock.add_packet(0.25, 11.0) == pytest.approx(WRAP_S + 0.25, rel=0, abs=1e-6)
    assert clock.add_packet(3.25, 14.0) == pytest.approx(WRAP_S + 3.25, rel=0, abs=1e-6)
    assert clock.boot == 0
    # From one to the next 5 s more than between their arrivals are no wrap, but a reboot.
    for ahead_s, boot in ((4.9, 0), (5.1, 1)):
        clock = at((WRAP_S - 0.75, 10.0))
        assert clock.add_packet(ahead_s + 0.25, 11.0) == pytest.approx(
            (0 if boot else WRAP_S) + ahead_s + 0.25, rel=0, abs=1e-6
        )
        assert clock.boot == boot


@pytest.mark.parametrize(
    ("boot_s", "elapsed_s", "boot"),
    [
        (95.05, 0.4, 0),
        (94.95, 0.4, None),
        (105.35, 0.4, 0),
        (105.45, 0.4, None),
        (94.95, 0.49, None),
        (94.95, 0.51, 1),
        (105.6, 0.51, 1),
        (3.0, 60.0, 1),
        (165.0, 60.0, 0),
    ],
)
def test_a_jump_of_more_than_five_seconds_is_another_clock_or_after_half_a_second_a_reboot(
    boot_s: float, elapsed_s: float, boot: int | None
) -> None:
    clock = at((100.0, 10.0))

    assert clock.add_packet(boot_s, 10.0 + elapsed_s) == (None if boot is None else boot_s)
    assert clock.boot == (boot or 0)


def test_two_clocks_are_received_if_both_are_for_two_seconds() -> None:
    clock = at((100.0, 10.0))
    for step in range(1, 26):
        assert clock.add_packet(500.0 + 0.1 * step, 9.95 + 0.1 * step) is None
        assert clock.add_packet(100.0 + 0.1 * step, 10.0 + 0.1 * step) is not None
        # The first packet of the other clock arrived at 10.05 s.
        assert clock.has_two_clocks == (9.95 + 0.1 * step > 12.051)
    # Neither counts any more after a reboot.
    assert clock.add_packet(1.0, 15.0) == 1.0
    assert (clock.boot, clock.has_two_clocks) == (1, False)


def test_after_a_reboot_utc_is_continued_until_the_autopilot_states_it() -> None:
    clock = at((100.0, 105.0))
    clock.read_utc(100.0, UTC_S)
    clock.add_packet(2.0, 110.25)

    assert clock.utc_minus_boot_before_s == UTC_S - 100
    assert clock.utc_minus_boot_s == UTC_S + 5.25 - 2.0
    assert clock.source == "the UTC before the reboot and the computer's clock"
    clock.read_utc(2.0, UTC_S + 77)
    assert (clock.utc_minus_boot_s, clock.source) == (UTC_S + 75, "SYSTEM_TIME, 1 readings")
    unknown = at((100.0, 105.0))
    unknown.add_packet(2.0, 110.0)
    assert (unknown.boot, unknown.utc_minus_boot_before_s, unknown.utc_minus_boot_s) == (1, None, None)


def readings(*differences_s: float, **options: object) -> BootClock:
    """Return a clock with readings of UTC minus the time since boot, above `UTC_S`."""
    clock = at((1.0, 1.0), **options)
    for number, difference_s in enumerate(differences_s):
        clock.read_utc(float(number), UTC_S + number + difference_s)
    return clock


def utc_of(clock: BootClock) -> float:
    assert clock.utc_minus_boot_s is not None
    return clock.utc_minus_boot_s - UTC_S


def test_utc_is_the_median_of_31_readings() -> None:
    assert readings(*(0.001 * k for k in range(40))).source == "SYSTEM_TIME, 31 readings"
    assert utc_of(readings(*(0.001 * k for k in range(40)))) == pytest.approx(0.024, rel=0, abs=1e-6)
    assert utc_of(readings(0.04, 0.0, 0.03)) == pytest.approx(0.03, rel=0, abs=1e-6)
    # 2010-01-01 and 2100-01-01, by date(1).
    for utc_s, is_read in ((1262303999.0, False), (1262304000.0, True), (4102444799.0, True), (4102444800.0, False)):
        clock = at((1.0, 1.0))
        clock.read_utc(1.0, utc_s)
        assert (clock.utc_minus_boot_s == utc_s - 1) == is_read


@pytest.mark.parametrize(
    ("latest", "expected"),
    [
        ([0.053] * 5, 0.053),
        ([0.053] * 4, 0.0),
        ([0.047] * 5, 0.0),
        ([3.0, 3.047, 3.02, 3.01, 3.0], 3.01),
        ([3.0, 3.053, 3.02, 3.01, 3.0], 0.0),
    ],
)
def test_utc_was_set_if_the_latest_five_readings_agree_on_another(latest: list[float], expected: float) -> None:
    assert utc_of(readings(*[0.0] * 12, *latest)) == pytest.approx(expected, rel=0, abs=1e-6)


def test_utc_of_other_systems_is_used_if_there_is_no_other() -> None:
    clock = at((100.0, 105.0))
    for number in range(40):
        clock.read_others_utc(UTC_S + number * 1.5, 200.0 + number)
    for utc_s in (1262303999.0, 4102444800.0):
        clock.read_others_utc(utc_s, 300.0)

    assert clock.source == "SYSTEM_TIME of another system, 31 readings"
    # Of the latest 31, the readings 9 to 39: the 24th.
    assert utc_of(clock) == 5.0 - 200 + 24 * 0.5
    clock.use_computer_clock(UTC_S)
    assert clock.source == COMPUTER_CLOCK


def test_an_attitude_is_dated_if_both_clocks_are_known() -> None:
    clock = at((100.0, 105.0))
    assert clock.dated(100.5, 106.0) is None
    clock.read_utc(100.0, UTC_S)
    assert clock.dated(100.5, 106.0) == LatestAttitude(UTC_S + 0.5, 106.0, UTC_S - 100, 0, UTC_S - 105)
    assert clock.dated(None, 106.0) is None
    assert clock.dated(100.5, None) is None
    later = LatestAttitude(UTC_S + 9, 115.0, UTC_S - 99.75, 0, UTC_S - 104.5)
    assert later.boot_s == 108.75
    before = LatestAttitude(UTC_S, 106.0, UTC_S - 100)
    assert (before.boot, before.utc_minus_host_s) == (0, 0.0)
    assert later.utc_step_s(before) == 0.25
    assert LatestAttitude(UTC_S + 9, 115.0, UTC_S + 3, 1, UTC_S - 104.5).utc_step_s(
        LatestAttitude(UTC_S, 106.0, UTC_S - 100, 0, UTC_S - 105)
    ) == pytest.approx(0.5, rel=0, abs=1e-6)


# --- a simulator's clock ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("step_s", "counts"), [(-0.48, True), (-0.52, False), (59.9, True), (60.1, False)])
def test_a_simulator_has_jumped_if_two_packets_agree_on_another_time(step_s: float, counts: bool) -> None:
    clock = at((100.0, 10.0), is_vehicle_time=True)
    assert (clock.add_packet(100.0 + step_s, 10.1) is not None) == counts
    if counts:
        assert clock.boot == 0
        return
    # A packet of the time before is no second one; neither is one of a third time.
    assert clock.add_packet(100.1, 10.2) == 100.1
    assert clock.add_packet(100.1 + step_s, 10.3) is None
    for other_s in (300.0, 299.48, 359.58):
        assert clock.add_packet(other_s, 10.4) is None
    assert clock.boot == 0
    assert clock.add_packet(359.1, 10.7) == 359.1
    assert clock.boot == 1


def test_the_time_of_a_simulator_stands_still_between_its_packets() -> None:
    clock = at((100.0, 10.0), is_vehicle_time=True, utc_minus_host_s=UTC_S)
    assert clock.now(10.5) == (UTC_S + 10.0, 100.0)
    # UTC counts from the first packet, by the time since boot: here at ten times the computer's.
    clock.add_packet(110.0, 11.0)
    assert clock.now(20.0) == (UTC_S + 20.0, 110.0)
    assert clock.host_minus_boot_s == -99.0
    assert clock.source == COMPUTER_CLOCK


@pytest.mark.parametrize(
    ("after", "expected"),
    [
        ([9.0] * 5, 9.0),
        ([9.0] * 4, 0.0),
        ([0.53, *[0.53] * 4], 0.53),
        ([0.47, *[0.47] * 4], 0.0),  # no step
        ([9.0, 9.047, 9.0, 9.0, 9.0], 9.0),
        ([9.0, 9.053, 9.0, 9.0, 9.0], 0.0),
        ([9.0, 9.0, 0.047, 9.0, 9.0, 9.0], 0.0),
        ([9.0, 9.0, 0.0, 9.0, 9.0, 9.0, 9.0, 9.0], 9.0),
        ([0.1 * k for k in range(1, 20)], 0.0),  # moves away
    ],
)
def test_a_simulators_utc_counts_from_its_first_readings_until_it_is_set(after: list[float], expected: float) -> None:
    clock = readings(*[0.0] * 6, *after, is_vehicle_time=True)
    assert utc_of(clock) == pytest.approx(expected, rel=0, abs=1e-6)
    assert readings(*[0.0] * 40, is_vehicle_time=True).source == "SYSTEM_TIME, 31 readings"


def test_a_status_says_what_a_flight_lacks() -> None:
    known = {"age_s": 0.5, "utc_source": "U", "position_source": "P"}
    always = {"endpoint": "udpin:14550", "state": "live", "problem": None, "vehicle": None, "sysid": 1, "systems": (1,)}
    always |= {"rate_hz": 50.0, "packets": 7, "lost": 0, "bad_bytes": 0, "recorded_bytes": 0}
    simulator = "no SIM_STATE, HIL_STATE_QUATERNION or SIMSTATE yet (--truth estimator needs none)"
    gimbal = (
        'no GIMBAL_DEVICE_ATTITUDE_STATUS, MOUNT_ORIENTATION or MOUNT_STATUS now ([mount] gimbal = "level" or'
        ' "none" needs none)'
    )
    for lacks, message in (
        ({"age_s": None}, "no attitude yet"),
        ({"lacks_simulator": True}, simulator),
        ({"lacks_gimbal": True}, gimbal),
        ({"utc_source": None}, "no UTC yet (--utc-now takes the computer's clock)"),
        ({"position_source": None}, "no position yet (--lat, --lon)"),
    ):
        status = LinkStatus(**(always | known | lacks))  # type: ignore[arg-type]
        assert status.missing == (message,)
    assert LinkStatus(**(always | known)).missing == ()  # type: ignore[arg-type]
