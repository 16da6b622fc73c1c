"""The choice among the topics of a bag, with topics made of arrays instead of files."""

from collections.abc import Callable

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from glstar.arrays import Float
from glstar.errors import ConfigError, LogFormatError
from glstar.telemetry import source
from glstar.telemetry.bags import BagOptions, BagReader, _distance_deg, _doubts_of_position, _shared_parts
from glstar.telemetry.bags.storage import Bag
from glstar.telemetry.bags.topics import (
    CAMERA,
    FIX,
    GEO,
    IMU,
    PX4_ATTITUDE,
    PX4_ODOMETRY,
    TIME,
    Topic,
)
from tests.telemetry.test_bagtopics import POSE, topic_of

ODOMETRY, STAMPED = "nav_msgs/msg/Odometry", "geometry_msgs/msg/QuaternionStamped"
UTC_S = 1710068400.0
TIMES_S = UTC_S + 3.0 + 0.04 * np.arange(151)
PLACE = (-34.5, 138.5, 50.5)
NED_OF_ENU = Rotation.from_matrix(np.array([[0.0, 1, 0], [1, 0, 0], [0, 0, -1]]))
FRD_OF_FLU = Rotation.from_matrix(np.diag([1.0, -1, -1]))


def flown(times_s: Float, speed: float = 1.0) -> Rotation:
    """Return the orientations of a flight, body to world."""
    past_s = speed * (times_s - TIMES_S[0])
    angles = np.stack([20 * np.sin(1.3 * past_s), 15 * np.cos(1.1 * past_s), 10 * np.sin(0.9 * past_s)], axis=-1)
    return Rotation.from_euler("ZYX", angles, degrees=True)


def rates(times_s: Float, speed: float = 1.0) -> Float:
    """Return the turn rates of the flight about the axes of the body, rad/s."""
    return (flown(times_s - 1e-3, speed).inv() * flown(times_s + 1e-3, speed)).as_rotvec() / 2e-3


def imu(name: str = "/imu", speed: float = 1.0, rate_speed: float | None = None, **more: object) -> Topic:
    rate = rates(TIMES_S, speed if rate_speed is None else rate_speed)
    return topic_of(name, IMU, times_s=TIMES_S, rotation=flown(TIMES_S, speed), rate_rad_per_s=rate, **more)


def pose(name: str = "/pose", kind: str = POSE, speed: float = 1.0, **more: object) -> Topic:
    return topic_of(name, kind, times_s=TIMES_S, rotation=flown(TIMES_S, speed), **more)


def fix(name: str = "/fix", kind: str = FIX, place: tuple[float, float, float] = PLACE, count: int = 20) -> Topic:
    return topic_of(name, kind, times_s=TIMES_S[:count], position=np.tile(place, (count, 1)))


def time_of(name: str, ahead_s: float, count: int = 10, **more: object) -> Topic:
    return topic_of(name, TIME, times_s=TIMES_S[:count], utc_s=TIMES_S[:count] + ahead_s, **more)


def reader(*of: Topic, name: str = "log.bag", **options: object) -> BagReader:
    """Return the reader of a bag with these topics."""
    opened = BagReader(name, **options)
    opened.__dict__["_bag"] = Bag(name, "ROS 2 bag", {t.name: t for t in of}, {t.kind for t in of}, ["a note"], 17)
    return opened


def by_kind(opened: BagReader) -> dict[type, list[source.Samples]]:
    found: dict[type, list[source.Samples]] = {}
    for batch in opened.samples():
        found.setdefault(type(batch), []).append(batch)
    return found


def attitude(*of: Topic, **options: object) -> source.AttitudeSamples:
    return by_kind(reader(*of, **options))[source.AttitudeSamples][0]


def refusal(act: Callable[[], object]) -> str:
    with pytest.raises(LogFormatError) as caught:
        act()
    return str(caught.value).removeprefix("log.bag: ")


