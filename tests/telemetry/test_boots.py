"""Logs of several boots: each boot is converted by its own UTC, or left out with a remark."""

from collections.abc import Callable
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

from glstar.errors import LogFormatError
from glstar.flight import Flight
from glstar.system.resources import asset
from glstar.telemetry import FlightOptions, open_flight, open_source, survey
from glstar.telemetry.boots import find_boots
from tests.support import tlog, ulog
from tests.support.dataflash import ELEVEN_MS, ELEVEN_S, HOME, WEEK, Log, TextLog, as_text, with_head

LOGS = Path(__file__).parents[3] / "shared" / "logs"
SKYWALKER = LOGS / "plane_skywalkerX8_TestLog2.reenc.BIN"
ADELAIDE = LOGS / "plane_SITL_adelaide_200Hz.BIN"
DEMO = asset("adelaide.BIN")
needs_logs = pytest.mark.skipif(not ADELAIDE.exists(), reason=f"no sample logs in {LOGS}")


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "joined.BIN"


def boot(
    log: Log,
    start_s: float,
    utc_s: float,
    yaw_deg: float,
    *,
    duration_s: float = 20.0,
    rate_hz: float = 25.0,
    status: int = 3,
    wrong_ms: Callable[[float], int] = lambda _: 0,
    latitude_deg: float = -34.93,
) -> bytes:
    """Write a boot whose clock begins at `start_s` when UTC is `utc_s`, turning at 1 deg/s from a yaw; return it."""
    for i in range(round(duration_s * rate_hz) + 1):
        t = start_s + i / rate_hz
        log.att(t, yaw_deg=(yaw_deg + i / rate_hz) % 360)
        log.pos(t, latitude_deg=latitude_deg)
        if i % 5 == 0:
            ms = ELEVEN_MS + round((utc_s - ELEVEN_S + i / rate_hz) * 1000) + wrong_ms(i / rate_hz)
            week = WEEK + ms // 604_800_000
            values = (round((t + 0.02) * 1e6), status, ms % 604_800_000, week, -349300000, 1386000000, 48.0)
            log.add("GPS", "QBIHLLf", "TimeUS,Status,GMS,GWk,Lat,Lng,Alt", *values)
    return log.data


def yaw_deg(flight: Flight, utc_s: float) -> float:
    w, _, _, z = flight.attitude.at([utc_s])[0]
    return -float(np.rad2deg(2 * np.arctan2(z, w))) % 360  # NED to body has the opposite sign


def reasons(flight: Flight) -> list[str]:
    return [gap.reason for gap in flight.attitude.gaps]


def same(one: Flight, other: Flight) -> bool:
    """Return whether two flights have exactly the same attitudes, positions and gaps at the same UTC."""
    return (
        np.array_equal(one.attitude.utc_s, other.attitude.utc_s)
        and np.array_equal(one.attitude.q_body_ned, other.attitude.q_body_ned)
        and np.array_equal(one.position.utc_s, other.position.utc_s)
        and np.array_equal(one.position.latitude_rad, other.position.latitude_rad)
        and one.attitude.gaps == other.attitude.gaps
        and one.utc_source == other.utc_source
    )


# --- DataFlash ------------------------------------------------------------------------------------------------------
HOUR_LATER_S = ELEVEN_S + 3600.0
# The clock of the second boot begins before, within and after that of the first; in the last case without a break.
STARTS_S = (5.0, 40.0, 49.0, 50.04, 51.5, 700.0)


@pytest.mark.parametrize("start_s", STARTS_S)
@pytest.mark.parametrize("kind", [Log, TextLog])
def test_each_boot_has_its_own_utc_and_a_gap_is_between_them(path: Path, start_s: float, kind: type[Log]) -> None:
    path.write_bytes(
        with_head(boot(kind(), 30.0, ELEVEN_S, 10.0)) + with_head(boot(kind(), start_s, HOUR_LATER_S, 200.0))
    )

    flight = open_flight(path)

    assert reasons(flight) == ["a reboot of the autopilot"]
    gap = flight.attitude.gaps[0]
    np.testing.assert_allclose([gap.start_utc_s, gap.stop_utc_s], [ELEVEN_S + 20, HOUR_LATER_S], rtol=0, atol=2e-3)
    assert yaw_deg(flight, ELEVEN_S + 7.0) == pytest.approx(17.0, abs=0.02)
    assert yaw_deg(flight, HOUR_LATER_S + 7.0) == pytest.approx(207.0, abs=0.02)
    assert flight.notes == (
        "the log holds 2 boots of the autopilot; this flight is boots 1 and 2 (--boot N takes one)",
    )


