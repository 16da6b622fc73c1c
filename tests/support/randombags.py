"""Random bags that are valid, with a true flight and decoys beside it, and what glstar makes of them."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation

from glstar.errors import LogFormatError
from glstar.flight import Flight
from glstar.rotation import matrix_from_quaternion
from glstar.telemetry import open_flight
from tests.support.bags import (
    GEO,
    IMU,
    NO_ORIENTATION,
    ODOMETRY,
    POSE,
    POSE_COV,
    QUATERNION,
    Bag,
)

Random = np.random.Generator
UTC_NS = 1710068400_000000000
DURATION_S = 2.5
ENU_NED = Rotation.from_matrix([[0.0, 1, 0], [1, 0, 0], [0, 0, -1]])
FRD_FLU = Rotation.from_matrix(np.diag([1.0, -1, -1]))

# Topics of attitudes that are measured, by kind, below the name space of a vehicle.
MEASURED = (
    (IMU, "mavros/imu/data"),
    (IMU, "imu/data"),
    (IMU, "sensors/imu_0/data"),
    (IMU, "dji_osdk_ros/imu"),
    (IMU, "vectornav/imu"),
    (QUATERNION, "dji_sdk/attitude"),
    (GEO, "ap/geopose/filtered"),
    (POSE, "mavros/local_position/pose"),
    (POSE_COV, "localization/pose_with_covariance"),
    (ODOMETRY, "mavros/local_position/odom"),
    (ODOMETRY, "odometry/filtered"),
)
FIXES = ("mavros/global_position/raw/fix", "mavros/global_position/global", "fix", "gps/fix", "sensors/gps_0/fix")
# Topics with orientations that are none of a vehicle's: by the list of mavros, and by names of others.
PLANNED = (
    (POSE, "mavros/setpoint_position/local"),
    (POSE, "mavros/setpoint_attitude/attitude"),
    (GEO, "mavros/setpoint_position/global"),
    (POSE, "mavros/setpoint_trajectory/desired"),
    (POSE, "mavros/target_attitude"),
    (POSE, "mavros/landing_target/pose"),
    (POSE, "mavros/vision_pose/pose"),
    (POSE_COV, "mavros/vision_pose/pose_cov"),
    (POSE, "mavros/mocap/pose"),
    (ODOMETRY, "mavros/odometry/out"),
    (IMU, "mavros/hil/imu_ned"),
    (POSE, "move_base_simple/goal"),
    (POSE_COV, "initialpose"),
    (POSE, "goal_pose"),
    (POSE, "controller/reference_pose"),
    (POSE, "cmd_pose"),
    (GEO, "planner/geopose"),
    (ODOMETRY, "planning/desiredState"),
    (QUATERNION, "commanded_attitude"),
    (QUATERNION, "gimbal/attitude"),
    (POSE, "des_pose"),
    (ODOMETRY, "tracker/tgtState"),
    (POSE, "detections/person/pose"),
    (POSE, "formation/wp_next"),
    (POSE, "mavros/mount_control/pose"),
)
SENSORS = (
    ("livox/imu", "livox_frame"),
    ("camera/imu", "camera_imu_optical_frame"),
    ("ouster/imu", "os_imu"),
    ("zed2/imu/data", "zed2_imu_link"),
    ("d435i/imu", "d435i_imu_optical_frame"),
)
FRAMES = ("base_link", "imu_link", "imu_aligned", "planned", "imu_ned", "tuned_imu", "")
VEHICLES = (
    ("uav1", "uav2"),
    ("drone_1", "drone_2"),
    ("alpha", "bravo"),
    ("swarm/r1", "swarm/r2"),
    ("robots/7", "robots/8"),
    ("leader", "follower"),
    ("quad_a", "quad_b"),
)


@dataclass
class Motion:
    """A body with constant turn rates, and its place."""

    angles_deg: np.ndarray  # yaw, pitch, roll
    rates_deg_per_s: np.ndarray
    place: tuple[float, float, float]  # latitude, longitude, deg; height, m

    @classmethod
    def of(cls, random: Random) -> "Motion":
        angles = random.uniform((0, -40, -40), (360, 40, 40))
        rates = random.uniform(4, 15, 3) * random.choice([-1, 1], 3)
        return cls(angles, rates, (random.uniform(-60, 60), random.uniform(-170, 170), random.uniform(0, 3000)))

    def body_to_ned(self, t_s: ArrayLike) -> Rotation:
        angles_deg = self.angles_deg + np.multiply.outer(np.asarray(t_s), self.rates_deg_per_s)
        return Rotation.from_euler("ZYX", angles_deg, degrees=True)

    def body_to_enu(self, t_s: ArrayLike) -> Rotation:
        return ENU_NED * self.body_to_ned(t_s) * FRD_FLU

    def rate_flu(self, t_s: np.ndarray) -> np.ndarray:
        before, after = self.body_to_enu(t_s - 1e-3), self.body_to_enu(t_s + 1e-3)
        return np.asarray((before.inv() * after).as_rotvec() / 2e-3)


class _SortedBag(Bag):
    """A bag whose messages are written in the order of reception, when it is closed."""

    def __init__(self, path: Path, kind: str) -> None:
        super().__init__(path, kind)
        self.waiting: list[tuple[int, str, str, dict[str, Any]]] = []

    def write(self, topic: str, kind: str, received_ns: int, **fields: Any) -> None:
        self.waiting.append((received_ns, topic, kind, fields))

    @property
    def topics(self) -> set[str]:
        return {topic for _, topic, _, _ in self.waiting}

    def __exit__(self, *error: object) -> None:
        for received_ns, topic, kind, fields in sorted(self.waiting, key=lambda message: message[0]):
            super().write(topic, kind, received_ns, **fields)
        super().__exit__(*error)


@dataclass
class RandomBag:
    """A bag in a file, and the flights that may be read from it."""

    path: Path
    flights: list[Motion]
    said: list[str]  # What it holds, for messages
    lost_s: float = 0.0  # Its last seconds may be lost


def random_bag(random: Random, folder: Path) -> RandomBag:
    """Write a bag with a true flight and decoys."""
    kind = str(random.choice(["bag", "mcap", "db3"]))
    flight, said = Motion.of(random), [kind]
    flights = [flight]
    name = folder / ("flight.bag" if kind == "bag" else "flight")
    late_ns = int(random.choice([0, 0, 0, 100_000_000_000, -1_710_000_000_000_000_000]))
    with _SortedBag(name, kind) as bag:
        space, other = "", None
        if random.random() < 0.3:
            first, second = VEHICLES[random.integers(len(VEHICLES))]
            space, other = (f"{first}/", f"{second}/") if random.random() < 0.5 else (f"{second}/", f"{first}/")
            flights.append(_add_vehicle(bag, random, other, late_ns, said, has_fix=random.random() < 0.7))
            if not said[-1].endswith("fix"):
                flights.pop()
        elif random.random() < 0.2:
            space = "uav1/"
        _add_flight(bag, random, flight, space, late_ns, said)
        for own in (space, other) if late_ns else ():
            if own is not None:
                _add_clocks(bag, random, own, late_ns, said)
        for add in random.permutation(len(DECOYS))[: random.integers(0, 5)]:
            DECOYS[add](bag, random, flight, space, late_ns, said)
    return RandomBag(_renamed(random, name, kind, said), flights, said)


def _renamed(random: Random, name: Path, kind: str, said: list[str]) -> Path:
    """Return the bag, under another name, or without its end."""
    if random.random() < 0.5:
        return name
    file = name if kind == "bag" else next(name.glob(f"*.{kind}"))
    if random.random() < 0.5 and kind != "db3":
        said.append("cut")
        content = file.read_bytes()
        file = file.with_name(f"cut.{kind}")
        file.write_bytes(content[: int(len(content) * random.uniform(0.3, 1.0))])
    suffix = str(random.choice([".MCAP", ".BAG", "", ".db", ".recording"]))
    return file.rename(name.parent / f"renamed{suffix}")


def _add_flight(bag: _SortedBag, random: Random, motion: Motion, space: str, late_ns: int, said: list[str]) -> None:
    kind, topic = MEASURED[random.integers(len(MEASURED))]
    said.append(f"/{space}{topic} ({kind})")
    frame = str(random.choice(FRAMES)) if kind == IMU else "map"
    _turning(bag, random, motion, kind, f"/{space}{topic}", late_ns, frame, random.uniform(15, 60))
    if kind != GEO or random.random() < 0.5:
        fix = f"/{space}{random.choice(FIXES)}"
        said.append(fix)
        for t_s in np.arange(0, DURATION_S, 0.4):
            bag.placed(fix, UTC_NS + late_ns + round(t_s * 1e9), motion.place, status=-1 if t_s == 0 else 0)


def _turning(
    bag: _SortedBag, random: Random, motion: Motion, kind: str, topic: str, late_ns: int, frame: str, rate_hz: float
) -> None:
    force = (0.0, 0.0, 0.0) if random.random() < 0.3 else (0.0, 0.0, 9.8)
    times_s = np.arange(0, DURATION_S, 1 / rate_hz)
    rotations, rates = motion.body_to_enu(times_s), motion.rate_flu(times_s)
    forces = rotations.inv().apply(force)
    for k, t_s in enumerate(times_s):
        bag.oriented(
            kind, topic, UTC_NS + late_ns + round(t_s * 1e9), rotations[k], frame,
            rate=rates[k], acceleration=forces[k], place=motion.place,
        )  # fmt: skip


def _add_vehicle(
    bag: _SortedBag, random: Random, space: str, late_ns: int, said: list[str], *, has_fix: bool
) -> Motion:
    """Add another vehicle, with or without its position."""
    motion = Motion.of(random)
    kind, topic = MEASURED[random.integers(6)]
    said.append(f"/{space}{topic}")
    if random.random() < 0.8 or has_fix:
        _turning(bag, random, motion, kind, f"/{space}{topic}", late_ns, "base_link", random.uniform(15, 100))
    if has_fix:
        for t_s in np.arange(0, DURATION_S, 0.2):
            stamp_ns = UTC_NS + late_ns + round(t_s * 1e9)
            bag.placed(f"/{space}mavros/global_position/raw/fix", stamp_ns, motion.place)
        said.append("with fix")
    return motion


def _add_clocks(bag: _SortedBag, random: Random, space: str, late_ns: int, said: list[str]) -> None:
    """Add the TimeReference of a bag whose stamps are no UTC, and others."""
    fcu = str(random.choice(["mavros/time_reference", "gps/time_reference", "ublox/time"]))
    decoys = ("lidar/trigger_time", "camera/sync", "pps/count", "sensors/clock")
    decoy, fault = str(random.choice(decoys)), str(random.choice(["none", "boot", "1970", "frozen", "jumps"]))
    said.append(f"TimeReference {fcu}, {decoy} {fault}")
    for t_s in np.arange(0, DURATION_S, 0.5):
        utc_ns = UTC_NS + round(t_s * 1e9)
        bag.time(f"/{space}{fcu}", utc_ns + late_ns, utc_ns)
        for fraction in np.arange(0, 0.5, 0.05) if fault != "none" else ():
            then_ns = utc_ns + round(fraction * 1e9)
            read_ns = {
                "boot": 1000_000_000_000 + then_ns - UTC_NS,
                "1970": then_ns - UTC_NS,
                "frozen": 1710000000_000000000,
                "jumps": then_ns + int(random.uniform(-3e11, 3e11)),
            }[fault]
            bag.time(f"/{space}{decoy}", then_ns + late_ns, read_ns, origin=str(random.choice(["", "sensor"])))


def _planned(bag: _SortedBag, random: Random, flight: Motion, space: str, late_ns: int, said: list[str]) -> None:
    kind, topic = PLANNED[random.integers(len(PLANNED))]
    said.append(f"planned {topic}")
    motion = Motion.of(random)
    _turning(bag, random, motion, kind, f"/{space}{topic}", late_ns, "map", random.uniform(5, 120))
    del flight


def _sensor(bag: _SortedBag, random: Random, flight: Motion, space: str, late_ns: int, said: list[str]) -> None:
    """Add the IMU of another sensor: without orientation in one fault of several, or with one of its own."""
    topic, frame = SENSORS[random.integers(len(SENSORS))]
    fault = str(random.choice(["identity", "fixed", "minus one", "zero", "unknown", "own"]))
    said.append(f"{topic} {fault}")
    turned = Rotation.random(random_state=int(random.integers(1 << 30)))
    times_s = np.arange(0, DURATION_S, 1 / random.uniform(50, 200))
    rotations, rates = flight.body_to_enu(times_s) * turned, turned.inv().apply(flight.rate_flu(times_s))
    covariance = {"minus one": NO_ORIENTATION, "unknown": np.diag([1e6, 1e6, 1e6]).ravel()}.get(fault, np.zeros(9))
    for k, t_s in enumerate(times_s):
        rotation = {"identity": Rotation.identity(), "fixed": turned}.get(fault, rotations[k])
        bag.oriented(
            IMU, f"/{space}{topic}", UTC_NS + late_ns + round(t_s * 1e9), rotation, frame, covariance=covariance,
            rate=rates[k], quaternion=np.zeros(4) if fault == "zero" else None, acceleration=(0.0, 0.0, 9.8),
        )  # fmt: skip


def _places(bag: _SortedBag, random: Random, flight: Motion, space: str, late_ns: int, said: list[str]) -> None:
    """Add positions that are none of the vehicle's: without a fix, of its home or of its goal."""
    names = (
        "mavros/home_position/fix",
        "home_point",
        "goal/fix",
        "mavros/fake_gps/fix",
        "target/gps",
        "base_station/fix",
    )
    is_unfixed = random.random() < 0.4
    topic = "ublox/fix" if is_unfixed else str(random.choice(names))
    place = (0.0, 0.0, 0.0) if is_unfixed else Motion.of(random).place
    said.append(f"{topic} {place}")
    for t_s in np.arange(0, DURATION_S, 0.05):
        bag.placed(f"/{space}{topic}", UTC_NS + late_ns + round(t_s * 1e9), place, -1 if is_unfixed else 0)
    del flight


