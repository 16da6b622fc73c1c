"""Cameras from elsewhere: calibration files, and the presets that ship with glstar.

Six dialects of YAML are read, told apart by their keys:

=========================  ==========================================================  ============================
dialect                    camera matrix                                               size of the image
=========================  ==========================================================  ============================
OpenCV FileStorage         ``camera_matrix``, ``cameraMatrix``, ``K`` ... (3 x 3)      ``image_width, image_height``
ROS camera_info            ``camera_matrix: {rows, cols, data}``, or ``K`` (9 numbers) the same, or ``width, height``
Kalibr camchain            ``cam0: {intrinsics: [fx, fy, cx, cy]}``                    ``resolution: [w, h]``
EuRoC sensor.yaml          ``intrinsics: [fx, fy, cx, cy]``                            ``resolution: [w, h]``
VINS-Fusion (camodocal)    ``projection_parameters: {fx, fy, cx, cy}``                 ``image_width, image_height``
ORB-SLAM2, ORB-SLAM3       ``Camera.fx``, ``Camera1.fx`` ...                           ``Camera.width, Camera.height``
=========================  ==========================================================  ============================

JSON, which OpenCV writes too, is read as the YAML that it is.  All place (0, 0) at the CENTRE of the top-left
pixel, as glstar does: nothing is shifted.  Lenses are OpenCV's (`glstar.camera.distortion`): plumb_bob (radtan),
rational_polynomial and fisheye (equidistant), by the name that a file gives, and without one by the number of
coefficients: 4 and 5 are a plumb_bob, 8, 12 and 14 a rational; a fisheye must be named.
"""

import re
import tomllib
from collections.abc import Mapping
from dataclasses import replace
from difflib import get_close_matches
from functools import cache
from math import isfinite
from os import PathLike
from reprlib import Repr
from typing import Any, NoReturn

import numpy as np
import yaml
from numpy.typing import NDArray

from glstar.camera.distortion import COEFFICIENTS, Lens, LensModel
from glstar.camera.model import Camera
from glstar.errors import CalibrationError, ConfigError
from glstar.system.inputfile import read_text
from glstar.system.resources import asset

__all__ = ["camera_from_file", "camera_from_preset", "camera_presets", "camera_to_yaml", "camera_warnings"]

Float = NDArray[np.float64]
Keys = Mapping[object, object]

# An OpenCV file with the corners of a hundred chessboards takes less than this.
_LARGEST_BYTES = 2 * 2**20

# Distortion coefficients of a plumb_bob or fisheye lens above this are a calibration gone wrong.
_LARGEST_COEFFICIENT = 10.0

# Names that people give to the same thing; compared in lower case, without underscores.
_MATRIX = ("cameramatrix", "k", "intrinsicmatrix", "intrinsics", "mtx")
_WIDTH, _HEIGHT = ("imagewidth", "width", "imgwidth"), ("imageheight", "height", "imgheight")
_SIZE = ("imagesize", "resolution", "imgsize")

# What OpenCV, ROS and Kalibr call their lenses; a file that names none is OpenCV's, whose coefficients tell.
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
_ROS_NAMES: Mapping[LensModel, str] = {
    "plumb_bob": "plumb_bob",
    "rational": "rational_polynomial",
    "fisheye": "equidistant",
}

# A value in a message: short, however large or deep it is.
_brief = Repr()
_brief.maxlist = _brief.maxdict = _brief.maxtuple = 9
_brief.maxlevel = 1
_brief.maxstring = _brief.maxother = 60


