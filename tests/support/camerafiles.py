"""Camera files as other programs write them, with decoys beside the camera, and the projection that they describe.

Projections are OpenCV's, so that the reader is compared with independent code.
"""

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import cv2
import numpy as np
import yaml
from numpy.typing import NDArray

from glstar.camera.camerafile import camera_from_file
from glstar.errors import CalibrationError

Float = NDArray[np.float64]
Rng = np.random.Generator

# Directions at which projections are compared: up to 30 deg off the axis, and the difference that is allowed, px.
_TANGENTS = np.stack(np.meshgrid(np.linspace(-0.4, 0.4, 5), np.linspace(-0.4, 0.4, 5)), axis=-1).reshape(-1, 2)
_DIRECTIONS = np.column_stack([_TANGENTS, np.ones(len(_TANGENTS))])
_TOLERANCE_PX = 1e-3

FISHEYE_KEYS = (
    ("camera_model", "fisheye"),
    ("cameraModel", "equidistant"),
    ("model", "KANNALA_BRANDT"),
    ("lens_model", "Fisheye"),
    ("lens_type", "fisheye"),
    ("lens", "fish-eye"),
    ("projection", "equidistant"),
    ("projection_model", "kannala_brandt"),
    ("distortion_type", "equi"),
    ("distortion_model", "opencv_fisheye"),
    ("model_type", "KannalaBrandt8"),
    ("camera_type", "fisheye"),
    ("type", "OPENCV_FISHEYE"),
    ("fisheye", True),
    ("is_fisheye", 1),
    ("use_fisheye", "true"),
    ("fisheye_model", 1),
)
LACKING = ("ucm", "fov", "SCARAMUZZA", "thin_prism_fisheye", "ftheta", "SIMPLE_RADIAL_FISHEYE")


@dataclass(frozen=True, eq=False)
class TrueCamera:
    """A camera by OpenCV's numbers: `model` is plumb_bob, rational or fisheye."""

    width_px: int
    height_px: int
    K: Float
    model: str
    D: tuple[float, ...]

    @classmethod
    def random(cls, rng: Rng, model: str | None = None) -> "TrueCamera":
        """Return a camera of some lens, with numbers as calibrations have them."""
        width_px, height_px = ((1280, 960), (752, 480), (1014, 760), (1920, 1200))[rng.integers(4)]
        f_px = width_px * rng.uniform(0.5, 1.5)
        centre = np.array([width_px, height_px]) / 2 + rng.normal(0, 8, 2)
        K = np.array([[f_px, 0, centre[0]], [0, f_px * rng.uniform(0.99, 1.01), centre[1]], [0, 0, 1]])
        model = model or ("plumb_bob", "rational", "fisheye")[rng.integers(3)]
        plumb_bob = (*rng.normal([-0.2, 0.05], [0.1, 0.02]), *rng.normal(0, 1e-3, 2), rng.normal(0, 0.01))
        if model == "plumb_bob":
            D = plumb_bob[: rng.choice([4, 5])]
        elif model == "rational":
            D = (*plumb_bob, *rng.normal([0.1, 0.02, 0.001], [0.02, 0.005, 0.001]))
        else:
            D = tuple(rng.normal([-0.03, 0.005, -0.003, 0.0005], 0.01))
        return cls(width_px, height_px, np.round(K, 4), model, tuple(float(f"{number:.6g}") for number in D))

    def project(self, directions: Float) -> Float:
        """Return the pixels of directions by OpenCV, (n, 2)."""
        still, D = np.zeros(3), np.array(self.D)
        if self.model == "fisheye":
            return np.asarray(cv2.fisheye.projectPoints(directions[:, np.newaxis], still, still, self.K, D)[0][:, 0])
        return np.asarray(cv2.projectPoints(directions, still, still, self.K, D)[0][:, 0])


@dataclass(eq=False)
class CameraCase:
    """A camera file of a stranger: what it describes, and whether glstar may refuse it."""

    what: str
    truth: TrueCamera | None  # None if it describes a camera that glstar cannot have
    content: bytes
    suffix: str = ".yaml"
    may_refuse: bool = False
    name: str | None = None


