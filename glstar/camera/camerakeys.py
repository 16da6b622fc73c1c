"""Keys of camera files: which hold the camera matrix, the image size and the lens.

The files of all programs are read by one rule.  Keys are compared without case, underscores and hyphens.  Several keys
may state the same thing, and must then agree.  A key that may carry the lens and that glstar does not know is an error,
and so is a lens model that glstar lacks.  Standard errors and the matrices of rectified images are passed over.
"""

import re
from collections.abc import Iterator, Mapping, Sequence
from math import isfinite
from reprlib import Repr
from typing import NoReturn, TypeVar, cast

import numpy as np

from glstar.arrays import Float
from glstar.camera.distortion import COEFFICIENTS, LENS_MODELS, Lens, LensModel
from glstar.camera.model import Camera
from glstar.errors import CalibrationError

Keys = Mapping[object, object]
# Keys as they are written, with their values, by normalized key.
Entries = Mapping[str, Sequence[tuple[str, object]]]
T = TypeVar("T")

_KNOWN_MODELS = (
    "glstar knows plumb_bob (radtan), rational_polynomial, fisheye (equidistant), omni, double_sphere (ds) and eucm:"
    " calibrate with one of these, or rectify the images"
)

# Limits a value quoted in a message to one short line, however large or deep it is.
_REPR = Repr()
_REPR.maxlist = _REPR.maxdict = _REPR.maxtuple = 9
_REPR.maxlevel = 1
_REPR.maxstring = _REPR.maxother = 60


def kind_of(value: object) -> str:
    """Return the kind of a value without its content, because the wrong file may be private."""
    return "a list" if isinstance(value, list) else "text" if isinstance(value, str) else "one value"


def normalized(key: object) -> str:
    """Return a key, or the name of a model, as its letters and digits in lower case."""
    return re.sub(r"[^a-z0-9]", "", (key if isinstance(key, str) else label(key)).lower())


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


# Names of the same key, normalized.
MATRIX_KEYS = ("cameramatrix", "k", "intrinsicmatrix", "intrinsics", "mtx")
INTRINSIC_KEYS = ("fx", "fy", "cx", "cy")
_WIDTH = ("imagewidth", "width", "imgwidth", "w")
_HEIGHT = ("imageheight", "height", "imgheight", "h")
_SIZE = ("imagesize", "resolution", "imgsize", "cameraresolution", "framesize", "imageresolution")
_COEFFICIENT_WORDS = ("coefficients", "coefficient", "coeffs", "coeff", "coefs", "coef", "parameters", "params")
_COEFFICIENTS = frozenset(
    f"{first}{last}" for first in ("dist", "distortion", "lensdistortion") for last in _COEFFICIENT_WORDS
) | {"d", "dist", "distortion", "distvec", "distortionvector"}
# Keys whose text is a lens model; an unknown one is an error.
_MODEL_KEYS = frozenset(
    f"{first}{last}"
    for first in ("distortion", "dist", "lens", "projection", "intrinsics")
    for last in ("model", "type", "modelname", "modeltype")
) | {"modeltype", "distortion", "cameramodel", "cameramodeltype", "cameraprojection", "projection"}
# Keys whose text may be a lens model, or the name of a product.
_MAYBE_MODEL_KEYS = frozenset(("model", "type", "lens", "cameratype", "camera", "calibrationmodel", "calibrationtype"))

