"""Formulas and constants of the shaders agree with those in Python, as read from the GLSL source.

No OpenGL is needed, and images would not show a small difference: it lies within their tolerances at the altitudes,
widths and turn rates that other tests draw.  Each formula occurs in one GLSL file, which the shaders include.
"""

import math
import re

import numpy as np
import pytest
from scipy.stats import norm

from glstar.camera.sensor.sensor import PIXEL_PART_VARIANCE_PX2, PIXEL_PLACES_PX, PIXEL_VARIANCE_PX2, PIXEL_WEIGHTS
from glstar.render.motion import segmentation
from glstar.sky.air import refraction
from glstar.sky.air.refraction import LOWEST_ALTITUDE_RAD, refraction_displacement
from glstar.system.resources import shader, shader_paths

DECLARED = re.compile(r"^\s*const\s+(?:float|int)\s+(?P<some>[^;\[]+);", re.MULTILINE)


def constants(name: str) -> dict[str, float]:
    """Return the plain numbers that a shader declares ``const``."""
    found = {}
    for declaration in DECLARED.finditer(shader(name)):
        for one in declaration["some"].split(","):
            constant, _, value = (part.strip() for part in one.partition("="))
            if re.fullmatch(r"-?[\d.e+-]+", value):
                found[constant] = float(value)
    return found


def expression(name: str, begins: str) -> str:
    """Return the expression that a shader gives to a variable, which Python reads as GLSL does."""
    (found,) = re.findall(rf"{re.escape(begins)}\s*=\s*([^;]+);", shader(name))
    return re.sub(r"\s+", " ", found)


def test_the_shaders_refract_as_the_labels_do() -> None:
    s = np.sin(np.linspace(LOWEST_ALTITUDE_RAD, np.pi / 2, 1000))

    numerator = eval(expression("refraction.glsl", "float numerator"), {"s": s})
    denominator = eval(expression("refraction.glsl", "float denominator"), {"s": s})

    np.testing.assert_allclose(numerator / denominator, refraction_displacement(s), rtol=1e-14)


def test_the_shaders_hold_the_refraction_constant_below_the_same_altitude_as_the_labels() -> None:
    lowest = constants("refraction.glsl")["SINE_OF_LOWEST_ALTITUDE"]
    assert lowest == pytest.approx(math.sin(refraction.LOWEST_ALTITUDE_RAD), rel=1e-15)


@pytest.mark.parametrize(
    "number", ["8.431267579e-3", "0.3458319986644865", "0.254829592", "0.125", "-0.017452406437283512"]
)
def test_a_formula_occurs_in_one_shader_file(number: str) -> None:
    """Refraction, the kernel of pixels, erf, the margin of rasterization, the lowest altitude."""
    assert sum(number in path.read_text(encoding="utf-8") for path in shader_paths()) == 1


def test_all_kinds_of_segments_have_numbers_of_their_own() -> None:
    kinds = constants("trail_constants.glsl")

    assert list(kinds) == ["NOTHING", "SHORT", "POINT", "LONG", "PARTLY_OPEN"]
    assert len(set(kinds.values())) == 5
    # It is added to the others.
    assert kinds["PARTLY_OPEN"] > max(kinds["SHORT"], kinds["POINT"], kinds["LONG"])


def test_three_gaussians_a_side_have_the_moments_of_a_square_pixel() -> None:
    """Of the second, fourth and sixth order: 1/12, 1/80 and 1/448 px^n."""
    kernel = constants("pixel_kernel.glsl")
    weight, own, a2 = kernel["WEIGHT"], PIXEL_PART_VARIANCE_PX2, kernel["OFFSET_PX"] ** 2

    assert (-kernel["OFFSET_PX"], 0.0, kernel["OFFSET_PX"]) == PIXEL_PLACES_PX
    assert pytest.approx((weight, 1 - 2 * weight, weight), rel=1e-15) == PIXEL_WEIGHTS
    assert 2 * weight * a2 + own == pytest.approx(PIXEL_VARIANCE_PX2, rel=1e-6)
    assert 2 * weight * (a2**2 + 6 * a2 * own) + 3 * own**2 == pytest.approx(1 / 80, rel=1e-6)
    assert 2 * weight * (a2**3 + 15 * a2**2 * own + 45 * a2 * own**2) + 15 * own**3 == pytest.approx(1 / 448, rel=1e-6)


