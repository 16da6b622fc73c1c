"""Where stars are on an image whose rows a rolling shutter reads one after the other."""

import numpy as np
import pytest

from glstar.calibrate.identify.platesolution import PlateSolution
from glstar.calibrate.identify.rollingshutter import ReadoutTime, RowTurns
from glstar.camera.exposure import Readout
from glstar.camera.model import Camera
from glstar.errors import CalibrationError
from glstar.flight import AttitudeTrack
from glstar.rotation import about_z, matrix_from_quaternion, quaternion_from_turn

MID_S = 1000.0
CAMERA = Camera(400, 300, 380.0, 380.0, 199.5, 149.5)


def attitude(rate_deg_per_s: tuple[float, float, float]) -> AttitudeTrack:
    utc_s = MID_S + np.arange(-60, 61) * 0.005
    turn_rad = np.deg2rad(rate_deg_per_s) * (utc_s - MID_S)[:, np.newaxis]
    return AttitudeTrack.from_samples(utc_s, quaternion_from_turn(turn_rad))


@pytest.mark.parametrize("readout", ["down", "up", "left", "right"])
@pytest.mark.parametrize("mirrored", [False, True])
def test_a_star_is_where_the_open_row_meets_it(readout: Readout, *, mirrored: bool) -> None:
    """Against 200,001 moments of the readout: the one in which the star is on the row that is open."""
    track, readout_s = attitude((31.0, -22.0, 45.0)), 0.09
    C_ned_eq, C_camera_body = about_z(1.1), matrix_from_quaternion(quaternion_from_turn(np.array([0.4, -0.3, 0.2])))
    C_camera_eq = C_camera_body @ matrix_from_quaternion(track.at([MID_S]))[0] @ C_ned_eq
    solution = PlateSolution(CAMERA, C_camera_eq, mirrored)
    rays = CAMERA.unit_vectors(np.array([[30.0, 20.0], [200.0, 150.0], [350.0, 40.0], [80.0, 270.0]]))
    apparent = rays @ C_camera_eq
    found = solution.placed(apparent, RowTurns(track, MID_S, C_ned_eq, readout_s, readout))

    share = np.linspace(0, 1, 200_001)
    C = matrix_from_quaternion(track.at(MID_S + (share - 0.5) * readout_s))
    for star, direction in enumerate(apparent):
        path = solution.project(np.einsum("ij,njk,k->ni", C_camera_body, C, C_ned_eq @ direction))
        position = path[:, 1] / 299 if readout in {"down", "up"} else path[:, 0] / 399
        opened = share if readout in {"down", "right"} else 1 - share
        np.testing.assert_allclose(found[star], path[np.argmin(np.abs(position - opened))], rtol=0, atol=2e-3)


def test_directions_at_the_middle_row_are_unchanged() -> None:
    rows = RowTurns(attitude((50.0, 0.0, 0.0)), MID_S, np.eye(3), 0.1)
    direction = np.array([[0.6, 0.0, 0.8]])
    np.testing.assert_allclose(rows.turned(direction, np.array([[7.0, 149.5]]), CAMERA), direction, rtol=0, atol=1e-12)


def test_rows_beyond_the_log_are_refused() -> None:
    rows = RowTurns(attitude((1.0, 0.0, 0.0)), MID_S + 0.29, np.eye(3), 0.1)
    with pytest.raises(CalibrationError, match=r"within 100 ms around --utc, .* 0\.590 s before and 0\.010 s after"):
        rows.require_covered(0.1)


def test_rows_open_at_their_part_of_the_readout() -> None:
    xy = np.array([[0.0, 299.0], [100.0, 30.0], [450.0, -20.0]])
    across, down = np.array([-0.5, 100 / 399 - 0.5, 0.5]), np.array([0.5, 30 / 299 - 0.5, -0.5])
    for readout, share in (("down", down), ("up", -down), ("right", across), ("left", -across)):
        rows = RowTurns(attitude((1.0, 0.0, 0.0)), MID_S, np.eye(3), 0.08, readout)
        np.testing.assert_allclose(rows.offset_s(xy, CAMERA), 0.08 * share, rtol=1e-12)
    # An image of one row.
    assert RowTurns(attitude((1.0, 0.0, 0.0)), MID_S, np.eye(3), 0.08).offset_s(
        np.array([[3.0, 0.0], [3.0, 7.0]]), Camera(400, 1, 380.0, 380.0, 199.5, 0.0)
    ).tolist() == [-0.04, 0.04]
    assert [rows.with_readout_s(s).direction for s in (0.5, 0.0, -1e-3)] == ["left", "left", "right"]
    assert (rows.with_readout_s(-0.25).readout_s, rows.with_readout_s(-0.25).readout) == (-0.25, "left")