@pytest.mark.parametrize("start_s", [5.0, 40.0, 51.5, 700.0])
def test_boots_of_one_file_without_a_second_head_are_found_by_their_clocks(path: Path, start_s: float) -> None:
    log = Log()
    boot(log, 30.0, ELEVEN_S, 10.0)
    boot(log, start_s, HOUR_LATER_S, 200.0)

    flight = open_flight(log.save(path))

    assert reasons(flight) == ["a reboot of the autopilot"]
    for utc_s, expected_deg in ((ELEVEN_S + 7.0, 17.0), (HOUR_LATER_S + 7.0, 207.0)):
        assert yaw_deg(flight, utc_s) == pytest.approx(expected_deg, abs=0.02)


def test_one_of_two_boots_on_a_continuous_clock_is_left_out(path: Path) -> None:
    log = Log()
    boot(log, 30.0, ELEVEN_S, 10.0)
    boot(log, 50.04, HOUR_LATER_S, 200.0, duration_s=30.0)

    flight = open_flight(log.save(path))

    assert reasons(flight) == []
    assert yaw_deg(flight, HOUR_LATER_S + 7.0) == pytest.approx(207.0, abs=0.02)
    assert (
        "boot 1, 20.0 s, is left out: UTC steps by 3580.0 s between it and boot 2, but the clock goes on"
        in (flight.notes[1])
    )


def test_one_boot_of_several_is_chosen_by_its_number(path: Path) -> None:
    first, second = with_head(boot(Log(), 30.0, ELEVEN_S, 10.0)), with_head(boot(Log(), 5.0, HOUR_LATER_S, 200.0))
    path.write_bytes(first)
    alone = open_flight(path)
    path.write_bytes(second + first)

    chosen = open_flight(path, boot=2)

    assert same(chosen, alone)
    assert chosen.notes == ()
    with pytest.raises(LogFormatError, match=r"has no boot 3 \(--boot\): it has 2 boots"):
        open_flight(path, boot=3)


def test_a_log_of_one_boot_has_no_second_one(path: Path) -> None:
    path.write_bytes(boot(Log(), 30.0, ELEVEN_S, 10.0))

    assert same(open_flight(path, boot=1), open_flight(path))
    with pytest.raises(LogFormatError, match="has no boot 2"):
        open_flight(path, boot=2)


@pytest.mark.parametrize("start_s", [5.0, 50.04, 52.0, 700.0])
def test_a_boot_without_a_fix_does_not_borrow_utc(path: Path, start_s: float) -> None:
    first = with_head(boot(Log(), 30.0, ELEVEN_S, 10.0))
    path.write_bytes(first)
    alone = open_flight(path)
    path.write_bytes(first + with_head(boot(Log(), start_s, HOUR_LATER_S, 200.0, duration_s=60.0, status=1)))

    flight = open_flight(path)

    assert same(flight, alone)
    assert flight.notes[1] == (
        "boot 2, 60.0 s, is left out: it has no UTC (its GPS never had a 3D fix and a week);"
        " --boot 2 --utc-start TIME takes it"
    )
    given = open_flight(path, boot=2, utc_start=HOUR_LATER_S)
    assert yaw_deg(given, HOUR_LATER_S + 7.0) == pytest.approx(207.0, abs=0.02)
    with pytest.raises(LogFormatError, match="no UTC"):
        open_flight(path, boot=2)


@pytest.mark.parametrize("wrong_rows", [1, 2, 10])
def test_a_receiver_with_a_brief_error_is_no_boot(path: Path, wrong_rows: int) -> None:
    def wrong_ms(t_s: float) -> int:
        return 115_200_000 if 10.0 <= t_s < 10.0 + 0.2 * wrong_rows - 0.01 else 0

    path.write_bytes(boot(Log(), 30.0, ELEVEN_S, 10.0, duration_s=40.0, wrong_ms=wrong_ms))

    flight = open_flight(path)

    assert (flight.notes, reasons(flight)) == ((), [])
    np.testing.assert_allclose(np.diff(flight.attitude.utc_s), 0.04, rtol=0, atol=1e-5)
    assert flight.attitude.first_s == pytest.approx(ELEVEN_S, abs=2e-3)


