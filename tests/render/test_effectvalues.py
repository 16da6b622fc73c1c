"""Uniforms, options, textures and truth of each effect, for models whose numbers all differ."""

import json
from dataclasses import asdict, replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from glstar.camera.distortion import Lens
from glstar.camera.exposure import Exposure
from glstar.camera.model import Camera, Mount
from glstar.camera.sensor.pixelpattern import PixelPattern
from glstar.camera.sensor.sensor import ElectronModel, Sensor
from glstar.camera.vignetting import Vignetting
from glstar.errors import ConfigError
from glstar.render.effects import EFFECTS, Effect, active_effects, effects_truth
from glstar.render.effects.cloud import (
    axis_transmission,
    crossing_at,
    frame_transmission,
    is_below_cloud,
    sky_fraction,
    transmission_at,
    transmission_towards,
)
from glstar.render.effects.effect import quads_of
from glstar.render.effects.electrons import bloomed
from glstar.render.effects.sky import (
    FINE_GRID,
    SMOOTH_GRID,
    beyond_lens,
    has_natural_sky,
    interpolates_by_quads,
    node_positions,
    node_rays,
    relative_sky,
    softened,
    uniform_sky_dn,
    with_halfway_nodes,
)
from glstar.render.scene.clouds import cloud_sheet, sheet_crossing
from glstar.render.scene.scene import Scene
from tests.support.scenes import NIGHT_UTC_S, sky_over_adelaide, stars_at

LENS = Camera(62, 48, 70.0, 50.0, 30.0, 25.5, 0.6)
MODEL = ElectronModel(
    sky_e_per_s=40.0, gain_dn_per_e=0.7, analogue_gain=3.0, full_well_e=900.0, black_level_dn=70.0,
    read_noise_before_gain_e=2.0, read_noise_after_gain_e=4.5, dark_current_e_per_s=9.0, temperature_c=32.0,
)  # fmt: skip
DN_PER_E, READ_E, DARK_E = 2.1, np.hypot(2.0, 1.5), 9.0 * 2.0 * 0.4
BY_NAME = {effect.name: effect for effect in EFFECTS}


def scene_of(model: ElectronModel | None = MODEL, *, lens: Camera = LENS, **effects: Any) -> Scene:
    keys = {key.replace("__", "."): value for key, value in effects.items()}
    sensor = Sensor(electrons=model, bit_depth=12, effects=keys)
    return stars_at([[5.0, 5.0], [20.0, 9.0]], [3.0, 4.0], sensor=sensor, lens=lens, duration_s=0.4)


def uniforms(name: str, scene: Scene) -> dict[str, Any]:
    effect = BY_NAME[name]
    return dict(effect.uniforms(effect.values(scene.sensor), scene))


def truth(name: str, scene: Scene) -> dict[str, Any]:
    effect = BY_NAME[name]
    return dict(effect.truth(effect.values(scene.sensor), scene))


def options(name: str, scene: Scene) -> dict[str, int]:
    effect = BY_NAME[name]
    return dict(effect.options(effect.values(scene.sensor), scene))