def verdict(case: CameraCase) -> str:
    """Return ``"right"`` or ``"refused"``, or a line on what is wrong."""
    with TemporaryDirectory() as folder:
        path = Path(folder) / f"camera{case.suffix}"
        path.write_bytes(case.content)
        try:
            camera = camera_from_file(path, case.name)
        except CalibrationError as error:
            is_allowed = case.may_refuse or case.truth is None
            return "refused" if is_allowed and "\n" not in str(error) else f"{case.what}: refused: {error}"
    if case.truth is None:
        return f"{case.what}: read as {camera}"
    off_px = float(np.abs(camera.project(_DIRECTIONS) - case.truth.project(_DIRECTIONS)).max())
    size = camera.width_px, camera.height_px
    if not off_px < _TOLERANCE_PX or size != (case.truth.width_px, case.truth.height_px):
        return f"{case.what}: off by {off_px:.3g} px, {size}: {camera}"
    return "right"


# --- dialects ---------------------------------------------------------------------------------------------------------

Writer = Callable[[Rng, TrueCamera, dict[str, Any]], CameraCase]
_ROS_MODEL = {"plumb_bob": "plumb_bob", "rational": "rational_polynomial", "fisheye": "equidistant"}
_KALIBR_MODEL = {"plumb_bob": "radtan", "fisheye": "equidistant"}


def _as_yaml(keys: dict[str, Any], head: str = "") -> bytes:
    return (head + yaml.safe_dump(keys, sort_keys=False)).encode()


def opencv(rng: Rng, truth: TrueCamera, extra: dict[str, Any]) -> CameraCase:
    """Return a file of OpenCV's own FileStorage, with the names of its sample, its tool and of others."""
    suffix = (".yml", ".json", ".xml")[rng.integers(3)]
    matrix, lens = (("camera_matrix", "distortion_coefficients"), ("cameraMatrix", "dist_coeffs"), ("K", "D"))[
        rng.integers(3)
    ]
    D = np.array(truth.D)
    with TemporaryDirectory() as folder:
        path = Path(folder) / f"camera{suffix}"
        storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
        storage.write("calibration_time", "Sun 10 Mar 2024 11:00:00")
        storage.write("image_width", truth.width_px)
        storage.write("image_height", truth.height_px)
        storage.write("board_width", 9)
        storage.write("board_height", 6)
        storage.write(f"{matrix}_std_dev", np.array([[0.5, 0.5, 0.8, 0.7]]).T)
        storage.write(matrix, truth.K)
        storage.write(f"{lens}_std_dev", rng.uniform(0, 0.1, (len(D), 1)))
        storage.write(lens, D[np.newaxis] if rng.random() < 0.5 else D[:, np.newaxis])
        storage.write("avg_reprojection_error", 0.31)
        storage.write("image_points", np.zeros((2, 5, 2), np.float32))
        if truth.model == "fisheye" and not extra:
            storage.write("fisheye_model", 1)
        for key, value in extra.items():
            storage.write(key, int(value) if isinstance(value, bool) else value)
        storage.release()
        return CameraCase(f"OpenCV {suffix} {matrix}", truth, path.read_bytes(), suffix)


def ros(rng: Rng, truth: TrueCamera, extra: dict[str, Any]) -> CameraCase:
    """Return camera_info as camera_calibration writes it, with the matrices of the rectified image."""
    rectified = truth.K * [[0.9], [0.9], [1.0]]
    P = np.column_stack([rectified, np.zeros(3)])

    def matrix(values: Float) -> Any:
        return {"rows": len(values), "cols": values.shape[1], "data": values.ravel().tolist()}

    keys = {
        "image_width": truth.width_px,
        "image_height": truth.height_px,
        "camera_name": ("narrow_stereo", "front")[rng.integers(2)],
        "camera_matrix": matrix(truth.K),
        "distortion_model": _ROS_MODEL[truth.model],
        "distortion_coefficients": matrix(np.array([truth.D])),
        "rectification_matrix": matrix(np.eye(3)),
        "projection_matrix": matrix(P),
        **extra,
    }
    return CameraCase("ROS camera_info", truth, _as_yaml(keys))


