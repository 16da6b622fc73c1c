"""Keys of camera files as dictionaries: each rule with what it reads, what it refuses, and the whole message."""

import numpy as np
import pytest

from glstar.camera.camerakeys import (
    abbreviated,
    camera_of,
    entries_of,
    kind_of,
    label,
    model_of,
    normalized,
    read_integer,
    read_matrix,
    read_number,
    read_numbers,
)
from glstar.camera.distortion import Lens
from glstar.camera.model import Camera
from glstar.errors import CalibrationError

BASE = {"width": 640, "height": 480, "fx": 500.0, "fy": 510.0, "cx": 320.5, "cy": 239.5}
PINHOLE = Camera(640, 480, 500.0, 510.0, 320.5, 239.5)
MATRIX = [500.0, 0.25, 320.5, 0.0, 510.0, 239.5, 0.0, 0.0, 1.0]
MATRIX_3 = {"rows": 3, "cols": 3, "data": [500, 0, 320.5, 0, 510, 239.5, 0, 0, 1]}
KNOWN = (
    "glstar knows plumb_bob (radtan), rational_polynomial, fisheye (equidistant), omni, double_sphere (ds) and eucm:"
    " calibrate with one of these, or rectify the images"
)


def read(keys: dict) -> tuple[Camera, tuple[str, ...]]:
    return camera_of(entries_of(iter(keys.items())))


def lens_of(**keys: object) -> Lens | None:
    return read(BASE | keys)[0].lens


def refusal(keys: dict) -> str:
    with pytest.raises(CalibrationError) as caught:
        read(keys)
    return str(caught.value)


# --- values -----------------------------------------------------------------------------------------------------------


def test_values_are_short_in_messages() -> None:
    assert [kind_of(value) for value in ([1], "x", 3)] == ["a list", "text", "one value"]
    assert normalized("Camera_Matrix-1 .K") == "cameramatrix1k"
    assert normalized(12) == "12"
    assert (abbreviated("ab"), label("ab"), label(5)) == ("'ab'", "ab", "5")
    assert abbreviated(list(range(12))) == "[0, 1, 2, 3, 4, 5, 6, 7, 8, ...]"
    assert abbreviated(dict.fromkeys(range(10), 0)).count(":") == 9
    assert abbreviated([[1, 2], [3]]) == "[[...], [...]]"
    assert (len(abbreviated("x" * 100)), len(abbreviated("x" * 58))) == (60, 60)


def test_numbers_may_be_texts_lists_and_matrices() -> None:
    assert [read_number("a", value) for value in (3, 2.5, "1e-5", "-4")] == [3.0, 2.5, 1e-5, -4.0]
    assert read_numbers("a", [1, [2, "3"], 4]) == [1.0, 2.0, 3.0, 4.0]
    assert read_numbers("a", {"rows": 1, "data": [5, 6]}) == [5.0, 6.0]
    np.testing.assert_array_equal(
        read_matrix("K", {"rows": 3, "cols": 3, "data": list(range(9))}), np.arange(9).reshape(3, 3)
    )
    assert (read_integer("w", 1.0), read_integer("w", 640.0)) == (1, 640)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: read_number("a", True), "a must be a number, not True"),
        (lambda: read_number("a", None), "a must be a number, not None"),
        (lambda: read_number("a", "x1"), "a must be a number, not 'x1'"),
        (lambda: read_number("a", ".Nan"), "a holds nan; it must be a finite number"),
        (lambda: read_number("a", "inf"), "a holds inf; it must be a finite number"),
        (lambda: read_number("a", 10**400), f"a must be a number, not {abbreviated(10**400)}"),
        (lambda: read_numbers("a", 5), "a must be a list of numbers, not 5"),
        (lambda: read_numbers("a", {"rows": 1}), "a has no data: [...]"),
        (lambda: read_numbers("a", {"data": [1, "y"]}), "a.data must be a number, not 'y'"),
        (lambda: read_matrix("K", [1, 2, 3]), "K holds 3 numbers; a camera matrix has 9, row by row"),
        (lambda: read_matrix("K", {"rows": 3, "cols": 4}), "K is 3 x 4; a camera matrix has rows: 3, cols: 3"),
        (lambda: read_integer("w", 0.0), "w is 0; the size of an image is an integer of 1 or more, px"),
        (lambda: read_integer("w", 2.5), "w is 2.5; the size of an image is an integer of 1 or more, px"),
    ],
)
def test_what_is_no_number_is_refused(call, message: str) -> None:
    with pytest.raises(CalibrationError) as caught:
        call()
    assert str(caught.value) == message