def test_electrons_become_digital_numbers_in_each_effect() -> None:
    scene = scene_of(sensor__row_noise_e=3.0, sensor__black_drift_dn=5.0)
    # From this mean signal on, six standard deviations of shot noise reach the full well.
    near_full_e = (np.sqrt(9 + 900) - 3) ** 2
    assert near_full_e + 6 * np.sqrt(near_full_e) == pytest.approx(900)
    near_full_dn = pytest.approx(DN_PER_E * near_full_e, rel=1e-12)
    assert uniforms("full_pixels", scene) == {"counted_dn_per_e": pytest.approx(2.1), "counted_from_dn": near_full_dn}
    assert uniforms("shot_noise", scene) == {
        "shot_dn_per_e": pytest.approx(2.1), "shot_from_dn": near_full_dn, "shot_full_dn": pytest.approx(2.1 * 900),
        "shot_read_variance_dn2": pytest.approx((2.1 * READ_E) ** 2, rel=1e-9),
    }  # fmt: skip
    assert uniforms("row_noise", scene) == {"row_noise_dn": pytest.approx(6.3), "black_drift_dn": 5.0}
    assert uniforms("dark_current", scene) == {"dark_dn": pytest.approx(2.1 * DARK_E)}
    assert uniforms("full_well", scene) == {"full_well_dn": pytest.approx(1890.0)}
    assert uniforms("black_level", scene) == {"black_level_dn": 70.0}
    assert uniforms("quantisation", scene) == {"saturation_dn": 4095.0}
    assert uniforms("uniform_sky", scene) == {"uniform_sky_dn": pytest.approx(2.1 * 40 * 0.4)}
    assert uniforms("sky_map", scene) == {"sky_map_dn": pytest.approx(2.1 * 40 * 0.4)}
    assert uniforms("blooming", scene) == uniforms("dark_pattern", scene) == uniforms("response_pattern", scene) == {}
    noiseless = scene_of(replace(MODEL, read_noise_before_gain_e=0.0, read_noise_after_gain_e=0.0))
    assert uniforms("shot_noise", noiseless)["shot_read_variance_dn2"] == 1e-9
    assert truth("shot_noise", scene) == {
        "sensor": {
            "noise": "electrons", "vmag_0_e_per_s": 90_000.0, "dn_per_e": pytest.approx(2.1), "black_level_dn": 70.0,
            "read_noise_e": pytest.approx(READ_E), "full_well_e": 900.0, "temperature_c": 32.0,
            "sky_e": pytest.approx(16.0), "dark_e": pytest.approx(DARK_E),
        }
    }  # fmt: skip
    assert [options("row_noise", scene_of(sensor__black_drift_dn=dn)) for dn in (0.0, 0.5)] == [
        {"BLACK_DRIFT": 0}, {"BLACK_DRIFT": 1},
    ]  # fmt: skip
    active = BY_NAME["row_noise"].is_active
    assert [active({"row_noise_e": e, "black_drift_dn": dn}) for e, dn in ((0, 0), (1, 0), (0, 1))] == [
        False,
        True,
        True,
    ]


def test_a_shorter_formula_serves_little_skewness() -> None:
    # The skewness is largest where the mean is twice the read variance: 2 / sqrt(27) / r, and little up to 0.3.
    limit_e = 2 / np.sqrt(27) / 0.3
    for part, skewed in ((0.99, 1), (1.01, 0)):
        model = replace(MODEL, read_noise_before_gain_e=part * limit_e, read_noise_after_gain_e=0.0)
        assert options("shot_noise", scene_of(model)) == {"SHOT_SKEWED": skewed}
        read2 = (part * limit_e) ** 2
        mean = np.linspace(0.1, 20, 2000)
        assert (mean / (mean + read2) ** 1.5).max() == pytest.approx(0.3 / part, rel=1e-4)


def test_blooming_takes_its_direction_threshold_and_fraction() -> None:
    effect = BY_NAME["blooming"]
    for along in ("columns", "rows"):
        scene = scene_of(sensor__blooming=along, sensor__blooming_fraction=0.6)
        values = effect.values(scene.sensor)
        transfer = effect.transfer(values, scene)
        assert (transfer.along, transfer.threshold_dn) == (along, pytest.approx(1890.0))
        line = np.array([[100.0, 1890.0 + 600.0, 1700.0, 0.0]])
        # 60 % of the excess of 600, half of it to each side: 180 and 180.
        np.testing.assert_allclose(transfer.moved(line), [[280.0, 1890.0, 1880.0, 0.0]], rtol=1e-12)
        assert truth("blooming", scene) == {"blooming": {"along": along, "fraction": 0.6}}
    active = effect.is_active
    cases = (("none", 1.0), ("rows", 0.0), ("columns", 0.1), ("rows", 1.0))
    assert [active({"blooming": along, "blooming_fraction": part}) for along, part in cases] == [
        False,
        False,
        True,
        True,
    ]


