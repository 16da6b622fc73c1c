"""What is read of MAVLink packets in memory: senders, attitude, places, cameras, modes; and streams."""

import struct
from pathlib import Path

import numpy as np
import pytest
from pymavlink.dialects.v20 import common
from scipy.spatial.transform import Rotation

from glstar.arrays import Float
from glstar.errors import LogFormatError
from glstar.flight import EventKind
from glstar.telemetry import source
from glstar.telemetry.mavlink import packets, tlog
from glstar.telemetry.mavlink.tlog import TelemetryLogReader, is_mavlink_stream
from tests.telemetry.test_mavlinkclock import COLUMNS, Table, packed

nan = np.nan
UTC_S = 1710068400.0
CLOCK_S = 30.0 + 0.1 * np.arange(60)
STAMP_S = UTC_S - 25  # arrival minus time since boot
PILOT, MATE, OTHER, GROUND = (3, 1), (3, 100), (5, 1), (255, 190)


class Packets(Table):
    """Packets in memory, with texts and modes."""

    count, whole_bytes, unread_bytes = 77, 900, 7

    def __init__(
        self,
        texts: list[tuple[float, packets.Sender, str]] = (),
        modes: list[tuple[float, packets.Sender, int]] = (),
        **rows: Float,
    ) -> None:
        super().__init__(**rows)
        self._texts, self._modes = list(texts), list(modes)

    def texts(self, sender: packets.Sender) -> list[str]:
        return [text for _, of, text in self._texts if of == sender]

    def status_texts(self, sender: packets.Sender) -> tuple[Float, list[str]]:
        rows = [[at(boot_s), boot_s + STAMP_S, *of] for boot_s, of, _ in self._texts if of == sender]
        return np.array(rows, dtype=np.float64).reshape(-1, 4), self.texts(sender)

    def custom_modes(self, sender: packets.Sender) -> Float:
        rows = [[at(boot_s), boot_s + STAMP_S, *of, mode] for boot_s, of, mode in self._modes if of == sender]
        return np.array(rows, dtype=np.float64).reshape(-1, 5)


class Reader(TelemetryLogReader):
    """A reader of packets in memory."""

    def __init__(self, given: packets.Packets, **options: object) -> None:
        self._given = given
        super().__init__("log.tlog", **options)

    def _open(self) -> packets.Packets:
        return self._given


def at(boot_s: float) -> float:
    """Return the position in the file of a packet that arrives at a time since boot."""
    return round(1000 * boot_s)


def rows(name: str, *fields: object, boot_s: Float = CLOCK_S, sender: packets.Sender = PILOT) -> Float:
    """Return packets of a message that arrive at these times since boot, with these fields."""
    columns = [1000.0 * boot_s, boot_s + STAMP_S, *sender, *fields]
    table = np.column_stack([np.broadcast_to(column, boot_s.shape) for column in columns])
    assert table.shape[1] == COLUMNS[name]
    return table


def euler(yaw_rad: object = 0.5, **more: object) -> Float:
    boot_s = more.get("boot_s", CLOCK_S)
    return rows("ATTITUDE", 1e3 * boot_s, -0.3, 0.2, yaw_rad, **more)


TURN = Rotation.from_euler("ZYX", np.column_stack([0.5 + 0.01 * np.arange(60), [0.2] * 60, [-0.3] * 60]))


def quaternion(rotation: Rotation = TURN, boot_s: Float = CLOCK_S) -> Float:
    q = rotation.as_quat()[:, [3, 0, 1, 2]]
    return rows("ATTITUDE_QUATERNION", 1e3 * boot_s, *q.T, boot_s=boot_s)


def beats(autopilot: int = 3, kind: int = 1, sender: packets.Sender = PILOT) -> Float:
    return rows("HEARTBEAT", autopilot, kind, boot_s=CLOCK_S[::10], sender=sender)


def utc(off_s: float = UTC_S - 30, sender: packets.Sender = PILOT, boot_s: Float = CLOCK_S[::5]) -> Float:
    return rows("SYSTEM_TIME", 1e3 * boot_s, 1e6 * (boot_s + off_s), boot_s=boot_s, sender=sender)


def batches(given: packets.Packets, **options: object) -> dict[type, list[source.Samples]]:
    found: dict[type, list[source.Samples]] = {}
    for batch in Reader(given, **options).samples():
        found.setdefault(type(batch), []).append(batch)
    return found


