"""Lenses up to the whole sphere, against OpenCV's omnidir and the formulas of the papers, and their files."""

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from glstar.camera.camerafile import camera_from_file, read_camera_file
from glstar.camera.distortion import Lens
from glstar.camera.model import Camera
from glstar.errors import CalibrationError

Float = NDArray[np.float64]

DOUBLE_SPHERE = Lens("double_sphere", (-0.172, 0.593))  # of a camera of 195 deg, TUM VI
EUCM = Lens("eucm", (0.58, 1.08))
OMNI = Lens("omni", (1.25, -0.1, 0.02, 1e-3, -2e-3))
BARREL_OMNI = Lens("omni", (0.8, -0.34, 0.13, 5e-4, 6e-4))


def camera_with(lens: Lens, f_px: float = 190.0) -> Camera:
    return Camera(752, 480, f_px, 1.01 * f_px, 380.5, 236.25, lens=lens)


def directions_within(limit_rad: float) -> Float:
    """Return a grid of unit vectors up to just within an angle off the axis."""
    theta, azimuth = np.meshgrid(np.linspace(0.0, 0.999 * limit_rad, 61), np.linspace(0.0, 2 * np.pi, 37))
    across = np.sin(theta)
    return np.stack([across * np.cos(azimuth), across * np.sin(azimuth), np.cos(theta)], axis=-1).reshape(-1, 3)


def by_paper(lens: Lens, direction: Float) -> Float:
    """Return points in the image plane as the papers write them, with vectors of any length, (n, 2)."""
    x, y, z = direction.T
    if lens.model == "double_sphere":  # Usenko et al. 2018, eqs (40) to (42)
        xi, alpha = lens.coefficients
        d1 = np.sqrt(x**2 + y**2 + z**2)
        d2 = np.sqrt(x**2 + y**2 + (xi * d1 + z) ** 2)
        depth = alpha * d2 + (1 - alpha) * (xi * d1 + z)
    elif lens.model == "eucm":  # Khomutenko et al. 2016, eq. (6)
        alpha, beta = lens.coefficients
        depth = alpha * np.sqrt(beta * (x**2 + y**2) + z**2) + (1 - alpha) * z
    else:  # Mei & Rives 2007
        depth = z + lens.coefficients[0] * np.sqrt(x**2 + y**2 + z**2)
    return np.column_stack([x / depth, y / depth])


def random_lens(random: np.random.Generator) -> Lens:
    """Return a lens of one of the papers' models without a second step."""
    model = random.choice(["double_sphere", "eucm", "omni"])
    if model == "double_sphere":
        return Lens("double_sphere", (random.uniform(-0.9, 0.9), random.uniform(0.0, 1.0)))
    if model == "eucm":
        return Lens("eucm", (random.uniform(0.0, 1.0), random.uniform(0.3, 3.0)))
    return Lens("omni", (random.uniform(-0.5, 3.0),))


@pytest.mark.parametrize("seed", range(40))
def test_a_random_lens_projects_by_the_formula_of_its_paper_and_back(seed: int) -> None:
    random = np.random.default_rng(seed)
    lens = random_lens(random)
    camera = camera_with(lens, random.uniform(100, 900))
    seen = directions_within(lens.limit_rad)
    # Up to 20 focal lengths from the axis, where a lens is finite.
    points = by_paper(lens, seen)
    near = np.hypot(*points.T) < 20
    seen, points = seen[near], points[near]
    assert near.mean() > 0.5

    xy_px = camera.project(seen * random.uniform(0.1, 10.0, (len(seen), 1)))

    expected = points * [camera.fx_px, camera.fy_px] + [380.5, 236.25]
    np.testing.assert_allclose(xy_px, expected, rtol=1e-12, atol=1e-9)
    np.testing.assert_allclose(camera.unit_vectors(expected), seen, rtol=0, atol=1e-9)


@pytest.mark.parametrize("lens", [OMNI, BARREL_OMNI, Lens("omni", (0.0, -0.2, 0.05, 1e-3, 0.0))], ids=str)
def test_an_omnidirectional_lens_projects_as_opencv_does(lens: Lens) -> None:
    camera = camera_with(lens)
    seen = directions_within(lens.limit_rad)
    still = np.zeros(3)
    D = np.array(lens.coefficients[1:])
    expected, _ = cv2.omnidir.projectPoints(seen[np.newaxis], still, still, camera.K, lens.coefficients[0], D)

    np.testing.assert_allclose(camera.project(seen), expected.reshape(-1, 2), rtol=1e-12, atol=1e-9)
    inside = seen[seen[:, 2] > np.cos(0.97 * lens.limit_rad)]
    np.testing.assert_allclose(camera.unit_vectors(camera.project(inside)), inside, rtol=0, atol=1e-9)


