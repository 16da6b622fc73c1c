"""PX4's topics without a log: what is read of columns, and the messages of a file byte by byte."""

import struct
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from glstar.arrays import Float, Integer
from glstar.errors import LogFormatError
from glstar.flight import EventKind
from glstar.telemetry import source, ulog, ulogfile
from glstar.telemetry.source import EVERYWHERE, LogFacts, Span
from glstar.telemetry.ulog import ULogReader, is_ulog, is_ulog2csv
from glstar.telemetry.ulogfile import CsvTopics, LogTopics, Topics, joined_logs

nan = np.nan
UTC_S = 1710068400.0
CLOCK_S = 30.0 + 0.25 * np.arange(40)

Columns = dict[str, Float]


class Table(Topics):
    """Topics in memory: by name, the columns of each instance."""

    whole_bytes, unread_bytes = 900, 7

    def __init__(self, about: dict[str, str | int] | None = None, texts: object = (), **topics: list[Columns]) -> None:
        self.about = about or {}
        self._texts = list(texts)
        self._topics = topics

    @property
    def names(self) -> list[str]:
        return sorted(self._topics)

    def count(self, name: str) -> int:
        return sum(topic["timestamp"].size for topic in self._topics.get(name, ()))

    def __getitem__(self, name: str) -> list[tuple[int, Columns]]:
        return [(2 * k + 1, topic) for k, topic in enumerate(self._topics.get(name, ()))]

    def with_quaternion(self) -> list[str]:
        return [name for name in self.names if "q[0]" in self._topics[name][0]]

    def lack(self, *names: str) -> str:
        return f"it lacks {' and '.join(names)}"

    def extent(self) -> str:
        return " in all"

    def messages(self) -> list[tuple[float, str]]:
        return self._texts

    def stamps(self, name: str) -> list[tuple[Integer, Float]]:
        """Return positions in the file, with those of all instances interleaved."""
        offset = 100 * (1 + sorted(self._topics).index(name)) if name in self._topics else 0
        return [
            (10_000 * np.arange(topic["timestamp"].size) + offset + k, topic["timestamp"] * 1e-6)
            for k, topic in enumerate(self._topics.get(name, ()))
        ]

    def only(self, spans: Sequence[Span]) -> "Table":
        del spans
        return self


class Reader(ULogReader):
    """A reader of topics in memory."""

    def __init__(self, *logs: Topics, **options: object) -> None:
        self._given = list(logs)
        super().__init__("log.ulg", **options)

    def _open(self) -> list[Topics]:
        return self._given


def batches(log: Topics, **options: object) -> dict[type, list[source.Samples]]:
    found: dict[type, list[source.Samples]] = {}
    for batch in Reader(log, **options).samples():
        found.setdefault(type(batch), []).append(batch)
    return found


def topic(clock_s: Float = CLOCK_S, **columns: object) -> Columns:
    return {"timestamp": clock_s * 1e6} | {
        name: np.broadcast_to(of, clock_s.shape) * 1.0 for name, of in columns.items()
    }


TURN = Rotation.from_euler("ZYX", [[40.0, 15.0 + k, -25.0] for k in range(40)], degrees=True)


def quaternion(rotation: Rotation = TURN, **more: object) -> Columns:
    """Return orientations from body to NED."""
    q = rotation.as_quat()[:, [3, 0, 1, 2]]
    clock_s = CLOCK_S[: len(q)]
    return topic(clock_s, **{f"q[{k}]": q[:, k] for k in range(4)}, **more)


# --- attitude -------------------------------------------------------------------------------------------------------
def test_the_attitude_is_turned_from_ned_to_the_body() -> None:
    odd = quaternion(quat_reset_counter=np.where(np.arange(40) < 10, 4, np.where(np.arange(40) < 25, 5, 2)))
    odd["q[1]"] = np.where(np.arange(40) == 3, 2.0, odd["q[1]"])
    odd["timestamp"][5] = 1e15
    samples = batches(Table(vehicle_attitude=[odd]))[source.AttitudeSamples][0]

    used = np.delete(np.arange(40), [3, 5])
    np.testing.assert_allclose(samples.clock_s, CLOCK_S[used], rtol=0, atol=1e-9)
    expected = TURN.inv().as_quat()[used][:, [3, 0, 1, 2]]
    np.testing.assert_allclose(np.abs(np.sum(samples.q_body_ned * expected, axis=-1)), 1.0, rtol=0, atol=1e-12)
    assert samples.segment.tolist() == [0] * 8 + [1] * 15 + [2] * 15
    assert (samples.source, samples.break_reason, samples.boot) == ("vehicle_attitude", "a reset of the estimator", 1)