def test_the_first_readings_of_a_receiver_may_be_wrong(path: Path) -> None:
    path.write_bytes(boot(Log(), 30.0, ELEVEN_S, 10.0, duration_s=40.0, wrong_ms=lambda t_s: 4700 if t_s < 3.0 else 0))

    flight = open_flight(path)

    assert (flight.notes, reasons(flight)) == ((), [])
    assert flight.attitude.first_s == pytest.approx(ELEVEN_S, abs=2e-3)


def test_the_end_of_a_gps_week_is_no_boot(path: Path) -> None:
    end_of_week_s = ELEVEN_S + (7 * 86400 - 11 * 3600 - 18) - 10.0
    path.write_bytes(boot(Log(), 30.0, end_of_week_s, 10.0))

    flight = open_flight(path)

    assert (flight.notes, reasons(flight)) == ((), [])
    assert yaw_deg(flight, end_of_week_s + 15.0) == pytest.approx(25.0, abs=0.02)


def test_a_flight_joined_with_itself_is_one_flight(path: Path) -> None:
    path.write_bytes(with_head(boot(Log(), 30.0, ELEVEN_S, 10.0)))
    alone = open_flight(path)
    path.write_bytes(path.read_bytes() * 2)

    flight = open_flight(path)

    assert same(flight, alone)
    assert flight.notes[1] == "boot 2, 20.0 s, is left out: it is at the same time as boot 1; --boot 2 takes it"


def test_two_aircraft_at_the_same_time_are_not_mixed(path: Path) -> None:
    one = with_head(boot(Log(), 30.0, ELEVEN_S, 10.0))
    other = with_head(boot(Log(), 7.0, ELEVEN_S + 3.0, 200.0, duration_s=30.0, rate_hz=10.0))
    path.write_bytes(one + other)

    flight = open_flight(path)

    assert flight.attitude.rate_hz == pytest.approx(10.0, abs=0.01)
    assert flight.attitude.last_s - flight.attitude.first_s == pytest.approx(30.0, abs=1e-3)
    assert "boot 1, 20.0 s, is left out: it is at the same time as boot 2" in flight.notes[1]


def test_flights_of_different_days_are_not_one(path: Path) -> None:
    first = with_head(boot(Log(), 30.0, ELEVEN_S, 10.0))
    path.write_bytes(first + with_head(boot(Log(), 5.0, ELEVEN_S + 26 * 86400, 200.0, duration_s=10.0)))

    flight = open_flight(path)

    assert flight.attitude.last_s == pytest.approx(ELEVEN_S + 20.0, abs=2e-3)
    assert flight.notes[1] == "boot 2, 10.0 s, is left out: it is 26.0 days after boot 1; --boot 2 takes it"
    assert open_flight(path, boot=2).attitude.first_s == pytest.approx(ELEVEN_S + 26 * 86400, abs=2e-3)


def test_pieces_in_the_wrong_order_are_put_in_order(path: Path) -> None:
    first, second = with_head(boot(Log(), 30.0, ELEVEN_S, 10.0)), with_head(boot(Log(), 5.0, HOUR_LATER_S, 200.0))
    path.write_bytes(first + second)
    right = open_flight(path)
    path.write_bytes(second + first)

    assert same(open_flight(path), right)


def test_the_parts_of_one_boot_are_one_boot_in_any_order(path: Path) -> None:
    whole = boot(Log(), 30.0, ELEVEN_S, 10.0, duration_s=40.0)
    path.write_bytes(with_head(whole))
    right = open_flight(path)
    halves = [Log(), Log()]
    boot(halves[0], 30.0, ELEVEN_S, 10.0)
    boot(halves[1], 50.04, ELEVEN_S + 20.04, 30.04, duration_s=19.96)
    path.write_bytes(with_head(halves[1].data) + with_head(halves[0].data))

    flight = open_flight(path)

    assert flight.notes == ()
    np.testing.assert_allclose(flight.attitude.utc_s, right.attitude.utc_s, rtol=0, atol=2e-3)
    assert yaw_deg(flight, ELEVEN_S + 30.0) == pytest.approx(40.0, abs=0.02)


