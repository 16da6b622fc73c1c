"""Faint long trails, which are drawn on wide pixels, against sums of sub-exposures in float64."""

from dataclasses import replace

import numpy as np
import pytest

from glstar.camera.distortion import Lens
from glstar.camera.exposure import Exposure
from glstar.camera.model import Camera
from glstar.camera.sensor.pointspread import TRUNCATION_DN
from glstar.render.scene import reduction
from glstar.render.scene.reduction import SCALES, drawn_variance_px2, reduced_camera, reduced_scenes
from glstar.render.scene.starcomponents import drawn_peak_dn, gaussian_scenes
from tests.support.reference import light_of
from tests.support.scenes import NIGHT_UTC_S, camera, sky_over_adelaide
from tests.support.trails import light, with_stars

SUB_EXPOSURES = 4000
OPENS_S = NIGHT_UTC_S + 0.2


@pytest.fixture
def reduced_whatever_it_saves(monkeypatch):
    """Single stars on wide pixels, which would save nothing."""
    monkeypatch.setattr(reduction, "_are_worth_reducing", lambda *_: True)
    monkeypatch.setattr(reduction, "_FEWEST", 1)


def turning(deg_per_s=200.0, *, lens=None, vmag_limit=6.5, size=(320, 240, 300.0), **sensor):
    simulator = sky_over_adelaide(
        replace(camera(*size), lens=lens), vmag_limit=vmag_limit, roll_rate_rad_per_s=np.deg2rad(deg_per_s)
    )
    return replace(simulator, sensor=replace(simulator.sensor, **sensor))


def brightest_on_wide_pixels(scene, scale):
    """Return the star of the draw list whose trail is the brightest on pixels of some width, and that peak, DN."""
    (parts,) = reduced_scenes(gaussian_scenes(scene)).reduced[scale]
    stars = np.flatnonzero(np.isin(scene.draw_list.index, parts.draw_list.index))
    peak_dn = scene.sensor.max_trail_peak_dn(drawn_peak_dn(scene), scene.draw_list.min_trail_px)[stars]
    # Paths of many stars of a fast turn cross a corner only.
    xy = scene.positions(scene.stars.direction_eq[scene.draw_list.index[stars]], np.linspace(0.0, 1.0, 200))
    stays = scene.camera.contains(np.nan_to_num(xy, nan=-1e6)).mean(axis=0) > 0.1
    best = np.argmax(np.where(stays, peak_dn, 0.0))
    return scene.draw_list.index[stars[best : best + 1]], peak_dn[best]


def exact(renderer, scene, monkeypatch):
    """Return the light of a scene whose stars are drawn on the pixels of the image, up to five standard deviations."""
    radius_px = np.full(len(scene.draw_list), 5 * scene.sensor.effective_sigma_px)
    with monkeypatch.context() as patch:
        patch.setattr(reduction, "_are_worth_reducing", lambda *_: False)
        return light(renderer, replace(scene, draw_list=replace(scene.draw_list, truncation_radius_px=radius_px)))


@pytest.mark.parametrize("scale", SCALES)
@pytest.mark.parametrize("lens", [None, Lens("plumb_bob", (-0.2, 0.05, 1e-3, -5e-4))])
def test_the_camera_of_wide_pixels_sees_every_direction_at_the_same_place(scale, lens):
    """Pixel (0, 0) of either image begins at (-0.5, -0.5)."""
    fine = Camera(321, 242, 300.0, 290.0, 170.0, 110.0, 4.0, lens)
    wide = reduced_camera(fine, scale)
    edges_px = fine.project(fine.unit_vectors(np.array([[-0.5, -0.5], [320.5, 241.5], [10.0, 200.0], [290.0, 33.0]])))
    rays = fine.unit_vectors(edges_px)
    np.testing.assert_allclose(wide.project(rays), (edges_px + 0.5) / scale - 0.5, rtol=0, atol=1e-6)
    # The last wide pixels may reach beyond the image.
    assert (wide.width_px, wide.height_px) == ({2: 161, 4: 81}[scale], {2: 121, 4: 61}[scale])


@pytest.mark.parametrize("scale", SCALES)
def test_the_largest_error_of_a_profile_is_that_of_its_interpolation(scale):
    """An upright trail of peak 1, sampled at wide pixels and interpolated at the pixels of the image."""
    wide = np.arange(-40, 41)
    pixels = (np.arange(-20 * scale, 20 * scale) + 0.5) / scale - 0.5

    def largest_error(width):
        variance = drawn_variance_px2(width, 1)
        errors = []
        for at in np.linspace(0.0, 1.0, 81):
            drawn = width / np.sqrt(variance) * np.exp(-((wide - at) ** 2) / (2 * variance))
            errors.append(np.interp(pixels, wide, drawn) - np.exp(-((pixels - at) ** 2) / (2 * width**2)))
        return np.abs(errors).max()

    for width, listed in zip(reduction._WIDTHS, reduction._ERRORS[scale], strict=True):
        assert 0.99 * listed / 1.06 < largest_error(width) < 1.001 * listed
    # Between the listed widths, too.
    widths = np.geomspace(reduction._WIDTHS[0], reduction._WIDTHS[-1], 60)
    between = np.interp(widths, reduction._WIDTHS, reduction._ERRORS[scale])
    assert (np.array([largest_error(width) for width in widths]) < 1.02 * between).all()