@pytest.mark.parametrize(
    ("late_s", "is_used"), [(0.005, True), (0.96, True), (1.04, False), (-0.96, True), (-1.04, False)]
)
def test_a_sample_was_taken_up_to_a_second_before_it_was_published(late_s: float, is_used: bool) -> None:
    late = quaternion(timestamp_sample=(CLOCK_S - late_s) * 1e6)
    [samples] = batches(Table(vehicle_attitude=[late]))[source.AttitudeSamples]
    np.testing.assert_allclose(samples.clock_s, CLOCK_S - (late_s if is_used else 0.0), rtol=0, atol=1e-9)


def test_an_instance_is_chosen_by_its_number() -> None:
    log = Table(
        vehicle_attitude=[quaternion(), quaternion(TURN[::-1])],
        vehicle_attitude_setpoint=[quaternion()],
        estimator_attitude=[quaternion(), quaternion()],
        other=[topic(x=1.0)],
    )

    def chosen(attitude: str) -> tuple[str, float]:
        [samples] = batches(log, attitude=attitude)[source.AttitudeSamples]
        return samples.source, float(abs(samples.q_body_ned[0, 2]))

    first, last = (float(abs(TURN.as_quat()[k, 1])) for k in (0, 39))
    assert chosen("auto") == ("vehicle_attitude instance 1 of 1 and 3", pytest.approx(first))
    assert (
        chosen(" AUTO[3]")
        == chosen("Vehicle_Attitude[3]")
        == (
            "vehicle_attitude instance 3 of 1 and 3",
            pytest.approx(last),
        )
    )
    assert chosen("vehicle_attitude_setpoint")[0] == "vehicle_attitude_setpoint"
    names = ["vehicle_attitude[1]", "vehicle_attitude[3]"]
    assert [name for name, _ in Reader(log).attitudes()] == [
        *[n.replace("vehicle", "estimator") for n in names],
        *names,
    ]
    assert [name for name, _ in Reader(Table(vehicle_attitude=[quaternion()])).attitudes()] == ["vehicle_attitude"]


def test_why_a_log_has_no_attitude() -> None:
    def refusal(log: Topics, **options: str) -> str:
        with pytest.raises(LogFormatError) as caught:
            list(Reader(log, **options).samples())
        assert caught.value.offset == 900
        return str(caught.value).removeprefix("log.ulg: ")

    both = Table(vehicle_attitude=[quaternion()], estimator_attitude=[quaternion()])
    has = "it has estimator_attitude, vehicle_attitude"
    assert refusal(both, attitude="x") == f"the log has no attitude 'x'; {has}"
    assert refusal(both, attitude="auto[0]") == f"the log has no attitude 'auto[0]'; {has}"
    assert refusal(both, attitude="vehicle_attitude[3]") == f"the log has no attitude 'vehicle_attitude[3]'; {has}"
    assert refusal(Table(vehicle_attitude=[topic(**{f"q[{k}]": 0.0 for k in range(4)})])) == (
        "the log has no valid sample of vehicle_attitude"
    )
    assert refusal(Table(other=[topic(x=1.0)], more=[topic()])) == (
        "the log has no attitude: no vehicle_attitude among its 2 topics in all"
    )


# --- position and UTC -----------------------------------------------------------------------------------------------
PLACE = {"lat": -34.5, "lon": 138.5, "alt": 50.5}
OLD = {"lat": -345000000, "lon": 1385000000, "alt": 50500}
NEW = {"latitude_deg": -34.5, "longitude_deg": 138.5, "altitude_msl_m": 50.5}


