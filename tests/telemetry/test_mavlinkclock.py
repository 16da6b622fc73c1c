"""The clock of an autopilot over its boots, by packets written as arrays, and packets found byte by byte."""

import struct
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from pymavlink.dialects.v20 import ardupilotmega, common

from glstar.arrays import Float
from glstar.telemetry.mavlink import packets
from glstar.telemetry.mavlink.clock import (
    VehicleClock,
    _add_utc_by_recorder,
    _arrived_near_s,
    clock_readings,
    other_clocks,
    readings_source,
)
from glstar.telemetry.mavlink.packets import MESSAGES, LogPackets, Packets, has_boot_ms, is_telemetry_log, with_ms
from glstar.telemetry.source import Boot

PILOT, CAMERA, GROUND = (3, 1), (3, 100), (255, 190)
UTC_S = 1.75e9
COLUMNS = {name: 4 + len(fields) for name, fields in MESSAGES.values()}


class Table(Packets):
    """Packets from rows: position in the file, arrival, system, component and fields."""

    count = whole_bytes = unread_bytes = 0
    checked = True

    def __init__(self, **rows: list[list[float]]) -> None:
        self._rows = {name: np.array(of, dtype=np.float64).reshape(-1, COLUMNS[name]) for name, of in rows.items()}

    def message(self, name: str) -> Float:
        return self._rows.get(name, np.empty((0, COLUMNS[name])))

    def texts(self, sender: packets.Sender) -> list[str]:
        return [f"text of {sender}"]


def attitudes(first_at: int, boot_s: Float, stamp_s: Float, sender: packets.Sender = PILOT) -> list[list[float]]:
    """Return rows of ATTITUDE at every tenth position in the file."""
    return [
        [first_at + 10 * k, stamp, *sender, 1e3 * boot, 0.1, 0.2, 0.3]
        for k, (boot, stamp) in enumerate(zip(boot_s, stamp_s, strict=True))
    ]


def system_times(
    first_at: int, boot_s: Float, stamp_s: Float, utc_minus_boot_s: float, sender: packets.Sender = PILOT
) -> list[list[float]]:
    """Return rows of SYSTEM_TIME, one for nine attitudes."""
    return [
        [first_at + 90 * k, stamp, *sender, 1e3 * boot, 1e6 * (boot + utc_minus_boot_s)]
        for k, (boot, stamp) in enumerate(zip(boot_s, stamp_s, strict=True))
    ]


# --- packets as tables ----------------------------------------------------------------------------------------------
def test_rows_are_of_one_sender() -> None:
    beats = [[10, 5.0, 3, 1, 3, 2], [20, 6.0, 3, 100, 8, 5], [30, 7.0, 4, 1, 12, 1], [40, 8.0, 3, 1, 3, 13]]
    table = Table(HEARTBEAT=beats, ATTITUDE=[[15, 5.5, 4, 1, 1, 0, 0, 0], [35, 7.5, 3, 1, 2, 0, 0, 0]])

    np.testing.assert_array_equal(table.rows("HEARTBEAT", PILOT), [beats[0], beats[3]])
    assert table.rows("HEARTBEAT", (4, 100)).shape == (0, 6)
    assert table.senders("HEARTBEAT") == [(3, 1), (3, 100), (4, 1)]
    assert table.senders("ATTITUDE", "HEARTBEAT") == [(3, 1), (4, 1), (3, 100)]
    assert table.autopilots() == {(3, 1), (4, 1)}
    assert (table.amount("HEARTBEAT"), table.amount("RAW_IMU")) == (4, 0)
    assert table.first_stamp_s(PILOT) == 7.5
    assert table.called((3, 100)) == "system 3, component 100"
    assert table.lack("SYSTEM_TIME") == "it has no SYSTEM_TIME"
    stamps, texts = table.status_texts(PILOT)
    assert (stamps.shape, texts, table.custom_modes(PILOT).shape) == ((0, 4), [], (0, 5))