def test_charge_from_both_sides_shares_the_room() -> None:
    # Excesses of 8 and 12 around two pixels of room 3 and 4: either side comes first, and the mean of both remains.
    line = np.array([[10.0, 18.0, 7.0, 6.0, 22.0, 9.0, 9.5]])
    found = bloomed(line, 10.0)
    # From the left 4 and from the right 6 into a room of 7: first left, 3 + 1 and 0 + 3; first right, 1 + 2 and ... 4.
    from_left = np.array([3.0, 4.0])
    from_right = np.array([3.0, 4.0])
    np.testing.assert_allclose(found[0, 2:4], [7, 6] + (from_left + from_right) / 2, rtol=1e-12)
    # To the right end go 6: 1, then 0.5, and the rest leaves.
    np.testing.assert_allclose(found[0, [0, 1, 4, 5, 6]], [10, 10, 10, 10, 10], rtol=1e-12)
    # Into a room of 8 between two pixels go 6 and 3: the rest, 1, passes on to the left or to the right.
    either = bloomed(np.array([[0.0, 22.0, 6.0, 6.0, 16.0, 0.0]]), 10.0)
    np.testing.assert_allclose(either, [[6.5, 10, 10, 10, 10, 3.5]], rtol=1e-12)
    partly = bloomed(np.array([[0.0, 0.0, 14.0, 0.0, 0.0], [9.0, 9.5, 14.0, 9.5, 0.0]]), 10.0, 0.5)
    np.testing.assert_allclose(partly, [[0, 1, 10, 1, 0], [9.5, 10, 10, 10, 0.5]], rtol=1e-12)
    assert bloomed(np.array([[3.0, 10.0]]), 10.0).tolist() == [[3.0, 10.0]]


def test_fixed_patterns_are_textures_of_their_arrays(tmp_path: Path) -> None:
    dark_frame = np.arange(62 * 48, dtype=np.float32).reshape(48, 62)
    np.save(tmp_path / "dark.npy", dark_frame)
    keys = {
        "camera_seed": 3, "hot_pixels_per_mpx": 9e4, "dsnu_fraction": 0.2, "prnu_fraction": 0.1,
        "dead_pixels_per_mpx": 2e4,
    }  # fmt: skip
    scene = scene_of(**{f"sensor__{name}": value for name, value in keys.items()})
    pattern = PixelPattern(**keys)
    dark, response = BY_NAME["dark_pattern"], BY_NAME["response_pattern"]
    (of_dark,), (of_response,) = dark.textures, response.textures
    assert (of_dark.sampler, of_dark.per_quad) == ("dark_pattern_dn", True)
    assert (of_response.sampler, of_response.per_quad) == ("response_deviation", True)
    expected = quads_of(2.1 * pattern.dark_e(62, 48, DARK_E))
    np.testing.assert_allclose(of_dark.texels({}, scene), expected, rtol=1e-5)
    np.testing.assert_allclose(of_response.texels({}, scene), quads_of(pattern.response(62, 48)), rtol=1e-6)
    measured = scene_of(sensor__dark_frame=str(tmp_path / "dark.npy"))
    np.testing.assert_allclose(of_dark.texels({}, measured), quads_of(dark_frame - np.median(dark_frame)), rtol=1e-5)
    few = scene_of(sensor__hot_pixels_per_mpx=9e4, sensor__camera_seed=3)
    defects = PixelPattern(camera_seed=3, hot_pixels_per_mpx=9e4).defects(62, 48)
    np.testing.assert_array_equal(dark.only_at({}, few), np.column_stack([defects.x_px, defects.y_px]))
    assert dark.only_at({}, scene) is None
    assert dark.only_at({}, measured) is None
    assert truth("dark_pattern", scene) == truth("response_pattern", scene) == {"pixel_pattern": asdict(pattern)}
    before = of_dark.depends_on({}, scene), of_response.depends_on({}, scene)
    for change, others in (
        (replace(scene, exposure=replace(scene.exposure, duration_s=0.5)), (True, False)),
        (replace(scene, sensor=replace(scene.sensor, electrons=replace(MODEL, gain_dn_per_e=0.8))), (True, False)),
        (replace(scene, camera=replace(LENS, width_px=63)), (True, True)),
        (replace(scene, camera=replace(LENS, height_px=49)), (True, True)),
        (replace(scene, sensor=replace(scene.sensor, effects={})), (True, True)),
    ):
        after = of_dark.depends_on({}, change), of_response.depends_on({}, change)
        assert tuple(a != b for a, b in zip(after, before, strict=True)) == others
    padded = quads_of(np.arange(12.0).reshape(2, 6))
    assert padded.tolist() == [[[0, 1, 2, 3], [4, 5, 0, 0]], [[6, 7, 8, 9], [10, 11, 0, 0]]]


