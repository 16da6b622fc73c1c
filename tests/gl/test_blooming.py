"""Blooming on images against a model that moves charge pixel by pixel in float64."""

import json
from dataclasses import replace

import moderngl
import numpy as np
import pytest
from numpy.typing import NDArray

from glstar.camera.distortion import Lens
from glstar.camera.exposure import Exposure
from glstar.camera.sensor.sensor import ElectronModel, Sensor
from glstar.errors import RenderError
from glstar.render.effects import EFFECTS
from glstar.render.effects.electrons import BLOOMING, bloomed
from glstar.render.opengl import GLRenderer
from glstar.render.scene.scene import Frame, Scene
from glstar.render.truth.frame import frame_truth
from tests.support.scenes import NIGHT_UTC_S, camera, sky_over_adelaide, stars_at, turning

Float = NDArray[np.float64]

# Not a multiple of 16 pixels wide.
SIZE_PX = (327, 240)
# 10000 e are 20000 DN; a star of magnitude 0 leaves 5e5 electrons in half a second.
MODEL = ElectronModel(
    vmag_0_e_per_s=1e6,
    gain_dn_per_e=2.0,
    full_well_e=10_000.0,
    black_level_dn=100.0,
    dark_current_e_per_s=400.0,
    read_noise_before_gain_e=1.0,
)
DARK_DN = 2.0 * 400.0 * 0.5
FULL_DN = 20_000.0
# Rounding to whole numbers, and float32.
ROUNDING_DN = 0.505


def sensor(along: str, fraction: float = 1.0, bit_depth: int = 16, **keys: object) -> Sensor:
    effects = {"sensor.blooming": along, "sensor.blooming_fraction": fraction, **keys}
    return Sensor(bit_depth=bit_depth, electrons=MODEL, effects=effects)  # type: ignore[arg-type]


def star(sensor: Sensor, xy_px: tuple[float, float] = (160.0, 120.0), vmag: float = -2.0) -> Scene:
    return stars_at([xy_px], [vmag], sensor=sensor, lens=camera(*SIZE_PX))


def noiseless(renderer: GLRenderer, scene: Scene) -> Frame:
    renderer.develop(scene, seed=0, light=True, noiseless=True)
    return renderer.read().frame()


def spilled(line: Float, full_well: float, fraction: float) -> Float:
    """Return a line after blooming, one portion of charge after the other, one pixel after the other."""
    both = []
    for first in (1, -1):
        kept = line.copy()
        for step in (first, -first):
            for start in np.flatnonzero(line > full_well)[::-step].tolist():
                kept[start] = full_well
                charge = fraction * (line[start] - full_well) / 2
                pixel = start + step
                while charge > 0 and 0 <= pixel < len(line):
                    moved = min(charge, max(full_well - kept[pixel], 0.0)) if line[pixel] <= full_well else 0.0
                    kept[pixel] += moved
                    charge -= moved
                    pixel += step
        both.append(kept)
    return np.mean(both, axis=0)


def reference_dn(signal_dn: Float, along: str, fraction: float = 1.0) -> Float:
    lines = signal_dn.astype(np.float64) if along == "rows" else signal_dn.T.astype(np.float64)
    moved = np.array([spilled(line, FULL_DN, fraction) for line in lines])
    return (moved if along == "rows" else moved.T) + MODEL.black_level_dn


@pytest.mark.parametrize("fraction", [1.0, 0.3])
def test_lines_are_those_of_charge_moved_pixel_by_pixel(fraction: float) -> None:
    rng = np.random.default_rng(1)
    lines = rng.uniform(0.0, 100.0, (200, 60))
    lines[rng.random(lines.shape) < 0.1] *= 8.0  # blooms of several stars meet, and pass through saturated pixels

    expected = [spilled(line, 100.0, fraction) for line in lines]

    np.testing.assert_allclose(bloomed(lines, 100.0, fraction), expected, rtol=0, atol=1e-9)
    # The same in both directions.
    np.testing.assert_allclose(bloomed(lines[:, ::-1], 100.0, fraction)[:, ::-1], expected, rtol=0, atol=1e-9)