def _frozen(bag: _SortedBag, random: Random, flight: Motion, space: str, late_ns: int, said: list[str]) -> None:
    """Add an attitude that stands still, as fast as a real one."""
    kind, topic = MEASURED[random.integers(len(MEASURED))]
    name = f"/{space}{topic}"
    if name in bag.topics:
        return
    said.append(f"frozen {topic}")
    rotation = flight.body_to_enu(0.0) if random.random() < 0.5 else Rotation.identity()
    for t_s in np.arange(0, DURATION_S, 1 / 100):
        stamp_ns = UTC_NS + late_ns + round(t_s * 1e9)
        bag.oriented(kind, name, stamp_ns, rotation, "odom", rate=0.01 * random.normal(size=3), place=flight.place)


def _other_clock(bag: _SortedBag, random: Random, flight: Motion, space: str, late_ns: int, said: list[str]) -> None:
    """Add a camera whose stamps count from its start, and an IMU that counts so and has gyros only."""
    said.append("another clock")
    times_s = np.arange(0, DURATION_S, 0.04)
    for t_s, rate in zip(times_s, flight.rate_flu(times_s), strict=True):
        received_ns, stamp_ns = UTC_NS + late_ns + round(t_s * 1e9), 20_000_000_000 + round(t_s * 1e9)
        bag.oriented(
            IMU, f"/{space}boot/imu", stamp_ns, Rotation.identity(), "imu", covariance=NO_ORIENTATION, rate=rate,
            late_ns=received_ns - stamp_ns,
        )  # fmt: skip
    del random