VIGNETTED = {"lens__vignetting": "polynomial", "lens__vignetting_r2": -0.2, "lens__vignetting_r4": 0.05}


@pytest.mark.parametrize(("model", "kind"), [(MODEL, "polynomial"), (MODEL, "cos4"), (None, "cos4")])
def test_vignetting_is_polynomials_around_the_axis(model: ElectronModel | None, kind: str) -> None:
    vignetted = VIGNETTED | {"lens__vignetting": kind}
    scene = scene_of(model, **vignetted)
    fit = Vignetting.of(scene.sensor.effects).fit(LENS)
    found = uniforms("lens_falloff", scene)
    largest = np.sqrt(fit.largest_q)
    # The uniform sky of the electron model was added with its level on the axis, as if it were stars.
    sky_dn = 2.1 * 40 * 0.4 if model else 0.0
    star = [*found["falloff_star_low"], *found["falloff_star_high"]]
    sky = [*found["falloff_sky_low"], *found["falloff_sky_high"]]
    terms = len(fit.star)
    assert (terms < 8) == (kind == "cos4")
    np.testing.assert_allclose(star[:terms], fit.star, rtol=1e-12)
    np.testing.assert_allclose(sky[:terms], sky_dn * (np.array(fit.sky) - fit.star), rtol=1e-9, atol=1e-12)
    assert not any(star[terms:] + sky[terms:])
    assert {key: value for key, value in found.items() if not key.startswith(("falloff_star", "falloff_sky"))} == {
        "falloff_bend": fit.bend, "falloff_per_px": pytest.approx((1 / (70 * largest), 1 / (50 * largest))),
        "falloff_principal_px": (30.0, 25.5), "falloff_shear": pytest.approx(0.6 / 70),
    }  # fmt: skip
    assert truth("lens_falloff", scene) == {"vignetting": kind}
    flat = BY_NAME["flat_falloff"]
    assert uniforms("flat_falloff", scene) == {"flat_sky_dn": pytest.approx(sky_dn)}
    mapped = scene_of(model, sensor__sky_map="sky.npy", **vignetted)
    assert uniforms("flat_falloff", mapped) == {"flat_sky_dn": 0.0}
    for effect, expected in (
        (BY_NAME["lens_falloff"], [False, True, True, False]),
        (flat, [False, False, False, True]),
    ):
        kinds = ("none", "cos4", "polynomial", "flat")
        assert [effect.is_active({"vignetting": one}) for one in kinds] == expected
    (texture,) = flat.textures
    texels = texture.texels({}, scene)
    assert (texture.sampler, texture.per_quad, texels.shape) == ("falloff_of_star_and_sky", False, (97, 129, 2))
    vignetting = Vignetting.of(scene.sensor.effects)
    xy = np.stack(np.meshgrid((np.arange(129) + 0.5) / 129 * 62 - 0.5, (np.arange(97) + 0.5) / 97 * 48 - 0.5), axis=-1)
    np.testing.assert_allclose(texels[..., 0], vignetting.of_stars(LENS, xy), rtol=1e-6)
    np.testing.assert_allclose(texels[..., 1], vignetting.of_sky(LENS, xy), rtol=1e-6)
    assert texture.depends_on({}, scene) == (vignetting, LENS)


