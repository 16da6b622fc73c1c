"""The active estimator of ArduPilot: it is used, and differences and dropped samples are reported."""

from pathlib import Path

import numpy as np
import pytest

from glstar.rotation import quaternion_from_euler
from glstar.telemetry import open_flight, open_source, survey
from tests.support.dataflash import BOOT_S, ELEVEN_S, Log, angle_deg, conjugate, times


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "log.BIN"


def log_of(
    *, att_yaw_deg: float, xkq_yaw_deg: float | None = None, nkq_yaw_deg: float | None = None, aekf: int = 3
) -> Log:
    """Return a log of a level aircraft; each estimator has another yaw."""
    log = Log()
    for t in times():
        log.att(t, yaw_deg=att_yaw_deg, aekf=aekf)
        log.pos(t)
        if xkq_yaw_deg is not None:
            log.xkq(t, 0, xkq_yaw_deg)
        if nkq_yaw_deg is not None:
            log.xkq(t, 0, nkq_yaw_deg, name="NKQ")
    for t in times(rate_hz=5):
        log.gps(t)
    return log


def yaw_error_deg(path: Path, yaw_deg: float, **options: str) -> float:
    q = open_flight(path, **options).attitude.at([ELEVEN_S + 1.0])
    return float(angle_deg(q, quaternion_from_euler(0.0, 0.0, np.deg2rad(yaw_deg)))[0])


@pytest.mark.parametrize(("aekf", "flew"), [(0, "DCM"), (11, "an external AHRS")])
def test_att_is_used_if_no_ekf_was_active_and_the_difference_is_reported(path: Path, aekf: int, flew: str) -> None:
    log_of(att_yaw_deg=10.0, xkq_yaw_deg=61.0, aekf=aekf).save(path)

    assert yaw_error_deg(path, 10.0) < 0.01
    assert yaw_error_deg(path, 61.0, attitude="XKQ") < 0.01
    assert open_flight(path).notes == (
        f"XKQ is 51.0 deg from ATT in the median (51.0 deg in yaw); by ATT.AEKF {flew} flew; ATT is taken,"
        " --attitude XKQ takes the other",
    )


@pytest.mark.parametrize(("aekf", "flew", "yaw_deg"), [(3, "XKQ", 30.0), (2, "NKQ", 50.0)])
def test_the_active_ekf_is_used(path: Path, aekf: int, flew: str, yaw_deg: float) -> None:
    log_of(att_yaw_deg=yaw_deg, xkq_yaw_deg=30.0, nkq_yaw_deg=50.0, aekf=aekf).save(path)

    assert yaw_error_deg(path, yaw_deg) < 0.01
    assert open_flight(path).attitude_source.startswith(flew)
    assert open_flight(path).notes == ()


def test_an_ekf_that_differs_from_att_by_its_trim_is_reported_from_one_degree_on(path: Path) -> None:
    log_of(att_yaw_deg=10.0, xkq_yaw_deg=10.9).save(path)
    assert open_flight(path).notes == ()

    log_of(att_yaw_deg=10.0, xkq_yaw_deg=11.2).save(path)
    [note] = open_flight(path).notes
    assert note.startswith(
        "XKQ is 1.2 deg from ATT in the median (1.2 deg in yaw); by ATT.AEKF EKF3 flew; XKQ is taken,"
    )


@pytest.mark.parametrize(
    ("att_deg", "xkq_deg", "between_deg"), [(170, -160, 30), (190, 160, 30), (5, -5, 10), (0, 179, 179)]
)
def test_a_difference_in_yaw_is_the_shorter_one(path: Path, att_deg: float, xkq_deg: float, between_deg: float) -> None:
    log_of(att_yaw_deg=att_deg, xkq_yaw_deg=xkq_deg).save(path)

    [note] = open_flight(path).notes

    assert note.startswith(f"XKQ is {between_deg:.1f} deg from ATT in the median ({between_deg:.1f} deg in yaw); ")


@pytest.mark.parametrize(("far", "is_noted"), [(1, False), (3, True)])
def test_an_ekf_that_differs_for_a_hundredth_of_the_flight_is_reported(path: Path, far: int, is_noted: bool) -> None:
    """Of 200 samples."""
    log = Log()
    for number, t in enumerate(times(duration_s=8.0)):
        log.att(t, yaw_deg=10.0 + 5.0 * (100 <= number < 100 + far))
        log.pos(t)
        log.xkq(t, 0, 10.0)
    for t in times(rate_hz=5):
        log.gps(t)

    notes = open_flight(log.save(path)).notes

    assert [note.split(" of the time")[0] for note in notes] == [f"for {far / 2:.1f} %"] * is_noted


def test_the_survey_names_the_active_estimator(path: Path) -> None:
    log = log_of(att_yaw_deg=10.0, xkq_yaw_deg=10.0)
    for t in np.arange(2.04, 2.60, 0.04):
        log.att(BOOT_S + float(t), yaw_deg=10.0, aekf=0)
    with open_source(log.save(path)) as source:
        found, _ = survey(source)

    assert found.estimator == "EKF3 77.3 %, DCM 22.7 %"


