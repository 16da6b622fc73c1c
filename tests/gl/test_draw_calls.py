"""Draw calls of a few stars, segments and pieces give the same image; light of wide pixels in finer ones."""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace

import moderngl
import numpy as np
import pytest

from glstar.camera.exposure import Exposure
from glstar.camera.model import Camera, Mount
from glstar.camera.sensor.sensor import Sensor
from glstar.flight import AttitudeTrack
from glstar.render.opengl import GLRenderer
from glstar.render.opengl.drawnlens import PINHOLE
from glstar.render.opengl.passes import piece, subexposure, trail
from glstar.render.opengl.passes.enlarge import EnlargePass
from glstar.render.opengl.textures import ReadoutClock, StarTarget
from glstar.render.scene.scene import Scene
from glstar.render.simulator import Simulator
from glstar.rotation import quaternion_from_euler
from tests.support.clouds import CLOUD
from tests.support.scenes import NIGHT_UTC_S, camera, sky_over_adelaide

# Numbers that divide neither the stars nor the segments; of pieces and sub-exposures a multiple of four.
FEW = (
    (trail, "_STARS_PER_CALL", 7), (trail, "_SEGMENTS_PER_CALL", 3), (trail, "_PRIMITIVES_PER_CALL", 11),
    (trail, "_MOST_WAITING", 3), (piece, "STARS_PER_CALL", 9), (piece, "_PIECES_PER_CALL", 40),
    (piece, "_SPRITES_PER_CALL", 41), (piece, "_END_PIECES_PER_CALL", 15), (subexposure, "_SUB_EXPOSURES_PER_CALL", 8),
)  # fmt: skip
EFFECTS = CLOUD | {"sensor.mosaic": "rggb", "sensor.band": "imx477"}


@contextmanager
def few_per_call() -> Iterator[None]:
    with pytest.MonkeyPatch.context() as patch:
        for module, name, number in FEW:
            patch.setattr(module, name, number)
        yield


@pytest.fixture(scope="module")
def renderers(context_of_renderers: moderngl.Context) -> Iterator[tuple[GLRenderer, GLRenderer]]:
    with context_of_renderers, GLRenderer(context_of_renderers) as whole:
        with few_per_call():
            few = GLRenderer(context_of_renderers)
        with few:
            yield whole, few


def shaken(simulator: Simulator) -> Simulator:
    """Return an aircraft that turns by some degrees a second and shakes by a tenth of a degree."""
    t = np.arange(0.0, 1.0, 1 / 200)
    angles_deg = np.outer([8.0, -3.0, 5.0], t) + 0.1 * np.sin(2 * np.pi * np.outer([3.1, 7.7, 11.3], t))
    angles_deg += 0.002 * np.random.default_rng(0).normal(size=(3, t.size))
    track = AttitudeTrack.from_samples(NIGHT_UTC_S + t, quaternion_from_euler(*np.deg2rad(angles_deg)))
    return replace(simulator, flight=replace(simulator.flight, attitude=track))


def scene_of(case: str) -> Scene:
    """Return a scene of some hundred stars behind cloud, in the cells of a mosaic."""
    sensor = Sensor(psf_sigma_px=1.3, bit_depth=16, effects=EFFECTS)
    lens = camera(64, 48, 40.0)
    readout_s = 0.1 if "rolling" in case else 0.0
    if "pieces" in case:
        simulator = shaken(sky_over_adelaide(lens, sensor=sensor, vmag_limit=3.5))
        return simulator.scene(Exposure(NIGHT_UTC_S + 0.2, 0.5, trail="analytic", readout_s=readout_s))
    mount = Mount(pitch_rad=np.deg2rad(60.0))
    simulator = sky_over_adelaide(
        lens, sensor=sensor, mount=mount, vmag_limit=3.5, yaw_rate_rad_per_s=0.15, roll_rate_rad_per_s=0.1
    )
    exposure = Exposure(NIGHT_UTC_S + 2.0, 1.5 if "long" in case else 0.3, readout_s=readout_s)
    return simulator.scene(replace(exposure, trail="sprites" if "sprites" in case else "analytic"))


@pytest.mark.parametrize(
    "case", ["segments", "long segments", "rolling segments", "pieces", "rolling pieces", "sprites", "rolling sprites"]
)
def test_small_draw_calls_give_the_same_light(renderers: tuple[GLRenderer, GLRenderer], case: str) -> None:
    scene = scene_of(case)
    whole, few = renderers
    expected = whole.render(scene, seed=0, light=True).light_dn
    with few_per_call():
        found = few.render(scene, seed=0, light=True).light_dn
    assert expected is not None
    assert expected.max() > 20
    np.testing.assert_allclose(found, expected, rtol=1e-4, atol=1e-5 * float(expected.max()))


