"""Topics of a bag without a bag: messages as columns, and what the columns say, against SciPy and hand-made values."""

from types import SimpleNamespace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from glstar.arrays import Float
from glstar.telemetry.bags import topics
from glstar.telemetry.bags.topics import (
    CAMERA,
    FIX,
    GEO,
    IMU,
    PX4_ATTITUDE,
    PX4_GPS,
    PX4_GYROS,
    PX4_ODOMETRY,
    PX4_OLD_GPS,
    PX4_PLACE,
    PX4_RATES,
    TIME,
    Topic,
    utc_of_scale,
)

POSE, POSE_COV = "geometry_msgs/msg/PoseStamped", "geometry_msgs/msg/PoseWithCovarianceStamped"
STAMPED, ODOMETRY = "geometry_msgs/msg/QuaternionStamped", "nav_msgs/msg/Odometry"
UTC_S = 1710068400.0
nan = np.nan


def xyz(*values: float) -> SimpleNamespace:
    return SimpleNamespace(**dict(zip("xyzw", values, strict=False)))


def header(stamp_s: float, frame_id: str = "map") -> SimpleNamespace:
    stamp = SimpleNamespace(sec=int(stamp_s), nanosec=round(stamp_s % 1 * 1e9))
    return SimpleNamespace(stamp=stamp, frame_id=frame_id)


def added(kind: str, *messages: SimpleNamespace, received_s: float = 900.5) -> Topic:
    topic = Topic("/name", kind)
    for k, message in enumerate(messages):
        topic.add(message, received_s + k)
    return topic


def row(topic: Topic, k: int = 0) -> dict[str, list[float]]:
    """Return the numbers of a message, without those that it does not have."""
    columns = {name: np.atleast_1d(topic.column(name)[k]) for name in topics._COLUMNS}
    return {name: column.round(6).tolist() for name, column in columns.items() if not np.isnan(column).all()}


# --- messages as columns --------------------------------------------------------------------------------------------
TURN = xyz(0.2, 0.3, 0.4, 0.1)  # x, y, z, w


def imu(stamp_s: float = 7.25, **changed: object) -> SimpleNamespace:
    fields = {
        "header": header(stamp_s, "imu"),
        "orientation": TURN,
        "orientation_covariance": np.array([1.0, 70, 71, 72, 2.0, 73, 74, 75, 3.0]),
        "angular_velocity": xyz(0.5, 0.6, 0.7),
        "angular_velocity_covariance": np.arange(9.0),
        "linear_acceleration": xyz(1.5, 1.6, 1.7),
        "linear_acceleration_covariance": np.arange(9.0),
    }
    return SimpleNamespace(**fields | changed)


IMU_ROW = {
    "received_s": [900.5],
    "stamp_s": [7.25],
    "orientation": [0.1, 0.2, 0.3, 0.4],
    "rate_rad_per_s": [0.5, 0.6, 0.7],
    "acceleration": [1.5, 1.6, 1.7],
}


def test_an_imu_has_orientation_rates_and_acceleration() -> None:
    topic = added(IMU, imu(), imu(0.0, header=header(0.0, "other")))

    assert row(topic) == IMU_ROW
    assert row(topic, 1) == IMU_ROW | {"received_s": [901.5], "stamp_s": [901.5]}
    assert (topic.frame_id, topic.unmeasured, topic.unknown, len(topic)) == ("imu", 0, 0, 2)
    assert topic.column("stamp_s").shape == (2,)
    assert topic.column("orientation").shape == (2, 4)


@pytest.mark.parametrize("axis", [0, 4, 8])
def test_the_covariance_of_an_imu_says_what_is_not_known(axis: int) -> None:
    variances = np.array([1.0, 70, 71, 72, 2.0, 73, 74, 75, 3.0])
    low, high = variances.copy(), variances.copy()
    low[axis], high[axis] = 9.6, 10.4
    of = [imu(orientation_covariance=low), imu(orientation_covariance=high), imu(orientation_covariance=high)]
    assert added(IMU, *of).unknown == 2

    minus = np.array([-1.0, *np.arange(8.0)])
    topic = added(IMU, imu(orientation_covariance=minus), imu(orientation_covariance=minus), imu())
    assert (topic.unmeasured, topic.unknown) == (2, 0)
    assert row(topic) == {name: of for name, of in IMU_ROW.items() if name != "orientation"}
    no_rate, no_acceleration = imu(angular_velocity_covariance=minus), imu(linear_acceleration_covariance=minus)
    assert row(added(IMU, no_rate)) == {name: of for name, of in IMU_ROW.items() if name != "rate_rad_per_s"}
    assert row(added(IMU, no_acceleration)) == {name: of for name, of in IMU_ROW.items() if name != "acceleration"}


