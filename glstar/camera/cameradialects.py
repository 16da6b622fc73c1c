"""Cameras in the dialects of YAML that `glstar.camera.camerafile` lists."""

import re
from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from glstar.camera.distortion import COEFFICIENTS, Lens, LensModel
from glstar.camera.model import Camera
from glstar.camera.yamlvalues import (
    DIALECTS,
    Keys,
    abbreviated,
    kind_of,
    label,
    normalized,
    read_integer,
    read_matrix,
    read_number,
    read_numbers,
)
from glstar.errors import CalibrationError

__all__ = ["camera_from_keys"]

# Common names of the same key, normalized: lower case, without underscores, hyphens and spaces.
_MATRIX = ("cameramatrix", "k", "intrinsicmatrix", "intrinsics", "mtx")
_WIDTH, _HEIGHT = ("imagewidth", "width", "imgwidth"), ("imageheight", "height", "imgheight")
_SIZE = ("imagesize", "resolution", "imgsize")

# Names of lens models in OpenCV, ROS and Kalibr files.  None: the number of coefficients decides, as in OpenCV's files.
_MODELS: Mapping[str, LensModel | None] = {
    "": None,
    "none": None,
    "plumbbob": "plumb_bob",
    "radtan": "plumb_bob",
    "radialtangential": "plumb_bob",
    "pinhole": "plumb_bob",
    "rationalpolynomial": "rational",
    "rational": "rational",
    "thinprism": "rational",
    "equidistant": "fisheye",
    "fisheye": "fisheye",
    "kannalabrandt": "fisheye",
    "kannalabrandt4": "fisheye",
    "kannalabrandt8": "fisheye",
}


def _key_of_another_file(keys: Keys) -> str:
    """Return the first key of a file that is not a camera file, unless it may be private text."""
    first = str(next(iter(keys), ""))
    return f"its first key is {first}" if re.fullmatch(r"[A-Za-z][\w.-]{0,39}", first) else "its keys are other ones"


def camera_from_keys(keys: Keys, name: str | None) -> Camera:
    """Return the only camera of a file, or the one with the given name."""
    chain = [key for key in keys if isinstance(key, str) and re.fullmatch(r"cam\d+", key)]
    orb_slam = sorted({found[1] for key in keys if (found := re.fullmatch(r"(Camera\d?)\.fx", str(key)))})
    if chain:
        return _kalibr(keys, _chosen(chain, name))
    if orb_slam:
        return _orb_slam(keys, _chosen(orb_slam, name))
    if name is not None:
        raise CalibrationError(f"holds one camera, and none named {label(name)}")
    return _camodocal(keys) if "projection_parameters" in keys else _opencv_or_ros(keys)


def _opencv_or_ros(keys: Keys) -> Camera:
    entries = {normalized(key): (str(key), value) for key, value in keys.items()}
    found = next((entries[name] for name in _MATRIX if name in entries), None)
    if found is None:
        raise CalibrationError(
            f"has no camera matrix under any name that glstar knows; it reads {DIALECTS}, and here"
            f" {_key_of_another_file(keys)}"
        )
    _refuse_binning(entries)
    lens = _lens(entries)
    width_px, height_px = _size(entries)
    return replace(_camera(width_px, height_px, *found), lens=lens)


def _chosen(names: list[str], name: str | None) -> str:
    """Return the name of the camera to read."""
    if name is not None and name not in names:
        raise CalibrationError(f"holds {', '.join(names)}, and no camera named {label(name)}")
    if name is None and len(names) > 1:
        raise CalibrationError(
            f'holds {len(names)} cameras ({", ".join(names)}); in a config, set camera = "{names[0]}" beside file; or'
            f" write one to a file of its own: glstar camera show FILE --camera {names[0]} -o {names[0]}.yaml"
        )
    return name or names[0]