DECOYS: tuple[Callable[..., None], ...] = (_planned, _planned, _sensor, _places, _frozen, _other_clock)


def judged(made: RandomBag) -> str:
    """Return how a bag was read: empty if right, ``"refused: ..."``, or what is wrong."""
    try:
        flight = open_flight(made.path)
    except LogFormatError as error:
        return f"refused: {error.reason}"
    return _difference(flight, made)


def _difference(flight: Flight, made: RandomBag) -> str:
    first_s, last_s = flight.attitude.first_s, flight.attitude.last_s
    if not -0.01 < first_s - UTC_NS * 1e-9 < DURATION_S:
        return f"wrong: UTC {first_s - UTC_NS * 1e-9:.3f} s off"
    time_s = (first_s + last_s) / 2
    reasons = []
    for motion in made.flights:
        C_body_ned = matrix_from_quaternion(flight.attitude.at(np.array([time_s])))[0]
        truth = motion.body_to_ned(time_s - UTC_NS * 1e-9).as_matrix()
        off_deg = np.rad2deg(Rotation.from_matrix(C_body_ned @ truth).magnitude())
        site = flight.position.at(time_s)
        north_deg = np.rad2deg(site.latitude_rad) - motion.place[0]
        east_deg = np.rad2deg(site.longitude_rad) - motion.place[1]
        if off_deg < 0.2 and abs(north_deg) < 1e-6 and abs(east_deg) < 1e-6:
            return ""
        reasons.append(f"attitude {off_deg:.1f} deg, position {np.hypot(north_deg, east_deg):.3f} deg off")
    return f"wrong: {flight.attitude_source}, {flight.position_source}: {'; '.join(reasons)}"