def camera_from_file(path: str | PathLike[str], name: str | None = None) -> Camera:
    """Return the camera that a calibration file describes.

    Parameters
    ----------
    path : path-like
        YAML or JSON of OpenCV, ROS camera_info YAML, a Kalibr camchain, or a file of EuRoC, VINS-Fusion or ORB-SLAM.
    name : str, optional
        Which camera of a file that holds several: ``cam1``, or ``Camera2`` of ORB-SLAM3.

    Returns
    -------
    Camera
        Focal lengths and principal point as the file has them, px; without a lens where all its coefficients are
        zero and a pinhole is meant.

    Raises
    ------
    CalibrationError
        If the file cannot be read, holds several cameras or not the named one, has no camera matrix or no image size,
        or describes a lens of an unknown model.
    """
    try:
        return _named(_keys(read_text(path, _LARGEST_BYTES)), name)
    except (CalibrationError, ValueError) as error:
        raise CalibrationError(str(error), path=path) from None


def camera_warnings(camera: Camera) -> tuple[str, ...]:
    """Return what is implausible about a camera.

    Parameters
    ----------
    camera : Camera

    Returns
    -------
    tuple of str
        Nothing for a plausible one.
    """
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
                " view, or points in its middle only, do not determine them: calibrate with fewer coefficients"
            )
    return tuple(warnings)


def camera_to_yaml(camera: Camera, *comments: str) -> str:
    """Return a camera as a calibration file that `camera_from_file`, ROS and OpenCV's FileStorage read.

    Parameters
    ----------
    camera : Camera
    *comments : str
        Lines that say where it comes from.

    Returns
    -------
    str
        ROS camera_info YAML; every number comes back as it was.
    """
    lens = camera.lens
    K = camera.K
    projection = np.column_stack([K, np.zeros(3)])
    # ROS wants five numbers of a plumb_bob, eight of a rational_polynomial.
    coefficients = list(lens.coefficients) if lens is not None else []
    if lens is None or lens.model != "rational":
        least = 4 if lens is not None and lens.model == "fisheye" else 5
    else:
        least = next(n for n in (8, 12, 14) if len(coefficients) <= n)
    coefficients += [0.0] * (least - len(coefficients))
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


def camera_from_preset(name: str) -> Camera:
    """Return a camera that ships with glstar.

    Parameters
    ----------
    name : str
        Such as ``"picamhq-6mm"``; `camera_presets` lists them.

    Returns
    -------
    Camera
        Its nominal numbers, px.

    Raises
    ------
    ConfigError
        If there is no such preset; the message lists those that there are.
    """
    presets = _presets()
    if name not in presets:
        close = get_close_matches(name.lower(), presets, n=1, cutoff=0.5)
        hint = f'did you mean "{close[0]}"? There' if close else "there"
        raise ConfigError(f'there is no camera "{_bare(name)}" ({hint} are {", ".join(presets)})', key="camera.preset")
    preset = presets[name]
    if "binned" in preset:
        return _binned(camera_from_preset(preset["binned"]["of"]), preset["binned"]["by"])
    width_px, height_px, focal_px = preset["width_px"], preset["height_px"], preset["focal_px"]
    return Camera(width_px, height_px, focal_px, focal_px, (width_px - 1) / 2, (height_px - 1) / 2)


def camera_presets() -> dict[str, str]:
    """Return the presets by name, each with a line that describes it."""
    return {name: preset["description"] for name, preset in _presets().items()}


# --- presets ----------------------------------------------------------------------------------------------------------


@cache
def _presets() -> dict[str, dict[str, Any]]:
    return tomllib.loads(asset("cameras.toml").read_text(encoding="utf-8"))


def _binned(camera: Camera, by: int) -> Camera:
    """Return the camera whose pixels are blocks of `by` times `by` of this one's."""
    # With pixel centres at whole numbers the corner of the image lies at -0.5, and the corner is what stays.
    return Camera(
        camera.width_px // by,
        camera.height_px // by,
        camera.fx_px / by,
        camera.fy_px / by,
        (camera.cx_px + 0.5) / by - 0.5,
        (camera.cy_px + 0.5) / by - 0.5,
        camera.skew_px / by,
    )


# --- the text of a file -----------------------------------------------------------------------------------------------