# Names of lens models by other programs, normalized.  None: the file does not say how the lens distorts, or only that
# it is a pinhole before its distortion, and the number of coefficients decides, as in OpenCV's files.
_MODEL_NAMES: Mapping[LensModel | None, str] = {
    None: "pinhole perspective rectilinear opencv",
    "plumb_bob": "plumbbob radtan pinholeradtan radialtangential brown brownconrady",
    "rational": "rationalpolynomial rational fullopencv pinholefull thinprism pinholeradtan8",
    "fisheye": (
        "equidistant equi pinholeequi pinholeequidistant fisheye opencvfisheye fisheyeopencv "
        "cvfisheye cv2fisheye pinholefisheye fisheyeequidistant equidistantfisheye kb kb4 kb8 "
        "kannalabrandt kannalabrandt4 kannalabrandt8"
    ),
    "omni": "omni omniradtan omninone omnidir cvomnidir cv2omnidir omnidirectional mei",
    "double_sphere": "ds dsnone doublesphere",
    "eucm": "eucm eucmnone",
}
_MODELS = {"": None} | {name: model for model, names in _MODEL_NAMES.items() for name in names.split()}
# Coefficients of a lens that are written beside its camera matrix, not among its distortion coefficients.
_FIRST_STEP = {name: tuple(formulas.bounds) for name, formulas in LENS_MODELS.items() if formulas.bounds}
# Lens models that glstar lacks, where a text may be a lens model or the name of a product.
_LACKING = frozenset(
    {"ucm", "unified", "fov", "atan", "ftheta", "ocam", "ocamcalib", "division", "radialdivision"}
    | {"radial", "simpleradial", "polynomial", "spherical", "equirectangular", "equisolid", "stereographic"}
    | {"orthographic", "cylindrical", "panoramic", "inversebrownconrady", "modifiedbrownconrady"}
)
# Text that says that the images have no distortion.
_NO_DISTORTION = "none"
# In a key or a text: a lens that is no plumb_bob.
_WIDE = re.compile(r"fisheye|equidist|kannala|omni(?!vision)|doublesphere|eucm|scaramuzza")
# In a key: coefficients of a lens; standard errors; images after rectification.
_LENS_KEY = re.compile(r"distort|dist(coef|param|vec)|coef|radial|tangential|prism")
_ERROR_KEY = re.compile(r"^(std|sigma)|(std|stddev|stdev|stderr|sigma|err|errors?|uncertaint(y|ies)|cov(ariance)?)$")
_ERROR_WORDS = frozenset(
    ("std", "stddev", "stderr", "sigma", "error", "errors", "uncertainty", "variance", "covariance", "residuals")
)
_RECTIFIED_KEY = re.compile(r"undist|rectif")
# Names of single coefficients, normalized; k7 or p3 belong to models that glstar lacks.
_COEFFICIENT_NAME = re.compile(r"[kps]\d|tau[xy]")
# Numbers of coefficients of OpenCV's models.
_COUNTS: Mapping[LensModel, tuple[int, ...]] = {
    "plumb_bob": (4, 5),
    "rational": (4, 5, 8, 12, 14),
    "fisheye": (4,),
}
# Largest tangential coefficients of lenses; the last two of a fisheye's four are often larger.
_LARGEST_TANGENTIAL = 0.015
# Least focal length over the width of the image: a plumb_bob lens then sees 79 deg off its axis, a fisheye all around.
_LEAST_FOCAL: Mapping[LensModel, float] = {"plumb_bob": 0.1, "rational": 0.1}
_LEAST_WIDE_FOCAL = 0.03


def entries_of(items: Iterator[tuple[str, object]], prefix: str = "") -> dict[str, list[tuple[str, object]]]:
    """Return keys with their values by normalized key; `fx` and `k1` of a section count as keys of the file."""
    entries: dict[str, list[tuple[str, object]]] = {}
    for key, value in items:
        is_section = normalized(key) in _COEFFICIENTS or normalized(key) in MATRIX_KEYS
        if is_section and isinstance(value, Mapping) and ("fx" in value or "k1" in value):
            for inner, named in entries_of(((str(k), v) for k, v in value.items()), f"{prefix}{key}.").items():
                entries.setdefault(inner, []).extend(named)
        else:
            entries.setdefault(normalized(key), []).append((f"{prefix}{key}", value))
    return entries


def camera_of(entries: Entries) -> tuple[Camera, tuple[str, ...]]:
    """Return the camera of all dialects, and what was passed over or assumed."""
    _refuse_part_of_the_image(entries)
    notes = _passed_over(entries)
    named = model_of(entries)
    if named is None and any(_number(key, value) for key, value in entries.get("xi", ())):
        named = "omni"
        notes.append(f"{entries['xi'][0][0]} is not 0 and no key names the model: omni is assumed, OpenCV's omnidir")
    lens = _wide_lens(entries, named) if named is not None and named in _FIRST_STEP else _lens(entries, named, notes)
    width_px, height_px = _size(entries)
    fx_px, fy_px, cx_px, cy_px, skew_px = _intrinsics(entries, len(_FIRST_STEP.get(named or "", ())))
    camera = Camera(width_px, height_px, fx_px, fy_px, cx_px, cy_px, skew_px=skew_px, lens=lens)
    least = _LEAST_FOCAL.get("plumb_bob" if lens is None else lens.model, _LEAST_WIDE_FOCAL)
    if fx_px < least * width_px and fy_px < least * height_px:
        raise CalibrationError(
            f"has focal lengths of {fx_px:g} and {fy_px:g} for an image of {width_px} x {height_px} px: they are not in"
            " pixels, but normalized or in mm; write fx, fy, cx and cy in pixels"
        )
    return camera, tuple(notes)


