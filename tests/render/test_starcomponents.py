"""Stars in the band and the mosaic of a camera, and as sums of Gaussians, by their magnitudes and widths."""

from dataclasses import replace

import numpy as np
import pytest

from glstar.camera.sensor.pointspread import FAINTEST_COMPONENT_DN
from glstar.camera.sensor.sensor import Sensor
from glstar.render.motion.trailmodels import AnalyticSegments
from glstar.render.scene import starcomponents
from glstar.render.scene.scene import Scene
from glstar.render.scene.starcomponents import (
    cell_tints,
    drawn_peak_dn,
    gaussian_scenes,
    in_band,
    mean_of_cells,
    psf_scale,
)
from glstar.sky.air.extinction import Extinction
from tests.support.scenes import camera, stars_at

LENS = camera(120, 90, 300.0)
BV = np.array([-0.2, 0.4, np.nan, 1.5])
KNOWN_BV = np.array([-0.2, 0.4, 0.65, 1.5])
MOSAIC = {"sensor.band": "imx219", "sensor.mosaic": "grbg"}
# Slope, curvature and photons of the Raspberry Pi Camera Module 2.
RESPONSE = {
    "mean": (0.142, -0.086, 1.0),
    "r": (-0.359, -0.035, 0.727),
    "g": (0.075, -0.032, 1.126),
    "b": (0.673, -0.077, 1.022),
}


def scene_of(effects: dict[str, object], n: int = 6, step_rad: float = 0.0, **changed: object) -> Scene:
    sensor = Sensor(psf_sigma_px=1.6, effects=effects, **changed)
    scene = stars_at([(60.0, 44.0), (20.0, 30.0), (110.0, 80.0), (5.0, 85.0)], [3.0, 4.0, 5.0, 6.0], sensor=sensor,
                     lens=LENS, n=n, turn=lambda u: (n * step_rad * u, 0 * u))  # fmt: skip
    return replace(scene, stars=replace(scene.stars, bv=BV, catalogue="bodies"))


def minus_v(channel: str, bv: np.ndarray) -> np.ndarray:
    slope, curvature, photons = RESPONSE[channel]
    return slope * bv + curvature * bv**2 - 2.5 * np.log10(photons)


def ratios(channel: str) -> np.ndarray:
    """Return the flux of the stars in the pixels of a channel over that of their magnitude in the mean band."""
    return 10 ** (-0.4 * (minus_v(channel, KNOWN_BV) - minus_v("mean", KNOWN_BV)))


def test_magnitudes_in_a_band_follow_from_the_colour_but_where_they_were_measured() -> None:
    scene = scene_of(MOSAIC)
    stars, colour = scene.stars, scene.sensor.colour
    banded = in_band(stars, colour)
    np.testing.assert_allclose(banded.camera_mag, stars.vmag + minus_v("mean", KNOWN_BV), rtol=1e-12)
    assert in_band(stars, colour) is banded
    assert in_band(stars, Sensor().colour) is stars
    measured = replace(stars, measured_mag=np.array([1.0, 2.0, 3.0, 4.0]))
    assert in_band(measured, colour) is measured
    some = replace(measured, is_measured=np.array([True, False, True, False]))
    expected = np.where(some.is_measured, some.camera_mag, stars.vmag + minus_v("mean", KNOWN_BV))
    np.testing.assert_allclose(in_band(some, colour).camera_mag, expected, rtol=1e-12)


@pytest.mark.parametrize(("guard_px", "cells"), [(0, "grbg"), (1, "gbrg"), (2, "grbg")])
def test_the_pixels_of_a_mosaic_have_the_tints_of_their_channels(guard_px: int, cells: str) -> None:
    scene = scene_of(MOSAIC)
    tints = cell_tints(scene, guard_px)
    assert tints.dtype == np.float32
    np.testing.assert_allclose(tints, np.stack([ratios(channel) for channel in cells], axis=1), rtol=1e-6)
    assert cell_tints(scene_of({}), guard_px) is None
    # A row of the guard band exchanges the rows.
    cell_mean = mean_of_cells(scene, np.array([3, 0]))
    expected = (ratios("r") + 2 * ratios("g") + ratios("b")) / 4
    np.testing.assert_allclose(cell_mean, expected[[3, 0]], rtol=1e-12)
    assert mean_of_cells(scene_of({}), np.array([3, 0])) == 1.0