class _Loader(yaml.SafeLoader):
    """Plain values only: no objects, no merge keys (which can grow without bound), OpenCV's tags as what they hold."""

    def flatten_mapping(self, node: yaml.MappingNode) -> None:
        """Refuse ``<<: *alias``; a calibration has no use for it."""
        for key, _ in node.value:
            if key.tag == "tag:yaml.org,2002:merge":
                raise yaml.constructor.ConstructorError(None, None, "merge keys (<<) are not read", key.start_mark)


def _opencv_value(loader: yaml.SafeLoader, _tag: str, node: yaml.Node) -> object:
    if isinstance(node, yaml.MappingNode):
        return loader.construct_mapping(node, deep=True)
    if isinstance(node, yaml.SequenceNode):
        return loader.construct_sequence(node, deep=True)
    return None


# !!opencv-matrix, !!opencv-nd-matrix and their kind.
_Loader.add_multi_constructor("tag:yaml.org,2002:opencv-", _opencv_value)


def _keys(text: str) -> Keys:
    """Return the top level of a calibration file."""
    if text.lstrip().startswith(("<?xml", "<opencv_storage")):
        raise CalibrationError("is XML; glstar reads the YAML that OpenCV writes into a file named .yml")
    # OpenCV 4 opens with "%YAML:1.0", which is no YAML; the line stays, empty, so that line numbers hold.
    text = re.sub(r"\A\s*%YAML:.*", "", text)
    try:
        # "ros2 topic echo" ends each message with "---": the first document is the camera.
        keys = next((document for document in yaml.load_all(text, _Loader) if document is not None), None)
    except yaml.YAMLError as error:
        raise CalibrationError(f"is not YAML: {_words(error)}") from None
    except (ValueError, TypeError, RecursionError) as error:
        raise CalibrationError(f"is not YAML that describes a camera: {_unquoted(str(error))}") from None
    if keys is None:
        raise CalibrationError("is empty")
    if not isinstance(keys, Mapping):
        raise CalibrationError(f"holds no keys and values, but {_kind_of(keys)}; glstar reads {_KINDS}")
    return keys


_KINDS = (
    "OpenCV and ROS camera_info files (camera_matrix), Kalibr camchains (cam0), and files of EuRoC, VINS-Fusion and"
    " ORB-SLAM"
)


def _words(error: yaml.YAMLError) -> str:
    """Return what PyYAML has to say, in one line."""
    if isinstance(error, yaml.MarkedYAMLError):
        mark = error.problem_mark or error.context_mark
        where = f"line {mark.line + 1}, column {mark.column + 1}: " if mark else ""
        return where + _unquoted(error.problem or error.context or "a fault")
    if isinstance(error, yaml.reader.ReaderError):
        return f"the character at position {error.position} has no place in text"
    return " ".join(str(error).split())


def _unquoted(message: str) -> str:
    """Return a parser's message without what it quotes, "found undefined alias 'name'"; its own <words> stay."""
    return " ".join(re.sub(r"'[^<'][^']+'", "'...'", message).split())[:200]


def _kind_of(value: object) -> str:
    """Return what a value is, without its content: the file may be another than the one meant, and private."""
    return "a list" if isinstance(value, list) else "text" if isinstance(value, str) else "one value"


def _key_of_another_file(keys: Keys) -> str:
    """Return where the first key of a file stands that is no camera file, and the key if it looks like one."""
    first = str(next(iter(keys), ""))
    return f"its first key is {first}" if re.fullmatch(r"[A-Za-z][\w.-]{0,39}", first) else "its keys are other ones"


# --- the dialects -----------------------------------------------------------------------------------------------------


def _named(keys: Keys, name: str | None) -> Camera:
    """Return the camera of a file, or the one with a name."""
    chain = [key for key in keys if isinstance(key, str) and re.fullmatch(r"cam\d+", key)]
    orb_slam = sorted({found[1] for key in keys if (found := re.fullmatch(r"(Camera\d?)\.fx", str(key)))})
    if chain:
        return _kalibr(keys, _chosen(chain, name))
    if orb_slam:
        return _orb_slam(keys, _chosen(orb_slam, name))
    if name is not None:
        raise CalibrationError(f"holds one camera, and none by the name of {_bare(name)}")
    return _camodocal(keys) if "projection_parameters" in keys else _opencv_or_ros(keys)


