"""YAML of calibration files: the keys at the top level, and checked values with short messages."""

import re
from collections.abc import Mapping
from math import isfinite
from reprlib import Repr
from typing import NoReturn

import numpy as np
import yaml
from numpy.typing import NDArray

from glstar.errors import CalibrationError

__all__ = [
    "DIALECTS",
    "Keys",
    "abbreviated",
    "kind_of",
    "label",
    "normalized",
    "read_integer",
    "read_matrix",
    "read_number",
    "read_numbers",
    "top_level_keys",
]

Float = NDArray[np.float64]
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
