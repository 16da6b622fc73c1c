"""Calibration files of cameras.

Six dialects of YAML are read.  The dialect of a file is recognized by its keys:

=========================  ==========================================================  ============================
dialect                    camera matrix                                               image size
=========================  ==========================================================  ============================
OpenCV FileStorage         ``camera_matrix``, ``cameraMatrix``, ``K`` ... (3 x 3)      ``image_width, image_height``
ROS camera_info            ``camera_matrix: {rows, cols, data}``, or ``K`` (9 numbers) the same, or ``width, height``
Kalibr camchain            ``cam0: {intrinsics: [fx, fy, cx, cy]}``                    ``resolution: [w, h]``
EuRoC sensor.yaml          ``intrinsics: [fx, fy, cx, cy]``                            ``resolution: [w, h]``
VINS-Fusion (camodocal)    ``projection_parameters: {fx, fy, cx, cy}``                 ``image_width, image_height``
ORB-SLAM2, ORB-SLAM3       ``Camera.fx``, ``Camera1.fx`` ...                           ``Camera.width, Camera.height``
=========================  ==========================================================  ============================

JSON is a subset of YAML and is read too.  All dialects put pixel (0, 0) at the CENTRE of the top-left pixel, as glstar
does, so that no position is shifted.  The lens models are OpenCV's (`glstar.camera.distortion`): plumb_bob (radtan),
rational_polynomial and fisheye (equidistant).  If a file does not name its model, the number of coefficients decides:
4 or 5 mean plumb_bob, and 8, 12 or 14 mean rational.  A fisheye must be named.
"""

import re
from collections.abc import Mapping
from dataclasses import replace
from math import isfinite
from os import PathLike
from reprlib import Repr
from typing import NoReturn

import numpy as np
import yaml

from glstar.arrays import Float
from glstar.camera.distortion import COEFFICIENTS, Lens, LensModel
from glstar.camera.model import Camera
from glstar.errors import CalibrationError
from glstar.system.userinput import read_text

Keys = Mapping[object, object]

# Limits a value quoted in a message to one short line, however large or deep it is.
_REPR = Repr()
_REPR.maxlist = _REPR.maxdict = _REPR.maxtuple = 9
_REPR.maxlevel = 1
_REPR.maxstring = _REPR.maxother = 60


class _Loader(yaml.SafeLoader):
    """Loads plain values: no objects and no merge keys, which can grow without bound.  OpenCV's tags are ignored."""

    def flatten_mapping(self, node: yaml.MappingNode) -> None:
        """Reject ``<<: *alias``; calibration files do not need it."""
        for key, _ in node.value:
            if key.tag == "tag:yaml.org,2002:merge":
                raise yaml.constructor.ConstructorError(None, None, "merge keys (<<) are not read", key.start_mark)


def _opencv_value(loader: yaml.SafeLoader, _tag: str, node: yaml.Node) -> object:
    if isinstance(node, yaml.MappingNode):
        return loader.construct_mapping(node, deep=True)
    if isinstance(node, yaml.SequenceNode):
        return loader.construct_sequence(node, deep=True)
    return None


# !!opencv-matrix, !!opencv-nd-matrix and similar tags.
_Loader.add_multi_constructor("tag:yaml.org,2002:opencv-", _opencv_value)


def top_level_keys(text: str) -> Keys:
    """Return the top-level keys and values of a calibration file."""
    if text.lstrip().startswith(("<?xml", "<opencv_storage")):
        raise CalibrationError("is XML; glstar reads the YAML that OpenCV writes into a file named .yml")
    # OpenCV 4 starts with "%YAML:1.0", which is not valid YAML; an empty line keeps the line numbers of messages right.
    text = re.sub(r"\A\s*%YAML:.*", "", text)
    try:
        # "ros2 topic echo" ends each message with "---": the first document is the camera.
        keys = next((document for document in yaml.load_all(text, _Loader) if document is not None), None)
    except yaml.YAMLError as error:
        raise CalibrationError(f"is not YAML: {_yaml_message(error)}") from None
    except (ValueError, TypeError, RecursionError) as error:
        raise CalibrationError(f"is not YAML that describes a camera: {_unquoted(str(error))}") from None
    if keys is None:
        raise CalibrationError("is empty")
    if not isinstance(keys, Mapping):
        raise CalibrationError(f"holds no keys and values, but {kind_of(keys)}; glstar reads {DIALECTS}")
    return keys