HEAD = {"received_s": [900.5], "stamp_s": [7.25]}
ORIENTED = HEAD | {"orientation": [0.1, 0.2, 0.3, 0.4]}


def test_poses_have_an_orientation() -> None:
    pose = SimpleNamespace(orientation=TURN, position=SimpleNamespace(latitude=-3.5, longitude=4.5, altitude=5.5))
    simple = SimpleNamespace(header=header(7.25, ""), pose=pose)
    nested = SimpleNamespace(header=header(7.25), pose=SimpleNamespace(pose=pose), child_frame_id="base")

    assert row(added(POSE, simple)) == ORIENTED
    assert row(added(GEO, simple)) == ORIENTED | {"position": [-3.5, 4.5, 5.5]}
    assert row(added(POSE_COV, nested)) == ORIENTED
    assert row(added(STAMPED, SimpleNamespace(header=header(7.25), quaternion=TURN))) == ORIENTED
    topic = added(ODOMETRY, nested, SimpleNamespace(**vars(nested) | {"child_frame_id": "later"}))
    assert row(topic) == ORIENTED
    assert (topic.frame_id, topic.child_frame_id, topic.short_kind) == ("map", "base", "Odometry")
    assert added(POSE, simple, SimpleNamespace(header=header(8.0, "odom"), pose=pose)).frame_id == "odom"


@pytest.mark.parametrize(("status", "is_fixed"), [(-1, False), (0, True), (2, True)])
def test_a_fix_has_a_position_with_a_status_from_zero_on(status: int, is_fixed: bool) -> None:
    place = {"latitude": -34.5, "longitude": 138.5, "altitude": 50.5}
    message = SimpleNamespace(header=header(7.25), status=SimpleNamespace(status=status), **place)

    assert row(added(FIX, message)) == HEAD | ({"position": [-34.5, 138.5, 50.5]} if is_fixed else {})


def test_a_time_reference_and_a_camera() -> None:
    first, later = SimpleNamespace(sec=1700000000, nanosec=250000000), SimpleNamespace(sec=5, nanosec=0)
    messages = [
        SimpleNamespace(header=header(7.25), time_ref=first, source="gps"),
        SimpleNamespace(header=header(8.25), time_ref=later, source="ntp"),
    ]
    topic = added(TIME, *messages)
    assert row(topic) == HEAD | {"utc_s": [1700000000.25]}
    assert row(topic, 1) == {"received_s": [901.5], "stamp_s": [8.25], "utc_s": [5.0]}
    assert topic.origin == "gps"
    assert row(added(CAMERA, SimpleNamespace(header=header(7.25)))) == HEAD


def test_attitudes_of_px4_have_resets_and_a_world() -> None:
    one = SimpleNamespace(timestamp_sample=7_250_000, timestamp=9, q=[0.1, 0.2, 0.3, 0.4], quat_reset_counter=3)
    topic = added(PX4_ATTITUDE, one)
    assert row(topic) == ORIENTED | {"resets": [3.0]}
    assert topic.frame_id == "NED"
    for frame, world in ((1, "NED"), (2, "FRD"), (0, "unknown"), (3, "unknown")):
        odometry = {"timestamp_sample": 0, "timestamp": 7_250_000, "q": [0.1, 0.2, 0.3, 0.4], "reset_counter": 5}
        topic = added(PX4_ODOMETRY, SimpleNamespace(**odometry, pose_frame=frame))
        assert row(topic) == ORIENTED | {"resets": [5.0]}
        assert topic.frame_id == world


def test_rates_and_places_of_px4() -> None:
    gyros = SimpleNamespace(timestamp=7_250_000, gyro_rad=[0.5, 0.6, 0.7])
    rates = SimpleNamespace(timestamp_sample=7_250_000, timestamp=9, xyz=[0.5, 0.6, 0.7])
    assert row(added(PX4_GYROS, gyros)) == row(added(PX4_RATES, rates)) == HEAD | {"rate_rad_per_s": [0.5, 0.6, 0.7]}
    place = {"timestamp": 7_250_000, "lat": -34.5, "lon": 138.5, "alt": 50.5}
    placed = HEAD | {"position": [-34.5, 138.5, 50.5]}
    for valid, expected in (
        ({}, placed),
        ({"lat_lon_valid": True, "alt_valid": True}, placed),
        ({"lat_lon_valid": False, "alt_valid": True}, HEAD),
        ({"lat_lon_valid": True, "alt_valid": False}, HEAD),
    ):
        assert row(added(PX4_PLACE, SimpleNamespace(**place, **valid))) == expected