# --- size and matrix --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "keys",
    [
        BASE,
        {"image_size": [640, 480], "camera_matrix": [[500, 0, 320.5], [0, 510, 239.5], [0, 0, 1]]},
        {"resolution": [640, 480], "intrinsics": [500, 510, 320.5, 239.5]},
        {"ImageWidth": 640, "img-height": "480", "K": [500, 0, 320.5, 0, 510, 239.5, 0, 0, 1]},
        {"w": 640, "h": 480, "width": 640, "frame_size": [640, 480], "mtx": MATRIX_3},
        {"width": 640, "height": 480, "intrinsics": {"fx": 500, "fy": 510, "cx": 320.5, "cy": 239.5}},
        BASE | {"K": [500, 0, 320.5, 0, 510, 239.5, 0, 0, 1]},
        BASE | {"xi": 0.0, "distortion": None, "D": []},
    ],
)  # fmt: skip
def test_a_pinhole_is_read_in_all_spellings(keys: dict) -> None:
    assert read(keys) == (PINHOLE, ())


def test_a_matrix_may_have_a_skew_and_keys_must_agree_with_it() -> None:
    keys = {"width": 640, "height": 480, "K": MATRIX}
    assert read(keys)[0].skew_px == 0.25
    assert read(BASE | {"K": MATRIX})[0].skew_px == 0.25
    other = [501.0, *MATRIX[1:]]
    assert refusal(BASE | {"K": other}) == (
        "K is (501.0, 510.0, 320.5, 239.5, 0.25) and fx is (500.0, 510.0, 320.5, 239.5, 0.25): they contradict"
        " each other;"
        " keep the key that describes the images"
    )


@pytest.mark.parametrize(
    ("keys", "message"),
    [
        ({"width": 640, "height": 480, "fx": 1, "cy": 2}, "has no fy, cx; a camera has fx, fy, cx and cy, px"),
        ({"width": 640, "height": 480}, "has no fx, fy, cx, cy; a camera has fx, fy, cx and cy, px"),
        ({"width": 640, "K": MATRIX}, "does not give the image size; add it, px: image_width: and image_height:"
                                      " (in a Kalibr"
                                      " camchain, resolution: [width, height])"),
        ({"image_size": [640, 480, 3], "K": MATRIX}, "image_size holds 3 numbers; it takes [width, height], px"),
        (BASE | {"w": 641}, "width is 640 and w is 641: they contradict each other; keep the key that describes"
                            " the images"),
        ({"width": 640, "height": 480, "intrinsics": [1, 2, 3]}, "intrinsics holds 3 numbers; a pinhole has 4:"
                                                                 " [fx, fy, cx, cy],"
         " omni 5: [xi, fx ...], double_sphere (ds) 6: [xi, alpha, fx ...], eucm 6: [alpha, beta, fx ...];"
         " camera_model names it"),
        ({"width": 640, "height": 480, "K": [1, 2, 3]}, "K holds 3 numbers; a camera matrix has 9, row by row"),
        ({"width": 640, "height": 480, "K": [5, 0, 3, 0.5, 5, 3, 0, 0, 1]}, "K is [5 0 3; 0.5 5 3; 0 0 1]; a"
                                                                            " camera matrix is"
                                                                            " [fx skew cx; 0 fy cy; 0 0 1]"),
        ({"width": 640, "height": 480, "K": [5, 0, 3, 0, 5, 3, 0, 0, 2]}, "K is [5 0 3; 0 5 3; 0 0 2]; a camera"
                                                                          " matrix is"
                                                                          " [fx skew cx; 0 fy cy; 0 0 1]"),
        (BASE | {"binning_x": 2}, "has binning_x = 2; its matrix is for the image before binning: give a"
                                  " calibration of the binned"
                                  " images, with binning 0"),
        (BASE | {"roi": {"x_offset": 5, "width": 10, "height": 20}}, "has roi of 10 x 20 px at 5, 0; its matrix"
                                                                     " is for the whole"
         " image: give the size of the cropped images, subtract 5 and 0 from cx and cy, and remove roi"),
        (BASE | {"roi": {"y_offset": 7}}, "has roi of 0 x 0 px at 0, 7; its matrix is for the whole image: give"
                                          " the size of the"
         " cropped images, subtract 0 and 7 from cx and cy, and remove roi"),
        (BASE | {"roi": {"width": 10, "height": 20}}, "has roi of 10 x 20 px at 0, 0; its matrix is for the"
                                                      " whole image: give the"
         " size of the cropped images, subtract 0 and 0 from cx and cy, and remove roi"),
    ],
)  # fmt: skip
def test_what_is_no_camera_is_refused(keys: dict, message: str) -> None:
    assert refusal(keys) == message