def test_definitions_may_differ_between_two_logs(path: Path) -> None:
    newer = Log()
    newer.add("PARM", "Nf", "Name,Value", "THR_MID", 1.0)  # gives ATT another number
    newer.kinds |= {"XXXX": 77}
    first, second = boot(Log(), 30.0, ELEVEN_S, 10.0), boot(newer, 5.0, HOUR_LATER_S, 200.0)
    for pieces in ((first, second), (second, first)):
        path.write_bytes(b"".join(map(with_head, pieces)))

        flight = open_flight(path)

        assert yaw_deg(flight, ELEVEN_S + 7.0) == pytest.approx(17.0, abs=0.02)
        assert yaw_deg(flight, HOUR_LATER_S + 7.0) == pytest.approx(207.0, abs=0.02)


@pytest.mark.parametrize("lost_bytes", [1, 5, 13, 20, 40])
def test_a_truncated_record_before_a_join_is_dropped(path: Path, lost_bytes: int) -> None:
    first, second = with_head(boot(Log(), 30.0, ELEVEN_S, 10.0)), with_head(boot(Log(), 5.0, HOUR_LATER_S, 200.0))
    path.write_bytes(first[:-lost_bytes])
    alone = open_flight(path)
    path.write_bytes(first[:-lost_bytes] + second)

    assert same(open_flight(path, boot=1), alone)


def test_the_limit_of_gaps_follows_the_rate_of_each_boot(path: Path) -> None:
    slow = with_head(boot(Log(), 5.0, HOUR_LATER_S, 200.0, rate_hz=5.0))
    path.write_bytes(with_head(boot(Log(), 30.0, ELEVEN_S, 10.0, rate_hz=100.0)) + slow)

    assert reasons(open_flight(path)) == ["a reboot of the autopilot"]


def test_positions_are_not_taken_from_another_boot(path: Path) -> None:
    path.write_bytes(
        with_head(boot(Log(), 30.0, ELEVEN_S, 10.0))
        + with_head(boot(Log(), 5.0, HOUR_LATER_S, 200.0, latitude_deg=51.0))
    )

    position = open_flight(path).position

    for utc_s, latitude_deg in ((ELEVEN_S + 19.99, -34.93), (HOUR_LATER_S + 0.01, 51.0)):
        assert np.rad2deg(position.at(utc_s).latitude_rad) == pytest.approx(latitude_deg, abs=1e-6)


@pytest.mark.parametrize("interpolation", ["spline", "gyro"])
def test_smooth_curves_end_where_a_boot_ends(path: Path, interpolation: str) -> None:
    pieces = []
    for start_s, utc_s, yaw in ((30.0, ELEVEN_S, 10.0), (5.0, HOUR_LATER_S, 200.0)):
        log = Log()
        boot(log, start_s, utc_s, yaw)
        for i in range(1001):
            log.imu(start_s + i / 50, 0.0, 0.0, np.deg2rad(1.0))
        pieces.append(with_head(log.data))
    alone = []
    for piece in pieces:
        path.write_bytes(piece)
        alone.append(open_flight(path, interpolation=interpolation).attitude)
    path.write_bytes(b"".join(pieces))

    flight = open_flight(path, interpolation=interpolation)

    for track in alone:
        utc_s = np.linspace(track.first_s, track.last_s, 500)
        np.testing.assert_allclose(flight.attitude.at(utc_s), track.at(utc_s), rtol=0, atol=1e-12)


def test_logs_without_utc_are_not_joined(path: Path) -> None:
    path.write_bytes(
        with_head(boot(Log(), 30.0, ELEVEN_S, 10.0, status=1))
        + with_head(boot(Log(), 60.0, ELEVEN_S, 200.0, duration_s=9.0, status=1))
    )

    flight = open_flight(path, utc_start=ELEVEN_S)

    assert flight.attitude.last_s == pytest.approx(ELEVEN_S + 20.0, abs=1e-3)
    assert "boot 2, 9.0 s, is left out: without UTC its time relative to boot 1 is not known" in flight.notes[1]


def test_a_given_utc_applies_to_the_first_boot(path: Path) -> None:
    path.write_bytes(with_head(boot(Log(), 5.0, HOUR_LATER_S, 200.0)) + with_head(boot(Log(), 30.0, ELEVEN_S, 10.0)))

    flight = open_flight(path, utc_start=1e9)

    assert yaw_deg(flight, 1e9 + 7.0) == pytest.approx(17.0, abs=0.02)
    assert yaw_deg(flight, 1e9 + 3607.0) == pytest.approx(207.0, abs=0.1)