@pytest.mark.parametrize(
    ("age_us", "late_s"), [(-250_000, -0.25), (1_920_000, 1.92), (2_080_000, 0.0), (-2_080_000, 0.0)]
)
@pytest.mark.parametrize("fix_type", [2, 3])
def test_receivers_of_px4_have_utc_and_a_position_with_a_fix(age_us: int, late_s: float, fix_type: int) -> None:
    common = {"timestamp": 7_250_000, "timestamp_time_relative": age_us, "fix_type": fix_type}
    common["time_utc_usec"] = 1_700_000_000_250_000
    new = SimpleNamespace(**common, latitude_deg=-34.5, longitude_deg=138.5, altitude_msl_m=50.5)
    old = SimpleNamespace(**common, lat=-345000000, lon=1385000000, alt=50500)

    head = HEAD | {"stamp_s": [round(7.25 + late_s, 9)]}
    fixed = head | {"position": [-34.5, 138.5, 50.5], "utc_s": [1700000000.25]}
    assert row(added(PX4_GPS, new)) == row(added(PX4_OLD_GPS, old)) == (fixed if fix_type == 3 else head)


def test_messages_are_sorted_by_reception() -> None:
    topic = Topic("/name", CAMERA)
    for stamp_s, received_s in ((3.0, 13.5), (1.0, 11.5), (2.0, 11.5), (4.0, 10.5)):
        topic.add(SimpleNamespace(header=header(stamp_s)), received_s)
    topic.sort()
    assert topic.column("stamp_s").tolist() == [4.0, 1.0, 2.0, 3.0]
    assert topic.column("received_s").tolist() == [10.5, 11.5, 11.5, 13.5]


# --- what columns say -----------------------------------------------------------------------------------------------
def topic_of(
    name: str = "/pose",
    kind: str = POSE,
    *,
    times_s: Float,
    rotation: Rotation | None = None,
    late_s: float = 0.01,
    frame_id: str = "map",
    **columns: Float,
) -> Topic:
    """Return a topic with these columns; `rotation`: its orientations."""
    topic = Topic(name, kind, frame_id)
    table = np.full((times_s.size, topics._WIDTH), nan)
    if rotation is not None:
        columns["orientation"] = rotation.as_quat()[:, [3, 0, 1, 2]]
    for column, values in ({"stamp_s": times_s, "received_s": times_s + late_s} | columns).items():
        table[:, topics._COLUMNS[column]] = np.reshape(values, (times_s.size, -1))
    topic._cells.frombytes(table.tobytes())
    return topic


TIMES_S = 3.0 + 0.1 * np.arange(41)
AXIS = np.array([2.0, -3.0, 6.0]) / 7


def turning(deg_per_s: float, first: tuple[float, float, float] = (10.0, -20.0, 30.0)) -> Rotation:
    """Return orientations that turn about a fixed axis."""
    turn = Rotation.from_rotvec(np.deg2rad(deg_per_s) * (TIMES_S - TIMES_S[0])[:, np.newaxis] * AXIS)
    return turn * Rotation.from_euler("ZYX", first, degrees=True)


def test_angles_of_orientations_are_those_of_scipy() -> None:
    rng = np.random.default_rng(2)
    one, other = Rotation.random(9, random_state=rng), Rotation.random(9, random_state=rng)
    quaternions = [rotation.as_quat()[:, [3, 0, 1, 2]] for rotation in (one, other)]
    expected = (one.inv() * other).magnitude()
    np.testing.assert_allclose(topics._angles_rad(*quaternions), expected, rtol=0, atol=1e-12)
    np.testing.assert_allclose(topics._angles_rad(quaternions[0], -quaternions[1]), expected, rtol=0, atol=1e-12)
    pairs = [(one[i].inv() * one[j]).magnitude() for i in range(9) for j in range(i + 1, 9)]
    np.testing.assert_allclose(topics._angles_between(quaternions[0]), pairs, rtol=0, atol=1e-12)


def test_orientations_are_interpolated_on_the_arc() -> None:
    at_s = np.array([3.0, 3.04, 5.55, 6.99, 7.0])
    doubled = np.concatenate([[0], np.arange(41)])  # the first time twice
    q = turning(20.0).as_quat()[:, [3, 0, 1, 2]][doubled] * 1.004
    between = topics._interpolated(TIMES_S[doubled], q, at_s)
    expected = Rotation.from_rotvec(np.deg2rad(20.0) * (at_s - 3.0)[:, np.newaxis] * AXIS) * turning(20.0)[0]
    angles = (Rotation.from_quat(between[:, [1, 2, 3, 0]]).inv() * expected).magnitude()
    np.testing.assert_allclose(angles, 0.0, rtol=0, atol=1e-9)


