"""What `glstar manual solvers` states, and the adapters of five solvers on frames of glstar."""

import json
import math
import os
import subprocess
import sys
from functools import cache
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from glstar.score.scoring import Score, score
from tests.examples import solver_adapters
from tests.support.exports import in_folder

ADAPTERS = Path(solver_adapters.__file__)
CONFIG = (ADAPTERS.parent / "solvers.toml").read_text(encoding="utf-8")
MODULES = {
    "tetra3rs": "tetra3rs",
    "cedar-solve": "tetra3",
    "zenith-fixer": "zenith",
    "ruststartracker": "ruststartracker, typing_extensions",
    "astrometry": "astrometry",
}
Row = dict[str, Any]


def exported(folder: Path, config: str) -> Path:
    (folder / "night.toml").write_text(config, encoding="utf-8")
    command = ["export", "-c", "night.toml", "-o", "seen", "--blind", "hidden", "--frames", "4"]
    assert in_folder(folder, *command).rc == 0
    return folder


@pytest.fixture(scope="module")
def night(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return exported(tmp_path_factory.mktemp("night"), CONFIG)


@pytest.fixture(scope="module")
def without_refraction(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return exported(tmp_path_factory.mktemp("airless"), f"{CONFIG}\n[sky]\nrefraction = false\n")


def rows(path: Path) -> list[Row]:
    return [json.loads(line) for line in path.read_text(encoding="utf-8").splitlines()]


def scored(night: Path, answers: list[Row], folder: Path) -> Score:
    (folder / "answers.jsonl").write_text("".join(json.dumps(one) + "\n" for one in answers), encoding="utf-8")
    return score(night / "hidden", folder / "answers.jsonl")


def by_quaternion(truth: Row) -> Row:
    """Scalar first, and it turns ICRS components into camera components: v_camera = R v_icrs."""
    x, y, z, w = Rotation.from_matrix(truth["C_camera_icrs"]).as_quat()
    return {"qw": w, "qx": x, "qy": y, "qz": z}


def by_angles(truth: Row) -> Row:
    """The optical axis is the third row; roll is the angle from north through east to up, minus the second row."""
    _, down, (x, y, z) = truth["C_camera_icrs"]
    ra, dec = math.atan2(y, x), math.asin(z)
    up = -np.array(down)
    to_north = up @ [-math.sin(dec) * math.cos(ra), -math.sin(dec) * math.sin(ra), math.cos(dec)]
    to_east = up @ [-math.sin(ra), math.cos(ra), 0.0]
    roll = math.atan2(to_east, to_north)
    return {"ra_deg": math.degrees(ra), "dec_deg": math.degrees(dec), "roll_deg": math.degrees(roll)}


@pytest.mark.parametrize("rule", [by_quaternion, by_angles])
def test_an_answer_by_the_rules_of_the_page_scores_0(rule: Any, night: Path, tmp_path: Path) -> None:
    answers = [{"frame": truth["frame"]} | rule(truth) for truth in rows(night / "hidden" / "truth.jsonl")]

    summary = scored(night, answers, tmp_path).summary.json

    assert summary["solved"] == 4
    assert summary["boresight_arcsec"]["p90"] < 1e-3
    assert summary["roll_arcsec"]["p90"] < 1e-3
    # Aberration and refraction move pixels: a rotation fitted to them has an error that the attitude has not.
    assert summary["boresight_floor_arcsec"]["median"] > 5


def test_the_roll_of_cedar_solve_is_that_of_the_page_with_the_other_sign(night: Path) -> None:
    """Its Roll is positive where north is counter-clockwise of the image's up, by its documentation."""
    truth = rows(night / "hidden" / "truth.jsonl")[1]
    C = np.array(truth["C_camera_icrs"])
    north = C @ (np.array([0.0, 0.0, 1.0]) - C[2] * C[2, 2])
    # Right is +x and up is -y: counter-clockwise from up is towards -x.
    Roll_deg = math.degrees(math.atan2(-north[0], -north[1]))

    assert by_angles(truth)["roll_deg"] == pytest.approx(-Roll_deg, rel=1e-9)
    assert abs(Roll_deg) > 1


def test_centroids_of_an_image_are_pixel_centres_from_0(night: Path) -> None:
    truth = rows(night / "hidden" / "truth.jsonl")[0]
    image = cv2.imread(str(night / "seen" / truth["file"]), cv2.IMREAD_UNCHANGED)
    bright = [star for star in truth["stars"] if star["snr"] > 10 and star["in_frame"] == 1 and not star["saturated"]]
    true_px = np.array([(star["centroid_x_px"], star["centroid_y_px"]) for star in bright])

    found_px = solver_adapters.spots(image)

    offsets = found_px[:, np.newaxis] - true_px
    near = np.linalg.norm(offsets, axis=-1) < 2
    assert near.sum() >= 3
    # A corner for a centre would be 0.5 px, a count from 1 a pixel.
    np.testing.assert_allclose(np.median(offsets[near], axis=0), 0, rtol=0, atol=0.1)


def test_refraction_is_in_the_pixels_and_not_in_the_attitude(night: Path, without_refraction: Path) -> None:
    with_air, airless = (rows(one / "hidden" / "truth.jsonl")[0] for one in (night, without_refraction))
    positions = [
        {star["star_id"]: (star["x_px"], star["y_px"]) for star in truth["stars"]} for truth in (with_air, airless)
    ]
    moved_px = [math.dist(positions[0][star], positions[1][star]) for star in positions[0].keys() & positions[1].keys()]

    np.testing.assert_array_equal(with_air["C_camera_icrs"], airless["C_camera_icrs"])
    assert max(moved_px) > 0.1


def test_the_record_of_a_frame_states_its_conventions_and_follows_them(night: Path) -> None:
    for nav, truth in zip(rows(night / "seen" / "nav.jsonl"), rows(night / "hidden" / "truth.jsonl"), strict=True):
        assert nav["conventions"]["quaternion"].startswith("[w, x, y, z]; q_body_ned turns components along (north,")
        assert "(0, 0) is the centre" in nav["conventions"]["pixel"]
        w, x, y, z = nav["q_body_ned"]["middle"]
        up_body = Rotation.from_quat([x, y, z, w]).apply([0.0, 0.0, -1.0])
        up_camera = np.array(nav["C_camera_body"]) @ up_body
        # Without errors in [navigator], what the aircraft estimates is true.
        np.testing.assert_allclose(nav["up_camera"]["middle"], up_camera, rtol=0, atol=1e-9)
        np.testing.assert_allclose(truth["up_camera"], up_camera, rtol=0, atol=1e-6)


MOSAIC = """
[camera]
width_px = 640
height_px = 480
fx_px = 950.0
fy_px = 950.0

[sensor]
band = "imx477"
mosaic = "rggb"
"""


def test_stars_are_found_on_a_raw_mosaic(tmp_path: Path) -> None:
    night = exported(tmp_path, MOSAIC + CONFIG[CONFIG.index("[exposure]") :])
    truth = rows(night / "hidden" / "truth.jsonl")[0]
    image = cv2.imread(str(night / "seen" / truth["file"]), cv2.IMREAD_UNCHANGED)
    bright = [star for star in truth["stars"] if star["snr"] > 30 and star["in_frame"] == 1]
    true_px = np.array([(star["centroid_x_px"], star["centroid_y_px"]) for star in bright])

    found_px = solver_adapters.spots(solver_adapters.grey(image))

    # The sky of the colours differs by more than the least signal of a star.
    assert np.ptp([np.median(image[y::2, x::2]) for y in (0, 1) for x in (0, 1)]) > 10
    assert len(found_px) < solver_adapters.MOST_SPOTS / 2  # a checkerboard is thousands of spots
    separation_px = np.linalg.norm(found_px[:, np.newaxis] - true_px, axis=-1).min(axis=0)
    assert max(separation_px) < 0.5


def test_an_image_of_three_channels_is_averaged() -> None:
    image = np.stack([np.full((2, 3), value, np.uint8) for value in (10, 20, 60)], axis=2)

    np.testing.assert_array_equal(solver_adapters.grey(image), np.full((2, 3), 30.0))
    assert solver_adapters.grey(image[..., 0]).dtype == np.uint8


@pytest.mark.skipif(os.name == "nt", reason="the limit is one of POSIX")
@pytest.mark.filterwarnings("ignore:.*use of fork:DeprecationWarning")
def test_a_search_without_end_is_refused_and_a_fault_is_not(capfd: pytest.CaptureFixture[str]) -> None:
    def solve(work: str) -> Row | None:
        while work == "endless":
            pass
        return {"ra_deg": 1 / len(work)}

    answer = solver_adapters.limited(solve, 1)

    assert answer("four") == {"ra_deg": 0.25}
    assert answer("endless") is None
    with pytest.raises(SystemExit, match="failed"):
        answer("")
    assert "ZeroDivisionError" in capfd.readouterr().err


@cache
def interpreter(solver: str) -> str | None:
    """Return a Python that has a solver: this one, or one of those in GLSTAR_SOLVER_PYTHONS."""
    pythons = [sys.executable, *os.environ.get("GLSTAR_SOLVER_PYTHONS", "").split(os.pathsep)]
    program = f"import {MODULES[solver]}, PIL, scipy"
    for python in filter(None, pythons):
        if subprocess.run([python, "-c", program], capture_output=True, check=False).returncode == 0:
            return python
    return None


@pytest.mark.slow
@pytest.mark.parametrize("solver", solver_adapters.SOLVERS)
def test_a_solver_answers_in_the_conventions_of_glstar(solver: str, night: Path, tmp_path: Path) -> None:
    python = interpreter(solver)
    if python is None:
        pytest.skip(f"no Python here has {solver}; GLSTAR_SOLVER_PYTHONS names others")
    if solver == "astrometry" and "ASTROMETRY_INDEXES" not in os.environ:
        pytest.skip("ASTROMETRY_INDEXES names no folder with index files of astrometry.net")
    answers = tmp_path / "answers.jsonl"

    environment = {key: value for key, value in os.environ.items() if key != "PYTHONPATH"}
    command = [python, str(ADAPTERS), solver, str(night / "seen"), str(answers)]
    subprocess.run(command, check=True, capture_output=True, timeout=240, env=environment)
    summary = score(night / "hidden", answers).summary.json

    assert (summary["solved"], summary["false"]) == (4, 0)
    if solver == "zenith-fixer":
        assert summary["position_km"]["median"] < 2
        assert summary["in_ellipse"] >= 3
    else:
        # What refraction and aberration cost is 20"; a pixel is 108".
        assert summary["boresight_arcsec"]["median"] < 40
        assert summary["roll_arcsec"]["median"] < 100