@pytest.mark.parametrize(("case", "sigma_px"), [("", 1.3), ("rolling", 1.3), ("", 0.6)])
def test_segments_and_sub_exposures_have_the_same_light(
    renderers: tuple[GLRenderer, GLRenderer], case: str, sigma_px: float
) -> None:
    images = []
    for trail_kind in ("segments", "sprites"):
        scene = scene_of(f"{case} {trail_kind}")
        scene = replace(scene, sensor=replace(scene.sensor, psf_sigma_px=sigma_px))
        images.append(renderers[0].render(scene, seed=0, light=True).light_dn.astype(float))
    segments, sprites = images
    assert segments.max() > 20
    # Cloud is taken once for four sub-exposures, and profiles are cut where they fall below a part of a digital number.
    assert segments.sum() == pytest.approx(sprites.sum(), rel=5e-3)
    np.testing.assert_allclose(segments, sprites, rtol=0, atol=0.02 * segments.max())


def bilinear(values: np.ndarray, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Return values between the centres of texels, whose first is at 0.5, and those of the border beyond."""
    rows, columns = values.shape
    across, down = (np.clip(at - 0.5, 0, size - 1) for at, size in ((x, columns), (y, rows)))
    column, row = (np.minimum(at.astype(int), size - 2) for at, size in ((across, columns), (down, rows)))
    u, v = across - column, (down - row)[:, np.newaxis]
    upper, lower = ((1 - u) * values[r][:, column] + u * values[r][:, column + 1] for r in (row, row + 1))
    return (1 - v) * upper + v * lower


def test_light_of_wide_pixels_is_interpolated_in_finer_ones(context: moderngl.Context) -> None:
    enlarge = EnlargePass(context)
    lens = Camera(30, 21, 40.0, 40.0, 14.5, 10.0)
    texture = context.texture((30 + 16, 21 + 16), 1, dtype="f4")
    clock = ReadoutClock(1, 1.25, (0.002, 0.003, -0.04))
    full = StarTarget(context.framebuffer([texture]), 8, clock, PINHOLE)
    targets = {scale: enlarge.target(full, lens, scale) for scale in (2, 4)}
    assert [targets[scale].light.size for scale in (2, 4)] == [(15 + 4, 11 + 4), (8 + 4, 6 + 4)]
    assert [(t.guard_band_px, t.pixel_width_px, t.lens) for t in targets.values()] == [(2, 2, PINHOLE), (2, 4, PINHOLE)]
    assert [round(t.clock.opening[0], 9) for t in targets.values()] == [0.004, 0.008]
    assert enlarge.target(full, lens, 2).light is targets[2].light
    random = np.random.default_rng(5)
    content = {scale: random.uniform(1, 9, target.light.size[::-1]).astype("f4") for scale, target in targets.items()}
    for scale, target in targets.items():
        target.light.color_attachments[0].write(content[scale])
    for scale in (2, 4):
        full.light.use()
        full.light.clear(red=5.0)
        enlarge.fill(full, targets[scale])
        found = np.frombuffer(full.light.read(components=1, dtype="f4"), "f4").reshape(37, 46)
        # Pixel x of the image has its centre at (x + 0.5) / scale beyond the two of the border.
        x, y = ((np.arange(size) + 0.5) / scale + 2 for size in (30, 21))
        # Drivers interpolate in steps of 1/256 of a texel.
        np.testing.assert_allclose(found[8:29, 8:38], bilinear(content[scale], x, y), rtol=0, atol=8 / 200)
        border = np.ones_like(found, bool)
        border[8:29, 8:38] = False
        assert not found[border].any()
        assert full.light.viewport == (0, 0, 46, 37)
    # Between wide pixels the whole target is filled, its border too.
    targets[2].light.use()
    enlarge.fill(targets[2], targets[4])
    found = np.frombuffer(targets[2].light.read(components=1, dtype="f4"), "f4").reshape(15, 19)
    x, y = ((np.arange(size) + 0.5 - 2) / 2 + 2 for size in (19, 15))
    np.testing.assert_allclose(found, bilinear(content[4], x, y), rtol=0, atol=8 / 200)
    context.detect_framebuffer(0).use()  # a bound target cannot be released
    larger = enlarge.target(full, replace(lens, width_px=40), 2)
    assert larger.light.size == (24, 15)
    assert enlarge.target(full, lens, 4).light is targets[4].light
    enlarge.release()
    full.light.release()
    texture.release()