def _orb_slam(keys: Keys, name: str) -> Camera:
    """Return a camera of ORB-SLAM2 or ORB-SLAM3, with keys such as ``Camera.fx`` and ``Camera1.k1``."""
    own = {
        normalized(str(key).partition(".")[2]): (str(key), keys[key]) for key in keys if str(key).startswith(f"{name}.")
    }
    shared = {
        normalized(str(key).partition(".")[2]): (str(key), keys[key]) for key in keys if str(key).startswith("Camera.")
    }
    return _by_name(shared | own, label(shared.get("type", ("", "PinHole"))[1]))


def _camodocal(keys: Keys) -> Camera:
    """Return a camera in the format of camodocal, which VINS-Fusion and its relatives use."""
    model = label(keys.get("model_type", "PINHOLE"))
    entries = {normalized(key): (str(key), value) for key, value in keys.items()}
    for group in ("projection_parameters", "distortion_parameters"):
        section = keys.get(group, {})
        if not isinstance(section, Mapping):
            raise CalibrationError(f"{group} holds no keys and values, but {kind_of(section)}")
        entries |= {normalized(key): (f"{group}.{key}", value) for key, value in section.items()}
    if _MODELS.get(normalized(model)) == "fisheye":
        # r = theta + k2 theta^3 + k3 theta^5 + k4 theta^7 + k5 theta^9 is OpenCV's k1 to k4.
        for ours, theirs in zip(("k1", "k2", "k3", "k4"), ("k2", "k3", "k4", "k5"), strict=True):
            if theirs in entries:
                entries[ours] = entries[theirs]
        for ours, theirs in zip(("fx", "fy", "cx", "cy"), ("mu", "mv", "u0", "v0"), strict=True):
            if theirs in entries:
                entries[ours] = entries[theirs]
    return _by_name(entries, model)


def _by_name(entries: Mapping[str, tuple[str, object]], said: str) -> Camera:
    """Return a camera with one key per number: fx, fy, cx, cy, and k1, k2, p1, p2, k3 or k1 to k4."""
    model = _MODELS.get(normalized(said))
    if model is None:
        raise CalibrationError(
            f"has a camera of the model {abbreviated(said)}; glstar knows pinhole with radial-tangential distortion and"
            " Kannala-Brandt (fisheye): calibrate with one of these"
        )
    missing = [name for name in ("fx", "fy", "cx", "cy") if name not in entries]
    if missing:
        raise CalibrationError(f"has no {', '.join(missing)}; a camera has fx, fy, cx and cy, px")
    fx_px, fy_px, cx_px, cy_px = (read_number(*entries[name]) for name in ("fx", "fy", "cx", "cy"))
    coefficients = [read_number(*entries[name]) if name in entries else 0.0 for name in COEFFICIENTS[model]]
    lens = Lens(model, tuple(coefficients)) if model == "fisheye" or any(coefficients) else None
    return Camera(*_size(entries), fx_px, fy_px, cx_px, cy_px, lens=lens)


def _kalibr(keys: Keys, name: str) -> Camera:
    entry = keys[name]
    if not isinstance(entry, Mapping):
        raise CalibrationError(f"{name} holds no keys and values, but {kind_of(entry)}")
    model = entry.get("camera_model", "pinhole")
    if model != "pinhole":
        raise CalibrationError(
            f"{name} has camera_model {abbreviated(model)}; glstar knows OpenCV's lens models:"
            " calibrate with pinhole-radtan or pinhole-equi"
        )
    if "intrinsics" not in entry:
        raise CalibrationError(f"{name} has no intrinsics: [fx, fy, cx, cy]")
    entries = {normalized(key): (f"{name}.{key}", value) for key, value in entry.items()}
    lens = _lens(entries)
    numbers = read_numbers(f"{name}.intrinsics", entry["intrinsics"])
    if len(numbers) != 4:
        raise CalibrationError(f"{name}.intrinsics holds {len(numbers)} numbers; a pinhole has 4: [fx, fy, cx, cy]")
    width_px, height_px = _size(entries)
    fx_px, fy_px, cx_px, cy_px = numbers
    return Camera(width_px, height_px, fx_px, fy_px, cx_px, cy_px, lens=lens)