def _agreed(claims: Sequence[tuple[str, T]]) -> T | None:
    """Return the value that keys agree on, or None if there is no key."""
    for key, value in claims[1:]:
        if value != claims[0][1]:
            first, first_value = claims[0]
            raise CalibrationError(
                f"{first} is {abbreviated(first_value)} and {key} is {abbreviated(value)}: they contradict each other;"
                " keep the key that describes the images"
            )
    return claims[0][1] if claims else None


def _intrinsics(entries: Entries, first: int) -> tuple[float, ...]:
    """Return fx, fy, cx, cy and skew, px; `first` coefficients of the lens may precede them in a list."""
    claims = [(key, _of_matrix(key, value, first)) for name in MATRIX_KEYS for key, value in entries.get(name, ())]
    if not claims or all(name in entries for name in INTRINSIC_KEYS):
        missing = [name for name in INTRINSIC_KEYS if name not in entries]
        if missing:
            raise CalibrationError(f"has no {', '.join(missing)}; a camera has fx, fy, cx and cy, px")
        numbers = [_agreed([(key, read_number(key, value)) for key, value in entries[name]]) for name in INTRINSIC_KEYS]
        skew_px = claims[0][1][4] if claims else 0.0
        claims.append((entries["fx"][0][0], (*(number or 0.0 for number in numbers), skew_px)))
    return _agreed(claims) or ()


def _of_matrix(key: str, value: object, first: int) -> tuple[float, ...]:
    """Return fx, fy, cx, cy and skew, px, of a 3 x 3 matrix or of Kalibr's intrinsics."""
    if isinstance(value, list) and not any(isinstance(row, list) for row in value):
        numbers = read_numbers(key, value)
        if len(numbers) in {4, 4 + first}:
            return (*numbers[-4:], 0.0)
        if len(numbers) != 9 and normalized(key.rpartition(".")[2]) == "intrinsics":
            raise CalibrationError(
                f"{key} holds {len(numbers)} numbers; a pinhole has 4: [fx, fy, cx, cy], omni 5: [xi, fx ...],"
                " double_sphere (ds) 6: [xi, alpha, fx ...], eucm 6: [alpha, beta, fx ...]; camera_model names it"
            )
    K = read_matrix(key, value)
    if K[1, 0] != 0 or not np.array_equal(K[2], [0.0, 0.0, 1.0]):
        rows = "; ".join(" ".join(f"{number:g}" for number in row) for row in K)
        raise CalibrationError(f"{key} is [{rows}]; a camera matrix is [fx skew cx; 0 fy cy; 0 0 1]")
    fx_px, skew_px, cx_px = K[0].tolist()
    _, fy_px, cy_px = K[1].tolist()
    return fx_px, fy_px, cx_px, cy_px, skew_px


def _size(entries: Entries) -> tuple[int, int]:
    """Return width and height, px."""
    claims: list[list[tuple[str, int]]] = [[], []]
    for key, value in (entry for name in _SIZE for entry in entries.get(name, ())):
        numbers = read_numbers(key, value)
        if len(numbers) != 2:
            raise CalibrationError(f"{key} holds {len(numbers)} numbers; it takes [width, height], px")
        for side, number in zip(claims, numbers, strict=True):
            side.append((key, read_integer(key, number)))
    for side, names in zip(claims, (_WIDTH, _HEIGHT), strict=True):
        for key, value in (entry for name in names for entry in entries.get(name, ())):
            side.append((key, read_integer(key, read_number(key, value))))
    width_px, height_px = _agreed(claims[0]), _agreed(claims[1])
    if width_px is None or height_px is None:
        raise CalibrationError(
            "does not give the image size; add it, px:"
            " image_width: and image_height: (in a Kalibr camchain, resolution: [width, height])"
        )
    return width_px, height_px


