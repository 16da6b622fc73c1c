"""Where stars are on an image whose rows a rolling shutter reads one after the other."""

import numpy as np
import pytest

from glstar.calibrate.identify.platesolution import PlateSolution
from glstar.calibrate.identify.rollingshutter import RowTurns
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