def refusal(act: object, *arguments: object, **more: object) -> str:
    with pytest.raises(LogFormatError) as caught:
        act(*arguments, **more)
    assert caught.value.offset == 900
    return str(caught.value).removeprefix("log.tlog: ")


def same(q: Float, rotation: Rotation) -> bool:
    expected = rotation.inv().as_quat()[:, [3, 0, 1, 2]]
    return bool(np.allclose(np.abs(np.sum(q * expected, axis=-1)), 1.0, rtol=0, atol=1e-9))


# --- attitude -------------------------------------------------------------------------------------------------------
def test_the_attitude_of_quaternions_or_angles() -> None:
    [samples] = batches(Packets(ATTITUDE_QUATERNION=quaternion(), SYSTEM_TIME=utc()))[source.AttitudeSamples]
    np.testing.assert_allclose(samples.clock_s, CLOCK_S, rtol=0, atol=1e-9)
    assert same(samples.q_body_ned, TURN)
    assert (samples.source, samples.break_reason, samples.notes) == (
        "ATTITUDE_QUATERNION",
        "a reboot of the autopilot",
        (),
    )
    assert samples.segment.tolist() == [0] * 60
    angles = euler(0.5 + 0.01 * np.arange(60))
    angles[3, 6] = nan
    [samples] = batches(Packets(ATTITUDE=angles))[source.AttitudeSamples]
    assert same(samples.q_body_ned, TURN[np.delete(np.arange(60), 3)])
    assert samples.source == "ATTITUDE"
    names = [name for name, _ in Reader(Packets(ATTITUDE=angles, ATTITUDE_QUATERNION=quaternion())).attitudes()]
    assert names == ["ATTITUDE_QUATERNION", "ATTITUDE"]


@pytest.mark.parametrize(("sparse", "chosen"), [(30, "ATTITUDE_QUATERNION"), (29, "ATTITUDE")])
def test_angles_are_used_if_they_are_more_than_twice_as_frequent(sparse: int, chosen: str) -> None:
    few = quaternion(TURN[:sparse], CLOCK_S[:sparse])
    given = Packets(ATTITUDE=euler(), ATTITUDE_QUATERNION=few)
    assert batches(given)[source.AttitudeSamples][0].source == chosen
    for name in ("ATTITUDE", " attitude_quaternion"):
        assert batches(given, attitude=name)[source.AttitudeSamples][0].source == name.strip().upper()
    said = "the log has no attitude 'x'; it has ATTITUDE and ATTITUDE_QUATERNION"
    assert refusal(batches, given, attitude="x") == said


@pytest.mark.parametrize(("unaligned", "is_reported"), [(10, False), (12, True)])
def test_samples_before_the_alignment_are_left_out(unaligned: int, is_reported: bool) -> None:
    late = quaternion()
    late[:unaligned, 5:9] = [1.0, 0.0, 0.0, 0.0]
    [samples] = batches(Packets(ATTITUDE_QUATERNION=late, ATTITUDE=euler()))[source.AttitudeSamples]
    np.testing.assert_allclose(samples.clock_s, CLOCK_S[unaligned:], rtol=0, atol=1e-9)
    head = "the first 1.1 s of ATTITUDE_QUATERNION are left out, before its estimator was aligned: 4.8 s remain"
    assert samples.notes == ((f"{head}; --attitude ATTITUDE covers 5.9 s",) if is_reported else ())
    [alone] = batches(Packets(ATTITUDE_QUATERNION=late))[source.AttitudeSamples]
    assert alone.notes == ((head,) if is_reported else ())
    late[:, 5:9] = [1.0, 0.0, 0.0, 0.0]
    assert batches(Packets(ATTITUDE_QUATERNION=late))[source.AttitudeSamples][0].clock_s.size == 0