def test_the_turn_rate_is_the_mean_around_the_middle() -> None:
    t = np.arange(-64, 65) / 256
    turn = np.column_stack([np.zeros_like(t), 0.8 * t + 5 * t**3, np.zeros_like(t)])
    rows = RowTurns(AttitudeTrack.from_samples(MID_S + t, quaternion_from_turn(turn)), MID_S, np.eye(3), 0.1)
    for span_s in (0.125, 0.5):
        assert rows.rate_rad_per_s(span_s) == pytest.approx(0.8 + 5 * span_s**2 / 4, rel=1e-6)
    rows.require_covered(0.5)  # to the first and the last sample
    with pytest.raises(CalibrationError, match=r"within 501 ms .* 0\.250 s before and 0\.250 s after"):
        rows.require_covered(0.501)
    later = RowTurns(rows.attitude, MID_S + 1 / 128, np.eye(3), 0.1)
    with pytest.raises(CalibrationError, match=r"0\.258 s before and 0\.242 s after"):
        later.require_covered(0.5)
    with pytest.raises(CalibrationError, match=r"0\.242 s before and 0\.258 s after"):
        RowTurns(rows.attitude, MID_S - 1 / 128, np.eye(3), 0.1).require_covered(0.5)
    holed = np.flatnonzero(np.abs(t - 0.1) > 0.06)
    track = AttitudeTrack.from_samples(MID_S + t[holed], quaternion_from_turn(turn[holed]), max_gap_s=0.05)
    RowTurns(track, MID_S, np.eye(3), 0.1).require_covered(0.06)
    text = "the log has a data gap of 0.12 s while the rows of the rolling shutter are read; leave this photograph out"
    with pytest.raises(CalibrationError, match=text):
        RowTurns(track, MID_S, np.eye(3), 0.1).require_covered(0.3)


def test_directions_move_with_the_readout_by_the_turn_rate() -> None:
    rate = np.array([0.3, -0.5, 0.7])
    rows = RowTurns(attitude(tuple(np.rad2deg(rate))), MID_S, about_z(0.6), 0.04)
    apparent, xy = np.array([[0.36, 0.48, 0.8], [-0.6, 0.0, 0.8]]), np.array([[10.0, 40.0], [390.0, 290.0]])
    share = xy[:, 1] / 299 - 0.5
    turned = rows.turned(apparent, xy, CAMERA)
    for k in range(2):
        body = rows.C_ned_eq @ apparent[k]
        expected = matrix_from_quaternion(quaternion_from_turn(rate * 0.04 * share[k])) @ body
        np.testing.assert_allclose(rows.C_ned_eq @ turned[k], expected, rtol=0, atol=2e-6)
        h = 1e-3
        later, earlier = (
            rows.C_ned_eq.T @ matrix_from_quaternion(quaternion_from_turn(rate * (0.04 + s) * share[k])) @ body
            for s in (h, -h)
        )
        np.testing.assert_allclose(
            rows.by_readout(apparent, xy, CAMERA)[k], (later - earlier) / (2 * h), rtol=0, atol=2e-5
        )


@pytest.mark.parametrize(("rate", "turn_rad"), [(2.0, 0.18), (9.0, 0.7)])
def test_stars_beyond_twice_the_turn_are_not_moved(rate: float, turn_rad: float) -> None:
    """Beyond 0.7 rad (40 deg) the margin grows no more."""
    rows = RowTurns(attitude((0.0, np.rad2deg(rate), 0.0)), MID_S, np.eye(3), 0.09, "down")
    margin = 2 * 380 * np.tan(turn_rad) + 2
    at = np.array(
        [[-0.5 - margin + 3, 9.0], [-0.5 - margin - 3, 9.0], [399.5 + margin - 3, 9], [399.5 + margin + 3, 9]]
    )
    apparent = CAMERA.unit_vectors(at)
    found = rows.positions(CAMERA.project, apparent, CAMERA)
    moved = np.linalg.norm(found - at, axis=1)
    assert np.isfinite(moved[[1, 3]]).all()
    assert (moved[[1, 3]] < 1e-6).all()
    assert not (moved[[0, 2]] < 5).any()


def test_a_star_that_crosses_faster_than_the_rows_has_no_position() -> None:
    track = attitude((np.rad2deg(12.0), 0.0, 0.0))
    middle = CAMERA.unit_vectors(np.array([[199.5, 170.0]]))
    found = [RowTurns(track, MID_S, np.eye(3), s * 0.09).positions(CAMERA.project, middle, CAMERA) for s in (1, -1)]
    assert sorted(np.isnan(one).all() for one in found) == [False, True]
    assert sorted(np.isnan(one).any() for one in found) == [False, True]


def test_a_readout_time_is_described_in_all_forms() -> None:
    fitted = ReadoutTime(0.01642, 0.000321, "up", True, 37, 2, np.deg2rad(1.25))
    assert fitted.summary == (
        "readout time 16.42 ± 0.32 ms, rows open up, against the given direction: from 37 stars of 2 images, and turns"
        " of up to 1.25 deg meanwhile"
    )
    plain = ReadoutTime(0.01642, 0.000321, "down", False, 37, 1, np.deg2rad(1.25)).summary
    assert plain.startswith("readout time 16.42 ± 0.32 ms, rows open down: from 37 stars of one image, and")
    assert fitted.to_json() == {
        "readout_s": 0.01642,
        "readout_std_s": 0.000321,
        "readout": "up",
        "opposite_to_given": True,
        "stars": 37,
        "images": 2,
        "largest_turn_deg": pytest.approx(1.25),
    }
    assert ReadoutTime(0.0164234567, 0.000321, "up", True, 37, 2, 0.1).toml_lines() == [
        "",
        "# The rolling shutter's readout time: standard error 0.00032 s.",
        "[exposure]",
        "readout_s = 0.016423",
        'readout = "up"',
    ]