DIALECTS = (
    "OpenCV and ROS camera_info files (camera_matrix), Kalibr camchains (cam0), and files of EuRoC, VINS-Fusion and"
    " ORB-SLAM"
)


def _yaml_message(error: yaml.YAMLError) -> str:
    """Return PyYAML's message in one line."""
    if isinstance(error, yaml.MarkedYAMLError):
        mark = error.problem_mark or error.context_mark
        where = f"line {mark.line + 1}, column {mark.column + 1}: " if mark else ""
        return where + _unquoted(error.problem or error.context or "a syntax error")
    if isinstance(error, yaml.reader.ReaderError):
        return f"the character at position {error.position} is not allowed in text"
    return " ".join(str(error).split())


def _unquoted(message: str) -> str:
    """Return a parser's message without its quotations from the file; its own <placeholders> stay."""
    return " ".join(re.sub(r"'[^<'][^']+'", "'...'", message).split())[:200]


def kind_of(value: object) -> str:
    """Return the kind of a value without its content, because the wrong file may be private."""
    return "a list" if isinstance(value, list) else "text" if isinstance(value, str) else "one value"


def normalized(key: object) -> str:
    """Return a key in lower case without underscores, hyphens and spaces."""
    return label(key).lower().replace("_", "").replace("-", "").replace(" ", "")


def abbreviated(value: object) -> str:
    """Return a value for a message: one short line, strings in quotes."""
    return _REPR.repr(value)


def label(value: object) -> str:
    """Return a value for a message: one short line, strings without quotes."""
    return abbreviated(value).strip("'\"")


def read_matrix(key: str, value: object) -> Float:
    """Return a 3 x 3 matrix written as in OpenCV or ROS files, as three rows, or as nine numbers."""
    if isinstance(value, Mapping) and (value.get("rows"), value.get("cols")) != (3, 3):
        raise CalibrationError(
            f"{key} is {abbreviated(value.get('rows'))} x {abbreviated(value.get('cols'))};"
            " a camera matrix has rows: 3, cols: 3"
        )
    numbers = read_numbers(key, value)
    if len(numbers) != 9:
        raise CalibrationError(f"{key} holds {len(numbers)} numbers; a camera matrix has 9, row by row")
    return np.array(numbers).reshape(3, 3)


def read_numbers(key: str, value: object) -> list[float]:
    """Return the numbers of a matrix, a list or a list of lists, in row order."""
    if isinstance(value, Mapping):
        if "data" not in value:
            raise CalibrationError(f"{key} has no data: [...]")
        return read_numbers(f"{key}.data", value["data"])
    if not isinstance(value, list):
        _not_a_number(key, value, "a list of numbers")
    return [read_number(key, item) for row in value for item in (row if isinstance(row, list) else [row])]


def read_number(key: str, value: object) -> float:
    """Return one finite number."""
    if isinstance(value, bool) or not isinstance(value, int | float | str):
        _not_a_number(key, value, "a number")
    try:
        # PyYAML reads 1e-5 and OpenCV's .Nan as strings, because YAML 1.1 requires 1.0e-5 and .nan.
        number = float("nan" if value == ".Nan" else value)
    except (ValueError, OverflowError):
        _not_a_number(key, value, "a number")
    if not isfinite(number):
        raise CalibrationError(f"{key} holds {number}; it must be a finite number")
    return number


def read_integer(key: str, number: float) -> int:
    """Return the width or height of an image, px."""
    if number != int(number) or number < 1:
        raise CalibrationError(f"{key} is {number:g}; the size of an image is an integer of 1 or more, px")
    return int(number)


