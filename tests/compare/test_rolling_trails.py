"""Trails that a rolling shutter leaves, as a comparison with real images predicts them."""

import json

import numpy as np
import pytest

from glstar.camera.exposure import Exposure
from glstar.camera.sensor.sensor import Sensor
from glstar.compare.prediction import predicted_trails
from glstar.render.opengl import GLRenderer
from glstar.render.truth.frame import frame_truth
from tests.support.scenes import NIGHT_UTC_S, camera, sky_over_adelaide


@pytest.mark.parametrize("readout", ["down", "left"])
def test_predicted_trails_begin_and_end_with_the_rows_of_their_stars(readout):
    sensor = Sensor(reference_peak_dn=2000.0, bit_depth=16)
    turn = {"roll_rate_rad_per_s": np.deg2rad(20.0), "refraction": False}
    simulator = sky_over_adelaide(camera(800, 600, 967.7425), sensor=sensor, vmag_limit=5.0, **turn)
    scene = simulator.scene(Exposure(NIGHT_UTC_S + 0.4, 0.1, readout_s=0.087, readout=readout))
    with GLRenderer.headless() as renderer:
        frame = renderer.render(scene, seed=1, light=True)
    truth = {s["star_id"]: s for s in json.loads(frame_truth(scene, frame, number=0, file="x.png"))["stars"]}

    trails = predicted_trails(scene, frame, noise_dn=3.0, least_signal=10.0, most=20)

    assert len(trails) >= 2
    for k, star_id in enumerate(trails.star_id.tolist()):
        star, path = truth[star_id], trails.path_px[:, k]
        half_step = (path[1] - path[0]) / 2
        assert tuple(path[0] - half_step) == pytest.approx(star["start"], rel=0, abs=0.02)
        assert tuple(path[-1] + half_step) == pytest.approx(star["end"], rel=0, abs=0.02)
        # A delay moves the recorded trail by more than the star moves, if it moves along the readout.
        speed = (np.array(star["end"]) - star["start"]) / scene.exposure.duration_s
        assert tuple(trails.jacobian[k, :2, 3]) == pytest.approx(tuple(speed), rel=0.02, abs=1.0)