@pytest.mark.usefixtures("reduced_whatever_it_saves")
@pytest.mark.parametrize("scale", SCALES)
@pytest.mark.parametrize("psf_sigma_px", [1.2, 2.0, 2.5, 3.0])
def test_a_faint_trail_is_that_of_sub_exposures_within_002_dn(renderer, scale, psf_sigma_px):
    simulator = turning(psf_sigma_px=psf_sigma_px, reference_peak_dn=150.0 / scale**2)
    scene = simulator.scene(Exposure(OPENS_S, 0.5, trail="analytic"))
    star, peak_dn = brightest_on_wide_pixels(scene, scale)
    fine = simulator.scene(Exposure(OPENS_S, 0.5, SUB_EXPOSURES / 0.5, "sprites"))
    drawn, expected = light(renderer, with_stars(scene, star)), light_of(with_stars(fine, star))
    assert peak_dn > TRUNCATION_DN
    assert np.abs(drawn - expected).max() <= TRUNCATION_DN
    assert drawn.sum() == pytest.approx(expected.sum(), rel=0.01)


@pytest.mark.usefixtures("reduced_whatever_it_saves")
@pytest.mark.parametrize("scale", SCALES)
@pytest.mark.parametrize(
    ("lens", "readout_s"),
    [(None, 0.05), (Lens("plumb_bob", (-0.2, 0.0, 0.0, 0.0, 0.0)), 0.0)],
    ids=["rolling", "barrel"],
)
def test_a_faint_trail_by_rows_and_behind_a_lens_is_that_on_the_pixels_of_the_image(
    renderer, monkeypatch, scale, lens, readout_s
):
    simulator = turning(lens=lens, psf_sigma_px=2.0, reference_peak_dn=150.0 / scale**2)
    scene = simulator.scene(Exposure(OPENS_S, 0.5, trail="analytic", readout_s=readout_s))
    star, peak_dn = brightest_on_wide_pixels(scene, scale)
    drawn = light(renderer, with_stars(scene, star))
    expected = exact(renderer, with_stars(scene, star), monkeypatch)
    assert peak_dn > TRUNCATION_DN
    assert np.abs(drawn - expected).max() <= TRUNCATION_DN
    assert drawn.sum() == pytest.approx(expected.sum(), rel=0.01)


@pytest.mark.parametrize("size", [(1014, 760, 967.7425), (1013, 759, 967.7425)])
def test_a_turn_of_200_deg_per_s_keeps_its_light(renderer, monkeypatch, size):
    scene = turning(size=size).scene(Exposure(OPENS_S, 0.5, trail="analytic"))
    reduced = reduced_scenes(gaussian_scenes(scene)).reduced
    assert sum(len(part.draw_list) for parts in reduced.values() for part in parts) > 0.8 * len(scene.draw_list)
    drawn, expected = light(renderer, scene), exact(renderer, scene, monkeypatch)
    assert drawn.sum() == pytest.approx(expected.sum(), rel=1e-3)
    # Without wide pixels, what is cut off around stars adds up to 0.078 DN in a pixel and 0.008 DN rms.
    assert np.abs(drawn - expected).max() < 0.078
    assert (drawn - expected).std() < 0.015


@pytest.mark.parametrize(
    ("deg_per_s", "reference_peak_dn", "effects"),
    [
        (0.0, 150.0, {}),
        (10.0, 150.0, {}),
        (200.0, 1e5, {}),
        (200.0, 150.0, {"sensor.mosaic": "rggb", "sensor.band": "imx477"}),
    ],
    ids=["still", "slow", "bright", "mosaic"],
)
def test_stars_that_rest_bright_trails_and_mosaics_are_drawn_on_the_pixels_of_the_image(
    deg_per_s, reference_peak_dn, effects
):
    simulator = turning(deg_per_s, size=(1014, 760, 967.7425), reference_peak_dn=reference_peak_dn, effects=effects)
    scenes = gaussian_scenes(simulator.scene(Exposure(OPENS_S, 0.5, trail="analytic")))
    divided = reduced_scenes(scenes)
    assert divided.reduced == {}
    assert list(divided.full) == scenes
