"""Calibration files of cameras.

Seven dialects of YAML are read, by the rules of `glstar.camera.camerakeys`:

=========================  ==========================================================  ============================
dialect                    camera matrix                                               image size
=========================  ==========================================================  ============================
OpenCV FileStorage         ``camera_matrix``, ``cameraMatrix``, ``K`` ... (3 x 3)      ``image_width, image_height``
ROS camera_info            ``camera_matrix: {rows, cols, data}``, or ``K`` (9 numbers) the same, or ``width, height``
Kalibr camchain            ``cam0: {intrinsics: [fx, fy, cx, cy]}``                    ``resolution: [w, h]``
EuRoC sensor.yaml          ``intrinsics: [fx, fy, cx, cy]``                            ``resolution: [w, h]``
VINS-Fusion (camodocal)    ``projection_parameters: {fx, fy, cx, cy}``                 ``image_width, image_height``
Basalt calibration.json    ``value0: intrinsics: [{intrinsics: {fx, fy, cx, cy}}]``    ``resolution: [[w, h]]``
ORB-SLAM2, ORB-SLAM3       ``Camera.fx``, ``Camera1.fx`` ...                           ``Camera.width, Camera.height``
=========================  ==========================================================  ============================

JSON is a subset of YAML and is read too, and so is OpenCV's XML.  All dialects put pixel (0, 0) at the CENTRE of the
top-left pixel, as glstar does, so that no position is shifted.  The lens models are those of
`glstar.camera.distortion`: plumb_bob (radtan), rational_polynomial, fisheye (equidistant), omni (Mei), double_sphere
(ds) and eucm.  If a file does not name its model, the number of coefficients decides: 4 or 5 mean plumb_bob, and 8, 12
or 14 mean rational; with a number xi it is omni, as OpenCV's omnidir writes it.  The others must be named, by any key.
"""

import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from itertools import islice
from os import PathLike
from xml.etree import ElementTree as ET

import numpy as np
import yaml

from glstar.arrays import Float
from glstar.camera.camerakeys import (
    INTRINSIC_KEYS,
    MATRIX_KEYS,
    Keys,
    camera_of,
    entries_of,
    kind_of,
    label,
    model_of,
    normalized,
    read_number,
)
from glstar.camera.distortion import COEFFICIENTS, LensModel
from glstar.camera.model import Camera
from glstar.errors import CalibrationError, reading
from glstar.system.userinput import limit_of, read_text

DIALECTS = (
    "OpenCV and ROS camera_info files (camera_matrix), Kalibr camchains (cam0), and files of EuRoC, Basalt, VINS-Fusion"
    " and ORB-SLAM"
)
# Documents of one file that are compared: "ros2 topic echo" writes one per message.
_MOST_DOCUMENTS = 10


class _Loader(yaml.SafeLoader):
    """Loads plain values: no objects and no merge keys, which can grow without bound.  OpenCV's tags are ignored."""

    def fetch_flow_collection_start(self, TokenClass: type[yaml.Token]) -> None:
        """Reject lists in lists in lists: their time grows with the square of their number."""
        super().fetch_flow_collection_start(TokenClass)
        if self.flow_level > limit_of("depth"):
            raise yaml.scanner.ScannerError(None, None, "nested too deeply", self.get_mark())

    def flatten_mapping(self, node: yaml.MappingNode) -> None:
        """Reject ``<<: *alias``, which calibration files do not need, and a key with two values."""
        values: dict[str, object] = {}
        for key, value in node.value:
            if key.tag == "tag:yaml.org,2002:merge":
                raise yaml.constructor.ConstructorError(None, None, "merge keys (<<) are not read", key.start_mark)
            if not isinstance(key.value, str):
                continue
            content = value.value if isinstance(value, yaml.ScalarNode) else value
            if values.setdefault(key.value, content) != content:
                problem = f"the key {label(key.value)} occurs twice, with two values"
                raise yaml.constructor.ConstructorError(None, None, problem, key.start_mark)