def _not_a_number(key: str, value: object, wanted: str) -> NoReturn:
    raise CalibrationError(f"{key} must be {wanted}, not {abbreviated(value)}")


# Common names of the same key, normalized: lower case, without underscores, hyphens and spaces.
_MATRIX = ("cameramatrix", "k", "intrinsicmatrix", "intrinsics", "mtx")
_WIDTH = ("imagewidth", "width", "imgwidth")
_HEIGHT = ("imageheight", "height", "imgheight")
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
    orb_slam = sorted({match[1] for key in keys if (match := re.fullmatch(r"(Camera\d?)\.fx", str(key)))})
    if chain:
        return _kalibr(keys, _chosen(chain, name))
    if orb_slam:
        return _orb_slam(keys, _chosen(orb_slam, name))
    if name is not None:
        raise CalibrationError(f"holds one camera, and none named {label(name)}")
    return _camodocal(keys) if "projection_parameters" in keys else _opencv_or_ros(keys)


def _opencv_or_ros(keys: Keys) -> Camera:
    entries = {normalized(key): (str(key), value) for key, value in keys.items()}
    matrix = next((entries[name] for name in _MATRIX if name in entries), None)
    if matrix is None:
        raise CalibrationError(
            f"has no camera matrix under any name that glstar knows; it reads {DIALECTS}, and here"
            f" {_key_of_another_file(keys)}"
        )
    _refuse_binning(entries)
    lens = _lens(entries)
    width_px, height_px = _size(entries)
    return replace(_camera(width_px, height_px, *matrix), lens=lens)


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

    def entries(camera: str) -> dict[str, tuple[str, object]]:
        of_camera = [str(key) for key in keys if str(key).partition(".")[0] == camera and "." in str(key)]
        return {normalized(key.partition(".")[2]): (key, keys[key]) for key in of_camera}

    shared = entries("Camera")
    return _by_name(shared | entries(name), label(shared.get("type", ("", "PinHole"))[1]))


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