def test_an_image_that_is_whole_is_read() -> None:
    for keys in (
        {"binning_x": 1, "binning_y": 0}, {"roi": {"width": 640, "height": 480}}, {"roi": {"width": 0, "height": 0}},
        {"roi": {"width": 0, "height": 20}}, {"roi": True}, {"radial": 0},
    ):  # fmt: skip
        assert read(BASE | keys) == (PINHOLE, ())


@pytest.mark.parametrize(
    ("fx", "fy", "keys", "refused"),
    [
        (63.9, 47.9, {"D": [0.1, 0, 0, 0, 0]}, True),
        (64.0, 47.9, {"D": [0.1, 0, 0, 0, 0]}, False),
        (63.9, 48.0, {"D": [0.1, 0, 0, 0, 0]}, False),
        (64.1, 47.9, {"D": [0.1, 0, 0, 0, 0]}, False),
        (63.9, 48.1, {"D": [0.1, 0, 0, 0, 0]}, False),
        (63.9, 47.9, {}, True),
        (64.1, 47.9, {"D": [0.1, *[0] * 6, 0.1]}, False),
        (63.9, 47.9, {"D": [0.1, *[0] * 6, 0.1]}, True),
        (19.1, 14.3, {"D": [0.1, 0, 0, 0], "distortion_model": "equidistant"}, True),
        (19.3, 14.3, {"D": [0.1, 0, 0, 0], "distortion_model": "equidistant"}, False),
        (19.1, 14.5, {"D": [0.1, 0, 0, 0], "distortion_model": "equidistant"}, False),
    ],
)
def test_a_focal_length_is_in_pixels(fx: float, fy: float, keys: dict, refused: bool) -> None:
    given = BASE | {"fx": fx, "fy": fy} | keys
    if refused:
        assert refusal(given) == (
            f"has focal lengths of {fx:g} and {fy:g} for an image of 640 x 480 px: they are not in pixels, but"
            f" normalized"
            " or in mm; write fx, fy, cx and cy in pixels"
        )
    else:
        assert read(given)[0].fx_px == fx


def test_a_mirror_without_a_model_is_assumed_to_be_omnidirectional() -> None:
    camera, notes = read(BASE | {"xi": 1.2, "D": [0.1, 0.2, 0.0, 0.0]})
    assert camera.lens == Lens("omni", (1.2, 0.1, 0.2, 0.0, 0.0))
    assert notes == ("xi is not 0 and no key names the model: omni is assumed, OpenCV's omnidir",)


# --- models -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("keys", "model"),
    [
        ({}, None),
        ({"distortion_model": "plumb_bob"}, "plumb_bob"),
        ({"distortion_model": "Radial-Tangential"}, "plumb_bob"),
        ({"model": "Brown Conrady"}, "plumb_bob"),
        ({"camera_model": "rational_polynomial"}, "rational"),
        ({"camera_model": "pinhole"}, None),
        ({"camera_model": "pinhole", "distortion_model": "equidistant"}, "fisheye"),
        ({"camera_model": "omni", "distortion_model": "radtan"}, "omni"),
        ({"camera_model": "ds", "distortion_model": "none"}, "double_sphere"),
        ({"camera_model": "eucm"}, "eucm"),
        ({"distortion": "none"}, "none"),
        ({"camera": "Some Product 3"}, None),
        ({"camera": "fisheye"}, "fisheye"),
        ({"fisheye": 1}, "fisheye"),
        ({"is_fisheye": "yes"}, "fisheye"),
        ({"fisheye_model": "kb4"}, "fisheye"),
        ({"fisheye": 0}, None),
        ({"fisheye": "off", "model": "plumb_bob"}, "plumb_bob"),
        ({"fisheye": None}, None),
        ({"fisheye": [1, 2]}, None),
        ({"equidistant": True}, "fisheye"),
        ({"equidistant": False}, None),
        ({"distortion_model": True}, None),
        ({"type": "omnivision ov9281"}, None),
    ],
)
def test_the_model_of_a_lens_is_that_of_its_keys(keys: dict, model: str | None) -> None:
    assert model_of(entries_of(iter(keys.items()))) == model