def _opencv_value(loader: yaml.SafeLoader, _tag: str, node: yaml.Node) -> object:
    if isinstance(node, yaml.MappingNode):
        return loader.construct_mapping(node, deep=True)
    if isinstance(node, yaml.SequenceNode):
        return loader.construct_sequence(node, deep=True)
    return None


# Plain numbers and nothing else: YAML 1.1 takes 0500 for 320 and 1:20 for 80, programs of YAML 1.2 do not.
_NUMBERS = {
    "tag:yaml.org,2002:int": re.compile(r"[-+]?(?:0|[1-9][0-9]*)"),
    "tag:yaml.org,2002:float": re.compile(
        r"[-+]?(?:[0-9]+\.[0-9]*|\.[0-9]+)(?:[eE][-+]?[0-9]+)?|[-+]?\.(?:inf|Inf|INF)|\.(?:nan|NaN|NAN)"
    ),
}
_NOT_RESOLVED = {*_NUMBERS, "tag:yaml.org,2002:timestamp"}
_Loader.yaml_implicit_resolvers = {
    first: [entry for entry in entries if entry[0] not in _NOT_RESOLVED]
    for first, entries in yaml.SafeLoader.yaml_implicit_resolvers.items()
}
for _tag, _pattern in _NUMBERS.items():
    _Loader.add_implicit_resolver(_tag, re.compile(f"(?:{_pattern.pattern})$"), list("-+0123456789."))

# !!opencv-matrix, !!opencv-nd-matrix and similar tags.
_Loader.add_multi_constructor("tag:yaml.org,2002:opencv-", _opencv_value)


def documents_of(text: str) -> Iterator[Keys]:
    """Yield the keys and values of the documents of a calibration file; the first one is checked."""
    if text.lstrip().startswith(("<?xml", "<opencv_storage")):
        yield _keys_of_xml(text)
        return
    # OpenCV 4 starts with "%YAML:1.0", which is not valid YAML; an empty line keeps the line numbers of messages right.
    text = re.sub(r"\A\s*%YAML:.*", "", text)
    documents = (document for document in yaml.load_all(text, _Loader) if document is not None)
    try:
        # "ros2 topic echo" ends each message with "---": the first document is the camera.
        keys = next(documents, None)
    except yaml.YAMLError as error:
        raise CalibrationError(f"is not YAML: {_yaml_message(error)}") from None
    except (ValueError, TypeError, RecursionError) as error:
        raise CalibrationError(f"is not YAML that describes a camera: {_unquoted(str(error))}") from None
    if keys is None:
        raise CalibrationError("is empty")
    if isinstance(keys, str) and re.match(r"\d+ [A-Z_]+ \d+ \d+ [-\d.]", keys):
        raise CalibrationError(
            "is a list of cameras by COLMAP; write the camera as camera_matrix, distortion_model and"
            " distortion_coefficients with image_width and image_height, and subtract 0.5 from its cx and cy"
        )
    if not isinstance(keys, Mapping):
        raise CalibrationError(f"holds no keys and values, but {kind_of(keys)}; glstar reads {DIALECTS}")
    yield keys
    try:
        yield from (other for other in documents if isinstance(other, Mapping))
    except (yaml.YAMLError, ValueError, TypeError, RecursionError):
        return  # the last message of a stream may be cut off


def _keys_of_xml(text: str) -> Keys:
    """Return the keys and values of a file that OpenCV writes into a file named .xml."""
    if "<!DOCTYPE" in text:
        raise CalibrationError("is XML with a document type, which OpenCV does not write")
    try:
        root = ET.fromstring(text.lstrip())  # noqa: S314 - no document type, thus no entities
    except (ET.ParseError, ValueError) as error:
        raise CalibrationError(f"is XML that cannot be read: {error}") from None
    if root.tag != "opencv_storage":
        raise CalibrationError(f"is XML of another program than OpenCV ({label(root.tag)}); glstar reads {DIALECTS}")
    if not len(root):
        raise CalibrationError("is empty")
    return _xml_values(list(root))


