"""What cloud transmits of a frame and its stars: the sheet crossed at the middle of the exposure, pixel by pixel."""

from dataclasses import replace

import numpy as np
import pytest

from glstar.camera.exposure import Exposure
from glstar.camera.model import Mount
from glstar.camera.sensor.sensor import Sensor
from glstar.render.effects.cloud import (
    axis_transmission,
    crossing_at,
    frame_transmission,
    is_below_cloud,
    sky_fraction,
    transmission_at,
    transmission_towards,
)
from glstar.render.scene.clouds import cloud_sheet, sheet_crossing
from glstar.render.scene.scene import Scene
from tests.support.clouds import CLOUD
from tests.support.scenes import ADELAIDE, NIGHT_UTC_S, camera, sky_over_adelaide

LENS = camera(96, 72, 90.0)
# In six seconds the cloud moves by a third of its size and the camera turns.
EXPOSURE = Exposure(NIGHT_UTC_S + 1.0, 6.0)


def cloudy(pitch_deg: float = 60.0, **effects: float) -> Scene:
    simulator = sky_over_adelaide(
        LENS,
        sensor=Sensor(effects=CLOUD | effects),
        mount=Mount(pitch_rad=np.deg2rad(pitch_deg)),
        vmag_limit=2.0,
        yaw_rate_rad_per_s=0.02,
    )
    return simulator.scene(EXPOSURE)


def transmitted(scene: Scene, rays: np.ndarray, time: int) -> np.ndarray:
    """Return what the sheet transmits along rays at the start, the middle or the end of the exposure."""
    direction = rays @ scene.shutter.C_camera_eq[time]
    zenith = scene.shutter.zenith_eq[time]
    site = ADELAIDE.latitude_rad, ADELAIDE.longitude_rad, ADELAIDE.height_m
    sheet = cloud_sheet(scene.sensor, scene.motion)
    return sheet_crossing(
        sheet, direction @ zenith, direction, zenith, site, EXPOSURE.start_utc_s + 3.0 * time
    ).transmission


def test_the_sheet_is_crossed_at_the_start_the_middle_and_the_end() -> None:
    pixels = np.stack(np.meshgrid(np.linspace(3.0, 90.0, 6), np.linspace(4.0, 70.0, 5)), axis=-1)
    scene, rays = cloudy(), LENS.unit_vectors(pixels.reshape(-1, 2))
    at_times = [transmitted(scene, rays, time) for time in range(3)]
    assert min(np.abs(np.diff(at_times, axis=0)).max(axis=1)) > 0.1
    for time, expected in enumerate(at_times):
        direction = rays @ scene.shutter.C_camera_eq[time]
        np.testing.assert_allclose(crossing_at(scene, time, direction).transmission, expected, rtol=0, atol=1e-9)
    middle = rays @ scene.shutter.C_camera_eq[1]
    np.testing.assert_allclose(transmission_towards(scene, middle), at_times[1], rtol=0, atol=1e-9)
    np.testing.assert_allclose(transmission_at(scene, pixels), at_times[1].reshape(5, 6), rtol=0, atol=1e-9)
    on_axis = transmitted(scene, np.array([[0.0, 0, 1]]), 1)
    assert axis_transmission(scene) == pytest.approx(on_axis[0], rel=0, abs=1e-9)


@pytest.mark.parametrize("pitch_deg", [60.0, 5.0])
def test_the_means_of_a_frame_are_those_of_the_sky_on_its_pixels(pitch_deg: float) -> None:
    scene = cloudy(pitch_deg)
    x, y = np.meshgrid(np.arange(96.0), np.arange(72.0))
    rays = LENS.unit_vectors(np.stack([x, y], axis=-1).reshape(-1, 2))
    is_sky = scene.above_horizon(rays @ scene.shutter.C_camera_eq[1]) >= 0
    assert is_sky.all() == (pitch_deg == 60.0)
    # The horizon lies between two of 37 rows.
    assert sky_fraction(scene) == pytest.approx(is_sky.mean(), rel=0, abs=0.5 / 37)
    expected = transmitted(scene, rays[is_sky], 1).mean()
    assert frame_transmission(scene) == pytest.approx(expected, rel=0, abs=0.02)


def test_above_the_cloud_below_the_horizon_and_without_cloud_all_light_arrives() -> None:
    down = cloudy(-60.0)
    assert (frame_transmission(down), sky_fraction(down), axis_transmission(down)) == (None, 0.0, 1.0)
    for height_m, is_below in ((49.0, False), (51.0, True)):  # the aircraft is 50 m high
        scene = cloudy(**{"cloud.height_m": height_m})
        assert is_below_cloud(scene) == is_below
        assert (frame_transmission(scene) < 1.0) == is_below
    for key in ("cloud.coverage", "cloud.optical_depth"):
        clear = cloudy(**{key: 0.0})
        assert not is_below_cloud(clear)
        assert crossing_at(clear, 1, np.array([[0.0, 0, 1]])) is None
        assert frame_transmission(clear) == 1.0
    assert crossing_at(replace(cloudy(), motion=None), 1, np.array([[0.0, 0, 1]])) is None