def _refuse_part_of_the_image(entries: Entries) -> None:
    """Reject ROS camera_info of binned or cropped images: its camera matrix is for the whole image before binning."""
    for key, value in (entry for name in ("binningx", "binningy") for entry in entries.get(name, ())):
        if read_number(key, value) > 1:
            raise CalibrationError(
                f"has {key} = {read_number(key, value):g}; its matrix is for the image before binning:"
                " give a calibration of the binned images, with binning 0"
            )
    for key, value in entries.get("roi", ()):
        window = value if isinstance(value, Mapping) else {}
        x_px, y_px, width_px, height_px = (
            read_number(f"{key}.{side}", window.get(side) or 0) for side in ("x_offset", "y_offset", "width", "height")
        )
        if x_px or y_px or (width_px and height_px and (width_px, height_px) != _size(entries)):
            raise CalibrationError(
                f"has {key} of {width_px:g} x {height_px:g} px at {x_px:g}, {y_px:g}; its matrix is for the whole"
                f" image: give the size of the cropped images, subtract {x_px:g} and {y_px:g} from cx and cy, and"
                f" remove {key}"
            )


def _is_standard_error(key: str) -> bool:
    words = {word.lower() for word in re.findall(r"[A-Z]+(?![a-z])|[A-Z]?[a-z]+", key)}
    return bool(words & _ERROR_WORDS) or _ERROR_KEY.search(normalized(key)) is not None


def _passed_over(entries: Entries) -> list[str]:
    """Return a note on keys near the lens that are not used; raise CalibrationError for one that may carry it."""
    passed = []
    for name, (key, value) in ((name, entry) for name, found in entries.items() for entry in found):
        if _is_standard_error(key) or _RECTIFIED_KEY.search(name):
            is_near = _LENS_KEY.search(name) or any(
                name.startswith(matrix) for matrix in MATRIX_KEYS if len(matrix) > 1
            )
            passed += [key] if is_near else []
        elif name == "mirrorparameters" and value:
            raise CalibrationError(f"has {key}, the mirror of an omnidirectional lens; write it as xi, a number")
        elif name not in _COEFFICIENTS | _MODEL_KEYS and _may_carry_the_lens(name, value):
            raise CalibrationError(
                f"has {key}, which glstar does not know and which may carry the lens; write the coefficients as"
                " distortion_coefficients and the model as distortion_model, or remove the key"
            )
    return [f"passed over as standard errors or rectified images: {', '.join(passed)}"] if passed else []


def _may_carry_the_lens(name: str, value: object) -> bool:
    """Return whether a key with an unknown name holds coefficients; flags (0, 1, true) and text do not."""
    if isinstance(value, list | Mapping):
        return bool(value) and (bool(_LENS_KEY.search(name) or _WIDE.search(name)) or name.startswith("lens"))
    is_number = isinstance(value, int | float) and value not in (0, 1)
    return is_number and _LENS_KEY.search(name) is not None


def model_of(entries: Entries) -> LensModel | str | None:
    """Return the model that the file names; ``"none"`` for no distortion, and None if it names no model."""
    claims: list[tuple[str, str]] = []
    for name, (key, value) in ((name, entry) for name, found in entries.items() for entry in found):
        text = normalized(value) if isinstance(value, str) else None
        if name in _MODEL_KEYS and (
            text is not None or (isinstance(value, int | float) and not isinstance(value, bool))
        ):
            model: str | None = _NO_DISTORTION if text == _NO_DISTORTION else _known_model(key, value)
        elif name in _MAYBE_MODEL_KEYS and text is not None:
            is_lens = _MODELS.get(text) is not None or text in _LACKING or _WIDE.search(text)
            model = _known_model(key, value) if is_lens else None
        elif "fisheye" in name and not isinstance(value, list | Mapping):
            model = "fisheye" if _is_true(value) else _MODELS.get(text or "")
            claims += [(key, "no fisheye")] if _is_false(value) else []
        elif _WIDE.search(name) and _is_true(value):
            model = _known_model(key, name)
        else:
            model = None
        claims += [(key, model)] if model else []
    refused = [key for key, model in claims if model == "no fisheye"]
    named = [(key, model) for key, model in claims if model != "no fisheye"]
    if refused and any(model == "fisheye" for _, model in named):
        _agreed([named[0], (refused[0], "no fisheye")])
    if any(model in _FIRST_STEP for _, model in named):
        # The other name is that of the second step: Kalibr's camera_model: omni with distortion_model: radtan.
        named = [claim for claim in named if claim[1] not in {"plumb_bob", _NO_DISTORTION}]
    return _agreed(named)