@pytest.mark.parametrize(("bit_depth", "half_px"), [(8, 8), (9, 4), (16, 4)])
def test_vignetting_is_curved_within_a_fragment_of_short_lenses(bit_depth: int, half_px: int) -> None:
    scene = scene_of(None, **VIGNETTED)
    fit = Vignetting.of(scene.sensor.effects).fit(LENS)
    assert options("lens_falloff", scene)["FALLOFF_TERMS"] == len(fit.star)
    for part, curved in ((0.97, 1), (1.03, 0)):
        # The second derivative moves the light by half of its curvature times the squared distance: 5e-6.
        distance = np.sqrt(2 * 5e-6 / fit.curvature)
        shortest = part * half_px / distance
        # Curvature and number of terms are taken as those of the first lens.
        bent = SimpleNamespace(fx_px=shortest * 1.3, fy_px=shortest)
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(Vignetting, "fit", lambda _self, _camera: fit)
            other: Any = SimpleNamespace(camera=bent, sensor=SimpleNamespace(effects={}, bit_depth=bit_depth))
            found = BY_NAME["lens_falloff"].options({}, other)
        assert found == {"FALLOFF_TERMS": len(fit.star), "FALLOFF_CURVED": curved}


def test_a_map_of_the_sky_has_its_own_mean(tmp_path: Path) -> None:
    np.save(tmp_path / "sky.npy", np.array([[1.0, 3.0], [5.0, 7.0]], np.float32))
    np.testing.assert_allclose(relative_sky(str(tmp_path / "sky.npy")), [[0.25, 0.75], [1.25, 1.75]], rtol=1e-6)
    np.save(tmp_path / "faint.npy", np.array([[0.0, 0.5], [0.25, 0.25]], np.float32))
    assert relative_sky(str(tmp_path / "faint.npy")).tolist() == [[0.0, 2.0], [1.0, 1.0]]
    scene = scene_of(sensor__sky_map=str(tmp_path / "sky.npy"))
    effect = BY_NAME["sky_map"]
    values = effect.values(scene.sensor)
    (texture,) = effect.textures
    u, v = (np.clip(2 * (np.arange(n) + 0.5) / n - 0.5, 0, 1) for n in (62, 48))
    expected = quads_of(0.25 + 0.5 * u + 1.0 * v[:, np.newaxis])
    np.testing.assert_allclose(texture.texels(values, scene), expected, rtol=1e-5)
    assert texture.depends_on(values, scene) == (str(tmp_path / "sky.npy"), 62, 48)
    assert truth("sky_map", scene) == {"sky_map": str(tmp_path / "sky.npy")}
    names = [effect.name for effect in active_effects(scene.sensor)]
    assert "sky_map" in names
    assert "uniform_sky" not in names
    paper = scene_of(None, sensor__sky_map=str(tmp_path / "sky.npy"))
    assert "sky_level" not in [effect.name for effect in active_effects(paper.sensor)]
    assert uniform_sky_dn(paper) == 16.0
    assert [has_natural_sky(Sensor(effects=e)) for e in ({}, {"sky.brightness": "natural"})] == [False, True]
    for content, limits in (([[-1.0, 2.0]], "from -1 to 2"), ([[0.0, 0.0]], "from 0 to 0")):
        path = tmp_path / f"{limits}.npy"
        np.save(path, np.array(content, np.float32))
        with pytest.raises(ConfigError) as refused:
            relative_sky(str(path))
        assert str(refused.value) == (
            f"sensor.sky_map: cannot be used: {path} holds numbers {limits}; a sky is 0 or brighter everywhere, and"
            " brighter than 0 somewhere"
        )