def test_the_brightest_channel_of_a_star_decides_how_far_it_is_drawn() -> None:
    plain, scene = scene_of({}), scene_of(MOSAIC)
    peak = plain.sensor.peak_dn(plain.stars.vmag, 0.5)
    np.testing.assert_allclose(drawn_peak_dn(plain), peak, rtol=1e-12)
    brightest = np.max([ratios(channel) for channel in "rgb"], axis=0)
    np.testing.assert_allclose(drawn_peak_dn(scene), peak * brightest, rtol=1e-12)
    air = Extinction(by_channel=True)
    mags = np.array([0.0, 0.5, 1.0, 2.0])
    hazy = replace(scene, extinction=air, draw_list=replace(scene.draw_list, extinction_mag=mags))
    zenith = air.zenith_mag(scene.site.height_m)
    excess = {
        channel: air.at_wavelength(scene.sensor.colour.wavelength_nm(channel)).zenith_mag(scene.site.height_m) / zenith
        - 1
        for channel in "rgb"
    }
    assert excess["b"] > 0.1 > 0 > excess["r"]
    through = {channel: ratios(channel) * 10 ** (-0.4 * mags * excess[channel]) for channel in "rgb"}
    observed = scene.sensor.peak_dn(scene.stars.vmag + mags, 0.5)
    np.testing.assert_allclose(drawn_peak_dn(hazy), observed * np.max(list(through.values()), axis=0), rtol=1e-9)
    np.testing.assert_allclose(
        cell_tints(hazy, 0), np.stack([through[channel] for channel in "grbg"], axis=1), rtol=1e-6
    )
    # The tints of the field itself stay.
    np.testing.assert_allclose(cell_tints(scene, 0)[:, 1], ratios("r"), rtol=1e-6)
    grey = replace(hazy, extinction=Extinction())
    np.testing.assert_allclose(drawn_peak_dn(grey), observed * brightest, rtol=1e-12)
    assert starcomponents._extinction_over_mean(replace(hazy, sensor=Sensor())) is None


def test_widths_are_those_of_the_place_in_the_middle_of_the_exposure() -> None:
    scene = scene_of({"sensor.psf_growth": 0.6, "sensor.psf_tilt": 0.2})
    xy = np.array([(60.0, 44.0), (20.0, 30.0), (110.0, 80.0), (5.0, 85.0)])
    offset = (xy - [59.5, 44.5]) / 75.0
    exact = 1 + 0.6 * (offset**2).sum(axis=1) + 0.2 * offset[:, 0]
    np.testing.assert_allclose(psf_scale(scene, scene.stars.direction_eq), exact, rtol=0.0101)
    step = np.floor(np.log(exact) / np.log(1.02)) + 0.5
    np.testing.assert_allclose(psf_scale(scene, scene.stars.direction_eq), 1.02**step, rtol=1e-9)
    # Behind the camera, and far outside: near a corner in that direction.
    far = np.array([[0.0, 0.0, -1.0], [5.0, 0.0, 1.0], [0.0, -5.0, 1.0]])
    far /= np.linalg.norm(far, axis=1, keepdims=True)
    exact = 1 + 0.6 + 0.2 * np.array([np.sqrt(0.5), 1.0, 0.0])
    step = np.floor(np.log(exact) / np.log(1.02)) + 0.5
    np.testing.assert_allclose(psf_scale(scene, far), 1.02**step, rtol=1e-9)
    assert psf_scale(scene_of({}), far).tolist() == [1.0] * 3