@pytest.mark.parametrize(("cosine", "is_down"), [(-0.83, True), (-0.77, False), (0.83, False)])
def test_the_world_of_an_imu_is_down_by_its_accelerometers(cosine: float, is_down: bool) -> None:
    rotation = Rotation.from_euler("ZYX", [[10.0, 20.0, 30.0], [-40.0, 50.0, -60.0], [70.0, 10.0, 5.0]], degrees=True)
    force = np.array([[np.sqrt(1 - cosine**2), 0.0, cosine]])
    acceleration = 9.8 * rotation.inv().apply(force)
    times_s = np.arange(3.0)
    assert topic_of(times_s=times_s, rotation=rotation, acceleration=acceleration).is_up_down is is_down

    damaged = np.concatenate([acceleration, [[nan, 1.0, 2.0]], [[1.0, -1.02e4, 2.0]], 50 * -acceleration[:1]])
    rotations = Rotation.concatenate([rotation, rotation[:1], rotation[:1], rotation[:1]])
    topic = topic_of(times_s=np.arange(6.0), rotation=rotations, acceleration=damaged)
    table = np.frombuffer(topic._cells, dtype=np.float64).reshape(-1, topics._WIDTH)
    table[5, 2:6] *= 1.1  # no unit quaternion
    assert topic.is_up_down is is_down


def test_the_axes_of_an_imu_without_acceleration_are_not_known() -> None:
    rotation = turning(5.0)
    for acceleration in (np.zeros((41, 3)), np.full((41, 3), nan), np.full((41, 3), -1.1e4)):
        assert not topic_of(kind=IMU, times_s=TIMES_S, rotation=rotation, acceleration=acceleration).is_up_down
    large = np.tile([0.0, 0.0, -9.9e3], (41, 1))
    assert topic_of(times_s=TIMES_S, rotation=Rotation.identity(41), acceleration=large).is_up_down


@pytest.mark.parametrize(
    ("kind", "frame_id", "child", "asked", "expected"),
    [
        (POSE, "map", "", ("auto", "auto"), ("ENU", "FLU")),
        (POSE, "map_ned", "", ("auto", "auto"), ("NED", "FRD")),
        (POSE, "localNWU", "", ("auto", "auto"), ("NWU", "FLU")),
        (POSE, "enu", "base_frd", ("auto", "auto"), ("ENU", "FRD")),
        (POSE, "ned", "base_flu", ("auto", "auto"), ("NED", "FLU")),
        (POSE, "map", "", ("NED", "auto"), ("NED", "FRD")),
        (POSE, "ned", "", ("ENU", "FRD"), ("ENU", "FRD")),
        (POSE, "ned", "", ("NWU", "auto"), ("NWU", "FLU")),
        (IMU, "imu_ned", "", ("auto", "auto"), ("ENU", "FLU")),
        (PX4_ATTITUDE, "map", "", ("auto", "auto"), ("NED", "FRD")),
        (PX4_ODOMETRY, "enu", "", ("auto", "FLU"), ("NED", "FLU")),
        (PX4_ODOMETRY, "enu", "", ("ENU", "auto"), ("ENU", "FLU")),
    ],
)
def test_the_axes_of_a_topic(
    kind: str, frame_id: str, child: str, asked: tuple[str, str], expected: tuple[str, str]
) -> None:
    topic = topic_of(kind=kind, times_s=TIMES_S, rotation=turning(5.0), frame_id=frame_id)
    topic.child_frame_id = child
    assert topic.axes(*asked) == expected


def test_the_axes_of_an_upside_down_imu_are_ned() -> None:
    topic = topic_of(
        kind=IMU, times_s=TIMES_S, rotation=Rotation.identity(41), acceleration=np.tile([0, 0, -9.8], (41, 1))
    )
    assert topic.axes("auto", "auto") == ("NED", "FRD")


@pytest.mark.parametrize(
    ("name", "kind", "authority", "is_of_device"),
    [
        ("/mavros/imu/data", IMU, 2, False),
        ("/mavros/local_position/pose", POSE, 2, False),
        ("/x", PX4_ATTITUDE, 2, False),
        ("/imu/data", IMU, 1, False),
        ("/odom", POSE, 0, False),
        ("/camera/imu", IMU, 1, True),
        ("/livox/pose", POSE, 0, True),
    ],
)
def test_how_surely_a_topic_is_the_aircraft(name: str, kind: str, authority: int, is_of_device: bool) -> None:
    topic = Topic(name, kind)
    assert (topic.authority, topic.is_interface, topic.is_of_device) == (authority, authority == 2, is_of_device)
    assert Topic("/odom", POSE, frame_id="t265_odom").is_of_device


