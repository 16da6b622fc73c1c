"""What a renderer refuses, sums again and leaves out, on small images."""

from dataclasses import replace
from typing import NamedTuple

import moderngl
import numpy as np
import pytest

from glstar.camera.exposure import Exposure
from glstar.camera.sensor.sensor import ElectronModel, Sensor
from glstar.errors import RenderError
from glstar.render.motion.pointing import Pointing
from glstar.render.opengl import GLRenderer
from glstar.render.opengl.targets import Targets
from glstar.render.scene.scene import Scene
from tests.support.scenes import NIGHT_UTC_S, camera, sky_over_adelaide, stars_at


def test_a_renderer_refuses_what_it_cannot_draw(renderer: GLRenderer) -> None:
    scene = stars_at([[30.0, 20.0]], [3.0], sensor=Sensor(), lens=camera(64, 48))
    for use in (renderer.read, renderer.texture):
        with pytest.raises(RenderError) as refused:
            use()
        assert str(refused.value) == "nothing has been developed yet"
    for seed in (-1, 2**32):
        with pytest.raises(RenderError) as refused:
            renderer.develop(scene, seed=seed)
        assert str(refused.value) == f"a seed is a whole number from 0 to 4294967295, not {seed}"
    renderer.expose(scene)
    with pytest.raises(RenderError, match="nothing has been developed yet"):
        renderer.read()
    renderer.develop(scene, seed=2**32 - 1)
    assert renderer.read().frame().light_dn is None
    with pytest.raises(TypeError) as refused:
        renderer.render(replace(scene, trails=_NoTrails(scene.trails.pointing)), seed=0)
    assert str(refused.value) == "no render pass draws _NoTrails"
    # The target was not filled: the same scene is drawn again.
    expected = renderer.render(scene, seed=0, light=True).light_dn
    assert expected is not None
    assert expected.max() > 50


class _NoTrails(NamedTuple):
    """Trails that no pass draws."""

    pointing: Pointing


def test_light_is_summed_again_only_where_it_changes(renderer: GLRenderer, monkeypatch: pytest.MonkeyPatch) -> None:
    scene = stars_at([[30.0, 20.0]], [3.0], sensor=Sensor(), lens=camera(64, 48))
    summed: list[Scene] = []
    expose = GLRenderer._expose_all

    def counted(self: GLRenderer, scene: Scene, targets: Targets) -> None:
        summed.append(scene)
        expose(self, scene, targets)

    monkeypatch.setattr(GLRenderer, "_expose_all", counted)
    first = renderer.render(scene, seed=1, light=True)
    again = renderer.render(replace(scene, sensor=replace(scene.sensor, sky_mean_dn=90.0)), seed=1, light=True)
    assert len(summed) == 1
    np.testing.assert_array_equal(first.light_dn, again.light_dn)
    assert int(again.pixels.mean()) == 90
    texture = renderer.texture()
    assert renderer.holds(texture)
    assert not renderer.holds(None)
    kinds = (8, 9, 8)
    for bits, count in zip(kinds, (1, 2, 3), strict=True):
        renderer.render(replace(scene, sensor=replace(scene.sensor, bit_depth=bits)), seed=1)
        assert len(summed) == count
    assert not renderer.holds(texture)
    smaller = replace(scene, camera=camera(63, 48))
    assert renderer.render(smaller, seed=1).pixels.shape == (48, 63)
    assert renderer.driver == f"{renderer.context.info['GL_RENDERER']}, {renderer.context.info['GL_VERSION']}"
    renderer.close()
    with pytest.raises(RenderError, match="nothing has been developed yet"):
        renderer.read()


def test_noise_is_left_out_on_demand(renderer: GLRenderer) -> None:
    model = ElectronModel(sky_e_per_s=400.0, black_level_dn=50.0)
    scene = stars_at([[30.0, 20.0]], [9.0], sensor=Sensor(electrons=model, bit_depth=12), lens=camera(64, 48))
    for noiseless in (True, False):
        renderer.develop(scene, seed=3, noiseless=noiseless)
        pixels = renderer.read().frame().pixels
        assert (np.unique(pixels[:, :10]).size > 1) != noiseless
        level = 50 + (400 + 0.2) * 0.5 * 0.47
        assert pixels[:, :10].mean() == pytest.approx(level, rel=0, abs=0.5 if noiseless else 3.0)


def test_a_stacked_image_is_read_and_shown_as_a_whole(renderer: GLRenderer) -> None:
    base = sky_over_adelaide(camera(64, 48, 60.0), sensor=Sensor(), vmag_limit=4.0)
    scene = base.scene(Exposure(NIGHT_UTC_S + 1.0, 0.1, frames=3))
    assert len(scene.shorts) == 3
    with pytest.raises(RenderError, match="a stacked image has no flux of its own"):
        renderer.expose(scene)
    frame = renderer.render(scene, seed=4)
    assert renderer.stacked is frame
    assert renderer.read().frame() is frame
    texture = renderer.texture()
    assert texture.size == (64, 48)
    np.testing.assert_array_equal(np.frombuffer(texture.read(), frame.pixels.dtype).reshape(48, 64), frame.pixels)
    assert renderer.holds(texture)
    single = renderer.render(scene.shorts[1], seed=4)
    assert renderer.stacked is None
    shown = renderer.texture()
    assert shown is not texture
    assert renderer.holds(shown)
    np.testing.assert_array_equal(np.frombuffer(shown.read(), np.uint8).reshape(48, 64), single.pixels)
    renderer.render(scene, seed=4)
    renderer.close()
    for use in (renderer.read, renderer.texture):
        with pytest.raises(RenderError, match="nothing has been developed yet"):
            use()


def test_a_renderer_of_its_own_context_releases_it() -> None:
    renderer = GLRenderer.headless()
    assert not isinstance(renderer.context.mglo, moderngl.mgl.InvalidObject)
    renderer.close()
    assert isinstance(renderer.context.mglo, moderngl.mgl.InvalidObject)
