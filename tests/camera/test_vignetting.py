"""Vignetting: stars and sky fall off differently."""

from pathlib import Path

import cv2
import numpy as np
import pytest

from glstar.camera.distortion import Lens
from glstar.camera.model import Camera
from glstar.camera.vignetting import Vignetting, image_grid, relative_solid_angle

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