# --- an orientation that stands still -------------------------------------------------------------------------------
def frozen(stop: int, start: int = 0) -> Rotation:
    """Return orientations that turn at 10 deg/s, but stand still from one sample to another."""
    k = np.arange(41)
    return turning(10.0)[np.where((k >= start) & (k < stop), start, k)]


ALONE = "its orientation is constant while its gyros turn"
BESIDE = "its orientation is constant while that of /other turns"


@pytest.mark.parametrize(("held", "is_frozen"), [(10, False), (12, True)])
@pytest.mark.parametrize("start", [0, 15])
def test_an_orientation_that_stands_still_for_a_second_is_frozen(held: int, start: int, is_frozen: bool) -> None:
    """Samples are at 0.1 s: the tenth is 0.9 s after the first."""
    topic = topic_of(times_s=TIMES_S, rotation=frozen(start + held, start))
    other = topic_of("/other", times_s=TIMES_S, rotation=turning(4.0))

    assert topic.frozen_beside([other]) == (BESIDE if is_frozen else "")
    assert topic.frozen_beside([]) == ""
    slow = topic_of("/other", times_s=TIMES_S, rotation=turning(0.3))
    assert topic.frozen_beside([slow]) == ""
    assert topic.frozen_beside([slow, other]) == (BESIDE if is_frozen else "")


@pytest.mark.parametrize(("held", "is_frozen"), [(10, False), (14, True)])
def test_an_orientation_that_stands_still_for_a_tenth_of_the_log_is_frozen(held: int, is_frozen: bool) -> None:
    """Samples are at 1 s: the log lasts 120 s."""
    times_s = 5.0 + np.arange(121)
    turn = Rotation.from_rotvec(np.deg2rad(3.0) * np.arange(121)[:, np.newaxis] * AXIS)
    kept = np.where(np.arange(121) < 20 + held, np.minimum(np.arange(121), 20), np.arange(121))
    topic = topic_of(times_s=times_s, rotation=turn[kept])
    assert topic.frozen_beside([topic_of("/other", times_s=times_s, rotation=turn)]) == (BESIDE if is_frozen else "")


@pytest.mark.parametrize(("deg_per_s", "is_frozen"), [(0.96, False), (1.04, True)])
def test_gyros_that_turn_while_the_orientation_stands_still(deg_per_s: float, is_frozen: bool) -> None:
    """By more than a degree a second in the mean of thirty rates, of which one is damaged; later it moves."""
    rate = np.zeros((41, 3))
    rate[:30:2, 1] = np.deg2rad(deg_per_s) * 29 / 15
    rate[3] = 1e6
    rate[30:] = 2.0
    topic = topic_of(kind=IMU, times_s=TIMES_S, rotation=frozen(30), rate_rad_per_s=rate)
    assert topic.frozen_beside([]) == (ALONE if is_frozen else "")


def test_an_orientation_that_never_moves_is_frozen_beside_any_rate() -> None:
    tiny = np.zeros((41, 3))
    tiny[7, 2] = 1e-9
    still = Rotation.from_euler("ZYX", [[10.0, 20.0, 30.0]] * 41, degrees=True)
    assert topic_of(kind=IMU, times_s=TIMES_S, rotation=still, rate_rad_per_s=tiny).frozen_beside([]) == ALONE
    none = topic_of(kind=IMU, times_s=TIMES_S, rotation=still, rate_rad_per_s=np.zeros((41, 3)))
    assert none.frozen_beside([]) == ""
    assert none.frozen_beside([topic_of("/other", times_s=TIMES_S, rotation=turning(4.0))]) == BESIDE
    moved = topic_of(kind=IMU, times_s=TIMES_S, rotation=frozen(38), rate_rad_per_s=tiny)
    assert moved.frozen_beside([]) == ""


@pytest.mark.parametrize(("deg_per_s", "turns"), [(0.13, True), (0.12, False)])
def test_another_attitude_turns_by_half_a_degree(deg_per_s: float, turns: bool) -> None:
    still = topic_of(times_s=TIMES_S, rotation=Rotation.identity(41))
    other = topic_of("/other", times_s=TIMES_S, rotation=turning(deg_per_s))
    assert still.frozen_beside([other]) == (BESIDE if turns else "")