def test_charge_is_conserved_and_blooms_are_as_long_as_they_must_be() -> None:
    line = np.full((1, 101), 20.0)
    line[0, 50] = 100.0 + 1600.0  # 800 in each direction fill ten pixels of 80

    full = bloomed(line, 100.0)

    assert full.sum() == pytest.approx(line.sum(), rel=1e-12)
    assert np.flatnonzero(full[0] > 99.0).tolist() == list(range(40, 61))
    assert bloomed(line, 100.0, 0.5).sum() == pytest.approx(line.sum() - 800.0, rel=1e-12)
    # At the edge, the half that moves outwards leaves the image.
    line[0, 50], line[0, 0] = 20.0, 1700.0
    assert bloomed(line, 100.0).sum() == pytest.approx(line.sum() - 800.0, rel=1e-12)


@pytest.mark.parametrize("along", ["columns", "rows"])
@pytest.mark.parametrize("fraction", [1.0, 0.4])
def test_a_bright_star_blooms(renderer: GLRenderer, along: str, fraction: float) -> None:
    at_the_edge = star(sensor(along, fraction), (325.0, 3.0))
    for scene in (star(sensor(along, fraction)), at_the_edge):
        frame = noiseless(renderer, scene)

        signal_dn = frame.light_dn + np.float32(DARK_DN)
        np.testing.assert_allclose(frame.pixels, reference_dn(signal_dn, along, fraction), rtol=0, atol=ROUNDING_DN)
    image = noiseless(renderer, star(sensor(along, fraction))).pixels.astype(float)
    rows, columns = np.nonzero(image > 20_000.0)
    across, length = (columns, rows) if along == "columns" else (rows, columns)
    assert np.ptp(across) < 14  # saturated pixels of the star itself
    assert np.ptp(length) > (40 if fraction == 1.0 else 15)
    if fraction == 1.0:
        total_dn = frame_total_dn(renderer, scene=star(sensor(along)))
        assert image.sum() - 100.0 * image.size == pytest.approx(total_dn, rel=1e-4)


def frame_total_dn(renderer: GLRenderer, scene: Scene) -> float:
    light_dn = noiseless(renderer, scene).light_dn
    assert light_dn is not None
    return float(light_dn.astype(float).sum() + DARK_DN * light_dn.size)


@pytest.mark.parametrize("bit_depth", [8, 16])
def test_a_frame_without_saturated_pixels_has_the_same_bytes(renderer: GLRenderer, bit_depth: int) -> None:
    model = replace(MODEL, black_level_dn=10.0)
    plain = replace(sensor("none", bit_depth=bit_depth), electrons=model)
    faint = star(replace(sensor("columns", bit_depth=bit_depth), electrons=model), vmag=6.0)

    np.testing.assert_array_equal(
        renderer.render(faint, seed=3).pixels, renderer.render(replace(faint, sensor=plain), seed=3).pixels
    )


def test_only_the_columns_of_saturated_pixels_change(renderer: GLRenderer) -> None:
    mosaic = {"sensor.band": "imx477", "sensor.mosaic": "rggb", "sensor.prnu_fraction": 0.02, "lens.vignetting": "cos4"}
    scene = star(sensor("columns", **mosaic))
    before = renderer.render(replace(scene, sensor=sensor("none", **mosaic)), seed=3).pixels
    after = renderer.render(scene, seed=3).pixels

    changed = np.flatnonzero((before != after).any(axis=0))
    assert len(changed)
    assert (np.abs(changed - 160) < 5).all()


@pytest.mark.parametrize("case", ["rolling", "lens", "mosaic", "trail"])
def test_photosites_bloom_after_all_light_is_summed(renderer: GLRenderer, case: str) -> None:
    keys = {"sensor.band": "imx477", "sensor.mosaic": "rggb"} if case == "mosaic" else {}
    lens = replace(camera(*SIZE_PX, 250.0), lens=Lens("plumb_bob", (-0.1, 0.02, 0.0, 0.0)) if case == "lens" else None)
    if case == "trail":
        scene = stars_at([[160.0, 120.0]], [-1.0], sensor=sensor("columns"), lens=lens, turn=turning(4.0))
    else:
        sky = sky_over_adelaide(lens, sensor=sensor("columns", **keys), roll_rate_rad_per_s=0.05)
        readout_s = 0.1 if case == "rolling" else 0.0
        scene = sky.scene(Exposure(NIGHT_UTC_S + 1, 0.5, readout_s=readout_s))
    frame = noiseless(renderer, scene)

    signal_dn = frame.light_dn + np.float32(DARK_DN)
    assert (signal_dn > FULL_DN).any()
    np.testing.assert_allclose(frame.pixels, reference_dn(signal_dn, "columns"), rtol=0, atol=ROUNDING_DN)


