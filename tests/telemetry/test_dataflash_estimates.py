"""What is read of a DataFlash log's columns: estimates, lanes, remarks, UTC, gyros and cameras, without a file."""

from collections.abc import Sequence

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from glstar.arrays import Float, Integer
from glstar.errors import LogFormatError
from glstar.flight import EventKind
from glstar.telemetry import source
from glstar.telemetry.dataflash import attitude, reader
from glstar.telemetry.dataflash.attitude import AttitudeEstimate, active_estimator, estimator_notes, flown_attitude
from glstar.telemetry.dataflash.records import Records
from glstar.telemetry.source import Span

nan = np.nan
CLOCK_S = 30.0 + 0.1 * np.arange(50)
UTC_S, WEEK, WEEK_MS = 1710068400.0, 2305, 39_618_000.0  # 2024-03-10 11:00:00, 18 leap seconds

Message = dict[str, Float | list[str]]


class Table(Records):
    """The messages of a log as columns."""

    kind, end, unread_bytes = "a table", 900, 7
    heads = ()

    def __init__(self, **messages: Message) -> None:
        self._messages = messages

    @property
    def names(self) -> list[str]:
        return sorted(self._messages)

    def __contains__(self, name: str) -> bool:
        return name in self._messages

    def count(self, name: str) -> int:
        return len(next(iter(self._messages[name].values()))) if name in self else 0

    def fields(self, name: str) -> tuple[str, ...]:
        return tuple(self._messages.get(name, ()))

    def columns(self, name: str, *fields: str) -> list[Float] | None:
        message = self._messages.get(name, {})
        if not set(fields) <= set(message) or any(isinstance(message[field], list) for field in fields):
            return None
        return [message[field] for field in fields]

    def texts(self, name: str, field: str) -> list[str]:
        column = self._messages.get(name, {}).get(field, [])
        return column if isinstance(column, list) else []

    def position(self, name: str) -> Integer:
        return 3 + 10 * np.arange(self.count(name))

    def alike(self, one: int, other: int) -> bool:
        del one, other
        return True

    def only(self, spans: Sequence[Span]) -> "Table":
        del spans
        return self

    def loss(self) -> str:
        return " in all"

    def close(self) -> None:
        """Do nothing."""


def message(clock_s: Float = CLOCK_S, **columns: object) -> Message:
    spread = {
        name: of if isinstance(of, list) else np.broadcast_to(of, clock_s.shape) * 1.0 for name, of in columns.items()
    }
    return {"TimeUS": clock_s * 1e6} | spread


def turned(yaw_deg: Float | float, size: int = 50) -> Rotation:
    """Return attitudes of a body, to NED."""
    angles = np.column_stack([np.broadcast_to(yaw_deg, size), np.full(size, 20.0), np.full(size, -30.0)])
    return Rotation.from_euler("ZYX", angles, degrees=True)


def xkq(yaw_deg: Float | float = 40.0, lane: object = 0, clock_s: Float = CLOCK_S, late_s: float = 0.0) -> Message:
    q = turned(yaw_deg, clock_s.size).as_quat()[:, [3, 0, 1, 2]]
    return message(clock_s + late_s, C=lane, **{f"Q{k + 1}": q[:, k] for k in range(4)})


def att(yaw_deg: Float | float = 40.0, aekf: object = 3, clock_s: Float = CLOCK_S) -> Message:
    return message(clock_s, Roll=-30.0, Pitch=20.0, Yaw=yaw_deg, AEKF=aekf)


def yaw_deg(q_body_ned: Float) -> Float:
    """Return the yaw of NED to body quaternions, by SciPy."""
    return Rotation.from_quat(q_body_ned[:, [1, 2, 3, 0]]).inv().as_euler("ZYX", degrees=True)[:, 0]


def of(log: Table, name: str) -> AttitudeEstimate:
    estimate = AttitudeEstimate.of(log, name)
    assert estimate is not None
    return estimate


# --- estimates ------------------------------------------------------------------------------------------------------
def test_estimates_of_quaternions_and_of_angles() -> None:
    log = Table(XKQ=xkq(40.0, np.arange(50) % 2), ATT=att(41.0))
    both = of(log, "XKQ")
    np.testing.assert_allclose(both.clock_s, CLOCK_S, rtol=0, atol=1e-9)
    expected = turned(40.0).inv().as_quat()[:, [3, 0, 1, 2]]
    np.testing.assert_allclose(np.abs(np.sum(both.q_body_ned * expected, axis=-1)), 1.0, rtol=0, atol=1e-12)
    assert both.lane.tolist() == [0, 1] * 25
    assert (both.lanes, both.has_lanes, both.is_of_lanes, both.unaligned_s) == ([0, 1], True, True, 0.0)
    assert [both.called(lane) for lane in both.lanes] == ["XKQ[0]", "XKQ[1]"]
    assert both.summary() == "XKQ[0] and XKQ[1] 5.0 Hz"
    euler = of(log, "ATT")
    np.testing.assert_allclose(yaw_deg(euler.q_body_ned), 41.0, rtol=0, atol=1e-9)
    assert (euler.lanes, euler.has_lanes, euler.is_of_lanes) == ([0], False, False)
    assert (euler.called(0), euler.summary()) == ("ATT", "ATT 10.0 Hz")
    assert AttitudeEstimate.of(log, "NKQ") is AttitudeEstimate.of(Table(X=message()), "X") is None
    once = of(Table(ATT=att(clock_s=CLOCK_S[:1])), "ATT")
    assert once.summary() == "ATT once"
    only = both.only(1, ", why")
    assert only.source == "XKQ lane 1, why"
    np.testing.assert_allclose(only.clock_s, CLOCK_S[1::2], rtol=0, atol=1e-9)
    assert euler.only(0).source == "ATT"