def test_another_attitude_counts_only_while_it_stands_still() -> None:
    topic = topic_of(times_s=TIMES_S, rotation=frozen(12))
    other = turning(0.0)
    later = Rotation.concatenate([other[:13], turning(10.0)[13:]])
    assert topic.frozen_beside([topic_of("/other", times_s=TIMES_S, rotation=later)]) == ""
    last = topic_of(times_s=TIMES_S, rotation=frozen(41, 20))
    sooner = Rotation.concatenate([turning(10.0)[:20], other[20:]])
    assert last.frozen_beside([topic_of("/other", times_s=TIMES_S, rotation=sooner)]) == ""


# --- attitudes of one body ------------------------------------------------------------------------------------------
def test_attitudes_of_one_body_turn_alike_whatever_their_axes() -> None:
    one = topic_of(times_s=TIMES_S, rotation=turning(20.0))
    axes = Rotation.from_euler("ZYX", [50.0, 60.0, 70.0], degrees=True)
    other = topic_of("/other", times_s=TIMES_S, rotation=axes * turning(20.0) * axes)
    assert one.turns_otherwise(other) == other.turns_otherwise(one) == 0.0
    assert one.turns_otherwise(one) == 0.0


@pytest.mark.parametrize(("more", "is_alike"), [(0.97, True), (1.03, False)])
def test_attitudes_of_two_bodies_turn_otherwise(more: float, is_alike: bool) -> None:
    """By 2 deg and 5 % of the median angle; two times of sixty over 4 s are 1.15 s from each other in the median."""
    at_s = np.linspace(0.0, 4.0, 60)
    between_s = np.array([at_s[j] - at_s[i] for i in range(60) for j in range(i + 1, 60)])
    middle_s = float(np.median(between_s))
    # difference d: d t = 2 + 0.05 (20 + d / 2) t, nearly
    d = (2 / middle_s + 1.0) / (1 - 0.025) * more
    one = topic_of(times_s=TIMES_S, rotation=turning(20.0))
    other = topic_of("/other", times_s=TIMES_S, rotation=turning(20.0 + d))
    assert one.turns_otherwise(other) == pytest.approx(0.0 if is_alike else d * middle_s, rel=1e-6)


def test_attitudes_at_different_times_are_not_compared() -> None:
    one = topic_of(times_s=TIMES_S, rotation=turning(20.0))
    later = topic_of("/other", times_s=TIMES_S + 4.0, rotation=turning(90.0), late_s=0.01)
    assert one.turns_otherwise(later) == 0.0
    assert one.turns_otherwise(topic_of("/other", times_s=TIMES_S + 3.0, rotation=turning(90.0))) > 10
    # The stamps of another clock are replaced by the times of reception.
    shifted = topic_of("/other", times_s=TIMES_S + 500, rotation=turning(20.0), late_s=-499.99)
    assert shifted.turns_otherwise(one) == 0.0
    assert topic_of("/x", times_s=TIMES_S + 500, rotation=turning(60.0), late_s=-499.99).turns_otherwise(one) > 10


# --- clocks ---------------------------------------------------------------------------------------------------------
@pytest.mark.parametrize(("by_s", "is_other"), [(4.8, False), (5.2, True), (-4.8, False), (-5.2, True)])
def test_stamps_of_another_clock_are_replaced_by_reception(by_s: float, is_other: bool) -> None:
    one = topic_of(times_s=TIMES_S, late_s=0.25)
    other = topic_of(times_s=TIMES_S - by_s, late_s=0.25 + by_s)
    assert one.late_s == pytest.approx(0.25)
    assert other.is_other_clock(one) is is_other
    np.testing.assert_allclose(other.clock_s(one), TIMES_S if is_other else TIMES_S - by_s, rtol=0, atol=1e-9)


def test_positions_are_by_the_clock_of_the_attitude() -> None:
    attitude = topic_of(times_s=TIMES_S, late_s=0.25)
    place = np.column_stack([-34.5 + 1e-5 * np.arange(41), np.full(41, 138.5), np.full(41, 50.5)])
    place[3] = nan
    samples = topic_of("/fix", FIX, times_s=TIMES_S - 90, late_s=90.25, position=place).positions(attitude)
    np.testing.assert_allclose(samples.clock_s, np.delete(TIMES_S, 3), rtol=0, atol=1e-9)
    np.testing.assert_allclose(samples.latitude_rad, np.deg2rad(np.delete(place[:, 0], 3)), rtol=1e-12)
    assert (np.rad2deg(samples.longitude_rad[0]), samples.height_m[0]) == (pytest.approx(138.5), 50.5)
    assert samples.source == "/fix"