def test_the_first_arrival_is_by_the_position_in_the_file() -> None:
    table = Table(
        ATTITUDE=[[35, 4.5, 3, 1, 2, 0, 0, 0]],
        ATTITUDE_QUATERNION=[[55, 3.0, 3, 1, 2, 1, 0, 0, 0], [15, 9.5, 3, 1, 2, 1, 0, 0, 0]],
    )

    assert table.first_stamp_s(PILOT) == 9.5
    assert table.attitude_messages(PILOT) == ("ATTITUDE_QUATERNION", "ATTITUDE")


@pytest.mark.parametrize(("first_us", "are_utc"), [(1.26231e15, True), (1.26229e15, False), (7e9, False)])
def test_a_simulators_state_may_be_timed_by_utc(first_us: float, are_utc: bool) -> None:
    """From 2010 on, 1 262 304 000 s; `Packets` have the times in ms."""
    rows = [[10 * k, 5.0, 3, 1, first_us / 1e3 + 20 * k, 1, 0, 0, 0, 7, 8, 9] for k in range(5)]
    table = Table(HIL_STATE_QUATERNION=rows)

    assert table.attitude_messages(PILOT) == ("HIL_STATE_QUATERNION",)
    assert table.timestamps_are_utc(PILOT) is are_utc
    assert not table.timestamps_are_utc(CAMERA)
    assert table.attitude_messages(CAMERA) == ()
    own = Table(HIL_STATE_QUATERNION=rows, ATTITUDE=[[15, 5.5, 3, 1, 1, 0, 0, 0]])
    assert own.attitude_messages(PILOT) == ("ATTITUDE",)
    assert not own.timestamps_are_utc(PILOT)
    readings = clock_readings(table, PILOT)
    expected = [[10 * k, 5.0, 3, 1, first_us / 1e3 + 20 * k, first_us + 20_000 * k] for k in range(5)]
    np.testing.assert_allclose(readings, expected if are_utc else np.empty((0, 6)), rtol=1e-15)


def test_times_are_those_with_a_date() -> None:
    good = [20, 6.0, 3, 1, 700, 1.3e15]
    table = Table(
        SYSTEM_TIME=[[10, 5.0, 3, 1, 600, 1.2e15], good, [30, 7.0, 3, 1, 800, 4.2e15], [40, 8, 4, 1, 9, 1.3e15]]
    )

    np.testing.assert_array_equal(table.times(PILOT), [good])
    np.testing.assert_array_equal(clock_readings(table, PILOT), [good])


def test_messages_have_the_numbers_of_mavlink() -> None:
    assert {number: name for number, (name, _) in MESSAGES.items()} == {
        getattr(ardupilotmega, f"MAVLINK_MSG_ID_{name}"): name for name, _ in MESSAGES.values()
    }
    for name, fields in MESSAGES.values():
        known = getattr(ardupilotmega, f"MAVLink_{name.lower()}_message").fieldnames
        assert {field.partition("[")[0] for field in fields} <= set(known)
    assert packets._value(SimpleNamespace(q=[0.5 * k for k in range(12)]), "q[10]") == 5.0


def test_the_unit_of_a_time_since_boot() -> None:
    in_ms = {name for name, fields in MESSAGES.values() if fields and has_boot_ms(name)}

    assert in_ms >= {"SYSTEM_TIME", "SCALED_IMU", "SCALED_IMU2", "SCALED_IMU3", "ATTITUDE", "MOUNT_ORIENTATION"}
    assert not in_ms & {"RAW_IMU", "HIGHRES_IMU", "CAMERA_TRIGGER", "CAMERA_FEEDBACK", "HIL_STATE_QUATERNION"}
    rows = np.array([[1.0, 2.0, 3.0, 4.0, 5000.0, 6.0]])
    assert with_ms("ATTITUDE", rows.copy()).tolist() == rows.tolist()
    assert with_ms("HIL_STATE_QUATERNION", rows.copy()).tolist() == [[1.0, 2.0, 3.0, 4.0, 5.0, 6.0]]


def test_other_clocks_are_of_the_same_system_first() -> None:
    senders = [(255, 190), (3, 1), (7, 1), (3, 100)]
    table = Table(SYSTEM_TIME=[[10 * k, 5.0, *sender, 600, 1.3e15] for k, sender in enumerate(senders)])

    assert other_clocks(table, PILOT) == [(3, 100), (255, 190), (7, 1)]
    assert readings_source(7) == "SYSTEM_TIME, 7 readings"
    assert readings_source(7, "another sender") == "SYSTEM_TIME of another sender, on arrival, 7 readings"


