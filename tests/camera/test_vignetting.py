"""Vignetting: stars and sky fall off differently."""

from pathlib import Path

import cv2
import numpy as np
import pytest

from glstar.camera.distortion import Lens
from glstar.camera.model import Camera
from glstar.camera.vignetting import FalloffFit, Vignetting, _curvature, image_grid, px2_per_sr, relative_solid_angle

HQ = Camera(2028, 1520, 1935.484, 1935.484, 1013.5, 759.5)
# 60 deg from the axis to the corners.
WIDE = Camera(1014, 760, 365.8, 365.8, 506.5, 379.5)
FISHEYE = Camera(800, 600, 500.0, 500.0, 399.5, 299.5, lens=Lens("fisheye", (0.02, -0.01, 0.0, 0.0)))


def test_behind_a_pinhole_the_sky_falls_as_cos_4_and_stars_as_cos() -> None:
    xy = image_grid(HQ, 9, 7)
    cosine = HQ.unit_vectors(xy)[..., 2]
    cos4 = Vignetting("cos4")

    np.testing.assert_allclose(cos4.of_sky(HQ, xy), cosine**4, rtol=1e-12)
    np.testing.assert_allclose(cos4.of_stars(HQ, xy), cosine, rtol=1e-12)
    corner = np.array([-0.5, -0.5])
    assert cos4.of_sky(HQ, corner) == pytest.approx(0.49, abs=0.01)
    assert cos4.of_stars(HQ, corner) == pytest.approx(0.84, abs=0.01)


def test_the_solid_angle_is_that_of_the_spherical_quadrilateral_of_a_pixel() -> None:
    corners = np.array([[-0.5, -0.5], [0.5, -0.5], [0.5, 0.5], [-0.5, 0.5]])

    def solid_angle(xy: np.ndarray) -> float:
        a, b, c, d = FISHEYE.unit_vectors(xy + corners)

        def triangle(u: np.ndarray, v: np.ndarray, w: np.ndarray) -> float:  # van Oosterom & Strackee 1983
            return float(2 * np.arctan2(abs(u @ np.cross(v, w)), 1 + u @ v + v @ w + w @ u))

        return triangle(a, b, c) + triangle(a, c, d)

    axis = solid_angle(np.array([399.5, 299.5]))
    for xy in ([700.0, 299.5], [50.0, 60.0], [399.0, 590.0]):
        expected = solid_angle(np.array(xy)) / axis
        assert relative_solid_angle(FISHEYE, xy) == pytest.approx(expected, rel=1e-5)


def test_a_polynomial_describes_the_sky_and_stars_get_it_without_the_solid_angle() -> None:
    vignetting = Vignetting("polynomial", vignetting_r2=-0.4, vignetting_r4=0.02)
    corner = np.array([[2027.5, 1519.5], [1013.5, 759.5]])

    sky = vignetting.of_sky(HQ, corner)

    np.testing.assert_allclose(sky, [0.62, 1.0], rtol=1e-12)
    np.testing.assert_allclose(vignetting.of_stars(HQ, corner), sky / relative_solid_angle(HQ, corner), rtol=1e-12)


def test_a_flat_field_is_smoothed_and_normalised_to_the_axis(tmp_path: Path) -> None:
    x, y = np.meshgrid(np.arange(2028) - 1013.5, np.arange(1520) - 759.5)
    shade = 1 - 0.3 * (x**2 + y**2) / (1013.5**2 + 759.5**2)
    noisy = 9000 * shade * (1 + 0.02 * np.random.default_rng(1).standard_normal(shade.shape))
    cv2.imwrite(str(tmp_path / "flat.png"), noisy.astype(np.uint16))

    sky = Vignetting("flat", vignetting_file=str(tmp_path / "flat.png")).of_sky(HQ, [[100.0, 100.0], [1900.0, 700.0]])

    np.testing.assert_allclose(sky, [shade[100, 100], shade[700, 1900]], rtol=0, atol=0.004)