# --- options --------------------------------------------------------------------------------------------------------
def test_options_are_read_from_columns() -> None:
    assert BagOptions.of(None) == BagOptions.of("") == BagOptions("", "", "", "auto", "auto")
    options = BagOptions.of("world=NED,body=FRD,position=/a/fix,rates=/imu,utc=/t")
    assert options == BagOptions("/a/fix", "/imu", "/t", "NED", "FRD")
    with pytest.raises(ConfigError, match=r"columns: world must be one of auto, ENU, NED, NWU, not 'ned'"):
        BagOptions.of("world=ned")
    with pytest.raises(ConfigError, match=r"columns: body must be one of auto, FLU, FRD, not ''"):
        BagOptions.of("body")
    with pytest.raises(ConfigError, match=r"columns: 'rate=/imu' says nothing about a bag \(did you mean rates\?\)"):
        BagOptions.of("utc=/t,rate=/imu")


# --- a whole flight -------------------------------------------------------------------------------------------------
def test_a_flight_of_an_imu_with_everything() -> None:
    info = topic_of("/cam/camera_info", CAMERA, times_s=TIMES_S[5:9])
    found = by_kind(reader(imu(), fix(), time_of("/gps/time", 7.25), info, fix("/empty", place=(np.nan,) * 3)))

    assert set(found) == {
        source.AttitudeSamples,
        source.PositionSamples,
        source.ClockSamples,
        source.RateSamples,
        source.TriggerSamples,
    }
    (attitudes,), (positions,), (clock,), (gyros,), (triggers,) = found.values()
    np.testing.assert_array_equal(attitudes.clock_s, TIMES_S)
    expected = (NED_OF_ENU * flown(TIMES_S) * FRD_OF_FLU).inv().as_quat()[:, [3, 0, 1, 2]]
    np.testing.assert_allclose(np.abs(np.sum(attitudes.q_body_ned * expected, axis=-1)), 1.0, rtol=0, atol=1e-9)
    np.testing.assert_allclose(np.linalg.norm(attitudes.q_body_ned, axis=-1), 1.0, rtol=0, atol=1e-12)
    assert set(attitudes.segment.tolist()) == {0}
    assert (attitudes.source, attitudes.break_reason) == ("/imu", "")
    assert attitudes.notes == (
        "orientations of /imu are taken from FLU to ENU (--columns world=...,body=...)",
        "a note",
    )
    np.testing.assert_array_equal(positions.clock_s, TIMES_S[:20])
    np.testing.assert_allclose(np.rad2deg(positions.latitude_rad), -34.5, rtol=1e-12)
    assert positions.source == "/fix"
    np.testing.assert_array_equal(clock.clock_s, TIMES_S[:10])
    np.testing.assert_allclose(clock.utc_s - clock.clock_s, 7.25, rtol=0, atol=1e-6)
    assert clock.source == "/gps/time, 10 readings"
    np.testing.assert_allclose(gyros.rate_rad_per_s, rates(TIMES_S) * [1, -1, -1], rtol=0, atol=1e-6)
    np.testing.assert_array_equal(gyros.clock_s, TIMES_S)
    assert gyros.source == "/imu"
    np.testing.assert_array_equal(triggers.clock_s, TIMES_S[5:9])
    assert np.isnan(triggers.utc_s).all()
    assert (triggers.source, triggers.camera) == ("/cam/camera_info", "/cam/camera_info")


def test_facts_and_attitudes_of_a_bag() -> None:
    assert BagReader.one_clock
    opened = reader(imu(), pose("/x/pose", "geometry_msgs/msg/PoseStamped"), fix())
    assert opened.facts() == source.LogFacts("ROS 2 bag", unread_bytes=17)
    assert opened.facts().unread_bytes == 17
    assert [name for name, _ in opened.attitudes()] == ["/imu", "/x/pose"]
    assert [samples.source for _, samples in opened.attitudes()] == ["/imu", "/x/pose"]


@pytest.mark.parametrize("is_whole", [True, False])
def test_orientations_of_other_axes_and_without_unit_length(is_whole: bool) -> None:
    topic = pose(frame_id="map_ned")
    table = np.frombuffer(topic._cells, dtype=np.float64).reshape(151, -1)
    table[:, 2:6] *= 1.004
    if not is_whole:
        table[7, 2:6] *= 1.1
        table[9, 1] = np.nan
    samples = attitude(topic, fix())

    used = np.arange(151) if is_whole else np.delete(np.arange(151), [7, 9])
    np.testing.assert_array_equal(samples.clock_s, TIMES_S[used])
    expected = flown(TIMES_S).inv().as_quat()[used][:, [3, 0, 1, 2]]
    np.testing.assert_allclose(np.abs(np.sum(samples.q_body_ned * expected, axis=-1)), 1.0, rtol=0, atol=1e-9)
    np.testing.assert_allclose(np.linalg.norm(samples.q_body_ned, axis=-1), 1.0, rtol=0, atol=1e-12)
    assert samples.notes[0] == "orientations of /pose are taken from FRD to NED (--columns world=...,body=...)"


