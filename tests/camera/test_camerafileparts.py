"""Dialects of camera files as dictionaries and short texts: what each one reads, and its messages."""

import numpy as np
import pytest

from glstar.camera.camerafile import (
    _camera_of_document,
    _key_of_another_file,
    _unquoted,
    camera_to_yaml,
    camera_warnings,
    documents_of,
)
from glstar.camera.distortion import Lens
from glstar.camera.model import Camera
from glstar.errors import CalibrationError

PINHOLE = Camera(640, 480, 500.0, 510.0, 320.5, 239.5)
FOUR = {"fx": 500.0, "fy": 510.0, "cx": 320.5, "cy": 239.5}
SIZE = {"image_width": 640, "image_height": 480}


def camera(keys: dict, name: str | None = None) -> Camera:
    return _camera_of_document(keys, name)[0]


def refusal(keys: dict, name: str | None = None) -> str:
    with pytest.raises(CalibrationError) as caught:
        _camera_of_document(keys, name)
    return str(caught.value)


def kalibr(**more: object) -> dict:
    return {"intrinsics": [500, 510, 320.5, 239.5], "resolution": [640, 480], **more}


def test_a_camchain_has_the_camera_of_a_name() -> None:
    keys = {"cam0": kalibr(), "cam1": kalibr(resolution=[64, 48]), "camera": 5}
    assert camera(keys, "cam0") == PINHOLE
    assert camera(keys, "cam1").width_px == 64
    assert camera({"cam7": kalibr()}) == PINHOLE
    assert refusal(keys, "cam2") == "holds cam0, cam1, and no camera named cam2"
    assert refusal(keys) == (
        'holds 2 cameras (cam0, cam1); in a config, set camera = "cam0" beside file; or write one to a file of its own:'
        " glstar camera show FILE --camera cam0 -o cam0.yaml"
    )
    assert refusal({"cam0": {"resolution": [1, 2], "fx": 3}}) == "cam0 has no intrinsics: [fx, fy, cx, cy]"
    assert refusal({"cam0": [1]}) == "cam0 holds no keys and values, but a list"
    assert camera({"cam0": FOUR | {"resolution": [640, 480]}}) == PINHOLE
    assert refusal({**FOUR, **SIZE}, "left") == "holds one camera, and none named left"


def basalt(*cameras: object, sizes: object = ((640, 480),)) -> dict:
    return {"value0": {"intrinsics": list(cameras), "resolution": [list(one) for one in sizes]}}


def test_basalt_names_its_cameras_in_order() -> None:
    pinhole = {"camera_type": "pinhole", "intrinsics": FOUR}
    assert camera(basalt(pinhole)) == PINHOLE
    wide = {"camera_type": "ds", "intrinsics": FOUR | {"xi": -0.2, "alpha": 0.6}}
    both = basalt(pinhole, wide, sizes=((640, 480), (64, 48)))
    assert camera(both, "cam1") == Camera(64, 48, 500.0, 510.0, 320.5, 239.5, lens=Lens("double_sphere", (-0.2, 0.6)))
    unified = {"camera_type": "ucm", "intrinsics": FOUR | {"alpha": 0.6}}
    assert camera(basalt(unified)).lens == Lens("eucm", (0.6, 1.0))
    said = "has value0, as Basalt's files, without intrinsics and a resolution for each camera"
    for wrong in (
        {"value0": 5},
        {"value0": {"intrinsics": {}, "resolution": [[1, 2]]}},
        {"value0": {"intrinsics": [pinhole], "resolution": {}}},
        {"value0": {"intrinsics": [pinhole], "resolution": 3}},
        basalt(pinhole, sizes=((1, 2), (3, 4))),
    ):
        assert refusal(wrong) == said
    assert refusal(basalt({"camera_type": "ds"})) == "value0.intrinsics holds no camera_type with intrinsics for cam0"
    assert refusal(basalt(5)) == "value0.intrinsics holds no camera_type with intrinsics for cam0"