@pytest.mark.parametrize(
    ("topics", "name", "count"),
    [
        ({"vehicle_global_position": [topic(**PLACE)]}, "vehicle_global_position", 40),
        ({"vehicle_global_position": [topic(**PLACE, lat_lon_valid=np.arange(40) > 3)]}, "vehicle_global_position", 36),
        ({"sensor_gps": [topic(**OLD, fix_type=np.arange(40) // 10)]}, "sensor_gps", 10),
        ({"sensor_gps": [topic(**NEW, fix_type=3.0)]}, "sensor_gps", 40),
        ({"sensor_gps": [topic(fix_type=3.0), topic(**NEW, fix_type=4.0)]}, "sensor_gps", 40),
        (
            {
                "vehicle_global_position": [topic(lat=0, lon=0, alt=0)],
                "vehicle_gps_position": [topic(**NEW, fix_type=3)],
            },
            "vehicle_gps_position",
            40,
        ),
    ],
)
def test_the_position_of_an_estimator_or_of_a_receiver_with_a_fix(
    topics: dict[str, list[Columns]], name: str, count: int
) -> None:
    [samples] = batches(Table(vehicle_attitude=[quaternion()], **topics))[source.PositionSamples]
    assert (samples.source, samples.clock_s.size) == (name, count)
    np.testing.assert_allclose(samples.clock_s, CLOCK_S[40 - count :], rtol=0, atol=1e-9)
    place = np.rad2deg([samples.latitude_rad, samples.longitude_rad])
    np.testing.assert_allclose(place, [[-34.5] * count, [138.5] * count], rtol=1e-12)
    np.testing.assert_allclose(samples.height_m, 50.5, rtol=1e-12)


def test_why_a_log_has_no_position() -> None:
    attitude = {"vehicle_attitude": [quaternion()]}
    [none] = batches(Table(**attitude, sensor_gps=[topic(**NEW, fix_type=2)]))[source.PositionSamples]
    assert none.source == "its GPS never had a 3D fix"
    [none] = batches(Table(**attitude))[source.PositionSamples]
    assert none.source == "it lacks vehicle_global_position and vehicle_gps_position"


def gps(fix_type: object = 3, off_s: object = 0.0, **more: object) -> Columns:
    return topic(**NEW, fix_type=fix_type, time_utc_usec=(UTC_S + CLOCK_S + off_s) * 1e6, **more)


def clock(*receivers: Columns, about: dict[str, str | int] | None = None, **more: object) -> source.ClockSamples:
    [samples] = batches(Table(about, vehicle_attitude=[quaternion()], sensor_gps=list(receivers), **more))[
        source.ClockSamples
    ]
    return samples


def offsets(samples: source.ClockSamples) -> list[float]:
    return np.round(samples.utc_s - samples.clock_s - UTC_S, 4).tolist()


def test_utc_is_that_of_a_receiver_with_a_fix() -> None:
    samples = clock(gps(2, 5.0), gps(np.arange(40) // 10, 7.0))
    assert samples.source == "sensor_gps.time_utc_usec, 10 fixes"
    assert offsets(samples) == [7.0] * 10
    assert samples.notes == ()
    without = clock(gps(2, 5.0), gps(1, 7.0))
    assert (without.source, offsets(without)) == ("sensor_gps.time_utc_usec, 40 fixes", [5.0] * 40)
    other = clock(gps(3, 5.0), vehicle_gps_position=[gps(3, 9.0)])
    assert (other.source, set(offsets(other))) == ("vehicle_gps_position.time_utc_usec, 40 fixes", {9.0})
    early = gps()
    early["time_utc_usec"][:7] = 1.2e15
    assert clock(early).source == "sensor_gps.time_utc_usec, 33 fixes"


def test_a_log_without_utc_of_a_receiver() -> None:
    at_boot = clock(about={"boot_time_utc_us": round(UTC_S * 1e6)})
    assert (at_boot.clock_s.tolist(), at_boot.utc_s.tolist()) == ([0.0], [UTC_S])
    assert at_boot.source == "boot_time_utc_us"
    assert at_boot.notes == (
        "the only UTC of the log is boot_time_utc_us, by PX4's own clock: a GPS or a ground station set it before the"
        " log began, perhaps a second off; --utc-start replaces it",
    )
    assert clock(gps(off_s=-UTC_S)).source == "its GPS never had a time after 2010"
    assert clock(topic(**NEW, fix_type=3)).source == "its GPS never had a time after 2010"
    assert clock().source == "it lacks vehicle_gps_position"


@pytest.mark.parametrize(("age_s", "is_used"), [(1.92, True), (2.08, False), (-1.92, True), (-2.08, False)])
def test_an_age_of_utc_up_to_two_seconds_is_used(age_s: float, is_used: bool) -> None:
    ages_s = np.where(np.arange(40) < 5, age_s, 0.5)
    samples = clock(gps(timestamp_time_relative=-1e6 * ages_s, off_s=-ages_s))
    assert offsets(samples) == [0.0] * (40 if is_used else 35)
    left_out = "5 of 40 UTC readings are left out: by sensor_gps.timestamp_time_relative"
    assert samples.notes == (() if is_used else (f"{left_out} they were more than 2 s old when logged",))


@pytest.mark.parametrize(("valid", "is_used"), [(2, False), (3, True)])
def test_ages_are_not_used_if_less_than_a_twentieth_is_valid(valid: int, is_used: bool) -> None:
    """Of 40 ages; the UTC is then new only where it changes."""
    ages_s = np.where(np.arange(40) < valid, 0.5, 300.0)
    held = gps(timestamp_time_relative=-1e6 * ages_s)
    held["time_utc_usec"] = (UTC_S + CLOCK_S[np.arange(40) // 4 * 4]) * 1e6
    samples = clock(held)
    if is_used:
        np.testing.assert_allclose(samples.clock_s, CLOCK_S[:3] - 0.5, rtol=0, atol=1e-9)
        assert samples.notes[0].startswith("37 of 40 UTC readings are left out")
    else:
        np.testing.assert_allclose(samples.clock_s, CLOCK_S[::4], rtol=0, atol=1e-9)
        field = "sensor_gps.timestamp_time_relative is not used"
        assert samples.notes == (f"{field}: by it the UTC readings were 300 s old when logged",)


# --- gyros, camera, modes -------------------------------------------------------------------------------------------
def test_rates_are_those_of_the_most_frequent_topic() -> None:
    old = {f"gyro_rad_s[{k}]": 0.1 * (k + 1) for k in range(3)}
    few = {f"xyz[{k}]": 0.5 * (k + 1) for k in range(3)}
    attitude = {"vehicle_attitude": [quaternion()]}
    few_samples = topic(CLOCK_S[:20], **few)
    damaged = topic(**old, timestamp_sample=(CLOCK_S - 0.125) * 1e6)
    damaged["gyro_rad_s[1]"][4] = 1e3
    log = Table(**attitude, vehicle_angular_velocity=[few_samples], sensor_combined=[topic(x=1.0), damaged])
    [rates] = batches(log)[source.RateSamples]
    np.testing.assert_allclose(rates.clock_s, np.delete(CLOCK_S, 4) - 0.125, rtol=0, atol=1e-9)
    np.testing.assert_allclose(rates.rate_rad_per_s, np.tile([0.1, 0.2, 0.3], (39, 1)), rtol=1e-12)
    assert rates.source == "sensor_combined"
    log = Table(**attitude, vehicle_angular_velocity=[few_samples], sensor_gyro=[topic(CLOCK_S[:20], x=1, y=2, z=3)])
    assert batches(log)[source.RateSamples][0].source == "vehicle_angular_velocity"
    assert source.RateSamples not in batches(Table(**attitude, sensor_gyro=[topic(CLOCK_S[:1], x=1, y=2, z=3)]))
    two = batches(Table(**attitude, sensor_gyro=[topic(CLOCK_S[:2], x=1, y=2, z=3)]))
    assert two[source.RateSamples][0].rate_rad_per_s.tolist() == [[1, 2, 3]] * 2


def triggers(**topics: list[Columns]) -> list[tuple[str, list[float], tuple[str, ...]]]:
    found = batches(Table(vehicle_attitude=[quaternion()], **topics)).get(source.TriggerSamples, [])
    assert all(samples.clock_error_s == 0.5 for samples in found)
    return [(f"{s.source} {s.camera}", np.round(s.clock_s, 6).tolist(), s.notes) for s in found]


SHOTS_S = np.array([31.0, 32.0, 33.0, 34.0])


def test_captures_of_a_camera() -> None:
    result = topic(SHOTS_S, result=np.array([1, 0, -1, 1]), timestamp_utc=np.array([UTC_S, UTC_S, UTC_S + 3, 5]) * 1e6)
    failed = ("1 of 4 captures (camera_capture) failed and are left out",)
    assert triggers(camera_capture=[result]) == [("camera_capture camera:1", [31.0, 33.0, 34.0], failed)]
    [samples] = batches(Table(vehicle_attitude=[quaternion()], camera_capture=[result]))[source.TriggerSamples]
    np.testing.assert_array_equal(samples.utc_s, [UTC_S, UTC_S + 3, nan])
    two = triggers(camera_capture=[topic(SHOTS_S), topic(SHOTS_S[:1], result=0)])
    assert [one[:2] for one in two] == [("camera_capture camera:1", [31, 32, 33, 34]), ("camera_capture camera:3", [])]
    far = topic(np.array([31.0, 32.0, 1e7]))
    assert triggers(camera_capture=[far])[0][1] == [31.0, 32.0]


def test_triggers_without_captures_are_completed() -> None:
    note = ("2 of 4 triggers (camera_trigger) have no camera_capture: PX4 had no position",)
    sent, two = topic(SHOTS_S), topic(SHOTS_S[2:])
    assert triggers(camera_capture=[two], camera_trigger=[sent]) == [
        ("camera_trigger camera:1", SHOTS_S.tolist(), note)
    ]
    for other in (topic(SHOTS_S[2:] + 0.1), topic(SHOTS_S[2:], result=np.array([0, 1]))):
        [(name, _, notes)] = triggers(camera_capture=[other], camera_trigger=[sent])
        assert name == "camera_capture camera:1"
        assert note[0] not in notes
    assert triggers(camera_capture=[sent], camera_trigger=[sent]) == [("camera_capture camera:1", SHOTS_S.tolist(), ())]


def test_answers_of_a_camera() -> None:
    feedback = topic(SHOTS_S, feedback=np.array([0, 1, 0, 0]))
    lost = ("2 of 3 triggers (camera_trigger) have no answer and are left out",)
    assert triggers(camera_trigger=[feedback]) == [("camera_trigger camera:1", [32.0], lost)]
    assert triggers(camera_trigger=[topic(SHOTS_S, feedback=0)]) == [("camera_trigger camera:1", SHOTS_S.tolist(), ())]
    # One instance has the triggers, the other one the answers.
    sent, answers = topic(SHOTS_S), topic(SHOTS_S[1:] + 0.5, feedback=1)
    lost = ("1 of 4 triggers (camera_trigger) have no answer and are left out",)
    assert triggers(camera_trigger=[sent, answers]) == [("camera_trigger camera:3", [32.5, 33.5, 34.5], lost)]
    both = triggers(camera_trigger=[answers, answers])
    assert both == [(f"camera_trigger camera:{k}", [32.5, 33.5, 34.5], ()) for k in (1, 3)]
    mixed = triggers(camera_trigger=[answers, topic(SHOTS_S, feedback=np.array([0, 1, 1, 1]))])
    assert mixed == [("camera_trigger camera:1", [32.5, 33.5, 34.5], ()), ("camera_trigger camera:3", [32, 33, 34], ())]


def test_the_attitude_of_a_gimbal() -> None:
    angles = {f"attitude_euler_angle[{k}]": np.deg2rad(angle) for k, angle in enumerate((11.0, -23.0, 37.0))}
    status = quaternion(device_flags=np.where(np.arange(40) < 20, 64, 32))
    attitude = {"vehicle_attitude": [quaternion()]}
    [gimbal] = batches(Table(**attitude, mount_orientation=[topic(**angles)]))[source.GimbalSamples]
    expected = Rotation.from_euler("ZYX", [37.0, -23.0, 11.0], degrees=True).inv().as_quat()[[3, 0, 1, 2]]
    np.testing.assert_allclose(np.abs(gimbal.q_gimbal_reference @ expected), 1.0, rtol=0, atol=1e-12)
    assert (gimbal.source, gimbal.is_earth.any()) == ("mount_orientation", np.False_)
    both = {"mount_orientation": [topic(**angles)], "gimbal_device_attitude_status": [topic(x=1), status]}
    [gimbal] = batches(Table(**attitude, **both))[source.GimbalSamples]
    assert gimbal.source == "gimbal_device_attitude_status"
    assert gimbal.is_earth.tolist() == [True] * 20 + [False] * 20
    np.testing.assert_allclose(gimbal.clock_s, CLOCK_S, rtol=0, atol=1e-9)
    one = {name: of[:1] for name, of in status.items()}
    found = batches(Table(**attitude, gimbal_device_attitude_status=[one], mount_orientation=[topic(**angles)]))
    assert [samples.source for samples in found[source.GimbalSamples]] == ["mount_orientation"]


def test_modes_and_messages_are_events() -> None:
    status = topic(CLOCK_S[:5], nav_state=np.array([0, 3, 3, nan, 17]))
    texts = [(31.0, "armed"), (1e8, "lost"), (33.0, "landed")]
    log = Table({}, texts, vehicle_attitude=[quaternion()], vehicle_status=[topic(x=1), status, topic(nav_state=5)])
    modes, messages = batches(log)[source.EventSamples]
    assert (modes.texts, modes.clock_s.tolist()) == (("Manual", "Mission", "Takeoff"), [30.0, 30.25, 31.0])
    assert set(modes.kinds) == {EventKind.MODE}
    assert (messages.texts, messages.clock_s.tolist()) == (("armed", "landed"), [31.0, 33.0])
    assert set(messages.kinds) == {EventKind.MESSAGE}


@pytest.mark.parametrize(
    ("about", "kind", "vehicle", "firmware"),
    [
        ({}, None, "PX4", None),
        ({}, 2, "PX4 quadrotor", None),
        ({"sys_name": "PX4", "ver_sw_release": 0x010E0080}, 1, "PX4 fixed wing", "PX4 v1.14.0-beta"),
        ({"sys_name": "X", "ver_sw": "0123456789", "ver_hw": "FMU"}, None, "X", "X (01234567) on FMU"),
        ({"ver_sw_release": "x", "ver_hw": "FMU"}, None, "PX4", "PX4 on FMU"),
    ],
)
def test_facts_of_a_log(about: dict[str, str | int], kind: int | None, vehicle: str, firmware: str | None) -> None:
    status = {} if kind is None else {"vehicle_status": [topic(x=1), topic(system_type=kind)]}
    facts = Reader(Table(about, vehicle_attitude=[quaternion()], **status)).facts()
    assert facts == LogFacts("PX4 ULog", vehicle, firmware)
    assert facts.unread_bytes == 7


def test_readings_of_utc_have_the_positions_of_their_samples() -> None:
    """The samples of one of several receivers are found among all of the topic."""
    log = Table(sensor_gps=[gps(np.where(np.arange(40) < 4, 0, 3))])
    position, clock_s, utc_s = ulog._clock_readings([Table(), log])
    assert position.tolist() == [10_000 * k + 100 for k in range(4, 40)]
    np.testing.assert_allclose(clock_s, CLOCK_S[4:], rtol=0, atol=1e-9)
    np.testing.assert_allclose(utc_s - clock_s, UTC_S, rtol=0, atol=1e-5)
    values = np.array([1.0, 2.0, 2.0, 3.0, 4.0, 2.0])
    for selected, indices in (
        ([1.0, 2.0, 3.0], [0, 1, 3]),
        ([2.0, 2.0, 2.0], [1, 2, 5]),
        ([3.0, 2.0], [3, 5]),
        (values, [0, 1, 2, 3, 4, 5]),
        ([3.0, 1.0], None),
        ([2.0, 9.0], None),
    ):
        found = ulog._in_order(np.array(selected), values)
        assert (None if found is None else found.tolist()) == indices


@pytest.mark.parametrize(
    ("header", "is_csv"),
    [
        ("timestamp,q[0],q[1]", True),
        ("timestamp;xyz[0]\n", True),
        ("timestamp,system_type", True),
        ("timestamp,x,y", False),
        ("timestamp", False),
        ("timestamp,q[0],1x", False),
        ("time,q[0]", False),
        ("xtimestamp,q[0]", False),
    ],
)
def test_a_table_of_ulog2csv_is_known_by_its_header(header: str, is_csv: bool) -> None:
    assert is_ulog2csv(header) is is_csv


# --- the messages of a file -----------------------------------------------------------------------------------------
FILE_HEAD = b"ULog\x01\x12\x35\x01" + struct.pack("<Q", 0)


def message(kind: str, body: bytes) -> bytes:
    return struct.pack("<HB", len(body), ord(kind)) + body


FORMAT = message("F", b"pair:uint64_t timestamp;float x;")
OTHER = message("F", b"odd:uint64_t timestamp;float[4] q;")
SUBSCRIBE = message("A", struct.pack("<BH", 0, 7) + b"pair")


def sample(t_s: float, x: float, number: int = 7) -> bytes:
    return message("D", struct.pack("<HQf", number, round(t_s * 1e6), x))


def fact(kind: str, name: str, value: bytes) -> bytes:
    key = f"{kind} {name}".encode()
    return message("I", bytes([len(key)]) + key + value)


def log_of(path: Path, *parts: bytes, **span: int) -> LogTopics:
    path.write_bytes(FILE_HEAD + b"".join(parts))
    return LogTopics(str(path), **span)


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "log.ulg"


def test_the_messages_of_a_log_are_indexed(path: Path) -> None:
    second = message("A", struct.pack("<BH", 3, 9) + b"pair")
    again = message("A", struct.pack("<BH", 1, 7) + b"odd")
    text = message("L", struct.pack("<BQ", 54, 2_500_000) + b"landed \xff")
    tagged = message("C", struct.pack("<BHQ", 54, 7, 3_250_000) + b"tagged")
    facts = fact("char[8]", "sys_name", b" PX4\0 ") + fact("uint32_t", "ver_sw_release", struct.pack("<I", 0xFE010203))
    facts += fact("int64_t", "boot_time_utc_us", struct.pack("<q", -5)) + fact("char[3]", "sys_name", b"two")
    facts += fact("uint32_t", "ver_hw", b"\1\2\3") + fact("char[3]", "other", b"abc")
    parts = [FORMAT, OTHER, SUBSCRIBE, again, second, facts, text, sample(1.5, 2.5), sample(2.0, 3.5, 9), tagged]
    parts += [sample(2.25, 4.5), b"xx"]
    log = log_of(path, *parts)

    at = 16 + np.cumsum([0, *map(len, parts)])
    assert log.names == ["pair"]
    assert [log.count(name) for name in ("pair", "odd")] == [3, 0]
    assert [(number, {k: v.tolist() for k, v in of.items()}) for number, of in log["pair"]] == [
        (0, {"timestamp": [1.5e6, 2.25e6], "x": [2.5, 4.5]}),
        (3, {"timestamp": [2e6], "x": [3.5]}),
    ]
    assert log["odd"] == []
    assert [(p.tolist(), t.tolist()) for p, t in log.stamps("pair")] == [
        ([at[7], at[10]], [1.5, 2.25]),
        ([at[8]], [2.0]),
    ]
    assert log.stamps("odd") == []
    assert log.about == {"sys_name": "PX4", "ver_sw_release": 0xFE010203, "boot_time_utc_us": -5}
    assert log.messages() == [(2.5, "landed \N{REPLACEMENT CHARACTER}"), (3.25, "tagged")]
    assert (log.whole_bytes, log.unread_bytes, log.start) == (at[11], 2, 0)
    assert log.extent() == f" in {at[11]} whole bytes of {at[12]}"
    assert log.with_quaternion() == []
    assert log.lack("a") == "it has no a"
    assert log.lack("a", "b", "c") == "it has neither a nor b nor c"
    part = log.only([(int(at[8]), int(at[10]))])
    assert part.count("pair") == 1
    assert [number for number, _ in part["pair"]] == [3]
    assert part.messages() == [(3.25, "tagged")]
    assert log.count("pair") == 3


def test_a_topic_with_a_quaternion_is_named(path: Path) -> None:
    log = log_of(path, OTHER, FORMAT, message("A", struct.pack("<BH", 0, 9) + b"odd"), SUBSCRIBE, sample(1.5, 2.5))
    assert (log.names, log.with_quaternion(), log.extent()) == (["odd", "pair"], ["odd"], "")


@pytest.mark.parametrize(("between", "are_read"), [(2, False), (3, True)])
def test_reading_goes_on_at_three_messages_or_the_end(path: Path, between: int, are_read: bool) -> None:
    good = [sample(1.0 + k, 0.5 + k) for k in range(between + 3)]
    damage = b"\xff\xff\xffDyy", b"\xff" * 3
    parts = [FORMAT, SUBSCRIBE, good[0], damage[0], *good[1:-2], damage[1], *good[-2:]]
    log = log_of(path, *parts)
    read = range(between + 3) if are_read else [0, between + 1, between + 2]
    assert log["pair"][0][1]["x"].tolist() == [0.5 + k for k in read]
    assert log.unread_bytes == 9 + (0 if are_read else between * len(good[0]))
    assert log.whole_bytes == 16 + sum(map(len, parts))


@pytest.mark.parametrize(
    ("letter", "least", "most"),
    [
        ("B", 16, 100),
        ("F", 3, 65535),
        ("I", 3, 65535),
        ("M", 4, 65535),
        ("P", 3, 65535),
        ("Q", 4, 65535),
        ("A", 4, 300),
        ("R", 2, 2),
        ("D", 3, 65535),
        ("L", 9, 65535),
        ("C", 11, 65535),
        ("S", 8, 8),
        ("O", 2, 2),
        ("X", 1, 0),
    ],
)
def test_a_message_holds_at_least_its_fields(letter: str, least: int, most: int) -> None:
    """By the layouts of ULog: L is a level and a time of 64 bits, C has a tag of 16 bits too, S is eight bytes."""
    for size in (least - 1, least, most, most + 1):
        if 0 <= size <= 65535:
            raw = b"." + message(letter, bytes(size)) + b"."
            is_valid = least <= size <= most
            assert ulogfile._stop(raw, 1, len(raw)) == (len(raw) - 1 if is_valid else None)
            assert ulogfile._stop(raw, 1, len(raw) - 2) is None


def test_the_head_of_a_log_says_whether_it_can_be_read(path: Path) -> None:
    for size in (0, 15):
        path.write_bytes(FILE_HEAD[:size])
        with pytest.raises(LogFormatError, match=f"the log is cut off in its head: {size} bytes; copy it again"):
            LogTopics(str(path))
        assert joined_logs(str(path)) == [(0, 16)]
    for byte, value, is_known in ((8, 0, True), (8, 1, True), (8, 2, False), (9, 1, False), (0, 255, True)):
        flags = bytearray(40)
        flags[byte] = value
        if is_known:
            assert log_of(path, message("B", bytes(flags)), FORMAT, SUBSCRIBE, sample(1.5, 2.5)).count("pair") == 1
        else:
            with pytest.raises(LogFormatError, match="is a newer kind of ULog, which pyulog does not know") as caught:
                log_of(path, message("B", bytes(flags)), FORMAT)
            assert caught.value.offset == 16
        assert log_of(path, FORMAT, message("B", bytes(flags)), SUBSCRIBE).names == ["pair"]
    assert is_ulog(FILE_HEAD)
    assert not is_ulog(FILE_HEAD[1:])


def test_joined_logs_have_a_head_each(path: Path) -> None:
    first = FILE_HEAD + FORMAT + SUBSCRIBE + sample(1.5, 2.5)
    second = FILE_HEAD + FORMAT + message("A", struct.pack("<BH", 0, 7) + b"pair") + sample(3.5, 4.5)
    path.write_bytes(first + second + FILE_HEAD)
    spans = [(0, len(first)), (len(first), len(first + second) + 16)]
    assert joined_logs(str(path)) == spans
    logs = [LogTopics(str(path), *span) for span in spans]
    assert [log["pair"][0][1]["x"].tolist() for log in logs] == [[2.5], [4.5]]
    assert [log.start for log in logs] == [0, len(first)]
    assert [log.stamps("pair")[0][0].tolist() for log in logs] == [[len(first) - 17], [len(first + second) - 17]]
    assert logs[0].whole_bytes == len(first)


@pytest.mark.parametrize("piece_bytes", [1, 5, 64, 1 << 20])
def test_letters_are_searched_in_pieces(monkeypatch: pytest.MonkeyPatch, piece_bytes: int) -> None:
    monkeypatch.setattr(ulogfile, "_PIECE_BYTES", piece_bytes)
    raw = b"xDx" + bytes(100) + b"FyzB" + bytes(7) + b"S"
    assert list(ulogfile._letters(raw, 0, len(raw))) == [1, 103, 106, 114]
    assert list(ulogfile._letters(raw, 2, 106)) == [103]
    assert list(ulogfile._letters(raw, 2, 107)) == [103, 106]


# --- the files of ulog2csv ------------------------------------------------------------------------------------------
def test_files_beside_one_of_ulog2csv_are_its_topics(tmp_path: Path) -> None:
    for name, text in {
        "a_vehicle_attitude_0.csv": "timestamp,q[0]\n1000000,0.5\n2000000,0.6\n",
        "a_vehicle_attitude_2.csv": "timestamp,q[0]\n3000000,0.7\n",
        "a_sensor_gps_0.csv": "timestamp,lat\n4000000,8\n",
        "b_sensor_gps_1.csv": "timestamp,lat\n5000000,9\n",
        "a_sensor_gyro_0.csv": "x,y\n1,2\n",
        "a_other_0.csv": "timestamp,q[0]\n1,2\n",
    }.items():
        (tmp_path / name).write_text(text)
    topics = CsvTopics(str(tmp_path / "a_vehicle_attitude_2.csv"))
    assert topics.names == ["sensor_gps", "sensor_gyro", "vehicle_attitude"]
    assert (topics.own, topics.own_quaternion) == (("vehicle_attitude", 2), True)
    assert [topics.count(name) for name in ("vehicle_attitude", "sensor_gps", "sensor_gyro", "x")] == [3, 1, 0, 0]
    assert [number for number, _ in topics["vehicle_attitude"]] == [0, 2]
    assert [times_s.tolist() for _, times_s in topics.stamps("vehicle_attitude")] == [[1.0, 2.0], [3.0]]
    assert [rows.tolist() for rows, _ in topics.stamps("vehicle_attitude")] == [[0, 1], [0]]
    assert topics.with_quaternion() == ["vehicle_attitude"]
    assert topics.lack("x") == "no a_x_0.csv lies beside it"
    assert topics.lack("x", "y") == "neither a_x_0.csv nor a_y_0.csv lies beside it"
    assert (topics.extent(), topics.whole_bytes, topics.unread_bytes) == ("", 0, 0)
    assert topics.only([(0, EVERYWHERE)]) is topics
    gps_file = CsvTopics(str(tmp_path / "a_sensor_gps_0.csv"))
    assert (gps_file.own, gps_file.own_quaternion) == (("sensor_gps", 0), False)
    (tmp_path / "plain.csv").write_text("timestamp,q[0]\n1,2\n")
    plain = CsvTopics(str(tmp_path / "plain.csv"))
    assert (plain.names, plain.own) == (["vehicle_attitude"], ("vehicle_attitude", 0))
    assert plain.lack("x") == (
        "the name of the file should be LOG_vehicle_attitude_0.csv, as ulog2csv wrote it, to find those beside it"
    )
