"""Vignetting on images against the closed form, and in the truth."""

import json
from dataclasses import replace
from pathlib import Path

import moderngl
import numpy as np
import pytest

from glstar.camera.exposure import Exposure
from glstar.camera.sensor.sensor import ElectronModel, Sensor
from glstar.camera.vignetting import Vignetting
from glstar.config import Config
from glstar.errors import ConfigError
from glstar.render.effects import EFFECTS, Effect, Stage
from glstar.render.opengl import GLRenderer
from glstar.render.scene.scene import Frame, Scene
from glstar.render.truth.frame import frame_truth
from tests.support.scenes import NIGHT_UTC_S, camera, sky_over_adelaide, stars_at

# A field of 34 by 27 deg off the axis; noise well below a DN.
WIDE = camera(320, 240, 240.0)
QUIET = ElectronModel(
    vmag_0_e_per_s=1e6,
    sky_e_per_s=20_000.0,
    gain_dn_per_e=4.0,
    full_well_e=1e6,
    read_noise_before_gain_e=0.0,
    read_noise_after_gain_e=0.0,
    dark_current_e_per_s=0.0,
    black_level_dn=100.0,
)


def scene_of(sky_e_per_s: float, xy_px: list[list[float]], **lens: float | str) -> Scene:
    effects = {f"lens.{key}": value for key, value in lens.items()}
    sensor = Sensor(bit_depth=16, psf_sigma_px=2.0, electrons=replace(QUIET, sky_e_per_s=sky_e_per_s), effects=effects)
    return stars_at(xy_px, [2.0] * len(xy_px), sensor=sensor, lens=WIDE)


@pytest.mark.parametrize("model", ["cos4", "polynomial", "flat"])
def test_the_sky_falls_off_as_the_flat_field(renderer: GLRenderer, model: str, tmp_path: Path) -> None:
    x, y = np.meshgrid(np.arange(320.0), np.arange(240.0))
    cosine = 1 / np.sqrt(1 + ((x - 159.5) ** 2 + (y - 119.5) ** 2) / 240.0**2)
    squared = ((x - 159.5) ** 2 + (y - 119.5) ** 2) / (160**2 + 120**2)
    expected, keys = cosine**4, {}
    if model == "polynomial":
        expected, keys = 1 - 0.4 * squared, {"vignetting_r2": -0.4}
    if model == "flat":
        expected = 1 - 0.3 * squared
        np.save(tmp_path / "flat.npy", 1000 * expected)
        keys = {"vignetting_file": str(tmp_path / "flat.npy")}
    empty = scene_of(20_000.0, [[10.0, 10.0]], vignetting=model, **keys).with_visible(slice(0))

    image = np.mean([renderer.render(empty, seed=seed).pixels.astype(float) for seed in range(30)], axis=0)

    relative = (image - 100.0) / 40_000.0
    # Noise of 1 % a pixel and frame; a flat field is smoothed over 33 px, which bends its edge.
    blocks = (relative / expected).reshape(12, 20, 16, 20).mean(axis=(1, 3))
    np.testing.assert_allclose(blocks, 1.0, rtol=0, atol=0.02 if model == "flat" else 7e-4)


def test_a_star_falls_off_as_the_cosine_and_the_truth_says_so(renderer: GLRenderer) -> None:
    scene = scene_of(0.0, [[160.0, 120.0], [30.0, 30.0]], vignetting="cos4")

    frames = [renderer.render(scene, seed=seed) for seed in range(10)]
    light = np.mean([frame.pixels.astype(float) for frame in frames], axis=0) - 100.0
    centre, corner = light[105:136, 145:176].sum(), light[15:46, 15:46].sum()

    cosine = 1 / np.sqrt(1 + ((30 - 159.5) ** 2 + (30 - 119.5) ** 2) / 240.0**2)
    assert corner / centre == pytest.approx(cosine, rel=2e-3)
    stars = json.loads(frame_truth(scene, frames[0], number=0, file="frame.png"))["stars"]
    assert [star["transmission"] for star in stars] == pytest.approx([1.0, cosine], rel=1e-5)
    assert stars[1]["flux_e"] / stars[0]["flux_e"] == pytest.approx(cosine, rel=1e-5)


