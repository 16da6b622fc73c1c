"""Trails in pieces, against brute force and against the same trails in segments."""

from dataclasses import replace
from unittest.mock import patch

import numpy as np
import pytest
from scipy.ndimage import maximum_filter

from glstar.camera.distortion import Lens
from glstar.camera.exposure import Exposure
from glstar.camera.sensor.pointspread import TRUNCATION_DN
from glstar.config import Config
from glstar.render.motion.trailmodels import AnalyticSegments
from glstar.render.opengl.passes import trail as trailpass
from glstar.render.opengl.textures import readout_clock
from glstar.system.resources import asset
from tests.scripts.random_trails import FREE_PIECES, Variant, drawn_in_pieces, random_trial, worst_pixel

# Of the local maximum, in any pixel.
TOLERANCE = 0.005


@pytest.mark.parametrize(
    "variant", [Variant(), Variant(fisheye=True), Variant(rolling=True)], ids=["pinhole", "fisheye", "rolling"]
)
def test_no_pixel_of_a_random_trail_in_pieces_is_half_a_percent_of_the_local_maximum_off(renderer, variant):
    seeds = (204, 209, 213) if variant.rolling else range(200, 206)
    trials = {seed: random_trial(seed, variant) for seed in seeds}
    with drawn_in_pieces():
        fractions = {seed: worst_pixel(renderer, trial).fraction for seed, trial in trials.items()}
    assert {seed: fraction for seed, fraction in fractions.items() if not fraction <= TOLERANCE} == {}
    scenes = [trial.simulator.scene(trial.exposure) for trial in trials.values()]
    clocks = [readout_clock(scene.exposure, scene.camera, 0) for scene in scenes]
    divided = [
        trailpass.in_pieces(scene, scene.trails, FREE_PIECES, openings=clock.openings(0))
        for scene, clock in zip(scenes, clocks, strict=True)
    ]
    assert sum(one is not None and len(one.parts[0].scene.draw_list) > 0 for one in divided) > 2


def test_a_star_that_sets_is_not_drawn_in_pieces(renderer):
    trial = random_trial(5, Variant(horizon=True))
    scene = trial.simulator.scene(trial.exposure)
    divided = trailpass.in_pieces(scene, scene.trails, FREE_PIECES)
    assert divided is not None
    assert sum(len(part.scene.draw_list) for part in divided.parts) == 0
    with drawn_in_pieces():
        assert worst_pixel(renderer, trial).fraction <= TOLERANCE


@pytest.mark.parametrize(
    ("after_s", "keys"),
    [
        (20.0, {}),
        (33.5, {}),
        (20.0, {"sensor.band": "imx477", "sensor.mosaic": "rggb"}),
        (20.0, {"sensor.psf": "moffat", "sensor.psf_ellipticity": 0.2}),
        (20.0, {"cloud.coverage": 0.5, "cloud.scale_m": 300.0}),
        (25.0, {"exposure.readout_s": 0.087}),
        (25.0, {"exposure.readout_s": 0.087, "cloud.coverage": 0.5, "cloud.scale_m": 300.0}),
        (25.0, {"exposure.readout_s": 0.087, "camera.lens": "plumb_bob"}),
    ],
    ids=["gaussian", "faint", "mosaic", "moffat-and-elliptic", "cloud", "rolling", "rolling-and-cloud", "rolling-lens"],
)
def test_a_rough_flight_is_the_same_in_pieces_as_in_segments(renderer, after_s, keys):
    keys = dict(keys)
    readout_s, lens = keys.pop("exposure.readout_s", 0.0), keys.pop("camera.lens", None)
    config = Config().override(**{"camera.preset": "picamhq-6mm-binned4", **keys})
    simulator = config.simulator(config.open_flight(asset("adelaide.BIN")))
    if lens is not None:
        simulator = replace(simulator, camera=replace(simulator.camera, lens=Lens(lens, (-0.3, 0.1, 0.0, 0.0, 0.0))))
    exposure = Exposure(simulator.flight.attitude.first_s + after_s, 0.5, trail="auto", readout_s=readout_s)
    scene = simulator.scene(exposure)
    assert isinstance(scene.trails, AnalyticSegments)
    divided = trailpass.in_pieces(scene, scene.trails, FREE_PIECES)
    # Most stars of a fast exposure are so faint that longer pieces suffice.
    assert after_s < 30.0 or len(divided.parts) == 2
    with patch.object(trailpass, "in_pieces", lambda *_, **__: None):
        in_segments = renderer.render(scene, seed=0, light=True).light_dn
    with drawn_in_pieces():
        again = replace(scene, draw_list=replace(scene.draw_list))
        drawn = renderer.render(again, seed=0, light=True).light_dn
    assert not np.array_equal(drawn, in_segments)
    # Both leave out light below 0.02 DN, but not at the same distance from a star.
    assert (np.abs(drawn - in_segments) - TOLERANCE * maximum_filter(in_segments, 9)).max() < 1.5 * TRUNCATION_DN
    assert drawn.sum(dtype=np.float64) == pytest.approx(in_segments.sum(dtype=np.float64), rel=1e-3)