def _xml_values(nodes: list[ET.Element]) -> dict[object, object]:
    """Return the values of nodes by name; of one that occurs twice they must agree."""
    values: dict[object, object] = {}
    for node in nodes:
        value = _xml_value(node)
        if values.setdefault(node.tag, value) != value:
            raise CalibrationError(f"the key {label(node.tag)} occurs twice, with two values")
    return values


def _xml_value(node: ET.Element) -> object:
    """Return a number, a text, a list or a mapping; a matrix is a mapping with rows, cols and data."""
    children = list(node)
    if children and all(child.tag == "_" for child in children):
        return [_xml_value(child) for child in children]
    if children:
        return _xml_values(children)
    words = (node.text or "").split()
    try:
        numbers = [float(word) for word in words]
    except ValueError:
        return " ".join(words).strip('"')
    return numbers if node.tag == "data" or len(numbers) > 1 else numbers[0] if numbers else None


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
    hidden = re.sub(r"'([^']*)'", lambda quoted: quoted[0] if re.match("<|.?$", quoted[1]) else "'...'", message)
    return " ".join(hidden.split())[:200]


# Size limit of a calibration file, bytes: OpenCV's file with the corners of a hundred chessboards is smaller.
_LARGEST_BYTES = 2 * 2**20

# Plausible magnitude of the coefficients of a plumb_bob or fisheye lens; larger ones mean that the calibration failed.
_LARGEST_COEFFICIENT = 10.0

_ROS_NAMES: Mapping[LensModel, str] = {"rational": "rational_polynomial", "fisheye": "equidistant"}


def _camera_of_document(keys: Keys, name: str | None) -> tuple[Camera, tuple[str, ...]]:
    """Return the only camera of a file, or the one with the given name; and what was passed over or assumed."""
    chain = [key for key in keys if isinstance(key, str) and re.fullmatch(r"cam\d+", key)]
    orb_slam = sorted({match[1] for key in keys if (match := re.fullmatch(_ORB_SLAM, str(key)))})
    if chain:
        return _kalibr(keys, _chosen(chain, name))
    if "value0" in keys:
        return _basalt(keys["value0"], name)
    if orb_slam:
        return _orb_slam(keys, _chosen(orb_slam, name))
    if name is not None:
        raise CalibrationError(f"holds one camera, and none named {label(name)}")
    if "projection_parameters" in keys:
        return _camodocal(keys)
    entries = entries_of((str(key), value) for key, value in keys.items())
    if not any(key in entries for key in MATRIX_KEYS) and not all(key in entries for key in INTRINSIC_KEYS):
        raise CalibrationError(
            f"has no camera matrix under any name that glstar knows; it reads {DIALECTS}, and here"
            f" {_key_of_another_file(keys)}"
        )
    camera, notes = camera_of(entries)
    if "maxangledeg" in entries and camera.lens is not None:
        key, value = entries["maxangledeg"][0]
        camera = replace(camera, lens=replace(camera.lens, max_angle_rad=float(np.deg2rad(read_number(key, value)))))
    return camera, notes


def _key_of_another_file(keys: Keys) -> str:
    """Return the first key of a file that is not a camera file, unless it may be private text."""
    first = str(next(iter(keys), ""))
    return f"its first key is {first}" if re.fullmatch(r"[A-Za-z][\w.-]{0,39}", first) else "its keys are other ones"


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


# A camera of ORB-SLAM; in its stereo files, Camera is rectified, and LEFT and RIGHT are the cameras themselves.
_ORB_SLAM = r"(Camera\d?(?=\.fx)|LEFT(?=\.K)|RIGHT(?=\.K))\.(fx|K)"


