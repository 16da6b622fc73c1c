"""Sensor and sky effects: order, GLSL, uniforms, textures, and the example of the manual."""

import json
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import cv2
import moderngl
import numpy as np
import pytest
from numpy.typing import NDArray

from glstar.camera.sensor.pointspread import PSF_KEYS
from glstar.camera.sensor.sensor import Sensor
from glstar.errors import RenderError, ShaderError
from glstar.render.effects import (
    EFFECTS,
    Effect,
    EffectTexture,
    Key,
    Stage,
    active_effects,
    effects_truth,
    light_keys,
    scaled_keys,
)
from glstar.render.opengl import GLRenderer
from glstar.render.scene.clouds import CLOUD_DEFAULTS
from glstar.render.scene.scene import Scene
from glstar.render.truth.frame import frame_truth
from tests.examples import add_an_effect
from tests.examples.add_an_effect import PANE
from tests.support.scenes import camera, stars_at

Draw = Callable[..., NDArray[np.uint16]]

# Without noise and with 16 bits, pixels show the signal to half a digital number.
CLEAN = Sensor(sky_mean_dn=2000.0, sky_std_dn=0.0, bit_depth=16, reference_peak_dn=20000.0, psf_sigma_px=3.0)
ROUNDING_DN = 0.502


@pytest.fixture
def draw(context: moderngl.Context) -> Draw:
    """Draw a scene with some effects besides those of glstar."""

    def drawn(scene: Scene, *effects: Effect) -> NDArray[np.uint16]:
        with GLRenderer(context, effects=[*EFFECTS, *effects]) as renderer:
            return renderer.render(scene, seed=5).pixels

    return drawn


def scene_of(sensor: Sensor = CLEAN) -> Scene:
    """Return a wide field with stars at its centre and in its corners."""
    return stars_at(
        [[160.0, 120.0], [12.0, 10.0], [300.0, 230.0]], [3.0, 3.0, 3.0], sensor=sensor, lens=camera(320, 240, 150.0)
    )


def effect(name: str, glsl: str, stage: Stage = Stage.TRANSMISSION, **given: object) -> Effect:
    return Effect(name=name, section=name, keys=(), stage=stage, glsl=glsl, **given)  # type: ignore[arg-type]


def test_a_pane_of_glass_passes_what_fresnels_equations_say(draw: Draw, context: moderngl.Context) -> None:
    scene = scene_of(replace(CLEAN, effects={"pane.refractive_index": 1.5}))
    with GLRenderer(context) as renderer:
        light_dn = renderer.render(scene, seed=5, light=True).light_dn
    x, y = np.meshgrid(np.arange(320.0), np.arange(240.0))
    ray = scene.camera.unit_vectors(np.stack([x, y], axis=-1))
    outside_rad = np.arccos(ray[..., 2])
    inside_rad = np.arcsin(np.sin(outside_rad) / 1.5)
    # Of a face, by the sum and difference of the angles (Hecht, Optics, equations 4.42 and 4.43); on the axis 4 %.
    with np.errstate(invalid="ignore"):
        across = (np.sin(outside_rad - inside_rad) / np.sin(outside_rad + inside_rad)) ** 2
        along = (np.tan(outside_rad - inside_rad) / np.tan(outside_rad + inside_rad)) ** 2

    pixels = draw(scene, PANE)

    passes = sum((1 - reflected) / (1 + reflected) for reflected in (across, along)) / 2
    assert passes[120, 160] == pytest.approx(0.96 / 1.04, abs=1e-4)
    assert passes.min() < 0.9  # the pane dims the corners
    np.testing.assert_allclose(pixels, light_dn * passes + CLEAN.sky_mean_dn, rtol=0, atol=ROUNDING_DN)


def test_an_effect_that_is_off_leaves_every_pixel_as_it_is(draw: Draw) -> None:
    scene = scene_of(Sensor())

    np.testing.assert_array_equal(draw(scene, PANE), draw(scene))
    assert PANE not in active_effects(scene.sensor, [*EFFECTS, PANE])


def test_effects_are_applied_in_the_order_of_their_stages(draw: Draw) -> None:
    halved = effect("halved", "vec4 halved(vec4 signal_dn, uvec2 quad) { return 0.5 * signal_dn; }")
    empty = scene_of().with_visible(slice(0))

    assert np.unique(draw(empty, halved)).tolist() == [2000]  # before the sky is added
    assert np.unique(draw(empty, replace(halved, stage=Stage.NOISE))).tolist() == [1000]
    assert [one.name for one in active_effects(CLEAN, [*reversed(EFFECTS), halved])] == [
        "halved",
        "image_circle",
        "sky_level",
        "noise",
        "quantisation",
    ]


def test_a_texture_covers_the_image_from_its_top_left_corner(draw: Draw) -> None:
    texels = np.array([[0.0, 1.0], [2.0, 3.0]], np.float32)
    texture = EffectTexture("map", lambda _values, _scene: texels, lambda _values, _scene: 0)
    mapped = effect(
        "mapped",
        """
        uniform sampler2D map;
        vec4 mapped(vec4 signal_dn, uvec2 quad) {
            vec4 u = (columns_px(quad) + 0.5) / image_px.x;
            float v = (row_px(quad) + 0.5) / image_px.y;
            return vec4(texture(map, vec2(u.x, v)).r, texture(map, vec2(u.y, v)).r,
                        texture(map, vec2(u.z, v)).r, texture(map, vec2(u.w, v)).r) * 10000.0;
        }
        """,
        textures=(texture,),
    )
    # Texel centres are at a quarter and at three quarters of the image; between them values are interpolated.
    u, v = (np.clip(2 * (np.arange(n) + 0.5) / n - 0.5, 0, 1) for n in (320, 240))
    expected_dn = 10000.0 * (u + 2 * v[:, np.newaxis]) + CLEAN.sky_mean_dn

    # Drivers interpolate in steps of 1/256 of a texel.
    np.testing.assert_allclose(draw(scene_of(), mapped), expected_dn, rtol=0, atol=3 * 10000.0 / 256)