def test_orb_slam_shares_size_and_model_between_its_cameras() -> None:
    one = {f"Camera.{key}": value for key, value in (FOUR | {"width": 640, "height": 480}).items()}
    assert camera(one) == PINHOLE
    assert camera(one | {"Camera.k1": 0.1, "Camera.k2": 0.02}).lens == Lens("plumb_bob", (0.1, 0.02, 0.0, 0.0, 0.0))
    shared = {"Camera.type": "KannalaBrandt8", "Camera.width": 640, "Camera.height": 480}
    two = shared | {f"Camera{n}.{key}": value + n for n in (1, 2) for key, value in (FOUR | {"k1": 0.1}).items()}
    assert camera(two, "Camera2") == Camera(640, 480, 502.0, 512.0, 322.5, 241.5, lens=Lens("fisheye", (2.1, 0, 0, 0)))
    assert refusal(two).startswith("holds 2 cameras (Camera1, Camera2)")
    own = camera(two | {"Camera1.width": 800}, "Camera1")
    assert (own.width_px, own.height_px) == (800, 480)
    matrix = {"rows": 3, "cols": 3, "data": [500, 0, 320.5, 0, 510, 239.5, 0, 0, 1]}
    stereo = {"LEFT.K": matrix, "LEFT.width": 640, "LEFT.height": 480, "RIGHT.K": matrix}
    assert camera(stereo, "LEFT") == PINHOLE


def test_vins_fusion_has_sections() -> None:
    sections = {"projection_parameters": FOUR, "distortion_parameters": {"k1": 0.1, "p1": 0.01}}
    plain = sections | {"model_type": "PINHOLE", **SIZE}
    assert camera(plain) == Camera(640, 480, 500.0, 510.0, 320.5, 239.5, lens=Lens("plumb_bob", (0.1, 0, 0.01, 0, 0)))
    mei = {
        "model_type": "MEI",
        "mirror_parameters": {"xi": 1.2},
        "distortion_parameters": {"k1": 0.1},
        "projection_parameters": {"gamma1": 500.0, "gamma2": 510.0, "u0": 320.5, "v0": 239.5},
        **SIZE,
    }
    assert camera(mei) == Camera(640, 480, 500.0, 510.0, 320.5, 239.5, lens=Lens("omni", (1.2, 0.1, 0, 0, 0)))
    theirs = {"k2": 0.1, "k3": 0.2, "k4": 0.3, "k5": 0.4, "mu": 500.0, "mv": 510.0, "u0": 320.5, "v0": 239.5}
    kannala = {"model_type": "KANNALA_BRANDT", "projection_parameters": theirs, **SIZE}
    assert camera(kannala) == Camera(640, 480, 500.0, 510.0, 320.5, 239.5, lens=Lens("fisheye", (0.1, 0.2, 0.3, 0.4)))
    first = kannala | {"projection_parameters": theirs | {"k1": 0.5}}
    assert refusal(first) == "has projection_parameters.k1; the coefficients of KANNALA_BRANDT are k2 to k5"
    no_section = plain | {"distortion_parameters": 5}
    assert refusal(no_section) == "distortion_parameters holds no keys and values, but one value"


def test_the_end_of_the_image_circle_is_an_angle() -> None:
    keys = {**FOUR, **SIZE, "max_angle_deg": 95.0}
    fisheye = camera(keys | {"D": [0.1, 0, 0, 0], "distortion_model": "fisheye"})
    assert fisheye.lens == Lens("fisheye", (0.1, 0.0, 0.0, 0.0), float(np.deg2rad(95.0)))
    assert camera(keys) == PINHOLE


def test_the_first_key_of_another_file_is_named_unless_it_may_be_private() -> None:
    assert _key_of_another_file({"some.key-1": 3}) == "its first key is some.key-1"
    assert _key_of_another_file({"a" * 40: 3}) == f"its first key is {'a' * 40}"
    for key in ("a" * 41, "1a", "my words", ""):
        assert _key_of_another_file({key: 3}) == "its keys are other ones"
    assert _key_of_another_file({}) == "its keys are other ones"


def test_values_of_xml_are_numbers_texts_lists_and_matrices() -> None:
    text = """ <?xml version="1.0"?>
    <opencv_storage>
    <a>5</a> <b>1 2.5</b> <c>"some text"</c> <d></d> <e><_>1</_><_>x</_></e>
    <f type_id="opencv-matrix"><rows>1</rows><cols>1</cols><dt>d</dt><data>7</data></f> <a>5</a>
    </opencv_storage>"""
    [keys] = documents_of(text)
    matrix = {"rows": 1.0, "cols": 1.0, "dt": "d", "data": [7.0]}
    assert keys == {"a": 5.0, "b": [1.0, 2.5], "c": "some text", "d": None, "e": [1.0, "x"], "f": matrix}


