"""Constants that a shader shares with Python or with another shader agree, as read from the GLSL source.

No OpenGL is needed, and images would not show a small difference: it lies within their tolerances at the altitudes,
widths and turn rates that other tests draw.
"""

import math
import re

import numpy as np
import pytest
from scipy.stats import norm

from glstar.camera.sensor import PIXEL_VARIANCE_PX2
from glstar.render import segmentation
from glstar.render.opengl import distortionpass, renderer, trailpass
from glstar.sky import horizon
from glstar.sky.horizon import LOWEST_ALTITUDE_RAD, refraction_displacement
from glstar.system.resources import shader

DECLARED = re.compile(r"^\s*const\s+(?:float|int)\s+(?P<some>[^;\[]+);", re.MULTILINE)
NUMBER = re.compile(r"(?<![\w.])(\d+\.?\d*(?:e-?\d+)?)")


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


@pytest.mark.parametrize("name", ["star.vert", "place.frag"])
def test_the_shaders_lift_a_star_as_the_labels_do(name: str) -> None:
    s = np.sin(np.linspace(LOWEST_ALTITUDE_RAD, np.pi / 2, 1000))

    above = eval(expression(name, "float above"), {"s": s})
    below = eval(expression(name, "float below"), {"s": s})

    np.testing.assert_allclose(above / below, refraction_displacement(s), rtol=1e-14)


@pytest.mark.parametrize("name", ["star.vert", "place.frag"])
def test_the_shaders_hold_the_refraction_where_the_labels_do(name: str) -> None:
    assert constants(name)["SINE_OF_LOWEST_ALTITUDE"] == pytest.approx(math.sin(horizon.LOWEST_ALTITUDE_RAD), rel=1e-15)


def test_trails_are_drawn_by_the_bounds_that_cut_them() -> None:
    drawn = constants("way.frag")

    assert drawn["SHORT_SIGMA"] == segmentation.SHORT_SIGMA
    assert drawn["STEEPEST"] == segmentation._STEEPEST
    assert drawn["MOST_AT_ENDS"] == segmentation._MOST_AT_ENDS


def test_the_shaders_read_what_python_writes_for_them() -> None:
    assert constants("star.vert")["SUB_EXPOSURES_A_SPRITE"] == renderer._SUB_EXPOSURES_A_SPRITE
    assert constants("place.frag")["STARS_A_ROW"] == trailpass._STARS_A_ROW
    assert constants("warp.vert")["REACH_PX"] == distortionpass._SPLINE_REACH_PX


def test_both_shaders_of_trails_number_the_kinds_of_segments_alike() -> None:
    ways, shapes = constants("way.frag"), constants("trail.vert")

    assert {kind: shapes[kind] for kind in ("SHORT", "POINT", "LONG")} == {
        kind: ways[kind] for kind in ("SHORT", "POINT", "LONG")
    }
    assert len({ways[kind] for kind in ("NOTHING", "SHORT", "POINT", "LONG")}) == 4


def test_all_points_are_wider_by_the_grid_that_rasterisers_place_them_on() -> None:
    assert {constants(name)["SNAPPING_PX"] for name in ("star.vert", "trail.vert", "way.frag")} == {0.125}


def kernel(name: str) -> tuple[float, float]:
    told = constants(name)
    return told["APART_PX"], told["WEIGHT"]


@pytest.mark.parametrize("name", ["trail.frag", "trail_between.frag", "trail_short.frag"])
def test_three_gaussians_a_side_have_the_moments_of_a_square_pixel(name: str) -> None:
    """Of the second, fourth and sixth order: 1/12, 1/80 and 1/448 px^n."""
    apart_px, weight = kernel(name)
    own = trailpass._NARROW_VARIANCE_PX2
    a2 = apart_px**2

    assert 2 * weight * a2 + own == pytest.approx(PIXEL_VARIANCE_PX2, rel=1e-6)
    assert 2 * weight * (a2**2 + 6 * a2 * own) + 3 * own**2 == pytest.approx(1 / 80, rel=1e-6)
    assert 2 * weight * (a2**3 + 15 * a2**2 * own + 45 * a2 * own**2) + 15 * own**3 == pytest.approx(1 / 448, rel=1e-6)


