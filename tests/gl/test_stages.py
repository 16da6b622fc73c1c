"""Exposing, developing and reading, one by one."""

from dataclasses import replace

import numpy as np
import pytest

from glstar.camera.exposure import Exposure
from glstar.camera.sensor.sensor import Sensor
from glstar.errors import RenderError
from glstar.render.opengl import GLRenderer
from tests.support.scenes import camera, stars_at

SCENE = stars_at([[50.2, 40.7]], [0.0], sensor=Sensor(), lens=camera())


@pytest.fixture
def exposed(monkeypatch):
    """Return the scenes whose flux is summed."""
    scenes = []
    expose = GLRenderer._expose_all

    def recorded(self, scene, targets):
        scenes.append(scene)
        expose(self, scene, targets)

    monkeypatch.setattr(GLRenderer, "_expose_all", recorded)
    return scenes


def test_the_stages_one_by_one_draw_what_render_draws(renderer):
    expected = renderer.render(SCENE, seed=3, light=True)
    with GLRenderer(renderer.context) as other:
        other.expose(SCENE)
        other.develop(SCENE, seed=3, light=True)
        frame = other.read().frame()
        shown = np.frombuffer(other.texture().read(), np.uint8).reshape(240, 320)
    np.testing.assert_array_equal(frame.pixels, expected.pixels)
    np.testing.assert_array_equal(frame.light_dn, expected.light_dn)
    np.testing.assert_array_equal(shown, expected.pixels)
    assert (frame.seed, frame.exposure) == (3, SCENE.exposure)


def test_another_noise_or_seed_does_not_expose_again(renderer, exposed):
    brighter = replace(SCENE, sensor=replace(SCENE.sensor, sky_mean_dn=99.0))
    for scene, seed in ((SCENE, 1), (SCENE, 2), (brighter, 2)):
        renderer.develop(scene, seed=seed)
    assert exposed == [SCENE]
    with GLRenderer(renderer.context) as fresh:
        np.testing.assert_array_equal(renderer.read().frame().pixels, fresh.render(brighter, seed=2).pixels)


@pytest.mark.parametrize(
    "other",
    [
        replace(SCENE, sensor=replace(SCENE.sensor, reference_peak_dn=90.0)),
        replace(SCENE, sensor=replace(SCENE.sensor, bit_depth=12)),
        replace(SCENE, camera=camera(320, 240, 301.0)),
        replace(SCENE, exposure=Exposure(0.0, 0.6, trail="sprites")),
        stars_at([[50.2, 40.7]], [0.0], sensor=Sensor(), lens=camera()),
    ],
    ids=["brightness", "bits", "lens", "duration", "equal arrays"],
)
def test_every_change_of_the_flux_exposes_again(renderer, exposed, other):
    renderer.render(SCENE, seed=1)
    pixels = renderer.render(other, seed=1).pixels
    assert exposed == [SCENE, other]
    with GLRenderer(renderer.context) as fresh:
        np.testing.assert_array_equal(pixels, fresh.render(other, seed=1).pixels)


def test_a_bright_star_that_enters_the_image_creates_no_new_targets(renderer):
    both = stars_at([[50.2, 40.7], [90.1, 80.4]], [-1.5, 6.0], sensor=Sensor(psf_sigma_px=5.0), lens=camera())
    faint = both.with_visible(slice(1, None))
    assert (
        both.draw_list.truncation_radius_px[1] < 23 < both.draw_list.truncation_radius_px[0]
    )  # on both sides of a multiple of 8 px, the step of the guard band
    renderer.develop(faint, seed=0)
    texture = renderer.texture()
    renderer.develop(both, seed=0)
    assert renderer.holds(texture)
    assert renderer.texture() is texture
    renderer.develop(SCENE.with_sensor(Sensor(bit_depth=12)), seed=0)
    assert not renderer.holds(texture)


def test_a_scene_that_was_not_developed_cannot_be_read(renderer):
    with pytest.raises(RenderError, match="nothing has been developed"):
        renderer.read()
    renderer.expose(SCENE)
    with pytest.raises(RenderError, match="nothing has been developed"):
        renderer.read()


def test_images_are_read_in_the_order_in_which_they_were_started(renderer):
    other = stars_at([[20.7, 30.1]], [1.0], sensor=Sensor(bit_depth=12), lens=camera(101, 83))
    expected = [renderer.render(scene, seed=seed) for scene, seed in ((SCENE, 1), (other, 2), (SCENE, 3))]
    pending = []
    for scene, seed in ((SCENE, 1), (other, 2), (SCENE, 3)):
        renderer.develop(scene, seed=seed)
        pending.append(renderer.read())
    for frame, each in zip(expected, pending, strict=True):
        read = each.frame()
        np.testing.assert_array_equal(read.pixels, frame.pixels)
        assert (read.seed, read.exposure, read.pixels.dtype) == (frame.seed, frame.exposure, frame.pixels.dtype)
        assert each.frame() is read


def test_a_frame_that_is_read_while_another_is_drawn_is_that_of_render(renderer):
    expected = renderer.render(SCENE, seed=4, light=True)
    renderer.develop(SCENE, seed=4, light=True)
    first = renderer.read()
    renderer.develop(SCENE.with_visible(slice(0)), seed=5)
    frame, dark = first.frame(), renderer.read().frame()
    np.testing.assert_array_equal(frame.pixels, expected.pixels)
    np.testing.assert_array_equal(frame.light_dn, expected.light_dn)
    assert (dark.seed, dark.light_dn) == (5, None)
    assert (dark.pixels != frame.pixels).any()


def test_a_discarded_frame_is_not_returned(renderer):
    renderer.develop(SCENE, seed=1)
    discarded = renderer.read()
    discarded.discard()
    renderer.develop(SCENE, seed=2)
    assert renderer.read().frame().seed == 2
    with pytest.raises(RenderError, match="discarded"):
        discarded.frame()


def test_a_frame_of_a_closed_renderer_is_not_returned(renderer):
    with GLRenderer(renderer.context) as other:
        other.develop(SCENE, seed=1)
        pending, read = other.read(), other.read()
        frame = read.frame()
    with pytest.raises(RenderError, match="closed"):
        pending.frame()
    assert read.frame() is frame


@pytest.mark.parametrize("width_px", [1, 2, 3, 5, 318, 319])
@pytest.mark.parametrize("bit_depth", [8, 16])
def test_an_image_of_any_width_is_the_left_part_of_a_wider_one(renderer, width_px, bit_depth):
    wide, narrow = (
        stars_at([[1.2, 40.7]], [0.0], sensor=Sensor(bit_depth=bit_depth), lens=replace(camera(), width_px=width))
        for width in (320, width_px)
    )
    pixels = renderer.render(wide, seed=3).pixels[:, :width_px]
    np.testing.assert_array_equal(renderer.render(narrow, seed=3).pixels, pixels)
    renderer.develop(narrow, seed=3)
    shown = renderer.texture()
    assert shown.size == (width_px, 240)
    np.testing.assert_array_equal(np.frombuffer(shown.read(alignment=1), pixels.dtype).reshape(pixels.shape), pixels)