def test_the_camera_s_clock_leaves_every_boot_at_its_utc(path: Path) -> None:
    path.write_bytes(with_head(boot(Log(), 30.0, ELEVEN_S, 10.0)) + with_head(boot(Log(), 700.0, HOUR_LATER_S, 200.0)))

    flight, ahead = open_flight(path), open_flight(path, time_offset_s=1800.0)

    assert same(flight, ahead)
    assert (flight.time_offset_s, ahead.time_offset_s) == (0.0, 1800.0)
    with open_source(path) as source:
        found, _ = survey(source, FlightOptions(time_offset_s=1800.0))
    assert [one.utc_first for one in found.boots] == ["2024-03-10T11:00:00.000000Z", "2024-03-10T12:00:00.000000Z"]


def test_the_survey_lists_the_boots(path: Path) -> None:
    path.write_bytes(
        with_head(boot(Log(), 30.0, ELEVEN_S, 10.0)) + with_head(boot(Log(), 5.0, HOUR_LATER_S, 200.0, status=1))
    )

    with open_source(path) as source:
        found, _ = survey(source)

    assert [(one.number, one.samples, one.utc_first) for one in found.boots] == [
        (1, 501, "2024-03-10T11:00:00.000000Z"),
        (2, 501, None),
    ]
    assert (found.boots[0].left_out, found.boots[1].left_out) == (
        "",
        "it has no UTC (its GPS never had a 3D fix and a week)",
    )


@needs_logs
@pytest.mark.parametrize("pieces", [(DEMO, SKYWALKER), (SKYWALKER, DEMO), (DEMO, DEMO), (DEMO, ADELAIDE, SKYWALKER)])
def test_joined_real_logs_are_boot_by_boot_the_logs_that_were_joined(path: Path, pieces: tuple[Path, ...]) -> None:
    path.write_bytes(b"".join(piece.read_bytes() for piece in pieces))

    for number, piece in enumerate(pieces, start=1):
        assert same(open_flight(path, boot=number), open_flight(piece))


@needs_logs
def test_a_joined_real_log_as_text_is_boot_by_boot_the_logs_that_were_joined(path: Path, tmp_path: Path) -> None:
    texts = [tmp_path / f"{number}.log" for number in (1, 2)]
    for text, log in zip(texts, (DEMO, SKYWALKER), strict=True):
        piece = tmp_path / "piece.BIN"
        piece.write_bytes(log.read_bytes()[:400_000])
        text.write_bytes(as_text(piece))
    path.write_bytes(b"".join(text.read_bytes() for text in texts))

    for number, text in enumerate(texts, start=1):
        assert same(open_flight(path, boot=number), open_flight(text))


# --- the search -----------------------------------------------------------------------------------------------------
def steady(start_s: float, stop_s: float, at: int = 0) -> tuple[np.ndarray, np.ndarray]:
    clock_s = np.arange(start_s, stop_s, 0.1)
    return at + np.arange(clock_s.size), clock_s


def test_pieces_of_two_boots_that_alternate_are_two_boots() -> None:
    parts = [(10.0, 20.0, 1e9), (500.0, 510.0, 2e9), (20.0, 30.0, 1e9), (510.0, 520.0, 2e9)]
    position, clock_s, utc_s = np.empty(0, dtype=np.int64), np.empty(0), np.empty(0)
    for start_s, stop_s, pause_s in parts:
        at, part_s = steady(start_s, stop_s, position.size)
        position, clock_s = np.concatenate([position, at]), np.concatenate([clock_s, part_s])
        utc_s = np.concatenate([utc_s, part_s + pause_s])

    boots = find_boots([(position, clock_s)], (position, clock_s, utc_s))

    assert [one.number for one in boots] == [1, 2]
    assert [len(one.spans) for one in boots] == [2, 2]
    assert all(before[1] <= after[0] for one in boots for before, after in pairwise(one.spans))


def test_a_log_without_valid_times_is_one_boot() -> None:
    position, clock_s = np.arange(4), np.array([10.0, 20.0, 5.0, 1.0])

    [only] = find_boots([(position, clock_s)], (position[:0], clock_s[:0], clock_s[:0]))

    assert only.number == 1


def test_a_single_wrong_time_is_no_boot() -> None:
    position, clock_s = steady(10.0, 60.0)
    clock_s[[100, 300]] = [4000.0, 0.0]

    [only] = find_boots([(position, clock_s)], (position, clock_s, clock_s + 1e9))

    assert only.spans[0][0] == 0
    assert only.spans[0][1] > position[-1]