def test_values_of_yaml_are_plain() -> None:
    lines = ["%YAML:1.0", "---", "a: 010", "b: 1e-5", "c: -.5", "d: .nan", "e: 12:30", "f: yes", "g: 2024-01-02"]
    text = "\n".join([*lines, "h: !!opencv-nd-matrix [1, [2]]", ""])
    [keys] = documents_of(text)
    assert str(keys.pop("d")) == "nan"
    assert keys == {"a": "010", "b": "1e-5", "c": -0.5, "e": "12:30", "f": True, "g": "2024-01-02", "h": [1, [2]]}
    assert list(documents_of("a: 1\n---\n---\nb: 2\n---\n- 3\n---\nc: [\n")) == [{"a": 1}, {"b": 2}]
    assert list(documents_of("a: !!opencv-x 5\n")) == [{"a": None}]
    # The same key with the same value is no contradiction.
    assert list(documents_of("a: 1\na: 1\n")) == [{"a": 1}]
    with pytest.raises(
        CalibrationError, match="is not YAML: line 2, column 1: the key a occurs twice, with two values"
    ):
        next(documents_of("a: 1\na: 2\n"))


def test_messages_of_parsers_do_not_quote_the_file() -> None:
    assert _unquoted("found  'secret' and '<key>' and 'a'") == "found '...' and '<key>' and 'a'"
    assert (
        _unquoted("expected '<document start>', but found '<scalar>'")
        == "expected '<document start>', but found '<scalar>'"
    )
    assert _unquoted("expected '<a>', but found 'secret'") == "expected '<a>', but found '...'"
    assert len(_unquoted("x" * 300)) == 200


def test_implausible_cameras_are_warned_of() -> None:
    assert camera_warnings(PINHOLE) == ()
    outside = Camera(640, 480, 500.0, 510.0, 639.6, 239.5)
    assert camera_warnings(outside) == (
        "the principal point (639.6, 239.5) lies outside the image of 640 x 480 px: is the file for an image of"
        " another size,"
        " or was the image cropped?",
    )
    assert camera_warnings(Camera(640, 480, 500.0, 510.0, 639.4, 239.5)) == ()
    strong = Camera(640, 480, 500.0, 510.0, 320.5, 239.5, lens=Lens("plumb_bob", (0.1, -10.1, 0.0, 0.0, 10.0)))
    assert camera_warnings(strong) == (
        "k2 = -10.1: coefficients of real lenses are rarely above 10; a narrow view, or points near the image"
        " centre only,"
        " do not determine them: calibrate with fewer coefficients",
    )
    rational = Camera(640, 480, 500.0, 510.0, 320.5, 239.5, lens=Lens("rational", (0.1, 10.2, 0, 0, 0, 0, 10.2)))
    assert camera_warnings(rational) == ()


@pytest.mark.parametrize(
    ("lens", "model", "coefficients", "more"),
    [
        (None, "plumb_bob", [0.0] * 5, ""),
        (Lens("plumb_bob", (0.1, 0.2)), "plumb_bob", [0.1, 0.2, 0.0, 0.0, 0.0], ""),
        (Lens("rational", (0.1,) * 8), "rational_polynomial", [0.1] * 8, ""),
        (Lens("rational", (0.1,) * 9), "rational_polynomial", [0.1] * 9 + [0.0] * 3, ""),
        (Lens("rational", (0.1,) * 12), "rational_polynomial", [0.1] * 12, ""),
        (Lens("rational", (0.1,) * 13), "rational_polynomial", [0.1] * 13 + [0.0], ""),
        (
            Lens("fisheye", (0.1,), float(np.deg2rad(95.0))),
            "equidistant",
            [0.1, 0.0, 0.0, 0.0],
            "max_angle_deg: 95.0\n",
        ),
        (Lens("omni", (1.2, 0.1)), "omni", [0.1, 0.0, 0.0, 0.0], "xi: 1.2\n"),
        (Lens("eucm", (0.6, 1.1)), "eucm", [0.6, 1.1], ""),
    ],
)
def test_a_camera_is_written_as_camera_info(lens: Lens | None, model: str, coefficients: list, more: str) -> None:
    one = Camera(640, 480, 500.0, 510.0, 320.5, 239.5, 0.25, lens)
    assert camera_to_yaml(one, "first\nsecond", "third") == (
        "# first\n# second\n# third\nimage_width: 640\nimage_height: 480\ncamera_name: glstar\n"
        "camera_matrix:\n  rows: 3\n  cols: 3\n  data: [500.0, 0.25, 320.5, 0.0, 510.0, 239.5, 0.0, 0.0, 1.0]\n"
        f"distortion_model: {model}\n{more}"
        f"distortion_coefficients:\n  rows: 1\n  cols: {len(coefficients)}\n  data: {coefficients}\n"
        "rectification_matrix:\n  rows: 3\n  cols: 3\n  data: [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0]\n"
        "projection_matrix:\n  rows: 3\n  cols: 4\n"
        "  data: [500.0, 0.25, 320.5, 0.0, 0.0, 510.0, 239.5, 0.0, 0.0, 0.0, 1.0, 0.0]\n"
    )