def test_nodes_reach_the_edges_and_rays_the_limit_of_a_lens() -> None:
    assert (SMOOTH_GRID, FINE_GRID) == ((97, 73), (193, 145))
    nodes = node_positions(LENS, (5, 4))
    assert nodes.shape == (4, 5, 2)
    np.testing.assert_allclose(nodes[2, :, 0], [-0.5, 15.0, 30.5, 46.0, 61.5], rtol=1e-14)
    np.testing.assert_allclose(nodes[:, 3, 1], [-0.5, 15.5, 31.5, 47.5], rtol=1e-14)
    assert [interpolates_by_quads(replace(LENS, width_px=width), (97, 73)) for width in (1535, 1536)] == [True, False]
    np.testing.assert_allclose(node_rays(LENS, (5, 4)), LENS.unit_vectors(nodes), rtol=1e-14)
    limit_rad = np.deg2rad(20.0)
    lens = Camera(62, 48, 70.0, 50.0, 30.0, 25.5, 0.0, Lens("fisheye", (), limit_rad))
    rays = node_rays(lens, (5, 4))
    x, y = np.moveaxis((node_positions(lens, (5, 4)) - [30.0, 25.5]) / [70.0, 50.0], -1, 0)
    theta = np.minimum(np.hypot(x, y), limit_rad)
    around = np.arctan2(y, x)
    expected = np.stack([np.sin(theta) * np.cos(around), np.sin(theta) * np.sin(around), np.cos(theta)], axis=-1)
    np.testing.assert_allclose(rays, expected, rtol=0, atol=1e-7)
    assert np.count_nonzero(np.hypot(x, y) > limit_rad) > 5
    pixels = np.stack(np.meshgrid(np.arange(62), np.arange(48)), axis=-1)
    seen = np.linalg.norm((pixels - [30.0, 25.5]) / [70.0, 50.0], axis=-1)
    beyond = beyond_lens(lens)
    assert beyond is not None
    known = np.abs(seen - limit_rad) > 1e-3
    np.testing.assert_array_equal(beyond[known], (seen > limit_rad)[known])
    assert beyond_lens(LENS) is None
    assert beyond_lens(replace(lens, lens=Lens("fisheye", (), 1.5))) is None
    # A single corner is enough.
    corner = replace(lens, cx_px=0.0, cy_px=0.0, lens=Lens("fisheye", (), float(np.hypot(61 / 70, 47 / 50)) - 0.005))
    assert np.count_nonzero(beyond_lens(corner)) > 0
    circle = BY_NAME["image_circle"]
    scene = scene_of(lens=lens)
    assert [options("image_circle", scene), options("image_circle", scene_of())] == [
        {"IMAGE_CIRCLE": 1},
        {"IMAGE_CIRCLE": 0},
    ]
    (texture,) = circle.textures
    np.testing.assert_array_equal(texture.texels({}, scene), quads_of(1.0 - beyond))
    assert (texture.sampler, texture.per_quad, texture.depends_on({}, scene)) == ("seen_by_lens", True, lens)
    rows = np.array([[1.0, 3.0, 11.0], [5.0, 7.0, 17.0]])
    assert with_halfway_nodes(rows).tolist() == [[1, 2, 3, 7, 11], [3, 4, 5, 9.5, 14], [5, 6, 7, 12, 17]]
    blurred = softened(np.array([[4.0, 8.0, 0.0], [0.0, 16.0, 32.0]]))
    # Along columns with the border twice, then along rows.
    columns = np.array([[3.0, 10.0, 8.0], [1.0, 14.0, 24.0]])
    one, two, three = columns.T
    expected = np.column_stack([3 * one + two, one + 2 * two + three, two + 3 * three]) / 4
    np.testing.assert_allclose(blurred, expected, rtol=1e-14)