# --- parts of the clock ---------------------------------------------------------------------------------------------
@pytest.mark.parametrize(
    ("pause_s", "filled_s"),
    [(3590.0, 570.0), (3600.0, 570.0), (3650.0, None), (0.0, 570.0), (-1.0, None)],
)
@pytest.mark.parametrize("is_later", [False, True])
def test_utc_of_another_boot_holds_within_an_hour(pause_s: float, filled_s: float | None, is_later: bool) -> None:
    """Boot 2 has no UTC; that of boot 4 is nearer than that of boots 1 and 3."""
    span = (100_000.0, 100_200.0)
    near = (span[1] + pause_s, span[1] + pause_s + 50) if is_later else (span[0] - pause_s - 50, span[0] - pause_s)
    spans = [(0.0, 10.0), span, (900_000.0, 900_010.0), near]
    utc_s, sources = np.array([300.0, np.nan, 400.0, 500.0]), ["", "", "", ""]
    _add_utc_by_recorder(utc_s, np.array([10.0, 110.0, 30.0, 40.0]), sources, spans)

    assert (None if np.isnan(utc_s[1]) else utc_s[1]) == filled_s
    assert utc_s[[0, 2, 3]].tolist() == [300.0, 400.0, 500.0]
    assert sources == ["", "the recorder's clock and the UTC of boot 4" if filled_s else "", "", ""]


@pytest.mark.parametrize(("set_s", "is_followed"), [(0.97, False), (1.03, True), (-0.97, False), (-1.03, True)])
def test_a_recorders_clock_that_was_set_is_followed(set_s: float, is_followed: bool) -> None:
    boot = np.array([0, 1, 1, 1, 1, 1, 2, 2, 2, 2, 2, 2])
    usual_s = np.where(boot == 2, 70.0, 50.0)
    arrived_s = usual_s + np.where(np.arange(12) >= 9, set_s, 0.0)
    near_s = _arrived_near_s(arrived_s, np.array([50.0, 70.0]), boot)

    np.testing.assert_allclose(near_s[:9], usual_s[:9], rtol=1e-12)
    np.testing.assert_allclose(near_s[9:], 70.0 + set_s * is_followed, rtol=1e-12)


def clock() -> VehicleClock:
    """Return a clock of two boots at positions 100 to 200 and 300 to 400; that at 250 is of no boot."""
    at = np.array([100.0, 200.0, 250.0, 300.0, 400.0])
    return VehicleClock(
        boots=(Boot(1), Boot(2)),
        at=at,
        boot_s=np.array([7.0, 8.0, 1.0, 2.0, 9000.0]),
        boot=np.array([1, 1, 0, 2, 2]),
        wraps=np.array([0, 0, 0, 0, 2]),
        later_s=np.array([0.0, 0.0, 60.0]),
        stamp_s=np.array([1007.0, 1008.0, 1040.0, 1062.5, 1070.0]),
        arrived_s=np.array([1000.0, 1001.0, 1002.0, 1060.5, 1062.0]),
        is_known=np.array([True, True]),
        utc_sources=("", ""),
        readings=np.empty((0, 6)),
    )


WRAP_S = 4_294_967.296  # 2^32 ms


def test_a_packet_is_of_the_boot_and_wrap_of_the_next_attitude() -> None:
    rows = np.array([[at, 0.0, 3, 1, 4500.0] for at in (50, 100, 150, 240, 260, 300, 350, 500)])
    clock_s, boot = clock().read(rows)

    assert boot.tolist() == [1, 1, 1, 0, 2, 2, 2, 2]
    assert clock().boot_of(rows).tolist() == boot.tolist()
    expected = [4.5, 4.5, 4.5, 4.5, 64.5, 64.5, 64.5 + 2 * WRAP_S, 64.5 + 2 * WRAP_S]
    np.testing.assert_allclose(clock_s, expected, rtol=1e-15)
    of_second, second_s = clock().of_boot(rows, 2)
    np.testing.assert_array_equal(of_second, rows[4:])
    np.testing.assert_allclose(second_s, expected[4:], rtol=1e-15)