def _known_model(key: str, value: object) -> LensModel | None:
    """Return the model with some name; raise CalibrationError if glstar lacks it."""
    name = normalized(value)
    if name not in _MODELS:
        raise CalibrationError(f"has a lens of the model {label(value)} ({key}); {_KNOWN_MODELS}")
    return _MODELS[name]


def _is_true(value: object) -> bool:
    return value in (True, 1) or (isinstance(value, str) and value.strip().lower() in ("true", "yes", "on", "1"))


def _is_false(value: object) -> bool:
    is_text = isinstance(value, str) and value.strip().lower() in ("false", "no", "off", "0")
    return is_text or (value is not None and value in (False, 0))


def _number(key: str, value: object) -> float:
    """Return a number, or the only number of a matrix."""
    numbers = read_numbers(key, value) if isinstance(value, list | Mapping) else [read_number(key, value)]
    if len(numbers) != 1:
        raise CalibrationError(f"{key} holds {len(numbers)} numbers; it is one number")
    return numbers[0]


def _coefficient_lists(entries: Entries) -> list[tuple[str, tuple[float, ...]]]:
    """Return the lists of coefficients with their keys."""
    return [
        (key, tuple(read_numbers(key, value)))
        for name in entries
        if name in _COEFFICIENTS
        for key, value in entries[name]
        if value is not None and not isinstance(value, str)
    ]


def _wide_lens(entries: Entries, model: str) -> Lens:
    """Return a lens of two steps (omni), or of one whose coefficients are beside the camera matrix."""
    first = _FIRST_STEP[model]
    second = COEFFICIENTS[model][len(first) :]
    named = [
        (entries[name][0][0], _agreed([(key, _number(key, value)) for key, value in entries[name]]))
        for name in first
        if name in entries
    ]
    claims = [(named[0][0], tuple(number or 0.0 for _, number in named))] if len(named) == len(first) else []
    for key, value in (entry for name in MATRIX_KEYS for entry in entries.get(name, ())):
        if isinstance(value, list) and not any(isinstance(row, list) for row in value) and len(value) == 4 + len(first):
            claims.append((key, tuple(read_numbers(key, value)[: len(first)])))
    lists = []
    for key, numbers in _coefficient_lists(entries):
        count = len(numbers) if any(numbers[len(second) :]) else min(len(numbers), len(second))
        if not second and len(numbers) == len(first):
            claims.append((key, numbers))
        elif count > len(second):
            raise CalibrationError(
                f"{key} holds {len(numbers)} numbers; a {model} lens has {', '.join(second) or 'none'}"
            )
        elif count:
            lists.append((key, numbers[:count]))
    coefficients = _agreed(claims)
    if coefficients is None:
        raise CalibrationError(
            f"has no {' and '.join(name for name in first if name not in entries)}; a lens of the model {model} has"
            f" {', '.join(COEFFICIENTS[model])} (of Kalibr, intrinsics: [{', '.join(first)}, fx, fy, cx, cy])"
        )
    listed, by_name = _agreed(lists), _coefficients_by_name(entries)
    known = (
        dict(zip(second, listed, strict=False))
        if listed
        else {name: by_name[name][1] for name in second if name in by_name}
    )
    _require_same(known, by_name, model)
    return Lens(cast(LensModel, model), (*coefficients, *(known.get(name, 0.0) for name in second if known)))


def _lens(entries: Entries, named: str | None, notes: list[str]) -> Lens | None:
    """Return the lens of a file, of the named model; None for a pinhole."""
    for key, value in entries.get("xi", ()):
        if _number(key, value):
            raise CalibrationError(
                f"has {key} = {_number(key, value):g}, the mirror of an omnidirectional lens, and names the model"
                f" {named}: they contradict each other; keep the key that describes the lens"
            )
    claims = _coefficient_lists(entries)
    # Empty lists say nothing.
    listed = _agreed([claim for claim in claims if claim[1]]) or ()
    by_name = _coefficients_by_name(entries)
    if listed:
        coefficients, model = listed, _model_of_count(named, claims, notes)
        _require_same(dict(zip(COEFFICIENTS[model], listed, strict=False)), by_name, claims[0][0])
    else:
        model = _model_of_names(named, by_name)
        coefficients = tuple(by_name[name][1] if name in by_name else 0.0 for name in COEFFICIENTS[model])
        _require_same(dict.fromkeys(set(by_name) & set(COEFFICIENTS[model])), by_name, model)
    if named == _NO_DISTORTION and any(coefficients):
        raise CalibrationError("says that the lens does not distort (none), and has coefficients; remove one of them")
    # A fisheye distorts even if all coefficients are zero: r = f theta, where a pinhole has r = f tan(theta).
    if named is None:
        _refuse_hints(entries)
    return Lens(model, coefficients) if model == "fisheye" or any(coefficients) else None