def _opencv_or_ros(keys: Keys) -> Camera:
    plain = {_plain(key): (str(key), value) for key, value in keys.items()}
    found = next((plain[name] for name in _MATRIX if name in plain), None)
    if found is None:
        raise CalibrationError(
            f"has no camera matrix under any name that glstar knows; it reads {_KINDS}, and here"
            f" {_key_of_another_file(keys)}"
        )
    _refuse_binning(plain)
    lens = _lens(plain)
    width_px, height_px = _size(plain)
    return replace(_camera(width_px, height_px, *found), lens=lens)


def _chosen(names: list[str], name: str | None) -> str:
    """Return which camera of a file is meant."""
    if name is not None and name not in names:
        raise CalibrationError(f"holds {', '.join(names)}, and no camera by the name of {_bare(name)}")
    if name is None and len(names) > 1:
        raise CalibrationError(
            f"holds {len(names)} cameras ({', '.join(names)}); write the one that flies into a file of its own: glstar"
            f" camera show FILE --camera {names[0]} -o {names[0]}.yaml"
        )
    return name or names[0]


def _orb_slam(keys: Keys, name: str) -> Camera:
    """Return a camera of ORB-SLAM2 or ORB-SLAM3: ``Camera.fx``, ``Camera1.k1`` and their kind."""
    own = {_plain(str(key).partition(".")[2]): (str(key), keys[key]) for key in keys if str(key).startswith(f"{name}.")}
    shared = {
        _plain(str(key).partition(".")[2]): (str(key), keys[key]) for key in keys if str(key).startswith("Camera.")
    }
    return _by_name(shared | own, _bare(shared.get("type", ("", "PinHole"))[1]))


def _camodocal(keys: Keys) -> Camera:
    """Return a camera of camodocal, which VINS-Fusion and its kin write."""
    model = _bare(keys.get("model_type", "PINHOLE"))
    plain = {_plain(key): (str(key), value) for key, value in keys.items()}
    for group in ("projection_parameters", "distortion_parameters"):
        section = keys.get(group, {})
        if not isinstance(section, Mapping):
            raise CalibrationError(f"{group} holds no keys and values, but {_kind_of(section)}")
        plain |= {_plain(key): (f"{group}.{key}", value) for key, value in section.items()}
    if _MODELS.get(_plain(model)) == "fisheye":
        # r = theta + k2 theta^3 + k3 theta^5 + k4 theta^7 + k5 theta^9 is OpenCV's k1 to k4.
        for ours, theirs in zip(("k1", "k2", "k3", "k4"), ("k2", "k3", "k4", "k5"), strict=True):
            if theirs in plain:
                plain[ours] = plain[theirs]
        for ours, theirs in zip(("fx", "fy", "cx", "cy"), ("mu", "mv", "u0", "v0"), strict=True):
            if theirs in plain:
                plain[ours] = plain[theirs]
    return _by_name(plain, model)


def _by_name(plain: Mapping[str, tuple[str, object]], said: str) -> Camera:
    """Return the camera whose numbers have a key each: fx, fy, cx, cy, and k1, k2, p1, p2, k3 or k1 to k4."""
    model = _MODELS.get(_plain(said))
    if model is None:
        raise CalibrationError(
            f"has a camera of the model {_brief.repr(said)}; glstar knows pinhole with radial-tangential distortion and"
            " Kannala-Brandt (fisheye): calibrate with one of these"
        )
    missing = [name for name in ("fx", "fy", "cx", "cy") if name not in plain]
    if missing:
        raise CalibrationError(f"has no {', '.join(missing)}; a camera has fx, fy, cx and cy, px")
    fx_px, fy_px, cx_px, cy_px = (_number(*plain[name]) for name in ("fx", "fy", "cx", "cy"))
    coefficients = [_number(*plain[name]) if name in plain else 0.0 for name in COEFFICIENTS[model]]
    lens = Lens(model, tuple(coefficients)) if model == "fisheye" or any(coefficients) else None
    return Camera(*_size(plain), fx_px, fy_px, cx_px, cy_px, lens=lens)