def test_lanes_that_had_messages_of_their_own() -> None:
    log = Table(XKQ1=xkq(40.0), XKQ3=xkq(60.0), NKQ2=xkq(70.0))
    both = of(log, "XKQ")
    assert (both.lanes, both.clock_s.size) == ([0, 2], 100)
    np.testing.assert_allclose(yaw_deg(both.only(2).q_body_ned), 60.0, rtol=0, atol=1e-9)
    assert (of(log, "XKQ3").lanes, of(log, "NKQ").lanes) == ([2], [1])
    assert [one.name for one in attitude.estimates(log)] == ["NKQ", "XKQ"]


@pytest.mark.parametrize(("rare", "is_lane"), [(4, True), (3, False)])
def test_a_lane_with_a_hundredth_of_the_samples_is_a_damaged_number(rare: int, is_lane: bool) -> None:
    clock_s = 30.0 + 0.01 * np.arange(400 + rare)
    lane = np.zeros(400 + rare, dtype=np.int64)
    lane[100 * np.arange(rare) + 7] = 1
    lane[20] = -1
    assert of(Table(XKQ=xkq(40.0, lane, clock_s)), "XKQ").lanes == ([0, 1] if is_lane else [0])


def test_damaged_samples_and_those_before_the_alignment_are_left_out() -> None:
    damaged = xkq(40.0, np.arange(50) % 2)
    for k in range(4):
        damaged[f"Q{k + 1}"][[0, 2, 4, 6, 1]] = 1.0 if k == 0 else 0.0
    damaged["Q2"][10] = 5.0
    damaged["TimeUS"][13] = 1e15
    estimate = of(Table(XKQ=damaged), "XKQ")
    used = np.delete(np.arange(50), [0, 1, 2, 4, 6, 10, 13])
    np.testing.assert_allclose(np.sort(estimate.clock_s), CLOCK_S[used], rtol=0, atol=1e-9)
    assert estimate.unaligned_s == 0.0  # of the lane that was aligned first
    for k in range(4):
        damaged[f"Q{k + 1}"][[1, 3]] = 1.0 if k == 0 else 0.0
    assert of(Table(XKQ=damaged), "XKQ").unaligned_s == pytest.approx(0.2)
    never = message(C=0, Q1=1.0, Q2=0.0, Q3=0.0, Q4=0.0)
    assert AttitudeEstimate.of(Table(XKQ=never), "XKQ") is None
    assert of(Table(AHR2=never), "AHR2").clock_s.size == 50
    assert AttitudeEstimate.usual_length(Table(XKQ=message(Q1=3.0, Q2=0.0, Q3=4.0, Q4=0.0)), "XKQ") == 5.0
    assert AttitudeEstimate.usual_length(Table(ATT=att()), "ATT") is None


# --- the lane in use ------------------------------------------------------------------------------------------------
def lanes(**messages: Message) -> Table:
    """Return a log of lanes 0 and 1, whose yaw is 40 and 60 deg."""
    clock_s = np.repeat(CLOCK_S, 2)
    both = xkq(np.tile([40.0, 60.0], 50), np.tile([0, 1], 50), clock_s)
    return Table(XKQ=both, **messages)


def test_the_lane_in_use_is_that_of_xkf4() -> None:
    log = lanes(XKF4=message(np.array([32.05, 25.0, 33.05, 34.0]), PI=np.array([1, 0, 0, nan])))
    estimate = of(log, "XKQ")
    flown = estimate.flown(log)
    expected = np.where((estimate.clock_s >= 32.05) & (estimate.clock_s < 33.05), 1, 0)
    assert flown.tolist() == expected.tolist()
    samples = estimate.primary(log)
    assert samples.source == "XKQ lane 0 and 1 by XKF4.PI"
    np.testing.assert_allclose(samples.clock_s, CLOCK_S, rtol=0, atol=1e-9)
    expected = np.where((CLOCK_S >= 32.05) & (CLOCK_S < 33.05), 60.0, 40.0)
    np.testing.assert_allclose(yaw_deg(samples.q_body_ned), expected, rtol=0, atol=1e-9)
    assert np.unique(samples.segment).size == 2
    assert samples.break_reason == "a switch of the EKF lane"
    assert estimate.primary_message == "XKF4"
    one = Table(XKQ=xkq(), XKF4=message(PI=0))
    assert of(one, "XKQ").primary(one).source == "XKQ lane 0"
    assert of(Table(ATT=att()), "ATT").flown(log) is None
    assert of(log, "XKQ").flown(Table(XKF4=message(PI=nan))) is None