# --- other formats --------------------------------------------------------------------------------------------------
def telemetry(start_s: float, utc_s: float, yaw: float, *, stamp_s: float, system: int = 1) -> bytes:
    """Write a telemetry log of one boot, recorded by a clock that is `stamp_s` ahead of the autopilot's."""
    log = tlog.Log()
    log.stamp_s = stamp_s
    for i in range(501):
        t = start_s + i / 25
        log.attitude(t, yaw + i / 25, sender=(system, 1))
        if i % 25 == 0:
            log.time(t, sender=(system, 1), utc_s=utc_s + i / 25)
            log.place(t)
    return log.data()


@pytest.mark.parametrize("start_s", [5.0, 40.0, 52.0, 700.0])
def test_joined_telemetry_logs_have_each_their_own_utc(path: Path, start_s: float) -> None:
    # The second ground station's clock is wrong by an hour.
    second = telemetry(start_s, HOUR_LATER_S, 200.0, stamp_s=ELEVEN_S + 50.0 - start_s)
    path.write_bytes(telemetry(30.0, ELEVEN_S, 10.0, stamp_s=ELEVEN_S - 30.0) + second)

    flight = open_flight(path)

    assert reasons(flight) == ["a reboot of the autopilot"]
    assert yaw_deg(flight, ELEVEN_S + 7.0) == pytest.approx(17.0, abs=0.02)
    assert yaw_deg(flight, HOUR_LATER_S + 7.0) == pytest.approx(207.0, abs=0.02)
    assert yaw_deg(open_flight(path, boot=2), HOUR_LATER_S + 7.0) == pytest.approx(207.0, abs=0.02)
    assert open_flight(path, boot=1).attitude.last_s == pytest.approx(ELEVEN_S + 20.0, abs=1e-3)


def without_utc(start_s: float, yaw: float, *, stamp_s: float, others_utc_s: float | None = None) -> bytes:
    """Write a telemetry log of an autopilot without UTC; a ground station may send it."""
    log = tlog.Log()
    log.stamp_s = stamp_s
    for i in range(501):
        t = start_s + i / 25
        log.attitude(t, yaw + i / 25)
        if i % 25 == 0:
            log.place(t)
            if others_utc_s is not None:
                log.time(t, sender=(255, 190), utc_s=others_utc_s + i / 25, boot_ms=0)
    return log.data()


def test_utc_of_a_ground_station_applies_to_a_boot_without_its_own(path: Path) -> None:
    """The recorder's clock differs by years from that of the other recording."""
    later_s = ELEVEN_S + 40 * 86400
    second = without_utc(5.0, 200.0, stamp_s=later_s - 3e8, others_utc_s=later_s)
    path.write_bytes(telemetry(30.0, ELEVEN_S, 10.0, stamp_s=ELEVEN_S - 30.0 + 8e7) + second)

    assert yaw_deg(open_flight(path), ELEVEN_S + 7.0) == pytest.approx(17.0, rel=0, abs=0.02)
    alone = open_flight(path, boot=2)
    assert alone.attitude.first_s == pytest.approx(later_s, rel=0, abs=1e-3)
    assert alone.utc_source == "SYSTEM_TIME of system 255, component 190, on arrival, 21 readings"


def test_the_utc_source_names_what_dates_each_boot(path: Path) -> None:
    second = without_utc(5.0, 200.0, stamp_s=ELEVEN_S + 60.0 - 5.0, others_utc_s=ELEVEN_S + 60.0)
    path.write_bytes(telemetry(30.0, ELEVEN_S, 10.0, stamp_s=ELEVEN_S - 30.0) + second)

    flight = open_flight(path)

    assert flight.attitude.last_s == pytest.approx(ELEVEN_S + 80.0, rel=0, abs=1e-3)
    assert flight.utc_source == (
        "SYSTEM_TIME, 21 readings; boot 2: SYSTEM_TIME of system 255, component 190, on arrival, 21 readings"
    )
    assert open_flight(path, boot=1).utc_source == "SYSTEM_TIME, 21 readings"


@pytest.mark.parametrize("pause_s", [-7200.0, 7200.0])
def test_a_boot_without_utc_does_not_take_that_of_another_recording(path: Path, pause_s: float) -> None:
    second = without_utc(5.0, 200.0, stamp_s=ELEVEN_S - 5.0 + pause_s)
    path.write_bytes(telemetry(30.0, ELEVEN_S, 10.0, stamp_s=ELEVEN_S - 30.0) + second)

    flight = open_flight(path)

    assert flight.attitude.last_s == pytest.approx(ELEVEN_S + 20.0, rel=0, abs=1e-3)
    assert any("boot 2" in note and "no SYSTEM_TIME during this boot" in note for note in flight.notes)
    with pytest.raises(LogFormatError, match="no SYSTEM_TIME during this boot"):
        open_flight(path, boot=2)