def test_an_ekf_that_differs_for_a_part_of_the_flight_is_reported(path: Path) -> None:
    log = log_of(att_yaw_deg=10.0, xkq_yaw_deg=10.0)
    for t in np.arange(2.04, 2.60, 0.04):
        log.att(BOOT_S + float(t), yaw_deg=50.0, aekf=0)
        log.xkq(BOOT_S + float(t), 0, 10.0)

    [note] = open_flight(log.save(path)).notes

    assert note == (
        "for 22.7 % of the time XKQ is more than 1 deg from ATT, 40.0 deg at most;"
        " by ATT.AEKF EKF3 77.3 %, DCM 22.7 % flew; XKQ is taken, --attitude ATT takes the other"
    )


# --- dropped samples ------------------------------------------------------------------------------------------------
def test_attitude_dropped_before_the_alignment_is_reported_with_an_alternative(path: Path) -> None:
    log = Log()
    for t in times(duration_s=20.0):
        log.att(t)
        log.pos(t)
        q = (1.0, 0.0, 0.0, 0.0) if t < BOOT_S + 15.0 else conjugate(quaternion_from_euler(0.001, 0.0, 0.0))
        log.add("XKQ", "QBffff", "TimeUS,C,Q1,Q2,Q3,Q4", round(t * 1e6), 0, *q)
    for t in times(rate_hz=5):
        log.gps(t)

    flight = open_flight(log.save(path))

    assert flight.attitude.last_s - flight.attitude.first_s == pytest.approx(5.0, abs=0.05)
    assert flight.notes == (
        "the first 15.0 s of XKQ are left out, before its EKF was aligned: 5.0 s remain; --attitude ATT covers 20.0 s",
    )
    whole = open_flight(path, attitude="ATT")
    assert whole.attitude.last_s - whole.attitude.first_s == pytest.approx(20.0, abs=1e-3)


def test_quaternions_that_are_not_of_unit_length_are_reported(path: Path) -> None:
    log = log_of(att_yaw_deg=10.0)
    for t in times():
        log.add("XKQ", "QBffff", "TimeUS,C,Q1,Q2,Q3,Q4", round(t * 1e6), 0, 0.5, 0.0, 0.0, 0.0)

    flight = open_flight(log.save(path))

    assert flight.attitude_source == "ATT, 25.0 Hz"
    assert flight.notes == ("XKQ is left out because its quaternions have length 0.5, not 1; ATT is used",)


# --- a lane that flew but is not logged -----------------------------------------------------------------------------
@pytest.mark.parametrize("lane_0_deg", [40.0, 10.0])
def test_att_is_taken_if_the_lane_that_flew_is_not_logged_and_the_others_differ(path: Path, lane_0_deg: float) -> None:
    log = log_of(att_yaw_deg=10.0, xkq_yaw_deg=lane_0_deg)
    log.xkf4(BOOT_S - 1.0, primary=1)

    flight = open_flight(log.save(path))

    # ATT is of the lane that flew; a lane that agrees with it is more precise.
    assert yaw_error_deg(path, 10.0) < 0.01
    taken = "ATT is of the lane that flew, it is taken" if lane_0_deg == 40.0 else "--attitude ATT takes it"
    assert flight.notes[0].startswith("by XKF4.PI lane 1 flew, but XKQ has only lane 0; ")
    assert taken in flight.notes[0]


def test_a_lane_that_differs_from_att_by_the_trim_is_taken(path: Path) -> None:
    log = Log()
    for name, value in (("AHRS_TRIM_X", np.deg2rad(0.5)), ("AHRS_TRIM_Y", np.deg2rad(-0.7)), ("AHRS_TRIM_Z", 0.0)):
        log.add("PARM", "QNf", "TimeUS,Name,Value", round(BOOT_S * 1e6), name, value)
    log.xkf4(BOOT_S - 1.0, primary=1)
    for t in times():
        log.att(t, roll_deg=-0.5, pitch_deg=0.7, yaw_deg=10.0)
        log.xkq(t, 0, 10.0)
        log.pos(t)
    for t in times(rate_hz=5):
        log.gps(t)

    assert yaw_error_deg(log.save(path), 10.0) < 0.01
    assert open_flight(path).attitude_source.startswith("XKQ lane 0")


def test_a_lane_that_flew_for_a_part_and_is_not_logged_leaves_a_gap_and_a_remark(path: Path) -> None:
    log = log_of(att_yaw_deg=10.0, xkq_yaw_deg=10.0)
    log.xkf4(BOOT_S - 1.0, primary=0)
    log.xkf4(BOOT_S + 0.99, primary=1)
    log.xkf4(BOOT_S + 1.51, primary=0)

    flight = open_flight(log.save(path))

    assert [
        (round(gap.start_utc_s - flight.attitude.first_s, 2), round(gap.duration_s, 2)) for gap in flight.attitude.gaps
    ] == [(0.96, 0.56)]
    assert flight.notes[0].startswith("by XKF4.PI lane 1 flew for 25.5 % of the time, but XKQ has only lane 0; ATT is")