HEAD = "(--columns world=...,body=...)"
RELATIVE = "its azimuth may be relative to the start"


def test_notes_on_the_world_of_an_attitude() -> None:
    down = np.tile([0.0, 0.0, -9.8], (151, 1))
    still = Rotation.identity(151)
    upside = topic_of("/imu", IMU, times_s=TIMES_S, rotation=still, acceleration=down, frame_id="imu_ned")
    accelerometers = "its accelerometers find up opposite to the third axis of its world"
    notes = reader(upside)._attitude_of(upside).notes
    assert notes == (f"orientations of /imu are taken from FRD to NED {HEAD}: {accelerometers}",)
    notes = reader(upside, columns="world=NED")._attitude_of(upside).notes
    assert notes == (f"orientations of /imu are taken from FRD to NED {HEAD}",)
    named = imu(frame_id="imu_ned")
    sensor = "the frame 'imu_ned' is the sensor's and does not say what its world is"
    assert reader(named)._attitude_of(named).notes == (
        f"orientations of /imu are taken from FLU to ENU {HEAD}: {sensor}",
    )
    assert reader(named, columns="world=NWU")._attitude_of(named).notes == (
        f"orientations of /imu are taken from FLU to NWU {HEAD}",
    )
    for kind, short in ((POSE, "PoseStamped"), (ODOMETRY, "Odometry"), (STAMPED, None)):
        local = pose("/p", kind, frame_id="odom")
        relative = () if short is None else (f"/p is {short} in 'odom': {RELATIVE}",)
        assert reader(local)._attitude_of(local).notes[1:] == relative
    for frame, is_relative in (("NED", False), ("FRD", True)):
        px4 = pose("/p", PX4_ODOMETRY, frame_id=frame)
        relative = (f"/p is VehicleOdometry in 'FRD': {RELATIVE}",) if is_relative else ()
        assert reader(px4)._attitude_of(px4).notes[1:] == relative


def test_a_reset_of_the_estimator_begins_a_segment() -> None:
    resets = np.where(np.arange(151) < 40, 2.0, np.where(np.arange(151) < 90, 3.0, 255.0))
    px4 = pose("/fmu/out/vehicle_attitude", PX4_ATTITUDE, frame_id="NED", resets=resets)
    samples = reader(px4)._attitude_of(px4)
    assert samples.segment.tolist() == [0] * 40 + [1] * 50 + [2] * 61
    assert samples.segment.dtype == np.int64
    assert samples.break_reason == "attitude resets"
    assert set(reader(imu())._attitude_of(imu()).segment.tolist()) == {0}


# --- the choice of an attitude --------------------------------------------------------------------------------------
@pytest.mark.parametrize(
    ("better", "worse"),
    [
        (imu("/imu"), imu("/camera/imu")),  # of the aircraft before another device
        (imu("/imu"), pose("/a_pose")),  # measured before unknown
        (pose("/mavros/pose"), pose("/b_pose", GEO)),  # of an autopilot before a better kind
        (pose("/b_pose", GEO), pose("/a_pose", POSE)),  # by kind
        (pose("/a_pose", POSE), pose("/b_pose", STAMPED)),
    ],
)
def test_the_better_of_two_attitudes_is_used(better: Topic, worse: Topic) -> None:
    for of in ((better, worse), (worse, better)):
        assert attitude(*of, fix()).source == better.name


def test_of_equal_attitudes_that_with_more_orientations_is_used() -> None:
    few = topic_of("/a_imu", IMU, times_s=TIMES_S[:100], rotation=flown(TIMES_S[:100]))
    assert attitude(few, imu("/b_imu"), fix()).source == "/b_imu"
    assert attitude(imu("/b_imu"), few, fix()).source == "/b_imu"
    autopilot = imu("/mavros/imu/data")
    assert attitude(few, imu("/b_imu"), autopilot, fix()).source == "/mavros/imu/data"