@pytest.mark.parametrize(("unlogged", "source_of"), [(48, "XKQ lane 0 by XKF4.PI"), (52, "XKQ lane 1, nearest to ATT")])
def test_a_lane_that_is_not_logged_for_most_of_the_time(unlogged: int, source_of: str) -> None:
    log = lanes(XKF4=message(CLOCK_S, PI=np.where(np.arange(50) < unlogged // 2, 2, 0)), ATT=att(60.0))
    assert of(log, "XKQ").primary(log).source == source_of


def test_the_lane_nearest_to_att_is_used_without_xkf4() -> None:
    assert of(lanes(ATT=att(59.0)), "XKQ").primary(lanes(ATT=att(59.0))).source == "XKQ lane 1, nearest to ATT"
    assert of(lanes(ATT=att(45.0)), "XKQ").primary(lanes(ATT=att(45.0))).source == "XKQ lane 0, nearest to ATT"
    assert of(lanes(), "XKQ").primary(lanes()).source == "XKQ lane 0, the lowest of 0 and 1"
    # Of lanes that agree within the rounding of ATT the first is used.
    alike = Table(XKQ=xkq(np.tile([40.004, 40.001], 25), np.arange(50) % 2), ATT=att(40.0))
    assert of(alike, "XKQ").primary(alike).source == "XKQ lane 0, nearest to ATT"
    two = Table(XKQ=xkq(40.0), XKF4=message(np.array([25.0, 30.15]), PI=np.array([0, 1])), ATT=att(40.0))
    assert of(two, "XKQ").primary(two).source == "XKQ lane 0, nearest to ATT"
    few = lanes(XKF4=message(np.array([25.0, 30.15]), PI=np.array([0, 2])), ATT=att(60.0))
    assert of(few, "XKQ").primary(few).source == "XKQ lane 1, nearest to ATT"
    once = Table(XKQ=xkq(40.0), XKF4=message(CLOCK_S[:1], PI=1))
    assert of(once, "XKQ").primary(once).source == "XKQ lane 0, the lowest of 0"


# --- breaks ---------------------------------------------------------------------------------------------------------
def test_resets_of_the_yaw_are_events_and_texts() -> None:
    texts = [
        "EKF3 IMU0 MAG0 in-flight yaw alignment complete",
        "EKF2 yaw re-aligned",
        "EKF3 is using GPS",
        "ekf yaw reset",
    ]
    log = Table(
        ATT=att(),
        EV=message(np.array([31.05, 33.05, 34.05]), Id=np.array([62, 61, 62])),
        MSG=message(np.array([32.05, 30.55, 34.55, 34.75]), Message=texts),
    )
    assert attitude._resets_s(log).tolist() == pytest.approx([30.55, 31.05, 32.05, 34.05, 34.75])
    samples = of(log, "ATT").only(0)
    edges = np.searchsorted([30.55, 31.05, 32.05, 34.05, 34.75], CLOCK_S)
    assert np.unique(samples.segment, return_inverse=True)[1].tolist() == edges.tolist()
    assert samples.break_reason == "a reset of the EKF's yaw"
    short = Table(ATT=att(), MSG=message(np.array([32.05, 33.05]), Message=texts[:1]))
    assert attitude._resets_s(short).size == 0
    for name, breaks in (("XKQ2", True), ("NKF1", True), ("EKF1", True), ("AHR2", False), ("SIM", False)):
        assert bool(attitude._Breaks.of(log, name).resets_s.size) is breaks


def test_att_switches_with_the_lane_or_the_estimator() -> None:
    log = Table(
        ATT=att(aekf=np.where(np.arange(50) < 30, 3, 2)),
        XKF4=message(np.array([35.0, 30.0, 31.0]), PI=np.array([0, 0, 1])),
        NKF4=message(np.array([30.0, 30.5]), PI=np.array([0, 1])),
    )
    before_s, since_s = attitude._switches_s(log)
    np.testing.assert_allclose(since_s, [31.0, 33.0, 35.0], rtol=0, atol=1e-9)
    np.testing.assert_allclose(before_s, [30.0, 32.9, 31.0], rtol=0, atol=1e-9)
    only_ekf2 = Table(
        ATT=att(aekf=2), XKF4=message(np.array([30.0, 31.0]), PI=np.array([0, 1])), NKF4=log._messages["NKF4"]
    )
    assert [column.tolist() for column in attitude._switches_s(only_ekf2)] == [[30.0], [30.5]]
    segment, reason = attitude._Breaks.of(log, "ATT").segments(CLOCK_S, np.zeros(50, dtype=np.int64))
    assert reason == "a switch of the EKF lane"
    assert np.unique(segment[segment < 0]).size == np.count_nonzero(segment < 0)
    assert (segment[(CLOCK_S > 30.05) & (CLOCK_S < 30.95)] < 0).all()
    assert (segment[CLOCK_S < 30.05] >= 0).all()


def test_segments_of_lanes_and_resets() -> None:
    clock_s, lane = np.array([1.0, 2.0, 3.0, 4.0, 5.0, 6.0]), np.array([0, 2, 0, 2, 2, 0])
    breaks = attitude._Breaks(np.array([2.5, 4.0]), np.empty(0), np.empty(0))
    segment, reason = breaks.segments(clock_s, lane)
    # By resets before 1, 2 | 3 | 4, 5, 6 s and lane, in this order.
    assert np.unique(segment, return_inverse=True)[1].tolist() == [0, 1, 2, 4, 4, 3]
    assert reason == "a switch of the EKF lane or a reset of the EKF's yaw"
    none = attitude._Breaks(np.array([9.0]), np.empty(0), np.empty(0)).segments(clock_s, np.zeros(6, dtype=np.int64))
    assert (none[0].tolist(), none[1]) == ([0] * 6, "a switch of the EKF lane")
    switched = attitude._Breaks(np.empty(0), np.array([2.0, 4.5]), np.array([3.0, 5.0]))
    segment, _ = switched.segments(np.array([1.0, 2.0, 2.5, 2.9, 3.0, 4.5, 4.7, 5.0, 6.0]), np.zeros(9, dtype=np.int64))
    assert segment.tolist() == [0, 0, -1, -2, 1, 1, -3, 2, 2]


# --- the estimator in use and remarks -------------------------------------------------------------------------------
def test_the_estimator_in_use_by_att() -> None:
    mixed = np.where(np.arange(50) < 4, 0, np.where(np.arange(50) < 9, 2, 3))
    assert active_estimator(Table(ATT=att(aekf=mixed))) == "EKF3 82.0 %, EKF2 10.0 %, DCM 8.0 %"
    assert active_estimator(Table(ATT=att(aekf=np.where(np.arange(50) < 9, 7, 11)))) == "an external AHRS"
    assert active_estimator(Table(ATT=att(aekf=10))) == "the simulator's"
    assert active_estimator(Table(ATT=att(aekf=7))) is active_estimator(Table(XKQ=xkq())) is None
    for aekf, names in (
        (2, ("NKQ", "XKQ", "ATT")),
        (3, ("XKQ", "NKQ", "ATT")),
        (0, ("ATT", "XKQ", "NKQ")),
        (7, ("XKQ", "NKQ", "ATT")),
        (mixed, ("XKQ", "NKQ", "ATT")),
    ):
        assert attitude.preferred_messages(Table(ATT=att(aekf=aekf))) == names


def flown(log: Table) -> tuple[str, str, tuple[str, ...]]:
    found = flown_attitude(log)
    assert found is not None
    estimate, samples = found
    return estimate.name, samples.source, estimator_notes(log, estimate, samples)


def test_a_lane_that_flew_and_is_not_logged() -> None:
    primary = message(PI=np.where(np.arange(50) < 20, 0, 2))
    logged = (
        "by XKF4.PI lane 2 flew for 60.0 % of the time, but XKQ has only lane 0 and 1; ATT is of the lane that flew"
    )
    name, _, notes = flown(lanes(XKF4=primary, ATT=att(80.0)))
    assert (name, notes[0]) == ("ATT", f"{logged}, it is taken")
    name, _, notes = flown(lanes(XKF4=primary, ATT=att(40.0)))
    assert (name, notes[0]) == ("XKQ", f"{logged}, --attitude ATT takes it")
    whole = flown(lanes(XKF4=message(PI=2), ATT=att(80.0)))[2][0]
    assert whole == "by XKF4.PI lane 2 flew, but XKQ has only lane 0 and 1; ATT is of the lane that flew, it is taken"
    some = message(PI=np.where(np.arange(50) < 40, 1, 2))
    assert flown(lanes(XKF4=some, ATT=att(80.0)))[0] == "XKQ"
    assert flown(lanes(ATT=att(40.0))) == ("XKQ", "XKQ lane 0, nearest to ATT", ())
    assert flown_attitude(Table(AHR2=att())) is None


@pytest.mark.parametrize(("off_deg", "is_same"), [(0.096, True), (0.104, False)])
@pytest.mark.parametrize("trim_deg", [0.0, 3.0, -3.0])
def test_a_lane_within_a_tenth_of_a_degree_of_att_and_its_trim_is_the_same(
    off_deg: float, is_same: bool, trim_deg: float
) -> None:
    body_ned = turned(40.0) * Rotation.from_euler("Y", trim_deg + off_deg, degrees=True)
    euler = body_ned.as_euler("ZYX", degrees=True)
    of_att = message(Roll=euler[:, 2], Pitch=euler[:, 1], Yaw=euler[:, 0])
    parameters = {
        "TimeUS": np.arange(3.0),
        "Name": ["AHRS_TRIM_Y", "X", "AHRS_TRIM_Y"],
        "Value": np.array([9.0, 8.0, np.deg2rad(3.0)]),
    }
    log = Table(XKQ=xkq(), ATT=of_att, **({"PARM": parameters} if trim_deg else {}))
    lane, att_samples = of(log, "XKQ").only(0), of(log, "ATT").only(0)
    assert attitude._is_lane_of(log, lane, att_samples) is is_same
    far = source.AttitudeSamples(lane.clock_s + 900, lane.q_body_ned, lane.segment, "x")
    assert not attitude._is_lane_of(log, far, att_samples)


def test_the_last_value_of_a_parameter_counts() -> None:
    names = ["A", "B", "A", "A"]
    log = Table(PARM={"Name": names, "Value": np.array([1.5, 2.5, 3.5, nan])})
    assert [attitude._parameter(log, name) for name in ("A", "B", "C")] == [3.5, 2.5, 0.0]
    assert attitude._parameter(Table(PARM={"Name": names[:2], "Value": np.array([1.5])}), "A") == 0.0
    assert attitude._parameter(Table(), "A") == 0.0


@pytest.mark.parametrize(("off_deg", "is_reported"), [(0.96, False), (1.04, True), (-1.04, True)])
def test_a_difference_of_a_degree_is_reported(off_deg: float, is_reported: bool) -> None:
    name, _, notes = flown(Table(XKQ=xkq(359.5 + off_deg), ATT=att(359.5)))
    said = "XKQ is 1.0 deg from ATT in the median (1.0 deg in yaw); by ATT.AEKF EKF3 flew; XKQ is taken, --attitude ATT"
    assert (name, notes) == ("XKQ", (f"{said} takes the other",) if is_reported else ())


def test_a_difference_is_reported_of_what_is_read() -> None:
    no_aekf = {name: of for name, of in att(10.0).items() if name != "AEKF"}
    _, _, [note] = flown(Table(XKQ=xkq(55.0), ATT=no_aekf))
    assert note == (
        "XKQ is 45.0 deg from ATT in the median (45.0 deg in yaw); the log does not say which one flew; XKQ is taken,"
        " --attitude ATT takes the other"
    )
    log = Table(NKQ=xkq(55.0), ATT=att(10.0, 0))
    name, _, [note] = flown(log)
    assert (name, note) == (
        "ATT",
        "NKQ is 45.0 deg from ATT in the median (45.0 deg in yaw); by ATT.AEKF DCM flew; ATT is taken, --attitude NKQ"
        " takes the other",
    )
    assert flown(Table(ATT=att())) == ("ATT", "ATT", ())
    assert flown(Table(XKQ=xkq(), ATT=att(90.0, clock_s=CLOCK_S + 900)))[2] == ()


@pytest.mark.parametrize(("late_s", "is_compared"), [(0.048, True), (0.052, False)])
def test_attitudes_within_a_twentieth_of_a_second_are_compared(late_s: float, is_compared: bool) -> None:
    clock_s = CLOCK_S[::4]
    log = Table(XKQ=xkq(40.0, 0, clock_s, late_s), ATT=att(70.0, clock_s=clock_s))
    assert bool(flown(log)[2]) is is_compared


@pytest.mark.parametrize(
    ("count", "far", "late_s", "is_reported"),
    [
        (100, 2, 0.0, True),
        (200, 1, 0.0, False),
        (20, 1, 0.0, True),
        (19, 1, 0.0, False),
        (100, 5, 0.0019, True),
        (100, 5, 0.0021, False),
    ],
)
def test_a_difference_for_a_part_of_the_flight(count: int, far: int, late_s: float, is_reported: bool) -> None:
    """Of at least twenty samples at the same time to 2 ms, a hundredth."""
    clock_s = 30.0 + 0.1 * np.arange(count)
    yaw = np.where(np.arange(count) < far, 47.0, 40.0)
    notes = flown(Table(XKQ=xkq(yaw, 0, clock_s, late_s), ATT=att(40.0, clock_s=clock_s)))[2]
    angle_deg = np.rad2deg((turned(40.0, 1).inv() * turned(47.0, 1)).magnitude()[0])
    said = f"for {100 * far / count:.1f} % of the time XKQ is more than 1 deg from ATT, {angle_deg:.1f} deg at most"
    assert notes == (
        (f"{said}; by ATT.AEKF EKF3 flew; XKQ is taken, --attitude ATT takes the other",) if is_reported else ()
    )


@pytest.mark.parametrize(("unaligned", "is_reported"), [(10, False), (12, True)])
def test_samples_lost_before_the_alignment_are_reported(unaligned: int, is_reported: bool) -> None:
    late = xkq()
    for k in range(4):
        late[f"Q{k + 1}"][:unaligned] = 1.0 if k == 0 else 0.0
    left_out = "the first 1.1 s of XKQ are left out, before its EKF was aligned: 3.7 s remain"
    assert flown(Table(XKQ=late, ATT=att()))[2] == (
        (f"{left_out}; --attitude ATT covers 4.9 s",) if is_reported else ()
    )
    assert flown(Table(XKQ=late))[2] == ((left_out,) if is_reported else ())


def test_quaternions_of_another_length_are_reported() -> None:
    long = message(C=0, Q1=3.0, Q2=0.0, Q3=4.0, Q4=0.0)
    said = "is left out because its quaternions have length 5, not 1; ATT is used"
    assert flown(Table(XKQ=long, NKQ=long, ATT=att())) == ("ATT", "ATT", (f"XKQ {said}", f"NKQ {said}"))


class Reader(reader.DataFlashReader):
    """A reader of messages in memory."""

    def __init__(self, log: Records, requested: str = "auto") -> None:
        self.name, self._attitude, self._boot, self._log = "log.BIN", requested, None, log


def test_an_attitude_is_requested_by_message_and_lane() -> None:
    log = Table(XKQ=xkq(np.where(np.arange(50) % 2, 60.0, 40.0), np.arange(50) % 2), NKQ2=xkq(70.0), ATT=att(41.0))
    for requested, source_of in (
        ("auto", "XKQ lane 0, nearest to ATT"),
        ("xkq", "XKQ lane 0, nearest to ATT"),
        ("XKQ[1]", "XKQ lane 1"),
        ("xkq1", "XKQ lane 1"),
        ("ATT", "ATT"),
        ("NKQ2", "NKQ2 lane 1"),
        ("NKQ[1]", "NKQ lane 1"),
    ):
        [samples] = [of for of in Reader(log, requested).samples() if isinstance(of, source.AttitudeSamples)]
        assert (samples.source, samples.boot) == (source_of, 1)
    has = "it has ATT 10.0 Hz; NKQ[1] 10.0 Hz; XKQ[0] and XKQ[1] 5.0 Hz"
    for requested in ("XKQ[2]", "XKQ3", "AHR2", "x", ""):
        with pytest.raises(LogFormatError) as caught:
            list(Reader(log, requested).samples())
        assert str(caught.value) == f"log.BIN: the log has no attitude {requested!r}; {has}"
        assert caught.value.offset == 900
    for nothing in ("auto", "XKQ"):
        with pytest.raises(LogFormatError) as caught:
            list(Reader(Table(POS=message(), GPS=message()), nothing).samples())
        why = "no XKQ, NKQ or ATT among the messages GPS, POS in all"
        assert str(caught.value) == f"log.BIN: the log has no attitude: {why}"
    unstamped = {name: of for name, of in att().items() if name != "TimeUS"}
    with pytest.raises(LogFormatError, match=r"its ATT records are not stamped with a time .* and glstar guesses none"):
        list(Reader(Table(ATT=unstamped)).samples())
    names = [name for name, _ in Reader(log).attitudes()]
    assert names == ["ATT", "NKQ[1]", "XKQ[0]", "XKQ[1]"]
    facts = Reader(Table(ATT=att(), MSG={"Message": ["Blimp V1.2"]})).facts
    assert facts() == facts([1]) == source.LogFacts("a table", "Blimp", "Blimp V1.2", "EKF3")
    assert facts([2]) == source.LogFacts("a table")
    assert facts().unread_bytes == 7


# --- UTC and positions ----------------------------------------------------------------------------------------------
def gps(late_s: float = 0.02, **changed: object) -> Message:
    """Return records of a receiver: boot time 30 s is 11:00 UTC."""
    fields = {"I": 0, "Status": 3, "GMS": WEEK_MS + 1e3 * (CLOCK_S - 30), "GWk": WEEK}
    return message(CLOCK_S + late_s, **fields | {"Lat": -34.5, "Lng": 138.5, "Alt": 50.5, "U": 1} | changed)


def gpa(**changed: object) -> Message:
    return message(CLOCK_S + 0.02, **{"I": 0, "SMS": 1e3 * CLOCK_S} | changed)


def off_s(samples: source.ClockSamples) -> Float:
    return np.round(samples.utc_s - samples.clock_s - UTC_S + 30, 6)


def test_utc_is_that_of_the_sample_or_of_its_record() -> None:
    measured = reader._utc(Table(GPS=gps(), GPA=gpa()))
    assert measured.source == "GPS time at GPA.SMS, 50 fixes, 18 leap seconds"
    assert (set(off_s(measured)), measured.lag_is_measured) == ({0.0}, True)
    assert measured.lag_s == pytest.approx(0.02, abs=1e-9)
    np.testing.assert_allclose(measured.clock_s, CLOCK_S, rtol=0, atol=1e-9)
    assumed = reader._utc(Table(GPS=gps(0.05)))
    assert assumed.source == "GPS time when logged (no GPA), 50 fixes, 18 leap seconds"
    assert (set(off_s(assumed)), assumed.lag_s, assumed.lag_is_measured) == ({-0.03}, 0.02, False)
    other = reader._utc(Table(GPS=gps(), GPA=gpa(I=1)))
    assert other.source == "GPS time when logged (GPA.SMS is of another clock), 50 fixes, 18 leap seconds"
    old = {{"GMS": "TimeMS", "GWk": "Week"}.get(name, name): of for name, of in gps().items()}
    old["T"] = old.pop("TimeUS") / 1e3
    assert set(off_s(reader._utc(Table(GPS=old)))) == {0.0}


@pytest.mark.parametrize(
    ("written_s", "sampled_s", "is_used"),
    [(0.048, 0.0, True), (0.052, 0.0, False), (0.0, 1.96, True), (0.0, 2.04, False), (0.0, -2.04, False)],
)
def test_a_sample_belongs_to_the_record_written_with_it(written_s: float, sampled_s: float, is_used: bool) -> None:
    clock_s = CLOCK_S[::4] + 0.02
    log = Table(GPA=message(clock_s + written_s, I=0, SMS=1e3 * (clock_s - sampled_s)))
    found = reader._sampled_s(log, 0, clock_s)
    np.testing.assert_allclose(found, clock_s - sampled_s if is_used else np.full(13, nan), rtol=0, atol=1e-9)
    assert np.isnan(reader._sampled_s(log, 1, clock_s)).all()
    assert np.isnan(reader._sampled_s(Table(GPA=message(clock_s, I=0, SMS=0)), 0, clock_s)).all()


def test_the_receiver_in_use_with_a_fix_is_read() -> None:
    both = np.arange(50) % 2
    used = reader._utc(Table(GPS=gps(I=both, U=both)))
    assert used.source.endswith("25 fixes, 18 leap seconds")
    np.testing.assert_allclose(used.clock_s, CLOCK_S[1::2], rtol=0, atol=1e-9)
    many = reader._utc(Table(GPS=gps(I=np.where(np.arange(50) < 30, 1, 0), U=0)))
    assert many.clock_s.size == 30
    without = {name: of for name, of in gps(I=np.where(np.arange(50) < 20, 1, 0)).items() if name != "U"}
    assert reader._utc(Table(GPS=without)).clock_s.size == 30
    assert reader._utc(Table(GPS=gps(Status=np.arange(50) % 5))).clock_s.size == 20
    receiver, clock_s, columns = reader._fixes(
        Table(GPS=gps(I=7, Status=np.where(np.arange(50) < 9, 2, 3))), "Lat", "Alt"
    )
    assert (receiver, clock_s.size, columns[0].tolist()[0], columns[1].tolist()[0]) == (7, 41, -34.5, 50.5)
    assert reader._fixes(Table(GPS=gps(I=7, Status=0)), "Lat")[0] == 0
    assert reader._fixes(Table(GPS=gps()), "Nothing") is None


def test_readings_of_gps_for_the_search_of_boots() -> None:
    log = Table(GPS=gps(I=np.arange(50) % 2, U=np.arange(50) % 2, Status=np.where(np.arange(50) < 10, 2, 3)))
    position, clock_s, gps_s = reader._gps_readings(log)
    rows = np.arange(11, 50, 2)
    assert position.tolist() == (3 + 10 * rows).tolist()
    np.testing.assert_allclose(clock_s, CLOCK_S[rows] + 0.02, rtol=0, atol=1e-9)
    np.testing.assert_allclose(gps_s - CLOCK_S[rows] + 30, UTC_S + 18, rtol=0, atol=1e-6)
    unused = gps(I=np.where(np.arange(50) < 20, 1, 0), U=0, GWk=np.where(np.arange(50) < 3, 0, WEEK))
    assert reader._gps_readings(Table(GPS=unused))[1].size == 30
    assert [column.size for column in reader._gps_readings(Table(GPS=message(Status=3)))] == [0, 0, 0]
    assert reader._gps_readings(Table(GPS=gps(GWk=257)))[0].size == 0


@pytest.mark.parametrize(
    ("messages", "reason"),
    [
        ({}, "it has no GPS records"),
        ({"GPS": message(Status=3)}, "its GPS records have no week and milliseconds (GWk, GMS)"),
        ({"GPS": gps(Status=2)}, "its GPS never had a 3D fix and a week"),
        ({"GPS": gps(GWk=0)}, "its GPS never had a 3D fix and a week"),
        ({"GPS": gps(GWk=257)}, "its GPS says week 257, 1985: the receiver's week has rolled over"),
        (
            {"GPS": {name: of for name, of in gps().items() if name != "TimeUS"}},
            "its GPS records are not stamped with the time since boot (TimeUS or T)",
        ),
    ],
)
def test_why_a_log_has_no_utc(messages: dict[str, Message], reason: str) -> None:
    samples = reader._utc(Table(**messages))
    assert (samples.source, samples.utc_s.size) == (reason, 0)


def test_positions_of_the_estimator_or_of_the_receiver() -> None:
    pos = message(Lat=-35.5, Lng=139.5, Alt=60.5)
    samples = reader._positions(Table(POS=pos, GPS=gps()))
    assert (samples.source, samples.clock_s.size) == ("POS", 50)
    assert np.rad2deg([samples.latitude_rad[0], samples.longitude_rad[0]]).tolist() == pytest.approx([-35.5, 139.5])
    assert samples.height_m[0] == 60.5
    samples = reader._positions(Table(POS=message(Lat=0, Lng=0, Alt=0), GPS=gps(Status=np.arange(50) // 10)))
    assert (samples.source, samples.clock_s.size, samples.height_m[0]) == ("GPS", 20, 50.5)
    assert reader._positions(Table(GPS=gps(Status=2))).source == "its GPS never had a 3D fix"
    assert reader._positions(Table()).source == "it has neither POS nor GPS records"
    unstamped = {name: of for name, of in gps().items() if name != "TimeUS"}
    assert reader._positions(Table(GPS=unstamped)).source.startswith("its GPS records are not stamped")


# --- gyros, cameras, gimbal, events ---------------------------------------------------------------------------------
def gyr(clock_s: Float = CLOCK_S, x: float = 0.1, **more: object) -> Message:
    return message(clock_s, **{"I": 0, "GyrX": x, "GyrY": 0.2, "GyrZ": -0.3} | more)


@pytest.mark.parametrize(("covered", "source_of"), [(97, "GYR 0"), (94, "IMU 0")])
def test_raw_rates_are_used_if_they_cover_the_flight(covered: int, source_of: str) -> None:
    fast_s = 30.0 + 0.02 * np.arange(round(2.45 * covered))
    log = Table(IMU=gyr(), GYR=gyr(fast_s, SampleUS=1e6 * fast_s - 5e3))
    rates = reader._turn_rates(log)
    assert rates.source == source_of
    if source_of == "GYR 0":
        np.testing.assert_allclose(rates.clock_s, fast_s - 0.005, rtol=0, atol=1e-9)
    np.testing.assert_allclose(rates.rate_rad_per_s, np.tile([0.1, 0.2, -0.3], (rates.clock_s.size, 1)), rtol=1e-12)
    assert reader._turn_rates(Table(IMU=gyr(), GYR=gyr(SampleUS=CLOCK_S * 1e6))).source == "IMU 0"
    assert reader._turn_rates(Table(GYR=gyr(fast_s, SampleUS=1e6 * fast_s))).source == "GYR 0"
    assert reader._turn_rates(Table(IMU=gyr())).source == "IMU 0"
    assert reader._turn_rates(Table(GYR=gyr())) is reader._turn_rates(Table()) is None


@pytest.mark.parametrize(("late_s", "is_used"), [(1.96, True), (2.04, False)])
def test_a_raw_rate_was_sampled_up_to_two_seconds_before(late_s: float, is_used: bool) -> None:
    rates = reader._turn_rates(Table(GYR=gyr(SampleUS=1e6 * (CLOCK_S - late_s))))
    np.testing.assert_allclose(rates.clock_s, CLOCK_S - (late_s if is_used else 0.0), rtol=0, atol=1e-9)


def test_the_first_gyro_with_two_valid_rates_is_used() -> None:
    several = gyr(I=np.where(np.arange(50) < 1, 0, np.where(np.arange(50) < 30, 2, 5)))
    rates = reader._turn_rates(Table(IMU=several))
    assert (rates.source, rates.clock_s.size) == ("IMU 2", 29)
    damaged = gyr()
    damaged["GyrY"][4], damaged["TimeUS"][7] = 1e4, 1e15
    assert reader._turn_rates(Table(IMU=damaged)).clock_s.size == 48
    assert reader._turn_rates(Table(IMU2=gyr(x=0.5))).source == "IMU2 0"
    assert reader._turn_rates(Table(IMU3=gyr(CLOCK_S[:1]))) is None
    assert reader._turn_rates(Table(IMU3=gyr(CLOCK_S[:2]))).clock_s.size == 2


def test_triggers_of_each_camera() -> None:
    shots_s = np.array([31.0, 32.0, 33.0, 34.0])
    sent = message(shots_s, I=np.array([0, 1, 0, 1]))
    found = list(reader._triggers(Table(TRIG=sent, CAM=message(shots_s[2:3] + 0.1, I=0))))
    assert [(one.source, one.camera, one.clock_s.tolist()) for one in found] == [
        ("CAM", "camera:0", [33.1]),
        ("TRIG", "camera:1", [32.0, 34.0]),
    ]
    assert found[0].notes == ("1 of 2 triggers of camera:0 (TRIG) have no answer (CAM)",)
    assert (found[1].notes, np.isnan(found[1].utc_s).all()) == ((), np.True_)
    [plain] = reader._triggers(Table(CAM=message(np.array([31.0, 32.0, 1e9, nan]))))
    assert (plain.camera, plain.clock_s.tolist(), plain.notes) == ("camera", [31.0, 32.0], ())
    equal = list(reader._triggers(Table(TRIG=message(shots_s), CAM=message(shots_s))))
    assert [one.notes for one in equal] == [()]
    assert list(reader._triggers(Table(CAM=message(shots_s, I=300)))) == []


def mnt(**changed: object) -> Message:
    return message(**{"I": 0, "Roll": 11.0, "Pitch": -23.0, "YawB": 37.0, "YawE": nan} | changed)


def test_the_gimbal_has_a_yaw_against_north_or_the_heading() -> None:
    gimbal = reader._gimbal(Table(MNT=mnt(YawE=np.where(np.arange(50) < 20, 77.0, nan))))
    for row, yaw in ((0, 77.0), (49, 37.0)):
        expected = Rotation.from_euler("ZYX", [yaw, -23.0, 11.0], degrees=True).inv().as_quat()[[3, 0, 1, 2]]
        assert abs(gimbal.q_gimbal_reference[row] @ expected) == pytest.approx(1.0, abs=1e-12)
    assert gimbal.is_earth.tolist() == [True] * 20 + [False] * 30
    assert gimbal.source == "MNT"
    np.testing.assert_allclose(gimbal.clock_s, CLOCK_S, rtol=0, atol=1e-9)
    several = reader._gimbal(Table(MNT=mnt(I=np.where(np.arange(50) < 20, 3, 1))))
    np.testing.assert_allclose(several.clock_s, CLOCK_S[20:], rtol=0, atol=1e-9)
    damaged = mnt(Pitch=np.where(np.arange(50) < 2, nan, 1.0))
    damaged["TimeUS"][7] = 1e15
    assert reader._gimbal(Table(MNT=damaged)).clock_s.size == 47
    one = mnt(Pitch=np.where(np.arange(50) < 49, nan, 1.0))
    assert (
        reader._gimbal(Table(MNT=one)) is reader._gimbal(Table(MNT=mnt(Pitch=nan))) is reader._gimbal(Table()) is None
    )
    two = mnt(Pitch=np.where(np.arange(50) < 48, nan, 1.0))
    assert reader._gimbal(Table(MNT=two)).clock_s.size == 2
    assert reader._gimbal(Table(MNT=message(Roll=1.0))) is None


def test_modes_and_messages() -> None:
    texts = ["armed", "lost", "landed"]
    log = Table(
        MODE=message(CLOCK_S[:5], ModeNum=np.array([10, 10, nan, 12, 99])),
        MSG=message(np.array([31.0, 1e9, 33.0]), Message=texts),
    )
    modes, messages = reader._events(log, "ArduPlane")
    assert (modes.texts, modes.clock_s.round(6).tolist()) == (("AUTO", "LOITER", "mode 99"), [30.0, 30.3, 30.4])
    assert set(modes.kinds) == {EventKind.MODE}
    assert (messages.texts, messages.clock_s.tolist()) == (("armed", "landed"), [31.0, 33.0])
    assert set(messages.kinds) == {EventKind.MESSAGE}
    [old] = reader._events(Table(MODE=message(CLOCK_S[:2], Mode=np.array([5, 6]), ModeNum=nan)), None)
    assert old.texts == ("mode 5", "mode 6")
    assert list(reader._events(Table(MSG=message(CLOCK_S[:2], Message=texts)), None)) == []
    assert list(reader._events(Table(MODE=message(CLOCK_S[:0], Mode=np.empty(0))), None)) == []


@pytest.mark.parametrize(
    ("messages", "vehicle", "firmware"),
    [
        ({"MSG": {"Message": ["x", "ArduPlane V4.5.1 (1a2b3c4d) y"]}}, "ArduPlane", "ArduPlane V4.5.1 (1a2b3c4d)"),
        ({"MSG": {"Message": ["APM:Copter V3.3 (acf71d5f)"]}}, "ArduCopter", "APM:Copter V3.3 (acf71d5f)"),
        ({"MSG": {"Message": ["Rover V4.2.0-dev"]}, "VER": {"FWS": ["Blimp V1.2"]}}, "Blimp", "Blimp V1.2"),
        ({"MSG": {"Message": ["Frame: QUAD"]}, "VER": {"BU": np.array([7.0])}}, "ArduSub", None),
        ({"VER": {"BU": np.array([13.0, 3.0])}}, "ArduCopter", None),
        ({"VER": {"BU": np.array([99.0])}, "PARM": {"Name": ["X", "THR_MID", "PILOT_THR_BHV"]}}, "ArduCopter", None),
        ({"PARM": {"Name": ["THR_MID", "ROLL_LIMIT_DEG"]}}, None, None),
        ({"PARM": {"Name": ["JS_GAIN_DEFAULT"]}}, "ArduSub", None),
        ({"VER": {"BU": np.empty(0)}}, None, None),
    ],
)
def test_the_vehicle_of_a_log(messages: dict[str, Message], vehicle: str | None, firmware: str | None) -> None:
    facts = reader._facts(Table(**messages, ATT=att()))
    assert facts == source.LogFacts("a table", vehicle, firmware, "EKF3")


@pytest.mark.parametrize(
    ("number", "vehicle"),
    [
        (1, "ArduRover"),
        (2, "ArduCopter"),
        (3, "ArduPlane"),
        (4, "AntennaTracker"),
        (7, "ArduSub"),
        (12, "Blimp"),
        (13, "ArduCopter"),
    ],
)
def test_vehicles_by_the_type_of_their_build(number: int, vehicle: str) -> None:
    """APM_BUILD_... in AP_Vehicle/AP_Vehicle_Type.h; 13 is a helicopter."""
    assert reader._facts(Table(VER={"BU": np.array([float(number)])})).vehicle == vehicle
    assert set(reader._BY_BUILD_TYPE) == {1, 2, 3, 4, 7, 12, 13}