def test_microseconds_of_32_bits_are_those_nearest_to_the_boot() -> None:
    """9000 s are twice 2^32 us and 410.065408 s."""
    wrap_us = 2**32
    low_us = [7_100_000, 7_100_000 + 3 * wrap_us, 410_565_408, wrap_us - 89_000_000, np.nan, 2_805_032_704]
    rows = np.array([[at, 0.0, 3, 1, us] for at, us in zip((100, 100, 400, 500, 100, 400), low_us, strict=True)])

    expected = [7.1, 7.1, 9000.5 + 60, 2 * 4294.967296 - 89 + 60, np.nan, 7100 + 60]
    np.testing.assert_allclose(clock().read_us(rows), expected, rtol=0, atol=1e-6)


def test_packets_of_others_are_timed_by_the_packet_that_arrived_with_them() -> None:
    rows = np.array(
        [
            [50, 1006.5, 255, 190],  # before the first
            [150, 1007.3, 255, 190],  # nearer to the one before
            [150, 1007.9, 255, 190],
            [280, 1041.0, 255, 190],  # nearer to the one of no boot before it
            [350, 1064.0, 255, 190],
            [220, 1039.0, 255, 190],  # no boot
            [500, 1071.0, 255, 190],
        ]
    )

    expected = [6.5, 7.3, 6.9, 1041.0 - 1060.5 + 60, 1064.0 - 1060.5 + 60, 37.0, 1071.0 - 1062.0 + 60]
    np.testing.assert_allclose(clock().on_arrival(rows), expected, rtol=0, atol=1e-9)


# --- the clock as a whole -------------------------------------------------------------------------------------------
FIRST_S, SECOND_S = 20.0 + 0.1 * np.arange(300), 4.0 + 0.1 * np.arange(200)


def two_boots(pause_s: float = 40.0) -> tuple[list[list[float]], Float, Float]:
    """Return the attitudes of two boots, and when the first time of each was recorded."""
    first, second = FIRST_S + 5000.0, SECOND_S + 5050.0 + pause_s - SECOND_S[0]
    return attitudes(100, FIRST_S, first) + attitudes(5005, SECOND_S, second), first, second


def test_a_clock_of_one_boot() -> None:
    rows, stamps, _ = two_boots()
    table = Table(ATTITUDE=rows[:300], SYSTEM_TIME=system_times(105, FIRST_S[::9], stamps[::9], UTC_S))
    one = VehicleClock.of(table, PILOT)

    assert one.boots == (Boot(1),)
    np.testing.assert_allclose(np.unique(one.boot_s), FIRST_S, rtol=0, atol=1e-9)
    assert set(one.boot.tolist()) == {1}
    assert one.wraps.tolist() == [0] * one.at.size
    assert one.later_s.tolist() == [0.0, 0.0]
    np.testing.assert_allclose(one.arrived_s, 5000.0, rtol=0, atol=1e-9)
    np.testing.assert_allclose(one.stamp_s - one.boot_s, 5000.0, rtol=0, atol=1e-9)
    assert (one.is_known.tolist(), one.utc_sources, one.notes) == ([True], ("",), ())
    np.testing.assert_array_equal(one.readings, table.message("SYSTEM_TIME"))


def test_the_clock_of_a_second_boot_goes_on_by_utc() -> None:
    rows, first, second = two_boots()
    times = system_times(105, FIRST_S[::9], first[::9], UTC_S) + system_times(
        5010, SECOND_S[::9], second[::9], UTC_S + 97
    )
    two = VehicleClock.of(Table(ATTITUDE=rows, SYSTEM_TIME=times), PILOT)

    assert [boot.number for boot in two.boots] == [1, 2]
    assert [boot.doubt for boot in two.boots] == ["", ""]
    np.testing.assert_allclose(two.later_s, [0.0, 0.0, 97.0], rtol=0, atol=1e-6)
    assert (two.is_known.tolist(), two.utc_sources) == ([True, True], ("", ""))
    clock_s, boot = two.read(two.readings)
    np.testing.assert_allclose(two.readings[:, 5] * 1e-6 - clock_s, UTC_S, rtol=0, atol=1e-6)
    assert set(boot.tolist()) == {1, 2}


