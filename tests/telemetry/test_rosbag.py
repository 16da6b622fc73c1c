"""ROS bags, written by the rosbags library: attitude, UTC and position agree with SciPy."""

import struct
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation, Slerp
from typer.testing import CliRunner

from glstar.cli import app
from glstar.errors import ConfigError, LogFormatError
from glstar.flight import Flight
from glstar.rotation import matrix_from_quaternion
from glstar.sky.place.site import Site
from glstar.telemetry import RateSamples, open_flight, open_source
from glstar.telemetry.recordedlog import RecordedLog
from tests.support.bags import ENU_FLU, IMU, NED_FRD, ODOMETRY, START_NS, TIMES_S, Bag, written

HOME = Site(latitude_rad=np.deg2rad(-34.93), longitude_rad=np.deg2rad(138.60))


def require_agreement(flight: Flight, start_s: float = START_NS * 1e-9) -> None:
    between_s = TIMES_S[2:-2] + 0.0123
    truth = Slerp(TIMES_S, NED_FRD)(between_s).as_matrix()
    C_body_ned = matrix_from_quaternion(flight.attitude.at(between_s + start_s))
    assert np.rad2deg(Rotation.from_matrix(C_body_ned @ truth).magnitude().max()) < 0.001
    assert abs(flight.attitude.first_s - start_s) < 1e-3


@pytest.mark.parametrize("kind", ["bag", "db3", "mcap"])
def test_a_bag_of_each_kind_is_a_flight(tmp_path: Path, kind: str) -> None:
    path = written(tmp_path / ("flight.bag" if kind == "bag" else "flight"), kind)

    # Also the file inside the directory of a ROS 2 bag.
    for one in [path, *(path.glob(f"*.{kind}") if path.is_dir() else [])]:
        flight = open_flight(one)

        require_agreement(flight)
        assert flight.attitude_source == "/imu/data, 25.0 Hz"
        assert flight.position_source == "/fix"
        assert "by the clock of the computer" in flight.utc_source
        site = flight.position.at(START_NS * 1e-9 + 2)
        assert abs(np.rad2deg(site.latitude_rad) - (-34.93 + 2e-5)) * 111e3 < 1
        assert abs(site.height_m - 152) < 1


def test_info_and_export_take_the_directory_of_a_bag(tmp_path: Path) -> None:
    path = written(tmp_path / "flight", "mcap")

    shown = CliRunner().invoke(app, ["info", str(path)])
    exported = CliRunner().invoke(
        app, ["export", str(path), "-o", str(tmp_path / "out"), "--exposure", "0.5", "--frames", "1"]
    )

    assert shown.exit_code == 0, shown.output
    assert "ROS 2 bag" in shown.output
    assert "/imu/data" in shown.output
    assert exported.exit_code == 0, exported.output
    assert (tmp_path / "out" / "frame_000000.png").exists()


def test_the_frame_of_a_pose_and_the_accelerometers_of_an_imu_say_that_it_is_ned(tmp_path: Path) -> None:
    with Bag(tmp_path / "flight.bag", "bag") as bag:
        for k in range(TIMES_S.size):
            bag.imu(k, START_NS, NED_FRD, up=-1.0)
            bag.pose(k, START_NS, NED_FRD, "map_NED", "/pose")
            bag.pose(k, START_NS, NED_FRD, "map", "/other")

    for attitude, columns in (
        ("/imu/data", None),
        ("/pose", None),
        ("/other", "world=NED,body=FRD"),
        ("/other", "world=NED"),
    ):
        require_agreement(open_flight(tmp_path / "flight.bag", site=HOME, attitude=attitude, columns=columns))


@pytest.mark.parametrize("frame_id", ["imu_aligned", "planned", "imu_ned", "ned"])
def test_the_frame_of_an_imu_says_nothing_about_the_world(tmp_path: Path, frame_id: str) -> None:
    with Bag(tmp_path / "flight", "mcap") as bag:
        for k in range(TIMES_S.size):
            bag.imu(k, START_NS, ENU_FLU, frame_id)

    require_agreement(open_flight(tmp_path / "flight", site=HOME))


def test_rates_are_turned_into_forward_right_down(tmp_path: Path) -> None:
    with open_source(written(tmp_path / "flight", "db3")) as source:
        (rates,) = [one for one in source.samples() if isinstance(one, RateSamples)]

    turn = (NED_FRD[49].inv() * NED_FRD[51]).as_rotvec() / 0.08
    np.testing.assert_allclose(rates.rate_rad_per_s[50], turn, rtol=0, atol=1e-9)