def test_the_state_of_a_simulator() -> None:
    q = TURN.as_quat()[:, [3, 0, 1, 2]]
    state = rows("HIL_STATE_QUATERNION", 1e3 * CLOCK_S, *q.T, -345000000, 1385000000, 50500)
    found = batches(Packets(HIL_STATE_QUATERNION=state, SYSTEM_TIME=utc()))
    [samples] = found[source.AttitudeSamples]
    assert same(samples.q_body_ned, TURN)
    simulated = "the attitude is a simulator's own state (HIL_STATE_QUATERNION), not an estimate of an autopilot"
    assert (samples.source, samples.notes) == ("HIL_STATE_QUATERNION", (simulated,))
    [place] = found[source.PositionSamples]
    assert (place.source, place.clock_s.size, place.height_m[0]) == ("HIL_STATE_QUATERNION", 60, 50.5)
    own = Packets(HIL_STATE_QUATERNION=state, ATTITUDE=euler(), SYSTEM_TIME=utc())
    assert batches(own)[source.AttitudeSamples][0].source == "ATTITUDE"


# --- senders --------------------------------------------------------------------------------------------------------
def test_the_vehicle_is_the_first_autopilot_or_the_named_system() -> None:
    both = np.concatenate(
        [euler(sender=MATE), euler(0.9, sender=OTHER, boot_s=CLOCK_S + 0.01), euler(boot_s=CLOCK_S + 0.02)]
    )
    hearts = np.concatenate([beats(sender=OTHER), beats(kind=2), beats(8, sender=MATE)])
    given = Packets(ATTITUDE=both, HEARTBEAT=hearts)
    assert Reader(given)._vehicle() == (OTHER, [5, 3])
    assert Reader(given, sysid=3)._vehicle() == (PILOT, [5, 3])
    said = "the log has no attitude of system 7 (sysid); it has that of system 5 and 3"
    assert refusal(Reader(given, sysid=7)._vehicle) == said
    assert batches(given)[source.AttitudeSamples][0].source == "ATTITUDE of system 5 (of 5 and 3; sysid chooses)"
    assert Reader(given).facts().vehicle == "ArduPlane, system 5 of 5 and 3"
    assert Reader(given, sysid=3).facts().vehicle == "ArduCopter, system 3 of 5 and 3"
    # Without heartbeats any sender is a candidate, and component 1 is preferred.
    assert Reader(Packets(ATTITUDE=both))._vehicle() == (PILOT, [3, 5])
    assert Reader(Packets(ATTITUDE=euler(sender=MATE)))._vehicle() == (MATE, [3])
    simulated = rows("HIL_STATE_QUATERNION", 1e3 * CLOCK_S, 1, 0, 0, 0, 1, 2, 3, sender=OTHER)
    own = rows("HIL_STATE_QUATERNION", 1e3 * CLOCK_S, 1, 0, 0, 0, 1, 2, 3)
    assert Reader(Packets(ATTITUDE=euler(), HIL_STATE_QUATERNION=np.concatenate([own, simulated])))._vehicle() == (
        PILOT,
        [3, 5],
    )
    none = "the log has no attitude: no ATTITUDE_QUATERNION or ATTITUDE in 77 packets"
    assert refusal(Reader(Packets())._vehicle) == none


TEXTS = [(30.0, PILOT, "ArduSub V4.1 x"), (31.0, PILOT, "ArduSub V4.2 y\0"), (32.0, MATE, "Rover V1.0")]
VERSIONS = rows("AUTOPILOT_VERSION", np.array([0x01020300, 0x04050640, 0]), boot_s=CLOCK_S[:3])


@pytest.mark.parametrize(
    ("given", "vehicle", "firmware"),
    [
        (Packets(ATTITUDE=euler()), None, None),
        (Packets(ATTITUDE=euler(), HEARTBEAT=beats(12, 2)), "PX4 quadrotor", None),
        (Packets(TEXTS, ATTITUDE=euler()), None, "ArduSub V4.2 y"),
        (
            Packets(ATTITUDE=euler(), HEARTBEAT=beats(), AUTOPILOT_VERSION=VERSIONS),
            "ArduPlane",
            "ArduPlane v4.5.6-alpha",
        ),
        (Packets(ATTITUDE=euler(), AUTOPILOT_VERSION=rows("AUTOPILOT_VERSION", 0.0)), None, None),
        (Packets(ATTITUDE=euler(), AUTOPILOT_VERSION=rows("AUTOPILOT_VERSION", 0x04050640)), None, "v4.5.6-alpha"),
    ],
)
def test_vehicle_and_firmware(given: Packets, vehicle: str | None, firmware: str | None) -> None:
    facts = Reader(given).facts()
    assert facts == source.LogFacts("MAVLink telemetry log", vehicle, firmware)
    assert facts.unread_bytes == 7