@pytest.mark.parametrize(
    ("keys", "message"),
    [
        ({"distortion_model": "fov"}, f"has a lens of the model fov (distortion_model); {KNOWN}"),
        ({"model": "fov"}, f"has a lens of the model fov (model); {KNOWN}"),
        ({"distortion_model": 4}, f"has a lens of the model 4 (distortion_model); {KNOWN}"),
        ({"lens": "scaramuzza 2"}, f"has a lens of the model scaramuzza 2 (lens); {KNOWN}"),
        ({"scaramuzza": 1}, f"has a lens of the model scaramuzza (scaramuzza); {KNOWN}"),
        ({"distortion_model": "plumb_bob", "lens_model": "fisheye"}, "distortion_model is 'plumb_bob' and"
                                                                     " lens_model is 'fisheye':"
         " they contradict each other; keep the key that describes the images"),
        ({"distortion_model": "equidistant", "fisheye": False}, "distortion_model is 'fisheye' and fisheye is"
                                                                " 'no fisheye': they"
         " contradict each other; keep the key that describes the images"),
    ],
)  # fmt: skip
def test_models_that_glstar_lacks_or_that_contradict_are_refused(keys: dict, message: str) -> None:
    with pytest.raises(CalibrationError) as caught:
        model_of(entries_of(iter(keys.items())))
    assert str(caught.value) == message


# --- coefficients -----------------------------------------------------------------------------------------------------

FIVE = [0.1, -0.02, 0.001, 0.002, 0.01]


@pytest.mark.parametrize(
    ("keys", "lens"),
    [
        ({"D": FIVE}, Lens("plumb_bob", tuple(FIVE))),
        ({"D": FIVE[:4], "distortion_model": "radtan"}, Lens("plumb_bob", tuple(FIVE[:4]))),
        ({"D": [*FIVE, 0.2, 0.1, 0.05]}, Lens("rational", (*FIVE, 0.2, 0.1, 0.05))),
        ({"D": [*FIVE, 0.2, 0.1, 0.05], "distortion_model": "plumb_bob"}, Lens("rational", (*FIVE, 0.2, 0.1, 0.05))),
        ({"D": FIVE[:4], "distortion_model": "rational"}, Lens("rational", tuple(FIVE[:4]))),
        ({"D": FIVE[:4], "distortion_model": "equidistant"}, Lens("fisheye", tuple(FIVE[:4]))),
        ({"D": [0, 0, 0, 0], "distortion_model": "equidistant"}, Lens("fisheye", (0.0,) * 4)),
        ({"D": [0, 0, 0, 0, 0]}, None),
        ({"D": [0, 0, 0, 0]}, None),
        ({"k1": 0.1, "p2": 0.002}, Lens("plumb_bob", (0.1, 0.0, 0.0, 0.002, 0.0))),
        ({"distortion": {"k1": 0.1, "k2": 0.2}}, Lens("plumb_bob", (0.1, 0.2, 0.0, 0.0, 0.0))),
        ({"k1": 0.1, "k6": 0.3}, Lens("rational", (0.1, *[0.0] * 6, 0.3, *[0.0] * 6))),
        ({"k1": 0.1, "k4": 0.3, "model": "fisheye"}, Lens("fisheye", (0.1, 0.0, 0.0, 0.3))),
        ({"k1": 0.1, "k4": 0.0}, Lens("plumb_bob", (0.1, 0.0, 0.0, 0.0, 0.0))),
        ({"k1": 0.1, "tau_x": 0.01, "model": "rational"}, Lens("rational", (0.1, *[0.0] * 11, 0.01, 0.0))),
        ({"D": FIVE, "k1": 0.1, "p1": 0.001}, Lens("plumb_bob", tuple(FIVE))),
        ({"D": FIVE, "coefficients_std": [1, 2]}, Lens("plumb_bob", tuple(FIVE))),
        ({"D": FIVE, "P1": [[1, 2], [3, 4]]}, Lens("plumb_bob", tuple(FIVE))),
        ({"camera_model": "omni", "xi": 1.2, "D": FIVE[:4]}, Lens("omni", (1.2, *FIVE[:4]))),
        ({"camera_model": "omni", "xi": {"data": [1.2]}, "D": [*FIVE[:4], 0.0]}, Lens("omni", (1.2, *FIVE[:4]))),
        ({"camera_model": "omni", "xi": 1.2}, Lens("omni", (1.2,))),
        ({"camera_model": "omni", "xi": 1.2, "k1": 0.1}, Lens("omni", (1.2, 0.1, 0.0, 0.0, 0.0))),
        ({"camera_model": "ds", "xi": -0.2, "alpha": 0.6}, Lens("double_sphere", (-0.2, 0.6))),
        ({"camera_model": "ds", "distortion_coeffs": [-0.2, 0.6]}, Lens("double_sphere", (-0.2, 0.6))),
        ({"camera_model": "eucm", "alpha": 0.6, "beta": 1.1, "D": [0, 0, 0, 0]}, Lens("eucm", (0.6, 1.1))),
    ],
)
def test_coefficients_make_a_lens(keys: dict, lens: Lens | None) -> None:
    assert lens_of(**keys) == lens