def test_a_plain_star_is_drawn_as_it_is_and_in_a_mosaic_as_far_as_its_brightest_colour() -> None:
    plain = scene_of({})
    assert gaussian_scenes(plain) == [plain]
    scene = scene_of(MOSAIC)
    (found,) = gaussian_scenes(scene)
    sensor = scene.sensor
    radius = sensor.truncation_radius_px(drawn_peak_dn(scene), scene.draw_list.min_trail_px)
    expected = np.maximum(radius, scene.draw_list.truncation_radius_px)
    np.testing.assert_allclose(found.draw_list.truncation_radius_px, expected, rtol=1e-12)
    trail = replace(scene, trails=AnalyticSegments(scene.shutter, np.ones(1)))
    (found,) = gaussian_scenes(trail)
    radius = sensor.truncation_radius_px(drawn_peak_dn(scene), scene.draw_list.min_trail_px, renormalized=True)
    expected = np.maximum(radius, scene.draw_list.truncation_radius_px)
    np.testing.assert_allclose(found.draw_list.truncation_radius_px, expected, rtol=1e-12)


@pytest.mark.parametrize("is_analytic", [False, True])
def test_wings_and_rows_are_scenes_of_one_gaussian_each(is_analytic: bool) -> None:
    effects = {"sensor.psf_wing_fraction": 0.01, "sensor.psf_wing_sigma_px": 6.0, "sensor.psf_ellipticity": 0.3,
               "sensor.psf_angle_rad": 0.6}  # fmt: skip
    scene = scene_of(effects, n=12, step_rad=0.7 / 300)
    if is_analytic:
        scene = replace(scene, trails=AnalyticSegments(scene.shutter, np.ones(1)))
    else:
        passage = np.tile(np.arange(12, dtype=np.float32) / 12, (4, 1))
        scene = replace(scene, draw_list=replace(scene.draw_list, passage=passage))
    components = scene.sensor.point_spread.components(1.6)
    found = gaussian_scenes(scene)
    assert len(components) > 3
    assert len(found) == len(components)
    for part, component in zip(found, components, strict=True):
        sensor = part.sensor
        assert (sensor.psf_sigma_px, part.bodies) == (component.sigma_px, None)
        flux = sensor.flux_dn(sensor.peak_dn(3.0, 0.5)) / scene.sensor.flux_dn(scene.sensor.peak_dn(3.0, 0.5))
        assert flux == pytest.approx(component.flux_fraction, rel=1e-9)
        assert (part.camera.cx_px, part.camera.cy_px) == (59.5 + component.offset_px[0], 44.5 + component.offset_px[1])
        peak = sensor.peak_dn(scene.stars.vmag, 0.5)
        kept = sensor.max_trail_peak_dn(peak, scene.draw_list.min_trail_px) >= FAINTEST_COMPONENT_DN
        assert part.draw_list.index.tolist() == np.flatnonzero(kept).tolist()
        radius = sensor.component_radius_px(peak[kept], scene.draw_list.min_trail_px[kept], renormalized=is_analytic)
        np.testing.assert_allclose(part.draw_list.truncation_radius_px, radius, rtol=1e-12)
        if is_analytic:
            assert part.trails is scene.trails
        else:
            group = 12 // len(part.trails)
            means = (np.arange(12) / 12).reshape(-1, group).mean(axis=1)
            np.testing.assert_allclose(part.draw_list.passage, np.tile(means, (kept.sum(), 1)), rtol=1e-6)
    if not is_analytic:
        # Wings of 6 px share sub-exposures of 0.7 px, up to 9 px.
        assert [len(part.trails) for part in found][-1] == 1
        assert len(found[0].trails) > 3
    # Of a faint star the wings do not show.
    faint = replace(scene, stars=replace(scene.stars, vmag=np.array([3.0, 20.0, 20.0, 20.0])))
    assert {tuple(part.draw_list.index.tolist()) for part in gaussian_scenes(faint)} == {(0,)}


def test_stars_of_the_same_width_are_drawn_together_with_bodies_and_satellites() -> None:
    scene = scene_of({"sensor.psf_growth": 0.9})
    scales = psf_scale(scene, scene.stars.direction_eq)
    found = gaussian_scenes(scene)
    widths = [part.sensor.psf_sigma_px for part in found]
    np.testing.assert_allclose(widths, 1.6 * np.unique(scales), rtol=1e-12)
    assert [part.draw_list.index.tolist() for part in found] == [
        np.flatnonzero(scales == one).tolist() for one in np.unique(scales)
    ]
    plain, satellite = scene_of({}), scene_of({}, n=2)
    both = replace(plain, satellites=(satellite, satellite))
    assert gaussian_scenes(both) == [both, satellite, satellite]
