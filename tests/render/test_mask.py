"""Trail masks without an image, against every star's light in every pixel, one star and one sample at a time."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.special import erf

from glstar.camera.exposure import Exposure
from glstar.camera.sensor.sensor import ElectronModel, Sensor
from glstar.camera.vignetting import Vignetting
from glstar.render.scene.scene import Scene
from glstar.render.scene.transmission import Transmission
from glstar.render.truth import mask as mask_module
from glstar.render.truth.mask import _Gaussian, _Patch, _patch_around, _samples, mask_threshold_dn, trail_mask
from tests.support.scenes import camera, stars_at

LENS = camera(70, 50, 300.0)
WIDE = Sensor(psf_sigma_px=1.6, sky_std_dn=3.0)
# Beside the border, on it, one beside another, and one behind which another one is hidden.
XY_PX = [(20.2, 30.7), (23.9, 29.5), (55.0, 12.4), (55.3, 12.0), (69.8, 40.1), (-0.9, 20.0), (40.0, 48.9)]
VMAG = [1.0, 2.0, 3.0, 1.5, 2.2, 0.6, 5.2]


def in_pixels(offset_px: np.ndarray, sensor: Sensor) -> np.ndarray:
    """Return the fraction of a star's light in pixels along one axis: of a narrow one the integral over the pixel."""
    if sensor.psf_sigma_px < 1.1:
        ends = [erf((offset_px + half) / (np.sqrt(2) * sensor.psf_sigma_px)) / 2 for half in (0.5, -0.5)]
        return ends[0] - ends[1]
    variance = sensor.psf_sigma_px**2 + 1 / 12
    return np.exp(-(offset_px**2) / (2 * variance)) / np.sqrt(2 * np.pi * variance)


def light_of(scene: Scene, passage: np.ndarray | None = None) -> np.ndarray:
    """Return the light of each star in each pixel, (stars, height, width) DN."""
    lens, sensor = scene.camera, scene.sensor
    (paths,) = scene.star_paths(scene.stars.direction_eq)
    flux = sensor.flux_dn(sensor.peak_dn(scene.stars.vmag, scene.exposure.duration_s))
    image = np.zeros((len(flux), lens.height_px, lens.width_px))
    for time, fraction in enumerate(paths.time_fraction):
        for star, (x, y) in enumerate(paths.xy_px[:, time].T):
            if np.isfinite(x):
                across, down = (
                    in_pixels(np.arange(side) - at, sensor) for side, at in ((lens.width_px, x), (lens.height_px, y))
                )
                passed = 1.0 if passage is None else passage[time, star]
                image[star] += passed * fraction * flux[star] * np.outer(down, across)
    return image


def dominant(light: np.ndarray, threshold_dn: float) -> tuple[np.ndarray, np.ndarray]:
    """Return which star is brightest in each pixel, from 1, and where that is clear by a thousandth."""
    levels = np.concatenate([np.full((1, *light.shape[1:]), threshold_dn), light])
    first, second = np.sort(levels, axis=0)[[-1, -2]]
    return levels.argmax(axis=0), first > 1.001 * second


@pytest.mark.parametrize("turn", [0.0, 0.06])
@pytest.mark.parametrize("sensor", [WIDE, Sensor(psf_sigma_px=0.5, sky_std_dn=1.0)])
def test_a_pixel_belongs_to_the_star_that_leaves_most_light_there(sensor: Sensor, turn: float) -> None:
    scene = stars_at(XY_PX, VMAG, sensor=sensor, lens=LENS, n=40, turn=lambda u: (turn * u, 0.4 * turn * u))
    expected, is_clear = dominant(light_of(scene), mask_threshold_dn(scene))
    found = trail_mask(scene)
    assert (found.dtype, found.shape) == (np.uint16, (50, 70))
    assert is_clear.mean() > 0.99
    np.testing.assert_array_equal(found[is_clear], expected[is_clear])
    assert len(np.unique(found)) >= 6