def test_point_spread_colours_and_processing_are_in_truth() -> None:
    effects = {"sensor__psf_wing_fraction": 0.2, "sensor__psf_wing_sigma_px": 5.0}
    found = truth("point_spread", scene_of(**effects))["psf"]
    sensor = scene_of(**effects).sensor
    components = sensor.point_spread.circular(sensor.psf_sigma_px)
    assert found.pop("gaussians") == [[one.flux_fraction, one.sigma_px] for one in components]
    assert found == {"psf_sigma_px": sensor.psf_sigma_px, **sensor.point_spread.keys}
    assert len(components) == 2
    scene = scene_of(sensor__band="imx477", sensor__mosaic="grbg", sensor__sky_bv=1.2)
    bv = np.array([0.3, np.nan])
    scene = replace(scene, stars=replace(scene.stars, catalogue="gaia", bv=bv))
    assert truth("colour_band", scene) == {
        "colour": {"band": "imx477", "mosaic": "grbg", "assumed_bv": 0.65, "without_bv": [2]}
    }
    colour = scene.sensor.colour
    ratio = colour.sky_ratio
    levels = {"mosaic_even_row": (ratio["g"], ratio["r"]), "mosaic_odd_row": (ratio["b"], ratio["g"])}
    assert uniforms("mosaic_of_stars", scene) == uniforms("mosaic_of_sky", scene) == levels
    assert len(set(ratio.values())) == 3
    for name in ("mosaic_of_stars", "mosaic_of_sky"):
        assert [BY_NAME[name].is_active({"mosaic": one}) for one in ("none", "rggb")] == [False, True]
    assert [BY_NAME["colour_band"].is_active({"band": one}) for one in ("v", "bare")] == [False, True]
    assert [BY_NAME["scintillation"].is_active({"scintillation": one}) for one in (0.0, 0.1)] == [False, True]
    processing: Effect = BY_NAME["camera_processing"]
    raw = scene_of(output__align="high")
    assert truth("camera_processing", raw) == {"output": {"align": "high", "shift_bits": 4}}
    cases = (("raw", "low"), ("raw", "high"), ("isp", "low"))
    assert [processing.is_active({"process": p, "align": a}) for p, a in cases] == [False, True, True]
    isp = truth("camera_processing", scene_of(output__process="isp", output__red_gain=2.5))["output"]
    names = {key.name for key in processing.keys} - {"align", "tone_curve"}
    assert isp == {name: processing.values(Sensor())[name] for name in names} | {"process": "isp", "red_gain": 2.5}
    curved = scene_of(output__process="isp", output__tone_curve="0,0;0.5,0.75;1,1")
    assert truth("camera_processing", curved)["output"]["tone_curve"] == ((0, 0), (0.5, 0.75), (1, 1))
    whole = effects_truth(raw)
    assert whole["output"] == {"align": "high", "shift_bits": 4}
    assert whole["sensor"]["noise"] == "electrons"
    assert json.loads(json.dumps(whole)) == whole


CLOUD = {"cloud.coverage": 1.0, "cloud.edge": 0.01, "cloud.optical_depth": 0.7}


def sky_scene(*, pitch_deg: float = 11.0, height_m: float = 4000.0, coverage: float = 1.0) -> Scene:
    sensor = Sensor(effects=CLOUD | {"cloud.height_m": height_m, "cloud.coverage": coverage})
    mount = Mount(0.3, np.deg2rad(pitch_deg), 0.2)
    base = sky_over_adelaide(LENS, sensor=sensor, mount=mount, vmag_limit=2.0, roll_rate_rad_per_s=0.5)
    return base.scene(Exposure(NIGHT_UTC_S + 2.0, 0.4))


def sines(scene: Scene, xy_px: np.ndarray) -> np.ndarray:
    """Return the sines of the altitudes of what pixels see in the middle of the exposure."""
    return LENS.unit_vectors(xy_px) @ scene.shutter.C_camera_eq[1] @ scene.shutter.zenith_eq[1]


