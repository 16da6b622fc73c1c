"""The map of the sky in place of one level, in both noise models."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from glstar.camera.sensor.sensor import ElectronModel, Sensor
from glstar.config import Config
from glstar.errors import ConfigError
from glstar.render.opengl import GLRenderer
from tests.support.scenes import camera, stars_at

PAPER = Sensor(sky_mean_dn=2000.0, sky_std_dn=0.0, bit_depth=16)
ELECTRONS = replace(
    PAPER,
    electrons=ElectronModel(
        sky_e_per_s=4000.0,
        gain_dn_per_e=1.0,
        full_well_e=1e6,
        black_level_dn=100.0,
        read_noise_before_gain_e=0.0,
        read_noise_after_gain_e=0.0,
        dark_current_e_per_s=0.0,
    ),
)


@pytest.mark.parametrize("sensor", [PAPER, ELECTRONS])
@pytest.mark.parametrize("falloff", [False, True])
def test_the_sky_is_the_map_with_its_own_mean(
    renderer: GLRenderer, sensor: Sensor, falloff: bool, tmp_path: Path
) -> None:
    texels = np.array([[10.0, 30.0], [50.0, 70.0]], np.float32)
    np.save(tmp_path / "sky.npy", texels)
    effects = {"sensor.sky_map": str(tmp_path / "sky.npy")} | ({"lens.vignetting": "cos4"} if falloff else {})
    scene = stars_at([[160.0, 120.0]], [3.0], sensor=replace(sensor, effects=effects), lens=camera())
    pixels = renderer.render(scene.with_visible(slice(0)), seed=3).pixels.astype(np.float64)

    u, v = (np.clip(2 * (np.arange(n) + 0.5) / n - 0.5, 0, 1) for n in (320, 240))
    expected = 2000.0 * (10.0 + 20.0 * u + 40.0 * v[:, np.newaxis]) / 40.0
    black = 0.0 if sensor.electrons is None else 100.0
    noise = 1.0 if sensor.electrons is None else 6 * np.sqrt(expected)
    assert np.all(np.abs(pixels - black - expected) < noise)
    assert (pixels - black).mean() == pytest.approx(2000.0, abs=1.0)


@pytest.mark.parametrize(
    ("texels", "message"),
    [(None, "sensor.sky_map: cannot be used"), ([[-1.0, 2.0]], "a sky is 0 or brighter everywhere")],
)
def test_a_map_that_is_none_is_an_error_of_the_config(tmp_path: Path, texels: object, message: str) -> None:
    if texels is not None:
        np.save(tmp_path / "sky.npy", np.array(texels, np.float32))
    (tmp_path / "c.toml").write_text('[sensor]\nsky_map = "sky.npy"\n')
    with pytest.raises(ConfigError, match=message):
        Config.load(tmp_path / "c.toml")


def test_a_map_beside_the_config_is_found(tmp_path: Path) -> None:
    np.save(tmp_path / "sky.npy", np.ones((2, 2), np.float32))
    (tmp_path / "c.toml").write_text('[sensor]\nsky_map = "sky.npy"\n')
    assert Config.load(tmp_path / "c.toml").sensor().effects["sensor.sky_map"] == str(tmp_path / "sky.npy")