def _kalibr(keys: Keys, name: str) -> Camera:
    entry = keys[name]
    if not isinstance(entry, Mapping):
        raise CalibrationError(f"{name} holds no keys and values, but {_kind_of(entry)}")
    model = entry.get("camera_model", "pinhole")
    if model != "pinhole":
        raise CalibrationError(
            f"{name} has camera_model {_brief.repr(model)}; glstar draws through OpenCV's lenses:"
            " calibrate with pinhole-radtan or pinhole-equi"
        )
    if "intrinsics" not in entry:
        raise CalibrationError(f"{name} has no intrinsics: [fx, fy, cx, cy]")
    plain = {_plain(key): (f"{name}.{key}", value) for key, value in entry.items()}
    lens = _lens(plain)
    numbers = _numbers(f"{name}.intrinsics", entry["intrinsics"])
    if len(numbers) != 4:
        raise CalibrationError(f"{name}.intrinsics holds {len(numbers)} numbers; a pinhole has 4: [fx, fy, cx, cy]")
    width_px, height_px = _size(plain)
    fx_px, fy_px, cx_px, cy_px = numbers
    return Camera(width_px, height_px, fx_px, fy_px, cx_px, cy_px, lens=lens)


def _camera(width_px: int, height_px: int, key: str, value: object) -> Camera:
    """Return the camera of a 3 x 3 matrix."""
    if isinstance(value, list) and len(value) == 4 and not any(isinstance(row, list) for row in value):
        # EuRoC's sensor.yaml has Kalibr's intrinsics.
        fx_px, fy_px, cx_px, cy_px = _numbers(key, value)
        return Camera(width_px, height_px, fx_px, fy_px, cx_px, cy_px)
    K = _matrix(key, value)
    if K[1, 0] != 0 or not np.array_equal(K[2], [0.0, 0.0, 1.0]):
        rows = "; ".join(" ".join(f"{number:g}" for number in row) for row in K)
        raise CalibrationError(f"{key} is [{rows}]; a camera matrix is [fx skew cx; 0 fy cy; 0 0 1]")
    return Camera(width_px, height_px, float(K[0, 0]), float(K[1, 1]), float(K[0, 2]), float(K[1, 2]), float(K[0, 1]))


def _size(plain: Mapping[str, tuple[str, object]]) -> tuple[int, int]:
    """Return width and height, px."""
    for name in _SIZE:
        if name in plain:
            key, value = plain[name]
            numbers = _numbers(key, value)
            if len(numbers) != 2:
                raise CalibrationError(f"{key} holds {len(numbers)} numbers; it takes [width, height], px")
            return _whole(key, numbers[0]), _whole(key, numbers[1])
    sides = []
    for names in (_WIDTH, _HEIGHT):
        found = next((plain[name] for name in names if name in plain), None)
        if found is None:
            raise CalibrationError(
                "does not tell the size of the image; add it, px:"
                " image_width: and image_height: (in a Kalibr camchain, resolution: [width, height])"
            )
        sides.append(_whole(found[0], _number(*found)))
    return sides[0], sides[1]


def _refuse_binning(plain: Mapping[str, tuple[str, object]]) -> None:
    """Refuse the ROS messages whose images are not those of the camera matrix."""
    for name in ("binningx", "binningy"):
        if name in plain and _number(*plain[name]) > 1:
            raise CalibrationError(
                f"has {plain[name][0]} = {_number(*plain[name]):g}; its matrix is for the image before binning:"
                " give a file for the images that the camera delivers, with binning 0"
            )