def test_cloud_transmits_along_lines_of_sight_above_the_horizon() -> None:
    scene = sky_scene()
    x, y = np.meshgrid(np.arange(0.0, 62.0, 7.0), np.arange(0.0, 48.0, 3.0))
    xy_px = np.stack([x, y], axis=-1)
    up = sines(scene, xy_px)
    impact = np.sqrt(1 - up**2) * (6371008.8 + scene.site.height_m) / (6371008.8 + 4000.0)
    expected = np.where(up >= 0, np.exp(-0.7 / np.sqrt(1 - impact**2)), 1.0)
    assert 0.05 < np.mean(up > 0) < 0.95
    sure = np.abs(up) > 0.02
    np.testing.assert_allclose(transmission_at(scene, xy_px)[sure], expected[sure], rtol=1e-3)
    assert transmission_at(scene, xy_px).shape == x.shape
    axis = sky_scene(pitch_deg=30.0)
    up = float(axis.shutter.boresight_eq[1] @ axis.shutter.zenith_eq[1])
    impact = np.sqrt(1 - up**2) * (6371008.8 + 50.0) / (6371008.8 + 4000.0)
    assert axis_transmission(axis) == pytest.approx(np.exp(-0.7 / np.sqrt(1 - impact**2)), rel=1e-3)
    assert axis_transmission(sky_scene(pitch_deg=-30.0)) == 1.0
    # Evenly over the image, at 49 columns and 37 rows.
    x, y = np.meshgrid((np.arange(49) + 0.5) / 49 * 62 - 0.5, (np.arange(37) + 0.5) / 37 * 48 - 0.5)
    up = sines(scene, np.stack([x, y], axis=-1)).ravel()
    assert sky_fraction(scene) == round(np.mean(up >= 0), 4)
    impact = np.sqrt(1 - up[up >= 0] ** 2) * (6371008.8 + 50.0) / (6371008.8 + 4000.0)
    mean = frame_transmission(scene)
    assert mean == pytest.approx(np.exp(-0.7 / np.sqrt(1 - impact**2)).mean(), rel=3e-4)
    assert mean == round(mean, 6) != round(mean, 5)
    assert (sky_fraction(sky_scene(pitch_deg=-60.0)), frame_transmission(sky_scene(pitch_deg=-60.0))) == (0.0, None)
    assert truth("cloud", scene) == {"cloud_transmission": mean}


def test_a_sheet_of_cloud_is_above_or_below_the_aircraft_or_none() -> None:
    above, below, none = sky_scene(), sky_scene(height_m=20.0), sky_scene(coverage=0.0)
    assert [is_below_cloud(scene) for scene in (above, below, none)] == [True, False, False]
    up = above.shutter.zenith_eq[1:2]
    for scene in (below, none):
        np.testing.assert_array_equal(transmission_towards(scene, up), [1.0])
        assert frame_transmission(scene) == 1.0
    assert crossing_at(none, 1, up) is None
    assert transmission_towards(above, up)[0] == pytest.approx(np.exp(-0.7), rel=1e-3)
    # At the start, the middle and the end of the exposure, with the zenith and the drift of that time.
    sheet = cloud_sheet(above.sensor, above.motion)
    assert sheet is not None
    broken = replace(above, sensor=replace(above.sensor, effects=above.sensor.effects | {"cloud.coverage": 0.5}))
    sheet = cloud_sheet(broken.sensor, broken.motion)
    directions = LENS.unit_vectors(np.array([[5.0, 2.0], [30.0, 1.0]])) @ above.shutter.C_camera_eq[1]
    for time, utc_s in enumerate((NIGHT_UTC_S + 2.0, NIGHT_UTC_S + 2.2, NIGHT_UTC_S + 2.4)):
        zenith = broken.shutter.zenith_eq[time]
        latitude, longitude, height = broken.motion.flight.position.coordinates(np.array([utc_s]))
        site = float(latitude[0]), float(longitude[0]), float(height[0])
        expected = sheet_crossing(sheet, directions @ zenith, directions, zenith, site, utc_s)
        found = crossing_at(broken, time, directions)
        np.testing.assert_array_equal(found.optical_depth, expected.optical_depth)
        np.testing.assert_array_equal(found.slant, expected.slant)
    effect = BY_NAME["cloud"]
    cases = ((0.0, 2.0), (0.5, 0.0), (0.5, 2.0))
    assert [effect.is_active({"coverage": c, "optical_depth": d}) for c, d in cases] == [False, False, True]
