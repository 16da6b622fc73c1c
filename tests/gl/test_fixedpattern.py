"""The fixed pattern on images against the arrays that it is drawn from."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from glstar.camera.sensor.pixelpattern import PixelPattern
from glstar.camera.sensor.sensor import ElectronModel, Sensor
from glstar.config import Config
from glstar.render.effects import EFFECTS
from glstar.render.effects.fixedpattern import DARK_PATTERN
from glstar.render.opengl import GLRenderer
from glstar.render.opengl.passes import develop as developpass
from glstar.render.scene.scene import Scene
from tests.support.scenes import camera, stars_at

# Not a multiple of 16 pixels wide.
SIZE_PX = (327, 240)
QUIET = ElectronModel(
    sky_e_per_s=2000.0,
    gain_dn_per_e=2.0,
    read_noise_before_gain_e=0.0,
    read_noise_after_gain_e=0.0,
    dark_current_e_per_s=20.0,
    black_level_dn=100.0,
    full_well_e=20000.0,
)


def empty(model: ElectronModel = QUIET, **keys: float | str) -> Scene:
    sensor = Sensor(bit_depth=16, electrons=model, effects={f"sensor.{key}": value for key, value in keys.items()})
    return stars_at([[10.0, 10.0]], [3.0], sensor=sensor, lens=camera(*SIZE_PX)).with_visible(slice(0))


def mean_image(renderer: GLRenderer, scene: Scene, frames: int = 40) -> NDArray[np.float64]:
    return np.mean([renderer.render(scene, seed=seed).pixels.astype(np.float64) for seed in range(frames)], axis=0)


def test_each_pixel_has_its_dark_current_and_its_response(renderer: GLRenderer) -> None:
    keys = {"hot_pixels_per_mpx": 3000.0, "dsnu_fraction": 0.3, "prnu_fraction": 0.05, "dead_pixels_per_mpx": 500.0}
    pattern = PixelPattern(**keys)
    light_e, dark_e = 1000.0, 10.0
    expected_e = light_e * (1 + pattern.response(*SIZE_PX)) + dark_e + pattern.dark_e(*SIZE_PX, dark_e)

    image = mean_image(renderer, empty(**keys))

    error_e = (image - 100.0) / 2 - np.minimum(expected_e, 20000.0)
    # Forty frames of shot noise; half floats add 0.05 %.
    sigma_e = np.sqrt(np.maximum(expected_e, 0.3) / 40) + 5e-4 * expected_e + 0.02
    assert np.abs(error_e / sigma_e).max() < 5.5
    assert (error_e / sigma_e).std() == pytest.approx(0.8, abs=0.25)


@pytest.mark.parametrize("bit_depth", [8, 16])
def test_few_hot_pixels_are_drawn_alone_with_the_same_bytes(
    renderer: GLRenderer, monkeypatch: pytest.MonkeyPatch, bit_depth: int
) -> None:
    scene = empty(replace(QUIET, black_level_dn=20.0, sky_e_per_s=40.0), hot_pixels_per_mpx=300.0, prnu_fraction=0.02)
    scene = replace(scene, sensor=replace(scene.sensor, bit_depth=bit_depth))
    cool = replace(scene, sensor=replace(scene.sensor, effects={"sensor.prnu_fraction": 0.02}))
    whole, without = (renderer.render(one, seed=7).pixels for one in (scene, cool))
    monkeypatch.setattr(developpass, "_LARGE_PX", 1)
    hot_px = developpass._changed_px(EFFECTS, scene)[DARK_PATTERN]

    np.testing.assert_array_equal(renderer.render(scene, seed=7).pixels, whole)
    changed = {(x, y) for y, x in np.argwhere(whole != without).tolist()}
    assert len(changed) > 15
    assert changed <= set(map(tuple, hot_px.tolist()))


@pytest.mark.parametrize("keys", [{"dsnu_fraction": 0.1}, {"hot_pixels_per_mpx": 600.0}, {"dark_frame": "dark.npy"}])
def test_many_pixels_that_differ_in_the_dark_are_drawn_with_the_others(
    monkeypatch: pytest.MonkeyPatch, keys: dict[str, float | str]
) -> None:
    monkeypatch.setattr(developpass, "_LARGE_PX", 1)

    assert developpass._changed_px([DARK_PATTERN], empty(**keys)) == {}


def test_frames_of_one_camera_share_their_pattern_and_those_of_another_do_not(renderer: GLRenderer) -> None:
    # Light is so strong and uneven response so large that the pattern is all that is seen.
    bright = replace(QUIET, sky_e_per_s=20000.0)
    one, later, other = (
        renderer.render(empty(bright, prnu_fraction=0.3, camera_seed=camera_seed), seed=seed).pixels.astype(float)
        for camera_seed, seed in ((1, 0), (1, 1), (2, 0))
    )

    def correlation(a: NDArray[np.float64], b: NDArray[np.float64]) -> float:
        return float(np.corrcoef(a.ravel(), b.ravel())[0, 1])

    assert correlation(one, later) > 0.99
    assert abs(correlation(one, other)) < 0.015


def test_a_measured_dark_frame_is_added_to_the_black_level(renderer: GLRenderer, tmp_path: Path) -> None:
    dark = np.full(SIZE_PX[::-1], 64.0, np.float32)
    dark[7, 5], dark[8, 326] = 564.0, 114.0
    np.save(tmp_path / "dark.npy", dark)
    model = replace(QUIET, sky_e_per_s=0.0, dark_current_e_per_s=0.0)

    image = renderer.render(empty(model, dark_frame=str(tmp_path / "dark.npy")), seed=0).pixels.astype(float)

    assert np.median(image) == 100.0
    assert image[7, 5] == pytest.approx(600.0, abs=6 * np.sqrt(2 * 500))
    assert image[8, 326] == pytest.approx(150.0, abs=6 * np.sqrt(2 * 50))
    assert (image > 120).sum() <= 2


def test_rows_share_their_noise_and_frames_their_black_level(renderer: GLRenderer) -> None:
    model = replace(QUIET, sky_e_per_s=0.0, dark_current_e_per_s=0.0, black_level_dn=500.0)
    scene = empty(model, row_noise_e=10.0, black_drift_dn=50.0)

    frames = np.stack([renderer.render(scene, seed=seed).pixels.astype(float) for seed in range(200)])

    assert np.ptp(frames, axis=2).max() <= 1  # within a row
    rows = frames[:, :, 0] - frames[:, :, 0].mean(axis=1, keepdims=True)
    assert rows.std() == pytest.approx(20.0, rel=0.02)
    assert abs((rows[:, 1:] * rows[:, :-1]).mean()) / 400 < 3 / np.sqrt(rows.size)
    means = frames.mean(axis=(1, 2))
    # Two hundred draws of 50 DN, beside the mean of 240 rows of 20 DN.
    assert means.std() == pytest.approx(50.0, rel=0.15)
    assert means.mean() == pytest.approx(500.0, abs=4 * 50 / np.sqrt(200))
    # Without drift the same noise of the rows.
    steady = renderer.render(empty(model, row_noise_e=10.0), seed=5).pixels.astype(float)
    np.testing.assert_allclose(steady - frames[5], (steady - frames[5]).mean(), rtol=0, atol=1.01)


def test_maps_of_a_config_are_relative_to_it_and_must_fit(tmp_path: Path) -> None:
    np.save(tmp_path / "dark.npy", np.zeros((760, 1014), np.float32))
    config = tmp_path / "night.toml"
    config.write_text('[sensor]\nnoise = "electrons"\ndark_frame = "dark.npy"\nhot_pixels_per_mpx = 10.0\n')

    loaded = Config.load(config)

    assert loaded.sensor().effects["sensor.dark_frame"] == str(tmp_path / "dark.npy")
    assert tmp_path / "dark.npy" in loaded.files