def _by_name(entries: Mapping[str, tuple[str, object]], model_name: str) -> Camera:
    """Return a camera with one key per number: fx, fy, cx, cy, and k1, k2, p1, p2, k3 or k1 to k4."""
    model = _MODELS.get(normalized(model_name))
    if model is None:
        raise CalibrationError(
            f"has a camera of the model {abbreviated(model_name)}; glstar knows pinhole with radial-tangential"
            " distortion and Kannala-Brandt (fisheye): calibrate with one of these"
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
    fx_px, skew_px, cx_px = K[0].tolist()
    _, fy_px, cy_px = K[1].tolist()
    return Camera(width_px, height_px, fx_px, fy_px, cx_px, cy_px, skew_px=skew_px)


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
        side = next((entries[name] for name in names if name in entries), None)
        if side is None:
            raise CalibrationError(
                "does not give the image size; add it, px:"
                " image_width: and image_height: (in a Kalibr camchain, resolution: [width, height])"
            )
        sides.append(read_integer(side[0], read_number(*side)))
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
    model_name = label(entries.get("distortionmodel", ("", ""))[1] or "").strip()
    if "fisheyemodel" in entries and read_number(*entries["fisheyemodel"]) != 0:
        model_name = "fisheye"
    if normalized(model_name) not in _MODELS:
        raise CalibrationError(
            f"has a lens of the model {model_name}; glstar knows plumb_bob (radtan), rational_polynomial and fisheye"
            " (equidistant): calibrate with one of these, or rectify the images"
        )
    model = _MODELS[normalized(model_name)]
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


# Size limit of a calibration file, bytes: OpenCV's file with the corners of a hundred chessboards is smaller.
_LARGEST_BYTES = 2 * 2**20

# Plausible magnitude of the coefficients of a plumb_bob or fisheye lens; larger ones mean that the calibration failed.
_LARGEST_COEFFICIENT = 10.0

_ROS_NAMES: Mapping[LensModel, str] = {
    "plumb_bob": "plumb_bob",
    "rational": "rational_polynomial",
    "fisheye": "equidistant",
}


def camera_from_file(path: str | PathLike[str], name: str | None = None) -> Camera:
    """Return the camera that a calibration file describes.

    Parameters
    ----------
    path : path-like
        YAML or JSON of OpenCV, ROS camera_info YAML, a Kalibr camchain, or a file of EuRoC, VINS-Fusion or ORB-SLAM.
    name : str, optional
        The camera to read from a file with several of them: ``cam1``, or ``Camera2`` of ORB-SLAM3.

    Returns
    -------
    Camera
        Focal lengths and principal point are the file's, px.  A plumb_bob or rational lens whose coefficients are all
        zero is a pinhole, and `lens` is None.

    Raises
    ------
    CalibrationError
        If the file cannot be read, holds several cameras and none is named, lacks the named camera, the camera matrix
        or the image size, or has an unknown lens model.
    """
    try:
        return camera_from_keys(top_level_keys(read_text(path, _LARGEST_BYTES)), name)
    except (CalibrationError, ValueError) as error:
        raise CalibrationError(str(error), path=path) from None


def camera_warnings(camera: Camera) -> tuple[str, ...]:
    """Return warnings about implausible numbers of a camera."""
    warnings = []
    if not camera.contains([camera.cx_px, camera.cy_px]):
        warnings.append(
            f"the principal point ({camera.cx_px:.1f}, {camera.cy_px:.1f}) lies outside the image of {camera.width_px}"
            f" x {camera.height_px} px: is the file for an image of another size, or was the image cropped?"
        )
    if camera.lens is not None and camera.lens.model != "rational":
        names = COEFFICIENTS[camera.lens.model]
        large = [
            f"{name} = {number:g}"
            for name, number in zip(names, camera.lens.coefficients, strict=False)
            if abs(number) > _LARGEST_COEFFICIENT
        ]
        if large:
            warnings.append(
                f"{', '.join(large)}: coefficients of real lenses are rarely above {_LARGEST_COEFFICIENT:g}; a narrow"
                " view, or points near the image centre only, do not determine them: calibrate with fewer coefficients"
            )
    return tuple(warnings)


def camera_to_yaml(camera: Camera, *comments: str) -> str:
    """Return a camera as ROS camera_info YAML, which `camera_from_file`, ROS and OpenCV's FileStorage read.

    Lines of `comments`, such as the origin of the numbers, are written at the top.  Reading it returns the same
    numbers.
    """
    lens = camera.lens
    K = camera.K
    projection = np.column_stack([K, np.zeros(3)])
    # ROS expects five numbers for a plumb_bob and eight for a rational_polynomial.
    coefficients = list(lens.coefficients) if lens is not None else []
    if lens is None or lens.model != "rational":
        count = 4 if lens is not None and lens.model == "fisheye" else 5
    else:
        count = next(count for count in (8, 12, 14) if len(coefficients) <= count)
    coefficients += [0.0] * (count - len(coefficients))
    lines = [
        *(f"# {line}" for comment in comments for line in comment.splitlines()),
        f"image_width: {camera.width_px}",
        f"image_height: {camera.height_px}",
        "camera_name: glstar",
        *_yaml_matrix("camera_matrix", K),
        f"distortion_model: {_ROS_NAMES[lens.model] if lens is not None else 'plumb_bob'}",
        *_yaml_matrix("distortion_coefficients", np.array([coefficients])),
        *_yaml_matrix("rectification_matrix", np.eye(3)),
        *_yaml_matrix("projection_matrix", projection),
    ]
    return "\n".join(lines) + "\n"


def _yaml_matrix(name: str, matrix: Float) -> list[str]:
    numbers = ", ".join(repr(float(number)) for number in matrix.ravel())
    return [f"{name}:", f"  rows: {matrix.shape[0]}", f"  cols: {matrix.shape[1]}", f"  data: [{numbers}]"]