# --- position and UTC -----------------------------------------------------------------------------------------------
PLACE = (-345000000, 1385000000, 50500)


def test_positions_of_the_estimator_or_the_receiver() -> None:
    own = rows("GLOBAL_POSITION_INT", 1e3 * CLOCK_S + 50, *PLACE)
    fixes = rows("GPS_RAW_INT", np.arange(60) // 15, -355000000, 1395000000, 60500)
    given = {"ATTITUDE": euler(), "SYSTEM_TIME": utc()}
    [place] = batches(Packets(**given, GLOBAL_POSITION_INT=own, GPS_RAW_INT=fixes))[source.PositionSamples]
    np.testing.assert_allclose(place.clock_s, CLOCK_S + 0.05, rtol=0, atol=1e-9)
    assert np.rad2deg([place.latitude_rad[0], place.longitude_rad[0]]).tolist() == pytest.approx([-34.5, 138.5])
    assert (place.height_m[0], place.source) == (50.5, "GLOBAL_POSITION_INT")
    zeros = rows("GLOBAL_POSITION_INT", 1e3 * CLOCK_S, 0, 0, 0)
    [place] = batches(Packets(**given, GLOBAL_POSITION_INT=zeros, GPS_RAW_INT=fixes))[source.PositionSamples]
    np.testing.assert_allclose(place.clock_s, CLOCK_S[45:], rtol=0, atol=1e-6)
    assert (place.height_m[0], place.source) == (60.5, "GPS_RAW_INT")
    fixes[:, 4] = 2
    for more, why in (
        (
            {"GLOBAL_POSITION_INT": zeros, "GPS_RAW_INT": fixes},
            "its GLOBAL_POSITION_INT and GPS_RAW_INT never had a position",
        ),
        ({"GPS_RAW_INT": fixes}, "its GPS_RAW_INT never had a position"),
        ({}, "it has no GLOBAL_POSITION_INT"),
    ):
        assert batches(Packets(**given, **more))[source.PositionSamples][0].source == why


def clock(given: Packets, **options: object) -> source.ClockSamples:
    return batches(given, **options)[source.ClockSamples][0]


def test_utc_of_the_autopilot_of_others_or_of_none() -> None:
    own = clock(Packets(ATTITUDE=euler(), SYSTEM_TIME=utc()))
    np.testing.assert_allclose(own.utc_s - own.clock_s, UTC_S - 30, rtol=0, atol=1e-5)
    assert (own.source, own.notes, own.clock_s.size) == ("SYSTEM_TIME, 12 readings", (), 12)
    ground = rows("SYSTEM_TIME", 0.0, 1e6 * (CLOCK_S[::5] + UTC_S - 30 + 0.5), boot_s=CLOCK_S[::5], sender=GROUND)
    other = clock(Packets(ATTITUDE=euler(), SYSTEM_TIME=ground))
    np.testing.assert_allclose(other.utc_s - other.clock_s, UTC_S - 29.5, rtol=0, atol=1e-5)
    assert other.source == "SYSTEM_TIME of system 255, component 190, on arrival, 12 readings"
    recorded = "; the recorder's own clock said 2024-03-10T11:00:05.000000Z"
    assert clock(Packets(ATTITUDE=euler())).source == f"it has no SYSTEM_TIME{recorded}"
    old = Packets(ATTITUDE=euler(), SYSTEM_TIME=utc(1e9))
    assert clock(old).source == f"no SYSTEM_TIME after 2010{recorded}"
    undated = euler()
    undated[:, 1] -= UTC_S
    assert clock(Packets(ATTITUDE=undated)).source == "it has no SYSTEM_TIME"


def test_utc_of_several_boots_names_their_sources() -> None:
    second = CLOCK_S + 3600 * 2
    again = rows("ATTITUDE", 1e3 * CLOCK_S, -0.3, 0.2, 0.5, boot_s=second)
    given = {"ATTITUDE": np.concatenate([euler(), again])}
    near = rows("ATTITUDE", 1e3 * CLOCK_S, -0.3, 0.2, 0.5, boot_s=CLOCK_S + 100)
    two = Packets(ATTITUDE=np.concatenate([euler(), near]), SYSTEM_TIME=utc())
    assert clock(two).source == "SYSTEM_TIME, 12 readings; boot 2: the recorder's clock and the UTC of boot 1"
    assert clock(two, boot=2).source == "the recorder's clock and the UTC of boot 1"
    far = Packets(**given, SYSTEM_TIME=utc())
    lone = clock(far, boot=2)
    why = "no SYSTEM_TIME during this boot, and no other boot was recorded within an hour of it"
    assert (lone.source, lone.utc_s.size) == (why, 0)
    assert clock(far, boot=1).source == "SYSTEM_TIME, 12 readings"
    found = batches(two)
    assert [batch.boot for batch in found[source.AttitudeSamples]] == [1, 2]
    assert [batch.boot for batch in found[source.PositionSamples]] == [1, 2]
    assert [batch.boot for batch in found[source.ClockSamples]] == [1]
    np.testing.assert_allclose(found[source.AttitudeSamples][1].clock_s, CLOCK_S + 100, rtol=0, atol=1e-6)


# --- gyros ----------------------------------------------------------------------------------------------------------
def test_the_most_frequent_rates_as_often_as_the_attitude() -> None:
    raw = rows("RAW_IMU", 1e6 * CLOCK_S, 100, -200, 300)
    scaled = rows("SCALED_IMU2", 1e3 * CLOCK_S, 400, 500, -600)
    given = {"ATTITUDE": euler(), "HEARTBEAT": beats()}
    [rates] = batches(Packets(**given, RAW_IMU=raw, SCALED_IMU2=scaled))[source.RateSamples]
    assert rates.source == "RAW_IMU"
    np.testing.assert_allclose(rates.rate_rad_per_s, np.tile([0.1, -0.2, 0.3], (60, 1)), rtol=1e-12)
    np.testing.assert_allclose(rates.clock_s, CLOCK_S, rtol=0, atol=1e-9)
    px4 = {"ATTITUDE": euler(), "HEARTBEAT": beats(12)}
    [rates] = batches(Packets(**px4, RAW_IMU=raw, SCALED_IMU2=scaled))[source.RateSamples]
    assert rates.source == "SCALED_IMU2"
    np.testing.assert_allclose(rates.rate_rad_per_s, np.tile([0.4, 0.5, -0.6], (60, 1)), rtol=1e-12)
    assert source.RateSamples not in batches(Packets(**px4, RAW_IMU=raw))
    assert source.RateSamples not in batches(Packets(**given, RAW_IMU=raw[:59]))
    high = rows("HIGHRES_IMU", 1e6 * CLOCK_S, 0.5, nan, 0.7)
    high[10:, 6] = 0.6
    high[20, 7] = 1e3
    [rates] = batches(Packets(**px4, HIGHRES_IMU=high))[source.RateSamples]
    np.testing.assert_allclose(rates.clock_s, np.delete(CLOCK_S[10:], 10), rtol=0, atol=1e-9)
    np.testing.assert_allclose(rates.rate_rad_per_s[0], [0.5, 0.6, 0.7], rtol=1e-12)


# --- cameras --------------------------------------------------------------------------------------------------------
SHOTS_S = np.array([31.0, 32.0, 33.0, 34.0])
ON_ARRIVAL = "their packets' arrival dates them, after the exposure"


def triggers(**more: Float) -> list[tuple[str, list[float], list[float], list[int] | None, tuple[str, ...]]]:
    found = batches(Packets(ATTITUDE=euler(), SYSTEM_TIME=utc(), **more)).get(source.TriggerSamples, [])
    assert all((one.clock_error_s, one.boot) == (60.0, 1) for one in found)
    return [
        (
            f"{one.source} {one.camera}",
            np.round(one.clock_s, 6).tolist(),
            np.round(one.utc_s - UTC_S, 3)[np.isfinite(one.utc_s)].tolist(),
            None if one.number is None else one.number.tolist(),
            one.notes,
        )
        for one in found
    ]


def test_feedback_of_cameras_has_time_since_boot_utc_or_none() -> None:
    boot_us = 1e6 * (SHOTS_S - 0.25)
    of = rows("CAMERA_FEEDBACK", boot_us, np.array([7, 8, 9, 10]), 0, boot_s=SHOTS_S)
    times_s = [30.75, 31.75, 32.75, 33.75]
    assert triggers(CAMERA_FEEDBACK=of) == [("CAMERA_FEEDBACK camera:0", times_s, [], [7, 8, 9, 10], ())]
    twice = np.concatenate([of, of[1:2] + np.array([5, 0.01, 0, 0, 0, 0, 0])])
    assert triggers(CAMERA_FEEDBACK=twice)[0][1] == times_s
    dated = of.copy()
    dated[:, 4] = 1e6 * (UTC_S + SHOTS_S)
    assert triggers(CAMERA_FEEDBACK=dated)[0][1:4] == (SHOTS_S.tolist(), SHOTS_S.tolist(), [7, 8, 9, 10])
    none = of.copy()
    none[:2, 4] = 0.0
    note = f"2 of 4 triggers of camera:0 have no time in CAMERA_FEEDBACK: {ON_ARRIVAL}"
    assert triggers(CAMERA_FEEDBACK=none)[0][1:] == ([31.0, 32.0, 32.75, 33.75], [], [7, 8, 9, 10], (note,))
    two = of.copy()
    two[:, 6] = [0, 1, 0, 1]
    two[:, 5] = [3, 65535, 1, 0]
    lost = "1 of the images 1 to 3 of camera:0 are missing in CAMERA_FEEDBACK: packets were lost"
    assert triggers(CAMERA_FEEDBACK=two) == [
        ("CAMERA_FEEDBACK camera:0", [32.75, 30.75], [], [1, 3], (lost,)),
        ("CAMERA_FEEDBACK camera:1", [31.75, 33.75], [], [65535, 65536], ()),
    ]
    same_number = of.copy()
    same_number[:, 5] = [7, 7, 8, 9]
    assert triggers(CAMERA_FEEDBACK=same_number)[0][1:4] == (times_s, [], None)
    strange = np.concatenate([of, rows("CAMERA_FEEDBACK", 5e6, 3, 0, boot_s=SHOTS_S[:1] + 0.5, sender=OTHER)])
    assert triggers(CAMERA_FEEDBACK=strange)[0][1] == times_s


@pytest.mark.parametrize(("late_s", "is_used"), [(59.0, True), (61.0, False)])
def test_a_time_since_boot_is_within_a_minute_of_its_arrival(late_s: float, is_used: bool) -> None:
    of = rows("CAMERA_FEEDBACK", 1e6 * (SHOTS_S + late_s), np.arange(4), 0, boot_s=SHOTS_S)
    [(_, clock_s, _, _, notes)] = triggers(CAMERA_FEEDBACK=of)
    assert clock_s == ((SHOTS_S + late_s) if is_used else SHOTS_S).tolist()
    assert bool(notes) is not is_used


def test_captured_images_of_an_autopilot_and_of_a_camera() -> None:
    fields = (0.0, np.arange(4) + 5, 0, 1e3 * (SHOTS_S - 0.25), np.array([1, 1, 0, 1]))
    own = rows("CAMERA_IMAGE_CAPTURED", *fields, boot_s=SHOTS_S)
    failed = "1 of 4 captures of camera:0 (CAMERA_IMAGE_CAPTURED) failed and are left out"
    expected = ("CAMERA_IMAGE_CAPTURED camera:0", [30.75, 31.75, 33.75], [], [5, 6, 8], (failed,))
    assert triggers(CAMERA_IMAGE_CAPTURED=own) == [expected]
    # The time since boot of a component of its own is of another clock; its number is the camera's.
    of_mate = rows("CAMERA_IMAGE_CAPTURED", *fields[:4], 1, boot_s=SHOTS_S, sender=MATE)
    note = f"4 of 4 triggers of camera:100 have no time in CAMERA_IMAGE_CAPTURED: {ON_ARRIVAL}"
    assert triggers(CAMERA_IMAGE_CAPTURED=of_mate) == [
        ("CAMERA_IMAGE_CAPTURED camera:100", SHOTS_S.tolist(), [], [5, 6, 7, 8], (note,))
    ]
    of_mate[:, 6] = 2
    of_mate[:, 4] = 1e6 * (UTC_S + 7)
    assert triggers(CAMERA_IMAGE_CAPTURED=of_mate)[0][:3] == (
        "CAMERA_IMAGE_CAPTURED camera:2",
        SHOTS_S.tolist(),
        [7.0] * 4,
    )


def test_sent_triggers_are_of_one_camera() -> None:
    sent = rows("CAMERA_TRIGGER", 1e6 * (SHOTS_S - 0.25), np.array([70000, 70001, 70003, 70004]), boot_s=SHOTS_S)
    lost = "1 of the images 70000 to 70004 of camera are missing in CAMERA_TRIGGER: packets were lost"
    expected = ("CAMERA_TRIGGER camera", [30.75, 31.75, 32.75, 33.75], [], [70000, 70001, 70003, 70004], (lost,))
    assert triggers(CAMERA_TRIGGER=sent) == [expected]
    answer = rows("CAMERA_FEEDBACK", 1e6 * SHOTS_S, np.arange(4), 0, boot_s=SHOTS_S)
    assert [one[0] for one in triggers(CAMERA_TRIGGER=sent, CAMERA_FEEDBACK=answer)] == ["CAMERA_FEEDBACK camera:0"]


def test_modes_and_messages_are_timed_by_their_arrival() -> None:
    texts = [(31.0, PILOT, "armed"), (32.0, MATE, "no"), (33.0, PILOT, "landed")]
    modes = [(30.5, PILOT, 10), (31.5, PILOT, 10), (32.5, PILOT, 11), (33.5, OTHER, 0)]
    given = Packets(texts, modes, ATTITUDE=euler(), HEARTBEAT=beats())
    events = batches(given)[source.EventSamples]
    assert [(of.texts, of.clock_s.round(6).tolist(), set(of.kinds)) for of in events] == [
        (("AUTO", "RTL"), [30.5, 32.5], {EventKind.MODE}),
        (("armed", "landed"), [31.0, 33.0], {EventKind.MESSAGE}),
    ]
    px4 = Packets((), [(30.5, PILOT, 4 << 16 | 4 << 24)], ATTITUDE=euler(), HEARTBEAT=beats(12, 2))
    assert [of.texts for of in batches(px4)[source.EventSamples]] == [("Mission",)]
    assert source.EventSamples not in batches(Packets((), modes, ATTITUDE=euler()))


# --- gimbal ---------------------------------------------------------------------------------------------------------
def test_the_gimbal_is_timed_by_its_own_clock_or_the_autopilots() -> None:
    q = TURN.inv().as_quat()[:, [3, 0, 1, 2]]
    given = {"ATTITUDE": euler(), "SYSTEM_TIME": utc()}
    status = rows("GIMBAL_DEVICE_ATTITUDE_STATUS", 1e3 * CLOCK_S + 40, 64, *q.T)
    [own] = batches(Packets(**given, GIMBAL_DEVICE_ATTITUDE_STATUS=status))[source.GimbalSamples]
    np.testing.assert_allclose(own.clock_s, CLOCK_S + 0.04, rtol=0, atol=1e-9)
    assert (own.source, own.is_earth.all(), own.boot) == ("GIMBAL_DEVICE_ATTITUDE_STATUS", np.True_, 1)
    late_s = np.where(np.arange(60) == 7, 0.01, 0.04)
    of_mate = rows("GIMBAL_DEVICE_ATTITUDE_STATUS", 1e3 * (CLOCK_S + 500), 64, *q.T, sender=MATE)
    of_mate[:, 1] += late_s
    [other] = batches(Packets(**given, GIMBAL_DEVICE_ATTITUDE_STATUS=of_mate))[source.GimbalSamples]
    np.testing.assert_allclose(other.clock_s, CLOCK_S + 0.01, rtol=0, atol=1e-5)
    both = np.concatenate([of_mate, status])
    [first] = batches(Packets(**given, GIMBAL_DEVICE_ATTITUDE_STATUS=both))[source.GimbalSamples]
    np.testing.assert_allclose(first.clock_s, CLOCK_S + 0.04, rtol=0, atol=1e-9)
    # Of two gimbals that are components of their own, the first one in the file is used.
    one, two = (
        rows("MOUNT_ORIENTATION", 1e3 * CLOCK_S, angle, 0, 0, sender=(3, of)) for angle, of in ((11, 154), (7, 171))
    )
    two[:, 0] += 1
    both = np.concatenate([one, two])
    [of_first] = batches(Packets(**given, MOUNT_ORIENTATION=both[np.argsort(both[:, 0])]))[source.GimbalSamples]
    assert same(of_first.q_gimbal_reference, Rotation.from_euler("ZYX", [[0.0, 0.0, 11.0]] * 60, degrees=True))
    angles = rows("MOUNT_STATUS", -2300, 1100, 3700)
    [mount] = batches(Packets(**given, MOUNT_STATUS=angles))[source.GimbalSamples]
    np.testing.assert_allclose(mount.clock_s, CLOCK_S, rtol=0, atol=1e-5)
    expected = Rotation.from_euler("ZYX", [37.0, -23.0, 11.0], degrees=True)
    assert same(mount.q_gimbal_reference, Rotation.concatenate([expected] * 60))
    orientation = rows("MOUNT_ORIENTATION", 1e3 * CLOCK_S, 11.0, -23.0, 37.0)
    [turned] = batches(Packets(**given, MOUNT_STATUS=angles[:, :] + 0, MOUNT_ORIENTATION=orientation))[
        source.GimbalSamples
    ]
    assert turned.source == "MOUNT_ORIENTATION"
    assert same(turned.q_gimbal_reference, Rotation.concatenate([expected] * 60))
    lone = batches(Packets(**given, MOUNT_ORIENTATION=orientation[:1], MOUNT_STATUS=angles))[source.GimbalSamples]
    assert [one.source for one in lone] == ["MOUNT_STATUS"]
    strange = rows("MOUNT_STATUS", -2300, 1100, 3700, sender=OTHER)
    assert source.GimbalSamples not in batches(Packets(**given, MOUNT_STATUS=strange))


# --- streams --------------------------------------------------------------------------------------------------------
def test_a_stream_is_five_packets_in_a_row() -> None:
    for v1 in (False, True):
        one = packed(0.5, v1)
        assert is_mavlink_stream(one * 5)
        assert not is_mavlink_stream(one * 4)
        assert is_mavlink_stream(b"junk\xfe" + one * 5)
        assert not is_mavlink_stream(one * 2 + b"x" + one * 4)
        assert not is_mavlink_stream(b"j" * 1024 + one * 5)
    assert is_mavlink_stream(b"j" * 1023 + packed(0.5) * 5)


def test_the_end_of_a_packet_of_a_stream() -> None:
    packet = packed(0.5)
    size = len(packet)
    assert tlog._stop(b"." + packet, 1) == size + 1
    assert tlog._stop(packet[:-1], 0) is None
    signed = bytearray(packet + b"x" * 13)
    signed[2] = 1
    assert (tlog._stop(bytes(signed), 0), tlog._stop(bytes(signed[:-1]), 0)) == (size + 13, None)
    signed[2] = 2
    assert tlog._stop(bytes(signed), 0) is None
    old = bytearray(packed(0.5, v1=True))
    assert tlog._stop(bytes(old), 0) == len(old)
    old[2] = 1  # a sequence number there
    assert tlog._stop(bytes(old), 0) == len(old)
    assert tlog._stop(b"\xfe\0" + bytes(6), 0) == 8
    assert tlog._stop(b"\xfe\0" + bytes(5), 0) is None
    assert tlog._stop(b"\xfc\0" + bytes(20), 0) is None


def test_packets_of_a_stream_arrive_by_the_clock_of_the_autopilot(tmp_path: Path) -> None:
    def attitude(ms: int, sender: tuple[int, int] = PILOT) -> bytes:
        message = common.MAVLink_attitude_message(ms, 0.25, -0.5, 0.75, 0.0, 0.0, 0.0)
        return bytes(message.pack(common.MAVLink(None, *sender)))

    beat = bytes(common.MAVLink_heartbeat_message(2, 12, 0, 0, 4, 3).pack(common.MAVLink(None, *PILOT)))
    damaged = bytearray(attitude(9000))
    damaged[-1] ^= 1
    stream = [
        beat,
        attitude(1500),
        bytes(damaged),
        attitude(2750),
        attitude(99_000, MATE),
        beat,
        attitude(400),
        attitude(500),
    ]
    path = tmp_path / "a.rlog"
    path.write_bytes(b"".join(stream))
    folder, log = tlog._with_arrival_times(str(path))
    with folder:
        raw = log.read_bytes()
        stamps = [struct.unpack_from(">Q", raw, start)[0] for start, _ in packets._packets(raw)]
    start_us = 1262304000_000000 + 86400_000000
    assert [stamp - start_us for stamp in stamps] == [0, 0, 1250000, 1250000, 1250000, 1250000, 1350000]
    assert log.name == "a.tlog"
    path.write_bytes(bytes(damaged))
    with pytest.raises(LogFormatError, match="holds no valid MAVLink packet"):
        tlog._with_arrival_times(str(path))