def _orb_slam(keys: Keys, name: str) -> tuple[Camera, tuple[str, ...]]:
    """Return a camera of ORB-SLAM2 or ORB-SLAM3, with keys such as ``Camera.fx`` and ``Camera1.k1``."""
    own = {str(key): value for key, value in keys.items() if str(key).startswith(f"{name}.")}
    if name != "Camera":
        # Camera2 shares the size and the model of Camera, and no coefficient.
        for key in ("width", "height", "type"):
            if f"Camera.{key}" in keys and f"{name}.{key}" not in own:
                own[f"Camera.{key}"] = keys[f"Camera.{key}"]
    entries: dict[str, list[tuple[str, object]]] = {}
    for key, value in own.items():
        entries.setdefault(normalized(key.partition(".")[2]), []).append((key, value))
    # Keys of the lens; elsewhere `type` and `model` may be the name of a product.
    entries["cameramodel"] = [*entries.pop("type", ()), *entries.pop("model", ())]
    return camera_of(entries)


def _camodocal(keys: Keys) -> tuple[Camera, tuple[str, ...]]:
    """Return a camera in the format of camodocal, which VINS-Fusion and its relatives use."""
    entries = entries_of((str(key), value) for key, value in keys.items() if key not in _CAMODOCAL_SECTIONS)
    for group in _CAMODOCAL_SECTIONS:
        section = keys.get(group, {})
        if not isinstance(section, Mapping):
            raise CalibrationError(f"{group} holds no keys and values, but {kind_of(section)}")
        for key, value in section.items():
            entries.setdefault(normalized(key), []).append((f"{group}.{key}", value))
    theirs = {"gamma1": "fx", "gamma2": "fy", "u0": "cx", "v0": "cy"}
    if model_of(entries) == "omni":
        entries = {theirs.get(key, key): values for key, values in entries.items()}
    elif model_of(entries) == "fisheye":
        # r = theta + k2 theta^3 + k3 theta^5 + k4 theta^7 + k5 theta^9 is OpenCV's k1 to k4.
        theirs |= {"k2": "k1", "k3": "k2", "k4": "k3", "k5": "k4", "mu": "fx", "mv": "fy"}
        if "k1" in entries:
            raise CalibrationError(f"has {entries['k1'][0][0]}; the coefficients of KANNALA_BRANDT are k2 to k5")
        entries = {theirs.get(key, key): values for key, values in entries.items()}
    return camera_of(entries)


_CAMODOCAL_SECTIONS = ("projection_parameters", "distortion_parameters", "mirror_parameters")


def _kalibr(keys: Keys, name: str) -> tuple[Camera, tuple[str, ...]]:
    entry = keys[name]
    if not isinstance(entry, Mapping):
        raise CalibrationError(f"{name} holds no keys and values, but {kind_of(entry)}")
    entries = entries_of(((str(key), value) for key, value in entry.items()), f"{name}.")
    if not any(key in entries for key in MATRIX_KEYS) and not all(key in entries for key in INTRINSIC_KEYS):
        raise CalibrationError(f"{name} has no intrinsics: [fx, fy, cx, cy]")
    return camera_of(entries)


def _basalt(rig: object, name: str | None) -> tuple[Camera, tuple[str, ...]]:
    """Return a camera of Basalt's calibration.json; cameras are named cam0, cam1 ... in their order."""
    cameras = rig.get("intrinsics") if isinstance(rig, Mapping) else None
    sizes = rig.get("resolution") if isinstance(rig, Mapping) else None
    if not isinstance(cameras, list) or not isinstance(sizes, list) or len(cameras) != len(sizes):
        raise CalibrationError("has value0, as Basalt's files, without intrinsics and a resolution for each camera")
    chosen = int(_chosen([f"cam{k}" for k in range(len(cameras))], name)[3:])
    camera = cameras[chosen]
    numbers = camera.get("intrinsics") if isinstance(camera, Mapping) else None
    if not isinstance(numbers, Mapping):
        raise CalibrationError(f"value0.intrinsics holds no camera_type with intrinsics for cam{chosen}")
    named = dict(numbers) | {"resolution": sizes[chosen], "camera_model": camera.get("camera_type")}
    if named["camera_model"] == "ucm":  # an EUCM with beta = 1
        named |= {"camera_model": "eucm", "beta": 1.0}
    return camera_of(entries_of((str(key), value) for key, value in named.items()))