def _coefficients_by_name(entries: Entries) -> dict[str, tuple[str, float]]:
    """Return coefficients with a key each: name to key and number.  P1 of stereo files is a matrix."""
    names = {normalized(name): name for name in COEFFICIENTS["rational"]}
    found = {}
    for name in filter(_COEFFICIENT_NAME.fullmatch, entries):
        scalars = [(key, value) for key, value in entries[name] if not isinstance(value, list | Mapping)]
        if scalars:
            number = _agreed([(key, read_number(key, value)) for key, value in scalars])
            found[names.get(name, name)] = (scalars[0][0], number or 0.0)
    return found


def _require_same(known: Mapping[str, float | None], by_name: Mapping[str, tuple[str, float]], of: str) -> None:
    """Raise CalibrationError if a coefficient with its own key is none of the lens, or has another value."""
    for name, (key, number) in by_name.items():
        value = known.get(name, 0.0)
        if value is not None and number != value:
            raise CalibrationError(
                f"has {key} = {number:g}, and {name} of {of} is {value:g}: they contradict each other; keep the key"
                " that describes the lens"
            )


def _model_of_count(named: str | None, claims: Sequence[tuple[str, tuple[float, ...]]], notes: list[str]) -> LensModel:
    """Return the model of a list of coefficients: the named one, or the one that OpenCV takes for their number."""
    key, numbers = next(claim for claim in claims if claim[1])
    by_count: LensModel = "plumb_bob" if len(numbers) <= len(COEFFICIENTS["plumb_bob"]) else "rational"
    # ROS drivers name plumb_bob before eight coefficients, and OpenCV goes by their number.
    model: LensModel = "fisheye" if named == "fisheye" else "rational" if named == "rational" else by_count
    if len(numbers) <= len(COEFFICIENTS[model]) and len(numbers) not in _COUNTS[model]:
        counts = " or ".join(str(count) for count in _COUNTS[model])
        raise CalibrationError(f"{key} holds {len(numbers)} numbers; a {model} lens has {counts}")
    if named is None and len(numbers) == _COUNTS["fisheye"][0] and any(numbers):
        if max(abs(number) for number in numbers[2:]) > _LARGEST_TANGENTIAL:
            raise CalibrationError(
                f"{key} has four numbers, no key names the model, and the last two are too large for the tangential"
                " distortion of a plumb_bob; add distortion_model: equidistant (a fisheye), or plumb_bob"
            )
        notes.append(
            f"{key} has four numbers and no key names the model: plumb_bob is assumed; for a fisheye, add"
            " distortion_model: equidistant"
        )
    return model


def _model_of_names(named: str | None, by_name: Mapping[str, tuple[str, float]]) -> LensModel:
    """Return the model of coefficients with a key each."""
    model: LensModel = "fisheye" if named == "fisheye" else "rational" if named == "rational" else "plumb_bob"
    beyond = [name for name in ("k4", "k5", "k6") if by_name.get(name, ("", 0.0))[1]]
    if named is None and beyond:
        if "k6" not in by_name:
            raise CalibrationError(
                f"has {', '.join(key for key, _ in by_name.values())} and no key names the model of the lens; add"
                " distortion_model: equidistant (a fisheye) or rational_polynomial"
            )
        return "rational"
    return model


def _refuse_hints(entries: Entries) -> None:
    """Raise CalibrationError if the lens has no model, and some text says that it is a fisheye or wider."""
    for key, value in (entry for found in entries.values() for entry in found):
        if isinstance(value, str) and _WIDE.search(normalized(value)):
            raise CalibrationError(
                f"has {key} = {label(value)} and no key names the model of the lens; add distortion_model: equidistant"
                " (a fisheye) or plumb_bob"
            )