def test_a_named_attitude_is_used_or_refused_with_the_known_ones() -> None:
    of = (imu(), pose("/a/setpoint"), fix())
    assert attitude(*of, attitude="/a/setpoint").source == "/a/setpoint"
    planned = "by its name where something should be or another thing is, not a measurement"
    notes = attitude(*of, attitude="/a/setpoint").notes
    assert f"/a/setpoint is used because it is named: {planned}" in notes
    assert f"passed over: /a/setpoint ({planned})" in attitude(*of).notes
    message = "the bag has no attitude '/b' (--attitude); it has /imu (Imu), /a/setpoint (PoseStamped)"
    assert refusal(lambda: attitude(*of, attitude="/b")) == message
    assert refusal(lambda: attitude(fix(), attitude="/b")) == "the bag has no attitude '/b' (--attitude); it has none"


def test_why_a_bag_has_no_attitude() -> None:
    planned = "by its name where something should be or another thing is, not a measurement"
    many = [pose(f"/goal{k}") for k in range(5)]
    listed = "; ".join(f"/goal{k} (PoseStamped): {planned}" for k in range(4))
    assert refusal(lambda: attitude(*many)) == (
        f"the bag has no attitude that can be used: {listed} (--attitude takes it nevertheless)"
    )
    empty = topic_of("/imu", IMU, times_s=TIMES_S)
    assert refusal(lambda: attitude(empty)) == (
        "the bag has no attitude that can be used: /imu (Imu): it has no unit quaternions"
    )
    empty.unmeasured = 3
    assert refusal(lambda: attitude(empty)).endswith("/imu (Imu): its covariance says that it has no orientation")
    undefined = [Topic(f"/a{k}", PX4_ATTITUDE, undefined=True) for k in range(5)]
    named = ", ".join(f"/a{k} (px4_msgs/VehicleAttitude)" for k in range(4))
    assert refusal(lambda: attitude(*undefined, Topic("/b", IMU))) == (
        f"the bag has no definitions of the messages of {named}, which older recorders left out;"
        " convert it to MCAP where their package is installed: ros2 bag convert"
    )
    assert refusal(attitude) == "the bag has no attitude: no Imu, Pose or Odometry; it has no messages"
    opened = reader(fix())
    opened._bag.kinds |= {"", *(f"z/msg/K{k}" for k in range(9))}
    kinds = ", ".join(["sensor_msgs/NavSatFix", *(f"z/K{k}" for k in range(7))])
    assert refusal(lambda: list(opened.samples())) == (
        f"the bag has no attitude: no Imu, Pose or Odometry; it has {kinds}"
    )


def doubt(topic: Topic, *others: Topic) -> str:
    return reader(topic, *others)._doubt(topic)


def test_doubts_of_an_attitude() -> None:
    assert doubt(imu()) == ""
    half = imu()
    for half.unknown, expected in ((75, ""), (76, "its covariance says that its orientation is not known")):
        assert doubt(half) == expected
    assert doubt(pose("/gimbal/pose")) == "by its name of a gimbal"
    for frame in ("camera_frame", "cam", "lidar", "optical_frame"):
        assert doubt(pose(frame_id=frame)) == f"its frame {frame!r} is that of a sensor"
    for frame in ("ecef", "earth"):
        assert doubt(pose(frame_id=frame)) == f"its frame {frame!r} is that of the Earth"
    assert doubt(pose(frame_id="earth_camera")) == "its frame 'earth_camera' is that of a sensor"
    assert doubt(pose(frame_id="camera_ned")) == doubt(pose(frame_id="earth_enu")) == ""
    assert doubt(imu(frame_id="camera_imu")) == ""
    assert doubt(imu(frame_id="camera_optical")) == "its frame 'camera_optical' is that of a sensor"
    held = pose()
    held.child_frame_id = "camera_link"
    assert doubt(held) == "its body 'camera_link' is a sensor"


def test_an_attitude_is_frozen_beside_others_of_its_vehicle() -> None:
    still = topic_of("/still", POSE, times_s=TIMES_S, rotation=Rotation.identity(151))
    assert doubt(still, imu()) == "its orientation is constant while that of /imu turns"
    assert doubt(still) == doubt(still, pose("/goal")) == doubt(still, fix()) == ""
    of_one = topic_of("/uav1/still", POSE, times_s=TIMES_S, rotation=Rotation.identity(151))
    assert doubt(of_one, imu("/uav2/imu")) == ""
    assert doubt(of_one, imu("/uav2/imu"), imu("/uav1/imu")) == (
        "its orientation is constant while that of /uav1/imu turns"
    )