def test_each_short_exposure_of_a_stack_blooms(renderer: GLRenderer) -> None:
    sky = sky_over_adelaide(camera(*SIZE_PX), sensor=sensor("columns", bit_depth=14))
    scene = sky.scene(Exposure(NIGHT_UTC_S + 1, 0.5, frames=3, stack="mean"))
    stacked = noiseless(renderer, scene)
    shorts = [noiseless(renderer, short).pixels.astype(int) for short in scene.shorts]

    assert stacked.saturated is not None
    assert (stacked.saturated == (np.max(shorts, axis=0) >= 2**14 - 1)).all()
    np.testing.assert_array_equal(stacked.pixels, (2 * np.sum(shorts, axis=0) + 3) // 6)


def test_a_star_in_the_bloom_of_another_is_saturated_in_the_truth(renderer: GLRenderer) -> None:
    model = replace(MODEL, full_well_e=2500.0)  # above what the converter of 12 bits counts
    stars = [[160.0, 120.0], [160.0, 100.0], [190.0, 100.0]]
    marked = {}
    for along in ("none", "columns", "rows"):
        scene = stars_at(
            stars,
            [-1.0, 6.0, 6.0],
            sensor=replace(sensor(along, bit_depth=12), electrons=model),
            lens=camera(*SIZE_PX),
        )
        truth = json.loads(frame_truth(scene, renderer.render(scene, seed=1), number=0, file="frame.png"))
        marked[along] = [one["saturated"] for one in sorted(truth["stars"], key=lambda one: one["star_id"])]
        assert truth.get("blooming") == (None if along == "none" else {"along": along, "fraction": 1.0})

    assert marked == {"none": [True, False, False], "columns": [True, True, False], "rows": [True, False, False]}


def test_blooming_moves_the_electrons_that_were_counted(renderer: GLRenderer) -> None:
    """Full pixels of a bloom have read noise only, and the charge of the image scatters as Poisson counts do."""
    model = replace(MODEL, dark_current_e_per_s=0.0, read_noise_after_gain_e=0.0)
    scene = star(replace(sensor("columns"), electrons=model), vmag=-1.0)
    frames = np.array([renderer.render(scene, seed=seed).pixels.astype(float) for seed in range(60)])
    signal_dn = noiseless(renderer, scene).light_dn
    bloomed_dn = noiseless(renderer, scene).pixels - 100.0
    filled = (bloomed_dn > FULL_DN - 1) & (signal_dn < 0.5 * FULL_DN)
    inside = filled & np.roll(filled, 3, axis=0) & np.roll(filled, -3, axis=0)
    assert inside.sum() > 20
    assert frames[:, inside].var(axis=0).mean() == pytest.approx(4.0 * 1.0**2 + 1 / 12, rel=0.1)
    np.testing.assert_allclose(frames[:, inside].mean(), FULL_DN + 100, rtol=0, atol=0.5)
    sums = (frames - 100.0).sum(axis=(1, 2)) / 2.0
    expected_e = float(signal_dn.sum()) / 2.0
    scatter_e = np.sqrt(expected_e + signal_dn.size)
    assert sums.mean() == pytest.approx(expected_e, abs=4 * scatter_e / np.sqrt(60))
    assert sums.std() == pytest.approx(scatter_e, rel=0.35)


def test_two_effects_that_move_charge_are_refused(context: moderngl.Context) -> None:
    again = replace(BLOOMING, name="again", glsl=BLOOMING.glsl.replace("blooming", "again"))
    with (
        GLRenderer(context, effects=[*EFFECTS, again]) as renderer,
        pytest.raises(RenderError, match="at most one effect moves charge, not blooming and again"),
    ):
        renderer.render(star(sensor("columns")), seed=0)
