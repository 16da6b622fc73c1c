"""Resources of a renderer, from creation to release, and invalid arguments."""

import gc
import weakref
from dataclasses import replace

import moderngl
import pytest

from glstar.camera.distortion import Lens
from glstar.camera.exposure import Exposure
from glstar.camera.sensor.sensor import Sensor
from glstar.errors import ContextError, RenderError, ShaderError
from glstar.render.opengl import GLRenderer
from glstar.render.opengl import program as program_module
from glstar.render.opengl.context import headless_context
from glstar.render.truth.frame import frame_truth
from glstar.system import resources
from tests.support.scenes import NIGHT_UTC_S, camera, sky_over_adelaide, stars_at

MAKERS = ("program", "vertex_array", "buffer", "texture", "framebuffer")


def test_a_closed_renderer_leaves_nothing_on_the_gpu(context, monkeypatch):
    made = []
    for maker in MAKERS:
        make = getattr(context, maker)

        def recorded(*args, _make=make, **kwargs):
            made.append(_make(*args, **kwargs))
            return made[-1]

        monkeypatch.setattr(context, maker, recorded, raising=False)
    with GLRenderer(context) as renderer:
        for sensor in (Sensor(), Sensor(psf_sigma_px=0.5), Sensor(bit_depth=16)):
            for lens in (camera(), replace(camera(), lens=Lens("plumb_bob", (-0.1,)))):
                renderer.render(stars_at([[50.2, 40.7]], [0.0], sensor=sensor, lens=lens), seed=0)
    assert len(made) > 10
    assert all(isinstance(resource.mglo, moderngl.mgl.InvalidObject) for resource in made)


def test_a_scene_with_a_natural_sky_is_freed_with_its_flight_and_stars_when_nothing_refers_to_it():
    sky = {"sky.brightness": "natural", "cloud.coverage": 0.3, "sky.scintillation": 0.3}
    simulator = sky_over_adelaide(camera(), sensor=Sensor(effects=sky))
    scene = simulator.scene(Exposure(NIGHT_UTC_S + 1.0, 0.5))
    with GLRenderer.headless() as renderer:
        line = frame_truth(scene, renderer.render(scene, seed=0), number=0, file="frame.png")
    assert b'"sky_mag_arcsec2"' in line
    alive = [weakref.ref(part) for part in (scene.stars, scene.listing, simulator.flight.attitude)]
    assert all(part() is not None for part in alive)

    del simulator, scene, renderer
    gc.collect()
    assert [part() for part in alive] == [None, None, None]


def test_closing_again_has_no_effect():
    renderer = GLRenderer.headless()
    renderer.close()
    renderer.close()


def test_two_renderers_in_one_process_are_independent():
    scene = stars_at([[50.2, 40.7]], [0.0], sensor=Sensor(), lens=camera())
    with GLRenderer.headless() as one, GLRenderer.headless() as other:
        expected = one.render(scene, seed=1).pixels
        mixed = [renderer.render(scene, seed=1).pixels for renderer in (other, one, other)]
    assert all((pixels == expected).all() for pixels in mixed)


def test_a_sigma_too_large_for_a_sprite_is_refused_with_the_limit(context, renderer):
    limit_px = int(context.info["GL_POINT_SIZE_RANGE"][1])  # 255 of llvmpipe, 2047 of GPUs
    scene = stars_at([[50.2, 40.7]], [0.0], sensor=Sensor(psf_sigma_px=limit_px / 4), lens=camera())
    with pytest.raises(
        RenderError,
        match=rf"psf_sigma_px = [\d.]+ requires sprites of \d+ px and this driver draws at most {limit_px} px",
    ):
        renderer.render(scene, seed=0)


def test_an_image_larger_than_the_driver_s_limit_is_refused(renderer):
    scene = stars_at([[50.2, 40.7]], [0.0], sensor=Sensor(), lens=camera(65000, 10))
    with pytest.raises(RenderError, match="larger than this driver draws"):
        renderer.render(scene, seed=0)


def test_a_shader_that_does_not_compile_is_named_with_its_line(context, monkeypatch):
    def broken(name):
        source = resources.shader(name)
        return source.replace("out float light_dn;", "out float light_dn; nonsense;") if name == "star.frag" else source

    monkeypatch.setattr(program_module, "shader", broken)
    with pytest.raises(ShaderError) as caught:
        GLRenderer(context)
    assert caught.value.file == "star.frag"
    assert caught.value.line is not None


def test_a_missing_device_is_refused_with_a_message():
    with pytest.raises(ContextError, match="glstar doctor"):
        headless_context(device_index=77)


def test_the_environment_chooses_the_device(monkeypatch):
    monkeypatch.setenv("GLSTAR_DEVICE", "77")
    with pytest.raises(ContextError, match="77"):
        headless_context()
    monkeypatch.setenv("GLSTAR_DEVICE", "the fast one")
    with pytest.raises(ContextError, match="is not a number"):
        headless_context()


def test_the_caller_s_context_stays_current(context):
    scene = stars_at([[50.2, 40.7]], [0.0], sensor=Sensor(), lens=camera())
    with GLRenderer(context) as renderer:
        context.buffer(b"made").release()
        renderer.render(scene, seed=0)
        context.buffer(b"drawn").release()
    context.buffer(b"closed").release()


def test_a_closed_renderer_draws_no_more():
    renderer = GLRenderer.headless()
    renderer.close()
    with pytest.raises(RenderError, match="closed"):
        renderer.render(stars_at([[50.2, 40.7]], [0.0], sensor=Sensor(), lens=camera()), seed=0)


@pytest.mark.parametrize("seed", [-1, 2**32])
def test_a_seed_has_32_bits(renderer, seed):
    with pytest.raises(RenderError, match="seed"):
        renderer.render(stars_at([[50.2, 40.7]], [0.0], sensor=Sensor(), lens=camera()), seed=seed)