@pytest.mark.parametrize("camera", [HQ, FISHEYE, WIDE])
@pytest.mark.parametrize("vignetting", [Vignetting("cos4"), Vignetting("polynomial", vignetting_r2=-0.5)])
def test_the_polynomials_of_the_shader_fit_the_formulas(camera: Camera, vignetting: Vignetting) -> None:
    fit = vignetting.fit(camera)
    xy = image_grid(camera, 33, 25)
    u = (camera.normalized(xy) ** 2).sum(axis=-1) / fit.largest_q
    w = (1 + fit.bend) * u / (1 + fit.bend * u)

    star, sky = (np.polynomial.polynomial.polyval(w, coefficients) for coefficients in (fit.star, fit.sky))

    np.testing.assert_allclose(star, vignetting.of_stars(camera, xy), rtol=1e-4, atol=0)
    np.testing.assert_allclose(sky, vignetting.of_sky(camera, xy), rtol=1e-4, atol=0)


def test_a_grid_has_the_middles_of_its_cells() -> None:
    camera = Camera(12, 9, 20.0, 20.0, 5.5, 4.0)
    # Three columns of 4 px and two rows of 4.5 px; the image begins half a pixel before the first centre.
    np.testing.assert_allclose(image_grid(camera, 3, 2)[0], [[1.5, 1.75], [5.5, 1.75], [9.5, 1.75]], rtol=1e-12)
    np.testing.assert_allclose(image_grid(camera, 3, 2)[1, :, 1], [6.25] * 3, rtol=1e-12)


def test_without_vignetting_nothing_is_lost() -> None:
    for where in (np.zeros(2), np.zeros((5, 2)), np.zeros((3, 4, 2))):
        assert Vignetting().of_sky(HQ, where).tolist() == np.ones(where.shape[:-1]).tolist()
        assert Vignetting().of_stars(HQ, where).tolist() == np.ones(where.shape[:-1]).tolist()
    assert Vignetting() == Vignetting("none", 0.0, 0.0, 0.0, "")
    given = {"lens.vignetting": "polynomial", "lens.vignetting_r4": 0.5, "sensor.psf": "moffat"}
    assert Vignetting.of(given) == Vignetting("polynomial", vignetting_r4=0.5)


def test_a_polynomial_has_three_terms_and_is_never_negative() -> None:
    camera = Camera(400, 300, 500.0, 500.0, 190.0, 160.0)
    r = np.array([0.0, 0.4, 0.8, 1.2])
    xy = np.column_stack([190 + 250 * r * 0.6, 160 - 250 * r * 0.8])
    expected = 1 - 0.3 * r**2 + 0.2 * r**4 - 0.5 * r**6
    found = Vignetting("polynomial", -0.3, 0.2, -0.5).of_sky(camera, xy)
    np.testing.assert_allclose(found, np.maximum(expected, 0), rtol=1e-12, atol=1e-12)
    assert expected[3] < 0