@pytest.mark.parametrize("lens", [DOUBLE_SPHERE, EUCM, OMNI, BARREL_OMNI], ids=str)
def test_rates_behind_a_wide_lens_are_the_derivatives_of_positions(lens: Lens) -> None:
    camera, random = camera_with(lens), np.random.default_rng(4)
    seen = directions_within(0.95 * lens.limit_rad)
    rate, step = random.normal(size=seen.shape), 1e-6

    xy_px, rate_px = camera.project_with_rates(seen, rate)

    np.testing.assert_array_equal(xy_px, camera.project(seen))
    central = (camera.project(seen + step * rate) - camera.project(seen - step * rate)) / (2 * step)
    np.testing.assert_allclose(rate_px, central, rtol=1e-6, atol=1e-4)


@given(st.integers(0, 10_000), st.floats(0.0, np.pi), st.floats(-np.pi, np.pi))
def test_no_two_directions_have_one_position(seed: int, theta: float, azimuth: float) -> None:
    """Up to the limit the radius grows; beyond it no direction has a position."""
    lens = random_lens(np.random.default_rng(seed))
    camera = camera_with(lens)
    direction = np.array([np.sin(theta) * np.cos(azimuth), np.sin(theta) * np.sin(azimuth), np.cos(theta)])
    xy_px = camera.project(direction)
    if theta > lens.limit_rad + 1e-3:
        assert np.isnan(xy_px).all()
    elif theta < 0.98 * lens.limit_rad and np.abs(xy_px).max() < 1e5:
        np.testing.assert_allclose(camera.unit_vectors(xy_px), direction, rtol=0, atol=1e-8)


@pytest.mark.parametrize(
    "lens",
    [
        Lens("double_sphere", (0.5, 0.7)),
        Lens("double_sphere", (-0.3, 0.8)),
        Lens("double_sphere", (1.6, 0.3)),
        Lens("eucm", (0.7, 1.2)),
        OMNI,
    ],
    ids=str,
)
def test_a_lens_ends_where_its_radius_turns(lens: Lens) -> None:
    limit, step = lens.limit_rad, 1e-4
    theta = limit + np.array([-2.0, -1.0, 1.0, 2.0]) * step
    r = np.hypot(*by_paper(lens, np.column_stack([np.sin(theta), 0 * theta, np.cos(theta)])).T)
    if lens is not OMNI:  # its second step turns first
        assert r[0] < r[1] > r[3]
        assert r[1] == pytest.approx(r[2], rel=1e-6)
    assert np.isfinite(lens.radius(limit - step))
    assert np.isnan(lens.radius(limit + step))


@pytest.mark.parametrize(
    ("model", "coefficients", "words"),
    [
        ("double_sphere", (0.1, 1.2), "the lens has alpha = 1.2; alpha of double_sphere is from 0 to 1"),
        ("double_sphere", (-1.0, 0.5), "the lens has xi = -1; xi of double_sphere is above -1"),
        ("double_sphere", (0.1,), "1 coefficients are too few for double_sphere: xi, alpha"),
        ("eucm", (0.5, 0.0), "the lens has beta = 0; beta of eucm is positive"),
        ("omni", (), "0 coefficients are too few for omni: xi"),
        ("omni", (1.0, 0.0, 0.0, 0.0, 0.0, 0.1), "6 distortion coefficients are too many for omni: xi, k1, k2, p1, p2"),
    ],
)
def test_coefficients_without_a_meaning_are_refused(model, coefficients, words: str) -> None:
    with pytest.raises(CalibrationError, match=words):
        Lens(model, coefficients)


# --- files ------------------------------------------------------------------------------------------------------------


def kalibr(model: str, intrinsics: list[float], distortion: str, coefficients: list[float]) -> str:
    return (
        f"cam0:\n  camera_model: {model}\n  intrinsics: {intrinsics}\n  distortion_model: {distortion}\n"
        f"  distortion_coeffs: {coefficients}\n  resolution: [752, 480]\n  rostopic: /cam0/image_raw\n"
    )


@pytest.mark.parametrize(
    ("text", "lens"),
    [
        (
            kalibr("omni", [0.8, 190.0, 191.9, 380.5, 236.25], "radtan", [-0.34, 0.13, 5e-4, 6e-4]),
            BARREL_OMNI,
        ),
        (kalibr("omni", [0.8, 190.0, 191.9, 380.5, 236.25], "none", []), Lens("omni", (0.8,))),
        (kalibr("ds", [-0.172, 0.593, 190.0, 191.9, 380.5, 236.25], "none", []), DOUBLE_SPHERE),
        (kalibr("eucm", [0.58, 1.08, 190.0, 191.9, 380.5, 236.25], "none", []), EUCM),
        (
            "%YAML:1.0\n---\nmodel_type: MEI\ncamera_name: camera\nimage_width: 752\nimage_height: 480\n"
            "mirror_parameters:\n   xi: 0.8\ndistortion_parameters:\n   k1: -0.34\n   k2: 0.13\n   p1: 0.0005\n"
            "   p2: 0.0006\nprojection_parameters:\n   gamma1: 190.0\n   gamma2: 191.9\n   u0: 380.5\n   v0: 236.25\n",
            BARREL_OMNI,
        ),
    ],
    ids=["omni-radtan", "omni-none", "ds", "eucm", "camodocal"],
)
def test_a_camera_of_kalibr_or_camodocal_is_read(tmp_path: Path, text: str, lens: Lens) -> None:
    path = tmp_path / "camera.yaml"
    path.write_text(text, encoding="utf-8")

    assert camera_from_file(path) == camera_with(lens)