def test_attitudes_that_turn_otherwise() -> None:
    """The autopilot's or an Imu's is used beside poses; two of a kind are refused unless gyros decide."""
    odd = pose("/odd", speed=2.0)
    samples = attitude(imu(), odd, fix())
    assert samples.source == "/imu"
    assert "passed over: /odd, which do not turn as /imu does (--attitude)" in samples.notes
    assert not any("/odd" in note for note in attitude(imu(), pose("/odd"), fix()).notes)
    said = refusal(lambda: attitude(imu("/imu"), imu("/imu_b", speed=2.0), fix()))
    differs_deg = imu("/imu_b", speed=2.0).turns_otherwise(imu("/imu"))
    remedy = "they are not of one body, and nothing says which is the aircraft; name one with --attitude"
    assert said == f"the angles that /imu and /imu_b turn by differ by {differs_deg:.0f} deg: {remedy}"
    assert refusal(lambda: attitude(pose("/a"), odd, fix())).startswith("the angles that /a and /odd turn by differ by")
    gyros = topic_of("/gyros", IMU, times_s=TIMES_S, rate_rad_per_s=rates(TIMES_S, 2.0))
    samples = attitude(pose("/a"), odd, gyros, fix())
    assert samples.source == "/odd"
    assert "passed over: /a, which do not turn as /odd does (--attitude)" in samples.notes
    assert attitude(imu(), imu("/camera/imu", speed=2.0), fix()).source == "/imu"


# --- vehicles -------------------------------------------------------------------------------------------------------
def test_a_flight_is_of_one_vehicle() -> None:
    two = (imu("/uav1/imu"), imu("/uav2/imu", speed=2.0), fix("/uav2/fix"), fix("/uav1/fix", place=(1.5, 2.5, 3.5)))
    first = by_kind(reader(*two))
    assert first[source.AttitudeSamples][0].source == "/uav1/imu"
    assert first[source.PositionSamples][0].source == "/uav1/fix"
    held = "the bag holds 2 vehicles (uav1, uav2); this flight is {} (--vehicle takes another one)"
    assert held.format("uav1") in first[source.AttitudeSamples][0].notes
    second = by_kind(reader(*two, vehicle="/uav2/"))
    assert second[source.AttitudeSamples][0].source == "/uav2/imu"
    assert second[source.PositionSamples][0].source == "/uav2/fix"
    assert held.format("uav2") in second[source.AttitudeSamples][0].notes
    assert attitude(*two, attitude="/uav2/imu").source == "/uav2/imu"
    assert attitude(*two, attitude="/uav2/imu", vehicle="uav2").source == "/uav2/imu"
    both = {"attitude": "/uav2/imu", "vehicle": "uav1"}
    assert refusal(lambda: attitude(*two, **both)) == "/uav2/imu (--attitude) is not of uav1 (--vehicle)"
    unknown = "the bag has no vehicle 'x' (--vehicle); it has uav1, uav2"
    assert refusal(lambda: attitude(*two, vehicle="x")) == unknown
    unknown = "the bag has no vehicle 'x' (--vehicle); it has one vehicle, without a name"
    assert refusal(lambda: attitude(imu(), vehicle="x")) == unknown


def test_the_vehicle_with_a_position_and_more_attitudes_is_flown() -> None:
    short = topic_of("/uav1/imu", IMU, times_s=TIMES_S[:90], rotation=flown(TIMES_S[:90]))
    assert attitude(short, imu("/uav2/imu")).source == "/uav2/imu"
    assert attitude(short, imu("/uav2/imu"), fix("/uav1/fix")).source == "/uav1/imu"
    assert attitude(short, imu("/uav2/imu"), fix("/uav1/goal/fix")).source == "/uav2/imu"
    assert attitude(short, imu("/uav2/imu"), fix("/uav1/fix", place=(np.nan,) * 3)).source == "/uav2/imu"
    doubtful = [pose("/uav2/goal"), pose("/uav2/target")]
    assert (
        attitude(
            short, topic_of("/uav2/imu", IMU, times_s=TIMES_S[:80], rotation=flown(TIMES_S[:80])), *doubtful
        ).source
        == "/uav1/imu"
    )