def test_a_boot_without_utc_has_that_of_another_sender_on_arrival() -> None:
    rows, first, second = two_boots()
    times = system_times(105, FIRST_S[::9], first[::9], UTC_S)
    ground = [[5010 + 10 * k, stamp, *GROUND, 0, 1e6 * (UTC_S + stamp - 4000)] for k, stamp in enumerate(second[:4])]
    two = VehicleClock.of(Table(ATTITUDE=rows, SYSTEM_TIME=times + ground), PILOT)

    # The second boot began at 5086 s of the recorder's clock: UTC minus its time since boot is UTC_S + 1086.
    np.testing.assert_allclose(two.later_s, [0.0, 0.0, 1086.0], rtol=0, atol=1e-6)
    assert two.utc_sources == ("", "SYSTEM_TIME of system 255, component 190, on arrival, 4 readings")
    assert two.is_known.tolist() == [True, True]


def test_a_boot_without_utc_has_that_of_the_other_boot_by_the_recorder() -> None:
    rows, first, _ = two_boots()
    times = system_times(105, FIRST_S[::9], first[::9], UTC_S)
    two = VehicleClock.of(Table(ATTITUDE=rows, SYSTEM_TIME=times), PILOT)

    np.testing.assert_allclose(two.later_s, [0.0, 0.0, 86.0], rtol=0, atol=1e-6)
    assert two.utc_sources == ("", "the recorder's clock and the UTC of boot 1")
    assert two.is_known.tolist() == [True, True]
    assert [boot.doubt for boot in two.boots] == ["", ""]

    rows, first, _ = two_boots(pause_s=3700.0)
    far = VehicleClock.of(Table(ATTITUDE=rows, SYSTEM_TIME=times), PILOT)
    assert far.is_known.tolist() == [True, False]
    assert far.utc_sources == ("", "")
    assert [boot.doubt for boot in far.boots] == [
        "",
        "no SYSTEM_TIME during this boot, and no other boot was recorded within an hour of it",
    ]


def test_boots_without_any_utc_are_related_by_the_recorder() -> None:
    rows, _, _ = two_boots()
    two = VehicleClock.of(Table(ATTITUDE=rows), PILOT)

    np.testing.assert_allclose(two.later_s, [0.0, 0.0, 86.0], rtol=0, atol=1e-6)
    assert (two.is_known.tolist(), two.utc_sources) == ([True, True], ("", ""))
    assert two.readings.shape == (0, 6)


def test_a_time_since_boot_of_32_bits_wraps_around() -> None:
    boot_s = WRAP_S - 30.0 + 0.1 * np.arange(600)
    stamps = boot_s + 700.0
    table = Table(
        ATTITUDE=attitudes(100, boot_s % WRAP_S, stamps),
        SYSTEM_TIME=[
            [105 + 50 * k, stamps[5 * k], *PILOT, 1e3 * (boot_s[5 * k] % WRAP_S), 1e6 * (UTC_S + boot_s[5 * k])]
            for k in range(120)
        ],
    )
    one = VehicleClock.of(table, PILOT)

    assert one.boots == (Boot(1),)
    np.testing.assert_allclose(one.boot_s[one.at % 10 == 0], boot_s, rtol=0, atol=1e-6)
    assert set(one.wraps.tolist()) == {0, 1}
    clock_s, _ = one.read(one.readings)
    np.testing.assert_allclose(one.readings[:, 5] * 1e-6 - clock_s, UTC_S, rtol=0, atol=1e-6)


@pytest.mark.parametrize(("off_s", "is_kept"), [(1.07, True), (1.13, False), (-1.07, True), (-1.13, False)])
def test_a_time_since_boot_far_from_its_neighbours_is_damaged(off_s: float, is_kept: bool) -> None:
    """By more than a second from the nearest neighbour, which is 0.1 s away."""
    boot_s = FIRST_S.copy()
    boot_s[50] += off_s
    one = VehicleClock.of(Table(ATTITUDE=attitudes(100, boot_s, FIRST_S + 5000)), PILOT)

    assert (600.0 in one.at) is is_kept
    assert one.at.size == 299 + is_kept