def test_two_gaussians_have_the_moments_of_a_short_even_trail() -> None:
    """Of the second and fourth order, over a trail of length 1."""
    told = constants("way.frag")
    a2, own = told["APART"] ** 2, told["WIDTH"]

    assert a2 + own == pytest.approx(1 / 12, rel=1e-5)
    assert a2**2 + 6 * a2 * own + 3 * own**2 == pytest.approx(1 / 80, rel=1e-5)


def test_a_spline_widens_light_by_what_stars_were_drawn_narrower() -> None:
    (bend,) = re.findall(r"BEND_PX2 = vec2\(([\d.]+), ([\d.]+)\)", shader("warp.frag"))
    always, between = map(float, bend)
    t = np.linspace(0.0, 1.0, 101)

    # A cubic B-spline's own variance, and half a second derivative's.
    widened_px2 = 1 / 3 + always + between * t * (1 - t)

    np.testing.assert_allclose(widened_px2, distortionpass._WIDENED_PX2, rtol=0, atol=0.012)


@pytest.mark.parametrize(
    ("name", "constant", "value"),
    [
        ("noise.glsl", "HALF_PI", math.pi / 2),
        ("noise.glsl", "MINUS_2_LN_2", -2 * math.log(2)),
        ("star_erf.frag", "HALF_PI", math.pi / 2),
        ("trail.frag", "TWO_SIGMA", 2 / math.sqrt(2 * math.log(2))),
        ("trail.frag", "SQRT_LN_2", math.sqrt(math.log(2))),
        ("trail.frag", "INV_SQRT_PI_LN_2", 1 / math.sqrt(math.pi * math.log(2))),
        ("trail.frag", "HALF_LOG2_E", 1 / (2 * math.log(2))),
        ("way.frag", "LN_2", math.log(2)),
        ("way.frag", "SQRT_HALF_PI", math.sqrt(math.pi / 2)),
        ("way.frag", "INV_SQRT_2_PI", 1 / math.sqrt(2 * math.pi)),
    ],
)
def test_a_constant_is_what_its_name_says(name: str, constant: str, value: float) -> None:
    # Light is drawn to 2e-3 of a trail; one of these has five digits only.
    assert constants(name)[constant] == pytest.approx(value, rel=1e-5)


@pytest.mark.parametrize(("name", "scale"), [("star_erf.frag", 1.0), ("trail.frag", math.sqrt(math.log(2)))])
def test_erf_is_erf_to_its_seven_digits(name: str, scale: float) -> None:
    x = np.linspace(0.0, 4.0, 200)
    declared = expression(name, "vec4 t" if name == "star_erf.frag" else "vec2 b")
    (slope,) = [float(number) for number in NUMBER.findall(declared) if number.startswith("0.32")]
    t = 1 / (1 + slope * scale * x)
    tail = eval(expression(name, "vec4 tail" if name == "star_erf.frag" else "vec2 tail"), {"t": t})

    erf = 1 - tail * np.exp(-((scale * x) ** 2))

    np.testing.assert_allclose(erf, [math.erf(scale * one) for one in x], rtol=0, atol=1.6e-7)


def test_what_lies_beyond_a_cut_is_the_normal_tail_to_five_digits() -> None:
    z = np.linspace(0.0, 5.0, 200)
    density = constants("way.frag")["INV_SQRT_2_PI"] * np.exp(-0.5 * z * z)
    (slope,) = re.findall(r"t = 1\.0 / \(1\.0 \+ ([\d.]+) \* z\)", shader("way.frag"))
    t = 1 / (1 + float(slope) * z)

    (tail,) = re.findall(r"float share = (density[^;]+);", shader("way.frag"))

    share = eval(tail, {"density": density, "t": t})

    np.testing.assert_allclose(share, norm.sf(z), rtol=0, atol=1.2e-5)


def test_noise_takes_its_sines_and_cosines_from_polynomials_that_are_those() -> None:
    angle = np.linspace(-np.pi / 4, np.pi / 4, 200)
    known = {"angle": angle, "square": angle * angle}

    sine = eval(expression("noise.glsl", "vec2 sine"), known)
    cosine = eval(expression("noise.glsl", "vec2 cosine"), known)

    np.testing.assert_allclose(sine, np.sin(angle), rtol=0, atol=5e-9)
    np.testing.assert_allclose(cosine, np.cos(angle), rtol=0, atol=5e-9)