def _camera(width_px: int, height_px: int, key: str, value: object) -> Camera:
    """Return the camera of a 3 x 3 matrix."""
    if isinstance(value, list) and len(value) == 4 and not any(isinstance(row, list) for row in value):
        # EuRoC's sensor.yaml has Kalibr's intrinsics.
        fx_px, fy_px, cx_px, cy_px = read_numbers(key, value)
        return Camera(width_px, height_px, fx_px, fy_px, cx_px, cy_px)
    K = read_matrix(key, value)
    if K[1, 0] != 0 or not np.array_equal(K[2], [0.0, 0.0, 1.0]):
        rows = "; ".join(" ".join(f"{number:g}" for number in row) for row in K)
        raise CalibrationError(f"{key} is [{rows}]; a camera matrix is [fx skew cx; 0 fy cy; 0 0 1]")
    return Camera(width_px, height_px, float(K[0, 0]), float(K[1, 1]), float(K[0, 2]), float(K[1, 2]), float(K[0, 1]))


def _size(entries: Mapping[str, tuple[str, object]]) -> tuple[int, int]:
    """Return width and height, px."""
    for name in _SIZE:
        if name in entries:
            key, value = entries[name]
            numbers = read_numbers(key, value)
            if len(numbers) != 2:
                raise CalibrationError(f"{key} holds {len(numbers)} numbers; it takes [width, height], px")
            return read_integer(key, numbers[0]), read_integer(key, numbers[1])
    sides = []
    for names in (_WIDTH, _HEIGHT):
        found = next((entries[name] for name in names if name in entries), None)
        if found is None:
            raise CalibrationError(
                "does not give the image size; add it, px:"
                " image_width: and image_height: (in a Kalibr camchain, resolution: [width, height])"
            )
        sides.append(read_integer(found[0], read_number(*found)))
    return sides[0], sides[1]


def _refuse_binning(entries: Mapping[str, tuple[str, object]]) -> None:
    """Reject ROS camera_info of binned images: its camera matrix is for the images before binning."""
    for name in ("binningx", "binningy"):
        if name in entries and read_number(*entries[name]) > 1:
            raise CalibrationError(
                f"has {entries[name][0]} = {read_number(*entries[name]):g}; its matrix is for the image before binning:"
                " give a calibration of the binned images, with binning 0"
            )


def _lens(entries: Mapping[str, tuple[str, object]]) -> Lens | None:
    """Return the lens of a file; None for a pinhole."""
    said = label(entries.get("distortionmodel", ("", ""))[1] or "").strip()
    if "fisheyemodel" in entries and read_number(*entries["fisheyemodel"]) != 0:
        said = "fisheye"
    if normalized(said) not in _MODELS:
        raise CalibrationError(
            f"has a lens of the model {said}; glstar knows plumb_bob (radtan), rational_polynomial and fisheye"
            " (equidistant): calibrate with one of these, or rectify the images"
        )
    model = _MODELS[normalized(said)]
    coefficients = [
        number
        for name, (key, value) in entries.items()
        if (name == "d" or name.startswith("dist")) and name != "distortionmodel" and value is not None
        for number in read_numbers(key, value)
    ]
    # A fisheye distorts even if all coefficients are zero: r = f theta, where a pinhole has r = f tan(theta).
    if model != "fisheye" and not any(coefficients):
        return None
    if model is None or (model == "plumb_bob" and len(coefficients) > len(COEFFICIENTS["plumb_bob"])):
        model = "plumb_bob" if len(coefficients) <= len(COEFFICIENTS["plumb_bob"]) else "rational"
    return Lens(model, tuple(coefficients))