@pytest.mark.filterwarnings("error")
def test_a_signalling_nan_in_a_rate_costs_one_sample_and_no_warning(tmp_path: Path) -> None:
    """Damage makes such numbers; NumPy warns when it multiplies them."""
    marker = 0.012345678901234567
    turned = ENU_FLU
    with Bag(tmp_path / "flight.bag", "bag") as bag:
        for k in range(TIMES_S.size):
            stamp_ns = START_NS + round(TIMES_S[k] * 1e9)
            before, after = max(k - 1, 0), min(k + 1, TIMES_S.size - 1)
            turn = (turned[before].inv() * turned[after]).as_rotvec() / (TIMES_S[after] - TIMES_S[before])
            rate = (turn[0], marker if k == 20 else turn[1], turn[2])
            bag.oriented(IMU, "/imu/data", stamp_ns, turned[k], "imu_link", rate=rate, acceleration=(0, 0, 9.8))
            bag.fix(k, START_NS)
    path = tmp_path / "flight.bag"
    content = path.read_bytes()
    assert content.count(struct.pack("<d", marker)) == 1
    path.write_bytes(content.replace(struct.pack("<d", marker), struct.pack("<Q", 0x7FF0_0000_0000_0001)))

    require_agreement(open_flight(path))
    with open_source(path) as source:
        rates = RecordedLog.read(source).longest.rates
    assert rates is not None
    assert rates.clock_s.size == TIMES_S.size - 1


def test_stamps_of_a_simulator_are_converted_by_time_reference(tmp_path: Path) -> None:
    offset_ns = START_NS - 5_000_000_000
    with Bag(tmp_path / "flight", "mcap") as bag:
        for k in range(TIMES_S.size):
            bag.imu(k, 5_000_000_000, ENU_FLU)
            bag.fix(k, 5_000_000_000)
            stamp_ns = 5_000_000_000 + round(TIMES_S[k] * 1e9)
            bag.time("/time_reference", stamp_ns, stamp_ns + offset_ns)

    flight = open_flight(tmp_path / "flight")

    require_agreement(flight)
    assert flight.utc_source == "/time_reference, 100 readings"


def test_stamps_of_a_simulator_without_utc_are_no_utc(tmp_path: Path) -> None:
    path = written(tmp_path / "flight", "mcap", start_ns=5_000_000_000)

    with pytest.raises(
        LogFormatError, match=r"the log has no UTC \(its stamps are no UTC, and it has no TimeReference\)"
    ):
        open_flight(path)

    require_agreement(open_flight(path, utc_start=START_NS * 1e-9))


def test_topics_can_be_chosen(tmp_path: Path) -> None:
    with Bag(tmp_path / "flight", "mcap") as bag:
        for k in range(TIMES_S.size):
            bag.imu(k, START_NS, ENU_FLU)
            bag.fix(k, START_NS)
            stamp_ns = START_NS + round(TIMES_S[k] * 1e9)
            bag.oriented(ODOMETRY, "/odom", stamp_ns, Rotation.identity(), "odom", child_frame_id="base")
            bag.fix(k, START_NS, topic="/gps/other")

    flight = open_flight(tmp_path / "flight", attitude="/odom", columns="position=/gps/other")

    # Without rotation the nose points east.
    C_body_ned = matrix_from_quaternion(flight.attitude.at(np.array([START_NS * 1e-9 + 1])))[0]
    np.testing.assert_allclose(C_body_ned[0], [0, 1, 0], rtol=0, atol=1e-9)
    assert flight.position_source == "/gps/other"
    assert any("may be relative to the start" in note for note in flight.notes)
    with pytest.raises(LogFormatError, match=r"no attitude '/nope' \(--attitude\); it has /imu/data \(Imu\), /odom"):
        open_flight(tmp_path / "flight", attitude="/nope")
    with pytest.raises(LogFormatError, match=r"no position '/nope' \(--columns position=\); it has /fix, /gps/other"):
        open_flight(tmp_path / "flight", columns="position=/nope")
    with pytest.raises(ConfigError, match=r"'wrld=NED' says nothing about a bag \(did you mean world\?\)"):
        open_flight(tmp_path / "flight", columns="wrld=NED")


def test_an_imu_without_orientation_is_no_attitude(tmp_path: Path) -> None:
    with Bag(tmp_path / "flight", "mcap") as bag:
        for k in range(5):
            bag.fix(k, START_NS)

    with pytest.raises(LogFormatError, match=r"the bag has no attitude: .*it has sensor_msgs/NavSatFix"):
        open_flight(tmp_path / "flight")


@pytest.mark.parametrize("name", ["flight.bag", "flight.mcap", "flight.db3"])
def test_a_damaged_bag_is_refused_in_one_line(tmp_path: Path, name: str) -> None:
    kind = name.rpartition(".")[2]
    path = written(tmp_path / ("whole.bag" if kind == "bag" else "whole"), kind)
    whole = path if kind == "bag" else next(path.glob(f"*.{kind}"))
    (tmp_path / name).write_bytes(whole.read_bytes()[:300])

    with pytest.raises(LogFormatError) as caught:
        open_flight(tmp_path / name)

    assert str(caught.value).startswith(f"{tmp_path / name}: cannot be read as a ROS bag: ")
    assert "\n" not in str(caught.value)