@pytest.mark.parametrize(
    ("intrinsics", "model", "lens"),
    [
        ([1.2, 500, 510, 320.5, 239.5], "omni", Lens("omni", (1.2,))),
        ([-0.2, 0.6, 500, 510, 320.5, 239.5], "ds", Lens("double_sphere", (-0.2, 0.6))),
        ([0.6, 1.1, 500, 510, 320.5, 239.5], "eucm", Lens("eucm", (0.6, 1.1))),
    ],
)
def test_the_first_coefficients_may_precede_the_focal_lengths(intrinsics: list, model: str, lens: Lens) -> None:
    keys = {"camera_model": model, "resolution": [640, 480], "intrinsics": intrinsics}
    camera, notes = read(keys)
    assert (camera.lens, notes) == (lens, ())
    assert (camera.fx_px, camera.fy_px, camera.cx_px, camera.cy_px) == (500.0, 510.0, 320.5, 239.5)


SAME = "they contradict each other; keep the key that describes the lens"


@pytest.mark.parametrize(
    ("keys", "message"),
    [
        ({"D": FIVE[:3]}, "D holds 3 numbers; a plumb_bob lens has 4 or 5"),
        ({"D": [*FIVE, 0.1]}, "D holds 6 numbers; a rational lens has 4 or 5 or 8 or 12 or 14"),
        ({"D": FIVE[:3], "model": "fisheye"}, "D holds 3 numbers; a fisheye lens has 4"),
        ({"D": FIVE, "k1": 0.2}, f"has k1 = 0.2, and k1 of D is 0.1: {SAME}"),
        ({"D": FIVE, "k4": 0.2}, f"has k4 = 0.2, and k4 of D is 0: {SAME}"),
        ({"k1": 0.1, "k7": 0.2}, f"has k7 = 0.2, and k7 of plumb_bob is 0: {SAME}"),
        ({"D": FIVE, "dist_coeffs": FIVE[:4]}, "D is (0.1, -0.02, 0.001, 0.002, 0.01) and dist_coeffs is (0.1,"
                                               " -0.02, 0.001, 0.002):"
         " they contradict each other; keep the key that describes the images"),
        ({"D": FIVE, "distortion_model": "none"}, "says that the lens does not distort (none), and has"
                                                  " coefficients; remove one of"
                                                  " them"),
        ({"xi": 1.2, "model": "plumb_bob"}, "has xi = 1.2, the mirror of an omnidirectional lens, and names the"
                                            " model plumb_bob:"
         f" {SAME}"),
        ({"D": [0.1, 0.0, 0.0151, 0.0]}, "D has four numbers, no key names the model, and the last two are too"
                                         " large for the"
         " tangential distortion of a plumb_bob; add distortion_model: equidistant (a fisheye), or plumb_bob"),
        ({"k1": 0.1, "k4": 0.3}, "has k1, k4 and no key names the model of the lens; add distortion_model:"
                                 " equidistant (a fisheye) or"
                                 " rational_polynomial"),
        ({"D": FIVE, "comment": "my fisheye lens"}, "has comment = my fisheye lens and no key names the model"
                                                    " of the lens; add"
         " distortion_model: equidistant (a fisheye) or plumb_bob"),
        ({"mirror_parameters": {"xi": 1}}, "has mirror_parameters, the mirror of an omnidirectional lens; write"
                                           " it as xi, a number"),
        ({"radial_stuff": [0.1]}, "has radial_stuff, which glstar does not know and which may carry the lens;"
                                  " write the coefficients"
         " as distortion_coefficients and the model as distortion_model, or remove the key"),
        ({"camera_model": "omni"}, "has no xi; a lens of the model omni has xi, k1, k2, p1, p2 (of Kalibr,"
                                   " intrinsics: [xi, fx, fy,"
                                   " cx, cy])"),
        ({"camera_model": "ds", "xi": 0.1}, "has no alpha; a lens of the model double_sphere has xi, alpha (of"
                                            " Kalibr, intrinsics:"
                                            " [xi, alpha, fx, fy, cx, cy])"),
        ({"camera_model": "omni", "xi": 1.2, "D": FIVE}, "D holds 5 numbers; a omni lens has k1, k2, p1, p2"),
        ({"camera_model": "ds", "xi": 0.1, "alpha": 0.5, "D": [0.1, 0, 0]}, "D holds 3 numbers; a double_sphere"
                                                                            " lens has none"),
        ({"camera_model": "omni", "xi": [1.2, 3.0]}, "xi holds 2 numbers; it is one number"),
        ({"camera_model": "omni", "xi": 1.2, "D": FIVE[:4], "k2": 0.5}, f"has k2 = 0.5, and k2 of omni is"
                                                                        f" -0.02: {SAME}"),
    ],
)  # fmt: skip
def test_coefficients_that_are_no_lens_are_refused(keys: dict, message: str) -> None:
    assert refusal(BASE | keys) == message