def test_two_gaussians_have_the_moments_of_a_short_even_trail() -> None:
    """Of the second and fourth order, over a trail of length 1."""
    gaussians = constants("two_gaussians.glsl")
    a2, own = gaussians["OFFSET"] ** 2, gaussians["VARIANCE"]

    assert a2 + own == pytest.approx(1 / 12, rel=1e-5)
    assert a2**2 + 6 * a2 * own + 3 * own**2 == pytest.approx(1 / 80, rel=1e-5)


def test_two_gaussians_have_the_asymmetry_of_a_short_trail_of_changing_speed() -> None:
    """The third moment of u + 4 u (1 - u) ahead to first order of ahead: -12 (1 / 80 - 1 / 144)."""
    gaussians = constants("two_gaussians.glsl")
    offset, own, change = (gaussians[name] for name in ("OFFSET", "VARIANCE", "RATE_CHANGE"))

    assert -6 * offset * own * change == pytest.approx(-12 * (1 / 80 - 1 / 144), rel=1e-5)
    assert pytest.approx(own * change**2, rel=1e-12) == segmentation._CHANGE_VARIANCE


@pytest.mark.parametrize(
    ("name", "constant", "value"),
    [
        ("noise.glsl", "HALF_PI", math.pi / 2),
        ("noise.glsl", "MINUS_2_LN_2", -2 * math.log(2)),
        ("star_erf.frag", "HALF_PI", math.pi / 2),
        ("trail.frag", "FALLOFF", 1.6**2 / (2 * math.log(2))),
        ("trail.frag", "SQRT_LN_2", math.sqrt(math.log(2))),
        ("trail.frag", "INV_SQRT_PI_LN_2", 1 / math.sqrt(math.pi * math.log(2))),
        ("trail.frag", "HALF_LOG2_E", 1 / (2 * math.log(2))),
        ("two_gaussians.glsl", "LN_2", math.log(2)),
        ("star_path.frag", "SQRT_HALF_PI", math.sqrt(math.pi / 2)),
        ("gaussian_tail.glsl", "INV_SQRT_2_PI", 1 / math.sqrt(2 * math.pi)),
        ("trail_pieces.vert", "HALF_LOG2_E", 1 / (2 * math.log(2))),
    ],
)
def test_a_constant_is_what_its_name_says(name: str, constant: str, value: float) -> None:
    # Trails are accurate to 2e-3; one of these constants has only five digits.
    assert constants(name)[constant] == pytest.approx(value, rel=1e-5)


def test_erf_is_erf_to_its_seven_digits() -> None:
    x = np.linspace(0.0, 4.0, 200)
    t = 1 / (1 + constants("erf.glsl")["ERF_P"] * x)
    (polynomial,) = re.findall(r"#define ERFC_POLYNOMIAL\(t\) (.+)", shader("erf.glsl"))

    erf = 1 - eval(polynomial, {"t": t}) * np.exp(-(x**2))

    np.testing.assert_allclose(erf, [math.erf(one) for one in x], rtol=0, atol=1.6e-7)


def test_the_gaussian_tail_has_five_digits() -> None:
    z = np.linspace(0.0, 5.0, 200)
    density = constants("gaussian_tail.glsl")["INV_SQRT_2_PI"] * np.exp(-0.5 * z * z)
    (slope,) = re.findall(r"t = 1\.0 / \(1\.0 \+ ([\d.]+) \* z\)", shader("gaussian_tail.glsl"))
    t = 1 / (1 + float(slope) * z)

    (polynomial,) = re.findall(r"float tail = (density[^;]+);", shader("gaussian_tail.glsl"))

    tail = eval(polynomial, {"density": density, "t": t})

    np.testing.assert_allclose(tail, norm.sf(z), rtol=0, atol=1.2e-5)


def test_the_polynomials_of_the_noise_are_sine_and_cosine() -> None:
    angle = np.linspace(-np.pi / 4, np.pi / 4, 200)
    known = {"angle": angle, "square": angle * angle}

    sine = eval(expression("noise.glsl", "vec2 sine"), known)
    cosine = eval(expression("noise.glsl", "vec2 cosine"), known)

    np.testing.assert_allclose(sine, np.sin(angle), rtol=0, atol=5e-9)
    np.testing.assert_allclose(cosine, np.cos(angle), rtol=0, atol=5e-9)