@pytest.mark.parametrize(("back_s", "boots"), [(4.8, 1), (5.2, 2)])
def test_a_time_since_boot_that_goes_back_by_five_seconds_is_a_reboot(back_s: float, boots: int) -> None:
    boot_s = FIRST_S - np.where(np.arange(300) >= 150, back_s + 0.1, 0.0)
    two = VehicleClock.of(Table(ATTITUDE=attitudes(100, boot_s, boot_s + 5000)), PILOT)
    assert len(two.boots) == boots


# --- the bytes of a file --------------------------------------------------------------------------------------------
STAMP_US = 1_700_000_000_000_000


def packed(yaw_rad: float, v1: bool = False, sender: tuple[int, int] = PILOT) -> bytes:
    message = common.MAVLink_attitude_message(1500, 0.25, -0.5, yaw_rad, 0.0, 0.0, 0.0)
    return bytes(message.pack(common.MAVLink(None, *sender), force_mavlink1=v1))


def stamped(packet: bytes, stamp_us: int = STAMP_US) -> bytes:
    return struct.pack(">Q", stamp_us) + packet


@pytest.mark.parametrize("v1", [False, True])
def test_packets_of_both_versions_are_found(tmp_path: Path, v1: bool) -> None:
    path = tmp_path / "two.tlog"
    signed = bytearray(packed(0.5))
    signed[2] = 1
    text = common.MAVLink_statustext_message(4, b"hello").pack(common.MAVLink(None, *PILOT), force_mavlink1=v1)
    beat = common.MAVLink_heartbeat_message(2, 12, 0, 0x4030000, 4, 3).pack(common.MAVLink(None, *PILOT))
    parts = [stamped(packed(0.5, v1)), b"\xfd\xfe\1" * 5, stamped(packed(0.75, v1), STAMP_US + 2_500_000)]
    parts += [stamped(bytes(text), STAMP_US + 3_000_000), stamped(bytes(beat), STAMP_US + 4_000_000)]
    parts += [stamped(packed(1.0, v1), STAMP_US + 5_000_000), stamped(packed(9.0))[:-1]]
    path.write_bytes(b"".join(parts))
    log = LogPackets(str(path))

    size = [len(part) for part in parts]
    start = np.cumsum([0, *size])
    assert log.count == 5
    assert log.whole_bytes == start[6]
    assert log.unread_bytes == size[1] + size[6]
    assert [log.amount(name) for name in ("ATTITUDE", "HEARTBEAT", "STATUSTEXT", "RAW_IMU")] == [3, 1, 1, 0]
    yaws = ((0, 0.0, 0.5), (2, 2.5, 0.75), (5, 5.0, 1.0))
    expected = [[start[part], 1.7e9 + late, 3, 1, 1500, 0.25, -0.5, yaw] for part, late, yaw in yaws]
    np.testing.assert_allclose(log.message("ATTITUDE"), expected, rtol=1e-12)
    assert log.message("RAW_IMU").shape == (0, 8)
    assert (log.texts(PILOT), log.texts(CAMERA)) == (["hello"], [])
    stamps, texts = log.status_texts(PILOT)
    np.testing.assert_allclose(stamps, [[start[3], 1.7e9 + 3, 3, 1]], rtol=1e-15)
    assert texts == ["hello"]
    assert log.status_texts(CAMERA)[0].shape == (0, 4)
    np.testing.assert_allclose(log.custom_modes(PILOT), [[start[4], 1.7e9 + 4, 3, 1, 0x4030000]], rtol=1e-15)
    assert log.custom_modes(CAMERA).shape == (0, 5)
    np.testing.assert_allclose(log.message("HEARTBEAT"), [[start[4], 1.7e9 + 4, 3, 1, 12, 2]], rtol=1e-15)