def test_four_numbers_without_a_model_are_assumed_to_be_tangential() -> None:
    camera, notes = read(BASE | {"D": [0.1, 0.2, 0.015, -0.015]})
    assert camera.lens == Lens("plumb_bob", (0.1, 0.2, 0.015, -0.015))
    assert notes == (
        "D has four numbers and no key names the model: plumb_bob is assumed; for a fisheye, add distortion_model:"
        " equidistant",
    )
    assert read(BASE | {"D": [0.1, 0.2, 0.0, 0.0], "distortion_model": "radtan"})[1] == ()


@pytest.mark.parametrize(
    ("key", "value", "note"),
    [
        ("distortion_std", [1.0], True),
        ("sigma_distortion", [1.0], True),
        ("undistorted_coefficients", [1.0], True),
        ("camera_matrix_std", [[1.0]], True),
        ("coeffUncertainty", 0.5, True),
        ("focal_std", 0.5, False),
        ("Errors", [1], False),
        ("rectification_matrix", [[1.0]], False),
        ("radial", 1, False),
        ("radial", "text", False),
        ("lens_on", True, False),
    ],
)
def test_errors_and_rectified_images_are_passed_over(key: str, value: object, note: bool) -> None:
    camera, notes = read(BASE | {key: value})
    assert camera == PINHOLE
    assert notes == ((f"passed over as standard errors or rectified images: {key}",) if note else ())


def test_passed_over_keys_are_listed_together() -> None:
    notes = read(BASE | {"distortion_std": [1.0], "k1_undistorted": [2.0], "coef_err": 3.0})[1]
    assert notes == ("passed over as standard errors or rectified images: distortion_std, k1_undistorted, coef_err",)


@pytest.mark.parametrize(
    ("key", "value"), [("lens_table", [1.0]), ("fisheye_poly", [1.0]), ("my_distortion", 0.5), ("prism_a", 2)]
)
def test_a_key_that_may_carry_the_lens_is_refused(key: str, value: object) -> None:
    assert refusal(BASE | {key: value}).startswith(
        f"has {key}, which glstar does not know and which may carry the lens"
    )


def test_sections_count_as_keys_of_the_file() -> None:
    entries = entries_of(iter({"K": {"fx": 5, "note": 1}, "D": {"a": 2}, "Other": {"fx": 3}}.items()))
    assert entries == {
        "fx": [("K.fx", 5)],
        "note": [("K.note", 1)],
        "d": [("D", {"a": 2})],
        "other": [("Other", {"fx": 3})],
    }