@pytest.mark.parametrize(("off_s", "is_used"), [(0.48, True), (0.52, False), (-0.48, True), (-0.52, False)])
def test_readings_of_utc_that_scatter_are_left_out(off_s: float, is_used: bool) -> None:
    attitude = topic_of(times_s=TIMES_S, late_s=0.25)
    utc_s = UTC_S + TIMES_S
    utc_s[5] += off_s
    utc_s[7] = 1.2e9  # before 2010
    clock_s, read_s = topic_of("/time", TIME, times_s=TIMES_S, late_s=0.3, utc_s=utc_s).utc_readings(attitude)
    used = np.delete(np.arange(41), 7 if is_used else [5, 7])
    np.testing.assert_allclose(clock_s, TIMES_S[used], rtol=0, atol=1e-9)
    np.testing.assert_allclose(read_s, utc_s[used], rtol=0, atol=1e-6)


def readings(times_s: list[float], utc_s: list[float]) -> tuple[list[float], list[float]]:
    topic = topic_of("/time", TIME, times_s=np.array(times_s), utc_s=np.array(utc_s))
    clock_s, read_s = topic.utc_readings(topic_of(times_s=TIMES_S))
    return clock_s.tolist(), (read_s - UTC_S).tolist()


def test_readings_that_do_not_agree_or_stand_still_are_none() -> None:
    assert readings([3.0, 4.0], [UTC_S, UTC_S]) == ([], [])
    assert readings([3.0, 3.2], [UTC_S, UTC_S]) == ([], [])  # it stands still
    assert readings([3.0, 3.0], [UTC_S, UTC_S]) == ([3.0, 3.0], [0.0, 0.0])
    assert readings([3.0], [UTC_S]) == ([3.0], [0.0])
    assert readings([3.0, 4.0], [UTC_S, UTC_S + 1]) == ([3.0, 4.0], [0.0, 1.0])
    assert readings([3.0, 4.0, 5.0, 6.0], [UTC_S, UTC_S + 1, UTC_S + 70, UTC_S + 140]) == ([], [])
    assert readings([3.0], [1e9]) == ([], [])


@pytest.mark.parametrize(
    ("off_s", "scale"),
    [
        (18.48, (-18.0, "GPS time")),
        (17.52, (-18.0, "GPS time")),
        (18.52, (0.0, "")),
        (17.48, (0.0, "")),
        (37.48, (-37.0, "TAI")),
        (36.48, (0.0, "")),
        (18 - 315964800 + 58, (315964782.0, "GPS time since 1980")),
        (18 - 315964800 - 58, (315964782.0, "GPS time since 1980")),
        (18 - 315964800 + 62, (0.0, "")),
        (0.2, (0.0, "")),
    ],
)
def test_a_time_ahead_of_the_recorder_by_leap_seconds_counts_another_scale(
    off_s: float, scale: tuple[float, str]
) -> None:
    assert utc_of_scale(off_s, UTC_S) == scale
    topic = topic_of(times_s=UTC_S + off_s + TIMES_S, late_s=-off_s)
    assert topic.scale_of_stamps == (pytest.approx(scale[0]), scale[1])


def test_a_recorder_without_a_date_says_nothing_about_scales() -> None:
    year_2010_s, year_2100_s = 1262304000.0, 4102444800.0
    assert utc_of_scale(15.0, year_2010_s) == (-15.0, "GPS time")
    assert utc_of_scale(15.0, year_2010_s - 1) == (0.0, "")
    assert utc_of_scale(18.0, year_2100_s - 1) == (-18.0, "GPS time")
    assert utc_of_scale(18.0, year_2100_s) == (0.0, "")
    # The leap second of 2017 counts from the instant at which it ended.
    assert utc_of_scale(18.0, 1483228800.0 + 1) == (-18.0, "GPS time")
    assert utc_of_scale(17.0, 1483228800.0 - 2) == (-17.0, "GPS time")


# --- what a topic is for --------------------------------------------------------------------------------------------
SENT = "sent to the autopilot by another program"
PLANNED = "by its name where something should be or another thing is, not a measurement"


@pytest.mark.parametrize(
    ("name", "purpose"),
    [
        ("/mavros/vision_pose/pose", SENT),
        ("/uav1/mavros/mocap/pose", SENT),
        ("/mavros/odometry/out", SENT),
        ("/mavros/odometry/in", ""),
        ("/mavros/hil", SENT),
        ("/vision_pose/pose", ""),
        ("/fmu/in/vehicle_attitude", SENT),
        ("/fmu/out/vehicle_attitude", ""),
        ("/x/in/vehicle_attitude", ""),
        ("/mavros/in/pose", ""),
        ("/gimbal/pose", "by its name of a gimbal"),
        ("/a/mount_status", "by its name of a gimbal"),
        ("/mavros/setpoint_raw/attitude", PLANNED),
        ("/a/goal", PLANNED),
        ("/a/goalkeeper", PLANNED),
        ("/a/homeland", ""),
    ],
)
def test_what_a_topic_is_for_by_its_name(name: str, purpose: str) -> None:
    assert topics.purpose_of(name) == purpose


