"""Flare of the Moon and of a lamp: its light against closed forms, and on images."""

import json
from dataclasses import replace

import numpy as np
import pytest

from glstar.camera.exposure import Exposure
from glstar.camera.sensor.sensor import Sensor
from glstar.render.effects.lensflare import flare_dn
from glstar.render.opengl import GLRenderer
from glstar.render.truth.frame import frame_truth
from tests.support.scenes import NIGHT_UTC_S, camera, sky_over_adelaide

LENS = camera(320, 240, 300.0)
LAMP = {"flare.lamp_mag": -8.0, "flare.lamp_altitude_deg": 90.0}
PIXELS = np.stack(np.meshgrid(np.arange(320.0), np.arange(240.0)), axis=-1)


def scene_of(keys, *, lens=LENS, bit_depth=16, lamp=LAMP):
    effects = {f"flare.{key}": value for key, value in keys.items()}
    sensor = Sensor(
        bit_depth=bit_depth, reference_peak_dn=2e3, sky_mean_dn=100.0, sky_std_dn=1.0, effects=effects | lamp
    )
    return sky_over_adelaide(lens, sensor=sensor, refraction=False).scene(Exposure(NIGHT_UTC_S + 2.0, 0.5))


def lamp_flux_dn(scene):
    return float(scene.sensor.flux_of_magnitude_dn(-8.0, 0.5))


def test_scattered_light_adds_up_to_its_fraction() -> None:
    """Within an angle t of the source, Harvey and Shack's law holds ln(1 + sin^2 t / l^2) / ln(1 + 1 / l^2) of it."""
    scene = scene_of({"scatter": 0.02, "scatter_deg": 2.0})
    shoulder = np.sin(np.deg2rad(2.0))
    radius_px = np.hypot(PIXELS[..., 0] - 159.5, PIXELS[..., 1] - 119.5)
    flare = flare_dn(scene, PIXELS)
    for t_px in (40.0, 110.0):
        sine2 = np.sin(np.arctan(t_px / 300.0)) ** 2
        expected = 0.02 * np.log1p(sine2 / shoulder**2) / np.log1p(shoulder**-2)
        assert flare[radius_px < t_px].sum() / lamp_flux_dn(scene) == pytest.approx(expected, rel=5e-3, abs=0)


def test_a_lamp_outside_the_image_veils_it_and_a_hood_stops_it() -> None:
    aside = LAMP | {"flare.lamp_altitude_deg": 40.0}
    lit = flare_dn(scene_of({"scatter": 0.02}, lamp=aside), PIXELS)
    assert lit.min() > 0
    assert flare_dn(scene_of({"scatter": 0.02, "hood_deg": 45.0}, lamp=aside), PIXELS).max() == 0
    behind = LAMP | {"flare.lamp_altitude_deg": -10.0}
    assert flare_dn(scene_of({"scatter": 0.02}, lamp=behind), PIXELS).max() < 0.01 * lit.max()  # planets


@pytest.mark.parametrize("keys", [{"ghost_fraction": 1e-3, "ghosts": 3, "ghost_size": 0.3}, {"streak_fraction": 1e-3}])
def test_ghosts_and_streaks_have_their_part_of_the_light(keys) -> None:
    lamp = LAMP | {"flare.lamp_altitude_deg": 85.0, "flare.lamp_azimuth_deg": 30.0}
    scene = scene_of(keys, lamp=lamp)
    # Far beyond the image: the whole light of a streak is there but for its Lorentzian tails.
    wide = np.stack(np.meshgrid(np.arange(-3000.0, 3320.0, 2.0), np.arange(-400.0, 640.0, 2.0)), axis=-1)
    fraction = keys.get("streak_fraction", 0.0) + 3 * keys.get("ghost_fraction", 0.0)
    total = 4 * flare_dn(scene, wide).sum() / lamp_flux_dn(scene) / np.cos(np.deg2rad(5.0))
    assert total == pytest.approx(fraction, rel=0.02, abs=0)


def test_the_image_has_the_flare_and_truth_says_how_much(renderer: GLRenderer) -> None:
    keys = {"scatter": 0.01, "scatter_deg": 3.0, "ghost_fraction": 5e-4, "ghost_size": 0.5}
    lamp = LAMP | {"flare.lamp_altitude_deg": 80.0}
    scene, dark = scene_of(keys, lamp=lamp), scene_of({}, lamp={})
    images = [
        np.mean([renderer.render(one, seed=seed).pixels.astype(float) for seed in range(8)], axis=0)
        for one in (scene, dark)
    ]
    expected = flare_dn(scene, PIXELS)
    clear = (images[1] < 110) & (expected < 2e4)
    # Bilinear between nodes, which blurs the edges of ghosts; noise of 0.5 DN.
    off = np.abs((images[0] - images[1])[clear] - expected[clear])
    assert np.mean(off < 3.0 + 0.06 * expected[clear]) > 0.99
    assert np.median(off) < 0.5
    line = json.loads(frame_truth(scene, renderer.render(scene, seed=0), number=0, file="a"))
    assert line["flare_mean_dn"] == pytest.approx(expected.mean(), rel=0.1, abs=0)


def test_the_moon_flares_only_while_it_is_up() -> None:
    keys = {"flare.scatter": 0.01}
    means = []
    for hours in (0.0, 10.0):
        base = sky_over_adelaide(LENS, sensor=Sensor(effects=keys))
        night = 1710757800.0 - NIGHT_UTC_S + 3600 * hours  # 2024-03-18 10:30 UTC: the Moon is at first quarter
        flight = replace(base.flight, attitude=base.flight.attitude).shifted(night)
        scene = replace(base, flight=flight).scene(Exposure(NIGHT_UTC_S + night + 1.0, 0.5))
        means.append(flare_dn(scene, PIXELS).mean())
    assert means[0] > 0.01
    assert means[1] < 0.01 * means[0]  # planets