@dataclass(frozen=True, slots=True)
class CameraFile:
    """The camera of a file, and what was passed over or assumed."""

    camera: Camera
    notes: tuple[str, ...]


def read_camera_file(path: str | PathLike[str], name: str | None = None) -> CameraFile:
    """Return the camera of a file with notes for the user; see `camera_from_file`."""
    with reading(path, CalibrationError):
        return _read_camera_file(path, name)


def _read_camera_file(path: str | PathLike[str], name: str | None) -> CameraFile:
    try:
        documents = documents_of(read_text(path, _LARGEST_BYTES))
        camera, notes = _camera_of_document(next(documents), name)
        others = [keys for keys in islice(documents, _MOST_DOCUMENTS) if _is_another_camera(keys, name, camera)]
    except (CalibrationError, ValueError) as error:
        raise CalibrationError(str(error), path=path) from None
    except RecursionError:  # XML, or YAML with an alias of a value inside that value
        raise CalibrationError("is nested too deeply", path=path) from None
    if others:
        raise CalibrationError("holds several documents (---) with different cameras; keep one of them", path=path)
    return CameraFile(camera, notes)


def _is_another_camera(keys: Keys, name: str | None, camera: Camera) -> bool:
    try:
        return _camera_of_document(keys, name)[0] != camera
    except CalibrationError:
        return False


def camera_from_file(path: str | PathLike[str], name: str | None = None) -> Camera:
    """Return the camera that a calibration file describes.

    Parameters
    ----------
    path : path-like
        YAML, JSON or XML of OpenCV, ROS camera_info YAML, a Kalibr camchain, or a file of EuRoC, VINS-Fusion or
        ORB-SLAM.
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
        If the file cannot be read or contradicts itself, holds several cameras and none is named, lacks the named
        camera, the camera matrix or the image size, or has an unknown lens model or key of the lens.
    """
    return read_camera_file(path, name).camera


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

    ROS has no name for omni, double_sphere and eucm.  xi of omni is a key of its own, as OpenCV's omnidir writes it.
    Lines of `comments`, such as the origin of the numbers, are written at the top.  Reading it returns the same
    numbers.
    """
    lens = camera.lens
    K = camera.K
    projection = np.column_stack([K, np.zeros(3)])
    # ROS expects five numbers for a plumb_bob and eight for a rational_polynomial.
    model = "plumb_bob" if lens is None else lens.model
    coefficients = list(lens.coefficients) if lens is not None else []
    count = len(COEFFICIENTS[model])
    if model == "rational":
        count = next(count for count in (8, 12, 14) if len(coefficients) <= count)
    coefficients += [0.0] * (count - len(coefficients))
    mirror = [f"xi: {coefficients.pop(0)!r}"] if model == "omni" else []
    lines = [
        *(f"# {line}" for comment in comments for line in comment.splitlines()),
        f"image_width: {camera.width_px}",
        f"image_height: {camera.height_px}",
        "camera_name: glstar",
        *_yaml_matrix("camera_matrix", K),
        f"distortion_model: {_ROS_NAMES.get(model, model)}",
        *mirror,
        *([] if lens is None or "max_angle_deg" not in lens.keys else [f"max_angle_deg: {lens.keys['max_angle_deg']}"]),
        *_yaml_matrix("distortion_coefficients", np.array([coefficients])),
        *_yaml_matrix("rectification_matrix", np.eye(3)),
        *_yaml_matrix("projection_matrix", projection),
    ]
    return "\n".join(lines) + "\n"


def _yaml_matrix(name: str, matrix: Float) -> list[str]:
    numbers = ", ".join(repr(float(number)) for number in matrix.ravel())
    return [f"{name}:", f"  rows: {matrix.shape[0]}", f"  cols: {matrix.shape[1]}", f"  data: [{numbers}]"]