def _lens(plain: Mapping[str, tuple[str, object]]) -> Lens | None:
    """Return the lens that a file describes; None for a pinhole."""
    said = _bare(plain.get("distortionmodel", ("", ""))[1] or "").strip()
    if "fisheyemodel" in plain and _number(*plain["fisheyemodel"]) != 0:
        said = "fisheye"
    if _plain(said) not in _MODELS:
        raise CalibrationError(
            f"has a lens of the model {said}; glstar knows plumb_bob (radtan), rational_polynomial and fisheye"
            " (equidistant): calibrate with one of these, or rectify the images"
        )
    model = _MODELS[_plain(said)]
    coefficients = [
        number
        for name, (key, value) in plain.items()
        if (name == "d" or name.startswith("dist")) and name != "distortionmodel" and value is not None
        for number in _numbers(key, value)
    ]
    # A fisheye bends straight lines with all its coefficients at zero: r = f theta, where a pinhole has f tan(theta).
    if model != "fisheye" and not any(coefficients):
        return None
    if model is None or (model == "plumb_bob" and len(coefficients) > len(COEFFICIENTS["plumb_bob"])):
        model = "plumb_bob" if len(coefficients) <= len(COEFFICIENTS["plumb_bob"]) else "rational"
    return Lens(model, tuple(coefficients))


# --- values -----------------------------------------------------------------------------------------------------------


def _plain(key: object) -> str:
    """Return the name under which a key is looked up."""
    return _bare(key).lower().replace("_", "").replace("-", "").replace(" ", "")


def _bare(value: object) -> str:
    """Return a value for a message, short and in one line; words without quotes."""
    return _brief.repr(value).strip("'\"")


def _matrix(key: str, value: object) -> Float:
    """Return a 3 x 3 matrix given as OpenCV and ROS write it, as three rows, or as nine numbers in a row."""
    if isinstance(value, Mapping) and (value.get("rows"), value.get("cols")) != (3, 3):
        raise CalibrationError(
            f"{key} is {_brief.repr(value.get('rows'))} x {_brief.repr(value.get('cols'))};"
            " a camera matrix has rows: 3, cols: 3"
        )
    numbers = _numbers(key, value)
    if len(numbers) != 9:
        raise CalibrationError(f"{key} holds {len(numbers)} numbers; a camera matrix has 9, row by row")
    return np.array(numbers).reshape(3, 3)


def _numbers(key: str, value: object) -> list[float]:
    """Return the numbers of a matrix, a list or a list of lists, row by row."""
    if isinstance(value, Mapping):
        if "data" not in value:
            raise CalibrationError(f"{key} has no data: [...]")
        return _numbers(f"{key}.data", value["data"])
    if not isinstance(value, list):
        _not_a_number(key, value, "a list of numbers")
    return [_number(key, item) for row in value for item in (row if isinstance(row, list) else [row])]


def _number(key: str, value: object) -> float:
    """Return one finite number."""
    if isinstance(value, bool) or not isinstance(value, int | float | str):
        _not_a_number(key, value, "a number")
    try:
        # PyYAML takes 1e-5 for a word (YAML 1.1 wants 1.0e-5, and people do not), and the .Nan of OpenCV too.
        number = float("nan" if value == ".Nan" else value)
    except (ValueError, OverflowError):
        _not_a_number(key, value, "a number")
    if not isfinite(number):
        raise CalibrationError(f"{key} holds {number}; it must be a finite number")
    return number


def _whole(key: str, number: float) -> int:
    if number != int(number) or number < 1:
        raise CalibrationError(f"{key} is {number:g}; the size of an image is a whole number of pixels, 1 or more")
    return int(number)


def _not_a_number(key: str, value: object, wanted: str) -> NoReturn:
    raise CalibrationError(f"{key} must be {wanted}, not {_brief.repr(value)}")