def ros_topic(rng: Rng, truth: TrueCamera, extra: dict[str, Any]) -> CameraCase:
    """Return some messages of a CameraInfo topic, of ROS 1 (K) or ROS 2 (k)."""
    case = str.upper if rng.random() < 0.5 else str.lower
    roi = {"x_offset": 0, "y_offset": 0, "height": 0, "width": 0, "do_rectify": False}
    keys = {
        "header": {"stamp": {"sec": 1710068400, "nanosec": 0}, "frame_id": "camera"},
        "height": truth.height_px,
        "width": truth.width_px,
        "distortion_model": _ROS_MODEL[truth.model],
        case("d"): list(truth.D),
        case("k"): truth.K.ravel().tolist(),
        case("r"): np.eye(3).ravel().tolist(),
        case("p"): np.column_stack([truth.K * 0.9, np.zeros(3)]).ravel().tolist(),
        "binning_x": 0,
        "binning_y": 0,
        "roi": roi,
        **extra,
    }
    message = _as_yaml(keys) + b"---\n"
    return CameraCase("ROS topic", truth, message * int(rng.integers(1, 4)))


def kalibr(rng: Rng, truth: TrueCamera, extra: dict[str, Any]) -> CameraCase:
    """Return a camchain of one or two cameras, as Kalibr and OpenVINS have them."""
    entry = {
        "T_cam_imu": np.eye(4).tolist(),
        "cam_overlaps": [1],
        "camera_model": "pinhole",
        "distortion_coeffs": list(truth.D),
        "distortion_model": _KALIBR_MODEL[truth.model],
        "intrinsics": _four(truth),
        "resolution": [truth.width_px, truth.height_px],
        "rostopic": "/cam0/image_raw",
        "timeshift_cam_imu": 0.001,
        **extra,
    }
    chain: dict[str, Any] = {"cam0": entry}
    name = None
    if rng.random() < 0.5:
        other = {**entry, "intrinsics": [400.0, 400.0, 300.0, 200.0], "distortion_coeffs": [0.1, 0.1, 0.0, 0.0]}
        chain, name = (
            ({"cam0": other, "cam1": entry}, "cam1") if rng.random() < 0.5 else ({**chain, "cam1": other}, "cam0")
        )
    return CameraCase("Kalibr", truth, _as_yaml(chain, "%YAML:1.0\n" if rng.random() < 0.5 else ""), name=name)


def euroc(_rng: Rng, truth: TrueCamera, extra: dict[str, Any]) -> CameraCase:
    """Return a sensor.yaml of the EuRoC layout."""
    keys = {
        "sensor_type": "camera",
        "comment": "VI-Sensor cam0 (MT9M034)",
        "T_BS": {"cols": 4, "rows": 4, "data": np.eye(4).ravel().tolist()},
        "rate_hz": 20,
        "resolution": [truth.width_px, truth.height_px],
        "camera_model": "pinhole",
        "intrinsics": _four(truth),
        "distortion_model": {"plumb_bob": "radial-tangential", "fisheye": "equidistant"}[truth.model],
        "distortion_coefficients": list(truth.D),
        **extra,
    }
    return CameraCase("EuRoC", truth, _as_yaml(keys))


def vins(_rng: Rng, truth: TrueCamera, extra: dict[str, Any]) -> CameraCase:
    """Return a file of camodocal, which VINS-Fusion reads."""
    fx, fy, cx, cy = _four(truth)
    if truth.model == "fisheye":
        names = dict(zip(("k2", "k3", "k4", "k5"), truth.D, strict=True))
        projection = {**names, "mu": fx, "mv": fy, "u0": cx, "v0": cy}
        keys: dict[str, Any] = {"model_type": "KANNALA_BRANDT", "projection_parameters": projection}
    else:
        names = dict(zip(("k1", "k2", "p1", "p2"), truth.D, strict=False))
        keys = {"model_type": "PINHOLE", "distortion_parameters": names}
        keys["projection_parameters"] = {"fx": fx, "fy": fy, "cx": cx, "cy": cy}
    keys |= {"camera_name": "camera", "image_width": truth.width_px, "image_height": truth.height_px, **extra}
    return CameraCase("VINS", truth, _as_yaml(keys, "%YAML:1.0\n---\n"))