def test_a_star_that_leaves_the_image_is_as_bright_as_where_it_was_on_it() -> None:
    """Polynomials of the falloff hold on the image: far beside it they are thousands."""
    sensor = Sensor(effects={"lens.vignetting": "polynomial", "lens.vignetting_r4": 0.05})
    turn = sky_over_adelaide(WIDE, sensor=sensor, roll_rate_rad_per_s=np.deg2rad(150.0))
    exposure = Exposure(NIGHT_UTC_S + 0.2, 0.9)
    scene = turn.scene(exposure)
    line = json.loads(frame_truth(scene, Frame(np.zeros((240, 320), np.uint8), exposure, 0), number=0, file="frame"))
    beside = [star for star in line["stars"] if star["y_px"] is None or abs(star["y_px"] - 120) > 240]
    assert len(beside) > 10
    # 1.05 over the solid angle in the corner, 40 deg off the axis, and some margin.
    assert all(1.0 <= star["transmission"] <= 2.35 for star in line["stars"])
    assert all(star["trail_peak_dn"] <= 2.35 * star["flux_dn"] for star in line["stars"])


@pytest.mark.parametrize("bit_depth", [8, 16])
@pytest.mark.parametrize(
    ("size", "focal_px", "rtol"),
    [((322, 240), 200.0, 3e-4), ((322, 240), 1500.0, 3e-4), ((4002, 8), 3000.0, 2e-5), ((4002, 8), 9000.0, 2e-5)],
)
def test_every_pixel_falls_off_as_the_cosine(
    context: moderngl.Context, bit_depth: int, size: tuple[int, int], focal_px: float, rtol: float
) -> None:
    # Signal in front of the lens, without noise: transmitted as that of stars.
    most_dn = 0.9 * 2**bit_depth
    glsl = f"vec4 even(vec4 signal_dn, uvec2 quad) {{ return signal_dn + {most_dn}; }}"
    even = Effect(name="even", section="even", keys=(), stage=Stage.SKY_RADIANCE, glsl=glsl)
    sensor = Sensor(bit_depth=bit_depth, sky_mean_dn=0.0, sky_std_dn=0.0, effects={"lens.vignetting": "cos4"})
    wide = replace(camera(*size, focal_px), cx_px=100.0, cy_px=200.0)
    empty = stars_at([[10.0, 10.0]], [2.0], sensor=sensor, lens=wide).with_visible(slice(0))

    with GLRenderer(context, effects=[*EFFECTS, even]) as renderer:
        image = renderer.render(empty, seed=0).pixels

    x, y = np.meshgrid(*map(np.arange, map(float, size)))
    cosine = 1 / np.sqrt(1 + ((x - 100.0) ** 2 + (y - 200.0) ** 2) / focal_px**2)
    np.testing.assert_allclose(image, most_dn * cosine, rtol=rtol, atol=0.501)


def test_the_paper_s_sky_was_measured_behind_the_lens_and_stays(renderer: GLRenderer) -> None:
    sensor = Sensor(sky_std_dn=0.0, effects={"lens.vignetting": "cos4"})
    empty = stars_at([[10.0, 10.0]], [2.0], sensor=sensor, lens=WIDE).with_visible(slice(0))

    assert np.unique(renderer.render(empty, seed=0).pixels).tolist() == [16]


@pytest.mark.parametrize(
    ("keys", "message"),
    [
        ({"lens.vignetting": "flat"}, 'lens.vignetting_file: is missing from vignetting = "flat"'),
        ({"lens.vignetting_file": "flat.png"}, 'lens.vignetting_file: needs vignetting = "flat"'),
        ({"lens.vignetting": "flat", "lens.vignetting_file": "no.png"}, "lens.vignetting_file: cannot be used"),
        ({"lens.vignetting": "cos3"}, 'lens.vignetting: must be "none", "cos4", "polynomial" or "flat", not "cos3"'),
    ],
)
def test_an_invalid_lens_is_refused(keys: dict[str, object], message: str) -> None:
    with pytest.raises(ConfigError) as refused:
        Config().override(**keys)

    assert message in str(refused.value)


def test_vignetting_is_a_value() -> None:
    assert Vignetting.of({"lens.vignetting": "cos4", "sky.x": 1}) == Vignetting("cos4")