def test_the_threshold_is_the_noise_of_a_pixel_without_stars() -> None:
    scene = stars_at(XY_PX, VMAG, sensor=WIDE, lens=LENS, n=2)
    assert mask_threshold_dn(scene) == pytest.approx(np.sqrt(9 + 1 / 12), rel=1e-12)
    stack = replace(scene, exposure=replace(scene.exposure, frames=4))
    assert mask_threshold_dn(stack) == pytest.approx(np.sqrt(9 + 1 / 12) / 2, rel=1e-12)
    electrons = ElectronModel(
        sky_e_per_s=300.0, dark_current_e_per_s=20.0, gain_dn_per_e=0.4,
        read_noise_before_gain_e=2.0, read_noise_after_gain_e=3.0,
    )  # fmt: skip
    counting = replace(scene, sensor=Sensor(psf_sigma_px=1.6, bit_depth=12, electrons=electrons))
    variance = 0.4**2 * (320 * 0.5 + 13) + 1 / 12
    assert mask_threshold_dn(counting) == pytest.approx(np.sqrt(variance), rel=1e-12)


def test_the_shot_noise_of_a_natural_sky_is_a_part_of_the_threshold(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(mask_module, "natural_sky_dn", lambda _scene: 50.0)
    scene = stars_at(
        XY_PX, VMAG, sensor=Sensor(psf_sigma_px=1.6, bit_depth=12, electrons=ElectronModel()), lens=LENS, n=2
    )
    background = scene.sensor.background_std_dn(0.5) ** 2
    assert mask_threshold_dn(scene) == pytest.approx(np.sqrt(background + 0.47 * 50 + 1 / 12), rel=1e-12)


def test_bodies_are_sums_of_their_sources_and_numbered_after_the_stars() -> None:
    places = [(20.0, 20.0), (22.0, 20.5), (50.0, 30.0), (30.0, 90.0), (21.0, 23.0)]
    sources = stars_at(places, [4.0, 4.0, 3.0, 0.0, 4.2], sensor=WIDE, lens=LENS, n=1)
    sources = replace(sources, stars=replace(sources.stars, star_id=np.array([7, 7, 3, 5, 7], np.int32)))
    light = light_of(sources)
    # In the order of their numbers; the one beside the image is none.
    bodies = np.stack([light[2], light[[0, 1, 4]].sum(axis=0)])
    threshold = mask_threshold_dn(sources)
    expected, is_clear = dominant(bodies, threshold)
    expected[expected > 0] += 10
    found, strongest = np.zeros((50, 70), np.uint16), np.full((50, 70), threshold, np.float32)
    assert mask_module._add_bodies(found, strongest, sources, 10) == 2
    np.testing.assert_array_equal(found[is_clear], expected[is_clear])
    assert set(np.unique(found)) == {0, 11, 12}
    np.testing.assert_allclose(strongest, np.maximum(bodies.max(axis=0), threshold), rtol=2e-3)
    # Each alone is too faint where all together are not.
    assert (bodies[1] > threshold).sum() > (light[[0, 1, 4]].max(axis=0) > threshold).sum()


def test_satellites_are_numbered_after_bodies_and_stars_and_none_from_65536_on() -> None:
    scene = stars_at(XY_PX, VMAG, sensor=WIDE, lens=LENS, n=1)
    alone = [stars_at([at], [0.5], sensor=WIDE, lens=LENS, n=1) for at in ((10.0, 10.0), (45.0, 35.0))]
    found = trail_mask(replace(scene, satellites=tuple(alone)))
    assert (found[10, 10], found[35, 45]) == (8, 9)
    assert found[31, 20] == 1
    without = trail_mask(scene)
    np.testing.assert_array_equal(found[(found < 8)], without[found < 8])
    for first, numbers in ((65533, {0, 65534, 65535}), (65534, {0, 65535}), (65535, {0})):
        mask, strongest = np.zeros((50, 70), np.uint16), np.full((50, 70), 3.0, np.float32)
        assert mask_module._add_stars(mask, strongest, scene, first) == 7
        assert set(np.unique(mask)) == numbers
        mask, strongest = np.zeros((50, 70), np.uint16), np.full((50, 70), 3.0, np.float32)
        mask_module._add_bodies(mask, strongest, scene, first)
        assert set(np.unique(mask)) == numbers


@pytest.mark.parametrize("is_narrow", [False, True])
def test_a_gaussian_reaches_as_far_as_it_exceeds_a_level(is_narrow: bool) -> None:
    one = _Gaussian(0.4, 0.8, 1.5, (0.3, -0.7), is_narrow)
    offset = np.arange(-40, 41) / 10
    if is_narrow:
        expected = (erf((offset + 0.5) / (0.8 * np.sqrt(2))) - erf((offset - 0.5) / (0.8 * np.sqrt(2)))) / 2
    else:
        expected = np.exp(-(offset**2) / 4.5) / (np.sqrt(2 * np.pi) * 1.5)
    np.testing.assert_allclose(one.in_pixels(offset), expected, rtol=0, atol=6e-7)
    peak = 0.4 * 1000 / (2 * np.pi * 1.5**2)
    assert one.reach_px(1000.0, peak * 1.0001) == 0
    for level, reach in ((np.exp(-2) * 1.001, 4), (np.exp(-2) * 0.999, 5), (np.exp(-0.5) * 1.001, 3), (1e-12, 10)):
        assert one.reach_px(1000.0, peak * level) == reach


def test_a_patch_collects_light_in_its_own_rectangle(monkeypatch: pytest.MonkeyPatch) -> None:
    rng = np.random.default_rng(4)
    one = _Gaussian(0.4, 0.8, 1.5, (0.3, -0.7), False)
    xy, flux = np.column_stack([rng.uniform(5, 25, 30), rng.uniform(8, 20, 30)]), rng.uniform(10, 90, 30)
    expected = np.zeros((40, 50))
    for (x, y), dn in zip(xy, flux, strict=True):
        for row in range(40):
            for column in range(50):
                if max(abs(column - np.rint(x + 0.3)), abs(row - np.rint(y - 0.7))) <= 3:
                    off = (column - x - 0.3) ** 2 + (row - y + 0.7) ** 2
                    expected[row, column] += 0.4 * dn * np.exp(-off / 4.5) / (2 * np.pi * 1.5**2)
    for at_once in (2048, 7):
        monkeypatch.setattr(mask_module, "_SAMPLES_PER_BLOCK", at_once)
        patch = _Patch((10, 8), (9, 14))
        patch.add(xy, flux, one, 3)
        assert patch.window == (slice(10, 19), slice(8, 22))
        np.testing.assert_allclose(patch.signal_dn, expected[10:19, 8:22], rtol=1e-5, atol=1e-6)
    mask, strongest = np.full((40, 50), 2, np.uint16), np.full((40, 50), 3.0, np.float32)
    patch.mark(mask, strongest, 5)
    inside = np.zeros((40, 50), np.bool_)
    inside[10:19, 8:22] = True
    np.testing.assert_array_equal(mask, np.where(inside & (expected > 3), 5, 2))
    np.testing.assert_allclose(strongest, np.where(inside & (expected > 3), expected, 3.0), rtol=1e-5)


@pytest.mark.parametrize(("xy", "window"), [
    ([(10.2, 12.6), (14.0, 20.4)], (slice(9, 25), slice(6, 19))),
    ([(1.0, 2.0)], (slice(0, 7), slice(0, 6))),
    ([(67.0, 48.0)], (slice(44, 50), slice(63, 70))),
    ([(80.0, -9.0)], (slice(0, 1), slice(69, 70))),
    ([(-9.0, 60.0)], (slice(49, 50), slice(0, 1))),
])  # fmt: skip
def test_a_patch_is_the_part_of_the_image_around_positions(xy: list[tuple[float, float]], window: object) -> None:
    assert _patch_around(np.array(xy), 4, (50, 70)).window == window


def test_samples_are_dimmed_by_cloud_in_their_middle_and_by_the_lens_where_they_are() -> None:
    scene = stars_at(
        [(20.0, 30.0), (60.0, 10.0)], [1.0, 2.0], sensor=WIDE, lens=LENS, n=4, turn=lambda u: (0.1 * u, 0 * u)
    )
    through = Transmission(np.array([[1.0, 0.2], [0.5, 0.4], [0.7, 0.9]]))
    stars = np.array([1, 0])
    cloudy = replace(
        scene, attenuation=SimpleNamespace(steady_transmission=lambda eq: through if len(eq) == 2 else None)
    )
    (paths,) = scene.star_paths(scene.stars.direction_eq[stars])
    xy, weight = _samples(cloudy, stars)
    np.testing.assert_allclose(xy, np.moveaxis(paths.xy_px, 0, -1), rtol=0, atol=1e-9)
    expected = 0.25 * through.at(np.array([0.125, 0.375, 0.625, 0.875]))
    np.testing.assert_allclose(weight, expected, rtol=1e-12)
    lens = {"lens.vignetting": "polynomial", "lens.vignetting_r2": -0.6}
    dark = replace(scene, sensor=replace(WIDE, effects=lens))
    xy, weight = _samples(dark, stars)
    inside = LENS.contains(xy)
    assert 0 < np.count_nonzero(~inside) < 8
    expected = np.full(inside.shape, 0.25)
    expected[inside] *= Vignetting.of(lens).of_stars(LENS, xy[inside])
    np.testing.assert_allclose(weight, expected, rtol=1e-12)
    # A star behind the camera is nowhere.
    behind = replace(scene, stars=replace(scene.stars, direction_eq=scene.stars.direction_eq * [[1.0], [-1.0]]))
    xy, weight = _samples(behind, np.array([0, 1]))
    assert (xy[:, 1] == -1e6).all()
    assert not weight[:, 1].any()
    assert (weight[:, 0] == 0.25).all()


def test_samples_of_a_rolling_shutter_are_those_that_its_rows_record(monkeypatch: pytest.MonkeyPatch) -> None:
    parts = [(np.full((2, 1, 2), 3.0), np.array([0.1, 0.3]), np.array([[0.1], [0.2]])),
             (np.full((1, 1, 2), 4.0), np.array([0.6]), np.array([[0.5]]))]  # fmt: skip
    monkeypatch.setattr(mask_module, "recorded_samples", lambda _scene, _directions: iter(parts))
    scene = stars_at([(20.0, 30.0)], [1.0], sensor=WIDE, lens=LENS, n=2)
    rolling = replace(scene, exposure=Exposure(0.0, 0.5, readout_s=0.1), motion=object())
    xy, weight = _samples(rolling, np.array([0]))
    assert xy[:, 0, 0].tolist() == [3.0, 3.0, 4.0]
    assert weight[:, 0].tolist() == [0.1, 0.2, 0.5]
    # Without a motion the rows cannot be known.
    still, _ = _samples(replace(rolling, motion=None), np.array([0]))
    assert len(still) == 2


def test_several_gaussians_exceed_the_level_together() -> None:
    """Of a star with wings a hundredth of its light is 20 px wide: below the level alone, above a fiftieth of it."""
    sensor = replace(WIDE, effects={"sensor.psf_wing_fraction": 0.3, "sensor.psf_wing_sigma_px": 5.0})
    scene = stars_at([(30.3, 25.1)], [1.0], sensor=sensor, lens=LENS, n=1)
    ((number, patch),) = mask_module._signals(scene, np.array([0]), np.array([1000.0]), 2.0)
    assert number == 0
    profile = np.zeros((50, 70))
    for fraction, sigma in ((0.7, 1.6), (0.3, 5.0)):
        variance = sigma**2 + 1 / 12
        column, row = np.arange(70) - 30.3, np.arange(50)[:, np.newaxis] - 25.1
        profile += 1000 * fraction * np.exp(-(column**2 + row**2) / (2 * variance)) / (2 * np.pi * variance)
    top, left = patch.window
    # A fiftieth of 2 DN.
    widths = ((0.7, np.sqrt(1.6**2 + 1 / 12)), (0.3, np.sqrt(25 + 1 / 12)))
    reaches = [np.ceil(s * np.sqrt(2 * np.log(f * 1000 / (2 * np.pi * s**2 * 0.04)))) + 1 for f, s in widths]
    reach = int(max(reaches))
    assert (top, left) == (slice(max(25 - reach, 0), min(26 + reach, 50)), slice(30 - reach, 31 + reach))
    np.testing.assert_allclose(patch.signal_dn, profile[patch.window], rtol=0, atol=0.05)
    faint = list(mask_module._signals(scene, np.array([0]), np.array([1000.0]), 1e4))
    assert faint == []
    # Of the first star nothing is drawn; numbers are positions in the selection, also of the second block.
    many = stars_at([(30.3, 25.1)] * 300, [1.0] * 300, sensor=WIDE, lens=LENS, n=1)
    flux = np.where(np.isin(np.arange(300), [0, 255, 256, 299]), 1000.0, 1e-3)
    assert [k for k, _ in mask_module._signals(many, np.arange(300), flux, 2.0)] == [0, 255, 256, 299]
