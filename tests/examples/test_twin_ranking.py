"""Verdicts on photographs and twins, and what follows of them."""

from pathlib import Path

import numpy as np
import pytest

from glstar.rotation import matrix_from_euler, quaternion_from_matrix
from glstar.sky.place.timescale import parse_utc
from tests.examples.celestial_fix import position
from tests.scripts.twin_ranking import (
    UTC,
    ZENITH,
    Photograph,
    rank_of_images,
    rank_of_solvers,
    same_verdicts,
    with_interval,
)

C_CAMERA_ICRS = matrix_from_euler(0.3, -0.4, 2.0)


def photograph() -> Photograph:
    solution = {"C_camera_icrs": C_CAMERA_ICRS.tolist(), "radial_distortion_k1": -0.1}
    return Photograph(Path("a.png"), "20", Path("b.png"), solution | dict.fromkeys(("fx_px", "cx_px", "cy_px"), 500.0))


def answers(C_camera_icrs: np.ndarray) -> list[dict[str, float]]:
    """Return what solvers say of an attitude: a quaternion, a direction, a position."""
    x, y, z = C_camera_icrs[2]
    quaternion = dict(zip(("qw", "qx", "qy", "qz"), quaternion_from_matrix(C_camera_icrs).tolist(), strict=True))
    direction = {"ra_deg": float(np.rad2deg(np.arctan2(y, x))), "dec_deg": float(np.rad2deg(np.arcsin(z)))}
    latitude_deg, longitude_deg = position(C_camera_icrs, np.array(ZENITH), parse_utc(UTC))
    return [quaternion, direction, {"latitude_deg": latitude_deg, "longitude_deg": longitude_deg}]


@pytest.mark.parametrize(("off_deg", "verdict"), [(0.4, "right"), (0.6, "false"), (180.0, "false")])
def test_an_answer_is_right_within_half_a_degree(off_deg: float, verdict: str) -> None:
    turned = matrix_from_euler(0.0, np.deg2rad(off_deg), 0.0) @ C_CAMERA_ICRS

    assert [photograph().verdict(answer) for answer in answers(turned)] == [verdict] * 3


def test_no_answer_is_refused() -> None:
    assert photograph().verdict(None) == photograph().verdict({"status": "refused"}) == "refused"


def test_a_solver_gets_the_camera_of_the_plate_solution() -> None:
    nav = photograph().nav(3, 1000, 800)

    assert nav["file"] == "frame_000003.png"
    assert nav["camera"]["lens"] == "plumb_bob"
    assert nav["camera"]["distortion"] == [-0.1, 0.0, 0.0, 0.0]
    assert nav["camera"]["K"][0] == [500.0, 0.0, 500.0]


def test_equal_verdicts_and_ranks() -> None:
    r, n, f = "right", "refused", "false"
    # Three solvers, photographs above twins, four images.
    found = np.array([[[r, r, r, n], [r, r, r, n]], [[r, r, n, n], [r, r, n, f]], [[r, n, n, n], [r, n, n, n]]])

    assert same_verdicts(found) == pytest.approx(11 / 12)
    assert rank_of_solvers(found) == pytest.approx(1.0)  # 3, 2 and 1 right answers on both
    assert rank_of_images(found) == pytest.approx(1.0)
    assert np.isnan(rank_of_solvers(np.stack([found[0], found[0]])))  # equal solvers have no ranks
    value, low, high = with_interval(same_verdicts, found)
    assert low <= value <= high
    assert (low, high) == (pytest.approx(2 / 3, abs=0.1), 1.0)  # the image that differs is drawn 0 to 3 times


def test_ranks_that_turn_round_are_negative() -> None:
    r, n = "right", "refused"
    found = np.array([[[r, r], [n, n]], [[n, r], [n, r]], [[n, n], [r, r]]])

    assert rank_of_solvers(found) == pytest.approx(-1.0)