def test_a_boot_without_utc_in_the_same_recording_takes_its_clock(path: Path) -> None:
    second = without_utc(5.0, 200.0, stamp_s=ELEVEN_S + 60.0 - 5.0 + 900.0)
    path.write_bytes(telemetry(30.0, ELEVEN_S, 10.0, stamp_s=ELEVEN_S - 30.0 + 900.0) + second)

    assert yaw_deg(open_flight(path), ELEVEN_S + 67.0) == pytest.approx(207.0, rel=0, abs=0.02)


def test_telemetry_of_different_days_is_not_one_flight(path: Path) -> None:
    later_s = ELEVEN_S + 40 * 86400
    second = telemetry(5.0, later_s, 200.0, stamp_s=later_s - 5.0)
    path.write_bytes(telemetry(30.0, ELEVEN_S, 10.0, stamp_s=ELEVEN_S - 30.0) + second)

    flight = open_flight(path)

    assert flight.attitude.last_s == pytest.approx(ELEVEN_S + 20.0, abs=1e-3)
    assert "boot 2, 20.0 s, is left out: it is 40.0 days after boot 1" in flight.notes[1]
    assert yaw_deg(open_flight(path, boot=2), later_s + 7.0) == pytest.approx(207.0, abs=0.02)


def micro(t_s: float) -> int:
    return round(t_s * 1e6)


def px4(start_s: float, utc_s: float, yaw: float, *, fix: int = 3) -> bytes:
    """Write a ULog of one boot."""
    log = ulog.Log()
    for i in range(501):
        t = start_s + i / 25
        log.attitude(t, yaw + i / 25)
        if i % 5 == 0:
            log.gps(t, fix=fix, utc_s=utc_s + i / 25 if fix == 3 else 0.0)
    return log.data()


@pytest.mark.parametrize("start_s", [5.0, 40.0, 52.0, 700.0])
def test_joined_ulogs_have_each_their_own_utc(path: Path, start_s: float) -> None:
    path.write_bytes(px4(30.0, ELEVEN_S, 10.0) + px4(start_s, HOUR_LATER_S, 200.0))

    flight = open_flight(path)

    assert reasons(flight) == ["a reboot of the autopilot"]
    assert yaw_deg(flight, ELEVEN_S + 7.0) == pytest.approx(17.0, abs=0.02)
    assert yaw_deg(flight, HOUR_LATER_S + 7.0) == pytest.approx(207.0, abs=0.02)


def test_a_ulog_without_a_fix_does_not_borrow_utc(path: Path) -> None:
    path.write_bytes(px4(30.0, ELEVEN_S, 10.0) + px4(52.0, HOUR_LATER_S, 200.0, fix=0))

    flight = open_flight(path)

    assert flight.attitude.last_s == pytest.approx(ELEVEN_S + 20.0, abs=1e-3)
    assert "boot 2, 20.0 s, is left out: it has no UTC" in flight.notes[1]


HEADER = "utc_s,roll_deg,pitch_deg,yaw_deg,latitude_deg,longitude_deg,height_m\n"


def table(utc_s: float, yaw: float) -> str:
    return "".join(f"{utc_s + i / 10:.3f},0,0,{yaw + i / 10:.3f},-34.93,138.6,48\n" for i in range(201))


@pytest.mark.parametrize("header", ["", HEADER])
def test_joined_tables_without_overlap_are_one_flight(path: Path, header: str) -> None:
    path.write_text(HEADER + table(HOUR_LATER_S, 200.0) + header + table(ELEVEN_S, 10.0))

    flight = open_flight(path)

    assert flight.notes == ()
    assert reasons(flight) == ["a data gap"]
    assert yaw_deg(flight, ELEVEN_S + 7.0) == pytest.approx(17.0, abs=0.02)
    assert yaw_deg(flight, HOUR_LATER_S + 7.0) == pytest.approx(207.0, abs=0.02)