def test_a_direction_that_a_lens_does_not_show_receives_nothing() -> None:
    camera = Camera(800, 600, 150.0, 150.0, 399.5, 299.5, lens=Lens("fisheye", (), np.deg2rad(80.0)))
    xy = [[399.5, 299.5], [399.5 + 150 * 0.8, 299.5], [2.0, 3.0]]
    angle = np.array([0.0, 0.8])
    # A circle of the radius theta has the solid angle 2 pi (1 - cos theta): sin(theta) / theta per pixel.
    solid = np.array([1.0, np.sin(0.8) / 0.8, 0.0])
    np.testing.assert_allclose(relative_solid_angle(camera, xy), solid, rtol=1e-9, atol=1e-12)
    assert np.isnan(px2_per_sr(camera, camera.unit_vectors(xy[2])))
    cos4 = Vignetting("cos4")
    np.testing.assert_allclose(cos4.of_sky(camera, xy), [*(np.cos(angle) * solid[:2]), 0], rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(cos4.of_stars(camera, xy), [*np.cos(angle), 0], rtol=1e-9, atol=1e-12)


def test_a_flat_field_is_read_at_the_nearest_pixel_of_the_image(tmp_path: Path) -> None:
    """A ramp stays a ramp when it is smoothed, away from its edges; beside the image its border counts."""
    camera = Camera(160, 120, 300.0, 300.0, 60.4, 50.6)
    ramp = 1000 + 2.0 * np.arange(160)[np.newaxis] + 3.0 * np.arange(120)[:, np.newaxis]
    np.save(tmp_path / "flat.npy", ramp)
    flat = Vignetting("flat", vignetting_file=str(tmp_path / "flat.npy"))
    axis = ramp[51, 60]
    found = flat.of_sky(camera, [[60.4, 50.6], [80.4, 70.6], [100.0, 40.0]])
    np.testing.assert_allclose(found, [1.0, ramp[71, 80] / axis, ramp[40, 100] / axis], rtol=1e-5)
    inside = flat.of_sky(camera, [[0.0, 0.0], [159.0, 119.0], [159.0, 60.0], [80.0, 119.0]])
    beside = flat.of_sky(camera, [[-7.0, -3.0], [170.0, 125.0], [170.0, 60.0], [80.0, 125.0]])
    np.testing.assert_array_equal(inside, beside)
    assert len(set(inside.tolist())) == 4


def test_polynomials_reach_the_outer_edges_of_the_corners() -> None:
    camera = Camera(400, 300, 500.0, 500.0, 190.0, 160.0)
    # The farthest corner is the top right one.
    q = (209.5 / 500) ** 2 + (160.5 / 500) ** 2
    fit = Vignetting("cos4").fit(camera)
    assert fit.largest_q == pytest.approx(q, rel=1e-12)
    assert fit.bend == fit.largest_q
    assert len(fit.star) == len(fit.sky) <= 8
    polynomial = Vignetting("polynomial", -0.3, 0.05, -0.02).fit(camera)
    assert polynomial.bend == 0.0
    for one, given in ((fit, Vignetting("cos4")), (polynomial, Vignetting("polynomial", -0.3, 0.05, -0.02))):
        corner = np.array([399.5, -0.5])
        assert sum(one.star) == pytest.approx(float(given.of_stars(camera, corner)), rel=2e-5)
        assert sum(one.sky) == pytest.approx(float(given.of_sky(camera, corner)), rel=2e-5)
        assert one.star[0] == pytest.approx(1.0, abs=1e-5)
    assert isinstance(fit, FalloffFit)


def test_the_curvature_bounds_the_second_derivatives() -> None:
    """The second derivative of f(x^2 / L) is 2 f' / L + 4 x^2 f'' / L^2, largest where both have one sign."""
    coefficients = np.array([[1.0, 1.0], [-0.5, -0.2], [0.1, -0.3]])
    largest_q = 0.4
    for bend in (0.0, 0.4):
        u = np.linspace(0, 1, 2001)
        step = 1e-4

        def value(u: np.ndarray, bend: float = bend) -> np.ndarray:
            w = (1 + bend) * u / (1 + bend * u)
            return np.array([np.polynomial.polynomial.polyval(w, one) for one in coefficients.T])

        slope = (value(u + step) - value(u - step)) / (2 * step)
        bent = (value(u + step) + value(u - step) - 2 * value(u)) / step**2
        expected = np.max(2 * np.abs(slope) + 4 * u * np.abs(bent)) / largest_q
        assert _curvature(coefficients, largest_q, bend) == pytest.approx(expected, rel=0.03)


@pytest.mark.parametrize("given", [Vignetting("cos4"), Vignetting("polynomial", -0.3, 0.05, -0.02)])
@pytest.mark.parametrize("focal_px", [260.0, 500.0])
def test_a_polynomial_has_as_few_terms_as_five_millionths_allow(given: Vignetting, focal_px: float) -> None:
    camera = Camera(400, 300, focal_px, focal_px, 190.0, 160.0)
    fit = given.fit(camera)
    x, y = np.linspace(-0.5, 399.5, 65), np.linspace(-0.5, 299.5, 65)
    xy = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
    u = (camera.normalized(xy) ** 2).sum(axis=-1) / fit.largest_q
    w = (1 + fit.bend) * u / (1 + fit.bend * u)
    both = np.column_stack([given.of_stars(camera, xy), given.of_sky(camera, xy)])

    def error(terms: int) -> float:
        powers = np.vander(w, terms, increasing=True)
        return float(np.max(np.abs(powers @ np.linalg.lstsq(powers, both, rcond=None)[0] - both) / both))

    terms = len(fit.star)
    assert 3 <= terms <= 8
    assert terms == 3 or error(terms - 1) > 5e-6
    assert terms == 8 or error(terms) <= 5e-6
    assert terms in range(3, 8) or focal_px == 260.0