def test_shared_topics_are_of_every_vehicle_unless_one_has_its_own() -> None:
    two = (imu("/uav1/imu"), imu("/uav2/imu", speed=2.0))
    assert by_kind(reader(*two, fix("/fix")))[source.PositionSamples][0].source == "/fix"
    [position] = by_kind(reader(*two, fix("/uav2/fix"), vehicle="uav1"))[source.PositionSamples]
    assert position.clock_s.size == 0
    assert position.source == "uav1 has none; --columns position= takes another one of /uav2/fix"


# --- positions ------------------------------------------------------------------------------------------------------
def position(*of: Topic, **options: object) -> source.PositionSamples:
    return by_kind(reader(*of, **options))[source.PositionSamples][0]


def test_the_position_is_by_name_and_kind() -> None:
    assert position(imu("/a/imu"), fix("/b/fix"), fix("/a/fix")).source == "/a/fix"
    assert position(imu("/a/imu"), fix("/a/base/fix"), fix("/b/fix")).source == "/b/fix"
    geo = topic_of("/b", GEO, times_s=TIMES_S, position=np.tile(PLACE, (151, 1)))
    assert position(imu(), geo, fix("/fix")).source == "/fix"
    assert position(imu(), fix("/x", count=10), fix("/y", count=30)).source == "/y"
    assert position(imu(), fix("/goal"), fix("/y", count=5)).source == "/y"
    assert position(imu(), fix("/x"), fix("/y", count=5), columns="position=/y").source == "/y"
    none = position(imu(), fix("/x", place=(np.nan,) * 3), fix("/y", place=(0.0, 0.0, 0.0)))
    assert (none.source, none.clock_s.size) == ("/x, /y never had a fix", 0)
    none = position(imu(), fix("/x"), fix("/y", place=(0.0, 0.0, 0.0)), columns="position=/y")
    assert (none.source, none.clock_s.size) == ("/y never had a fix", 0)
    assert position(imu()).source == "it has no NavSatFix"
    assert position(imu(), fix("/goal")).source == (
        "this vehicle has none; --columns position= takes another one of /goal"
    )
    said = refusal(lambda: position(imu(), fix(), columns="position=/z"))
    assert said == "the bag has no position '/z' (--columns position=); it has /fix"


def test_positions_of_an_attitude_that_turns_otherwise_are_not_used() -> None:
    odd = topic_of("/b", GEO, times_s=TIMES_S, rotation=flown(TIMES_S, 2.0), position=np.tile(PLACE, (151, 1)))
    assert position(imu(), odd).source == "this vehicle has none; --columns position= takes another one of /b"


@pytest.mark.parametrize(("north_deg", "is_refused"), [(0.0192, False), (0.0208, True)])
def test_positions_of_one_name_space_far_from_each_other_are_refused(north_deg: float, is_refused: bool) -> None:
    of = (imu("/a/imu"), fix("/a/fix"), fix("/a/fix_b", count=9, place=(PLACE[0] + north_deg, *PLACE[1:])))
    if is_refused:
        said = refusal(lambda: position(*of))
        far = "/a/fix and /a/fix_b are 2 km from each other, and nothing says which is the aircraft"
        assert said == f"{far}; name one with --columns position=TOPIC"
    else:
        assert position(*of).source == "/a/fix"
    # Of another name space it is not as good.
    assert position(*of[:2], fix("/b/fix", place=(1.5, 2.5, 3.5))).source == "/a/fix"
    assert position(*of[:2], fix("/a/base/fix", place=(1.5, 2.5, 3.5))).source == "/a/fix"


def test_distances_and_names_in_common() -> None:
    def at(latitude_deg: float, longitude_deg: float) -> source.PositionSamples:
        rows = np.array([latitude_deg, latitude_deg, 89.0]), np.array([longitude_deg, longitude_deg, 3.0])
        return source.PositionSamples(np.zeros(3), *(np.deg2rad(row) for row in rows), np.zeros(3), "x")

    assert _distance_deg(at(60.0, 20.0), at(60.03, 20.08)) == pytest.approx(0.05, rel=1e-3)
    assert _distance_deg(at(60.0, 20.0), at(60.0, 20.0)) == 0.0
    assert [_shared_parts("/a/b/imu", other) for other in ("/a/b/fix", "/a/c/imu", "a/b/imu/", "/x/b/imu", "/a")] == [
        *(2, 1, 3, 0, 1)
    ]
    doubtful = "/uav2/fix may be of another vehicle than /uav1/imu, by their name spaces (--columns position=TOPIC)"
    assert _doubts_of_position("/uav1/imu", "/uav2/fix") == (doubtful,)
    assert _doubts_of_position("/uav1/imu", "/uav1/fix") == ()