@pytest.mark.parametrize("header", ["", HEADER])
def test_joined_tables_of_two_aircraft_are_not_mixed(path: Path, header: str) -> None:
    path.write_text(HEADER + table(ELEVEN_S, 10.0) + table(ELEVEN_S + 20.1, 30.1) + header + table(ELEVEN_S + 5, 200.0))

    flight = open_flight(path)

    assert yaw_deg(flight, ELEVEN_S + 7.0) == pytest.approx(17.0, abs=0.02)
    assert "boot 2, 20.0 s, is left out: it is at the same time as boot 1; --boot 2 takes it" in flight.notes
    assert yaw_deg(open_flight(path, boot=2), ELEVEN_S + 7.0) == pytest.approx(202.0, abs=0.02)


def test_sessions_of_a_table_on_different_days_are_not_one_flight(path: Path) -> None:
    path.write_text(HEADER + table(ELEVEN_S, 10.0) + table(ELEVEN_S + 26 * 86400, 200.0).rpartition("\n")[0])

    flight = open_flight(path)

    assert flight.attitude.last_s == pytest.approx(ELEVEN_S + 20.0, abs=1e-3)
    assert flight.notes[1] == "boot 2, 20.0 s, is left out: it is 26.0 days after boot 1; --boot 2 takes it"


@pytest.mark.parametrize("row", [50, 150])
def test_one_row_of_another_year_does_not_make_a_flight_of_years(path: Path, row: int) -> None:
    rows = table(ELEVEN_S, 10.0).splitlines(keepends=True)
    rows[row] = f"{ELEVEN_S + 3e8:.3f}" + rows[row][14:]
    path.write_text(HEADER + "".join(rows))

    flight = open_flight(path)

    assert flight.attitude.last_s - flight.attitude.first_s == pytest.approx(20.0, abs=1e-3)
    assert flight.notes == ("1 row has an impossible time and is left out",)


def dumped(folder: Path, *parts: tuple[float, float, float]) -> Path:
    """Write mavlogdump's CSV of boots, each given by the start of its clock, its UTC, and a yaw."""
    att, gps = ["timestamp,TimeUS,Roll,Pitch,Yaw"], ["timestamp,TimeUS,Status,GMS,GWk,Lat,Lng,Alt"]
    for start_s, utc_s, yaw in parts:
        for i in range(501):
            t = start_s + i / 25
            att.append(f"{1.71e9 + t:.8f},{micro(t)},0.0,0.0,{yaw + i / 25}")
            if i % 5 == 0:
                ms = ELEVEN_MS + round((utc_s - ELEVEN_S + i / 25) * 1000)
                gps.append(f"{1.71e9 + t:.8f},{micro(t + 0.02)},3,{ms},{WEEK},-34.93,138.6,48.0")
    (folder / "log_GPS.csv").write_text("\n".join(gps))
    (folder / "log_ATT.csv").write_text("\n".join(att))
    return folder / "log_ATT.csv"


@pytest.mark.parametrize("start_s", [5.0, 40.0, 52.0, 700.0])
def test_boots_are_reported_separately_in_the_csv_of_a_log(tmp_path: Path, start_s: float) -> None:
    flight = open_flight(dumped(tmp_path, (30.0, ELEVEN_S, 10.0), (start_s, HOUR_LATER_S, 200.0)))

    assert reasons(flight) == ["a reboot of the autopilot"]
    assert yaw_deg(flight, ELEVEN_S + 7.0) == pytest.approx(17.0, abs=0.02)
    assert yaw_deg(flight, HOUR_LATER_S + 7.0) == pytest.approx(207.0, abs=0.02)


def test_csv_tables_of_different_numbers_of_boots_are_refused(tmp_path: Path) -> None:
    att = dumped(tmp_path, (30.0, ELEVEN_S, 10.0))
    one_gps = (tmp_path / "log_GPS.csv").read_text()
    dumped(tmp_path, (30.0, ELEVEN_S, 10.0), (5.0, HOUR_LATER_S, 200.0))
    (tmp_path / "log_GPS.csv").write_text(one_gps)

    with pytest.raises(LogFormatError, match=r"of different numbers of boots \(log_ATT.csv 2, log_GPS.csv 1\)"):
        open_flight(att)


def test_the_stamps_of_a_csv_of_two_boots_are_no_utc(tmp_path: Path) -> None:
    att = dumped(tmp_path, (30.0, ELEVEN_S, 10.0), (5.0, HOUR_LATER_S, 200.0))
    (tmp_path / "log_GPS.csv").unlink()

    with pytest.raises(LogFormatError, match="timestamps hold for one boot only"):
        open_flight(att, site=HOME)