def orb_slam(rng: Rng, truth: TrueCamera, extra: dict[str, Any]) -> CameraCase:
    """Return settings of ORB-SLAM3, with another camera beside the first one or without."""
    names = ("k1", "k2", "k3", "k4") if truth.model == "fisheye" else ("k1", "k2", "p1", "p2", "k3")
    numbers = dict(zip(("fx", "fy", "cx", "cy", *names), (*_four(truth), *truth.D), strict=False))
    keys: dict[str, Any] = {
        "File.version": "1.0",
        "Camera.type": "KannalaBrandt8" if truth.model == "fisheye" else "PinHole",
        **{f"Camera1.{key}": value for key, value in numbers.items()},
        "Camera.width": truth.width_px,
        "Camera.height": truth.height_px,
        "Camera.newWidth": 600,
        "Camera.newHeight": 350,
        "Camera.fps": 20,
        "Camera.RGB": 1,
        "ORBextractor.nFeatures": 1200,
    }
    name = None
    if rng.random() < 0.5:
        other = dict(zip(("fx", "fy", "cx", "cy"), (400.0, 400.0, 300.0, 200.0), strict=True))
        keys |= {f"Camera2.{key}": value for key, value in other.items()}
        name = "Camera1"
    return CameraCase("ORB-SLAM3", truth, _as_yaml({**keys, **extra}, "%YAML:1.0\n"), name=name)


def orb_slam_stereo(_rng: Rng, truth: TrueCamera, extra: dict[str, Any]) -> CameraCase:
    """Return settings of ORB-SLAM2 for stereo: LEFT is the camera, and Camera that of the rectified images."""

    def matrix(values: Float) -> Any:
        return {"rows": len(values), "cols": values.shape[1], "dt": "d", "data": values.ravel().tolist()}

    keys = {
        f"Camera.{key}": value
        for key, value in zip(("fx", "fy", "cx", "cy"), (435.2, 435.2, 367.4, 252.2), strict=True)
    }
    keys |= {"Camera.k1": 0.0, "Camera.k2": 0.0, "Camera.width": truth.width_px, "Camera.height": truth.height_px}
    for side, K in (("LEFT", truth.K), ("RIGHT", truth.K * 0.95 + 0.05 * np.diag([0, 0, 1.0]))):
        keys |= {f"{side}.height": truth.height_px, f"{side}.width": truth.width_px}
        keys |= {f"{side}.D": matrix(np.array([truth.D])), f"{side}.K": matrix(K), f"{side}.R": matrix(np.eye(3))}
        keys[f"{side}.P"] = matrix(np.column_stack([truth.K * 0.9, np.zeros(3)]))
    return CameraCase("ORB-SLAM2 stereo", truth, _as_yaml({**keys, **extra}), name="LEFT")


def plain(rng: Rng, truth: TrueCamera, extra: dict[str, Any]) -> CameraCase:
    """Return a file that somebody's script dumped from the arrays of cv2.calibrateCamera."""
    matrix = ("K", "mtx", "camera_matrix", "intrinsic_matrix")[rng.integers(4)]
    lens = ("dist", "D", "dist_coeffs", "distCoeffs", "distortion")[rng.integers(5)]
    keys: dict[str, Any] = {matrix: truth.K.tolist(), lens: [list(truth.D)] if rng.random() < 0.5 else list(truth.D)}
    if rng.random() < 0.5:
        keys["image_size"] = [truth.width_px, truth.height_px]
    else:
        keys |= {"width": truth.width_px, "height": truth.height_px}
    if truth.model == "fisheye" and not extra:
        keys["model"] = "fisheye"
    keys |= {"rms": 0.3, "newcameramtx": (truth.K * 0.9).tolist(), "undistorted_camera_matrix": truth.K.tolist()}
    return CameraCase("a script's", truth, _as_yaml({**keys, **extra}))


def _four(truth: TrueCamera) -> list[float]:
    return [float(truth.K[at]) for at in ((0, 0), (1, 1), (0, 2), (1, 2))]


# The dialects, and the lens models that each has.
DIALECTS: dict[Writer, tuple[str, ...]] = {
    opencv: ("plumb_bob", "rational", "fisheye"),
    ros: ("plumb_bob", "rational", "fisheye"),
    ros_topic: ("plumb_bob", "rational", "fisheye"),
    kalibr: ("plumb_bob4", "fisheye"),
    euroc: ("plumb_bob4", "fisheye"),
    vins: ("plumb_bob4", "fisheye"),
    orb_slam: ("plumb_bob", "fisheye"),
    orb_slam_stereo: ("plumb_bob",),
    plain: ("plumb_bob", "rational", "fisheye"),
}


def _camera_of(rng: Rng, models: tuple[str, ...]) -> TrueCamera:
    model = models[rng.integers(len(models))]
    truth = TrueCamera.random(rng, model.removesuffix("4"))
    return TrueCamera(truth.width_px, truth.height_px, truth.K, truth.model, truth.D[:4]) if model[-1] == "4" else truth


# --- what strangers' files have beside the camera ---------------------------------------------------------------------