@pytest.mark.parametrize(
    ("first", "second", "are_two"),
    [
        ("/uav1/imu", "/uav2/fix", True),
        ("/uav1/imu", "/uav1/fix", False),
        ("/imu", "/uav2/fix", False),
        ("/uav1/imu/data", "/gps/fix", False),
        ("/mavros/imu/data", "/uav2/fix", False),
        ("/mavros/uav1/data", "/gps/uav2/fix", True),
        ("/uav1/x/data", "/uav1/y/fix", False),
    ],
)
def test_topics_below_two_names_are_of_two_bodies(first: str, second: str, are_two: bool) -> None:
    assert topics.are_of_two_bodies(first, second) is are_two


def vehicles(**kinds: str) -> list[str]:
    """Return the vehicle of each topic; names are written with ``__`` for ``/``."""
    return list(topics.vehicles_of({"/" + name.replace("__", "/"): kind for name, kind in kinds.items()}).values())


def test_vehicles_by_their_names() -> None:
    assert vehicles(uav1__imu=IMU, uav2__imu=IMU) == ["uav1", "uav2"]
    assert vehicles(drone_a__imu=IMU, leader__imu=IMU, fix=FIX) == ["drone_a", "leader", ""]
    assert vehicles(uav1__imu=IMU, uav1__fix=FIX) == ["", ""]  # a single one
    assert vehicles(fleet__uav1__imu=IMU, fleet__uav2__imu=IMU) == ["uav1", "uav2"]
    assert vehicles(team1__uav1__imu=IMU, team2__uav1__imu=IMU) == ["team1/uav1", "team2/uav1"]


def test_vehicles_above_the_interface_of_an_autopilot() -> None:
    assert vehicles(alpha1__mavros__imu=IMU, zeta__mavros__imu=IMU) == ["alpha1", "zeta"]
    assert vehicles(mavros__imu=IMU, zeta__mavros__imu=IMU, fix=FIX) == ["unnamed", "zeta", "unnamed"]
    assert vehicles(fmu__out__x=PX4_ATTITUDE, px4_1__fmu__out__x=PX4_ATTITUDE) == ["unnamed", "px4_1"]
    assert vehicles(mavros__imu1__data=IMU, mavros__imu2__data=IMU) == ["", ""]


def test_vehicles_by_their_numbers() -> None:
    assert vehicles(r1__imu=IMU, r2__imu=IMU, r2__fix=FIX) == ["r1", "r2", "r2"]
    assert vehicles(r1__imu=IMU, s2__imu=IMU) == ["", ""]
    assert vehicles(imu1__data=IMU, imu2__data=IMU) == ["", ""]
    assert vehicles(x__1__imu=IMU, x__2__imu=IMU) == ["1", "2"]
    assert vehicles(imu__1__x=IMU, imu__2__x=IMU) == ["", ""]  # two sensors


def test_vehicles_with_equal_topics() -> None:
    assert vehicles(red__odom=ODOMETRY, red__fix=FIX, blue__odom=ODOMETRY, blue__fix=FIX) == ["red"] * 2 + ["blue"] * 2
    assert vehicles(red__odom=ODOMETRY, blue__odom=ODOMETRY, blue__fix=FIX) == [""] * 3  # one is equal
    assert vehicles(red__odom=ODOMETRY, red__fix=FIX, blue__odom=POSE, blue__fix=FIX) == [""] * 4
    assert vehicles(red__odom=ODOMETRY, red__goal=POSE, blue__odom=ODOMETRY, blue__goal=POSE) == [""] * 4
    three = vehicles(red__a=IMU, red__b=FIX, blue__a=IMU, blue__b=FIX, green__a=IMU, green__b=FIX)
    assert three == ["red", "red", "blue", "blue", "green", "green"]


def test_another_name_beside_a_vehicle_is_one_too() -> None:
    assert vehicles(uav1__imu=IMU, husky__fix=FIX) == ["uav1", "husky"]
    assert vehicles(uav1__imu=IMU, husky__goal=POSE) == ["", ""]
    assert vehicles(uav1__imu=IMU, husky__t=TIME) == ["", ""]
    assert vehicles(uav1__imu=IMU, gps__fix=FIX) == ["", ""]
    assert vehicles(uav1__imu=IMU, fix=FIX) == ["", ""]
    assert vehicles(husky__imu=IMU, spot__fix=FIX) == ["", ""]