# --- UTC ------------------------------------------------------------------------------------------------------------
def clock_of(*of: Topic, **options: object) -> source.ClockSamples:
    return by_kind(reader(*of, **options))[source.ClockSamples][0]


def test_the_best_time_reference_is_used() -> None:
    assert clock_of(imu(), time_of("/a", 1.0), time_of("/b", 1.0, 30)).source == "/b, 30 readings"
    assert clock_of(imu(), time_of("/gps/t", 1.0), time_of("/b", 1.0, 30)).source == "/gps/t, 10 readings"
    assert clock_of(imu(), time_of("/camera/gps", 1.0, 30), time_of("/b", 1.0)).source == "/b, 10 readings"
    never_set = time_of("/gps/t", -86500.0, 30)
    assert clock_of(imu(), never_set, time_of("/gps/b", 1.0)).source == "/gps/b, 10 readings"
    assert clock_of(imu(), time_of("/gps/t", -86300.0, 30), time_of("/gps/b", 1.0)).source == "/gps/t, 30 readings"
    assert clock_of(imu(), time_of("/a", 1.0), time_of("/b", 1.0, 30), columns="utc=/a").source == "/a, 10 readings"
    origin = time_of("/a", 1.0)
    origin.origin = "pps"
    assert clock_of(imu(), origin, time_of("/b", 1.0, 30)).source == "/a, 10 readings"


def test_a_time_reference_of_another_scale_is_converted_and_reported() -> None:
    gps = reader(imu(late_s=3.0), time_of("/t", 21.0, late_s=3.0))
    [clock] = by_kind(gps)[source.ClockSamples]
    np.testing.assert_allclose(clock.utc_s - clock.clock_s, 3.0, rtol=0, atol=1e-6)
    notes = by_kind(gps)[source.AttitudeSamples][0].notes
    assert "/t count GPS time, as the clock of the recorder shows: converted to UTC" in notes


@pytest.mark.parametrize(("ahead_s", "is_reported"), [(0.19, False), (0.21, True), (-0.21, True)])
def test_time_references_that_differ_are_reported(ahead_s: float, is_reported: bool) -> None:
    notes = attitude(imu(), fix(), time_of("/b", 1.0, 30), time_of("/c", 1.0 + ahead_s)).notes
    remark = f"the UTC of /c differs by {ahead_s:.3f} s from /b, which is used (--columns utc=TOPIC)"
    assert (remark in notes) is is_reported
    assert sum("the UTC of" in note for note in notes) == is_reported


def test_a_time_reference_without_utc_is_passed_over() -> None:
    notes = attitude(imu(), fix(), time_of("/b", 1.0), time_of("/c", -1e9)).notes
    assert "/c is passed over: it counts no UTC" in notes
    assert not any("/b" in note for note in notes)


def test_stamps_are_utc_of_the_computer_or_none() -> None:
    clock = clock_of(imu(), fix())
    assert clock.source == "stamps of /imu, by the clock of the computer"
    np.testing.assert_array_equal(clock.clock_s, TIMES_S)
    np.testing.assert_array_equal(clock.utc_s, TIMES_S)
    ahead = topic_of("/imu", IMU, times_s=TIMES_S, rotation=flown(TIMES_S), late_s=-18.0)
    clock = clock_of(ahead)
    np.testing.assert_allclose(clock.utc_s, TIMES_S - 18, rtol=0, atol=1e-6)
    converted = "the stamps of /imu count GPS time, as the clock of the recorder shows: converted to UTC"
    assert converted in attitude(ahead).notes
    assert converted not in attitude(imu()).notes