def test_a_texture_is_computed_again_only_when_it_depends_on_something_that_changed(context: moderngl.Context) -> None:
    computed = []

    def texels(values: object, scene: Scene) -> NDArray[np.float32]:
        computed.append(scene.exposure.duration_s)
        return np.full((2, 2), scene.exposure.duration_s, np.float32)

    texture = EffectTexture("level", texels, lambda _values, scene: scene.exposure.duration_s)
    filled = effect(
        "filled",
        """
        uniform sampler2D level;
        vec4 filled(vec4 signal_dn, uvec2 quad) { return vec4(1000.0 * texture(level, vec2(0.5)).r); }
        """,
        textures=(texture,),
    )
    scene = scene_of()
    longer = replace(scene, exposure=replace(scene.exposure, duration_s=2.0))
    with GLRenderer(context, effects=[*EFFECTS, filled]) as renderer:
        levels = [renderer.render(one, seed=0).pixels.max() for one in (scene, scene, longer, longer)]

    assert levels == [2500, 2500, 4000, 4000]
    assert computed == [0.5, 2.0]


def test_a_uniform_without_a_value_is_named(draw: Draw) -> None:
    forgotten = effect(
        "forgotten", "uniform float gain;\nvec4 forgotten(vec4 signal_dn, uvec2 quad) { return gain * signal_dn; }"
    )
    with pytest.raises(RenderError, match="no effect gives a value to the uniform gain"):
        draw(scene_of(), forgotten)


def test_an_effect_has_any_number_of_uniforms(draw: Draw) -> None:
    names = [f"level_{number}_dn" for number in range(60)]
    declared = f"uniform float {', '.join(names)}; // levels\nuniform ivec2 shift_dn;\nuniform uint more_dn;\n"
    level = f"vec4({' + '.join(names)} + shift_dn.y + more_dn)"
    many = effect(
        "many",
        f"{declared}vec4 many(vec4 signal_dn, uvec2 quad) {{ return {level}; }}",
        Stage.SKY,
        uniforms=lambda _values, _scene: dict.fromkeys(names, 10.0) | {"shift_dn": (7, -50), "more_dn": 3},
    )
    assert np.unique(draw(scene_of(), many)).tolist() == [600 - 50 + 3]


def test_a_mistake_in_the_glsl_of_an_effect_is_reported_with_its_line(context: moderngl.Context) -> None:
    wrong = effect("wrong", "// one\n// two\nvec4 wrong(vec4 signal_dn, uvec2 quad) { return brightness; }")
    with pytest.raises(ShaderError) as refused:
        GLRenderer(context, effects=[*EFFECTS, wrong])

    assert (refused.value.file, refused.value.line) == ("effect wrong", 3)


def test_the_truth_of_a_frame_has_the_keys_of_its_effects(renderer: GLRenderer, monkeypatch) -> None:
    scene = scene_of(replace(CLEAN, effects={"pane.refractive_index": 1.5}))
    frame = renderer.render(scene, seed=0)
    assert effects_truth(scene, [*EFFECTS, PANE]) == {"pane": {"refractive_index": 1.5}}
    monkeypatch.setattr("glstar.render.truth.frame.effects_truth", lambda scene: effects_truth(scene, [*EFFECTS, PANE]))

    line = json.loads(frame_truth(scene, frame, number=0, file="frame_000000.png"))

    assert line["pane"] == {"refractive_index": 1.5}


def test_names_keys_and_labels_of_effects_are_unique() -> None:
    names = [one.name for one in EFFECTS]
    keys = [f"{one.section}.{key.name}" for one in EFFECTS for key in one.keys]
    labels = [key.control.label for one in EFFECTS for key in one.keys if key.control is not None]

    for together in (names, keys, labels):
        assert len(set(together)) == len(together)


def test_keys_in_digital_numbers_and_keys_of_starlight_are_those_that_say_so() -> None:
    assert scaled_keys() == {
        "sensor.sky_mean_dn",
        "sensor.sky_std_dn",
        "sensor.black_level_dn",
        "sensor.black_drift_dn",
    }
    shape = {f"sensor.{key}" for key in ("band", "band_slope", "band_curvature", "mosaic")}
    cloud = {f"cloud.{key}" for key in CLOUD_DEFAULTS}
    assert light_keys() == {*PSF_KEYS, *shape, *cloud}
    own = Effect("own", "own", (Key("peak_dn", 1.0, "DN", scales=True, changes_light=True),), Stage.SKY, glsl="")
    assert (scaled_keys([own]), light_keys([own])) == ({"own.peak_dn"}, {"own.peak_dn"})


def test_missing_values_are_defaults() -> None:
    keys = (Key("gain", 2.0, "a number"), Key("kind", "a", "a letter", choices=("a", "b")))
    some = Effect(name="some", section="some", keys=keys, stage=Stage.SKY, glsl="")

    assert some.values(Sensor(effects={"some.kind": "b"})) == {"gain": 2.0, "kind": "b"}


def test_the_example_draws_an_image_behind_glass(tmp_path: Path) -> None:
    image = tmp_path / "behind-glass.png"
    subprocess.run([sys.executable, add_an_effect.__file__, image], check=True)

    assert cv2.imread(str(image), cv2.IMREAD_UNCHANGED).shape == (760, 1014)