@pytest.mark.parametrize("suffix", [".yml", ".xml"])
def test_a_file_of_the_sample_of_opencv_s_omnidir_is_read(tmp_path: Path, suffix: str) -> None:
    camera = camera_with(BARREL_OMNI)
    path = tmp_path / f"out_camera_params{suffix}"
    storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
    storage.write("calibration_time", "Sun 10 Mar 2024 11:00:00")
    storage.write("image_width", 752)
    storage.write("image_height", 480)
    storage.write("flags", 0)
    storage.write("camera_matrix", camera.K)
    storage.write("distortion_coefficients", np.array([BARREL_OMNI.coefficients[1:]]))
    storage.write("xi", 0.8)
    storage.write("rms", 0.21)
    storage.release()

    found = read_camera_file(path)

    assert found.camera == camera
    assert found.notes == ("xi is not 0 and no key names the model: omni is assumed, OpenCV's omnidir",)


def basalt(*cameras: tuple[str, dict[str, float]]) -> str:
    intrinsics = [
        {"camera_type": kind, "intrinsics": {"fx": 190.0, "fy": 191.9, "cx": 380.5, "cy": 236.25} | numbers}
        for kind, numbers in cameras
    ]
    return json.dumps(
        {
            "value0": {
                "T_imu_cam": [{"px": 0.0, "qw": 1.0}] * len(cameras),
                "intrinsics": intrinsics,
                "resolution": [[752, 480]] * len(cameras),
                "calib_accel_bias": [0.0] * 9,
                "cam_time_offset_ns": 0,
            }
        }
    )


@pytest.mark.parametrize(
    ("kind", "numbers", "lens"),
    [
        ("ds", {"xi": -0.172, "alpha": 0.593}, DOUBLE_SPHERE),
        ("eucm", {"alpha": 0.58, "beta": 1.08}, EUCM),
        ("ucm", {"alpha": 0.58}, Lens("eucm", (0.58, 1.0))),
        ("kb4", {"k1": -0.02, "k2": 0.003, "k3": -0.001, "k4": 2e-4}, Lens("fisheye", (-0.02, 0.003, -0.001, 2e-4))),
        ("pinhole", {}, None),
    ],
)
def test_a_camera_of_basalt_is_read(tmp_path: Path, kind: str, numbers: dict[str, float], lens: Lens | None) -> None:
    path = tmp_path / "calibration.json"
    path.write_text(basalt((kind, numbers)), encoding="utf-8")

    assert camera_from_file(path) == Camera(752, 480, 190.0, 191.9, 380.5, 236.25, lens=lens)


def test_one_camera_of_basalt_is_chosen_by_its_number(tmp_path: Path) -> None:
    path = tmp_path / "calibration.json"
    path.write_text(basalt(("pinhole", {}), ("ds", {"xi": -0.172, "alpha": 0.593})), encoding="utf-8")

    assert camera_from_file(path, "cam1").lens == DOUBLE_SPHERE
    with pytest.raises(CalibrationError, match=r"holds 2 cameras \(cam0, cam1\)"):
        camera_from_file(path)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        (kalibr("ds", [-0.2, 0.6, 190.0, 190.0, 380.5, 236.0], "radtan", [0.1, 0.0, 0.0, 0.0]), "a double_sphere lens"),
        (kalibr("omni", [0.8, 190.0, 190.0, 380.5, 236.0], "equidistant", [0.1, 0.0, 0.0, 0.0]), "contradict"),
        (kalibr("pinhole", [0.8, 190.0, 190.0, 380.5, 236.0], "radtan", [0.1, 0.0, 0.0, 0.0]), "a pinhole has 4"),
        (basalt(("fov", {"w": 0.9})), "has a lens of the model fov"),
        ('{"value0": {"intrinsics": 3}}', "has value0, as Basalt's files, without intrinsics"),
    ],
    ids=["ds-radtan", "omni-equidistant", "pinhole of five", "basalt fov", "basalt"],
)
def test_a_file_that_contradicts_itself_is_refused(tmp_path: Path, text: str, words: str) -> None:
    path = tmp_path / "camera.yaml"
    path.write_text(text, encoding="utf-8")

    with pytest.raises(CalibrationError, match=words):
        camera_from_file(path)