@pytest.mark.parametrize("first_s", [UTC_S, 900.0])
def test_stamps_since_boot_are_no_utc(first_s: float) -> None:
    past_s = TIMES_S - TIMES_S[0]
    since_boot = topic_of("/imu", IMU, times_s=50 + past_s, rotation=flown(TIMES_S), late_s=first_s - 50)
    received = "; its recorder received the first attitude at 2024-03-10T11:00:00.000000Z" if first_s == UTC_S else ""
    clock = clock_of(since_boot)
    assert (clock.source, clock.utc_s.size) == (f"its stamps are no UTC, and it has no TimeReference{received}", 0)
    wrong = topic_of("/t", TIME, times_s=50 + past_s, late_s=first_s - 50, utc_s=np.full(151, 1e9))
    assert clock_of(since_boot, wrong).source == (
        f"its stamps are no UTC, and its TimeReference counts no UTC{received}"
    )


def test_stamps_of_another_clock_are_reported() -> None:
    other = topic_of("/fix", FIX, times_s=TIMES_S[:20] - 90, late_s=90.01, position=np.tile(PLACE, (20, 1)))
    notes = attitude(imu(), other, topic_of("/cam", CAMERA, times_s=TIMES_S - 7, late_s=7.01)).notes
    replaced = "stamps of another clock than that of /imu are replaced by times of reception: /fix (90 s), /cam (7 s)"
    assert replaced in notes
    assert not any("another clock" in note for note in attitude(imu(), fix()).notes)


# --- rates ----------------------------------------------------------------------------------------------------------
def gyros_of(*of: Topic, **options: object) -> str | None:
    found = by_kind(reader(*of, **options)).get(source.RateSamples)
    return None if found is None else found[0].source


def test_the_best_gyros_are_used() -> None:
    fast_s = TIMES_S[0] + 0.02 * np.arange(300)
    fast = topic_of("/fast", IMU, times_s=fast_s, rate_rad_per_s=rates(fast_s))
    assert gyros_of(pose(), fast, topic_of("/a", IMU, times_s=TIMES_S, rate_rad_per_s=rates(TIMES_S))) == "/fast"
    assert gyros_of(imu(), fast) == "/imu"
    device = topic_of("/camera/imu", IMU, times_s=fast_s, rate_rad_per_s=rates(fast_s))
    assert gyros_of(pose(), device, topic_of("/a", IMU, times_s=TIMES_S, rate_rad_per_s=rates(TIMES_S))) == "/a"
    assert gyros_of(imu(), fast, columns="rates=/fast") == "/fast"
    axes = Rotation.from_euler("ZYX", [0, 0, 120.0], degrees=True)
    turned = topic_of("/turned", IMU, times_s=fast_s, rate_rad_per_s=axes.apply(rates(fast_s)))
    assert gyros_of(pose(), turned) == "/turned, turned by 120.0 deg into the axes of /pose"
    assert gyros_of(pose(), turned, topic_of("/a", IMU, times_s=TIMES_S, rate_rad_per_s=rates(TIMES_S))) == "/a"
    assert gyros_of(pose()) is None
    [samples] = by_kind(reader(pose(), turned))[source.RateSamples]
    np.testing.assert_allclose(samples.rate_rad_per_s, rates(fast_s) * [1, -1, -1], rtol=0, atol=2e-3)


def test_gyros_that_turn_otherwise_are_reported() -> None:
    other = topic_of("/other", IMU, times_s=TIMES_S - 90, late_s=90.01, rate_rad_per_s=rates(TIMES_S))
    odd = topic_of("/odd", IMU, times_s=TIMES_S, rate_rad_per_s=rates(TIMES_S, 1.7))
    notes = attitude(pose(), other, odd).notes
    [note] = [note for note in notes if note.startswith("gyros")]
    head = "gyros that do not turn as the attitude does are not used"
    assert note.startswith(f"{head}: /other (its stamps are of another clock), /odd (off by ")
    assert note.endswith(" deg/s)")
    assert gyros_of(pose(), other, odd) is None


def test_damaged_rates_and_times_are_left_out() -> None:
    rate = rates(TIMES_S)
    rate[5] = 1e4
    rate[7, 1] = np.nan
    times_s = TIMES_S.copy()
    times_s[9] = np.nan
    topic = topic_of("/imu", IMU, times_s=TIMES_S, rotation=flown(TIMES_S), rate_rad_per_s=rate, stamp_s=times_s)
    [samples] = by_kind(reader(topic))[source.RateSamples]
    np.testing.assert_array_equal(samples.clock_s, np.delete(TIMES_S, [5, 7, 9]))