@dataclass
class _Trap:
    """Keys that a reader may not pass over: the file then describes another camera, or none that glstar has."""

    what: str
    keys: dict[str, Any]
    describes: str = "nothing"  # "the camera", or "nothing" that glstar can have
    writers: tuple[Writer, ...] = field(default=(opencv, ros, ros_topic, plain))


def _traps(rng: Rng, truth: TrueCamera) -> list[_Trap]:
    other = [float(f"{number + rng.normal(0, 0.05):.5g}") for number in truth.D]
    half = [truth.width_px // 2, truth.height_px // 2]
    lacking = str(rng.choice(LACKING))
    yaml_only = (ros, ros_topic, plain)
    window = {"x_offset": 100, "y_offset": 0, "width": half[0], "height": half[1]}
    rectified = {"rectified_distortion": [0.0] * 5, "R1": [1.0] * 9, "P1": [1.0] * 12}
    return [
        _Trap("a second lens", {"lens_distortion_coefficients": other}, writers=yaml_only),
        _Trap("the lens of another camera", {"distortion_coefficients_right": other}, "the camera", yaml_only),
        _Trap("an unknown key of the lens", {"radial_distortion": other}, writers=yaml_only),
        _Trap("another size", {"resolution": half}, writers=yaml_only),
        _Trap("another matrix", {"intrinsics": [300.0, 300.0, 200.0, 150.0]}, writers=yaml_only),
        _Trap("a lens that glstar lacks", {"camera_model": lacking}),
        _Trap("a lens that glstar lacks", {"lens_model": lacking}),
        _Trap("a mirror", {"xi": 1.2}, writers=(ros, ros_topic)),
        _Trap(
            "a window",
            {"roi": window},
            writers=yaml_only,
        ),
        _Trap("binning", {"binning_x": 2, "binning_y": 2}, writers=yaml_only),
        _Trap("a coefficient of its own", {"k1": 0.4321}),
        _Trap("a seventh coefficient", {"k7": 0.4321}),
        _Trap("no distortion", {"distortion_model": "none"}, writers=(plain, ros, ros_topic)),
        _Trap("standard errors", {"distCoeffsStdDev": other, "sigma_K": [1.0] * 9}, "the camera", yaml_only),
        _Trap("rectified", rectified, "the camera", yaml_only),
    ]


def random_case(rng: Rng) -> CameraCase:
    """Return a file of some dialect: as it is, with a fisheye named by some key, with a trap, or normalized."""
    kind = rng.random()
    if kind < 0.5:
        writer = list(DIALECTS)[rng.integers(len(DIALECTS))]
        return writer(rng, _camera_of(rng, DIALECTS[writer]), {})
    if kind < 0.7:
        key, value = FISHEYE_KEYS[rng.integers(len(FISHEYE_KEYS))]
        case = (opencv, plain)[rng.integers(2)](rng, TrueCamera.random(rng, "fisheye"), {key: value})
        case.what += f", fisheye by {key}: {value}"
        return case
    if kind < 0.75:
        return _without_pixels(rng)
    if kind < 0.8:
        case = plain(rng, TrueCamera.random(rng, "plumb_bob"), {})
        case.content += b"---\n" + plain(rng, TrueCamera.random(rng, "plumb_bob"), {}).content
        case.truth, case.what = None, "two documents"
        return case
    truth = TrueCamera.random(rng)
    traps = _traps(rng, truth)
    trap = traps[rng.integers(len(traps))]
    keys = dict(trap.keys)
    if truth.model == "fisheye" and not {"model", "distortion_model", "camera_model", "lens_model"} & set(keys):
        keys["model"] = "fisheye"
    case = trap.writers[rng.integers(len(trap.writers))](rng, truth, keys)
    case.what += f", {trap.what}: {list(trap.keys)}"
    case.may_refuse = True
    case.truth = truth if trap.describes == "the camera" else None
    return case


def _without_pixels(rng: Rng) -> CameraCase:
    """Return a file whose matrix is in units of the image's width, or in mm."""
    truth = TrueCamera.random(rng, "plumb_bob")
    scale = np.diag([rng.choice([1 / truth.width_px, 0.003]), rng.choice([1 / truth.width_px, 0.003]), 1.0])
    case = plain(rng, TrueCamera(truth.width_px, truth.height_px, scale @ truth.K, truth.model, truth.D), {})
    case.truth, case.what = None, "not in pixels"
    return case