def test_a_signed_packet_is_longer_and_an_unknown_flag_is_none() -> None:
    packet = bytearray(packed(0.5))
    size = 8 + len(packet)
    whole = stamped(bytes(packet)) + b"x" * 20
    assert packets._stop(whole, 0) == size
    assert packets._stop(whole[:size], 0) == size
    assert packets._stop(whole[: size - 1], 0) is None
    signed = bytearray(whole)
    signed[10] = 1
    assert packets._stop(bytes(signed), 0) == size + 13
    assert packets._stop(bytes(signed)[: size + 12], 0) is None
    signed[10] = 2
    assert packets._stop(bytes(signed), 0) is None
    signed[8] = 0xFE  # of version 1: 8 bytes beside the payload
    assert packets._stop(bytes(signed), 0) == 8 + 8 + packet[1]
    signed[8] = 0xFC
    assert packets._stop(bytes(signed), 0) is None
    empty = stamped(b"\xfe\0" + bytes(6))
    assert (packets._stop(empty, 0), packets._stop(empty[:-1], 0)) == (16, None)
    assert packets._stop(b"." + empty, 1) == 17


def test_the_number_of_a_message_has_three_bytes_in_version_2() -> None:
    head = bytearray(stamped(packed(0.5)))
    head[15:18] = b"\x01\x02\x03"
    assert packets._number(bytes(head), 0) == 0x030201
    assert packets._number(b"abc" + stamped(packed(0.5, v1=True)), 3) == 30


@pytest.mark.parametrize(
    ("head", "is_log"),
    [
        (stamped(packed(0.5)), True),
        (stamped(packed(0.5, v1=True)), True),
        (stamped(packed(0.5), 946_684_800_000_000), True),  # 2000
        (stamped(packed(0.5), 946_684_799_999_999), False),
        (stamped(packed(0.5), 4_102_444_799_999_999), True),  # 2100
        (stamped(packed(0.5), 4_102_444_800_000_000), False),
        (stamped(b"\xfc" + packed(0.5)[1:]), False),
        (stamped(packed(0.5))[:9], True),
        (stamped(packed(0.5))[:8], False),
        (b"", False),
    ],
)
def test_a_telemetry_log_begins_with_a_time_and_a_packet(head: bytes, is_log: bool) -> None:
    assert is_telemetry_log(head) is is_log


@pytest.mark.parametrize(
    ("stamps_us", "is_log"),
    [
        ((STAMP_US, STAMP_US + 1, STAMP_US + 2), True),
        ((STAMP_US, STAMP_US + 1), False),
        ((STAMP_US, STAMP_US + 3_600_000_000, STAMP_US), True),
        ((STAMP_US, STAMP_US + 3_600_000_001, STAMP_US), False),
        ((STAMP_US, STAMP_US, STAMP_US - 3_600_000_001), False),
        ((946_684_800_000_000, 946_684_800_000_001, 946_684_799_999_999), False),
        ((4_102_444_799_999_998, 4_102_444_799_999_999, 4_102_444_800_000_000), False),
        ((946_684_800_000_000,) * 3, True),
        ((4_102_444_799_999_999,) * 3, True),
    ],
)
@pytest.mark.parametrize("junk", [b"j", b"junk" * 7])
def test_three_packets_in_a_row_are_a_telemetry_log(stamps_us: tuple[int, ...], is_log: bool, junk: bytes) -> None:
    assert is_telemetry_log(junk + b"".join(stamped(packed(0.5), stamp) for stamp in stamps_us)) is is_log


def test_reading_goes_on_after_damage_at_three_packets_or_the_end(tmp_path: Path) -> None:
    """A byte of damage among others that may be the head of a packet."""
    path = tmp_path / "damaged.tlog"
    good = [stamped(packed(0.1 * k), STAMP_US + k) for k in range(1, 8)]
    path.write_bytes(good[0] + good[1] + b"\xfe" + b"".join(good[2:5]) + b"\xfd" * 3 + good[5] + good[6])
    log = LogPackets(str(path))

    assert log.count == 7
    assert log.unread_bytes == 4
    np.testing.assert_allclose(log.message("ATTITUDE")[:, -1], 0.1 * np.arange(1, 8), rtol=1e-6)
